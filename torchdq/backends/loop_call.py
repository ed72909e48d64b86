"""Computations that are evaluated step after step, as one loop: so many times, or as long as rows go on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from torchdq.backends.call import Computation, Repeated, batch_of, evaluate
from torchdq.backends.choice import BackendName, choose
from torchdq.base.checks import is_dense
from torchdq.program.transforms import dispatching, transforming, without_values

TOGETHER = 2048  # rows of a processor's core that take some steps together, before others take their places


def repeatable(like: Tensor, backend: BackendName | None) -> bool:
    """Whether a computation on such tensors can be repeated as one loop: plain ones, by a backend that compiles."""
    traced = without_values((like,)) or transforming() or dispatching()
    return not (traced or choose(backend, like.device).differentiable)


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
        backend: as in `torchdq.backend`.
    """
    same = {name: x[0] for name, x in stepped.items() if steps and is_dense(x) and x.stride(0) == 0}
    series = tuple([name for name in stepped if name not in same])
    repeated = Repeated(steps, tuple(carried), series, tuple(total), ends)
    return evaluate(what, {**carried, **stepped, **same, **fixed}, backend, repeated=repeated)


def repeat_while(
    goes_on: Callable[[Mapping[str, Tensor]], Tensor],
    what: Computation,
    steps: Callable[[int], int],
    carried: Mapping[str, Tensor],
    fixed: Mapping[str, Tensor],
    backend: BackendName | None = None,
) -> dict[str, Tensor]:
    """Carried rows, by name, after as many steps as each row needs.

    Rows take some steps together; those that are done make room for others. A step must leave them as they are.

    Args:
        goes_on: function of carried rows [rows, ...] that is True [rows] where they are not done.
        what: the computation.
        steps: number of steps of so many rows before `goes_on` is asked.
        carried, fixed, backend: as in `repeat`.
    """
    given = {**carried, **fixed}
    batch, axes = batch_of(what, given), {name: what.axes(name) for name in given}
    count, like = math.prod(batch), next(iter(carried.values()))
    same = {name: x for name, x in fixed.items() if x.ndim == len(axes[name]) and what.shared(name)}
    rows = {
        name: x.expand(batch + axes[name]).reshape(count, *axes[name]) for name, x in given.items() if name not in same
    }
    lanes = TOGETHER * torch.get_num_threads() if like.device.type == "cpu" else count
    following, found = min(count, lanes), list[dict[str, Tensor]]()
    at = torch.arange(following, device=like.device)
    now = {name: rows[name][:following] for name in carried}
    while True:
        among = {name: rows[name].index_select(0, at) for name in rows if name not in carried}
        now = repeat(what, steps(len(at)), now, {}, {**among, **same}, ends=True, backend=backend)
        goes = goes_on(now)
        on, off = (x.nonzero()[:, 0] for x in (goes, ~goes))
        found.append({name: x.index_select(0, off) for name, x in {"": at, **now}.items()})
        more = torch.arange(following, min(following + len(off), count), device=like.device)
        if not len(on) + len(more):
            break
        following += len(more)
        at = torch.cat([at.index_select(0, on), more])
        now = {name: torch.cat([x.index_select(0, on), rows[name].index_select(0, more)]) for name, x in now.items()}
    if len(found) == 1:
        ordered = found[0]
    else:
        whole = {name: torch.cat([part[name] for part in found]) for name in found[0]}
        back = whole[""].argsort()
        ordered = {name: x.index_select(0, back) for name, x in whole.items()}
    return {name: ordered[name].reshape(batch + axes[name]) for name in carried}
