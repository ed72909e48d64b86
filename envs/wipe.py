"""Task of an arm that wipes: it presses on a table with a commanded force and follows a path."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torchdq import effects
from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number, Pure
from torchdq.dynamics import ltdl
from torchdq.dynamics.posed import Row
from torchdq.envs.randomization import Absolute
from torchdq.envs.tasks import EpisodeTask, cost, home_of, seen, seen_bounds, tip, within
from torchdq.functions.posed import frame, posed
from torchdq.numbers.functions import absolute, at_least, maximum, minimum, sqrt
from torchdq.robot import Robot
from torchdq.scene.defaults import default_effects
from torchdq.scene.spec import Rows, View

__all__ = ["Wipe"]

HOME = (-0.1016, 0.1599, 0.0994, -2.3987, -0.0287, 2.5576, 0.0205)  # tool of the Panda 0.25 m above its base, downwards
AROUND = 0.05  # starts are so far from home, along x and y [m]
ABOVE = 0.02  # and so far above the table [m]
SIZE, SPEED, FORCE = (0.03, 0.08), (0.05, 0.15), (5.0, 20.0)  # ranges of half axes [m], speeds [m/s] and forces [N]
RATIO = (0.5, 1.0)  # range of the second axis over the first; sliding turns by at most 0.1 rad per substep
LANDING = 0.5  # time in which the reference comes down [s]
CLOSE, TIGHT = 0.01, 0.2  # distance [m] and share of the force at which half of each part of the reward is earned
FAR, CRUSHED = 0.1, 100.0  # distance [m] and force [N] that end an episode
FASTEST = 2.0  # bound of the observed velocity of the tool [m/s]
DAMPING = 1e-4  # of the inverse kinematics, squared [m^2]


@dataclass(frozen=True)
class Wipe(EpisodeTask):
    """Press on a table with a commanded force, and follow a path on it with the end effector, from just above it.

    Goal: start of an ellipse (x, y) in the base frame and half of its first axis (x, y) [m], its second axis over the
    first, rate [rad/s] and normal force [N]. Reference: along this path, `press` below the table, by the inverse
    kinematics of the robot as described.

    Observation: sine and cosine of revolute joints or the position of prismatic ones, velocities as fractions of their
    limits, vector from the end effector to the point of the path on the table as described, its rate, velocity of that
    point, normal force, and the commanded one. Success: d is at most 0.01 m and e at most 0.1. The episode ends where d
    is above 0.1 m or the force above 100 N. Reward, of the true state:

        0.5 / (1 + (d / 0.01)^2) + 0.5 / (1 + (e / 0.2)^2) - 0.01 mean(action^2)

    Here d is the distance from the path along the table [m], and e the error of the force over the commanded one.

    Table: at the height of the end effector in `home`, and in every episode up to 5 mm higher or lower, with a friction
    of 0.25 to 0.75 and a stiffness of 6 to 60 kN/m, unless `randomise` says otherwise.

    Args:
        home: joint positions [rad or m], with the end effector on the table where paths are.
        press: depth of the reference below the table [m], which without a policy makes the force.

    >>> from torchdq.envs import RobotVectorEnv
    >>> envs = RobotVectorEnv(64, "wipe", "panda")
    """

    home: tuple[float, ...] = HOME
    press: float = 0.03

    def defaults(self, robot: Robot) -> Mapping[str, Any]:
        """Arguments of environments: a table, and what of it is random."""
        height = self.table(robot)
        return {
            "effects": (*default_effects(robot), effects.Contact(height=height, stiffness=2e4, friction=0.5)),
            "scale": 0.2,
            "randomise": {
                "Contact.height": Absolute(height - 0.005, height + 0.005),
                "Contact.friction": (0.5, 1.5),
                "Contact.stiffness": (0.3, 3.0),
            },
        }

    def table(self, robot: Robot) -> float:
        """Height of the table as described [m]."""
        home = home_of(self, robot, "with the end effector on the table")
        return float(tip(robot, posed(robot, home, {}, ()))[2])

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of the inputs: the goal, the action, the time, and the position of the reference."""
        return {"goal": 7, "action": n, "time": 1, "carry": n}

    def draws(self, robot: Robot) -> int:
        """Number of random numbers that an episode starts from."""
        return 7

    def start(self, robot: Robot, u: Row) -> Rows:
        """Start at rest, the end effector above the path."""
        x, y, _ = tip(robot, posed(robot, self.home, {}, ()))
        ranges = (SIZE, SPEED, FORCE, RATIO)
        size, speed, force, ratio = (a + (b - a) * s for (a, b), s in zip(ranges, u[:4], strict=True))
        angle = 2 * math.pi * u[4]
        start = (x + AROUND * (2.0 * u[5] - 1.0), y + AROUND * (2.0 * u[6] - 1.0), self.table(robot) + ABOVE)
        q: Row = self.home
        for _ in range(4):
            q = _moved(robot, q, start)
        goal = [*start[:2], size * angle.cos(), size * angle.sin(), ratio, speed / size, force]
        return {"q": q, "qd": [0.0] * robot.n, "goal": goal}

    def bounds(self, robot: Robot) -> list[tuple[float, float]]:
        """Bounds of sines, cosines and velocities, of the way to the path, and of forces."""
        return [*seen_bounds(robot), *[(-FAR, FAR)] * 3, *[(-FASTEST, FASTEST)] * 5, (0.0, CRUSHED), FORCE]

    def path(self, goal: Row, time: Number) -> tuple[Row, Row]:
        """Position and velocity of the point on the path, along x and y."""
        (x, y, a, b, ratio, rate, _), phase = goal, goal[5] * time
        c, s = phase.cos(), phase.sin()
        p = (x + a * (c - 1.0) - b * ratio * s, y + b * (c - 1.0) + a * ratio * s)
        return p, (-rate * (a * s + b * ratio * c), -rate * (b * s - a * ratio * c))

    def rows(self, view: View) -> Rows:
        """Rows as the class states them."""
        robot, n, goal, time = view.scene.spec.robot, len(view.q), view.inputs["goal"], view.inputs["time"][0]
        table, force = self.table(robot), sum((contact.normal_force for contact in view.contacts), 0.0)
        (x, y), velocity = self.path(goal, time)
        p, v = _tool(robot, view.reading[:n], view.reading[n:])
        way = quat.sub((x, y, table), p)
        seen_now = [*seen(view), *way, *quat.sub((*velocity, 0.0), v), *velocity, force, goal[6]]
        true = tip(robot, posed(robot, view.q, {}, ()))
        squared = (x - true[0]) * (x - true[0]) + (y - true[1]) * (y - true[1])
        distance, error = sqrt(squared + 1e-12), absolute(force / goal[6] - 1.0)
        before = view.inputs.get("carry", view.q)
        down = minimum(time * (1.0 / LANDING), 1.0)
        q = _moved(robot, before, (x, y, table + ABOVE - (ABOVE + self.press) * down))
        rates = [(b - a) * (1.0 / view.scene.spec.dt) for a, b in zip(before, q, strict=True)]
        parts = (1.0 + distance * distance * (1.0 / CLOSE**2), 1.0 + error * error * (1.0 / TIGHT**2))
        return {
            "observation": within(seen_now, self.bounds(robot)),
            "reward": [0.5 / parts[0] + 0.5 / parts[1] - cost(view)],
            "reference": [*q, *rates, *[0.0] * n],
            "carry": q,
            "terminated": [maximum(at_least(distance, FAR), at_least(force, CRUSHED))],
            "distance": [distance],
            "force": [force],
            "error": [error],
            "success": [at_least(0.01, distance) * at_least(0.1, error)],
        }


