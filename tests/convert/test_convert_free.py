"""Converters of floating bases: there and back, values and derivatives, against Pinocchio and MuJoCo themselves."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import torch
from free_flyers import B, case, motion
from helpers import all_in_one
from messages import refused

import torchdq
from torchdq import convert, dq, floating

F64 = torch.float64
C, M = case("tree4"), motion(case("tree4"))
COM = torch.tensor([0.1, -0.3, 0.2], dtype=F64)
X, Q, V, QD, A, QDD, F, TAU = (M[x] for x in ("X_WB", "q", "V_WB_B", "qd", "A_WB_B", "qdd", "f_base", "tau"))

# name: conversion, its inverse, arguments
PAIRS = {
    "Pinocchio's configuration": (convert.configuration_to_pinocchio, convert.configuration_from_pinocchio, (X, Q)),
    "Pinocchio's velocity": (convert.velocity_to_pinocchio, convert.velocity_from_pinocchio, (V, QD)),
    "Pinocchio's forces": (convert.forces_to_pinocchio, convert.forces_from_pinocchio, (F, TAU)),
    "MuJoCo's configuration": (convert.configuration_to_mujoco, convert.configuration_from_mujoco, (X, Q)),
    "MuJoCo's velocity": (
        lambda *x: convert.velocity_to_mujoco(X, *x),
        lambda y: convert.velocity_from_mujoco(X, y),
        (V, QD),
    ),
    "MuJoCo's acceleration": (
        lambda *x: convert.acceleration_to_mujoco(X, V, *x),
        lambda y: convert.acceleration_from_mujoco(X, V, y),
        (A, QDD),
    ),
    "MuJoCo's forces": (
        lambda *x: convert.forces_to_mujoco(X, *x),
        lambda y: convert.forces_from_mujoco(X, y),
        (F, TAU),
    ),
    "Isaac's wrench": (
        lambda f: torch.cat(convert.wrench_to_isaac(f, COM), -1),
        lambda y: (convert.wrench_from_isaac(y[..., :3], y[..., 3:], COM),),
        (F,),
    ),
    **{
        f"Isaac's root, {order}, {com}": (
            lambda *x, order=order, com=com: convert.root_to_isaac(*x, order, com),
            lambda y, order=order, com=com: convert.root_from_isaac(y, order, com),
            (X, V),
        )
        for order in ("wxyz", "xyzw")
        for com in (None, COM)
    },
    **{
        f"Isaac's acceleration, {com}": (
            lambda a, com=com: convert.acceleration_to_isaac(X, V, a, com),
            lambda y, com=com: (convert.acceleration_from_isaac(X, V, y, com),),
            (A,),
        )
        for com in (None, COM)
    },
}
EVERY = pytest.mark.parametrize("pair", PAIRS)


def near(found, expected, tolerance=1e-13):
    np.testing.assert_allclose(np.asarray(found), np.asarray(expected), rtol=0, atol=tolerance * 10)


@EVERY
def test_there_and_back(pair):
    there, back, given = PAIRS[pair]
    for found, x in zip(back(there(*given)), given, strict=True):
        near(found, x)


@EVERY
def test_derivatives_there_and_back(pair):
    there, back, given = PAIRS[pair]
    leaves = [x.clone().requires_grad_() for x in given]
    row = there(*given).detach().requires_grad_()
    torch.autograd.gradcheck(there, leaves, fast_mode=True)
    torch.autograd.gradcheck(back, row, fast_mode=True)
    # the derivative of there and back is the identity, along motions that the pose can make
    tangents = [torch.randn_like(x) for x in given]
    if given[0] is X:
        tangents[0] = 0.5 * dq.mul(X, torch.cat([0 * V[:, :1], V[:, :3], 0 * V[:, :1], V[:, 3:]], -1))
    _, moved = torch.autograd.functional.jvp(lambda *x: tuple(back(there(*x))), given, tuple(tangents))
    for found, tangent in zip(moved, tangents, strict=True):
        near(found, tangent)


def test_velocities_are_the_rates_of_configurations():
    """Velocities of MuJoCo and Isaac in world axes, and their rates, by differentiation in time along X exp(V t/2)."""
    zero = torch.zeros(B, 1, dtype=F64)

    def moving(t):
        twist = V + A * t  # to first order, which one derivative of a velocity needs
        return dq.mul(X, dq.exp(0.5 * (V * t + 0.5 * A * t * t))), twist

    _, rates = torch.autograd.functional.jvp(
        lambda t: convert.configuration_to_mujoco(moving(t)[0], Q), zero, torch.ones_like(zero)
    )
    near(rates[:, :3], convert.velocity_to_mujoco(X, V, QD)[:, :3])
    near(rates[:, :3], convert.root_to_isaac(X, V)[:, 7:10])
    _, rates = torch.autograd.functional.jvp(
        lambda t: convert.velocity_to_mujoco(*moving(t), QD), zero, torch.ones_like(zero)
    )
    near(rates[:, :6], convert.acceleration_to_mujoco(X, V, A, QDD)[:, :6])
    for com in (None, COM):
        _, rates = torch.autograd.functional.jvp(
            lambda t, com=com: convert.root_to_isaac(*moving(t), com=com), zero, torch.ones_like(zero)
        )
        near(rates[:, 7:], convert.acceleration_to_isaac(X, V, A, com))


def test_pinocchio_computes_our_forces_from_converted_motions():
    order = [joint.idx_v - 6 for joint in C.joints]
    put = torch.zeros(C.robot.n, dtype=torch.long)
    put[order] = torch.arange(C.robot.n)  # our joint of each of Pinocchio's
    rows = [
        convert.configuration_to_pinocchio(X, Q[:, put]),
        convert.velocity_to_pinocchio(V, QD[:, put]),
        convert.velocity_to_pinocchio(A, QDD[:, put]),
    ]
    F_B, tau = floating.inverse_dynamics(C.robot, X, Q, V, QD, A, QDD)
    data = C.model.createData()
    expected = [pin.rnea(C.model, data, *(x[k].numpy() for x in rows)) for k in range(B)]
    near(convert.forces_to_pinocchio(F_B, tau[:, put]), expected, 1e-12)


SATELLITE = """
<mujoco><option gravity="0.5 -1 -9.81"/><worldbody><body name="base">
  <freejoint/><inertial pos="0.1 -0.2 0.05" mass="3" diaginertia="0.3 0.25 0.2"/>
  <body name="upper" pos="0.2 0.1 0.3">
    <joint name="hinge" type="hinge" axis="0 0.6 0.8"/>
    <inertial pos="0 0.1 0.2" mass="1.5" diaginertia="0.03 0.02 0.02"/>
    <body name="lower" pos="0.1 0 0.5">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <inertial pos="0.05 0 0.1" mass="0.7" diaginertia="0.01 0.01 0.005"/>
    </body>
  </body>
