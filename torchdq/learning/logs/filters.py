"""Signals on even time stamps, low-passed without delay, differentiated, and fewer rows of them without aliases."""

from math import ceil

import numpy as np

from torchdq.base.optional import imported

ORDER = 4  # the filter of `low_pass` has it, and is applied twice
STEEP = 8  # the same, of the one before rows are left out
PASSED = 0.4  # highest frequency that is kept, relative to the rate of the rows that are kept: 0.5 would be an alias


def even(time: np.ndarray, stamps: np.ndarray, x: np.ndarray, purpose: str) -> np.ndarray:
    """Signals [rows, n] at other times, by cubics between their stamps that never overshoot.

    At stamps that are uneven by 60 %, twenty a period, their error is 0.35 of that of straight lines; splines,
    whose error is smaller still, overshoot where two stamps nearly agree.
    """
    interpolate = imported("scipy.interpolate", "scipy", purpose)
    with np.errstate(over="ignore"):  # the inverse of a slope that is nearly zero
        found: np.ndarray = interpolate.PchipInterpolator(stamps, x, axis=0)(time)
    return found


def low_pass(x: np.ndarray, cutoff: float, step: float, purpose: str, order: int = ORDER) -> np.ndarray:
    """Signals [rows, n] in even steps [s] through a Butterworth filter, forwards and backwards, so that nothing lags.

    At the cutoff [Hz] half of a signal passes. `purpose` is the function that needs the filter, for messages.
    """
    signal = imported("scipy.signal", "scipy", purpose)
    found: np.ndarray = signal.sosfiltfilt(signal.butter(order, cutoff, fs=1 / step, output="sos"), x, axis=0)
    return np.ascontiguousarray(found)  # a view backwards, which torch does not take


def derivative(time: np.ndarray, x: np.ndarray, purpose: str) -> np.ndarray:
    """Rates of signals [rows, n], of the quintic spline through them.

    Ten rows a period leave an error of 1e-5; central differences would be 6 % too small.
    """
    interpolate = imported("scipy.interpolate", "scipy", purpose)
    found: np.ndarray = interpolate.make_interp_spline(time, x, k=5).derivative()(time)
    return found


def fewer_times(stamps: np.ndarray, rate: float) -> np.ndarray:
    """Even time stamps at a rate, from the first on [rows] [s]."""
    return stamps[0] + np.arange(int((stamps[-1] - stamps[0]) * rate * (1 + 1e-12)) + 1) / rate


def decimated(stamps: np.ndarray, x: np.ndarray, rate: float, purpose: str) -> np.ndarray:
    """Signals [rows, n] at `fewer_times`, without what is too fast for the rate, which would look slow (an alias).

    They are drawn at a multiple of the rate that is as fast as the rows, filtered, and every so many are kept.
    """
    times = ceil(1 / (rate * np.median(np.diff(stamps))) - 1e-9)
    step = 1 / (rate * times)
    time = stamps[0] + np.arange((len(fewer_times(stamps, rate)) - 1) * times + 1) * step
    return low_pass(even(time, stamps, x, purpose), PASSED * rate, step, purpose, STEEP)[::times]
