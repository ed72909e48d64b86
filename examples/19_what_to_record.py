"""Excitation trajectory, predicted standard errors, and a hundred samples from the posterior.

    python examples/19_what_to_record.py
    python examples/19_what_to_record.py --robot arm.urdf --table 0.05

A motion is designed within 90 % of the arm's limits and above a table, written to a file for the controller, and its
standard errors are predicted. Here a simulated arm that differs from its description replaces the real one: it is
identified from its noisy torques along the motion, and the errors are as predicted. Arms are then drawn from the
posterior, all physically consistent, and simulated under the same torques, to show the effect of the uncertainty.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, ORANGE, prepare, save
from rich.console import Console
from torch import Tensor

import torchdq
from torchdq import Scene, effects
from torchdq.learning import (
    Excitation,
    HalfSpace,
    Model,
    MotionLimits,
    PosteriorSamples,
    Samples,
    excitation_trajectory,
    identify,
    posterior_samples,
)
from torchdq.learning.excitation.fourier import Family
from torchdq.scene import integrators


@dataclass
class Args:
    robot: str = "panda"
    """Name of a shipped robot, or path of a URDF."""
    seconds: float = 20.0
    """Length of the motion [s]."""
    table: float = 0.1
    """Height above the base that the tip stays above [m]."""
    arms: int = 100
    """Arms that are drawn."""
    seed: int = 0
    quick: bool = False
    """Few starts of the search, and ten arms."""
    out: Path = Path("out")
    """Folder of the motion and the pictures."""


STEP = 1e-3  # [s] of the simulation


class Result(NamedTuple):
    """Results that the test of this example looks at."""

    chi_square: float  # mean square of the base parameters' deviations over the predicted errors
    gain: float  # mean standard error of random motions over that of the one found
    drawn: PosteriorSamples
    spread: Tensor  # [time, n] standard deviation of the drawn arms' positions [rad]


def other_arm(described: torchdq.Robot) -> torchdq.Robot:
    """Arm whose bodies differ by up to 20 % from the description."""
    scale = 0.8 + 0.4 * torch.rand(len(described.mass), dtype=torch.float64)
    return described.replace(mass=scale * described.mass, inertia=scale[:, None] * described.inertia).bake()


def random_errors(found: Excitation, limits: MotionLimits, args: Args) -> float:
    """Mean standard error of random motions within the same limits, over that of the motion found."""
    family = Family(limits.bounds(found.parameters.robot), found.series.sine.shape[-1])
    rates = found.series.rate.expand(10)
    series = family.motions(family.start(10, torch.Generator().manual_seed(args.seed)), rates)
    motions = series.at(found.series.rate * found.time)
    errors = [found.parameters.errors(*rows) for rows in zip(*motions, strict=True)]
    return float(torch.stack(errors).log().mean(1).median().exp() / found.base_errors.log().mean().exp())


def fanned(drawn: PosteriorSamples, tau: Tensor, q: Tensor) -> Tensor:
    """Positions [time, arms, n] of the drawn arms that start alike and feel the same torques."""
    scene = Scene(drawn.robot, drawn.effects(), integrator=integrators.LinearlyImplicit(), dt=STEP)
    start = scene.start(q.expand(len(drawn.parameters), -1))
    return torch.cat([start.q[None], scene.rollout(start, tau[:-1, None]).q])


def main(args: Args) -> Result:
    """Motion, errors and drawn arms."""
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    prepare()
    console = Console()
    named = args.robot in torchdq.robots.names()
    described = torchdq.robots.load(args.robot) if named else torchdq.Robot.from_urdf(args.robot)
    limits = MotionLimits(workspace=[HalfSpace(described.end_effector().name, (0, 0, 1), args.table)])
    found = excitation_trajectory(described, args.seconds, limits, restarts=16 if args.quick else 256, seed=args.seed)
    args.out.mkdir(parents=True, exist_ok=True)
    found.to_csv(args.out / "motion.csv", rate=1000.0)
    save(found.plot(), args.out / "motion.png")
    console.print(str(found), highlight=False)
    gain = random_errors(found, limits, args)
    console.print(f"random motions leave {gain:.1f} times the error; the motion is in {args.out / 'motion.csv'}")

    real, n, width = other_arm(described), described.n, found.parameters.sign_width
    viscous, coulomb = 1.0 + torch.rand(n).double(), 0.5 + torch.rand(n).double()

    def torques(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        return torchdq.inverse_dynamics(real, q, qd, qdd) + viscous * qd + coulomb * qd / (qd**2 + width**2).sqrt()

    noise = found.parameters.noise * torch.randn(found.q.shape, dtype=torch.float64)
    tau = torques(found.q, found.qd, found.qdd) + noise
    plain = Model(friction=(effects.Viscous(), effects.Coulomb(sign_width=width)))
    identified = identify(described, Samples(found.q, found.qd, found.qdd, tau), plain, prior=0.1, sign_width=width)
    truth = found.base @ torch.cat([real.inertial_parameters, viscous, coulomb])
    off = (found.base @ identified.parameters - truth) / found.base_errors
    chi_square = float(off.square().mean())
    console.print(f"mean square of the deviations over the predicted errors: {chi_square:.2f}")

    drawn = posterior_samples(identified, 10 if args.quick else args.arms, most=0.2, seed=args.seed)
    states = found.series.at(found.series.rate * STEP * torch.arange(1000).double())
    positions = fanned(drawn, torques(*states), states[0][0])
    draw((positions - states[0][:, None]).norm(dim=-1), off, args)
    return Result(chi_square, gain, drawn, positions.std(1))


def draw(astray: Tensor, off: Tensor, args: Args) -> None:
    """Deviations of the base parameters, and distances [time, arms] from the motion that drawn arms end up at."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.5), layout="constrained")
    left.axhspan(-2, 2, color="#E4E4E4", label="two predicted standard errors")
    left.plot(off, "o", color=BLUE, markersize=4)
    left.set(
        xlabel="base parameter",
        ylabel="off the truth [standard errors]",
        ylim=(-4, 4),
        title="identified base parameters",
    )
    left.legend(loc="lower left")
    time = STEP * torch.arange(len(astray))
    right.plot(time, astray, color=GREY, linewidth=0.6)
    right.plot(time, astray.median(1).values, color=ORANGE, label="median")
    right.set(xlabel="time [s]", ylabel="off the motion [rad]", title="arms drawn, under the torques of the real one")
    right.legend()
    save(figure, args.out / "possible_arms.png")


if __name__ == "__main__":
    result = main(tyro.cli(Args))
    sys.exit(0 if result.chi_square < 2 and result.gain > 1 else 1)
