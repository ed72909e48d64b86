"""Formulas of the functions of a frame's motion, of its dynamics, and of its control."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchdq.algebra import screw
from torchdq.algebra.quaternion import Number
from torchdq.dynamics import observer, task_space
from torchdq.dynamics import posed as mechanics
from torchdq.dynamics.posed import Row, dot
from torchdq.dynamics.task_space import AXES, COMPONENTS, Task
from torchdq.functions.posed import as_screw, factors, frame
from torchdq.functions.recipe import RecipeInputs, Results
from torchdq.functions.task_space import (
    Gains,
    Goal,
    impedance_torques,
    numbers,
    operational_space_torques,
    pose_of,
    pose_of_any_norm,
)
from torchdq.program.program import GROWTH, Argument

HELD = Argument("held", 6)  # the twist of a floating base, where derivatives by it are wanted elsewhere
DAMPING = 2.0**-8  # of a posture beside a spring, where the inertia of the frame serves the projection alone


def rows_of(axes: str) -> tuple[int, ...]:
    """Numbers of the components that a choice of axes names."""
    return tuple(COMPONENTS.index(axis) for axis in AXES.get(axes, axes.split()))


def task_of(x: RecipeInputs, name: str, expressed: str, axes: str = "pose") -> Task:
    """Frame of a robot and its components."""
    return Task(*frame(x.robot, name), expressed == "world", rows_of(axes))


def frame_motion(x: RecipeInputs, name: str, expressed: str) -> Results:
    """Pose X of a frame, its twist V, and the rate A of the components of that."""
    at, task, qd = x.posed(), task_of(x, name, expressed), x.arguments["qd"]
    X, V, A = pose_of(at, task), task.twist(at, qd), task.twist_rate(at, qd, x.arguments.get("qdd"))
    return {name: [*pair[0], *pair[1]] for name, pair in (("X", X), ("V", V), ("A", A))}


def operational_space(x: RecipeInputs, name: str, expressed: str, axes: str) -> Results:
    """Terms of F = Lambda a + mu + p, and the Jacobians J and Jbar."""
    x.require_inertia()
    at, task, qd = x.posed(), task_of(x, name, expressed, axes), x.arguments["qd"]
    found, solve = task_space.inertia(at, task, None), factors(x.robot, at, False).solve
    _, c, g = mechanics.closed_form(at, qd)
    Lambda, moved = found.matrix(), [solve(row) for row in found.J]
    Jbar = tuple(tuple(dot(row, column) for row in Lambda) for column in zip(*moved, strict=True))
    drift = task.of(task.twist_rate(at, qd, None))
    forces = [task_space.torques(Jbar, numbers(torque)) for torque in (c, g)]
    return {
        "Lambda": [entry for row in Lambda for entry in row],
        "mu": [f - dot(row, drift) for f, row in zip(forces[0], Lambda, strict=True)],
        "p": forces[1],
        "J": [entry for row in found.J for entry in row],
        "Jdot_qd": drift,
        "Jbar": [entry for row in Jbar for entry in row],
        "growth": [found.growth],
        GROWTH: [found.growth],
    }


def _law(x: RecipeInputs, task: Task, single: Sequence[str], *names: str) -> tuple[Row, Row, Goal, Gains]:
    """State, goal and gains of a control law; gains in `single` are one number for all components."""
    given, m = x.arguments, len(task.rows)
    p, d = (tuple(given[name]) * m if name in single else given[name] for name in names)
    k_null = given.get("k_null")
    gains = Gains(p, d) if k_null is None else Gains(p, d, given["q_null"], k_null[0])
    X, zero = pose_of_any_norm(given["X_des"]), (0.0,) * 6
    goal = Goal(X, *[as_screw(given.get(name, zero)) for name in ("V_des", "A_des")])
    return given["q"], given["qd"], goal, gains


def operational_space_control(x: RecipeInputs, name: str, expressed: str, axes: str, *marks: str) -> Results:
    """Torques under which the error of a frame obeys e'' + kd e' + kp e = 0."""
    x.require_inertia()
    task, damping = task_of(x, name, expressed, axes), x.arguments.get("damping")
    effort = [e if e > 0 else math.inf for e in x.robot.limits.effort.tolist()] if "limits" in marks else None
    law = _law(x, task, marks, "kp", "kd")
    tau, growth = operational_space_torques(x.posed(), task, *law, damping and damping[0], effort)
    return {"tau": tau, GROWTH: [growth]}


def cartesian_impedance(x: RecipeInputs, name: str, expressed: str, axes: str, *marks: str) -> Results:
    """Torques of a spring and a damper at a frame, with those that hold the robot."""
    x.require_inertia()
    task = task_of(x, name, expressed, axes)
    law = _law(x, task, marks, "stiffness", "damping")
    tau, growth = impedance_torques(x.posed(), task, *law, DAMPING, "gravity" not in marks)
    return {"tau": tau, GROWTH: [growth]}


def coriolis_matrix(x: RecipeInputs) -> Results:
    """Torques whose derivatives by the velocities are C: half of those of c, and of the acceleration [V, V_WB_B].

    V is the twist of a floating base, held where they are differentiated: twists are not rates of coordinates, and the
    bracket of two of them is left when they change places.
    """
    v, held, bracket = x.velocities() or (), x.arguments.get(HELD.name), None
    if held is not None:
        V = screw.cross(as_screw(held), as_screw(v[:6]))
        bracket = (*V[0], *V[1], *[0.0] * x.robot.n)
    c: list[Number] = numbers(x.posed().without_gravity().torques(v, bracket, None))
    return {"c": [0.5 * x for x in c]}


def manipulability(x: RecipeInputs, name: str, expressed: str, axes: str) -> Results:
    """Square root of det J J^T."""
    return {"w": [task_space.manipulability(x.posed(), task_of(x, name, expressed, axes))]}


def contact_force(x: RecipeInputs, name: str, expressed: str, axes: str) -> Results:
    """Force F at a frame that exerts the torques r, and how much of each of its components these show."""
    task = task_of(x, name, expressed, axes)
    J = task._replace(rows=tuple(range(6))).jacobian(x.posed())
    F, part, growth = observer.force(J, task.rows, x.arguments["r"], x.arguments["damping"][0])
    return {"F": F, "part": part, GROWTH: [growth]}
