"""Compiling ahead of time, and looking at what was compiled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torchdq.backends import c, run
from torchdq.backends import choice as backends
from torchdq.errors import ArgumentError, DtypeError, UnknownNameError
from torchdq.functions.catalogue import RECIPES, Signature, program
from torchdq.program.program import Count, Program
from torchdq.robot import Robot
from torchdq.robot.robot import DTYPES, SHAPES


@dataclass(frozen=True, eq=False)
class CompiledProgram:
    """A program of a robot in one precision: counted, printed, differentiated and called.

    >>> import torchdq
    >>> tau = torchdq.compile(torchdq.robots.load("two_link"), "inverse_dynamics")
    >>> tau.count().multiplications
    14
    >>> tau(*torch.zeros(3, 5, 2, dtype=torch.float64)).shape
    torch.Size([5, 2])
    """

    program: Program
    dtype: torch.dtype

    def count(self) -> Count:
        """Operations per sample."""
        return self.program.count()

    def source(self, language: Literal["c"] = "c") -> str:
        """Source text in a language."""
        if language != "c":
            raise ArgumentError(f"language must be 'c', found {language!r}")
        return c.source(self.program, self.dtype == torch.float32)

    def vjp(self, wrt: Sequence[str] | None = None) -> CompiledProgram:
        """Compiled vector-Jacobian product: takes the arguments and a cotangent per result, returns the gradients.

        Args:
            wrt: names of the arguments to differentiate in; None: all of them.
        """
        names = [a.name for a in self.program.arguments]
        for name in wrt or ():
            if name not in names:
                raise UnknownNameError(f"argument of {self.program.name}", name, names)
        positions = tuple(k for k, name in enumerate(names) if wrt is None or name in wrt)
        return _ready(run.vjp(self.program, positions), self.dtype)

    def __call__(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Results [..., width] of arguments [..., width]; those that are uniform are [width]."""
        arguments = self.program.arguments
        if len(inputs) != len(arguments):
            raise ArgumentError(f"{self.program.name} takes {[a.name for a in arguments]}, found {len(inputs)} tensors")
        for a, x in zip(arguments, inputs, strict=True):
            if x.dtype != self.dtype or x.shape[-1:] != (a.width,):
                raise ArgumentError(
                    f"{a.name} must be a {self.dtype} tensor [..., {a.width}], found {x.dtype} {tuple(x.shape)}"
                )
        batches = [x.shape[:-1] for a, x in zip(arguments, inputs, strict=True) if not a.uniform]
        batch = torch.broadcast_shapes(*batches)
        rows = [
            x if a.uniform else x.expand(*batch, a.width).reshape(math.prod(batch), a.width)
            for a, x in zip(arguments, inputs, strict=True)
        ]
        compiled = backends.choose(None, inputs[0].device.type) == "c"
        outputs = (run.compiled if compiled else run.eager)(self.program, rows)
        results = tuple(
            y if r.summed else y.reshape(*batch, y.shape[-1])
            for y, r in zip(outputs, self.program.results, strict=True)
        )
        return results[0] if len(results) == 1 else results

    def __str__(self) -> str:
        return str(self.program)


def _ready(recorded: Program, dtype: torch.dtype) -> CompiledProgram:
    if backends.choose(None, "cpu") == "c":
        run.kernel(recorded, dtype == torch.float32)
    return CompiledProgram(recorded, dtype)


def compile(
    robot: Robot,
    function: str,
    dtype: torch.dtype = torch.float64,
    arguments: Sequence[str] | None = None,
    options: Sequence[str] = (),
) -> CompiledProgram:
    """Compiled program of a function for a robot, built and cached now rather than at the first call.

    Args:
        robot: the robot; its tensors are constants of the program, those that were replaced are arguments.
        function: "inverse_dynamics", "forward_dynamics", "mass_matrix", "closed_form", "regressor", "jacobian",
            "forward_kinematics", "kinetic_energy", "potential_energy", "inverse_dynamics_jacobian".
        dtype: float32 or float64.
        arguments: names of the arguments that will be present; None: all but the wrenches.
        options: names of the frames for "forward_kinematics", a frame and "body" or "world" for "jacobian", the tip or
            "" for "closed_form".
    Raises:
        UnknownNameError: there is no such function or argument.
        BuildError: the C compiler failed. Without one the program runs as torch operations, and a warning says so once.
    """
    if function not in RECIPES:
        raise UnknownNameError("function that is compiled", function, RECIPES)
    if dtype not in DTYPES:
        raise DtypeError(f"dtype must be float32 or float64, found {dtype}")
    known = {name: axes for name, axes, _ in RECIPES[function].arguments}
    present = [name for name in known if name not in ("f_tip", "f_ext")] if arguments is None else list(arguments)
    for name in present:
        if name not in known:
            raise UnknownNameError(f"argument of {function}", name, known)

    def width(axes: Sequence[int | str]) -> int:
        return math.prod(robot.n if axis == "n" else int(axis) for axis in axes)

    fields = [(name, getattr(robot, name)) for name in robot.varying]
    signature = Signature(
        robot.identity,
        function,
        tuple((name, width(axes)) for name, axes in known.items() if name in present),
        tuple((name, width(SHAPES[name]), x.ndim == len(SHAPES[name])) for name, x in fields),
        tuple(options),
    )
    return _ready(program(robot.origin or robot, signature), dtype)
