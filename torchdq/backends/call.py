"""Call path from tensors to a program and back, for functions, modules, scenes and resets alike.

    results = evaluate(computation, {"q": q, "qd": None, "mass": mass}, backend="auto", double=False)

The first call checks the tensors, broadcasts their batch axes, records the program for those that are present, and
chooses a backend. All of this is the layout, cached by computation and by shapes, dtypes and devices, so that a later
call of the same form goes from tensors to the program directly. With `Repeated` steps the same holds of a loop over the
program. In a graph traced by torch.compile or torch.export, sizes may be symbols, and the graph calls the program by
its name.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from operator import is_
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.compiler import is_compiling

from torchdq.backends.backend import Backend, Form, contiguous, dense, share_memory
from torchdq.backends.choice import BackendName, choose, choose_for_graph, present
from torchdq.backends.fast_call import Forms, learn, quick
from torchdq.backends.precision import Guarded, learn_graph, run, run_loop, unguarded
from torchdq.backends.torch import EAGER
from torchdq.base.caches import LAYOUTS, PROGRAMS, Bounded, remembered
from torchdq.base.checks import DTYPES, TensorValue, is_dense, require_tensor, tensor_in
from torchdq.errors import ArgumentError, DtypeError, TorchdqError
from torchdq.program.autograd import in_a_graph, named, operator
from torchdq.program.loop import Chain, Loop
from torchdq.program.program import Argument, Program
from torchdq.program.transforms import constant_in_graphs, dispatching, transforming, with_values

Shape = tuple[int, ...]
Tensors = Mapping[str, Tensor | None]  # by name; None: absent


class Computation:
    """Interface of a computation: a hashable description of everything that its program depends on.

    A new one derives from this class and from a NamedTuple of that, for a scene its specification, stage and task.
    """

    def axes(self, name: str) -> Shape:
        """Trailing axes of a tensor; raises `ArgumentError` if there is none of that name."""
        raise NotImplementedError

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program with these arguments."""
        raise NotImplementedError

    def shared(self, name: str) -> bool:
        """Whether the tensor is a parameter: cast like the inputs, one row for all samples unless it has batch axes."""
        return False

    def results(self, program: Program) -> tuple[Shape, ...]:
        """Trailing axes of the results."""
        return tuple([(len(r.values),) for r in program.results])

    def check(self, tensors: Mapping[str, Tensor]) -> None:
        """Raise unless the present tensors, each valid by itself, are valid together; once per layout."""

    def label(self, name: str) -> str:
        """Name of a tensor in error messages."""
        return name

    def subject(self) -> str:
        """Text after a shape in error messages, such as " for the 7 joints of robot 'panda'"."""
        return ""


class Repeated(NamedTuple):
    """Steps of a computation that are evaluated as one loop."""

    steps: int
    carried: tuple[str, ...]  # arguments that are results, too: those of a step are arguments of the next
    stepped: tuple[str, ...] = ()  # arguments of every step, [steps, ...]
    total: tuple[str, ...] = ()  # results of which the sum over the steps is returned; of what is carried the last
    ends: bool = False  # whether only the last of what is carried is returned
    backwards: bool = False  # whether the last step comes first


class Arrangement(NamedTuple):
    """Shapes on the way from a tensor to rows of a program; None: the tensor has this shape already."""

    whole: Shape | None  # of a tensor of every step: with the batch axes that it lacks
    expanded: Shape | None  # with all batch axes
    flat: Shape | None  # [samples, width], of every step [steps, samples, width], or [width] for a uniform argument


class CallLayout(NamedTuple):
    """Everything about a call that follows from the shapes, dtypes and devices of its tensors."""

    rows: tuple[Arrangement, ...]
    dtype: torch.dtype  # dtype of the program
    device: torch.device
    program: Program  # that of a step
    loop: Loop | None  # over the program
    backend: Backend
    names: tuple[str, ...]  # names of the results
    shapes: tuple[Shape, ...]  # shapes of the results
    samples: int
    direct: tuple[Form, ...] | None  # forms of all outputs if the tensors can be taken as they are; None: they cannot


