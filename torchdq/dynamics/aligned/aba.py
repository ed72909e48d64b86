"""Solution of M x = b in time linear in the number of joints, by articulated bodies.

The mass matrix is not formed. The articulated-body inertia of a link, whose joints beyond it are free to move, gives
the wrench of an acceleration (wd, d) of its frame,

    n = A wd + B d,   f = B^T wd + C d

and is accumulated from the leaves to the base (Featherstone 1983). A joint with several degrees of freedom is
eliminated one degree at a time. If b are the torques less the inverse dynamics at qdd = 0, x are the accelerations.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.elementary import Angle, X, Z, turn, unit
from torchdq.algebra.inertia import Moments, Six, square, turn_symmetric
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.algebra.structural import add
from torchdq.dynamics.aligned.placement import Step, Steps
from torchdq.dynamics.error_growth import inverse
from torchdq.dynamics.tree import WORLD, Tree, freedoms

Matrix3 = tuple[Pure, ...]  # three rows


class Articulated(NamedTuple):
    """Blocks of an articulated-body inertia: A and C symmetric (xx xy yy xz yz zz), B by rows."""

    A: Six
    B: Matrix3
    C: Six

    @classmethod
    def rigid(cls, body: Moments) -> Articulated:
        """Inertia of one rigid body."""
        m, (x, y, z), (xx, xy, yy, xz, yz, zz) = body
        return cls(
            (yy + zz, -xy, xx + zz, -xz, -yz, xx + yy),
            ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)),
            (m, 0.0, m, 0.0, 0.0, m),
        )

    def plus(self, other: Articulated) -> Articulated:
        """Sum of two inertias in the same frame."""
        B = tuple(quat.add(x, y) for x, y in zip(self.B, other.B, strict=True))
        return Articulated(quat.add(self.A, other.A), B, quat.add(self.C, other.C))

    def response(self, a: Screw) -> Screw:
        """Wrench (f, n) of the acceleration a."""
        wd, d = a
        n = tuple(quat.dot(r, wd) + quat.dot(b, d) for r, b in zip(square(self.A), self.B, strict=True))
        columns = zip(*self.B, strict=True)
        f = tuple(quat.dot(b, wd) + quat.dot(r, d) for r, b in zip(square(self.C), columns, strict=True))
        return f, n

    def freed(self, a: Screw, wrench: Screw, r: Number, rotor: bool) -> Articulated:
        """Inertia on the parent's side of a joint, after elimination of a degree of freedom: I - U U^T / D.

        Args:
            a: screw of the degree of freedom.
            wrench: U = I a, the response to it.
            r: inverse of the pivot D = a . U, rotor included.
            rotor: whether there is a rotor; without one, no force along a is transmitted.
        """
        f, n = wrench
        rn, rf = quat.scale(r, n), quat.scale(r, f)

        B = [list(quat.sub(row, quat.scale(rn_i, f))) for row, rn_i in zip(self.B, rn, strict=True)]
        A, C = list(_with_product(self.A, quat.neg(rn), n)), list(_with_product(self.C, quat.neg(rf), f))
        k = None if rotor else _axis(a)
        if k is not None:
            # zero in exact arithmetic
            for j in _ROWS[k % 3]:
                (A if k < 3 else C)[j] = 0.0
            for j in range(3):
                row, column = (k, j) if k < 3 else (j, k - 3)
                B[row][column] = 0.0
        return Articulated(tuple(A), tuple(map(tuple, B)), tuple(C))

    def with_outer(self, e: Number, s: Screw) -> Articulated:
        """Inertia I + e s s^T of a mass e that moves along one line, with the wrench s of a unit force on it."""
        n, m = s
        en, em = quat.scale(e, n), quat.scale(e, m)
        B = tuple(quat.add(row, quat.scale(x, n)) for row, x in zip(self.B, em, strict=True))
        return Articulated(_with_product(self.A, em, m), B, _with_product(self.C, en, n))

    def turned(self, axis: int, angle: Angle) -> Articulated:
        """Inertia in a frame in which the present frame is rotated about an axis."""
        half = tuple(turn(axis, angle, row) for row in self.B)  # B R^T
        columns = (turn(axis, angle, column) for column in zip(*half, strict=True))
        B = tuple(zip(*columns, strict=True))  # R B R^T
        return Articulated(turn_symmetric(axis, angle, self.A), B, turn_symmetric(axis, angle, self.C))

    def shifted(self, p: Pure) -> Articulated:
        """Inertia about another origin, from which the present origin is at p, in the same axes."""
        # B' = B + [p] C, A' = A - B [p] + [p] B'^T
        pC = zip(*(quat.cross(p, c) for c in square(self.C)), strict=True)
        B = tuple(quat.add(b, c) for b, c in zip(self.B, pC, strict=True))
        Bp = tuple(quat.cross(row, p) for row in self.B)  # rows of B [p]
        pB = zip(*(quat.cross(p, row) for row in B), strict=True)  # rows of [p] B'^T
        d = tuple(quat.sub(b, a) for a, b in zip(Bp, pB, strict=True))
        return Articulated(quat.add(self.A, (d[0][0], d[0][1], d[1][1], d[0][2], d[1][2], d[2][2])), B, self.C)

    def to_parent(self, step: Step) -> Articulated:
        """Inertia in the parent's frame of a body of the link."""
        at = step.placement
        body = self.turned(Z, step.theta.turn).shifted(unit(Z, step.theta.shift))
        return body.turned(X, at.alpha).turned(Z, at.gamma).shifted(at.p)


