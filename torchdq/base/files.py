"""Files that are whole at any moment: written beside their places, and moved there in one step."""

import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, which holds what it held before or all that is new, never a part, even if this is interrupted.

    What is no regular file, such as /dev/stdout, is written as it is; of a link, the file that it leads to.

    Args:
        path: the file.
        content: its text, in UTF-8, or bytes.
    Raises:
        OSError: it cannot be written; `filename` is the path.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "note.txt"
    >>> write_whole(path, "well")
    >>> path.read_text(), [file.name for file in path.parent.iterdir()]
    ('well', ['note.txt'])
    """
    write_together({path: content})


def write_together(contents: Mapping[Path, str | bytes]) -> None:
    """Write several files as `write_whole` does; none of them changes before all are on the disk."""
    beside: dict[Path, Path] = {}
    path = Path()
    try:
        try:
            for path, content in contents.items():
                data = content.encode() if isinstance(content, str) else content
                if path.exists() and not path.is_file():
                    path.write_bytes(data)
                    continue
                place = path.resolve()
                beside[place] = place.with_name(f".{place.name}.{os.getpid()}.tmp")
                with beside[place].open("wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())  # a name must not reach the disk before the content
            for path, part in beside.items():
                os.replace(part, path)
            for folder in {place.parent for place in beside}:
                _flush(folder)
        finally:
            for part in beside.values():
                part.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def remove_parts(path: Path) -> None:
    """Remove what killed processes left beside a file; nobody else may be writing it."""
    place = path.resolve()
    for part in place.parent.iterdir():
        if re.fullmatch(rf"\.{re.escape(place.name)}\.\d+\.tmp", part.name):
            part.unlink(missing_ok=True)


def _flush(folder: Path) -> None:
    """New names in a folder, brought to the disk where its file system can do that."""
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
