"""Receding horizons in C99: a tick, in loops over the functions of a step under gains and of a knot.

A tick does what a call of `Receding` does: it moves the plan on by a step, follows it by its gains from the state that
is measured, and improves what comes of it by the rules of the solver. All its memory is a struct of the caller.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.call import Computation
from torchdq.export import c99, files, golden, parts
from torchdq.export.c99 import CFunction, Library
from torchdq.export.files import Exported
from torchdq.export.meaning import described, words
from torchdq.export.names import distinct
from torchdq.optimal.costs import named
from torchdq.optimal.ilqr import DAMPED, LEAST, LENGTHS
from torchdq.optimal.knot import NEXT, Knot
from torchdq.optimal.problem import Passes, Plan, joined
from torchdq.program.program import Argument
from torchdq.scene.policies import STEPPED, LinearForm
from torchdq.scene.recording import Stage
from torchdq.scene.spec import POLICY, POSES

BOUNDS = {False: "1e-9", True: "1e-3f"}  # largest relative differences of the test, by whether numbers are single
NAMES = ("forward", "backward", "compare", "in_state", "out_torque", "out_gain")  # of the files' own

_ABOUT = """
$described

${name}_begin writes the problem and the plan of the export; goals, weights and limits may change between ticks.
${name}_tick moves the plan on by a step, and improves it from the state that is measured. It writes the
$control of the step that begins now, and gains for a loop that is faster than the ticks:
$control + gain (x - x_plan), where x is measured, and x_plan the plan at that time, from plan.states[0], the state of
the tick, to plan.states[1], that of the next. gain[$n][$s] is row by row, in SI units; its columns are
$displaced, in this order. Keep the sum within the limits: no rate of $control is limited.
It simulates the $steps steps $fewest times, up to $most where costs do not fall at once, as where a goal jumps.
Returns 1 where a result is not finite, else 0. What is written as $control is NaN then, and the plan only moves on.
All memory is the struct, of which every thread or robot has its own; nothing is allocated.
"""
_TYPES = """typedef struct {
$members} ${name}_problem;

typedef struct {
    $S states[$points][$state]; /* $rows, from the start on */
    $S $control[$steps][$n];
    $S gain[$steps][$gains]; /* of every step [$n][$s], row by row */
} ${name}_plan;

typedef struct {
    ${name}_problem problem;
    ${name}_plan plan;
    struct {
        ${name}_plan now, next;
        $S change[$steps][$n];
    } work;
} $name;

void ${name}_begin($name *mpc);
$tick;"""
_LOOPS = """${zeros}static $S forward(const ${name}_problem *problem, const ${name}_plan *along,
    $S (*change)[$n], $S length, ${name}_plan *found)
{
    $S cost = 0, of_step[1], torque[$n];
    int j, k;
    for (k = 0; k < $steps; k++) {
        for (j = 0; j < $n; j++) torque[j] = along->$control[k][j] + (change ? length * change[k][j] : 0);
        for (j = 0; j < $gains; j++) found->gain[k][j] = along->gain[k][j];
        (void)${name}_step($step);
        cost += of_step[0];
    }
    return cost - cost == 0 ? cost : ($S)1 / ($S)0;
}

static void backward(const ${name}_problem *problem, ${name}_plan *at, $S damping, $S (*change)[$n], $S *terms)
{
    $S V[2][$V] = {{0}}, v[2][$v] = {{0}}, of_knot[2];
    int k;
    terms[0] = terms[1] = 0;
    for (k = $steps - 1; k >= 0; k--) {
        (void)${name}_knot($knot);
        terms[0] += of_knot[0];
        terms[1] += of_knot[1];
    }
}

void ${name}_begin($name *mpc)
{
    static const ${name}_problem problem = {
$problem    };
    static const ${name}_plan plan = {
$plan    };
    mpc->problem = problem;
    mpc->plan = plan;
}

