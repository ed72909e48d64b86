"""Files that other readers open are opened, and notes say what was wrong; what gives wrong numbers raises."""

import math
import warnings

import numpy as np
import oracles
import pytest
import torch
from robot.urdf.test_read import (
    LIMIT,
    ORDINARY,
    arm,
    fixed,
    joint,
    link,
    position,
    refusal,
    same,
    states,
    tensor,
    torques,
    tree,
    urdf,
)

import torchdq
from torchdq import ArgumentError, Robot, UnphysicalError
from torchdq.robot.arrays import matrices, second_moments

F64 = torch.float64
SLIP = pytest.mark.filterwarnings("ignore:.*may change the dynamics")


def also(more, text=None):
    """An arm with more elements at the end of its file."""
    return (text or arm()).replace("</robot>", more + "</robot>")


def noted(text, *notes, **options):
    """Robot of a text whose notes hold these, and otherwise only those of every arm."""
    robot = Robot.from_urdf(text, **options)
    ordinary = ("limits given", "no tip chosen", "1 fixed joints", "2 fixed joints", "locked", "links without mass")
    assert [note for note in map(str, robot.notes) if not note.startswith(ordinary)] == [*notes]
    return robot


def as_arm(robot):
    return torch.equal(torques(robot), torques(Robot.from_urdf(arm())))


# --- XML -------------------------------------------------------------------------------------------------------------


def test_undeclared_prefixes_are_told():
    text = also('<drake:x gz:y="1"/>').replace("<robot", '<robot xmlns:gz="http://gz" xml:lang="en"')
    assert as_arm(noted(text, "XML prefixes that are not declared: drake"))


def test_tags_that_may_be_misspelt_are_told():
    text = also("<Joint/><mesh/>").replace("<axis", "<orign/><axis", 1)
    misspelt = "tags that seem misspelt, not read: <Joint> in <robot> (is <joint> meant?)"
    with pytest.warns(UserWarning, match="not used and may change the dynamics") as seen:
        robot = noted(text, misspelt, "tags that are not of URDF, not read: mesh, orign")  # there is an origin as well
    assert as_arm(robot) and len(seen) == 1 and misspelt in str(seen[0].message) and "mesh" not in str(seen[0].message)


SLIPS = {
    "multiplyer": ("<mimic multiplyer='2' joint='{}'/>", "multiplyer of <mimic> in joint '{}' (is multiplier meant?)"),
    "factor": ("<mimic factor='2' joint='{}'/>", "factor of <mimic> in joint '{}' (is multiplier meant?)"),
    "Damping": ("<dynamics Damping='2'/>", "Damping of <dynamics> in joint '{}' (is damping meant?)"),
    "stiffness": ("<dynamics stiffness='2'/>", "stiffness of <dynamics> in joint '{}'"),
    "angles": ("<origin xyz='0 0 0' rotation='0 0 1'/>", "rotation of <origin> in joint '{}' (is rpy meant?)"),
}


@SLIP
@pytest.mark.parametrize("slip", SLIPS)
def test_an_attribute_that_may_be_misspelt_is_told(slip):
    text, told = SLIPS[slip]
    wheel = joint("wheel", "lower", "x", "continuous", more=text.format("gone"))
    if slip == "angles":
        wheel = wheel.replace('<origin xyz="0.0 0.0 0.0" rpy="0.0 0.0 0.0"/>', "")
    notes = Robot.from_urdf(also(link("x") + wheel)).notes
    assert "attributes that are not of URDF, not read: " + told.format("wheel") in notes


@SLIP
def test_limits_that_are_misspelt_are_told_and_so_is_what_is_taken_instead():
    wrong = '<limit low="-1" max="2" velocity="3" effort="4"/>'
    robot = Robot.from_urdf(also(link("x") + joint("j", "lower", "x", more=wrong)))
    assert float(robot.limits.upper[2]) == 0.0
    words = "low of <limit> in joint 'j' (is lower meant?), max of <limit> in joint 'j' (is upper meant?)"
    assert f"attributes that are not of URDF, not read: {words}" in robot.notes
    assert "limits left out of <limit>, taken as 0, as the format has it: j (lower and upper)" in robot.notes
    one = Robot.from_urdf(also(link("x") + joint("j", "lower", "x", more='<limit upper="2"/>'))).notes
    assert "limits left out of <limit>, taken as 0, as the format has it: j (lower)" in one


