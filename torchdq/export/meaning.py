"""Descriptions and units of the arguments and results of programs, by their names."""

from collections.abc import Mapping, Sequence
from dataclasses import fields

WORDS = {
    "q": "joint positions [rad or m]",
    "qd": "joint velocities [rad/s or m/s]",
    "qdd": "joint accelerations [rad/s^2 or m/s^2]",
    "tau": "joint torques or forces [N m or N]",
    "torque": "commanded joint torques or forces [N m or N]",
    "q_des": "desired joint positions [rad or m]",
    "qd_des": "desired joint velocities [rad/s or m/s]",
    "qdd_des": "desired joint accelerations [rad/s^2 or m/s^2]",
    "kp": "gains of the position errors [1/s^2]",
    "kd": "gains of the velocity errors [1/s]",
    "X_des": "desired pose of the frame: dual quaternion (w x y z, w x y z), primary and dual part [-, m]",
    "V_des": "desired twist (angular, linear) of the frame [rad/s, m/s]",
    "A_des": "rate of the components of the desired twist [rad/s^2, m/s^2]",
    "q_null": "joint positions that the task leaves free move to [rad or m]",
    "k_null": "gain of the errors from q_null [1/s^2]",
    "damping": "of a control law: share of a diagonal below which a pivot is singular, or coefficients of a damper",
    "stiffness": "stiffness of the spring at the frame, axis by axis [N m/rad, N/m]",
    "gain": "change of the torques or targets by displacements of the state, row by row; see below",
    "best": "joint positions of the smallest error so far [rad or m]",
    "state": "number of the start, 1 if it has converged, mean of the squared error, best squares [rad^2, m^2]",
    "settings": "largest angle [rad], largest distance [m], number of starts",
    "dt": "time within which no joint may leave its limits [s]",
    "f_tip": "wrench (force, moment) the end effector exerts on the environment, in the tip frame [N, N m]",
    "f_ext": "wrenches (force, moment) the environment exerts on the links, link by link, in link frames [N, N m]",
    "f_base": "wrench (force, moment) the environment exerts on the base, in its frame [N, N m]",
    "X_WB": "pose of the base: unit dual quaternion (w x y z, w x y z), primary and dual part [-, m]",
    "V_WB_B": "twist (angular, linear) of the base in its axes [rad/s, m/s]",
    "A_WB_B": "rate of the twist of the base [rad/s^2, m/s^2]",
    "F_B": "wrench (force, moment) on the base, in its axes [N, N m]",
    "M": "mass matrix, row by row [kg m^2, kg m or kg]",
    "c": "Coriolis and centrifugal torques [N m or N]",
    "H": "second derivatives with respect to z, weighted and summed, or joint by joint, row by row",
    "weight": "weights of the joints in H",
    "g": "gravity torques [N m or N]",
    "Jt": "transposed Jacobian of the tip on (force, moment), row by row",
    "J": "Jacobian of the frame, (angular, linear), row by row",
    "X": "poses of the frames: unit dual quaternions, frame by frame",
    "V": "twist (angular, linear) of the frame [rad/s, m/s]",
    "A": "rate of the components of the twist [rad/s^2, m/s^2]",
    "Lambda": "inertia of the frame on the axes, row by row",
    "mu": "Coriolis and centrifugal force on the axes",
    "p": "gravity force on the axes",
    "Jdot_qd": "rate of the twist on the axes without joint accelerations",
    "Jbar": "dynamically consistent inverse of J, row by row",
    "r": "external torques, as an observer estimates them [N m or N]",
    "momentum": "momentum of the joints, M qd [N m s or N s]",
    "rate": "rate of the momentum that the model expects [N m or N]",
    "F": "force on the axes [N m, N]",
    "part": "part of each component of the force that the torques determine",
    "C": "Coriolis matrix, row by row",
    "w": "manipulability",
    "e": "error (rotation vector, displacement) of the frame on the axes [rad, m]",
    "P": "factors of the error in the step of the joint positions, row by row",
    "scale": "share of the desired twist that the joints give",
    "Y": "regressor, row by row",
    "T": "kinetic energy [J]",
    "U": "potential energy [J]",
    "growth": "factor by which rounding errors are magnified; the function returns 1 where it is too large",
    "memory": "memory of the effects from step to step; see the scene's effects, in their order",
    "reading": "measured joint positions, then velocities [rad or m, rad/s or m/s]",
    "reference": "desired joint positions, velocities and accelerations, or pose of a frame, twist and twist rate",
    "noise": "uniform random numbers in (0, 1)",
    "mass": "masses of the links [kg]",
    "com": "centres of mass of the links, xyz, in the link frames [m]",
    "inertia": "inertias of the links about their centres of mass, xx xy yy xz yz zz [kg m^2]",
    "armature": "rotor inertias at the joints [kg m^2 or kg]",
    "X_PB_home": "poses of the links in their parents' frames at home: unit dual quaternions, link by link [-, m]",
    "screw": "joint screws in the link frames, (direction, moment), link by link [-, m]",
    "home": "joint positions at home [rad or m]",
    "base_mass": "mass of the base [kg]",
    "base_com": "centre of mass of the base, xyz, in its frame [m]",
    "base_inertia": "inertia of the base about its centre of mass, xx xy yy xz yz zz [kg m^2]",
    "p_WC": "centre of mass of all bodies in the world [m]",
    "linear": "linear momentum [kg m/s], or its rate [N]",
    "angular": "angular momentum about the centre of mass [kg m^2/s], or its rate [N m]",
    "push": "wrench (force, moment) of the environment on the pushed frame [N, N m]",
    "temperature": "temperatures of the joints above the one at which friction coefficients hold [K]",
    "target": "positions that the servos hold [rad or m]",
    "gravity": "gravitational acceleration in the base frame [m/s^2]",
    "viscous": "viscous friction of the joints [N m s/rad or N s/m]",
    "coulomb": "Coulomb friction of the joints [N m or N]",
    "offset": "constant torques of the motors [N m or N]",
}


