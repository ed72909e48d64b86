"""The examples run, and what they return holds; the reader of logs refuses what it cannot use, in words.

The recordings are not part of the package. Their tests look in the folder that TORCHDQ_DATA names, or beside the
checkout, and are skipped where there are none.
"""

import importlib.util
import os
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
DATA = Path(os.environ.get("TORCHDQ_DATA", ROOT.parent / "shared" / "data"))
sys.path.insert(0, str(EXAMPLES))  # where a script's own folder is when it runs

for needed in ("matplotlib", "pytorch_kinematics", "rich", "scipy", "tyro"):
    pytest.importorskip(needed, reason="the examples need the extra 'examples'")
import logs  # noqa: E402
from matplotlib.image import imread  # noqa: E402
from rich.console import Console  # noqa: E402

BACKEND = "auto"


def example(name: str) -> ModuleType:
    """Module of an example, whose file name no import statement can spell."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def assert_drawn(path: Path) -> None:
    picture = imread(path)[..., :3]
    assert picture.shape[0] > 500 and picture.shape[1] > 900
    assert picture.std() > 0.03, f"{path.name} is blank"


# --- the examples ----------------------------------------------------------------------------------------------------


def test_inverse_dynamics(tmp_path, capsys):
    main = example("01_inverse_dynamics")
    checks = main.main(main.Args(batch=64, step=2.5e-3, timing=1e-3, out=tmp_path))
    assert len(checks) == 15
    failed = {name: check for name, check in checks.items() if not check.passed}
    assert not failed
    assert checks["torques, float64"].value < 1e-12
    assert checks["tracking error of the two-link arm against the analytic decay"].value < 1e-9
    assert_drawn(tmp_path / "torques.png")
    assert_drawn(tmp_path / "tracking.png")
    printed = capsys.readouterr().out
    assert "xarm7" in printed or "UF_ROBOT" in printed
    assert "FAIL" not in printed


def test_a_failed_check_is_the_exit_status(tmp_path, capsys, monkeypatch):
    script = EXAMPLES / "01_inverse_dynamics.py"
    options = ["--batch", "8", "--timing", "0", "--step", "0.1", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [str(script), *options])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(script), run_name="__main__")
    assert stop.value.code == 1
    assert "FAIL  tracking error of the two-link arm" in capsys.readouterr().out


def test_a_bad_log_ends_the_program_before_the_work(tmp_path, capsys, monkeypatch):
    script = EXAMPLES / "01_inverse_dynamics.py"
    monkeypatch.setattr(sys, "argv", [str(script), "--log", str(tmp_path / "missing.csv"), "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"missing\.csv"):
        runpy.run_path(str(script), run_name="__main__")
    assert not capsys.readouterr().out


def test_closed_form(capsys):
    assert example("02_closed_form").main() < 1e-13
    assert "Jt2 tz" in capsys.readouterr().out


def test_computed_torque(tmp_path):
    module = example("03_computed_torque")
    right, wrong = module.main(module.Args(duration=0.5, out=tmp_path))
    analytic = 0.1 * (1 + 10 * 0.5) * np.exp(-10 * 0.5)
    assert abs(right - analytic) < 1e-6
    assert wrong > 5 * right
    assert_drawn(tmp_path / "computed_torque.png")


# --- logs ------------------------------------------------------------------------------------------------------------

RATE = 2 * np.pi * 0.7  # [rad/s] of the motion in the synthetic log


def motion(time: np.ndarray) -> tuple[np.ndarray, ...]:
    """q, qd, qdd and tau of seven joints, each [rows, 7]."""
    phase = RATE * time[:, None] + np.arange(7)
    return np.sin(phase), RATE * np.cos(phase), -(RATE**2) * np.sin(phase), 3 * np.cos(phase) + np.arange(7)


def table(seconds: float = 5.0) -> np.ndarray:
    """Rows of a log at about 1 kHz, in uneven steps."""
    time = np.cumsum(np.random.default_rng(0).uniform(0.4e-3, 1.6e-3, round(1000 * seconds)))
    q, qd, _, tau = motion(time)
    return np.column_stack([time, q, qd, tau])


def written(path: Path, rows: np.ndarray, header: bool = True) -> Path:
    names = ",".join(logs.LAYOUTS["panda"].columns)
    np.savetxt(path, rows, delimiter=",", fmt="%.9g", header=names if header else "", comments="")
    return path


@pytest.fixture
def log(tmp_path) -> Path:
    return written(tmp_path / "log.csv", table())


def edited(path: Path, edit: Callable[[list[str]], None]) -> Path:
    lines = path.read_text().splitlines()
    edit(lines)
    path.write_text("\n".join(lines) + "\n")
    return path


def test_log_is_read_as_written(log):
    found, rows = logs.read(log), table()
    assert found.layout is logs.LAYOUTS["panda"] and found.repeats == 0
    np.testing.assert_allclose(np.column_stack([found.time, found.q, found.qd, found.tau]), rows, atol=1e-7)
    np.testing.assert_allclose(logs.read(log, rows=(100, 200)).time, rows[100:200, 0], atol=1e-7)


def test_smoothing_recovers_a_known_motion(log):
    found = logs.smooth(logs.read(log))
    for name, x, expected in zip(("q", "qd", "qdd", "tau"), found[1:], motion(found.time), strict=True):
        assert abs(x - expected).max() < 1e-3 * abs(expected).max(), name
    assert np.diff(found.time).std() < 1e-9
    assert found.time[0] >= logs.read(log).time[0] + logs.ENDS


def test_smoothing_removes_noise_without_delay(tmp_path):
    rows = table(20.0)
    rows[:, 1:] += np.random.default_rng(1).normal(0, 0.1, rows[:, 1:].shape)
    found = logs.smooth(logs.read(written(tmp_path / "noisy.csv", rows)))
    _, qd, qdd, tau = motion(found.time)
    assert (found.qd - qd).std() < 0.02 and (found.tau - tau).std() < 0.02
    assert (found.qdd - qdd).std() < 0.02 * qdd.std()
    delay = (found.tau * motion(found.time + 0.01)[3]).sum() - (found.tau * motion(found.time - 0.01)[3]).sum()
    assert abs(delay) < 1e-3 * (found.tau * tau).sum()


def test_rows_at_rest_are_left_out(tmp_path):
    rows = table(6.0)
    resting = (rows[:, 0] > 2) & (rows[:, 0] < 4)
    rows[resting, 8:15] = 0.0
    found = logs.smooth(logs.read(written(tmp_path / "pause.csv", rows)))
    assert not ((found.time > 2.5) & (found.time < 3.5)).any()
    assert (found.time < 1.5).any() and (found.time > 4.5).any()


def test_repeated_time_stamps_are_dropped_and_counted(log):
    edited(log, lambda lines: lines.insert(50, lines[49]))
    found = logs.read(log)
    assert found.repeats == 1
    assert (np.diff(found.time) > 0).all() and len(found.time) == len(table())


def cell(row: int, column: int, text: str) -> Callable[[list[str]], None]:
    """Edit that puts text into a cell, both counted from 1 as the messages do."""

    def edit(lines: list[str]) -> None:
        cells = lines[row - 1].split(",")
        cells[column - 1] = text
        lines[row - 1] = ",".join(cells)

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (cell(17, 11, "nan"), r"log\.csv, row 17, column 'qd3': 'nan' is not a finite number"),
        (cell(17, 22, "inf"), r"log\.csv, row 17, column 'tau7': 'inf' is not a finite number"),
        (cell(17, 2, "high"), r"log\.csv, row 17, column 'q1': 'high' is not a finite number"),
        (cell(17, 2, ""), r"log\.csv, row 17, column 'q1': '' is not a finite number"),
        (cell(30, 1, "0.001"), r"log\.csv, row 30, column 'time': .* s before the row above"),
        (
            lambda lines: lines.__delitem__(slice(100, 400)),
            r"row 101, column 'time': 0\.\d+ s after the row above, more",
        ),
        (cell(17, 2, "1,2"), r"row 17: 23 columns, expected 22 columns time, q1 \.\.\. tau7"),
        (cell(1, 9, "velocity1"), r"row 1: column 9 is 'velocity1', expected 'qd1'"),
        (cell(1, 22, "tau7,extra"), r"row 1: 23 columns, expected 22"),
        (lambda lines: lines.pop(0), r"row 1: 22 columns, from '0\.\S+' on, fit no known layout"),
        (lambda lines: lines.__delitem__(slice(1, None)), r"log\.csv: 0 rows of numbers"),
        (lambda lines: lines.clear(), r"log\.csv is empty"),
    ],
)
def test_bad_logs_are_refused_by_row_and_column(log, edit, message):
    with pytest.raises(logs.LogError, match=message):
        logs.read(edited(log, edit))


def test_too_little_motion_is_refused(tmp_path):
    with pytest.raises(logs.LogError, match=r"short\.csv: 1\.02 s of motion, more than 1\.5 s are needed"):
        logs.smooth(logs.read(written(tmp_path / "short.csv", table(1.0))))
    rows = table()
    rows[:, 8:15] = 0.0
    with pytest.raises(logs.LogError, match=r"still\.csv: no joint ever moves faster"):
        logs.smooth(logs.read(written(tmp_path / "still.csv", rows)))


def test_currents_become_torques(tmp_path):
    rows = np.hstack([np.arange(300)[:, None] * 0.01, np.ones((300, 30))])
    found = logs.read(written(tmp_path / "ur.csv", rows, header=False))
    assert found.layout.robot == "ur10e"
    np.testing.assert_array_equal(found.tau[0], found.layout.gain)


# --- recordings of real arms -----------------------------------------------------------------------------------------


def explained(tmp_path: Path, sources: tuple[str, ...], test_last: bool) -> tuple[np.ndarray, np.ndarray]:
    for source in sources:
        file = DATA / source.split(":")[0]
        if not file.exists():
            pytest.skip(f"no recording {file}; TORCHDQ_DATA names the folder that holds it")
    main = example("01_inverse_dynamics")
    read = [main.read_log(str(DATA / source), "auto") for source in sources]
    alone, full, checks = main.explain_logs(Console(), read, test_last, None, tmp_path / "measured.png")
    assert all(check.passed for check in checks.values())
    assert_drawn(tmp_path / "measured.png")
    return alone, full


def test_panda_recording(tmp_path):
    alone, full = explained(tmp_path, ("panda_gaz2019/panda_exciting_traj1.csv",), test_last=False)
    np.testing.assert_allclose(alone, [0.98, 0.998, 0.998, 0.98, 0.90, 0.96, -0.02], atol=0.01)
    np.testing.assert_allclose(full, [0.995, 0.999, 0.999, 0.996, 0.986, 0.991, 0.948], atol=0.01)


def test_ur10e_recordings(tmp_path):
    folder = "ur10e_innopolis/"
    names = (
        "ur-20_02_10-30sec_12harm.csv:635:3510",
        "ur-20_02_12-40sec_12harm.csv:500:4460",
        "ur-20_02_19_14harm50sec.csv",
    )
    alone, full = explained(tmp_path, tuple(folder + name for name in names), test_last=True)
    # the rows behind the stated figures of the model alone are not stated; other halves of the file move them by 0.1
    np.testing.assert_allclose(alone, [0.02, 0.89, 0.86, 0.29, 0.0, -0.01], atol=0.07)
    np.testing.assert_allclose(full, [0.996, 0.990, 0.997, 0.987, 0.984, 0.996], atol=0.01)


def test_a_single_ur10e_recording(tmp_path):
    _, full = explained(tmp_path, ("ur10e_innopolis/ur-20_02_19_14harm50sec.csv",), test_last=False)
    assert (full > 0.97).all()
