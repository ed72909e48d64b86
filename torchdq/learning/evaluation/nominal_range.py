"""Motions far beyond the limits of the description, as those in degrees or millimetres or of other joints are."""

import math

import torch
from torch import Tensor

from torchdq.robot import Robot

OFTEN = 0.01  # part of the rows in which a joint must be beyond its limits
PAST = 1.0  # farthest beyond a limit of position that is not doubted, relative to the range between both limits
TURNS = 4 * math.pi  # the same of joints that may make a full turn, whose limits often mean that there are none [rad]
FASTER = 3.0  # times the limit of velocity that are not doubted: simulated motions do not keep it
UNITS = ("rad", "rad/s", "degrees (multiply by pi/180)"), ("m", "m/s", "millimetres (multiply by 0.001)")


def beyond_limits(robot: Robot, q: Tensor, qd: Tensor) -> list[str]:
    """Words for joints that positions and velocities [rows, n] take far beyond the limits of the description."""
    lower, upper, velocity, _ = (x.double().cpu() for x in robot.limits)
    reach = upper - lower
    past = torch.maximum(lower - q.cpu(), q.cpu() - upper)
    turns = torch.tensor([kind.turns for kind in robot.joint_types]) & (reach > 1.99 * math.pi)
    far = ((past > torch.where(turns, TURNS, PAST * reach)).double().mean(0) > OFTEN) & (reach > 0)
    fast = ((qd.cpu().abs() > FASTER * velocity).double().mean(0) > OFTEN) & (velocity > 0)
    told, units = list[str](), set[str]()
    for j, (name, kind) in enumerate(zip(robot.joint_names, robot.joint_types, strict=True)):
        place, speed, other = UNITS[not kind.turns]
        if far[j]:
            low, high = float(q[:, j].min()), float(q[:, j].max())
            told.append(
                f"{name} moves from {low:.3g} to {high:.3g} {place}, its limits are {lower[j]:.3g} and {upper[j]:.3g}"
            )
        elif fast[j]:
            told.append(
                f"{name} moves at up to {float(qd[:, j].abs().max()):.3g} {speed}, its limit is {velocity[j]:.3g}"
            )
        if far[j] or fast[j]:
            units.add(other)
    if not told:
        return []
    found = f"motions go far beyond the limits of the description: {'; '.join(told)}"
    return [f"{found}; are these {' or '.join(sorted(units))}, or of other joints?"]
