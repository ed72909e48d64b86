"""Pictures of a robot: images by matplotlib, a live view in the browser by viser, films by Pillow.

Links are drawn by the shapes of their description, see `bodies`. Others are thick lines from the frame of the parent,
through the joint's axis, to their own frame, which looks like the robot if link frames lie on the links, as those of
URDF and of DH parameters do. The view follows a floating base, and lines on the ground pass below it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdq import floating
from torchdq.base.checks import tensor_of
from torchdq.base.optional import imported
from torchdq.dq import rotate, rotation, translation
from torchdq.dynamics.tree import BASE
from torchdq.effects import Contact, HeightMap
from torchdq.envs.bodies import Surface, bodies_of, surface_of
from torchdq.envs.canvas import FINE, Canvas, spread
from torchdq.errors import ArgumentError
from torchdq.functional import forward_kinematics
from torchdq.robot import ContactPoint, Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.robot import arguments
from torchdq.scene.model import SceneModel

__all__ = ["Painter", "Skeleton", "save_gif"]

MOST_ARMS = 16  # arms in one image
PAPER, GROUND, SHADOW, INK = "#f7f8fa", "#eef1f4", "#cfd6de", "#2f4156"
RULE = "#d9dfe6"  # lines on the ground
LINK, TIP, TARGET, OBJECT = "#7d9fc0", "#f2a541", "#d1344b", "#1d6b57"
AZIMUTH, ELEVATION = math.radians(-55.0), math.radians(25.0)  # direction of the camera, which is far away [rad]
LIGHT = np.array([-0.35, 0.65, 0.67])  # direction to the light, in axes of the camera
SPACING = 1.2  # of points on surfaces, in those of the image
PIECES = 6  # of a line on the ground, which follows it
RULES = 4  # lines on the ground in a radius of the view
SHADE = -1e3  # nearness of shadows, in radii of the view: farther than every robot
RIM = 0.05  # step in nearness at which an outline is drawn, in radii of the view


def _library(module: str) -> Any:
    """Module of a library that only drawing needs."""
    package = module.partition(".")[0].replace("PIL", "Pillow")
    return imported(module, package, "drawing", "'torchdq[viz]'")


def _rows(name: str, x: Any, *axes: int, most: int | None = None) -> Tensor:
    """Rows [k, *axes] of an argument of shape [*axes] or, with k <= most, [k, *axes]; None: any number."""
    rows = torch.as_tensor(x, dtype=torch.float64, device="cpu").detach()
    one, several = rows.shape == axes, rows.shape[1:] == axes and 0 < len(rows) <= (most or len(rows)) and most != 1
    if not (one or several):
        size = ", ".join(map(str, axes))
        expected = f"[{size}]" if most == 1 else f"[{size}] or [k, {size}]"
        expected += f" with k from 1 to {most}" if most and most > 1 else ""
        raise ArgumentError(f"{name} must have the shape {expected}, found {tuple(rows.shape)}")
    return rows[None] if one else rows


def room(robot: Robot) -> tuple[Tensor, Tensor]:
    """Lower and upper limits [n] of the joints; half a turn or a metre either way where there are none."""
    free = torch.tensor([math.pi if joint.turns else 1.0 for joint in robot.joint_types], dtype=torch.float64)
    lower, upper = (x.double() for x in robot.limits[:2])
    return torch.where(lower.isfinite(), lower, -free), torch.where(upper.isfinite(), upper, free)


class Skeleton:
    """Points of a robot and the lines between them.

    The points are the base, every link's origin, the points on joint axes that are nearest to the origins, and ends: a
    link that carries no other ends at the end effector, at the last of its frames or, where these are at its origin, at
    its centre of mass. The contact points of a scene are balls. Bodies of links and objects are surfaces, and `sticks`
    are the lines that no body covers. Of a batch it is the first.

    >>> import torchdq
    >>> skeleton = Skeleton(torchdq.robots.load("two_link"))
    >>> skeleton.points([0.0, 0.0])[0, :, 0]  # base, link 1, joint 1, link 2, joint 2, tip
    array([0. , 0.5, 0. , 1.5, 1. , 2. ])
    """

    def __init__(self, what: Robot | SceneModel):
        scene = what if isinstance(what, SceneModel) else None
        robot = require_robot(what) if scene is None else scene.robot
        contacts: list[Any] = [] if scene is None else [scene.effects[i] for i, _ in scene.spec.of(Contact)]
        if not robot.n:
            raise ArgumentError(f"robot {robot.name!r} must have a joint to be drawn, found none")
        batched = {name: getattr(robot, name).detach() for name in arguments(robot)}
        first = {name: x.reshape(-1, *x.shape[x.ndim - len(SHAPES[name]) :])[0] for name, x in batched.items()}
        self.robot = robot.replace(**first).to(torch.float64, "cpu")
        self.joints: list[int] = []  # point on the axis of each joint
        self.tip: int | None = None  # point of the end effector
        self.lines: list[tuple[int, int]] = []  # points at their ends
        self.balls: list[tuple[int, float]] = []  # contact points, and their radii [m]
        self.ground = _ground(contact for contact in contacts if contact.on is None)  # its height at x and y [m]
        self.objects = [surface_of(body) for body in (() if scene is None else scene.objects)]
        self.bodies = bodies_of(self.robot)  # number of a frame, and the surface in it
        self._frames: list[int] = []  # frame that each point but the base is fixed to
        self._offsets: list[Tensor] = []  # position of the point in that frame [m]

        axes = torch.linalg.cross(*self.robot.screw.split(3, -1))  # nearest to the origin; zero of a prismatic joint
        tip = None if robot.tip is None else self.robot.frame(robot.tip)
        origins: list[int] = []
        for i, (name, parent) in enumerate(zip(robot.link_names, robot.parents, strict=True)):
            origins.append(self._point(name, torch.zeros(3)))
            self.joints.append(self._point(name, axes[i]) if axes[i].norm() > 1e-6 else origins[i])
            self.lines.append((0 if parent == BASE else origins[parent], self.joints[i]))
            if self.joints[i] != origins[i]:
                self.lines.append((self.joints[i], origins[i]))
        if tip is not None:
            self.tip = self._point(tip.name, torch.zeros(3))
            self.lines.append((0 if tip.link == BASE else origins[tip.link], self.tip))
        for i, name in enumerate(robot.link_names):
            ends_in_tip = tip is not None and tip.link == i and translation(tip.X_BF).norm() > 1e-6
            if i not in robot.parents and not ends_in_tip:
                fixed = [(float(translation(f.X_BF).norm()), f.name) for f in robot.frames if f.link == i]
                far, frame = max(fixed)
                end = self._point(frame, torch.zeros(3)) if far > 1e-6 else self._point(name, self.robot.com[i])
                self.lines.append((origins[i], end))
        for p in [p for contact in contacts for p in contact.points if isinstance(p, ContactPoint)]:
            self.balls.append((self._point(p.frame, torch.tensor(p.center)), p.radius))
        self.sticks = self._sticks([BASE, *(robot.frames[i].link for i in self._frames)])

    def _sticks(self, links: list[int]) -> list[tuple[int, int]]:
        """Lines of links whose bodies are less than half as long; `links` are those of all points."""
        points, X = self.placed(torch.zeros(self.robot.n))
        corners = dict[int, list[np.ndarray]]()
        for (i, _), p in zip(self.bodies, self._extremes(X), strict=True):
            corners.setdefault(self.robot.frames[i].link, []).append(p[0])
        sizes = {link: float(np.linalg.norm(np.ptp(np.concatenate(p), 0))) for link, p in corners.items()}
        ends = points[0][self.lines]
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
        carriers = [links[b] if b not in self.joints else links[a] for a, b in self.lines]
        return [
            line
            for line, link, length in zip(self.lines, carriers, lengths, strict=True)
            if 2.0 * sizes.get(link, 0.0) <= length
        ]

    def _point(self, frame: str, offset: Tensor) -> int:
        self._frames.append(self.robot.frame_names.index(frame))
        self._offsets.append(offset.double())
        return len(self._frames)

    def points(self, q: Any, most: int | None = None, X_WB: Any = None) -> np.ndarray:
        """Positions [k, points, 3] in the world [m] at q [rad or m], shape [n] or, with k <= most, [k, n].

        X_WB is the pose of a floating base, shape [8] or [k, 8]; None: at the origin, as a fixed base is.
        """
        return self.placed(q, most, X_WB)[0]

    def placed(self, q: Any, most: int | None = None, X_WB: Any = None) -> tuple[np.ndarray, Tensor]:
        """Positions as of `points`, and the poses [k, bodies, 8] of the bodies."""
        rows = _rows("q", q, self.robot.n, most=most)
        if X_WB is not None and not self.robot.floating:
            raise ArgumentError(f"X_WB must be None, found one for robot {self.robot.name!r}, whose base is fixed")
        base = _rows("X_WB", torch.eye(8)[0] if X_WB is None else X_WB, 8, most=len(rows)).expand(len(rows), 8)
        with torch.no_grad():
            if self.robot.floating:
                X = floating.forward_kinematics(self.robot, base, rows, backend="eager")
            else:
                X = forward_kinematics(self.robot, rows, backend="eager")
            own = X[:, self._frames]
            moving = translation(own) + rotate(rotation(own), torch.stack(self._offsets))
        return torch.cat([translation(base)[:, None], moving], 1).numpy(), X[:, [i for i, _ in self.bodies]]

    def ends(self, q: Any) -> np.ndarray:
        """Positions [k, points, 3] as of `points`, with those of the ends of all bodies."""
        points, X = self.placed(q)
        return np.concatenate([points, *self._extremes(X)], 1)

    def _extremes(self, X: Tensor) -> list[np.ndarray]:
        """Extreme points [k, p, 3] of the bodies at their poses [k, bodies, 8]."""
        placed = zip(X[:, :, None].unbind(1), self.bodies, strict=True)
        return [
            (translation(x) + rotate(rotation(x), torch.from_numpy(body.extremes()))).numpy() for x, (_, body) in placed
        ]

    def poses(self, X_WO: Any, most: int) -> Tensor:
        """Poses [k, objects, 8] of the objects, given as [objects, 8] or, with k <= most, [k, objects, 8]."""
        return _rows("X_WO", X_WO, len(self.objects), 8, most=most)

    def view(self) -> tuple[np.ndarray, float]:
        """Centre [3] and radius [m] of a ball around the robot, from 512 positions within its limits.

        That of a robot with a floating base is around its base, which may turn.
        """
        lower, upper = room(self.robot)
        share = torch.rand(512, self.robot.n, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        points = self.ends(lower + share * (upper - lower)).reshape(-1, 3)
        middle = (points.min(0) + points.max(0)) / 2 * (not self.robot.floating)
        return middle, float(np.linalg.norm(points - middle, axis=-1).max())

    def dots(self, radius: float) -> list[tuple[int, float, str]]:
        """Point, radius [m] and colour of every joint, end effector and contact point, in a view of this radius [m]."""
        share = 0.2 if self.objects else 1.0  # what would hide an object in the hand is small
        bare = {end for line in self.sticks for end in line}
        joints = [(point, 0.0225 * radius, INK) for point in self.joints if point in bare]
        tip = [] if self.tip is None else [(self.tip, 0.0325 * share * radius, TIP)]
        return [*joints, *tip, *((point, max(r, 0.025 * share * radius), TIP) for point, r in self.balls)]


class Painter:
    """Draws images of a robot, or of up to 16 of them side by side.

    Args:
        what: a robot; or a scene, of which the ground, the contact points and the objects are drawn, too.
        size: width and height of the images [pixels].

    Raises:
        MissingLibraryError: matplotlib is not installed.
    """

    def __init__(self, what: Robot | SceneModel, size: tuple[int, int] = (400, 400)):
        if len(size) != 2 or not all(isinstance(x, int) and x >= 16 for x in size):
            raise ArgumentError(f"size must be (width, height), whole numbers from 16, found {size!r}")
        self.size, self.skeleton = size, Skeleton(what)
        self.middle, self.radius = self.skeleton.view()
        right = np.array([-math.sin(AZIMUTH), math.cos(AZIMUTH), 0.0])
        toward = np.array([math.cos(AZIMUTH), math.sin(AZIMUTH), math.tan(ELEVATION)]) * math.cos(ELEVATION)
        self._camera = np.stack([right, np.cross(toward, right), toward], -1)
        self._clouds: dict[tuple[int, float], tuple[np.ndarray, np.ndarray]] = {}  # points and normals of surfaces
        self._artists = _library("matplotlib.collections")
        # a point is a pixel
        self._figure = _library("matplotlib.figure").Figure(figsize=(size[0] / 72, size[1] / 72), dpi=72)
        self._agg = _library("matplotlib.backends.backend_agg").FigureCanvasAgg(self._figure)

    def project(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Pixels [k, ..., 2] from the lower left corner, and nearness [k, ...], of positions [k, ..., 3] of k arms.

        Nearness is measured toward the camera from the middle of the view, in its radii, whose size in pixels is third.
        """
        arms, (width, height) = len(x), self.size
        columns = max(range(1, arms + 1), key=lambda c: min(width / c, height / math.ceil(arms / c)))
        cell = np.array([width / columns, height / math.ceil(arms / columns)])
        at = np.arange(arms)
        centres = np.array([0.0, height]) + (np.stack([at % columns, -1 - at // columns], -1) + 0.5) * cell
        seen = (x - self.middle) @ self._camera / self.radius
        pixels = centres.reshape(-1, *(1,) * (x.ndim - 2), 2) + seen[..., :2] * cell.min() / 2.1
        return pixels, seen[..., 2], cell.min() / 2.1

    def frame(
        self, q: Any, target: Any = None, text: str | None = None, X_WB: Any = None, X_WO: Any = None
    ) -> np.ndarray:
        """Image [height, width, 3], uint8, of one robot or of k <= 16 of them.

        Args:
            q: joint positions [rad or m], shape [n] or [k, n]. A robot whose position is not finite is left out.
            target: marked positions in the world, that of a fixed base [m], shape [3] or [k, 3]; None: none.
            text: text in the upper left corner.
            X_WB: pose of a floating base in the world, shape [8] or [k, 8]; None: at the origin.
            X_WO: poses of the objects of a scene, as in its state, shape [objects, 8] or [k, objects, 8]; None: they
                are left out.
        """
        points, X_WF = self.skeleton.placed(q, MOST_ARMS, X_WB)
        arms = len(points)
        place = points[:, :1] * self.skeleton.robot.floating  # [k, 1, 3], which the view follows
        points = points - place
        goal = np.full((1, 3), np.nan) if target is None else _rows("target", target, 3, most=arms).numpy()
        if len(goal) not in (1, arms):
            raise ArgumentError(f"target must have one row or one for each of the {arms} robots, found {len(goal)}")
        objects, X = self.skeleton.objects if X_WO is not None else [], X_WF
        if objects:
            X = torch.cat([X_WF, self.skeleton.poses(X_WO, arms).expand(arms, -1, 8)], 1)
        X = X + torch.from_numpy(0.0 * points.sum((1, 2)))[:, None, None]  # not a number where the robot is not finite
        self._canvas = Canvas(self.size)
        for i, body in enumerate([*(body for _, body in self.skeleton.bodies), *objects]):
            colour = OBJECT if i >= X_WF.shape[1] else LINK
            self._surface(i, body, X[:, i], place, colour)
        for a, b in self.skeleton.sticks:
            self._stick(points[:, [a]], points[:, [b]], 0.03 * self.radius, LINK, place)
        mark = goal[:, None] - place + 0.0 * points[:, :1]
        dots = [(points[:, [at]], r, colour) for at, r, colour in self.skeleton.dots(self.radius)]
        for middle, r, colour in (*dots, (mark, (0.025 if objects else 0.05) * self.radius, TARGET)):
            self._stick(middle, middle, r, colour, place, 0.06)
        return self._whole(place, text)

    def _whole(self, place: np.ndarray, text: str | None) -> np.ndarray:
        """Image [height, width, 3] of what is on the canvas, with the ground below it."""
        self._figure.clear(keep_observers=False)
        self._figure.set_facecolor(PAPER)
        axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, self.size[0]), ylim=(0, self.size[1]))
        axes.set_axis_off()
        turn = np.linspace(0.0, 2 * np.pi, 97)
        disc = self.radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)[None]
        pixels, _, scale = self.project(_on_ground(self.skeleton.ground, disc, place))
        axes.add_collection(self._artists.PolyCollection(pixels, facecolor=GROUND), autolim=False)
        if self.skeleton.robot.floating or self.skeleton.balls:
            rules = self.project(_on_ground(self.skeleton.ground, _rules(self.radius, place), place))[0]
            rules = self._artists.LineCollection(rules.reshape(-1, 2, 2), linewidths=0.008 * scale, colors=RULE)
            axes.add_collection(rules, autolim=False)
        self._figure.figimage(self._canvas.image(RIM, 0.1 * SHADE, _rgb(INK)), zorder=2)
        self._figure.text(0.03, 0.97, text or "", va="top", color=INK, size=max(8.0, min(self.size) / 28), zorder=3)
        self._agg.draw()
        return np.asarray(self._agg.buffer_rgba())[..., :3].copy()

    def _surface(self, i: int, body: Surface, X: Tensor, place: np.ndarray, colour: str) -> None:
        """Draw body i at poses [k, 8]."""
        spacing = self._spacing(place)
        if (i, spacing) not in self._clouds:
            self._clouds[i, spacing] = body.points(spacing)
        own, normals = self._clouds[i, spacing]
        turn = rotate(rotation(X)[:, None], torch.eye(3, dtype=X.dtype)).numpy()  # rows are the axes
        shift = translation(X)[:, None].numpy() - place
        self._points(own @ turn.astype(np.float32) + shift, normals @ turn.astype(np.float32), colour, place)

    def _stick(self, a: np.ndarray, b: np.ndarray, r: float, colour: str, place: np.ndarray, bias: float = 0.0) -> None:
        """Draw capsules from a to b [k, 1, 3], as rows of balls of which the camera sees one side."""
        length = float(np.nan_to_num(np.linalg.norm(b - a, axis=-1)).max(initial=0.0))
        along = np.linspace(0.0, 1.0, 1 + math.ceil(4.0 * length / r))[:, None]
        u, v = spread(math.ceil(8.0 * (r / self._spacing(place)) ** 2))
        v = 2.0 * math.pi * v
        normals = np.stack([np.sqrt(u) * np.cos(v), np.sqrt(u) * np.sin(v), np.sqrt(1.0 - u)], -1) @ self._camera.T
        p = (a + along * (b - a))[:, :, None] + r * normals
        self._points(p.reshape(len(a), -1, 3), np.tile(normals, (len(along), 1)), colour, place, bias)

    def _spacing(self, place: np.ndarray) -> float:
        """Distance [m] of points on surfaces."""
        return SPACING * self.radius / (FINE * self.project(place)[2])

    def _points(self, p: np.ndarray, normals: np.ndarray, colour: str, place: np.ndarray, bias: float = 0.0) -> None:
        """Draw points [k, p, 3] with normals [k, p, 3] or [p, 3], and their shadows."""
        pixels, nearness, _ = self.project(p)
        n = np.broadcast_to(normals @ self._camera, p.shape)
        light = np.abs(n[..., 2:]).squeeze(-1) * LIGHT[2] + np.sign(n[..., 2]) * (n[..., :2] @ LIGHT[:2])
        self._canvas.add(pixels.reshape(-1, 2), (nearness + bias).ravel(), 1.5 * light.ravel(), _rgb(colour))
        below = self.project(_on_ground(self.skeleton.ground, p[:, ::3], place))[0].reshape(-1, 2)
        self._canvas.add(below, np.full(len(below), SHADE), np.ones(len(below)), _rgb(SHADOW))


