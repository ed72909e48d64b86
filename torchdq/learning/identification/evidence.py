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
from torchdq.learning.identification.regression import by_chunks, gram, parted, places, rigid, squared
from torchdq.learning.identification.solution import Solution, solve
from torchdq.learning.identification.terms import ROTOR, Term, at_rest, rows_of
from torchdq.robot import Robot

STILL = 0.3  # least variance of a joint's torque in a motion, relative to that in the motion where it is largest
NORMAL = 1.96  # half-width of the interval that holds 95 % of normal numbers, in standard deviations


class Evidence(NamedTuple):
    """Sums of `regression.gram` about the described bodies and coefficients of zero."""

    robot: Robot
    recording: MotionRows
    terms: tuple[Term, ...]
    sign_width: float  # velocity below which dry friction is viscous [rad/s or m/s]
    parts: tuple[Tensor, ...]  # rows that are left out in turn: of blocks, and then of pairs of regions
    margins: tuple[Tensor, ...]  # rows next to each block
    say: Callable[[str], None]  # is called with the progress
    load: Tensor  # [rows, n] torques of the described bodies and rotors
    own: Tensor  # [rows, n, terms] torques per unit of the terms
    left: Tensor  # [parts, n, p + 1, p + 1] of the rows of each part
    folds: Tensor  # [parts + 1, n, p + 1, p + 1] of the rows neither in a part nor next to it; the last of all
    sizes: Tensor  # [parts, n] number of rows times the variance of the torques of their motion
    squares: Tensor  # [n] mean squares of the torques
    unit: Tensor  # [terms, n] torques per unit that set the width of the prior: `Term.size`
    identifiable: Tensor  # [terms, n] bool: whether the rows can separate a term from others
    at: Tensor  # [n, p] places of the parameters of each joint
    kept: Tensor  # [n] bool: joints whose torques changes of the bodies must not explain

    @property
    def samples(self) -> int:
        """Number of rows."""
        return len(self.own)

    @property
    def total(self) -> Tensor:
        """Sums [n, p + 1, p + 1] of all rows."""
        return self.folds[-1]

    def with_loads(self, parameters: Tensor) -> Evidence:
        """Evidence with the loads that the bodies and rotors of a fit make, which found these parameters [k]."""
        pi, own = parted(self.robot, parameters)
        rotors = own[self.terms.index(ROTOR)] if ROTOR in self.terms else self.robot.armature
        some = [k for k, term in enumerate(self.terms) if term.loaded]
        return self._summed(some, rigid(self.robot, self.recording, pi, rotors)) if some else self

    def _summed(self, some: Sequence[int], load: Tensor) -> Evidence:
        """Evidence with the torques per unit of some terms, and their sums, under loads [rows, n]."""
        states = rows_of(self.robot, self.recording, self.sign_width, load)
        new = self._replace(**{x: getattr(self, x).clone() for x in ("own", "left", "folds", "unit", "identifiable")})
        for k in some:
            term, unit = self.terms[k], self.terms[k].unit(states)
            new.own[..., k], new.identifiable[k] = unit, term.identifiable(states)
            rms = unit.expand_as(load).square().mean(0).sqrt().cpu()
            new.unit[k] = term.size(rms, self.squares.sqrt(), new.identifiable[k])
        blocks, rows = len(self.margins), torch.arange(self.samples, device=load.device)
        first, halves = self.parts[:blocks] or (rows,), self.parts[blocks::2]
        columns = torch.cat([new.own, (self.recording.measured - self.load)[..., None]], -1)
        p = self.at.shape[1]
        at = [p - len(self.terms) + k for k in some] if len(some) < len(self.terms) else list(range(p + 1))
        sums = gram(self.robot, self.recording, columns, (*first, *self.margins, *halves), at, self.say)
        left, margins, inside = sums.split([len(first), blocks, len(halves)])
        total = left.sum(0, keepdim=True)
        left = torch.cat([left, torch.stack([inside, total - inside], 1).flatten(0, 1)])[: len(self.parts)]
        folds = torch.cat([total - left, total])
        folds[:blocks] -= margins
        for known, found in ((new.left, left), (new.folds, folds)):
            known[..., at], known[..., at, :] = found, found.mT
        return new.keeping(self.kept)

    def keeping(self, kept: Tensor) -> Evidence:
        """Evidence in which some joints [n] keep the description: changes of bodies only add torques there."""
        folds, bodies = self.folds.clone(), self.at.shape[1] - len(self.terms)
        folds[..., kept, :bodies, bodies:] = 0
        folds[..., kept, bodies:, :bodies] = 0
        return self._replace(folds=folds, kept=kept)

    @property
    def measurements(self) -> Tensor:
        """Sums [n, p + 1, p + 1] of all rows, in which joints that keep the description say nothing of bodies."""
        total, bodies = self.total.clone(), self.at.shape[1] - len(self.terms)
        total[self.kept, :bodies, :bodies] = 0
        return total

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

    def half_widths(self, left_out: Sequence[Tensor], spread: Tensor, noise: Tensor) -> Tensor:
        """Half-widths [n] of intervals that hold 95 % of measured torques, in units of the errors that are predicted.

        Of those that the residuals of blocks and regions that were `left_out` ask for, the larger ones are taken; where
        there are neither, errors are assumed to be normal. Errors are those of parameters with the covariance `spread`
        [k, t] times its transpose, and of noise [n]. Joints at rest, which friction holds, do not count.
        """
        F, found, parts = spread[self.at], list[Tensor](), [*zip(self.parts, left_out, strict=True)]
        for kind in filter(None, (parts[: len(self.margins)], parts[len(self.margins) :])):
            ratios, few = [], -(-sum(len(rows) for rows, _ in kind) // 4096)
            for rows, residual in ((rows[::few], residual[::few]) for rows, residual in kind):
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
        return self._replace(
            terms=terms,
            own=self.own[..., used.to(self.own.device)],
            left=self.left[..., keep, :][..., keep],
            folds=self.folds[..., keep, :][..., keep],
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
) -> Evidence:
    """Evidence of a recording; loads are those of the description."""
    tau, rows = recording.measured.cpu(), torch.arange(len(recording.q), device=recording.q.device)
    parts = [rows[block.rows] for block in blocks]
    parts += [half for pair in regions(recording) for half in pair] if blocks else []
    whole, *variances = (x.var(0, correction=0) for x in (tau, *(tau[block.motion] for block in blocks)))
    least = STILL * torch.stack(variances or [whole]).amax(0)
    variances = [*(x.maximum(least) for x in variances), *[whole] * (len(parts) - len(blocks))]
    sizes = [len(part) * x.where(x > 0, 1.0)[None] for part, x in zip(parts, variances, strict=True)]
    load = rigid(robot, recording, described(robot), robot.armature)
    at, none = places(len(robot.link_names), len(terms), robot.n), tau.new_zeros(len(terms), robot.n)
    sums = tau.new_zeros(len(parts) + 1, robot.n, at.shape[1] + 1, at.shape[1] + 1)
    return Evidence(
        robot=robot,
        recording=recording,
        terms=tuple(terms),
        sign_width=sign_width,
        parts=tuple(parts),
        margins=tuple(torch.cat([rows[:0], *(rows[margin] for margin in block.margins)]) for block in blocks),
        say=say,
        load=load,
        own=load.new_zeros(*load.shape, len(terms)),
        left=sums[:-1],
        folds=sums,
        sizes=torch.cat([tau[:0], *sizes]),
        squares=tau.square().mean(0),
        unit=none,
        identifiable=none > 0,
        at=at,
        kept=torch.zeros(robot.n, dtype=torch.bool),
    )._summed(range(len(terms)), load)


def described(robot: Robot) -> Tensor:
    """Inertial parameters [10 links] of the described bodies."""
    none = torch.zeros(0, robot.n)
    return Neighbourhood(robot, (), none, none.new_zeros(robot.n), none, math.inf).described


def bodies(robot: Robot, p: int) -> Tensor:
    """Parameters [n, p] of the described bodies, and coefficients of zero."""
    pi = described(robot).expand(robot.n, -1)
    return torch.cat([pi, pi.new_zeros(robot.n, p - pi.shape[1])], 1)
