"""Observations of the registered environments, entry by entry, with the quantities themselves for comparison in tests.

The name of a task is the one under which `torchdq.envs` registers it, in small letters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

import torchdq
from torchdq.effects.contact import Contacts
from torchdq.envs.actions import HORIZON
from torchdq.envs.manipulation import Lift, Manipulation, Pick, Push
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
    touching: Sequence[tuple[str, str]]  # what touches what, of each of them
    state: Mapping[str, Tensor]  # everything else


class Entries(NamedTuple):
    """Neighbouring entries of an observation."""

    what: str
    unit: str
    value: Callable[[Situation], Tensor]  # [N, entries]


class Reward(NamedTuple):
    """A reward that has no formula in the docstring of its task."""

    words: str
    value: Callable[[Situation], Tensor]  # [N]


MOMENTS = (0, 15, 30, 60, 150)  # of the picture, in steps
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
    about: tuple[str, ...] = ()  # further sentences on the task
    reward: Reward | None = None
    policy: Callable[[Situation], Tensor] | None = None  # actions [N, n] of the picture; None: none
    moments: tuple[int, ...] = MOMENTS


def fractions(robot: Robot, x: Tensor) -> Tensor:
    """Velocities over their limits."""
    return x / torch.tensor(velocities(robot), dtype=x.dtype)


def tip(now: Situation) -> Tensor:
    """Position of the end effector [N, 3] in the base frame [m]."""
    return torchdq.dq.translation(torchdq.forward_kinematics(now.robot, now.q, now.robot.end_effector().name))


def resolved(now: Situation, way: Tensor) -> Tensor:
    """Displacements of the joints [N, n] along a way of the end effector, by the damped inverse of the Jacobian."""
    J = torchdq.jacobian(now.robot, now.q, now.robot.end_effector().name, expressed="world")[:, 3:]
    return (J.mT @ torch.linalg.solve(J @ J.mT + 0.05**2 * torch.eye(3).to(J), way[:, :, None]))[:, :, 0]


def towards(now: Situation) -> Tensor:
    """Actions that move the end effector towards the goal."""
    return (resolved(now, now.goal - tip(now)) / (HORIZON * torch.tensor(velocities(now.robot)))).clamp(-1.0, 1.0)


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


# --- objects ---------------------------------------------------------------------------------------------------------

HOME = Manipulation().home
REST = 0.02  # height of the cube on the table, its half [m]
HELD = 0.5  # normal force of a finger in a grasp [N]
FULL = 0.1  # full action of a joint of the arm [rad]
STIFF = 1000.0  # of the servos of the arm [N m/rad]
CLOSE, FAR, QUICK = 0.012, 0.04, 2.0  # distance at which fingers close, longest way [m], and gain of the policies


def hand(now: Situation, q: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Position [N, 3] and rotation matrix [N, 3, 3] of the tip."""
    X = torchdq.forward_kinematics(now.robot, now.q if q is None else q, now.robot.end_effector().name)
    T = torchdq.dq.to_matrix(X)
    return T[..., :3, 3], T[..., :3, :3]


def thing(now: Situation) -> tuple[Tensor, Tensor]:
    """Position [N, 3] and rotation matrix [N, 3, 3] of the object."""
    T = torchdq.dq.to_matrix(now.state["poses"])
    return T[:, :3, 3], T[:, :3, :3]


def turned(now: Situation, part: slice) -> Tensor:
    """Part of the twist of the object [N, 3] in world axes."""
    return (thing(now)[1] @ now.state["twists"][:, part, None])[:, :, 0]


def pressing(now: Situation) -> Tensor:
    """1 for each finger that presses on the object, otherwise 0, [N, fingers]."""
    fingers = list(dict.fromkeys(frame for frame, on in now.touching if on == "cube"))
    forces = [[k for k, pair in enumerate(now.touching) if pair == (finger, "cube")] for finger in fingers]
    return torch.stack([now.contacts.normal_force[:, own].sum(1) >= HELD for own in forces], 1).to(now.q)


def pushed(now: Situation) -> Tensor:
    """Reward of `Push`."""
    (p, _), (at, _) = thing(now), hand(now)
    behind = (at - p + p.new_tensor([REST + 0.015, 0.0, 0.0])).norm(dim=1)
    away = (p - now.goal)[:, :2].norm(dim=1)
    reached = 1 - (5 * behind).tanh() + (behind <= 0.03) * (1 - (5 * away).tanh())
    return torch.where((away <= 0.1) & (p[:, 2] <= REST + 0.01), 3 - (10 * away).tanh(), reached) / 3


def carried(there: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Situation], Tensor]:
    """Reward of `Lift` and `Pick`; `there` says of positions of object and goal whether that is success."""

    def value(now: Situation) -> Tensor:
        (p, _), (at, _), grasped = thing(now), hand(now), pressing(now).prod(1)
        near, away, still = (x.norm(dim=1) for x in (at - p, now.goal - p, now.qd[:, :7]))
        reward = 1 - (5 * near).tanh() + grasped * (2 - (5 * away).tanh())
        return (reward + there(p, now.goal) * grasped * (2 - (5 * still).tanh())) / 5

    return value


def moving(now: Situation, way: Tensor, opening: Tensor) -> Tensor:
    """Actions that hold the arm, move the tip along a way, and open the gripper, [N] in [-1, 1]."""
    way = way * (FAR / way.norm(dim=1, keepdim=True)).clamp(max=1.0)
    move = resolved(now, way)[:, :-1]
    weight = torchdq.inverse_dynamics(now.robot, now.q, 0 * now.q, 0 * now.q)[:, :-1] / STIFF
    return torch.cat([(weight + QUICK * move) / FULL, opening[:, None]], 1).clamp(-1.0, 1.0)


