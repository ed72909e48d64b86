"""Friction of the joints, each law defined once, for scenes, layers and identification.

The law of an effect is the impedance of one joint, on any kind of number: the motor must add the torque
(D + g |load|) qd + f to overcome it. That torque is linear in the parameters listed in `LINEAR`. A scene applies the
opposite to its joints; `torchdq.effects.resistance` evaluates it on tensors, for layers and for logs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, Self

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import POSITIVE, REAL, Interval, is_number
from torchdq.dynamics.friction import smooth_speed
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Effect, Inputs
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import Parameter
from torchdq.functions.signature import parameter
from torchdq.numbers.functions import absolute, cos, exp, maximum, sin
from torchdq.robot import Robot

TEMPERATURE = "temperature"  # input of temperature-dependent friction


@dataclass(frozen=True)
class Friction(JointEffect):
    """Base of friction, with temperature-dependent coefficients c (1 + warming temperature), at least zero.

    The input `temperature` [..., n] is the difference to the temperature at which the coefficients are given [K]. All
    friction of a scene shares it; without warming it is not an input.

    Args:
        warming: relative change of the coefficients [1/K], shape [..., n]; negative if friction falls with temperature.
    """

    SHARED: ClassVar[frozenset[str]] = frozenset({TEMPERATURE})
    LINEAR: ClassVar[tuple[str, ...]] = ()  # parameters in which the torque is linear; zero if all are zero
    LEARNED_AS: ClassVar[Mapping[str, str]] = {}  # names of the learned parameters of a layer
    warming: Parameter = field(default=0.0, kw_only=True, metadata=parameter("n", check=REAL))

    def law(self, q: Number, qd: Number) -> Impedance:
        """Impedance of one joint, with numbers as parameters."""
        raise NotImplementedError

    def steady(self, sign_width: float) -> Friction:
        """Memoryless friction with the same torque in steady motion, of the given `sign_width`."""
        return self

    def bristles(self) -> float:
        """Deflection of bristles that can be computed from positions alone [rad or m]; zero without memory."""
        return 0.0

    def idle(self) -> tuple[str, ...]:
        """Parameters in which the torque is linear, if all are constants that are zero."""
        return self.LINEAR if all(_zero(getattr(self, name)) for name in self.LINEAR) else ()

    def parts(self) -> list[tuple[Friction, str]]:
        """Laws that sum to this one, each proportional to one nonnegative parameter."""
        law = replace(self, **dict.fromkeys(self.LINEAR))
        return [(law, name) for name in self.LINEAR]

    def inputs(self, n: int) -> dict[str, int]:
        """The temperature [n], if the coefficients depend on it."""
        return {} if _zero(self.warming) else {TEMPERATURE: n}

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances of all joints."""
        return [one.law(x, v) for one, x, v in zip(self.joints(len(q), inputs), q, qd, strict=True)]

    def joints(self, n: int, inputs: Inputs) -> list[Self]:
        """Friction of each joint at its temperature: copies with numbers as parameters."""
        rows = {name: getattr(self, name) for name in self.SHAPES if name != "warming"}
        if not _zero(self.warming):
            pairs = zip(self.warming, inputs[TEMPERATURE], strict=True)
            factors = [maximum(1.0 + a * T, 0.0) for a, T in pairs]
            rows |= {name: [k * c for k, c in zip(factors, rows[name], strict=True)] for name in self.LINEAR}
        each = [{name: row[i] if self.SHAPES[name] else row for name, row in rows.items()} for i in range(n)]
        return [replace(self, warming=0.0, **numbers) for numbers in each]


@dataclass(frozen=True)
class Viscous(Friction):
    """Viscous friction: tau = -d qd.

    Args:
        coefficient: d [N m s/rad or N s/m], shape [..., n]; None: the damping of the robot's description.
        warming: as in `Friction`.
    """

    LINEAR = SCALES = ("coefficient",)
    LEARNED_AS: ClassVar[Mapping[str, str]] = {"coefficient": "viscous"}
    coefficient: Parameter = field(default=None, metadata=parameter("n", described="damping"))

    def law(self, q: Number, qd: Number) -> Impedance:
        """D = d."""
        return Impedance(self.coefficient)


@dataclass(frozen=True)
class Quadratic(Friction):
    """Quadratic friction, as in fluids: tau = -c |qd| qd.

    Args:
        coefficient: c [N m s^2/rad^2 or N s^2/m^2], shape [..., n].
        warming: as in `Friction`.
    """

    LINEAR = SCALES = ("coefficient",)
    coefficient: Parameter = field(default=None, metadata=parameter("n"))

    def law(self, q: Number, qd: Number) -> Impedance:
        """D = c |qd|."""
        return Impedance(self.coefficient * absolute(qd))


