"""Experiment 8: the motion of the seven-joint arm in other packages, error against time, and the gradient of a rollout.

All have the same robot, torques, gravity and damping, in float64 on one thread. MuJoCo steps in C, by its `rollout`.
Pinocchio has accelerations and their derivatives: steps are taken in Python, or by scipy. torchdiffeq, if it is
installed, integrates the accelerations of torchdq. Times are per arm: of one arm, or of one of 4096 where it is said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pinocchio as pin
import report
import torch
from mujoco import rollout
from pages.pictures import SMALL, Curve, Picture, svg
from pages.text import table
from torch import Tensor

import torchdq
from accuracy import fits, references
from accuracy.methods import adaptive
from accuracy.rows import LONG
from accuracy.scenes import PERIODS, Case, arm7
from accuracy.textbook import cross, position
from torchdq.scene import integrators

PICTURE = report.ROOT / "docs/pictures/precision.svg"
ALTERNATIVE = (
    "Error of one second of motion of a Panda against the time of its simulation on one thread, in torchdq, MuJoCo, "
    "Pinocchio and torchdiffeq"
)
BATCH, STEPS = 4096, 8  # arms, and steps of a timed rollout of them: the time of a step does not depend on its size
OURS, ONE, ADAPTIVE = "torchdq RK4", "torchdq RK4, one arm", "torchdq DormandPrince"
PINOCCHIO, SCIPY, DIFFEQ = "Pinocchio RK4", "Pinocchio DOP853", "torchdiffeq"
MUJOCO = {
    "MuJoCo RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "MuJoCo implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "MuJoCo Euler": mujoco.mjtIntegrator.mjINT_EULER,
}
METHODS = (OURS, ONE, ADAPTIVE, *MUJOCO, PINOCCHIO, SCIPY, DIFFEQ)
DRAWN = {  # looks, words and their places in the picture, which leaves out three methods of the table
    OURS: (("blue", "-"), (f"torchdq RK4,\n{BATCH} arms", 1.5, 2e-8)),
    ONE: (("blue", "--"), ("one arm", 720, 1e-9)),
    DIFFEQ: (("grey", "-"), ("torchdiffeq", 90, 2e-11)),
    "MuJoCo RK4": (("orange", "-"), ("MuJoCo\nRK4", 2000, 4e-11)),
    "MuJoCo implicitfast": (("orange", "--"), ("MuJoCo\nimplicitfast", 5000, 2e-2)),
    PINOCCHIO: (("ink", "-"), ("Pinocchio\nRK4", 8500, 3e-8)),
}
ERRORS = (1e-3, 1e-6, 1e-9)  # of the table
SECTION = f"""### The same motion in other packages

