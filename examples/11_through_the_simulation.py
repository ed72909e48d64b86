"""A policy that reaches points in space, trained by gradients through the simulation, on one device or on several.

    python examples/11_through_the_simulation.py [--device cuda]
    torchrun --nproc-per-node 4 examples/11_through_the_simulation.py --device cuda

Panda arms with friction and gravity start at rest, each with a goal of its own, and a network learns from scratch to
move their tips there within a second. Its gradient is that of the whole simulated second. What it has learned is
measured on new starts and goals. Starts lie about one posture, and goals in a box about its tip: `--spread`, `--box`.

Every process simulates its share of the arms, and gradients are summed over all processes, so that the policy is that
of a single process up to rounding. `out/through_the_simulation.png` shows the result.
"""

import sys
import time
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from devices import OnDevice
from matplotlib import pyplot as plt
from pictures import BLUE, ORANGE, prepare, save
from processes import Team, team
from torch import Tensor, nn

import torchdq
from torchdq import Scene, dq, effects
from torchdq.scene import State

ROBOT = torchdq.robots.load("panda")
HOME = (0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.8)  # posture in the middle of the starts [rad]
STEP = 0.02  # [s]
CLOSE = 0.05  # distance from a goal that counts as reached [m]
NEW, EVERY = 1000, 20  # arms that are not learned from, and optimiser steps between looks at them


@dataclass
class Args(OnDevice):
    arms: int = 128
    """Number of arms, over all processes."""
    steps: int = 50
    """Steps of the simulation."""
    iterations: int = 300
    """Optimiser steps."""
    rate: float = 3e-3
    """First learning rate; it falls to zero along half a cosine."""
    spread: float = 0.2
    """Largest distance of a joint's start from the posture in the middle [rad]."""
    box: float = 0.4
    """Edge of the box of goals about the tip of that posture [m]."""
    out: Path = Path("out")
    """Folder of the picture."""


class Task(NamedTuple):
    """Starts of arms, and the goals of their tips."""

    start: Tensor  # [arms, 7] [rad]
    goal: Tensor  # [arms, 3] [m]


def tips(q: Tensor) -> Tensor:
    """Positions of the tip [..., 3] [m]."""
    return dq.translation(torchdq.forward_kinematics(ROBOT, q, ROBOT.tip))


def drawn(arms: int, args: Args) -> Task:
    """Random starts and goals."""
    home = torch.tensor(HOME)
    start = home + args.spread * (2 * torch.rand(arms, 7) - 1)
    goal = tips(home) + args.box * (torch.rand(arms, 3) - 0.5)
    return Task(start.to(args.place), goal.to(args.place))


class Policy(nn.Module):
    """Torques from a state and a goal: those that hold the arm against gravity, and up to half of the limits more."""

    def __init__(self) -> None:
        super().__init__()
        wide = (nn.Linear(17, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, 7), nn.Tanh())
        self.layers = nn.Sequential(*wide)
        self.register_buffer("largest", 0.5 * ROBOT.limits.effort.float())

    def forward(self, state: State, goal: Tensor) -> Tensor:
        """Torques [..., 7] [N m]."""
        seen = torch.cat([state.q, 0.3 * state.qd, 4 * (goal - tips(state.q))], -1)
        return torchdq.inverse_dynamics(ROBOT, state.q) + self.largest * self.layers(seen)


def rolled_out(policy: Policy, task: Task, steps: int) -> State:
    """States [steps, arms, ...] of arms under the policy."""
    scene = Scene(ROBOT, (effects.Gravity(), effects.Viscous(1.0), effects.RotorInertia(0.1)), dt=STEP)
    start = scene.start(task.start)
    return scene.rollout(start, steps=steps, policy=lambda s, k: policy(s, task.goal), nonfinite="ignore")


def loss(policy: Policy, task: Task, args: Args, share: Team) -> Tensor:
    """Part of this process in the mean distance from the goals, with a small penalty on speed, over arms and time."""
    own = Task(*map(share.share, task))
    states = rolled_out(policy, own, args.steps)
    off = (tips(states.q) - own.goal).norm(dim=-1) + 1e-3 * states.qd.square().sum(-1)
    return off.mean(0).sum() / len(task.goal)


