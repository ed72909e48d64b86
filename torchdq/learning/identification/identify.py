"""Masses, centres of mass, inertias and friction of an arm from recorded motions, by least squares that stay physical.

Joint torques are linear in all parameters,

    tau = Y(q, qd, qdd) pi + rotor qdd + viscous qd + coulomb qd / sqrt(qd^2 + width^2) + ... + offset = Z phi.

The answer minimises the sum of (residual / noise of the joint)^2 and prior * distance to the description, over robots
that can exist (`feasible`); the samples enter by one small matrix per joint and block (`evidence`). Which terms there
are, and how strong the prior is, is decided on blocks that were left out (`model_selection`).
"""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_number, require_object
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.functional import inverse_dynamics, require_finite
from torchdq.learning.evaluation.blocks import MotionRows, blocks, of_motions, too_few
from torchdq.learning.evaluation.diagnostics import diagnose, misshapen, of_joints, sampled, uneven, unexplained
from torchdq.learning.identification.augmented import AugmentedFit, offset_findings
from torchdq.learning.identification.base_parameters import base_parameters
from torchdq.learning.identification.evidence import Evidence, gather
from torchdq.learning.identification.faults import fault_findings
from torchdq.learning.identification.friction_selection import simple_friction
from torchdq.learning.identification.gains import Gains, drive_gains, negative_gains, spread_of_gains
from torchdq.learning.identification.identified import INERTIAL, Identified
from torchdq.learning.identification.lags import lag_findings
from torchdq.learning.identification.model import Model
from torchdq.learning.identification.model_selection import STRENGTHS, ModelSelection, select
from torchdq.learning.identification.regression import added, known, parted
from torchdq.learning.identification.solution import ITERATIONS, Solution
from torchdq.learning.identification.terms import COULOMB, OFFSET, SHAPES, Term
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.motions import Motion
from torchdq.learning.logs.samples import Samples
from torchdq.learning.threads import one_thread
from torchdq.robot import Robot
from torchdq.robot.argument import require_bodies, require_single

IDENTIFIABLE = 0.9  # least part of a parameter's variance that the samples take away where they identify it
CARRIED = 2.0  # most times that its variance would be larger if the prior carried nothing over from other parameters
FAR = 3.0  # times the described mass from which a note says so
FEW = 100  # rows below which no effects that the model lacks are reported
AUTO = Model()


class _Problem(NamedTuple):
    """Model that was chosen or given, with the evidence about it."""

    evidence: Evidence  # with the terms of the model
    estimated: Tensor  # [terms, n] coefficients that are estimated
    strength: float  # prior of the bodies
    weight: float  # scale of the whole prior
    selection: ModelSelection | None = None
    unseen: Sequence[Tensor] = ()  # residuals of the parts that were left out
    few: tuple[Finding, ...] = ()  # rows that are too few to choose a model by


