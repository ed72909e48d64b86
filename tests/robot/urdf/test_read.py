"""Robots of URDF files: what is read, what is lumped, what is refused, and what the refusal says.

The files are written here by hand, and what they mean is worked out with numpy or on paper; pinocchio's own reading of
real files is compared elsewhere. Refusals must come quickly, name the link or joint, and name every fault at once.
"""

import io
import math
import os
import random
import re
import threading
import time
import warnings
from collections import Counter

import numpy as np
import pytest
import torch

import torchdq
from torchdq import (
    ArgumentError,
    DescriptionError,
    MissingFileError,
    Robot,
    SingularInertiaError,
    TorchdqError,
    UnknownNameError,
    UnphysicalError,
    dq,
)

F64 = torch.float64
EPS = 2.0**-52
LIMIT = '<limit lower="-1" upper="2" velocity="3" effort="4"/>'
ENTRIES = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
ORDINARY = (0.04, 0.001, 0.05, -0.002, 0.003, 0.03)  # an inertia without any symmetry

# --- files -----------------------------------------------------------------------------------------------------------


def words(x):
    return x if isinstance(x, str) else " ".join(map(repr, map(float, np.ravel(x))))


def link(name, mass=1.0, inertia=ORDINARY, xyz=(0.02, -0.03, 0.1), rpy=(0, 0, 0), more=""):
    """A <link>; numbers may be given as text. Without mass it has no <inertial>."""
    if mass is None:
        return f'<link name="{name}">{more}</link>'
    entries = " ".join(f'{key}="{words(value)}"' for key, value in zip(ENTRIES, inertia, strict=True))
    origin = f'<origin xyz="{words(xyz)}" rpy="{words(rpy)}"/>'
    inertial = f'<inertial>{origin}<mass value="{words(mass)}"/><inertia {entries}/></inertial>'
    return f'<link name="{name}">{inertial}{more}</link>'


def joint(name, parent, child, kind="revolute", xyz=(0, 0, 0), rpy=(0, 0, 0), axis=(0, 0, 1), more=LIMIT):
    """A <joint>; numbers may be given as text."""
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    axis = "" if axis is None else f'<axis xyz="{words(axis)}"/>'
    origin = f'<origin xyz="{words(xyz)}" rpy="{words(rpy)}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{origin}{axis}{more}</joint>'


def fixed(name, parent, child, xyz=(0, 0, 0), rpy=(0, 0, 0)):
    return joint(name, parent, child, "fixed", xyz, rpy, axis=None, more="")


def urdf(*elements, name="arm"):
    return f'<robot name="{name}">' + "".join(elements) + "</robot>"


def arm(**upper):
    """Two joints: base - shoulder - upper - elbow - lower; arguments are those of the upper link."""
    return urdf(
        link("base", None),
        link("upper", **upper),
        link("lower", 0.5, xyz=(0, 0.2, 0)),
        joint("shoulder", "base", "upper", axis=(0, 1, 0), xyz=(0, 0, 0.3)),
        joint("elbow", "upper", "lower", axis=(1, 0, 0), xyz=(0.1, 0, 0.4)),
    )


def rotation(rpy):
    """Matrix of roll, pitch and yaw: about the fixed x, then y, then z axis."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def about(axis, angle):
    """Matrix of a turn about a unit axis, by Rodrigues."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


def angles(R):
    """Roll, pitch and yaw of a matrix, away from a pitch of a quarter turn."""
    return math.atan2(R[2, 1], R[2, 2]), -math.asin(R[2, 0]), math.atan2(R[1, 0], R[0, 0])


def tensor(six):
    xx, xy, yy, xz, yz, zz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def flat(I):
    return I[0, 0], I[0, 1], I[1, 1], I[0, 2], I[1, 2], I[2, 2]


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


def position(robot, q, frame):
    return dq.translation(torchdq.forward_kinematics(robot, torch.tensor(q, dtype=F64), frame))


def refusal(text, error=DescriptionError, **arguments):
    """What the loader says about a file that it must refuse, within two seconds of this thread on any machine."""
    begin = time.thread_time()
    with pytest.raises(error) as caught:
        Robot.from_urdf(text, **arguments)
    assert time.thread_time() - begin < 2.0
    return str(caught.value)


# --- fixed joints ----------------------------------------------------------------------------------------------------


@pytest.mark.case("U5")
@pytest.mark.parametrize("on", ["base", "upper", "lower"])
def test_a_massless_link_on_a_fixed_joint_changes_no_torque(on):
    plain = arm()
    more = link("tool", None) + fixed("mount", on, "tool", (0.3, -0.2, 0.1), (0.4, 0.5, 0.6))
    with_tool = Robot.from_urdf(plain.replace("</robot>", more + "</robot>"))
    assert torch.equal(torques(with_tool), torques(Robot.from_urdf(plain)))


@pytest.mark.case("U5")
def test_a_body_described_on_a_fixed_link_is_the_body_on_its_carrier():
    p, rpy, c = np.array([0.1, -0.2, 0.3]), (0.4, -0.5, 0.6), np.array([0.02, -0.03, 0.1])
    R = rotation(rpy)
    in_tool = flat(R.T @ tensor(ORDINARY) @ R)
    split = arm(mass=None).replace(
        "</robot>", link("tool", 1.0, in_tool, R.T @ (c - p)) + fixed("mount", "upper", "tool", p, rpy) + "</robot>"
    )
    assert same(torques(Robot.from_urdf(split)), torques(Robot.from_urdf(arm())))


def test_the_masses_of_fixed_links_add_up():
    more = link("tool", 0.25) + fixed("mount", "upper", "tool")
    robot = Robot.from_urdf(arm(mass=1.5).replace("</robot>", more + "</robot>"))
    assert robot.mass.tolist() == [1.75, 0.5]


@pytest.mark.case("U5")
def test_a_fixed_link_adds_its_inertia_by_the_parallel_axis_theorem():
    # two equal balls of 1 kg, 0.6 m apart along x: the centre lies between them, 0.3 m from each
    ball = (0.01, 0, 0.01, 0, 0, 0.01)
    robot = Robot.from_urdf(
        urdf(
            link("base", None),
            link("upper", 1.0, ball, (0, 0, 0)),
            link("ball", 1.0, ball, (0.1, 0, 0)),
            joint("shoulder", "base", "upper"),
            fixed("mount", "upper", "ball", (0.5, 0, 0)),
        )
    )
    assert same(robot.com[0], [0.3, 0, 0])
    assert same(robot.inertia[0], [0.02, 0, 0.02 + 2 * 0.09, 0, 0, 0.02 + 2 * 0.09])


@pytest.mark.case("U5")
def test_two_fixed_joints_in_a_row_are_one():
    R1, R2, p1, p2 = rotation((0.4, 0.5, -0.6)), rotation((-0.2, 0.3, 0.9)), np.array([0.1, 0.2, 0.3]), np.ones(3)
    end, base = link("tool", 0.7), arm().removesuffix("</robot>")
    two = link("flange", None) + fixed("a", "lower", "flange", p1, angles(R1))
    two += fixed("b", "flange", "tool", p2, angles(R2))
    one = fixed("a", "lower", "tool", p1 + R1 @ p2, angles(R1 @ R2))
    robots = [Robot.from_urdf(base + end + more + "</robot>") for more in (two, one)]
    assert same(*map(torques, robots))
    assert same(*(position(robot, [0.3, 0.4], "tool") for robot in robots))


def test_the_links_of_fixed_joints_stay_as_frames():
    more = link("tool", None) + fixed("mount", "lower", "tool", (0, 0.5, 0))
    robot = Robot.from_urdf(arm().replace("</robot>", more + "</robot>"))
    assert robot.frame_names == ("base", "upper", "lower", "tool")
    assert robot.link_names == ("upper", "lower")
    # shoulder 0.3 up, elbow 0.1 ahead and 0.4 up, tool 0.5 to the left; nothing is turned at zero
    assert same(position(robot, [0.0, 0.0], "tool"), [0.1, 0.5, 0.7])


def test_a_frame_on_the_base_does_not_move():
    more = link("camera", None) + fixed("stand", "base", "camera", (1, 2, 3))
    robot = Robot.from_urdf(arm().replace("</robot>", more + "</robot>"))
    assert same(position(robot, [0.7, -0.9], "camera"), [1, 2, 3])


# --- links and joints ------------------------------------------------------------------------------------------------


def test_the_inertial_frame_may_be_turned():
    rpy = (0.4, -0.5, 0.6)
    robot = Robot.from_urdf(arm(rpy=rpy))
    assert same(robot.inertia[0], flat(rotation(rpy) @ tensor(ORDINARY) @ rotation(rpy).T))


@pytest.mark.case("U9")
def test_a_joint_may_turn_a_quarter_in_pitch():
    robot = Robot.from_urdf(
        urdf(link("base", None), link("a"), joint("j", "base", "a", rpy=(0.3, math.pi / 2, 0.2), axis=(0, 0, 1)))
    )
    R = rotation((0.3, math.pi / 2, 0.2)) @ about((0, 0, 1), 0.8)
    X = torchdq.forward_kinematics(robot, torch.tensor([0.8], dtype=F64), "a")
    assert same(dq.to_matrix(X)[:3, :3], R)


def test_a_continuous_joint_takes_the_plain_angle():
    turning = Robot.from_urdf(arm().replace("revolute", "continuous"))
    assert turning.n == 2 and turning.kinds == ("revolute", "revolute")
    assert torch.equal(torques(turning), torques(Robot.from_urdf(arm())))