_layouts: Bounded[tuple, CallLayout] = Bounded(LAYOUTS)
_loop_of = remembered(PROGRAMS)(lambda *parts: Loop(*parts))  # one for all batches, so that it is compiled once


def evaluate(
    what: Computation,
    tensors: Tensors,
    backend: BackendName | None = None,
    double: bool = False,
    out: Sequence[Tensor] = (),
    repeated: Repeated | None = None,
) -> dict[str, Tensor]:
    """Results of a computation by name, with the broadcast batch axes of all tensors.

    Of repeated steps, those of every step or their total; of what is carried steps + 1, with the start, or the last.

    Args:
        what: the computation.
        tensors: its arguments by name; None: absent. The first is an input.
        backend: as in `torchdq.backend`.
        double: whether float32 inputs are computed in float64, and the results rounded.
        out: tensors that the results are written to, one for each; (): new ones.
        repeated: steps, outside of traced graphs; None: one.
    """
    names, found = results_of(what, tensors, backend, double, out, repeated)
    return dict(zip(names, found, strict=True))


def results_of(
    what: Computation,
    tensors: Tensors,
    backend: BackendName | None = None,
    double: bool = False,
    out: Sequence[Tensor] = (),
    repeated: Repeated | None = None,
    key: Hashable = None,
) -> tuple[Sequence[str], Sequence[Tensor]]:
    """Names of the results of `evaluate`, and the results; `key` is that of a fast call that a caller has tried."""
    if key is None and backend is None and not double:
        key, names, quickly = quick((what, len(out), repeated, *tensors), tensors.values(), out)
        if quickly is not None:
            return names, quickly
    if repeated is None and (is_compiling() or dispatching()):
        if out:
            raise ArgumentError("out cannot be given in a traced graph; leave it out, and torch reuses memory itself")
        traced = _traced(what, tensors, backend, double)
        return [*traced], [*traced.values()]
    try:
        layout = layout_of(what, tensors, backend, double, repeated)
        given = [x for x in tensors.values() if x is not None]
        if out:
            _require_room(layout, given, out)
        forms = None if in_a_graph(given) else layout.direct
        if forms is not None and layout.loop is None:
            # without views of the tensors: one takes a microsecond, which counts where a call has one sample
            direct = unguarded(layout.backend, layout.program, dense(given), forms, layout.samples, out)
            form = partial(_forms, layout, tensors, out=bool(out))
            learn(key, layout.backend, layout.program, layout.samples, 1, form)
            return layout.names, direct
        if not all(map(is_dense, given)):  # torch multiplies some of them in silence
            batch_of(what, _of_one_step(tensors, repeated))  # raises
        rows = rows_of(layout, given)
        if layout.loop is None:
            found = run(layout.program, rows, layout.backend)
            as_given = all(map(is_, rows, given)) and [y.shape for y in found] == [*layout.shapes]
            if key is not None and layout.direct is not None and as_given and not transforming():
                learn_graph(key, layout.backend, layout.program, tensors.values(), layout.names)
        else:
            steps = 1 if repeated is None else repeated.steps
            found = run_loop(layout.loop, rows, layout.backend, layout.samples, steps)
            if forms is not None and steps:
                learn(key, layout.backend, layout.loop, layout.samples, steps, partial(_forms, layout, tensors, steps))
    except (AttributeError, RuntimeError):  # no check before, which would cost every call
        if any([isinstance(x, TensorValue) for x in tensors.values()]):
            plain = {name: tensor_in(x) for name, x in tensors.items()}
            return results_of(what, plain, backend, double, out, repeated)
        batch_of(what, _of_one_step(tensors, repeated))  # raises, naming an argument that is not a dense tensor
        raise
    narrow = given[0].dtype
    if narrow != layout.dtype:
        found = [y.to(narrow) for y in found]
    shaped = [y if y.shape == shape else y.view(shape) for y, shape in zip(found, layout.shapes, strict=True)]
    for room, y in zip(out, shaped, strict=False):
        room.copy_(y)
    return layout.names, out or shaped


