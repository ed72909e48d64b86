"""Reinforcement learning on top of computed torque: a policy that compensates model errors.

    python examples/08_residual_rl.py [--quick] [--steps N] [--seeds N] [--device cuda] [--json FILE]

A Panda tracks sums of two sinusoids (`torchdq/Track-v0`, 2 s per episode) under a computed-torque controller with the
nominal rigid bodies, gravity and rotors. Unknown to it are 2 kg in the hand, link masses that differ by up to 10 % (the
payload with them), strong friction (viscous and Stribeck) that differs by up to 20 %, and motors with a delay of one
step and a lag. The policy, PPO of stable-baselines3, adds torques of up to a fifth of the torque limits: 17.4 N m at
the joints 1 to 4, 2.4 N m at the joints 5 to 7. Its last layer is initialised with zeros: the untrained policy is the
controller.

It is trained with the default gains of the environments, 100 / 20, and once more with the best gains for this arm. The
baselines without learning have the same motors: higher gains; the true friction (the torques of its mean at the desired
velocity, as actions); and the true bodies, payload and masses of every episode included. Gains, kp with
kd = 2 d sqrt(kp), are selected on separate episodes, by return; the delay of the torques limits them.

Returns (at most 100) and tracking errors (root mean square over time and joints, mean over episodes) are of 512
episodes that were used neither for training nor for the choice of gains. Intervals are 95 % bootstrap intervals of the
mean: over seeds for trained policies (over episodes if there is one seed), over episodes for everything else.
`out/residual_rl.png` shows the returns during training, and the error of one joint with and without the policies.
"""

import json
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
import tyro
from devices import OnDevice
from gymnasium.vector import AutoresetMode
from matplotlib import pyplot as plt
from pictures import prepare, save
from scipy.stats import bootstrap
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

import torchdq
from torchdq import Scene, effects
from torchdq.envs import Actions, RobotVectorEnv, Simulation
from torchdq.envs.sb3 import StableBaselinesVecEnv
from torchdq.scene.controllers import ComputedTorque
from torchdq.scene.defaults import default_effects, nominal_robot

ROBOT = torchdq.robots.load("panda")
N = ROBOT.n
EPISODE, DT = 100, 0.02  # steps, and their duration [s]
TRAINED, TESTED = 256, 512  # environments
TEST, CHOICE = 1_000_000, 2_000_000  # seeds of episodes; those of training are below 1000 times the number of seeds
SHARE = 0.2  # full action as a share of the torque limits
KP, KD = 100.0, 20.0  # gains of the controller [1/s^2, 1/s]
GAINS = [(kp, 2 * d * math.sqrt(kp)) for kp in (100.0, 200.0, 300.0, 400.0, 500.0, 600.0) for d in (0.7, 1.0, 1.3)]
FRICTION = (
    effects.Viscous([4.0] * 4 + [2.0] * 3),  # [N m s/rad]
    effects.Stribeck([3.0] * 4 + [1.0] * 3, [5.0] * 4 + [1.6] * 3),  # [N m]
)
PLANT = (
    *[effect for effect in default_effects(ROBOT) if not isinstance(effect, effects.Viscous)],
    *FRICTION,
    effects.Payload(2.0),  # [kg]
    effects.CommandDelay(1),  # steps
    effects.FirstOrderLag(0.04),  # [s]
)
CHECKS = 10  # how often a policy is evaluated while it learns
JOINT = 5  # joint in the picture, from 0
Policy = Callable[[Tensor], Tensor]


@dataclass
class Args(OnDevice):
    steps: int = 1_000_000
    """Environment steps of training."""
    seeds: int = 5
    """Trainings of each policy."""
    quick: bool = False
    """One seed, at most 100 000 steps."""
    json: Path | None = None
    """File of the results of every seed and episode."""
    out: Path = Path("out")
    """Folder of the picture."""


