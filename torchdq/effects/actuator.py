"""Effects of the actuators on commanded torques. They act once per step, in their order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Effect, Late, Parameter, Shapes, unbounded, undefined
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import below, clip, exp, floor, maximum, polynomial, select
from torchdq.program.transforms import without_values
from torchdq.robot import Robot


@dataclass(frozen=True)
class Actuator(Effect):
    """Base class of actuators, which change commanded torques before they act on the joints."""

    SLOT: ClassVar[str] = "actuator"

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """Torques behind the actuator, and its memory after the step."""
        raise undefined(self, "driven")


@dataclass(frozen=True)
class Saturation(Actuator):
    """The torque clipped to its limit, exactly: tau = min(max(u, -limit), limit).

    Args:
        limit: [N m or N], shape [..., n]; None: the effort limits of the robot's description, infinite where none.
    """

    SHAPES: ClassVar[Shapes] = {"limit": ("n",)}
    UNBOUNDED = frozenset({"limit"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"limit": "limits.effort"}
    limit: Parameter = None

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """The torques within their limits."""
        return [x if unbounded(limit) else clip(x, -limit, limit) for x, limit in zip(u, self.limit, strict=True)], ()


@dataclass(frozen=True)
class TorqueSpeed(Actuator):
    """A motor whose torque falls with speed: -stall max(0, 1 + qd/speed) <= tau <= stall max(0, 1 - qd/speed).

    Torque-speed line of a direct-current motor at maximum voltage, in both directions, and |tau| <= stall; braking has
    the full torque.

    Args:
        stall: torque at rest [N m or N], shape [..., n]; None: the effort limits of the description. Where it is an
            infinite number there is no limit.
        speed: at which no torque is left [rad/s or m/s], shape [..., n]; None: the velocity limits of the description.
    """

    SHAPES: ClassVar[Shapes] = {"stall": ("n",), "speed": ("n",)}
    UNBOUNDED = frozenset({"stall", "speed"})
    DIVIDING = frozenset({"speed"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"stall": "limits.effort", "speed": "limits.velocity"}
    stall: Parameter = None
    speed: Parameter = None

    def resolved(self, robot: Robot) -> Self:
        """Copy for a robot; raises if a torque at rest that is a tensor is infinite, which only a number can be."""
        whole = super().resolved(robot)
        x = whole.stall
        if isinstance(x, Tensor) and not without_values((x,)) and bool(x.detach().isinf().any()):
            raise ArgumentError(
                "stall of TorqueSpeed must be finite as a tensor; a joint without limit is the number inf"
            )
        return whole

    def idle(self) -> tuple[str, ...]:
        """Torque at rest, if it is infinite at every joint."""
        return ("stall",) if isinstance(self.stall, tuple) and all(map(unbounded, self.stall)) else ()

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """Torques clipped to what the motors have at their speeds."""
        result = []
        for x, v, stall, speed in zip(u, qd, self.stall, self.speed, strict=True):
            if unbounded(stall):
                result.append(x)
                continue
            lost = clip(stall / speed * v, -stall, stall)
            upper = stall - maximum(lost, 0.0)
            result.append(clip(x, -(upper + lost), upper))
        return result, ()


@dataclass(frozen=True)
class FirstOrderLag(Actuator):
    """A first-order lag: T tau' = u - tau, solved exactly over a step in which u is constant.

    The torque that acts over the step is the mean of that solution, so that its impulse is exact at any length of the
    step; the solution at the end is remembered.

    Args:
        time: T [s], shape [..., n]; zero is no lag.
    """

    SHAPES: ClassVar[Shapes] = {"time": ("n",)}
    time: Parameter

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
    """Torques that arrive a whole number of steps late: tau(t) = u(t - steps dt); before that, none.

    Args:
        steps: from 1 to 500.
    """

    PER_JOINT = 1

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """The torques of `steps` steps ago."""
        return self.passed(u, memory)


@dataclass(frozen=True)
class DeadBand(Actuator):
    """Dead band: commands lose up to a width, tau = u - min(max(u, -width), width).

    Args:
        width: [N m or N], shape [..., n].
    """

    SHAPES: ClassVar[Shapes] = {"width": ("n",)}
    width: Parameter

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """Commands less the part within the width."""
        return [x - clip(x, -w, w) for x, w in zip(u, self.width, strict=True)], ()


@dataclass(frozen=True)
class QuantisedCommand(Actuator):
    """Commands rounded to whole multiples of a step; the gradient is zero, as of any staircase.

        tau = step floor(u / step + 1/2)

    Args:
        step: [N m or N], shape [..., n], positive.
    """

    SHAPES: ClassVar[Shapes] = {"step": ("n",)}
    DIVIDING = frozenset({"step"})
    step: Parameter

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """The nearest multiples of the step."""
        return [rounded(x, s) for x, s in zip(u, self.step, strict=True)], ()


def _decay(z: Number) -> Number:
    """Mean (1 - exp(-z)) / z of the exponential exp(-t) over t from 0 to z > 0."""
    if isinstance(z, float):
        return -math.expm1(-z) / z
    # the difference of 1 and a number near it has no digits left; 1 - z/2 + z^2/6 - ... has all
    series = polynomial([(-1) ** k / math.factorial(k + 1) for k in range(9)], z)
    return select(below(z, 0.05), series, (1.0 - exp(-z)) / z)


def rounded(x: Number, step: Number) -> Number:
    """Nearest multiple of a step."""
    return step * floor(x / step + 0.5)
