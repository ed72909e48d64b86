"""Command `scene`: a robot simulated with the effects that are asked for."""

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from torchdq import dq, effects
from torchdq.base import machine
from torchdq.base.checks import names_of, require_number
from torchdq.base.files import write_atomically
from torchdq.base.timing import digits
from torchdq.command.command import RobotCommand, per_joint
from torchdq.command.outcome import Grid, Outcome
from torchdq.dynamics.friction import COLUMNS, STATED
from torchdq.dynamics.joints import KINDS as JOINTS
from torchdq.effects.steady import at_speeds
from torchdq.errors import ArgumentError
from torchdq.robot import Robot
from torchdq.scene import controllers, integrators
from torchdq.scene.defaults import DAMPING, ROTOR, default_effects
from torchdq.scene.integrators import DormandPrince, Integrator
from torchdq.scene.scene import Scene
from torchdq.scene.state import State

KINDS = {  # JointLimits is joint-limits, and LuGre lugre
    re.sub("(?<=[a-z]{3})(?=[A-Z])", "-", name).lower(): getattr(effects, name)
    for name in effects.__all__
    if name not in ("Effect", "HeightMap", "Residual")
}
STEPPERS = {
    name: kind
    for name, kind in vars(integrators).items()
    if isinstance(kind, type)
    and issubclass(kind, Integrator)
    and kind not in (Integrator, DormandPrince)
    and all(entry.default is not MISSING for entry in fields(kind))
}
DEFAULT = "default"
COARSE = 0.1  # error by the steps from which a motion is called coarse, as a share of it


