"""What several test files build with: tensors, the integrators of fixed steps, and a single thread."""

import pytest
import torch

from torchdq.envs.integrators import ExplicitEuler, LinearlyImplicit, RungeKutta4, SemiImplicitEuler, StoermerVerlet

FIXED = (ExplicitEuler(), SemiImplicitEuler(), LinearlyImplicit(), RungeKutta4(), StoermerVerlet())


def called(integrator):
    """Name of an integrator, for a test's."""
    return type(integrator).__name__


def double(*x):
    """Vector of numbers, in double precision."""
    return torch.tensor(x, dtype=torch.float64)


def random(*shape, seed=0, dtype=torch.float64):
    """Normal numbers that are the same in every precision but for rounding."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """For the file that has it: several would only wait for each other on small tensors, or in a forked child."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
