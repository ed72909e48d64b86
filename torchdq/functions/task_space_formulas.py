"""Formulas of the functions of a frame's motion and of its dynamics."""

from __future__ import annotations

from torchdq.algebra import screw
from torchdq.algebra.quaternion import Number
from torchdq.dynamics import observer, task_space
from torchdq.dynamics import posed as mechanics
from torchdq.dynamics.posed import dot
from torchdq.dynamics.task_space import Task, rows_of
from torchdq.functions.posed import as_screw, factors, frame
from torchdq.functions.recipe import RecipeInputs, Results
from torchdq.functions.task_space import numbers, pose_of
from torchdq.program.program import GROWTH, Argument

HELD = Argument("held", 6)  # the twist of a floating base, where derivatives by it are wanted elsewhere


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
