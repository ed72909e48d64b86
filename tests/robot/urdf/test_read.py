"""Robots of URDF files: random files are read as Pinocchio reads them, and the rest is worked out by hand."""

import math
from itertools import product

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one, thinned
from messages import refused, warned
from robots import EPS, F64, same, states, torques
from rotations import about, flat, rotation
from rotations import tensor as matrix
from urdf_text import LIMIT, ORDINARY, also, arm, codes, fixed, joint, link, position, random_elements, tree, urdf

import torchdq
from torchdq import ArgumentError, DescriptionError, Robot, SingularInertiaError, TorchdqError, UnphysicalError, dq

DIRECTION = np.array([2.0, -3.0, 6.0]) / 7.0

# --- random files against pinocchio ----------------------------------------------------------------------------------


@pytest.mark.case("U5", "U9", "U10")
@pytest.mark.parametrize("seed", thinned(range(12), range(3)))
def test_a_random_file_is_the_robot_that_pinocchio_reads(seed):
    """Trees in any order, with turned bodies and axes, and links on fixed joints, in rows and on the base."""
    text = urdf(*random_elements(seed, n=10))
    robot, model = Robot.from_urdf(text, on_unphysical="ignore"), pin.buildModelFromXML(text)
    data = model.createData()
    assert robot.joint_names == tuple(model.names)[1:]
    assert robot.parents == tuple(int(parent) - 1 for parent in model.parents)[1:]
    assert same(robot.limits.lower, model.lowerPositionLimit) and same(robot.limits.velocity, model.velocityLimit)
    assert same(robot.limits.upper, model.upperPositionLimit) and same(robot.limits.effort, model.effortLimit)
    q, qd, qdd = states(robot.n)
    tau = [pin.rnea(model, data, *(x[k].numpy() for x in (q, qd, qdd))) for k in range(len(q))]
    assert same(torchdq.inverse_dynamics(robot, q, qd, qdd), np.array(tau), 1e-12)
    pin.framesForwardKinematics(model, data, q[0].numpy())
    for name, X in zip(robot.frame_names, dq.to_matrix(torchdq.forward_kinematics(robot, q[0])), strict=True):
        assert same(X, data.oMf[model.getFrameId(name)].homogeneous, 1e-12)


@all_in_one(range(6))
def test_locked_joints_are_those_of_a_reduced_model(seed):
    """Whether they are locked as the file is read or afterwards."""
    text = urdf(*random_elements(seed, n=8, kinds=("revolute", "prismatic", "fixed")))
    whole, model = Robot.from_urdf(text, on_unphysical="ignore"), pin.buildModelFromXML(text)
    at = {name: 0.3 - 0.1 * i for i, name in enumerate(whole.joint_names[seed % 2 :: 2])}
    q = np.array([at.get(name, 0.0) for name in whole.joint_names])
    reduced = pin.buildReducedModel(model, [model.getJointId(name) for name in at], q)
    q, qd, qdd = (x[0].numpy() for x in states(whole.n - len(at)))
    data = reduced.createData()
    tau = pin.rnea(reduced, data, q, qd, qdd)
    pin.framesForwardKinematics(reduced, data, q)
    for robot in (Robot.from_urdf(text, lock=at, on_unphysical="ignore"), whole.lock(at)):
        assert robot.joint_names == tuple(reduced.names)[1:]
        assert same(torchdq.inverse_dynamics(robot, *map(torch.from_numpy, (q, qd, qdd))), tau, 1e-13)
        X = dq.to_matrix(torchdq.forward_kinematics(robot, torch.from_numpy(q)))
        for pose, name in zip(X, robot.frame_names, strict=True):
            assert same(pose, data.oMf[reduced.getFrameId(name, pin.FrameType.BODY)].homogeneous, 1e-13)


@all_in_one(["talos_full_v2", "solo12", "romeo", "quadrotor_base"])
def test_free_bases_of_real_robots_are_those_of_pinocchio(name):
    path = oracles.urdf_paths()[name]
    found = Robot.from_urdf(path, base="floating", mimic="independent", on_unphysical="ignore")
    body = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer()).inertias[1]
    assert math.isclose(found.base_mass, body.mass, rel_tol=1e-14)
    np.testing.assert_allclose(found.base_com, body.lever, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.base_inertia, flat(body.inertia), rtol=0, atol=1e-14 * np.abs(body.inertia).max())


# --- links and joints ------------------------------------------------------------------------------------------------


