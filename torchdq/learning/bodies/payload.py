"""Mass, centre of mass and inertia of what an arm holds, from seconds of motion with it.

What a payload adds to the torques of an identified arm is Y(q, qd, qdd) pi and changes of friction and offset, with its
ten inertial parameters pi about the frame that holds it, and the columns Y of the link that carries the frame, moved
there. Minimised is the sum of squares over the noise, with the distance to a body of the size that is expected as prior
(`nearest`), so that the payload can exist, however little is identifiable from the motion.
"""

import warnings
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_number, require_object
from torchdq.base.progress import Progress
from torchdq.base.tables import table
from torchdq.dynamics.friction import smooth_sign
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.findings import Finding, merged
from torchdq.functional import inverse_dynamics, regressor, require_finite
from torchdq.learning.evaluation.diagnostics import diagnose, of_joints
from torchdq.learning.evaluation.statistics import correlation_times
from torchdq.learning.identification.base_parameters import base_names, base_of, inverse_of
from torchdq.learning.identification.identified import INERTIAL, Identified, recorded
from torchdq.learning.identification.solution import nearest, of_numbers
from torchdq.learning.identification.terms import at_rest
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.motions import Motion
from torchdq.learning.threads import one_thread
from torchdq.robot import Robot
from torchdq.robot.pseudo_inertia import BASIS, bodies_of, inertial_parameters, moved, pseudo_inertia, relative

WORSE = 3.0  # residual over that of the empty arm, from which a joint is reported: on good logs it is below 2
MOVING = 0.1  # least part of the rows in which a joint must slide to be judged by these alone
MATTERS = 0.03  # the same, over the joint's torques, below which it does not matter
NUISANCE = 1e-3  # part of its expected size that a change of friction or offset has at most: it is free
NAMES = ("mass", *(f"com {x}" for x in "xyz"), *(f"inertia {x}" for x in ("xx", "xy", "yy", "xz", "yz", "zz")))
UNITS = ("kg", *["m"] * 3, *["kg m^2"] * 6)
DTYPE = torch.float64


class IdentifiedPayload(NamedTuple):
    """Payload found at a frame, with standard errors that count so many rows as one as their residuals are correlated.

    Printed, it is a table. `robot` is the identified robot with the payload in its hand.
    """

    robot: Robot
    frame: str
    mass: Tensor  # [] [kg]
    com: Tensor  # [3] centre of mass in the frame [m]
    inertia: Tensor  # [6] about the centre of mass, axes of the frame: xx xy yy xz yz zz [kg m^2]
    mass_error: Tensor  # [] [kg]
    com_error: Tensor  # [3] [m]
    inertia_error: Tensor  # [6] [kg m^2]
    rms: Tensor  # [n] root mean square of the residual torque [N m or N]
    before: Tensor  # [n] the same without payload, with the estimated changes of friction and offset [N m or N]
    unidentifiable: tuple[str, ...] = ()  # inertial parameters about the frame that are not identifiable one by one
    findings: tuple[Finding, ...] = ()  # joints whose torques no payload explains, with the factor of their residuals

    def __repr__(self) -> str:
        return f"IdentifiedPayload({float(self.mass):.4g} +- {float(self.mass_error):.2g} kg at {self.frame!r})"

    def __str__(self) -> str:
        values = self.mass[None], self.com, self.inertia
        errors = self.mass_error[None], self.com_error, self.inertia_error
        numbers = (torch.cat(x).tolist() for x in (values, errors))
        rows = [(name, f"{x:.4g}", f"{e:.2g}", unit) for name, unit, x, e in zip(NAMES, UNITS, *numbers, strict=True)]
        found = table((f"payload at {self.frame}", "estimate", "standard error", "unit"), rows)
        if not self.unidentifiable:
            return found
        return f"{found}\n\nnot identifiable one by one, so as expected of the size: {', '.join(self.unidentifiable)}"


