"""Poses, twists, wrenches and rows of robots with a floating base in the conventions of other libraries.

Ours, as arguments and results of all functions:

    X_AB, X_WB      [..., 8]   pose; of the base in the world
    V_WB_B, A_WB_B  [..., 6]   twist (angular [rad/s], linear [m/s]) of the base in its own
                               axes, and its rate
    F_B             [..., 6]   wrench (force [N], moment [N m]) on the base in its axes,
                               about its origin
    q, qd, qdd, tau [..., n]   of our joints in our order; `q[..., order]` is the order of a
                               model, found by names
    r               [..., 4]   unit quaternion (w, x, y, z)
    com             [..., 3]   centre of mass in the frame of the base [m]

Theirs, with the joints last in every row:

    scipy      RigidTransform: the same pose; its Rotation writes quaternions (x, y, z, w)
               by default
    Pinocchio  SE3: the same pose; Motion (linear, angular); Force (force, moment), our
               order: `pin.Force(F.numpy())`
               configuration [..., 7 + n]  position, quaternion (x, y, z, w), q
               velocity      [..., 6 + n]  linear, angular in base axes, qd; accelerations
                                           are rates of it
               forces        [..., 6 + n]  force, moment in base axes, tau
    MuJoCo     pose: position and quaternion (w, x, y, z), as `data.xpos` and `data.xquat`
               qpos [..., 7 + n]  position, quaternion (w, x, y, z), q
               qvel [..., 6 + n]  velocity of the origin in world axes, angular velocity
                                  in base axes, qd
               qacc [..., 6 + n]  rates of qvel
               qfrc [..., 6 + n]  force in world axes, moment in base axes, tau
    Isaac      root state   [..., 13]  position, quaternion, linear and angular velocity in
                                       world axes
               acceleration [..., 6]   linear, angular in world axes
               wrench                  force, moment about the centre of mass, in base axes

Arrays of numpy are taken where the row is theirs. scipy and Pinocchio are imported when their converters are called;
nothing is differentiated through their objects, everything else is differentiable.
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
from torchdq.convert.rows import from_xyzw, to_xyzw
from torchdq.convert.scipy import from_scipy, to_scipy

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