@pytest.mark.case("U7")
def test_a_continuous_joint_has_no_position_limits():
    robot = Robot.from_urdf(arm().replace("revolute", "continuous"))
    assert robot.limits.lower.tolist() == [-math.inf] * 2 and robot.limits.upper.tolist() == [math.inf] * 2
    assert robot.limits.effort.tolist() == [4.0, 4.0]


def test_a_continuous_joint_needs_no_limit_element():
    robot = Robot.from_urdf(arm().replace("revolute", "continuous").replace(LIMIT, ""))
    assert all(bool(limit.isinf().all()) for limit in robot.limits)


def test_a_prismatic_joint_lifts_its_weight():
    lift = urdf(link("base", None), link("car", 2.5), joint("rail", "base", "car", "prismatic"))
    robot = Robot.from_urdf(lift)
    assert robot.kinds == ("prismatic",)
    q, qd, qdd = (torch.tensor([x], dtype=F64) for x in (0.7, 1.3, 0.4))
    assert same(torchdq.inverse_dynamics(robot, q, qd, qdd), [2.5 * (9.81 + 0.4)])
    assert same(position(robot, [0.7], "car"), [0, 0, 0.7])


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_an_axis_may_point_anywhere(kind):
    axis = np.array([2.0, -3.0, 6.0]) / 7.0
    text = urdf(link("base", None), link("a"), joint("j", "base", "a", kind, (0.1, 0.2, 0.3), (0.4, 0.5, 0.6), axis))
    X = dq.to_matrix(torchdq.forward_kinematics(Robot.from_urdf(text), torch.tensor([0.8], dtype=F64), "a"))
    R, p = rotation((0.4, 0.5, 0.6)), np.array([0.1, 0.2, 0.3])
    turned, moved = (R @ about(axis, 0.8), p) if kind == "revolute" else (R, p + R @ axis * 0.8)
    assert same(X[:3, :3], turned) and same(X[:3, 3], moved)


@pytest.mark.case("U6")
@pytest.mark.parametrize("length", [3.0, 1e-6, 1e40])
def test_an_axis_may_have_any_length(length):
    axis = np.array([2.0, -3.0, 6.0]) / 7.0
    unit, scaled = (
        Robot.from_urdf(urdf(link("base", None), link("a"), joint("j", "base", "a", axis=axis * size)))
        for size in (1.0, length)
    )
    assert same(torques(scaled), torques(unit))
    assert "axes scaled to unit length: j" in scaled.notes and not any(
        "scaled" in note for note in map(str, unit.notes)
    )


@pytest.mark.case("U6")
def test_an_axis_that_is_not_given_is_x():
    text = urdf(link("base", None), link("a"), joint("j", "base", "a", axis=None))
    assert Robot.from_urdf(text).screw.tolist() == [[1, 0, 0, 0, 0, 0]]


@pytest.mark.case("U6")
def test_the_axis_of_a_fixed_joint_does_not_matter():
    more = link("tool", None) + joint("mount", "lower", "tool", "fixed", axis=(0, 0, 0), more="")
    assert Robot.from_urdf(arm().replace("</robot>", more + "</robot>")).n == 2


@pytest.mark.parametrize("text", ["1.5 ", " 1.5", "\t1.5\n", "+1.5", "1.50", "15e-1", "15E-1", "&#49;.5"])
def test_a_number_may_be_written_in_any_way_that_is_a_number(text):
    # pinocchio takes the link of '1.5 ' for one without inertia, and says nothing
    assert Robot.from_urdf(arm(mass=text)).mass[0] == 1.5


@pytest.mark.parametrize("text", ["0.02 -0.03 0.1", "0.02  -0.03\t0.1", "\n0.02\n-0.03 0.1 "])
def test_numbers_may_be_separated_by_any_blanks(text):
    assert torch.equal(torques(Robot.from_urdf(arm(xyz=text))), torques(Robot.from_urdf(arm())))


@pytest.mark.case("U1")
def test_a_link_without_inertial_has_no_mass():
    robot = Robot.from_urdf(arm(mass=None))
    assert robot.mass.tolist() == [0.0, 0.5] and "links without mass: upper" in robot.notes


NAMES = {"universe": "universe", "root_joint": "root_joint", "lower": "lower", "Gelenk ä": "Gelenk ä"}
NAMES |= {"a &amp; b": "a & b", "a&#10;b&#13;&#9;": "a\nb\r\t"}


@pytest.mark.parametrize("name", NAMES)
def test_a_joint_may_have_any_name(name):
    robot = Robot.from_urdf(arm().replace('"elbow"', f'"{name}"'))
    assert robot.joint_names == ("shoulder", NAMES[name])
    assert torch.equal(torques(robot), torques(Robot.from_urdf(arm())))


@pytest.mark.parametrize("name", [*NAMES, "shoulder"])
@pytest.mark.parametrize("link", ["base", "upper", "lower"])
def test_a_link_may_have_any_name(link, name):
    if name == "lower" and link != "lower":
        name = "elbow"  # no two links of a name, but a joint's will do
    robot = Robot.from_urdf(arm().replace(f'"{link}"', f'"{name}"'), lock={"shoulder": 0.3})
    assert NAMES.get(name, name) in robot.frame_names
    assert torch.equal(torques(robot), torques(Robot.from_urdf(arm(), lock={"shoulder": 0.3})))


# --- trees -----------------------------------------------------------------------------------------------------------


def tree(order=None):
    """A trunk with a left arm of two joints and a right arm of one; `order` shuffles the elements of the file."""
    elements = [
        link("base", None),
        link("trunk", 3.0),
        link("left1", 1.0),
        link("left2", 0.5),
        link("right1", 0.8),
        joint("waist", "base", "trunk", axis=(0, 0, 1)),
        joint("left_a", "trunk", "left1", axis=(0, 1, 0), xyz=(0, 0.2, 0.5)),
        joint("left_b", "left1", "left2", axis=(1, 0, 0), xyz=(0, 0.3, 0)),
        joint("right_a", "trunk", "right1", axis=(0, 1, 0), xyz=(0, -0.2, 0.5)),
    ]
    if order is not None:
        random.Random(order).shuffle(elements)
    return urdf(*elements)


@pytest.mark.case("U10")
def test_a_tree_hangs_as_described():
    robot = Robot.from_urdf(tree())
    links = ("base", *robot.link_names)
    hangs = {links[i + 1]: links[parent + 1] for i, parent in enumerate(robot.parents)}
    assert hangs == {"trunk": "base", "left1": "trunk", "left2": "left1", "right1": "trunk"}


def test_every_parent_comes_before_its_children():
    assert all(parent < i for i, parent in enumerate(Robot.from_urdf(tree(3)).parents))


def test_every_joint_carries_the_link_of_its_name():
    robot = Robot.from_urdf(tree(1))
    carried = dict(zip(robot.joint_names, robot.link_names, strict=True))
    assert carried == {"waist": "trunk", "left_a": "left1", "left_b": "left2", "right_a": "right1"}


@pytest.mark.case("U10")
@pytest.mark.parametrize("order", range(4))
def test_the_order_of_the_file_does_not_matter(order):
    plain, shuffled = Robot.from_urdf(tree()), Robot.from_urdf(tree(order))
    same_joints = [shuffled.joint_index(name) for name in plain.joint_names]
    q, qd, qdd = states(4)
    tau = torch.zeros_like(q)
    into = [x.index_select(-1, torch.tensor(same_joints).argsort()) for x in (q, qd, qdd)]
    tau = torchdq.inverse_dynamics(shuffled, *into)[:, same_joints]
    assert same(tau, torchdq.inverse_dynamics(plain, q, qd, qdd))


@pytest.mark.case("U10")
def test_a_branch_bends_where_its_own_joint_turns():
    robot = Robot.from_urdf(tree())
    q = torch.zeros(4, dtype=F64)
    q[robot.joint_index("left_a")] = math.pi / 2  # about y: z becomes x
    rest = {name: position(robot, [0.0] * 4, name) for name in ("left2", "right1")}
    X = {name: dq.to_matrix(torchdq.forward_kinematics(robot, q, name)) for name in rest}
    assert same(X["left2"][:3, 2], [1, 0, 0]) and same(X["right1"][:3, :3], np.eye(3))
    assert same(X["right1"][:3, 3], rest["right1"])


# --- lock ------------------------------------------------------------------------------------------------------------

AXIS = np.array([2.0, -3.0, 6.0]) / 7.0


def chain_of_three(elbow):
    return urdf(
        link("base", None),
        *(link(name, mass) for name, mass in (("upper", 1.0), ("lower", 0.7), ("hand", 0.3))),
        joint("shoulder", "base", "upper", axis=(0, 1, 0)),
        elbow,
        joint("wrist", "lower", "hand", axis=(1, 0, 0), xyz=(0, 0.1, 0.2)),
    )


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
@pytest.mark.parametrize("length", [1.0, 2.0])
def test_a_locked_joint_is_a_fixed_joint_at_that_position(kind, length):
    p, rpy, value = np.array([0.1, 0.2, 0.3]), (0.4, 0.5, 0.6), 0.7
    moving = chain_of_three(joint("elbow", "upper", "lower", kind, p, rpy, length * AXIS))
    R = rotation(rpy)
    at, turn = (p + R @ AXIS * value, R) if kind == "prismatic" else (p, R @ about(AXIS, value))
    stiff = Robot.from_urdf(chain_of_three(fixed("elbow", "upper", "lower", at, angles(turn))))
    locked = Robot.from_urdf(moving, lock={"elbow": value})
    assert locked.joint_names == stiff.joint_names == ("shoulder", "wrist")
    assert same(torques(locked), torques(stiff))
    assert same(position(locked, [0.3, 0.4], "hand"), position(stiff, [0.3, 0.4], "hand"))
    assert "locked: elbow at 0.7" in locked.notes


