"""What must hold for any robot, whatever its numbers: structure, energy, symmetry, and the choice of frames.

No reference implementation is asked. The robots are the shipped ones and random trees of revolute, prismatic and
helical joints with nothing aligned, one of them with rotors. Differences are measured in roundings of the largest
term that enters, since that is what cancels.
"""

from functools import cache

import numpy as np
import pytest
import torch
from helpers import all_in_one
from oracles import random_tree, shipped, states
from robots import ARMS

import torchdq
from torchdq import dq
from torchdq.robot.description import Frame

EPS = 2.0**-52
ROBOTS = {name: shipped(name).robot for name in ARMS}
ROBOTS |= {f"tree{n}": random_tree(n, seed=n, armature=n == 7).robot for n in (1, 4, 7, 11)}
SHORT = ("two_link", "puma560", "tree4", "tree7")  # for what a few robots show as well as all

every_robot = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)
some_robots = pytest.mark.parametrize("robot", [ROBOTS[name] for name in SHORT], ids=SHORT)


def times(M, v):
    return torch.einsum("...ij,...j->...i", M, v)


def inner(a, b):
    return (a * b).sum(-1)


@cache
def closed_form(robot, q, qd):
    """Terms of (63), which most tests of a robot look at: operation by operation they take long."""
    return torchdq.closed_form(robot, q, qd)


def size_of_torques(robot, s):
    """Largest torque [batch] that any one cause asks of any one joint."""
    M, c, g, Jt = closed_form(robot, s.q, s.qd)
    terms = [times(M.abs(), s.qdd.abs()), c.abs(), g.abs(), times(Jt.abs(), s.f_tip.abs())]
    # links throw each other about: a joint passes on the wrench of everything beyond it
    return torch.stack(terms).amax((0, -1))


def agree(found, expected, size):
    """Check rows of components to 20 roundings of a size per row, times the number of components."""
    assert found.shape == expected.shape
    assert found.isfinite().all()
    error = (found - expected).abs().amax(-1)
    allowed = 20 * found.shape[-1] * EPS * size
    assert (error <= allowed).all(), f"off by {(error / allowed).max():.3g} times what is allowed"


# --- what equals what ------------------------------------------------------------------------------------------------


def torques(robot, s, **other):
    """Torques of a motion without wrenches, or with other arguments."""
    return torchdq.inverse_dynamics(robot, **{"q": s.q, "qd": s.qd, "qdd": s.qdd} | other)


def size_of_rates(robot, s):
    """Size [batch] of momenta that change with the velocities, also where, as for one joint, they cancel."""
    M = torchdq.mass_matrix(robot, s.q)
    return times(M.abs(), s.qd.abs()).amax(-1) * s.qd.abs().sum(-1)


def causes(robot, s):
    """tau = M qdd + c + g + J^T f_tip."""
    M, c, g, Jt = closed_form(robot, s.q, s.qd)
    return torques(robot, s, f_tip=s.f_tip), times(M, s.qdd) + c + g + times(Jt, s.f_tip), size_of_torques(robot, s)


def composite_bodies(robot, s):
    """Mass matrix of composite bodies and of the closed form."""
    M = torchdq.mass_matrix(robot, s.q)
    return M, closed_form(robot, s.q, s.qd).M, M.abs().amax((-2, -1))[:, None]


def columns_of_the_mass_matrix(robot, s):
    """They are torques per acceleration."""
    unit = torch.eye(robot.n, dtype=torch.float64).unsqueeze(1)
    M = torchdq.mass_matrix(robot, s.q)
    columns = torchdq.inverse_dynamics(robot.replace(gravity=None), s.q, None, unit).movedim(0, -1)
    return columns, M, M.abs().amax((-2, -1))[:, None]


def nothing_but_positions(robot, s):
    """Only the torques of gravity are left."""
    g = closed_form(robot, s.q, s.qd).g
    return torchdq.inverse_dynamics(robot, s.q), g, g.abs().amax(-1)


def absent_and_zero(robot, s):
    """Absent quantities are zero."""
    found = torchdq.inverse_dynamics(robot, *(0 * x if k else x for k, x in enumerate(s)))
    return found, torchdq.inverse_dynamics(robot, s.q), found.abs().amax(-1)


