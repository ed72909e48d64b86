"""The axes of the study: precisions and integrators, and how a state is carried with them.

The duration of a step is an argument of the programs here, so that one compilation serves all of an integrator's steps;
otherwise they are those of `Scene.step`, in which it is a constant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from accuracy.scenes import PERIODS, Case
from torchdq.algebra.quaternion import Number
from torchdq.backends.c import COMPILED
from torchdq.backends.precision import run
from torchdq.backends.torch import EAGER
from torchdq.dynamics.posed import Row
from torchdq.functions.recipe import alternatives_to_record
from torchdq.program.program import Argument, Program, record
from torchdq.scene import integrators
from torchdq.scene.equations_of_motion import with_growths
from torchdq.scene.integrators import Integrator, System
from torchdq.scene.spec import recorded as recorded_scene

Runner = Callable[[Program, Sequence[Tensor]], Sequence[Tensor]]
compiled, eager = partial(run, backend=COMPILED), partial(run, backend=EAGER)

INTEGRATORS: dict[str, Integrator] = {
    "ExplicitEuler": integrators.ExplicitEuler(),
    "SemiImplicitEuler": integrators.SemiImplicitEuler(),
    "LinearlyImplicit": integrators.LinearlyImplicit(),
    "StoermerVerlet": integrators.StoermerVerlet(),
    "RungeKutta4": integrators.RungeKutta4(),
}
DORMAND_PRINCE = "DormandPrince"

PRECISIONS = {
    "float32": "state and arithmetic in float32",
    "float64": "state and arithmetic in float64",
    "mixed": 'state in float32, arithmetic in float64: Scene(precision="double")',
    "compensated": "float32, the state a sum of two numbers to which increments are added without loss",
    "bfloat16": "arithmetic in float32, the state stored in bfloat16 between steps: a mistake",
}


@dataclass(frozen=True)
class Increments(integrators.RungeKutta4):
    """Increments of RungeKutta4, for a state to which they are added without loss."""

    def step(self, system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
        """Changes over a step h."""
        return self.increments(system, x, v, h)


# --- programs --------------------------------------------------------------------------------------------------------


@lru_cache
def step_program(case: Case, integrator: Integrator) -> Program:
    """Program of a step whose duration is an argument; otherwise as `Scene` has it."""
    return _recorded(
        case, "step", lambda motion, x, v, h: dict(zip(("q", "qd"), integrator.step(motion, x, v, h), strict=True))
    )


def _recorded(case: Case, name: str, of: Callable[..., dict[str, Any]]) -> Program:
    n, spec = case.robot.n, case.scene.spec
    arguments = [Argument(x, n) for x in ("q", "qd", "torque", *case.inputs)] + [Argument("dt", 1, uniform=True)]

    def recorded(linear: bool) -> Program:
        def algorithm(q: Row, qd: Row, torque: Row, *others: Row) -> dict[str, Any]:
            *rows, (h,) = others
            scene = recorded_scene(spec, linear, dict(zip(case.inputs, rows, strict=True)), {}, ())
            return with_growths(scene, torque, lambda motion: of(motion, q, qd, h))

        return record(f"{name}_{case.name}", arguments, algorithm)

    return min(map(recorded, alternatives_to_record(n, (False, True))), key=lambda p: p.count().total)


# --- steps -----------------------------------------------------------------------------------------------------------

State = tuple[Tensor, ...]  # q, qd, and what a compensated one carries beside


def dtype_of(precision: str) -> torch.dtype:
    """Dtype of the state."""
    return torch.float64 if precision == "float64" else torch.float32


def program_of(case: Case, integrator: str, precision: str) -> Program:
    """Program that a precision steps with."""
    return step_program(case, Increments() if precision == "compensated" else INTEGRATORS[integrator])


def stepper(
    program: Program, precision: str, others: Sequence[Tensor], runner: Runner = compiled
) -> Callable[[State, Tensor], State]:
    """Step of a state under a torque; `others` are the further inputs and the duration."""
    if precision == "mixed":
        wide = [x.double() for x in others]

        def mixed(state: State, torque: Tensor) -> State:
            return tuple(x.float() for x in runner(program, [*(y.double() for y in state), torque.double(), *wide]))

        return mixed
    if precision == "compensated":

        def compensated(state: State, torque: Tensor) -> State:
            q, qd, q_rest, qd_rest = state
            dq, dqd = runner(program, [q, qd, torque, *others])
            (q, q_rest), (qd, qd_rest) = two_sum(q, dq + q_rest), two_sum(qd, dqd + qd_rest)
            return q, qd, q_rest, qd_rest

        return compensated
    if precision == "bfloat16":

        def stored(state: State, torque: Tensor) -> State:
            found = runner(program, [*(y.float() for y in state), torque, *others])
            return tuple(x.bfloat16() for x in found)

        return stored
    return lambda state, torque: tuple(runner(program, [*state, torque, *others]))


def two_sum(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """The rounded sum and what rounding took from it (Knuth)."""
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


def initial(case: Case, precision: str, batch: int | None = None) -> tuple[State, list[Tensor], list[Tensor]]:
    """State, torques of the periods, and further inputs, of the samples of a case or as many as a batch has."""
    dtype = dtype_of(precision)
    samples = torch.arange(batch or len(case.q)) % len(case.q)
    q, qd = case.q[samples].to(dtype), case.qd[samples].to(dtype)
    state: State = (q, qd, torch.zeros_like(q), torch.zeros_like(q)) if precision == "compensated" else (q, qd)
    torques = [x[samples].to(dtype) for x in case.torque]
    return state, torques, [x.to(dtype).expand_as(q).contiguous() for x in case.inputs.values()]


def flown(case: Case, integrator: str, precision: str, steps: int, runner: Runner = compiled) -> Tensor:
    """State [batch, 2 n] at the horizon after so many steps, as float64."""
    state, torques, others = initial(case, precision)
    h = torch.tensor([case.horizon / steps], dtype=dtype_of(precision))
    step = stepper(program_of(case, integrator, precision), precision, [*others, h], runner)
    for torque in torques:
        for _ in range(steps // PERIODS):
            state = step(state, torque)
    end = torch.cat([x.double() for x in state[:2]], -1)
    # a compensated state is the sum of both numbers
    return end + torch.cat([x.double() for x in state[2:]], -1) if len(state) > 2 else end


def adaptive(case: Case, precision: str, rtol: float, batch: int | None = None) -> Callable[[], Tensor]:
    """Call for the state at the horizon by DormandPrince."""
    (q, qd), torques, _ = initial(case, precision, batch)
    method = integrators.DormandPrince(rtol, 1e-3 * rtol)
    scene = case.scene.replace(integrator=method, dt=case.horizon / PERIODS)
    inputs = {name: x.to(q.dtype) for name, x in case.inputs.items()}

    def call() -> Tensor:
        state = scene.start(q, qd)
        for torque in torques:
            state = scene.step(state, torque, **inputs)
        return torch.cat(state[:2], -1).double()

    return call
