"""Speed of the registered environments, and their pages.

    python benchmarks/environments.py [--quick] [--measure [NAME ...]] [--write]

`--measure` stores steps per second in benchmarks/results/environments.json, with the machine; those of named
environments are scaled by the rates of Reach, as if on the machine of the others. `--write` writes docs/environments
from these and from the environments themselves. A new environment needs an entry in `pages/environment_cases.py`.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium
import numpy as np
import report
import torch
from pages import environment_index, environment_page
from pages.command import command
from pages.environment_cases import ENVIRONMENTS

from torchdq.envs import RobotVectorEnv

FOLDER = environment_page.ROOT / "docs" / "environments"
BATCHES = (1, 64, 4096)
SCALE = "reach"  # environment whose rates others are in proportion to


def fastest(step: Callable[[], object], seconds: float) -> float:
    """Seconds of a call, the fastest twentieth of many: others were disturbed by whatever else the machine does."""
    times, end = [], time.perf_counter() + seconds
    while time.perf_counter() < end or len(times) < 40:
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
    return statistics.quantiles(times[10:], n=20)[0]


def single(id: str) -> Callable[[], object]:
    """A step of one environment of `gymnasium.make`, without its check of every step, begun anew where it ends."""
    env = gymnasium.make(id, disable_env_checker=True)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)

    def step() -> None:
        if env.step(action)[3]:
            env.reset()

    return step


def batched(task: str, batch: int) -> Callable[[], object]:
    """A step of many, each at another time of its episode."""
    envs = RobotVectorEnv(batch, task, environment_page.robot_of(task))
    envs.reset(seed=0)
    state = envs.get_state()
    ages = torch.randint(250, state["steps"].shape, generator=torch.Generator().manual_seed(0))
    envs.set_state({**state, "steps": ages.to(envs.dtype)})
    action = torch.zeros(batch, envs.robot.n)
    return lambda: envs.step(action)


def measured(seconds: float, tasks: Sequence[str]) -> dict[str, list[tuple[str, int, float]]]:
    """Steps per second of environments: how each is made, how many there are, and the rate."""
    found = {}
    for task in tasks:
        id = environment_page.newest(task).id
        rows = [("`gymnasium.make`, numpy", 1, 1 / fastest(single(id), seconds))]
        rows += [("`RobotVectorEnv`, torch", k, k / fastest(batched(task, k), seconds)) for k in BATCHES]
        for what, batch, rate in rows:
            print(f"{task:8s} {what:26s} {batch:6d} {rate:12.0f} per second", flush=True)
        found[task] = rows
    return found


def pages() -> dict[str, str]:
    """Files of docs/environments that are text."""
    return {"index.md": environment_index.index()} | {
        f"{task}.md": environment_page.page(task) for task in ENVIRONMENTS
    }


def pictures() -> dict[str, bytes]:
    """Files of docs/environments that are pictures."""
    return {f"{task}.png": environment_page.picture(task) for task in ENVIRONMENTS} | {
        f"{task}_learning.svg": environment_page.learning_picture(task).encode()
        for task in ENVIRONMENTS
        if environment_page.learned(task)
    }


def store(quick: bool, names: Sequence[str]) -> None:
    """Measure rates of named environments, or of all, and store them with the machine."""
    seconds = 0.5 if quick else 4.0
    if not names:
        rates = measured(seconds, list(ENVIRONMENTS))
        report.into_json(environment_page.RATES, machine=report.machine("gymnasium"), rates=rates)
        return
    stored, found = environment_page.rates(), measured(seconds, [SCALE, *names])
    for name in names:
        rows = zip(found[name], found[SCALE], stored["rates"][SCALE], strict=True)
        stored["rates"][name] = [(*what, rate * kept / now) for (*what, rate), (*_, now), (*_, kept) in rows]
    report.into_json(environment_page.RATES, **stored)


def main() -> None:
    """Rates of all environments measured, or their pages written, as the arguments say."""
    command(
        __doc__,
        "shorter measurements",
        store,
        ENVIRONMENTS,
        environment_page.RATES,
        FOLDER,
        files=lambda: pages() | pictures(),
    )


if __name__ == "__main__":
    main()
