"""From a log with torques to an identified robot and its report.

    python examples/17_log_with_torques.py
    python examples/17_log_with_torques.py --robot arm.urdf --logs A.csv B.csv --test C.csv
    python examples/17_log_with_torques.py --robot ur10e --logs ur-20_02_06*.csv --test ur-20_02_19_14harm50sec.csv

Without logs, an arm that differs from its description (masses, centres of mass, friction) is recorded first: one CSV
file per motion, with columns and time stamps like those of drivers. The steps are those for any log: a `Layout` that
names the columns, reading, `smooth`, `identify`. The last log is the test set, or the last third of a single log. The
result is a robot, `found.robot`, with friction: `found.layer()` is a module of its torques, and
`Scene(found.robot, found.effects())` simulates it. If a URDF was given, one with the identified parameters is written
next to it.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import tyro
from identified import draw, errors_table, shares
from recordings import layout_of
from rich.console import Console
from simulated_logs import real_arm, recorded, write

import torchdq
from torchdq.learning import (
    Identified,
    Layout,
    LogError,
    Motion,
    identify,
    read_log,
    smooth,
    stack_samples,
    train_test_split,
)

# columns of our own logs; joints are counted from 0 there
NAMES = {"time": "stamp", "q": "position_{0}", "qd": "velocity_{0}", "tau": "effort_{0}"}


@dataclass
class Args:
    robot: str = "panda"
    """Name of a shipped robot, or path of a URDF."""
    logs: list[Path] = field(default_factory=list)
    """Logs to learn from; none: those of a simulated arm."""
    test: Path | None = None
    """Log to test on; none: the last one of `logs`, or the last third of the only one."""
    columns: dict[str, str] = field(default_factory=dict)
    """Names of the columns of `logs`, e.g. q position_{0} qd velocity_{0} tau effort_{0}; none: those that the package
    expects, or of a public data set in `recordings.py`."""
    seed: int = 0
    quick: bool = False
    """Two short motions instead of four."""
    out: Path = Path("out")
    """Folder of the picture, and of the logs that are made."""


class Result(NamedTuple):
    """Results that the test of this example looks at."""

    found: Identified
    before: np.ndarray  # [n] error over standard deviation of the torques in the test, as described
    after: np.ndarray  # [n] the same, as found


def made_logs(robot: torchdq.Robot, args: Args) -> list[Path]:
    """Logs of an arm that is not as described."""
    arm, paths = real_arm(robot, args.seed), []
    for k in range(2 if args.quick else 4):
        log = recorded(arm, 12.0 if args.quick else 25.0, 200.0, 100 * args.seed + k)
        columns = {"position": log.q, "velocity": log.qd, "effort": log.tau}
        paths.append(write(args.out / f"torques_{k}.csv", log.time, columns))
    return paths


def split(motions: list[Motion]) -> tuple[list[Motion], Motion]:
    """Motions to learn from and one to test on."""
    if len(motions) > 1:
        return motions[:-1], motions[-1]
    first, (last,) = train_test_split(motions[0], 2 / 3)
    return first, last


def main(args: Args) -> Result:
    """Errors of the torques before and after."""
    console = Console(width=110)
    shipped = args.robot in torchdq.robots.names()
    robot = torchdq.robots.load(args.robot) if shipped else torchdq.Robot.from_urdf(args.robot)
    columns = args.columns if args.logs else NAMES

    def motion(path: Path) -> Motion:
        log = read_log(path, Layout(columns=columns) if columns else layout_of(path))
        console.print(log)
        return smooth(log, rate=20)

    motions = [motion(path) for path in args.logs or made_logs(robot, args)]
    train, test = (motions, motion(args.test)) if args.test else split(motions)
    console.print(test)

    found = identify(robot, train)
    console.print(str(found))

    with torch.no_grad():
        described = torchdq.inverse_dynamics(robot, *stack_samples(test)[:3])
    torques = {"nominal": described.numpy(), "identified": found.predict(test).tau.numpy()}
    errors = shares(test, torques)
    console.print(errors_table(errors))
    draw(robot.joint_names, test, torques, args.out / "log_with_torques.png", 12.0)
    if not shipped:
        args.out.joinpath("identified.urdf").write_text(found.to_urdf(args.robot), encoding="utf-8")
    return Result(found, *errors.values())


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (LogError, torchdq.TorchdqError, OSError) as fault:
        sys.exit(f"{type(fault).__name__}: {fault}")