@dataclass(frozen=True)
class Coulomb(Friction):
    """Coulomb friction with a smooth sign: tau = -c qd / sqrt(qd^2 + w^2).

    The joint never sticks: under a torque tau below c it creeps at the speed w tau / sqrt(c^2 - tau^2). Explicit
    integrators chatter once dt c / (inertia w) exceeds 2. The linearly implicit integrator is stable at any w, but a
    joint at rest under a torque tau above c leaves the smooth zone only by a factor tau/c per step.

    Args:
        coulomb: c, friction of a sliding joint [N m or N], shape [..., n]; None: the friction of the robot's
            description.
        sign_width: w, the speed below which the sign is smooth and friction viscous [rad/s or m/s], a number or [...].
        warming: as in `Friction`.
    """

    LINEAR = SCALES = ("coulomb",)
    LEARNED_AS: ClassVar[Mapping[str, str]] = {"coulomb": "coulomb"}
    coulomb: Parameter = field(default=None, metadata=parameter("n", described="friction"))
    sign_width: Parameter = field(default=1e-2, metadata=parameter(check=POSITIVE))

    def law(self, q: Number, qd: Number) -> Impedance:
        """D = c / sqrt(qd^2 + w^2)."""
        return Impedance(self.coulomb / smooth_speed(qd, self.sign_width))


@dataclass(frozen=True)
class Directional(Friction):
    """Coulomb friction that differs between the two directions, with the smooth sign s = qd / sqrt(qd^2 + w^2).

        tau = -(forward (1 + s)/2 + backward (1 - s)/2) s

    Args:
        forward: Coulomb friction where qd > 0 [N m or N], shape [..., n].
        backward: Coulomb friction where qd < 0 [N m or N], shape [..., n].
        sign_width: w, the speed below which the sign is smooth [rad/s or m/s], a number or [...].
        warming: as in `Friction`.
    """

    LINEAR = SCALES = ("forward", "backward")
    forward: Parameter = field(default=None, metadata=parameter("n"))
    backward: Parameter = field(default=None, metadata=parameter("n"))
    sign_width: Parameter = field(default=1e-2, metadata=parameter(check=POSITIVE))

    def law(self, q: Number, qd: Number) -> Impedance:
        """D = (forward (1 + s) + backward (1 - s)) / (2 sqrt(qd^2 + w^2))."""
        speed = smooth_speed(qd, self.sign_width)
        mean, half = 0.5 * (self.forward + self.backward), 0.5 * (self.forward - self.backward)
        return Impedance((mean + half * (qd / speed)) / speed)


@dataclass(frozen=True)
class Stribeck(Friction):
    """Coulomb friction that is higher near rest: tau = -(c + (s - c) / (1 + (qd/v)^2)) qd / sqrt(qd^2 + w^2).

    Source: D. P. Hess, A. Soom, "Friction at a lubricated line contact operating at oscillating sliding velocities",
    Journal of Tribology 112 (1990), without its viscous term, which is `Viscous`.

    Args:
        coulomb: c, friction of a sliding joint [N m or N], shape [..., n]; None: the friction of the robot's
            description.
        static: s, friction near rest [N m or N], shape [..., n], at least c.
        velocity: v, the Stribeck velocity, at which the excess s - c has halved [rad/s or m/s], shape [..., n].
        sign_width: w, the speed below which the sign is smooth [rad/s or m/s], a number or [...].
        warming: as in `Friction`.
    """

    ORDERED = ("coulomb", "static")
    LINEAR = SCALES = ("coulomb", "static")
    coulomb: Parameter = field(default=None, metadata=parameter("n", described="friction"))
    static: Parameter = field(default=None, metadata=parameter("n"))
    velocity: Parameter = field(default=0.1, metadata=parameter("n", check=POSITIVE))
    sign_width: Parameter = field(default=1e-2, metadata=parameter(check=POSITIVE))

    def parts(self) -> list[tuple[Friction, str]]:
        """Coulomb friction, and the excess near rest, so that static friction is at least Coulomb friction."""
        return [(Coulomb(sign_width=self.sign_width), "coulomb"), (super().parts()[-1][0], "static")]

    def law(self, q: Number, qd: Number) -> Impedance:
        """D = (c + (s - c) / (1 + (qd/v)^2)) / sqrt(qd^2 + w^2)."""
        ratio = qd / self.velocity
        friction = self.coulomb + (self.static - self.coulomb) / (1.0 + ratio * ratio)
        return Impedance(friction / smooth_speed(qd, self.sign_width))


@dataclass(frozen=True)
class LoadDependent(Friction):
    """Coulomb friction in proportion to the load, as in gears: tau = -g |load| qd / sqrt(qd^2 + w^2).

    The load is the torque that accelerates the bodies and the rotor: inverse dynamics without friction. In a scene it
    is computed from all other torques u' at the joint: load = u' / (1 + m sign(u')), with m = g times the smooth sign.
    The coefficient is below 1, so that the joint is always backdrivable.

    Args:
        coefficient: g, friction over load, below 1, shape [..., n].
        sign_width: w, the speed below which the sign is smooth [rad/s or m/s], a number or [...].
        warming: as in `Friction`.
    """

    LINEAR = SCALES = ("coefficient",)
    ONCE = "their coefficients add up to one"
    coefficient: Parameter = field(
        default=None, metadata=parameter("n", check=Interval(0.0, below=1.0, cure="such a joint would lock"))
    )
    sign_width: Parameter = field(default=1e-2, metadata=parameter(check=POSITIVE))

    def law(self, q: Number, qd: Number) -> Impedance:
        """g / sqrt(qd^2 + w^2) per load."""
        return Impedance(per_load=self.coefficient / smooth_speed(qd, self.sign_width))


