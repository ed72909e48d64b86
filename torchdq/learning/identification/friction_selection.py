"""Choice of friction: terms that a joint gains from on blocks that were left out, one after the other.

A fit to all blocks but one is a ridge regression on sums, in which the coefficients of every joint are eliminated, so
that a term more at a joint changes that joint's part alone.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.learning.identification.evidence import Evidence

GAIN = 0.02  # least part of a joint's squared residual that a term must take away
ROUNDS = 4  # most terms that a joint gains


class Gain(NamedTuple):
    """Term that a joint gains from: squared residual over variance that it takes away on blocks left out."""

    term: str
    joint: str
    gain: float
    error: float  # standard error over blocks


class _Fit(NamedTuple):
    """Parameters without the coefficients of a joint, and how these follow from them."""

    H: Tensor  # [folds, b, b]
    h: Tensor  # [folds, b]
    own: list[int]  # rows of the joint's coefficients
    X: Tensor  # [folds, coefficients, columns]

    def coefficients(self, y: Tensor) -> Tensor:
        """Coefficients [folds, coefficients] for bodies y [folds, b]."""
        b = y.shape[1]
        return self.X[..., -1] - (self.X[..., :b] @ y[..., None])[..., 0]

    def errors(self, y: Tensor) -> Tensor:
        """Weights of the columns in the residual [folds, columns]."""
        e = torch.zeros(len(y), self.X.shape[-1], dtype=y.dtype)
        e[:, : y.shape[1]] = -y
        e[:, self.own] = -self.coefficients(y)
        e[:, -1] = 1
        return e


def gainful(
    evidence: Evidence,
    variance: Tensor,  # [n] variances of the residuals, times their correlation times
    estimated: Tensor,  # [terms, n] coefficients that are estimated already
    candidates: Sequence[int],  # terms to choose from
    strength: float,  # prior of the bodies; infinite: they stay as described
) -> tuple[Tensor, list[Gain]]:
    """Coefficients that are estimated [terms, n], with those of candidates that gain, and the gains."""
    near = evidence.near(torch.ones_like(estimated), strength)
    n, b, p = len(variance), 10 * len(near.links), evidence.at.shape[1]
    inertial = p - len(estimated)
    scale = near.start.reshape(len(estimated), n)
    basis = torch.zeros(n, p + 1, b + len(estimated) + 1, dtype=torch.float64)
    basis[:, :inertial, :b] = near.S[:inertial, :b]
    basis[:, inertial:p, b:-1] = torch.diag_embed(scale.T)
    basis[:, -1, -1] = 1
    sums = torch.cat([evidence.folds, evidence.total[None]])
    M = basis.mT @ sums @ basis / variance[:, None, None]
    left, blocks = basis.mT @ evidence.left @ basis, len(evidence.left)

    def fit(j: int, mask: Tensor) -> _Fit:
        own = (b + mask.nonzero()[:, 0]).tolist()
        rows = M[:, j, own]
        X = torch.linalg.solve(rows[:, :, own] + torch.eye(len(own), dtype=M.dtype), rows)
        rest = M[:, j] - rows.mT @ X
        return _Fit(rest[:, :b, :b], rest[:, :b, -1], own, X)

    def solved(H: Tensor, h: Tensor) -> Tensor:
        return torch.linalg.solve(H + torch.eye(b, dtype=H.dtype), h[..., None])[..., 0] if b else h

    def score(j: int, one: _Fit, y: Tensor) -> Tensor:
        e = one.errors(y)[:blocks]
        return torch.einsum("ks,kst,kt->k", e, left[:, j], e) / evidence.sizes[:, j]

    estimated, gains, open_joints = estimated.clone(), list[Gain](), set(range(n))
    for round_ in range(ROUNDS):
        evidence.say(f"friction, round {round_ + 1} of at most {ROUNDS}")
        fits = [fit(j, estimated[:, j] & (scale[:, j] > 0)) for j in range(n)]
        H, h = torch.stack([one.H for one in fits]).sum(0), torch.stack([one.h for one in fits]).sum(0)
        y = solved(H, h)
        added = list[tuple[int, int, Gain]]()
        for j in sorted(open_joints):
            before = score(j, fits[j], y)
            best: tuple[int, Gain] | None = None
            for c in candidates:
                if estimated[c, j] or not evidence.identifiable[c, j] or not scale[c, j] > 0:
                    continue
                mask = estimated[:, j] & (scale[:, j] > 0)
                mask[c] = True
                more = fit(j, mask)
                y_more = solved(H - fits[j].H + more.H, h - fits[j].h + more.h)
                at = more.own.index(b + c)
                number = float(scale[c, j] * more.coefficients(y_more)[-1, at])
                if (number <= 0 and not evidence.terms[c].signed) or (number >= 1 and evidence.terms[c].fraction):
                    continue
                less = before - score(j, more, y_more)
                mean, error = float(less.mean()), float(less.std() / blocks**0.5)
                if mean > max(error, GAIN * float(before.mean())) and (best is None or mean > best[1].gain):
                    best = (c, Gain(evidence.terms[c].name, evidence.robot.joint_names[j], mean, error))
            if best is not None:
                added.append((j, *best))
        open_joints = {j for j, *_ in added}
        for j, c, gain in added:
            estimated[c, j] = True
            gains.append(gain)
        if not added:
            break
    return estimated, gains
