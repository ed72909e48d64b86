"""Model predictive path integral control: a Panda whose tip goes to a point, by 4096 rollouts a tick.

    python examples/27_mppi.py

Torques of the next 0.6 s are drawn about the last plan, the simulation says what each costs, and the next plan is their
mean, weighted with exp(-cost / temperature). The cost is part of the simulated step, in one compiled loop.

Source: G. Williams, A. Aldrich, E. Theodorou, "Model predictive path integral control: from theory to parallel
computation", Journal of Guidance, Control, and Dynamics 40 (2017).
"""

import time
from dataclasses import dataclass
from typing import NamedTuple

import torch
import tyro

import torchdq
from torchdq import Scene, dq, effects, optimal

ROBOT = torchdq.robots.load("panda")
HOME = torch.tensor([0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.8])
TIP = ROBOT.end_effector().name
GOAL = torch.tensor([0.3, 0.4, 0.6])  # [m]
SCENE = Scene(ROBOT, (effects.Gravity(), effects.Viscous(2.0)), dt=0.02)
COSTS = [optimal.Point(TIP, GOAL, 2000.0), optimal.Speeds(0.2)]


@dataclass
class Args:
    samples: int = 4096
    """Rollouts a tick."""
    horizon: int = 30
    """Steps of each, of 0.02 s."""
    ticks: int = 100
    """Steps of the arm."""
    spread: float = 2.0
    """Standard deviation of the torques [N m]."""
    temperature: float = 5.0
    """Difference of costs by which a weight falls to 1/e."""


class Found(NamedTuple):
    """Distance of the tip from the goal at the end [m], and the median time of a tick [s]."""

    distance: float
    tick: float


def main(args: Args) -> Found:
    """Control the arm, and print where its tip is."""
    method = optimal.MPPI(args.samples, args.spread, temperature=args.temperature)
    mpc = optimal.Receding(optimal.Problem(SCENE, args.horizon, COSTS), method=method)
    state, times = SCENE.start(HOME), []
    for k in range(args.ticks):
        begun = time.perf_counter()
        torque, _ = mpc(state)
        times.append(time.perf_counter() - begun)
        state = SCENE.step(state, torque)
        distance = float((dq.translation(torchdq.forward_kinematics(ROBOT, state.q, TIP)) - GOAL).norm())
        if k % 10 == 9:
            print(f"{(k + 1) * SCENE.dt:4.1f} s: the tip is {100 * distance:5.1f} cm from the goal")
    found = Found(distance, sorted(times)[len(times) // 2])
    print(f"a tick takes {1e3 * found.tick:.1f} ms: {args.samples} rollouts of {args.horizon} steps")
    return found


if __name__ == "__main__":
    main(tyro.cli(Args))
