"""Dynamics agree with MuJoCo, which reads the same URDF files with a parser of its own.

Two readers that misunderstand a file alike would not show in a comparison with Pinocchio; a third may. MuJoCo also
turns every inertia to its principal axes and computes in other frames. It wants meshes, so those elements are removed
from the text, and so is what torchdq does not simulate but MuJoCo would: limits, friction, damping and coupled (mimic)
joints. Joints and bodies are mapped by name.

An error is a largest difference relative to the magnitudes of a joint torque's terms (`size_of_torques`), for the mass
matrix to sqrt(M_ii M_jj). MuJoCo stops looking for principal axes at 1e-12, so that is what its inertias are good for.
The tolerance is 1e-12 for torques, whose size counts more than inertia, 2e-12 for the mass matrix, 2e-14 for frames.
"""

from functools import cache

import mujoco
import numpy as np
import oracles
import pytest
from compared import FEW, MUJOCO_REFUSES, READ_BY_MUJOCO
from helpers import thinned
from oracles import worst

import torchdq

TOLERANCE = 1e-12
AXES = 2e-12
EXACT = 2e-14

# --- MuJoCo's answers ------------------------------------------------------------------------------------------------


@cache
def compiled(name: str) -> mujoco.MjModel:
    """MuJoCo's model of a robot."""
    return mujoco.MjModel.from_xml_string(oracles.rigid_bodies(name))


@cache
def frames(name: str) -> list[str]:
    """Names of the links that MuJoCo has as bodies; it makes a base link without inertia part of its world."""
    bodies = {compiled(name).body(i).name for i in range(compiled(name).nbody)}
    return [frame for frame in robot_of(name).frame_names if frame in bodies]


def robot_of(name: str) -> torchdq.Robot:
    """The robot under test."""
    return oracles.example_case(name).robot


def answers(name: str) -> list[np.ndarray]:
    """MuJoCo's results in `oracles.states`: M, bias and torques in the robot's order, rotations and positions."""
    model, robot = compiled(name), robot_of(name)
    data = mujoco.MjData(model)
    joints = [model.joint(joint) for joint in robot.joint_names]
    at, dof = [j.qposadr[0] for j in joints], [j.dofadr[0] for j in joints]
    assert sorted(dof) == list(range(model.nv))
    rows = []
    for q, qd, qdd, *_ in oracles.states(robot).rows():
        data.qpos[at], data.qvel[dof] = q, qd
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, M)
        bias = data.qfrc_bias[dof]
        bodies = [data.body(body) for body in frames(name)]
        poses = [body.xmat.reshape(3, 3).copy() for body in bodies], [body.xpos.copy() for body in bodies]
        data.qacc[dof] = qdd
        mujoco.mj_inverse(model, data)
        rows.append((M[np.ix_(dof, dof)], bias, data.qfrc_inverse[dof], *poses))
    return [*map(np.array, zip(*rows, strict=True))]


# --- tests -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MUJOCO_REFUSES)
def test_a_robot_left_out_is_one_that_mujoco_does_not_read(name):
    with pytest.raises(ValueError, match=MUJOCO_REFUSES[name]):
        compiled(name)


@pytest.mark.parametrize("name", thinned(READ_BY_MUJOCO, FEW))
def test_agrees_with_mujoco(name):
    """Mass matrix, torques, and poses of every link but the base."""
    robot, (M, bias, torques, rotations, positions) = robot_of(name), answers(name)
    s, case = oracles.states(robot), oracles.case(name)
    size = np.sqrt(np.diagonal(M, axis1=-2, axis2=-1).max(0))
    errors = {"mass matrix": worst(torchdq.mass_matrix(robot, s.q), M, size[:, None] * size) / AXES}
    size = oracles.size_of_torques(case, s._replace(qdd=0 * s.qdd))
    errors["bias torques"] = worst(torchdq.inverse_dynamics(robot, s.q, s.qd), bias, size) / TOLERANCE
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)
    errors["torques"] = worst(tau, torques, oracles.size_of_torques(case, s)) / TOLERANCE
    X = torchdq.forward_kinematics(robot, s.q)[:, [robot.frame_names.index(frame) for frame in frames(name)]]
    poses = np.array([[oracles.se3(x).homogeneous for x in row] for row in X])
    errors["orientations"] = worst(poses[..., :3, :3], rotations, 1.0) / EXACT
    reach = np.linalg.norm(positions, axis=-1).max()
    errors["positions"] = worst(poses[..., :3, 3], positions, reach) / EXACT
    assert {what: error for what, error in errors.items() if not error <= 1.0} == {}
    base, *others = robot.frame_names
    assert set(others) <= set(frames(name)), base
