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
from torchdq.base.checks import require_tensor
from torchdq.dynamics.task_space import rows_of
from torchdq.errors import ArgumentError
from torchdq.functions import floating as free
from torchdq.functions import formulas as fixed
from torchdq.functions import inverse_kinematics as ik
from torchdq.functions import task_space_formulas as task
from torchdq.functions.recipe import (
    BASE_WRENCH,
    RATES,
    WRENCHES,
    ArgumentSpec,
    Recipe,
    RecipeInputs,
    Results,
    alternatives_to_record,
    joints,
)
from torchdq.program import autodiff as derive
from torchdq.program.program import Argument, Program, record, replay, results
from torchdq.robot.constants import Constants
from torchdq.robot.fields import SHAPES, Axes, trailing
from torchdq.robot.robot import recorded

RECIPES: dict[str, Recipe] = {
    "inverse_dynamics": Recipe((*joints("q"), *RATES, *WRENCHES), (fixed.inverse_dynamics,), lambda: (("n",),)),
    "inverse_dynamics_jacobian": Recipe(
        joints("q", "qd", "qdd"), (fixed.inverse_dynamics,), lambda: (("n", "n"), ("n", "n"))
    ),
    "dynamics_jacobian": Recipe(joints("q", "qd", "qdd"), (), lambda: (("n", "n"), ("n", "n"), ("n", "n"))),
    "mass_matrix": Recipe(joints("q"), (fixed.mass_matrix,), lambda: (("n", "n"),)),
    "forward_dynamics": Recipe(
        (*joints("q"), RATES[0], *joints("tau"), *WRENCHES),
        (fixed.forward_dynamics, fixed.forward_dynamics_articulated),
        lambda: (("n",),),
    ),
    "error_growth": Recipe(joints("q"), (fixed.error_growth, fixed.error_growth_articulated), lambda: ((),)),
    "closed_form": Recipe(
        joints("q", "qd"), (fixed.closed_form,), lambda tip: (("n", "n"), ("n",), ("n",), *((("n", 6),) if tip else ()))
    ),
    "regressor": Recipe((*joints("q"), *RATES), (fixed.regressor,), lambda: (("n", "parameters"),)),
    "kinetic_energy": Recipe(joints("q", "qd"), (fixed.kinetic_energy,), lambda: ((),)),
    "potential_energy": Recipe(joints("q"), (fixed.potential_energy,), lambda: ((),)),
    "forward_kinematics": Recipe(
        joints("q"),
        (fixed.forward_kinematics, fixed.forward_kinematics_in_link_frames, fixed.forward_kinematics_from_base),
        lambda *frames: ((len(frames), 8),),
        each=True,
    ),
    "jacobian": Recipe(joints("q"), (fixed.jacobian,), lambda frame, expressed: ((6, "n"),)),
    "external_wrenches": Recipe(
        (*joints("q"), ("wrenches", ("frames", 6), False)), (fixed.external_wrenches,), lambda *frames: (("links", 6),)
    ),
    "coriolis_matrix": Recipe(joints("q", "qd"), (task.coriolis_matrix,), lambda: (("n", "n"),)),
    "frame_motion": Recipe(
        (*joints("q", "qd"), RATES[1]), (task.frame_motion,), lambda frame, expressed: ((8,), (6,), (6,))
    ),
    "manipulability": Recipe(joints("q"), (task.manipulability,), lambda *task: ((),)),
    "operational_space": Recipe(
        joints("q", "qd"),
        (task.operational_space,),
        lambda *task: (("axes", "axes"), ("axes",), ("axes",), ("axes", "n"), ("axes",), ("n", "axes"), ()),
    ),
    "inverse_kinematics_step": Recipe(
        (*joints("q", "best"), ("state", (5,), False), ("X", (8,), False), ("settings", (4,), False)),
        (ik.step,),
        lambda *task: (("n",), ("n",), (5,)),
        shared=("settings",),
    ),
    "inverse_kinematics_newton": Recipe(
        (*joints("q"), ("X", (8,), False)), (ik.newton,), lambda *task: (("axes",), ("n", "axes"))
    ),
    "differential_inverse_kinematics": Recipe(
        (*joints("q"), ("V_des", ("axes",), False), ("dt", (), True)), (ik.differential,), lambda *task: (("n",), ())
    ),
    "joint_momentum": Recipe(joints("q", "qd", "tau"), (), lambda: (("n",), ("n",))),
    "contact_force": Recipe(
        (*joints("q", "r"), ("damping", (), False)), (task.contact_force,), lambda *task: (("axes",), ("axes",))
    ),
}
_BEFORE = {"q": ("X_WB", (8,)), "qd": ("V_WB_B", (6,)), "qdd": ("A_WB_B", (6,))}  # what the base has before the joints


