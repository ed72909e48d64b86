"""Compilation ahead of time, and inspection of the compiled program."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from torchdq.backends import c_source, cuda_source
from torchdq.backends.choice import choose
from torchdq.call import Computation, evaluate
from torchdq.checks import dtype_of, names_of, require_choice, require_tensor
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.catalogue import RECIPES, Function
from torchdq.functions.options import options_of
from torchdq.program.autograd import vjp
from torchdq.program.program import Argument, Count, Program
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.robot import SHAPES, constants
from torchdq.robot.robot import arguments as tensors_of

CPU = torch.device("cpu")
Language = Literal["c", "cuda"]


class _RecordedFields(NamedTuple):
    """Fields of `RecordedComputation`."""

    recorded: Program


class RecordedComputation(_RecordedFields, Computation):
    """Program that is recorded already, as a computation of `torchdq.call`."""

    def _argument(self, name: str) -> Argument:
        return next(a for a in self.recorded.arguments if a.name == name)

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument."""
        return (self._argument(name).width,)

    def shared(self, name: str) -> bool:
        """Whether an argument is one row for all samples."""
        return self._argument(name).uniform

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Recorded program."""
        return self.recorded


@dataclass(frozen=True, eq=False)
class CompiledProgram:
    """Program of a robot in one precision, which can be called, differentiated, counted and printed.

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

    def source(self, language: Language = "c") -> str:
        """Source code in a language: C with vectors, as it runs on the CPU, or CUDA C++, as it runs on a GPU."""
        require_choice("language", language, get_args(Language))
        printed = {"c": c_source.source, "cuda": cuda_source.source}[language]
        return printed(self.program, self.dtype == torch.float32)

    def vjp(self, wrt: Sequence[str] | None = None) -> CompiledProgram:
        """Compiled vector-Jacobian product: takes the arguments and a cotangent per result, returns the gradients.

        Args:
            wrt: names of the arguments to differentiate with respect to; None: all of them.
        """
        names = [a.name for a in self.program.arguments]
        for name in wrt or ():
            if name not in names:
                raise UnknownNameError(f"argument of {self.program.name}", name, names)
        positions = tuple(k for k, name in enumerate(names) if wrt is None or name in wrt)
        return _ready(vjp(self.program, positions), self.dtype)

    def __call__(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Results [..., width] of arguments [..., width]; uniform arguments are [width]."""
        arguments = self.program.arguments
        if len(inputs) != len(arguments):
            raise ArgumentError(f"{self.program.name} takes {[a.name for a in arguments]}, found {len(inputs)} tensors")
        for a, x in zip(arguments, inputs, strict=True):
            require_tensor(a.name, x)
            if x.dtype != self.dtype or x.shape[-1:] != (a.width,) or (a.uniform and x.ndim > 1):
                expected = f"{self.dtype} tensor [{'' if a.uniform else '..., '}{a.width}]"
                raise ArgumentError(f"{a.name} must be a {expected}, found {x.dtype} {tuple(x.shape)}")
        given = {a.name: x for a, x in zip(arguments, inputs, strict=True)}
        results = tuple(evaluate(RecordedComputation(self.program), given).values())
        return results[0] if len(results) == 1 else results

    def __str__(self) -> str:
        return str(self.program)


def _ready(recorded: Program, dtype: torch.dtype) -> CompiledProgram:
    choose(None, CPU).kernel(recorded, dtype, CPU)
    return CompiledProgram(recorded, dtype)


def compile(
    robot: Robot,
    function: str,
    dtype: torch.dtype | str = torch.float64,
    arguments: Sequence[str] | None = None,
    options: Sequence[str] = (),
) -> CompiledProgram:
    """Compiled program of a function for a robot, built and cached now instead of at the first call.

    Args:
        robot: the robot; its tensors are constants of the program, replaced tensors are arguments.
        function: "inverse_dynamics", "forward_dynamics", "mass_matrix", "closed_form", "regressor", "jacobian",
            "forward_kinematics", "kinetic_energy", "potential_energy", "inverse_dynamics_jacobian", "computed_torque".
        dtype: float32 or float64, or the name of one.
        arguments: names of the arguments that calls will pass; None: all but the wrenches.
        options: names of the frames for "forward_kinematics", by default all; a frame and "body" (the default) or
            "world" for "jacobian"; the tip or "" for "closed_form", by default the robot's; "kp" and "kd" for
            "computed_torque" if they are one number for all joints.
    Raises:
        UnknownNameError: there is no such function, argument or frame.
        ArgumentError: an option means nothing to the function.
        BuildError: the C compiler failed. Without one the program runs as torch operations, and a warning says so once.
    """
    require_robot(robot)
    names_of("function", function, RECIPES, "function that is compiled")
    known = [name for name, _, _ in RECIPES[function].arguments]
    present = [name for name in known if name not in ("f_tip", "f_ext")]
    if arguments is not None:
        present = list(names_of("arguments", arguments, known, f"argument of {function}"))
    what = Function(constants(robot), function, options_of(robot, function, options))
    widths = {name: math.prod(what.axes(name)) for name in (*known, *tensors_of(robot))}
    taken = [Argument(name, widths[name]) for name in known if name in present]
    taken += [
        Argument(name, widths[name], getattr(robot, name).ndim == len(SHAPES[name])) for name in tensors_of(robot)
    ]
    return _ready(what.program(tuple(taken)), dtype_of("dtype", dtype))