@pytest.mark.parametrize(
    "text",
    [
        LIMIT.replace("<limit", "<limit acceleration='3' soft:lower='1'"),
        "<dynamics damping='0' friction='0' spring_stiffness='1'/>",
        "<mimic joint='shoulder' multiplier='1' offset='0' of='x'/>",
    ],
)
def test_attributes_beside_all_of_urdf_are_extensions_and_silent(text):
    notes = Robot.from_urdf(also(link("x") + joint("j", "lower", "x", more=text))).notes
    assert [note for note in notes if note.startswith("attributes")] == []


@SLIP
def test_elements_that_are_given_twice_are_told():
    double = {
        "link": link("x", 1.0).replace("<inertial>", "<inertial><mass value='7'/></inertial><inertial>"),
        "joint": joint("j", "lower", "x", more=LIMIT + LIMIT.replace("2", "9") + '<axis xyz="1 0 0"/>'),
    }
    robot = Robot.from_urdf(also("".join(double.values())))
    assert float(robot.mass[2]) == 7.0 and float(robot.limits.upper[2]) == 2.0 and same(robot.screw[2, :3], [0, 0, 1])
    words = "2 <axis> in joint 'j', 2 <inertial> in link 'x', 2 <limit> in joint 'j'"
    assert f"elements given more than once, of which the first is read: {words}" in robot.notes


@SLIP
def test_tags_in_the_wrong_place_are_told():
    body = link("x", 1.0)
    text = also(body.replace("<inertial>", "").replace("</inertial>", "") + fixed("f", "lower", "x") + LIMIT)
    words = "<inertia> in link 'x', <limit> in <robot>, <mass> in link 'x', <origin> in link 'x'"
    assert as_arm(noted(text, f"tags in the wrong place, not read: {words}"))


@SLIP
def test_attributes_of_joints_that_belong_to_their_elements_are_told():
    text = arm().replace('<joint name="elbow"', '<joint name="elbow" damping="1" dont_collapse="1"')
    assert as_arm(noted(text, "attributes that are not of URDF, not read: damping in joint 'elbow'"))


@pytest.mark.parametrize("zero", ["effort", "velocity", "lower and upper"])
def test_limits_of_zero_are_told(zero):
    limits = {"lower": -1, "upper": 2, "effort": 3, "velocity": 4} | dict.fromkeys(zero.split(" and "), 0)
    more = "<limit " + " ".join(f'{key}="{x}"' for key, x in limits.items()) + "/>"
    noted(also(link("x") + joint("j", "lower", "x", more=more)), "limits of zero, which leave no room: j")


def test_an_attribute_that_is_absent_is_told_from_an_empty_one():
    assert "link 'upper': mass value must be a finite number, found none beside 'val'" in refusal(
        arm().replace("<mass value", "<mass val", 1)
    )
    assert "mass value must be a finite number, found ''" in refusal(arm(mass=""))


def test_tags_of_inertials_that_may_be_misspelt_are_told():
    text = arm().replace("<mass ", "<Mass value='1'/><mass ", 1)
    assert as_arm(noted(text, "tags that are not of URDF, not read: Mass"))


@pytest.mark.parametrize(
    "more",
    [
        "<transmission><joint name='x'><hardwareInterface/></joint><actuator/></transmission>",
        "<gazebo reference='x'><link><inertial><mass value='x'/></inertial></link></gazebo>",
        "<ros2_control><joint name='elbow'/></ros2_control>",
        "<material name='m'/>",
    ],
)
def test_what_others_read_is_nothing_to_tell(more):
    assert as_arm(noted(also(more)))


def test_a_link_of_meshes_alone_has_no_mass():
    mesh = "<visual><geometry><mesh filename='x.stl'/></geometry></visual>"
    text = also(f'<link name="cover">{mesh}<mesh/></link>' + fixed("glue", "lower", "cover"))
    assert as_arm(noted(text, "tags that are not of URDF, not read: mesh"))


