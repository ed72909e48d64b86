"""Observations of the registered environments, entry by entry, with the quantities themselves for comparison in tests.

The name of a task is the one under which `torchdq.envs` registers it, in small letters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

import torchdq
from torchdq.effects.contact import Contacts
from torchdq.envs.tasks import EpisodeTask, Reach, Track, velocities
from torchdq.envs.walk import WEIGHTS, Walk
from torchdq.envs.wipe import Wipe
from torchdq.robot import Robot
from torchdq.scene.defaults import DAMPING, ROTOR


class Situation(NamedTuple):
    """Environments at one moment."""

    robot: Robot
    q: Tensor  # [N, n] as measured
    qd: Tensor
    goal: Tensor  # of the task
    time: float  # since the start of the episode [s]
    contacts: Contacts | None  # of the scene, where it has some
    state: Mapping[str, Tensor]  # everything else


class Entries(NamedTuple):
    """Neighbouring entries of an observation."""

    what: str
    unit: str
    value: Callable[[Situation], Tensor]  # [N, entries]


ABSENT = f"Missing ones are {ROTOR:g} kg m^2 for rotors and {DAMPING:g} N m s/rad for damping"


class Environment(NamedTuple):
    """A registered environment as its page shows it."""

    task: type[EpisodeTask]
    observation: tuple[Entries, ...]
    info: Mapping[str, str]
    versions: Mapping[str, str]
    hint: str  # a first policy, for the example
    other: str = "ur10e"  # robot of the example
    effects: str = f"those of a typical arm, with the parameters of its description. {ABSENT}"
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
    x, y, a, b, ratio, rate, _ = now.goal.unbind(1)
    turned = (now.goal.new_tensor([0.0, -1.0]), now.goal.new_tensor([1.0, 0.0]))
    first = torch.stack([a, b], 1)
    other = torch.stack([first @ axis for axis in turned], 1) * ratio[:, None]
    phase = (rate * now.time + order * torch.pi / 2)[:, None]
    moved = rate[:, None] ** order * (first * torch.cos(phase) + other * torch.sin(phase))
    if order:
        return torch.cat([moved, 0 * moved[:, :1]], 1)
    return torch.cat([torch.stack([x, y], 1) - first + moved, 0 * moved[:, :1] + Wipe().table(now.robot)], 1)


def walked(name: str, value: Callable[[Situation], Tensor]) -> Callable[[Situation], Tensor]:
    """Observed entries of `Walk`, of the quantity itself."""
    return lambda now: Walk.SEEN[name] * value(now)


def offsets(now: Situation) -> Tensor:
    """Positions of the joints less those of the stand."""
    return now.q - torch.tensor(Walk().joints(now.robot), dtype=now.q.dtype)


def down(now: Situation) -> Tensor:
    """Direction of gravity in axes of the base."""
    return torchdq.dq.rotate(torchdq.dq.conj(now.state["X_WB"][:, :4]), now.q.new_tensor([0.0, 0.0, -1.0]))


def tip_velocity(now: Situation) -> Tensor:
    """Velocity of the end effector [N, 3] in base axes."""
    J = torchdq.jacobian(now.robot, now.q, now.robot.end_effector().name, expressed="world")[:, 3:]
    return (J @ now.qd[:, :, None])[:, :, 0]


COMMON = {
    "clipped": "number of entries of the action that were outside [-1, 1]",
    "nonfinite": "true if the simulation failed in this step",
}
FIRST = {"v0": "first version"}

TERMS = {  # of the reward of `Walk`
    "velocity": "exp(-x / 0.25), x the squared error of the velocity [m^2/s^2]",
    "turning": "exp(-x / 0.25), x the squared error of the yaw rate [rad^2/s^2]",
    "air_time": "the time that each foot was in the air beyond 0.3 s, once as it lands [s]",
    "vertical": "the squared vertical velocity [m/s]",
    "rocking": "the squared rates of roll and pitch [rad/s]",
    "tilt": "the squared sine of the tilt",
    "height": "the squared deviation of the height [m]",
    "hips": "the squared deviations from the stand of the joints that the base carries [rad]",
    "torque": "the squared torques, over the weight times the height of the base",
    "acceleration": "the squared accelerations of the joints [rad/s^2]",
    "action_rate": "the squared changes of the actions",
}

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
    "walk": Environment(
        Walk,
        (
            Entries("velocity of the base", "0.5 m/s", walked("velocity", lambda now: now.state["V_WB_B"][:, 3:])),
            Entries("commanded velocity, x y", "0.5 m/s", walked("velocity", lambda now: now.goal[:, :2])),
            Entries("angular velocity of the base", "4 rad/s", walked("rate", lambda now: now.state["V_WB_B"][:, :3])),
            Entries("commanded yaw rate", "4 rad/s", walked("rate", lambda now: now.goal[:, 2:])),
            Entries("direction of gravity in axes of the base", "1", walked("down", down)),
            Entries("position of each joint less that of the stand", "rad", walked("offset", offsets)),
            Entries("velocity of each joint", "20 rad/s", walked("speed", lambda now: now.qd)),
            Entries(
                "last action, in full ones", "1/6", walked("action", lambda now: now.state["carry"][:, : now.robot.n])
            ),
        ),
        {
            **COMMON,
            "speed_error": "size of the error of the velocity [m/s]",
            "touching": "1 for each foot that touches the ground, otherwise 0",
            **{name: f"{WEIGHTS[name]:g} times {words}" for name, words in TERMS.items()},
        },
        FIRST,
        "target",
        "go2",
        "gravity, rotors, servos, contact of the feet, and a push on the base",
        (),
        "if the base tilts by more than 53 degrees or sinks below half its height, or the simulation failed",
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
        f"those of a typical arm and a table, with the parameters of its description. {ABSENT}",
        (
            "## A policy of a few lines",
            "[`examples/26_wipe.py`](../../examples/26_wipe.py) shifts the reference by the error of the path and by "
            "the integral of the error of the force, and pushes against the friction of an average table. From two "
            "seconds on, the force is within 10 % of the commanded one, and friction within 1 % of its coefficient "
            "times the normal force; over eight seeds, each of 256 tables, 5.1 % and 0.80 % were the largest.",
        ),
        "if the end effector is 0.1 m from the path, the force above 100 N, or the simulation failed",
    ),
}
