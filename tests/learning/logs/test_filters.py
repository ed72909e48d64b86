"""Signals on even stamps, low-passed, differentiated and thinned, held against sines and noise in closed form."""

import warnings

import numpy as np
import pytest
from helpers import all_in_one

pytest.importorskip("scipy", reason="filters need scipy")

from torchdq.learning.logs.filters import at_times, derivative, even, fewer_times, low_pass


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


@all_in_one([8.0, 37.0, 100.0])
def test_fewer_rows_keep_what_is_slow_and_nothing_of_what_is_fast(rate):
    stamps = uneven(1000, 20)
    slow, fast = 0.25 * rate, 0.9 * rate  # without the filter, the fast one would look like 0.1 of the rate
    time = fewer_times(stamps, rate)
    assert np.allclose(np.diff(time), 1 / rate) and stamps[-1] - time[-1] < 1 / rate
    found = at_times(time, stamps, sine(stamps, slow, fast), "test")[20:-20]
    np.testing.assert_allclose(found[:, 0], sine(time, slow)[20:-20, 0], atol=5e-3)
    assert abs(found[:, 1]).max() < 1e-2
    noise = np.random.default_rng(2).normal(size=(len(stamps), 1))
    assert at_times(time, stamps, noise, "test").std() < 1.2 * np.sqrt(rate / 1000)
