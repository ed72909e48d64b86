"""What is published: the version is one everywhere, and the wheel and the source archive hold all that they need."""

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from places import ROOT

import torchdq
from torchdq import robots

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TRY = """
import pathlib, sys, warnings
import torch
import torchdq, torchdq.envs, torchdq.learning
assert pathlib.Path(torchdq.__file__).is_relative_to(sys.argv[1]), torchdq.__file__
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    for name in torchdq.robots.names():
        robot = torchdq.robots.load(name)
        q = torch.full((2, robot.n), 0.3, dtype=torch.float64)
        assert torchdq.inverse_dynamics(robot, q, q, q).isfinite().all(), name
print(*[str(one.message) for one in said], sep="\\n")
"""


def test_the_version_is_one_everywhere():
    version = PROJECT["version"]
    assert torchdq.__version__ == version
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\n## {version}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    """Wheel and source archive, built from a copy of the sources by the setuptools that is installed."""
    setuptools = pytest.importorskip("setuptools")
    if int(setuptools.__version__.partition(".")[0]) < 77:
        pytest.skip("setuptools 77 or newer builds the package")
    folder = tmp_path_factory.mktemp("archives")
    hidden = shutil.ignore_patterns(".*", "out", "build", "dist", "*.egg-info", "__pycache__")
    copy = Path(shutil.copytree(ROOT, folder / "copy", ignore=hidden))
    for build in ("build_wheel", "build_sdist"):
        code = f"from setuptools import build_meta; build_meta.{build}({str(folder)!r})"
        done = subprocess.run([sys.executable, "-c", code], cwd=copy, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


def test_the_wheel_works_without_a_compiler_and_says_once_what_one_would_bring(archives, tmp_path):
    place = tmp_path / "site"
    with zipfile.ZipFile(archives[0]) as wheel:
        wheel.extractall(place)
    assert (place / "torchdq" / "py.typed").is_file()
    env = {**os.environ, "PYTHONPATH": str(place), "PATH": str(tmp_path), "TORCHDQ_CACHE": str(tmp_path / "cache")}
    env.pop("CC", None)
    done = subprocess.run(
        [sys.executable, "-c", TRY, str(place)], cwd=tmp_path, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (said,) = done.stdout.splitlines()
    assert "no C compiler" in said and "install gcc or clang" in said
    assert robots.names()


def test_the_source_archive_holds_all_that_is_tracked(archives):
    with tarfile.open(archives[1]) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    folders = ("torchdq", "envs", "tests", "examples", "benchmarks", "docs")
    files = {
        str(path.relative_to(ROOT))
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith(".")
    }
    files |= {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "Makefile", "PAPER.md", "ROBOTS.md", "mkdocs.yml"}
    assert sorted(files - held) == []
