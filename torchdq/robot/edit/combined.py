"""Robots with more on them: payloads, tools, and other robots."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from torchdq import dq
from torchdq.algebra.inertia import RigidBody
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.robot import fields
from torchdq.robot.arrays import IDENTITY, matrices, poses
from torchdq.robot.bodies import body_at, lumped
from torchdq.robot.check import consistency, faults, units
from torchdq.robot.description import Frame, JointMap, Limits
from torchdq.robot.edit.rebuilt import hung, stacked
from torchdq.robot.edit.replaced import measurable, replace
from torchdq.robot.fields import BASE_BODY, LINK_BODY
from torchdq.robot.model import AnyRobot, RobotModel, batches, factors

JOINED = {"screw": 2, "home": 1, "armature": 1, "damping": 1, "friction": 1}  # fields that are joined as they are
NAMED = {"link_names": "links", "frame_names": "frames"}
ABSENT = (0.0,) * 6  # inertia of a point


def with_payload(
    robot: AnyRobot, mass: Any, com: Any = (0.0, 0.0, 0.0), inertia: Any = ABSENT, frame: str | None = None
) -> AnyRobot:
    """Robot that holds a body, which becomes part of the link, or of the floating base, that carries a frame.

    The inertial parameters become arguments of the programs, as by `replace`: another payload, a batch of them and
    gradients in their tensors need no new program. `effects.Payload` is for a body that a scene draws or learns.
    Numbers that seem to be in mm or kg mm^2 are warned of.

    Args:
        robot: the robot.
        mass: [kg], shape [...].
        com: centre of mass in the frame [m], shape [..., 3].
        inertia: about the centre of mass, axes of the frame: xx xy yy xz yz zz [kg m^2], shape [..., 6].
        frame: name of the frame; None: the end effector.

    >>> import torchdq
    >>> torchdq.robots.load("two_link").with_payload(0.5).mass.tolist()
    [1.0, 1.5]
    """
    return _holding(robot, mass, com, inertia, robot.end_effector() if frame is None else robot.frame(frame))


def _holding(robot: AnyRobot, mass: Any, com: Any, inertia: Any, at: Frame) -> AnyRobot:
    """Robot with a payload in a frame, for the functions that users call."""
    if at.link == BASE and not robot.floating:
        raise ArgumentError(
            f"frame must be one that a joint of robot {robot.name!r} moves, found {at.name!r} on the fixed base, where "
            "a payload changes nothing"
        )
    given = (("mass", mass, ()), ("com", com, (3,)), ("inertia", inertia, (6,)))
    held = RigidBody(*(_numbers(robot, *one) for one in given))
    if all(fields.readable(x, False) for x in held):
        found = consistency.bodies(("payload",), held.mass.unsqueeze(-1), matrices(held.inertia).unsqueeze(-3))
        if found:
            raise ArgumentError(f"mass and inertia must be those of a body, xx xy yy xz yz zz: {found[0]}", *found)
    suspicious = units.of_payload(robot, held) if measurable(robot, *held) else []
    units.warn(f"a payload of robot {robot.name!r}", suspicious, stacklevel=3)
    # a warning of the payload is not repeated for the link
    changes: dict[str, Any] = {**_held(robot, at.link, at.X_BF, held)}
    return replace(robot, **changes, on_unphysical="ignore" if suspicious else "error")


def with_tool(
    robot: AnyRobot,
    name: str,
    pose: Any,
    mass: Any = 0.0,
    com: Any = (0.0, 0.0, 0.0),
    inertia: Any = ABSENT,
    frame: str | None = None,
) -> AnyRobot:
    """Robot whose end effector is a new frame, the tip of a tool that another frame holds.

    Args:
        robot: the robot.
        name: name of the new frame.
        pose: its pose in the frame that holds the tool, a unit dual quaternion [8].
        mass, com, inertia: body of the tool, in the frame that holds it, as in `with_payload`.
        frame: name of the frame that holds the tool; None: the end effector.

    >>> import torchdq
    >>> robot = torchdq.robots.load("two_link").with_tool(
    ...     "pen", [1, 0, 0, 0, 0, 0.1, 0, 0], mass=0.2
    ... )
    >>> robot.tip, robot.mass.tolist()
    ('pen', [1.0, 1.2])
    """
    if not isinstance(name, str) or name in robot.frame_names:
        raise ArgumentError(f"name must be that of a new frame of robot {robot.name!r}, found {name!r}")
    at = robot.end_effector() if frame is None else robot.frame(frame)
    tip = Frame(name, at.link, dq.mul(at.X_BF, poses("pose", pose, 8, error=ArgumentError).to(at.X_BF)))
    weightless = not isinstance(mass, Tensor) and mass == 0 and inertia is ABSENT
    carrier = robot if weightless else _holding(robot, mass, com, inertia, at)
    return replace(carrier, frames=(*carrier.frames, tip), tip=name)


def attach(robot: AnyRobot, other: AnyRobot, frame: str, prefix: str | None = None, base_pose: Any = None) -> AnyRobot:
    """Robot with the base of another one fixed to a frame: all links, joints, limits and frames of both.

    Gravity is that of the first; the end effector is that of the other if it has one. The body of the other's base,
    such as the palm of a hand, becomes part of what carries the frame. It is known only if the other one was read with
    `base="floating"`; without it there is a warning, as its mass may be missing.

    Args:
        robot: the robot that carries the other.
        other: the robot that is attached.
        frame: name of the frame of `robot` that carries it.
        prefix: beginning of the names of the other's joints, links and frames, such as "left_"; None: as they are.
        base_pose: pose of the other's base in the frame, a unit dual quaternion [8]; None: they coincide.

    >>> import torchdq
    >>> arm, hand = torchdq.robots.load("panda"), torchdq.robots.load("two_link")
    >>> palm = {
    ...     "base_mass": torch.tensor(0.5),
    ...     "base_com": torch.zeros(3),
    ...     "base_inertia": torch.zeros(6),
    ... }
    >>> both = arm.attach(hand.replace(**palm), "tip", prefix="hand_")
    >>> both.joint_names[-2:], (both.mass[6] - arm.mass[6]).item()
    (('hand_joint1', 'hand_joint2'), 0.5)
    """
    if not isinstance(other, RobotModel):
        raise ArgumentError(f"other must be a torchdq.Robot, found {type(other).__name__}; load it first")
    at, start = robot.frame(frame), "" if prefix is None else prefix
    X = at.X_BF
    if base_pose is not None:
        X = dq.mul(X, poses("base_pose", base_pose, 8, error=ArgumentError).to(X))
    names = _joined_names(robot, other, start)
    other, count = other.to(robot.mass.dtype, robot.mass.device), len(robot.link_names)
    own = IDENTITY.to(robot.screw)
    places = {BASE: (at.link, X)} | {i: (i + count, own) for i in range(len(other.link_names))}
    moved = hung(other, places, range(len(other.link_names)))
    frames = (x._replace(name=start + x.name) for x in moved["frames"])
    closures = (x._replace(frame_a=start + x.frame_a, frame_b=start + x.frame_b) for x in other.closures)
    carrier, known = {name: getattr(robot, name) for name in (*LINK_BODY, *BASE_BODY)}, set(robot._arguments)
    if with_base := other.floating and (at.link != BASE or robot.floating):
        changed = _held(robot, at.link, X, body_at(other, BASE))
        carrier |= changed
        known |= set(changed) if known & set(changed) or set(other._arguments) & set(BASE_BODY) else set()
    if not other.floating and (at.link != BASE or robot.floating):
        warnings.warn(
            f"robot {other.name!r} has no body of its base, so {at.name!r} carries no mass of it; the base link of a "
            'file has mass only if the file is read with base="floating"',
            stacklevel=2,
        )
    note = f"{other.name!r} attached"
    if not with_base:
        note += "; the mass of its base is left out" if other.floating else ", without a mass of its base"
    changes: dict[str, Any] = {
        **names,
        **{name: _both(robot, other, name, axes) for name, axes in JOINED.items()},
        **{name: carrier[name] for name in BASE_BODY},
        **{name: _cat((carrier[name], getattr(other, name)), len(fields.SHAPES[name])) for name in LINK_BODY},
        "kinds": (*robot.kinds, *other.kinds),
        "parents": (*robot.parents, *moved["parents"]),
        "X_PB_home": _cat((robot.X_PB_home, moved["X_PB_home"]), 2),
        "limits": Limits(*(_cat(pair, 1) for pair in zip(robot.limits, other.limits, strict=True))),
        "frames": (*robot.frames, *frames),
        "closures": (*robot.closures, *closures),
        "tip": robot.tip if other.tip is None else start + other.tip,
        "notes": (
            *robot.notes,
            *(x._replace(subject=": ".join(filter(None, (other.name, x.subject)))) for x in other.notes),
            Finding("robot.attached", f"frame {at.name!r}", note, severity="note"),
        ),
        "_arguments": (*known, *(name for name in other._arguments if name not in (*BASE_BODY, "gravity"))),
    }
    made = type(robot)(**{"name": robot.name, "gravity": robot.gravity, **changes})
    # those of the other's links were accepted when it was loaded
    found = [fault for fault in faults.faults(made, ("mass", "inertia")) if fault not in made.notes]
    return made._with(notes=(*made.notes, *found)) if found else made


def _joined_names(robot: RobotModel, other: RobotModel, prefix: str) -> dict[str, Any]:
    """Names of both robots; raises where one stands for two things."""
    joints = [(*x.every_joint, *(name for name in x.joint_names if name not in x.every_joint)) for x in (robot, other)]
    names = {"joints": joints, **{kind: [getattr(x, field) for x in (robot, other)] for field, kind in NAMED.items()}}
    for kind, (ours, theirs) in names.items():
        both = [prefix + name for name in theirs if prefix + name in ours]
        if both:
            way = "give another prefix" if prefix else "pass prefix="
            raise ArgumentError(
                f"names of {kind} of robots {robot.name!r} and {other.name!r} must differ, found {', '.join(both)} in "
                f"both; {way}, which the names of the attached robot will begin with"
            )

    def together(field: str) -> tuple[str, ...]:
        return (*getattr(robot, field), *(prefix + name for name in getattr(other, field)))

    joint_map = None
    if robot.joint_map is not None or other.joint_map is not None:
        joint_map = JointMap(together("every_joint"), torch.block_diag(factors(robot), factors(other).to(robot.mass)))
    return {**{field: together(field) for field in ("joint_names", "link_names")}, "joint_map": joint_map}


def _numbers(robot: RobotModel, name: str, x: Any, shape: tuple[int, ...]) -> Tensor:
    """Numbers of a payload, in the dtype and on the device of the robot, whose batch axes they fit."""
    try:
        given = x if isinstance(x, Tensor) else torch.as_tensor(x, dtype=torch.float64, device=robot.mass.device)
        found = given.to(robot.mass)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ArgumentError(f"{name} must be numbers: {error}") from error
    axes = found.ndim - len(shape)
    if tuple(found.shape[axes:]) != shape:
        expected = ", ".join(["...", *map(str, shape)])
        raise ArgumentError(f"{name} must have the shape [{expected}], found {tuple(found.shape)}")
    for field, own in batches(robot).items():
        try:
            torch.broadcast_shapes(own, batch := tuple(found.shape[:axes]))
        except RuntimeError as error:
            raise ArgumentError(
                f"{name} must have batch axes that fit those of {field} of robot {robot.name!r}, {own}, found {batch}"
            ) from error
    return found


def _held(robot: RobotModel, link: int, X_BF: Tensor, held: RigidBody) -> dict[str, Tensor]:
    """Inertial parameters of a robot one of whose links, or floating base, holds a body at a pose."""
    whole = lumped(body_at(robot, link), [(X_BF, held)])
    if link == BASE:
        return dict(zip(BASE_BODY, whole, strict=True))
    found = {}
    for name, row in zip(LINK_BODY, whole, strict=True):
        rows = list(getattr(robot, name).unbind(-len(fields.SHAPES[name])))
        rows[link] = row
        found[name] = stacked(robot, name, rows)
    return found


def _cat(parts: Iterable[Tensor], axes: int) -> Tensor:
    """Rows of all parts, each with batch axes of its own and one or two trailing axes."""
    found = tuple(parts)
    batch = torch.broadcast_shapes(*(x.shape[:-axes] for x in found))
    return torch.cat([x.expand(*batch, *x.shape[-axes:]) for x in found], -axes)


def _both(robot: RobotModel, other: RobotModel, name: str, axes: int) -> Tensor | None:
    """Field of both robots; it is zero where only the other one has it."""
    found = [getattr(x, name) for x in (robot, other)]
    if found[0] is None and found[1] is None:
        return None
    missing = (x.mass.new_zeros(x.sizes["links" if name == "home" else "n"]) for x in (robot, other))
    return _cat((zero if x is None else x for x, zero in zip(found, missing, strict=True)), axes)
