"""Truth about trajectories, found in two ways that share neither formulas nor integrator, and how far these agree.

An error below ten times the agreement is not a measurement: it is shown as being at the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import mpmath
import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

from accuracy import integration
from accuracy.fits import relative
from accuracy.rows import LONG, Formulas
from accuracy.scenes import PERIODS, Case
from accuracy.textbook import Textbook, cross, position, rotation
from torchdq import Robot

Array = np.ndarray


class Truth(NamedTuple):
    """State at the horizon."""

    state: Array  # [batch, 2 n], extended precision
    agreements: dict[str, float]  # largest relative distance between means
    floor: float  # below which an error is not a measurement


def flown(acceleration: Any, case: Case, meshes: list | None = None) -> tuple[Array, list[list[float]]]:
    """State at the horizon and the mesh of every period: extrapolated, or collocated on given meshes."""
    n, T = case.robot.n, case.horizon / PERIODS
    y = np.concatenate([case.q.numpy(), case.qd.numpy()], -1).astype(LONG)
    taken = []
    for k in range(PERIODS):
        torque = case.torque[k].numpy().astype(LONG)

        def slope(y: Array, torque: Array = torque) -> Array:
            return np.concatenate([y[..., n:], acceleration(y[..., :n], y[..., n:], torque)], -1)

        if meshes is None:
            y, steps = integration.extrapolated(slope, y, T, taken[-1][-1] if taken else T / 8)
            taken.append(steps)
        else:
            y = integration.collocated(slope, y, meshes[k])
    return y, taken


def elliptic(case: Case) -> Array:
    """Motion of a pendulum let go at rest, by Jacobi's elliptic functions."""
    robot = case.robot
    states = []
    with mpmath.workdps(40):
        m, l, inertia = (mpmath.mpf(float(x)) for x in (robot.mass[0], -robot.com[0, 1], robot.inertia[0, 5]))
        w = mpmath.sqrt(m * mpmath.mpf(-case.gravity[1]) * l / (inertia + m * l * l))
        for start in case.q[:, 0].tolist():
            k = mpmath.sin(mpmath.mpf(start) / 2)
            u = mpmath.ellipk(k * k) - w * mpmath.mpf(case.horizon)
            sn, cn = (mpmath.ellipfun(name, u, m=k * k) for name in ("sn", "cn"))
            states.append([LONG(mpmath.nstr(x, 30)) for x in (2 * mpmath.asin(k * sn), -2 * k * w * cn)])
    return np.array(states)


def pinocchio_model(robot: Robot, gravity: Sequence[float] | None) -> pin.Model:
    """A robot of revolute joints in Pinocchio."""
    model = pin.Model()
    model.gravity.linear = np.zeros(3) if gravity is None else np.array(gravity)
    index, to_joint = {-1: 0}, {-1: pin.SE3.Identity()}
    for i in range(robot.n):
        home = robot.X_PB_home[i].numpy()
        axis, point = robot.screw[i, :3].numpy(), cross(*robot.screw[i].numpy().reshape(2, 3))
        at = to_joint[robot.parents[i]] * pin.SE3(rotation(home[:4]), position(home)) * pin.SE3(np.eye(3), point)
        index[i] = model.addJoint(
            index[robot.parents[i]], pin.JointModelRevoluteUnaligned(axis), at, robot.joint_names[i]
        )
        to_joint[i] = pin.SE3(np.eye(3), -point)  # the link's frame in the joint's
        xx, xy, yy, xz, yz, zz = robot.inertia[i].tolist()
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        body = pin.Inertia(float(robot.mass[i]), robot.com[i].numpy(), inertia)
        model.appendBodyToJoint(index[i], body, to_joint[i])
    return model


def dop853(case: Case, samples: int, rtol: float = 1e-13, atol: float = 1e-13) -> Array:
    """States of the first samples by Pinocchio's accelerations and scipy's DOP853, in double precision."""
    model, n, T = pinocchio_model(case.robot, case.gravity), case.robot.n, case.horizon / PERIODS
    data, states = model.createData(), []
    for i in range(samples):
        y = np.concatenate([case.q[i].numpy(), case.qd[i].numpy()])
        for k in range(PERIODS):
            torque = case.torque[k, i].numpy()

            def rates(_: float, y: Array, torque: Array = torque) -> Array:
                q, qd = y[:n], y[n:]
                return np.concatenate([qd, pin.aba(model, data, q, qd, torque + case.forces(q, qd))])

            y = solve_ivp(rates, (0.0, T), y, method="DOP853", rtol=rtol, atol=atol).y[:, -1]
        states.append(y)
    return np.array(states)


def truth(case: Case) -> Truth:
    """State at the horizon, by means that are compared."""
    state, meshes = flown(Formulas(case), case)
    second, _ = flown(Textbook.of(case), case, meshes)
    agreements = {"extrapolation and collocation": float(relative(state, second).max())}
    decisive = agreements["extrapolation and collocation"]
    if case.name == "pendulum":
        exact = elliptic(case)
        decisive = agreements["elliptic functions"] = float(relative(state, exact).max())
        state = exact
    third = dop853(case, min(2, len(state)))
    agreements["pinocchio and DOP853, double precision"] = float(relative(third, state[: len(third)]).max())
    return Truth(state, agreements, 10 * decisive)
