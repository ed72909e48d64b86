"""Momentum observer: r' = K (tau_ext - r) on scenes that are integrated, to second order in the step; and the force."""

import math
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
import torch
from exporting import needs, passes_its_test
from helpers import all_in_one, random, thinned
from messages import refused
from oracles import EPS, random_tree, shipped

import torchdq
from torchdq import effects
from torchdq.errors import ArgumentError, DtypeError
from torchdq.learning import Layout, read_log
from torchdq.nn import MomentumObserver, ObserverState
from torchdq.scene import Scene, integrators

F64 = torch.float64
GAIN, END = 30.0, 0.1
PANDA, TWO = shipped("panda").robot, shipped("two_link").robot
TREE = random_tree(3, seed=6, armature=True).robot
MIMIC = TREE.couple({TREE.joint_names[2]: {TREE.joint_names[0]: -0.7}})
FRICTION = (effects.Viscous(0.04), effects.Coulomb(0.03, sign_width=0.5))
ROBOTS = {"panda": PANDA, "tree": TREE, "mimic": MIMIC}


@cache
def pushed(robot, dt, push=0.0, friction=(), rows=3):
    """Positions, velocities and torques of the motors of scenes that are pushed, by small Runge-Kutta steps."""
    steps, n = round(END / dt), robot.n
    rotors = () if robot.armature is None else (effects.RotorInertia(),)
    scene = Scene(
        robot, (effects.Gravity(), *rotors, *friction), integrator=integrators.RungeKutta4(), dt=dt, substeps=4
    )
    start = scene.start(random(rows, n, seed=1), 0.5 * random(rows, n, seed=2))
    phase = torch.linspace(0.0, 2.0, steps + 1, dtype=F64)[:-1, None, None] + torch.arange(n)
    tau = (4.0 * torch.sin(5.0 * phase)).expand(steps, rows, n)
    with torchdq.backend("auto"):
        path = scene.rollout(start, torque=tau + push)
    return torch.cat((start.q[None], path.q)), torch.cat((start.qd[None], path.qd)), tau


def error(robot, dt, push=0.0, friction=()):
    """Largest deviation of the estimates from push (1 - exp(-K t)) over the size of the torques."""
    model = torchdq.InverseDynamics(robot, friction=friction)
    with torch.no_grad():
        r = MomentumObserver(model, GAIN, dt).series(*pushed(robot, dt, push, friction))
    t = dt * torch.arange(1, len(r) + 1, dtype=F64)
    return float((r - push * (1.0 - torch.exp(-GAIN * t))[:, None, None]).abs().max())


def recorded(layout=None, **signals):
    """Log of rows every 10 ms, at rest where no signals are given."""
    signals = dict.fromkeys(("q", "qd", "tau"), np.zeros((10, 2))) | signals
    return read_log({"time": 1e-2 * np.arange(len(signals["q"])), **signals}, layout or Layout())


@pytest.mark.parametrize("name", thinned(ROBOTS, ("mimic",)))
def test_the_error_falls_with_the_square_of_the_step(name):
    for push in thinned((0.0, 3.0), (3.0,)):
        coarse, fine = (error(ROBOTS[name], dt, push, FRICTION) for dt in (1e-3, 5e-4))
        assert 0.95 * 4 < coarse / fine < 1.05 * 4 and fine < 1e-3, push


def test_momentum_is_mass_times_velocity_and_its_rate_that_of_pinocchio():
    """C^T qd - g, with the Coriolis matrix of Christoffel symbols."""
    case = shipped("panda")
    q, qd = random(2, 7, seed=4)
    state = MomentumObserver(case.robot, GAIN, 1e-3).start(q, qd)
    data = case.model.createData()
    M = pin.crba(case.model, data, q.numpy())
    C = pin.computeCoriolisMatrix(case.model, data, q.numpy(), qd.numpy())
    g = pin.computeGeneralizedGravity(case.model, data, q.numpy())
    for found, expected in ((state.momentum, M @ qd.numpy()), (state.rate, C.T @ qd.numpy() - g)):
        np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=1e-13 * np.abs(expected).max())


