"""Rollouts as one call, beside steps from Python: values, gradients, linearizations, environments, sampling.

    python benchmarks/rollouts.py [--quick] [--json FILE] [--page]

Steps from Python are calls of `Scene.step` one after the other, as of any function of torch; Jacobian matrices are made
of a gradient per number of the state. A Panda with gravity and friction, 100 steps, float64, one thread. Both take
turns, and the least processor time counts, since others only add to it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from sys import path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import report
import torch
from torch import Tensor, nn

import torchdq
from torchdq import Scene, effects
from torchdq.envs import RobotVectorEnv
from torchdq.scene import State, policies

SCENE = Scene(torchdq.robots.load("panda"), (effects.Gravity(), effects.Viscous(0.1)), dt=0.002)
N, F64 = 7, torch.float64
STEPS = 100


class Row(NamedTuple):
    """Times of a task [s]: as one call, and by steps from Python."""

    task: str
    ours: float
    theirs: float


def least(runs: list[Callable[[], object]], seconds: float) -> list[float]:
    """Least processor time of each of some functions, which take turns [s]."""
    return [1e-9 * x for x in report.least({str(k): (run, 1) for k, run in enumerate(runs)}, 3, seconds).values()]


def stepped(state: State, torque: Callable[[State, int], Tensor], steps: int) -> State:
    """States of steps one after the other."""
    found = []
    for k in range(steps):
        state = SCENE.step(state, torque(state, k))
        found.append(state)
    return State(*[None if x[0] is None else torch.stack(x) for x in zip(*found, strict=True)])


def start(arms: int) -> State:
    """Arms at rest, each at other angles."""
    generator = torch.Generator().manual_seed(0)
    return SCENE.start(
        torch.rand(arms, N, generator=generator, dtype=F64) - torch.tensor([0.5, 0.5, 0.5, 2.5, 0.5, 0, 0])
    )


def gradient(states: State, wrt: Any) -> object:
    """Gradient of all positions."""
    return torch.autograd.grad(states.q.square().sum(), wrt)


def rollouts(arms: int, seconds: float) -> list[Row]:
    """Values and gradients of a rollout of some arms."""
    state, torque = start(arms), torch.randn(STEPS, arms, N, dtype=F64)
    given = torque.clone().requires_grad_()
    values = least(
        [lambda: SCENE.rollout(state, torque), lambda: stepped(state, lambda s, k: torque[k], STEPS)], seconds
    )
    gradients = least(
        [
            lambda: gradient(SCENE.rollout(state, given), given),
            lambda: gradient(stepped(state, lambda s, k: given[k], STEPS), given),
        ],
        seconds,
    )
    named = "1 arm" if arms == 1 else f"{arms} arms"
    return [
        Row(f"{STEPS} steps of {named}", *values),
        Row(f"gradient of {STEPS} steps of {named} in the torques", *gradients),
    ]


def weights(seconds: float) -> Row:
    """Gradient in the weights of a network."""
    network = nn.Sequential(nn.Linear(14, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 7)).double()
    policy, state, wrt = policies.Network(network), start(256), list(network.parameters())

    def torque(state: State, k: int) -> Tensor:
        return network(torch.cat([state.q, state.qd], -1))

    count = sum(x.numel() for x in wrt)
    found = least(
        [
            lambda: gradient(SCENE.rollout(state, policy=policy, steps=25), wrt),
            lambda: gradient(stepped(state, torque, 25), wrt),
        ],
        seconds,
    )
    return Row(f"gradient of 25 steps of 256 arms in the {count} weights of a network", *found)


def linearizations(states: int, seconds: float) -> Row:
    """Jacobian matrices of a step at some states."""
    state, torque = start(states), torch.zeros(states, N, dtype=F64)

    def by_gradients() -> object:
        given = [x.detach().requires_grad_() for x in (state.q, state.qd, torque)]
        after = SCENE.step(State(*given[:2]), given[2])
        numbers = torch.cat([after.q, after.qd], -1)
        return [torch.autograd.grad(numbers[:, i].sum(), given, retain_graph=True) for i in range(2 * N)]

    found = least([lambda: SCENE.linearize(state, torque), by_gradients], seconds)
    return Row(f"Jacobian matrices of a step at {'1 state' if states == 1 else f'{states} states'}", *found)


def environments(robots: int, seconds: float) -> Row:
    """Rollout of environments under a policy, resets included."""
    envs = RobotVectorEnv(robots, "reach", "panda")
    observation, _ = envs.reset(seed=0)
    policy = nn.Sequential(nn.Linear(observation.shape[1], 64), nn.ELU(), nn.Linear(64, N))

    @torch.no_grad()
    def stepped() -> None:
        found = envs.get_state()["observation"]
        for _ in range(25):
            found = envs.step(policy(found))[0]

    found = least([lambda: envs.rollout(policy, 25), stepped], seconds)
    return Row(f"25 steps of {robots} environments of Reach under a network, float32", *found)


def sampling(seconds: float) -> float:
    """Time of a tick of control by 4096 rollouts of 30 steps in float32 [s], of the example."""
    path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
    example = import_module("27_mppi")
    return min(example.main(example.Args(ticks=20)).tick for _ in range(3 + int(seconds)))


def time_of(seconds: float) -> str:
    """Time, to three digits."""
    return f"{1e3 * seconds:.3g} ms"


def main() -> None:
    """All measurements, as a table."""
    parser = report.parser(__doc__, "shorter measurements")
    arguments = parser.parse_args()
    seconds = 1.0 if arguments.quick else 6.0
    rows = [row for arms in (1, 64, 1024) for row in rollouts(arms, seconds)]
    rows += [weights(seconds), *(linearizations(count, seconds) for count in (1, 50, 3200))]
    rows += [environments(robots, seconds) for robots in (64, 1024, 8192)]
    lines = [f"| {r.task} | {time_of(r.ours)} | {time_of(r.theirs)} | {r.theirs / r.ours:.3g} x |" for r in rows]
    tick = sampling(seconds)
    lines.append(f"| tick of sampled control, 4096 times 30 steps, float32 | {time_of(tick)} | | |")
    text = "\n".join(["| task | one call | steps from Python | ratio |", "|---|---|---|---|", *lines])
    print(text)
    report.finish(arguments, __file__, text, report.machine(), rows=rows, tick=[tick])


if __name__ == "__main__":
    main()
