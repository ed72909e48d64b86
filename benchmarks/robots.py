"""Every robot of example-robot-data, with a fixed and a floating base: errors against Pinocchio, operations, times.

    python benchmarks/robots.py [--quick] [--json FILE] [--page]

`--page` writes docs/tested-robots.md. Errors are the largest of 20 random states, relative to the largest torque or
force; those of accelerations are divided by the amplification of rounding errors (`torchdq.error_growth`), which is
common to all methods. Mimic joints follow their drivers, and the reference is reduced to the same coordinates. Times
are on one thread.
"""

from __future__ import annotations

import importlib.metadata
import os
import sys
import tempfile
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["TORCHDQ_CACHE"] = tempfile.mkdtemp()  # so that programs are compiled

import numpy as np
import pinocchio as pin
import report
import torch

import torchdq
from torchdq import floating
from torchdq.errors import TorchdqError, UnphysicalError

STATES = 20
BATCH = 4096
PAGE = Path(__file__).resolve().parents[1] / "docs" / "tested-robots.md"
USUAL = (
    "joint.fixed",
    "damping.unused",
    "friction.unused",
    "limits.unused",
    "tip.missing",
    "axis.scaled",
    "link.massless",
)


@dataclass
class Row:
    """One robot on one base."""

    file: str
    base: str
    joints: int
    followers: int
    torques: float  # error
    accelerations: float  # error over growth; NaN: undefined
    multiplications: int  # multiplications of inverse dynamics
    additions: int
    seconds: float  # to record and compile inverse dynamics, without the cache
    nanoseconds: float  # per sample of inverse dynamics
    pinocchio: float  # nanoseconds of one of its calls
    remarks: list[str]


def files() -> list[Path]:
    """URDF files of example-robot-data."""
    known = importlib.metadata.files("example-robot-data") or ()
    return sorted(Path(str(f.locate())).resolve() for f in known if f.suffix == ".urdf")


