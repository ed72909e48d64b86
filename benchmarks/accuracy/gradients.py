"""Experiment 3: the gradient of a rollout, by several ways and in two precisions: error, time, bytes kept.

The loss is the sum of squares of the positions after 50 steps of a seven-joint arm, its gradient that in the initial
state and in one torque that is held. Truth is the complex step in extended precision on torchdq's own formulas; its
check are extrapolated central differences on a textbook's.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from accuracy import fits, peers
from accuracy.clock import clock
from accuracy.rows import LONG, Formulas
from accuracy.scenes import arm7
from accuracy.textbook import Textbook
from torchdq import Scene
from torchdq.scene import integrators

STEPS, DT, SEGMENT = 50, 1 / 256, 10
EPSILON = 1e-4  # the best of MuJoCo's differences
BATCH = {"eager": 64, "compiled": 4096}  # samples of a timed call
Array = np.ndarray


def rolled(acceleration: Callable[..., Array], x: Array) -> Array:
    """Loss of rows [..., 3 n]: q, qd and the torque that is held."""
    q, qd, torque = np.split(x, 3, -1)
    for _ in range(STEPS):
        qd = qd + LONG(DT) * acceleration(q, qd, torque)
        q = q + LONG(DT) * qd
    return (q * q).sum(-1)


def truth(x: Array) -> tuple[Array, float]:
    """Gradient of rows [batch, 3 n], and how well two ways agree on it."""
    case, unit = arm7(), np.eye(x.shape[-1], dtype=LONG)
    h = LONG(1e-30)
    shifted = x[:, None].astype(np.clongdouble) + 1j * h * unit
    by_complex = rolled(Formulas(case), shifted).imag / h
    book = Textbook.of(case)
    differences = []
    for k in range(3):  # Richardson: errors of orders 2 and 4 in the step go
        step = LONG(2.0**-9) / 2**k
        up, down = (rolled(book, x[:, None].astype(LONG) + sign * step * unit) for sign in (1, -1))
        differences.append((up - down) / (2 * step))
    a, b = ((4 * fine - coarse) / 3 for coarse, fine in pairwise(differences))
    by_difference = (16 * b - a) / 15
    return by_complex, float(fits.relative(by_difference, by_complex).max())


def loss(scene: Scene, x: Tensor, checkpoint: int = 0) -> Tensor:
    """Loss of rows [batch, 3 n]."""
    q, qd, torque = x.chunk(3, -1)
    return (
        scene.rollout(scene.start(q, qd), torque.expand(STEPS, *torque.shape), checkpoint=checkpoint)
        .q[-1]
        .square()
        .sum(-1)
    )


def reverse(scene: Scene, x: Tensor, checkpoint: int = 0) -> Tensor:
    """Gradient by reverse mode."""
    x = x.detach().requires_grad_()
    return torch.autograd.grad(loss(scene, x, checkpoint).sum(), x)[0]


def differences(scene: Scene, x: Tensor, step: float) -> Tensor:
    """Gradient by central differences, all rows at once."""
    unit = step * torch.eye(x.shape[-1], dtype=x.dtype)
    rows = torch.cat([x[:, None] + unit, x[:, None] - unit])
    up, down = loss(scene, rows).chunk(2)
    return (up - down) / (2 * step)


def kept(scene: Scene, x: Tensor, checkpoint: int = 0) -> float:
    """Bytes per sample that wait for the backward pass."""
    storages: dict[int, int] = {}
    alive = []  # so that no address is used twice

    def pack(y: Tensor) -> Tensor:
        storages[y.untyped_storage().data_ptr()] = y.untyped_storage().nbytes()
        alive.append(y)
        return y

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda y: y):
        loss(scene, x.detach().requires_grad_(), checkpoint)
    if checkpoint:
        # a segment keeps the state at its start, which no hook sees
        n = scene.n
        storages[-1] = STEPS // checkpoint * 2 * n * x.element_size() * len(x)
    return sum(storages.values()) / len(x)


def measured(quick: bool) -> dict[str, Any]:
    """Errors, times and bytes by way and precision."""
    case = arm7()
    scene = Scene(case.robot, case.effects, integrator=integrators.SemiImplicitEuler(), dt=DT)
    eager = scene.replace(backend="eager")
    x = torch.cat([case.q, case.qd, case.torque[0]], -1)
    exact, agreement = truth(x.numpy())
    points = []
    for dtype in (torch.float32, torch.float64):
        small = x.to(dtype)
        steps = [10.0**-k for k in range(1, 6 if dtype == torch.float32 else 9)]
        tried = {h: float(fits.relative(differences(scene, small, h).double().numpy(), exact).max()) for h in steps}
        best = min(tried, key=tried.__getitem__)
        ways: dict[str, tuple[Callable[[Tensor], Tensor], int, float | None]] = {
            "compiled reverse": (lambda y: reverse(scene, y), BATCH["compiled"], kept(scene, small)),
            "compiled reverse, one arm": (lambda y: reverse(scene, y), 1, None),
            "compiled reverse, checkpointed": (
                lambda y: reverse(scene, y, SEGMENT),
                BATCH["compiled"],
                kept(scene, small, SEGMENT),
            ),
            "autograd of torch operations": (lambda y: reverse(eager, y), BATCH["eager"], kept(eager, small)),
            "finite differences, best step": (
                lambda y, h=best: differences(scene, y, h),
                BATCH["compiled"] // 16,
                None,
            ),
        }
        for way, (call, batch, held) in ways.items():
            errors = fits.relative(call(small).double().numpy(), exact)
            rows = small[torch.arange(batch) % len(small)]
            slow = quick and way.startswith("autograd")
            time = clock(lambda call=call, rows=rows: call(rows), batch, repeats=3 if slow else 10 if quick else 20)
            points.append(
                {
                    "way": way,
                    "precision": str(dtype).removeprefix("torch."),
                    **fits.judged(errors, 10 * agreement),
                    **time._asdict(),
                    "batch": batch,
                    "bytes": held,
                    "step": best if way.startswith("finite") else None,
                }
            )
    others = {
        "Pinocchio, derivatives of every step": (lambda y: peers.by_pinocchio(y, STEPS, DT), None),
        "MuJoCo, finite differences of every step": (lambda y: peers.by_mujoco(y, STEPS, DT, EPSILON), EPSILON),
    }
    for way, (call, step) in others.items():
        errors = fits.judged(fits.relative(call(x.numpy()), exact), 10 * agreement)
        time = clock(lambda call=call: call(x.numpy()), len(x))._asdict()
        found = {"way": way, "precision": "float64", **errors, **time, "batch": 1, "bytes": None, "step": step}
        points.append(found)
    return {"steps": STEPS, "dt": DT, "agreement": agreement, "points": points}
