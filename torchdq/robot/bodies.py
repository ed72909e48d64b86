"""Bodies of the links of a robot and of a floating base: those fixed to each other as one, and taken apart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from torchdq.algebra import quaternion as quat
from torchdq.algebra.inertia import RigidBody
from torchdq.algebra.quaternion import Number
from torchdq.dynamics.tree import BASE
from torchdq.robot.fields import BASE_BODY, LINK_BODY
from torchdq.robot.model import RobotModel

NOTHING = RigidBody(0.0, quat.ZERO, (0.0,) * 6)


def merged(a: RigidBody, b: RigidBody) -> RigidBody:
    """Two bodies as one; those without mass may have a rotational inertia."""
    return a.plus(b, _fraction(b.mass, a.mass + b.mass))


def without(whole: RigidBody, part: RigidBody) -> RigidBody:
    """Rest of a body without a part of it: with the part, it is the whole again."""
    mass = whole.mass - part.mass
    if not mass or not part.mass:
        return RigidBody(mass, whole.com if mass else quat.ZERO, quat.sub(whole.inertia, part.inertia))
    com = quat.add(whole.com, quat.scale(part.mass / mass, quat.sub(whole.com, part.com)))
    between = merged(RigidBody(mass, com, NOTHING.inertia), part)
    return RigidBody(mass, com, quat.sub(whole.inertia, between.inertia))


def _fraction(part: Number, whole: Number) -> Number:
    """Part of the whole as a fraction, zero if there is no whole."""
    if isinstance(whole, Tensor):  # a division by zero would leave NaN in the gradients even where it is masked
        return torch.where(whole == 0, 0.0, part / torch.where(whole == 0, 1.0, whole))
    return part / whole if whole else 0.0


# --- as rows of tensors ----------------------------------------------------------------------------------------------


def body_at(robot: RobotModel, link: int) -> RigidBody:
    """Body of a link, or of a floating base, as rows [...], [..., 3] and [..., 6]."""
    if link == BASE:
        return RigidBody(*(getattr(robot, name) for name in BASE_BODY))
    return RigidBody(robot.mass[..., link], robot.com[..., link, :], robot.inertia[..., link, :])


def lumped(body: RigidBody, others: Iterable[tuple[Tensor, RigidBody]]) -> RigidBody:
    """Body with others fixed to it, all as rows, each seen in a frame that has a pose [8] in the frame of the first."""
    whole = _numbers(body)
    for X, other in others:
        x = X.unbind(-1)
        whole = merged(whole, _numbers(other).moved((x[:4], x[4:])))
    return RigidBody(whole.mass, *(torch.stack(torch.broadcast_tensors(*x), -1) for x in whole[1:]))


def _numbers(body: RigidBody) -> RigidBody:
    return RigidBody(body.mass, body.com.unbind(-1), body.inertia.unbind(-1))


def mixed(arguments: Sequence[str]) -> tuple[str, ...]:
    """Arguments of programs of a robot some of whose bodies are lumped: a sum depends on all that it is made of."""
    known = set(arguments)
    links = LINK_BODY if known & set(LINK_BODY) else ()
    return (*arguments, *links, *(BASE_BODY if links or known & set(BASE_BODY) else ()))
