"""Jacobian of the logarithm, screw motions in time, and rotations as two columns."""

import math

import mpmath as mp
import torch
from helpers import all_in_one, random, thinned
from messages import refused
from torch.autograd import gradcheck
from torch.autograd.functional import jacobian, jvp

from torchdq import dq
from torchdq.errors import ArgumentError

F32, F64 = torch.float32, torch.float64
ANGLES = [0.0, 1e-12, 1e-4, 0.5, 2.0, 3.0, math.pi - 1e-9]


def turned(angle, rows=4):
    """Twists [rows, 6] that turn by an angle about lines through a neighbourhood of the origin."""
    axis = torch.nn.functional.normalize(random(rows, 3), dim=-1)
    return torch.cat([axis * angle, random(rows, 3, seed=1)], -1)


def skew(v):
    return [[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]]


def left_jacobian(e):
    """Sum of ad^k/(k + 1)!, in many digits."""
    with mp.workdps(40):
        ad, w, v = mp.zeros(6), skew([mp.mpf(x) for x in e[:3]]), skew([mp.mpf(x) for x in e[3:]])
        for i in range(3):
            for k in range(3):
                ad[i, k] = ad[3 + i, 3 + k] = w[i][k]
                ad[3 + i, k] = v[i][k]
        total = term = mp.eye(6)
        for k in range(1, 36):
            term = term * ad / (k + 1)
            total += term
        return total


@all_in_one(ANGLES)
def test_the_jacobian_of_the_logarithm_inverts_the_series_of_the_left_jacobian(angle):
    e = turned(angle, 2)
    for row, J in zip(e, dq.log_jacobian(dq.exp(0.5 * e)), strict=True):
        with mp.workdps(40):
            error = mp.matrix(J.tolist()) * left_jacobian(row.tolist()) - mp.eye(6)
            assert max(map(abs, error)) < 1e-14 * (1 + angle**2)
    half = dq.log_jacobian(dq.exp(0.5 * e).float())
    assert (half - dq.log_jacobian(dq.exp(0.5 * e))).abs().max() < 3e-5


@all_in_one(thinned(ANGLES[:-1], [0.0, 1e-4, 0.5, 3.0]))
def test_the_jacobian_of_the_logarithm_is_the_derivative_of_the_error(angle):
    """For both signs of the pose; with gradients of its own."""
    x = dq.exp(0.5 * turned(angle, 2))

    def errors(t):
        return torch.stack([2 * dq.log_shortest(dq.mul(dq.exp(0.5 * t), y)) for y in (x, -x)])

    J = jacobian(errors, torch.zeros(6, dtype=F64), vectorize=True)
    assert torch.allclose(dq.log_jacobian(x).expand_as(J), J, rtol=1e-13, atol=1e-13)
    e = turned(angle + 0.1, 1).requires_grad_()
    assert gradcheck(lambda e: dq.log_jacobian(dq.exp(0.5 * e)), e, fast_mode=True)


def test_a_screw_path_has_the_twist_and_its_rate():
    """X' = X V / 2 and V' = A by automatic derivatives in time, from the start to the goal."""
    x, y = dq.exp(random(3, 6)), dq.exp(random(3, 6, seed=1))

    def way(t):
        return t**3 * (10 - 15 * t + 6 * t**2), 30 * t**2 * (1 - t) ** 2, 60 * t * (1 - t) * (1 - 2 * t)

    one = torch.ones((), dtype=F64)
    for t in (0.2, 0.5, 0.9):
        at = torch.tensor(t, dtype=F64)
        (X, V), (Xd, Vd) = jvp(lambda t: dq.screw_path(x, y, *way(t))[:2], at, one)
        twist = torch.cat([0 * V[..., :1], V[..., :3], 0 * V[..., :1], V[..., 3:]], -1)
        assert torch.allclose(Xd, 0.5 * dq.mul(X, twist), atol=1e-13)
        assert torch.allclose(Vd, dq.screw_path(x, y, *way(at))[2], atol=1e-12)
    ends = [dq.screw_path(x, y, s, 0.0, 0.0)[0] for s in (0.0, 1.0)]
    for found, expected in zip(ends, (x, y), strict=True):
        assert torch.allclose(dq.to_matrix(found), dq.to_matrix(expected), atol=1e-13)
    for way_and_rates in ((math.nan, 0.0, 0.0), (0.0, None, 0.0), (0.0, 0.0, math.inf)):
        with refused(ArgumentError):
            dq.screw_path(x, y, *way_and_rates)


def test_six_numbers_are_two_columns_of_a_rotation():
    """Whatever their lengths, and the part of the second along the first."""
    r = torch.nn.functional.normalize(random(50, 4), dim=-1)
    r = torch.where(r[:, :1] < 0, -r, r)
    columns = dq.to_rotation_6d(r)
    assert torch.equal(columns, dq.to_rotation_matrix(r)[..., :2].mT.reshape(50, 6))
    assert torch.allclose(dq.from_rotation_6d(columns), r, atol=1e-15)
    a, b = columns.split(3, -1)
    assert torch.allclose(dq.from_rotation_6d(torch.cat([3 * a, 0.2 * b - 7 * a], -1)), r, atol=1e-14)
    assert gradcheck(dq.from_rotation_6d, random(3, 6).requires_grad_())
    columns = random(20, 6)
    for size in (2.0**-660, 2.0**660):  # whose squares underflow and overflow
        lengths = torch.tensor([size] * 3 + [1 / size] * 3, dtype=F64)
        assert torch.equal(dq.from_rotation_6d(columns * lengths), dq.from_rotation_6d(columns))


def test_parallel_columns_give_a_rotation_that_keeps_the_first_with_a_finite_gradient():
    close = torch.tensor([1.0, 0, 0, 1, 1e-6, 0], dtype=F32)
    assert torch.allclose(dq.from_rotation_6d(close), torch.eye(4)[0])
    first = torch.cat([random(20, 3), torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64)])
    for dtype, eps in ((F32, 2.0**-23), (F64, 2.0**-52)):
        columns = torch.cat([first, -3.3 * first], -1).to(dtype).requires_grad_()
        found = dq.from_rotation_6d(columns)
        expected = torch.nn.functional.normalize(columns[:, :3], dim=-1)
        assert (dq.to_rotation_matrix(found)[..., 0] - expected).abs().max() <= 8 * eps
        (slope,) = torch.autograd.grad(found.sum(), columns)
        assert slope.isfinite().all() and slope[:, 3:].eq(0).all() and slope[:, :3].ne(0).any()
    none = torch.tensor([[0.0, 0, 0, 1, 2, 3], [1, 2, 3, 0, 0, 0], [1, 2, math.nan, 0, 1, 0], [1, 0, 0, 0, 1, 0]])
    assert dq.from_rotation_6d(none).isnan().all(-1).tolist() == [True, True, True, False]
