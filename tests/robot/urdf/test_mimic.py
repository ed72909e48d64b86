"""Motions of joints of URDF files: those that follow others by <mimic>, and those that are locked.

The map from coordinates to joints is compared with the same robot whose joints are all independent, driven by hand.
"""

import math
import random
import warnings

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one, thinned
from messages import refused, warned
from robots import F64, noted, same, states, torques
from rotations import about, angles, rotation
from urdf_text import LIMIT, also, arm, codes, fixed, joint, link, mimic, position, random_elements, tree, urdf

import torchdq
from torchdq import ArgumentError, DescriptionError, Robot, UnknownNameError


def hand(*mimics):
    """Four fingers that slide on the base, each with a <mimic>, or without."""
    names = ("thumb", "index", "ring", "little")
    joints = (
        joint(name, "base", f"{name}_link", "prismatic", more=LIMIT + more)
        for name, more in zip(names, (*mimics, "", "", "", ""), strict=False)
    )
    return urdf(link("base", None), *(link(f"{name}_link") for name in names), *joints)


FOLLOWING = hand("", mimic("thumb", -2, 0.25), mimic("index", 0.5), mimic("thumb"))


def accompanied(robot):
    """A robot and, on its base, a joint that follows none and that none follows."""
    return also(link("other_link") + joint("other", "base", "other_link", "prismatic"), robot)


BESIDE = accompanied(FOLLOWING)


def locked(robot):
    """What the note on locked joints says."""
    return noted(robot, "lock") == [] or noted(robot, "lock")[0].removeprefix("locked: ")


# --- mimic joints ----------------------------------------------------------------------------------------------------


def test_followers_have_no_coordinates():
    found = Robot.from_urdf(FOLLOWING)
    assert found.joint_names == ("thumb",)
    assert found.joint_map.joint_names == ("index", "little", "ring", "thumb")  # in the order of their names
    assert found.joint_map.S.tolist() == [[-2.0], [1.0], [-1.0], [1.0]]  # ring follows index at a half
    assert found.home.tolist() == [-0.25, 0.0, -0.125, 0.0]
    assert found.link_names == ("index_link", "little_link", "ring_link", "thumb_link") and len(found.mass) == 4
    expected = "joints follow others: index = -2 thumb + 0.25, little = 1 thumb, ring = -1 thumb + 0.125"
    assert noted(found, "joint.follows") == [expected] and not noted(found, "unsimulated.mimic")
    plain = Robot.from_urdf(tree())
    assert plain.joint_map is None and plain.home is None


def test_displacements_are_the_map_of_the_coordinates():
    found, whole = Robot.from_urdf(BESIDE), Robot.from_urdf(BESIDE, mimic="independent")
    assert found.joint_names == ("other", "thumb") and found.joint_map.joint_names == whole.joint_names
    q = torch.tensor([0.3, -0.7], dtype=F64)
    expected = {"thumb": -0.7, "index": -2 * -0.7 + 0.25, "ring": 0.5 * (1.4 + 0.25), "little": -0.7, "other": 0.3}
    assert same(found.joint_map.S @ q - found.home, [expected[name] for name in whole.joint_names])
    assert torch.equal(found.X_PB_home, whole.X_PB_home) and torch.equal(found.screw, whole.screw)


