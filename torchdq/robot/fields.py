"""Fields of a robot: their names, shapes and kinds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from torchdq.base.checks import DTYPES, is_dense
from torchdq.dynamics.joints import KINDS
from torchdq.dynamics.tree import BASE
from torchdq.findings import Finding
from torchdq.program.transforms import without_values
from torchdq.robot.description import Closure, Frame, JointMap, Limits

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
INERTIAL = ("mass", "inertia", "armature", "base_mass", "base_inertia")  # with all of them zero nothing has dynamics
OPTIONAL = ("gravity", "home", "armature", *BASE_BODY)
DESCRIBED = ("limits", "damping", "friction", "frames", "joint_map")  # other fields that hold tensors


def trailing(axes: Axes, sizes: Mapping[str, int]) -> tuple[int, ...]:
    """Trailing axes as numbers."""
    return tuple([sizes[axis] if isinstance(axis, str) else axis for axis in axes])


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
    "closures": (
        "a tuple of Closures",
        lambda x, n, links: isinstance(x, tuple) and all(isinstance(one, Closure) for one in x),
    ),
    "tip": ("the name of a frame or None", lambda x, n, links: x is None or isinstance(x, str)),
    "notes": (
        "a tuple of findings",
        lambda x, n, links: isinstance(x, tuple) and all(isinstance(one, Finding) for one in x),
    ),
}


def readable(x: Tensor, everything: bool) -> bool:
    """Whether a tensor has values to read; and unless `everything` is, one of a single robot that is not learned."""
    return not without_values([x]) and (everything or not x.requires_grad)
