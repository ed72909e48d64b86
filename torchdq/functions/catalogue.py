"""Catalogue of public functions: what each computes, on numbers, and its program for a robot.

A formula takes `RecipeInputs` and returns named rows of numbers; a `Recipe` holds the candidate formulas of a public
function, its arguments and the shapes of its results. A program depends on the constants of the robot and on which
arguments are present.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from torchdq.algebra import dual_quaternion, screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.caches import PROGRAMS, remembered
from torchdq.call import Computation
from torchdq.checks import require_tensor
from torchdq.dynamics import posed as mechanics
from torchdq.dynamics.aligned.posed import Aligned
from torchdq.dynamics.paper.rnea import exerted_wrenches
from torchdq.dynamics.posed import Posed
from torchdq.dynamics.tracking import commanded
from torchdq.errors import ArgumentError, SingularInertiaError
from torchdq.program import autodiff as derive
from torchdq.program.program import GROWTH, Argument, Program, Value, record
from torchdq.robot import consistency
from torchdq.robot.constants import Constants
from torchdq.robot.posed import GEOMETRY, INERTIAL, Overrides, as_screw, factors, frame, paper, posed, solve, tree
from torchdq.robot.robot import SHAPES, Robot, recorded

TRACKING = ("q", "qd", "q_des", "qd_des", "qdd_des", "kp", "kd")  # arguments of computed torque control
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
        if any(name in self.overrides for name in (*INERTIAL, *GEOMETRY, "armature")):
            return
        found = consistency.inert_joints(self.robot.joint_names, tree(self.robot, {}))
        if found:
            raise SingularInertiaError(f"robot {self.robot.name!r} cannot be accelerated: {'; '.join(found)}")

    def posed(self) -> Posed:
        """Robot at q."""
        return posed(self.robot, self.arguments["q"], self.overrides, self.per_sample)

    def exerted(self, at: Posed) -> list[Screw | None] | None:
        """Wrench each link exerts on the environment; None: there is none."""
        f_tip, f_ext = self.arguments.get("f_tip"), self.arguments.get("f_ext")
        if f_tip is None and f_ext is None:
            return None
        n, tip = self.robot.n, None
        if f_tip is not None:
            link, X_BF = frame(self.robot, self.robot.end_effector().name)
            tip = (link, screw.columns(X_BF))
        ext = None if f_ext is None else [None, *(as_screw(f_ext[6 * i : 6 * i + 6]) for i in range(n))]
        exerted = exerted_wrenches(n + 1, ext, tip, None if f_tip is None else as_screw(f_tip))
        return [None if F is None else at.wrench(i, F) for i, F in enumerate(exerted)]


def inverse_dynamics(x: RecipeInputs) -> Results:
    """Torques tau."""
    at = x.posed()
    return {"tau": at.torques(x.arguments.get("qd"), x.arguments.get("qdd"), x.exerted(at))}


def computed_torque(x: RecipeInputs, *single: str) -> Results:
    """Torques tau of the desired acceleration, errors fed back; gains in `single` are one number for all joints."""
    given = {name: tuple(row) * x.robot.n if name in single else row for name, row in x.arguments.items()}
    a = list(map(commanded, *[given[name] for name in TRACKING]))
    at = x.posed()
    return {"tau": at.torques(given["qd"], a, x.exerted(at))}  # (73), (74)


def mass_matrix(x: RecipeInputs) -> Results:
    """Mass matrix M, row-major."""
    return {"M": [entry for row in x.posed().mass_matrix() for entry in row]}


def forward_dynamics(x: RecipeInputs, linear: bool = False) -> Results:
    """Accelerations qdd, by the factors of the mass matrix or, if `linear`, by articulated bodies."""
    x.require_inertia()
    at = x.posed()
    bias = at.torques(x.arguments.get("qd"), None, x.exerted(at))
    net = [t if b is None else t - b for t, b in zip(x.arguments["tau"], bias, strict=True)]
    qdd, growth = solve(x.robot, at, net, linear)  # (63) solved for qdd
    return {"qdd": qdd, GROWTH: [growth]}


def forward_dynamics_articulated(x: RecipeInputs) -> Results:
    """Accelerations qdd, by articulated bodies."""
    return forward_dynamics(x, linear=True)


def error_growth(x: RecipeInputs, linear: bool = False) -> Results:
    """Largest ratio of M_ii to its pivot."""
    x.require_inertia()
    return {"growth": [factors(x.robot, x.posed(), linear).growth]}


def error_growth_articulated(x: RecipeInputs) -> Results:
    """Largest ratio of M_ii to its pivot, by articulated bodies."""
    return error_growth(x, linear=True)


def closed_form(x: RecipeInputs, tip_name: str) -> Results:
    """Mass matrix M, Coriolis torques c, gravity torques g, and the Jacobian Jt if there is a tip."""
    at = x.posed()
    M, c, g = mechanics.closed_form(at, x.arguments["qd"])
    rows: Results = {"M": [entry for row in M for entry in row], "c": c, "g": g}
    if tip_name:
        columns = at.jacobian(*frame(x.robot, tip_name), world=False)
        # a wrench is (force, moment) and a twist (angular, linear)
        rows["Jt"] = [entry for c in columns for entry in _six(None if c is None else screw.swap(c))]  # (72)
    return rows


def regressor(x: RecipeInputs) -> Results:
    """Regressor Y, row-major."""
    blocks = x.posed().regressor(x.arguments["qd"], x.arguments["qdd"])
    return {"Y": [entry for row in blocks for block in row for entry in (block or (None,) * 10)]}


def kinetic_energy(x: RecipeInputs) -> Results:
    """Kinetic energy T."""
    return {"T": [x.posed().kinetic_energy(x.arguments["qd"])]}


def potential_energy(x: RecipeInputs) -> Results:
    """Potential energy U."""
    return {"U": [x.posed().potential_energy()]}


def forward_kinematics(x: RecipeInputs, *names: str) -> Results:
    """Poses of frames, joint by joint, by elementary screws."""
    at = x.posed()
    X_WB = at.poses_in_chain() if isinstance(at, Aligned) else at.poses()
    return _poses(x, names, lambda link, X_BF: dual_quaternion.mul(X_WB[link], X_BF))


def forward_kinematics_in_link_frames(x: RecipeInputs, *names: str) -> Results:
    """Poses of frames, joint by joint, in the link frames of the description."""
    X_WB = paper(x.robot, x.arguments["q"], x.overrides).poses()
    return _poses(x, names, lambda link, X_BF: dual_quaternion.mul(X_WB[link], X_BF))


def forward_kinematics_from_base(x: RecipeInputs, *names: str) -> Results:
    """Poses of frames, by joint screws in the base frame."""
    at = x.posed()
    if not isinstance(at, Aligned):
        return forward_kinematics(x, *names)
    links = at.poses_from_base()
    mul = dual_quaternion.mul
    return _poses(x, names, lambda link, X_BF: mul(links[link].motion, mul(links[link].home, X_BF)))


def _poses(x: RecipeInputs, names: Sequence[str], pose: Callable[[int, DualQuaternion], DualQuaternion]) -> Results:
    """Poses of frames; `pose(link, X_BF)` is that of a frame on a link."""
    rows: list[Value] = []
    for p, d in (pose(*frame(x.robot, name)) for name in names):
        rows += [*p, *d]
    return {"X": rows}


def jacobian(x: RecipeInputs, name: str, expressed: str) -> Results:
    """Jacobian J, row-major, twist components by joints."""
    columns = x.posed().jacobian(*frame(x.robot, name), world=expressed == "world")
    return {"J": [_six(c)[i] for i in range(6) for c in columns]}


def _six(s: Screw | None) -> tuple[Number | None, ...]:
    return (None,) * 6 if s is None else (*s[0], *s[1])


Axes = tuple[int | str, ...]  # trailing axes, "n" being the number of joints


def worth_recording(n: int, known: Sequence[Alternative]) -> Sequence[Alternative]:
    """Candidates to record: the dense one below 9 joints, both below 64, then only the O(n) one."""
    return known[:1] if n < LONG else known if n < VERY_LONG else known[-1:]


class Recipe(NamedTuple):
    """Public function: its arguments, its candidate formulas, and the shapes of its results."""

    arguments: tuple[tuple[str, Axes, bool], ...]  # name, trailing axes, whether it may be absent
    # candidate formulas; the one with the fewest operations for the robot becomes the program
    formulas: tuple[Callable[..., Results], ...]
    results: Callable[..., tuple[tuple[int, ...], ...]]  # trailing axes of the results, from n and the options
    each: bool = False  # whether all candidates are recorded, whatever the number of joints
    single: tuple[str, ...] = ()  # arguments that are one number for all joints if they are among the options


def _joints(*names: str) -> tuple[tuple[str, Axes, bool], ...]:
    return tuple((name, ("n",), False) for name in names)


_WRENCHES: tuple[tuple[str, Axes, bool], ...] = (("f_tip", (6,), True), ("f_ext", ("n", 6), True))
_RATES: tuple[tuple[str, Axes, bool], ...] = (("qd", ("n",), True), ("qdd", ("n",), True))

RECIPES: dict[str, Recipe] = {
    "inverse_dynamics": Recipe((*_joints("q"), *_RATES, *_WRENCHES), (inverse_dynamics,), lambda n: ((n,),)),
    "inverse_dynamics_jacobian": Recipe(_joints("q", "qd", "qdd"), (inverse_dynamics,), lambda n: ((n, n), (n, n))),
    "computed_torque": Recipe(
        (*_joints(*TRACKING), _WRENCHES[0]), (computed_torque,), lambda n, *single: ((n,),), single=("kp", "kd")
    ),
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
        (forward_kinematics, forward_kinematics_in_link_frames, forward_kinematics_from_base),
        lambda n, *frames: ((len(frames), 8),),
        each=True,
    ),
    "jacobian": Recipe(_joints("q"), (jacobian,), lambda n, frame, expressed: ((6, n),)),
}
DERIVATIVES = {"inverse_dynamics_jacobian": (0, 1)}  # positions of the arguments that a result is differentiated by


class _Call(NamedTuple):
    """Fields of `Function`."""

    constants: Constants
    name: str
    options: tuple[str, ...] = ()


class Function(_Call, Computation):
    """Public function for robots with the same constants, as a computation of `torchdq.call`."""

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.constants.fields["joint_names"])

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument, or of a tensor of the robot."""
        recipe = RECIPES[self.name]
        if name in recipe.single and name in self.options:
            return ()
        known = {argument: axes for argument, axes, _ in recipe.arguments}
        return trailing({**known, **SHAPES}[name], self.n)

    def shared(self, name: str) -> bool:
        """True for a tensor of the robot."""
        return name in SHAPES

    def label(self, name: str) -> str:
        """Name of a tensor in error messages."""
        return f"robot.{name}" if name in SHAPES else name

    def subject(self) -> str:
        """Words about the robot after a shape in error messages."""
        return f" for the {self.n} joints of robot {self.constants.fields['name']!r}"

    def check(self, tensors: Mapping[str, Any]) -> None:
        """Raise unless all required arguments are present."""
        for name, _, optional in RECIPES[self.name].arguments:
            if not optional:
                require_tensor(name, tensors.get(name))
        first = next(iter(tensors.values()))
        if not first.is_meta and self.constants.without_values():
            raise ArgumentError(
                f"robot {self.constants.fields['name']!r} is on the device 'meta', where tensors have no values, and "
                f"the arguments are on {first.device}; load the robot anew"
            )

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Trailing axes of the results."""
        return RECIPES[self.name].results(self.n, *self.options)

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the function, cached."""
        return _program(self, arguments)