@all_in_one(range(6))
def test_a_random_file_of_followers_is_the_reduced_system(seed):
    """Torques S^T tau and mass matrix S^T M S of the joints at S q - home, whatever computes them."""
    text, rng = urdf(*random_elements(seed, n=7, kinds=("revolute", "prismatic"))), random.Random(seed)
    names = [f"j{i}" for i in range(1, 8)]
    rng.shuffle(names)
    for follower, driver in zip(names[3:], rng.choices(names[:3], k=4), strict=True):
        factor, offset = rng.uniform(-2, 2), rng.choice([0.0, 0.3])
        at = text.index("</joint>", text.index(f'<joint name="{follower}"'))
        text = text[:at] + mimic(driver, factor, offset) + text[at:]
    found, whole = (Robot.from_urdf(text, mimic=x, on_unphysical="ignore") for x in ("coupled", "independent"))
    assert set(found.joint_names) == set(names[:3]) and found.joint_map.joint_names == whole.joint_names
    q, qd, qdd = (x[0] for x in states(3))
    S, home = found.joint_map.S, torch.zeros(7, dtype=F64) if found.home is None else found.home
    tau = torchdq.inverse_dynamics(whole, S @ q - home, S @ qd, S @ qdd, backend="eager")
    assert same(torchdq.inverse_dynamics(found, q, qd, qdd, backend="eager"), S.T @ tau, 1e-12)
    M = torchdq.mass_matrix(whole, S @ q - home, backend="eager")
    assert same(torchdq.mass_matrix(found, q, backend="eager"), S.T @ M @ S, 1e-12)


@all_in_one(thinned(["baxter", "tiago_pro", "panda"], ["tiago_pro", "panda"]))
def test_mass_matrices_of_mimic_robots_are_those_of_pinocchio(name):
    path = oracles.urdf_paths()[name]
    found = Robot.from_urdf(path)
    model = pin.buildModelFromUrdf(str(path), mimic=True)
    theirs_of = {own: x for own, x in zip(model.names, model.joints, strict=True) if x.nv == 1}
    joints = [theirs_of[own] for own in found.joint_names]
    q = torch.linspace(-0.7, 0.7, found.n, dtype=F64)
    z = pin.neutral(model)
    z[[x.idx_q for x in joints]] = q
    theirs, rows = pin.crba(model, model.createData(), z), [x.idx_v for x in joints]
    theirs = (np.triu(theirs) + np.triu(theirs, 1).T)[np.ix_(rows, rows)]
    assert same(torchdq.mass_matrix(found, q, backend="eager"), theirs, 1e-13)


def test_the_order_of_a_chain_of_followers_does_not_matter():
    found = Robot.from_urdf(hand(mimic("index", 2, 1), mimic("ring", 1, 1), ""))
    assert found.joint_names == ("little", "ring")
    rows = dict(zip(found.joint_map.joint_names, found.joint_map.S.tolist(), strict=True))
    assert rows == {"index": [0.0, 1.0], "little": [1.0, 0.0], "ring": [0.0, 1.0], "thumb": [0.0, 2.0]}
    assert found.home.tolist() == [-1.0, 0.0, 0.0, -3.0]
    # a follower may come before its driver in the tree
    found = Robot.from_urdf(arm().replace(LIMIT, LIMIT + mimic("elbow", 0.5), 1))
    assert found.joint_names == ("elbow",) and found.joint_map.S.tolist() == [[0.5], [1.0]]


def test_a_long_chain_of_followers_is_composed():
    n = 1050  # deeper than Python calls
    links = [link("base", None), *(link(f"l{i}") for i in range(n))]
    follow = [mimic(f"j{i + 1}") for i in range(n - 1)] + [""]
    found = Robot.from_urdf(urdf(*links, *(joint(f"j{i}", "base", f"l{i}", more=LIMIT + follow[i]) for i in range(n))))
    assert found.joint_names == (f"j{n - 1}",) and bool((found.joint_map.S == 1).all())


ENDLESS = [
    ([mimic("thumb")], "mimic.circle", "joint 'thumb'"),
    ([mimic("index"), mimic("thumb")], "mimic.circle", "joint 'thumb'"),
    (["", mimic("thumb", "1e40"), mimic("index", "1e40")], "mimic.large", "joint 'ring'"),
    (["", mimic("thumb", "x")], "number.invalid", "joint 'index'"),
    ([mimic("index"), mimic("ring"), mimic("index"), mimic("thumb")], "mimic.circle", "joint 'index'"),
]


