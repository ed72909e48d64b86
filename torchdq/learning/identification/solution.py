"""Minimum of the least squares and the prior: the physical robot that explains samples best.

The cost is convex in the parameters, so that there is one minimum, and Newton's method finds it in the manner of
interior-point methods.
"""

import warnings
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.learning.identification.feasible import Distance, Neighbourhood
from torchdq.learning.identification.regression import Information, information, known, shifted, squared

ITERATIONS = 200  # most Newton steps of a minimum
EXACT, NEAR, ROUGH = 1e-12, 1e-6, 1e-3  # part of the prior's weight by which a minimum may be missed; scores need less
ROUNDS = 10  # most times that the joints are reweighted


class Solution(NamedTuple):
    """Parameters that explain samples best."""

    near: Neighbourhood
    y: Tensor  # [t]
    facts: Information
    rms: Tensor  # [n] root mean squares of the residual torques [N m or N]
    settled: bool

    @property
    def parameters(self) -> Tensor:
        """Parameters phi [k]."""
        return self.near.described + self.near.S @ self.y

    def change(self, at: Tensor) -> Tensor:
        """Parameters less the described bodies, at places in phi [n, p]."""
        return self.near.start_of(at) + (self.near.S @ self.y)[at]

    def inflation(self, prior: float) -> float:
        """Factor by which the prior is stronger than the changes found in the bodies make likely, at least one.

        A strength is an expectation of changes of the size 1 / sqrt(strength).
        """
        effective = float((self.facts.e / (self.facts.e + prior)).sum()) - len(self.near.effects)
        return max(1.0, prior * self.near.strength * self.near.apart(self.y) / max(effective, 1.0))

    def spread(self, prior: float, inflation: float = 1.0) -> Tensor:
        """F [k, t], the covariance of the errors being F F^T, linearised at the description.

        It is that of the noise, and of what the prior hides where it is stronger than likely: with e the information
        in a combination of parameters, (e + inflation prior) / (e + prior)^2.
        """
        e = self.facts.e
        return self.near.S @ self.facts.V * ((e + inflation * prior).sqrt() / (e + prior))


def solve(
    near: Neighbourhood,
    sums: Tensor,  # [n, p + 1, p + 1] by `gram` about the described bodies and coefficients of zero, of those samples
    squares: Tensor,  # [n] mean squares of the torques
    independent: Tensor,  # [n] number of independent samples
    at: Tensor,  # [n, p] places of the parameters of each joint
    prior: float = 1.0,  # weight of the distance
    say: Callable[[str], None] = lambda _: None,
    start: Tensor | None = None,  # [t] near the minimum
) -> Solution:
    """Minimum in a neighbourhood, joints being weighted by the noise that it leaves."""
    S, own = near.S[at], shifted(sums, near.start_of(at))
    floor = torch.zeros_like(squares)
    for k in range(ROUNDS):
        say(f"minimum {k + 1} of at most {ROUNDS}")
        facts = information(own, S, squares, floor, independent)
        y, settled = minimum(near, facts, prior, start)
        start = start if settled else y  # a next round goes on from what took too long
        rms = (squared(own, S @ y) / independent).sqrt()
        # least squares may explain a joint by a robot that cannot exist; what a physical one cannot do is noise
        worse = rms > 2 * facts.noise
        floor = torch.where(worse, rms, floor)
        if settled and not bool(worse.any()):
            break
    return Solution(near, y, facts, rms, settled)


def _factor(H: Tensor) -> Tensor:
    """Factors L of H = L L^T, H having diagonals of ones; at the edge of what can exist rounding may need more."""
    for more in (0.0, 1e-15, 1e-13, 1e-11):  # rounding
        L, failed = torch.linalg.cholesky_ex(H + more * torch.eye(H.shape[-1], dtype=H.dtype))
        if not bool(failed.any()):
            return L
    return torch.linalg.cholesky(H)


