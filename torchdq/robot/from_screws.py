"""Robots from joint screws in the base frame: the paper's own description, section 5.1."""

import dataclasses
import sys
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchdq import dq
from torchdq.backends.choice import backend
from torchdq.dynamics.joints import HELICAL, PRISMATIC, REVOLUTE
from torchdq.dynamics.tree import BASE
from torchdq.errors import DescriptionError
from torchdq.robot.arrays import IDENTITY, UNIT, distinct, indices, numbers, poses, table
from torchdq.robot.assembly import assemble
from torchdq.robot.description import RobotDescription, note

# Pitches [m/rad] that are not noted: a thousandth of an atom, and what rounding leaves of l . m per size of m.
ATOM, PRODUCTS = 1e-13, 32 * sys.float_info.epsilon


def joint(name: str, screw: Tensor) -> tuple[str, Tensor]:
    """Kind of the joint with that screw, and its exact line, screw or translation, from one up to rounding."""
    axis, moment = screw[:3], screw[3:]
    length = float(axis.norm())
    if abs(length - 1.0) < UNIT:
        axis = axis / length
        pitch = axis @ moment
        if abs(float(pitch)) > UNIT + PRODUCTS * float(moment.norm()):
            return HELICAL, torch.cat([axis, moment])
        return REVOLUTE, torch.cat([axis, moment - pitch * axis])
    if length < UNIT and abs(float(moment.norm()) - 1.0) < UNIT:
        return PRISMATIC, torch.cat([torch.zeros_like(axis), moment / moment.norm()])
    raise DescriptionError(
        f"joint {name!r}: its screw must be a unit line (l | p x l), a line with pitch (l | p x l + h l), or a "
        f"translation (0 | l) with |l| = 1, found {screw.tolist()}"
    )


@backend("eager")  # compiling takes longer than a few poses
def read(
    joint_screws: Any,
    link_poses: Any,
    tip_pose: Any,
    parents: Sequence[int] | None,
    joint_names: Sequence[str] | None,
    **bodies: Any,
) -> RobotDescription:
    """Description; `Robot.from_screws` says what is expected."""
    s = numbers("joint_screws", joint_screws)
    n = s.shape[0] if s.ndim else 0
    s = table("joint_screws", s, n, 6)
    if n == 0:
        raise DescriptionError("joint_screws must hold at least one joint")
    tree = tuple(range(BASE, n - 1)) if parents is None else indices("parents", parents)
    if len(tree) != n or any(not BASE <= p < i for i, p in enumerate(tree)):
        raise DescriptionError(f"parents must hold, for each of {n} links, an earlier link or -1, found {tree}")
    X_WB = IDENTITY.expand(n, 8) if link_poses is None else poses("link_poses", link_poses, n, 8)
    X_WE = X_WB[-1] if tip_pose is None else poses("tip_pose", tip_pose, 8)
    names = distinct("joint", joint_names, n)
    kinds, exact = zip(*map(joint, names, s), strict=True)
    pitches, sizes = (s[:, :3] * s[:, 3:]).sum(-1), s[:, 3:].norm(dim=-1)
    s = torch.stack(exact)
    X_WP = torch.stack([IDENTITY if p == BASE else X_WB[p] for p in tree])
    X_PB_home = dq.mul(dq.conj(X_WP), X_WB)  # delta_i^{i-1}, (37)
    a = dq.ad(dq.conj(X_WB), s)  # a_i = Ad(delta_0^i) s_i
    found = assemble(names, tree, kinds, X_PB_home, a, dq.mul(dq.conj(X_WB[-1]), X_WE), **bodies)
    dropped = [
        note("screw.pitch", [name], f"its pitch of {pitch:.3g} m/rad is rounding, and it is revolute")
        for name, kind, pitch, size in zip(names, kinds, pitches.tolist(), sizes.tolist(), strict=True)
        if kind == REVOLUTE and abs(pitch) > ATOM + PRODUCTS * size
    ]
    return dataclasses.replace(found, notes=(*found.notes, *dropped))
