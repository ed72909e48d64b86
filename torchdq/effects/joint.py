"""Effects at the joints: friction, springs, servos, limits, elasticity.

A joint effect is an impedance: the torque -D qd - K (q - rest) with a damping D >= 0 and a stiffness K >= 0 that may
depend on the state. Written this way a linearly implicit integrator can take the velocity and the position at the end
of the step, with D and K as they are at its beginning: however stiff, such a torque cannot overshoot, and friction
cannot turn a motion round. Explicit integrators evaluate it as it stands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from torchdq.algebra.quaternion import Number
from torchdq.effects.effect import Effect, Parameter, Shapes, unbounded
from torchdq.numbers.functions import at_least, clip, maximum, sqrt

Inputs = Mapping[str, Sequence[Number]]


class Impedance(NamedTuple):
    """Torque -damping qd - stiffness (q - rest) of one joint."""

    damping: Number = 0.0  # D >= 0 [N m s/rad or N s/m]
    stiffness: Number = 0.0  # K >= 0 [N m/rad or N/m]
    rest: Number = 0.0  # [rad or m]

    def torque(self, q: Number, qd: Number) -> Number:
        """The torque [N m or N]."""
        return -(self.damping * qd) - self.stiffness * (q - self.rest)


@dataclass(frozen=True)
class JointEffect(Effect):
    """A torque at every joint that depends on the state of that joint alone."""

    SLOT: ClassVar[str] = "joint"

    def impedances(self, q: Sequence[Number], qd: Sequence[Number], inputs: Inputs) -> Sequence[Impedance]:
        """Impedance of every joint at a state."""
        raise NotImplementedError


@dataclass(frozen=True)
class Viscous(JointEffect):
    """Viscous friction: tau = -d qd.

    Args:
        coefficient: d [N m s/rad or N s/m], shape [..., n]; None: the damping of the robot's description.
    """

    SHAPES: ClassVar[Shapes] = {"coefficient": ("n",)}
    DESCRIBED: ClassVar[Mapping[str, str]] = {"coefficient": "damping"}
    coefficient: Parameter = None

    def impedances(self, q: Sequence[Number], qd: Sequence[Number], inputs: Inputs) -> Sequence[Impedance]:
        """D = d."""
        return [Impedance(d) for d in self.coefficient]


@dataclass(frozen=True)
class Coulomb(JointEffect):
    """Dry friction, regularised: tau = -level qd / sqrt(qd^2 + width^2).

    Below the width the joint creeps, at width tau / sqrt(level^2 - tau^2) under a torque tau smaller than the level; it
    never sticks for good. An explicit integrator chatters once dt level / (inertia width) exceeds 2; the linearly
    implicit one does not at any width, but a joint at rest under a torque tau above the level leaves the width only by
    a factor tau/level per step.

    Args:
        level: Coulomb friction [N m or N], shape [..., n]; None: the friction of the robot's description.
        width: velocity below which it is viscous [rad/s or m/s], a number or [...].
    """

    SHAPES: ClassVar[Shapes] = {"level": ("n",), "width": ()}
    DIVIDING = frozenset({"width"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"level": "friction"}
    level: Parameter = None
    width: Parameter = 1e-2

    def impedances(self, q: Sequence[Number], qd: Sequence[Number], inputs: Inputs) -> Sequence[Impedance]:
        """D = level / sqrt(qd^2 + width^2)."""
        return [Impedance(_over_speed(level, v, self.width)) for level, v in zip(self.level, qd, strict=True)]


@dataclass(frozen=True)
class Stribeck(JointEffect):
    """Dry friction that is higher at rest: tau = -(c + (s - c) / (1 + (qd/v)^2)) qd / sqrt(qd^2 + width^2).

    Source: D. P. Hess, A. Soom, "Friction at a lubricated line contact operating at oscillating sliding velocities",
    Journal of Tribology 112 (1990), without its viscous term, which is `Viscous`.

    Args:
        coulomb: c, friction of a moving joint [N m or N], shape [..., n]; None: the friction of the description.
        static: s, friction at rest [N m or N], shape [..., n], at least c.
        velocity: v at which the excess has halved [rad/s or m/s], shape [..., n].
        width: velocity below which it is viscous [rad/s or m/s], a number or [...].
    """

    SHAPES: ClassVar[Shapes] = {"coulomb": ("n",), "static": ("n",), "velocity": ("n",), "width": ()}
    DIVIDING = frozenset({"velocity", "width"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"coulomb": "friction"}
    coulomb: Parameter = None
    static: Parameter = None
    velocity: Parameter = 0.1
    width: Parameter = 1e-2

    def impedances(self, q: Sequence[Number], qd: Sequence[Number], inputs: Inputs) -> Sequence[Impedance]:
        """D = level(qd) / sqrt(qd^2 + width^2)."""
        result = []
        for c, s, v_s, v in zip(self.coulomb, self.static, self.velocity, qd, strict=True):
            ratio = v / v_s
            level = c + (s - c) / (1.0 + ratio * ratio)
            result.append(Impedance(_over_speed(level, v, self.width)))
        return result


@dataclass(frozen=True)
class Spring(JointEffect):
    """A linear spring at every joint: tau = -k (q - rest).

    Args:
        stiffness: k [N m/rad or N/m], shape [..., n].
        rest: position in which it is relaxed [rad or m], shape [..., n].
    """

    SHAPES: ClassVar[Shapes] = {"stiffness": ("n",), "rest": ("n",)}
    SIGNED = frozenset({"rest"})
    stiffness: Parameter
    rest: Parameter = 0.0

    def impedances(self, q: Sequence[Number], qd: Sequence[Number], inputs: Inputs) -> Sequence[Impedance]:
        """K = k about the rest."""
        return [Impedance(0.0, k, r) for k, r in zip(self.stiffness, self.rest, strict=True)]


@dataclass(frozen=True)
class Servo(JointEffect):
    """A position servo that acts continuously: tau = kp (target - q) - kd qd, the input `target` [..., n].

    Unlike a controller, which sees the state once per step, it is part of what is integrated, and the linearly implicit
    integrator keeps it stable at any gain.

    Args:
        kp: stiffness [N m/rad or N/m], shape [..., n].
        kd: damping [N m s/rad or N s/m], shape [..., n].
    """

    SHAPES: ClassVar[Shapes] = {"kp": ("n",), "kd": ("n",)}
    kp: Parameter
    kd: Parameter = 0.0

    def inputs(self, n: int) -> dict[str, int]:
        """The target [n]."""
        return {"target": n}

    def impedances(self, q: Sequence[Number], qd: Sequence[Number], inputs: Inputs) -> Sequence[Impedance]:
        """D = kd, and K = kp about the target."""
        return [Impedance(d, k, x) for k, d, x in zip(self.kp, self.kd, inputs["target"], strict=True)]


@dataclass(frozen=True)
class Limits(JointEffect):
    """Compliant joint limits: tau = -k p (1 + c pd) beyond a limit by the distance p, with pd only while it grows.

    The torque is continuous, never pulls towards the limit, and takes energy out (after K. H. Hunt and F. R. E.
    Crossley, "Coefficient of restitution interpreted as damping in vibroimpact", Journal of Applied Mechanics, 1975).

    Args:
        lower, upper: [rad or m], shape [..., n]; None: those of the robot's description. A joint whose limits are
            infinite numbers has none, and costs nothing.
        stiffness: k [N m/rad or N/m], shape [..., n].
        dissipation: c [s/rad or s/m], shape [..., n].
    """

    SHAPES: ClassVar[Shapes] = {"lower": ("n",), "upper": ("n",), "stiffness": ("n",), "dissipation": ("n",)}
    SIGNED = frozenset({"lower", "upper"})
    UNBOUNDED = frozenset({"lower", "upper"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"lower": "limits.lower", "upper": "limits.upper"}
    lower: Parameter = None
    upper: Parameter = None
    stiffness: Parameter = 1e4
    dissipation: Parameter = 1.0

    def impedances(self, q: Sequence[Number], qd: Sequence[Number], inputs: Inputs) -> Sequence[Impedance]:
        """Beyond a limit K = k about it, and D = k c p while p grows."""
        result = []
        for x, v, low, high, k, c in zip(q, qd, self.lower, self.upper, self.stiffness, self.dissipation, strict=True):
            has_low, has_high = not unbounded(low), not unbounded(high)
            if not (has_low or has_high):
                result.append(Impedance())
                continue
            below = maximum(low - x, 0.0) if has_low else 0.0
            above = maximum(x - high, 0.0) if has_high else 0.0
            outside = (1.0 - at_least(x, low) if has_low else 0.0) + (1.0 - at_least(high, x) if has_high else 0.0)
            deeper = below * at_least(0.0, v) + above * at_least(v, 0.0)
            nearest = clip(x, low, high) if has_low and has_high else x + below - above
            result.append(Impedance(k * c * deeper, k * outside, nearest))
        return result


@dataclass(frozen=True)
class Elastic(JointEffect):
    """Elastic joints: the actuator turns a rotor, and a spring and damper turn the joint.

        J thd' = u - t,   t = k (th - q) + d (thd - qd) acts on the joint

    Source: M. W. Spong, "Modeling and control of elastic joint robots", Journal of Dynamic Systems, Measurement, and
    Control 109 (1987), with the damper added. The state remembers the rotor's position and velocity [2 n].

    Args:
        stiffness: k [N m/rad or N/m], shape [..., n].
        damping: d [N m s/rad or N s/m], shape [..., n].
        inertia: J of the rotor, seen at the joint [kg m^2 or kg], shape [..., n]; None: the robot's rotor inertia.
    """

    SHAPES: ClassVar[Shapes] = {"stiffness": ("n",), "damping": ("n",), "inertia": ("n",)}
    DIVIDING = frozenset({"inertia"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"inertia": "armature"}
    stiffness: Parameter
    damping: Parameter = 0.0
    inertia: Parameter = None

    def memory(self, n: int) -> int:
        """Position and velocity of every rotor."""
        return 2 * n

    def start(self, q: Sequence[Number], qd: Sequence[Number]) -> Sequence[Number]:
        """With the joints: the springs are relaxed."""
        return (*q, *qd)

    def impedances(self, q: Sequence[Number], qd: Sequence[Number], inputs: Inputs) -> Sequence[Impedance]:
        """None: what it does depends on the rotors, and stands between the actuators and the joints."""
        return [Impedance()] * len(q)


def _over_speed(level: Number, v: Number, width: Number) -> Number:
    """level / sqrt(v^2 + width^2)."""
    return level / sqrt(v * v + width * width)
