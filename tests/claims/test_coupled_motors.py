"""Friction, rotors and noise at motors that are coupled, as in wrists: a robot whose coordinates are its motors.

Evidence: Pinocchio in the coordinates of the joints, with the motors' friction and rotors added by a matrix C by hand,
z = C q, tau_q = C^T tau_z.
"""

import math

import numpy as np
import pinocchio as pin
import pytest
import torch
from messages import refused, warned
from oracles import pinocchio_model

import torchdq
from torchdq import Scene, effects
from torchdq.errors import ArgumentError
from torchdq.learning import Layout, LogWarning, Model, Samples, identify, read_log, smooth
from torchdq.scene.integrators import ExplicitEuler

F64, WIDTH, NOISE = torch.float64, 1e-2, 0.02
C = np.eye(6)
C[4, 3], C[5, 3], C[5, 4] = -1 / 72, 0.1, 1.0  # the motor of a joint of the wrist turns with the joints before it
S, NAMES = np.linalg.inv(C), [f"motor{k}" for k in range(1, 7)]
ROTOR, VISCOUS = np.array([0.8, 2.3, 0.6, 0.2, 0.17, 0.19]), np.array([5.0, 9.0, 4.0, 0.4, 0.4, 0.2])
COULOMB, SHARE = np.array([6.0, 8.0, 5.0, 1.2, 1.0, 0.8]), 0.1
RATIOS = 1 / np.array([62.6, -107.8, 53.7, 76.0, 71.9, 76.7])


def described() -> torchdq.Robot:
    """Puma 560 with links that can exist and without the numbers of its motors."""
    puma = torchdq.robots.load("puma560")
    mass = torch.tensor([3.0, 17.4, 4.8, 1.8, 1.3, 1.1], dtype=F64)
    com, inertia = puma.com.clone(), puma.inertia.clone()
    com[4:] += torch.tensor([0.01, 0.02, 0.07], dtype=F64)
    inertia[0], inertia[2] = torch.tensor([[0.2, 0, 0.35, 0, 0, 0.2], [0.07, 0, 0.09, 0, 0, 0.03]], dtype=F64)
    inertia[3:] *= 3
    return puma.replace(mass=mass, com=com, inertia=inertia, armature=None, damping=torch.zeros(6, dtype=F64)).bake()


JOINTS = described()
REAL = JOINTS.replace(mass=1.1 * JOINTS.mass, com=JOINTS.com + 0.01).bake()
MODEL = pinocchio_model(REAL)
DATA = MODEL.createData()


def coupled(robot: torchdq.Robot) -> torchdq.Robot:
    return robot.couple(S, NAMES, limits=math.inf).bake()


def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.as_tensor(x, dtype=F64) for x in arrays]


def swing(seconds: float, seed: int, step: float = 0.02) -> tuple[np.ndarray, ...]:
    """Time, and positions, velocities and accelerations of the joints: sums of sines."""
    rng, t = np.random.default_rng(seed), np.arange(0, seconds, step)
    k = np.arange(1, 6)[:, None]
    w = 0.2 * np.pi * k * (1 + 0.1 * rng.random((5, 6)))
    size, angle = 0.6 * rng.normal(size=(5, 6)) / k, w * t[:, None, None] + 2 * np.pi * rng.random((5, 6))
    parts = size * np.sin(angle), size * w * np.cos(angle), -size * w**2 * np.sin(angle)
    return t, *(x.sum(1) for x in parts)


def friction(zd: np.ndarray, load: np.ndarray | float = 0.0) -> np.ndarray:
    """Torques that motors add to overcome viscous friction, Coulomb friction, and a share of a load."""
    return VISCOUS * zd + (COULOMB + SHARE * abs(load)) * zd / np.hypot(zd, WIDTH)


def motors(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, loaded: bool = False) -> np.ndarray:
    """Torques of the motors in a motion of the joints."""
    bodies = np.array([pin.rnea(MODEL, DATA, *x) for x in zip(q, qd, qdd, strict=True)]) @ S
    load = bodies + ROTOR * (qdd @ C.T)
    return load + friction(qd @ C.T, load if loaded else 0.0)


def errors(found: np.ndarray, tau: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(found - tau).mean(0)) / tau.std(0)


LAW = (effects.Viscous(tuple(VISCOUS)), effects.Coulomb(tuple(COULOMB), WIDTH), effects.LoadDependent(SHARE, WIDTH))
ARM = coupled(REAL).replace(armature=torch.as_tensor(ROTOR, dtype=F64)).bake()


# --- identification --------------------------------------------------------------------------------------------------


