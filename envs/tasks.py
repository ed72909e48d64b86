"""Tasks of environments, written for any kind of number and recorded into the step's own program.

A task computes start and goal of an episode from random numbers; and, from the state at the end of a step, observation,
reward, and the reference that the robot follows without the policy. A task of one's own starts from one of these:

    @dataclass(frozen=True)
    class Gentle(Reach):
        def rows(self, view):
            rows, energy = super().rows(view), sum((v * v for v in view.qd), 0.0)
            return {**rows, "reward": [rows["reward"][0] - 0.01 * energy], "energy": [energy]}

    envs = RobotVectorEnv(4096, Gentle(), "panda")

Its numbers are recorded, so it uses + - * /, and the functions of `torchdq.numbers.functions` instead of torch's,
and no comparisons; `torchdq.envs.torch_task` has no such limits, and is slower.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number, Pure
from torchdq.base.checks import require_number
from torchdq.dynamics.joints import KINDS
from torchdq.dynamics.posed import Posed, Row
from torchdq.envs.pose_actions import PoseActions
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.posed import frame, posed
from torchdq.numbers.functions import at_least, clip, minimum, sqrt
from torchdq.numbers.record import Recorded
from torchdq.objects import Object
from torchdq.program.program import GROWTH
from torchdq.robot import Robot
from torchdq.scene.free_base import POSE, START, TWIST
from torchdq.scene.spec import Rows, Task, View

__all__ = ["Plain", "Reach", "Track"]

ROBOT = "panda"
SPEED = 2.0  # velocity limit of a joint whose description has none [rad/s or m/s]
FASTEST = 10.0  # bound of observed velocities, in multiples of the limit
TUMBLING = 20.0  # bound of the observed twist of a floating base [rad/s, m/s]
EFFORT = 0.01  # cost per step of full actions of all joints
CLOSE = 0.05  # distance at which half of the bonus is earned [m]
TIGHT = 0.1  # root mean square error at which half of the reward is earned [rad or m]
HIGHEST = 2.0  # largest rate of the sinusoids of a reference [rad/s]
SENSIBLE = 1e6  # bound of velocities and rewards; beyond it the simulation has failed
STATE = ("q", "qd", "X_WB", "V_WB_B", "poses", "twists", "memory", "reading")
RESERVED = (*STATE, "valid", GROWTH, "clipped", "nonfinite", "final_obs", "final_info")


class EpisodeTask(Task, Protocol):
    """A task of an environment; frozen and hashable, since it is part of the key of its programs.

    Its rows are "observation", "reward" [1] and "reference" [3 n], the positions, velocities and accelerations that a
    controller or servo is to follow over the next step; "terminated" [1], not zero where the episode ends, and
    "success" [1], 1 where the task is achieved and 0 elsewhere, may be among them. "success" and others go to the
    environment's `info`. In addition to its "goal" it may take the "action" [n] in [-1, 1] and the "time" [1] since the
    start of the episode [s]. A goal of three numbers is drawn as a point, unless POINT is False.

    What it remembers from step to step, such as the last action, is the row "carry" [k]: it comes back as the input
    "carry" of the next step. At the start of an episode there is neither action nor carry.

    A task is recorded once, when its first environment is reset, and its numbers are part of the program from then on.
    Its class and its fields tell programs apart: make a number that may change a field. A change of anything else, such
    as a global or an attribute of the class, has no effect until `torchdq.clear_caches()`. A field that only `spans`
    reads is no part of the program: `field(compare=False)` says so, and `RobotVectorEnv.set` changes it.
    """

    POINT: ClassVar[bool] = True
    ROBOT: ClassVar[str] = ROBOT  # of environments that are given none

    def defaults(self, robot: Robot) -> Mapping[str, Any]:
        """Arguments of environments whose effects are not given.

        They are `effects`, `scale`, `dt`, `substeps`, `unroll`, `randomise` and `pushes`. Each may be left out, and is
        replaced by one that is given. The scale is that of the default `action`.
        """
        return {}

    def objects(self, robot: Robot) -> Sequence[Object]:
        """Objects of the scene."""
        return ()

    def described(self, robot: Robot) -> EpisodeTask:
        """The task with what it takes from a robot, such as the number of its feet."""
        return self

    def draws(self, robot: Robot) -> int:
        """Number of random numbers that an episode starts from."""

    def spans(self) -> Sequence[tuple[float, float]]:
        """Ranges (least, largest) of the last of these numbers, such as commands; others are in (0, 1)."""
        return ()

    def start(self, robot: Robot, u: Row) -> Rows:
        """Rows "q", "qd" and "goal" of these random numbers, and others where there is something that floats.

        They are "X_WB" and "V_WB_B" of a floating base, and "poses" [8 objects] and "twists" [6 objects] of objects.
        What is left out starts at the origin and at rest. Loops are closed at "q", and at "there" where there are such
        positions, of which the goal is then that of `aim`.
        """

    def aim(self, robot: Robot, there: Row) -> Row:
        """Goal of the positions "there" of a start."""
        return ()

    def bounds(self, robot: Robot) -> list[tuple[float, float]]:
        """Lower and upper bound of every number of an observation."""


@dataclass(frozen=True)
class Reach(EpisodeTask):
    """Bring the end effector to a point that it can reach, from standstill.

    Goal: the point in the base frame [m], that of random joint positions within their limits. Observation: sine and
    cosine of revolute joints or the position of prismatic ones, velocities as fractions of their limits, the vector
    from the end effector to the goal, and the position of the end effector, as measured. Success: d is at most 0.05 m.
    Positions are in the frame at which a floating base starts, and its motion is observed, too: the direction of the
    world's z axis and the twist of the base, in its axes. Reward, of the true state:

        1 / (1 + (d / 0.05)^2) - d - 0.01 mean(action^2),   d the distance [m]

    Reference: to stand still at the present position.
    """

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of the inputs: the goal [3] and the action."""
        return {"goal": 3, "action": n}

    def draws(self, robot: Robot) -> int:
        """Number of random numbers that an episode starts from: two for every joint."""
        return 2 * robot.n

    def start(self, robot: Robot, u: Row) -> Rows:
        """Start at rest in the middle half of the joints' ranges, and a goal."""
        at = [r.lower + r.span * (0.25 + 0.5 * x) for r, x in zip(ranges(robot), u[: robot.n], strict=True)]
        there = [r.lower + r.span * x for r, x in zip(ranges(robot), u[robot.n :], strict=True)]
        found = {"q": at, "qd": [0.0] * robot.n, "goal": self.aim(robot, there)}
        return {**found, "there": there} if robot.closures else found

    def aim(self, robot: Robot, there: Row) -> Row:
        """Position of the end effector at these positions of the joints."""
        return tip(robot, posed(robot, there, {}, ()))

    def bounds(self, robot: Robot) -> list[tuple[float, float]]:
        """Bounds of sines and cosines, positions, velocities, vector to the goal, and end effector."""
        length = reach(robot)
        return [*seen_bounds(robot), *[(-2 * length, 2 * length)] * 3, *[(-length, length)] * 3]

    def rows(self, view: View) -> Rows:
        """Rows as the class states them."""
        robot, n, goal = view.scene.spec.robot, len(view.q), view.inputs["goal"]
        q = view.reading[:n]
        p = tip(robot, view.posed(q))
        observation = [*seen(view), *quat.sub(goal, p), *p]
        error = quat.sub(goal, tip(robot, view.posed(view.q)))
        squared = quat.dot(error, error)
        distance = sqrt(squared + 1e-12)
        bonus = 1.0 / (1.0 + squared * (1.0 / CLOSE**2))
        return {
            "observation": within(observation, Reach.bounds(self, robot)),
            "reward": [bonus - distance - cost(view)],
            "reference": [*q, *[0.0] * (2 * n)],
            "distance": [distance],
            "success": [at_least(CLOSE**2, squared)],
        }


