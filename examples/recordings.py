"""Layouts of three public data sets of real arms, with what their fits need to know; for the other examples."""

import gzip
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import torch

from torchdq import ResidualDynamics
from torchdq.learning import Identified, Layout, Motion, Samples, stack_samples


@dataclass(frozen=True)
class Arm(Layout):
    """Layout of a data set, and properties of its arm."""

    files: str = ""
    """Pattern of the names of the data set's files; empty: those of no data set."""
    width: int | None = None
    """Number of columns of a file without a header; None: it has one."""
    robot: str | None = None
    """Name of the shipped robot it was recorded on, if it is one."""
    slow: float = 0.02
    """Speed over which Coulomb friction changes sign [rad/s]: about the noise of the filtered velocity."""
    rotors: bool = False
    """True: torques are taken at the motors, before the rotors' inertia."""


LAYOUTS = {
    # a header, time [s], q1 ... q7 [rad], qd1 ... [rad/s], tau1 ... measured at the joints [N m]
    "panda": Arm(files="panda_exciting_traj*.csv", robot="panda", joints=7, cutoff_qd=6.0, slow=0.05),
    # no header; time [s], six each of q [rad], qd [rad/s], motor current [A], and twelve desired values
    "ur10e": Arm(
        files="ur-20_*.csv",
        width=31,
        robot="ur10e",
        joints=6,
        columns={"time": "1", "q": "{2}", "qd": "{8}", "tau": "{14}"},
        gain=(10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232),  # drive gains identified with a known payload [N m/A]
        cutoff_qd=7.0,
        cutoff_tau=10.0,
        slow=0.01,
        rotors=True,
    ),
    # a header, time [s], pos_meas1, pos_meas2 [rad], vel_meas1 ... [rad/s], tau_meas1 ... from motor currents [N m]
    "double_pendulum": Arm(
        files="trajectory_*.csv*",
        joints=2,
        columns={"q": "pos_meas{1}", "qd": "vel_meas{1}", "tau": "tau_meas{1}"},
        cutoff_qd=8.0,  # above 8 Hz, the shoulder's torques are those of the shaking mount
        rotors=True,
    ),
    # any other arm, as the package reads it
    "csv": Arm(),
}


def layout_of(path: Path) -> Arm:
    """Layout of a log: a data set's if both the file's name and its columns are that set's, else any other arm's.

    Columns alone say nothing: those of the Panda's log are the ones of any seven joints.
    """
    candidates = [layout for layout in LAYOUTS.values() if fnmatch(path.name, layout.files)]
    if not candidates:
        return LAYOUTS["csv"]
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    with (gzip.open if packed else open)(path, "rt", encoding="utf-8-sig", errors="replace") as file:
        heads = [cell.strip() for cell in file.readline().split(",")]
    for layout in candidates:
        needed = {name for signal in ("time", "q", "qd", "tau") for name in layout.names(signal, layout.joints)}
        if needed <= {*heads} if layout.width is None else len(heads) == layout.width and _are_numbers(heads):
            return layout
    return LAYOUTS["csv"]


@torch.no_grad()
def residual_samples(found: Identified, network: ResidualDynamics, motion: Motion) -> Samples:
    """Samples of a network around `found.layer()`: it learns what predictions leave, not the memory of friction."""
    q, qd, qdd, tau = stack_samples(motion)
    return Samples(q, qd, qdd, tau - found.predict(motion).tau + network.model(q, qd, qdd))


@torch.no_grad()
def predicted(found: Identified, network: ResidualDynamics, motion: Motion) -> Any:
    """Torques of an identified robot and a network, with errors that are smaller where it was trained."""
    alone, (q, qd, *_) = found.predict(motion), stack_samples(motion)
    more, narrower = network.residual(q, qd), network.narrowing(q, qd)
    low, high = ((x - alone.tau) * narrower for x in (alone.low, alone.high))
    tau = alone.tau + more
    return alone._replace(tau=tau, error=narrower * alone.error, low=tau + low, high=tau + high)


def _are_numbers(cells: list[str]) -> bool:
    try:
        return bool([float(cell) for cell in cells])
    except ValueError:
        return False