def test_the_right_joint_is_locked_whatever_its_name():
    # pinocchio's own first joint, which carries the base, is called universe
    elbow, universe = (
        Robot.from_urdf(chain_of_three(joint(name, "upper", "lower")), lock={name: 0.7})
        for name in ("elbow", "universe")
    )
    assert universe.joint_names == ("shoulder", "wrist")
    assert torch.equal(torques(universe), torques(elbow))


@pytest.mark.parametrize("lock", [{"shoulder": 0.1, "elbow": 0.2}, "*", ["shoulder", "elbow"]], ids=repr)
def test_locking_every_joint_is_refused(lock):
    with pytest.raises(
        ArgumentError, match=r"lock must leave at least one joint free, .* locks shoulder, elbow, which"
    ):
        Robot.from_urdf(arm(), lock=lock)


def test_locking_every_joint_by_those_that_follow_is_refused():
    with pytest.raises(ArgumentError, match=r"lock must leave .* locks thumb, index, ring, little, which are all"):
        Robot.from_urdf(FOLLOWING, lock="thumb")


@pytest.mark.parametrize("joints", [[], ()], ids=repr)
def test_joints_to_keep_are_one_at_least(joints):
    with pytest.raises(ArgumentError, match="joints must name at least one joint to keep, found none; known: shoulder"):
        Robot.from_urdf(arm(), joints=joints)


def test_a_body_without_joints_has_none_to_keep_or_to_lock():
    assert Robot.from_urdf(urdf(link("base")), joints=[]).n == Robot.from_urdf(urdf(link("base")), lock=[]).n == 0


def test_locking_an_unknown_joint_names_the_closest():
    with pytest.raises(UnknownNameError, match="no movable joint to lock named 'elbows'; did you mean 'elbow'"):
        Robot.from_urdf(arm(), lock={"elbows": 0.0})


def test_a_fixed_joint_cannot_be_locked():
    text = chain_of_three(fixed("elbow", "upper", "lower"))
    with pytest.raises(UnknownNameError, match="movable joint to lock named 'elbow'"):
        Robot.from_urdf(text, lock={"elbow": 0.0})


@pytest.mark.parametrize("value", [math.nan, math.inf, 10**400, None, "0.4", True, [0.4]])
def test_a_joint_is_locked_at_a_number(value):
    with pytest.raises(ArgumentError, match=r"lock\['elbow'\] must be a finite number, found "):
        Robot.from_urdf(arm(), lock={"elbow": value})


def test_a_joint_is_locked_where_its_pose_is_a_number():
    with pytest.raises(ArgumentError, match=r"lock\['elbow'\] must not exceed 1e\+50 in size, found -1e\+300"):
        Robot.from_urdf(arm(), lock={"elbow": -1e300})


@pytest.mark.parametrize("lock", [True, 5, 0.4, [5], [None], {5: 0.4}, b"elbow"], ids=repr)
def test_what_is_locked_is_named(lock):
    with pytest.raises(ArgumentError, match=r"lock must .*found .*known: shoulder, elbow"):
        Robot.from_urdf(arm(), lock=lock)


@pytest.mark.parametrize("lock", ["elbow", ["elbow"], ("elb*",), {"elbow"}, {"e*": 0}])
def test_joints_are_locked_by_names_and_patterns(lock):
    robot = Robot.from_urdf(tree(), lock={"left_?": 0.0})
    assert robot.joint_names == ("waist", "right_a")
    locked = Robot.from_urdf(arm(), lock=lock)
    assert torch.equal(torques(locked), torques(Robot.from_urdf(arm(), lock={"elbow": 0.0})))


def test_a_name_to_lock_goes_before_a_pattern():
    robot = Robot.from_urdf(tree(), lock={"left_*": 0.5, "left_a": 0.0})
    assert any(note.startswith("locked: left_a at 0, left_b at 0.5") for note in map(str, robot.notes))


def test_locked_at_zero_means_where_the_file_was_drawn():
    assert "locked: elbow at 0" in Robot.from_urdf(arm(), lock=["elbow"]).notes


@pytest.mark.parametrize("joints", ["left_*", ["left_a", "left_b"], ("*_b", "left_a")])
def test_joints_that_are_not_kept_are_locked_at_zero(joints):
    robot = Robot.from_urdf(tree(), joints=joints)
    assert robot.joint_names == ("left_a", "left_b")
    others = Robot.from_urdf(tree(), lock={"waist": 0.0, "right_a": 0.0})
    assert torch.equal(torques(robot), torques(others)) and robot.frame_names == others.frame_names


def test_joints_that_are_not_kept_may_be_locked_elsewhere():
    robot = Robot.from_urdf(tree(), joints="left_*", lock={"waist": 0.4})
    assert torch.equal(torques(robot), torques(Robot.from_urdf(tree(), lock={"waist": 0.4, "right_a": 0.0})))
    assert "locked: waist at 0.4, right_a at 0" in robot.notes


def test_joints_to_keep_are_named():
    with pytest.raises(UnknownNameError, match=r"no movable joint named 'left'; did you mean 'left_"):
        Robot.from_urdf(tree(), joints=["left"])
    with pytest.raises(UnknownNameError, match=r"no movable joint named 'arm\*'"):
        Robot.from_urdf(tree(), joints="arm*")
    with pytest.raises(ArgumentError, match="joints and lock must not name the same joint, found waist in both"):
        Robot.from_urdf(tree(), joints=["waist"], lock=["waist"])
    for joints in (5, {"waist": 0.0}, [5]):
        with pytest.raises(ArgumentError, match=r"joints must be a name, a pattern .*known: waist, left_a"):
            Robot.from_urdf(tree(), joints=joints)


def hand(*mimics):
    """Four fingers that slide on the base, each with a <mimic>, or without."""
    names = ("thumb", "index", "ring", "little")
    joints = (
        joint(name, "base", f"{name}_link", "prismatic", more=LIMIT + mimic)
        for name, mimic in zip(names, (*mimics, "", "", "", ""), strict=False)
    )
    return urdf(link("base", None), *(link(f"{name}_link") for name in names), *joints)


def beside(robot):
    """A robot and, on its base, a joint that follows none and that none follows."""
    more = link("other_link") + joint("other", "base", "other_link", "prismatic", more=LIMIT)
    return robot.replace("</robot>", more + "</robot>")


FOLLOWING = hand(
    "",
    '<mimic joint="thumb" multiplier="-2" offset="0.25"/>',
    '<mimic joint="index" multiplier="0.5"/>',
    '<mimic joint="thumb"/>',
)


def lock_of(robot):
    return next(note for note in map(str, robot.notes) if note.startswith("locked: "))


def test_the_followers_of_a_locked_joint_are_locked_where_the_file_puts_them():
    robot = Robot.from_urdf(beside(FOLLOWING), lock={"thumb": 0.5})
    assert lock_of(robot) == "locked: thumb at 0.5, index at -0.75, ring at -0.375, little at 0.5"
    assert robot.joint_names == ("other",) and same(position(robot, [0.0], "index_link"), [0, 0, -0.75])
    assert not any("independent" in note for note in map(str, robot.notes))


def test_a_follower_that_is_named_itself_does_not_follow():
    robot = Robot.from_urdf(beside(FOLLOWING), lock={"thumb": 0.5, "index": 0.0}, mimic="independent")
    assert lock_of(robot) == "locked: thumb at 0.5, index at 0, ring at 0, little at 0.5"
    robot = Robot.from_urdf(FOLLOWING, joints="index", lock={"thumb": 0.5}, mimic="independent")
    assert robot.joint_names == ("index",) and lock_of(robot) == "locked: thumb at 0.5, ring at 0, little at 0.5"


def test_a_follower_that_is_locked_alone_is_told():
    robot = Robot.from_urdf(FOLLOWING, joints="thumb", mimic="independent")
    assert lock_of(robot) == "locked: index at 0, ring at 0, little at 0"
    assert "locked although the joints that they mimic move: index, little" in robot.notes


def test_followers_of_unnamed_joints_are_locked_at_their_offset():
    robot = Robot.from_urdf(beside(FOLLOWING), joints="other")
    assert lock_of(robot) == "locked: thumb at 0, index at 0.25, ring at 0.125, little at 0"


@pytest.mark.parametrize("circle", [["index", "thumb"], ["thumb"], ["index", "ring", "thumb"]], ids=repr)
def test_joints_that_mimic_each_other_are_locked_once(circle):
    text = beside(hand(*(f'<mimic joint="{name}" offset="1"/>' for name in circle)))
    assert len(Robot.from_urdf(text, lock=["thumb"], mimic="independent").joint_names) == 5 - len(circle)
    assert Robot.from_urdf(text, joints="other", mimic="independent").n == 1


@pytest.mark.parametrize("number", ["multiplier", "offset"])
def test_the_numbers_of_a_follower_are_checked(number):
    message = refusal(hand("", f'<mimic joint="thumb" {number}="nan"/>'))
    assert f"joint 'index': mimic {number} must be a finite number, found 'nan'" in message


def test_a_follower_must_not_be_carried_beyond_all_numbers():
    text = hand("", '<mimic joint="thumb" multiplier="1e40"/>')
    with pytest.raises(ArgumentError, match=r"lock\['index'\] must not exceed 1e\+50 in size, found 1e\+60"):
        Robot.from_urdf(text, lock={"thumb": 1e20})


@pytest.mark.parametrize("value, told", [(2.0, False), (2.0000001, False), (2.1, True), (-400.0, True)])
def test_a_lock_beyond_the_limits_is_told(value, told):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        notes = Robot.from_urdf(arm(), lock={"elbow": value}).notes
    assert [x.filename for x in seen if "locked beyond its limits: elbow" in str(x.message)] == [__file__] * told
    assert (f"locked beyond their limits: elbow at {value:g}, limits [-1, 2]" in notes) == told


