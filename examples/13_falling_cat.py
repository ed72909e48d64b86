"""A cat falls on its back and lands on its feet: it turns over with zero angular momentum.

    python examples/13_falling_cat.py

Two halves of a body, bent against each other, roll about their own axes at opposite rates. The angular momentum is zero
at every instant and the final shape is the initial one, yet the whole cat has rotated by half a turn (T. R. Kane,
M. P. Scher, A dynamical explanation of the falling cat phenomenon, 1969). Gravity and free fall have no influence.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, ORANGE, prepare, save
from reactions import followed, smooth, torques

import torchdq
from torchdq import Scene, dq, effects, floating
from torchdq.scene import integrators


@dataclass
class Args:
    height: float = 1.8
    """Height of the fall [m]."""
    bend: float = 1.13
    """Angle between the halves [rad]; more or less of it turns the cat less."""
    steps: int = 600
    """Steps of the integrator."""
    out: Path = Path("out")
    """Folder of the picture."""


def halves(mass: float = 1.5, length: float = 0.25, radius: float = 0.06) -> torchdq.Robot:
    """Cat of two cylinders along x: the base is the front one, and three joints carry the other."""
    across, along = mass * (3 * radius**2 + length**2) / 12, mass * radius**2 / 2
    cylinder = [along, 0, across, 0, 0, across]
    light = [1e-6, 0, 1e-6, 0, 0, 1e-6]  # the parts of the spine between the joints
    robot = torchdq.Robot.from_screws(
        [[1.0, 0, 0, 0, 0, 0], [0.0, 1, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0]],
        [0.01, 0.01, mass],
        [[0.0, 0, 0], [0, 0, 0], [-length / 2, 0, 0]],
        [light, light, cylinder],
        joint_names=["roll_front", "bend", "roll_back"],
        gravity=(0.0, 0.0, -9.81),
        name="cat",
    )
    front = {"base_mass": mass, "base_com": [length / 2, 0, 0], "base_inertia": cylinder}
    return robot.replace(**{name: torch.tensor(x, dtype=torch.float64) for name, x in front.items()}).bake()


def main(args: Args) -> tuple[float, float]:
    """Turn of the cat [deg], and the largest angular momentum on the way [N m s]."""
    robot, T = halves(), math.sqrt(2 * args.height / 9.81)
    scene = Scene(robot, (effects.Gravity(),), integrator=integrators.RungeKutta4(), dt=T / args.steps)
    times = torch.arange(args.steps, dtype=torch.float64) / args.steps
    roll = torch.tensor([2 * math.pi, 0, -2 * math.pi], dtype=torch.float64)
    shape = torch.tensor([0, args.bend, 0], dtype=torch.float64)

    def policy(state, k):
        s, rate, second = smooth(times[k])
        return torques(robot, state, followed(state, shape + s * roll, rate / T * roll, second / T**2 * roll))

    # half of the bend on either side of the horizontal, and on its back
    tilt = dq.exp(torch.tensor([0, -args.bend / 4, 0, 0, 0, 0], dtype=torch.float64))
    over = dq.from_pose(torch.tensor([0.0, 1, 0, 0]).double(), torch.tensor([0, 0, args.height]).double())
    start = scene.start(shape, X_WB=dq.mul(over, tilt))
    with torch.inference_mode():
        path = scene.rollout(start, steps=args.steps, policy=policy)
        _, L = floating.momentum(robot, path.X_WB, path.q, path.V_WB_B, path.qd)
        back = floating.centre_of_mass(robot, path.X_WB, path.q)
        turn = 2 * dq.mul(path.X_WB, dq.conj(start.X_WB))[:, 0].abs().clamp(max=1).acos().rad2deg()
    largest = float(L.norm(dim=-1).max())
    print(f"the cat has turned by {turn[-1]:.1f} deg after {T:.2f} s and {args.height:g} m")
    print(f"angular momentum below {largest:.1e} N m s; its centre of mass fell {back[0, 2] - back[-1, 2]:.3f} m")

    prepare()
    figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
    time = torch.arange(1, args.steps + 1) * scene.dt
    axes.plot(time, turn, color=BLUE, label="turn of the front half [deg]")
    axes.plot(time, 100 * back[:, 2], color=ORANGE, label="height of the centre of mass [cm]")
    axes.set(xlabel="time [s]", title="A falling cat turns over without angular momentum")
    axes.legend()
    save(figure, args.out / "cat.png")
    return float(turn[-1]), largest


if __name__ == "__main__":
    turn, momentum = main(tyro.cli(Args))
    sys.exit(0 if turn > 170 and momentum < 1e-6 else 1)
