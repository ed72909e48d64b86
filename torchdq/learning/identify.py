"""Masses, centres of mass, inertias and friction of an arm from recorded motions, by least squares that stay physical.

Joint torques are linear in everything that is sought,

    tau = Y(q, qd, qdd) pi + rotor qdd + viscous qd + coulomb qd / sqrt(qd^2 + width^2) + offset = Z phi,

so all that the samples say is in one small matrix per joint, the sum of [Z tau]^T [Z tau], however many there are. The
answer minimises

    sum over samples and joints of (residual / noise of the joint)^2  +  prior * distance to the description

over robots that can exist: a link exists if its pseudo-inertia J = integral of (1, p) (1, p)^T dm is positive definite,
which says that the mass is positive and the inertia obeys the triangle inequality. The distance of a link is

    2 (tr B - log det B - 4),   B = J described by J_0 = C C^T:  B = C^-1 J C^-T,

about |B - 1|^2 for small changes, the same in all axes and units, and infinite where a body stops to exist (T. Lee, P.
Wensing, F. C. Park, "Geometric robot dynamic identification: a convex programming approach", T-RO 36 (2020)). That of a
coefficient of friction is 2 (x - log x - 1), x being its ratio to the described one. All of it is convex in phi, so
that there is one minimum, and Newton's method finds it in the manner of interior-point methods.
"""

import itertools
import math
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.functional import check, regressor, require_finite
from torchdq.robot import Robot
from torchdq.robot.robot import SHAPES

INERTIAL = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")  # of a link, about its frame
THIN = 1e-2  # least extent of a body over its size: coordinates of points, rods and plates would be infinite
SMALL = 0.1  # part of the joint's torques that an effect the description does not know is taken to be
COARSE = 1e-2  # the same where there are too few samples to estimate it
FAINT = 1e-3  # weight of the description while the noise is estimated: nothing beside a few samples
EXACT = 1e-5  # least noise over the joint's torques; what is weighted by less costs more digits than it gives
INDEPENDENT = 1e-13  # least eigenvalue, over the largest, of a combination that the samples tell: beyond rounding
CHUNK = 2**22  # numbers of the regressor that are held at a time
ITERATIONS = 200
ROUNDS = 10  # of weighting joints anew


class Prediction(NamedTuple):
    """Torques with their standard errors, each [..., n]."""

    tau: Tensor  # [N m or N]
    error: Tensor  # [N m or N], of the prediction; the noise of a measurement comes on top


