"""Elements of URDF files that are not read: those that may change the dynamics are warned of, others are only noted."""

import warnings

import oracles
import pytest
import torch
from helpers import all_in_one, thinned
from messages import warned
from robots import torques
from urdf_text import LIMIT, also, arm, codes, fixed, joint, link, mimic

from torchdq import Robot

ORIGIN = '<origin xyz="0.1 0.2 0.3" rpy="0 0 1"/>'
INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
BODY = f"<mass value='2'/>{INERTIA}"
MATTER = {  # content of a link "x" and of a joint "j" that carries it
    "multiplyer": ("", "<mimic joint='elbow' multiplyer='-1'/>"),
    "mas": (f"<inertial><mas value='2'/>{INERTIA}</inertial>", ""),
    "orign of a body": (f"<inertial><orign xyz='1 0 0'/>{BODY}</inertial>", ""),
    "orign of a joint": ("", "<orign xyz='1 0 0'/>"),
    "ryp": ("", "<origin xyz='1 0 0' ryp='0 0 1'/>"),
    "xzy": ("", "<axis xzy='0 1 0'/>"),
    "vector": ("", "<axis vector='0 1 0'/>"),
    "axes": ("", "<axes xyz='0 1 0'/>"),
    "Damping": ("", "<dynamics Damping='2'/>"),
    "Inertial": (f"<Inertial>{BODY}</Inertial>", ""),
    "uper": ("", "<limit lower='0' uper='1' effort='1' velocity='1'/>"),
    "no driver": ("", "<mimic joint='elbo'/>"),
    "two bodies": (f"<inertial>{BODY}</inertial>" * 2, ""),
    "two origins": ("", ORIGIN * 2),
    "two axes": ("", "<axis xyz='0 1 0'/><axis xyz='0 0 1'/>"),
    "body outside": (BODY, ""),
    "place outside": (f"{ORIGIN}<inertial>{BODY}</inertial>", ""),
    "xyz of a joint": ("", "' xyz='1 0 0"),
}
HARMLESS = {
    "misspelt mesh": ("<visul/><visual><orign/></visual><collision><orign/></collision>", "", "revolute"),
    "vendors' tags": ("<self_collision/>", "<hardware/><gear ratio='2'/><x:axes/>", "revolute"),
    "springs": ("", "<dynamics stiffness='2'/>", "revolute"),
    "place of an empty link": (ORIGIN, "", "revolute"),
    "place of a link and of its body": (f"{ORIGIN}<inertial>{ORIGIN}<mass value='1'/></inertial>", "", "revolute"),
    "axes of a fixed joint": ("", "<axis xyz='0 0 1'/><axis xzy='0 1 0'/><axes/>", "fixed"),
    "two of what is not read": ("", "<calibration/><calibration/>", "revolute"),
    "limits left out": ("", "<limit effort='1' velocity='1'/>", "continuous"),
    "a limit left out": ("", "<limit upper='1' effort='1' velocity='1'/>", "revolute"),
}


def with_link(body, more, kind="revolute"):
    """An arm with a link "x" of this content, on a joint "j" of that."""
    attribute, more = (more, "") if more.startswith("'") else ("", more)
    ends = "<parent link='lower'/><child link='x'/>"
    return also(f"<link name='x'>{body}</link><joint name='j' type='{kind}{attribute}'>{ends}{more}</joint>")


@all_in_one(MATTER)
def test_what_may_change_the_dynamics_is_one_warning(case):
    body, more = MATTER[case]
    with warned(UserWarning) as seen:
        robot = Robot.from_urdf(with_link(body, more))
    assert len(seen) == 1 and seen[0].filename == __file__
    subject = "link 'x'" if body else "joint 'j'"
    found = [x for x in robot.notes if x.severity == "warning" and x.subject == subject]
    assert found and all(x.code in ("element.ignored", "mimic.orphan") for x in found)
    assert any(str(x) in str(seen[0].message) for x in found)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert set(found) <= set(Robot.from_urdf(with_link(body, more), on_unphysical="ignore").notes)


@all_in_one(HARMLESS)
def test_what_changes_no_dynamics_is_no_warning(case):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Robot.from_urdf(with_link(*HARMLESS[case]))


