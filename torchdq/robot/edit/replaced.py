"""Robots with some fields replaced: new values are checked as those of a description are."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any

from torch import Tensor

from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.findings import Finding
from torchdq.robot import fields
from torchdq.robot.arrays import SIX, matrices
from torchdq.robot.check import consistency, faults, units
from torchdq.robot.check.consistency import OnUnphysical
from torchdq.robot.constants import hold
from torchdq.robot.fields import SHAPES
from torchdq.robot.model import AnyRobot, RobotModel, batches, present, require_unchanged, values

# fields whose units are checked
MEASURED = ("X_PB_home", "screw", "mass", "com", "inertia", "limits", "frames")


def replace(robot: AnyRobot, *, on_unphysical: OnUnphysical = "error", **changes: Any) -> AnyRobot:
    """Robot with some fields replaced; the other fields are shared.

    A replaced physical tensor becomes an argument of the programs, so new values, batches and gradients need no new
    program; `bake` makes it a constant again. New values are checked as a file's are, with `on_unphysical` as in
    `from_urdf`, where "repair" repairs all links of a single robot; batches, and tensors that require grad or are
    inside a transform, only by `check`. Writing in place into a replaced physical tensor changes the robot.
    Damping, friction, limits and frames are copied: writing into the given tensor changes nothing. Writing into a
    copy or a constant is refused at the next call; not so through `x.data[...]` or `x.numpy()[...]`, which torch
    does not count: programs keep the numbers of before.

    Raises:
        UnknownNameError, ArgumentError, DtypeError: there is no such field, or a value does not fit the robot.
        UnphysicalError: a body would give wrong numbers, a friction or a limit is negative, or a link is left with
            inertia and no mass. A file's link may have that, which is noted; a new mass of zero needs an inertia
            of zero.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> heavier = robot.replace(
    ...     mass=robot.mass * torch.tensor([[1.0], [1.1], [1.2]], dtype=torch.float64)
    ... )
    >>> heavier.mass.shape  # three robots
    torch.Size([3, 2])
    """
    known = values(robot)
    for name in changes:
        if name not in known:
            raise UnknownNameError(f"field of robot {robot.name!r}", name, known)
    require_unchanged(robot, changes)
    faults.require_structure(robot, changes)
    made = robot._with(**changes)
    if on_unphysical == "repair":
        changed, notes = repaired(made)
        made = made._with(**changed, notes=notes) if changed else made
    if any(hold(made._storages, x) for x in changes.values()):  # whose changes in place are not the robot's
        made = dataclasses.replace(made, _storages=())
    found = complaints(made, changes, on_unphysical)
    return made._with(notes=(*found, *made.notes)) if found else made


def with_tip(robot: AnyRobot, name: str | None) -> AnyRobot:
    """Robot whose end effector is the frame with a name; None: no end effector."""
    return replace(robot, tip=None if name is None else robot.frame(name).name)


def complaints(robot: RobotModel, changes: Collection[str], on_unphysical: OnUnphysical) -> list[Finding]:
    """New findings about changed fields, after raising or warning."""
    if {"tip", "frames"} & set(changes) and robot.tip is not None:
        robot.frame(robot.tip)
    known = {(note.code, note.subject) for note in robot.notes}
    found = [x for x in faults.faults(robot, changes) if (x.code, x.subject) not in known]
    consistency.complain(robot.name, found, on_unphysical)
    if found or not {*MEASURED} & {*changes} or not measurable(robot):
        return found
    suspicions = [x for x in units.diagnostics(robot) if (x.code, x.subject) not in known]
    if on_unphysical != "ignore":
        units.warn(f"robot {robot.name!r}", suspicions, stacklevel=3)
    return suspicions


def measurable(robot: RobotModel, *others: Tensor) -> bool:
    """Whether units are checked: the robot is one on the CPU whose numbers, and others, are not learned."""
    read = (*present(robot, SHAPES).values(), *robot.limits, *others)
    return not batches(robot) and all(x.device.type == "cpu" and fields.readable(x, False) for x in read)


def repaired(robot: RobotModel) -> tuple[dict[str, Any], tuple[Finding, ...]]:
    """Fields whose impossible inertias are replaced by the nearest possible ones, and the notes of the robot then."""
    links = {"inertia": (robot.link_names, robot.mass, robot.inertia)}
    if robot.base_mass is not None and robot.base_inertia is not None:
        links["base_inertia"] = (("the base",), robot.base_mass[..., None], robot.base_inertia[..., None, :])
    new: dict[str, Any] = {}
    repairs: list[Finding] = []
    for name, (bodies, mass, inertia) in links.items():
        if mass.ndim > 1 or inertia.ndim > 2 or not fields.readable(mass, True) or not fields.readable(inertia, True):
            raise ArgumentError(
                f"{name} of robot {robot.name!r} must be that of one robot to be repaired, found mass "
                f"{tuple(mass.shape)} and inertia {tuple(inertia.shape)}; repair the robots one by one"
            )
        I, notes = consistency.repaired(bodies, mass.detach().double().cpu(), matrices(inertia.detach().double().cpu()))
        if notes:
            repairs += notes
            new[name] = I[..., *SIX].reshape(getattr(robot, name).shape).to(getattr(robot, name))
    better = {(code, note.subject) for note in repairs for code in consistency.MISSHAPEN}
    kept = (x for x in robot.notes if (x.code, x.subject) not in better)
    return new, (*repairs, *kept)
