"""Description of a robot, as its sources (`urdf`, `from_screws`, `from_dh`) return it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from torch import Tensor

from torchdq.algebra import dual_quaternion
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.errors import DescriptionError
from torchdq.findings import Finding

ClosureKind = Literal["point", "hinge", "weld"]
Base = Literal["file", "fixed", "floating"]
NO_TIP = "tip.missing"  # code of a note that goes when a tip is chosen
NO_MASS = "robot.massless"  # code of a warning that goes when bodies are changed
BALL = "joint.ball"  # code of a note of a ball joint that three hinges stand for
UNACTUATED = "joint.unactuated"  # code of a note of the joints of an MJCF file that no actuator moves
UNSIMULATED = "unsimulated."  # beginning of the codes of parts that would act on the motion, and have no field


def note(code: str, about: Sequence[Any], what: str, among: int = 0) -> Finding:
    """Note about named things, or names; all of several joints are called so where `among` is their number."""
    names = [x if isinstance(x, str) else x.name for x in about]
    subject = "all joints" if 1 < len(names) == among else ", ".join(names)
    return Finding(code, subject, what, severity="note")


def require_usable(faults: Sequence[Finding]) -> None:
    """Raise for all faults of a description at once."""
    if faults:
        lines = "\n  ".join(map(str, faults))
        found = [x._replace(severity="error") for x in faults]
        raise DescriptionError(f"the robot description cannot be used:\n  {lines}", *found)


class Limits(NamedTuple):
    """Limits of the joints as the description gives them, each [n]; infinite where it gives none."""

    lower: Tensor  # [rad or m]
    upper: Tensor  # [rad or m]
    velocity: Tensor  # [rad/s or m/s]
    effort: Tensor  # [N m or N]


class Shape(NamedTuple):
    """Shape S fixed to a frame F; the axis of a capsule or a cylinder is z."""

    kind: str  # "sphere", "capsule", "cylinder" or "box"; other words say what it is instead
    size: tuple[float, ...] = ()  # radius; radius and half length; half lengths [m]; scale of a mesh
    X_FS: DualQuaternion = dual_quaternion.ONE
    name: str = ""  # of the element
    mesh: str = ""  # path or address of its file


@dataclass(frozen=True)
class Drawing:
    """Shapes by which a frame is drawn; neither programs nor comparisons of robots depend on them."""

    shapes: tuple[Shape, ...] = field(default=(), repr=False, compare=False)  # `repr` is part of the keys of programs
    folder: str = field(default="", repr=False, compare=False)  # folder around which meshes lie


class Frame(NamedTuple):
    """Named frame F fixed to a link B."""

    name: str
    link: int  # index of the link, -1: the base
    X_BF: Tensor  # [8]
    shapes: tuple[Shape, ...] = ()  # collision shapes that the description has there
    drawing: Drawing = Drawing()


class JointMap(NamedTuple):
    """Joints that follow the coordinates q: the displacements of all joints are S q - home."""

    joint_names: tuple[str, ...]  # names of all joints, one per link
    S: Tensor  # [links, n] positions of the joints per coordinate


class Closure(NamedTuple):
    """Frames A and B of two links that are held together, which closes a loop of links.

    Args:
        frame_a, frame_b: names of the frames.
        kind: "point": they have one origin, as on a ball joint; "hinge": and one z axis, about which they turn; "weld":
            all axes.

    >>> import torchdq
    >>> torchdq.Closure("rod_end", "crank_end", "hinge")
    Closure(frame_a='rod_end', frame_b='crank_end', kind='hinge')
    """

    frame_a: str
    frame_b: str
    kind: ClosureKind = "point"


@dataclass(frozen=True)
class RobotDescription:
    """Fields of a `Robot` that its source gives; see there for shapes and units."""

    name: str
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    parents: tuple[int, ...]
    kinds: tuple[str, ...]
    X_PB_home: Tensor
    screw: Tensor
    mass: Tensor
    com: Tensor
    inertia: Tensor
    limits: Limits
    damping: Tensor
    friction: Tensor
    frames: tuple[Frame, ...]
    tip: str | None
    home: Tensor | None = None
    armature: Tensor | None = None
    base_mass: Tensor | None = None
    base_com: Tensor | None = None
    base_inertia: Tensor | None = None
    joint_map: JointMap | None = None
    closures: tuple[Closure, ...] = ()
    notes: tuple[Finding, ...] = ()  # faults, suspicions and parts that are not used
