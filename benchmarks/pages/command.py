"""Options of the scripts that write a folder of pages from what they have measured and stored."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

import torch

from pages.text import write


def command(
    document: str,
    quick: str,
    measure: Callable[[bool, Sequence[str]], None],
    known: Collection[str],
    stored: Path,
    folder: Path,
    files: Callable[[], Mapping[str, str | bytes]],
) -> None:
    """Do what the options ask for: measure and store on one thread, write the pages.

    Args:
        document: docstring of the script.
        quick: help of `--quick`.
        measure: stores measurements; its arguments are whether `--quick` is given, and the names of `--measure`.
        known: names of all that is measured.
        stored: file of the measurements.
        folder: folder of the pages.
        files: all files of the folder by name.
    """
    root = Path(__file__).resolve().parents[2]
    options = argparse.ArgumentParser(description=document.splitlines()[0])
    options.add_argument("--quick", action="store_true", help=quick)
    where = stored.relative_to(root)
    options.add_argument("--measure", nargs="*", metavar="NAME", help=f"store measurements of some, or all, in {where}")
    options.add_argument("--write", action="store_true", help=f"write {folder.relative_to(root)}")
    arguments = options.parse_args()
    torch.set_num_threads(1)
    if unknown := set(arguments.measure or ()) - set(known):
        options.error(
            f"--measure takes names among {', '.join(known)}, found {', '.join(unknown)}; a new one needs a case in "
            "benchmarks/pages first"
        )
    if arguments.measure is not None:
        measure(arguments.quick, arguments.measure)
    if arguments.write:
        print("\n".join(write(folder, files())) or "nothing has changed")
