"""Walking, learned on one thread: a robot with feet follows commanded velocities after a minute of PPO.

    python examples/21_walk_ppo.py [--seconds 90] [--seed 0] [--turning 1] [--robot FILE] [--device cuda] [--out FOLDER]
    torchrun --nproc-per-node 4 examples/21_walk_ppo.py

PPO (J. Schulman et al., "Proximal Policy Optimization Algorithms", 2017) in this one file and in torch alone, for any
vector environment of torchdq: many robots in one program, short rollouts, each one call, generalised advantages, a
learning rate that follows the change of the policy (N. Rudin et al., "Learning to Walk in Minutes Using Massively
Parallel Deep Reinforcement Learning", 2021). An episode that reaches its time limit counts as one that goes on. Under
`torchrun` processes share the robots and average gradients, and the policy is that of one process, to rounding.

The robots of `torchdq/Walk-v0` differ in ground and masses, and are pushed. A policy walks when 48 robots on the
nominal ground walk for 10 s, none falls, and the error of their mean speed is below 0.1 m/s at 0.5, 0.75 and 1.0 m/s
and, with `--turning`, of their mean yaw rate below 0.15 rad/s. It is tested now and then until it does, and learns on
to the end of `--seconds`. Times are those of the processor, tests included. `out/walk.pt` has the policy.
"""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
import torch.distributed as dist
import tyro
from devices import OnDevice
from torch import Tensor, nn

import torchdq
from torchdq import Robot
from torchdq.envs import Pushes, RobotVectorEnv
from torchdq.envs.walk import Walk

HORIZON, CLIP = 24, 0.2  # steps of a rollout
FASTEST, SLOWEST = 1e-2, 1e-5  # bounds of the learning rate
UNIT = 1 / 6  # output of the policy as an action
GROUP = 32  # robots with random numbers of their own, so that those do not depend on the number of processes
SHOWN = ("reward", "ended", "speed_error")  # means that are printed
SPEEDS, EACH = (0.5, 0.75, 1.0), 16  # commands of the test [m/s], and robots with each


@dataclass
class Walker:
    """Robot that walks, of this and other examples."""

    robot: str = "go2"
    """Name of a shipped robot, or a URDF or MJCF file of a robot with feet."""
    stand: tuple[str, ...] = ()
    """Positions of joints at the stand [rad], by names or patterns: `--stand "*_HAA=0" "?F_HFE=0.7"`."""
    feet: tuple[str, ...] = ("*_foot",)
    """Names of the feet."""
    stiffness: float = 0.6
    """Stiffness of the servos, in weights times the height of the base per rad."""
    joints: tuple[str, ...] = ("*",)
    """Names or patterns of the joints that move; others are locked at zero."""

    def load(self) -> Robot:
        """The robot, with a floating base; what its file has that no rigid body can have is warned of."""
        if self.robot in torchdq.robots.names():
            return torchdq.robots.load(self.robot)
        read = Robot.from_mjcf if Path(self.robot).suffix == ".xml" else Robot.from_urdf
        return read(self.robot, base="floating", joints=self.joints, on_unphysical="warn")

    def task(self, **commands: tuple[float, float]) -> Walk:
        """The task, with its commands."""
        stand = {name: float(x) for name, x in (pair.split("=") for pair in self.stand)}
        return Walk(feet=self.feet, stiffness=self.stiffness, **({"stand": stand} if stand else {}), **commands)


@dataclass
class Args(Walker, OnDevice):
    seconds: float = 90.0
    """Processor time to learn in."""
    seed: int = 0
    """Seed of policy and robots."""
    robots: int = 1024
    """Robots of all processes, a multiple of 32 in each."""
    forward: tuple[float, float] = (0.4, 1.1)
    """Commanded velocities [m/s]."""
    turning: float = 0.0
    """Largest commanded yaw rate [rad/s]."""
    out: Path = Path("out")
    """Folder of the policy."""


@dataclass(frozen=True)
class Settings:
    """Numbers of PPO that are of a task."""

    epochs: int = 2  # passes through a rollout
    value_epochs: int = 1  # passes that learn the values as well
    parts: int = 8  # of a pass
    gamma: float = 0.99
    decay: float = 0.95  # of later advantages
    entropy: float = 0.003  # weight of the entropy
    change: float = 0.01  # desired change of the policy in an update
    std: float = 0.8  # first standard deviation of the policy's outputs
    unit: float = UNIT


class Policy(nn.Module):
    """Normal distribution of actions, and value of a state, of observations [N, k]."""

    def __init__(self, observations: int, actions: int, std: float = Settings.std) -> None:
        super().__init__()
        self.actor = network(observations, actions, 0.1, nn.ELU(inplace=True))
        self.critic = network(observations, 1, 1.0, nn.ReLU(inplace=True))  # faster, and no actions to be smooth
        self.log_std = nn.Parameter(torch.full((actions,), std).log())

    def forward(self, observation: Tensor) -> Tensor:
        """Mean actions, in the policy's units."""
        return self.actor(observation)

    def value(self, observation: Tensor) -> Tensor:
        return self.critic(observation).squeeze(-1)

    def log_prob(self, mean: Tensor, sample: Tensor) -> Tensor:
        """Logarithm of the density, up to a constant."""
        return -0.5 * (sample - mean).square() @ (-2 * self.log_std).exp() - self.log_std.sum()