# --- tip, gravity, what is read but not simulated --------------------------------------------------------------------


def test_the_only_leaf_is_the_tip():
    more = link("tool", None) + fixed("mount", "lower", "tool")
    assert Robot.from_urdf(arm().replace("</robot>", more + "</robot>")).tip == "tool"


def test_a_leaf_on_the_base_is_no_tip():
    more = link("camera", None) + fixed("stand", "base", "camera")
    assert Robot.from_urdf(arm().replace("</robot>", more + "</robot>")).tip == "lower"


def test_among_several_leaves_none_is_the_tip():
    robot = Robot.from_urdf(tree())
    assert robot.tip is None
    note = "no tip chosen among the leaves left2, right1; name one with tip="
    assert note in robot.notes
    chosen = (Robot.from_urdf(tree(), tip="left2"), robot.with_tip("left2"), robot.replace(tip="left2"))
    assert not any(note in str(x.report()) for x in chosen)
    with pytest.warns(UserWarning, match="has no body of its base"):
        other = Robot.from_urdf(arm()).attach(robot, "lower", prefix="b_")
    assert other.tip == "lower" and not any("no tip chosen" in x for x in map(str, other.notes))


def test_the_tip_can_be_named():
    assert Robot.from_urdf(tree(), tip="left1").tip == "left1"


def test_an_unknown_tip_names_the_closest():
    with pytest.raises(UnknownNameError, match="named 'right'; did you mean 'right1'"):
        Robot.from_urdf(tree(), tip="right")


def test_gravity_is_what_is_asked_for():
    lift = urdf(link("base", None), link("car", 2.0), joint("rail", "base", "car", "prismatic", axis=(0, 1, 0)))
    robot = Robot.from_urdf(lift, gravity=(1.0, -1.5, 3.0))
    assert same(torchdq.inverse_dynamics(robot, torch.zeros(1, dtype=F64)), [2.0 * 1.5])


def test_without_gravity_nothing_is_held():
    robot = Robot.from_urdf(arm(), gravity=None)
    assert robot.gravity is None
    assert bool((torchdq.inverse_dynamics(robot, torch.ones(2, dtype=F64)) == 0).all())


@pytest.mark.parametrize("gravity", [(0, 0, math.nan), (0, 0), (0, 0, -9.81, 0)])
def test_gravity_is_three_finite_numbers(gravity):
    with pytest.raises(DescriptionError if len(gravity) == 3 else ArgumentError, match="gravity"):
        Robot.from_urdf(arm(), gravity=gravity)


@pytest.mark.parametrize("name, value", [("base", "free"), ("base", None), ("mimic", "geared"), ("mimic", True)])
def test_choices_are_named(name, value):
    with pytest.raises(ArgumentError, match=f"{name} must be one of '.*', found {value!r}"):
        Robot.from_urdf(arm(), **{name: value})


def test_limits_are_read():
    limits = Robot.from_urdf(arm()).limits
    assert [x.tolist() for x in limits] == [[-1.0] * 2, [2.0] * 2, [3.0] * 2, [4.0] * 2]


def test_limits_are_reported():
    some = arm().replace("revolute", "continuous", 1).replace(LIMIT, "", 1)
    assert "limits given but not enforced: elbow" in Robot.from_urdf(some).notes


def test_joints_are_not_listed_where_all_are_meant():
    # the report's table shows the limits of each joint already
    assert Robot.from_urdf(arm()).notes == ("limits given but not enforced: all joints",)


@pytest.mark.case("U7")
def test_positions_that_a_limit_does_not_state_are_zero():
    robot = Robot.from_urdf(arm().replace(LIMIT, '<limit velocity="3" effort="4"/>'))
    assert robot.limits.lower.tolist() == robot.limits.upper.tolist() == [0.0, 0.0]


DAMPED = arm().replace(LIMIT, LIMIT + '<dynamics damping="0.3" friction="0.2"/>', 1)


def test_damping_and_friction_are_read():
    robot = Robot.from_urdf(DAMPED)
    assert robot.damping.tolist() == [0.3, 0.0] and robot.friction.tolist() == [0.2, 0.0]


def test_damping_and_friction_are_not_part_of_the_rigid_body():
    assert torch.equal(torques(Robot.from_urdf(DAMPED)), torques(Robot.from_urdf(arm())))


def test_damping_and_friction_are_reported():
    notes = Robot.from_urdf(DAMPED).notes
    assert "viscous damping given but not simulated: shoulder" in notes
    assert "Coulomb friction given but not simulated: shoulder" in notes


@pytest.mark.case("U4")
@pytest.mark.parametrize("mimic", ['<mimic joint="shoulder" multiplier="2"/>', '<mimic joint="nobody"/>', "<mimic/>"])
def test_a_mimic_joint_is_independent_and_reported(mimic):
    text = arm().replace(LIMIT + "</joint></robot>", LIMIT + mimic + "</joint></robot>")
    robot = Robot.from_urdf(text, mimic="independent")
    assert robot.n == 2 and "mimic joints treated as independent: elbow" in robot.notes


def test_a_robot_that_asks_for_nothing_else_has_no_notes():
    assert Robot.from_urdf(arm().replace("revolute", "continuous").replace(LIMIT, "")).notes == ()


# --- where the text comes from ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [str, lambda path: path], ids=["text", "Path"])
def test_a_path_is_read(tmp_path, kind):
    path = tmp_path / "arm.urdf"
    path.write_text(arm())
    assert torch.equal(torques(Robot.from_urdf(kind(path))), torques(Robot.from_urdf(arm())))


OPENED = {
    "bytes": lambda path: path.read_bytes(),
    "bytearray": lambda path: bytearray(path.read_bytes()),
    "text handle": lambda path: path.open(encoding="utf-8"),
    "binary handle": lambda path: path.open("rb"),
    "StringIO": lambda path: io.StringIO(path.read_text()),
    "BytesIO": lambda path: io.BytesIO(path.read_bytes()),
    "file address": lambda path: path.as_uri(),
    "file address of this machine": lambda path: path.as_uri().replace("file://", "file://localhost"),
}


@pytest.mark.parametrize("kind", OPENED)
def test_bytes_open_files_and_addresses_are_read(tmp_path, kind):
    path = tmp_path / "an arm.urdf"
    path.write_text(arm())
    source = OPENED[kind](path)
    assert torch.equal(torques(Robot.from_urdf(source)), torques(Robot.from_urdf(arm())))
    if hasattr(source, "close"):
        source.close()


def test_the_home_folder_is_written_as_in_a_shell(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "arm.urdf").write_text(arm())
    assert Robot.from_urdf("~/arm.urdf").n == 2


@pytest.mark.parametrize(
    "variable, value, folder",
    [
        ("ROS_PACKAGE_PATH", "{0}/none:{0}/src", "src/arm_description"),
        ("ROS_PACKAGE_PATH", "{0}/src/arm_description", "src/arm_description"),
        ("AMENT_PREFIX_PATH", "{0}/none:{0}/install", "install/share/arm_description"),
    ],
)
def test_a_package_of_ros_is_found(tmp_path, monkeypatch, variable, value, folder):
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    address = "package://arm_description/urdf/arm.urdf"
    message = refusal(address, MissingFileError)
    assert repr(address) in message and "ROS_PACKAGE_PATH are not set" in message and "setup script" in message
    monkeypatch.setenv(variable, value.format(tmp_path))
    assert f"{tmp_path}/{folder}" in refusal(address, MissingFileError)
    path = tmp_path / folder / "urdf" / "arm.urdf"
    path.parent.mkdir(parents=True)
    path.write_text(arm())
    assert Robot.from_urdf(address).n == 2


@pytest.mark.parametrize(
    "source, expected",
    [
        ("https://host/arm.urdf", "only file:/// and package:// addresses are read, found 'https://host/arm.urdf'"),
        ("file://other/arm.urdf", "only file:/// and package://"),
        ("", "its path is empty, found ''"),
        (" \n", "its path is empty"),
        (b"", "the robot description is empty"),
        (io.StringIO(""), "the open file is empty"),
        ("$HOME/arm.urdf", "there is no file '$HOME/arm.urdf'; variables such as $HOME are not replaced"),
        ("panda", "a robot that comes with this package is torchdq.robots.load('panda')"),
    ],
)
def test_a_source_that_cannot_be_read_says_what_to_do(source, expected):
    assert expected in refusal(source)


@pytest.mark.parametrize("source", [None, 5, True, ["arm.urdf"], {"path": "arm.urdf"}], ids=repr)
def test_what_is_no_source_is_refused_by_kind(source):
    message = refusal(source, ArgumentError)
    assert message.startswith("the robot description must be a path") and repr(source) in message


def closed():
    file = io.StringIO(arm())
    file.close()
    return file


@pytest.mark.parametrize("source", [closed(), io.StringIO, "a/../" * 2000], ids=["closed", "class", "long"])
def test_a_source_that_fails_is_one_of_the_packages_errors(source):
    assert "cannot be read" in refusal(source)


@pytest.mark.parametrize("before", ["", "\n  ", "<!-- arm -->", '<?xml version="1.0" encoding="utf-8"?>', "\ufeff"])
def test_text_may_begin_as_xml_may(before):
    assert Robot.from_urdf(before + arm()).n == 2


@pytest.mark.parametrize("declared", ["utf-16", "latin-1", "ebcdic-of-no-kind"])
def test_text_needs_no_decoding_whatever_it_declares(declared):
    assert Robot.from_urdf(f'<?xml version="1.0" encoding="{declared}"?>' + arm()).n == 2


