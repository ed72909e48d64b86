"""Ladder of models, from the description to the identified robot, measured on blocks of motions that were left out.

The rungs are the description; friction, rotor inertia and offsets beside it; and all inertial parameters with a prior
at the description, whose strength is found, too; the last two also with friction of other shapes and offsets of the
joints that gain from them (`shapes`). The simplest rung within one standard error of the best is chosen, the error
being that of the paired differences over the blocks: what little data cannot decide stays as described.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.tables import table
from torchdq.learning.evaluation.blocks import Block, MotionRows
from torchdq.learning.identification.evidence import Evidence, Unseen, described, gather
from torchdq.learning.identification.regression import places, rigid
from torchdq.learning.identification.shapes import Gain, gainful
from torchdq.learning.identification.solution import Solution, changes, solve
from torchdq.learning.identification.terms import OFFSET, ROTOR, Term
from torchdq.robot import Robot

STRENGTHS = tuple(10.0**k for k in range(5, -1, -1))  # prior of the bodies, the strongest first

UnseenParts = tuple[list[Unseen], list[Unseen]]  # blocks, and regions of the states


class Rung(NamedTuple):
    """Model, and how it did on the blocks that were left out."""

    name: str
    scores: Tensor  # [blocks, n] mean squared residual over the variance of the joint's torque
    sought: Tensor  # [terms, n] coefficients that it has
    strength: float  # weight of the bodies' prior; infinite: they stay as described
    gains: tuple[Gain, ...] = ()  # friction of other shapes that it has
    found: tuple[Tensor, ...] = ()  # changes of the parameters, found without each block and region [n, p]

    @property
    def score(self) -> float:
        """Mean score over joints and blocks."""
        return float(self.scores.mean())

    @property
    def error(self) -> float:
        """Standard error of the score over blocks."""
        return float(self.scores.mean(1).std() / len(self.scores) ** 0.5)


class Ladder(NamedTuple):
    """Rungs from the simplest to the richest, and the one that was chosen.

    Printed, it is a table of them with the reasons for the choice.
    """

    rungs: tuple[Rung, ...]
    chosen: int
    parts: str  # words for the blocks and regions that were left out, or for why there are none
    left: Tensor  # [n] mean squared residual of the chosen rung on blocks, or on regions where larger [(N m)^2 or N^2]
    useless: tuple[str, ...] = ()  # shapes of friction, and offsets, that no joint gained from
    untold: tuple[str, ...] = ()  # groups of parameters that the samples do not tell

    @property
    def rung(self) -> Rung:
        """Rung that was chosen."""
        return self.rungs[self.chosen]

    @property
    def words(self) -> str:
        """The model, and what it was chosen on."""
        return f"{self.rung.name}, {'chosen on' if len(self.rung.scores) else 'not chosen, since'} {self.parts}"

    def __repr__(self) -> str:
        if not len(self.rung.scores):
            return f"Ladder({self.rung.name!r}, not chosen)"
        return f"Ladder({len(self.rungs)} rungs, {self.rung.name!r} chosen, score {self.rung.score:.4g})"

    def __str__(self) -> str:
        if not len(self.rung.scores):
            return "\n".join([self.words, *self._untold()])
        best = min(self.rungs, key=lambda rung: rung.score)
        rows = [
            (
                rung.name,
                f"{rung.score:.5f}",
                f"{rung.error:.5f}",
                f"{rung.score**0.5:.3f}",
                "" if math.isinf(rung.strength) else f"{rung.strength:g}",
                " and ".join(["chosen"] * (rung is self.rung) + ["best"] * (rung is best)),
            )
            for rung in self.rungs
        ]
        lines = [
            f"squared residual over variance of the torque, mean over joints, on {self.parts}",
            table(("model", "score", "standard error", "root", "prior", ""), rows),
            f"chosen: {self.rung.name}, "
            + ("the best" if self.rung is best else "the simplest within one standard error of the best"),
        ]
        if self.rung.gains:
            found: dict[str, list[str]] = {}
            for gain in self.rung.gains:
                found.setdefault(gain.joint, []).append(f"{gain.term} ({gain.gain:.2g} +- {gain.error:.1g})")
            lines.append(f"{_more(self.rung.gains)}, with what a joint gains:")
            lines += [f"  {joint}: {', '.join(terms)}" for joint, terms in found.items()]
        if self.useless:
            lines.append(f"no joint gains from {', '.join(self.useless)}")
        return "\n".join([*lines, *self._untold()])

    def _untold(self) -> list[str]:
        found = [f"  {group}" for group in self.untold]
        return ["not told by the samples, left near the description:", *found] if found else []


def climb(
    robot: Robot,
    recording: MotionRows,
    fixed: Sequence[Term],
    candidates: Sequence[Term],
    width: float,
    strengths: Sequence[float],
    blocks: Sequence[Block],
    say: Callable[[str], None],
) -> tuple[Ladder, Evidence, UnseenParts]:
    """Ladder of models of a recording, the evidence with the terms of its chosen rung, and residuals of this rung.

    The residuals are those of blocks, and of regions, by parameters that were found without each.

    Args:
        robot: the robot as described.
        recording: the rows.
        fixed: terms of every joint.
        candidates: friction of other shapes, and offsets.
        width: velocity below which dry friction is viscous [rad/s or m/s].
        strengths: of the prior of the bodies to choose from, the strongest first.
        blocks: blocks to leave out.
        say: is told how far it is.
    """
    terms, n = (*fixed, *candidates), robot.n
    loaded = any(term.loaded for term in terms)
    none = torch.zeros(n, 10 * len(robot.link_names) + len(terms), dtype=torch.float64)
    sought = torch.tensor([[term in fixed] * n for term in terms], dtype=torch.bool).reshape(len(terms), n)
    others = [k for k, term in enumerate(terms) if term not in fixed]

    load = rigid(robot, recording, described(robot), robot.armature) if loaded else None
    evidence = gather(robot, recording, terms, width, load, blocks, say)
    nothing = (none,) * len(evidence.left)
    rungs = [Rung("description", evidence.scores(nothing), torch.zeros_like(sought), math.inf, found=nothing)]

    def add(name: str, evidence: Evidence, strengths: Sequence[float], mask: Tensor, gains: Sequence[Gain]) -> None:
        say(name)
        rungs.append(_rung(name, evidence, strengths, mask, variance, gains))

    found, variance = _noise(evidence, sought, math.inf, say)
    if fixed:
        add("+ friction", evidence, (math.inf,), sought, ())
    if others:
        mask, gains = gainful(evidence, variance, sought, others, math.inf, say)
        if gains:
            add(f"+ {_more(gains)}", evidence, (math.inf,), mask, gains)
    if math.isinf(strengths[-1]):
        return _chosen(rungs, evidence, evidence, others, blocks)
    found, variance = _noise(evidence, sought, strengths[-1], say)
    add("identified", evidence, strengths, sought, ())
    identified = evidence
    if others:
        if loaded:
            load = rigid(robot, recording, found.parameters[: 10 * len(robot.link_names)], _rotors(evidence, found))
            identified = gather(robot, recording, terms, width, load, blocks, say)
        strength = rungs[-1].strength
        for _ in range(2):  # what is noise depends on the friction
            mask, gains = gainful(identified, variance, sought, others, strength, say)
            if not gains:
                break
            found, variance = _noise(identified, mask, strength, say)
        if gains:
            add(f"identified, {_more(gains)}", identified, strengths, mask, gains)

    return _chosen(rungs, evidence, identified, others, blocks)


def _more(gains: Sequence[Gain]) -> str:
    """Words for what joints gain from."""
    offsets = [gain.term == OFFSET.name for gain in gains]
    return " and ".join(["friction of other shapes"] * (not all(offsets)) + ["offsets"] * any(offsets))


def _chosen(
    rungs: Sequence[Rung], evidence: Evidence, identified: Evidence, others: Sequence[int], blocks: Sequence[Block]
) -> tuple[Ladder, Evidence, UnseenParts]:
    """Ladder of rungs, the evidence of the chosen one with its terms alone, and its residuals on what was left out."""
    chosen = _simplest([rung.scores for rung in rungs])
    useless = [evidence.terms[k].name for k in others if not any(bool(rung.sought[k].any()) for rung in rungs)]
    regions = len(evidence.left) - len(blocks)
    what = f"parts of motions and {regions} regions of the states" if regions else "motions"
    squares = rungs[chosen].scores * evidence.sizes / evidence.counts[:, None]
    left = torch.stack([part.mean(0) for part in (squares[: len(blocks)], squares[len(blocks) :]) if len(part)]).amax(0)
    ladder = Ladder(tuple(rungs), chosen, f"{len(blocks)} {what} that were left out in turn", left, tuple(useless))
    own = evidence if math.isinf(rungs[chosen].strength) else identified
    return ladder, _only(own, rungs[chosen].sought.any(1)), own.left_out(rungs[chosen].found, blocks)


def _rung(
    name: str, evidence: Evidence, strengths: Sequence[float], sought: Tensor, variance: Tensor, gains: Sequence[Gain]
) -> Rung:
    """Rung with the strength of the prior that does best on the blocks, or a stronger one as good."""
    scores, every = list[Tensor](), list[list[Tensor]]()
    starts: list[Tensor | None] = [None] * len(evidence.folds)
    before = 1.0
    for strength in strengths:
        near, found = evidence.near(sought, strength), []
        ratio = math.sqrt(strength / before)
        for k, sums in enumerate(evidence.folds):
            start = starts[k]
            if start is not None:
                start = torch.cat([start[: 10 * len(near.links)] * ratio, start[10 * len(near.links) :]])
            starts[k], change = changes(near, sums, variance, evidence.at, start)
            found.append(change)
        before = strength
        every.append(found)
        scores.append(evidence.scores(found))
    best = _simplest(scores)
    return Rung(name, scores[best], sought, strengths[best], tuple(gains), tuple(every[best]))


def _simplest(scores: Sequence[Tensor]) -> int:
    """First of scores [blocks, n], simplest first, that is within one standard error of the best."""
    means = [x.mean(1) for x in scores]
    best = min(range(len(means)), key=lambda i: float(means[i].mean()))
    for i, one in enumerate(means):
        off = one - means[best]
        if float(off.mean()) <= float(off.std() / len(off) ** 0.5):
            return i
    return best


def _noise(evidence: Evidence, sought: Tensor, strength: float, say: Callable[[str], None]) -> tuple[Solution, Tensor]:
    """Fit to all rows, and the variance of its residuals times their correlation time [n]."""
    one = torch.ones(evidence.robot.n, dtype=torch.float64)
    near = evidence.near(sought, strength)
    found = solve(near, evidence.total, evidence.squares, evidence.samples, one, evidence.at, say=say)
    variance = found.facts.noise.maximum(found.rms) ** 2
    return found, variance * evidence.correlation(found.change(evidence.at))


def _rotors(evidence: Evidence, found: Solution) -> Tensor | None:
    """Rotor inertias [n] of a fit, or those of the description."""
    if ROTOR not in evidence.terms:
        return evidence.robot.armature
    own = found.parameters[10 * len(evidence.robot.link_names) :].reshape(-1, evidence.robot.n)
    return own[evidence.terms.index(ROTOR)]


def _only(evidence: Evidence, used: Tensor) -> Evidence:
    """Evidence without terms that are not used [terms]."""
    p = evidence.at.shape[1]
    keep = torch.ones(p + 1, dtype=torch.bool)
    keep[p - len(used) : p] = used
    terms = tuple(term for term, u in zip(evidence.terms, used.tolist(), strict=True) if u)

    def cut(sums: Tensor) -> Tensor:
        return sums[..., keep, :][..., keep]

    return evidence._replace(
        terms=terms,
        own=evidence.own[..., used.to(evidence.own.device)],
        total=cut(evidence.total),
        left=cut(evidence.left),
        folds=cut(evidence.folds),
        unit=evidence.unit[used],
        told=evidence.told[used],
        at=places(len(evidence.robot.link_names), len(terms), evidence.robot.n),
    )