def network(inputs: int, outputs: int, gain: float, activation: nn.Module) -> nn.Sequential:
    layers = nn.Sequential(nn.Linear(inputs, 64), activation, nn.Linear(64, 64), activation, nn.Linear(64, outputs))
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

    def __init__(self, envs: RobotVectorEnv, seed: int, settings: Settings = Settings()) -> None:
        rank, processes = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        torch.manual_seed(seed)  # the same policy in all processes, and different robots
        self.envs, self.settings, device = envs, settings, envs.device
        observation, _ = envs.reset(seed=(10_000 * seed * processes + rank) * envs.num_envs)
        actions = envs.single_action_space.shape[0]
        self.policy = Policy(observation.shape[1], actions, settings.std).to(device)
        self.optimizer = torch.optim.Adam(self.policy.parameters(), lr=1e-3, fused=True)
        groups = envs.num_envs // GROUP
        if groups * GROUP != envs.num_envs:
            raise ValueError(f"the robots of a process must be a multiple of {GROUP}, found {envs.num_envs}")
        first = 2**20 * seed + rank * groups
        self.generators = [torch.Generator(device).manual_seed(first + k) for k in range(groups)]
        if envs.max_episode_steps:  # episodes that end at different times
            steps = self.drawn(lambda g: torch.randint(envs.max_episode_steps, (GROUP,), generator=g, device=device))
            envs.set_state({**envs.get_state(), "steps": steps.flatten().to(envs.dtype)})

    def drawn(self, draw: Callable[[torch.Generator], Tensor]) -> Tensor:
        """Random numbers of every group of robots, shape [groups, ...]."""
        return torch.stack([draw(generator) for generator in self.generators])

    @torch.no_grad()
    def rollout(self) -> tuple[list[Tensor], dict[str, float]]:
        """Observations, actions, their log probabilities, returns, advantages [samples, ...], and means of `info`."""
        policy, settings, shape = self.policy, self.settings, (HORIZON, GROUP, len(self.policy.log_std))
        noise = self.drawn(lambda g: torch.randn(shape, generator=g, device=g.device)).transpose(0, 1).flatten(1, 2)
        noise *= policy.log_std.exp()
        found = self.envs.rollout(policy.actor, HORIZON, noise, settings.unit)
        late, reward = found.truncated & ~found.terminated, torch.where(found.info["nonfinite"], -1.0, found.rewards)
        going = (~(found.terminated | found.truncated)).to(reward.dtype)
        reward[late] += settings.gamma * policy.value(found.final_observations[late])
        value = torch.stack([policy.value(x) for x in found.observations])
        advantages, advantage = [], torch.zeros_like(reward[0])
        for t in reversed(range(HORIZON)):
            advantage = reward[t] + settings.gamma * going[t] * (value[t + 1] + settings.decay * advantage) - value[t]
            advantages.append(advantage)
        advantage = torch.stack(advantages[::-1])
        returns = advantage + value[:-1]
        mean_of_all(mean := advantage.mean())
        mean_of_all(variance := (advantage - mean).square().mean())
        advantage = (advantage - mean) / (variance.sqrt() + 1e-8)
        rows = {"reward": reward, "ended": found.terminated, **found.info}
        rows = {name: x.to(advantage.dtype).mean() for name, x in rows.items() if x.ndim == 2}
        mean_of_all(*rows.values())
        log_prob = policy.log_prob(torch.zeros_like(noise), noise)
        samples = (found.observations[:-1], found.actions / settings.unit, log_prob, returns, advantage)
        return [x.flatten(0, 1) for x in samples], {name: float(x) for name, x in rows.items()}

    def update(self, samples: list[Tensor]) -> None:
        """Change the policy so that better actions become more likely, and the values come closer to the returns."""
        policy, settings, parameters = self.policy, self.settings, list(self.policy.parameters())
        group, (number, device) = self.optimizer.param_groups[0], (HORIZON * GROUP, samples[0].device)
        first = GROUP * torch.arange(len(self.generators), device=device)[:, None]
        for k in range(settings.epochs):
            # every part has as many samples of each group
            order = self.drawn(lambda g: torch.randperm(number, generator=g, device=device))
            order = order // GROUP * self.envs.num_envs + first + order % GROUP
            for part in order.chunk(settings.parts, 1):
                observation, action, before, returns, advantage = (x.index_select(0, part.flatten()) for x in samples)
                change = policy.log_prob(policy(observation), action) - before
                ratio = change.exp()
                gain = torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
                loss = -gain - settings.entropy * policy.log_std.sum()
                if k < settings.value_epochs:
                    loss = loss + (policy.value(observation) - returns).square().mean()
                self.optimizer.zero_grad()
                loss.backward()
                kl = (ratio - 1 - change).mean().detach()
                mean_of_all(kl, *[x.grad for x in parameters if x.grad is not None])
                nn.utils.clip_grad_norm_(parameters, 1.0)
                self.optimizer.step()
                factor = 1 / 1.5 if kl > 2 * settings.change else 1.5 if kl < settings.change / 2 else 1.0
                group["lr"] = min(max(group["lr"] * factor, SLOWEST), FASTEST)