class Result(NamedTuple):
    """Result of a policy on a number of episodes."""

    returns: Tensor  # [episodes]
    errors: Tensor  # [episodes] root mean square over time and joints [mrad]
    trace: Tensor  # [steps] error of `JOINT` in the first episode [mrad]

    @property
    def means(self) -> tuple[float, float]:
        """Return and error, means over episodes."""
        return float(self.returns.mean()), float(self.errors.mean())


@dataclass(frozen=True)
class Base:
    """The computed-torque controller under a policy."""

    kp: float = KP  # [1/s^2]
    kd: float = KD  # [1/s]
    true: bool = False  # True: it knows payload and masses of every episode
    device: str = "cpu"  # device of the environments

    def environments(self, number: int, mode: AutoresetMode = AutoresetMode.SAME_STEP) -> RobotVectorEnv:
        """Environments under it; gains are tensors, so that all of them share one program."""
        gains = (torch.full((N,), self.kp), torch.full((N,), self.kd))
        controller = ComputedTorque(*gains, model=None if self.true else nominal_robot(Scene(ROBOT, PLANT)))
        return RobotVectorEnv(
            number,
            "track",
            ROBOT,
            effects=PLANT,
            action=Actions("residual", controller=controller, scale=(SHARE * ROBOT.limits.effort).tolist()),
            simulation=Simulation(dt=DT),
            max_episode_steps=EPISODE,
            randomise={"mass": 0.1, "friction": 0.2},
            autoreset_mode=mode,
            device=self.device,
        )


class Features(BaseFeaturesExtractor):
    """Observations as numbers of about one: errors, velocity errors, velocities, reference.

    Errors of a tenth of a radian are what the policy lives on; as they come they would drown among positions.
    """

    def __init__(self, space) -> None:
        super().__init__(space, space.shape[0])

    def forward(self, observation: Tensor) -> Tensor:
        """Features of observations, both [..., 5 n]."""
        error, qd, wanted, moving, pushed = observation.split(N, -1)
        return torch.cat([10 * error, 5 * (moving - qd), 3 * qd, 0.5 * wanted, pushed], -1)


class Watch(BaseCallback):
    """Evaluates the policy while it learns: `curve` has steps, return and error [mrad]."""

    def __init__(self, base: Base, steps: int) -> None:
        super().__init__()
        self.base, self.stride = base, steps / CHECKS
        self.curve: list[tuple[int, float, float]] = []

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= len(self.curve) * self.stride:
            self.note()

    def _on_step(self) -> bool:
        return True

    def note(self) -> Result:
        """Evaluate now."""
        result = evaluate(self.base, greedy(self.model))
        self.curve.append((self.num_timesteps, *result.means))
        return result


def evaluate(base: Base, policy: Policy, episodes: int = TESTED, seed: int = TEST) -> Result:
    """Result of a policy on top of a controller, by default on the episodes that are kept for it."""
    envs = base.environments(episodes, AutoresetMode.DISABLED)  # the last observation is that of the last step
    observation, _ = envs.reset(seed=seed)
    returns, squared = torch.zeros(2, episodes, device=base.device)
    trace = []
    for _ in range(EPISODE):
        observation, reward, _, _, info = envs.step(policy(observation))
        returns += reward
        squared += info["error"] ** 2
        trace.append(observation[0, JOINT])
    return Result(*(x.cpu() for x in (returns, 1e3 * (squared / EPISODE).sqrt(), 1e3 * torch.stack(trace))))


def nothing(observation: Tensor) -> Tensor:
    """No residual: the controller alone."""
    return observation.new_zeros(len(observation), N)


def friction(observation: Tensor) -> Tensor:
    """The mean friction at the wanted velocity, as an action; the environments clip it as they do any other."""
    qd = observation[:, 3 * N : 4 * N] * ROBOT.limits.velocity.to(observation)
    columns = qd.unbind(1)
    found = [effect.resolved(ROBOT).impedances(columns, columns, {}) for effect in FRICTION]
    damping = [torch.stack([torch.as_tensor(x.damping).to(qd).expand(len(qd)) for x in row], 1) for row in found]
    return sum(damping) * qd / (SHARE * ROBOT.limits.effort.to(observation))