class Identified(NamedTuple):
    """What `identify` found.

    `parameters` are phi [k] with the names `names`: ten per link in the order of `Robot.inertial_parameters`, then
    rotor inertias, viscous, Coulomb and offset, of all joints each, those that were asked for.

    `covariance` [k, k] is that of the least squares with the prior, linearised at the description: its diagonal is the
    squared standard error that noise of the found size, independent from sample to sample, leaves. Smoothed signals
    are not independent: keep about two samples per period of the filter's cutoff, or the errors come out too small.
    What the samples cannot tell has the width of the prior instead, the described size over sqrt(prior), which is
    large, and right as long as the description is not off by more; that the robot must be physical narrows it further
    and is not counted. Single masses and inertias are mostly
    of that kind. What the samples do tell are `rank` combinations, the base parameters `base` @ `parameters`.
    """

    robot: Robot  # baked; its damping and friction are those below, its rotor inertia the one found
    viscous: Tensor | None  # [n] [N m s/rad or N s/m]
    coulomb: Tensor | None  # [n] [N m or N]
    offset: Tensor | None  # [n] [N m or N]
    names: tuple[str, ...]  # of the k parameters
    parameters: Tensor  # [k]
    spread: Tensor  # [k, t] F, the covariance being F F^T: exact where huge errors cancel in a combination
    base: Tensor  # [rank, k]: each row one parameter and what the samples cannot tell from it
    noise: Tensor  # [n] standard deviation of a torque's residual, by which the joints were weighted [N m or N]
    rms: Tensor  # [n] root mean square of what is left unexplained [N m or N]
    width: float  # of the Coulomb friction [rad/s or m/s]

    @property
    def rank(self) -> int:
        """Number of combinations of parameters that the samples tell."""
        return len(self.base)

    @property
    def covariance(self) -> Tensor:
        """Covariance of the parameters [k, k]; see the class for what it means."""
        return self.spread @ self.spread.T

    @property
    def errors(self) -> Tensor:
        """Standard errors of the parameters [k]; see the class for what they mean."""
        return self.spread.norm(dim=1)

    @property
    def base_names(self) -> tuple[str, ...]:
        """The base parameters as sums, `link2 Izz + 0.0825 link3 mx`, of at most three terms."""
        names = []
        for row in self.base:
            lead = int((row == 1).nonzero()[0]) if bool((row == 1).any()) else int(row.abs().argmax())
            others = [i for i in row.nonzero()[:, 0].tolist() if i != lead]
            terms = [self.names[lead]]
            for i in sorted(others, key=lambda i: -abs(float(row[i] * self.errors[i])))[:2]:
                size = f"{abs(float(row[i])):.3g} " if abs(abs(float(row[i])) - 1) > 1e-6 else ""
                terms.append(f"{'-' if row[i] < 0 else '+'} {size}{self.names[i]}")
            names.append(" ".join(terms) + (" ..." if len(others) > 2 else ""))
        return tuple(names)

    @property
    def base_errors(self) -> Tensor:
        """Standard errors of the base parameters [rank]."""
        return (self.base @ self.spread).norm(dim=1)

    def predict(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Prediction:
        """Torques of the identified robot, friction and offset included, [..., n], with standard errors.

        Args:
            q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
                shape [..., n].
        """
        batch = check(self.robot, q=q, qd=qd, qdd=qdd)
        n = self.robot.n
        rows = [x.detach().to(torch.float64).expand(*batch, n).reshape(-1, n) for x in (q, qd, qdd)]
        asked = [name.split()[-1] for name in self.names[10 * n :: n]]
        tau, error = torch.empty_like(rows[0]), torch.empty_like(rows[0])
        with torch.no_grad():
            for part in _chunks(len(tau), n * len(self.names)):
                Z = _columns(self.robot, rows[0][part], rows[1][part], rows[2][part], asked, self.width)
                error[part] = (Z @ self.spread).norm(dim=-1)
                tau[part] = Z @ self.parameters
                if self.robot.armature is not None and "rotor" not in asked:
                    tau[part] += self.robot.armature.to(torch.float64) * rows[2][part]
        return Prediction(tau.reshape(*batch, n), error.reshape(*batch, n))


def identify(
    robot: Robot,
    q: Tensor,
    qd: Tensor,
    qdd: Tensor,
    tau: Tensor,
    friction: bool = True,
    offset: bool = False,
    armature: bool = False,
    prior: float = 1.0,
    width: float = 1e-2,
) -> Identified:
    """The robot, as `Identified`, that explains measured torques best and can exist.

    Joints are weighted by the noise that least squares leave in each. A link without mass stays without; a body
    described as a point, a rod or a plate gets 1 % of its size as thickness. Friction and rotor inertia that the
    description does not give make 10 % of the joint's torques where the samples do not say otherwise. Solving costs
    the same for any number of samples, and they are read in pieces.

    Args:
        robot: the robot as described, without batch axes.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
            shape [..., n]: every row is a sample, in any order.
        tau: measured joint torques [N m or N], shape [..., n].
        friction: seek viscous and Coulomb friction, or take the joints to have none.
        offset: seek a constant torque of every joint.
        armature: seek the rotor inertia of every joint, or leave it as described.
        prior: weight of the description: a change of 1 / sqrt(prior), in units of what is described, costs as much as
            one torque that is off by the noise of its joint. What hundreds of samples tell does not depend on it, what
            they hardly tell stays near the description, and what they do not tell stays as described. Positive.
        width: velocity below which Coulomb friction is viscous, as in `torchdq.effects.Coulomb` [rad/s or m/s].

    Raises:
        ArgumentError: a shape, a device, a value that is not finite, no samples, or a robot with batch axes.

    >>> import torch, torchdq
    >>> described = torchdq.robots.load("two_link")
    >>> real = described.replace(mass=1.3 * described.mass)
    >>> q, qd, qdd = torch.randn(3, 100, 2, dtype=torch.float64)
    >>> found = identify(described, q, qd, qdd, torchdq.inverse_dynamics(real, q, qd, qdd), friction=False)
    >>> torch.allclose(found.predict(q, qd, qdd).tau, torchdq.inverse_dynamics(real, q, qd, qdd), atol=1e-6)
    True
    """
    batch = check(robot, q=q, qd=qd, qdd=qdd, tau=tau)
    n, samples = robot.n, math.prod(batch)
    for name in SHAPES:
        x = getattr(robot, name)
        if x is not None and x.ndim > len(SHAPES[name]):
            raise ArgumentError(
                f"{name} of robot {robot.name!r} has batch axes {tuple(x.shape)}; identify one at a time"
            )
    if not samples or not n:
        raise ArgumentError(f"at least one sample and one joint are needed, found {samples} samples of {n} joints")
    for name, value in (("prior", prior), ("width", width)):
        if not (value > 0 and math.isfinite(value)):
            raise ArgumentError(f"{name} must be positive and finite, found {value}")
    require_finite(q=q, qd=qd, qdd=qdd, tau=tau)

    asked = ["rotor"] * armature + ["viscous", "coulomb"] * friction + ["offset"] * offset
    with torch.no_grad():
        rows = [x.detach().to(torch.float64).expand(*batch, n).reshape(-1, n) for x in (q, qd, qdd, tau)]
        space = _Space(robot, asked, rows, width)
        gram = _gram(robot, rows, space, asked, width)
        squares, floor = rows[3].square().mean(0).cpu(), torch.zeros(n, dtype=torch.float64)
        for _ in range(ROUNDS):
            told = _told(gram, space.S, squares, floor, samples)
            y, settled = _minimum(space, told, prior)
            change = space.S @ y
            error = torch.cat([-change, change.new_ones(1)])
            rms = ((gram @ error) @ error / samples).clamp_min(0).sqrt()
            # least squares may explain a joint by what cannot exist; what such a robot cannot do is noise
            worse = rms > 2 * told.noise
            floor = torch.where(worse, rms, floor)
            if settled and not bool(worse.any()):
                break
        if not settled:
            warnings.warn(f"the least squares have not settled after {ITERATIONS} iterations", stacklevel=2)
        phi = space.described + change
        found = dict(zip(asked, phi[10 * n :].reshape(-1, n), strict=True))
        return Identified(
            _replaced(robot, *space.bodies(y), found),
            found.get("viscous"),
            found.get("coulomb"),
            found.get("offset"),
            (
                *(f"{link} {name}" for link in robot.link_names for name in INERTIAL),
                *(f"{joint} {name}" for name in asked for joint in robot.joint_names),
            ),
            phi,
            space.S @ told.V * (told.e + prior).rsqrt(),
            _base(told.V[:, told.e > 0].T @ space.inverse, space.S.norm(dim=1)),
            told.noise,
            rms,
            width,
        )


# --- what the samples say --------------------------------------------------------------------------------------------


def _chunks(samples: int, numbers: int) -> list[slice]:
    """Pieces of samples of so many numbers each."""
    size = max(1, CHUNK // numbers)
    return [slice(i, i + size) for i in range(0, samples, size)]


def _effect(name: str, qd: Tensor, qdd: Tensor, width: float) -> Tensor:
    """Torque [samples, n] per unit of a parameter that each joint has one of."""
    if name == "coulomb":
        return qd / (qd * qd + width * width).sqrt()
    return {"rotor": qdd, "viscous": qd, "offset": torch.ones_like(qd)}[name]


def _columns(robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor, asked: Sequence[str], width: float) -> Tensor:
    """Z [samples, n, k]: torque per unit of every parameter."""
    effects = [torch.diag_embed(_effect(name, qd, qdd, width)) for name in asked]
    return torch.cat([regressor(robot, q, qd, qdd), *effects], -1)


def _gram(robot: Robot, rows: Sequence[Tensor], space: "_Space", asked: Sequence[str], width: float) -> Tensor:
    """Sums [n, k + 1, k + 1] of [Z d]^T [Z d], d being what the described parameters leave of tau."""
    q, qd, qdd, tau = rows
    n, phi = robot.n, space.described.to(q)
    gram = q.new_zeros(n, len(phi) + 1, len(phi) + 1)
    for part in _chunks(len(q), n * len(phi)):
        Z = _columns(robot, q[part], qd[part], qdd[part], asked, width)
        left = tau[part] - Z @ phi
        if robot.armature is not None and "rotor" not in asked:
            left -= robot.armature.to(q) * qdd[part]
        Z = torch.cat([Z, left[..., None]], -1).transpose(0, 1)
        gram += Z.mT @ Z
    return gram.cpu()


class _Told(NamedTuple):
    """What the samples say about y = V w: the sum of e (w - w_0)^2."""

    e: Tensor  # [t], zero where they say nothing
    V: Tensor  # [t, t]
    w: Tensor  # [t] w_0
    noise: Tensor  # [n]


def _told(gram: Tensor, S: Tensor, squares: Tensor, floor: Tensor, samples: int) -> _Told:
    """Least squares with every joint weighted by the noise that it leaves there.

    Weights and solution follow from each other (restricted maximum likelihood): an estimate of the noise divides by
    the samples less the parameters they were spent on. A joint's share of those is its part of the trace of the
    matrix that takes measured torques to fitted ones. `floor` [n] is the least noise.
    """
    A, b, c = S.T @ gram[:, :-1, :-1] @ S, gram[:, :-1, -1] @ S, gram[:, -1, -1]
    squares = squares.clamp_min(1e-6 * float(squares.max()))
    squares = torch.where(squares > 0, squares, 1.0)  # torques that vanish say the same at any weight
    # what is told does not depend on the weights, and is clearest where they differ least
    e, Q = torch.linalg.eigh((A / squares[:, None, None]).sum(0))
    told = e > INDEPENDENT * e.amax()
    P = Q[:, told]
    A, b = P.T @ A @ P, b @ P
    least = squares * (EXACT if samples * len(c) >= 2 * P.shape[1] else COARSE) ** 2
    least = least.maximum(floor**2)
    variance = (c / samples).maximum(least)
    for _ in range(50):
        e, V = torch.linalg.eigh((A / variance[:, None, None]).sum(0))
        inverse = (V / (e.clamp_min(0) + FAINT)) @ V.T
        y = inverse @ (b / variance[:, None]).sum(0)
        left = (c - 2 * b @ y + (A @ y) @ y).clamp_min(0)
        spent = (A * inverse).sum((1, 2)) / variance
        before, variance = variance, (left / (samples - spent).clamp_min(1e-3 * samples)).maximum(least)
        if float((variance / before - 1).abs().max()) < 1e-3:
            break
    e, V = torch.linalg.eigh((A / variance[:, None, None]).sum(0))
    e = torch.where(e > 1e-15 * e.amax(), e, 0.0)
    w = torch.where(e > 0, V.T @ (b / variance[:, None]).sum(0) / torch.where(e > 0, e, 1.0), 0.0)
    nothing = torch.zeros(int((~told).sum()), dtype=e.dtype)
    return _Told(torch.cat([nothing, e]), torch.cat([Q[:, ~told], P @ V], 1), torch.cat([nothing, w]), variance.sqrt())


def _base(R: Tensor, size: Tensor) -> Tensor:
    """Rows [rank, k] that span those of R [rank, k], what is told, each with a one where all others have a zero.

    The ones are chosen from the first link on, among columns that are nearly as independent of those chosen as any.
    """
    rank = len(R)
    R = R * size
    left, chosen = R.clone(), list[int]()
    for _ in range(rank):
        norms = left.norm(dim=0)
        chosen.append(int((norms > 0.1 * norms.max()).nonzero()[0]))
        direction = left[:, chosen[-1]] / norms[chosen[-1]]
        left -= direction[:, None] * (direction @ left)
        left[:, chosen] = 0
    chosen.sort()
    base = torch.linalg.solve(R[:, chosen], R) if rank else R
    base = size[chosen, None] * base / torch.where(size > 0, size, 1.0)
    base = torch.where((base * size).abs() > 1e-8 * size[chosen, None], base, 0.0)
    base[:, chosen] = torch.eye(rank, dtype=base.dtype)
    return base


# --- robots that can exist -------------------------------------------------------------------------------------------


class _Space:
    """Parameters phi = phi_0 + S y around a described robot, and how far y [t] is from it.

    Ten numbers of y are the entries of B - 1 of a link with mass, one the change of a coefficient over its size.
    """

    def __init__(self, robot: Robot, asked: Sequence[str], rows: Sequence[Tensor], width: float):
        mass, com, inertia = (getattr(robot, name).detach().double().cpu() for name in ("mass", "com", "inertia"))
        if not bool((mass >= 0).all()):
            raise ArgumentError(f"mass of robot {robot.name!r} must not be negative, found {mass.tolist()}")
        self.com, self.links = com, mass.nonzero()[:, 0]
        self.factor = _factor(mass[self.links], com[self.links], inertia[self.links])
        self.start, signed = _sizes(robot, asked, rows, width)
        self.effects = self.start.nonzero()[:, 0]
        self.signed = signed[self.effects]
        if not len(self.links) + len(self.effects):
            raise ArgumentError(f"robot {robot.name!r} has no mass, and there is nothing else to seek")

        C, k = self.factor[:, None], 10 * len(mass) + len(self.start)
        blocks = _parameters(C @ ENTRIES @ C.mT).mT  # [links, 10 parameters, 10 entries]
        self.described = torch.zeros(k, dtype=torch.float64)
        pi = self.described[: 10 * len(mass)].reshape(-1, 10)
        pi[self.links] = _parameters(self.factor @ self.factor.mT)
        self.described[10 * len(mass) :] = torch.where(signed, 0.0, self.start)
        self.S = torch.zeros(k, 10 * len(self.links) + len(self.effects), dtype=torch.float64)
        self.inverse = torch.zeros_like(self.S).T  # y of a change of phi
        for i, link in enumerate(self.links.tolist()):
            own, columns = slice(10 * i, 10 * i + 10), slice(10 * link, 10 * link + 10)
            self.S[columns, own], self.inverse[own, columns] = blocks[i], torch.linalg.inv(blocks[i])
        at, of = 10 * len(self.links) + torch.arange(len(self.effects)), 10 * len(mass) + self.effects
        self.S[of, at], self.inverse[at, of] = self.start[self.effects], 1 / self.start[self.effects]

    def _split(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """B [links, 4, 4] and the ratio of every coefficient to its size."""
        bodies = 10 * len(self.links)
        B = torch.eye(4, dtype=y.dtype) + torch.einsum("li,ijk->ljk", y[:bodies].reshape(-1, 10), ENTRIES)
        return B, 1 + y[bodies:]

    def distance(self, y: Tensor) -> float:
        """Distance to the description; infinite where a robot cannot exist."""
        B, x = self._split(y)
        L, info = torch.linalg.cholesky_ex(B)
        if bool((info != 0).any()) or not bool((self.signed | (x > 0)).all()):
            return math.inf
        diagonal = L.diagonal(dim1=1, dim2=2)
        bodies = (B.diagonal(dim1=1, dim2=2) - 1 - 2 * diagonal.log()).sum()
        return float(2 * bodies + torch.where(self.signed, (x - 1).square(), 2 * (x - 1 - x.abs().log())).sum())

    def slopes(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [t] and Hessian [t, t] of the distance."""
        B, x = self._split(y)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(B))
        turned = inverse[:, None] @ ENTRIES
        gradient = 2 * torch.einsum("ljk,ijk->li", torch.eye(4, dtype=y.dtype) - inverse, ENTRIES).flatten()
        H = 2 * torch.einsum("lijk,lmkj->lim", turned, turned)
        x = torch.where(self.signed, 1.0, x)
        rest = torch.where(self.signed, 2 * y[len(gradient) :], 2 - 2 / x)
        return torch.cat([gradient, rest]), torch.block_diag(*H, torch.diag(2 / x**2))

    def bodies(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mass [n], centre of mass [n, 3] and inertia about it [n, 6] of the links."""
        L = self.factor @ torch.linalg.cholesky(self._split(y)[0])
        mass, com, inertia = self.com.new_zeros(len(self.com)), self.com.clone(), self.com.new_zeros(len(self.com), 6)
        mass[self.links] = L[:, 0, 0] ** 2
        com[self.links] = L[:, 1:, 0] / L[:, :1, 0]
        inertia[self.links] = _inertia(L[:, 1:, 1:] @ L[:, 1:, 1:].mT)  # a square, so it can exist, rounded or not
        return mass, com, inertia


def _entries() -> Tensor:
    """Orthonormal basis [10, 4, 4] of the symmetric matrices."""
    basis = torch.zeros(10, 4, 4, dtype=torch.float64)
    for k, (i, j) in enumerate(itertools.combinations_with_replacement(range(4), 2)):
        basis[k, i, j] = basis[k, j, i] = 1.0 if i == j else math.sqrt(0.5)
    return basis


ENTRIES = _entries()


def _factor(mass: Tensor, com: Tensor, inertia: Tensor) -> Tensor:
    """C [links, 4, 4], lower triangular, of the pseudo-inertias C C^T, all thick enough to have one."""
    second = _second(inertia)  # about the centre of mass
    trace = second.diagonal(dim1=1, dim2=2).sum(-1).clamp_min(0)
    whole = float(((trace + mass * com.square().sum(-1)).sum() / mass.sum()).sqrt()) if len(mass) else 0.0
    size = (trace / mass).sqrt().clamp_min(0.1 * (whole or 1.0))  # [m]
    moments, axes = torch.linalg.eigh(second)
    thick = moments.maximum((mass * (THIN * size) ** 2)[:, None])
    changed = (thick != moments).any(-1)
    second = torch.where(changed[:, None, None], (axes * thick[:, None]) @ axes.mT, second)
    C = torch.zeros(len(mass), 4, 4, dtype=torch.float64)
    C[:, 0, 0] = mass.sqrt()
    C[:, 1:, 0] = mass.sqrt()[:, None] * com
    C[:, 1:, 1:] = torch.linalg.cholesky(second)
    return C


def _sizes(robot: Robot, asked: Sequence[str], rows: Sequence[Tensor], width: float) -> tuple[Tensor, Tensor]:
    """Size of every coefficient, zero where nothing can be said, and whether it may have either sign."""
    _, qd, qdd, tau = rows
    described = {"rotor": robot.armature, "viscous": robot.damping, "coulomb": robot.friction}
    sizes = [torch.zeros(0, dtype=torch.float64)]
    for name in asked:
        torque, unit = (x.square().mean(0).sqrt().cpu() for x in (tau, _effect(name, qd, qdd, width)))
        large = torch.where(unit > 0, torque / torch.where(unit > 0, unit, 1.0), 0.0)  # as large as the torques
        x = described.get(name)
        known = torch.zeros_like(large) if x is None else x.detach().double().cpu()
        sizes.append(large if name == "offset" else torch.where(known > 0, known, SMALL * large))
    signed = torch.tensor([name == "offset" for name in asked for _ in range(robot.n)], dtype=torch.bool)
    return torch.cat(sizes), signed


def _parameters(J: Tensor) -> Tensor:
    """Inertial parameters [..., 10] of pseudo-inertias [..., 4, 4], the mass in their first entry."""
    return torch.cat([J[..., 0], _inertia(J[..., 1:, 1:])], -1)


def _inertia(second: Tensor) -> Tensor:
    """Inertia [..., 6] (xx xy yy xz yz zz) of second moments [..., 3, 3]."""
    x, y, z = second.diagonal(dim1=-2, dim2=-1).unbind(-1)
    xy, xz, yz = second[..., 0, 1], second[..., 0, 2], second[..., 1, 2]
    return torch.stack([y + z, -xy, x + z, -xz, -yz, x + y], -1)


def _second(inertia: Tensor) -> Tensor:
    """Second moments [..., 3, 3] of an inertia [..., 6]."""
    xx, xy, yy, xz, yz, zz = inertia.unbind(-1)
    half = (xx + yy + zz) / 2
    numbers = [half - xx, -xy, -xz, -xy, half - yy, -yz, -xz, -yz, half - zz]
    return torch.stack(numbers, -1).reshape(*inertia.shape[:-1], 3, 3)


def _replaced(robot: Robot, mass: Tensor, com: Tensor, inertia: Tensor, found: dict[str, Tensor]) -> Robot:
    """The robot with what was found, in its own dtype and on its own device."""
    changes = dict(mass=mass, com=com, inertia=inertia)
    names = {"rotor": "armature", "viscous": "damping", "coulomb": "friction"}
    changes |= {names[name]: x for name, x in found.items() if name in names}
    return robot.replace(**{name: x.to(robot.mass) for name, x in changes.items()}).bake()


# --- the minimum -----------------------------------------------------------------------------------------------------


def _minimum(space: _Space, told: _Told, prior: float) -> tuple[Tensor, bool]:
    """y [t] that minimises the sum of e (w - w_0)^2 and prior * distance, with y = V w, and whether it was reached.

    Newton's method from the description, the weight of the distance falling tenfold at a time.
    """
    e, V, w_0 = told.e, told.V, told.w
    w, weight = torch.zeros_like(w_0), max(prior, float(e.amax()))

    def cost(w: Tensor) -> float:
        return float((e * (w - w_0).square()).sum()) + weight * space.distance(V @ w)

    for _ in range(ITERATIONS):
        slope, bend = space.slopes(V @ w)
        gradient, H = 2 * e * (w - w_0) + weight * (slope @ V), torch.diag(2 * e) + weight * (V.T @ bend @ V)
        scale = H.diagonal().rsqrt()  # the samples' part may be 1e20 times the other
        factor = torch.linalg.cholesky(scale[:, None] * H * scale)
        step = -scale * torch.cholesky_solve((scale * gradient)[:, None], factor)[:, 0]
        before, promised = cost(w), float(-gradient @ step)
        settled = promised <= (0.1 if weight > prior else 1e-12) * weight + 1e-14 * before
        length = 1.0
        while not settled and cost(w + length * step) > before - 1e-4 * length * promised:
            length /= 2
            settled = length < 1e-9  # by rounding
        if not settled:
            w = w + length * step
        elif weight == prior:
            return V @ w, True
        else:
            weight = max(prior, weight / 10)
    return V @ w, False
