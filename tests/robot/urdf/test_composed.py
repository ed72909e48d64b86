"""URDF texts of robots that have no file: read again they are the robots, for this package and for Pinocchio."""

import math
import warnings

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one
from messages import refused
from robots import F64, SHIPPED, on_free_base, one_joint, states
from urdf_text import joint, link, mimic, random_elements, urdf

import torchdq
from torchdq import Robot, dq, floating
from torchdq.robot.description import Limits


def random_screws(seed):
    """A random tree whose axes pass beside the frames of their links, with limits; a helical joint turns only."""
    robot = oracles.random_tree(6, seed).robot
    l, m = robot.screw[:, :3], robot.screw[:, 3:]
    bounds = torch.arange(1.0, robot.n + 1, dtype=F64)
    bounds[0] = math.inf
    return robot.replace(
        kinds=tuple("prismatic" if kind == "prismatic" else "revolute" for kind in robot.kinds),
        screw=torch.cat([l, m - (l * m).sum(-1, keepdim=True) * l], -1),
        limits=Limits(-bounds, 2 * bounds, 3 * bounds, 4 * bounds),
        damping=torch.linspace(0, 1, robot.n, dtype=F64),
        friction=torch.linspace(1, 0, robot.n, dtype=F64),
    )


def coupled():
    """Joints of a file that follow one of them, one of them backwards from another zero."""
    return Robot.from_urdf(
        urdf(
            *(link(f"l{i}", 1.0 + i) for i in range(4)),
            joint("a", "l0", "l1", xyz=(0, 0, 1), axis=(0, 1, 0)),
            joint("b", "l1", "l2", xyz=(0, 1, 0), axis=(1, 0, 0), more=mimic("a", -0.5, 0.25)),
            joint("c", "l2", "l3", "prismatic", axis=(0, 0, 1), more=mimic("b", 2.0)),
        )
    )


def arm(convention="standard", **more):
    """An arm of six axes from its table, with spherical wrist."""
    h = math.pi / 2
    a = [0.1, 0.6, 0.05, 0.0, 0.0, 0.0]
    alpha = [h, 0.0, h, -h, h, 0.0]
    return Robot.from_dh(a, alpha, [0.4, 0.0, 0.0, 0.5, 0.0, 0.1], [0, h, 0, 0, 0.3, 0], convention=convention, **more)


ROBOTS = {
    **{name: robot.replace(armature=None) for name, robot in SHIPPED.items()},
    **{f"tree {i}": random_screws(i) for i in range(6)},
    **{f"file {i}": Robot.from_urdf(urdf(*random_elements(i)), on_unphysical="ignore") for i in range(3)},
    "coupled": coupled(),
    "table": arm().with_rods(30.0),
    "modified": arm("modified").with_rods(30.0),
    "turned": arm()
    .with_rods(30.0)
    .couple(
        {"joint2": {"joint2": -1.0}, "joint5": {"joint5": -1.0}, "joint6": {"joint2": 0.5}},
        offset={"joint2": 0.7, "joint6": 1.0},
    ),
    "floating": on_free_base(random_screws(7)),
    "cut": SHIPPED["panda"].lock({"panda_joint3": 0.4}),
    "single": arm().with_rods(30.0).to(torch.float32),
}


AT = torch.eye(8, dtype=F64)[0]  # pose of a base that stands


def torques(robot, q, qd, qdd):
    """Torques of a robot, after the wrench on its base if it floats."""
    if not robot.floating:
        return torchdq.inverse_dynamics(robot, q, qd, qdd)
    return torch.cat([*floating.inverse_dynamics(robot, AT, q, None, qd, None, qdd)], -1)


def poses(robot, q, frames):
    """Matrices of the poses of frames."""
    if robot.floating:
        return dq.to_matrix(floating.forward_kinematics(robot, AT, q, frames))
    return dq.to_matrix(torchdq.forward_kinematics(robot, q, frames))


@all_in_one(ROBOTS)
def test_a_robot_is_read_back_from_its_own_text(name):
    """Frames, torques and all numbers of joints agree to rounding, with the joints in the order of the reader."""
    robot = ROBOTS[name]
    text = robot.to_urdf()
    base = "floating" if robot.floating else "file"
    again = Robot.from_urdf(text, base=base, on_unphysical="ignore", gravity=robot.gravity)
    robot = robot.to(F64)
    order = [again.joint_names.index(x) for x in robot.joint_names]
    q, qd, qdd = states(robot.n)
    back = [x[:, np.argsort(order)] for x in (q, qd, qdd)]
    single = ROBOTS[name].mass.dtype == torch.float32  # whose poses are units to that
    names = [*robot.frame_names]
    assert torch.allclose(poses(robot, q, names), poses(again, back[0], names), atol=1e-6 if single else 1e-12)
    tau, found = torques(robot, q, qd, qdd), torques(again, *back)
    k = found.shape[-1] - robot.n
    found = torch.cat([found[:, :k], found[:, k:][:, order]], -1)
    assert torch.allclose(tau, found, rtol=0, atol=(1e-6 if single else 1e-12) * float(tau.abs().max()))
    for a, b in zip(*((*r.limits, r.damping, r.friction) for r in (robot, again)), strict=True):
        assert torch.allclose(a, b[order], rtol=1e-14)
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
