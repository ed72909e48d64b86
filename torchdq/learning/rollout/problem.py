"""Problem that a fit of rollouts solves: its unknowns, its measurements, and the steps towards its solution."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchdq.learning.rollout import shooting
from torchdq.learning.rollout.recordings import CheckedRecording
from torchdq.learning.rollout.shooting import Linear, Motions, Segments
from torchdq.learning.rollout.unknowns import Unknowns

if TYPE_CHECKING:
    from torchdq.envs.sensitivity import StepMap

PRIOR = 10.0  # standard deviation of a parameter around its start, relative to its size: for what nothing tells
EXACT = 1e-9  # least deviation of a measurement, relative to its motion
UNEVEN = 1e-3  # motion of a joint that hardly moves, relative to that of the one that moves most
FAR = 6.0  # times the usual residuals from which those of a block are far larger
SINGLE = 100  # single steps, at most about so many, that the search starts with
SINGLE_STEPS = 20  # most iterations on them
ALMOST = 0.1  # last step of those, relative to the sizes


class Iterate(NamedTuple):
    """Parameters, and motions at them."""

    values: Tensor  # [p] numbers of the unknowns
    motions: Motions
    gap: float  # root mean square of the gaps between nodes, relative to the motion
    cost: float  # negative logarithm of the likelihood and the prior
    spread: Tensor  # [c] root mean square of the residuals


class Change(NamedTuple):
    """Change of an iterate."""

    values: Tensor  # [p] in the coordinates of the unknowns
    nodes: Tensor  # [K, T, s]
    length: float  # change of all predicted measurements, in their standard deviations


@dataclass(frozen=True)
class Problem:
    """Greatest likelihood of recordings: independent errors, whose deviation every signal has of its own."""

    step_map: StepMap
    unknowns: Unknowns
    logs: Sequence[CheckedRecording]
    pieces: Segments

    # --- iterates ---

    def first(self) -> Iterate:
        """Start: the parameters of the scene, the nodes where the measurements are."""
        return self.at(self.unknowns.start, self._measured)

    def at(self, values: Tensor, nodes: Tensor) -> Iterate:
        """Iterate at parameters and nodes."""
        moved = shooting.motions(
            self.step_map, self.pieces, nodes, self._inputs(values), self.unknowns.parameters(values)
        )
        gap = float(torch.linalg.vector_norm(moved.gaps / self._motion)) / math.sqrt(nodes.numel())
        spread = torch.linalg.vector_norm(moved.residual, dim=(0, 1)) / math.sqrt(self.rows)
        prior = (self.unknowns.offset(values) / (PRIOR * self.unknowns.sizes(values))).square().sum()
        cost = self.rows * self._least(spread).log().sum() + 0.5 * prior
        return Iterate(values, moved, gap, float(cost), spread)

    def moved(self, at: Iterate, step: Change, share: float) -> Iterate:
        """Iterate after a share of a step."""
        return self.at(self.unknowns.moved(at.values, share * step.values), at.motions.nodes + share * step.nodes)

    def simulated(self, at: Iterate) -> Iterate:
        """Iterate whose nodes follow from each other within a block; there are gaps between blocks only."""
        nodes, size = at.motions.nodes, self.pieces.block
        inputs, parameters = self._inputs(at.values), self.unknowns.parameters(at.values)
        given = {name: x.reshape(-1, size, x.shape[-1]) for name, x in inputs.items()}
        states = [nodes.reshape(-1, size, nodes.shape[-1])[:, 0]]
        for t in range(size - 1):
            states.append(self.step_map.after(states[-1], {name: x[:, t] for name, x in given.items()}, parameters))
        return self.at(at.values, torch.stack(states, 1).reshape(nodes.shape))

    @cached_property
    def rows(self) -> float:
        """Number of measured rows."""
        return float(self.pieces.used.sum())

    @cached_property
    def scale(self) -> Tensor:
        """Standard deviations [c] of the measured signals: how large the motion is."""
        found = self.pieces.y[self.pieces.used[..., 0] > 0].std(0)
        return torch.where(found.amax() > 0, found.clamp_min(UNEVEN * found.amax()), 1.0)

    def _least(self, spread: Tensor) -> Tensor:
        return (spread.square() + (EXACT * self.scale).square()).sqrt()

    @cached_property
    def _measured(self) -> Tensor:
        """Nodes where the measurements are."""
        q, qd = shooting.first_guess(self.pieces, self.logs)
        memory = self.step_map.scene.begin({"q": q, "qd": qd}, {})[0].memory
        return torch.cat([q, qd] if memory is None else [q, qd, memory], -1)

    @cached_property
    def _motion(self) -> Tensor:
        """Sizes [s] of the states."""
        size = self._measured.square().mean((0, 1)).sqrt()
        return torch.where(size > 0, size, 1.0)

    def _inputs(self, values: Tensor) -> dict[str, Tensor]:
        delay = self.unknowns.delay(values)
        return shooting.commands(self.pieces, self.logs, delay) if delay else self._prompt

    def _slopes(self, values: Tensor) -> dict[str, Tensor]:
        """Derivatives of the commands of all steps by their delay, if it is unknown."""
        sought = self.unknowns
        return shooting.commands(self.pieces, self.logs, sought.delay(values), slope=True) if sought.delayed else {}

    @cached_property
    def _prompt(self) -> dict[str, Tensor]:
        """Commands of all steps without a delay."""
        return shooting.commands(self.pieces, self.logs, 0.0)

    def uneven(self, at: Iterate) -> str:
        """Words for the part of a log whose residuals are far larger than most; "": there is none."""
        size, c = self.pieces.block, at.spread.numel()
        count = self.pieces.used.reshape(-1, size, 1).sum(1)
        squares = at.motions.residual.reshape(-1, size, c).square().sum(1) / count.clamp_min(1.0)
        rms = (squares + (EXACT * self.scale).square()).sqrt()
        usual = rms[count[:, 0] > 0].median(0).values
        worst, signal = divmod(int((rms / usual).argmax()), c)
        if rms[worst, signal] <= FAR * usual[signal]:
            return ""
        piece, block = divmod(worst, self.pieces.time.shape[1] // size)
        time, log = self.pieces.time[piece, block * size], self.logs[self.pieces.log[piece]]
        joint = self.step_map.scene.robot.joint_names[signal % self.pieces.n]
        return (
            f"at {time:.3g} s of {log.name} the scene is {rms[worst, signal] / usual[signal]:.0f} times farther from "
            f"the measurements of joint {joint!r} than usual: it lacks an effect, or sticks where the robot moved; "
            "shorter segments or other starting values may help"
        )

    # --- single steps ---

    def prepared(self, at: Iterate) -> Iterate:
        """Iterate with the parameters by which single steps between its nodes have the velocities of the nodes.

        That is least squares of accelerations, cheap and in few iterations from far away; its errors are those of
        numerical derivatives. States with a memory, which nothing measures, are left alone.
        """
        n, nodes, sought = self.pieces.n, at.motions.nodes, self.unknowns
        if nodes.shape[-1] > 2 * n:
            return at
        steps = self.pieces.follows[:, :-1, 0].flatten().nonzero()[:, 0]
        chosen = steps[:: max(1, len(steps) // SINGLE)]
        before, after = nodes[:, :-1].flatten(0, 1)[chosen], nodes[:, 1:, n:].flatten(0, 1)[chosen]

        def picked(commands: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {name: x[:, :-1].flatten(0, 1)[chosen] for name, x in commands.items()}

        prompt = picked(self._prompt)

        def missing(values: Tensor) -> tuple[dict[str, Tensor], Tensor, float]:
            inputs = picked(self._inputs(values)) if sought.delayed else prompt
            gaps = after - self.step_map.after(before, inputs, sought.parameters(values))[:, n:]
            return inputs, gaps, float(torch.linalg.vector_norm(gaps, dim=0).log().sum())

        values = at.values
        inputs, gaps, least = missing(values)
        for _ in range(SINGLE_STEPS):
            B = self._derivatives(values, before, inputs, picked(self._slopes(values)))[1][:, n:]
            weight = 1 / torch.linalg.vector_norm(gaps, dim=0).clamp_min(1e-300)
            sizes, rows = sought.sizes(values), math.sqrt(len(gaps)) * weight
            Z = (B * rows[:, None] * sizes).flatten(0, 1)
            right = Z.T @ (gaps * rows).flatten() - sought.offset(values) / sizes
            change = sizes * torch.linalg.solve(Z.T @ Z + torch.eye(len(sizes), dtype=Z.dtype), right)
            trial = sought.moved(values, change)
            inputs, gaps, cost = missing(trial)
            if not cost < least:
                break
            values, least = trial, cost
            if float((change / sizes).abs().amax()) < ALMOST:
                break
        return self.at(values, nodes)

    # --- steps ---

    def noise(self, at: Iterate) -> Tensor:
        """Standard deviations [c] of the measurements, those of the residuals for as many as there are beside states.

        Nodes that start where the measurements are have none; then the signals count by how large their motion is.
        """
        if not bool((at.spread > 0).any()):
            return self.scale
        states = at.motions.nodes.shape[-1] * len(at.motions.nodes) / at.spread.numel()
        spent = states + len(at.values) / at.spread.numel()
        return self._least(at.spread) * math.sqrt(self.rows / max(self.rows - spent, 1.0))

    def linearised(self, at: Iterate) -> Linear:
        """Linearised motions at an iterate."""
        inputs, slopes = self._inputs(at.values), self._slopes(at.values)
        A, B = self._derivatives(at.values, at.motions.nodes, inputs, slopes)
        return shooting.linearised(self.pieces, at.motions, A, B, 1 / self.noise(at))

    def _derivatives(
        self, values: Tensor, nodes: Tensor, inputs: Mapping[str, Tensor], slopes: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Derivatives of the steps in the states [..., s, s], and in the unknowns [..., s, p]."""
        sought, s = self.unknowns, nodes.shape[-1]
        parameters = sought.parameters(values)
        wrt = (*parameters, *(inputs if sought.delayed else ()))
        A, B = self.step_map.jacobian(nodes, inputs, parameters, wrt).tensor_split((s,), -1)
        if sought.direct:
            return A, B
        widths = [parameters[name].numel() if name in parameters else inputs[name].shape[-1] for name in wrt]
        blocks, columns = dict(zip(wrt, B.split(widths, -1), strict=True)), []
        for part in sought.parts:
            if part.key:
                columns.append(blocks[part.key][..., part.at])
            else:
                columns.append(torch.stack([blocks[name] @ u[..., None] for name, u in slopes.items()]).sum(0))
        return A, torch.cat(columns, -1) @ sought.slopes(values)

    def information(self, at: Iterate, linear: Linear) -> Tensor:
        """Triangular factor [p + 1, p + 1] of the measurements and the prior: a step, and what is left."""
        p, s = len(at.values), at.motions.nodes.shape[-1]
        sizes = PRIOR * self.unknowns.sizes(at.values)
        prior = torch.cat([torch.diag(1 / sizes), (-self.unknowns.offset(at.values) / sizes)[:, None]], 1)
        rows = torch.cat([linear.factor[:, s : s + p + 1, s:].flatten(0, 1), prior])
        return torch.linalg.qr(rows, mode="r").R

    def step(self, at: Iterate, linear: Linear, damping: float) -> Change:
        """Change to the solution of the linearised problem; damping shortens it, relative to the information."""
        R, p = self.information(at, linear), len(at.values)
        if damping:
            held = torch.diag(math.sqrt(damping) * R[:, :p].norm(dim=0))
            R = torch.linalg.qr(torch.cat([R, torch.cat([held, held.new_zeros(p, 1)], 1)]), mode="r").R
        values = torch.linalg.solve_triangular(R[:p, :p], R[:p, p:], upper=True)[:, 0]
        nodes = shooting.changes(linear, values)
        length = float((shooting.seen(self.pieces, nodes) / self.noise(at)).square().sum().sqrt())
        return Change(values, nodes, length)
