"""Derivatives of programs, which are programs again, to any order."""

from collections.abc import Callable, Sequence

from torchdq.numbers.ops import OPS
from torchdq.numbers.record import Recorded
from torchdq.program.program import Argument, Program, Value, finish, growths, inputs, recording, replay, results


def cotangents(program: Program, values: Sequence[Value], seeds: dict[int, Value]) -> dict[tuple[int, int], Value]:
    """Cotangents of the argument components by reverse mode, from the cotangents of some values; others are zero."""
    adjoint: list[Value] = [0.0] * len(values)
    for i, seed in seeds.items():
        adjoint[i] = seed
    found: dict[tuple[int, int], Value] = {}
    for i in reversed(range(len(values))):
        op, g = program.ops[i], adjoint[i]
        if not isinstance(g, Recorded) and g == 0:
            continue
        if op.code == "in":
            found[op.payload] = g
        elif op.code in OPS:
            row, x = OPS[op.code], [values[k] for k in op.operands]
            if row.divisor is not None:
                g = g / row.divisor(values[i], *x)
            for k, partial in zip(op.operands, row.partials, strict=True):
                if partial is not None:
                    adjoint[k] = adjoint[k] + partial(g, values[i], *x)
    return found


def gradient(program: Program, values: Sequence[Value], of: tuple[int, bool] | float) -> dict[tuple[int, int], Value]:
    """Gradient of one number of a result in the argument components; others are zero."""
    return {} if isinstance(of, float) else cotangents(program, values, {of[0]: -1.0 if of[1] else 1.0})


def vjp(program: Program, wrt: Sequence[int]) -> Program:
    """Vector-Jacobian product by reverse mode: takes the arguments and a cotangent per result, returns the gradients.

    `wrt` are positions of arguments; the gradients come in that order. The gradient of an argument that is uniform is
    summed over the samples; the cotangent of a summed result is uniform.
    """
    name = f"{program.name}_vjp"
    with recording(name) as tape:
        arguments = [*program.arguments]
        for r in program.results:
            arguments.append(Argument(_unused(f"{r.name}'", arguments), len(r.values), r.summed))
        rows = inputs(tape, arguments)
        values = replay(program, rows)
        seeds: dict[int, Value] = {}
        for result, row in zip(program.results, rows[len(program.arguments) :], strict=True):
            for v, seed in zip(result.values, row, strict=True):
                if not isinstance(v, float):
                    seeds[v[0]] = seeds.get(v[0], 0.0) + (-seed if v[1] else seed)
        found = cotangents(program, values, seeds)
        outputs = {
            f"{program.arguments[k].name}'": [found.get((k, j), 0.0) for j in range(program.arguments[k].width)]
            for k in wrt
        }
        summed = [f"{program.arguments[k].name}'" for k in wrt if program.arguments[k].uniform]
        return finish(name, arguments, tape, outputs, summed, growths(program, values))


def vjp_jacobian(program: Program, wrt: Sequence[int]) -> Program:
    """Jacobians of the vector-Jacobian product by forward over reverse mode, without uniform arguments and sums.

    They are those of `jacobian(vjp(program, wrt), ...)` in the arguments of `wrt`, which are second derivatives of the
    results, weighted with the cotangents and summed, and then in the cotangents, which are first derivatives. A
    symmetric pair is computed once.
    """
    product, name = vjp(program, wrt), f"{program.name}_vjp_jacobian"
    with recording(name) as tape:
        rows = inputs(tape, product.arguments)
        values, plain = replay(product, rows), replay(program, rows[: len(program.arguments)])
        places = [(k, j) for k in wrt for j in range(program.arguments[k].width)]
        second: list[list[Value]] = []  # below the diagonal, column by column
        first: dict[tuple[int, int], dict[str, list[Value]]] = {}
        for column, place in enumerate(places):
            second.append([x for row in rates(product, values, {place: 1.0}).values() for x in row][column:])
            first[place] = rates(program, plain, {place: 1.0})
        at = {place: k for k, place in enumerate(places)}
        outputs: dict[str, list[Value]] = {}
        for k in wrt:
            for i, r in zip(wrt, product.results, strict=True):
                pairs = [(at[i, a], at[k, b]) for a in range(len(r.values)) for b in range(program.arguments[k].width)]
                outputs[_name(r.name, program.arguments[k])] = [second[min(p)][max(p) - min(p)] for p in pairs]
        for result, cotangent in zip(program.results, product.arguments[len(program.arguments) :], strict=True):
            for i, r in zip(wrt, product.results, strict=True):
                outputs[_name(r.name, cotangent)] = [x for a in range(len(r.values)) for x in first[i, a][result.name]]
        return finish(name, product.arguments, tape, outputs, growths=growths(product, values))


