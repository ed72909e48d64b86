"""Order of evaluation of a program, for code in any language.

Values that are the same for all samples are computed once, in a prelude. The others are computed per sample, sine and
cosine of one angle together. A long program is cut into parts of bounded length, which pass values on in slots; a slot
is used again after the last read of its value.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from torchdq.program.order import pairs, recorded
from torchdq.program.program import Program
from torchdq.program.uniform import shared


class Part(NamedTuple):
    """Section of a program, printed as one function."""

    values: tuple[int, ...]  # in order of evaluation
    loaded: tuple[tuple[int, int], ...] = ()  # values read from earlier parts, with their slots
    stored: tuple[tuple[int, int], ...] = ()  # values read by later parts, with their slots


class Schedule(NamedTuple):
    """Place and order of evaluation of every value of a program."""

    uniform: tuple[bool, ...]  # whether a value is the same for all samples
    prelude: tuple[int, ...]  # values computed once, constants left out
    parts: tuple[Part, ...]  # computed per sample
    slots: int  # number of slots that parts pass values in


def schedule(program: Program, longest: int) -> Schedule:
    """Schedule of a program, in parts of at most `longest` values."""
    uniform = shared(program)
    prelude = tuple(i for i, op in enumerate(program.ops) if uniform[i] and op.code != "const")
    body = recorded(program, {i for i, known in enumerate(uniform) if known})
    if len(body) <= longest:
        return Schedule(uniform, prelude, (Part(tuple(body)),), 0)
    together = pairs(program)
    cut = [body[k : k + longest] for k in range(0, len(body), longest)]
    for earlier, later in pairwise(cut):
        first = later[0]
        if first in together and together[first][0] != first:  # second of a pair; it stays in the part of the first
            earlier.append(later.pop(0))
    return Schedule(uniform, prelude, *_in_slots(program, cut))


def _in_slots(program: Program, cut: Sequence[Sequence[int]]) -> tuple[tuple[Part, ...], int]:
    """Parts with their loads and stores, and the number of slots."""
    home = {i: k for k, part in enumerate(cut) for i in part}
    last = dict.fromkeys(home, -1)  # last part that reads a value
    for i, k in home.items():
        for operand in program.ops[i].operands:
            if operand in home:
                last[operand] = max(last[operand], k)
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
                # free again in part `last`, which loads before it stores
                expiring.setdefault(last[i], []).append(slots[i])
        parts.append(Part(tuple(part), loaded, tuple((i, slots[i]) for i in part if i in slots)))
    return tuple(parts), most