@dataclass(frozen=True)
class Track(EpisodeTask):
    """Follow a smooth reference, the sum of two sinusoids per joint, from a start on it.

    Goal: middle, and amplitude, rate [rad/s] and phase [rad] of both sinusoids, of every joint [7 n]; within the limits
    of the positions and below half of those of the velocities. Observation: errors of the positions, velocities, and
    positions, velocities and accelerations of the reference; all velocities and accelerations as fractions of the
    velocity's limit. Reward, of the true state:

        1 / (1 + e^2 / 0.1^2) - 0.01 mean(action^2)

    Here e^2 is the mean squared error of the positions.
    """

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of the inputs: the goal, the action and the time."""
        return {"goal": 7 * n, "action": n, "time": 1}

    def draws(self, robot: Robot) -> int:
        """Number of random numbers that an episode starts from: seven for every joint."""
        return 7 * robot.n

    def start(self, robot: Robot, u: Row) -> Rows:
        """Start on the reference, moving with it."""
        if robot.closures:
            raise ArgumentError(
                f"robot {robot.name!r} has closures, which Track does not take: a motion of all joints would open the "
                "loops; use Reach, or a task of your own"
            )
        goal: list[Number] = []
        for i, r in enumerate(ranges(robot)):
            x = u[7 * i : 7 * i + 7]
            waves: list[Number] = []
            for share, rate, phase in (x[1:4], x[4:7]):
                w = 0.25 * HIGHEST + (0.75 * HIGHEST) * rate
                largest = 0.25 * r.speed / w
                waves += [share * minimum(largest, r.span / 8), w, (2 * math.pi) * phase]
            widest = waves[0] + waves[3]
            goal += [r.lower + widest + x[0] * (r.span - 2.0 * widest), *waves]
        reference = self.reference(goal, 0.0)
        return {"q": reference[: robot.n], "qd": reference[robot.n : 2 * robot.n], "goal": goal}

    def reference(self, goal: Row, time: Number) -> list[Number]:
        """Positions, velocities and accelerations at a time [s]."""
        q: list[Number] = []
        qd: list[Number] = []
        qdd: list[Number] = []
        for k in range(0, len(goal), 7):
            x: list[Number] = [goal[k], 0.0, 0.0]
            for a, w, phase in (goal[k + 1 : k + 4], goal[k + 4 : k + 7]):
                angle = w * time + phase
                s, c = a * angle.sin(), a * angle.cos()
                x = [x[0] + s, x[1] + w * c, x[2] - w * w * s]
            for row, value in zip((q, qd, qdd), x, strict=True):
                row.append(value)
        return [*q, *qd, *qdd]

    def bounds(self, robot: Robot) -> list[tuple[float, float]]:
        """Bounds of errors, velocities and reference."""
        n = robot.n
        wide = [(-2.0 * r.span, 2.0 * r.span) for r in ranges(robot)]
        return [*wide, *[(-FASTEST, FASTEST)] * n, *[r.beyond for r in ranges(robot)], *[(-HIGHEST, HIGHEST)] * (2 * n)]

    def rows(self, view: View) -> Rows:
        """Rows as the class states them."""
        robot, n = view.scene.spec.robot, len(view.q)
        q, qd = view.reading[:n], view.reading[n:]
        reference = self.reference(view.inputs["goal"], view.inputs["time"][0])
        wanted, moving = reference[:n], reference[n:]
        errors = [r - x for r, x in zip(wanted, q, strict=True)]
        rates = [*speeds(robot, moving[:n]), *speeds(robot, moving[n:])]
        measured = within([*errors, *speeds(robot, qd)], Track.bounds(self, robot)[: 2 * n])
        squared = sum(((r - x) * (r - x) for r, x in zip(wanted, view.q, strict=True)), 0.0) * (1.0 / n)
        return {
            "observation": [*measured, *wanted, *rates],  # the reference is within its bounds
            "reward": [1.0 / (1.0 + squared * (1.0 / TIGHT**2)) - cost(view)],
            "reference": reference,
            "error": [sqrt(squared + 1e-12)],
        }


@dataclass(frozen=True)
class Plain(EpisodeTask):
    """Neither goal nor reward: what a `TorchTask` starts from that names no other task.

    Start at rest, as in `Reach`. Observation: sine and cosine of revolute joints or the position of prismatic ones, and
    velocities as fractions of their limits, as measured; of a floating base as in `Reach`. Reference: to stand still at
    the present position; where actions are targets of a servo, at that of the start.

    Args:
        goal: number of numbers of a goal, all zero.
    """

    goal: int = 0

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of the inputs: the goal, and the position of the start."""
        return {"goal": self.goal, "carry": n}

    def draws(self, robot: Robot) -> int:
        """Number of random numbers that an episode starts from: one for every joint."""
        return robot.n

    def start(self, robot: Robot, u: Row) -> Rows:
        """Start at rest in the middle half of the joints' ranges."""
        at = [r.lower + r.span * (0.25 + 0.5 * x) for r, x in zip(ranges(robot), u, strict=True)]
        return {"q": at, "qd": [0.0] * robot.n, "goal": [0.0] * self.goal}

    def bounds(self, robot: Robot) -> list[tuple[float, float]]:
        """Bounds of sines and cosines, positions and velocities."""
        return seen_bounds(robot)

    def rows(self, view: View) -> Rows:
        """Rows as the class states them."""
        robot, n = view.scene.spec.robot, len(view.q)
        start, held = view.inputs.get("carry", view.q), "target" in view.scene.spec.inputs()
        return {
            "observation": within(seen(view), self.bounds(robot)),
            "reward": [0.0],
            "reference": [*(start if held else view.reading[:n]), *[0.0] * (2 * n)],
            "carry": start,
        }


