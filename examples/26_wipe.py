"""Arms wipe tables: they press with commanded forces and follow paths, by a policy of a few lines.

    python examples/26_wipe.py

Friction, stiffness and height of each table differ, unknown to the arm. Actions are offsets of the joint positions that
a computed-torque controller tracks along the path, pressed into the table. The policy shifts them by the error of the
path, and along the normal by the integral of the error of the force: an admittance. `out/wipe.png` shows paths and
forces.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, ORANGE, prepare, save

import torchdq
from torchdq.envs import ArmVectorEnv


@dataclass
class Args:
    arms: int = 256
    """Number of environments."""
    steps: int = 500
    """Steps of 20 ms."""
    path_gain: float = 20.0
    """Rate at which the reference moves by the error of the path [1/s]."""
    force_gain: float = 0.05
    """Speed of the reference along the normal per error of the force [m/s/N]."""
    out: Path = Path("out")
    """Folder of the picture."""


@dataclass
class Wiped:
    """Measurements from two seconds on, [steps, circles]; on lines, where friction turns around, apart."""

    error: torch.Tensor  # of the normal force, over the commanded one
    line_error: torch.Tensor  # the same of lines
    distance: torch.Tensor  # from the path [m]
    friction: torch.Tensor  # over mu times the normal force


def main(args: Args) -> Wiped:
    """Forces and distances of arms that wipe, on circles and lines."""
    torch.set_num_threads(1)
    envs = ArmVectorEnv(args.arms, "wipe", "panda", max_episode_steps=None)
    robot, scale, found = envs.robot, 0.2, []
    observation, _ = envs.reset(seed=0)
    lead = torch.zeros(args.arms, 3)  # shift of the end effector
    for k in range(args.steps):
        way, force, commanded = observation[:, -10:-8], observation[:, -2:-1], observation[:, -1:]
        lead[:, :2] += 0.02 * args.path_gain * way
        lead[:, 2:] += 0.02 * args.force_gain * (force - commanded) * (k > 30)  # once it has landed
        shift = lead + torch.cat([2.0 * way, torch.zeros_like(force)], 1)
        J = torchdq.jacobian(robot, envs.state.q, robot.tip, expressed="world")[:, 3:]
        offsets = J.mT @ torch.linalg.solve(J @ J.mT + 1e-4 * torch.eye(3), shift[:, :, None])
        observation, _, terminated, _, info = envs.step((offsets[:, :, 0] / scale).clamp(-1, 1))
        assert not terminated.any()
        contact = envs.scene.contacts(envs.state)
        sideways = contact.force[:, 0, :2].norm(dim=1)
        tip = torchdq.dq.translation(torchdq.forward_kinematics(robot, envs.state.q, robot.tip))
        mu = envs.scene.effects[-1].friction
        found.append((info["error"], info["distance"], sideways / (mu * info["force"]), tip, info["force"]))
    goal = envs.get_state()["goal"]
    errors, distances, friction, tips, forces = (torch.stack(x)[100:] for x in zip(*found, strict=True))
    circles = goal[:, 4] > 0
    draw(tips, forces, goal, args.out / "wipe.png")
    wiped = Wiped(errors[:, circles], errors[:, ~circles], distances[:, circles], friction[:, circles])
    share = (wiped.line_error < 0.1).float().mean()
    print(f"{int(circles.sum())} circles: force within {wiped.error.max():.1%} of the commanded one")
    print(f"friction within {(wiped.friction - 1).abs().max():.2%} of mu times the normal force")
    print(f"distance from the path: median {1e3 * wiped.distance.median():.1f} mm, {1e3 * wiped.distance.max():.1f} mm")
    print(
        f"{int((~circles).sum())} lines: force within 10 % for {share:.1%} of the time; friction turns with the motion"
    )
    return wiped


def draw(tips: torch.Tensor, forces: torch.Tensor, goal: torch.Tensor, path: Path) -> None:
    """Paths of a circle and a line, and their forces over time."""
    prepare()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.9), layout="constrained")
    kinds = {
        "circle": (int((goal[:, 4] > 0).int().argmax()), BLUE),
        "line": (int((goal[:, 4] == 0).int().argmax()), ORANGE),
    }
    for name, (arm, colour) in kinds.items():
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
