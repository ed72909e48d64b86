"""Robots with some joints locked, and chains between two frames of a robot.

Masses, centres of mass and inertias keep their batch axes and gradients, so a batch of robots is reduced as a whole.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdq import dq
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot.arrays import IDENTITY, SIX, matrices
from torchdq.robot.description import Frame, Limits
from torchdq.robot.urdf_lock import positions, require_free, told

if TYPE_CHECKING:
    from torchdq.robot.robot import Robot

PER_JOINT = {"screw": -2, "home": -1, "armature": -1, "damping": -1, "friction": -1}  # fields by the axis of the joints


def lock(robot: Robot, lock: Mapping[str, float] | Sequence[str] | str) -> Robot:
    """Robot with some joints fixed, whose links become parts of those before them.

    Args:
        robot: the robot.
        lock: positions [rad or m] of the joints, by name or pattern ("finger*"), or names or patterns alone: at home.

    >>> import torchdq
    >>> torchdq.robots.load("two_link").lock({"joint2": 0.5}).joint_names
    ('joint1',)
    """
    _require_constant_geometry(robot)
    given = positions(lock, robot.joint_names)
    require_free(robot.joint_names, given)
    home = [0.0] * robot.n if robot.home is None else robot.home.tolist()
    limits = list(zip(robot.limits.lower.tolist(), robot.limits.upper.tolist(), strict=True))
    own = IDENTITY.to(robot.screw)
    carrier, X_CB = {BASE: BASE}, {BASE: own}  # link that each link is part of, and its pose there
    free: list[int] = []
    placed: list[Tensor] = []  # poses of the free links in the carriers of their parents
    at: dict[str, float] = {}
    for i, (name, parent) in enumerate(zip(robot.joint_names, robot.parents, strict=True)):
        X = dq.mul(X_CB[parent], robot.X_PB_home[i])
        if name in given:
            wanted = given[name]
            at[name] = home[i] if wanted is None else wanted
            carrier[i], X_CB[i] = carrier[parent], dq.mul(X, dq.exp(0.5 * (at[name] - home[i]) * robot.screw[i]))
        else:
            carrier[i], X_CB[i] = i, own
            free.append(i)
            placed.append(X)
    new = {BASE: BASE} | {old: i for i, old in enumerate(free)}
    bodies = [_lumped(robot, {i: X_CB[i] for i, c in carrier.items() if c == link}) for link in free]
    masses, coms, inertias = zip(*bodies, strict=True) if bodies else ((), (), ())
    inertial = {"mass", "com", "inertia"}
    return _made(
        robot,
        free,
        parents=tuple(new[carrier[robot.parents[i]]] for i in free),
        X_PB_home=_stacked(placed, robot.X_PB_home[:0]),
        mass=_stacked(masses, robot.mass[..., :0], -1),
        com=_stacked(coms, robot.com[..., :0, :]),
        inertia=_stacked(inertias, robot.inertia[..., :0, :]),
        frames=tuple(Frame(x.name, new[carrier[x.link]], dq.mul(X_CB[x.link], x.X_BF)) for x in robot.frames),
        notes=(*robot.notes, *told(at, {name: limits[robot.joint_index(name)] for name in at})),
        # the sums depend on all that any of them is made of
        _arguments=(*robot._arguments, *(inertial if inertial & set(robot._arguments) else ())),
    )


def subchain(robot: Robot, base: str, tip: str) -> Robot:
    """Chain of the joints between two frames, as a robot on the first of them; all other links are left out.

    Gravity is turned into the axes of the new base, which stands where it is with all joints at home.

    Args:
        robot: the robot.
        base: name of the frame that becomes the base.
        tip: name of the frame of the end effector.

    >>> import torchdq
    >>> torchdq.robots.load("panda").subchain("panda_link3", "panda_link6").joint_names
    ('panda_joint4', 'panda_joint5', 'panda_joint6')
    """
    _require_constant_geometry(robot)
    first, last = robot.frame(base), robot.frame(tip)
    chain: list[int] = []
    link = last.link
    while link not in (first.link, BASE):
        chain.insert(0, link)
        link = robot.parents[link]
    if link != first.link or not chain:
        raise ArgumentError(f"tip must be a frame that joints carry from the frame {base!r} on, found {tip!r}")
    X_WF = first.X_BF  # pose of the new base in the old one at home
    while link != BASE:
        X_WF, link = dq.mul(robot.X_PB_home[link], X_WF), robot.parents[link]
    X_FB = dq.conj(first.X_BF)
    new = {first.link: BASE} | {old: i for i, old in enumerate(chain)}
    frames = [Frame(x.name, new[x.link], x.X_BF) for x in robot.frames if x.link in new]
    left_out = ", ".join(name for i, name in enumerate(robot.joint_names) if i not in chain)
    note = f"chain from {base!r} to {tip!r}, without the joints {left_out}"
    return _made(
        robot,
        chain,
        parents=tuple(range(BASE, len(chain) - 1)),
        X_PB_home=torch.stack([dq.mul(X_FB, robot.X_PB_home[chain[0]]), *robot.X_PB_home[chain[1:]]]),
        mass=robot.mass[..., chain],
        com=robot.com[..., chain, :],
        inertia=robot.inertia[..., chain, :],
        gravity=None if robot.gravity is None else dq.rotate(dq.conj(X_WF[:4]), robot.gravity),
        frames=tuple(x._replace(X_BF=dq.mul(X_FB, x.X_BF)) if x.link == BASE else x for x in frames),
        tip=tip,
        notes=(*robot.notes, note) if left_out else robot.notes,
    )


def _require_constant_geometry(robot: Robot) -> None:
    for name in ("X_PB_home", "screw", "home"):
        if name in robot._arguments:
            raise ArgumentError(f"{name} of robot {robot.name!r} must be constant, as its frames are; use bake() first")


def _made(robot: Robot, kept: Sequence[int], **changes: Any) -> Robot:
    """Robot with some of the joints, and with other fields changed."""
    rows = torch.tensor(kept, dtype=torch.long, device=robot.mass.device)
    values = {name: getattr(robot, name) for name in PER_JOINT}
    fields: dict[str, Any] = {
        **{x.name: getattr(robot, x.name) for x in dataclasses.fields(robot) if not x.name.startswith("_")},
        "_arguments": robot._arguments,
        **{name: tuple(getattr(robot, name)[i] for i in kept) for name in ("joint_names", "link_names", "kinds")},
        **{name: None if x is None else x.index_select(PER_JOINT[name], rows) for name, x in values.items()},
        "limits": Limits(*(x.index_select(-1, rows) for x in robot.limits)),
    }
    return type(robot)(**(fields | changes))


def _stacked(rows: Sequence[Tensor], none: Tensor, axis: int = -2) -> Tensor:
    return torch.stack(torch.broadcast_tensors(*rows), axis) if rows else none


def _lumped(robot: Robot, parts: Mapping[int, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Mass [...], centre of mass [..., 3] and inertia [..., 6] of links at poses in the frame of the first of them."""
    first, *others = parts
    mass, com, inertia = robot.mass[..., first], robot.com[..., first, :], robot.inertia[..., first, :]
    for i in others:
        R, p = dq.to_rotation_matrix(parts[i][:4]), dq.translation(parts[i])
        more = robot.mass[..., i]
        total = mass + more
        share = torch.where(total == 0, 0.0, more / torch.where(total == 0, 1.0, total))
        apart = (R @ robot.com[..., i, :, None]).squeeze(-1) + p - com
        rotated = (R @ matrices(robot.inertia[..., i, :]) @ R.mT)[..., *SIX]
        square = apart.square().sum(-1, keepdim=True) * torch.eye(3, dtype=apart.dtype, device=apart.device)[*SIX]
        steiner = square - apart[..., SIX[0]] * apart[..., SIX[1]]
        inertia = inertia + rotated + (mass * share).unsqueeze(-1) * steiner
        com = com + share.unsqueeze(-1) * apart
        mass = total
    return mass, com, inertia
