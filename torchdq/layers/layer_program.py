"""Program of a layer, which it runs and exports: a function of rigid bodies, with friction and offset of the motors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.backends.call import Computation
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import names_of, require_choice
from torchdq.effects.friction import Friction
from torchdq.effects.resistance import Templates, loads, torques
from torchdq.effects.steady import lines
from torchdq.errors import ArgumentError
from torchdq.export.meaning import constants as constants_of
from torchdq.export.meaning import heading, part
from torchdq.functions.catalogue import Function
from torchdq.functions.parametric import TENSOR
from torchdq.layers.layer_friction import LayerFriction
from torchdq.program.program import GROWTH, Argument, Program, growths, record, replay, results
from torchdq.robot import Robot
from torchdq.robot.constants import Constants
from torchdq.robot.fields import SHAPES, trailing
from torchdq.robot.robot import arguments, constants

Parameters = Literal["constants", "arguments"]
WRENCHES = ("f_tip", "f_ext", "f_base")


class _LayerFields(NamedTuple):
    """Fields of `LayerFunction`."""

    constants: Constants
    name: str
    options: tuple[str, ...]
    written: tuple[Any, ...]
    friction: Templates


class LayerFunction(_LayerFields, Computation):
    """Function of rigid bodies with friction and offset, as a computation of `torchdq.backends.call`.

    Tensors of friction are named after the position of their effect, "0.coefficient"; the offset is "offset".
    """

    @property
    def rigid(self) -> Function:
        """Function without friction and offset."""
        return Function(*self[:-1])

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument or a parameter."""
        owner, dot, parameter = name.partition(".")
        if dot:
            return trailing(self.friction.effects[int(owner)].SHAPES[parameter], self.rigid.sizes)
        return (self.rigid.sizes["n"],) if name == "offset" else self.rigid.axes(name)

    def shared(self, name: str) -> bool:
        """True for parameters."""
        law = () if self.rigid.law is None else self.rigid.law.SHAPES
        return "." in name or name == "offset" or name in law or self.rigid.shared(name)

    def label(self, name: str) -> str:
        """Name of a tensor in error messages."""
        return name.partition(".")[2] or self.rigid.label(name)

    def subject(self) -> str:
        """Text about the robot after a shape in error messages."""
        return self.rigid.subject()

    def check(self, tensors: Mapping[str, Tensor]) -> None:
        """Raise unless all required arguments are present."""
        self.rigid.check(tensors)

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Trailing axes of the results."""
        return self.rigid.results(program)

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the layer, recorded once."""
        return _program(self, arguments)


@remembered(PROGRAMS)
def _program(what: LayerFunction, arguments: tuple[Argument, ...]) -> Program:
    rigid = what.rigid.program(tuple([a for a in arguments if "." not in a.name and a.name != "offset"]))
    if len(rigid.arguments) == len(arguments) and not what.friction.effects:
        return rigid

    def algorithm(*rows: Sequence[Number]) -> Mapping[str, Sequence[Number]]:
        named = {a.name: row for a, row in zip(arguments, rows, strict=True)}
        return with_motors(rigid, named, what.friction.bound(named))

    return record(rigid.name, arguments, algorithm)


def with_motors(
    rigid: Program, given: Mapping[str, Sequence[Number]], effects: Sequence[Friction]
) -> Mapping[str, Sequence[Number]]:
    """Results of a program with the torques of the motors, which overcome friction and hold the offset.

    Args:
        rigid: program that takes or returns the torques of the rigid bodies, "tau".
        given: its arguments, and "offset" if there is one.
        effects: the friction, its tensors being numbers.
    """
    named, q = dict(given), given["q"]
    qd, offset = given.get("qd", (0.0,) * len(q)), given.get("offset", (0.0,) * len(q))
    if "tau" in named:
        net = [tau - t for tau, t in zip(named["tau"], offset, strict=True)]
        named["tau"] = loads(effects, q, qd, net)
    values = replay(rigid, [named[a.name] for a in rigid.arguments])
    found = results(rigid, values)
    if "tau" in found:
        friction = torques(effects, q, qd, found["tau"], {})
        found["tau"] = [tau + (t + c) for tau, t, c in zip(found["tau"], friction, offset, strict=True)]
    return {**found, GROWTH: growths(rigid, values)}


def program(
    robot: Robot,
    what: Function,
    wrenches: Sequence[str],
    parameters: Parameters,
    own: Mapping[str, Tensor],
    learned: Sequence[str],
    friction: LayerFriction,
) -> Program:
    """Program of a layer to compile and export, in which quantities have the names of the layer.

    Args:
        robot: the robot with the layer's present parameters.
        what: its function of rigid bodies.
        wrenches: names of those that are arguments.
        parameters: whether what is learned, and what was replaced in the robot, is constant or an argument.
        own: values of the offset, of the parameters of a control law, and of what friction learns, if there are any.
        learned: names of those that the layer learns.
        friction: the layer's.
    """
    require_choice("parameters", parameters, ("constants", "arguments"))
    known = what.recipe.names
    wanted = names_of("wrenches", wrenches, [name for name in known if name in WRENCHES], f"wrench of {what.name}")
    if parameters == "constants":
        robot, learned = robot.bake(), ()
    what = what._replace(constants=constants(robot))
    taken_as_given = [name for name in known if name in wanted or name not in (*own, *WRENCHES)]
    inputs = [Argument(name, math.prod(what.axes(name))) for name in taken_as_given]
    replaced = [
        Argument(name, math.prod(what.axes(name)), getattr(robot, name).ndim == len(SHAPES[name]))
        for name in arguments(robot)
    ]
    present = {name: Argument(name, x.shape[-1] if x.ndim else 1, x.ndim < 2) for name, x in own.items()}
    rigid = what.program((*inputs, *[present[name] for name in known if name in own], *replaced))
    numbers = {name: _numbers(name, x) for name, x in own.items() if name not in learned}
    taken = [*inputs, *replaced, *[present[name] for name in learned]]

    def algorithm(*rows: Sequence[Number]) -> Mapping[str, Sequence[Number]]:
        named = {**numbers, **{a.name: row for a, row in zip(taken, rows, strict=True)}}
        return with_motors(rigid, named, [_of_numbers(effect) for effect in friction.present(named)])

    motors = " with the motors' torques" if friction.effects or "offset" in own else ""
    effects = friction.present({name: numbers.get(name, TENSOR) for name in friction.learned})
    written = {name: x for name, x in numbers.items() if name not in friction.learned}
    if robot.gravity is not None and "gravity" not in arguments(robot):
        written["gravity"] = _numbers("gravity", robot.gravity)
    about = (*heading(f"{what.name}{motors}", robot.name, robot.joint_names), *constants_of(written))
    acting = [one for effect in effects if not (one := _of_numbers(effect)).idle()]
    said = [f"friction: {part(effect)}" for effect in acting] or ["friction: none"]
    return replace(record(rigid.name, taken, algorithm), about=(*about, *said, *lines(acting, robot.n)))


def _of_numbers(effect: Friction) -> Friction:
    """Effect whose tensors are constants of a program."""
    kind = type(effect).__name__
    return effect.bound({name: _numbers(f"{name} of {kind}", x) for name, x in effect.tensors().items()})


def _numbers(name: str, x: Tensor) -> tuple[float, ...]:
    if x.ndim > 1:
        raise ArgumentError(f"{name} has batch axes {tuple(x.shape[:-1])} and cannot be constant; name one row of it")
    return tuple(x.detach().double().reshape(-1).tolist())
