"""Threads that share the samples of a batch."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch

from torchdq.base.caches import emptied_by
from torchdq.base.system import after_fork

PER_THREAD = 1e6  # vector operations per thread: waking a thread takes as long as tens of thousands of them
BLOCK = 64  # samples; threads get whole blocks, so that no vector is shared
PART = 64 * BLOCK  # samples per partial sum

_pools: list[ThreadPoolExecutor] = []  # empty until the first large batch, then one pool


def _pool() -> ThreadPoolExecutor:
    if not _pools:
        _pools.append(ThreadPoolExecutor(max(2, os.cpu_count() or 2), thread_name_prefix="torchdq"))
    return _pools[0]


def running() -> bool:
    """Whether there are threads."""
    return bool(_pools)


def stop() -> None:
    """End the threads; the next large batch starts new ones."""
    while _pools:
        _pools.pop().shutdown()


emptied_by(stop)
after_fork(_pools.clear)  # threads do not survive a fork


def least(operations: int) -> int:
    """Least number of samples for a thread, of so many operations each."""
    return max(BLOCK, int(8 * PER_THREAD / max(1, operations)))


def shares(samples: int, operations: int, sums: bool) -> tuple[int, int]:
    """Number of threads for a batch with so many operations per sample, and number of samples in each of its parts.

    Where results are summed, the size of a part is fixed, so that sums do not depend on the number of threads.
    """
    if samples <= BLOCK:
        return 1, BLOCK
    threads = min(torch.get_num_threads(), samples // least(operations))
    size = samples
    if sums:
        size = PART
    elif threads > 1:
        size = -(-samples // (threads * BLOCK)) * BLOCK
    return threads, size


def run(job: Callable[[int], None], parts: int, threads: int) -> None:
    """Run a job for every part; the parts are shared among the threads, the calling one included."""
    threads = max(threads, 1)

    def some(first: int) -> None:
        for k in range(first, parts, threads):
            job(k)

    waiting = [_pool().submit(some, k) for k in range(1, threads)]
    some(0)
    for done in waiting:
        done.result()
