"""The paper's two-link arm against recorded torques, to 1e-11.

The numbers were recorded from Pinocchio, with twelve decimals, and follow from formulas that are written out here. The
paper does not print its links' inertia: without any (as in the toolbox model its figure resembles) errors in the
inertia would not show, so every state is also taken with the uniform rod's.
"""

from math import pi

import pytest
import torch

import torchdq
from torchdq.dynamics.general import rnea
from torchdq.dynamics.general.kinematics import adjoints, joint_poses
from torchdq.dynamics.joints import Coordinate

BACKEND = "auto"

TOLERANCE = 1e-11  # [N m], absolute; the numbers below carry twelve decimals
ROUNDING = 64 * 2.0**-52  # relative, where the other side is a formula
ROD = 1.0 / 12.0  # [kg m^2]


def double(x):
    return torch.tensor(x, dtype=torch.float64)


def close(actual, expected, tolerance):
    assert actual.shape == expected.shape
    worst = (actual - expected).abs().max().item()
    assert worst <= tolerance, f"off by {worst:.3e}, allowed {tolerance:.1e}"


# --- two ways to the torques ---------------------------------------------------------------------------------------


def recursion(robot, q, qd, qdd, f_tip):
    return torchdq.inverse_dynamics(robot, q, qd, qdd, f_tip)


def closed_form(robot, q, qd, qdd, f_tip):
    M, c, g, Jt = torchdq.closed_form(robot, q, qd)
    return torch.einsum("...ij,...j->...i", M, qdd) + c + g + torch.einsum("...ij,...j->...i", Jt, f_tip)


ways = pytest.mark.parametrize("way", [recursion, closed_form])


# --- the two-link arm ------------------------------------------------------------------------------------------------

# q | qd | qdd | f_tip (fx, fy, mz) | torques without inertia | torques of the uniform rod
TWO_LINK = """
0 0           | 0 0       | 0 0      | 0 0 0    | 19.62 4.905                     | 19.62 4.905
0.3 -0.7      | 0 0       | 0 0      | 0 0 0    | 18.575580613067 4.517804175584  | 18.575580613067 4.517804175584
0.3 -0.7      | 0.5 -1.1  | 0 0      | 0 0 0    | 18.611012585866 4.437276964679  | 18.611012585866 4.437276964679
0.3 -0.7      | 0.5 -1.1  | 1.2 2.3  | 0 0 0    | 22.783391725984 5.771182277050  | 23.175058392651 6.062848943717
pi/6 -pi/6    | 1 2       | -3 0.5   | 0 0 0    | 12.891993956281 2.730961894323  | 12.433660622947 2.522628560990
-2.1 1.9      | -3.3 4.4  | 5.5 -6.6 | 0 0 0    | 7.847271512432 8.795784232895   | 8.213938179098 8.704117566228
0.3 -0.7      | 0.5 -1.1  | 1.2 2.3  | 2 -3 0.7 | 16.900429789655 3.471182277050  | 17.292096456322 3.762848943717
pi/2 0        | 0 0       | 1 1      | 1 0 0    | 3.25 1                          | 3.5 1.166666666667
""".strip().splitlines()
ANGLES = {"pi/6": pi / 6, "-pi/6": -pi / 6, "pi/2": pi / 2}


def two_link(transverse):
    robot = torchdq.robots.load("two_link")
    return robot.replace(inertia=double([[0, 0, transverse, 0, 0, transverse]] * 2))


def in_tip_frame(planar):
    """Wrench [..., 6] of (fx, fy, mz)."""
    fx, fy, mz = planar.unbind(-1)
    zero = torch.zeros_like(fx)
    return torch.stack([fx, fy, zero, zero, zero, mz], -1)


def states(transverse=ROD):
    """Tensors q, qd, qdd, f_tip, and torques without inertia or of rods, each [8, ...]."""
    rows = [[[ANGLES.get(x) or float(x) for x in cell.split()] for cell in row.split("|")] for row in TWO_LINK]
    q, qd, qdd, planar, point_mass, rod = map(double, zip(*rows, strict=True))
    return q, qd, qdd, in_tip_frame(planar), rod if transverse else point_mass


inertias = pytest.mark.parametrize("transverse", [0.0, ROD], ids=["no-inertia", "rod"])


@ways
@inertias
def test_two_link_torques(transverse, way):
    *state, tau = states(transverse)
    close(way(two_link(transverse), *state), tau, TOLERANCE)


