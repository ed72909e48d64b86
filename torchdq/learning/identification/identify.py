"""Masses, centres of mass, inertias and friction of an arm from recorded motions, by least squares that stay physical.

Joint torques are linear in all parameters,

    tau = Y(q, qd, qdd) pi + rotor qdd + viscous qd + coulomb qd / sqrt(qd^2 + width^2) + ... + offset = Z phi.

The answer minimises

    sum over samples and joints of (residual / noise of the joint)^2  +  prior * distance to the description

over robots that can exist (`feasible`); the samples enter by one small matrix per joint and block (`evidence`). Which
terms there are, and how strong the prior is, is decided on blocks that were left out (`ladder`).
"""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from torchdq.base.checks import require_number
from torchdq.base.progress import Progress
from torchdq.effects.friction import Friction
from torchdq.errors import ArgumentError
from torchdq.functional import inverse_dynamics, require_finite
from torchdq.learning.evaluation.blocks import MotionRows, blocks, too_few
from torchdq.learning.evaluation.diagnostics import LogWarning, doubts, misshapen, sampled, unexplained
from torchdq.learning.identification.calibration import half_widths
from torchdq.learning.identification.evidence import Evidence, described, gather
from torchdq.learning.identification.gains import Gains, drive_gains, spread_of_gains
from torchdq.learning.identification.identified import INERTIAL, Identified, recorded
from torchdq.learning.identification.lags import lagging
from torchdq.learning.identification.missing import missing, offset_missing
from torchdq.learning.identification.model_selection import STRENGTHS, Ladder, Rung, UnseenParts, climb
from torchdq.learning.identification.regression import base_parameters, rigid
from torchdq.learning.identification.simple import simple_friction
from torchdq.learning.identification.solution import ITERATIONS, Solution, solve
from torchdq.learning.identification.terms import COULOMB, OFFSET, ROTOR, SHAPES, VISCOUS, Term, terms_of
from torchdq.learning.logs.motions import Motion
from torchdq.learning.threads import one_thread
from torchdq.robot import Robot
from torchdq.robot.argument import require_bodies, require_robot
from torchdq.robot.model import batches

EXCITED = 0.9  # least part of a parameter's variance that the samples take away where they excite it


