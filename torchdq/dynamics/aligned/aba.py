"""Solving M x = b in time linear in the number of joints, by articulated bodies.

The mass matrix is never formed. Each link, with everything beyond it free to move under its own inertia, answers an
acceleration (wd, d) of its frame by the wrench

    n = A wd + B d,   f = B^T wd + C d

whose blocks are carried from the leaves to the base (Featherstone 1983). With b the torques less the inverse dynamics
at qdd = 0, x are the joint accelerations.
"""

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number, Pure
from torchdq.dynamics.aligned.tree import (
    Aligned,
    AlignedLink,
    Body,
    Second,
    Step,
    Turn,
    to_link,
    to_parent,
    turn_second_x,
    turn_second_z,
    turn_x,
    turn_z,
)
from torchdq.dynamics.conditioning import inverse
from torchdq.dynamics.tree import BASE

Matrix = tuple[Pure, ...]  # three rows


class Articulated(NamedTuple):
    """Blocks of an articulated body's inertia: A and C symmetric (xx xy yy xz yz zz), B by rows."""

    A: Second
    B: Matrix
    C: Second


def rigid(body: Body) -> Articulated:
    """Inertia of a single body."""
    m, (x, y, z), (xx, xy, yy, xz, yz, zz) = body
    return Articulated(
        (yy + zz, -xy, xx + zz, -xz, -yz, xx + yy),
        ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)),
        (m, 0.0, m, 0.0, 0.0, m),
    )


def joined(a: Articulated, b: Articulated) -> Articulated:
    """Two inertias of one frame as one."""
    B = tuple(quat.add(x, y) for x, y in zip(a.B, b.B, strict=True))
    return Articulated(quat.add(a.A, b.A), B, quat.add(a.C, b.C))


def response(link: AlignedLink, inertia: Articulated) -> tuple[Pure, Pure]:
    """Wrench (n, f) that answers a unit acceleration of the link's joint."""
    A, B, C = inertia
    spin: tuple[Pure, Pure] = ((A[3], A[4], A[5]), B[2])
    slide: tuple[Pure, Pure] = ((B[0][2], B[1][2], B[2][2]), (C[3], C[4], C[5]))
    if link.kind == "revolute":
        return spin
    if link.kind == "prismatic":
        return slide
    return tuple(quat.add(a, quat.scale(link.pitch, b)) for a, b in zip(spin, slide, strict=True))


def felt(link: AlignedLink, n: Pure, f: Pure) -> Number:
    """Part of a wrench that the link's joint feels."""
    if link.kind == "revolute":
        return n[2]
    return f[2] if link.kind == "prismatic" else n[2] + link.pitch * f[2]


def freed(link: AlignedLink, inertia: Articulated, n: Pure, f: Pure, r: Number) -> Articulated:
    """Inertia behind a joint that is free to move: less the response squared over its own part, r being its inverse."""
    A, B, C = inertia
    rn, rf = quat.scale(r, n), quat.scale(r, f)

    def less(s: Second, v: Pure, rv: Pure) -> Second:
        xx, xy, yy, xz, yz, zz = s
        return (
            xx - rv[0] * v[0],
            xy - rv[0] * v[1],
            yy - rv[1] * v[1],
            xz - rv[0] * v[2],
            yz - rv[1] * v[2],
            zz - rv[2] * v[2],
        )

    A, C = less(A, n, rn), less(C, f, rf)
    B = tuple(quat.sub(row, quat.scale(rn_i, f)) for row, rn_i in zip(B, rn, strict=True))
    if link.armature is None and link.kind == "revolute":
        # a free joint transmits nothing along itself: what rounding left there is zero
        return Articulated((A[0], A[1], A[2], 0.0, 0.0, 0.0), (B[0], B[1], (0.0, 0.0, 0.0)), C)
    if link.armature is None and link.kind == "prismatic":
        return Articulated(A, tuple((x, y, 0.0) for x, y, _ in B), (C[0], C[1], C[2], 0.0, 0.0, 0.0))
    return Articulated(A, B, C)


