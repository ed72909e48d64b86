"""Effects on the bodies: wrenches that the environment exerts on links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.dynamics.tree import BASE
from torchdq.effects.effect import Effect, Inputs, Parameter, Shapes, on_a_link
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import maximum, sqrt
from torchdq.robot import Robot
from torchdq.robot.posed import Given, PaperModel, constant_pose, field


class Bodies:
    """Poses and twists of a robot's links in a state; what nothing asks for is not part of the program."""

    def __init__(self, robot: Robot, q: Sequence[Number], qd: Sequence[Number], fields: Given):
        self.robot = robot
        self.fields = fields
        model = PaperModel.of(robot, q, fields)
        self.X_WB, self.V_WB_B = model.poses(), model.twists(qd)

    def com(self, i: int) -> Pure:
        """Centre of mass of a link, in the link frame."""
        return field(self.robot, "com", self.fields)[i]

    def at(self, name: str) -> tuple[int, DualQuaternion, DualQuaternion]:
        """Link B of a frame F, and the poses X_BF and X_WF."""
        frame = self.robot.frame(name)
        X_BF = constant_pose(frame.X_BF)
        return frame.link, X_BF, X_BF if frame.link == BASE else dq.mul(self.X_WB[frame.link], X_BF)

    def velocity(self, i: int, p_B: Pure) -> Pure:
        """Velocity, in the link frame, of a point p_B of a link."""
        w, v = self.V_WB_B[i]
        return quat.add(v, quat.cross(w, p_B))


@dataclass(frozen=True)
class BodyEffect(Effect):
    """A wrench on one or more links."""

    SLOT: ClassVar[str] = "body"

    def wrenches(self, bodies: Bodies, inputs: Inputs) -> dict[int, Screw]:
        """Wrench (force, moment) on links, in and about their frames."""
        raise NotImplementedError


@dataclass(frozen=True)
class Push(BodyEffect):
    """A wrench on a frame, given at every step; a step at which it is not given costs nothing.

    Args:
        frame: name of the frame; None: the robot's end effector.
        axes: "world": force and moment are given in the axes of the base frame; "body": in those of the frame. Both
            are about the frame's origin.
        name: name of the input, shape [..., 6] [N, N m].
    """

    frame: str | None = None
    axes: Literal["world", "body"] = "world"
    name: str = "push"

    def described(self, robot: Robot) -> Self:
        """Copy with the frame named."""
        if self.axes not in ("world", "body"):
            raise ArgumentError(f"axes of Push must be 'world' or 'body', found {self.axes!r}")
        return on_a_link(self, robot)

    def inputs(self, n: int) -> dict[str, int]:
        """The wrench [6]."""
        return {self.name: 6}

    def needs(self, n: int) -> tuple[str, ...]:
        """No names: a step may be without a push."""
        return ()

    def wrenches(self, bodies: Bodies, inputs: Inputs) -> dict[int, Screw]:
        """The wrench on the link, if it is given."""
        if self.name not in inputs:
            return {}
        link, X_BF, X_WF = bodies.at(str(self.frame))
        row = tuple(inputs[self.name])
        wrench: Screw = (row[:3], row[3:])
        if self.axes == "world":
            back = quat.conj(X_WF[0])
            wrench = (quat.rotate(back, wrench[0]), quat.rotate(back, wrench[1]))
        return {link: screw.ad(screw.columns(X_BF), wrench)}


@dataclass(frozen=True)
class Drag(BodyEffect):
    """Resistance of a medium at every link: f = -(a + b |v|) v at the centre of mass, moment -c w.

    Args:
        linear: a [N s/m], shape [..., n]; Stokes.
        quadratic: b [N s^2/m^2], shape [..., n]; half density times area times drag coefficient.
        angular: c [N m s/rad], shape [..., n].
        width: speed below which |v| is rounded off [m/s].
    """

    SHAPES: ClassVar[Shapes] = {"linear": ("n",), "quadratic": ("n",), "angular": ("n",), "width": ()}
    DIVIDING = frozenset({"width"})
    linear: Parameter = 0.0
    quadratic: Parameter = 0.0
    angular: Parameter = 0.0
    width: Parameter = 1e-3

    def wrenches(self, bodies: Bodies, inputs: Inputs) -> dict[int, Screw]:
        """The resistance to every link."""
        result = {}
        for i in range(bodies.robot.n):
            c = bodies.com(i)
            v = bodies.velocity(i, c)
            speed = sqrt(quat.dot(v, v) + self.width * self.width)
            force = quat.scale(-(self.linear[i] + self.quadratic[i] * speed), v)
            moment = quat.scale(-self.angular[i], bodies.V_WB_B[i][0])
            result[i] = (force, quat.add(moment, quat.cross(c, force)))
        return result


@dataclass(frozen=True)
class Contact(BodyEffect):
    """Compliant contact of a frame's origin with a half-space: normal force k d (1 + c dd), friction mu times it.

        d = height - n . p,   f = f_n n - mu f_n v_t / sqrt(|v_t|^2 + width^2),   f_n = max(k d (1 + c dd), 0)

    Source of the normal force: Hunt and Crossley 1975. The force is continuous and the ground never pulls.

    Args:
        frame: name of the frame; None: the robot's end effector.
        height: of the surface along the normal from the base's origin [m], a number or [...].
        normal: unit normal n of the surface in the base frame, shape [..., 3].
        stiffness: k [N/m], a number or [...].
        dissipation: c [s/m], a number or [...].
        friction: mu, a number or [...].
        width: sliding velocity below which friction is viscous [m/s], a number or [...].
    """

    SHAPES: ClassVar[Shapes] = {
        "height": (),
        "normal": (3,),
        "stiffness": (),
        "dissipation": (),
        "friction": (),
        "width": (),
    }
    SIGNED = frozenset({"height", "normal"})
    DIVIDING = frozenset({"width"})
    frame: str | None = None
    height: Parameter = 0.0
    normal: Parameter = (0.0, 0.0, 1.0)
    stiffness: Parameter = 1e4
    dissipation: Parameter = 1.0
    friction: Parameter = 0.0
    width: Parameter = 1e-2

    def described(self, robot: Robot) -> Self:
        """Copy with the frame named."""
        if isinstance(self.normal, tuple) and abs(sum(x * x for x in self.normal) - 1) > 1e-6:
            raise ArgumentError(f"normal of Contact must be a unit vector, found {self.normal}")
        return on_a_link(self, robot)

    def wrenches(self, bodies: Bodies, inputs: Inputs) -> dict[int, Screw]:
        """The force on the link that touches."""
        link, X_BF, X_WF = bodies.at(str(self.frame))
        p_B = dq.translation(X_BF)
        r_WB = bodies.X_WB[link][0]
        v = quat.rotate(r_WB, bodies.velocity(link, p_B))
        n = self.normal
        approach = quat.dot(n, v)
        depth = maximum(self.height - quat.dot(n, dq.translation(X_WF)), 0.0)
        f_n = maximum(self.stiffness * depth * (1.0 - self.dissipation * approach), 0.0)
        force = quat.scale(f_n, n)
        sliding = quat.sub(v, quat.scale(approach, n))
        speed = sqrt(quat.dot(sliding, sliding) + self.width * self.width)
        force = quat.sub(force, quat.scale(self.friction * f_n / speed, sliding))
        f_B = quat.rotate(quat.conj(r_WB), force)
        return {link: (f_B, quat.cross(p_B, f_B))}