# --- checks ----------------------------------------------------------------------------------------------------------


def batch_of(what: Computation, tensors: Tensors) -> Shape:
    """Broadcast batch axes of the arguments of a computation.

    Raises, naming the argument, unless the tensors fit the computation and each other.
    """
    given = {name: x for name, x in tensors.items() if x is not None}
    batch = common_batch(
        [(what.label(name), x, what.axes(name), what.shared(name)) for name, x in given.items()], what.subject()
    )
    what.check(given)
    return batch


def common_batch(given: Sequence[tuple[str, Tensor, Shape, bool]], subject: str) -> Shape:
    """Broadcast batch axes of tensors, each with its name, its trailing axes, and whether it is a parameter.

    Raises, naming the argument, unless the inputs, all that are not parameters, have their trailing axes, one dtype and
    one device, and the batch axes of all tensors broadcast. `subject` stands after a shape in error messages.
    """
    batches: dict[str, Shape] = {}
    if not given:
        return ()
    first, like = next(((label, x) for label, x, _, shared in given if not shared), given[0][:2])
    for label, x, axes, shared in given:
        require_tensor(label, x)
        if not shared:
            _require_alike(label, x, first, like)
        elif x.is_meta and not like.is_meta:
            raise ArgumentError(
                f"{label} is on the device 'meta', where tensors have no values, but {first} is on "
                f"{like.device}; give it with values"
            )
        if x.ndim < len(axes) or tuple(x.shape[x.ndim - len(axes) :]) != axes:
            raise ArgumentError(
                f"{label} must have the shape [{', '.join(['...', *map(str, axes)])}]{subject}, found {tuple(x.shape)}"
            )
        batches[label] = tuple(x.shape[: x.ndim - len(axes)])
    found_axes = [batch for batch in batches.values() if batch]
    if all(_same(batch, found_axes[0]) for batch in found_axes):
        return found_axes[0] if found_axes else ()
    try:
        return tuple(torch.broadcast_shapes(*batches.values()))  # whose first call takes a second: it imports sympy
    except RuntimeError as error:
        found = ", ".join(f"{label} {batch}" for label, batch in batches.items() if batch)
        raise ArgumentError(f"the batch axes of the arguments must broadcast, found {found}") from error


def _require_alike(name: str, x: Tensor, other: str, like: Tensor) -> None:
    """Raise unless an input has a dtype of the package, and dtype and device of another input."""
    if x.dtype not in DTYPES:
        raise DtypeError(
            f"{name} must be float32 or float64, found {x.dtype}; integers would round angles and half precision "
            f"loses centimetres over an arm, so convert it explicitly"
        )
    if x.dtype != like.dtype:
        raise DtypeError(f"{name} is {x.dtype} but {other} is {like.dtype}; convert one of them")
    if x.device != like.device:
        raise ArgumentError(f"{name} is on {x.device} but {other} is on {like.device}; move one of them")


