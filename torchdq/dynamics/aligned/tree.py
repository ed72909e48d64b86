"""A mechanism whose every joint axis is the z axis of its link's frame: the form in which programs are recorded.

A link frame hangs on its parent's by three turns in a plane and a shift,

    R_PB = R_z(gamma) R_x(alpha) R_z(q + offset),   p_PB constant,

with gamma = 0 for one child of every link (the modified Denavit-Hartenberg placement), so that a change of axes costs
two planar turns, 8 multiplications, where a rotation matrix costs 9 after it has been built.

A body is its mass distribution about the frame's origin: m, h = sum of r dm, second moments E = sum of r r^T dm. Every
particle r of it accelerates by d + U r, d being the origin's acceleration and U = [wd] + [w]^2, from which the net
force and moment follow without the twist's linear part:

    f = m d + U h,   n = h x d + vect(U E)
"""

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Columns
from torchdq.dynamics.tree import BASE

Turn = tuple[Number, Number]  # cosine and sine of an angle
Second = tuple[Number, ...]  # xx xy yy xz yz zz


class Body(NamedTuple):
    """Mass [kg], first moments [kg m] and second moments [kg m^2] about the frame's origin."""

    mass: Number
    first: Pure
    second: Second


class AlignedLink(NamedTuple):
    """A link whose joint axis is the z axis of its frame."""

    parent: int
    kind: str
    pitch: Number  # [m/rad] of a helical joint
    gamma: Turn
    alpha: Turn
    p: Pure  # of the link frame's origin in the parent frame, at q = 0 [m]
    body: Body
    armature: Number | None


class Aligned(NamedTuple):
    """A tree of such links; every parent comes before its children."""

    links: tuple[AlignedLink, ...]
    gravity: Pure | None  # in the base frame [m/s^2]


class Step(NamedTuple):
    """How a link hangs on its parent in the present position."""

    theta: Turn
    p: Pure


NO_TURN: Turn = (1.0, 0.0)


def turn_z(t: Turn, v: Pure) -> Pure:
    """R_z v."""
    (c, s), (x, y, z) = t, v
    return (c * x - s * y, s * x + c * y, z)


def turn_x(t: Turn, v: Pure) -> Pure:
    """R_x v."""
    (c, s), (x, y, z) = t, v
    return (x, c * y - s * z, s * y + c * z)


def back(t: Turn) -> Turn:
    """The opposite turn."""
    return (t[0], -t[1])


def to_parent(link: AlignedLink, step: Step, v: Pure) -> Pure:
    """Components in the parent's axes of a vector given in the link's."""
    return turn_z(link.gamma, turn_x(link.alpha, turn_z(step.theta, v)))


def to_link(link: AlignedLink, step: Step, v: Pure) -> Pure:
    """Components in the link's axes of a vector given in the parent's."""
    return turn_z(back(step.theta), turn_x(back(link.alpha), turn_z(back(link.gamma), v)))


def steps(links: Sequence[AlignedLink], q: Sequence[Number], turns: Sequence[Turn]) -> tuple[Step, ...]:
    """Step of every link, from the joint positions and the cosines and sines of q + offset."""
    result = []
    for link, q_i, turn in zip(links, q, turns, strict=True):
        if link.kind == "revolute":
            result.append(Step(turn, link.p))
            continue
        slide = q_i if link.kind == "prismatic" else link.pitch * q_i
        axis = turn_z(link.gamma, turn_x(link.alpha, (0.0, 0.0, 1.0)))
        result.append(Step(turn, quat.add(link.p, quat.scale(slide, axis))))
    return tuple(result)


def turn_second_z(t: Turn, e: Second) -> Second:
    """R_z E R_z^T."""
    (c, s), (xx, xy, yy, xz, yz, zz) = t, e
    a, b = c * xx - s * xy, c * xy - s * yy
    top = c * a - s * b
    return (top, s * a + c * b, (xx + yy) - top, c * xz - s * yz, s * xz + c * yz, zz)


def turn_second_x(t: Turn, e: Second) -> Second:
    """R_x E R_x^T."""
    xx, xy, yy, xz, yz, zz = e
    yy, yz, zz, xy, xz, xx = turn_second_z(t, (yy, yz, zz, xy, xz, xx))
    return (xx, xy, yy, xz, yz, zz)


def carried(link: AlignedLink, step: Step, body: Body) -> Body:
    """A body of the link, in the parent's frame."""
    m, h, e = body
    h = to_parent(link, step, h)
    e = turn_second_z(link.gamma, turn_second_x(link.alpha, turn_second_z(step.theta, e)))
    return shifted(step.p, Body(m, h, e))


def shifted(p: Pure, body: Body) -> Body:
    """A body given about the point p, about the origin of the same axes."""
    m, h, (xx, xy, yy, xz, yz, zz) = body
    f = quat.add(h, quat.scale(m, p))  # E + h p^T + p h^T + m p p^T = E + f p^T + p h^T
    return Body(
        m,
        f,
        (
            xx + (f[0] * p[0] + p[0] * h[0]),
            xy + (f[0] * p[1] + p[0] * h[1]),
            yy + (f[1] * p[1] + p[1] * h[1]),
            xz + (f[0] * p[2] + p[0] * h[2]),
            yz + (f[1] * p[2] + p[1] * h[2]),
            zz + (f[2] * p[2] + p[2] * h[2]),
        ),
    )


def joined(a: Body, b: Body) -> Body:
    """Two bodies of one frame as one."""
    return Body(a.mass + b.mass, quat.add(a.first, b.first), quat.add(a.second, b.second))


def grouped(aligned: Aligned) -> Aligned:
    """The same mechanism with fewer inertial parameters: what lies on a revolute joint's axis moves with the parent.

    Mass, first and second moment along the axis of link i are those of particles on it, which the joint does not move:
    they are taken from link i and given to its parent (to nothing, on the base). No torque or acceleration changes.
    """
    bodies = [link.body for link in aligned.links]
    for i in reversed(range(len(bodies))):
        link, (m, (hx, hy, hz), (xx, xy, yy, xz, yz, zz)) = aligned.links[i], bodies[i]
        if link.kind != "revolute":
            continue
        bodies[i] = Body(0.0, (hx, hy, 0.0), (xx, xy, yy, xz, yz, 0.0))
        if link.parent != BASE:
            on_axis = Body(m, (0.0, 0.0, hz), (0.0, 0.0, 0.0, 0.0, 0.0, zz))
            moved = carried(link, Step(NO_TURN, link.p), on_axis)
            bodies[link.parent] = joined(bodies[link.parent], moved)
    links = tuple(link._replace(body=body) for link, body in zip(aligned.links, bodies, strict=True))
    return aligned._replace(links=links)


def second_moments(com: Pure, mass: Number, inertia: Columns) -> Second:
    """Second moments about the frame's origin, from the rotational inertia about the centre of mass."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia
    half = 0.5 * (xx + yy + zz)
    x, y, z = com
    return (
        (half - xx) + mass * (x * x),
        mass * (x * y) - xy,
        (half - yy) + mass * (y * y),
        mass * (x * z) - xz,
        mass * (y * z) - yz,
        (half - zz) + mass * (z * z),
    )
