"""Forward dynamics tells how far it magnifies rounding errors, sample by sample, and acts on it."""

import itertools

import numpy as np
import pytest
import torch
from helpers import rods, thinned
from messages import refused
from precisions import C

import torchdq
from torchdq import Scene, effects
from torchdq.backends.choice import choose
from torchdq.backends.precision import run
from torchdq.functions.posed import posed
from torchdq.program.program import GROWTH, LARGEST_GROWTH, Argument, record
from torchdq.scene.integrators import LinearlyImplicit, RungeKutta4, SemiImplicitEuler

EPS = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}
every_backend = pytest.mark.parametrize("backend", ["eager", C])


def inputs(robot, batch, dtype=torch.float32, seed=0):
    g = torch.Generator().manual_seed(seed)
    q, qd, tau = (torch.randn(batch, robot.n, generator=g, dtype=torch.float64) for _ in range(3))
    return [x.to(dtype) for x in (2 * q, qd, 10 * tau)]


# some of its samples are beyond what float32 may magnify, all are far from singular
MIXED = rods(6, tip=1000.0)


def split(robot, q):
    lost = torchdq.error_growth(robot, q) > LARGEST_GROWTH.single
    assert 4 < lost.sum() < len(q) - 4, "the robot has to give both kinds of samples"
    return lost


# --- what it is -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", [rods(4), rods(12), torchdq.robots.load("panda")], ids=["4", "12", "panda"])
def test_growth_is_the_diagonal_over_the_pivots_of_the_mass_matrix(robot):
    q = inputs(robot, 20, torch.float64)[0]
    M = torchdq.mass_matrix(robot, q).numpy()
    # eliminated from the last joint: Cholesky of the matrix turned round
    factors = np.linalg.cholesky(M[:, ::-1, ::-1])
    pivots = np.diagonal(factors, axis1=1, axis2=2)[:, ::-1] ** 2
    expected = (np.diagonal(M, axis1=1, axis2=2) / pivots).max(-1)
    found = torchdq.error_growth(robot, q).numpy()
    assert (abs(found - expected) / expected <= 32 * robot.n * EPS[torch.float64] * expected).all()


def test_articulated_bodies_and_the_mass_matrix_have_the_same_pivots():
    robot = rods(10)
    q = inputs(robot, 1, torch.float64)[0][0]
    m = posed(robot, q.unbind(-1), {}, ())
    entries, bodies = (torch.tensor([float(r) for r in m.factors(linear).inverses]) for linear in (False, True))
    assert ((entries - bodies).abs() / entries).max() <= 1e3 * EPS[torch.float64] * torchdq.error_growth(robot, q)


def test_a_single_joint_magnifies_nothing():
    assert torchdq.error_growth(rods(1), torch.zeros(3, 1)).tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("joints", "backend"), [(1, "eager"), (2, "eager"), (5, "eager"), pytest.param(2, "c", marks=C.marks)]
)
def test_a_mass_matrix_that_is_negative_has_no_accelerations(backend, joints):
    for scale in (-1.0, -1e-6, -1e5):
        require_no_accelerations(rods(joints), scale, backend)
    robot = rods(joints).replace(armature=torch.full((joints,), -1e3, dtype=torch.float64), on_unphysical="ignore")
    assert torchdq.forward_dynamics(robot, *inputs(robot, 3, torch.float64), backend=backend).isnan().all()


def require_no_accelerations(robot, scale, backend):
    """Negative masses give NaN in their own rows of the batch, and finite values in all others."""
    q, qd, tau = inputs(robot, 3, torch.float64)
    factor = torch.tensor([[scale], [1.0], [scale]], dtype=torch.float64)
    mixed = robot.replace(mass=factor * robot.mass, inertia=factor.unsqueeze(-1) * robot.inertia)
    growth = torchdq.error_growth(mixed, q, backend=backend)
    assert (growth[[0, 2]] >= 1e30).all()
    torch.testing.assert_close(growth[1], torchdq.error_growth(robot, q[1], backend=backend), rtol=1e-9, atol=0)
    qdd = torchdq.forward_dynamics(mixed, q, qd, tau, backend=backend)
    assert qdd[[0, 2]].isnan().all() and qdd[1].isfinite().all()


