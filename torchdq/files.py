"""Files that are whole at any moment: written beside their place, and moved there in one step."""

import os
from pathlib import Path


def write_whole(path: Path, content: str | bytes, encoding: str = "utf-8") -> None:
    """Write a file, which holds what it held before or all that is new, never a part, even if this is interrupted.

    What is no regular file, such as /dev/stdout, is written as it is; of a link, the file that it leads to.

    Args:
        path: the file.
        content: its text or bytes.
        encoding: of a text.
    Raises:
        OSError: it cannot be written; `filename` is the path.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "note.txt"
    >>> write_whole(path, "well")
    >>> path.read_text(), [file.name for file in path.parent.iterdir()]
    ('well', ['note.txt'])
    """
    data = content.encode(encoding) if isinstance(content, str) else content
    try:
        if path.exists() and not path.is_file():
            path.write_bytes(data)
            return
        place = path.resolve()
        beside = place.with_name(f".{place.name}.{os.getpid()}.tmp")
        try:
            with beside.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())  # a name must not reach the disk before the content
            os.replace(beside, place)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
