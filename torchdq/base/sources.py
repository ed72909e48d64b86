"""Bytes of files that a caller names by a path, an address, an open file, or gives as they are.

Every reader takes the same kinds of sources through here, and none of them reads more than its bound.
"""

import os
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

from torchdq.errors import ArgumentError, TorchdqError

PACKAGES = ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH")  # variables in which ROS 2 and ROS 1 list their folders


class Content(NamedTuple):
    """Bytes of a source, with a name for messages."""

    name: str
    data: bytes


def content(
    kind: str, source: Any, most: int, error: type[TorchdqError], missing: type[TorchdqError], hint: str = ""
) -> Content:
    """Bytes of a source.

    Args:
        kind: contents for messages, e.g. "robot description".
        source: path (`~` is the home folder), `file://` or `package://` address, bytes, or an open file.
        most: largest number of bytes that is read.
        error, missing: errors of a source that cannot be read, and of a file that does not exist.
        hint: end of the message about a file that does not exist.
    """
    try:
        name, data = _read(kind, source, most, missing, hint)
    except (OSError, TypeError, ValueError) as fault:  # a folder, no permission, a name no file can have, a closed file
        if isinstance(fault, TorchdqError):
            raise
        cause = fault.strerror if isinstance(fault, OSError) and fault.strerror else fault
        raise error(f"the {kind} {_shown(source)} cannot be read: {cause}") from fault
    if len(data) > most:
        raise error(f"{name} is larger than {most / 1e6:g} MB, the limit for a {kind}")
    if not data:
        raise error(f"{name} is empty; a {kind} was expected")
    return Content(name, data)


def xml(
    kind: str, source: Any, most: int, error: type[TorchdqError], missing: type[TorchdqError], hint: str = ""
) -> str:
    """XML text of a source, which may be the text itself; arguments as in `content`."""
    if _is_xml(source):
        if len(source) > most:
            raise error(f"the text has {len(source)} characters; a {kind} has at most {most}")
        return source
    hint = "XML text would begin with '<'" + (hint and f"; {hint}")
    name, data = content(kind, source, most, error, missing, hint)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as fault:
        raise error(f"{name} is not UTF-8 text: {fault}") from fault


def file_name(source: Any) -> str:
    """Path or address of a source, or the name of an open file; "" of bytes, of XML text and where there is none."""
    if callable(getattr(source, "read", None)):
        name = getattr(source, "name", None)
        return name if isinstance(name, str) else ""
    return os.fsdecode(source) if isinstance(source, str | os.PathLike) and not _is_xml(source) else ""


def _is_xml(source: Any) -> bool:
    return isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<")


def _read(kind: str, source: Any, most: int, missing: type[TorchdqError], hint: str) -> Content:
    if isinstance(source, bytes | bytearray | memoryview):
        return Content(f"the {kind}", bytes(source))
    if callable(getattr(source, "read", None)):
        read = source.read(most + 1)
        data = read.encode() if isinstance(read, str) else memoryview(read).tobytes()
        return Content(file_name(source) or "the open file", data)
    if not isinstance(source, str | os.PathLike):
        expected = "a path, a file:// or package:// address, bytes or an open file"
        raise ArgumentError(f"the {kind} must be {expected}, found {_shown(source)}")
    text = os.fsdecode(source)
    if not text.strip():
        raise ValueError(f"its path is empty, found {_shown(text)}")
    path = located(text, missing)
    try:
        with path.open("rb") as file:
            return Content(text, file.read(most + 1))
    except FileNotFoundError as fault:
        variables = "; variables such as $HOME are not replaced, use os.path.expandvars" if "$" in text else ""
        raise missing(f"there is no file {_shown(str(path))}{variables}{hint and '; '}{hint}") from fault


def _shown(x: Any) -> str:
    """Value as Python writes it, its beginning if that is long."""
    text = repr(x)
    return text if len(text) <= 300 else f"{text[:300]}..."


def located(text: str, missing: type[TorchdqError], folder: Path | None = None) -> Path:
    """Path of a file that is named by a path or an address, in another file where that one's folder is given."""
    scheme, separator, _ = text.partition("://")
    if not separator or not scheme.isalnum():
        return Path(os.path.expanduser(text)) if folder is None else folder / text
    address = urlsplit(text)
    if scheme == "file" and address.netloc in ("", "localhost"):
        return Path(unquote(address.path))
    if scheme == "package":
        return _in_package(text, address.netloc, unquote(address.path).lstrip("/"), missing, folder)
    raise ValueError(
        f"only file:/// and package:// addresses are read, found {_shown(text)}; save the file and pass its path"
    )


def _in_package(text: str, package: str, inside: str, missing: type[TorchdqError], folder: Path | None) -> Path:
    """Path of a file in a package of ROS."""
    ament, ros = ([Path(x) for x in os.environ.get(variable, "").split(os.pathsep) if x] for variable in PACKAGES)
    folders = [prefix / "share" / package for prefix in ament]
    folders += [path for root in ros for path in (root / package, root) if path.name == package]
    around = [] if folder is None else [folder, *folder.parents]
    folders += [path for x in around for path in (x, x / package) if path.name == package]
    for path in folders:
        if (path / inside).is_file():
            return path / inside
    searched = ", ".join(map(str, folders)) or f"no folder, because {' and '.join(PACKAGES)} are not set"
    raise missing(
        f"there is no file {_shown(text)}; searched: {searched}; run the setup script of the ROS workspace, or pass "
        "the path of the file"
    )
