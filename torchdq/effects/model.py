"""Model effects: rigid bodies, rotors and gravity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

from torchdq.algebra.inertia import RigidBody
from torchdq.algebra.quaternion import Number
from torchdq.base.checks import REAL, tensor_of
from torchdq.dynamics.tree import BASE
from torchdq.effects.effect import Effect, on_a_link
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import Parameter, undefined
from torchdq.functions.posed import Overrides, constant_pose
from torchdq.functions.posed import field as row_of
from torchdq.functions.signature import parameter
from torchdq.robot import Robot
from torchdq.robot.arrays import matrices
from torchdq.robot.check.consistency import require_body
from torchdq.robot.robot import GRAVITY


@dataclass(frozen=True)
class ModelEffect(Effect):
    """Change of the robot's parameters."""

    SLOT: ClassVar[str] = "model"
    LATE: ClassVar[bool] = False  # whether it acts after all other model effects

    def changed(self, robot: Robot, overrides: Overrides) -> dict[str, Sequence[Number]]:
        """Rows of the changed tensors of the robot; `overrides` are those of earlier effects."""
        raise undefined(self, "changed")


@dataclass(frozen=True)
class Gravity(ModelEffect):
    """Uniform gravity: f = m g at the centre of mass of every body.

    Args:
        acceleration: g in the base frame [m/s^2], shape [..., 3]; None: that of the robot, or 9.81 downwards. For a
            tilted base, tilt the vector.
    """

    ONCE = "there is one acceleration"
    acceleration: Parameter = field(default=None, metadata=parameter(3, check=REAL, described="gravity"))

    def described(self, robot: Robot) -> Self:
        """Copy with the robot's gravity, or 9.81 downwards if it has none."""
        found = super().described(robot)
        return replace(found, acceleration=GRAVITY) if found.acceleration is None else found

    def changed(self, robot: Robot, overrides: Overrides) -> dict[str, Sequence[Number]]:
        """The acceleration."""
        return {"gravity": self.acceleration}


@dataclass(frozen=True)
class RotorInertia(ModelEffect):
    """Rotor inertia reflected to the joints, added to the diagonal of the mass matrix.

        (M(q) + diag(J)) qdd + c(q, qd) + g(q) = tau

    Args:
        inertia: J [kg m^2 or kg], shape [..., n]; None: that of the robot's description.
    """

    inertia: Parameter = field(default=None, metadata=parameter("n", described="armature"))

    def changed(self, robot: Robot, overrides: Overrides) -> dict[str, Sequence[Number]]:
        """Rotor inertia, added to that of earlier effects."""
        before = overrides.get("armature")
        if before is None:
            return {"armature": self.inertia}
        return {"armature": tuple(a + b for a, b in zip(before, self.inertia, strict=True))}


@dataclass(frozen=True)
class Payload(ModelEffect):
    """Rigid body attached to a frame and merged with its link; `MassScale` does not change it.

        m = m_l + m_p,   m c = m_l c_l + m_p c_p

    m_l and c_l are mass and centre of mass of the link; inertias add about the common centre of mass c. For a payload
    that is the same in every sample, `Robot.with_payload` is equivalent.

    Args:
        mass: m_p [kg], a number or [...].
        com: c_p, its centre of mass in the frame [m], shape [..., 3].
        inertia: about its centre of mass, axes of the frame [kg m^2], shape [..., 6]: xx xy yy xz yz zz.
        frame: name of the frame; None: the robot's end effector.
    """

    LATE = True
    mass: Parameter = field(metadata=parameter())
    com: Parameter = field(default=0.0, metadata=parameter(3, check=REAL))
    inertia: Parameter = field(default=0.0, metadata=parameter(6, check=REAL))
    frame: str | None = None

    def described(self, robot: Robot) -> Self:
        """Copy with the frame named."""
        named = on_a_link(self, robot)
        if robot.frame(named.frame).link == BASE:
            raise ArgumentError(
                f"frame of Payload must be on a link, found {named.frame!r} on the base; use robot.with_payload"
            )
        return named

    def resolved(self, robot: Robot) -> Self:
        """Copy for a robot; raises unless mass and inertia, if they are not learned, are physically consistent."""
        whole = super().resolved(robot)
        require_body("Payload", tensor_of(whole.mass), matrices(tensor_of(whole.inertia)))
        return whole

    def changed(self, robot: Robot, overrides: Overrides) -> dict[str, Sequence[Number]]:
        """Inertial parameters, those of one link merged with the payload."""
        frame = robot.frame(str(self.frame))
        i, held = frame.link, RigidBody(self.mass, self.com, self.inertia).moved(constant_pose(frame.X_BF))
        masses, coms, inertias = (list(row_of(robot, name, overrides)) for name in ("mass", "com", "inertia"))
        share = self.mass / (masses[i] + self.mass)
        masses[i], coms[i], inertias[i] = RigidBody(masses[i], coms[i], inertias[i]).plus(held, share)
        return {"mass": masses, "com": flat(coms), "inertia": flat(inertias)}


@dataclass(frozen=True)
class MassScale(ModelEffect):
    """Scaled link masses: mass and inertia times a factor, centres of mass unchanged.

        m = k m_0,   I = k I_0

    Payloads are not scaled, in any order of the effects. A tensor [batch, links] gives every sample its own masses, all
    physically consistent.

    Args:
        factor: k, shape [..., links].
    """

    factor: Parameter = field(metadata=parameter("links"))

    def changed(self, robot: Robot, overrides: Overrides) -> dict[str, Sequence[Number]]:
        """Masses and inertias of the links times their factors."""
        mass, inertia = row_of(robot, "mass", overrides), row_of(robot, "inertia", overrides)
        return {
            "mass": [k * m for k, m in zip(self.factor, mass, strict=True)],
            "inertia": [k * x for k, row in zip(self.factor, inertia, strict=True) for x in row],
        }


def flat(rows: Sequence[Sequence[Number]]) -> list[Number]:
    """Rows one after the other."""
    return [x for row in rows for x in row]
