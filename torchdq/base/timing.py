"""Times of calls that take turns, so that a noisy machine is noisy to all."""

import statistics
import time
from collections.abc import Callable, Sequence

TURN = 0.01  # time of one call's turn, long enough that the others' traces in the caches do not matter [s]


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
