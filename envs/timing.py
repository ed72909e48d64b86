"""Times of calls that are compared."""

import statistics
import time
from collections.abc import Callable, Sequence


def medians(calls: Sequence[Callable[[], object]], batch: int, seconds: float) -> list[float]:
    """Median time of every call per sample [ns]; calls alternate, so that noise of the machine affects all alike."""
    inner = []
    for call in calls:
        call()
        start = time.perf_counter()
        call()
        inner.append(max(1, int(0.01 / max(time.perf_counter() - start, 1e-7))))
    found: list[list[float]] = [[] for _ in calls]
    end = time.perf_counter() + seconds * len(calls)
    while time.perf_counter() < end or len(found[0]) < 5:
        for times, call, number in zip(found, calls, inner, strict=True):
            start = time.perf_counter()
            for _ in range(number):
                call()
            times.append((time.perf_counter() - start) / number / batch * 1e9)
    return [statistics.median(times) for times in found]
