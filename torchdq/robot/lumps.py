"""Bodies that are fixed to each other, as one, and what is left of one without another."""

from __future__ import annotations

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Six, merged, rotated, six, square
from torchdq.algebra.quaternion import Pure

Lump = tuple[float, Pure, Six]  # mass [kg], centre of mass [m], inertia about it: xx xy yy xz yz zz [kg m^2]
NOTHING: Lump = (0.0, quat.ZERO, (0.0,) * 6)


def moved(X: DualQuaternion, body: Lump) -> Lump:
    """Body in frame A of one in frame B, where X = X_AB."""
    mass, com, inertia = body
    turned = six(rotated(quat.rotation_columns(X[0]), square(inertia)))
    return mass, quat.add(quat.rotate(X[0], com), dual_quaternion.translation(X)), turned


def together(a: Lump, b: Lump) -> Lump:
    """Two bodies as one; one without mass may have a rotational inertia."""
    if a[0] and b[0]:
        return merged(a, b)
    return a[0] + b[0], a[1] if a[0] else b[1], quat.add(a[2], b[2])


def without(whole: Lump, part: Lump) -> Lump:
    """Rest of a body without a part of it: with the part, it is the whole again."""
    mass = whole[0] - part[0]
    if not mass or not part[0]:
        return mass, whole[1] if mass else quat.ZERO, quat.sub(whole[2], part[2])
    com = quat.add(whole[1], quat.scale(part[0] / mass, quat.sub(whole[1], part[1])))
    between = merged((mass, com, (0.0,) * 6), (part[0], part[1], part[2]))
    return mass, com, quat.sub(whole[2], between[2])