@one_thread()
def identify_payload(
    empty: Identified,
    motions: Motion | Sequence[Motion] | Tensor,
    qd: Tensor | None = None,
    qdd: Tensor | None = None,
    tau: Tensor | None = None,
    frame: str | None = None,
    friction: bool = False,
    offset: bool = False,
    size: float = 0.1,
    prior: float = 1.0,
    reference: Sequence[Tensor] | None = None,
) -> IdentifiedPayload:
    """Body that an arm holds, from a few seconds of motion with it, as `IdentifiedPayload`.

    Identify the empty arm first, from motions like this one: what both have wrong, such as a drive's offset, is then
    no payload.

    Args:
        empty: the arm without payload, from `identify`.
        motions: motions with payload, from `smooth`; or joint positions [rows, n] [rad or m], one row after the other
            in time: their correlation is part of the errors.
        qd, qdd, tau: joint velocities [rad/s or m/s], accelerations [rad/s^2 or m/s^2] and measured torques [N m or N],
            [rows, n], with positions.
        frame: name of the frame that holds it; None: the end effector.
        friction, offset: allow viscous and Coulomb friction and the offset of every joint to have changed since, for
            motions of 10 s and more: in shorter ones they take some of the payload.
        size: extent of the payload [m] that is expected where it is not identifiable: radius of gyration about its
            centre of mass in each direction.
        prior: weight of this expectation, positive, as in `identify`.
        reference: q, qd, qdd and tau of the empty arm, as `stack_samples(motion)` gives them, long enough to show by
            how much and for how long its torques are wrong; without, errors come out too small.

    Raises:
        ArgumentError: a shape, a value that is not finite, or a frame that no joint moves, or from whose motion a mass
            is not identifiable, as that of the first links.
    Warns:
        LogWarning: no payload explains the torques of some joints, which are named: their columns, signs or gains may
            be others than those of the empty arm.

    >>> import torch, torchdq
    >>> from torchdq.learning import Model, Samples, identify
    >>> robot = torchdq.robots.load("ur10e")
    >>> q, qd, qdd = torch.randn(3, 500, 6, dtype=torch.float64)
    >>> tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    >>> empty = identify(robot, Samples(q, qd, qdd, tau), Model(friction=None), prior=1.0)
    >>> tau = torchdq.inverse_dynamics(robot.with_payload(2.0, (0.0, 0.0, 0.1)), q, qd, qdd)
    >>> found = identify_payload(empty, q[:100], qd[:100], qdd[:100], tau[:100])
    >>> bool((found.mass - 2).abs() < 0.01), bool((found.com[2] - 0.1).abs() < 0.01)
    (True, True)
    """
    require_object("empty", empty, Identified, "torchdq.learning", "identify(robot, motions)")
    robot = empty.robot
    batch, rows = recorded(robot, motions, qd, qdd, tau=tau)
    if len(batch) != 1 or not batch[0]:
        expected = f"the shape [rows, {robot.n}] with a row at least"
        raise ArgumentError(f"q must have {expected}, found the batch axes {batch}")
    require_finite(**rows.signals())
    require_number("size", size, positive=True)
    require_number("prior", prior, positive=True)
    at = robot.end_effector() if frame is None else robot.frame(frame)
    if at.link == BASE:
        raise ArgumentError(f"frame must be one that a joint moves, found {at.name!r} on the base")
    with torch.no_grad(), Progress("identifying the payload"):
        alone = empty.predict(motions, qd, qdd).tau
        q, qd, qdd, tau = (x.cpu() for x in (rows.q, rows.qd, rows.qdd, rows.torques))
        Y = regressor(robot.to(DTYPE, "cpu"), q, qd, qdd)
        body = Y[..., 10 * at.link : 10 * at.link + 10] @ moved(at.X_BF.to("cpu", DTYPE))
        unidentifiable = _unidentifiable(robot, at.name, body)
        sign = smooth_sign(qd, empty.sign_width) if rows.direction is None else rows.direction.cpu()
        units = [qd, sign] * friction + [torch.ones_like(qd)] * offset
        changes = torch.cat([body[..., :0], *map(torch.diag_embed, units)], -1)
        residual = tau - alone.to(tau)
        variance, correlation = _empty_residual(empty, reference)
        Z = torch.cat([body[..., :4], changes], -1)  # columns of a point mass
        weight, point = _reweighted(Z, residual, rows.lengths, variance, correlation)
        mass = point[0].maximum(_solved(Z, residual, weight)[1][0])
        C = size * torch.eye(4, dtype=DTYPE)  # of the body that is expected
        C[0, 0], C[1:, 0] = 1.0, (point[1:4] / mass).clamp(-10 * size, 10 * size)
        model = Y @ empty.by_these_gains().spread[: Y.shape[-1]]
        pi, covariance = _estimate(body, changes, residual, weight, mass.sqrt() * C, prior, model)
        both = torch.cat([body, changes], -1)
        left, without = (_solved(Z, residual, weight)[2] for Z in (both, changes))
        rms, before = (x.square().mean(0).sqrt() for x in (left, without))
        findings = _unexplained(empty, (q, qd, qdd, tau), left, torch.hypot(variance.sqrt(), empty.model))
    slopes = torch.autograd.functional.jacobian(_quantities, pi)
    quantities, errors = _quantities(pi), (slopes @ covariance @ slopes.T).diagonal().sqrt()
    found, own_errors = ((x[0], x[1:4], x[4:]) for x in (quantities, errors))
    mass, com, inertia = (x.to(robot.mass) for x in found)
    held = robot.with_payload(mass, com, inertia, at.name)
    return IdentifiedPayload(held, at.name, *found, *own_errors, rms, before, unidentifiable, findings)


