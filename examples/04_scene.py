"""A scene, effect by effect: its influence on a falling Panda, and its cost per step.

    python examples/04_scene.py

A bare scene has no effects. Each row of the table adds one effect to those above it, and shows its operations and
nanoseconds per step, the energy of the arm after the fall, and the change of the final position. Finally, the viscous
friction of the arm is estimated from its motion by gradients through the steps.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, ORANGE, prepare, save
from rich.console import Console
from rich.table import Table

import torchdq
from torchdq import Scene, effects
from torchdq.scene import integrators


@dataclass
class Args:
    duration: float = 2.0
    """Time to simulate [s]."""
    step: float = 1e-3
    """Step of the integrator [s]."""
    seconds: float = 10.0
    """Time for the costs of the effects, compiling included [s]."""
    iterations: int = 100
    """Optimiser steps of learning the friction."""
    out: Path = Path("out")
    """Folder of the picture."""


PARTS = (
    effects.Gravity(),
    effects.RotorInertia(0.1),
    effects.Payload(1.5, com=(0.0, 0.0, 0.1)),
    effects.Viscous(0.5),
    effects.Coulomb(1.0),
    effects.JointLimits(),
    effects.Drag(linear=0.2, quadratic=0.1),
    effects.Contact(height=-0.2, friction=0.5),
    effects.Saturation(),
    effects.FirstOrderLag(0.01),
    effects.Noise(position=1e-4, velocity=1e-3),
)


def main(args: Args) -> tuple[dict[str, float], float]:
    """Distance that each effect makes [rad], and the relative error of the learned friction."""
    robot = torchdq.robots.load("panda")
    torch.set_num_threads(1)
    torch.manual_seed(0)
    console = Console(width=110)
    whole = Scene(robot, PARTS, integrator=integrators.LinearlyImplicit(), dt=args.step)
    description = whole.describe(seconds=args.seconds)

    q = torch.tensor([0.3, 0.4, 0.2, -1.2, 0.1, 1.5, 0.5], dtype=torch.float64)
    steps = round(args.duration / args.step)
    torque = torch.zeros(steps, 7, dtype=torch.float64)
    torque[: steps // 10, 3] = 5.0  # a push at the elbow to begin with
    table = Table("effect", "slot", "operations", "ns per step", "energy at the end [J]", "moved the arm by [rad]")
    changed: dict[str, float] = {}
    energies, before = {}, None
    with torch.inference_mode():
        for k, cost in enumerate(description.costs):
            scene = whole.replace(effects=whole.effects[:k])
            states = scene.rollout(scene.start(q), torque)
            energy = scene.energy(states).sum(-1)
            moved = 0.0 if before is None else float((states.q - before).abs().max())
            before, energies[cost.effect], changed[cost.effect] = states.q, energy, moved
            numbers = (f"{cost.operations:+d}", cost.time, f"{float(energy[-1]):.2f}", f"{moved:.2g}")
            table.add_row(cost.effect, cost.slot, *numbers)
    table.add_row("all", "", f"{description.total.operations}", description.total.time, "", "")
    console.print(table)
    console.print(f"({description.measured_on})\nleft out of what the description asks for:")
    for line in description.left_out:
        console.print(f"- {line}", highlight=False)

    prepare()
    figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
    time = torch.arange(1, steps + 1) * args.step
    for name, color in (("Gravity", BLUE), ("Viscous", "#009E73"), ("Coulomb", ORANGE), ("Contact", "#CC79A7")):
        axes.plot(time, energies[name], color=color, linewidth=2, label=f"up to {name}")
    axes.set(xlabel="time [s]", ylabel="energy of the arm [J]", title="A falling Panda under more and more effects")
    axes.legend()
    save(figure, args.out / "scene.png")

    # --- learning through the steps: 64 short falls, and the friction that explains them ---
    true = torch.linspace(0.2, 0.8, 7, dtype=torch.float64)
    falls, speeds = q + 0.3 * torch.randn(64, 7, dtype=torch.float64), torch.randn(64, 7, dtype=torch.float64)
    plant = Scene(robot, (effects.Gravity(), effects.Viscous(true)), dt=5e-3)
    with torch.no_grad():
        seen = plant.rollout(plant.start(falls, speeds), steps=40).q
    logarithm = torch.zeros(7, dtype=torch.float64, requires_grad=True)  # so that the coefficient stays positive
    optimiser = torch.optim.Adam([logarithm], lr=0.1)
    for _ in range(args.iterations):
        scene = plant.replace(effects=(effects.Gravity(), effects.Viscous(logarithm.exp())))
        loss = (scene.rollout(scene.start(falls, speeds), steps=40).q - seen).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    off = float(((logarithm.detach().exp() - true) / true).abs().max())
    console.print(f"\nfriction learned from 64 falls of 0.2 s: within {100 * off:.1f} % at every joint")
    return changed, off


if __name__ == "__main__":
    changed, off = main(tyro.cli(Args))
    sys.exit(0 if off < 0.1 else 1)
