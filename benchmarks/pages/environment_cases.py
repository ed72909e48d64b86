"""Observations of the registered environments, entry by entry, with the quantities themselves for comparison in tests.

The name of a task is the one under which `torchdq.envs` registers it, in small letters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

import torchdq
from torchdq.envs.tasks import Reach, Track, velocities
from torchdq.robot import Robot


class Situation(NamedTuple):
    """Environments at one moment."""

    robot: Robot
    q: Tensor  # [N, n] as measured
    qd: Tensor
    goal: Tensor  # of the task
    time: float  # since the start of the episode [s]


class Entries(NamedTuple):
    """Neighbouring entries of an observation."""

    what: str
    unit: str
    value: Callable[[Situation], Tensor]  # [N, entries]


class Environment(NamedTuple):
    """A registered environment as its page shows it."""

    task: type[Reach | Track]
    observation: tuple[Entries, ...]
    info: Mapping[str, str]
    versions: Mapping[str, str]
    hint: str  # a first policy, for the example


def fractions(robot: Robot, x: Tensor) -> Tensor:
    """Velocities over their limits."""
    return x / torch.tensor(velocities(robot), dtype=x.dtype)


def tip(now: Situation) -> Tensor:
    """Position of the end effector [N, 3] in the base frame [m]."""
    return torchdq.dq.translation(torchdq.forward_kinematics(now.robot, now.q, now.robot.end_effector().name))


def turns(now: Situation) -> Tensor:
    """Sine and cosine of revolute joints, position of prismatic ones."""
    columns = []
    for joint, x in zip(now.robot.joint_types, now.q.unbind(1), strict=True):
        columns += [x] if joint.slides else [x.sin(), x.cos()]
    return torch.stack(columns, 1)


def reference(now: Situation, order: int) -> Tensor:
    """Position of the reference [N, n] of `Track`, its velocity (order 1) or acceleration (order 2)."""
    waves = now.goal.unflatten(1, (now.robot.n, 7))
    found = waves[:, :, 0] if order == 0 else 0.0
    for k in (1, 4):
        amplitude, rate, phase = waves[:, :, k : k + 3].unbind(-1)
        found = found + amplitude * rate**order * torch.sin(rate * now.time + phase + order * torch.pi / 2)
    return found


COMMON = {
    "clipped": "number of entries of the action that were outside [-1, 1]",
    "nonfinite": "true if the simulation failed in this step",
}
FIRST = {"v0": "first version"}

ENVIRONMENTS: dict[str, Environment] = {
    "reach": Environment(
        Reach,
        (
            Entries(
                "sine and cosine of each revolute joint, in turn; of a prismatic joint its position [m]", "1", turns
            ),
            Entries("velocity of each joint over its limit", "1", lambda now: fractions(now.robot, now.qd)),
            Entries(
                "vector from the end effector to the goal, x y z in the base frame",
                "m",
                lambda now: now.goal - tip(now),
            ),
            Entries("position of the end effector, x y z in the base frame", "m", tip),
        ),
        {
            **COMMON,
            "distance": "of the end effector from the goal, true and not measured [m]",
            "success": "1 where the distance is at most 0.05 m, otherwise 0",
        },
        FIRST,
        "reference",
    ),
    "track": Environment(
        Track,
        (
            Entries("reference less position of each joint", "rad or m", lambda now: reference(now, 0) - now.q),
            Entries("velocity of each joint over its limit", "1", lambda now: fractions(now.robot, now.qd)),
            Entries("position of the reference", "rad or m", lambda now: reference(now, 0)),
            Entries(
                "velocity of the reference over the limit", "1", lambda now: fractions(now.robot, reference(now, 1))
            ),
            Entries(
                "acceleration of the reference over the limit of the velocity",
                "1/s",
                lambda now: fractions(now.robot, reference(now, 2)),
            ),
        ),
        {**COMMON, "error": "root mean square error of the positions, true and not measured [rad or m]"},
        FIRST,
        "residual",
    ),
}
