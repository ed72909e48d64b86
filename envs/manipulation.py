"""Tasks of an arm with a gripper and an object on a table: push it to a place, lift it, bring it to a point.

The gripper's tip is the robot's end effector, whose z axis points out of the hand. Actions are those of servos: offsets
of the arm's targets from the measured positions, and the opening of the fingers. The rewards follow the definitions of
ManiSkill's PushCube and PickCube (S. Tao et al., "ManiSkill3", 2024) and robosuite's Lift (Y. Zhu et al., "robosuite",
2020), with sums of terms that are at most 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import mul
from typing import Any, ClassVar

from torch import Tensor

from torchdq import effects
from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.backends.choice import choose
from torchdq.backends.precision import run
from torchdq.base.checks import matching
from torchdq.dynamics.posed import Point, Posed, Row
from torchdq.envs.tasks import EpisodeTask, home_of, within
from torchdq.functions.posed import frame, posed
from torchdq.numbers.functions import at_least, sqrt, tanh
from torchdq.objects import Box, Object
from torchdq.program.program import Argument, record
from torchdq.robot import ContactPoint, Robot
from torchdq.robot.contact_points import points_of
from torchdq.scene.spec import Rows, View

__all__ = ["Lift", "Pick", "Push"]

PANDA = (0.0, 0.1125, 0.0, -2.5686, 0.0, 2.6811, 0.7854, 0.04)  # tip 0.12 m above the table, 0.45 m ahead
CUBE = Box("cube", 0.1, size=(0.04, 0.04, 0.04))
PERIOD = 0.05  # between actions [s]
STEP = 0.1  # full action of a joint of the arm [rad or m]
ROTOR = 0.01  # rotor inertia where the description has none [kg m^2 or kg]
CONTACT = 1e5  # stiffness of contacts over the mass of the object [1/s^2]
PADS, TABLE = 1.0, 0.5  # friction of the fingers, and of the table
AROUND, SPREAD = 0.02, 0.1  # largest deviations of a start: of joints [rad], of the object along x and y [m]
PRESSING = 0.5  # normal force of each finger in a grasp [N]
WIDEST = 10.0  # bound of observed numbers
NEAR = 0.03  # distance from which the tip pushes [m]
LEVEL = 0.003  # heights above the lowest point of a finger that count as lowest [m]


@dataclass(frozen=True)
class Manipulation(EpisodeTask):
    """Arm with a gripper and an object on the table z = 0; base of the tasks.

    Observation: positions of the joints from `home`, velocities, position of the object from the tip and from the place
    where objects start, two of its axes, the way from it to the goal, its velocities, two axes of the tip, its height,
    and for every finger whether it presses. The reference is the measured position of the arm, and half of the opening.

    By default masses of the object differ by 30 %, its size by 10 %, friction by 30 %.

    Args:
        object: the object; its mass, size and friction are random around what it says.
        home: positions of the joints, the tip above the place where objects start, pointing down [rad or m].
        fingers: names or patterns of the joints that open the gripper, the wider, the larger.
        pads: points of the fingers that touch the object, as `effects.Contact` takes them.
        gains: stiffness [N m/rad or N/m] and damping [N m s/rad or N s/m] of the servos; stiffer for a heavy arm.
    """

    POINT: ClassVar[bool] = True
    ROBOT: ClassVar[str] = "panda_hand"
    TURNED: ClassVar[float] = 0.0  # largest turn of the object at a start [rad]
    OPEN: ClassVar[float] = 1.0  # opening at a start, as a share of the largest

    object: Object = CUBE
    home: tuple[float, ...] = PANDA
    fingers: Any = "finger_joint*"
    pads: Any = "*_finger"
    gains: tuple[float, float] = (1000.0, 100.0)

    # --- what it consists of ---

    def objects(self, robot: Robot) -> tuple[Object, ...]:
        """The object."""
        return (self.object,)

    def defaults(self, robot: Robot) -> Mapping[str, Any]:
        """Arguments of environments: servos, contact of object, fingers and table, and what is random."""
        k, name, effort = CONTACT * float(self.object.mass), self.object.name, robot.limits.effort
        limit = effort.where(effort > 0, math.inf).tolist()
        grip = [i in self._fingers(robot) for i in range(robot.n)]
        return {
            "effects": (
                effects.Gravity(),
                effects.RotorInertia(ROTOR if robot.armature is None else None),
                effects.Viscous(),
                effects.Servo(*self.gains, limit=limit),
                effects.Contact(self.pads, on=name, friction=PADS, stiffness=k),
                effects.Contact((name,), friction=TABLE, stiffness=k),
                effects.Contact(self.lowest(robot), friction=TABLE, stiffness=k),
            ),
            "scale": [0.5 * self._open(robot) if one else STEP for one in grip],
            "dt": PERIOD,
            "substeps": 10,
            "unroll": False,
            "randomise": {
                f"{name}.mass": 0.3,
                **{f"{name}.{x}": 0.1 for x in ("size", "radius", "length") if x in self.object.SHAPES},
                **{f"Contact.{i}.friction": 0.3 for i in range(3)},
            },
        }

    def _fingers(self, robot: Robot) -> list[int]:
        """Numbers of the joints of the fingers."""
        names = matching("fingers", self.fingers, robot.joint_names, "joint")
        return [robot.joint_names.index(name) for name in names]

    def _open(self, robot: Robot) -> float:
        """Largest opening of the fingers [rad or m]."""
        return min(float(robot.limits.upper[i]) for i in self._fingers(robot))

    def _home(self, robot: Robot) -> Row:
        """Joint positions at a start."""
        return home_of(self, robot, "with the gripper open and above the table")

    def lowest(self, robot: Robot) -> tuple[ContactPoint, ...]:
        """Lowest points of the pads at a start, those that can touch the table."""
        at, heights = posed(robot, self._home(robot), {}, ()), {}
        for point in points_of(robot, self.pads):
            link, X_BF = frame(robot, point.frame)
            center = at.point(link, dq.mul(X_BF, dq.from_pose(quat.ONE, point.center))).position
            heights[point] = at.position(link, center)[2] - point.radius
        least = {x.frame: min(h for y, h in heights.items() if y.frame == x.frame) for x in heights}
        return tuple(x for x, h in heights.items() if h < least[x.frame] + LEVEL)

    def _tip(self, robot: Robot, at: Posed) -> tuple[Pure, Sequence[Pure]]:
        """Position and axes of the tip."""
        link, X_BF = frame(robot, robot.end_effector().name)
        point: Point = at.point(link, X_BF)
        return at.position(link, point.position), [at.to_world(link, e) for e in point.axes]

    def rest(self) -> float:
        """Height of the object on the table [m]."""
        return max(r - float(p[2]) for p, r in self.object.points())

    # --- episodes ---

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of the inputs: the goal [3]."""
        return {"goal": 3}

    def draws(self, robot: Robot) -> int:
        """Number of random numbers that an episode starts from."""
        return robot.n + 6

    def start(self, robot: Robot, u: Row) -> Rows:
        """Start near `home`, the object around the place below the tip."""
        n, home, grip = robot.n, self._home(robot), self._fingers(robot)
        around = [0.0 if i in grip else AROUND * (2.0 * x - 1.0) for i, x in enumerate(u[:n])]
        q = [self.OPEN * 0.98 * h if i in grip else h + x for i, (h, x) in enumerate(zip(home, around, strict=True))]
        x, y, half = *self.place(robot, u[n : n + 2]), 0.5 * self.TURNED * (2.0 * u[n + 2] - 1.0)
        turn = (half.cos(), 0.0, 0.0, half.sin()) if self.TURNED else quat.ONE
        X_WO = dq.from_pose(turn, (x, y, 1.1 * self.rest()))
        return {"q": q, "qd": [0.0] * n, "poses": [*X_WO[0], *X_WO[1]], "goal": self.goal(robot, (x, y), u[n + 3 :])}

    def place(self, robot: Robot, u: Row) -> tuple[Number, Number]:
        """Place of the object."""
        (x, y, _), _ = self._tip(robot, posed(robot, self._home(robot), {}, ()))
        return x + SPREAD * (2.0 * u[0] - 1.0), y + SPREAD * (2.0 * u[1] - 1.0)

    def goal(self, robot: Robot, at: tuple[Number, Number], u: Row) -> list[Number]:
        """Place to which the object goes, of its own and three random numbers."""
        raise NotImplementedError

    def bounds(self, robot: Robot) -> list[tuple[float, float]]:
        """Bounds of the observation."""
        return [(-WIDEST, WIDEST)] * (2 * robot.n + 28 + len(self.parts(robot)))

    def parts(self, robot: Robot) -> list[str]:
        """Frames of the points that touch the object."""
        return [*dict.fromkeys(point.frame for point in points_of(robot, self.pads))]

    def rows(self, view: View) -> Rows:
        """Rows as the class states them."""
        robot, n, goal = view.scene.spec.robot, len(view.q), tuple(view.inputs["goal"])
        X_WO = tuple(view.poses[:4]), tuple(view.poses[4:])
        fingers = [at_least(force, PRESSING) for force in view.pressing(self.object.name).values()]
        q = view.reading[:n]
        reward, success = self.judged(robot, view.q, view.qd, X_WO, goal, fingers)
        return {
            "observation": self.observed(robot, q, view.reading[n:], X_WO, view.twists, goal, fingers),
            "reward": [reward],
            "reference": [*self.reference(robot, q), *[0.0] * (2 * n)],
            "success": [success],
            "distance": [_length(quat.sub(goal, dq.translation(X_WO)))],
        }

    def reference(self, robot: Robot, q: Row) -> list[Number]:
        """Targets without an action: the arm where it is, and fingers half open."""
        grip, closed = self._fingers(robot), 0.5 * self._open(robot)
        return [closed if i in grip else x for i, x in enumerate(q)]

    def observed(
        self, robot: Robot, q: Row, qd: Row, X_WO: DualQuaternion, V_WO: Row, goal: Pure, fingers: Row
    ) -> list[Number]:
        """Observation of a state; `fingers` are 1 for those that press on the object, otherwise 0."""
        p, (a, b, _) = dq.translation(X_WO), quat.rotation_columns(X_WO[0])
        w, v = quat.rotate(X_WO[0], tuple(V_WO[:3])), quat.rotate(X_WO[0], tuple(V_WO[3:]))
        tip, hand = self._tip(robot, posed(robot, q, {}, ()))
        middle, _ = self._tip(robot, posed(robot, self._home(robot), {}, ()))
        seen = [
            *[x - h for x, h in zip(q, self._home(robot), strict=True)],
            *[0.2 * x for x in qd],
            *quat.scale(10.0, quat.sub(p, tip)),
            *quat.scale(5.0, quat.sub(p, (middle[0], middle[1], 0.0))),
            *(*a, *b),
            *quat.scale(5.0, quat.sub(goal, p)),
            *quat.scale(0.5, v),
            *quat.scale(0.1, w),
            *(*hand[0], *hand[2]),
            10.0 * tip[2] - 1.0,
            *fingers,
        ]
        return within(seen, self.bounds(robot))

    def reader(self, robot: Robot) -> Callable[..., tuple[Tensor, Tensor, Tensor]]:
        """Function of states of a real arm or of another engine: observations, success, and targets without an action.

        Its arguments are q and qd [N, n], X_WO [N, 8] and V_WO [N, 6] of the object, `fingers`, 1 for those that press
        on it and otherwise 0, and goals [N, 3].
        """
        widths = {"q": robot.n, "qd": robot.n, "X_WO": 8, "V_WO": 6, "fingers": len(self.parts(robot)), "goal": 3}

        def rows(q: Row, qd: Row, X: Row, V: Row, fingers: Row, goal: Row) -> Rows:
            X_WO, there = (tuple(X[:4]), tuple(X[4:])), tuple(goal)
            return {
                "observation": self.observed(robot, q, qd, X_WO, V, there, fingers),
                "success": [self.judged(robot, q, qd, X_WO, there, fingers)[1]],
                "target": self.reference(robot, q),
            }

        program = record(f"read_{robot.name}", [Argument(name, width) for name, width in widths.items()], rows)

        def read(*state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            observation, success, target = run(program, list(state), choose(None, state[0].device))
            return observation, success[:, 0] > 0, target

        return read

    def judged(
        self, robot: Robot, q: Row, qd: Row, X_WO: DualQuaternion, goal: Pure, fingers: Row
    ) -> tuple[Number, Number]:
        """Reward and success of a state."""
        tip, _ = self._tip(robot, posed(robot, q, {}, ()))
        grip = self._fingers(robot)
        still = sqrt(sum([x * x for i, x in enumerate(qd) if i not in grip], 1e-12))
        return self.earned(tip, dq.translation(X_WO), goal, reduce(mul, fingers), still)

    def earned(self, tip: Pure, p: Pure, goal: Pure, grasped: Number, still: Number) -> tuple[Number, Number]:
        """Reward and success.

        Args:
            tip, p, goal: positions of the tip, the object and the goal.
            grasped: 1 if all fingers press on the object, otherwise 0.
            still: speed of the arm's joints.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Push(Manipulation):
    """Push an object ahead, to within 0.1 m of a place that is 0.2 m away, with closed fingers."""

    OPEN: ClassVar[float] = 0.0

    def goal(self, robot: Robot, at: tuple[Number, Number], u: Row) -> list[Number]:
        """A place ahead of the object."""
        return [at[0] + 0.2, at[1], self.rest()]

    def place(self, robot: Robot, u: Row) -> tuple[Number, Number]:
        """Place of the object, ahead of the tip."""
        x, y = super().place(robot, u)
        return x + 0.1, y

    def earned(self, tip: Pure, p: Pure, goal: Pure, grasped: Number, still: Number) -> tuple[Number, Number]:
        """Reward for being behind the object, and for its place."""
        rest = self.rest()
        behind = _length(quat.sub(tip, quat.sub(p, (rest + 0.015, 0.0, 0.0))))
        x, y, _ = quat.sub(p, goal)
        away = _length((x, y, 0.0))
        placed = at_least(0.1, away) * at_least(rest + 0.01, p[2])
        reached = 1.0 - tanh(5.0 * behind) + at_least(NEAR, behind) * (1.0 - tanh(5.0 * away))
        return (placed * (3.0 - tanh(10.0 * away) - reached) + reached) * (1.0 / 3.0), placed


@dataclass(frozen=True)
class Lift(Manipulation):
    """Lift an object by 0.04 m or more, in a grasp."""

    TURNED: ClassVar[float] = math.pi / 4

    def goal(self, robot: Robot, at: tuple[Number, Number], u: Row) -> list[Number]:
        """A place above the object."""
        return [*at, self.rest() + 0.1]

    def achieved(self, p: Pure, goal: Pure) -> Number:
        """1 where an object in a grasp is where it should be."""
        return at_least(p[2], self.rest() + 0.04)

    def earned(self, tip: Pure, p: Pure, goal: Pure, grasped: Number, still: Number) -> tuple[Number, Number]:
        """Reward for reaching, grasping, carrying, and holding still."""
        near, away = _length(quat.sub(tip, p)), _length(quat.sub(goal, p))
        success = self.achieved(p, goal) * grasped
        reward = 1.0 - tanh(5.0 * near) + grasped * (2.0 - tanh(5.0 * away))
        return (reward + success * (2.0 - tanh(5.0 * still))) * 0.2, success


@dataclass(frozen=True)
class Pick(Lift):
    """Bring an object in a grasp to within 0.025 m of a point above the table."""

    def goal(self, robot: Robot, at: tuple[Number, Number], u: Row) -> list[Number]:
        """A point around the place where objects start, 0.04 to 0.3 m high."""
        x, y = self.place(robot, u[:2])
        return [x, y, 0.04 + 0.26 * u[2]]

    def achieved(self, p: Pure, goal: Pure) -> Number:
        """1 where an object in a grasp is where it should be."""
        return at_least(0.025, _length(quat.sub(goal, p)))


def _length(v: Pure) -> Number:
    return sqrt(quat.dot(v, v) + 1e-12)
