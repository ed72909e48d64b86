"""Walking, learned on one thread: a quadruped follows commanded velocities after a minute of PPO.

    python examples/21_walk_ppo.py [--seconds 90] [--seed 0] [--turning 1] [--robot FILE] [--device cuda] [--out FOLDER]
    torchrun --nproc-per-node 4 examples/21_walk_ppo.py

PPO (J. Schulman et al., "Proximal Policy Optimization Algorithms", 2017) in this one file, in torch alone, for any vector
environment of torchdq: many robots in one program, short rollouts, generalised advantages, a learning rate that follows
the change of the policy (N. Rudin et al., "Learning to Walk in Minutes Using Massively Parallel Deep Reinforcement
Learning", 2021). An episode that reaches its time limit counts as one that goes on. Under `torchrun` every process has
robots of its own, and gradients are averaged.

The robots of `torchdq/Walk-v0` differ in ground, masses and pushes. The policy walks when 48 robots on the nominal ground
walk for 10 s, none falls, and the error of their mean speed is below 0.1 m/s at 0.5, 0.75 and 1.0 m/s, and, with
`--turning`, of their mean yaw rate below 0.15 rad/s. `out/walk.pt` has the policy then; times are of the processor, all
threads, tests included.
"""

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
import torch.distributed as dist
import tyro
from devices import OnDevice
from torch import Tensor, nn

from torchdq.envs import ArmVectorEnv, Pushes
from torchdq.envs.walk import SEEN, Walk

HORIZON, EPOCHS, BATCHES = 24, 2, 8  # steps of a rollout, passes through them, and parts of each pass
GAMMA, LAMBDA, CLIP, ENTROPY = 0.99, 0.95, 0.2, 0.003
KL, FASTEST, SLOWEST = 0.01, 1e-2, 1e-5  # desired change of the policy in an update; bounds of the learning rate
STD, UNIT = 0.8, 1 / 6  # first standard deviation of the policy's outputs, and such an output as an action
SPEEDS, EACH = (0.5, 0.75, 1.0), 16  # commands of the test [m/s], and robots with each


@dataclass
class Args(OnDevice):
    seconds: float = 90.0
    """Processor time to learn in."""
    seed: int = 0
    """Seed of policy and robots."""
    robots: int = 1024
    """Robots of each process."""
    robot: str = "go2"
    """Name of a shipped robot, or the file of a quadruped."""
    forward: tuple[float, float] = (0.4, 1.1)
    """Commanded velocities [m/s]."""
    turning: float = 0.0
    """Largest commanded yaw rate [rad/s]."""
    out: Path = Path("out")
    """Folder of the policy."""


class Policy(nn.Module):
    """Normal distribution of actions, and value of a state, of observations [N, k]."""

    def __init__(self, observations: int, actions: int) -> None:
        super().__init__()
        self.actor, self.critic = network(observations, actions, 0.1), network(observations, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((actions,), STD).log())

    def forward(self, observation: Tensor) -> Tensor:
        """Mean actions, in the policy's units."""
        return self.actor(observation)

    def value(self, observation: Tensor) -> Tensor:
        return self.critic(observation).squeeze(-1)

    def log_prob(self, mean: Tensor, sample: Tensor) -> Tensor:
        """Logarithm of the density, up to a constant."""
        return -0.5 * (sample - mean).square() @ (-2 * self.log_std).exp() - self.log_std.sum()


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    layers = nn.Sequential(nn.Linear(inputs, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, outputs))
    with torch.no_grad():
        layers[-1].weight.mul_(gain)
        layers[-1].bias.zero_()
    return layers


def mean_of_all(*tensors: Tensor) -> None:
    """Make tensors their means over all processes."""
    if dist.is_initialized():
        flat = torch.cat([x.reshape(-1) for x in tensors])
        dist.all_reduce(flat)
        for x, mean in zip(tensors, (flat / dist.get_world_size()).split([x.numel() for x in tensors]), strict=True):
            x.copy_(mean.reshape(x.shape))


