"""Identities of the dynamics of any robot: structure, energy and symmetry.

No reference implementation is asked. The robots are the shipped ones and random trees of revolute, prismatic and
helical joints with nothing aligned, one of them with rotors. Differences are measured in roundings of the largest
term that enters, since that is what cancels.
"""

from functools import cache

import pytest
import torch
from helpers import all_in_one, thinned
from oracles import random_tree, shipped, states
from robots import ARMS

import torchdq
from torchdq import dq
from torchdq.robot.description import Frame

EPS = 2.0**-52
ROBOTS = {name: shipped(name).robot for name in ARMS}
ROBOTS |= {f"tree{n}": random_tree(n, seed=n, armature=n == 7).robot for n in (1, 4, 7, 11)}
SHORT = ("two_link", "puma560", "tree4", "tree7")  # for what a few robots show as well as all

EVERY = thinned(ROBOTS, ("two_link", "puma560", "tree1", "tree4"))
every_robot = pytest.mark.parametrize("robot", [ROBOTS[name] for name in EVERY], ids=EVERY)
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


def absent_and_zero(robot, s):
    """Absent quantities are zero."""
    found = torchdq.inverse_dynamics(robot, *(0 * x if k else x for k, x in enumerate(s)))
    return found, torchdq.inverse_dynamics(robot, s.q), found.abs().amax(-1)


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
    return spent[:, None], dq.paper.power(s.f_tip, V_tip)[:, None], size


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
    *(causes, absent_and_zero, tip_and_link, kinetic_energy, gradient_of_potential_energy, power_of_torques),
    *(power_of_a_wrench, power_of_coriolis_torques, christoffel_symbols),
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


@pytest.mark.case("D9")
@every_robot
def test_forward_and_inverse_dynamics_undo_each_other(robot):
    s = states(robot)
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, s.f_tip, s.f_ext)
    found = torchdq.forward_dynamics(robot, s.q, s.qd, tau, s.f_tip, s.f_ext)
    # torques are exact to some roundings of their largest; M^-1 turns those into accelerations
    inverse = torch.linalg.inv(torchdq.mass_matrix(robot, s.q)).abs().sum(-1).amax(-1)
    agree(found, s.qdd, inverse * (size_of_torques(robot, s) + tau.abs().amax(-1)))
    tau = 20.0 * s.qd
    qdd = torchdq.forward_dynamics(robot, s.q, s.qd, tau, s.f_tip, s.f_ext)
    found = torchdq.inverse_dynamics(robot, s.q, s.qd, qdd, s.f_tip, s.f_ext)
    agree(found, tau, size_of_torques(robot, s._replace(qdd=qdd)) + s.f_ext.abs().amax((-2, -1)))


def quantities(robot, s):
    """Everything that does not depend on link frames or on the base frame."""
    return (
        torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, s.f_tip),
        *closed_form(robot, s.q, s.qd)[1:3],
        torchdq.mass_matrix(robot, s.q),
        torchdq.kinetic_energy(robot, s.q, s.qd),
        torchdq.jacobian(robot, s.q, robot.tip),
    )


@some_robots
def test_one_more_frame_changes_nothing(robot):
    extra = Frame("camera", robot.n - 1, torch.tensor([0.6, 0.8, 0, 0, 0, 0, 0.3, -0.1], dtype=torch.float64))
    other, s = robot.replace(frames=(*robot.frames, extra)), states(robot)
    for found, expected in zip(quantities(other, s), quantities(robot, s), strict=True):
        assert torch.equal(found, expected)
