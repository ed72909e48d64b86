"""Receding horizons: plans that move on by a step at every call, and are improved from the state that is measured.

A tick of iterative LQR rolls the plan out from the measured state under its gains, and takes an iteration from there. A
step counts only where it costs less than the gains alone do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from typing import get_args

import torch
from torch import Tensor

from torchdq.base.checks import require_choice, require_count, require_object
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.export.c99 import Library
from torchdq.export.files import Exported, path_of
from torchdq.export.names import distinct, identifier
from torchdq.optimal.exported import NAMES, Horizon
from torchdq.optimal.ilqr import TOLERANCES, Found, Method, begun, by_rows, converged, improved, planned, rows_of, solve
from torchdq.optimal.problem import STOPPED, Passes, Plan, Problem, joined
from torchdq.optimal.sampling import Sampling
from torchdq.scene.state import State, require_state

TICKS = 8  # golden vectors of an export


class Receding:
    """Receding horizon: the plan moves on by a step at every call, and is improved from the state that is measured.

    Called as `mpc(state)` it returns the torques [..., n] for the step that begins now, and their gains [..., n, s] in
    displacements of the state, for what happens until the next call; the gains are None for a sampling method. The
    first call solves the problem. `mpc.plan` is the latest plan, None before it; `mpc.problem` may be assigned, as with
    new goals, and for one that is far away `mpc.plan = None`, so that the next call solves it. A row whose simulation
    is not finite, as of a measurement that is missing, gets torques that are not, and its plan only moves on.

    Args:
        problem: costs and limits.
        iterations: iterations of a call.
        method: as in `solve`.

    >>> import torch, torchdq
    >>> from torchdq import Scene, optimal
    >>> scene = Scene(torchdq.robots.load("two_link"), dt=0.02)
    >>> costs = [
    ...     optimal.Torques(1e-3),
    ...     optimal.Posture(torch.tensor([0.5, -0.3]).double(), 1.0),
    ...     optimal.Speeds(0.1),
    ... ]
    >>> mpc = optimal.Receding(optimal.Problem(scene, 20, costs))
    >>> state = scene.start(torch.zeros(2).double())
    >>> for _ in range(100):
    ...     torque, gain = mpc(state)
    ...     state = scene.step(state, torque)
    >>> (state.q - torch.tensor([0.5, -0.3])).abs().max() < 0.01
    tensor(True)
    """

    def __init__(self, problem: Problem, iterations: int = 1, method: Method = "ilqr"):
        require_count("iterations", iterations)
        self.problem, self.iterations, self.method = problem, iterations, method
        self._plan: Plan | None = None
        self._rows: tuple[Passes, torch.Size, Found] | None = None  # of which the plan is made where it is asked for
        self._ticks = 0

    @property
    def plan(self) -> Plan | None:
        """Latest plan; None before the first call. Assigned, it is that which the next call moves on."""
        if self._plan is None and self._rows is not None:
            passes, batch, found = self._rows
            self._plan = planned(passes, batch, found)
        return self._plan

    @plan.setter
    def plan(self, plan: Plan | None) -> None:
        """Begin with a plan, or with none."""
        if plan is not None:
            require_object("plan", plan, Plan, "torchdq.optimal", "solve(problem, state)")
        self._plan, self._rows = plan, None

    def export(self, folder: str | PathLike[str], name: str = "", library: Library = "math.h") -> Exported:
        """Files in strict C99 that need neither Python nor torch: a function NAME_tick that does what a call does.

        Goals, weights, limits and tensors of the scene are members of a struct, with the plan and all other memory;
        NAME_begin fills it with those of `problem` and `plan`. Steps, iterations and precision are those of the plan. A
        tick that is not finite, as of a measurement that is missing, returns 1, and NaN as torques; its plan only moves
        on. The test among the files compares ticks with those of Python.

        Args:
            folder: path of the folder, which is made if it is not there; files of the same names are replaced.
            name: name of the struct; "": that of the robot, and mpc.
            library: source of sine, cosine and roots, as in `torchdq.compile(...).export`.
        Raises:
            ArgumentError: there is no plan, or one of a batch or a sampling method; a knot of the robot is too large
                for one program; name, folder or library are none that the files can have.

        >>> import tempfile, torch, torchdq
        >>> from torchdq import Scene, optimal
        >>> scene = Scene(torchdq.robots.load("two_link"), dt=0.02)
        >>> costs = [optimal.Torques(1e-3), optimal.Posture(torch.ones(2).double(), 1.0)]
        >>> mpc = optimal.Receding(optimal.Problem(scene, 20, costs))
        >>> torque, gain = mpc(scene.start(torch.zeros(2).double()))
        >>> mpc.export(tempfile.mkdtemp(), "arm_mpc").header.name
        'arm_mpc.h'
        """
        plan = self.plan
        if plan is None:
            raise ArgumentError("plan must be known for an export, found None; call mpc(state) first")
        if plan.gain is None or plan.cost.ndim or not plan.cost.isfinite():
            found = "a batch" if plan.cost.ndim else "one without gains" if plan.gain is None else plan.why()
            raise ArgumentError(f"plan must be that of one robot, with gains and a finite cost, found {found}")
        passes = Passes.of(self.problem, plan.states.q[0], {})
        if not passes.looped:
            raise ArgumentError("scene must be that of a smaller robot, whose knots are one program, to be exported")
        require_choice("library", library, get_args(Library))
        own = identifier(name or distinct([f"{self.problem.scene.robot.name}_mpc"])[0], "name", NAMES)
        return Horizon(passes, plan, self._golden(plan), self.iterations, own, library).write(path_of(folder))

    def _golden(self, plan: Plan) -> list[Tensor]:
        """States, torques and gains of some ticks after a plan, whose torques are not quite those that act."""
        mpc, found, generator = Receding(self.problem, self.iterations), [], torch.Generator().manual_seed(0)
        mpc.plan, state = plan, State(**{name: x[0] for name, x in plan.states.rows().items()})
        for _ in range(TICKS):
            torque, gain = mpc(state)
            found.append((joined(state.rows()), mpc.plan.torque.flatten(), gain.flatten()))  # type: ignore[union-attr]
            share = 0.5 + torch.rand(len(torque), generator=generator).to(torque)
            state = self.problem.scene.step(state, **{plan.control: share * torque})
        return [torch.stack(x) for x in zip(*found, strict=True)]

    @torch.no_grad()
    def __call__(self, state: State) -> tuple[Tensor, Tensor | None]:
        """Torques [..., n] for the step that begins now, and their gains [..., n, s]."""
        if isinstance(self.method, Sampling):
            torque = None if self.plan is None else _moved(self.plan.torque)
            method = replace(self.method, seed=self.method.seed + self._ticks)  # other numbers at every tick
            count, self._ticks = 100 if torque is None else self.iterations, self._ticks + 1
            plan = self.plan = solve(self.problem, state, torque, method=method, iterations=count)
            return torch.where(plan.cost.isfinite()[..., None], plan.torque[0], torch.nan), None
        require_state(state)
        batch = state.q.shape[:-1]
        last: Found | None
        if self._rows is not None and self._rows[0].problem is self.problem and self._rows[1] == batch:
            passes, _, last = self._rows
        else:
            passes, last = Passes.of(self.problem, state.q, {}), None if self.plan is None else rows_of(self.plan)
            expected = (self.problem.steps, *state.q.shape)
            if self.plan is not None and self.plan.torque.shape != expected:
                shape = ", ".join(map(str, expected))
                raise ArgumentError(
                    f"torques of the plan must have the shape [{shape}] for this state, found "
                    f"{tuple(self.plan.torque.shape)}; set plan to None, so that the next call solves the problem"
                )
        found, torque = self._tick(passes, state, last)
        self._plan, self._rows = None, (passes, batch, found)
        return torque.view(state.q.shape), found.gain[0].view(*batch, *found.gain.shape[-2:])

    def _tick(self, passes: Passes, state: State, last: Found | None) -> tuple[Found, Tensor]:
        """Plans from a state on, those of the step before moved on by one, and the torques of now."""
        start = {name: by_rows(x, 0) for name, x in state.rows().items()}
        if last is None:
            found = self._solved(passes, state, start, None)
            return found, torch.where(_known(found)[:, None], found.torque[0], torch.nan)
        states, last = joined(last.states)[1:], last._replace(torque=_moved(last.torque), gain=_moved(last.gain))
        last = last._replace(status=torch.full_like(last.status, STOPPED), damping=torch.zeros_like(last.damping))
        x, u, cost = passes.forward(start, last.torque, (last.gain, states))
        found = last._replace(states=x, torque=u, cost=cost)
        found = improved(passes, start, found, self.iterations, None, lambda _: None)
        if math.isfinite(found.cost.sum() + found.gain.sum()):
            return found, found.torque[0]
        lost, before = ~_known(found), _known(last)
        kept, new = ((lost & x).nonzero()[:, 0] for x in (before, ~before))
        if len(new):
            found.put(new, self._solved(passes, state, start, new))
        torque = torch.where(_known(found)[:, None], found.torque[0], torch.nan)
        last = last._replace(states={name: _moved(x) for name, x in last.states.items()})
        found.put(kept, last.among(kept))  # the next state finds the plan where it would have been
        return found, torque

    def _solved(self, passes: Passes, state: State, start: Mapping[str, Tensor], rows: Tensor | None) -> Found:
        """Plans of rows that have none; None: of all."""
        torque = by_rows(self.problem.holding(state), 1)
        if rows is not None:
            passes, torque = passes.among(rows), torque.index_select(1, rows)
            start = {name: x.index_select(0, rows) for name, x in start.items()}
        with Progress(f"optimal control, {torque.shape[1]} rows") as notice:
            found = begun(passes, *passes.forward(start, torque))
            return converged(passes, start, found, True, 100, TOLERANCES[torque.dtype], notice)


def _known(found: Found) -> Tensor:
    """Whether the plan of a row is finite [rows]."""
    return found.cost.isfinite() & found.gain.isfinite().flatten(2).all(2).all(0)


def _moved(x: Tensor) -> Tensor:
    """Rows of steps, moved on by one, the last twice."""
    return torch.cat([x[1:], x[-1:]])
