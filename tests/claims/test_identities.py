"""What must hold for any robot, whatever its numbers: structure, energy, symmetry, and the choice of frames.

No reference implementation is asked. The robots are the shipped ones and random trees of revolute, prismatic and
helical joints with nothing aligned, one of them with rotors. Differences are measured in roundings of the largest
term that enters, since that is what cancels.
"""

from functools import cache

import numpy as np
import pytest
import torch
from oracles import random_tree, shipped, states

import torchdq
from torchdq import dq
from torchdq.robot.description import Frame

EPS = 2.0**-52
ROBOTS = {name: shipped(name).robot for name in torchdq.robots.names()}
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


def agree(found, expected, size, roundings=20):
    """Check rows of components to so many roundings of a size per row, times the number of components."""
    assert found.shape == expected.shape
    assert found.isfinite().all()
    error = (found - expected).abs().amax(-1)
    allowed = roundings * found.shape[-1] * EPS * size
    assert (error <= allowed).all(), f"off by {(error / allowed).max():.3g} times what is allowed"


# --- the terms of (63) -----------------------------------------------------------------------------------------------


@pytest.mark.case("D7")
@every_robot
def test_torques_are_the_sum_of_their_causes(robot):
    """tau = M qdd + c + g + J^T f_tip."""
    s = states(robot)
    M, c, g, Jt = closed_form(robot, s.q, s.qd)
    found = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, s.f_tip)
    agree(found, times(M, s.qdd) + c + g + times(Jt, s.f_tip), size_of_torques(robot, s))


@every_robot
def test_composite_bodies_give_the_mass_matrix_of_the_closed_form(robot):
    s = states(robot)
    composite = torchdq.mass_matrix(robot, s.q)
    agree(composite, closed_form(robot, s.q, s.qd).M, composite.abs().amax((-2, -1))[:, None])


@every_robot
def test_columns_of_the_mass_matrix_are_torques_per_acceleration(robot):
    s, floating = states(robot), robot.replace(gravity=None)
    unit = torch.eye(robot.n, dtype=torch.float64).unsqueeze(1)
    columns = torchdq.inverse_dynamics(floating, s.q, None, unit).movedim(0, -1)
    M = torchdq.mass_matrix(robot, s.q)
    agree(columns, M, M.abs().amax((-2, -1))[:, None])


@pytest.mark.case("D6")
@every_robot
def test_the_mass_matrix_is_symmetric_to_the_last_bit(robot):
    M = torchdq.mass_matrix(robot, states(robot, batch=20).q)
    assert torch.equal(M, M.mT)


@pytest.mark.case("D6")
@every_robot
def test_the_mass_matrix_is_positive_definite(robot):
    M = torchdq.mass_matrix(robot, states(robot, batch=20).q)
    assert (torch.linalg.eigvalsh(M)[..., 0] > EPS * robot.n * M.abs().amax((-2, -1))).all()


@every_robot
def test_nothing_but_positions_leaves_the_gravity_torques(robot):
    s = states(robot)
    g = closed_form(robot, s.q, s.qd).g
    agree(torchdq.inverse_dynamics(robot, s.q), g, g.abs().amax(-1))


@every_robot
def test_absent_is_the_same_as_zero(robot):
    s = states(robot)
    zero = torch.zeros_like(s.q)
    found = torchdq.inverse_dynamics(robot, s.q, zero, zero, 0 * s.f_tip, 0 * s.f_ext)
    agree(found, torchdq.inverse_dynamics(robot, s.q), found.abs().amax(-1))


@every_robot
def test_without_gravity_rest_takes_exactly_no_torque(robot):
    s, floating = states(robot), robot.replace(gravity=None)
    assert torch.equal(torchdq.inverse_dynamics(floating, s.q), torch.zeros_like(s.q))


@every_robot
def test_the_transposed_jacobian_is_the_transpose_of_the_jacobian(robot):
    """Up to the order of the six: twists are (angular, linear), wrenches (force, moment)."""
    s = states(robot)
    J = torchdq.jacobian(robot, s.q, robot.tip)
    Jt = closed_form(robot, s.q, s.qd).Jt
    agree(Jt, torch.cat([J[:, 3:], J[:, :3]], 1).mT, J.abs().amax((-2, -1))[:, None])


# --- what torques depend on, and how ---------------------------------------------------------------------------------


@every_robot
def test_torques_are_affine_in_the_accelerations(robot):
    s, t = states(robot), states(robot, seed=1)
    at = lambda qdd: torchdq.inverse_dynamics(robot, s.q, s.qd, qdd)  # noqa: E731
    mixed = at(0.3 * s.qdd + 0.7 * t.qdd)
    agree(mixed, 0.3 * at(s.qdd) + 0.7 * at(t.qdd), size_of_torques(robot, s) + size_of_torques(robot, t))


@every_robot
def test_coriolis_torques_are_quadratic_in_the_velocities(robot):
    s = states(robot)
    c = closed_form(robot, s.q, s.qd).c
    agree(torchdq.closed_form(robot, s.q, -3.0 * s.qd).c, 9.0 * c, 9.0 * size_of_torques(robot, s))


