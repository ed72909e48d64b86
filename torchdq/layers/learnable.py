"""Quantities that layers may learn: their names, and their values before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdq.errors import ArgumentError, nearest
from torchdq.robot import Robot
from torchdq.robot.argument import require_bodies
from torchdq.robot.fields import SHAPES

# initial value of what the description does not give [SI]
INITIAL = {"armature": 1e-3}
LAYER_TORQUES = ("friction", "offset")  # learned torques that are not those of rigid bodies


def learnable(robot: Robot, learn: Any) -> tuple[str, ...]:
    """Names in `learn`, each once; raises unless all are quantities that the robot has."""
    known = [field for field in SHAPES if getattr(robot, field) is not None or field == "armature"]
    known += LAYER_TORQUES
    names = (learn,) if isinstance(learn, str) else learn
    wrong = [name for name in names if name not in known] if isinstance(names, Sequence) else [learn]
    if wrong:
        raise ArgumentError(
            f"learn must name what robot {robot.name!r} has among {known}, found {wrong[0]!r}{_cure(wrong[0], known)}"
        )
    if "inertia" in names:
        require_bodies(robot, "learning inertias")
    return tuple(dict.fromkeys(names))


def _cure(wrong: Any, known: Sequence[str]) -> str:
    """Cure for a value that is not a learnable quantity."""
    if isinstance(wrong, Mapping):
        return "; it takes names alone, and starts from the numbers of the robot: give others by robot.replace(...)"
    if not isinstance(wrong, str):
        return ""
    if wrong in ("damping", "viscous", "coulomb", "stribeck"):
        return "; 'friction' learns viscous and Coulomb friction, from the damping and the friction of the robot on"
    if wrong in ("kp", "kd"):
        return "; gains are learned by torchdq.ComputedTorque alone"
    close = nearest(wrong, known)
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def initial_values(robot: Robot, name: str) -> dict[str, Tensor]:
    """Quantities that a name in `learn` stands for, without friction, with their initial values."""
    zeros = torch.zeros_like(robot.damping)
    if name == "offset":
        return {name: zeros}
    if name == "armature" and robot.armature is None:
        return {name: zeros + INITIAL[name]}
    return {name: getattr(robot, name).detach().clone()}
