"""Arms that pick a cube each as a film: the policy of `31_hands_ppo.py`, from a start of its own for every arm.

    python examples/36_hands_film.py [out/pick.pt]

All arms are rows of one environment. Each brings its cube, of a mass, a size and a friction of its own, to the red dot.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import films
import numpy as np
import torch
import tyro
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from torch import Tensor

from torchdq import dq
from torchdq.envs import RobotVectorEnv
from torchdq.envs.manipulation import PERIOD, Pick
from torchdq.envs.render import Skeleton

arms, walk, play = (import_module(name) for name in ("00_a_thousand_arms", "25_walk_film", "32_hands_in_mujoco"))
WIDTH, HEIGHT, ZOOM = 960, 400, 4.2  # of the film [pixels], and of its camera
ALONG, ACROSS, REACH = 0.86, 0.75, 0.27  # distances between arms, between rows, and of the middle of an arm [m]
CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])  # of a cube, and of its faces
FACES = np.array([(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)])
FLAT = np.array([1.0, 1.0, 0.0])
CUBE, GOAL = "#43c59e", "#ff5964"


@dataclass
class Args:
    policy: tyro.conf.Positional[Path] = Path("out/pick.pt")
    """File of `31_hands_ppo.py`."""
    arms: int = 12
    """Number of arms."""
    frames: int = 48
    """Images of the film, 20 in a second."""
    quality: int = 40
    """Quality of the images, 1 to 100."""
    out: Path = Path("out")
    """Folder of the film."""


class Motion(NamedTuple):
    """Motion of all arms, their cubes and goals."""

    q: Tensor  # [frame, arm, joint]
    X_WO: Tensor  # [frame, arm, 8]
    size: Tensor  # [arm, 3]
    goal: Tensor  # [arm, 3]
    success: Tensor  # [arm], at the end


def places(count: int) -> np.ndarray:
    """Places [count, 3] of the bases: the nearest ones of a lattice that the camera sees, far ones first."""
    x, y = np.meshgrid(np.arange(-12, 12.0), np.arange(12.0))
    lattice = np.stack([ALONG * (x + y % 2 / 2) - REACH, ACROSS * y, 0 * x], -1).reshape(-1, 3)
    across = walk.project(lattice + np.array([REACH, 0.0, 0.0]), ZOOM)[0][:, 0]
    seen = lattice[(across > 100) & (across < WIDTH - 100)]
    return seen[np.argsort(seen[:, 1], kind="stable")[:count]][::-1].copy()


@torch.no_grad()
def simulated(envs: RobotVectorEnv, policy: torch.nn.Module, frames: int) -> Motion:
    """Motion of all arms."""
    observation, _ = envs.reset(seed=0)
    drawn, found, info = envs.get_state(), [], {}
    for _ in range(frames):
        found.append((envs.state.q.double(), envs.state.X_WO[:, 0].double()))
        observation, _, _, _, info = envs.step(policy(observation))
    q, X_WO = map(torch.stack, zip(*found, strict=True))
    return Motion(q, X_WO, drawn["-4.size"].double(), drawn["goal"], info["success"])


def cubes(X_WO: Tensor, size: Tensor, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces [arm, face, corner, 3] of the cubes, which of them the camera sees, and their brightness."""
    corners = 0.5 * size[:, None] * torch.from_numpy(CORNERS)
    corners = dq.translation(X_WO)[:, None] + dq.rotate(dq.rotation(X_WO)[:, None], corners)
    faces = (corners.numpy() + at[:, None])[:, FACES]
    middle = faces.mean(2)
    normal = middle - middle.mean(1, keepdims=True)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    seen = (normal * (arms.EYE / ZOOM - middle)).sum(-1) > 0
    return faces, seen, 0.75 + 0.25 * normal[..., 2] - 0.2 * normal[..., 0]


def moves(figure: Figure, skeleton: Skeleton, at: np.ndarray, motion: Motion) -> Iterator[None]:
    """Draw all arms, their shadows, cubes and goals, row by row; every time it is asked, they move on."""
    panel = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(0, HEIGHT))
    panel.set_axis_off()
    goal, near = walk.project(motion.goal.numpy() + at, ZOOM)
    dark, mist = (np.array(to_rgb(colour)) for colour in (films.CARD, films.FOG))
    lines = [(a, b) for a, b in skeleton.lines if b != skeleton.tip]  # which would hide the cube
    start = skeleton.points(motion.q[0, 0])[0]
    pads = [  # lines to every pad from the finger that is nearest
        (min(skeleton.joints[-2:], key=lambda k, pad=pad: np.linalg.norm(start[k] - start[pad])), pad)
        for pad, _ in skeleton.balls
    ]
    grid = np.array([[(x * ALONG / 2 - REACH, -1.0, 0.0), (x * ALONG / 2 - REACH, 9.0, 0.0)] for x in range(-20, 22)])
    for q, X in zip(motion.q, motion.X_WO, strict=True):
        for artist in [*panel.collections]:
            artist.remove()
        panel.add_collection(LineCollection(walk.project(grid, ZOOM)[0], linewidths=0.8, colors=films.FOG, zorder=-1e3))
        points, (faces, seen, light) = skeleton.points(q, len(q)) + at[:, None], cubes(X, motion.size, at)
        for y in sorted({*at[:, 1]}, reverse=True):
            (own,) = np.nonzero(at[:, 1] == y)
            fog = 0.8 * (near[own[0]] - near.min()) / max(np.ptp(near), 1e-9)
            scale = 0.72 * ZOOM * arms.FOCUS / near[own[0]]  # points in a metre
            arm, cube, red = (np.array(to_rgb(x)) * (1.0 - fog) + mist * fog for x in (films.FAST, CUBE, GOAL))
            links, fingers = (points[own][:, ends].reshape(-1, 2, 3) for ends in (lines, pads))
            sides, shown = faces[own].reshape(-1, 4, 3), seen[own]
            colours = np.clip(light[own][shown][:, None] * cube, 0.0, 1.0)
            for x, width, colour in (
                (sides * FLAT, 0.0, 0.55 * dark),
                (links * FLAT, 0.045, 0.55 * dark),
                (links, 0.045, arm),
                (faces[own][shown], 0.0, colours),
                (fingers, 0.01, arm),
            ):
                kind, name = (LineCollection, "colors") if width else (PolyCollection, "facecolors")
                style = {name: colour, "linewidths": width * scale, "capstyle": "round", "zorder": -y}
                panel.add_collection(kind(walk.project(x, ZOOM)[0], **style))
            panel.scatter(*goal[own].T, s=(0.022 * scale) ** 2, color=[red], linewidths=0, zorder=-y)
        yield


def main(args: Args) -> tuple[Path, float]:
    """File of the film, and the share of the arms that succeed."""
    torch.set_num_threads(1)
    at = places(args.arms)
    envs = RobotVectorEnv(len(at), Pick(), "panda_hand", max_episode_steps=None)
    motion = simulated(envs, play.policy_of(args.policy, envs), args.frames)
    subtitle = "each brings its own to the red dot; a policy learned in two minutes on one core"
    figure = films.card(WIDTH, HEIGHT, f"{len(at)} arms pick a cube, one program", subtitle)
    path = args.out / "pick.webp"
    films.save(figure, moves(figure, Skeleton(envs.scene), at, motion), path, round(1e3 * PERIOD), args.quality)
    return path, float(motion.success.double().mean())


if __name__ == "__main__":
    path, success = main(tyro.cli(Args))
    print(f"{path}, {path.stat().st_size / 1e6:.2f} MB; {success:.0%} succeed")
    sys.exit(success < 0.9)
