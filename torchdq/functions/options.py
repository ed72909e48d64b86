"""Options of public functions: names that a program depends on, checked, with the defaults of the functions."""

import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import require
from torchdq.dynamics.task_space import AXES, COMPONENTS, Task, rows_of
from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.functions.catalogue import RECIPES, Function
from torchdq.functions.posed import frame, posed
from torchdq.functions.recipe import PAIRS, TASK, TIP
from torchdq.functions.signature import Field
from torchdq.program.transforms import constant_in_graphs, with_values
from torchdq.robot import ContactPoint, Robot
from torchdq.robot.constants import Constants
from torchdq.robot.contact_points import points_of
from torchdq.robot.robot import constants, recorded

Options = tuple[Any, ...]
UNSERVED = ("contact_force",)  # functions of more axes than the joints need to move


def _read(robot: Robot, fields: Sequence[Field], given: Sequence[Any], subject: str) -> Options:
    """Options, None where they are absent, with the defaults of a robot; raises unless they are meaningful."""
    single = [field for field in fields if field.name != "frames"]
    if len(given) > len(single) == len(fields):
        names = ", ".join(field.name for field in fields)
        expected = f"must be at most {names}, in this order" if names else "must be left out: there are none"
        raise ArgumentError(f"options of {subject} {expected}, found {given!r}")
    found = [_one(robot, field, x) for field, x in zip(single, (*given, *[None] * len(single)), strict=False)]
    for field in fields[len(single) :]:
        frames = given[len(single) :] or ([robot.end_effector().name] if field.default == TIP else robot.frame_names)
        found += [robot.frame(name).name for name in frames]
    return tuple(found)


def _one(robot: Robot, field: Field, x: Any) -> Any:
    """Option of a robot; None: its default."""
    x = field.default if x is None else x
    if field.name == "tip":
        x = robot.tip or "" if x == TIP else x
        return robot.frame(x).name if x else ""
    if field.name == "frame" and x is None:
        raise ArgumentError(f"frame must be given; the frames are {', '.join(robot.frame_names)}")
    if field.name == "frame":
        return robot.frame(robot.end_effector().name if x == TIP or (x == "" and field.default == TIP) else x).name
    if field.name == "points":
        return points_of(robot, ContactPoint(robot.end_effector().name) if x == TIP else x)
    if field.name == "axes":
        x = axes_of(x)
    elif field.name != "objects":
        require(field.name, x, field.check)
    return x


def task_of(robot: Robot, name: str | None, expressed: str, axes: str | Sequence[str]) -> tuple[str, str, Task]:
    """Name of a frame, its axes, and both as a task; raises unless the joints move these axes independently."""
    frame_name, expressed, named = _read(robot, TASK, (name, expressed, axes), "a task")
    require_served(robot, frame_name, expressed, named)
    return frame_name, named, Task(*frame(robot, frame_name), expressed == "world", rows_of(named))


def axes_of(axes: str | Sequence[str]) -> str:
    """Axes as one option, their names one after the other; raises unless they are some components, and different."""
    if not isinstance(axes, str) and not (isinstance(axes, Sequence) and all(isinstance(x, str) for x in axes)):
        raise ArgumentError(f"axes must be a name or a sequence of names, found {axes!r}")
    found = axes if isinstance(axes, str) else " ".join(axes)
    wanted = _components(found)
    if not wanted or len(set(wanted)) < len(wanted) or not set(wanted) <= set(COMPONENTS):
        raise ArgumentError(
            f"axes must be 'pose', 'position', 'orientation', or different names among {' '.join(COMPONENTS)}, "
            f"found {found!r}"
        )
    return found


def _components(axes: str) -> tuple[str, ...]:
    """Names of the components that axes mean."""
    return AXES.get(axes, tuple(axes.split()))


def require_served(robot: Robot, name: str, expressed: str, axes: str) -> None:
    """Raise unless axes are components of the twist of a frame that the joints can move independently."""
    wanted = _components(axes)
    served = independent(robot, name, expressed, wanted)
    if len(served) < len(wanted):
        cure, option = "take another frame", None
        if served:
            cure = f"take axes={served}"
            option = f"take --options {shlex.join((name, expressed, ' '.join(served)))}"
        expected = (
            f"axes must be at most {len(served)} of {' '.join(wanted)}, of which its joints move no more independently"
        )
        subject = f"frame {name!r} of robot {robot.name!r}"
        raise ArgumentError(Finding("axes.unserved", subject, expected, cure=cure, option=option))


def independent(robot: Robot, name: str, expressed: str, wanted: tuple[str, ...] = COMPONENTS) -> tuple[str, ...]:
    """Components of the twist of a frame, of those wanted, that the joints move independently at some posture.

    Displacements are taken first. All of them for a geometry that is an argument, whose numbers are not known.
    """
    if any(x.isnan().any() for x in (robot.X_PB_home, robot.screw, robot.home) if x is not None):
        return wanted
    found: list[tuple[str, ...]] = []
    rows = tuple([COMPONENTS.index(axis) for axis in wanted])
    for start in (0.37, 1.13, 2.71):
        q = [2.0 * np.sin(start * (k + 1.0)) for k in range(robot.n)]
        J = np.array(Task(*frame(robot, name), expressed == "world", rows).jacobian(posed(robot, q, {}, ())))
        kept: list[int] = []
        for r in sorted(range(len(rows)), key=lambda r: rows[r] < 3):
            # a URDF has angles with five digits, so an arm may be planar up to those only
            kept += [r] if np.linalg.matrix_rank(J[[*kept, r]], 1e-4) > len(kept) else []
        found.append(tuple([wanted[r] for r in sorted(kept)]))
    return max(found, key=len)


def options_of(robot: Robot, function: str, given: Any) -> Options:
    """Options of a function of a robot, complete; raises unless they are names that the function knows."""
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, Sequence):
        raise ArgumentError(f"options must be a sequence of names, found {given!r}")
    if function not in RECIPES or RECIPES[function].options != PAIRS:
        names = [axes_of(x) if isinstance(x, list | tuple) else x for x in names]
    return _in_graphs(constants(robot), function, *names)


@constant_in_graphs
def _in_graphs(*of: Any) -> Options:
    """Options, also in a graph that is being traced."""
    return _complete(*of)


@remembered(PROGRAMS)
def _complete(of: Constants, function: str, *given: Any) -> Options:
    """Options of a function of a robot with these constants, complete."""
    fields = RECIPES[function].options if function in RECIPES else ()
    with with_values():
        robot = recorded(of)
        if robot.floating:
            Function(of, function).require_base()
        found = _read(robot, fields, given, repr(function))
        if fields[:3] == TASK and function not in UNSERVED:
            require_served(robot, *found[:3])
    return found
