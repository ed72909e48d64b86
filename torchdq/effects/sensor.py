"""Sensor effects on measured positions and velocities, applied at the end of a step, in their order.

The controller of a scene with sensors uses the measurements, and so should any other source of torques.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from torchdq.base.checks import REAL
from torchdq.dynamics.posed import Row
from torchdq.effects.actuator import rounded
from torchdq.effects.effect import Effect, Late
from torchdq.functions.parametric import Parameter, undefined
from torchdq.functions.signature import parameter
from torchdq.numbers.functions import log, sqrt


@dataclass(frozen=True)
class Sensor(Effect):
    """Change of the measurements: a row of n positions and n velocities."""

    SLOT: ClassVar[str] = "sensor"

    def read(self, reading: Row, memory: Row, noise: Row) -> tuple[Row, Row]:
        """Measurements after the sensor, and its memory after the step."""
        raise undefined(self, "read")


@dataclass(frozen=True)
class Noise(Sensor):
    """White Gaussian noise on every measurement, from uniform numbers u_1 and u_2.

        y = x + s sqrt(-2 log(u_1)) cos(2 pi u_2)

    Velocities use the sine of the same pair, which is independent of the cosine.

    Source: G. E. P. Box, M. E. Muller, "A note on the generation of random normal deviates", Annals of Mathematical
    Statistics 29 (1958).

    Args:
        position: s of positions, a standard deviation [rad or m], shape [..., n].
        velocity: s of velocities [rad/s or m/s], shape [..., n].
    """

    position: Parameter = field(default=0.0, metadata=parameter("n"))
    velocity: Parameter = field(default=0.0, metadata=parameter("n"))

    def noises(self, n: int) -> int:
        """Two per joint, for two independent normal numbers."""
        return 2 * n

    def read(self, reading: Row, memory: Row, noise: Row) -> tuple[Row, Row]:
        """Measurements with noise."""
        result = []
        n = len(reading) // 2
        for i in range(n):  # one pair of uniform numbers makes a pair of normal ones
            radius = sqrt(-2.0 * log(noise[2 * i]))
            angle = (2 * math.pi) * noise[2 * i + 1]
            result.append((radius * angle.cos(), radius * angle.sin()))
        positions = [x + s * z[0] for x, s, z in zip(reading[:n], self.position, result, strict=True)]
        velocities = [x + s * z[1] for x, s, z in zip(reading[n:], self.velocity, result, strict=True)]
        return [*positions, *velocities], ()


@dataclass(frozen=True)
class Bias(Sensor):
    """Constant bias of the measurements: y = x + b.

    Args:
        position: b of positions [rad or m], shape [..., n].
        velocity: b of velocities [rad/s or m/s], shape [..., n].
    """

    position: Parameter = field(default=0.0, metadata=parameter("n", check=REAL))
    velocity: Parameter = field(default=0.0, metadata=parameter("n", check=REAL))

    def read(self, reading: Row, memory: Row, noise: Row) -> tuple[Row, Row]:
        """Measurements with bias."""
        return [x + b for x, b in zip(reading, (*self.position, *self.velocity), strict=True)], ()


@dataclass(frozen=True)
class QuantisedReading(Sensor):
    """Quantisation of the measurements to multiples of a step; zero disables it, at no cost.

        y = s floor(x / s + 1/2)

    Args:
        position: step s of positions [rad or m], shape [..., n].
        velocity: step s of velocities [rad/s or m/s], shape [..., n].
    """

    position: Parameter = field(default=0.0, metadata=parameter("n"))
    velocity: Parameter = field(default=0.0, metadata=parameter("n"))

    def read(self, reading: Row, memory: Row, noise: Row) -> tuple[Row, Row]:
        """The nearest multiples of the steps."""
        return [
            x if isinstance(s, float) and s == 0 else rounded(x, s)
            for x, s in zip(reading, (*self.position, *self.velocity), strict=True)
        ], ()


@dataclass(frozen=True)
class MeasurementDelay(Late, Sensor):
    """Delay of the measurements by a whole number of steps: y(t) = x(t - steps dt), initially the initial state.

    Args:
        steps: from 1 to 500.
    """

    PER_JOINT = 2

    def start(self, q: Row, qd: Row) -> Row:
        """Initial state, once for each step."""
        return (*q, *qd) * self.steps

    def read(self, reading: Row, memory: Row, noise: Row) -> tuple[Row, Row]:
        """The measurements `steps` steps before."""
        return self.passed(reading, memory)
