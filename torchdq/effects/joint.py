"""Effects at the joints: friction, springs, servos, limits.

A joint effect is an impedance: the torque -D qd - f(q) with a damping D >= 0 that may depend on the state, and a force
f of stiffness K = df/dq >= 0. In this form a linearly implicit integrator can use velocity and position at the end of
the step, with D and K at its start: however large the stiffness, the torque cannot overshoot, and friction cannot
reverse a motion. Explicit integrators evaluate the torque itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import torch

from torchdq.algebra.quaternion import Number
from torchdq.checks import tensor_of
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Effect, Inputs, Parameter, Shapes, unbounded
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import absolute, at_least, maximum, minimum, sqrt
from torchdq.program.transforms import without_values
from torchdq.robot import Robot

TOUCHING = 2.0**-126  # smallest normal number of float32: a limit acts from this force on [N m or N]


class Impedance(NamedTuple):
    """Torque -D qd - f of one joint, whose force f has the stiffness K = df/dq."""

    damping: Number = 0.0  # D >= 0 [N m s/rad or N s/m]
    force: Number = 0.0  # f [N m or N]
    stiffness: Number = 0.0  # K >= 0 where active [N m/rad or N/m]
    active: Number = 1.0  # 1, or 0 where there is no stiffness

    def damping_at_end(self, h: Number) -> Number:
        """D + h K: damping of an implicit step h, at whose end the force is f + h K qd."""
        return self.damping + (h * self.stiffness) * self.active


def spring(k: Number, stretch: Number, damping: Number = 0.0) -> Impedance:
    """Impedance of a linear spring k with a stretch, and of a damper in parallel."""
    return Impedance(damping, k * stretch, k)


@dataclass(frozen=True)
class JointEffect(Effect):
    """A torque at every joint that depends on the state of that joint alone."""

    SLOT: ClassVar[str] = "joint"
    ORDERED: ClassVar[tuple[str, ...]] = ()  # two parameters, of which the first must not be above the second

    def resolved(self, robot: Robot) -> Self:
        """Copy for a robot; raises unless parameters that have an order are in it."""
        whole = super().resolved(robot)
        if self.ORDERED:
            low, high = self.ORDERED
            if wrong := crossed(getattr(whole, low), getattr(whole, high), robot):
                raise ArgumentError(f"{low} of {type(self).__name__} must not be above {high}, found {wrong}")
        return whole

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedance of every joint in a state."""
        raise NotImplementedError


@dataclass(frozen=True)
class Viscous(JointEffect):
    """Viscous friction: tau = -d qd.

    Args:
        coefficient: d [N m s/rad or N s/m], shape [..., n]; None: the damping of the robot's description.
    """

    SHAPES: ClassVar[Shapes] = {"coefficient": ("n",)}
    SCALES = ("coefficient",)
    DESCRIBED: ClassVar[Mapping[str, str]] = {"coefficient": "damping"}
    coefficient: Parameter = None

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances with D = d."""
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
    SCALES = ("level",)
    DIVIDING = frozenset({"width"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"level": "friction"}
    level: Parameter = None
    width: Parameter = 1e-2

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances with D = level / sqrt(qd^2 + width^2)."""
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
    ORDERED = ("coulomb", "static")
    SCALES = ("coulomb", "static")
    DIVIDING = frozenset({"velocity", "width"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"coulomb": "friction"}
    coulomb: Parameter = None
    static: Parameter = None
    velocity: Parameter = 0.1
    width: Parameter = 1e-2

    def idle(self) -> tuple[str, ...]:
        """Friction parameters, if both are zero."""
        both = super().idle() and isinstance(self.static, tuple) and not any(self.static)
        return ("coulomb", "static") if both else ()

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances with D = level(qd) / sqrt(qd^2 + width^2)."""
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

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances with f = k (q - rest)."""
        return [spring(k, x - r) for k, r, x in zip(self.stiffness, self.rest, q, strict=True)]


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

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances with D = kd, f = kp (q - target)."""
        return [spring(k, x - r, d) for k, d, r, x in zip(self.kp, self.kd, inputs["target"], q, strict=True)]


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
    ORDERED = ("lower", "upper")
    SIGNED = frozenset({"lower", "upper"})
    UNBOUNDED = frozenset({"lower", "upper"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"lower": "limits.lower", "upper": "limits.upper"}
    lower: Parameter = None
    upper: Parameter = None
    stiffness: Parameter = 1e4
    dissipation: Parameter = 1.0

    def free_range(self) -> tuple[Parameter, Parameter]:
        """The limits."""
        return self.lower, self.upper

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances with f = k e, e the signed distance beyond a limit; K = k for e not 0, D = c |f| while e grows."""
        result = []
        for x, v, low, high, k, c in zip(q, qd, self.lower, self.upper, self.stiffness, self.dissipation, strict=True):
            above_low = x if unbounded(low) else maximum(x, low)
            nearest = above_low if unbounded(high) else minimum(above_low, high)
            force = k * (x - nearest)
            if isinstance(force, float) and force == 0.0:
                result.append(Impedance())
                continue
            size = absolute(force)
            growing = at_least(force * v, 0.0)
            result.append(Impedance(c * (size * growing), force, k, at_least(size, TOUCHING)))
        return result


def crossed(lower: Parameter, upper: Parameter, robot: Robot) -> str:
    """Words for the first joint whose lower value is above the upper one; "" if there is none, or none can be read."""
    if isinstance(lower, tuple) and isinstance(upper, tuple):
        pairs = zip(robot.joint_names, lower, upper, strict=True)
        return next((f"{a:g} and {b:g} at joint {joint!r}" for joint, a, b in pairs if a > b), "")
    low, high = (tensor_of(x).detach() for x in (lower, upper))
    if without_values((low,)) or without_values((high,)):
        return ""
    low, high = torch.broadcast_tensors(*(x.to("cpu", torch.float64) for x in (low, high)))
    if not bool((low > high).any()):
        return ""
    at = tuple((low > high).nonzero()[0].tolist())
    return f"{float(low[at]):g} and {float(high[at]):g} at joint {robot.joint_names[at[-1]]!r}"


def _over_speed(level: Number, v: Number, width: Number) -> Number:
    """Quotient level / sqrt(v^2 + width^2)."""
    return level / sqrt(v * v + width * width)
