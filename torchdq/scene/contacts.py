"""Contacts of a scene in a state: forces, depths and slip of its points."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from torchdq.effects.contact import Contact
from torchdq.errors import ArgumentError
from torchdq.scene.model import SceneModel
from torchdq.scene.state import State, require_state


class Contacts(NamedTuple):
    """Contact of every point of the scene's `Contact` effects, in their order."""

    force: Tensor  # [..., points, 3] on the robot, in world axes, or base axes if the base is fixed [N]
    normal_force: Tensor  # [..., points] [N]
    touching: Tensor  # [..., points] bool
    depth: Tensor  # [..., points] of the point in the ground, negative above it [m]
    slip: Tensor  # [..., points] speed along the surface [m/s]


def contacts(scene: SceneModel, state: State) -> Contacts:
    """Contact of every point in a state; with stiction the forces are those of the last step, as the state remembers.

    Args:
        state: from `start`, `step` or `rollout`, shape [...].

    >>> import torch, torchdq
    >>> from torchdq import Scene, effects
    >>> scene = Scene(torchdq.robots.load("panda"), (effects.Contact(height=0.5),), dt=0.005)
    >>> scene.contacts(scene.start(torch.zeros(4, 7))).force.shape
    torch.Size([4, 1, 3])
    """
    require_state(state)
    if not scene.spec.of(Contact):
        raise ArgumentError(f"contacts need an effects.Contact in the scene of robot {scene.robot.name!r}, found none")
    given = state.rows()
    rows = scene.evaluate("contacts", {**given, **scene.grounds(state)})
    force = rows["force"].unflatten(-1, (-1, 3))
    return Contacts(force, rows["normal_force"], rows["touching"] != 0, rows["depth"], rows["slip"])
