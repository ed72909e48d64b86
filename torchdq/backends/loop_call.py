"""Computations that are evaluated step after step, as one loop: so many times, or as long as rows go on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from torchdq.backends.call import Computation, Repeated, batch_of, evaluate, layout_of, rows_of
from torchdq.backends.choice import BackendName, choose
from torchdq.backends.precision import run_loop
from torchdq.base.checks import is_dense
from torchdq.program.loop import Loop, by_steps
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

    Of what is carried there are steps + 1, with the start; of other results one for every step, or their total. Steps
    that are not `repeatable` are so many calls.

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
    if not repeatable(next(iter(carried.values())), backend):

        def step(k: int, before: Mapping[str, Tensor]) -> dict[str, Tensor]:
            now = {name: x[k] for name, x in stepped.items()}
            return evaluate(what, {**{name: before[name] for name in carried}, **now, **fixed}, backend)

        last = carried if ends else carried.keys() & {*total}
        return by_steps(step, carried, range(steps), torch.stack, total, last)
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
        goes_on: function of carried rows [rows, width] that is True [rows] where they are not done.
        what: the computation.
        steps: number of steps of so many rows before `goes_on` is asked.
        carried, fixed, backend: as in `repeat`.
    """
    given = {**carried, **fixed}
    if not all(map(is_dense, given.values())):
        batch_of(what, given)  # raises
    # one layout for all steps, since those of ever new numbers of rows would take as long as the steps
    layout = layout_of(what, given, backend, repeated=Repeated(1, tuple(carried), ends=True))
    count, rows = layout.samples, rows_of(layout, list(given.values()))
    loop: Loop = layout.loop  # type: ignore[assignment]  # steps are repeated
    device, states = rows[0].device, len(carried)
    following = min(count, TOGETHER * torch.get_num_threads() if device.type == "cpu" else count)
    several = [not a.uniform for a in loop.arguments]
    first = [x[:following] if each and following < count else x for x, each in zip(rows, several, strict=True)]
    now, same, at = first[:states], first[states:], torch.arange(following, device=device)
    found = list[list[Tensor]]()
    while True:
        made = run_loop(loop, [*now, *same], layout.backend, len(at), steps(len(at)), among=count)
        now = [made[r] for _, r in loop.carried]
        goes = goes_on(dict(zip(carried, now, strict=True)))
        if len(at) == count and not goes.any():  # all in one: without the operations that sort rows
            found = [[at, *now]]
            break
        on, off = (x.nonzero()[:, 0] for x in (goes, ~goes))
        found.append([x.index_select(0, off) for x in (at, *now)])
        more = torch.arange(following, min(following + len(off), count), device=device)
        if not len(on) + len(more):
            break
        following += len(more)
        at, *now = [x.index_select(0, on) for x in (at, *now)]
        if len(more):
            new = (more, *[x.index_select(0, more) for x in rows[:states]])
            at, *now = [torch.cat(pair) for pair in zip((at, *now), new, strict=True)]
        same = [x.index_select(0, at) if each else x for x, each in zip(rows[states:], several[states:], strict=True)]
    order, *whole = found[0] if len(found) == 1 else map(torch.cat, zip(*found, strict=True))
    if len(found) > 1:
        back = order.argsort()
        whole = [x.index_select(0, back) for x in whole]
    return {name: x.view(layout.shapes[r]) for name, x, (_, r) in zip(carried, whole, loop.carried, strict=True)}
