"""Experiment 7: exponential and logarithm beside the naive ones, which divide by the sine and take the arc cosine.

Same tensors in, same tensors out, both as torch operations. Truth is mpmath on the numbers as they are given.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import torch
from torch import Tensor

import torchdq
from accuracy.clock import clock

ANGLES = (0.0, 1e-8, 1e-6, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 1.0, 2.0, 3.0, 3.14)
BATCH, SAMPLES = 4096, 8


def naive_exp(a: Tensor) -> Tensor:
    """exp(a) by sin h / h and its derivative as they are written."""
    v, m = a[..., :3], a[..., 3:]
    h = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    s, c = h.sin(), h.cos()
    inner = (v * m).sum(-1, keepdim=True)
    return torch.cat([c, s / h * v, -s / h * inner, s / h * m + (c - s / h) / (h * h) * inner * v], -1)


def naive_log(x: Tensor) -> Tensor:
    """log(x) by the arc cosine of the real part, along the imaginary one."""
    w, v, dw, dv = x[..., :1], x[..., 1:4], x[..., 4:5], x[..., 5:]
    h = torch.acos(w.clamp(-1, 1))
    s = torch.linalg.vector_norm(v, dim=-1, keepdim=True) / h
    a, inner = v / s, -dw / s
    return torch.cat([a, (dv - (w - s) / (h * h) * inner * a) / s], -1)


MAPS: dict[str, Callable[[Tensor], Tensor]] = {
    "exp": torchdq.dq.exp,
    "naive exp": naive_exp,
    "log": torchdq.dq.log,
    "naive log": naive_log,
}


def exact_exp(a: Any) -> list[Any]:
    """exp of six numbers in mpmath."""
    v, m = a[:3], a[3:]
    h = mpmath.sqrt(sum(x * x for x in v)) or mpmath.mpf(10) ** -40  # the limit at zero, to 80 digits
    c, s = mpmath.cos(h), mpmath.sin(h) / h
    inner = sum(x * y for x, y in zip(v, m, strict=True))
    k = (c - s) / (h * h) * inner
    return [c, *(s * x for x in v), -s * inner, *(s * y + k * x for x, y in zip(v, m, strict=True))]


def exact_log(x: Any) -> list[Any]:
    """log of eight numbers in mpmath, made unit first."""
    size = mpmath.sqrt(sum(y * y for y in x[:4]))
    p, d = [y / size for y in x[:4]], [y / size for y in x[4:]]
    along = sum(y * z for y, z in zip(p, d, strict=True))
    d = [z - along * y for y, z in zip(p, d, strict=True)]
    h = mpmath.atan2(mpmath.sqrt(sum(y * y for y in p[1:])), p[0]) or mpmath.mpf(10) ** -40
    s = mpmath.sin(h) / h
    a, inner = [y / s for y in p[1:]], -d[0] / s
    k = (p[0] - s) / (h * h) * inner
    return [*a, *((y - k * z) / s for y, z in zip(d[1:], a, strict=True))]


def _worst(found: np.ndarray, truth: np.ndarray) -> float | None:
    """Largest relative error of primary and dual parts, apart so that neither hides the other's; None: not finite."""
    if not np.isfinite(found).all():
        return None
    half = found.shape[-1] // 2
    sizes = [np.linalg.norm(truth[:, part], axis=1) for part in (slice(half), slice(half, None))]
    errors = [np.linalg.norm((found - truth)[:, part], axis=1) for part in (slice(half), slice(half, None))]
    return max(float((e / np.where(s == 0, 1, s)).max()) for e, s in zip(errors, sizes, strict=True))


def measured(quick: bool) -> dict[str, Any]:
    """Errors by map, precision and angle, times by map and precision, and how many times the naive ones take."""
    generator = torch.Generator().manual_seed(0)
    line = torch.nn.functional.normalize(torch.randn(BATCH, 3, generator=generator, dtype=torch.float64), dim=-1)
    moment = torch.randn(BATCH, 3, generator=generator, dtype=torch.float64)
    errors, times = [], []
    for dtype in (torch.float32, torch.float64):
        name = str(dtype).removeprefix("torch.")
        for angle in ANGLES:
            a = torch.cat([0.5 * angle * line, 0.5 * moment], -1)[:SAMPLES].to(dtype)
            x = torchdq.dq.exp(a.double()).to(dtype)
            for which, call in MAPS.items():
                given, exact = (a, exact_exp) if "exp" in which else (x, exact_log)
                with mpmath.workdps(150):
                    truth = np.array(
                        [[float(y) for y in exact([mpmath.mpf(z) for z in row])] for row in given.tolist()]
                    )
                found = call(given).double().numpy()
                worst = _worst(found, truth)
                point = {"map": which, "precision": name, "angle": angle, "error_max": worst}
                errors.append(point)
        turns = torch.rand(BATCH, 1, generator=generator, dtype=torch.float64) * 3
        a = torch.cat([0.5 * turns * line, 0.5 * moment], -1).to(dtype)
        x = torchdq.dq.exp(a)
        for which, call in MAPS.items():
            given = a if "exp" in which else x
            time = clock(lambda call=call, given=given: call(given), BATCH, repeats=20 if quick else 100)
            times.append({"map": which, "precision": name, **time._asdict()})
    taken = {(t["map"], t["precision"]): t["nanoseconds"] for t in times}
    ratios = {
        f"{which}, {precision}": taken[which, precision] / taken[f"naive {which}", precision]
        for which in ("exp", "log")
        for precision in ("float32", "float64")
    }
    return {"errors": errors, "times": times, "ratios": ratios}
