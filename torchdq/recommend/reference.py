"""How far trajectories can be held, and references of them that are exact to a small part of an error.

Every trajectory is computed twice, the second time from a start that is shifted by so little that the distance of the
two grows as every small error does; where an arm falls without damping, exponentially. Once it has grown a million
times, a start that is rounded to float32 ends a tenth of a radian away, and no step makes the trajectory meaningful: it
is not held any further, and the reference ends there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.recommend.trials import EXACT, SAFETY, Trial, distance
from torchdq.scene.integrators import DormandPrince, Integrator

MOST_GROWTH = 1e6  # growth of a small error up to which a trajectory is held
SHIFT = 1e-9  # change of the start, above rounding and below curvature [rad or m]
NEAR = 0.1  # change by halved steps below which a path shows how errors grow [rad or m]
EXACTNESS = 20  # ratio of the error to the change by the last halving, which is more than the reference's own error
FIRST, FACTOR = 1e-3, 1.5  # first time to which growth is followed [s], and ratio of the next ones
TOLERANCE = 1e-6  # tolerated error of a step along which it is followed [rad or m]


@dataclass(frozen=True)
class Reference:
    """Positions up to the time until which they can be held."""

    trial: Trial  # until that time
    positions: Tensor  # [intervals, samples, n]
    growth: float  # factor by which a small change of the start grows until then
    limit: str  # why it ends before the horizon; "": it does not
    known: tuple[Integrator, dict[int, float]]  # errors of an integrator, by the number of steps per interval


@dataclass(frozen=True)
class _Refinement:
    """Paths of a trial and of the shifted one, with steps that were halved again and again."""

    trial: Trial
    integrator: Integrator
    paths: tuple[Tensor, ...] = ()  # [intervals, 2 samples, n] each, of 1, 2, 4 ... steps per interval
    before: tuple[Tensor, ...] = ()  # the last but one, with its extrapolations
    row: tuple[Tensor, ...] = ()  # the last one, with its extrapolations

    @property
    def times(self) -> int:
        """Steps per interval of the next path."""
        return 2 ** len(self.paths)

    def refined(self, shift: Tensor) -> _Refinement:
        """Refinement with one path more."""
        row = [self.trial.with_shifted(shift).path(self.integrator, self.times, EXACT)]
        # an error that is a series in the step, from the power of the order on, loses a term with every column
        for j, coarser in enumerate(self.row[:4]):
            row.append(row[j] + (row[j] - coarser) / (2 ** (self.integrator.order + j) - 1))
        return replace(self, paths=(*self.paths, row[0]), before=self.row, row=tuple(row))

    def until(self, intervals: int) -> _Refinement:
        """Refinement of the first intervals alone."""
        trial = replace(self.trial, intervals=intervals)
        paths, before, row = (tuple(x[:intervals] for x in part) for part in (self.paths, self.before, self.row))
        return replace(self, trial=trial, paths=paths, before=before, row=row)

    def changes(self, column: int) -> Tensor:
        """Largest changes by the last halving until the end of every interval."""
        return _largest(self.row[column] - self.before[column])

    def growth(self) -> Tensor:
        """Factors by which the shift has grown until the end of every interval."""
        at, shifted = self.row[-1].chunk(2, 1)
        return _largest(shifted - at) / SHIFT

    def reference(self, column: int, limit: str) -> Reference:
        """Reference of a column of the last row."""
        exact = self.row[column].chunk(2, 1)[0]
        known = {2**k: distance(path.chunk(2, 1)[0], exact) for k, path in enumerate(self.paths)}
        return Reference(self.trial, exact, float(self.growth()[-1]), limit, (self.integrator, known))


def predictable(trial: Trial) -> tuple[Trial, str]:
    """Trial up to the time until which its trajectories can be held, in as many intervals, and the reason.

    The growth of a small change is followed along coarse trajectories: there is one like them that is exact.
    """
    integrator = DormandPrince(TOLERANCE, TOLERANCE)
    pair = trial.with_shifted(_shift(trial))
    state, time, growth = pair.state, 0.0, 1.0
    while time < trial.horizon:
        before, grown_before = time, growth
        time = min(max(FIRST, FACTOR * time), trial.horizon)
        trial.report(f"growth of errors until {time:.2g} s")
        state = pair.scene.replace(dt=time - before, integrator=integrator).step(state, **pair.inputs)
        at, shifted = state.q.chunk(2)
        growth = float((shifted - at).abs().max()) / SHIFT
        if growth > MOST_GROWTH:
            share = math.log(MOST_GROWTH / grown_before) / math.log(growth / grown_before)
            until = before + share * (time - before)
            until = float(f"{0.95 * until:.2g}")
            return replace(trial, scene=trial.scene.replace(dt=until / trial.intervals)), _unpredictable(trial, until)
    return trial, ""


def reference(trial: Trial, error: float) -> Reference:
    """Reference that is exact to a small part of the error, extrapolated from steps that are halved.

    Raises:
        ArgumentError: not even the first interval can be held, or no steps are short enough.
    """
    shift = _shift(trial)
    limit, closest, spent = "", math.inf, False
    for integrator in trial.integrators[:2]:
        now, stuck = _Refinement(trial, integrator), 0
        while now.times * trial.intervals <= trial.most_steps:
            now = now.refined(shift)
            if not now.before:
                continue
            growth = now.growth()[: _first(now.changes(-1) <= NEAR)]
            until = _first(growth <= MOST_GROWTH)
            if until < len(growth):
                limit = _unpredictable(trial, until * trial.scene.dt)
                if not until:
                    raise ArgumentError(f"{limit}; give the scene damping, a controller or a shorter dt")
                now = now.until(until)
                trial = now.trial
            # at kinks there is no such series, and the steps themselves have to converge
            for column in (-1, 0):
                change = float(now.changes(column)[-1])
                if change <= error / EXACTNESS:
                    return now.reference(column, limit)
            stuck = stuck + 1 if not change < closest and closest < 1e-6 else 0
            closest = min(closest, change)
            if stuck > 2:
                break
        else:
            spent = True
    name = f"{trial.name} over {trial.horizon:.3g} s"
    steps, cure = "however short the steps", ""
    if spent:
        steps, cure = f"in {trial.most_steps} steps", "give more steps, "
    if not closest < 1e3:
        raise ArgumentError(
            f"{name} do not stay finite, {steps}; is the controller stable with dt = {trial.scene.dt:g} s?"
        )
    raise ArgumentError(
        f"{name} can be computed to {closest * EXACTNESS / SAFETY:.1e} at best, not to {error / SAFETY:.1e}"
        f", {steps}; {cure}shorten the horizon or raise the error"
    )


def _shift(trial: Trial) -> Tensor:
    """Small changes of the positions at the start, of random signs."""
    generator = torch.Generator().manual_seed(2)
    return SHIFT * (2 * torch.randint(0, 2, trial.state.q.shape, generator=generator) - 1).double()


def _unpredictable(trial: Trial, until: float) -> str:
    return f"{trial.name} cannot be held beyond {until:.3g} s, for small errors soon grow {MOST_GROWTH:.0e} times"


def _largest(differences: Tensor) -> Tensor:
    """Largest differences until the end of every interval; infinite if one is not finite."""
    size = differences.abs().amax((-1, -2))
    return torch.where(size.isfinite(), size, math.inf).cummax(0).values


def _first(good: Tensor) -> int:
    """Number of intervals before the first that is not good."""
    return int(good.long().cumprod(0).sum())
