"""Experiment 5: energy of a double pendulum over a long time, by integrator.

Energies are relative to what the pendulum has above its lowest position. A drift is the mean of the second half less
that of the first; a method that keeps a band has next to none, whatever the band's width.
"""

from __future__ import annotations

import math
from typing import Any

import torch

import torchdq
from accuracy.clock import clock
from accuracy.methods import INTEGRATORS
from torchdq import Scene, effects
from torchdq.scene import State

DT = 1 / 256
SHOWN = 200  # energies that are stored for the plot


def measured(quick: bool) -> dict[str, Any]:
    """Drifts, largest errors and times by integrator and precision."""
    robot = torchdq.robots.load("two_link")
    steps = 10_000 if quick else 100_000
    rows = []
    for integrator in INTEGRATORS:
        for dtype in (torch.float64, torch.float32):
            scene = Scene(robot, (effects.Gravity(),), integrator=INTEGRATORS[integrator], dt=DT)
            start = State(*(torch.tensor(x, dtype=dtype) for x in ((-math.pi / 2 + 0.6, 0.4), (0.0, 0.0))))
            states = scene.rollout(start, steps=steps, nonfinite="ignore").to(torch.float64)
            energies = scene.energy(states).sum(-1)
            first = scene.energy(State(start.q.double(), start.qd.double())).sum()
            rest = State(torch.tensor([-math.pi / 2, 0.0], dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
            error = (energies - first) / (first - scene.energy(rest).sum())
            half = error.reshape(2, -1).mean(1)
            many = State(start.q.expand(4096, 2).contiguous(), start.qd.expand(4096, 2).contiguous())
            time = clock(lambda scene=scene, many=many: scene.step(many), 4096)
            found = {
                "first_half": float(half[0]),
                "second_half": float(half[1]),
                "drift": float(half[1] - half[0]),
                "largest": float(error.abs().max()),
            }
            if not all(map(math.isfinite, found.values())):
                found = dict.fromkeys(found)  # the pendulum has left for infinity
            rows.append(
                {
                    "integrator": integrator,
                    "precision": str(dtype).removeprefix("torch."),
                    **found,
                    **time._asdict(),
                    "curve": [x if math.isfinite(x) else None for x in error[:: steps // SHOWN].tolist()],
                }
            )
    return {"dt": DT, "steps": steps, "rows": rows}
