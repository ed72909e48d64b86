"""Robots whose joints follow coordinates, q = S z + s0, on fixed and on free bases.

Evidence: Pinocchio's full robot, whose torques, mass matrices and derivatives are reduced by S by hand.
"""

from typing import NamedTuple

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from messages import refused
from oracles import Case, random_tree

import torchdq
from torchdq import Robot, dq, floating

F64 = torch.float64
N, B = 6, 3
WORST = 1e-11

GEARS = {"j2": {"j0": -1.5}, "j4": {"j3": 0.5}, "j5": {"j3": 2.0}}  # each joint follows one coordinate
BASE = {"base_mass": 3.0, "base_com": [0.1, -0.05, 0.2], "base_inertia": [0.3, 0.02, 0.4, -0.03, 0.01, 0.5]}


class Reduced(NamedTuple):
    """Robot with a joint map, the full one as Pinocchio's model, and the map."""

    robot: Robot
    full: Case
    model: pin.Model  # on a free base too
    S: np.ndarray
    shift: np.ndarray

    @property
    def root(self) -> int:
        """Degrees of freedom of the base."""
        return self.model.nv - N

    @property
    def map(self) -> np.ndarray:
        """Velocities of Pinocchio's model per velocity (angular, linear) of the base and of the coordinates."""
        found = np.zeros((self.model.nv, self.root + self.S.shape[1]))
        if self.root:
            found[:6, :6] = np.roll(np.eye(6), 3, axis=0)
        found[np.ix_(self.order, range(self.root, found.shape[1]))] = self.S
        return found

    @property
    def joints(self) -> list:
        return [self.model.joints[self.model.getJointId(name)] for name in self.full.robot.joint_names]

    @property
    def order(self) -> list[int]:
        return [joint.idx_v for joint in self.joints]

    def configuration(self, z, X_WB) -> np.ndarray:
        found = np.zeros(self.model.nq)
        for joint, x in zip(self.joints, self.S @ np.asarray(z) + self.shift, strict=True):
            found[joint.idx_q : joint.idx_q + joint.nq] = [x] if joint.nq == 1 else [np.cos(x), np.sin(x)]
        if self.root:
            found[:7] = pin.SE3ToXYZQUAT(oracles.se3(X_WB))
        return found

    def wrenches(self, f_ext) -> list[pin.Force]:
        found = [pin.Force.Zero() for _ in range(self.model.njoints)]
        for joint, placement, f in zip(self.joints, self.full.link_placements(), f_ext, strict=True):
            found[joint.id] = placement.act(pin.Force(f[:3], f[3:]))
        return found


def reduced(seed: int, kind: str, free: bool = False) -> Reduced:
    """Random tree with gears, or with a map without zeros."""
    full = random_tree(N, seed, armature=kind == "gears")
    rng = np.random.default_rng([7, seed])
    shift = rng.normal(size=N) * 0.4
    offset = dict(zip(full.robot.joint_names, shift.tolist(), strict=True))
    if kind == "gears":
        robot = full.robot.couple(GEARS, offset=offset)
        S = np.array([[GEARS.get(j, {j: 1.0}).get(z, 0.0) for z in robot.joint_names] for j in full.robot.joint_names])
    else:
        S = rng.normal(size=(N, 4))
        robot = full.robot.couple(S, ["a", "b", "c", "d"], offset=offset)
    model = full.model
    if free:
        robot = robot.replace(**{name: torch.tensor(x, dtype=F64) for name, x in BASE.items()})
        model = on_a_free_base(full.model)
    return Reduced(robot.bake(), full, model, S, shift)


