"""Mass, centre of mass and inertia of what an arm holds, from seconds of motion with it.

What a payload adds to the torques is linear in its ten inertial parameters about the frame that holds it,

    tau - torques of the empty arm = Y(q, qd, qdd) pi + changes of friction and offset,

Y being the columns of the link that carries the frame, moved there. The empty arm is an identified one: its torques
bring their own errors. Minimised is the sum of squares over the noise, with the distance to a body of the size that is
expected as prior (`nearest`), so that the payload can exist, however little the motion tells about it.
"""

import math
import warnings
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_number
from torchdq.base.findings import merged
from torchdq.base.progress import Notice
from torchdq.base.tables import table
from torchdq.dynamics.friction import smooth_sign
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.functional import inverse_dynamics, regressor, require_finite
from torchdq.learning.bodies.nearest import curvature, nearest, relative
from torchdq.learning.bodies.pseudo_inertia import central, inertial_parameters, moved, pseudo_inertia
from torchdq.learning.evaluation.diagnostics import diagnose
from torchdq.learning.identification.feasible import ENTRIES
from torchdq.learning.identification.identified import INERTIAL, Identified, recorded
from torchdq.learning.identification.naming import sums
from torchdq.learning.identification.regression import base_parameters
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.motions import Motion
from torchdq.learning.threads import one_thread
from torchdq.robot import Robot

ROUNDS = 20  # most times that joints are weighted anew
WORSE = 3.0  # residual over that of the empty arm, from which a joint is doubted: on good logs it is below 2
MATTERS = 0.03  # the same, over the joint's torques, below which it does not matter
INDEPENDENT = 1e-12  # least eigenvalue of a combination that is told, relative to the largest: beyond rounding
NUISANCE = 1e-3  # part of its expected size that a change of friction or offset has at most: it is free
PARTS = ("x", "y", "z"), ("xx", "xy", "yy", "xz", "yz", "zz")
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
    before: Tensor  # [n] the same without payload, with those changes of friction and offset that are sought [N m or N]
    untold: tuple[str, ...] = ()  # inertial parameters about the frame that its motion does not tell one by one

    def __repr__(self) -> str:
        return f"IdentifiedPayload({float(self.mass):.4g} +- {float(self.mass_error):.2g} kg at {self.frame!r})"

    def __str__(self) -> str:
        rows = [("mass", f"{float(self.mass):.4g}", f"{float(self.mass_error):.2g}", "kg")]
        for kind, unit, names in (("com", "m", PARTS[0]), ("inertia", "kg m^2", PARTS[1])):
            values, errors = getattr(self, kind).tolist(), getattr(self, f"{kind}_error").tolist()
            rows += [
                (f"{kind} {x}", f"{v:.4g}", f"{e:.2g}", unit) for x, v, e in zip(names, values, errors, strict=True)
            ]
        found = table((f"payload at {self.frame}", "estimate", "standard error", "unit"), rows)
        if not self.untold:
            return found
        return f"{found}\n\nnot told one by one, but as expected of the size: {', '.join(self.untold)}"


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
    no payload. A gain of the torques that is off by some part makes mass and inertia wrong by the same part.

    Args:
        empty: the arm without payload, from `identify`.
        motions: motions with payload, from `smooth`; or joint positions [rows, n] [rad or m], one row after the other
            in time: their correlation is part of the errors.
        qd, qdd, tau: joint velocities [rad/s or m/s], accelerations [rad/s^2 or m/s^2] and measured torques [N m or N],
            [rows, n], beside positions.
        frame: name of the frame that holds it; None: the end effector.
        friction, offset: allow viscous and Coulomb friction and the offset of every joint to have changed since, where
            the motion is long enough to tell: of less than 10 s they take some of the payload.
        size: extent of the payload [m] that is expected where the motion does not tell: radius of gyration about its
            centre of mass in each direction.
        prior: weight of this expectation, positive, as in `identify`.
        reference: q, qd, qdd and tau of the empty arm, long enough to show by how much and for how long its torques are
            wrong, as `stack_samples(motion)` gives them: a few seconds with payload cannot, and their errors come out
            too small without.

    Raises:
        ArgumentError: a shape, a value that is not finite, or a frame that no joint moves, or whose motion does not
            tell a mass, as that of the first links.
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
    if not isinstance(empty, Identified):
        raise ArgumentError(f"empty must be what identify returns, found {type(empty).__name__}")
    robot = empty.robot
    batch, rows = recorded(robot, motions, qd, qdd, tau=tau)
    if not all(torch.tensor(rows.known_gains).expand(robot.n)):
        cure = "multiply them by the gains that Model(gains=True) of identify found"
        raise ArgumentError(f"tau of the motions must be torques, found efforts of unknown gains; {cure}")
    if len(batch) != 1 or not batch[0]:
        raise ArgumentError(
            f"q must have the shape [rows, {robot.n}] with a row at least, found the batch axes {batch}"
        )
    require_finite(**rows.signals())
    require_number("size", size, positive=True)
    require_number("prior", prior, positive=True)
    at = robot.end_effector() if frame is None else robot.frame(frame)
    if at.link == BASE:
        raise ArgumentError(f"frame must be one that a joint moves, found {at.name!r} on the base")
    with torch.no_grad(), Notice("identifying the payload"):
        alone = empty.predict(motions, qd, qdd).tau
        q, qd, qdd, tau = (x.cpu() for x in (rows.q, rows.qd, rows.qdd, rows.measured))
        Y = regressor(robot.to(DTYPE, "cpu"), q, qd, qdd)
        own = Y[..., 10 * at.link : 10 * at.link + 10] @ moved(at.X_BF.to("cpu", DTYPE))
        untold = _untold(robot, at.name, own)
        sign = smooth_sign(qd, empty.sign_width) if rows.direction is None else rows.direction.cpu()
        units = [qd, sign] * friction + [torch.ones_like(qd)] * offset
        rest = torch.cat([torch.diag_embed(x) for x in units], -1) if units else own[..., :0]
        residual = tau - alone.to(tau)
        variance, correlation = _wrong(empty, reference)
        weight, point = _weighted(torch.cat([own[..., :4], rest], -1), residual, variance, correlation)
        mass = point[0].maximum(_error(torch.cat([own[..., :4], rest], -1), weight))
        J = _expected(mass, (point[1:4] / mass).clamp(-10 * size, 10 * size), size)
        pi, covariance = _found(own, rest, residual, weight, J, prior, Y @ empty.by_these_gains().spread[: Y.shape[-1]])
        rms, before = (_left(Z, residual, weight) for Z in (torch.cat([own, rest], -1), rest))
        usual = torch.hypot(variance.sqrt(), empty.model)
        if doubt := _doubts(empty, (q, qd, qdd, tau), rms, usual):
            warnings.warn(doubt, LogWarning, stacklevel=3)
    quantities = central(pseudo_inertia(pi))
    slopes = torch.autograd.functional.jacobian(_quantities, pi)
    errors = (slopes @ covariance @ slopes.T).diagonal().sqrt()
    mass, com, inertia = (x.to(robot.mass) for x in quantities)
    held = robot.with_payload(mass, com, inertia, at.name)
    return IdentifiedPayload(held, at.name, *quantities, errors[0], errors[1:4], errors[4:], rms, before, untold)