![{ALTERNATIVE}](pictures/{PICTURE.name})"""
Array = np.ndarray


class Run(NamedTuple):
    """A method at a setting."""

    method: str
    setting: float  # number of steps, or relative tolerance
    end: Callable[[], Array]  # states of the arms of the case at the horizon [batch, 2 n]
    call: Callable[[], Any]  # is timed
    per: float  # arms of the timed call, times the part of the motion that it makes


# --- MuJoCo ----------------------------------------------------------------------------------------------------------


def mujoco_model(case: Case, integrator: int, dt: float) -> mujoco.MjModel:
    """A robot of revolute joints with damping and a motor at each of them."""
    robot, spec = case.robot, mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator, spec.option.gravity = dt, integrator, case.gravity
    damping = -case.forces(np.zeros(robot.n), np.ones(robot.n))
    bodies = {-1: spec.worldbody}
    for i, name in enumerate(robot.joint_names):
        home, (axis, moment) = robot.X_PB_home[i].numpy(), robot.screw[i].numpy().reshape(2, 3)
        xx, xy, yy, xz, yz, zz = robot.inertia[i].tolist()
        bodies[i] = bodies[robot.parents[i]].add_body(
            pos=position(home),
            quat=home[:4],
            mass=float(robot.mass[i]),
            ipos=robot.com[i].numpy(),
            fullinertia=[xx, yy, zz, xy, xz, yz],
            explicitinertial=True,
        )
        bodies[i].add_joint(
            name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, pos=cross(axis, moment), damping=[damping[i], 0, 0]
        )
        spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
    return spec.compile()


def mujoco_run(case: Case, method: str, steps: int) -> Run:
    """Steps in C, all torques of a motion in one call."""
    model = mujoco_model(case, MUJOCO[method], case.horizon / steps)
    data, zeros = mujoco.MjData(model), np.zeros((len(case.q), 1))
    start = np.concatenate([zeros, case.q.numpy(), case.qd.numpy()], -1)
    control = np.repeat(case.torque.numpy().swapaxes(0, 1), steps // PERIODS, axis=1)

    def call() -> Array:
        return rollout.rollout(model, data, start, control)[0][:, -1, 1:]

    return Run(method, steps, call, call, len(start))


# --- Pinocchio -------------------------------------------------------------------------------------------------------


def pinocchio_run(case: Case, steps: int) -> Run:
    """Classical Runge-Kutta steps in Python."""
    model, n, h = references.pinocchio_model(case.robot, case.gravity), case.robot.n, case.horizon / steps
    data, damping = model.createData(), -case.forces(np.zeros(n), np.ones(n))

    def slope(y: Array, torque: Array) -> Array:
        qd = y[n:]
        return np.concatenate([qd, pin.aba(model, data, y[:n], qd, torque - damping * qd)])

    def flown(i: int) -> Array:
        y = np.concatenate([case.q[i].numpy(), case.qd[i].numpy()])
        for torque in case.torque[:, i].numpy():
            for _ in range(steps // PERIODS):
                a = slope(y, torque)
                b = slope(y + h / 2 * a, torque)
                c = slope(y + h / 2 * b, torque)
                d = slope(y + h * c, torque)
                y = y + h / 6 * (a + 2 * (b + c) + d)
        return y

    return Run(PINOCCHIO, steps, lambda: np.array([flown(i) for i in range(len(case.q))]), lambda: flown(0), 1)


def scipy_run(case: Case, rtol: float) -> Run:
    """DOP853 of scipy at a tolerance."""

    def flown(arms: int) -> Array:
        return references.dop853(case, arms, rtol, 1e-3 * rtol)

    return Run(SCIPY, rtol, lambda: flown(len(case.q)), lambda: flown(1), 1)


# --- torchdq and torchdiffeq -----------------------------------------------------------------------------------------


def torchdq_run(case: Case, steps: int, batch: int) -> Run:
    """Rollout of one arm, or of many, of which some steps are timed."""
    scene = case.scene.replace(integrator=integrators.RungeKutta4(), dt=case.horizon / steps)

    def flown(arms: Tensor, taken: int) -> Callable[[], Tensor]:
        state = scene.start(case.q[arms], case.qd[arms])
        torque = case.torque[:, arms].repeat_interleave(steps // PERIODS, 0)[:taken]
        return lambda: torch.cat(scene.rollout(state, torque, ends=True)[:2], -1)

    rows, taken = torch.arange(max(batch, len(case.q))) % len(case.q), min(steps, STEPS) if batch > 1 else steps
    end = flown(rows[: len(case.q)], steps)
    return Run(
        OURS if batch > 1 else ONE, steps, lambda: end().numpy(), flown(rows[:batch], taken), batch * taken / steps
    )


def adaptive_run(case: Case, rtol: float) -> Run:
    """DormandPrince at a tolerance."""
    end = adaptive(case, "float64", rtol)
    return Run(ADAPTIVE, rtol, lambda: end().numpy(), adaptive(case, "float64", rtol, BATCH), BATCH)


def torchdiffeq_run(case: Case, rtol: float) -> Run:
    """`dopri5` on the accelerations of torchdq."""
    from torchdiffeq import odeint

    n, t = case.robot.n, torch.tensor([0.0, case.horizon / PERIODS], dtype=torch.float64)
    damping = -torch.tensor(case.forces(np.zeros(n), np.ones(n)))

    def flown(arms: Tensor) -> Tensor:
        y = torch.cat([case.q[arms], case.qd[arms]], -1)
        for torque in case.torque[:, arms]:

            def slope(_: Tensor, y: Tensor, torque: Tensor = torque) -> Tensor:
                q, qd = y.split(n, -1)
                return torch.cat([qd, torchdq.forward_dynamics(case.robot, q, qd, torque - damping * qd)], -1)

            y = odeint(slope, y, t, rtol=rtol, atol=1e-3 * rtol, method="dopri5")[-1]
        return y

    arms = torch.arange(BATCH) % len(case.q)
    return Run(DIFFEQ, rtol, lambda: flown(arms[: len(case.q)]).numpy(), lambda: flown(arms), BATCH)


def runs(case: Case, quick: bool) -> Iterator[Run]:
    """All methods at their settings."""
    steps = [PERIODS * 2**k for k in range(1, 8 if quick else 9)]
    tolerances = [10.0**-k for k in range(2, 11, 2 if quick else 1)]
    for number in steps:
        yield torchdq_run(case, number, BATCH)
        yield torchdq_run(case, number, 1)
        yield pinocchio_run(case, number)
    for method in MUJOCO:
        finer = 1 if method == "MuJoCo RK4" else 16
        yield from (mujoco_run(case, method, finer * number) for number in steps)
    for rtol in tolerances:
        yield adaptive_run(case, rtol)
        yield scipy_run(case, rtol)
        if find_spec("torchdiffeq"):
            yield torchdiffeq_run(case, rtol)


# --- results ---------------------------------------------------------------------------------------------------------


def measured(quick: bool, truth: references.Truth) -> dict[str, Any]:
    """Errors and times of all methods, and what was left out."""
    case = arm7()
    found = list(runs(case, quick))
    errors = [fits.relative(run.end().astype(LONG), truth.state) for run in found]
    times = report.least({str(k): (run.call, run.per) for k, run in enumerate(found)}, 3 if quick else 10)
    points = [
        {"method": run.method, "setting": run.setting, **fits.judged(error, truth.floor), "nanoseconds": time}
        for run, error, time in zip(found, errors, times.values(), strict=True)
        if np.isfinite(error).all()
    ]
    omitted = [] if find_spec("torchdiffeq") else ["torchdiffeq: not installed"]
    return {"horizon": case.horizon, "points": points, "omitted": omitted}


def picture(found: dict[str, Any]) -> str:
    """Error over time of every method, as SVG."""
    curves = {}
    for method, (look, label) in DRAWN.items():
        points = [p for p in found["points"] if p["method"] == method and p["error_max"] < 1]
        pairs = sorted((p["nanoseconds"] / 1e3, max(p["error_max"], p["floor"])) for p in points)
        # without points that another one of the method beats in time and error
        best = [(x, y) for k, (x, y) in enumerate(pairs) if all(y < other for _, other in pairs[:k])]
        if best:
            curves[method] = Curve(*zip(*best, strict=True), look=look, marker="o", label=label)
    words = ("time of one second of motion, per arm [us]", "largest relative error")
    return svg(Picture(*words, curves, "xy", SMALL))


def reached(found: dict[str, Any], method: str, error: float) -> float | None:
    """Time of a method to an error [us]; None: it does not get there."""
    times = [p["nanoseconds"] for p in found["points"] if p["method"] == method and p["error_max"] <= error]
    return min(times) / 1e3 if times else None


def words(microseconds: float) -> str:
    """A time, to three digits."""
    return f"{float(f'{microseconds:.3g}'):g} us"


def page(results: dict[str, Any]) -> str:
    """Picture, times to some errors, and gradients, as a section of docs/accuracy.md; "": they were not measured."""
    found = results.get("peers")
    if not found:
        return ""
    head = ("one second of motion, per arm, to an error of", *(f"{e:.0e}" for e in ERRORS))
    lines = []
    for method in (x for x in METHODS if any(p["method"] == x for p in found["points"])):
        times = [reached(found, method, error) for error in ERRORS]
        lines.append((method, *("not reached" if t is None else words(t) for t in times)))
    gradients = [
        (
            p["way"],
            f"{p['error_max']:.0e}" if p["measured"] else f"below {p['floor']:.0e}",
            words(p["nanoseconds"] / 1e3),
        )
        for p in results["gradients"]["points"]
        if p["precision"] == "float64"
    ]
    title = (f"gradient of {results['gradients']['steps']} steps, float64", "error", "time per arm")
    return "\n\n".join([SECTION, table(head, lines), table(title, gradients)])


# --- gradients -------------------------------------------------------------------------------------------------------


def by_mujoco(x: Array, steps: int, dt: float, epsilon: float) -> Array:
    """Gradient of the loss of `gradients.rolled` by finite differences of every step, chained backwards."""
    case = arm7()
    model = mujoco_model(case, mujoco.mjtIntegrator.mjINT_EULER, dt)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP  # damping at the start of the step, as the others
    data, n = mujoco.MjData(model), case.robot.n
    A, B = np.zeros((steps, 2 * n, 2 * n)), np.zeros((steps, 2 * n, n))
    found = np.empty_like(x)
    for row, out in zip(x, found, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = row.reshape(3, n)
        for k in range(steps):
            mujoco.mjd_transitionFD(model, data, epsilon, True, A[k], B[k], None, None)
            mujoco.mj_step(model, data)
        adjoint, torque = np.concatenate([2 * data.qpos, np.zeros(n)]), np.zeros(n)
        for k in reversed(range(steps)):
            torque += adjoint @ B[k]
            adjoint = adjoint @ A[k]
        out[:] = np.concatenate([adjoint, torque])
    return found


def by_pinocchio(x: Array, steps: int, dt: float) -> Array:
    """Gradient by analytic derivatives of the accelerations at every step, chained backwards."""
    case = arm7()
    model, n = references.pinocchio_model(case.robot, case.gravity), case.robot.n
    data, damping = model.createData(), -case.forces(np.zeros(n), np.ones(n))
    found = np.empty_like(x)
    for row, out in zip(x, found, strict=True):
        q, qd, torque = row.reshape(3, n)
        kept = []
        for _ in range(steps):
            dq, dqd, du = (y.copy() for y in pin.computeABADerivatives(model, data, q, qd, torque - damping * qd))
            kept.append((dq, dqd - du * damping, du))
            qd = qd + dt * data.ddq
            q = q + dt * qd
        of_q, of_qd, of_u = 2 * q, np.zeros(n), np.zeros(n)
        for dq, dqd, du in reversed(kept):
            of_qd = of_qd + dt * of_q
            force = dt * of_qd
            of_q, of_qd, of_u = of_q + force @ dq, of_qd + force @ dqd, of_u + force @ du
        out[:] = np.concatenate([of_q, of_qd, of_u])
    return found