def _require_room(layout: CallLayout, given: Sequence[Tensor], out: Sequence[Tensor]) -> None:
    """Raise unless the results can be written to these tensors, and nothing else is changed by it."""
    if len(out) != len(layout.names):
        raise ArgumentError(f"out must have a tensor for each of {', '.join(layout.names)}, found {len(out)}")
    for k, (name, shape, room) in enumerate(zip(layout.names, layout.shapes, out, strict=True)):
        label = f"out for {name}"
        require_tensor(label, room)
        _require_alike(label, room, "the first argument", given[0])
        written = dense([room])[0] is room  # what is written to its memory are its numbers
        if room.shape != shape or not written:
            expected, held = ", ".join(map(str, shape)), ""
            if not written:
                held = " that is not contiguous" if not room.is_contiguous() else " that is a view of other numbers"
                held += "; give out.resolve_neg()" if room.is_neg() else ""
            if room.ndim > len(shape) and room.numel() == math.prod(shape):
                held += "; it is flat, row by row"
            raise ArgumentError(f"{label} must be contiguous [{expected}], found {tuple(room.shape)}{held}")
        if any([share_memory(room, x) for x in (*given, *out[:k])]):
            raise ArgumentError(f"{label} must have memory of its own, found that of an argument or of another result")
    if in_a_graph([*given, *out]):
        raise ArgumentError(
            "out cannot be given where torch records gradients or transforms, found an argument or an out that "
            "requires grad, or a transform; leave it out, or call under torch.no_grad()"
        )


# --- layout ----------------------------------------------------------------------------------------------------------


def layout_of(
    what: Computation,
    tensors: Tensors,
    backend: BackendName | None,
    double: bool = False,
    repeated: Repeated | None = None,
) -> CallLayout:
    """Layout of a call of `evaluate`."""
    looks = [None if x is None else (x.shape, x.dtype, x.device) for x in tensors.values()]
    key = (what, backend, present(), double, repeated, *tensors, *looks)
    layout = _layouts.get(key)
    if layout is None:
        layout = _layouts[key] = _layout(what, tensors, backend, double, repeated)
    return layout


def _forms(layout: CallLayout, tensors: Tensors, steps: int = 1, out: bool = False) -> Forms:
    """Forms of the tensors of a call."""
    return Forms.of(tensors.values(), layout.shapes, layout.dtype, layout.names, layout.samples, steps, out)


def rows_of(layout: CallLayout, given: Sequence[Tensor]) -> list[Tensor]:
    """Tensors as rows of the program."""
    return [_row_of(x, layout.dtype, layout.device, row) for x, row in zip(given, layout.rows, strict=True)]


def _layout(
    what: Computation, tensors: Tensors, backend: BackendName | None, double: bool, repeated: Repeated | None
) -> CallLayout:
    arguments, rows, batch, common = _arranged(what, tensors, repeated)
    like = next(x for x in tensors.values() if x is not None)
    dtype, device = torch.float64 if double else like.dtype, like.device
    program, chosen = _recorded(what, arguments), choose(backend, device)
    if isinstance(program, Chain):
        repeated = repeated or Repeated(1, (), total=tuple([r.name for r in program.results]))
    results, loop = _shapes(what, program), None
    lead: list[Shape] = [()] * len(program.results)
    if repeated is not None:
        loop = _loop(program, repeated, common)
        of_all = (repeated.steps, repeated.steps + 1)
        lead = [(of_all[r.name in repeated.carried],) * (k in loop.kept) for k, r in enumerate(program.results)]
    shapes = [(*n, *(axes if summed else batch + axes)) for n, (_, summed, axes) in zip(lead, results, strict=True)]
    alike = all(x is None or (x.dtype == dtype and x.device == device) for x in tensors.values())
    direct = None
    if alike and not (
        chosen.differentiable
        or device.type != "cpu"
        or 0 in batch
        or any(row.whole is not None or row.expanded is not None for row in rows)
        or any(summed for _, summed, _ in results)
    ):
        growth = () if program.growth is None or chosen.guards else (batch,)
        direct = tuple(contiguous(shape, dtype) for shape in (*shapes, *growth))
    names = tuple([name for name, _, _ in results])
    return CallLayout(rows, dtype, device, program, loop, chosen, names, tuple(shapes), math.prod(batch), direct)