def _untold(robot: Robot, frame: str, own: Tensor) -> tuple[str, ...]:
    """Inertial parameters that torques per unit of them [rows, n, 10] do not tell alone; raises if the mass is one."""
    Z = own.flatten(0, 1)
    size = Z.square().mean(0).sqrt()
    size = torch.where(size > 1e-9 * size.max(), size, 0.0)
    Z = Z / torch.where(size > 0, size, torch.inf)
    e, V = torch.linalg.eigh(Z.T @ Z)
    inverse = torch.where(size > 0, 1 / size, 0.0)
    base = base_parameters(V[:, e > INDEPENDENT * e[-1]].T * size, inverse)
    alone = ((base != 0).sum(1) == 1).nonzero()[:, 0].tolist()
    told = {int(base[row].argmax()) for row in alone}
    if 0 not in told:
        found = ", ".join(sums(base, INERTIAL, inverse)) or "nothing"
        expected = f"one of {robot.name!r} whose motion tells the mass of what it holds"
        raise ArgumentError(
            f"frame must be {expected}, found {frame!r}, whose motion tells {found} of its parameters about the frame; "
            "give one nearer to the end effector, or longer motion"
        )
    return tuple(name for k, name in enumerate(INERTIAL) if k not in told)


def _doubts(empty: Identified, rows: Sequence[Tensor], rms: Tensor, usual: Tensor) -> str:
    """Words for what is probably wrong with rows (q, qd, qdd, tau) that no payload explains; "" for nothing."""
    robot, tau = empty.robot.to(DTYPE, "cpu"), rows[3]
    rigid = partial(inverse_dynamics, robot)
    told = (rms > WORSE * usual) & (rms > MATTERS * tau.square().mean(0).sqrt())
    if not bool(told.any()):
        return ""
    off = [
        f"{name} ({x:.1f} times)"
        for name, x, yes in zip(robot.joint_names, (rms / usual).tolist(), told.tolist(), strict=True)
        if yes
    ]
    found = f"no payload explains the torques: residuals are larger than those of the empty arm at {', '.join(off)}"
    cure = (
        merged(diagnose(robot, rigid, rows, empty.sign_width))
        or "is a sign, gain or column another than then, or the body elsewhere?"
    )
    return f"{found}; the payload may be wrong beyond its errors: {cure}"


def _quantities(pi: Tensor) -> Tensor:
    """Mass, centre of mass and inertia about it [10] of inertial parameters [10]."""
    mass, com, inertia = central(pseudo_inertia(pi))
    return torch.cat([mass[None], com, inertia])


