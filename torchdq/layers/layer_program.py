"""Programs of layers: functions of rigid bodies, with the friction and the offset of the motors in the same program."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import names_of, require_choice
from torchdq.effects.effect import TENSOR
from torchdq.effects.friction import Friction
from torchdq.effects.resistance import loads, torques
from torchdq.errors import ArgumentError
from torchdq.export.meaning import constants as constants_of
from torchdq.export.meaning import heading, part
from torchdq.functions.catalogue import RECIPES, Function
from torchdq.layers.layer_friction import LayerFriction
from torchdq.program.program import GROWTH, Argument, Program, growths, record, replay, results
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.robot import arguments, constants

Parameters = Literal["constants", "arguments"]
GAINS = ("kp", "kd")  # those of computed torque control
WRENCHES = ("f_tip", "f_ext")


def program(
    robot: Robot,
    function: str,
    wrenches: Sequence[str],
    parameters: Parameters,
    fixed: Mapping[str, Tensor],
    learned: Mapping[str, Tensor],
    friction: LayerFriction,
) -> Program:
    """Program of a layer.

    Args:
        robot: the robot with the layer's present parameters.
        function: "inverse_dynamics", "forward_dynamics" or "computed_torque".
        wrenches: names of those that are arguments.
        parameters: whether what is learned, and what was replaced in the robot, is constant or an argument.
        fixed, learned: values of the offset, of `GAINS`, and of what friction learns, those that there are, [n]; the
            gains also [].
        friction: the layer's.
    """
    require_choice("parameters", parameters, ("constants", "arguments"))
    known = [name for name, _, optional in RECIPES[function].arguments if optional and name in WRENCHES]
    wanted = names_of("wrenches", wrenches, known, f"wrench of {function}")
    beside = {**fixed, **learned}
    if parameters == "constants":
        robot, fixed, learned = robot.bake(), beside, {}
    single = tuple([name for name in GAINS if name in beside and not beside[name].ndim])
    what = Function(constants(robot), function, single)
    inputs = [
        Argument(name, math.prod(what.axes(name)))
        for name, _, _ in RECIPES[function].arguments
        if name in wanted or name not in (*GAINS, *WRENCHES)
    ]
    replaced = [
        Argument(name, math.prod(what.axes(name)), getattr(robot, name).ndim == len(SHAPES[name]))
        for name in arguments(robot)
    ]
    present = {name: Argument(name, x.shape[-1] if x.ndim else 1, x.ndim < 2) for name, x in beside.items()}
    rigid = what.program((*inputs, *[present[name] for name in GAINS if name in beside], *replaced))
    numbers = {name: _numbers(name, x) for name, x in fixed.items()}
    taken = [*inputs, *replaced, *[present[name] for name in learned]]

    def algorithm(*rows: Sequence[Number]) -> Mapping[str, Sequence[Number]]:
        named = {**numbers, **{a.name: row for a, row in zip(taken, rows, strict=True)}}
        q, qd = named["q"], named["qd"]
        effects = [_of_numbers(effect) for effect in friction.present(named)]
        offset = named.get("offset", [0.0] * len(qd))
        if function == "forward_dynamics":
            named["tau"] = [tau - t for tau, t in zip(named["tau"], offset, strict=True)]
            named["tau"] = loads(effects, q, qd, named["tau"])
        values = replay(rigid, [named[a.name] for a in rigid.arguments])
        found = results(rigid, values)
        if function != "forward_dynamics":
            rubbing = torques(effects, q, qd, found["tau"], {})
            found["tau"] = [tau + (t + c) for tau, t, c in zip(found["tau"], rubbing, offset, strict=True)]
        return {**found, GROWTH: growths(rigid, values)}

    about = heading(
        f"{function} with the motors' torques" if friction.effects or "offset" in beside else function,
        robot.name,
        robot.joint_names,
    )
    rubbing = friction.present({name: numbers.get(name, TENSOR) for name in friction.learned})
    own = {name: numbers[name] for name in (*GAINS, "offset") if name in numbers}
    if robot.gravity is not None and "gravity" not in arguments(robot):
        own["gravity"] = _numbers("gravity", robot.gravity)
    told = constants_of(own)
    told += [f"friction: {part(_of_numbers(effect))}" for effect in rubbing] or ["friction: none"]
    return replace(record(rigid.name, taken, algorithm), about=(*about, *told))


def _of_numbers(effect: Friction) -> Friction:
    """Effect whose tensors are constants of a program."""
    found = {f"{name} of {type(effect).__name__}": (name, x) for name, x in effect.tensors().items()}
    rows = {name: _numbers(words, x) for words, (name, x) in found.items()}
    return effect.bound(rows)


def _numbers(name: str, x: Tensor) -> tuple[float, ...]:
    if x.ndim > 1:
        raise ArgumentError(f"{name} has batch axes {tuple(x.shape[:-1])} and cannot be constant; name one row of it")
    return tuple(x.detach().double().reshape(-1).tolist())