@pytest.mark.filterwarnings("ignore:.*may affect the dynamics")
def test_the_first_of_elements_that_are_given_twice_is_read():
    body = link("x", 1.0).replace("<inertial>", "<inertial><mass value='7'/></inertial><inertial>")
    more = LIMIT + LIMIT.replace("2", "9") + "<axis xyz='1 0 0'/>"
    robot = Robot.from_urdf(also(body + joint("j", "lower", "x", more=more)))
    assert float(robot.mass[2]) == 7.0 and float(robot.limits.upper[2]) == 2.0 and robot.screw[2, 2] == 1


@pytest.mark.filterwarnings("ignore:.*may affect the dynamics")
def test_what_is_not_read_has_no_effect_and_is_named_once():
    body = link("x", 1.0).replace("<inertial>", "").replace("</inertial>", "")
    text = also("<Joint/><mesh/>" + body + fixed("f", "lower", "x") + LIMIT).replace("<axis", "<orign/><axis", 1)
    robot = Robot.from_urdf(text.replace('<joint name="elbow"', '<joint name="elbow" damping="1" dont_collapse="1"'))
    assert torch.equal(torques(robot), torques(arm()))
    ignored = {(x.subject, str(x).removeprefix(f"{x.subject}: ")) for x in robot.notes if x.code == "element.ignored"}
    assert ignored == {
        ("", "<Joint> is not read; is <joint> meant?"),
        ("", "<limit> is not read in <robot>"),
        ("", "<mesh> is not read"),
        ("", "<orign> is not read"),  # there is an origin as well
        ("joint 'elbow'", "damping is not read in <joint>"),
        ("", "<origin> is not read in <link>"),  # which has no body
        *(("link 'x'", f"<{tag}> is not read in <link>") for tag in ("inertia", "mass")),
    }


def test_attributes_in_addition_to_all_of_urdf_are_extensions_and_silent():
    more = [
        LIMIT.replace("<limit", "<limit acceleration='3' soft:lower='1'"),
        LIMIT + "<dynamics damping='0' friction='0' spring_stiffness='1'/>",
        LIMIT + mimic("shoulder").replace("/>", " of='x'/>"),
    ]
    text = "".join(link(f"x{i}") + joint(f"j{i}", "lower", f"x{i}", more=x) for i, x in enumerate(more))
    assert "element.ignored" not in {code for code, _ in codes(Robot.from_urdf(also(text)))}


OTHERS = """<transmission><joint name='x'><hardwareInterface/></joint><actuator/></transmission>
  <gazebo reference='x'><link><inertial><mass value='x'/></inertial></link></gazebo>
  <ros2_control><joint name='elbow'/></ros2_control><material name='m'/><drake:x gz:y="1"/>"""


def test_what_others_read_is_nothing_to_note():
    robot = Robot.from_urdf(also(OTHERS))
    assert torch.equal(torques(robot), torques(arm())) and robot.notes == Robot.from_urdf(arm()).notes


@all_in_one(["effort", "velocity", "lower and upper"])
def test_limits_of_zero_are_noted(zero):
    limits = {"lower": -1, "upper": 2, "effort": 3, "velocity": 4} | dict.fromkeys(zero.split(" and "), 0)
    more = "<limit " + " ".join(f'{key}="{x}"' for key, x in limits.items()) + "/>"
    what = "position" if "lower" in zero else zero
    robot = Robot.from_urdf(also(link("x") + joint("j", "lower", "x", more=more)))
    assert ("limits.zero", f"j ({what})") in codes(robot)


def test_the_report_says_all_that_was_found():
    text = also('<drake:x/><y/><link name="map"/>').replace(LIMIT, "", 1)
    report = str(Robot.from_urdf(text).report())
    for note in ("<y> is not read", "map: nothing carries it", "left out", "shoulder: no <limit>, taken as unlimited"):
        assert note in report


# fingers that mimic 'index_q1', where the joint is 'Left_index_q1'; revolute joints without lower and upper
IGNORED = {"alex_psyonic_hands", "centauro", "quadruped"}


@all_in_one(thinned(oracles.example_robots(), {*IGNORED, *oracles.REPRESENTATIVE_ROBOTS[::2]}))
def test_robots_of_others_have_no_ignored_elements_but_three(name):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        Robot.from_urdf(oracles.example_robots()[name], on_unphysical="warn")
    assert any("may affect the dynamics" in str(warning.message) for warning in seen) == (name in IGNORED)
