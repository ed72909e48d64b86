"""Forward kinematics and inverse dynamics by homogeneous matrices, as textbooks write them.

Kinematics by Denavit-Hartenberg parameters and by products of exponentials; the recursive Newton-Euler algorithm of
K. M. Lynch and F. C. Park, Modern Robotics, 2017, chapter 8.3, with 6x6 adjoints. Twists and wrenches have their order:
(angular, linear) and (moment, force). The zeros and ones of matrices are arguments: counted numbers in their place
count every product of full matrices.
"""

import operator
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.dynamics.tree import Tree

Row = Sequence[Number]
RowMatrix = Sequence[Row]


class Units(NamedTuple):
    """Numbers for zeros and ones."""

    zero: Number = 0.0
    one: Number = 1.0


KNOWN = Units()


class Displacement(NamedTuple):
    """Displacement of a joint, with the terms of its exponential: sine, 1 - cosine and angle less sine."""

    value: Number
    sin: Number
    versine: Number
    rest: Number


# --- matrices --------------------------------------------------------------------------------------------------------


def dot(a: Row, b: Row) -> Number:
    """Sum of products."""
    return reduce(operator.add, (x * y for x, y in zip(a, b, strict=True)))


def times(m: RowMatrix, x: Row) -> list[Number]:
    """Matrix times vector."""
    return [dot(row, x) for row in m]


def transpose(m: RowMatrix) -> list[list[Number]]:
    """Rows for columns."""
    return [list(column) for column in zip(*m, strict=True)]


def product(a: RowMatrix, b: RowMatrix) -> list[list[Number]]:
    """Matrix times matrix."""
    columns = transpose(b)
    return [[dot(row, column) for column in columns] for row in a]


def bracket(x: Row, u: Units = KNOWN) -> list[list[Number]]:
    """Matrix [x] of the cross product."""
    return [[u.zero, -x[2], x[1]], [x[2], u.zero, -x[0]], [-x[1], x[0], u.zero]]


# --- poses -----------------------------------------------------------------------------------------------------------


def matrix(x: DualQuaternion) -> list[list[Number]]:
    """Homogeneous matrix of a pose."""
    return [*transpose([*quat.rotation_columns(x[0]), dq.translation(x)]), [0.0, 0.0, 0.0, 1.0]]


class Generator(NamedTuple):
    """Constant screw of a joint, with the terms of its exponential."""

    revolute: bool  # or helical: whether it turns
    screw: Row  # (w, v)
    W: RowMatrix  # [w]
    W2: RowMatrix  # [w]^2
    Wv: Row
    W2v: Row


def generator(axis: Screw) -> Generator:
    """Constants of a unit screw, or of a unit translation."""
    w, v = axis
    W = bracket(w)
    W2 = product(W, W)
    return Generator(any(x != 0 for x in w), (*w, *v), W, W2, times(W, v), times(W2, v))


def exponential(s: Generator, q: Displacement, u: Units = KNOWN) -> list[list[Number]]:
    """exp([S] q), Rodrigues' formula (Modern Robotics 3.51, 3.88)."""
    v = s.screw[3:]
    eye = [[u.one if i == j else u.zero for j in range(3)] for i in range(3)]
    if s.revolute:
        R = [[eye[i][j] + q.sin * s.W[i][j] + q.versine * s.W2[i][j] for j in range(3)] for i in range(3)]
        p = [q.value * a + q.versine * b + q.rest * c for a, b, c in zip(v, s.Wv, s.W2v, strict=True)]
    else:
        R, p = eye, quat.scale(q.value, v)
    return [[*row, p_i] for row, p_i in zip(R, p, strict=True)] + [[u.zero, u.zero, u.zero, u.one]]


def denavit_hartenberg(
    cos: Number, sin: Number, alpha: tuple[Number, Number], a: Number, d: Number
) -> list[list[Number]]:
    """Standard transform of a joint, Rot_z(theta) Trans_z(d) Trans_x(a) Rot_x(alpha), alpha as cosine and sine."""
    ca, sa = alpha
    return [
        [cos, -(sin * ca), sin * sa, a * cos],
        [sin, cos * ca, -(cos * sa), a * sin],
        [0.0, sa, ca, d],
        [0.0, 0.0, 0.0, 1.0],
    ]


