"""Derivatives of a step with respect to its state, inputs and parameters: one compiled program for a batch of rows.

Forward-mode differentiation of the program of a step, every column of the Jacobian matrix recorded with the others, so
that they share their common terms, and the many that vanish cost nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.call import Computation, evaluate
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.errors import ArgumentError
from torchdq.program.autodiff import jacobian
from torchdq.program.program import Argument, Program, Result
from torchdq.scene.integrators import Unrecorded
from torchdq.scene.recording import Stage
from torchdq.scene.scene import Scene


class _StepJacobianFields(NamedTuple):
    """Fields of `StepJacobian`."""

    stage: Stage
    wrt: tuple[str, ...]  # names of arguments, the state's first


class StepJacobian(_StepJacobianFields, Computation):
    """State after a step [s] and its Jacobian matrix [s, w], as a computation of `torchdq.backends.call`."""

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an input or a parameter of the step."""
        return self.stage.axes(name)

    def shared(self, name: str) -> bool:
        """True for a parameter."""
        return self.stage.shared(name)

    def label(self, name: str) -> str:
        """Name without its owner."""
        return self.stage.label(name)

    def subject(self) -> str:
        """Robot that shapes are for, in error messages."""
        return self.stage.subject()

    def check(self, tensors: Mapping[str, Any]) -> None:
        """Raise as the step itself does."""
        self.stage.check(tensors)

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Axis of the state; its rows, and columns of the arguments."""
        after, J = (len(result.values) for result in program.results)
        return (after,), (after, J // after)

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the state and the matrix, row by row, recorded once."""
        return _program(self, arguments)


@remembered(PROGRAMS)
def _program(what: StepJacobian, arguments: tuple[Argument, ...]) -> Program:
    step = what.stage.program(arguments)
    taken = [next(k for k, a in enumerate(arguments) if a.name == name) for name in what.wrt]
    derived = jacobian(step, taken, values=True)
    block = {result.name: result.values for result in derived.results}
    rows = [
        value
        for result in step.results
        for i in range(len(result.values))
        for a in (arguments[k] for k in taken)
        for value in block[f"d{result.name}/d{a.name}"][i * a.width : (i + 1) * a.width]
    ]
    after = [value for result in step.results for value in block[result.name]]
    return replace(derived, results=(Result("after", tuple(after)), Result("J", tuple(rows))))


@dataclass(frozen=True)
class StepMap:
    """Step of a scene as a function of rows [N, s], each the q, qd and memory of a state, and its derivatives.

    Args:
        scene: of a robot with a fixed base, without sensors, with an integrator that is recorded.
        inputs: names of the inputs that are given at every step.
    """

    scene: Scene
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
        return given | self.scene._parameters | dict(parameters)

    def after(self, s: Tensor, inputs: Mapping[str, Tensor], parameters: Mapping[str, Tensor]) -> Tensor:
        """Rows after a step [N, s]; `parameters`, by "owner.name", replace those of the scene."""
        given = self._given(s, inputs, parameters)
        found = evaluate(Stage(self.scene.spec, "step"), given, self.scene.backend)
        return torch.cat([found[name] for name in self.widths], -1)

    def linearised(
        self, s: Tensor, inputs: Mapping[str, Tensor], parameters: Mapping[str, Tensor], wrt: tuple[str, ...]
    ) -> tuple[Tensor, Tensor]:
        """Rows after a step [N, s], and derivatives [N, s, s + w] in those before, and in inputs and parameters."""
        what = StepJacobian(Stage(self.scene.spec, "step"), (*self.widths, *wrt))
        found = evaluate(what, self._given(s, inputs, parameters), self.scene.backend)
        return found["after"], found["J"]