@dataclass(frozen=True)
class Checked:
    """A task whose rows are checked while they are recorded, and whose numbers are checked at every step.

    It adds the row "valid" [1]: 1, or 0 where the simulation has failed. Where actions displace a pose, that is the
    row "reference".
    """

    task: EpisodeTask
    pose: PoseActions | None = None

    def inputs(self, n: int) -> dict[str, int]:
        """Inputs of the task."""
        found, known = self.task.inputs(n), {"action": n, "time": 1}
        own = ("goal", "carry")
        if "goal" not in found or any(known.get(name) != width for name, width in found.items() if name not in own):
            raise ArgumentError(
                f"{type(self.task).__name__}.inputs must give the width of 'goal', may give that of 'carry', and may "
                f"ask for {known}, found {found}"
            )
        return found | ({"action": len(self.pose.names)} if self.pose and "action" in found else {})

    def start(self, robot: Robot, u: Row) -> Rows:
        """Rows of the task at a start."""
        widths = {"q": robot.n, "qd": robot.n, "goal": self.inputs(robot.n)["goal"]}
        base: Rows = {"X_WB": START, "V_WB_B": (0.0,) * TWIST} if robot.floating else {}
        if k := len(self.task.objects(robot)):
            base |= {"poses": START * k, "twists": (0.0,) * TWIST * k}
            widths |= {"poses": POSE * k, "twists": TWIST * k}
        found = self.task.start(robot, u)
        rows = self._rows("start", {**base, **found} if isinstance(found, Mapping) else found, widths)
        for name in rows:
            if name not in (known := (*widths, *base, *["there"] * bool(robot.closures))):
                raise UnknownNameError(f"row of a start that {type(self.task).__name__}.start may return", name, known)
        return rows

    def rows(self, view: View) -> Rows:
        """Rows of the task, and "valid"."""
        robot = view.scene.spec.robot
        widths = {"observation": len(self.task.bounds(robot)), "reward": 1, "reference": 3 * robot.n}
        widths |= {name: width for name, width in self.inputs(robot.n).items() if name == "carry"}
        rows = self._rows("rows", self.task.rows(view), widths)
        # NaN and infinity survive sums; positions follow the velocities
        squares = [
            x * x for x in (*view.qd, *view.V_WB_B, *view.twists, *rows["reward"], sum(rows["observation"], 0.0))
        ]
        followed = {} if self.pose is None else {"reference": self.pose.reference(view)}
        return {**rows, **followed, "valid": [at_least(SENSIBLE**2, sum(squares, 0.0))]}

    def _rows(self, method: str, rows: Any, widths: Mapping[str, int]) -> Rows:
        """Rows that a method of the task returned; raises unless those of the widths are there, as lists of numbers."""
        what = f"{type(self.task).__name__}.{method}"
        if not isinstance(rows, Mapping) or not widths.keys() <= rows.keys():
            found = ", ".join(rows) if isinstance(rows, Mapping) else type(rows).__name__
            raise ArgumentError(f"{what} must return a dict of rows with {', '.join(widths)}, found {found}")
        widths = {"terminated": 1, "success": 1, "X_WB": POSE, "V_WB_B": TWIST, **widths}
        for name, row in rows.items():
            if method == "rows" and name in RESERVED:
                raise ArgumentError(f"{what} must not return a row {name!r}: the environment has its own")
            if not isinstance(row, list | tuple) or not all(isinstance(x, Recorded | float | int) for x in row):
                raise ArgumentError(
                    f"{what} must return {name!r} as a list of numbers, found {row!r:.80}; a number x is the row [x]"
                )
            if len(row) != widths.get(name, len(row)):
                raise ArgumentError(f"{what} must return {name!r} of width {widths[name]}, found {len(row)}")
        return dict(rows)


