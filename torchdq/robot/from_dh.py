"""Robots from Denavit-Hartenberg parameters, standard (Denavit and Hartenberg 1955) or modified (Craig 1986)."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchdq import dq
from torchdq.backends.choice import backend
from torchdq.dynamics.tree import BASE
from torchdq.errors import DescriptionError
from torchdq.robot.arrays import IDENTITY, distinct, double, numbers, poses, table, words
from torchdq.robot.assembly import assemble
from torchdq.robot.check.units import TURN
from torchdq.robot.description import RobotDescription


def _about(axis: int, angle: float, shift: float) -> Tensor:
    """Pose of a rotation about, and a translation along, one axis of a frame."""
    c, s = exact(math.cos(0.5 * angle), math.sin(0.5 * angle), angle)
    x = torch.zeros(8, dtype=torch.float64, device="cpu")
    x[0], x[1 + axis] = c, s
    # (eps/2) p r with p along the axis of r
    x[4], x[5 + axis] = -0.5 * shift * s, 0.5 * shift * c
    return x


def exact(cos: float, sin: float, angle: float) -> tuple[float, float]:
    """Half-angle cosine and sine with the rounding of a half turn or a full turn removed."""
    turns = angle / math.pi
    if turns == round(turns):
        return float(round(cos)), float(round(sin))
    return cos, sin


@backend("eager")  # compiling takes longer than a few poses
def read(
    a: Sequence[float],
    alpha: Sequence[float],
    d: Sequence[float],
    theta: Sequence[float],
    convention: str,
    kinds: Sequence[str] | None,
    tip_pose: Any,
    joint_names: Sequence[str] | None,
    **bodies: Any,
) -> RobotDescription:
    """Description; `Robot.from_dh` says what is expected."""
    n = numbers("a", a).numel()
    if n == 0:
        raise DescriptionError("a must hold a number for each of at least one joint")
    rows = [table(what, x, n).tolist() for what, x in (("a", a), ("alpha", alpha), ("d", d), ("theta", theta))]
    for what, angles in (("alpha", rows[1]), ("theta", rows[3])):
        for i, angle in enumerate(angles):
            if abs(angle) > TURN:
                found = f"found {angle:g} in row {i + 1}, more than a whole turn"
                raise DescriptionError(f"{what} must be in radians, {found}; multiply degrees by pi/180")
    types = ("revolute",) * n if kinds is None else words("kinds", kinds, n, ", 'revolute' or 'prismatic'")
    if not set(types) <= {"revolute", "prismatic"}:
        raise DescriptionError(f"kinds must be 'revolute' or 'prismatic', found {types}")
    if not isinstance(convention, str) or convention not in ("standard", "modified"):
        raise DescriptionError(f"convention must be 'standard' or 'modified', found {convention!r}")
    placements, screws = [], []
    for kind, a_i, alpha_i, d_i, theta_i in zip(types, *rows, strict=True):
        z = double([0, 0, 1, 0, 0, 0] if kind == "revolute" else [0, 0, 0, 0, 0, 1])
        joint, link = _about(2, theta_i, d_i), _about(0, alpha_i, a_i)
        if convention == "standard":
            placements.append(dq.mul(joint, link))
            screws.append(dq.ad(dq.conj(link), z))  # the joint turns about the z axis of the frame before
        else:
            placements.append(dq.mul(link, joint))
            screws.append(z)
    names, chain = distinct("joint", joint_names, n), tuple(range(BASE, n - 1))
    X_BE = IDENTITY if tip_pose is None else poses("tip_pose", tip_pose, 8)
    return assemble(names, chain, types, torch.stack(placements), torch.stack(screws), X_BE, **bodies)
