"""torchdq: rigid-body dynamics for robot learning as PyTorch layers, written in dual quaternions.

Conventions, everywhere:

* A quaternion is (w, x, y, z), a dual quaternion [..., 8] its primary and its dual quaternion. The pose of frame B in
  frame A is X_AB = r + (eps/2) p r: r turns B components into A components, p is B's origin in A; X_AC = X_AB X_BC.
* A screw is [..., 6], primary xyz and dual xyz. A twist is (angular, linear), a wrench is (force, moment).
* q, qd, qdd, tau are [..., n] in SI units, one number per joint, in the order of `robot.joint_names`; everything
  before the last axis is batch and broadcasts. dtype (float32, float64) and device follow the inputs.
* f_tip is the wrench the end effector exerts on the environment, in the tip frame; f_ext [..., n, 6] are the wrenches
  the environment exerts on the links, in link frames.
* None means absent: it is decided in Python and costs nothing.
"""

from typing import TYPE_CHECKING

from torchdq import convert, dq
from torchdq.backends.choice import backend
from torchdq.caches import clear_caches
from torchdq.control import computed_torque
from torchdq.errors import (
    ArgumentError,
    DescriptionError,
    DtypeError,
    FrozenError,
    MissingFileError,
    MissingLibraryError,
    NumberError,
    SingularInertiaError,
    TorchdqError,
    UnknownNameError,
    UnphysicalError,
)
from torchdq.functional import (
    closed_form,
    dynamics_jacobian,
    error_growth,
    forward_dynamics,
    forward_kinematics,
    inverse_dynamics,
    jacobian,
    kinetic_energy,
    mass_matrix,
    potential_energy,
    regressor,
    require_finite,
)
from torchdq.functions.compile import compile
from torchdq.nn import DQRNEA, ComputedTorque, ForwardDynamics
from torchdq.residual import ResidualDynamics
from torchdq.robot import Robot
from torchdq.robot import shipped as robots

if TYPE_CHECKING:
    from torchdq.envs.recommend import recommend

__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    """Attribute `recommend`, imported on first use: it tries scenes, which need gymnasium."""
    if name == "recommend":
        from torchdq.envs.recommend import recommend

        return recommend
    raise AttributeError(f"module 'torchdq' has no attribute {name!r}")


__all__ = [
    "DQRNEA",
    "ArgumentError",
    "ComputedTorque",
    "DescriptionError",
    "DtypeError",
    "ForwardDynamics",
    "FrozenError",
    "MissingFileError",
    "MissingLibraryError",
    "NumberError",
    "ResidualDynamics",
    "Robot",
    "SingularInertiaError",
    "TorchdqError",
    "UnknownNameError",
    "UnphysicalError",
    "backend",
    "clear_caches",
    "closed_form",
    "compile",
    "computed_torque",
    "convert",
    "dq",
    "dynamics_jacobian",
    "error_growth",
    "forward_dynamics",
    "forward_kinematics",
    "inverse_dynamics",
    "jacobian",
    "kinetic_energy",
    "mass_matrix",
    "potential_energy",
    "recommend",
    "regressor",
    "require_finite",
    "robots",
]