def _free(
    name: str, *formulas: Callable[..., Results], results: Callable[..., tuple[Axes, ...]] | None = None
) -> Recipe:
    """Recipe of a function with a floating base: that of `name`, each argument of the base before that of joints."""
    found: list[ArgumentSpec] = []
    for argument, axes, optional in (like := RECIPES[name]).arguments:
        found += [(*_BEFORE[argument], optional)] if argument in _BEFORE else []
        found.append((argument, axes, optional))
    wrench = BASE_WRENCH if WRENCHES[1] in found else ()
    return Recipe((*found, *wrench), formulas or like.formulas, results or like.results, like.each)


_FREE: dict[str, Recipe] = {
    "inverse_dynamics": _free("inverse_dynamics", results=lambda: ((6,), ("n",))),
    "forward_dynamics": _free("forward_dynamics", results=lambda: ((6,), ("n",))),
    "mass_matrix": _free("mass_matrix", results=lambda: (("all", "all"),)),
    "coriolis_matrix": _free("coriolis_matrix", results=lambda: (("all", "all"),)),
    "closed_form": _free("closed_form", results=lambda: (("all", "all"), ("all",), ("all",))),
    "error_growth": _free("error_growth"),
    "regressor": _free("regressor", results=lambda: (("all", "parameters"),)),
    "forward_kinematics": _free("forward_kinematics"),
    "jacobian": _free("jacobian", results=lambda frame, expressed: ((6, "all"),)),
    "external_wrenches": _free("external_wrenches", results=lambda *frames: (("links", 6), (6,))),
    "kinetic_energy": _free("kinetic_energy"),
    "potential_energy": _free("potential_energy"),
    "centre_of_mass": _free("mass_matrix", free.centre_of_mass, results=lambda: ((3,),)),
    "momentum": _free("kinetic_energy", free.momentum, results=lambda: ((3,), (3,))),
    "momentum_rate": _free("regressor", free.momentum_rate, results=lambda: ((3,), (3,))),
}
FLOATING = "floating."  # names of functions of robots with a floating base begin so
RECIPES |= {FLOATING + name: recipe for name, recipe in _FREE.items()}
_NO_MOTOR = "no motor moves its base, so torques of the joints alone cannot give a frame every acceleration"
_FIXED_ONLY = {  # why a function has no form for robots with a floating base
    "frame_motion": "floating.forward_kinematics and floating.jacobian give the pose and the twist of a frame",
    "joint_momentum": "what acts on its base is not measured",
    "contact_force": "what acts on its base is not measured",
    "manipulability": "its base moves every frame in all directions; torchdq.floating.jacobian has the joints' columns",
    "operational_space": _NO_MOTOR,
    "inverse_kinematics_step": "its base alone reaches every pose",
    "inverse_kinematics_newton": "its base alone reaches every pose",
    "differential_inverse_kinematics": _NO_MOTOR,
}
_OF_AXES = {  # third option: axes of a frame
    *("operational_space", "contact_force", "inverse_kinematics_newton", "differential_inverse_kinematics"),
}
# arguments that a result is differentiated by
DERIVATIVES = {"inverse_dynamics_jacobian": ("q", "qd"), "coriolis_matrix": ("V_WB_B", "qd")}


class _Call(NamedTuple):
    """Fields of `Function`."""

    constants: Constants
    name: str
    options: tuple[str, ...] = ()  # of a control law: gains that are one number for all of their axes
    written: tuple[Any, ...] = ()  # class and fields of a control law, which has the recipe; (): that of the catalogue