def gradients(policy: Policy, task: Task, args: Args, share: Team) -> tuple[Tensor, list[Tensor]]:
    """Loss and its gradients, of all processes."""
    own = loss(policy, task, args, share)
    found = torch.autograd.grad(own, list(policy.parameters()))
    total, *found = share.summed([own.detach(), *found])
    return total, found


@torch.no_grad()
def distances(policy: Policy, task: Task, args: Args) -> Tensor:
    """Distances of the tips from their goals at the end [arms] [m]."""
    return (tips(rolled_out(policy, task, args.steps).last.q) - task.goal).norm(dim=-1)


def reached(off: Tensor) -> str:
    """Distances at the end, in words."""
    share = float((off < CLOSE).float().mean())
    return f"median {1e3 * float(off.median()):.1f} mm, largest {1e3 * float(off.max()):.1f} mm, {share:.1%} below 5 cm"


def main(args: Args) -> list[float]:
    """Median distances of new arms from their goals, before learning and every few optimiser steps [m]."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with team(args.place) as share:
        torch.manual_seed(0)  # the same network and the same arms in every process
        policy, new = Policy().to(args.place), drawn(NEW, args)
        before, medians, spent = deepcopy(policy), [], 0.0
        optimiser = torch.optim.Adam(policy.parameters(), args.rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, args.iterations)
        for k in range(args.iterations + 1):
            if share.leads and (k % EVERY == 0 or k == args.iterations):
                off = distances(policy, new, args)
                medians.append(float(off.median()))
                print(f"{k} optimiser steps, {spent:.1f} s of a processor: {reached(off)}", flush=True)
            if k == args.iterations:
                break
            begin = time.process_time()
            _, found = gradients(policy, drawn(args.arms, args), args, share)
            for parameter, gradient in zip(policy.parameters(), found, strict=True):
                parameter.grad = gradient
            optimiser.step()
            schedule.step()
            spent += time.process_time() - begin
        if share.leads:
            print(f"{share.size} processes on {args.device}, {NEW} new arms")
            draw(medians, [before, policy], Task(*(x[:20] for x in new)), args)
    torch.set_num_threads(threads)
    return medians


def draw(medians: list[float], policies: list[Policy], task: Task, args: Args) -> None:
    """Learning, and the ways of some new arms before and after it."""
    prepare()
    figure, (learning, ways, time) = plt.subplots(1, 3, figsize=(9, 3.6), layout="constrained")
    done = [min(EVERY * k, args.iterations) for k in range(len(medians))]
    learning.semilogy(done, [1e3 * x for x in medians], color=BLUE)
    learning.set(xlabel="optimiser step", ylabel="distance from the goal [mm]", title="Median at the end")
    for policy, colour, name in zip(policies, (ORANGE, BLUE), ("before", "after"), strict=True):
        with torch.no_grad():
            p = tips(torch.cat([task.start[None], rolled_out(policy, task, args.steps).q]))
        off = 1e3 * (p - task.goal).norm(dim=-1).cpu()
        time.semilogy(STEP * torch.arange(args.steps + 1), off, color=colour, linewidth=0.8)
        time.plot([], color=colour, label=f"{name} learning")
    ways.plot(*p[..., 1:].cpu().unbind(-1), color=BLUE, linewidth=0.8)
    ways.plot(*task.goal[:, 1:].cpu().unbind(-1), "o", color=ORANGE, markersize=4)
    ways.set(xlabel="y [m]", ylabel="z [m]", title="Twenty new arms", aspect="equal")
    time.set(xlabel="time [s]", ylabel="distance from the goal [mm]", title="The same arms", ylim=(None, 1e4))
    time.legend(loc="upper right")  # above the curves
    save(figure, args.out / "through_the_simulation.png")


if __name__ == "__main__":
    medians = main(tyro.cli(Args))
    sys.exit(0 if medians[-1] < 0.2 * medians[0] else 1)
