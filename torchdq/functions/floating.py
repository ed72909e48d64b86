"""Formulas of the functions that only robots with a floating base have.

The velocities are those of the base, its twist V_WB_B (angular, linear), and then those of the coordinates. Generalised
forces have the same order: moment and force on the base, then torques.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.functions.posed import BASE, as_screw
from torchdq.functions.recipe import RecipeInputs, Results


def _centre(x: RecipeInputs) -> tuple[Number, Pure]:
    """Mass of the robot, and its centre of mass in the frame of the base."""
    whole = x.bodies().composites()[0]
    return whole.mass, quat.scale(1.0 / whole.mass, whole.first)


def centre_of_mass(x: RecipeInputs) -> Results:
    """Centre of mass in the world."""
    X_WB = x.base() or dq.ONE
    _, c = _centre(x)
    return {"p_WC": quat.add(dq.translation(X_WB), quat.rotate(X_WB[0], c))}


def _about_centre(x: RecipeInputs, generalised: Sequence[Number | None]) -> Screw:
    """Linear and angular part, about the centre of mass and in axes of the world, of (moment, force) on the base."""
    X_WB = x.base() or dq.ONE
    angular, linear = as_screw([0.0 if e is None else e for e in generalised[:BASE]])
    _, c = _centre(x)
    angular = quat.sub(angular, quat.cross(c, linear))
    return quat.rotate(X_WB[0], linear), quat.rotate(X_WB[0], angular)


def momentum(x: RecipeInputs) -> Results:
    """Linear and angular momentum about the centre of mass, in axes of the world: the first rows of M v."""
    linear, angular = _about_centre(x, x.posed().without_gravity().torques(None, x.velocities(), None))
    return {"linear": linear, "angular": angular}


def momentum_rate(x: RecipeInputs) -> Results:
    """Rates of linear and angular momentum: the wrench that would have to act on the base without gravity."""
    forces = x.posed().without_gravity().torques(x.velocities(), x.accelerations(), None)
    linear, angular = _about_centre(x, forces)
    return {"linear": linear, "angular": angular}
