"""Joint effects: springs, servos, limits; friction is in `friction`.

A joint effect is an impedance: the torque -D qd - f(q) with a damping D >= 0 that may depend on the state, and a force
f of stiffness K = df/dq >= 0. In this form a linearly implicit integrator can use velocity and position at the end of
the step, with D and K at its start: however large the stiffness, the torque cannot overshoot, and friction cannot
reverse a motion. Explicit integrators evaluate the torque itself.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple, Self

import torch

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import REAL, Interval, tensor_of
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Effect, Inputs, unbounded
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import Parameter, undefined
from torchdq.functions.signature import parameter
from torchdq.numbers.functions import absolute, at_least, maximum, minimum
from torchdq.program.transforms import without_values
from torchdq.robot import Robot

TOUCHING = 2.0**-126  # smallest normal number of float32: least force of an active limit [N m or N]
LARGEST = 2.0**60  # what stands for an infinite limit of a servo, so that no quotient is inf / inf [N m or N]


class Impedance(NamedTuple):
    """Torque -(D + g |load|) qd - f of one joint, whose force f has the stiffness K = df/dq.

    The load is the torque that accelerates the bodies and the rotor: the sum of all torques on the joint.
    """

    damping: Number = 0.0  # D >= 0 [N m s/rad or N s/m]
    force: Number = 0.0  # f [N m or N]
    stiffness: Number = 0.0  # K >= 0 where active [N m/rad or N/m]
    active: Number = 1.0  # 1, or 0 where there is no stiffness
    per_load: Number = 0.0  # g >= 0, with g |qd| < 1 [s/rad or s/m]

    def damping_at_end(self, h: Number) -> Number:
        """D + h K: damping of an implicit step h, at whose end the force is f + h K qd."""
        return self.damping + (h * self.stiffness) * self.active

    def limited(self, most: Number, qd: Number, h: Number) -> Impedance:
        """Impedance scaled so that its torque at the end of a step h, with the velocity qd, is at most `most`."""
        most = minimum(most, LARGEST)
        s = most / maximum(absolute(self.force + self.damping_at_end(h) * qd), most)
        return Impedance(s * self.damping, s * self.force, s * self.stiffness)


def spring(k: Number, stretch: Number, damping: Number = 0.0) -> Impedance:
    """Impedance of a linear spring k with a stretch, and of a damper in parallel."""
    return Impedance(damping, k * stretch, k)


def total(impedances: Sequence[Impedance], h: Number = 0.0) -> tuple[Number, Number, Number]:
    """Sums of D + h K, f and g of the impedances of one joint."""
    D = sum((z.damping_at_end(h) for z in impedances), 0.0)
    return D, sum((z.force for z in impedances), 0.0), sum((z.per_load for z in impedances), 0.0)


def load_size(torque: Number, g: Number, qd: Number) -> Number:
    """Absolute value of the load = torque - g |load| qd of a joint; `torque` is the sum of all other torques."""
    if isinstance(g, float) and g == 0.0:
        return 0.0  # not used
    m = g * qd
    return (absolute(torque) - m * torque) / (1.0 - m * m)


@dataclass(frozen=True)
class JointEffect(Effect):
    """Torque at every joint as a function of the state of that joint."""

    SLOT: ClassVar[str] = "joint"
    ORDERED: ClassVar[tuple[str, ...]] = ()  # two parameters in increasing order

    def resolved(self, robot: Robot) -> Self:
        """Copy for a robot; raises unless the parameters in `ORDERED` increase."""
        whole = super().resolved(robot)
        if self.ORDERED:
            low, high = self.ORDERED
            if wrong := _out_of_order(getattr(whole, low), getattr(whole, high), robot):
                raise ArgumentError(f"{low} of {type(self).__name__} must not be above {high}, found {wrong}")
        return whole

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedance of every joint in a state."""
        raise undefined(self, "impedances")

    def impedances_at_end(self, q: Row, qd: Row, inputs: Inputs, memory: Row, h: Number) -> Sequence[Impedance]:
        """Impedances of an effect with memory, at the end of an implicit step h; h = 0: now."""
        return self.impedances(q, qd, inputs)

    def memory_rates(self, q: Row, qd: Row, inputs: Inputs, memory: Row, ends: Row, h: Number) -> Row:
        """Mean rates of the memory over that step, with the velocities `ends` at its end."""
        return ()