def test_a_file_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_bytes(b"\xef\xbb\xbf" + arm().encode())
    assert Robot.from_urdf(path).n == 2


def test_a_missing_file_is_named():
    message = refusal("no/such/arm.urdf", MissingFileError)
    assert "'no/such/arm.urdf'" in message


@pytest.mark.parametrize("error", [FileNotFoundError, DescriptionError])
def test_a_missing_file_is_what_a_caller_expects(error):
    with pytest.raises(error):
        Robot.from_urdf("no/such/arm.urdf")


def test_a_folder_is_refused(tmp_path):
    assert "cannot be read" in refusal(tmp_path)


@pytest.mark.parametrize("source", ["", "a\0b", "a" * 100_000, "robot"])
def test_what_is_neither_a_path_nor_xml_is_refused(source):
    refusal(source)


@pytest.mark.case("U8")
@pytest.mark.parametrize("prefix", ["", "file://", "package://arm", "http://localhost:1"])
def test_meshes_are_never_opened(tmp_path, prefix):
    pipe = tmp_path / "mesh.stl"
    os.mkfifo(pipe)  # nobody writes into it, so whoever opens it waits for ever
    mesh = f'<geometry><mesh filename="{prefix}{pipe}"/></geometry>'
    text = arm(more=f"<visual>{mesh}</visual><collision>{mesh}</collision>")
    robots = []
    loading = threading.Thread(target=lambda: robots.append(Robot.from_urdf(text)), daemon=True)
    loading.start()
    loading.join(10)
    assert torch.equal(torques(robots[0]), torques(Robot.from_urdf(arm())))


def test_what_dynamics_do_not_need_may_be_wrong():
    more = '<visual><geometry><sphere radius="nan"/></geometry></visual><visual/><collision><geometry/></collision>'
    elements = '<transmission name="t"/><gazebo><plugin/></gazebo><material name="m"/><material name="m"/></robot>'
    text = arm(more=more).replace("</robot>", elements)
    assert torch.equal(torques(Robot.from_urdf(text)), torques(Robot.from_urdf(arm())))


# --- malformed: numbers ----------------------------------------------------------------------------------------------

NOT_NUMBERS = ["", "nan", "NaN", "inf", "-inf", "1e999", "1_0", "0x10", "1,5", "--1", "1e", ".", "1d0", "1 2"]
NOT_NUMBERS += ["\u0967", "\uff11.5"]  # digits of other scripts, which Python would read


@pytest.mark.case("U2")
@pytest.mark.parametrize("text", NOT_NUMBERS)
def test_what_is_not_a_finite_number_is_refused(text):
    assert f"link 'upper': mass value must be a finite number, found {text!r}" in refusal(arm(mass=text))


@pytest.mark.case("U2")
@pytest.mark.parametrize("text", ["", "0 0", "0 0 0 0", "0,0,1", "0 0 nan", "0 0 z", "0 0 1e999", "0 0 1_0"])
def test_what_is_not_three_finite_numbers_is_refused(text):
    assert f"link 'upper': inertial origin xyz must be 3 finite numbers, found {text!r}" in refusal(arm(xyz=text))


@pytest.mark.case("U2")
@pytest.mark.parametrize(
    "before, after, named",
    [
        ('mass value="1.0"', 'mass value="nan"', "link 'upper': mass value"),
        ("<mass value=", "<mass volume=", "link 'upper': mass value"),
        *((f'{key}="', f'{key}="nan', f"link 'upper': inertia {key}") for key in ENTRIES),
        (' ixy="', ' xyi="', "link 'upper': inertia ixy"),
        ('<inertial><origin xyz="', '<inertial><origin xyz="nan', "link 'upper': inertial origin xyz"),
        ('<inertial><origin xyz="0.02 -0.03 0.1" rpy="', '<inertial><origin rpy="nan', "inertial origin rpy"),
        ('<origin xyz="0.0 0.0 0.3"', '<origin xyz="0 0 nan"', "joint 'shoulder': origin xyz"),
        ('0.3" rpy="', '0.3" rpy="nan', "joint 'shoulder': origin rpy"),
        ('<axis xyz="0.0 1.0 0.0"', '<axis xyz="0 nan 0"', "joint 'shoulder': axis xyz"),
        ('lower="-1"', 'lower="nan"', "joint 'shoulder': limit lower"),
        ('upper="2"', 'upper="inf"', "joint 'shoulder': limit upper"),
        ('velocity="3"', 'velocity=""', "joint 'shoulder': limit velocity"),
        ('effort="4"', 'effort="4N"', "joint 'shoulder': limit effort"),
        (LIMIT, LIMIT + '<dynamics damping="x"/>', "joint 'shoulder': dynamics damping"),
        (LIMIT, LIMIT + '<dynamics friction="x"/>', "joint 'shoulder': dynamics friction"),
        ('<origin xyz="0.0 0.0 0.3"', '<origin quat_xyzw="0 0 0 1" xyz="0 0 0.3"', "joint 'shoulder': origin must be"),
    ],
)
def test_every_number_that_is_read_is_checked(before, after, named):
    assert before in arm()
    assert named in refusal(arm().replace(before, after, 1))


@pytest.mark.case("U2")
@pytest.mark.parametrize("broken", [{"mass": "1e60"}, {"xyz": "0 0 -1e60"}, {"inertia": ("1e60", 0, 1, 0, 0, 1)}])
def test_numbers_whose_products_would_overflow_are_refused(broken):
    message = refusal(arm(**broken))
    assert "link 'upper': " in message and "must not exceed 1e+50 in size" in message


@pytest.mark.case("U7")
def test_a_limit_may_be_as_large_as_a_number_can_be():
    robot = Robot.from_urdf(arm().replace('upper="2"', 'upper="1.7976931348623157e308"'))
    assert robot.limits.upper[0] == 1.7976931348623157e308


@pytest.mark.parametrize(
    "before, after, named",
    [
        ('effort="4"', 'effort="-4"', "limit effort"),
        ('velocity="3"', 'velocity="-1e-9"', "limit velocity"),
        (LIMIT, LIMIT + '<dynamics damping="-3"/>', "dynamics damping"),
        (LIMIT, LIMIT + '<dynamics friction="-3"/>', "dynamics friction"),
    ],
)
def test_what_only_resists_is_not_negative(before, after, named):
    number = re.search(r'"(-[^"]*)"', after.replace('lower="-1"', "")).group(1)
    expected = f"joint 'shoulder': {named} must not be negative, found '{number}'"
    assert expected in refusal(arm().replace(before, after, 1))


@pytest.mark.case("U6")
@pytest.mark.parametrize("axis", ["0 0 0", "1e-10 0 0", "-0 0 0", "1e-320 0 0"])
def test_an_axis_must_have_a_direction(axis):
    text = urdf(link("base", None), link("a"), joint("knee", "base", "a", axis=axis))
    assert "joint 'knee': axis must have a direction" in refusal(text)


@pytest.mark.case("U7")
def test_limits_must_not_be_reversed():
    message = refusal(arm().replace('upper="2"', 'upper="-2"', 1))
    assert "joint 'shoulder': lower limit -1 is above upper limit -2" in message


WITHOUT_INERTIA = re.sub(r"<inertia .*?/>", "", arm(), count=1)


def test_a_mass_without_inertia_is_a_point():
    robot = Robot.from_urdf(WITHOUT_INERTIA)
    assert robot.inertia[0].tolist() == [0.0] * 6 and robot.mass[0] == 1.0
    assert torch.equal(torques(robot), torques(Robot.from_urdf(arm(inertia=(0,) * 6))))
    note = "links with mass but without <inertia>, taken as points at their centres of mass: upper"
    assert note in robot.notes and note not in Robot.from_urdf(arm(inertia=(0,) * 6)).notes


def test_a_point_on_the_axis_of_its_joint_has_no_inertia():
    text = re.sub(r'<origin xyz="0.02[^>]*>', "", WITHOUT_INERTIA).replace("upper", "hub")
    text = text.replace('<joint name="elbow" type="revolute">', '<joint name="elbow" type="fixed">')
    text = re.sub(r'(<link name="lower">).*?</link>', r"\1</link>", text)
    assert any(
        note.startswith("joint 'shoulder': it moves no inertia") for note in map(str, Robot.from_urdf(text).notes)
    )


# --- malformed: links and joints -------------------------------------------------------------------------------------

MALFORMED = {
    "two links of a name": (link("upper"), "link 'upper' is described twice"),
    "two joints of a name": (link("x") + joint("elbow", "lower", "x"), "joint 'elbow' is described twice"),
    "two parents": (joint("again", "base", "lower"), "link 'lower' is carried by two joints, 'elbow' and 'again'"),
    "two roots": (
        link("island"),
        "exactly one link must be the base, carried by no joint; found 2: ['base', 'island']",
    ),
    "a loop": (
        link("x") + link("y") + joint("xy", "x", "y") + joint("yx", "y", "x"),
        "links ['x', 'y'] hang in a loop",
    ),
    "two joints without a child": (
        '<joint name="i" type="fixed"><parent link="base"/></joint>'
        '<joint name="j" type="fixed"><parent link="base"/></joint>',
        "joint 'j': it names no child link",
    ),
    "an axis that is none": (
        link("x") + joint("j", "base", "x", axis="up"),
        "joint 'j': axis xyz must be 3 finite numbers, found 'up'",
    ),
    "a joint onto itself": (link("x") + joint("self", "x", "x"), "links ['x'] hang in a loop"),
    "no such parent": (link("x") + joint("j", "nobody", "x"), "joint 'j': there is no link 'nobody'"),
    "no such child": (joint("j", "base", "nobody"), "joint 'j': there is no link 'nobody'"),
    "no parent": (
        '<joint name="j" type="fixed"><child link="x"/></joint>' + link("x"),
        "joint 'j': it names no parent",
    ),
    "no child": ('<joint name="j" type="fixed"><parent link="base"/></joint>', "joint 'j': it names no child link"),
    "a link without a name": ("<link/>", "a <link> has no name"),
    "a joint without a name": (link("x") + fixed("", "base", "x"), "a <joint> has no name"),
    **{
        f"a joint of type {kind!r}": (
            link("x") + joint("j", "base", "x", kind),
            f"joint 'j': type must be revolute, continuous, prismatic, planar or fixed, found {kind!r}",
        )
        for kind in ("floating", "ball", "Revolute", "")
    },
}


