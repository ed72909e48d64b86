"""Faults in simulated logs, and what `identify` says about them.

Pinocchio computes the torques of arms whose masses are 10 % larger and whose centres of mass are 1 cm off along every
axis. Logs of 40 s have a fault each. "Error" is the RMSE over the standard deviation of the torque, mean over joints,
of the identified robot on a log of another motion with the same fault.
"""

from __future__ import annotations

import math
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "tools"))

import numpy as np
import pinocchio as pin
import report
import torch

import torchdq
from torchdq import Robot, effects
from torchdq.learning import LogWarning, Model, Samples, identify

SECONDS, RATE = 40.0, 50.0
NOISE, FRICTION = 0.003, 0.1  # relative to the standard deviation of the torque
PLAIN = Model(friction=(effects.Viscous(), effects.Coulomb()))


class Told(NamedTuple):
    """What was said about a fault."""

    fault: str
    arm: str
    error: float
    findings: tuple[str, ...]


def motion(robot: Robot, seed: int) -> list[np.ndarray]:
    """Sums of sines within the limits: q, qd and qdd [rows, n]."""
    g, t = np.random.default_rng(seed), np.arange(0, SECONDS, 1 / RATE)[:, None, None]
    w = 2 * np.pi * 0.1 * np.arange(1, 6)
    size, angle = g.uniform(size=(robot.n, 5)) / w, w * t + 6.3 * g.uniform(size=(robot.n, 5))
    q, qd, qdd = (
        (size * np.sin(angle)).sum(-1),
        (size * w * np.cos(angle)).sum(-1),
        -(size * w**2 * np.sin(angle)).sum(-1),
    )
    lower, upper = (x.numpy().clip(-2.5, 2.5) for x in robot.limits[:2])
    scale = np.minimum(0.9 * (upper - lower) / np.ptp(q, axis=0), 2 / abs(qd).max(0))
    return [(lower + upper) / 2 + scale * (q - (q.max(0) + q.min(0)) / 2), scale * qd, scale * qdd]


def measured(
    robot: Robot, moved: Sequence[np.ndarray], seed: int, payload: float = 0.0, tilt: float = 0.0
) -> np.ndarray:
    """Torques [rows, n] of the real arm, with friction and noise."""
    model = import_module("oracles").pinocchio_model(robot)  # of the tests
    for body in list(model.inertias)[1:]:
        body.mass *= 1.1
        body.inertia *= 1.1
        body.lever += 0.01
    model.inertias[robot.n] += pin.Inertia(payload, np.array([0.0, 0.0, 0.05]), np.zeros((3, 3)))
    a = math.radians(tilt)
    model.gravity.linear = 9.81 * np.array([0.6 * math.sin(a), 0.8 * math.sin(a), -math.cos(a)])
    data = model.createData()
    tau, usual = (
        np.array([pin.rnea(model, data, *row) for row in zip(*rows, strict=True)]) for rows in (moved, motion(robot, 0))
    )
    size, qd = usual.std(0).clip(0.02 * usual.std(0).max()), moved[1]
    tau += FRICTION * size * (qd + qd / np.sqrt(qd**2 + 1e-4))
    return tau + NOISE * size * np.random.default_rng(seed).normal(size=tau.shape)


def zero(j: int, offset: float) -> Callable[[Robot, int], Samples]:
    """Logs whose positions of one joint are off."""

    def log(robot: Robot, seed: int) -> Samples:
        moved = motion(robot, seed)
        return samples(moved[0] + offset * np.eye(robot.n)[j], *moved[1:], measured(robot, moved, seed))

    return log


def scaled(factors: dict[int, float]) -> Callable[[Robot, int], Samples]:
    """Logs whose torques of some joints are off by factors."""

    def log(robot: Robot, seed: int) -> Samples:
        moved = motion(robot, seed)
        factor = np.array([factors.get(j, factors.get(-1, 1.0)) for j in range(robot.n)])
        return samples(*moved, factor * measured(robot, moved, seed))

    return log


def other(payload: float = 0.0, tilt: float = 0.0) -> Callable[[Robot, int], Samples]:
    """Logs of an arm with a payload [kg], or a tilted base [degrees]."""

    def log(robot: Robot, seed: int) -> Samples:
        moved = motion(robot, seed)
        return samples(*moved, measured(robot, moved, seed, payload, tilt))

    return log


def exchanged(robot: Robot, seed: int) -> Samples:
    """Logs whose torque columns 2 and 3 are exchanged."""
    moved = motion(robot, seed)
    return samples(*moved, measured(robot, moved, seed)[:, [0, 2, 1, *range(3, robot.n)]])


def samples(*signals: np.ndarray) -> Samples:
    """Samples of arrays."""
    return Samples(*(torch.from_numpy(x) for x in signals))


FAULTS: dict[str, Callable[[Robot, int], Samples]] = {
    "none": other(),
    "payload 2 kg": other(payload=2.0),
    "joint 2 zero 0.3 rad off": zero(1, 0.3),
    "joint 2 zero 0.1 rad off": zero(1, 0.1),
    "joint 4 zero 0.3 rad off": zero(3, 0.3),
    "joint 4 zero 0.03 rad off": zero(3, 0.03),
    "joint 1 zero 0.3 rad off": zero(0, 0.3),
    "last joint zero 0.3 rad off": zero(-1, 0.3),
    "torques of joint 3 14 % too large": scaled({2: 1 / 0.88}),
    "torques of all joints 14 % too large": scaled({-1: 1 / 0.88}),
    "sign of joint 3": scaled({2: -1.0}),
    "torque columns 2 and 3 exchanged": exchanged,
    "base tilted by 10 degrees": other(tilt=10.0),
    "base tilted by 2 degrees": other(tilt=2.0),
}


def told(name: str, arm: str) -> Told:
    """What is said about a fault of an arm."""
    robot = torchdq.robots.load(arm).replace(on_unphysical="repair")
    train, test = (FAULTS[name](robot, seed) for seed in (0, 1))
    found = identify(robot, train, PLAIN, prior=1.0)
    left = found.predict(*test[:3]).tau - test.tau
    said = [f"{one.code} {one.subject}".strip() + (f" {one.value:.3g}" if one.value else "") for one in found.findings]
    return Told(name, arm, float((left.std(0) / test.tau.std(0)).mean()), tuple(said))


def page(found: Sequence[Told]) -> str:
    """Table for the documentation."""
    rows = [f"| {one.fault} | {one.arm} | {one.error:.3f} | {', '.join(one.findings) or 'nothing'} |" for one in found]
    return "\n".join(["| fault | arm | error | findings |", "|---|---|---|---|", *rows])


def main() -> None:
    """Table of all faults."""
    arguments = report.parser(__doc__, "one arm").parse_args()
    warnings.simplefilter("ignore", LogWarning)
    found = []
    for arm in ("panda", "ur10e")[: 1 if arguments.quick else 2]:
        for name in FAULTS:
            found.append(told(name, arm))
            print(*found[-1], sep="  ", flush=True)
    report.finish(arguments, __file__, page(found), report.machine("pin"), faults=[one._asdict() for one in found])


if __name__ == "__main__":
    main()
