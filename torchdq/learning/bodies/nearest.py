"""Bodies and coefficients nearest to given ones that explain measurements, for many robots at once.

With B = C^-1 J C^-T, the change of a link's pseudo-inertia J from the given C C^T, and x, that of a coefficient as a
factor, they are the minimum of

    |offset + A y|^2 + sum over links of 2 (tr B - log det B - 4) + sum over coefficients of 2 (x - log x - 1),

which is infinite where a body cannot exist. The coordinates y are the entries of B - 1 of each link
(`torchdq.robot.pseudo_inertia`), then the x - 1; coefficients that may have either sign come last, at the distance
(x - 1)^2.
"""

import warnings

import torch
from torch import Tensor

from torchdq.learning.identification.feasible import Distance
from torchdq.learning.identification.regression import Information
from torchdq.learning.identification.solution import ITERATIONS, minimum

SETTLED = 1e-6  # decrease of the cost that ends the search


def of_numbers(links: int, positive: int = 0, signed: int = 0) -> Distance:
    """Distance from so many links and coefficients."""
    return Distance(links, torch.arange(positive + signed) >= positive, torch.zeros(positive + signed).double())


def nearest(near: Distance, A: Tensor, offset: Tensor) -> Tensor:
    """Minimum y [rows, t] of the cost, with A [rows, measurements, t] and offset [rows, measurements]."""
    # singular values, as the eigenvalues of A^T A would have half of the digits
    U, s, Vh = torch.linalg.svd(A)
    s = s.clamp_min(1e-100)
    most = s.shape[1]
    e, w = A.new_zeros(2, len(A), A.shape[2])
    e[:, :most], w[:, :most] = s.square(), -(offset[:, None] @ U)[:, 0, :most] / s
    y, settled = minimum(near, Information(e, Vh.mT, w, A.new_ones(1)), 1.0, torch.zeros_like(w), SETTLED)
    if not settled:
        warnings.warn(f"not all robots have settled after {ITERATIONS} steps", stacklevel=3)
    return y