# --- terms of tasks ---------------------------------------------------------------------------------------


class Range(NamedTuple):
    """Range of a joint's position, and its velocity limit."""

    lower: float  # [rad or m]
    span: float  # from there to the upper limit [rad or m]
    speed: float  # [rad/s or m/s]

    @property
    def beyond(self) -> tuple[float, float]:
        """Bounds half a range beyond the limits."""
        return self.lower - 0.5 * self.span, self.lower + 1.5 * self.span


def ranges(robot: Robot) -> list[Range]:
    """Range of every joint; a whole turn, or a metre, where the description has none."""
    found = []
    for joint, lower, upper, speed in zip(
        robot.joint_types, robot.limits.lower.tolist(), robot.limits.upper.tolist(), velocities(robot), strict=True
    ):
        if not math.isfinite(upper - lower) or upper <= lower:
            half = math.pi if joint.turns else 0.5
            lower, upper = -half, half
        found.append(Range(lower, upper - lower, speed))
    return found


def velocities(robot: Robot) -> list[float]:
    """Limits of the velocities [rad/s or m/s], `SPEED` where the description has none."""
    return [v if math.isfinite(v) and v > 0 else SPEED for v in robot.limits.velocity.tolist()]


def speeds(robot: Robot, qd: Row) -> list[Number]:
    """Velocities, or accelerations per second, as fractions of the velocities' limits."""
    return [v * (1.0 / limit) for v, limit in zip(qd, velocities(robot), strict=True)]


