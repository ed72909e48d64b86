"""From a log to a controller in C: identify an arm, export computed torque, and run it at 1 kHz outside of Python.

    python examples/15_real_time.py

The arm differs from its description: other masses, and rotors and friction that the description lacks. It is identified
from a log of torques. The controller with the identified model is exported to C, and so is the simulated arm, a step of
a scene with the true parameters. `real_time.c` runs both in a loop with a fixed period and records the latency and the
computing time of every cycle. The same loop in Python verifies the positions, and a controller with the nominal model
shows the benefit of identification.

The controller takes about a microsecond. The latency of the loop depends on the operating system: a machine that
controls an arm should run a real-time kernel, with a dedicated core and a high priority for the loop.
"""

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, ORANGE, prepare, save
from torch import Tensor

import torchdq
from torchdq import Scene, effects
from torchdq.learning import Model, Samples, identify
from torchdq.nn import ComputedTorque

LOOP = Path(__file__).with_name("real_time.c")
KP, KD = 400.0, 40.0  # gains of the controller [1/s^2, 1/s]
QUANTILES = {"median": 0.5, "99 %": 0.99, "99.9 %": 0.999, "most": 1.0}


@dataclass
class Args:
    seconds: float = 4.0
    """Duration of the motion [s]."""
    period: float = 1e-3
    """Period of the loop [s]."""
    noise: float = 0.2
    """Standard deviation of a torque in the log [N m]."""
    compiler: str = "cc"
    """C compiler."""
    out: Path = Path("out")
    """Folder of the picture."""


class Result(NamedTuple):
    """Results that the test of this example looks at."""

    deviation: float  # largest difference of a position from the same loop in Python [rad]
    error: float  # largest tracking error with the identified model [rad]
    error_described: float  # the same with the description [rad]
    late: np.ndarray  # [cycles] time from the end of a period until the loop woke [ns]
    computed: np.ndarray  # [cycles] time of the controller [ns]


