"""Every kind of program: functions of robots, steps of scenes and environments, and those of the study of accuracy."""

import importlib
import sys
from collections.abc import Callable
from functools import cache, partial

import torch
from places import BENCHMARKS
from robots import on_free_base as free

import torchdq
from torchdq import Scene, effects, objects
from torchdq.control import Law
from torchdq.envs import RobotVectorEnv
from torchdq.envs.tasks import Checked
from torchdq.functions.catalogue import FLOATING
from torchdq.program.program import Program
from torchdq.robot import ContactPoint
from torchdq.scene import controllers, integrators

ROBOTS = ("two_link", "panda", "ur10e", "puma560")


# --- functions of robots ---------------------------------------------------------------------------------------------

INERTIA = ("mass", "com", "inertia")
GEOMETRY = ("X_PB_home", "screw")
WRENCHES = ("f_tip", "f_ext")
STILL = ("q", "qd", "X_des", "kp", "kd", "damping")  # control with a goal at rest and without a posture
OF_BOTH_BASES = ("inverse_dynamics", "forward_dynamics", "mass_matrix", "coriolis_matrix", "error_growth", "regressor")
OF_BOTH_BASES += ("kinetic_energy", "potential_energy")
PLAIN = (*OF_BOTH_BASES, "inverse_dynamics_jacobian", "dynamics_jacobian", "dynamics_hessian")
PLAIN += ("forward_dynamics_hessian", "mass_matrix_derivative", "joint_momentum")
PLAIN += tuple(f"floating.{name}" for name in (*OF_BOTH_BASES, "closed_form", "centre_of_mass", "momentum"))
PLAIN += ("floating.momentum_rate", "distances", "floating.distances")
OF_AXES = ("manipulability", "operational_space", "contact_force")
OF_AXES += ("inverse_kinematics_step", "inverse_kinematics_newton")


@cache
def robot(name: str, arguments: tuple[str, ...] = ()) -> torchdq.Robot:
    """Shipped robot; the named tensors are arguments of its programs."""
    loaded = torchdq.robots.load(name)
    return loaded.replace(**{field: getattr(loaded, field) for field in arguments})


def recipe(name: str, function: str, present=None, options=(), fields=(), derivative=False) -> Program:
    """Program of a public function, or of the product of a cotangent with its Jacobian."""
    known = robot(name, fields)
    known = free(known) if function.startswith(FLOATING) else known
    compiled = torchdq.compile(known, function, arguments=present, options=options)
    return (compiled.vjp() if derivative else compiled).program


def recipes(name: str) -> dict[str, Callable[[], Program]]:
    """Programs of a robot by the function, and by what of it is asked for."""
    tip = robot(name).tip or robot(name).frame_names[-1]
    axes = "x y" if name == "two_link" else "pose"
    found = {
        **{function: {} for function in PLAIN},
        "inverse_dynamics q": {"present": ("q",)},
        "inverse_dynamics wrenches": {"present": ("q", "qd", "qdd", *WRENCHES)},
        "inverse_dynamics inertial arguments": {"fields": INERTIA},
        "inverse_dynamics geometry arguments": {"fields": GEOMETRY},
        "inverse_dynamics vjp": {"derivative": True},
        "forward_dynamics wrenches": {"present": ("q", "qd", "tau", *WRENCHES)},
        "forward_dynamics geometry arguments": {"fields": GEOMETRY},
        "forward_dynamics vjp": {"derivative": True},
        "dynamics_hessian each": {"present": ("q", "qd", "qdd")},
        "closed_form": {"options": ("",)},
        "closed_form tip": {"options": (tip,)},
        "forward_kinematics": {"options": (tip,)},
        "forward_kinematics all": {"options": robot(name).frame_names},
        "jacobian": {"options": (tip, "body")},
        "jacobian world": {"options": (tip, "world")},
        "external_wrenches": {"options": ("world", tip)},
        "frame_motion": {"options": (tip,)},
        "distances objects": {"options": (spheres(tip, robot(name).link_names[0]), OBJECTS, "ground", "own")},
        **{function: {"options": (tip, "body", axes)} for function in OF_AXES},
        "differential_inverse_kinematics": {"options": (tip, "body", axes, "bounded")},
        "floating.inverse_dynamics vjp": {"derivative": True},
        "floating.forward_dynamics vjp": {"derivative": True},
        "floating.forward_kinematics": {"options": (tip,)},
        "floating.jacobian": {"options": (tip,)},
        "floating.external_wrenches": {"options": ("world", tip)},
    }
    known = {f"{name}/{key}": partial(recipe, name, key.split()[0], **of) for key, of in found.items()}
    return known | {f"{name}/{key}": partial(law.program, robot(name), of) for key, (law, of) in laws(name).items()}


def laws(name: str) -> dict[str, tuple[Law, tuple[str, ...] | None]]:
    """Control laws of a robot whose gains are arguments, and the arguments that are present."""
    n, pose = robot(name).n, name != "two_link"
    joints, axes, one = (torch.ones(shape, dtype=torch.float64) for shape in (n, 6 if pose else 2, ()))
    where = {"frame": robot(name).tip or robot(name).frame_names[-1], "axes": "pose" if pose else "x y"}
    osc = partial(controllers.OperationalSpaceControl, axes, axes, **where)
    limits = {"limits": name in ("panda", "ur10e"), "expressed": "world"}
    return {
        "computed_torque": (controllers.ComputedTorque(joints, joints), None),
        "operational_space_control": (osc(one, q_null=joints, k_null=one), None),
        "operational_space_control still": (osc(one), STILL),
        "operational_space_control limits": (osc(one, **limits), STILL),
        "cartesian_impedance": (
            controllers.CartesianImpedance(axes, axes, **where),
            (*STILL[:3], "stiffness", "damping"),
        ),
    }


