"""Signals on even time stamps, low-passed without delay, differentiated, and fewer rows of them without aliases."""

from math import ceil, floor

import numpy as np

from torchdq.base.optional import imported

NEARLY = 1.05  # ratio of rates up to which signals are as fast as the times that they are drawn at
PASSED = 0.4  # highest frequency that is kept, relative to the rate of the rows that are kept: 0.5 would be an alias


def even(time: np.ndarray, stamps: np.ndarray, x: np.ndarray, purpose: str) -> np.ndarray:
    """Signals [rows, n] at other times, by cubics between their stamps that never overshoot.

    At stamps that are uneven by 60 %, twenty a period, their error is 0.35 of that of straight lines; splines,
    whose error is smaller still, overshoot where two stamps nearly agree.
    """
    interpolate = imported("scipy.interpolate", "scipy", purpose)
    with np.errstate(over="ignore"):  # the inverse of a slope that is nearly zero
        return interpolate.PchipInterpolator(stamps, x, axis=0)(time)


def low_pass(x: np.ndarray, cutoff: float, step: float, purpose: str, order: int = 4) -> np.ndarray:
    """Signals [rows, n] in even steps [s] through a Butterworth filter, forwards and backwards, so that nothing lags.

    At the cutoff [Hz] half of a signal passes. `purpose` is the function that needs the filter, for messages.
    """
    signal = imported("scipy.signal", "scipy", purpose)
    filtered = signal.sosfiltfilt(signal.butter(order, cutoff, fs=1 / step, output="sos"), x, axis=0)
    return np.ascontiguousarray(filtered)  # a view backwards, which torch does not take


def derivative(time: np.ndarray, x: np.ndarray, purpose: str) -> np.ndarray:
    """Rates of signals [rows, n], of the quintic spline through them.

    Ten rows a period leave an error of 1e-5; central differences would be 6 % too small.
    """
    interpolate = imported("scipy.interpolate", "scipy", purpose)
    return interpolate.make_interp_spline(time, x, k=5).derivative()(time)


def fewer_times(stamps: np.ndarray, rate: float) -> np.ndarray:
    """Even time stamps at a rate, from the first on [rows] [s]."""
    return stamps[0] + np.arange(int((stamps[-1] - stamps[0]) * rate * (1 + 1e-12)) + 1) / rate


def at_times(time: np.ndarray, stamps: np.ndarray, x: np.ndarray, purpose: str) -> np.ndarray:
    """Signals [rows, n] at other times, without what is too fast for those, which would look slow (an alias).

    Signals of more rows are drawn in even steps, a whole number of which is one of `time`, and filtered before.
    """
    step, own = float(np.median(np.diff(time))), float(np.median(np.diff(stamps)))
    if own * NEARLY > step:
        return even(time, stamps, x, purpose)
    fine = step / ceil(step / own - 1e-9)
    first, last = ceil((stamps[0] - time[0]) / fine), floor((stamps[-1] - time[0]) / fine + 1e-9)
    drawn = time[0] + np.arange(first, last + 1) * fine
    return even(time, drawn, low_pass(even(drawn, stamps, x, purpose), PASSED / step, fine, purpose, 8), purpose)
