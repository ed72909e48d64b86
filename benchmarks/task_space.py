"""Times of control in task space beside inverse dynamics, 4096 Pandas on one thread.

    python benchmarks/task_space.py [--quick] [--json FILE] [--page]

All functions take turns, and the least processor time counts, checks of arguments included.
"""

from __future__ import annotations

import os
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")

import report
import torch
from torch import Tensor

import torchdq

SAMPLES = 4096
GAINS = {"kp": 150.0, "kd": 24.5}
SPRING = {"stiffness": 400.0, "damping": 40.0}


def functions(dtype: torch.dtype) -> dict[str, Callable[[], Tensor | tuple[Tensor, ...]]]:
    """Calls to be timed, by their names on the page."""
    robot, g = torchdq.robots.load("panda"), torch.Generator().manual_seed(0)
    q, qd, there = (torch.randn(3, SAMPLES, robot.n, generator=g, dtype=torch.float64)).to(dtype)
    X = torchdq.forward_kinematics(robot, there, "tip")
    law = torchdq.operational_space_control
    return {
        "inverse dynamics": lambda: torchdq.inverse_dynamics(robot, q, qd, there),
        "operational-space control": lambda: law(robot, q, qd, X, **GAINS),
        "the same in world axes": lambda: law(robot, q, qd, X, **GAINS, expressed="world"),
        "with a posture": lambda: law(robot, q, qd, X, **GAINS, q_null=there),
        "with limits": lambda: law(robot, q, qd, X, **GAINS, limits=True),
        "without damping": lambda: law(robot, q, qd, X, **GAINS, damping=None),
        "Cartesian impedance": lambda: torchdq.cartesian_impedance(robot, q, qd, X, **SPRING),
        "Lambda, mu, p, J, Jdot qd, Jbar": lambda: torchdq.operational_space(robot, q, qd),
        "Coriolis matrix": lambda: torchdq.coriolis_matrix(robot, q, qd),
        "motion of the tip": lambda: torchdq.frame_motion(robot, q, qd, there),
    }


def times(dtype: torch.dtype, rounds: int) -> dict[str, float]:
    """Least time of every function [ms]."""
    # some calls in a turn: memory and code are in the caches then, as in a loop of control
    found = report.least({name: (call, 1) for name, call in functions(dtype).items()}, rounds, shortest=2e-3)
    return {name: 1e-6 * time for name, time in found.items()}


def main() -> None:
    """Measure, print, and write where the options ask for it."""
    arguments = report.parser(__doc__, "fewer rounds").parse_args()
    torch.set_num_threads(1)
    found = {dtype: times(dtype, 50 if arguments.quick else 500) for dtype in (torch.float32, torch.float64)}
    head = ("4096 seven-joint arms", "float32", "of inverse dynamics", "float64", "of inverse dynamics")
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for name in found[torch.float64]:
        cells = [f"{row[name]:.2f} ms | {row[name] / row['inverse dynamics']:.1f} x" for row in found.values()]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    text = "\n".join(lines)
    print(text)
    report.finish(arguments, __file__, text, report.machine(), times=[{str(d): x for d, x in found.items()}])


if __name__ == "__main__":
    main()
