"""Processor times of calls: warmed up, repeated, the least of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

WARM_UPS, LONG, TURN = 3, 0.2, 1e-3  # calls; seconds after which one is enough; seconds that a timing lasts at least


class Time(NamedTuple):
    """Nanoseconds."""

    nanoseconds: float  # the least, since others only add to it
    repeats: int

    def times(self, factor: float) -> Time:
        """All of it so many times."""
        return Time(self.nanoseconds * factor, self.repeats)


def clock(call: Callable[[], object], samples: int, repeats: int = 20) -> Time:
    """Processor time of a call per sample."""
    for _ in range(WARM_UPS):
        start = time.process_time()
        call()
        once = time.process_time() - start
        if once > LONG:
            break
    inner = max(1, int(TURN / max(once, 1e-7)))
    found = []
    for _ in range(repeats):
        start = time.process_time()
        for _ in range(inner):
            call()
        found.append((time.process_time() - start) / inner / samples * 1e9)
    return Time(min(found), repeats)