def _loop(program: Program, repeated: Repeated, common: tuple[int, ...]) -> Loop:
    """Loop over a program."""
    arguments, results = ([x.name for x in part] for part in (program.arguments, program.results))
    carried = tuple([(arguments.index(name), results.index(name)) for name in repeated.carried])
    left_out = {*repeated.total, *(repeated.carried if repeated.ends else ())}
    kept = tuple([k for k, name in enumerate(results) if name not in left_out])
    stepped = tuple([arguments.index(name) for name in repeated.stepped])
    return _loop_of(program, carried, stepped, kept, repeated.backwards, (), common)


def _recorded(what: Computation, arguments: tuple[Argument, ...]) -> Program:
    """Program of a computation; within transforms of torch its constants have values, too."""
    with with_values():
        return what.program(arguments)


def _shapes(what: Computation, program: Program) -> tuple[tuple[str, bool, Shape], ...]:
    """Name of every result, whether it is summed over the samples, and its trailing axes."""
    axes = what.results(program)
    return tuple([(r.name, r.summed, shape) for r, shape in zip(program.results, axes, strict=True)])


def _of_one_step(tensors: Tensors, repeated: Repeated | None) -> Tensors:
    """Arguments of one step."""
    if repeated is None:
        return tensors
    first = {name: x for name, x in tensors.items() if x is not None and name in repeated.stepped}
    return {**tensors, **{k: x[0] if repeated.steps else x.new_empty(x.shape[1:]) for k, x in first.items()}}


def _arranged(
    what: Computation, tensors: Tensors, repeated: Repeated | None = None
) -> tuple[tuple[Argument, ...], tuple[Arrangement, ...], Shape, tuple[int, ...]]:
    """Arguments of the program, arrangement of the tensors in rows, batch axes, and arguments common to all samples."""
    tensors = _of_one_step(tensors, repeated)
    batch = batch_of(what, tensors)
    samples = math.prod(batch)
    arguments, rows, common = list[Argument](), list[Arrangement](), list[int]()
    for name, x in tensors.items():
        if x is None:
            continue
        lead = (repeated.steps,) if repeated is not None and name in repeated.stepped else ()
        axes = what.axes(name)
        width, uniform = math.prod(axes), what.shared(name) and x.ndim == len(axes) and not lead
        if lead and samples > 1 and x.numel() == width:  # [steps, 1, width] of all samples
            common.append(len(arguments))
            arguments.append(Argument(name, width, False))
            rows.append(Arrangement(None, None, (*lead, 1, width)))
            continue
        arguments.append(Argument(name, width, uniform))
        expanded, flat = (axes, (width,)) if uniform else (lead + batch + axes, (*lead, samples, width))
        whole = (1,) * (len(expanded) - len(lead) - x.ndim)
        rows.append(
            Arrangement(
                (*lead, *whole, *x.shape) if lead and whole else None,
                None if (*lead, *x.shape) == expanded else expanded,
                None if expanded == flat else flat,
            )
        )
    return tuple(arguments), tuple(rows), batch, tuple(common)


def _row_of(x: Tensor, dtype: torch.dtype, device: torch.device, row: Arrangement) -> Tensor:
    """Tensor as rows of a program."""
    if x.dtype != dtype or x.device != device:
        x = x.to(dtype=dtype, device=device)
    if row.whole is not None:
        x = x.reshape(row.whole)
    if row.expanded is not None:
        x = x.expand(row.expanded)
    return x if row.flat is None else x.reshape(row.flat)


# --- traced graphs ---------------------------------------------------------------------------------------------------


