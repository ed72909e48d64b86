"""Formulations by their time: matrices and dual quaternions, D-H and screws, by one emitter, on one thread.

    python benchmarks/formulations.py [--quick] [--json FILE] [--page]

Every formulation is recorded on the same numbers and compiled by the same emitter, so that nothing differs but the
formulas. Those of the pose have one arm, those of the torques another, with a wrench at the tip, and they are compared
with each other before they are timed. Sines and cosines are computed inside the programs.
"""

from __future__ import annotations

import math
import os
import random
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial, reduce

os.environ.setdefault("OMP_NUM_THREADS", "1")

import report
import torch
from torch import Tensor

import torchdq
from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number
from torchdq.backends.c import COMPILED
from torchdq.dynamics.general import kinematics, rnea
from torchdq.dynamics.joints import Coordinate
from torchdq.dynamics.posed import Row
from torchdq.dynamics.tree import Tree
from torchdq.numbers.count import Cost
from torchdq.paper import cost, homogeneous, printed
from torchdq.program.program import Argument, Program, record

N, BATCH = 7, 4096
ALIKE = 0.03  # times and counts that differ by less are the same


@dataclass
class Formulation:
    """A program, what the formulas it was recorded from cost as they are written, and its time."""

    name: str
    program: Program
    dense: Cost | None = None  # whole matrices and dual quaternions, as the paper counts
    folded: Cost | None = None  # zeros and ones known
    nanoseconds: float = math.nan  # per sample

    @property
    def operations(self) -> tuple[int, int]:
        """Multiplications and additions of the program."""
        count = self.program.count()
        return count.multiplications, count.additions


def displacement(x: Number) -> Coordinate:
    """Terms of a joint's displacement in the exponential of a dual quaternion."""
    half = 0.5 * x
    return Coordinate(x, half.cos(), half.sin())


def turn(x: Number) -> homogeneous.Displacement:
    """Terms of a joint's displacement in Rodrigues' formula."""
    return homogeneous.Displacement(x, x.sin(), 1.0 - x.cos(), x - x.sin())


# --- pose of the tip -------------------------------------------------------------------------------------------------


@dataclass
class Arm:
    """A general arm by Denavit-Hartenberg parameters, and the same arm by screws in the base frame."""

    alpha: list[float]
    a: list[float]
    d: list[float]

    @classmethod
    def random(cls, n: int) -> Arm:
        """An arm without a parallel or perpendicular axis."""
        rng = random.Random(n)
        alpha, a, d = ([rng.uniform(low, high) for _ in range(n)] for low, high in ((0.3, 1.2), (0.1, 0.5), (0.1, 0.5)))
        return cls(alpha, a, d)

    def robot(self) -> torchdq.Robot:
        """The arm with bodies that its kinematics ignore."""
        n = len(self.a)
        bodies = [1.0] * n, torch.zeros(n, 3), torch.eye(3).expand(n, 3, 3)
        return torchdq.Robot.from_dh(self.a, self.alpha, self.d, [0.0] * n, *bodies)

    def screws(self) -> tuple[list, DualQuaternion]:
        """Screws of the joints and pose of the tip in the base frame, at home."""
        axes, pose = [], dq.ONE
        for alpha, a, d in zip(self.alpha, self.a, self.d, strict=True):
            axes.append(screw.ad(screw.columns(pose), ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))))
            twist = math.cos(alpha / 2), math.sin(alpha / 2)
            pose = dq.mul(pose, printed.denavit_hartenberg((1.0, 0.0), twist, a / 2, d / 2))
        return axes, pose

    def htm_dh(self, q: Row) -> list:
        """Matrix of the tip's pose."""
        steps = [
            homogeneous.denavit_hartenberg(x.cos(), x.sin(), (math.cos(alpha), math.sin(alpha)), a, d)
            for x, alpha, a, d in zip(q, self.alpha, self.a, self.d, strict=True)
        ]
        return reduce(homogeneous.product, steps)

    def htm_screws(self, q: Row) -> list:
        """Matrix of the tip's pose, by exponentials."""
        axes, home = self.screws()
        steps = [homogeneous.exponential(homogeneous.generator(s), turn(x)) for s, x in zip(axes, q, strict=True)]
        return reduce(homogeneous.product, [*steps, homogeneous.matrix(home)])

    def udq_dh(self, q: Row) -> DualQuaternion:
        """Dual quaternion of the tip's pose."""
        steps = []
        for x, alpha, a, d in zip(map(displacement, q), self.alpha, self.a, self.d, strict=True):
            twist = math.cos(alpha / 2), math.sin(alpha / 2)
            steps.append(printed.denavit_hartenberg((x.cos, x.sin), twist, a / 2, d / 2))
        return reduce(dq.mul, steps)

    def udq_screws(self, q: Row) -> DualQuaternion:
        """Dual quaternion of the tip's pose, by exponentials."""
        axes, home = self.screws()
        steps = [screw.exp_revolute(s, x.cos, x.sin) for s, x in zip(axes, map(displacement, q), strict=True)]
        return reduce(dq.mul, [*steps, home])


