"""Selection of a model, from the description to the identified robot, on blocks of motions that were left out.

The candidates are the description; the description with friction, rotor inertia and offsets; and all inertial
parameters with a prior at the description, whose strength is chosen, too; the last two also with friction of other
shapes and offsets of the joints that gain from them (`friction_selection`). The simplest candidate within one standard
error of the best is chosen, the error being that of the paired differences over the blocks: what little data cannot
decide stays as described.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.tables import table
from torchdq.learning.evaluation.blocks import Block, MotionRows
from torchdq.learning.identification.evidence import Evidence, Unseen, gather
from torchdq.learning.identification.friction_selection import Gain, gainful
from torchdq.learning.identification.solution import Solution, changes, solve
from torchdq.learning.identification.terms import OFFSET, Term
from torchdq.robot import Robot

STRENGTHS = tuple(10.0**k for k in range(5, -1, -1))  # prior of the bodies, the strongest first

UnseenParts = tuple[list[Unseen], list[Unseen]]  # blocks, and regions of the states


class CandidateModel(NamedTuple):
    """Model, and its validation on the blocks that were left out."""

    name: str
    scores: Tensor  # [blocks, n] mean squared residual over the variance of the joint's torque; none: not validated
    estimated: Tensor  # [terms, n] coefficients that it has
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


class ModelSelection(NamedTuple):
    """Candidates from the simplest to the richest, and the one that was chosen.

    Printed, it is a table of them with the reasons for the choice.
    """

    candidates: tuple[CandidateModel, ...]
    choice: int  # number of the chosen one
    validation: str  # the blocks and regions that were left out, or why there are none
    left: Tensor  # [n] mean squared residual of the chosen one on blocks, or on regions where larger [(N m)^2 or N^2]
    useless: tuple[str, ...] = ()  # shapes of friction, and offsets, that no joint gained from

    @property
    def chosen(self) -> CandidateModel:
        """CandidateModel that was chosen."""
        return self.candidates[self.choice]

    @property
    def validated(self) -> bool:
        """Whether the model was chosen on blocks that were left out; if not, there was no choice."""
        return len(self.chosen.scores) > 0

    @property
    def summary(self) -> str:
        """The model, and what it was chosen on."""
        return f"{self.chosen.name}, {'chosen on' if self.validated else 'not chosen:'} {self.validation}"

    def __repr__(self) -> str:
        if not self.validated:
            return f"ModelSelection({self.chosen.name!r}, not chosen)"
        size, chosen = len(self.candidates), self.chosen
        return f"ModelSelection({size} candidates, {chosen.name!r} chosen, score {chosen.score:.4g})"

    def __str__(self) -> str:
        if not self.validated:
            return self.summary
        chosen, best = self.chosen, min(self.candidates, key=lambda candidate: candidate.score)
        rows = [
            (
                *(one.name, f"{one.score:.5f}", f"{one.error:.5f}", f"{one.score**0.5:.3f}"),
                "" if math.isinf(one.strength) else f"{one.strength:g}",
                " and ".join(["chosen"] * (one is chosen) + ["best"] * (one is best)),
            )
            for one in self.candidates
        ]
        reason = "the best" if chosen is best else "the simplest within one standard error of the best"
        lines = [
            f"squared residual over variance of the torque, mean over joints, on {self.validation}",
            table(("model", "score", "standard error", "root", "prior", ""), rows),
            f"chosen: {chosen.name}, {reason}",
        ]
        if chosen.gains:
            found: dict[str, list[str]] = {}
            for gain in chosen.gains:
                found.setdefault(gain.joint, []).append(f"{gain.term} ({gain.gain:.2g} +- {gain.error:.1g})")
            lines.append(f"{_additions(chosen.gains)}, with the gain in validation, by joint:")
            lines += [f"  {joint}: {', '.join(terms)}" for joint, terms in found.items()]
        if self.useless:
            lines.append(f"no joint gains from {', '.join(self.useless)}")
        return "\n".join(lines)


def select(
    robot: Robot,  # as described
    recording: MotionRows,
    fixed: Sequence[Term],  # terms of every joint
    candidates: Sequence[Term],  # friction of other shapes, and offsets
    sign_width: float,
    strengths: Sequence[float],  # priors of the bodies to choose from, the strongest first
    blocks: Sequence[Block],
    say: Callable[[str], None],
) -> tuple[ModelSelection, Evidence, UnseenParts]:
    """Selection of a model of a recording, the evidence with the terms of the chosen one, and its residuals.

    The residuals are those of blocks, and of regions, by parameters that were found without each.
    """
    terms, n = (*fixed, *candidates), robot.n
    estimated = torch.tensor([[term in fixed] * n for term in terms], dtype=torch.bool).reshape(len(terms), n)
    others = [k for k, term in enumerate(terms) if term not in fixed]
    evidence = identified = gather(robot, recording, terms, sign_width, blocks, say)
    nothing = (torch.zeros(evidence.at.shape, dtype=torch.float64),) * len(evidence.left)
    tried = [
        CandidateModel("description", evidence.scores(nothing), torch.zeros_like(estimated), math.inf, found=nothing)
    ]

    def add(name: str, evidence: Evidence, strengths: Sequence[float], mask: Tensor, gains: Sequence[Gain]) -> None:
        say(name)
        tried.append(_candidate(name, evidence, strengths, mask, variance, gains))

    found, variance = _noise(evidence, estimated, math.inf)
    if fixed:
        add("+ friction", evidence, (math.inf,), estimated, ())
    if others:
        mask, gains = gainful(evidence, variance, estimated, others, math.inf)
        if gains:
            add(f"+ {_additions(gains)}", evidence, (math.inf,), mask, gains)
    if not math.isinf(strengths[-1]):
        found, variance = _noise(evidence, estimated, strengths[-1])
        add("identified", evidence, strengths, estimated, ())
        if others:
            identified, strength = evidence.with_loads(found.parameters), tried[-1].strength
            for _ in range(2):  # what is noise depends on the friction
                mask, gains = gainful(identified, variance, estimated, others, strength)
                if not gains:
                    break
                found, variance = _noise(identified, mask, strength)
            if gains:
                add(f"identified, {_additions(gains)}", identified, strengths, mask, gains)

    number = _simplest([one.scores for one in tried])
    chosen, regions = tried[number], len(evidence.left) - len(blocks)
    what = f"parts of motions and {regions} regions of the states" if regions else "motions"
    squares = chosen.scores * evidence.sizes / evidence.counts[:, None]
    left = torch.stack([part.mean(0) for part in (squares[: len(blocks)], squares[len(blocks) :]) if len(part)]).amax(0)
    useless = tuple(terms[k].name for k in others if not any(bool(one.estimated[k].any()) for one in tried))
    validation = f"{len(blocks)} {what} that were left out in turn"
    selection = ModelSelection(tuple(tried), number, validation, left, useless)
    own = evidence if math.isinf(chosen.strength) else identified
    return selection, own.only(chosen.estimated.any(1)), own.left_out(chosen.found)


def _additions(gains: Sequence[Gain]) -> str:
    """Names of the kinds of terms that joints gain from."""
    offsets = [gain.term == OFFSET.name for gain in gains]
    return " and ".join(["friction of other shapes"] * (not all(offsets)) + ["offsets"] * any(offsets))


def _candidate(
    name: str,
    evidence: Evidence,
    strengths: Sequence[float],
    estimated: Tensor,
    variance: Tensor,
    gains: Sequence[Gain],
) -> CandidateModel:
    """Model with the strength of the prior that does best on the blocks, or a stronger one as good."""
    scores, every = list[Tensor](), list[list[Tensor]]()
    starts: list[Tensor | None] = [None] * len(evidence.folds)
    before = 1.0
    for strength in strengths:
        near, found = evidence.near(estimated, strength), []
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
    return CandidateModel(name, scores[best], estimated, strengths[best], tuple(gains), tuple(every[best]))


def _simplest(scores: Sequence[Tensor]) -> int:
    """First of scores [blocks, n], simplest first, that is within one standard error of the best."""
    means = [x.mean(1) for x in scores]
    best = min(range(len(means)), key=lambda i: float(means[i].mean()))
    for i, one in enumerate(means):
        off = one - means[best]
        if float(off.mean()) <= float(off.std() / len(off) ** 0.5):
            return i
    return best


def _noise(evidence: Evidence, estimated: Tensor, strength: float) -> tuple[Solution, Tensor]:
    """Fit to all rows, and the variance of its residuals times their correlation time [n]."""
    one, near = torch.ones(evidence.robot.n, dtype=torch.float64), evidence.near(estimated, strength)
    found = solve(near, evidence.total, evidence.squares, evidence.samples, one, evidence.at, say=evidence.say)
    variance = found.facts.noise.maximum(found.rms) ** 2
    return found, variance * evidence.correlation(found.change(evidence.at))