@dataclass(kw_only=True)
class SceneCommand(RobotCommand):
    """Simulation with the effects that you name: energies, motion, operations and time of a step, and a CSV file.

    Errors are of the end, by the length of the steps; a second run with steps half as long estimates them.

    Effects: default (those of the description, and rotors and damping where it has none), gravity, viscous=0.5,
    coulomb=2, joint-limits, saturation, first-order-lag=0.02, rotor-inertia=0.1, noise=0.001 and all others of
    torchdq.effects; a number is the first parameter.

    Example: torchdq scene panda --effects gravity viscous=2 --csv fall.csv
    """

    effects: tuple[str, ...] = (DEFAULT,)
    """Effects, each NAME or NAME=NUMBER; none: rigid bodies alone."""
    seconds: float = 2.0
    """Duration [s]."""
    dt: float = 0.01
    """Step [s]."""
    integrator: str = "LinearlyImplicit"
    """Integrator of torchdq.scene.integrators."""
    q: tuple[float, ...] = ()
    """Positions at the start [rad or m]; by default zero, or what is nearest within the limits."""
    torque: tuple[float, ...] = ()
    """Constant torques [N m or N]; by default none."""
    hold: tuple[float, float] | None = None
    """Gains kp and kd of a controller that holds the start."""
    csv: Path | None = None
    """File of the motion: time, q1 ..., qd1 ..., energies."""
    price: float = 3.0
    """Time for measuring what every effect costs [s]; 0: operations alone."""

    def outcome(self) -> Outcome:
        """Energies and price; it failed if the motion grows beyond all numbers."""
        require_number("seconds", self.seconds, positive=True)
        require_number("dt", self.dt, positive=True)
        robot = self.load_moving(or_free=True).robot
        names_of("integrator", self.integrator, STEPPERS, "integrator")
        controller = None if self.hold is None else controllers.PD(*self.hold)
        chosen = [one for text in self.effects for one in effects_of(text, robot)]
        scene = Scene(robot, chosen, controller, STEPPERS[self.integrator](), self.dt)
        q = per_joint("q", self.q, robot)
        start = scene.start(torch.zeros(robot.n, dtype=torch.float64).clamp(*robot.limits[:2]) if q is None else q)
        path = _Path.of(scene, start, self._series(scene, start))
        energies = scene.energy(path.states)
        price = scene.describe(seconds=self.price)
        if self.csv is not None:
            self._write(self.csv, path.states, energies)
        failure = ""
        if not bool((finite := energies.isfinite().all(-1)).all()):
            at = self.dt * int((~finite).nonzero()[0])
            cure = "A smaller --dt, another --integrator, or a start within the limits may help."
            failure = f"The simulation has failed: from {at:g} s on its numbers are not finite. {cure}"
        acting = [type(effect).__name__ for effect in scene.effects if not effect.idle()]
        names = ", ".join(acting) or "rigid bodies alone"
        steps = len(energies) - 1
        many = f"{steps} step{'s' * (steps != 1)}"
        about = f"{robot.name}, {many} of {self.dt:g} s with {type(scene.integrator).__name__}: {names}"
        assumed = _assumed(robot) if DEFAULT in self.effects else ""
        coarse = path.coarse()
        text: list[str | Grid] = [about, *path.tables(), *[x for x in (coarse, assumed) if x]]
        if friction := at_speeds(scene.effects, robot.n):
            text += [f"{STATED}:", Grid(COLUMNS, list(zip(robot.joint_names, *friction, strict=True)))]
        text += ["price of a step:", str(price)]
        text += [Grid((), [("wrote", str(self.csv))])] if self.csv is not None else []
        text += [failure] if failure else []
        order = ["kinetic", "potential"]
        data = {
            "robot": robot.name,
            "machine": machine.words(),
            "effects": [repr(effect) for effect in scene.effects],
            "assumed": assumed,
            "steps": steps,
            "dt": self.dt,
            "start": start.rows(),
            "end": path.end.rows(),
            "energies": {"unit": "J", "order": order, "start": energies[0], "end": energies[-1]},
            "errors": {"energy": path.error(path.energy)[-1], "q": path.error(lambda state: state.q)},
            "operations": price.total.operations,
            "nanoseconds": price.total.nanoseconds,
            "costs": [cost._asdict() for cost in price.costs],
            "left_out": price.left_out,
            "files": {} if self.csv is None else {"csv": self.csv},
            "coarse": coarse,
            "failure": failure,
        }
        return Outcome(tuple(text), data, bool(failure))

    def _series(self, scene: Scene, start: State) -> dict[str, Any]:
        steps = max(1, round(self.seconds / self.dt))
        constant = {"torque": per_joint("torque", self.torque, scene.robot)}
        if scene.controller is not None:
            constant["reference"] = torch.cat([start.q, *[torch.zeros_like(start.q)] * 2])
        series: dict[str, Any] = {name: x.expand(steps, -1) for name, x in constant.items() if x is not None}
        if scene.noises:
            series["noise"] = 1 - torch.rand(steps, scene.noises, dtype=start.q.dtype)
        return {"steps": steps, **series}

    def _write(self, path: Path, states: State, energies: Tensor) -> None:
        columns = {"time": self.dt * torch.arange(len(energies), dtype=torch.float64)[:, None]}
        columns |= {name: x for name, x in states.rows().items() if name not in ("memory", "reading")}
        header = ["time"]
        header += [f"{name}{k + 1}" for name, x in list(columns.items())[1:] for k in range(x.shape[1])]
        table = np.concatenate([x.numpy() for x in (*columns.values(), energies)], 1)
        head = ",".join([*header, "kinetic", "potential"])
        text = io.StringIO()
        np.savetxt(text, table, "%.12g", ",", header=head, comments="")
        write_atomically({path: text.getvalue()})


