"""Objects of scenes: free rigid bodies of simple shapes, which robots push, grasp and lift.

An object's frame O is at its centre of mass, which is that of its shape, along the axes of the shape. Its state is the
pose X_WO in the world, or in the base frame of a fixed robot, and the twist V_WO in its axes. Objects touch nothing by
themselves: `effects.Contact` says what touches what.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, ClassVar, Self

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.base.checks import NOT_NEGATIVE, POSITIVE, require_object
from torchdq.dynamics import shapes
from torchdq.dynamics.free_bodies import FreeBody
from torchdq.dynamics.shapes import Nearest
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import Parameter, Parametric, Shapes, undefined
from torchdq.functions.signature import parameter
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot

__all__ = ["Ball", "Box", "Capsule", "Cylinder", "Object"]


@dataclass(frozen=True)
class Object(Parametric):
    """Free rigid body; base of the shapes.

    Args:
        name: by which effects, readings and errors call it.
        mass: [kg], a number or [...].
        inertia: principal moments about the axes of the shape [kg m^2], shape [..., 3]; None: those of a solid body of
            this mass and shape.
    """

    POINTS: ClassVar[int]  # number of `points`
    flat: ClassVar[bool] = False  # whether it has faces and edges
    name: str
    mass: Parameter = field(metadata=parameter(check=POSITIVE))
    inertia: Parameter = field(default=None, metadata=parameter(3, check=POSITIVE), kw_only=True)

    @property
    def SHAPES(self) -> Shapes:  # type: ignore[override]
        """Trailing axes of each parameter that is there."""
        return {name: x.axes for name, x in self.PARAMETERS.items() if getattr(self, name) is not None}

    def described(self, robot: Robot) -> Any:
        """The object itself; raises unless its name is a word."""
        if not isinstance(self.name, str) or not self.name:
            raise ArgumentError(f"name of {type(self).__name__} must be a text, found {self.name!r}")
        return self

    @property
    def shape(self) -> Self:
        """The object without mass and inertia of its own."""
        return replace(self, mass=1.0, inertia=None)

    def posed(self, X_WO: DualQuaternion) -> FreeBody:
        """Body at a pose, while it is recorded."""
        m, moments = self.mass, self.inertia
        return FreeBody(X_WO, m, tuple(m * x for x in self.radii()) if moments is None else moments)

    @property
    def sharp(self) -> bool:
        """Whether its points have no radius."""
        return False

    @property
    def mobility(self) -> Number:
        """Mean mobility of its points, 1/m and what its turning adds [1/kg]."""
        moments, points = self.posed(dq.ONE).moments, [p for p, _ in self.points()]
        levers = [sum(p[(k + j) % 3] * p[(k + j) % 3] for p in points for j in (1, 2)) for k in range(3)]
        turning = sum([lever / i for lever, i in zip(levers, moments, strict=True)], 0.0)
        return 1.0 / self.mass + turning / (3.0 * len(points))

    @property
    def isotropic(self) -> bool:
        """Whether its inertia is a constant, or that of its mass, and the same about all axes."""
        moments = self.radii() if self.inertia is None else self.inertia
        return all(isinstance(x, float) and x == moments[0] for x in moments)

    def radii(self) -> Pure:
        """Squares of the radii of gyration of a solid body of this shape [m^2]."""
        raise undefined(self, "radii")

    def points(self) -> Sequence[tuple[Pure, Number]]:
        """Centres and radii of the spheres by which it touches the ground, in O."""
        raise undefined(self, "points")

    def nearest(self, p: Pure) -> Nearest:
        """Surface where it is nearest to a point p in O."""
        raise undefined(self, "nearest")


@dataclass(frozen=True)
class Box(Object):
    """Solid box.

    Args:
        name, mass, inertia: as of `Object`.
        size: lengths along its axes [m], shape [..., 3].
        rounding: radius of its edges and corners [m], less than half of each length, a number or [...].

    >>> import torchdq
    >>> cube = torchdq.objects.Box("cube", mass=0.1, size=(0.04, 0.04, 0.04))
    """

    POINTS, flat = 8, True
    size: Parameter = field(metadata=parameter(3, check=POSITIVE), kw_only=True)
    rounding: Parameter = field(default=0.0, metadata=parameter(check=NOT_NEGATIVE), kw_only=True)

    @property
    def sharp(self) -> bool:
        """Whether its corners are not rounded."""
        return isinstance(self.rounding, float | int) and self.rounding == 0

    @property
    def half(self) -> Pure:
        """Half of its lengths."""
        return tuple(0.5 * x for x in self.size)

    def radii(self) -> Pure:
        """Squares of the radii of gyration."""
        x, y, z = (a * a / 3.0 for a in self.half)
        return y + z, x + z, x + y

    def points(self) -> list[tuple[Pure, Number]]:
        """The corners."""
        inner = [a - self.rounding for a in self.half]
        return [(tuple(s * x for s, x in zip(signs, inner, strict=True)), self.rounding) for signs in SIGNS]

    def nearest(self, p: Pure) -> Nearest:
        """Surface where it is nearest to a point."""
        return shapes.box(self.half, self.rounding, p)


@dataclass(frozen=True)
class Ball(Object):
    """Solid ball.

    Args:
        name, mass, inertia: as of `Object`.
        radius: [m], a number or [...].
    """

    POINTS = 1
    radius: Parameter = field(metadata=parameter(check=POSITIVE), kw_only=True)

    def radii(self) -> Pure:
        """Squares of the radii of gyration."""
        return (0.4 * (self.radius * self.radius),) * 3

    def points(self) -> list[tuple[Pure, Number]]:
        """The ball itself."""
        return [(quat.ZERO, self.radius)]

    def nearest(self, p: Pure) -> Nearest:
        """Surface where it is nearest to a point."""
        return shapes.ball(self.radius, p)


@dataclass(frozen=True)
class Capsule(Object):
    """Solid capsule about its z axis.

    Args:
        name, mass, inertia: as of `Object`.
        radius: [m], a number or [...].
        length: between the centres of its end spheres [m], a number or [...].
    """

    POINTS = 2
    radius: Parameter = field(metadata=parameter(check=POSITIVE), kw_only=True)
    length: Parameter = field(metadata=parameter(check=POSITIVE), kw_only=True)

    def radii(self) -> Pure:
        """Squares of the radii of gyration."""
        r, h = self.radius, 0.5 * self.length
        ends = 4.0 * r / (4.0 * r + 6.0 * h)  # share of the mass
        middle, rr = 1.0 - ends, r * r
        across = middle * (0.25 * rr + h * h / 3.0) + ends * (0.4 * rr + h * h + 0.75 * (r * h))
        return across, across, middle * (0.5 * rr) + ends * (0.4 * rr)

    def points(self) -> list[tuple[Pure, Number]]:
        """The end spheres."""
        return [((0.0, 0.0, s * self.length), self.radius) for s in (-0.5, 0.5)]

    def nearest(self, p: Pure) -> Nearest:
        """Surface where it is nearest to a point."""
        return shapes.capsule(self.radius, 0.5 * self.length, p)


@dataclass(frozen=True)
class Cylinder(Object):
    """Solid cylinder about its z axis; it touches the ground by four points of each rim.

    Args:
        name, mass, inertia: as of `Object`.
        radius: [m], a number or [...].
        length: [m], a number or [...].
    """

    POINTS, flat, sharp = 8, True, True
    radius: Parameter = field(metadata=parameter(check=POSITIVE), kw_only=True)
    length: Parameter = field(metadata=parameter(check=POSITIVE), kw_only=True)

    def radii(self) -> Pure:
        """Squares of the radii of gyration."""
        r, length = self.radius * self.radius, self.length * self.length
        across = 0.25 * r + length / 12.0
        return across, across, 0.5 * r

    def points(self) -> list[tuple[Pure, Number]]:
        """Four points of each rim."""
        r, h = self.radius, 0.5 * self.length
        return [((x * r, y * r, z * h), 0.0) for z in (-1.0, 1.0) for x, y in RIM]

    def nearest(self, p: Pure) -> Nearest:
        """Surface where it is nearest to a point."""
        return shapes.cylinder(self.radius, 0.5 * self.length, p)


SIGNS = tuple(product((-1.0, 1.0), repeat=3))
RIM = ((-1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (1.0, 0.0))


def resolved(objects: Sequence[Object], robot: Robot) -> tuple[Object, ...]:
    """Objects with checked numbers; raises if their names are not those of different things."""
    if isinstance(objects, Object) or not isinstance(objects, Sequence):
        raise ArgumentError(f"objects must be a sequence of objects, found {objects!r}; write objects=(Box(...),)")
    for body in objects:
        require_object("objects", body, Object, "torchdq.objects", "Box('cube', mass=0.1, size=(0.04, 0.04, 0.04))")
    names = [*require_robot(robot).frame_names, *(body.name for body in objects)]
    for name, number in Counter(names).items():
        if number > 1 and any(body.name == name for body in objects):
            raise ArgumentError(f"names of objects must differ, also from those of frames, found {name!r} twice")
    return tuple(body.resolved(robot) for body in objects)
