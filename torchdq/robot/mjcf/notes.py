"""Parts of an MJCF file that the dynamics do not use, or use otherwise; and its gravity."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence

from torchdq.dynamics.tree import BASE
from torchdq.robot.check.units import TURN
from torchdq.robot.description import Unsimulated
from torchdq.robot.edit.couplings import Follows
from torchdq.robot.mjcf.joints import FREE, MjcfJoint, actuators_at, names_of
from torchdq.robot.mjcf.links import WORLD, Links
from torchdq.robot.mjcf.source import MjcfModel

_URDF = re.compile(r"\ufeff?(?:\s|<\?.*?\?>|<!--.*?-->)*<robot\b", re.DOTALL)  # text whose root is that of a URDF


def gravity(of: MjcfModel) -> tuple[float, ...] | None:
    """Gravitational acceleration of a file [m/s^2]; None: there is none, or every moving body is relieved of it."""
    m = of.model
    off = m.opt.disableflags & int(of.mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    found = tuple(m.opt.gravity.tolist())
    return None if off or not any(found) or _relieved(of) == {1.0} else found


def _relieved(of: MjcfModel) -> set[float]:
    """Parts of gravity that moving bodies are relieved of."""
    m = of.model
    return {float(m.body_gravcomp[i]) for i in range(1, m.nbody) if m.body_weldid[i] and m.body_mass[i] > 0}


def notes(
    of: MjcfModel, joints: Sequence[MjcfJoint], moves: Sequence[Follows], links: Links, others: Sequence[str]
) -> tuple[str, ...]:
    """Notes on a model; those on parts that would act on its motion are `Unsimulated`.

    Args:
        of: the model.
        joints, moves: its joints, and the displacement of each of them.
        links: its links.
        others: equality constraints that are no linear couplings.
    """
    m = of.model
    moving = [joint for joint in joints if moves[joint.row].root is not None and joint.single]

    def listed(wanted: Callable[[MjcfJoint], object], among: Sequence[MjcfJoint] = moving) -> str:
        found = [joint.name for joint in among if wanted(joint)]
        return "all joints" if 1 < len(found) == len(moving) else ", ".join(found)

    def dof(joint: MjcfJoint) -> int:
        return int(m.jnt_dofadr[joint.row])

    free = [joint for joint in joints if joint.kind == FREE and moves[joint.row].root is not None]
    fluid = m.opt.density or m.opt.viscosity
    acting = {k for joint in joints for k in actuators_at(of, joint.row)}
    actuators = [*enumerate(names_of(of, "ACTUATOR", m.nactuator))]
    remote = [name for k, name in actuators if k not in acting]
    gears = {k: float(m.actuator_gear[m.actuator_outadr[k], 0]) for k in acting}
    read = [name if gears[k] == 1 else f"{name} (gear {gears[k]:g})" for k, name in actuators if k in acting]
    read_by_robot = (
        ("viscous damping given but not simulated", listed(lambda j: j.damping)),
        ("Coulomb friction given but not simulated", listed(lambda j: j.friction)),
        ("limits given but not enforced", listed(lambda j: math.isfinite(j.lower) or math.isfinite(j.upper))),
        ("ranges that end before they begin, taken as none", listed(lambda j: _reversed(of, j.row))),
        ("joints without actuators", listed(lambda j: j.effort is None) if m.nactuator else ""),
        ("left out, because it stands still beside the free base", ", ".join(links.left_out)),
    )
    no_field = (
        ("damping that is no multiple of the velocity, not used", listed(lambda j: m.dof_dampingpoly[dof(j)].any())),
        ("springs given but not simulated", listed(lambda j: _spring(of, j.row), [*moving, *free])),
        ("damping or friction of the free base, not used", listed(lambda j: _resists(of, dof(j)), free)),
        ("actuators not simulated, but their greatest efforts, damping and rotor inertia are read", ", ".join(read)),
        ("actuators that act on no joint, not used", ", ".join(remote)),
        ("tendons not used", ", ".join(names_of(of, "TENDON", m.ntendon))),
        ("equality constraints not used", ", ".join(others)),
        ("flexible bodies not used", ", ".join(names_of(of, "FLEX", m.nflex))),
        ("plugins not used", ", ".join(names_of(of, "PLUGIN", m.nplugin))),
        ("contacts given but not simulated", "between geoms" if of.collides else ""),
        ("resistance of air or water, not used", "yes" if fluid else ""),
    )
    relieved = _relieved(of) == {1.0}
    found = [f"{what}: {names}" for what, names in read_by_robot if names]
    found += [Unsimulated(f"{what}: {names}") for what, names in no_field if names]
    found += [f"{links.lumped} bodies without moving joints lumped; they are frames"] if links.lumped else []
    found += ["no gravity, because every moving body is compensated for it (gravcomp)"] if relieved else []
    found += ["bodies moved by hand (mocap) stand still"] if m.nmocap else []
    return tuple(found)


def ignored(
    of: MjcfModel, joints: Sequence[MjcfJoint], moves: Sequence[Follows], links: Links, falls: bool
) -> list[Unsimulated]:
    """Notes on what changes the accelerations in MuJoCo and not here.

    Args:
        of, joints, moves, links: as in `notes`.
        falls: whether gravity acts.
    """
    m = of.model
    free = [joint for joint in joints if joint.kind == FREE and moves[joint.row].root is not None]
    found = [
        Unsimulated(
            f"armature of the free joint {joint.name!r} ignored: MuJoCo adds it to the mass matrix of the base, also "
            "where the joint inherits it from a default class; write <freejoint/>, which has and inherits none"
        )
        for joint in free
        if m.dof_armature[(dof := int(m.jnt_dofadr[joint.row])) : dof + 6].any()
    ]
    names, still = names_of(of, "BODY", m.nbody), WORLD if free else BASE
    relieved = [
        names[i] for i, (link, _) in enumerate(links.placed) if link != still and m.body_gravcomp[i] * m.body_mass[i]
    ]
    if falls and relieved and _relieved(of) != {1.0}:
        found.append(Unsimulated(f"gravcomp ignored: {', '.join(relieved)}: gravity acts on them in full"))
    if _URDF.match(of.source.text):
        found.append(
            Unsimulated(
                "the file is a URDF, of which MuJoCo leaves out joints that mimic others, and frames on fixed joints; "
                "Robot.from_urdf reads them"
            )
        )
    return found


def doubts(of: MjcfModel, joints: Sequence[MjcfJoint]) -> list[str]:
    """Doubt about the ranges of all hinges: that they are in radians where the file has degrees."""
    bounds = [abs(x) for joint in joints if joint.kind == "revolute" for x in (joint.lower, joint.upper)]
    most = max((math.degrees(x) for x in bounds if math.isfinite(x)), default=0.0)
    if not of.degrees or not 0 < most <= TURN:
        return []
    return [
        f"ranges of hinges must be in degrees in a file without <compiler angle='radian'/>, found none beyond "
        f"{most:.4g}; are they in radians?"
    ]


def _reversed(of: MjcfModel, joint: int) -> bool:
    low, high = of.model.jnt_range[joint].tolist()
    return not of.model.jnt_limited[joint] and low > high


def _spring(of: MjcfModel, joint: int) -> bool:
    return bool(of.model.jnt_stiffness[joint] or of.model.jnt_stiffnesspoly[joint].any())


def _resists(of: MjcfModel, dof: int) -> bool:
    return bool(of.model.dof_damping[dof : dof + 6].any() or of.model.dof_frictionloss[dof : dof + 6].any())