class PPO:
    """Learner on a vector environment with tensors."""

    def __init__(self, envs: ArmVectorEnv, seed: int) -> None:
        rank = dist.get_rank() if dist.is_initialized() else 0
        torch.manual_seed(seed)  # the same policy in all processes, and different robots
        self.envs, device = envs, envs.device
        self.observation, _ = envs.reset(seed=(10_000 * seed + rank) * envs.num_envs)
        self.policy = Policy(self.observation.shape[1], envs.single_action_space.shape[0]).to(device)
        self.optimizer = torch.optim.Adam(self.policy.parameters(), lr=1e-3, fused=True)
        torch.manual_seed(10_000 * seed + rank)
        if envs.max_episode_steps:  # episodes that end at different times
            steps = torch.randint(envs.max_episode_steps, (envs.num_envs,), dtype=torch.int32)
            envs.set_state({**envs.get_state(), "steps": steps.to(device)})

    @torch.no_grad()
    def rollout(self) -> tuple[list[Tensor], dict[str, float]]:
        """Observations, actions, their log probabilities, returns, advantages [samples, ...], and means of `info`."""
        policy, rows, means = self.policy, [], {}
        std = policy.log_std.exp()
        for _ in range(HORIZON):
            mean = policy(self.observation)
            action = mean + std * torch.randn_like(mean)
            seen, reward, terminated, truncated, info = self.envs.step(UNIT * action)
            late, reward = truncated & ~terminated, reward.clamp(min=-1.0)  # of a simulation that failed
            if late.any():
                reward = reward + GAMMA * torch.where(late, policy.value(info["final_obs"]), 0.0)
            going = (~(terminated | truncated)).float()
            rows.append((self.observation, action, policy.log_prob(mean, action), reward, going))
            self.observation = seen
            for name, x in (("reward", reward), ("ended", terminated), *((name, info[name]) for name in ("speed_error", "air_time", "velocity", "torque", "clipped") if name in info)):
                means[name] = means.get(name, 0.0) + float(x.float().mean()) / HORIZON
        observation, action, log_prob, reward, going = map(torch.stack, zip(*rows, strict=True))
        value = torch.stack([policy.value(x) for x in (*observation, self.observation)])
        advantages, advantage = [], torch.zeros_like(reward[0])
        for t in reversed(range(HORIZON)):
            advantage = reward[t] + GAMMA * going[t] * (value[t + 1] + LAMBDA * advantage) - value[t]
            advantages.append(advantage)
        advantage = torch.stack(advantages[::-1])
        returns = advantage + value[:-1]
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        return [x.flatten(0, 1) for x in (observation, action, log_prob, returns, advantage)], means

    def update(self, samples: list[Tensor]) -> None:
        """Change the policy so that better actions become more likely, and the values come closer to the returns."""
        policy, parameters = self.policy, list(self.policy.parameters())
        group = self.optimizer.param_groups[0]
        for _ in range(EPOCHS):
            for indices in torch.randperm(len(samples[0]), device=samples[0].device).chunk(BATCHES):
                observation, action, before, returns, advantage = (x.index_select(0, indices) for x in samples)
                change = policy.log_prob(policy(observation), action) - before
                ratio = change.exp()
                gain = torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
                error = (policy.value(observation) - returns).square().mean()
                loss = error - gain - ENTROPY * policy.log_std.sum()
                self.optimizer.zero_grad()
                loss.backward()
                kl = (ratio - 1 - change).mean().detach()
                mean_of_all(kl, *[x.grad for x in parameters])
                nn.utils.clip_grad_norm_(parameters, 1.0)
                self.optimizer.step()
                factor = 1 / 1.5 if kl > 2 * KL else 1.5 if kl < KL / 2 else 1.0
                group["lr"] = min(max(group["lr"] * factor, SLOWEST), FASTEST)


