"""Logs of a simulated arm that differs from its description, with noise and uneven stamps; for examples 17 and 18."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import torchdq

SLOWEST, HARMONICS = 0.1, 5  # [Hz] and number of the sinusoids that every joint follows
WIDTH = 1e-3  # [rad/s] over which dry friction changes its sign


class Arm(NamedTuple):
    """An arm as it is, of which the description knows the kinematics and roughly the masses."""

    robot: torchdq.Robot
    viscous: Tensor  # [n] [N m s/rad]
    coulomb: Tensor  # [n] [N m]

    def torques(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Torques at the joints [..., n] [N m]."""
        friction = self.viscous * qd + self.coulomb * qd / torch.hypot(qd, torch.full_like(qd, WIDTH))
        return torchdq.inverse_dynamics(self.robot, q, qd, qdd) + friction


class Recorded(NamedTuple):
    """Readings of a log, row by row."""

    time: np.ndarray  # [rows] [s]
    q: np.ndarray  # [rows, n] [rad]
    qd: np.ndarray  # [rows, n] [rad/s]
    tau: np.ndarray  # [rows, n] [N m]


def real_arm(described: torchdq.Robot, seed: int, rotors: bool = False) -> Arm:
    """Arm with masses off by up to 30 %, centres of mass by a centimetre, friction, and if asked for, rotors."""
    random = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(described.n, generator=random, dtype=torch.float64)

    factor = uniform(0.7, 1.3)
    off = 0.01 * torch.randn(described.com.shape, generator=random, dtype=torch.float64)
    robot = described.replace(
        mass=factor * described.mass, com=described.com + off, inertia=factor[:, None] * described.inertia
    )
    if rotors:
        inertia = torchdq.mass_matrix(described, torch.zeros_like(factor)).diagonal()
        robot = robot.replace(armature=inertia.clamp(min=0.02 * float(inertia.max())) * uniform(0.1, 0.3))
    size = torchdq.inverse_dynamics(described, *torch.randn(3, 200, described.n, generator=random).double()).std(0)
    size = size.clamp(min=0.02 * float(size.max()))
    return Arm(robot.bake(), 0.05 * size * uniform(0.5, 1.5), 0.15 * size * uniform(0.5, 1.5))


def recorded(arm: Arm, seconds: float, rate: float, seed: int) -> Recorded:
    """Readings along sums of sinusoids within the limits, at stamps that are uneven by a third."""
    random, limits, n = np.random.default_rng(seed), arm.robot.limits, arm.robot.n
    stamps = np.cumsum(random.uniform(2 / 3, 4 / 3, round(seconds * rate))) / rate
    time = torch.from_numpy(stamps)
    w = 2 * torch.pi * SLOWEST * torch.arange(1, HARMONICS + 1).double()
    size, phase = (torch.from_numpy(random.uniform(0, x, (n, HARMONICS))) for x in (1.0, 2 * np.pi))
    angle = w * time[:, None, None] + phase
    q, qd, qdd = ((size * x).sum(-1) for x in (angle.sin(), w * angle.cos(), -w.square() * angle.sin()))
    middle, reach = (limits.upper + limits.lower) / 2, (limits.upper - limits.lower) / 2
    fit = torch.minimum(0.8 * reach.clamp(max=2.0) / q.abs().amax(0), 0.7 * limits.velocity / qd.abs().amax(0))
    q, qd, qdd = middle + fit * q, fit * qd, fit * qdd
    tau = arm.torques(q, qd, qdd)
    noises = (1e-5, 5e-3, 0.02 * tau.std(0).numpy())  # encoders, their differences, torque sensors
    return Recorded(
        stamps, *(x.numpy() + e * random.normal(size=x.shape) for x, e in zip((q, qd, tau), noises, strict=True))
    )


def write(path: Path, time: np.ndarray, columns: dict[str, np.ndarray]) -> Path:
    """CSV file with a column `stamp`, and for every joint, counted from 0, one of each name."""
    heads = ["stamp", *(f"{name}_{joint}" for name, x in columns.items() for joint in range(x.shape[1]))]
    rows = np.column_stack([time, *columns.values()])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows, delimiter=",", fmt="%.7f", header=",".join(heads), comments="")
    return path