@one_thread()
def identify(
    robot: Robot,
    motions: Motion | Sequence[Motion] | Tensor,
    qd: Tensor | None = None,
    qdd: Tensor | None = None,
    tau: Tensor | None = None,
    friction: bool | Literal["choose"] | Friction | Sequence[Friction] = "choose",
    offset: bool | Literal["choose"] = "choose",
    armature: bool = False,
    prior: float | None = None,
    width: float = 1e-2,
    direction: Tensor | None = None,
    gains: bool = False,
    memory: bool = True,
) -> Identified:
    """Physically consistent robot that explains measured torques best, as `Identified`.

    Blocks of the motions are left out in turn, and the models are measured on them: the description, friction beside
    it, all inertial parameters with a prior at the description, and friction of other shapes. The simplest model
    within one standard error of the best is returned; `report` says so. Where there are too few samples to leave any
    out, that is viscous and Coulomb friction and a prior of 1, which `friction=True, prior=1.0` asks for by name;
    `report` and a `LogWarning` say how many would do.

    Joints are weighted by the noise that least squares leave in each. A link without mass stays without; a body
    described as a point, a rod or a plate gets 1 % of its size as thickness. Friction and rotor inertia that the
    description does not give make 10 % of the joint's torques where the samples do not say otherwise. Solving costs
    the same for any number of samples, and they are read in pieces.

    Args:
        robot: the robot as described, without batch axes.
        motions: motions from `smooth`; or joint positions [..., n] [rad or m], the last of the leading axes being time
            and the others motions. If the rows are not in the order of time, give `friction` and `prior`: a model is
            chosen by leaving out neighbouring rows together.
        qd, qdd: joint velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2], [..., n], beside positions.
        tau: measured joint torques [N m or N], [..., n], beside positions.
        friction: "choose": viscous and Coulomb friction, and of other shapes what blocks that were left out gain from;
            True: viscous and Coulomb friction; False: the joints have none. Or friction effects, which are sought and
            no others: the numbers that they have where their torque is linear do not matter, all others hold.
        offset: "choose": seek a constant torque of the joints that gain from it on blocks that were left out; True: of
            every joint; False: of none.
        armature: seek the rotor inertia of every joint, or leave it as described.
        prior: weight of the description, positive: a change of 1 / sqrt(prior), relative to the described value, costs
            as much as one torque that is off by the noise of its joint. What hundreds of samples identify does not
            depend on it, what they hardly identify stays near the description, the rest stays as described. None: the
            strength that does best on blocks that were left out, for bodies, and 1 for the rest. math.inf: bodies
            stay as described.
        width: velocity below which Coulomb friction is viscous, as in `torchdq.effects.Coulomb` [rad/s or m/s]. The
            default is larger than that of `smooth`, which only rounds the sharp steps in logs of real arms: simulations
            would need tiny steps there.
        direction: sign of the velocities, filtered as the torques were, [..., n], beside positions: motions hold it,
            and `directions(motion)` has it. Filters round the steps of dry friction in the torques, and beside sharp
            signs Coulomb friction comes out too small, viscous friction too large. Give `smooth` the same `width`: the
            one here then only serves predictions and simulation. None: qd / sqrt(qd^2 + width^2), for torques that are
            not filtered. A `LogWarning` names joints whose friction has another shape than was sought, for which the
            numbers are biased beyond their errors; another names constant torques that were not sought, another torques
            that lag the motion, with the time.
        gains: seek the torque per unit of effort of every joint, where `tau` is a current, or a torque by gains that
            are not trusted. Before the samples they are 1 with a standard deviation of 0.3, and unknown at joints for
            which the layout of the log has no gain. One factor of all gains, like one of all masses, comes from the
            description. Gains are found first, with viscous and Coulomb friction; all else is found from the torques
            that they make.
        memory: whether friction may have a memory, as `torchdq.effects.LuGre` has: scenes simulate it, layers do not.

    Raises:
        ArgumentError: a shape, a device, a value that is not finite, no samples, or a robot with batch axes.

    >>> import torch, torchdq
    >>> described = torchdq.robots.load("two_link")
    >>> real = described.replace(mass=1.3 * described.mass)
    >>> q, qd, qdd = torch.randn(3, 200, 2, dtype=torch.float64)
    >>> found = identify(described, q, qd, qdd, torchdq.inverse_dynamics(real, q, qd, qdd), friction=False)
    >>> torch.allclose(found.predict(q, qd, qdd).tau, torchdq.inverse_dynamics(real, q, qd, qdd), atol=1e-6)
    True
    """
    for name, axes in batches(require_robot(robot)).items():
        raise ArgumentError(f"{name} of robot {robot.name!r} has batch axes {axes}; identify one at a time")
    _, rows = recorded(robot, motions, qd, qdd, tau=tau, direction=direction)
    _require(robot, rows, friction, offset, prior, width)

    plain = [VISCOUS, COULOMB] * bool(friction)
    rubbing = plain if isinstance(friction, bool | str) else [*terms_of(friction, robot, width)]
    if not memory and any(term.bristles for term in rubbing):
        raise ArgumentError(
            "friction must have no memory if memory=False, found LuGre; give other friction, or memory=True"
        )
    fixed = [ROTOR] * armature + rubbing + [OFFSET] * (offset is True)
    known = torch.tensor(rows.known_gains).expand(robot.n)
    if not (gains or bool(known.all())):
        raise ArgumentError("tau of the motions must be torques, found efforts of unknown gains; give gains=True")
    left_out = blocks(rows) if friction == "choose" or prior is None else []
    with torch.no_grad(), _solvable(rows.signals()), Progress(f"identifying {robot.name}") as notice:
        drives = None
        if gains:
            motors = [ROTOR] * (armature or robot.armature is not None) + plain + [OFFSET] * (offset is True)
            drives = drive_gains(gather(robot, rows, motors, width, None, (), notice.at), known)
            rows = rows._replace(tau=rows.measured * drives[0].value.to(rows.q))
        moves = _moving(robot, rows.qd, width)
        if doubt := _doubts(robot, rows, width):
            warnings.warn(doubt, LogWarning, stacklevel=3)
        frozen = prior == math.inf
        unseen: UnseenParts = ([], [])
        ladder, strength = None, math.inf if frozen else 1.0
        weight = 1.0 if prior is None or frozen else prior
        if left_out:
            shapes = SHAPES if friction == "choose" else ()
            candidates = [OFFSET] * (offset == "choose") + [term for term in shapes if memory or not term.bristles]
            strengths = STRENGTHS if prior is None else (strength,)
            ladder, evidence, unseen = climb(robot, rows, fixed, candidates, width, strengths, left_out, notice.at)
            sought, strength = ladder.rung.sought[ladder.rung.sought.any(1)], ladder.rung.strength
        else:
            loaded = any(term.loaded for term in fixed)
            load = rigid(robot, rows, described(robot), robot.armature) if loaded else None
            evidence = gather(robot, rows, fixed, width, load, (), notice.at)
            sought = torch.ones(len(fixed), robot.n, dtype=torch.bool)
            if friction == "choose" or prior is None:
                ladder = _unchosen(rows, fixed, sought, strength, weight)
                words = f"no model could be chosen, since {ladder.parts}; taken is {ladder.rung.name}"
                warnings.warn(words, LogWarning, stacklevel=3)
        evidence, found, correlation = _fitted(evidence, sought, strength, weight, width, notice.at)
        if not found.settled:
            warnings.warn(f"the least squares have not settled after {ITERATIONS} iterations", stacklevel=3)
        measured = bool(left_out) and offset == "choose"  # blocks that were left out have decided about offsets
        for late in () if doubt else _late(evidence, found, weight, width, not measured):
            warnings.warn(late, LogWarning, stacklevel=3)
        return _identified(evidence, found, correlation, weight, width, moves, ladder, unseen, drives)


