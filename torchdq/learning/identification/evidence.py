"""Evidence of a recording about a robot, as sums per block, so that a fit to some blocks need not read the samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.learning.evaluation.blocks import Block, MotionRows, regions
from torchdq.learning.evaluation.statistics import correlation_times, interval_factors
from torchdq.learning.identification.feasible import Neighbourhood
from torchdq.learning.identification.regression import added, by_chunks, gram, parted, places, rigid, squared
from torchdq.learning.identification.solution import Solution, solve
from torchdq.learning.identification.terms import ROTOR, Term, at_rest, rows_of, unit_torques
from torchdq.robot import Robot

STILL = 0.3  # least variance of a joint's torque in a motion, relative to that in the motion where it is largest
NORMAL = 1.96  # half-width of the interval that holds 95 % of normal numbers, in standard deviations


class Unseen(NamedTuple):
    """Rows that were left out together, and what a model that was found without them leaves there."""

    rows: Tensor  # [rows]
    residual: Tensor  # [rows, n] [N m or N]


class Evidence(NamedTuple):
    """Sums of `regression.gram` about the described bodies and coefficients of zero."""

    robot: Robot
    recording: MotionRows
    terms: tuple[Term, ...]
    sign_width: float  # velocity below which dry friction is viscous [rad/s or m/s]
    blocks: Sequence[Block]  # parts that are left out in turn; none: nothing is left out
    say: Callable[[str], None]  # is called with the progress
    own: Tensor  # [rows, n, terms] torques per unit of the terms
    total: Tensor  # [n, p + 1, p + 1] of all rows
    left: Tensor  # [blocks, n, p + 1, p + 1] of the rows of each block, and region
    folds: Tensor  # [blocks, n, p + 1, p + 1] of all rows without those and their neighbours
    counts: Tensor  # [blocks] rows
    sizes: Tensor  # [blocks, n] number of rows times the variance of the torques of their motion
    squares: Tensor  # [n] mean squares of the torques
    unit: Tensor  # [terms, n] torques per unit that set the width of the prior: `Term.size`
    identifiable: Tensor  # [terms, n] bool: whether the rows can separate a term from others
    at: Tensor  # [n, p] places of the parameters of each joint
    kept: Tensor  # [n] bool: joints whose torques changes of the bodies must not explain

    @property
    def samples(self) -> int:
        """Number of rows."""
        return len(self.own)

    def with_loads(self, parameters: Tensor) -> Evidence:
        """Evidence with the loads that the bodies and rotors of a fit make, which found these parameters [k]."""
        pi, own = parted(self.robot, parameters)
        rotors = own[self.terms.index(ROTOR)] if ROTOR in self.terms else self.robot.armature
        again = any(term.loaded for term in self.terms)
        return gather(*self[:6], pi, rotors).keeping(self.kept) if again else self

    def keeping(self, kept: Tensor) -> Evidence:
        """Evidence in which some joints [n] keep the description: changes of bodies only add torques there."""
        total, folds, bodies = self.total.clone(), self.folds.clone(), self.at.shape[1] - len(self.terms)
        for sums in (total, folds):
            sums[..., kept, :bodies, bodies:] = 0
            sums[..., kept, bodies:, :bodies] = 0
        return self._replace(total=total, folds=folds, kept=kept)

    @property
    def measurements(self) -> Tensor:
        """Sums [n, p + 1, p + 1] of all rows, in which joints that keep the description say nothing of bodies."""
        total, bodies = self.total.clone(), self.at.shape[1] - len(self.terms)
        total[self.kept, :bodies, :bodies] = 0
        return total

    def information(self, variance: Tensor) -> Tensor:
        """Information [k, k] of all rows in the parameters, for noise of this variance [n] per independent row."""
        return added(self.measurements / variance[:, None, None], self.at)[:-1, :-1]

    def near(self, estimated: Tensor, strength: float = 1.0) -> Neighbourhood:
        """Neighbourhood of the description, with those coefficients [terms, n] that are estimated."""
        return Neighbourhood(self.robot, self.terms, estimated, self.squares.sqrt(), self.unit, strength)

    def fit(
        self,
        estimated: Tensor,  # [terms, n]
        strength: float,
        correlation: Tensor,  # [n] correlation times of the residuals: so many rows say as much as one
        weight: float = 1.0,  # of the prior
        before: Solution | None = None,  # fit with fewer terms
    ) -> Solution:
        """Solution to all rows, from an earlier one on."""
        near = self.near(estimated, strength)
        sums, independent = self.total / correlation[:, None, None], self.samples / correlation
        start = None if before is None else near.at(before.near, before.y)
        return solve(near, sums, self.squares, independent, self.at, weight, self.say, start)

    def scores(self, changes: Tensor) -> Tensor:
        """Squared residuals over the torques' variance [blocks, n], changes [blocks, n, p] being found without it."""
        return squared(self.left, changes) / self.sizes

    def residual(self, change: Tensor, rows: Tensor | None = None) -> Tensor:
        """Residuals [rows, n] after a change of the parameters [n, p]; of all rows, or those of these numbers."""
        some, own = (self.recording, self.own) if rows is None else (self.recording.some(rows), self.own[rows])
        phi = bodies(self.robot, self.at.shape[1]) + change
        pi, coefficients = phi[0, : -len(self.terms) or None], phi[:, phi.shape[1] - len(self.terms) :].to(own)
        return some.measured - rigid(self.robot, some, pi, self.robot.armature) - (own * coefficients).sum(-1)

    def left_out(self, changes: Tensor) -> tuple[list[Unseen], list[Unseen]]:
        """Residuals of blocks, and of regions, by parameters [n, p] that were found without each."""
        device = self.recording.q.device
        parts = [torch.arange(block.rows.start, block.rows.stop, device=device) for block in self.blocks]
        parts += [half for pair in regions(self.recording) for half in pair]
        found = [Unseen(rows, self.residual(change, rows)) for change, rows in zip(changes, parts, strict=True)]
        return found[: len(self.blocks)], found[len(self.blocks) :]

    def half_widths(self, left_out: Sequence[Sequence[Unseen]], spread: Tensor, noise: Tensor) -> Tensor:
        """Half-widths [n] of intervals that hold 95 % of measured torques, in units of the errors that are predicted.

        Of those that blocks and regions that were left out ask for, the larger ones are taken; where there are neither,
        errors are assumed to be normal. Errors are those of parameters with the covariance `spread` [k, t] times its
        transpose, and of noise with these standard deviations [n]. Joints at rest, which friction holds, do not count.
        """
        F, found = spread[self.at], list[Tensor]()
        for kind in filter(None, left_out):
            ratios, few = [], -(-sum(len(part.rows) for part in kind) // 4096)
            for rows, residual in ((part.rows[::few], part.residual[::few]) for part in kind):
                some, error = self.recording.some(rows), torch.empty_like(residual)
                for chunk, Z in by_chunks(self.robot, some, self.own[rows], F.numel()):
                    error[chunk] = torch.einsum("rjp,jpt->rjt", Z, F.to(Z)).norm(dim=-1)
                held = at_rest(some.qd, self.sign_width) > 0.5
                ratios.append((residual / torch.hypot(error, noise.to(error))).masked_fill(held, torch.nan))
            found.append(interval_factors(ratios).cpu().nan_to_num(NORMAL))
        return torch.stack(found).amax(0) if found else torch.full_like(noise, NORMAL)

    def correlation(self, change: Tensor) -> Tensor:
        """Correlation times [n], in rows, of the residuals after a change of the parameters [n, p]."""
        return correlation_times(self.residual(change), self.recording.lengths)

    def only(self, used: Tensor) -> Evidence:
        """Evidence without terms that are not used [terms]."""
        p = self.at.shape[1]
        keep = torch.ones(p + 1, dtype=torch.bool)
        keep[p - len(used) : p] = used
        terms = tuple(term for term, u in zip(self.terms, used.tolist(), strict=True) if u)
        total, left, folds = (sums[..., keep, :][..., keep] for sums in (self.total, self.left, self.folds))
        return self._replace(
            terms=terms,
            own=self.own[..., used.to(self.own.device)],
            total=total,
            left=left,
            folds=folds,
            unit=self.unit[used],
            identifiable=self.identifiable[used],
            at=places(len(self.robot.link_names), len(terms), self.robot.n),
        )


def gather(
    robot: Robot,  # as described
    recording: MotionRows,
    terms: Sequence[Term],  # all that may be estimated
    sign_width: float,
    blocks: Sequence[Block] = (),
    say: Callable[[str], None] = lambda _: None,
    pi: Tensor | None = None,
    rotors: Tensor | None = None,
) -> Evidence:
    """Evidence of a recording; loads are those of bodies [10 links] and rotors [n], or of the described ones."""
    if pi is None:
        pi, rotors = described(robot), robot.armature
    load = rigid(robot, recording, pi, rotors) if any(term.loaded for term in terms) else None
    states = rows_of(robot, recording, sign_width, load)
    own = unit_torques(terms, states)
    at = places(len(robot.link_names), len(terms), robot.n)
    start = bodies(robot, at.shape[1])
    rows = [block.rows for block in blocks] or [slice(0, len(own))]
    margins = [part for block in blocks for part in block.margins]
    sums = gram(robot, recording, own, start, [*rows, *margins], say)
    left, total, first = sums[: len(rows)], sums[: len(rows)].sum(0), len(rows)
    folds = total - left
    for k, block in enumerate(blocks):
        folds[k] -= sums[first : first + len(block.margins)].sum(0)
        first += len(block.margins)
    tau = recording.measured.cpu()
    motions = [block.motion for block in blocks] or rows
    variance = torch.stack([tau[motion].var(0, correction=0) for motion in motions])
    variance = variance.maximum(STILL * variance.amax(0))
    counts = [part.stop - part.start for part in rows]
    for pair in regions(recording) if blocks else ():
        whole = [slice(0, len(pair[0]))]
        half = gram(robot, recording.some(pair[0]), own[pair[0]], start, whole, say)
        left, folds = torch.cat([left, half, total - half]), torch.cat([folds, total - half, half])
        variance = torch.cat([variance, tau.var(0, correction=0).expand(2, -1)])
        counts += [len(part) for part in pair]
    each = torch.tensor(counts)
    sizes = each[:, None] * torch.where(variance > 0, variance, 1.0)
    squares = tau.square().mean(0)
    rms = own.square().mean(0).sqrt().T.cpu()
    unit, identifiable = torch.zeros_like(rms), torch.zeros_like(rms, dtype=torch.bool)
    for k, term in enumerate(terms):
        identifiable[k] = term.identifiable(states)
        unit[k] = term.size(rms[k], squares.sqrt(), identifiable[k])
    given = robot, recording, tuple(terms), sign_width, blocks, say
    kept = torch.zeros(robot.n, dtype=torch.bool)
    return Evidence(*given, own, total, left, folds, each, sizes, squares, unit, identifiable, at, kept)


def described(robot: Robot) -> Tensor:
    """Inertial parameters [10 links] of the described bodies."""
    none = torch.zeros(0, robot.n)
    return Neighbourhood(robot, (), none, none.new_zeros(robot.n), none, math.inf).described


def bodies(robot: Robot, p: int) -> Tensor:
    """Parameters [n, p] of the described bodies, and coefficients of zero."""
    pi = described(robot).expand(robot.n, -1)
    return torch.cat([pi, pi.new_zeros(robot.n, p - pi.shape[1])], 1)
