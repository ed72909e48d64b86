"""URDF texts of robots that have no file: read again they are the robots, for this package and for Pinocchio."""

import warnings

import oracles
import pinocchio as pin
import pytest
import torch
from composed_robots import ROBOTS, arm, require_same_robot
from helpers import all_in_one
from messages import refused
from robots import SHIPPED, one_joint, states
from urdf_text import joint, link, urdf

import torchdq
from torchdq import Robot
from torchdq.robot.description import Limits


@all_in_one(ROBOTS)
def test_a_robot_is_read_back_from_its_own_text(name):
    robot = ROBOTS[name].replace(armature=None)
    text, base = robot.to_urdf(), "floating" if robot.floating else "file"
    again = Robot.from_urdf(text, base=base, on_unphysical="ignore", gravity=robot.gravity)
    require_same_robot(robot, again)
    assert again.to_urdf(text) == text


@all_in_one(["table", "modified", "panda", "ur10e", "cut", "tree 2"])
def test_pinocchio_reads_the_same_robot(name):
    """Other readers need limits of velocity and effort with those of position, and have infinite ones nowhere."""
    robot = ROBOTS[name]
    lower, upper, *rest = robot.limits
    if name.startswith("tree"):
        lower, upper = (
            x.where(x.isfinite() | (torch.tensor([k == "revolute" for k in robot.kinds])), 0) for x in (lower, upper)
        )
    robot = robot.replace(limits=Limits(lower, upper, *(x.clamp(max=100) for x in rest)))
    case = oracles.Case(robot, pin.buildModelFromXML(robot.to_urdf()))
    case.model.gravity.linear = robot.gravity.numpy()
    q, qd, qdd = states(robot.n, rows=1)
    data = case.model.createData()
    found = pin.rnea(case.model, data, case.configuration(q[0]), case.velocity(qd[0]), case.velocity(qdd[0]))
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)[0].numpy()
    assert abs(found[case.order] - tau).max() < 1e-11 * abs(tau).max()


def test_a_table_gives_its_frames_and_bodies_to_links_by_name():
    """The link that a joint moves has its frame on the axis, so the table's own frame hangs on it."""
    robot = Robot.from_urdf(arm().with_rods(30.0).to_urdf())
    assert robot.link_names == ("link1_axis", "link2_axis", "link3_axis", "link4", "link5", "link6")
    assert robot.tip == "tip" and set(arm().frame_names) < set(robot.frame_names)
    assert float(robot.mass.sum()) == pytest.approx(30.0)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert Robot.from_urdf(arm().to_urdf()).mass.tolist() == [0.0] * 6
    assert len(said) == 1  # that there is no mass


def test_joints_that_follow_others_are_written_as_mimic():
    robot = ROBOTS["coupled"]
    again = Robot.from_urdf(robot.to_urdf())
    assert torch.equal(again.joint_map.S, robot.joint_map.S) and again.joint_map.joint_names == ("a", "b", "c")


def test_contact_points_and_drawings_are_written():
    robot = SHIPPED["go2"]
    again = Robot.from_urdf(robot.to_urdf(), base="floating")
    foot = next(name for name in robot.frame_names if "foot" in name)
    assert robot.contact_points(foot) == again.contact_points(foot) != ()
    shapes = """<visual name="v"><origin xyz="1 2 3" rpy="1 2 3"/>
        <geometry><mesh filename="a.stl" scale="1 2 3"/></geometry></visual>
        <collision><geometry><box size="1 2 3"/></geometry></collision>
        <collision><geometry><cylinder radius="1" length="3"/></geometry></collision>"""
    robot = Robot.from_urdf(urdf(link("a", None), link("b", more=shapes), joint("j", "a", "b")))
    (a, b), (c, d) = (
        [r.frame("b").drawing.shapes, r.frame("b").shapes] for r in (robot, Robot.from_urdf(robot.to_urdf()))
    )
    assert (a[0]._replace(X_FS=None), b) == (c[0]._replace(X_FS=None), d) and a[0].mesh == "a.stl" and len(b) == 2


def test_names_of_links_that_are_taken_are_lengthened():
    robot = arm(link_names=["one", "one_axis", "three", "four", "five", "six"]).with_rods(1.0)
    names = Robot.from_urdf(robot.to_urdf()).frame_names
    assert {"one", "one_axis", "one_axis_", "one_axis_axis"} < set(names)


REFUSED = {
    "helical": lambda: one_joint([0, 0, 1, 0, 0, 0.1]),
    "rotors": lambda: SHIPPED["panda_hand"],
    "closures": lambda: SHIPPED["panda"].with_closures(torchdq.Closure("base", "tip")),
    "coupled": lambda: SHIPPED["two_link"].couple(torch.tensor([[1.0, 0.0], [1.0, 1.0]]), ["m1", "m2"]),
    "batch": lambda: SHIPPED["two_link"].replace(mass=torch.ones(3, 2)),
}


@all_in_one(REFUSED)
def test_a_robot_that_has_no_place_in_the_format_is_refused(name):
    robot = REFUSED[name]()
    with refused(torchdq.ArgumentError):
        robot.to_urdf()
