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
from torchdq.errors import ArgumentError
from torchdq.functions import floating as free
from torchdq.functions import formulas as fixed
from torchdq.functions.formulas import TRACKING
from torchdq.functions.recipe import (
    BASE_WRENCH,
    RATES,
    WRENCHES,
    Recipe,
    RecipeInputs,
    Results,
    joints,
    worth_recording,
)
from torchdq.program import autodiff as derive
from torchdq.program.program import Argument, Program, record
from torchdq.robot.constants import Constants
from torchdq.robot.fields import SHAPES, Axes, trailing
from torchdq.robot.robot import recorded

RECIPES: dict[str, Recipe] = {
    "inverse_dynamics": Recipe((*joints("q"), *RATES, *WRENCHES), (fixed.inverse_dynamics,), lambda: (("n",),)),
    "inverse_dynamics_jacobian": Recipe(
        joints("q", "qd", "qdd"), (fixed.inverse_dynamics,), lambda: (("n", "n"), ("n", "n"))
    ),
    "computed_torque": Recipe(
        (*joints(*TRACKING), WRENCHES[0]), (fixed.computed_torque,), lambda *single: (("n",),), single=("kp", "kd")
    ),
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
    "regressor": Recipe(joints("q", "qd", "qdd"), (fixed.regressor,), lambda: (("n", "parameters"),)),
    "kinetic_energy": Recipe(joints("q", "qd"), (fixed.kinetic_energy,), lambda: ((),)),
    "potential_energy": Recipe(joints("q"), (fixed.potential_energy,), lambda: ((),)),
    "forward_kinematics": Recipe(
        joints("q"),
        (fixed.forward_kinematics, fixed.forward_kinematics_in_link_frames, fixed.forward_kinematics_from_base),
        lambda *frames: ((len(frames), 8),),
        each=True,
    ),
    "jacobian": Recipe(joints("q"), (fixed.jacobian,), lambda frame, expressed: ((6, "n"),)),
}
_PLACE: tuple[tuple[str, Axes, bool], ...] = (("X_WB", (8,), False), *joints("q"))
_TWIST: tuple[tuple[str, Axes, bool], ...] = (("V_WB_B", (6,), False), *joints("qd"))
_MOTION = (*_PLACE, ("V_WB_B", (6,), True), RATES[0])
_CHANGE = (*_MOTION, ("A_WB_B", (6,), True), RATES[1])
_FREE: dict[str, Recipe] = {
    "inverse_dynamics": Recipe((*_CHANGE, *WRENCHES, *BASE_WRENCH), (free.inverse_dynamics,), lambda: ((6,), ("n",))),
    "forward_dynamics": Recipe(
        (*_MOTION, ("tau", ("n",), True), *WRENCHES, *BASE_WRENCH),
        (free.forward_dynamics, free.forward_dynamics_articulated),
        lambda: ((6,), ("n",)),
    ),
    "mass_matrix": Recipe(_PLACE, (fixed.mass_matrix,), lambda: (("all", "all"),)),
    "closed_form": Recipe((*_PLACE, *_TWIST), (free.closed_form,), lambda: (("all", "all"), ("all",), ("all",))),
    "error_growth": Recipe(_PLACE, (fixed.error_growth, fixed.error_growth_articulated), lambda: ((),)),
    "regressor": Recipe(_CHANGE, (fixed.regressor,), lambda: (("all", "parameters"),)),
    "forward_kinematics": Recipe(
        _PLACE,
        (fixed.forward_kinematics, fixed.forward_kinematics_in_link_frames, fixed.forward_kinematics_from_base),
        lambda *frames: ((len(frames), 8),),
        each=True,
    ),
    "jacobian": Recipe(_PLACE, (fixed.jacobian,), lambda frame, expressed: ((6, "all"),)),
    "kinetic_energy": Recipe((*_PLACE, *_TWIST), (fixed.kinetic_energy,), lambda: ((),)),
    "potential_energy": Recipe(_PLACE, (fixed.potential_energy,), lambda: ((),)),
    "centre_of_mass": Recipe(_PLACE, (free.centre_of_mass,), lambda: ((3,),)),
    "momentum": Recipe((*_PLACE, *_TWIST), (free.momentum,), lambda: ((3,), (3,))),
    "momentum_rate": Recipe(_CHANGE, (free.momentum_rate,), lambda: ((3,), (3,))),
}
FLOATING = "floating."  # names of functions of robots with a free base begin so
RECIPES |= {FLOATING + name: recipe for name, recipe in _FREE.items()}
DERIVATIVES = {"inverse_dynamics_jacobian": (0, 1)}  # positions of the arguments that a result is differentiated by


class _Call(NamedTuple):
    """Fields of `Function`."""

    constants: Constants
    name: str
    options: tuple[str, ...] = ()


class Function(_Call, Computation):
    """Public function for robots with the same constants, as a computation of `torchdq.backends.call`."""

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of axes, by name; see `Robot.sizes`."""
        fields = self.constants.fields
        n, links, floating = len(fields["joint_names"]), len(fields["link_names"]), fields["base_mass"] is not None
        return {"n": n, "links": links, "all": 6 + n, "parameters": 10 * (links + floating)}

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument, or of a tensor of the robot."""
        recipe = RECIPES[self.name]
        if name in recipe.single and name in self.options:
            return ()
        known = {argument: axes for argument, axes, _ in recipe.arguments}
        return trailing({**known, **SHAPES}[name], self.sizes)

    def shared(self, name: str) -> bool:
        """True for a tensor of the robot."""
        return name in SHAPES

    def label(self, name: str) -> str:
        """Name of a tensor in error messages."""
        return f"robot.{name}" if name in SHAPES else name

    def subject(self) -> str:
        """Words about the robot after a shape in error messages."""
        return f" for the {self.sizes['n']} joints of robot {self.constants.fields['name']!r}"

    def check(self, tensors: Mapping[str, Any]) -> None:
        """Raise unless all required arguments are present."""
        self.require_base()
        for name, _, optional in RECIPES[self.name].arguments:
            if not optional:
                require_tensor(name, tensors.get(name))
        first = next(iter(tensors.values()))
        if not first.is_meta and self.constants.without_values():
            raise ArgumentError(
                f"robot {self.constants.fields['name']!r} is on the device 'meta', where tensors have no values, and "
                f"the arguments are on {first.device}; load the robot anew"
            )

    def require_base(self) -> None:
        """Raise unless the base of the robot is fixed, or free, as the function has it."""
        fields, plain = self.constants.fields, self.name.removeprefix(FLOATING)
        if (fields["base_mass"] is not None) != (plain != self.name):
            kind, way = ("a fixed", "torchdq") if plain != self.name else ("a free", "torchdq.floating")
            raise ArgumentError(
                f"robot {fields['name']!r} has {kind} base: use {way}.{plain}, or load it with another base="
            )

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Trailing axes of the results."""
        return tuple([trailing(axes, self.sizes) for axes in RECIPES[self.name].results(*self.options)])

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the function, cached."""
        return _program(self, arguments)


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
