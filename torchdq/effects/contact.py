"""Contact of points and spheres with the ground and with objects, implicit in the step, with Coulomb friction.

A step h takes the normal force of Hunt and Crossley and the friction of bristles at its end, where the point has the
velocity u' (depth d, normal n, bristles z, coefficients as at the start):

    f_n = k d - k (h + c max(d, 0)) n.u'
    f_t = -s y,   y = k z + k (h + T) u_t',   s = min(1, limit / |y|)
    z'  = (s y / k + (T/h) z) / (1 + T/h)

Both are f - C (u' - u) with a symmetric C >= 0, so the step has one solution for any k. A spring would pull points
that land or leave within the step: one that lands is a damper for the part of the step in which it touches, and one
that leaves is pushed by what its spring still holds, k d^2 / 2 = h f_n u'. Where friction sticks, s is 1: it is a
spring, and nothing creeps. Where it would leave the cone, it returns to it along the secant through the origin, and |y|
is extrapolated from the last two steps, which makes the friction of sliding exact to second order in h.

No force gives energy, whatever k, h and the body are. Bristles never return more than they hold, for any s in [0, 1].
The spring along the normal neither: a point may be deeper than the step foresaw, as where a blow on one corner turns
another into the ground; it then is compressed by no more than the work done on it allows, and recovers slowly.

Friction keeps to mu times the normal impulse. The normal force that limits it is foreseen: with the mobility W of the
point, of the robot in the middle of its limits, and the acceleration a towards the ground that all else gave it over
the last step, a = n.W f - n.(u' - u) / h, it is f_n = (k d - Z v) / (1 + h Z n.W (n - mu y / |y|)), Z = k (h + c d),
where v = n.u - h a is the velocity without it. Where it grows, as in an impact, |y| grows by what it may add to the
slip, and points of a link that land together share it. What a step uses too much or too little, the next ones make up
for.
"""

from __future__ import annotations

import fnmatch
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.inertia import rotated
from torchdq.algebra.quaternion import Number, Pure
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import REAL, matching, tensor_of
from torchdq.dq.components import unit
from torchdq.dynamics.error_growth import NoInertiaError
from torchdq.dynamics.free_bodies import Pair
from torchdq.dynamics.posed import Row
from torchdq.dynamics.shapes import NONE
from torchdq.dynamics.tree import BASE
from torchdq.effects.body import Bodies, BodyEffect, PointImpedance
from torchdq.effects.effect import Inputs
from torchdq.effects.surface import HeightMap, tangent
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.inverse_kinematics import ranges, start
from torchdq.functions.parametric import TENSOR, Parameter, Shapes
from torchdq.functions.posed import frame as frame_of
from torchdq.functions.posed import posed
from torchdq.functions.signature import parameter
from torchdq.numbers.functions import absolute, below, clip, maximum, minimum, select, sqrt
from torchdq.objects import Object
from torchdq.robot import ContactPoint, Robot
from torchdq.robot.constants import Constants
from torchdq.robot.contact_points import points_of
from torchdq.robot.fields import SHAPES
from torchdq.robot.robot import arguments, constants, recorded

SINK = 1e-3  # depth of the points of a robot at rest, where the stiffness follows from it [m]
CARRYING = 4  # points that it then rests on at most; others are there for falls
WEIGHT = 9.81  # acceleration that the weight of a robot at rest is taken with [m/s^2]
NEAR = 1e-6  # depth from which a point was in contact over the last step, above the rounding of its memory [m]
TINY = 1e-6  # friction beside which the size of none counts as zero [N]
OWED = 0.03  # share of the cone from which friction that is left over is made up for at once
SLOWEST = 1e-9  # speed that a point has at least where it lands or leaves within a step [m/s]
RECOVERY = 0.1  # speed that sets how fast the compression of a point that is deeper recovers [m/s]
WIDTH = 1e-2  # sliding speed below which friction without stiction is viscous [m/s]
ANY_DEPTH = 1e3  # compression that no point exceeds [m]
KEPT = 8  # numbers that a point remembers
GIVEN = "object in Scene(objects=...)"
STIFF = 1e5  # stiffness of an object's contact over its mass, which steps of up to 6 ms keep [1/s^2]


