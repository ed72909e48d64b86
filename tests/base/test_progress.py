"""Lines about work that takes long, and warnings that are given once."""

import importlib
import re
import runpy
import sys
import threading
import time
import warnings

import numpy as np
import pytest
import torch
from helpers import all_in_one, interrupted
from messages import refused, warned

import torchdq
from torchdq import Scene
from torchdq.backends import c, c_library
from torchdq.base import progress
from torchdq.base.progress import Progress, warn_once
from torchdq.functions import call
from torchdq.learning import MotionLimits, Samples, excitation_trajectory, fit, read_log
from torchdq.program import autodiff
from torchdq.program import program as programs


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(progress, "FIRST", 0.1)
    monkeypatch.setattr(progress, "EVERY", 0.1)


def written_until(capfd, pattern: str) -> str:
    """What was written up to a line that matches, however late it comes."""
    written, end = "", time.monotonic() + 300
    while not re.search(pattern, written, re.MULTILINE):
        assert time.monotonic() < end, written
        time.sleep(0.02)
        written += capfd.readouterr().err
    return written


def test_quick_work_is_silent(capfd, monkeypatch):
    monkeypatch.setattr(progress, "FIRST", 60.0)
    before = threading.active_count()
    with Progress("counting"):
        pass
    time.sleep(0.1)
    assert capfd.readouterr().err == "" and threading.active_count() == before


def test_long_work_says_what_it_is_and_how_far(capfd):
    with Progress("counting") as shown:
        first = written_until(capfd, r" \.\.\.$")
        shown.at("2 of 3")
        later = written_until(capfd, "2 of 3(.|\n)*2 of 3")
    assert re.fullmatch(r"(torchdq: counting, \d+ s \.\.\.\n)+", first)
    assert re.fullmatch(r"(torchdq: counting, \d+ s \.\.\.\n)*(torchdq: counting, 2 of 3, \d+ s \.\.\.\n){2,}", later)
    capfd.readouterr()
    time.sleep(0.3)
    assert capfd.readouterr().err == ""


def test_where_the_work_is_can_be_asked_when_a_line_is_written(capfd):
    counted = []
    with Progress("counting") as shown:
        shown.at(lambda: f"{len(counted)} so far")
        counted.append(1)
        assert "torchdq: counting, 1 so far, " in written_until(capfd, "so far")


def test_the_first_line_comes_after_two_seconds_and_the_others_every_five():
    assert (progress.FIRST, progress.EVERY) == (0.1, 0.1)  # here
    said = runpy.run_path(progress.__file__)
    assert (said["FIRST"], said["EVERY"]) == (2.0, 5.0)


def test_errors_pass_and_end_the_lines(capfd):
    with refused(ValueError), Progress("counting"):
        raise ValueError("broken")
    time.sleep(0.3)
    assert capfd.readouterr().err == ""


def test_an_interrupt_ends_the_work_and_its_lines(capfd):
    with interrupted(0.3), pytest.raises(KeyboardInterrupt), Progress("sleeping"):
        time.sleep(60)
    assert "sleeping" in capfd.readouterr().err
    time.sleep(0.3)
    assert capfd.readouterr().err == ""


def test_a_stream_that_is_closed_or_absent_stops_nothing(monkeypatch):
    for stream in (None, open("/dev/null", "w")):  # noqa: SIM115
        if stream is not None:
            stream.close()
        failed = []
        monkeypatch.setattr(threading, "excepthook", failed.append)
        monkeypatch.setattr(sys, "stderr", stream)
        with Progress("counting"):
            time.sleep(0.2)
        assert failed == []


def test_a_topic_is_warned_about_once_until_the_caches_are_cleared():
    torchdq.clear_caches()
    for expected in (1, 0):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            warn_once("a topic of this test", "text")
        assert len(found) == expected
    torchdq.clear_caches()
    with warned(UserWarning):
        warn_once("a topic of this test", "text")


# --- recording of programs -------------------------------------------------------------------------------------------


def test_programs_that_take_long_to_record_and_to_write_are_told_with_their_operations(monkeypatch):
    torchdq.clear_caches()
    shown = {}

    class Kept(Progress):
        def __exit__(self, *error):
            super().__exit__(*error)
            shown[self.what] = self.where if isinstance(self.where, str) else self.where()

    for module in (programs, c):
        monkeypatch.setattr(module, "Progress", Kept)
    monkeypatch.setattr(c_library, "load", lambda *_: c_library.Library(None, ()))
    program = Scene(torchdq.robots.load("two_link"), substeps=3).program()
    autodiff.vjp(program, (0,))
    autodiff.jvp(program, (0,))
    autodiff.jacobian(program, (0,))
    c.CompiledKernel(program, torch.float32)
    torchdq.clear_caches()  # of the library that is none
    for ending in ("", "_vjp", "_jvp", "_jacobian"):
        number, words = shown[f"recording step_two_link{ending}"].split()
        assert int(number) > 100 and words == "operations"
    assert shown["writing step_two_link in C"] == ""


# --- work that shows how far it is ----------------------------------------------------------------------------------


@pytest.fixture
def shown(monkeypatch):
    """Lines that could be written, in their order: what is being done, and how far it is."""
    lines = []
    monkeypatch.setattr(Progress, "__enter__", lambda self: lines.append(self.what) or self)
    monkeypatch.setattr(Progress, "__exit__", lambda *_: None)
    monkeypatch.setattr(Progress, "at", lambda self, where: lines.append(f"{self.what}, {where}"))
    return lines


