"""4096 arms reach for 4096 points: a batched gymnasium environment, a policy of five lines, and a film.

    python examples/05_environment.py [--device cuda]

Link masses and friction of each arm differ by up to 20 %, unknown to the controller. Actions are offsets of the joint
positions that a computed-torque controller tracks; the policy moves towards the goal with the damped inverse of the
Jacobian. `out/reach.gif` shows nine of the arms, `out/reach.png` the distances of all.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
import torch
import tyro
from devices import OnDevice
from matplotlib import pyplot as plt
from pictures import BLUE, prepare, save

import torchdq
from torchdq.envs import Actions  # registers the environments
from torchdq.envs.render import Painter, save_gif


@dataclass
class Args(OnDevice):
    arms: int = 4096
    """Number of environments."""
    steps: int = 120
    """Steps of 20 ms."""
    damping: float = 0.05
    """Damping of the inverse of the Jacobian [m]."""
    out: Path = Path("out")
    """Folder of the film and the picture."""


def main(args: Args) -> tuple[torch.Tensor, float]:
    """Distances at the end [arms], and environment steps per second."""
    torch.set_num_threads(1)
    envs = gymnasium.make_vec(
        "torchdq/Reach-v0",
        num_envs=args.arms,
        robot="panda",
        action=Actions("reference", scale=0.2),
        randomise={"mass": 0.2, "friction": 0.2},
        max_episode_steps=args.steps + 1,
        output="torch",
        device=args.device,
    )
    robot = torchdq.robots.load("panda").to(args.device)
    n, tip = robot.n, robot.end_effector().name

    def policy(observation: torch.Tensor) -> torch.Tensor:
        turns, way = observation[:, : 2 * n], observation[:, 3 * n : 3 * n + 3]
        q = torch.atan2(turns[:, ::2], turns[:, 1::2])
        J = torchdq.jacobian(robot, q, tip, expressed="world")[:, 3:]
        damped = J @ J.mT + args.damping**2 * torch.eye(3, device=J.device)
        return (J.mT @ torch.linalg.solve(damped, way[:, :, None])).squeeze(-1) / 0.2

    painter, frames, distances = Painter(robot, (480, 480)), [], []
    observation, _ = envs.reset(seed=0)
    spent = 0.0  # in steps, without the first one, which compiles
    for k in range(args.steps):
        action = policy(observation)
        start = time.perf_counter()
        observation, _, _, _, info = envs.step(action)
        if action.is_cuda:
            torch.cuda.synchronize(action.device)
        spent += time.perf_counter() - start if k else 0.0
        distances.append(info["distance"].cpu())
        if k % 3 == 0:
            now = envs.unwrapped.get_state()
            frames.append(painter.frame(now["q"][:9].cpu(), now["goal"][:9].cpu()))
    args.out.mkdir(parents=True, exist_ok=True)
    save_gif(frames, args.out / "reach.gif", fps=50 / 3)
    draw(frames[-1], torch.stack(distances), args.out / "reach.png")
    distance, rate = info["distance"], args.arms * (args.steps - 1) / spent
    where = "on one thread" if args.device == "cpu" else f"on {args.device}"
    print(f"{args.arms} arms, {args.steps} steps: {rate / 1e6:.1f} million environment steps per second, {where}")
    share = float((distance < 0.01).float().mean())
    print(f"distance to the goal at the end: median {1e3 * float(distance.median()):.1f} mm, below 10 mm {share:.0%}")
    return distance, rate


def draw(frame: np.ndarray, distances: torch.Tensor, path: Path) -> None:
    """Nine arms at the end, and the distances [steps, arms] of all of them over time."""
    prepare()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.9), width_ratios=(4, 5), layout="constrained")
    left.imshow(frame)
    left.set_axis_off()
    left.set_title("nine of the arms, at the end")
    time = 0.02 * torch.arange(1, len(distances) + 1)
    low, middle, high = (1e3 * distances.double().quantile(part, 1) for part in (0.05, 0.5, 0.95))
    right.fill_between(time, low, high, color=BLUE, alpha=0.25, linewidth=0, label="nine of ten arms")
    right.plot(time, middle, color=BLUE, label="median")
    right.set(xlabel="time [s]", ylabel="distance to the goal [mm]", yscale="log", title=f"{distances.shape[1]} arms")
    right.legend()
    save(figure, path)


if __name__ == "__main__":
    distance, _ = main(tyro.cli(Args))
    sys.exit(0 if float(distance.median()) < 0.01 else 1)
