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
from torchdq import Scene, dq, effects
from torchdq.envs.tasks import tip

ROBOT = torchdq.robots.load("panda")
HOME = torch.tensor([0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.8])
TIP = ROBOT.end_effector().name
GOAL = torch.tensor([0.3, 0.4, 0.6])  # [m]
SCENE = Scene(ROBOT, (effects.Gravity(), effects.Viscous(2.0)), dt=0.02)


@dataclass(frozen=True)
class Cost:
    """Squared distance of the tip from the goal, and squared velocities."""

    def inputs(self, n):
        """Names and widths of the inputs."""
        return {"goal": 3}

    def rows(self, view):
        """Cost of a state."""
        at = tip(view.scene.spec.robot, view.posed(view.q))
        squared = sum((a - b) * (a - b) for a, b in zip(at, view.inputs["goal"], strict=True))
        return {"cost": [1000.0 * squared + 0.1 * sum(v * v for v in view.qd)]}


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
    torch.manual_seed(0)
    state, times = SCENE.start(HOME), []
    hold = torchdq.inverse_dynamics(ROBOT, HOME, 0 * HOME, 0 * HOME)
    plan, goal = hold.repeat(args.horizon, 1), GOAL.expand(args.horizon, 3)
    noise = args.spread * torch.randn(args.horizon, 2 * args.samples, ROBOT.n)  # drawn once: it takes as long as a tick
    for k in range(args.ticks):
        begun, first = time.perf_counter(), int(torch.randint(args.samples, ()))
        torque = plan[:, None] + noise[:, first : first + args.samples]
        _, rows = SCENE.rollout(state, torque, task=Cost(), goal=goal, total=("cost",), ends=True)
        cost = rows["cost"].nan_to_num(torch.inf)
        weight = torch.softmax((cost.min() - cost) / args.temperature, 0)
        plan = torch.einsum("s,hsn->hn", weight, torque)
        state = SCENE.step(state, plan[0])
        plan = torch.cat([plan[1:], plan[-1:]])
        times.append(time.perf_counter() - begun)
        distance = float((dq.translation(torchdq.forward_kinematics(ROBOT, state.q, TIP)) - GOAL).norm())
        if k % 10 == 9:
            print(f"{(k + 1) * SCENE.dt:4.1f} s: the tip is {100 * distance:5.1f} cm from the goal")
    found = Found(distance, sorted(times)[len(times) // 2])
    print(f"a tick takes {1e3 * found.tick:.1f} ms: {args.samples} rollouts of {args.horizon} steps")
    return found


if __name__ == "__main__":
    main(tyro.cli(Args))
