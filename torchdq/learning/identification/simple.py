"""Viscous and Coulomb friction instead of all friction found, since URDF and MJCF files hold no other.

A file cannot hold friction of other shapes, such as that in proportion to the load. The viscous and Coulomb
friction that were found together with it are too small alone, often zero. So a file gets the two that come nearest to
the torque of all friction together, by least squares over the samples, with neither of them negative.
"""

import torch
from torch import Tensor

from torchdq.learning.identification.base_parameters import inverse_of
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
