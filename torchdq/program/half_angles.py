"""One sine and one cosine for an angle and its half.

Poses as dual quaternions take the sine and cosine of half of a joint's angle, everything else those of the angle. Where
a program holds both, those of the angle follow from those of the half:

    sin x = 2 sin(x/2) cos(x/2),   cos x = 1 - 2 sin(x/2)^2
"""

from collections.abc import Sequence

from torchdq.numbers.record import Op


def halves(ops: Sequence[Op]) -> dict[int, int]:
    """Index of the half of every angle, where there is a sine or cosine of both."""
    angles = {op.operands[0] for op in ops if op.code in ("sin", "cos")}
    found = {}
    for i in angles:
        op = ops[i]
        if op.code == "mul":
            for whole, factor in (op.operands, op.operands[::-1]):
                if whole in angles and ops[factor].code == "const" and ops[factor].payload == 0.5:
                    found[whole] = i
    return found
