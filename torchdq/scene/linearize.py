"""Derivatives of a step: its linearization on tensors, and one compiled program of the state and its Jacobian matrix.

`linearize` serves every scene, by reverse mode through the program of a step. `StepMap` differentiates the program
itself, by forward mode: every column of the Jacobian matrix is recorded with the others, so that they share their
common terms, and the many that vanish cost nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, NamedTuple

import torch
from torch import Tensor

from torchdq import dq
from torchdq.backends.call import batch_of, evaluate
from torchdq.errors import ArgumentError
from torchdq.scene.free_base import POSE
from torchdq.scene.integrators import Unrecorded
from torchdq.scene.model import AnyScene, SceneModel
from torchdq.scene.recording import Stage
from torchdq.scene.state import State, require_state

ORDER = ("X_WB", "q", "V_WB_B", "qd", "memory", "reading")  # of the rows of a state in a linearization
PURE = [1, 2, 3, 5, 6, 7]  # numbers of a pure dual quaternion


class Linearization(NamedTuple):
    """Linear system of a step: s' + ds' = s' + A ds + B du.

    The numbers of ds are (q, qd) for a fixed base and (xi, q, V_WB_B, qd) for a floating one, then memory and reading
    where there are such. xi, six numbers, displaces the pose to X_WB exp(xi/2): a rotation and a translation (angular,
    linear) in the axes of the base [rad, m].
    """

    A: Tensor  # [..., s, s] derivative with respect to the state before the step
    B: Tensor  # [..., s, n] derivative with respect to the torques


def linearize(
    scene: SceneModel, state: State, torque: Tensor | None = None, noise: Tensor | None = None, **inputs: Tensor | None
) -> Linearization:
    """Derivatives of the state after a step, with respect to the state before it and the torques: `A, B`.

    `2 * dq.log_shortest(dq.mul(dq.conj(X), X_WB))` is the displacement xi of a floating base from a pose X.

    Args:
        state: states, shape [..., n]; derivatives are those of every row by itself.
        torque, noise, inputs: as in `step`.

    >>> import torch, torchdq
    >>> scene = torchdq.Scene(torchdq.robots.load("two_link"), dt=0.01)
    >>> A, B = scene.linearize(scene.start(torch.zeros(5, 2)))
    >>> A.shape, B.shape
    (torch.Size([5, 4, 4]), torch.Size([5, 4, 2]))
    """
    require_state(state)
    scene.spec.require_inputs(inputs)
    torque = state.q.new_zeros(scene.n) if torque is None else torque
    given = {name: x for name, x in {**inputs, "noise": noise}.items() if x is not None}
    batch_of(Stage(scene.spec, "step"), {**state.rows(), "torque": torque, **given})  # raises, naming what does not fit
    rows = state.rows()
    names = [name for name in ORDER if name in rows]
    parts = [*(rows[name] for name in names), torque]
    widths = [x.shape[-1] for x in parts]
    batch = torch.broadcast_shapes(*(x.shape[:-1] for x in (*parts, *given.values())), *scene.batches.values())

    def after(z: Tensor) -> Tensor:
        *before, u = z.split(widths, -1)
        found = scene.step(State(**dict(zip(names, before, strict=True))), u, **given).rows()
        return torch.cat([found[name] for name in names], -1)

    ends, pull, *_ = torch.func.vjp(after, torch.cat([x.expand(*batch, x.shape[-1]) for x in parts], -1))
    units = torch.eye(ends.shape[-1], dtype=ends.dtype, device=ends.device).expand(*batch, -1, -1)
    if scene.robot.floating:  # a pose X changes by dX = X xi/2, so that xi = 2 conj(X) dX
        displaced = 2 * dq.hamilton_left(dq.conj(ends[..., :POSE]))[..., PURE, :]
        units = torch.cat([torch.nn.functional.pad(displaced, (0, units.shape[-1] - POSE)), units[..., POSE:, :]], -2)
    # samples do not depend on each other, so that one gradient per row of the state is enough for all of them
    (found,) = torch.func.vmap(pull)(units.movedim(-2, 0))
    found = found.movedim(0, -2)
    if scene.robot.floating:
        directions = dq.hamilton_left(rows["X_WB"])[..., PURE] / 2
        found = torch.cat([found[..., :POSE] @ directions, found[..., POSE:]], -1)
    A, B = found.split([units.shape[-2], scene.n], -1)
    return Linearization(A, B)


@dataclass(frozen=True)
class StepMap(Generic[AnyScene]):
    """Step of a scene as a function of rows [N, s], each the q, qd and memory of a state, and its derivatives.

    Args:
        scene: of a robot with a fixed base, without sensors, with an integrator that is recorded.
        inputs: names of the inputs that are given at every step.
    """

    scene: AnyScene
    inputs: tuple[str, ...]

    def __post_init__(self) -> None:
        scene, spec = self.scene, self.scene.spec
        if scene.robot.floating:
            raise ArgumentError(f"robot {scene.robot.name!r} must have a fixed base for derivatives of a step")
        if isinstance(scene.integrator, Unrecorded):
            kind = type(scene.integrator).__name__
            raise ArgumentError(f"integrator must be one that is recorded, for derivatives of a step, found {kind}")
        if found := [type(e).__name__ for e in scene.effects if e.SLOT == "sensor" or e.computed(scene.n)]:
            raise ArgumentError(f"effects of the scene must be without {found[0]}, for derivatives of a step")
        if found := [name for name, batch in scene.batches.items() if batch]:
            raise ArgumentError(f"{found[0]} of the scene must be without batch axes, for derivatives of a step")
        Stage(spec, "step").check(dict.fromkeys((*spec.state, *self.inputs), torch.zeros(1)))

    @cached_property
    def widths(self) -> dict[str, int]:
        """Names and widths of the parts of a row."""
        return self.scene.spec.state

    def _given(self, s: Tensor, inputs: Mapping[str, Tensor], parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        parts = s.split(list(self.widths.values()), -1)
        given = dict(zip(self.widths, parts, strict=True)) | {name: inputs[name] for name in self.inputs}
        return given | self.scene.parameters | dict(parameters)

    def after(self, s: Tensor, inputs: Mapping[str, Tensor], parameters: Mapping[str, Tensor]) -> Tensor:
        """Rows after a step [N, s]; `parameters`, by "owner.name", replace those of the scene."""
        found = evaluate(Stage(self.scene.spec, "step"), self._given(s, inputs, parameters), self.scene.backend)
        return torch.cat([found[name] for name in self.widths], -1)

    def linearised(
        self, s: Tensor, inputs: Mapping[str, Tensor], parameters: Mapping[str, Tensor], wrt: tuple[str, ...]
    ) -> tuple[Tensor, Tensor]:
        """Rows after a step [N, s], and derivatives [N, s, s + w] in those before, and in inputs and parameters."""
        what = Stage(self.scene.spec, "step", wrt=(*self.widths, *wrt))
        found = evaluate(what, self._given(s, inputs, parameters), self.scene.backend)
        return found["after"], found["J"]
