"""Files of text in a folder, each of them whole or not there at all."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from torchdq.errors import ArgumentError


def write(folder: Path, texts: Mapping[str, str]) -> list[Path]:
    """Paths of files with texts in ASCII, by name, in a folder, which is made if it is not there.

    All are written under other names first and then renamed, so that neither a full disk nor a killed process leaves a
    part of a file, and a build that runs meanwhile reads old files or new ones.

    Raises:
        ArgumentError: the folder is a file, or nothing can be written there.
    """
    temporary = {folder / name: folder / f".{name}.{os.getpid()}.tmp" for name in texts}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for other, text in zip(temporary.values(), texts.values(), strict=True):
            other.write_text(text, encoding="ascii")
        for path, other in temporary.items():
            os.replace(other, path)
    except OSError as error:
        cause = error.strerror or error
        raise ArgumentError(
            f"folder must be one that files can be written to, found {str(folder)!r}: {cause}"
        ) from error
    finally:
        for other in temporary.values():
            with suppress(OSError):  # renamed, or in a folder that is none
                other.unlink()
    return list(temporary)
