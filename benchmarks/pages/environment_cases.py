"""Observations of the registered environments, entry by entry, with the quantities themselves for comparison in tests.

The name of a task is the one under which `torchdq.envs` registers it, in small letters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

import torchdq
from torchdq.envs.tasks import EpisodeTask, Reach, Track, velocities
from torchdq.envs.wipe import Wipe
from torchdq.robot import Robot
from torchdq.scene.contacts import Contacts


class Situation(NamedTuple):
    """Environments at one moment."""

    robot: Robot
    q: Tensor  # [N, n] as measured
    qd: Tensor
    goal: Tensor  # of the task
    time: float  # since the start of the episode [s]
    contacts: Contacts | None = None  # of the scene, where it has some


class Entries(NamedTuple):
    """Neighbouring entries of an observation."""

    what: str
    unit: str
    value: Callable[[Situation], Tensor]  # [N, entries]


class Environment(NamedTuple):
    """A registered environment as its page shows it."""

    task: type[EpisodeTask]
    observation: tuple[Entries, ...]
    info: Mapping[str, str]
    versions: Mapping[str, str]
    hint: str  # a first policy, for the example
    other: str = "ur10e"  # robot of the example
    also: str = ""  # default effects in addition to those of an arm
    more: tuple[str, ...] = ()  # further parts of the page
    ends: str = "only if the simulation failed: a state is non-finite, or far too large"


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


def path(now: Situation, order: int) -> Tensor:
    """Point on the path [N, 3] of `Wipe` on its table as described, or its velocity (order 1)."""
    x, y, a, b, second, rate, _ = now.goal.unbind(1)
    turned = (now.goal.new_tensor([0.0, -1.0]), now.goal.new_tensor([1.0, 0.0]))
    first = torch.stack([a, b], 1)
    other = torch.stack([first @ axis for axis in turned], 1) * (second / first.norm(dim=1))[:, None]
    phase = (rate * now.time + order * torch.pi / 2)[:, None]
    moved = rate[:, None] ** order * (first * torch.cos(phase) + other * torch.sin(phase))
    if order:
        return torch.cat([moved, 0 * moved[:, :1]], 1)
    return torch.cat([torch.stack([x, y], 1) - first + moved, 0 * moved[:, :1] + Wipe().table(now.robot)], 1)


def tip_velocity(now: Situation) -> Tensor:
    """Velocity of the end effector [N, 3] in base axes."""
    J = torchdq.jacobian(now.robot, now.q, now.robot.end_effector().name, expressed="world")[:, 3:]
    return (J @ now.qd[:, :, None])[:, :, 0]


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
    "wipe": Environment(
        Wipe,
        (
            Entries(
                "sine and cosine of each revolute joint, in turn; of a prismatic joint its position [m]", "1", turns
            ),
            Entries("velocity of each joint over its limit", "1", lambda now: fractions(now.robot, now.qd)),
            Entries(
                "vector from the end effector to the point of the path, x y z in the base frame",
                "m",
                lambda now: path(now, 0) - tip(now),
            ),
            Entries("rate of that vector", "m/s", lambda now: path(now, 1) - tip_velocity(now)),
            Entries("velocity of the point of the path, x y", "m/s", lambda now: path(now, 1)[:, :2]),
            Entries("normal force on the table", "N", lambda now: now.contacts.normal_force.sum(1, keepdim=True)),
            Entries("commanded normal force", "N", lambda now: now.goal[:, 6:]),
        ),
        {
            **COMMON,
            "distance": "of the end effector from the path, along the table, true and not measured [m]",
            "force": "normal force on the table [N]",
            "error": "of the force, as a share of the commanded one",
            "success": "1 where the distance is at most 0.01 m and the error at most 0.1, otherwise 0",
        },
        FIRST,
        "reference",
        "panda",
        "a table",
        (
            "## A policy of a few lines",
            "[`examples/25_wipe.py`](../../examples/25_wipe.py) shifts the reference by the error of the path and by "
            "the integral of the error of the force. From two seconds on, the force on circles is within 10 % of the "
            "commanded one, and friction within 1 % of its coefficient times the normal force. On lines the friction "
            "turns with the motion, and the force leaves 10 % for a twentieth of the time.",
        ),
        "if the end effector is 0.1 m from the path, the force above 100 N, or the simulation failed",
    ),
}
