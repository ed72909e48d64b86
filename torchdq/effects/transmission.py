"""Transmissions between the actuators and the joints: rigid, or elastic with rotors of their own.

The integrated state is x = (q, rotor positions), v = (qd, rotor velocities). A rigid transmission has no rotors, and
records nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import POSITIVE
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Effect
from torchdq.functions.parametric import Parameter
from torchdq.functions.signature import parameter


class Rotors(NamedTuple):
    """Rotors, with a spring and a damper to each joint."""

    stiffness: Row = ()  # [N m/rad or N/m]
    damping: Row = ()  # [N m s/rad or N s/m]
    inertia: Row = ()  # [kg m^2 or kg]


class Eliminated(NamedTuple):
    """Equations of the joints for an implicit step, after the end velocities of the rotors have been eliminated."""

    inertia: Row  # added to the diagonal of the mass matrix [kg m^2 or kg]
    torques: Row  # on the joints [N m or N]
    rotors: Callable[[Row], Row]  # mean accelerations of the rotors, given those of the joints


@dataclass(frozen=True)
class Transmission(Effect):
    """Transmission from the actuators to the joints; the default is rigid."""

    SLOT: ClassVar[str] = "joint"
    ONCE: ClassVar[str] = "a joint has one spring to its rotor"

    def extended(self, q: Row, qd: Row, memory: Row) -> tuple[Row, Row]:
        """Positions and velocities of the joints and then of the rotors."""
        return q, qd

    def rotors(self) -> Rotors:
        """Rotors of all joints; none if they are rigid."""
        return Rotors()

    def torques(self, u: Row, x: Row, v: Row) -> Row:
        """Torques on the joints, of the actuators' torques u."""
        return u

    def accelerations(self, u: Row, passed: Row) -> Row:
        """Accelerations of the rotors under the torques `passed` to the joints."""
        return ()

    def eliminated(self, u: Row, x: Row, v: Row, h: Number) -> Eliminated:
        """Equations of the joints for a step h at whose end the transmission acts."""
        return Eliminated((0.0,) * len(u), u, lambda qdd: ())


@dataclass(frozen=True)
class Elastic(Transmission):
    """Elastic joints: a rotor drives each joint through a spring and a damper.

        J thd' = u - t,   t = k (th - q) + d (thd - qd)

    The torque t acts on the joint.

    Source: M. W. Spong, "Modeling and control of elastic joint robots", Journal of Dynamic Systems, Measurement, and
    Control 109 (1987), with the damper added. The states are position and velocity of the rotors [2 n].

    Args:
        stiffness: k [N m/rad or N/m], shape [..., n].
        damping: d [N m s/rad or N s/m], shape [..., n].
        inertia: J of the rotor, reflected to the joint [kg m^2 or kg], shape [..., n]; None: the robot's rotor inertia.
    """

    SOLE: ClassVar[Mapping[str, str]] = {
        "armature": "the rotor inertia of the description; behind a spring it does not turn with the link"
    }
    stiffness: Parameter = field(metadata=parameter("n"))
    damping: Parameter = field(default=0.0, metadata=parameter("n"))
    inertia: Parameter = field(default=None, metadata=parameter("n", check=POSITIVE, described="armature"))

    def memory(self, n: int) -> int:
        """Position and velocity of every rotor."""
        return 2 * n

    def start(self, q: Row, qd: Row) -> Row:
        """Position and velocity of every rotor, equal to those of its joint: the spring is relaxed."""
        return (*q, *qd)

    def extended(self, q: Row, qd: Row, memory: Row) -> tuple[Row, Row]:
        """Joints, and the rotors from the memory."""
        n = len(q)
        return (*q, *memory[:n]), (*qd, *memory[n:])

    def rotors(self) -> Rotors:
        """Rotors of all joints."""
        return Rotors(self.stiffness, self.damping, self.inertia)

    def torques(self, u: Row, x: Row, v: Row) -> Row:
        """Torques of the springs and dampers, t = k (th - q) + d (thd - qd)."""
        n = len(u)
        return [
            k * (x[n + i] - x[i]) + d * (v[n + i] - v[i])
            for i, (k, d) in enumerate(zip(self.stiffness, self.damping, strict=True))
        ]

    def accelerations(self, u: Row, passed: Row) -> Row:
        """Accelerations of the rotors, thd' = (u - t) / J."""
        return [(u_i - t) / J for u_i, t, J in zip(u, passed, self.inertia, strict=True)]

    def eliminated(self, u: Row, x: Row, v: Row, h: Number) -> Eliminated:
        """Equations of the joints for springs at the end of a step, with rotor velocities w' = (b + s qd') / a.

        s = h (d + h k),   a = J + s,   b = J w + h (u - k (th - q));   t = k (th - q) + (s/h) (w' - qd')
        """
        n = len(u)
        inertia, torques, coefficients = [], [], []
        for i, (k, d, J) in enumerate(zip(self.stiffness, self.damping, self.inertia, strict=True)):
            s = h * (d + h * k)
            a = J + s
            pull = k * (x[n + i] - x[i])
            b = J * v[n + i] + h * (u[i] - pull)
            inertia.append(s * J / a)
            torques.append(pull + (s * b / a - s * J / a * v[i]) / h)
            coefficients.append((a, b, s))

        def rotors(qdd: Row) -> Row:
            ends = [v_i + h * a_i for v_i, a_i in zip(v, qdd, strict=False)]
            return [((b + s * e) / a - w) / h for (a, b, s), e, w in zip(coefficients, ends, v[n:], strict=True)]

        return Eliminated(inertia, torques, rotors)
