"""Hard cases of robot descriptions: what is missing, locked in a gimbal, tiny, of any length, or a tree.

What is malformed or hostile is refused in robot/urdf, and wounded at random there. Here are pinocchio's readings of the
same texts in both precisions, operation by operation and compiled, and numbers to the last digit by mpmath.
"""

import itertools
import math

import mpmath
import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import double
from messages import refused
from oracles import EPS, Case, over, size_of_torques, states, worst
from precisions import F64, every_backend, every_backend_and_dtype
from urdf_text import LIMIT, also, arm, fixed, joint, link, mimic, urdf

import torchdq
from torchdq import Robot, Scene, SingularInertiaError, dq, effects

# --- U1, U5, U9, U10: what pinocchio reads in the same text ----------------------------------------------------------

ON_FIXED_JOINTS = (
    link("tool", 0.2, xyz=(0.1, 0, 0), rpy=(0.3, 0, 0.1)),
    link("flange", None),
    fixed("a", "lower", "flange", (0.1, 0.2, 0.3), (0.4, 0.5, 0.6)),
    fixed("b", "flange", "tool", (0, 0.1, 0), (0, -0.5, 0)),
)
BRANCHES = (
    *ON_FIXED_JOINTS,
    link("slide", 0.4),
    link("wheel", 0.3),
    joint("rail", "upper", "slide", "prismatic", (0, -0.2, 0), (0, 0, 1), (0, 2, 1)),
    joint("axle", "base", "wheel", axis=(1, 1, 1)),
)
DUST = {"mass": 1e-9, "inertia": (2e-15, 0, 2e-15, 0, 0, 3e-15), "xyz": (1e-3, 0, 0), "rpy": (0, math.pi / 2, 0)}
TEXTS = {
    "U1": (
        *(link("flange", None), link("cross", None), link("tip", 2), fixed("a", "lower", "flange", (0.1, 0.2, 0.3))),
        *(joint("c", "flange", "cross"), joint("d", "cross", "tip", axis="1 0 0")),
    ),
    "U5": ON_FIXED_JOINTS,
    "U9": (link("dust", **DUST), joint("j", "lower", "dust", xyz=(1e-3, 0, 0), rpy=(0.3, -math.pi / 2, 0.2))),
    "U10": BRANCHES,
}
TEXTS = {id: also("".join(more)) for id, more in TEXTS.items()}
every_text = pytest.mark.parametrize("id", [pytest.param(id, marks=pytest.mark.case(id)) for id in TEXTS])


def reading(id):
    """The robot of a text, with pinocchio's own reading."""
    return Case(Robot.from_urdf(TEXTS[id]), pin.buildModelFromXML(TEXTS[id]))


@every_backend_and_dtype
@every_text
def test_dynamics_are_those_of_pinocchios_own_reading(id, dtype, backend, margin):
    """A cross and a flange without mass, links on fixed joints, a grain of dust beyond a gimbal, and a tree of all."""
    case = reading(id)
    s = states(case.robot, 5, dtype=dtype)
    tau = torchdq.inverse_dynamics(case.robot, s.q, s.qd, s.qdd, backend=backend)
    exact = over(lambda model, data, q, v, a, *_: pin.rnea(model, data, q, v, a)[case.order], case, s)
    margin(worst(tau.double(), exact, size_of_torques(case, s)), 8 * EPS[dtype], f"torques of {id}, {dtype}")
    qdd = torchdq.forward_dynamics(case.robot, s.q, s.qd, s.qdd, backend=backend).double().numpy()
    exact = over(lambda model, data, q, v, tau, *_: pin.aba(model, data, q, v, tau)[case.order], case, s)
    growth = torchdq.error_growth(case.robot, s.q.double()).numpy()
    # torques that drive a grain of dust are rounded to its own scale, so the error is that of each row's own joints
    size = np.abs(exact).max(-1, keepdims=True)
    margin((np.abs(qdd - exact) / size).max(), 128 * EPS[dtype] * growth.max(), f"accelerations of {id}, {dtype}")


@pytest.mark.case("U1")
@every_backend_and_dtype
def test_no_inertial_is_one_of_nothing_to_the_bit(dtype, backend):
    robots = [Robot.from_urdf(arm(mass=mass, inertia=(0,) * 6, xyz=(0, 0, 0))) for mass in (None, 0)]
    s = states(robots[0], 5, dtype=dtype)
    for function in (torchdq.inverse_dynamics, torchdq.forward_dynamics):
        assert torch.equal(*(function(robot, s.q, s.qd, s.qdd, backend=backend) for robot in robots))


