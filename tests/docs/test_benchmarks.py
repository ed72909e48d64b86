"""Every benchmark starts, and writes its table into one page."""

import json
import os
import re
import subprocess
import sys
from collections import Counter

import batches
import diagrams
import front_page
import numpy as np
import oracles
import pytest
import report
import terminals
import torch
from accuracy import findings, peers
from compared import READ_BY_MUJOCO, TOLERANCE
from helpers import thinned
from pages.pictures import curves_of
from places import ROOT

FOLDER = ROOT / "benchmarks"
SCRIPTS = [file for file in sorted(FOLDER.glob("*.py")) if "__main__" in file.read_text()]
# all in one process, since importing torch takes longer than all of them
HELP = """
import contextlib, io, json, runpy, sys, traceback
said = {}
for script in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        sys.argv, code = [script, "--help"], "no end"
        try:
            runpy.run_path(script, run_name="__main__")
        except SystemExit as end:
            code = end.code
        except Exception:
            code = traceback.format_exc()
    said[script] = [code, out.getvalue()]
print(json.dumps(said))
"""


def test_benchmarks_print_their_help():
    found = subprocess.run(
        [sys.executable, "-c", HELP, *map(str, SCRIPTS)],
        capture_output=True,
        text=True,
        cwd=FOLDER.parent,
        env=os.environ | {"PYTHONPATH": str(FOLDER)},
    )
    assert found.returncode == 0, found.stderr
    for script, (code, out) in json.loads(found.stdout).items():
        assert not code, f"{script}: {code}"
        assert "usage" in out, script


def test_there_are_benchmarks():
    assert {"peers", "envs", "formulations", "accuracy_vs_time"} <= {file.stem for file in SCRIPTS}


def test_every_table_of_a_page_has_a_script_that_writes_it():
    texts = [path.read_text("utf-8") for path in (report.ROOT / "README.md", *(report.ROOT / "docs").rglob("*.md"))]
    marked = Counter(name for text in texts for name in re.findall(r"<!-- benchmarks/(\S+) begins -->", text))
    assert {"peers.py", "envs.py", "compiled.py", "formulations.py", "accuracy_vs_time.py", "gpu.py"} <= marked.keys()
    for name, count in marked.items():
        by_marks = re.search(r"report\.(finish|into_page|between_marks)", (FOLDER / name).read_text())
        expected = 2 if name == "front_page.py" else 1
        assert count == expected or not by_marks, f"{count} pages for {name}"  # other scripts write whole pages


def test_a_table_is_written_between_its_marks_and_nowhere_else(tmp_path, monkeypatch):
    begin, end = report.marks("peers.py")
    page = tmp_path / "docs" / "deep" / "page.md"
    page.parent.mkdir(parents=True)
    page.write_text(f"before\n{begin}\nold\n{end}\nafter\n")
    (tmp_path / "README.md").write_text("nothing\n")
    monkeypatch.setattr(report, "ROOT", tmp_path)
    report.into_page("| new |", "benchmarks/peers.py", {"processor": "one", "cores": "2"})
    assert (
        page.read_text()
        == f"before\n{begin}\n| new |\n\nMeasured by `benchmarks/peers.py` on: processor one, cores 2.\n{end}\nafter\n"
    )
    assert report.shown("peers.py").startswith("| new |")
    assert (tmp_path / "README.md").read_text() == "nothing\n"


def test_numbers_of_checks_are_those_of_the_suite():
    """What README and pages say was compared is what the tests compare."""
    robots, mujoco, trees = len(oracles.example_robots()), len(READ_BY_MUJOCO), oracles.TREES
    readme, page = (" ".join((report.ROOT / x).read_text("utf-8").split()) for x in ("README.md", "docs/robots.md"))
    tolerance = f"{TOLERANCE[torch.float64]:.0e}"
    assert f"agree with Pinocchio to {tolerance} on {robots} robots and {trees} random trees" in readme
    assert f"agree with Pinocchio to {tolerance}" in page
    assert f"on {robots} robots of `example-robot-data` and on {trees} random trees" in page
    assert f"MuJoCo's own URDF reader agrees on {mujoco} of those files" in page


def test_numbers_of_the_page_on_accuracy_are_those_of_the_results():
    results = json.loads((FOLDER / "results" / "accuracy.json").read_text("utf-8"))
    shown, source = report.shown("accuracy_vs_time.py"), report.source("accuracy_vs_time.py", results["machine"])
    assert shown == f"{findings.page(results)}\n\n{source}", "benchmarks/accuracy_vs_time.py --again --page"


