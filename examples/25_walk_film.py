"""A herd of quadrupeds as a film: the policy of `21_walk_ppo.py`, with a command of its own for every robot.

    python examples/25_walk_film.py [out/walk.pt]

All robots are rows of one environment. The camera goes with the herd; the orange robot is commanded to turn.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import films
import numpy as np
import torch
import tyro
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from torch import Tensor

import torchdq
from torchdq import dq
from torchdq.envs import RobotVectorEnv
from torchdq.envs.render import Skeleton
from torchdq.envs.walk import Walk

arms, play, ppo = (import_module(name) for name in ("00_a_thousand_arms", "23_policy_in_mujoco", "21_walk_ppo"))
WIDTH, HEIGHT, ZOOM = 960, 400, 1.5  # of the film [pixels], and of its camera
SPEED, WARM = 0.75, 1.5  # of the herd [m/s], and time before the film [s]
SPACING = 1.15  # between robots [m]


@dataclass
class Args:
    policy: tyro.conf.Positional[Path] = Path("out/walk.pt")
    """File of `21_walk_ppo.py`."""
    robots: int = 90
    """Number of robots."""
    frames: int = 48
    """Images of the film, 15 in a second."""
    quality: int = 40
    """Quality of the images, 1 to 100."""
    out: Path = Path("out")
    """Folder of the film."""


def project(x: np.ndarray, zoom: float = ZOOM) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [..., 2] from the lower left corner, and distances [...] [m / zoom], of places seen from the camera."""
    seen, depth = arms.project(x * zoom)
    return seen + np.array([(WIDTH - arms.VIEW) / 2, 0.0]), depth


def places(count: int) -> np.ndarray:
    """Places [count, 3] on the ground [m]: the nearest ones of a lattice that the camera sees, far ones first."""
    x, y = np.meshgrid(np.arange(-20, 21.0), np.arange(24.0))
    lattice = SPACING * np.stack([x + y % 2 / 2, y - 1.0, 0 * x], -1).reshape(-1, 3)
    across = project(lattice)[0][:, 0]
    seen = lattice[(across > 40) & (across < WIDTH - 40)]
    return seen[np.argsort(seen[:, 1], kind="stable")[:count]][::-1].copy()


@torch.no_grad()
def simulated(policy: torch.nn.Module, at: np.ndarray, frames: int, chosen: int) -> tuple[Tensor, Tensor, int]:
    """Joint positions [frame, robot, joint] and poses [frame, robot, 8], and the number of robots that fell."""
    envs = RobotVectorEnv(len(at), Walk(), "go2", max_episode_steps=None)
    observation, _ = envs.reset(seed=0)
    state, generator = envs.get_state(), torch.Generator().manual_seed(0)
    moved = dq.from_pose(torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.from_numpy(at).float())
    goal = torch.zeros(len(at), 3)
    goal[:, 0], goal[:, 2] = SPEED, 0.05 * torch.randn(len(at), generator=generator)
    envs.set_state({**state, "X_WB": dq.mul(moved, state["X_WB"]), "goal": goal})
    found, fell = [], 0
    every = 1 / 15 / envs.scene.dt
    wanted = {round(WARM / envs.scene.dt + k * every) for k in range(frames)}
    for k in range(max(wanted) + 1):
        if k == min(wanted):
            goal[chosen, 2] = 1.0
            envs.set_state({**envs.get_state(), "goal": goal})
        observation, _, terminated, _, _ = envs.step(ppo.UNIT * policy(observation))
        fell += int(terminated.sum())
        if k in wanted:
            now = envs.get_state()
            found.append((now["q"].double(), now["X_WB"].double()))
    return *map(torch.stack, zip(*found, strict=True)), fell


def main(args: Args) -> tuple[Path, int]:
    """File of the film, and the number of robots that fell."""
    torch.set_num_threads(1)
    at = places(args.robots)
    chosen = int(np.argmin(np.abs(at[:, 0] + 1.0) + np.abs(at[:, 1] - 1.0)))
    q, X, fell = simulated(play.policy_of(args.policy), at, args.frames, chosen)
    skeleton = Skeleton(torchdq.robots.load("go2"))
    robot, mist = (np.array(to_rgb(colour)) for colour in (films.FAST, films.FOG))
    subtitle = f"a policy learned in {ppo.Args.seconds:.0f} s on one core"
    figure = films.card(WIDTH, HEIGHT, f"{len(at)} quadrupeds, one program", subtitle)
    panel = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(0, HEIGHT))
    panel.set_axis_off()
    rules = LineCollection([], colors=films.FOG, linewidths=0.8)
    panel.add_collection(rules, autolim=False)
    grid = np.array([[(x, -2.0, 0.0), (x, 26.0, 0.0)] for x in range(-40, 60)])
    drawn = films.Bodies(figure, (WIDTH, HEIGHT), project, arms.EYE / ZOOM, ZOOM * arms.FOCUS)
    bodies = [body for _, body in skeleton.bodies]

    def moves() -> Iterator[None]:
        for k, (joints, poses) in enumerate(zip(q, X, strict=True)):
            camera = np.array([SPEED * (WARM + k / 15), 0.0, 0.0])
            points, placed = skeleton.placed(joints, X_WB=poses)
            near = project(points[:, 0] - camera)[1][:, None]
            fog = 0.9 * np.clip((near - near.min()) / np.ptp(near), 0, 1) ** 0.6
            colours = robot * (1 - fog) + mist * fog
            colours[chosen] = to_rgb(films.CHOSEN)
            drawn.add(bodies, placed, np.broadcast_to(-camera, (len(at), 3)), colours)
            drawn.show(0.1)
            rules.set_segments(project(grid - camera)[0])
            yield

    path = args.out / "walk.webp"
    films.save(figure, moves(), path, 67, args.quality)
    return path, fell


if __name__ == "__main__":
    path, fell = main(tyro.cli(Args))
    print(f"{path}, {path.stat().st_size / 1e6:.2f} MB; {fell} robots fell")
    sys.exit(fell > 0)
