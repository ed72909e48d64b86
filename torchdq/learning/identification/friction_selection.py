"""Choice of friction: terms that a joint gains from on blocks that were left out, one after the other.

A fit to all blocks but one is a ridge regression on sums, in which the coefficients of every joint are eliminated. A
term more at a joint then changes the solution by a multiple of one vector, so that all terms of all joints are tried at
once.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.learning.identification.base_parameters import inverse_of
from torchdq.learning.identification.evidence import Evidence
from torchdq.learning.identification.regression import parted
from torchdq.learning.identification.terms import COULOMB, VISCOUS, rows_of

GAIN = 0.02  # least part of a joint's squared residual that a term must take away
ROUNDS = 4  # most terms that a joint gains
SIMPLE = (VISCOUS, COULOMB)  # friction that files of robots have


class Gain(NamedTuple):
    """Term that a joint gains from: squared residual over variance that it takes away on blocks left out."""

    term: str
    joint: str
    gain: float
    error: float  # standard error over blocks


def gainful(
    evidence: Evidence,
    variance: Tensor,  # [n] variances of the residuals, times their correlation times
    estimated: Tensor,  # [terms, n] coefficients that are estimated already
    candidates: Sequence[int],  # terms to choose from
    strength: float,  # prior of the bodies; infinite: they stay as described
    sure: float = 1.0,  # standard errors that a gain must have
) -> tuple[Tensor, list[Gain]]:
    """Coefficients that are estimated [terms, n], with those of candidates that gain, and the gains."""
    if not candidates:
        return estimated, []
    near = evidence.near(torch.ones_like(estimated), strength)
    n, b, terms, blocks = len(variance), near.inertial, evidence.terms, len(evidence.left)
    inertial, scale = evidence.at.shape[1] - len(terms), near.start.reshape(len(terms), n).T
    described = near.zero[-len(near.start) :].reshape(len(terms), n).T
    units = torch.cat([scale, torch.ones_like(scale[:, :1])], 1)[:, None]  # of the columns that follow those of bodies

    def by_coordinates(sums: Tensor) -> Tensor:
        """Columns of sums [..., n, p + 1, p + 1] per unit of y, as rows."""
        return torch.cat([sums[..., :inertial] @ near.S[:inertial, :b], sums[..., inertial:] * units], -1).mT

    M = by_coordinates(by_coordinates(evidence.folds)) / variance[:, None, None]
    left, sizes = by_coordinates(by_coordinates(evidence.left)), evidence.sizes[..., None]
    own, at = M[:, :, b:-1], torch.tensor(candidates, dtype=torch.long)
    one = torch.eye(len(terms), dtype=M.dtype)
    signed = torch.tensor([terms[c].signed for c in candidates])
    fraction = torch.tensor([terms[c].fraction for c in candidates])
    possible = evidence.identifiable.T[:, at] & (scale[:, at] > 0)

    estimated, gains, open_joints = estimated.T.clone(), list[Gain](), torch.ones(n, 1, dtype=torch.bool)
    for round_ in range(ROUNDS):
        evidence.say(f"friction, round {round_ + 1} of at most {ROUNDS}")
        used = (estimated & (scale > 0)).to(M)[..., None]
        X = torch.linalg.solve(used * own[..., b:-1] * used.mT + one, used * own)  # coefficients, by column
        rest = M - own.mT @ X
        H = rest[..., :b, :b].sum(1) + torch.eye(b, dtype=M.dtype)
        r, more = rest[:, :, b + at, :b], rest[:, :, b + at, -1]
        right = torch.cat([rest[..., :b, -1].sum(1)[:, None], r.flatten(1, 2)], 1)
        y, U = (torch.linalg.solve(H, right.mT).mT if b else right).split([1, n * len(at)], 1)
        U = U.unflatten(1, (n, -1))
        pivot = 1 + rest[:, :, b + at, b + at] - (r * U).sum(-1)
        x = (more - (r @ y.mT[:, None])[..., 0]) / pivot  # coefficient of each candidate
        by = own.new_zeros(*x.shape, M.shape[-1])  # change of the residual's columns per unit of it
        by[..., :b] = U
        by[..., b:-1] = X[..., b + at].mT - U @ X[..., :b].mT - one[at]
        e = torch.cat([-y[:, None].expand(-1, n, -1, -1), (X[..., :b] @ y[:, None].mT - X[..., -1:]).mT], -1)
        e = torch.cat([e, torch.ones_like(e[..., :1])], -1)[:blocks]
        before, after = (((z @ left) * z).sum(-1) / sizes for z in (e, e + x[:blocks, ..., None] * by[:blocks]))
        less, number = before - after, described[:, at] + scale[:, at] * x[-1]
        mean, error = less.mean(0), less.std(0) / blocks**0.5
        real = (signed | (number > 0)) & (~fraction | (number < 1)) & possible & ~estimated[:, at] & open_joints
        mean = torch.where(real & (mean > (sure * error).maximum(GAIN * before.mean(0))), mean, 0.0)
        best, choice = mean.max(1)
        for j in best.nonzero()[:, 0].tolist():
            c = candidates[int(choice[j])]
            estimated[j, c] = True
            gains.append(Gain(terms[c].name, evidence.robot.joint_names[j], float(best[j]), float(error[j, choice[j]])))
        open_joints = best[:, None] > 0
        if not bool(open_joints.any()):
            break
    return estimated.T, gains


def simple_friction(evidence: Evidence, parameters: Tensor) -> Tensor:
    """Viscous and Coulomb friction [2, n] nearest to the torque of all friction among parameters [k], neither negative.

    Files have no other friction. Joints without friction of other shapes keep what was found.
    """
    robot, terms = evidence.robot, evidence.terms
    own = parted(robot, parameters)[1]
    rows = [own[terms.index(term)] if term in terms else getattr(robot, term.described).to(own) for term in SIMPLE]
    known = torch.stack(rows)
    friction = [k for k, term in enumerate(terms) if term.law is not None]
    if not friction:
        return known
    tau = (evidence.own[..., friction] * own[friction].T.to(evidence.own)).sum(-1)
    sign = rows_of(robot, evidence.recording, evidence.sign_width).sign
    X = torch.stack([evidence.recording.qd.T, sign.T], -1)
    nearest = _nonnegative((X.mT @ X).cpu(), (X.mT @ tau.T[..., None])[..., 0].cpu())
    others = [k for k in friction if terms[k] not in SIMPLE]
    return torch.where((own[others] != 0).any(0), nearest.T, known)


def _nonnegative(A: Tensor, b: Tensor) -> Tensor:
    """Minima [n, 2] of x A x - 2 b x over x that are not negative, A [n, 2, 2] being positive semidefinite."""
    alone = torch.diag_embed(b * inverse_of(A.diagonal(dim1=-2, dim2=-1)))
    both = torch.linalg.pinv(A, hermitian=True) @ b[..., None]
    tried = torch.cat([alone, both.mT], 1).clamp_min(0)
    cost = torch.einsum("jip,jpq,jiq->ji", tried, A, tried) - 2 * torch.einsum("jp,jip->ji", b, tried)
    return tried[torch.arange(len(b)), cost.argmin(1)]
