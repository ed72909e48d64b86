"""Bodies of robots and objects, as triangles: boxes, cylinders, spheres, capsules, and meshes, which trimesh reads."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from torchdq.base.checks import tensor_of
from torchdq.base.optional import imported
from torchdq.base.sources import located
from torchdq.dq import rotate, rotation, translation
from torchdq.envs.canvas import spread
from torchdq.errors import MissingFileError
from torchdq.objects import Ball, Box, Capsule, Object
from torchdq.robot import Robot
from torchdq.robot.description import Shape

SIDES = 32  # of what is round
MOST_NAMED = 5  # meshes of a warning
PLATE = np.array([(0.0, -1.0), (1.0, -1.0), (1.0, 1.0), (0.0, 1.0)])  # profile of a box and of a cylinder


class Surface(NamedTuple):
    """Triangles with corners among some points."""

    vertices: np.ndarray  # [v, 3] [m]
    faces: np.ndarray  # [f, 3]

    def extremes(self) -> np.ndarray:
        """Vertices that are farthest in some directions: along edges, faces and diagonals of a cube."""
        ways = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), -1).reshape(-1, 3)
        return self.vertices[np.unique((self.vertices @ ways.T).argmax(0))]

    def points(self, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Points [p, 3] that leave no hole wider than about a spacing [m], and the normals [p, 3] there."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        area = np.linalg.norm(normal, axis=-1)
        numbers = np.ceil(area / spacing**2).astype(int)  # two for each square of that width
        face = np.repeat(np.arange(len(area)), numbers)
        k = np.arange(len(face)) - np.repeat(np.cumsum(numbers) - numbers, numbers)
        u, v = (x[k] for x in spread(max(numbers, default=0)))
        u, v = np.where(u + v > 1.0, [1.0 - u, 1.0 - v], [u, v])
        found = a[face] + u[:, None] * (b - a)[face] + v[:, None] * (c - a)[face]
        return found.astype(np.float32), (normal / np.maximum(area, 1e-300)[:, None])[face].astype(np.float32)


def surface_of(body: Object) -> Surface:
    """Surface of an object in its frame; of several, that of the first."""

    def first(name: str, *axes: int) -> list[float]:
        return tensor_of(getattr(body, name)).detach().double().cpu().reshape(-1, *axes)[0].reshape(-1).tolist()

    if isinstance(body, Box):
        return _primitive("box", [0.5 * x for x in first("size", 3)])
    if isinstance(body, Ball):
        return _primitive("sphere", first("radius"))
    kind = "capsule" if isinstance(body, Capsule) else "cylinder"
    return _primitive(kind, [*first("radius"), 0.5 * first("length")[0]])


def bodies_of(robot: Robot) -> list[tuple[int, Surface]]:
    """Frames, by number, whose descriptions have shapes that can be drawn, and these; a warning names the others."""
    found, failed = [], dict[str, str]()
    for i, frame in enumerate(robot.frames):
        parts = [_placed(shape, frame.drawing.folder, failed) for shape in frame.drawing.shapes]
        if whole := [part for part in parts if part is not None]:
            starts = np.cumsum([0, *(len(part.vertices) for part in whole)])
            faces = [part.faces + start for part, start in zip(whole, starts, strict=False)]
            found.append((i, Surface(np.concatenate([part.vertices for part in whole]), np.concatenate(faces))))
    if failed:
        shown = [f"{mesh}: {why}" for mesh, why in failed.items()]
        more = [f"and {len(shown) - MOST_NAMED} more"] * (len(shown) > MOST_NAMED)
        lines = "\n  ".join([*shown[:MOST_NAMED], *more])
        warnings.warn(f"meshes of robot {robot.name!r} are not drawn:\n  {lines}", stacklevel=4)
    return found


def _placed(shape: Shape, folder: str, failed: dict[str, str]) -> Surface | None:
    """Surface of a shape in its frame; None: it has none, or its mesh is added to those that failed."""
    if shape.mesh:
        if shape.mesh in failed:
            return None
        try:
            found = _mesh(shape.mesh, folder)
        except Exception as error:  # those of the libraries that read formats
            failed[shape.mesh] = " ".join(str(error).split()) or type(error).__name__
            return None
        found = found._replace(vertices=found.vertices * shape.size)
    elif shape.kind in ("box", "sphere", "cylinder", "capsule"):
        found = _primitive(shape.kind, shape.size)
    else:
        return None
    X = torch.tensor([*shape.X_FS[0], *shape.X_FS[1]], dtype=torch.float64)
    p = translation(X) + rotate(rotation(X), torch.from_numpy(np.ascontiguousarray(found.vertices, np.float64)))
    return found._replace(vertices=p.numpy())


def _mesh(file: str, folder: str) -> Surface:
    """Surface in a file."""
    path = located(file, MissingFileError, Path(folder))
    if not path.is_file():
        raise MissingFileError(f"there is no file {str(path)!r}")
    trimesh = imported("trimesh", "trimesh", "drawing meshes", "'torchdq[viz]'")
    found = trimesh.load(path, force="mesh", process=False, skip_materials=True)
    return Surface(np.asarray(found.vertices), np.asarray(found.faces))


def _primitive(kind: str, size: Iterable[float]) -> Surface:
    """Surface of a shape in its own axes; `size` as of `Shape`."""
    a, *rest = size
    if kind == "box":
        square = _revolved(PLATE * (math.sqrt(2.0), 1.0), 4)
        return square._replace(vertices=square.vertices * (a, *rest))
    if kind == "cylinder":
        return _revolved(PLATE * (a, *rest), SIDES)
    turn = np.linspace(-0.5 * math.pi, 0.5 * math.pi, SIDES // 2 + 2)  # has no equator, at which a capsule is cut
    middle = np.sign(turn) * (rest[0] if rest else 0.0)
    return _revolved(np.stack([a * np.cos(turn), a * np.sin(turn) + middle], -1), SIDES)


def _revolved(profile: np.ndarray, sides: int) -> Surface:
    """Surface of revolution about z of a profile of radii and heights [p, 2], from below to above."""
    turn = 2.0 * math.pi * (np.arange(sides) + 0.5) / sides
    ring = np.stack([np.cos(turn), np.sin(turn)], -1)
    radius, height = (column[:, None, None] for column in profile.T)
    vertices = np.concatenate([radius * ring, np.broadcast_to(height, (len(profile), sides, 1))], -1)
    k, j = np.meshgrid(np.arange(len(profile) - 1) * sides, np.arange(sides), indexing="ij")
    a, b = k + j, k + (j + 1) % sides
    faces = np.stack([np.stack([a, b, b + sides], -1), np.stack([a, b + sides, a + sides], -1)]).reshape(-1, 3)
    return Surface(vertices.reshape(-1, 3), faces)