@torch.no_grad()
def walk(policy: nn.Module, envs: ArmVectorEnv, commands: Tensor, seconds: float = 10.0) -> tuple[Tensor, Tensor]:
    """Whether each robot stayed up [N], and its mean velocity [N, 3] after 2 s (forward, sideways, yaw rate)."""
    observation, _ = envs.reset(seed=1_000_000_000)
    envs.set_state({**envs.get_state(), "goal": commands})
    up, total, steps = torch.ones(len(commands), dtype=torch.bool, device=envs.device), 0.0, round(seconds / envs.scene.dt)
    for k in range(steps):
        observation, _, terminated, _, _ = envs.step(UNIT * policy(observation))
        up &= ~terminated
        if k >= (after := round(2.0 / envs.scene.dt)):
            total = total + observation[:, [0, 1, 5]] / (steps - after)
    return up, total / total.new_tensor([SEEN["v"], SEEN["v"], SEEN["w"]])


def test_environment(task: Walk, robot: str, friction: float = 1.0, device: torch.device | str = "cpu", each: int = EACH) -> ArmVectorEnv:
    """Robots on the nominal ground, with nominal masses and without pushes; `friction` is a factor."""
    same = {"Contact.friction": (friction, friction), "Contact.stiffness": (1.0, 1.0), "mass": (1.0, 1.0)}
    still = {"push": Pushes((0.0,) * 6)}
    return ArmVectorEnv(
        each * len(SPEEDS), task, robot, randomise=same, pushes=still, max_episode_steps=None, device=device
    )


def main(args: Args) -> float | None:
    """Processor time until the policy walks [s]; None: it does not."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    if "RANK" in os.environ:
        dist.init_process_group("nccl" if args.place.type == "cuda" else "gloo")
    first = not dist.is_initialized() or dist.get_rank() == 0
    task = Walk(args.forward, turning=(-args.turning, args.turning))
    envs = ArmVectorEnv(args.robots, task, args.robot, max_episode_steps=1000, device=args.place)
    tests = test_environment(task, args.robot, device=args.place)
    commands = torch.zeros(tests.num_envs, 3, device=tests.device)
    commands[:, 0] = torch.tensor(SPEEDS).repeat_interleave(EACH)
    commands[:, 2] = args.turning * torch.linspace(-1, 1, EACH).repeat(len(SPEEDS))
    learner = PPO(envs, args.seed)
    walk(learner.policy, tests, commands, 3.0)  # compiles
    envs.step(torch.zeros(envs.num_envs, envs.single_action_space.shape[0], device=envs.device))
    begin, found, k = time.process_time(), None, 0
    while time.process_time() - begin < args.seconds and found is None:
        samples, means = learner.rollout()
        learner.update(samples)
        k += 1
        if k % 10 == 0 and first:
            spent, seen = time.process_time() - begin, k * len(samples[0]) * (dist.get_world_size() if dist.is_initialized() else 1)
            numbers = "  ".join(f"{name} {x:.4f}" for name, x in means.items())
            print(f"{spent:5.1f} s  {seen / 1e6:.2f} million samples  {numbers}", flush=True)
        if k % 5 == 0 and means["ended"] < 2e-3 and means["speed_error"] < 0.25:
            up, v = walk(learner.policy, tests, commands)
            error = (v - commands).abs().reshape(len(SPEEDS), EACH, 3).mean(1).amax(0)
            good = bool(up.all()) and float(error[0]) < 0.1 and float(error[2]) < 0.15
            spent = time.process_time() - begin
            print(f"{spent:5.1f} s  test: {int(up.sum())} of {len(up)} up, speed error {error[0]:.3f} m/s, yaw rate {error[2]:.3f} rad/s", flush=True)
            found = spent if good else None
    args.out.mkdir(parents=True, exist_ok=True)
    torch.save(learner.policy.actor.state_dict(), args.out / "walk.pt")
    return found


if __name__ == "__main__":
    found = main(tyro.cli(Args))
    print("does not walk yet" if found is None else f"walks after {found:.0f} s")
    sys.exit(found is None)
