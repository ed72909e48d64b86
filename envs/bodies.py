"""Bodies of robots and objects, as triangles: boxes, cylinders, spheres, capsules, and meshes, which trimesh reads."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
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
    found, meshes, failed = [], dict[tuple[str, str], Surface](), dict[str, str]()
    for i, frame in enumerate(robot.frames):
        for shape in frame.drawing.shapes:
            if shape.mesh and (key := (shape.mesh, frame.drawing.folder)) not in meshes and shape.mesh not in failed:
                try:
                    meshes[key] = _mesh(*key)
                except MissingFileError:
                    failed[shape.mesh] = f"there is no such file around {frame.drawing.folder!r}"
                except Exception as error:  # those of the libraries that read formats
                    failed[shape.mesh] = " ".join(str(error).split()) or type(error).__name__
        parts = [_placed(shape, meshes.get((shape.mesh, frame.drawing.folder))) for shape in frame.drawing.shapes]
        if whole := [part for part in parts if part is not None]:
            found.append((i, _joined(whole)))
    if failed:
        lines = []
        for reason in dict.fromkeys(failed.values()):
            names = [mesh for mesh, why in failed.items() if why == reason]
            more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
            lines.append(f"{', '.join(names[:MOST_NAMED])}{more}: {reason}")
        warnings.warn("\n  ".join([f"meshes of robot {robot.name!r} are not drawn:", *lines]), stacklevel=4)
    return found


def _placed(shape: Shape, mesh: Surface | None) -> Surface | None:
    """Surface in its frame of a shape, which may be a mesh; None: it has none."""
    if mesh is not None:
        found = mesh._replace(vertices=mesh.vertices * shape.size)
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
        raise MissingFileError(str(path))
    trimesh = imported("trimesh", "trimesh", "drawing meshes", "'torchdq[viz]'")
    scene = trimesh.load_scene(path, process=False, skip_materials=True)
    parts = []
    for node in scene.graph.nodes_geometry:
        X, name = scene.graph[node]
        part = scene.geometry[name]
        parts.append(Surface(part.vertices @ X[:3, :3].T + X[:3, 3], np.asarray(part.faces)))
    return _joined(parts)


def _joined(parts: Sequence[Surface]) -> Surface:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return Surface(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


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