def _wrong(empty: Identified, reference: Sequence[Tensor] | None) -> tuple[Tensor, Tensor]:
    """Least variance [n] of the residual torques and their least correlation time [n], in rows."""
    if reference is None:
        return empty.noise.square(), torch.ones_like(empty.noise)
    if len(reference) != 4:
        raise ArgumentError(f"reference must be q, qd, qdd and tau of the empty arm, found {len(reference)} tensors")
    q, qd, qdd, tau = (x.detach().to("cpu", DTYPE) for x in reference)
    left = tau - empty.predict(q, qd, qdd).tau
    return left.square().mean(0), _correlation(left)


def _weighted(Z: Tensor, residual: Tensor, variance: Tensor, correlation: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [n] of the joints, one over variance and correlation time of what is left, and least squares with them.

    `Z` are torques per unit [rows, n, p], `residual` is [rows, n]; variance and correlation time are at least as given.
    """
    weight = 1 / (variance * correlation)
    for _ in range(ROUNDS):
        x = _solved(Z, residual, weight)
        left = residual - Z @ x
        before = weight
        weight = 1 / (left.square().mean(0).maximum(variance) * _correlation(left).maximum(correlation))
        if float((weight / before - 1).abs().max()) < 1e-3:
            break
    return weight, x


def _solved(Z: Tensor, residual: Tensor, weight: Tensor) -> Tensor:
    """Weighted least squares [p], the smallest of them where some combination is not told."""
    A = (weight.sqrt()[:, None] * Z).flatten(0, 1)
    size = A.norm(dim=0)
    size = torch.where(size > 0, size, 1.0)
    b = (weight.sqrt() * residual).flatten()
    return torch.linalg.lstsq(A / size, b[:, None], driver="gelsd").solution[:, 0] / size


def _error(Z: Tensor, weight: Tensor) -> Tensor:
    """Standard error [] of the first parameter of weighted least squares."""
    A = (weight.sqrt()[:, None] * Z).flatten(0, 1)
    size = A.norm(dim=0).clamp_min(1e-30)
    return torch.linalg.pinv((A / size).T @ (A / size), hermitian=True)[0, 0].sqrt() / size[0]


def _left(Z: Tensor, residual: Tensor, weight: Tensor) -> Tensor:
    """Root mean squares [n] of what least squares leave."""
    left = residual - Z @ _solved(Z, residual, weight) if Z.shape[-1] else residual
    return left.square().mean(0).sqrt()


def _correlation(x: Tensor) -> Tensor:
    """Correlation times [n] of signals [rows, n], in rows: 1 + 2 times the correlations while they are positive."""
    x = x - x.mean(0)
    spectrum = torch.fft.rfft(x, n=2 * len(x), dim=0).abs().square()
    r = torch.fft.irfft(spectrum, dim=0)[: len(x)]
    r = r / r[0].clamp_min(1e-300)
    return 1 + 2 * (r[1:] * (r[1:] > 0).cumprod(0)).sum(0)


def _expected(mass: Tensor, com: Tensor, size: float) -> Tensor:
    """Pseudo-inertia [4, 4] of a body with radii of gyration `size` about its centre of mass."""
    whole = torch.cat([torch.ones(1, dtype=DTYPE), com])
    J = mass * torch.outer(whole, whole)
    J[1:, 1:] += mass * size**2 * torch.eye(3, dtype=DTYPE)
    return J


def _found(
    own: Tensor, rest: Tensor, residual: Tensor, weight: Tensor, J: Tensor, prior: float, model: Tensor
) -> tuple[Tensor, Tensor]:
    """Inertial parameters [10] of the payload with their covariance.

    `own` [rows, n, 10] and `rest` [rows, n, p] are torques per unit of the payload's parameters and of the changes, `J`
    is the body that is expected, and `model` [rows, n, t] are the errors of the empty arm's torques.
    """
    C = torch.linalg.cholesky(J)
    blocks = inertial_parameters(C @ ENTRIES @ C.T)  # [10 entries, 10 parameters]
    typical = residual.square().mean().sqrt() / rest.square().mean((0, 1)).sqrt().clamp_min(1e-30)
    Z = torch.cat([own @ blocks.T, rest * (typical / NUISANCE)], -1)
    off = own @ inertial_parameters(J) - residual
    A, b, model = ((weight.sqrt()[:, None] * x).flatten(0, 1) for x in (Z, off[..., None], model))
    Q, R = torch.linalg.qr(A)
    scale = 1 / math.sqrt(prior)
    y = nearest(scale * R[None], scale * (Q.T @ b)[None, :, 0], 1, 0)
    H = curvature(y, 1, 0)[1][0] / 2 * prior + R.T @ R
    size = H.diagonal().rsqrt()
    inverse = size[:, None] * torch.cholesky_inverse(torch.linalg.cholesky(size[:, None] * H * size)) * size
    errors = inverse @ (R.T @ (Q.T @ model))
    covariance = (inverse + errors @ errors.T)[:10, :10]
    pi = inertial_parameters(C @ relative(y, 1)[0, 0] @ C.T)
    return pi, blocks.T @ covariance @ blocks