def transposed_jacobian(robot, s):
    """Up to the order of the six: twists are (angular, linear), wrenches (force, moment)."""
    J = torchdq.jacobian(robot, s.q, robot.tip)
    return closed_form(robot, s.q, s.qd).Jt, torch.cat([J[:, 3:], J[:, :3]], 1).mT, J.abs().amax((-2, -1))[:, None]


def affine_in_accelerations(robot, s):
    """Torques of mixed accelerations are mixed torques."""
    t = states(robot, seed=1)
    mixed = torques(robot, s, qdd=0.3 * s.qdd + 0.7 * t.qdd)
    expected = 0.3 * torques(robot, s) + 0.7 * torques(robot, s, qdd=t.qdd)
    return mixed, expected, size_of_torques(robot, s) + size_of_torques(robot, t)


def quadratic_in_velocities(robot, s):
    """Coriolis torques at three times the speed are nine times as large."""
    found = torchdq.closed_form(robot, s.q, -3.0 * s.qd).c
    return found, 9.0 * closed_form(robot, s.q, s.qd).c, 9.0 * size_of_torques(robot, s)


def superposed_wrenches(robot, s):
    """Wrenches at the tip add."""
    t = states(robot, seed=1)
    free, one, other, both = (torques(robot, s, f_tip=f) for f in (None, s.f_tip, t.f_tip, s.f_tip + t.f_tip))
    size = size_of_torques(robot, s) + size_of_torques(robot, s._replace(f_tip=t.f_tip))
    return both - free, (one - free) + (other - free), size


def tip_and_link(robot, s):
    """The wrench that the tip exerts is the negative of that on its link."""
    tip = robot.frame(robot.tip)
    felt = torch.zeros_like(s.f_ext)
    felt[:, tip.link] = -dq.ad(tip.X_BF, s.f_tip)
    return torques(robot, s, f_ext=felt), torques(robot, s, f_tip=s.f_tip), size_of_torques(robot, s)


def kinetic_energy(robot, s):
    """T = qd^T M qd / 2."""
    M = torchdq.mass_matrix(robot, s.q)
    found, size = torchdq.kinetic_energy(robot, s.q, s.qd), inner(s.qd.abs(), times(M.abs(), s.qd.abs()))
    return found[:, None], 0.5 * inner(s.qd, times(M, s.qd))[:, None], size


def gradient_of_potential_energy(robot, s):
    """g = dU/dq."""
    g = closed_form(robot, s.q, s.qd).g
    return torch.func.grad(lambda q: torchdq.potential_energy(robot, q).sum())(s.q), g, g.abs().amax(-1)


def power_of_torques(robot, s):
    """d/dt (T + U) = tau . qd, without a wrench at the tip."""

    def energy(q, qd):
        return torchdq.kinetic_energy(robot, q, qd) + torchdq.potential_energy(robot, q)

    rate = torch.func.jvp(energy, (s.q, s.qd), (s.qd, s.qdd))[1]
    size = robot.n * size_of_torques(robot, s) * s.qd.abs().sum(-1)
    return rate[:, None], inner(torques(robot, s), s.qd)[:, None], size


def power_of_a_wrench(robot, s):
    """A wrench at the tip takes its power from the torques."""
    spent = inner(torques(robot, s, f_tip=s.f_tip) - torques(robot, s), s.qd)
    V_tip = times(torchdq.jacobian(robot, s.q, robot.tip), s.qd)
    size = robot.n * size_of_torques(robot, s) * s.qd.abs().sum(-1)
    return spent[:, None], dq.power(s.f_tip, V_tip)[:, None], size


def power_of_coriolis_torques(robot, s):
    """qd^T (Mdot - 2 C) qd = 0 with C qd = c: they move energy about and make none."""
    M_rate = torch.func.jvp(lambda q: torchdq.mass_matrix(robot, q), (s.q,), (s.qd,))[1]
    size = robot.n * size_of_rates(robot, s) * s.qd.abs().amax(-1)
    found = inner(s.qd, times(M_rate, s.qd))
    return found[:, None], 2.0 * inner(s.qd, closed_form(robot, s.q, s.qd).c)[:, None], size


