"""Linear algebra of small matrices on one thread."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

import torch

_lock = Lock()
_inside, _usual = 0, 1  # contexts that are open in all threads of Python, and torch's number of threads outside of them


@contextmanager
def one_thread() -> Iterator[None]:
    """Context, also a decorator, in which torch computes on one thread; that holds for the whole process.

    Factors of matrices of a hundred rows take torch's linear algebra 3 to 60 times as long on two threads that other
    processes keep busy. Several threads of Python may be inside at once: each one that leaves sets the number of before
    the first one entered; those that are still inside are slower then, and find the same numbers.
    """
    global _inside, _usual
    with _lock:
        if not _inside:
            _usual = torch.get_num_threads()
        _inside += 1
    try:
        torch.set_num_threads(1)
        yield
    finally:
        with _lock:
            _inside -= 1
            torch.set_num_threads(_usual)
