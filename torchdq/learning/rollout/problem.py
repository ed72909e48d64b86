"""Maximum-likelihood problem of a rollout fit: unknowns, measurements, and Gauss-Newton steps."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq.backends.call import evaluate
from torchdq.effects.actuator import Actuator
from torchdq.learning.rollout import shooting
from torchdq.learning.rollout.recordings import CheckedRecording
from torchdq.learning.rollout.shooting import Linear, Motions, Segments
from torchdq.learning.rollout.unknowns import Unknowns
from torchdq.scene.integrators import LinearlyImplicit
from torchdq.scene.recording import Stage
from torchdq.scene.scene import Scene
from torchdq.scene.state import State

Arrays = Mapping[str, np.ndarray]  # by name
PRIOR = 10.0  # standard deviation of a parameter around its start, relative to its size: for what is not identifiable
EXACT = 1e-9  # least deviation of a measurement, relative to its motion
UNEVEN = 1e-3  # motion of a joint that hardly moves, relative to that of the one that moves most
MOST = 16  # linearly implicit steps for derivatives
CORRELATED = 2.0  # rows over which residuals may be correlated
BLOCKS = 40  # least number of means whose variance tells
SINGLE = 100  # single steps, at most about so many, that the search starts with


class Iterate(NamedTuple):
    """Parameters, and motions at them."""

    values: np.ndarray  # [p] numbers of the unknowns
    motions: Motions
    defect: float  # root mean square of the defects between nodes, relative to the motion
    cost: float  # negative logarithm of the likelihood and the prior
    spread: np.ndarray  # [c] root mean square of the residuals


class Change(NamedTuple):
    """Change of an iterate."""

    values: np.ndarray  # [p] in the coordinates of the unknowns
    nodes: np.ndarray  # [K, T, s]
    length: float  # change of all predicted measurements, in their standard deviations


class End(NamedTuple):
    """End of a search."""

    problem: "Problem"  # with the integrator and substeps that were used
    at: Iterate
    linear: Linear
    steps: int
    reason: str  # for which it ended early, or ""
    shift: float = 0.0  # of the parameters by shorter steps, in standard errors


@dataclass(frozen=True)
class Problem:
    """Maximum likelihood of recordings with independent errors, whose deviation is estimated for each signal."""

    scene: Scene  # as it is simulated
    unknowns: Unknowns
    logs: Sequence[CheckedRecording]
    pieces: Segments
    exact: bool = False  # whether derivatives are those of the scene's own step instead of implicit ones

    def by(self, substeps: int) -> "Problem":
        """Problem with another number of substeps of the motions."""
        return replace(self, scene=self.scene.replace(substeps=substeps, unroll=False))

    def shift(self, at: Iterate, linear: Linear, substeps: int) -> float:
        """Change of the parameters by another number of substeps, in standard errors."""
        there = self.by(substeps).at(at.values, at.motions.nodes)
        other = self.linearised(there)
        change = self.step(there, other, 0.0).values - self.step(at, linear, 0.0).values
        found = float(np.linalg.norm(self.information(there, other)[:, :-1] @ change))
        return found / math.sqrt(len(change)) if math.isfinite(found) else math.inf

    # --- iterates ---

    def first(self) -> Iterate:
        """First iterate: nodes at the measurements, and parameters that fit single steps between them."""
        return self.at(self._by_single_steps(self._measured), self._measured)

    def at(self, values: np.ndarray, nodes: np.ndarray) -> Iterate:
        """Iterate at parameters and nodes."""
        moved = shooting.motions(self.pieces, nodes, self._after(values, nodes, self._inputs(values)))
        defect = float(np.linalg.norm(moved.defects / self._sizes)) / math.sqrt(nodes.size)
        spread = np.sqrt(np.square(moved.residual).sum((0, 1)) / self.rows)
        prior = np.square(self.unknowns.each("offset", values) / (PRIOR * self.unknowns.each("sizes", values))).sum()
        cost = self.rows * np.log(self._least(spread)).sum() + 0.5 * prior
        return Iterate(values, moved, defect, float(cost), spread)

    def simulated(self, at: Iterate) -> Iterate:
        """Iterate simulated within each block, with defects between blocks only."""
        nodes, size = at.motions.nodes, self.pieces.block
        blocks = nodes.reshape(-1, size, nodes.shape[-1])
        given = {name: x.reshape(-1, size, x.shape[-1]) for name, x in self._inputs(at.values).items()}
        states = [blocks[:, 0]]
        for t in range(size - 1):
            states.append(self._after(at.values, states[-1], {name: x[:, t] for name, x in given.items()}))
        return self.at(at.values, np.stack(states, 1).reshape(nodes.shape))

    @cached_property
    def rows(self) -> float:
        """Number of measured rows."""
        return float(self.pieces.used.sum())

    @cached_property
    def scale(self) -> np.ndarray:
        """Standard deviations [c] of the measured signals: how large the motion is."""
        found = self.pieces.y[self.pieces.used[..., 0] > 0].std(0, ddof=1)
        return np.maximum(found, UNEVEN * found.max()) if found.max() > 0 else np.ones_like(found)

    def _least(self, spread: np.ndarray) -> np.ndarray:
        return np.sqrt(np.square(spread) + np.square(EXACT * self.scale))

    @cached_property
    def _measured(self) -> np.ndarray:
        """Nodes where the measurements are."""
        found = shooting.first_guess(self.pieces, self.logs)
        q, qd = torch.from_numpy(found).split(self.pieces.n, -1)
        memory = self.scene._begin({"q": q, "qd": qd}, {})[0].memory
        return found if memory is None else np.concatenate([found, memory.numpy()], -1)

    @cached_property
    def _sizes(self) -> np.ndarray:
        """Sizes [s] of the states."""
        size = np.sqrt(np.square(self._measured).mean((0, 1)))
        return np.where(size > 0, size, 1.0)

    def _inputs(self, values: np.ndarray) -> Arrays:
        delay = self.unknowns.delay(values)
        return shooting.commands(self.pieces, self.logs, delay) if delay else self._undelayed

    def _slopes(self, values: np.ndarray) -> Arrays:
        """Derivatives of the commands of all steps by their delay, if it is unknown."""
        unknowns = self.unknowns
        return shooting.commands(self.pieces, self.logs, unknowns.delay(values), slope=True) if unknowns.delayed else {}

    @cached_property
    def _undelayed(self) -> Arrays:
        """Commands of all steps without a delay."""
        return shooting.commands(self.pieces, self.logs, 0.0)

    def _after(self, values: np.ndarray, nodes: np.ndarray, inputs: Arrays) -> np.ndarray:
        """States [..., s] after the steps from nodes [..., s]."""
        scene = copy(self.scene)
        # not `with_parameters`: what no robot has is no error in a trial
        object.__setattr__(scene, "parameters", self.scene.parameters | self.unknowns.parameters(values))
        given = {name: torch.from_numpy(x) for name, x in inputs.items()}
        after = scene._advance(State(**self._rows(nodes)), given)[0].rows()
        return np.concatenate([after[name].numpy() for name in self.scene.spec.state], -1)

    def _rows(self, nodes: np.ndarray) -> dict[str, Tensor]:
        """Tensors of nodes [..., s], by name."""
        state = self.scene.spec.state
        return dict(zip(state, torch.from_numpy(nodes).split([*state.values()], -1), strict=True))

    def correlated(self, at: Iterate) -> str:
        """Warning of residuals that are correlated over more than two rows; "": there are none.

        Means of m independent residuals have the m-th part of their variance; of correlated ones, more.
        """
        kept = self.pieces.used[..., 0] > 0
        rows, joints = at.motions.residual[kept], self.scene.robot.joint_names
        least = np.square(at.spread) + np.square(1e-6 * self.scale)  # no sensor is finer
        times = np.ones_like(least)
        for m in range(2, len(rows) // BLOCKS + 1):
            means = rows[: len(rows) // m * m].reshape(-1, m, least.size).mean(1)
            times = np.maximum(times, m * np.square(means).mean(0) / least)
        signal = int(times.argmax())
        if times[signal] <= CORRELATED:
            return ""
        worst = int(abs(rows[:, signal]).argmax())
        log, time = self.logs[np.repeat(self.pieces.log, kept.sum(1))[worst]], self.pieces.time[kept][worst]
        return (
            f"residuals of joint {joints[signal % len(joints)]!r} are correlated over {times[signal]:.0f} rows, and "
            f"largest at {time:.3g} s of {log.name}: they are errors of the scene, not of sensors, and larger than the "
            "standard errors say; the scene lacks an effect, or sticks where the robot moved (shorter segments or "
            "other starting values may help), or a simulator made the recordings, whose integrator must be given"
        )

    # --- single steps ---

    def _by_single_steps(self, nodes: np.ndarray) -> np.ndarray:
        """Parameters [p] that fit single steps between nodes to the velocities of the nodes.

        That is least squares of accelerations, cheap and in few iterations from far away; its errors are those of
        numerical derivatives. With a memory among the states, which nothing measures, they are those of the scene.
        """
        n, unknowns = self.pieces.n, self.unknowns
        values = trial = unknowns.start
        if nodes.shape[-1] > 2 * n:
            return values
        steps, states = np.flatnonzero(self.pieces.follows), nodes.reshape(-1, 2 * n)
        chosen = steps[:: max(1, len(steps) // SINGLE)]
        before, after = states[chosen], states[chosen + 1, n:]
        least, close = math.inf, False
        for _ in range(20 + 1):
            whole = self._inputs(trial), self._slopes(trial)
            inputs, late = ({name: x.reshape(-1, x.shape[-1])[chosen] for name, x in of.items()} for of in whole)
            gaps = after - self._after(trial, before, inputs)[:, n:]
            norms = np.sqrt(np.square(gaps).sum(0))
            if not np.log(norms).sum() < least:
                break
            values, least = trial, np.log(norms).sum()
            if close:
                break
            B = self._linear_steps(values, before, inputs, late)[1][:, n:]
            sizes, rows = unknowns.each("sizes", values), math.sqrt(len(gaps)) / np.maximum(norms, 1e-300)
            Z = (B * rows[:, None] * sizes).reshape(-1, len(sizes))
            right = Z.T @ (gaps * rows).ravel() - unknowns.each("offset", values) / sizes
            change = sizes * np.linalg.solve(Z.T @ Z + np.eye(len(sizes)), right)
            trial, close = unknowns.each("moved", values, change), bool(abs(change / sizes).max() < 0.1)
        return values

    # --- steps ---

    def noise(self, at: Iterate) -> np.ndarray:
        """Standard deviations [c] of the measurements, by the residuals and their degrees of freedom.

        Nodes that start where the measurements are have none; then the signals count by how large their motion is.
        """
        if not (at.spread > 0).any():
            return self.scale
        spent = (at.motions.nodes[:, 0].size + len(at.values)) / at.spread.size
        return self._least(at.spread) * math.sqrt(self.rows / max(self.rows - spent, 1.0))

    def linearised(self, at: Iterate) -> Linear:
        """Linearised motions at an iterate."""
        A, B = self._linear_steps(at.values, at.motions.nodes, self._inputs(at.values), self._slopes(at.values))
        return shooting.linearised(self.pieces, at.motions, A, B, 1 / self.noise(at))

    @cached_property
    def _differentiated(self) -> list[Scene]:
        """Scenes whose steps are differentiated; implicit steps are about as short as those of the integrator."""
        if self.exact:
            return [self.scene]
        scene = self.scene.replace(integrator=LinearlyImplicit(), substeps=1)
        if scene.controller is not None or scene.spec.of(Actuator):  # which act once per dt
            return [scene, scene.replace(substeps=2)]
        most = min(max(self.scene.substeps, 2), MOST)
        return [scene.replace(dt=scene.dt / times) for times in (most // 2, most)]

    def _linear_steps(
        self, values: np.ndarray, nodes: np.ndarray, inputs: Arrays, late: Arrays
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the steps in the states [..., s, s] and in the unknowns [..., s, p].

        Those of linearly implicit steps, which hold stiff friction, are of first order: twice those of many steps less
        those of half as many are of second order. Their programs are a tenth of that of Runge-Kutta steps.
        """
        (A, B), *many = (self._chained(scene, values, nodes, inputs, late) for scene in self._differentiated)
        return (2 * many[0][0] - A, 2 * many[0][1] - B) if many else (A, B)

    def _chained(
        self, scene: Scene, values: np.ndarray, nodes: np.ndarray, inputs: Arrays, late: Arrays
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the steps, chained from the shorter steps of a scene."""
        unknowns, own = self.unknowns, self.unknowns.parameters(values)
        given = {**scene.parameters, **own, **{name: torch.from_numpy(x) for name, x in inputs.items()}}
        stage = Stage(scene.spec, "step", wrt=(*own, *(inputs if unknowns.delayed else ())))
        A, B = np.eye(nodes.shape[-1]), np.zeros((nodes.shape[-1], len(values)))
        for _ in range(round(self.scene.dt / scene.dt)):
            found = evaluate(stage, {**given, **self._rows(nodes)}, scene.backend)
            by = {name: x.numpy() for name, x in found.items()}
            delay = sum((by[name] @ u[..., None] for name, u in late.items()), np.zeros(1))
            columns = [by[part.key][..., part.at] if part.key else delay for part in unknowns.parts]
            nodes, through = by["after"], by["A"]
            A, B = through @ A, through @ B + np.concatenate(columns, -1) @ unknowns.slopes(values)
        return A, B

    def information(self, at: Iterate, linear: Linear) -> np.ndarray:
        """Triangular factor [p + 1, p + 1] of measurements and prior, in the step and the right-hand side."""
        p, s = len(at.values), at.motions.nodes.shape[-1]
        sizes = PRIOR * self.unknowns.each("sizes", at.values)
        prior = np.column_stack([np.diag(1 / sizes), -self.unknowns.each("offset", at.values) / sizes])
        rows = linear.factor[:, s : s + p + 1, s:].reshape(-1, p + 1)
        return shooting.triangular(np.concatenate([rows, prior]))

    def step(self, at: Iterate, linear: Linear, damping: float) -> Change:
        """Step to the solution of the linearised problem, with damping relative to the information."""
        R, p = self.information(at, linear), len(at.values)
        if damping:
            held = np.diag(math.sqrt(damping) * np.linalg.norm(R[:, :p], axis=0))
            R = shooting.triangular(np.concatenate([R, np.column_stack([held, np.zeros(p)])]))
        values = shooting.solved(R[:p, :p], R[:p, p])
        nodes = shooting.changes(linear, values)
        length = float(np.linalg.norm(shooting.seen(self.pieces, nodes) / self.noise(at)))
        return Change(values, nodes, length)
