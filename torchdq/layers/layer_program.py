"""Program of a layer to export: a function of rigid bodies, with friction and offset of the motors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import names_of, require_choice
from torchdq.effects.friction import Friction
from torchdq.effects.resistance import with_motors
from torchdq.effects.steady import lines
from torchdq.errors import ArgumentError
from torchdq.export.meaning import constants as constants_of
from torchdq.export.meaning import heading, part
from torchdq.functions.catalogue import Function
from torchdq.functions.parametric import TENSOR
from torchdq.layers.layer_friction import LayerFriction
from torchdq.program.program import Argument, Program, record
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.robot import arguments, constants

Parameters = Literal["constants", "arguments"]
WRENCHES = ("f_tip", "f_ext", "f_base")


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
    about = [*heading(f"{what.name}{motors}", robot.name, robot.joint_names)]
    if law := what.law:  # its options, since its gains have lines of their own
        options = part(replace(law, **dict.fromkeys(name for name in own if name in law.PARAMETERS)))
        about += [] if options.endswith("()") else [options]
    about += constants_of(written)
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
