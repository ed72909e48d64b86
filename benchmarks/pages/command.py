"""Options of the scripts that write a folder of pages from what they have measured and stored."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

import torch

from pages.text import write


def command(
    document: str,
    quick: str,
    measure: Callable[[bool], None],
    stored: Path,
    folder: Path,
    files: Callable[[], Mapping[str, str | bytes]],
) -> None:
    """Do what the options ask for: measure and store on one thread, write the pages.

    Args:
        document: docstring of the script.
        quick: help of `--quick`.
        measure: stores measurements; its argument is true with `--quick`.
        stored: file of the measurements.
        folder: folder of the pages.
        files: all files of the folder by name.
    """
    root = Path(__file__).resolve().parents[2]
    options = argparse.ArgumentParser(description=document.splitlines()[0])
    options.add_argument("--quick", action="store_true", help=quick)
    options.add_argument("--measure", action="store_true", help=f"store measurements in {stored.relative_to(root)}")
    options.add_argument("--write", action="store_true", help=f"write {folder.relative_to(root)}")
    arguments = options.parse_args()
    torch.set_num_threads(1)
    if arguments.measure:
        measure(arguments.quick)
    if arguments.write:
        print("\n".join(write(folder, files())) or "nothing has changed")
