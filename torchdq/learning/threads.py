"""Linear algebra of small matrices on one thread."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Context, also a decorator, in which torch computes on one thread.

    Factors of matrices of a hundred rows take torch's linear algebra 3 to 60 times as long on two threads that other
    processes keep busy: each factor waits for both. The programs of a robot take few of the seconds of a fit.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