def _unidentifiable(robot: Robot, frame: str, body: Tensor) -> tuple[str, ...]:
    """Parameters that torques per unit of them [rows, n, 10] do not decide one by one; raises if the mass is one."""
    base, size = base_of(body.flatten(0, 1))
    single = base[(base != 0).sum(1) == 1].argmax(1).tolist()
    if 0 not in single:
        found = ", ".join(base_names(base, INERTIAL, inverse_of(size))) or "nothing"
        raise ArgumentError(
            f"frame must be one of {robot.name!r} from whose motion the mass that it holds is identifiable, found "
            f"{frame!r}, from whose motion {found} of the parameters about the frame are; give one nearer to the end "
            "effector, or longer motion"
        )
    return tuple(name for k, name in enumerate(INERTIAL) if k not in single)


def _unexplained(empty: Identified, rows: Sequence[Tensor], left: Tensor, usual: Tensor) -> tuple[Finding, ...]:
    """Joints whose residuals [rows, n] are far larger than those of the empty arm [n]; warns of them and of the cause.

    Rows at rest, where dry friction may be anything, count only at joints that hardly move.
    """
    moving = 1 - at_rest(rows[1], empty.sign_width)
    still = moving.mean(0) < MOVING
    weight = torch.where(still, torch.ones_like(moving), moving)
    rms = ((weight * left.square()).sum(0) / weight.sum(0)).sqrt()
    far = (rms > WORSE * usual) & (rms > MATTERS * rows[-1].square().mean(0).sqrt())
    claim = "residual torques should be like those of the empty arm"
    cure = "is a sign, gain or column another than then, or the body elsewhere?"
    finding = Finding("payload.unexplained", "", claim, "{:.1f} times as large", cure)
    names, ratio = empty.robot.joint_names, rms / usual
    held = finding._replace(cure="dry friction at rest may be anything: approach each pose from both sides")
    findings = (*of_joints(names, far & ~still, finding, ratio), *of_joints(names, far & still, held, ratio))
    if findings:
        robot = empty.robot.to(DTYPE, "cpu")
        joints = ", ".join(f"{finding.subject} ({finding.value:.1f} times)" for finding in findings)
        found = f"no payload explains the torques: residuals are larger than those of the empty arm at {joints}"
        cause = merged(diagnose(robot, partial(inverse_dynamics, robot), rows, empty.sign_width)) or findings[0].cure
        warnings.warn(LogWarning(f"{found}; the payload may be wrong beyond its errors: {cause}"), stacklevel=4)
    return findings


