"""Receding horizons in C99: a tick, in loops over the functions of a step under gains and of a knot.

A tick does what a call of `Receding` does: it moves the plan on by a step, follows it by its gains from the state that
is measured, and improves what comes of it by the rules of the solver. All its memory is a struct of the caller.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
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
from torchdq.optimal.costs import Residuals, named
from torchdq.optimal.knot import NEXT, Knot
from torchdq.optimal.problem import Passes, Plan, joined
from torchdq.program.program import Argument
from torchdq.scene.policies import STEPPED, LinearForm
from torchdq.scene.recording import Stage
from torchdq.scene.spec import POLICY

BOUNDS = {False: "1e-9", True: "1e-3f"}  # largest relative differences of the test, by whether numbers are single

_ABOUT = """
$described

${name}_begin writes the problem and the plan of the export; goals, weights and limits may change between ticks.
${name}_tick moves the plan on by a step, and improves it from the state that is measured. It writes the
$control of the step that begins now, and gains in displacements of the state, for what happens until the next tick.
Passes of a tick over the steps: $iterations backward, and $least_passes to $most forward, most where a goal jumps. Some ticks in
one state make a plan of another problem.
Returns 1 where a result is not finite, else 0. The plan has moved on then, and is what is written; the next tick
goes on from it.
"""
_TYPES = """typedef struct {
$members} ${name}_problem;

typedef struct {
    $S states[$steps + 1][$state]; /* $rows, from the start on */
    $S $control[$steps][$n];
    $S gain[$steps][$gains]; /* row by row */
} ${name}_plan;

typedef struct {
    ${name}_problem problem;
    ${name}_plan plan;
    struct {
        ${name}_plan plans[2];
        $S change[$steps][$n];
    } work;
} $name;

void ${name}_begin($name *mpc);
$tick;"""
_LOOPS = """${zeros}static $S forward(const ${name}_problem *problem, const ${name}_plan *along,
    const $S *change, $S length, ${name}_plan *found)
{
    $S cost = 0, of_step[1], torque[$n];
    int j, k;
    for (k = 0; k < $steps; k++) {
        for (j = 0; j < $n; j++) torque[j] = along->$control[k][j] + (change ? length * change[$n * k + j] : 0);
        for (j = 0; j < $gains; j++) found->gain[k][j] = along->gain[k][j];
        (void)${name}_step($step);
        cost += of_step[0];
    }
    return cost - cost == 0 ? cost : ($S)1 / ($S)0;
}

static void backward(const ${name}_problem *problem, ${name}_plan *at, $S damping, $S *change, $S *terms)
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

static void move_on($S *rows, int width, int count)
{
    int j;
    for (j = 0; j < width * (count - 1); j++) rows[j] = rows[j + width];
}

