"""Elements of URDF files: numbers, names and the tree that they make; every fault is named at once, and by code."""

import re
import time
import tracemalloc

import pytest
import torch
from urdf_text import ENTRIES, LIMIT, also, arm, fixed, joint, link, torques, urdf

from torchdq import DescriptionError, Robot

ENDLESS = 10.0  # seconds of this thread: what is refused at once takes less than one

# --- numbers ---------------------------------------------------------------------------------------------------------


def faults(text, **options):
    """Faults of a file that must be refused."""
    with pytest.raises(DescriptionError) as caught:
        Robot.from_urdf(text, **options)
    assert all(str(x) in str(caught.value) for x in caught.value.findings)
    return caught.value.findings


def fault(text, **options):
    """Code, subject and text of the only fault of a file."""
    (found,) = faults(text, **options)
    return found.code, found.subject, str(found)


@pytest.mark.parametrize("text", ["1.5 ", " 1.5", "\t1.5\n", "+1.5", "1.50", "15e-1", "15E-1", "&#49;.5"])
def test_a_number_may_be_written_in_any_way_that_is_a_number(text):
    # pinocchio takes the link of '1.5 ' for one without inertia, and says nothing
    assert Robot.from_urdf(arm(mass=text)).mass[0] == 1.5


@pytest.mark.parametrize("text", ["0.02 -0.03 0.1", "0.02  -0.03\t0.1", "\n0.02\n-0.03 0.1 "])
def test_numbers_may_be_separated_by_any_blanks(text):
    assert torch.equal(torques(arm(xyz=text)), torques(arm()))


NOT_NUMBERS = ["", "nan", "NaN", "inf", "-inf", "1e999", "1_0", "0x10", "1,5", "--1", "1e", ".", "1d0", "1 2"]
NOT_NUMBERS += ["\u0967", "\uff11.5"]  # digits of other scripts, which Python would read


@pytest.mark.case("U2")
@pytest.mark.parametrize("text", NOT_NUMBERS)
def test_what_is_not_a_finite_number_is_refused(text):
    expected = f"link 'upper': mass value must be a finite number, found {text!r}"
    assert fault(arm(mass=text)) == ("number.invalid", "link 'upper'", expected)


@pytest.mark.case("U2")
@pytest.mark.parametrize("text", ["", "0 0", "0 0 0 0", "0,0,1", "0 0 nan", "0 0 z", "0 0 1e999", "0 0 1_0"])
def test_what_is_not_three_finite_numbers_is_refused(text):
    expected = f"link 'upper': inertial origin xyz must be 3 finite numbers, found {text!r}"
    assert fault(arm(xyz=text)) == ("number.invalid", "link 'upper'", expected)


def test_an_attribute_that_is_absent_is_told_from_an_empty_one():
    expected = "link 'upper': mass value must be a finite number, found none, but 'val'"
    assert fault(arm().replace("<mass value", "<mass val", 1))[2] == expected


DYNAMICS = LIMIT + "<dynamics {}/>"


@pytest.mark.case("U2")
@pytest.mark.parametrize(
    "before, after, code, named",
    [
        ('mass value="1.0"', 'mass value="nan"', "invalid", "link 'upper': mass value"),
        ("<mass value=", "<mass volume=", "invalid", "link 'upper': mass value"),
        *((f'{key}="', f'{key}="nan', "invalid", f"link 'upper': inertia {key}") for key in ENTRIES),
        (' ixy="', ' xyi="', "invalid", "link 'upper': inertia ixy"),
        (
            '<inertial><origin xyz="0.02 -0.03 0.1" rpy="',
            '<inertial><origin rpy="nan',
            "invalid",
            "inertial origin rpy",
        ),
        ('<origin xyz="0.0 0.0 0.3"', '<origin xyz="0 0 nan"', "invalid", "joint 'shoulder': origin xyz"),
        ('0.3" rpy="', '0.3" rpy="nan', "invalid", "joint 'shoulder': origin rpy"),
        ('<axis xyz="0.0 1.0 0.0"', '<axis xyz="0 nan 0"', "invalid", "joint 'shoulder': axis xyz"),
        ('lower="-1"', 'lower="nan"', "invalid", "joint 'shoulder': limit lower"),
        ('upper="2"', 'upper="inf"', "invalid", "joint 'shoulder': limit upper"),
        ('velocity="3"', 'velocity=""', "invalid", "joint 'shoulder': limit velocity"),
        ('effort="4"', 'effort="4N"', "invalid", "joint 'shoulder': limit effort"),
        (LIMIT, DYNAMICS.format('damping="x"'), "invalid", "joint 'shoulder': dynamics damping"),
        (LIMIT, DYNAMICS.format('friction="x"'), "invalid", "joint 'shoulder': dynamics friction"),
        (LIMIT, LIMIT + '<mimic multiplier="nan"/>', "invalid", "joint 'shoulder': mimic multiplier"),
        (LIMIT, LIMIT + '<mimic offset="x"/>', "invalid", "joint 'shoulder': mimic offset"),
        ('effort="4"', 'effort="-4"', "negative", "joint 'shoulder': limit effort"),
        ('velocity="3"', 'velocity="-1e-9"', "negative", "joint 'shoulder': limit velocity"),
        (LIMIT, DYNAMICS.format('damping="-3"'), "negative", "joint 'shoulder': dynamics damping"),
        (LIMIT, DYNAMICS.format('friction="-3"'), "negative", "joint 'shoulder': dynamics friction"),
        ('mass value="1.0"', 'mass value="1e60"', "large", "link 'upper': mass value"),
        ('ixx="0.04"', 'ixx="1e60"', "large", "link 'upper': inertia ixx"),
        ('xyz="0.02 -0.03 0.1"', 'xyz="0 0 -1e60"', "large", "link 'upper': inertial origin xyz"),
    ],
)
def test_every_number_that_is_read_is_checked(before, after, code, named):
    """Products of numbers must not overflow, and what only resists is not negative."""
    assert before in arm()
    assert (found := fault(arm().replace(before, after, 1)))[0] == f"number.{code}" and named in found[2]