def best(true: bool, policy: Policy, device: str = "cpu") -> Base:
    """Controller with the best gains, by return on episodes that are used for nothing else."""
    bases = [Base(*gains, true, device) for gains in GAINS]
    return max(bases, key=lambda base: evaluate(base, policy, 256, CHOICE).means[0])


def greedy(model: BaseAlgorithm) -> Policy:
    """The policy without exploration."""
    return lambda observation: torch.as_tensor(model.predict(observation.cpu().numpy(), deterministic=True)[0])


def learner(base: Base, seed: int) -> PPO:
    """PPO before training; its policy adds nothing to the controller.

    Short rollouts and a short horizon: what a torque does to the error shows within half a second. Exploration starts
    at 0.37 of a full action; with 0.14 (log_std_init=-2) as many steps bring less than half of the gain.
    """
    envs = StableBaselinesVecEnv(base.environments(TRAINED))
    envs.seed(seed * 1000)
    network = {"net_arch": [64, 64], "log_std_init": -1.0, "features_extractor_class": Features}
    rates = {"n_steps": 20, "batch_size": 1280, "n_epochs": 5, "gamma": 0.9, "gae_lambda": 0.9}
    model = PPO(
        "MlpPolicy",
        envs,
        learning_rate=lambda left: 1e-3 * left,
        seed=seed,
        policy_kwargs=network,
        device=base.device,
        **rates,
    )
    nn.init.zeros_(model.policy.action_net.weight)
    nn.init.zeros_(model.policy.action_net.bias)
    return model


def train(base: Base, seed: int, steps: int) -> tuple[Result, list[tuple[int, float, float]]]:
    """Result of the policy after training, and steps, return and error [mrad] on the way there."""
    model, watch = learner(base, seed), Watch(base, steps)
    model.learn(steps, callback=watch)
    return watch.note(), watch.curve


def interval(values: list[float]) -> tuple[float, float, float]:
    """Mean, and both ends of its 95 % bootstrap interval."""
    if np.ptp(values) == 0:
        return values[0], values[0], values[0]
    found = bootstrap((np.array(values),), np.mean, confidence_level=0.95, rng=0, n_resamples=2000)
    return float(np.mean(values)), *map(float, found.confidence_interval)