def test_a_series_is_the_steps_one_after_the_other():
    """With steps of any lengths, and with gains by joint."""
    gain, dt = torch.linspace(5.0, 50.0, 3, dtype=F64), 1e-3 * (1.0 + random(100, seed=3).abs())
    q, qd, tau = pushed(TREE, 1e-3, 2.0)
    observer = MomentumObserver(TREE, gain, 1e-3)
    for steps in (None, dt):
        state, found = observer.start(q[0], qd[0]), []
        for k in range(len(tau)):
            with torchdq.backend("auto"):
                state = observer(q[k + 1], qd[k + 1], tau[k], state, None if steps is None else steps[k])
            found.append(state.r)
        torch.testing.assert_close(observer.series(q, qd, tau, steps), torch.stack(found), rtol=0, atol=1e-12)


def test_one_robot_without_numbers_does_not_disturb_others():
    q, qd, tau = (x.clone() for x in pushed(TREE, 1e-3, 2.0))
    observer = MomentumObserver(TREE, GAIN, 1e-3)
    expected = observer.series(q, qd, tau)
    q[4, 1, 2] = torch.nan
    found = observer.series(q, qd, tau)
    assert torch.equal(found[:, ::2], expected[:, ::2]) and torch.equal(found[:3, 1], expected[:3, 1])
    assert found[3:, 1].isnan().any(-1).all()


def test_a_trained_layer_brings_its_friction_and_offset():
    layer = torchdq.InverseDynamics(
        TWO, ("mass", "offset"), friction=(effects.LoadDependent(0.1), effects.Viscous(0.2))
    )
    with torch.no_grad():
        layer.mass, layer.offset = 1.3 * layer.mass, torch.tensor([0.5, -0.2], dtype=F64)
    q, h = random(4, 2, seed=5), 1e-2
    rest = torch.zeros_like(q)
    tau = layer(q, rest, rest).detach()  # holds the robot
    observer = MomentumObserver(layer, GAIN, h)
    r = observer(q, rest, tau, observer.start(q, rest)).r
    assert r.abs().max() <= 100 * EPS[F64] * tau.abs().max()
    (slope,) = torch.autograd.grad(observer(q, rest, tau, observer.start(q, rest)).r.sum(), layer.offset)
    torch.testing.assert_close(slope, torch.full((2,), 4 * (1 - math.exp(-GAIN * h)), dtype=F64))


def test_a_threshold_is_not_passed_in_its_own_motion():
    q, qd, tau = (x[:, 0] for x in pushed(TWO, 1e-2))
    noisy = qd + 1e-2 * random(*qd.shape, seed=6)
    log = recorded(q=q.numpy(), qd=noisy.numpy(), tau=torch.cat((tau, tau[-1:])).numpy())
    observer, held = MomentumObserver(TWO, GAIN, 1e-2), torch.from_numpy(log.tau)
    r = observer.series(q, noisy, (held[1:] + held[:-1]) / 2)
    torch.testing.assert_close(observer.threshold(log, 2.0), 2.0 * r.abs().amax(0))


def test_a_threshold_does_not_see_rows_that_are_missing():
    """Rows that were left out, in which the momentum changed, are no contact."""
    q, qd, tau = (x[:, 0] for x in pushed(TWO, 1e-2))
    signals = {"q": q, "qd": qd, "tau": torch.cat((tau, tau[-1:]))}
    half, observer = len(q) // 2, MomentumObserver(TWO, GAIN, 1e-2)
    kept = [*range(half - 3), *range(half, len(q))]
    log = recorded(**{name: x.numpy() for name, x in signals.items()})
    some = log._replace(time=log.time[kept], **{name: getattr(log, name)[kept] for name in signals})
    parts = [
        log._replace(time=log.time[part], **{name: getattr(log, name)[part] for name in signals})
        for part in (slice(0, half - 3), slice(half, None))
    ]
    largest = torch.maximum(*(observer.threshold(part) for part in parts))
    torch.testing.assert_close(observer.threshold(some), largest)


