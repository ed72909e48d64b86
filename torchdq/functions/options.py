"""Options of public functions: names that a program depends on, checked, with the defaults of the functions."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from torchdq.base.caches import PROGRAMS, remembered
from torchdq.dynamics.task_space import AXES, COMPONENTS, Task, rows_of
from torchdq.errors import ArgumentError
from torchdq.functions.catalogue import Function
from torchdq.functions.posed import frame, posed
from torchdq.program.transforms import constant_in_graphs, with_values
from torchdq.robot import Robot
from torchdq.robot.constants import Constants
from torchdq.robot.robot import constants, recorded

Options = tuple[str, ...]


def _frames(robot: Robot, *names: str) -> Options:
    """Names of frames; none: all frames."""
    return tuple([robot.frame(name).name for name in names]) or robot.frame_names


def _frame_and_axes(robot: Robot, *given: str) -> Options:
    """Name of a frame, and the axes that its twist is in."""
    if not 1 <= len(given) <= 2:
        raise ArgumentError(
            f"options of 'jacobian' must be the name of a frame and 'body' or 'world', found {given}; the frames are "
            f"{', '.join(robot.frame_names)}"
        )
    frame, expressed = (*given, "body")[:2]
    if expressed not in ("body", "world"):
        raise ArgumentError(f"expressed must be 'body' or 'world', found {expressed!r}")
    return robot.frame(frame).name, expressed


def _axes_and_frames(robot: Robot, expressed: str = "world", *names: str) -> Options:
    """Axes that wrenches are in, and names of the frames that they are at; none: the tip."""
    return expressed, *[_frame_and_axes(robot, x, expressed)[0] for x in names or [robot.end_effector().name]]


def _tip(robot: Robot, *given: str) -> Options:
    """Name of the tip, or "" for none; not given: the robot's."""
    if len(given) > 1:
        raise ArgumentError(f"options of 'closed_form' must be one frame or '', found {given}")
    tip = given[0] if given else robot.tip or ""
    return (robot.frame(tip).name if tip else "",)


def _task(*marks: str, served: bool = True) -> Callable[..., Options]:
    """Reader of a frame, the axes that its twist is in, and its components, followed by those of some marks.

    `served`: whether the joints must move all of these components.
    """

    def read(robot: Robot, *given: str) -> Options:
        named = [name for name in given if name not in marks]
        if len(named) > 3:
            raise ArgumentError(
                f"options must be a frame, 'body' or 'world', and axes{', and ' if marks else ''}{', '.join(marks)}, "
                f"found {given}"
            )
        tip, expressed, axes = (*named, *("", "body", "pose")[len(named) :])
        name, expressed = _frame_and_axes(robot, tip or robot.end_effector().name, expressed)
        if served:
            require_served(robot, name, expressed, axes)
        else:
            _distinct(axes)
        return (name, expressed, axes, *[mark for mark in marks if mark in given])

    return read


def task_of(robot: Robot, name: str | None, expressed: str, axes: str | Sequence[str]) -> tuple[str, str, Task]:
    """Name of a frame, its axes, and both as a task; raises unless the joints move these axes independently."""
    name, expressed, axes = _task()(robot, name or "", expressed, axes_of(axes))
    return name, axes, Task(*frame(robot, name), expressed == "world", rows_of(axes))


def axes_of(axes: str | Sequence[str]) -> str:
    """Axes as one option: their names, one after the other."""
    if not isinstance(axes, str) and not (isinstance(axes, Sequence) and all(isinstance(x, str) for x in axes)):
        raise ArgumentError(f"axes must be a name or a sequence of names, found {axes!r}")
    found = axes if isinstance(axes, str) else " ".join(axes)
    _distinct(found)
    return found


def _distinct(axes: str) -> tuple[str, ...]:
    """Names of the components that axes mean; raises unless they are some, and different."""
    wanted = AXES.get(axes, tuple(axes.split()))
    if not wanted or len(set(wanted)) < len(wanted) or not set(wanted) <= set(COMPONENTS):
        raise ArgumentError(
            f"axes must be 'pose', 'position', 'orientation', or different names among {' '.join(COMPONENTS)}, "
            f"found {axes!r}"
        )
    return wanted


def require_served(robot: Robot, name: str, expressed: str, axes: str) -> None:
    """Raise unless axes are components of the twist of a frame that the joints can move independently."""
    wanted = _distinct(axes)
    served = _components(robot, name, expressed, wanted)
    if len(served) < len(wanted):
        cure = f"take axes={served}" if served else "take another frame"
        raise ArgumentError(
            f"axes must be at most {len(served)} of {' '.join(wanted)} for frame {name!r} of robot {robot.name!r}, "
            f"whose joints move no more of them independently; {cure}"
        )


def _components(robot: Robot, name: str, expressed: str, wanted: tuple[str, ...]) -> tuple[str, ...]:
    """Components that the joints move independently at some posture, of those that are wanted; displacements first.

    All of them for a geometry that is an argument, whose numbers are not known.
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


_READERS: dict[str, Callable[..., Options]] = {
    "forward_kinematics": _frames,
    "jacobian": _frame_and_axes,
    "floating.forward_kinematics": _frames,
    "floating.jacobian": _frame_and_axes,
    "external_wrenches": _axes_and_frames,
    "floating.external_wrenches": _axes_and_frames,
    "closed_form": _tip,
    "frame_motion": lambda robot, *given: _frame_and_axes(robot, *(given or (robot.end_effector().name,))),
    "operational_space": _task(),
    "manipulability": _task(),
    "inverse_kinematics_step": _task(),
    "inverse_kinematics_newton": _task(),
    "differential_inverse_kinematics": _task("bounded"),
    "contact_force": _task(served=False),
}


def options_of(robot: Robot, function: str, given: Any) -> Options:
    """Options of a function of a robot, complete; raises unless they are names that the function knows."""
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, Sequence):
        raise ArgumentError(f"options must be a sequence of names, found {given!r}")
    return _in_graphs(constants(robot), function, *[axes_of(x) if isinstance(x, list | tuple) else x for x in names])


@constant_in_graphs
def _in_graphs(*of: Any) -> Options:
    """Options, also in a graph that is being traced."""
    return _complete(*of)


@remembered(PROGRAMS)
def _complete(of: Constants, function: str, *given: str) -> Options:
    """Options of a function of a robot with these constants, complete."""
    reader = _READERS.get(function)
    if reader is None:
        if given:
            raise ArgumentError(f"{function!r} has no options, found {given!r}")
        return ()
    with with_values():
        robot = recorded(of)
        if robot.floating:
            Function(of, function).require_base()
        return reader(robot, *given)
