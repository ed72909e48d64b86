"""Body effects: wrenches of the environment on links; contact is in `contact`.

A wrench acts as it is at the start of a step. A force on a point may be an impedance instead, as those of joints are:
a linearly implicit integrator then takes it at the velocity of the point at the end of the step, and however large the
coefficients are, the force cannot overshoot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, Self

from torch import Tensor

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.base.checks import POSITIVE, REAL, OneOf
from torchdq.dynamics.free_bodies import Pair
from torchdq.dynamics.point_mass import PointMass
from torchdq.dynamics.posed import Point, Row
from torchdq.effects.effect import Effect, Inputs, on_a_link
from torchdq.functions.parametric import Parameter, undefined
from torchdq.functions.posed import frame
from torchdq.functions.signature import option, parameter
from torchdq.numbers.functions import sqrt
from torchdq.objects import Object
from torchdq.robot import Robot


class PointImpedance(NamedTuple):
    """Force f - (D + E n n^T) (u' - u) on a point of a link, whose velocity is u now and u' at the end of a step.

    D >= 0 and D + E >= 0 are as at the start of the step, so that it has one solution, which loses energy.
    """

    link: int
    point: Pure  # in link axes, as all vectors here [m]
    force: Pure  # f [N]
    damping: Number  # D [N s/m]
    normal: Pure | None = None  # n; None: E is zero
    along: Number = 0.0  # E [N s/m]
    moment: Pure | None = None  # about the point, now; None: zero [N m]
    spin: Number = 0.0  # rotational damping of that moment, the same about all axes, not negative [N m s/rad]
    # memory at the end of the step, of u' and of the angular velocity then, relative as u' is; None: there is none
    kept: Callable[[Pure, Pure], Sequence[Number]] | None = None
    # body on which the opposite force acts, and to which u is relative, if `link` is an object; None: the world
    against: int | None = None

    @property
    def wrench(self) -> Screw:
        """Wrench about the origin of the link, at the velocity u."""
        moment = quat.cross(self.point, self.force)
        return self.force, moment if self.moment is None else quat.add(self.moment, moment)

    def mass(self, h: Number) -> PointMass:
        """Masses that a step h adds for it."""
        return PointMass(
            self.link, self.point, h * self.damping, self.normal, h * self.along, h * self.spin, self.against
        )


class Bodies(NamedTuple):
    """Links of a posed robot, and objects, in motion; points, twists and wrenches are in the frames of `posed`."""

    robot: Robot
    posed: Any  # a `Posed`, in a scene with objects `WithFreeBodies`
    V: Sequence[Screw] = ()  # twists of the links
    objects: Mapping[str, tuple[int, Object]] = {}  # by name, with their links
    relative: Mapping[Pair, Screw] = {}  # twists of objects relative to what touches them

    def moving(self, v: Row) -> Self:
        """The bodies with the twists of velocities in the order of the dynamics."""
        seen = self.posed.seen if self.objects else ()
        return self._replace(V=self.posed.twists(v), relative={pair: self.posed.relative(pair, v) for pair in seen})

    def frame(self, name: str) -> tuple[int, Point]:
        """Link of a frame, and the frame's origin and axes on it."""
        link, X_BF = frame(self.robot, name)
        return link, self.posed.point(link, X_BF)

    def point(self, name: str, center: Pure) -> tuple[int, Pure]:
        """Link of a frame, and a point given in the frame on it."""
        link, X_BF = frame(self.robot, name)
        return link, self.posed.point(link, dq.mul(X_BF, dq.from_pose(quat.ONE, center))).position

    def velocity(self, i: int, r: Pure, against: int | None = None) -> Pure:
        """Velocity of a point of a link, in link axes; that of an object may be relative to what touches it."""
        w, v = self.twist(i, against)
        return quat.add(v, quat.cross(w, r))

    def twist(self, i: int, against: int | None = None) -> Screw:
        """Twist of a link; that of an object may be relative to what touches it."""
        return self.V[i] if against is None else self.relative[i, against]


@dataclass(frozen=True)
class BodyEffect(Effect):
    """Wrench on one or more links, impedances of points, or both."""

    SLOT: ClassVar[str] = "body"

    def wrenches(self, bodies: Bodies, inputs: Inputs) -> dict[int, Screw]:
        """Wrenches (force, moment) by link number, in and about the frames of `bodies`."""
        if type(self).impedances is BodyEffect.impedances:
            raise undefined(self, "wrenches or impedances")
        return {}

    def impedances(self, bodies: Bodies, inputs: Inputs, memory: Row, h: Number) -> Sequence[PointImpedance]:
        """Impedances of points over a step h, in addition to the wrenches; h = 0: forces now."""
        return ()

    def pairs(self, robot: Robot, objects: Mapping[str, int]) -> Sequence[Pair]:
        """Pairs of bodies between which it has impedances: an object and what touches it, by their links."""
        return ()

    def places(self, bodies: Bodies) -> Sequence[Number]:
        """Places at which torch looks up its computed row before a step, as numbers of the pose."""
        return ()

    def looked_up(self, places: Tensor) -> Tensor:
        """Computed row at those places."""
        return places


@dataclass(frozen=True)
class Push(BodyEffect):
    """External wrench on a frame, an optional input of every step.

        tau = J^T F

    F is the wrench, and J the Jacobian of the frame.

    Args:
        frame: name of the frame; None: the robot's end effector.
        axes: "world": force and moment in base axes, or in world axes for a floating base; "body": in frame axes. Both
            are about the frame's origin.
        name: name of the input, shape [..., 6] [N, N m].
    """

    frame: str | None = None
    axes: Literal["world", "body"] = field(default="world", metadata=option(OneOf(("world", "body"))))
    name: str = "push"

    def described(self, robot: Robot) -> Self:
        """Copy with the name of its frame."""
        return on_a_link(self, robot)

    def inputs(self, n: int) -> dict[str, int]:
        """The wrench [6]."""
        return {self.name: 6}

    def needs(self, n: int) -> tuple[str, ...]:
        """None: the push is optional."""
        return ()

    def wrenches(self, bodies: Bodies, inputs: Inputs) -> dict[int, Screw]:
        """The wrench on the link, if it is given."""
        if self.name not in inputs:
            return {}
        link, point = bodies.frame(str(self.frame))
        row = tuple(inputs[self.name])
        if self.axes == "world":
            force, moment = (bodies.posed.to_link(link, v) for v in (row[:3], row[3:]))
        else:
            force, moment = (screw.columns_times(point.axes, v) for v in (row[:3], row[3:]))
        return {link: (force, quat.add(moment, quat.cross(point.position, force)))}


@dataclass(frozen=True)
class Drag(BodyEffect):
    """Drag of a medium on every link: f = -(a + b |v|) v at the centre of mass, moment -c w.

    A linearly implicit step takes v and w at its end, and |v| at its start. A floating base is not a link and has no
    drag.

    Args:
        linear: a [N s/m], shape [..., links]; Stokes.
        quadratic: b [N s^2/m^2], shape [..., links]; half density times area times drag coefficient.
        angular: c [N m s/rad], shape [..., links].
        sign_width: speed below which |v| is smooth [m/s], a number or [...].
    """

    linear: Parameter = field(default=0.0, metadata=parameter("links"))
    quadratic: Parameter = field(default=0.0, metadata=parameter("links"))
    angular: Parameter = field(default=0.0, metadata=parameter("links"))
    sign_width: Parameter = field(default=1e-3, metadata=parameter(check=POSITIVE))

    def impedances(self, bodies: Bodies, inputs: Inputs, memory: Row, h: Number) -> Sequence[PointImpedance]:
        """The drag on every link."""
        result = []
        for i, (a, b, angular) in enumerate(zip(self.linear, self.quadratic, self.angular, strict=True), 1):
            c = bodies.posed.com(i)
            v = bodies.velocity(i, c)
            damping = a + b * sqrt(quat.dot(v, v) + self.sign_width * self.sign_width)
            moment = quat.scale(-angular, bodies.V[i][0])
            result.append(PointImpedance(i, c, quat.scale(-damping, v), damping, moment=moment, spin=angular))
        return result


@dataclass(frozen=True)
class PointSpring(BodyEffect):
    """Spring and damper between a frame's origin p and a point of the world: f = -k (p - a) - b v.

    A linearly implicit step takes p and v at its end, so that it holds any stiffness.

    Args:
        frame: name of the frame; None: the robot's end effector.
        anchor: a, in the base frame, or in the world frame for a floating base [m], shape [..., 3].
        stiffness: k [N/m], a number or [...].
        damping: b [N s/m], a number or [...].
    """

    frame: str | None = None
    anchor: Parameter = field(default=(0.0, 0.0, 0.0), metadata=parameter(3, check=REAL))
    stiffness: Parameter = field(default=1e3, metadata=parameter())
    damping: Parameter = field(default=0.0, metadata=parameter())

    def described(self, robot: Robot) -> Self:
        """Copy with the name of its frame."""
        return on_a_link(self, robot)

    def impedances(self, bodies: Bodies, inputs: Inputs, memory: Row, h: Number) -> Sequence[PointImpedance]:
        """The force on the frame's origin."""
        link, point = bodies.frame(str(self.frame))
        r, damping = point.position, self.damping + h * self.stiffness
        stretch = bodies.posed.to_link(link, quat.sub(bodies.posed.position(link, r), self.anchor))
        force = quat.add(quat.scale(self.stiffness, stretch), quat.scale(damping, bodies.velocity(link, r)))
        return [PointImpedance(link, r, quat.neg(force), damping)]
