"""4096 arms reach for 4096 points: a batched gymnasium environment, a policy of five lines, and a film.

    python examples/05_environment.py [--device cuda]

Every arm is its own: link masses and friction differ by up to 20 %, and the controller knows nothing of it. Actions are
offsets of the joint positions that a computed-torque controller follows; the policy takes the way to the goal through
the damped inverse of the Jacobian. `out/reach.gif` shows nine of the arms.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import torch
import tyro
from devices import OnDevice

import torchdq
import torchdq.envs  # registers the environments
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
    """Folder of the film."""


def main(args: Args) -> tuple[torch.Tensor, float]:
    """Distances at the end [arms], and environment steps per second."""
    torch.set_num_threads(1)
    envs = gymnasium.make_vec(
        "torchdq/Reach-v0",
        num_envs=args.arms,
        robot="panda",
        action="reference",
        scale=0.2,
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

    painter, frames = Painter(robot, (480, 480)), []
    observation, _ = envs.reset(seed=0)
    spent = 0.0  # in steps, without the first one, which compiles
    for k in range(args.steps):
        action = policy(observation)
        start = time.perf_counter()
        observation, _, _, _, info = envs.step(action)
        if action.is_cuda:
            torch.cuda.synchronize(action.device)
        spent += time.perf_counter() - start if k else 0.0
        if k % 3 == 0:
            now = envs.unwrapped.get_state()
            frames.append(painter.frame(now["q"][:9].cpu(), now["goal"][:9].cpu()))
    args.out.mkdir(parents=True, exist_ok=True)
    save_gif(frames, args.out / "reach.gif", fps=50 / 3)
    distance, rate = info["distance"], args.arms * (args.steps - 1) / spent
    where = "on one thread" if args.device == "cpu" else f"on {args.device}"
    print(f"{args.arms} arms, {args.steps} steps: {rate / 1e6:.1f} million environment steps per second, {where}")
    share = float((distance < 0.01).float().mean())
    print(f"distance to the goal at the end: median {1e3 * float(distance.median()):.1f} mm, below 10 mm {share:.0%}")
    return distance, rate


if __name__ == "__main__":
    distance, _ = main(tyro.cli(Args))
    sys.exit(0 if float(distance.median()) < 0.01 else 1)
