"""Robots of joint screws in the base frame: the paper's own description, section 5.1."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdq import dq
from torchdq.dynamics.tree import BASE
from torchdq.errors import DescriptionError
from torchdq.robot import consistency as physical

UNIT = 1e-9  # how far from 0 or 1 a direction may be and still count as that; exact input is meant


def numbers(name: str, value: Any) -> Tensor:
    """Value as a float64 tensor."""
    try:
        return torch.as_tensor(value if isinstance(value, Tensor) else np.array(value), dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:  # words, or rows of different lengths
        raise DescriptionError(f"{name} must be an array of numbers: {error}") from error


def table(name: str, value: Any, *shape: int) -> Tensor:
    """Value as a finite float64 tensor of that shape."""
    x = numbers(name, value)
    if tuple(x.shape) != shape:
        raise DescriptionError(f"{name} must have the shape {shape}, found {tuple(x.shape)}")
    if not bool(x.isfinite().all()):
        raise DescriptionError(f"{name} must be finite, found {x.tolist()}")
    return x


def poses(name: str, value: Any, *shape: int) -> Tensor:
    """Value as unit dual quaternions of that shape."""
    x = dq.normalize(table(name, value, *shape))
    if not bool(x.isfinite().all()):
        raise DescriptionError(f"{name} must be dual quaternions with a rotation, found {value}")
    return x


def named(what: str, names: Sequence[str] | None, kind: str, n: int) -> tuple[str, ...]:
    """n different names; without any, the kind of thing with a number."""
    chosen = tuple(f"{kind}{i + 1}" for i in range(n)) if names is None else tuple(names)
    if len(chosen) != n or len(set(chosen)) != n:
        raise DescriptionError(f"{what} must be {n} different names, found {chosen}")
    return chosen


def six(inertia: Any, n: int) -> Tensor:
    """Inertias [n, 6] in the order xx xy yy xz yz zz, from those or from matrices [n, 3, 3]."""
    x = numbers("inertia", inertia)
    if tuple(x.shape) == (n, 3, 3):
        # R I R^T is symmetric up to rounding only
        if bool(((x - x.mT).abs() > UNIT * x.abs().amax()).any()):
            raise DescriptionError(f"inertia matrices must be symmetric, found {x.tolist()}")
        x = torch.stack([x[:, 0, 0], x[:, 0, 1], x[:, 1, 1], x[:, 0, 2], x[:, 1, 2], x[:, 2, 2]], -1)
    return table("inertia", x, n, 6)


def square(inertia: Tensor) -> Tensor:
    """Matrices [..., 3, 3] of inertias [..., 6] in the order xx xy yy xz yz zz."""
    xx, xy, yy, xz, yz, zz = inertia.unbind(-1)
    rows = [torch.stack(row, -1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
    return torch.stack(rows, -2)


def kind_of(joint: str, screw: Tensor) -> str:
    """Kind of the joint with that screw, after checking that it is one."""
    axis, moment = screw[:3], screw[3:]
    length = float(axis.norm())
    if abs(length - 1.0) < UNIT:
        return "helical" if abs(float(axis @ moment)) > UNIT else "revolute"
    if length < UNIT and abs(float(moment.norm()) - 1.0) < UNIT:
        return "prismatic"
    raise DescriptionError(
        f"joint {joint!r}: its screw must be a unit line (l | p x l), a line with pitch (l | p x l + h l), or a "
        f"translation (0 | l) with |l| = 1, found {screw.tolist()}"
    )


def straight(kind: str, screw: Tensor) -> Tensor:
    """The exact line, screw or translation of a joint whose screw is one up to rounding."""
    axis, moment = screw[:3], screw[3:]
    if kind == "prismatic":
        return torch.cat([torch.zeros_like(axis), moment / moment.norm()])
    axis = axis / axis.norm()
    return torch.cat([axis, moment - (axis @ moment) * axis if kind == "revolute" else moment])


def assemble(
    name: str,
    joints: tuple[str, ...],
    link_names: Sequence[str] | None,
    parents: tuple[int, ...],
    X_PB_home: Tensor,
    screw: Tensor,
    kinds: tuple[str, ...],
    mass: Any,
    com: Any,
    inertia: Any,
    home: Any,
    X_BE: Tensor,
) -> tuple[dict[str, Any], list[str]]:
    """Arguments of a `Robot` without limits or friction, with a frame per link, one at the tip, and one at the base."""
    n = len(parents)
    links = named("link_names", link_names, "link", n)
    if {"base", "tip"} & set(links):
        raise DescriptionError(f"link_names must not be 'base' or 'tip', which are frames already, found {links}")
    mass, com, inertia = table("mass", mass, n), table("com", com, n, 3), six(inertia, n)
    findings = [f for i in range(n) for f in physical.body(links[i], float(mass[i]), square(inertia[i]))]
    identity = torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    infinite = torch.full((n,), torch.inf, dtype=torch.float64)
    frames = [("base", BASE, identity), *((link, i, identity) for i, link in enumerate(links))]
    return {
        "name": name,
        "joint_names": joints,
        "link_names": links,
        "parents": parents,
        "kinds": kinds,
        "X_PB_home": X_PB_home,
        "screw": screw,
        "mass": mass,
        "com": com,
        "inertia": inertia,
        "home": None if home is None else table("home", home, n),
        "limits": {"lower": -infinite, "upper": infinite, "velocity": infinite, "effort": infinite},
        "damping": torch.zeros(n, dtype=torch.float64),
        "friction": torch.zeros(n, dtype=torch.float64),
        "frames": [*frames, ("tip", n - 1, X_BE)],
        "tip": "tip",
    }, findings


def read(
    joint_screws: Any,
    mass: Any,
    com: Any,
    inertia: Any,
    link_poses: Any,
    tip_pose: Any,
    parents: Sequence[int] | None,
    home: Any,
    joint_names: Sequence[str] | None,
    link_names: Sequence[str] | None,
    name: str,
) -> tuple[dict[str, Any], list[str]]:
    """Arguments of a `Robot`, and what is unphysical about it; `Robot.from_screws` says what is expected."""
    s = numbers("joint_screws", joint_screws)
    n = s.shape[0] if s.ndim else 0
    s = table("joint_screws", s, n, 6)
    if n == 0:
        raise DescriptionError("joint_screws must hold at least one joint")
    hangs_on = tuple(range(BASE, n - 1)) if parents is None else tuple(int(p) for p in parents)
    if len(hangs_on) != n or any(not BASE <= p < i for i, p in enumerate(hangs_on)):
        raise DescriptionError(f"parents must hold, for each of {n} links, an earlier link or -1, found {hangs_on}")
    identity = torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    X_WB = identity.expand(n, 8) if link_poses is None else poses("link_poses", link_poses, n, 8)
    X_WE = X_WB[-1] if tip_pose is None else poses("tip_pose", tip_pose, 8)
    joints = named("joint_names", joint_names, "joint", n)
    kinds = tuple(map(kind_of, joints, s))
    s = torch.stack(list(map(straight, kinds, s)))
    X_WP = torch.stack([identity if p == BASE else X_WB[p] for p in hangs_on])
    return assemble(
        name,
        joints,
        link_names,
        hangs_on,
        dq.mul(dq.conj(X_WP), X_WB),  # delta_i^{i-1}, (37)
        dq.ad(dq.conj(X_WB), s),  # a_i = Ad(delta_0^i) s_i
        kinds,
        mass,
        com,
        inertia,
        home,
        dq.mul(dq.conj(X_WB[-1]), X_WE),
    )
