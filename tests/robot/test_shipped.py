"""Robots that ship with the package.

Evidence: textbook equations, published numbers, and description files of two arms that were written by others.
"""

import math

import mujoco
import numpy as np
import pytest
import torch
from helpers import all_in_one
from messages import refused
from mjcf_text import panda_hand_mjcf
from oracles import states as random_states
from oracles import urdf_paths
from places import DATA
from robots import ARMS, F64, matrices, row, same, states, torques, two

import torchdq
from torchdq import Robot, Scene, UnknownNameError, dq
from torchdq.objects import Box

SHIPPED = torchdq.robots.names()


def test_an_unknown_robot_names_the_closest():
    with refused(UnknownNameError):
        torchdq.robots.load("pumas")


@all_in_one(SHIPPED)
def test_a_shipped_robot_is_physical(name):
    robot = torchdq.robots.load(name)
    assert robot.name == name
    if name in ARMS:
        assert bool((torch.linalg.eigvalsh(torchdq.mass_matrix(robot, states(robot.n)[0])) > 0).all())
    if name != "puma560":
        assert robot.floating or {note.severity for note in robot.notes} <= {"note"}
        robot.check()
        robot.to(torch.float32).check()


def test_what_is_unphysical_about_the_puma_is_reported():
    found = [(note.code, note.subject) for note in torchdq.robots.load("puma560").notes]
    assert found == [("inertia.massless", "link 'link1'"), ("inertia.triangle", "link 'link3'")]


# two links: thin rods of 1 m and 1 kg, gravity along -y


def test_two_link_reaches_two_metres():
    robot = two()
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
    assert same(torques(two()), torch.stack([tau1, tau2], -1))


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
PUMA_TORQUES = [4.086796449588486, 23.728694457656573, -4.132546652657011]  # without friction
PUMA_TORQUES += [0.06180156899440089, -0.05792859529263268, 0.13589778325405374]
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


def test_puma_has_the_toolbox_dynamics_and_kinematics():
    robot = torchdq.robots.load("puma560")
    M = torchdq.mass_matrix(robot, torch.tensor(PUMA_STATE[0], dtype=F64))
    assert same(M[:5, :5], PUMA_MASS_MATRIX, 1e-14)
    assert math.isclose(float(M[5, 5]), 0.19410450566800005, rel_tol=1e-14)
    assert same(torchdq.inverse_dynamics(robot, *torch.tensor(PUMA_STATE, dtype=F64)), PUMA_TORQUES, 1e-14)
    assert same(matrices(robot, PUMA_STATE[0], "tip"), PUMA_HAND)


# Go2: the file of the same robot in the package example-robot-data


def test_go2_is_the_robot_of_its_file():
    """But for two spheres of a gram on the head, which this older file lacks."""
    robot, described = torchdq.robots.load("go2"), Robot.from_urdf(urdf_paths()["go2"], base="floating")
    assert (robot.joint_names, robot.link_names) == (described.joint_names, described.link_names)
    for field in ("mass", "com", "inertia", "screw", "X_PB_home"):
        assert torch.equal(getattr(robot, field), getattr(described, field)), field
    for ours, theirs in zip(robot.limits, described.limits, strict=True):
        assert torch.equal(ours, theirs)
    heads = 0.001 * row(0.285, 0, 0.01) + 0.001 * row(0.293, 0, -0.06)
    assert same(robot.base_mass, described.base_mass + 0.002)
    assert same(robot.base_mass * robot.base_com, described.base_mass * described.base_com + heads)


# Panda with its hand: MuJoCo, with the numbers of franka_emika_panda/panda.xml of its Menagerie


def test_panda_with_its_hand_is_that_of_mujoco():
    """Its last coordinate moves both fingers."""
    robot, model = torchdq.robots.load("panda_hand"), mujoco.MjModel.from_xml_string(panda_hand_mjcf())
    data, S, M = mujoco.MjData(model), np.eye(9, 8), np.zeros((9, 9))
    S[8, 7] = 1.0
    for q, qd, qdd, *_ in random_states(robot).rows():
        data.qpos[:], data.qvel[:] = S @ q, S @ qd
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        found = (torch.from_numpy(x) for x in (q, qd, qdd))
        assert same(torchdq.mass_matrix(robot, torch.from_numpy(q)), S.T @ M @ S, 1e-12)
        assert same(torchdq.inverse_dynamics(robot, *found), S.T @ (M @ S @ qdd + data.qfrc_bias), 1e-11)
        for name in [*robot.link_names, "hand"]:
            body, T = data.body(name), matrices(robot, q, name)
            assert same(T[:3, 3], body.xpos, 1e-13) and same(T[:3, :3], body.xmat.reshape(3, 3), 1e-13)


