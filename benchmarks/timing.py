"""How long calls take beside each other."""

import time
from collections.abc import Callable

TURN = 0.02  # of one contender before it is the next one's turn [s]


def measure(contenders: dict[str, Callable[[], object]], batch: int, seconds: float) -> dict[str, list[float]]:
    """Times per sample [ns] of contenders that take turns."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    inner = {}
    for name, call in contenders.items():
        call()
        start = time.perf_counter()
        call()
        # a turn lasts long enough that what the others left in the caches does not matter
        inner[name] = max(1, int(TURN / max(time.perf_counter() - start, 1e-7)))
    end = time.perf_counter() + seconds * len(contenders)
    while time.perf_counter() < end or min(map(len, times.values())) < 5:
        for name, call in contenders.items():
            start = time.perf_counter()
            for _ in range(inner[name]):
                call()
            times[name].append((time.perf_counter() - start) / inner[name] / batch * 1e9)
    return times
