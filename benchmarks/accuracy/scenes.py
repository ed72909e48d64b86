"""Scenes of the study: robots with effects, initial states, torques and horizons.

Initial states and torques are numbers that single precision holds, and horizons are sums of powers of two, so that no
method is charged for the rounding of what it was given. Torques are held over a few periods, as controllers hold them:
within a period the motion is smooth, and a step that divides a period keeps its order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchdq
from torchdq import Scene, effects
from torchdq.effects import Effect

PERIODS = 4  # over which the torque is held
Forces = Callable[[Any, Any], Any]


def no_forces(q: Any, qd: Any) -> Any:
    """No torques at the joints."""
    return 0.0 * q


@dataclass(frozen=True, eq=False)
class Case:
    """A scene with everything that a trajectory takes."""

    name: str
    words: str
    robot: torchdq.Robot
    effects: tuple[Effect, ...]
    q: Tensor  # [batch, n], float64 that float32 holds, as the others
    qd: Tensor
    torque: Tensor  # [PERIODS, batch, n]
    horizon: float  # [s]
    # torques of the joint effects, written a second time on numpy arrays, for references that know nothing of torchdq
    forces: Forces = no_forces
    inputs: Mapping[str, Tensor] = field(default_factory=dict)  # what effects ask for, [n]
    limit: float = 0.1  # errors above it say only that the motion was lost
    smooth: bool = True  # False: torques with kinks, at which every method loses its order
    suited: tuple[str, ...] = ("ExplicitEuler", "SemiImplicitEuler", "LinearlyImplicit", "StoermerVerlet")

    @property
    def scene(self) -> Scene:
        """The robot and its effects; integrator and step are the methods' business."""
        return Scene(self.robot, self.effects)

    @property
    def gravity(self) -> tuple[float, float, float] | None:
        """Acceleration in the base frame, or None."""
        found = [effect.acceleration for effect in self.scene.effects if isinstance(effect, effects.Gravity)]
        return found[0] if found else None


def single(x: Tensor) -> Tensor:
    """The nearest numbers that float32 holds, as float64."""
    return x.float().double()


def _random(seed: int, *shape: int) -> Tensor:
    """Uniform numbers in [-1, 1]."""
    generator = torch.Generator().manual_seed(seed)
    return single(2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1)


def _waves(seed: int, batch: int, size: Tensor) -> Tensor:
    """A smooth torque, sampled at the start of every period, shape [PERIODS, batch, n]."""
    t = torch.arange(PERIODS, dtype=torch.float64)[:, None, None] / PERIODS
    phase = math.pi * _random(seed, batch, len(size))
    return single(size * torch.sin(2 * math.pi * t + phase))


@cache
def pendulum() -> Case:
    """A rod let go at rest; its motion is known in closed form."""
    robot = torchdq.Robot.from_screws(
        [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]],
        [1.0],
        [[0.0, -0.5, 0.0]],
        [np.diag([0.02, 0.02, 0.02])],
        gravity=[0.0, -9.81, 0.0],
        name="pendulum",
    )
    q = single(torch.linspace(0.5, 2.5, 8, dtype=torch.float64))[:, None]
    still = torch.zeros_like(q)
    torque = torch.zeros(PERIODS, 8, 1, dtype=torch.float64)
    return Case("pendulum", "pendulum, 2 s", robot, (effects.Gravity(),), q, still, torque, 2.0)


@cache
def double_pendulum() -> Case:
    """Two links let go where they swing regularly."""
    robot = torchdq.robots.load("two_link")
    hanging = torch.tensor([-math.pi / 2, 0.0], dtype=torch.float64)
    q = single(hanging + 0.7 * _random(1, 8, 2))
    torque = torch.zeros(PERIODS, 8, 2, dtype=torch.float64)
    return Case("double_pendulum", "double pendulum, 1 s", robot, (effects.Gravity(),), q, 0 * q, torque, 1.0)


@cache
def arm7() -> Case:
    """A seven-joint arm that is held against gravity where it starts, and waved about."""
    robot = torchdq.robots.load("panda")
    ready = torch.tensor([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8], dtype=torch.float64)
    q, qd = single(ready + 0.3 * _random(2, 4, 7)), single(0.25 * _random(3, 4, 7))
    inertia = torchdq.mass_matrix(robot, 0 * q[0], backend="eager").diagonal()
    torque, damping = _waves(4, len(q), inertia), (4.0 * inertia).tolist()
    held = torchdq.inverse_dynamics(robot, q, backend="eager")
    return Case(
        "arm7",
        "seven-joint arm, gravity, damping, 1 s",
        robot,
        (effects.Gravity(), effects.Viscous(damping)),
        q,
        qd,
        single(torque + held),
        1.0,
        lambda q, qd: -np.array(damping, q.dtype) * qd,
    )