def words(name: str) -> str:
    """Description and unit of an argument or a result of a program; "" if nothing is known of its name.

    >>> words("dtau/dq")
    'derivatives of tau (rows) with respect to q (columns), row by row'
    """
    if name.endswith("'"):
        return f"derivatives of a scalar with respect to {name.removesuffix(chr(39))}, in its order"
    if name.endswith("/dz"):
        return f"derivatives of {name[1:-3]} (rows) with respect to z, all arguments but weights, row by row"
    if name.startswith("d") and "/d" in name:
        of, by = name.removeprefix("d").rsplit("/d", 1)
        return f"derivatives of {of} (rows) with respect to {by} (columns), row by row"
    part, dot, parameter = name.rpartition(".")
    if dot:
        owner = {"-2": "the robot", "-1": "the controller"}.get(part, f"effect {part}")
        return f"{parameter} of {owner}{f': {WORDS[parameter]}' if parameter in WORDS else ', in SI units'}"
    return WORDS.get(name, "")


def heading(what: str, robot: str, joints: Sequence[str]) -> tuple[str, ...]:
    """Lines above a program of a robot: what it is, and the order of its joints."""
    return f"{what} of robot {robot}", f"joints in the order of q: {', '.join(joints)}"


def constants(numbers: Mapping[str, Sequence[float]]) -> list[str]:
    """Lines about numbers that are constants of a program, by name, each with its words.

    >>> constants({"kp": (25.0, 25.0), "kd": (10.0, 8.0)})
    ['kp = 25: gains of the position errors [1/s^2]', 'kd = 10, 8: gains of the velocity errors [1/s]']
    """
    return [f"{name} = {_row(row)}: {words(name)}" for name, row in numbers.items()]


def rigid(described: bool) -> str:
    """Line about a program of rigid bodies, of a robot that may have friction in its description."""
    return f"friction: none{'; that of the description is left out' * described}"


def part(x: object) -> str:
    """Effect or controller of a program with its numbers [SI], joint by joint; one number is that of all joints.

    What is absent is left out: None, and zeros that nobody gave.
    """
    shown = [f for f in fields(x) if f.init and f.repr]  # type: ignore[arg-type]
    given = {f.name: _value(v) for f in shown if not _absent(v := getattr(x, f.name), f.default)}
    return f"{type(x).__name__}({', '.join(f'{name}={text}' for name, text in given.items())})"


def _absent(x: object, default: object) -> bool:
    """True for None, and for zeros where the default is zero."""
    return x is None or (default == 0.0 and (x == 0.0 or (isinstance(x, tuple) and not any(x))))


def _value(x: object) -> str:
    """Parameter as text: numbers, or that it is an argument."""
    if isinstance(x, tuple) and x and all(isinstance(v, float) for v in x):
        row = _row(x)
        return row if "," not in row else f"({row})"
    plain = x is None or isinstance(x, bool | int | float | str | tuple)
    return repr(x) if plain else "argument" if repr(x) == "tensor" else type(x).__name__


def _row(row: Sequence[float]) -> str:
    return f"{row[0]:.6g}" if len(set(row)) == 1 else ", ".join(f"{x:.6g}" for x in row)


def described(shown: Sequence[str], names: Sequence[str], way: str) -> list[str]:
    """Lines about arguments or results: each as it is shown in the language, and its meaning."""
    width = max(map(len, shown), default=0)
    return [f"{way}  {text:<{width}}  {words(name)}".rstrip() for text, name in zip(shown, names, strict=True)]
