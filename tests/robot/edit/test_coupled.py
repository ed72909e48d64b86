"""Robots whose joints follow coordinates, q = S z + s0, on fixed and on floating bases.

Evidence: the full robot, which other tests compare with Pinocchio, reduced by S by hand.
"""

import pytest
import torch
from helpers import all_in_one, random, thinned
from messages import refused
from oracles import random_tree
from robots import F64, on_free_base, two

import torchdq
from torchdq import Robot, dq, floating

N, B = 6, 2
WORST = 1e-11

GEARS = {"j2": {"j0": -1.5}, "j4": {"j3": 0.5}, "j5": {"j3": 2.0}}  # each joint follows one coordinate

RUNS = [("gears", 0), ("dense", 5), ("gears", 5), ("dense", 0)]
SEEDS = pytest.mark.parametrize("kind, seed", thinned(RUNS, RUNS[1:2]))


def reduced(seed: int, kind: str, free: bool = False) -> tuple[Robot, Robot, torch.Tensor, torch.Tensor]:
    """Random tree with gears or with a map without zeros, the full robot, and S and s0."""
    full = random_tree(N, seed, armature=kind == "gears").robot
    full = on_free_base(full) if free else full
    shift = 0.4 * random(N, seed=seed)
    offset = dict(zip(full.joint_names, shift.tolist(), strict=True))
    if kind == "gears":
        robot = full.couple(GEARS, offset=offset)
        S = [[GEARS.get(j, {j: 1.0}).get(z, 0.0) for z in robot.joint_names] for j in full.joint_names]
        return robot, full, torch.tensor(S, dtype=F64), shift
    S = random(N, 4, seed=seed + 1)
    return full.couple(S, list("abcd"), offset=offset), full, S, shift


def close(found, expected, tolerance: float = WORST) -> bool:
    assert found.shape == expected.shape
    return bool((found - expected).abs().max() <= tolerance * expected.abs().max())


def joined(forces: floating.Forces) -> torch.Tensor:
    """Generalised forces (moment, force, torques)."""
    return torch.cat([forces.F_B[..., 3:], forces.F_B[..., :3], forces.tau], -1)


# --- fixed base ------------------------------------------------------------------------------------------------------


@SEEDS
def test_functions_are_those_of_the_reduced_system(kind, seed):
    robot, full, S, shift = reduced(seed, kind)
    z, zd, zdd, tau = random(4, B, robot.n, seed=seed)
    f_tip, f_ext = 5 * random(B, 6, seed=2), 5 * random(B, N, 6, seed=3)
    q, qd, qdd = z @ S.T + shift, zd @ S.T, zdd @ S.T
    found = torchdq.inverse_dynamics(robot, z, zd, zdd, f_tip, f_ext)
    assert close(found, torchdq.inverse_dynamics(full, q, qd, qdd, f_tip, f_ext) @ S)
    M, expected = torchdq.mass_matrix(robot, z), S.T @ torchdq.mass_matrix(full, q) @ S
    assert close(M, expected) and torch.equal(M, M.mT)
    growth = 1e-14 * float(torch.linalg.cond(expected).max()) + WORST
    assert close(torchdq.forward_dynamics(robot, z, zd, found, f_tip, f_ext), zdd, growth)
    bias = torchdq.inverse_dynamics(full, q, qd) @ S
    assert close(torchdq.forward_dynamics(robot, z, zd, tau), torch.linalg.solve(expected, tau - bias), growth)
    parts, whole = torchdq.closed_form(robot, z, zd), torchdq.closed_form(full, q, qd)
    assert close(parts.M, expected) and close(parts.g, whole.g @ S) and close(parts.c + parts.g, bias)
    assert close(parts.Jt, S.T @ whole.Jt)
    assert bool((torchdq.error_growth(robot, z) >= 1).all())
    for axes in ("body", "world"):
        J = torchdq.jacobian(robot, z, robot.tip, expressed=axes)
        assert close(J, torchdq.jacobian(full, q, robot.tip, expressed=axes) @ S)
    X, Y = torchdq.forward_kinematics(robot, z), torchdq.forward_kinematics(full, q)
    assert close(dq.to_matrix(X), dq.to_matrix(Y))
    assert close(torchdq.kinetic_energy(robot, z, zd), torchdq.kinetic_energy(full, q, qd))
    assert close(torchdq.potential_energy(robot, z), torchdq.potential_energy(full, q))


