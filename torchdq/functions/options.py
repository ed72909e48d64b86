"""Options of public functions: names that a program depends on, checked, with the defaults of the functions."""

from collections.abc import Callable, Sequence
from typing import Any

from torchdq.errors import ArgumentError
from torchdq.robot import Robot

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


def _tip(robot: Robot, *given: str) -> Options:
    """Name of the tip, or "" for none; not given: the robot's."""
    if len(given) > 1:
        raise ArgumentError(f"options of 'closed_form' must be one frame or '', found {given}")
    tip = given[0] if given else robot.tip or ""
    return (robot.frame(tip).name if tip else "",)


def _single_gains(robot: Robot, *given: str) -> Options:
    """Names of gains that are one number for all joints."""
    if not set(given) <= {"kp", "kd"}:
        raise ArgumentError(f"options of 'computed_torque' must be among 'kp' and 'kd', found {given}")
    return given


_READERS: dict[str, Callable[..., Options]] = {
    "forward_kinematics": _frames,
    "jacobian": _frame_and_axes,
    "floating.forward_kinematics": _frames,
    "floating.jacobian": _frame_and_axes,
    "closed_form": _tip,
    "computed_torque": _single_gains,
}


def options_of(robot: Robot, function: str, given: Any) -> Options:
    """Options of a function of a robot, complete; raises unless they are names that the function knows."""
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, Sequence):
        raise ArgumentError(f"options must be a sequence of names, found {given!r}")
    reader = _READERS.get(function)
    if reader is not None:
        return reader(robot, *names)
    if names:
        raise ArgumentError(f"{function!r} has no options, found {given!r}")
    return ()
