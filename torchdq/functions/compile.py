"""Compilation ahead of time, and inspection of the compiled program."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from torchdq.backends import c_loop, cuda_source
from torchdq.backends.call import Computation, results_of
from torchdq.backends.choice import choose
from torchdq.backends.fast_call import quick
from torchdq.base.checks import dtype_of, names_of, require_choice, require_count, require_tensor
from torchdq.control import LAWS
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.export import casadi, golden, graph
from torchdq.export.c99 import CFunction, Library
from torchdq.export.casadi import CasadiExport
from torchdq.export.files import Export, Exported, path_of
from torchdq.export.meaning import constants as constants_of
from torchdq.export.meaning import heading, rigid
from torchdq.export.names import distinct, identifier
from torchdq.functions import arrays
from torchdq.functions.catalogue import RECIPES, Function
from torchdq.functions.options import options_of
from torchdq.numbers.ops import Count
from torchdq.program.autodiff import jacobian
from torchdq.program.autograd import vjp
from torchdq.program.program import Argument, Program
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.robot import arguments as tensors_of
from torchdq.robot.robot import constants

CPU = torch.device("cpu")
Language = Literal["c", "cuda"]
ExportLanguage = Literal["c", "casadi", "torch"]
OF_FORCES = {"tau", "g", "p", "Y", "H", "U", "F_B", "rate"}  # arguments and results that depend on gravity or friction


class _RecordedFields(NamedTuple):
    """Fields of `RecordedComputation`."""

    recorded: Program


class RecordedComputation(_RecordedFields, Computation):
    """Program that is recorded already, as a computation of `torchdq.backends.call`."""

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument."""
        return next((a.width,) for a in self.recorded.arguments if a.name == name)

    def shared(self, name: str) -> bool:
        """Whether an argument is one row for all samples."""
        return next(a.uniform for a in self.recorded.arguments if a.name == name)

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Recorded program."""
        return self.recorded


@dataclass(frozen=True, eq=False)
class CompiledProgram:
    """Program of a robot in one precision, which can be called, differentiated, counted and exported.

    It prints as a summary; `print(compiled.program)` lists every operation.

    >>> import torchdq
    >>> tau = torchdq.compile(torchdq.robots.load("two_link"), "inverse_dynamics")
    >>> tau
    inverse_dynamics_two_link(q[2], qd[2], qdd[2]) -> tau[2]
      float64, 14 multiplications, 10 additions, 4 sines per sample
      print its attribute `program` for the list of all operations
    >>> tau(*torch.zeros(3, 5, 2, dtype=torch.float64)).shape
    torch.Size([5, 2])
    """

    program: Program
    dtype: torch.dtype
    axes: tuple[tuple[int, ...], ...]  # trailing axes of the results
    about: tuple[str, ...] = ()  # lines about the robot, for exported files
    examples: Mapping[str, Tensor] = field(default_factory=dict, repr=False)  # values of arguments that are parameters

    def count(self) -> Count:
        """Operations per sample."""
        return self.program.count()

    def source(self, language: Language = "c") -> str:
        """Source code in a language: C with vectors, as it runs on the CPU, or CUDA C++, as it runs on a GPU."""
        require_choice("language", language, get_args(Language))
        single = self.dtype == torch.float32
        return c_loop.source(self.program, single) if language == "c" else cuda_source.source(self.program, single)

    def vjp(self, wrt: Sequence[str] | None = None) -> CompiledProgram:
        """Compiled vector-Jacobian product: takes the arguments and a cotangent per result, returns the gradients.

        Args:
            wrt: names of the arguments to differentiate with respect to; None: all of them.
        """
        return self._derived(_ready(vjp(self.program, self._positions(wrt)), self.dtype))

    def jacobian(self, wrt: Sequence[str] | None = None) -> CompiledProgram:
        """Compiled Jacobians of all results, row by row: takes the arguments, returns one for each result and argument.

        Args:
            wrt: names of the arguments to differentiate with respect to; None: all of them.
        """
        positions = self._positions(wrt)
        widths = [self.program.arguments[k].width for k in positions]
        shapes = tuple((len(r.values), width) for width in widths for r in self.program.results)
        return self._derived(_ready(jacobian(self.program, positions), self.dtype, shapes))

    def _positions(self, wrt: Sequence[str] | None) -> tuple[int, ...]:
        names = [a.name for a in self.program.arguments]
        for name in wrt or ():
            if name not in names:
                raise UnknownNameError(f"argument of {self.program.name}", name, names)
        return tuple(k for k, name in enumerate(names) if wrt is None or name in wrt)

    def _derived(self, derivative: CompiledProgram) -> CompiledProgram:
        return replace(derivative, about=self.about, examples=self.examples)

    def export(
        self,
        folder: str | PathLike[str],
        name: str = "",
        library: Library = "math.h",
        language: ExportLanguage = "c",
        batch: bool = False,
        knots: int = 0,
        derivatives: int = 2,
    ) -> Exported:
        """Files that need neither Python nor torch: a function in strict C99, and what its language wants beside it.

        The function takes one sample. It has no memory of its own, no loops and no heap, and may be called by several
        threads. Its arguments and outputs are those of the program, in its order, described in the header. A step, of
        which results are arguments of the same name, has a function NAME_rollout of many steps beside it in "c".

        "c" writes source, headers, a test and CMake files, which build all functions that are exported into a folder.
        "casadi" writes one source with the function, its Jacobians and
        second derivatives, for `casadi.external`, once it is built:

            cc -shared -fPIC -O2 arm_torques.c -o arm_torques.so -lm
            f = casadi.external("arm_torques", "./arm_torques.so")

        Arguments are columns in CasADi, results columns or matrices; a Jacobian has no place that is always zero. Where
        rounding errors are too large the function fails: a call in CasADi raises, a solver takes a shorter step. With
        `knots` it is what `f.map(knots)` is, a column per knot and matrices side by side, in vector instructions:

            cc -shared -fPIC -O2 -ftree-vectorize -march=native -fno-math-errno arm_torques.c \\
                -o arm_torques.so -lm

        Args:
            folder: path of the folder, which is made if it is not there; files of the same names are replaced.
            name: name of the function; "": that of the program.
            library: source of sine, cosine and roots: "math.h", or "own", the polynomials of compiled programs, with
                sine and cosine up to 1e5 rad (4e3 in float32), beyond which the function returns 1 and NaN, and
                square roots to 1 ulp, but no exponentials and logarithms.
            language: "c"; "casadi", which takes programs in float64; or "torch", a graph of torch operations for any
                number of samples, which `torch.export.load` reads.
            batch: whether there is a function NAME_batch beside it, which takes the rows of many samples and which
                compilers turn into vector instructions. Its sine and cosine are those of "own".
            knots: for "casadi": number of knots of every call, with sine and cosine of "own"; 0: one column.
            derivatives: for "casadi": 2, or 1 without second derivatives, which is quicker to build; Ipopt then wants
                "ipopt.hessian_approximation": "limited-memory".
        Raises:
            ArgumentError: the name is none that the language accepts or the files use it, the library lacks a function,
                a program in float32, or for batches, is exported to CasADi, or `knots` to C.

        >>> import tempfile, torchdq
        >>> tau = torchdq.compile(torchdq.robots.load("two_link"), "inverse_dynamics")
        >>> tau.export(tempfile.mkdtemp(), "arm_torques").header.name
        'arm_torques.h'
        """
        require_choice("library", library, get_args(Library))
        require_choice("language", language, get_args(ExportLanguage))
        path = path_of(folder)
        named = identifier(name or distinct([self.program.name])[0], "name", golden.variables(self.program))
        if language == "casadi":
            if batch:
                raise ArgumentError("batch must be False for language 'casadi', which has knots, or f.map(n)")
            return self._casadi(named, library, knots, derivatives).write(path)
        if language == "torch":
            return graph.write(path, named, self.program, self.dtype, self)
        if knots:
            raise ArgumentError(
                f"knots are for language 'casadi', found {knots!r}; in 'c', batch=True takes any number"
            )
        function = CFunction(self.program, named, self.dtype == torch.float32, library)
        return Export(function, self.about, batch).write(path, self.examples)

    def _casadi(self, name: str, library: Library, knots: int, derivatives: int) -> CasadiExport:
        """Source for CasADi; raises unless the program and the options have one."""
        if self.dtype != torch.float64:
            raise ArgumentError(
                f"language 'casadi' takes programs in float64, found {self.dtype}; leave out dtype in torchdq.compile"
            )
        require_count("knots", knots, 0)
        require_choice("derivatives", derivatives, (1, 2))
        return CasadiExport(
            self.program, self.axes, casadi.identifier(name), library, self.about, knots, derivatives == 2
        )

    def __call__(self, *inputs: Tensor, out: Tensor | Sequence[Tensor] | None = None) -> Tensor | tuple[Tensor, ...]:
        """Results [..., width] of arguments [..., width]; uniform arguments are [width]; matrices are flat, row by row.

        On the CPU, a call takes two or three microseconds more than its program, from the second of a batch size on,
        and three times as much with arrays of NumPy: `torch.from_numpy` shares their memory, once before a loop.

        Args:
            inputs: the arguments of the program, in its order, tensors or arrays of NumPy; results are alike. Arrays
                that are read-only or have negative strides are copied.
            out: tensor for the result, or one for each result, writable, contiguous and apart from the memory of the
                arguments. They are written to and returned, and no memory is allocated for them. Not where gradients
                are recorded.
        Raises:
            ArgumentError: too few or too many arguments, or one of another shape or dtype; or `out` is not as above.

        >>> import torchdq
        >>> gravity = torchdq.compile(
        ...     torchdq.robots.load("two_link"), "inverse_dynamics", arguments=("q",)
        ... )
        >>> tau = torch.empty(2, dtype=torch.float64)
        >>> gravity(torch.zeros(2, dtype=torch.float64), out=tau) is tau
        True
        """
        room = () if out is None else out if isinstance(out, list | tuple) else (out,)
        key, _, found = quick((self.program, self.dtype, len(room)), inputs, room)
        if found is None:
            if inputs and isinstance(inputs[0], np.ndarray):
                return self._on_arrays(inputs, out)
            found = self._on_any_batch(inputs, room, key)
        return found[0] if len(found) == 1 else found

    def _on_arrays(self, inputs: Sequence[Any], out: Any) -> Any:
        """Results as arrays of NumPy."""
        self._require_as_many(inputs)
        rows = [arrays.argument(a.name, x, self.dtype) for a, x in zip(self.program.arguments, inputs, strict=True)]
        if out is not None:
            several = isinstance(out, list | tuple)
            given, results = out if several else (out,), self.program.results
            names = [f"out for {r.name}" for r in results] if len(given) == len(results) else ["out"] * len(given)
            self(*rows, out=[arrays.room(name, y, self.dtype) for name, y in zip(names, given, strict=True)])
            return tuple(out) if several else out
        found = self(*rows)
        return found.numpy() if isinstance(found, Tensor) else tuple([y.numpy() for y in found])

    def _require_as_many(self, inputs: Sequence[Any]) -> None:
        """Raise unless there is an input for every argument, and no other."""
        names = [a.name for a in self.program.arguments]
        if len(inputs) != len(names):
            raise ArgumentError(f"{self.program.name} takes {names}, found {len(inputs)} arguments")

    def _on_any_batch(self, inputs: Sequence[Tensor], out: Sequence[Tensor], key: Hashable) -> tuple[Tensor, ...]:
        """Results for any batch axes, on any device, with gradients."""
        arguments = self.program.arguments
        self._require_as_many(inputs)
        for a, x in zip(arguments, inputs, strict=True):
            require_tensor(a.name, x)
            if x.dtype != self.dtype or x.shape[-1:] != (a.width,) or (a.uniform and x.ndim > 1):
                expected = f"{self.dtype} tensor [{'' if a.uniform else '..., '}{a.width}]"
                raise ArgumentError(f"{a.name} must be a {expected}, found {x.dtype} {tuple(x.shape)}")
        given = {a.name: x for a, x in zip(arguments, inputs, strict=True)}
        return tuple(results_of(RecordedComputation(self.program), given, out=out, key=key)[1])

    def __repr__(self) -> str:
        results = [f"{r.name}{list(axes)}" for r, axes in zip(self.program.results, self.axes, strict=True)]
        counts = [f"{number} {name}" for name, number in self.count()._asdict().items() if number]
        return "\n".join(
            (
                f"{self.program.heading()} -> {', '.join(results)}",
                f"  {str(self.dtype).removeprefix('torch.')}, {', '.join(counts) or 'no operations'} per sample",
                "  print its attribute `program` for the list of all operations",
            )
        )


def _ready(recorded: Program, dtype: torch.dtype, axes: tuple[tuple[int, ...], ...] = ()) -> CompiledProgram:
    """Compiled program; its results are rows unless their trailing axes are given."""
    choose(None, CPU).kernel(recorded, dtype, CPU)
    return CompiledProgram(recorded, dtype, axes or tuple((len(r.values),) for r in recorded.results))


def _require_compilable(x: Any) -> None:
    """Raise unless x is a robot, with the way from a scene, a controller or a compiled program to a program."""
    if isinstance(x, CompiledProgram):
        raise ArgumentError(f"robot must be a torchdq.Robot, found {x.program.name!r}, which is compiled already")
    if callable(getattr(x, "program", None)):
        way = "program()" if isinstance(getattr(x, "robot", None), Robot) else "program(robot)"
        kind = type(x).__name__
        raise ArgumentError(f"robot must be a torchdq.Robot, found a {kind}; pass what its {way} returns")
    require_robot(x)


def _require_law(x: Any) -> None:
    """Raise if x has a program but is a class of laws, or has a robot of its own, as layers and scenes do."""
    if isinstance(x, type):
        raise ArgumentError(f"function must be an object, found the class {x.__name__}; call it to make an object")
    if isinstance(getattr(x, "robot", None), Robot):
        kind = type(x).__name__
        raise ArgumentError(
            f"function must be a name or a control law, found a {kind}; pass what its program() returns"
        )


def compile(
    robot: Robot | Program,
    function: Any = "",
    dtype: torch.dtype | str = torch.float64,
    arguments: Sequence[str] | None = None,
    options: Sequence[str] = (),
) -> CompiledProgram:
    """Compiled program of a function for a robot, built and cached now instead of at the first call.

    Args:
        robot: the robot; its tensors are constants of the program, replaced tensors are arguments. Or a program that is
            recorded already, such as the step of a scene, `scene.program()`, which needs no other argument but dtype.
        function: "inverse_dynamics", "forward_dynamics", "mass_matrix", "closed_form", "regressor", "jacobian",
            "forward_kinematics", "kinetic_energy", "potential_energy", "dynamics_jacobian",
            "inverse_dynamics_jacobian" (the same without the mass matrix), "dynamics_hessian",
            "forward_dynamics_hessian", "mass_matrix_derivative", "frame_motion", "operational_space", "manipulability",
            "coriolis_matrix", "distances", "differential_inverse_kinematics", "inverse_kinematics_step" and
            "inverse_kinematics_newton" (parts of the solver); of a robot with a floating base,
            "floating.inverse_dynamics" and so on. Or a control law: "computed_torque", "operational_space_control" or
            "cartesian_impedance", whose gains are arguments then; or an object of `torchdq.scene.controllers`, whose
            gains are constants where they are numbers, and arguments where they are tensors. All are of the rigid
            bodies alone: the programs of layers, such as `torchdq.ComputedTorque`, have friction.
        dtype: float32 or float64, or the name of one.
        arguments: names of the arguments that calls will pass; None: all but the wrenches.
        options: names of the frames for "forward_kinematics", by default all; a frame and "body" (the default) or
            "world" for "jacobian"; the tip or "" for "closed_form", by default the robot's. Of the dynamics of a frame:
            its name, "body" or "world", and axes such as "pose" or "x y rz", as far as they differ from the defaults.
            Of "distances": the points, a tuple of objects that are constants, "ground" or "", and "own" or "".
    Raises:
        UnknownNameError: there is no such function, argument or frame.
        ArgumentError: an option means nothing to the function.
        BuildError: the C compiler failed. Without one the program runs as torch operations, and a warning says so once.

    >>> import torchdq
    >>> program = torchdq.compile(torchdq.robots.load("two_link"), "mass_matrix")
    >>> program.count().multiplications
    3
    """
    if isinstance(robot, Program):
        if function or arguments is not None or options:
            raise ArgumentError(
                f"program {robot.name!r} is recorded already; leave out function, arguments and options"
            )
        return replace(_ready(robot, dtype_of("dtype", dtype)), about=robot.about)
    _require_compilable(robot)
    if isinstance(function, str) and function in LAWS:
        function, options = LAWS[function].of_arguments(options), ()
    if callable(getattr(function, "program", None)):
        _require_law(function)
        if options:
            raise ArgumentError(f"options must be empty for a control law, whose fields they are, found {options!r}")
        recorded = function.program(robot, arguments)
        ready = _ready(recorded, dtype_of("dtype", dtype))
        return replace(ready, about=recorded.about, examples=function.resolved(robot).tensors())
    known = (*RECIPES, *LAWS)
    if not isinstance(function, str) or not function:
        raise ArgumentError(f"function must be the name of one, found {function!r}; known: {', '.join(known)}")
    names_of("function", function, known, "function that is compiled")
    what = Function(constants(robot), function, options_of(robot, function, options))
    what.require_base()
    parameters = {name: getattr(robot, name) for name in tensors_of(robot)}
    present = [(field, math.prod(what.axes(field.name))) for field in RECIPES[function].present(function, arguments)]
    # numbers of objects that there are none of are no arguments
    taken = [Argument(x.name, width) for x, width in present if width or arguments is not None or not x.optional]
    taken += [Argument(name, math.prod(what.axes(name)), x.ndim == len(SHAPES[name])) for name, x in parameters.items()]
    recorded = what.program(tuple(taken))
    found = _ready(recorded, dtype_of("dtype", dtype), what.results(recorded))
    about = (*heading(function, robot.name, robot.joint_names), *_forces(robot, recorded))
    return replace(found, about=about, examples=parameters)


def _forces(robot: Robot, program: Program) -> tuple[str, ...]:
    """Lines on gravity and friction of a function of rigid bodies; none where these mean nothing to it."""
    names = {x.name for x in program.arguments} | {x.name for x in program.results}
    if names.isdisjoint(OF_FORCES) and not any(name.startswith("dtau/") for name in names):
        return ()
    weight = [] if robot.gravity is None or "gravity" in names else constants_of({"gravity": robot.gravity.tolist()})
    return (*weight, rigid(bool((robot.damping != 0).any() or (robot.friction != 0).any())))
