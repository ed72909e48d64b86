"""Scenes move as MuJoCo's do, which reads the same URDF files with a parser of its own and integrates on its own.

With gravity, damping and rotors, integrators that are the same on paper are the same to rounding after a second of a
thousand steps.
"""

from functools import cache

import mujoco
import numpy as np
import oracles
import pytest
import torch
from helpers import thinned

import torchdq
from torchdq import Scene, effects
from torchdq.backends import c_library as build
from torchdq.scene import State
from torchdq.scene.integrators import LinearlyImplicit, RungeKutta4, SemiImplicitEuler

ROBOTS = ("ur5_robot", "panda")  # of 6 joints, and of 7 and two fingers that slide
DT, STEPS = 1e-3, 1000
SAME = 1e-9  # [rad]; a thousandth of what the task asks for, measured are some 1e-12


@pytest.fixture(autouse=True)
def compiled():
    """Compiled programs, for thousands of steps."""
    if build.compiler() is None:
        pytest.skip("there is no C compiler")
    with torchdq.backend("c"), torch.no_grad():
        yield


def robot_of(name):
    return oracles.example_case(name).robot


@cache
def parameters(name):
    """Damping, rotor inertia, a start and constant torques of a robot."""
    rng = np.random.default_rng([20260702, len(name)])
    n = robot_of(name).n
    slides = np.array([kind == "prismatic" for kind in robot_of(name).kinds])
    return {
        "damping": rng.uniform(0.5, 2.0, n),
        "armature": rng.uniform(0.05, 0.2, n),
        "q": rng.normal(size=n) * np.where(slides, 0.01, 0.7),
        "qd": rng.normal(size=n) * np.where(slides, 0.05, 0.5),
        "torque": rng.normal(size=n),
    }


@cache
def model_of(name):
    """MuJoCo's model of a file without shapes, limits and friction, with the damping and the rotors."""
    model = mujoco.MjModel.from_xml_string(oracles.rigid_bodies(name))
    order = [model.joint(joint).dofadr[0] for joint in robot_of(name).joint_names]
    assert sorted(order) == list(range(model.nv))
    model.dof_damping[order] = parameters(name)["damping"]
    model.dof_armature[order] = parameters(name)["armature"]
    model.opt.timestep = DT
    return model, order


def simulated(name, integrator, disabled=0):
    """Positions after every step of MuJoCo, in the robot's order."""
    model, order = model_of(name)
    model.opt.integrator, model.opt.disableflags = integrator, disabled
    data = mujoco.MjData(model)
    p = parameters(name)
    data.qpos[order], data.qvel[order], data.qfrc_applied[order] = p["q"], p["qd"], p["torque"]
    found = []
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
        found.append(data.qpos[order].copy())
    return np.array(found)


@cache
def moved(name, integrator):
    """Positions after every step of a scene."""
    p = parameters(name)
    parts = (
        effects.Gravity((0.0, 0.0, -9.81)),
        effects.RotorInertia(p["armature"].tolist()),
        effects.Viscous(p["damping"].tolist()),
    )
    scene = Scene(robot_of(name), parts, integrator=integrator, dt=DT)
    state, torque = State(torch.from_numpy(p["q"]), torch.from_numpy(p["qd"])), torch.from_numpy(p["torque"])
    return scene.rollout(state, torque.expand(STEPS, -1)).q.numpy()


EULER, RK4 = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4
EXPLICIT = mujoco.mjtDisableBit.mjDSBL_EULERDAMP
PAIRS = {
    "implicit damping": (LinearlyImplicit(), EULER, 0),
    "explicit damping": (SemiImplicitEuler(), EULER, EXPLICIT),
    "Runge-Kutta": (RungeKutta4(), RK4, 0),
}


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("name", thinned(ROBOTS, ROBOTS[:1]))
def test_a_second_of_motion_is_mujocos(name, pair):
    ours, theirs, disabled = PAIRS[pair]
    found, expected = moved(name, ours), simulated(name, theirs, disabled)
    assert np.abs(expected[-1] - expected[0]).max() > 0.5
    assert np.abs(found - expected).max() < SAME


@pytest.mark.parametrize("name", thinned(ROBOTS, ROBOTS[:1]))
def test_integrators_that_are_not_the_same_differ(name):
    """Or else the test before could not tell one from another."""
    ends = [moved(name, ours)[-1] for ours, _, _ in PAIRS.values()]
    for i in range(3):
        assert np.abs(ends[i] - ends[i - 1]).max() > 1000 * SAME
