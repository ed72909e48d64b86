"""Friction of the joints, each law stated once, for scenes, layers and identification.

The law of an effect is the impedance of one joint, on any kind of number: the motor must add the torque
(D + g |load|) qd + f to overcome it. That torque is linear in the parameters that `LINEAR` names. A scene exerts the
opposite on its joints (`torchdq.envs`); `torchdq.effects.resistance` has it on tensors, for layers and for logs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import is_number
from torchdq.dynamics.friction import smooth_speed
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Inputs, Parameter, Shapes
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import absolute, cos, maximum, sin
from torchdq.robot import Robot

TEMPERATURE = "temperature"  # input of friction that depends on it


@dataclass(frozen=True)
class Friction(JointEffect):
    """Base of friction, whose coefficients may change with temperature: c (1 + warming temperature), at least zero.

    The input `temperature` [..., n] is that of the joints above the one at which the coefficients hold [K]. All
    friction of a scene shares it; where nothing is warming it is no input.

    Args:
        warming: relative change of the coefficients [1/K], shape [..., n]; negative where friction falls with warmth.
    """

    SHAPES: ClassVar[Shapes] = {"warming": ("n",)}
    SIGNED: ClassVar[frozenset[str]] = frozenset({"warming"})
    SHARED: ClassVar[frozenset[str]] = frozenset({TEMPERATURE})
    LINEAR: ClassVar[tuple[str, ...]] = ()  # parameters in which the torque is linear, zero where all of them are
    FRACTIONS: ClassVar[frozenset[str]] = frozenset()  # parameters that are below 1
    LEARNED_AS: ClassVar[Mapping[str, str]] = {}  # names of parameters that a layer learns
    warming: Parameter = field(default=0.0, kw_only=True)

    def law(self, q: Number, qd: Number) -> Impedance:
        """Impedance of one joint, whose numbers the parameters are."""
        raise NotImplementedError

    def _check_values(self, name: str, numbers: Sequence[float]) -> None:
        super()._check_values(name, numbers)
        if name in self.FRACTIONS and max(numbers) >= 1:
            raise ArgumentError(
                f"{name} of {type(self).__name__} must be below 1, found {max(numbers):g}: such a joint would lock"
            )

    def steady(self, sign_width: float) -> Friction:
        """Memoryless friction with the same torque in steady motion; Coulomb friction gets that `sign_width`."""
        return self

    def bristles(self) -> float:
        """Deflection of bristles that follow from the positions alone [rad or m]; zero without memory."""
        return 0.0

    def parts(self) -> list[tuple[Friction, str]]:
        """Laws whose torques add up to this one's, each in proportion to one parameter that may be any positive one."""
        law = replace(self, **dict.fromkeys(self.LINEAR))
        return [(law, name) for name in self.LINEAR]

    def inputs(self, n: int) -> dict[str, int]:
        """The temperature [n], if the coefficients change with it."""
        return {} if _zero(self.warming) else {TEMPERATURE: n}

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances of all joints, by the law."""
        return [one.law(x, v) for one, x, v in zip(self.joints(len(q), inputs), q, qd, strict=True)]

    def joints(self, n: int, inputs: Inputs) -> list[Self]:
        """Friction of each joint at its temperature: copies whose parameters are numbers."""
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

    SHAPES: ClassVar[Shapes] = {"coefficient": ("n",), **Friction.SHAPES}
    LINEAR = SCALES = ("coefficient",)
    LEARNED_AS: ClassVar[Mapping[str, str]] = {"coefficient": "viscous"}
    DESCRIBED: ClassVar[Mapping[str, str]] = {"coefficient": "damping"}
    coefficient: Parameter = None

    def law(self, q: Number, qd: Number) -> Impedance:
        """D = d."""
        return Impedance(self.coefficient)


@dataclass(frozen=True)
class Quadratic(Friction):
    """Friction that grows with the square of the speed, as in fluids: tau = -c |qd| qd.

    Args:
        coefficient: c [N m s^2/rad^2 or N s^2/m^2], shape [..., n].
        warming: as in `Friction`.
    """

    SHAPES: ClassVar[Shapes] = {"coefficient": ("n",), **Friction.SHAPES}
    LINEAR = SCALES = ("coefficient",)
    coefficient: Parameter = None

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

    SHAPES: ClassVar[Shapes] = {"coulomb": ("n",), "sign_width": (), **Friction.SHAPES}
    LINEAR = SCALES = ("coulomb",)
    LEARNED_AS: ClassVar[Mapping[str, str]] = {"coulomb": "coulomb"}
    DIVIDING = frozenset({"sign_width"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"coulomb": "friction"}
    coulomb: Parameter = None
    sign_width: Parameter = 1e-2

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

    SHAPES: ClassVar[Shapes] = {"forward": ("n",), "backward": ("n",), "sign_width": (), **Friction.SHAPES}
    LINEAR = SCALES = ("forward", "backward")
    DIVIDING = frozenset({"sign_width"})
    forward: Parameter = None
    backward: Parameter = None
    sign_width: Parameter = 1e-2

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

    SHAPES: ClassVar[Shapes] = {
        "coulomb": ("n",),
        "static": ("n",),
        "velocity": ("n",),
        "sign_width": (),
        **Friction.SHAPES,
    }
    ORDERED = ("coulomb", "static")
    LINEAR = SCALES = ("coulomb", "static")
    DIVIDING = frozenset({"velocity", "sign_width"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"coulomb": "friction"}
    coulomb: Parameter = None
    static: Parameter = None
    velocity: Parameter = 0.1
    sign_width: Parameter = 1e-2

    def idle(self) -> tuple[str, ...]:
        """Friction parameters, if both are zero."""
        both = super().idle() and isinstance(self.static, tuple) and not any(self.static)
        return ("coulomb", "static") if both else ()

    def parts(self) -> list[tuple[Friction, str]]:
        """Dry friction of a moving joint, and what is more at rest, so that the friction at rest is at least that."""
        return [(Coulomb(sign_width=self.sign_width), "coulomb"), (super().parts()[-1][0], "static")]

    def law(self, q: Number, qd: Number) -> Impedance:
        """D = (c + (s - c) / (1 + (qd/v)^2)) / sqrt(qd^2 + w^2)."""
        ratio = qd / self.velocity
        friction = self.coulomb + (self.static - self.coulomb) / (1.0 + ratio * ratio)
        return Impedance(friction / smooth_speed(qd, self.sign_width))


@dataclass(frozen=True)
class LoadDependent(Friction):
    """Coulomb friction in proportion to the load, as in gears: tau = -g |load| qd / sqrt(qd^2 + w^2).

    The load is the torque that moves the bodies and the rotor, inverse dynamics without friction. In a scene it follows
    from all other torques u' at the joint: load = u' / (1 + m sign(u')), with m = g times the smooth sign.
    The coefficient is below 1, so that a load can always turn the joint backwards.

    Args:
        coefficient: g, friction over load, below 1, shape [..., n].
        sign_width: w, the speed below which the sign is smooth [rad/s or m/s], a number or [...].
        warming: as in `Friction`.
    """

    SHAPES: ClassVar[Shapes] = {"coefficient": ("n",), "sign_width": (), **Friction.SHAPES}
    LINEAR = SCALES = ("coefficient",)
    DIVIDING = frozenset({"sign_width"})
    FRACTIONS = frozenset({"coefficient"})
    ONCE = "their coefficients add up to one"
    coefficient: Parameter = None
    sign_width: Parameter = 1e-2

    def law(self, q: Number, qd: Number) -> Impedance:
        """g / sqrt(qd^2 + w^2) per load."""
        return Impedance(per_load=self.coefficient / smooth_speed(qd, self.sign_width))


@dataclass(frozen=True)
class Ripple(Friction):
    """Torque that repeats with the position, as of cogging or of gear teeth, the same in both directions.

        tau = -(sine sin(2 pi q / period) + cosine cos(2 pi q / period))

    It takes no energy out; friction in the direction of motion is that of other effects.

    Args:
        period: of the position [rad or m], shape [..., n].
        sine, cosine: [N m or N], shape [..., n].
        warming: as in `Friction`.
    """

    SHAPES: ClassVar[Shapes] = {"period": ("n",), "sine": ("n",), "cosine": ("n",), **Friction.SHAPES}
    SIGNED = Friction.SIGNED | {"sine", "cosine"}
    LINEAR = SCALES = ("sine", "cosine")
    DIVIDING = frozenset({"period"})
    period: Parameter
    sine: Parameter = None
    cosine: Parameter = None

    def law(self, q: Number, qd: Number) -> Impedance:
        """Force f, and K = df/dq where that is positive."""
        k = 2.0 * math.pi / self.period
        c, s = cos(k * q), sin(k * q)
        return Impedance(
            force=self.sine * s + self.cosine * c, stiffness=maximum(k * (self.sine * c - self.cosine * s), 0.0)
        )


def _zero(x: Any) -> bool:
    """True for a constant parameter that is zero at every joint."""
    return all(is_number(value) and value == 0 for value in (x if isinstance(x, tuple) else (x,)))


def parts_of(friction: Any, robot: Robot) -> list[tuple[Friction, str]]:
    """Laws of friction effects with the parameter that is to be found, each once; raises for what logs cannot tell.

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
    """Friction effects for a layer of a robot, resolved; raises unless the layer's inputs are all that they need.

    Args:
        effects: a sequence of them.
        robot: the robot.
        learn: whether linear parameters that neither are given nor described start at zero.
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