class _Chosen(float):
    """Stiffness that was not given: another robot has its own."""


class Contacts(NamedTuple):
    """Contact of the points of a scene's `Contact` effects, in their order; while it is recorded, of one point.

    Forces are those at the end of the last step. In an impact the mean of the step differs from them, and with it the
    impulse that acted, which is the change of `floating.momentum`.
    """

    force: Any  # [..., points, 3] on the body of the point, in world axes, or base axes if the base is fixed [N]
    normal_force: Any  # [..., points] [N]
    touching: Any  # [..., points] bool; while it is recorded 1, or 0 where no force acts
    depth: Any  # [..., points] of the point in the ground, negative above it [m]
    slip: Any  # [..., points] speed along the surface [m/s]


class ObjectPoint(NamedTuple):
    """Point by which an object touches the ground, or another object."""

    frame: str  # name of the object
    number: int  # among the points of the object
    radius: None = None  # as the object has it


class _Place(NamedTuple):
    """A point above the ground and its motion, in axes of its link; one at an object, in those of the object.

    Signs are those of the body in whose axes it is: the normal is the direction in which it is pushed.
    """

    link: int
    against: int | None  # link of the point, where it touches an object
    normal: Pure
    center: Pure  # of the sphere
    point: Pure  # that touches
    # displacement of the body along the surface, up to a constant, where an object takes part: in axes of the object
    # that is touched, or of the world; None: friction of feet sums up the slip of every step
    anchored: Pure | None
    depth: Number
    along: Number  # velocity along the normal, negative towards the ground [m/s]
    slip: Pure  # velocity along the surface [m/s]
    lift: Number  # n.W n [1/kg]
    mobility: Pure | None  # W n [1/kg]; None: it is the same in all directions
    compression: Number  # of its spring [m]
    free: Number  # velocity along the normal that all else gives it at the end of the step [m/s]
    force: Number  # along the normal at that velocity, not positive where none acts [N]
    Z: Number  # impedance of the force over the step [N s/m]


