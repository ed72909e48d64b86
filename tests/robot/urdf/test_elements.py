"""Elements of URDF files: numbers, names and the tree that they make; every fault is named at once, and by code."""

import math
import re
import time
import tracemalloc
import warnings
from itertools import product

import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one
from messages import refused, warned
from robots import F64, same, states, torques
from urdf_text import ENTRIES, LIMIT, also, arm, codes, fixed, joint, link, urdf, words

import torchdq
from torchdq import DescriptionError, Robot

ENDLESS = 10.0  # seconds of this thread: what is refused at once takes less than one

# --- numbers ---------------------------------------------------------------------------------------------------------


def faults(text, **options):
    """Codes and subjects of the faults of a file that must be refused."""
    with refused(DescriptionError) as caught:
        Robot.from_urdf(text, **options)
    assert all(str(x) in str(caught.value) for x in caught.value.findings)
    return [(x.code, x.subject) for x in caught.value.findings]


def test_numbers_may_be_written_in_any_way_that_is_a_number_and_separated_by_any_blanks():
    # pinocchio takes the link of '1.5 ' for one without inertia, and says nothing
    for text in ("1.5 ", " 1.5", "\t1.5\n", "+1.5", "1.50", "15e-1", "15E-1", "&#49;.5"):
        assert Robot.from_urdf(arm(mass=text)).mass[0] == 1.5
    for text in ("0.02 -0.03 0.1", "0.02  -0.03\t0.1", "\n0.02\n-0.03 0.1 "):
        assert torch.equal(torques(arm(xyz=text)), torques(arm()))


NOT_NUMBERS = ["", "nan", "NaN", "inf", "-inf", "1e999", "1_0", "0x10", "1,5", "--1", "1e", ".", "1d0", "1 2"]
NOT_NUMBERS += ["\u0967", "\uff11.5"]  # digits of other scripts, which Python would read
NOT_THREE = ["", "0 0", "0 0 0 0", "0,0,1", "0 0 nan", "0 0 z", "0 0 1e999", "0 0 1_0"]
DYNAMICS = LIMIT + "<dynamics {}/>"
WRONG = {  # code of the fault: words of the arm's file, and others in their place
    "number.invalid": [
        *(('mass value="1.0"', f'mass value="{x}"') for x in NOT_NUMBERS),
        *(('xyz="0.02 -0.03 0.1"', f'xyz="{x}"') for x in NOT_THREE),
        *((f'{key}="', f'{key}="nan') for key in (*ENTRIES, "velocity", "effort", "lower", "upper")),
        *((f'{key}="', f'{key}="inf') for key in (*ENTRIES, "lower")),  # "inf2" is no number
        ('0.3" rpy="0.0 0.0 0.0"', '0.3" quat_xyzw="0 0 nan 1"'),
        ('0.3" rpy="0.0 0.0 0.0"', '0.3" quat_xyzw="0 0 inf 1"'),
        ('0.3" rpy="0.0 0.0 0.0"', '0.3" quat_xyzw="0 0 1"'),
        ("<mass value=", "<mass volume="),
        (' ixy="', ' xyi="'),
        ('0.1" rpy="', '0.1" rpy="nan'),
        ('<origin xyz="0.0 0.0 0.3"', '<origin xyz="0 0 nan"'),
        ('0.3" rpy="', '0.3" rpy="nan'),
        ('<axis xyz="0.0 1.0 0.0"', '<axis xyz="0 nan 0"'),
        *((LIMIT, LIMIT + x) for x in ('<mimic multiplier="nan"/>', '<mimic offset="x"/>')),
        *((LIMIT, DYNAMICS.format(f'{key}="x"')) for key in ("damping", "friction")),
    ],
    "number.negative": [(LIMIT, DYNAMICS.format(f'{key}="-3"')) for key in ("damping", "friction")],
    "number.large": [
        ('mass value="1.0"', 'mass value="1e60"'),
        ('ixx="0.04"', 'ixx="1e60"'),
        ('xyz="0.02 -0.03 0.1"', 'xyz="0 0 -1e60"'),
    ],
    "axis.zero": [('xyz="0.0 1.0 0.0"', f'xyz="{x}"') for x in ("0 0 0", "1e-10 0 0", "-0 0 0", "1e-320 0 0")],
    "origin.zero": [('0.3" rpy="0.0 0.0 0.0"', '0.3" quat_xyzw="0 0 0 0"')],
    "origin.twice": [('<origin xyz="0.0 0.0 0.3"', '<origin quat_xyzw="0 0 0 1" xyz="0 0 0.3"')],
}


