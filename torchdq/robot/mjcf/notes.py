"""Diagnostics of an MJCF file: parts that the dynamics do not use, or use differently; and its gravity."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from torchdq.dynamics.tree import BASE
from torchdq.findings import Finding
from torchdq.robot.assembly import APART
from torchdq.robot.check.units import TURN
from torchdq.robot.description import BALL, UNACTUATED, UNSIMULATED, note
from torchdq.robot.edit.couplings import Follows
from torchdq.robot.mjcf.joints import FREE, Equality, MjcfJoint, actuators_at, names_of
from torchdq.robot.mjcf.links import ModelLinks
from torchdq.robot.mjcf.source import MjcfModel
from torchdq.robot.xml_text import root_name

HINGES = (
    "read as three hinges {name}_x, {name}_y and {name}_z, which cannot turn freely where {name}_y is near a right "
    "angle; keep it below 70 degrees (1.2 rad)"
)


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


def diagnostics(
    of: MjcfModel,
    joints: Sequence[MjcfJoint],
    moves: Sequence[Follows],
    bodies: ModelLinks,
    others: Sequence[Equality],
    falls: bool,
) -> list[Finding]:
    """Findings of a model, on which gravity acts if it `falls`, and some of whose equalities are no linear couplings.

    Parts that would act on its motion, and are not read, have codes that begin `UNSIMULATED`.
    """
    return [
        *_ignored(of, joints, moves, bodies, falls),
        *_open(others),
        *_degrees(of, joints),
        *_used_otherwise(of, joints, moves, bodies),
        *_unsimulated(of, joints, moves),
    ]


def _used_otherwise(
    of: MjcfModel, joints: Sequence[MjcfJoint], moves: Sequence[Follows], bodies: ModelLinks
) -> list[Finding]:
    """Notes on parts that a robot has fields for, or that are used differently."""
    moving = [joint for joint in joints if moves[joint.row].leader is not None and joint.single]

    def listed(code: str, wanted: Callable[[MjcfJoint], object], what: str) -> Finding:
        return note(code, [joint for joint in moving if wanted(joint)], what, len(moving))

    def ends_first(joint: MjcfJoint) -> bool:
        low, high = m.jnt_range[joint.row].tolist()
        return not m.jnt_limited[joint.row] and low > high

    m, lumped = of.model, f"{bodies.lumped} bodies without moving joints lumped; they are frames"
    still = [joint for joint in joints if not joint.single and moves[joint.row].leader is None]
    found = [
        listed("damping.unused", lambda j: j.damping, "viscous damping given but not simulated"),
        listed("friction.unused", lambda j: j.friction, "Coulomb friction given but not simulated"),
        listed(
            "limits.unused", lambda j: math.isfinite(j.lower) or math.isfinite(j.upper), "limits given but not enforced"
        ),
        listed("limits.reversed", ends_first, "the range ends before it begins, taken as none"),
        note("frame.left_out", bodies.left_out, "left out, because it stands still and the base is free"),
        note("joint.held", still, "held where the file puts it"),
    ]
    if m.nactuator:
        found.append(listed(UNACTUATED, lambda j: j.effort is None, "joints without actuators"))
    more = {
        "body.lumped": lumped if bodies.lumped else "",
        "gravity.compensated": "no gravity, because every moving body is compensated for it (gravcomp)"
        if _relieved(of) == {1.0}
        else "",
        "body.mocap": "bodies moved by hand (mocap) stand still" if m.nmocap else "",
    }
    return [x for x in found if x.subject] + [note(code, [], words) for code, words in more.items() if words]


def _unsimulated(of: MjcfModel, joints: Sequence[MjcfJoint], moves: Sequence[Follows]) -> list[Finding]:
    """Notes on parts that would act on the motion, and that a robot has no field for."""
    m = of.model
    moving = [joint for joint in joints if moves[joint.row].leader is not None]
    free, single = ([joint for joint in moving if (joint.kind == FREE) == there] for there in (True, False))

    def dof(joint: MjcfJoint) -> int:
        return int(m.jnt_dofadr[joint.row])

    acting = {k for joint in joints for k in actuators_at(of, joint.row)}
    actuators = [*enumerate(names_of(of, "ACTUATOR", m.nactuator))]
    gears = {k: float(m.actuator_gear[m.actuator_outadr[k], 0]) for k in acting}
    read = [name if gears[k] == 1 else f"{name} (gear {gears[k]:g})" for k, name in actuators if k in acting]
    given: list[tuple[str, Sequence[Any], str]] = [
        ("damping", [j for j in single if m.dof_dampingpoly[dof(j)].any()], "damping that is not linear, not used"),
        (
            "spring",
            [j for j in moving if m.jnt_stiffness[j.row] or m.jnt_stiffnesspoly[j.row].any()],
            "springs given but not simulated",
        ),
        (
            "base",
            [j for j in free if any(x[dof(j) : dof(j) + 6].any() for x in (m.dof_damping, m.dof_frictionloss))],
            "damping or friction of the floating base, not used",
        ),
        ("actuator", read, "actuators not simulated; their greatest efforts, damping and rotor inertia are read"),
        ("actuator", [name for k, name in actuators if k not in acting], "actuators that act on no joint, not used"),
        ("tendon", names_of(of, "TENDON", m.ntendon), "tendons not used"),
        ("flex", names_of(of, "FLEX", m.nflex), "flexible bodies not used"),
        ("plugin", names_of(of, "PLUGIN", m.nplugin), "plugins not used"),
        ("contact", ["geoms"] if of.collides else [], "contacts given but not simulated"),
        ("fluid", ["air or water"] if m.opt.density or m.opt.viscosity else [], "resistance not used"),
    ]
    return [note(UNSIMULATED + code, names, what) for code, names, what in given if names]


def _ignored(
    of: MjcfModel, joints: Sequence[MjcfJoint], moves: Sequence[Follows], bodies: ModelLinks, falls: bool
) -> list[Finding]:
    """Warnings about ignored elements that affect MuJoCo's dynamics."""
    m = of.model
    free = [joint for joint in joints if joint.kind == FREE and moves[joint.row].leader is not None]
    inherited = (
        "armature ignored: MuJoCo adds it to the mass matrix of the base, also where the joint inherits it from a "
        "default class"
    )
    turning = {joint.name for joint in joints if moves[joint.row].leader is not None}
    found = [
        Finding(BALL, f"ball joint {name!r}", HINGES.format(name=name)) for name in of.balls if f"{name}_y" in turning
    ]
    found += [
        Finding(f"{UNSIMULATED}armature", f"free joint {x.name!r}", inherited, cure="write <freejoint/>, without any")
        for x in free
        if m.dof_armature[(dof := int(m.jnt_dofadr[x.row])) : dof + 6].any()
    ]
    names, still = names_of(of, "BODY", m.nbody), APART if free else BASE
    relieved = [
        names[i]
        for i, (link, _) in enumerate(bodies.of.places)
        if link != still and m.body_gravcomp[i] * m.body_mass[i]
    ]
    if falls and relieved and _relieved(of) != {1.0}:
        what = "gravcomp ignored: gravity acts on these bodies in full"
        found.append(Finding(f"{UNSIMULATED}gravcomp", ", ".join(relieved), what))
    if root_name(of.source.text) == "robot":
        what = "the file is a URDF, of which MuJoCo leaves out joints that mimic others, and frames on fixed joints"
        found.append(Finding(f"{UNSIMULATED}urdf", "", what, cure="Robot.from_urdf reads them"))
    return found


