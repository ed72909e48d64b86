"""Computed torque of the Panda with exact masses and with 10 % mass error: two arms in one batch.

    python examples/03_computed_torque.py

Both arms are the same; their controllers differ. With exact masses the error of every joint decays as
e'' + kd e' + kp e = 0, for any motion. With wrong ones a steady error remains: the torque mismatch over kp.
"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
import tyro
from closed_loop import simulated
from matplotlib import pyplot as plt
from pictures import BLUE, ORANGE, prepare, save
from torch import Tensor

import torchdq

double = partial(torch.tensor, dtype=torch.float64)


@dataclass
class Args:
    duration: float = 2.0
    """Time to simulate [s]."""
    step: float = 0.01
    """Step of the fourth-order Runge-Kutta rule [s]."""
    kp: float = 100.0
    """Position gain [1/s^2]; the velocity gain is 2 sqrt(kp), critical damping."""
    wrong: float = 1.1
    """Factor on the masses of the second controller's model."""
    out: Path = Path("out")
    """Folder of the picture."""


def main(args: Args) -> tuple[float, float]:
    """Largest error at the end with right and with wrong masses [rad]."""
    robot = torchdq.robots.load("panda")
    models = robot.replace(mass=robot.mass * double([[1.0], [args.wrong]]))  # a batch of two robots
    controller = torchdq.ComputedTorque(models, kp=args.kp, kd=2 * args.kp**0.5)
    rest = double([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8])
    swing = double([0.5, 0.4, 0.5, 0.4, 0.6, 0.5, 0.8])
    rate = double([2.0, 2.25, 2.5, 2.75, 3.0, 3.25, 3.5])

    def reference(t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        s, c = torch.sin(rate * t), torch.cos(rate * t)
        return rest + swing * s, swing * rate * c, -swing * rate**2 * s

    time, h = double(range(round(args.duration / args.step) + 1)) * args.step, args.step
    q_des, qd_des, _ = reference(time[0])
    x = torch.stack([q_des - 0.1, qd_des])[:, None].expand(2, 2, 7)  # (q, qd), arm, joint; each joint 0.1 rad behind
    with torch.inference_mode():
        states = simulated(robot, lambda t, q, qd: controller(q, qd, *reference(t)), x, time[:-1], h)
    errors = reference(time[:, None, None])[0] - states[:, 0]  # [time, arm, joint]
    right, wrong = errors.abs().amax(-1).T  # the worst joint

    prepare()
    figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
    axes.semilogy(time, wrong, color=ORANGE, linewidth=2, label=f"masses times {args.wrong:g}")
    axes.semilogy(time, right, color=BLUE, linewidth=2, label="right masses")
    axes.semilogy(time, 0.1 * (1 + args.kp**0.5 * time) * torch.exp(-(args.kp**0.5) * time), "k:", label="analytic")
    axes.set(xlabel="time [s]", ylabel="error of the worst joint [rad]")
    axes.set_title(f"Computed torque of the Panda, Runge-Kutta steps of {1e3 * h:g} ms")
    axes.legend()
    save(figure, args.out / "computed_torque.png")
    print(f"error after {args.duration:g} s: right masses {right[-1]:.1e} rad, wrong {wrong[-1]:.1e} rad")
    return float(right[-1]), float(wrong[-1])


if __name__ == "__main__":
    right, wrong = main(tyro.cli(Args))
    sys.exit(0 if right < 1e-6 < wrong else 1)
