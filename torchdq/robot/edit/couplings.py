"""Linear couplings of joints, solved for the joints that stay free: each other joint follows one of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torchdq.errors import DescriptionError

SLACK = 1e-6  # couplings that agree to this say one thing twice: files are printed with about six digits


class Follows(NamedTuple):
    """Displacement of a joint: factor times that of its leader plus offset."""

    leader: Any  # row or name of a joint, which may be the joint itself; None: the joint stands still at the offset
    factor: float
    offset: float  # [rad or m]

    def after(self, leader: Follows) -> Follows:
        """Displacement by the leader's leader."""
        factor = self.factor * leader.factor
        return Follows(leader.leader if factor else None, factor, self.factor * leader.offset + self.offset)


STILL = Follows(None, 0.0, 0.0)


def solved(joints: int, held: Mapping[int, float], couplings: Sequence[tuple[str, int, Follows]]) -> list[Follows]:
    """Displacement of every joint by those that stay free; a leader stays free where it can.

    Args:
        joints: number of joints.
        held: displacements [rad or m] of joints that are locked.
        couplings: equations between joints, each with its name and the joint that follows by it; one between two locked
            joints is left out.

    Raises:
        DescriptionError: couplings contradict each other.

    >>> solved(2, {}, [("fingers", 1, Follows(0, -1.0, 0.0))])
    [Follows(leader=0, factor=1.0, offset=0.0), Follows(leader=0, factor=-1.0, offset=0.0)]
    """
    found = [Follows(None, 0.0, held[i]) if i in held else Follows(i, 1.0, 0.0) for i in range(joints)]
    causes: list[tuple[str, ...]] = [("`lock`",) if i in held else () for i in range(joints)]  # in words
    for name, follower, (leader, factor, offset) in couplings:
        if follower in held and (leader is None or leader in held):
            continue
        a, b = found[follower], STILL if leader is None else found[leader]
        behind = (*causes[follower], *(() if leader is None else causes[leader]))
        # a.factor r_a = slope r_b + rest, with the displacements r_a and r_b of the free joints
        slope, rest = factor * b.factor, factor * b.offset + offset - a.offset
        if a.leader is not None and a.leader != b.leader:
            joint, by = a.leader, Follows(b.leader, slope / a.factor, rest / a.factor)
        elif b.leader is not None and abs(a.factor - slope) > SLACK * max(abs(a.factor), abs(slope)):
            joint, by = b.leader, Follows(None, 0.0, rest / (a.factor - slope))
        elif abs(rest) > SLACK:
            others = " and ".join(dict.fromkeys(behind)) or "itself"
            raise DescriptionError(
                f"the coupling {name!r} must agree with {others}, found that it is {rest:g} rad or m off wherever the "
                "joints are; leave one of them out"
            )
        else:
            continue
        reasons = (*behind, f"the coupling {name!r}")
        moved = [x.leader == joint for x in found]
        causes = [(*dict.fromkeys((*x, *reasons)),) if moves else x for x, moves in zip(causes, moved, strict=True)]
        found = [x.after(by) if x.leader == joint else x for x in found]
    return found