@pytest.mark.case("U5")
@all_in_one(["base", "upper", "lower"])
def test_a_massless_link_on_a_fixed_joint_changes_no_torque_and_is_a_frame(on):
    robot = Robot.from_urdf(also(link("tool", None) + fixed("mount", on, "tool", (0.3, -0.2, 0.1), (0.4, 0.5, 0.6))))
    assert torch.equal(torques(robot), torques(arm()))
    assert set(robot.frame_names) == {"base", "upper", "lower", "tool"} and robot.link_names == ("upper", "lower")


@pytest.mark.case("U7")
def test_a_continuous_joint_takes_the_plain_angle_and_has_no_position_limits():
    robot = Robot.from_urdf(arm().replace("revolute", "continuous"))
    assert robot.kinds == ("revolute", "revolute") and torch.equal(torques(robot), torques(arm()))
    assert [x.tolist() for x in robot.limits] == [[-math.inf] * 2, [math.inf] * 2, [3.0] * 2, [4.0] * 2]
    bare = Robot.from_urdf(arm().replace("revolute", "continuous").replace(LIMIT, ""))
    assert all(bool(limit.isinf().all()) for limit in bare.limits) and bare.notes == ()


def one_joint(kind="revolute", **placed):
    """A robot of one joint "j"."""
    return Robot.from_urdf(urdf(link("base", None), link("a"), joint("j", "base", "a", kind, **placed)))


@pytest.mark.case("U9")
@all_in_one(["revolute", "prismatic"])
def test_a_joint_may_be_turned_by_a_quarter_in_pitch(kind):
    R, p = rotation((0.3, math.pi / 2, 0.2)), np.array([0.1, 0.2, 0.3])
    robot = one_joint(kind, xyz=p, rpy=(0.3, math.pi / 2, 0.2), axis=DIRECTION)
    X = dq.to_matrix(torchdq.forward_kinematics(robot, torch.tensor([0.8], dtype=F64), "a"))
    turned, moved = (R @ about(DIRECTION, 0.8), p) if kind == "revolute" else (R, p + R @ DIRECTION * 0.8)
    assert same(X[:3, :3], turned) and same(X[:3, 3], moved)


@pytest.mark.case("U6")
def test_an_axis_may_have_any_length_and_is_x_where_it_is_not_given():
    unit = one_joint(axis=DIRECTION)
    assert ("axis.scaled", "j") not in codes(unit) and one_joint(axis=None).screw.tolist() == [[1, 0, 0, 0, 0, 0]]
    for length in (3.0, 1e-6, 1e40):
        scaled = one_joint(axis=DIRECTION * length)
        assert same(torques(scaled), torques(unit)) and ("axis.scaled", "j") in codes(scaled)
    still = joint("m", "lower", "tool", "fixed", axis=(0, 0, 0), more="")  # whose axis does not matter
    assert Robot.from_urdf(also(link("tool", None) + still)).n == 2


@all_in_one(["revolute", "prismatic"])
def test_a_joint_without_limits_is_unlimited(kind):
    robot = Robot.from_urdf(also(link("x") + joint("j", "lower", "x", kind, more="")))
    assert robot.limits.lower[2] == -math.inf and robot.limits.effort[2] == math.inf
    assert ("limits.missing", "j") in codes(robot)


@pytest.mark.case("U7")
def test_positions_that_a_limit_does_not_state_are_zero():
    """Which is warned of where it leaves a joint no room, with the way out."""
    with warned(UserWarning):
        robot = Robot.from_urdf(arm().replace(LIMIT, '<limit velocity="3" effort="4"/>'))
    assert robot.limits.lower.tolist() == robot.limits.upper.tolist() == [0.0, 0.0]
    unstated = {x.subject: x.cure for x in robot.notes if x.code == "limits.unstated"}
    assert set(unstated) == {"joint 'shoulder'", "joint 'elbow'"} and "continuous" in unstated["joint 'elbow'"]
    half = Robot.from_urdf(arm().replace(LIMIT, '<limit velocity="3" effort="4" upper="1"/>'))
    assert half.limits.lower.tolist() == [0.0, 0.0] and half.limits.upper.tolist() == [1.0, 1.0]
    assert ("limits.partial", "shoulder (lower), elbow (lower)") in codes(half)


NAMES = {"universe": "universe", "root_joint": "root_joint", "lower": "lower", "Gelenk ä": "Gelenk ä"}
NAMES |= {"a &amp; b": "a & b", "a&#10;b&#13;&#9;": "a\nb\r\t"}


