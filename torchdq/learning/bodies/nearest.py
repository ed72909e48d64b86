"""Bodies and coefficients nearest to given ones that explain measurements, for many robots at once.

With B = C^-1 J C^-T, the change of a link's pseudo-inertia J from the given C C^T, and x, that of a coefficient as a
factor, the minimum of

    |offset + A y|^2 + sum over links of 2 (tr B - log det B - 4) + sum over coefficients of 2 (x - log x - 1)

is found by Newton's method with steps that stay where it is finite: it is convex, and infinite where a body cannot
exist. The coordinates y are the entries of B - 1 of each link (`torchdq.robot.pseudo_inertia`), then the x - 1.
"""

import warnings

import torch
from torch import Tensor

from torchdq.robot.pseudo_inertia import divergence, divergence_slopes, relative

STEPS = 100  # most Newton steps
SETTLED = 1e-6  # decrease of the cost that ends the search
SHORTEST = 1e-9  # step that changes nothing but by rounding


def curvature(y: Tensor, links: int, positive: int) -> tuple[Tensor, Tensor]:
    """Gradient [rows, t] and Hessian [rows, t, t] of the distance."""
    first, second = 10 * links, 10 * links + positive
    slope, blocks = divergence_slopes(relative(y[:, :first].unflatten(1, (links, 10))))
    x = 1 + y[:, first:second]
    H = torch.diag_embed(torch.cat([0 * y[:, :first], 2 / x.square(), torch.full_like(y[:, second:], 2.0)], 1))
    for i in range(links):
        H[:, 10 * i : 10 * i + 10, 10 * i : 10 * i + 10] += blocks[:, i]
    return torch.cat([slope.flatten(1), 2 - 2 / x, 2 * y[:, second:]], 1), H


def nearest(A: Tensor, offset: Tensor, links: int, positive: int) -> Tensor:
    """Minimum y [rows, t] of the cost, with A [rows, measurements, t] and offset [rows, measurements].

    Ten coordinates of each link come first, then x - 1 of positive coefficients; those that are left may have either
    sign, and the distance y^2.
    """
    y, quadratic = A.new_zeros(A.shape[0], A.shape[2]), 2 * A.mT @ A
    first, second = 10 * links, 10 * links + positive

    def cost(y: Tensor) -> Tensor:
        x = 1 + y[:, first:second]
        distance = divergence(relative(y[:, :first].unflatten(1, (links, 10)))).sum(1)
        distance = distance + 2 * (x - 1 - x.log()).sum(1) + y[:, second:].square().sum(1)
        residual = offset + (A @ y[..., None])[..., 0]
        return (residual.square().sum(1) + distance).nan_to_num(nan=torch.inf, posinf=torch.inf)

    moving = torch.ones(len(y), dtype=torch.bool)
    for _ in range(STEPS):
        gradient, H = curvature(y, links, positive)
        gradient = gradient + 2 * ((offset + (A @ y[..., None])[..., 0])[:, None] @ A)[:, 0]
        H = H + quadratic
        scale = H.diagonal(dim1=1, dim2=2).rsqrt()
        factor = torch.linalg.cholesky_ex(scale[:, :, None] * H * scale[:, None]).L
        step = -scale * torch.cholesky_solve((scale * gradient)[..., None], factor)[..., 0]
        expected, before = -(gradient * step).sum(1), cost(y)
        moving = expected > SETTLED + 1e-13 * before
        length = moving.to(y.dtype)
        while bool((worse := moving & (cost(y + length[:, None] * step) > before - 1e-4 * length * expected)).any()):
            length = torch.where(worse, length / 2, length)
            moving = moving & (length > SHORTEST)
        length = torch.where(moving, length, 0.0)
        if not bool(moving.any()):
            return y
        y = y + length[:, None] * step
    warnings.warn(f"{int(moving.sum())} of {len(y)} robots have not settled after {STEPS} steps", stacklevel=3)
    return y
