"""A Panda on a satellite: the arm moves, the satellite counter-rotates, and the total momentum stays zero.

    python examples/12_satellite.py

The base is floating. The torques come from the blocks of the mass matrix (`reactions.py`), the motion from a scene
without gravity; the figure shows rotation and drift of the satellite while the arm extends and returns.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, ORANGE, prepare, save
from reactions import followed, smooth, torques

import torchdq
from torchdq import Scene, dq, floating
from torchdq.scene import integrators


@dataclass
class Args:
    duration: float = 4.0
    """Time in which the arm goes out and comes back [s]."""
    step: float = 5e-3
    """Step of the integrator [s]."""
    mass: float = 120.0
    """Mass of the satellite, a cube with an edge of 1 m [kg]."""
    out: Path = Path("out")
    """Folder of the picture."""


def main(args: Args) -> tuple[float, float, float]:
    """Largest turn of the satellite [deg], and the largest momenta on the way [N s, N m s]."""
    arm = torchdq.robots.load("panda")
    cube = args.mass / 6
    robot = arm.replace(
        gravity=None,
        base_mass=torch.tensor(args.mass, dtype=torch.float64),
        base_com=torch.tensor([0.0, 0.0, -0.5], dtype=torch.float64),
        base_inertia=torch.tensor([cube, 0, cube, 0, 0, cube], dtype=torch.float64),
    ).bake()
    scene = Scene(robot, integrator=integrators.RungeKutta4(), dt=args.step)
    home = torch.tensor([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8], dtype=torch.float64)
    reach = torch.tensor([1.2, 1.6, 0.0, 1.8, 0.0, 0.0, 0.0], dtype=torch.float64)
    steps = round(args.duration / args.step)
    times = torch.arange(steps, dtype=torch.float64) * 2 / steps

    def policy(state, k):
        t = times[k]
        s, rate, second = smooth(1 - (1 - t).abs())
        rate, second = rate * torch.sign(1 - t) * 2 / args.duration, second * (2 / args.duration) ** 2
        return torques(robot, state, followed(state, home + s * reach, rate * reach, second * reach))

    with torch.inference_mode():
        path = scene.rollout(scene.start(home), steps=steps, policy=policy)
        p, L = floating.momentum(robot, path.X_WB, path.q, path.V_WB_B, path.qd)
        centre = floating.centre_of_mass(robot, path.X_WB, path.q)
        turn = 2 * path.X_WB[:, 1:4].norm(dim=-1).asin().rad2deg()
        corner = dq.translation(path.X_WB).norm(dim=-1)
    linear, angular = float(p.norm(dim=-1).max()), float(L.norm(dim=-1).max())
    moved = float((centre - centre[0]).norm(dim=-1).max())
    print(f"the satellite turns by up to {turn.max():.1f} deg and ends {turn[-1]:.2f} deg from where it was")
    print(f"momentum below {linear:.1e} N s and {angular:.1e} N m s; centre of mass within {moved:.1e} m")

    prepare()
    figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
    time = torch.arange(1, steps + 1) * args.step
    axes.plot(time, turn, color=BLUE, label="turn of the satellite [deg]")
    axes.plot(time, 100 * corner, color=ORANGE, label="its origin moved by [cm]")
    axes.plot(time, path.q[:, 0].rad2deg() / 10, color=GREY, label="first joint of the arm [10 deg]")
    axes.set(xlabel="time [s]", title="An arm moves, and its satellite moves the other way")
    axes.legend()
    save(figure, args.out / "satellite.png")
    return float(turn.max()), linear, angular


if __name__ == "__main__":
    turn, linear, angular = main(tyro.cli(Args))
    sys.exit(0 if turn > 1 and linear < 1e-6 and angular < 1e-6 else 1)
