"""An arm that is guided by hand like a spring of chosen stiffness, and estimates how hard it is pushed.

    python examples/29_hand_guided.py

A Panda holds its tip by Cartesian impedance. A hand pushes it sideways with 20 N for a second and lets go. At rest the
tip has moved by force / stiffness, and comes back. A momentum observer finds the force without a sensor.
"""

from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import torch
import tyro
from pictures import BLUE, GREY, ORANGE, prepare, save
from torch import Tensor

import torchdq
from torchdq import dq, effects
from torchdq.nn import MomentumObserver
from torchdq.scene import Scene, controllers

ROBOT = torchdq.robots.load("panda")
START = torch.tensor([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.8], dtype=torch.float64)
DT, FORCE = 0.001, 20.0  # [s], [N]


@dataclass
class Args:
    stiffness: float = 400.0
    """Of the spring along all axes [N/m], critically damped for 5 kg."""
    out: Path = Path(__file__).parent / "figures"
    """Folder of the picture."""


def main(args: Args) -> tuple[Tensor, Tensor, Tensor]:
    """Times, displacements of the tip [m] and forces [N] that the observer finds, both in axes of the base."""
    K = (*[20.0] * 3, *[args.stiffness] * 3)  # about the axes, and along them
    D = (*[2.0] * 3, *[2 * (5 * args.stiffness) ** 0.5] * 3)
    control = controllers.CartesianImpedance(K, D, q_null=START, model=ROBOT)
    scene = Scene(ROBOT, (effects.Gravity(), effects.Push(frame=ROBOT.tip)), controller=control, dt=DT)
    t = DT * torch.arange(1, 4001, dtype=torch.float64)
    pushed = ((t > 0.5) & (t <= 2.0)).to(t)
    observer, start = MomentumObserver(ROBOT, gain=50.0, dt=DT), scene.start(START)
    push = FORCE * pushed[:, None] * torch.eye(6, dtype=torch.float64)[1]
    reference = control.holding(ROBOT, START).expand(len(t), -1)
    carry = torch.cat(observer.start(start.q, start.qd), -1)
    path, rows = scene.rollout(start, reference=reference, push=push, task=observer.task(), carry=carry)
    X = torchdq.forward_kinematics(ROBOT, path.q, ROBOT.tip)
    moved = dq.translation(X) - dq.translation(torchdq.forward_kinematics(ROBOT, START, ROBOT.tip))
    found = observer.force(path.q, rows["r"], expressed="world")[0][:, 3:]
    prepare({"axes.prop_cycle": plt.cycler(color=(BLUE, ORANGE, GREY))})  # of x, y and z
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
    upper.plot(t, 1e3 * moved, label=("x", "y", "z"))
    upper.axhline(1e3 * FORCE / args.stiffness, color="black", linestyle=":", label="force / stiffness")
    upper.set(ylabel="displacement [mm]", title="The tip yields as a spring does")
    lower.plot(t, found, label=("x", "y", "z"))
    lower.plot(t, FORCE * pushed, "k:", label="applied by the hand, along y")
    lower.set(xlabel="time [s]", ylabel="force [N]", title="Estimated force, without a sensor")
    for panel in (upper, lower):
        panel.legend(loc="upper right")
    save(figure, args.out / "hand_guided.png")
    return t, moved, found


if __name__ == "__main__":
    main(tyro.cli(Args))