def test_a_threshold_is_found_in_rows_of_a_given_rate():
    time = np.arange(0.0, 4.0, 1e-3)
    log = read_log({"time": time, **dict.fromkeys(("q", "qd", "tau"), np.sin(np.stack((time, 2 * time), 1)))}, rate=100)
    assert (MomentumObserver(TWO, GAIN, 1e-2).threshold(log) > 0).all()


def test_a_scene_observes_its_steps():
    """The rows of a rollout are the estimates from its states, and see a push on the tip that no motor knows of."""
    scene = Scene(TWO, (effects.Gravity(), effects.Push()), dt=1e-3)
    start, push = scene.start(random(3, 2)), torch.zeros(50, 3, 6, dtype=F64)
    push[..., 1] = 2.0
    observer = MomentumObserver(TWO, GAIN, 1e-3)
    carry = torch.cat(observer.start(start.q, start.qd), -1)
    path, rows = scene.rollout(start, push=push, task=observer.task(), carry=carry)
    q, qd = torch.cat((start.q[None], path.q)), torch.cat((start.qd[None], path.qd))
    torch.testing.assert_close(rows["r"], observer.series(q, qd, torch.zeros_like(path.q)), rtol=0, atol=1e-10)
    J = torchdq.jacobian(TWO, path.q[-1], TWO.end_effector().name, "world")
    expected = torch.einsum("...ij,...i->...j", J[..., 3:, :], push[-1, :, :3]) * (1.0 - math.exp(-GAIN * 0.05))
    assert (rows["r"][-1] - expected).abs().max() < 0.05 * expected.abs().max()


@needs("gcc")
def test_exported_c_computes_what_the_layer_does(tmp_path):
    """The exported test compares the C code with the program's own numbers."""
    observer = MomentumObserver(torchdq.InverseDynamics(TWO, friction=FRICTION), GAIN, 1e-3)
    compiled = torchdq.compile(observer.program())
    q, qd, tau, *state = random(6, 2, seed=7)
    expected = observer(q, qd, tau, ObserverState(*state))
    for found, x in zip(compiled(q, qd, tau, *state), expected, strict=True):
        torch.testing.assert_close(found, x, rtol=1e-13, atol=1e-13)
    passes_its_test(compiled.export(tmp_path))


@all_in_one(["body", "world"])
def test_the_force_is_the_one_that_exerts_the_torques(expressed):
    q, F = random(5, 7, seed=8), random(5, 6, seed=9)
    tip = PANDA.end_effector().name
    r = torch.einsum("...ij,...i->...j", torchdq.jacobian(PANDA, q, tip, expressed), F)
    found, part = MomentumObserver(PANDA, GAIN, 1e-3).force(q, r, expressed=expressed, damping=1e-6)
    torch.testing.assert_close(found, F, rtol=0, atol=1e-6)
    assert (part > 1 - 1e-6).all()


def test_what_the_joints_do_not_show_is_named_and_the_rest_is_unchanged():
    """A straight arm shows no force along itself; a planar one only the three components of its plane."""
    observer, F = MomentumObserver(TWO, GAIN, 1e-3), random(2, seed=3)
    q = torch.tensor([[0.3, 0.0], [0.3, 1.2]], dtype=F64)
    J = torchdq.jacobian(TWO, q, TWO.end_effector().name)[..., 3:5, :]
    r = torch.einsum("...ij,i->...j", J, F)
    found, part = observer.force(q, r, axes=("x", "y", "z"), damping=1e-5)
    torch.testing.assert_close(part, torch.tensor([[0.0, 1, 0], [1, 1, 0]], dtype=F64), rtol=0, atol=1e-8)
    torch.testing.assert_close(found[0], torch.stack((0 * F[0], F[1], 0 * F[0])), rtol=0, atol=1e-8)
    torch.testing.assert_close(found[1, :2], F, rtol=0, atol=1e-8)
    whole, part = observer.force(q[1], r[1])
    assert part.sum() < 2 + 1e-9 and whole.isfinite().all() and (part[:2] == 0).all()


