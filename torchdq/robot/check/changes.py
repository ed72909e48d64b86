"""Changes of a robot: one that happened in place, values for its fields, and several robots as one batch."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.compiler import is_compiling

from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot import fields
from torchdq.robot.arrays import SIX, matrices
from torchdq.robot.check import consistency, units
from torchdq.robot.constants import version
from torchdq.robot.description import Frame, JointMap, Limits
from torchdq.robot.fields import SHAPES, batches
from torchdq.robot.tree import inert_joints

if TYPE_CHECKING:
    from torchdq.robot.robot import Robot

# fields that the robots of a stack may have different values of
STACKED = (*SHAPES, "limits", "damping", "friction")
# fields whose units can be doubted
MEASURED = ("X_PB_home", "screw", "mass", "com", "inertia", "limits", "frames")


def values(robot: Robot) -> dict[str, Any]:
    """Values of the public fields of a robot, by name."""
    return {name: value for name, value in vars(robot).items() if not name.startswith("_")}


def require_unchanged(robot: Robot, replaced: Collection[str] = ()) -> None:
    """Raise if a constant tensor was changed in place or requires grad: programs have its numbers, not the tensor.

    Changes through `x.data` and `x.numpy()` are not seen, since torch does not count them. Tensors with the names
    `replaced` may require grad.
    """
    if is_compiling():
        return
    if any(map(version, robot._storages)):
        constant = {name: x for name, x in values(robot).items() if name not in ("notes", *robot._arguments)}
        names = robot._constants.changed(constant) or ["a tensor"]  # type: ignore[union-attr]
        raise ArgumentError(
            f"{', '.join(names)} of robot {robot.name!r} was changed in place, but its programs still have the numbers "
            f"of before; load the robot again and use robot.replace({names[0]}=...)"
        )
    for name, x in fields.present(robot, SHAPES).items():
        if x.requires_grad and name not in (*replaced, *robot._arguments):
            raise ArgumentError(
                f"{name} of robot {robot.name!r} requires grad, but is a constant of its programs and would get no "
                f"gradient; use robot.replace({name}={name}) with a tensor that requires grad"
            )


def require_fields(robot: Robot, changes: Mapping[str, Any]) -> None:
    """Raise unless changes are new values for fields of a robot, of their kind and length."""
    known = values(robot)
    for name in changes:
        if name not in known:
            raise UnknownNameError(f"field of robot {robot.name!r}", name, known)
    require_unchanged(robot, changes)
    fields.require_structure(robot, changes)


def complaints(robot: Robot, changes: Collection[str], on_unphysical: consistency.OnUnphysical) -> list[str]:
    """Faults of changed fields and doubts about their units, that the notes do not tell of, once raised or warned of.

    Raises unless the tip is a frame. Units are doubted of one robot on the CPU whose numbers are not learned.
    """
    if {"tip", "frames"} & set(changes) and robot.tip is not None:
        robot.frame(robot.tip)
    known = {units.without_numbers(note) for note in robot.notes}
    faults = [fault for fault in fields.faults(robot, changes) if units.without_numbers(fault) not in known]
    consistency.complain(robot.name, faults, on_unphysical)
    if faults or not {*MEASURED} & {*changes} or not doubted(robot):
        return faults
    return units.doubts(robot, quiet=on_unphysical == "ignore", known=known)


def doubted(robot: Robot, *others: Tensor) -> bool:
    """Whether units are doubted: the robot is one on the CPU whose numbers, and others, are not learned."""
    read = (*fields.present(robot, SHAPES).values(), *robot.limits, *others)
    return not batches(robot) and all(x.device.type == "cpu" and fields.readable(x, False) for x in read)


def repaired(robot: Robot) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Inertias of a robot that no body has, as fields with the nearest that one has, and the robot's notes then."""
    links = {"inertia": (robot.link_names, robot.mass, robot.inertia)}
    if robot.base_mass is not None and robot.base_inertia is not None:
        links["base_inertia"] = (("the base",), robot.base_mass[..., None], robot.base_inertia[..., None, :])
    new: dict[str, Any] = {}
    told: list[str] = []
    for name, (bodies, mass, inertia) in links.items():
        if mass.ndim > 1 or inertia.ndim > 2 or not fields.readable(mass, True) or not fields.readable(inertia, True):
            raise ArgumentError(
                f"{name} of robot {robot.name!r} must be that of one robot to be repaired, found mass "
                f"{tuple(mass.shape)} and inertia {tuple(inertia.shape)}; repair the robots one by one"
            )
        I, notes = consistency.repaired(bodies, mass.detach().double().cpu(), matrices(inertia.detach().double().cpu()))
        if notes:
            told += notes
            new[name] = I[..., *SIX].reshape(getattr(robot, name).shape).to(getattr(robot, name))
    better = {note.partition(": ")[0] for note in told}
    kept = (x for x in robot.notes if not isinstance(x, consistency.Misshapen) or x.partition(": ")[0] not in better)
    return new, (*told, *kept)


