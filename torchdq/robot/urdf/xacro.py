"""URDF text that a xacro file expands to, through the packages xacro and xacrodoc."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import StringIO
from os import PathLike, fsdecode
from pathlib import Path
from typing import Any

from torchdq.base.optional import imported
from torchdq.base.sources import content, located
from torchdq.errors import ArgumentError, DescriptionError, MissingFileError, UnknownNameError

MOST_BYTES = 10_000_000
ASKED_BY = ("Robot.from_xacro", "'torchdq[xacro]'")


class Arguments(dict[str, str]):
    """Arguments by name, which keep in mind what a file asks for."""

    def __init__(self, given: Mapping[str, str]):
        super().__init__(given)
        self.asked: dict[str, None] = {}

    def __contains__(self, name: object) -> bool:
        self.asked[str(name)] = None
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.asked[name] = None
        return super().__getitem__(name)


class Expanded(StringIO):
    """URDF text, with the name of the xacro file around which its meshes lie."""

    name = ""


def expanded(path: Any, arguments: Any, packages: Any, defaults: Mapping[str, str] | None = None) -> Expanded:
    """URDF text of a xacro file; `Robot.from_xacro` says what is expected.

    `defaults` are arguments that go behind the others, and that the file need not ask for.
    """
    imported("xacrodoc", "xacrodoc", *ASKED_BY)  # teaches xacro to find packages without ROS
    xacro = imported("xacro", "xacro", *ASKED_BY)
    if not isinstance(path, str | PathLike) or fsdecode(path).lstrip().startswith("<"):
        raise ArgumentError(f"path must be the path of a xacro file, with its includes in place, found {path!r:.300}")
    source = content("xacro file", path, MOST_BYTES, DescriptionError, MissingFileError)
    file = Path(located(fsdecode(path), MissingFileError))
    own = {} if arguments is None else _strings("arguments", arguments)
    given = Arguments({**(defaults or {}), **own})
    folders = {} if packages is None else _strings("packages", packages)
    missing: list[str] = []
    try:
        with _found_near(file, folders, missing):
            document = xacro.process_file(str(file), mappings=given)
    except Exception as error:  # a xacro file is a program, whose errors are of any type
        hint = f"; say where {missing[0]!r} is, as in packages={{'name': 'folder'}}" if missing else ""
        raise DescriptionError(f"xacro cannot expand {str(file)!r}: {type(error).__name__}: {error}{hint}") from error
    for name in own:
        if name not in given.asked:
            raise UnknownNameError(f"argument of {str(file)!r}", name, given.asked, every=True)
    if not document.getElementsByTagName("link") and b"<xacro:" in source.data:
        raise DescriptionError(f"{str(file)!r} only defines macros, and no link; expand the file that calls them")
    found = Expanded(document.toxml())
    found.name = str(file)
    return found


def _strings(name: str, x: Any) -> dict[str, str]:
    if not isinstance(x, Mapping) or not all(isinstance(key, str) for key in x):
        raise ArgumentError(f"{name} must be a mapping with names as keys, found {x!r}")
    return {key: str(value).lower() if isinstance(value, bool) else str(value) for key, value in x.items()}


@contextmanager
def _found_near(file: Path, folders: Mapping[str, str], missing: list[str]) -> Iterator[None]:
    """Search for packages in these folders and around a file first, then as xacrodoc does; lists those not found.

    What xacrodoc finds it remembers for the process, so the same package elsewhere would be taken for this one.
    """
    packages = imported("xacrodoc.packages", "xacrodoc", *ASKED_BY)
    finder, before = packages.PackageFinder(), packages.get_path
    finder.walk_up_from(file)
    finder.update_package_cache(folders)

    def path_of(package: str) -> str:
        for find in (finder.get_path, before):
            try:
                return find(package)
            except packages.PackageNotFoundError as error:
                fault = error
        missing.append(package)
        raise fault

    packages.get_path = path_of
    try:
        yield
    finally:
        packages.get_path = before