def summary(results: list[Result]) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return and error [mrad] with intervals: over seeds, or over episodes if there is one."""
    if len(results) == 1:
        return interval(results[0].returns.tolist()), interval(results[0].errors.tolist())
    returns, errors = zip(*[result.means for result in results], strict=True)
    return interval(list(returns)), interval(list(errors))


def draw(path: Path, curves: dict[str, list], results: dict[str, list[Result]], lines: dict[str, str]) -> None:
    """Picture of the learning curves, and of the error of one joint with and without the policies.

    `lines` are methods for comparison and their styles, first the controllers alone in the order of the curves.
    """
    prepare()
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
    colours = dict(zip(curves, ("tab:blue", "tab:green"), strict=True))
    for name, seeds in curves.items():
        x = [point[0] / 1e6 for point in seeds[0]]
        rows = [[curve[k][1] for curve in seeds] for k in range(len(x))]
        left.plot(x, np.mean(rows, 1), color=colours[name], label=name)
        if len(seeds) > 1:
            _, low, high = zip(*[interval(row) for row in rows], strict=True)
            left.fill_between(x, low, high, color=colours[name], alpha=0.25, linewidth=0)
    for name, style in lines.items():
        left.axhline(results[name][0].means[0], color="0.4", linestyle=style, linewidth=1, label=name)
    left.set(xlabel="million environment steps", ylabel="return of unseen episodes")
    left.legend(fontsize=8, loc="center right")
    now = np.arange(1, EPISODE + 1) * DT
    for (name, colour), before in zip(colours.items(), lines, strict=False):
        right.plot(now, results[before][0].trace, color=colour, linestyle="--", label=before)
        right.plot(now, results[name][0].trace, color=colour, label=name)
    right.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
    right.set(xlabel="time [s]", ylabel=f"error of joint {JOINT + 1} [mrad], one unseen episode")
    right.legend(fontsize=8)
    save(figure, path)


def main(args: Args) -> dict[str, list[Result]]:
    """Results of every method: of one evaluation, or of one for each seed."""
    torch.set_num_threads(1)
    seeds, steps = (1, min(args.steps, 100_000)) if args.quick else (args.seeds, args.steps)
    start = time.process_time()
    usual_gains, high = Base(device=args.device), best(False, nothing, args.device)
    compensated, informed = best(False, friction, args.device), best(True, friction, args.device)

    def named(base: Base) -> str:
        return f"{base.kp:.0f} / {base.kd:.0f}"

    alone, tuned = f"controller, gains {named(usual_gains)}", f"controller, best gains {named(high)}"
    known = f"true friction known, best gains {named(compensated)}"
    everything = f"true friction and bodies known, best gains {named(informed)}"
    results = {
        alone: [evaluate(usual_gains, nothing)],
        f"true bodies known, gains {named(usual_gains)}": [evaluate(Base(true=True, device=args.device), nothing)],
        tuned: [evaluate(high, nothing)],
        known: [evaluate(compensated, friction)],
        everything: [evaluate(informed, friction)],
    }
    curves: dict[str, list] = {}
    for base in (usual_gains, high):
        name = f"controller and PPO, gains {named(base)}"
        results[name], curves[name] = [], []
        for seed in range(seeds):
            result, curve = train(base, seed, steps)
            results[name].append(result)
            curves[name].append(curve)
            print(f"{name}, seed {seed}: return {curve[0][1]:.1f} -> {curve[-1][1]:.1f}", flush=True)
    spent, where = time.process_time() - start, "one thread" if args.device == "cpu" else args.device

    print("\n| method | return of an episode | tracking error [mrad] |\n|---|---|---|")
    summaries = {name: summary(found) for name, found in results.items()}
    for name, both in summaries.items():
        print(f"| {name} | " + " | ".join("{:.2f} [{:.2f}, {:.2f}]".format(*x) for x in both) + " |")
    print()
    for name, before in zip(curves, (alone, tuned), strict=True):
        added = "{:.2f} [{:.2f}, {:.2f}]".format(*gain(results[name], results[before][0]))
        share = np.mean([float((r.errors < results[before][0].errors).float().mean()) for r in results[name]])
        print(f"{name}: PPO adds {added} to the return, and lowers the error in {share:.1%} of the episodes")
    print(f"{seeds} seeds of {steps / 1e6:g} million steps, {spent:.0f} s of processor time in all, on {where}")
    draw(args.out / "residual_rl.png", curves, results, {alone: ":", tuned: "--", everything: "-."})
    if args.json:
        content = {
            "steps": steps,
            "seconds": spent,
            "summary": {name: dict(zip(("return", "mrad"), x, strict=True)) for name, x in summaries.items()},
            "methods": {
                name: [{"returns": r.returns.tolist(), "mrad": r.errors.tolist()} for r in found]
                for name, found in results.items()
            },
            "curves": curves,
        }
        args.json.write_text(json.dumps(content, indent=1))
    return results


def gain(results: list[Result], alone: Result) -> tuple[float, float, float]:
    """Gain of policies in the return of the same episodes, with an interval as in `summary`."""
    differences = [result._replace(returns=result.returns - alone.returns) for result in results]
    return summary(differences)[0]


def better(results: dict[str, list[Result]]) -> bool:
    """Verdict on whether PPO helps the controller it was trained on: the interval of its gain is above zero."""
    learned = next(found for name, found in results.items() if "PPO" in name)
    return gain(learned, next(iter(results.values()))[0])[1] > 0


if __name__ == "__main__":
    sys.exit(0 if better(main(tyro.cli(Args))) else 1)