def christoffel_symbols(robot, s):
    """c = Mdot qd - grad (qd^T M qd / 2): Lagrange's equations, all components and not only their power."""
    momentum_rate = torch.func.jvp(lambda q: times(torchdq.mass_matrix(robot, q), s.qd), (s.q,), (s.qd,))[1]
    gradient = torch.func.grad(lambda q: torchdq.kinetic_energy(robot, q, s.qd).sum())(s.q)
    return momentum_rate - gradient, closed_form(robot, s.q, s.qd).c, size_of_rates(robot, s)


IDENTITIES = (
    *(causes, composite_bodies, columns_of_the_mass_matrix, nothing_but_positions, absent_and_zero),
    *(transposed_jacobian, affine_in_accelerations, quadratic_in_velocities, superposed_wrenches, tip_and_link),
    *(kinetic_energy, gradient_of_potential_energy, power_of_torques, power_of_a_wrench, power_of_coriolis_torques),
    christoffel_symbols,
)


@pytest.mark.case("D6", "D7", "D8", "D10")
@every_robot
def test_both_sides_agree(robot):
    all_in_one(IDENTITIES)(lambda identity: agree(*identity(robot, states(robot))))()


@pytest.mark.case("D6")
@every_robot
def test_the_mass_matrix_is_symmetric_to_the_last_bit_and_positive_definite(robot):
    M = torchdq.mass_matrix(robot, states(robot, batch=20).q)
    assert torch.equal(M, M.mT)
    assert (torch.linalg.eigvalsh(M)[..., 0] > EPS * robot.n * M.abs().amax((-2, -1))).all()


@every_robot
def test_without_gravity_rest_takes_exactly_no_torque(robot):
    s = states(robot)
    assert torch.equal(torchdq.inverse_dynamics(robot.replace(gravity=None), s.q), torch.zeros_like(s.q))


@some_robots
def test_a_motion_run_backwards_takes_the_same_torques_and_twice_the_mass_twice_the_torque(robot):
    s = states(robot)
    forwards = torques(robot, s)
    assert torch.equal(torques(robot, s, qd=-s.qd), forwards)
    rotors = None if robot.armature is None else 2.0 * robot.armature
    heavy = robot.replace(mass=2.0 * robot.mass, inertia=2.0 * robot.inertia, armature=rotors)
    assert torch.equal(torques(heavy, s), 2.0 * forwards)


@pytest.mark.case("D10")
@every_robot
def test_wrenches_on_links_take_their_transposed_jacobians_off_the_torques(robot):
    s = states(robot)
    expected, size = torques(robot, s), size_of_torques(robot, s)
    for i, link in enumerate(robot.link_names):
        J = torchdq.jacobian(robot, s.q, link)
        f = torch.cat([s.f_ext[:, i, 3:], s.f_ext[:, i, :3]], -1)  # a twist's order
        expected = expected - times(J.mT, f)
        size = size + times(J.mT.abs(), f.abs()).amax(-1)
    agree(torques(robot, s, f_ext=s.f_ext), expected, size)


# --- there and back --------------------------------------------------------------------------------------------------


@pytest.mark.case("D9")
@every_robot
def test_forward_dynamics_undoes_inverse_dynamics(robot):
    s = states(robot)
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, s.f_tip, s.f_ext)
    found = torchdq.forward_dynamics(robot, s.q, s.qd, tau, s.f_tip, s.f_ext)
    # torques are exact to some roundings of their largest; M^-1 turns those into accelerations
    inverse = torch.linalg.inv(torchdq.mass_matrix(robot, s.q)).abs().sum(-1).amax(-1)
    agree(found, s.qdd, inverse * (size_of_torques(robot, s) + tau.abs().amax(-1)))


