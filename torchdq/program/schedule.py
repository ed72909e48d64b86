"""The order in which a program is computed, whatever language it is printed in.

What is the same for all samples is computed once, before them: the prelude. The rest is computed per sample, the sine
and cosine of one angle together. A long program is cut into parts of bounded length, which pass values on in slots; a
slot is used again when its value has been read for the last time.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from torchdq.program.program import Program, outputs

TOGETHER = ("sin", "cos")  # operations on one angle that are computed by one call


class Part(NamedTuple):
    """Values that are computed one after the other."""

    values: tuple[int, ...]
    loaded: tuple[tuple[int, int], ...] = ()  # values of earlier parts that are read, with their slots
    stored: tuple[tuple[int, int], ...] = ()  # values that later parts or results read, with their slots


class Schedule(NamedTuple):
    """Where and when every value of a program is computed."""

    uniform: tuple[bool, ...]  # whether a value is the same for all samples
    prelude: tuple[int, ...]  # values computed once, constants left out
    pairs: dict[int, tuple[int, ...]]  # sine and cosine of one angle, as far as they are wanted, by either
    parts: tuple[Part, ...]  # computed per sample
    slots: int  # that parts pass values in
    results: tuple[tuple[int, int], ...]  # values that results read from slots


def schedule(program: Program, longest: int) -> Schedule:
    """Schedule of a program whose parts are at most so long."""
    uniform = _uniform(program)
    prelude = tuple(i for i, op in enumerate(program.ops) if uniform[i] and op.code != "const")
    pairs = _pairs(program)
    body = _order(uniform, pairs)
    if len(body) <= longest:
        return Schedule(uniform, prelude, pairs, (Part(tuple(body)),), 0, ())
    cut = [body[k : k + longest] for k in range(0, len(body), longest)]
    for earlier, later in pairwise(cut):
        first = later[0]
        if first in pairs and pairs[first][0] != first:  # the other of a pair, which is computed before
            earlier.append(later.pop(0))
    return Schedule(uniform, prelude, pairs, *_in_slots(program, cut))


def _uniform(program: Program) -> tuple[bool, ...]:
    known: list[bool] = []
    for op in program.ops:
        if op.code == "in":
            known.append(program.arguments[op.payload[0]].uniform)
        else:
            known.append(all(known[k] for k in op.operands))
    return tuple(known)


def _pairs(program: Program) -> dict[int, tuple[int, ...]]:
    known = {(op.code, op.operands): i for i, op in enumerate(program.ops) if op.code in TOGETHER}
    return {
        i: tuple(known[code, angle] for code in TOGETHER if (code, angle) in known) for (_, angle), i in known.items()
    }


def _order(uniform: Sequence[bool], pairs: dict[int, tuple[int, ...]]) -> list[int]:
    """Values computed per sample, in order, the sine and cosine of one angle side by side."""
    order: dict[int, None] = {}
    for i, shared in enumerate(uniform):
        if not shared:
            order.update(dict.fromkeys(pairs.get(i, (i,))))
    return list(order)


def _in_slots(
    program: Program, cut: Sequence[Sequence[int]]
) -> tuple[tuple[Part, ...], int, tuple[tuple[int, int], ...]]:
    """Parts with their loads and stores, the number of slots, and what results read from them."""
    home = {i: k for k, part in enumerate(cut) for i in part}
    last = dict.fromkeys(home, -1)  # the last part that reads a value
    for i, k in home.items():
        for operand in program.ops[i].operands:
            if operand in home:
                last[operand] = max(last[operand], k)
    results = {v[0] for r in outputs(program) for v in r.values if not isinstance(v, float) and v[0] in home}
    last.update(dict.fromkeys(results, len(cut)))
    slots: dict[int, int] = {}
    free: list[int] = []
    most = 0
    expiring: dict[int, list[int]] = {}
    parts = []
    for k, part in enumerate(cut):
        earlier = {o for i in part for o in program.ops[i].operands if o in home and home[o] < k}
        loaded = tuple((i, slots[i]) for i in sorted(earlier))
        free += expiring.pop(k, [])
        for i in part:
            if last[i] > k:
                slots[i] = free.pop() if free else most
                most = max(most, slots[i] + 1)
                # read for the last time in part `last`, before that part stores
                expiring.setdefault(last[i], []).append(slots[i])
        parts.append(Part(tuple(part), loaded, tuple((i, slots[i]) for i in part if i in slots)))
    return tuple(parts), most, tuple((i, slots[i]) for i in sorted(results))