class Function(_Call, Computation):
    """Public function for robots with the same constants, as a computation of `torchdq.backends.call`."""

    @property
    def law(self) -> Any:
        """Control law; None: the function is in the catalogue."""
        return self.written[0].found(self.constants, *self.written) if self.written else None

    @property
    def recipe(self) -> Recipe:
        """Arguments, formulas and results."""
        return RECIPES[self.name] if self.law is None else self.law.recipe

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of axes, by name; see `Robot.sizes`."""
        fields = self.constants.fields
        n, links, floating = len(fields["joint_names"]), len(fields["link_names"]), fields["base_mass"] is not None
        axes = {"axes": len(rows_of(self.options[2]))} if self.name in _OF_AXES else {}
        axes["frames"] = len(self.options) - 1  # of "external_wrenches"
        return {"n": n, "links": links, "all": 6 + n, "parameters": 10 * (links + floating), **axes}

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument, or of a tensor of the robot."""
        recipe = self.recipe
        if name in recipe.single and name in self.options:
            return ()
        known = {argument: axes for argument, axes, _ in recipe.arguments}
        return trailing({**known, **SHAPES}[name], self.sizes)

    def shared(self, name: str) -> bool:
        """True for a tensor of the robot, a gain that is one number, and what all samples have in common."""
        return name in SHAPES or name in self.recipe.shared or not self.axes(name)

    def label(self, name: str) -> str:
        """Name of a tensor in error messages."""
        return f"robot.{name}" if name in SHAPES else name

    def subject(self) -> str:
        """Text about the robot after a shape in error messages."""
        task = "" if self.law is None else self.law.subject()
        if self.name in _OF_AXES:
            task = f"{self.sizes['axes']} axes of frame {self.options[0]!r} and "
        return f" for {task}the {self.sizes['n']} joints of robot {self.constants.fields['name']!r}"

    def check(self, tensors: Mapping[str, Any]) -> None:
        """Raise unless all required arguments are present."""
        self.require_base()
        for name, _, optional in self.recipe.arguments:
            if not optional:
                require_tensor(name, tensors.get(name))
        first = next(iter(tensors.values()))
        if not first.is_meta and self.constants.without_values:
            raise ArgumentError(
                f"robot {self.constants.fields['name']!r} is on the device 'meta', where tensors have no values, and "
                f"the arguments are on {first.device}; load the robot again"
            )

    def require_base(self) -> None:
        """Raise unless the base of the robot is fixed, or floating, as the function has it."""
        fields, plain = self.constants.fields, self.name.removeprefix(FLOATING)
        if self.written:  # a law says by itself which base it takes
            return
        if (fields["base_mass"] is not None) != (plain != self.name):
            if FLOATING + plain not in RECIPES:
                raise ArgumentError(
                    f"robot {fields['name']!r} has a floating base, which {plain.removesuffix('_step')} does not take: "
                    f"{_FIXED_ONLY[plain]}; load it with base='fixed' for the joints alone"
                )
            fixed = plain != self.name
            kind, other, way = ("fixed", "floating", "torchdq") if fixed else ("floating", "fixed", "torchdq.floating")
            raise ArgumentError(
                f"robot {fields['name']!r} has a {kind} base: use {way}.{plain}, or load it with base={other!r}"
            )

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Trailing axes of the results."""
        return tuple([trailing(axes, self.sizes) for axes in self.recipe.results(*self.options)])

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the function, cached."""
        return _program(self, arguments)


def recordings() -> int:
    """Number of programs of functions that this process has recorded so far, or since the last `clear_caches`."""
    return int(_program.cache_info().misses)  # type: ignore[attr-defined]


@remembered(PROGRAMS)
def _program(what: Function, arguments: tuple[Argument, ...]) -> Program:
    if what.name == "dynamics_jacobian":
        return _with_mass_matrix(what, arguments)
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
    wrt = [k for k, a in enumerate(taken) if a.name in DERIVATIVES.get(what.name.removeprefix(FLOATING), ())]
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
