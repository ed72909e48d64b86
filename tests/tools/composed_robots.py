"""Robots that have no file of their own, and whether a text that was made of one is that robot."""

import math

import numpy as np
import oracles
import torch
from robots import F64, SHIPPED, on_free_base, states
from urdf_text import joint, link, mimic, random_elements, urdf

import torchdq
from torchdq import Robot, dq, floating
from torchdq.robot.description import Limits


def random_screws(seed):
    """A random tree whose axes pass beside the frames of their links, with limits; a helical joint turns only."""
    robot = oracles.random_tree(6, seed).robot
    l, m = robot.screw[:, :3], robot.screw[:, 3:]
    bounds = torch.arange(1.0, robot.n + 1, dtype=F64)
    bounds[0] = math.inf
    return robot.replace(
        kinds=tuple("prismatic" if kind == "prismatic" else "revolute" for kind in robot.kinds),
        screw=torch.cat([l, m - (l * m).sum(-1, keepdim=True) * l], -1),
        limits=Limits(-bounds, 2 * bounds, 3 * bounds, 4 * bounds),
        damping=torch.linspace(0, 1, robot.n, dtype=F64),
        friction=torch.linspace(1, 0, robot.n, dtype=F64),
    )


def coupled():
    """Joints of a file that follow one of them, one of them backwards from another zero."""
    return Robot.from_urdf(
        urdf(
            *(link(f"l{i}", 1.0 + i) for i in range(4)),
            joint("a", "l0", "l1", xyz=(0, 0, 1), axis=(0, 1, 0)),
            joint("b", "l1", "l2", xyz=(0, 1, 0), axis=(1, 0, 0), more=mimic("a", -0.5, 0.25)),
            joint("c", "l2", "l3", "prismatic", axis=(0, 0, 1), more=mimic("b", 2.0)),
        )
    )


def arm(convention="standard", **more):
    """An arm of six axes from its table, with spherical wrist."""
    h = math.pi / 2
    a = [0.1, 0.6, 0.05, 0.0, 0.0, 0.0]
    alpha = [h, 0.0, h, -h, h, 0.0]
    return Robot.from_dh(a, alpha, [0.4, 0.0, 0.0, 0.5, 0.0, 0.1], [0, h, 0, 0, 0.3, 0], convention=convention, **more)


def poles():
    """Links that are turned by a quarter about y, or nearly, after turns about x: where yaw is not defined."""
    robot = Robot.from_dh(*[[0.1] * 4] * 4, convention="modified").with_rods(4.0)
    turns = (0.3, math.pi / 2), (-2.0, -math.pi / 2), (1.0, math.pi / 2 + 1e-9), (2.0, -math.pi / 2 - 1e-14)
    x, y = (torch.tensor(angles, dtype=F64) / 2 for angles in zip(*turns, strict=True))
    none, place = torch.zeros(4, dtype=F64), torch.tensor([[0.1, 0.2, 0.3]] * 4, dtype=F64)
    X = dq.from_pose(torch.stack([x.cos(), x.sin(), none, none], -1), 0 * place)
    Y = dq.from_pose(torch.stack([y.cos(), none, y.sin(), none], -1), place)
    return robot.replace(X_PB_home=dq.mul(Y, X))


ROBOTS = {
    "poles": poles(),
    **SHIPPED,
    **{f"tree {i}": random_screws(i) for i in range(6)},
    **{f"file {i}": Robot.from_urdf(urdf(*random_elements(i)), on_unphysical="ignore") for i in range(3)},
    "coupled": coupled(),
    "table": arm().with_rods(30.0),
    "modified": arm("modified").with_rods(30.0),
    "turned": arm()
    .with_rods(30.0)
    .couple(
        {"joint2": {"joint2": -1.0}, "joint5": {"joint5": -1.0}, "joint6": {"joint2": 0.5}},
        offset={"joint2": 0.7, "joint6": 1.0},
    ),
    "floating": on_free_base(random_screws(7)),
    "cut": SHIPPED["panda"].lock({"panda_joint3": 0.4}),
    "single": arm().with_rods(30.0).to(torch.float32),
}


AT = torch.eye(8, dtype=F64)[0]  # pose of a base that stands


def torques(robot, q, qd, qdd):
    """Torques of a robot, after the wrench on its base if it floats."""
    if not robot.floating:
        return torchdq.inverse_dynamics(robot, q, qd, qdd)
    return torch.cat([*floating.inverse_dynamics(robot, AT, q, None, qd, None, qdd)], -1)


def poses(robot, q, frames):
    """Matrices of the poses of frames."""
    if robot.floating:
        return dq.to_matrix(floating.forward_kinematics(robot, AT, q, frames))
    return dq.to_matrix(torchdq.forward_kinematics(robot, q, frames))


def require_same_robot(robot, again, limits=Limits._fields):
    """Frames, torques and all numbers of joints agree to rounding; the joints may be in another order."""
    tolerance = 1e-6 if robot.mass.dtype == torch.float32 else 1e-12  # poses in single precision are units to that
    robot = robot.to(F64)
    order = [again.joint_names.index(x) for x in robot.joint_names]
    q, qd, qdd = states(robot.n)
    back = [x[:, np.argsort(order)] for x in (q, qd, qdd)]
    names = [*robot.frame_names]
    assert torch.allclose(poses(robot, q, names), poses(again, back[0], names), atol=tolerance)
    tau, found = torques(robot, q, qd, qdd), torques(again, *back)
    k = found.shape[-1] - robot.n
    found = torch.cat([found[:, :k], found[:, k:][:, order]], -1)
    assert torch.allclose(tau, found, rtol=0, atol=tolerance * float(tau.abs().max()))
    for name in limits:
        a, b = (getattr(r.limits, name) for r in (robot, again))
        assert torch.allclose(a, b[order], rtol=1e-14), name
    for name in ("damping", "friction"):
        a, b = (getattr(r, name) for r in (robot, again))
        assert torch.allclose(a, b[order], rtol=1e-14), name