@pytest.mark.case("U2", "U6", "U7")
@all_in_one(WRONG)
def test_every_number_that_is_read_is_checked(code):
    """Products of numbers must not overflow, and what only resists is not negative."""
    for before, after in WRONG[code]:
        assert before in arm()
        ((found, subject),) = faults(arm().replace(before, after, 1), mimic="independent")
        assert found == code and subject in ("link 'upper'", "joint 'shoulder'")


@pytest.mark.case("U7")
def test_a_limit_may_be_as_large_as_a_number_can_be():
    robot = Robot.from_urdf(arm().replace('upper="2"', 'upper="1.7976931348623157e308"'))
    assert robot.limits.upper[0] == 1.7976931348623157e308


@pytest.mark.case("U8")
@all_in_one([("mass", " "), ("mass", ""), ("xyz", " " * 99), ("xyz", "\n")])
def test_millions_of_numbers_or_digits_are_refused_at_once_and_not_repeated(numbers):
    field, blank = numbers
    text = arm(**{field: ("1" + blank) * (9_000_000 // (1 + len(blank))) + "x"})
    tracemalloc.start()
    begin = time.thread_time()
    assert faults(text) == [("number.invalid", "link 'upper'")]
    seconds, (_, most) = time.thread_time() - begin, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert seconds < ENDLESS and most < 10 * len(text)  # parsing takes half of that, lists of words far more


@pytest.mark.case("U8")
@all_in_one(['"arm"', '"upper"', '"elbow"'])
def test_a_name_is_not_a_book(old):
    assert {code for code, _ in faults(arm().replace(old, '"' + "n" * 50_000 + '"'))} == {"name.long"}


# --- trees -----------------------------------------------------------------------------------------------------------

PARENTLESS = fixed("j", "nobody", "x").replace('<parent link="nobody"/>', "")
PLANAR = fixed("f", "lower", "d_x") + joint("d", "lower", "c", "planar")
MALFORMED = {
    "two links of a name": (link("upper"), "name.twice", "link 'upper'"),
    "two joints of a name": (link("x") + joint("elbow", "lower", "x"), "name.twice", "joint 'elbow'"),
    "two parents": (joint("again", "base", "lower"), "link.carried_twice", "link 'lower'"),
    "two roots": (link("island"), "base", ""),
    "a second tree": (link("m", None) + link("x", None) + fixed("j", "m", "x"), "base", ""),
    "a loop": (link("x") + link("y") + joint("xy", "x", "y") + joint("yx", "y", "x"), "link.loop", ""),
    "an axis that is none": (link("x") + joint("j", "base", "x", axis="up"), "number.invalid", "joint 'j'"),
    "a joint onto itself": (link("x") + joint("self", "x", "x"), "link.loop", ""),
    "no such parent": (link("x") + joint("j", "nobody", "x"), "link.unknown", "joint 'j'"),
    "no such child": (joint("j", "base", "nobody"), "link.unknown", "joint 'j'"),
    "no parent": (PARENTLESS + link("x"), "joint.end", "joint 'j'"),
    "no child": (fixed("j", "base", "x").replace('<child link="x"/>', ""), "joint.end", "joint 'j'"),
    "a link without a name": ("<link/>", "name.missing", "link"),
    "a joint without a name": (link("x") + fixed("", "base", "x"), "name.missing", "joint"),
    "a part of a planar joint": (link("d_x") + link("c") + PLANAR, "name.twice", "joint 'd'"),
    "on what moves": (link("x") + joint("j", "lower", "x", "floating", more=""), "joint.floating", "joint 'j'"),
}
for kind in ("ball", "Revolute", ""):
    MALFORMED[f"type {kind!r}"] = (link("x") + joint("j", "base", "x", kind), "joint.type", "joint 'j'")


@pytest.mark.case("U3", "U5")
@all_in_one(MALFORMED)
def test_a_malformed_file_is_refused_by_name_and_a_fault_brings_no_others(case):
    more, code, subject = MALFORMED[case]
    found = faults(also(more))
    assert found.count((code, subject)) == 1
    # what has no place in the tree is a root as well
    assert {code for code, _ in found} <= {code, "base"} or case == "a part of a planar joint"


@pytest.mark.case("U3")
def test_all_faults_are_named_at_once():
    cases = [case for case in MALFORMED if not case.startswith(("two links", "two joints", "a part"))]
    # every case with names of its own
    more = "".join(
        re.sub(r'"(x|y|j|m|xy|yx|self)"', rf'"\g<1>{i}"', MALFORMED[case][0]) for i, case in enumerate(cases)
    )
    found = faults(also(more, arm(mass="nan", xyz="0 0")))
    assert len(found) >= len(cases) and {MALFORMED[case][1] for case in cases} <= {code for code, _ in found}
    assert [code for code, subject in found if subject == "link 'upper'"] == ["number.invalid"] * 2


@pytest.mark.case("U3")
def test_two_floating_joints_are_refused():
    joints = [joint(x, "world", x[-1], "floating") for x in ("to_a", "to_b")]
    text = urdf(link("world", None), link("a"), link("b"), *joints)
    for base in ("file", "fixed", "floating"):
        assert set(faults(text, base=base)) == {("joint.floating", "joint 'to_a'"), ("joint.floating", "joint 'to_b'")}


NOWHERE = 'lower="inf" upper="inf"', 'lower="-inf" upper="-inf"'
UNUSABLE = {  # words of the limits of a joint: what they are taken for
    'lower="3" upper="2" velocity="3" effort="4"': (-math.inf, math.inf, 3.0, 4.0),
    'lower="1" velocity="3" effort="4"': (-math.inf, math.inf, 3.0, 4.0),  # upper is 0, as the format has it
    'lower="-1" upper="2" velocity="-1e-9" effort="4"': (-1.0, 2.0, math.inf, 4.0),
    'lower="0" upper="-1" velocity="-1" effort="-1"': (-math.inf, math.inf, math.inf, math.inf),
    # infinite ones as well
    **{f'{x} velocity="3" effort="4"': (-math.inf, math.inf, 3.0, 4.0) for x in NOWHERE},
    'lower="-1" upper="2" velocity="3" effort="-inf"': (-1.0, 2.0, 3.0, math.inf),
}


@all_in_one(UNUSABLE)
def test_limits_that_no_motion_can_keep_are_none_and_are_warned_of(given):
    text = arm().replace(LIMIT, f"<limit {given}/>", 1)
    with warned(UserWarning):
        robot = Robot.from_urdf(text)
    assert tuple(x[0].item() for x in robot.limits) == UNUSABLE[given]
    assert ("limits.unusable", "joint 'shoulder'") in codes(robot)
    assert torch.equal(torques(robot), torques(arm()))


NONE = math.inf
ENDLESS_LIMITS = {  # words of the limits of a joint, and what they are
    'lower="-inf" upper="inf" velocity="inf" effort="inf"': (-NONE, NONE, NONE, NONE),
    'lower="-Infinity" upper="+INF" velocity="1e400" effort="Inf"': (-NONE, NONE, NONE, NONE),
    'lower="-1e999" upper="2" velocity="3" effort="4"': (-NONE, 2.0, 3.0, 4.0),
    'lower="-1" upper="infinity" velocity="3" effort="inf"': (-1.0, NONE, 3.0, NONE),
}


@all_in_one([*product(ENDLESS_LIMITS, ["revolute", "prismatic"])])
def test_an_infinite_limit_is_none(case):
    given, kind = case
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = arm().replace(LIMIT, f"<limit {given}/>", 1).replace('type="revolute"', f'type="{kind}"', 1)
        robot = Robot.from_urdf(text)
    assert tuple(x[0].item() for x in robot.limits) == ENDLESS_LIMITS[given]
    if given.startswith('lower="-inf"'):
        missing = Robot.from_urdf(text.replace(f"<limit {given}/>", "", 1))
        assert all(torch.equal(a, b) for a, b in zip(robot.limits, missing.limits, strict=True))
    assert robot.to_urdf(text) == text
    # others are written beside it
    heavier = robot.replace(mass=2 * robot.mass).to_urdf(text)
    assert tuple(x[0].item() for x in Robot.from_urdf(heavier).limits) == ENDLESS_LIMITS[given]


def test_an_infinite_limit_of_a_joint_that_does_not_move_is_nothing():
    limit = '<limit lower="-inf" upper="inf" velocity="inf" effort="inf"/>'
    for kind in ("fixed", "continuous", "floating"):
        extra = link("more") + joint("more_joint", "base", "more", kind, more=limit)
        assert Robot.from_urdf(also(extra), base="fixed").n == 2 + (kind == "continuous")
        assert faults(also(extra.replace("inf", "nan")))[0] == ("number.invalid", "joint 'more_joint'")


def test_inverse_kinematics_takes_limits_on_one_side():
    text = arm().replace('lower="-1" upper="2"', 'lower="-inf" upper="0.5"', 1)
    robot = Robot.from_urdf(text)
    X = torchdq.forward_kinematics(robot, torch.tensor([-5.0, 0.5], dtype=F64), "lower")
    found = torchdq.inverse_kinematics(robot, X, "lower", axes=("x",))
    assert bool(found.converged) and found.q[0] <= 0.5 and bool(found.q.isfinite().all())


# --- origins ---------------------------------------------------------------------------------------------------------

Q = np.random.default_rng(2).normal(size=(3, 4))  # x y z w, of any length


def turned(element, quaternion):
    """An element whose origin is turned by a quaternion."""
    return element.replace('rpy="0.0 0.0 0.0"', f'quat_xyzw="{words(quaternion)}"')


PLACED = urdf(
    link("base", None),
    turned(link("upper"), Q[0]),
    turned(link("lower", 0.5), 1e-3 * Q[1]),
    turned(joint("shoulder", "base", "upper", axis=(0, 1, 0), xyz=(0, 0, 0.3)), 1e3 * Q[2]),
    turned(fixed("mount", "upper", "lower", (0.1, 0, 0.4)), Q[0]),
).replace("<robot", '<robot version="1.1"')


def test_origins_turned_by_quaternions_are_those_of_pinocchio():
    """x y z w of any length, of joints and of bodies; and written back, with another inertia, they stay."""
    robot, model = Robot.from_urdf(PLACED), pin.buildModelFromXML(PLACED)
    for q, qd, qdd in zip(*states(1), strict=True):
        theirs = pin.rnea(model, model.createData(), *(x.numpy() for x in (q, qd, qdd)))
        assert same(torchdq.inverse_dynamics(robot, q, qd, qdd), theirs)
    other = robot.replace(inertia=1.25 * robot.inertia)
    text = other.to_urdf(PLACED)
    assert text.count("quat_xyzw") == 4 and "rpy" not in text
    assert same(torques(Robot.from_urdf(text)), torques(other), 1e-13)


def test_shapes_are_placed_by_quaternions():
    rod = '<collision><origin xyz="1 0 0" {}/><geometry><capsule radius="0.1" length="2"/></geometry></collision>'
    for turn in ('quat_xyzw="0 3 0 3"', f'rpy="0 {math.pi / 2} 0"'):
        text = also(link("rod", more=rod.format(turn)) + fixed("f", "lower", "rod"))
        assert [x.center for x in Robot.from_urdf(text).contact_points("rod")] == [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0)]


@all_in_one(["quat", "quat_wxyz", "quat_xyz"])
def test_a_quaternion_in_other_words_is_warned_of(word):
    with warned(UserWarning):
        Robot.from_urdf(PLACED.replace("quat_xyzw", word))


@pytest.mark.case("U3", "U8")
def test_a_file_without_one_base_is_refused():
    loop = urdf(link("a"), link("b"), joint("ab", "a", "b"), joint("ba", "b", "a"))
    thousand = urdf(*(link(f"l{i}", None) for i in range(1000)))
    for text in (loop, urdf(), urdf(link("a", None), link("b", None)), thousand):
        assert ("base", "") in faults(text)


def test_links_without_bodies_that_hang_on_nothing_are_left_out():
    robot = Robot.from_urdf(also(link("map", None) + link("odom", 0.0, (0,) * 6)))
    assert ("frame.left_out", "map, odom") in codes(robot)
    assert robot.frame_names == ("base", "upper", "lower") and torch.equal(torques(robot), torques(arm()))


@all_in_one([{"mass": "x"}, {"inertia": ("nan", 0, 0, 0, 0, 0)}, {"xyz": "a b c"}])
def test_an_inertial_of_a_link_that_never_moves_may_be_unreadable(broken):
    text = arm().replace(link("base", None), link("base", **broken) + link("stand", **broken))
    text = also(fixed("bolt", "base", "stand"), text)
    robot = Robot.from_urdf(text)
    assert ("inertial.unreadable", "base, stand") in codes(robot)
    assert torch.equal(torques(robot), torques(arm()))
    assert {subject for _, subject in faults(text, base="floating")} == {"link 'base'", "link 'stand'"}
    assert faults(also(link("tool", **broken) + fixed("mount", "lower", "tool")))[0][1] == "link 'tool'"
