"""Test of an exported program: a program in C99 that compares its functions with golden vectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchdq.backends.choice import choose
from torchdq.export import c99, rollout
from torchdq.export.c99 import CFunction
from torchdq.program.autograd import per_sample
from torchdq.program.loop import Loop
from torchdq.program.program import Program

CASES = 8  # golden vectors
STEPS = 3  # of a rollout: few, since they magnify how two compilers round
SAMPLES = 37  # in a batch; not a whole number of blocks
CPU = torch.device("cpu")
# names of arguments that cannot be negative
POSITIVE = ("mass", "base_mass", "armature", "viscous", "coulomb", "kp", "kd")

COMPARE = """
static void compare(const {0} *found, const {0} *expected, int size, {0} *worst)
{{
    {0} largest = 0;
    int j;
    for (j = 0; j < size; j++) largest = fmax{1}(largest, fabs{1}(expected[j]));
    for (j = 0; j < size; j++) {{
        const {0} difference = fabs{1}(found[j] - expected[j]) / (largest > 0 ? largest : 1);
        if (!(difference <= *worst)) *worst = difference;
    }}
}}
"""


def variables(program: Program) -> frozenset[str]:
    """Names of the files' own, so that no function can have them."""
    names = [a.name for side in c99.arrays(program) for a in side.values()]
    derived = (f"{part}_{name}" for name in names for part in ("in", "out", "found", "sum_of", "after"))
    own = names if rollout.loop(program) else []
    return frozenset(["batch", "rollout", "compare", "worst", "j", "k", *own, *derived])


def test(function: CFunction, batches: bool, examples: Mapping[str, Tensor]) -> str:
    """Program in C99 that returns 1 if the functions do not agree with the results of this machine.

    `examples` are values of some of the arguments; the others are random.
    """
    program, name, number = function.program, function.name, function.number
    taken, given = function.taken, function.given
    bound, dtype = ("1e-5f", torch.float32) if function.single else ("1e-12", torch.float64)
    inputs = [_example(a.name, a.width, a.uniform, examples, k).to(dtype) for k, a in enumerate(program.arguments)]
    over = rollout.loop(program)
    known = {"in": (taken, inputs), "out": (given, _results(program, inputs))}
    known |= {"after": (given, _rolled(over, inputs))} if over else {}
    tables = [
        table(function, f"{kind}_{a.name}", x)
        for kind, (arrays, rows) in known.items()
        for a, x in zip(arrays, [x for x in rows if x.shape[1]], strict=True)
    ]
    locals_ = " ".join(f"{number} found_{a.name}[{a.size}];" for a in given)
    passed = ", ".join([*(f"in_{a.name}[k]" for a in taken), *(f"found_{a.name}" for a in given)])
    called = ("    rollout(&worst);\n" if over else "") + ("    batch(&worst);\n" if batches else "")
    checks = "\n".join(f"        compare(found_{a.name}, out_{a.name}[k], {a.size}, &worst);" for a in given)
    return (
        f"/* {name} against golden vectors; returns 0 if they agree to {bound} */\n"
        f'#include <math.h>\n#include <stdio.h>\n#include "{name}.h"\n\n{"".join(tables)}'
        f"{COMPARE.format(number, 'f' * function.single)}"
        f"{_rollout(function) if over else ''}{_batch(function) if batches else ''}\n"
        f"int main(void)\n{{\n    {number} worst = 0;\n    int k;\n    for (k = 0; k < {CASES}; k++) {{\n"
        f"        {locals_}\n        (void){name}({passed});\n{checks}\n    }}\n"
        f"{called}"
        f'    printf("{name}: largest relative difference %g\\n", (double)worst);\n'
        f"    return worst <= {bound} ? 0 : 1;\n}}\n"
    )