@SEEDS
def test_the_regressor_and_derivatives_are_the_reduced_ones(kind, seed):
    robot, full, S, shift = reduced(seed, kind)
    z, zd, zdd = random(3, B, robot.n, seed=seed)
    q, qd, qdd = z @ S.T + shift, zd @ S.T, zdd @ S.T
    Y = torchdq.regressor(robot, z, zd, zdd)
    assert close(Y, S.T @ torchdq.regressor(full, q, qd, qdd))
    tau = torchdq.inverse_dynamics(robot.replace(armature=None), z, zd, zdd)
    assert close(Y @ robot.inertial_parameters, tau)
    pairs = zip(torchdq.dynamics_jacobian(robot, z, zd, zdd), torchdq.dynamics_jacobian(full, q, qd, qdd), strict=True)
    assert all(close(found, S.T @ expected @ S) for found, expected in pairs)


@all_in_one(thinned(["dense", "gears"], ["dense"]))
def test_gradients_are_right_to_the_second_order(kind):
    robot = reduced(3, kind)[0]
    rows = [x.clone().requires_grad_() for x in (*random(3, robot.n), robot.mass)]

    def run(function):
        return lambda z, v, a, m: function(robot.replace(mass=m), z, v, a)

    assert torch.autograd.gradcheck(run(torchdq.forward_dynamics), rows, fast_mode=True)
    assert torch.autograd.gradgradcheck(run(torchdq.inverse_dynamics), rows, fast_mode=True)


# --- floating base ----------------------------------------------------------------------------------------------------


@SEEDS
def test_functions_on_a_free_base_are_those_of_the_reduced_system(kind, seed):
    robot, full, S, shift = reduced(seed, kind, free=True)
    T = torch.block_diag(torch.eye(6, dtype=F64), S)
    z, zd, zdd, tau = random(4, B, robot.n, seed=seed)
    X, (V, A, f_tip) = dq.exp(random(B, 6, seed=2)), 3 * random(3, B, 6, seed=3)
    f_ext, q, qd, qdd = 5 * random(B, N, 6, seed=4), z @ S.T + shift, zd @ S.T, zdd @ S.T
    forces = floating.inverse_dynamics(robot, X, z, V, zd, A, zdd, f_tip, f_ext)
    assert close(joined(forces), joined(floating.inverse_dynamics(full, X, q, V, qd, A, qdd, f_tip, f_ext)) @ T)
    M, expected = floating.mass_matrix(robot, X, z), T.T @ floating.mass_matrix(full, X, q).M @ T
    assert close(M.M, expected) and close(M.joints, expected[:, 6:, 6:])
    parts, whole = floating.closed_form(robot, X, z, V, zd), floating.closed_form(full, X, q, V, qd)
    bias = (whole.c + whole.g) @ T
    assert close(parts.M, expected) and close(parts.c + parts.g, bias)
    solved = torch.linalg.solve(expected, torch.cat([torch.zeros(B, 6, dtype=F64), tau], -1) - bias)
    found = torch.cat([*floating.forward_dynamics(robot, X, z, V, zd, tau)], -1)
    assert close(found, solved, 1e-14 * float(torch.linalg.cond(expected).max()) + WORST)
    assert close(floating.kinetic_energy(robot, X, z, V, zd), floating.kinetic_energy(full, X, q, V, qd))
    J = floating.jacobian(robot, X, z, robot.tip)
    assert close(J, floating.jacobian(full, X, q, robot.tip) @ T)
    for x, y in (
        (floating.momentum(robot, X, z, V, zd), floating.momentum(full, X, q, V, qd)),
        (floating.momentum_rate(robot, X, z, V, zd, A, zdd), floating.momentum_rate(full, X, q, V, qd, A, qdd)),
    ):
        assert all(map(close, x, y))
    Y = floating.regressor(robot, X, z, V, zd, A, zdd)
    assert close(Y, T.T @ floating.regressor(full, X, q, V, qd, A, qdd))


@all_in_one(thinned(["gears", "dense"], ["gears"]))
def test_gradients_on_a_free_base(kind):
    robot = reduced(3, kind, free=True)[0]
    X, (V, _) = dq.exp(random(6)), random(2, 6, seed=1)
    rows = [x.clone().requires_grad_() for x in (*random(3, robot.n), robot.mass, robot.base_mass)]

    def accelerations(z, zd, tau, mass, base_mass):
        changed = robot.replace(mass=mass, base_mass=base_mass)
        return torch.cat([*floating.forward_dynamics(changed, X, z, V, zd, tau)], -1)

    assert torch.autograd.gradcheck(accelerations, rows, fast_mode=True)


def test_a_follower_is_no_coordinate():
    chain = {"panda_joint7": {"panda_joint6": 0.5}, "panda_joint6": {"panda_joint5": -2.0}}
    with refused(torchdq.ArgumentError):
        torchdq.robots.load("panda").couple(chain)


def test_one_number_is_that_of_every_coordinate():
    S, names = [[1.0, 0.0], [1.0, 1.0]], ["a", "b"]
    one, each = (two().couple(S, names, limits=float("inf"), damping=x, friction=x) for x in (0.5, [0.5, 0.5]))
    assert torch.equal(one.damping, each.damping) and torch.equal(one.friction, each.friction)
