"""Bodies of the links of a robot, and of a free base, as tensors with batch axes of their own."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchdq.dynamics.tree import BASE
from torchdq.robot.edit import lumps
from torchdq.robot.fields import BASE_BODY, LINK_BODY

if TYPE_CHECKING:
    from torchdq.robot.robot import Robot


class RigidBody(NamedTuple):
    """Mass and its distribution, seen in a frame."""

    mass: Tensor  # [...] [kg]
    com: Tensor  # [..., 3] centre of mass [m]
    inertia: Tensor  # [..., 6] about the centre of mass: xx xy yy xz yz zz [kg m^2]

    @classmethod
    def at(cls, robot: Robot, link: int) -> RigidBody:
        """Body of a link, or of a free base."""
        if link == BASE:
            return cls(*(getattr(robot, name) for name in BASE_BODY))
        return cls(robot.mass[..., link], robot.com[..., link, :], robot.inertia[..., link, :])


def lumped(body: RigidBody, others: Iterable[tuple[Tensor, RigidBody]]) -> RigidBody:
    """RigidBody with others fixed to it, each seen in a frame that has a pose [8] in the frame of the first."""
    whole = _numbers(body)
    for X, other in others:
        x = X.unbind(-1)
        whole = lumps.together(whole, lumps.moved((x[:4], x[4:]), _numbers(other)))
    return RigidBody(whole[0], *(torch.stack(torch.broadcast_tensors(*x), -1) for x in whole[1:]))


def _numbers(body: RigidBody) -> lumps.Lump:
    return body.mass, body.com.unbind(-1), body.inertia.unbind(-1)


def mixed(arguments: Sequence[str]) -> tuple[str, ...]:
    """Arguments of programs of a robot some of whose bodies are lumped: a sum depends on all that it is made of."""
    known = set(arguments)
    links = LINK_BODY if known & set(LINK_BODY) else ()
    return (*arguments, *links, *(BASE_BODY if links or known & set(BASE_BODY) else ()))
