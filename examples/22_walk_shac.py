"""Walking, learned from gradients through contact: short-horizon actor-critic on the compiled steps of a scene.

    python examples/22_walk_shac.py [--seconds 120] [--seed 0] [--stiffness 5000] [--robot FILE] [--out FOLDER]

SHAC (J. Xu et al., "Accelerated Policy Learning with Parallel Differentiable Simulation", 2022): rewards of 16 control
steps, and the value of the state after them, are one function of the policy, differentiated through 64 physical steps.
Three things make the gradient useful: soft ground (k from 5 to 20 kN/m), where the slope of a return over large actions
is that of its gradient; a reward that has a slope far from the command, unlike PPO's; and a wide policy. It needs fewer
samples than `21_walk_ppo.py`, and each costs more. The test is the one there; `out/walk.pt` has the policy.
"""

import copy
import os
import sys
import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
import tyro
from torch import Tensor, nn

from torchdq import Scene, dq, effects
from torchdq.envs.walk import Walk

ppo = import_module("21_walk_ppo")
UNIT = ppo.UNIT  # output of the policy as an action
LAMBDA, FALL = 0.95, -0.2  # decay of later returns, and reward of a fall
STD, STEP, SUBSTEPS = 0.74, 0.005, 4  # first standard deviation, and step of the scene [s] and their number


@dataclass(frozen=True)
class Settings:
    """Numbers of SHAC that are of a task."""

    horizon: int = 16  # steps that a return is differentiated through
    gamma: float = 0.99
    unit: float = UNIT
    episode: int = 500  # steps


@dataclass
class Args(ppo.Walker):
    seconds: float = 120.0
    """Processor time to learn in."""
    seed: int = 0
    """Seed of policy and robots."""
    robots: int = 512
    """Robots."""
    stiffness: float = 5000.0
    """Stiffness of the ground [N/m]."""
    rate: float = 1e-3
    """Learning rate of the policy."""
    out: Path = Path("out")
    """Folder of the policy."""


