"""Viscous and Coulomb friction instead of all friction found, since URDF and MJCF files hold no other.

A file has no place for friction of other shapes, such as that in proportion to the load. The viscous and Coulomb
friction that were found together with it are too small alone, often zero. So a file gets the two that come nearest to
the torque of all friction together, by least squares over the samples, with neither of them negative.
"""

import torch
from torch import Tensor

from torchdq.learning.identification.evidence import Evidence
from torchdq.learning.identification.regression import parted
from torchdq.learning.identification.terms import COULOMB, VISCOUS, rows_of

SIMPLE = (VISCOUS, COULOMB)


def simple_friction(evidence: Evidence, parameters: Tensor) -> Tensor:
    """Viscous and Coulomb friction [2, n] that come nearest to all friction among parameters [k].

    Joints that have no other friction keep theirs.
    """
    robot, terms = evidence.robot, evidence.terms
    own = parted(robot, parameters)[1]
    rows = [own[terms.index(term)] if term in terms else getattr(robot, term.described).to(own) for term in SIMPLE]
    known = torch.stack(rows)
    friction = [k for k, term in enumerate(terms) if term.effect is not None]
    if not friction:
        return known
    tau = (evidence.own[..., friction] * own[friction].T.to(evidence.own)).sum(-1)
    sign = rows_of(robot, evidence.recording, evidence.sign_width).sign
    columns = torch.stack([evidence.recording.qd, sign], -1)
    nearest = _nonnegative(
        torch.einsum("rjp,rjq->jpq", columns, columns).cpu(), torch.einsum("rjp,rj->jp", columns, tau).cpu()
    )
    others = [k for k in friction if terms[k] not in SIMPLE]
    return torch.where((own[others] != 0).any(0), nearest.T, known)


def _nonnegative(A: Tensor, b: Tensor) -> Tensor:
    """Minima [n, 2] of x A x - 2 b x over x that are not negative, A [n, 2, 2] being positive semidefinite."""
    size = A.diagonal(dim1=-2, dim2=-1)
    alone = torch.where(size > 0, b / torch.where(size > 0, size, 1.0), 0.0).clamp_min(0)
    both = (torch.linalg.pinv(A, hermitian=True) @ b[..., None])[..., 0]
    none = torch.zeros_like(b[:, 0])
    tried = torch.stack([torch.stack([alone[:, 0], none], -1), torch.stack([none, alone[:, 1]], -1), both.clamp_min(0)])
    cost = torch.einsum("ijp,jpq,ijq->ij", tried, A, tried) - 2 * torch.einsum("jp,ijp->ij", b, tried)
    return tried[cost.argmin(0), torch.arange(len(b))]