@all_in_one(range(len(ENDLESS)))
def test_followers_that_end_nowhere_are_refused_and_bring_no_other_faults(k):
    mimics, *fault = ENDLESS[k]
    with refused(DescriptionError) as caught:
        Robot.from_urdf(hand(*mimics))
    assert [[x.code, x.subject] for x in caught.value.findings] == [fault]
    if fault[0].startswith("mimic"):
        assert Robot.from_urdf(hand(*mimics), mimic="independent").n == 4


@pytest.mark.case("U4")
@all_in_one(['<mimic joint="nobody"/>', "<mimic/>"])
def test_a_follower_of_nobody_is_independent(more):
    text = hand("", more, mimic("index"))
    with warned(UserWarning):
        found = Robot.from_urdf(text)
    assert found.joint_names == ("index", "little", "thumb") and len(found.joint_map.S) == 4
    assert ("mimic.orphan", "joint 'index'") in codes(found, ("warning",))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = Robot.from_urdf(text, mimic="independent")
    assert found.n == 4 and ("unsimulated.mimic", "index, ring") in codes(found)


@all_in_one(["0", "-0.0"])
def test_a_follower_at_no_multiple_or_of_a_fixed_joint_stays_at_its_offset(multiplier):
    found = Robot.from_urdf(hand("", mimic("thumb", multiplier, 0.5), mimic("index", 2)))
    assert found.joint_names == ("little", "thumb") and found.joint_map is None
    assert noted(found, "mimic.stuck") == ["index, ring: it follows nothing that moves: index at 0.5, ring at 1"]
    frame = next(frame for frame in found.frames if frame.name == "ring_link")
    assert frame.link == -1 and same(torchdq.dq.translation(frame.X_BF), [0, 0, 1])
    found = Robot.from_urdf(also(link("plate") + fixed("bolt", "base", "plate"), hand("", mimic("bolt", 1, 0.5))))
    assert ("mimic.stuck", "index") in codes(found) and found.joint_names == ("little", "ring", "thumb")


def limits(lower=-1, upper=2, velocity=3, effort=4):
    return f'<limit lower="{lower}" upper="{upper}" velocity="{velocity}" effort="{effort}"/>'


def pair(driver, follower, factor=1, offset=0):
    follower = joint("follower", "base", "b", more=follower + mimic("driver", factor, offset))
    return urdf(*map(link, "ab"), link("base", None), joint("driver", "base", "a", more=driver), follower)


NARROWED, NO_ROOM = "driver: limits narrowed to those of followers", "follower: limits that leave its driver no room"
FOLLOWERS = [
    (limits(-9, 9, 9, 1), (), [-1, 2, 3], ""),
    (limits(-0.5, 1, 1, 1), (), [-0.5, 1, 1], NARROWED),
    (limits(-0.5, 1, 1, 1), (-2, 0.5), [-0.25, 0.5, 0.5], NARROWED),
    (limits(5, 6, 3, 1), (), [-1, 2, 3], NO_ROOM),
    (limits(0, 0, 0, 0), (), [-1, 2, 3], NO_ROOM),  # as files have them where nothing is meant
    ("", (), [-1, 2, 3], ""),
]


@all_in_one(FOLLOWERS)
def test_limits_of_a_coordinate_keep_its_followers_within_theirs(case):
    follower, how, expected, note = case
    found = Robot.from_urdf(pair(limits(), follower, *how))
    assert [float(x) for x in found.limits] == [*expected, 4]
    named = noted(found, "limits.narrowed") + noted(found, "limits.no_room")
    assert len(named) == bool(note) and all(x.startswith(note) for x in named)


def test_friction_of_followers_is_that_of_the_coordinate():
    dynamics = '<dynamics damping="0.3" friction="0.2"/>'
    found = Robot.from_urdf(pair(LIMIT + dynamics, LIMIT + dynamics, -2))
    # the power dissipated is the same: d qd^2 + d (-2 qd)^2, and f |qd| + f |-2 qd|
    assert same(found.damping, [0.3 * 5]) and same(found.friction, [0.2 * 3])


