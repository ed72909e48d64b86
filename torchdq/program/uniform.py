"""Values of a program that all samples share, and the split of a program into these and the rest."""

from __future__ import annotations

from typing import NamedTuple

from torchdq.numbers.record import Op, Recorded, Tape
from torchdq.program.program import Argument, Program, finish, growths, outputs, results

COMMON = "common"  # name of the row of values that all samples share
LEAST_SAVED = 0.03  # least part of its operations that a split must spare a sample


class Split(NamedTuple):
    """Two programs that replace one."""

    common: Program  # its one result is the row of values that all samples share
    rest: Program  # its last argument, which is uniform, is that row


def shared(program: Program) -> tuple[bool, ...]:
    """Whether a value is the same for all samples, since it follows from uniform arguments and constants alone."""
    known: list[bool] = []
    for op in program.ops:
        if op.code == "in":
            known.append(program.arguments[op.payload[0]].uniform)
        else:
            known.append(all(known[k] for k in op.operands))
    return tuple(known)


def split(program: Program) -> Split | None:
    """Program in two; None: that would spare a sample too little."""
    ops, same = program.ops, shared(program)
    read = {k for i, op in enumerate(ops) if not same[i] for k in op.operands}
    read.update(v[0] for result in outputs(program) for v in result.values if not isinstance(v, float))
    handed = [i for i in sorted(read) if same[i] and ops[i].operands]
    spared = sum(same[i] and bool(op.operands) for i, op in enumerate(ops)) - len(handed)
    if spared <= LEAST_SAVED * sum(bool(op.operands) for op in ops):
        return None
    places = {i: Op("in", payload=(len(program.arguments), j)) for j, i in enumerate(handed)}
    first, second = Tape(), Tape()
    first.ops, second.ops = list(ops), [places.get(i, op) for i, op in enumerate(ops)]
    given, rest = ([Recorded(tape, i, False) for i in range(len(ops))] for tape in (first, second))
    arguments = (*program.arguments, Argument(COMMON, len(handed), uniform=True))
    summed = [r.name for r in program.results if r.summed]
    return Split(
        finish(program.name, program.arguments, first, {COMMON: [given[i] for i in handed]}),
        finish(program.name, arguments, second, results(program, rest), summed, growths(program, rest)),
    )
