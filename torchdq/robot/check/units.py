"""Suspicions about the units of a robot: angles in degrees, lengths in millimetres, inertias in other units.

A robot with such numbers can exist, so these are warnings and not faults. Masses and inertias that are all too large by
one factor look like those of another material, and a mass in g like that of a point: neither is seen.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from torchdq.algebra.inertia import RigidBody
from torchdq.dynamics.joints import KINDS
from torchdq.findings import Finding
from torchdq.program.transforms import without_values
from torchdq.robot.model import RobotModel, factors

# Every robot of example-robot-data and of this package stays below a suspicion by a factor: of eight for lengths; for
# sizes of bodies, where files have placeholders such as 1 kg m^2 in a humanoid, of 1.6.
TURN = 2 * math.pi + 1e-5  # largest angle of a placement [rad]; degrees are larger
TURNS = (20.0, 720.0)  # limits of a turning joint [rad] that are suspected; those of 1000 and more stand for none
WHOLE = 0.05  # distance of a limit from whole turns [rad]: 31.4 are five
NO_LIMIT = (99.0, 100.0)  # the same on both sides, by which files mean none [rad]
STEP = 20.0  # distance of a joint from the next [m]
FAR = 10.0  # distance of a centre of mass from its frame, in lengths of the robot
SLENDER = 100.0  # the same in radii of gyration, for a bob on a string
LARGE = 16.0  # radius of gyration of a body, in lengths of the robot; it may be a turntable
HEAVY = 1.5  # the same of all bodies together, of a robot with links enough to be as long as its bodies
MANY = 3


def warn(kind: str, findings: Sequence[Finding], stacklevel: int) -> None:
    """Warn of findings, if there are any, of a robot or payload in words."""
    if findings:
        lines = "\n  ".join(map(str, findings))
        warnings.warn(f"{kind} may have numbers in other units:\n  {lines}", stacklevel=stacklevel + 1)


def diagnostics(robot: RobotModel) -> list[Finding]:
    """Numbers that seem to be in other units than m, rad, kg and kg m^2; none inside of a transform.

    Of several robots it is about the first whose numbers are the largest.
    """
    if without_values((robot.X_PB_home, robot.screw, robot.mass, robot.com, robot.inertia, *robot.limits)):
        return []
    length, step = _length(robot), max(_steps(robot), default=0.0)
    found = []
    if step > STEP:
        where = f"{step:.4g} m from one joint to the next"
        found.append(Finding("units.length", "", "lengths must be in m", where, "are they in mm?"))
    subjects = [f"link {link!r}" for link in robot.link_names]
    bodies = [*_bodies(subjects, robot.mass, robot.com, robot.inertia, length)]
    if not bodies and len(subjects) >= MANY:
        mass, spread = torch.broadcast_tensors(robot.mass.detach().double(), _spread(robot.inertia))
        mass, spread = (x.flatten(0, -2)[0] if x.ndim > 1 else x for x in (mass, spread))
        if length > 0 and float(spread.sum()) > (HEAVY * length) ** 2 * float(mass.sum()) > 0:
            i = int(spread.argmax())
            radius = math.sqrt(float(spread.sum() / mass.sum()))
            bodies.append(_inertia(subjects[i], radius, length, "of all links together", "g m^2 or in kg cm^2"))
    return [*found, *_degrees(robot), *bodies]


def _degrees(robot: RobotModel) -> Iterator[Finding]:
    """Suspicions about wide limits; of equal ones on both sides only if they are not round, and most others wide."""
    kinds = dict(zip(robot.every_joint, robot.kinds, strict=True))
    rows = zip(robot.joint_names, *map(_first, robot.limits[:2]), strict=True)
    # a coordinate without a joint of its own moves several
    ends = {name: x for name, *x in rows if name in kinds and KINDS[kinds[name]].turns}
    wide = {name: x for name, x in ends.items() if any(TURNS[0] < abs(end) <= TURNS[1] for end in x)}
    narrow = [x for x in ends.values() if 0 < max(map(abs, x)) <= TURN]
    for name, (lower, upper) in wide.items():
        turns = abs(math.remainder(upper, 2 * math.pi)) < WHOLE and upper % 1
        if lower != -upper or not (upper in NO_LIMIT or turns or len(narrow) > len(wide)):
            shown = f"{lower:g} to {upper:g}"
            yield Finding("units.degrees", f"joint {name!r}", "limits must be in rad", shown, "are they in degrees?")


def of_payload(robot: RobotModel, body: RigidBody) -> list[Finding]:
    """Numbers of a payload, [...], that seem to be in other units than m, kg and kg m^2."""
    rows = body.mass.unsqueeze(-1), body.com.unsqueeze(-2), body.inertia.unsqueeze(-2)
    return [*_bodies(["payload"], *rows, _length(robot))]


def _bodies(subjects: Sequence[str], mass: Tensor, com: Tensor, inertia: Tensor, length: float) -> Iterator[Finding]:
    """Suspicions about bodies of masses [..., k], centres [..., k, 3] and inertias [..., k, 6] on a robot [m]."""
    heavy = mass.detach().double()
    radii = _largest((_spread(inertia) / heavy.where(heavy > 0, torch.inf)).clamp(min=0).sqrt())
    away = _largest(com.norm(dim=-1) * (mass > 0))
    for subject, far, radius in zip(subjects, away, radii, strict=True):
        if max(length, radius) > 0 and far > max(FAR * length, SLENDER * radius):
            found = f"it {far:.4g} m from its frame on a robot of {length:.3g} m"
            yield Finding("units.com", subject, "com must be in m", found, "is it in mm?")
        if length > 0 and radius > LARGE * (far if length < far <= FAR * length else length):  # a rod may be an arm
            yield _inertia(subject, radius, length, "of the body", "kg mm^2")


def _inertia(subject: str, radius: float, length: float, of: str, unit: str) -> Finding:
    found = f"a radius of gyration sqrt(inertia / mass) {of} of {radius:.4g} m on a robot of {length:.3g} m"
    cure = f"is the inertia in {unit}?"
    return Finding("units.inertia", subject, "inertia must be in kg m^2 and mass in kg", found, cure, value=radius)


def _spread(inertia: Tensor) -> Tensor:
    """Second moments [...] [kg m^2] of inertias [..., 6]: masses times squared radii of gyration."""
    return inertia.detach().double()[..., (0, 2, 5)].sum(-1) / 2


def _length(robot: RobotModel) -> float:
    """Longest way [m] from the base along the joints to a frame, with sliding joints at their ends."""
    steps, axes = _steps(robot), _largest(robot.screw[..., 3:].norm(dim=-1))
    bounds = torch.stack([x.abs().where(x.isfinite(), 0.0) for x in (robot.limits.lower, robot.limits.upper)])
    ends = _largest(bounds @ factors(robot).abs().mT)
    ways = [0.0] * (len(robot.link_names) + 1)  # the last is that of the base, whose index is -1
    for i, (parent, joint) in enumerate(zip(robot.parents, [KINDS[kind] for kind in robot.kinds], strict=True)):
        # a frame that is off its axis is carried around it
        ways[i] = ways[parent] + steps[i] + (2 * axes[i] if joint.turns else 0.0) + (ends[i] if joint.slides else 0.0)
    return max(ways + [ways[frame.link] + 2 * float(frame.X_BF[4:].norm()) for frame in robot.frames])


def _steps(robot: RobotModel) -> list[float]:
    return _largest(2 * robot.X_PB_home[..., 4:].norm(dim=-1))  # |translation| is twice the norm of the dual part


def _first(x: Tensor) -> list[float]:
    """Number of every coordinate, [n], of the first of all robots."""
    x = x.detach().double()
    return (x.flatten(0, -2)[0] if x.ndim > 1 else x).tolist()


def _largest(x: Tensor) -> list[float]:
    """Largest number of every link, [n], of [..., n]."""
    x = x.detach().double()
    return (x.flatten(0, -2).amax(0) if x.ndim > 1 else x).tolist()
