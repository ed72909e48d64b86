"""Base of control laws: what a law declares, and the function, the program and the reference that follow from it.

A law is a frozen dataclass: its parameters and their axes, the rows of its goal, and its torques as a formula on
numbers. A call evaluates it on tensors, `program` records it, a scene takes it as its controller, and
`torchdq.nn.Control` makes it a layer.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import zip_longest
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchdq.backends.call import Tensors, evaluate
from torchdq.backends.choice import BackendName
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import require_tensor, tensor_in
from torchdq.dynamics.posed import Posed, Row
from torchdq.errors import ArgumentError
from torchdq.export.meaning import heading, part, rigid
from torchdq.functions.call import gain, with_tensors
from torchdq.functions.catalogue import Function
from torchdq.functions.parametric import TENSOR, Parametric, Shapes, undefined
from torchdq.functions.posed import posed
from torchdq.functions.recipe import Recipe, RecipeInputs, Results
from torchdq.functions.signature import Field, joints
from torchdq.program.program import Argument, Program
from torchdq.program.transforms import constant_in_graphs, with_values
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.constants import Constants
from torchdq.robot.fields import SHAPES, Axes, trailing
from torchdq.robot.robot import arguments, constants, recorded


@dataclass(frozen=True)
class Law(Parametric):
    """Control law: joint torques of a goal, from measured positions and velocities.

    A law of one's own derives from it: a frozen dataclass of parameters (`torchdq.functions.signature.parameter`), with
    the rows of its goal in GOAL, and `torques`.

    Args:
        model: the controller's model of the robot, whose numbers are copied; None: the robot that is controlled.
    """

    NAME: ClassVar[str] = ""  # of its function and its programs; "": that of the class
    GOAL: ClassVar[Shapes] = {"q_des": ("n",), "qd_des": ("n",), "qdd_des": ("n",)}  # one after the other: a reference
    OPTIONAL: ClassVar[frozenset[str]] = frozenset()  # rows of the goal that are zero if they are not given
    WRENCHES: ClassVar[tuple[str, ...]] = ()  # wrenches on the environment that may be given beside the goal
    SWITCHES: ClassVar[frozenset[str]] = frozenset()  # parameters that may be True or False
    WHERE: ClassVar[tuple[str, ...]] = ()  # options of its program by their order: a frame and its axes
    FIXED: ClassVar[str] = ""  # reason why a robot with a floating base is refused; "": it is not
    model: Robot | None = field(default=None, kw_only=True)

    def torques(self, at: Posed, goal: Mapping[str, Any], q: Row, qd: Row) -> Results:
        """Row "tau" of torques, and GROWTH where the law magnifies rounding errors.

        Args:
            at: the model at q.
            goal: rows of GOAL, and "exerted", the wrenches of links on the environment.
            q, qd: measured positions and velocities.
        """
        raise undefined(self, "torques")

    @classmethod
    def named(cls) -> str:
        """Name of its function and of its programs."""
        return cls.NAME or cls.__name__

    def subject(self) -> str:
        """Text about it before the joints, in error messages."""
        return ""

    @classmethod
    def of_arguments(cls, options: Sequence[str]) -> Self:
        """Law whose gains are arguments of its program; `options` are those of the frame, in the order of WHERE."""
        if len(options) > len(cls.WHERE):
            expected = f"at most {', '.join(cls.WHERE)}, in this order" if cls.WHERE else "left out: there are none"
            raise ArgumentError(f"options of {cls.named()!r} must be {expected}, found {options!r}")
        gain, where = torch.ones((), dtype=torch.float64), dict[str, Any](zip(cls.WHERE, options, strict=False))
        return cls(gain, gain, **where)  # type: ignore[arg-type,call-arg]

    @classmethod
    def require_gain(cls, name: str, x: Tensor, given: Tensors) -> None:
        """Raise unless the shape of a parameter is meaningful beside state and goal."""

    def arguments(self, axes: Shapes) -> tuple[str, ...]:
        """Parameters that may be tensors; of `SWITCHES` those that are neither True nor False."""
        switched = [name for name in self.SWITCHES if isinstance(getattr(self, name), bool)]
        return tuple([name for name in axes if name not in switched])

    def described(self, robot: Robot) -> Self:
        """Copy for a robot, with a constant copy of its model; raises where its base floats and must not."""
        if robot.closures and self.FIXED:
            raise ArgumentError(
                f"robot {robot.name!r} has closures, which {self.named()} does not take: its torques would need their "
                "forces; use PD, effects.Servo, or torques of torchdq.constrained_inverse_dynamics"
            )
        if robot.floating and self.FIXED:
            raise ArgumentError(
                f"robot {robot.name!r} has a floating base, which {self.named()} does not take: {self.FIXED}; load it "
                "with base='fixed' for the joints alone"
            )
        return self if self.model is None else replace(self, model=_copied(self, self.model, robot))

    def believed(self, at: Posed, q: Row) -> Posed:
        """The controller's model at q; `at` is the robot that is controlled."""
        return at if self.model is None else posed(self.model, q, {}, ())

    # --- the reference of a scene ---

    def reference(self, n: int) -> int:
        """Width of the reference for n joints, the rows of the goal one after the other."""
        return sum(_widths(self.GOAL, n).values())

    def holding(self, robot: Robot, q: Tensor) -> Tensor:
        """Reference that asks a robot to stand still at positions q [..., n]: "q_des" is q, other rows are zero."""
        rows = _widths(self.GOAL, robot.n).items()
        return torch.cat([q if name == "q_des" else q.new_zeros(*q.shape[:-1], width) for name, width in rows], -1)

    def following(self, at: Posed, reference: Row, q: Row, qd: Row) -> Sequence[Any]:
        """Torques of a reference; `at` is the robot that is controlled, at q."""
        goal, start = {}, 0
        for name, width in _widths(self.GOAL, len(q)).items():
            goal[name], start = reference[start : start + width], start + width
        return self.torques(self.believed(at, q), goal, q, qd)["tau"]

    # --- its function ---

    @property
    def recipe(self) -> Recipe:
        """Recipe of its function of state, goal, parameters that are tensors, and wrenches."""
        goal = [Field(name, axes, name in self.OPTIONAL) for name, axes in self.GOAL.items()]
        held = [(name, axes) for name, axes in self.SHAPES.items() if getattr(self, name) is TENSOR]
        own = [self.PARAMETERS[name]._replace(axes=axes, optional=False) for name, axes in held]
        wrenches = [Field(name, (6,), optional=True) for name in self.WRENCHES]
        return Recipe((*joints("q", "qd"), *goal, *own, *wrenches), (self._formula(),), lambda *single: (("n",),))

    def _formula(self) -> Any:
        """Formula of the recipe; parameters in `single` are one number for all of their axes."""

        def formula(x: RecipeInputs, *single: str) -> Results:
            given, at = x.arguments, x.posed()
            own = {}
            for name, axes in self.SHAPES.items():
                if getattr(self, name) is TENSOR:
                    own[name] = tuple(given[name]) * (_size(axes, x.robot) if name in single else 1)
            law, goal = self.bound(own), dict[str, Any]()
            for name, axes in self.GOAL.items():
                goal[name] = given.get(name) or (0.0,) * _size(axes, x.robot)
            if self.WRENCHES:
                goal["exerted"] = x.exerted(at)
            return law.torques(law.believed(at, given["q"]), goal, given["q"], given["qd"])

        formula.__name__ = self.named()
        return formula

    def __call__(
        self, robot: Robot, q: Tensor, qd: Tensor, *goal: Tensor | None, backend: BackendName | None = None
    ) -> Tensor:
        """Torques [..., n], as one program whose parameters are arguments, so that others need no new one.

        Args:
            robot: the robot that is controlled.
            q, qd: measured positions [rad or m] and velocities [rad/s or m/s], shape [..., n].
            goal: rows of GOAL, and then the wrenches, in their order; None: absent.
            backend: as in `torchdq.backend`.
        """
        require_tensor("q", q)
        given, single = {"q": q, "qd": qd, **self.rows(goal)}, []
        held = [name for name in self.PARAMETERS if not ((x := getattr(self, name)) is None or isinstance(x, bool))]
        form = self.form(held)
        for name, axes in _arguments(*form):
            x = gain(name, getattr(self, name), q, self.PARAMETERS[name].check)
            self.require_gain(name, x, given)
            if axes and not x.ndim:
                single.append(name)
            given[name] = x
        what = Function(constants(require_robot(robot)), self.named(), tuple(single), form)
        return evaluate(what, with_tensors(robot, given), backend)["tau"]

    def rows(self, goal: Sequence[Tensor | None]) -> dict[str, Tensor | None]:
        """Rows of the goal and wrenches by name, None where they are left out at the end; raises if there are more."""
        known = (*self.GOAL, *self.WRENCHES)
        if len(goal) > len(known):
            raise ArgumentError(
                f"goal of {self.named()} must be at most {', '.join(known)}, in this order, found {len(goal)}"
            )
        return dict(zip_longest(known, map(tensor_in, goal)))

    def form(self, tensors: Collection[str]) -> tuple[Any, ...]:
        """Class and fields of the law, an ellipsis for some parameters, as plain values that graphs may keep."""
        return (type(self), *[... if name in tensors else x for name, x in vars(self).items()])

    @staticmethod
    @remembered(PROGRAMS)
    def found(of: Constants, *form: Any) -> Law:
        """Law of a form whose ellipses are tensors, for robots with these constants."""
        with with_values():
            law = _of_form(*form)
            law.require_options()
            return law.described(recorded(of))

    def program(self, robot: Robot, present: Sequence[str] | None = None) -> Program:
        """Program of the law, which takes q, qd, its goal and the parameters that are tensors, for `torchdq.compile`.

        Numbers, those of the robot included, are constants.

        Args:
            robot: the robot that is controlled.
            present: names of the arguments that it takes; None: all but the wrenches.

        >>> import torchdq
        >>> from torchdq.scene import controllers
        >>> program = controllers.PD(kp=30.0, kd=9.0).program(torchdq.robots.load("two_link"))
        >>> torchdq.compile(program).count().multiplications
        4
        """
        whole = self.resolved(require_robot(robot))
        tensors, kind = whole.tensors(), self.named()
        what = Function(constants(robot.bake()), kind, (), whole.form(tensors))
        taken = []
        for name, axes, *_ in what.recipe.present(kind, present):
            uniform = name in tensors and tensors[name].ndim == len(axes)
            taken.append(Argument(name, _size(axes, robot), uniform))
        friction = rigid(bool((robot.damping != 0).any() or (robot.friction != 0).any()))
        about = (*heading(kind, robot.name, robot.joint_names), part(whole.template()), friction)
        return replace(what.program(tuple(taken)), about=about)