def test_the_hand_of_the_panda_opens_by_both_fingers_and_has_pads():
    robot = torchdq.robots.load("panda_hand")
    assert robot.joint_names == (*(f"joint{i}" for i in range(1, 8)), "finger_joint1")
    assert robot.tip == "tcp" and robot.frame_names[0] == "link0"
    assert [x[-1].item() for x in robot.limits] == [0.0, 0.04, 0.2, 100.0]
    for ours, theirs in zip(robot.limits, torchdq.robots.load("panda").limits, strict=True):
        assert torch.equal(ours[:7], theirs)
    assert robot.damping.tolist() == [1.0] * 7 + [2.0]
    q = [*states(7)[0][0].tolist(), 0.03]
    hand, left, right, tcp = (matrices(robot, q, name) for name in ("hand", "left_finger", "right_finger", "tcp"))
    for finger, side in ((left, 1.0), (right, -1.0)):
        assert same((hand.inverse() @ finger)[:3, 3], [0.0, side * 0.03, 0.0584], 1e-13)
    assert same((hand.inverse() @ tcp)[:3, 3], [0.0, 0.0, 0.1034], 1e-13)
    points = robot.contact_points("*_finger")
    assert [p.frame for p in points] == ["left_finger"] * 4 + ["right_finger"] * 4
    grip, cube = torchdq.effects.Contact(("*_finger",), on="cube"), Box("cube", 0.1, size=(0.04, 0.04, 0.04))
    assert Scene(robot, (grip,), objects=(cube,), dt=5e-3).touching == [(p.frame, "cube") for p in points]
    # those of a closed hand end 1.5 mm before its middle, as the largest pads of the file do
    closed = [matrices(robot, [0.0] * 8, name) for name in ("hand", "left_finger", "right_finger")]
    at = [(closed[0].inverse() @ closed[1 + (k > 3)] @ row(*p.center, 1.0))[:3] for k, p in enumerate(points)]
    assert all(same(abs(p[1]) - points[0].radius, 0.0015, 1e-12) for p in at)
    assert {tuple(p.sign().tolist()) for p in at} == {(x, y, 1.0) for x in (-1.0, 1.0) for y in (-1.0, 1.0)}


# Panda and UR10e: description files that others wrote


FILES = {
    # name: file, its frame at the tip, relative tolerance of the torques
    "panda": (DATA / "panda_gaz2019" / "panda_gaz2019.urdf", None, 1e-10),
    "ur10e": (DATA / "ur10e_innopolis" / "ur10e.urdf", "tool0", 1e-9),  # its quarter turns are printed with 12 digits
}


@pytest.mark.parametrize("name", FILES)
def test_a_shipped_robot_is_the_robot_of_its_file(name):
    path, tool, tolerance = FILES[name]
    if not path.exists():
        pytest.skip(f"{path} is missing; TORCHDQ_DATA names the folder that holds it")
    robot, described = torchdq.robots.load(name), Robot.from_urdf(path)
    assert (robot.joint_names, robot.link_names) == (described.joint_names, described.link_names)
    assert same(torques(robot), torques(described), tolerance)
    # torques alone would not do: what link 1 has along its upright axis never shows in them
    for field in ("mass", "com", "inertia"):
        assert same(getattr(robot, field), getattr(described, field)), field
    for ours, theirs in zip(robot.limits, described.limits, strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-10)
    for q in states(robot.n)[0]:
        for link in robot.link_names:
            assert same(matrices(robot, q, link), matrices(described, q, link), 1e-10), link
        assert tool is None or same(matrices(robot, q, "tip"), matrices(described, q, tool), 1e-10)


def test_panda_at_zero_points_down():
    """Straight up to the elbow offsets, which cancel, out by 0.088 m, and the flange 0.107 m down again."""
    T = matrices(torchdq.robots.load("panda"), [0.0] * 7, "tip")
    assert same(T[:3, 3], [0.088, 0, 0.333 + 0.316 + 0.384 - 0.107])
    assert same(T[:3, :3], np.diag([1.0, -1.0, -1.0]))