# --- what follows -----------------------------------------------------------------------------------------------------


@every_backend
def test_samples_that_float32_would_lose_are_those_of_float64_rounded(backend):
    q, qd, tau = inputs(MIXED, 60)
    lost = split(MIXED, q)
    found = torchdq.forward_dynamics(MIXED, q, qd, tau, backend=backend)
    wide = torchdq.forward_dynamics(MIXED, q.double(), qd.double(), tau.double(), backend=backend)
    assert torch.equal(found[lost], wide[lost].float())
    assert not torch.equal(found[~lost], wide[~lost].float())


@every_backend
def test_a_sample_whose_growth_is_no_number_is_recomputed_too(backend):
    """Two pivots that float32 rounds to zero divide zero by zero."""

    def algorithm(x):
        rest = (1.0 + x[0]) - 1.0
        return {"y": [x[0] / rest], GROWTH: [(rest + rest) / rest]}

    program = record("rest", [Argument("x", 1)], algorithm)
    x = torch.tensor([[0.5], [1e-9], [0.25]])
    (found,) = run(program, [x], choose(backend, x.device))
    (wide,) = run(program, [x.double()], choose(backend, x.device))
    assert torch.equal(found, wide.float()) and bool(found.isfinite().all())


@every_backend
def test_constant_pivots_are_watched_too(backend):
    """Slides on one line: their mass matrix is the same in every position."""
    robot = torchdq.Robot.from_screws(
        [[0, 0, 0, 1, 0, 0], [0, 0, 0, 1, 0, 0]],
        [1.0, 1e7],
        np.zeros((2, 3)),
        [np.eye(3), 1e7 * np.eye(3)],
        gravity=None,
    )
    q = torch.zeros(2)
    tau = torch.tensor([0.0, 1.0])
    found = torchdq.forward_dynamics(robot, q, None, tau, backend=backend)
    assert torch.allclose(found, torch.tensor([-1.0, 1.0 + 1e-7]), rtol=1e-6)


# --- precision --------------------------------------------------------------------------------------------------------


@every_backend
def test_double_precision_inside_is_the_rounded_result_of_float64(backend):
    q, qd, tau = inputs(MIXED, 20)
    wide = torchdq.forward_dynamics(MIXED, q.double(), qd.double(), tau.double(), backend=backend).float()
    assert torch.equal(torchdq.forward_dynamics(MIXED, q, qd, tau, backend=backend, precision="double"), wide)
    layer = torchdq.ForwardDynamics(MIXED, backend=backend, precision="double")
    assert torch.equal(layer(q, qd, tau), wide)


@pytest.mark.parametrize(
    "make",
    [
        lambda p: torchdq.ForwardDynamics(MIXED, precision=p),
        lambda p: Scene(MIXED, precision=p),
        lambda p: torchdq.forward_dynamics(MIXED, *inputs(MIXED, 1), precision=p),
    ],
)
def test_an_unknown_precision_is_named(make):
    with refused(torchdq.ArgumentError):
        make("half")


@pytest.mark.parametrize(
    ("integrator", "backend"),
    thinned(
        [*itertools.product((SemiImplicitEuler(), RungeKutta4(), LinearlyImplicit()), ("eager", "c"))],
        [(LinearlyImplicit(), "eager")],
    ),
    ids=str,
)
def test_scenes_are_watched(backend, integrator):
    """A step's growth is the largest of its stages, so of the samples that take it in float64 more are found here."""
    scene = Scene(MIXED, (effects.Gravity(),), integrator=integrator, dt=1e-4, backend=backend)
    q, qd, tau = inputs(MIXED, 60)
    lost = split(MIXED, q)
    narrow = scene.step(scene.start(q, qd), tau)
    wide = scene.step(scene.start(q.double(), qd.double()), tau.double())
    assert torch.equal(narrow.qd[lost], wide.qd[lost].float())
    double = scene.replace(precision="double").step(scene.start(q, qd), tau)
    assert torch.equal(double.qd, wide.qd.float())
