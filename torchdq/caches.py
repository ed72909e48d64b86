"""Process-wide caches: what a process remembers, how much of it, and the one call that forgets it.

constants of programs and calls
    programs      of functions, scenes and resets, by their content: robot constants, options, widths of arguments
    derivatives   of programs, by program and arguments
    kernels       of programs, by backend, precision and device
    layouts       of calls, by the shapes, dtypes and devices of their tensors
    graphs        programs that traced graphs call by name; a graph whose program is forgotten must be traced again
facts
    compiler and processor of this machine
and the threads that share a batch, which are stopped. The built libraries on disk stay; see `backends.cache`.

Every cache has a bound. Of programs, what was used least recently goes first; of layouts and names, the oldest.
"""

from collections.abc import Callable, Hashable
from functools import lru_cache, wraps
from typing import Any, TypeVar

PROGRAMS = 1024  # programs, derivatives and kernels, each
LAYOUTS = 4096  # layouts of calls, and names of programs in graphs

Cached = TypeVar("Cached", bound=Callable[..., Any])
Key = TypeVar("Key", bound=Hashable)
Kept = TypeVar("Kept")

_emptying: list[Callable[[], object]] = []


def emptied_by(empty: Callable[[], object]) -> None:
    """Have `clear_caches` call a function as well."""
    _emptying.append(empty)


def remembered(size: int) -> Callable[[Cached], Cached]:
    """Decorator: a function that remembers its results for so many arguments."""

    def decorate(function: Cached) -> Cached:
        cached = lru_cache(size)(function)
        emptied_by(cached.cache_clear)
        return wraps(function)(cached)  # type: ignore[return-value]

    return decorate


class Bounded(dict[Key, Kept]):
    """A dictionary that loses its oldest entry when it is full."""

    def __init__(self, size: int):
        super().__init__()
        self.size = size
        emptied_by(self.clear)

    def __setitem__(self, key: Key, value: Kept) -> None:
        if len(self) >= self.size:
            self.pop(next(iter(self)), None)
        super().__setitem__(key, value)


def clear_caches() -> None:
    """Forget every program, kernel and layout of this process, and stop its threads.

    What is called afterwards is recorded and opened again, which takes milliseconds to seconds; the libraries that
    were compiled stay on disk. A graph that was traced before must be traced again.

    >>> import torchdq
    >>> torchdq.clear_caches()
    """
    for empty in _emptying:
        empty()