# --- locked joints ---------------------------------------------------------------------------------------------------


def chain_of_three(elbow):
    links = link("base", None), link("upper", 1.0), link("lower", 0.7), link("hand", 0.3)
    wrist = joint("wrist", "lower", "hand", axis=(1, 0, 0), xyz=(0, 0.1, 0.2))
    return urdf(*links, joint("shoulder", "base", "upper", axis=(0, 1, 0)), elbow, wrist)


@all_in_one([("revolute", 1.0), ("continuous", 2.0), ("prismatic", 1.0), ("prismatic", 2.0)])
def test_a_locked_joint_is_a_fixed_joint_at_that_position(axis):
    kind, length = axis
    p, rpy, value, axis = np.array([0.1, 0.2, 0.3]), (0.4, 0.5, 0.6), 0.7, np.array([2.0, -3.0, 6.0]) / 7.0
    moving = chain_of_three(joint("elbow", "upper", "lower", kind, p, rpy, length * axis))
    R = rotation(rpy)
    at, turn = (p + R @ axis * value, R) if kind == "prismatic" else (p, R @ about(axis, value))
    stiff = Robot.from_urdf(chain_of_three(fixed("elbow", "upper", "lower", at, angles(turn))))
    robot = Robot.from_urdf(moving, lock={"elbow": value})
    assert robot.joint_names == stiff.joint_names == ("shoulder", "wrist") and same(torques(robot), torques(stiff))
    assert same(position(robot, [0.3, 0.4], "hand"), position(stiff, [0.3, 0.4], "hand"))
    assert locked(robot) == "elbow at 0.7"


@all_in_one(["elbow", ["elbow"], ("elb*",), {"elbow"}, {"e*": 0}])
def test_joints_are_locked_by_names_and_patterns_at_zero(lock):
    robot = Robot.from_urdf(arm(), lock=lock)
    assert torch.equal(torques(robot), torques(Robot.from_urdf(arm(), lock={"elbow": 0.0})))
    assert locked(robot) == "elbow at 0"


def test_a_name_to_lock_goes_before_a_pattern():
    assert locked(Robot.from_urdf(tree(), lock={"left_*": 0.5, "left_a": 0.0})).startswith("left_a at 0, left_b at 0.5")
    assert Robot.from_urdf(tree(), lock={"left_?": 0.0}).joint_names == ("waist", "right_a")


@all_in_one([("left_*", 0.0), (["left_a", "left_b"], 0.4), (("*_b", "left_a"), 0.4)])
def test_joints_that_are_not_kept_are_locked_at_zero_or_elsewhere(case):
    joints, waist = case
    robot = Robot.from_urdf(tree(), joints=joints, lock={"waist": waist} if waist else None)
    others = Robot.from_urdf(tree(), lock={"waist": waist, "right_a": 0.0})
    assert robot.joint_names == ("left_a", "left_b") and robot.frame_names == others.frame_names
    assert torch.equal(torques(robot), torques(others)) and locked(robot) == f"waist at {waist:g}, right_a at 0"


ARM, ALONE, BOLTED = arm(), urdf(link("base")), chain_of_three(fixed("elbow", "upper", "lower"))
REFUSED = [
    (ARM, {"lock": {"shoulder": 0.1, "elbow": 0.2}}),
    *(
        (ARM, {"lock": x})
        for x in ("*", {"elbows": 0.0}, {"elbow": -1e300}, True, 5, 0.4, [5], [None], {5: 0.4}, b"elbow")
    ),
    *((ARM, {"lock": {"elbow": x}}) for x in (math.nan, math.inf, 10**400, None, "0.4", True, [0.4])),
    *((ARM, {"joints": x}) for x in ([], (), ["elb"], "arm*", 5, {"elbow": 0.0}, [5])),
    (ARM, {"joints": ["elbow"], "lock": ["elbow"]}),
    (BOLTED, {"lock": {"elbow": 0.0}}),
    *((BESIDE, {"lock": x}) for x in ("index", {"ring": 0.1})),
    (BESIDE, {"joints": "ring"}),
    (BESIDE, {"joints": "index", "lock": {"thumb": 0.5}}),
    (FOLLOWING, {"lock": "thumb"}),
    (hand("", mimic("thumb", "1e40")), {"lock": {"thumb": 1e20}}),
    (hand("", mimic("thumb", 0, 0.5)), {"lock": "index"}),
]


