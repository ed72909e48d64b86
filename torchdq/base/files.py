"""Files that are whole at any moment: written beside their places, and moved there in one step."""

import os
from collections.abc import Mapping
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
    """Write several files as `write_whole` does; none of them changes before all are written."""
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
                beside[place].write_bytes(data)
            for path, part in beside.items():
                os.replace(part, path)
        finally:
            for part in beside.values():
                part.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