def _unused(name: str, arguments: Sequence[Argument]) -> str:
    """Name that no argument has yet, made from the given one by adding primes."""
    while any(a.name == name for a in arguments):
        name += "'"
    return name


def tangents(program: Program, values: Sequence[Value], seeds: dict[tuple[int, int], Value]) -> list[Value]:
    """Tangents of all values by forward mode, from the tangents of some argument components; others are zero."""
    t: list[Value] = []
    for i, op in enumerate(program.ops):
        if op.code not in OPS:
            t.append(seeds.get(op.payload, 0.0) if op.code == "in" else 0.0)
            continue
        row, x, total = OPS[op.code], [values[k] for k in op.operands], 0.0
        for k, partial in zip(op.operands, row.partials, strict=True):
            if partial is not None and (isinstance(t[k], Recorded) or t[k] != 0):
                total = total + partial(t[k], values[i], *x)
        t.append(total if row.divisor is None else total / row.divisor(values[i], *x))
    return t


def rates(program: Program, values: Sequence[Value], seeds: dict[tuple[int, int], Value]) -> dict[str, list[Value]]:
    """Tangents of the results, from those of some argument components; zero for a constant result."""
    t = tangents(program, values, seeds)
    constant = {r.name: [isinstance(v, float) for v in r.values] for r in program.results}
    return {
        name: [0.0 if fixed else x for x, fixed in zip(row, constant[name], strict=True)]
        for name, row in results(program, t).items()
    }


def jvp(program: Program, wrt: Sequence[int]) -> Program:
    """Jacobian-vector product by forward mode: takes the arguments and a tangent of each argument in `wrt`."""
    name = f"{program.name}_jvp"
    with recording(name) as tape:
        arguments = [*program.arguments]
        for k in wrt:
            arguments.append(program.arguments[k]._replace(name=_unused(f"d{program.arguments[k].name}", arguments)))
        rows = inputs(tape, arguments)
        values = replay(program, rows)
        seeds = zip(wrt, rows[len(program.arguments) :], strict=True)
        outputs = rates(program, values, {(k, j): x for k, row in seeds for j, x in enumerate(row)})
        summed = [r.name for r in program.results if r.summed]
        return finish(name, arguments, tape, outputs, summed, growths(program, values))


def jacobian(program: Program, wrt: Sequence[int]) -> Program:
    """Full Jacobians of every result in every argument of `wrt`, [result, argument] row-major.

    Recorded by forward mode with a unit tangent per argument component, and by reverse mode with a unit cotangent per
    result component; the shorter program is returned.
    """
    return min((_jacobian(program, wrt, by) for by in (_by_columns, _by_rows)), key=lambda found: found.count().total)


def _jacobian(program: Program, wrt: Sequence[int], by: Callable[..., dict[str, list[Value]]]) -> Program:
    name = f"{program.name}_jacobian"
    with recording(name) as tape:
        values = replay(program, inputs(tape, program.arguments))
        return finish(name, program.arguments, tape, by(program, values, wrt), growths=growths(program, values))


def _name(result: str, argument: Argument) -> str:
    return f"d{result}/d{argument.name}"


def _by_columns(program: Program, values: Sequence[Value], wrt: Sequence[int]) -> dict[str, list[Value]]:
    outputs: dict[str, list[Value]] = {}
    for k in wrt:
        argument = program.arguments[k]
        columns = [rates(program, values, {(k, j): 1.0}) for j in range(argument.width)]
        for r in program.results:
            outputs[_name(r.name, argument)] = [c[r.name][i] for i in range(len(r.values)) for c in columns]
    return outputs


def _by_rows(program: Program, values: Sequence[Value], wrt: Sequence[int]) -> dict[str, list[Value]]:
    outputs: dict[str, list[Value]] = {_name(r.name, program.arguments[k]): [] for k in wrt for r in program.results}
    for r in program.results:
        for v in r.values:
            found = gradient(program, values, v)
            for k in wrt:
                argument = program.arguments[k]
                outputs[_name(r.name, argument)] += [found.get((k, j), 0.0) for j in range(argument.width)]
    return outputs
