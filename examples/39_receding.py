"""A receding horizon beneath a kilohertz loop: an arm with a load that its model has not, and delays.

    python examples/39_receding.py

The arm goes to a point, and then to another. It plans 0.5 s ahead, fifty times a second. In between, a loop at 1 kHz
applies the torques of the plan and its gains. Measurements are 3 ms old, torques act 2 ms late, and the hand carries
two kilograms that no model knows of. The loop predicts the state in which its torques will act. The figure
`out/receding.png` shows the distance of the tool from its goal, with gains and with torques held from plan to plan.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, prepare, save
from torch import Tensor

import torchdq
from torchdq import Scene, dq, effects, optimal

ROBOT = torchdq.Robot.from_urdf(Path(__file__).parent / "arm.urdf")
TICK, INSIDE, STEPS = 0.02, 20, 25  # step of the plan [s], cycles of the loop in it, steps of the plan
MEASURED, COMMANDED = 3, 2  # delays [cycles]
KNOWN = (effects.Gravity(), effects.Viscous())
MODEL = Scene(ROBOT, KNOWN, dt=TICK)
FINE = Scene(ROBOT, KNOWN, dt=TICK / INSIDE)
LATE = (effects.CommandDelay(COMMANDED), effects.MeasurementDelay(MEASURED))
ARM = Scene(ROBOT, (*KNOWN, effects.Payload(2.0), *LATE), dt=TICK / INSIDE)
HOME = torch.tensor([0.0, 0.5, 1.3, -1.8, 0.6, 0.0], dtype=torch.float64)
GOALS = torch.tensor([[0.2, 0.6, 0.5], [0.5, -0.3, 0.6]], dtype=torch.float64)  # [m]
LIMITS = ROBOT.limits.effort


@dataclass
class Args:
    seconds: float = 2.0
    """Time for each goal."""
    out: Path = Path("out")
    """Folder of the picture."""


class Found(NamedTuple):
    """Distances of the tool from its goal in every cycle [m], and the median time of a plan [s]."""

    distance: Tensor
    tick: float


def problem(goal: Tensor) -> optimal.Problem:
    """Way to a goal, at rest by the end."""
    costs = [
        optimal.Torques(1e-6),
        optimal.Speeds(1e-2),
        optimal.Point("tool", goal, 100.0),
        optimal.JointLimits(100.0),
    ]
    return optimal.Problem(MODEL, STEPS, costs, [optimal.Speeds(1.0)])


def controlled(seconds: float, gains: bool) -> Found:
    """Motion to the goals under the loop."""
    mpc, state, times, found = optimal.Receding(problem(GOALS[0])), ARM.start(HOME), list[float](), list[Tensor]()
    sent = [torch.zeros_like(HOME)] * (MEASURED + COMMANDED)  # torques that the measurement does not show yet
    for goal in GOALS:
        mpc.problem, mpc.plan = problem(goal), None  # far from the last goal, so that it is solved again
        for cycle in range(round(seconds / FINE.dt)):
            now = FINE.rollout(FINE.start(*state.measured), torch.stack(sent)).last
            share = cycle % INSIDE / INSIDE
            if share == 0:
                begun = time.perf_counter()
                torque, gain = mpc(now)
                times.append(time.perf_counter() - begun)
            plan = mpc.plan.states
            q, qd = (x[0] + share * (x[1] - x[0]) for x in (plan.q, plan.qd))
            change = gain @ torch.cat([now.q - q, now.qd - qd]) if gains else 0.0
            sent = [*sent[1:], (torque + change).clamp(-LIMITS, LIMITS)]
            state = ARM.step(state, sent[-1])
            found.append((dq.translation(torchdq.forward_kinematics(ROBOT, state.q, "tool")) - goal).norm())
    return Found(torch.stack(found), sorted(times)[len(times) // 2])


def main(args: Args) -> dict[str, Found]:
    """Control the arm in both ways, print and draw."""
    found = {name: controlled(args.seconds, gains) for name, gains in {"gains": True, "torques held": False}.items()}
    for name, (distance, tick) in found.items():
        last = [1e3 * float(x[-100:].mean()) for x in distance.chunk(len(GOALS))]
        print(f"{name}: {last[0]:.1f} mm and {last[1]:.1f} mm from the goals; a plan takes {1e3 * tick:.2f} ms")
    args.out.mkdir(parents=True, exist_ok=True)
    prepare()
    figure, panel = plt.subplots(figsize=(9, 3.6), layout="constrained")
    for (name, (distance, _)), colour in zip(found.items(), (BLUE, GREY), strict=True):
        panel.semilogy(FINE.dt * torch.arange(len(distance)), distance, color=colour, label=name)
    panel.set(xlabel="time [s]", title="distance of the tool from its goal [m]")
    panel.legend()
    save(figure, args.out / "receding.png")
    return found


if __name__ == "__main__":
    main(tyro.cli(Args))
