"""Arms that pick a cube each as a film: the policy of `31_hands_ppo.py`, from a start of its own for every arm.

    python examples/36_hands_film.py [out/pick.pt]

All arms are rows of one environment. Each brings its cube, of a mass, a size and a friction of its own, to the red dot.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import films
import numpy as np
import torch
import tyro
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from torch import Tensor

from torchdq import dq
from torchdq.envs import RobotVectorEnv
from torchdq.envs.bodies import surface_of
from torchdq.envs.manipulation import PERIOD, Pick
from torchdq.envs.render import Skeleton
from torchdq.objects import Ball, Box

arms, walk, play = (import_module(name) for name in ("00_a_thousand_arms", "25_walk_film", "32_hands_in_mujoco"))
WIDTH, HEIGHT, ZOOM = 960, 400, 4.2  # of the film [pixels], and of its camera
ALONG, ACROSS, REACH = 0.86, 0.75, 0.27  # distances between arms, between rows, and of the middle of an arm [m]
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


def moves(figure: Figure, skeleton: Skeleton, at: np.ndarray, motion: Motion) -> Iterator[None]:
    """Draw all arms, their shadows, cubes and goals; every time it is asked, they move on."""
    panel = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(0, HEIGHT))
    panel.set_axis_off()
    grid = np.array([[(x * ALONG / 2 - REACH, -1.0, 0.0), (x * ALONG / 2 - REACH, 9.0, 0.0)] for x in range(-20, 22)])
    panel.add_collection(LineCollection(walk.project(grid, ZOOM)[0], linewidths=0.8, colors=films.FOG))
    drawn = films.Bodies(figure, (WIDTH, HEIGHT), partial(walk.project, zoom=ZOOM), arms.EYE / ZOOM, ZOOM * arms.FOCUS)
    links, goal = [body for _, body in skeleton.bodies], [surface_of(Ball("goal", 1.0, radius=0.011))]
    cubes = [[surface_of(Box("cube", 1.0, size=size))] for size in motion.size]
    X_WG = dq.from_pose(torch.tensor([1.0, 0.0, 0.0, 0.0]).double(), motion.goal.double())[:, None]
    near = walk.project(motion.goal.numpy() + at, ZOOM)[1][:, None]
    fog = 0.8 * (near - near.min()) / max(np.ptp(near), 1e-9)
    arm, cube, red = (
        np.array(to_rgb(x)) * (1.0 - fog) + np.array(to_rgb(films.FOG)) * fog for x in (films.FAST, CUBE, GOAL)
    )
    for q, X in zip(motion.q, motion.X_WO[:, :, None], strict=True):
        drawn.add(links, skeleton.placed(q)[1], at, arm)
        for k, own in enumerate(cubes):
            drawn.add(own, X[[k]], at[[k]], cube[[k]])
        drawn.add(goal, X_WG, at, red)
        drawn.show(0.1)
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
