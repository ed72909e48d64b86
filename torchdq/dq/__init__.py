"""Quaternions, dual quaternions and screws on tensors.

tensors     operations of the algebra on tensors [..., 3], [..., 4], [..., 6] and [..., 8]
poses       exponential, logarithm and interpolation of poses; conversion from and to rotations, positions and matrices
formulas    formulas of the algebra on tensors, as programs
explog      exponential and logarithm as programs, accurate to rounding at every angle
components  conversion between tensors and tuples of components
"""

from typing import TYPE_CHECKING

from torchdq.base.attributes import refusing
from torchdq.dq.components import stack
from torchdq.dq.poses import (
    ScrewParameters,
    exp,
    from_matrix,
    from_pose,
    from_rotation_matrix,
    log,
    log_shortest,
    rotate,
    rotation,
    sclerp,
    screw_params,
    to_matrix,
    to_rotation_matrix,
    translation,
    translation_body,
)
from torchdq.dq.tensors import (
    ad,
    ad_matrix,
    columns,
    conj,
    cross,
    dot,
    double_geodesic,
    h_left,
    h_right,
    hamilton_left,
    hamilton_right,
    inertia_transform,
    inner,
    matmul,
    mul,
    norm,
    normalize,
    power,
    swap,
    t4,
    t8,
    transpose,
)

__all__ = [
    "ScrewParameters",
    "ad",
    "ad_matrix",
    "columns",
    "conj",
    "cross",
    "dot",
    "double_geodesic",
    "exp",
    "from_matrix",
    "from_pose",
    "from_rotation_matrix",
    "h_left",
    "h_right",
    "hamilton_left",
    "hamilton_right",
    "inertia_transform",
    "inner",
    "log",
    "log_shortest",
    "matmul",
    "mul",
    "norm",
    "normalize",
    "power",
    "rotate",
    "rotation",
    "sclerp",
    "screw_params",
    "stack",
    "swap",
    "t4",
    "t8",
    "to_matrix",
    "to_rotation_matrix",
    "translation",
    "translation_body",
    "transpose",
]

if not TYPE_CHECKING:  # type checkers know the names
    __getattr__ = refusing(__name__, multiply="mul", inverse="conj, of what has norm 1", conjugate="conj")
