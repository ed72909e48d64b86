"""Excitation trajectories: motions whose torques have the most information about the parameters of an arm.

Torques are linear in the base parameters, tau = Z(q, qd, qdd) beta, so that the information I of a motion about them,
the sum of z z^T / noise^2 over the rows z of Z, is known before it is recorded. log det I is maximised: the best motion
does not depend on units (J. Swevers et al., "Optimal robot excitation and identification", IEEE Transactions on
Robotics and Automation 13 (1997)). Motions are Fourier series that keep position, velocity and acceleration by
construction (`fourier`); torques and workspace are limited in the search (`search`).
"""

import math
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import require_count, require_number, require_object, tensor_of
from torchdq.base.tables import table
from torchdq.errors import ArgumentError
from torchdq.learning.excitation.fourier import Family, Series
from torchdq.learning.excitation.information import BaseParameters, States
from torchdq.learning.excitation.limits import Bounds, MotionLimits
from torchdq.learning.excitation.search import Search, described_torques
from torchdq.learning.identification.base_parameters import base_names, inverse_of
from torchdq.learning.identification.identified import INERTIAL
from torchdq.learning.logs.motions import Motion
from torchdq.learning.plots import picture_of_motion
from torchdq.learning.threads import one_thread
from torchdq.robot import Robot
from torchdq.robot.argument import require_bodies, require_single

FASTEST = 1.0  # [Hz] highest frequency of a motion, where no period is given: drives follow it, filters pass it
LENGTHS = 4  # periods that are tried, where none is given
STATES = 300  # random states, on whose torques the base parameters are chosen
DTYPE = torch.float64


class Excitation(NamedTuple):
    """Motion with the most information about a robot's parameters, at even times, with the errors that it leaves.

    `base`, `base_names` and `base_errors` are as those of `Identified`. The errors hold if the torques of every row
    have independent noise of the standard deviation `parameters.noise`, and nothing else is wrong. Printed, it is their
    table. What an identification made of the same combinations is `found.base @ identified.parameters`, with the errors
    `(found.base @ identified.spread).norm(dim=1)`, if it estimated the same coefficients: its own `base` has the
    combinations that are identifiable from its samples.
    """

    series: Series  # the motion at all times
    time: Tensor  # [rows], from 0 to the end [s]
    q: Tensor  # [rows, n] [rad or m]
    qd: Tensor  # [rows, n] [rad/s or m/s]
    qdd: Tensor  # [rows, n] [rad/s^2 or m/s^2]
    tau: Tensor  # [rows, n] torques of the description, friction included [N m or N]
    bounds: Bounds  # limits that are kept
    parameters: BaseParameters
    base_errors: Tensor  # [rank] standard errors, each in the unit of the parameter that leads
    condition: float  # condition number of the matrix of all torques per unit of the base parameters, over the noise

    @property
    def names(self) -> tuple[str, ...]:
        """Names [k] of all parameters, of bodies and then of friction, in the order of `Identified.names`."""
        robot = self.parameters.robot
        bodies = [f"{link} {name}" for link in robot.link_names for name in INERTIAL]
        return (*bodies, *(f"{joint} {name}" for name in self.parameters.coefficients for joint in robot.joint_names))

    @property
    def base(self) -> Tensor:
        """Base parameters as combinations [rank, k] of all parameters."""
        return self.parameters.base

    @property
    def base_names(self) -> tuple[str, ...]:
        """Base parameters as sums, `link2 Izz + 0.0825 link3 mx`, of at most three terms."""
        return base_names(self.base, self.names, inverse_of(self.parameters.sizes))

    def __repr__(self) -> str:
        seconds, n, name = float(self.time[-1]), self.q.shape[1], self.parameters.robot.name
        return f"Excitation({name}: {seconds:g} s of {n} joints for {len(self.base_errors)} base parameters)"

    def __str__(self) -> str:
        rows = [(name, f"{e:.2g}") for name, e in zip(self.base_names, self.base_errors.tolist(), strict=True)]
        used = (("velocity", self.qd, self.bounds.velocity), ("torque", self.tau, self.bounds.effort))
        parts = ", ".join(f"{name} {float((x.abs() / most).max()):.0%}" for name, x, most in used)
        facts = f"period {2 * math.pi / float(self.series.rate):.4g} s, condition number {self.condition:.3g}"
        return f"{self!r}\n{facts}, most that is used: {parts}\n\n{table(('parameter', 'standard error'), rows)}"

    def sampled(self, rate: float) -> Motion:
        """Motion at another rate [Hz], from 0 to the end, with the torques of the description."""
        require_number("rate", rate, positive=True)
        rows = _rows(self.parameters.robot, self.series, float(self.time[-1]), rate)
        time, q, qd, qdd, tau = (x.numpy() for x in rows)
        return Motion(time, q, qd, qdd, tau)

    def to_csv(self, path: str | PathLike[str], rate: float | None = None) -> None:
        """Write columns time, q1 ..., qd1 ..., tau1 ..., qdd1 ..., which `read` reads; torques are as described.

        Args:
            path: path of the file.
            rate: rows per second [Hz]; None: as `time`.
        """
        motion, signals = self if rate is None else self.sampled(rate), ("q", "qd", "tau", "qdd")
        rows = np.column_stack([getattr(motion, name) for name in ("time", *signals)])
        heads = ["time", *(f"{name}{j + 1}" for name in signals for j in range(self.q.shape[1]))]
        np.savetxt(path, rows, fmt="%.12g", delimiter=",", header=",".join(heads), comments="")

    def plot(self) -> Any:
        """Figure of positions, velocities and torques of all joints with their limits, by matplotlib."""
        return picture_of_motion(self.parameters.robot, self.time, self.q, self.qd, self.tau, self.bounds)