def test_a_part_is_the_diagonal_of_the_projector_on_what_the_torques_determine():
    """And the force is that of the pseudo-inverse, for an arm of four joints and all six components."""
    robot = random_tree(4, seed=9).robot
    tip = robot.frame_names[-1]
    q, r = random(6, 4, seed=1), random(6, 4, seed=2)
    J = torchdq.jacobian(robot, q, tip)
    kinds = J.square().sum(-1).unflatten(-1, (2, 3)).mean(-1).clamp(min=1e-12).rsqrt()
    scaled = kinds.repeat_interleave(3, -1)[..., None] * J
    inverse, damping = torch.linalg.pinv(scaled.mT), 1e-4
    found, part = MomentumObserver(robot, GAIN, 1e-3).force(q, r, frame=tip, damping=damping)
    projector = inverse @ scaled.mT
    bound = (2.0 * damping * inverse.norm(dim=(-2, -1))).square()[..., None] + 100 * EPS[F64] / damping**2
    assert ((part - projector.diagonal(dim1=-2, dim2=-1)).abs() <= bound).all()
    force = kinds.repeat_interleave(3, -1) * torch.einsum("...ij,...j->...i", inverse, r)
    assert ((found - force).abs() <= bound * force.norm(dim=-1, keepdim=True)).all() and bound.max() < 0.01


ZERO, FIVE = torch.zeros(2), torch.zeros(5, 2)
AT_REST = MomentumObserver(TWO, GAIN, 1e-3)
STATE = AT_REST.start(ZERO, ZERO)
MISUSE = {
    "a step back": lambda: AT_REST(ZERO, ZERO, ZERO, STATE, dt=-1.0),
    "steps of joints": lambda: AT_REST(ZERO, ZERO, ZERO, STATE, dt=torch.ones(2)),
    "no state": lambda: AT_REST(ZERO, ZERO, ZERO, None),
    "a state of another robot": lambda: AT_REST(ZERO, ZERO, ZERO, ObserverState(*torch.zeros(3, 7))),
    "torques as many as positions": lambda: AT_REST.series(FIVE, FIVE, FIVE),
    "times of rows": lambda: AT_REST.series(FIVE, FIVE, FIVE[1:], torch.ones(5)),
    "one number as a motion": lambda: AT_REST.series(ZERO[0], ZERO[0], ZERO[0]),
    "a negative margin": lambda: AT_REST.threshold(recorded(), -1.0),
    "no velocities": lambda: AT_REST.threshold(recorded(qd=None)),
    "currents": lambda: AT_REST.threshold(recorded(Layout(gain=None))),
    "another module": lambda: MomentumObserver(torchdq.ForwardDynamics(TWO), GAIN, 1e-3),
    "no step": lambda: MomentumObserver(TWO, GAIN, 0.0),
    "a negative gain": lambda: MomentumObserver(TWO, -GAIN, 1e-3),
    "a complex gain": lambda: MomentumObserver(TWO, torch.tensor(1j), 1e-3),
    "axes twice": lambda: MomentumObserver(TWO, GAIN, 1e-3).force(torch.zeros(2), torch.zeros(2), axes=("x", "x")),
}


@all_in_one(MISUSE.values())
def test_misuse_is_refused_with_the_argument_and_what_was_found(call):
    with refused(ArgumentError):
        call()


def test_dtypes_are_not_mixed():
    with refused(DtypeError):
        AT_REST(ZERO, ZERO, ZERO, ObserverState(*[x.double() for x in STATE]))
