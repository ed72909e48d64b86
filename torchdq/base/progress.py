"""Progress of long work as lines on stderr, and warnings that are given once."""

from __future__ import annotations

import sys
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Self

from torchdq.base.caches import remembered

FIRST = 2.0  # time from which work is announced [s]
EVERY = 5.0  # time between two lines [s]


@remembered(1)
def _topics() -> set[str]:
    """Topics of the warnings that were given."""
    return set()


def warn_once(topic: str, text: str, stacklevel: int = 3) -> None:
    """Warn, unless this process was warned about the topic since its start or the last `clear_caches`."""
    if topic not in _topics():
        _topics().add(topic)
        warnings.warn(text, stacklevel=stacklevel)


class Progress:
    """Context that writes what is being done, and how far it is, after 2 s and then every 5 s.

    Nothing is written about work that ends before. The lines come from a thread of their own, so they also come while
    another program or a long operation runs; KeyboardInterrupt ends the work as always.

    >>> with Progress("counting") as progress:
    ...     for k in range(3):
    ...         progress.at(f"{k} of 3")
    """

    def __init__(self, what: str):
        self.what = what
        self.where: str | Callable[[], str] = ""

    def at(self, where: str | Callable[[], str]) -> None:
        """State how far the work is, for the next line; a function is called when the line is written."""
        self.where = where

    def within(self, part: str) -> Callable[[str], None]:
        """Function `at` for the steps of a part of the work, which is named before them."""
        return lambda where: self.at(f"{part}, {where}")

    def _write(self) -> None:
        start, pause = time.monotonic(), FIRST
        while not self._ended.wait(pause):
            pause = EVERY
            where = self.where if isinstance(self.where, str) else self.where()
            parts = (self.what, where, f"{time.monotonic() - start:.0f} s")
            with suppress(AttributeError, ValueError, OSError):  # a stream that is absent or closed
                sys.stderr.write(f"torchdq: {', '.join(part for part in parts if part)} ...\n")
                sys.stderr.flush()

    def __enter__(self) -> Self:
        self._ended = threading.Event()  # here, since torch.compile cannot trace locks
        threading.Thread(target=self._write, daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._ended.set()
