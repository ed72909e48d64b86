"""Inertial parameters of a robot, how it prints, and batches of robots."""

import copy
import pickle

import pytest
import torch
from helpers import all_in_one, thinned
from messages import refused
from robots import ARMS, F64, LINE, forked, one_joint, panda, same, states

import torchdq


def test_the_inertial_parameters_are_those_about_the_link_frame():
    robot = one_joint(LINE, inertia=[(0.04, 0.001, 0.05, -0.002, 0.003, 0.03)])
    m, (x, y, z) = 2.0, (0.1, 0.2, 0.3)
    expected = [m, m * x, m * y, m * z, 0.04 + m * (y * y + z * z), 0.001 - m * x * y, 0.05 + m * (x * x + z * z)]
    expected += [-0.002 - m * x * z, 0.003 - m * y * z, 0.03 + m * (x * x + y * y)]
    assert same(robot.inertial_parameters, expected)


def test_repr_says_what_it_is():
    assert repr(panda()) == "Robot('panda', 7 joints, chain, 16.06 kg, tip='tip')"
    assert repr(copy.deepcopy(pickle.loads(pickle.dumps(panda())))) == repr(panda()) and "tree" in repr(forked())


def test_a_robot_of_one_argument_says_how_to_read_a_file():
    with refused(torchdq.ArgumentError):
        torchdq.Robot("arm.urdf")


# --- batches of robots -----------------------------------------------------------------------------------------------


def randomised(field, rows=3):
    """The Puma with a batch of one of its tensors."""
    robot = torchdq.robots.load("puma560")
    value = getattr(robot, field)
    g = torch.Generator().manual_seed(11)
    factors = 1 + 0.1 * torch.rand(rows, *[1] * value.ndim, generator=g, dtype=F64)
    return robot.replace(**{field: factors * value})


@pytest.mark.parametrize("field", thinned(["mass", "com", "inertia", "gravity", "armature"], ("inertia", "gravity")))
def test_a_row_of_a_batch_of_robots_is_that_robot_alone(field):
    robots = randomised(field)
    q, qd, qdd = states(6, rows=3)
    with torchdq.backend("auto" if field == "inertia" else "eager"):
        tau = torchdq.inverse_dynamics(robots, q, qd, qdd)
        for row in range(3):
            alone = robots.replace(**{field: getattr(robots, field)[row]})
            # up to rounding: one robot's numbers are folded once, those of many are worked on in every row
            assert same(tau[row], torchdq.inverse_dynamics(alone, q[row], qd[row], qdd[row]))


def test_batches_of_robots_and_of_states_broadcast():
    q = states(6, rows=5)[0].unsqueeze(1)
    assert torchdq.inverse_dynamics(randomised("mass"), q).shape == (5, 3, 6)
    assert torchdq.mass_matrix(randomised("mass"), torch.zeros(6, dtype=F64)).shape == (3, 6, 6)


@all_in_one([*ARMS, "three of their own masses"])
def test_the_regressor_times_the_parameters_is_the_torque(name):
    robot = torchdq.robots.load(name) if name in ARMS else randomised("mass")
    q, qd, qdd = states(robot.n, rows=3)
    tau = torchdq.inverse_dynamics(robot.replace(armature=None), q, qd, qdd)
    Y, parameters = torchdq.regressor(robot, q, qd, qdd), robot.inertial_parameters.unsqueeze(-1)
    assert same((Y @ parameters).squeeze(-1), tau, 1e-13)


def test_a_batch_of_robots_is_reported_by_its_mean():
    robots = panda().replace(mass=torch.stack([panda().mass, 3 * panda().mass]))
    assert "32.12 kg" in repr(robots) and robots.report().joints[3][3] == "7.176 kg"
