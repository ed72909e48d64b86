"""Command `scene`: a robot simulated with the effects that are asked for."""

import io
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdq import effects
from torchdq.base import machine
from torchdq.base.checks import names_of, require_number
from torchdq.base.files import write_atomically
from torchdq.command.command import RobotCommand, per_joint
from torchdq.command.outcome import Grid, Outcome
from torchdq.dynamics.friction import COLUMNS, STATED
from torchdq.effects.steady import at_speeds
from torchdq.errors import ArgumentError
from torchdq.robot import Robot
from torchdq.scene import controllers, integrators
from torchdq.scene.defaults import default_effects
from torchdq.scene.integrators import Integrator, Unrecorded
from torchdq.scene.scene import Scene
from torchdq.scene.state import State

KINDS = {name.lower(): getattr(effects, name) for name in effects.__all__ if name not in ("Effect", "Residual")}
STEPPERS = {
    name: kind
    for name, kind in vars(integrators).items()
    if isinstance(kind, type)
    and issubclass(kind, Integrator)
    and kind not in (Integrator, Unrecorded)
    and all(entry.default is not MISSING for entry in fields(kind))
}
DEFAULT = "default"


@dataclass(kw_only=True)
class SceneCommand(RobotCommand):
    """Simulation with the effects that you name: energies, operations and nanoseconds of a step, and a CSV file.

    Effects: default (those of the description), gravity, viscous=0.5, coulomb=2, joint-limits, saturation,
    first-order-lag=0.02, rotor-inertia=0.1, noise=0.001 and all others of torchdq.effects; a number is the first
    parameter.

    Example: torchdq scene panda --effects gravity viscous=2 --seconds 5 --csv fall.csv
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
        robot = self.load_moving().robot
        names_of("integrator", self.integrator, STEPPERS, "integrator")
        controller = None if self.hold is None else controllers.PD(*self.hold)
        chosen = [one for text in self.effects for one in effects_of(text, robot)]
        scene = Scene(robot, chosen, controller, STEPPERS[self.integrator](), self.dt)
        q = per_joint("q", self.q, robot)
        start = scene.start(torch.zeros(robot.n, dtype=torch.float64).clamp(*robot.limits[:2]) if q is None else q)
        steps = max(1, round(self.seconds / self.dt))
        states = self._run(scene, start, steps)
        energies = torch.cat([scene.energy(start)[None], scene.energy(states)])
        price = scene.describe(seconds=self.price)
        if self.csv is not None:
            self._write(self.csv, start, states, energies)
        first, last, total = energies[0], energies[-1], energies.sum(-1)
        failure = ""
        if not bool(total.isfinite().all()):
            at = self.dt * int((~total.isfinite()).nonzero()[0])
            cure = "A smaller --dt, another --integrator, or a start within the limits may help."
            failure = f"The simulation has failed: from {at:g} s on its numbers are not finite. {cure}"
        shown = {"kinetic": energies[:, 0], "potential": energies[:, 1], "sum": total}
        rows = [(name, *(f"{float(x):.6g}" for x in (e[0], e.max(), e[-1]))) for name, e in shown.items()]
        acting = [type(effect).__name__ for effect in scene.effects if not effect.idle()]
        names = ", ".join(acting) or "rigid bodies alone"
        many = f"{steps} step{'s' * (steps != 1)}"
        about = f"{robot.name}, {many} of {self.dt:g} s with {type(scene.integrator).__name__}: {names}"
        text: list[str | Grid] = [about, Grid(("energy [J]", "start", "most", "end"), rows)]
        joints = zip(robot.joint_names, start.q.tolist(), states.q[-1].tolist(), states.qd[-1].tolist(), strict=True)
        positions = [(name, *(f"{x:.6g}" for x in values)) for name, *values in joints]
        text += [Grid(("joint", "start", "end", "speed at the end"), positions)]
        if friction := at_speeds(scene.effects, robot.n):
            text += [f"{STATED}:", Grid(COLUMNS, list(zip(robot.joint_names, *friction, strict=True)))]
        text += ["price of a step:", str(price)]
        text += [Grid((), [("wrote", str(self.csv))])] if self.csv is not None else []
        text += [failure] if failure else []
        data = {
            "robot": robot.name,
            "machine": machine.words(),
            "effects": [repr(effect) for effect in scene.effects],
            "steps": steps,
            "dt": self.dt,
            "start": start.rows(),
            "end": {name: x[-1] for name, x in states.rows().items()},
            "energies": {"unit": "J", "order": ["kinetic", "potential"], "start": first, "end": last},
            "operations": price.total.operations,
            "nanoseconds": price.total.nanoseconds,
            "costs": [cost._asdict() for cost in price.costs],
            "left_out": price.left_out,
            "files": {} if self.csv is None else {"csv": self.csv},
            "failure": failure,
        }
        return Outcome(tuple(text), data, bool(failure))

    def _run(self, scene: Scene, start: State, steps: int) -> State:
        """States after each step."""
        torque, series = per_joint("torque", self.torque, scene.robot), dict[str, Any]()
        if torque is not None:
            series["torque"] = torque.expand(steps, -1)
        if scene.controller is not None:
            series["reference"] = torch.cat([start.q, *[torch.zeros_like(start.q)] * 2]).expand(steps, -1)
        with torch.no_grad():
            return scene.rollout(start, steps=steps, nonfinite="ignore", **series)

    def _write(self, path: Path, start: State, states: State, energies: Tensor) -> None:
        """Write the CSV file; the first row is the start."""
        columns = {"time": self.dt * torch.arange(len(energies), dtype=torch.float64)[:, None]}
        for name, x in states.rows().items():
            if name not in ("memory", "reading"):
                columns[name] = torch.cat([getattr(start, name)[None], x])
        header = ["time"]
        header += [f"{name}{k + 1}" for name, x in list(columns.items())[1:] for k in range(x.shape[1])]
        table = np.concatenate([x.numpy() for x in (*columns.values(), energies)], 1)
        head = ",".join([*header, "kinetic", "potential"])
        text = io.StringIO()
        np.savetxt(text, table, "%.12g", ",", header=head, comments="")
        write_atomically({path: text.getvalue()})


def effects_of(text: str, robot: Robot) -> list[effects.Effect]:
    """Effects that an option names: NAME, or NAME=NUMBER for the first parameter."""
    name, equals, value = text.partition("=")
    if name == DEFAULT and not equals:
        return list(default_effects(robot))
    key = name.lower().replace("_", "").replace("-", "")
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