@dataclass(frozen=True)
class Ripple(Friction):
    """Torque ripple, periodic in the position, as from cogging or gear teeth.

        tau = -(sine sin(2 pi q / period) + cosine cos(2 pi q / period))

    It is conservative: the same in both directions of motion.

    Args:
        period: in the position [rad or m], shape [..., n].
        sine, cosine: [N m or N], shape [..., n].
        warming: as in `Friction`.
    """

    LINEAR = SCALES = ("sine", "cosine")
    period: Parameter = field(metadata=parameter("n", check=POSITIVE))
    sine: Parameter = field(default=None, metadata=parameter("n", check=REAL))
    cosine: Parameter = field(default=None, metadata=parameter("n", check=REAL))

    def law(self, q: Number, qd: Number) -> Impedance:
        """Force f, and K = df/dq where that is positive."""
        k = 2.0 * math.pi / self.period
        c, s = cos(k * q), sin(k * q)
        return Impedance(
            force=self.sine * s + self.cosine * c, stiffness=maximum(k * (self.sine * c - self.cosine * s), 0.0)
        )


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
        settling: s, the time in which deflected bristles of a free joint without inertia relax [s], shape [..., n].
        warming: as in `Friction`.
    """

    LINEAR = SCALES = ("coulomb",)
    coulomb: Parameter = field(default=None, metadata=parameter("n", described="friction"))
    deflection: Parameter = field(default=5e-4, metadata=parameter("n", check=POSITIVE))
    ratio: Parameter = field(default=1.0, metadata=parameter("n", check=Interval(1.0)))
    velocity: Parameter = field(default=0.1, metadata=parameter("n", check=POSITIVE))
    settling: Parameter = field(default=0.0, metadata=parameter("n"))

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


def _zero(x: Any) -> bool:
    """True for a constant parameter that is zero at every joint."""
    return all(is_number(value) and value == 0 for value in (x if isinstance(x, tuple) else (x,)))


def resisting(effects: Sequence[Effect]) -> list[Friction]:
    """Friction among effects that acts against the motion, and is not zero."""
    friction = [one for one in effects if isinstance(one, Friction)]
    return [one for one in friction if not (one.idle() or any(one.interval(name).signed for name in one.LINEAR))]


def parts_of(friction: Any, robot: Robot) -> list[tuple[Friction, str]]:
    """Laws of friction effects with the parameter to estimate, without duplicates; raises for temperature dependence.

    Args:
        friction: an effect, or a sequence of them.
        robot: the robot.
    """
    found: list[tuple[Friction, str]] = []
    for effect in friction if isinstance(friction, Sequence) else (friction,):
        if not isinstance(effect, Friction):
            cure = "or a sequence of friction effects, such as (effects.Viscous(), effects.Coulomb())"
            raise ArgumentError(f"friction must be None, 'auto', {cure}, found {effect!r}")
        zeros: dict[str, Any] = dict.fromkeys(effect.LINEAR, 0.0)
        if replace(effect, **zeros).resolved(robot).inputs(robot.n):
            name = type(effect).__name__
            raise ArgumentError(f"friction must not be warming, since logs have no temperature, found that of {name}")
        found += effect.parts()
    return list(dict.fromkeys(found))


def of_layers(effects: Any, robot: Robot, learn: bool = False) -> tuple[Friction, ...]:
    """Friction effects of a layer, resolved; raises if they need more than the inputs of a layer.

    Args:
        effects: a sequence of them.
        robot: the robot.
        learn: whether linear parameters that are neither given nor described start at zero.
    """
    found: list[Friction] = []
    for effect in effects if isinstance(effects, Sequence) and not isinstance(effects, str) else (effects,):
        name = type(effect).__name__
        if not isinstance(effect, Friction):
            raise ArgumentError(
                f"friction must be a sequence of friction effects, such as (effects.Coulomb(),), found {effect!r}"
            )
        if effect.memory(robot.n):
            raise ArgumentError(
                f"friction of a layer must not be {name}, whose torque depends on the motion before, of which a layer "
                "sees one moment; it acts in a Scene, and Coulomb or Stribeck is its friction while sliding"
            )
        absent = {p: 0.0 for p in effect.LINEAR if learn and getattr(effect, p) is None and p not in effect.DESCRIBED}
        resolved = replace(effect, **absent).resolved(robot)
        if resolved.inputs(robot.n):
            raise ArgumentError(
                f"friction of a layer must not be warming, since a layer has no temperature, found warming of {name}; "
                "give its coefficients at the temperature of the motion"
            )
        if effect.ONCE and any(other.ONCE == effect.ONCE for other in found):
            raise ArgumentError(f"friction must not hold {name} twice: {effect.ONCE}")
        found.append(resolved)
    return tuple(found)
