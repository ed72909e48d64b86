"""Lifting, learned from gradients through a grasp: short-horizon actor-critic, as an alternative to PPO.

    python examples/35_hands_shac.py lift [--seconds 120] [--seed 0] [--out FOLDER]

`improve` of `22_walk_shac.py` on the task of `31_hands_ppo.py`: rewards of 8 actions and the value of the state after
them are differentiated through 80 steps of arm, fingers and cube. Two things are softer than there: friction of the
fingers has no stiction, and a finger presses more or less, where the task says yes or no. The gradient of a row is
bounded at every action, since some grow without limit over an impact. The test is that of `31_hands_ppo.py`, and the
page of the guide has both times.
"""

import copy
import sys
import time
from dataclasses import dataclass, replace
from importlib import import_module

import torch
import tyro
from torch import Tensor, nn

from torchdq import Robot, Scene, effects
from torchdq.backends.choice import choose
from torchdq.backends.precision import run
from torchdq.envs import RobotVectorEnv
from torchdq.envs.manipulation import PERIOD, Manipulation
from torchdq.numbers.functions import tanh
from torchdq.program.program import Argument, record

hands, shac = import_module("31_hands_ppo"), import_module("22_walk_shac")
SETTINGS = shac.Settings(horizon=8, gamma=0.9, unit=1.0, episode=hands.STEPS)
STARTS, SUBSTEPS, STD = 1024, 10, 0.4  # starts of episodes, steps of an action, standard deviation of actions
FIRM = 2.0  # a finger presses by tanh(FIRM force) [1/N]
STEEPEST = 3e-4  # gradient of a row


@dataclass
class Args(hands.Args):
    robots: int = 256
    """Number of robots."""
    rate: float = 1e-3
    """Learning rate of the policy."""


