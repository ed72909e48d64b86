"""Links of a model that MuJoCo compiled: its bodies, lumped where no joint lies between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import RigidBody
from torchdq.dynamics.tree import BASE
from torchdq.errors import DescriptionError
from torchdq.robot.arrays import double
from torchdq.robot.assembly import Links, MovingLink
from torchdq.robot.bodies import NOTHING, merged
from torchdq.robot.description import Frame
from torchdq.robot.edit.couplings import Follows
from torchdq.robot.mjcf.joints import MjcfJoint, names_of
from torchdq.robot.mjcf.source import MjcfModel

WORLD = -2  # index of what stands still, apart from a free base


class ModelLinks(NamedTuple):
    """Bodies of a model as links that move, and everything that is fixed to them."""

    of: Links
    lumped: int  # bodies that are part of others
    left_out: list[str]  # bodies and sites that stand still, apart from a free base
    placed: list[tuple[int, DualQuaternion]]  # link of each body of the model, and its pose there


def links_of(of: MjcfModel, joints: Sequence[MjcfJoint], moves: Sequence[Follows], base: int | None) -> ModelLinks:
    """Links of a model.

    Args:
        of: the model.
        joints: its joints.
        moves: displacement of each of them.
        base: body that is the free base; None: the base is the world.
    """
    m = of.model
    names = names_of(of, "BODY", m.nbody)
    links: list[MovingLink] = []
    bodies: dict[int, RigidBody] = {}
    placed = [(BASE if base is None else WORLD, dual_quaternion.ONE)]  # link of each body, and its pose there
    lumped = 0
    for body in range(1, m.nbody):
        link, X = placed[m.body_parentid[body]]
        X = dual_quaternion.mul(X, _pose(m.body_quat[body], m.body_pos[body]))
        own = [joint for joint in joints if joint.body == body]
        moving = [joint for joint in own if joint.single and moves[joint.row].root is not None]
        for joint in own:
            if joint in moving:
                if link == WORLD:
                    _refuse_apart(names[base or 0], names[body], joint)
                name = names[body] if joint is moving[-1] else f"{names[body]} before {joint.name}"
                links.append(MovingLink(name, link, joint, X))
                link, X = len(links) - 1, dual_quaternion.ONE
            elif joint.single:
                X = dual_quaternion.mul(X, joint.displaced(moves[joint.row].offset))
        if body == base:
            link, X = BASE, dual_quaternion.ONE
        elif not moving:
            lumped += 1
        placed.append((link, X))
        bodies[link] = merged(bodies.get(link, NOTHING), body_of(of, body).moved(X))
    sites = _sites(of, names, placed)
    everything = [*zip(names, placed, strict=True), *sites]
    found = [(name, *at) for name, at in everything]
    taken = {name for name, _, _ in found}
    between = [(x.name, i, dual_quaternion.ONE) for i, x in enumerate(links) if x.name not in taken]
    parents = set(m.body_parentid.tolist())
    frames = [Frame(name, link, double((*X[0], *X[1]))) for name, link, X in (*found, *between) if link != WORLD]
    leaves = [names[i] for i in range(m.nbody) if i not in parents and placed[i][0] >= 0]
    return ModelLinks(
        Links(links, bodies, frames, leaves),
        lumped,
        [name for name, link, _ in found[1:] if link == WORLD],
        placed,
    )


def _refuse_apart(base: str, body: str, joint: MjcfJoint) -> None:
    raise DescriptionError(
        f"everything that moves must hang on the free body {base!r}, found that joint {joint.name!r} carries {body!r} "
        f"apart from it; lock that joint, or hold the free body with base='fixed'"
    )


def _sites(of: MjcfModel, bodies: list[str], placed: list) -> list[tuple[str, tuple[int, DualQuaternion]]]:
    """Sites by name, with the link and the pose there; one that is named as a body is called by that and _site."""
    m, found, taken = of.model, [], set(bodies)
    for i, name in enumerate(names_of(of, "SITE", m.nsite)):
        while name in taken:
            name += "_site"
        taken.add(name)
        link, X = placed[m.site_bodyid[i]]
        found.append((name, (link, dual_quaternion.mul(X, _pose(m.site_quat[i], m.site_pos[i])))))
    return found


def _pose(rotation, position) -> DualQuaternion:
    return dual_quaternion.from_pose(tuple(rotation.tolist()), tuple(position.tolist()))


def body_of(of: MjcfModel, body: int) -> RigidBody:
    """Mass, centre of mass and inertia of one body in its own frame."""
    m = of.model
    turned = (tuple(m.body_iquat[body].tolist()), (0.0,) * 4)
    xx, yy, zz = m.body_inertia[body].tolist()
    inertia = RigidBody(0.0, quat.ZERO, (xx, 0.0, yy, 0.0, 0.0, zz)).moved(turned).inertia
    return RigidBody(float(m.body_mass[body]), tuple(m.body_ipos[body].tolist()), inertia)
