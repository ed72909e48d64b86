"""Doubts about the units of a robot: bodies that lie, or reach, far beyond all else about it, its length, its angles.

A centre of mass in mm lies a thousand times too far from its frame, an inertia in kg mm^2 is that of a body a thousand
times too large, and one in g m^2 of a body thirty times too large. Such a robot can exist, so these are doubts and not
faults. Masses and inertias that are all too large by one factor look like those of another material, and a mass in g
like that of a point: neither is seen.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from torchdq.algebra.inertia import RigidBody
from torchdq.dynamics.joints import KINDS
from torchdq.program.transforms import without_values
from torchdq.robot.model import RobotModel

# None of the 70 robots of example-robot-data and of this package has a centre of mass farther than 0.8 lengths of the
# robot: a factor of ten and more below what is doubted. None has a body larger than 1.6 lengths, or bodies that are
# together larger than 0.9. Both numbers are those of placeholders, inertias of 1 kg m^2 in a humanoid and those of the
# rotors of a quadrotor; 0.5 and 0.4 are next.
LONG = 50.0  # length of a robot that is doubted [m], where one of its steps is as long as
STEP = 5.0  # this [m]: chains of hundreds of short links exist
FAR = 10.0  # distance of a centre of mass from its frame that is doubted, in lengths of the robot
LARGE = 16.0  # radius of gyration that is doubted, likewise, of a payload or of a robot that may be a turntable
MANY = 3  # links of a robot whose length is that of its bodies, too
BULKY = 2.5  # radius of gyration of one of these that is doubted, likewise: a rod nine times as long as the robot
HEAVY = 1.5  # radius of gyration of all of them together, likewise
TURN = 2 * math.pi + 1e-5  # largest angle [rad] of a placement; degrees are larger
TURNS = (20.0, 720.0)  # limits of a turning joint that are doubted [rad]; those of 1000 and more stand for none
SLIM = 20.0  # distance of a centre of mass that is believed, in radii of gyration
SLENDER = 200.0  # likewise in robots of fewer links, which may be a bob on a long string


def without_numbers(fault: str) -> str:
    """Words of a fault or doubt before what was found."""
    return fault.partition(", found")[0]


def doubts(robot: RobotModel, quiet: bool = False, known: Collection[str] = (), said: Sequence[str] = ()) -> list[str]:
    """Numbers that seem to be in other units than m, rad, kg and kg m^2, and why; warns unless `quiet`.

    Numbers that cannot be read, inside a transform, are not doubted, nor is what is `known`: doubts without their
    numbers. Doubts that a reader of files `said` come first.
    """
    needed = (robot.X_PB_home, robot.screw, robot.mass, robot.com, robot.inertia, *robot.limits)
    own = [] if without_values(needed) else [x for x in _doubts(robot) if without_numbers(x) not in known]
    found = [*said, *own]
    if found and not quiet:
        lines = "\n  ".join(found)
        warnings.warn(f"robot {robot.name!r} may have numbers in other units:\n  {lines}", stacklevel=4)
    return found


def _doubts(robot: RobotModel) -> Iterator[str]:
    length = _length(robot)
    step = max(_steps(robot), default=0.0)
    if length > LONG and step > STEP:
        found = f"found {step:.4g} m from one joint to the next, and frames up to {length:.4g} m from the base"
        yield f"lengths must be in m, {found}; are they in mm?"
    bodies = {f"link {link!r}": "the link's frame" for link in robot.link_names}
    several = len(bodies) >= MANY
    large = [*_of_bodies(bodies, robot.mass, robot.com, robot.inertia, length, several)]
    together = _together(robot.mass, robot.inertia) if several and not large else 0.0
    if together > HEAVY * length > 0:
        large.append(
            f"inertias must be in kg m^2 and masses in kg, found a radius of gyration sqrt(inertia / mass) of "
            f"{together:.4g} m for all links together, {_among(length)}; are they in g m^2 or in kg cm^2?"
        )
    yield from large
    kinds = dict(zip(robot.every_joint, robot.kinds, strict=True))
    for name, *ends in zip(robot.joint_names, *map(_first, robot.limits[:2]), strict=True):
        # a coordinate that is no joint of its own moves several
        if name in kinds and KINDS[kinds[name]].turns and any(TURNS[0] < abs(x) <= TURNS[1] for x in ends):
            yield f"joint {name!r}: limits must be in rad, found {ends[0]:g} to {ends[1]:g}; are they in degrees?"


def doubts_of_payload(robot: RobotModel, frame: str, body: RigidBody, stacklevel: int) -> list[str]:
    """Numbers of a payload in a frame, [...], that seem to be in other units than m, kg and kg m^2; warns."""
    bodies = {"payload": f"frame {frame!r}"}
    mass, com, inertia = body.mass.unsqueeze(-1), body.com.unsqueeze(-2), body.inertia.unsqueeze(-2)
    found = [*_of_bodies(bodies, mass, com, inertia, _length(robot), False)]
    if found:
        lines = "\n  ".join(found)
        warnings.warn(
            f"a payload of robot {robot.name!r} may have numbers in other units:\n  {lines}", stacklevel=stacklevel + 1
        )
    return found


def _among(length: float) -> str:
    return f"although its joints and frames reach at most {length:.3g} m from the base"


def _spread(inertia: Tensor) -> Tensor:
    """Second moments [...] [kg m^2] of inertias [..., 6]: masses times squared radii of gyration."""
    return inertia.detach().double()[..., (0, 2, 5)].sum(-1) / 2


def _together(mass: Tensor, inertia: Tensor) -> float:
    """Radius of gyration [m] of all links, as if their centres of mass were one; of the first of all robots."""
    sums = torch.broadcast_tensors(mass.detach().double().sum(-1), _spread(inertia).sum(-1))
    total, spread = (float(x.flatten()[0]) for x in sums)
    return math.sqrt(spread / total) if total > 0 and spread > 0 else 0.0


def _of_bodies(
    bodies: Mapping[str, str], mass: Tensor, com: Tensor, inertia: Tensor, length: float, several: bool
) -> Iterator[str]:
    """Doubts about bodies on a robot of a length [m].

    Args:
        bodies: words for them, with the words for their frames.
        mass, com, inertia: masses [..., k], centres of mass [..., k, 3] and inertias [..., k, 6].
        length: of the robot.
        several: whether the robot has links enough for its length to be that of its bodies, too.
    """
    among, large, slender = _among(length), *((BULKY, SLIM) if several else (LARGE, SLENDER))
    heavy, spread = mass.detach().double(), _spread(inertia)
    radii = _largest((spread / heavy.where(heavy > 0, torch.inf)).clamp(min=0).sqrt())
    away = _largest(com.norm(dim=-1) * (mass > 0))
    for (body, frame), far, radius in zip(bodies.items(), away, radii, strict=True):
        if max(length, radius) > 0 and far > max(FAR * length, slender * radius):
            yield f"{body}: com must be in m, found it {far:.4g} m from {frame}, {among}; is it in mm?"
        reach = far if length < far <= FAR * length else length  # a rod may be all of an arm
        if length > 0 and radius > large * reach:
            yield (
                f"{body}: inertia must be in kg m^2 and mass in kg, found a radius of gyration "
                f"sqrt(inertia / mass) of {radius:.4g} m, {among}; is the inertia in {_unit(radius / length)}?"
            )


def _unit(factor: float) -> str:
    """Unit of an inertia whose radius of gyration is so many lengths of a robot."""
    return "kg mm^2" if factor > LARGE else "g m^2 or in kg cm^2"


def _length(robot: RobotModel) -> float:
    """Longest way [m] from the base along the joints to a frame, with sliding joints at their ends."""
    steps = _steps(robot)
    axes = _largest(robot.screw[..., 3:].norm(dim=-1))
    bounds = torch.stack([x.abs().where(x.isfinite(), 0.0) for x in (robot.limits.lower, robot.limits.upper)])
    ends = _largest(bounds if robot.joint_map is None else bounds @ robot.joint_map.S.abs().mT)
    ways = [0.0] * (len(robot.link_names) + 1)  # the last is that of the base, whose index is -1
    for i, (parent, joint) in enumerate(zip(robot.parents, [KINDS[kind] for kind in robot.kinds], strict=True)):
        # a frame beside its axis is carried around it
        ways[i] = ways[parent] + steps[i] + (2 * axes[i] if joint.turns else 0.0) + (ends[i] if joint.slides else 0.0)
    return max(ways + [ways[frame.link] + 2 * float(frame.X_BF[4:].norm()) for frame in robot.frames])


def _steps(robot: RobotModel) -> list[float]:
    """Distances [m] of the links' frames from those of their parents, at home, [n]."""
    return _largest(2 * robot.X_PB_home[..., 4:].norm(dim=-1))  # |translation| is twice the norm of the dual part


def _first(x: Tensor) -> list[float]:
    """Number of every coordinate, [n], of the first of all robots."""
    x = x.detach().double()
    return (x.flatten(0, -2)[0] if x.ndim > 1 else x).tolist()


def _largest(x: Tensor) -> list[float]:
    """Largest number of every link, [n], of [..., n]."""
    x = x.detach().double()
    return (x.flatten(0, -2).amax(0) if x.ndim > 1 else x).tolist()
