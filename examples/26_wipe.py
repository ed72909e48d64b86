"""Arms wipe tables: they press with commanded forces and follow paths, by a policy of a few lines.

    python examples/26_wipe.py

Friction, stiffness and height of each table differ, unknown to the arm. Actions are offsets of the joint positions that
a computed-torque controller tracks along the path, pressed into the table. The policy shifts them by the error of the
path, and along the normal by the integral of the error of the force: an admittance. It also pushes against the friction
of an average table, which turns as the path does. `out/wipe.png` shows paths and forces.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, ORANGE, prepare, save

import torchdq
from torchdq.envs import RobotVectorEnv


@dataclass
class Args:
    arms: int = 256
    """Number of environments."""
    steps: int = 500
    """Steps of 20 ms."""
    path_gain: float = 20.0
    """Rate at which the reference moves by the error of the path [1/s]."""
    force_gain: float = 0.06
    """Speed of the reference along the normal per error of the force [m/s/N]."""
    seed: int = 0
    """Seed of the first arm; the others have the next ones."""
    out: Path = Path("out")
    """Folder of the picture."""


@dataclass
class Wiped:
    """Measurements from two seconds on, [steps, arms]."""

    error: torch.Tensor  # of the normal force, over the commanded one
    distance: torch.Tensor  # from the path [m]
    friction: torch.Tensor  # over mu times the normal force


def main(args: Args) -> Wiped:
    """Forces and distances of arms that wipe along ellipses."""
    torch.set_num_threads(1)
    envs = RobotVectorEnv(args.arms, "wipe", "panda", max_episode_steps=None)
    robot, controller, scale, found = envs.robot, envs.scene.controller, 0.2, []
    observation, _ = envs.reset(seed=args.seed)
    lead = torch.zeros(args.arms, 3)  # shift of the end effector
    for k in range(args.steps):
        way, velocity = observation[:, -10:-8], observation[:, -4:-2]
        force, commanded = observation[:, -2:-1], observation[:, -1:]
        error = torch.cat([way, (force - commanded) * (k > 30)], 1)  # of the force once it has landed
        lead += 0.02 * torch.tensor([args.path_gain, args.path_gain, args.force_gain]) * error
        shift = lead + torch.tensor([2.0, 2.0, 0.001]) * error
        friction = 0.5 * commanded * torch.nn.functional.normalize(velocity)  # of an average table
        J = torchdq.jacobian(robot, envs.state.q, robot.tip, expressed="world")[:, 3:]
        M = torchdq.mass_matrix(controller.model, envs.state.q)
        bend = torch.linalg.solve(M, J.mT) / torch.tensor(controller.kp)[:, None]  # by a force on the tip
        push = torch.linalg.solve(J @ bend, shift[:, :, None])
        push[:, :2] += friction[:, :, None]
        offsets = (bend @ push)[:, :, 0]
        observation, _, terminated, _, info = envs.step((offsets / scale).clamp(-1, 1))
        assert not terminated.any()
        contact = envs.scene.contacts(envs.state)
        sideways = contact.force[:, 0, :2].norm(dim=1)
        tip = torchdq.dq.translation(torchdq.forward_kinematics(robot, envs.state.q, robot.tip))
        mu = envs.scene.effects[-1].friction
        found.append((info["error"], info["distance"], sideways / (mu * info["force"]), tip, info["force"]))
    *measured, tips, forces = (torch.stack(x)[100:] for x in zip(*found, strict=True))
    draw(tips, forces, envs.get_state()["goal"], args.out / "wipe.png")
    wiped = Wiped(*measured)
    print(f"{args.arms} arms: force within {wiped.error.max():.1%} of the commanded one")
    print(f"friction within {(wiped.friction - 1).abs().max():.2%} of mu times the normal force")
    print(f"distance from the path: median {1e3 * wiped.distance.median():.1f} mm, {1e3 * wiped.distance.max():.1f} mm")
    return wiped


def draw(tips: torch.Tensor, forces: torch.Tensor, goal: torch.Tensor, path: Path) -> None:
    """The roundest and the flattest path, and their forces over time."""
    prepare()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.9), layout="constrained")
    arms = {"roundest": (int(goal[:, 4].argmax()), BLUE), "flattest": (int(goal[:, 4].argmin()), ORANGE)}
    for name, (arm, colour) in arms.items():
        left.plot(*(100 * tips[:, arm, :2]).T, color=colour, label=name)
        right.plot(2 + 0.02 * torch.arange(len(forces)), forces[:, arm], color=colour, label=name)
        right.axhline(float(goal[arm, 6]), color=colour, linestyle=":", linewidth=1)
    left.set(xlabel="x [cm]", ylabel="y [cm]", aspect="equal", title="end effector on the table")
    right.set(xlabel="time [s]", ylabel="normal force [N]", title="force, and the commanded one")
    right.legend()
    save(figure, path)


if __name__ == "__main__":
    wiped = main(tyro.cli(Args))
    sys.exit(0 if float(wiped.error.max()) < 0.1 and float((wiped.friction - 1).abs().max()) < 0.01 else 1)
