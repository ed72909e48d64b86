"""An arm with a gripper that pushes, lifts or picks a cube, learned on one thread.

    python examples/31_hands_ppo.py pick [--seconds 120] [--seed 0] [--robot FILE] [--out FOLDER]
    python examples/31_hands_ppo.py lift --object cylinder --size 0.02 0.06

PPO as in `21_walk_ppo.py`, with 1024 arms of `torchdq/Push-v0`, `Lift-v0` or `Pick-v0`, whose cubes differ in mass,
size and friction. A policy is tested now and then on 256 nominal cubes, and has learned its task when 98 % succeed at
the end of an episode in three tests in a row. Times are those of the processor, without the tests. `out/pick.pt` has
the policy.
"""

import os
import sys
import time
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
import tyro
from torch import nn

import torchdq
from torchdq import Robot
from torchdq.envs import RobotVectorEnv
from torchdq.envs.manipulation import Manipulation
from torchdq.envs.task_names import task_of
from torchdq.objects import Ball, Box, Capsule, Cylinder, Object

ppo = import_module("21_walk_ppo")
SETTINGS = ppo.Settings(epochs=3, value_epochs=3, gamma=0.9, decay=0.9, entropy=0.001, change=0.01, std=0.6, unit=1.0)
STEPS, TESTED, SHARE, ROW = 50, 256, 0.98, 3  # of an episode; robots, share and number of tests


@dataclass
class Learning:
    seconds: float = 120.0
    """Processor time to learn in, at most."""
    seed: int = 0
    """Seed of policy and robots."""
    robots: int = 1024
    """Number of robots, a multiple of 32."""
    out: Path = Path("out")
    """Folder of the policy."""


@dataclass
class Args(Learning):
    task: Annotated[Literal["push", "lift", "pick"], tyro.conf.Positional] = "pick"
    """Task to learn."""
    robot: str = "panda_hand"
    """Name of a shipped robot with a gripper, or a URDF or MJCF file of one."""
    tip: str | None = None
    """Frame between the fingers, whose z axis points out of the hand; None: the robot's end effector."""
    fingers: str = "finger_joint*"
    """Names or patterns of the joints that open the gripper."""
    pads: str = "*_finger"
    """Names or patterns of the frames of the fingers, whose file has spheres on them."""
    object: Literal["box", "ball", "capsule", "cylinder"] = "box"
    """Shape of the object."""
    size: tuple[float, ...] = (0.04, 0.04, 0.04)
    """Lengths of a box, radius of a ball, radius and length of a capsule or a cylinder [m]."""
    mass: float = 0.1
    """Mass of the object [kg]."""
    gains: tuple[float, float] = (1000.0, 100.0)
    """Stiffness and damping of the servos [N m/rad, N m s/rad]; a heavy arm needs stiffer ones."""
    home: tuple[float, ...] = ()
    """Positions of the joints at a start, the tip above the table and pointing down [rad or m]."""

    def load(self) -> Robot:
        """The robot."""
        if self.robot in torchdq.robots.names():
            return torchdq.robots.load(self.robot)
        read = Robot.from_mjcf if Path(self.robot).suffix == ".xml" else Robot.from_urdf
        return read(self.robot, tip=self.tip)

    def of_task(self) -> Manipulation:
        """The task."""
        own = {"home": self.home} if self.home else {}
        own |= {"object": self.of_object(), "fingers": self.fingers, "pads": self.pads, "gains": self.gains}
        return replace(task_of(self.task), **own)

    def of_object(self) -> Object:
        """The object."""
        if self.object == "box":
            return Box("cube", self.mass, size=self.size)
        kind = {"ball": Ball, "capsule": Capsule, "cylinder": Cylinder}[self.object]
        names = ("radius",) if self.object == "ball" else ("radius", "length")
        return kind(self.object, self.mass, **dict(zip(names, self.size, strict=True)))


class Test:
    """Arms with nominal cubes.

    Args:
        task: the task.
        robot: the robot.
    """

    def __init__(self, task: Manipulation, robot: Robot) -> None:
        self.envs = RobotVectorEnv(TESTED, task, robot, max_episode_steps=None)
        self.envs.set(randomise=dict.fromkeys(task.defaults(self.envs.robot)["randomise"], (1.0, 1.0)))

    def __call__(self, policy: nn.Module) -> tuple[float, float]:
        """Share that succeeds at the end of an episode, and mean distance from the goal [m]."""
        self.envs.reset(seed=1_000_000_000)
        found = self.envs.rollout(policy, STEPS)
        success = found.info["success"][-1] * ~found.terminated.any(0)
        return float(success.mean()), float(found.info["distance"][-1].mean())


def learn(task: Manipulation, robot: Robot, args: Learning) -> tuple[nn.Module, float | None]:
    """Policy, and processor time after which it had learned the task [s]; None: it has not."""
    envs = RobotVectorEnv(args.robots, task, robot, max_episode_steps=STEPS)
    learner, test = ppo.PPO(envs, args.seed, SETTINGS), Test(task, robot)
    policy, name = learner.policy.actor, type(task).__name__
    test(policy)  # compiles
    k, row, spent, learned = 0, 0, 0.0, None
    while spent < args.seconds and row < ROW:
        begin = time.process_time()
        samples, means = learner.rollout()
        learner.update(samples)
        k, spent = k + 1, spent + time.process_time() - begin
        if k % 5 == 0:
            share, distance = test(policy)
            row = row + 1 if share >= SHARE else 0
            learned = spent if row == ROW else None
            print(
                f"{name} {spent:5.1f} s  {k * len(samples[0]) / 1e6:.2f} million samples  reward {means['reward']:.3f}"
                f"  test: {share:.0%} succeed, {1e3 * distance:.0f} mm from the goal",
                flush=True,
            )
    return policy, learned


def main(args: Args) -> float | None:
    """Processor time until the task is learned [s]; None: it is not."""
    torch.set_num_threads(1)
    policy, learned = learn(args.of_task(), args.load(), args)
    args.out.mkdir(parents=True, exist_ok=True)
    torch.save(policy.state_dict(), args.out / f"{args.task}.pt")
    print("not learned yet" if learned is None else f"learned after {learned:.0f} s")
    return learned


if __name__ == "__main__":
    torch.set_flush_denormal(True)
    sys.exit(main(tyro.cli(Args)) is None)