@all_in_one(NAMES)
def test_a_joint_may_have_any_name(name):
    """Pinocchio's own first joint, which carries the base, is called universe."""
    robot = Robot.from_urdf(arm().replace('"elbow"', f'"{name}"'))
    assert robot.joint_names == ("shoulder", NAMES[name]) and torch.equal(torques(robot), torques(arm()))
    locked = Robot.from_urdf(arm().replace('"elbow"', f'"{name}"'), lock={NAMES[name]: 0.7})
    assert torch.equal(torques(locked), torques(Robot.from_urdf(arm(), lock={"elbow": 0.7})))


@all_in_one([*product(["base", "upper", "lower"], [*NAMES, "shoulder"])])
def test_a_link_may_have_any_name(names):
    old, name = names
    if name == "lower" and old != "lower":
        name = "elbow"  # no two links of a name, but a joint's will do
    robot = Robot.from_urdf(arm().replace(f'"{old}"', f'"{name}"'), lock={"shoulder": 0.3})
    assert NAMES.get(name, name) in robot.frame_names
    assert torch.equal(torques(robot), torques(Robot.from_urdf(arm(), lock={"shoulder": 0.3})))


@pytest.mark.case("U10")
@all_in_one(range(4))
def test_the_order_of_the_file_does_not_matter(order):
    plain, shuffled = Robot.from_urdf(tree()), Robot.from_urdf(tree(order))
    assert shuffled.joint_names == plain.joint_names and torch.equal(torques(shuffled), torques(plain))
    assert all(parent < i for i, parent in enumerate(shuffled.parents))


# --- planar joints ---------------------------------------------------------------------------------------------------


def test_a_planar_joint_is_two_slides_and_a_turn():
    drive = joint("drive", "lower", "cart", "planar", (1, 2, 3), (0.1, 0.2, 0.3), axis=2 * DIRECTION)
    robot = Robot.from_urdf(also(link("cart") + drive))
    names = ("drive_x", "drive_y", "drive_angle")
    assert {("joint.planar", "drive"), ("axis.scaled", ", ".join(names))} <= codes(robot)
    assert robot.joint_names[2:] == names and robot.link_names[2:] == ("drive_x", "drive_y", "cart")
    x, y, z = robot.screw[2, 3:], robot.screw[3, 3:], robot.screw[4, :3]
    frame = torch.stack([x, y, z], -1)
    assert same(frame.T @ frame, torch.eye(3)) and float(torch.linalg.det(frame)) > 0 and same(z, DIRECTION)
    assert bool(robot.limits.upper[2:].isinf().all())
    spelled = link("sx", None) + link("sy", None) + link("cart")
    spelled += joint("drive_x", "lower", "sx", "prismatic", (1, 2, 3), (0.1, 0.2, 0.3), axis=x)
    spelled += joint("drive_y", "sx", "sy", "prismatic", axis=y) + joint("drive_angle", "sy", "cart", axis=z)
    assert same(torques(also(spelled)), torques(robot))


@all_in_one([1, -1])
def test_a_planar_joint_about_z_slides_along_x_and_y(sign):
    robot = one_joint("planar", axis=(0, 0, sign))
    assert same(position(robot, [0.3, -0.4, 0.7], "a"), [0.3, -0.4 * sign, 0.0])


# --- floating bases ---------------------------------------------------------------------------------------------------

FLYING = tree().replace(link("base", None), link("base", 5.0))


def test_a_free_base_has_the_body_of_its_link_and_of_what_is_locked_to_it():
    still, found = Robot.from_urdf(FLYING), Robot.from_urdf(FLYING, base="floating")
    assert still.base_mass is still.base_com is still.base_inertia is None
    assert found.base_mass == 5.0 and same(found.base_com, [0.02, -0.03, 0.1]) and same(found.base_inertia, ORDINARY)
    assert found.base_mass.shape == () and found.base_com.shape == (3,) and found.base_inertia.shape == (6,)
    assert Robot.from_urdf(FLYING, base="floating", lock={"waist": 0.4}).base_mass == 8.0
    assert Robot.from_urdf(urdf(link("drone", 2.0)), base="floating").base_mass == 2.0

    # inertia alone is no fault
    found = Robot.from_urdf(tree().replace(link("base", None), link("base", 0.0)), base="floating")
    assert found.base_mass == 0.0 and ("inertia.massless", "link 'base'") in codes(found, ("note",))


