"""Actions that displace the desired pose of a frame, which a controller of `torchdq.scene.controllers` follows."""

from __future__ import annotations

from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure, Quaternion
from torchdq.algebra.screw import Screw
from torchdq.dq import pose_error
from torchdq.dq.components import form
from torchdq.dq.explog import entire
from torchdq.dq.formulas import numbers
from torchdq.dynamics.task_space import COMPONENTS, Task
from torchdq.functions.task_space import pose_of, pose_of_any_norm, six
from torchdq.numbers.functions import at_least, maximum, select, sqrt
from torchdq.scene.spec import View

POSITION, ROTATION = 0.1, 0.5  # full actions [m, rad]


class PoseActions(NamedTuple):
    """Displacements of the desired pose of a frame, in the axes in which the controller has its error."""

    task: Task  # the frame and its axes
    leash: tuple[float, float]  # farthest that the desired pose is from the measured one [rad, m]
    still: int = 12  # zeros after the pose in the controller's reference: its twist, and the rate of that

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers of an action: a rotation vector, and a displacement."""
        return tuple([COMPONENTS[r] for r in self.task.rows])

    def moved(self, x: DualQuaternion, action: Any, scale: Any) -> DualQuaternion:
        """Desired pose x after an action in [-1, 1], whose rotation vector is at most as long as one full component.

        Without an action it is bitwise x, so that rounding errors do not move a frame that is held.
        """
        a = [*numbers(action)]
        turn, move = six(self.task, [s * u for s, u in zip(numbers(scale), a, strict=True)])
        turn = quat.scale(1.0 / sqrt(maximum(quat.norm2(six(self.task, a)[0]), 1.0)), turn)
        if self.task.world:
            turn, move = (quat.rotate(quat.conj(x[0]), v) for v in (turn, move))
        return dq.mul(x, dq.from_pose(_turned(turn) if min(self.task.rows) < 3 else quat.ONE, move))

    def towards(self, x: DualQuaternion, goal: Any, scale: Any) -> list[Number]:
        """Action that moves the desired pose x to a goal of any norm, or by a full action towards it."""
        e, d = between = _between(x, pose_of_any_norm([*numbers(goal)]))
        if not self.task.world:
            e, d = (quat.rotate(quat.conj(x[0]), v) for v in between)
        e, d = six(self.task, [c / s for c, s in zip(self.task.of((e, d)), numbers(scale), strict=True)])
        return self.task.of((_shortened(e, 1.0)[1], _shortened(d, 1.0)[1]))

    def reference(self, view: View) -> list[Number]:
        """Desired pose after a step, within the leash; at a start the measured one."""
        X = pose_of(view.posed(view.reading[: len(view.q)]), self.task)
        if "reference" in view.inputs:
            goal = pose_of_any_norm(view.inputs["reference"][:8])
            (turns, e), (moves, d) = (_shortened(v, m) for v, m in zip(_between(X, goal), self.leash, strict=True))
            cut = dq.from_pose(quat.mul(_turned(e), X[0]), quat.add(dq.translation(X), d))
            X = form([select(turns * moves, a, b) for a, b in zip(numbers(goal), numbers(cut), strict=True)])
        return [*X[0], *X[1]]


def _between(x: DualQuaternion, goal: DualQuaternion) -> Screw:
    """Rotation vector and displacement from one pose to another, in axes of the base."""
    turn = (quat.mul(goal[0], quat.conj(x[0])), dq.ZERO)
    return pose_error.error(turn)[0], quat.sub(dq.translation(goal), dq.translation(x))


def _turned(v: Pure) -> Quaternion:
    """Rotation by a rotation vector."""
    half = quat.scale(0.5, v)
    cos, sinc, _ = entire(half, None)
    return (cos, *quat.scale(sinc, half))


def _shortened(v: Pure, most: float) -> tuple[Number, Pure]:
    """Whether a vector is at most so long, and the vector cut to that."""
    square, most = quat.norm2(v), max(most, 1e-12)
    return at_least(most * most, square), quat.scale(most / sqrt(maximum(square, most * most)), v)
