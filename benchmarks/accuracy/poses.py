"""Experiment 6: how often a product of many poses has to be made unit again.

Small motions are multiplied on to a pose; truth is the product of the same numbers in extended precision.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchdq
from accuracy.clock import clock
from accuracy.rows import LONG, joined, split, unit
from torchdq.algebra import dual_quaternion

BATCH = 64


def _never(x: Tensor, k: int) -> Tensor:
    return x


def _always(x: Tensor, k: int) -> Tensor:
    return torchdq.dq.normalize(x)


def _each_100(x: Tensor, k: int) -> Tensor:
    return torchdq.dq.normalize(x) if k % 100 == 99 else x


def _when_off(x: Tensor, k: int) -> Tensor:
    off = ((x[..., :4] * x[..., :4]).sum(-1) - 1).abs().max() > 64 * torch.finfo(x.dtype).eps
    return torchdq.dq.normalize(x) if off else x


POLICIES: dict[str, Callable[[Tensor, int], Tensor]] = {
    "never": _never,
    "every product": _always,
    "every 100": _each_100,
    "when the norm is off by 32 eps": _when_off,
}


def measured(quick: bool) -> dict[str, Any]:
    """Drift of the norm, error of the pose and time per product, by policy and precision."""
    steps = 2_000 if quick else 20_000
    generator = torch.Generator().manual_seed(0)
    twist = 0.01 * torch.randn(BATCH, 6, generator=generator, dtype=torch.float64)
    rows = []
    for dtype in (torch.float32, torch.float64):
        motion = torchdq.dq.exp(twist).to(dtype)
        exact = _product(motion.double().numpy().astype(LONG), steps)
        for policy, renew in POLICIES.items():
            x = motion
            for k in range(steps - 1):
                x = renew(torchdq.dq.mul(x, motion), k)
            p, d = x.double().chunk(2, -1)

            def hundred(renew: Callable = renew, motion: Tensor = motion) -> None:
                y = motion
                for k in range(100):
                    y = renew(torchdq.dq.mul(y, motion), k)

            rows.append(
                {
                    "policy": policy,
                    "precision": str(dtype).removeprefix("torch."),
                    "norm": float((p.square().sum(-1).sqrt() - 1).abs().max()),
                    "orthogonality": float((p * d).sum(-1).abs().max()),
                    "pose": float(np.abs(torchdq.dq.normalize(x).double().numpy() - exact).max()),
                    **clock(hundred, 100 * BATCH, repeats=10 if quick else 20)._asdict(),
                }
            )
    return {"products": steps, "rows": rows}


def _product(motion: np.ndarray, steps: int) -> np.ndarray:
    """Unit product of so many equal motions in extended precision."""
    found, power, left = None, unit(motion), steps
    while left:  # by squaring
        if left % 2:
            found = power if found is None else _mul(found, power)
        power, left = _mul(power, power), left // 2
    return unit(found)


def _mul(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    a, b = split(x), split(y)
    p, d = dual_quaternion.mul((tuple(a[:4]), tuple(a[4:])), (tuple(b[:4]), tuple(b[4:])))
    return np.asarray(joined([*p, *d]))