def floating(origin=((0.3, -0.2, 0.5), (0.4, 0.5, 0.6)), world=None, more=""):
    """A file whose floating joint carries a trunk with arms, from a link with a stand on it."""
    stand = fixed("bolt", "world", "stand", (0.1, 0, 0)) + link("stand", None)
    joints = joint("root", "stand", "base", "floating", *origin, axis=None, more="")
    return also(link("world", world) + stand + joints + more, FLYING)


def test_what_a_floating_joint_carries_is_the_floating_base_as_in_pinocchio():
    """X_WB is the base in the link that no joint carries; the joint's own coordinates are behind its origin."""
    text = floating()
    model = pin.buildModelFromXML(text)
    data, n = model.createData(), model.nv - 6
    robot = Robot.from_urdf(text)
    assert robot.floating and robot.joint_names == tuple(model.names)[2:] and robot.frame_names[0] == "base"
    rng = np.random.default_rng(0)
    r, p = rng.normal(size=4), rng.normal(size=3)
    r /= np.linalg.norm(r)
    X = dq.from_pose(*map(torch.from_numpy, (r, p)))
    q, qd, qdd = rng.normal(size=(3, n))
    V, A = rng.normal(size=(2, 6))
    at = model.jointPlacements[1].inverse() * pin.SE3(pin.Quaternion(*r), p)
    where = np.concatenate([pin.SE3ToXYZQUAT(at), q])
    swapped = [3, 4, 5, 0, 1, 2, *range(6, 6 + n)]  # (linear, angular) of Pinocchio
    v, a = (np.concatenate(x)[swapped] for x in ((V, qd), (A, qdd)))
    tensors = [*map(torch.from_numpy, (q, V, qd, A, qdd))]
    found = torch.cat(torchdq.floating.inverse_dynamics(robot, X, *tensors), -1)
    assert same(found, pin.rnea(model, data, where, v, a), 1e-12)  # (force, moment) of both
    M = torchdq.floating.mass_matrix(robot, X, tensors[0])[0]
    assert same(M, np.array(pin.crba(model, data, where))[np.ix_(swapped, swapped)], 1e-12)
    pin.framesForwardKinematics(model, data, where)
    poses = dq.to_matrix(torchdq.floating.forward_kinematics(robot, X, tensors[0]))
    for name, pose in zip(robot.frame_names, poses, strict=True):
        assert same(pose, data.oMf[model.getFrameId(name)].homogeneous, 1e-12)


def test_a_floating_joint_may_be_held_and_then_is_a_fixed_one():
    text = floating()
    held = Robot.from_urdf(text, base="fixed")
    welded = Robot.from_urdf(text.replace('type="floating"', 'type="fixed"'))
    assert held.frame_names == welded.frame_names and ("joint.held", "root") in codes(held)
    assert torch.equal(torques(held), torques(welded)) and not held.floating and not welded.floating
    assert Robot.from_urdf(text, base="floating").floating


def test_links_that_a_floating_base_leaves_behind_are_no_frames_and_their_mass_is_warned_of():
    found = Robot.from_urdf(floating())
    assert ("frame.left_out", "stand, world") in codes(found) or ("frame.left_out", "world, stand") in codes(found)
    assert not {"world", "stand"} & set(found.frame_names)
    with warned(UserWarning):
        heavy = Robot.from_urdf(floating(world=3.0))
    assert ("base.left_behind", "link 'world'") in codes(heavy, ("warning",)) and heavy.base_mass == found.base_mass
    bare = floating(more=link("door") + joint("hinge", "world", "door"))
    with refused(DescriptionError):
        Robot.from_urdf(bare)
    assert Robot.from_urdf(bare, base="fixed").n == found.n + 1 == Robot.from_urdf(bare, lock="hinge").n + 1


# --- tip, gravity, what is read but not simulated --------------------------------------------------------------------


def test_the_tip_is_the_only_leaf_that_moves_or_the_one_that_is_named():
    assert Robot.from_urdf(also(link("tool", None) + fixed("mount", "lower", "tool"))).tip == "tool"
    assert Robot.from_urdf(also(link("camera", None) + fixed("stand", "base", "camera"))).tip == "lower"
    robot = Robot.from_urdf(tree())
    assert robot.tip is None and ("tip.missing", "") in codes(robot)
    assert "no tip chosen among left2, right1; name one with tip=" in str(robot.report())
    for chosen in (Robot.from_urdf(tree(), tip="left2"), robot.with_tip("left2"), robot.replace(tip="left2")):
        assert chosen.tip == "left2" and ("tip.missing", "") not in codes(chosen)
    with warned(UserWarning):
        other = Robot.from_urdf(arm()).attach(robot, "lower", prefix="b_")
    assert other.tip == "lower" and not any(code == "tip.missing" for code, _ in codes(other))


