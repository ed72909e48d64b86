"""Effects on the model: rigid bodies, rotors and gravity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from torchdq.algebra import dual_quaternion, screw
from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number
from torchdq.effects.effect import Effect, Parameter, Shapes, on_a_link
from torchdq.robot import Robot
from torchdq.robot.posed import Given, constant_pose, field
from torchdq.robot.robot import GRAVITY


@dataclass(frozen=True)
class ModelEffect(Effect):
    """A change of the robot's own numbers."""

    SLOT: ClassVar[str] = "model"

    def changed(self, robot: Robot, overrides: Given) -> dict[str, Sequence[Number]]:
        """Rows of the robot's tensors that it changes; `overrides` are those of earlier effects."""
        raise NotImplementedError


@dataclass(frozen=True)
class Gravity(ModelEffect):
    """Uniform gravity.

    Args:
        acceleration: g in the base frame [m/s^2], shape [..., 3]; None: the robot's own, or 9.81 downwards. A tilted
            base is a tilted vector.
    """

    SHAPES: ClassVar[Shapes] = {"acceleration": (3,)}
    SIGNED = frozenset({"acceleration"})
    DESCRIBED: ClassVar[Mapping[str, str]] = {"acceleration": "gravity"}
    ONCE = "there is one acceleration"
    acceleration: Parameter = None

    def described(self, robot: Robot) -> Self:
        """Copy with the robot's gravity, or 9.81 downwards if it has none."""
        found = super().described(robot)
        return replace(found, acceleration=GRAVITY) if found.acceleration is None else found

    def changed(self, robot: Robot, overrides: Given) -> dict[str, Sequence[Number]]:
        """Its acceleration."""
        return {"gravity": self.acceleration}


@dataclass(frozen=True)
class RotorInertia(ModelEffect):
    """Inertia of the rotors, seen at the joints, added to the diagonal of the mass matrix.

    Args:
        inertia: [kg m^2 or kg], shape [..., n]; None: that of the robot's description.
    """

    SHAPES: ClassVar[Shapes] = {"inertia": ("n",)}
    DESCRIBED: ClassVar[Mapping[str, str]] = {"inertia": "armature"}
    inertia: Parameter = None

    def changed(self, robot: Robot, overrides: Given) -> dict[str, Sequence[Number]]:
        """Rotor inertia, added to that of earlier effects."""
        before = overrides.get("armature")
        return {"armature": self.inertia if before is None else tuple(_sums(before, self.inertia))}


@dataclass(frozen=True)
class Payload(ModelEffect):
    """A body held by a frame, merged with the link that carries it.

    Args:
        mass: [kg], a number or [...].
        com: its centre of mass in the frame [m], shape [..., 3].
        inertia: about its centre of mass, axes of the frame [kg m^2], shape [..., 6]: xx xy yy xz yz zz.
        frame: name of the frame; None: the robot's end effector.
    """

    SHAPES: ClassVar[Shapes] = {"mass": (), "com": (3,), "inertia": (6,)}
    SIGNED = frozenset({"com", "inertia"})
    mass: Parameter
    com: Parameter = 0.0
    inertia: Parameter = 0.0
    frame: str | None = None

    def described(self, robot: Robot) -> Self:
        """Copy with the frame named."""
        return on_a_link(self, robot)

    def changed(self, robot: Robot, overrides: Given) -> dict[str, Sequence[Number]]:
        """Inertial parameters, those of one link merged with the payload."""
        frame = robot.frame(str(self.frame))
        X_BF = constant_pose(frame.X_BF)
        turn = quat.rotation_columns(X_BF[0])
        i = frame.link
        masses, coms, inertias = (list(field(robot, name, overrides)) for name in ("mass", "com", "inertia"))
        m, c = masses[i], coms[i]
        held = quat.add(dual_quaternion.translation(X_BF), screw.columns_times(turn, self.com))
        xx, xy, yy, xz, yz, zz = self.inertia
        rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        half = [screw.columns_times(turn, row) for row in rows]  # rows of I R^T
        turned = [screw.columns_times(turn, column) for column in zip(*half, strict=True)]  # columns of R I R^T
        total = m + self.mass
        apart = quat.sub(held, c)
        reduced = m * self.mass / total  # reduced mass of two bodies about their common centre of mass
        x, y, z = apart
        shift = (y * y + z * z, -(x * y), x * x + z * z, -(x * z), -(y * z), x * x + y * y)
        own = (turned[0][0], turned[0][1], turned[1][1], turned[0][2], turned[1][2], turned[2][2])
        masses[i] = total
        coms[i] = quat.add(c, quat.scale(self.mass / total, apart))
        inertias[i] = tuple(a + b + reduced * s for a, b, s in zip(inertias[i], own, shift, strict=True))
        return {"mass": masses, "com": flat(coms), "inertia": flat(inertias)}


@dataclass(frozen=True)
class MassScale(ModelEffect):
    """Links that are denser than described: mass and inertia times a factor, centres of mass unchanged.

    A tensor [batch, n] makes every sample its own robot that is still physical.

    Args:
        factor: shape [..., n].
    """

    SHAPES: ClassVar[Shapes] = {"factor": ("n",)}
    factor: Parameter

    def changed(self, robot: Robot, overrides: Given) -> dict[str, Sequence[Number]]:
        """Masses and inertias, scaled."""
        mass, inertia = field(robot, "mass", overrides), field(robot, "inertia", overrides)
        return {
            "mass": [k * m for k, m in zip(self.factor, mass, strict=True)],
            "inertia": [k * x for k, row in zip(self.factor, inertia, strict=True) for x in row],
        }


def flat(rows: Sequence[Sequence[Number]]) -> list[Number]:
    """Rows one after the other."""
    return [x for row in rows for x in row]


def _sums(a: Sequence[Number], b: Sequence[Number]) -> list[Number]:
    """Sums of two rows, entry by entry."""
    return [x + y for x, y in zip(a, b, strict=True)]
