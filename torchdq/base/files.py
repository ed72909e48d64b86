"""Files that are whole at any moment: written next to their places, and moved there in one step."""

import os
from collections.abc import Mapping
from pathlib import Path


def write_atomically(contents: Mapping[Path, str | bytes]) -> None:
    """Write files, each of which holds its old content or the new one, never a part, even if this is interrupted.

    None of them changes before all are written. /dev/stdout and others that are not regular files are written
    directly, and of a link the file that it leads to.

    Args:
        contents: text, in UTF-8, or bytes, by path.
    Raises:
        OSError: a file cannot be written; `filename` is its path.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "note.txt"
    >>> write_atomically({path: "well"})
    >>> path.read_text(), [file.name for file in path.parent.iterdir()]
    ('well', ['note.txt'])
    """
    parts: dict[Path, Path] = {}
    path = Path()
    try:
        try:
            for path, content in contents.items():
                data = content.encode() if isinstance(content, str) else content
                if path.exists() and not path.is_file():
                    path.write_bytes(data)
                    continue
                place = path.resolve()
                parts[place] = place.with_name(f".{place.name}.{os.getpid()}.tmp")
                parts[place].write_bytes(data)
            for path, part in parts.items():
                os.replace(part, path)
        finally:
            for part in parts.values():
                part.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
