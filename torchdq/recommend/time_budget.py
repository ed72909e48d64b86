"""Time that a search may take, and what it does with it."""

from __future__ import annotations

import math
import time
from collections.abc import Hashable

from torchdq.base.progress import Progress

ESSENTIAL = 2**11  # steps up to which a trajectory is computed even if the time is up, so that something is found


class TimeIsUp(Exception):
    """No time for a trial that is not essential."""


class Budget:
    """Time for trials, and their pace so far, from which the duration of the next one is predicted.

    Args:
        seconds: time from now on [s].
        notice: told what is being tried.
    """

    def __init__(self, seconds: float = math.inf, notice: Progress | None = None):
        self.seconds = seconds
        self._notice = notice
        self._end = time.monotonic() + seconds
        self._paces: dict[Hashable, float] = {}  # [s] per step

    @property
    def left(self) -> float:
        """Time that is left [s]; negative if it is up."""
        return self._end - time.monotonic()

    def at(self, where: str) -> None:
        """State what is being tried."""
        if self._notice is not None:
            self._notice.at(where)

    def took(self, kind: Hashable, steps: int, duration: float) -> None:
        """Note the duration of some steps of a kind [s]."""
        self._paces[kind] = duration / steps

    def allows(self, kind: Hashable, steps: int, share: float = 1.0) -> bool:
        """True if so many steps of a kind fit into a share of the time that is left."""
        return self._paces.get(kind, 0.0) * steps <= share * self.left