$tick
{
    const ${name}_problem *problem = &mpc->problem;
    ${name}_plan *plan = &mpc->plan, *now = &mpc->work.now, *next = &mpc->work.next;
    $S (*change)[$n] = mpc->work.change;
    $S cost, after = 0, expected, terms[2], wrong, damping = 0, length;
    int j, k;
    for (k = 0; k < $steps; k++) {
        for (j = 0; j < $state; j++) plan->states[k][j] = plan->states[k + 1][j];
        if (k + 1 == $steps) break;
        for (j = 0; j < $n; j++) plan->$control[k][j] = plan->$control[k + 1][j];
        for (j = 0; j < $gains; j++) plan->gain[k][j] = plan->gain[k + 1][j];
    }
$measured    cost = forward(problem, plan, 0, 0, now);
    for (k = 0; k < $iterations; k++) {
        backward(problem, now, damping, change, terms);
        for (j = 0, length = 1; j < $lengths; j++, length *= ($S)0.5) {
            after = forward(problem, now, change, length, next);
            expected = length * (terms[0] + ($S)0.5 * length * terms[1]);
            if (cost - after >= ($S)$least * (expected < 0 ? -expected : expected)) break; /* not where one is NaN */
        }
        if (j < $lengths) {
            *now = *next;
            cost = after;
            damping = damping > ($S)$damped ? ($S)0.1 * damping : 0;
        } else {
            damping = 10 * damping > ($S)$damped ? 10 * damping : ($S)$damped;
        }
    }
    wrong = cost - cost;
    for (k = 0; k < $steps; k++)
        for (j = 0; j < $gains; j++) wrong += now->gain[k][j] - now->gain[k][j];
    if (wrong == 0) *plan = *now;
    for (j = 0; j < $n; j++) $control[j] = plan->$control[0][j] + wrong; /* 0, or NaN */
    for (j = 0; j < $gains; j++) gain[j] = plan->gain[0][j];
    return wrong == 0 ? 0 : 1;
}
"""
_TEST = """/* ticks of $name against golden vectors; returns 0 if they agree to $bound */
#include <math.h>
#include <stdio.h>
#include "$name.h"

