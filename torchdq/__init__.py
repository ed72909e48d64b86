"""Rigid-body dynamics for robot learning as PyTorch layers, compiled per robot and written in dual quaternions.

Load a robot, and call functions and layers with it on batches of tensors:

    robot = torchdq.Robot.from_urdf("arm.urdf")  # or torchdq.robots.load("panda")
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)  # [..., n]
    layer = torchdq.DQRNEA(robot, learn=("mass", "friction"))  # a torch.nn.Module with the same arguments

Conventions, everywhere:

* A quaternion is (w, x, y, z), a dual quaternion [..., 8] its primary and its dual quaternion. The pose of frame B in
  frame A is X_AB = r + (eps/2) p r: r turns B components into A components, p is B's origin in A; X_AC = X_AB X_BC.
* A screw is [..., 6], primary xyz and dual xyz. A twist is (angular, linear), a wrench is (force, moment).
* q, qd, qdd, tau are [..., n] in SI units, one number per joint, in the order of `robot.joint_names`; everything
  before the last axis is batch and broadcasts. dtype (float32, float64) and device follow the inputs.
* f_tip is the wrench the end effector exerts on the environment, in the tip frame; f_ext [..., n, 6] are the wrenches
  the environment exerts on the links, in link frames.
* None means absent: it is decided in Python and costs nothing.

Robots:
    Robot                   from_urdf, from_screws, from_dh; `report()` says what was read, `replace` changes a copy
    Closure                 frames that are held together, for loops of links: robot.with_closures(Closure("a", "b"))
    robots                  robots that ship with the package: robots.load("panda")

Functions of a robot, batched and differentiable to any order:
    inverse_dynamics        joint torques of a motion
    forward_dynamics        joint accelerations under torques; error_growth says how rounding errors grow in it
    closed_form             mass matrix, Coriolis torques, gravity torques, Jacobian
    mass_matrix             mass matrix alone
    dynamics_jacobian       derivatives of the torques in q and qd, and the mass matrix
    dynamics_hessian        second derivatives of torques or accelerations; mass_matrix_derivative those of M
    regressor               factors of the inertial parameters in the torques
    kinetic_energy, potential_energy
    forward_kinematics      poses of frames as dual quaternions; dq.translation and dq.to_matrix convert them
    jacobian                twist of a frame from joint velocities
    closed, closure_errors  positions at which loops of links are closed, and how far others are from it
    constrained_inverse_dynamics        torques of the motors of a robot with loops, and forces in its closures
    distances               distances of spheres from objects, the ground and each other, to keep clear of them
    external_wrenches       wrenches on the links, of wrenches at frames
    computed_torque         torques of a tracking controller
    frame_motion            pose, twist and acceleration of a frame
    operational_space       dynamics of a frame; manipulability says how near it is to a singular configuration
    operational_space_control, cartesian_impedance      torques that move a frame, or hold it by a spring
    inverse_kinematics      joint positions of a pose, within limits
    differential_inverse_kinematics     joint velocities of a twist
    coriolis_matrix         Coriolis matrix, C qd = c and dM/dt = C + C^T
    floating                the same for robots with a floating base, and their momentum: floating.inverse_dynamics, ...

Layers, with quantities that may be learned and stay physical:
    DQRNEA                  inverse dynamics, named after the paper's algorithm, also InverseDynamics
    ForwardDynamics         forward dynamics
    ComputedTorque          controller, of a robot or of a trained layer
    ResidualDynamics        inverse dynamics and a network for what it lacks
    nn                      these, those of a floating base, task-space controllers and the momentum observer

Programs:
    compile                 one function of one robot: operation counts, source in C, derivatives
    backend                 context that chooses how programs run
    clear_caches            programs of this process forgotten
    recommend_settings      cheapest precision, integrator and step that keep an error

Tensors, other libraries, checks:
    dq                      dq.Pose, and functions of poses, quaternions and screws [..., 8], [..., 4], [..., 6]
    convert                 conventions of Pinocchio, SciPy, Isaac and others
    require_finite          error for NaN and infinity

Simulation and learning:
    Scene                   a robot with the effects, the integrator and the step size of its simulation
    effects                 gravity, friction, motors, sensors, contact and others
    objects                 free bodies that robots push, grasp and lift
    scene                   scene.integrators, scene.controllers, scene.policies, scene.State
    optimal                 trajectories, gains and receding horizons of least cost, within limits
    envs                    gymnasium environments
    learning                logs, identification, training of residuals

Errors derive from TorchdqError and from the built-in error that a caller would expect.
"""

