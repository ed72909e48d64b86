"""Robots from joint screws, from Denavit-Hartenberg tables and shipped ones, and what can be done with a robot.

Evidence: homogeneous matrices multiplied out here, formulas of one-joint robots, published numbers of the shipped arms,
and description files of two of them that were written by others.
"""

import copy
import dataclasses
import math
import os
import pickle
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from places import DATA

import torchdq
from torchdq import ArgumentError, DescriptionError, DtypeError, Robot, UnknownNameError, UnphysicalError, dq
from torchdq.envs import Scene, effects
from torchdq.robot import Frame

F64 = torch.float64
EPS = 2.0**-52
SHIPPED = torchdq.robots.names()


def states(n, rows=5, seed=0):
    """Positions, velocities and accelerations [rows, n]."""
    g = torch.Generator().manual_seed(seed)
    return tuple(2 * torch.randn(rows, n, generator=g, dtype=F64) for _ in range(3))


def torques(robot, seed=0):
    return torchdq.inverse_dynamics(robot, *states(robot.n, seed=seed))


def same(a, b, tolerance=64 * EPS):
    """Equal up to rounding relative to the largest entry."""
    a, b = (torch.as_tensor(x, dtype=F64) for x in (a, b))
    return a.shape == b.shape and bool((a - b).abs().max() <= tolerance * b.abs().max())


def matrices(robot, q, frame=None):
    return dq.to_matrix(torchdq.forward_kinematics(robot, torch.as_tensor(q, dtype=F64), frame))


def rotation(rng):
    """Random rotation matrix."""
    Q, R = np.linalg.qr(rng.normal(size=(3, 3)))
    Q = Q * np.sign(np.diagonal(R))
    return Q if np.linalg.det(Q) > 0 else Q[:, [1, 0, 2]]