def test_gravity_is_what_is_asked_for():
    text = urdf(link("base", None), link("car", 2.0), joint("rail", "base", "car", "prismatic", axis=(0, 1, 0)))
    lift = Robot.from_urdf(text, gravity=(1.0, -1.5, 3.0))
    assert same(torchdq.inverse_dynamics(lift, torch.zeros(1, dtype=F64)), [3.0])
    robot = Robot.from_urdf(arm(), gravity=None)
    assert robot.gravity is None and bool((torchdq.inverse_dynamics(robot, torch.ones(2, dtype=F64)) == 0).all())


CHOICES = [("gravity", (0, 0, math.nan)), ("gravity", (0, 0)), ("gravity", (0, 0, -9.81, 0)), ("base", "free")]
CHOICES += [("base", None), ("mimic", "geared"), ("mimic", True), ("on_unphysical", "mend"), ("tip", "right")]


@all_in_one(CHOICES)
def test_an_argument_that_does_not_fit_is_named(choice):
    with refused(TorchdqError):
        Robot.from_urdf(arm(), **dict([choice]))


def test_damping_friction_and_limits_are_read_and_reported_but_no_part_of_the_rigid_body():
    text = arm().replace(LIMIT, LIMIT + '<dynamics damping="0.3" friction="0.2"/>', 1)
    robot = Robot.from_urdf(text)
    assert robot.damping.tolist() == [0.3, 0.0] and robot.friction.tolist() == [0.2, 0.0]
    assert [x.tolist() for x in robot.limits] == [[-1.0] * 2, [2.0] * 2, [3.0] * 2, [4.0] * 2]
    assert torch.equal(torques(robot), torques(arm()))
    expected = {("damping.unused", "shoulder"), ("friction.unused", "shoulder"), ("limits.unused", "all joints")}
    assert codes(robot) == expected and "shoulder: viscous damping given but not simulated" in str(robot.report())
    some = arm().replace("revolute", "continuous", 1).replace(LIMIT, "", 1)
    assert ("limits.unused", "elbow") in codes(Robot.from_urdf(some))


# --- bodies that cannot exist ----------------------------------------------------------------------------------------

FLAT, NEGATIVE, WIDE = (0.1, 0, 0.1, 0, 0, 0.25), (0.1, 0, 0.2, 0, 0, -0.05), (0.1, 0.3, 0.1, 0, 0, 0.1)
LIGHT, INDEFINITE, LOWER = ("mass.negative", "upper"), ("inertia.indefinite", "upper"), ("inertia.indefinite", "lower")
FREE, REPAIR = {"base": "floating"}, {"on_unphysical": "repair"}
UNPHYSICAL = {  # file, options, and faults by code and link
    "negative mass": (arm(mass=-1.25), {}, LIGHT),
    "negative moment": (arm(inertia=NEGATIVE), {}, INDEFINITE),
    "large product": (arm(inertia=WIDE), {}, INDEFINITE),
    "no mass": (arm(mass=0.0, inertia=NEGATIVE), {}, INDEFINITE),
    "two": (arm(mass=-1).replace('ixx="0.04"', 'ixx="-0.04"'), {}, LIGHT, LOWER),
    "two, of which one alone is read": (
        *(arm(inertia=FLAT).replace('ixx="0.04"', 'ixx="-0.04"'), {}),
        *(("inertia.triangle", "upper"), LOWER),
    ),
    "on a fixed joint": (also(link("tool", -0.1) + fixed("mount", "lower", "tool")), {}, ("mass.negative", "tool")),
    "a floating base without mass": (tree(), FREE, ("base.massless", "base")),
    "a floating base": (tree().replace(link("base", None), link("base", -5.0)), FREE, ("mass.negative", "base")),
    # no repair gives a mass to a body that has none, or another sign to a mass
    "no repair": (arm(mass=-1.0, inertia=NEGATIVE), REPAIR, LIGHT),
    "no repair without mass": (arm(mass=0.0, inertia=NEGATIVE), REPAIR, INDEFINITE),
}