@cache
def servo() -> Case:
    """Seven-joint arm pulled to a target by servos whose time constants are far below those of the motion."""
    arm = arm7()
    rate = 128.0  # natural frequency of every joint alone [1/s]
    inertia = torchdq.mass_matrix(arm.robot, arm.q.mean(0), backend="eager").diagonal()
    kp, kd = (rate**2 * inertia).tolist(), (2 * rate * inertia).tolist()
    target = single(arm.q.mean(0) + 0.1 * _random(5, 7))

    def forces(q: Any, qd: Any) -> Any:
        return np.array(kp, q.dtype) * (target.numpy().astype(q.dtype) - q) - np.array(kd, q.dtype) * qd

    return Case(
        "servo",
        "the same arm under stiff servos, 1/4 s",
        arm.robot,
        (effects.Gravity(), effects.Servo(kp, kd)),
        arm.q[:2],
        arm.qd[:2],
        arm.torque[:, :2],
        0.25,
        forces,
        {"target": target},
        suited=("ExplicitEuler", "SemiImplicitEuler", "LinearlyImplicit"),
    )


def chain(n: int, seed: int = 0) -> torchdq.Robot:
    """A general chain of n revolute joints."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    axis = torch.nn.functional.normalize(random(n, 3), dim=-1)
    moment = torch.linalg.cross(0.1 * random(n, 3), axis)
    root = random(n, 3, 3)
    second = 0.1 * root @ root.mT + 0.05 * torch.eye(3)
    inertia = second.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * torch.eye(3) - second
    along = torch.arange(1, n + 1, dtype=torch.float64)[:, None] * torch.tensor([0.3, 0.0, 0.0])
    still = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).expand(n, 4)
    return torchdq.Robot.from_screws(
        torch.cat([axis, moment + torch.linalg.cross(along, axis)], -1),
        torch.ones(n),
        0.1 * random(n, 3),
        0.05 * (inertia + inertia.mT),
        link_poses=torchdq.dq.from_pose(still, along),
        name=f"chain{n}",
    )


@cache
def chain42() -> Case:
    """A chain of 42 joints."""
    robot = chain(42)
    q, qd = single(0.3 * _random(6, 2, 42)), single(0.3 * _random(7, 2, 42))
    # torques that hold the initial state, and a little more: light links at the end answer quickly
    held = torchdq.inverse_dynamics(robot, q, qd, backend="eager")
    torque = single(held + _waves(8, 2, torch.full((42,), 0.01, dtype=torch.float64)))
    return Case(
        "chain42",
        "chain of 42 joints, 1/16 s",
        robot,
        (effects.Gravity(),),
        q,
        qd,
        torque,
        0.0625,
        suited=("SemiImplicitEuler",),
    )


@cache
def tumbling() -> Case:
    """A free body that spins near its middle axis, away from the gimbal lock of its three joints."""
    robot = torchdq.Robot.from_screws(
        [[0, 0, 1, 0, 0, 0], [0, 1, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]],
        [0.0, 0.0, 1.0],
        np.zeros((3, 3)),
        [np.zeros((3, 3)), np.zeros((3, 3)), np.diag([0.01, 0.03, 0.02])],
        gravity=None,
        on_unphysical="ignore",
        name="body",
    )
    q = single(0.2 * _random(9, 8, 3))
    qd = single(torch.tensor([4.0, 0.0, 0.0], dtype=torch.float64) + 0.2 * _random(10, 8, 3))
    torque = torch.zeros(PERIODS, 8, 3, dtype=torch.float64)
    return Case("tumbling", "tumbling free body, 1 s", robot, (), q, qd, torque, 1.0, suited=("StoermerVerlet",))


@cache
def rough() -> Case:
    """Two links with friction that fall on their limits."""
    robot = torchdq.robots.load("two_link")
    q = single(torch.tensor([-0.9, 0.3], dtype=torch.float64) + 0.1 * _random(11, 4, 2))
    damping, level, width, bound, stiffness, dissipation = 0.5, 1.0, 0.125, 1.125, 2000.0, 0.5

    def forces(q: Any, qd: Any) -> Any:
        beyond = np.maximum(np.abs(q) - bound, 0)
        outward = np.sign(q) * qd  # the penetration's rate, which counts only while it grows
        push = stiffness * beyond * (1 + dissipation * np.maximum(outward, 0))
        return -damping * qd - level * qd / np.sqrt(qd * qd + width * width) - np.sign(q) * push

    return Case(
        "rough",
        "friction and limits, 1/2 s",
        robot,
        (
            effects.Gravity(),
            effects.Viscous(damping),
            effects.Coulomb(level, width),
            effects.JointLimits(-bound, bound, stiffness, dissipation),
        ),
        q,
        0 * q,
        torch.zeros(PERIODS, 4, 2, dtype=torch.float64),
        0.5,
        forces,
        smooth=False,
        suited=("SemiImplicitEuler", "LinearlyImplicit"),
    )


CASES: dict[str, Callable[[], Case]] = {
    "pendulum": pendulum,
    "double_pendulum": double_pendulum,
    "arm7": arm7,
    "servo": servo,
    "chain42": chain42,
    "tumbling": tumbling,
    "rough": rough,
}