def check(robot: Robot) -> None:
    """Raise unless a robot can exist; see `Robot.check`."""
    require_unchanged(robot)
    names = values(robot)
    fields.require_structure(robot, names)
    faults = fields.faults(robot, names, everything=True)
    if not faults and not fields.batches(robot):
        faults = inert_joints(robot)
    if faults:
        consistency.refuse(robot.name, faults)
    units.doubts(robot)


# --- robots in one batch ---------------------------------------------------------------------------------------------


def stacked(kind: type[Robot], robots: Sequence[Robot]) -> Robot:
    """Batch of robots; see `Robot.stack`."""
    if not robots or not all(isinstance(robot, kind) for robot in robots):
        raise ArgumentError(f"robots must be a sequence of torchdq.Robot, found {robots!r}")
    first, notes = robots[0], dict.fromkeys(note for robot in robots for note in robot.notes)
    changes: dict[str, Any] = {"notes": tuple(notes)}
    for robot in robots:
        require_unchanged(robot)
        for field, x in fields.present(robot, SHAPES).items():
            mine = getattr(first, field)
            if mine is not None and (mine.dtype, mine.device) != (x.dtype, x.device):
                raise ArgumentError(
                    f"robots of a stack must have one dtype and device, found {field} with {mine.dtype} on "
                    f"{mine.device} and with {x.dtype} on {x.device}; convert them by robot.to(dtype, device)"
                )
        for field, axes in batches(robot).items():
            raise ArgumentError(
                f"robots of a stack must have no batch axes, found {axes} of {field} in robot {robot.name!r}; stack "
                "the single robots"
            )
    for name, value in values(first).items():
        found = [getattr(robot, name) for robot in robots]
        if name in ("name", "notes") or all(_equal(value, other) for other in found):
            continue
        if name not in STACKED:
            two = _difference(first, value, next(x for x in found if not _equal(value, x)))
            raise ArgumentError(f"robots of a stack must have the same {name}, found {two}")
        changes[name] = Limits(*map(_together, zip(*found, strict=True))) if name == "limits" else _together(found)
    if not {*SHAPES} & {*changes}:  # equal robots are several, too
        changes["mass"] = _together([robot.mass for robot in robots])
    return first.replace(**changes)


def _together(found: Sequence[Tensor | None]) -> Tensor:
    """Tensors along a new leading axis; absent ones are zero."""
    zero = torch.zeros_like(next(x for x in found if x is not None))
    return torch.stack(torch.broadcast_tensors(*(zero if x is None else x for x in found)))


def _difference(robot: Robot, a: Any, b: Any) -> str:
    """Two different values of a field, in words; of frames or joints with the same names, those that differ."""
    if isinstance(a, JointMap) and isinstance(b, JointMap) and a.joint_names == b.joint_names:
        told = [(name, *(x.followed(name, robot.joint_names) for x in (a, b))) for name in a.joint_names]
        return "; ".join(f"joint {name!r} that follows {x} in one and {y} in another" for name, x, y in told if x != y)
    if isinstance(a, JointMap) or isinstance(b, JointMap):
        return " and ".join("none" if x is None else f"one of the joints {', '.join(x.joint_names)}" for x in (a, b))
    pairs = [*zip(a, b, strict=False)] if isinstance(a, tuple) and isinstance(b, tuple) else []
    if not pairs or len(a) != len(b) or not all(isinstance(x, Frame) and x.name == y.name for x, y in pairs):
        return f"{a} and {b}"
    x, y = next(pair for pair in pairs if not _equal(*pair))
    if x.link != y.link:
        return f"frame {x.name!r} with link {x.link} and {y.link}"
    return f"frame {x.name!r} with X_BF {x.X_BF.tolist()} and {y.X_BF.tolist()}"


def _equal(a: Any, b: Any) -> bool:
    """Whether two values of a field are equal; a tensor that requires grad equals only itself."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return a is b or (not (a.requires_grad or b.requires_grad or a.dtype != b.dtype) and torch.equal(a, b))
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_equal, a, b))
    return type(a) is type(b) and bool(a == b)
