"""A policy trained by gradients through the simulation, on one device or on several.

    python examples/11_through_the_simulation.py [--device cuda]
    torchrun --nproc-per-node 4 examples/11_through_the_simulation.py --device cuda

Arms with friction and gravity start at rest in random postures, and a network learns from scratch to move them to a
desired one within a second. Its gradient is that of the whole simulated second. Every process simulates its share of
the arms, and gradients are summed over all processes, so that the policy is that of a single process up to rounding.
`out/through_the_simulation.png` shows the result.
"""

import sys
import time
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from devices import OnDevice
from matplotlib import pyplot as plt
from pictures import BLUE, ORANGE, prepare, save
from processes import Team, team
from torch import Tensor, nn

import torchdq
from torchdq.envs import Scene, State, effects

ROBOT = torchdq.robots.load("panda")
WANTED = (0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.8)  # [rad]
SPREAD = 0.4  # spread of the starts about it [rad]
STEP = 0.02  # [s]


@dataclass
class Args(OnDevice):
    arms: int = 256
    """Number of arms, over all processes."""
    steps: int = 50
    """Steps of the simulation."""
    iterations: int = 150
    """Optimiser steps."""
    rate: float = 5e-3
    """First learning rate; it falls to zero along half a cosine."""
    out: Path = Path("out")
    """Folder of the picture."""


class Policy(nn.Module):
    """Torques from a state, as fractions of the limits."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(14, 64), nn.Tanh(), nn.Linear(64, 7))
        self.register_buffer("wanted", torch.tensor(WANTED))
        self.register_buffer("largest", ROBOT.limits.effort.float())

    def forward(self, state: State) -> Tensor:
        """Torques [..., 7] [N m]."""
        return self.largest * self.layers(torch.cat([state.q - self.wanted, 0.2 * state.qd], -1)).tanh()


def rolled_out(policy: Policy, q: Tensor, steps: int) -> State:
    """States [steps, arms, ...] of arms under the policy."""
    scene = Scene(ROBOT, (effects.Gravity(), effects.Viscous(2.0), effects.RotorInertia(0.1)), dt=STEP)
    return scene.rollout(scene.start(q), steps=steps, policy=policy, nonfinite="ignore")


def starts(arms: int) -> Tensor:
    """Random postures [arms, 7] about the wanted one [rad]."""
    return torch.tensor(WANTED) + SPREAD * (2 * torch.rand(arms, 7) - 1)


def loss(policy: Policy, q: Tensor, args: Args, share: Team) -> Tensor:
    """Part of this process in the mean squared distance from the wanted posture and from rest, over arms and time."""
    states = rolled_out(policy, share.share(q), args.steps)
    off = (states.q - policy.wanted).square().sum(-1) + 0.01 * states.qd.square().sum(-1)
    return off.mean(0).sum() / len(q)


def gradients(policy: Policy, q: Tensor, args: Args, share: Team) -> tuple[Tensor, list[Tensor]]:
    """Loss and its gradients, of all processes."""
    own = loss(policy, q, args, share)
    found = torch.autograd.grad(own, list(policy.parameters()))
    total, *found = share.summed([own.detach(), *found])
    return total, found


def main(args: Args) -> list[float]:
    """Losses of all iterations."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with team(args.place) as share:
        torch.manual_seed(0)  # the same network and the same arms in every process
        policy = Policy().to(args.place)
        before = deepcopy(policy)
        optimiser = torch.optim.Adam(policy.parameters(), args.rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, args.iterations)
        losses, start = [], time.perf_counter()
        for k in range(args.iterations):
            total, found = gradients(policy, starts(args.arms).to(args.place), args, share)
            for parameter, gradient in zip(policy.parameters(), found, strict=True):
                parameter.grad = gradient
            optimiser.step()
            schedule.step()
            losses.append(total)
            if share.leads and (k % 25 == 0 or k == args.iterations - 1):
                print(f"iteration {k}: loss {float(total):.4f}", flush=True)
        if share.leads:
            rate = args.arms * args.steps * args.iterations / (time.perf_counter() - start)
            print(f"{share.size} processes on {args.device}: {rate:.3g} steps of an arm per second, gradients included")
            draw(torch.stack(losses).tolist(), [before, policy], args)
    torch.set_num_threads(threads)
    return torch.stack(losses).tolist()


def draw(losses: list[float], policies: list[Policy], args: Args) -> None:
    """Losses, and how far arms that were not learned from are from the wanted posture, before and after."""
    prepare()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    left.semilogy(losses, color=BLUE)
    left.set(xlabel="optimiser step", ylabel="mean square of the distance", title="Learning")
    time, q = STEP * torch.arange(args.steps + 1), starts(20).to(args.place)
    for policy, colour, name in zip(policies, (ORANGE, BLUE), ("before", "after"), strict=True):
        with torch.no_grad():
            moved = torch.cat([q[None], rolled_out(policy, q, args.steps).q])
        distance = (moved - policy.wanted).norm(dim=-1).cpu()
        right.plot(time, distance, color=colour, linewidth=0.8)
        right.plot([], color=colour, label=f"{name} learning")
    right.set(xlabel="time [s]", ylabel="off the wanted posture [rad]", title="Twenty new arms", yscale="log")
    right.legend()
    save(figure, args.out / "through_the_simulation.png")


if __name__ == "__main__":
    losses = main(tyro.cli(Args))
    sys.exit(0 if losses[-1] < 0.2 * losses[0] else 1)
