"""Points at which robots touch the ground."""

from __future__ import annotations

from typing import NamedTuple

from torchdq.base.checks import require_number, require_object
from torchdq.errors import ArgumentError
from torchdq.robot.model import RobotModel


class ContactPoint(NamedTuple):
    """Sphere fixed to a frame of a robot, which can touch the ground; without a radius it is a point."""

    frame: str  # name
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the frame [m]
    radius: float = 0.0  # [m]


def require_contact_point(robot: RobotModel, point: ContactPoint) -> None:
    """Raise unless a contact point lies on a frame of a robot, and has the numbers of a sphere."""
    require_object("points", point, ContactPoint, "torchdq.robot.ContactPoint", "ContactPoint('foot', radius=0.02)")
    robot.frame(point.frame)
    what = f"of the contact point on {point.frame!r}"
    if not isinstance(point.center, tuple) or len(point.center) != 3:
        raise ArgumentError(f"center {what} must be a tuple of three numbers [m], found {point.center!r}")
    for x in point.center:
        require_number(f"center {what}", x)
    require_number(f"radius {what}", point.radius, least=0.0)