@pytest.mark.case("D9")
@every_robot
def test_inverse_dynamics_undoes_forward_dynamics(robot):
    s = states(robot)
    tau = 20.0 * s.qd
    qdd = torchdq.forward_dynamics(robot, s.q, s.qd, tau, s.f_tip, s.f_ext)
    found = torchdq.inverse_dynamics(robot, s.q, s.qd, qdd, s.f_tip, s.f_ext)
    agree(found, tau, size_of_torques(robot, s._replace(qdd=qdd)) + s.f_ext.abs().amax((-2, -1)))


# --- where the numbers are written down ------------------------------------------------------------------------------


class Body:
    """A random tree at home, in the base frame, from which robots with any link frames are made."""

    def __init__(self, n, seed=0):
        rng = np.random.default_rng([seed, n])
        self.n, self.rng = n, rng
        self.parents = [i - 1 if rng.random() < 0.7 else int(rng.integers(-1, i)) for i in range(n)]
        self.home = rng.uniform(-1.0, 1.0, n)
        self.axis = rng.normal(size=(n, 3))
        self.axis /= np.linalg.norm(self.axis, axis=-1, keepdims=True)
        self.point, self.com = rng.normal(size=(2, n, 3))  # on the axis, and the centre of mass
        self.kinds = [str(rng.choice(["revolute", "prismatic", "helical"], p=[0.6, 0.2, 0.2])) for _ in range(n)]
        self.pitch = rng.uniform(-0.3, 0.3, n)
        self.gravity = 6.0 * rng.normal(size=3)
        self.mass = rng.uniform(0.5, 3.0, n)
        root = rng.normal(size=(n, 3, 3))
        second = 0.05 * root @ root.swapaxes(-1, -2)
        self.inertia = np.trace(second, axis1=-2, axis2=-1)[:, None, None] * np.eye(3) - second
        self.tip, self.tip_turn = rng.normal(size=3), self.quaternions(1)[0]

    def quaternions(self, n):
        r = self.rng.normal(size=(n, 4))
        return torch.from_numpy(r / np.linalg.norm(r, axis=-1, keepdims=True))

    def robot(self, origins, turns, turn=(1.0, 0.0, 0.0, 0.0)):
        """Robot with link frames at those origins, turned so, everything seen from a base that is turned."""
        base = dq.from_pose(torch.tensor(turn, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
        R = dq.to_rotation_matrix(dq.rotation(base)).numpy()
        axis, moment = self.axis, np.cross(self.point, self.axis)
        slides, winds = (np.array([kind == k for kind in self.kinds])[:, None] for k in ("prismatic", "helical"))
        screws = np.concatenate(
            [~slides * axis, np.where(slides, axis, moment + winds * self.pitch[:, None] * axis)], -1
        )
        R_i = dq.to_rotation_matrix(turns).numpy()
        inertia = R_i.swapaxes(-1, -2) @ self.inertia @ R_i
        return torchdq.Robot.from_screws(
            joint_screws=dq.ad(base, torch.from_numpy(screws)),
            mass=self.mass,
            com=np.einsum("nij,ni->nj", R_i, self.com - origins),
            inertia=0.5 * (inertia + inertia.swapaxes(-1, -2)),
            link_poses=dq.mul(base, dq.from_pose(turns, torch.from_numpy(origins))),
            tip_pose=dq.mul(base, dq.from_pose(self.tip_turn, torch.from_numpy(self.tip))),
            parents=self.parents,
            home=self.home,
            gravity=R @ self.gravity,
        )

    def upright(self):
        return torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(self.n, 4)


@pytest.fixture(scope="module", params=range(3))
def body(request):
    return Body(7, seed=request.param)


def at_centres(body, **where):
    return body.robot(body.com, body.quaternions(body.n), **where)


def quantities(robot, s):
    """Everything that does not depend on link frames or on the base frame."""
    return (
        torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, s.f_tip),
        closed_form(robot, s.q, s.qd).c,
        closed_form(robot, s.q, s.qd).g,
        torchdq.mass_matrix(robot, s.q).flatten(-2),
        torchdq.kinetic_energy(robot, s.q, s.qd)[:, None],
        torchdq.jacobian(robot, s.q, robot.tip).flatten(-2),
    )


def check_same(robot, other):
    s = states(robot)
    for found, expected in zip(quantities(other, s), quantities(robot, s), strict=True):
        size = size_of_torques(robot, s) + expected.abs().amax(-1)
        agree(found, expected, size)


WRITTEN = {  # the paper puts link frames at the centres of mass; that is a choice
    "frames on the joints": lambda body: body.robot(body.point, body.quaternions(body.n)),
    "frames that are all the base frame": lambda body: body.robot(0 * body.com, body.upright()),
    "the base turned, and gravity with it": lambda body: at_centres(body, turn=(0.5, -0.7, 0.1, 0.5)),
}


@pytest.mark.parametrize("how", WRITTEN)
def test_where_numbers_are_written_down_changes_nothing(body, how):
    check_same(at_centres(body), WRITTEN[how](body))


def test_another_home_is_another_zero(body):
    """Positions count from home: with home at zero, the same robot stands where q - home says."""
    robot = at_centres(body)
    s, other = states(robot), robot.replace(home=None)
    found = torchdq.inverse_dynamics(other, s.q - robot.home, s.qd, s.qdd, s.f_tip)
    assert torch.equal(found, torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, s.f_tip))