class Motion(NamedTuple):
    """Desired motion middle + swing (1 - cos(rate t)) / 2."""

    middle: Tensor  # [n] [rad]
    swing: Tensor  # [n] [rad]
    rate: Tensor  # [n] [rad/s]

    def at(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions, velocities and accelerations [..., n] at times [..., 1] [s]."""
        half, w = 0.5 * self.swing, self.rate
        return (
            self.middle + half * (1 - (w * t).cos()),
            half * w * (w * t).sin(),
            half * w.square() * (w * t).cos(),
        )

    def header(self) -> str:
        """Text of motion.h."""
        rows = {"MIDDLE": self.middle, "SWING": self.swing, "RATE": self.rate}
        tables = [
            f"static const double {name}[JOINTS] = {{{', '.join(map(repr, x.tolist()))}}};" for name, x in rows.items()
        ]
        return "\n".join([f"#define JOINTS {len(self.middle)}", *tables, ""])


def logged(arm: torchdq.Robot, noise: float, samples: int = 2000) -> tuple[Tensor, ...]:
    """Log of an arm that moves in sums of sinusoids: positions, velocities, accelerations and noisy torques."""
    t = torch.arange(samples).double()[:, None, None] * 0.01
    rate = 2 * torch.pi * 0.15 * (1 + torch.rand(arm.n, 4).double() * 4)  # [rad/s]
    size = 0.6 * torch.rand(arm.n, 4).double() / rate.clamp(min=1.0)  # [rad]
    phase = rate * t + 6 * torch.rand(arm.n, 4).double()
    middle = (arm.limits.lower + arm.limits.upper) / 2
    q = middle + (size * phase.sin()).sum(-1)
    qd, qdd = (size * rate * phase.cos()).sum(-1), -(size * rate**2 * phase.sin()).sum(-1)
    tau = torchdq.InverseDynamics(arm, learn="friction")(q, qd, qdd).detach()
    return q, qd, qdd, tau + noise * torch.randn(tau.shape).double()


def simulated(scene: Scene, controller: ComputedTorque, motion: Motion, args: Args) -> Tensor:
    """Positions [cycles, n] of the loop in Python."""
    state, positions = scene.start(motion.middle), []
    with torch.inference_mode():
        for k in range(round(args.seconds / args.period)):
            wanted = motion.at(torch.tensor([k * args.period]).double())
            state = scene.step(state, controller(state.q, state.qd, *wanted))
            positions.append(state.q)
    return torch.stack(positions)


def in_c(scene: Scene, controller: ComputedTorque, motion: Motion, args: Args) -> np.ndarray:
    """Lines of the loop in C: how late it woke [ns], how long the controller computed [ns], and positions [rad]."""
    with tempfile.TemporaryDirectory() as folder:
        control = torchdq.compile(controller.program()).export(folder, "arm_control")
        step = torchdq.compile(scene.program("torque")).export(folder, "arm_step")
        (Path(folder) / "motion.h").write_text(motion.header())
        program = Path(folder) / "real_time"
        sources = [str(x) for x in (LOOP, control.source, step.source)]
        subprocess.run(
            [args.compiler, "-std=c99", "-O2", "-I", folder, *sources, "-o", str(program), "-lm"], check=True
        )
        cycles, period = round(args.seconds / args.period), round(1e9 * args.period)
        done = subprocess.run([program, str(cycles), str(period)], check=True, capture_output=True, text=True)
    return np.loadtxt(done.stdout.splitlines())


def main(args: Args) -> Result:
    """Latency of the loop, and how well the arm follows."""
    if shutil.which(args.compiler) is None:
        raise SystemExit(f"no C compiler {args.compiler!r}; name one with --compiler")
    torch.manual_seed(0)
    described = torchdq.robots.load("panda")
    true = described.replace(
        mass=described.mass * (1 + 0.3 * torch.rand(7).double()),
        damping=0.5 + torch.rand(7).double(),
        friction=0.5 + torch.rand(7).double(),
        armature=0.1 + 0.2 * torch.rand(7).double(),
    ).bake()
    found = identify(described, Samples(*logged(true, args.noise)), Model(armature=True))
    scene = Scene(
        true, (effects.Gravity(), effects.RotorInertia(), effects.Viscous(), effects.Coulomb()), dt=args.period
    )
    motion = Motion(
        torch.tensor([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8]).double(),
        torch.tensor([0.8, 0.7, -0.6, 0.5, 0.8, -0.7, 0.9]).double(),
        torch.tensor([1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5]).double(),
    )
    controllers = [ComputedTorque(robot, KP, KD) for robot in (found.robot, described)]
    in_python = [simulated(scene, controller, motion, args) for controller in controllers]
    lines = in_c(scene, controllers[0], motion, args)
    late, computed, positions = lines[:, 0], lines[:, 1], torch.from_numpy(lines[:, 2:])

    times = (1 + torch.arange(len(positions)).double())[:, None] * args.period
    wanted = motion.at(times)[0]
    error, error_described = (float((q - wanted).abs().max()) for q in in_python)
    deviation = float((positions - in_python[0]).abs().max())
    print(f"{len(late)} cycles of {1e3 * args.period:g} ms; positions differ by {deviation:.1e} rad from Python's loop")
    print(f"largest tracking error: {error:.1e} rad identified, {error_described:.1e} rad nominal")
    rows = {"wake-up latency": late, "computation time": computed}
    for name, x in rows.items():
        parts = ", ".join(f"{label} {np.quantile(x, part) / 1e3:.2f}" for label, part in QUANTILES.items())
        print(f"{name} [us]: {parts}")
    draw(args, times, wanted, in_python, late, computed)
    return Result(deviation, error, error_described, late, computed)


def draw(
    args: Args, times: Tensor, wanted: Tensor, followed: list[Tensor], late: np.ndarray, computed: np.ndarray
) -> None:
    """Tracking errors over time, and the distribution of both latencies."""
    prepare()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
    for q, color, name in zip(followed, (BLUE, ORANGE), ("identified model", "nominal model"), strict=True):
        left.semilogy(times, (q - wanted).abs().amax(1).clamp(min=1e-9), color=color, label=name)
    left.set(xlabel="time [s]", ylabel="largest error of a joint [rad]", title="Tracking error")
    left.legend()
    for x, color, name in ((computed, BLUE, "computation time"), (late, GREY, "wake-up latency")):
        right.semilogx(np.sort(x) / 1e3, 1 - np.arange(len(x)) / len(x), color=color, label=name)
    right.set(xlabel="time [us]", ylabel="fraction of cycles exceeding", title=f"Loop of {1e3 * args.period:g} ms in C")
    right.set(yscale="log", ylim=(0.02 / len(x), 1.5))  # the legend below the curves
    right.legend(loc="lower left")
    save(figure, args.out / "real_time.png")


if __name__ == "__main__":
    result = main(tyro.cli(Args))
    sys.exit(0 if result.deviation < 1e-7 and result.error < result.error_described / 3 else 1)