def homogeneous(R, p):
    return np.block([[R, np.reshape(p, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


def pose(T):
    return dq.from_matrix(torch.as_tensor(T, dtype=F64))


# --- joint screws ----------------------------------------------------------------------------------------------------

POINT = np.array([0.3, -0.2, 0.5])
DIRECTION = np.array([2.0, -3.0, 6.0]) / 7.0
LINE = np.concatenate([DIRECTION, np.cross(POINT, DIRECTION)])
SLIDE = np.concatenate([np.zeros(3), DIRECTION])
BALL = (0.02, 0, 0.02, 0, 0, 0.02)


def one_joint(screw, **more):
    arguments = {"mass": [2.0], "com": [[0.1, 0.2, 0.3]], "inertia": [BALL]} | more
    return Robot.from_screws([screw], **arguments)


@pytest.mark.parametrize(
    "screw, kind",
    [(LINE, "revolute"), (SLIDE, "prismatic"), (LINE + 0.1 * SLIDE, "helical"), (LINE - 1e-6 * SLIDE, "helical")],
    ids=["line", "translation", "line with pitch", "line with a small pitch"],
)
def test_the_screw_tells_the_kind_of_joint(screw, kind):
    assert one_joint(screw).kinds == (kind,)


@pytest.mark.parametrize("q", [0.0, 0.7, -2.5])
def test_a_revolute_joint_turns_about_its_line(q):
    T = matrices(one_joint(LINE), [q], "link1").numpy()
    assert same(T[:3, :3] @ DIRECTION, DIRECTION)
    assert same(T[:3, :3] @ POINT + T[:3, 3], POINT)  # points on the line stay
    assert math.isclose((np.trace(T[:3, :3]) - 1) / 2, math.cos(q), abs_tol=1e-15)


def test_a_prismatic_joint_moves_along_its_direction():
    assert same(matrices(one_joint(SLIDE), [0.7], "link1"), homogeneous(np.eye(3), 0.7 * DIRECTION))


def test_a_helical_joint_advances_by_its_pitch():
    T = matrices(one_joint(LINE + 0.1 * SLIDE), [0.7], "link1").numpy()
    assert same(T[:3, :3] @ POINT + T[:3, 3], POINT + 0.1 * 0.7 * DIRECTION)


def test_a_screw_jack_lifts_with_its_pitch():
    """Upright screw of pitch h through the centre of mass: M = I + m h^2, and gravity asks for m g h."""
    robot = Robot.from_screws([[0, 0, 1, 0, 0, 0.05]], mass=[3.0], com=[[0, 0, 0.2]], inertia=[BALL])
    tau = torchdq.inverse_dynamics(robot, *(torch.tensor([x], dtype=F64) for x in (0.4, 1.5, 2.0)))
    assert same(tau, [(0.02 + 3.0 * 0.05**2) * 2.0 + 3.0 * 9.81 * 0.05])


@pytest.mark.case("G14")
@pytest.mark.parametrize(
    "screw",
    [
        [0, 0, 2, 0, 0, 0],
        [0, 0, 0.999999, 0, 0, 0],
        [0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 2],
        [0, 0, 0.5, 0, 0, 1],
    ],
    ids=["twice a line", "not quite a line", "nothing", "twice a translation", "half of each"],
)
def test_what_is_no_screw_is_refused_by_name(screw):
    with pytest.raises(DescriptionError, match=r"joint 'knee': its screw must be a unit line .*found \[0\.0, 0\.0"):
        one_joint(screw, joint_names=["knee"])


@pytest.mark.parametrize(
    "broken, named",
    [
        ({"mass": [1.0, 2.0]}, r"mass must have the shape \(1,\), found \(2,\)"),
        ({"mass": ["heavy"]}, "mass must be an array of numbers"),
        ({"mass": [math.nan]}, "mass must be finite"),
        ({"com": [[0, 0]]}, r"com must have the shape \(1, 3\)"),
        ({"com": [[0, 0, 0], [0]]}, "com must be an array of numbers"),
        ({"inertia": [[1, 2, 3]]}, r"inertia must have the shape \(1, 6\)"),
        ({"inertia": [[[1, 0, 0], [0.1, 1, 0], [0, 0, 1]]]}, "inertia matrices must be symmetric"),
        ({"link_poses": [[0.0] * 8]}, "link_poses must be unit dual quaternions"),
        ({"link_poses": [[1.0] * 7]}, r"link_poses must have the shape \(1, 8\)"),
        ({"tip_pose": [0.0] * 8}, "tip_pose must be unit dual quaternions"),
        ({"parents": [0]}, r"parents must hold, for each of 1 links, an earlier link or -1, found \(0,\)"),
        ({"parents": [-1, 0]}, "parents must hold, for each of 1 links"),
        ({"parents": [None]}, "parents must be an array of numbers"),
        ({"parents": ["a"]}, "parents must be an array of numbers"),
        ({"parents": [0.5]}, r"parents must be a row of whole numbers, found \[0.5\]"),
        ({"parents": [math.nan]}, "parents must be a row of whole numbers"),
        ({"parents": 5}, "parents must be a row of whole numbers, found 5"),
        ({"joint_names": 5}, "joint_names must be 1 different names, found 5"),
        ({"joint_names": "a"}, "joint_names must be 1 different names, found 'a'"),
        ({"link_names": [["a"]]}, "link_names must be 1 different names"),
        ({"name": 5}, "name must be a string, found 5"),
        ({"mass": [1j]}, "mass must be an array of numbers: found complex numbers"),
        ({"com": torch.ones(1, 3, dtype=torch.complex64)}, "com must be an array of numbers: found complex numbers"),
        ({"mass": [1e300]}, r"mass must not exceed 1e\+50 in size, found 1e\+300"),
        ({"home": [-1e300]}, r"home must not exceed 1e\+50 in size"),
        ({"home": [0.0, 0.0]}, r"home must have the shape \(1,\)"),
        ({"home": [math.inf]}, "home must be finite"),
        ({"joint_names": []}, "joint_names must be 1 different names"),
        ({"link_names": ["a", "b"]}, "link_names must be 1 different names"),
        ({"link_names": ["tip"]}, "link_names must not be 'base' or 'tip'"),
    ],
)
def test_an_argument_that_does_not_fit_is_named(broken, named):
    with pytest.raises(DescriptionError, match=named):
        one_joint(LINE, **broken)


@pytest.mark.parametrize("screws", [[], 3.0, [[0, 0, 1, 0, 0]], "z"], ids=["none", "a number", "five", "a word"])
def test_joint_screws_are_an_array_of_sixes(screws):
    with pytest.raises(DescriptionError, match="joint_screws"):
        Robot.from_screws(screws, mass=[1.0], com=[[0, 0, 0]], inertia=[BALL])


def test_a_list_of_arrays_is_an_array():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = Robot.from_screws([LINE, SLIDE], mass=np.ones(2), com=[np.zeros(3)] * 2, inertia=[0.1 * np.eye(3)] * 2)
    assert same(robot.screw, np.array([LINE, SLIDE]))


def test_a_robot_does_not_change_with_the_arrays_it_was_made_of():
    mass = np.array([2.0])
    robot = one_joint(LINE, mass=mass)
    mass[0] = 3.0
    assert robot.mass.tolist() == [2.0]


def test_names_must_differ():
    with pytest.raises(DescriptionError, match="joint_names must be 2 different names"):
        Robot.from_screws(
            [LINE, SLIDE], mass=[1, 1], com=[[0, 0, 0]] * 2, inertia=[BALL] * 2, joint_names=["knee", "knee"]
        )


@pytest.mark.case("I1")
def test_a_link_without_a_body_is_noted():
    robot = one_joint(LINE, mass=[0.0], inertia=[(0,) * 6])
    with pytest.raises(UnphysicalError) as refused:
        robot.check()
    (note,), (fault,) = robot.notes, refused.value.findings
    assert note == fault and (note.code, note.subject) == ("joint.inert", "joint 'joint1'")


def test_an_inertia_may_be_a_matrix():
    rng = np.random.default_rng(0)
    R = rotation(rng)
    matrix = R @ np.diag([0.1, 0.2, 0.25]) @ R.T  # symmetric up to rounding only
    six = (matrix[0, 0], matrix[0, 1], matrix[1, 1], matrix[0, 2], matrix[1, 2], matrix[2, 2])
    assert same(torques(one_joint(LINE, inertia=[matrix])), torques(one_joint(LINE, inertia=[six])))


# --- home, trees, link frames ----------------------------------------------------------------------------------------


def random_chain(frames="base", home=None, n=4, seed=1):
    """The same random chain with its links described in other frames: the base frame, at the joints, or at the
    centres of mass with random axes."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    points, coms, mass = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), rng.uniform(0.5, 2, n)
    turns = [rotation(rng) for _ in range(n)]
    inertia = [R @ np.diag([0.1, 0.2, 0.25]) @ R.T for R in (rotation(rng) for _ in range(n))]
    screws = [np.concatenate([a, np.cross(p, a)]) for a, p in zip(axes, points, strict=True)]
    screws[2] = np.concatenate([np.zeros(3), axes[2]])
    tip = pose(homogeneous(rotation(rng), rng.normal(size=3)))
    common = {"mass": mass, "tip_pose": tip, "home": home}
    if frames == "base":
        return Robot.from_screws(screws, com=coms, inertia=inertia, **common)
    origins = points if frames == "joint" else coms
    return Robot.from_screws(
        screws,
        com=[R.T @ (c - p) for R, c, p in zip(turns, coms, origins, strict=True)],
        inertia=[R.T @ I @ R for R, I in zip(turns, inertia, strict=True)],
        link_poses=torch.stack([pose(homogeneous(R, p)) for R, p in zip(turns, origins, strict=True)]),
        **common,
    )


@pytest.mark.parametrize("frames", ["joint", "centre of mass"])
def test_torques_do_not_depend_on_the_link_frames(frames):
    assert same(torques(random_chain(frames)), torques(random_chain("base")), 1e-12)


@pytest.mark.parametrize("frames", ["joint", "centre of mass"])
def test_the_tip_does_not_depend_on_the_link_frames(frames):
    q, qd, qdd = states(4)
    f = torch.randn(5, 6, generator=torch.Generator().manual_seed(7), dtype=F64)
    tau, reference = (
        torchdq.inverse_dynamics(robot, q, qd, qdd, f_tip=f) for robot in (random_chain(frames), random_chain("base"))
    )
    assert same(tau, reference, 1e-12)


def test_without_link_poses_all_link_frames_are_the_base_frame_at_home():
    T = matrices(random_chain("base"), [0.0] * 4)
    assert same(T[:-1], torch.eye(4).expand(5, 4, 4))


def test_home_is_where_the_poses_hold():
    home = [0.3, -0.4, 0.5, -0.6]
    assert same(matrices(random_chain("joint", home), home), matrices(random_chain("joint"), [0.0] * 4))


def test_home_shifts_the_positions_and_nothing_else():
    home = torch.tensor([0.3, -0.4, 0.5, -0.6], dtype=F64)
    q, qd, qdd = states(4)
    tau = torchdq.inverse_dynamics(random_chain("joint", home), q + home, qd, qdd)
    assert same(tau, torchdq.inverse_dynamics(random_chain("joint"), q, qd, qdd), 1e-13)


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


@pytest.mark.case("U10")
def test_arms_of_a_tree_hang_on_the_trunk_not_on_each_other():
    at_rest = matrices(forked(), [0.2, 0.0, 0.0], "link3")
    assert same(matrices(forked(), [0.2, 0.9, 0.0], "link3"), at_rest)
    assert not same(matrices(forked(), [0.5, 0.0, 0.0], "link3"), at_rest)


@pytest.mark.case("U10")
def test_the_mass_matrix_of_a_tree_is_its_textbook_one():
    q2, q3 = 0.9, 0.4
    # the turning arm's centre of mass: 0.5 below x-axis at y = 1, swung by q2 about x
    y = 1 + 0.5 * math.sin(q2)
    trunk = 3 * 0.02 + 2 * y**2 + 3 * (1 + q3**2)
    # turning the trunk moves the slide along x: -y = 1 m away from it
    M = [[trunk, 0, 3.0], [0, 0.02 + 2 * 0.25, 0], [3.0, 0, 3.0]]
    assert same(torchdq.mass_matrix(forked(), torch.tensor([0.3, q2, q3], dtype=F64)), M)


# --- Denavit-Hartenberg ----------------------------------------------------------------------------------------------

A, ALPHA = [0.1, -0.3, 0.25, 0.0, 0.4], [0.3, -math.pi / 2, 1.1, math.pi / 2, -0.7]
D, THETA = [0.5, 0.1, -0.2, 0.35, 0.0], [0.2, -0.4, math.pi, 0.0, 1.3]
KINDS = ["revolute", "prismatic", "revolute", "revolute", "prismatic"]


def rot(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    R = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis]
    return homogeneous(np.array(R), np.zeros(3))


def trans(axis, distance):
    return homogeneous(np.eye(3), {"x": [distance, 0, 0], "z": [0, 0, distance]}[axis])


def dh_frames(convention, kinds, q):
    """Frames 1..n of the table above at q, in the base frame."""
    T, frames = np.eye(4), []
    for a, alpha, d, theta, kind, q_i in zip(A, ALPHA, D, THETA, kinds, q, strict=True):
        theta, d = (theta + q_i, d) if kind == "revolute" else (theta, d + q_i)
        joint, link = rot("z", theta) @ trans("z", d), rot("x", alpha) @ trans("x", a)
        T = T @ (joint @ link if convention == "standard" else link @ joint)
        frames.append(T)
    return np.array(frames)


def dh_bodies():
    rng = np.random.default_rng(3)
    inertia = [R @ np.diag([0.1, 0.2, 0.25]) @ R.T for R in (rotation(rng) for _ in range(5))]
    return {"mass": rng.uniform(0.5, 2, 5), "com": rng.normal(size=(5, 3)), "inertia": inertia}


def dh_robot(convention, kinds=KINDS):
    return Robot.from_dh(A, ALPHA, D, THETA, **dh_bodies(), convention=convention, kinds=kinds)


@pytest.mark.parametrize("kinds", [KINDS, ["revolute"] * 5, ["prismatic"] * 5], ids=["mixed", "revolute", "prismatic"])
@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_link_frames_are_the_frames_of_the_convention(convention, kinds):
    robot = dh_robot(convention, kinds)
    for q in states(5)[0].tolist():
        frames = matrices(robot, q)
        assert same(frames[1:6], dh_frames(convention, kinds, q))
        assert torch.equal(frames[0], torch.eye(4, dtype=F64)) and torch.equal(frames[6], frames[5])


def test_all_joints_are_revolute_unless_told_otherwise():
    robot = Robot.from_dh(A, ALPHA, D, THETA, **dh_bodies())
    assert robot.kinds == ("revolute",) * 5


def test_the_convention_is_standard_unless_told_otherwise():
    robot = Robot.from_dh(A, ALPHA, D, THETA, **dh_bodies())
    assert same(matrices(robot, [0.1] * 5)[1:6], dh_frames("standard", ["revolute"] * 5, [0.1] * 5))


@pytest.mark.parametrize("convention", ["standard", "modified"])
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


@pytest.mark.parametrize(
    "broken, named",
    [
        ({"a": [0.1]}, r"alpha must have the shape \(1,\), found \(5,\)"),
        ({"a": []}, "a must hold a number"),
        ({"d": ["x"] * 5}, "d must be an array of numbers"),
        ({"theta": [math.nan] * 5}, "theta must be finite"),
        ({"kinds": ["revolute"]}, "kinds must be 5 times"),
        ({"kinds": [["revolute"]] * 5}, "kinds must be 5 times"),
        ({"kinds": "prism"}, "kinds must be 5 times"),
        ({"convention": ["standard"]}, "convention must be 'standard' or 'modified', found"),
        ({"kinds": ["helical"] * 5}, "kinds must be 5 times 'revolute' or 'prismatic'"),
        ({"convention": "craig"}, "convention must be 'standard' or 'modified', found 'craig'"),
        ({"tip_pose": [0.0] * 8}, "tip_pose must be unit dual quaternions"),
        ({"joint_names": ["a"]}, "joint_names must be 5 different names"),
        ({"alpha": [0, 90, 0, 0, 0]}, "alpha must be in radians, found 90 in row 2, more than a whole turn; multiply"),
        ({"theta": [0, 0, 0, 0, -45.0]}, "theta must be in radians, found -45 in row 5, .* degrees by pi/180"),
    ],
)
def test_a_column_that_does_not_fit_is_named(broken, named):
    table = {"a": A, "alpha": ALPHA, "d": D, "theta": THETA} | dh_bodies() | broken
    with pytest.raises(DescriptionError, match=named):
        Robot.from_dh(**table)


# --- shipped robots --------------------------------------------------------------------------------------------------


def test_an_unknown_robot_names_the_closest():
    with pytest.raises(UnknownNameError, match="no shipped robot named 'pumas'; did you mean 'puma560'"):
        torchdq.robots.load("pumas")


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_robot_has_its_name(name):
    assert torchdq.robots.load(name).name == name


@pytest.mark.parametrize("name", sorted(set(SHIPPED) - {"puma560"}))
def test_a_shipped_robot_is_physical(name):
    assert torchdq.robots.load(name).notes == ()


def test_what_is_unphysical_about_the_puma_is_reported():
    found = [(note.code, note.subject) for note in torchdq.robots.load("puma560").notes]
    assert found == [("inertia.massless", "link 'link1'"), ("inertia.triangle", "link 'link3'")]


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_robot_has_an_invertible_mass_matrix(name):
    robot = torchdq.robots.load(name)
    M = torchdq.mass_matrix(robot, states(robot.n)[0])
    assert bool((torch.linalg.eigvalsh(M) > 0).all())


# two links: thin rods of 1 m and 1 kg, gravity along -y


def test_two_link_reaches_two_metres():
    robot = torchdq.robots.load("two_link")
    q = torch.tensor([0.3, -0.7], dtype=F64)
    x, y = math.cos(0.3) + math.cos(-0.4), math.sin(0.3) + math.sin(-0.4)
    assert same(dq.translation(torchdq.forward_kinematics(robot, q, "tip")), [x, y, 0])


def test_two_link_obeys_the_textbook_equations():
    """Spong, Hutchinson, Vidyasagar, "Robot Modeling and Control", the planar elbow manipulator."""
    q, qd, qdd = states(2)
    (q1, q2), (v1, v2), (a1, a2) = (x.unbind(-1) for x in (q, qd, qdd))
    m, l, lc, I, g = 1.0, 1.0, 0.5, 1.0 / 12, 9.81
    m11 = m * lc**2 + m * (l**2 + lc**2 + 2 * l * lc * q2.cos()) + 2 * I
    m12 = m * (lc**2 + l * lc * q2.cos()) + I
    m22 = m * lc**2 + I
    h = -m * l * lc * q2.sin()
    g2 = m * lc * g * (q1 + q2).cos()
    tau1 = m11 * a1 + m12 * a2 + h * v2 * (2 * v1 + v2) + (m * lc + m * l) * g * q1.cos() + g2
    tau2 = m12 * a1 + m22 * a2 - h * v1**2 + g2
    assert same(torques(torchdq.robots.load("two_link")), torch.stack([tau1, tau2], -1))


# Puma 560: numbers of roboticstoolbox-python 1.5, models.DH.Puma560, which were compared with Armstrong's at its time

PUMA_NOMINAL = [0.0, math.pi / 4, math.pi, 0.0, math.pi / 4, 0.0]
PUMA_STATE = [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0.3, -0.2, 0.4, 0.1, -0.5, 0.2], [1.0, -2.0, 0.5, 0.3, -0.2, 0.7]]
PUMA_MASS_MATRIX = [  # at PUMA_STATE's position, rotors included
    [3.594546204022791, -0.2842919855935946, -0.12380871234468933, 1.2907965647417233e-3, -3.176286355050085e-4],
    [-0.2842919855935946, 4.226093323818544, 0.2572827791920638, -1.966838791659495e-4, 7.020036070616297e-4],
    [-0.12380871234468933, 0.2572827791920638, 0.9382744135035835, -2.652958471209572e-4, 1.5686371285474438e-3],
    [1.2907965647417233e-3, -1.966838791659495e-4, -2.652958471209572e-4, 0.19247709236660285, 0.0],
    [-3.176286355050085e-4, 7.020036070616297e-4, 1.5686371285474438e-3, 0.0, 0.17134845165700002],
]
PUMA_TORQUES = [  # without friction
    4.086796449588486,
    23.728694457656573,
    -4.132546652657011,
    0.06180156899440089,
    -0.05792859529263268,
    0.13589778325405374,
]
PUMA_HAND = [  # at PUMA_STATE's position, without a base of 0.67183 m
    [0.12169768141653306, -0.6066717260175295, -0.7855820079334506, 0.2478027469236375],
    [0.8183638247039288, 0.5091974688455275, -0.2664556025631021, -0.1259401814515313],
    [0.561667450324298, -0.6104648675986358, 0.5584463453851071, 1.1462879056952355],
    [0.0, 0.0, 0.0, 1.0],
]


def test_puma_holds_the_published_gravity_load():
    """P. Corke, "Robotics, Vision and Control", gravity load of p560 at the nominal position."""
    g = torchdq.inverse_dynamics(torchdq.robots.load("puma560"), torch.tensor(PUMA_NOMINAL, dtype=F64))
    assert torch.allclose(g, torch.tensor([0, 31.6399, 6.0351, 0, 0.0283, 0], dtype=F64), rtol=0, atol=5e-5)


def test_puma_has_the_toolbox_mass_matrix():
    M = torchdq.mass_matrix(torchdq.robots.load("puma560"), torch.tensor(PUMA_STATE[0], dtype=F64))
    assert same(M[:5, :5], PUMA_MASS_MATRIX, 1e-14)
    assert math.isclose(float(M[5, 5]), 0.19410450566800005, rel_tol=1e-14)


def test_puma_has_the_toolbox_torques():
    tau = torchdq.inverse_dynamics(torchdq.robots.load("puma560"), *torch.tensor(PUMA_STATE, dtype=F64))
    assert same(tau, PUMA_TORQUES, 1e-14)


def test_puma_has_the_toolbox_kinematics():
    assert same(matrices(torchdq.robots.load("puma560"), PUMA_STATE[0], "tip"), PUMA_HAND)


# Panda and UR10e: description files that others wrote


def file_of_others(*parts):
    """A file of the data that is kept beside a checkout, or in the folder that TORCHDQ_DATA names."""
    beside = DATA
    path = Path(os.environ.get("TORCHDQ_DATA", beside)).joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{'/'.join(parts)} is not in the folder of TORCHDQ_DATA, nor in ../shared/data")
    return path


FILES = {
    # name: file, relative tolerance of the torques
    "panda": (("panda_gaz2019", "panda_gaz2019.urdf"), 1e-10),
    "ur10e": (("ur10e_innopolis", "ur10e.urdf"), 1e-9),  # its quarter turns are printed with 12 digits
}


@pytest.mark.parametrize("name", FILES)
def test_a_shipped_robot_is_the_robot_of_its_file(name):
    parts, tolerance = FILES[name]
    robot, described = torchdq.robots.load(name), Robot.from_urdf(file_of_others(*parts))
    assert robot.joint_names == described.joint_names
    assert same(torques(robot), torques(described), tolerance)


@pytest.mark.parametrize("field", ["mass", "com", "inertia"])
@pytest.mark.parametrize("name", FILES)
def test_the_bodies_of_a_shipped_robot_are_those_of_its_file(name, field):
    # torques alone would not do: what link 1 has along its upright axis never shows in them
    parts, _ = FILES[name]
    assert same(getattr(torchdq.robots.load(name), field), getattr(Robot.from_urdf(file_of_others(*parts)), field))


@pytest.mark.parametrize("name", FILES)
def test_the_links_of_a_shipped_robot_are_where_its_file_has_them(name):
    parts, _ = FILES[name]
    robot, described = torchdq.robots.load(name), Robot.from_urdf(file_of_others(*parts))
    assert robot.link_names == described.link_names
    for q in states(robot.n)[0]:
        for link in robot.link_names:
            assert same(matrices(robot, q, link), matrices(described, q, link), 1e-10)


@pytest.mark.parametrize("name", FILES)
def test_the_limits_of_a_shipped_robot_are_those_of_its_file(name):
    parts, _ = FILES[name]
    for ours, theirs in zip(
        torchdq.robots.load(name).limits, Robot.from_urdf(file_of_others(*parts)).limits, strict=True
    ):
        assert torch.allclose(ours, theirs, rtol=1e-10)


def test_the_tool_of_the_ur10e_is_that_of_its_file():
    described = Robot.from_urdf(file_of_others("ur10e_innopolis", "ur10e.urdf"))
    q = states(6)[0][0]
    assert same(matrices(torchdq.robots.load("ur10e"), q, "tip"), matrices(described, q, "tool0"), 1e-10)


def test_panda_at_zero_points_down():
    """Straight up to the elbow offsets, which cancel, out by 0.088 m, and the flange 0.107 m down again."""
    T = matrices(torchdq.robots.load("panda"), [0.0] * 7, "tip")
    assert same(T[:3, 3], [0.088, 0, 0.333 + 0.316 + 0.384 - 0.107])
    assert same(T[:3, :3], np.diag([1.0, -1.0, -1.0]))


# --- what can be done with a robot -----------------------------------------------------------------------------------


def panda():
    return torchdq.robots.load("panda")


def tensors(robot):
    fields = {f.name: getattr(robot, f.name) for f in dataclasses.fields(robot)}
    found = {name: x for name, x in fields.items() if isinstance(x, torch.Tensor)}
    found |= {f"limits.{name}": x for name, x in robot.limits._asdict().items()}
    return found | {f"frame {frame.name}": frame.X_BF for frame in robot.frames}


@pytest.mark.parametrize("name", SHIPPED)
def test_no_function_modifies_a_robot(name):
    robot = torchdq.robots.load(name)
    before = {key: x.clone() for key, x in tensors(robot).items()}
    q, qd, qdd = states(robot.n)
    torchdq.inverse_dynamics(robot, q, qd, qdd, torch.ones(6, dtype=F64), torch.ones(robot.n, 6, dtype=F64))
    torchdq.forward_dynamics(robot, q, qd, qdd)
    torchdq.closed_form(robot, q, qd)
    torchdq.regressor(robot, q, qd, qdd)
    torchdq.dynamics_jacobian(robot, q, qd, qdd)
    torchdq.forward_kinematics(robot, q)
    torchdq.jacobian(robot, q, "tip")
    torchdq.inverse_dynamics(robot, q.float())
    robot.replace(mass=2 * robot.mass).to(torch.float32).with_tip("base").report()
    assert all(torch.equal(x, before[key]) for key, x in tensors(robot).items())


def test_a_robot_cannot_be_changed_in_place():
    with pytest.raises(dataclasses.FrozenInstanceError):
        panda().mass = torch.ones(7)


def test_parameters_are_kept_in_double_precision():
    assert {x.dtype for x in tensors(panda()).values()} == {F64}


def test_a_robot_can_be_cast():
    assert {x.dtype for x in tensors(panda().to(torch.float32)).values()} == {torch.float32}


def test_a_robot_without_values_takes_no_arguments_with_values():
    robot = two().to("meta")
    for function in (torchdq.inverse_dynamics, torchdq.forward_kinematics, torchdq.mass_matrix):
        with pytest.raises(torchdq.ArgumentError, match="is on the device 'meta', where tensors have no"):
            function(robot, torch.zeros(2))
        assert function(robot, torch.zeros(2, device="meta")).is_meta


@pytest.mark.parametrize("field", ["mass", "com", "gravity"])
def test_tensors_without_values_make_results_without_values_or_are_named(field):
    robot = two()
    robot = robot.replace(**{field: getattr(robot, field).to("meta")})
    for function in (torchdq.inverse_dynamics, torchdq.mass_matrix):
        with pytest.raises(
            ArgumentError, match=f"^robot.{field} is on the device 'meta', where tensors have no values"
        ):
            function(robot, torch.zeros(2))
        assert function(robot, torch.zeros(2, device="meta")).is_meta
    assert "2 joints" in repr(robot)


def test_a_robot_is_converted_as_tensors_of_torch_are():
    robot = two()
    for same in (robot.to("float32"), robot.to(torch.float32), robot.to(dtype="float32"), robot.to("float32", "cpu")):
        assert {x.dtype for x in tensors(same).values()} == {torch.float32}
    for same in (robot.to("meta"), robot.to(torch.device("meta")), robot.to(device="meta")):
        assert {x.device.type for x in tensors(same).values()} == {"meta"}
    with pytest.raises(torchdq.ArgumentError, match="device must be a device that torch has"):
        robot.to("gpu")
    with pytest.raises(torchdq.ArgumentError, match="one device must be given, found 'cpu' and 'meta'"):
        robot.to("cpu", "meta")
    with pytest.raises(torchdq.DtypeError, match=r"dtype must be torch\.float32"):
        robot.to(torch.float16)


def test_a_robot_can_be_moved():
    robot = torchdq.robots.load("puma560").to(device="meta")
    assert {x.device.type for x in tensors(robot).values()} == {"meta"}


def test_replace_shares_the_rest():
    robot = panda()
    heavier = robot.replace(mass=2 * robot.mass)
    assert heavier.com is robot.com and torch.equal(heavier.mass, 2 * robot.mass)


@pytest.mark.parametrize(
    "field, shape, expected",
    [
        ("mass", (6,), r"\[\.\.\., 7\]"),
        ("mass", (7, 1), r"\[\.\.\., 7\]"),
        ("mass", (), r"\[\.\.\., 7\]"),
        ("com", (7,), r"\[\.\.\., 7, 3\]"),
        ("inertia", (7, 3, 3), r"\[\.\.\., 7, 6\]"),
        ("X_PB_home", (8,), r"\[\.\.\., 7, 8\]"),
        ("screw", (6, 6), r"\[\.\.\., 7, 6\]"),
        ("gravity", (2,), r"\[\.\.\., 3\]"),
        ("home", (1,), r"\[\.\.\., 7\]"),
        ("armature", (8,), r"\[\.\.\., 7\]"),
    ],
)
def test_replace_checks_shapes(field, shape, expected):
    with pytest.raises(ArgumentError, match=rf"{field} of robot 'panda' must be a tensor of shape {expected}"):
        panda().replace(**{field: torch.zeros(shape, dtype=F64)})


@pytest.mark.parametrize("value", [None, [1.0] * 7, 3.0])
def test_replace_wants_tensors(value):
    with pytest.raises(ArgumentError, match="mass of robot 'panda' must be a tensor"):
        panda().replace(mass=value)


@pytest.mark.case("P7")
def test_replace_refuses_integers():
    with pytest.raises(DtypeError, match="mass of robot 'panda' must be float32 or float64"):
        panda().replace(mass=torch.ones(7, dtype=torch.int64))


def test_the_tip_can_be_another_frame():
    robot = panda().with_tip("panda_link3")
    assert robot.tip == "panda_link3" and panda().with_tip(None).tip is None


def test_a_tip_that_does_not_exist_names_the_closest():
    with pytest.raises(UnknownNameError, match="frame of robot 'panda' named 'panda_link9'; did you mean 'panda_link"):
        panda().with_tip("panda_link9")


def test_a_frame_has_a_name_a_link_and_a_pose():
    frame = panda().frame("tip")
    assert isinstance(frame, Frame) and frame.name == "tip" and frame.link == 6
    assert same(frame.X_BF, [1, 0, 0, 0, 0, 0, 0, 0.107 / 2])


def test_the_base_is_a_frame():
    assert panda().frame("base").link == -1


def test_a_frame_that_does_not_exist_names_the_closest():
    with pytest.raises(UnknownNameError, match="did you mean 'tip'"):
        panda().frame("tips")


def test_a_joint_is_found_by_name():
    assert panda().joint_index("panda_joint3") == 2


@pytest.mark.parametrize("error", [KeyError, UnknownNameError])
def test_a_joint_that_does_not_exist_names_the_closest(error):
    with pytest.raises(error, match="joint of robot 'panda' named 'joint3'; did you mean 'panda_joint"):
        panda().joint_index("joint3")


@pytest.mark.parametrize("name", SHIPPED)
def test_the_regressor_times_the_parameters_is_the_torque(name):
    robot = torchdq.robots.load(name).replace(armature=None)
    q, qd, qdd = states(robot.n)
    Y = torchdq.regressor(robot, q, qd, qdd)
    assert same(Y @ robot.inertial_parameters, torchdq.inverse_dynamics(robot, q, qd, qdd), 1e-13)


def test_the_inertial_parameters_are_those_about_the_link_frame():
    robot = one_joint(LINE, inertia=[(0.04, 0.001, 0.05, -0.002, 0.003, 0.03)])
    m, (x, y, z) = 2.0, (0.1, 0.2, 0.3)
    expected = [m, m * x, m * y, m * z, 0.04 + m * (y * y + z * z), 0.001 - m * x * y, 0.05 + m * (x * x + z * z)]
    expected += [-0.002 - m * x * z, 0.003 - m * y * z, 0.03 + m * (x * x + y * y)]
    assert same(robot.inertial_parameters, expected)


def test_repr_says_what_it_is():
    assert repr(panda()) == "Robot('panda', 7 joints, chain, 16.06 kg, tip='tip')"
    assert "tree" in repr(forked())


def test_the_report_names_every_joint_with_its_link_and_limits():
    rows = panda().report().joints
    assert rows[3] == ("panda_joint4", "revolute", "panda_link4", "3.588 kg", "[-3.072, -0.0698]")
    assert len(rows) == 7


def test_the_report_says_what_is_used():
    text = str(torchdq.robots.load("puma560").report())
    for part in ("Robot('puma560'", "mass, centre of mass and inertia", "gravity [0.0, 0.0, -9.81]", "rotor inertia"):
        assert part in text


def test_the_report_does_not_speak_of_what_is_absent():
    text = str(panda().replace(gravity=None).report())
    assert "gravity" not in text and "rotor" not in text


def test_the_report_says_that_limits_are_not_enforced():
    assert "limits (not enforced)" in str(panda().report())


def test_the_report_of_an_unremarkable_robot_says_so():
    assert "nothing else in the description" in str(panda().report())


# --- batches of robots -----------------------------------------------------------------------------------------------


def randomised(field, rows=3):
    """The Puma with a batch of one of its tensors."""
    robot = torchdq.robots.load("puma560")
    value = getattr(robot, field)
    g = torch.Generator().manual_seed(11)
    factors = 1 + 0.1 * torch.rand(rows, *[1] * value.ndim, generator=g, dtype=F64)
    return robot.replace(**{field: factors * value})


@pytest.mark.parametrize("field", ["mass", "com", "inertia", "gravity", "armature"])
@pytest.mark.parametrize("backend", ["auto", "eager"])
def test_a_row_of_a_batch_of_robots_is_that_robot_alone(backend, field):
    robots = randomised(field)
    q, qd, qdd = states(6, rows=3)
    with torchdq.backend(backend):
        tau = torchdq.inverse_dynamics(robots, q, qd, qdd)
        for row in range(3):
            alone = robots.replace(**{field: getattr(robots, field)[row]})
            # up to rounding: one robot's numbers are folded once, those of many are worked on in every row
            assert same(tau[row], torchdq.inverse_dynamics(alone, q[row], qd[row], qdd[row]))


def test_batches_of_robots_and_of_states_broadcast():
    q = states(6, rows=5)[0].unsqueeze(1)
    assert torchdq.inverse_dynamics(randomised("mass"), q).shape == (5, 3, 6)


def test_a_batch_of_robots_takes_one_state():
    assert torchdq.mass_matrix(randomised("mass"), torch.zeros(6, dtype=F64)).shape == (3, 6, 6)


@pytest.mark.parametrize("field", ["mass", "com", "inertia"])
def test_a_batch_of_robots_has_a_batch_of_parameters(field):
    robots = randomised(field)
    q, qd, qdd = states(6, rows=3)
    assert robots.inertial_parameters.shape == (3, 60)
    Y = torchdq.regressor(robots, q, qd, qdd)
    tau = torchdq.inverse_dynamics(robots.replace(armature=None), q, qd, qdd)
    assert same((Y @ robots.inertial_parameters.unsqueeze(-1)).squeeze(-1), tau, 1e-13)


def test_a_batch_of_robots_is_reported_by_its_mean():
    robots = panda().replace(mass=torch.stack([panda().mass, 3 * panda().mass]))
    assert "32.12 kg" in repr(robots) and robots.report().joints[3][3] == "7.176 kg"


# --- changes that would go unseen -------------------------------------------------------------------------------------


CONSTANTS = [
    "mass",
    "com",
    "inertia",
    "gravity",
    "X_PB_home",
    "screw",
    "damping",
    "friction",
    "limits.effort",
    "frame tip",
]


def uses(robot):
    """Everything that reads a robot's constants."""
    q = torch.ones(robot.n, dtype=F64)
    return {
        "function": lambda: torchdq.inverse_dynamics(robot, q),
        "kinematics": lambda: torchdq.forward_kinematics(robot, q),
        "module": lambda: torchdq.DQRNEA(robot)(q),
        "learned module": lambda: torchdq.DQRNEA(robot, learn=("home",) if robot.home is not None else ("offset",))(q),
        "compile": lambda: torchdq.compile(robot, "inverse_dynamics"),
        "scene": lambda: Scene(robot, (effects.Gravity(),)),
        "replace": lambda: robot.replace(com=robot.com.clone()),
        "with_tip": lambda: robot.with_tip(None),
        "to": lambda: robot.to(torch.float32),
        "bake": lambda: robot.bake(),
        "tree": lambda: robot.tree(),
        "report": lambda: robot.report(),
        "parameters": lambda: robot.inertial_parameters,
        "pickle": lambda: pickle.dumps(robot),
        "copy": lambda: copy.deepcopy(robot),
        "check": lambda: robot.check(),
    }


USES = list(uses(torchdq.robots.load("two_link")))


@pytest.mark.parametrize("use", USES)
def test_a_constant_that_was_changed_in_place_is_told_at_the_next_use(use):
    robot = torchdq.robots.load("two_link")
    uses(robot)[use]()
    robot.mass.mul_(2)
    with pytest.raises(
        ArgumentError, match=r"mass of robot 'two_link' was changed in place.* robot\.replace\(mass=\.\.\.\)"
    ):
        uses(robot)[use]()


@pytest.mark.parametrize("name", CONSTANTS)
def test_every_constant_is_watched(name):
    robot = torchdq.robots.load("two_link")
    tensors(robot)[name].fill_(3)
    with pytest.raises(ArgumentError, match=f"{name.split('.')[0].split(' ')[0]}.* was changed in place"):
        torchdq.inverse_dynamics(robot, torch.ones(2, dtype=F64))


def test_a_scene_sees_that_its_robot_was_changed_in_place():
    robot = torchdq.robots.load("two_link")
    scene, q = Scene(robot, (effects.Viscous(),)), torch.zeros(2, dtype=F64)
    scene.step(scene.start(q, q))
    robot.damping.add_(5.0)
    with pytest.raises(ArgumentError, match="damping of robot 'two_link' was changed in place"):
        scene.step(scene.start(q, q))


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
@pytest.mark.parametrize("field", ["mass", "limits"])
def test_copies_are_watched_too(copied, field):
    original = torchdq.robots.load("two_link")
    robot = copied(original)
    assert torch.equal(torques(robot), torques(original))
    (robot.mass if field == "mass" else robot.limits.lower).fill_(3)
    with pytest.raises(ArgumentError, match=f"{field} of robot 'two_link' was changed in place"):
        torques(robot)
    torques(original)


def test_a_robot_shares_no_tensor_with_another_by_chance():
    a, b = (Robot.from_screws([LINE], [2.0], [[0.1, 0.2, 0.3]], [BALL]) for _ in range(2))
    a.frames[0].X_BF.mul_(2)
    torques(b)
    mass = torch.ones(1, dtype=F64)
    baked = b.replace(mass=mass).bake()
    mass.mul_(3)
    assert baked.mass.tolist() == [1.0]
    torques(baked)


def test_a_replaced_tensor_may_be_changed_in_place():
    robot = torchdq.robots.load("two_link")
    q, mass = torch.ones(2, dtype=F64), torch.nn.Parameter(robot.mass)  # one storage with the robot
    learned = robot.replace(mass=mass)
    before = torchdq.inverse_dynamics(learned, q)
    with torch.no_grad():
        mass.mul_(2)
    assert not torch.equal(torchdq.inverse_dynamics(learned, q), before)
    with pytest.raises(ArgumentError, match="mass of robot 'two_link' was changed in place"):
        torchdq.inverse_dynamics(robot, q)


@pytest.mark.parametrize("field", ["damping", "friction", "limits", "frames"])
def test_other_replaced_tensors_are_copied(field):
    """Writing into the given tensor changes neither the robot nor a scene; into the robot's own it is refused."""
    robot = torchdq.robots.load("two_link")
    mine = getattr(copy.deepcopy(robot), field)
    changed = robot.replace(**{field: mine})
    pick = {"limits": lambda x: x.effort, "frames": lambda x: x[0].X_BF}.get(field, lambda x: x)
    pick(mine).fill_(7.0)
    assert torch.equal(pick(getattr(changed, field)), pick(getattr(robot, field)))
    Scene(changed)
    pick(getattr(changed, field)).fill_(7.0)
    with pytest.raises(ArgumentError, match=f"{field} of robot 'two_link' was changed in place"):
        Scene(changed)


def test_what_keeps_robots_from_one_stack_is_named():
    robot = torchdq.robots.load("two_link")
    frames = list(robot.frames)
    frames[-1] = frames[-1]._replace(X_BF=frames[-1].X_BF * torch.tensor([1.0, 1, 1, 1, 1, 2, 1, 1]))
    longer, tip = robot.replace(frames=tuple(frames)), frames[-1].name
    with pytest.raises(
        ArgumentError, match=rf"the same frames, found frame '{tip}' with X_BF \[1.0[^F]*\] and [^F]*\]$"
    ):
        Robot.stack([robot, longer])
    frames[-1] = robot.frames[-1]._replace(link=0)
    with pytest.raises(ArgumentError, match=f"the same frames, found frame '{tip}' with link 1 and 0"):
        Robot.stack([robot, robot.replace(frames=tuple(frames))])
    with pytest.raises(ArgumentError, match=r"one dtype and device, found .*float64 on cpu and with torch.float32 on"):
        Robot.stack([robot, robot.to(torch.float32)])
    with pytest.raises(ArgumentError, match=r"one dtype and device, found mass .*; convert them by robot.to"):
        Robot.stack([robot, robot.replace(mass=robot.mass.float())])


def test_robots_of_inference_mode_are_watched():
    with torch.inference_mode():
        robot = torchdq.robots.load("two_link").replace(mass=torch.ones(2, dtype=F64)).bake()
        torques(robot)
    robot.mass.mul_(2)
    with pytest.raises(ArgumentError, match="changed in place"):
        torques(robot)


@pytest.mark.parametrize("use", USES)
def test_a_constant_that_requires_grad_is_told_at_the_next_use(use):
    robot = torchdq.robots.load("two_link")
    robot.mass.requires_grad_()
    with pytest.raises(ArgumentError, match=r"mass of robot 'two_link' requires grad.*robot\.replace\(mass=mass\)"):
        uses(robot)[use]()
    tau = torchdq.inverse_dynamics(robot.replace(mass=robot.mass), torch.ones(2, dtype=F64))
    tau.sum().backward()
    assert robot.mass.grad is not None
    robot.mass.requires_grad_(False)
    uses(robot)[use]()


@pytest.mark.parametrize("backend", ["auto", "eager"])
def test_a_robot_made_of_a_tensor_that_requires_grad_is_told(backend):
    robot = one_joint(LINE, mass=torch.ones(1, dtype=F64, requires_grad=True))
    with pytest.raises(ArgumentError, match="mass of robot 'robot' requires grad"):
        torchdq.inverse_dynamics(robot, torch.ones(1, dtype=F64), backend=backend)


def test_assignment_names_replace():
    with pytest.raises(torchdq.errors.FrozenError, match=r"robot\.replace\(mass=\.\.\.\)"):
        panda().mass = torch.ones(7)
    with pytest.raises(dataclasses.FrozenInstanceError, match="a Robot does not change"):
        del panda().mass


# --- values that no robot has ----------------------------------------------------------------------------------------


def two():
    return torchdq.robots.load("two_link")


def row(*numbers):
    return torch.tensor(numbers, dtype=F64)


POSE = row(2, 0, 0, 0, 0, 0, 0, 0)
UNPHYSICAL = {  # changed fields, code and subject of the fault, and the number found where the message has it
    "negative mass": ({"mass": row(1, -1)}, "mass.negative", "link 'link2'", "-1 kg"),
    "mass of nan": ({"mass": row(math.nan, 1)}, "body.finite", "link 'link1'", "mass nan"),
    "negative inertia": ({"inertia": -two().inertia}, "inertia.indefinite", "link 'link1'", ""),
    "inertia without mass": ({"mass": row(1, 0)}, "inertia.massless", "link 'link2'", ""),
    "com of inf": ({"com": two().com + math.inf}, "com.value", "", "inf"),
    "home of nan": ({"home": row(0, math.nan)}, "home.value", "", "nan at (1,)"),
    "gravity of nan": ({"gravity": row(0, 0, math.nan)}, "gravity.value", "", "nan at (2,)"),
    "armature": ({"armature": row(0, -1)}, "armature.value", "", "-1.0 at (1,)"),
    "damping": ({"damping": row(0, -1)}, "damping.value", "", "-1.0 at (1,)"),
    "friction": ({"friction": row(0, -1)}, "friction.value", "", "-1.0 at (1,)"),
    "effort": ({"limits": two().limits._replace(effort=row(1, -1))}, "effort limit.value", "", "-1.0 at (1,)"),
    "velocity": ({"limits": two().limits._replace(velocity=row(1, math.nan))}, "velocity limit.value", "", "nan"),
    "long screw": ({"screw": 2 * two().screw}, "screw.kind", "joint 'joint1'", ""),
    "screw with pitch": ({"screw": two().screw + row(0, 0, 0, 0, 0, 0.1)}, "screw.kind", "joint 'joint1'", "0.1"),
    "no screw": ({"screw": 0 * two().screw}, "screw.kind", "joint 'joint1'", "0.0"),
    "screw of nan": ({"screw": math.nan * two().screw}, "screw.kind", "joint 'joint1'", "nan"),
    "kinds and screws": ({"kinds": ("revolute", "prismatic")}, "screw.kind", "joint 'joint2'", ""),
    "long pose": ({"X_PB_home": 2 * two().X_PB_home}, "pose.unit", "", "2.0"),
    "long frame": ({"frames": (Frame("tip", 1, POSE),)}, "pose.unit", "frame 'tip'", "2.0"),
    "crossed": ({"limits": two().limits._replace(lower=row(9, 9), upper=row(0, 0))}, "lower limit.value", "", "9.0"),
}


@pytest.mark.parametrize("case", UNPHYSICAL)
def test_replace_checks_values_as_a_file_is_checked(case):
    changes, code, subject, number = UNPHYSICAL[case]

    def one(findings):
        fault = findings[0]
        assert (fault.code, fault.subject) == (code, subject) and number in fault.found
        return fault

    with pytest.raises(UnphysicalError) as refused:
        two().replace(**changes)
    sentence = str(one(refused.value.findings))
    with pytest.warns(UserWarning) as warned:
        robot = two().replace(**changes, on_unphysical="warn")
    assert sentence in str(warned[0].message) and warned[0].filename == __file__
    one(robot.report().notes)
    with pytest.raises(UnphysicalError) as refused:
        two().replace(**changes, on_unphysical="ignore").check()
    one(refused.value.findings)


LONG, BENT = row(2, 0, 0, 0, 0, 0.2, 0, 0), row(1, 0, 0, 0, 0.5, 0, 0, 0)  # |r| = 2, and a dual part that is no pose's
BODIES = {"mass": [1.0], "com": [[0.1, 0.0, 0.0]], "inertia": [[0.01, 0, 0.01, 0, 0, 0.01]]}
GIVEN_POSES = {
    "pose": lambda x: two().with_tool("pen", x),
    "base_pose": lambda x: two().attach(two(), "tip", prefix="o_", base_pose=x),
    "tip_pose": lambda x: Robot.from_screws([[0, 0, 1, 0, 0, 0]], **BODIES, tip_pose=x),
    "link_poses": lambda x: Robot.from_screws([[0, 0, 1, 0, 0, 0]], **BODIES, link_poses=x.unsqueeze(0)),
    "tip_pose of dh": lambda x: Robot.from_dh([0.1], [0.0], [0.0], [0.0], **BODIES, tip_pose=x),
}


@pytest.mark.filterwarnings("ignore:robot 'two_link' has no body of its base")
@pytest.mark.parametrize("argument", GIVEN_POSES)
def test_a_pose_that_is_not_unit_is_refused_not_normalised(argument):
    make, name = GIVEN_POSES[argument], argument.partition(" ")[0]
    error = ArgumentError if name in ("pose", "base_pose") else DescriptionError
    for wrong in (LONG, BENT, LONG.to(torch.float32), 0 * LONG):
        found = re.escape(str(wrong.double().tolist()))
        with pytest.raises(error, match=rf"^{name} must be unit dual quaternions .*dq\.normalize\), found {found}"):
            make(wrong)
    with pytest.raises(error, match=rf"^{name} must have the shape \("):
        make(LONG[:7])
    # a pose in single precision is unit up to its rounding, which goes
    turned = dq.exp(row(0.3, -0.2, 0.5, 0.1, 0.7, -0.4))
    for robot in (make(turned), make(turned.float())):
        assert all(abs(float(frame.X_BF[:4].norm()) - 1) < 1e-15 for frame in robot.frames)
    for exact, rounded in zip(make(turned).frames, make(turned.float()).frames, strict=True):
        assert torch.allclose(exact.X_BF, rounded.X_BF, rtol=0, atol=2**-23)


BROKEN = {
    "frame beyond": ({"frames": (Frame("tip", 2, two().frames[0].X_BF),)}, "frames of robot 'two_link' must be"),
    "damping": ({"damping": torch.ones(5)}, r"damping of robot 'two_link' must be a tensor \[n\], with n = 2"),
    "integers": ({"friction": torch.ones(2, dtype=torch.int64)}, "friction of robot 'two_link' must be"),
    "limits": ({"limits": 5}, "limits of robot 'two_link' must be Limits"),
    "name": ({"name": 3}, "name of robot 'two_link' must be a string, with n = 2, found 3"),
    "joints": ({"joint_names": ("a", "a")}, "joint_names .* different names"),
    "links": ({"link_names": ["a", "b"]}, "link_names .* different names"),
    "parents": ({"parents": (1, 0)}, "parents .* earlier link or -1"),
    "kinds": ({"kinds": ("ball", "ball")}, "kinds .* revolute, prismatic, helical"),
    "tip": ({"tip": 3}, "tip .* name of a frame"),
    "notes": ({"notes": "none"}, "notes .* strings"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_replace_checks_structure(case):
    changes, named = BROKEN[case]
    with pytest.raises(ArgumentError, match=named):
        two().replace(**changes)


def test_every_field_can_be_replaced_by_itself():
    for name in SHIPPED:
        robot = torchdq.robots.load(name)
        fields = [f.name for f in dataclasses.fields(robot) if not f.name.startswith("_")]
        for field in fields:
            again = robot.replace(**{field: getattr(robot, field)})
            assert same(torques(again), torques(robot))
            assert again.to(torch.float32).replace(**{field: getattr(robot.to(torch.float32), field)}).n == robot.n


def test_an_unknown_field_names_the_closest():
    with pytest.raises(UnknownNameError, match="no field of robot 'two_link' named 'masses'; did you mean 'mass'"):
        two().replace(masses=two().mass)
    with pytest.raises(UnknownNameError, match="no frame of robot 'two_link' named 'tool'"):
        two().replace(tip="tool")


def test_learned_and_transformed_values_are_not_read():
    mass = -torch.ones(2, dtype=F64)
    learned = two().replace(mass=mass.clone().requires_grad_())
    torch.func.vmap(lambda m: torchdq.inverse_dynamics(two().replace(mass=m), torch.ones(2, dtype=F64)))(mass[None])
    for robot in (learned, two().replace(mass=mass[None])):
        with pytest.raises(UnphysicalError, match="mass must not be negative"):
            robot.check()


@pytest.mark.parametrize("way", ["data", "numpy"])
def test_writes_that_torch_does_not_count_change_nothing(way):
    """`Robot.replace` says so; `x[...] = ` is counted, and refused."""
    robot, q = two(), torch.ones(2, dtype=F64)
    before = torchdq.inverse_dynamics(robot, q)
    (robot.mass.data if way == "data" else robot.mass.numpy())[:] = 5.0
    assert robot.mass._version == 0 and torch.equal(torchdq.inverse_dynamics(robot, q), before)
    robot.mass[:] = 5.0
    with pytest.raises(ArgumentError, match=r"mass of robot .* was changed in place"):
        torchdq.inverse_dynamics(robot, q)


@pytest.mark.parametrize("device", ["cuda:99", "gpu", 3.5], ids=repr)
def test_a_device_that_is_not_there_is_named(device):
    with pytest.raises(ArgumentError, match=r"^device must be a device that torch has on this machine, which are cpu"):
        two().to(device=device)


def test_a_shipped_robot_passes_its_check():
    for name in sorted(set(SHIPPED) - {"puma560"}):
        torchdq.robots.load(name).check()
        torchdq.robots.load(name).to(torch.float32).check()


def test_a_check_finds_a_joint_without_inertia():
    robot = two().replace(mass=row(1, 0), inertia=row(0, 0, 0, 0, 0, 0).expand(2, 6))
    with pytest.raises(UnphysicalError, match="joint 'joint2': it moves no inertia"):
        robot.check()


# --- one robot of several --------------------------------------------------------------------------------------------


def test_a_stack_of_robots_is_a_batch_of_them():
    robots = [two(), two().replace(mass=row(2, 3), com=two().com + 0.1), two().replace(armature=row(0.1, 0.2)).bake()]
    batch = Robot.stack(robots)
    assert (batch.mass.shape, batch.com.shape, batch.armature.shape) == ((3, 2), (3, 2, 3), (3, 2))
    assert batch.screw.shape == (2, 6) and batch.inertia.shape == (2, 6)
    q, qd, qdd = states(2, rows=3)
    expected = torch.stack([torchdq.inverse_dynamics(x, *rows) for x, *rows in zip(robots, q, qd, qdd, strict=True)])
    assert same(torchdq.inverse_dynamics(batch, q, qd, qdd), expected)


def unlimited():
    return two().replace(limits=two().limits._replace(effort=row(math.inf, math.inf)))


def test_a_stack_holds_frictions_and_limits_of_all():
    other = two().replace(damping=row(1, 2), limits=two().limits._replace(effort=row(3, 4)))
    batch = Robot.stack([two(), other])
    assert batch.damping[1].tolist() == [1, 2] and batch.limits.effort[1].tolist() == [3, 4]
    assert "joint2" in str(batch.report())


@pytest.mark.parametrize("robots", [lambda: [two()] * 3, lambda: [two(), two(), unlimited()], lambda: [two()]])
def test_a_stack_has_an_axis_of_its_robots_even_if_they_are_equal(robots):
    robots = robots()
    batch = Robot.stack(robots)
    assert torchdq.mass_matrix(batch, torch.zeros(2).double()).shape == (len(robots), 2, 2)
    assert batch.mass.shape == (len(robots), 2) and batch.com.shape == (2, 3)


@pytest.mark.parametrize(
    "other, named",
    [
        (lambda: two().with_tip(None), "must have the same tip"),
        (lambda: panda(), "must have the same joint_names"),
        (
            lambda: two().replace(joint_names=("a", "b")),
            r"same joint_names, found \('joint1', 'joint2'\) and \('a', 'b'\)",
        ),
        (lambda: 3, "robots must be a sequence of torchdq.Robot"),
    ],
)
def test_a_stack_is_of_equal_trees(other, named):
    with pytest.raises(ArgumentError, match=named):
        Robot.stack([two(), other()])


def test_a_stack_of_none_is_refused():
    with pytest.raises(ArgumentError, match="robots must be a sequence"):
        Robot.stack([])


def test_words_and_complex_numbers_are_refused_by_name():
    with pytest.raises(DescriptionError, match="gravity must be an array of numbers"):
        one_joint(LINE, gravity="down")
    with pytest.raises(DescriptionError, match="parents must be an array of numbers"):
        one_joint(LINE, parents=["a"])
    with pytest.raises(DescriptionError, match="mass must be an array of numbers: found complex numbers"):
        one_joint(LINE, mass=[1j])


def test_robots_with_batch_axes_are_not_stacked():
    robot = two()
    several = robot.replace(mass=robot.mass * torch.ones(3, 1))
    with pytest.raises(torchdq.ArgumentError, match=r"must have no batch axes, found \(3,\) of mass"):
        torchdq.Robot.stack([several, robot])
