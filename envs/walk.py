"""Task of a robot that walks: it follows commanded velocities on a ground that differs from episode to episode."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any, ClassVar

from torchdq import effects
from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number
from torchdq.base.checks import is_number, matching
from torchdq.dynamics.posed import Row
from torchdq.dynamics.tree import BASE
from torchdq.effects.contact import WEIGHT, moving_mass
from torchdq.envs.pushes import Pushes
from torchdq.envs.tasks import EpisodeTask, within
from torchdq.errors import ArgumentError
from torchdq.functions.posed import frame as frame_of
from torchdq.functions.posed import posed
from torchdq.numbers.functions import at_least, below, exp, maximum, sqrt
from torchdq.robot import ContactPoint, Robot
from torchdq.robot.contact_points import points_of
from torchdq.scene.free_base import START
from torchdq.scene.spec import Rows, View

__all__ = ["Walk"]

FULL = 0.9  # full action, an offset of a servo's target, in m g times the height of the base of its torque
STAND = {"?L_hip_joint": 0.1, "?R_hip_joint": -0.1, "F?_thigh_joint": 0.8, "R?_thigh_joint": 1.0, "*_calf_joint": -1.5}
SOFT, LAG = 0.6, 40.0  # gains of the servos: default stiffness, and kp / kd [1/s]
ROTOR = 0.01  # rotor inertia where the description has none [kg m^2]
STEEPEST = 0.6  # cosine of the largest tilt, 53 degrees
CROUCH = 0.88  # desired height of the base, in heights of the start
SHARP = 0.25  # squared error of a velocity at which its reward falls to 1/e [m^2/s^2, rad^2/s^2]
STRIDE = 0.3  # time in the air from which a step is rewarded [s]
AROUND, SLOW = 0.1, 0.2  # largest deviations of a start from the stand: of joints [rad], and of the twist [rad/s, m/s]
WIDEST = 20.0  # bound of observed numbers

# weights of the terms of the reward, per second
WEIGHTS = {
    "velocity": 1.5,  # exp(-(squared error of the velocity) / 0.25)
    "turning": 0.5,  # the same of the yaw rate
    "air_time": 1.0,  # time of every step in the air beyond 0.3 s, once as it lands
    "vertical": -2.0,  # squared vertical velocity [m/s]
    "rocking": -0.05,  # squared rates of roll and pitch [rad/s]
    "tilt": -2.0,  # squared sine of the tilt
    "height": -20.0,  # squared deviation of the height [m]
    "hips": -0.1,  # squared deviation from the stand of the joints that the base carries [rad]
    "torque": -0.5,  # squared torques, over m g times the height of the base
    "acceleration": -2.5e-7,  # squared accelerations of the joints [rad/s^2]
    "action_rate": -0.36,  # squared change of the actions
}


@dataclass(frozen=True)
class Walk(EpisodeTask):
    """Follow a commanded velocity of the base on feet, from a stand.

    Goal: forward and sideways velocity [m/s] and yaw rate [rad/s] of the base, drawn for every episode: 0.4 to 1.1
    m/s ahead, nothing sideways, and -1 to 1 rad/s. An action displaces the targets of the servos from the stand. A full
    one is 0.9 / `stiffness` = 1.5 rad, so that softer servos reach as much torque. Observation, in the order and with
    the factors of `SEEN`: velocity of the base and of the goal, angular velocity and yaw rate of the goal, and the
    direction of gravity, in axes of the base; offsets of the joints from the stand, their velocities, and the last
    action. Reward: the sum of the terms that `info` lists, weights included, times the step; a negative sum counts as
    zero. The argument `weights` replaces weights. End of an episode: the base tilts by more than 53 degrees or sinks
    below `lowest`, or a `fatal` point touches the ground.

    By default the ground's friction is 0.24 to 1.2 and its stiffness differs by a factor of ten, masses differ by up
    to 10 %, and every 3 to 8 s the base is pushed for 0.1 s by up to 0.3 of the weight along x and y. Only the feet
    touch the ground: knees and trunk pass through it unless `fatal` names their points.

    Args:
        forward, sideways: least and largest commanded velocity [m/s].
        turning: least and largest commanded yaw rate [rad/s].
        stand: position of joints at the stand, by names and patterns; others are at zero [rad].
        feet: names or patterns of the frames that touch the ground, as `effects.Contact` takes them; a frame is a foot.
        fatal: others that touch it, which ends the episode.
        lowest: height of the base at which the episode ends, in heights of the stand.
        stiffness: kp of the servos, in m g times the height of the base per rad; fewer than four feet need 1.5 or more.
        weights: weights that replace those of `WEIGHTS`.

    >>> from torchdq.envs import RobotVectorEnv
    >>> from torchdq.envs.walk import Walk
    >>> envs = RobotVectorEnv(64, Walk(forward=(0.0, 1.0)), "go2", max_episode_steps=1000)
    """

    POINT: ClassVar[bool] = False
    ROBOT: ClassVar[str] = "go2"
    SEEN: ClassVar[Mapping[str, float]] = {
        **{"velocity": 2.0, "rate": 0.25, "down": 1.0},
        **{"offset": 1.0, "speed": 0.05, "action": 6.0},
    }
    forward: tuple[float, float] = field(default=(0.4, 1.1), compare=False)
    sideways: tuple[float, float] = field(default=(0.0, 0.0), compare=False)
    turning: tuple[float, float] = field(default=(-1.0, 1.0), compare=False)
    stand: Any = tuple(STAND.items())
    feet: Any = "*_foot"
    fatal: tuple[Any, ...] = ()
    lowest: float = 0.5
    stiffness: float = SOFT
    weights: Any = ()

    def __post_init__(self) -> None:
        for name in ("stand", "weights"):  # hashable
            object.__setattr__(self, name, tuple(dict(getattr(self, name)).items()))
        if unknown := dict(self.weights).keys() - WEIGHTS.keys():
            raise ArgumentError(f"weights of Walk must be among {', '.join(WEIGHTS)}, found {', '.join(unknown)}")
        if not (is_number(self.stiffness) and self.stiffness > 0):
            raise ArgumentError(f"stiffness of Walk must be a number above 0, found {self.stiffness!r}")
        for name in ("forward", "sideways", "turning"):
            x = getattr(self, name)
            if not (isinstance(x, tuple) and len(x) == 2 and all(map(is_number, x)) and x[0] <= x[1]):
                raise ArgumentError(f"{name} of Walk must be (least, largest), which may be equal, found {x!r}")

    def defaults(self, robot: Robot) -> Mapping[str, Any]:
        """Arguments of environments: servos that carry the robot's weight, contact of the feet, and what is random."""
        if not robot.floating:
            raise ArgumentError(f"robot {robot.name!r} must have a floating base to walk; load it with base='floating'")
        weight, effort = WEIGHT * moving_mass(robot), robot.limits.effort
        kp = self.stiffness * weight * self.height(robot, self.joints(robot))
        push = effects.Push(next(frame.name for frame in robot.frames if frame.link == BASE))
        return {
            "effects": (
                effects.Gravity(),
                effects.RotorInertia(ROTOR if robot.armature is None else None),
                effects.Servo(kp, kp / LAG, limit=effort.where(effort > 0, math.inf).tolist()),
                effects.Contact((*self._feet(robot), *self.fatal)),
                push,
            ),
            "scale": FULL / self.stiffness,
            "substeps": 4,
            "randomise": {"Contact.friction": (0.3, 1.5), "Contact.stiffness": (0.2, 2.0), "mass": 0.1},
            "pushes": {push.name: Pushes((0.3 * weight, 0.3 * weight, 0.0, 0.0, 0.0, 0.0))},
        }

    def joints(self, robot: Robot) -> list[float]:
        """Joint positions at the stand [rad]."""
        found = dict.fromkeys(robot.joint_names, 0.0)
        for pattern, angle in self.stand:
            found |= dict.fromkeys(matching("stand", pattern, robot.joint_names, "joint"), float(angle))
        return list(found.values())

    def height(self, robot: Robot, q: Row) -> Number:
        """Height of a level base at joint positions, its lowest foot on the ground [m]."""
        at, depths = posed(robot, q, {}, (), (START[:4], START[4:])), []
        for foot in self._feet(robot):
            link, X_BF = frame_of(robot, foot.frame)
            center = at.point(link, dq.mul(X_BF, dq.from_pose(START[:4], foot.center))).position
            depths.append(foot.radius - at.position(link, center)[2])
        return reduce(maximum, depths)

    def described(self, robot: Robot) -> Walk:
        """The task with the contact points of the feet."""
        return replace(self, feet=self._feet(robot))

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of the inputs: command and action; last action and velocities, and times in the air."""
        frames = {point.frame for point in self.feet if isinstance(point, ContactPoint)}
        if not frames:
            raise ArgumentError("feet of Walk must be those of a robot; give Walk(...).described(robot)")
        return {"goal": 3, "action": n, "carry": 2 * n + len(frames)}

    def draws(self, robot: Robot) -> int:
        """Number of random numbers that an episode starts from."""
        return robot.n + 9

    def spans(self) -> Sequence[tuple[float, float]]:
        """Ranges of the command."""
        return self.forward, self.sideways, self.turning

    def start(self, robot: Robot, u: Row) -> Rows:
        """Start near the stand, a foot on the ground, in slow motion, and a command."""
        n = robot.n
        q = [x + AROUND * (2.0 * y - 1.0) for x, y in zip(self.joints(robot), u[:n], strict=True)]
        return {
            "q": q,
            "qd": [0.0] * n,
            "X_WB": [*START[:4], 0.0, 0.0, 0.0, 0.5 * self.height(robot, q)],
            "V_WB_B": [SLOW * (2.0 * y - 1.0) for y in u[n : n + 6]],
            "goal": [*u[n + 6 :]],
        }

    def bounds(self, robot: Robot) -> list[tuple[float, float]]:
        """Bounds of the observation."""
        return [(-WIDEST, WIDEST)] * (12 + 3 * robot.n)

    def rows(self, view: View) -> Rows:
        """Rows as the class states them."""
        robot, n, dt, goal = view.scene.spec.robot, len(view.q), view.scene.spec.dt, view.inputs["goal"]
        X_WB, w, v = (tuple(view.X_WB[:4]), tuple(view.X_WB[4:])), view.V_WB_B[:3], view.V_WB_B[3:]
        action, carry = (view.inputs.get(name, [0.0] * self.inputs(n)[name]) for name in ("action", "carry"))
        last, before, air = carry[:n], carry[n : 2 * n], carry[2 * n :]
        passed = dt if "carry" in view.inputs else 0.0
        stand = self.joints(robot)
        standing = self.height(robot, stand)
        down, height = quat.rotate(quat.conj(X_WB[0]), (0.0, 0.0, -1.0)), dq.translation(X_WB)[2]
        touching, fatal = self._touching(view)
        landed = [(t + dt - STRIDE) * on * below(0.0, t) for t, on in zip(air, touching, strict=True)]
        error, size = squares([v[0] - goal[0], v[1] - goal[1]]), WEIGHT * moving_mass(robot) * standing
        terms = {
            "velocity": exp(error * (-1.0 / SHARP)),
            "turning": exp(squares([w[2] - goal[2]]) * (-1.0 / SHARP)),
            "air_time": sum(landed, 0.0),
            "vertical": v[2] * v[2],
            "rocking": squares(w[:2]),
            "tilt": squares(down[:2]),
            "height": squares([height - CROUCH * standing]),
            "hips": squares([view.q[i] - stand[i] for i, parent in enumerate(robot.parents) if parent < 0]),
            "torque": squares([x * (1.0 / size) for x in self._torques(view)]),
            "acceleration": squares([(a - b) * (1.0 / dt) for a, b in zip(view.qd, before, strict=True)]),
            "action_rate": squares([a - b for a, b in zip(action, last, strict=True)]),
        }
        weights = {**WEIGHTS, **dict(self.weights)}
        weighted = {name: [weights[name] * x] for name, x in terms.items()}
        seen = {
            "velocity": [*v, *goal[:2]],
            "rate": [*w, goal[2]],
            "down": down,
            "offset": [x - y for x, y in zip(view.reading[:n], stand, strict=True)],
            "speed": view.reading[n:],
            "action": action,
        }
        observation = [self.SEEN[name] * x for name, row in seen.items() for x in row]
        low, tilted = at_least(self.lowest * standing, height), at_least(down[2], -STEEPEST)
        return {
            "observation": within(observation, self.bounds(robot)),
            "reward": [dt * maximum(sum((x for (x,) in weighted.values()), 0.0), 0.0)],
            "reference": [*stand, *[0.0] * (2 * n)],
            "carry": [*action, *view.qd, *((t + passed) * (1.0 - on) for t, on in zip(air, touching, strict=True))],
            "terminated": [reduce(maximum, [low, tilted, *fatal])],
            "speed_error": [sqrt(error + 1e-12)],
            "touching": touching,
            **weighted,
        }

    def _feet(self, robot: Robot) -> tuple[ContactPoint, ...]:
        """Contact points of the feet."""
        return points_of(robot, self.feet)

    def _touching(self, view: View) -> tuple[list[Number], list[Number]]:
        """Whether each foot touches the ground, 1 or 0, and whether each other point of the contacts does."""
        feet, others = {point.frame: 0.0 for point in self._feet(view.scene.spec.robot)}, []
        touching = view.scene.spec.touching
        if missing := sorted(feet.keys() - {frame for frame, _ in touching}):
            found = f"found none of {', '.join(missing)}; add effects.Contact({missing!r})"
            raise ArgumentError(f"effects of Walk must hold a Contact of every foot, {found}")
        for (frame, _), contact in zip(touching, view.contacts, strict=True):
            if frame in feet:
                feet[frame] = maximum(feet[frame], contact.touching)
            else:
                others.append(contact.touching)
        return list(feet.values()), others

    def _torques(self, view: View) -> list[Number]:
        """Torques of actuators and servos."""
        found = list(view.torque)
        for _, servo in view.scene.spec.of(effects.Servo) if "target" in view.inputs else ():
            impedances = servo.impedances_at_end(view.q, view.qd, view.inputs, (), 0.0)
            found = [t - z.force - z.damping * x for t, z, x in zip(found, impedances, view.qd, strict=True)]
        return found


def squares(row: Row) -> Number:
    """Sum of squares."""
    return sum((x * x for x in row), 0.0)
