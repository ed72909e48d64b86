"""Tensors, integrators of fixed steps, a wheel, chains of rods, and threads, for several test files."""

import inspect
import os
import signal
import threading
from contextlib import contextmanager
from functools import cache, partial

import numpy as np
import pytest
import torch

import torchdq
from torchdq.backends import threads as pool
from torchdq.backends.c import COMPILED
from torchdq.backends.precision import run
from torchdq.backends.torch import EAGER
from torchdq.scene.integrators import ExplicitEuler, LinearlyImplicit, RungeKutta4, SemiImplicitEuler, StoermerVerlet

EVERYTHING = os.environ.get("TORCHDQ_TESTS") == "all"  # as in `make test-all`
exhaustive = pytest.mark.skipif(not EVERYTHING, reason="takes long: make test-all")

DOWN = (0.0, -9.81, 0.0)  # gravity in the plane in which rods with axes along z move

compiled, eager = partial(run, backend=COMPILED), partial(run, backend=EAGER)  # results of a program

# a wheel about its axis: its acceleration is a hundred times its torque
INERTIA = 0.01  # [kg m^2]
WHEEL = torchdq.Robot.from_screws(
    [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]], [1.0], [[0.0, 0.0, 0.0]], [np.diag([INERTIA] * 3)], name="wheel"
)

PAIR = """
<robot name="pair">
  <link name="base"/>
  <link name="a"><inertial><origin xyz="0.3 0 0"/><mass value="2"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.06" iyz="0" izz="0.06"/></inertial></link>
  <link name="b"><inertial><origin xyz="0.2 0 0"/><mass value="1"/>
    <inertia ixx="0.005" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>
  <joint name="one" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/></joint>
  <joint name="two" type="continuous"><parent link="a"/><child link="b"/>
    <origin xyz="0.6 0 0"/><axis xyz="0 1 0"/></joint>
</robot>
"""

FIXED = (ExplicitEuler(), SemiImplicitEuler(), LinearlyImplicit(), RungeKutta4(), StoermerVerlet())


def called(integrator):
    """Name of an integrator, for a test's."""
    return type(integrator).__name__


def thinned(values, kept):
    """Parameters of a test; those that are not kept are left to `make test-all`."""
    return [value for value in values if EVERYTHING or value in kept]


def all_in_one(values):
    """Makes a test of one value the test of all, which names the first that fails: for a thousand that take no time.

    The value is the first argument of the test; others are fixtures.
    """

    def decorated(test):
        def of_all(**fixtures):
            for value in values:
                try:
                    test(value, **fixtures)
                except BaseException as error:
                    error.add_note(f"{test.__name__} with {value!r}")
                    raise

        _, *fixtures = inspect.signature(test).parameters.values()
        of_all.__signature__ = inspect.Signature(fixtures)
        of_all.__name__, of_all.__doc__, of_all.__module__ = test.__name__, test.__doc__, test.__module__
        return of_all

    return decorated


def double(*x):
    """Vector of numbers, in double precision."""
    return torch.tensor(x, dtype=torch.float64)


def largest(x):
    """Largest magnitude of the numbers of a tensor."""
    return x.detach().abs().max().item()


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


@contextmanager
def interrupted(seconds):
    """Ctrl-C after some seconds, which this process may have been started to ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        signal.signal(signal.SIGINT, before)


@pytest.fixture
def fresh():
    """A compiler of torch that remembers nothing of other tests."""
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


@pytest.fixture
def threads(monkeypatch):
    """Sets the number of threads, which even small batches are worth meanwhile; it is put back."""
    before = torch.get_num_threads()
    monkeypatch.setattr(pool, "PER_THREAD", 1e4)
    yield torch.set_num_threads
    torch.set_num_threads(before)


def rod_axes(n, planar=False):
    """Axes of the joints of `rods`: all along z, or anywhere."""
    if planar:
        return np.tile([0.0, 0.0, 1.0], (n, 1))
    axes = np.random.default_rng(n).normal(size=(n, 3))
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


@cache
def rods(n, planar=False, tip=1.0):
    """Robot of n thin rods of a metre and a kilogram in a row, the last one of another mass."""
    points = np.stack([np.arange(n), np.zeros(n), np.zeros(n)], 1)
    axes, mass = rod_axes(n, planar), np.array([1.0] * (n - 1) + [tip])
    return torchdq.Robot.from_screws(
        np.concatenate([axes, np.cross(points, axes)], 1),
        mass,
        np.tile([0.5, 0, 0], (n, 1)),
        np.outer(mass / 12, [0, 0, 1, 0, 0, 1]),
        link_poses=[[1.0, 0, 0, 0, 0, x / 2, 0, 0] for x in range(n)],
        gravity=DOWN,
    )