# --- inertials -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("inertial", ["<inertial/>", '<inertial><origin xyz="1 2 3"/><inertia ixx="1"/></inertial>'])
def test_an_inertial_without_mass_is_none(inertial):
    text = also(f'<link name="tool">{inertial}</link>' + fixed("mount", "lower", "tool"))
    assert as_arm(noted(text, "links whose <inertial> gives no <mass>, taken as massless: tool"))


def test_an_inertia_without_numbers_is_that_of_a_point():
    text = arm()[: arm().index("<inertia ")] + "<inertia/>" + arm()[arm().index("</inertial>") :]
    note = "links with mass but without <inertia>, taken as points at their centres of mass: upper"
    assert torch.equal(torques(noted(text, note)), torques(Robot.from_urdf(arm(inertia=(0,) * 6))))


@pytest.mark.parametrize("broken", ["mass", "inertia", "origin"])
def test_an_inertial_of_a_link_that_never_moves_may_be_unreadable(broken):
    bad = {"mass": {"mass": "x"}, "inertia": {"inertia": ("nan", 0, 0, 0, 0, 0)}, "origin": {"xyz": "a b c"}}[broken]
    text = arm().replace(link("base", None), link("base", **bad) + link("stand", **bad))
    text = also(fixed("bolt", "base", "stand"), text)
    assert as_arm(noted(text, "<inertial> cannot be read in links that never move: base, stand"))
    message = refusal(text, base="floating")
    assert "link 'base': " in message and "link 'stand': " in message
    assert "link 'tool': " in refusal(also(link("tool", **bad) + fixed("mount", "lower", "tool")))


def test_leftover_inertia_of_a_massless_link_counts_and_is_told():
    text = also(link("tool", 0.0, ORDINARY, (0, 0, 0)) + fixed("mount", "lower", "tool"))
    robot = Robot.from_urdf(text)
    assert (
        robot.notes[0]
        .text()
        .startswith("link 'tool': it has no mass, so its inertia must be zero, found principal moments")
    )
    assert same(robot.inertia[1], 2 * np.array(ORDINARY))  # as other readers have it


@pytest.mark.parametrize("size, told", [(0.9e-7, True), (1.1e-7, False)])
def test_inertia_of_too_small_a_radius_of_gyration_is_in_the_report(size, told):
    text = urdf(link("base", None), link("bead", 1.0, (size**2, 0, size**2, 0, 0, size**2)), joint("j", "base", "bead"))
    robot = Robot.from_urdf(text, on_unphysical="ignore")
    assert ("inertia that is rounding taken as zero: bead" in str(robot.report())) == told
    assert bool((robot.inertia == 0).all()) == told


@pytest.mark.parametrize("mass", [1.0, 0.0])
@pytest.mark.parametrize("tiny", [(0, 0, -2e-35, 0, 0, 0), (0, 2e-35, 0, 0, 0, 1e-35)])
def test_inertia_that_is_rounding_is_zero(mass, tiny):
    text = also(link("tool", mass, tiny) + fixed("mount", "lower", "tool"))
    robot = noted(text, "inertia that is rounding taken as zero: tool")
    assert torch.equal(torques(robot), torques(Robot.from_urdf(text.replace("2e-35", "0").replace("1e-35", "0"))))


def test_the_inertia_of_dust_is_no_rounding():
    text = also(link("tool", 1e-18, np.array(ORDINARY) * 1e-30) + fixed("mount", "lower", "tool"))
    noted(text)
    assert "positive definite" in refusal(text.replace('ixx="', 'ixx="-'), UnphysicalError)


# --- trees and joints ------------------------------------------------------------------------------------------------


def test_links_without_bodies_that_hang_on_nothing_are_left_out():
    note = "links that nothing carries and that have neither bodies nor joints, left out: map, odom"
    robot = noted(also(link("map", None) + link("odom", 0.0, (0,) * 6)), note)
    assert as_arm(robot) and robot.frame_names == ("base", "upper", "lower")


