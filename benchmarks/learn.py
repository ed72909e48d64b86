"""Does a policy learn in these environments? PPO of stable-baselines3 on Reach, with seeds and intervals.

    python benchmarks/learn.py [--quick] [--steps N] [--seeds N] [--device cuda] [--json FILE] [--page]

Actions are offsets of the joint positions that a joint PD controller with gravity compensation follows. Returns are
sums over episodes of 100 steps from 512 states and goals that training never saw; the interval is the 95 % bootstrap
interval of the mean over seeds. Beside PPO: the policy before training, the controller alone (no offset), and a policy
that is given the arm's kinematics, which PPO is not (the damped inverse of the Jacobian, towards the goal).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import report
import torch
from scipy.stats import bootstrap
from stable_baselines3 import PPO

import torchdq
from torchdq.envs import ArmVectorEnv
from torchdq.envs.sb3 import StableBaselinesVecEnv
from torchdq.scene import controllers

EPISODE, TESTS = 100, 512
Policy = Callable[[torch.Tensor], torch.Tensor]


def environments(number: int, device: str) -> ArmVectorEnv:
    """Environments of a Panda under a PD controller that knows its weight."""
    robot = torchdq.robots.load("panda")
    gains = ([600.0] * 4 + [250.0, 150.0, 50.0], [50.0] * 4 + [25.0, 25.0, 10.0])
    controller = controllers.PD(*gains, model=robot)
    return ArmVectorEnv(
        number,
        "reach",
        robot,
        action="reference",
        controller=controller,
        scale=0.3,
        max_episode_steps=EPISODE,
        device=device,
    )


def evaluate(policy: Policy, device: str) -> tuple[float, float]:
    """Mean return and median final distance [m] on unseen episodes."""
    envs = environments(TESTS, device)
    observation, _ = envs.reset(seed=1_000_000)
    returns = torch.zeros(TESTS, device=device)
    for _ in range(EPISODE):
        observation, reward, _, _, info = envs.step(policy(observation))
        returns += reward
    return float(returns.mean()), float(info["final_info"]["distance"].median())


def nothing(observation: torch.Tensor) -> torch.Tensor:
    """No offset: the controller alone."""
    return observation.new_zeros(len(observation), 7)


def kinematic(observation: torch.Tensor) -> torch.Tensor:
    """Towards the goal by the damped inverse of the Jacobian."""
    robot = torchdq.robots.load("panda").to(observation.device)
    q, way = torch.atan2(observation[:, :14:2], observation[:, 1:14:2]), observation[:, 21:24]
    J = torchdq.jacobian(robot, q, robot.end_effector().name, expressed="world")[:, 3:]
    damped = J @ J.mT + 0.05**2 * torch.eye(3, device=J.device)
    return (J.mT @ torch.linalg.solve(damped, way[:, :, None])).squeeze(-1) / 0.3


def train(seed: int, steps: int, device: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Results of the policy before and after training."""
    envs = StableBaselinesVecEnv(environments(256, device))
    envs.seed(seed * 1000)
    network = {"net_arch": [64, 64], "log_std_init": -0.7}
    rates = {"n_steps": 50, "batch_size": 3200, "n_epochs": 5, "learning_rate": 1e-3, "gamma": 0.97, "gae_lambda": 0.9}
    model = PPO("MlpPolicy", envs, seed=seed, policy_kwargs=network, device=device, **rates)

    def policy(observation: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(model.predict(observation.cpu().numpy(), deterministic=True)[0])

    before = evaluate(policy, device)
    model.learn(steps)
    return before, evaluate(policy, device)


def interval(values: list[float]) -> str:
    """Mean and bootstrap interval."""
    if len(values) < 2:
        return f"{values[0]:.1f}"
    low, high = bootstrap((np.array(values),), np.mean, confidence_level=0.95, rng=0).confidence_interval
    return f"{np.mean(values):.1f} [{low:.1f}, {high:.1f}]"


def main() -> dict[str, list[tuple[float, float]]]:
    parser = report.parser(__doc__, quick="one seed, a tenth of the steps")
    parser.add_argument("--steps", type=int, default=3_000_000, help="environment steps of training")
    parser.add_argument("--seeds", type=int, default=5, help="how often it is trained")
    parser.add_argument("--device", default="cpu", help="device of the environments and of the training")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds, steps = (1, arguments.steps // 10) if arguments.quick else (arguments.seeds, arguments.steps)
    found: dict[str, list[tuple[float, float]]] = {
        "PD alone": [evaluate(nothing, arguments.device)],
        "PD, given the kinematics": [evaluate(kinematic, arguments.device)],
        "PPO, untrained": [],
        f"PPO, {steps / 1e6:g} million steps": [],
    }
    start = time.process_time()  # which other work on the machine does not change
    for seed in range(seeds):
        for name, result in zip(list(found)[2:], train(seed, steps, arguments.device), strict=True):
            found[name].append(result)
    spent = (time.process_time() - start) / seeds
    lines = ["| Reach, Panda | return of an episode | distance at its end |", "|---|---|---|"]
    for name, results in found.items():
        returns, distances = zip(*results, strict=True)
        lines.append(f"| {name} | {interval(list(returns))} | {1e3 * np.median(distances):.0f} mm |")
    where = "one thread" if arguments.device == "cpu" else arguments.device
    lines += ["", f"Seeds: {seeds}. Training took {spent:.0f} s of processor time for each, on {where}."]
    text = "\n".join(lines)
    print(text)
    report.finish(arguments, __file__, text, report.machine("stable-baselines3"), results=[found])
    return found


if __name__ == "__main__":
    main()
