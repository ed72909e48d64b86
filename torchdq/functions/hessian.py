"""First and second derivatives of torques and of accelerations, as one program."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from operator import add, mul

from torchdq.algebra import matrix
from torchdq.algebra.matrix import Matrix, transpose
from torchdq.algebra.quaternion import Number
from torchdq.functions.recipe import Results
from torchdq.program import autodiff as derive
from torchdq.program.program import GROWTH, Argument, Program, growths, record, replay, results

Row = Sequence[Number]
product = partial(matrix.matmul, times=mul, plus=add)


def with_jacobian(name: str, arguments: Sequence[Argument], torques: Program, accelerations: Program | None) -> Program:
    """Program of the Hessian and the Jacobian of torques in q, qd, qdd, or of accelerations in q, qd and torques.

    The Hessian is contracted with the argument "weight"; without it there is one for each joint. Those of accelerations
    a(y) follow from those H_i of torques tau_i(z), since the torques of the accelerations are linear in y:

        Z^T H_i Z + sum of M_ij d2a_j/dy2 = 0,   y = (q, qd, tau),   z = (q, qd, a(y)),   Z = dz/dy
    """
    second = derive.vjp_jacobian(torques, _positions(torques, "q", "qd", "qdd"))
    inverse = accelerations and derive.jacobian(accelerations, _positions(accelerations, "tau"))

    def algorithm(*rows: Row) -> Results:
        named = {a.name: row for a, row in zip(arguments, rows, strict=True)}
        n = len(named["q"])
        units, growth = _identity(n), list[Number]()
        weights: Matrix = (tuple(named.pop("weight")),) if "weight" in named else units
        mixed = _identity(len(weights))
        if accelerations is not None and inverse is not None:
            solved = replay(accelerations, [named[a.name] for a in accelerations.arguments])
            (named["qdd"],), growth = results(accelerations, solved).values(), growths(accelerations, solved)
            Minv = _rows(_results(inverse, [named[a.name] for a in inverse.arguments])[0], n)
            if weights is units:  # H_i have fewer operations than sums of them
                mixed = Minv
            else:
                weights = product(weights, Minv)
        H, J = list[Matrix](), tuple([()] * n)
        for weight in weights:
            blocks = _results(second, [named.get(a.name, weight) for a in second.arguments])
            found, J = _of_torques(blocks, n)
            H.append(found)
        if inverse is not None:
            pairs = zip(product(Minv, J), Minv, strict=True)
            J = tuple([(*[-x for x in row[: 2 * n]], *last) for row, last in pairs])
            Z = (*_identity(3 * n)[: 2 * n], *J)
            H = [product(transpose(Z), product(x, Z)) for x in H]
            mixed = tuple([tuple([-x for x in row]) for row in mixed])
        flat = tuple([tuple([x[max(i, j)][min(i, j)] for i in range(3 * n) for j in range(3 * n)]) for x in H])
        slopes = "dtau/dz" if accelerations is None else "dqdd/dz"
        return {"H": sum(product(mixed, flat), ()), slopes: sum(J, ()), GROWTH: growth}

    return record(name, arguments, algorithm)


def _positions(program: Program, *names: str) -> list[int]:
    return [k for k, a in enumerate(program.arguments) if a.name in names]


def _results(program: Program, rows: Sequence[Row]) -> list[Row]:
    return list(results(program, replay(program, rows)).values())


def _of_torques(blocks: Sequence[Row], n: int) -> tuple[Matrix, Matrix]:
    """Hessian [3n, 3n] and Jacobian [n, 3n] from the blocks of `vjp_jacobian`, column by column."""
    found = [_rows(block, n) for block in blocks]
    H = [sum([found[3 * k + i][a] for k in range(3)], ()) for i in range(3) for a in range(n)]
    return tuple(H), transpose(sum(found[9:], ()))


def _rows(flat: Row, n: int) -> Matrix:
    return tuple([tuple(flat[k : k + n]) for k in range(0, len(flat), max(n, 1))])


def _identity(n: int) -> Matrix:
    return tuple([tuple([float(i == k) for i in range(n)]) for k in range(n)])
