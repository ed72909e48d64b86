"""State of a scene, and checks of initial states: unit poses, finite rows, positions near the joint limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import and_
from typing import Any, NamedTuple

import torch
from torch import Tensor, dtype

from torchdq.backends.call import batch_of
from torchdq.base.checks import require_tensor, tensor_in, tensor_of
from torchdq.dq.components import unit
from torchdq.effects.effect import Effect
from torchdq.errors import ArgumentError
from torchdq.program.transforms import without_values
from torchdq.robot import Robot
from torchdq.robot.description import BALL
from torchdq.scene.free_base import POSE, TWIST
from torchdq.scene.recording import Stage
from torchdq.scene.spec import LABELS, POSES, SceneSpec

BENT = 0.3  # cosine of the middle hinge of a ball joint below which the three cannot turn freely
OUTSIDE = 0.5  # distance beyond a limit from which its spring throws the joint back at speeds of no real arm [rad or m]


class State(NamedTuple):
    """State of a scene: everything that the next step depends on."""

    q: Tensor  # [..., n] positions [rad or m]
    qd: Tensor  # [..., n] velocities [rad/s or m/s]
    memory: Tensor | None = None  # [..., m] memory of the scene's effects, in their order; None: they have none
    reading: Tensor | None = None  # [..., 2 n] measured positions and velocities; None: there are no sensors
    X_WB: Tensor | None = None  # [..., 8] pose of a floating base; None: the base is fixed
    V_WB_B: Tensor | None = None  # [..., 6] twist (angular, linear) of a floating base in its axes [rad/s, m/s]
    poses: Tensor | None = None  # [..., 8 objects] poses of the objects, one after the other; None: there are none
    twists: Tensor | None = None  # [..., 6 objects] their twists (angular, linear) in their axes [rad/s, m/s]

    @property
    def measured(self) -> tuple[Tensor, Tensor]:
        """Positions and velocities as the sensors read them; without sensors, those of the state itself."""
        if self.reading is None:
            return self.q, self.qd
        n = self.q.shape[-1]
        return self.reading[..., :n], self.reading[..., n:]

    @property
    def X_WO(self) -> Tensor | None:
        """Poses of the objects [..., objects, 8]; None: there are none."""
        return None if self.poses is None else self.poses.unflatten(-1, (-1, POSE))

    @property
    def V_WO(self) -> Tensor | None:
        """Twists of the objects in their axes [..., objects, 6]; None: there are none."""
        return None if self.twists is None else self.twists.unflatten(-1, (-1, TWIST))

    @property
    def last(self) -> State:
        """State after the last step of a rollout, from which another one goes on: the last along the first axis."""
        if self.q.ndim < 2 or not len(self.q):
            found = tuple(self.q.shape)
            raise ArgumentError(f"last is that of a rollout of one step or more, q [steps, ..., n], found q of {found}")
        return State._make(None if x is None else x[-1] for x in self)

    def rows(self) -> dict[str, Tensor]:
        """Tensors of the state that are there, by name."""
        return {name: x for name, x in zip(self._fields, self, strict=True) if x is not None}

    def finite(self) -> Tensor:
        """True for every row whose numbers are all finite, shape [...]."""
        return reduce(and_, [x.isfinite().all(-1) for x in self.rows().values()])

    def to(self, dtype: dtype) -> State:
        """State in another dtype."""
        return State._make(None if x is None else x.to(dtype) for x in self)


def require_state(x: Any) -> None:
    """Raise unless x is a state with positions and velocities."""
    if not isinstance(x, State):
        raise ArgumentError(
            f"state must be a torchdq.scene.State, found {type(x).__name__}; scene.start(q, qd) makes one, "
            f"and states.last is the last one of a rollout"
        )
    for name in ("q", "qd"):
        require_tensor(f"{name} of the state", getattr(x, name))


def initial_motion(spec: SceneSpec, given: Mapping[str, Tensor | None]) -> dict[str, Tensor]:
    """Positions and velocities of a state, by name, with common batch axes; those not given are zero, a pose is 1."""
    require_tensor("q", given["q"])
    present = {name: tensor_in(x) for name, x in given.items() if x is not None}
    batch = batch_of(Stage(spec, "start"), present)
    q = present["q"]
    moved = {name: q.new_zeros(width) for name, width in spec.moving.items()}
    for name in {*POSES} & moved.keys():
        if name in present:
            require_unit(name, present[name])
        moved[name] = torch.eye(1, POSE, dtype=q.dtype, device=q.device)[0].repeat(spec.moving[name] // POSE)
    # clones, so that later changes of q do not move the state
    return {name: x.clone().expand(*batch, x.shape[-1]) for name, x in {**moved, **present}.items()}


def require_unit(name: str, poses: Tensor) -> None:
    """Raise unless poses [..., 8 bodies], those with NaN apart, are unit dual quaternions."""
    unit(LABELS.get(name, name), poses.unflatten(-1, (-1, POSE)))


def nonfinite_rows(state: State, robot: Robot) -> str:
    """Message about rows of an initial state that are not finite; "" if there are none."""
    bad = ~state.finite()
    if not bool(bad.any()):
        return ""
    row = tuple(bad.nonzero()[0].tolist())
    rows = {name: x for name, x in state.rows().items() if not bool(x[row].isfinite().all())}
    name = next(iter(rows))
    found = f"{'the memory of the effects' if name == 'memory' else LABELS.get(name, name)} is not finite"
    for name, x in (("qd", state.qd), ("q", state.q)):
        wrong = ~x[row].isfinite()
        if bool(wrong.any()):
            joint = int(wrong.long().argmax())
            found = f"{name} of joint {robot.joint_names[joint]!r} is {float(x[row][joint]):g}"
    where = f"the first is row {', '.join(map(str, row))}, where {found}" if row else found
    return f"{int(bad.sum())} of {bad.numel()} rows have a non-finite initial state and will remain non-finite: {where}"


def outside_limits(q: Tensor, effects: Sequence[Effect], robot: Robot) -> str:
    """Message about a position far outside the limits that effects simulate; "" if there is none."""
    if without_values((q,)) or not q.numel():
        return ""
    q = q.detach()
    for bounds in [found for effect in effects if (found := effect.free_range()) is not None]:
        low, high = (tensor_of(x).detach() for x in bounds)
        if without_values((low,)) or without_values((high,)):
            continue
        low, high = low.to(q), high.to(q)
        beyond = torch.maximum(low - q, q - high)
        rows = (beyond > OUTSIDE).any(-1)
        if not bool(rows.any()):
            continue
        at = torch.unravel_index(beyond.nan_to_num(0.0).argmax(), beyond.shape)
        at_limit, value = torch.where(q < low, low, high)[at], q.expand_as(beyond)[at]
        return (
            f"{int(rows.sum())} of {rows.numel()} rows start far outside their JointLimits: joint "
            f"{robot.joint_names[int(at[-1])]!r} is at {float(value):.3g}, its limit {float(at_limit):.3g}; the spring "
            f"of the limit throws it back, faster than a step can follow. Start within the limits, or give "
            f"JointLimits(lower, upper) that allow it"
        )
    return ""


def bent_balls(q: Tensor, robot: Robot) -> str:
    """Message about ball joints whose three hinges come to where they cannot turn freely; "" if there is none."""
    balls = {x.subject for x in robot.notes if x.code == BALL}
    if not balls or without_values((q,)) or not q.numel():
        return ""
    cosines = q.detach().cos().abs().reshape(-1, robot.n).amin(0).tolist()
    bent = [x for x, cos in zip(robot.joint_names, cosines, strict=True) if cos < BENT]
    found = [x for x in bent if x.endswith("_y") and f"ball joint {x[:-2]!r}" in balls]
    if not found:
        return ""
    return (
        f"found {', '.join(found)} of robot {robot.name!r} near a right angle, where the hinges of a ball joint cannot "
        "turn freely; stay below 70 degrees (1.2 rad)"
    )
