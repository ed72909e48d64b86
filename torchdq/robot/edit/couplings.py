"""Linear couplings of joints, solved for the joints that stay free: each other joint follows one of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from torchdq.errors import DescriptionError

SLACK = 1e-6  # couplings that agree to this say one thing twice: files are printed with about six digits


class JointCoupling(NamedTuple):
    """Equation between displacements of two joints: that of the follower is factor times the leader's plus offset."""

    name: str
    follower: int
    leader: int | None  # None: the follower stands still at the offset
    factor: float
    offset: float  # [rad or m]


class Follows(NamedTuple):
    """Displacement of a joint: factor times that of a free joint plus offset."""

    root: int | None  # the free joint, which may be the joint itself; None: the joint stands still
    factor: float
    offset: float  # [rad or m]


def solved(joints: int, held: Mapping[int, float], couplings: Sequence[JointCoupling]) -> list[Follows]:
    """Displacement of every joint by those that stay free; a leader stays free where it can.

    Args:
        joints: number of joints.
        held: displacements [rad or m] of joints that are locked.
        couplings: equations between joints; one between two locked joints is left out.

    Raises:
        DescriptionError: couplings contradict each other.

    >>> solved(2, {}, [JointCoupling("fingers", 1, 0, -1.0, 0.0)])
    [Follows(root=0, factor=1.0, offset=0.0), Follows(root=0, factor=-1.0, offset=0.0)]
    """
    found = [Follows(None, 0.0, held[i]) if i in held else Follows(i, 1.0, 0.0) for i in range(joints)]
    causes: list[tuple[str, ...]] = [("`lock`",) if i in held else () for i in range(joints)]  # in words
    for name, follower, leader, factor, offset in couplings:
        if follower in held and (leader is None or leader in held):
            continue
        a, b = found[follower], Follows(None, 0.0, 0.0) if leader is None else found[leader]
        behind = (*causes[follower], *(() if leader is None else causes[leader]))
        # a.factor r_a = slope r_b + rest, with the displacements r_a and r_b of the free joints
        slope, rest = factor * b.factor, factor * b.offset + offset - a.offset
        if a.root is not None and a.root != b.root:
            joint, by = a.root, Follows(b.root, slope / a.factor, rest / a.factor)
        elif b.root is not None and abs(a.factor - slope) > SLACK * max(abs(a.factor), abs(slope)):
            joint, by = b.root, Follows(None, 0.0, rest / (a.factor - slope))
        elif abs(rest) > SLACK:
            others = " and ".join(dict.fromkeys(behind)) or "itself"
            raise DescriptionError(
                f"the coupling {name!r} must agree with {others}, found that it is {rest:g} rad or m off wherever the "
                "joints are; leave one of them out"
            )
        else:
            continue
        reasons = (*behind, f"the coupling {name!r}")
        moved = [x.root == joint for x in found]
        causes = [(*dict.fromkeys((*x, *reasons)),) if moves else x for x, moves in zip(causes, moved, strict=True)]
        found = _with(found, joint, by)
    return found


def _with(found: Sequence[Follows], joint: int, by: Follows) -> list[Follows]:
    """Displacements with that of a free joint replaced."""
    rows = []
    for x in found:
        if x.root == joint:
            factor = x.factor * by.factor
            x = Follows(by.root if factor else None, factor, x.factor * by.offset + x.offset)
        rows.append(x)
    return rows
