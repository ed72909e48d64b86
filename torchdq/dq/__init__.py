"""Poses, quaternions and screws on tensors: [..., 8], [..., 4] and [..., 6], batched and differentiable.

`Pose` is a pose as a value, with its group operations:

    X = dq.Pose(torchdq.forward_kinematics(robot, q, "tip"))  # from a tensor [..., 8]
    X_des = dq.Pose.from_rotation_and_translation(r, p)  # a quaternion (w, x, y, z) and a position
    xi = (X.inverse() @ X_des).log()  # rotation vector and displacement from X to X_des, in the axes of X

The functions do the same on tensors: `mul`, `conj`, `exp`, `log_shortest`, `translation`, `rotate`, and conversions
`from_pose`, `from_matrix`, `to_matrix`, `from_rotation_matrix`, `to_rotation_matrix`. `exp` and `log` are those of the
paper, of half a motion; those of `Pose` are of the whole. `dq.paper` has the other operators of the paper.
"""

from torchdq.dq import paper as paper
from torchdq.dq.pose import Pose
from torchdq.dq.poses import (
    exp,
    from_matrix,
    from_pose,
    from_rotation_6d,
    from_rotation_matrix,
    log,
    log_jacobian,
    log_shortest,
    rotate,
    rotation,
    sclerp,
    screw_path,
    to_matrix,
    to_rotation_6d,
    to_rotation_matrix,
    translation,
)
from torchdq.dq.tensors import ad, ad_matrix, conj, mul, normalize

__all__ = [
    "Pose",
    "ad",
    "ad_matrix",
    "conj",
    "exp",
    "from_matrix",
    "from_pose",
    "from_rotation_6d",
    "from_rotation_matrix",
    "log",
    "log_jacobian",
    "log_shortest",
    "mul",
    "normalize",
    "rotate",
    "rotation",
    "sclerp",
    "screw_path",
    "to_matrix",
    "to_rotation_6d",
    "to_rotation_matrix",
    "translation",
]
