"""Links of a model that MuJoCo compiled: its bodies, lumped where no joint lies between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import ONE
from torchdq.algebra.inertia import RigidBody
from torchdq.robot.arrays import IDENTITY, double, unused
from torchdq.robot.assembly import APART, Links, Segment, linked
from torchdq.robot.description import Closure, Drawing, Frame, Shape
from torchdq.robot.edit.couplings import Follows
from torchdq.robot.mjcf.joints import Equality, MjcfJoint, names_of, pose
from torchdq.robot.mjcf.source import MjcfModel

UNSEEN = 3  # first group of geoms that MuJoCo's viewer does not show
SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3}  # numbers of a geom's size


class ModelLinks(NamedTuple):
    """Bodies of a model as links that move, and everything that is fixed to them."""

    of: Links
    lumped: int  # bodies that are part of others
    left_out: list[str]  # bodies and sites that stand still, apart from a floating base


def links_of(of: MjcfModel, joints: Sequence[MjcfJoint], moves: Sequence[Follows], base: int | None) -> ModelLinks:
    """Links of a model by the displacements of its joints, on the body that is its floating base, or the world."""
    m, names, shapes, drawings = of.model, names_of(of, "BODY", of.model.nbody), shapes_of(of), drawings_of(of)
    segments = [Segment(names[0], None, ONE, shapes=tuple(shapes[0]), drawing=drawings[0])]
    for i in range(1, m.nbody):
        own = [joint for joint in joints if joint.body == i and joint.single]
        X = pose(m.body_quat[i], m.body_pos[i])
        touching, seen = tuple(shapes[i]), drawings[i]
        segments.append(Segment(names[i], int(m.body_parentid[i]), X, own, body_of(of, i), ONE, touching, seen))
    found = linked(segments, moves, base)
    carried = {link.joint.body for link in found.links} | {base}
    sites = [(name, *found.places[m.site_bodyid[i]], i) for i, name in enumerate(_site_names(of, names))]
    left_out = [name for name, (link, _) in zip(names[1:], found.places[1:], strict=True) if link == APART]
    frames = [
        Frame(name, link, double(sum(dual_quaternion.mul(X, pose(m.site_quat[i], m.site_pos[i])), ())))
        for name, link, X, i in sites
        if link != APART
    ]
    taken = {*names, *(name for name, *_ in sites)}
    frames += [Frame(link.name, i, IDENTITY) for i, link in enumerate(found.links) if link.name not in taken]
    return ModelLinks(
        found._replace(frames=[*found.frames, *frames]),
        sum(i not in carried for i in range(1, m.nbody)),
        [*left_out, *(name for name, link, *_ in sites if link == APART)],
    )


def closures_of(found: Links, equalities: Sequence[Equality]) -> tuple[list[Frame], list[Closure], list[Equality]]:
    """Closures between links of a model, the frames that they hold together, and the equality constraints left."""
    frames, closures, others = list[Frame](), list[Closure](), list[Equality]()
    taken = {frame.name for frame in found.frames}
    for one in equalities:
        at = [found.places[i] for i in one.bodies]
        if not one.places or one.disabled or APART in (link for link, _ in at):
            others.append(one)
        elif at[0][0] != at[1][0]:  # those between bodies on one link hold anyway
            a, b = (unused(f"{one.name}_{end}", taken) for end in "ab")
            for name, (link, X), place in zip((a, b), at, one.places, strict=True):
                frames.append(Frame(name, link, double(sum(dual_quaternion.mul(X, place), ()))))
            closures.append(Closure(a, b, "point" if one.kind == "connect" else "weld"))
    return frames, closures, others


def _site_names(of: MjcfModel, bodies: list[str]) -> list[str]:
    """Names of sites; one that is named as a body is called by that and _site."""
    found: list[str] = []
    for name in names_of(of, "SITE", of.model.nsite):
        while name in (*bodies, *found):
            name += "_site"
        found.append(name)
    return found


def shapes_of(of: MjcfModel) -> list[list[Shape]]:
    """Shapes of the geoms that take part in contacts, by body."""
    m = of.model
    return _by_body(of, lambda i: m.geom_contype[i] or m.geom_conaffinity[i])


def drawings_of(of: MjcfModel) -> list[Drawing]:
    """Shapes of the geoms that MuJoCo's viewer shows, or where there are none that touch, by body."""
    m, folder = of.model, str(of.source.folder.absolute())
    seen = _by_body(of, lambda i: m.geom_group[i] < UNSEEN and m.geom_rgba[i, 3] > 0)
    return [Drawing(tuple(own or other), folder) for own, other in zip(seen, shapes_of(of), strict=True)]


def _by_body(of: MjcfModel, wanted: Callable[[int], Any]) -> list[list[Shape]]:
    m = of.model
    found: list[list[Shape]] = [[] for _ in range(m.nbody)]
    for i in filter(wanted, range(m.ngeom)):
        file, X = "", pose(m.geom_quat[i], m.geom_pos[i])
        kind = of.mujoco.mjtGeom(int(m.geom_type[i])).name.removeprefix("mjGEOM_").lower()
        size = tuple(m.geom_size[i, : SIZES.get(kind, 0)].tolist())
        if i in of.meshes:
            name, file, size = of.meshes[i]
            kind = f"mesh {name!r}"
            if (k := int(m.geom_dataid[i])) >= 0:  # MuJoCo moves a mesh that it has opened to its centre of mass
                X = dual_quaternion.mul(X, dual_quaternion.conj(pose(m.mesh_quat[k], m.mesh_pos[k])))
        found[m.geom_bodyid[i]].append(Shape(kind, size, X, m.geom(i).name, file))
    return found


def body_of(of: MjcfModel, body: int) -> RigidBody:
    """Mass, centre of mass and inertia of one body in its own frame."""
    m = of.model
    turned = (tuple(m.body_iquat[body].tolist()), (0.0,) * 4)
    xx, yy, zz = m.body_inertia[body].tolist()
    inertia = RigidBody(0.0, quat.ZERO, (xx, 0.0, yy, 0.0, 0.0, zz)).moved(turned).inertia
    return RigidBody(float(m.body_mass[body]), tuple(m.body_ipos[body].tolist()), inertia)