_ROWS = ((0, 1, 3), (1, 2, 4), (3, 4, 5))  # positions of the entries of each row among the six numbers
_ENTRIES = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))


def _with_product(s: Six, u: Pure, v: Pure) -> Six:
    """Symmetric matrix S + u v^T of parallel vectors."""
    return tuple(e + u[i] * v[j] for e, (i, j) in zip(s, _ENTRIES, strict=True))


def _axis(a: Screw) -> int | None:
    """Position of the only component of a unit screw that is not zero; None if there are several."""
    present = [(k, x) for k, x in enumerate((*a[0], *a[1])) if not (isinstance(x, float) and x == 0)]
    return present[0][0] if len(present) == 1 and present[0][1] == 1 else None


class BodyFactors(NamedTuple):
    """Factors of the mass matrix by articulated bodies, for every degree of freedom."""

    responses: tuple[Screw, ...]  # U = I a
    inverses: tuple[Number, ...]  # inverse pivots


def factorise(tree: Tree, steps: Steps, outer: Iterable[tuple[int, Number, Screw]] = ()) -> BodyFactors:
    """Factors of the mass matrix, by articulated bodies from the leaves to the base.

    Args:
        tree, steps: bodies, and poses of the links in their parents.
        outer: links with a mass e that moves along one line only, with the wrench s of a unit force on it (i, e, s).
    """
    inertia = [None if link.inertia is None else Articulated.rigid(link.inertia) for link in tree.links]
    for i, e, s in outer:
        inertia[i] = inertia[i].with_outer(e, s)  # type: ignore[union-attr]  # it has a body, see `PointMass`
    responses: list[Screw] = [((), ())] * tree.nv
    inverses: list[Number] = [0.0] * tree.nv
    for i in reversed(range(len(tree.links))):
        link, step, body = tree.links[i], steps[i], inertia[i]
        if body is None:
            continue
        for k, a in reversed(freedoms(link)):
            responses[k] = body.response(a)
            own = screw.power(responses[k], a)
            inverses[k] = inverse(k, own if link.armature is None else own + link.armature)
            body = body.freed(a, responses[k], inverses[k], link.armature is not None)
        # a fixed base needs no inertia
        if step is not None and (link.parent or tree.links[0].joint.nv):
            behind, below = body.to_parent(step), inertia[link.parent]
            inertia[link.parent] = behind if below is None else below.plus(behind)
    return BodyFactors(tuple(responses), tuple(inverses))


def solve(tree: Tree, steps: Steps, factors: BodyFactors, b: Sequence[Number]) -> tuple[Number, ...]:
    """Solution x of M(q) x = b."""
    bias: list[Screw | None] = [None] * len(tree.links)  # bias force of the articulated body: wrench at A = 0
    net = list(b)
    for i in reversed(range(len(tree.links))):
        link, step, F = tree.links[i], steps[i], bias[i]
        for k, a in reversed(freedoms(link)):
            if F is not None:
                net[k] = net[k] - screw.power(F, a)
            F = add(F, screw.scale(factors.inverses[k] * net[k], factors.responses[k]))
        if step is not None and F is not None and (link.parent or tree.links[0].joint.nv):
            bias[link.parent] = add(bias[link.parent], step.to_parent(F))
    x: list[Number] = [0.0] * tree.nv
    motion: list[Screw | None] = [None] * len(tree.links)  # acceleration (wd, d)
    for i, (link, step) in enumerate(zip(tree.links, steps, strict=True)):
        below = None if link.parent == WORLD else motion[link.parent]
        A = None if below is None or step is None else step.to_link(below)
        for k, a in freedoms(link):
            r = factors.inverses[k]
            x[k] = r * net[k] if A is None else r * (net[k] - screw.power(factors.responses[k], A))
            A = add(A, screw.scale(x[k], a))
        motion[i] = A
    return tuple(x)