def _require(robot: Robot, rows: MotionRows, friction: Any, offset: Any, prior: Any, width: Any) -> None:
    """Raise unless samples and options are such that the robot can be identified."""
    if not len(rows.q) or not robot.n:
        raise ArgumentError(
            f"at least one sample and one joint are needed, found {len(rows.q)} samples of {robot.n} joints"
        )
    if isinstance(friction, str) and friction != "choose":
        raise ArgumentError(
            f"friction must be True, False, 'choose', or a sequence of friction effects, found {friction!r}"
        )
    if offset != "choose" and not isinstance(offset, bool):
        raise ArgumentError(f"offset must be True, False or 'choose', found {offset!r}")
    if prior is not None and prior != math.inf:
        require_number("prior", prior, positive=True)
    require_number("width", width, positive=True)
    require_finite(**rows.signals())
    require_bodies(robot, "identification")


def _unchosen(rows: MotionRows, fixed: Sequence[Term], sought: Tensor, strength: float, prior: float) -> Ladder:
    """Ladder of the one model that is taken where there are too few rows to choose by."""
    bodies = "bodies as described" if math.isinf(strength) else f"bodies with a prior of {prior:g}"
    none = torch.zeros(0, sought.shape[1], dtype=torch.float64)
    rung = Rung(", ".join([*(term.name for term in fixed), bodies]), none, sought, strength)
    return Ladder((rung,), 0, too_few(rows), none.sum(0))


def _fitted(
    evidence: Evidence, sought: Tensor, strength: float, prior: float, width: float, say: Callable[[str], None]
) -> tuple[Evidence, Solution, Tensor]:
    """Solution to all rows, and the correlation times of its residuals [n]; loads are those that it finds itself."""
    robot, at = evidence.robot, evidence.at
    correlation = torch.ones(robot.n, dtype=torch.float64)
    for again in (True, False):
        near = evidence.near(sought, strength)
        found = solve(near, evidence.total, evidence.squares, evidence.samples, correlation, at, prior, say)
        if again:
            correlation = evidence.correlation(found.change(at))
            if any(term.loaded for term in evidence.terms):
                robot_found = _replaced(robot, found, evidence.terms)
                load = rigid(
                    robot, evidence.recording, found.parameters[: 10 * len(robot.link_names)], robot_found.armature
                )
                evidence = gather(robot, evidence.recording, evidence.terms, width, load, (), say)
    return evidence, found, correlation


def _identified(
    evidence: Evidence,
    found: Solution,
    correlation: Tensor,
    prior: float,
    width: float,
    moves: Tensor,
    ladder: Ladder | None,
    unseen: UnseenParts,
    drives: tuple[Gains, Tensor] | None,
) -> Identified:
    robot, terms, near, facts = evidence.robot, evidence.terms, found.near, found.facts
    measured = ladder is not None and len(ladder.rung.scores) > 0
    doubt = found.doubt(prior) if measured else 1.0  # a strength that was chosen is no knowledge
    spread = found.spread(prior, doubt)
    names = [f"{link} {name}" for link in robot.link_names for name in INERTIAL]
    excited = _excited(spread, near.S.norm(dim=1) * math.sqrt(doubt / prior), moves, terms)
    if ladder is not None:
        ladder = ladder._replace(untold=_untold(robot, excited))
    model = _beyond(evidence, spread, facts.noise, ladder if measured else None)
    wide = half_widths(evidence, unseen, spread, facts.noise)
    if drives is not None:
        spread = torch.cat([spread, spread_of_gains(evidence, found, correlation, prior, *drives)], 1)
    return Identified(
        robot=_replaced(robot, found, terms),
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
        width=width,
        simple=simple_friction(evidence, found.parameters, width),
        excited=excited,
        report=ladder,
        gains=drives and drives[0],
    )


