"""Lines about work that takes long, and warnings that are given once."""

import signal
import subprocess
import sys
import threading
import time
import warnings

import pytest
import torch

import torchdq
from torchdq import functional, notice
from torchdq.notice import Notice, warn_once


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(notice, "FIRST", 0.1)
    monkeypatch.setattr(notice, "EVERY", 0.1)


def test_quick_work_is_silent(capfd):
    before = threading.active_count()
    with Notice("counting"):
        pass
    time.sleep(0.3)
    assert capfd.readouterr().err == "" and threading.active_count() == before


def test_long_work_says_what_it_is_and_how_far(capfd):
    with Notice("counting") as told:
        time.sleep(0.15)
        told.at("2 of 3")
        time.sleep(0.3)
    lines = capfd.readouterr().err.splitlines()
    assert lines[0] == "torchdq: counting, 0 s ..."
    assert len(lines) >= 2 and set(lines[1:]) == {"torchdq: counting, 2 of 3, 0 s ..."}
    time.sleep(0.3)
    assert capfd.readouterr().err == ""


def test_the_first_line_comes_after_two_seconds_and_the_others_every_five():
    assert (notice.FIRST, notice.EVERY) == (0.1, 0.1)  # here
    code = "from torchdq import notice; print(notice.FIRST, notice.EVERY)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "2.0 5.0\n"


def test_errors_pass_and_end_the_lines(capfd):
    with pytest.raises(ValueError, match="broken"), Notice("counting"):
        raise ValueError("broken")
    time.sleep(0.3)
    assert capfd.readouterr().err == ""


def test_an_interrupt_ends_the_work():
    code = """
import time
from torchdq.notice import Notice
with Notice("sleeping"):
    print("here", flush=True)
    time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "here\n"
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=10)
    assert process.returncode != 0 and "KeyboardInterrupt" in err


def test_a_stream_that_is_closed_or_absent_stops_nothing(monkeypatch):
    for stream in (None, open("/dev/null", "w")):  # noqa: SIM115
        if stream is not None:
            stream.close()
        failed = []
        monkeypatch.setattr(threading, "excepthook", failed.append)
        monkeypatch.setattr(sys, "stderr", stream)
        with Notice("counting"):
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
    with pytest.warns(UserWarning, match="text"):
        warn_once("a topic of this test", "text")


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
    monkeypatch.setattr(functional, "FIRST", 0.0)
    ((text, file),) = frame_by_frame(robot, name)
    assert text.startswith(f"{name} built 3 programs in 0.") and "one for each frame of robot 'panda'; " in text
    assert file == __file__ and ("frame=[...] takes" in text) == (name == "forward_kinematics")
    assert frame_by_frame(robot, name) == []
    assert len(frame_by_frame(torchdq.robots.load("ur10e"), name)) == 1


def test_quick_programs_and_programs_that_are_there_are_no_reason_to_warn(monkeypatch):
    torchdq.clear_caches()
    monkeypatch.setattr(functional, "FIRST", 1e9)
    robot = torchdq.robots.load("panda")
    assert frame_by_frame(robot, "forward_kinematics") == []
    monkeypatch.setattr(functional, "FIRST", 0.0)
    assert frame_by_frame(robot, "forward_kinematics") == []  # nothing is built


def test_several_frames_come_from_one_program():
    torchdq.clear_caches()
    robot, q = torchdq.robots.load("panda"), torch.ones(3, 7, dtype=torch.float64)
    names = ["tip", "panda_link3", "base"]
    found = torchdq.forward_kinematics(robot, q, names)
    assert found.shape == (3, 3, 8) and functional.recordings() == 1
    each = [torchdq.forward_kinematics(robot, q, name) for name in names]
    torch.testing.assert_close(found, torch.stack(each, -2), rtol=1e-14, atol=1e-14)
    assert torchdq.forward_kinematics(robot, q, ["tip"]).shape == (3, 1, 8)


@pytest.mark.parametrize("frames", [[], 5, ["tip", "hand"], [1]], ids=repr)
def test_frames_that_are_none_are_refused(frames):
    robot = torchdq.robots.load("panda")
    with pytest.raises(
        torchdq.TorchdqError, match=r"frame must (name one|be a name or a seq)|no frame .* named 'hand'"
    ):
        torchdq.forward_kinematics(robot, torch.zeros(7), frames)