class Viewer:
    """A live view of a robot in the browser, at the address `url`, which viser prints.

    Args:
        what: a robot or a scene, as in `Painter`.
        port: port of the address; the next free one is taken.

    Raises:
        MissingLibraryError: viser is not installed.
    """

    def __init__(self, what: Robot | SceneModel, port: int = 8080):
        self.skeleton = Skeleton(what)
        middle, radius = self.skeleton.view()
        self._reach = 2 * radius
        self._server = _library("viser").ViserServer(host="127.0.0.1", port=port)
        self.url = f"http://127.0.0.1:{self._server.get_port()}"
        scene = self._server.scene
        scene.set_up_direction("+z")
        camera = self._server.initial_camera
        camera.look_at, camera.position = tuple(middle), tuple(middle + radius * np.array([1.1, -1.5, 0.7]))
        self.ground = scene.add_line_segments("/ground", np.zeros((1, 2, 3)), colors=_rgb(SHADOW))
        self.base = scene.add_box("/base", color=_rgb(INK), dimensions=(0.18 * radius, 0.18 * radius, 0.02 * radius))
        self.base.visible = all(self.skeleton.robot.frames[i].link != BASE for i, _ in self.skeleton.bodies)
        lines = np.zeros((len(self.skeleton.sticks), 2, 3))
        self.links = scene.add_line_segments("/links", lines, colors=_rgb(LINK), thickness=0.05 * radius)
        names = self.skeleton.robot.frame_names
        self.bodies = [self._mesh(f"/bodies/{names[i]}", body, LINK) for i, body in self.skeleton.bodies]
        self._balls = {
            point: scene.add_icosphere(f"/points/{point}", radius=r, color=_rgb(colour))
            for point, r, colour in self.skeleton.dots(radius)
        }
        self.objects = [self._mesh(f"/objects/{i}", body, OBJECT) for i, body in enumerate(self.skeleton.objects)]
        self.target = scene.add_icosphere("/target", radius=0.045 * radius, color=_rgb(TARGET), visible=False)
        self.show(torch.zeros(self.skeleton.robot.n))

    def show(self, q: Any, target: Any = None, X_WB: Any = None, X_WO: Any = None) -> None:
        """Show the robot at the positions q [n] [rad or m], and a target [3] in the world, that of a fixed base [m].

        X_WB is the pose [8] of a floating base in the world; None: at the origin. X_WO are the poses [objects, 8] of
        the objects of a scene; None: they are not shown.
        """
        (points,), (X_WF,) = self.skeleton.placed(q, 1, X_WB)
        place = points[0] * self.skeleton.robot.floating
        points = points - place
        goal = None if target is None else tuple(_rows("target", target, 3, most=1)[0].numpy() - place)
        poses = torch.eye(8)[:1].expand(len(self.objects), 8) if X_WO is None else self.skeleton.poses(X_WO, 1)[0]
        with self._server.atomic():
            rules = _on_ground(self.skeleton.ground, _rules(self._reach, place[None, None]), place[None, None])
            self.ground.points = rules[0].astype(np.float32)
            if X_WB is not None:
                self.base.wxyz = tuple(_rows("X_WB", X_WB, 8, most=1)[0, :4].tolist())
            self.links.points = points[self.skeleton.sticks].reshape(-1, 2, 3).astype(np.float32)
            for point, ball in self._balls.items():
                ball.position = tuple(points[point])
            for body, X in (*zip(self.bodies, X_WF, strict=True), *zip(self.objects, poses, strict=True)):
                body.wxyz, body.position = rotation(X).numpy(), translation(X).numpy() - place
            for body in self.objects:
                body.visible = X_WO is not None
            self.target.visible = goal is not None
            if goal is not None:
                self.target.position = goal

    def _mesh(self, name: str, body: Surface, colour: str) -> Any:
        vertices = body.vertices.astype(np.float32)
        return self._server.scene.add_mesh_simple(
            name, vertices, body.faces, color=_rgb(colour), flat_shading=True, side="double"
        )

    def close(self) -> None:
        """Stop serving the view."""
        self._server.stop()


