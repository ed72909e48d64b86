"""Robots whose links are rods: bodies to begin with, where only the mass of the whole is known."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import ZERO, Pure
from torchdq.base.checks import require_number
from torchdq.dynamics.joints import KINDS, Along
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot.arrays import SIX, double
from torchdq.robot.edit.replaced import replace
from torchdq.robot.model import AnyRobot, RobotModel, batches
from torchdq.robot.tree import plain

THIN = 1 / 20  # radius of the rods, in lengths of all of them
NEAR = 1e-12  # length that is rounding [m]


def with_rods(robot: AnyRobot, mass: float, radius: float | None = None) -> AnyRobot:
    """Robot whose links are rods of one thickness and density: a guess from the mass of the whole, to identify from.

    At home, a rod goes from the axis of its joint, square to it, to the farthest rod that its link carries, the last
    one to the end effector, or the farthest frame. One without length lies along its axis. Rods are solid cylinders,
    longer by the radius at either end, so that each link has mass and inertia. All bodies of links are replaced; that
    of a floating base is not.

    `identify` starts from any robot that can exist: masses, centres and inertias that torques determine are found, and
    the others stay as the rods have them.

    Args:
        robot: the robot, as of a table without masses, or of a file without <inertial>.
        mass: of all links together, as from a data sheet [kg].
        radius: of the rods [m]; None: a twentieth of their length, all together.

    Raises:
        ArgumentError: the robot has batch axes; the mass or the radius is not positive; all rods are points and no
            radius is given.

    >>> import torchdq
    >>> arm = torchdq.Robot.from_dh(
    ...     a=[0.5, 0.3], alpha=[0, 0], d=[0, 0], theta=[0, 0]
    ... )
    >>> rods = arm.with_rods(10.0)
    >>> [round(x, 2) for x in rods.mass.tolist()], rods.com[:, 0].tolist()
    ([6.04, 3.96], [-0.25, -0.15])
    """
    require_number("mass", mass, positive=True)
    for name, axes in batches(robot).items():
        raise ArgumentError(
            f"{name} of robot {robot.name!r} must have no batch axes, found {axes}; give one robot rods"
        )
    starts, ends, along = double(_rods(robot)).reshape(-1, 3, 3).unbind(1)
    lengths = (ends - starts).norm(dim=-1)
    lengths = lengths.where(lengths > NEAR, 0.0)
    if radius is None and not lengths.any():
        raise ArgumentError(f"radius must be given for robot {robot.name!r}, whose rods have no length, found None")
    r = THIN * float(lengths.sum()) if radius is None else radius
    require_number("radius", r, positive=True)
    h = lengths + 2 * r
    m = mass * h / h.sum()
    along = torch.where(lengths[:, None] > 0, ends - starts, along)
    bodies = {"mass": m, "com": (starts + ends) / 2, "inertia": _cylinders(m, h, r, along)}
    return replace(robot, **{name: x.to(robot.mass) for name, x in bodies.items()})


def _cylinders(mass: Tensor, height: Tensor, radius: float, along: Tensor) -> Tensor:
    """Inertias [links, 6] of solid cylinders."""
    u = along / along.norm(dim=-1, keepdim=True)
    across, about = mass * (3 * radius**2 + height**2) / 12, mass * radius**2 / 2
    one = torch.eye(3, dtype=u.dtype)
    I = across[:, None, None] * one + (about - across)[:, None, None] * u[:, :, None] * u[:, None, :]
    return I[:, *SIX]


def _rods(robot: RobotModel) -> list[tuple[Pure, Pure, Pure]]:
    """Starts and ends of rods and directions of joints, in the frames of the links: a rod starts at its end's foot."""
    placements, screws = ([(x[:k], x[k:]) for x in plain(robot, name)] for name, k in (("X_PB_home", 4), ("screw", 3)))
    carried: list[list[Pure]] = [[] for _ in placements]
    rods = []
    for i in reversed(range(len(placements))):
        joint, (X, parent) = KINDS[robot.kinds[i]](screws[i]), (placements[i], robot.parents[i])
        frames = {x.name: tuple(x.X_BF.tolist()) for x in robot.frames if x.link == i}
        chosen = [frames[robot.tip]] if robot.tip in frames else frames.values()
        places = carried[i] or [dual_quaternion.translation((x[:4], x[4:])) for x in chosen] or [ZERO]
        pairs = [(_foot(joint, p), p) for p in places]
        start, end = max(pairs, key=lambda x: quat.norm2(quat.sub(*x)))
        rods.append((start, end, joint.direction))
        if parent != BASE:
            carried[parent].append(quat.add(dual_quaternion.translation(X), quat.rotate(X[0], start)))
    return rods[::-1]


def _foot(joint: Along, p: Pure) -> Pure:
    """Point of the axis of a joint closest to another one, which is that itself where the joint only slides."""
    if not joint.turns:
        return p
    along = quat.dot(quat.sub(p, joint.point), joint.direction)
    return quat.add(joint.point, quat.scale(along, joint.direction))
