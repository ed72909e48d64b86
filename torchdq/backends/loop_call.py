"""Call path from tensors to a loop over a computation and back; `call` has that of a single step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.backends.backend import Backend, dense
from torchdq.backends.call import Computation, Shape, Tensors, arranged, batch_of, row_of
from torchdq.backends.choice import BackendName, choose, present
from torchdq.backends.precision import largest_growth
from torchdq.base.caches import LAYOUTS, Bounded
from torchdq.program.autograd import in_a_graph
from torchdq.program.loop import Loop
from torchdq.program.loop_autograd import differentiable


class Steps(NamedTuple):
    """Rows of a computation over a number of steps."""

    rows: dict[str, Tensor]  # [steps + 1, ...] of what is carried, with the start, or [...] at the end; of others ...
    over: Tensor | None  # [samples] rows whose errors grow too much, which are wrong; None: there are none


class LoopLayout(NamedTuple):
    """Everything about a call that follows from the shapes, dtypes and devices of its tensors."""

    loop: Loop
    backend: Backend
    arrangement: tuple[tuple[Shape | None, Shape | None], ...]  # shapes on the way to the arguments of the loop
    names: tuple[str, ...]
    shapes: tuple[Shape, ...]  # of the results
    samples: int


_layouts: Bounded[tuple, LoopLayout] = Bounded(LAYOUTS)


def repeat(
    what: Computation,
    steps: int,
    carried: Tensors,
    stepped: Tensors,
    fixed: Tensors,
    total: Sequence[str] = (),
    ends: bool = False,
    backend: BackendName | None = None,
) -> Steps:
    """Rows of a computation that is evaluated a number of times, each result of a carried name being the next argument.

    Args:
        what: the computation.
        steps: number of steps.
        carried: arguments that are results, too, by name, at the start.
        stepped: arguments of every step, [steps, ...]; one that is expanded along that axis costs as much as a fixed one.
        fixed: arguments that are the same at all steps.
        total: results of which the sum over the steps is returned.
        ends: whether only the end of what is carried is returned.
        backend: as in `torchdq.functional`; one that compiles programs.
    """
    tensors = {**carried, **stepped, **fixed}
    try:
        looks = [(x.shape, x.dtype, x.device) for x in tensors.values()]
        constant = [steps > 0 and x.stride(0) == 0 for x in stepped.values()]
        key = (what, steps, len(carried), *constant, tuple(total), ends, backend, present(), *tensors, *looks)
        layout = _layouts.get(key)
        if layout is None:
            layout = _layouts[key] = _layout(what, steps, carried, stepped, fixed, constant, total, ends, backend)
        given = [*carried.values(), *(x[0] if c else x for x, c in zip(stepped.values(), constant)), *fixed.values()]
        like = given[0]
        rows = [row_of(x, like.dtype, like.device, a) for x, a in zip(given, layout.arrangement, strict=True)]
    except (AttributeError, RuntimeError):
        _check(what, carried, stepped, fixed)  # raises, naming an argument that is not a dense tensor
        raise
    execute = layout.backend.loop
    found = differentiable(layout.backend, layout.loop, rows, layout.samples, steps)
    ...
