"""Recipes of public functions: their formulas and arguments, and the inputs that a formula takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.base.checks import OneOf, names_of
from torchdq.dynamics.coupling import Coupled
from torchdq.dynamics.general.rnea import exerted_wrenches
from torchdq.dynamics.posed import Posed
from torchdq.errors import ArgumentError, SingularInertiaError
from torchdq.functions.posed import GEOMETRY, Massless, Overrides, as_screw, frame, posed
from torchdq.functions.signature import Field
from torchdq.program.program import Value
from torchdq.robot.fields import BODIES, Axes
from torchdq.robot.robot import Robot
from torchdq.robot.tree import inert_joints

LONG = 9  # number of joints from which an O(n) candidate is recorded
VERY_LONG = 64  # number of joints from which only the O(n) candidate is recorded

Results = dict[str, Sequence[Value | None]]
Alternative = TypeVar("Alternative")


class RecipeInputs(NamedTuple):
    """Inputs of a formula."""

    robot: Robot
    arguments: Mapping[str, Sequence[Number]]  # those that are present
    overrides: Overrides  # tensors of the robot that are arguments
    per_sample: tuple[str, ...]  # names of those that have batch axes

    def require_inertia(self) -> None:
        """Raise `SingularInertiaError` if a joint of a constant robot moves no inertia, up to rounding."""
        if any(name in self.overrides for name in (*BODIES, *GEOMETRY, "armature")):
            return
        found = inert_joints(self.robot)
        if found:
            listed = "; ".join(map(str, found))
            raise SingularInertiaError(f"robot {self.robot.name!r} cannot be accelerated: {listed}", *found)

    def posed(self) -> Posed:
        """Robot at q, and at X_WB if its base is free."""
        return posed(self.robot, self.arguments["q"], self.overrides, self.per_sample, self.base())

    def on_fixed_base(self) -> Posed:
        """Robot at q, its base at the origin and at rest."""
        return posed(self.robot, self.arguments["q"], self.overrides, self.per_sample)

    def bodies(self) -> Posed:
        """Robot at the same place whose joints are all its coordinates, for functions of the place alone."""
        at = self.posed()
        while isinstance(at, Coupled | Massless):
            at = at.robot
        return at

    def base(self) -> DualQuaternion | None:
        """Pose of a floating base; None: the base is fixed."""
        x = self.arguments.get("X_WB")
        return None if x is None else (tuple(x[:4]), tuple(x[4:]))

    def velocities(self) -> Sequence[Number | None] | None:
        """Velocities of a floating base and of the coordinates; None: zero."""
        return self._row("V_WB_B", "qd")

    def accelerations(self) -> Sequence[Number | None] | None:
        """Rates of `velocities`; None: zero."""
        return self._row("A_WB_B", "qdd")

    def _row(self, base: str, joints: str) -> Sequence[Number | None] | None:
        moved, turned = self.arguments.get(base), self.arguments.get(joints)
        if "X_WB" not in self.arguments or (moved is None and turned is None):
            return turned
        return (*(moved or (0.0,) * 6), *(turned or (0.0,) * self.robot.n))

    def exerted(self, at: Posed) -> list[Screw | None] | None:
        """Wrench each link exerts on the environment; None: there is none."""
        f_tip, f_ext, f_base = (self.arguments.get(name) for name in ("f_tip", "f_ext", "f_base"))
        if f_tip is None and f_ext is None and f_base is None:
            return None
        links, tip = self.robot.sizes["links"], None
        if f_tip is not None:
            link, X_BF = frame(self.robot, self.robot.end_effector().name)
            tip = (link, screw.columns(X_BF))
        ext: list[Screw | None] = [None if f_base is None else as_screw(f_base)]
        ext += [None if f_ext is None else as_screw(f_ext[6 * i : 6 * i + 6]) for i in range(links)]
        exerted = exerted_wrenches(links + 1, ext, tip, None if f_tip is None else as_screw(f_tip))
        return [None if F is None else at.wrench(i, F) for i, F in enumerate(exerted)]


def alternatives_to_record(n: int, known: Sequence[Alternative]) -> Sequence[Alternative]:
    """Candidates to record: the dense one below 9 joints, both below 64, then only the O(n) one."""
    return known[:1] if n < LONG else known if n < VERY_LONG else known[-1:]


class Recipe(NamedTuple):
    """Public function: what it takes, its candidate formulas, and the shapes of its results."""

    fields: tuple[Field, ...]
    # candidate formulas; the one with the fewest operations for the robot becomes the program
    formulas: tuple[Callable[..., Results], ...]
    results: Callable[..., tuple[Axes, ...]]  # trailing axes of the results, from the options
    each: bool = False  # whether all candidates are recorded, whatever the number of joints
    wrt: tuple[str, ...] = ()  # arguments that the result of the formula is differentiated by
    of_joints: bool = False  # whether it does not depend on the base, and is for any
    fixed_only: str = ""  # reason why it has no form for a floating base; "": it may have one

    @property
    def arguments(self) -> tuple[Field, ...]:
        """Fields that are tensors."""
        return tuple([field for field in self.fields if field.kind != "option"])

    @property
    def options(self) -> tuple[Field, ...]:
        """Fields that are names, on which the program depends."""
        return tuple([field for field in self.fields if field.kind == "option"])

    def present(self, function: str, names: Sequence[str] | None) -> list[Field]:
        """Arguments that calls will pass, in order, those that are named; None: all but the wrenches."""
        usual = [name for name in self.names if name not in ("f_tip", "f_ext", "f_base")]
        present = names_of("arguments", usual if names is None else names, self.names, f"argument of {function}")
        for field in self.arguments:
            if not (field.optional or field.name in present):
                raise ArgumentError(
                    f"arguments of {function!r} must hold {field.name!r}, found {list(present)}; add it"
                )
        return [field for field in self.arguments if field.name in present]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arguments."""
        return tuple([field.name for field in self.arguments])


WRENCHES = (Field("f_tip", (6,), optional=True), Field("f_ext", ("links", 6), optional=True))
TIP = "the tip"  # default of a frame
FRAME = Field("frame", kind="option", default=TIP)
EXPRESSED = Field("expressed", kind="option", check=OneOf(("body", "world")), default="body")
TASK = (FRAME, EXPRESSED, Field("axes", kind="option", default="pose"))
PAIRS = (
    Field("points", kind="option", default=TIP),
    Field("objects", kind="option", default=()),
    Field("ground", kind="option", check=OneOf(("", "ground")), default="ground"),
    Field("own", kind="option", check=OneOf(("", "own")), default=""),
)