static $S zero_if_finite(const $S *numbers, int count)
{
    $S sum = 0;
    int j;
    for (j = 0; j < count; j++) sum += numbers[j] - numbers[j];
    return sum;
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
    ${name}_plan *plan = &mpc->plan, *now = &mpc->work.plans[0], *next = &mpc->work.plans[1], *other;
    $S *change = mpc->work.change[0];
    $S cost, after = 0, expected, terms[2], wrong, damping = 0, length;
    int j, k;
    move_on(plan->states[0], $state, $steps + 1);
    move_on(plan->$control[0], $n, $steps);
    move_on(plan->gain[0], $gains, $steps);
$measured    cost = forward(problem, plan, 0, 0, now);
    for (k = 0; k < $iterations; k++) {
        backward(problem, now, damping, change, terms);
        for (j = 0, length = 1; j < $lengths; j++, length *= ($S)0.5) {
            after = forward(problem, now, change, length, next);
            expected = -length * (terms[0] + ($S)0.5 * length * terms[1]);
            if (after - after != 0 || !(cost - after >= ($S)$least * expected)) continue;
            if (expected >= 0 || cost - cost != 0) break;
        }
        if (j < $lengths) {
            other = now;
            now = next;
            next = other;
            cost = after;
            damping = damping > ($S)$damped ? ($S)0.1 * damping : 0;
        } else {
            damping = 10 * damping > ($S)$damped ? 10 * damping : ($S)$damped;
        }
    }
    wrong = zero_if_finite(now->states[0], ($steps + 1) * $state) + zero_if_finite(now->$control[0], $steps * $n);
    wrong += zero_if_finite(now->gain[0], $steps * $gains);
    if (wrong == 0) *plan = *now;
    for (j = 0; j < $n; j++) $control[j] = plan->$control[0][j];
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
        compare(gain, out_gain[k], $gains, &worst);
    }
    printf("$name: largest relative difference %g\\n", (double)worst);
    return status == 0 && worst <= $bound ? 0 : 1;
}
"""


class Horizon(NamedTuple):
    """Receding horizon of one robot as it is exported."""

    passes: Passes
    plan: Plan  # at first
    ticks: Sequence[Tensor]  # golden vectors: states [ticks, x], torques [ticks, n], gains [ticks, n s]
    rules: Mapping[str, float]  # numbers of the solver, by their names in the text
    name: str
    library: Library

    @property
    def rows(self) -> dict[str, int]:
        """Widths of the rows of a state, in the order of those that are joined."""
        spec = self.passes.problem.scene.spec
        return {name: spec.state[name] for name in spec.displaced}

    @property
    def last(self) -> list[str]:
        """Weights of the last step alone."""
        of = self.passes.problem
        return [named("weight", k) for k in range(len(of.costs), len(of.objective.terms))]

    @property
    def numbers(self) -> dict[str, Tensor]:
        """Numbers of the problem by name, [k], or those of every step [steps, k]."""
        of = self.passes
        found = {name: x[:, 0].flatten(1) for name, x in of.stepped.items()}
        found |= {name: found[name][-1] for name in self.last}
        found |= {name: x[0].flatten() for name, x in (of.fixed | of.bounds()).items()}
        return found | {name: x.flatten() for name, x in of.shared.items()}

    def functions(self) -> tuple[CFunction, CFunction]:
        """Function of a step under gains, and of a knot."""
        of, spec, objective = self.passes, self.passes.problem.scene.spec, self.passes.problem.objective
        boxed, given = of.limits is not None, [*of.stepped, *of.fixed, *of.shared]
        step = Stage(spec, "step", objective, policy=LinearForm(boxed, objective.control), unguarded=True)
        taken = [*self.rows, *STEPPED, *given, *[f"{POLICY}.{name}" for name in of.bounds()]]
        ends = ["V", "v", *self.rows, *[NEXT + name for name in self.rows], objective.control, "damping"]

        def function(name: str, what: Computation, taken: Sequence[str]) -> CFunction:
            arguments = [Argument(x, math.prod(what.axes(x)), x in of.shared) for x in taken]
            single = self.plan.torque.dtype == torch.float32
            return CFunction(what.program(tuple(arguments)), f"{self.name}_{name}", single, self.library)

        knot = Knot(spec, objective, boxed)
        return function("step", step, taken), function("knot", knot, [*ends, *given, *of.bounds()])

    def write(self, folder: Path) -> Exported:
        """Files in a folder, which is made if it is not there."""
        step, knot = self.functions()
        both = step._replace(program=replace(step.program, ops=step.program.ops + knot.program.ops))
        known = self._words(step, knot)
        about, types, loops, test = (Template(x).substitute(known) for x in (_ABOUT, _TYPES, _LOOPS, _TEST))
        costs = (*self.passes.problem.costs, *self.passes.problem.final)
        heading = [*step.program.about, *[f"cost {k}: {_shown(cost)}" for k, cost in enumerate(costs)]]
        before = f'{c99.comment(heading)}#include "{self.name}.h"\n{both.preamble()}'
        source = "\n".join([before, parts.text(step), parts.text(knot) + loops])
        header = files.header(self.name, [*heading, *about.splitlines()], "", types)
        return files.write_project(folder, step._replace(name=self.name), source, header, test)

    def _words(self, step: CFunction, knot: CFunction) -> dict[str, Any]:
        """What the texts name."""
        plan: Any = self.plan
        number, literal, control, (steps, n, s) = step.number, step.dialect.literal, plan.control, plan.gain.shape
        rows, numbers, given = self.rows, self.numbers, {control: n, "gain": n * s}
        members = dict(zip(numbers, distinct(numbers), strict=True))
        first, firsts = (joined(plan.states.rows()), plan.torque, plan.gain.flatten(1)), self._places("")
        copied = [f"now->states[0][j{x}] = next->states[0][j{x}] = {row}[j];" for row, x in firsts.items()]
        widest = max([len(numbers[name]) for name in self.last], default=0)
        passed = [f"{self.name} *mpc", *[f"const {x}" for x in _listed(rows, number)], *_listed(given, number)]
        tables = zip(("in_state", "out_torque", "out_gain"), self.ticks, strict=True)
        return {
            **{"name": self.name, "S": number, "control": control, "steps": steps, "n": n, "gains": n * s},
            **{r.name: len(r.values) for r in knot.program.results if r.name in "Vv"},
            **{"state": sum(rows.values()), "rows": ", ".join(rows), "bound": BOUNDS[step.single], **self.rules},
            "least_passes": 1 + self.rules["iterations"],
            "most": 1 + self.rules["iterations"] * self.rules["lengths"],
            "tick": f"int {self.name}_tick({', '.join(passed)})",
            "described": "\n".join(
                described(_listed(rows), [*rows], "in ") + described(_listed(given), [*given], "out")
            ),
            "members": c99.indented([self._member(name, f"{number} {x}") for name, x in members.items()]),
            "zeros": f"static const {number} zeros[{widest}] = {{0}};\n\n" if widest else "",
            **self._calls(step, knot, members),
            "measured": c99.indented(
                [f"for (j = 0; j < {k}; j++) {x}" for k, x in zip(rows.values(), copied, strict=True)]
            ),
            "problem": c99.indented([f"{_braced(x.tolist(), literal)}," for x in numbers.values()], 8),
            "plan": c99.indented([f"{_braced(x.tolist(), literal)}," for x in first], 8),
            "ticks": len(self.ticks[0]),
            "tables": "".join([golden.table(step, name, x) for name, x in tables]),
            "compare": golden.COMPARE.format(number, "f" * step.single),
            "passed": ", ".join(self._places("in_state[k]").values()),
        }

    def _places(self, states: str, before: str = "") -> dict[str, str]:
        """Places of the rows of a state, by names with something before them."""
        widths = [*self.rows.values()]
        return {before + name: f"{states} + {sum(widths[:k])}" for k, name in enumerate(self.rows)}

    def _calls(self, step: CFunction, knot: CFunction, members: Mapping[str, str]) -> dict[str, str]:
        """What is passed to the functions, where k is the step."""
        control, (steps, n), found = self.plan.control, self.plan.torque.shape, dict[str, str]()
        for name, x in self.numbers.items():
            found[name] = f"k < {steps - 1} ? zeros : " * (name in self.last) + f"problem->{members[name]}"
            found[name] += "[k]" * (x.ndim > 1)
        found |= {f"{POLICY}.{name}": found[name] for name in self.passes.bounds()}
        under = dict(zip(STEPPED, ("along->gain[k]", "torque", "along->states[k]"), strict=True))
        under |= self._places("found->states[k]")
        moved = {**self._places("found->states[k + 1]"), "cost": "of_step", "planned": f"found->{control}[k]"}
        at = {**self._places("at->states[k]"), **self._places("at->states[k + 1]", NEXT)}
        at |= {control: f"at->{control}[k]", "damping": "&damping", "V": "V[(k + 1) % 2]", "v": "v[(k + 1) % 2]"}
        solved = {"gain": "at->gain[k]", "change": f"change + {n} * k", "expected": "of_knot"}
        solved |= {"V": "V[k % 2]", "v": "v[k % 2]"}
        return {"step": _passed(step, found | under, moved), "knot": _passed(knot, found | at, solved)}

    def _member(self, name: str, declared: str) -> str:
        """Member of the struct of the problem."""
        text = "of the last step" if name in self.last else words(name)
        axes = "".join([f"[{k}]" for k in self.numbers[name].shape])
        return f"{declared}{axes};" + f" /* {text} */" * bool(text)


def _passed(function: CFunction, taken: Mapping[str, str], given: Mapping[str, str]) -> str:
    """Arguments of a call, whose places are known by the names of arguments and results."""
    program, (ours, theirs) = function.program, c99.arrays(function.program)
    passed = [taken[program.arguments[k].name] for k in ours]
    return ", ".join([*passed, *[given[program.results[k].name] for k in theirs]])


def _listed(widths: Mapping[str, int], number: str = "") -> list[str]:
    """Arrays by name, with their type."""
    return [f"{number} {name}[{width}]".strip() for name, width in widths.items()]


def _braced(x: Any, literal: Callable[[float], str]) -> str:
    """Initialiser of numbers, in lists or by itself."""
    return f"{{{', '.join([_braced(y, literal) for y in x])}}}" if isinstance(x, list) else literal(x)


def _shown(cost: Residuals) -> str:
    """Cost in a word, with the name of its frame or row."""
    return " ".join([type(cost).__name__, *[x for x in cost.term.settings if isinstance(x, str)]])
