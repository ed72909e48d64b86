"""Faults in simulated logs, and what is said about them where they are read and where `identify` meets them.

    python benchmarks/faults.py [--quick] [--only WORD] [--json FILE] [--page]

Pinocchio computes the torques of arms whose masses are 10 % larger and whose centres of mass are 1 cm off along every
axis, at 100 Hz, for 40 s. A log is read by `read_log`, and refused there, or identified. "Error" is the RMSE over the
standard deviation of the torque, mean over joints, of the identified robot on a motion without the fault, and "in 95 %"
the share of its torques in the intervals; of faults that belong to the arm, on a motion with the same fault. A fault is
reported if a finding names it, and harmless if the error stays below 0.06, or where nothing is wrong with the log but
what it lacks, the intervals hold 93 % and more.
"""

from __future__ import annotations

import functools
import math
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "tools"))

import numpy as np
import pinocchio as pin
import report
import torch

import torchdq
from torchdq import Robot
from torchdq.errors import TorchdqError
from torchdq.findings import Finding
from torchdq.learning import Layout, LogError, LogWarning, Model, identify, read_log, smooth

SECONDS, RATE = 40.0, 100.0
NOISE, FRICTION = 0.003, 0.1  # relative to the standard deviation of the torque
HARMLESS, HELD = 0.06, 0.93  # error up to which a fault is harmless, and share in the intervals from which it is
DEGREES = 180 / math.pi
GAINS = (10.0, 10.7, 8.5, 9.0, 9.5, 10.1)  # of drives [N m/A]
RATED = (330.0, 330.0, 150.0, 56.0, 56.0, 56.0)  # [N m]

Arrays = dict[str, np.ndarray | None]


class Arm(NamedTuple):
    """Properties of the real arm that its description lacks."""

    payload: Callable[[float], float] = lambda t: 0.0  # mass in the hand [kg], by the time [s]
    tilt: float = 0.0  # of the base [rad]
    stribeck: float = 0.0  # friction at rest beyond that of motion, relative to it
    seconds: float = SECONDS
    speed: float = 1.0  # of the motion


class Fault(NamedTuple):
    """Fault of a log, or of an arm."""

    codes: str  # findings that name it
    change: Callable[[Arrays], Any] = lambda x: None  # edits the arrays of a log
    arm: Arm = Arm()
    layout: Layout = Layout()
    model: Model = Model()
    same: bool = False  # whether the motion to test on has it, too


class Told(NamedTuple):
    """What was said about a fault."""

    fault: str
    arm: str
    error: float  # NaN where the log is refused
    within: float
    findings: tuple[str, ...]
    verdict: str


def motion(robot: Robot, seed: int, arm: Arm) -> tuple[np.ndarray, list[np.ndarray]]:
    """Sums of sines within the limits: times, and q, qd and qdd [rows, n]."""
    g, time = np.random.default_rng(seed), np.arange(0, arm.seconds, 1 / RATE)
    w = 2 * np.pi * 0.1 * np.arange(1, 6)
    size, phase = g.uniform(size=(robot.n, 5)) / w, 6.3 * g.uniform(size=(robot.n, 5))
    angle = arm.speed * w * time[:, None, None] + phase
    waves = (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle))
    q, qd, qdd = (arm.speed**k * (size * x).sum(-1) for k, x in enumerate(waves))
    lower, upper = (x.numpy().clip(-2.5, 2.5) for x in robot.limits[:2])
    scale = np.minimum(0.9 * (upper - lower) / np.ptp(q, axis=0), 2 / abs(qd).max(0))
    return time, [(lower + upper) / 2 + scale * (q - (q.max(0) + q.min(0)) / 2), scale * qd, scale * qdd]


@functools.cache
def model(name: str) -> pin.Model:
    """Pinocchio's model of the real arm, without what it holds."""
    found = import_module("oracles").pinocchio_model(described(name))  # of the tests
    for body in list(found.inertias)[1:]:
        body.mass *= 1.1
        body.inertia *= 1.1
        body.lever += 0.01
    return found


