"""Frames and Jacobians agree with pytorch_kinematics, which reads the same URDF files with a parser of its own.

It keeps the constants of a file in single precision, whatever the dtype of the joint angles, so positions agree to 1e-6
of the robot's reach and rotation matrices to 1e-6, and no better. Joints and frames are mapped by name.
"""

from functools import cache

import numpy as np
import oracles
import pytest
import pytorch_kinematics as pk
import torch
from compared import FEW
from helpers import thinned
from oracles import worst

import torchdq

TOLERANCE = 1e-6

# what pytorch_kinematics objects to in files it does not read; none of it concerns kinematics
REFUSED = {
    "icub": "texture:\nRequired attribute not set",
    "icub_reduced": "texture:\nRequired attribute not set",
    "pr2": "r_wrist_trans.*\nCould not perform duck-typed parsing",
    "romeo_laas_small": "texture:\nRequired attribute not set",
}
NAMES = [name for name in oracles.example_robots() if name not in REFUSED]
# robots and the links at the ends of their chains
CHAINS = {
    "kinova": "j2s6s200_end_effector",
    "panda": "panda_leftfinger",
    "so101": "gripper_link",
    "tiago_pro": "arm_left_7_link",
    "ur10_robot": "tool0",
    "xarm7": "link7",
    "z1": "link06",
}


@cache
def chain_of(name: str) -> pk.Chain:
    """Pytorch_kinematics' reading of a robot's file."""
    return pk.build_chain_from_urdf(oracles.urdf_paths()[name].read_bytes()).to(dtype=torch.float64)


def poses(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Homogeneous matrices [states, frames, 4, 4] of all frames: torchdq's and pytorch_kinematics'."""
    robot, chain = oracles.example_case(name).robot, chain_of(name)
    q = oracles.states(robot).q
    angles = q[:, [robot.joint_names.index(joint) for joint in chain.get_joint_parameter_names()]]
    theirs = chain.forward_kinematics(angles)
    missing = set(robot.frame_names) - set(theirs)
    assert not missing, missing
    X = torchdq.forward_kinematics(robot, q)
    matrices = [theirs[frame].get_matrix().expand(len(q), 4, 4) for frame in robot.frame_names]
    return torchdq.dq.to_matrix(X).numpy(), torch.stack(matrices, 1).numpy()


@pytest.mark.parametrize("name", REFUSED)
def test_a_robot_left_out_is_one_that_pytorch_kinematics_does_not_read(name):
    with pytest.raises(Exception, match=REFUSED[name]):
        chain_of(name)


@pytest.mark.parametrize("name", thinned(NAMES, FEW))
def test_frames_are_where_pytorch_kinematics_puts_them(name):
    ours, theirs = poses(name)
    reach = np.linalg.norm(ours[..., :3, 3], axis=-1).max()
    assert worst(ours[..., :3, :3], theirs[..., :3, :3], 1.0) <= TOLERANCE
    assert worst(ours[..., :3, 3], theirs[..., :3, 3], reach) <= TOLERANCE


@pytest.mark.parametrize("name", thinned(CHAINS, FEW))
def test_jacobian(name):
    robot, end = oracles.example_case(name).robot, CHAINS[name]
    text = oracles.urdf_paths()[name].read_bytes()
    chain = pk.build_serial_chain_from_urdf(text, end).to(dtype=torch.float64)
    joints = [robot.joint_index(joint) for joint in chain.get_joint_parameter_names()]
    q = oracles.states(robot).q
    theirs = chain.jacobian(q[:, joints]).numpy()[:, [3, 4, 5, 0, 1, 2]]  # it has the linear rows first
    ours = torchdq.jacobian(robot, q, end, expressed="world").numpy()
    reach = np.abs(ours[:, 3:]).max()
    size = np.repeat([1.0, reach], 3)[:, None]
    others = [i for i in range(robot.n) if i not in joints]
    assert worst(ours[..., joints], theirs, size) <= TOLERANCE
    assert not ours[..., others].any()