class Hands:
    """Arms and objects of a task, differentiable."""

    def __init__(self, robots: int, task: Manipulation, robot: Robot, seed: int) -> None:
        own, self.task, self.robot = task.defaults(robot), task, robot
        acting = [replace(x, stiction=False) if isinstance(x, effects.Contact) and x.on else x for x in own["effects"]]
        self.scene = Scene(robot, acting, objects=task.objects(robot), dt=PERIOD / SUBSTEPS)
        self.scale, cube = torch.tensor(own["scale"]), task.object.name
        envs = RobotVectorEnv(STARTS, task, robot, max_episode_steps=None)
        envs.reset(seed=STARTS * seed)
        self.starts = envs.state.q, envs.state.X_WO, envs.get_state()["goal"]
        pads = dict.fromkeys(frame for frame, on in self.scene.touching if on == cube)
        self.pads = [[k for k, pair in enumerate(self.scene.touching) if pair == (pad, cube)] for pad in pads]
        widths = {"q": robot.n, "qd": robot.n, "X_WO": 8, "V_WO": 6, "force": len(pads), "goal": 3}
        self.program = record("look", [Argument(name, width) for name, width in widths.items()], self.rows)
        self.state = self.scene.start(self.starts[0][:robots], X_WO=self.starts[1][:robots])
        self.goal, self.steps = self.starts[2][:robots], torch.randint(hands.STEPS, (robots,))
        self.seen = self.look()

    def rows(self, q: tuple, qd: tuple, X: tuple, V: tuple, force: tuple, goal: tuple) -> dict[str, list]:
        """Observation, reward and targets without an action, as the task has them."""
        X_WO, fingers = (tuple(X[:4]), tuple(X[4:])), [tanh(FIRM * x) for x in force]
        return {
            "observation": self.task.observed(self.robot, q, qd, X_WO, V, tuple(goal), fingers),
            "reward": [self.task.judged(self.robot, q, qd, X_WO, tuple(goal), fingers)[0]],
            "target": self.task.reference(self.robot, q),
        }

    def look(self) -> list[Tensor]:
        """Rows of the present state."""
        x, pressing = self.state, self.scene.contacts(self.state).normal_force
        force = torch.stack([pressing[:, own].sum(1) for own in self.pads], 1)
        return [*run(self.program, [x.q, x.qd, x.X_WO[:, 0], x.V_WO[:, 0], force, self.goal], choose(None, x.q.device))]

    def observation(self) -> Tensor:
        """Observation of the task."""
        return self.seen[0]

    def cut(self) -> None:
        """Keep the state, without its gradient."""
        self.state = self.state._replace(**{name: x.detach() for name, x in self.state.rows().items()})
        self.seen = self.look()

    def reset(self, where: Tensor) -> None:
        """Begin new episodes in some rows."""
        if where.any():
            row, k = where[:, None], torch.randint(STARTS, where.shape)
            q, X_WO, goal = (x[k] for x in self.starts)
            begun, now = self.scene.start(q, X_WO=X_WO).rows(), self.state.rows()
            self.state = self.state._replace(**{name: torch.where(row, x, now[name]) for name, x in begun.items()})
            self.goal, self.steps = torch.where(row, goal, self.goal), torch.where(where, 0, self.steps)
            self.seen = self.look()

    def step(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Rewards, and where the simulation failed."""
        target = self.seen[2] + self.scale * action.clamp(-1, 1)
        self.state = self.scene.rollout(self.state, target=target.expand(SUBSTEPS, *target.shape), ends=True)
        for x in self.state.rows().values():
            x.register_hook(bounded)
        self.seen, self.steps = self.look(), self.steps + 1
        return self.seen[1][:, 0], ~(self.state.qd.detach().abs().amax(1) < 50.0)


def bounded(gradient: Tensor) -> Tensor:
    """Gradient with rows of a bounded length, and none where it is not finite."""
    finite = torch.where(gradient.isfinite().all(1, keepdim=True), gradient, 0.0)
    return finite * (STEEPEST / finite.norm(dim=1, keepdim=True).clamp(min=STEEPEST))


def main(args: Args) -> tuple[nn.Module, float]:
    """Policy, and the largest share of a test that succeeded."""
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    task, robot = args.of_task(), args.load()
    arms, test = Hands(args.robots, task, robot, args.seed), hands.Test(task, robot)
    policy = hands.ppo.Policy(arms.observation().shape[1], robot.n, STD)
    slow, best, spent, k = copy.deepcopy(policy), 0.0, 0.0, 0
    actor = torch.optim.Adam(policy.actor.parameters(), lr=args.rate, betas=(0.7, 0.95))
    critic = torch.optim.Adam(policy.critic.parameters(), lr=1e-3)
    test(policy.actor)
    shac.improve(arms, copy.deepcopy(policy), slow, torch.optim.SGD(policy.actor.parameters(), lr=0.0), SETTINGS)
    while spent < args.seconds and best < hands.SHARE:
        begin = time.process_time()
        seen = shac.improve(arms, policy, slow, actor, SETTINGS)
        shac.fit(policy, critic, seen, SETTINGS)
        with torch.no_grad():
            for old, new in zip(slow.parameters(), policy.parameters(), strict=True):
                old.lerp_(new, 0.6)
        k, spent = k + 1, spent + time.process_time() - begin
        if k % 25 == 0 or spent >= args.seconds:
            share, distance = test(policy.actor)
            best = max(best, share)
            print(
                f"{spent:5.1f} s  {k * seen[1].numel() / 1e6:.2f} million samples  reward {seen[1].mean():.3f}"
                f"  test: {share:.0%} succeed, {1e3 * distance:.0f} mm from the goal",
                flush=True,
            )
    args.out.mkdir(parents=True, exist_ok=True)
    torch.save(policy.actor.state_dict(), args.out / f"{args.task}.pt")
    return policy, best


if __name__ == "__main__":
    torch.set_flush_denormal(True)
    sys.exit(main(tyro.cli(Args))[1] < hands.SHARE)
