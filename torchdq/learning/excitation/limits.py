"""Limits that a motion keeps: of positions, velocities, accelerations, torques, and of the space the arm may use."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq import dq
from torchdq.base.checks import Interval, is_number, require_number, tensor_of
from torchdq.errors import ArgumentError
from torchdq.functional import forward_kinematics
from torchdq.functions.parametric import Parametric
from torchdq.functions.signature import Field, parameter
from torchdq.robot import Robot

Clearance = Callable[[Robot, Tensor], Tensor]  # (robot, q [..., n]) to numbers [..., c], not negative where q may be
WIDER = 1.05  # times the description's limits that are as good as these
FAST, TURNS = 50.0, 4 * math.pi  # [rad/s], [rad] which limits of joints that turn hardly exceed
JOINT_UNITS = {"velocity": ("rad/s", "m/s"), "acceleration": ("rad/s^2", "m/s^2"), "effort": ("N m", "N")}


@dataclass(frozen=True)
class HalfSpace:
    """Space on one side of a plane, for the origin of a frame: normal . p >= least, p in the base frame.

    Called, it is how far the frame is inside [m].

    Args:
        frame: name of the frame.
        normal: direction into the space, in the base frame; it need not have length one.
        least: distance of the plane from the origin of the base along the normal [m].

    >>> import torch, torchdq
    >>> above = HalfSpace("tip", (0, 0, 1), 0.1)  # the tip stays 0.1 m above the base
    >>> above(torchdq.robots.load("two_link"), torch.zeros(2)).shape
    torch.Size([1])
    """

    frame: str
    normal: tuple[float, float, float]
    least: float

    def __post_init__(self) -> None:
        if len(self.normal) != 3 or not all(is_number(x) and math.isfinite(x) for x in self.normal):
            raise ArgumentError(f"normal must be three numbers, found {self.normal!r}")
        require_number("least", self.least)
        if not any(self.normal):
            raise ArgumentError(f"normal of the half-space of frame {self.frame!r} must be a direction, found zero")

    def __call__(self, robot: Robot, q: Tensor) -> Tensor:
        """Distance [..., 1] of the frame from the plane [m], negative outside."""
        p = dq.translation(forward_kinematics(robot, q, self.frame))
        normal = torch.tensor(self.normal, dtype=q.dtype) / math.hypot(*self.normal)
        return p @ normal[:, None] - self.least


class Bounds(NamedTuple):
    """Numbers of the limits, one per joint each."""

    lower: Tensor  # [n] [rad or m]
    upper: Tensor  # [n] [rad or m]
    velocity: Tensor  # [n] [rad/s or m/s]
    acceleration: Tensor  # [n] [rad/s^2 or m/s^2], infinite where there is none
    effort: Tensor  # [n] [N m or N]


def _limit(described: str, least: float = 0.0) -> Mapping[Any, Field]:
    """Metadata of a limit per joint, which may be infinite; None: that of the description."""
    return parameter("n", check=Interval(least, infinite=True), described=described)


@dataclass(frozen=True, eq=False)
class MotionLimits(Parametric):
    """Limits that a motion keeps, each one number for all joints or one per joint.

    Args:
        lower, upper: least and greatest positions [rad or m]; None: the robot's.
        velocity: greatest speed [rad/s or m/s]; None: the robot's.
        acceleration: greatest acceleration [rad/s^2 or m/s^2]; None: none but what the torques allow.
        effort: greatest torque, gravity and described friction included [N m or N]; None: the robot's.
        share: part of these that is used: of velocities, accelerations and torques, and of the range about its middle.
            The description's torques may be off, and a controller overshoots.
        workspace: `HalfSpace`, or functions (robot, q [..., n]) that return numbers [..., c], differentiable in q and
            not negative where the arm may be. A half-space holds for the origin of a frame: leave room for the
            body around it. Nothing here knows whether links collide with each other.

    >>> MotionLimits(velocity=1.0, workspace=(HalfSpace("tip", (0, 0, 1), 0.05),)).share
    0.9
    """

    lower: Any = field(default=None, metadata=_limit("limits.lower", -math.inf))
    upper: Any = field(default=None, metadata=_limit("limits.upper", -math.inf))
    velocity: Any = field(default=None, metadata=_limit("limits.velocity"))
    acceleration: Any = field(default=None, metadata=_limit(""))
    effort: Any = field(default=None, metadata=_limit("limits.effort"))
    share: float = 0.9
    workspace: Sequence[Clearance] = ()

    def __post_init__(self) -> None:
        require_number("share", self.share, positive=True)
        if self.share > 1:
            raise ArgumentError(f"share must be at most 1, the limits themselves, found {self.share}")
        if not isinstance(self.workspace, Sequence) or not all(map(callable, self.workspace)):
            expected = "a sequence of HalfSpace or functions (robot, q)"
            raise ArgumentError(f"workspace must be {expected}, found {self.workspace!r}")

    def bounds(self, robot: Robot) -> Bounds:
        """Numbers of the limits for a robot, its share taken.

        Raises:
            ArgumentError: a joint lacks one.
        Warns:
            UserWarning: one is wider than that of the description, as degrees are.
        """
        whole = replace(self, acceleration=math.inf) if self.acceleration is None else self
        whole = replace(whole, workspace=()).resolved(robot)
        found = Bounds(*(tensor_of(getattr(whole, name)).detach().double().cpu() for name in Bounds._fields))
        if any(x.ndim > 1 for x in found):
            raise ArgumentError("limits must be those of one robot, found batch axes")
        joints = zip(robot.joint_names, robot.joint_types, *(x.tolist() for x in found), strict=True)
        for joint, kind, lower, upper, *others in joints:
            whose = f"of joint {joint!r} of robot {robot.name!r}"
            if not -math.inf < lower < upper < math.inf:
                unit = "rad" if kind.turns else "m"
                what = f"position {whose} must have finite limits, lower below upper"
                cure = "give MotionLimits(lower=..., upper=...)"
                raise ArgumentError(f"{what}, found {lower:g} to {upper:g} {unit}; {cure}")
            for (name, units), x in zip(JOINT_UNITS.items(), others, strict=True):
                if not x > 0 or (math.isinf(x) and name != "acceleration"):
                    wrong = f"{name} {whose} must have a finite limit, found {x:g} {units[not kind.turns]}"
                    raise ArgumentError(f"{wrong}; give MotionLimits({name}=...) with one number, or one per joint")
        _warn_of_wider(robot, found)
        middle, reach = (found.upper + found.lower) / 2, self.share * (found.upper - found.lower) / 2
        return Bounds(middle - reach, middle + reach, *(self.share * x for x in found[2:]))

    def clearance(self, robot: Robot, q: Tensor) -> Tensor:
        """Numbers [..., c] of all parts of the workspace at positions [..., n], not negative where q may be."""
        parts = [part(robot, q) for part in self.workspace]
        return torch.cat(parts, -1) if parts else q[..., :0]


def _warn_of_wider(robot: Robot, found: Bounds) -> None:
    """Warn of limits that are wider than those of the description, or than joints turn."""
    wide, numbers = list[str](), (x.tolist() for x in (*robot.limits[:3], *found[:3]))
    joints = zip(robot.joint_names, robot.joint_types, *numbers, strict=True)
    for joint, kind, low, high, fast, lower, upper, velocity in joints:
        if kind.turns:
            low, high, fast = max(low, -TURNS), min(high, TURNS), min(fast, FAST)
        slack, unit = (WIDER - 1) * (high - low), "rad" if kind.turns else "m"
        if lower < low - slack or upper > high + slack:
            wide.append(f"{joint} {lower:.4g} to {upper:.4g} {unit} instead of {low:.3g} to {high:.3g}")
        if velocity > WIDER * fast:
            wide.append(f"{joint} {velocity:.4g} {unit}/s instead of {fast:.3g}")
    if wide:
        cure = "are they in degrees? give radians and metres, or the robot's own limits, by None"
        claim = f"limits are wider than those of the description: {', '.join(wide)}"
        warnings.warn(f"{claim}; {cure}", stacklevel=5)