@functools.cache
def described(name: str) -> Robot:
    """Robot as described."""
    return torchdq.robots.load(name).replace(on_unphysical="repair")


@functools.cache
def sizes(name: str) -> np.ndarray:
    """Standard deviations of the torques [n]."""
    tau = torques(model(name), *motion(described(name), 0, Arm(seconds=20.0))[1])
    return tau.std(0).clip(0.02 * tau.std(0).max())


def torques(real: pin.Model, *rows: np.ndarray) -> np.ndarray:
    """Torques [rows, n] without friction."""
    data = real.createData()
    return np.array([pin.rnea(real, data, *row) for row in zip(*rows, strict=True)])


@functools.cache
def recording(name: str, seed: int, arm: Arm) -> Arrays:
    """Log of the real arm, with friction and noise."""
    time, (q, qd, qdd) = motion(described(name), seed, arm)
    real, size = model(name).copy(), sizes(name)
    a = arm.tilt
    real.gravity.linear = 9.81 * np.array([0.6 * math.sin(a), 0.8 * math.sin(a), -math.cos(a)])
    tau, held, empty = np.zeros_like(q), [arm.payload(t) for t in time], real.inertias[real.njoints - 1].copy()
    for mass in set(held):
        rows = np.equal(held, mass)
        real.inertias[real.njoints - 1] = empty + pin.Inertia(mass, np.array([0.0, 0.0, 0.05]), np.zeros((3, 3)))
        tau[rows] = torques(real, q[rows], qd[rows], qdd[rows])
    dry = qd / np.sqrt(qd**2 + 1e-4) * (1 + arm.stribeck * np.exp(-((qd / 0.1) ** 2)))
    tau += FRICTION * size * (qd + dry)
    return {
        "time": time,
        "q": q,
        "qd": qd,
        "tau": tau + NOISE * size * np.random.default_rng(seed).normal(size=q.shape),
    }


def scaled(**factors: float | Sequence[float]) -> Callable[[Arrays], Any]:
    """Change of the scale of signals."""
    return lambda x: x.update({name: x[name] * np.array(factor) for name, factor in factors.items()})


def of(j: int, factor: float, n: int = 6) -> list[float]:
    """Factor of one joint, counted from 1."""
    return [factor if k + 1 == j else 1.0 for k in range(n)]


def ordered(signal: str, *joints: int) -> Callable[[Arrays], Any]:
    """Change of the order of the columns of a signal."""
    return lambda x: x.update({signal: x[signal][:, [j - 1 for j in joints]]})


