"""Tests that concern some files: `python tests/tools/concerned.py FILE...` prints them, for pytest.

A module is held by the test file of its name, by those that notice faults planted in it, or as allowances.toml says;
where there is none of these, by its room.
"""

import re
import sys
import tomllib
from functools import cache
from pathlib import Path

from places import ENVS, PACKAGE, ROOT, TESTS

sys.path.append(str(TESTS / "mutants"))
import mutants


def mirrored(module: str) -> list[Path]:
    """Test files of the name of a module, as learning.logs.read, in the folder of its room or above it."""
    *rooms, name = module.split(".")
    places = [TESTS.joinpath(*rooms[:k]) for k in range(len(rooms), 0, -1)] or [TESTS / "claims"]
    return [path for place in places if (path := place / f"test_{name}.py").exists()][:1]


@cache
def of_faults() -> dict[str, set[Path]]:
    """Test files that notice faults planted in a file, by file."""
    found: dict[str, set[Path]] = {}
    for fault in mutants.read():
        found.setdefault(fault.file, set()).add(TESTS / fault.test.partition("::")[0])
    return found


def holding(path: Path) -> set[Path]:
    """Test files that hold a file of the package; none: `test_architecture.py` asks for one."""
    inside = path.relative_to(PACKAGE) if path.is_relative_to(PACKAGE) else path.relative_to(ROOT)
    module = ".".join(inside.with_suffix("").parts).removesuffix(".__init__")
    held = tomllib.loads((TESTS / "claims" / "allowances.toml").read_text(encoding="utf-8"))["held"]
    found = {TESTS / file for file, modules in held.items() if module in re.findall(r"[\w.]+", modules)}
    return found | {*mirrored(module)} | of_faults().get(path.relative_to(ROOT).as_posix(), set())


def concerned(path: Path) -> set[Path]:
    """Tests of a file, or of the files below a folder."""
    if path.is_dir() and not path.is_relative_to(TESTS):
        return set().union(*(concerned(one) for one in path.rglob("*.py")))
    if path.is_relative_to(TESTS):
        return {path if path.is_dir() or path.name.startswith("test_") else path.parent}
    if path.is_relative_to(PACKAGE) or path.is_relative_to(ENVS):
        room = TESTS / path.parent.name
        return (holding(path) or {room if room.is_dir() else TESTS / "claims"}) | {
            TESTS / "claims" / "test_architecture.py"
        }
    return {TESTS / "docs"}


def main(files: list[str]) -> None:
    """Print tests by their paths, without files of folders that are among them."""
    missing = [name for name in files if not Path(name).exists()]
    if missing or not files:
        sys.exit(f"FILES must name files or folders of the project, found {' '.join(missing) or 'none'}")
    found = set().union(*(concerned(Path(name).resolve()) for name in files))
    outer = {path for path in found if not any(folder in path.parents for folder in found)}
    print(*sorted(path.relative_to(ROOT).as_posix() for path in outer))


if __name__ == "__main__":
    main(sys.argv[1:])