@pytest.mark.case("U3", "U5")
@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_file_is_refused_by_name(case):
    more, expected = MALFORMED[case]
    assert expected in refusal(arm().replace("</robot>", more + "</robot>"))


@pytest.mark.case("U3")
@pytest.mark.parametrize("case", sorted(set(MALFORMED) - {"two roots"}))
def test_a_fault_brings_no_others_with_it(case):
    more, _ = MALFORMED[case]
    lines = refusal(arm().replace("</robot>", more + "</robot>")).splitlines()[1:]
    # what has no place in the tree is a root as well
    assert len([line for line in lines if "exactly one link" not in line]) == (
        2 if case.startswith("two joints w") else 1
    )


@pytest.mark.case("U3")
def test_all_faults_are_told_at_once():
    faults = [case for case in MALFORMED if not case.startswith(("two joints", "two links"))]
    # every case with names of its own
    more = "".join(re.sub(r'"(x|y|j|xy|yx|self)"', rf'"\g<1>{i}"', MALFORMED[case][0]) for i, case in enumerate(faults))
    message = refusal(arm(mass="nan", xyz="0 0").replace("</robot>", more + "</robot>"))
    told = message.splitlines()[1:]
    assert len(told) >= len(faults)
    for expected in (
        "mass value",
        "inertial origin xyz",
        "carried by two joints",
        "found 'ball'",
        "'nobody'",
        "loop",
    ):
        assert expected in message


@pytest.mark.case("U3")
def test_every_root_is_named_when_there_is_none():
    text = urdf(link("a"), link("b"), joint("ab", "a", "b"), joint("ba", "b", "a"))
    message = refusal(text)
    assert "found 0: []" in message and "links ['a', 'b'] hang in a loop" in message


@pytest.mark.case("U3")
def test_a_robot_without_links_is_refused():
    assert "the robot has no links" in refusal('<robot name="nothing"/>')


def test_a_base_alone_is_a_robot_without_joints():
    assert Robot.from_urdf(urdf(link("base"))).n == 0


def test_a_base_alone_weighs_nothing_that_moves():
    assert "0 joints, chain, 0 kg" in repr(Robot.from_urdf(urdf(link("base"))))


ROOTS = {
    "sdf": "this is SDF",
    "mujoco": "this is MJCF",
    "srdf": "this is SRDF",
    "launch": "this is a launch file",
    "COLLADA": "this is a mesh",
    "html": "this is a web page",
    "Robot": "tags are written in lower case",
    "arm": "a URDF file was expected",
}


@pytest.mark.parametrize("root", ROOTS)
def test_the_root_must_be_a_robot(root):
    message = refusal(f"<{root}>{link('base')}</{root}>")
    assert f"root element must be <robot>, found <{root}>; {ROOTS[root]}" in message


XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
UNEXPANDED = {
    "a macro that is called": '<xacro:arm prefix="a"/><link name="base"/>',
    "a file that is included": '<xacro:include filename="arm.xacro"/>',
    "a macro inside of a link": '<link name="base"><xacro:inertia mass="1"/></link>',
    "a condition": '<link name="base" xacro:if="true"/>',
    "an expression in a name": '<link name="${prefix}_base"/>',
    "an expression in a number": arm(mass="${2 * m}").removeprefix('<robot name="arm">').removesuffix("</robot>"),
    "a command in a name": '<link name="$(arg prefix)base"/>',
}


@pytest.mark.parametrize("case", UNEXPANDED)
@pytest.mark.parametrize("head", [f'<robot name="a" {XACRO}>', '<robot name="a">'], ids=["declared", "undeclared"])
def test_unexpanded_xacro_is_refused_with_the_command_that_expands_it(case, head):
    message = refusal(head + UNEXPANDED[case] + "</robot>")
    assert (
        "this is xacro, which must be expanded first: use Robot.from_xacro" in message
        and len(message.splitlines()) == 1
    )


def test_a_root_of_xacro_is_refused_as_xacro():
    assert "this is xacro" in refusal(f'<xacro:robot {XACRO}><link name="base"/></xacro:robot>')


@pytest.mark.parametrize(
    "more",
    ["<!-- <xacro:arm/> ${x} -->", '<gazebo reference="${x}"/>', "<transmission><xacro:arm/></transmission>", XACRO],
)
def test_xacro_in_what_is_not_read_does_not_matter(more):
    text = arm().replace("<robot", f"<robot {more}") if more == XACRO else arm().replace("</robot>", more + "</robot>")
    assert torch.equal(torques(Robot.from_urdf(text)), torques(Robot.from_urdf(arm())))


@pytest.mark.parametrize(
    "more, expected",
    [
        (
            '<group name="hand"/><disable_collisions link1="a" link2="b"/>',
            "['disable_collisions', 'group']; this is SRDF",
        ),
        ("<robot><link name='c'/></robot>", "<robot> holds no <joint> but ['robot']; a robot is described by"),
        ('<Joint name="j" type="fixed"/>', "['Joint']; a robot is described by <link> and <joint>"),
    ],
)
def test_a_file_of_other_things_is_no_robot_without_joints(more, expected):
    assert expected in refusal(urdf(link("base", None), more))


@pytest.mark.parametrize("more", ['<material name="m"/>', "<gazebo/>", '<drake:x value="1"/>', "<ros2_control/>"])
def test_a_body_alone_may_have_what_robots_have(more):
    assert Robot.from_urdf(urdf(link("base"), more)).n == 0


@pytest.mark.parametrize(
    "text",
    [
        arm().replace("</robot>", '<drake:x value="1"><drake:y/></drake:x></robot>'),
        arm().replace("<robot", '<robot xsi:schema="x"'),
        arm(more='<gz:y gz:x="1"/>'),
        arm().replace("<robot", '<robot xmlns="http://www.ros.org"'),
    ],
    ids=["elements", "attributes", "in a link", "a namespace without a prefix"],
)
def test_prefixes_need_no_declaration(text):
    assert torch.equal(torques(Robot.from_urdf(text)), torques(Robot.from_urdf(arm())))


# --- malformed: text -------------------------------------------------------------------------------------------------

BOMB = '<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {after} "{f"&{before};" * 10}">' for before, after in zip("abcdefghi", "bcdefghij", strict=True)
)


@pytest.mark.case("U8")
@pytest.mark.parametrize(
    "head",
    [
        "<!DOCTYPE robot>",
        BOMB + "]>",
        '<!DOCTYPE robot [<!ENTITY file SYSTEM "file:///etc/hostname">]>',
        '<!DOCTYPE robot SYSTEM "http://localhost:1/robot.dtd">',
    ],
    ids=["type", "bomb", "file", "network"],
)
def test_document_types_and_entities_are_refused(head):
    text = head + arm().replace(
        'name="arm"', 'name="&file;"' if "file" in head else 'name="&j;"' if BOMB in head else ""
    )
    assert "document type or entities" in refusal(text)


@pytest.mark.case("U8")
def test_an_entity_bomb_in_another_encoding_is_refused(tmp_path):
    path = tmp_path / "bomb.urdf"
    path.write_bytes((BOMB + "]>" + arm()).encode("utf-16"))
    assert "not UTF-8" in refusal(path)


@pytest.mark.case("U8")
@pytest.mark.parametrize("around", [arm, lambda more: urdf(more)], ids=["in a link", "in the robot"])
def test_deep_nesting_is_refused(around):
    assert "400" in refusal(around(more="<a>" * 200_000 + "</a>" * 200_000))


@pytest.mark.case("U8")
def test_more_attributes_than_any_robot_has_are_refused():
    attributes = " ".join(f'a{i}="1"' for i in range(300_000))
    assert "attributes; a robot description has at most 200000" in refusal(
        arm().replace("<robot", f"<robot {attributes}")
    )


@pytest.mark.case("U8")
def test_nesting_that_is_not_refused_is_survived():
    assert Robot.from_urdf(arm(more="<a>" * 90_000 + "</a>" * 90_000)).n == 2


def test_robots_within_robots_are_none():
    assert "<robot> holds no <joint> but ['robot']" in refusal("<robot>" * 90_000 + "</robot>" * 90_000)


@pytest.mark.case("U8")
@pytest.mark.parametrize("shape", ["chain", "star"])
def test_more_links_than_can_be_read_safely_are_refused(shape):
    n = 10_000  # a chain of so many overflows the stack of the library that puts the tree together
    names = ["base", *(f"l{i}" for i in range(n))]
    joints = (
        f'<joint name="j{i}" type="fixed"><parent link="{names[i] if shape == "chain" else "base"}"/>'
        f'<child link="{names[i + 1]}"/></joint>'
        for i in range(n)
    )
    assert "10001 links and 10000 joints; at most 2000" in refusal(urdf(*(link(x, None) for x in names), *joints))