class Test:
    """Robots on the nominal ground, with nominal masses and without pushes, and their commands.

    Args:
        task: the task.
        robot: the robot.
        turning: largest commanded yaw rate [rad/s].
        device: device of the environments.
        friction: factor of the friction of the ground.
    """

    def __init__(
        self, task: Walk, robot: Robot, turning: float, device: torch.device | str = "cpu", friction: float = 1.0
    ) -> None:
        # the same parameters as in training, so that the program is the same
        self.envs = RobotVectorEnv(EACH * len(SPEEDS), task, robot, device=device, max_episode_steps=None)
        same = {"Contact.friction": (friction, friction), "Contact.stiffness": (1.0, 1.0), "mass": (1.0, 1.0)}
        self.envs.set(randomise=same, pushes=dict.fromkeys(task.defaults(robot)["pushes"], Pushes((0.0,) * 6)))
        self.commands = torch.zeros(self.envs.num_envs, 3, device=device)
        self.commands[:, 0] = torch.tensor(SPEEDS).repeat_interleave(EACH)
        self.commands[:, 2] = turning * torch.linspace(-1, 1, EACH).repeat(len(SPEEDS))

    @torch.no_grad()
    def __call__(self, policy: nn.Module, seconds: float = 10.0) -> tuple[float, float, float]:
        """Share of robots that stay up, and errors of mean speed [m/s] and yaw rate [rad/s] after 2 s.

        They are the largest over the commanded speeds of the mean over robots.
        """
        envs, (start, end) = self.envs, (round(x / self.envs.scene.dt) for x in (2.0, seconds))
        envs.reset(seed=1_000_000_000)
        envs.set_state({**envs.get_state(), "goal": self.commands})
        quiet = torch.zeros(end, *envs.action_space.shape, device=envs.device)  # the program of training has noise
        found = envs.rollout(policy, end, quiet, UNIT)
        seen = found.observations[start + 1 :]
        velocity = torch.cat([seen[..., :2] / Walk.SEEN["velocity"], seen[..., 7:8] / Walk.SEEN["rate"]], 2)
        error = (velocity.mean(0) - self.commands).abs().reshape(len(SPEEDS), EACH, 3).mean(1).amax(0)
        return float(1.0 - found.terminated.any(0).float().mean()), float(error[0]), float(error[2])


def main(args: Args) -> float | None:
    """Processor time until the policy walks [s]; None: it does not."""
    torch.set_num_threads(1)
    if "RANK" in os.environ:
        dist.init_process_group("nccl" if args.place.type == "cuda" else "gloo")
    processes, first = (dist.get_world_size(), dist.get_rank() == 0) if dist.is_initialized() else (1, True)
    robot, task = args.load(), args.task(forward=args.forward, turning=(-args.turning, args.turning))
    robots = args.robots // processes
    learner = PPO(RobotVectorEnv(robots, task, robot, max_episode_steps=1000, device=args.place), args.seed)
    test = Test(task, robot, args.turning, args.place)
    test(learner.policy.actor, 0.04)  # compiles
    begin, walks, k, spent = time.process_time(), None, 0, 0.0
    while spent < args.seconds:
        samples, means = learner.rollout()
        learner.update(samples)
        k, spent = k + 1, time.process_time() - begin
        stop = torch.tensor(float(spent >= args.seconds), device=args.place)
        mean_of_all(stop)  # so that all processes do as many updates
        spent = max(spent, args.seconds) if stop > 0 else min(spent, 0.999 * args.seconds)
        if k % 10 == 0 and first:
            shown = "  ".join(f"{name} {means[name]:.3f}" for name in SHOWN)
            print(f"{spent:5.1f} s  {k * len(samples[0]) * processes / 1e6:.2f} million samples  {shown}", flush=True)
        if first and k % 5 == 0 and walks is None and means["ended"] < 2e-3 and means["speed_error"] < 0.25:
            up, speed, rate = test(learner.policy.actor)
            print(f"{spent:5.1f} s  test: {up:.0%} up, errors {speed:.3f} m/s and {rate:.3f} rad/s", flush=True)
            walks = spent if up == 1 and speed < 0.1 and rate < 0.15 else None
    if not first:
        return spent  # the first process reports
    args.out.mkdir(parents=True, exist_ok=True)
    torch.save(learner.policy.actor.state_dict(), args.out / "walk.pt")
    up, speed, rate = test(learner.policy.actor)
    print(f"at the end: {up:.0%} up, errors {speed:.3f} m/s and {rate:.3f} rad/s")
    print("does not walk yet" if walks is None else f"walks after {walks:.0f} s")
    return walks


if __name__ == "__main__":
    torch.set_flush_denormal(True)
    sys.exit(main(tyro.cli(Args)) is None)