def _ground(contacts: Iterable[Any]) -> Callable[[Tensor, Tensor], Any]:
    """Height of the ground at x and y [m]: that of the first of contacts, of its first robot; without any, zero."""
    found = next(iter(contacts), Contact())
    height, normal = (tensor_of(x).detach().double().cpu() for x in (found.height, found.normal))
    height, (a, b, c), surface = height.reshape(-1)[0], normal.reshape(-1, 3)[0], found.surface
    if surface is None:
        return lambda x, y: (height - a * x - b * y) / c
    if isinstance(surface, HeightMap):
        heights = surface.heights.detach().cpu()
        first = replace(surface, heights=heights.reshape(-1, *heights.shape[-2:])[0])
        return lambda x, y: height + first(x, y)[0]
    return lambda x, y: height + surface(x, y)


def _rules(radius: float, place: np.ndarray) -> np.ndarray:
    """Lines [k, lines, 2, 3] along x and y of the world within a radius, seen from places [k, 1, 3]."""
    step = radius / RULES
    at = step * np.arange(1 - RULES, RULES + 1) - place[..., :2].swapaxes(1, 2) % step  # [k, 2, lines]
    half = np.sqrt(np.maximum(radius**2 - at**2, 0.0))
    ends = np.stack([np.stack([at, -half], -1), np.stack([at, half], -1)], -2)
    ends[:, 1] = ends[:, 1, ..., ::-1]
    return _pieces(np.pad(ends, ((0, 0),) * 4 + ((0, 1),)).reshape(len(place), -1, 2, 3))