@dataclass(frozen=True)
class Spring(JointEffect):
    """Linear spring at every joint: tau = -k (q - rest).

    Args:
        stiffness: k [N m/rad or N/m], shape [..., n].
        rest: equilibrium position [rad or m], shape [..., n].
    """

    stiffness: Parameter = field(metadata=parameter("n"))
    rest: Parameter = field(default=0.0, metadata=parameter("n", check=REAL))

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances with f = k (q - rest)."""
        return [spring(k, x - r) for k, r, x in zip(self.stiffness, self.rest, q, strict=True)]


@dataclass(frozen=True)
class Servo(JointEffect):
    """Continuous position servo: tau = kp (target - q) - kd qd, with the input `target` [..., n].

    Unlike a controller, which samples the state once per step, it is part of the integrated equations, so that the
    linearly implicit integrator keeps it stable at any gain. A limit scales kp and kd of a joint over a step h by a
    factor s that follows from the state at its start.

        s = min(1, limit / |kp (target - q - h qd) - kd qd|)

    Explicit integrators, whose h is 0 here, keep the limit exactly. An implicit step takes the torque at its end, which
    may exceed the limit by s (kd + h kp) times the change of qd over the step: where others accelerate the joint, as a
    blow does; the servo itself only makes its torque smaller.

    Args:
        kp: stiffness [N m/rad or N/m], shape [..., n].
        kd: damping [N m s/rad or N s/m], shape [..., n].
        limit: largest torque [N m or N], shape [..., n]; None: infinite, which costs nothing.
    """

    kp: Parameter = field(metadata=parameter("n"))
    kd: Parameter = field(default=0.0, metadata=parameter("n"))
    limit: Parameter = field(default=None, metadata=parameter("n", check=Interval(0.0, open=True, infinite=True)))

    def inputs(self, n: int) -> dict[str, int]:
        """The target [n]."""
        return {"target": n}

    def simulates(self) -> Collection[str]:
        """Limits of the torque, if it has any."""
        return () if all(map(unbounded, self.limit)) else ("limits.effort",)

    def described(self, robot: Robot) -> Self:
        """Copy with an infinite limit instead of None."""
        return replace(self, limit=math.inf) if self.limit is None else self

    def impedances_at_end(self, q: Row, qd: Row, inputs: Inputs, memory: Row, h: Number) -> Sequence[Impedance]:
        """Impedances with D = kd, f = kp (q - target), within the limits."""
        rows = zip(self.kp, self.kd, self.limit, inputs["target"], q, qd, strict=True)
        free = [(spring(k, x - r, d), most, v) for k, d, most, r, x, v in rows]
        return [z if unbounded(most) else z.limited(most, v, h) for z, most, v in free]


@dataclass(frozen=True)
class JointLimits(JointEffect):
    """Compliant joint limits: tau = -k p (1 + c max(pd, 0)), with the distance p beyond a limit.

    The torque is continuous, never attracts to the limit, and dissipates energy (after K. H. Hunt and F. R. E.
    Crossley, "Coefficient of restitution interpreted as damping in vibroimpact", Journal of Applied Mechanics, 1975).

    Args:
        lower, upper: limits [rad or m], shape [..., n]; None: those of the robot's description. Infinite limits are
            absent, and cost nothing.
        stiffness: k [N m/rad or N/m], shape [..., n].
        dissipation: c [s/rad or s/m], shape [..., n].
    """

    ORDERED = ("lower", "upper")
    lower: Parameter = field(
        default=None, metadata=parameter("n", check=Interval(infinite=True), described="limits.lower")
    )
    upper: Parameter = field(
        default=None, metadata=parameter("n", check=Interval(infinite=True), described="limits.upper")
    )
    stiffness: Parameter = field(default=1e4, metadata=parameter("n"))
    dissipation: Parameter = field(default=1.0, metadata=parameter("n"))

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


def _out_of_order(lower: Parameter, upper: Parameter, robot: Robot) -> str:
    """Text for the first joint with a lower value above the upper one; "" if there is none, or values are unknown."""
    low, high = (tensor_of(x).detach() for x in (lower, upper))
    if without_values((low,)) or without_values((high,)):
        return ""
    low, high = torch.broadcast_tensors(*(x.to("cpu", torch.float64) for x in (low, high)))
    if not bool((low > high).any()):
        return ""
    at = tuple((low > high).nonzero()[0].tolist())
    return f"{float(low[at]):g} and {float(high[at]):g} at joint {robot.joint_names[at[-1]]!r}"