def rows(keep: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Callable[[Arrays], Any]:
    """Change that keeps some rows, by their times."""

    def change(x: Arrays) -> None:
        some = keep(x["time"], np.random.default_rng(5))
        x.update({name: y[some] for name, y in x.items()})

    return change


def stamps(late: Callable[[np.ndarray, np.random.Generator], np.ndarray], qd: bool = True) -> Callable[[Arrays], Any]:
    """Change of the time stamps; without velocities, if there are none to contradict them."""

    def change(x: Arrays) -> None:
        x["time"] = late(x["time"], np.random.default_rng(5))
        x["qd"] = x["qd"] if qd else None

    return change


def rounded(steps: float, *signals: str) -> Callable[[Arrays], Any]:
    """Change of signals to so many steps of a turn, or of a range."""

    def change(x: Arrays) -> None:
        for name in signals:
            step = 2 * np.pi / steps if name == "q" else np.ptp(x[name], axis=0) / steps
            x[name] = np.round(x[name] / step) * step
        x["qd"] = None if "q" in signals else x["qd"]

    return change


def frozen(x: Arrays) -> None:
    """Torques that stay the same for three seconds."""
    at = np.flatnonzero((x["time"] > 20) & (x["time"] < 23))
    x["tau"] = x["tau"].copy()
    x["tau"][at] = x["tau"][at[0]]


def clipped(x: Arrays) -> None:
    """Torques that are cut off at 40 % of their range."""
    most = 0.4 * abs(x["tau"]).max(0)
    x["tau"] = x["tau"].clip(-most, most)


def dropouts(x: Arrays) -> None:
    """Torques that are zero in single rows."""
    x["tau"] = np.where(np.random.default_rng(5).uniform(size=(len(x["tau"]), 1)) < 0.005, 0.0, x["tau"])


def weightless(x: Arrays) -> None:
    """Torques from which the drives have removed gravity."""
    real = model("ur10e")
    data = real.createData()
    x["tau"] = x["tau"] - np.array([pin.computeGeneralizedGravity(real, data, q) for q in x["q"]])


def outlier(x: Arrays) -> None:
    """A torque that leaps in a single row."""
    x["tau"] = x["tau"].copy()
    x["tau"][1234, 2] = 1e4


def still(x: Arrays) -> None:
    """Three joints that hardly move."""
    x["q"] = x["q"] * [1, 1, 1, 0, 0, 0]
    x["qd"] = x["qd"] * [1, 1, 1, 0, 0, 0]
    tau = torques(model("ur10e"), x["q"], x["qd"], np.gradient(x["qd"], x["time"], axis=0))
    size = sizes("ur10e")
    x["tau"] = tau + FRICTION * size * (x["qd"] + x["qd"] / np.sqrt(x["qd"] ** 2 + 1e-4))


def missing(x: Arrays) -> None:
    """A number that is missing."""
    x["tau"] = x["tau"].copy()
    x["tau"][1234, 2] = np.nan


def shifted(j: int, offset: float) -> Callable[[Arrays], Any]:
    """Change of a joint's zero, counted from 1; or of the last one, -1."""

    def change(x: Arrays) -> None:
        x["q"] = x["q"] + offset * np.eye(x["q"].shape[1])[j - (j > 0)]

    return change


def negated(j: int) -> Callable[[Arrays], Any]:
    """Change of the sign of a joint in all signals."""
    return scaled(**dict.fromkeys(("q", "qd", "tau"), of(j, -1.0)))


CURRENTS = Layout(gain=None)
UNIT = "q.unit qd.unit position.limits velocity.limits motion.unit columns.rate"
DT = "time.scale"
MIDDLE, LAST = Arm(payload=lambda t: 3.0 * (t > SECONDS / 2)), Arm(payload=lambda t: 3.0 * (t > 0.8 * SECONDS))
ATTACKS = {
    "positions and velocities in degrees": Fault(UNIT, scaled(q=DEGREES, qd=DEGREES)),
    "those of joint 1 alone": Fault(UNIT, scaled(q=of(1, DEGREES), qd=of(1, DEGREES))),
    "velocities in turns per minute": Fault(UNIT, scaled(qd=30 / math.pi)),
    "velocities in degrees per second": Fault(UNIT, scaled(qd=DEGREES)),
    "times in milliseconds": Fault("time.unit", scaled(time=1000.0)),
    "times in minutes": Fault("columns.rate log.short", scaled(time=1 / 60)),
    "torques in mN m": Fault("torque.unit", scaled(tau=1000.0)),
    "torques in kgf cm": Fault("torque.unit", scaled(tau=10.2)),
    "torques in percent of the rated ones": Fault(
        "torque.unit torque.factor torque.current", scaled(tau=[100 / x for x in RATED])
    ),
    "currents as torques": Fault("torque.current torque.unit", scaled(tau=[1 / x for x in GAINS])),
    "currents without gains": Fault("gains.unknown", scaled(tau=[1 / x for x in GAINS]), layout=CURRENTS),
    "currents, gains estimated": Fault(
        "", scaled(tau=[1 / x for x in GAINS]), layout=CURRENTS, model=Model(gains=True)
    ),
    "torques without gravity": Fault("torque.weightless", weightless),
    "sign of all torques": Fault("torque.sign", scaled(tau=-1.0)),
    "sign of torque 3": Fault("torque.sign", scaled(tau=of(3, -1.0))),
    "sign of position and velocity 1": Fault("motion.sign torque.sign", scaled(q=of(1, -1.0), qd=of(1, -1.0))),
    "sign of position and velocity 3": Fault("motion.sign", scaled(q=of(3, -1.0), qd=of(3, -1.0))),
    "sign of velocity 3": Fault("columns.rate", scaled(qd=of(3, -1.0))),
    "torques 2 and 3 exchanged": Fault("columns.swapped", ordered("tau", 1, 3, 2, 4, 5, 6)),
    "torques reversed": Fault("columns.reversed", ordered("tau", 6, 5, 4, 3, 2, 1)),
    "positions 4 and 5 exchanged": Fault("columns.order", ordered("q", 1, 2, 3, 5, 4, 6)),
    "a gap of 1.5 s": Fault("time.gap", rows(lambda t, g: (t < 20) | (t > 21.5))),
    "a number missing": Fault("cell.number", missing),
    "a torque that leaps": Fault("torque.outliers", outlier),
    "1.5 s of motion": Fault("log.short rows.few", arm=Arm(seconds=1.5)),
    "three joints at rest": Fault("joint.unexcited", still),
    "sign of joint 2 in all signals": Fault("motion.sign", negated(2)),
    "sign of joint 5 in all signals": Fault("motion.sign", negated(5)),
    "zero of joint 3 off by a quarter turn": Fault("joint.zero", shifted(3, math.pi / 2)),
    "zero of joint 2 off by 0.3 rad": Fault("joint.zero", shifted(2, 0.3), same=True),
    "torque constant of joint 3 off by 14 %": Fault("torque.factor", scaled(tau=of(3, 1 / 0.88)), same=True),
    "base tilted by 10 degrees": Fault("base.tilt", arm=Arm(tilt=math.radians(10)), same=True),
    "a payload of 3 kg from the middle on": Fault("payload.changed", arm=MIDDLE),
    "torques frozen for 3 s": Fault("signal.frozen", frozen),
    "torques clipped at 40 %": Fault("torque.clipped", clipped),
    "time steps twice as long, no velocities": Fault(DT, stamps(lambda t, g: 2 * t, qd=False)),
    "time steps 10 % longer, no velocities": Fault(DT, stamps(lambda t, g: 1.1 * t, qd=False)),
    "positions of 12 bits": Fault("", rounded(2**12, "q")),
    "positions of 10 bits": Fault("", rounded(2**10, "q")),
    "torques in steps of 5 % of their range": Fault("", rounded(20, "tau")),
    "30 % of the rows missing": Fault("", rows(lambda t, g: g.uniform(size=len(t)) > 0.3)),
    "every stamp twice": Fault("", rows(lambda t, g: np.repeat(np.arange(len(t)), 2))),
    "stamps rounded to 10 ms": Fault("", stamps(lambda t, g: np.round(t + 0.004 * g.uniform(size=len(t)), 2))),
    "stamps that jitter by 2 ms": Fault("", stamps(lambda t, g: np.sort(t + 0.002 * g.normal(size=len(t))))),
    "torques of zero in single rows": Fault("torque.outliers", dropouts),
    "50 rows a second": Fault("", rows(lambda t, g: np.arange(0, len(t), 2))),
    "5 s of motion": Fault("", arm=Arm(seconds=5.0)),
    "friction that sticks": Fault("", arm=Arm(stribeck=1.5)),
}
OTHERS = {
    "none": Fault(""),
    "a motion a tenth as fast": Fault("", arm=Arm(speed=0.1)),
    "payload of 2 kg": Fault("", arm=Arm(payload=lambda t: 2.0), same=True),
    "a payload of 3 kg in the last fifth": Fault("payload.changed", arm=LAST),
    "time steps 10 % longer": Fault(DT, stamps(lambda t, g: 1.1 * t)),
    "zero of joint 2 off by 0.1 rad": Fault("joint.zero", shifted(2, 0.1), same=True),
    "zero of joint 4 off by 0.3 rad": Fault("joint.zero", shifted(4, 0.3), same=True),
    "zero of joint 4 off by 0.03 rad": Fault("joint.zero", shifted(4, 0.03), same=True),
    "zero of joint 1 off by 0.3 rad": Fault("joint.zero", shifted(1, 0.3), same=True),
    "zero of the last joint off by 0.3 rad": Fault("joint.zero", shifted(-1, 0.3), same=True),
    "torques of all joints 14 % too large": Fault("torque.factor", scaled(tau=1 / 0.88), same=True),
    "base tilted by 2 degrees": Fault("base.tilt", arm=Arm(tilt=math.radians(2)), same=True),
}


def told(name: str, fault: Fault, arm: str) -> Told:
    """What is said about a fault of an arm."""
    robot, found = described(arm), list[Finding]()
    error = within = math.nan
    train, test = recording(arm, 0, fault.arm).copy(), recording(arm, 1, fault.arm if fault.same else Arm()).copy()
    fault.change(train)
    if fault.same:
        fault.change(test)
    try:
        log = read_log(train, fault.layout, robot=robot)
        found += log.findings
        identified = identify(robot, smooth(log, rate=50.0), fault.model)
        found += identified.findings
        motion = smooth(read_log(test))
        predicted = identified.predict(motion)  # in N m, so errors of gains count
        tau = torch.from_numpy(motion.tau)
        error = float(((predicted.tau - tau).std(0) / tau.std(0)).mean())
        within = float(((tau >= predicted.low) & (tau <= predicted.high)).double().mean())
    except LogError as refused:
        found += refused.findings
    except TorchdqError as refused:
        found += [x for x in refused.args if isinstance(x, Finding)]
    said = [one.code for one in found]
    harmless = error < HARMLESS or (not fault.codes and within > HELD)
    verdict = "reported" if {*fault.codes.split()} & {*said} else "harmless" if harmless else "silent"
    some = [f"{one.code} {one.subject}".strip() + (f" {one.value:.3g}" if one.value else "") for one in found]
    return Told(name, arm, error, within, tuple(dict.fromkeys(some)), verdict)


def page(found: Sequence[Told]) -> str:
    """Table for the documentation."""
    lines = ["| fault | arm | error | in 95 % | findings | |", "|---|---|---|---|---|---|"]
    for one in found:
        numbers = "| refused | " if math.isnan(one.error) else f"| {one.error:.3f} | {one.within:.0%} "
        some = ", ".join(one.findings[:4]) + (", ..." if len(one.findings) > 4 else "")
        lines.append(f"| {one.fault} | {one.arm} {numbers}| {some or 'nothing'} | {one.verdict} |")
    return "\n".join(lines)


def main() -> None:
    """Table of all faults."""
    parser = report.parser(__doc__, "the attacks alone")
    parser.add_argument("--only", default="", help="faults whose names hold this")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", LogWarning)
    found = []
    for arm, faults in (("ur10e", ATTACKS), ("ur10e", OTHERS), ("panda", OTHERS))[: 1 if arguments.quick else 3]:
        for name, fault in faults.items():
            if arguments.only in name:
                found.append(told(name, fault, arm))
                print(*found[-1], sep="  ", flush=True)
    attacks = [one for one in found if one.fault in ATTACKS]
    print(f"{sum(one.verdict != 'silent' for one in attacks)} of {len(attacks)} reported or harmless")
    report.finish(arguments, __file__, page(found), report.machine("pin"), faults=[one._asdict() for one in found])


if __name__ == "__main__":
    main()
