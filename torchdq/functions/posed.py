"""Robot at one configuration, in numbers to record: constants, and arguments for tensors that were replaced."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Moments
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.dynamics import closures, error_growth
from torchdq.dynamics.aligned.posed import Aligned
from torchdq.dynamics.aligned.regroup import regrouped
from torchdq.dynamics.closures import Gap, Held
from torchdq.dynamics.coupling import Coupled, Coupling
from torchdq.dynamics.general.posed import General
from torchdq.dynamics.joints import Coordinate, Free, along_z
from torchdq.dynamics.posed import Factors, Posed
from torchdq.dynamics.tree import Tree, on_base
from torchdq.errors import SingularInertiaError
from torchdq.functions import mdh
from torchdq.numbers.functions import cos, sin
from torchdq.robot.description import JointMap
from torchdq.robot.fields import BASE_BODY, BODIES, SHAPES
from torchdq.robot.model import factors as factors_of
from torchdq.robot.robot import Robot
from torchdq.robot.tree import MASSLESS, general_tree, massless, plain

# flat components of tensors that replace those of the robot, by name; None: absent
Overrides = Mapping[str, Sequence[Number] | None]

GEOMETRY = ("X_PB_home", "screw")
BASE = 6  # degrees of freedom of a floating base, which come first
DYNAMICS = {
    *("composites", "torques", "mass_matrix", "factors", "with_armature", "with_masses", "without_gravity"),
    *("kinetic_energy", "potential_energy"),
}  # methods of `Posed`; the regressor does not depend on masses


def field(robot: Robot, name: str, overrides: Overrides):
    """Tensor of the robot as nested tuples of numbers; None: absent."""
    if name in overrides:
        row, shape = overrides[name], SHAPES[name]
        if row is None:
            return None
        flat = tuple(row)
        if not shape:
            return flat[0]
        if len(shape) == 1:
            return flat
        width = int(shape[1])
        return tuple(flat[k : k + width] for k in range(0, len(flat), width))
    return plain(robot, name)


def tree(robot: Robot, overrides: Overrides, free: bool = False) -> Tree:
    """Tree of the robot in the link frames of its description."""
    return general_tree(robot, lambda name: field(robot, name, overrides), free)


def coupling(joint_map: JointMap) -> Coupling:
    """Map from coordinates to all joints, in numbers."""
    return Coupling(tuple(tuple(x or None for x in row) for row in joint_map.S.tolist()))


def displacements(robot: Robot, q: Sequence[Number], overrides: Overrides) -> list[Number]:
    """Positions of all joints relative to home."""
    home = field(robot, "home", overrides)
    if robot.joint_map is not None:
        q = coupling(robot.joint_map).joints(q)
    return list(q) if home is None else [x - h for x, h in zip(q, home, strict=True)]


def coordinates(robot: Robot, q: Sequence[Number], overrides: Overrides, X_WB: DualQuaternion | None) -> list[Any]:
    """Coordinates of all joints, beginning with the base."""
    halves = [(x, 0.5 * x) for x in displacements(robot, q, overrides)]
    return [X_WB, *(Coordinate(x, cos(half), sin(half)) for x, half in halves)]


def aligned(
    robot: Robot, q: Sequence[Number], overrides: Overrides, group: bool, X_WB: DualQuaternion | None = None
) -> Aligned:
    """Robot at q in aligned frames, with a floating base at X_WB if that is given; its geometry must be constant.

    To `group` inertial parameters saves operations if they do not depend on the sample.
    """
    described = tree(robot, {"gravity": None, "armature": None})
    alignments, coms = mdh.align(described), field(robot, "com", overrides)
    masses, inertias = field(robot, "mass", overrides), field(robot, "inertia", overrides)
    found = on_base(
        robot.parents,
        [along_z(link.joint) for link in described.links[1:]],
        [at.placement for at in alignments],
        [
            Moments.from_com(m, at.point_from_own(com), at.inertia_from_own(inertia))
            for at, m, com, inertia in zip(alignments, masses, coms, inertias, strict=True)
        ],
        None if robot.joint_map else field(robot, "armature", overrides),
        field(robot, "gravity", overrides),
        *(() if X_WB is None else (Free(), Moments.from_com(*(field(robot, name, overrides) for name in BASE_BODY)))),
    )
    x = displacements(robot, q, overrides)
    return Aligned.at(regrouped(found) if group else found, alignments, coms, x, X_WB)


def general(robot: Robot, q: Sequence[Number], overrides: Overrides, X_WB: DualQuaternion | None = None) -> General:
    """Robot at q in the general form, in the link frames of its description; every tensor may be an argument."""
    found = tree(robot, overrides, free=X_WB is not None)
    return General.at(found, field(robot, "com", overrides), coordinates(robot, q, overrides, X_WB))


class Massless(NamedTuple):
    """Posed robot that moves no mass: it has kinematics, and an error where its dynamics are asked for."""

    robot: Posed
    name: str

    def __getattr__(self, name: str) -> Any:
        """Methods of the robot that do not depend on masses."""
        if name in DYNAMICS:
            raise no_dynamics(self.name)
        return getattr(self.robot, name)


def no_dynamics(name: str) -> SingularInertiaError:
    """Error for dynamics of the robot with a name, which moves no mass."""
    return SingularInertiaError(f"robot {name!r} has no dynamics: {MASSLESS}", MASSLESS)


def posed(
    robot: Robot,
    q: Sequence[Number],
    overrides: Overrides,
    per_sample: Sequence[str],
    X_WB: DualQuaternion | None = None,
) -> Posed:
    """Robot at q, in aligned frames if its geometry is constant, otherwise in the general form.

    `per_sample` are names of its tensors that depend on the sample, X_WB is the pose of a floating base.
    """
    at: Posed
    if any(name in overrides for name in GEOMETRY):
        at = general(robot, q, overrides, X_WB)
    else:
        at = aligned(robot, q, overrides, not any(name in per_sample for name in BODIES), X_WB)
    if robot.joint_map is not None:
        before, rotors = 0 if X_WB is None else BASE, field(robot, "armature", overrides)
        mapped: Any = Coupled(at, coupling(robot.joint_map).after(before), rotors and (0.0,) * before + tuple(rotors))
        at = mapped
    without: Any = Massless(at, robot.name)
    return without if massless(robot, overrides) else at


def factors(robot: Robot, at: Posed, linear: bool) -> Factors:
    """Factors of the mass matrix; raises `SingularInertiaError` if a joint moves no inertia."""
    try:
        return at.factors(linear)
    except error_growth.NoInertiaError as error:
        joint = error.joint - (BASE if robot.floating else 0)
        what = "the floating base" if joint < 0 else f"joint {robot.joint_names[joint]!r}"
        raise SingularInertiaError(
            f"{what} of robot {robot.name!r} moves no inertia, so its acceleration is undefined; give mass to the "
            "links beyond it, or armature to the joint"
        ) from error


def solve(
    robot: Robot, at: Posed, b: Sequence[Number], linear: bool, held: Sequence[Held] = ()
) -> tuple[Sequence[Number], Number]:
    """Solution x of M x = b, as closures hold it, and the factor by which it magnifies rounding errors."""
    parts = factors(robot, at, linear and not held)
    return closures.solve(parts, b, held) if held else parts.solve(b), parts.growth


def gaps(robot: Robot, at: Posed, qd: Sequence[Number] | None) -> list[Gap]:
    """Gaps of the closures of a robot, `at` being it on a fixed base; see `closures.gap`."""
    found, S = [], factors_of(robot).bool()
    for x in robot.closures:
        a, b = frame(robot, x.frame_a), frame(robot, x.frame_b)
        loop = _path(robot, a[0]) ^ _path(robot, b[0])
        moving = [k for k in range(robot.n) if any(S[i, k] for i in loop)]
        found.append(closures.gap(at, x.kind, (a, b), moving, qd))
    return found


def _path(robot: Robot, link: int) -> set[int]:
    """Joints between the base and a link, which is numbered as in a tree."""
    found, i = set[int](), link - 1
    while i >= 0:
        found.add(i)
        i = robot.parents[i]
    return found


def constant_pose(x) -> DualQuaternion:
    """Pose as numbers, from a tensor."""
    components = tuple(x.tolist())
    return components[:4], components[4:]


def frame(robot: Robot, name: str) -> tuple[int, DualQuaternion]:
    """Index in the tree of the link that a frame of the robot is fixed to, and the pose of the frame in the link."""
    found = robot.frame(name)
    return found.link + 1, constant_pose(found.X_BF)


def as_screw(x: Sequence[Number]) -> Screw:
    """Six components as a screw."""
    return tuple(x[:3]), tuple(x[3:])
