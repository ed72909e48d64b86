"""Robots by hand, their states, and comparisons of what is computed with them."""

import numpy as np
import torch

import torchdq
from torchdq import Robot, dq

F64 = torch.float64
EPS = 2.0**-52
LINE = np.array([2.0, -3.0, 6.0, 0.3, -0.8, -0.5]) / 7.0  # screw of a revolute joint
BALL = (0.02, 0, 0.02, 0, 0, 0.02)
FREE_BODY = {"base_mass": 3.0, "base_com": [0.1, -0.05, 0.2], "base_inertia": [0.3, 0.02, 0.4, -0.03, 0.01, 0.5]}
SHIPPED = {name: torchdq.robots.load(name) for name in torchdq.robots.names()}
ARMS = tuple(name for name, x in SHIPPED.items() if not x.floating and x.joint_map is None)  # whose joints are all free


def row(*numbers):
    return torch.tensor(numbers, dtype=F64)


def two():
    return torchdq.robots.load("two_link")


def panda():
    return torchdq.robots.load("panda")


def on_free_base(robot):
    """Robot whose base is a body that moves."""
    return robot.replace(**{name: torch.tensor(x, dtype=F64) for name, x in FREE_BODY.items()}).bake()


def one_joint(screw, **more):
    arguments = {"mass": [2.0], "com": [[0.1, 0.2, 0.3]], "inertia": [BALL]} | more
    return Robot.from_screws([screw], **arguments)


def forked():
    """A turning trunk (about z) of which two arms hang: one turns about x at y = 1, one slides along x at y = -1."""
    return Robot.from_screws(
        [[0, 0, 1, 0, 0, 0], [1, 0, 0, 0, 0, -1], [0, 0, 0, 1, 0, 0]],
        mass=[1.0, 2.0, 3.0],
        com=[[0, 0, 0], [0, 1, -0.5], [0, -1, 0]],
        inertia=[BALL] * 3,
        parents=[-1, 0, 0],
        gravity=(0, 0, -10),
    )


def states(n, rows=5, seed=0):
    """Positions, velocities and accelerations [rows, n]."""
    g = torch.Generator().manual_seed(seed)
    return tuple(2 * torch.randn(rows, n, generator=g, dtype=F64) for _ in range(3))


def torques(robot, seed=0):
    """Torques of a robot, or of the robot in a URDF text, in these states."""
    robot = robot if isinstance(robot, Robot) else Robot.from_urdf(robot)
    return torchdq.inverse_dynamics(robot, *states(robot.n, seed=seed))


def matrices(robot, q, frame=None):
    return dq.to_matrix(torchdq.forward_kinematics(robot, torch.as_tensor(q, dtype=F64), frame))


def same(a, b, tolerance=64 * EPS):
    """Equal up to rounding relative to the largest entry."""
    a, b = (torch.as_tensor(x, dtype=F64) for x in (a, b))
    return a.shape == b.shape and bool((a - b).abs().max() <= tolerance * b.abs().max())


def rotation(rng):
    """Random rotation matrix."""
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diagonal(R))
    return Q if np.linalg.det(Q) > 0 else Q[:, [1, 0, 2]]


def homogeneous(R, p):
    return np.block([[R, np.reshape(p, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


def pose(T):
    return dq.from_matrix(torch.as_tensor(T, dtype=F64))


def noted(robot, code):
    """Sentences of the notes with a code."""
    return [str(note) for note in robot.notes if note.code == code]
