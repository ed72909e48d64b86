"""Search for the Fourier series with the greatest information, log det I, within limits of torque and workspace.

Torques and workspace cost what exceeds their limits, and are checked in the end. Many starts are improved together, as
rows of a batch, with exact gradients; the worse ones are dropped on the way.
"""

from collections.abc import Iterator
from typing import NamedTuple, NoReturn

import torch
from torch import Tensor

from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.functional import inverse_dynamics
from torchdq.learning.excitation.fourier import Family, Series, grid
from torchdq.learning.excitation.information import BaseParameters
from torchdq.learning.excitation.limits import MotionLimits
from torchdq.robot import Robot

STAGES = ((1, 10), (4, 30), (16, 60), (64, 240))  # part of the starts, one in so many, and the steps that it takes
STEP = 0.25  # step width of the numbers of a motion; it falls to a tenth in the last stage
SAMPLED = 10  # points of the period per harmonic, for the mean of the information
FINE = 400  # points of the period per harmonic at which torques and workspace are checked
NEAR = 0.02  # part of the greatest torque, and [m] of the workspace, from which on the search is held back
ROWS = 16  # motions at a time, whose numbers a processor's cache holds
DTYPE = torch.float64


class Search(NamedTuple):
    """Motions of a family, to be improved for parameters within limits."""

    family: Family
    parameters: BaseParameters
    limits: MotionLimits

    def best(self, numbers: Tensor, w: Tensor) -> Series:
        """Best motion found from numbers [starts, n, 2 H] with base frequencies [starts] [rad/s]."""
        starts = len(numbers)
        with Progress(f"finding a motion for {self.parameters.robot.name}") as progress:
            for k, (part, steps) in enumerate(STAGES):
                left, say = max(min(4, starts), starts // part), progress.within(f"stage {k + 1} of {len(STAGES)}")
                last = k + 1 == len(STAGES)
                x, w = numbers[:left].clone().requires_grad_(), w[:left]
                method = torch.optim.Adam([x], STEP, betas=(0.9, 0.99))
                schedule = torch.optim.lr_scheduler.CosineAnnealingLR(method, steps, STEP / 10 if last else STEP)
                for step in range(steps):
                    say(f"step {step + 1} of {steps}")
                    slopes = [torch.autograd.grad(self.cost(*part).sum(), part[0])[0] for part in _parts(x, w)]
                    x.grad = torch.cat(slopes)
                    method.step()
                    schedule.step()
                with torch.no_grad():
                    order = torch.cat([self.cost(*part) for part in _parts(x, w)]).nan_to_num(nan=torch.inf).argsort()
                numbers, w = x.detach()[order], w[order]
            progress.at("checking the limits")
            return self.largest(self.family.motions(numbers, w))

    def cost(self, x: Tensor, w: Tensor) -> Tensor:
        """Negative information of motions [rows], and what exceeds the limits."""
        robot = self.parameters.robot
        motion = self.family.motions(x, w).at(grid(SAMPLED * self.family.harmonics))
        # a start may have no information about some parameters
        A = self.parameters.information(*motion) + 1e-10 * torch.eye(len(self.parameters.leading), dtype=DTYPE)
        gain = 2 * torch.linalg.cholesky_ex(A).L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        used = (described_torques(robot, *motion).abs() + robot.friction) / self.family.bounds.effort
        exceeded = (used - 1 + NEAR).relu().square().sum((-2, -1))
        exceeded = exceeded + (NEAR - self.limits.clearance(robot, motion[0])).relu().square().sum((-2, -1))
        return 1e4 * exceeded - gain

    @torch.no_grad()
    def largest(self, series: Series) -> Series:
        """Best of several motions, each as large as torques and workspace let it be."""

        def fits(size: Tensor) -> Tensor:
            used, clearance = self.extremes(series.shrunk(size))
            return (used <= 1).all(-1) & (clearance >= 0).all(-1)

        large = torch.ones(len(series.rate), dtype=DTYPE)
        small = torch.where(fits(large), large, 0.0)
        for _ in range(12):
            middle = (small + large) / 2
            inside = fits(middle)
            small, large = torch.where(inside, middle, small), torch.where(inside, large, middle)
        if not bool((small > 0).any()):
            self.refuse(series)
        series = series.shrunk(small)
        A = self.parameters.information(*series.at(grid(SAMPLED * self.family.harmonics)))
        gain = torch.where(small > 0, torch.linalg.slogdet(A).logabsdet, -torch.inf)
        return Series(*(part[gain.argmax()] for part in series))

    def extremes(self, series: Series) -> tuple[Tensor, Tensor]:
        """Greatest torques over their limits [rows, n], and least clearances [rows, c], at all times.

        A function is beyond the line between two points by an eighth of its second difference there, but for higher
        derivatives; a quarter of the greatest is added.
        """
        robot, motion = self.parameters.robot, series.at(grid(FINE * self.family.harmonics))

        def between(x: Tensor) -> Tensor:
            return (x.roll(1, -2) - 2 * x + x.roll(-1, -2)).abs().amax(-2) / 4

        torque, clearance = described_torques(robot, *motion), self.limits.clearance(robot, motion[0])
        most = torque.abs().amax(-2) + between(torque) + robot.friction
        return most / self.family.bounds.effort, clearance.amin(-2) - between(clearance)

    def refuse(self, series: Series) -> NoReturn:
        """Raise, with the limit that no motion keeps."""
        robot, effort = self.parameters.robot, self.family.bounds.effort
        used, clearance = self.extremes(series.shrunk(torch.zeros(len(series.rate), dtype=DTYPE)))
        joint = used[0].argmax()
        found = f"the workspace is left by {-float(clearance[0].min()) if clearance.numel() else 0:.3g} m"
        if not bool((used[0] <= 1).all()):
            needed = f"{float(used[0, joint] * effort[joint]):.3g} of {float(effort[joint]):.3g} N m"
            found = f"joint {robot.joint_names[joint]!r} needs {needed}"
        cure = "give MotionLimits with a larger effort, or a range of positions that the arm can hold in its workspace"
        raise ArgumentError(f"limits of robot {robot.name!r} allow no motion: at its middle, {found}; {cure}")


def described_torques(robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Torques [..., n] of the description with its viscous friction: smooth in time, as the dry friction is not."""
    return inverse_dynamics(robot, q, qd, qdd) + robot.damping * qd


def _parts(x: Tensor, w: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    return zip(x.split(ROWS), w.split(ROWS), strict=True)