def _quantities(pi: Tensor) -> Tensor:
    """Mass, centre of mass and inertia about it [10] of inertial parameters [10]."""
    mass, com, inertia = bodies_of(torch.linalg.cholesky(pseudo_inertia(pi)))
    return torch.cat([mass[None], com, inertia])


def _empty_residual(empty: Identified, reference: Sequence[Tensor] | None) -> tuple[Tensor, Tensor]:
    """Variance [n] of the residual torques of the empty arm, and their correlation time [n] in rows."""
    if reference is None:
        return empty.noise.square(), torch.ones_like(empty.noise)
    if len(reference) != 4:
        raise ArgumentError(f"reference must be q, qd, qdd and tau of the empty arm, found {len(reference)} tensors")
    q, qd, qdd, tau = (x.detach().to("cpu", DTYPE) for x in reference)
    left = tau - empty.predict(q, qd, qdd).tau
    return left.square().mean(0), correlation_times(left - left.mean(0), [len(left)], clear=0.0)


def _reweighted(
    Z: Tensor, residual: Tensor, lengths: Sequence[int], variance: Tensor, correlation: Tensor
) -> tuple[Tensor, Tensor]:
    """Weights [n] of the joints, one over variance and correlation time of what is left, and least squares with them.

    `Z` are torques per unit [rows, n, p], `residual` is [rows, n]; variance and correlation time are at least as given.
    """
    weight = 1 / (variance * correlation)
    for _ in range(20):
        (x, _, left), before = _solved(Z, residual, weight), weight
        times = correlation_times(left - left.mean(0), lengths, clear=0.0)
        weight = 1 / (left.square().mean(0).maximum(variance) * times.maximum(correlation))
        if float((weight / before - 1).abs().max()) < 1e-3:
            break
    return weight, x


def _solved(Z: Tensor, residual: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Smallest weighted least squares [p], their standard errors [p], and the torques that they leave [rows, n]."""
    A, b = ((weight.sqrt()[:, None] * x).flatten(0, 1) for x in (Z, residual[..., None]))
    size = A.norm(dim=0).clamp_min(1e-30)
    inverse = torch.linalg.pinv(A / size) / size[:, None]
    x = (inverse @ b)[:, 0]
    return x, inverse.norm(dim=1), residual - Z @ x


def _estimate(
    body: Tensor,  # [rows, n, 10] torques per unit of the payload's parameters
    changes: Tensor,  # [rows, n, p] the same of changes of friction and offset
    residual: Tensor,
    weight: Tensor,
    C: Tensor,  # [4, 4] Cholesky factor of the pseudo-inertia that is expected
    prior: float,
    model: Tensor,  # [rows, n, t] errors of the empty arm's torques
) -> tuple[Tensor, Tensor]:
    """Inertial parameters [10] of the payload with their covariance."""
    blocks = inertial_parameters(C @ BASIS @ C.T)  # [10 entries, 10 parameters]
    typical = residual.square().mean().sqrt() / changes.square().mean((0, 1)).sqrt().clamp_min(1e-30)
    Z = torch.cat([body @ blocks.T, changes * (typical / NUISANCE)], -1)
    off = body @ inertial_parameters(C @ C.T) - residual
    A, b, model = ((weight.sqrt()[:, None] * x).flatten(0, 1) for x in (Z, off[..., None], model))
    Q, R = torch.linalg.qr(A)
    near = of_numbers(links=1, signed=changes.shape[-1])
    y = nearest(near, R[None] / prior**0.5, (Q.T @ b).T / prior**0.5)
    H = near.slopes(y)[1][0] / 2 * prior + R.T @ R
    size = H.diagonal().rsqrt()
    inverse = size[:, None] * torch.cholesky_inverse(torch.linalg.cholesky(size[:, None] * H * size)) * size
    errors = inverse @ (R.T @ (Q.T @ model))
    covariance = (inverse + errors @ errors.T)[:10, :10]
    pi = inertial_parameters(C @ relative(y[0, :10]) @ C.T)
    return pi, blocks.T @ covariance @ blocks