@some_robots
def test_a_motion_run_backwards_takes_the_same_torques(robot):
    s = states(robot)
    forwards = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)
    assert torch.equal(torchdq.inverse_dynamics(robot, s.q, -s.qd, s.qdd), forwards)


@some_robots
def test_twice_the_mass_takes_exactly_twice_the_torque(robot):
    s = states(robot)
    rotors = None if robot.armature is None else 2.0 * robot.armature
    heavy = robot.replace(mass=2.0 * robot.mass, inertia=2.0 * robot.inertia, armature=rotors)
    twice = 2.0 * torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)
    assert torch.equal(torchdq.inverse_dynamics(heavy, s.q, s.qd, s.qdd), twice)


@every_robot
def test_wrenches_at_the_tip_superpose(robot):
    s, t = states(robot), states(robot, seed=1)
    of = lambda f_tip: torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, f_tip)  # noqa: E731
    free, together = of(None), of(s.f_tip + t.f_tip)
    size = size_of_torques(robot, s) + size_of_torques(robot, s._replace(f_tip=t.f_tip))
    agree(together - free, (of(s.f_tip) - free) + (of(t.f_tip) - free), size)


@pytest.mark.case("D10")
@every_robot
def test_wrenches_on_links_take_their_transposed_jacobians_off_the_torques(robot):
    s = states(robot)
    found = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, None, s.f_ext)
    expected, size = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd), size_of_torques(robot, s)
    for i, link in enumerate(robot.link_names):
        J = torchdq.jacobian(robot, s.q, link)
        f = torch.cat([s.f_ext[:, i, 3:], s.f_ext[:, i, :3]], -1)  # a twist's order
        expected = expected - times(J.mT, f)
        size = size + times(J.mT.abs(), f.abs()).amax(-1)
    agree(found, expected, size)


@pytest.mark.case("D10")
@every_robot
def test_what_the_tip_exerts_is_the_negative_of_what_its_link_feels(robot):
    s = states(robot)
    tip = robot.frame(robot.tip)
    felt = torch.zeros_like(s.f_ext)
    felt[:, tip.link] = -dq.ad(tip.X_BF, s.f_tip)
    found = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, None, felt)
    agree(found, torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, s.f_tip), size_of_torques(robot, s))


def size_of_rates(robot, s):
    """Size [batch] of momenta that change with the velocities, also where, as for one joint, they cancel."""
    M = torchdq.mass_matrix(robot, s.q)
    return times(M.abs(), s.qd.abs()).amax(-1) * s.qd.abs().sum(-1)


# --- energy ----------------------------------------------------------------------------------------------------------


@pytest.mark.case("D6")
@every_robot
def test_kinetic_energy_is_half_the_mass_matrix_between_velocities(robot):
    s = states(robot)
    M = torchdq.mass_matrix(robot, s.q)
    found, size = torchdq.kinetic_energy(robot, s.q, s.qd), inner(s.qd.abs(), times(M.abs(), s.qd.abs()))
    agree(found[:, None], 0.5 * inner(s.qd, times(M, s.qd))[:, None], size)


@every_robot
def test_gravity_torques_are_the_gradient_of_potential_energy(robot):
    s = states(robot)
    gradient = torch.func.grad(lambda q: torchdq.potential_energy(robot, q).sum())(s.q)
    g = closed_form(robot, s.q, s.qd).g
    agree(gradient, g, g.abs().amax(-1))


@every_robot
def test_energy_grows_by_the_power_of_the_torques(robot):
    """d/dt (T + U) = tau . qd, without a wrench at the tip."""
    s = states(robot)

    def energy(q, qd):
        return torchdq.kinetic_energy(robot, q, qd) + torchdq.potential_energy(robot, q)

    rate = torch.func.jvp(energy, (s.q, s.qd), (s.qd, s.qdd))[1]
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)
    size = size_of_torques(robot, s) * s.qd.abs().sum(-1)
    agree(rate[:, None], inner(tau, s.qd)[:, None], size, roundings=20 * robot.n)


@pytest.mark.case("D10")
@every_robot
def test_a_wrench_at_the_tip_takes_its_power_from_the_torques(robot):
    s = states(robot)
    with_wrench = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, s.f_tip)
    spent = inner(with_wrench - torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd), s.qd)
    V_tip = times(torchdq.jacobian(robot, s.q, robot.tip), s.qd)
    size = size_of_torques(robot, s) * s.qd.abs().sum(-1)
    agree(spent[:, None], dq.power(s.f_tip, V_tip)[:, None], size, roundings=20 * robot.n)


