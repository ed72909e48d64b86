"""Experiment 4: what each effect of a scene costs, as the scene itself says it."""

from __future__ import annotations

from typing import Any

import torch

import torchdq
from torchdq import Scene, effects
from torchdq.scene import controllers, integrators


def measured(quick: bool) -> dict[str, Any]:
    """Operations and nanoseconds of effects that are added one after the other."""
    robot = torchdq.robots.load("panda")
    parts = (
        effects.Gravity(),
        effects.RotorInertia(0.1),
        effects.Payload(1.0, (0.0, 0.0, 0.1)),
        effects.Viscous(0.5),
        effects.Coulomb(0.5),
        effects.JointLimits(-2.8, 2.8),
        effects.Drag(0.1, 0.1, 0.02),
        effects.Saturation(80.0),
        effects.FirstOrderLag(0.01),
        effects.Noise(1e-3, 1e-2),
    )
    scene = Scene(
        robot, parts, controller=controllers.PD(kp=100.0, kd=20.0), integrator=integrators.LinearlyImplicit(), dt=0.002
    )
    found = scene.describe(4096, torch.float64, seconds=20.0 if quick else 60.0)
    return {
        "costs": [cost._asdict() for cost in found.costs],
        "total": found.total._asdict(),
        "measured_on": found.measured_on,
    }
