"""Knot of a problem: derivatives of a step and its costs, the Riccati step and the box QP of it, as one program.

Costs of the steps that follow are V(s) = 1/2 ds^T V ds + v^T ds about the state after the step, ds being a displacement
as in a `Linearization`. With those of the step itself, by Gauss-Newton, they are pulled back through the step,

    Q(ds, du) = 1/2 (ds, du)^T T^T (V + J^T W J) T (ds, du) + (v + J^T W r)^T T (ds, du),   T = [A B; 0 1]

and minimised over du within the limits: du = change + gain ds. What Q is then, is V of the step before.

Where positions follow velocities, q' = q + dt qd', only rows of T for qd' are products; V is moved to (q, qd') first.

A knot whose products are too many for a program has programs of its parts, the costs and the minimum; see `riccati`.
Another, of exact second derivatives, is in `derivatives`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import add, mul
from typing import Any, NamedTuple

from torchdq.algebra.matrix import Matrix, matmul, transpose
from torchdq.algebra.quaternion import Number
from torchdq.backends.call import Computation
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.dynamics import ltdl
from torchdq.dynamics.posed import Row, dot
from torchdq.numbers.functions import at_least, below, clip, maximum, minimum, select
from torchdq.numbers.record import Recorded
from torchdq.optimal.costs import Objective
from torchdq.program.autodiff import rates
from torchdq.program.program import Argument, Program, record, replay, results
from torchdq.scene.free_base import displacements, rates_of
from torchdq.scene.policies import displacement
from torchdq.scene.recording import Stage
from torchdq.scene.spec import POSES, Rows, SceneSpec

COSTATE = "costate"
NEXT = "next "  # before the names of the rows of the state after a step
ROUNDS = 3  # Newton steps of a box QP
LARGEST = 400_000  # operations of a program that compiles within a minute
TINY = 1e-30  # least pivot


def named_rows(arguments: Sequence[Argument], rows: Sequence[Row]) -> Rows:
    """Rows by the names of arguments."""
    return {a.name: row for a, row in zip(arguments, rows, strict=True)}


def _knot(what: Knot, arguments: Sequence[Argument]) -> Callable[[Rows], Rows]:
    """Formula of all parts."""
    spec, control, asked = what.spec, what.objective.control, what.objective.inputs(what.spec.robot.n)
    taken = [a for a in arguments if a.name not in what.own and a.name not in asked]
    step, costs = what.step._replace(task=None).program(tuple(taken)), _costs(what, arguments)
    s, m = what.own["v"][0], what.own["change"][0]

    def algorithm(known: Rows) -> Rows:
        after, (M, g) = {name: known[NEXT + name] for name in spec.state}, costs(known)
        V, v = _half(known["V"], s), [*known["v"], *[0.0] * m]
        M = tuple(
            tuple([x + (V[i][j] if max(i, j) < s else 0.0) for j, x in enumerate(row)]) for i, row in enumerate(M)
        )
        moved = _Derived(step, taken, known, spec)
        gap = [x for name in spec.displaced for x in displacement(name, moved.values[name], after[name])]
        M, g = _pulled(moved, M, [a + b + dot(row[:s], gap) for a, b, row in zip(g, v, M, strict=True)], control)
        return _minimised(M, g, s, known["damping"][0], _room(what, known))

    return algorithm


def _costs(what: Knot, arguments: Sequence[Argument]) -> Callable[[Rows], tuple[Matrix, list[Number]]]:
    """Formula of the Gauss-Newton matrix J^T W J and the gradient J^T W r of the costs of a step."""
    spec, control, asked = what.spec, what.objective.control, what.objective.inputs(what.spec.robot.n)
    # costs are those of the next state, which differs from the state after the step where a start is not feasible
    judged = [a for a in arguments if a.name.startswith(NEXT) or "." in a.name or a.name in (*asked, control)]
    judged = [a._replace(name=a.name.removeprefix(NEXT)) for a in judged]
    cost = Stage(spec, "judge", what.objective._replace(squares=True)).program(tuple(judged))

    def algorithm(known: Rows) -> tuple[Matrix, list[Number]]:
        of = _Derived(cost, judged, known | {name: known[NEXT + name] for name in spec.state}, spec)
        J = of.columns(["residual"], [*spec.displaced, control])
        weighted = tuple([tuple([w * x for x in row]) for w, row in zip(of.values["weight"], J, strict=True)])
        return _gram(J, weighted), [dot(column, of.values["residual"]) for column in transpose(weighted)]

    return algorithm


def costs(what: Knot, arguments: Sequence[Argument]) -> Callable[[Rows], Rows]:
    """Formula of the costs alone, of every row of their matrix the numbers from the first not zero to the diagonal."""
    formula = _costs(what, arguments)

    def algorithm(known: Rows) -> Rows:
        M, g = formula(known)
        first = [[isinstance(x, Recorded) or x != 0.0 for x in row[:i]] + [True] for i, row in enumerate(M)]
        return {"g": g, **{f"M{i}": row[first[i].index(True) : i + 1] for i, row in enumerate(M)}}

    return algorithm


def smallest(what: Knot, arguments: Sequence[Argument]) -> Callable[[Rows], Rows]:
    """Formula of the change of the torques, and of its derivatives in their gradient, among those that may follow."""
    (m,) = what.own["change"]

    def algorithm(known: Rows) -> Rows:
        change, solved = _solved(_square(known["H"], m), known["slope"], known["damping"][0], _room(what, known))
        return {"change": change, "response": [-x for i in range(m) for x in solved(_unit(i, m))]}

    return algorithm


class _Derived:
    """Program on numbers, with derivatives of its results in displacements of a state and in other arguments."""

    def __init__(self, program: Program, arguments: Sequence[Argument], known: Rows, spec: SceneSpec):
        self.program, self.known, self.spec = program, known, spec
        self.at = {a.name: k for k, a in enumerate(arguments)}
        self.numbers = replay(program, [known[a.name] for a in arguments])
        self.values = results(program, self.numbers)

    def columns(self, of: Sequence[str], names: Sequence[str]) -> Matrix:
        """Matrix of the derivatives of results in arguments, both by name."""
        columns = []
        for name in names:
            width = self.spec.displaced.get(name, len(self.known[name]))
            for k in range(width):
                unit: Row = _unit(k, width)
                unit = rates_of(self.known[name], unit) if name in POSES else unit
                found = rates(self.program, self.numbers, {(self.at[name], j): x for j, x in enumerate(unit)})
                found |= {name: displacements(self.values[name], found[name]) for name in POSES if name in of}
                columns.append(tuple([x for name in of for x in found[name]]))
        return transpose(tuple(columns))


def _pulled(of: _Derived, M: Matrix, g: Row, control: str) -> tuple[Matrix, list[Number]]:
    """Quadratic form of a state after a step and its control, as one of the state before it and the control."""
    known, after, dt = of.known, of.values, of.spec.dt
    parts, n, m, width = [*of.spec.displaced], len(known["q"]), len(known[control]), len(g)
    follow = zip(known["q"], after["qd"], after["q"], strict=True)
    follows = parts == ["q", "qd"] and all([_equal(q + dt * v, x) for q, v, x in follow])
    rows = of.columns(["qd"] if follows else parts, [*parts, control])
    if follows:
        S = [[float(i == j) + dt * (j == i + n) * (i < n) for j in range(width)] for i in range(width)]
        M, g = _through(tuple(map(tuple, S)), M, g)
        rows = (*[_unit(i, width) for i in range(n)], *rows)
    return _through((*rows, *[_unit(width - m + i, width) for i in range(m)]), M, g)


def _unit(i: int, width: int) -> tuple[float, ...]:
    return tuple([float(i == j) for j in range(width)])


def _equal(a: Number, b: Number) -> bool:
    """Whether two numbers are one recorded value."""
    both: Any = a, b
    return all([isinstance(x, Recorded) for x in both]) and both[0].index == both[1].index and a.negative == b.negative


def _through(T: Matrix, M: Matrix, g: Row) -> tuple[Matrix, list[Number]]:
    """Quadratic form T^T M T, T^T g."""
    return _gram(T, matmul(M, T, mul, add)), [dot(column, g) for column in transpose(T)]


def _minimised(M: Matrix, g: Row, s: int, damping: Number, room: Sequence[Row]) -> Rows:
    """Minimum of a quadratic form over the control, as change and gain, with what it leaves of the form."""
    X, G, H = [row[:s] for row in M[:s]], tuple([row[:s] for row in M[s:]]), [row[s:] for row in M[s:]]
    change, solved = _solved(H, g[s:], damping, room)
    K: Matrix = transpose(tuple([tuple(solved([-x for x in column])) for column in transpose(G)]))
    moved, S = [dot(row, change) for row in H], _gram(G, K)
    return {
        "V": [X[i][j] + S[i][j] for i in range(s) for j in range(i + 1)],
        "v": [a + dot(b, change) for a, b in zip(g[:s], transpose(G), strict=True)],
        "gain": [x for row in K for x in row],
        "change": change,
        "expected": [dot(change, g[s:]), dot(change, moved)],
    }


def _solved(
    H: Sequence[Row], g: Row, damping: Number, room: Sequence[Row]
) -> tuple[list[Number], Callable[[Row], list[Number]]]:
    """Solutions of `box_qp` for a damped matrix."""
    heavy = [[x + damping * x if i == j else x for j, x in enumerate(row)] for i, row in enumerate(H)]
    lower, upper = room or ((), ())
    return box_qp(heavy, g, lower, upper)


def _room(what: Knot, known: Rows) -> list[Row]:
    """Smallest and largest changes of the torques within the limits, zero where they are rounding errors of torques."""
    control = known[what.objective.control] if what.boxed else ()
    return [[*map(_rounded, _less(known[name], control), control)] for name in ("lower", "upper") if what.boxed]


def _rounded(change: Number, x: Number) -> Number:
    """Change of a number; zero if it is a few units in the last place, by which a number at a limit may miss it."""
    near = 8.0 * x
    moved = near + change
    return select(at_least(moved, near) * at_least(near, moved), 0.0, change)


def box_qp(
    H: Sequence[Row], g: Row, lower: Row = (), upper: Row = (), rounds: int = ROUNDS
) -> tuple[list[Number], Callable[[Row], list[Number]]]:
    """Minimum x of 1/2 x^T H x + g^T x within bounds, and the solution of H y = b among what may follow a state.

    Projected Newton steps from zero, which must be within the bounds; without bounds one step is exact. An element is
    held where it is at a bound that the gradient pushes it against. What begins at a bound follows no state, even where
    it leaves the bound: gains would push it beyond, and clipped torques would not be those that are expected.
    """
    x: list[Number] = [0.0] * len(g)
    free: list[Number] = [1.0] * len(g)
    for k in range(rounds if lower else 1):
        slope = [a + dot(row, x) for a, row in zip(g, H, strict=True)] if k else g
        if lower:
            free = [
                select(at_least(a, y) * at_least(d, 0.0), 0.0, select(at_least(y, b) * at_least(0.0, d), 0.0, 1.0))
                for a, b, y, d in zip(lower, upper, x, slope, strict=True)
            ]
        solved = _among(H, free)
        x = [a - b for a, b in zip(x, solved(slope), strict=True)]
        if lower:
            x = [clip(*of) for of in zip(x, lower, upper, strict=True)]
    if lower:
        # where the last step is not the solution yet, its best share
        slope, bend = dot(x, g), dot(x, [dot(row, x) for row in H])
        share = minimum(1.0, maximum(-slope, 0.0) / maximum(bend, TINY))
        x = [share * y for y in x]
        solved = _among(H, [f * below(a, 0.0) * below(0.0, b) for f, a, b in zip(free, lower, upper, strict=True)])
    return x, solved


def _among(H: Sequence[Row], free: Row) -> Callable[[Row], list[Number]]:
    """Solution of H y = b among the elements that are free, the others being zero."""
    m = len(free)
    own = [[H[i][j] * (free[i] * free[j]) + (1.0 - free[i] if i == j else 0.0) for j in range(m)] for i in range(m)]
    before = ltdl.dense(m)
    factors = ltdl.factorise(before, tuple(map(tuple, own)), lambda k, d: maximum(d, TINY))
    return lambda b: list(ltdl.solve(before, factors, [f * x for f, x in zip(free, b, strict=True)]))


def _less(a: Row, b: Row) -> Row:
    return [x - y for x, y in zip(a, b, strict=True)]


def _gram(A: Matrix, B: Matrix) -> Matrix:
    """Product A^T B, which is symmetric."""
    a, b = transpose(A), transpose(B)
    half = [[dot(x, y) for y in b[: i + 1]] for i, x in enumerate(a)]
    return tuple(tuple([half[max(i, j)][min(i, j)] for j in range(len(half))]) for i in range(len(half)))


def _square(row: Row, size: int) -> Matrix:
    """Square matrix of its numbers, row by row."""
    return tuple([tuple(row[size * i : size * (i + 1)]) for i in range(size)])


def _half(row: Row, size: int) -> Matrix:
    """Symmetric matrix of the numbers of its lower half, row by row."""
    at = lambda i, j: row[max(i, j) * (max(i, j) + 1) // 2 + min(i, j)]  # noqa: E731
    return tuple(tuple([at(i, j) for j in range(size)]) for i in range(size))


# --- the computation -------------------------------------------------------------------------------------------------

Part = Callable[[Any, Sequence[Argument]], Callable[[Rows], Rows]]


class _KnotFields(NamedTuple):
    """Fields of `Knot`."""

    spec: SceneSpec
    objective: Objective
    boxed: bool = False  # whether torques have limits
    part: Part = _knot  # formula of its results


class Knot(_KnotFields, Computation):
    """Knot as a computation of `torchdq.backends.call`."""

    @property
    def step(self) -> Stage:
        """Step whose derivatives are taken."""
        return Stage(self.spec, "step", self.objective)

    @property
    def own(self) -> dict[str, tuple[int, ...]]:
        """Axes of arguments and results that a step has not."""
        s, m = sum(self.spec.displaced.values()), self.step.widths()[self.objective.control]
        found = {"V": (s * (s + 1) // 2,), "v": (s,), "gain": (m, s), "change": (m,), "expected": (2,)}
        found |= {"damping": (1,), "lower": (m,), "upper": (m,)}
        found |= {"H": (m, m), "slope": (m,), "response": (m, m)}
        found |= {COSTATE: (s,), "hessian": (s + m, s + m), "T": (s, s + m)}
        return found | {NEXT + name: (width,) for name, width in self.spec.state.items()}

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument."""
        return self.own[name] if name in self.own else self.step.axes(name)

    def shared(self, name: str) -> bool:
        """True for a parameter of the scene."""
        return self.step.shared(name)

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Trailing axes of the results."""
        return tuple([self.own.get(r.name, (len(r.values),)) for r in program.results])

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program, recorded once."""
        return _program(self, arguments)


@remembered(PROGRAMS)
def _program(what: Knot, arguments: tuple[Argument, ...]) -> Program:
    algorithm, name = what.part(what, arguments), what.part.__name__.strip("_")
    return record(f"{name}_{what.spec.robot.name}", arguments, lambda *rows: algorithm(named_rows(arguments, rows)))