@pytest.mark.case("D8")
@every_robot
def test_coriolis_torques_take_half_of_what_the_changing_mass_matrix_takes(robot):
    """qd^T (Mdot - 2 C) qd = 0 with C qd = c: they move energy about and make none."""
    s = states(robot)
    M_rate = torch.func.jvp(lambda q: torchdq.mass_matrix(robot, q), (s.q,), (s.qd,))[1]
    c = closed_form(robot, s.q, s.qd).c
    size = size_of_rates(robot, s) * s.qd.abs().amax(-1)
    found = inner(s.qd, times(M_rate, s.qd))
    agree(found[:, None], 2.0 * inner(s.qd, c)[:, None], size, roundings=20 * robot.n)


@pytest.mark.case("D8")
@every_robot
def test_coriolis_torques_are_the_christoffel_symbols_of_the_mass_matrix(robot):
    """c = Mdot qd - grad (qd^T M qd / 2): Lagrange's equations, all components and not only their power."""
    s = states(robot)
    momentum_rate = torch.func.jvp(lambda q: times(torchdq.mass_matrix(robot, q), s.qd), (s.q,), (s.qd,))[1]
    gradient = torch.func.grad(lambda q: torchdq.kinetic_energy(robot, q, s.qd).sum())(s.q)
    c = closed_form(robot, s.q, s.qd).c
    agree(momentum_rate - gradient, c, size_of_rates(robot, s))


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

    def __init__(self, n, seed=0, slide=False):
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
        if slide:  # the whole robot hangs on a slide along gravity
            self.parents, self.kinds[0] = [-1, *(max(p, 0) for p in self.parents[1:])], "prismatic"
            self.axis[0] = self.gravity / np.linalg.norm(self.gravity)
        self.mass = rng.uniform(0.5, 3.0, n)
        root = rng.normal(size=(n, 3, 3))
        second = 0.05 * root @ root.swapaxes(-1, -2)
        self.inertia = np.trace(second, axis1=-2, axis2=-1)[:, None, None] * np.eye(3) - second
        self.tip, self.tip_turn = rng.normal(size=3), self.quaternions(1)[0]

    def quaternions(self, n):
        r = self.rng.normal(size=(n, 4))
        return torch.from_numpy(r / np.linalg.norm(r, axis=-1, keepdims=True))

    def robot(self, origins, turns, shift=(0.0, 0.0, 0.0), turn=(1.0, 0.0, 0.0, 0.0), **changes):
        """Robot with link frames at those origins, turned so, everything seen from a base that is elsewhere."""
        base = dq.from_pose(torch.tensor(turn, dtype=torch.float64), torch.tensor(shift, dtype=torch.float64))
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
            **{"gravity": R @ self.gravity, **changes},
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


def check_same(robot, other, roundings=20):
    s = states(robot)
    for found, expected in zip(quantities(other, s), quantities(robot, s), strict=True):
        size = size_of_torques(robot, s) + expected.abs().amax(-1)
        agree(found, expected, size, roundings)


def test_frames_on_the_joints_give_the_torques_of_frames_at_the_centres_of_mass(body):
    """The paper puts link frames at the centres of mass; that is a choice."""
    check_same(at_centres(body), body.robot(body.point, body.quaternions(body.n)))


def test_frames_that_are_all_the_base_frame_give_the_torques_of_frames_at_the_centres_of_mass(body):
    check_same(at_centres(body), body.robot(0 * body.com, body.upright()))


def test_turning_the_base_and_gravity_with_it_changes_nothing(body):
    turn = (0.5, -0.7, 0.1, 0.5)
    check_same(at_centres(body), at_centres(body, turn=turn))


@pytest.mark.case("G13")
def test_a_base_ten_kilometres_away_changes_nothing(body):
    """Link frames hold only what is near them, so the distance costs digits once, when the robot is read."""
    far = (6e3, -7e3, 4e3)
    check_same(at_centres(body), at_centres(body, shift=far), roundings=10 * 1e4)


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


@pytest.mark.case("D10")
def test_in_free_fall_there_is_no_gravity():
    """A robot whose slide lets it fall freely takes the torques it takes where there is no gravity."""
    falling = at_centres(Body(6, seed=4, slide=True))
    floating, s = falling.replace(gravity=None), states(falling)
    fall = torch.zeros_like(s.qdd)
    fall[:, 0] = falling.gravity.norm()
    found = torchdq.inverse_dynamics(falling, s.q, s.qd, s.qdd + fall)
    agree(found, torchdq.inverse_dynamics(floating, s.q, s.qd, s.qdd), size_of_torques(falling, s))


@pytest.mark.case("D10")
def test_left_alone_a_robot_on_a_slide_falls_with_gravity_and_does_not_move_otherwise():
    falling = at_centres(Body(6, seed=4, slide=True))
    q = states(falling).q
    qdd = torchdq.forward_dynamics(falling, q, None, torch.zeros_like(q))
    expected = torch.zeros_like(q)
    expected[:, 0] = falling.gravity.norm()
    inverse = torch.linalg.inv(torchdq.mass_matrix(falling, q)).abs().sum(-1).amax(-1)
    g = torchdq.inverse_dynamics(falling, q).abs().amax(-1)
    agree(qdd, expected, inverse * g)


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
