"""Robots from Denavit-Hartenberg tables. Evidence: their homogeneous matrices multiplied out, and joint screws."""

import math

import numpy as np
import pytest
import torch
from helpers import all_in_one
from messages import refused
from robots import BALL, F64, homogeneous, matrices, pose, rotation, same, states, torques
from rotations import about

import torchdq
from torchdq import DescriptionError, Robot, SingularInertiaError

A, ALPHA = [0.1, -0.3, 0.25, 0.0, 0.4], [0.3, -math.pi / 2, 1.1, math.pi / 2, -0.7]
D, THETA = [0.5, 0.1, -0.2, 0.35, 0.0], [0.2, -0.4, math.pi, 0.0, 1.3]
KINDS = ["revolute", "prismatic", "revolute", "revolute", "prismatic"]


def along(axis, angle, distance):
    """Turn about an axis and slide along it."""
    return homogeneous(about(axis, angle), distance * np.array(axis))


def dh_frames(convention, kinds, q):
    """Frames 1..n of the table above at q, in the base frame."""
    T, frames = np.eye(4), []
    for a, alpha, d, theta, kind, q_i in zip(A, ALPHA, D, THETA, kinds, q, strict=True):
        theta, d = (theta + q_i, d) if kind == "revolute" else (theta, d + q_i)
        joint, link = along((0, 0, 1), theta, d), along((1, 0, 0), alpha, a)
        T = T @ (joint @ link if convention == "standard" else link @ joint)
        frames.append(T)
    return np.array(frames)


def dh_bodies():
    rng = np.random.default_rng(3)
    inertia = [R @ np.diag([0.1, 0.2, 0.25]) @ R.T for R in (rotation(rng) for _ in range(5))]
    return {"mass": rng.uniform(0.5, 2, 5), "com": rng.normal(size=(5, 3)), "inertia": inertia}


def dh_robot(convention, kinds=KINDS):
    return Robot.from_dh(A, ALPHA, D, THETA, **dh_bodies(), convention=convention, kinds=kinds)


@all_in_one(["standard", "modified"])
def test_link_frames_are_the_frames_of_the_convention(convention):
    for kinds in (KINDS, ["revolute"] * 5, ["prismatic"] * 5):
        robot = dh_robot(convention, kinds)
        for q in states(5)[0].tolist():
            frames = matrices(robot, q)
            assert same(frames[1:6], dh_frames(convention, kinds, q))
            assert torch.equal(frames[0], torch.eye(4, dtype=F64)) and torch.equal(frames[6], frames[5])
    robot = Robot.from_dh(A, ALPHA, D, THETA, **dh_bodies())  # revolute joints, in the standard convention
    assert same(matrices(robot, [0.1] * 5)[1:6], dh_frames("standard", ["revolute"] * 5, [0.1] * 5))


@all_in_one(["standard", "modified"])
def test_a_table_is_the_same_robot_as_its_screws(convention):
    at_home = dh_frames(convention, KINDS, [0.0] * 5)
    # the joint's axis is the z axis of the frame before in the standard convention, of its own in the modified
    carriers = at_home if convention == "modified" else [np.eye(4), *at_home[:-1]]
    screws = []
    for T, kind in zip(carriers, KINDS, strict=True):
        z, p = T[:3, 2], T[:3, 3]
        screws.append(np.concatenate([z, np.cross(p, z)] if kind == "revolute" else [np.zeros(3), z]))
    same_robot = Robot.from_screws(screws, **dh_bodies(), link_poses=torch.stack([pose(T) for T in at_home]))
    assert same(torques(dh_robot(convention)), torques(same_robot), 1e-12)


def test_the_tip_of_a_table_is_beyond_its_last_frame():
    tool = homogeneous(rotation(np.random.default_rng(5)), [0.1, 0.2, 0.3])
    robot = Robot.from_dh(A, ALPHA, D, THETA, **dh_bodies(), kinds=KINDS, tip_pose=pose(tool))
    q = [0.3, -0.2, 0.5, 0.1, 0.4]
    assert same(matrices(robot, q, "tip"), dh_frames("standard", KINDS, q)[-1] @ tool)


def test_quarter_and_half_turns_of_a_table_are_not_blurred():
    # a half turn has the cosine 6e-17 in floating point; the frame it stands for has 0
    robot = Robot.from_dh([0], [math.pi], [0], [0], mass=[1], com=[[0, 0, 0]], inertia=[BALL], convention="modified")
    assert torch.equal(matrices(robot, [0.0], "tip"), torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=F64)))


def test_a_table_without_masses_has_frames_and_says_what_accelerations_lack(recwarn):
    robot = Robot.from_dh(A, ALPHA, D, THETA, kinds=KINDS)
    q = [0.3, -0.2, 0.5, 0.1, 0.4]
    assert same(matrices(robot, q)[1:6], dh_frames("standard", KINDS, q))
    assert not recwarn.list and "robot.massless" in {note.code for note in robot.notes}
    x = torch.tensor(q, dtype=F64)
    with pytest.raises(SingularInertiaError):
        torchdq.forward_dynamics(robot, x, x, x)
    assert "robot.massless" not in {note.code for note in robot.with_rods(5.0).notes}


BROKEN = [
    *({"kinds": x} for x in (["revolute"], [["revolute"]] * 5, "prism", ["helical"] * 5)),
    *({"convention": x} for x in (["standard"], "craig")),
    *({"a": x} for x in ([0.1], [])),
    {"d": ["x"] * 5},
    {"mass": None},
    {"com": None, "inertia": None},
    {"theta": [math.nan] * 5},
    *({"tip_pose": [0.0] * 8}, {"joint_names": ["a"]}, {"alpha": [0, 90, 0, 0, 0]}, {"theta": [0, 0, 0, 0, -45.0]}),
]


@all_in_one(BROKEN)
def test_a_column_that_does_not_fit_is_named(broken):
    table = {"a": A, "alpha": ALPHA, "d": D, "theta": THETA} | dh_bodies() | broken
    with refused(DescriptionError):
        Robot.from_dh(**table)
