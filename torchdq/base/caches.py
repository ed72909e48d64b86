"""Process-wide caches: their sizes, and the function that empties all of them.

They hold programs, derivatives, kernels with their libraries, layouts of calls, names of programs in traced graphs, and
what is known of the machine. Each has a bound: those of `remembered` functions remove the entry that was used least
recently, `Bounded` ones the oldest. Compiled programs stay on disk, see `backends.cache`.
"""

from collections.abc import Callable, Hashable
from functools import lru_cache, wraps
from typing import Any, TypeVar

PROGRAMS = 1024  # programs; as many derivatives and kernels
LAYOUTS = 4096  # layouts of calls, and names of programs in graphs

Cached = TypeVar("Cached", bound=Callable[..., Any])
Key = TypeVar("Key", bound=Hashable)
Kept = TypeVar("Kept")

_emptying: list[Callable[[], object]] = []


def emptied_by(empty: Callable[[], object]) -> None:
    """Register a function that `clear_caches` calls."""
    _emptying.append(empty)


def remembered(size: int) -> Callable[[Cached], Cached]:
    """Decorator that caches the results of a function for the last `size` arguments."""

    def decorate(function: Cached) -> Cached:
        cached = lru_cache(size)(function)
        emptied_by(cached.cache_clear)
        return wraps(function)(cached)  # type: ignore[return-value]

    return decorate


class Bounded(dict[Key, Kept]):
    """Dictionary of bounded size; a new entry removes the oldest one if it is full."""

    def __init__(self, size: int):
        super().__init__()
        self.size = size
        emptied_by(self.clear)

    def __setitem__(self, key: Key, value: Kept) -> None:
        if len(self) >= self.size:
            self.pop(next(iter(self)), None)
        super().__setitem__(key, value)


def clear_caches() -> None:
    """Remove every program, kernel and layout of this process, and stop its threads.

    Later calls record their programs again and load the libraries from disk, which takes milliseconds to seconds. A
    graph that was traced before must be traced again.

    >>> import torchdq
    >>> torchdq.clear_caches()
    """
    for empty in _emptying:
        empty()
