"""Motions are zero-phase filtered and differentiated, held against sines in closed form, and split without leaks."""

import sys
from functools import partial

import numpy as np
import pytest
import torch
from helpers import all_in_one
from messages import refused
from recorded_logs import RATE, arrays, log_refused, names, sines, table, written
from recordings import LAYOUTS

from torchdq.errors import ArgumentError, MissingLibraryError
from torchdq.learning import Layout, read_log, smooth, stack_samples, train_test_split
from torchdq.learning.logs import motions

pytest.importorskip("scipy", reason="smoothing needs scipy")


def of(rows):
    """Log of rows of `table`."""
    return read_log(dict(zip(("time", "q", "qd", "tau"), (rows[:, 0], *np.split(rows[:, 1:], 3, 1)), strict=True)))


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return read_log(written(tmp_path_factory.mktemp("log") / "log.csv", table(), names(7)))


@pytest.fixture(scope="module")
def motion(log):
    return smooth(log)


def test_smoothing_recovers_a_known_motion(log, motion):
    """Although the steps are uneven by 60 %."""
    for name, x, expected in zip(("q", "qd", "qdd", "tau"), motion[1:5], sines(motion.time), strict=True):
        assert abs(x - expected).max() < 1e-3 * abs(expected).max(), name
    assert np.diff(motion.time).std() < 1e-9
    assert motion.time[0] >= log.time[0] + motions.ENDS


def phase_of(x, time):
    """Phase of the motion's frequency in each column [rad], by least squares on whole numbers of rows."""
    basis = np.stack([np.sin(RATE * time), np.cos(RATE * time), np.ones_like(time)], axis=-1)
    sine, cosine, _ = np.linalg.lstsq(basis, x, rcond=None)[0]
    return np.arctan2(cosine, sine)


def test_a_sine_keeps_its_phase(motion):
    """A lag of one row would be 4e-3 rad; accelerations are opposite to the positions to 1e-5 rad."""
    for x, ahead in ((motion.q, 0.0), (motion.qd, np.pi / 2), (motion.qdd, np.pi), (motion.tau, np.pi / 2)):
        lag = np.angle(np.exp(1j * (phase_of(x, motion.time) - np.arange(7.0) - ahead)))
        assert abs(lag).max() < 2e-5


def test_smoothing_removes_noise_without_delay(tmp_path):
    rows = table(20.0)
    rows[:, 1:] += np.random.default_rng(1).normal(0, 0.1, rows[:, 1:].shape)
    found = smooth(read_log(written(tmp_path / "noisy.csv", rows, names(7)), LAYOUTS["panda"]))
    _, qd, qdd, tau = sines(found.time)
    assert (found.qd - qd).std() < 0.02 and (found.tau - tau).std() < 0.02
    assert (found.qdd - qdd).std() < 0.02 * qdd.std()
    delay = (found.tau * sines(found.time + 0.01)[3]).sum() - (found.tau * sines(found.time - 0.01)[3]).sum()
    assert abs(delay) < 1e-3 * (found.tau * tau).sum()


def test_accelerations_of_the_log_are_preferred():
    known = arrays()
    found = smooth(read_log(known | {"qdd": 1.01 * known["qdd"]}))
    np.testing.assert_allclose(found.qdd, 1.01 * sines(found.time, 3)[2], atol=1e-3 * RATE**2)


