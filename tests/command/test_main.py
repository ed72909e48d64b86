"""Command line: every command does its work, as text and as JSON, and a user's mistake is one message.

They run in this process, by `main`, which returns the exit code.
"""

import importlib.metadata
import json
import os
import re
import runpy
import shlex
import sys
import warnings
from contextlib import closing
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import oracles
import pytest
import torch
from helpers import EVERYTHING, exhaustive, interrupted, thinned
from places import ROOT
from recorded_logs import STEP, states, written

import torchdq
from torchdq.backends import compiler
from torchdq.base import machine, progress
from torchdq.command import doctor
from torchdq.command.main import ABOUT, COMMANDS, INTERRUPTED, MISTAKE, USAGE, WELL, _parsed, main
from torchdq.command.outcome import Grid, Outcome, plain, write
from torchdq.command.scene import KINDS, STEPPERS
from torchdq.learning import read_log

WIDE = 80  # columns of a terminal
SHORT = ("--price", "0", "--seconds", "0.1")  # a simulation
MASSLESS = ("--base", "floating", "--on-unphysical", "warn")  # the base of the arm

ARM = """<robot name="arm"><link name="base"/>
<link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
  <inertia ixx="0.02" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><origin xyz="0.15 0 0"/><mass value="1"/>
  <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="50" velocity="5"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.4 0 0"/>
  <axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="30" velocity="5"/></joint>
</robot>"""
ROBOT = torchdq.Robot.from_urdf(ARM)
HEAVIER = ROBOT.replace(mass=1.3 * ROBOT.mass, inertia=1.3 * ROBOT.inertia)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Folder with a robot in it, in which commands run."""
    tmp_path.joinpath("arm.urdf").write_text(ARM)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", str(WIDE))
    return tmp_path


def told(capsys, *arguments, code=WELL):
    """Output and messages of a run, whose exit code must be this one."""
    found = main([str(x) for x in arguments])
    out, errors = capsys.readouterr()
    assert found == code, out + errors
    return out, errors


def data(capsys, *arguments, code=WELL):
    """The one JSON object that a run writes."""
    return json.loads(told(capsys, *arguments, "--json", code=code)[0], parse_constant=pytest.fail)


def log(path, names=("q", "qd", "tau"), count=1, held=None, rows=750, seed=0, real=HEAVIER):
    """Log of the arm, 30 % heavier than described, or of another, with friction, and perhaps something in its hand."""
    q, qd, qdd = (x[0] for x in states(1, rows, seed))
    noise = 0.05 * torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)
    tau = torchdq.inverse_dynamics(real, q, qd, qdd) + torch.tensor([0.8, 0.4]) * qd + noise
    if held is not None:
        tau += torchdq.inverse_dynamics(held, q, qd, qdd) - torchdq.inverse_dynamics(ROBOT, q, qd, qdd)
    heads = ["time", *(f"{name}{j + count}" for name in names for j in range(2))]
    written(Path(path), np.column_stack([STEP * np.arange(rows), q, qd, tau]), heads)


# --- all commands ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ""),
        (("teach",), ", ".join(COMMANDS)),
        (("bnech", "panda"), "there is no command 'bnech'; did you mean 'bench'?"),
        (("report",), "Missing from torchdq report: ROBOT; see torchdq report --help"),
        (("report", "panda", "--no-such-option"), "Unrecognized options: --no-such-option; see torchdq report --help"),
        (("doctor", "FILE"), "Unrecognized options: FILE; see torchdq doctor --help"),
        (("scene", "panda", "--dt", "x"), "could not convert string to float: 'x'; see torchdq scene --help"),
    ],
)
def test_what_is_not_understood_is_told_and_is_exit_code_2(here, capsys, arguments, words):
    out, errors = told(capsys, *arguments, code=USAGE)
    assert not out and errors.startswith("torchdq: error: ") and words in " ".join(errors.split())
    assert all(line == line.rstrip() for line in errors.splitlines())


def test_numbers_of_an_option_stand_apart_or_with_commas():
    assert _parsed(["bench", "panda", "--batches", "4,5"]).batches == (4, 5)
    assert _parsed(["bench", "panda", "--batches=4,5", "--threads", "1"]).batches == (4, 5)
    assert _parsed(["scene", "panda", "--q", "-0.3,1e-1", "2", "--hold", "20,5"]).q == (-0.3, 0.1, 2)
    # names stay together, also those that are numbers
    known = _parsed(["id", "panda", "1,2", "--rows", "0,9", "--columns", "q", "1,2", "--out", "3,4"])
    assert (known.logs, known.rows, known.columns, str(known.out)) == (("1,2",), (0, 9), {"q": "1,2"}, "3,4")


@pytest.mark.parametrize("option", ["--help", "-h"])
def test_the_help_names_the_commands_on_one_page(here, capsys, option):
    out, _ = told(capsys, option)
    assert all(re.search(rf"^{name} ", out, re.MULTILINE) for name in COMMANDS)
    assert len(out.splitlines()) < 40 and max(map(len, out.splitlines())) <= WIDE
    assert "print-completion" in out and ABOUT


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_a_command_has_an_example_that_is_understood(here, capsys, command):
    out, _ = told(capsys, command, "--help")
    example = re.search(r"^Example: torchdq (.*)$", out, re.MULTILINE)
    assert example and example[1].split()[0] == command and "--json" in out
    assert max(map(len, out.splitlines())) <= WIDE and not re.search(r"\(default:\s+(None|False)?\s*\)", out)
    asked = set(re.findall(r"--[a-z-]+", example[1]))
    assert asked <= set(re.findall(r"--[a-z-]+", out.replace(example[0], "")))


def test_the_version_is_given(capsys):
    assert told(capsys, "--version") == (f"torchdq {torchdq.__version__}\n", "")


def test_the_program_is_installed_by_its_name():
    scripts = importlib.metadata.entry_points(group="console_scripts", name="torchdq")
    if not scripts:
        pytest.skip("installed before there was a command line")
    assert [script.load() for script in scripts] == [main]


MISTAKES = [
    (("report", "nowhere.urdf"), "there is no file 'nowhere.urdf'"),
    (("report", "pandda"), "did you mean 'panda'"),
    (("report", "folder"), "Is a directory"),
    (("report", "garbage.urdf"), "garbage.urdf is not UTF-8 text"),
    (("report", "broken.urdf"), "broken.urdf: the file is not well-formed XML"),
    (("report", "panda", "--base", "floating"), "base must be 'fixed'"),
    (("report", "arm.urdf", "--joints", "knee"), "'knee'"),
    (("bench", "arm.urdf", "--batches", "0"), "batches must be"),
    (("bench", "arm.urdf", "--threads", "0"), "threads must be"),
    (("scene", "arm.urdf", "--effects", "gravty"), "did you mean 'gravity'"),
    (("scene", "arm.urdf", "--effects", "viscous=much"), "as in viscous=0.5"),
    (("scene", "arm.urdf", "--effects", "payload"), "payload=MASS"),
    (("scene", "arm.urdf", "--q", "1"), "q must be 2 numbers"),
    (("scene", "arm.urdf", "--dt", "0"), "dt must be"),
    (("scene", "arm.urdf", "--integrator", "Euler"), "ExplicitEuler"),
    (("scene", "arm.urdf", "--price", "0", "--seconds", "0.1", "--csv", "nowhere/a.csv"), "'nowhere/a.csv' cannot be"),
    (("accuracy", "arm.urdf", "--error", "0"), "error must be"),
    (("export", "arm.urdf", "inverse_dynamic"), "did you mean 'inverse_dynamics'"),
    (("export", "arm.urdf", "jacobian"), "the frames are base"),
    (("export", "arm.urdf", "computed_torque", "--options", "tip"), "options of 'computed_torque' must be left out"),
    (("export", "arm.urdf", "inverse_dynamics", "--out", "arm.urdf"), "'arm.urdf'"),
    (("id", "arm.urdf"), "LOG must be a file at least"),
    (("id", "arm.urdf", "nowhere.csv"), "there is no file 'nowhere.csv'"),
    (("id", "arm.urdf", "folder"), "Is a directory"),
    (("id", "panda", "log.csv"), "found 2; --joints keeps some joints of the robot"),
    (("id", "arm.urdf", "log.csv", "--columns", "q", "position_{0}"), "there is no column 'position_0'"),
    (("id", "arm.urdf", "log.csv", "--columns", "angle", "q"), "no signal named 'angle'"),
    (("id", "arm.urdf", "log.csv", "--gains", "1"), "gain must have 2 numbers"),
    (("id", "arm.urdf", "log.csv", "--out", "arm.urdf"), "'arm.urdf' cannot be used"),
    (("id", "arm.urdf", "log.csv", "--columns", "q", "a,b,c", "qd", "none"), "there is no column 'a'"),
    (("id", "arm.urdf", "log.csv", "--columns", "tau", "tau_{joint}"), "there is no column 'tau_shoulder'"),
    (("id", "arm.urdf", "log.csv", "--cutoff", "60"), "half the rate, found 60.0; give another --cutoff"),
    (("id", "arm.urdf", "log.csv", "--delay", "9"), "which lasts 3.98 s, found 9.0; give a shorter --delay"),
    (("id", "arm.urdf", "log.csv", "--gains", "1", "0"), "none of them zero"),
    (("id", "arm.urdf", "log.csv+./log.csv"), "there are several columns"),
    (("id", "arm.urdf", "bare.csv"), "--columns time 1 q {2} qd {4} tau {6}"),
    (("id", "arm.urdf", "log.csv", "--transmission", "0.01"), "transmission must have 2 numbers"),
    (("id", "arm.urdf", "log.csv", "--scale", "q", "half"), "scale must be numbers such as 0.001"),
    (("id", "arm.urdf", "log.csv", "--zero", "1"), "zero must have 2 numbers"),
    (("id", "log.csv", "arm.urdf"), "torchdq id arm.urdf a.csv b.csv"),
    (("id", "arm.urdf", "arm.urdf"), "torchdq id arm.urdf a.csv b.csv"),
    (("id", "arm.urdf", "log.csv", "--test", "./log.csv"), "test must be other logs than those to learn from"),
    (("export", "arm.urdf", "inverse_dynamics", "--language", "torch", "--name", "a/b"), "a name that C accepts"),
    (("view", "arm.urdf", "--q", "1"), "q must be 2 numbers"),
    *(((name, "still.urdf"), "must have a joint that moves") for name in ("scene", "accuracy", "view")),
    (("id", "still.urdf", "log.csv"), "must have a joint that moves"),
]


def test_a_mistake_of_a_user_is_one_message(here, capsys):
    here.joinpath("folder").mkdir()
    here.joinpath("broken.urdf").write_text("<robot name='r'>")
    here.joinpath("still.urdf").write_text("<robot name='still'><link name='base'/></robot>")
    here.joinpath("garbage.urdf").write_bytes(bytes(range(255, 0, -1)) * 9)
    log("log.csv", rows=200)
    here.joinpath("bare.csv").write_text(here.joinpath("log.csv").read_text().partition("\n")[2])
    for arguments, found in MISTAKES:
        out, errors = told(capsys, *arguments, code=MISTAKE)
        assert not out, arguments
        errors = "".join(line for line in errors.splitlines(True) if not line.endswith(" s ...\n"))  # without progress
        assert errors.startswith("torchdq: error: ") and "Traceback" not in errors, arguments
        assert found in " ".join(errors.split()), arguments
        assert max(map(len, errors.splitlines())) <= WIDE, arguments
    found = data(capsys, "report", "nowhere.urdf", code=MISTAKE)
    assert found == {"error": found["error"], "kind": "MissingFileError"} and "nowhere.urdf" in found["error"]


def test_a_folder_that_cannot_be_written_is_told_before_the_work(here, capsys, monkeypatch):
    log("log.csv", rows=200)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    _, errors = told(capsys, "id", "arm.urdf", "log.csv", "--out", "locked", code=MISTAKE)
    assert "out must be a folder that you can write" in errors


def test_packages_that_are_missing_are_told_before_the_work(here, capsys, monkeypatch):
    both = "needs scipy and matplotlib, which are not installed; pip install 'torchdq[learn,viz]'"
    for package, command, words in (
        ("matplotlib", ("id", "arm.urdf", "log.csv"), "pip install 'torchdq[viz]'"),
        ("scipy", ("id", "arm.urdf", "log.csv"), both),
        ("viser", ("view", "arm.urdf"), "pip install 'torchdq[viz]'"),
    ):
        monkeypatch.setitem(sys.modules, package, None)
        assert words in " ".join(told(capsys, *command, code=MISTAKE)[1].split())


def test_ctrl_c_ends_a_command_with_its_exit_code(here, capsys, monkeypatch):
    monkeypatch.setattr(progress, "FIRST", 0.1)
    with interrupted(0.4):
        out, errors = told(capsys, "scene", "arm.urdf", "--seconds", "1e5", "--price", "0", code=INTERRUPTED)
    assert re.match(r"torchdq: .* 0 s \.\.\.", errors) and not out and "Traceback" not in errors
    assert errors.strip().endswith("torchdq: interrupted")


def test_a_reader_that_leaves_early_is_no_fault(here, monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as out, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", out)
        patch.setattr(sys, "argv", ["torchdq", "report", "arm.urdf"])
        with pytest.raises(SystemExit) as end:
            runpy.run_module("torchdq", run_name="__main__")  # as `python -m torchdq`
        assert end.value.code == WELL
        out.write("more, as the process ends")


def test_what_libraries_print_is_not_in_the_output(here, capsys, monkeypatch):
    usual = COMMANDS["report"].outcome
    monkeypatch.setattr(COMMANDS["report"], "outcome", lambda command: (sys.stdout.write("hello\n"), usual(command))[1])
    assert data(capsys, "report", "arm.urdf")["robot"] == "arm"


def test_warnings_are_told_once_and_are_in_the_json_object(here, capsys, monkeypatch):
    def warned(command):
        warnings.warn("far from here", stacklevel=1)
        warnings.warn("far from here", stacklevel=1)
        return Outcome(("well",), {"well": True})

    monkeypatch.setattr(COMMANDS["cost"], "outcome", warned)
    out, errors = told(capsys, "cost")
    assert out == "well\n" and errors == "torchdq: warning: far from here\n"
    assert data(capsys, "cost") == {"well": True, "warnings": ["far from here"]}


def test_tables_fit_the_terminal(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    write(Outcome((Grid(("a", "b"), [("x " * 40, "y" * 50)]), "z " * 60), {}), as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 40 and "".join(lines).count("x") == 40 and "".join(lines).count("y") == 50


# --- report ----------------------------------------------------------------------------------------------------------


def test_a_report_as_json_has_numbers(here, capsys):
    found = data(capsys, "report", "arm.urdf")
    assert found["coordinates"] == ["shoulder", "elbow"] and [link["mass"] for link in found["links"]] == [2.0, 1.0]
    count = torchdq.compile(ROBOT, "inverse_dynamics").count()
    assert found["operations"]["inverse_dynamics"] == count._asdict()
    assert found["error_growth"]["worst"] >= found["error_growth"]["median"] >= 1


def test_some_joints_and_a_free_base(here, capsys):
    assert data(capsys, "report", "arm.urdf", "--joints", "elbow")["coordinates"] == ["elbow"]
    found = data(capsys, "report", "panda", "--joints", "panda_joint[12]")
    assert found["coordinates"] == ["panda_joint1", "panda_joint2"]
    assert data(capsys, "report", "arm.urdf", "--base", "floating")["base"] == "floating"


def test_a_file_is_read_by_what_is_in_it(here, capsys):
    pytest.importorskip("mujoco")
    body = "<body name='b'><joint/><geom size='.1'/></body>"
    here.joinpath("m.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    here.joinpath("u.xml").write_text(ARM)
    comment = f"<!-- {'<mujoco>' * 10_000} -->"
    here.joinpath("h.urdf").write_text(f"{comment}{ARM.replace('</robot>', '<mujoco><compiler/></mujoco></robot>')}")
    assert len(data(capsys, "report", "m.xml")["coordinates"]) == 1
    assert len(data(capsys, "report", "u.xml")["coordinates"]) == 2
    one, other = (data(capsys, "report", name, "--base", "floating") for name in ("h.urdf", "u.xml"))
    assert one == other


MARKS = ["&#x9b;31m", "&#x85;", "&#x202e;", "&#10;j9  revolute  l9  99 kg", "&#13;", "&#9;"]


@pytest.mark.parametrize("mark", thinned(MARKS, MARKS[3:4]))
def test_names_that_a_terminal_would_obey_are_escaped(here, capsys, mark):
    text = ARM.replace("elbow", f"elbow{mark}").replace('lower="-2.5"', 'lower="5"').replace("lower", f"l{mark}")
    here.joinpath("marked.urdf").write_text(text.replace(f'l{mark}="', 'lower="'), encoding="utf-8")
    name = torchdq.Robot.from_urdf(here / "marked.urdf", on_unphysical="ignore").joint_names[1]
    assert name.startswith("elbow") and not name.isprintable()
    for arguments, code in (
        (("report",), WELL),
        (("scene", *SHORT), WELL),
        (("report", "--tip", "x"), MISTAKE),
    ):
        out, errors = told(capsys, arguments[0], "marked.urdf", *arguments[1:], code=code)
        assert (out + errors).replace("\n", "").isprintable() and "\nj9" not in out + errors
    assert data(capsys, "report", "marked.urdf")["coordinates"][1] == name
    assert (written := told(capsys, "report", "marked.urdf", "--json")[0]).replace("\n", "").isprintable() and written


def test_a_body_that_cannot_exist_is_reported_and_is_not_simulated_unless_asked(here, capsys):
    here.joinpath("light.urdf").write_text(ARM.replace('<mass value="2"/>', '<mass value="-2"/>'))
    for arguments in (("report", "light.urdf"), ("scene", "light.urdf", *SHORT, "--on-unphysical", "warn")):
        assert "link 'upper': mass must not be negative" in " ".join(told(capsys, *arguments)[1].split())
    _, errors = told(capsys, "scene", "light.urdf", code=MISTAKE)
    assert "link 'upper': mass must not be negative" in " ".join(errors.split())


FILES = [path for name, path in oracles.urdf_paths().items() if name not in oracles.UNREADABLE]
BASES = ("fixed", "floating")
QUICK = [("hextilt_flying_arm_5.urdf", base) for base in BASES]
# what no line of a report may be: a number that is none, an object, or a name of Python's
UNEXPLAINED = re.compile(r"\bnan\b|tensor\(|<[a-z_.]+ object|\bnull\b|Traceback|\btensor\b")


@pytest.mark.parametrize(
    ("path", "base"),
    [x for x in product(FILES, BASES) if EVERYTHING or (x[0].name, x[1]) in QUICK],
    ids=lambda x: getattr(x, "name", x),
)
def test_a_report_of_every_robot_has_no_unexplained_line(here, capsys, path, base):
    out, errors = told(capsys, "report", path, "--base", base)
    assert not UNEXPLAINED.search(out + errors)
    assert max(map(len, out.splitlines())) <= WIDE
    title, rest = out.split("\nnotes:\n")
    notes, rest = rest.split("\noperations per sample:\n")
    assert title.startswith("Robot('") and "used: " in title
    for note in re.split(r"^- ", notes, flags=re.MULTILINE)[1:]:
        assert re.match(r"[\w'\"]", note) and len(note.split()) >= 3, note
    # a joint without inertia has no accelerations, and is named
    if "undefined" in rest:
        assert re.search(r"joint '[^']+': it moves\s+no\s+inertia", rest)
    elif "there is no joint to accelerate" not in rest:
        assert float(re.search(r"largest growth (\S+);", " ".join(rest.split()))[1]) >= 1


def test_there_are_robots_to_report():
    assert len(FILES) > 60 and {path.name for path in FILES} >= {name for name, _ in QUICK}


# --- bench -----------------------------------------------------------------------------------------------------------


def test_bench_measures_every_function_at_every_batch(here, capsys):
    threads = torch.get_num_threads()
    found = data(capsys, "bench", "arm.urdf", "--batches", "1", "64", "--seconds", "0", "--threads", "1")
    names = ("inverse_dynamics", "forward_dynamics", "mass_matrix", "regressor", "gradient of inverse_dynamics")
    assert {(one["function"], one["batch"]) for one in found["speeds"]} == set(product(names, (1, 64)))
    assert all(one["nanoseconds"] > 0 for one in found["speeds"])
    assert found["threads"] == 1 and torch.get_num_threads() == threads
    assert machine.processor() in found["machine"]


@exhaustive
def test_bench_of_a_free_base(here, capsys):
    out, _ = told(capsys, "bench", "arm.urdf", *MASSLESS, "--batches", "64", "--seconds", "0")
    assert "forward_dynamics" in out and "64 samples" in out and max(map(len, out.splitlines())) <= WIDE


# --- id --------------------------------------------------------------------------------------------------------------


fits = pytest.mark.skipif(not (find_spec("scipy") and find_spec("matplotlib")), reason="no scipy, or no matplotlib")
FEW = ("--friction", "simple", "--prior", "1")  # parameters


def elements(page):
    """Names of the elements of a page whose tags are all closed, and what it would load."""
    text = re.sub(r"<(meta|br|img)\b([^>]*)>", r"<\1\2/>", page.removeprefix("<!doctype html>"))
    every = list(ElementTree.fromstring(text).iter())
    attributes = ((name.rpartition("}")[2], x) for element in every for name, x in element.items())
    loads = [x for name, x in attributes if name in ("src", "href") and not x.startswith(("#", "data:"))]
    return {element.tag.rpartition("}")[2] for element in every}, loads


@fits
def test_a_robot_is_identified_from_logs_with_a_page_and_a_urdf(here, capsys):
    for k, name in enumerate(("a.csv", "b.csv")):
        log(name, names=("pos_", "vel_", "eff_"), count=0, seed=k)
    named = ("--columns", "q", "pos_{0}", "qd", "vel_{0}", "tau", "eff_{0}")
    found = data(capsys, "id", "arm.urdf", "a.csv", "b.csv", *named, *FEW, "--out", "made")
    assert found["verdict"] == "Good" and " by the file is " in found["summary"] and not found["findings"]
    errors = found["evaluation"]
    assert max(errors["found"]) < 0.05 < min(errors["described"])
    assert errors["file"] == pytest.approx(errors["found"], abs=1e-3)
    viscous = {p["name"]: p for p in found["parameters"] if p["name"].endswith("viscous")}
    for joint, true in (("shoulder", 0.8), ("elbow", 0.4)):
        one = viscous[f"{joint} viscous"]
        assert abs(one["estimate"] - true) < 5 * one["error"] < 0.2 * true
    page = Path(found["files"]["page"]).read_text()
    found_elements, loads = elements(page)
    assert {"img", "table", "style"} <= found_elements and "script" not in found_elements and not loads
    assert not re.search(r"@import|url\((?!#)", page)
    assert "shoulder viscous" in page and found["summary"] in page and "a.csv, b.csv" in page
    assert "Good means that" in page and "by the file" in page
    assert not list(Path("made").glob(".*"))  # nothing temporary is left
    written = torchdq.Robot.from_urdf(found["files"]["urdf"])
    q = torch.rand(5, 2, dtype=torch.float64)
    zero = torch.zeros_like(q)
    real = torchdq.inverse_dynamics(HEAVIER, q, zero, zero)
    assert torch.allclose(torchdq.inverse_dynamics(written, q, zero, zero), real, rtol=0.02, atol=0.02)


@fits
def test_the_last_third_of_a_single_log_is_the_test_and_a_payload_is_found(here, capsys):
    log("empty.csv")
    log("held.csv.gz", held=ROBOT.with_payload(0.4, (0.1, 0.0, 0.0), frame="lower"), seed=1)
    held = ("--payload", "held.csv.gz", "--frame", "lower")
    out, errors = told(capsys, "id", "arm.urdf", "empty.csv", *FEW, *held)
    assert "payload at lower" in out and "wrote" in out and re.search(r"Good: in [45]\.\d s", out)
    mass = float(re.search(r"^mass +(\S+)", out, re.MULTILINE)[1])
    assert abs(mass - 0.4) < 0.05, out + errors
    assert here.joinpath("arm_identified.urdf").is_file()


@fits
def test_a_robot_without_a_urdf_gets_one(here, capsys):
    robot = torchdq.robots.load("two_link")
    log("log.csv", real=robot.replace(mass=1.2 * robot.mass))
    found = data(capsys, "id", "two_link", "log.csv", *FEW)
    written = torchdq.Robot.from_urdf(found["files"]["urdf"], gravity=robot.gravity)
    q = torch.rand(5, 2, dtype=torch.float64)
    tau, real = (torchdq.inverse_dynamics(x, q, 0 * q, 0 * q) for x in (written, robot))
    assert torch.allclose(tau, 1.2 * real, rtol=0.02, atol=0.02)


@exhaustive
@fits
def test_logs_of_another_robot_have_a_poor_verdict(here, capsys):
    log("log.csv", rows=450)
    text = here.joinpath("log.csv").read_text().splitlines()
    swapped = [",".join([*line.split(",")[:5], *reversed(line.split(",")[5:])]) for line in text[1:]]
    here.joinpath("log.csv").write_text("\n".join([text[0], *swapped]) + "\n")
    out, errors = told(capsys, "id", "arm.urdf", "log.csv", *FEW)
    assert "Good: " not in out and "warning" in errors


@fits
def test_what_may_be_missing_is_tried_where_the_verdict_is_poor(here, capsys):
    """A load in the motions to test on alone, which no gain and no rotor explains."""
    log("empty.csv")
    log("held.csv", held=ROBOT.with_payload(4.0, (0.1, 0.0, 0.0), frame="lower"), seed=1)
    found = data(capsys, "id", "arm.urdf", "empty.csv", "--test", "held.csv", *FEW, "--frame", "lower")
    tried = {one["name"]: one for one in found["tried"]}
    assert found["verdict"] == "Poor" and {"nothing else", "--rotors", "--estimate-gains"} <= tried.keys()
    (name,) = (name for name, one in tried.items() if one["helps"])
    mass = float(name.split(" kg at lower in the motions to test on")[0])
    assert abs(mass - 4) < 0.4 and tried[name]["error"] < 0.2 * tried["nothing else"]["error"]
    assert "What may be missing" in Path(found["files"]["page"]).read_text()


@fits
def test_files_of_one_log_are_joined_and_the_output_says_how(here, capsys):
    log("whole.csv")
    rows = np.loadtxt("whole.csv", delimiter=",", skiprows=1)
    np.savetxt("q.txt", rows[:, 1:3])
    np.savetxt("tau.txt", rows[:, 5:])
    named = ("--columns", "q", "q:{1}", "qd", "none", "tau", "tau:{1}", "--rate", "50")
    found = data(capsys, "id", "arm.urdf", "q.txt+tau.txt", *named, *FEW)
    assert found["verdict"] == "Good" and found["tried"] == []
    assert "joined row by row" in Path(found["files"]["page"]).read_text()


def test_columns_are_named_by_patterns_by_joints_and_one_by_one(here):
    given = {"time": "stamp", "q": "a,b", "tau": "eff_{joint}", "qd": "none"}
    columns = [word for pair in given.items() for word in pair]
    layout = _parsed(["id", "arm.urdf", "a.csv", "--columns", *columns])._layout(ROBOT)
    heads = "stamp,b,eff_elbow,a,eff_shoulder"
    rows = [f"{0.01 * k},{2 * k},{4 * k},{k},{3 * k}" for k in range(9)]
    found = read_log("\n".join([heads, *rows]).encode(), layout, robot=ROBOT)
    assert found.q[1].tolist() == [1, 2] and found.tau[1].tolist() == [3, 4] and found.qd is None


# --- scene -----------------------------------------------------------------------------------------------------------


def test_a_scene_keeps_its_energy_and_writes_a_log(here, capsys):
    pytest.importorskip("scipy")
    arguments = ("--effects", "gravity", "--seconds", "0.3", "--dt", "0.001", "--q", "0.3", "-0.2", "--price", "0")
    with torchdq.backend("auto"):  # hundreds of steps
        found = data(capsys, "scene", "arm.urdf", *arguments, "--integrator", "RungeKutta4", "--csv", "fall.csv")
    start, end = (sum(found["energies"][k]) for k in ("start", "end"))
    assert abs(end - start) < 1e-8 and found["energies"]["end"][0] > 0.1
    assert found["steps"] == 300 and found["operations"] == sum(cost["operations"] for cost in found["costs"])
    table = read_log("fall.csv", torchdq.learning.Layout(columns={"tau": None}))
    assert table.q.shape == (301, 2) and abs(table.time[-1] - 0.3) < 1e-9
    assert table.q[0].tolist() == [0.3, -0.2] and plain(table.q[-1]) == pytest.approx(found["end"]["q"], abs=1e-9)


def test_a_scene_of_a_free_body_has_its_motion_and_the_error_of_its_steps(here, capsys):
    """In free fall steps of order 1 end g dt T/2 too low, and their energy is off by as much."""
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    body = f'<link name="base"><inertial><mass value="2"/>{inertia}</inertial></link>'
    here.joinpath("body.urdf").write_text(f"<robot name='body'>{body}</robot>")
    arguments = ("scene", "body.urdf", "--base", "floating", "--effects", "gravity", "--seconds", "1", "--price", "0")
    g, off = 9.81, 9.81 * 0.01 / 2
    table = {row[0]: row[1:] for line in told(capsys, *arguments)[0].splitlines() if (row := line.split())}
    assert [float(x) for x in table["height"][1:]] == pytest.approx([0, -g / 2 - off, -g, off], rel=0.05)
    assert [float(x) for x in table["sum"]] == pytest.approx([0, 0, -2 * g * off, 2 * g * off], rel=0.05)
    with torchdq.backend("auto"):
        found = data(capsys, *arguments, "--integrator", "RungeKutta4", "--csv", "fall.csv")
    assert found["errors"]["energy"] < 1e-10 and found["end"]["V_WB_B"][5] == pytest.approx(-g)
    assert here.joinpath("fall.csv").read_text().startswith("time,X_WB1,")


def test_a_scene_that_leaves_all_bounds_has_failed(here, capsys):
    options = ("--price", "0", "--seconds", "1", "--effects", "gravity", "spring=1e9", "--integrator", "ExplicitEuler")
    found = data(capsys, "scene", "arm.urdf", *options, code=MISTAKE)
    assert found["failure"].startswith("The simulation has failed: from ") and found["energies"]["end"] == [None, None]


def test_a_scene_says_what_it_assumes_and_that_its_steps_are_coarse(here, capsys):
    """The arm has neither rotors nor damping; ten steps of its fall are few."""
    out = " ".join(told(capsys, "scene", "arm.urdf", *SHORT)[0].split())
    assert "RotorInertia 0.1 kg m^2 or kg, Viscous 1 N m s/rad or N s/m." in out and "coarse" not in out
    fall = ("--effects", "gravity", "--dt", "0.1", "--seconds", "1", "--price", "0")
    found = data(capsys, "scene", "arm.urdf", *fall)
    assert found["assumed"] == "" and "The steps are coarse: the error of " in found["coarse"]


def test_a_scene_has_the_effects_that_are_named(here, capsys):
    out, _ = told(capsys, "scene", "arm.urdf", "--effects", "gravity", "viscous=2", "joint-limits", *SHORT)
    assert "Gravity, Viscous, JointLimits" in " ".join(out.split()) and max(map(len, out.splitlines())) <= WIDE
    found = data(capsys, "scene", "arm.urdf", "--effects", *SHORT, "--hold", "20", "5")
    assert not found["effects"] and [cost["slot"] for cost in found["costs"]][-1] == "controller"
    assert found["end"]["q"] == [0, 0]


def test_every_effect_and_every_integrator_can_be_named():
    offered = set(torchdq.effects.__all__) if hasattr(torchdq, "effects") else set()
    assert {"gravity", "joint-limits", "lugre", "first-order-lag", "noise"} <= set(KINDS) and len(KINDS) >= len(
        offered
    ) - 3
    assert {"LinearlyImplicit", "RungeKutta4", "StoermerVerlet"} <= set(STEPPERS)


# --- accuracy, export, view, cost ------------------------------------------------------------------------------------


def test_accuracy_recommends(here, capsys):
    found = data(capsys, "accuracy", "arm.urdf", "--error", "1e-2", "--horizon", "0.1", "--most-steps", "4096")
    assert found["error"] <= 1e-2 and found["step"] > 0 and found["integrator"] in STEPPERS
    out, _ = told(capsys, "accuracy", "arm.urdf", "--accelerations", "--error", "1e-3")
    assert "dtype" in out and "predicted" in out


def test_c_casadi_and_graphs_of_torch_are_exported(here, capsys):
    arguments = ("inverse_dynamics", "--out", "c", "--name", "arm_torques")
    found = data(capsys, "export", "arm.urdf", *arguments)
    names = {Path(file).name for file in found["files"]}
    assert {"arm_torques.c", "arm_torques.h"} <= names and all(Path(file).is_file() for file in found["files"])
    out, _ = told(capsys, "export", "arm.urdf", *arguments)
    assert "wrote c/arm_torques.c" in out
    found = data(capsys, "export", "arm.urdf", "forward_dynamics", *MASSLESS)
    assert found["function"] == "forward_dynamics_arm"
    assert "X_WB" in next(Path(file) for file in found["files"] if file.endswith(".h")).read_text()
    found = data(capsys, "export", "arm.urdf", "mass_matrix", "--language", "casadi", "--out", "casadi")
    assert len(found["files"]) == 1 and "sparsity" in Path(found["files"][0]).read_text()
    found = data(capsys, "export", "arm.urdf", "inverse_dynamics", "--language", "torch")
    graph = torch.export.load(found["files"][0]).module()
    x = torch.rand(3, 5, 2, dtype=torch.float64)
    assert torch.allclose(graph(*x), torchdq.inverse_dynamics(ROBOT, *x))


FRICTION = re.sub(r'(<axis xyz="0 1 0"/>)', r'\1<dynamics damping="0.7" friction="1.5"/>', ARM)
LAW = ("--options", "lower", "body", "z")


@pytest.mark.parametrize(
    ("name", "layer", "options"),
    [
        ("computed_torque", torchdq.ComputedTorque, ()),
        ("cartesian_impedance", torchdq.nn.CartesianImpedance, LAW),
        ("operational_space_control", torchdq.nn.OperationalSpaceControl, LAW),
    ],
)
def test_an_exported_law_has_the_torques_of_its_layer(here, capsys, name, layer, options):
    """Friction of the description included, whose sum at 1 rad/s the header states: 1.5 + 0.7 N m."""
    here.joinpath("arm.urdf").write_text(FRICTION)
    found = data(capsys, "export", "arm.urdf", name, *options, "--language", "torch")
    robot = torchdq.Robot.from_urdf("arm.urdf")
    law = layer(robot, 20.0, 5.0, **dict(zip(("frame", "expressed", "axes"), options[1:], strict=False)))
    q, qd, *goal = torch.rand(5, 6, 2, dtype=torch.float64)
    if options:
        goal = [torchdq.forward_kinematics(robot, q + 0.1, "lower"), 0.1 * torch.ones(6, 6, dtype=q.dtype)]
        goal += [0 * goal[1]] if name == "operational_space_control" else []
    gains = [torch.full((1 if options else 2,), x, dtype=q.dtype) for x in (20.0, 5.0)]
    tau = torch.export.load(found["files"][0]).module()(q, qd, *goal, *gains)
    assert torch.allclose(tau if isinstance(tau, torch.Tensor) else tau[0], law(q, qd, *goal), rtol=1e-10)
    files = data(capsys, "export", "arm.urdf", name, *options)["files"]
    header = next(Path(file) for file in files if file.endswith(".h")).read_text()
    assert "friction at 1 rad/s or m/s = 2.2" in header and "gravity = 0, 0, -9.81" in header


def test_gravity_torques_are_exported_and_wrenches_may_be_arguments(here, capsys):
    here.joinpath("arm.urdf").write_text(FRICTION)
    _, errors = told(capsys, "export", "arm.urdf", "gravity", code=MISTAKE)
    (words,) = re.findall("gravity torques are (.*)", " ".join(errors.split()))
    found = data(capsys, "export", "arm.urdf", *words.split(), "--language", "torch")
    q = torch.rand(5, 2, dtype=torch.float64)
    tau = torch.export.load(found["files"][0]).module()(q)
    assert torch.allclose(tau, torchdq.closed_form(ROBOT, q, 0 * q).g)
    files = data(capsys, "export", "arm.urdf", *words.split())["files"]
    header = next(Path(file) for file in files if file.endswith(".h")).read_text()
    assert "friction: none; that of the description is left out" in header and "gravity = 0, 0, -9.81" in header
    goal = ("q", "qd", "q_des", "qd_des", "qdd_des", "kp", "kd", "f_tip")
    files = data(capsys, "export", "arm.urdf", "computed_torque", "--arguments", *goal)["files"]
    assert "f_tip[6]" in next(Path(file) for file in files if file.endswith(".h")).read_text()


def test_the_help_and_the_error_list_the_same_functions(here, capsys):
    out, _ = told(capsys, "export", "--help")
    _, errors = told(capsys, "export", "arm.urdf", "zzz", code=MISTAKE)
    listed = re.search("known: (.*)", " ".join(errors.split()))[1]
    assert f"Functions: {listed}." in " ".join(out.split())


def test_a_cure_in_options_can_be_given_to_a_shell(here, capsys):
    _, errors = told(capsys, "export", "arm.urdf", "cartesian_impedance", code=MISTAKE)
    (cure,) = re.findall("take (--options .*)", " ".join(errors.split()))
    assert data(capsys, "export", "arm.urdf", "cartesian_impedance", *shlex.split(cure))["files"]


def test_a_robot_is_viewed(here, capsys):
    pytest.importorskip("viser")
    found = data(capsys, "view", "arm.urdf", "--seconds", "0.2", "--port", "8123")
    assert found["frames"] >= 1 and found["url"].startswith("http://127.0.0.1:")


def test_a_robot_with_a_floating_base_is_viewed_on_the_ground(here, capsys):
    pytest.importorskip("viser")
    from torchdq.command.view import standing
    from torchdq.envs.render import Viewer

    with pytest.warns(UserWarning):
        assert data(capsys, "view", "arm.urdf", *MASSLESS, "--seconds", "0.1")["frames"] >= 1
        robot = torchdq.Robot.from_urdf(ARM, base="floating", on_unphysical="warn")
    with closing(Viewer(robot)) as viewer:
        q = torch.tensor([1.0, 0.5])
        before, after = (viewer.skeleton.points(q, X_WB=X)[..., 2].min() for X in (None, standing(viewer, q)))
        assert before < -0.3 and abs(after) < 1e-6


def test_joints_sway_within_their_limits():
    from torchdq.command.view import PERIOD, swaying

    moved = torch.stack([swaying(ROBOT, t) for t in torch.linspace(0, 2 * PERIOD, 50).tolist()])
    assert bool((moved > ROBOT.limits.lower).all() and (moved < ROBOT.limits.upper).all())
    assert bool((moved.std(0) > 0.1).all())


@exhaustive
def test_the_papers_tables_are_counted(here, capsys, monkeypatch):
    from torchdq.paper import ladder

    monkeypatch.setattr(ladder, "times", lambda n: [1.0] * len(ladder.FORMS))
    out, _ = told(capsys, "cost")
    assert "Table 4" in out and "1 ns" in out and "|" not in out and "From Algorithm 1" in out
    assert max(map(len, out.splitlines())) <= WIDE
    assert set(data(capsys, "cost")) == {"tables", "steps"}


# --- doctor ----------------------------------------------------------------------------------------------------------


def test_the_doctor_finds_this_installation_well(here, capsys):
    found = data(capsys, "doctor")
    states, subjects = ({one[name] for one in found["findings"]} for name in ("state", "what"))
    assert states <= {"ok", "warning"}
    assert {"python", "packages", "processor", "threads", "C compiler", "cache", "GPU", "compiled program"} <= subjects
    out, _ = told(capsys, "doctor")
    assert max(map(len, out.splitlines())) <= WIDE and "torques of a double" in " ".join(out.split())


def test_the_doctor_compiles_and_leaves_the_cache_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setenv(doctor.CACHE, str(tmp_path))
    tmp_path.chmod(0o700)
    assert {finding.subject: finding.severity for finding in doctor.findings()}["compiled program"] == "ok"
    assert os.environ[doctor.CACHE] == str(tmp_path) and list(tmp_path.iterdir()) == []


def test_the_known_torque_is_that_of_the_weights():
    q, zero = torch.tensor(doctor.POSITION, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    tau = torchdq.inverse_dynamics(torchdq.robots.load("two_link"), q, zero, zero, backend="eager")
    assert tau.tolist() == pytest.approx(doctor.TORQUES, rel=1e-14)


@pytest.fixture
def other_compiler(monkeypatch):
    """Patches of an environment whose compiler nothing remembers."""
    torchdq.clear_caches()
    yield monkeypatch
    monkeypatch.undo()
    torchdq.clear_caches()


def test_a_compiler_that_fails_is_broken_with_a_cure(here, capsys, other_compiler):
    fails = 'if [ "$1" = --version ]; then echo broken 1.0; else echo no space left; exit 1; fi'
    here.joinpath("cc").write_text(f"#!/bin/sh\n{fails}\n")
    here.joinpath("cc").chmod(0o755)
    other_compiler.setenv("CC", str(here / "cc"))
    states = {one["what"]: one for one in data(capsys, "doctor", code=MISTAKE)["findings"]}
    assert states["compiled program"]["state"] == "broken" and "no space left" in states["compiled program"]["found"]
    assert "$CC" in states["compiled program"]["cure"]


def test_no_compiler_is_a_warning(here, capsys, other_compiler):
    other_compiler.setenv("PATH", str(here))
    other_compiler.delenv("CC", raising=False)
    other_compiler.setattr(compiler, "ZIG", ("/nowhere",))
    out, _ = told(capsys, "doctor")
    assert "install gcc or clang" in " ".join(out.split()) and "it works; 1 warning" in out


@pytest.mark.parametrize(
    ("module", "name", "value", "subject", "severity", "words"),
    [
        (doctor, "TORQUES", (17.8, 3.75), "compiled program", "error", "must be (17.8, 3.75)"),
        (torch, "get_num_threads", lambda: 10_000, "threads", "warning", "OMP_NUM_THREADS"),
        (machine, "version_of", lambda package: None, "packages", "error", "pip install "),
    ],
)
def test_what_is_not_well_has_a_finding_with_a_cure(monkeypatch, module, name, value, subject, severity, words):
    monkeypatch.setattr(module, name, value)
    found = doctor.findings()
    assert all(finding.cure for finding in found if finding.severity == "error")
    (one,) = [finding for finding in found if finding.subject == subject]
    assert one.severity == severity and one.cure and words in str(one)


# --- the page about the command line ---------------------------------------------------------------------------------

DOCUMENT = ROOT / "docs" / "command-line.md"


def commands_of(document):
    """Command lines of a document, those that go on in the next line as one."""
    blocks = re.findall(r"```sh\n(.*?)```", document, re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [line.partition("  #")[0].strip() for line in lines if line.startswith("torchdq ")]


def test_the_page_names_every_command_and_every_line_of_it_is_understood(capsys):
    lines = commands_of(DOCUMENT.read_text())
    words = [shlex.split(line)[1:] for line in lines]
    assert {line[0] for line in words} >= set(COMMANDS)
    for line in words:
        if line[0] in COMMANDS and "--help" not in line:
            assert isinstance(_parsed(line), COMMANDS[line[0]]), line
    assert capsys.readouterr() == ("", "")


def test_the_report_on_the_page_is_what_comes_out(here, capsys):
    out, _ = told(capsys, "report", "two_link")
    assert out in DOCUMENT.read_text()
