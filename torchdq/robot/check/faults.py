"""Faults of the fields of a robot: values of the wrong kind or length raise at once, `faults` are impossible numbers.

A description's source checks what it reads; here the same is checked of single fields.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.robot.arrays import first, matrices, not_unit, slack
from torchdq.robot.check import consistency, units
from torchdq.robot.fields import SHAPES, STRUCTURE, readable
from torchdq.robot.model import RobotModel, batches, present, require_unchanged, values
from torchdq.robot.tree import inert_joints

SCREWS = {
    "revolute": "a unit line (l | p x l)",
    "helical": "a unit line with pitch (l | p x l + h l)",
    "prismatic": "a unit translation (0 | l)",
}


def check(robot: RobotModel) -> None:
    """Raise unless a robot can exist; see `Robot.check`."""
    require_unchanged(robot)
    names = values(robot)
    require_structure(robot, names)
    found = faults(robot, names, everything=True)
    if not found and not batches(robot):
        found = inert_joints(robot)
    if found:
        consistency.refuse(robot.name, found)
    units.warn(f"robot {robot.name!r}", units.diagnostics(robot), stacklevel=3)


def require_structure(robot: RobotModel, values: Mapping[str, Any]) -> None:
    """Raise unless values are of the kind and the length of their fields, those with physical tensors apart."""
    sizes = robot.sizes
    for name, value in values.items():
        expected, fits = STRUCTURE.get(name, ("", lambda x, n, links: True))
        if not fits(value, robot.n, sizes["links"]):
            counts = f"n = {robot.n}" + ("" if robot.joint_map is None else f" and links = {sizes['links']}")
            raise ArgumentError(f"{name} of robot {robot.name!r} must be {expected}, with {counts}, found {value!r}")


def faults(robot: RobotModel, names: Collection[str], everything: bool = False) -> list[Finding]:
    """Numbers of the fields with these names that no robot can have, in batches and learned tensors if `everything`."""
    found, bodies = [*_geometry(robot, names, everything)], (robot.mass, robot.inertia)
    batched = any(x.ndim > axes for x, axes in zip(bodies, (1, 2), strict=True))
    wanted = {"mass", "inertia"} & set(names) and (everything or not batched)
    if wanted and all(readable(x, everything) for x in bodies):
        mass, inertia = (x.detach() for x in bodies)
        found += consistency.bodies(robot.link_names, mass, matrices(inertia))
    base = {name: x for name, x in present(robot, ("base_mass", "base_inertia")).items() if name in names}
    if base and robot.base_mass is not None and robot.base_inertia is not None:
        shaped = robot.base_mass.unsqueeze(-1), matrices(robot.base_inertia).unsqueeze(-3)
        if all(readable(x, everything) for x in shaped):
            found += consistency.bodies(("the base",), *(x.detach() for x in shaped))
    for name, expected, x, fits in _rules(robot, names):
        if readable(x, everything) and (everything or x.ndim <= len(SHAPES.get(name, "n"))) and not bool(fits(x).all()):
            at, value = first(x, ~fits(x))
            claim = f"{name} must be {expected}"
            found.append(Finding(f"{name}.value", "", claim, f"{value} at {at}", severity="error"))
    return found


def _geometry(robot: RobotModel, names: Collection[str], everything: bool) -> Iterator[Finding]:
    """Faults of poses that are not unit ones, and of screws that are not of the kind of their joint."""
    poses = [("X_PB_home", robot.X_PB_home, "")] if "X_PB_home" in names else []
    poses += [("pose X_BF", f.X_BF, f"frame {f.name!r}") for f in robot.frames if "frames" in names]
    for name, x, subject in poses:
        if readable(x, everything) and (fault := not_unit(name, x.detach(), slack(x), subject)):
            yield fault
    if {"screw", "kinds"} & set(names) and readable(robot.screw, everything):
        fits = _of_kind(robot.screw.detach(), robot.kinds)
        if not bool(fits.all()):
            at, value = first(robot.screw, ~fits)
            name, kind = robot.every_joint[at[-1]], robot.kinds[at[-1]]
            claim = f"screw of a {kind} joint must be {SCREWS[kind]} with |l| = 1"
            yield Finding("screw.kind", f"joint {name!r}", claim, f"{value} at {at}", severity="error")


def _of_kind(screw: Tensor, kinds: tuple[str, ...]) -> Tensor:
    """Mask of screws [..., n, 6] of joints of these kinds."""
    near = slack(screw)
    axis, moment = screw[..., :3].double(), screw[..., 3:].double()
    length, size, pitch = axis.norm(dim=-1), moment.norm(dim=-1), (axis * moment).sum(-1)
    line = (length - 1).abs() <= near
    fits = {
        "revolute": line & (pitch.abs() <= near * (1 + size)),
        "helical": line & size.isfinite(),
        "prismatic": (length <= near) & ((size - 1).abs() <= near),
    }
    return torch.stack([fits[kind][..., i] for i, kind in enumerate(kinds)], -1) if kinds else line


def _rules(robot: RobotModel, names: Collection[str]) -> Iterator[tuple[str, str, Tensor, Callable[[Tensor], Tensor]]]:
    """Name, expectation, tensor and the expectation as a mask, of every rule on single numbers."""
    for name in ("com", "home", "gravity", "base_com"):
        if name in names and getattr(robot, name) is not None:
            yield name, "finite", getattr(robot, name), torch.isfinite
    for name in ("armature", "damping", "friction"):
        if name in names and getattr(robot, name) is not None:
            yield name, "finite and not negative", getattr(robot, name), lambda x: x.isfinite() & (x >= 0)
    if "limits" in names:
        lower, upper, velocity, effort = robot.limits
        yield "lower limit", "a number that is not above the upper limit", lower, lambda x: x <= upper
        yield "velocity limit", "a number that is not negative", velocity, lambda x: x >= 0
        yield "effort limit", "a number that is not negative", effort, lambda x: x >= 0