def test_turning_a_joint_around_turns_its_torque_around(body):
    robot = at_centres(body).replace(home=None)
    s = states(robot)
    sign = torch.tensor([(-1.0) ** i for i in range(robot.n)], dtype=torch.float64)
    other = robot.replace(screw=sign[:, None] * robot.screw)
    found = torchdq.inverse_dynamics(other, sign * s.q, sign * s.qd, sign * s.qdd, s.f_tip)
    agree(found, sign * torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, s.f_tip), size_of_torques(robot, s))


# --- frames without mass ---------------------------------------------------------------------------------------------


@some_robots
def test_one_more_frame_changes_nothing(robot):
    extra = Frame("camera", robot.n - 1, torch.tensor([0.6, 0.8, 0, 0, 0, 0, 0.3, -0.1], dtype=torch.float64))
    other, s = robot.replace(frames=(*robot.frames, extra)), states(robot)
    for found, expected in zip(quantities(other, s), quantities(robot, s), strict=True):
        assert torch.equal(found, expected)


INERTIAL = """<inertial><origin xyz="0.1 0.02 -0.1" rpy="0.3 0 0.2"/><mass value="1.5"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.025" ixy="0.002" ixz="-0.001" iyz="0.003"/></inertial>"""
TURNING = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>
    <origin xyz="0.2 0 0.3" rpy="{3}"/><axis xyz="0 0.6 0.8"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>"""
FIXED = '<joint name="{0}" type="fixed"><parent link="{1}"/><child link="{2}"/><origin xyz="{3}" rpy="{4}"/></joint>'


def from_urdf(*parts, massless=()):
    links = "".join(f'<link name="{name}">{INERTIAL}</link>' for name in ("arm", "hand"))
    links += "".join(f'<link name="{name}"/>' for name in ("base", *massless))
    return torchdq.Robot.from_urdf(f'<robot name="r">{links}{"".join(parts)}</robot>', tip="hand")


@pytest.mark.case("I1")
def test_a_massless_link_in_a_file_changes_nothing_wherever_it_is():
    """At the end of an arm, under its base, and between two joints, where it carries the next joint."""
    shoulder, elbow = TURNING.format("a", "base", "arm", "0 0 0"), TURNING.format("b", "arm", "hand", "0.4 -0.3 0")
    plain = from_urdf(shoulder, elbow)
    at_the_end = from_urdf(shoulder, elbow, FIXED.format("c", "hand", "tool", "0 0 1", "1 2 3"), massless=["tool"])
    between = from_urdf(
        shoulder,
        FIXED.format("c", "arm", "flange", "0.5 -0.2 0.7", "0 0 0"),
        TURNING.format("b", "flange", "hand", "0.4 -0.3 0").replace("0.2 0 0.3", "-0.3 0.2 -0.4"),
        massless=["flange"],
    )
    s = states(plain)
    for found, expected in zip(quantities(at_the_end, s), quantities(plain, s), strict=True):
        assert torch.equal(found, expected)
    check_same(plain, between)
