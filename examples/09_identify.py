"""Masses, inertias and friction of a Panda, identified from a noisy log.

    python examples/09_identify.py

The simulated arm differs from its description: masses by up to 20 %, centres of mass by a centimetre, inertias,
friction and rotors. It tracks sums of sinusoids under a controller with the nominal model; positions and torques are
logged with noise, smoothed, and given to `identify`. Most single masses and inertias are not identifiable from
torques, in any motion. The identifiable combinations are listed with their errors, and the identified robot is tested
on another motion.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, ORANGE, prepare, save
from rich.console import Console
from rich.table import Table
from scipy.signal import butter, sosfiltfilt
from torch import Tensor

import torchdq
from torchdq import Scene, effects
from torchdq.learning import Identified, Model, Samples, identify
from torchdq.scene import integrators
from torchdq.scene.controllers import ComputedTorque


@dataclass
class Args:
    motions: int = 8
    """Recorded motions; one more is kept for the test."""
    duration: float = 10.0
    """Duration of a motion [s]."""
    torque_noise: float = 0.5
    """Standard deviation of a torque reading [N m]."""
    position_noise: float = 2e-5
    """Standard deviation of a position reading [rad]."""
    cutoff: float = 20.0
    """Cutoff of the low-pass filter [Hz]."""
    seed: int = 0
    quick: bool = False
    """Two motions instead."""
    out: Path = Path("out")
    """Folder of the picture."""


class Result(NamedTuple):
    """Results that the test of this example looks at."""

    chi_square: float  # mean square of the base parameters' deviations over their errors
    before: Tensor  # [n] root mean square of the torque error in the test motion, as described [N m]
    after: Tensor  # [n] the same, as found
    found: Identified


class Motions(NamedTuple):
    """Samples [motions, time, n]."""

    q: Tensor
    qd: Tensor
    qdd: Tensor
    tau: Tensor


STEP = 1e-3  # [s] of the controller and the log
HARMONICS, SLOWEST = 5, 0.1  # [Hz]


def excitation(robot: torchdq.Robot, time: Tensor, motions: int) -> tuple[Tensor, Tensor, Tensor]:
    """Sums of sinusoids within the limits: positions, velocities and accelerations, [motions, time, n]."""
    lower, upper, fastest = robot.limits.lower, robot.limits.upper, robot.limits.velocity
    rate = 2 * torch.pi * SLOWEST * torch.arange(1, HARMONICS + 1).double()
    size = torch.rand(motions, 1, robot.n, HARMONICS).double()
    phase = rate * time[:, None, None] + 2 * torch.pi * torch.rand(motions, 1, robot.n, HARMONICS).double()
    q, qd = (size * phase.sin()).sum(-1), (size * rate * phase.cos()).sum(-1)
    middle, reach = (upper + lower) / 2, (upper - lower) / 2
    fit = torch.minimum(0.8 * reach / q.abs().amax(1, keepdim=True), 0.7 * fastest / qd.abs().amax(1, keepdim=True))
    return middle + fit * q, fit * qd, fit * -(size * rate**2 * phase.sin()).sum(-1)


def recorded(scene: Scene, believed: torchdq.Robot, args: Args, motions: int) -> Motions:
    """Logged, smoothed and thinned motions of the arm under a controller that believes the description."""
    time = torch.arange(round(args.duration / STEP)).double() * STEP
    wanted = excitation(believed, time, motions)
    scene = scene.replace(controller=ComputedTorque(400.0, 40.0, model=believed))
    start = scene.start(wanted[0][:, 0], wanted[1][:, 0])
    states = scene.rollout(start, reference=torch.cat(wanted, -1).movedim(1, 0))
    q, qd = (torch.cat([a[:, None], b[:-1].movedim(0, 1)], 1) for a, b in zip(start[:2], states[:2], strict=True))
    tau = torchdq.computed_torque(believed, q, qd, *wanted, 400.0, 40.0)
    tau[:, 1:] = (tau[:, 1:] + tau[:, :-1]) / 2  # a position is read between the torque before and the one after
    q = q + args.position_noise * torch.randn(q.shape).double()
    tau = tau + args.torque_noise * torch.randn(q.shape).double()

    # The same filter for everything, without delay; what passes a cutoff f holds 2 f independent numbers a second.
    low_pass = butter(4, args.cutoff, fs=1 / STEP, output="sos")
    q, tau = (torch.from_numpy(sosfiltfilt(low_pass, x.numpy(), axis=1).copy()) for x in (q, tau))
    qd = torch.gradient(q, spacing=STEP, dim=1)[0]
    qdd = torch.gradient(qd, spacing=STEP, dim=1)[0]
    keep = slice(500, -500, round(1 / (2 * args.cutoff * STEP)))
    return Motions(*(x[:, keep] for x in (q, qd, qdd, tau)))


def main(args: Args) -> Result:
    """Accuracy with which the parameters and the torques are found."""
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    described = torchdq.robots.load("panda")
    n = described.n

    def about(x: Tensor, part: float) -> Tensor:
        return x * (1 + part * (2 * torch.rand(x.shape).double() - 1))

    scale = about(torch.ones(n, 1).double(), 0.2)
    true = described.replace(
        mass=about(described.mass, 0.2),
        com=described.com + 0.01 * torch.randn(n, 3).double(),
        inertia=scale * described.inertia,
        armature=torch.tensor([0.6, 0.6, 0.5, 0.5, 0.2, 0.2, 0.2]).double(),
    ).bake()
    viscous, coulomb = 0.2 + 0.8 * torch.rand(n).double(), 0.3 + 0.9 * torch.rand(n).double()
    parts = (effects.Gravity(), effects.RotorInertia(), effects.Viscous(viscous), effects.Coulomb(coulomb, 0.02))
    scene = Scene(true, parts, integrator=integrators.RungeKutta4(), dt=STEP)

    with torch.inference_mode():
        every = recorded(scene, described, args, 1 + (2 if args.quick else args.motions))
    test, train = Motions(*(x[0] for x in every)), Motions(*(x[1:] for x in every))
    found = identify(described, Samples(*train), Model(armature=True), sign_width=0.02)

    truth = torch.cat([true.inertial_parameters, true.armature, viscous, coulomb])
    start = torch.cat([described.inertial_parameters, torch.zeros(3 * n).double()])
    real, guess, value, error = *(found.base @ x for x in (truth, start, found.parameters)), found.base_errors
    chi_square = float(((value - real) / error).square().mean())
    table = Table("base parameters", "true", "described", "found", "+-")
    for name, row in zip(found.base_names, zip(real, guess, value, error, strict=True), strict=True):
        table.add_row(name, *(f"{float(x):.4f}" for x in row))
    console = Console(width=110)
    console.print(table)
    samples = train.q.shape[0] * train.q.shape[1]
    console.print(
        f"{found.rank} of {len(truth)} parameters are identifiable from {samples} samples; chi square per one of them"
    )
    console.print(f"{chi_square:.2f}; masses true, described, found +- error:")
    for i, link in enumerate(described.link_names):
        numbers = f"{float(true.mass[i]):.2f} {float(described.mass[i]):.2f} {float(found.robot.mass[i]):.2f}"
        console.print(f"  {link} {numbers} +- {float(found.errors[10 * i]):.2g} kg", highlight=False)

    plain = torchdq.inverse_dynamics(described, test.q, test.qd, test.qdd)
    after = found.predict(test.q, test.qd, test.qdd)
    before_rms, after_rms = ((x - test.tau).square().mean(0).sqrt() for x in (plain, after.tau))
    table = Table("joint", *(str(j + 1) for j in range(n)), title="torque error in the test motion [N m]")
    rows = {"nominal": before_rms, "identified": after_rms, "noise": found.noise}
    rows["error of the prediction"] = after.error.square().mean(0).sqrt()
    for name, row in rows.items():
        table.add_row(name, *(f"{float(x):.3f}" for x in row))
    console.print(table)
    draw(args, test, plain, after.tau, (guess - real, value - real, error), found)
    return Result(chi_square, before_rms, after_rms, found)


def draw(args: Args, test: Motions, plain: Tensor, after: Tensor, off: tuple[Tensor, ...], found: Identified) -> None:
    """Torques of two joints in the test motion, and every base parameter with its error."""
    prepare()
    figure = plt.figure(figsize=(10, 7), layout="constrained")
    axes = figure.subplot_mosaic([["a", "b"], ["c", "c"]])
    time = 0.5 + torch.arange(len(test.tau)) / (2 * args.cutoff)
    for panel, joint in (("a", 1), ("b", 5)):
        axes[panel].plot(time, test.tau[:, joint], color="#000000", linewidth=1, label="measured")
        axes[panel].plot(time, plain[:, joint], color=ORANGE, linewidth=1.5, label="nominal")
        axes[panel].plot(time, after[:, joint], color=BLUE, linewidth=1.5, label="identified")
        title = f"joint {joint + 1} in a motion not seen before"
        axes[panel].set(xlabel="time [s]", ylabel="torque [N m]", title=title)
    axes["a"].legend(ncols=3, loc="lower left", bbox_to_anchor=(0, 1.08), borderaxespad=0)
    described, value, error = (x / off[2] for x in off)
    order = described.abs().argsort(descending=True)
    place = torch.arange(found.rank)
    axes["c"].axhspan(-2, 2, color="#E4E4E4", label="two standard errors")
    axes["c"].plot(place, described[order], "o", color=ORANGE, markersize=4, label="nominal")
    axes["c"].errorbar(place, value[order], error[order], fmt="o", color=BLUE, markersize=4, label="identified")
    axes["c"].set_yscale("symlog", linthresh=4)
    axes["c"].set_yticks([-100, -10, 0, 10, 100])
    axes["c"].set(xlabel="combination of parameters", ylabel="off the truth [standard errors]")
    axes["c"].set_title("base parameters")
    axes["c"].legend(ncols=3, loc="lower right")
    save(figure, args.out / "identify.png")


if __name__ == "__main__":
    result = main(tyro.cli(Args))
    sys.exit(0 if result.chi_square < 3 and bool((result.after < result.before / 2).all()) else 1)
