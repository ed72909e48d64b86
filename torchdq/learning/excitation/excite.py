"""Motions worth recording: those whose torques tell most about the parameters of an arm.

Torques are linear in the base parameters, tau = Z(q, qd, qdd) beta (`base`), so that the information of a motion about
them is known before it is recorded:

    I = sum over samples and joints of z z^T / noise^2,   z: row of Z.

log det I is sought: it measures the region that beta is then known to lie in, and the best motion does not depend on
units (J. Swevers et al., "Optimal robot excitation and identification", IEEE Transactions on Robotics and Automation 13
(1997)). Motions are Fourier series that keep position, velocity and acceleration by construction (`fourier`); torques
and workspace cost what exceeds them, and are checked in the end. Many starts are improved together, as rows of a batch,
with exact gradients; the worse ones are dropped on the way.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import require_count, require_number, tensor_of
from torchdq.base.progress import Notice
from torchdq.base.tables import table
from torchdq.errors import ArgumentError
from torchdq.functional import inverse_dynamics
from torchdq.learning.excitation.fourier import Family, Series, grid
from torchdq.learning.excitation.limits import Bounds, MotionLimits
from torchdq.learning.identification.base import BaseParameters
from torchdq.learning.logs.motions import Motion
from torchdq.learning.plots import picture_of_motion
from torchdq.learning.threads import one_thread
from torchdq.robot import Robot
from torchdq.robot.argument import require_bodies, require_robot
from torchdq.robot.model import batches

STAGES = ((1, 10), (4, 30), (16, 60), (64, 240))  # part of the starts, one in so many, and the steps that it takes
LEFT = 4  # starts that take all steps, at least
STEP = 0.25  # step width of the numbers of a motion; it falls to a tenth in the last stage
FASTEST = 1.0  # [Hz] highest frequency of a motion, where no period is given: drives follow it, filters pass it
LENGTHS = 4  # periods that are tried, where none is given
SAMPLED = 10  # points of the period per harmonic, for the mean of the information
FINE = 400  # points of the period per harmonic at which torques and workspace are checked
NEAR = 0.02  # part of the greatest torque, and [m] of the workspace, from which on the search is held back
FIRM = 1e4  # cost of the square of what exceeds
ROWS = 16  # motions at a time, whose numbers a processor's cache holds
STATES = 300  # random states, which tell the base parameters
FAINT = 1e-10  # information beside that of a motion, relative to random states: a start may tell nothing of some
HALVINGS = 12  # halvings of the interval that holds the largest size of a motion
DTYPE = torch.float64


class Excitation(NamedTuple):
    """Motion that tells most about a robot's parameters, at even times, with the errors that it leaves.

    `base`, `base_names` and `base_errors` are as those of `Identified`. The errors hold if the torques of every row
    have independent noise of the standard deviation `parameters.noise`, and nothing else is wrong. Printed, it is their
    table. What an identification made of the same combinations is `found.base @ identified.parameters`, with the errors
    `(found.base @ identified.spread).norm(dim=1)`, if it sought the same coefficients: its own `base` has combinations
    of its own, those that its samples tell.
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
        return self.parameters.every_name

    @property
    def base(self) -> Tensor:
        """Base parameters as combinations [rank, k] of all parameters."""
        return self.parameters.base

    @property
    def base_names(self) -> tuple[str, ...]:
        """Base parameters as sums, `link2 Izz + 0.0825 link3 mx`, of at most three terms."""
        return self.parameters.names

    def __repr__(self) -> str:
        seconds, n, name = float(self.time[-1]), self.q.shape[1], self.parameters.robot.name
        return f"Excitation({name}: {seconds:g} s of {n} joints for {len(self.base_errors)} base parameters)"

    def __str__(self) -> str:
        rows = [(name, f"{e:.2g}") for name, e in zip(self.base_names, self.base_errors.tolist(), strict=True)]
        used = (("velocity", self.qd, self.bounds.velocity), ("torque", self.tau, self.bounds.effort))
        parts = ", ".join(f"{name} {float((x.abs() / most).max()):.0%}" for name, x, most in used)
        facts = f"period {float(self.series.period):.4g} s, condition number {self.condition:.3g}"
        return f"{self!r}\n{facts}, most that is used: {parts}\n\n{table(('parameter', 'standard error'), rows)}"

    def sampled(self, rate: float) -> Motion:
        """Motion at another rate [Hz], from 0 to the end, with the torques of the description."""
        require_number("rate", rate, positive=True)
        return _motion(_rows(self.parameters.robot, self.series, float(self.time[-1]), rate))

    def to_csv(self, path: str | PathLike[str], rate: float | None = None) -> None:
        """Write columns time, q1 ..., qd1 ..., tau1 ..., qdd1 ..., which `read` reads; torques are as described.

        Args:
            path: path of the file.
            rate: rows per second [Hz]; None: as `time`.
        """
        motion = _motion((self.time, self.q, self.qd, self.qdd, self.tau)) if rate is None else self.sampled(rate)
        signals = {name: getattr(motion, name) for name in ("q", "qd", "tau", "qdd")}
        heads = ["time", *(f"{name}{j + 1}" for name, x in signals.items() for j in range(x.shape[1]))]
        rows = np.column_stack([motion.time, *signals.values()])
        np.savetxt(path, rows, fmt="%.12g", delimiter=",", header=",".join(heads), comments="")

    def plot(self) -> Any:
        """Figure of positions, velocities and torques of all joints beside their limits, by matplotlib."""
        return picture_of_motion(self.parameters.robot, self.time, self.q, self.qd, self.tau, self.bounds)


