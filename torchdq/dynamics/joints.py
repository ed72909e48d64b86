"""Joint types: their interface for algorithms, and one class for each type.

A joint connects a link B to its parent P. Its screws `columns` span the twists that it allows, V = sum of columns v_k,
and are constant in B. The coordinate of a joint with one degree of freedom is an angle [rad] or a length [m]; the
coordinates of a free joint are the pose of B in P. A fixed joint has no coordinates and no screws; it costs nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw


class Coordinate(NamedTuple):
    """Displacement of a joint from home [rad or m], with the cosine and sine of half of it."""

    value: Number
    cos: Number
    sin: Number


class Joint(Protocol):
    """Interface of a joint type."""

    nq: ClassVar[int]  # number of coordinates
    nv: ClassVar[int]  # number of degrees of freedom
    turns: ClassVar[bool]  # whether its coordinate is an angle
    slides: ClassVar[bool]  # whether its coordinate moves the link along the axis

    @property
    def columns(self) -> tuple[Screw, ...]:
        """Screws of the joint in the link frame, one for each degree of freedom."""

    def motion(self, q: Any) -> DualQuaternion | None:
        """Pose of the link relative to its home pose; None: identity."""

    def rate(self, v: Sequence[Number] | None) -> Screw | None:
        """Twist of the link relative to its parent; None: zero."""

    def project(self, F: Screw) -> tuple[Number, ...]:
        """Generalised forces of a wrench on the link: its power on each column (48)."""


@dataclass(frozen=True)
class Along:
    """Base class of joints with one degree of freedom: motion along a constant screw."""

    nq: ClassVar[int] = 1
    nv: ClassVar[int] = 1
    turns: ClassVar[bool]
    slides: ClassVar[bool]
    screw: Screw  # in the link frame

    @property
    def columns(self) -> tuple[Screw, ...]:
        """Screw of the joint."""
        return (self.screw,)

    def rate(self, v: Sequence[Number] | None) -> Screw | None:
        """Screw times velocity."""
        return None if v is None or v[0] is None else screw.scale(v[0], self.screw)

    def project(self, F: Screw) -> tuple[Number, ...]:
        """Power of the wrench on the screw."""
        return (screw.power(F, self.screw),)  # (48), erratum A1

    @property
    def direction(self) -> Pure:
        """Direction of the axis, of unit length up to rounding."""
        return self.screw[0] if self.turns else self.screw[1]

    @property
    def point(self) -> Pure:
        """Point of the axis closest to the frame's origin."""
        return quat.cross(*self.screw)

    def angle(self, x: Number) -> Number:
        """Rotation about the axis at a displacement [rad]."""
        return x if self.turns else 0.0

    def slide(self, x: Number) -> Number:
        """Translation along the axis at a displacement [m]."""
        return x if self.slides else 0.0


class Revolute(Along):
    """Rotation about a line."""

    turns, slides = True, False

    def motion(self, q: Coordinate) -> DualQuaternion:
        """Pose exp(a q/2) of a unit line a."""
        return screw.exp_revolute(self.screw, q.cos, q.sin)  # (27), erratum 25


class Prismatic(Along):
    """Translation along a direction."""

    turns, slides = False, True

    def motion(self, q: Coordinate) -> DualQuaternion:
        """Pose exp(a q/2) of a = eps l."""
        return screw.exp_prismatic(self.screw[1], q.value)  # (27)


class Helical(Along):
    """Rotation about a line with a proportional translation along it."""

    turns, slides = True, True

    def motion(self, q: Coordinate) -> DualQuaternion:
        """Pose exp(a q/2) of a line with pitch."""
        return screw.exp_helical(self.screw, q.value, q.cos, q.sin)  # (27)

    @property
    def pitch(self) -> Number:
        """Translation per angle [m/rad]."""
        return quat.dot(*self.screw)

    def slide(self, x: Number) -> Number:
        """Translation along the axis at an angle [m]."""
        return self.pitch * x


@dataclass(frozen=True)
class Fixed:
    """Rigid connection."""

    nq: ClassVar[int] = 0
    nv: ClassVar[int] = 0
    turns: ClassVar[bool] = False
    slides: ClassVar[bool] = False
    columns: ClassVar[tuple[Screw, ...]] = ()

    def motion(self, q: Any) -> None:
        """None: the home pose."""

    def rate(self, v: Sequence[Number] | None) -> None:
        """None: no relative twist."""

    def project(self, F: Screw) -> tuple[Number, ...]:
        """No generalised force."""
        return ()


def _unit_screw(k: int) -> Screw:
    x = [1.0 if i == k else 0.0 for i in range(6)]
    return (tuple(x[:3]), tuple(x[3:]))


@dataclass(frozen=True)
class Free:
    """Free motion: the coordinates are a pose, the velocities a twist (angular, linear) in the link frame."""

    nq: ClassVar[int] = 8
    nv: ClassVar[int] = 6
    turns: ClassVar[bool] = False
    slides: ClassVar[bool] = False
    columns: ClassVar[tuple[Screw, ...]] = tuple(_unit_screw(k) for k in range(6))

    def motion(self, q: DualQuaternion) -> DualQuaternion:
        """Pose given by the coordinates."""
        return q

    def rate(self, v: Sequence[Number] | None) -> Screw | None:
        """Velocities as a screw."""
        return None if v is None else (tuple(v[:3]), tuple(v[3:]))

    def project(self, F: Screw) -> tuple[Number, ...]:
        """Moment and force, the order of the velocities."""
        return (*F[1], *F[0])


REVOLUTE, PRISMATIC, HELICAL = "revolute", "prismatic", "helical"  # names of joint types in descriptions
KINDS: dict[str, type[Revolute | Prismatic | Helical]] = {REVOLUTE: Revolute, PRISMATIC: Prismatic, HELICAL: Helical}

Z_AXIS: Pure = (0.0, 0.0, 1.0)


def along_z(joint: Along) -> Along:
    """Joint of the same type whose axis is the z axis of its frame."""
    axis: Screw = (quat.scale(joint.angle(1.0), Z_AXIS), quat.scale(joint.slide(1.0), Z_AXIS))
    return type(joint)(axis)