@dataclass(frozen=True)
class Contact(BodyEffect):
    """Compliant contact with Coulomb friction, of points of the robot or of objects with the ground or objects.

        f_n = k d (1 + c dd) >= 0,   |f_t| <= mu f_n

    The normal force is continuous in the depth d and never attractive. Friction sticks without creep at rest, and is
    mu f_n in sliding. Use `LinearlyImplicit`, which evaluates the force at the end of the step and is stable for any
    stiffness; impacts are first-order accurate in the step size. Contact never adds energy, for any stiffness and body,
    in steps in which the base turns by less than 1.5 rad. Over an impact the friction impulse is at most mu times the
    normal impulse; in single steps it may exceed it. A point that another contact lifts within a step is held until
    the end of the step. Each point has eight states: friction bristles in world axes [m], or, where an object
    takes part, the place at which they would be straight, largest compression of its spring [m], the normal force, the
    friction force and the unused friction of the last step [N], and the acceleration towards
    the ground by all other forces [m/s^2].

    Sources: K. H. Hunt and F. R. E. Crossley, "Coefficient of restitution interpreted as damping in vibroimpact",
    Journal of Applied Mechanics, 1975, for the normal force; M. Anitescu and F. A. Potra, "A time-stepping method for
    stiff multibody dynamics with contact and friction", 2002, for contact in linearly implicit steps.

    Args:
        points: contact points: names or patterns of frames, with the points of `robot.contact_points`, or the origin of
            the frame if the file has none; or `ContactPoint` objects; or names of objects of the scene, for the corners
            of a box, the ends of a capsule, a ball, four points of each rim of a cylinder; None: the origin of the end
            effector.
        on: names or patterns of objects whose surfaces the points touch; None: they touch the ground.
        height: height of the plane along its normal [m], from the origin of the base, or of the world for a floating
            base.
        normal: unit normal n of the plane, in the base frame or, for a floating base, the world frame, shape [..., 3].
        surface: ground other than a plane: a function of recorded numbers (x, y) [m] that returns the height above
            z = height [m], and whose derivatives give the slope; or an `effects.HeightMap`, from which torch looks up a
            plane below every point before each step. A sphere of radius r touches with its lowest point, and therefore
            sinks by r (1 - cos) on a slope. None: the plane.
        stiffness: stiffness k of each point, of the normal force and of sticking friction [N/m], a number or [...];
            None: a robot at rest sinks by 1 mm on four points, or on all if there are fewer; of objects 1e5 1/s^2
            times the mass of the lightest, which steps of up to 6 ms follow.
        dissipation: dissipation c [s/m], a number or [...].
        friction: friction coefficient mu, a number or [...].
        stiction: False: no memory, and viscous friction below 10 mm/s, which has a smooth gradient and creeps.
        settling: relaxation time T of the bristles of a massless point, at least half a step [s], a number or [...].

    >>> import torchdq
    >>> from torchdq import effects
    >>> scene = torchdq.Scene(
    ...     torchdq.robots.load("panda"), (effects.Contact(height=0.2, friction=0.5),), dt=0.005
    ... )
    """

    IMPLICIT = "its stiff forces act at the end of a step"
    points: Any = None
    on: Any = field(default=None, kw_only=True)
    height: Parameter = field(default=0.0, metadata=parameter(check=REAL))
    normal: Parameter = field(default=(0.0, 0.0, 1.0), metadata=parameter(3, check=REAL))
    surface: Any = None
    stiffness: Parameter = field(default=None, metadata=parameter(optional=True))
    dissipation: Parameter = field(default=1.0, metadata=parameter())
    friction: Parameter = field(default=0.8, metadata=parameter())
    stiction: bool = True
    settling: Parameter = field(default=1e-3, metadata=parameter())

    # --- parameters ---

    @property
    def SHAPES(self) -> Shapes:  # type: ignore[override]
        """Trailing axes of each parameter; the stiffness of objects may follow from their masses."""
        return self.present()

    def __post_init__(self) -> None:
        for name in ("points", "on"):
            if isinstance(getattr(self, name), list):  # which could change after it was recorded
                object.__setattr__(self, name, tuple(getattr(self, name)))

    def among(self, robot: Robot, objects: Sequence[Object]) -> Self:
        """Copy with the points of robot and objects, and the names of those that are touched."""
        bodies = {body.name: body for body in objects}
        on = self.on if self.on is None else matching("on", self.on, bodies, GIVEN)
        if on == ():
            raise ArgumentError("on of Contact must name an object at least, found none; None is the ground")
        points: Any = []
        given = [one.frame if isinstance(one, ObjectPoint) else one for one in _each(self.points)]  # of another scene
        for one in dict.fromkeys(given):
            names = fnmatch.filter(bodies, one) if isinstance(one, str) else []
            of_objects: Any = [ObjectPoint(name, k) for name in names for k in range(bodies[name].POINTS)]
            try:
                points += of_objects or points_of(robot, one)
            except UnknownNameError as error:
                kind = f"frame of robot {robot.name!r} or {GIVEN}"
                raise UnknownNameError(kind, one, [*robot.frame_names, *bodies]) from error
        own = [x.frame for x in points if isinstance(x, ObjectPoint)]
        for name in own if on else ():
            sharp, flat = bodies[name].sharp, [x for x in on or () if x != name and bodies[x].flat]
            if sharp and flat:
                raise ArgumentError(
                    f"points of Contact on {flat[0]!r} must be round, found {name!r}, whose edges would pass through "
                    f"those of {flat[0]!r}; give it a rounding of a few millimetres, or make it a Ball or a Capsule"
                )
        if on is not None and {*on} == {*own} and len(on) == 1 and len(own) == len(points):
            raise ArgumentError(f"on of Contact must name an object other than that of its points, found {on[0]!r}")
        return replace(self, points=None if self.points is None else tuple(points), on=on)

    def described(self, robot: Robot) -> Self:
        """Copy with its contact points, on links that move, and a stiffness."""
        named = (ContactPoint(robot.end_effector().name),) if self.points is None else _each(self.points)
        of_objects = tuple(x for x in named if isinstance(x, ObjectPoint))
        own = [x for x in named if not isinstance(x, ObjectPoint)]
        points = points_of(robot, tuple(own)) if own or not of_objects else ()
        for point in points:
            if robot.frame(point.frame).link == BASE and not robot.floating:
                raise ArgumentError(f"points of Contact hold {point.frame!r}, which is fixed to the base")
        if self.surface is not None and not callable(self.surface):
            raise ArgumentError(f"surface of Contact must be a function of (x, y), found {self.surface!r}")
        if self.surface is not None and self.normal != (0.0, 0.0, 1.0):
            raise ArgumentError("normal of Contact must be left out where a surface is given, which has its own")
        stiffness = None if isinstance(self.stiffness, _Chosen) else self.stiffness
        if stiffness is None and not (of_objects or self.on):
            stiffness = _Chosen(max(1.0, moving_mass(robot) * WEIGHT / (SINK * min(len(points), CARRYING))))
        return replace(self, points=(*_with_mobilities(robot, points), *of_objects), stiffness=stiffness)

    def resolved(self, robot: Robot) -> Self:
        """Copy for a robot; raises unless the normal is a unit vector."""
        whole, described = super().resolved(robot), self.described(robot)
        if isinstance(described.stiffness, _Chosen):
            whole = replace(whole, stiffness=described.stiffness)
        unit("normal of Contact", tensor_of(whole.normal))
        return whole

    def of_objects(self, objects: Sequence[Object]) -> Self:
        """Copy with the stiffness that follows from the masses of the objects that take part, where none is given."""
        if self.stiffness is not None:
            return self
        names = {name for point, on in self.touching for name in (point.frame, on)}
        masses = [body.mass for body in objects if body.name in names]
        return replace(self, stiffness=STIFF * reduce(minimum, masses))

    def template(self) -> Self:
        """Copy without the heights of a map, because programs do not depend on them."""
        found = super().template()
        return replace(found, surface=TENSOR) if isinstance(self.surface, HeightMap) else found

    def computed(self, n: int) -> dict[str, int]:
        """Planes below the points [3 points], if there is a map."""
        mapped = self.surface is TENSOR or isinstance(self.surface, HeightMap)
        return {f"ground_{self.points[0].frame}": 3 * len(self.points)} if mapped and self.on is None else {}

    def of_rows(self, chosen: Callable[[Tensor, int], Tensor]) -> Self:
        """Copy with some of the maps."""
        if not isinstance(self.surface, HeightMap):
            return self
        return replace(self, surface=replace(self.surface, heights=chosen(self.surface.heights, 2)))

    def outside(self) -> str:
        """Description of the map; "" without one."""
        if not isinstance(self.surface, HeightMap):
            return ""
        rows, columns = self.surface.heights.shape[-2:]
        return f"a map of {rows} x {columns} heights, in which torch looks up a plane below every point once per step"

    def looked_up(self, places: Tensor) -> Tensor:
        """Planes z = c + a x + b y tangent to the map, c, a and b [..., 3 points], at x and y [..., 2 points]."""
        x, y = places.chunk(2, -1)
        height, a, b = self.surface(x, y)
        return torch.cat(torch.broadcast_tensors(height - a * x - b * y, a, b), -1)

    def places(self, bodies: Bodies) -> list[Number]:
        """x, and then y, of all points."""
        found = [bodies.posed.position(*self._point(bodies, point)[:2]) for point in self.points]
        return [p[axis] for axis in (0, 1) for p in found]

    @property
    def touching(self) -> list[tuple[Any, str | None]]:
        """Points, each with what it touches: an object by its name, or None, the ground."""
        return [(point, name) for name in self.on or (None,) for point in self.points if point.frame != name]

    def label(self) -> str:
        """Name in descriptions, with the pairs of bodies and the number of contacts of each."""
        if self.on is None and not any(isinstance(point, ObjectPoint) for point in self.points):
            return type(self).__name__
        pairs = Counter(f"{point.frame} on {name or 'the ground'}" for point, name in self.touching)
        return f"{type(self).__name__}: {', '.join(f'{pair} ({n})' for pair, n in pairs.items())}"

    def pairs(self, robot: Robot, objects: Mapping[str, int]) -> list[Pair]:
        """Objects, and bodies of the points that touch them."""

        def body(point: Any) -> int:
            return objects[point.frame] if isinstance(point, ObjectPoint) else robot.frame(point.frame).link + 1

        return [(objects[name], body(point)) for point, name in self.touching if name is not None]

    def memory(self, n: int) -> int:
        """Numbers that all contacts remember; none without stiction."""
        return KEPT * len(self.touching) if self.stiction else 0

    def start(self, q: Row, qd: Row) -> Row:
        """Memory of points that may be in the ground, with springs as compressed as they are deep."""
        return (0.0, 0.0, 0.0, ANY_DEPTH, *[0.0] * (KEPT - 4)) * len(self.touching) if self.stiction else ()

    # --- law ---

    def impedances(self, bodies: Bodies, inputs: Inputs, memory: Row, h: Number) -> Sequence[PointImpedance]:
        """Forces of the points, and what these remember."""
        places = list(self._places(bodies, inputs, memory, h))
        found = []
        for i, place in enumerate(places):
            pair = (place.link, place.against)
            others = [x for x in places if (x.link, x.against) == pair and x is not place]
            Z_others = sum([select(below(0.0, x.force), x.Z, 0.0) for x in others], 0.0)
            found.append(self._impedance(bodies, place, memory[KEPT * i : KEPT * (i + 1)], Z_others, h))
        return found

    def _impedance(self, bodies: Bodies, place: _Place, memory: Row, Z_others: Number, h: Number) -> PointImpedance:
        """Force of a point over a step h, and what it remembers then; Z_others: of others that press on its link."""
        k, n, kept, force, Z_n = self.stiffness, place.normal, None, place.force, place.Z
        active = below(0.0, force)
        if not self.stiction:
            trial, Z_t = place.slip, 1.0
            normal = select(active, force, 0.0)
            share = self.friction * normal / sqrt(quat.dot(trial, trial) + WIDTH * WIDTH)
        else:
            # bristles that relax in less than half of the step would double what differs between steps
            T = maximum(self.settling, 0.5 * h)
            Z_t = k * (h + T)
            *_, pushed, left = memory
            z = self._bristles(bodies, place, memory)
            trial = quat.add(quat.scale(k, z), quat.scale(Z_t, place.slip))
            size = sqrt(quat.dot(trial, trial) + TINY * TINY)
            limit, ahead = self._cone(place, memory, trial, size, Z_others, h * Z_t, h)
            slides = below(limit, ahead)
            share = select(slides, limit / ahead, 1.0)

            def kept(end: Pure, turning: Pure) -> Row:
                lag, along = T / h, quat.dot(n, end)
                slip = quat.sub(end, quat.scale(along, n))
                # s y / k = s (z + (h + T) u_t')
                whole = quat.add(z, quat.scale(h + T, slip))
                acted = quat.scale(share, whole)
                pressing = maximum(force - Z_n * (along - place.free), 0.0)
                used = k * sqrt(quat.dot(acted, acted) + NONE)
                d, worked = maximum(place.compression, 0.0), pressing * (-2.0 * h) * along / k
                deepest = sqrt(maximum(d * d + worked, 0.0) + (RECOVERY * h) * (RECOVERY * h))
                rest = select(slides, left + self.friction * pressing - used, 0.0)
                moved = place.lift * pressing
                if place.mobility is not None:
                    moved = moved - k * quat.dot(place.mobility, acted)
                row = [deepest, pressing, size, moved - (along - place.along) / h, rest]
                if place.anchored is None:
                    after = quat.scale(1.0 / (1.0 + lag), quat.add(acted, quat.scale(lag, z)))
                    bent = bodies.posed.to_world(place.link, after)
                else:
                    # where the bristles would be straight: it moves with what slides, and as the sphere rolls
                    slid = quat.scale((1.0 - share) * (1.0 / (1.0 + lag)), whole)
                    rolled = quat.add(quat.scale(along, n), quat.cross(turning, quat.sub(place.center, place.point)))
                    back = quat.sub(z, quat.add(slid, quat.scale(h, rolled)))
                    bent = quat.sub(place.anchored, self._outside(bodies, place, back))
                return [*bent, *(select(active, x, 0.0) for x in row)]

            normal = select(active, force - h * Z_n * pushed, 0.0)

        D = share * Z_t
        acting = quat.sub(quat.scale(normal, n), quat.scale(share, trial))
        E = select(active, Z_n, 0.0) - D
        return PointImpedance(place.link, place.point, acting, D, n, E, kept=kept, against=place.against)

    def _bristles(self, bodies: Bodies, place: _Place, memory: Row) -> Pure:
        """Displacement of the bristles, along the surface; none at a point that did not touch before."""
        bent, n, pressed = tuple(memory[:3]), place.normal, memory[4]
        if place.anchored is None:
            z = bodies.posed.to_link(place.link, bent)
            return z if self.surface is None else quat.sub(z, quat.scale(quat.dot(n, z), n))  # whose normal turns
        apart = quat.sub(place.anchored, bent)
        z = apart if place.against is not None else bodies.posed.to_link(place.link, apart)
        along, was = quat.dot(n, z), below(0.0, pressed)
        return tuple(select(was, x - along * y, 0.0) for x, y in zip(z, n, strict=True))

    def _outside(self, bodies: Bodies, place: _Place, v: Pure) -> Pure:
        """Vector in the axes in which a point remembers: those of the object that it touches, or of the world."""
        return v if place.against is not None else bodies.posed.to_world(place.link, v)

    def _cone(
        self, place: _Place, memory: Row, trial: Pure, size: Number, Z_others: Number, heavy: Number, h: Number
    ) -> tuple[Number, Number]:
        """Largest friction of a step, and that of the bristles at its end, which returns to it; heavy: their mass."""
        *_, pressed, last, _, left = memory
        W_n, lift, kick, was = place.mobility, place.lift, 0.0, below(self.stiffness * NEAR, pressed)
        if W_n is not None:
            kick = sqrt(maximum(quat.dot(W_n, W_n) - lift * lift, NONE)) * (1.0 + Z_others / maximum(place.Z, NONE))
            lift = maximum(lift - self.friction / size * quat.dot(W_n, trial), 0.0)
        f_n = place.force / (1.0 + h * lift * (place.Z + select(was, 0.0, Z_others)))
        cone = self.friction * f_n
        # slowly where it is small, or it would double errors that alternate
        owed = left * absolute(left) / (absolute(left) + OWED * cone + TINY)
        ahead = select(was, clip(size + (size - last), size, 2.0 * size), size)
        if W_n is not None:  # the slip may grow where the normal force does
            ahead = ahead + kick * heavy * maximum(f_n - pressed, 0.0)
        return select(below(0.0, place.force), maximum(cone + owed, 0.0), 0.0), ahead

    def readings(self, bodies: Bodies, inputs: Inputs, memory: Row) -> list[Contacts]:
        """Contact of every point in a state."""
        found = []
        for i, place in enumerate(self._places(bodies, inputs)):
            to_world, speed = partial(bodies.posed.to_world, place.link), sqrt(quat.dot(place.slip, place.slip))
            if self.stiction:
                own = memory[KEPT * i : KEPT * (i + 1)]
                *z, _, f_n, _, _, _ = own
                bent = select(below(0.0, f_n), self.stiffness, 0.0)  # those of a point that left relax without a force
                held = tuple(z) if place.anchored is None else to_world(self._bristles(bodies, place, own))
                force = quat.sub(quat.scale(f_n, to_world(place.normal)), quat.scale(bent, held))
            else:
                f_n, force = maximum(place.force, 0.0), to_world(self._impedance(bodies, place, (), 0.0, 0.0).force)
            if place.against is not None:
                force = quat.neg(force)
            found.append(Contacts(force, f_n, below(0.0, f_n), place.depth, speed))
        return found

    def _pressing(self, depth: Number, u: Number, h: Number) -> tuple[Number, Number]:
        """Normal force at a velocity u, not positive where none acts, and its impedance over a step h."""
        k, c, deep = self.stiffness, self.dissipation, maximum(depth, 0.0)
        Z = k * (h + c * deep)
        force, speed = k * depth - Z * u, maximum(absolute(u), SLOWEST)
        lands, leaves = below(depth, 0.0), below(force, 0.0)
        left = k * deep * deep * maximum(1.0 - c * u, 0.0) / (2.0 * h * speed + NONE)
        force = select(leaves, left, force)
        return force, select(maximum(lands, leaves), force / speed, Z)

    def _places(self, bodies: Bodies, inputs: Inputs, memory: Row = (), h: Number = 0.0) -> Iterator[_Place]:
        """Places of the contacts, before a step h."""
        planes = [inputs[name] for name in self.computed(0)]
        for k, (point, name) in enumerate(self.touching):
            body = None if name is None else bodies.objects[name]
            link, c, radius = self._point(bodies, point)
            if body is None:
                p = bodies.posed.position(link, c)
                n, depth = self._ground(p, radius, *(row[k :: len(self.points)] for row in planes))
                i, against, normal = link, None, bodies.posed.to_link(link, n)
                anchored = p if isinstance(point, ObjectPoint) else None
                lowest = quat.sub(c, quat.scale(radius, normal))
            else:
                i, against = body[0], link
                c = bodies.posed.seen[i, against].point(c)
                out, distance = body[1].nearest(c)
                depth, normal = radius - distance, quat.neg(out)
                anchored, lowest = quat.neg(c), quat.add(c, quat.scale(radius, normal))
            u = bodies.velocity(i, lowest, against)
            along = quat.dot(normal, u)
            slip = quat.sub(u, quat.scale(along, normal))
            compression, free = depth, along
            if memory:
                *_, compression, _, _, pushed, _ = memory[KEPT * k : KEPT * (k + 1)]
                compression, free = minimum(depth, compression), along - h * pushed
            pressing = self._pressing(compression, free, h)
            lift, W_n = self._mobility(bodies, point, normal, body)
            yield _Place(
                i, against, normal, c, lowest, anchored, depth, along, slip, lift, W_n, compression, free, *pressing
            )

    def _point(self, bodies: Bodies, point: Any) -> tuple[int, Pure, Number]:
        """Link of a point, the point on it, and its radius."""
        if isinstance(point, ObjectPoint):
            link, body = bodies.objects[point.frame]
            return link, *body.points()[point.number]
        return *bodies.point(point.frame, point.center), point.radius

    def _mobility(self, bodies: Bodies, point: Any, normal: Pure, body: Any) -> tuple[Number, Pure | None]:
        """Mobilities n.W n and W n of a point, relative to the object that it touches; None: the same everywhere."""
        if isinstance(point, ObjectPoint):
            own = bodies.objects[point.frame][1].mobility
        elif body is not None or isinstance(point.mobility, float):
            W = point.mobility
            own = W if isinstance(W, float) else sum(row[k] for k, row in enumerate(W)) / 3.0
        else:
            axes = bodies.frame(point.frame)[1].axes
            W_n = tuple(quat.dot(row, normal) for row in rotated(axes, point.mobility))
            return quat.dot(W_n, normal), W_n
        return (own if body is None else own + body[1].mobility), None

    def _ground(self, p: Pure, radius: float, plane: Row = ()) -> tuple[Pure, Number]:
        """Normal of the ground below a sphere at p, in the world, and the sphere's depth; `plane`: that of a map."""
        if self.surface is None:
            return self.normal, self.height + radius - quat.dot(self.normal, p)
        x, y, z = p
        if plane:
            c, a, b = plane
            height = c + a * x + b * y
        else:
            height, a, b = tangent(self.surface, x, y)
        w = 1.0 / sqrt(1.0 + a * a + b * b)
        # of its lowest point: the distance of its centre would jump where slopes do, and give energy
        return (-a * w, -b * w, w), (radius - (z - height - self.height)) * w


