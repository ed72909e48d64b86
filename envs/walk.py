"""Task of a quadruped that walks: it follows commanded velocities on a ground that differs from episode to episode."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchdq import effects
from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number
from torchdq.base.checks import matching
from torchdq.dynamics.posed import Row
from torchdq.dynamics.tree import BASE
from torchdq.envs.pushes import Pushes
from torchdq.envs.tasks import EpisodeTask, within
from torchdq.errors import ArgumentError
from torchdq.functions.posed import posed
from torchdq.functions.posed import frame as frame_of
from torchdq.numbers.functions import at_least, below, exp, maximum, sqrt
from torchdq.robot import ContactPoint, Robot
from torchdq.scene.free_base import START
from torchdq.scene.spec import Rows, View

FULL = 1.5  # full action, an offset of a servo's target [rad]
STAND = {"?L_hip_joint": 0.1, "?R_hip_joint": -0.1, "F?_thigh_joint": 0.8, "R?_thigh_joint": 1.0, "*_calf_joint": -1.5}
SOFT, LAG = 0.6, 40.0  # gains of the servos: kp in m g times the height of the base per rad, and kp / kd [1/s]
ROTOR = 0.01  # rotor inertia where the description has none [kg m^2]
STEEPEST = 0.6  # cosine of the largest tilt, 53 degrees
CROUCH = 0.88  # desired height of the base, in heights of the start
SHARP = 0.1  # squared error of a velocity at which its reward falls to 1/e [m^2/s^2, rad^2/s^2]
STRIDE = 0.3  # time in the air from which a step is rewarded [s]
SEEN = {"v": 2.0, "w": 0.25, "qd": 0.05, "action": 6.0}  # factors of observed numbers
WIDEST = 20.0  # bound of observed numbers

# weights of the terms of the reward, per second
WEIGHTS = {
    "velocity": 1.5,  # exp(-(squared error of the velocity) / 0.1)
    "turning": 0.5,  # the same of the yaw rate
    "air_time": 1.0,  # time of every step in the air beyond 0.3 s, once as it lands
    "vertical": -2.0,  # squared vertical velocity [m/s]
    "rocking": -0.05,  # squared rates of roll and pitch [rad/s]
    "tilt": -2.0,  # squared sine of the tilt
    "height": -20.0,  # squared deviation of the height [m]
    "hips": -0.1,  # squared deviation from the stand of the joints that the base carries [rad]
    "torque": -2e-4,  # squared torques [N m]
    "acceleration": -2.5e-7,  # squared accelerations of the joints [rad/s^2]
    "action_rate": -0.36,  # squared change of the actions
}


@dataclass(frozen=True)
class Walk(EpisodeTask):
    """Follow a commanded velocity of the base on feet, from a stand with random joint positions and velocities.

    Goal: forward and sideways velocity [m/s] and yaw rate [rad/s] of the base. Actions: offsets of the targets of the
    joints' servos from the stand, full ones 1.5 rad. Observation: velocity and angular velocity of the base, the
    direction of gravity, and the goal, in axes of the base; offsets of the joints from the stand, their velocities, and
    the last action. Reward: the sum of the terms in `WEIGHTS`, which `info` has one by one, over the step, and at least
    zero. The episode ends where the base tilts by more than 53 degrees or sinks below `lowest`, or where a frame of
    `fatal` touches the ground.

    By default the ground's friction is 0.36 to 1.24 and its stiffness differs by a factor of ten, masses differ by up
    to 10 %, and the base is pushed.

    Args:
        forward, sideways: least and largest commanded velocity [m/s].
        turning: least and largest commanded yaw rate [rad/s].
        stand: position of joints at the stand, by names and patterns; others are at zero [rad].
        feet: names or patterns of the frames that touch the ground, as `effects.Contact` takes them.
        fatal: those whose touch ends the episode, among the points of the scene's contacts.
        lowest: height of the base at which the episode ends, in heights of the stand.
        weights: weights that replace those of `WEIGHTS`.

    >>> from torchdq.envs import ArmVectorEnv
    >>> from torchdq.envs.walk import Walk
    >>> envs = ArmVectorEnv(64, Walk(forward=(0.0, 1.0)), "go2", max_episode_steps=1000)
    """

    forward: tuple[float, float] = (0.4, 1.1)
    sideways: tuple[float, float] = (0.0, 0.0)
    turning: tuple[float, float] = (-1.0, 1.0)
    stand: Any = tuple(STAND.items())
    feet: Any = "*_foot"
    fatal: Any = ()
    lowest: float = 0.5
    weights: Any = ()

    def __post_init__(self) -> None:
        for name in ("stand", "weights"):  # hashable
            object.__setattr__(self, name, tuple(dict(getattr(self, name)).items()))
        if unknown := dict(self.weights).keys() - WEIGHTS.keys():
            raise ArgumentError(f"weights of Walk must be among {', '.join(WEIGHTS)}, found {', '.join(unknown)}")

    # --- environment ---

    def defaults(self, robot: Robot) -> Mapping[str, Any]:
        """Arguments of environments: servos that hold the robot's weight, contact, and what is random."""
        mass = float(robot.mass.sum() + robot.base_mass)
        weight = 9.81 * mass
        kp = SOFT * weight * self.start_height(robot)
        effort = robot.limits.effort
        push = effects.Push(next(frame.name for frame in robot.frames if frame.link == BASE))
        return {
            "effects": (
                effects.Gravity(),
                effects.RotorInertia(ROTOR if robot.armature is None else None),
                effects.Servo(kp, kp / LAG, limit=effort.where(effort > 0, math.inf).tolist()),
                effects.Contact(self.feet),
                push,
            ),
            "scale": FULL,
            "substeps": 4,
            "randomise": {"Contact.friction": (0.45, 1.55), "Contact.stiffness": (0.2, 2.0), "mass": 0.1},
            "pushes": {push.name: Pushes((0.3 * weight, 0.3 * weight, 0.0, 0.0, 0.0, 0.0))},
        }

    def joints(self, robot: Robot) -> list[float]:
        """Joint positions at the stand [rad]."""
        found = dict.fromkeys(robot.joint_names, 0.0)
        for pattern, angle in self.stand:
            found |= dict.fromkeys(matching("stand", pattern, robot.joint_names, "joint"), float(angle))
        return list(found.values())

    def height(self, robot: Robot, points: Sequence[ContactPoint], q: Row) -> Number:
        """Height of a level base whose lowest point touches a plane [m]."""
        at, lowest = posed(robot, q, {}, (), (START[:4], START[4:])), None
        for point in points:
            link, X_BF = frame_of(robot, point.frame)
            X_BP = dq.mul(X_BF, dq.from_pose((1.0, 0.0, 0.0, 0.0), point.center))
            depth = point.radius - at.position(link, at.point(link, X_BP).position)[2]
            lowest = depth if lowest is None else maximum(lowest, depth)
        return lowest

    def start_height(self, robot: Robot) -> float:
        """Height of the base at the stand [m]."""
        return float(self.height(robot, _points(self.feet, robot), self.joints(robot)))

    # --- task ---

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of the inputs: the command, the action, and last action, velocities, and times in the air."""
        return {"goal": 3, "action": n, "carry": 2 * n + 4}

    def draws(self, robot: Robot) -> int:
        """Number of random numbers that an episode starts from."""
        return robot.n + 9

    def start(self, robot: Robot, u: Row) -> Rows:
        """Start near the stand, the lowest foot on the ground, in slow motion, and a command."""
        n = robot.n
        q = [x + 0.1 * (2.0 * y - 1.0) for x, y in zip(self.joints(robot), u[:n], strict=True)]
        z = self.height(robot, _points(self.feet, robot), q)
        goal = [a + (b - a) * y for (a, b), y in zip((self.forward, self.sideways, self.turning), u[n + 6 :], strict=True)]
        return {
            "q": q,
            "qd": [0.0] * n,
            "X_WB": [*START[:4], 0.0, 0.0, 0.0, 0.5 * z],
            "V_WB_B": [0.4 * y - 0.2 for y in u[n : n + 6]],
            "goal": goal,
        }

    def bounds(self, robot: Robot) -> list[tuple[float, float]]:
        """Bounds of the observation."""
        return [(-WIDEST, WIDEST)] * (12 + 3 * robot.n)

    def rows(self, view: View) -> Rows:
        """Rows as the class states them."""
        n, robot = len(view.q), view.scene.spec.robot
        goal, down, v, w = view.inputs["goal"], _down(view), view.V_WB_B[3:], view.V_WB_B[:3]
        action = view.inputs.get("action", [0.0] * n)
        carry = view.inputs.get("carry", [0.0] * (2 * n + 4))
        touching, fatal = self._touching(view)
        off = [x - y for x, y in zip(view.reading[:n], self.joints(robot), strict=True)]
        observation = [
            *(SEEN["v"] * x for x in v),
            *(SEEN["w"] * x for x in w),
            *down,
            *(SEEN["v"] * x for x in goal[:2]),
            SEEN["w"] * goal[2],
            *off,
            *(SEEN["qd"] * x for x in view.reading[n:]),
            *(SEEN["action"] * x for x in action),
        ]
        terms, air = self._terms(view, goal, down, action, carry, touching)
        weights = {**WEIGHTS, **dict(self.weights)}
        weighted = {name: weights[name] * x for name, x in terms.items()}
        error = sqrt((v[0] - goal[0]) * (v[0] - goal[0]) + (v[1] - goal[1]) * (v[1] - goal[1]) + 1e-12)
        low = at_least(self.lowest * self._standing(view), _height(view))
        ended = maximum(maximum(low, at_least(down[2], -STEEPEST)), fatal)
        return {
            "observation": within(observation, self.bounds(robot)),
            "reward": [view.scene.spec.dt * maximum(sum(weighted.values(), 0.0), 0.0)],
            "reference": [*self.joints(robot), *[0.0] * (2 * n)],
            "carry": [*action, *view.qd, *air],
            "terminated": [ended],
            "speed_error": [error],
            "touching": touching,
            **{name: [x] for name, x in weighted.items()},
        }

    def _terms(
        self, view: View, goal: Row, down: Row, action: Row, carry: Row, touching: Row
    ) -> tuple[dict[str, Number], list[Number]]:
        """Terms of the reward without their weights, and the times of the feet in the air."""
        n, robot, dt = len(view.q), view.scene.spec.robot, view.scene.spec.dt
        v, w, (last, before, air) = view.V_WB_B[3:], view.V_WB_B[:3], (carry[:n], carry[n : 2 * n], carry[2 * n :])
        hips = [i for i, parent in enumerate(robot.parents) if parent < 0]
        off = [view.q[i] - self.joints(robot)[i] for i in hips]
        landed = [(t + dt - STRIDE) * on * below(0.0, t) for t, on in zip(air, touching, strict=True)]
        terms = {
            "velocity": exp(_squares([v[0] - goal[0], v[1] - goal[1]]) * (-1.0 / SHARP)),
            "turning": exp(_squares([w[2] - goal[2]]) * (-1.0 / SHARP)),
            "air_time": sum(landed, 0.0),
            "vertical": v[2] * v[2],
            "rocking": _squares(w[:2]),
            "tilt": _squares(down[:2]),
            "height": _squares([_height(view) - CROUCH * self._standing(view)]),
            "hips": _squares(off),
            "torque": _squares(_torques(view)),
            "acceleration": _squares([(a - b) * (1.0 / dt) for a, b in zip(view.qd, before, strict=True)]),
            "action_rate": _squares([a - b for a, b in zip(action, last, strict=True)]),
        }
        return terms, [(t + dt) * (1.0 - on) for t, on in zip(air, touching, strict=True)]

    def _standing(self, view: View) -> float:
        """Height of the base at the stand [m]."""
        robot = view.scene.spec.robot
        return self.height(robot, [p for p in _all_points(view) if p.frame in self._frames(view)], self.joints(robot))

    def _frames(self, view: View) -> list[str]:
        """Names of the four feet."""
        return list(dict.fromkeys(p.frame for p in _points(self.feet, view.scene.spec.robot)))

    def _touching(self, view: View) -> tuple[list[Number], Number]:
        """Whether every foot touches the ground, 1 or 0, and whether something does that must not."""
        found = dict.fromkeys(self._frames(view), 0.0)
        names = view.scene.spec.robot.frame_names
        fatal, ended = matching("fatal", self.fatal, names, "frame") if self.fatal else (), 0.0
        for point, contact in zip(_all_points(view), view.contacts, strict=True):
            if point.frame in found:
                found[point.frame] = maximum(found[point.frame], contact.touching)
            if point.frame in fatal:
                ended = maximum(ended, contact.touching)
        return list(found.values()), ended


def _points(feet: Any, robot: Robot) -> tuple[ContactPoint, ...]:
    """Contact points of the feet; raises unless there are four feet."""
    found = effects.Contact(feet).described(robot).points
    if (number := len({point.frame for point in found})) != 4:
        raise ArgumentError(f"feet of Walk must be four frames of robot {robot.name!r}, found {number}")
    return found


def _all_points(view: View) -> list[ContactPoint]:
    """Points of all contacts of a scene."""
    return [p for effect in view.scene.spec.effects if isinstance(effect, effects.Contact) for p in effect.points]


def _down(view: View) -> Row:
    """Direction of gravity in axes of the base."""
    return quat.rotate(quat.conj(view.X_WB[:4]), (0.0, 0.0, -1.0))


def _height(view: View) -> Number:
    """Height of the base [m]."""
    return dq.translation((view.X_WB[:4], view.X_WB[4:]))[2]


def _torques(view: View) -> list[Number]:
    """Torques of actuators and servos."""
    found = list(view.torque)
    for effect in view.scene.spec.effects:
        if isinstance(effect, effects.Servo) and "target" in view.inputs:
            impedances = effect.impedances_at_end(view.q, view.qd, view.inputs, (), 0.0)
            found = [t - z.force - z.damping * x for t, z, x in zip(found, impedances, view.qd, strict=True)]
    return found


def _squares(row: Row) -> Number:
    return sum((x * x for x in row), 0.0)