def poses(arm: Arm) -> list[Formulation]:
    """Formulations of the pose of an arm's tip."""

    def pose(name: str, algorithm: Callable[[Row], Sequence[Row]], rows: int, line: str = "") -> Formulation:
        def flat(q: Row) -> dict[str, list[Number]]:
            return {"X": [x for row in algorithm(q)[:rows] for x in row]}

        return Formulation(name, record("pose", [Argument("q", N)], flat), *counted(line, cost.FKM, cost.FKM_FOLDED))

    package = torchdq.compile(arm.robot(), "forward_kinematics", options=("tip",))
    return [
        pose("pose, HTM by D-H", arm.htm_dh, 3, "HTM, D-H"),
        pose("pose, UDQ by D-H", arm.udq_dh, 2, "UDQ, D-H"),
        pose("pose, HTM by screws", arm.htm_screws, 3, "HTM, screws"),
        pose("pose, UDQ by screws", arm.udq_screws, 2, "UDQ, screws"),
        Formulation("pose, this package", package.program),
    ]


def counted(name: str, *tables: Sequence[cost.Line]) -> list[Cost | None]:
    """Cost of a formulation in the tables."""
    return [next((line.at(N) for line in lines if line.name == name), None) for lines in tables]


# --- torques ---------------------------------------------------------------------------------------------------------


def torques(chain: Tree, tip: DualQuaternion) -> list[Formulation]:
    """Formulations of the torques of a chain whose tip exerts a wrench."""

    def htm(q: Row, qd: Row, qdd: Row, f: Row) -> Sequence[Number]:
        back = [turn(-x) for x in q]
        outer = homogeneous.matrix(dq.conj(tip))
        f_tip = (*f[3:], *f[:3])  # Lynch and Park's order
        return homogeneous.rnea(homogeneous.bodies(chain), chain.gravity or (), back, qd, qdd, outer, f_tip)

    def as_printed(q: Row, qd: Row, qdd: Row, f: Row) -> Sequence[Number]:
        return printed.rnea(chain, [None, *map(displacement, q)], qd, qdd, screw.columns(tip), (f[:3], f[3:]))

    def paper_frames(q: Row, qd: Row, qdd: Row, f: Row) -> Sequence[Number]:
        Ad = kinematics.adjoints(kinematics.joint_poses(chain, [None, *map(displacement, q)]))
        exerted = rnea.exerted_wrenches(N + 1, None, (N, screw.columns(tip)), (f[:3], f[3:]))
        return rnea.rnea(chain, Ad, qd, qdd, exerted)

    arguments = [Argument("q", N), Argument("qd", N), Argument("qdd", N), Argument("f_tip", 6)]

    def torque(name: str, algorithm: Callable[..., Sequence[Number]], *costs: Cost | None) -> Formulation:
        return Formulation(name, record("torques", arguments, lambda *x: {"tau": algorithm(*x)}), *costs)

    names = [a.name for a in arguments]
    package = torchdq.compile(cost.robot(chain, tip), "inverse_dynamics", arguments=names)
    return [
        torque("torques, HTM (Lynch and Park)", htm, cost.htm_rnea(N, full=True), cost.htm_rnea(N)),
        torque(
            "torques, DQ, operators as printed", as_printed, cost.dqrnea_as_printed(N, True), cost.dqrnea_as_printed(N)
        ),
        torque("torques, DQ, this package's formulas in the paper's frames", paper_frames, None, cost.dqrnea(N)),
        Formulation("torques, this package", package.program),
    ]


# --- checked and timed -----------------------------------------------------------------------------------------------


