"""Layouts of three public data sets of real arms, with what their fits need to know; for the other examples."""

import gzip
from dataclasses import dataclass
from pathlib import Path

from torchdq.learning import Layout


@dataclass(frozen=True)
class Arm(Layout):
    """Layout of a data set, and properties of its arm."""

    robot: str | None = None
    """Name of the shipped robot it was recorded on, if it is one."""
    slow: float = 0.02
    """Speed over which Coulomb friction changes sign [rad/s]: about the noise of the filtered velocity."""
    rotors: bool = False
    """True: torques are taken at the motors, before the rotors' inertia."""


LAYOUTS = {
    # a header, time [s], q1 ... q7 [rad], qd1 ... [rad/s], tau1 ... measured at the joints [N m]
    "panda": Arm(robot="panda", joints=7, cutoff_qd=6.0, slow=0.05),
    # no header; time [s], six each of q [rad], qd [rad/s], motor current [A], and twelve desired values
    "ur10e": Arm(
        robot="ur10e",
        joints=6,
        blocks=("q", "qd", "current", "current_des", "tau_des"),
        header=False,
        gain=(10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232),  # drive gains identified with a known payload [N m/A]
        cutoff_qd=7.0,
        cutoff_tau=10.0,
        slow=0.01,
        rotors=True,
    ),
    # a header, time [s], pos_meas1, pos_meas2 [rad], vel_meas1 ... [rad/s], tau_meas1 ... from motor currents [N m]
    "double_pendulum": Arm(
        joints=2,
        blocks=("pos_meas", "vel_meas", "tau_meas"),
        cutoff_qd=8.0,  # above 8 Hz, the shoulder's torques are those of the shaking mount
        rotors=True,
    ),
    # any other arm, as the package reads it
    "csv": Arm(),
}


def layout_of(path: Path) -> Arm:
    """Layout of a log by its first line; any seven joints are taken for a Panda's, an archive for any other arm's."""
    with path.open("rb") as file:
        start = file.read(2)
    if start == b"PK":
        return LAYOUTS["csv"]
    with (gzip.open if start == b"\x1f\x8b" else open)(path, "rt", encoding="utf-8-sig", errors="replace") as file:
        heads = [cell.strip() for cell in file.readline().split(",")]
    if "time" not in heads:
        return LAYOUTS["ur10e"]
    for layout in LAYOUTS.values():
        if layout.header and layout.joints == sum(x.removeprefix(layout.blocks[0]).isdecimal() for x in heads):
            return layout
    return LAYOUTS["csv"]
