"""Objects of scenes: free rigid bodies of simple shapes, which robots push, grasp and lift.

An object's frame O is at its centre of mass, which is that of its shape, along the axes of the shape. Its state is the
pose X_WO in the world, or in the base frame of a fixed robot, and the twist V_WO in its axes. Objects touch nothing by
themselves: `effects.Contact` says what touches what. `from_mjcf` and `from_urdf` read them from files.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import IO, Any, ClassVar, Self

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import RigidBody
from torchdq.algebra.quaternion import Number, Pure
from torchdq.base.checks import NOT_NEGATIVE, POSITIVE, matching, require_object, tensor_of
from torchdq.dynamics import shapes
from torchdq.dynamics.free_bodies import FreeBody
from torchdq.dynamics.shapes import Nearest
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError, DescriptionError
from torchdq.functions.parametric import Parameter, Parametric, Shapes, undefined
from torchdq.functions.signature import parameter
from torchdq.program.transforms import without_values
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.check.consistency import require_body
from torchdq.robot.contact_points import points_of_shape
from torchdq.robot.description import Shape
from torchdq.robot.mjcf.joints import FREE, joints_of, names_of
from torchdq.robot.mjcf.links import body_of, shapes_of
from torchdq.robot.mjcf.source import compiled
from torchdq.robot.robot import naming

__all__ = ["Ball", "Box", "Capsule", "Cylinder", "Object", "from_mjcf", "from_urdf"]

ROUNDING = 5e-4  # part of a number that is rounding: files are printed with about four digits


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
    inertia: Parameter = field(default=None, metadata=parameter(3, check=POSITIVE, optional=True), kw_only=True)

    @property
    def SHAPES(self) -> Shapes:  # type: ignore[override]
        """Trailing axes of each parameter, without an inertia that is that of a solid body."""
        return self.present()

    def described(self, robot: Robot) -> Any:
        """The object itself; raises unless its name is a word."""
        if not isinstance(self.name, str) or not self.name:
            raise ArgumentError(f"name of {type(self).__name__} must be a text, found {self.name!r}")
        return self

    def resolved(self, robot: Robot) -> Self:
        """Object with checked numbers; raises unless mass and inertia, if they are not learned, are those of a body."""
        whole = super().resolved(robot)
        if whole.inertia is not None:
            moments = tensor_of(whole.inertia)
            require_body(f"{type(self).__name__} {self.name!r}", tensor_of(whole.mass), moments.diag_embed())
        return whole

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

    def resolved(self, robot: Robot) -> Self:
        """Box with checked numbers; raises unless its rounding leaves something of every face."""
        whole = super().resolved(robot)
        rounding = tensor_of(whole.rounding)
        room = 0.5 * tensor_of(whole.size).min(-1).values - rounding
        if not without_values((room,)) and bool(((rounding > 0) & (room < 0)).any()):
            raise ArgumentError(
                f"rounding of Box {self.name!r} must be at most half of its shortest length, found one that is "
                f"{-float(room.min()):.3g} m longer"
            )
        return whole

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
        return [(p, self.rounding) for p in points_of_shape("box", inner)]

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
        return [(p, self.radius) for p in points_of_shape("capsule", (self.radius, 0.5 * self.length))]

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
        return [(p, 0.0) for p in points_of_shape("cylinder", (self.radius, 0.5 * self.length))]

    def nearest(self, p: Pure) -> Nearest:
        """Surface where it is nearest to a point."""
        return shapes.cylinder(self.radius, 0.5 * self.length, p)


def resolved(objects: Sequence[Object], robot: Robot) -> tuple[Object, ...]:
    """Objects with checked numbers; raises if their names are not those of different things."""
    if isinstance(objects, Object) or not isinstance(objects, Sequence):
        raise ArgumentError(f"objects must be a sequence of objects, found {objects!r}; write objects=(Box(...),)")
    for body in objects:
        require_object("objects", body, Object, "torchdq.objects", "Box('cube', mass=0.1, size=(0.04, 0.04, 0.04))")
    moving = [x.name for x in require_robot(robot).frames if robot.floating or x.link != BASE]
    names = [*moving, *(body.name for body in objects)]
    for name, number in Counter(names).items():
        if number > 1 and any(body.name == name for body in objects):
            raise ArgumentError(f"names of objects must differ, also from those of moving frames, found {name!r} twice")
    return tuple(body.resolved(robot) for body in objects)


# --- objects of files ------------------------------------------------------------------------------------------------


def from_mjcf(source: str | PathLike[str] | bytes | IO[Any], bodies: str | Sequence[str] = "*") -> tuple[Object, ...]:
    """Objects of an MJCF file: its bodies with a free joint, with their names, masses [kg] and inertias [kg m^2].

    Each has one geom that touches, a box, a sphere, a capsule or a cylinder, whose centre is the centre of mass and
    whose axes are principal axes of the inertia. They are those of the object, whatever the body's own are. The inertia
    is None where it is that of a solid body. Needs the package `mujoco`.

    `Robot.from_mjcf(source, base="fixed")` is the robot of the same file; its frames say where the bodies are.

    Args:
        source: as of `Robot.from_mjcf`.
        bodies: names or patterns of the bodies.

    Raises:
        MissingLibraryError: mujoco is not installed.
        DescriptionError: MuJoCo cannot compile the file, no body is free, or one of the bodies is no such object.
        UnknownNameError: no free body has such a name.

    >>> cube = '<geom type="box" size="0.02 0.02 0.02" mass="0.1"/>'
    >>> body = f'<body name="cube"><freejoint/>{cube}</body>'
    >>> from_mjcf(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    (Box(name='cube', mass=0.1, inertia=None, size=(0.04, 0.04, 0.04), rounding=0.0),)
    """
    with naming(source):
        of, found = compiled(source), []
        names, shapes = names_of(of, "BODY", of.model.nbody), shapes_of(of)
        free = {names[joint.body]: joint.body for joint in joints_of(of) if joint.kind == FREE}
        if not free:
            raise DescriptionError("objects need bodies with a free joint, found none; add <freejoint/> to them")
        for name in matching("bodies", bodies, free, "body with a free joint"):
            if carried := [names[i] for i in range(of.model.nbody) if of.model.body_parentid[i] == free[name]]:
                raise DescriptionError(
                    f"body {name!r} must carry no others to be an object, found {', '.join(carried)}; read it by "
                    "Robot.from_mjcf, and name the objects by bodies="
                )
            found.append(_object(name, body_of(of, free[name]), shapes[free[name]]))
    return tuple(found)


def from_urdf(source: str | PathLike[str] | bytes | IO[Any]) -> Object:
    """Object of a URDF file without moving joints: the name of its robot, its mass [kg] and its inertia [kg m^2].

    It has one collision element, as a body of `from_mjcf` has one geom.

    Args:
        source: as of `Robot.from_urdf`.

    Raises:
        DescriptionError: the text is not a usable URDF, or no such object.

    >>> inertia = '<inertia ixx="3e-4" iyy="3e-4" izz="3e-4" ixy="0" ixz="0" iyz="0"/>'
    >>> link = f'<inertial><mass value="0.3"/>{inertia}</inertial>'
    >>> link += '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
    >>> from_urdf(f'<robot name="ball"><link name="base">{link}</link></robot>')
    Ball(name='ball', mass=0.3, inertia=None, radius=0.05)
    """
    robot = Robot.from_urdf(source, base="floating")
    with naming(source):
        if robot.n:
            raise DescriptionError(
                f"{robot.name!r} must be one body to be an object, found the joints {', '.join(robot.joint_names)}; "
                "read it by Robot.from_urdf, or make these joints fixed"
            )
        body = RigidBody(*(x.tolist() for x in (robot.base_mass, robot.base_com, robot.base_inertia)))  # type: ignore[union-attr]
        own = ((frame, tuple(frame.X_BF.tolist())) for frame in robot.frames)
        shapes = [
            x._replace(X_FS=dq.mul((tuple(X[:4]), tuple(X[4:])), x.X_FS)) for frame, X in own for x in frame.shapes
        ]
        return _object(robot.name, body, shapes)


def _object(name: str, body: RigidBody, shapes: Sequence[Shape]) -> Object:
    """Object of a body with collision shapes, all in one frame."""
    made: Object
    mass, com, (xx, xy, yy, xz, yz, zz) = body.moved(dq.conj(shapes[0].X_FS) if shapes else dq.ONE)
    match [(shape.kind, shape.size) for shape in shapes]:
        case [("box", half)]:
            made = Box(name, mass, size=tuple(2.0 * x for x in half))
        case [("sphere", (radius,))]:
            made = Ball(name, mass, radius=radius)
        case [("capsule", (radius, half))]:
            made = Capsule(name, mass, radius=radius, length=2.0 * half)
        case [("cylinder", (radius, half))]:
            made = Cylinder(name, mass, radius=radius, length=2.0 * half)
        case others:
            found = ", ".join(kind for kind, _ in others) or "none"
            raise _refused(name, "one collision shape, a box, sphere, capsule or cylinder", found)
    kind, moments, products = shapes[0].kind, (xx, yy, zz), (xy, xz, yz)
    if (off := math.hypot(*com)) > ROUNDING * max(shapes[0].size):
        raise _refused(name, f"its centre of mass at the centre of its {kind}", f"it {off:.4g} m from there")
    if min(moments) <= 0 or max(map(abs, products)) > ROUNDING * max(moments):
        found = "xx {:.4g}, yy {:.4g}, zz {:.4g}, xy {:.4g}, xz {:.4g}, yz {:.4g} kg m^2".format(*moments, *products)
        raise _refused(name, f"positive moments of inertia about the axes of its {kind}, and no products", found)
    solid = [mass * x for x in made.radii()]
    same = all(abs(a - b) <= ROUNDING * b for a, b in zip(moments, solid, strict=True))
    return made if same else replace(made, inertia=moments)


def _refused(name: str, expected: str, found: str) -> DescriptionError:
    return DescriptionError(
        f"body {name!r} must have {expected}, found {found}; describe it by a torchdq.objects.Box, Ball, Capsule or "
        "Cylinder of your own numbers"
    )
