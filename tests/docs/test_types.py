"""The annotations of the package hold."""

import shutil
import subprocess
import sys

import pytest
from places import ENVS, PACKAGE, ROOT


def test_mypy_has_nothing_to_say():
    """On the package as it installs: with `envs` in it, which lies beside it here."""
    pytest.importorskip("mypy")
    cache = ROOT / ".mypy_cache"
    tree = cache / "installed"  # always the same place, for which the cache holds
    shutil.rmtree(tree, ignore_errors=True)
    for folder, place in ((PACKAGE, tree / "torchdq"), (ENVS, tree / "torchdq" / "envs")):
        shutil.copytree(folder, place, ignore=shutil.ignore_patterns("__pycache__"))
    options = ("mypy", "--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", str(cache))
    run = subprocess.run([sys.executable, "-m", *options], cwd=tree, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
