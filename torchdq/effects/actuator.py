"""Actuator effects on commanded torques, applied once per step, in their order."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Self

from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import POSITIVE, Interval
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Effect, Late, unbounded
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import Parameter, undefined
from torchdq.functions.signature import parameter
from torchdq.numbers.functions import below, clip, exp, floor, maximum, polynomial, select
from torchdq.program.transforms import without_values
from torchdq.robot import Robot


@dataclass(frozen=True)
class Actuator(Effect):
    """Base of actuators, which change commanded torques before they act on the joints."""

    SLOT: ClassVar[str] = "actuator"

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """Torques behind the actuator, and its memory after the step."""
        raise undefined(self, "driven")


@dataclass(frozen=True)
class Saturation(Actuator):
    """Torque limit: tau = min(max(u, -limit), limit).

    Args:
        limit: [N m or N], shape [..., n]; None: the effort limits of the robot's description, infinite if absent.
    """

    limit: Parameter = field(
        default=None, metadata=parameter("n", check=Interval(0.0, infinite=True), described="limits.effort")
    )

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """The torques within their limits."""
        return [x if unbounded(limit) else clip(x, -limit, limit) for x, limit in zip(u, self.limit, strict=True)], ()


@dataclass(frozen=True)
class TorqueSpeed(Actuator):
    """Torque-speed limit of a motor: -stall max(0, 1 + qd/speed) <= tau <= stall max(0, 1 - qd/speed).

    Torque-speed line of a DC motor at maximum voltage, in both directions, and |tau| <= stall; the full torque is
    available for braking.

    Args:
        stall: stall torque [N m or N], shape [..., n]; None: the effort limits of the description. An infinite number
            is no limit.
        speed: no-load speed [rad/s or m/s], shape [..., n]; None: the velocity limits of the description.
    """

    stall: Parameter = field(
        default=None, metadata=parameter("n", check=Interval(0.0, infinite=True), described="limits.effort")
    )
    speed: Parameter = field(
        default=None,
        metadata=parameter("n", check=Interval(0.0, open=True, infinite=True), described="limits.velocity"),
    )

    def resolved(self, robot: Robot) -> Self:
        """Copy for a robot; raises if a stall torque that is a tensor is infinite, which only a number can be."""
        whole = super().resolved(robot)
        x = whole.stall
        if isinstance(x, Tensor) and not without_values((x,)) and bool(x.detach().isinf().any()):
            raise ArgumentError(
                "stall of TorqueSpeed must be finite as a tensor; a joint without limit is the number inf"
            )
        return whole

    def idle(self) -> tuple[str, ...]:
        """Stall torque, if it is infinite at every joint."""
        return ("stall",) if isinstance(self.stall, tuple) and all(map(unbounded, self.stall)) else ()

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """Torques clipped to the available torques at these velocities."""
        result = []
        for x, v, stall, speed in zip(u, qd, self.stall, self.speed, strict=True):
            if unbounded(stall):
                result.append(x)
                continue
            drop = clip(stall / speed * v, -stall, stall)
            upper = stall - maximum(drop, 0.0)
            result.append(clip(x, -(upper + drop), upper))
        return result, ()


@dataclass(frozen=True)
class FirstOrderLag(Actuator):
    """First-order lag: T tau' = u - tau, solved exactly for constant u over a step.

    The torque over the step is the mean of that solution, so that its impulse is exact at any step size; the solution
    at the end of the step is the state.

    Args:
        time: T [s], shape [..., n]; zero disables it.
    """

    time: Parameter = field(metadata=parameter("n"))

    def memory(self, n: int) -> int:
        """The torques at the end of the last step."""
        return n

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """Mean torques over the step, and those at its end."""
        mean, end = [], []
        for x, before, T in zip(u, memory, self.time, strict=True):
            kept, share = (0.0, 0.0) if isinstance(T, float) and T == 0 else (exp(-(dt / T)), _decay(dt / T))
            mean.append(x + share * (before - x))
            end.append(x + kept * (before - x))
        return mean, end


@dataclass(frozen=True)
class CommandDelay(Late, Actuator):
    """Delay of the torques by a whole number of steps: tau(t) = u(t - steps dt), initially zero.

    Args:
        steps: from 1 to 500.
    """

    PER_JOINT = 1

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """The commands `steps` steps before."""
        return self.passed(u, memory)


@dataclass(frozen=True)
class DeadBand(Actuator):
    """Dead band of the commands: tau = u - min(max(u, -width), width).

    Args:
        width: half-width of the band [N m or N], shape [..., n].
    """

    width: Parameter = field(metadata=parameter("n"))

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """Commands minus the part inside the band."""
        return [x - clip(x, -w, w) for x, w in zip(u, self.width, strict=True)], ()


@dataclass(frozen=True)
class QuantisedCommand(Actuator):
    """Quantisation of the commands to multiples of a step; its gradient is zero.

        tau = step floor(u / step + 1/2)

    Args:
        step: [N m or N], shape [..., n], positive.
    """

    step: Parameter = field(metadata=parameter("n", check=POSITIVE))

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """The nearest multiples of the step."""
        return [rounded(x, s) for x, s in zip(u, self.step, strict=True)], ()


def _decay(z: Number) -> Number:
    """Mean (1 - exp(-z)) / z of the exponential exp(-t) over t from 0 to z > 0."""
    if isinstance(z, float):
        return -math.expm1(-z) / z
    # 1 - exp(-z) cancels for small z; the series 1 - z/2 + z^2/6 - ... does not
    series = polynomial([(-1) ** k / math.factorial(k + 1) for k in range(9)], z)
    return select(below(z, 0.05), series, (1.0 - exp(-z)) / z)


def rounded(x: Number, step: Number) -> Number:
    """Nearest multiple of a step."""
    return step * floor(x / step + 0.5)
