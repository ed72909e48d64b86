"""Times of calls that take turns, so that a noisy machine is noisy to all."""

import math
import statistics
import time
from collections.abc import Callable, Sequence

TURN = 0.01  # time of one call's turn, long enough that the others' traces in the caches do not matter [s]


def digits(x: float, error: float | None = None) -> str:
    """Number with two digits, or with as many as an error leaves that has two.

    >>> digits(23502.6), digits(0.0155), digits(-1.662771, 0.0094)
    ('24000', '0.015', '-1.6628')
    """
    if error is None or not 0 < error < math.inf:
        return f"{float(f'{x:.2g}'):g}" if error is None else f"{x:.6g}"
    return f"{x:.{min(max(0, 1 - math.floor(math.log10(error))), 6)}f}"


def duration(nanoseconds: float, spread: float) -> str:
    """Time with its spread, in a unit that suits it; one whose spread exceeds half of it is noisy.

    >>> duration(23502.6, 3245.4), duration(50.13, 14.4), duration(271.0, 500.0)
    ('24 +- 3 us', '50 +- 10 ns', '270 ns, noisy')
    """
    unit, factor = ("us", 1e-3) if nanoseconds >= 1000 else ("ns", 1.0)
    if spread > nanoseconds / 2:
        return f"{digits(factor * nanoseconds)} {unit}, noisy"
    return f"{digits(factor * nanoseconds)} +- {float(f'{factor * spread:.1g}'):g} {unit}"


def measure(calls: dict[str, Callable[[], object]], batch: int, seconds: float) -> dict[str, list[float]]:
    """Times of every call per sample [ns], at least five of each, for so many seconds per call."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    repeats = {}
    for name, call in calls.items():
        call()
        start = time.perf_counter()
        call()
        repeats[name] = max(1, int(TURN / max(time.perf_counter() - start, 1e-7)))
    end = time.perf_counter() + seconds * len(calls)
    while time.perf_counter() < end or min(map(len, times.values())) < 5:
        for name, call in calls.items():
            start = time.perf_counter()
            for _ in range(repeats[name]):
                call()
            times[name].append((time.perf_counter() - start) / repeats[name] / batch * 1e9)
    return times


def medians(calls: Sequence[Callable[[], object]], batch: int, seconds: float) -> list[float]:
    """Median time of every call per sample [ns]."""
    times = measure({str(i): call for i, call in enumerate(calls)}, batch, seconds)
    return [statistics.median(found) for found in times.values()]
