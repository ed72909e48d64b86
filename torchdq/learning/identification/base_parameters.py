"""Base parameters: the combinations of parameters that torques depend on, and their names."""

from collections.abc import Sequence

import torch
from torch import Tensor

SEPARATE = 1e-12  # least eigenvalue, relative to the largest, of a base parameter, for columns of size one


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
    base = size[chosen, None] * base * inverse_of(size)
    base = torch.where((base * size).abs() > 1e-8 * size[chosen, None], base, 0.0)
    base[:, chosen] = torch.eye(rank, dtype=base.dtype)
    return base


def base_of(Z: Tensor) -> tuple[Tensor, Tensor]:
    """Base parameters [rank, k] that torques per unit Z [rows, k] identify, and the sizes [k] of its columns."""
    size = Z.square().mean(0).sqrt()
    size = torch.where(size > 1e-12 * size.max(), size, 0.0)
    Z = Z * inverse_of(size)
    e, V = torch.linalg.eigh(Z.T @ Z)
    return base_parameters(V[:, e > SEPARATE * e[-1]].T * size, inverse_of(size)), size


def inverse_of(size: Tensor) -> Tensor:
    """Inverse of sizes, zero where they are."""
    return torch.where(size > 0, 1 / size, 0.0)


def base_names(base: Tensor, names: Sequence[str], sizes: Tensor, most: int | None = 3) -> tuple[str, ...]:
    """Names of combinations base [rank, k] of parameters with names [k]: `link2 Izz + 0.0825 link3 mx`.

    The parameter whose factor is one leads; the others follow by their factor times `sizes` [k], up to `most` terms.
    """
    found = []
    for row in base:
        lead = int((row == 1).nonzero()[0]) if bool((row == 1).any()) else int(row.abs().argmax())
        others = [i for i in row.nonzero()[:, 0].tolist() if i != lead]
        terms = [names[lead]]
        for i in sorted(others, key=lambda i: -abs(float(row[i] * sizes[i])))[: most and most - 1]:
            size = f"{abs(float(row[i])):.3g} " if abs(abs(float(row[i])) - 1) > 1e-6 else ""
            terms.append(f"{'-' if row[i] < 0 else '+'} {size}{names[i]}")
        found.append(" ".join(terms) + (" ..." if len(others) >= len(terms) else ""))
    return tuple(found)