@pytest.mark.case("U1")
@every_backend
def test_a_joint_that_moves_nothing_has_torques_but_no_accelerations(backend):
    robot, plain = (
        Robot.from_urdf(also(link("finger", None) + joint("knuckle", "lower", "finger"))),
        Robot.from_urdf(arm()),
    )
    assert robot.notes[0].text().startswith("joint 'knuckle': it moves no inertia")
    s = states(robot, 5)
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, backend=backend)
    expected = torchdq.inverse_dynamics(plain, *(x[:, :2] for x in (s.q, s.qd, s.qdd)), backend=backend)
    assert torch.equal(tau[:, 2], torch.zeros(5, dtype=F64))
    assert (tau[:, :2] - expected).abs().max() <= 64 * EPS[F64] * expected.abs().max()
    with refused(SingularInertiaError):
        torchdq.forward_dynamics(robot, s.q, s.qd, tau, backend=backend)


@pytest.mark.case("U5")
def test_links_on_fixed_joints_are_lumped_as_pinocchio_lumps_them(margin):
    case = reading("U10")
    for i, (own, placement) in enumerate(zip(case.joints, case.link_placements(), strict=True)):
        body = placement.actInv(case.model.inertias[own.id])
        xx, xy, yy, xz, yz, zz = case.robot.inertia[i].tolist()
        ours = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        margin(abs(float(case.robot.mass[i]) - body.mass) / body.mass, 2 * EPS[F64], "mass")
        margin(np.abs(case.robot.com[i].numpy() - body.lever).max(), 4 * EPS[F64] * np.abs(body.lever).max(), "centre")
        margin(np.abs(ours - body.inertia).max(), 16 * EPS[F64] * np.abs(body.inertia).max(), "inertia")


@pytest.mark.case("U10")
@every_backend_and_dtype
def test_branches_of_a_tree_do_not_feel_each_other_to_the_bit(dtype, backend):
    """The mass matrix is zero between them, and no torque depends on what another branch does."""
    robot = Robot.from_urdf(TEXTS["U10"])
    path = [set() for _ in robot.joint_names]  # of a joint: itself and all that carry it
    for i, parent in enumerate(robot.parents):
        path[i] |= {i} | (path[parent] if parent >= 0 else set())
    s = states(robot, 5, dtype=dtype)
    M = torchdq.mass_matrix(robot, s.q, backend=backend)
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, backend=backend)
    apart = [(i, k) for i, k in itertools.permutations(range(robot.n), 2) if i not in path[k] and k not in path[i]]
    assert len(apart) == 2 + 6  # slide beside elbow; the wheel beside all three
    for i, k in apart:
        assert not M[:, i, k].any()
        step = torch.zeros(robot.n, dtype=dtype)
        step[k] = 1.0
        moved = [x + step for x in (s.q, s.qd, s.qdd)]
        assert torch.equal(torchdq.inverse_dynamics(robot, *moved, backend=backend)[:, i], tau[:, i])


# --- U4: mimic joints ------------------------------------------------------------------------------------------------

MIMICS = {
    "a chain": ("", mimic("shoulder"), mimic("elbow", -2)),
    "a circle": (mimic("elbow"), mimic("shoulder"), ""),
    "itself": (mimic("shoulder"), "", ""),
    "nobody": (mimic("nobody"), "", ""),
    "a multiplier of zero": ("", mimic("shoulder", 0, 9), ""),
}


@pytest.mark.case("U4")
@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
@pytest.mark.parametrize("which", MIMICS)
def test_mimic_joints_of_every_kind_move_by_themselves_and_are_told(which, kind):
    """On request, chains and circles of them are joints like others, and the robot says which."""
    names, links = ("shoulder", "elbow", "c"), ("base", "upper", "lower", "hand")

    def read(mimics):
        joints = zip(names, links, links[1:], mimics, strict=False)
        made = (joint(n, *ends, kind, axis=(0, 1, 0), more=LIMIT + more) for n, *ends, more in joints)
        return Robot.from_urdf(urdf(*map(link, links), *made), mimic="independent")

    robot, plain = read(MIMICS[which]), read(("", "", ""))
    told = ", ".join(name for name, more in zip(names, MIMICS[which], strict=True) if more)
    assert ("unsimulated.mimic", told) in {(x.code, x.subject) for x in robot.notes}
    s = states(plain)
    assert robot.n == 3
    assert torch.equal(*(torchdq.inverse_dynamics(r, s.q, s.qd, s.qdd) for r in (robot, plain)))