</body></worldbody></mujoco>"""


def test_mujoco_computes_our_forces_and_accelerations(tmp_path):
    file = tmp_path / "satellite.xml"
    file.write_text(SATELLITE)
    robot, (q, qd, qdd, tau) = torchdq.Robot.from_mjcf(file), (x[:, :2] for x in (Q, QD, QDD, TAU))
    model = mujoco.MjModel.from_xml_string(SATELLITE)
    data = mujoco.MjData(model)
    F_B, torques = floating.inverse_dynamics(robot, X, q, V, qd, A, qdd)
    found = floating.forward_dynamics(robot, X, q, V, qd, tau, f_base=F)
    forces, accelerations = convert.forces_to_mujoco(X, F_B, torques), convert.acceleration_to_mujoco(X, V, *found)
    applied, moved = convert.forces_to_mujoco(X, F, tau), convert.acceleration_to_mujoco(X, V, A, qdd)
    for k in range(B):
        data.qpos[:] = convert.configuration_to_mujoco(X, q)[k]
        data.qvel[:] = convert.velocity_to_mujoco(X, V, qd)[k]
        data.qacc[:] = moved[k]
        mujoco.mj_inverse(model, data)
        near(forces[k], data.qfrc_inverse, 1e-12)
        data.qfrc_applied[:] = applied[k]
        mujoco.mj_forward(model, data)
        near(accelerations[k], data.qacc, 1e-11)


def test_rows_that_are_too_short_are_named():
    for f in (
        convert.configuration_from_pinocchio,
        convert.configuration_from_mujoco,
        lambda x: convert.velocity_from_mujoco(X[0], x),
        convert.root_from_isaac,
    ):
        with refused(torchdq.ArgumentError):
            f(torch.zeros(4))
    with refused(torchdq.ArgumentError):
        convert.root_to_isaac(X, V, "zyxw")


QUATERNIONS = {
    "configuration": (convert.configuration_from_pinocchio, 9),
    "qpos": (convert.configuration_from_mujoco, 9),
    "state": (convert.root_from_isaac, 13),
}


@all_in_one(QUATERNIONS)
def test_quaternions_that_are_not_unit_are_named(name):
    convert_row, width = QUATERNIONS[name]
    rows = torch.zeros(3, width, dtype=torch.float64)
    rows[:, 3:7] = torch.tensor([0.5, -0.5, 0.5, 0.5])
    good = convert_row(rows)[0]
    wrong = rows.clone()
    wrong[1, 3:7] = torch.tensor([1.0, 1.0, 0.0, 0.0])
    for bad in (wrong, wrong[1], wrong.float(), rows * torch.inf, 0 * rows):
        with refused(torchdq.ArgumentError):
            convert_row(bad)
    assert torch.equal(torch.func.vmap(convert_row)(wrong)[0][::2], good[::2])  # values cannot be read there
    missing = rows.clone()
    missing[1] = torch.nan
    found = convert_row(missing)[0]
    assert torch.equal(found[::2], good[::2]) and bool(found[1].isnan().all())
    printed = torch.tensor([0.182574, 0.365148, 0.547723, 0.730297])  # six digits
    convert_row(torch.cat([rows[0, :3], printed.double(), rows[0, 7:]]))
    assert convert_row(rows[:0])[0].shape == (0, 8)


def test_arrays_of_mujoco_are_copied():
    row = np.array([1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.6])
    found = [convert.from_mujoco(row[:3], row[3:7]), *convert.configuration_from_mujoco(row)]
    before = [x.clone() for x in found]
    row[:] = 2.0
    assert all(map(torch.equal, found, before))
