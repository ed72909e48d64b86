"""Equations of motion of a scene on tensors: every evaluation is a program of its own.

For integrators that are not recorded into the program of a step, and for the analysis of their stability.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdq import dq
from torchdq.algebra.quaternion import Number
from torchdq.dynamics.posed import Row
from torchdq.effects.residual import NAME as RESIDUAL
from torchdq.scene import free_base
from torchdq.scene.free_base import POSE, TWIST
from torchdq.scene.integrators import System
from torchdq.scene.spec import Task
from torchdq.scene.state import State

if TYPE_CHECKING:
    from torchdq.scene.scene import Scene


@dataclass(frozen=True)
class _Evaluated(System):
    """Equations of motion on rows that are lists of one tensor [..., n]."""

    scene: Scene
    inputs: Mapping[str, Tensor]

    def _evaluated(self, stage: str, **given: Tensor) -> list[Tensor]:
        return [self.scene.evaluate(stage, {**given, **self.inputs})["a"]]

    @property
    def _free(self) -> int:
        """Numbers of the twist of a free base."""
        return TWIST if self.scene.robot.floating else 0

    def _joints(self, x: Tensor) -> Tensor:
        """Positions of joints and rotors."""
        return x[..., :-POSE] if self._free else x

    def moved(self, x: Row, h: Number, rate: Row) -> list[Number]:
        displacement, joints = h * rate[0], self._joints(x[0])
        joints = joints + displacement[..., : joints.shape[-1]]
        if not self._free:
            return [joints]
        return [torch.cat([joints, dq.mul(x[0][..., -POSE:], dq.exp(0.5 * displacement[..., -TWIST:]))], -1)]

    def rates(self, h: Number, rate: Row, v: Row) -> Row:
        if not self._free:
            return v
        displacement, twist = (y[..., -TWIST:].unbind(-1) for y in (h * rate[0], v[0]))
        base = torch.stack(free_base.rate(displacement, twist, free_base.EXACT), -1)
        return [torch.cat([v[0][..., :-TWIST].expand(*base.shape[:-1], -1), base], -1)]

    def sizes(self, x: Row) -> Row:
        joints = self._joints(x[0]).abs()
        return [torch.cat([joints, joints.new_ones(*joints.shape[:-1], self.scene.spec.inner + self._free)], -1)]

    def accelerations(self, x: Row, v: Row) -> list[Tensor]:
        return self._evaluated("accelerations", x=x[0], v=v[0])

    def implicit_accelerations(self, x: Row, v: Row, h: float) -> list[Tensor]:
        return self._evaluated("implicit_accelerations", x=x[0], v=v[0], h=x[0].new_full((1,), h))

    def momentum_accelerations(self, x: Row, v: Row) -> list[Tensor]:
        return self._evaluated("momentum_accelerations", x=x[0], v=v[0])

    def velocities_at(self, x: Row, v: Row, to: Row) -> list[Tensor]:
        return self._evaluated("velocities_at", x=x[0], v=v[0], to=to[0])


def driven(
    scene: Scene, state: State, inputs: Mapping[str, Tensor], task: Task | None = None
) -> tuple[_Evaluated, Tensor, Tensor, dict[str, Tensor]]:
    """Equations of motion over a step, the positions x and velocities v to integrate, and the rows for `sense`."""
    rows = scene.evaluate("drive", {**state.rows(), **inputs}, task)
    x, v = rows.pop("x"), rows.pop("v")
    acting = {name: inputs[name] for effect in scene.effects for name in effect.inputs(scene.n) if name in inputs}
    acting["u"] = rows["u"]

    def accelerations(held: Tensor | None) -> Tensor:
        given = acting if held is None else {**acting, RESIDUAL: held}
        return scene.evaluate("accelerations", {"x": x, "v": v, **given})["a"][..., : scene.n]

    learned = learned_effect(scene)
    held = {} if learned is None else {RESIDUAL: learned.torques(state.q, state.qd, accelerations)}
    return _Evaluated(scene, {**acting, **held}), x, v, rows


def learned_effect(scene: Scene) -> Any:
    """Effect whose torques are computed before a step; None: there is none."""
    return next((effect for effect in scene.effects if effect.computed(scene.n)), None)


def with_held(
    scene: Scene, state: State, inputs: Mapping[str, Tensor], task: Task | None = None
) -> Mapping[str, Tensor]:
    """Inputs of the program of a step, those that the scene computes before it included."""
    if learned_effect(scene) is None:
        return inputs
    system, *_ = driven(scene, state, inputs, task)
    return {**inputs, RESIDUAL: system.inputs[RESIDUAL]}
