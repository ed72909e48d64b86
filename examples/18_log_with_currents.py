"""Identification from a log of drives: positions of the motors, and their currents.

    python examples/18_log_with_currents.py
    python examples/18_log_with_currents.py --seed 3

The log is that of a simulated arm, which differs from its description. Its drives record time stamps, motor encoders
and currents, but no velocities. A gear reverses one joint, and the last two motors drive the wrist together. A
`Layout` describes all of it, and `robot.couple` makes the motors the coordinates of the robot: friction and rotor
inertia act there. The torques per ampere are those of a data sheet, and wrong by up to a fifth: with
`Model(gains=True)`, `identify` estimates the factor of each motor. A common factor of all motors is not identifiable
along with the masses; it comes from the description.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import tyro
from identified import draw, errors_table, shares
from rich.console import Console
from rich.table import Table
from simulated_logs import real_arm, recorded, write

import torchdq
from torchdq.learning import Identified, Layout, LogError, Model, identify, read_log, smooth, stack_samples

RATIOS = (101.0, -101.0, 101.0, 101.0)  # gear ratios of the arm, negative where the joint turns against the motor
WRIST = ((1 / 80, 0.0), (1 / 80, 1 / 50))  # joints per motor: the first one carries the second joint along
TRANSMISSION = np.zeros((6, 6))
TRANSMISSION[:4, :4], TRANSMISSION[4:, 4:] = np.diag(1 / np.array(RATIOS)), WRIST
GAINS = (0.12, 0.12, 0.10, 0.09, 0.09, 0.09)  # torque of the motors per ampere, by the data sheet [N m/A]
DRIVES = Layout(
    columns={"time": "stamp", "q": "encoder_{0}", "qd": None, "tau": "current_{0}"},
    transmission=TRANSMISSION,
    gain=GAINS,
)


@dataclass
class Args:
    seed: int = 0
    quick: bool = False
    """Two short motions instead of four."""
    out: Path = Path("out")
    """Folder of the picture and of the logs."""


class Result(NamedTuple):
    """Results that the test of this example looks at."""

    found: Identified
    before: np.ndarray  # [n] error over standard deviation of the torques in the test, as described
    after: np.ndarray  # [n] the same, as found
    gains: np.ndarray  # [n] found torque over the true one, but for one factor of all joints


def made_logs(robot: torchdq.Robot, args: Args) -> tuple[list[Path], np.ndarray]:
    """Logs of the drives of an arm that is not as described, and their torques over those of the data sheet."""
    arm, paths = real_arm(robot, args.seed, rotors=True), []
    off = np.random.default_rng(args.seed).uniform(0.8, 1.2, robot.n)
    for k in range(2 if args.quick else 4):
        log = recorded(arm, 12.0 if args.quick else 25.0, 200.0, 100 * args.seed + k)
        encoders = log.q / DRIVES.ratios
        currents = log.tau * DRIVES.ratios / (off * GAINS)  # no power is lost in the gears
        paths.append(write(args.out / f"drives_{k}.csv", log.time, {"encoder": encoders, "current": currents}))
    return paths, off


def main(args: Args) -> Result:
    """Errors of the torques before and after."""
    console = Console(width=110)
    robot = torchdq.robots.load("ur10e")
    robot = robot.couple(DRIVES.coupling, [f"motor {k}" for k in range(1, 7)], limits=robot.limits)
    paths, off = made_logs(robot, args)
    try:
        read_log(paths[0], Layout(columns={"time": "stamp", "q": "encoder_{0}"}))
    except (
        LogError
    ) as fault:  # there are neither velocities nor torques: the message says what is possible all the same
        console.print(f"{fault}\n", highlight=False)
    logs = [read_log(path, DRIVES) for path in paths]
    console.print(logs[0])
    *train, test = [smooth(log, rate=20) for log in logs]
    console.print(test)

    found = identify(robot, train, Model(armature=True, gains=True))  # currents drive the rotors, too
    console.print(str(found))

    factors = found.gains.value.numpy()
    common = float(np.median(factors / off))
    rows = Table("torque over that of the data sheet", *robot.joint_names)
    shown = {
        "true": off,
        "found": factors,
        "+-": found.gains.error.numpy(),
        "found, but for one factor": factors / common,
    }
    for name, x in shown.items():
        rows.add_row(name, *(f"{one:.3f}" for one in x))
    console.print(rows)

    test = test._replace(tau=test.tau * factors)
    with torch.no_grad():
        described = torchdq.inverse_dynamics(robot, *stack_samples(test)[:3])
    torques = {"nominal": described.numpy(), "identified": found.predict(test).tau.numpy()}
    errors = shares(test, torques)
    console.print(errors_table(errors))
    draw(robot.joint_names, test, torques, args.out / "log_with_currents.png", 12.0)
    return Result(found, *errors.values(), factors / common / off)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (LogError, torchdq.TorchdqError, OSError) as fault:
        sys.exit(f"{type(fault).__name__}: {fault}")
