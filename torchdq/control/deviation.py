"""Deviation of a frame from its desired motion, on numbers: its error, and the first two derivatives of that."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.screw import Screw
from torchdq.dq import pose_error
from torchdq.dynamics import task_space
from torchdq.dynamics.task_space import Task


class Goal(NamedTuple):
    """Desired motion of a frame: its twist and the rate of that in its own axes, or in those of the world."""

    X: DualQuaternion
    V: Screw = screw.ZERO
    A: Screw = screw.ZERO


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
