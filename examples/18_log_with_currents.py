"""From a log of drives to an identified robot: positions of motors, and their currents, nothing else.

    python examples/18_log_with_currents.py
    python examples/18_log_with_currents.py --seed 3

The log is one of an arm that is simulated first, and differs from its description. Its drives write stamps, encoders at
the motors and currents; velocities they do not. Gears reverse a joint, and the last two motors turn the wrist together.
A `Layout` says all of it. Torques per ampere are those of a data sheet; a robot found from them is right as far as they
are: masses, inertias and friction of a joint change with its gain.
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
from simulated_logs import real_arm, recorded, write

import torchdq
from torchdq.learning import Identified, Layout, LogError, directions, identify, read, samples, smooth

RATIOS = (101.0, -101.0, 101.0, 101.0)  # of the gears of the arm, negative where the joint turns against the motor
WRIST = (
    (1 / 80, 0.0),
    (1 / 80, 1 / 50),
)  # joints per motor: the first one carries the second joint along
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


def made_logs(robot: torchdq.Robot, args: Args) -> list[Path]:
    """Logs of the drives of an arm that is not as described."""
    arm, paths = real_arm(robot, args.seed), []
    for k in range(2 if args.quick else 4):
        log = recorded(arm, 12.0 if args.quick else 25.0, 200.0, 100 * args.seed + k)
        encoders = log.q @ np.linalg.inv(TRANSMISSION).T
        currents = log.tau @ TRANSMISSION / GAINS  # no power is lost: torques go to the motors by the transposed matrix
        paths.append(write(args.out / f"drives_{k}.csv", log.time, {"encoder": encoders, "current": currents}))
    return paths


def main(args: Args) -> Result:
    """Errors of the torques before and after."""
    console = Console(width=110)
    robot = torchdq.robots.load("ur10e")
    paths = made_logs(robot, args)
    try:
        read(paths[0], Layout(columns={"time": "stamp", "q": "encoder_{0}"}))
    except (
        LogError
    ) as fault:  # there are neither velocities nor torques: the message says what is possible all the same
        console.print(f"{fault}\n", highlight=False)
    logs = [read(path, DRIVES) for path in paths]
    console.print(logs[0])
    *train, test = [smooth(log, rate=20) for log in logs]
    console.print(test)

    found = identify(robot, *samples(train), direction=directions(train))
    console.print(str(found))

    unseen = samples(test)
    with torch.no_grad():
        torques = {
            "as described": torchdq.inverse_dynamics(robot, *unseen[:3]).numpy(),
            "as found": found.predict(*unseen[:3]).tau.numpy(),
        }
    errors = shares(test, torques)
    console.print(errors_table(errors))
    draw(robot.joint_names, test, torques, args.out / "log_with_currents.png", 12.0)
    return Result(found, *errors.values())


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (LogError, torchdq.TorchdqError, OSError) as fault:
        sys.exit(f"{type(fault).__name__}: {fault}")