@pytest.mark.filterwarnings("ignore:.*locked beyond")
@all_in_one(range(len(REFUSED)))
def test_what_is_locked_or_kept_is_named(k):
    text, options = REFUSED[k]
    with refused((ArgumentError, UnknownNameError)):
        Robot.from_urdf(text, **options)


def test_a_body_alone_has_no_joints_to_keep_or_to_lock():
    assert Robot.from_urdf(ALONE, joints=[]).n == Robot.from_urdf(ALONE, lock=[]).n == 0


@all_in_one([(2.0, False), (2.0000001, False), (2.1, True), (-400.0, True)])
def test_a_lock_beyond_the_limits_is_warned_of(lock):
    value, beyond = lock
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        robot = Robot.from_urdf(arm(), lock={"elbow": value})
    assert [x.filename for x in seen if "locked beyond its limits: elbow" in str(x.message)] == [__file__] * beyond
    named = [f"locked beyond their limits: elbow at {value:g}, limits [-1, 2]"] * beyond
    assert noted(robot, "lock.beyond_limits") == named


# --- locked followers ------------------------------------------------------------------------------------------------


HALF, APART = {"thumb": 0.5}, {"mimic": "independent"}
BOTH = {"lock": {**HALF, "index": 0.0}}
LOCKED = [  # options, the joint that is left, and what the note says
    ({"lock": HALF}, "other", "thumb at 0.5, index at -0.75, ring at -0.375, little at 0.5"),
    ({"joints": "other"}, "other", "thumb at 0, index at 0.25, ring at 0.125, little at 0"),
    ({"joints": "thumb"}, "thumb", "other at 0"),
    # one that is named itself does not follow
    (BOTH, "other", "thumb at 0.5, index at 0, ring at 0, little at 0.5"),
    (BOTH | APART, "other", "thumb at 0.5, index at 0, ring at 0, little at 0.5"),
    ({"joints": "index", "lock": HALF} | APART, "index", "thumb at 0.5, ring at 0, little at 0.5, other at 0"),
    ({"joints": "thumb"} | APART, "thumb", "index at 0, ring at 0, little at 0, other at 0"),
]


@all_in_one(LOCKED)
def test_the_followers_of_a_locked_joint_are_locked_where_the_file_puts_them(case):
    options, left, named = case
    robot = Robot.from_urdf(BESIDE, **options)
    assert robot.joint_names == (left,) and locked(robot) == named
    assert (robot.joint_map is None) == (left != "thumb" or "mimic" in options)
    for name, at in (x.split(" at ") for x in named.split(", ")):
        assert same(position(robot, [0.0] * robot.n, f"{name}_link")[2], float(at)) or float(at) == 0
    apart = {"thumb": "index, little", "index": "ring"}.get(left, "") if "mimic" in options else ""
    assert (("lock.mimic", apart) in codes(robot)) == bool(apart)


@all_in_one([arguments for text, arguments in REFUSED if text is BESIDE])
def test_independent_followers_are_locked_or_kept_alone(arguments):
    assert Robot.from_urdf(BESIDE, mimic="independent", **arguments).joint_names


@all_in_one([["index", "thumb"], ["thumb"], ["index", "ring", "thumb"]])
def test_joints_that_mimic_each_other_are_locked_once(circle):
    text = accompanied(hand(*(mimic(name, 1, 1) for name in circle)))
    assert Robot.from_urdf(text, lock=["thumb"], mimic="independent").n == 5 - len(circle)
    assert Robot.from_urdf(text, joints="other", mimic="independent").n == 1
