"""Torques of friction effects on tensors: those that motors add to overcome them, along a motion or a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.caches import PROGRAMS, remembered
from torchdq.call import Computation, evaluate
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Inputs
from torchdq.effects.friction import Friction
from torchdq.effects.joint import total
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import absolute
from torchdq.program.program import Argument, Program, record
from torchdq.robot import Robot
from torchdq.robot.fields import trailing


def torques(effect: Friction, q: Row, qd: Row, load: Row | None, inputs: Inputs) -> Row:
    """Torques that overcome the friction of one effect, (D + g |load|) qd + f of every joint, on any kind of number."""
    result = []
    for i, (impedance, v) in enumerate(zip(effect.impedances(q, qd, inputs), qd, strict=True)):
        D, f, g = total([impedance])
        if not (isinstance(g, float) and g == 0.0):
            if load is None:
                raise ArgumentError(f"load must be given for {type(effect).__name__}, whose friction depends on it")
            D = D + g * absolute(load[i])
        result.append(D * v + f)
    return result


def columns(
    robot: Robot,
    effect: Friction,
    q: Tensor,
    qd: Tensor,
    load: Tensor | None = None,
    temperature: Tensor | None = None,
    backend: BackendName | None = None,
) -> dict[str, Tensor]:
    """Torque [..., n] that overcomes friction per unit of each parameter in `effect.LINEAR`, by its name.

    The torque of the effect is their sum, each times its parameter; the values that the effect has for these do not
    matter, and may be None.

    Args:
        robot: the robot, for its joints.
        effect: friction without a memory.
        q, qd: positions and velocities [rad or m, rad/s or m/s], shape [..., n].
        load: torques of the rigid bodies and rotors in that motion, `torchdq.inverse_dynamics` [N m or N], shape
            [..., n]; None: for an effect that does not depend on them.
        temperature: as in `torchdq.effects.friction.Friction`, shape [..., n].
        backend: as in `torchdq.functional`.

    >>> import torch, torchdq
    >>> from torchdq import effects
    >>> robot, qd = torchdq.robots.load("two_link"), torch.tensor([[-2.0, 0.0]])
    >>> columns(robot, effects.Quadratic(), torch.zeros(1, 2), qd)
    {'coefficient': tensor([[-4.,  0.]])}
    """
    zeros: dict[str, Any] = dict.fromkeys(effect.LINEAR, 0.0)
    known = replace(effect, **zeros).resolved(robot)
    units = tuple([replace(known, **{name: (1.0,) * robot.n}) for name in effect.LINEAR])
    given = {"q": q, "qd": qd, "load": load, "temperature": temperature if known.inputs(robot.n) else None}
    rows = evaluate(
        _Torques(tuple([unit.template() for unit in units]), robot.n), {**given, **_tensors(units)}, backend
    )
    return dict(zip(effect.LINEAR, rows.values(), strict=True))


def _tensors(effects: Sequence[Friction]) -> dict[str, Tensor]:
    """Parameters of effects that are tensors, by position and name."""
    return {f"{k}.{name}": x for k, effect in enumerate(effects) for name, x in effect.tensors().items()}


class _TorquesFields(NamedTuple):
    """Fields of `_Torques`."""

    effects: tuple[Friction, ...]
    n: int


class _Torques(_TorquesFields, Computation):
    """Torques [..., n] that overcome each of some effects, as a computation of `torchdq.call`."""

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an input or a parameter."""
        owner, dot, parameter = name.partition(".")
        return trailing(self.effects[int(owner)].SHAPES[parameter], {"n": self.n}) if dot else (self.n,)

    def shared(self, name: str) -> bool:
        """True for a parameter."""
        return "." in name

    def label(self, name: str) -> str:
        """Name without its owner."""
        return name.rpartition(".")[2]

    def check(self, tensors: Any) -> None:
        """Raise unless the inputs of the effects are there."""
        for effect in self.effects:
            for name in effect.needs(self.n):
                if name not in tensors:
                    raise ArgumentError(
                        f"{name} must be given, shape [..., {self.n}]; {type(effect).__name__} needs it"
                    )

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the torques, recorded once."""
        return _program(self, arguments)


@remembered(PROGRAMS)
def _program(what: _Torques, arguments: tuple[Argument, ...]) -> Program:
    def algorithm(*rows: Row) -> dict[str, Row]:
        named = {a.name: row for a, row in zip(arguments, rows, strict=True)}
        result = {}
        for k, effect in enumerate(what.effects):
            own = {name.partition(".")[2]: row for name, row in named.items() if name.startswith(f"{k}.")}
            result[str(k)] = torques(effect.bound(own), named["q"], named["qd"], named.get("load"), named)
        return result

    return record("friction", arguments, algorithm)
