"""Bodies that are fixed to each other, as one, and what is left of one without another; numbers may be tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion, screw
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Six, merged, rotated, six, square
from torchdq.algebra.quaternion import Number, Pure

Lump = tuple[Number, Pure, Six]  # mass [kg], centre of mass [m], inertia about it: xx xy yy xz yz zz [kg m^2]
NOTHING: Lump = (0.0, quat.ZERO, (0.0,) * 6)


def moved(X: DualQuaternion, body: Lump) -> Lump:
    """Body in frame A of one in frame B, where X = X_AB."""
    mass, com, inertia = body
    R = quat.rotation_columns(X[0])
    placed = quat.add(dual_quaternion.translation(X), screw.columns_times(R, com))
    return mass, placed, six(rotated(R, square(inertia)))


def together(a: Lump, b: Lump) -> Lump:
    """Two bodies as one; those without mass may have a rotational inertia."""
    return merged(a, b, _share(b[0], a[0] + b[0]))


def without(whole: Lump, part: Lump) -> Lump:
    """Rest of a body without a part of it: with the part, it is the whole again."""
    mass = whole[0] - part[0]
    if not mass or not part[0]:
        return mass, whole[1] if mass else quat.ZERO, quat.sub(whole[2], part[2])
    com = quat.add(whole[1], quat.scale(part[0] / mass, quat.sub(whole[1], part[1])))
    between = together((mass, com, (0.0,) * 6), part)
    return mass, com, quat.sub(whole[2], between[2])


def _share(part: Number, whole: Number) -> Number:
    """Part of the whole as a fraction, zero if there is no whole."""
    if isinstance(whole, Tensor):  # a division by zero would leave NaN in the gradients even where it is masked
        return torch.where(whole == 0, 0.0, part / torch.where(whole == 0, 1.0, whole))
    return part / whole if whole else 0.0
