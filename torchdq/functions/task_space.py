"""Control of a frame, on numbers: which accelerations its error asks for, and the torques that give them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.dq import pose_error
from torchdq.dynamics import task_space
from torchdq.dynamics.error_growth import HUGE
from torchdq.dynamics.posed import Posed, Row, dot
from torchdq.dynamics.task_space import Task
from torchdq.numbers.functions import at_least, below, maximum, minimum, select, sqrt

COMPLETE = (set(range(6)), set(range(3)), set(range(3, 6)))  # components that turn into each other


class Goal(NamedTuple):
    """Desired motion of a frame: its twist and the rate of that in its own axes, or in those of the world."""

    X: DualQuaternion
    V: Screw = screw.ZERO
    A: Screw = screw.ZERO


def pose_of_any_norm(X: Row) -> DualQuaternion:
    """Desired pose, scaled to a unit dual quaternion."""
    return dq.scale(1.0 / sqrt(quat.norm2(X[:4])), (tuple(X[:4]), tuple(X[4:])))


class Deviation(NamedTuple):
    """Error of a frame, its rate, and the rate of the twist that gives the error a second derivative."""

    e: Screw
    rate: Screw
    twist_rate: Callable[[Screw], Screw]


def deviation(task: Task, X: DualQuaternion, V: Screw, goal: Goal) -> Deviation:
    """Error of a frame with the pose X and the twist V.

    In the axes of the frame and of all components it is the screw e = 2 log(X* X_des). Of some components, or in the
    axes of the world, it is the difference of the positions, and 2 log(r* r_des) or 2 log(r_des r*) of the rotations.
    """
    if not task.world and len(task.rows) == 6:
        return _of_screws(dq.mul(dq.conj(X), goal.X), V, goal, 1.0)
    r, r_des = X[0], goal.X[0]
    turn = quat.mul(r, quat.conj(r_des)) if task.world else quat.mul(quat.conj(r), r_des)
    only = [(part[0], quat.ZERO) for part in (V, goal.V, goal.A)]
    turned = _of_screws((turn, dq.ZERO), only[0], Goal(goal.X, *only[1:]), -1.0 if task.world else 1.0)
    v, (w_des, v_des), d_des = V[1], goal.V, goal.A[1]
    p = quat.sub(dq.translation(goal.X), dq.translation(X))
    if not task.world:
        back = quat.rotation_columns(quat.conj(r))
        p, across = screw.columns_times(back, p), quat.rotation_columns(turn)
        d_des = screw.columns_times(across, quat.add(d_des, quat.cross(w_des, v_des)))
        v_des = screw.columns_times(across, v_des)

    def twist_rate(change: Screw) -> Screw:
        d = quat.sub(d_des, change[1])
        return turned.twist_rate((change[0], quat.ZERO))[0], d if task.world else task_space.components_rate(d, V)

    return Deviation((turned.e[0], p), (turned.rate[0], quat.sub(v_des, v)), twist_rate)


def _of_screws(x: DualQuaternion, V: Screw, goal: Goal, side: float) -> Deviation:
    """Error from the pose x of the desired frame in the actual one; `side` -1: of the actual one in the desired."""

    def signed(a: Screw) -> Screw:
        return a if side > 0 else screw.neg(a)

    columns, error = screw.columns(x), pose_error.error(x)
    V_des = screw.ad(columns, goal.V)
    xi = signed(screw.sub(V_des, V))  # x' = xi x / 2
    rate = pose_error.error_rate(error, xi)

    def twist_rate(change: Screw) -> Screw:
        feed = screw.add(screw.ad(columns, goal.A), screw.cross(xi, V_des))
        return screw.sub(feed, signed(pose_error.twist_rate(error, rate, signed(change))))

    return Deviation(signed(error), signed(rate), twist_rate)


class Gains(NamedTuple):
    """Gains of a task, a number for every component, and of a posture."""

    kp: Row
    kd: Row
    q_null: Row | None = None  # None: no posture
    k_null: Number = 0.0

    def feedback(self, task: Task, error: Screw, rate: Screw) -> Row:
        """kd e' + kp e, by components."""
        rows = zip(self.kp, self.kd, task.of(error), task.of(rate), strict=True)
        return [kd * e_rate + kp * e for kp, kd, e, e_rate in rows]

    def posture(self, q: Row, qd: Row) -> Row | None:
        """Acceleration of the joints towards the posture, critically damped; None: there is none."""
        if self.q_null is None:
            return None
        damping = 2.0 * sqrt(self.k_null)
        return [self.k_null * (a - x) - damping * v for a, x, v in zip(self.q_null, q, qd, strict=True)]


