"""Pose and components of a frame of a robot, on numbers."""

from __future__ import annotations

from collections.abc import Sequence

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.dynamics.posed import Posed, Row
from torchdq.dynamics.task_space import Task
from torchdq.numbers.functions import sqrt


def pose_of_any_norm(X: Row) -> DualQuaternion:
    """Desired pose, scaled to a unit dual quaternion."""
    return dq.scale(1.0 / sqrt(quat.norm2(X[:4])), (tuple(X[:4]), tuple(X[4:])))


def pose_of(at: Posed, task: Task) -> DualQuaternion:
    """Pose of the frame."""
    return dq.mul(at.poses()[task.link], task.X_BF)


def six(task: Task, row: Row) -> Screw:
    """Components of a task as a screw, zero at the others."""
    found: list[Number] = [0.0] * 6
    for r, x in zip(task.rows, row, strict=True):
        found[r] = x
    return tuple(found[:3]), tuple(found[3:])


def numbers(row: Sequence[Number | None]) -> list[Number]:
    """Numbers, zero where one is absent."""
    return [0.0 if x is None else x for x in row]
