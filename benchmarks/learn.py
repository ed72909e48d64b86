"""How fast a policy learns in Reach, on one core: the line of the guide, PPO of Stable-Baselines3, and PPO on blocks.

    python benchmarks/learn.py [--quick] [--seconds S] [--seeds N] [--blocks] [--json FILE] [--page]

The policy is tested while it learns, on 512 episodes that training never saw: distance from the goal at the end of an
episode, and success as the task defines it. The clock is the processor time of training alone, which other work on the
machine does not change. Beside PPO: no policy, and one that is given the arm's kinematics, which PPO is not (the damped
inverse of the Jacobian, towards the goal). PPO on blocks is that of examples/21_walk_ppo.py; with --blocks it learns
alone, and what is stored of the other stays. With --page it stores benchmarks/results/learning.json and writes
docs/environments.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import report
import torch
from pages import environment_page
from pages.environment_cases import towards
from pages.environment_page import situation
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed

from torchdq.envs import RobotVectorEnv
from torchdq.envs.sb3 import StableBaselinesVecEnv

# the guide's, to the letter
LINE = 'PPO("MlpPolicy", vec, n_steps=25, batch_size=1600, n_epochs=5, learning_rate=2e-3, gamma=0.95)'
TASK, ARMS, EVERY = "reach", 256, 10.0  # seconds between tests
TESTS, UNSEEN = 512, 1_000_000  # episodes, and their seed
BLOCKS = {"epochs": 3, "value_epochs": 3, "parts": 4, "gamma": 0.95, "entropy": 0.0}
BLOCKS |= {"change": 0.03, "std": 1.0, "unit": 0.5}
WIDE, SHORT, OFTEN, SEEDS = 512, 30.0, 2.0, 5  # arms, seconds of training and between tests, and seeds of PPO on blocks
GOOD = -14.9  # mean return of a policy that has learned to come near
Policy = Callable[[RobotVectorEnv, torch.Tensor], torch.Tensor]


class Tested(NamedTuple):
    """Result of a policy on unseen episodes."""

    seconds: float  # of training
    steps: int
    distance: float  # median at the end [m]
    success: float  # share of the episodes
    total: float  # mean return


def tested(policy: Policy, seconds: float = 0.0, steps: int = 0) -> Tested:
    """Result of a policy after so much training."""
    envs = RobotVectorEnv(TESTS, TASK)
    observation, _ = envs.reset(seed=UNSEEN)
    total = torch.zeros(TESTS)
    for _ in range(envs.max_episode_steps or 0):
        observation, reward, _, _, info = envs.step(policy(envs, observation))
        total += reward
    last = info["final_info"]
    success = float((last["success"] == 1).float().mean())
    return Tested(seconds, steps, float(last["distance"].nanmedian()), success, float(total.mean()))


def nothing(envs: RobotVectorEnv, observation: torch.Tensor) -> torch.Tensor:
    """No action: the arm stands still."""
    return torch.zeros(envs.action_space.shape)


def kinematic(envs: RobotVectorEnv, observation: torch.Tensor) -> torch.Tensor:
    """Towards the goal by the damped inverse of the Jacobian."""
    return towards(situation(envs))


class Watch(BaseCallback):
    """Tests of a policy on the way, and the end of its training after so many seconds of processor time."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds, self.curve = seconds, list[Tested]()
        self.start = time.process_time()

    def spent(self) -> float:
        """Processor time of training [s]."""
        return time.process_time() - self.start

    def test(self) -> None:
        """Test the policy now, off the clock."""
        before = self.spent()

        def greedy(envs: RobotVectorEnv, observation: torch.Tensor) -> torch.Tensor:
            return torch.as_tensor(self.model.predict(observation.numpy(), deterministic=True)[0])

        self.curve.append(found := tested(greedy, before, self.num_timesteps))
        print(f"{before:6.1f} s {found.steps / 1e6:6.2f} million steps: {words(found)}", flush=True)
        self.start += self.spent() - before

    def _on_rollout_start(self) -> None:
        if EVERY * len(self.curve) <= self.spent() < self.seconds:
            self.test()

    def _on_step(self) -> bool:
        return self.spent() < self.seconds


def words(found: Tested) -> str:
    """Result in words."""
    return f"median {1e3 * found.distance:.1f} mm, success {found.success:.0%}, return {found.total:.1f}"


def train(seed: int, seconds: float) -> list[Tested]:
    """Results of the policy of the guide while it learns."""
    set_random_seed(seed)
    vec = StableBaselinesVecEnv(RobotVectorEnv(ARMS, TASK, "panda"))
    vec.seed(seed * 1000)
    model, watch = eval(LINE, {"PPO": PPO, "vec": vec}), Watch(seconds)
    model.learn(10**9, callback=watch)
    watch.test()
    return watch.curve


def train_on_blocks(seed: int, seconds: float) -> list[Tested]:
    """Results of the policy of PPO on blocks while it learns."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    ppo = import_module("21_walk_ppo")
    learner = ppo.PPO(RobotVectorEnv(WIDE, TASK, "panda"), seed, ppo.Settings(**BLOCKS))

    def greedy(envs: RobotVectorEnv, observation: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return BLOCKS["unit"] * learner.policy(observation)

    learner.rollout()  # compiles
    curve, spent, steps = list[Tested](), 0.0, 0
    while spent < seconds:
        if spent >= OFTEN * len(curve):
            curve.append(tested(greedy, spent, steps))
            print(f"{spent:6.1f} s {steps / 1e6:6.2f} million steps: {words(curve[-1])}", flush=True)
        start = time.process_time()
        samples, _ = learner.rollout()
        learner.update(samples)
        spent, steps = spent + time.process_time() - start, steps + len(samples[0])
    return [*curve, tested(greedy, spent, steps)]


def main() -> None:
    """Train with every seed, and store what was found."""
    parser = report.parser(__doc__, quick="one seed, ten seconds")
    parser.add_argument("--seconds", type=float, default=180.0, help="processor time of training")
    parser.add_argument("--seeds", type=int, default=3, help="how often it is trained")
    parser.add_argument("--blocks", action="store_true", help="train PPO on blocks alone")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    seeds, seconds = (1, 10.0) if arguments.quick else (arguments.seeds, arguments.seconds)
    found = json.loads(environment_page.LEARNED.read_text(encoding="utf-8"))["learning"][TASK]
    if not arguments.blocks:
        found = {"line": LINE, "arms": ARMS, "tests": TESTS}
        found["seeds"] = [train(seed, seconds) for seed in range(seeds)]
    found["policies"] = {"no action": tested(nothing), "kinematics known": tested(kinematic)}
    several = range(1 if arguments.quick else SEEDS)
    found["blocks"] = [train_on_blocks(seed, min(seconds, SHORT)) for seed in several]
    reached = [next((x.seconds for x in curve if x.total >= GOOD), float("inf")) for curve in found["blocks"]]
    print(f"return {GOOD} on blocks after {', '.join(f'{x:.1f}' for x in reached)} s")
    for name, result in found["policies"].items():
        print(f"{name}: {words(result)}")
    facts = {"machine": report.machine("stable-baselines3"), "learning": {TASK: found}}
    report.into_json(arguments.json, **facts)
    if arguments.page:
        import environments
        from pages.text import write

        report.into_json(environment_page.LEARNED, **facts)
        write(environments.FOLDER, environments.pages() | environments.pictures())


if __name__ == "__main__":
    main()