@pytest.mark.case("I3", "U2")
@all_in_one(UNPHYSICAL)
def test_a_body_that_cannot_exist_is_refused_by_name_and_number(case):
    """With all others, and with a cure that helps."""
    text, options, *faults = UNPHYSICAL[case]
    with refused(UnphysicalError) as caught:
        Robot.from_urdf(text, **options)
    assert [(x.code, x.subject) for x in caught.value.findings] == [(code, f"link {name!r}") for code, name in faults]


@pytest.mark.case("I3")
@pytest.mark.filterwarnings("ignore:.*other units")
@all_in_one([(0.25, 1.0), (0.2001, 1.0), (0.25, 1e-12), (0.25, 1e12)])
def test_an_inertia_that_only_breaks_the_triangle_inequality_is_read_with_a_warning(of_what):
    """Its torques are those of the file, linear in the inertia as all torques are; `check` is the strict way."""
    largest, scale = of_what
    inertia = np.array([0.1, 0, 0.1, 0, 0, largest]) * scale
    with warned(UserWarning) as caught:
        robot = Robot.from_urdf(arm(inertia=inertia))
    assert "on_unphysical='repair'" in str(caught[0].message) and caught[0].filename == __file__
    assert robot.inertia[0].tolist() == inertia.tolist() and ("inertia.triangle", "link 'upper'") in codes(robot)
    half, rest = (Robot.from_urdf(arm(inertia=x), on_unphysical="ignore") for x in (inertia / 2, 0 * inertia))
    assert same(torques(robot) + torques(rest), 2 * torques(half), 1e-12)
    with refused(UnphysicalError):
        robot.check()


POINT, ROD, PLATE, TURN = (0,) * 6, (0.1, 0, 0.1, 0, 0, 0), (0.1, 0, 0.2, 0, 0, 0.3), rotation((1, 2, 3))
THIN = [POINT, ROD, PLATE, *(flat(TURN @ matrix(I) @ TURN.T) for I in (ROD, PLATE))]
THIN += [("0.333333", 0, "0.666667", 0, 0, "1.00000049")]  # a plate, printed with six digits
# the cross of a universal joint has no mass of its own
PITCH, ROLL = joint("pitch", "base", "cross", axis=(0, 1, 0)), joint("roll", "cross", "heavy", axis=(1, 0, 0))
CROSS = urdf(link("base", None), link("cross", None), link("heavy", 40.0, xyz=(0.1, 0.2, 0.5)), PITCH, ROLL)


@pytest.mark.case("I1", "I2", "U1")
@all_in_one([*(arm(inertia=x) for x in THIN), CROSS])
def test_points_rods_plates_and_massless_links_between_can_exist(text):
    robot = Robot.from_urdf(text)
    assert not any(code == "inertia.triangle" for code, _ in codes(robot))
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
@pytest.mark.filterwarnings("ignore:.*other units")
def test_robots_of_any_size_are_accepted_and_a_micro_hand_on_a_crane():
    for size in (1e-6, 1e-3, 1e3, 1e6):  # dust, worm, giant, moon
        scaled = Robot.from_urdf(arm_of_size(size), gravity=(0, 0, -9.81 * size))
        assert same(torques(scaled) / size**5, torques(arm_of_size(1.0)))
    crane = link("crane", 1e9, (1e6, 0, 1e6, 0, 0, 1e6)) + joint("rail", "base", "crane", "prismatic")
    grip = link("hand", 1e-6, (1e-12, 0, 1e-12, 0, 0, 1e-12), (0, 0, 0))
    assert Robot.from_urdf(urdf(link("base", None), crane, grip, joint("w", "crane", "hand", xyz=(30, 0, 20)))).n == 2


NO_INERTIA = {
    "a massless leaf": (link("finger", None), {}),
    "a point on the axis": (link("finger", 1.0, POINT, (0, 0, 0.3)), {}),
    "a rod along the axis": (link("finger", 1.0, ROD, (0, 0, 0.3)), {}),
    "a massless leaf that slides": (link("finger", None), {"kind": "prismatic"}),
    # the point lies on the knuckle's axis, but only up to the rounding of 0.1 + 0.2 - 0.3
    "an inertia that is only rounding": (
        link("finger", None)
        + link("tip", 1.0, POINT, (0.1, 0, 0))
        + link("mid", None)
        # in two steps
        + fixed("a", "finger", "mid", (0.2, 0, 0))
        + fixed("b", "mid", "tip", (-0.3, 0, 0)),
        {},
    ),
}