@pytest.mark.parametrize("more", [link("map"), link("map", None) + link("x", None) + fixed("j", "map", "x")])
def test_a_second_base_with_a_body_or_a_joint_is_refused(more):
    assert "exactly one link must be the base, carried by no joint; found 2: ['base', 'map']" in refusal(also(more))


def test_several_frames_and_nothing_else_are_refused():
    assert "exactly one link must be the base" in refusal(urdf(link("a", None), link("b", None)))


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_joint_without_limits_is_unlimited(kind):
    text = also(link("x") + joint("j", "lower", "x", kind, more=""))
    robot = noted(text, "revolute and prismatic joints without <limit>, taken as unlimited: j")
    assert robot.limits.lower[2] == -math.inf and robot.limits.effort[2] == math.inf


def test_a_planar_joint_is_two_slides_and_a_turn():
    axis = np.array([2.0, -3.0, 6.0]) / 7.0
    text = also(link("cart") + joint("drive", "lower", "cart", "planar", (1, 2, 3), (0.1, 0.2, 0.3), axis=2 * axis))
    robot = noted(
        text,
        "planar joints taken as two slides, x and y, and a turn: drive",
        "axes scaled to unit length: " + ("drive_x, drive_y, drive_angle"),
    )
    assert robot.joint_names[2:] == ("drive_x", "drive_y", "drive_angle")
    assert robot.kinds[2:] == ("prismatic", "prismatic", "revolute")
    assert robot.link_names[2:] == ("drive_x", "drive_y", "cart")
    x, y, z = robot.screw[2, 3:], robot.screw[3, 3:], robot.screw[4, :3]
    frame = torch.stack([x, y, z], -1)
    assert same(frame.T @ frame, torch.eye(3)) and float(torch.linalg.det(frame)) > 0 and same(z, axis)
    assert bool(robot.limits.upper[2:].isinf().all())


@pytest.mark.parametrize("axis, x, y", [((0, 0, 1), (1, 0, 0), (0, 1, 0)), ((0, 0, -1), (1, 0, 0), (0, -1, 0))])
def test_a_planar_joint_about_z_slides_along_x_and_y(axis, x, y):
    robot = Robot.from_urdf(urdf(link("base", None), link("cart"), joint("d", "base", "cart", "planar", axis=axis)))
    assert same(robot.screw[:2, 3:], [x, y])
    at = position(robot, [0.3, -0.4, 0.7], "cart")
    assert same(at, 0.3 * np.array(x) - 0.4 * np.array(y))


def test_parts_of_a_planar_joint_have_names_of_their_own():
    text = also(
        link("drive_x") + link("cart") + fixed("f", "lower", "drive_x") + joint("drive", "lower", "cart", "planar")
    )
    assert "joint 'drive': its parts are named drive_x, drive_y, drive_angle, but the file has ['drive_x']" in refusal(
        text
    )


def test_a_floating_joint_is_refused_with_the_way_to_have_one():
    text = urdf(link("world", None), link("pelvis"), joint("free", "world", "pelvis", "floating"))
    assert "found 'floating'; leave it out and pass base='floating'" in refusal(text)


# --- repair ----------------------------------------------------------------------------------------------------------

