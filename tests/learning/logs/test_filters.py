"""Signals on even stamps, low-passed, differentiated and thinned, held against sines and noise in closed form."""

import warnings

import numpy as np
import pytest

pytest.importorskip("scipy", reason="filters need scipy")

from torchdq.errors import ArgumentError
from torchdq.learning import Layout, LogError, read, smooth
from torchdq.learning.logs import motions
from torchdq.learning.logs.filters import decimated, derivative, even, fewer_times, low_pass


def uneven(rate: float, seconds: float, by: float = 0.6) -> np.ndarray:
    """Stamps in steps that are uneven by a part of their mean."""
    rng = np.random.default_rng(0)
    return np.cumsum(rng.uniform(1 - by, 1 + by, round(rate * seconds))) / rate


def sine(time: np.ndarray, *frequencies: float) -> np.ndarray:
    return np.sin(2 * np.pi * np.multiply.outer(time, frequencies))


def test_uneven_stamps_are_evened_more_precisely_than_by_straight_lines():
    """The claim of `even`, at twenty rows a period."""
    stamps = uneven(20, 200)
    time = np.arange(stamps[5], stamps[-5], 0.05)
    off = even(time, stamps, sine(stamps, 1.0), "test") - sine(time, 1.0)
    straight = np.interp(time, stamps, sine(stamps, 1.0)[:, 0])[:, None] - sine(time, 1.0)
    assert off.std() < 0.37 * straight.std()


def test_noise_at_stamps_that_nearly_agree_does_not_grow():
    stamps = uneven(100, 20)
    stamps[1::2] = stamps[::2] + 1e-7
    noise = np.random.default_rng(1).uniform(-1, 1, (len(stamps), 2))
    found = even(np.arange(stamps[0], stamps[-1], 1e-3), stamps, noise, "test")
    assert abs(found).max() <= 1 + 1e-12


