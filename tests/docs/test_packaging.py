"""What is published: the version is one everywhere, and the wheel and the source archive hold all that they need."""

import json
import os
import re
import runpy
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
        if robot.floating:
            continue
        q = torch.full((2, robot.n), 0.3, dtype=torch.float64)
        assert torchdq.inverse_dynamics(robot, q, q, q).isfinite().all(), name
print(*[str(one.message) for one in said], sep="\\n")
"""


def test_the_version_is_one_everywhere():
    version = PROJECT["version"]
    assert torchdq.__version__ == version
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\n## {version}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_pages_say_whether_there_is_a_release():
    pages = [(ROOT / name).read_text(encoding="utf-8") for name in ("CHANGELOG.md", "README.md", "docs/index.md")]
    said = ["not released yet" in page for page in pages]
    assert all(said) or not any(said)


def test_the_install_page_names_every_extra():
    page = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    assert not [extra for extra in PROJECT["optional-dependencies"] if f"`{extra}`" not in page]


PAGE, TAG = "https://host.org/group/torchdq", f"v{PROJECT['version']}"
BUILD = "from setuptools import build_meta; build_meta.build_wheel({0!r}); build_meta.build_sdist({0!r})"


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    """Wheel and source archive of a tag, built from a copy of the sources by the setuptools that is installed."""
    setuptools = pytest.importorskip("setuptools")
    if int(setuptools.__version__.partition(".")[0]) < 77:
        pytest.skip("setuptools 77 or newer builds the package")
    folder = tmp_path_factory.mktemp("archives")
    hidden = shutil.ignore_patterns(".git", ".venv", ".*_cache", "out", "build", "dist", "*.egg-info", "__pycache__")
    copy = Path(shutil.copytree(ROOT, folder / "copy", ignore=hidden))
    for order in (
        ["git", "init", "--quiet"],
        ["git", "remote", "add", "origin", f"{PAGE}.git"],
        [sys.executable, "docs/hooks/repository.py", TAG],
        [sys.executable, "-c", BUILD.format(str(folder))],
    ):
        done = subprocess.run(order, cwd=copy, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    return next(folder.glob("*.whl")), next(folder.glob("*.tar.gz"))


def test_the_wheel_holds_the_package_alone(archives):
    with zipfile.ZipFile(archives[0]) as wheel:
        held = {name for name in wheel.namelist() if ".dist-info/" not in name}
    own = {path.relative_to(ROOT).as_posix() for path in (ROOT / "torchdq").rglob("*.py")} | {"torchdq/py.typed"}
    assert held == own | {f"torchdq/envs/{path.name}" for path in (ROOT / "envs").glob("*.py")}


def test_an_index_takes_the_metadata(archives):
    """Fields are valid, no link of the README leads to a file beside it, and addresses are those of the tag."""
    metadata = pytest.importorskip("packaging.metadata")
    with zipfile.ZipFile(archives[0]) as wheel:
        (name,) = (x for x in wheel.namelist() if x.endswith(".dist-info/METADATA"))
        assert any(x.endswith(".dist-info/licenses/LICENSE") for x in wheel.namelist())
        found = metadata.Metadata.from_email(wheel.read(name), validate=True)
    assert (found.name, str(found.version)) == ("torchdq", PROJECT["version"])
    assert (found.license_expression, str(found.requires_python)) == ("BSD-3-Clause", ">=3.11")
    assert found.summary == PROJECT["description"] and found.description_content_type == "text/markdown"
    assert {"Source": PAGE, "Changelog": f"{PAGE}/blob/{TAG}/CHANGELOG.md"}.items() <= found.project_urls.items()
    assert f"({PAGE}/raw/{TAG}/examples/figures/arms.webp)" in found.description
    assert not re.findall(r"\]\((?!https://|#)[^)]*\)", found.description)
    assert found.description.count("](") == (ROOT / "README.md").read_text(encoding="utf-8").count("](")


@pytest.mark.parametrize(
    ("origin", "page"),
    [
        *((f"{PAGE}{end}", PAGE) for end in ("", "/", ".git")),
        ("ssh://git@host.org/group/torchdq.git", PAGE),
        ("https://name:secret@host.org/group/torchdq.git", PAGE),
        ("git@host.org:group/torchdq.git", PAGE),
        ("/srv/git/torchdq", None),
        ("../torchdq", None),
        ("file:///srv/torchdq", None),
        ("", None),
    ],
)
def test_the_address_of_the_repository_is_that_of_its_origin(origin, page):
    """Passwords do not appear in it."""
    space = runpy.run_path(str(ROOT / "docs/hooks/repository.py"))
    assert space["address"](origin) == page


def test_the_release_runs_what_is_there():
    """Targets of make, files of the repository, and the token of the index for the last job alone."""
    yaml = pytest.importorskip("yaml")
    jobs = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8"))["jobs"]
    runs = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = [target for run in runs for target in re.findall(r"\bmake (\w+)", run)]
    assert targets == ["dist"] and "\ndist:" in makefile
    assert all((ROOT / file).exists() for run in runs for file in re.findall(r"[\w/]+\.(?:py|toml)\b", run))
    assert [name for name, job in jobs.items() if job.get("permissions") == {"id-token": "write"}] == ["publish"]
    assert (jobs["try"]["needs"], jobs["publish"]["needs"]) == ("build", "try")


OPTIONAL = """
import contextlib, importlib.abc, io, json, sys
class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
names, orders, ended = set(sys.argv[1].split(",")), sys.argv[2:], []
sys.meta_path.insert(0, Hidden())
import torchdq, torchdq.learning, torchdq.envs
from torchdq.command.main import main
for order in orders:
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main(order.split())
    ended.append([bool(code), said.getvalue()])
print(json.dumps(ended))
"""
MODULES = {"pin": "pinocchio"}  # names that are not those of their packages


ORDERS = {  # and what they say to install
    "doctor": None,
    "report two_link": None,
    "id two_link log.csv": "pip install 'torchdq[learn,viz]'",
    "view two_link": "pip install 'torchdq[viz]'",
    "report panda_description": "pip install 'torchdq[names]'",
}


def test_optional_packages_are_never_in_the_way(tmp_path):
    """Commands without them work, or name the line that installs what they need."""
    groups = {k: v for k, v in PROJECT["optional-dependencies"].items() if k not in ("docs", "test", "gpu-test")}
    names = {re.match(r"[\w-]+", x)[0] for group in groups.values() for x in group} - {"torchdq"}
    hidden = {MODULES.get(name, name.replace("-", "_")) for name in names}
    assert {"scipy", "matplotlib", "mujoco", "pinocchio", "casadi"} <= hidden
    done = subprocess.run(
        [sys.executable, "-c", OPTIONAL, ",".join(hidden), *ORDERS], cwd=tmp_path, capture_output=True, text=True
    )
    assert not done.returncode, done.stderr
    for (order, cure), (failed, said) in zip(ORDERS.items(), json.loads(done.stdout), strict=True):
        assert failed == bool(cure), f"{order}: {said}"
        assert not cure or cure in " ".join(said.split()), said
        assert "Traceback" not in said, said


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
    folders = ("torchdq", "envs", "tests", "examples", "benchmarks", "docs", ".github")
    files = {
        str(path.relative_to(ROOT))
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith(".")
    }
    files |= {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "Makefile", "mkdocs.yml"}
    assert sorted(files - held) == []