# --- dynamics --------------------------------------------------------------------------------------------------------


def adjoint(T: RowMatrix, u: Units = KNOWN) -> list[list[Number]]:
    """6x6 adjoint of a pose: [R 0; [p] R  R]."""
    R, p = [row[:3] for row in T[:3]], [row[3] for row in T[:3]]
    zero = [u.zero] * 3
    pR = product(bracket(p, u), R)
    return [[*R[i], *zero] for i in range(3)] + [[*pR[i], *R[i]] for i in range(3)]


def bracket6(V: Row, u: Units = KNOWN) -> list[list[Number]]:
    """6x6 matrix [ad_V] = [[w] 0; [v] [w]]."""
    w, v = bracket(V[:3], u), bracket(V[3:], u)
    return [[*w[i], *[u.zero] * 3] for i in range(3)] + [[*v[i], *w[i]] for i in range(3)]


def inertia(mass: Number, first: Pure | None, second: RowMatrix) -> list[list[Number]]:
    """6x6 inertia [I  [h]; -[h]  m 1]; h = 0 about the centre of mass."""
    h = bracket(first or (0.0,) * 3)
    eye = [[mass if i == j else 0.0 for j in range(3)] for i in range(3)]
    return [[*second[i], *h[i]] for i in range(3)] + [[*(-x for x in h[i]), *eye[i]] for i in range(3)]


class Body(NamedTuple):
    """Constants of a link and its joint."""

    home: RowMatrix  # M_{i,i-1}
    joint: Generator
    G: RowMatrix  # 6x6 inertia


def bodies(tree: Tree) -> tuple[Body, ...]:
    """Constants of a chain."""
    return tuple(
        Body(matrix(dq.conj(link.placement)), generator(link.joint.screw), inertia(*link.inertia))
        for link in tree.links[1:]
    )


def rnea(
    chain: Sequence[Body],
    gravity: Row,
    q: Sequence[Displacement],
    qd: Row,
    qdd: Row,
    tip: RowMatrix | None = None,
    f_tip: Row | None = None,
    u: Units = KNOWN,
) -> list[Number]:
    """Joint torques of a chain.

    Args:
        gravity: acceleration in the base frame.
        q: terms of the exponentials of minus the displacements, which make the inverse poses.
        tip: pose of the last link in the end effector's frame.
        f_tip: wrench (moment, force) the end effector exerts on the environment.
    """
    z = u.zero
    V: Row = [z] * 6
    Vd: Row = [z, z, z, *(-g for g in gravity)]
    kept = []
    for body, q_i, qd_i, qdd_i in zip(chain, q, qd, qdd, strict=True):
        A = body.joint.screw
        Ad = adjoint(product(exponential(body.joint, q_i, u), body.home), u)  # T_{i,i-1} = exp(-[A] q) M_{i,i-1}
        V = quat.add(times(Ad, V), quat.scale(qd_i, A))  # (8.50)
        ad = bracket6(V, u)
        Vd = quat.add(quat.add(times(Ad, Vd), quat.scale(qd_i, times(ad, A))), quat.scale(qdd_i, A))  # (8.51)
        kept.append((Ad, ad, V, Vd))
    F = None if f_tip is None or tip is None else times(transpose(adjoint(tip, u)), f_tip)
    tau: list[Number] = [z] * len(kept)
    for i in reversed(range(len(kept))):
        Ad, ad, V, Vd = kept[i]
        G = chain[i].G
        net = times(G, Vd) if F is None else quat.add(F, times(G, Vd))
        F = quat.sub(net, times(transpose(ad), times(G, V)))  # (8.52)
        tau[i] = dot(F, chain[i].joint.screw)  # (8.53)
        F = times(transpose(Ad), F) if i else F
    return tau
