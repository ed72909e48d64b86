"""What is recorded: each public function as a computation on numbers, and the programs it has become.

A recipe takes the robot, its arguments as tuples of numbers, and those of the robot's own tensors that are arguments,
and returns named rows of numbers. Its program depends on the robot's constants and on which arguments are present.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from torchdq.algebra import dual_quaternion, quaternion, screw
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.caches import PROGRAMS, remembered
from torchdq.call import Computation
from torchdq.dynamics.paper import closed_form as closed
from torchdq.dynamics.paper import kinematics, rnea
from torchdq.dynamics.paper import regressor as regression
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError, SingularInertiaError
from torchdq.program import autodiff as derive
from torchdq.program.program import Argument, Program, Value, record
from torchdq.robot import consistency as physical
from torchdq.robot.constants import Constants
from torchdq.robot.posed import (
    GEOMETRY,
    INERTIAL,
    Given,
    PaperModel,
    as_screw,
    constant_pose,
    coordinates,
    factorised,
    general,
    model,
    solve,
)
from torchdq.robot.robot import SHAPES, Robot, recorded

LONG = 9  # joints from which an alternative that is linear in their number is worth recording
VERY_LONG = 64  # joints from which nothing else is

Rows = dict[str, Sequence[Value | None]]
Way = TypeVar("Way")


class Inputs(NamedTuple):
    """What a recipe is given."""

    robot: Robot
    arguments: Mapping[str, Sequence[Number]]  # those that are present
    given: Given  # tensors of the robot that are arguments
    varied: tuple[str, ...]  # and those among them that differ from sample to sample

    @property
    def q(self) -> Sequence[Number]:
        """Joint positions."""
        return self.arguments["q"]

    def exerted(self) -> list[Screw | None] | None:
        """Wrench each link exerts on the environment, in link frames; None if there is none."""
        f_tip, f_ext = self.arguments.get("f_tip"), self.arguments.get("f_ext")
        if f_tip is None and f_ext is None:
            return None
        tip = None
        if f_tip is not None:
            frame = self.robot.end_effector()
            tip = (frame.link, screw.columns(constant_pose(frame.X_BF)))
        return rnea.exerted_wrenches(
            self.robot.n,
            None if f_ext is None else [as_screw(f_ext[6 * i : 6 * i + 6]) for i in range(self.robot.n)],
            tip,
            None if f_tip is None else as_screw(f_tip),
        )

    def require_inertia(self) -> None:
        """Raise `SingularInertiaError` if a joint of a constant robot moves nothing in any position but rounding."""
        if any(name in self.given for name in (*INERTIAL, *GEOMETRY, "armature")):
            return
        found = physical.inert_joints(self.robot.joint_names, general(self.robot, {}))
        if found:
            raise SingularInertiaError(f"robot {self.robot.name!r} cannot be accelerated: {'; '.join(found)}")

    def model(self):
        """The robot in its position, in the cheapest frames."""
        return model(self.robot, self.q, self.given, self.varied)

    def paper(self) -> PaperModel:
        """The robot in its position, in its own link frames."""
        return PaperModel.of(self.robot, self.q, self.given)


def inverse_dynamics(x: Inputs) -> Rows:
    """tau."""
    return {"tau": x.model().torques(x.arguments.get("qd"), x.arguments.get("qdd"), x.exerted())}


def mass_matrix(x: Inputs) -> Rows:
    """M, row-major."""
    return {"M": [entry for row in x.model().mass_matrix() for entry in row]}


def forward_dynamics(x: Inputs, linear: bool = False) -> Rows:
    """qdd, by the mass matrix and its factors, or by articulated bodies."""
    x.require_inertia()
    m = x.model()
    bias = m.torques(x.arguments.get("qd"), None, x.exerted())
    net = [t if b is None else t - b for t, b in zip(x.arguments["tau"], bias, strict=True)]
    return {"qdd": solve(m, net, linear)}  # (63) solved for qdd


def forward_dynamics_articulated(x: Inputs) -> Rows:
    """qdd, by articulated bodies."""
    return forward_dynamics(x, linear=True)


def error_growth(x: Inputs, linear: bool = False) -> Rows:
    """Largest M_ii over pivot."""
    x.require_inertia()
    return {"growth": [factorised(x.model(), linear).growth]}


def error_growth_articulated(x: Inputs) -> Rows:
    """The same by articulated bodies."""
    return error_growth(x, linear=True)


def closed_form(x: Inputs, tip_name: str) -> Rows:
    """M, c, g, and Jt if there is a tip."""
    m = x.paper()
    tip = None
    if tip_name:
        frame = x.robot.frame(tip_name)
        tip = (frame.link, screw.columns(constant_pose(frame.X_BF)))
    terms = closed.closed_form(m.mechanism, m.Ad, x.arguments["qd"], tip)
    rows: Rows = {"M": [entry for row in terms.M for entry in row], "c": terms.c, "g": terms.g}
    if terms.Jt is not None:
        rows["Jt"] = [entry for row in terms.Jt for entry in _six(row)]
    return rows


def regressor(x: Inputs) -> Rows:
    """Y, row-major."""
    m = x.paper()
    base = rnea.base_at_rest(m.mechanism)
    V, A = rnea.outward(m.mechanism, m.Ad, x.arguments["qd"], x.arguments["qdd"], base)
    blocks = regression.regressor(m.mechanism, m.Ad, V, A)
    return {"Y": [entry for row in blocks for block in row for entry in (block or (None,) * 10)]}


def kinetic_energy(x: Inputs) -> Rows:
    """T."""
    return {"T": [x.paper().kinetic_energy(x.arguments["qd"])]}


def potential_energy(x: Inputs) -> Rows:
    """U."""
    return {"U": [x.paper().potential_energy()]}


def forward_kinematics(x: Inputs, *names: str) -> Rows:
    """Poses of the frames, one after the other."""
    X_WB = x.paper().poses()
    rows: list[Value | None] = []
    for name in names:
        frame = x.robot.frame(name)
        pose = constant_pose(frame.X_BF)
        pose = pose if frame.link == BASE else dual_quaternion.mul(X_WB[frame.link], pose)
        rows += [*pose[0], *pose[1]]
    return {"X": rows}


def forward_kinematics_from_base(x: Inputs, *names: str) -> Rows:
    """The same by screws in the base frame."""
    mechanism = general(x.robot, x.given)
    links = kinematics.link_poses_from_base(mechanism, coordinates(x.robot, x.q, x.given))
    rows: list[Value | None] = []
    for name in names:
        frame = x.robot.frame(name)
        pose = constant_pose(frame.X_BF)
        if frame.link != BASE:
            at = links[frame.link]
            pose = dual_quaternion.mul(at.motion, dual_quaternion.mul(at.home, pose))
        rows += [*pose[0], *pose[1]]
    return {"X": rows}


def jacobian(x: Inputs, name: str, expressed: str) -> Rows:
    """J, row-major, twist components by joints."""
    m = x.paper()
    frame = x.robot.frame(name)
    columns: Sequence[Screw | None] = (None,) * x.robot.n
    if frame.link != BASE:
        X_BF = constant_pose(frame.X_BF)
        columns = kinematics.jacobian(m.mechanism, m.Ad, frame.link, X_BF)
        if expressed == "world":
            r_WF = quaternion.mul(m.poses()[frame.link][0], X_BF[0])
            columns = [c and (quaternion.rotate(r_WF, c[0]), quaternion.rotate(r_WF, c[1])) for c in columns]
    return {"J": [_six(c)[i] for i in range(6) for c in columns]}


def _six(s: Screw | None) -> tuple[Number | None, ...]:
    return (None,) * 6 if s is None else (*s[0], *s[1])


Axes = tuple[int | str, ...]  # trailing axes, "n" being the number of joints


def ways(n: int, known: Sequence[Way]) -> Sequence[Way]:
    """Those of two ways that are worth recording for a number of joints, if the second is linear in it."""
    return known[:1] if n < LONG else known if n < VERY_LONG else known[-1:]


class Recipe(NamedTuple):
    """A public function: what it takes, how it is computed, and what it returns."""

    arguments: tuple[tuple[str, Axes, bool], ...]  # name, trailing axes, whether it may be absent
    # ways to compute it; the one with the fewest operations for the robot at hand becomes its program
    ways: tuple[Callable[..., Rows], ...]
    results: Callable[..., tuple[tuple[int, ...], ...]]  # trailing axes of the results, from n and the options
    each: bool = False  # whether all ways are worth recording for every robot


def _joints(*names: str) -> tuple[tuple[str, Axes, bool], ...]:
    return tuple((name, ("n",), False) for name in names)


_WRENCHES: tuple[tuple[str, Axes, bool], ...] = (("f_tip", (6,), True), ("f_ext", ("n", 6), True))
_RATES: tuple[tuple[str, Axes, bool], ...] = (("qd", ("n",), True), ("qdd", ("n",), True))

RECIPES: dict[str, Recipe] = {
    "inverse_dynamics": Recipe((*_joints("q"), *_RATES, *_WRENCHES), (inverse_dynamics,), lambda n: ((n,),)),
    "inverse_dynamics_jacobian": Recipe(_joints("q", "qd", "qdd"), (inverse_dynamics,), lambda n: ((n, n), (n, n))),
    "mass_matrix": Recipe(_joints("q"), (mass_matrix,), lambda n: ((n, n),)),
    "forward_dynamics": Recipe(
        (*_joints("q"), _RATES[0], *_joints("tau"), *_WRENCHES),
        (forward_dynamics, forward_dynamics_articulated),
        lambda n: ((n,),),
    ),
    "error_growth": Recipe(_joints("q"), (error_growth, error_growth_articulated), lambda n: ((),)),
    "closed_form": Recipe(
        _joints("q", "qd"), (closed_form,), lambda n, tip: ((n, n), (n,), (n,), *(((n, 6),) if tip else ()))
    ),
    "regressor": Recipe(_joints("q", "qd", "qdd"), (regressor,), lambda n: ((n, 10 * n),)),
    "kinetic_energy": Recipe(_joints("q", "qd"), (kinetic_energy,), lambda n: ((),)),
    "potential_energy": Recipe(_joints("q"), (potential_energy,), lambda n: ((),)),
    "forward_kinematics": Recipe(
        _joints("q"),
        (forward_kinematics, forward_kinematics_from_base),
        lambda n, *frames: ((len(frames), 8),),
        each=True,
    ),
    "jacobian": Recipe(_joints("q"), (jacobian,), lambda n, frame, expressed: ((6, n),)),
}
DERIVATIVES = {"inverse_dynamics_jacobian": (0, 1)}  # positions of the arguments in which a recipe is differentiated


class _Call(NamedTuple):
    """Fields of `Function`."""

    constants: Constants
    name: str
    options: tuple[str, ...] = ()


class Function(_Call, Computation):
    """A public function for robots with the same constants, as a computation of `torchdq.call`."""

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.constants.fields["joint_names"])

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument, or of a tensor of the robot."""
        known = {argument: axes for argument, axes, _ in RECIPES[self.name].arguments}
        return trailing({**known, **SHAPES}[name], self.n)

    def shared(self, name: str) -> bool:
        """Whether it is a tensor of the robot."""
        return name in SHAPES

    def label(self, name: str) -> str:
        """Name in error messages."""
        return f"robot.{name}" if name in SHAPES else name

    def subject(self) -> str:
        """What shapes are for, in error messages."""
        return f" for the {self.n} joints of robot {self.constants.fields['name']!r}"

    def check(self, tensors: Mapping[str, Any]) -> None:
        """Raise unless all arguments are there that may not be absent."""
        for name, _, optional in RECIPES[self.name].arguments:
            if not optional and name not in tensors:
                raise ArgumentError(f"{name} must be a tensor, found NoneType; use torch.as_tensor")

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Trailing axes of the results."""
        return RECIPES[self.name].results(self.n, *self.options)

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the function, recorded once."""
        return _program(self, arguments)


def trailing(axes: Axes, n: int) -> tuple[int, ...]:
    """Trailing axes of a tensor of a robot with n joints."""
    return tuple([n if axis == "n" else int(axis) for axis in axes])


@remembered(PROGRAMS)
def _program(what: Function, arguments: tuple[Argument, ...]) -> Program:
    robot, recipe = recorded(what.constants), RECIPES[what.name]
    varied = tuple(a.name for a in arguments if a.name in SHAPES and not a.uniform)

    def by(way: Callable[..., Rows]) -> Program:
        def algorithm(*rows: Sequence[Number]) -> Rows:
            named = {a.name: row for a, row in zip(arguments, rows, strict=True)}
            given = {name: named.pop(name) for name in SHAPES if name in named}
            return way(Inputs(robot, named, given, varied), *what.options)

        return record(f"{way.__name__}_{robot.name}", arguments, algorithm)

    worth = recipe.ways if recipe.each else ways(robot.n, recipe.ways)
    best = min(map(by, worth), key=lambda p: p.count().total)
    wrt = DERIVATIVES.get(what.name)
    return best if wrt is None else derive.jacobian(best, wrt)