def pose_of(at: Posed, task: Task) -> DualQuaternion:
    """Pose of the frame."""
    return dq.mul(at.poses()[task.link], task.X_BF)


def operational_space_torques(
    at: Posed,
    task: Task,
    q: Row,
    qd: Row,
    goal: Goal,
    gains: Gains,
    damping: Number,
    effort: Sequence[float] | None = None,
) -> tuple[list[Number], Number]:
    """Torques under which the error obeys e'' + kd e' + kp e = 0, and the factor by which rounding errors grow.

    Args:
        at: the robot at q.
        task: the frame and its components.
        q, qd: positions and velocities.
        goal: desired motion of the frame.
        gains: of the task and of the posture.
        damping: as in `task_space.inertia`.
        effort: largest torques, within which the force of the task is scaled; None: there are none.
    """
    X, V = pose_of(at, task), task.twist(at, qd)
    found = deviation(task, X, V, goal)
    wanted = found.twist_rate(six(task, [-x for x in gains.feedback(task, found.e, found.rate)]))
    u = gains.posture(q, qd)
    more, own_axes = screw.sub(wanted, task.twist_rate(at, qd, u)), task
    if task.world and set(task.rows) in COMPLETE:  # fewer digits are lost in the axes of the frame
        back = quat.rotation_columns(quat.conj(X[0]))
        more = (screw.columns_times(back, more[0]), screw.columns_times(back, more[1]))
        own_axes = task._replace(world=False)
    inertia = task_space.inertia(at, own_axes, damping)
    F = inertia.force(own_axes.of(more))
    own, others = task_space.torques(inertia.J, F), numbers(at.torques(qd, u, None))
    # a joint that does not move the frame has no part in a force that is NaN, but its row has no torques
    growth = maximum(inertia.growth, select(at_least(dot(F, F), 0.0), 1.0, HUGE))
    share = 1.0 if effort is None else _share(own, others, effort)
    return [b + share * t for b, t in zip(others, own, strict=True)], growth


def impedance_torques(
    at: Posed, task: Task, q: Row, qd: Row, goal: Goal, gains: Gains, damping: Number, coriolis: bool
) -> tuple[list[Number], Number]:
    """Torques of a spring and a damper at the frame, with c or not, and the factor by which rounding errors grow."""
    X, V = pose_of(at, task), task.twist(at, qd)
    found, u = deviation(task, X, V, goal), gains.posture(q, qd)
    F, growth, J = gains.feedback(task, found.e, found.rate), 1.0, task.jacobian(at)
    if u is not None:
        inertia = task_space.inertia(at, task, damping)
        growth = inertia.growth
        F = [f - h for f, h in zip(F, inertia.force([dot(row, u) for row in J]), strict=True)]
    held = numbers(at.torques(qd if coriolis else None, u, None))
    return [b + t for b, t in zip(held, task_space.torques(J, F), strict=True)], growth


def _share(own: Row, others: Row, effort: Sequence[float]) -> Number:
    """Largest share in [0, 1] of the torques `own` that keeps their sum with the others within the efforts."""
    share: Number = 1.0
    for t, b, most in zip(own, others, effort, strict=True):
        room = select(below(t, 0.0), most + b, most - b)
        size = select(below(t, 0.0), -t, t)
        fits = below(size, room)
        share = minimum(share, select(fits, 1.0, maximum(room, 0.0) / select(fits, 1.0, size)))
    return share


def six(task: Task, row: Row) -> Screw:
    """Components of a task as a screw, zero at the others."""
    found: list[Number] = [0.0] * 6
    for r, x in zip(task.rows, row, strict=True):
        found[r] = x
    return tuple(found[:3]), tuple(found[3:])


def numbers(row: Sequence[Number | None]) -> list[Number]:
    """Numbers, zero where one is absent."""
    return [0.0 if x is None else x for x in row]
