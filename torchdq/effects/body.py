"""Body effects: wrenches of the environment on links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Self

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.quaternion import Pure
from torchdq.algebra.screw import Screw
from torchdq.base.checks import tensor_of
from torchdq.dynamics.posed import Point, Posed
from torchdq.effects.effect import Effect, Inputs, Parameter, Shapes, on_a_link, undefined
from torchdq.errors import ArgumentError
from torchdq.functions.posed import frame
from torchdq.numbers.functions import maximum, sqrt
from torchdq.program.transforms import without_values
from torchdq.robot import Robot


class Bodies(NamedTuple):
    """Links of a posed robot in motion; points, twists and wrenches are in the frames of `posed`."""

    robot: Robot
    posed: Posed
    V: Sequence[Screw]  # twists of the links

    def frame(self, name: str) -> tuple[int, Point]:
        """Link of a frame, and the frame's origin and axes on it."""
        link, X_BF = frame(self.robot, name)
        return link, self.posed.point(link, X_BF)

    def velocity(self, i: int, r: Pure) -> Pure:
        """Velocity of a point of a link, in link axes."""
        w, v = self.V[i]
        return quat.add(v, quat.cross(w, r))


@dataclass(frozen=True)
class BodyEffect(Effect):
    """Wrench on one or more links."""

    SLOT: ClassVar[str] = "body"

    def wrenches(self, bodies: Bodies, inputs: Inputs) -> dict[int, Screw]:
        """Wrenches (force, moment) by link number, in and about the frames of `bodies`."""
        raise undefined(self, "wrenches")


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
    axes: Literal["world", "body"] = "world"
    name: str = "push"

    def described(self, robot: Robot) -> Self:
        """Copy with the name of its frame."""
        if self.axes not in ("world", "body"):
            raise ArgumentError(f"axes of Push must be 'world' or 'body', found {self.axes!r}")
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

    A floating base is not a link and has no drag.

    Args:
        linear: a [N s/m], shape [..., links]; Stokes.
        quadratic: b [N s^2/m^2], shape [..., links]; half density times area times drag coefficient.
        angular: c [N m s/rad], shape [..., links].
        sign_width: speed below which |v| is smooth [m/s], a number or [...].
    """

    SHAPES: ClassVar[Shapes] = {"linear": ("links",), "quadratic": ("links",), "angular": ("links",), "sign_width": ()}
    DIVIDING = frozenset({"sign_width"})
    linear: Parameter = 0.0
    quadratic: Parameter = 0.0
    angular: Parameter = 0.0
    sign_width: Parameter = 1e-3

    def wrenches(self, bodies: Bodies, inputs: Inputs) -> dict[int, Screw]:
        """The drag on every link."""
        result = {}
        for i, (a, b, angular) in enumerate(zip(self.linear, self.quadratic, self.angular, strict=True), 1):
            c = bodies.posed.com(i)
            v = bodies.velocity(i, c)
            speed = sqrt(quat.dot(v, v) + self.sign_width * self.sign_width)
            force = quat.scale(-(a + b * speed), v)
            moment = quat.scale(-angular, bodies.V[i][0])
            result[i] = (force, quat.add(moment, quat.cross(c, force)))
        return result


@dataclass(frozen=True)
class Contact(BodyEffect):
    """Compliant contact of a frame's origin with a half-space: normal force k d (1 + c dd), friction coefficient mu.

        d = height - n . p,   f = f_n n - mu f_n v_t / sqrt(|v_t|^2 + w^2),   f_n = max(k d (1 + c dd), 0)

    Source of the normal force: Hunt and Crossley 1975. The force is continuous and never attractive.

    Args:
        frame: name of the frame; None: the robot's end effector.
        height: of the surface along the normal, from the origin of the base, or of the world for a floating base [m].
        normal: unit normal n of the surface, in the base frame or in the world frame, shape [..., 3].
        stiffness: k [N/m], a number or [...].
        dissipation: c [s/m], a number or [...].
        friction: mu, a number or [...].
        sign_width: w, the sliding speed below which friction is viscous [m/s], a number or [...].
    """

    SHAPES: ClassVar[Shapes] = {
        "height": (),
        "normal": (3,),
        "stiffness": (),
        "dissipation": (),
        "friction": (),
        "sign_width": (),
    }
    SIGNED = frozenset({"height", "normal"})
    DIVIDING = frozenset({"sign_width"})
    frame: str | None = None
    height: Parameter = 0.0
    normal: Parameter = (0.0, 0.0, 1.0)
    stiffness: Parameter = 1e4
    dissipation: Parameter = 1.0
    friction: Parameter = 0.0
    sign_width: Parameter = 1e-2

    def described(self, robot: Robot) -> Self:
        """Copy with the name of its frame."""
        return on_a_link(self, robot)

    def resolved(self, robot: Robot) -> Self:
        """Copy for a robot; raises unless the normal is a unit vector up to rounding."""
        whole = super().resolved(robot)
        normal = tensor_of(whole.normal).double()
        if without_values((normal,)):
            return whole
        wrong = (normal.square().sum(-1) - 1).abs() > 1e-5
        if bool(wrong.any()):
            found = ", ".join(f"{x:.4g}" for x in normal[wrong][0].tolist())
            raise ArgumentError(f"normal of Contact must be a unit vector, found ({found})")
        return whole

    def wrenches(self, bodies: Bodies, inputs: Inputs) -> dict[int, Screw]:
        """The contact force on the link."""
        link, point = bodies.frame(str(self.frame))
        p = point.position
        v = bodies.velocity(link, p)
        n = bodies.posed.to_link(link, self.normal)
        approach = quat.dot(n, v)
        depth = maximum(self.height - quat.dot(self.normal, bodies.posed.position(link, p)), 0.0)
        f_n = maximum(self.stiffness * depth * (1.0 - self.dissipation * approach), 0.0)
        force = quat.scale(f_n, n)
        sliding = quat.sub(v, quat.scale(approach, n))
        speed = sqrt(quat.dot(sliding, sliding) + self.sign_width * self.sign_width)
        force = quat.sub(force, quat.scale(self.friction * f_n / speed, sliding))
        return {link: (force, quat.cross(p, force))}