from typing import TYPE_CHECKING

from torchdq import convert, dq, effects, floating, nn, objects
from torchdq.backends.choice import backend
from torchdq.base.caches import clear_caches
from torchdq.closures import closed, closure_errors, constrained_inverse_dynamics
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
from torchdq.errors import no_attribute as _no_attribute
from torchdq.functional import (
    closed_form,
    computed_torque,
    distances,
    dynamics_hessian,
    dynamics_jacobian,
    error_growth,
    external_wrenches,
    forward_dynamics,
    forward_kinematics,
    inverse_dynamics,
    jacobian,
    kinetic_energy,
    mass_matrix,
    mass_matrix_derivative,
    potential_energy,
    regressor,
    require_finite,
)
from torchdq.functions.compile import compile
from torchdq.nn import DQRNEA, ComputedTorque, ForwardDynamics, InverseDynamics, ResidualDynamics
from torchdq.pose_solver import differential_inverse_kinematics, inverse_kinematics
from torchdq.robot import Closure, Robot
from torchdq.robot import shipped as robots
from torchdq.task_space import (
    cartesian_impedance,
    coriolis_matrix,
    frame_motion,
    manipulability,
    operational_space,
    operational_space_control,
)

if TYPE_CHECKING:
    from torchdq import envs, learning, optimal, scene
    from torchdq.recommend import recommend_settings
    from torchdq.scene import Scene

__all__ = [
    "DQRNEA",
    "ArgumentError",
    "Closure",
    "ComputedTorque",
    "DescriptionError",
    "DtypeError",
    "ForwardDynamics",
    "FrozenError",
    "InverseDynamics",
    "MissingFileError",
    "MissingLibraryError",
    "NumberError",
    "ResidualDynamics",
    "Robot",
    "Scene",
    "SingularInertiaError",
    "TorchdqError",
    "UnknownNameError",
    "UnphysicalError",
    "backend",
    "cartesian_impedance",
    "clear_caches",
    "closed",
    "closed_form",
    "closure_errors",
    "compile",
    "computed_torque",
    "constrained_inverse_dynamics",
    "convert",
    "coriolis_matrix",
    "differential_inverse_kinematics",
    "distances",
    "dq",
    "dynamics_hessian",
    "dynamics_jacobian",
    "effects",
    "envs",
    "error_growth",
    "external_wrenches",
    "floating",
    "forward_dynamics",
    "forward_kinematics",
    "frame_motion",
    "inverse_dynamics",
    "inverse_kinematics",
    "jacobian",
    "kinetic_energy",
    "learning",
    "manipulability",
    "mass_matrix",
    "mass_matrix_derivative",
    "nn",
    "objects",
    "operational_space",
    "operational_space_control",
    "optimal",
    "potential_energy",
    "recommend_settings",
    "regressor",
    "require_finite",
    "robots",
    "scene",
]

__version__ = "0.1.0"

# names in other libraries
_ELSEWHERE = {
    "rnea": "inverse_dynamics",
    "aba": "forward_dynamics",
    "crba": "mass_matrix",
    "nle": "inverse_dynamics without qdd",
    "gravity": "closed_form(...).g",
    "coriolis": "closed_form(...).c, or coriolis_matrix",
    "osc": "operational_space_control",
    "nullspace": "operational_space(...).N",
    "fk": "forward_kinematics",
    "joint_torque_regressor": "regressor",
    "from_urdf": "Robot.from_urdf",
    "load": "robots.load",
    "read": "learning.read_log",
    "smooth": "learning.smooth",
    "identify": "learning.identify",
    "fit": "learning.fit",
    "com": "Robot.com, the centres of mass of the links",
    "ik": "inverse_kinematics",
    "ikine": "inverse_kinematics",
}


def __getattr__(name: str) -> object:
    """Name or module that is imported on first use; an unknown name raises with the closest known ones."""
    if name == "Scene":
        from torchdq.scene import Scene

        return Scene
    if name == "recommend_settings":
        from torchdq.recommend import recommend_settings

        return recommend_settings
    if name == "envs":
        import torchdq.envs as envs

        return envs
    if name == "learning":
        import torchdq.learning as learning

        return learning
    if name == "optimal":
        import torchdq.optimal as optimal

        return optimal
    if name == "scene":
        import torchdq.scene as scene

        return scene
    raise _no_attribute("module 'torchdq'", name, __all__, _ELSEWHERE, "help(torchdq)")


def __dir__() -> list[str]:
    """Public names."""
    return [*__all__, "__version__"]