def motion(rows=400):
    """Arrays of a smooth motion of two joints."""
    time = 0.01 * np.arange(rows)
    q, qd = (
        np.stack([np.sin(3 * time), np.cos(5 * time)], 1),
        np.stack([3 * np.cos(3 * time), -5 * np.sin(5 * time)], 1),
    )
    return {"time": time, "q": q, "qd": qd, "tau": qd + np.sin(2 * q)}


def two_link_samples():
    data = motion()
    q, qd, tau = (torch.tensor(data[name]) for name in ("q", "qd", "tau"))
    return Samples(q, qd, torch.zeros_like(q), tau)


def test_cross_validation_of_a_residual_shows_its_networks_and_steps(shown):
    model = torchdq.ResidualDynamics(torchdq.DQRNEA(torchdq.robots.load("two_link")), hidden=(4,))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit(model, two_link_samples(), steps=3, batch=64)
    said = [line for line in shown if line.startswith("fitting, copy")]
    copies = int(said[0].split(" of ")[1].split(" ")[0])
    pairs = [(k, i) for k in range(1, copies + 1) for i in range(1, 4)]
    expected = [f"fitting, copy {k} of {copies} for held-out rows, step {i} of 3" for k, i in pairs]
    assert copies > 1 and said == expected


def test_the_search_for_a_motion_tells_its_stages_and_steps(shown, monkeypatch):
    monkeypatch.setattr(importlib.import_module("torchdq.learning.excitation.search"), "STAGES", ((1, 2), (2, 3)))
    limits = MotionLimits(lower=[-1.0, -1.0], upper=[1.0, 1.0], velocity=2.0, effort=100.0)
    excitation_trajectory(torchdq.robots.load("two_link"), 2.0, limits, restarts=4, harmonics=2)
    steps = [f"stage 1 of 2, step {i} of 2" for i in (1, 2)] + [f"stage 2 of 2, step {i} of 3" for i in (1, 2, 3)]
    shown = [line.partition(", ")[2] for line in shown if line.startswith("finding a motion")]
    assert shown == ["", *steps, "checking the limits"]


def test_reading_a_log_is_told(shown, tmp_path):
    data = motion()
    path = tmp_path / "log.csv"
    columns = np.column_stack([data[name] for name in ("time", "q", "qd", "tau")])
    np.savetxt(path, columns, delimiter=",", header="time,q1,q2,qd1,qd2,tau1,tau2", comments="", fmt="%.12g")
    read_log(path)
    assert shown == [f"reading {path}"]
    read_log(data)
    assert shown[1:] == ["reading a log"]


# --- programs of single frames ---------------------------------------------------------------------------------------


def frame_by_frame(robot, name):
    """Calls for every frame of a robot, one by one, with the warnings."""
    q = torch.zeros(robot.n, dtype=torch.float64)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        for frame in robot.frame_names:
            getattr(torchdq, name)(robot, q, frame, backend="eager")
    return [(str(one.message), one.filename) for one in seen]


@pytest.mark.parametrize("name", ["forward_kinematics", "jacobian"])
def test_frames_one_by_one_are_told_once_when_their_programs_took_long(name, monkeypatch):
    torchdq.clear_caches()
    robot = torchdq.robots.load("panda")
    monkeypatch.setattr(call, "FIRST", 0.0)
    ((text, file),) = frame_by_frame(robot, name)
    assert text.startswith(f"{name} built 3 programs in 0.") and "one for each frame of robot 'panda'; " in text
    assert file == __file__ and ("frame=[...] takes" in text) == (name == "forward_kinematics")
    assert frame_by_frame(robot, name) == []
    assert len(frame_by_frame(torchdq.robots.load("ur10e"), name)) == 1


def test_quick_programs_and_programs_that_are_there_are_no_reason_to_warn(monkeypatch):
    torchdq.clear_caches()
    monkeypatch.setattr(call, "FIRST", 1e9)
    robot = torchdq.robots.load("panda")
    assert frame_by_frame(robot, "forward_kinematics") == []
    monkeypatch.setattr(call, "FIRST", 0.0)
    assert frame_by_frame(robot, "forward_kinematics") == []  # nothing is built


def test_several_frames_come_from_one_program():
    torchdq.clear_caches()
    robot, q = torchdq.robots.load("panda"), torch.ones(3, 7, dtype=torch.float64)
    names = ["tip", "panda_link3", "base"]
    found = torchdq.forward_kinematics(robot, q, names)
    assert found.shape == (3, 3, 8) and call.recordings() == 1
    each = [torchdq.forward_kinematics(robot, q, name) for name in names]
    torch.testing.assert_close(found, torch.stack(each, -2), rtol=1e-14, atol=1e-14)
    assert torchdq.forward_kinematics(robot, q, ["tip"]).shape == (3, 1, 8)


@all_in_one([[], 5, ["tip", "hand"], [1]])
def test_frames_that_are_none_are_refused(frames):
    robot = torchdq.robots.load("panda")
    with refused(torchdq.TorchdqError):
        torchdq.forward_kinematics(robot, torch.zeros(7), frames)