def _tool(robot: Robot, q: Row, qd: Row) -> tuple[Pure, Pure]:
    """Position and velocity of the end effector."""
    at = posed(robot, q, {}, ())
    v: Pure = quat.ZERO
    for column, rate in zip(_columns(robot, at), qd, strict=True):
        v = quat.add(v, quat.scale(rate, column))
    return tip(robot, at), v


def _moved(robot: Robot, q: Row, p: Pure) -> list[Number]:
    """Joint positions near q that bring the end effector to p: a step by the damped inverse of the Jacobian."""
    at = posed(robot, q, {}, ())
    columns = _columns(robot, at)
    three, damping = range(3), (DAMPING, 0.0)
    JJ = tuple(tuple(sum((c[i] * c[j] for c in columns), damping[i != j]) for j in three) for i in three)
    y = ltdl.solve((-1, 0, 1), ltdl.factorise((-1, 0, 1), JJ), quat.sub(p, tip(robot, at)))
    return [x + quat.dot(column, y) for x, column in zip(q, columns, strict=True)]


def _columns(robot: Robot, at: Any) -> list[Pure]:
    """Velocity of the end effector per velocity of each joint."""
    screws = at.jacobian(*frame(robot, robot.end_effector().name), True)
    return [quat.ZERO if one is None else one[1] for one in screws]