def on_a_free_base(fixed: pin.Model) -> pin.Model:
    """Pinocchio's model with the body of `BASE` as a free base."""
    model = pin.Model()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    xx, xy, yy, xz, yz, zz = BASE["base_inertia"]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    body = pin.Inertia(BASE["base_mass"], np.array(BASE["base_com"]), inertia)
    model.appendBodyToJoint(root, body, pin.SE3.Identity())
    frame = model.addFrame(pin.Frame("root_body", root, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    return joined_models(model, fixed, frame, pin.SE3.Identity())


def joined_models(first: pin.Model, other: pin.Model, frame: int, placement: pin.SE3) -> pin.Model:
    """Pinocchio's model of both, with the rotors, which Pinocchio forgets, and the gravity of the second."""
    model = pin.appendModel(first, other, frame, placement)
    model.gravity = other.gravity
    armature = np.zeros(model.nv)
    for part in (first, other):
        for name in list(part.names)[1:]:
            (old, new), count = (x.joints[x.getJointId(name)].idx_v for x in (part, model)), 1
            if part.joints[part.getJointId(name)].nv == count:
                armature[new] = part.armature[old]
    model.armature = armature
    return model


class Motion(NamedTuple):
    """States [B, ...] of a robot with a map; of a fixed base, those of the base are not used."""

    X: torch.Tensor
    z: torch.Tensor
    v: torch.Tensor  # of the base and the coordinates
    a: torch.Tensor
    f_tip: torch.Tensor
    f_ext: torch.Tensor


def motion(m: int, root: int, seed: int = 0) -> Motion:
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(B, *shape, dtype=F64, generator=g)

    X = dq.exp(normal(6))
    return Motion(X, normal(m), normal(root + m), 3 * normal(root + m), 5 * normal(6), 5 * normal(N, 6))


def each(case: Reduced, s: Motion, function) -> np.ndarray:
    """Results of function(model, data, q, v, a, i), inputs those of the full robot."""
    data = case.model.createData()
    rows = []
    for i in range(B):
        q = case.configuration(s.z[i].numpy(), s.X[i])
        rows.append(function(case.model, data, q, case.map @ s.v[i].numpy(), case.map @ s.a[i].numpy(), i))
    return np.array(rows)


def mass_matrices(case: Reduced, s: Motion) -> np.ndarray:
    M = each(case, s, lambda model, data, q, *_: np.array(pin.crba(model, data, q)))
    M = np.triu(M) + np.triu(M, 1).swapaxes(-1, -2)
    return case.map.T @ M @ case.map


def torques(case: Reduced, s: Motion, f_ext=None, f_tip=None) -> np.ndarray:
    def loaded(model, data, q, v, a, i):
        tau = pin.rnea(model, data, q, v, a, case.wrenches(f_ext[i].numpy())) if f_ext is not None else None
        tau = pin.rnea(model, data, q, v, a) if tau is None else tau
        if f_tip is None:
            return tau
        frame = model.getFrameId(case.robot.tip, pin.FrameType.BODY)
        return tau + pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL).T @ f_tip[i].numpy()

    return each(case, s, loaded) @ case.map


def close(found, expected, tolerance: float = WORST) -> bool:
    found = found.detach().numpy() if isinstance(found, torch.Tensor) else np.asarray(found)
    return found.shape == expected.shape and bool(abs(found - expected).max() <= tolerance * abs(expected).max())


def joined(forces: floating.Forces) -> torch.Tensor:
    """Generalised forces (moment, force, torques)."""
    return torch.cat([forces.F_B[..., 3:], forces.F_B[..., :3], forces.tau], -1)


KINDS = pytest.mark.parametrize("kind", ["gears", "dense"])
SEEDS = pytest.mark.parametrize("seed", [0, 5])
RUNS = pytest.mark.parametrize(
    "kind, seed, backend", [("gears", 0, "eager"), ("dense", 0, "eager"), ("gears", 5, "eager"), ("dense", 5, "c")]
)


# --- fixed base ------------------------------------------------------------------------------------------------------


@RUNS
def test_dynamics_are_those_of_the_reduced_system(kind, seed, backend):
    case = reduced(seed, kind)
    m = case.robot.n
    s, with_backend = motion(m, 0, seed), {"backend": backend}
    tau = torchdq.inverse_dynamics(case.robot, s.z, s.v, s.a, s.f_tip, s.f_ext, **with_backend)
    assert close(tau, torques(case, s, s.f_ext, s.f_tip))
    M = torchdq.mass_matrix(case.robot, s.z, **with_backend)
    expected = mass_matrices(case, s)
    assert close(M, expected) and torch.equal(M, M.mT)
    qdd = torchdq.forward_dynamics(case.robot, s.z, s.v, tau, s.f_tip, s.f_ext, **with_backend)
    growth = np.linalg.cond(expected).max()
    assert close(qdd, s.a.numpy(), 1e-14 * growth + WORST)
    tau = s.a  # any torques
    bias = torques(case, s._replace(a=0 * s.a))
    solved = np.linalg.solve(expected, (tau.numpy() - bias)[..., None])[..., 0]
    assert close(torchdq.forward_dynamics(case.robot, s.z, s.v, tau, **with_backend), solved, 1e-14 * growth + WORST)
    parts = torchdq.closed_form(case.robot, s.z, s.v, **with_backend)
    gravity = torques(case, s._replace(v=0 * s.v, a=0 * s.a))
    assert close(parts.M, expected) and close(parts.g, gravity) and close(parts.c + parts.g, bias)
    lifted = torques(case, s, f_tip=s.f_tip) - torques(case, s)
    assert close((parts.Jt @ s.f_tip[..., None])[..., 0], lifted)
    assert bool((torchdq.error_growth(case.robot, s.z, **with_backend) >= 1).all())


@RUNS
def test_kinematics_and_energies_are_those_of_the_full_robot(kind, seed, backend):
    case = reduced(seed, kind)
    s = motion(case.robot.n, 0, seed)
    for expressed, axes in (("body", pin.LOCAL), ("world", pin.LOCAL_WORLD_ALIGNED)):

        def jacobian(model, data, q, v, a, i, axes=axes):
            frame = model.getFrameId(case.robot.tip, pin.FrameType.BODY)
            return pin.computeFrameJacobian(model, data, q, frame, axes)[[3, 4, 5, 0, 1, 2]] @ case.map

        J = torchdq.jacobian(case.robot, s.z, case.robot.tip, expressed=expressed, backend=backend)
        assert close(J, each(case, s, jacobian))

    def placements(model, data, q, v, a, i):
        pin.framesForwardKinematics(model, data, q)
        ids = [model.getFrameId(name, pin.FrameType.BODY) for name in case.robot.frame_names]
        return [data.oMf[frame].homogeneous for frame in ids]

    X = torchdq.forward_kinematics(case.robot, s.z, backend=backend)
    assert close(dq.to_matrix(X), each(case, s, placements))
    energy = torchdq.kinetic_energy(case.robot, s.z, s.v, backend=backend)
    assert close(energy, 0.5 * np.einsum("bi,bij,bj->b", s.v, mass_matrices(case, s), s.v))
    potential = each(case, s, lambda model, data, q, *_: pin.computePotentialEnergy(model, data, q))
    found = torchdq.potential_energy(case.robot, s.z, backend=backend)
    assert close(found - found[0], potential - potential[0])


def regressors(case: Reduced, s: Motion) -> np.ndarray:
    """Regressors about the link frames, the base's body first."""
    bodies = case.model.njoints - 1

    def regressor(model, data, q, v, a, i):
        return pin.computeJointTorqueRegressor(model, data, q, v, a).reshape(model.nv, bodies, 10)

    ids = [*([0] if case.root else []), *(joint.id - 1 for joint in case.joints)]
    at = [*([pin.SE3.Identity()] if case.root else []), *case.full.link_placements()]
    moved = np.array([oracles.moved_parameters(placement) for placement in at])
    Y = np.einsum("bjlk,lkp->bjlp", each(case, s, regressor)[:, :, ids], moved).reshape(B, case.model.nv, -1)
    return case.map.T @ Y


@KINDS
@SEEDS
def test_the_regressor_is_the_reduced_one(kind, seed):
    case = reduced(seed, kind)
    s = motion(case.robot.n, 0, seed)
    Y = torchdq.regressor(case.robot, s.z, s.v, s.a)
    assert close(Y, regressors(case, s))
    without = case.robot.replace(armature=None)
    tau = torchdq.inverse_dynamics(without, s.z, s.v, s.a)
    assert close(Y @ case.robot.inertial_parameters, tau.numpy())


@KINDS
@SEEDS
def test_derivatives_are_the_reduced_ones(kind, seed):
    case = reduced(seed, kind)
    s = motion(case.robot.n, 0, seed)
    found = torchdq.dynamics_jacobian(case.robot, s.z, s.v, s.a)
    for k in range(2):

        def derivative(model, data, q, v, a, i, k=k):
            return np.array(pin.computeRNEADerivatives(model, data, q, v, a)[k])

        assert close(found[k], case.map.T @ each(case, s, derivative) @ case.map)
    assert close(found[2], mass_matrices(case, s))


@pytest.mark.parametrize("kind, backend", [("gears", "c"), ("dense", "eager")])
def test_gradients_are_right_to_the_second_order(kind, backend):
    case = reduced(3, kind)
    s = motion(case.robot.n, 0)
    rows = [x[0].clone().requires_grad_() for x in (s.z, s.v, s.a)]
    mass = case.robot.mass.clone().requires_grad_()

    def run(function):
        return lambda z, v, a, m: function(case.robot.replace(mass=m), z, v, a, backend=backend)

    assert torch.autograd.gradcheck(run(torchdq.inverse_dynamics), (*rows, mass))
    assert torch.autograd.gradcheck(run(torchdq.forward_dynamics), (*rows, mass))
    assert torch.autograd.gradgradcheck(run(torchdq.inverse_dynamics), (*rows, mass), fast_mode=True)


# --- free base -------------------------------------------------------------------------------------------------------


@RUNS
def test_dynamics_on_a_free_base_are_those_of_the_reduced_system(kind, seed, backend):
    case = reduced(seed, kind, free=True)
    m, robot = case.robot.n, case.robot
    s, with_backend = motion(m, 6, seed), {"backend": backend}
    V, zd, A, zdd = s.v[:, :6], s.v[:, 6:], s.a[:, :6], s.a[:, 6:]
    forces = floating.inverse_dynamics(robot, s.X, s.z, V, zd, A, zdd, s.f_tip, s.f_ext, **with_backend)
    assert close(joined(forces), torques(case, s, s.f_ext, s.f_tip))
    M, expected = floating.mass_matrix(robot, s.X, s.z, **with_backend), mass_matrices(case, s)
    assert close(M.M, expected) and close(M.joints, expected[:, 6:, 6:])
    bias = torques(case, s._replace(a=0 * s.a))
    net = np.concatenate([np.zeros((B, 6)), zdd.numpy()], -1) - bias
    solved = np.linalg.solve(expected, net[..., None])[..., 0]
    found = torch.cat([*floating.forward_dynamics(robot, s.X, s.z, V, zd, zdd, **with_backend)], -1)
    assert close(found, solved, 1e-14 * np.linalg.cond(expected).max() + WORST)
    parts = floating.closed_form(robot, s.X, s.z, V, zd, **with_backend)
    assert close(parts.M, expected) and close(parts.c + parts.g, bias)
    energy = floating.kinetic_energy(robot, s.X, s.z, V, zd, **with_backend)
    assert close(energy, 0.5 * np.einsum("bi,bij,bj->b", s.v, expected, s.v))

    def jacobian(model, data, q, v, a, i):
        frame = model.getFrameId(robot.tip, pin.FrameType.BODY)
        return pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL)[[3, 4, 5, 0, 1, 2]] @ case.map

    assert close(floating.jacobian(robot, s.X, s.z, robot.tip, **with_backend), each(case, s, jacobian))

    def momenta(model, data, q, v, a, i):
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        return [*data.hg.vector, *data.dhg.vector]

    momentum = floating.momentum(robot, s.X, s.z, V, zd, **with_backend)
    rate = floating.momentum_rate(robot, s.X, s.z, V, zd, A, zdd, **with_backend)
    if robot.armature is None:  # rotors have no place in Pinocchio's momentum, nor in ours
        assert close(torch.cat([*momentum, *rate], -1), each(case, s, momenta))