def _copied(law: Law, model: Robot, robot: Robot) -> Robot:
    """Constant copy of the model of a law; raises unless it is one robot with these joints, without gradients."""
    what = f"model of {type(law).__name__}"
    if robot.floating or model.floating:
        raise ArgumentError(
            f"{what} must be None for a robot with a floating base: what its joints carry depends on the forces on "
            "the base"
        )
    if model.n != robot.n:
        raise ArgumentError(f"{what} must have the {robot.n} joints of robot {robot.name!r}, found {model.n}")
    for name in arguments(model):
        if getattr(model, name).ndim > len(SHAPES[name]):
            raise ArgumentError(f"{what} must be one robot, found batch axes of its {name}; its tensors are constants")
        if getattr(model, name).requires_grad:
            raise ArgumentError(
                f"{what} must have constants, which get no gradient, found a {name} that requires grad; use "
                "model.bake(), or learn with torques from the layer torchdq.nn.Control"
            )
    return recorded(constants(model.bake()))


def _of_form(kind: type[Law], *values: Any) -> Law:
    """Law of a form, with `TENSOR` for its ellipses."""
    pairs = zip(fields(kind), values, strict=False)
    given: dict[str, Any] = {x.name: TENSOR if value is ... else value for x, value in pairs}
    return kind(**given)


@constant_in_graphs
def _arguments(*form: Any) -> tuple[tuple[str, Axes], ...]:
    """Parameters of a form that may be tensors, with their axes."""
    return _found_arguments(*form)


@remembered(PROGRAMS)
def _found_arguments(*form: Any) -> tuple[tuple[str, Axes], ...]:
    law = _of_form(*form)
    axes = law.SHAPES
    return tuple([(name, axes[name]) for name in law.arguments(axes)])


def _size(axes: tuple[int | str, ...], robot: Robot) -> int:
    """Numbers in a row with these axes."""
    size: int = math.prod(trailing(axes, robot.sizes))
    return size


def _widths(goal: Shapes, n: int) -> dict[str, int]:
    """Widths of the rows of a goal, by name."""
    return {name: math.prod(trailing(axes, {"n": n})) for name, axes in goal.items()}
