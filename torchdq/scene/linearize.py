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

from torchdq.backends.call import batch_of, evaluate
from torchdq.errors import ArgumentError
from torchdq.scene.integrators import Unrecorded
from torchdq.scene.model import AnyScene, SceneModel
from torchdq.scene.recording import Stage
from torchdq.scene.state import State, require_state


class Linearization(NamedTuple):
    """Linear system of a step: s' + ds' = s' + A ds + B du.

    A state s has its rows one after the other: q, qd, then memory and reading where there are such.
    """

    A: Tensor  # [..., s, s] derivative with respect to the state before the step
    B: Tensor  # [..., s, n] derivative with respect to the torques


def linearize(
    scene: SceneModel, state: State, torque: Tensor | None = None, noise: Tensor | None = None, **inputs: Tensor | None
) -> Linearization:
    """Derivatives of the state after a step, with respect to the state before it and the torques: `A, B`.

    A floating base is refused, since its pose has 8 components for 6 directions. There `torch.func.jacrev` of `step`
    gives the derivatives in these components.

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
    if scene.robot.floating:
        raise ArgumentError(
            f"robot {scene.robot.name!r} must have a fixed base to be linearized, found a floating one, whose pose has "
            "8 components for 6 directions; differentiate scene.step with torch.func.jacrev, which gives the "
            "derivatives in these components, or take finite differences of it"
        )
    scene.spec.require_inputs(inputs)
    torque = state.q.new_zeros(scene.n) if torque is None else torque
    given = {name: x for name, x in {**inputs, "noise": noise}.items() if x is not None}
    batch_of(Stage(scene.spec, "step"), {**state.rows(), "torque": torque, **given})  # raises, naming what does not fit
    parts = [*state.rows().values(), torque]
    batch = torch.broadcast_shapes(*(x.shape[:-1] for x in (*parts, *given.values())), *scene.batches.values())
    names, widths = tuple(state.rows()), [x.shape[-1] for x in parts]

    def after(z: Tensor) -> Tensor:
        *rows, u = z.split(widths, -1)
        stepped = scene.step(State(**dict(zip(names, rows, strict=True))), u, **given)
        return torch.cat(list(stepped.rows().values()), -1)

    ends, pull, *_ = torch.func.vjp(after, torch.cat([x.expand(*batch, x.shape[-1]) for x in parts], -1))
    s = ends.shape[-1]
    # samples do not depend on each other, so that one gradient per row of the state is enough for all of them
    units = torch.eye(s, dtype=ends.dtype, device=ends.device).reshape(s, *[1] * len(batch), s)
    (found,) = torch.func.vmap(pull)(units.expand(s, *ends.shape))
    A, B = found.movedim(0, -2).split([s, scene.n], -1)
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