def test_motors_are_identified_where_they_are():
    (_, *seen), (_, *unseen) = swing(15.0, 1), swing(5.0, 2)
    exact, expected = motors(*seen), motors(*unseen)
    noise = NOISE * exact.std(0)
    tau = exact + noise * np.random.default_rng(0).normal(size=exact.shape)
    model = Model((effects.Viscous(), effects.Coulomb()), offset=False, armature=True)
    found = identify(coupled(JOINTS), Samples(*tensors(*(x @ C.T for x in seen), tau)), model, prior=1.0)
    of_motors, size = np.r_[ROTOR, VISCOUS, COULOMB], found.errors[-18:].numpy()
    assert (abs(found.parameters[-18:].numpy() - of_motors) < 4.5 * size).all()
    assert (size[6:] < 0.05 * of_motors[6:]).all() and (size[3:6] < 0.1 * ROTOR[3:]).all()
    np.testing.assert_allclose(found.noise, noise, rtol=0.1)
    assert found.names[-1] == "motor6 coulomb"
    predicted = found.predict(*tensors(*(x @ C.T for x in unseen))).tau.numpy()
    assert errors(predicted, expected).max() < 0.005
    with warned(LogWarning):
        at_joints = identify(JOINTS, Samples(*tensors(*seen, tau @ C)), model, prior=1.0)
    wrong = errors(at_joints.predict(*tensors(*unseen)).tau.numpy(), expected @ C)
    right = errors(predicted @ C, expected @ C)
    assert right.max() < 0.005 and (wrong[4:] > 50 * right[4:]).all()  # friction of the joints alone


def test_a_log_of_motors_is_that_of_the_coupled_robot():
    (t, *seen), full = swing(20.0, 1, 0.01), S * RATIOS
    readings = {"time": t, "q": seen[0] @ np.linalg.inv(full).T, "tau": motors(*seen) * RATIOS / 0.1}
    layout = Layout(columns={"qd": None}, gain=(0.1,) * 6, transmission=full.tolist(), farthest=1e3)
    motion = smooth(read_log(readings, layout), rate=50.0, sign_width=WIDTH)
    np.testing.assert_allclose(layout.coupling, S, atol=1e-12)
    arm = JOINTS.couple(layout.coupling, NAMES, limits=math.inf)
    assert all(bool((x == most).all()) for x, most in zip(arm.limits, (-math.inf, *[math.inf] * 3), strict=True))
    model = Model((effects.Viscous(), effects.Coulomb()), offset=False, armature=True)
    found = identify(arm, motion, model, prior=1.0)
    np.testing.assert_allclose(found.viscous, VISCOUS, rtol=0.1)
    np.testing.assert_allclose(found.coulomb, COULOMB, rtol=0.1)
    for wrong in (JOINTS, JOINTS.couple(C, NAMES, limits=math.inf)):
        with refused(ArgumentError):
            identify(wrong, motion, model)
    with refused(ArgumentError):
        torchdq.nn.MomentumObserver(JOINTS, 50.0, 0.02).threshold(motion)


# --- layers and scenes -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["eager", "c"])
def test_layers_are_those_of_the_motors(backend):
    _, q, qd, qdd = swing(1.0, 3, 0.1)
    z = tensors(*(x @ C.T for x in (q, qd, qdd)))
    expected, layer = motors(q, qd, qdd, loaded=True), torchdq.InverseDynamics(ARM, friction=LAW, backend=backend)
    np.testing.assert_allclose(layer(*z), expected, rtol=1e-10, atol=1e-10 * abs(expected).max())
    zdd = torchdq.ForwardDynamics(ARM, friction=LAW, backend=backend)(*z[:2], torch.as_tensor(expected))
    np.testing.assert_allclose(zdd @ torch.as_tensor(S).mT, qdd, atol=1e-9 * abs(qdd).max())


def test_gradients_of_layers_are_those_of_differences():
    _, q, qd, qdd = swing(0.2, 3, 0.1)
    z = [x.requires_grad_() for x in tensors(*(x @ C.T for x in (q, qd, qdd)))]
    layer, weight = torchdq.InverseDynamics(ARM, friction=LAW), torch.randn(2, 6, dtype=F64)
    (layer(*z) * weight).sum().backward()
    for k, h in ((0, 1e-5), (1, 1e-5), (2, 1e-3)):
        for i in range(6):
            step = [np.zeros_like(q) for _ in range(3)]
            step[k][:, :] = h * S[:, i]  # joints, of a motor
            ends = [motors(q + s * step[0], qd + s * step[1], qdd + s * step[2], loaded=True) for s in (1, -1)]
            slope = ((ends[0] - ends[1]) / (2 * h) * weight.numpy()).sum(1)
            np.testing.assert_allclose(z[k].grad[:, i], slope, rtol=1e-4, atol=1e-4 * abs(slope).max() + 1e-6)


def test_scenes_move_as_the_joints_do():
    parts, h = (effects.RotorInertia(), effects.Gravity(), *LAW[:2]), 1e-3
    scene = Scene(ARM, parts, integrator=ExplicitEuler(), dt=h)
    q, qd, tau = np.random.default_rng(4).normal(size=(3, 6)) * [[1], [1], [5]]
    after = scene.step(scene.start(*tensors(C @ q, C @ qd)), *tensors(tau))
    M = pin.crba(MODEL, DATA, q)
    M = np.triu(M) + np.triu(M, 1).T + C.T @ np.diag(ROTOR) @ C
    qdd = np.linalg.solve(M, C.T @ (tau - friction(C @ qd)) - pin.nle(MODEL, DATA, q, qd))
    np.testing.assert_allclose(S @ after.q.numpy(), q + h * qd, atol=1e-12)
    np.testing.assert_allclose((S @ after.qd.numpy() - qd) / h, qdd, atol=1e-9 * abs(qdd).max())
