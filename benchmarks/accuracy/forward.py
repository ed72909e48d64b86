"""Experiment 2: error of forward dynamics against the number of joints, by algorithm and precision.

Formulas run on numpy rows of the precision in question, operation by operation, so that nothing has to be compiled for
hundreds of joints; "auto" and "mixed" are the public function. Truth is the mass matrix of a textbook, eliminated in
extended precision, and its check torchdq's in the paper's frames in the same precision, or where that takes too long,
torchdq's articulated bodies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

import torchdq
from accuracy.clock import clock
from accuracy.fits import judged, relative
from accuracy.methods import compiled
from accuracy.rows import LONG, exact, joined, split
from accuracy.scenes import chain, single
from accuracy.textbook import Textbook, solved
from torchdq.errors import SingularInertiaError
from torchdq.functions import formulas, recipe
from torchdq.program.program import Argument, Program, record

Array = np.ndarray
SAMPLES = 4
COMPILED = 42  # joints up to which times are taken
CUBIC = 200  # joints up to which algorithms of cubic cost are tried
CLOSED = 42  # the closed form multiplies matrices of screws


def evaluated(
    formula: Callable, robot: torchdq.Robot, dtype: Any, *options: Any, given: Any = None, **arguments: Array
) -> dict[str, Array]:
    """Results of a formula on rows of a precision; `given` are the robot's numbers, if not its own float64."""
    rows = {name: split(x.astype(dtype)) for name, x in arguments.items()}
    with np.errstate(all="ignore"):
        found = formula(recipe.RecipeInputs(robot, rows, given or {}, ()), *options)
    return {name: joined([0.0 if y is None else y for y in row]) for name, row in found.items()}


def solving(robot: torchdq.Robot, dtype: Any, linear: bool, q: Array, qd: Array, tau: Array) -> Array:
    """Accelerations by the mass matrix and its factors, or by articulated bodies."""
    return evaluated(formulas.forward_dynamics, robot, dtype, linear, q=q, qd=qd, tau=tau)["qdd"]


def checked(robot: torchdq.Robot, cubic: int, q: Array, qd: Array, tau: Array) -> Array:
    """Accelerations by the most precise means that shares nothing with the textbook."""
    if robot.n <= cubic:
        numbers = {name: tuple(x.ravel()) for name, x in exact(robot).items()}
        return evaluated(formulas.forward_dynamics, robot, LONG, False, given=numbers, q=q, qd=qd, tau=tau)["qdd"]
    # articulated bodies take time linear in the joints, but the constants of their frames are float64
    return solving(robot, LONG, True, q, qd, tau)


def closed(robot: torchdq.Robot, dtype: Any, q: Array, qd: Array, tau: Array) -> Array:
    """Accelerations by the paper's closed form and Cholesky's factors."""
    terms = evaluated(formulas.closed_form, robot, dtype, "", q=q, qd=qd)
    M, rest = terms["M"].reshape(*q.shape, q.shape[-1]), tau.astype(dtype) - terms["c"] - terms["g"]
    factor = torch.linalg.cholesky(torch.from_numpy(np.asarray(M, dtype)))
    b = torch.from_numpy(np.ascontiguousarray(rest, dtype))[..., None]
    return torch.cholesky_solve(b, factor)[..., 0].numpy()


def torques(robot: torchdq.Robot, dtype: Any, q: Array, qd: Array, qdd: Array) -> Array:
    """Inverse dynamics."""
    return evaluated(formulas.inverse_dynamics, robot, dtype, q=q, qd=qd, qdd=qdd)["tau"]


def refined(robot: torchdq.Robot, linear: bool, times: int, q: Array, qd: Array, tau: Array) -> Array:
    """Accelerations by factors in float32, corrected by residuals in float64."""
    still = robot.replace(gravity=None)
    found = solving(robot, np.float32, linear, q, qd, tau).astype(np.float64)
    for _ in range(times):
        residual = tau - torques(robot, np.float64, q, qd, found)
        found = found + solving(still, np.float32, linear, q, 0 * qd, residual)
    return found


def public(robot: torchdq.Robot, precision: str, *x: Array) -> Array:
    """torchdq.forward_dynamics on float32."""
    q, qd, tau = (torch.from_numpy(y).float() for y in x)
    return torchdq.forward_dynamics(robot, q, qd, tau, backend="eager", precision=precision).numpy()


METHODS: dict[str, Callable[..., Array]] = {
    "CRBA + LDL, float64": lambda robot, *x: solving(robot, np.float64, False, *x),
    "CRBA + LDL, float32": lambda robot, *x: solving(robot, np.float32, False, *x),
    "articulated bodies, float64": lambda robot, *x: solving(robot, np.float64, True, *x),
    "articulated bodies, float32": lambda robot, *x: solving(robot, np.float32, True, *x),
    "closed form + Cholesky, float64": lambda robot, *x: closed(robot, np.float64, *x),
    "closed form + Cholesky, float32": lambda robot, *x: closed(robot, np.float32, *x),
    "float32, auto": lambda robot, *x: public(robot, "auto", *x),
    "mixed": lambda robot, *x: public(robot, "double", *x),
    "float32 + 1 float64 residual": lambda robot, *x: refined(robot, True, 1, *x),
    "float32 + 2 float64 residuals": lambda robot, *x: refined(robot, True, 2, *x),
}


def too_much(method: str, n: int, cubic: int) -> str | None:
    """Reason why a method is not tried at a number of joints; None: it is."""
    if method.startswith("CRBA") and n > cubic:
        return f"its cost is cubic, and it is tried up to {cubic} joints"
    if method.startswith("closed") and n > CLOSED:
        return f"it multiplies matrices of screws, and is tried up to {CLOSED} joints"
    return None