$tables$compare
int main(void)
{
    static $name mpc;
    $S worst = 0, torque[$n], gain[$gains];
    int k, status = 0;
    ${name}_begin(&mpc);
    for (k = 0; k < $ticks; k++) {
        status |= ${name}_tick(&mpc, $passed, torque, gain);
        compare(torque, out_torque[k], $n, &worst);
        compare(mpc.plan.$control[0], out_torque[k], $steps * $n, &worst);
        compare(gain, out_gain[k], $gains, &worst);
    }
    printf("$name: largest relative difference %g\\n", (double)worst);
    return status == 0 && worst <= $bound ? 0 : 1;
}
"""


class Member(NamedTuple):
    """Numbers of the problem in its struct."""

    name: str  # in C
    numbers: Tensor  # [k], or those of every step [steps, k]
    last: bool  # whether they are zero but at the last step


class Horizon(NamedTuple):
    """Receding horizon of one robot as it is exported."""

    passes: Passes
    plan: Plan  # at first
    ticks: Sequence[Tensor]  # golden vectors [ticks, ...]: states, torques of all steps, gains of the first
    iterations: int  # of a tick
    name: str
    mathematics: Library  # source of sine, cosine and roots

    @property
    def members(self) -> dict[str, Member]:
        """Numbers of the problem, by the names of arguments."""
        of, first = self.passes, len(self.passes.problem.costs)
        last = [named("weight", k) for k in range(first, len(of.problem.objective.terms))]
        found = {name: x[-1, 0] if name in last else x[:, 0].flatten(1) for name, x in of.stepped.items()}
        found |= {name: x[0].flatten() for name, x in (of.fixed | of.bounds()).items()}
        found |= {name: x.flatten() for name, x in of.shared.items()}
        names = zip(found.items(), distinct(found), strict=True)
        return {name: Member(own, x, name in last) for (name, x), own in names}

    def rows(self, states: str = "", before: str = "") -> dict[str, str]:
        """Places of the rows of a state, as they are joined, by their names with something before them."""
        spec, found, at = self.passes.problem.scene.spec, dict[str, str](), 0
        for name in spec.displaced:
            found[before + name], at = f"{states} + {at}", at + spec.state[name]
        return found

    def write(self, folder: Path) -> Exported:
        """Files in a folder, which is made if it is not there."""
        (step, knot), problem = self.functions(), self.passes.problem
        known = self._words(step) | self._calls(step, knot)
        about, types, loops, test = (Template(x).substitute(known) for x in (_ABOUT, _TYPES, _LOOPS, _TEST))
        costs = [f"cost {k}: {type(cost).__name__}" for k, cost in enumerate((*problem.costs, *problem.final))]
        both = step._replace(program=replace(step.program, ops=step.program.ops + knot.program.ops))
        heading, before = [*step.program.about, *costs], f'#include "{self.name}.h"\n{both.preamble()}'
        source = "\n".join([c99.comment(heading) + before, parts.text(step), parts.text(knot), loops])
        header = files.header(self.name, [*heading, *about.splitlines()], "", types)
        return files.write_project(folder, step._replace(name=self.name), source, header, test)

    def functions(self) -> tuple[CFunction, CFunction]:
        """Function of a step under gains, and of a knot."""
        of, boxed, rows = self.passes, self.passes.limits is not None, [*self.plan.states.rows()]
        spec, objective, same = of.problem.scene.spec, of.problem.objective, [*of.fixed, *of.shared]
        step = Stage(spec, "step", objective, policy=LinearForm(boxed, objective.control), unguarded=True)
        along = [*rows, *of.stepped, *STEPPED, *same, *[f"{POLICY}.{name}" for name in of.bounds()]]
        # in the order of `Passes`, for which a knot is recorded already
        at = ["V", "v", *rows, *[NEXT + name for name in rows], objective.control, *of.stepped, "damping", *same]

        def function(name: str, what: Computation, taken: Sequence[str]) -> CFunction:
            arguments = [Argument(x, math.prod(what.axes(x)), x in of.shared) for x in taken]
            single = self.plan.torque.dtype == torch.float32
            return CFunction(what.program(tuple(arguments)), f"{self.name}_{name}", single, self.mathematics)

        return function("step", step, along), function("knot", Knot(spec, objective, boxed), [*at, *of.bounds()])

    def _words(self, step: CFunction) -> dict[str, Any]:
        """Names and numbers in the texts, but for calls."""
        plan: Any = self.plan
        number, literal, (steps, n, s) = step.number, step.dialect.literal, plan.gain.shape
        state, first = plan.states.rows(), (joined(plan.states.rows()), plan.torque, plan.gain.flatten(1))
        rows, members = self.rows(), [*self.members.values()]
        taken = {name: f"{name}[{state[name].shape[-1]}]" for name in rows}
        given = {plan.control: f"{plan.control}[{n}]", "gain": f"gain[{n * s}]"}
        passed = [f"const {number} {x}" for x in taken.values()] + [f"{number} {x}" for x in given.values()]
        about = [described([*x.values()], [*x], way) for x, way in ((taken, "in "), (given, "out"))]
        begun = [(state[name].shape[-1], f"states[0][j{at}] = ", name) for name, at in rows.items()]
        zeros = max([len(x.numbers) for x in members if x.last], default=0)
        tables = zip(("in_state", "out_torque", "out_gain"), self.ticks, strict=True)
        return {
            **{"name": self.name, "S": number, "control": plan.control, "steps": steps, "n": n, "gains": n * s, "s": s},
            "displaced": ", ".join([_column(*x) for x in self.passes.problem.scene.spec.displaced.items()]),
            **{"state": first[0].shape[1], "rows": ", ".join(rows), "V": s * (s + 1) // 2, "v": s},
            **{"iterations": self.iterations, "lengths": LENGTHS, "least": LEAST, "damped": DAMPED},
            **{"fewest": 1 + self.iterations, "most": 1 + self.iterations * LENGTHS, "points": steps + 1},
            "tick": f"int {self.name}_tick({self.name} *mpc, {', '.join(passed)})",
            "described": "\n".join(chain(*about)),
            "members": c99.indented([_declared(number, *x) for x in self.members.items()]),
            "zeros": f"static const {number} zeros[{zeros}] = {{0}};\n\n" * bool(zeros),
            "measured": c99.indented([f"for (j = 0; j < {k}; j++) now->{x}next->{x}{y}[j];" for k, x, y in begun]),
            "problem": c99.indented([f"{_braced(x.numbers.tolist(), literal)}," for x in members], 8),
            "plan": c99.indented([f"{_braced(x.tolist(), literal)}," for x in first], 8),
            **{"ticks": len(self.ticks[0]), "passed": ", ".join(self.rows("in_state[k]").values())},
            "tables": "".join([golden.table(step, name, x) for name, x in tables]),
            "compare": golden.COMPARE.format(number, "f" * step.single),
            "bound": BOUNDS[step.single],
        }

    def _calls(self, step: CFunction, knot: CFunction) -> dict[str, str]:
        """Arguments of the calls at step k."""
        control, last, found = self.plan.control, len(self.plan.torque) - 1, dict[str, str]()
        for name, x in self.members.items():
            found[name] = f"k < {last} ? zeros : " * x.last + f"problem->{x.name}" + "[k]" * (x.numbers.ndim > 1)
        found |= {f"{POLICY}.{name}": found[name] for name in self.passes.bounds()}
        along = dict(zip(STEPPED, ("along->gain[k]", "torque", "along->states[k]"), strict=True))
        along |= self.rows("found->states[k]")
        moved = {**self.rows("found->states[k + 1]"), "cost": "of_step", "planned": f"found->{control}[k]"}
        at = {**self.rows("at->states[k]"), **self.rows("at->states[k + 1]", NEXT), control: f"at->{control}[k]"}
        at |= {"damping": "&damping", "V": "V[(k + 1) % 2]", "v": "v[(k + 1) % 2]"}
        solved = {"V": "V[k % 2]", "v": "v[k % 2]", "gain": "at->gain[k]", "change": "change[k]"}
        knots = _passed(knot, found | at, {**solved, "expected": "of_knot"})
        return {"step": _passed(step, found | along, moved), "knot": knots}


def _column(name: str, width: int) -> str:
    """Columns of a gain that belong to a row of the state."""
    return f"{name}[{width}]{' (xi of X_plan exp(xi/2): a twist of each pose)' * (name in POSES)}"


def _declared(number: str, name: str, member: Member) -> str:
    """Declaration of numbers of the problem."""
    text = "of the last step" if member.last else words(name)
    axes = "".join([f"[{k}]" for k in member.numbers.shape])
    return f"{number} {member.name}{axes};" + f" /* {text} */" * bool(text)


def _passed(function: CFunction, taken: Mapping[str, str], given: Mapping[str, str]) -> str:
    """Arguments of a call, whose places are known by the names of arguments and results."""
    program, (ours, theirs) = function.program, c99.arrays(function.program)
    passed = [taken[program.arguments[k].name] for k in ours]
    return ", ".join([*passed, *[given[program.results[k].name] for k in theirs]])


def _braced(x: Any, literal: Callable[[float], str]) -> str:
    """Initialiser of numbers, in lists or by itself."""
    return f"{{{', '.join([_braced(y, literal) for y in x])}}}" if isinstance(x, list) else literal(x)
