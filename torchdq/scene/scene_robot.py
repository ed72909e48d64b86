"""Rigid bodies that a scene simulates, as a robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdq.program.program import Argument
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES, trailing
from torchdq.robot.model import batches
from torchdq.scene.recording import Stage
from torchdq.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Simulated:
    """Robot of a scene with its gravity and rotors, its payloads, and all that is drawn for an episode.

    Args:
        robot: with everything that all episodes share.
        differing: names of the tensors that differ from episode to episode, or from row to row.
    """

    robot: Robot
    differing: tuple[str, ...]

    @classmethod
    def of(cls, scene: Scene, device: torch.device) -> Simulated:
        """Robot of a scene, with tensors on a device."""
        stage, n = Stage(scene.spec, "bodies"), scene.n
        taken = [Argument("q", n), *(Argument(name, math.prod(stage.axes(name))) for name in scene._parameters)]
        found = {result.name: result.values for result in stage.program(tuple(taken)).results}
        same = {name: row for name, row in found.items() if all(isinstance(x, float) for x in row)}
        known: dict[str, Any] = {"gravity": None, "armature": None}
        for name, row in same.items():
            known[name] = torch.tensor(row, dtype=torch.float64).reshape(trailing(SHAPES[name], scene.robot.sizes))
        differing = tuple(name for name in found if name not in same)
        described = scene.robot._with(**{name: x for name, x in known.items() if name not in differing})
        whole = described if batches(described) else described.bake()
        return cls(whole.to(device=device), differing)

    def __call__(self, scene: Scene, q: Tensor) -> Robot:
        """Robot of the rows of a scene, in the dtype of their positions q [N, n]."""
        if not self.differing:
            return self.robot
        rows = scene.evaluate("bodies", {"q": q})
        sizes = self.robot.sizes
        changes = {name: rows[name].reshape(-1, *trailing(SHAPES[name], sizes)) for name in self.differing}
        return self.robot._with(**changes)
