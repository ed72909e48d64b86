"""Orders in which the operations of a program can be evaluated, and the number of values that each keeps alive.

A value is alive from its operation to its last reader; what is alive at once wants as many registers. Chains are
recorded well. Trees gain from a list schedule, which finishes a limb before it begins the next.
"""

from __future__ import annotations

import heapq
from collections.abc import Container, Sequence
from itertools import accumulate

from torchdq.program.program import Program

TOGETHER = ("sin", "cos")  # operations on the same angle that one call computes
GIVEN = ("in", "const")  # values that can be read again at any time


def pairs(program: Program) -> dict[int, tuple[int, ...]]:
    """Sine and cosine of the same angle, by the index of each."""
    known = {(op.code, op.operands): i for i, op in enumerate(program.ops) if op.code in TOGETHER}
    return {
        i: tuple(known[code, angle] for code in TOGETHER if (code, angle) in known) for (_, angle), i in known.items()
    }


def recorded(program: Program, left_out: Container[int] = ()) -> list[int]:
    """Values in the order in which they were recorded, sine and cosine of one angle next to each other.

    Inputs come right before the first operation on them, so that they do not occupy registers before.
    """
    together = pairs(program)
    order: dict[int, None] = {}
    for i, op in enumerate(program.ops):
        if i not in left_out and op.code != "in":
            read = [k for k in op.operands if program.ops[k].code == "in" and k not in left_out]
            order.update(dict.fromkeys([*read, *together.get(i, (i,))]))
    only_results = [i for i in range(len(program.ops)) if i not in left_out and i not in order]
    return [*order, *only_results]


def listed(program: Program) -> list[int]:
    """Values in the order of a list schedule.

    Of the operations whose operands are known, the next is the one that leaves fewest values alive; of equals, the
    one that continues the latest value. An input that is read for the first time counts as a value.
    """
    ops = program.ops
    operands = [tuple(dict.fromkeys(op.operands)) for op in ops]
    readers: list[list[int]] = [[] for _ in ops]
    for i, mine in enumerate(operands):
        for k in mine:
            readers[k].append(i)
    given = [op.code in GIVEN for op in ops]
    missing = [sum(not given[k] for k in mine) for mine in operands]
    unread = [len(later) for later in readers]
    touched = [-1] * len(ops)  # place in the order at which a value was computed or last read
    order: dict[int, None] = {}

    def rank(i: int) -> tuple[int, int, int]:
        change = int(bool(readers[i]))
        for k in operands[i]:
            if ops[k].code == "in" and k not in order:
                change += unread[k] > 1
            elif ops[k].code != "const":
                change -= unread[k] == 1
        return change, -max((touched[k] for k in operands[i]), default=-1), i

    ready = [rank(i) for i in range(len(ops)) if not given[i] and not missing[i]]
    heapq.heapify(ready)
    while ready:
        i = heapq.heappop(ready)[-1]
        if i in order:
            continue  # an earlier entry had a better rank; ranks never get worse
        order.update(dict.fromkeys(k for k in operands[i] if given[k]))
        order[i] = None
        for k in (*operands[i], i):
            touched[k] = len(order)
            unread[k] -= k != i
        for k in readers[i]:
            missing[k] -= 1
        near = {k for x in (*operands[i], i) if ops[x].code != "const" for k in readers[x]}
        for k in near:
            if not missing[k] and k not in order:
                heapq.heappush(ready, rank(k))
    return [*order, *(i for i in range(len(ops)) if i not in order)]


def alive(program: Program, order: Sequence[int]) -> int:
    """Most values that are alive at once, those apart that can be read again."""
    at = {i: t for t, i in enumerate(order)}
    last = dict(at)
    for i in order:
        for k in program.ops[i].operands:
            last[k] = max(last.get(k, 0), at[i])
    change = [0] * (len(order) + 2)
    for i in order:
        if program.ops[i].code not in GIVEN:
            change[at[i]] += 1
            change[max(last[i], at[i] + 1)] -= 1
    return max(accumulate(change))


def narrowest(program: Program) -> list[int]:
    """Of the recorded order and the list schedule, the one that keeps fewer values alive."""
    return min(recorded(program), listed(program), key=lambda order: alive(program, order))
