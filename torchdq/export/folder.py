"""Files of text in a folder, each of them whole or not there at all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torchdq.base.files import write_atomically
from torchdq.errors import ArgumentError


def write(folder: Path, texts: Mapping[str, str]) -> list[Path]:
    """Paths of files with texts in ASCII, by name, in a folder, which is made if it is not there.

    Neither a full disk nor a killed process leaves a part of a file, and a build that runs meanwhile reads old files or
    new ones.

    Raises:
        ArgumentError: the folder is a file, or nothing can be written there.
    """
    files: dict[Path, str | bytes] = {folder / name: text.encode("ascii") for name, text in texts.items()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(files)
    except OSError as error:
        cause = error.strerror or error
        raise ArgumentError(
            f"folder must be one that files can be written to, found {str(folder)!r}: {cause}"
        ) from error
    return list(files)