def measured(quick: bool, full: bool) -> dict[str, Any]:
    """Errors and residuals by method and number of joints, guide lines, times, and what was left out."""
    sizes = (2, 7, 14, 42, 100, 200) if quick and not full else (2, 4, 7, 14, 24, 42, 70, 100, 200, 1000)
    cubic = 100 if quick and not full else CUBIC
    points, guides, omitted = [], [], []
    for n in sizes:
        robot = chain(n)
        samples = SAMPLES if n <= CUBIC else 1
        generator = torch.Generator().manual_seed(n)
        draw = [2 * torch.rand(samples, n, generator=generator, dtype=torch.float64) - 1 for _ in range(3)]
        q, qd, qdd = (single(x).numpy() for x in draw)
        # torques of a motion: random ones would ask for accelerations that no float32 can hold
        tau = single(torch.from_numpy(torques(robot, np.float64, 0.3 * q, qd, qdd))).numpy()
        q = single(torch.from_numpy(0.3 * q)).numpy()
        M, bias = Textbook(robot, robot.gravity.tolist()).terms(q.astype(LONG), qd.astype(LONG))
        truth = solved(M, tau - bias)
        agreement = float(relative(checked(robot, cubic, q, qd, tau), truth).max())
        d = 1 / np.sqrt(np.einsum("...ii->...i", M))
        scaled = np.linalg.cond((d[..., :, None] * M * d[..., None, :]).astype(float)).max()
        growth = evaluated(formulas.error_growth, robot, np.float64, True, q=q)["growth"].max()
        rounded = torques(robot, np.float64, q, qd, truth.astype(np.float32).astype(np.float64))
        guides.append(
            {
                "n": n,
                "kappa_scaled": float(scaled),
                "error_growth": float(growth),
                "agreement": agreement,
                "residual_of_rounded_truth": float(relative(rounded, tau).max()),
            }
        )
        for method, call in METHODS.items():
            reason = too_much(method, n, cubic)
            if reason:
                omitted.append(f"{method} at n = {n}: {reason}")
                continue
            try:
                found = call(robot, q, qd, tau)
            except (torch.linalg.LinAlgError, SingularInertiaError) as error:
                omitted.append(f"{method} at n = {n}: {str(error).splitlines()[0]}")
                continue
            back = torques(robot, np.float64, q, qd, found.astype(np.float64))
            errors = relative(found, truth)
            if not np.isfinite(errors).all():
                omitted.append(f"{method} at n = {n}: not finite")
                continue
            point = {
                "method": method,
                "n": n,
                **judged(errors, 10 * agreement),
                "residual": float(relative(back, tau).max()),
            }
            points.append(point)
    for n in [n for n in sizes if n <= COMPILED]:
        for method, time in _times(n).items():
            for point in points:
                if point["method"] == method and point["n"] == n:
                    point.update(time._asdict())
    return {"points": points, "guides": guides, "omitted": omitted}


def _times(n: int) -> dict[str, Any]:
    """Times per sample of what is compiled."""
    robot, batch = chain(n), 4096 if n <= 14 else 512
    generator = torch.Generator().manual_seed(0)
    wide = [0.3 * (2 * torch.rand(batch, n, generator=generator, dtype=torch.float64) - 1) for _ in range(3)]
    wide[2] = torchdq.inverse_dynamics(robot, *wide)
    narrow = [x.float() for x in wide]
    plain = _unwatched(robot, ("q", "qd", "tau"))
    factors = _unwatched(robot.replace(gravity=None), ("q", "tau"))

    def correct(times: int) -> torch.Tensor:
        x = compiled(plain, narrow)[0].double()
        for _ in range(times):
            residual = wide[2] - torchdq.inverse_dynamics(robot, wide[0], wide[1], x)
            x = x + compiled(factors, [narrow[0], residual.float()])[0]
        return x

    # the public function has the one of the two algorithms that counts fewer operations
    name = "articulated bodies" if _linear_is_cheaper(robot) else "CRBA + LDL"
    return {
        f"{name}, float64": clock(lambda: torchdq.forward_dynamics(robot, *wide), batch),
        f"{name}, float32": clock(lambda: compiled(plain, narrow), batch),
        "float32, auto": clock(lambda: torchdq.forward_dynamics(robot, *narrow), batch),
        "mixed": clock(lambda: torchdq.forward_dynamics(robot, *narrow, precision="double"), batch),
        "float32 + 1 float64 residual": clock(lambda: correct(1), batch),
        "float32 + 2 float64 residuals": clock(lambda: correct(2), batch),
    }


def _unwatched(robot: torchdq.Robot, given: tuple[str, ...]) -> Program:
    """Program of forward dynamics that does not look at how far errors grow."""
    return replace(torchdq.compile(robot, "forward_dynamics", arguments=given).program, growth=None)


def _linear_is_cheaper(robot: torchdq.Robot) -> bool:
    """True if articulated bodies count fewer operations than the mass matrix, where both are considered."""
    if robot.n < recipe.LONG:
        return False
    arguments = [Argument(name, robot.n) for name in ("q", "qd", "tau")]

    def count(linear: bool) -> int:
        def algorithm(*rows: Any) -> dict[str, Any]:
            given = dict(zip(("q", "qd", "tau"), rows, strict=True))
            return formulas.forward_dynamics(recipe.RecipeInputs(robot, given, {}, ()), linear)

        return record("count", arguments, algorithm).count().total

    return count(True) < count(False)
