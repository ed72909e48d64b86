"""Poses, twists and quaternions in the conventions of other libraries.

Here a pose X_AB is [..., 8], a quaternion (w, x, y, z), a twist (angular, linear), a wrench (force, moment). Elsewhere:

    scipy      RigidTransform holds the same pose; its Rotation writes quaternions (x, y, z, w) by default
    Pinocchio  pin.SE3 holds the same pose; Motion is (linear, angular); Force is (linear, angular) = (force, moment),
               which is the order here, so that a wrench needs no conversion: `pin.Force(wrench.numpy())`
    MuJoCo     position and quaternion (w, x, y, z)
    Isaac      position and quaternion, (x, y, z, w) or (w, x, y, z): see `root_to_isaac`

Robots with a free base have their converters at the end: their configurations, velocities, accelerations and forces are
rows of the base and then of the joints there. The joints are those of our robots, in our order: take `q[..., order]`
for the order of a model, found by names. These are differentiable.

scipy and Pinocchio are imported when their converters are called. Nothing is differentiated through those two.
"""

from torchdq.convert.isaac import (
    acceleration_from_isaac,
    acceleration_to_isaac,
    root_from_isaac,
    root_to_isaac,
    wrench_from_isaac,
    wrench_to_isaac,
)
from torchdq.convert.mujoco import (
    acceleration_from_mujoco,
    acceleration_to_mujoco,
    configuration_from_mujoco,
    configuration_to_mujoco,
    forces_from_mujoco,
    forces_to_mujoco,
    from_mujoco,
    to_mujoco,
    velocity_from_mujoco,
    velocity_to_mujoco,
)
from torchdq.convert.pinocchio import (
    configuration_from_pinocchio,
    configuration_to_pinocchio,
    forces_from_pinocchio,
    forces_to_pinocchio,
    from_pinocchio,
    motion_from_pinocchio,
    motion_to_pinocchio,
    to_pinocchio,
    velocity_from_pinocchio,
    velocity_to_pinocchio,
)
from torchdq.convert.quaternions import (
    from_xyzw,
    to_xyzw,
)
from torchdq.convert.scipy import (
    from_scipy,
    to_scipy,
)

__all__ = [
    "acceleration_from_isaac",
    "acceleration_from_mujoco",
    "acceleration_to_isaac",
    "acceleration_to_mujoco",
    "configuration_from_mujoco",
    "configuration_from_pinocchio",
    "configuration_to_mujoco",
    "configuration_to_pinocchio",
    "forces_from_mujoco",
    "forces_from_pinocchio",
    "forces_to_mujoco",
    "forces_to_pinocchio",
    "from_mujoco",
    "from_pinocchio",
    "from_scipy",
    "from_xyzw",
    "motion_from_pinocchio",
    "motion_to_pinocchio",
    "root_from_isaac",
    "root_to_isaac",
    "to_mujoco",
    "to_pinocchio",
    "to_scipy",
    "to_xyzw",
    "velocity_from_mujoco",
    "velocity_from_pinocchio",
    "velocity_to_mujoco",
    "velocity_to_pinocchio",
    "wrench_from_isaac",
    "wrench_to_isaac",
]
