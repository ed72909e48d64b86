"""Masses, centres of mass, inertias and friction of an arm from recorded motions, by least squares that stay physical.

Joint torques are linear in all parameters,

    tau = Y(q, qd, qdd) pi + rotor qdd + viscous qd + coulomb qd / sqrt(qd^2 + width^2) + offset = Z phi.

The answer minimises

    sum over samples and joints of (residual / noise of the joint)^2  +  prior * distance to the description

over robots that can exist (`feasible`); the samples enter by one small matrix per joint (`regression`). All of it is
convex in phi, so that there is one minimum, and Newton's method finds it in the manner of interior-point methods.
"""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.checks import require_number
from torchdq.errors import ArgumentError
from torchdq.functional import check, require_finite
from torchdq.learning.feasible import Neighbourhood
from torchdq.learning.plausibility import LogWarning, doubts, misshapen, sampled, unexplained
from torchdq.learning.regression import Information, base_parameters, chunks, columns, gram, information
from torchdq.notice import Notice
from torchdq.robot import Robot
from torchdq.robot.argument import require_bodies
from torchdq.robot.robot import batches
from torchdq.tables import summary, table

INERTIAL = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")  # parameters of a link, about its frame
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)
# units of the coefficients of a joint that turns, and of one that slides
JOINT_UNITS = {
    "rotor": ("kg m^2", "kg"),
    "viscous": ("N m s/rad", "N s/m"),
    "coulomb": ("N m", "N"),
    "offset": ("N m", "N"),
}
EXCITED = 0.9  # least part of a parameter's variance that the samples take away where they excite it
ITERATIONS = 200  # most Newton steps of a minimum
ROUNDS = 10  # most times that the joints are weighted anew


class Prediction(NamedTuple):
    """Torques with their standard errors, each [..., n]."""

    tau: Tensor  # [N m or N]
    error: Tensor  # [N m or N], of the prediction; the noise of a measurement comes on top

    def __repr__(self) -> str:
        return summary("Prediction", {name: (x, "N m or N") for name, x in self._asdict().items()})


