"""Friction that remembers: bristles that bend before they slide.

What a joint remembers is the deflection of its bristles in units of that at which they slide. The law is linear in the
velocity at the end of a step and in the memory, so that a linearly implicit step is stable at any stiffness of the
bristles, and takes them to the exact stationary deflection at any speed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import is_number
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Inputs, Parameter, Shapes
from torchdq.effects.friction import Coulomb, Friction
from torchdq.effects.joint import Impedance
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import absolute, exp


class Bristle(NamedTuple):
    """Mean rate a qd' - b z of a deflection z over a step, at whose end the velocity is qd'."""

    a: Number  # [1/rad or 1/m]
    b: Number  # >= 0 [1/s]


@dataclass(frozen=True)
class LuGre(Friction):
    """LuGre friction: elastic bristles hold a joint like a spring before it slides, tau = -c (z + T zd).

        zd = (qd - |qd| z / g) / b,   g = 1 + (r - 1) exp(-(qd/v)^2)

    The state remembers z. At a constant velocity z = g sign(qd), so that friction is c, and r c near rest. In the
    source's terms the stiffness of the bristles is sigma_0 = c / b and their damping is sigma_1 = T sigma_0; here
    T = s / (1 + (s qd / (8 b))^2), since friction with a constant T could accelerate a fast joint. The term sigma_2 is
    `Viscous`.

    Source: C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, "A new model for control of systems with
    friction", IEEE Transactions on Automatic Control 40 (1995).

    Args:
        coulomb: c, friction of a sliding joint [N m or N], shape [..., n]; None: the friction of the robot's
            description.
        deflection: b, of the bristles when they slide [rad or m], shape [..., n].
        ratio: r, friction near rest over that of a sliding joint, at least 1, shape [..., n].
        velocity: v, the Stribeck velocity, at which that excess has fallen to 1/e [rad/s or m/s], shape [..., n].
        settling: s, the time in which bent bristles of a free joint without inertia relax [s], shape [..., n].
        warming: as in `Friction`.
    """

    SHAPES: ClassVar[Shapes] = {
        **{name: ("n",) for name in ("coulomb", "deflection", "ratio", "velocity", "settling")},
        **Friction.SHAPES,
    }
    LINEAR = SCALES = ("coulomb",)
    DIVIDING = frozenset({"deflection", "velocity"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"coulomb": "friction"}
    coulomb: Parameter = None
    deflection: Parameter = 5e-4
    ratio: Parameter = 1.0
    velocity: Parameter = 0.1
    settling: Parameter = 0.0

    def _check_values(self, name: str, numbers: Sequence[float]) -> None:
        super()._check_values(name, numbers)
        if name == "ratio" and min(numbers) < 1:
            raise ArgumentError(f"ratio of LuGre must be at least 1, found {min(numbers):g}")

    def steady(self, sign_width: float) -> Friction:
        """Coulomb friction of the same size, without the excess near rest."""
        return Coulomb(self.coulomb, sign_width, warming=self.warming)

    def bristles(self) -> float:
        """The deflection, if it is that of all joints, ratio is 1 and settling 0; raises otherwise."""
        if not is_number(self.deflection) or (self.ratio, self.settling) != (1.0, 0.0):
            raise ArgumentError(
                "friction must hold LuGre with one deflection for all joints, ratio=1 and settling=0, so that its "
                f"bristles follow from the positions, found {self!r}"
            )
        return float(self.deflection)

    def memory(self, n: int) -> int:
        """The deflection of every joint."""
        return n

    def bristle(self, qd: Number, h: Number) -> Bristle:
        """Rate of the deflection of one joint over a step h, at whose start the velocity is qd; h = 0: now."""
        ratio, speed = qd / self.velocity, absolute(qd)
        g = 1.0 + (self.ratio - 1.0) * exp(-(ratio * ratio))
        sliding = speed / (self.deflection * g)
        share = 1.0 + h * sliding
        return Bristle(1.0 / (self.deflection * share), sliding / share)

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances of bristles that are not bent."""
        return self.impedances_at_end(q, qd, inputs, (0.0,) * len(q), 0.0)

    def impedances_at_end(self, q: Row, qd: Row, inputs: Inputs, memory: Row, h: Number) -> Sequence[Impedance]:
        """Impedances of the torque c (z + (h + T) (a qd' - b z)), of which h a is the stiffness times the step."""
        result = []
        for one, v, z in zip(self.joints(len(q), inputs), qd, memory, strict=True):
            a, b = one.bristle(v, h)
            fast = one.settling * v / (8.0 * one.deflection)
            T = one.settling / (1.0 + fast * fast)
            result.append(Impedance(one.coulomb * T * a, one.coulomb * (z - (h + T) * b * z), one.coulomb * a))
        return result

    def memory_rates(self, q: Row, qd: Row, inputs: Inputs, memory: Row, ends: Row, h: Number) -> Row:
        """Rates a qd' - b z, at any temperature."""
        result = []
        for one, v, z, end in zip(replace(self, warming=0.0).joints(len(q), inputs), qd, memory, ends, strict=True):
            a, b = one.bristle(v, h)
            result.append(a * end - b * z)
        return result