# --- U2, U6, U7, U9: numbers -----------------------------------------------------------------------------------------

SPELLINGS = ["1e-9", "1E-9", "0.000000001", "+1.e-9", ".1e-8", "10e-10", "00001e-9"]


@pytest.mark.case("U2", "U9")
@pytest.mark.parametrize(
    "text", [*SPELLINGS, "4.9e-324", "2.2250738585072014e-308", "0.1", "1e22", "123456789.123456789"]
)
def test_a_number_is_read_to_its_last_bit(text):
    """Against the nearest double of its decimals."""
    with mpmath.workdps(60):
        assert Robot.from_urdf(arm(mass=text), on_unphysical="ignore").mass[0].item() == float(mpmath.mpf(text))


def hinge(**placed):
    """A link on one joint."""
    return Robot.from_urdf(urdf(link("base", None), link("a"), joint("j", "base", "a", **placed)))


def turned(rpy):
    """Rotation of roll, pitch and yaw by mpmath."""
    c, s = zip(*((mpmath.cos(mpmath.mpf(x)), mpmath.sin(mpmath.mpf(x))) for x in rpy), strict=True)
    x = mpmath.matrix([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
    y = mpmath.matrix([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
    z = mpmath.matrix([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    return np.array((z * y * x).tolist(), dtype=float)


@pytest.mark.case("U9")
@pytest.mark.parametrize(
    "pitch", [math.pi / 2, -math.pi / 2, math.pi / 2 - 1e-9, math.pi / 2 + 1e-4, math.pi, 1e-9, 7.0]
)
@pytest.mark.parametrize("roll, yaw", [(0.3, 0.2), (0.0, 0.0), (-2.0, 3.1)])
def test_a_frame_in_gimbal_lock_is_turned_exactly(roll, pitch, yaw, margin):
    """Angles become a rotation and never angles again."""
    X = torchdq.forward_kinematics(hinge(rpy=(roll, pitch, yaw)), torch.zeros(1, dtype=F64), "a")
    with mpmath.workdps(50):
        exact = turned((roll, pitch, yaw))
    margin(np.abs(dq.to_matrix(X)[:3, :3].numpy() - exact).max(), 8 * EPS[F64], f"pitch {pitch}")


@pytest.mark.case("U6", "G14")
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("size", ["e-8", "e-3", "e0", "e3", "e49"])
def test_an_axis_of_any_length_is_one_of_unit_length_and_is_told(size, kind, margin):
    """Its direction as good as its numbers."""
    robot = hinge(kind=kind, axis=" ".join(f"{k}{size}" for k in (2, -3, 6)), xyz=(1, 2, 3))
    found, moment = robot.screw[0].split(3) if kind == "revolute" else robot.screw[0].split(3)[::-1]
    margin((found - double(2, -3, 6) / 7).abs().max(), 2 * EPS[F64], "direction")
    margin(abs(float(found.norm()) - 1.0), 2 * EPS[F64], "length")
    margin(abs(float(found @ moment)), 2 * EPS[F64] * max(1.0, float(moment.norm())), "moment along the axis")
    assert ("axis.scaled", "j") in {(x.code, x.subject) for x in robot.notes}


@pytest.mark.case("U7")
def test_limits_of_nothing_are_limits():
    """Effort and velocity of zero, and a range of one point, are taken as they stand by what enforces them."""
    robot = Robot.from_urdf(arm().replace(LIMIT, '<limit lower="0.5" upper="0.5" velocity="0" effort="0"/>'))
    assert [x.tolist() for x in robot.limits] == [[0.5, 0.5], [0.5, 0.5], [0.0, 0.0], [0.0, 0.0]]
    q, torque = double(0.3, 0.7), double(5.0, -5.0)
    held = Scene(robot, (effects.Saturation(),))
    assert torch.equal(held.step(held.start(q), torque).qd, torch.zeros(2, dtype=F64))
    with refused(torchdq.ArgumentError):
        Scene(robot, (effects.TorqueSpeed(),))
    pushed = Scene(robot, (effects.JointLimits(),)).step(held.start(q)).qd
    assert pushed[0] > 0  # back to the only place that is allowed