@one_thread()
def excitation_trajectory(
    robot: Robot,
    seconds: float,
    limits: MotionLimits | None = None,
    *,
    harmonics: int = 5,
    period: float | None = None,
    restarts: int = 256,
    noise: Any = None,
    rate: float = 100.0,
    friction: bool = True,
    armature: bool = False,
    offset: bool = False,
    width: float = 1e-2,
    seed: int = 0,
) -> Excitation:
    """Motion whose torques have the most information about base parameters and friction of a robot, as `Excitation`.

    It starts and ends at rest, repeats itself, and keeps the limits at all times, not only in its rows: positions,
    velocities and accelerations by a bound for trigonometric polynomials; torques and workspace on a fine grid of
    times, with the greatest curvature between them. Torques are those of the description.

    Args:
        robot: the robot as described, without batch axes.
        seconds: length of the motion [s].
        limits: limits that the motion keeps; None: 90 % of the robot's own.
        harmonics: number of harmonics of every joint, at least 2.
        period: time after which the motion repeats itself, a whole part of `seconds` [s]; None: the best of some by
            which no frequency is above 1 Hz.
        restarts: number of random motions from which the search starts. The better quarter takes more steps, and of
            these the better quarter still more.
        noise: standard deviation of the torques' noise [N m or N], one number or one per joint; None: 1 % of the
            greatest torques. The errors are proportional to it; the motion depends on its ratios between joints.
        rate: rows per second, in which the noise is independent [Hz].
        friction, armature, offset, width: parameters to identify, as in `identify`.
        seed: seed of the random motions.
    Raises:
        ArgumentError: a limit of a joint is missing, or no motion keeps them.

    >>> import torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> limits = MotionLimits(lower=-1.0, upper=1.0, velocity=2.0, effort=60.0)
    >>> found = excitation_trajectory(robot, 10.0, limits, restarts=8)
    >>> found.q.shape, bool(found.qd.abs().max() < 1.8), len(found.base_names)
    (torch.Size([1001, 2]), True, 10)
    """
    for name, x in (("seconds", seconds), ("rate", rate), ("width", width)):
        require_number(name, x, positive=True)
    for name, count, least in (("harmonics", harmonics, 2), ("restarts", restarts, 1), ("seed", seed, 0)):
        require_count(name, count, least)
    limits = MotionLimits() if limits is None else limits
    require_object("limits", limits, MotionLimits, "torchdq.learning", "MotionLimits(velocity=1.0)")
    require_bodies(require_single(robot), "excitation")
    robot = robot.to(DTYPE, "cpu").bake()
    bounds = limits.bounds(robot)
    coefficients = ["rotor"] * armature + ["viscous", "coulomb"] * friction + ["offset"] * offset
    repeats = _repeats(seconds, period, harmonics)
    generator = torch.Generator().manual_seed(seed)
    states = _states(bounds, generator)
    parameters = BaseParameters.of(robot, coefficients, width, _noise(robot, noise, bounds), states)
    family = Family(bounds, harmonics)
    w = (2 * math.pi / seconds * repeats)[torch.arange(restarts) % len(repeats)]
    series = Search(family, parameters, limits).best(family.start(restarts, generator), w)
    rows = _rows(robot, series, seconds, rate)
    errors, condition = parameters.errors(*rows[1:4]), parameters.condition(*rows[1:4])
    return Excitation(series, *rows, bounds, parameters, errors, condition)


def _noise(robot: Robot, given: Any, bounds: Bounds) -> Tensor:
    """Standard deviations [n] of the torques' noise."""
    noise = 0.01 * bounds.effort if given is None else tensor_of(given).detach().to("cpu", DTYPE)
    if noise.ndim > 1 or (noise.ndim == 1 and len(noise) != robot.n) or not bool((noise > 0).all()):
        raise ArgumentError(f"noise must be one positive number or {robot.n}, found {given!r}")
    return noise.expand(robot.n)


def _repeats(seconds: float, period: float | None, harmonics: int) -> Tensor:
    """Numbers of periods that are tried."""
    if period is None:
        most = max(1, math.floor(FASTEST * seconds / harmonics))
        return torch.tensor(sorted({math.ceil(most * (i + 1) / LENGTHS) for i in range(LENGTHS)})).to(DTYPE)
    require_number("period", period, positive=True)
    repeats = max(1, round(seconds / period))
    if abs(seconds / period - repeats) > 1e-9 * repeats:
        expected = "a whole part of seconds, for the motion to end at rest"
        cure = f"give seconds={repeats * period:g}"
        raise ArgumentError(f"period must be {expected}, found {period:g} s of {seconds:g} s; {cure}")
    return torch.tensor([repeats]).to(DTYPE)


def _states(bounds: Bounds, generator: torch.Generator) -> States:
    """Random positions, velocities and accelerations [states, n] within bounds."""
    u = 2 * torch.rand(3, STATES, len(bounds.lower), dtype=DTYPE, generator=generator) - 1
    reach = (bounds.upper - bounds.lower) / 2
    return bounds.upper - reach + reach * u[0], bounds.velocity * u[1], bounds.velocity.square() / reach * u[2]


def _rows(robot: Robot, series: Series, seconds: float, rate: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Time, positions, velocities, accelerations and torques of the description, friction included, at even times."""
    time = torch.arange(math.floor(seconds * rate * (1 + 1e-12)) + 1, dtype=DTYPE) / rate
    q, qd, qdd = series.at(series.rate * time)
    return time, q, qd, qdd, described_torques(robot, q, qd, qdd) + robot.friction * qd.sign()