OBJECTS = (objects.Box("box", 1.0, size=(0.1, 0.2, 0.3)), objects.Capsule("capsule", 1.0, radius=0.05, length=0.2))


def spheres(*frames: str) -> tuple[ContactPoint, ...]:
    """A sphere on every frame."""
    return tuple(ContactPoint(frame, radius=0.05) for frame in frames)


# --- steps of scenes -------------------------------------------------------------------------------------------------

DRAG = effects.Drag(0.1, 0.1, 0.1)
CONTACT = effects.Contact(friction=0.5)
FRICTION = (effects.Viscous(1.0), effects.Coulomb(1.0), effects.Stribeck(1.0, 1.5), effects.Quadratic(1.0))
FRICTION += (effects.Directional(1.0, 1.5), effects.LoadDependent(0.2), effects.Ripple(0.1, 0.5, 0.5))
FRICTION += (effects.LuGre(1.0),)
MODEL = (effects.Gravity(), effects.RotorInertia(0.1), effects.Payload(1.0), effects.MassScale(1.1))
JOINTS = (effects.Spring(10.0), effects.JointLimits(), effects.Elastic(1e3, 1.0, 0.1))
EFFECTS = {
    "none": (),
    **{type(x).__name__: (x,) for x in (*MODEL, *FRICTION, *JOINTS, effects.Push(), DRAG, CONTACT)},
    "warming Viscous": (effects.Viscous(1.0, warming=-0.01),),
    "DragContactPush": (DRAG, CONTACT, effects.Push()),
}
# the other integrators evaluate effects the way these two do, only more often
SEVERAL = ("none", "Gravity", "Elastic", "Drag")
INTEGRATORS = {
    "semi": (integrators.SemiImplicitEuler(), [name for name in EFFECTS if "Contact" not in name]),
    "implicit": (integrators.LinearlyImplicit(), EFFECTS),
    "rk4": (integrators.RungeKutta4(), SEVERAL),
    "verlet": (integrators.StoermerVerlet(), SEVERAL),
}
FLOATING_TOO = {"semi": ("none",), "implicit": ("none", "Contact"), "rk4": ("none",)}  # those for floating bases


def step(integrator: str, effect: str, floating: bool = False) -> Program:
    """Program of a step of the panda under an effect."""
    known = free(robot("panda")) if floating else robot("panda")
    return Scene(known, EFFECTS[effect], integrator=INTEGRATORS[integrator][0], dt=0.01).program()


CUBE = objects.Box("cube", 0.1, size=(0.04, 0.04, 0.04))
TOUCHING = {"beside": (), "held": (effects.Contact("*_finger", on="cube"), effects.Contact("cube"))}


def cube_step(how: str) -> Program:
    """Program of a step of an arm with a gripper and a cube."""
    return Scene(robot("panda_hand"), (effects.Gravity(), *TOUCHING[how]), objects=(CUBE,), dt=0.005).program()


def linearization(name: str) -> Program:
    """Program of the derivatives of a step under gravity and friction."""
    return Scene(robot(name), (effects.Gravity(), effects.Viscous(1.0)), dt=0.01).program(wrt=("torque",))


def environment(name: str, task: str) -> Program:
    """Program of a step of an environment, its rewards and observations included."""
    envs = RobotVectorEnv(2, task, name, action="torque")
    return envs.scene.program("torque", *envs.task.inputs(envs.scene.n), task=Checked(envs.task))


# --- the study of accuracy -------------------------------------------------------------------------------------------

CASES = ("pendulum", "double_pendulum", "arm7", "servo", "chain42", "tumbling", "rough")
METHODS = ("ExplicitEuler", "SemiImplicitEuler", "LinearlyImplicit", "StoermerVerlet", "RungeKutta4")
STUDIED = [
    (case, method)
    for case in CASES
    for method in METHODS
    # evaluated several times in a step, 42 joints take seconds to record
    if case != "chain42" or method not in ("StoermerVerlet", "RungeKutta4")
]


@cache
def study(module: str):
    """Module of the study."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        return importlib.import_module(f"accuracy.{module}")
    finally:
        sys.path.remove(str(BENCHMARKS))


@cache
def case(name: str):
    """Scene of the study."""
    return study("scenes").CASES[name]()


def studied(name: str, method: str) -> Program:
    """Program of a step of the study, whose duration is an argument."""
    return study("methods").step_program(case(name), study("methods").INTEGRATORS[method])


TASKS = [(task, name) for task in ("reach", "track") for name in ("panda", "ur10e")]
FLOATING_STEPS = [(i, e) for i, several in FLOATING_TOO.items() for e in several]
PROGRAMS: dict[str, Callable[[], Program]] = {
    **{key: program for name in ROBOTS for key, program in recipes(name).items()},
    **{f"panda/scene/{i}/{e}": partial(step, i, e) for i, (_, several) in INTEGRATORS.items() for e in several},
    **{f"panda/floating scene/{i}/{e}": partial(step, i, e, True) for i, e in FLOATING_STEPS},
    **{f"panda_hand/cube/{how}": partial(cube_step, how) for how in TOUCHING},
    **{f"{name}/linearization": partial(linearization, name) for name in ("panda", "ur10e")},
    **{f"{task.title()}/{name}": partial(environment, name, task) for task, name in TASKS},
    **{f"study/{name}/{method}": partial(studied, name, method) for name, method in STUDIED},
}
