"""Rows that leap away are separated from motions, steps and noise, in logs and on recordings of real arms."""

import numpy as np
import pytest
from recorded_logs import arrays, recordings, with_findings
from recordings import layout_of

from torchdq.learning import read_log
from torchdq.learning.logs.outliers import outlier_findings, outliers


def motion(rows=2000, seed=0):
    t = np.linspace(0, 20, rows)[:, None]
    rng = np.random.default_rng(seed)
    return 30 * np.sin(t + np.arange(2)) + 5 * np.sign(np.cos(t)) + 0.3 * rng.normal(size=(rows, 2))


def test_a_few_rows_far_away_are_found_and_no_others():
    x = motion()
    assert not outliers(x).any()
    for rows in ([700], [700, 701], [5, 900, 1990]):
        wrong = x.copy()
        wrong[rows, 1] = 1e4
        found = outliers(wrong)
        assert np.flatnonzero(found[:, 1]).tolist() == rows and not found[:, 0].any()
    shuffled = np.random.default_rng(1).permutation(x)
    assert not outliers(shuffled).any()


def test_steps_short_motions_and_rest_are_no_outliers():
    x = np.zeros((3000, 1))
    x[1000:1100, 0] = 40 * np.sin(np.linspace(0, np.pi, 100))  # a short motion in a long rest
    x[2000:] = 8.0  # a step
    x[2500:2512] = 500.0  # a collision, longer than a fault of the bus
    assert not outliers(x + 1e-3 * np.random.default_rng(0).normal(size=x.shape)).any()
    quantised = np.where(np.random.default_rng(0).uniform(size=(3000, 2)) < 0.01, 1e-4, 0.0)
    quantised[:, 1] = motion(3000)[:, 1]
    assert not outliers(quantised).any()
    assert not outliers(motion(10)).any()


def test_findings_name_the_column_the_rows_and_the_usual_size():
    x = motion()
    x[[20, 30, 40, 50, 60, 70], 0] = 500.0
    (found,) = outlier_findings(("a", "b"), x, first=2)
    assert (found.code, found.subject, found.value) == ("torque.outliers", "a", 6)
    assert found.found.startswith("500 in row 22, 500 in row 32") and "and 1 more rows, elsewhere up to" in found.found


def test_a_log_with_outliers_is_read_with_a_finding():
    tau = motion()
    time = 0.01 * np.arange(len(tau))
    arrays = {"time": time, "q": np.sin(time)[:, None] + np.arange(2), "qd": None, "tau": tau}
    assert with_findings(read_log, arrays)[1] == []
    tau[[100, 1500], 1] = -1e4
    log, (found,) = with_findings(read_log, arrays)
    assert (found.code, found.subject, found.value) == ("torque.outliers", "column 'tau2'", 2)
    assert (log.tau[100] == tau[100]).all() and "in row 100, -1e+04 in row 1500" in found.found


@pytest.mark.parametrize("name", ["panda_gaz2019", "ur10e_innopolis", "double_pendulum_dfki_A0"])
def test_recordings_have_none(name):
    files = [path for path in sorted(recordings(name).glob("*.csv*")) if "15harm" not in path.name]
    for path in files[:4]:
        assert read_log(path, layout_of(path)).findings == ()


def moved(seconds=10.0, noise=0.01):
    """Log of three joints at 100 Hz, with noisy torques."""
    known = arrays(3, np.arange(0, seconds, 0.01))
    known["tau"] = known["tau"] + noise * np.random.default_rng(0).normal(size=known["tau"].shape)
    return known


def clipped(tau):
    """Torques of the second joint cut off above 3.5 N m."""
    return np.where(np.arange(3) == 1, tau.clip(None, 3.5), tau)


def frozen(tau, joints):
    """Torques of some joints that stay the same for a second."""
    stuck = tau.copy()
    stuck[300:400, joints] = tau[300, joints]
    return stuck


def coarse(tau):
    """Torques in steps of 5 % of their range."""
    return np.round(tau / 0.3) * 0.3


SENSORS = [
    (clipped, "torque.clipped", "column 'tau2'"),
    (lambda tau: frozen(tau, [1]), "signal.frozen", "column 'tau2'"),
    (lambda tau: frozen(tau, [0, 1, 2]), "signal.frozen", "column 'tau1', column 'tau2', column 'tau3'"),
]


@pytest.mark.parametrize(("change", "code", "subject"), SENSORS)
def test_torques_that_are_cut_off_or_stop_to_change_have_a_finding(change, code, subject):
    known = moved()
    _, (one,) = with_findings(read_log, known | {"tau": change(known["tau"])})
    assert (one.code, one.subject) == (code, subject)


def test_coarse_sensors_held_values_and_arms_at_rest_have_none():
    known = moved()
    for tau in (coarse(known["tau"]), np.repeat(known["tau"][::10], 10, axis=0), known["tau"]):
        assert not with_findings(read_log, known | {"tau": tau})[1]
    still = {name: x if name == "time" else np.where(known["time"][:, None] < 5, x[:1], x) for name, x in known.items()}
    for name in ("qd", "qdd"):
        still[name] = np.where(known["time"][:, None] < 5, 0.0, known[name])
    still["q"] = known["q"] * 0 + np.cumsum(still["qd"], axis=0) * 0.01
    assert not with_findings(read_log, still)[1]


def test_a_clock_that_runs_at_another_rate_has_a_finding():
    known = moved()
    _, (one,) = with_findings(read_log, known | {"time": 1.1 * known["time"], "qdd": None})
    assert one.code == "time.scale" and one.value == pytest.approx(1 / 1.1, rel=1e-3)