def _beyond(evidence: Evidence, spread: Tensor, noise: Tensor, ladder: Ladder | None) -> Tensor:
    """Standard deviations [n] of residuals on blocks left out beyond those of noise and parameters; zero without."""
    if ladder is None:
        return torch.zeros_like(noise)
    F = spread[evidence.at]
    told = torch.einsum("jpt,jpr,jrt->j", F, evidence.total[:, :-1, :-1], F) / evidence.samples
    return (ladder.left - noise.square() - told).clamp_min(0).sqrt()


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


def _moving(robot: Robot, qd: Tensor, width: float) -> Tensor:
    """Joints that move faster than `width` in the samples [n]; a warning names the others."""
    fastest = qd.abs().amax(0).cpu()
    joints = zip(robot.joint_names, robot.joint_types, fastest.tolist(), strict=True)
    names = [f"{name} ({v:.2g} {'rad/s' if joint.turns else 'm/s'})" for name, joint, v in joints if v <= width]
    if names:
        warnings.warn(
            f"{len(names)} of {robot.n} joints never move faster than width = {width}: {', '.join(names)}; their "
            "friction and rotor inertia, and all that only their motion shows, are not identified: see `excited`",
            stacklevel=4,
        )
    return fastest > width


def _doubts(robot: Robot, rows: MotionRows, width: float) -> str:
    """Words for what is wrong with samples that the description does not explain; "" for nothing."""
    return doubts(robot, partial(inverse_dynamics, robot), [rows.q, rows.qd, rows.qdd, rows.measured], width)


def _late(evidence: Evidence, found: Solution, prior: float, width: float, offsets: bool) -> list[str]:
    """Words for what is wrong with torques that the solution does not explain, or explains by wrong terms.

    `offsets` says that constant torques which are missing are to be named.
    """
    robot, rows, at = evidence.robot, evidence.recording, evidence.at
    residual = evidence.residual(found.change(at))
    signals = [rows.q, rows.qd, rows.qdd, rows.measured, residual]
    few = sampled(signals if rows.direction is None else [*signals, rows.direction])
    fitted, signs = few[3] - few[4], None if rows.direction is None else few[5]
    if words := unexplained(robot.joint_names, few[:4], fitted, width):
        return [words]
    constant, lags = missing(evidence, found, prior, residual)
    if lacking := [*lagging(rows.names, lags), *offset_missing(robot, constant if offsets else {})]:
        return lacking
    if COULOMB not in evidence.terms or any(term in evidence.terms for term in SHAPES):
        return []
    words = misshapen(robot.joint_names, few[:4], fitted, width, signs)
    return [words] if words else []


def _excited(spread: Tensor, prior: Tensor, moves: Tensor, terms: Sequence[Term]) -> Tensor:
    """Parameters [k] whose variance the samples reduce to a tenth of that by the prior alone, at joints that move.

    `prior` [k] are the standard errors without samples: zero for a link without mass, and for what no sample moves.
    """
    left = spread.square().sum(1) / prior.square().where(prior > 0, 1.0)
    own = [moves if term is not OFFSET else torch.ones_like(moves) for term in terms]
    inertial = torch.ones(len(prior) - len(own) * len(moves), dtype=torch.bool)
    return (prior > 0) & (left < 1 - EXCITED) & torch.cat([inertial, *own])


def _untold(robot: Robot, excited: Tensor) -> tuple[str, ...]:
    """Inertial parameters of each link that the samples do not tell, in words."""
    told = excited[: 10 * len(robot.link_names)].reshape(-1, 10).tolist()
    names = [[name for name, yes in zip(INERTIAL, row, strict=True) if not yes] for row in told]
    return tuple(
        f"{link}: {'all' if len(some) == 10 else ', '.join(some)}"
        for link, some in zip(robot.link_names, names, strict=True)
        if some
    )


def _replaced(robot: Robot, found: Solution, terms: Sequence[Term]) -> Robot:
    """Robot with the parameters found, in its own dtype and on its own device."""
    mass, com, inertia = found.near.bodies(found.y)
    changes = dict(mass=mass, com=com, inertia=inertia)
    own = found.parameters[10 * len(robot.link_names) :].reshape(-1, robot.n)
    changes |= {term.described: x for term, x in zip(terms, own, strict=True) if term.described}
    return robot.replace(on_unphysical="warn", **{name: x.to(robot.mass) for name, x in changes.items()}).bake()