def test_positions_alone_give_the_velocities_and_accelerations():
    known = {name: x for name, x in arrays().items() if name != "qdd"}
    for absent in (("qd",), ("qd", "tau")):
        motion = smooth(read_log(known | dict.fromkeys(absent)))
        _, qd, qdd, _ = sines(motion.time, 3)
        # what the filter takes at 0.7 Hz, and what it lets through of the ends
        np.testing.assert_allclose(motion.qd, qd, atol=2e-3 * RATE)
        np.testing.assert_allclose(motion.qdd, qdd, atol=2e-3 * RATE**2)
    assert motion.tau is None and motion.direction is None and motion.cutoff_tau is None
    (first,), _ = train_test_split(motion, 0.5)
    assert len(first.q) == -(-len(motion.q) // 2) and "tau" not in str(motion)
    with refused(ArgumentError):
        stack_samples(motion)
    np.testing.assert_allclose(smooth(read_log(known | {"qd": None})).tau, smooth(read_log(known)).tau)


def test_the_sign_of_the_velocity_is_filtered_as_the_torques_are(log, motion):
    fast = abs(motion.qd) > 1
    assert abs(motion.direction - np.sign(motion.qd))[fast].max() < 0.2
    assert abs(motion.direction).min() < 0.1  # rounded, where a sharp sign would hardly ever be
    for (part,) in train_test_split(motion, 0.5):
        assert len(part.direction) == len(part.time)
    few = smooth(log, rate=20)
    assert np.allclose(np.diff(few.time), 0.05, atol=1e-3) and len(few.direction) == len(few.time)


@pytest.mark.parametrize(("rate", "cutoff"), [(1000.0, 8.0), (20.0, 5.0), (12.5, 3.125)])
def test_cutoffs_fit_the_rate_and_are_recorded(rate, cutoff):
    time = np.arange(0, 20, 1 / rate)
    known = arrays(2, time) | {"qdd": None}
    motion = smooth(read_log(known))
    assert motion.cutoff_qd == motion.cutoff_tau == pytest.approx(cutoff)
    assert f"velocities at {cutoff:.4g} Hz, torques at {cutoff:.4g} Hz" in str(motion)
    np.testing.assert_allclose(motion.qdd, sines(motion.time, 2)[2], atol=0.1)
    chosen = smooth(read_log(known, Layout(cutoff_tau=2.0)), cutoff_qd=3.0, sign_width=0.02)
    assert (chosen.cutoff_qd, chosen.cutoff_tau, chosen.sign_width) == (3.0, 2.0, 0.02)


def test_frequencies_may_be_chosen():
    narrow = smooth(of(table(20.0)), cutoff_qd=0.7, cutoff_tau=30.0)
    # twice through a filter of order four, a sine at the cutoff is halved
    assert abs(narrow.qd).max() == pytest.approx(RATE / 2, rel=0.05)
    np.testing.assert_allclose(narrow.tau, sines(narrow.time)[3], atol=1e-3)


def test_rows_at_rest_are_left_out():
    rows = table(6.0)
    rows[(rows[:, 0] > 2) & (rows[:, 0] < 4), 8:15] = 0.0
    found = smooth(of(rows))
    assert not ((found.time > 2.5) & (found.time < 3.5)).any()
    assert (found.time < 1.5).any() and (found.time > 4.5).any()


def reaching(seconds, rest, step=1e-3):
    """Motion from rest to rest, its acceleration a sine."""
    time = np.arange(0, seconds + 2 * rest, step)
    s = np.clip((time - rest) / seconds, 0, 1)[:, None]
    w = 2 * np.pi
    q, qd, qdd = s - np.sin(w * s) / w, (1 - np.cos(w * s)) / seconds, w * np.sin(w * s) / seconds**2
    return {"time": time, "q": q, "qd": qd, "tau": qdd + 2 * q}


def test_a_short_motion_between_rests_is_kept_whole():
    exact = reaching(0.8, 0.3)
    found = smooth(read_log(exact), cutoff_qd=20.0, cutoff_tau=20.0)
    assert found.time[-1] - found.time[0] > 0.7  # the rest of it is slower than `AT_REST`
    rows = np.rint(found.time / 1e-3).astype(int)
    for name in ("q", "qd", "tau"):
        np.testing.assert_allclose(getattr(found, name), exact[name][rows], atol=0.02 * np.ptp(exact[name]))


def test_ends_in_motion_are_left_out_and_too_little_motion_is_refused():
    whole = reaching(2.0, 0.4)
    found = smooth(read_log({name: x[:1700] for name, x in whole.items()}))  # it ends while it moves
    assert found.time[0] < 0.5 and found.time[-1] <= 1.7 - motions.ENDS
    for rows in (slice(850), slice(700, 1200)):
        with log_refused("log.short"):
            smooth(read_log({name: x[rows] for name, x in whole.items()}))
    with log_refused("log.short"):
        smooth(of(table(1.0)))
    still = table()
    still[:, 8:15] = 0.0
    with log_refused("log.still"):
        smooth(of(still))


def test_without_scipy_the_message_says_so(log, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.signal", None)
    with refused(MissingLibraryError):
        smooth(log)


def test_a_single_motion_is_cut_with_a_gap(motion):
    (before,), (after,) = train_test_split(motion, 0.6)
    assert len(before.time) == np.ceil(0.6 * len(motion.time))
    assert motions.ENDS <= after.time[0] - before.time[-1] < motions.ENDS + 0.002
    np.testing.assert_array_equal(after.tau[-1], motion.tau[-1])
    (usual,), _ = train_test_split([motion])
    assert len(usual.time) == np.ceil(2 / 3 * len(motion.time))


def test_several_motions_are_split_as_wholes(motion):
    many = [motion._replace(tau=np.full_like(motion.tau, i)) for i in range(10)]

    def numbers(*arguments, **options):
        return [[m.tau[0, 0] for m in part] for part in train_test_split(*arguments, **options)]

    assert numbers(many, 0.7) == [list(range(7)), [7, 8, 9]]  # without a seed the last ones are for the test
    train, test = numbers(many, 0.7, seed=4)
    assert sorted(train + test) == list(range(10)) and len(test) == 3 and numbers(many, 0.7, seed=4)[1] == test
    assert any(numbers(many, 0.7, seed=k)[1] != test for k in range(3))
    assert [len(part) for part in numbers(many[:2], 0.99)] == [len(part) for part in numbers(many[:2], 0.01)] == [1, 1]


@all_in_one([torch.float32, torch.float64])
def test_samples_are_the_rows_of_all_motions(dtype, motion):
    parts = [part for some in train_test_split(motion, 0.5) for part in some]
    found = stack_samples(parts, dtype)
    for name, x in found._asdict().items():
        expected = np.concatenate([getattr(part, name) for part in parts])
        torch.testing.assert_close(x, torch.tensor(expected, dtype=dtype), rtol=0, atol=0)
    assert torch.equal(stack_samples(parts[0], dtype).q, found.q[: len(parts[0].q)])


def test_they_print_as_tables(log, motion):
    """Shape, range and unit of every signal instead of thousands of numbers."""
    for found in (log, motion, stack_samples(motion)):
        lines = str(found).splitlines()
        assert repr(found) == str(found) and len(lines) < 10
        (row,) = [line for line in lines if line.startswith("qd ")]
        assert str(list(found.qd.shape)) in row and f"{float(found.qd.max()):.4g}" in row and row.endswith("rad/s")
    assert str(log).endswith("log.csv: 7 joints, 5000 rows, 0 repeated time stamps left out", 0, str(log).index("\n"))


def test_arguments_are_checked(log, motion):
    options = [*({"rate": x} for x in (1e-9, 5e-324, 0)), {"sign_width": -1.0}, {"delay": 9.0}]
    options += [{name: x} for name in ("cutoff_qd", "cutoff_tau") for x in ("8", 600.0, 0.0)]
    for call in (
        *(partial(smooth, log, **x) for x in options),
        *(partial(train_test_split, motion, x) for x in (0.99, 0.0, 1.0, -1.0, "0.5")),
        partial(stack_samples, [motion, motion._replace(q=motion.q[:, :3])]),
        partial(stack_samples, []),
        *(partial(f, x) for f in (smooth, stack_samples, train_test_split) for x in ("std.csv", None, 3)),
    ):
        with refused(ArgumentError):
            call()
