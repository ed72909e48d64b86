"""A robot at one configuration as numbers to record: constants where its tensors are known, arguments elsewhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Moments
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.dynamics import conditioning
from torchdq.dynamics.aligned.posed import Aligned
from torchdq.dynamics.aligned.regroup import regrouped
from torchdq.dynamics.joints import Coordinate, along_z
from torchdq.dynamics.paper.posed import Paper
from torchdq.dynamics.posed import Factors, Posed
from torchdq.dynamics.tree import Tree, plant
from torchdq.errors import SingularInertiaError
from torchdq.numbers.functions import cos, sin
from torchdq.robot import mdh
from torchdq.robot.robot import SHAPES, Robot, general_tree

# flat components of the robot's tensors that are arguments, or otherwise not its own; None: there is none
Overrides = Mapping[str, Sequence[Number] | None]

GEOMETRY = ("X_PB_home", "screw")
INERTIAL = ("mass", "com", "inertia")


def field(robot: Robot, name: str, overrides: Overrides):
    """Tensor of the robot as nested tuples of numbers, or None if the robot has none."""
    if name in overrides:
        row, shape = overrides[name], SHAPES[name]
        if row is None:
            return None
        flat = tuple(row)
        if len(shape) == 1:
            return flat
        return tuple(flat[k : k + shape[1]] for k in range(0, len(flat), shape[1]))
    value = getattr(robot, name)
    if value is None:
        return None
    rows = value.tolist()
    return tuple(tuple(row) if isinstance(row, list) else row for row in rows)


def tree(robot: Robot, overrides: Overrides) -> Tree:
    """Tree of the robot in its own link frames, as the paper has it."""
    names = ("X_PB_home", "screw", "mass", "com", "inertia", "gravity", "armature")
    return general_tree(robot.parents, robot.kinds, **{name: field(robot, name, overrides) for name in names})


def displacements(robot: Robot, q: Sequence[Number], overrides: Overrides) -> list[Number]:
    """Joint positions relative to home."""
    home = field(robot, "home", overrides)
    return list(q) if home is None else [x - h for x, h in zip(q, home, strict=True)]


def aligned(robot: Robot, q: Sequence[Number], overrides: Overrides, group: bool) -> Aligned:
    """Robot at q in aligned frames; its geometry must be constant.

    Args:
        group: whether inertia is moved towards the base, which pays unless it differs from sample to sample.
    """
    described = tree(robot, {"gravity": None, "armature": None})
    alignments, coms = mdh.align(described), field(robot, "com", overrides)
    masses, inertias = field(robot, "mass", overrides), field(robot, "inertia", overrides)
    found = plant(
        robot.parents,
        [along_z(link.joint) for link in described.links[1:]],
        [at.placement for at in alignments],
        [
            Moments.from_com(m, at.point_from_own(com), at.inertia_from_own(inertia))
            for at, m, com, inertia in zip(alignments, masses, coms, inertias, strict=True)
        ],
        field(robot, "armature", overrides),
        field(robot, "gravity", overrides),
    )
    x = displacements(robot, q, overrides)
    return Aligned.at(regrouped(found) if group else found, alignments, coms, x)


def paper(robot: Robot, q: Sequence[Number], overrides: Overrides) -> Paper:
    """Robot at q in its own link frames, as the paper has it; anything about it may be an argument."""
    halves = [(x, 0.5 * x) for x in displacements(robot, q, overrides)]
    coordinates = [None, *(Coordinate(x, cos(half), sin(half)) for x, half in halves)]
    return Paper.at(tree(robot, overrides), field(robot, "com", overrides), coordinates)


def posed(robot: Robot, q: Sequence[Number], overrides: Overrides, per_sample: Sequence[str]) -> Posed:
    """Robot at q, in the frames that cost least for what is constant about it.

    Args:
        per_sample: tensors of the robot that differ from sample to sample.
    """
    if any(name in overrides for name in GEOMETRY):
        return paper(robot, q, overrides)
    return aligned(robot, q, overrides, group=not any(name in per_sample for name in INERTIAL))


def factors(robot: Robot, at: Posed, linear: bool) -> Factors:
    """Factors of the mass matrix of a robot at a configuration."""
    try:
        return at.factors(linear)
    except conditioning.NoInertiaError as error:
        raise SingularInertiaError(
            f"joint {robot.joint_names[error.joint]!r} of robot {robot.name!r} moves no inertia, so its "
            f"acceleration is undefined; give the links beyond it mass, or the joint armature"
        ) from error


def solve(robot: Robot, at: Posed, b: Sequence[Number], linear: bool) -> tuple[Sequence[Number], Number]:
    """Solution x of M x = b, and the factor by which it magnifies rounding errors."""
    parts = factors(robot, at, linear)
    return parts.solve(b), parts.growth


def constant_pose(x) -> DualQuaternion:
    """Pose tensor as numbers."""
    components = tuple(x.tolist())
    return components[:4], components[4:]


def frame(robot: Robot, name: str) -> tuple[int, DualQuaternion]:
    """Link of a tree that a frame of the robot is fixed to, and the frame's pose in it."""
    found = robot.frame(name)
    return found.link + 1, constant_pose(found.X_BF)


def as_screw(x: Sequence[Number]) -> Screw:
    """Six components as a screw."""
    a: Pure = (x[0], x[1], x[2])
    b: Pure = (x[3], x[4], x[5])
    return a, b