def grasping(now: Situation) -> Tensor:
    """Actions that grasp the object and carry it to the goal."""
    (p, _), (at, _), held = thing(now), hand(now), pressing(now).prod(1) > 0
    near = (p - at).norm(dim=1) < CLOSE
    way = torch.where(held[:, None], now.goal - p, p - at)
    return moving(now, way, torch.where(held | near, -1.0, 1.0).to(p))


def pushing(now: Situation) -> Tensor:
    """Actions that take the tip down behind the object, and then ahead."""
    (p, _), (at, _) = thing(now), hand(now)
    way = p - p.new_tensor([REST + 0.03, 0.0, -0.02]) - at
    ahead = torch.cat([(now.goal - p)[:, :1].clamp(max=FAR), way[:, 1:]], 1)
    return moving(now, torch.where(way[:, 2:].abs() < FAR, ahead, way), -torch.ones_like(p[:, 0]))


SEEN = (
    Entries("position of each joint less that of the start", "rad or m", lambda now: now.q - now.q.new_tensor(HOME)),
    Entries("velocity of each joint", "5 rad/s or m/s", lambda now: now.qd / 5),
    Entries("vector from the tip to the object", "0.1 m", lambda now: 10 * (thing(now)[0] - hand(now)[0])),
    Entries(
        "position of the object from the point on the table below the tip at a start",
        "0.2 m",
        lambda now: 5 * (thing(now)[0] - hand(now, now.q.new_tensor(HOME))[0] * now.q.new_tensor([1.0, 1.0, 0.0])),
    ),
    Entries("x and y axis of the object", "1", lambda now: thing(now)[1][:, :, :2].mT.flatten(1)),
    Entries("vector from the object to the goal", "0.2 m", lambda now: 5 * (now.goal - thing(now)[0])),
    Entries("velocity of the object", "2 m/s", lambda now: turned(now, slice(3, 6)) / 2),
    Entries("angular velocity of the object", "10 rad/s", lambda now: turned(now, slice(0, 3)) / 10),
    Entries("x and z axis of the tip", "1", lambda now: hand(now)[1][:, :, ::2].mT.flatten(1)),
    Entries("height of the tip above 0.1 m", "0.1 m", lambda now: 10 * hand(now)[0][:, 2:] - 1),
    Entries("1 for each finger that presses on the object by 0.5 N or more, otherwise 0", "1", pressing),
)


CARRIED = (
    "A fifth of a sum: 1 - tanh(5 b), with the distance b of the tip from the object [m]; in a grasp 2 - tanh(5 d), "
    "with the distance d of the object from the goal; and on success 2 - tanh(5 v), with the size v of the velocities "
    "of the arm's joints [rad/s]."
)


def handled(
    task: type[Manipulation],
    about: str,
    success: str,
    reward: Reward,
    policy: Callable[[Situation], Tensor],
) -> Environment:
    """Environment of an arm with a gripper."""
    return Environment(
        task,
        SEEN,
        {**COMMON, "distance": "of the object from the goal [m]", "success": f"1 where {success}, otherwise 0"},
        FIRST,
        "target",
        "panda_hand",
        "gravity, rotors, servos, contact of the fingers with the object, and of the object and the fingers with the "
        "table",
        (
            "## Another object, another arm",
            "[A robot with hands](../guides/hands.md#another-object-another-arm) puts an object and an arm of your own "
            "into the task, and `examples/31_hands_ppo.py` learns it.",
        ),
        about=(
            about,
            "The object is a cube of 0.1 kg with edges of 0.04 m, on the table z = 0. Masses differ by 30 %, sizes by "
            "10 %, each friction by 30 %. The last joint is the opening of the gripper, which is half without an "
            "action. Targets of the arm are offsets from its measured positions: without an action it sinks slowly.",
        ),
        reward=reward,
        policy=policy,
        moments=(0, 10, 20, 30, 49),
    )


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
        policy=towards,
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
        "if the base tilts by more than 53 degrees or sinks below half its height, another contact point touches (by "
        "default there is none), or the simulation failed",
        about=(
            "[A robot with feet](../guides/legs.md#learn-to-walk) learns it, and tests the policy in MuJoCo.",
            "The observation has the linear velocity of the base, which no sensor of a real Go2 measures: on hardware "
            "it comes from a state estimator. "
            '`TorchTask("walk", observation=..., bounds=...)` is the task with another observation.',
        ),
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
    "push": handled(
        Push,
        "The goal is 0.2 m ahead of the object, along x, and the gripper is closed at the start.",
        "the object is within 0.1 m of the goal, along the table, and at most 0.01 m above it",
        Reward(
            "On success (3 - tanh(10 d)) / 3, with the distance d from the goal along the table [m]. Until then (1 - "
            "tanh(5 b)) / 3, with the distance b of the tip from the point 0.035 m behind the object, and where b is "
            "at most 0.03 m, (1 - tanh(5 d)) / 3 more.",
            pushed,
        ),
        pushing,
    ),
    "lift": handled(
        Lift,
        "The goal is 0.1 m above the object. Success is less: 0.04 m above its place on the table, in a grasp.",
        "the object is 0.04 m or more above its place on the table, and all fingers press on it",
        Reward(CARRIED, carried(lambda p, goal: p[:, 2] >= REST + 0.04)),
        grasping,
    ),
    "pick": handled(
        Pick,
        "The goal is 0.04 to 0.3 m above the table, above the square in which objects start.",
        "the object is within 0.025 m of the goal, and all fingers press on it",
        Reward(CARRIED, carried(lambda p, goal: (goal - p).norm(dim=1) <= 0.025)),
        grasping,
    ),
}