@KINDS
@SEEDS
def test_the_regressor_on_a_free_base_is_the_reduced_one(kind, seed):
    case = reduced(seed, kind, free=True)
    s = motion(case.robot.n, 6, seed)
    V, zd, A, zdd = s.v[:, :6], s.v[:, 6:], s.a[:, :6], s.a[:, 6:]
    Y = floating.regressor(case.robot, s.X, s.z, V, zd, A, zdd)
    assert close(Y, regressors(case, s))
    tau = joined(floating.inverse_dynamics(case.robot.replace(armature=None), s.X, s.z, V, zd, A, zdd))
    assert close(Y @ case.robot.inertial_parameters, tau.numpy())


@KINDS
def test_gradients_on_a_free_base(kind):
    case = reduced(3, kind, free=True)
    s = motion(case.robot.n, 6)
    rows = [x[0].clone().requires_grad_() for x in (s.z, s.v, s.a)]
    masses = [case.robot.mass.clone().requires_grad_(), case.robot.base_mass.clone().requires_grad_()]

    def accelerations(z, v, a, mass, base_mass):
        robot = case.robot.replace(mass=mass, base_mass=base_mass)
        return torch.cat([*floating.forward_dynamics(robot, s.X[0], z, v[:6], v[6:], a[6:])], -1)

    assert torch.autograd.gradcheck(accelerations, (*rows, *masses), fast_mode=True)


def test_a_follower_is_no_coordinate():
    chain = {"panda_joint7": {"panda_joint6": 0.5}, "panda_joint6": {"panda_joint5": -2.0}}
    with refused(torchdq.ArgumentError):
        torchdq.robots.load("panda").couple(chain)
