"""Call path from tensors to a loop over a computation and back; `call` has that of a single step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

from torch import Tensor

from torchdq.backends.backend import Backend
from torchdq.backends.call import Arrangement, Computation, Shape, arranged, batch_of, recorded, row_of
from torchdq.backends.choice import BackendName, choose, present
from torchdq.backends.precision import largest_growth, run, within_limit
from torchdq.backends.torch import by_steps
from torchdq.base.caches import LAYOUTS, PROGRAMS, Bounded, remembered
from torchdq.program.autograd import in_a_graph
from torchdq.program.loop import Loop
from torchdq.program.loop_autograd import differentiable
from torchdq.program.transforms import dispatching, transforming, without_values


def repeatable(like: Tensor, backend: BackendName | None) -> bool:
    """Whether a computation on such tensors can be repeated as one loop: plain ones, by a backend that compiles."""
    seen = without_values((like,)) or transforming() or dispatching()
    return not (seen or choose(backend, like.device).differentiable)


class LoopLayout(NamedTuple):
    """Everything about a call that follows from the shapes, dtypes and devices of its tensors."""

    loop: Loop
    backend: Backend
    rows: tuple[Arrangement, ...]
    names: tuple[str, ...]  # names of the results
    shapes: tuple[Shape, ...]  # shapes of the results
    samples: int


_layouts: Bounded[tuple, LoopLayout] = Bounded(LAYOUTS)
loop_of = remembered(PROGRAMS)(lambda *parts: Loop(*parts))  # one for all batches, so that it is compiled once


def repeat(
    what: Computation,
    steps: int,
    carried: Mapping[str, Tensor],
    stepped: Mapping[str, Tensor],
    fixed: Mapping[str, Tensor],
    total: Sequence[str] = (),
    ends: bool = False,
    backend: BackendName | None = None,
) -> dict[str, Tensor]:
    """Results of a computation that is evaluated a number of times, with what is carried from one to the next, by name.

    Of what is carried there are steps + 1, with the start; of other results one for every step, or their total.

    Args:
        what: the computation.
        steps: number of steps.
        carried: arguments that are results, too, by name, at the start.
        stepped: arguments of every step, [steps, ...]; one expanded along that axis costs as much as a fixed one.
        fixed: arguments that are the same at all steps.
        total: results of which the sum over the steps is returned; of what is carried the last.
        ends: whether only the last of what is carried is returned.
        backend: as in `torchdq.functional`; one that compiles programs.
    """
    tensors = {**carried, **stepped, **fixed}
    try:
        looks = [(x.shape, x.dtype, x.device) for x in tensors.values()]
        constant = tuple([steps > 0 and x.stride(0) == 0 for x in stepped.values()])
        key = (what, steps, len(carried), constant, tuple(total), ends, backend, present(), *tensors, *looks)
        layout = _layouts.get(key)
        if layout is None:
            names = tuple(name for name, same in zip(stepped, constant, strict=True) if not same)
            layout = _layouts[key] = _layout(
                what, steps, once(steps, tensors, stepped), carried, names, total, ends, backend
            )
        series = [x[0] if same else x for x, same in zip(stepped.values(), constant, strict=True)]
        given = [*carried.values(), *series, *fixed.values()]
        like = given[0]
        rows = [row_of(x, like.dtype, like.device, a) for x, a in zip(given, layout.rows, strict=True)]
    except (AttributeError, RuntimeError):
        batch_of(what, once(steps, tensors, stepped))  # raises, naming an argument that is not a dense tensor
        raise
    found = _guarded(layout, rows, steps)
    shaped = [y if y.shape == shape else y.view(shape) for y, shape in zip(found, layout.shapes, strict=True)]
    return dict(zip(layout.names, shaped, strict=True))


def _guarded(layout: LoopLayout, rows: Sequence[Tensor], steps: int) -> Sequence[Tensor]:
    """Results of a loop; samples whose errors grow too much at one of the steps take all of them one by one."""
    loop, backend, samples, count = layout.loop, layout.backend, layout.samples, len(layout.names)
    execute = partial(_executed, backend)
    found = differentiable(execute, loop, rows, samples, steps)
    growth = found[count].detach() if len(found) > count and samples else None
    if growth is None or within_limit(growth, samples):
        return found[:count]
    over = ~(growth[:, 0] <= largest_growth(growth.dtype))
    at, others = over.nonzero()[:, 0], (~over).nonzero()[:, 0]

    def among(indices: Tensor) -> list[Tensor]:
        given = enumerate(zip(rows, loop.arguments, strict=True))
        return [x if a.uniform else x.index_select(int(k in loop.given), indices) for k, (x, a) in given]

    axes = [int(r in loop.kept) for r in range(count)]
    few = by_steps(loop, among(at), len(at), steps, lambda program, x, _: run(program, x, backend))
    if in_a_graph(rows):  # gradients of the rows over the limit may be 0 * inf
        rest = differentiable(execute, loop, among(others), len(others), steps)
    else:
        rest = [y.index_select(axis, others) for y, axis in zip(found, axes, strict=False)]
    wholes = [y.new_empty(y.shape) for y in found[:count]]
    return [
        y.index_copy(axis, at, a).index_copy(axis, others, b)
        for y, axis, a, b in zip(wholes, axes, few, rest, strict=False)
    ]


def _executed(backend: Backend, loop: Loop, inputs: Sequence[Tensor], samples: int, steps: int) -> list[Tensor]:
    """Outputs of a loop, by a backend."""
    return backend.loop(loop, inputs[0].dtype, inputs[0].device, samples)(inputs, samples, steps)


def once(steps: int, tensors: Mapping[str, Tensor], stepped: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Arguments of one step."""
    return {
        name: (x[0] if steps else x.new_empty(x.shape[1:])) if name in stepped else x for name, x in tensors.items()
    }


def _layout(
    what: Computation,
    steps: int,
    once: Mapping[str, Tensor],
    carried: Mapping[str, Tensor],
    stepped: Sequence[str],
    total: Sequence[str],
    ends: bool,
    backend: BackendName | None,
) -> LoopLayout:
    arguments, rows, batch = arranged(what, once)
    program, like, names = recorded(what, arguments), next(iter(once.values())), [a.name for a in arguments]
    results = [r.name for r in program.results]
    states = tuple([(names.index(name), results.index(name)) for name in carried])
    kept = [r for r, name in enumerate(results) if not (name in total or (ends and name in carried))]
    loop = loop_of(program, states, tuple(map(names.index, stepped)), tuple(kept))
    arrangement = []
    for name, row, a in zip(names, rows, arguments, strict=True):
        if name in stepped:
            shape, flat = (steps, *batch, *what.axes(name)), (steps, math.prod(batch), a.width)
            lacking = len(shape) - 1 - once[name].ndim
            whole = (steps, *(1,) * lacking, *once[name].shape) if lacking else None
            row = Arrangement(None if row.expanded is None else shape, None if shape == flat else flat, whole)
        arrangement.append(row)
    shapes = []
    for r, axes in enumerate(what.results(program)):
        lead = (steps + (results[r] in carried),) if r in kept else ()
        shapes.append((*lead, *batch, *axes))
    return LoopLayout(
        loop,
        choose(backend, like.device),
        tuple(arrangement),
        tuple(results),
        tuple(shapes),
        math.prod(batch),
    )
