"""The one path from tensors to a program and back.

A caller describes what it computes by a `Computation`, a hashable value, and hands over named tensors:

    found = evaluate(what, {"q": q, "qd": None, "mass": mass}, backend="auto", double=False)

    checks     tensors of one dtype and one device, with their trailing axes; the error names the argument
    layout     batch axes broadcast; a tensor that may be shared and has none is one row for all samples
    program    `what.program`, recorded for those that are present, with their widths
    backend    the one that was named, or else the first that can run on the device
    results    tensors by name, with the batch axes of everything that went in

The layout is remembered by what is computed and by the shapes, dtypes and devices of the tensors, so a call that looks
like an earlier one goes from tensors to the program directly. All of it works under `torch.func` transforms and
forward-mode differentiation; in a graph that is traced by torch.compile or torch.export, sizes may be symbols and the
program goes by its name.

To add a computation, derive from `Computation` beside a NamedTuple of everything that the program depends on (for a
scene: blueprint, stage and task), and say the trailing axes of every input by name. `shared` names parameters: they are
converted to the dtype and the device of the inputs, and are one row for all samples unless they have batch axes.
`check` raises what only this computation asks, say that an input is missing; it is called once for each layout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.backend import Backend
from torchdq.backends.choice import BackendName, choose, present
from torchdq.backends.precision import Guarded
from torchdq.backends.run import run
from torchdq.backends.torch import EAGER
from torchdq.caches import LAYOUTS, Bounded
from torchdq.errors import ArgumentError, DtypeError
from torchdq.program.autograd import named, operator
from torchdq.program.program import Argument, Program

DTYPES = (torch.float32, torch.float64)  # inputs, parameters and programs may have

Shape = tuple[int, ...]
Tensors = Mapping[str, Tensor | None]  # by name; None: absent


class Computation:
    """Hashable description of a call: everything that its program depends on but the tensors."""

    def axes(self, name: str) -> Shape:
        """Trailing axes of a tensor; raises `ArgumentError` if there is none of that name."""
        raise NotImplementedError

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program with these arguments."""
        raise NotImplementedError

    def shared(self, name: str) -> bool:
        """Whether the tensor is a parameter, which all samples may share."""
        return False

    def results(self, program: Program) -> tuple[Shape, ...]:
        """Trailing axes of the results."""
        return tuple([(len(r.values),) for r in program.results])

    def check(self, tensors: Mapping[str, Tensor]) -> None:
        """Raise if the tensors that are present, each of them right, are not what is asked together."""

    def label(self, name: str) -> str:
        """Name of a tensor in error messages."""
        return name

    def subject(self) -> str:
        """Words after a shape in error messages, say " for the 7 joints of robot 'panda'"."""
        return ""


class Arrangement(NamedTuple):
    """Steps from a tensor to rows of a program: expanded, then reshaped to these shapes; None: it has that shape."""

    expanded: Shape | None
    flat: Shape | None


class CallLayout(NamedTuple):
    """Everything that is known of a call by the shapes, dtypes and devices of its tensors."""

    rows: tuple[Arrangement, ...]
    dtype: torch.dtype  # the program runs in
    device: torch.device
    program: Program
    backend: Backend
    results: tuple[tuple[str, Shape], ...]


_layouts: Bounded[tuple, CallLayout] = Bounded(LAYOUTS)


def evaluate(
    what: Computation, tensors: Tensors, backend: BackendName | None = None, double: bool = False
) -> dict[str, Tensor]:
    """Results of a computation by name, with the batch axes of everything that went in.

    Args:
        what: the computation.
        tensors: its arguments by name; None: absent. The first is an input.
        backend: as in `torchdq.functional`.
        double: whether float32 is computed in float64, and rounded at the end.
    """
    if torch.compiler.is_compiling():
        return _traced(what, tensors, backend, double)
    try:
        looks = [None if x is None else (x.shape, x.dtype, x.device) for x in tensors.values()]
    except AttributeError:
        batch_of(what, tensors)  # something is no tensor, and the check says what
        raise
    key = (what, backend, present(), double, *tensors, *looks)
    layout = _layouts.get(key)
    if layout is None:
        layout = _layouts[key] = _layout(what, tensors, backend, double)
    given = [x for x in tensors.values() if x is not None]
    rows = [_row(x, layout.dtype, layout.device, row) for x, row in zip(given, layout.rows, strict=True)]
    found = run(layout.program, rows, layout.backend)
    narrow = given[0].dtype
    if narrow != layout.dtype:
        found = [y.to(narrow) for y in found]
    return {
        name: y if y.shape == shape else y.view(shape) for y, (name, shape) in zip(found, layout.results, strict=True)
    }


# --- checks ----------------------------------------------------------------------------------------------------------