@one_thread()
def excite(
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
    """Motion whose torques tell most about the base parameters and the friction of a robot, as `Excitation`.

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
        friction, armature, offset, width: parameters to be told, as in `identify`.
        seed: seed of the random motions.
    Raises:
        ArgumentError: a limit of a joint is missing, or no motion keeps them.

    >>> import torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> limits = MotionLimits(lower=-1.0, upper=1.0, velocity=2.0, effort=60.0)
    >>> found = excite(robot, 10.0, limits, restarts=8)
    >>> found.q.shape, bool(found.qd.abs().max() < 1.8), len(found.base_names)
    (torch.Size([1001, 2]), True, 10)
    """
    for name, x in (("seconds", seconds), ("rate", rate), ("width", width)):
        require_number(name, x, positive=True)
    for name, count, least in (("harmonics", harmonics, 2), ("restarts", restarts, 1), ("seed", seed, 0)):
        require_count(name, count, least)
    limits = MotionLimits() if limits is None else limits
    if not isinstance(limits, MotionLimits):
        raise ArgumentError(f"limits must be MotionLimits, found {type(limits).__name__}")
    for name, axes in batches(require_robot(robot)).items():
        raise ArgumentError(f"{name} of robot {robot.name!r} has batch axes {axes}; find motions for one at a time")
    require_bodies(robot, "excitation")
    robot = robot.to(DTYPE, "cpu").bake()
    bounds = limits.bounds(robot)
    coefficients = ["rotor"] * armature + ["viscous", "coulomb"] * friction + ["offset"] * offset
    repeats = _repeats(seconds, period, harmonics)
    generator = torch.Generator().manual_seed(seed)
    states = _states(bounds, generator)
    parameters = BaseParameters.of(robot, coefficients, width, _noise(robot, noise, bounds), states)
    with Notice(f"finding a motion for {robot.name}") as notice:
        family = Family(bounds, harmonics)
        numbers = family.start(restarts, generator)
        w = (2 * math.pi / seconds * repeats)[torch.arange(restarts) % len(repeats)]
        for k, (part, steps) in enumerate(STAGES):
            kept, last = max(min(LEFT, restarts), restarts // part), k + 1 == len(STAGES)
            say = notice.within(f"stage {k + 1} of {len(STAGES)}")
            numbers, w = _improved(family, numbers[:kept], w[:kept], parameters, limits, steps, last, say)
        notice.at("checking the limits")
        series = _fitted(family.motions(numbers, w), parameters, limits, bounds, FINE * harmonics)
    time, q, qd, qdd, tau = _rows(robot, series, seconds, rate)
    errors, condition = parameters.errors(q, qd, qdd), parameters.condition(q, qd, qdd)
    return Excitation(series, time, q, qd, qdd, tau, bounds, parameters, errors, condition)


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


def _states(bounds: Bounds, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Random positions, velocities and accelerations [states, n] within bounds."""
    u = 2 * torch.rand(3, STATES, len(bounds.lower), dtype=DTYPE, generator=generator) - 1
    reach = (bounds.upper - bounds.lower) / 2
    return bounds.upper - reach + reach * u[0], bounds.velocity * u[1], bounds.velocity.square() / reach * u[2]


def _torques(robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Torques [..., n] of the description with its viscous friction: smooth in time, as the dry friction is not."""
    return inverse_dynamics(robot, q, qd, qdd) + robot.damping * qd


def _improved(
    family: Family,
    x: Tensor,
    w: Tensor,
    parameters: BaseParameters,
    limits: MotionLimits,
    steps: int,
    last: bool,
    say: Callable[[str], None],
) -> tuple[Tensor, Tensor]:
    """Numbers of motions [rows, n, 2 H] after some steps, and their base frequencies, the best ones first."""
    robot, phases = parameters.robot, grid(SAMPLED * family.harmonics)
    x = x.clone().requires_grad_()
    method = torch.optim.Adam([x], STEP, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(method, steps, STEP / 10 if last else STEP)

    def cost(x: Tensor, w: Tensor) -> Tensor:
        motion = family.motions(x, w).at(phases)
        A = parameters.information(*motion) + FAINT * torch.eye(len(parameters.leading), dtype=DTYPE)
        gain = 2 * torch.linalg.cholesky_ex(A).L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        used = (_torques(robot, *motion).abs() + robot.friction) / family.bounds.effort
        beyond = (used - 1 + NEAR).relu().square().sum((-2, -1))
        beyond = beyond + (NEAR - limits.clearance(robot, motion[0])).relu().square().sum((-2, -1))
        return FIRM * beyond - gain

    def parts() -> Iterator[tuple[Tensor, Tensor]]:
        return zip(x.split(ROWS), w.split(ROWS), strict=True)

    for step in range(steps):
        say(f"step {step + 1} of {steps}")
        x.grad = torch.cat([torch.autograd.grad(cost(*part).sum(), part[0])[0] for part in parts()])
        method.step()
        schedule.step()
    with torch.no_grad():
        order = torch.cat([cost(*part) for part in parts()]).nan_to_num(nan=torch.inf).argsort()
        return x.detach()[order], w[order]


def _exceeded(robot: Robot, series: Series, limits: MotionLimits, bounds: Bounds, points: int) -> tuple[Tensor, Tensor]:
    """Greatest torques over their limits [rows, n], and least clearances [rows, c], at all times.

    A function is beyond the line between two points by an eighth of its second difference there, but for higher
    derivatives; a quarter of the greatest is added.
    """
    motion = series.at(grid(points))

    def between(x: Tensor) -> Tensor:
        return (x.roll(1, -2) - 2 * x + x.roll(-1, -2)).abs().amax(-2) / 4

    torque, clearance = _torques(robot, *motion), limits.clearance(robot, motion[0])
    most = torque.abs().amax(-2) + between(torque) + robot.friction
    return most / bounds.effort, clearance.amin(-2) - between(clearance)


def _fitted(series: Series, parameters: BaseParameters, limits: MotionLimits, bounds: Bounds, points: int) -> Series:
    """Best of the motions, each as large as torques and workspace let it be."""
    robot = parameters.robot

    def fits(size: Tensor) -> Tensor:
        used, clearance = _exceeded(robot, series.shrunk(size), limits, bounds, points)
        return (used <= 1).all(-1) & (clearance >= 0).all(-1)

    with torch.no_grad():
        large = torch.ones(len(series.rate), dtype=DTYPE)
        small = torch.where(fits(large), large, 0.0)
        for _ in range(HALVINGS if bool((small < 1).any()) else 0):
            middle = (small + large) / 2
            inside = fits(middle)
            small, large = torch.where(inside, middle, small), torch.where(inside, large, middle)
        if not bool((small > 0).any()):
            _refuse(robot, series, limits, bounds, points)
        series = series.shrunk(small)
        A = parameters.information(*series.at(grid(SAMPLED * series.sine.shape[-1])))
        gain = torch.where(small > 0, torch.linalg.slogdet(A).logabsdet, -torch.inf)
        return Series(*(part[gain.argmax()] for part in series))


def _refuse(robot: Robot, series: Series, limits: MotionLimits, bounds: Bounds, points: int) -> None:
    """Raise, with the limit that no motion keeps."""
    used, clearance = _exceeded(
        robot, series.shrunk(torch.zeros(len(series.rate), dtype=DTYPE)), limits, bounds, points
    )
    joint = used[0].argmax()
    found = (
        f"joint {robot.joint_names[joint]!r} needs {float(used[0, joint] * bounds.effort[joint]):.3g} of "
        f"{float(bounds.effort[joint]):.3g} N m"
    )
    if bool((used[0] <= 1).all()):
        found = f"the workspace is left by {-float(clearance[0].min()):.3g} m"
    cure = "give MotionLimits with a larger effort, or a range of positions that the arm can hold in its workspace"
    raise ArgumentError(f"limits of robot {robot.name!r} let no motion be: at its middle, {found}; {cure}")


def _motion(rows: Sequence[Tensor]) -> Motion:
    time, q, qd, qdd, tau = (x.numpy() for x in rows)
    return Motion(time, q, qd, qdd, tau)


def _rows(robot: Robot, series: Series, seconds: float, rate: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Time, positions, velocities, accelerations and torques of the description, friction included, at even times."""
    time = torch.arange(math.floor(seconds * rate * (1 + 1e-12)) + 1, dtype=DTYPE) / rate
    q, qd, qdd = series.at(series.rate * time)
    return time, q, qd, qdd, _torques(robot, q, qd, qdd) + robot.friction * qd.sign()
