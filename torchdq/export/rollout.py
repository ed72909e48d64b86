"""C99 text of the rollout of a step: the function of one step, called again and again on its own results.

A program is a step if some of its results are arguments, by name and width: these are carried from step to step. Other
arguments are given for every step, those that are uniform once; results are written for every step.
"""

from __future__ import annotations

from torchdq.export import c99
from torchdq.export.c99 import CFunction
from torchdq.program.loop import Loop
from torchdq.program.program import Program


def loop(program: Program) -> Loop | None:
    """Loop over a program that keeps all results; None: it is no step."""
    arguments = [(k, a) for k, a in enumerate(program.arguments) if not a.uniform]
    results = {(x.name, len(x.values)): r for r, x in enumerate(program.results) if x.values and not x.summed}
    states = [(k, a) for k, a in arguments if not a.name.endswith("'")]  # cotangents would be carried the other way
    carried = tuple((k, results[a.name, a.width]) for k, a in states if (a.name, a.width) in results)
    stepped = [k for k, _ in arguments if k not in dict(carried)]
    return Loop(program, carried, tuple(stepped), tuple(range(len(program.results)))) if carried else None


def text(over: Loop, step: CFunction) -> str:
    """Text of the rollout, which follows the function of the step."""
    taken, given = c99.arrays(step.program)
    passed, states = [], {k: given[r] for k, r in over.carried if r in given}
    for k, a in taken.items():
        if k in states:
            passed.append(f"place ? {states[k].name} + {a.size} * (place - 1) : {a.name}")
        else:
            passed.append(f"{a.name} + {a.size} * place" if k in over.stepped else a.name)
    passed += [f"{a.name} + {a.size} * place" for a in given.values()]
    lines = ["size_t place;", "int status = 0;", "for (place = 0; place < steps; place++)"]
    lines += [f"    status |= {step.name}({', '.join(passed)});", "return status;"]
    return f"{step.declaration('rollout')}\n{{\n{c99.indented(lines)}}}\n"


def about(over: Loop, name: str) -> list[str]:
    """Lines about the rollout."""
    arguments = over.body.arguments
    several = [arguments[k].name for k in over.stepped if arguments[k].width]
    return [
        "",
        f"{name}_rollout takes many steps, each from the results of the last; it returns 1 where one does.",
        f"One row, of the start: {', '.join(arguments[k].name for k, _ in over.carried)}.",
        f"A row for every step, one after the other: {', '.join([*several, 'all outputs'])}.",
        "No output may be the array of an input.",
    ]