def test_signals_that_hardly_change_are_evened_without_a_word():
    stamps = uneven(100, 2)
    found = even(stamps[:-1] + 1e-3, stamps, np.full((200, 1), 0.3) + 5e-324 * np.arange(200)[:, None], "test")
    np.testing.assert_array_equal(found, 0.3)
    tiny = np.cumsum(np.random.default_rng(3).uniform(0, 1e-310, (200, 1)), 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        even(stamps[:-1] + 1e-3, stamps, tiny, "test")


@pytest.mark.parametrize(("rows", "error"), [(5, 1.5e-3), (10, 2e-5), (20, 5e-7)])
def test_derivatives_of_sines(rows, error):
    """By rows a period; central differences are off by 6 % at ten."""
    time = np.arange(0, 20, 1 / rows)
    found = derivative(time, sine(time + 0.1, 1.0), "test") / (2 * np.pi)
    inside = slice(2 * rows, -2 * rows)
    assert abs(found[:, 0] - np.cos(2 * np.pi * (time + 0.1)))[inside].max() < error
    assert abs(np.gradient(sine(time, 1.0)[:, 0], time) / (2 * np.pi) - np.cos(2 * np.pi * time))[inside].max() > error


def test_a_sine_at_the_cutoff_is_halved_and_nothing_lags():
    time = np.arange(0, 40, 0.01)
    for frequency, gain in ((1.0, 1.0), (8.0, 0.5), (16.0, 0.0)):
        found = low_pass(sine(time, frequency), 8.0, 0.01, "test")[500:-500]
        np.testing.assert_allclose(found, gain * sine(time, frequency)[500:-500], atol=6e-3)


@pytest.mark.parametrize("rate", [8.0, 37.0, 100.0])
def test_fewer_rows_keep_what_is_slow_and_nothing_of_what_is_fast(rate):
    stamps = uneven(1000, 20)
    slow, fast = 0.25 * rate, 0.9 * rate  # without the filter, the fast one would look like 0.1 of the rate
    time = fewer_times(stamps, rate)
    assert np.allclose(np.diff(time), 1 / rate) and stamps[-1] - time[-1] < 1 / rate
    found = decimated(stamps, sine(stamps, slow, fast), rate, "test")[20:-20]
    np.testing.assert_allclose(found[:, 0], sine(time, slow)[20:-20, 0], atol=5e-3)
    assert abs(found[:, 1]).max() < 1e-2
    noise = np.random.default_rng(2).normal(size=(len(stamps), 1))
    assert decimated(stamps, noise, rate, "test").std() < 1.2 * np.sqrt(rate / 1000)


def arrays(time: np.ndarray) -> dict[str, np.ndarray]:
    q = sine(time, 0.5, 0.8)
    qd = 2 * np.pi * np.array([0.5, 0.8]) * np.cos(2 * np.pi * np.multiply.outer(time, (0.5, 0.8)))
    return {"time": time, "q": q, "qd": qd, "tau": 3 * q}


def test_logs_are_read_at_a_rate():
    stamps = uneven(2000, 5)
    log = read(arrays(stamps), rate=50.0)
    assert np.allclose(np.diff(log.time), 0.02) and len(log.time) == pytest.approx(250, abs=3)
    inside = slice(10, -10)
    for name, x in arrays(log.time).items():
        np.testing.assert_allclose(getattr(log, name)[inside], x[inside], atol=1e-3)
    motion = smooth(log)
    np.testing.assert_allclose(
        motion.qdd, -((2 * np.pi * np.array([0.5, 0.8])) ** 2) * arrays(motion.time)["q"], atol=0.05
    )


@pytest.mark.parametrize("rate", [0.0, -1.0, "50", 5000.0, 1.0, float("nan")])
def test_rates_are_checked(rate):
    with pytest.raises(ArgumentError, match="rate must be"):
        read(arrays(uneven(1000, 5)), rate=rate)
    with pytest.raises(LogError, match="25 rows, more than 30 are needed to read it at a rate"):
        read(arrays(uneven(1000, 0.025)), rate=100.0)


# --- smoothing -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "cutoff"), [(1000.0, 8.0), (20.0, 5.0), (12.5, 3.125)])
def test_cutoffs_fit_the_rate_and_are_told(rate, cutoff):
    motion = smooth(read(arrays(np.arange(0, 20, 1 / rate))))
    assert motion.cutoff_qd == motion.cutoff_tau == pytest.approx(cutoff)
    assert f"velocities at {cutoff:.4g} Hz, torques at {cutoff:.4g} Hz" in str(motion)
    np.testing.assert_allclose(
        motion.qdd, -((2 * np.pi * np.array([0.5, 0.8])) ** 2) * arrays(motion.time)["q"], atol=0.1
    )
    chosen = smooth(read(arrays(np.arange(0, 20, 1 / rate)), Layout(cutoff_tau=2.0)), cutoff_qd=3.0, width=0.02)
    assert (chosen.cutoff_qd, chosen.cutoff_tau, chosen.width) == (3.0, 2.0, 0.02)


def reaching(seconds: float, rest: float, step: float = 1e-3) -> dict[str, np.ndarray]:
    """Motion from rest to rest, its acceleration a sine."""
    time = np.arange(0, seconds + 2 * rest, step)
    s = np.clip((time - rest) / seconds, 0, 1)[:, None]
    w = 2 * np.pi
    q, qd, qdd = s - np.sin(w * s) / w, (1 - np.cos(w * s)) / seconds, w * np.sin(w * s) / seconds**2
    return {"time": time, "q": q, "qd": qd, "tau": qdd + 2 * q}


def test_a_short_motion_between_rests_is_kept_whole():
    found = smooth(read(reaching(0.8, 0.3)), cutoff_qd=20.0, cutoff_tau=20.0)
    assert found.time[-1] - found.time[0] > 0.7  # the rest of it is slower than `AT_REST`
    exact = reaching(0.8, 0.3)
    rows = np.rint(found.time / 1e-3).astype(int)
    for name in ("q", "qd", "tau"):
        np.testing.assert_allclose(getattr(found, name), exact[name][rows], atol=0.02 * np.ptp(exact[name]))


def test_ends_in_motion_are_left_out():
    whole = reaching(2.0, 0.4)
    part = {name: x[:1700] for name, x in whole.items()}  # it ends while it moves
    found = smooth(read(part))
    assert found.time[0] < 0.5 and found.time[-1] <= 1.7 - motions.ENDS
    with pytest.raises(LogError, match=r"0.849 s of motion, more than 1 s are needed"):
        smooth(read({name: x[:850] for name, x in whole.items()}))
    with pytest.raises(LogError, match=r"0.499 s of motion, more than 1.5 s are needed"):
        smooth(read({name: x[700:1200] for name, x in whole.items()}))
