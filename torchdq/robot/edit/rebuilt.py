"""Robots of other links: some are part of others, some are left out, and what is fixed to each moves with it.

Tensors keep their batch axes and gradients, so a batch of robots is rebuilt as a whole.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdq import dq
from torchdq.dynamics.tree import BASE
from torchdq.robot.bodies import body_at, lumped, mixed
from torchdq.robot.description import JointMap, Limits
from torchdq.robot.fields import BASE_BODY, LINK_BODY, SHAPES
from torchdq.robot.model import AnyRobot, RobotModel

PER_LINK = {"screw": -2, "home": -1}  # fields by the axis of the links
PER_COORDINATE = {"armature": -1, "damping": -1, "friction": -1}  # fields by the axis of the coordinates

Places = Mapping[
    int, tuple[int, Tensor]
]  # of links and the base: the new link that each is part of, its pose [8] there


def rebuilt(
    robot: AnyRobot, places: Places, links: Sequence[int], coordinates: Sequence[int], **changes: Any
) -> AnyRobot:
    """Robot of some of the links and coordinates, in order, and with other fields changed.

    `places` has every link that is kept, or is part of one that is.
    """
    fields: dict[str, Any] = {x.name: getattr(robot, x.name) for x in dataclasses.fields(robot) if x.name[0] != "_"}
    for kept, axes in ((links, PER_LINK), (coordinates, PER_COORDINATE)):
        rows = torch.tensor(kept, dtype=torch.long, device=robot.mass.device)
        fields |= {k: None if fields[k] is None else fields[k].index_select(axis, rows) for k, axis in axes.items()}
    fields |= {name: tuple(getattr(robot, name)[i] for i in links) for name in ("link_names", "kinds")}
    fields["joint_names"] = tuple(robot.joint_names[k] for k in coordinates)
    fields["limits"] = Limits(*(x.index_select(-1, rows) for x in robot.limits))
    if robot.joint_map is not None:
        S, names = robot.joint_map.S[links][:, coordinates], tuple(robot.every_joint[i] for i in links)
        trivial = names == fields["joint_names"] and torch.equal(S, torch.eye(len(names)).to(S))
        fields["joint_map"] = None if trivial else JointMap(names, S)
    heads = [*links, *([BASE] if robot.floating and BASE in places else [])]
    parts = {i: [k for k, (link, _) in places.items() if link == places[i][0] and k != i] for i in heads}
    bodies = {i: lumped(body_at(robot, i), [(places[k][1], body_at(robot, k)) for k in parts[i]]) for i in heads}
    fields |= {name: stacked(robot, name, [bodies[i][j] for i in links]) for j, name in enumerate(LINK_BODY)}
    fields |= zip(BASE_BODY, bodies.get(BASE, (None,) * 3), strict=True)
    known = robot._arguments
    fields |= {**hung(robot, places, links), "_arguments": mixed(known) if any(parts.values()) else known}
    return type(robot)(**(fields | changes))


def hung(robot: RobotModel, places: Places, links: Sequence[int]) -> dict[str, Any]:
    """Parents, poses at home, frames and closures of links that hang on others now."""
    at = [places[robot.parents[i]] for i in links]
    X_PB_home = [dq.mul(X, robot.X_PB_home[..., i, :]) for i, (_, X) in zip(links, at, strict=True)]
    moved = [(x, *places[x.link]) for x in robot.frames if x.link in places]
    kept = {x.name: link for x, link, _ in moved}
    return {
        # what is on one link now is held together anyway
        "closures": tuple(
            x for x in robot.closures if {x.frame_a, x.frame_b} <= kept.keys() and kept[x.frame_a] != kept[x.frame_b]
        ),
        "parents": tuple(parent for parent, _ in at),
        "X_PB_home": stacked(robot, "X_PB_home", X_PB_home),
        "frames": tuple(x._replace(link=link, X_BF=dq.mul(X, x.X_BF)) for x, link, X in moved),
    }


def stacked(robot: RobotModel, name: str, rows: Sequence[Tensor]) -> Tensor:
    """Tensor of links from their rows, each with batch axes of its own."""
    axis = -len(SHAPES[name])
    return torch.stack(torch.broadcast_tensors(*rows), axis) if rows else getattr(robot, name).narrow(axis, 0, 0)
