"""MJCF texts of robots that have no file: read again they are the robots, and MuJoCo moves them so."""

import pytest
import torch
from composed_robots import ROBOTS, arm, require_same_robot
from helpers import all_in_one
from messages import refused
from robots import F64, SHIPPED, one_joint, states

import torchdq
from torchdq import Robot

mujoco = pytest.importorskip("mujoco")

# which MuJoCo has no place for: points, links without mass between joints, an inertia that no body has
UNMOVED = {"two_link", "puma560", "file 0"}


@all_in_one([name for name in ROBOTS if name not in UNMOVED])
def test_a_robot_is_read_back_from_its_own_text(name):
    """Limits of velocity have no place in the format."""
    robot = ROBOTS[name]
    text = robot.to_mjcf()
    again = Robot.from_mjcf(text, on_unphysical="ignore")
    require_same_robot(robot, again, ("lower", "upper", "effort"))
    assert torch.allclose(again.gravity, robot.gravity.double()) and again.to_mjcf(text) == text
    assert (robot.armature is None) == (again.armature is None)


@all_in_one(["turned", "ur10e", "panda", "tree 2"])
def test_mujoco_has_the_same_torques(name):
    """Each joint of the model is at its position, those that follow another one without their constraint."""
    robot = ROBOTS[name]
    robot = robot.replace(armature=torch.arange(1.0, robot.n + 1, dtype=F64), damping=0 * robot.damping)
    model = mujoco.MjModel.from_xml_string(robot.replace(friction=0 * robot.friction).to_mjcf())
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    q, qd, qdd = states(robot.n, rows=1)
    followers = torch.eye(robot.n, dtype=F64) if robot.joint_map is None else robot.joint_map.S
    own = [joint in robot.joint_names for joint in robot.every_joint]
    S = followers.abs().where(torch.tensor(own)[:, None], followers)  # the coordinate of a joint turns as it does
    at = [model.joint(x).qposadr[0] for x in robot.every_joint]
    data.qpos[at], data.qvel[at], data.qacc[at] = (S @ x[0] for x in (q, qd, qdd))
    mujoco.mj_inverse(model, data)
    found = S.T @ torch.tensor(data.qfrc_inverse[at])
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)[0]
    assert torch.allclose(found, tau, rtol=0, atol=1e-11 * float(tau.abs().max()))


def test_a_table_has_one_body_for_each_frame():
    again = Robot.from_mjcf(arm().with_rods(30.0).to_mjcf())
    assert again.frame_names == ("world", *arm().frame_names) and again.tip == "tip"


REFUSED = {
    "helical": lambda: one_joint([0, 0, 1, 0, 0, 0.1]),
    "coupled": lambda: SHIPPED["two_link"].couple(torch.tensor([[1.0, 0.0], [1.0, 1.0]]), ["m1", "m2"]),
}


@all_in_one(REFUSED)
def test_a_robot_that_has_no_place_in_the_format_is_refused(name):
    with refused(torchdq.ArgumentError):
        REFUSED[name]().to_mjcf()


def test_links_without_mass_are_left_to_the_error_of_mujoco():
    with pytest.raises(torchdq.DescriptionError, match="mjMINVAL"):
        Robot.from_mjcf(arm().to_mjcf())