@one_thread()
def identify(
    robot: Robot,
    motions: Motion | Samples | Sequence[Motion | Samples],
    model: Model = AUTO,
    prior: float | None = None,
    sign_width: float = 1e-2,
) -> Identified:
    """Physically consistent robot that explains measured torques best, as `Identified`.

    Blocks of the motions are left out in turn, and models are validated on them, from the description to all inertial
    parameters with friction of several shapes: the simplest one within one standard error of the best is returned;
    `selection` says so. Where there are too few samples, that is viscous and Coulomb friction and a prior of 1, and a
    finding says how many would do.

    A link without mass stays without; a point, a rod or a plate gets 1 % of its size as thickness. Friction and rotor
    inertia that the description does not give make 10 % of the joint's torques where the samples do not say otherwise.

    Args:
        robot: the robot as described, without batch axes.
        motions: motions from `smooth`, which hold the sign of the velocity filtered as the torques: with sharp signs,
            Coulomb friction in filtered torques comes out too small, viscous friction too large. Or
            `Samples(q, qd, qdd, tau)` of unfiltered torques, [..., n] each, the last of the leading axes being time and
            the others motions; if their rows are in no order of time, give `friction` and `prior`, because a model is
            chosen by leaving out neighbouring rows together.
        model: the parameters that are estimated besides those of the bodies.
        prior: weight of the description, positive: a relative change of 1 / sqrt(prior) costs as much as one torque
            that is off by the noise of its joint. What hundreds of samples identify does not depend on it, the rest
            stays near the description. None: the strength that does best on blocks left out, for bodies, and 1 for the
            rest. math.inf: bodies stay as described.
        sign_width: velocity below which Coulomb friction is viscous, as in `torchdq.effects.Coulomb` [rad/s or m/s].
            With motions of `smooth`, which have a smaller one, it only serves predictions and simulations, which would
            need tiny steps otherwise.

    Raises:
        ArgumentError: a shape, a device, a value that is not finite, no samples, or a robot with batch axes.
    Warns:
        LogWarning: measurements that the description cannot explain, joints that hardly move, too few samples, or what
            biases the numbers beyond their errors, such as a lag; the same are in `Identified.findings`.

    >>> import torch, torchdq
    >>> described = torchdq.robots.load("two_link")
    >>> real = described.replace(mass=1.3 * described.mass)
    >>> q, qd, qdd = torch.randn(3, 200, 2, dtype=torch.float64)
    >>> samples = Samples(q, qd, qdd, torchdq.inverse_dynamics(real, q, qd, qdd))
    >>> found = identify(described, samples, Model(friction=None))
    >>> torch.allclose(found.predict(q, qd, qdd).tau, samples.tau, atol=1e-6)
    True
    """
    require_bodies(require_single(robot), "identification")
    require_object("model", model, Model, "torchdq.learning", "Model(friction=None)")
    rows = of_motions(robot, motions)
    if not len(rows.q) or not robot.n:
        raise ArgumentError(
            f"at least one sample and one joint are needed, found {len(rows.q)} samples of {robot.n} joints"
        )
    if prior is not None and prior != math.inf:
        require_number("prior", prior, positive=True)
    require_number("sign_width", sign_width, positive=True)
    require_finite(**{"tau": rows.measured if model.gains else rows.torques} | rows.signals())
    fixed = model.fixed(robot, sign_width)
    with torch.no_grad(), _solvable(rows.signals()), Progress(f"identifying {robot.name}") as notice:
        drives = None
        if model.gains:
            motors = gather(robot, rows, model.of_motors(robot), sign_width, say=notice.at)
            drives = drive_gains(motors, torch.tensor(rows.known_gains).expand(robot.n))
            rows = rows._replace(tau=rows.measured * drives[0].value.to(rows.q))
        data = diagnose(robot, partial(inverse_dynamics, robot), [rows.q, rows.qd, rows.qdd, rows.measured], sign_width)
        still = _still_joints(robot, rows.qd, sign_width) if bool(rows.qd.any()) else []  # static poses are meant to be
        still = [*still, *(negative_gains(robot, drives[0]) if drives else ())]
        _warn([*still, *data])
        problem = _problem(robot, rows, model, fixed, prior, sign_width, notice.at)
        problem, found, correlation = _fitted(problem)
        misfits = _misfits(problem, found, model, explained=not data)
        _warn(misfits)
        identified = _identified(problem, found, correlation, drives)
        return identified._replace(findings=(*still, *data, *misfits, *_notes(problem, identified)))


def _warn(findings: Sequence[Finding]) -> None:
    """One warning about findings, if there are any, at the caller of `identify`."""
    if findings:
        warnings.warn(LogWarning(*findings), stacklevel=4)


def _problem(
    robot: Robot,
    rows: MotionRows,
    model: Model,
    fixed: Sequence[Term],
    prior: float | None,
    sign_width: float,
    say: Callable[[str], None],
) -> _Problem:
    """Model that blocks left out ask for, or that is given, or that is taken where there are too few rows to choose."""
    strength = math.inf if prior == math.inf else 1.0
    weight = 1.0 if prior is None or math.isinf(prior) else float(prior)
    choice = model.friction == "auto" or prior is None
    if choice and (parts := blocks(rows)):
        strengths = STRENGTHS if prior is None else (strength,)
        selection, evidence, unseen = select(robot, rows, fixed, model.candidates(), sign_width, strengths, parts, say)
        chosen = selection.chosen
        return _Problem(evidence, chosen.estimated[chosen.estimated.any(1)], chosen.strength, weight, selection, unseen)
    evidence = gather(robot, rows, fixed, sign_width, say=say)
    problem = _Problem(evidence, torch.ones(len(fixed), robot.n, dtype=torch.bool), strength, weight)
    if not choice:
        return problem
    bodies = "bodies as described" if math.isinf(strength) else f"bodies with a prior of {weight:g}"
    cure = f"the model is {', '.join([*(term.name for term in fixed), bodies])}; record longer motions"
    return problem._replace(few=(too_few(rows)._replace(cure=cure),))


