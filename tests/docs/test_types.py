"""The annotations of the package hold."""

import shutil
import subprocess
import sys

import pytest
from places import ENVS, PACKAGE, ROOT


def mypy(name: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run of mypy on the package as it installs: with `envs` in it, which lies beside it here."""
    pytest.importorskip("mypy")
    cache = ROOT / ".mypy_cache" / name
    tree = cache / "installed"  # always the same place, for which the cache holds
    shutil.rmtree(tree, ignore_errors=True)
    for folder, place in ((PACKAGE, tree / "torchdq"), (ENVS, tree / "torchdq" / "envs")):
        shutil.copytree(folder, place, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(cache), *options]
    return subprocess.run(command, cwd=tree, capture_output=True, text=True)


def test_mypy_has_nothing_to_say():
    run = mypy("all", "--config-file", str(ROOT / "pyproject.toml"))
    assert run.returncode == 0, run.stdout + run.stderr


def test_nothing_of_the_standard_library_that_windows_lacks_is_used():
    """Types of other packages are not read here, which takes most of the time."""
    run = mypy("windows", "--platform", "win32", "--follow-imports", "skip", "--config-file", "", "torchdq")
    assert run.stdout.splitlines()[-1].startswith(("Found ", "Success: ")), run.stdout + run.stderr
    assert [line for line in run.stdout.splitlines() if "Module has no attribute" in line] == []
