"""Logs in several files, joined by time; the motion is known in closed form."""

import io

import numpy as np
import pytest
from helpers import all_in_one
from recorded_logs import HEADS, TABLE, TIME, assert_holds, log_refused, sines, with_findings

from torchdq.learning import Layout, read_log

pytest.importorskip("scipy", reason="files of different rates need scipy")


def test_files_of_the_same_rows_are_joined_without_a_change(tmp_path):
    q, tau = tmp_path / "positions.csv", tmp_path / "torques.csv"
    np.savetxt(q, TABLE[:, :5], delimiter=",", header=",".join(HEADS[:5]), comments="")
    np.savetxt(tau, TABLE[:, [0, 5, 6]], delimiter=";", header="time;tau1;tau2", comments="")
    found = read_log([q, tau])
    assert_holds(found)
    assert found.joined == "joined row by row" and found.path.name.endswith("torques.csv")
    np.testing.assert_array_equal(read_log([q, tau], rows=(10, 30)).tau, found.tau[10:30])
    for file, x in ((q, TABLE[:, 1:5]), (tau, TABLE[:, 5:])):  # without names
        np.savetxt(file, x)
    names = {"q": "positions:{1}", "qd": "positions:{3}", "tau": "torques:{1}"}
    assert_holds(read_log((q, tau), Layout(columns=names, rate=500.0)))
    with log_refused("column.repeated"):
        read_log([q, tau], Layout(columns=names | {"tau": "{2}"}, rate=500.0))
    times = tmp_path / "times.txt"
    np.savetxt(times, TIME)
    assert_holds(read_log([q, tau, times], Layout(columns=names | {"time": "times:1"})))
    np.savetxt(times, TIME[:-5])
    with log_refused("time.missing"):
        read_log([q, tau, times], Layout(columns=names | {"time": "times:1"}))
    with log_refused("column.split"):
        read_log([q, tau], Layout(columns=names | {"q": ["positions:1", "torques:1"], "tau": None}, rate=500.0))


@all_in_one(["q", "tau"])
def test_files_of_different_rates_are_joined_at_the_times_of_the_slower_one(fast):
    """Where both run; noise above what the slower one can hold is filtered out, and commands are never interpolated."""
    quick, slow = np.arange(0.5, 6, 0.001), np.arange(0, 5.004, 0.01) + 0.0003
    times = {"q": slow, "tau": slow, fast: quick}
    x = {name: sines(times[name], 2)[k] for k, name in ((0, "q"), (3, "tau"))}
    x[fast] = x[fast] + 0.5 * np.sin(2 * np.pi * 90 * quick)[:, None]  # an alias would be at 10 Hz
    files = [np.column_stack([times[name], x[name]]) for name in ("q", "tau")]
    found, _ = with_findings(read_log, list(map(text, files, ("q", "tau"))), Layout(columns={"qd": None}))
    assert found.time[0] >= 0.5 and found.time[-1] <= 5.004 and len(found.time) == pytest.approx(450, abs=2)
    assert set(found.time) <= set(slow) and f"{fast} of the log (1000 Hz, low-passed at 40 Hz)" in found.joined
    assert f"\n{found.joined}\n" in repr(found)
    for k, name in ((0, "q"), (3, "tau")):
        inside = slice(20, -20) if name == fast else slice(None)
        np.testing.assert_allclose(getattr(found, name)[inside], sines(found.time, 2)[k][inside], atol=1e-3)


def text(rows, name):
    """Bytes of a file of a signal of two joints."""
    file = io.StringIO()
    np.savetxt(file, rows, delimiter=",", header=f"time,{name}1,{name}2", comments="")
    return file.getvalue().encode()


def test_commands_are_held_and_files_of_other_times_refused():
    slow, quick = np.arange(0, 4, 0.05), np.arange(0, 4, 0.01)
    command = np.repeat(np.arange(80) % 2.0, 5)[:, None] + np.zeros(2)  # a step every 0.05 s
    q = text(np.column_stack([slow + 0.004, sines(slow, 2)[0]]), "q")
    asked, late = (text(np.column_stack([quick + by, command]), "u") for by in (0, 60))
    layout = Layout(columns={"qd": None, "tau": None, "command": "u{1}"})
    found, _ = with_findings(read_log, [q, asked], layout)
    np.testing.assert_array_equal(found.command[:, 0], np.arange(len(found.time)) % 2)
    assert "commands are held" in found.joined
    with log_refused("time.apart"):
        read_log([q, late], layout)
