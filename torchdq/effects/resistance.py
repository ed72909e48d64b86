"""Friction torques on tensors: those that motors add to overcome friction, along a motion or a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.backends.call import Computation, evaluate
from torchdq.backends.choice import BackendName
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import REAL
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Inputs
from torchdq.effects.friction import TEMPERATURE, Friction
from torchdq.effects.joint import load_size, total
from torchdq.errors import ArgumentError
from torchdq.functions.signature import Field
from torchdq.numbers.functions import absolute
from torchdq.program.program import GROWTH, Argument, Program, growths, record, replay, results
from torchdq.robot import Robot
from torchdq.robot.fields import trailing

What = Literal["columns", "rates", "friction"]  # what a program returns


def torques(
    effects: Sequence[Friction], q: Row, qd: Row, load: Row | None, inputs: Inputs, memory: Row = ()
) -> list[Number]:
    """Friction torques of the motors, (D + g |load|) qd + f at every joint, on any kind of number."""
    result = []
    found = [effect.impedances_at_end(q, qd, inputs, memory, 0.0) for effect in effects]
    for i in range(len(qd)):
        joint = [row[i] for row in found]
        D, f, g = total(joint)
        if not (isinstance(g, float) and g == 0.0):
            if load is None:
                names = " and ".join(type(effect).__name__ for effect in effects)
                raise ArgumentError(f"load must be given for {names}, whose friction depends on it")
            D = D + g * absolute(load[i])
        result.append(D * qd[i] + f)
    return result


def loads(effects: Sequence[Friction], q: Row, qd: Row, tau: Row) -> list[Number]:
    """Loads: motor torques tau minus friction, on any kind of number."""
    result = []
    found = [effect.impedances(q, qd, {}) for effect in effects]
    for i, (v, t) in enumerate(zip(qd, tau, strict=True)):
        D, f, g = total([row[i] for row in found])
        free = t - (D * v + f)
        result.append(free - g * load_size(free, g, v) * v)
    return result


OFFSET = Field("offset", ("n",), kind="parameter", check=REAL)  # constant torques of the motors


@dataclass(frozen=True)
class Templates:
    """Effects of n joints without tensors; an object that graphs of torch.compile can hold, but not construct."""

    effects: tuple[Friction, ...]
    n: int

    def bound(self, rows: Mapping[str, Row]) -> list[Friction]:
        """Effects with rows of numbers instead of their tensors, those of effect k named "k.parameter"."""

        def own(k: int) -> dict[str, Row]:
            return {name.partition(".")[2]: row for name, row in rows.items() if name.startswith(f"{k}.")}

        return [effect.bound(own(k)) for k, effect in enumerate(self.effects)]

    def fields(self) -> list[Field]:
        """Parameters of the effects, and the offset of the motors."""
        own = [(k, field) for k, effect in enumerate(self.effects) for field in effect.PARAMETERS.values()]
        return [*[field._replace(name=f"{k}.{field.name}") for k, field in own], OFFSET]

    def program(self, rigid: Any, arguments: tuple[Argument, ...]) -> Program:
        """Program of a function of rigid bodies with friction and offset, recorded once."""
        return _with_motors(self, rigid, arguments)


class Parts(NamedTuple):
    """Effects without their tensors, and the tensors by position and name."""

    templates: Templates
    tensors: Mapping[str, Tensor]


def parts(effects: Sequence[Friction], n: int) -> Parts:
    """Parts of resolved effects of n joints."""
    tensors = {f"{k}.{name}": x for k, effect in enumerate(effects) for name, x in effect.tensors().items()}
    return Parts(Templates(tuple([effect.template() for effect in effects]), n), tensors)


def friction(of: Parts, q: Tensor, qd: Tensor, load: Tensor, backend: BackendName | None = None) -> Tensor:
    """Friction torque [..., n] of effects without memory and temperature dependence.

    Args:
        of: the effects.
        q, qd: positions and velocities [rad or m, rad/s or m/s], shape [..., n].
        load: torques of the rigid bodies and rotors [N m or N], shape [..., n].
        backend: as in `torchdq.backend`.
    """
    return _evaluated("friction", of, {"q": q, "qd": qd, "load": load}, backend)["tau"]


def columns(
    robot: Robot,
    effect: Friction,
    q: Tensor,
    qd: Tensor,
    load: Tensor | None = None,
    temperature: Tensor | None = None,
    time: Tensor | None = None,
    backend: BackendName | None = None,
) -> dict[str, Tensor]:
    """Friction torque [..., n] per unit of each parameter in `effect.LINEAR`, by name: columns of a regressor.

    The torque of the effect is the sum of the columns times their parameters. The effect's own values of these
    parameters are ignored, and may be None.

    Args:
        robot: the robot, for its joints.
        effect: the friction.
        q, qd: positions and velocities [rad or m, rad/s or m/s], shape [..., n].
        load: torques of the rigid bodies and rotors in that motion, `torchdq.inverse_dynamics` [N m or N], shape
            [..., n]; None: for an effect that does not depend on it.
        temperature: as in `torchdq.effects.friction.Friction`, shape [..., n].
        time: for friction with memory, increasing times of q [rows, n], one motion from its start [s], shape [rows];
            None: for friction without memory.
        backend: as in `torchdq.backend`.

    >>> import torch, torchdq
    >>> from torchdq import effects
    >>> robot, qd = torchdq.robots.load("two_link"), torch.tensor([[-2.0, 0.0]])
    >>> columns(robot, effects.Quadratic(), torch.zeros(1, 2), qd)
    {'coefficient': tensor([[-4.,  0.]])}
    """
    zeros: dict[str, Any] = dict.fromkeys(effect.LINEAR, 0.0)
    known = replace(effect, **zeros).resolved(robot)
    units = parts([replace(known, **{name: (1.0,) * robot.n}) for name in effect.LINEAR], robot.n)
    given = {"q": q, "qd": qd, "load": load, TEMPERATURE: temperature if known.inputs(robot.n) else None}
    if known.memory(robot.n):
        if time is None:
            raise ArgumentError(f"time must be given for {type(effect).__name__}, which has memory")
        given["memory"] = _followed(known, q, time, backend)
    rows = _evaluated("columns", units, given, backend)
    return dict(zip(effect.LINEAR, rows.values(), strict=True))


def _followed(effect: Friction, q: Tensor, time: Tensor, backend: BackendName | None) -> Tensor:
    """Memory [rows, m] of friction along one motion q [rows, n]; its rates are linear in it."""
    if q.ndim != 2 or time.shape != q.shape[:1]:
        raise ArgumentError(
            f"q must be [rows, n] and time [rows] for {type(effect).__name__}, one motion, found {tuple(q.shape)} and "
            f"{tuple(time.shape)}"
        )
    h = time.to(q).diff().unsqueeze(-1)
    if not bool((h > 0).all()):
        raise ArgumentError("time must increase from row to row of one motion")
    qd = q.diff(dim=0) / h
    given, of = {"q": q[:-1], "qd": qd, "h": h}, parts([effect], q.shape[-1])
    still = q.new_zeros(len(h), effect.memory(q.shape[-1]))
    bent, slope = (_evaluated("rates", of, {**given, "memory": z}, backend)["0"] for z in (still, still + 1.0))
    memory = [still.new_zeros(still.shape[-1])]
    for kept, added in zip((1.0 + h * (slope - bent)).unbind(), (h * bent).unbind(), strict=True):
        memory.append(kept * memory[-1] + added)
    return torch.stack(memory)


# --- programs --------------------------------------------------------------------------------------------------------


def _evaluated(
    what: What, of: Parts, given: Mapping[str, Tensor | None], backend: BackendName | None
) -> dict[str, Tensor]:
    """Results of a program by name; those that are of one effect each have its position for a name."""
    return evaluate(_Along(what, of.templates), {**given, **of.tensors}, backend)


class _AlongFields(NamedTuple):
    """Fields of `_Along`."""

    what: What
    of: Templates


class _Along(_AlongFields, Computation):
    """Torques of effects along a motion, or the rates of their memory, as a computation of `torchdq.backends.call`."""

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an input or a parameter."""
        owner, dot, parameter = name.partition(".")
        if dot:
            return trailing(self.of.effects[int(owner)].SHAPES[parameter], {"n": self.of.n})
        return {"h": (1,), "memory": (self.of.effects[0].memory(self.of.n),)}.get(name, (self.of.n,))

    def shared(self, name: str) -> bool:
        """True for a parameter."""
        return "." in name

    def label(self, name: str) -> str:
        """Name without its owner."""
        return name.rpartition(".")[2]

    def check(self, tensors: Mapping[str, Any]) -> None:
        """Raise unless the inputs of the effects are there."""
        for effect in self.of.effects:
            for name in effect.needs(self.of.n) if self.what == "columns" else ():
                if name not in tensors:
                    raise ArgumentError(f"{name} must be given, shape [..., {self.of.n}], for {type(effect).__name__}")

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program, recorded once."""
        return _program(self, arguments)


@remembered(PROGRAMS)
def _with_motors(of: Templates, rigid: Any, arguments: tuple[Argument, ...]) -> Program:
    bodies = rigid.program(tuple([a for a in arguments if "." not in a.name and a.name != "offset"]))
    if len(bodies.arguments) == len(arguments) and not of.effects:
        return bodies

    def algorithm(*rows: Row) -> Mapping[str, Row]:
        named = {a.name: row for a, row in zip(arguments, rows, strict=True)}
        return with_motors(bodies, named, of.bound(named))

    return record(bodies.name, arguments, algorithm)


def with_motors(rigid: Program, given: Mapping[str, Row], effects: Sequence[Friction]) -> Mapping[str, Row]:
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


@remembered(PROGRAMS)
def _program(what: _Along, arguments: tuple[Argument, ...]) -> Program:
    def algorithm(*rows: Row) -> dict[str, Row]:
        given = {a.name: row for a, row in zip(arguments, rows, strict=True)}
        q, qd, load, memory = given["q"], given["qd"], given.get("load"), given.get("memory", ())
        effects = what.of.bound(given)
        match what.what:
            case "columns":
                return {str(k): torques([effect], q, qd, load, given, memory) for k, effect in enumerate(effects)}
            case "rates":
                h = given["h"][0]
                return {str(k): effect.memory_rates(q, qd, given, memory, qd, h) for k, effect in enumerate(effects)}
        return {"tau": torques(effects, q, qd, load, {})}

    return record(f"friction_{what.what}", arguments, algorithm)