def changes(
    near: Neighbourhood, sums: Tensor, variance: Tensor, at: Tensor, start: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Minima y [..., t] of sums [..., n, p + 1, p + 1] and a known variance [n], and the parameters less the zero."""
    y, _ = minimum(near, known(sums, near, variance, at), 1.0, start, ROUGH)
    return y, near.start_of(at) + (y @ near.S.T)[..., at]


def minimum(
    near: Distance, facts: Information, prior: float, start: Tensor | None = None, tolerance: float = EXACT
) -> tuple[Tensor, bool]:
    """Minima y [..., t] of the sum of e (w - w_0)^2 and prior * distance, with y = V w, and whether all were reached.

    Newton's method from the description, the weight of the distance falling tenfold at a time; or from a y near by.
    """
    e, V, w_0 = facts.e, facts.V, facts.w
    if not e.shape[-1]:
        return e, True
    w, weight = torch.zeros_like(w_0), e.amax(-1).clamp_min(prior)
    if start is not None:
        by = (V.mT @ start[..., None])[..., 0]
        exists = near.distance((V @ by[..., None])[..., 0]).isfinite()  # rounding may take it beyond
        w, weight = by.where(exists[..., None], 0.0), torch.where(exists, prior, weight)

    def parts(w: Tensor) -> tuple[Tensor, Tensor]:
        return (e * (w - w_0).square()).sum(-1), near.distance((V @ w[..., None])[..., 0])

    squares, distance = parts(w)
    for _ in range(ITERATIONS):
        slope, curvature = near.slopes((V @ w[..., None])[..., 0], V)
        gradient = 2 * e * (w - w_0) + weight[..., None] * slope
        H = torch.diag_embed(2 * e) + weight[..., None, None] * curvature
        scale = H.diagonal(dim1=-2, dim2=-1).rsqrt()  # the samples' part may be 1e20 times the prior's
        factor = _factor(scale[..., None] * H * scale[..., None, :])
        step = -scale * torch.cholesky_solve((scale * gradient)[..., None], factor)[..., 0]
        before, expected, last = squares + weight * distance, -(gradient * step).sum(-1), weight == prior
        settled = expected <= torch.where(last, tolerance, 0.1) * weight + 1e-14 * before
        # a self-concordant cost falls by a part 1 / (1 + lambda) of the step; what must be far shorter is rounding
        shortest = 1e-3 / (1 + (expected.clamp_min(0.0) / weight).sqrt())
        length = torch.where(settled, 0.0, 1.0)
        while True:
            squares, distance = parts(w + length[..., None] * step)
            long = (length > 0) & (squares + weight * distance > before - 1e-4 * length * expected)
            if not bool(long.any()):
                break
            length = torch.where(long, length / 2, length)
            length = torch.where(length < shortest, 0.0, length)
        w, settled = w + length[..., None] * step, length == 0
        if done := bool((settled & last).all()):
            break
        weight = torch.where(settled, (weight / 10).clamp_min(prior), weight)
    return (V @ w[..., None])[..., 0], done


def of_numbers(links: int, positive: int = 0, signed: int = 0) -> Distance:
    """Distance from so many links and coefficients."""
    return Distance(links, torch.arange(positive + signed) >= positive, torch.zeros(positive + signed).double())


def nearest(near: Distance, A: Tensor, offset: Tensor) -> Tensor:
    """Bodies and coefficients y [rows, t] nearest to given ones that explain measurements, for many robots at once.

    They minimise |offset + A y|^2 + distance, with A [rows, measurements, t] and offset [rows, measurements].
    """
    # singular values, as the eigenvalues of A^T A would have half of the digits
    U, s, Vh = torch.linalg.svd(A)
    s = s.clamp_min(1e-100)
    most = s.shape[1]
    e, w = A.new_zeros(2, len(A), A.shape[2])
    e[:, :most], w[:, :most] = s.square(), -(offset[:, None] @ U)[:, 0, :most] / s
    y, settled = minimum(near, Information(e, Vh.mT, w, A.new_ones(1)), 1.0, torch.zeros_like(w), NEAR)
    if not settled:
        warnings.warn(f"not all robots have settled after {ITERATIONS} steps", stacklevel=3)
    return y
