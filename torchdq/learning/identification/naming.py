"""Names of combinations of parameters as sums, such as `link2 Izz + 0.0825 link3 mx`."""

from collections.abc import Sequence

from torch import Tensor


def sums(base: Tensor, names: Sequence[str], sizes: Tensor) -> tuple[str, ...]:
    """Names of combinations base [rank, k] of parameters with names [k], of at most three terms each.

    The parameter whose factor is one leads; of the others, those of the largest factor times `sizes` [k] are named.
    """
    found = []
    for row in base:
        lead = int((row == 1).nonzero()[0]) if bool((row == 1).any()) else int(row.abs().argmax())
        others = [i for i in row.nonzero()[:, 0].tolist() if i != lead]
        terms = [names[lead]]
        for i in sorted(others, key=lambda i: -abs(float(row[i] * sizes[i])))[:2]:
            size = f"{abs(float(row[i])):.3g} " if abs(abs(float(row[i])) - 1) > 1e-6 else ""
            terms.append(f"{'-' if row[i] < 0 else '+'} {size}{names[i]}")
        found.append(" ".join(terms) + (" ..." if len(others) > 2 else ""))
    return tuple(found)
