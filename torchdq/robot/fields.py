"""Fields of a robot: their shapes, and the checks of values that are given to `Robot.replace`.

A description's source checks what it reads. Here the same is checked of single fields: values of the wrong kind or
length raise at once; `faults` are numbers that no robot can have.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdq.checks import DTYPES
from torchdq.dynamics.joints import KINDS
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError, DtypeError
from torchdq.program.transforms import without_values
from torchdq.robot import consistency
from torchdq.robot.arrays import UNIT, matrices
from torchdq.robot.description import Frame, Limits

if TYPE_CHECKING:
    from torchdq.robot.robot import Robot

# trailing axes of each tensor field; leading axes are batch axes, "n" is the number of joints
SHAPES: dict[str, tuple] = {
    "X_PB_home": ("n", 8),
    "screw": ("n", 6),
    "home": ("n",),
    "mass": ("n",),
    "com": ("n", 3),
    "inertia": ("n", 6),
    "gravity": (3,),
    "armature": ("n",),
}
OPTIONAL = ("gravity", "home", "armature")
DESCRIBED = ("limits", "damping", "friction", "frames")  # other fields that hold tensors
UNIT_SINGLE = 1e-5  # as UNIT, of numbers in single precision
SCREWS = {
    "revolute": "a unit line (l | p x l)",
    "helical": "a unit line with pitch (l | p x l + h l)",
    "prismatic": "a unit translation (0 | l)",
}


def present(robot: Robot, names: Collection[str]) -> dict[str, Tensor]:
    """Tensors of a robot, by name, that are among the names and are not absent."""
    tensors = {name: getattr(robot, name) for name in SHAPES if name in names}
    return {name: x for name, x in tensors.items() if x is not None}


def batches(robot: Robot) -> dict[str, tuple[int, ...]]:
    """Batch axes, by name, of the tensors of a robot that have some."""
    axes = {name: tuple(x.shape[: x.ndim - len(SHAPES[name])]) for name, x in present(robot, SHAPES).items()}
    return {name: batch for name, batch in axes.items() if batch}


def require_shapes(robot: Robot) -> None:
    """Raise unless the physical tensors of a robot are tensors of their shapes and of a dtype of the package."""
    n = len(robot.joint_names)
    for name, trailing in SHAPES.items():
        value = getattr(robot, name)
        if value is None and name in OPTIONAL:
            continue
        shape = tuple(n if axis == "n" else axis for axis in trailing)
        if not isinstance(value, Tensor) or tuple(value.shape[value.ndim - len(shape) :]) != shape:
            found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            expected = ", ".join(["...", *map(str, shape)])
            raise ArgumentError(
                f"{name} of robot {robot.name!r} must be a tensor of shape [{expected}] for its {n} joints, "
                f"found {found}"
            )
        if value.dtype not in DTYPES:
            raise DtypeError(f"{name} of robot {robot.name!r} must be float32 or float64, found {value.dtype}")


def _strings(x: Any) -> bool:
    return isinstance(x, tuple) and all(isinstance(one, str) for one in x)


def _names(x: Any, n: int) -> bool:
    return _strings(x) and len(x) == len(set(x)) == n


def _row(x: Any, n: int) -> bool:
    return isinstance(x, Tensor) and x.dtype in DTYPES and x.shape[-1:] == (n,)


def _frames(x: Any, n: int) -> bool:
    return (
        isinstance(x, tuple)
        and all(isinstance(frame, Frame) and _row(frame.X_BF, 8) and frame.X_BF.ndim == 1 for frame in x)
        and all(isinstance(frame.link, int) and BASE <= frame.link < n for frame in x)
        and _names(tuple(frame.name for frame in x), len(x))
    )


# expected value of every other field of a robot with n joints, in words and as a test
STRUCTURE: dict[str, tuple[str, Callable[[Any, int], bool]]] = {
    "name": ("a string", lambda x, n: isinstance(x, str)),
    "joint_names": ("a tuple of different names, one per joint", _names),
    "link_names": ("a tuple of different names, one per link", _names),
    "parents": (
        "a tuple with an earlier link or -1 for each link",
        lambda x, n: (
            isinstance(x, tuple) and len(x) == n and all(isinstance(p, int) and BASE <= p < i for i, p in enumerate(x))
        ),
    ),
    "kinds": (
        f"a tuple with one of {', '.join(KINDS)} for each joint",
        lambda x, n: _strings(x) and len(x) == n and set(x) <= set(KINDS),
    ),
    "limits": (
        "Limits of four tensors [n]",
        lambda x, n: getattr(x, "_fields", ()) == Limits._fields and all(_row(bound, n) for bound in x),
    ),
    "damping": ("a tensor [n]", _row),
    "friction": ("a tensor [n]", _row),
    "frames": ("a tuple of Frames with different names, links from -1 to n - 1 and poses [8]", _frames),
    "tip": ("the name of a frame or None", lambda x, n: x is None or isinstance(x, str)),
    "notes": ("a tuple of strings", lambda x, n: _strings(x)),
}


def require_structure(robot: str, n: int, values: Mapping[str, Any]) -> None:
    """Raise unless values are of the kind and the length of their fields, those with physical tensors apart."""
    for name, value in values.items():
        expected, fits = STRUCTURE.get(name, ("", lambda x, n: True))
        if not fits(value, n):
            raise ArgumentError(f"{name} of robot {robot!r} must be {expected}, with n = {n}, found {value!r}")


# --- values ----------------------------------------------------------------------------------------------------------


def readable(x: Tensor, everything: bool) -> bool:
    """Whether a tensor has values to read; and unless `everything` is, one of a single robot that is not learned."""
    return not without_values([x]) and (everything or not x.requires_grad)


def _bad(x: Tensor, mask: Tensor) -> tuple[tuple[int, ...], Any]:
    """Place and value of the first row of x where a mask is true."""
    at = tuple(mask.nonzero()[0].tolist())
    return at, x.detach()[at].tolist()


def _unit(x: Tensor) -> Tensor:
    """Mask of unit dual quaternions [..., 8]."""
    slack = UNIT if x.dtype == torch.float64 else UNIT_SINGLE
    r, d = x[..., :4].double(), x[..., 4:].double()
    return ((r.norm(dim=-1) - 1).abs() <= slack) & ((r * d).sum(-1).abs() <= slack * (1 + d.norm(dim=-1)))


def _of_kind(screw: Tensor, kinds: tuple[str, ...]) -> Tensor:
    """Mask of screws [..., n, 6] of joints of these kinds."""
    slack = UNIT if screw.dtype == torch.float64 else UNIT_SINGLE
    axis, moment = screw[..., :3].double(), screw[..., 3:].double()
    length, size, pitch = axis.norm(dim=-1), moment.norm(dim=-1), (axis * moment).sum(-1)
    line = (length - 1).abs() <= slack
    fits = {
        "revolute": line & (pitch.abs() <= slack * (1 + size)),
        "helical": line & size.isfinite(),
        "prismatic": (length <= slack) & ((size - 1).abs() <= slack),
    }
    return torch.stack([fits[kind][..., i] for i, kind in enumerate(kinds)], -1) if kinds else line


def _geometry(robot: Robot, names: Collection[str], everything: bool) -> Iterator[str]:
    """Faults of poses and screws: those that are no unit ones, and screws that are not of the kind of their joint."""
    poses = {"X_PB_home": robot.X_PB_home} if "X_PB_home" in names else {}
    poses |= {f"pose X_BF of frame {f.name!r}": f.X_BF for f in robot.frames if "frames" in names}
    for name, x in poses.items():
        if readable(x, everything) and not bool(_unit(x.detach()).all()):
            at, found = _bad(x, ~_unit(x.detach()))
            yield f"{name} must be unit dual quaternions (see torchdq.dq.normalize), found {found} at {at}"
    if {"screw", "kinds"} & set(names) and readable(robot.screw, everything):
        fits = _of_kind(robot.screw.detach(), robot.kinds)
        if not bool(fits.all()):
            at, found = _bad(robot.screw, ~fits)
            name, kind = robot.joint_names[at[-1]], robot.kinds[at[-1]]
            yield f"screw of the {kind} joint {name!r} must be {SCREWS[kind]} with |l| = 1, found {found} at {at}"


def faults(robot: Robot, names: Collection[str], everything: bool = False) -> list[str]:
    """Faults of the fields with these names: numbers that no robot can have.

    Args:
        robot: the robot.
        names: names of fields.
        everything: whether batches and tensors that require grad are read, too.
    """
    found, bodies = [*_geometry(robot, names, everything)], (robot.mass, robot.inertia)
    batched = any(x.ndim > axes for x, axes in zip(bodies, (1, 2), strict=True))
    wanted = {"mass", "inertia"} & set(names) and (everything or not batched)
    if wanted and all(readable(x, everything) for x in bodies):
        mass, inertia = (x.detach() for x in bodies)
        found += consistency.bodies(robot.link_names, mass, matrices(inertia))
    for name, expected, x, fits in _rules(robot, names):
        if readable(x, everything) and (everything or x.ndim <= len(SHAPES.get(name, "n"))) and not bool(fits(x).all()):
            at, value = _bad(x, ~fits(x))
            found.append(f"{name} must be {expected}, found {value} at {at}")
    return found


def _rules(robot: Robot, names: Collection[str]) -> Iterator[tuple[str, str, Tensor, Callable[[Tensor], Tensor]]]:
    """Name, expectation in words, tensor and expectation as a mask of every rule on single numbers."""
    for name in ("com", "home", "gravity"):
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
