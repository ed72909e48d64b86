"""Scenes of small robots, their steps one after the other, and a scene with effects of every slot."""

import math

import torch
from helpers import double, random
from oracles import random_tree, shipped

from torchdq import Scene, effects
from torchdq.scene import State
from torchdq.scene.controllers import ComputedTorque
from torchdq.scene.integrators import LinearlyImplicit

ARM = shipped("two_link").robot
TREE = random_tree(3, seed=6, armature=True).robot
PANDA = shipped("panda").robot
ZERO = torch.zeros(2, dtype=torch.float64)
KP, KD = 25.0, 8.0
RICH = (
    effects.Gravity(),
    effects.RotorInertia(0.1),
    effects.Viscous(0.3),
    effects.Coulomb(0.2),
    effects.JointLimits(-1.0, 1.0, 100.0),
    effects.Drag(0.1, 0.1, 0.1),
    effects.Contact(height=0.3, stiffness=100.0, friction=0.5),
    effects.Push(),
    effects.FirstOrderLag(0.05),
    effects.Saturation(5.0),
    effects.Noise(0.1, 0.2),
    effects.MeasurementDelay(2),
)


def rich(robot, **fields):
    """Scene with effects of every slot and a controller."""
    return Scene(robot, RICH, ComputedTorque(KP, KD), LinearlyImplicit(), **fields)


def inputs_of(scene, *batch, seed=0, dtype=torch.float64):
    """Random inputs of a scene, by name."""
    return {
        name: random(*batch, width, seed=seed + k).to(dtype) for k, (name, width) in enumerate(scene.inputs.items())
    }


def uniform(scene, *batch):
    """Random numbers for the sensors of a scene."""
    generator = torch.Generator().manual_seed(9)
    return torch.rand(*batch, scene.noises, generator=generator, dtype=torch.float64)


def equal(a, b):
    """Whether tensors, or None, are equal to the bit."""
    return all((x is None and y is None) or torch.equal(x, y) for x, y in zip(a, b, strict=True))


def rolled(scene, state, steps, torque=None, **inputs):
    """State after a number of steps."""
    for _ in range(steps):
        state = scene.step(state, torque, **inputs)
    return state


def trace(scene, state, steps, torque=None, **inputs):
    """Positions and velocities at the start and after every step, [steps + 1, ...]."""
    series = {name: x.expand(steps, *x.shape) for name, x in {"torque": torque, **inputs}.items() if x is not None}
    states = scene.rollout(state, steps=steps, nonfinite="ignore", **series)
    return State(*(torch.cat([a[None], b]) for a, b in list(zip(state, states, strict=True))[:2]))


def swinging(dtype=torch.float64):
    """The two-link pendulum let go from where it swings regularly."""
    return State(double(-math.pi / 2 + 0.6, 0.4).to(dtype), torch.zeros(2, dtype=dtype))
