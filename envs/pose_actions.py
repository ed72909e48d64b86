"""Actions that displace the desired pose of a frame, which a controller of `torchdq.scene.controllers` follows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure, Quaternion
from torchdq.dq import pose_error
from torchdq.dq.explog import entire
from torchdq.dq.formulas import numbers
from torchdq.dynamics.task_space import COMPONENTS, Task
from torchdq.functions.task_space import pose_of, pose_of_any_norm
from torchdq.numbers.functions import at_least, maximum, select, sqrt
from torchdq.scene.spec import View

POSITION, ROTATION = 0.05, 0.5  # full actions, as in robosuite [m, rad]


class PoseActions(NamedTuple):
    """Displacements of the desired pose of a frame, in the axes in which the controller has its error."""

    task: Task  # the frame and its axes
    leash: tuple[float, float]  # farthest that the desired pose is from the measured one [rad, m]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers of an action: a rotation vector, and a displacement."""
        return tuple([COMPONENTS[r] for r in self.task.rows])

    def moved(self, x: DualQuaternion, action: Any, scale: Any) -> DualQuaternion:
        """Desired pose x after an action in [-1, 1], whose rotation vector is at most as long as one full component."""
        whole: list[Number] = [0.0] * 6
        moves: list[Number] = [0.0] * 6
        for row, a, s in zip(self.task.rows, numbers(action), numbers(scale), strict=True):
            whole[row], moves[row] = a, s * a
        longest = 1.0 / sqrt(maximum(quat.norm2(tuple(whole[:3])), 1.0))
        turn = _turned(quat.scale(longest, tuple(moves[:3]))) if min(self.task.rows) < 3 else quat.ONE
        if self.task.world:
            return dq.from_pose(quat.mul(turn, x[0]), quat.add(dq.translation(x), tuple(moves[3:])))
        return dq.mul(x, dq.from_pose(turn, tuple(moves[3:])))

    def reference(self, view: View) -> list[Number]:
        """Desired pose after a step, within the leash; at a start the measured one."""
        X = pose_of(view.posed(view.reading[: len(view.q)]), self.task)
        if "reference" in view.inputs:
            goal, p = pose_of_any_norm(view.inputs["reference"][:8]), dq.translation(X)
            e = pose_error.error((quat.mul(quat.conj(X[0]), goal[0]), dq.ZERO))[0]
            d = quat.sub(dq.translation(goal), p)
            (turns, e), (moves, d) = (_shortened(v, most) for v, most in zip((e, d), self.leash, strict=True))
            r = _where(turns, goal[0], quat.mul(X[0], _turned(e)))
            X = dq.from_pose(r, _where(moves, dq.translation(goal), quat.add(p, d)))
        return [*X[0], *X[1]]


def _turned(v: Pure) -> Quaternion:
    """Rotation by a rotation vector."""
    half = quat.scale(0.5, v)
    cos, sinc, _ = entire(half, None)
    return (cos, *quat.scale(sinc, half))


def _shortened(v: Pure, most: float) -> tuple[Number, Pure]:
    """Whether a vector is at most so long, and the vector cut to that."""
    square, most = quat.norm2(v), max(most, 1e-12)
    return at_least(most * most, square), quat.scale(most / sqrt(maximum(square, most * most)), v)


def _where(chosen: Number, a: Sequence[Number], b: Sequence[Number]) -> tuple[Number, ...]:
    return tuple([select(chosen, x, y) for x, y in zip(a, b, strict=True)])
