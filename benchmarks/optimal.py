"""Reaches of a Panda by optimal control, beside Crocoddyl on the same problems, on one thread.

    python benchmarks/optimal.py [--quick] [--json FILE] [--page]

The tip goes to a point and to rest in 50 steps of 20 ms, from 64 starts to as many goals, with torques without limits,
within those of the description, and within 0.3 of them. Solvers take turns, to a tolerance of 1e-9, and the least
processor time of a problem counts. Crocoddyl is optional: `pip install crocoddyl==3.2.1 pin==4.0.0`, in an environment
of its own, since it needs that Pinocchio. It is refused if its costs of given torques are others.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import report
import torch
from pages.text import table
from peers import urdf
from torch import Tensor

import torchdq
from torchdq import Scene, dq, effects, optimal
from torchdq.scene.integrators import SemiImplicitEuler

try:
    import crocoddyl
    import pinocchio as pin
except ImportError:
    crocoddyl = None

STEPS, DT, TIP = 50, 0.02, "panda_hand_tcp"
TORQUE, SPEED, POSTURE = 1e-4, 1e-2, 1e-2  # weights of a second
REACHED, STOPPED = 1e3, 10.0  # and of the end
PATH = urdf("example-robot-data", "panda.urdf")
JOINTS = [f"panda_joint{k}" for k in range(1, 8)]
ROBOT = torchdq.Robot.from_urdf(PATH, joints=JOINTS, tip=TIP)
SCENE = Scene(ROBOT, (effects.Gravity(),), integrator=SemiImplicitEuler(), dt=DT)
HOME = torch.tensor([0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.8], dtype=torch.float64)
EFFORT = ROBOT.limits.effort


def starts(count: int) -> tuple[Tensor, Tensor]:
    """Positions of starts, and goals of the tip; the first of more are those of fewer."""
    x = torch.from_numpy(np.random.default_rng(0).uniform(-1.0, 1.0, (count, 2, 7)))
    q = HOME + x * torch.tensor([[0.3], [0.6]])
    return q[:, 0], dq.translation(torchdq.forward_kinematics(ROBOT, q[:, 1], TIP))


def reaching(q: Tensor, goal: Tensor, scale: float | None) -> optimal.Problem:
    """Problem of the starts."""
    on = torch.ones(STEPS, *[1] * q.ndim, dtype=torch.float64)
    on[-1] = 0.0  # the last state has costs of its own
    costs = [optimal.Torques(DT * TORQUE), optimal.Speeds(DT * SPEED * on), optimal.Posture(q, DT * POSTURE * on)]
    final = [optimal.Point(TIP, goal, REACHED), optimal.Speeds(STOPPED)]
    return optimal.Problem(SCENE, STEPS, costs, final, scale and (-scale * EFFORT, scale * EFFORT))


class Crocoddyl:
    """Solutions by Crocoddyl, one problem after the other."""

    def __init__(self, q: Tensor, goal: Tensor) -> None:
        full = pin.buildModelFromUrdf(str(PATH))
        locked = [k for k, name in enumerate(full.names) if k and name not in JOINTS]
        model = pin.buildReducedModel(full, locked, pin.neutral(full))
        self.state, self.tip = crocoddyl.StateMultibody(model), model.getFrameId(TIP)
        self.hold = torchdq.inverse_dynamics(ROBOT, q).numpy()
        self.q, self.goal = q.numpy(), goal.numpy()

    def problem(self, k: int, scale: float) -> Any:
        """Problem of a start."""
        state, start = self.state, np.concatenate([self.q[k], np.zeros(7)])
        knots = []
        for last in (False, True):
            weights = np.repeat([0.0, STOPPED] if last else [POSTURE, SPEED], 7)
            weighted = crocoddyl.ActivationModelWeightedQuad(weights)
            costs, of_state = crocoddyl.CostModelSum(state), crocoddyl.ResidualModelState(state, start)
            costs.addCost("state", crocoddyl.CostModelResidual(state, weighted, of_state), 1.0)
            if last:
                residual = crocoddyl.ResidualModelFrameTranslation(state, self.tip, self.goal[k])
                costs.addCost("tip", crocoddyl.CostModelResidual(state, residual), REACHED)
            else:
                costs.addCost(
                    "torque", crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelControl(state)), TORQUE
                )
            full = crocoddyl.ActuationModelFull(state)
            dynamics = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, full, costs)
            knots.append(crocoddyl.IntegratedActionModelEuler(dynamics, 0.0 if last else DT))
        knots[0].u_lb, knots[0].u_ub = -scale * EFFORT.numpy(), scale * EFFORT.numpy()
        found = crocoddyl.ShootingProblem(start, [knots[0]] * STEPS, knots[1])
        found.nthreads = 1
        return found

    def require_equal_costs(self) -> None:
        """Raise unless costs of torques that are near those that hold the arm are those of torchdq."""
        noise = 0.02 * np.random.default_rng(1).normal(size=(STEPS, *self.hold.shape))
        ours = reaching(torch.tensor(self.q), torch.tensor(self.goal), None)
        costs = ours.cost(SCENE.start(torch.tensor(self.q)), torch.from_numpy(self.hold + noise)).tolist()
        for k, cost in enumerate(costs):
            problem, u = self.problem(k, 1.0), list(self.hold[k] + noise[:, k])
            theirs = problem.calc(problem.rollout(u), u)
            if abs(theirs - cost) > 1e-6 * cost:
                raise SystemExit(f"the cost of Crocoddyl is {theirs} where that of torchdq is {cost}")

    def solved(self, solver: str, scale: float) -> np.ndarray:
        """Costs of a solver."""
        costs = []
        for k, hold in enumerate(self.hold):
            problem, boxed = self.problem(k, scale), "Box" in solver
            found = getattr(crocoddyl, solver)(problem)
            found.th_stop = 1e-9
            u = [np.clip(hold, problem.runningModels[0].u_lb, problem.runningModels[0].u_ub) if boxed else hold] * STEPS
            found.solve(problem.rollout(u) if boxed else [problem.x0] * (STEPS + 1), u, 100, boxed)
            costs.append(found.cost)
        return np.array(costs)


def ticks(q: Tensor, goal: Tensor, count: int) -> Tensor:
    """Times of ticks of a receding horizon of one arm, from Python [us], the least first."""
    mpc, state, times = optimal.Receding(reaching(q, goal, 1.0)), SCENE.start(q), []
    for _ in range(count + 1):
        begin = time.perf_counter()
        torque, _ = mpc(state)
        times.append(1e6 * (time.perf_counter() - begin))
        state = SCENE.step(state, torque)
    return torch.tensor(times[1:]).sort().values


class TicksInC(NamedTuple):
    """Times of ticks of the same horizon in C [us], the least first, size of its text [MB] and time to compile [s]."""

    times: Tensor
    size: float
    built: float


def ticks_in_c(q: Tensor, goal: Tensor, count: int) -> TicksInC:
    """Ticks of an exported receding horizon, in the states of those from Python."""
    mpc, state = optimal.Receding(reaching(q, goal, 1.0)), SCENE.start(q)
    mpc(state)
    with tempfile.TemporaryDirectory() as folder:
        made, library = mpc.export(folder, "panda_mpc"), f"{folder}/panda_mpc.so"
        size, begin = made.source.stat().st_size / 1e6, sum(os.times()[2:4])
        flags = ["-std=c99", "-O3", "-march=native", "-shared", "-fPIC"]
        subprocess.run(["cc", *flags, made.source, "-o", library, "-lm"], check=True)
        built, called = sum(os.times()[2:4]) - begin, ctypes.CDLL(library)
    memory, times = (ctypes.c_double * 100_000)(), []
    called.panda_mpc_begin(memory)
    torque, gain = torch.zeros_like(q), torch.zeros(7 * 14, dtype=q.dtype)
    for _ in range(count):
        pointers = [ctypes.c_void_p(x.data_ptr()) for x in (state.q, state.qd, torque, gain)]
        begin = time.perf_counter()
        status = called.panda_mpc_tick(memory, *pointers)
        times.append(1e6 * (time.perf_counter() - begin))
        if status or not torch.allclose(torque, mpc(state)[0], rtol=1e-6, atol=1e-6):
            raise SystemExit("ticks in C are not those of Python")
        state = SCENE.step(state, torque)
    return TicksInC(torch.tensor(times).sort().values, size, built)


def sampled(count: int) -> float:
    """Least time of an iteration of MPPI with 4096 samples of 30 steps, float32 [ms]."""
    q, goal = (x[0].float() for x in starts(1))
    costs = [optimal.Torques(1e-6), optimal.Point(TIP, goal, 1.0), optimal.Speeds(1e-3)]
    problem, state = optimal.Problem(SCENE, 30, costs), SCENE.start(q)

    def solve(iterations: int) -> float:
        begin = time.thread_time()
        optimal.solve(problem, state, method=optimal.MPPI(4096, knots=8), iterations=iterations)
        return time.thread_time() - begin

    return 1e3 * min(solve(11) - solve(1) for _ in range(count)) / 10


def main() -> None:
    """Measure, print, and write where the options ask for it."""
    arguments = report.parser(__doc__, "fewer problems and turns").parse_args()
    torch.set_num_threads(1)
    count, turns = (16, 2) if arguments.quick else (64, 5)
    q, goal = starts(count)
    state, rows = SCENE.start(q), []
    crowd, aims = starts(4 * count)
    peer = None if crocoddyl is None else Crocoddyl(q, goal)
    if peer is not None:
        peer.require_equal_costs()
    begin = time.perf_counter()
    optimal.solve(reaching(q, goal, 1.0), state)
    first = time.perf_counter() - begin
    for name, scale in (("none", None), ("x 1", 1.0), ("x 0.3", 0.3)):
        problem, many = reaching(q, goal, scale), reaching(crowd, aims, scale)
        plan = optimal.solve(problem, state)
        kinds: dict[str, tuple[Callable[[], object], int]] = {
            f"torchdq, {count} at once": (lambda problem=problem: optimal.solve(problem, state), count),
            f"torchdq, {4 * count} at once": (lambda many=many: optimal.solve(many, SCENE.start(crowd)), 4 * count),
        }
        costs = dict.fromkeys(kinds, plan.cost.numpy())
        costs[f"torchdq, {4 * count} at once"] = optimal.solve(many, SCENE.start(crowd)).cost.numpy()
        for solver in ("SolverFDDP", "SolverDDP") if scale is None else ("SolverBoxFDDP",):
            if peer is not None:
                costs[solver] = peer.solved(solver, scale or 1.0)
                kinds[solver] = (lambda solver=solver, scale=scale: peer.solved(solver, scale or 1.0), count)
        best = report.least(kinds, turns if scale is None else 2)
        for kind, ns in best.items():
            mean, same = costs[kind].mean(), len(costs[kind]) == count
            within = f"{(plan.cost.numpy() <= 1.01 * costs[kind]).sum()} of {count}" if same else "-"
            rows.append((name, kind, f"{ns / 1e6:.2f}", f"{mean:.7f}", within))
    header = ("limits", "solver", "ms a problem", "mean cost", "where ours is within 1 %")
    times, inside, sampling = ticks(q[0], goal[0], 1000), ticks_in_c(q[0], goal[0], 1000), sampled(turns)
    lines = [
        ("first solution with limits of a new process", f"{first:.1f} s"),
        (
            "tick of a receding horizon from Python, one arm",
            f"{times.median():.0f} us, 99 % {times.quantile(0.99):.0f}",
        ),
        ("tick of the same exported to C", f"{inside.times.median():.0f} us"),
        ("its C, by -O3 -march=native", f"{inside.size:.1f} MB, compiled in {inside.built:.1f} s"),
        ("iteration of MPPI, 4096 samples of 30 steps, float32", f"{sampling:.1f} ms"),
    ]
    text = "\n\n".join([table(header, rows), report.table("Optimal control, Panda, 50 steps", lines)])
    print(text)
    packages = () if crocoddyl is None else ("crocoddyl",)
    report.finish(arguments, __file__, text, report.machine(*packages), rows=rows, lines=lines)


if __name__ == "__main__":
    main()
