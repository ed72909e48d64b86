"""Swing-up of a two-link arm with weak motors, planned with CasADi and Ipopt on torques of torchdq.

    python examples/14_casadi.py

The inverse dynamics of all knots is exported as one C function with its first and second derivatives, built by the C
compiler and loaded by `casadi.external`, so that Ipopt uses exact Hessians. Unknowns are positions, velocities and
accelerations at the knots; accelerations are linear between knots, so that the collocation is exact, and the torques
are bounded at every knot. The plan is verified outside of CasADi: by torchdq's forward dynamics at the knots, and by a
scene in which the planned torques alone move the arm.
"""

import math
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import torch
import tyro

import torchdq
from torchdq import Scene, effects
from torchdq.scene import integrators

START, GOAL = [-math.pi / 2, 0.0], [math.pi / 2, 0.0]  # hanging down, standing up [rad]


@dataclass
class Args:
    duration: float = 1.5
    """Time of the swing [s]."""
    knots: int = 31
    """Number of knots."""
    bounds: tuple[float, float] = (12.0, 5.0)
    """Largest torques; the first joint needs 19.6 to hold the arm out [N m]."""


class Plan(NamedTuple):
    """Motion at the knots [knots, joints], and what the solver says of it."""

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    tau: torch.Tensor
    violation: float  # largest of a constraint
    stats: dict[str, Any]


def exported(robot: torchdq.Robot, knots: int, folder: Path) -> ca.Function:
    """Inverse dynamics of a robot at all knots in CasADi, with first and second derivatives."""
    made = torchdq.compile(robot, "inverse_dynamics").export(folder, "torques", language="casadi", knots=knots)
    flags = ["-shared", "-fPIC", "-O2", "-ftree-vectorize", "-march=native", "-fno-math-errno"]
    subprocess.run(["cc", *flags, made.source, "-o", folder / "torques.so", "-lm"], check=True)
    return ca.external("torques", str(folder / "torques.so"))


def planned(torques: ca.Function, args: Args) -> Plan:
    """Swing with the least squares of the torques."""
    n, h = len(START), args.duration / (args.knots - 1)
    q, qd, qdd = (ca.MX.sym(name, n, args.knots) for name in ("q", "qd", "qdd"))
    tau = torques(q, qd, qdd) / np.array(args.bounds)

    before, after = slice(None, -1), slice(1, None)
    a, b = qdd[:, before], qdd[:, after]
    steps = ca.veccat(
        (q[:, after] - q[:, before]) / h - qd[:, before] - h / 6 * (2 * a + b),
        qd[:, after] - qd[:, before] - h / 2 * (a + b),
    )
    equal = ca.vertcat(steps, q[:, 0] - START, q[:, -1] - GOAL, qd[:, 0], qd[:, -1])
    x = ca.veccat(q, qd, qdd)
    problem = {"x": x, "f": h * ca.sumsqr(tau), "g": ca.vertcat(equal, ca.vec(tau))}

    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}
    solver = ca.nlpsol("solver", "ipopt", problem, quiet)

    widest = np.concatenate([np.zeros(equal.numel()), np.ones(n * args.knots)])
    line = np.linspace(START, GOAL, args.knots).ravel()
    found = solver(x0=[*line, *np.zeros(2 * line.size)], lbg=-widest, ubg=widest)
    violation = np.maximum(np.abs(found["g"].full()[:, 0]) - widest, 0).max()
    motion = ca.Function("motion", [x], [q, qd, qdd, tau * np.array(args.bounds)])(found["x"])
    return Plan(*(torch.from_numpy(rows.full().T.copy()) for rows in motion), float(violation), solver.stats())


def swung(robot: torchdq.Robot, plan: Plan, duration: float, steps: int = 1500) -> torch.Tensor:
    """Positions at the end of a scene that the torques of the plan alone drive, also between the knots."""
    h, dt = duration / (len(plan.q) - 1), duration / steps
    time = (torch.arange(steps, dtype=torch.float64) + 0.5) * dt
    k = (time / h).long()
    q, qd, qdd, t = plan.q[k], plan.qd[k], plan.qdd[k], (time - k * h).unsqueeze(-1)
    rate = (plan.qdd[k + 1] - qdd) / h
    moved = q + t * qd + t**2 / 2 * qdd + t**3 / 6 * rate
    tau = torchdq.inverse_dynamics(robot, moved, qd + t * qdd + t**2 / 2 * rate, qdd + t * rate)
    scene = Scene(robot, (effects.Gravity(),), integrator=integrators.RungeKutta4(), dt=dt)
    return scene.rollout(scene.start(plan.q[0]), tau).q[-1]


def main(args: Args) -> dict[str, float]:
    """Number of iterations, largest violation of a constraint, and errors by torchdq's own dynamics."""
    robot = torchdq.robots.load("two_link")
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        torques = exported(robot, args.knots, Path(folder))
        built = time.perf_counter()
        plan = planned(torques, args)
        end = time.perf_counter()
    largest = plan.tau.abs().amax(0) / torch.tensor(args.bounds)
    accelerations = (torchdq.forward_dynamics(robot, plan.q, plan.qd, plan.tau) - plan.qdd).abs().max()
    miss = (swung(robot, plan, args.duration) - torch.tensor(GOAL)).abs().max()
    iterations = plan.stats["iter_count"]
    print(f"inverse dynamics exported and built in {built - begin:.1f} s")
    print(f"{plan.stats['return_status']}: {iterations} iterations in {end - built:.2f} s")
    print(f"constraints hold to {plan.violation:.1e}; torques up to {largest.tolist()} of their bounds")
    print(f"torchdq's accelerations are the plan's to {accelerations:.1e} rad/s^2; the arm ends {miss:.1e} rad off")
    return {
        "iterations": iterations,
        "violation": plan.violation,
        "accelerations": float(accelerations),
        "miss": float(miss),
    }


if __name__ == "__main__":
    found = main(tyro.cli(Args))
    sys.exit(0 if max(found["violation"], found["accelerations"]) < 1e-6 and found["miss"] < 1e-3 else 1)
