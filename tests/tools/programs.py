"""Robots with programs of every function, run by a backend, and comparisons of what two backends find."""

import torch
from helpers import random, rods
from oracles import EPS, random_tree

import torchdq

F32 = torch.float32


def tree(n: int, armature: bool = True, seeds=range(100)) -> torchdq.Robot:
    """The first random tree with joints of all kinds."""
    cases = (random_tree(n, seed, armature) for seed in seeds)
    return next(case.robot for case in cases if set(case.robot.kinds) == {"revolute", "prismatic", "helical"})


TWO, TREE, PANDA = torchdq.robots.load("two_link"), tree(3), torchdq.robots.load("panda")

FUNCTIONS = {
    "inverse_dynamics": lambda r, s: torchdq.inverse_dynamics(r, s.q, s.qd, s.qdd, s.f_tip, s.f_ext),
    "inverse_dynamics at rest": lambda r, s: torchdq.inverse_dynamics(r, s.q),
    "mass_matrix": lambda r, s: torchdq.mass_matrix(r, s.q),
    "forward_dynamics": lambda r, s: torchdq.forward_dynamics(r, s.q, s.qd, s.qdd, s.f_tip, s.f_ext),
    "closed_form": lambda r, s: tuple(torchdq.closed_form(r, s.q, s.qd)),
    "regressor": lambda r, s: torchdq.regressor(r, s.q, s.qd, s.qdd),
    "kinetic_energy": lambda r, s: torchdq.kinetic_energy(r, s.q, s.qd),
    "potential_energy": lambda r, s: torchdq.potential_energy(r, s.q),
    "forward_kinematics": lambda r, s: torchdq.forward_kinematics(r, s.q),
    "jacobian": lambda r, s: torchdq.jacobian(r, s.q, r.tip),
    "jacobian in world": lambda r, s: torchdq.jacobian(r, s.q, r.tip, "world"),
    "dynamics_jacobian": lambda r, s: torchdq.dynamics_jacobian(r, s.q, s.qd, s.qdd),
    "DQRNEA": lambda r, s: torchdq.DQRNEA(r, learn=("mass",))(s.q, s.qd, s.qdd),
    "ForwardDynamics": lambda r, s: torchdq.ForwardDynamics(r)(s.q, s.qd, s.qdd),
    "ComputedTorque": lambda r, s: torchdq.ComputedTorque(r, 25.0, 10.0)(s.q, s.qd, s.qdd, s.qd, s.q, s.f_tip),
}

# one of each kind: absent arguments, several results, wide ones, solutions, uniform arguments, control
KINDS = ("inverse_dynamics at rest", "closed_form", "regressor", "forward_dynamics", "DQRNEA", "ComputedTorque")


def as_tuple(x):
    return x if isinstance(x, tuple) else (x,)


def on(backend: str, function, *args):
    with torchdq.backend(backend):
        return as_tuple(function(*args))


def condition(name, robot, s):
    """Largest condition number of the mass matrix for a function that solves with it; 1 for the others."""
    solves = "orward" in name and "kinematics" not in name
    return torch.linalg.cond(torchdq.mass_matrix(robot, s.q.double())).max().item() if solves else 1.0


def same(found, expected):
    """Both are equal to the last bit, NaN in the same places."""
    for f, e in zip(found, expected, strict=True):
        torch.testing.assert_close(f, e, rtol=0, atol=0, equal_nan=True)


def agree(found, expected, factor=64.0, dtype=None):
    """Both are the same sums, rounded differently: the error is a multiple of eps and of the largest entry."""
    for f, e in zip(found, expected, strict=True):
        assert f.shape == e.shape and f.dtype == e.dtype
        atol = factor * EPS[dtype or e.dtype] * float(e.detach().abs().max() if e.numel() else 0.0)
        torch.testing.assert_close(f, e, rtol=0, atol=atol, equal_nan=True)


# some of its samples are beyond what float32 may magnify, all are far from singular
MIXED = rods(5, tip=1000.0)


def mixed(batch, dtype=F32):
    q, qd, tau = (x.to(dtype) for x in random(3, batch, MIXED.n))
    return 2 * q, qd, 10 * tau