@pytest.mark.case("I1", "U1")
@all_in_one(NO_INERTIA)
def test_a_joint_that_moves_nothing_has_torques_and_poses_but_no_accelerations(case):
    finger, how = NO_INERTIA[case]
    robot = Robot.from_urdf(also(finger + joint("knuckle", "lower", "finger", **how)))
    assert {subject for code, subject in codes(robot) if code == "joint.inert"} == {"joint 'knuckle'"}
    q, qd, qdd = states(3)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    assert bool(tau.isfinite().all()) and bool(torchdq.forward_kinematics(robot, q, "finger").isfinite().all())
    for needs in (
        lambda: torchdq.forward_dynamics(robot, q, qd, tau),
        lambda: torchdq.error_growth(robot, q),
        lambda: torchdq.nn.ForwardDynamics(robot)(q, qd, tau),
    ):
        with refused(SingularInertiaError):
            needs()


def test_only_links_that_move_are_judged():
    bad = {"mass": -1.0, "inertia": (1, 0, 0, 0, 0, -1)}
    text = arm().replace(link("base", None), link("base", **bad) + link("stand", **bad))
    assert Robot.from_urdf(also(fixed("bolt", "base", "stand"), text)).n == 2
    assert Robot.from_urdf(arm(mass=-1.0), lock={"shoulder": 0.0}).n == 1


@pytest.mark.case("I3")
def test_a_warning_or_the_report_can_take_the_place_of_the_error(recwarn):
    with warned(UserWarning) as caught:
        robot = Robot.from_urdf(arm(mass=-1.0), on_unphysical="warn")
    assert robot.mass[0] == -1.0 and caught[0].filename == __file__  # the caller's line
    recwarn.clear()
    robot = Robot.from_urdf(arm(mass=-1.0), on_unphysical="ignore", gravity=(0, 0, 0))
    assert not recwarn.list and "link 'upper': mass must not be negative, found -1 kg" in str(robot.report())
    mirrored = Robot.from_urdf(arm(mass=1.0, inertia=-np.array(ORDINARY)), on_unphysical="ignore", gravity=(0, 0, 0))
    light = Robot.from_urdf(arm(mass=0.0, inertia=(0,) * 6), gravity=(0, 0, 0))
    # torques are linear in the mass and the inertia of a link
    assert same(torques(robot) + torques(mirrored), 2 * torques(light), 1e-12)


# --- inertias that are points or rounding ----------------------------------------------------------------------------


@all_in_one(["", "<inertia/>"])
def test_a_mass_without_inertia_is_a_point(inertia):
    text = arm()[: arm().index("<inertia ")] + inertia + arm()[arm().index("</inertial>") :]
    robot = Robot.from_urdf(text)
    assert robot.inertia[0].tolist() == [0.0] * 6 and robot.mass[0] == 1.0
    assert torch.equal(torques(robot), torques(arm(inertia=(0,) * 6)))
    assert ("inertial.point", "upper") in codes(robot)
    assert ("inertial.point", "upper") not in codes(Robot.from_urdf(arm(inertia=(0,) * 6)))


@pytest.mark.case("U1")
@all_in_one(["", "<inertial/>", '<inertial><origin xyz="1 2 3"/><inertia ixx="1"/></inertial>'])
def test_a_link_without_inertial_or_mass_has_no_mass(inertial):
    robot = Robot.from_urdf(also(f'<link name="tool">{inertial}</link>' + fixed("mount", "lower", "tool")))
    assert torch.equal(torques(robot), torques(arm())) and ("link.massless", "tool") in codes(robot)
    assert (("inertial.no_mass", "tool") in codes(robot)) == bool(inertial)


def test_leftover_inertia_of_a_massless_link_counts_and_is_noted():
    robot = Robot.from_urdf(also(link("tool", 0.0, ORDINARY, (0, 0, 0)) + fixed("mount", "lower", "tool")))
    assert ("inertia.massless", "link 'tool'") in codes(robot, ("note",))
    assert same(robot.inertia[1], 2 * np.array(ORDINARY))  # as other readers have it


@all_in_one([(0.9e-7, True), (1.1e-7, False)])
def test_inertia_of_too_small_a_radius_of_gyration_is_zero(bead):
    size, rounding = bead
    text = urdf(link("base", None), link("bead", 1.0, (size**2, 0, size**2, 0, 0, size**2)), joint("j", "base", "bead"))
    robot = Robot.from_urdf(text, on_unphysical="ignore")
    assert (("inertia.rounding", "bead") in codes(robot)) == rounding == bool((robot.inertia == 0).all())


