"""Least squares for the parameters of a robot: the information in samples, gathered in one small matrix per joint.

Joint torques are linear in the parameters phi, tau = Z(q, qd, qdd) phi, so that the sums of [Z tau]^T [Z tau] hold all
that the samples say, however many there are.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.dynamics.friction import smooth_sign
from torchdq.functional import regressor
from torchdq.robot import Robot

COARSE = 1e-2  # least noise relative to the joint's torques, where there are too few samples to estimate it
EXACT = 1e-5  # least noise relative to the joint's torques otherwise; more weight costs more digits than it gives
FAINT = 1e-3  # weight of the description while the noise is estimated: negligible beside a few samples
INDEPENDENT = 1e-13  # least eigenvalue, relative to the largest, of an identifiable combination: beyond rounding
CHUNK = 2**22  # numbers of the regressor that are held at a time


def chunks(samples: int, numbers: int) -> list[slice]:
    """Slices of the samples, each small enough to hold so many numbers per sample."""
    size = max(1, CHUNK // numbers)
    return [slice(i, i + size) for i in range(0, samples, size)]


def unit_torque(name: str, qd: Tensor, qdd: Tensor, width: float) -> Tensor:
    """Torque [samples, n] per unit of a coefficient of the joints: rotor, viscous, coulomb or offset."""
    return {"rotor": qdd, "viscous": qd, "coulomb": smooth_sign(qd, width), "offset": torch.ones_like(qd)}[name]


def columns(
    robot: Robot,
    q: Tensor,
    qd: Tensor,
    qdd: Tensor,
    coefficients: Sequence[str],
    width: float,
    direction: Tensor | None = None,
) -> Tensor:
    """Regressor Z [samples, n, k]: torque per unit of every parameter; `direction` is that of Coulomb friction."""
    units = {name: unit_torque(name, qd, qdd, width) for name in coefficients}
    if direction is not None and "coulomb" in units:
        units["coulomb"] = direction
    effects = [torch.diag_embed(unit) for unit in units.values()]
    return torch.cat([regressor(robot, q, qd, qdd), *effects], -1)


def gram(
    robot: Robot,
    rows: Sequence[Tensor],
    described: Tensor,
    coefficients: Sequence[str],
    width: float,
    say: Callable[[str], None],
) -> Tensor:
    """Sums [n, k + 1, k + 1] of [Z d]^T [Z d], d being the residual of the described parameters [k].

    `rows` are q, qd, qdd, tau and perhaps the direction of Coulomb friction; `say` is told how many have been read.
    """
    q, qd, qdd, tau, *given = rows
    n, phi = robot.n, described.to(q)
    sums = q.new_zeros(n, len(phi) + 1, len(phi) + 1)
    for part in chunks(len(q), n * len(phi)):
        say(f"{part.start} of {len(q)} samples")
        direction = given[0][part] if given else None
        Z = columns(robot, q[part], qd[part], qdd[part], coefficients, width, direction)
        residual = tau[part] - Z @ phi
        if robot.armature is not None and "rotor" not in coefficients:
            residual -= robot.armature.to(q) * qdd[part]
        Z = torch.cat([Z, residual[..., None]], -1).transpose(0, 1)
        sums += Z.mT @ Z
    return sums.cpu()


class Information(NamedTuple):
    """Sum of e (w - w_0)^2 that the samples add to the cost of y = V w."""

    e: Tensor  # [t], zero where they hold no information
    V: Tensor  # [t, t]
    w: Tensor  # [t] w_0
    noise: Tensor  # [n] standard deviation by which the joints are weighted [N m or N]


def information(sums: Tensor, S: Tensor, squares: Tensor, floor: Tensor, samples: int) -> Information:
    """Least squares with every joint weighted by its noise.

    Weights and solution follow from each other (restricted maximum likelihood): an estimate of the noise divides by
    the samples less the parameters they were spent on. A joint's share of those is its part of the trace of the
    matrix that takes measured torques to fitted ones. `floor` [n] is the least noise.
    """
    A, b, c = S.T @ sums[:, :-1, :-1] @ S, sums[:, :-1, -1] @ S, sums[:, -1, -1]
    squares = squares.clamp_min(1e-6 * float(squares.max()))
    squares = torch.where(squares > 0, squares, 1.0)  # torques that vanish: any weight will do
    # which combinations are identifiable does not depend on the weights, and is clearest where they differ least
    e, Q = torch.linalg.eigh((A / squares[:, None, None]).sum(0))
    identifiable = e > INDEPENDENT * e.amax()
    P = Q[:, identifiable]
    A, b = P.T @ A @ P, b @ P
    least = squares * (EXACT if samples * len(c) >= 2 * P.shape[1] else COARSE) ** 2
    least = least.maximum(floor**2)
    variance = (c / samples).maximum(least)
    for _ in range(50):
        e, V = torch.linalg.eigh((A / variance[:, None, None]).sum(0))
        inverse = (V / (e.clamp_min(0) + FAINT)) @ V.T
        y = inverse @ (b / variance[:, None]).sum(0)
        squared = (c - 2 * b @ y + (A @ y) @ y).clamp_min(0)
        spent = (A * inverse).sum((1, 2)) / variance
        before, variance = variance, (squared / (samples - spent).clamp_min(1e-3 * samples)).maximum(least)
        if float((variance / before - 1).abs().max()) < 1e-3:
            break
    e, V = torch.linalg.eigh((A / variance[:, None, None]).sum(0))
    e = torch.where(e > 1e-15 * e.amax(), e, 0.0)
    w = torch.where(e > 0, V.T @ (b / variance[:, None]).sum(0) / torch.where(e > 0, e, 1.0), 0.0)
    unknown = torch.zeros(int((~identifiable).sum()), dtype=e.dtype)
    V = torch.cat([Q[:, ~identifiable], P @ V], 1)
    return Information(torch.cat([unknown, e]), V, torch.cat([unknown, w]), variance.sqrt())


def base_parameters(R: Tensor, size: Tensor) -> Tensor:
    """Rows [rank, k] with the span of R [rank, k], the identifiable ones, each with a one where all others have a zero.

    The ones are chosen from the first link on, among columns that are nearly as independent of those chosen as any.
    """
    rank = len(R)
    R = R * size
    left, chosen = R.clone(), list[int]()
    for _ in range(rank):
        norms = left.norm(dim=0)
        chosen.append(int((norms > 0.1 * norms.max()).nonzero()[0]))
        direction = left[:, chosen[-1]] / norms[chosen[-1]]
        left -= direction[:, None] * (direction @ left)
        left[:, chosen] = 0
    chosen.sort()
    base = torch.linalg.solve(R[:, chosen], R) if rank else R
    base = size[chosen, None] * base / torch.where(size > 0, size, 1.0)
    base = torch.where((base * size).abs() > 1e-8 * size[chosen, None], base, 0.0)
    base[:, chosen] = torch.eye(rank, dtype=base.dtype)
    return base
