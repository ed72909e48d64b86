"""Inertia of rigid bodies, in two equivalent forms.

    Inertia   mass, first moments, rotational inertia I = sum of dm (r.r 1 - r r^T)   as in (30) of the paper
    Moments   mass, first moments, second moments E = sum of dm r r^T                 cheaper to rotate and to shift

Both are about the origin of the frame in which they are given, and I = tr(E) 1 - E.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion, screw
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.elementary import Angle, turn
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Adjoint, Columns, Screw

Symmetric = tuple[Pure, ...]  # three rows, which are also the columns, of a symmetric 3x3 matrix
Six = tuple[Number, ...]  # xx xy yy xz yz zz of a symmetric 3x3 matrix


def square(six: Six) -> Symmetric:
    """Rows of a symmetric matrix."""
    xx, xy, yy, xz, yz, zz = six
    return ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


def six(rows: Symmetric) -> Six:
    """Numbers xx xy yy xz yz zz of a symmetric matrix."""
    return (rows[0][0], rows[0][1], rows[1][1], rows[0][2], rows[1][2], rows[2][2])


def rotated(R: Columns, m: Symmetric) -> Symmetric:
    """Matrix R M R^T of a symmetric matrix M."""
    half = tuple(screw.columns_times(R, row) for row in m)  # rows of M R^T
    a, b, c = (screw.columns_times(R, column) for column in zip(*half, strict=True))
    return (a, b, c)


class Inertia(NamedTuple):
    """Inertia of a body about the origin of the frame."""

    mass: Number  # [kg]
    first: Pure | None  # m c [kg m]; None: the origin is the centre of mass
    rotational: Symmetric  # [kg m^2]

    @classmethod
    def from_com(cls, mass: Number, com: Pure, about_com: Six) -> Inertia:
        """Inertia from the centre of mass [m] and the rotational inertia about it, by the parallel axis theorem."""
        x, y, z = com
        xx, yy, zz = mass * (x * x), mass * (y * y), mass * (z * z)
        xy, xz, yz = mass * (x * y), mass * (x * z), mass * (y * z)
        shift = ((yy + zz, -xy, -xz), (-xy, xx + zz, -yz), (-xz, -yz, xx + yy))
        a, b, c = (quat.add(i, d) for i, d in zip(square(about_com), shift, strict=True))
        return cls(mass, quat.scale(mass, com), (a, b, c))

    def momentum(self, V: Screw) -> Screw:
        """Momentum G(V) of the body with twist V, or G(A) for an acceleration A.

        G(w + eps v) = (m v - h x w) + eps (I_x w_x + I_y w_y + I_z w_z + h x v)
        """
        w, v = V
        i_x, i_y, i_z = self.rotational
        force = quat.scale(self.mass, v)
        moment = quat.add(quat.add(quat.scale(w[0], i_x), quat.scale(w[1], i_y)), quat.scale(w[2], i_z))
        if self.first is None:
            return (force, moment)  # (30), erratum 30
        return (quat.sub(force, quat.cross(self.first, w)), quat.add(moment, quat.cross(self.first, v)))

    @property
    def about_com(self) -> Symmetric:
        """Rotational inertia about the centre of mass, of a body that has mass: I + h x (c x)."""
        if self.first is None:
            return self.rotational
        h, c = self.first, quat.scale(1.0 / self.mass, self.first)
        shifts = [quat.cross(h, quat.cross(c, e)) for e in quat.UNITS]
        a, b, d = (quat.add(row, shift) for row, shift in zip(self.rotational, shifts, strict=True))
        return (a, b, d)

    def carried(self, a: Adjoint, p: Pure) -> Inertia:
        """Inertia in frame A of a body given in frame B, where the pose X_AB has the columns a and the position p."""
        rotation = rotated(a[0], self.rotational)
        c = quat.ZERO if self.first is None else screw.columns_times(a[0], self.first)
        h = quat.add(c, quat.scale(self.mass, p))
        # parallel axis theorem: I - ([p][h] + [c][p]), written so that the result is exactly symmetric
        trace = quat.dot(p, quat.add(c, h))
        rows = [list(row) for row in rotation]
        for i in range(3):
            for j in range(i, 3):
                shift = -(p[i] * h[j] + c[i] * p[j])
                rows[i][j] = rows[j][i] = rotation[i][j] + (shift + trace if i == j else shift)
        x, y, z = map(tuple, rows)
        return Inertia(self.mass, h, (x, y, z))

    def plus(self, other: Inertia) -> Inertia:
        """Inertia of two bodies together, both given in the same frame."""
        first = other.first if self.first is None else self.first
        if self.first is not None and other.first is not None:
            first = quat.add(self.first, other.first)
        a, b, c = (quat.add(x, y) for x, y in zip(self.rotational, other.rotational, strict=True))
        return Inertia(self.mass + other.mass, first, (a, b, c))


class RigidBody(NamedTuple):
    """Body by its mass, its centre of mass and the inertia about that, in one frame.

    The last two are tuples of numbers; a robot's tensors are split into bodies with rows of tensors in their place.
    """

    mass: Number  # [kg]
    com: Any  # three numbers [m]
    inertia: Any  # xx xy yy xz yz zz [kg m^2]

    def moved(self, X: DualQuaternion) -> RigidBody:
        """Body in frame A of one in frame B, where X = X_AB."""
        R = quat.rotation_columns(X[0])
        com = quat.add(dual_quaternion.translation(X), screw.columns_times(R, self.com))
        return RigidBody(self.mass, com, six(rotated(R, square(self.inertia))))

    def plus(self, other: RigidBody, share: Number) -> RigidBody:
        """Two bodies of the same frame as one; `share` is the fraction of their mass that the other has."""
        apart = quat.sub(other.com, self.com)
        x, y, z = apart
        reduced = self.mass * share  # reduced mass
        parallel = (y * y + z * z, -(x * y), x * x + z * z, -(x * z), -(y * z), x * x + y * y)
        about_com = tuple(i + o + reduced * s for i, o, s in zip(self.inertia, other.inertia, parallel, strict=True))
        return RigidBody(self.mass + other.mass, quat.add(self.com, quat.scale(share, apart)), about_com)


class Moments(NamedTuple):
    """Mass moments of a body, of order zero, one and two, about the origin of the frame."""

    mass: Number  # [kg]
    first: Pure  # m c [kg m]
    second: Six  # E [kg m^2]

    @classmethod
    def from_com(cls, mass: Number, com: Pure, about_com: Six) -> Moments:
        """Moments from the centre of mass [m] and the rotational inertia about it."""
        xx, xy, yy, xz, yz, zz = about_com
        half = 0.5 * (xx + yy + zz)
        x, y, z = com
        second = (
            (half - xx) + mass * (x * x),
            mass * (x * y) - xy,
            (half - yy) + mass * (y * y),
            mass * (x * z) - xz,
            mass * (y * z) - yz,
            (half - zz) + mass * (z * z),
        )
        return cls(mass, quat.scale(mass, com), second)

    @property
    def rotational(self) -> Symmetric:
        """Rotational inertia I = tr(E) 1 - E about the origin [kg m^2]."""
        xx, xy, yy, xz, yz, zz = self.second
        return ((yy + zz, -xy, -xz), (-xy, xx + zz, -yz), (-xz, -yz, xx + yy))

    @property
    def inertia(self) -> Inertia:
        """Conversion to the other form."""
        return Inertia(self.mass, self.first, self.rotational)

    @property
    def about_com(self) -> Symmetric:
        """Rotational inertia about the centre of mass."""
        return self.inertia.about_com

    def momentum(self, V: Screw) -> Screw:
        """Momentum G(V) of the body with twist V."""
        return self.inertia.momentum(V)  # (30)

    def plus(self, other: Moments) -> Moments:
        """Moments of two bodies together, both given in the same frame."""
        return Moments(self.mass + other.mass, quat.add(self.first, other.first), quat.add(self.second, other.second))

    def turned(self, axis: int, angle: Angle) -> Moments:
        """Moments in frame A of a body given in frame B, where B is rotated in A by an angle about a common axis."""
        return Moments(self.mass, turn(axis, angle, self.first), turn_symmetric(axis, angle, self.second))

    def shifted(self, p: Pure) -> Moments:
        """Moments about another origin, from which the present origin is at p, in the same axes."""
        m, h = self.mass, self.first
        f = quat.add(h, quat.scale(m, p))
        # E + h p^T + p h^T + m p p^T = E + f p^T + p h^T; if m is zero, f is h and products are recorded once
        pairs = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
        return Moments(
            m, f, tuple(e + (f[i] * p[j] + p[i] * h[j]) for e, (i, j) in zip(self.second, pairs, strict=True))
        )

    def split(self, axis: int) -> tuple[Moments, Moments]:
        """Moments that a rotation about an axis changes, and those of particles on the axis, which it does not."""
        first, second = [0.0] * 3, [0.0] * 6
        first[axis], second[DIAGONAL[axis]] = self.first[axis], self.second[DIAGONAL[axis]]
        off_first, off_second = list(self.first), list(self.second)
        off_first[axis] = off_second[DIAGONAL[axis]] = 0.0
        return Moments(0.0, tuple(off_first), tuple(off_second)), Moments(self.mass, tuple(first), tuple(second))


DIAGONAL = (0, 2, 5)  # positions of xx, yy, zz
# positions of the six numbers after a cyclic exchange of axes that makes axis k the third
_CYCLES = ((2, 4, 5, 1, 3, 0), (5, 3, 0, 4, 1, 2), (0, 1, 2, 3, 4, 5))


def turn_symmetric(axis: int, angle: Angle, m: Six) -> Six:
    """Matrix R M R^T of a symmetric matrix M, for the rotation R about an axis."""
    c, s = angle
    order = _CYCLES[axis]
    xx, xy, yy, xz, yz, zz = (m[k] for k in order)
    if isinstance(c, float) and c * s == 0.0:  # a multiple of a quarter turn exchanges entries, without rounding
        a, b = c * xx - s * xy, c * xy - s * yy
        turned = (c * a - s * b, s * a + c * b, s * s * xx + c * c * yy)
    else:
        w = s * (xx - yy) + c * (xy + xy)
        turned = (xx - s * w, c * w - xy, yy + s * w)
    result: list[Number] = [0.0] * 6
    for k, x in zip(order, (*turned, c * xz - s * yz, s * xz + c * yz, zz), strict=True):
        result[k] = x
    return tuple(result)