def _traced(what: Computation, tensors: Tensors, backend: BackendName | None, double: bool) -> dict[str, Tensor]:
    """Results in a graph that is being traced.

    At every call of its graph, torch.compile checks all objects that were read while it was traced, so all parts
    that do not depend on sizes are read in `_known`.
    """
    tensors = {name: tensor_in(x) for name, x in tensors.items()}
    given = [x for x in tensors.values() if x is not None]
    if not all([isinstance(x, Tensor) for x in given]):
        batch_of(what, tensors)  # raises
    looks = tuple([(name, x.ndim, x.dtype, x.device) for name, x in tensors.items() if x is not None])
    # the fields one by one, so that torch.compile guards the graph by each of them
    known = _known(type(what), looks, backend, double, *what)  # type: ignore[misc]
    batch = None if known is None else _common_batch(given, known[0])
    if batch is None:
        batch = batch_of(what, tensors)  # broadcast, or raises
    forms, dtype, name, program, results = known  # type: ignore[misc]  # where it is None, `batch_of` has raised
    samples = math.prod(batch)
    inputs = []
    for x, (axes, width, uniform) in zip(given, forms, strict=True):
        shape, flat = (axes, (width,)) if uniform else (batch + axes, (samples, width))
        x = x if x.dtype == dtype and x.device == given[0].device else x.to(dtype=dtype, device=given[0].device)
        x = x if _same(x.shape, shape) else x.expand(shape)
        inputs.append(x if _same(shape, flat) else x.reshape(flat))
    found = run(program, inputs, EAGER) if program is not None else operator(name, inputs)
    shapes = [axes if summed else batch + axes for _, summed, axes in results]
    narrow = [y if dtype == given[0].dtype else y.to(given[0].dtype) for y in found]
    shaped = [y if _same(y.shape, shape) else y.reshape(shape) for y, shape in zip(narrow, shapes, strict=True)]
    return {result: y for (result, _, _), y in zip(results, shaped, strict=True)}


def _common_batch(given: Sequence[Tensor], forms: Sequence[tuple[Shape, int, bool]]) -> Shape | None:
    """Batch axes of tensors that all have them, without broadcasting; None: they differ, or other axes do not fit."""
    batch: Shape | None = None
    for x, (axes, _, uniform) in zip(given, forms, strict=True):
        own, last = x.shape[: x.ndim - len(axes)], x.shape[x.ndim - len(axes) :]
        batch = own if batch is None and not uniform else batch
        if last != axes or not (uniform or (batch is not None and _same(own, batch))):
            return None
    return None if batch is None else tuple(batch)


def _same(a: Shape, b: Shape) -> bool:
    """Whether shapes are equal, without a comparison of sizes, which an exported graph keeps, where ranks differ."""
    return len(a) == len(b) and a == b


@constant_in_graphs
def _known(
    kind: type,
    looks: Sequence[tuple[str, int, torch.dtype, torch.device]],
    backend: BackendName | None,
    double: bool,
    *fields: Any,
) -> tuple | None:
    """Parts of a call in a graph that do not depend on the sizes of its tensors; None: the tensors do not fit.

    Args:
        kind, fields: type and fields of the computation.
        looks: name, number of axes, dtype and device of every tensor.
        backend, double: as in `evaluate`.
    Returns:
        forms: trailing axes and their size, and whether it is one row for all samples, of every tensor.
        dtype: that of the program.
        name: name of the program in a graph, or "" if it runs as torch operations.
        program: program that runs as torch operations, or None.
        results: name, whether it is summed over the samples, and trailing axes of every result.
    """
    what = kind(*fields)
    try:
        with with_values():
            one = {
                name: torch.empty(((1,) * ndim + what.axes(name))[len(what.axes(name)) :], dtype=dtype, device=device)
                for name, ndim, dtype, device in looks
            }
            arguments, *_ = _arranged(what, one)
    except TorchdqError:
        return None
    _, _, dtype, device = looks[0]
    forms = tuple([(what.axes(a.name), a.width, a.uniform) for a in arguments])
    program, chosen = _recorded(what, arguments), choose_for_graph(backend, device)
    results, dtype = _shapes(what, program), torch.float64 if double else dtype
    if chosen.differentiable:
        return forms, dtype, "", program, results
    return forms, dtype, named(Guarded(chosen), program), None, results