def _batch(function: CFunction) -> str:
    """Function that compares a batch, in which the golden vectors come again and again, with these."""
    number, given = function.number, function.given
    sums, rows, every = [a for a in given if a.shared], [a for a in given if not a.shared], [*function.taken, *given]
    passed = [str(SAMPLES), *(f"found_{a.name}[0]" for a in every)]
    arrays = [f"static {number} found_{a.name}[{1 if a.shared else SAMPLES}][{a.size}];" for a in every]
    arrays += [f"{number} sum_of_{a.name}[{a.size}] = {{0}};" for a in sums]
    filled = [
        f"for (j = 0; j < {a.size}; j++) found_{a.name}[{0 if a.shared else 'k'}][j] = in_{a.name}[k % {CASES}][j];"
        for a in function.taken
    ]
    filled += [f"for (j = 0; j < {a.size}; j++) sum_of_{a.name}[j] += out_{a.name}[k % {CASES}][j];" for a in sums]
    compared = [f"compare(found_{a.name}[k], out_{a.name}[k % {CASES}], {a.size}, worst);" for a in rows]
    lines = [*arrays, "int j, k;", *_for_each(SAMPLES, filled)]
    lines += [f"(void){function.name}_batch({', '.join(passed)});", *_for_each(SAMPLES, compared)]
    lines += [f"compare(found_{a.name}[0], sum_of_{a.name}, {a.size}, worst);" for a in sums]
    return f"\nstatic void batch({number} *worst)\n{{\n{c99.indented(lines)}}}\n"


def _rollout(function: CFunction) -> str:
    """Function that compares a rollout, whose inputs are the golden vectors, with what follows from them."""
    taken, given = function.taken, function.given
    passed = ", ".join([str(STEPS), *(f"in_{a.name}[0]" for a in taken), *(f"found_{a.name}[0]" for a in given)])
    lines = [*(f"{function.number} found_{a.name}[{STEPS}][{a.size}];" for a in given), "int k;"]
    lines += [f"(void){function.name}_rollout({passed});"]
    lines += _for_each(STEPS, [f"compare(found_{a.name}[k], after_{a.name}[k], {a.size}, worst);" for a in given])
    return f"\nstatic void rollout({function.number} *worst)\n{{\n{c99.indented(lines)}}}\n"


def _for_each(count: int, lines: Sequence[str]) -> list[str]:
    """Lines of a loop over k; none around nothing."""
    return [f"for (k = 0; k < {count}; k++) {{", *(f"    {line}" for line in lines), "}"] if lines else []


def _rolled(over: Loop, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Rows [steps, width] of all outputs of a rollout from the first of the rows, which has one for every step."""
    given, steps = [x[:1] for x in inputs], []
    for s in range(STEPS):
        for k in over.stepped:
            given[k] = inputs[k][s : s + 1]
        steps.append(_results(over.body, given))
        for k, r in over.carried:
            given[k] = steps[-1][r]
    return [torch.cat(rows) for rows in zip(*steps, strict=True)]


def table(function: CFunction, name: str, rows: Tensor) -> str:
    """Constant array of rows."""
    lines = [", ".join(map(function.dialect.literal, row)) for row in rows.tolist()]
    listed = ",\n".join(f"    {{{line}}}" for line in lines)
    return f"static const {function.number} {name}[{len(rows)}][{rows.shape[1]}] = {{\n{listed}\n}};\n"


def _results(program: Program, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Rows [cases, width] of all outputs; each sample has its own sums."""
    apart = any(a.uniform for a in program.arguments) or any(r.summed for r in program.results)
    kernel = choose(None, CPU).kernel(per_sample(program) if apart else program, inputs[0].dtype, CPU)
    return kernel(inputs, len(inputs[0]))


def _example(name: str, width: int, uniform: bool, examples: Mapping[str, Tensor], seed: int) -> Tensor:
    """Rows for an argument: given ones, or random numbers."""
    if name in examples:
        return examples[name].detach().double().cpu().reshape(-1, width).expand(CASES, width).clone()
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(1 if uniform else CASES, width, generator=generator, dtype=torch.float64).expand(CASES, width)
    if name == "noise":
        return x.contiguous()
    if name in POSITIVE:
        return 0.5 + x
    x = 2 * x - 1
    if name in ("inertia", "base_inertia"):
        round_body = torch.tensor([1.0, 0.0, 1.0, 0.0, 0.0, 1.0], dtype=torch.float64)
        return 0.1 * x + round_body.repeat(width // 6)
    if name in ("X_WB", "X_PB_home"):  # unit dual quaternions
        r, d = x.reshape(CASES, -1, 2, 4).unbind(-2)
        r = r / r.norm(dim=-1, keepdim=True)
        return torch.stack([r, d - (d * r).sum(-1, keepdim=True) * r], -2).reshape(CASES, width)
    return x.contiguous()
