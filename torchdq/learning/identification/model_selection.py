"""Selection of a model, from the description to the identified robot, on blocks of motions that were left out.

Candidates are the description; that with friction, rotors and offsets; and all inertial parameters with a prior, with
and without the constraint that joints which do not gain keep their described torques. The last two also have friction
of other shapes, at joints that gain from it (`friction_selection`). The simplest one within one standard error and
`NEAR` of the best is chosen, the error being that of the paired differences over the blocks. Averages of candidates, by
the weights that do best on the blocks, predict recordings of real arms no better.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.tables import table
from torchdq.learning.evaluation.blocks import REGIONS, Block, MotionRows
from torchdq.learning.identification.evidence import Evidence, gather
from torchdq.learning.identification.friction_selection import Gain, gainful
from torchdq.learning.identification.solution import Solution, changes
from torchdq.learning.identification.terms import OFFSET, ROTOR, SHAPES, Term
from torchdq.robot import Robot

STRENGTHS = (1e4, 1e2, 1.0)  # prior of the bodies, the strongest first
SURE = 2.0  # standard errors by which a joint gains from a rotor or an offset, tried before friction of other shapes
ALONE = 0.12  # the same of the best and the plainest models, where parts of a single motion are all the validation
NEAR = 0.1  # part of the best score by which that of a simpler model may be worse, and by one standard error
MOVES = 0.01  # least mean square of a joint's velocity in a block, relative to the largest, where it moves


class CandidateModel(NamedTuple):
    """Model, and its validation on the blocks that were left out."""

    name: str
    scores: Tensor  # [blocks, n] mean squared residual over the variance of the joint's torque
    estimated: Tensor  # [terms, n] coefficients that it has
    strength: float  # weight of the bodies' prior; infinite: they stay as described
    gains: tuple[Gain, ...] = ()  # terms that single joints have
    found: Tensor = torch.zeros(0)  # [blocks, n, p] changes of the parameters, found without each block and region
    kept: tuple[str, ...] = ()  # joints at which the bodies act as described

    @property
    def score(self) -> float:
        """Mean score over joints and blocks."""
        return float(self.scores.mean())

    @property
    def error(self) -> float:
        """Standard error of the score over blocks; regions share their rows."""
        blocks = self.scores[:-REGIONS].mean(1)
        return float(blocks.std() / len(blocks) ** 0.5)


class ModelSelection(NamedTuple):
    """Candidates from the simplest to the richest, and the one that was chosen.

    Printed, it is a table of them with the reasons for the choice.
    """

    candidates: tuple[CandidateModel, ...]
    chosen: CandidateModel
    validation: str  # the blocks and regions that were left out
    left: Tensor  # [n] mean squared residual of the chosen one on blocks, or on regions where larger [(N m)^2 or N^2]
    useless: tuple[str, ...] = ()  # terms that no joint gained from

    @property
    def summary(self) -> str:
        """The model, and what it was chosen on."""
        return f"{self.chosen.name}, chosen on {self.validation}"

    def __repr__(self) -> str:
        size, chosen = len(self.candidates), self.chosen
        return f"ModelSelection({size} candidates, {chosen.name!r} chosen, score {chosen.score:.4g})"

    def __str__(self) -> str:
        chosen, best = self.chosen, min(self.candidates, key=lambda candidate: candidate.score)
        rows = [
            (
                *(one.name, f"{one.score:.5f}", f"{one.error:.5f}", f"{one.score**0.5:.3f}"),
                "" if math.isinf(one.strength) else f"{one.strength:g}",
                "all" if math.isinf(one.strength) else ", ".join(one.kept),
                " and ".join(["chosen"] * (one is chosen) + ["best"] * (one is best)),
            )
            for one in self.candidates
        ]
        near = f"one standard error, and {NEAR:.0%}, of the best"
        reason = "the best" if chosen is best else f"the simplest within {near}"
        lines = [
            f"squared residual over variance of the torque, mean over joints, on {self.validation}",
            table(("model", "score", "standard error", "root", "prior", "as described", ""), rows),
            f"chosen: {chosen.name}, {reason}",
        ]
        if chosen.gains:
            found: dict[str, list[str]] = {}
            for gain in chosen.gains:
                found.setdefault(gain.joint, []).append(f"{gain.term} ({gain.gain:.2g} +- {gain.error:.1g})")
            lines.append("terms of single joints, with the gain in validation:")
            lines += [f"  {joint}: {', '.join(terms)}" for joint, terms in found.items()]
        if self.useless:
            lines.append(f"no joint gains from {', '.join(self.useless)}")
        return "\n".join(lines)


def select(
    robot: Robot,  # as described
    recording: MotionRows,
    fixed: Sequence[Term],  # terms of every joint
    candidates: Sequence[Term],  # rotors, offsets, and friction of other shapes
    sign_width: float,
    strengths: Sequence[float],  # priors of the bodies to choose from, the strongest first
    blocks: Sequence[Block],
    say: Callable[[str], None],
) -> tuple[ModelSelection, Evidence, list[Tensor]]:
    """Selection of a model of a recording, the evidence with the terms of the chosen one, and what it leaves of parts.

    These residuals are those of blocks and regions, by parameters that were found without each.
    """
    terms, n = (*fixed, *candidates), robot.n
    evidence = identified = gather(robot, recording, terms, sign_width, blocks, say)
    untested = _untested(evidence)
    base = torch.tensor([[term in fixed] * n for term in terms], dtype=torch.bool).reshape(len(terms), n)
    base |= untested & torch.tensor([term in (ROTOR, OFFSET) for term in terms], dtype=torch.bool)[:, None]
    nothing = torch.zeros(len(evidence.left), *evidence.at.shape, dtype=torch.float64)
    tried = [CandidateModel("description", evidence.scores(nothing), torch.zeros_like(base), math.inf, found=nothing)]
    tried += _family(evidence, (math.inf,), base)[0]
    if not (math.isinf(strengths[-1]) or bool(untested.all())):
        more, identified = _family(evidence.keeping(untested), strengths, base)
        less = tried[:2][-1].scores - more[_simplest([one.scores for one in more])].scores
        kept = untested | (less.mean(0) <= less.std(0) / len(less) ** 0.5)
        if bool((kept & ~untested).any()) and not bool(kept.all()):
            constrained = identified.keeping(kept)
            tried += _again(constrained, more, strengths)
        tried += more

    number = _simplest([one.scores for one in tried])
    if len(recording.lengths) == 1:
        best = min(one.score for one in tried)
        number = next((k for k, one in enumerate(tried[:2]) if one.score <= (1 + ALONE) * best), number)
    chosen, regions = tried[number], len(evidence.left) - len(blocks)
    what = "motions" if len(recording.lengths) >= 3 else "parts of motions"
    squares = chosen.scores * evidence.sizes / torch.tensor([[len(part)] for part in evidence.parts])
    left = torch.stack([part.mean(0) for part in (squares[: len(blocks)], squares[len(blocks) :]) if len(part)]).amax(0)
    tries = torch.stack([one.estimated for one in tried]).any(0).any(1)
    useless = tuple(term.name for term, used in zip(terms, tries.tolist(), strict=True) if not used)
    validation = f"{len(blocks)} {what} and {regions} regions of the states that were left out in turn"
    selection = ModelSelection(tuple(tried), chosen, validation, left, useless)
    own = evidence if math.isinf(chosen.strength) else identified.keeping(_places(robot, chosen.kept))
    unseen = [own.residual(change, rows) for change, rows in zip(chosen.found, own.parts, strict=True)]
    return selection, own.only(chosen.estimated.any(1)), unseen


def _family(evidence: Evidence, strengths: Sequence[float], base: Tensor) -> tuple[list[CandidateModel], Evidence]:
    """Candidates of one kind of bodies with coefficients `base` [terms, n], and the evidence with their loads."""
    terms, strength, free = evidence.terms, strengths[-1], strengths[-1] < math.inf
    name = "identified" if free else "+ friction"
    optional = [k for k in range(len(terms)) if not bool(base[k].all())]
    found, variance = _noise(evidence, base, strength)
    simple = [k for k in optional if terms[k] in (ROTOR, OFFSET)]
    mask, gains = gainful(evidence, variance, base, simple, strength, SURE)
    if not (free or bool(mask.any())):
        return [], evidence
    found, variance = _noise(evidence, mask, strength, found)
    tried = [_candidate(name, evidence, strengths, mask, variance, gains, found)]
    strengths = [x for x in strengths if x <= tried[0].strength]
    if free:
        evidence = evidence.with_loads(found.parameters)
    steady = [k for k in optional if not terms[k].bristles]
    for kinds in (steady, optional):
        mask, more = gainful(evidence, variance, mask, kinds, tried[-1].strength)
        if any(kinds is steady or gain.term not in [terms[k].name for k in steady] for gain in more):
            gains = [*gains, *more]
            found, variance = _noise(evidence, mask, tried[-1].strength, found)
            tried.append(_candidate(name, evidence, strengths, mask, variance, gains, found))
    return tried, evidence


def _again(
    evidence: Evidence, candidates: Sequence[CandidateModel], strengths: Sequence[float]
) -> list[CandidateModel]:
    """Candidates with the same terms, validated again on other evidence."""
    tried, found = list[CandidateModel](), None
    for one in candidates:
        found, variance = _noise(evidence, one.estimated, one.strength, found)
        weaker = [x for x in strengths if x <= one.strength]
        tried.append(_candidate("identified", evidence, weaker, one.estimated, variance, one.gains, found))
    return tried


def _places(robot: Robot, joints: Sequence[str]) -> Tensor:
    """Joints [n] that have these names."""
    return torch.tensor([name in joints for name in robot.joint_names], dtype=torch.bool)


def _untested(evidence: Evidence) -> Tensor:
    """Joints [n] excited in one block only; they cannot be cross-validated."""
    blocks = evidence.parts[: len(evidence.margins)]
    speed = torch.stack([evidence.recording.qd[rows].square().mean(0) for rows in blocks]).cpu()
    return (speed > MOVES * speed.amax(0)).sum(0) == 1


def _additions(evidence: Evidence, estimated: Tensor) -> list[str]:
    """Names of the kinds of terms besides viscous and Coulomb friction."""
    own = [term for term, used in zip(evidence.terms, estimated.any(1).tolist(), strict=True) if used]
    shapes = [term for term in own if term in SHAPES]
    kinds = {"rotors": ROTOR in own, "offsets": OFFSET in own, "friction of other shapes": bool(shapes)}
    kinds["memory"] = any(term.bristles for term in shapes)
    return [kind for kind, there in kinds.items() if there]


def _candidate(
    name: str,
    evidence: Evidence,
    strengths: Sequence[float],
    estimated: Tensor,
    variance: Tensor,
    gains: Sequence[Gain],
    whole: Solution,  # fit to all rows
) -> CandidateModel:
    """Model with the strongest prior within one standard error of the best on the blocks."""
    name = ", ".join([name, *_additions(evidence, estimated)])
    evidence.say(name)
    scores, every = list[Tensor](), list[Tensor]()
    before, start = whole.near, whole.y.expand(len(evidence.left), -1)
    for strength in strengths:
        near = evidence.near(estimated, strength)
        start, found = changes(near, evidence.folds[:-1], variance, evidence.at, near.at(before, start))
        before = near
        every.append(found)
        scores.append(evidence.scores(found))
    best = _simplest(scores)
    kept = tuple(joint for joint, yes in zip(evidence.robot.joint_names, evidence.kept.tolist(), strict=True) if yes)
    return CandidateModel(name, scores[best], estimated, strengths[best], tuple(gains), every[best], kept)


def _simplest(scores: Sequence[Tensor]) -> int:
    """Index of the first scores [blocks, n] within one standard error and `NEAR` of the best."""
    means = [x.mean(1) for x in scores]
    best = min(means, key=lambda one: float(one.mean()))
    off, least = torch.stack(means) - best, float(best.mean())
    near = off.mean(1) <= (off.std(1) / len(best) ** 0.5).clamp_max(NEAR * least) + 1e-3 * least
    return int(near.to(torch.int).argmax())


def _noise(
    evidence: Evidence, estimated: Tensor, strength: float, before: Solution | None = None
) -> tuple[Solution, Tensor]:
    """Fit to all rows, started from another, and the variance of its residuals times their correlation times [n]."""
    found = evidence.fit(estimated, strength, torch.ones(evidence.robot.n, dtype=torch.float64), before=before)
    variance = found.facts.noise.maximum(found.rms) ** 2
    return found, variance * evidence.correlation(found.change(evidence.at))