class Identified(NamedTuple):
    """Identified robot with its parameters and their errors.

    `parameters` are phi [k] with the names `names`: ten per link in the order of `Robot.inertial_parameters`, then
    rotor inertias, viscous, Coulomb and offset, of all joints each, those that were sought.

    `covariance` [k, k] is that of the least squares with the prior, linearised at the description: its diagonal is the
    squared standard error that noise of the found size, independent from sample to sample, leaves. Smoothed signals
    are not independent: keep about two samples per period of the filter's cutoff, by `rate` of `smooth`, or the
    errors come out too small.
    Parameters that the samples do not identify have the width of the prior instead, the described size over
    sqrt(prior), which is large, and right as long as the description is not off by more; that the robot must be
    physical narrows it further and is not counted. Single masses and inertias are mostly of that kind; `excited` tells
    them from the others. The samples identify `rank` combinations, the base parameters `base` @ `parameters`.

    Printed, it is a table of the parameters.
    """

    robot: Robot  # baked; its damping and friction are those below, its rotor inertia the one found
    viscous: Tensor | None  # [n] [N m s/rad or N s/m]
    coulomb: Tensor | None  # [n] [N m or N]
    offset: Tensor | None  # [n] [N m or N]
    names: tuple[str, ...]  # [k] names of the parameters
    parameters: Tensor  # [k]
    spread: Tensor  # [k, t] F, the covariance being F F^T: exact where huge errors cancel in a combination
    base: Tensor  # [rank, k]: each row one parameter and those that the samples cannot separate from it
    noise: Tensor  # [n] standard deviation of a torque's residual, by which the joints were weighted [N m or N]
    rms: Tensor  # [n] root mean square of the residual torque [N m or N]
    width: float  # width of the Coulomb friction [rad/s or m/s]
    excited: Tensor  # [k] bool: parameters that the samples decide, not the prior; false if the joint hardly moves

    @property
    def rank(self) -> int:
        """Number of combinations of parameters that the samples identify."""
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
        """Base parameters as sums, `link2 Izz + 0.0825 link3 mx`, of at most three terms."""
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

    def __repr__(self) -> str:
        return f"Identified({self.robot.name}: {len(self.names)} parameters, {self.rank} combinations of them told)"

    def __str__(self) -> str:
        title = f"{self.robot.name}, identified: {self.rank} combinations of {len(self.names)} parameters are told"
        numbers = zip(self.names, self._units, self.parameters, self.errors, self.excited, strict=True)
        rows = [(name, f"{x:.4g}", f"{e:.2g}", unit, "yes" if told else "no") for name, unit, x, e, told in numbers]
        parameters = table(("parameter", "estimate", "standard error", "unit", "excited"), rows)
        residuals = summary("residual", {"rms": (self.rms, "N m or N"), "noise": (self.noise, "N m or N")})
        return f"{title}\n\n{parameters}\n\n{residuals}"

    @property
    def _units(self) -> list[str]:
        """Units of the parameters [k]."""
        slides = [not joint.turns for joint in self.robot.joint_types]
        return [
            *UNITS * len(self.robot.link_names),
            *(JOINT_UNITS[name][joint] for name in self._coefficients for joint in slides),
        ]

    @property
    def _coefficients(self) -> list[str]:
        """Kinds of the parameters that are not those of bodies, each with one per joint."""
        return [name.split()[-1] for name in self.names[10 * len(self.robot.link_names) :: self.robot.n]]

    def predict(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Prediction:
        """Torques of the identified robot, friction and offset included, [..., n], with standard errors.

        Args:
            q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
                shape [..., n].
        """
        batch, (q, qd, qdd) = _rows(self.robot, q=q, qd=qd, qdd=qdd)
        n, coefficients = self.robot.n, self._coefficients
        tau, error = torch.empty_like(q), torch.empty_like(q)
        with torch.no_grad():
            for part in chunks(len(tau), n * len(self.names)):
                some = (q[part], qd[part], qdd[part])
                error[part] = (columns(self.robot, *some, coefficients, self.width) @ self.spread).norm(dim=-1)
                tau[part] = _torques(self.robot, *some, self.parameters, coefficients, self.width)
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
    direction: Tensor | None = None,
) -> Identified:
    """Physically consistent robot that explains measured torques best, as `Identified`.

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
        prior: weight of the description, positive: a change of 1 / sqrt(prior), relative to the described value, costs
            as much as one torque that is off by the noise of its joint. What hundreds of samples identify does not
            depend on it, what they hardly identify stays near the description, the rest stays as described.
        width: velocity below which Coulomb friction is viscous, as in `torchdq.effects.Coulomb` [rad/s or m/s].
        direction: sign of the velocities, filtered as the torques were, shape [..., n]: `directions(motion)`. Filters
            round the steps of dry friction in the torques, and beside sharp signs Coulomb friction comes out too small,
            viscous friction too large. Give `smooth` the same `width`: the one here then only serves predictions and
            simulation. None: qd / sqrt(qd^2 + width^2), for torques that are not filtered. A `LogWarning` names joints
            whose friction has another shape than this, for which both numbers are biased beyond their errors.

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
    signals = {"q": q, "qd": qd, "qdd": qdd, "tau": tau} | ({} if direction is None else {"direction": direction})
    batch, rows = _rows(robot, **signals)
    n, samples, bodies = robot.n, math.prod(batch), 10 * len(robot.link_names)
    for name, axes in batches(robot).items():
        raise ArgumentError(f"{name} of robot {robot.name!r} has batch axes {axes}; identify one at a time")
    if not samples or not n:
        raise ArgumentError(f"at least one sample and one joint are needed, found {samples} samples of {n} joints")
    require_number("prior", prior, positive=True)
    require_number("width", width, positive=True)
    require_finite(**signals)
    require_bodies(robot, "identification")

    coefficients = ["rotor"] * armature + ["viscous", "coulomb"] * friction + ["offset"] * offset
    with torch.no_grad(), _solvable(signals), Notice(f"identifying {robot.name}") as notice:
        near = Neighbourhood(robot, coefficients, rows[:4], width)
        moves = _moving(robot, rows[1], width)
        if doubt := _doubts(robot, rows[:4], near.described, width):
            warnings.warn(doubt, LogWarning, stacklevel=2)
        sums = gram(robot, rows, near.described, coefficients, width, notice.at)
        squares, floor = rows[3].square().mean(0).cpu(), torch.zeros(n, dtype=torch.float64)
        for k in range(ROUNDS):
            notice.at(f"minimum {k + 1} of at most {ROUNDS}")
            facts = information(sums, near.S, squares, floor, samples)
            y, settled = _minimum(near, facts, prior)
            change = near.S @ y
            error = torch.cat([-change, change.new_ones(1)])
            rms = ((sums @ error) @ error / samples).clamp_min(0).sqrt()
            # least squares may explain a joint by a robot that cannot exist; what a physical one cannot do is noise
            worse = rms > 2 * facts.noise
            floor = torch.where(worse, rms, floor)
            if settled and not bool(worse.any()):
                break
        if not settled:
            warnings.warn(f"the least squares have not settled after {ITERATIONS} iterations", stacklevel=2)
        phi = near.described + change
        few, signs = (kept := sampled(rows))[:4], kept[4] if direction is not None else None
        fitted = _torques(robot, few[0], few[1], few[2], phi, coefficients, width, signs)
        late = unexplained(robot.joint_names, few, fitted, width)
        if friction and not late:
            late = misshapen(robot.joint_names, few, fitted, width, signs)
        if late and not doubt:
            warnings.warn(late, LogWarning, stacklevel=2)
        found = dict(zip(coefficients, phi[bodies:].reshape(-1, n), strict=True))
        spread = near.S @ facts.V * (facts.e + prior).rsqrt()
        names = [f"{link} {name}" for link in robot.link_names for name in INERTIAL]
        return Identified(
            robot=_replaced(robot, *near.bodies(y), found),
            viscous=found.get("viscous"),
            coulomb=found.get("coulomb"),
            offset=found.get("offset"),
            names=(*names, *(f"{joint} {name}" for name in coefficients for joint in robot.joint_names)),
            parameters=phi,
            spread=spread,
            base=base_parameters(facts.V[:, facts.e > 0].T @ near.inverse, near.S.norm(dim=1)),
            noise=facts.noise,
            rms=rms,
            width=width,
            excited=_excited(spread, near.S.norm(dim=1) / math.sqrt(prior), moves, coefficients),
        )


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
            stacklevel=3,
        )
    return fastest > width


def _torques(
    robot: Robot,
    q: Tensor,
    qd: Tensor,
    qdd: Tensor,
    parameters: Tensor,
    coefficients: Sequence[str],
    width: float,
    direction: Tensor | None = None,
) -> Tensor:
    """Torques [samples, n] of parameters phi; rotors are those of the description if they are not among these."""
    tau = columns(robot, q, qd, qdd, coefficients, width, direction) @ parameters.to(q)
    if robot.armature is not None and "rotor" not in coefficients:
        tau += robot.armature.to(q) * qdd
    return tau


def _doubts(robot: Robot, rows: Sequence[Tensor], described: Tensor, width: float) -> str:
    """Words for what is wrong with samples that the description does not explain; "" for nothing."""

    def torques(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        return _torques(robot, q, qd, qdd, described[: 10 * len(robot.link_names)], (), width)

    return doubts(torques, robot.joint_names, sampled(rows), width)


def _excited(spread: Tensor, prior: Tensor, moves: Tensor, coefficients: list[str]) -> Tensor:
    """Parameters [k] whose variance the samples reduce to a tenth of that by the prior alone, at joints that move.

    `prior` [k] are the standard errors without samples: zero for a link without mass, and for what no sample moves.
    """
    left = spread.square().sum(1) / prior.square().where(prior > 0, 1.0)
    own = [moves if name != "offset" else torch.ones_like(moves) for name in coefficients]
    inertial = torch.ones(len(prior) - len(own) * len(moves), dtype=torch.bool)
    return (prior > 0) & (left < 1 - EXCITED) & torch.cat([inertial, *own])


def _rows(robot: Robot, **signals: Tensor) -> tuple[tuple[int, ...], list[Tensor]]:
    """Batch axes of signals [..., n], and the signals as float64 rows [samples, n]."""
    batch = check(robot, (), **signals)
    rows = (x.detach().to(torch.float64).expand(*batch, robot.n) for x in signals.values())
    return batch, [x.reshape(math.prod(batch), robot.n) for x in rows]


def _replaced(robot: Robot, mass: Tensor, com: Tensor, inertia: Tensor, found: dict[str, Tensor]) -> Robot:
    """Robot with the parameters found, in its own dtype and on its own device."""
    changes = dict(mass=mass, com=com, inertia=inertia)
    names = {"rotor": "armature", "viscous": "damping", "coulomb": "friction"}
    changes |= {names[name]: x for name, x in found.items() if name in names}
    return robot.replace(on_unphysical="warn", **{name: x.to(robot.mass) for name, x in changes.items()}).bake()


def _minimum(near: Neighbourhood, facts: Information, prior: float) -> tuple[Tensor, bool]:
    """Minimum y [t] of the sum of e (w - w_0)^2 and prior * distance, with y = V w, and whether it was reached.

    Newton's method from the description, the weight of the distance falling tenfold at a time.
    """
    e, V, w_0 = facts.e, facts.V, facts.w
    w, weight = torch.zeros_like(w_0), max(prior, float(e.amax()))

    def cost(w: Tensor) -> float:
        return float((e * (w - w_0).square()).sum()) + weight * near.distance(V @ w)

    for _ in range(ITERATIONS):
        slope, curvature = near.slopes(V @ w)
        gradient, H = 2 * e * (w - w_0) + weight * (slope @ V), torch.diag(2 * e) + weight * (V.T @ curvature @ V)
        scale = H.diagonal().rsqrt()  # the samples' part may be 1e20 times the prior's
        factor = torch.linalg.cholesky(scale[:, None] * H * scale)
        step = -scale * torch.cholesky_solve((scale * gradient)[:, None], factor)[:, 0]
        before, expected = cost(w), float(-gradient @ step)
        settled = expected <= (0.1 if weight > prior else 1e-12) * weight + 1e-14 * before
        length = 1.0
        while not settled and cost(w + length * step) > before - 1e-4 * length * expected:
            length /= 2
            settled = length < 1e-9  # by rounding
        if not settled:
            w = w + length * step
        elif weight == prior:
            return V @ w, True
        else:
            weight = max(prior, weight / 10)
    return V @ w, False