BROKEN = {
    "triangle": (0.1, 0, 0.1, 0, 0, 0.25),
    "negative moment": (0.1, 0, 0.2, 0, 0, -0.05),
    "large product": (0.1, 0.3, 0.1, 0, 0, 0.1),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_repaired_inertia_is_the_nearest_that_a_body_has(case):
    robot = Robot.from_urdf(arm(inertia=BROKEN[case]), on_unphysical="repair")
    E = second_moments(torch.tensor(BROKEN[case], dtype=F64))
    found = second_moments(robot.inertia[0])
    values, axes = np.linalg.eigh(E.numpy())
    assert values[0] < 0 and same(found, axes @ np.diag(values.clip(min=0)) @ axes.T, 1e-12)
    # no second moments nearby are nearer: the distance only grows in random directions that keep them positive
    g = torch.Generator().manual_seed(0)
    for _ in range(200):
        A = torch.randn(3, 3, generator=g, dtype=F64)
        other = 0.9 * found + 0.1 * A @ A.T * float(torch.rand((), generator=g))
        assert float((other - E).norm()) >= float((found - E).norm())
    (note,) = [note for note in map(str, robot.notes) if "repaired" in note]
    assert note.startswith("link 'upper': inertia repaired by ") and " %, principal moments " in note
    robot.check()


def test_a_repair_says_by_how_much():
    notes = Robot.from_urdf(arm(inertia=BROKEN["triangle"]), on_unphysical="repair").notes
    # E = diag(0.125, 0.125, -0.025) without the last: I = diag(0.125, 0.125, 0.25)
    part = 100 * math.sqrt(2 * 0.025**2) / math.sqrt(2 * 0.1**2 + 0.25**2)
    repaired = notes[0]
    assert (repaired.code, repaired.subject) == ("inertia.repaired", "link 'upper'")
    assert abs(100 * repaired.value - part) <= 1e-12 and "0.1, 0.1, 0.25 to 0.125, 0.125, 0.25" in str(repaired)


def test_a_repair_leaves_what_is_physical_to_the_bit():
    plain, repaired = (Robot.from_urdf(tree(), on_unphysical=how) for how in ("error", "repair"))
    assert torch.equal(plain.inertia, repaired.inertia) and plain.notes == repaired.notes


def test_every_repaired_link_is_told_by_its_own_name():
    tool = link("tool", 1.0, BROKEN["triangle"]) + fixed("mount", "lower", "tool")
    robot = Robot.from_urdf(also(tool, arm(inertia=BROKEN["triangle"])), on_unphysical="repair")
    assert [note.partition(":")[0] for note in map(str, robot.notes) if "repaired" in note] == [
        "link 'upper'",
        "link 'tool'",
    ]
    assert bool(torch.linalg.eigvalsh(second_moments(robot.inertia)).min() > -1e-15)


@pytest.mark.parametrize("mass", [-1.0, 0.0])
def test_only_inertias_of_masses_are_repaired(mass):
    message = refusal(arm(mass=mass, inertia=BROKEN["negative moment"]), UnphysicalError, on_unphysical="repair")
    assert "link 'upper': " in message and "only inertias of bodies with mass can be repaired" in message


def test_a_cure_that_cannot_help_is_not_named():
    """No repair gives a mass to a free base that has none, or another sign to a mass."""
    weightless = arm().replace('<link name="base">', '<link name="base"><!--').replace("</link>", "--></link>", 1)
    for message in (refusal(arm(mass=-1.0), UnphysicalError), refusal(weightless, UnphysicalError, base="floating")):
        assert "repair" not in message and "Correct the description" in message


def test_robots_in_hand_are_repaired_as_well():
    robot = Robot.from_urdf(arm(inertia=BROKEN["large product"]), on_unphysical="ignore")
    found = robot.replace(on_unphysical="repair")
    expected = Robot.from_urdf(arm(inertia=BROKEN["large product"]), on_unphysical="repair")
    assert same(found.inertia, expected.inertia, 1e-15) and found.notes == expected.notes
    found.check()
    assert robot.check is not None and same(robot.inertia[0], BROKEN["large product"])


def test_a_batch_of_robots_is_not_repaired():
    robot = Robot.from_urdf(arm())
    with pytest.raises(ArgumentError, match=r"inertia of robot .* must be that of one robot to be repaired"):
        robot.replace(mass=robot.mass * torch.ones(3, 1, dtype=F64), on_unphysical="repair")


def test_robots_from_tables_are_repaired_as_well():
    arguments = [[[0, 0, 1, 0, 0, 0]], [1.0], [[0.1, 0, 0]]]
    with pytest.warns(UserWarning, match="triangle"):
        Robot.from_screws(*arguments, [BROKEN["triangle"]])
    with pytest.raises(UnphysicalError, match="positive definite"):
        Robot.from_screws(*arguments, [BROKEN["large product"]])
    robot = Robot.from_screws(*arguments, [BROKEN["triangle"]], on_unphysical="repair")
    assert same(robot.inertia[0], [0.125, 0, 0.125, 0, 0, 0.25]) and robot.notes[0].code == "inertia.repaired"
    robot = Robot.from_dh(
        [0.1], [0], [0], [0], [1.0], [[0, 0, 0]], [tensor(BROKEN["triangle"])], on_unphysical="repair"
    )
    assert same(matrices(robot.inertia[0]), np.diag([0.125, 0.125, 0.25]))


def test_the_error_names_the_ways_out():
    message = refusal(arm(inertia=BROKEN["large product"]), UnphysicalError)
    assert "on_unphysical='repair'" in message and "'warn'" in message
    with pytest.raises(ArgumentError, match="on_unphysical must be one of 'error', 'warn', 'repair', 'ignore'"):
        Robot.from_urdf(arm(), on_unphysical="mend")


# --- slips that change the dynamics ----------------------------------------------------------------------------------

ORIGIN, BODY = '<origin xyz="0.1 0.2 0.3" rpy="0 0 1"/>', '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
MATTER = {  # content of a link "x" and of a joint "j" that carries it, and the words of the warning
    "multiplyer": (
        "",
        "<mimic joint='elbow' multiplyer='-1'/>",
        "multiplyer of <mimic> in joint 'j' (is multiplier me",
    ),
    "mas": (f"<inertial><mas value='2'/>{BODY}</inertial>", "", "<mas> in link 'x' (is <mass> meant?)"),
    "orign of a body": (f"<inertial><orign xyz='1 0 0'/><mass value='2'/>{BODY}</inertial>", "", "<orign> in link 'x'"),
    "orign of a joint": ("", "<orign xyz='1 0 0'/>", "<orign> in joint 'j' (is <origin> meant?)"),
    "ryp": ("", "<origin xyz='1 0 0' ryp='0 0 1'/>", "ryp of <origin> in joint 'j' (is rpy meant?)"),
    "xzy": ("", "<axis xzy='0 1 0'/>", "xzy of <axis> in joint 'j' (is xyz meant?)"),
    "vector": ("", "<axis vector='0 1 0'/>", "vector of <axis> in joint 'j'"),
    "axes": ("", "<axes xyz='0 1 0'/>", "<axes> in joint 'j' (is <axis> meant?)"),
    "Inertial": (f"<Inertial><mass value='2'/>{BODY}</Inertial>", "", "<Inertial> in link 'x' (is <inertial> meant?)"),
    "uper": (
        "",
        "<limit lower='0' uper='1' effort='1' velocity='1'/>",
        "uper of <limit> in joint 'j' (is upper meant?)",
    ),
    "no driver": ("", "<mimic joint='elbo'/>", "j mimics 'elbo' (is 'elbow' meant?)"),
    "two bodies": (f"<inertial><mass value='2'/>{BODY}</inertial>" * 2, "", "2 <inertial> in link 'x'"),
    "two origins": ("", ORIGIN * 2, "2 <origin> in joint 'j'"),
    "two axes": ("", "<axis xyz='0 1 0'/><axis xyz='0 0 1'/>", "2 <axis> in joint 'j'"),
    "body outside": (f"<mass value='2'/>{BODY}", "", "<mass> in link 'x'"),
    "place outside": (f"{ORIGIN}<inertial><mass value='2'/>{BODY}</inertial>", "", "<origin> in link 'x'"),
    "xyz of a joint": ("", "' xyz='1 0 0", "xyz in joint 'j'"),
}
HARMLESS = {
    "misspelt mesh": ("<visul/><visual><orign/></visual><collision><orign/></collision>", "", "revolute"),
    "vendors' tags": ("<self_collision/>", "<hardware/><gear ratio='2'/><x:axes/>", "revolute"),
    "springs": ("", "<dynamics stiffness='2'/>", "revolute"),
    "place of an empty link": (ORIGIN, "", "revolute"),
    "place of a link and of its body": (
        f"{ORIGIN}<inertial>{ORIGIN}<mass value='1'/></inertial>",
        "",
        "revolute",
    ),
    "axes of a fixed joint": ("", "<axis xyz='0 0 1'/><axis xzy='0 1 0'/><axes/>", "fixed"),
    "two of what is not read": ("", "<calibration/><calibration/>", "revolute"),
    "limits left out": ("", "<limit effort='1' velocity='1'/>", "revolute"),
}


def with_link(body, more, kind="revolute"):
    """An arm with a link "x" of this content, on a joint "j" of that."""
    attribute, more = (more, "") if more.startswith("'") else ("", more)
    ends = "<parent link='lower'/><child link='x'/>"
    return also(f"<link name='x'>{body}</link><joint name='j' type='{kind}{attribute}'>{ends}{more}</joint>")


@pytest.mark.parametrize("slip", MATTER)
def test_a_slip_that_may_change_the_dynamics_is_one_warning(slip):
    body, more, words = MATTER[slip]
    with pytest.warns(UserWarning) as seen:
        robot = Robot.from_urdf(with_link(body, more))
    (message,) = [str(warning.message) for warning in seen]
    assert message.startswith("robot 'arm': its file has what is not used and may change the dynamics:\n  ")
    assert words in message and words in "\n".join(map(str, robot.notes)) and seen[0].filename == __file__


@pytest.mark.parametrize("what", HARMLESS)
def test_what_changes_no_dynamics_is_no_warning(what):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Robot.from_urdf(with_link(*HARMLESS[what]))
        for slip in MATTER:  # and asked for, none is
            Robot.from_urdf(with_link(*MATTER[slip][:2]), on_unphysical="ignore")


def test_a_driver_that_is_missing_is_none_for_independent_joints():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Robot.from_urdf(with_link("", "<mimic joint='elbo'/>"), mimic="independent")


SLIPPED = {"alex_psyonic_hands"}  # its fingers mimic 'index_q1', and the joint is 'Left_index_q1'


@pytest.mark.parametrize("name", oracles.example_robots())
def test_robots_of_others_have_no_slips_but_one(name):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        Robot.from_urdf(oracles.example_robots()[name], on_unphysical="warn")
    assert any("may change the dynamics" in str(warning.message) for warning in seen) == (name in SLIPPED)


# --- reports ---------------------------------------------------------------------------------------------------------


def test_the_report_says_all_that_was_wrong():
    text = also('<drake:x/><y/><link name="map"/>').replace(LIMIT, "", 1)
    report = str(Robot.from_urdf(text).report())
    for note in ("not declared: drake", "not read: y", "left out: map", "taken as unlimited: shoulder"):
        assert note in report


def test_torques_need_no_inertia_and_accelerations_do():
    text = also(link("finger", None) + joint("knuckle", "lower", "finger"))
    robot = Robot.from_urdf(text)
    q, qd, qdd = states(3)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd, backend="eager")
    for needs in (
        lambda: torchdq.forward_dynamics(robot, q, qd, tau, backend="eager"),
        lambda: torchdq.error_growth(robot, q),
        lambda: torchdq.nn.ForwardDynamics(robot)(q, qd, tau),
    ):
        with pytest.raises(torchdq.SingularInertiaError, match="knuckle"):
            needs()


def test_errors_of_a_file_name_it(tmp_path):
    """Of text there is nothing to name."""
    path = tmp_path / "broken.urdf"
    path.write_text(arm()[:-20])
    with pytest.raises(torchdq.DescriptionError, match=r"^the file is not well-formed XML"):
        torchdq.Robot.from_urdf(path.read_text())
    with pytest.raises(torchdq.DescriptionError, match=f"^{path}: the file is not well-formed XML"):
        torchdq.Robot.from_urdf(path)
    with path.open() as file, pytest.raises(torchdq.DescriptionError, match=f"^{path}: the file is not well-formed"):
        torchdq.Robot.from_urdf(file)
    path.write_text("<mujoco><worldbody>")
    with pytest.raises(torchdq.DescriptionError, match=f"{path}.*MuJoCo cannot compile|MuJoCo cannot .*{path.name}"):
        torchdq.Robot.from_mjcf(path)