def test_inertia_that_is_rounding_is_zero_and_that_of_dust_is_not():
    on = fixed("mount", "lower", "tool")
    for mass, tiny in product([1.0, 0.0], [(0, 0, -2e-35, 0, 0, 0), (0, 2e-35, 0, 0, 0, 1e-35)]):
        robot = Robot.from_urdf(also(link("tool", mass, tiny) + on))
        assert ("inertia.rounding", "tool") in codes(robot)
        assert torch.equal(torques(robot), torques(also(link("tool", mass, POINT) + on)))
    dust = also(link("tool", 1e-18, np.array(ORDINARY) * 1e-30) + on)
    assert not any(code.startswith("inertia") for code, _ in codes(Robot.from_urdf(dust)))
    with refused(UnphysicalError) as caught:
        Robot.from_urdf(dust.replace('ixx="', 'ixx="-'))
    assert "link 'tool'" in [x.subject for x in caught.value.findings if x.code == "inertia.indefinite"]


# --- repair ----------------------------------------------------------------------------------------------------------


def second(I):
    """Second moments of an inertia."""
    I = matrix(I)
    return I.trace() / 2 * np.eye(3) - I


@all_in_one([FLAT, NEGATIVE, WIDE])
def test_a_repaired_inertia_is_the_nearest_that_a_body_has(inertia):
    robot = Robot.from_urdf(arm(inertia=inertia), on_unphysical="repair")
    E, found = second(inertia), second(robot.inertia[0].tolist())
    values, axes = np.linalg.eigh(E)
    assert values[0] < 0 and same(found, axes @ np.diag(values.clip(min=0)) @ axes.T, 1e-12)
    # no second moments nearby are nearer: the distance only grows in random directions that keep them positive
    rng = np.random.default_rng(0)
    for _ in range(200):
        A = rng.normal(size=(3, 3))
        assert np.linalg.norm(0.9 * found + 0.1 * A @ A.T * rng.uniform() - E) >= np.linalg.norm(found - E)
    (note,) = [note for note in robot.notes if note.code == "inertia.repaired"]
    change = np.linalg.norm(matrix(robot.inertia[0].tolist()) - matrix(inertia))
    assert note.subject == "link 'upper'" and math.isclose(note.value, change / np.linalg.norm(matrix(inertia)))
    robot.check()
    again = Robot.from_urdf(arm(inertia=inertia), on_unphysical="ignore").replace(on_unphysical="repair")
    assert same(again.inertia, robot.inertia, 1e-15) and codes(again) == codes(robot)


def test_a_repair_names_every_link_and_leaves_what_is_physical_to_the_bit():
    plain, repaired = (Robot.from_urdf(tree(), on_unphysical=how) for how in ("error", "repair"))
    assert torch.equal(plain.inertia, repaired.inertia) and plain.notes == repaired.notes
    tool = link("tool", 1.0, FLAT) + fixed("mount", "lower", "tool")
    robot = Robot.from_urdf(also(tool, arm(inertia=FLAT)), on_unphysical="repair")
    assert [x.subject for x in robot.notes if x.code == "inertia.repaired"] == ["link 'upper'", "link 'tool'"]
    assert min(np.linalg.eigvalsh(second(I)).min() for I in robot.inertia.tolist()) > -8 * EPS


def test_a_batch_is_not_repaired():
    robot = Robot.from_urdf(arm())
    with refused(ArgumentError):
        robot.replace(mass=robot.mass * torch.ones(3, 1, dtype=F64), on_unphysical="repair")


def test_robots_from_tables_are_repaired_as_well():
    arguments = [[[0, 0, 1, 0, 0, 0]], [1.0], [[0.1, 0, 0]]]
    with warned(UserWarning):
        Robot.from_screws(*arguments, [FLAT])
    with refused(UnphysicalError):
        Robot.from_screws(*arguments, [WIDE])
    for robot in (
        Robot.from_screws(*arguments, [FLAT], on_unphysical="repair"),
        Robot.from_dh([0.1], [0], [0], [0], *arguments[1:], [matrix(FLAT)], on_unphysical="repair"),
    ):
        assert same(robot.inertia[0], [0.125, 0, 0.125, 0, 0, 0.25])
        assert codes(robot) == {("inertia.repaired", "link 'link1'")}