class _Path(NamedTuple):
    """Motion of a scene, and the end of the one with steps half as long."""

    scene: Scene
    states: State  # [steps + 1, ...], the first of them the start
    finer: State

    @classmethod
    def of(cls, scene: Scene, start: State, series: dict[str, Any]) -> Self:
        """Motion from a start."""

        def states(of: Scene) -> State:
            with torch.no_grad():
                found = of.rollout(start, nonfinite="ignore", **series).rows()
            return State(**{name: torch.cat([x[None], found[name]]) for name, x in start.rows().items()})

        return cls(scene, states(scene), states(scene.replace(substeps=2, unroll=False)).last)

    @property
    def end(self) -> State:
        """State at the end."""
        return self.states.last

    def energy(self, state: State) -> Tensor:
        """Kinetic and potential energy, and their sum [..., 3]."""
        found = self.scene.energy(state)
        return torch.cat([found, found.sum(-1, keepdim=True)], -1)

    def error(self, of: Callable[[State], Tensor]) -> Tensor:
        """Errors of what is computed from the end, of which steps half as long take off the share of their order."""
        return (of(self.end) - of(self.finer)).abs() / (1 - 0.5**self.scene.integrator.order)

    def coarse(self) -> str:
        """Sentence where the largest error of a joint is more than a share of its motion; "" where it is not."""
        q, errors, robot = self.states.q, self.error(lambda state: state.q), self.scene.robot
        joint = int(errors.argmax()) if robot.n else 0
        if not robot.n or not float(errors[joint]) > COARSE * (motion := float((q - q[0])[:, joint].abs().max())):
            return ""
        return (
            f"The steps are coarse: the error of {robot.joint_names[joint]} is {float(errors[joint]) / motion:.0%} of "
            "its motion. A smaller --dt or an --integrator of higher order reduces it."
        )

    def tables(self) -> list[Grid]:
        """Energies, motion of a floating base, and joints."""
        e, robot = self.energy(self.states), self.scene.robot
        columns = [e[0], e.amax(0), e[-1], self.error(self.energy)]
        found = [_grid(("energy [J]", "start", "most", "end", "error"), ("kinetic", "potential", "sum"), columns)]
        if robot.floating:
            columns = [_place(self.states)[0], _place(self.end), _speed(self.end), self.error(_place)]
            names = ("x [m]", "y [m]", "height [m]", "turned by [rad]")
            found.append(_grid(("base", "start", "end", "speed at the end [per s]", "error"), names, columns))
        columns = [self.states.q[0], self.end.q, self.end.qd, self.error(lambda state: state.q)]
        turns = [JOINTS[kind].turns for kind in robot.kinds]
        unit = "rad" if all(turns) else "rad or m" if any(turns) else "m"
        head = ("joint", f"start [{unit}]", "end", "speed at the end [per s]", "error")
        return [*found, _grid(head, robot.joint_names, columns)] if robot.n else found


def _grid(header: tuple[str, ...], names: Sequence[str], columns: Sequence[Tensor]) -> Grid:
    """Table of names and numbers, the last column of which are errors."""
    *numbers, errors = [column.tolist() for column in columns]
    cells = [[digits(x, e) for x, e in zip(column, errors, strict=True)] for column in numbers]
    cells.append([f"{x:.2g}" for x in errors])
    return Grid(header, list(zip(names, *cells, strict=True)))


def _place(state: State) -> Tensor:
    """Position of a floating base in the world, and the angle by which it is turned [..., 4]."""
    X = state.rows()["X_WB"]
    angle = dq.Pose(X).log()[..., :3].norm(dim=-1, keepdim=True)
    return torch.cat([dq.translation(X), angle], -1)


def _speed(state: State) -> Tensor:
    """Velocity of a floating base in the world, and its angular speed [..., 4]."""
    rows = state.rows()
    w, v = rows["V_WB_B"].split(3, -1)
    return torch.cat([dq.rotate(dq.rotation(rows["X_WB"]), v), w.norm(dim=-1, keepdim=True)], -1)


def _plain(name: str) -> str:
    """Name of an effect, however it is spelled."""
    return name.lower().replace("_", "").replace("-", "")


def _assumed(robot: Robot) -> str:
    """Sentence on the defaults that stand for what a description lacks; "" where it lacks nothing."""
    rotors = [f"RotorInertia {ROTOR:g} kg m^2 or kg"] if robot.armature is None else []
    damping = [f"Viscous {DAMPING:g} N m s/rad or N s/m"] if bool((robot.damping <= 0).any()) else []
    return f"Assumed where the description has none: {', '.join(rotors + damping)}." if rotors or damping else ""


def effects_of(text: str, robot: Robot) -> list[effects.Effect]:
    """Effects that an option names: NAME, or NAME=NUMBER for the first parameter."""
    name, equals, value = text.partition("=")
    if name == DEFAULT and not equals:
        return list(default_effects(robot))
    key = {_plain(one): one for one in KINDS}.get(_plain(name), name)
    names_of("effects", key, (*KINDS, DEFAULT), "effect")
    given: list[Any] = []
    try:
        given = [float(x) for x in value.split(",")] if equals else []
        return [KINDS[key](*given)]
    except ValueError as error:
        if isinstance(error, ArgumentError):
            raise
        raise ArgumentError(f"effects must be NAME or NAME=NUMBER, as in viscous=0.5, found {text!r}") from error
    except TypeError as error:
        needed = [x for x in fields(KINDS[key]) if x.init and x.default is MISSING and x.default_factory is MISSING]
        expected = f"{key}={','.join(x.name.upper() for x in needed)}" if needed else key
        raise ArgumentError(f"effects must have the numbers of each, here {expected}, found {text!r}") from error