class Reference:
    """Pinocchio's model of a file, in the coordinates of a robot."""

    def __init__(self, path: Path, robot: torchdq.Robot):
        self.model = pin.buildModelFromUrdf(str(path))
        if robot.floating and "JointModelFreeFlyer" not in (joint.shortname() for joint in self.model.joints):
            self.model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
        self.data = self.model.createData()
        self.robot, self.base = robot, 6 * robot.floating
        joints = [self.model.joints[self.model.getJointId(name)] for name in robot.every_joint]
        self.q_at, self.v_at = [(j.idx_q, j.nq) for j in joints], [j.idx_v for j in joints]
        n, links = robot.n, len(robot.link_names)
        self.S = np.eye(n) if robot.joint_map is None else robot.joint_map.S.numpy()
        self.home = np.zeros(links) if robot.home is None else robot.home.numpy()

    def configuration(self, X: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration of a base pose and coordinates."""
        q = pin.neutral(self.model)
        if self.base:
            r = X[:4]
            position = 2 * (pin.Quaternion(*X[4:]) * pin.Quaternion(*r).conjugate()).coeffs()[:3]
            at = self.model.jointPlacements[1].inverse() * pin.SE3(pin.Quaternion(*r), position)
            q[:7] = pin.SE3ToXYZQUAT(at)
        for (at, size), x in zip(self.q_at, self.S @ z - self.home, strict=True):
            q[at : at + size] = x if size == 1 else (np.cos(x), np.sin(x))
        return q

    def velocity(self, V: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Pinocchio's velocity, (linear, angular) of the base first."""
        v = np.zeros(self.model.nv)
        if self.base:
            v[:6] = [*V[3:], *V[:3]]
        v[self.v_at] = self.S @ z
        return v

    def forces(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Wrench (force, moment) on the base, and forces on the coordinates."""
        tau = pin.rnea(self.model, self.data, q, v, a)
        return np.concatenate([tau[: self.base], self.S.T @ tau[self.v_at]])


def examined(path: Path, base: str, seconds: float) -> Row:
    """Row of a file."""
    torchdq.clear_caches()
    robot = torchdq.Robot.from_urdf(path, base=base, on_unphysical="ignore")
    if not robot.n and not robot.floating:
        raise torchdq.ArgumentError("it has no joints")
    reference, free = Reference(path, robot), robot.floating
    rng = np.random.default_rng(0)
    n, numbers = robot.n, {}
    r, p = rng.normal(size=(STATES, 4)), rng.normal(size=(STATES, 3))
    r /= np.linalg.norm(r, axis=-1, keepdims=True)
    X = torchdq.dq.from_pose(torch.from_numpy(r), torch.from_numpy(p))
    V, A = (torch.from_numpy(rng.normal(size=(STATES, 6))) for _ in range(2))
    q, qd, qdd = (torch.from_numpy(rng.normal(size=(STATES, n))) for _ in range(3))

    def inverse(X: Any, q: Any, V: Any, qd: Any, A: Any, qdd: Any) -> torch.Tensor:
        if not free:
            return torchdq.inverse_dynamics(robot, q, qd, qdd)
        return torch.cat(floating.inverse_dynamics(robot, X, q, V, qd, A, qdd), -1)

    start = time.perf_counter()
    with torchdq.backend("c"):
        found = inverse(X, q, V, qd, A, qdd)
        numbers["seconds"] = time.perf_counter() - start
        configurations = [reference.configuration(x.numpy(), z.numpy()) for x, z in zip(X, q, strict=True)]
        motion = [
            [reference.velocity(a.numpy(), b.numpy()) for a, b in zip(*pair, strict=True)]
            for pair in ((V, qd), (A, qdd))
        ]
        expected = torch.from_numpy(np.stack([reference.forces(*x) for x in zip(configurations, *motion, strict=True)]))
        size = expected.abs().max()
        numbers["torques"] = float((found - expected).abs().max() / size)
        with torchdq.backend("eager"):  # whose program need not be compiled to be compared
            numbers["accelerations"] = _accelerations(robot, X, q, V, qd, expected, A, qdd)
        many = [x[:1].expand(BATCH, -1).contiguous() + 0.0 for x in (X, q, V, qd, A, qdd)]
        once = (configurations[0], motion[0][0], motion[1][0])
        calls = {
            "nanoseconds": (lambda: inverse(*many), BATCH),
            "pinocchio": (lambda: pin.rnea(reference.model, reference.data, *once), 1),
        }
        numbers |= report.least(calls, 5, seconds * len(calls), shortest=0.01)
    name = f"{'floating.' if free else ''}inverse_dynamics"
    count = torchdq.compile(robot, name).count()
    return Row(
        file=f"{path.parent.parent.name}/{path.name}",
        base=base,
        joints=n,
        followers=len(robot.link_names) - n,
        multiplications=count.multiplications,
        additions=count.additions,
        remarks=[
            *_refusal(path, base),
            *(str(note) for note in robot.notes if note.code not in USUAL),
        ],
        **numbers,
    )


def _refusal(path: Path, base: str) -> list[str]:
    """Words for a file that is loaded on request only, because its bodies give wrong numbers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            torchdq.Robot.from_urdf(path, base=base)
        except UnphysicalError:
            return ["from_urdf raises UnphysicalError unless on_unphysical is 'warn', 'ignore' or 'repair'"]
    return []


def _accelerations(robot, X, q, V, qd, forces, A, qdd) -> float:
    """Error of accelerations over the growth of rounding errors; NaN if they are undefined."""
    try:
        if robot.floating:
            found = torch.cat(floating.forward_dynamics(robot, X, q, V, qd, forces[:, 6:], f_base=forces[:, :6]), -1)
            growth, expected = floating.error_growth(robot, X, q), torch.cat([A, qdd], -1)
        else:
            found, growth, expected = (
                torchdq.forward_dynamics(robot, q, qd, forces),
                torchdq.error_growth(robot, q),
                qdd,
            )
    except torchdq.SingularInertiaError:
        return float("nan")
    errors = (found - expected).abs().amax(-1) / expected.abs().amax(-1) / growth
    return float(errors.max()) if bool(errors.isfinite().any()) else float("nan")


def page(rows: list[Row], refused: list[tuple[str, str]], facts: dict[str, str]) -> str:
    """Text of the page."""
    lines = [
        "# Tested robots",
        "",
        "Made by `python benchmarks/robots.py --page`: " + " ".join((__doc__ or "").split(".md. ")[1].split()),
        "A dash means undefined accelerations: a joint has zero effective inertia, or bodies are unphysical. For a "
        "floating base, the last column lists only additional defects.",
        "",
        "| file | base | joints | followers | error of torques | of accelerations | mul + add | compile [s] | "
        "ns | Pinocchio [ns] | defects of the file |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    known = {r.file: r.remarks for r in rows if r.base == "fixed"}
    for r in rows:
        acceleration = "-" if r.accelerations != r.accelerations else f"{r.accelerations:.0e}"
        new = r.remarks if r.base == "fixed" else [x for x in r.remarks if x not in known.get(r.file, ())]
        remarks = "; ".join(new).replace("|", "\\|")
        lines.append(
            f"| {r.file} | {r.base} | {r.joints} | {r.followers or ''} | {r.torques:.0e} | {acceleration} | "
            f"{r.multiplications} + {r.additions} | {r.seconds:.1f} | {r.nanoseconds:.0f} | {r.pinocchio:.0f} | "
            f"{remarks} |"
        )
    lines += ["", *[f"Refused: {file}: {why}" for file, why in refused]]
    return "\n".join([*lines, "", report.source(__file__, facts), ""])


def main() -> None:
    """Examine all robots."""
    options = report.parser(__doc__ or "", "five robots, short measurements")
    given = options.parse_args()
    rows: list[Row] = []
    refused: list[tuple[str, str]] = []
    found = files()[::15] if given.quick else files()
    for path in found:
        for base in ("fixed", "floating"):
            try:
                rows.append(examined(path, base, 0.05 if given.quick else 0.1))
            except TorchdqError as error:
                refused.append((f"{path.parent.parent.name}/{path.name} ({base})", str(error).splitlines()[0]))
            else:
                r = rows[-1]
                errors = f"{r.torques:.1e} {r.accelerations:.1e}"
                print(f"{r.file:60} {r.base:9} {r.joints:3} {errors} {r.nanoseconds:8.0f} ns")
            sys.stdout.flush()
    facts = report.machine("torch", "pin", "example-robot-data")
    text = page(rows, refused, facts)
    if given.page:
        PAGE.write_text(text)
    report.into_json(given.json, machine=facts, rows=[asdict(r) for r in rows], refused=refused)


if __name__ == "__main__":
    main()