def trailing(axes: Axes, n: int) -> tuple[int, ...]:
    """Trailing axes of a tensor of a robot with n joints."""
    return tuple([n if axis == "n" else int(axis) for axis in axes])


def recordings() -> int:
    """Number of programs of functions that this process has recorded so far, or since the last `clear_caches`."""
    return int(_program.cache_info().misses)  # type: ignore[attr-defined]


@remembered(PROGRAMS)
def _program(what: Function, arguments: tuple[Argument, ...]) -> Program:
    robot, recipe = recorded(what.constants), RECIPES[what.name]
    per_sample = tuple(a.name for a in arguments if a.name in SHAPES and not a.uniform)

    def by(formula: Callable[..., Results]) -> Program:
        def algorithm(*rows: Sequence[Number]) -> Results:
            named = {a.name: row for a, row in zip(arguments, rows, strict=True)}
            overrides = {name: named.pop(name) for name in SHAPES if name in named}
            return formula(RecipeInputs(robot, named, overrides, per_sample), *what.options)

        return record(f"{formula.__name__}_{robot.name}", arguments, algorithm)

    known = recipe.formulas if recipe.each else worth_recording(robot.n, recipe.formulas)
    best = min(map(by, known), key=lambda p: p.count().total)
    wrt = DERIVATIVES.get(what.name)
    return best if wrt is None else derive.jacobian(best, wrt)