def batch_of(what: Computation, tensors: Tensors) -> Shape:
    """Batch axes of the arguments of a computation together.

    Raises, naming the argument, unless the inputs have their trailing axes, one dtype and one device, and the batch
    axes of all tensors broadcast.
    """
    given = {name: x for name, x in tensors.items() if x is not None}
    batches: dict[str, Shape] = {}
    first = ""
    for name, x in given.items():
        axes, label = what.axes(name), what.label(name)
        _require_tensor(label, x)
        if not what.shared(name):
            first = first or name
            _require_alike(label, x, first, given[first])
        if x.ndim < len(axes) or tuple(x.shape[x.ndim - len(axes) :]) != axes:
            raise ArgumentError(
                f"{label} must have the shape [{', '.join(['...', *map(str, axes)])}]{what.subject()}, "
                f"found {tuple(x.shape)}"
            )
        batches[label] = tuple(x.shape[: x.ndim - len(axes)])
    what.check(given)
    try:
        return tuple(torch.broadcast_shapes(*batches.values()))
    except RuntimeError as error:
        found = ", ".join(f"{label} {batch}" for label, batch in batches.items() if batch)
        raise ArgumentError(f"the batch axes of the arguments must broadcast, found {found}") from error


def _require_tensor(name: str, x: Any) -> None:
    if not isinstance(x, Tensor):
        raise ArgumentError(f"{name} must be a tensor, found {type(x).__name__}; use torch.as_tensor")


def _require_alike(name: str, x: Tensor, other: str, like: Tensor) -> None:
    """Raise unless an input has a dtype of the package, and dtype and device of another input."""
    if x.dtype not in DTYPES:
        raise DtypeError(
            f"{name} must be float32 or float64, found {x.dtype}; integers would round angles and half precision "
            f"loses centimetres over an arm, so convert it yourself"
        )
    if x.dtype != like.dtype:
        raise DtypeError(f"{name} is {x.dtype} but {other} is {like.dtype}; convert one of them")
    if x.device != like.device:
        raise ArgumentError(f"{name} is on {x.device} but {other} is on {like.device}; move one of them")


# --- layout ----------------------------------------------------------------------------------------------------------


def _layout(what: Computation, tensors: Tensors, backend: BackendName | None, double: bool) -> CallLayout:
    arguments, rows, batch = _arranged(what, tensors)
    like = next(x for x in tensors.values() if x is not None)
    program = what.program(arguments)
    shapes = zip(program.results, what.results(program), strict=True)
    return CallLayout(
        rows,
        torch.float64 if double else like.dtype,
        like.device,
        program,
        choose(backend, like.device),
        tuple((r.name, axes if r.summed else batch + axes) for r, axes in shapes),
    )


def _arranged(what: Computation, tensors: Tensors) -> tuple[tuple[Argument, ...], tuple[Arrangement, ...], Shape]:
    """Arguments of the program, how tensors become rows of them, and the batch axes."""
    batch = batch_of(what, tensors)
    samples = math.prod(batch)
    arguments, rows = [], []
    for name, x in tensors.items():
        if x is None:
            continue
        axes = what.axes(name)
        width, uniform = math.prod(axes), what.shared(name) and x.ndim == len(axes)
        arguments.append(Argument(name, width, uniform))
        expanded, flat = (axes, (width,)) if uniform else (batch + axes, (samples, width))
        rows.append(Arrangement(None if x.shape == expanded else expanded, None if expanded == flat else flat))
    return tuple(arguments), tuple(rows), batch


def _row(x: Tensor, dtype: torch.dtype, device: torch.device, row: Arrangement) -> Tensor:
    if x.dtype != dtype or x.device != device:
        x = x.to(dtype=dtype, device=device)
    if row.expanded is not None:
        x = x.expand(row.expanded)
    return x if row.flat is None else x.reshape(row.flat)


# --- traced graphs ---------------------------------------------------------------------------------------------------


def _traced(what: Computation, tensors: Tensors, backend: BackendName | None, double: bool) -> dict[str, Tensor]:
    """Results in a graph that is being traced."""
    arguments, rows, batch = _arranged(what, tensors)
    given = [x for x in tensors.values() if x is not None]
    like = given[0]
    dtype = torch.float64 if double else like.dtype
    inputs = [_row(x, dtype, like.device, row) for x, row in zip(given, rows, strict=True)]
    # one by one, so that the graph is guarded by each
    name, program, results = _known(type(what), arguments, backend, like.device, *what)  # type: ignore[misc]
    found = run(program, inputs, EAGER) if program is not None else operator(name, inputs)
    return {
        result: y.to(like.dtype).reshape(axes if summed else batch + axes)
        for y, (result, summed, axes) in zip(found, results, strict=True)
    }


@torch.compiler.assume_constant_result
def _known(
    kind: type, arguments: Sequence[tuple], backend: BackendName | None, device: torch.device, *fields: Any
) -> tuple[str, Program | None, tuple[tuple[str, bool, Shape], ...]]:
    """Name of the program in a graph, or the program if torch sees its operations, and its results.

    A tracer hands over plain tuples, not named ones.
    """
    what = kind(*fields)
    program, chosen = what.program(tuple(Argument(*a) for a in arguments)), choose(backend, device)
    shapes = zip(program.results, what.results(program), strict=True)
    results = tuple((r.name, r.summed, axes) for r, axes in shapes)
    if chosen.differentiable:
        return "", program, results
    return named(Guarded(chosen), program), None, results