def inputs(program: Program) -> list[Tensor]:
    """Random arguments of a program, the same for all that have the same arguments."""
    generator = torch.Generator().manual_seed(0)
    return [2 * torch.rand(BATCH, a.width, generator=generator, dtype=torch.float64) - 1 for a in program.arguments]


Execute = Callable[[Program, Sequence[Tensor]], Sequence[Tensor]]


def compiled(program: Program, x: Sequence[Tensor]) -> Sequence[Tensor]:
    """Results of a program by its kernel."""
    return COMPILED.kernel(program, torch.float64, torch.device("cpu"))(x, BATCH)


def results(formulation: Formulation, execute: Execute) -> Tensor:
    """Torques, or the tip's pose as a matrix."""
    (found,) = execute(formulation.program, inputs(formulation.program))
    if "pose" not in formulation.name:
        return found
    return found.reshape(-1, 3, 4) if found.shape[-1] == 12 else torchdq.dq.to_matrix(found)[:, :3]


def require_agreement(formulations: Sequence[Formulation], execute: Execute = compiled) -> None:
    """Raise an error unless all compute the same."""
    first, *others = [results(f, execute) for f in formulations]
    for formulation, other in zip(formulations[1:], others, strict=True):
        error = float((other - first).abs().max() / first.abs().max())
        if not error < 1e-13:
            raise ArithmeticError(f"{formulation.name} is off by {error:.1e} of {formulations[0].name}")


def time_all(formulations: Sequence[Formulation], seconds: float) -> None:
    """Put times into formulations that take turns."""
    calls = {f.name: (partial(compiled, f.program, inputs(f.program)), BATCH) for f in formulations}
    times = report.least(calls, 5, seconds * len(calls), shortest=0.01)
    for f in formulations:
        f.nanoseconds = times[f.name]


# --- text ------------------------------------------------------------------------------------------------------------


def table(formulations: Sequence[Formulation]) -> str:
    """Counts and times in Markdown."""

    def shown(multiplications: int, additions: int) -> str:
        return f"{multiplications} x, {additions} +"

    heads = [f"{N} general revolute joints, batch {BATCH}, float64", "dense products", "zeros known"]
    heads += ["program, without sines and cosines", "time"]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for f in formulations:
        written = ["" if c is None else shown(*c[:2]) for c in (f.dense, f.folded)]
        lines.append(f"| {f.name} | {' | '.join(written)} | {shown(*f.operations)} | {f.nanoseconds:.1f} ns |")
    return "\n".join(lines)


def verdict(formulations: Sequence[Formulation]) -> str:
    """Verdict on whether dual quaternions cost less than matrices, counted and timed."""
    by_name = {f.name: f for f in formulations}
    pairs = {
        "the pose by D-H": ("pose, UDQ by D-H", "pose, HTM by D-H"),
        "the pose by screws": ("pose, UDQ by screws", "pose, HTM by screws"),
        "the torques": ("torques, DQ, operators as printed", "torques, HTM (Lynch and Park)"),
    }
    ways: dict[str, Callable[[Formulation], float]] = {
        "as the paper counts": lambda f: sum(f.dense[:2]) if f.dense else math.nan,
        "with zeros known": lambda f: sum(f.folded[:2]) if f.folded else math.nan,
        "in the program": lambda f: sum(f.operations),
        "in time": lambda f: f.nanoseconds,
    }
    parts = []
    for way, of in ways.items():
        ratios = {what: of(by_name[ours]) / of(by_name[theirs]) for what, (ours, theirs) in pairs.items()}
        said = [
            f"{'as much' if abs(r - 1) < ALIKE else 'less' if r < 1 else 'more'} for {what} ({r:.2f})"
            for what, r in ratios.items()
        ]
        parts.append(f"{way}, {', '.join(said)}")
    return f"Dual quaternions cost, relative to homogeneous matrices: {'; '.join(parts)}."


def main() -> None:
    arguments = report.parser(__doc__, quick="shorter measurements").parse_args()
    torch.set_num_threads(1)
    groups = [poses(Arm.random(N)), torques(*cost.chain(N))]
    for group in groups:
        require_agreement(group)
        time_all(group, 0.3 if arguments.quick else 2.0)
    formulations = [f for group in groups for f in group]
    text = f"{table(formulations)}\n\n{verdict(formulations)}"
    print(text)
    rows = [{**asdict(f), "program": f.program.count()._asdict()} for f in formulations]
    report.finish(arguments, __file__, text, report.machine(), rows=rows)


if __name__ == "__main__":
    main()