def test_the_numbers_of_the_first_pages_are_those_of_the_page_on_prices():
    assert report.pages("front_page.py") == [front_page.README, front_page.INDEX]
    for (page, name), text in front_page.BLOCKS.items():
        assert report.shown(name, page) == text(), "benchmarks/front_page.py --page writes them again"


PICTURES = {
    "batches": (batches.PICTURE, lambda found: batches.picture(found["times"]["inverse_dynamics"])),
    "accuracy": (peers.PICTURE, lambda found: peers.picture(found["peers"])),
}


@pytest.mark.parametrize("results", PICTURES)
def test_pictures_of_speed_are_those_of_the_results(results):
    file, picture = PICTURES[results]
    drawn = picture(json.loads((FOLDER / "results" / f"{results}.json").read_text("utf-8")))
    pairs = zip(curves_of(file.read_text("utf-8")), curves_of(drawn), strict=True)
    assert all(np.allclose(a, b, rtol=1e-3, atol=0) for a, b in pairs), "the script with --again draws it again"


@pytest.mark.parametrize("name", diagrams.DIAGRAMS)
def test_a_diagram_is_that_of_its_script(name):
    """Up to how processors round places."""
    texts = [(diagrams.FOLDER / f"{name}.svg").read_text("utf-8"), diagrams.DIAGRAMS[name]().svg()]
    kept, drawn = (re.split(r"(-?\d+\.\d+)", text) for text in texts)
    assert kept[::2] == drawn[::2], "benchmarks/diagrams.py --write"
    assert np.allclose(*(np.array(x[1::2], float) for x in (kept, drawn)), rtol=0, atol=0.2)
    assert "prefers-color-scheme: dark" in texts[0]


@pytest.mark.parametrize("name", thinned(terminals.COMMANDS, ("report",)))
def test_a_terminal_shows_what_the_command_prints(name):
    """Compared are words and lines, since digits of an identification differ between processors."""
    kept = (terminals.FOLDER / f"terminal_{name}.svg").read_text("utf-8")
    drawn = terminals.picture(name, terminals.printed(name))
    kept, drawn = ([re.sub(r"\d", "0", x) for x in re.findall(r">([^<\n]+)<", text)] for text in (kept, drawn))
    assert len(kept) > 20 and kept == drawn, "benchmarks/terminals.py --write"


@pytest.mark.parametrize("script", ["peers.py", "envs.py"])
def test_a_ratio_is_that_of_its_times(script):
    rows = re.findall(r"^\|[^|]+\| ([\d.]+) ns \| ([\d.]+) ns, [^|]+\| ([\d.]+) x \|", report.shown(script), re.M)
    assert len(rows) >= 4
    for ours, theirs, ratio in ([float(x) for x in row] for row in rows):
        assert abs(theirs / ours - ratio) < 0.01 * ratio + 0.05, (ours, theirs, ratio)


def test_the_first_page_repeats_what_the_guide_says_of_a_policy():
    first, guide = (
        " ".join((report.ROOT / x).read_text("utf-8").split()) for x in ("docs/index.md", "docs/guides/policy.md")
    )
    millimetres, seconds = re.search(r"to ([\d.]+) mm in the median after (\d+) s on one core", first).groups()
    assert f"a median distance of {millimetres} mm after {seconds} s on one core" in guide


FACTS = {  # of the README, by the page that has them
    "docs/guides/legs.md": r"for (90 s) on one core, stay upright in MuJoCo in (120 of 120 runs of 10 s)",
    "docs/environments/walk.md": r"makes ([\d.]+ thousand) steps per second",
    "docs/learning.md": r"from ([\d.]+) to ([\d.]+) standard deviations",
    "docs/prices.md": r"exported as C takes (\d+ us) per tick",
    "docs/guides/hands.md": r"succeeds from (\d+ %) to (\d+ %) of 64 starts",
}


@pytest.mark.parametrize("page", FACTS)
def test_the_readme_repeats_what_pages_measured(page):
    readme, text = (" ".join((report.ROOT / x).read_text("utf-8").split()) for x in ("README.md", page))
    assert all(number in text for number in re.search(FACTS[page], readme).groups())
