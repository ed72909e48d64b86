"""Inverse kinematics of random poses from random starts, on one thread: poses per second, and how many are reached.

    python benchmarks/inverse_kinematics.py [FILE.urdf ...] [--quick] [--json FILE] [--page]

Poses are those of random positions within the limits (a turn where there are none), so that all can be reached; FILEs
are taken beside the arms that ship with the package, for the frame of their tip or of the end of their longest chain. A
pose counts as reached if angle and distance, recomputed from the positions, are within 1e-8 (1e-5 in float32), and
the positions within the limits. One pose is taken from its random start, and from near its solution: 0.02 rad in
every joint. CPU time of the thread.
"""

from __future__ import annotations

import math
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import report
import torch
from torch import Tensor

import torchdq
from torchdq import dq

ARMS = ("panda", "ur10e", "puma560")
NEAR = 0.02  # [rad] from the solution, in every joint
TOLERANCES = {torch.float64: 1e-8, torch.float32: 1e-5}


def end(robot: torchdq.Robot) -> str:
    """Name of the frame to move: the tip, or the link at the end of the longest chain."""
    depths: list[int] = []
    for parent in robot.parents:
        depths.append(1 + (depths[parent] if parent >= 0 else 0))
    return robot.tip or robot.link_names[max(range(len(depths)), key=depths.__getitem__)]


def problem(robot: torchdq.Robot, frame: str, count: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Poses, and starts."""
    g = torch.Generator().manual_seed(0)
    lower, upper = robot.limits.lower.clamp(min=-math.pi * 2), robot.limits.upper.clamp(max=2 * math.pi)
    q, start = lower + (upper - lower) * torch.rand(2, count, robot.n, generator=g, dtype=torch.float64)
    return torchdq.forward_kinematics(robot, q, frame).to(dtype), start.to(dtype)


def row(robot: torchdq.Robot, frame: str, dtype: torch.dtype, count: int) -> str:
    """Row of the table."""
    X, start = problem(robot, frame, count, dtype)
    torchdq.inverse_kinematics(robot, X[:9], frame, start[:9])
    torchdq.inverse_kinematics(robot, X[0], frame, start[0])
    times = []
    for _ in range(3):
        begin = time.thread_time()
        found = torchdq.inverse_kinematics(robot, X, frame, start)
        times.append(time.thread_time() - begin)
    medians = []
    for begins in (start, found.q + NEAR):
        single = []
        for k in range(300):
            begin = time.thread_time()
            torchdq.inverse_kinematics(robot, X[k], frame, begins[k])
            single.append(time.thread_time() - begin)
        medians.append(1e3 * sorted(single)[150])
    there = torchdq.forward_kinematics(robot, found.q.double(), frame)
    off = (dq.Pose(there).inverse() @ dq.Pose(X.double())).log()
    worst = torch.maximum(off[..., :3].norm(dim=-1), off[..., 3:].norm(dim=-1))
    limits = [bound.to(dtype) for bound in robot.limits[:2]]
    kept = ((found.q >= limits[0]) & (found.q <= limits[1])).all(-1)
    reached = 100 * float((kept & (worst <= TOLERANCES[dtype] + 16 * torch.finfo(dtype).eps)).double().mean())
    starts, (far, near) = float(found.starts.double().mean()), medians
    name = f"{robot.name}, {str(dtype).removeprefix('torch.')}"
    rate = f"{count / min(times):,.0f}"
    return f"| {name} | {robot.n} | {rate} | {reached:.2f} % | {starts:.1f} | {far:.2f} ms | {near:.2f} ms |"


def main() -> None:
    """Measure, print, and write where the options ask for it."""
    parser = report.parser(__doc__, "fewer poses")
    parser.add_argument("files", nargs="*")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    count = 2000 if arguments.quick else 50_000
    robots = [torchdq.robots.load(name) for name in ARMS]
    robots += [torchdq.Robot.from_urdf(file, base="fixed", on_unphysical="ignore") for file in arguments.files]
    head = "| arm | joints | poses per second | reached | starts per pose | one pose | from near |"
    lines = [head, "|---|---|---|---|---|---|---|"]
    for robot in robots:
        kinds = TOLERANCES if robot.name == "panda" else (torch.float64,)
        lines += [row(robot, end(robot), dtype, count) for dtype in kinds]
    text = "\n".join(lines)
    print(text)
    report.finish(arguments, __file__, text, report.machine())


if __name__ == "__main__":
    main()