def _fitted(problem: _Problem) -> tuple[_Problem, Solution, Tensor]:
    """Solution to all rows with the loads that it finds itself, and correlation times [n] of its residuals in rows."""
    evidence, model = problem.evidence, (problem.estimated, problem.strength)
    first = evidence.fit(*model, torch.ones(evidence.robot.n, dtype=torch.float64), problem.weight)
    correlation = evidence.correlation(first.change(evidence.at))
    evidence = evidence.with_loads(first.parameters)
    found, at = evidence.fit(*model, correlation, problem.weight, first), evidence.at
    if bool(evidence.kept.any()):  # that a joint keeps the description is no measurement
        sums = evidence.measurements / correlation[:, None, None]
        found = found._replace(facts=known(sums, found.near, found.facts.noise**2, at))
    return problem._replace(evidence=evidence), found, correlation


def _identified(
    problem: _Problem, found: Solution, correlation: Tensor, drives: tuple[Gains, Tensor] | None
) -> Identified:
    """Robot, parameters and errors of a fit."""
    evidence, weight, near, facts = problem.evidence, problem.weight, found.near, found.facts
    robot, terms, sign_width = evidence.robot, evidence.terms, evidence.sign_width
    inflation = found.inflation(weight) if problem.selection else 1.0  # a strength that was chosen adds no knowledge
    spread = found.spread(weight, inflation)
    fastest = evidence.recording.qd.abs().amax(0).cpu()
    names = [f"{link} {name}" for link in robot.link_names for name in INERTIAL]
    changes = dict(zip(("mass", "com", "inertia"), near.bodies(found.y), strict=True))
    own = zip(terms, parted(robot, found.parameters)[1], strict=True)
    changes |= {term.described: x for term, x in own if term.described}
    model = _beyond(evidence, spread, facts.noise, problem.selection)
    wide = evidence.half_widths(problem.unseen, spread, facts.noise)
    alone = near.S.square().sum(1) * inflation / weight  # variances by the prior
    H = added(evidence.measurements / (correlation * facts.noise**2)[:, None, None], evidence.at)[:-1, :-1]
    identifiable = _identifiable(spread.square().sum(1), alone, H, fastest > sign_width, terms)
    if drives is not None:
        spread = torch.cat([spread, spread_of_gains(evidence, found, correlation, weight, *drives)], 1)
    return Identified(
        robot=robot.replace(on_unphysical="warn", **{name: x.to(robot.mass) for name, x in changes.items()}).bake(),
        terms=terms,
        names=(*names, *(f"{joint} {term.name}" for term in terms for joint in robot.joint_names)),
        parameters=found.parameters,
        spread=spread,
        base=base_parameters(facts.V[:, facts.e > 0].T @ near.inverse, near.S.norm(dim=1)),
        noise=facts.noise,
        model=model,
        half_width=wide,
        rms=found.rms,
        correlation=correlation,
        sign_width=sign_width,
        fastest=fastest,
        simple=simple_friction(evidence, found.parameters),
        identifiable=identifiable,
        selection=problem.selection,
        gains=drives and drives[0],
    )


def _beyond(evidence: Evidence, spread: Tensor, noise: Tensor, selection: ModelSelection | None) -> Tensor:
    """Standard deviations [n] of residuals on blocks left out beyond those of noise and parameters; zero without."""
    if selection is None:
        return torch.zeros_like(noise)
    F = spread[evidence.at]
    explained = torch.einsum("jpt,jpr,jrt->j", F, evidence.total[:, :-1, :-1], F) / evidence.samples
    return (selection.left - noise.square() - explained).clamp_min(0).sqrt()


@contextmanager
def _solvable(signals: Mapping[str, Tensor]) -> Iterator[None]:
    """Raise, with the signal of the largest numbers, where a matrix made of the signals cannot be factorised."""
    try:
        yield
    except torch.linalg.LinAlgError as error:
        largest = {name: float(x.abs().max()) for name, x in signals.items()}
        name = max(largest, key=lambda name: largest[name])
        raise ArgumentError(
            f"{name} must be numbers for which least squares can be solved, found up to {largest[name]:.0e}, the "
            f"largest of {', '.join(largest)}; give SI units, and leave out the rows that no robot could have measured"
        ) from error


