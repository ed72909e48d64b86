"""Torch's number of threads is that of before when a fit ends, however it ends and whatever runs beside it."""

import threading

import pytest
import torch

from torchdq.learning.threads import one_thread


@pytest.fixture
def three():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield 3
    torch.set_num_threads(before)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_error_leaves_the_number_of_before(three, error):
    @one_thread()
    def failing():
        assert torch.get_num_threads() == 1
        with one_thread():
            raise error

    for _ in range(2):
        with pytest.raises(error):
            failing()
        assert torch.get_num_threads() == three


def test_fits_in_two_threads_that_overlap_leave_the_number_of_before(three):
    entered, left, found = threading.Event(), threading.Event(), []

    def second():
        with one_thread():
            entered.set()
            left.wait(10)
        found.append(torch.get_num_threads())

    other = threading.Thread(target=second)
    with one_thread():
        other.start()
        assert entered.wait(10)
    left.set()
    other.join()
    later = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    later.start()
    later.join()
    assert found == [three, three] and torch.get_num_threads() == three
