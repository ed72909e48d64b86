"""Lines about work that takes long, and warnings that are given once."""

import signal
import subprocess
import sys
import threading
import time
import warnings

import pytest

import torchdq
from torchdq import notice
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