@pytest.mark.case("U6", "U7")
@pytest.mark.parametrize(
    "before, after, code",
    [
        *(('xyz="0.0 1.0 0.0"', f'xyz="{x}"', "axis.zero") for x in ("0 0 0", "1e-10 0 0", "-0 0 0", "1e-320 0 0")),
        ('upper="2"', 'upper="-2"', "limits.reversed"),
        ('<origin xyz="0.0 0.0 0.3"', '<origin quat_xyzw="0 0 0 1" xyz="0 0 0.3"', "origin.quaternion"),
    ],
)
def test_axes_limits_and_placements_make_sense(before, after, code):
    assert fault(arm().replace(before, after, 1))[:2] == (code, "joint 'shoulder'")


@pytest.mark.case("U7")
def test_a_limit_may_be_as_large_as_a_number_can_be():
    robot = Robot.from_urdf(arm().replace('upper="2"', 'upper="1.7976931348623157e308"'))
    assert robot.limits.upper[0] == 1.7976931348623157e308


@pytest.mark.case("U8")
@pytest.mark.parametrize("field, part", [("mass", "mass value"), ("xyz", "origin xyz")])
@pytest.mark.parametrize("blank", [" ", " " * 99, "\n", ""])
def test_millions_of_numbers_or_digits_are_refused_at_once_and_not_repeated(field, part, blank):
    text = arm(**{field: ("1" + blank) * (9_000_000 // (1 + len(blank))) + "x"})
    tracemalloc.start()
    begin = time.thread_time()
    message = fault(text)[2]
    seconds, (_, most) = time.thread_time() - begin, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert seconds < ENDLESS and f"{part} must be" in message and len(message) < 500
    assert most < 10 * len(text)  # parsing takes half of that, lists of words far more


@pytest.mark.case("U8")
@pytest.mark.parametrize("old", ['"arm"', '"upper"', '"elbow"'])
def test_a_name_is_not_a_book(old):
    found = faults(arm().replace(old, '"' + "n" * 50_000 + '"'))
    assert {x.code for x in found} == {"name.long"} and sum(len(str(x)) for x in found) < 5_000
    assert "name must have at most 1000 characters, found 50000: 'nnn" in str(found[0])


# --- trees -----------------------------------------------------------------------------------------------------------

MALFORMED = {
    "two links of a name": (link("upper"), "name.twice", "link 'upper'", "described twice"),
    "two joints of a name": (link("x") + joint("elbow", "lower", "x"), "name.twice", "joint 'elbow'", ""),
    "two parents": (joint("again", "base", "lower"), "link.carried_twice", "link 'lower'", "'elbow' and 'again'"),
    "two roots": (link("island"), "base", "", "carried by no joint, found 2: ['base', 'island']"),
    "a second tree": (link("m", None) + link("x", None) + fixed("j", "m", "x"), "base", "", "found 2: ['base', 'm']"),
    "a loop": (
        link("x") + link("y") + joint("xy", "x", "y") + joint("yx", "y", "x"),
        "link.loop",
        "",
        "links ['x', 'y'] hang in a loop",
    ),
    "an axis that is none": (link("x") + joint("j", "base", "x", axis="up"), "number.invalid", "joint 'j'", "'up'"),
    "a joint onto itself": (link("x") + joint("self", "x", "x"), "link.loop", "", "links ['x'] hang in a loop"),
    "no such parent": (link("x") + joint("j", "nobody", "x"), "link.unknown", "joint 'j'", "no link 'nobody'"),
    "no such child": (joint("j", "base", "nobody"), "link.unknown", "joint 'j'", "there is no link 'nobody'"),
    "no parent": (
        '<joint name="j" type="fixed"><child link="x"/></joint>' + link("x"),
        "joint.end",
        "joint 'j'",
        "no parent",
    ),
    "no child": ('<joint name="j" type="fixed"><parent link="base"/></joint>', "joint.end", "joint 'j'", "no child"),
    "a link without a name": ("<link/>", "name.missing", "link", ""),
    "a joint without a name": (link("x") + fixed("", "base", "x"), "name.missing", "joint", ""),
    "a part of a planar joint": (
        link("d_x") + link("c") + fixed("f", "lower", "d_x") + joint("d", "lower", "c", "planar"),
        "name.twice",
        "joint 'd'",
        "its parts are named d_x, d_y, d_angle, but the file has ['d_x']",
    ),
    **{
        f"a joint of type {kind!r}": (link("x") + joint("j", "base", "x", kind), "joint.type", "joint 'j'", f"{kind!r}")
        for kind in ("floating", "ball", "Revolute", "")
    },
}


@pytest.mark.case("U3", "U5")
@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_file_is_refused_by_name_and_a_fault_brings_no_others(case):
    more, code, subject, words = MALFORMED[case]
    found = faults(also(more))
    named = [x for x in found if (x.code, x.subject) == (code, subject)]
    assert len(named) == 1 and words in str(named[0])
    # what has no place in the tree is a root as well
    assert {x.code for x in found} <= {code, "base"} or case == "a part of a planar joint"


@pytest.mark.case("U3")
def test_all_faults_are_named_at_once():
    cases = [case for case in MALFORMED if not case.startswith(("two links", "two joints", "a part"))]
    # every case with names of its own
    more = "".join(
        re.sub(r'"(x|y|j|m|xy|yx|self)"', rf'"\g<1>{i}"', MALFORMED[case][0]) for i, case in enumerate(cases)
    )
    found = faults(also(more, arm(mass="nan", xyz="0 0")))
    assert len(found) >= len(cases) and {MALFORMED[case][1] for case in cases} <= {x.code for x in found}
    assert [str(x) for x in found if x.subject == "link 'upper'"] == [
        "link 'upper': inertial origin xyz must be 3 finite numbers, found '0 0'",
        "link 'upper': mass value must be a finite number, found 'nan'",
    ]


@pytest.mark.case("U3", "U8")
@pytest.mark.parametrize(
    "text, expected",
    [
        (urdf(link("a"), link("b"), joint("ab", "a", "b"), joint("ba", "b", "a")), "found 0: []"),
        (urdf(), "the robot has no links"),
        (urdf(link("a", None), link("b", None)), "found 2: ['a', 'b']"),
        (urdf(*(link(f"l{i}", None) for i in range(1000))), "found 1000: ['l0', 'l1'"),
    ],
)
def test_a_file_without_one_base_is_refused(text, expected):
    (found,) = (x for x in faults(text) if x.code == "base")
    assert expected in str(found) and len(str(found)) < 500


def test_a_floating_joint_is_refused_with_the_way_to_have_one():
    text = urdf(link("world", None), link("pelvis"), joint("free", "world", "pelvis", "floating"))
    assert "found 'floating'; leave it out and pass base='floating'" in fault(text)[2]


def test_links_without_bodies_that_hang_on_nothing_are_left_out():
    robot = Robot.from_urdf(also(link("map", None) + link("odom", 0.0, (0,) * 6)))
    assert ("frame.left_out", "map, odom") in {(x.code, x.subject) for x in robot.notes}
    assert robot.frame_names == ("base", "upper", "lower") and torch.equal(torques(robot), torques(arm()))


@pytest.mark.parametrize("broken", [{"mass": "x"}, {"inertia": ("nan", 0, 0, 0, 0, 0)}, {"xyz": "a b c"}], ids=repr)
def test_an_inertial_of_a_link_that_never_moves_may_be_unreadable(broken):
    text = arm().replace(link("base", None), link("base", **broken) + link("stand", **broken))
    text = also(fixed("bolt", "base", "stand"), text)
    robot = Robot.from_urdf(text)
    assert ("inertial.unreadable", "base, stand") in {(x.code, x.subject) for x in robot.notes}
    assert torch.equal(torques(robot), torques(arm()))
    assert {x.subject for x in faults(text, base="floating")} == {"link 'base'", "link 'stand'"}
    assert fault(also(link("tool", **broken) + fixed("mount", "lower", "tool")))[1] == "link 'tool'"