def seen(view: View) -> list[Number]:
    """Sine and cosine of revolute joints or the position of prismatic ones, and velocities over their limits.

    For a floating base also the world's z axis and the twist of the base, in its axes.
    """
    robot, n, found = view.scene.spec.robot, len(view.q), list[Number]()
    for joint, x in zip(robot.joint_types, view.reading[:n], strict=True):
        found += [x] if joint.slides else [x.sin(), x.cos()]
    up = quat.rotate(quat.conj(tuple(view.X_WB[:4])), (0.0, 0.0, 1.0)) if robot.floating else ()
    return [*found, *speeds(robot, view.reading[n:]), *up, *view.V_WB_B]


def seen_bounds(robot: Robot) -> list[tuple[float, float]]:
    """Bounds of what `seen` returns."""
    found = []
    for joint, r in zip(robot.joint_types, ranges(robot), strict=True):
        found += [r.beyond] if joint.slides else [(-1.0, 1.0)] * 2
    base = [(-1.0, 1.0)] * 3 + [(-TUMBLING, TUMBLING)] * TWIST if robot.floating else []
    return [*found, *[(-FASTEST, FASTEST)] * robot.n, *base]


def tip(robot: Robot, at: Posed) -> Pure:
    """Position of the end effector in the base frame, or in the world if the base is floating [m]."""
    link, X_BF = frame(robot, robot.end_effector().name)
    return at.position(link, at.point(link, X_BF).position)


def home_of(task: Any, robot: Robot, place: str) -> Row:
    """Positions `home` of a task; raises unless they are those of a robot's joints, within their limits.

    Args:
        place: where they bring the robot, in words.
    """
    kind = type(task).__name__
    if len(task.home) != robot.n:
        raise ArgumentError(
            f"home of {kind} must be the {robot.n} positions of the joints of robot {robot.name!r}, {place}, found "
            f"{len(task.home)}; give it by {kind}(home=...)"
        )
    lower, upper = (x.tolist() for x in robot.limits[:2])
    for name, x, low, high in zip(robot.joint_names, task.home, lower, upper, strict=True):
        require_number(f"home of {kind}", x)
        if not low <= x <= high:
            raise ArgumentError(
                f"home of {kind} must be within the limits of joint {name!r}, {low:g} to {high:g}, found {x:g}"
            )
    return task.home


def reach(robot: Robot) -> float:
    """Bound of the end effector's distance from the base's origin [m]: the sum of all lengths between them."""
    frame = robot.end_effector()
    length, i = _length(frame.X_BF.tolist()), frame.link
    while i >= 0:
        length += _length(robot.X_PB_home[i].tolist())
        if KINDS[robot.kinds[i]].turns:  # a turn about an axis that passes the frame's origin at a distance
            length += 2 * math.hypot(*robot.screw[i, 3:].tolist())
        if KINDS[robot.kinds[i]].slides:
            length += _slide(robot, i)
        i = robot.parents[i]
    return 1.01 * length


def _slide(robot: Robot, i: int) -> float:
    """Longest displacement of a sliding joint from its home [m]."""
    bounds = [max(map(abs, r.beyond)) for r in ranges(robot)]
    home = 0.0 if robot.home is None else abs(float(robot.home[i]))
    if robot.joint_map is None:
        return home + bounds[i]
    return home + sum(abs(x) * bound for x, bound in zip(robot.joint_map.S[i].tolist(), bounds, strict=True))


def _length(X: Sequence[float]) -> float:
    return math.hypot(*dq.translation((tuple(X[:4]), tuple(X[4:]))))


def within(row: Row, bounds: Sequence[tuple[float, float]]) -> list[Number]:
    """Numbers clipped to their bounds."""
    return [clip(x, *b) for x, b in zip(row, bounds, strict=True)]


def cost(view: View) -> Number:
    """Cost of the action; zero if there was none."""
    action = view.inputs.get("action", ())
    return (EFFORT / len(action)) * sum((a * a for a in action), 0.0) if action else 0.0