def carried(link: AlignedLink, step: Step, inertia: Articulated) -> Articulated:
    """A link's inertia in its parent's frame."""
    A, B, C = inertia
    turns: tuple[tuple[Turn, bool], ...] = ((step.theta, True), (link.alpha, False), (link.gamma, True))
    for turn, about_z in turns:
        symmetric, vector = (turn_second_z, turn_z) if about_z else (turn_second_x, turn_x)
        A, C = symmetric(turn, A), symmetric(turn, C)
        half = tuple(vector(turn, row) for row in B)  # B R^T
        B = tuple(zip(*(vector(turn, column) for column in zip(*half, strict=True)), strict=True))  # R B R^T
    p = step.p
    xx, xy, yy, xz, yz, zz = C
    # B' = B + [p] C, A' = A - B [p] + [p] B'^T
    pC = tuple(zip(*(quat.cross(p, c) for c in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))), strict=True))
    shifted = tuple(quat.add(b, c) for b, c in zip(B, pC, strict=True))
    Bp = tuple(quat.cross(row, p) for row in B)  # rows of B [p]
    pB = tuple(zip(*(quat.cross(p, row) for row in shifted), strict=True))  # rows of [p] B'^T
    d = tuple(quat.sub(b, a) for a, b in zip(Bp, pB, strict=True))
    A = quat.add(A, (d[0][0], d[0][1], d[1][1], d[0][2], d[1][2], d[2][2]))
    return Articulated(A, shifted, C)


class Factors(NamedTuple):
    """What a solution takes of the robot's position: each joint's response, and the inverse of its own part of it."""

    responses: tuple[tuple[Pure, Pure], ...]
    inverses: tuple[Number, ...]


def factorise(aligned: Aligned, steps: Sequence[Step]) -> Factors:
    """Articulated bodies, from the leaves to the base."""
    links = aligned.links
    inertia = [rigid(link.body) for link in links]
    responses: list[tuple[Pure, Pure]] = [((), ())] * len(links)
    inverses: list[Number] = [0.0] * len(links)
    for i in reversed(range(len(links))):
        link = links[i]
        n, f = response(link, inertia[i])
        own = felt(link, n, f)
        responses[i] = (n, f)
        inverses[i] = inverse(i, own if link.armature is None else own + link.armature)
        if link.parent != BASE:
            behind = carried(link, steps[i], freed(link, inertia[i], n, f, inverses[i]))
            inertia[link.parent] = joined(inertia[link.parent], behind)
    return Factors(tuple(responses), tuple(inverses))


def solve(aligned: Aligned, steps: Sequence[Step], factors: Factors, b: Sequence[Number]) -> tuple[Number, ...]:
    """Solution x of M(q) x = b."""
    links = aligned.links
    bias: list = [None] * len(links)  # wrench (n, f) that b drives against a still parent
    net = list(b)
    for i in reversed(range(len(links))):
        link, step, (n, f), r = links[i], steps[i], factors.responses[i], factors.inverses[i]
        if bias[i] is not None:
            net[i] = net[i] - felt(link, *bias[i])
        if link.parent == BASE:
            continue
        driven = (quat.scale(r * net[i], n), quat.scale(r * net[i], f))
        if bias[i] is not None:
            driven = (quat.add(bias[i][0], driven[0]), quat.add(bias[i][1], driven[1]))
        force = to_parent(link, step, driven[1])
        moment = quat.add(to_parent(link, step, driven[0]), quat.cross(step.p, force))
        before = bias[link.parent]
        bias[link.parent] = (
            (moment, force) if before is None else (quat.add(before[0], moment), quat.add(before[1], force))
        )
    x: list[Number] = [0.0] * len(links)
    motion: list[tuple[Pure, Pure]] = []
    zero: Pure = (0.0, 0.0, 0.0)
    for i, (link, step) in enumerate(zip(links, steps, strict=True)):
        wd_P, d_P = (zero, zero) if link.parent == BASE else motion[link.parent]
        wd = to_link(link, step, wd_P)
        d = to_link(link, step, quat.add(d_P, quat.cross(wd_P, step.p)))
        n, f = factors.responses[i]
        x[i] = (net[i] - (quat.dot(n, wd) + quat.dot(f, d))) * factors.inverses[i]
        if link.kind != "prismatic":
            wd = (wd[0], wd[1], wd[2] + x[i])
        if link.kind != "revolute":
            d = (d[0], d[1], d[2] + (x[i] if link.kind == "prismatic" else link.pitch * x[i]))
        motion.append((wd, d))
    return tuple(x)
