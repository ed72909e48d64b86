"""Experiment 8: a step as torch operations and compiled, by the size of the batch."""

from __future__ import annotations

from typing import Any

import torch

from accuracy.clock import clock
from accuracy.scenes import arm7
from torchdq import Scene
from torchdq.scene import integrators

SIZES = (1, 64, 4096, 65536)


def measured(quick: bool) -> dict[str, Any]:
    """Nanoseconds per step and sample."""
    case = arm7()
    scene = Scene(case.robot, case.effects, integrator=integrators.SemiImplicitEuler(), dt=1 / 256)
    rows = []
    for size in SIZES:
        samples = torch.arange(size) % len(case.q)
        for dtype in (torch.float32, torch.float64):
            state = scene.start(case.q[samples].to(dtype), case.qd[samples].to(dtype))
            torque = case.torque[0][samples].to(dtype)
            for backend in ("c", "eager"):
                by = scene.replace(backend=backend)
                few = quick and backend == "eager" and size > 4096
                time = clock(lambda by=by, s=state, t=torque: by.step(s, t), size, repeats=3 if few else 20)
                row = {"batch": size, "precision": str(dtype).removeprefix("torch."), "backend": backend}
                rows.append({**row, **time._asdict()})
    return {"rows": rows}
