"""Catalogue of public functions, and the program of each for a robot.

A formula takes `RecipeInputs` and returns named rows of numbers; a `Recipe` holds the candidate formulas of a public
function, its arguments and the shapes of its results. A program depends on the constants of the robot and on which
arguments are present.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from torchdq.algebra.quaternion import Number
from torchdq.backends.call import Computation
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import NOT_NEGATIVE, POSITIVE, REAL, OneOf, require_tensor
from torchdq.dynamics.closures import ROWS
from torchdq.dynamics.task_space import rows_of
from torchdq.errors import ArgumentError
from torchdq.functions import distances as apart
from torchdq.functions import floating as free
from torchdq.functions import formulas as fixed
from torchdq.functions import hessian
from torchdq.functions import inverse_kinematics as ik
from torchdq.functions import task_space_formulas as task
from torchdq.functions.recipe import (
    EXPRESSED,
    FRAME,
    PAIRS,
    TASK,
    WRENCHES,
    Recipe,
    RecipeInputs,
    Results,
    alternatives_to_record,
)
from torchdq.functions.signature import Field, joints
from torchdq.program import autodiff as derive
from torchdq.program.program import Argument, Program, record, replay, results
from torchdq.robot.constants import Constants
from torchdq.robot.fields import SHAPES, Axes, trailing
from torchdq.robot.robot import recorded

_MOVED = joints("qd", "qdd", optional=True)
_NO_MOTOR = "no motor moves its base, so torques of the joints alone cannot give a frame every acceleration"
_UNMEASURED = "what acts on its base is not measured"
_NO_COORDINATES = "its pose has no unique coordinates to differentiate by"
_ANYWHERE = "its base alone reaches every pose"

RECIPES: dict[str, Recipe] = {
    "inverse_dynamics": Recipe((*joints("q"), *_MOVED, *WRENCHES), (fixed.inverse_dynamics,), lambda: (("n",),)),
    "inverse_dynamics_jacobian": Recipe(
        joints("q", "qd", "qdd"), (fixed.inverse_dynamics,), lambda: (("n", "n"), ("n", "n")), wrt=("q", "qd")
    ),
    "dynamics_jacobian": Recipe(joints("q", "qd", "qdd"), (), lambda: (("n", "n"), ("n", "n"), ("n", "n"))),
    **{
        name: Recipe(
            (*joints("q", "qd", last), *joints("weight", optional=True)),
            (),
            lambda: (("3n", "3n"), ("n", "3n")),
            fixed_only=_NO_COORDINATES,
        )
        for name, last in (("dynamics_hessian", "qdd"), ("forward_dynamics_hessian", "tau"))
    },
    "mass_matrix": Recipe(joints("q"), (fixed.mass_matrix,), lambda: (("n", "n"),)),
    "mass_matrix_derivative": Recipe(
        joints("q"), (fixed.mass_matrix,), lambda: (("n", "n", "n"),), wrt=("q",), fixed_only=_NO_COORDINATES
    ),
    "forward_dynamics": Recipe(
        (*joints("q"), _MOVED[0], *joints("tau"), *WRENCHES),
        (fixed.forward_dynamics, fixed.forward_dynamics_articulated),
        lambda: (("n",),),
    ),
    "error_growth": Recipe(joints("q"), (fixed.error_growth, fixed.error_growth_articulated), lambda: ((),)),
    "closed_form": Recipe(
        (*joints("q", "qd"), FRAME._replace(name="tip")),
        (fixed.closed_form,),
        lambda *tip: (("n", "n"), ("n",), ("n",), *((("n", 6),) if any(tip) else ())),
    ),
    "regressor": Recipe((*joints("q"), *_MOVED), (fixed.regressor,), lambda: (("n", "parameters"),)),
    "kinetic_energy": Recipe(joints("q", "qd"), (fixed.kinetic_energy,), lambda: ((),)),
    "potential_energy": Recipe(joints("q"), (fixed.potential_energy,), lambda: ((),)),
    "forward_kinematics": Recipe(
        (*joints("q"), FRAME._replace(name="frames", default=None)),
        (fixed.forward_kinematics, fixed.forward_kinematics_in_link_frames, fixed.forward_kinematics_from_base),
        lambda *frames: ((len(frames), 8),),
        each=True,
    ),
    "jacobian": Recipe(
        (*joints("q"), FRAME._replace(default=None), EXPRESSED),
        (fixed.jacobian,),
        lambda frame, expressed: ((6, "n"),),
    ),
    "external_wrenches": Recipe(
        (
            *joints("q"),
            Field("wrenches", ("frames", 6)),
            EXPRESSED._replace(default="world"),
            FRAME._replace(name="frames"),
        ),
        (fixed.external_wrenches,),
        lambda *frames: (("links", 6),),
    ),
    "closure_gaps": Recipe(
        joints("q"), (fixed.closure_gaps,), lambda: (("gaps",), ("gaps", "n"), ("closures",)), of_joints=True
    ),
    "loop_step": Recipe(
        (*joints("q"), _MOVED[0], Field("free", ("n",), kind="shared")),
        (fixed.loop_step,),
        lambda: (("n",), (), ()),
        of_joints=True,
    ),
    "loop_torques": Recipe((*joints("q"), *_MOVED, *WRENCHES), (fixed.loop_torques,), lambda: (("n",), ("gaps", "n"))),
    "distances": Recipe(
        (
            *(*joints("q"), Field("X_WO", ("objects", 8), optional=True)),
            *(Field("height", (), True, "parameter", REAL), Field("normal", (3,), optional=True)),
            *(Field("sizes", ("sizes",), optional=True), *PAIRS),
        ),
        (apart.distances,),
        lambda *pairs: (("pairs",),),
    ),
    "coriolis_matrix": Recipe(joints("q", "qd"), (task.coriolis_matrix,), lambda: (("n", "n"),), wrt=("V_WB_B", "qd")),
    "frame_motion": Recipe(
        (*joints("q", "qd"), _MOVED[1], FRAME, EXPRESSED),
        (task.frame_motion,),
        lambda frame, expressed: ((8,), (6,), (6,)),
        fixed_only="floating.forward_kinematics and floating.jacobian give the pose and the twist of a frame",
    ),
    "manipulability": Recipe(
        (*joints("q"), *TASK),
        (task.manipulability,),
        lambda *task: ((),),
        fixed_only="its base moves every frame in all directions; torchdq.floating.jacobian has the joints' columns",
    ),
    "operational_space": Recipe(
        (*joints("q", "qd"), *TASK),
        (task.operational_space,),
        lambda *task: (("axes", "axes"), ("axes",), ("axes",), ("axes", "n"), ("axes",), ("n", "axes"), ()),
        fixed_only=_NO_MOTOR,
    ),
    "inverse_kinematics_step": Recipe(
        (*joints("q", "best"), Field("state", (6,)), Field("X", (8,)), Field("settings", (4,), kind="shared"), *TASK),
        (ik.step,),
        lambda *task: (("n",), ("n",), (6,)),
        fixed_only=_ANYWHERE,
    ),
    "inverse_kinematics_newton": Recipe(
        (*joints("q"), Field("X", (8,)), *TASK),
        (ik.newton,),
        lambda *task: (("axes",), ("n", "axes")),
        fixed_only=_ANYWHERE,
    ),
    "differential_inverse_kinematics": Recipe(
        (
            *(*joints("q"), Field("V_des", ("axes",)), Field("dt", (), True, "parameter", POSITIVE), *TASK),
            Field("bounded", kind="option", check=OneOf(("", "bounded")), default=""),
        ),
        (ik.differential,),
        lambda *task: (("n",), ()),
        fixed_only=_NO_MOTOR,
    ),
    "joint_momentum": Recipe(joints("q", "qd", "tau"), (), lambda: (("n",), ("n",)), fixed_only=_UNMEASURED),
    "contact_force": Recipe(
        (*joints("q", "r"), Field("damping", kind="parameter", check=NOT_NEGATIVE), *TASK),
        (task.contact_force,),
        lambda *task: (("axes",), ("axes",)),
        fixed_only=_UNMEASURED,
    ),
}
# what the base has before the joints, and behind the wrenches on the links
_BEFORE = {"q": ("X_WB", (8,)), "qd": ("V_WB_B", (6,)), "qdd": ("A_WB_B", (6,))}
_BEHIND = Field("f_base", (6,), optional=True)


def _free(name: str, *results: Axes, formula: Callable[..., Results] | None = None) -> Recipe:
    """Recipe of a function with a floating base: that of `name`, each argument of the base before that of joints.

    So are rows and columns of its results, unless these are given.
    """
    like, found = RECIPES[name], list[Field]()
    for field in like.fields:
        if field.name in _BEFORE:
            found.append(Field(*_BEFORE[field.name], field.optional))
        found += [field] if field.name != "tip" else []
        found += [_BEHIND] if field.name == "f_ext" else []

    def shapes(*options: str) -> tuple[Axes, ...]:
        return results or tuple([tuple("all" if x == "n" else x for x in axes) for axes in like.results(*options)])

    return like._replace(fields=tuple(found), formulas=(formula,) if formula else like.formulas, results=shapes)


_ALIKE = (
    "mass_matrix",
    "coriolis_matrix",
    "closed_form",
    "error_growth",
    "regressor",
    "forward_kinematics",
    "jacobian",
    "distances",
)
_FREE: dict[str, Recipe] = {
    **{name: _free(name, (6,), ("n",)) for name in ("inverse_dynamics", "forward_dynamics")},
    **{name: _free(name) for name in (*_ALIKE, "kinetic_energy", "potential_energy")},
    "external_wrenches": _free("external_wrenches", ("links", 6), (6,)),
    "centre_of_mass": _free("mass_matrix", (3,), formula=free.centre_of_mass),
    "momentum": _free("kinetic_energy", (3,), (3,), formula=free.momentum),
    "momentum_rate": _free("regressor", (3,), (3,), formula=free.momentum_rate),
}
# functions that take a robot for the tree of its links
_OPEN = {
    **dict.fromkeys(("inverse_dynamics", "regressor"), "its torques would need the forces of the closures"),
    **dict.fromkeys(
        (
            *("inverse_dynamics_jacobian", "dynamics_jacobian", "dynamics_hessian", "forward_dynamics_hessian"),
            *("joint_momentum", "operational_space", "contact_force"),
        ),
        "its motion would need the forces of the closures",
    ),
    **dict.fromkeys(
        ("manipulability",),
        "the loops leave its joints less freedom",
    ),
    **dict.fromkeys(
        ("inverse_kinematics_step", "inverse_kinematics_newton", "differential_inverse_kinematics"),
        "it moves the joints as if all loops were open",
    ),
}
FLOATING = "floating."  # names of functions of robots with a floating base begin so
RECIPES |= {FLOATING + name: recipe for name, recipe in _FREE.items()}


class _Call(NamedTuple):
    """Fields of `Function`."""

    constants: Constants
    name: str
    options: tuple[Any, ...] = ()  # of a control law: gains that are one number for all of their axes
    form: tuple[Any, ...] = ()  # class and fields of a control law, which has the recipe; (): that of the catalogue
    motors: Any = None  # friction and offset of a layer (`torchdq.effects.resistance.Templates`), which has more fields


class Function(_Call, Computation):
    """Public function for robots with the same constants, as a computation of `torchdq.backends.call`."""

    @property
    def law(self) -> Any:
        """Control law; None: the function is in the catalogue."""
        return self.form[0].found(self.constants, *self.form) if self.form else None

    @property
    def recipe(self) -> Recipe:
        """Arguments, formulas and results."""
        return RECIPES[self.name] if self.law is None else self.law.recipe

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of axes, by name; see `Robot.sizes`."""
        return _sizes(self)

    @property
    def _of_axes(self) -> bool:
        """True if it is about some axes of a frame."""
        return self.recipe.options[:3] == TASK

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument, or of a tensor of the robot."""
        field = self._field(name)
        if field is None:
            return trailing(SHAPES[name], self.sizes)
        return () if field.kind == "parameter" and name in self.options else trailing(field.axes, self.sizes)

    def _field(self, name: str) -> Field | None:
        """Field of an argument; None: it is a tensor of the robot."""
        known = (*self.recipe.arguments, *([] if self.motors is None else self.motors.fields()))
        return next((field for field in known if field.name == name and name not in SHAPES), None)

    def shared(self, name: str) -> bool:
        """True for a tensor of the robot, a parameter of a layer, one number, and what all samples have in common."""
        field = self._field(name)
        if field is None or field.kind == "shared" or not self.axes(name):
            return True
        return self.motors is not None and field.kind == "parameter"

    def label(self, name: str) -> str:
        """Name of a tensor in error messages."""
        return f"robot.{name}" if name in SHAPES else name.rpartition(".")[2]

    def subject(self) -> str:
        """Text about the robot after a shape in error messages."""
        task = "" if self.law is None else self.law.subject()
        if self._of_axes:
            task = f"{self.sizes['axes']} axes of frame {self.options[0]!r} and "
        return f" for {task}the {self.sizes['n']} joints of robot {self.constants.fields['name']!r}"

    def check(self, tensors: Mapping[str, Any]) -> None:
        """Raise unless all required arguments are present."""
        self.require_base()
        for field in self.recipe.arguments:
            if not field.optional:
                require_tensor(field.name, tensors.get(field.name))
        first = next(iter(tensors.values()))
        if not first.is_meta and self.constants.without_values:
            raise ArgumentError(
                f"robot {self.constants.fields['name']!r} is on the device 'meta', where tensors have no values, and "
                f"the arguments are on {first.device}; load the robot again"
            )

    def require_base(self) -> None:
        """Raise unless the base of the robot is fixed, or floating, as the function has it."""
        fields, plain = self.constants.fields, self.name.removeprefix(FLOATING)
        if fields["closures"] and not self.form and plain in _OPEN:
            raise ArgumentError(
                f"robot {fields['name']!r} has closures, which {plain.removesuffix('_step')} does not take: "
                f"{_OPEN[plain]}; robot.replace(closures=()) is the tree without them"
            )
        if self.form or self.recipe.of_joints:  # a law says by itself which base it takes
            return
        if (fields["base_mass"] is not None) != (plain != self.name):
            if FLOATING + plain not in RECIPES:
                raise ArgumentError(
                    f"robot {fields['name']!r} has a floating base, which {plain.removesuffix('_step')} does not take: "
                    f"{RECIPES[plain].fixed_only}; load it with base='fixed' for the joints alone"
                )
            fixed = plain != self.name
            kind, other, way = ("fixed", "floating", "torchdq") if fixed else ("floating", "fixed", "torchdq.floating")
            raise ArgumentError(
                f"robot {fields['name']!r} has a {kind} base: use {way}.{plain}, or load it with base={other!r}"
            )

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Trailing axes of the results."""
        shapes = self.recipe.results(*self.options)
        if self.name.endswith("dynamics_hessian") and all(a.name != "weight" for a in program.arguments):
            shapes = (("n", *shapes[0]), shapes[1])  # a Hessian for each joint
        return tuple([trailing(axes, self.sizes) for axes in shapes])

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the function, cached."""
        if self.motors is not None:
            return self.motors.program(self._replace(motors=None), arguments)
        return _program(self, arguments)


@remembered(PROGRAMS)
def _sizes(what: Function) -> dict[str, int]:
    """Sizes of axes of a function, found once: several are asked for at every call."""
    fields = what.constants.fields
    n, links, floating = len(fields["joint_names"]), len(fields["link_names"]), fields["base_mass"] is not None
    axes = len(rows_of(what.options[2])) if what._of_axes else 0
    gaps = sum(ROWS[kind] for *_, kind in fields["closures"])
    found = {
        "n": n,
        "links": links,
        "gaps": gaps,
        "closures": len(fields["closures"]),
        "all": 6 + n,
        "3n": 3 * n,
        "parameters": 10 * (links + floating),
        "axes": axes,
    }
    if what.recipe.options == PAIRS:
        objects, pairs = what.options[1], apart.pairs(recorded(what.constants), *what.options)
        found |= {"objects": len(objects), "sizes": apart.sizes(objects), "pairs": len(pairs)}
    return {**found, "frames": len(what.options) - 1}  # of "external_wrenches"


def recordings() -> int:
    """Number of programs of functions that this process has recorded so far, or since the last `clear_caches`."""
    return int(_program.cache_info().misses)  # type: ignore[attr-defined]


@remembered(PROGRAMS)
def _program(what: Function, arguments: tuple[Argument, ...]) -> Program:
    if what.name == "dynamics_jacobian":
        return _with_mass_matrix(what, arguments)
    if what.name.endswith("dynamics_hessian"):
        return _hessian(what, arguments)
    if what.name == "joint_momentum":
        return _momentum(what, arguments)
    robot, recipe = recorded(what.constants), what.recipe
    per_sample = tuple(a.name for a in arguments if a.name in SHAPES and not a.uniform)
    taken = (*arguments, task.HELD) if what.name == "floating.coriolis_matrix" else arguments

    def by(formula: Callable[..., Results]) -> Program:
        def algorithm(*rows: Sequence[Number]) -> Results:
            named = {a.name: row for a, row in zip(taken, rows, strict=True)}
            overrides = {name: named.pop(name) for name in SHAPES if name in named}
            return formula(RecipeInputs(robot, named, overrides, per_sample), *what.options)

        return record(f"{formula.__name__}_{robot.name}", taken, algorithm)

    known = recipe.formulas if recipe.each else alternatives_to_record(robot.n, recipe.formulas)
    best = min(map(by, known), key=lambda p: p.count().total)
    wrt = [k for k, a in enumerate(taken) if a.name in recipe.wrt]
    if what.name.endswith("coriolis_matrix"):
        return _square(derive.jacobian(best, wrt), arguments, sum(taken[k].width for k in wrt))
    return derive.jacobian(best, wrt) if wrt else best


def _square(blocks: Program, arguments: tuple[Argument, ...], n: int) -> Program:
    """Matrix C [n, n] of blocks of columns side by side, in which the twist that was held is that of the base."""

    def algorithm(*rows: Sequence[Number]) -> Results:
        named = {a.name: row for a, row in zip(arguments, rows, strict=True)}
        values = replay(blocks, [named["V_WB_B" if a == task.HELD else a.name] for a in blocks.arguments])
        found = [(len(block) // n, block) for block in results(blocks, values).values()] if n else []
        return {"C": [x for i in range(n) for width, block in found for x in block[i * width : (i + 1) * width]]}

    return record(blocks.name.removesuffix("_jacobian"), arguments, algorithm)


def _with_mass_matrix(what: Function, arguments: tuple[Argument, ...]) -> Program:
    """Derivatives of the torques and the mass matrix, which share what depends on q alone."""
    slopes = Function(what.constants, "inverse_dynamics_jacobian").program(arguments)
    inertia = Function(what.constants, "mass_matrix").program(
        tuple([a for a in arguments if a.name not in ("qd", "qdd")])
    )

    def algorithm(*rows: Sequence[Number]) -> Results:
        named = {a.name: row for a, row in zip(arguments, rows, strict=True)}
        parts = [(part, replay(part, [named[a.name] for a in part.arguments])) for part in (slopes, inertia)]
        return {name: row for part, values in parts for name, row in results(part, values).items()}

    return record(f"dynamics_jacobian_{what.constants.fields['name']}", arguments, algorithm)


def _hessian(what: Function, arguments: tuple[Argument, ...]) -> Program:
    """Second derivatives of torques or accelerations, with the first ones."""
    caused = tuple([a for a in arguments if a.name != "weight"])
    moved = tuple([a._replace(name="qdd") if a.name == "tau" else a for a in caused])
    torques, accelerations = Function(what.constants, "inverse_dynamics").program(moved), None
    if caused != moved:
        accelerations = Function(what.constants, "forward_dynamics").program(caused)
    name = f"{what.name}_{what.constants.fields['name']}"
    return hessian.with_jacobian(name, arguments, torques, accelerations)


def _momentum(what: Function, arguments: tuple[Argument, ...]) -> Program:
    """Momenta p = dT/dqd and their modelled rates tau + dT/dq - g, by one gradient of the kinetic energy T."""
    still = tuple([a for a in arguments if a.name != "tau"])
    wrt = [k for k, a in enumerate(still) if a.name in ("q", "qd")]
    slopes = derive.vjp(Function(what.constants, "kinetic_energy").program(still), wrt)
    weight = Function(what.constants, "inverse_dynamics").program(tuple([a for a in still if a.name != "qd"]))

    def algorithm(*rows: Sequence[Number]) -> Results:
        named = {**{a.name: row for a, row in zip(arguments, rows, strict=True)}, "T'": (1.0,)}
        (dq, p), (g,) = [
            list(results(part, replay(part, [named[a.name] for a in part.arguments])).values())
            for part in (slopes, weight)
        ]
        return {"momentum": p, "rate": [t + d - w for t, d, w in zip(named["tau"], dq, g, strict=True)]}

    return record(f"joint_momentum_{what.constants.fields['name']}", arguments, algorithm)