def _still_joints(robot: Robot, qd: Tensor, sign_width: float) -> list[Finding]:
    """Findings about joints that never move faster than `sign_width` in the samples."""
    fastest = qd.abs().amax(0)
    claim = f"a joint should move faster than sign_width = {sign_width} to be identified"
    cure = "its friction and rotor inertia, and all that only its motion shows, are not identifiable"
    units = ["rad/s" if joint.turns else "m/s" for joint in robot.joint_types]
    finding = Finding("joint.unexcited", "", claim, "{:.2g} {}", cure)
    return of_joints(robot.joint_names, fastest <= sign_width, finding, fastest, units)


def _notes(problem: _Problem, found: Identified) -> list[Finding]:
    """Notes about what one motion cannot show, and links whose mass is far from the described one."""
    notes, robot = list[Finding](), problem.evidence.robot
    if problem.selection and len(problem.evidence.recording.lengths) == 1:
        claim = "motions of several kinds are needed to vouch for others"
        cure = "the model was chosen on parts of it; in motions unlike it errors may be far larger than stated"
        notes.append(Finding("motion.single", "", claim, "one motion", cure, severity="note"))
    ratios = found.robot.mass / robot.mass
    claim, cure = "the mass found should be near that described", "is it the robot of this description, without a load?"
    far = (ratios <= 1 / FAR) | (ratios >= FAR)
    finding = Finding("mass.far", "", claim, "{:.2g} times it", cure, severity="note")
    return notes + of_joints(robot.link_names, far, finding, ratios)


def _misfits(problem: _Problem, found: Solution, model: Model, explained: bool) -> list[Finding]:
    """Findings about a model that could not be chosen, and torques that it does not explain, or by wrong terms."""
    evidence, misfits = problem.evidence, [*problem.few]
    # what was tried on blocks that were left out is not asked for
    robot, rows, sign_width, tried = evidence.robot, evidence.recording, evidence.sign_width, problem.selection
    if not found.settled:
        claim = f"the least squares should settle within {ITERATIONS} iterations"
        misfits.append(Finding("fit.unsettled", "", claim, "", "give a stronger prior"))
    if not explained:  # by the description: then no model explains them
        return misfits
    residual = evidence.residual(found.change(evidence.at))
    signals = [rows.q, rows.qd, rows.qdd, rows.measured, residual]
    few = sampled(signals if rows.direction is None else [*signals, rows.direction])
    fitted, signs = few[3] - few[4], None if rows.direction is None else few[5]
    if len(residual) >= FEW and (faults := fault_findings(evidence, problem.estimated)):
        return misfits + faults
    if changed := uneven(robot.joint_names, few[4], few[3]):
        return misfits + changed
    described = inverse_dynamics(robot, few[0], few[1], few[2])
    if poor := unexplained(robot.joint_names, few[:4], fitted, described, sign_width):
        return misfits + poor
    if len(residual) >= FEW:
        fit = AugmentedFit.of(evidence, found.near, found.y, problem.weight, residual)
        if lacking := [*lag_findings(fit), *(() if tried and model.offset == "auto" else offset_findings(fit))]:
            return misfits + lacking
    if COULOMB in evidence.terms and not ((tried and model.friction == "auto") or set(SHAPES) & set(evidence.terms)):
        misfits += misshapen(robot.joint_names, few[:4], fitted, sign_width, signs)
    return misfits


def _identifiable(variance: Tensor, alone: Tensor, H: Tensor, moves: Tensor, terms: Sequence[Term]) -> Tensor:
    """Parameters [k] that the samples decide, at joints that move: none of a link without mass, or that no row moves.

    The samples reduce their variances, which are `alone` by the prior, to a tenth, and do so by themselves, with their
    information H [k, k]: the prior also carries a parameter over from others of its link, such as the mass from the
    first moment. Independent priors of the same widths must leave as little, or nearly the same variance.
    """
    width = alone.sqrt()
    independent = alone * torch.linalg.inv(width[:, None] * H * width + torch.eye(len(H), dtype=H.dtype)).diagonal()
    own = [moves if term is not OFFSET else torch.ones_like(moves) for term in terms]
    inertial = torch.ones(len(alone) - len(own) * len(moves), dtype=torch.bool)
    least = (CARRIED * variance).maximum((1 - IDENTIFIABLE) ** 2 * alone)
    decided = (variance.maximum(independent) < (1 - IDENTIFIABLE) * alone) & (independent < least)
    return decided & torch.cat([inertial, *own])