def _open(others: Sequence[Equality]) -> list[Finding]:
    """Warnings about equality constraints that are ignored."""
    found = []
    for one in others:
        if one.disabled:
            found.append(note(f"{UNSIMULATED}equality", [str(one)], "disabled by a flag of the file, not used"))
        elif one.places:
            what = f"ignored, so that {one.ends} move apart, because it holds a floating base to the world"
            found.append(Finding(f"{UNSIMULATED}equality", str(one), what, cure="read the file with base='fixed'"))
        else:
            what = f"ignored, so that {one.ends} move apart"
            cure = "write it as a linear coupling of joints, or as a connect or weld between bodies"
            found.append(Finding(f"{UNSIMULATED}equality", str(one), what, cure=cure))
    return found


def _degrees(of: MjcfModel, joints: Sequence[MjcfJoint]) -> list[Finding]:
    """Suspicion about the ranges of all hinges: that they are in radians where the file has degrees."""
    bounds = [abs(x) for joint in joints if joint.kind == "revolute" for x in (joint.lower, joint.upper)]
    most = max((math.degrees(x) for x in bounds if math.isfinite(x)), default=0.0)
    if not of.degrees or not 0 < most <= TURN:
        return []
    expected = "ranges of hinges must be in degrees in a file without <compiler angle='radian'/>"
    return [Finding("units.radians", "", expected, f"none beyond {most:.4g}", "are they in radians?")]