def _pieces(lines: np.ndarray) -> np.ndarray:
    t = np.linspace(0.0, 1.0, PIECES + 1)[:, None]
    cuts = lines[:, :, :1] * (1 - t) + lines[:, :, 1:] * t
    return np.stack([cuts[:, :, :-1], cuts[:, :, 1:]], -2).reshape(len(lines), -1, 2, 3)


def _on_ground(ground: Callable[[Tensor, Tensor], Any], x: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Positions [k, ..., 3] below or above those, on the ground; all are seen from places [k, 1, 3]."""
    place = place.reshape(-1, *(1,) * (x.ndim - 2), 3)
    found = torch.from_numpy(x + place)
    found[..., 2] = torch.as_tensor(ground(*found[..., :2].unbind(-1)))
    return found.numpy() - place


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:]))


def save_gif(frames: Iterable[np.ndarray], path: str | Path, fps: float = 25.0) -> None:
    """Write images as a film that repeats itself.

    Times of a GIF are hundredths of a second; an image equal to the one before lengthens that one.

    Args:
        frames: images [height, width, 3], uint8, of one size.
        path: path of the file.
        fps: images per second, up to 50.

    Raises:
        MissingLibraryError: Pillow is not installed.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "film.gif"
    >>> save_gif([np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), 255, np.uint8)], file)
    >>> file.read_bytes()[:3]
    b'GIF'
    """
    images = [np.asarray(frame) for frame in frames]
    found = sorted({f"{image.dtype}{list(image.shape)}" for image in images})
    if len(found) != 1 or images[0].dtype != np.uint8 or images[0].shape[2:] != (3,):
        raise ArgumentError(f"frames must be uint8 [height, width, 3] of one size, found {', '.join(found) or 'none'}")
    if not 0 < fps <= 50:
        raise ArgumentError(f"fps must be above 0 and at most 50, found {fps!r}")
    image = _library("PIL.Image")
    first, *others = [image.fromarray(x) for x in images]
    first.save(path, format="GIF", save_all=True, append_images=others, duration=10 * round(100 / fps), loop=0)
