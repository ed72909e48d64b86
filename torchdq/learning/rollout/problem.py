"""Problem that a fit of rollouts solves: its unknowns, its measurements, and the steps towards its solution."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from torchdq.backends.call import evaluate
from torchdq.learning.rollout import shooting
from torchdq.learning.rollout.recordings import CheckedRecording
from torchdq.learning.rollout.shooting import Linear, Motions, Segments
from torchdq.learning.rollout.unknowns import Unknowns
from torchdq.scene.recording import Stage
from torchdq.scene.scene import Scene

Arrays = Mapping[str, np.ndarray]  # by name
PRIOR = 10.0  # standard deviation of a parameter around its start, relative to its size: for what is not identifiable
EXACT = 1e-9  # least deviation of a measurement, relative to its motion
UNEVEN = 1e-3  # motion of a joint that hardly moves, relative to that of the one that moves most
FAR = 6.0  # times the usual residuals from which those of a block are far larger
SINGLE = 100  # single steps, at most about so many, that the search starts with
SINGLE_STEPS = 20  # most iterations on them
ALMOST = 0.1  # last step of those, relative to the sizes


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


@dataclass(frozen=True)
class Problem:
    """Greatest likelihood of recordings: independent errors, whose deviation every signal has of its own."""

    scene: Scene
    unknowns: Unknowns
    logs: Sequence[CheckedRecording]
    pieces: Segments

    # --- iterates ---

    def first(self) -> Iterate:
        """Start: the nodes where the measurements are, and the parameters by which single steps fit them."""
        return self.at(self._by_single_steps(self._measured), self._measured)

    def at(self, values: np.ndarray, nodes: np.ndarray) -> Iterate:
        """Iterate at parameters and nodes."""
        moved = shooting.motions(self.pieces, nodes, self._after(values, nodes, self._inputs(values)))
        defect = float(np.linalg.norm(moved.defects / self._sizes)) / math.sqrt(nodes.size)
        spread = np.sqrt(np.square(moved.residual).sum((0, 1)) / self.rows)
        prior = np.square(self.unknowns.offset(values) / (PRIOR * self.unknowns.sizes(values))).sum()
        cost = self.rows * np.log(self._least(spread)).sum() + 0.5 * prior
        return Iterate(values, moved, defect, float(cost), spread)

    def moved(self, at: Iterate, step: Change, share: float) -> Iterate:
        """Iterate after a share of a step."""
        return self.at(self.unknowns.moved(at.values, share * step.values), at.motions.nodes + share * step.nodes)

    def simulated(self, at: Iterate) -> Iterate:
        """Iterate whose nodes follow from each other within a block; there are defects between blocks only."""
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
        q, qd = shooting.first_guess(self.pieces, self.logs)
        given = {"q": torch.from_numpy(q), "qd": torch.from_numpy(qd)}
        memory = self.scene.begin(given, {})[0].memory
        return np.concatenate([q, qd] if memory is None else [q, qd, memory.numpy()], -1)

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
        found = self._evaluated(values, nodes, inputs, None)
        return np.concatenate([found[name] for name in self.scene.spec.state], -1)

    def _evaluated(self, values: np.ndarray, nodes: np.ndarray, inputs: Arrays, wrt: tuple[str, ...] | None) -> Arrays:
        """Rows after the steps from nodes [..., s], or with their derivatives in inputs and parameters."""
        state = self.scene.spec.state
        rows = dict(zip(state, torch.from_numpy(nodes).split([*state.values()], -1), strict=True))
        given = {**rows, **{name: torch.from_numpy(x) for name, x in inputs.items()}}
        tensors = {**given, **self.scene.parameters, **self.unknowns.parameters(values)}
        found = evaluate(Stage(self.scene.spec, "step", wrt=wrt), tensors, self.scene.backend)
        return {name: x.numpy() for name, x in found.items()}

    def uneven(self, at: Iterate) -> str:
        """Warning of the part of a log whose residuals are far larger than most; "": there is none."""
        size, c = self.pieces.block, at.spread.size
        count = self.pieces.used.reshape(-1, size, 1).sum(1)
        squares = np.square(at.motions.residual).reshape(-1, size, c).sum(1) / np.maximum(count, 1.0)
        rms = self._least(np.sqrt(squares))
        usual = np.median(rms[count[:, 0] > 0], 0)
        worst, signal = divmod(int((rms / usual).argmax()), c)
        if rms[worst, signal] <= FAR * usual[signal]:
            return ""
        piece, block = divmod(worst, self.pieces.time.shape[1] // size)
        time, log = self.pieces.time[piece, block * size], self.logs[self.pieces.log[piece]]
        joint = self.scene.robot.joint_names[signal % self.pieces.n]
        return (
            f"at {time:.3g} s of {log.name} the scene is {rms[worst, signal] / usual[signal]:.0f} times farther from "
            f"the measurements of joint {joint!r} than usual: it lacks an effect, or sticks where the robot moved; "
            "shorter segments or other starting values may help"
        )

    # --- single steps ---

    def _by_single_steps(self, nodes: np.ndarray) -> np.ndarray:
        """Parameters [p] by which single steps between nodes have the velocities of the nodes.

        That is least squares of accelerations, cheap and in few iterations from far away; its errors are those of
        numerical derivatives. With a memory among the states, which nothing measures, they are those of the scene.
        """
        n, unknowns = self.pieces.n, self.unknowns
        values = unknowns.start
        if nodes.shape[-1] > 2 * n:
            return values
        steps = np.flatnonzero(self.pieces.follows[:, :-1])
        chosen = steps[:: max(1, len(steps) // SINGLE)]

        def picked(x: np.ndarray) -> np.ndarray:
            """Chosen rows of an array over the steps [K, T - 1, ...]."""
            return x.reshape(-1, x.shape[-1])[chosen]

        before, after = picked(nodes[:, :-1]), picked(nodes[:, 1:, n:])
        undelayed = {name: picked(x[:, :-1]) for name, x in self._undelayed.items()}

        def linear(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Gaps of the velocities, their norms [n], and their slopes in the parameters."""
            inputs, slopes = undelayed, {}
            if unknowns.delayed:
                inputs = {name: picked(x[:, :-1]) for name, x in self._inputs(values).items()}
                slopes = {name: picked(x[:, :-1]) for name, x in self._slopes(values).items()}
            reached, _, B = self._linear_steps(values, before, inputs, slopes)
            defects = after - reached[:, n:]
            return defects, np.sqrt(np.square(defects).sum(0)), B[:, n:]

        defects, norms, B = linear(values)
        for _ in range(SINGLE_STEPS):
            sizes, rows = unknowns.sizes(values), math.sqrt(len(defects)) / np.maximum(norms, 1e-300)
            Z = (B * rows[:, None] * sizes).reshape(-1, len(sizes))
            right = Z.T @ (defects * rows).ravel() - unknowns.offset(values) / sizes
            change = sizes * np.linalg.solve(Z.T @ Z + np.eye(len(sizes)), right)
            trial, least = unknowns.moved(values, change), np.log(norms).sum()
            defects, norms, B = linear(trial)
            if not np.log(norms).sum() < least:
                break
            values = trial
            if abs(change / sizes).max() < ALMOST:
                break
        return values

    # --- steps ---

    def noise(self, at: Iterate) -> np.ndarray:
        """Standard deviations [c] of the measurements, those of the residuals for as many as there are but states.

        Nodes that start where the measurements are have none; then the signals count by how large their motion is.
        """
        if not (at.spread > 0).any():
            return self.scale
        states = at.motions.nodes.shape[-1] * len(at.motions.nodes) / at.spread.size
        spent = states + len(at.values) / at.spread.size
        return self._least(at.spread) * math.sqrt(self.rows / max(self.rows - spent, 1.0))

    def linearised(self, at: Iterate) -> Linear:
        """Linearised motions at an iterate."""
        inputs, slopes = self._inputs(at.values), self._slopes(at.values)
        _, A, B = self._linear_steps(at.values, at.motions.nodes, inputs, slopes)
        return shooting.linearised(self.pieces, at.motions, A, B, 1 / self.noise(at))

    def _linear_steps(
        self, values: np.ndarray, nodes: np.ndarray, inputs: Arrays, slopes: Arrays
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States after the steps, and their derivatives in the states [..., s, s] and in the unknowns [..., s, p]."""
        unknowns = self.unknowns
        wrt = (*unknowns.parameters(values), *(inputs if unknowns.delayed else ()))
        found, columns = self._evaluated(values, nodes, inputs, wrt), []
        for part in unknowns.parts:
            if part.key:
                columns.append(found[part.key][..., part.at])
            else:
                columns.append(sum((found[name] @ u[..., None] for name, u in slopes.items()), np.zeros(1)))
        return found["after"], found["A"], np.concatenate(columns, -1) @ unknowns.slopes(values)

    def information(self, at: Iterate, linear: Linear) -> np.ndarray:
        """Triangular factor [p + 1, p + 1] of the measurements and the prior: a step, and what is left."""
        p, s = len(at.values), at.motions.nodes.shape[-1]
        sizes = PRIOR * self.unknowns.sizes(at.values)
        prior = np.column_stack([np.diag(1 / sizes), -self.unknowns.offset(at.values) / sizes])
        rows = linear.factor[:, s : s + p + 1, s:].reshape(-1, p + 1)
        return shooting.triangular(np.concatenate([rows, prior]))

    def step(self, at: Iterate, linear: Linear, damping: float) -> Change:
        """Change to the solution of the linearised problem; damping shortens it, relative to the information."""
        R, p = self.information(at, linear), len(at.values)
        if damping:
            held = np.diag(math.sqrt(damping) * np.linalg.norm(R[:, :p], axis=0))
            R = shooting.triangular(np.concatenate([R, np.column_stack([held, np.zeros(p)])]))
        values = shooting.solved(R[:p, :p], R[:p, p])
        nodes = shooting.changes(linear, values)
        length = float(np.linalg.norm(shooting.seen(self.pieces, nodes) / self.noise(at)))
        return Change(values, nodes, length)
