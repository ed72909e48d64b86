"""Fields of a robot: their shapes, and the checks of values that are given to `Robot.replace`.

A description's source checks what it reads. Here the same is checked of single fields: values of the wrong kind or
length raise at once; `faults` are numbers that no robot can have.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdq.base.checks import DTYPES, is_dense, require_tensor
from torchdq.dynamics.joints import KINDS
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError, DtypeError
from torchdq.program.transforms import without_values
from torchdq.robot.arrays import first, matrices, not_unit, slack
from torchdq.robot.check import consistency
from torchdq.robot.description import Frame, JointMap, Limits

if TYPE_CHECKING:
    from torchdq.robot.robot import Robot

Axes = tuple[int | str, ...]  # trailing axes, by number or by name

# trailing axes of each tensor field, see `Robot.sizes`; leading axes are batch axes
SHAPES: dict[str, Axes] = {
    "X_PB_home": ("links", 8),
    "screw": ("links", 6),
    "home": ("links",),
    "mass": ("links",),
    "com": ("links", 3),
    "inertia": ("links", 6),
    "gravity": (3,),
    "armature": ("n",),
    "base_mass": (),
    "base_com": (3,),
    "base_inertia": (6,),
}
LINK_BODY = ("mass", "com", "inertia")
BASE_BODY = ("base_mass", "base_com", "base_inertia")
BODIES = (*LINK_BODY, *BASE_BODY)
OPTIONAL = ("gravity", "home", "armature", *BASE_BODY)
DESCRIBED = ("limits", "damping", "friction", "frames", "joint_map")  # other fields that hold tensors
SCREWS = {
    "revolute": "a unit line (l | p x l)",
    "helical": "a unit line with pitch (l | p x l + h l)",
    "prismatic": "a unit translation (0 | l)",
}


def trailing(axes: Axes, sizes: Mapping[str, int]) -> tuple[int, ...]:
    """Trailing axes as numbers."""
    return tuple([sizes[axis] if isinstance(axis, str) else axis for axis in axes])


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
    absent = [name for name in BASE_BODY if getattr(robot, name) is None]
    if 0 < len(absent) < 3:
        raise ArgumentError(
            f"base_mass, base_com and base_inertia of robot {robot.name!r} must be given together, for a free base, or "
            f"all be None; {', '.join(absent)} {'is' if len(absent) == 1 else 'are'} None"
        )
    for name, axes in SHAPES.items():
        value = getattr(robot, name)
        if value is None and name in OPTIONAL:
            continue
        shape = trailing(axes, robot.sizes)
        if isinstance(value, Tensor):
            require_tensor(f"{name} of robot {robot.name!r}", value)
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


def _names(x: Any, count: int) -> bool:
    return _strings(x) and len(x) == len(set(x)) == count


def _row(x: Any, size: int) -> bool:
    return isinstance(x, Tensor) and is_dense(x) and x.dtype in DTYPES and x.shape[-1:] == (size,)


def _parents(x: Any, links: int) -> bool:
    return (
        isinstance(x, tuple) and len(x) == links and all(isinstance(p, int) and BASE <= p < i for i, p in enumerate(x))
    )


def _frames(x: Any, links: int) -> bool:
    return (
        isinstance(x, tuple)
        and all(isinstance(frame, Frame) and _row(frame.X_BF, 8) and frame.X_BF.ndim == 1 for frame in x)
        and all(isinstance(frame.link, int) and BASE <= frame.link < links for frame in x)
        and _names(tuple(frame.name for frame in x), len(x))
    )


def _joint_map(x: Any, n: int, links: int) -> bool:
    return getattr(x, "_fields", ()) == JointMap._fields and _names(x.joint_names, links) and x.S.shape == (links, n)


# expected value of every other field of a robot with n joints, in words and as a test
STRUCTURE: dict[str, tuple[str, Callable[[Any, int, int], bool]]] = {
    "name": ("a string", lambda x, n, links: isinstance(x, str)),
    "joint_names": ("a tuple of different names, one per joint", lambda x, n, links: _names(x, n)),
    "link_names": ("a tuple of different names, one per link", lambda x, n, links: _names(x, links)),
    "parents": ("a tuple with an earlier link or -1 for each link", lambda x, n, links: _parents(x, links)),
    "kinds": (
        f"a tuple with one of {', '.join(KINDS)} for each link",
        lambda x, n, links: _strings(x) and len(x) == links and set(x) <= set(KINDS),
    ),
    "limits": (
        "Limits of four tensors [n]",
        lambda x, n, links: getattr(x, "_fields", ()) == Limits._fields and all(_row(bound, n) for bound in x),
    ),
    "damping": ("a tensor [n]", lambda x, n, links: _row(x, n)),
    "friction": ("a tensor [n]", lambda x, n, links: _row(x, n)),
    "frames": (
        "a tuple of Frames with different names, links from -1 to links - 1 and poses [8]",
        lambda x, n, links: _frames(x, links),
    ),
    "joint_map": (
        "a JointMap of the names of all joints and a tensor [links, n], or None",
        lambda x, n, links: links == n if x is None else _joint_map(x, n, links),
    ),
    "tip": ("the name of a frame or None", lambda x, n, links: x is None or isinstance(x, str)),
    "notes": ("a tuple of strings", lambda x, n, links: _strings(x)),
}


def require_structure(robot: Robot, values: Mapping[str, Any]) -> None:
    """Raise unless values are of the kind and the length of their fields, those with physical tensors apart."""
    sizes = robot.sizes
    for name, value in values.items():
        expected, fits = STRUCTURE.get(name, ("", lambda x, n, links: True))
        if not fits(value, **sizes):
            counts = f"n = {robot.n}" + ("" if robot.joint_map is None else f" and links = {sizes['links']}")
            raise ArgumentError(f"{name} of robot {robot.name!r} must be {expected}, with {counts}, found {value!r}")


# --- values ----------------------------------------------------------------------------------------------------------


def readable(x: Tensor, everything: bool) -> bool:
    """Whether a tensor has values to read; and unless `everything` is, one of a single robot that is not learned."""
    return not without_values([x]) and (everything or not x.requires_grad)


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


def _geometry(robot: Robot, names: Collection[str], everything: bool) -> Iterator[str]:
    """Faults of poses and screws: those that are no unit ones, and screws that are not of the kind of their joint."""
    poses = {"X_PB_home": robot.X_PB_home} if "X_PB_home" in names else {}
    poses |= {f"pose X_BF of frame {f.name!r}": f.X_BF for f in robot.frames if "frames" in names}
    for name, x in poses.items():
        if readable(x, everything) and (fault := not_unit(name, x.detach(), slack(x))):
            yield fault
    if {"screw", "kinds"} & set(names) and readable(robot.screw, everything):
        fits = _of_kind(robot.screw.detach(), robot.kinds)
        if not bool(fits.all()):
            at, found = first(robot.screw, ~fits)
            name, kind = robot.every_joint[at[-1]], robot.kinds[at[-1]]
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
    base = {name: x for name, x in present(robot, ("base_mass", "base_inertia")).items() if name in names}
    if base and robot.base_mass is not None and robot.base_inertia is not None:
        shaped = robot.base_mass.unsqueeze(-1), matrices(robot.base_inertia).unsqueeze(-3)
        if all(readable(x, everything) for x in shaped):
            found += consistency.bodies(("the base",), *(x.detach() for x in shaped))
    for name, expected, x, fits in _rules(robot, names):
        if readable(x, everything) and (everything or x.ndim <= len(SHAPES.get(name, "n"))) and not bool(fits(x).all()):
            at, value = first(x, ~fits(x))
            found.append(f"{name} must be {expected}, found {value} at {at}")
    return found


def _rules(robot: Robot, names: Collection[str]) -> Iterator[tuple[str, str, Tensor, Callable[[Tensor], Tensor]]]:
    """Name, expectation in words, tensor and expectation as a mask of every rule on single numbers."""
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