def _each(points: Any) -> tuple[Any, ...]:
    """Points, one by one; () if there are none, the end effector's."""
    if points is None:
        return ()
    return points if isinstance(points, tuple) and not isinstance(points, ContactPoint) else (points,)


def _with_mobilities(robot: Robot, points: Sequence[ContactPoint]) -> tuple[ContactPoint, ...]:
    """Points with the mobility of the robot; where its tensors are arguments, that which they had at first.

    It is a constant of programs, which must not depend on the values of arguments.
    """
    if not {*arguments(robot)} - {"gravity"}:
        return _of_constants(constants(robot), tuple(point._replace(mobility=()) for point in points))
    return tuple(points) if all(point.mobility != () for point in points) else _mobilities(robot, points)


@remembered(PROGRAMS)
def _of_constants(known: Constants, points: Sequence[ContactPoint]) -> tuple[ContactPoint, ...]:
    """Points with the mobility of a robot of these constants."""
    return _mobilities(recorded(known), points)


def _mobilities(robot: Robot, points: Sequence[ContactPoint]) -> tuple[ContactPoint, ...]:
    """Points with the mobility W = J M^-1 J^T that the robot has there, in axes of their frames.

    It is the largest of several robots, with joints in the middle of their limits. A point that is alone on its link
    takes the mean of all directions, a number.
    """
    own = [name for name in arguments(robot) if name != "gravity"]
    rows: dict[str, Any] = {"gravity": None}
    for name in (*own, "armature") if robot.armature is not None else own:
        x = getattr(robot, name).detach().double()
        rows[name] = x.reshape(*x.shape[: x.ndim - len(SHAPES[name])], -1).unbind(-1)
    at = posed(recorded(constants(robot)), start(0, ranges(robot)), rows, own, dq.ONE if robot.floating else None)
    try:
        factors = at.factors(False)
    except NoInertiaError:  # which a solution names
        return tuple(point._replace(mobility=1.0) for point in points)
    found, frames = [], [frame_of(robot, point.frame) for point in points]
    links = [link for link, _ in frames]
    for point, (link, X_BF) in zip(points, frames, strict=True):
        columns = at.jacobian(link, dq.mul(X_BF, dq.from_pose(quat.ONE, point.center)), False)
        J = tuple(tuple(0.0 if c is None else c[1][axis] for c in columns) for axis in range(3))
        W = [tensor_of(x).double() for row in factors.mobility(J) for x in row]
        every = torch.stack(torch.broadcast_tensors(*W)).reshape(3, 3, -1)
        largest = every[:, :, int(every.diagonal().sum(-1).argmax())]
        every_way = tuple(map(tuple, largest.tolist()))
        found.append(point._replace(mobility=every_way if links.count(link) > 1 else float(largest.trace()) / 3.0))
    return tuple(found)


def moving_mass(robot: Robot) -> float:
    """Mass of everything that moves, of the lightest of several robots [kg]."""
    whole = robot.mass.detach().sum(-1)
    if robot.floating and robot.base_mass is not None:
        whole = whole + robot.base_mass.detach()
    return float(whole.min()) if whole.numel() else 0.0