@inertias
def test_two_link_accelerations_from_the_recorded_torques(transverse):
    """The torques are rounded to twelve decimals, and M^-1 amplifies that."""
    robot, (q, qd, qdd, f_tip, tau) = two_link(transverse), states(transverse)
    amplified = TOLERANCE * torch.linalg.inv(torchdq.mass_matrix(robot, q)).abs().sum(-1).max().item()
    close(torchdq.forward_dynamics(robot, q, qd, tau, f_tip), qdd, amplified)


# --- its intermediates -----------------------------------------------------------------------------------------------


def test_two_link_constants():
    robot = two_link(ROD)
    assert torch.equal(torchdq.robots.load("two_link").inertia, robot.inertia)
    close(robot.screw, double([[0, 0, 1, 0, 0.5, 0]] * 2), 1e-15)
    close(robot.X_PB_home, double([[1, 0, 0, 0, 0, 0.25, 0, 0], [1, 0, 0, 0, 0, 0.5, 0, 0]]), 1e-15)
    close(robot.frame("tip").X_BF, double([1, 0, 0, 0, 0, 0.25, 0, 0]), 1e-15)


def test_two_link_twists_accelerations_and_wrenches():
    """Twist and wrench of each link in the state of row 4, (angular, linear) and (force, moment)."""
    q, qd, qdd, *_ = (x[3] for x in states())
    tree, half = two_link(ROD).tree(), 0.5 * q
    coordinates = [None, *(Coordinate(q[i], half[i].cos(), half[i].sin()) for i in range(2))]
    Ad = adjoints(joint_poses(tree, coordinates))
    V, A = rnea.outward(tree, Ad, qd.unbind(), qdd.unbind())
    F = rnea.inward(tree, Ad, V, A, [None] * 3)
    V, A, F = (torch.stack([torch.stack([*s[0], *s[1]]) for s in screws[1:]]) for screws in (V, A, F))
    close(V, double([[0, 0, 0.5, 0, 0.25, 0], [0, 0, -0.6, -0.322108843619, 0.082421093642, 0]]), TOLERANCE)
    expected = [[0, 0, 1.2, 2.899053227348, 9.971850958322, 0], [0, 0, 3.5, -5.01391836574, 11.349099247929, 0]]
    close(A, double(expected), TOLERANCE)
    first = [6.41281581365, 21.998134928095, 0, 0, 0, 12.175990928603]
    close(F, double([first, [-4.964465709554, 11.5423645541, 0, 0, 0, 0.291666666667]]), TOLERANCE)


def test_two_link_terms():
    q, qd = double([0.3, -0.7]), double([0.5, -1.1])
    terms = torchdq.closed_form(two_link(ROD), q, qd)
    M = double([[2.431508853951156, 0.715754426975578], [0.715754426975578, 0.333333333333333]])
    close(terms.M, M, 4e-15)
    close(torchdq.mass_matrix(two_link(ROD), q), M, 4e-15)
    close(terms.c, double([0.035431972799, -0.080527210905]), TOLERANCE)
    close(terms.g, double([18.575580613067, 4.517804175584]), TOLERANCE)
    close(terms.Jt @ in_tip_frame(double([2.0, -3.0, 0.7])), double([-5.882961936329, -2.3]), TOLERANCE)


# --- its formulas ----------------------------------------------------------------------------------------------------


def formulas(transverse, q, qd):
    """M, c, g and J^T on (fx, fy, mz) of the two-link arm, by hand."""
    (q1, q2), (w1, w2) = q.unbind(-1), qd.unbind(-1)
    c1, c2, s2, c12 = q1.cos(), q2.cos(), q2.sin(), (q1 + q2).cos()
    m11, m12 = 1.5 + 2 * transverse + c2, 0.25 + transverse + 0.5 * c2
    h, one = -0.5 * s2, torch.ones_like(c2)
    m22 = (0.25 + transverse) * one
    return (
        torch.stack([m11, m12, m12, m22], -1).reshape(*q.shape[:-1], 2, 2),
        torch.stack([h * (2 * w1 * w2 + w2 * w2), -h * w1 * w1], -1),
        9.81 * torch.stack([1.5 * c1 + 0.5 * c12, 0.5 * c12], -1),
        torch.stack([s2, 1 + c2, one, 0 * one, one, one], -1).reshape(*q.shape[:-1], 2, 3),
    )


@inertias
def test_two_link_terms_follow_the_formulas(transverse):
    generator = torch.Generator().manual_seed(4)
    q, qd = 6.0 * torch.rand(2, 50, 2, generator=generator, dtype=torch.float64) - 3.0
    M, c, g, Jt = torchdq.closed_form(two_link(transverse), q, qd)
    for found, expected in zip((M, c, g, Jt[..., [0, 1, 5]]), formulas(transverse, q, qd), strict=True):
        close(found, expected, ROUNDING * expected.abs().max().item())
