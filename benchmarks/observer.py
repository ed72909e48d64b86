"""Pushes that a momentum observer finds on recorded motions of a UR10e.

    python benchmarks/observer.py DATA [--quick] [--json FILE] [--page]

DATA is the folder of the recordings that docs/learning.md names. The robot is identified on five motions and observed
in three others, causally, from raw positions, velocities and currents at 94 Hz. Thresholds are the largest residuals
|r| of the joints, of the three motions themselves, so that none of them alarms, or of the five with a margin. A push is
a force on the tool of constant direction. It is found where |r| of a joint, with what the push adds in 20 ms or in the
end, passes the threshold. Rows at rest, where static friction is unknown, 0.5 s from each start and 50 ms before each
halt are not watched: at the end of most recordings the drives halt the arm within one sample.
"""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import report
import torch
from recordings import LAYOUTS
from splits import SIX
from torch import Tensor

import torchdq
from torchdq.learning import Log, LogWarning, Model, identify, read_log, smooth

WATCHED = ("02_12-40sec_12harm", "02_19_14harm50sec", "01_31-unload")
GAINS = (5.0, 10.0, 20.0, 50.0, 100.0)
MOVING, AFTER, BEFORE = 0.01, 50, 5  # speed of an arm that moves [rad/s]; rows after a start and before a halt
FOUND, MARGIN, FRAME = 0.02, 1.5, "tool0"  # time to find a push [s]; of thresholds of other motions


class Pushes(NamedTuple):
    """Smallest forces found [N]: medians of postures and directions, and what finds 90 %."""

    soon: list[float]
    settled: list[float]


def shown(forces: list[float]) -> str:
    """Median and 90 %, for a table."""
    return f"{forces[0]:.0f} / {forces[1]:.0f}"


def watched(log: Log) -> Tensor:
    """Steps of a log in which the arm moves, neither starting nor halting."""
    moving = (torch.as_tensor(log.qd).abs().amax(1) > MOVING).double()
    run = torch.cat((moving.new_zeros(AFTER), moving, moving.new_zeros(BEFORE))).unfold(0, AFTER + BEFORE + 1, 1)
    return (run.amin(1) > 0)[1:]


def residuals(observer: torchdq.nn.MomentumObserver, log: Log) -> Tensor:
    """Residuals in the watched steps [steps, n]."""
    q, qd, tau, seconds = (torch.as_tensor(x) for x in (log.q, log.qd, log.tau, log.time))
    return observer.series(q, qd, 0.5 * (tau[1:] + tau[:-1]), seconds.diff())[watched(log)]


def pushes(observer: torchdq.nn.MomentumObserver, logs: list[Log], r: list[Tensor], threshold: Tensor) -> Pushes:
    """Smallest forces that pass a threshold, added to the residuals of recorded motions."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(100, 3, generator=generator, dtype=torch.float64))
    quantiles = torch.tensor([0.5, 0.9], dtype=torch.float64)
    q, before = torch.cat([torch.as_tensor(log.q)[1:][watched(log)] for log in logs]), torch.cat(r)
    some = torch.linspace(0, len(q) - 1, 500).long()
    J = torchdq.jacobian(observer.robot, q[some], FRAME, "world")[:, 3:]
    torque = torch.einsum("sij,di->sdj", J, directions)
    found = []
    for share in (1.0 - torch.exp(-observer.gain * FOUND), torch.ones(())):
        added = share * torque
        least = ((threshold * added.sign() - before[some, None]) / added).amin(-1).flatten()
        found.append(least.quantile(quantiles).tolist())
    return Pushes(*found)


def main() -> None:
    """Measure, print, and write where the options ask for it."""
    parser = report.parser(__doc__, "two gains")
    parser.add_argument("data", type=Path, nargs="?", default=Path(os.environ.get("TORCHDQ_DATA", "data")))
    arguments = parser.parse_args()
    folder = arguments.data / "ur10e_innopolis"
    robot = torchdq.Robot.from_urdf(folder / "ur10e.urdf", on_unphysical="ignore")
    train, test = ([read_log(folder / f"ur-20_{name}.csv", LAYOUTS["ur10e"]) for name in x] for x in (SIX[:5], WATCHED))
    warnings.simplefilter("ignore", LogWarning)
    model = identify(robot, [smooth(log) for log in train], Model(offset=True, armature=True, memory=False)).layer()
    head = ("gain [1/s]", "rms of r [N m]", "largest r [N m]", "push in 20 ms [N]", "settled [N]")
    head = (*head, f"thresholds {MARGIN} x those of other motions", "steps with alarm")
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for k in GAINS[::3] if arguments.quick else GAINS:
        observer = torchdq.nn.MomentumObserver(model, k, dt=0.01)
        with torch.no_grad():
            known, r = ([residuals(observer, log) for log in logs] for logs in (train, test))
            every, largest = torch.cat(r), torch.cat(r).abs().amax(0)
            others = MARGIN * torch.cat(known).abs().amax(0)
            rows = [" ".join(f"{x:.1f}" for x in one.tolist()) for one in (every.square().mean(0).sqrt(), largest)]
            own, foreign = (pushes(observer, test, r, threshold) for threshold in (largest, others))
            alarms = float((every.abs() > others).any(1).double().mean())
        cells = (
            f"{k:g}",
            *rows,
            shown(own.soon),
            shown(own.settled),
            f"{shown(foreign.soon)}, {shown(foreign.settled)}",
        )
        lines.append(f"| {' | '.join(cells)} | {alarms:.1%} |")
    text = "\n".join(lines)
    print(text)
    report.finish(arguments, __file__, text, report.machine(), lines=lines[2:])


if __name__ == "__main__":
    main()