class Walkers:
    """Robots of the task, differentiable: their state, and what is remembered of it."""

    def __init__(self, robots: int, stiffness: float, walker: Any) -> None:
        self.task, self.robot = walker.task(turning=(0.0, 0.0)), walker.load()
        chosen = self.task.defaults(self.robot)
        parts = {type(effect): effect for effect in chosen["effects"]}
        ground = effects.Contact(self.task.described(self.robot).feet, stiffness=stiffness)
        acting = (*(parts[kind] for kind in (effects.Gravity, effects.RotorInertia, effects.Servo)), ground)
        self.scene, self.full = Scene(self.robot, acting, dt=STEP), chosen["scale"]
        self.kp, self.kd = parts[effects.Servo].kp, parts[effects.Servo].kd
        self.stand = torch.tensor(self.task.joints(self.robot))
        self.height = float(self.task.height(self.robot, self.task.joints(self.robot)))
        X = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([0.0, 0.0, self.height]))
        self.state = self.scene.start(self.stand.expand(robots, -1).contiguous(), X_WB=X.expand(robots, 8).contiguous())
        self.fresh, self.goal, self.last = self.state, torch.zeros(robots, 3), torch.zeros(robots, self.robot.n)
        self.steps = torch.randint(500, (robots,))
        self.reset(torch.ones(robots, dtype=torch.bool))

    def reset(self, where: Tensor) -> None:
        """Begin new episodes in some rows."""
        row, n = where[:, None], len(where)
        start = self.fresh._replace(
            q=self.stand + 0.1 * (2 * torch.rand(n, self.robot.n) - 1), V_WB_B=0.2 * (2 * torch.rand(n, 6) - 1)
        )
        begun = {name: torch.where(row, x, getattr(self.state, name)) for name, x in start.rows().items()}
        self.state = self.state._replace(**begun)
        low, high = self.task.forward
        speed = low + (high - low) * torch.rand(n, 1)
        self.goal = torch.where(row, torch.cat([speed, torch.zeros(n, 2)], 1), self.goal)
        self.last, self.steps = torch.where(row, 0.0, self.last), torch.where(where, 0, self.steps)

    def cut(self) -> None:
        """Keep the state, without its gradient."""
        self.state = self.state._replace(**{name: x.detach() for name, x in self.state.rows().items()})
        self.last = self.last.detach()

    def down(self) -> Tensor:
        """Direction of gravity in axes of the base [N, 3]."""
        return -dq.to_matrix(self.state.X_WB)[:, 2, :3]

    def observation(self) -> Tensor:
        """Observation of the task."""
        w, v = self.state.V_WB_B.split(3, 1)
        rows = {"velocity": [v, self.goal[:, :2]], "rate": [w, self.goal[:, 2:]], "down": [self.down()]}
        rows |= {"offset": [self.state.q - self.stand], "speed": [self.state.qd], "action": [self.last]}
        return torch.cat([Walk.SEEN[name] * x for name, row in rows.items() for x in row], 1)

    def step(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Rewards, and whether robots fell."""
        action, before = action.clamp(-1, 1), self.state.qd
        target = self.stand + self.full * action
        for _ in range(SUBSTEPS):
            self.state = self.scene.step(self.state, target=target)
        w, v = self.state.V_WB_B.split(3, 1)
        down, z = self.down(), dq.translation(self.state.X_WB)[:, 2]
        torque = self.kp * (target - self.state.q) - self.kd * self.state.qd
        hips = (self.state.q - self.stand)[:, [i for i, parent in enumerate(self.robot.parents) if parent < 0]]
        costs = [(2.0, v[:, 2:]), (0.05, w[:, :2]), (2e-4, torque), (0.36, action - self.last), (2.0, down[:, :2])]
        costs += [(20.0, (z - 0.88 * self.height)[:, None]), (0.1, hips)]
        costs += [(2.5e-7, (self.state.qd - before) / (SUBSTEPS * STEP))]
        error = (v[:, :2] - self.goal[:, :2]).square().sum(1)
        reward = 1.5 * (1 - (error + 0.0025).sqrt()) + 0.5 * torch.exp(-(w[:, 2] - self.goal[:, 2]).square() / 0.1)
        reward = reward - sum(weight * x.square().sum(1) for weight, x in costs)
        self.last, self.steps = action, self.steps + 1
        return SUBSTEPS * STEP * reward, (down[:, 2] > -0.6) | (z < self.task.lowest * self.height) | ~torch.isfinite(z)


def improve(
    walkers: Any, policy: nn.Module, slow: nn.Module, optimizer: torch.optim.Optimizer, settings: Settings = Settings()
) -> list[Tensor]:
    """Step up the gradient of the return; what was observed, earned and expected after it, and where episodes ended."""
    walkers.cut()
    horizon, gamma = settings.horizon, settings.gamma
    total, discount, seen = 0.0, torch.ones(len(walkers.goal)), []
    for k in range(horizon):
        observation = walkers.observation()
        mean = policy(observation)
        reward, fell = walkers.step(settings.unit * (mean + policy.log_std.exp() * torch.randn_like(mean)))
        reward = torch.where(fell, FALL, reward)
        value, late = slow.value(walkers.observation()), walkers.steps >= settings.episode
        done = fell | late
        ahead = torch.where(fell | ~(late | (k == horizon - 1)), 0.0, gamma * value)
        total = total + discount * (reward + ahead)
        seen.append([observation.detach(), reward.detach(), torch.where(fell, 0.0, value.detach()), done.float()])
        discount = torch.where(done, 1.0, gamma * discount)
        walkers.reset(done)
    optimizer.zero_grad()
    (-total.mean() / horizon).backward()
    trained = [x for group in optimizer.param_groups for x in group["params"]]
    if torch.isfinite(nn.utils.clip_grad_norm_(trained, 1.0)):
        optimizer.step()
    return [torch.stack(x) for x in zip(*seen, strict=True)]


def fit(
    critic: nn.Module, optimizer: torch.optim.Optimizer, seen: list[Tensor], settings: Settings = Settings()
) -> None:
    """Bring values closer to the returns."""
    observation, reward, value, done = seen
    returns, after = [], value[-1]
    for k in reversed(range(settings.horizon)):
        after = reward[k] + settings.gamma * torch.where(
            done[k] > 0, value[k], (1 - LAMBDA) * value[k] + LAMBDA * after
        )
        returns.append(after)
    inputs, targets = observation.flatten(0, 1), torch.stack(returns[::-1]).flatten()
    for _ in range(2):
        for rows in torch.randperm(len(targets)).chunk(4):
            optimizer.zero_grad()
            (critic.value(inputs[rows]) - targets[rows]).square().mean().backward()
            nn.utils.clip_grad_norm_(critic.critic.parameters(), 1.0)
            optimizer.step()


def main(args: Args) -> float | None:
    """Processor time until the policy walks [s]; None: it does not."""
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    walkers = Walkers(args.robots, args.stiffness, args)
    policy = ppo.Policy(walkers.observation().shape[1], walkers.robot.n)
    torch.nn.init.constant_(policy.log_std, torch.tensor(STD).log())
    slow = copy.deepcopy(policy)
    actor = torch.optim.Adam([*policy.actor.parameters(), policy.log_std], lr=args.rate, betas=(0.7, 0.95))
    critic = torch.optim.Adam(policy.critic.parameters(), lr=1e-3)
    test = ppo.Test(walkers.task, walkers.robot, 0.0)
    improve(walkers, copy.deepcopy(policy), slow, torch.optim.SGD(policy.actor.parameters(), lr=0.0))  # compiles
    begin, walks, k, spent = time.process_time(), None, 0, 0.0
    while spent < args.seconds and walks is None:
        seen = improve(walkers, policy, slow, actor)
        fit(policy, critic, seen)
        with torch.no_grad():
            policy.log_std.clamp_(-2.5, 0.0)
            for old, new in zip(slow.parameters(), policy.parameters(), strict=True):
                old.lerp_(new, 0.6)
        k, spent = k + 1, time.process_time() - begin
        if k % 20 == 0:
            samples, fell = k * Settings.horizon * args.robots / 1e6, float((seen[1] == FALL).float().mean())
            print(
                f"{spent:5.1f} s  {samples:.2f} million samples  reward {seen[1].mean():.4f}  fell {fell:.4f}",
                flush=True,
            )
            if fell < 2e-3:
                up, speed, _ = test(policy)
                print(f"{spent:5.1f} s  test: {up:.0%} up, error {speed:.3f} m/s", flush=True)
                walks = spent if up == 1 and speed < 0.1 else None
    args.out.mkdir(parents=True, exist_ok=True)
    torch.save(policy.actor.state_dict(), args.out / "walk.pt")
    return walks


if __name__ == "__main__":
    torch.set_flush_denormal(True)
    walks = main(tyro.cli(Args))
    print("does not walk yet" if walks is None else f"walks after {walks:.0f} s")
    sys.exit(walks is None)