def test_a_long_chain_is_read_in_time_that_grows_with_its_length():
    def seconds(n):
        links = [link("l0", None), *(link(f"l{i + 1}", 1.0) for i in range(n))]
        text = urdf(*links, *(joint(f"j{i}", f"l{i}", f"l{i + 1}", axis=(0, 1, 0)) for i in range(n)))
        begin = time.thread_time()
        assert Robot.from_urdf(text).n == n
        return time.thread_time() - begin

    seconds(50)
    assert seconds(800) < 5.0


@pytest.mark.parametrize("part", [0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_truncated_text_is_refused(part):
    assert "not well-formed XML" in refusal(arm()[: int(part * len(arm()))])


def test_truncated_bytes_are_refused(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_bytes(arm().replace('"arm"', '"ä"').encode()[:14])  # in the middle of a character
    assert "not UTF-8" in refusal(path)


@pytest.mark.case("U8")
@pytest.mark.parametrize("encoding", ["utf-16", "utf-32", "latin-1"])
def test_a_file_that_is_not_utf8_is_refused(tmp_path, encoding):
    path = tmp_path / "arm.urdf"
    path.write_bytes(arm().replace('"arm"', '"bras articulé"').encode(encoding))
    assert "not UTF-8" in refusal(path)


@pytest.mark.parametrize("bad", ["\0", "\ud800", "<", "&", "&nbsp;", "<!-- ", "]]>"])
def test_text_that_is_not_xml_is_refused(bad):
    assert "not well-formed XML" in refusal(arm().replace("</robot>", bad + "</robot>"))


@pytest.mark.case("U8")
def test_a_huge_file_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "arm.urdf"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # a terabyte, of which nothing is on the disk
    assert "more than 10000000 bytes" in refusal(path)


@pytest.mark.case("U8")
def test_huge_text_is_refused():
    assert "10000000" in refusal(arm() + " " * 10_000_000)


def test_a_long_number_takes_no_time_to_refuse():
    refusal(arm(mass="1" * 50_000 + "x"))


@pytest.mark.case("U8")
@pytest.mark.parametrize("field", ["mass", "xyz"])
@pytest.mark.parametrize("blank", [" ", " " * 99, "\n"])
def test_millions_of_numbers_in_place_of_one_take_no_time_to_refuse(field, blank):
    text = arm(**{field: ("1" + blank) * (9_000_000 // (1 + len(blank)))})
    begin = time.thread_time()
    assert f"{'value' if field == 'mass' else field} must be" in refusal(text)
    assert time.thread_time() - begin < 0.5


@pytest.mark.case("U8")
def test_a_refusal_does_not_repeat_the_file():
    assert len(refusal(arm(mass="secret " * 10_000, xyz="x" * 10_000))) < 500


@pytest.mark.case("U8")
@pytest.mark.parametrize("old", ['"arm"', '"upper"', '"elbow"'])
def test_a_name_is_not_a_book(old):
    message = refusal(arm().replace(old, '"' + "n" * 50_000 + '"'))
    assert "name must have at most 1000 characters, found 50000: 'nnn" in message and len(message) < 5_000


@pytest.mark.case("U8")
def test_a_refusal_does_not_list_all_links():
    message = refusal(urdf(*(link(f"l{i}", None) for i in range(1000))))
    assert "found 1000: ['l0', " in message and "and 980 more" in message and len(message) < 500


def test_a_long_path_is_not_repeated():
    assert "File name too long" in (message := refusal("a" * 100_000)) and len(message) < 500


# --- unphysical ------------------------------------------------------------------------------------------------------

UNPHYSICAL = {
    "negative mass": ({"mass": -1.25}, "link 'upper': mass must not be negative, found -1.25 kg"),
    "negative moment": (
        {"inertia": (0.1, 0, 0.2, 0, 0, -0.05)},
        "link 'upper': inertia must be positive definite, found principal moments -0.05, 0.1, 0.2 kg m^2",
    ),
    "large product": (
        {"inertia": (0.1, 0.3, 0.1, 0, 0, 0.1)},
        "link 'upper': inertia must be positive definite, found principal moments -0.2, 0.1, 0.4 kg m^2",
    ),
    "negative inertia without mass": (
        {"mass": 0.0, "inertia": (0.1, 0, 0.2, 0, 0, -0.05)},
        "link 'upper': inertia must be positive definite, found principal moments -0.05, 0.1, 0.2 kg m^2",
    ),
}


@pytest.mark.case("I3")
@pytest.mark.case("U2")
@pytest.mark.parametrize("case", UNPHYSICAL)
def test_a_body_that_cannot_exist_is_refused_by_name_and_number(case):
    upper, expected = UNPHYSICAL[case]
    assert expected in refusal(arm(**upper), UnphysicalError)


BROKEN_TRIANGLE = (
    "link 'upper': the largest principal moment must not exceed the sum of the others (triangle inequality), found "
)


@pytest.mark.case("I3")
@pytest.mark.parametrize("largest", [0.25, 0.2001])
def test_an_inertia_that_only_breaks_the_triangle_inequality_is_read_with_a_warning(largest):
    """Its torques are those of the file, linear in the inertia as all torques are; `check` is the strict way."""
    inertia = np.array([0.1, 0, 0.1, 0, 0, largest])
    with pytest.warns(UserWarning, match="triangle") as caught:
        robot = Robot.from_urdf(arm(inertia=inertia))
    message = str(caught[0].message)
    assert (
        f"{BROKEN_TRIANGLE}principal moments 0.1, 0.1, {largest} kg m^2" in message
        and "on_unphysical='repair'" in message
    )
    assert caught[0].filename == __file__
    assert robot.inertia[0].tolist() == inertia.tolist() and BROKEN_TRIANGLE in str(robot.report())
    half, rest = (Robot.from_urdf(arm(inertia=x), on_unphysical="ignore") for x in (inertia / 2, 0 * inertia))
    assert same(torques(robot) + torques(rest), 2 * torques(half), 1e-12)
    with pytest.raises(UnphysicalError, match="triangle"):
        robot.check()


@pytest.mark.case("I3")
@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_the_judgement_does_not_depend_on_the_scale(scale):
    with pytest.warns(UserWarning, match="triangle inequality"):
        Robot.from_urdf(arm(inertia=np.array([0.1, 0, 0.1, 0, 0, 0.25]) * scale))


def test_with_a_fault_that_gives_wrong_numbers_an_odd_inertia_is_named_in_the_error():
    text = arm(inertia=(0.1, 0, 0.1, 0, 0, 0.25)).replace('ixx="0.04"', 'ixx="-0.04"')
    message = refusal(text, UnphysicalError)
    assert "link 'upper': the largest" in message and "link 'lower': inertia must be positive" in message


def test_every_unphysical_body_is_told_at_once():
    text = arm(mass=-1).replace('ixx="0.04"', 'ixx="-0.04"')
    message = refusal(text, UnphysicalError)
    assert "link 'upper'" in message and "link 'lower'" in message


@pytest.mark.case("I2")
def test_numbers_printed_with_six_digits_are_believed():
    # a thin plate: xx + yy = zz, each rounded where the file was written
    robot = Robot.from_urdf(arm(inertia=("0.333333", 0, "0.666667", 0, 0, "1.00000049")))
    assert not any("triangle" in note for note in map(str, robot.notes))


TURN = rotation((1, 2, 3))
THIN = {
    "point": (0, 0, 0, 0, 0, 0),
    "rod": (0.1, 0, 0.1, 0, 0, 0),
    "plate": (0.1, 0, 0.2, 0, 0, 0.3),
    "turned rod": flat(TURN @ np.diag([0.1, 0.1, 0]) @ TURN.T),
    "turned plate": flat(TURN @ np.diag([0.1, 0.2, 0.3]) @ TURN.T),
}


@pytest.mark.case("I2")
@pytest.mark.parametrize("inertia", THIN.values(), ids=THIN)
def test_points_rods_and_plates_can_exist(inertia):
    robot = Robot.from_urdf(arm(inertia=inertia))
    q, qd, qdd = states(2)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    assert torch.allclose(torchdq.forward_dynamics(robot, q, qd, tau), qdd, rtol=1e-9, atol=1e-9)


def arm_of_size(s):
    """Lengths times s, masses s^3, inertias s^5; the last link carries another on a fixed joint."""

    def body(name, mass, *xyz):
        return link(name, mass * s**3, np.array(ORDINARY) * s**5, np.array(xyz) * s)

    return urdf(
        link("base", None),
        body("upper", 1.0, 0.02, -0.03, 0.1),
        body("lower", 0.5, 0, 0.2, 0),
        body("tool", 0.3, 0.1, 0, 0),
        joint("shoulder", "base", "upper", axis=(0, 1, 0), xyz=(0, 0, 0.3 * s)),
        joint("elbow", "upper", "lower", axis=(1, 0, 0), xyz=(0.1 * s, 0, 0.4 * s)),
        fixed("mount", "lower", "tool", (0, 0.3 * s, 0), (0.4, 0.5, 0.6)),
    )


@pytest.mark.case("U9")
@pytest.mark.parametrize("size", [1e-6, 1e-3, 1e3, 1e6], ids=["dust", "worm", "giant", "moon"])
def test_robots_of_any_size_are_accepted(size):
    ordinary = Robot.from_urdf(arm_of_size(1.0))
    scaled = Robot.from_urdf(arm_of_size(size), gravity=(0, 0, -9.81 * size))
    assert same(torques(scaled) / size**5, torques(ordinary))


def test_a_micro_hand_on_a_crane_is_accepted():
    text = urdf(
        link("base", None),
        link("crane", 1e9, (1e6, 0, 1e6, 0, 0, 1e6)),
        link("hand", 1e-6, (1e-12, 0, 1e-12, 0, 0, 1e-12), (0, 0, 0)),
        joint("rail", "base", "crane", "prismatic"),
        joint("wrist", "crane", "hand", xyz=(30, 0, 20)),
    )
    assert Robot.from_urdf(text).n == 2


@pytest.mark.case("I1")
@pytest.mark.case("U1")
def test_a_massless_link_between_heavy_ones_is_accepted():
    """A universal joint: the cross between its two axes has no mass of its own."""
    text = urdf(
        link("base", None),
        link("cross", None),
        link("heavy", 40.0, xyz=(0.1, 0.2, 0.5)),
        joint("pitch", "base", "cross", axis=(0, 1, 0)),
        joint("roll", "cross", "heavy", axis=(1, 0, 0)),
    )
    robot = Robot.from_urdf(text)
    q, qd, qdd = states(2)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    assert torch.allclose(torchdq.forward_dynamics(robot, q, qd, tau), qdd, rtol=1e-9, atol=1e-9)


NO_INERTIA = {
    "a massless leaf": (link("finger", None), {}),
    "a point on the axis": (link("finger", 1.0, (0,) * 6, (0, 0, 0.3)), {}),
    "a rod along the axis": (link("finger", 1.0, (0.1, 0, 0.1, 0, 0, 0), (0, 0, 0.3)), {}),
    "a massless leaf that slides": (link("finger", None), {"kind": "prismatic"}),
}


@pytest.mark.case("I1")
@pytest.mark.case("U1")
@pytest.mark.parametrize("case", NO_INERTIA)
def test_a_joint_that_moves_nothing_has_torques_and_poses_but_no_accelerations(case):
    finger, how = NO_INERTIA[case]
    more = finger + joint("knuckle", "lower", "finger", **how)
    robot = Robot.from_urdf(arm().replace("</robot>", more + "</robot>"))
    assert [note.partition(":")[0] for note in map(str, robot.notes) if "moves no inertia" in note] == [
        "joint 'knuckle'"
    ]
    q, qd, qdd = states(3)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd, backend="eager")
    assert bool(tau.isfinite().all())
    assert bool(torchdq.forward_kinematics(robot, q, "finger", backend="eager").isfinite().all())
    with pytest.raises(SingularInertiaError, match="knuckle"):
        torchdq.forward_dynamics(robot, q, qd, tau, backend="eager")


@pytest.mark.case("U1")
def test_an_inertia_that_is_only_rounding_is_none():
    # the point lies on the knuckle's axis, but only up to the rounding of 0.1 + 0.2 - 0.3
    more = link("finger", None) + joint("knuckle", "lower", "finger") + link("tip", 1.0, (0,) * 6, (0.1, 0, 0))
    more += link("mid", None) + fixed("a", "finger", "mid", (0.2, 0, 0)) + fixed("b", "mid", "tip", (-0.3, 0, 0))
    robot = Robot.from_urdf(arm().replace("</robot>", more + "</robot>"), on_unphysical="ignore")
    assert 0 < abs(float(robot.com[2, 0])) < 1e-16
    assert any("'knuckle': it moves no inertia" in note for note in map(str, robot.notes))


def test_links_that_never_move_are_not_judged():
    bad = {"mass": -1.0, "inertia": (1, 0, 0, 0, 0, -1)}
    text = arm().replace(link("base", None), link("base", **bad) + link("stand", **bad))
    assert Robot.from_urdf(text.replace("</robot>", fixed("bolt", "base", "stand") + "</robot>")).n == 2


def test_a_link_that_is_locked_to_the_base_is_not_judged():
    assert Robot.from_urdf(arm(mass=-1.0), lock={"shoulder": 0.0}).n == 1


def test_a_link_on_a_fixed_joint_that_moves_is_judged():
    more = link("tool", -0.1) + fixed("mount", "lower", "tool")
    assert "link 'tool': mass must not" in refusal(arm().replace("</robot>", more + "</robot>"), UnphysicalError)


@pytest.mark.case("I3")
def test_a_warning_can_take_the_place_of_the_error():
    with pytest.warns(UserWarning, match="link 'upper': mass must not be negative, found -1 kg") as caught:
        robot = Robot.from_urdf(arm(mass=-1.0), on_unphysical="warn")
    assert robot.mass[0] == -1.0
    assert caught[0].filename == __file__  # it points at the caller's line, not into the package


def test_the_report_can_take_the_place_of_the_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = Robot.from_urdf(arm(mass=-1.0), on_unphysical="ignore")
    assert "link 'upper': mass must not be negative, found -1 kg" in str(robot.report())


def test_there_is_no_other_way_to_deal_with_the_unphysical():
    with pytest.raises(ArgumentError, match="on_unphysical must be one of"):
        Robot.from_urdf(arm(), on_unphysical="balance")


def test_what_was_ignored_is_computed_all_the_same():
    robot = Robot.from_urdf(arm(mass=-1.0), on_unphysical="ignore", gravity=(0, 0, 0))
    mirrored = Robot.from_urdf(arm(mass=1.0, inertia=-np.array(ORDINARY)), on_unphysical="ignore", gravity=(0, 0, 0))
    light = Robot.from_urdf(arm(mass=0.0, inertia=(0,) * 6), gravity=(0, 0, 0))
    # torques are linear in the mass and the inertia of a link
    assert same(torques(robot) + torques(mirrored), 2 * torques(light), 1e-12)


# --- fuzz ------------------------------------------------------------------------------------------------------------

SEEDS_OF_A_BATCH = 40
NASTY = [
    "1e-9",
    "0.1",
    "-0.1",
    "1e3",
    "-3.14",
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e-320",
    "-0",
    "0",
    "",
    "-1",
    "1e50",
    "0 0",
    "x",
    "1e9999",
]

RICH = tree().replace("</robot>", "") + "".join(
    [
        link("tool", 0.2, rpy=(0.1, 0.2, 0.3), more='<visual><geometry><mesh filename="no.stl"/></geometry></visual>'),
        link("camera", None),
        link("slide", 0.4),
        link("wheel", 0.3),
        fixed("mount", "left2", "tool", (0.1, 0, 0), (0.4, 0.5, 0.6)),
        fixed("stand", "base", "camera"),
        joint("rail", "right1", "slide", "prismatic", axis=(0, 2, 1), more=LIMIT + '<dynamics damping="1"/>'),
        joint("axle", "trunk", "wheel", "continuous", more='<mimic joint="rail"/>'),
        "</robot>",
    ]
)


def mutant(seed):
    """RICH with one to three random wounds."""
    rng, text = random.Random(seed), RICH
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        tags = list(re.finditer(r"<[^>]*>", text))
        numbers = list(re.finditer(r"(?<=[\" ])-?\d+(\.\d+)?(?=[\" ])", text))
        names = list(re.finditer(r'(?<==")[a-z_]\w*(?=")', text))
        wounds = ["cut", "tag", "double", "rename", *["number"] * 5, "name", "character", "element"]
        wound = rng.choice(wounds)
        if wound == "cut":
            text = text[: rng.randrange(len(text) + 1)] if rng.random() < 0.3 else text
        elif wound == "tag" and tags:
            tag = rng.choice(tags)
            text = text[: tag.start()] + text[tag.end() :]
        elif wound == "double" and tags:
            tag = rng.choice(tags)
            text = text[: tag.end()] + tag.group() + text[tag.end() :]
        elif wound == "element":
            whole = list(re.finditer(r"<(link|joint) .*?</\1>", text))
            if whole:
                element = rng.choice(whole)
                text = text[: element.start()] + element.group() * rng.choice([0, 2]) + text[element.end() :]
        elif wound == "rename" and tags:
            word = rng.choice(re.findall(r"[a-z]\w*", rng.choice(tags).group()) or ["link"])
            text = text.replace(word, rng.choice(["link", "joint", "robot", "mass", "origin", "zzz", ""]), 1)
        elif wound == "number" and numbers:
            number = rng.choice(numbers)
            text = text[: number.start()] + rng.choice(NASTY) + text[number.end() :]
        elif wound == "name" and names:
            name = rng.choice(names)
            other = rng.choice(names).group() if rng.random() < 0.7 else ""
            text = text[: name.start()] + other + text[name.end() :]
        elif text:
            at = rng.randrange(len(text))
            text = text[:at] + rng.choice(["", "<", ">", '"', "&", "\0", "é", "\ud800", "9" * 400]) + text[at + 1 :]
    return text


def fate(text, on_unphysical):
    """What becomes of a text: a robot, or the name of one of the package's errors; anything else is let through."""
    begin = time.thread_time()
    try:
        robot = Robot.from_urdf(text, on_unphysical=on_unphysical)
    except TorchdqError as error:
        assert time.thread_time() - begin < 1.0
        return type(error).__name__
    assert time.thread_time() - begin < 1.0
    return robot


def test_the_unwounded_file_is_a_robot():
    assert isinstance(fate(RICH, "error"), Robot)


@pytest.mark.case("U2", "U3", "U8")
@pytest.mark.parametrize("batch", range(25))
def test_a_wounded_file_is_a_robot_or_one_of_the_packages_errors(batch):
    for seed in range(batch * SEEDS_OF_A_BATCH, (batch + 1) * SEEDS_OF_A_BATCH):
        outcome = fate(mutant(seed), "error" if seed % 2 else "ignore")
        if isinstance(outcome, Robot):
            fields = [outcome.X_PB_home, outcome.screw, outcome.mass, outcome.com, outcome.inertia]
            assert all(bool(x.isfinite().all()) for x in fields)
            assert bool(torques(outcome).isfinite().all())


def test_the_wounds_are_neither_all_deadly_nor_all_harmless():
    fates = Counter(type(fate(mutant(seed), "error")).__name__ for seed in range(200))
    assert min(fates["Robot"], fates["str"]) > 30
