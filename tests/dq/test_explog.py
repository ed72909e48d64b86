"""Exponential, logarithm and what is built on them: accuracy, derivatives and hard cases.

The reference is multi-precision and shares no formula with the package: the exponential is the power series of dual
quaternion products with scaling and squaring, the logarithm the geometry of a screw (angle, line, slide). Both are
evaluated on the rounded inputs. Errors are norm-wise over the 8 or 6 components, in units of eps = 2.2e-16 or 1.2e-7.
"""

import itertools
import math
from functools import cache, partial

import mpmath as mp
import numpy as np
import pytest
import torch
from helpers import EVERYTHING, all_in_one, thinned
from mpmath import mpf
from torch.autograd import gradcheck, gradgradcheck
from torch.autograd.functional import jacobian

import torchdq
from torchdq import dq
from torchdq.algebra import dual_quaternion
from torchdq.backends import c_library as build

F32, F64 = torch.float32, torch.float64
EPS = {F32: 2.0**-23, F64: 2.0**-52}
PI = math.pi
DIGITS = 70  # 50 are compared; the squarings at 1e6 rad and the cancellation near a full turn take the others

LOG_SWITCH = 2.0 * math.atan(math.sqrt(0.05))  # angle where the logarithm changes from series to closed form
UP_TO_PI = [0.0, 1e-20, 1e-8, 1e-6, 1e-4, 1e-3, 1e-2, 0.1, LOG_SWITCH - 1e-6, LOG_SWITCH + 1e-6, 1.0]
UP_TO_PI += [2.0 - 1e-7, 2.0 + 1e-7, PI - 1e-6, PI]
UP_TO_FULL = [PI + 1e-6, 4.5, 2 * PI - 1e-3, 2 * PI - 1e-6]
BEYOND = [7.0, 13.0, 1e3, 1e6]
ROWS = 4 if EVERYTHING else 2
TINY = [1e-300, 1e-160]  # whose square is not even a subnormal float32

every_dtype = pytest.mark.parametrize("dtype", [F32, F64], ids=["f32", "f64"])
ACCURACY = pytest.mark.parametrize("dtype, tiny", [(F32, []), (F64, TINY)], ids=["f32", "f64"])


@pytest.fixture(autouse=True, params=["eager", "c"])
def on_both_backends(request):
    """Every claim of this file is one about torch operations and about the compiled programs."""
    if request.param == "c" and build.compiler() is None:
        pytest.skip("there is no C compiler")
    with torchdq.backend(request.param):
        yield


def round_trip(a):
    return dq.log(dq.exp(a))


def halves(angle, dtype, rows=ROWS, seed=0):
    """Half-angle screws [rows, 6]: random lines about a metre from the origin, every second one with a pitch."""
    g = torch.Generator().manual_seed(seed)
    axis = torch.randn(rows, 3, generator=g, dtype=F64)
    axis = axis / axis.norm(dim=-1, keepdim=True)
    point = torch.randn(rows, 3, generator=g, dtype=F64)
    pitch = torch.randn(rows, 1, generator=g, dtype=F64) * (torch.arange(rows) % 2).unsqueeze(-1)
    return (torch.cat([axis, torch.linalg.cross(point, axis) + pitch * axis], -1) * (0.5 * angle)).to(dtype)


# --- reference -------------------------------------------------------------------------------------------------------


def exact(row):
    return [mpf(v) for v in row.tolist()]


def _hamilton(a, b):
    """Quaternion product by the rule for scalar and vector parts."""
    (s, u), (t, v) = (a[0], a[1:]), (b[0], b[1:])
    cross = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    return [s * t - sum(p * q for p, q in zip(u, v, strict=True))] + [s * v[i] + t * u[i] + cross[i] for i in range(3)]


def _product(x, y):
    cross_terms = zip(_hamilton(x[:4], y[4:]), _hamilton(x[4:], y[:4]), strict=True)
    return _hamilton(x[:4], y[:4]) + [p + q for p, q in cross_terms]


def exact_exp(a):
    """Power series of the dual quaternion a, scaled and squared."""
    with mp.workdps(DIGITS):
        size = mp.sqrt(sum(v * v for v in a[:3]))
        squarings = int(mp.ceil(mp.log(size, 2))) + 4 if size > mpf(1) / 16 else 0
        x = [v * mpf(2) ** -squarings for v in (mpf(0), *a[:3], mpf(0), *a[3:])]
        term = total = [mpf(1)] + [mpf(0)] * 7
        small = mpf(10) ** -DIGITS * max(map(abs, x))
        for k in range(1, 40):
            term = [v / k for v in _product(term, x)]
            total = [u + v for u, v in zip(total, term, strict=True)]
            if max(map(abs, term)) < small:
                break
        for _ in range(squarings):
            total = _product(total, total)
        return total


def exact_log(x):
    """Half of (angle * line + eps slide * axis) of the unit dual quaternion closest to x."""
    with mp.workdps(DIGITS):
        length = mp.sqrt(sum(v * v for v in x[:4]))
        r, d = [v / length for v in x[:4]], [v / length for v in x[4:]]
        off = sum(p * q for p, q in zip(r, d, strict=True))
        d = [q - off * p for p, q in zip(r, d, strict=True)]
        n = mp.sqrt(sum(v * v for v in r[1:]))
        if n == 0:
            return [mpf(0)] * 3 + d[1:]
        half, axis, slide = mp.atan2(n, r[0]), [v / n for v in r[1:]], -d[0] / n
        moment = [(d[i + 1] - slide * r[0] * axis[i]) / n for i in range(3)]
        return [half * v for v in axis] + [half * m + slide * v for m, v in zip(moment, axis, strict=True)]


def ulps(rows, references):
    """Largest norm-wise error in units of eps of the rows against their references."""
    worst = 0.0
    with mp.workdps(DIGITS):
        for row, reference in zip(rows, references, strict=True):
            error = mp.sqrt(sum((p - q) ** 2 for p, q in zip(exact(row), reference, strict=True)))
            size = mp.sqrt(sum(q * q for q in reference))
            worst = max(worst, float(error / size) if size else float(error) * math.inf if error else 0.0)
    return worst / EPS[rows.dtype]


@cache
def exact_exps(angle, dtype):
    """Exponentials of the screws of an angle, which every backend is held to."""
    return [exact_exp(exact(row)) for row in halves(angle, dtype)]


@cache
def exact_logs(angle, dtype):
    """Logarithms of these poses, rounded."""
    return [exact_log(exact(row)) for row in rounded_exps(angle, dtype)]


def rounded_exps(angle, dtype):
    """The exponentials of an angle rounded once, component by component."""
    return torch.tensor([[float(v) for v in row] for row in exact_exps(angle, dtype)], dtype=F64).to(dtype)


def test_the_reference_logarithm_inverts_the_reference_exponential():
    for angle in (1e-300, 1e-8, 1.0, PI, 6.0):
        for row in halves(angle, F64, rows=2):
            a = exact(row)
            with mp.workdps(DIGITS):
                error = max(abs(p - q) for p, q in zip(exact_log(exact_exp(a)), a, strict=True))
                assert error <= mpf(10) ** -50 * max(abs(v) for v in a)


# --- accuracy --------------------------------------------------------------------------------------------------------


@pytest.mark.case("G2", "G3", "G5", "G6", "G7")
@ACCURACY
def test_exp_is_within_4_ulp(dtype, tiny, margin):
    for angle in tiny + UP_TO_PI + UP_TO_FULL + BEYOND:
        # over many turns the pitch, a difference of products as long as the angle, takes its digits
        condition = angle if angle > 13.0 else 1.0
        margin(ulps(dq.exp(halves(angle, dtype)), exact_exps(angle, dtype)), 4 * condition, f"at {angle:g}")


def conditioned(angle):
    """Bound of the errors of a logarithm: beyond half a turn the line is divided by the sine of the half angle."""
    return 8 + (50 / (2 * PI - angle) if angle > PI else 0)


@pytest.mark.case("G2", "G3", "G5", "G6")
@ACCURACY
def test_log_is_within_8_ulp_and_loses_only_what_its_condition_takes(dtype, tiny, margin):
    for angle in tiny + UP_TO_PI + UP_TO_FULL:
        found, reference = dq.log(rounded_exps(angle, dtype)), exact_logs(angle, dtype)
        margin(ulps(found[:, :3], [row[:3] for row in reference]), 8, f"angle at {angle:g}")
        margin(ulps(found, reference), conditioned(angle), f"line at {angle:g}")


@pytest.mark.case("G7")
@all_in_one(BEYOND)
def test_log_of_a_longer_turn_is_a_logarithm_within_a_full_turn(angle):
    x = dq.exp(halves(angle, F64))
    a = dq.log(x)
    assert (a[:, :3].norm(dim=-1) <= PI).all()
    rest = 2 * PI - 2 * a[:, :3].norm(dim=-1).max().item()
    assert ulps(dq.exp(a), [exact(row) for row in x]) <= 8 + 50 / rest + 4 * angle  # x itself is off unit by as much


@every_dtype
def test_log_does_not_see_the_length_of_x_nor_its_part_along_itself(dtype):
    x = rounded_exps(1.3, dtype)
    off = 3.0 * torch.cat([x[:, :4], x[:, 4:] + 0.25 * x[:, :4]], -1)
    assert ulps(dq.log(off), [exact_log(exact(row)) for row in off]) <= 16
    assert ulps(dq.log(off), exact_logs(1.3, dtype)) <= 16


@pytest.mark.case("G8")
@every_dtype
def test_pure_translations_are_exact(dtype):
    lengths = torch.tensor([[0.0], [1e-12], [1e-6], [1e-3], [1.0], [1e2], [1e4]], dtype=dtype)
    v = torch.tensor([2.0, -1.0, 2.0], dtype=dtype) * (lengths / 3)
    a = torch.cat([torch.zeros_like(v), v], -1)
    x = dq.exp(a)
    assert x.equal(torch.cat([torch.tensor([1.0, 0, 0, 0, 0], dtype=dtype).expand(7, 5), v], -1))
    assert dq.log(x).equal(a) and dq.log_shortest(-x).equal(a)


@pytest.mark.case("G6")
def test_a_full_turn_has_the_documented_logarithm():
    along = torch.tensor([-1.0, 0, 0, 0, 0, 0.3, 0, 0.4], dtype=F64)  # a full turn while moving by 1 m
    expected = torch.tensor([0.6 * PI, 0, 0.8 * PI, -0.3, 0, -0.4], dtype=F64)
    torch.testing.assert_close(dq.log(along), expected, rtol=4 * EPS[F64], atol=0)
    still = torch.tensor([-1.0, 0, 0, 0, 0, 0, 0, 0], dtype=F64)
    assert dq.log(still).abs().equal(torch.tensor([PI, 0, 0, 0, 0, 0], dtype=F64))
    for x in (along, still):
        torch.testing.assert_close(dq.exp(dq.log(x)), x, rtol=0, atol=4 * PI * EPS[F64])


# --- derivatives -----------------------------------------------------------------------------------------------------

SWITCHES = [0.0, 1e-8, LOG_SWITCH - 1e-6, LOG_SWITCH + 1e-6, 2.0 - 1e-7, 2.0 + 1e-7, PI - 1e-6, PI + 1e-6]


@pytest.mark.case("G1", "G4", "G5", "G6", "G7")
@all_in_one(thinned([*SWITCHES, 2 * PI - 1e-6, 7.0, 13.0], [0.0, 2.0 + 1e-7, 13.0]))
def test_exp_has_its_derivatives(angle):
    a = halves(angle, F64, rows=2)[1].requires_grad_()
    assert gradcheck(dq.exp, a, eps=1e-6, atol=1e-8, rtol=1e-6)
    assert gradgradcheck(dq.exp, a, atol=1e-7, rtol=1e-5, fast_mode=True)


@pytest.mark.case("G1", "G4", "G5")
@all_in_one(thinned(SWITCHES, [0.0, PI + 1e-6]))
def test_log_and_log_of_exp_have_their_derivatives(angle):
    a = halves(angle, F64, rows=2)[1]
    for f, x in ((dq.log, dq.exp(a)), (round_trip, a)):
        x = x.clone().requires_grad_()
        assert gradcheck(f, x, eps=1e-7, atol=1e-6, rtol=1e-5)
        assert gradgradcheck(f, x, atol=1e-5, rtol=1e-4, fast_mode=True)
    torch.testing.assert_close(jacobian(round_trip, a), torch.eye(6, dtype=F64), rtol=0, atol=1e3 * EPS[F64])


def derivatives(f, at):
    """Values of f at some rows, gradient of a weighted sum of them, and second derivatives [width, rows, width]."""
    at = at.clone().requires_grad_()
    value = f(at)
    weights = torch.arange(1.0, 1.0 + value.shape[-1], dtype=at.dtype)
    (slope,) = torch.autograd.grad((weights * value).sum(), at, create_graph=True)
    each = torch.eye(at.shape[-1], dtype=at.dtype).reshape(-1, *[1] * (at.ndim - 1), at.shape[-1])
    (curves,) = torch.autograd.grad(slope, at, each.expand(-1, *at.shape), is_grads_batched=True)
    return value.detach(), slope.detach(), curves


@pytest.mark.case("G4")
@pytest.mark.parametrize(
    ("f", "switch", "row", "bound"),
    [
        (dq.exp, 1.0, lambda n: [n, 0.0, 0.0, 0.3, -0.5, 0.7], 1e-12),
        # log does not see the length, so that w = 1 puts its switch at n^2 = 0.05; second derivatives reach 40 here
        (dq.log, 0.05, lambda n: [1.0, n, 0.0, 0.0, 0.1, 0.3, -0.5, 0.7], 1e-11),
    ],
)
def test_nothing_jumps_where_a_series_changes_to_a_closed_form(f, switch, row, bound, margin):
    above = math.sqrt(switch) + 1e-15
    while (below := math.nextafter(above, 0.0)) ** 2 >= switch:
        above = below
    assert below**2 < switch <= above**2
    before, after = (derivatives(f, torch.tensor(row(n), dtype=F64)) for n in (below, above))
    margin(max(float((y - x).abs().max()) for x, y in zip(before, after, strict=True)), bound)


@pytest.mark.case("G1", "G2", "G6")
@ACCURACY
def test_values_gradients_and_hessians_are_finite(dtype, tiny):
    angles = tiny + UP_TO_PI + UP_TO_FULL + BEYOND
    a = torch.stack([halves(angle, dtype, rows=2)[1] for angle in angles])
    x = dq.exp(a).detach()
    # two float32 steps from a full turn the second derivatives pass through sin(angle/2)^-7 > 1e38
    near = torch.tensor([dtype == F32 and 2 * PI - 1e-5 < angle < 2 * PI for angle in angles])
    for f, at in ((dq.exp, a), (dq.log_shortest, x), (dq.log, x), (round_trip, a)):
        value, slope, curves = derivatives(f, at)
        assert value.isfinite().all() and slope.isfinite().all()
        infinite = ~curves.isfinite().transpose(0, 1).flatten(1).all(-1)
        excused = near if f in (dq.log, round_trip) else torch.zeros_like(near)
        assert not (infinite & ~excused).any(), [angles[k] for k in infinite.nonzero()[:, 0]]


@pytest.mark.case("G6", "G8")
@every_dtype
def test_translations_and_full_turns_have_finite_derivatives(dtype):
    slide = torch.tensor([0.0, 0.0, 0.0, 1e-12, 0.0, 1e4], dtype=dtype)
    ways = [0.0, 0.0, 0.0], [0.3, 0.0, 0.4], [1e4, 0.0, 0.0]
    x = torch.tensor([[sign, 0, 0, 0, 0, *v] for sign in (1.0, -1.0) for v in ways], dtype=dtype)
    for f, at in ((dq.exp, slide), (dq.log, x), (dq.log_shortest, x)):
        assert all(found.isfinite().all() for found in derivatives(f, at))


# --- shortest way, interpolation -------------------------------------------------------------------------------------


@pytest.mark.case("G9")
@all_in_one([0.0, 1e-8, 1.0, PI - 1e-6, PI + 1e-6, 5.0, 2 * PI - 1e-6])
def test_both_signs_of_a_pose_have_the_same_shortest_logarithm_that_of_positive_w(angle):
    x = dq.exp(halves(angle, F64))
    assert dq.log_shortest(x).equal(dq.log_shortest(-x))
    positive = torch.where(x[:, :1] > 0, x, -x)
    assert dq.log_shortest(x).equal(dq.log(positive)) and not dq.log(-positive).allclose(dq.log(positive))
    half = dq.log_shortest(x)[:, :3].norm(dim=-1)
    torch.testing.assert_close(half, torch.full_like(half, min(angle, 2 * PI - angle) / 2), rtol=0, atol=8 * EPS[F64])


@pytest.mark.case("G5")
def test_the_shortest_logarithm_turns_round_at_half_a_turn_where_each_sign_keeps_its_own_direction():
    x = torch.tensor([0.0, 0.0, 0.6, 0.8, 0.0, 1.0, 0.0, 0.0], dtype=F64)
    a = dq.log_shortest(x)
    torch.testing.assert_close(a[:3], 0.5 * PI * x[1:4], rtol=4 * EPS[F64], atol=0)
    assert dq.log_shortest(-x).equal(-a)
    axis = torch.cat([x[1:4], torch.zeros(3, dtype=F64)])
    below, above = (dq.log_shortest(dq.exp(axis * (PI / 2 + s * 1e-9))) for s in (-1, 1))
    torch.testing.assert_close(above, -below, rtol=0, atol=1e-8)


def pairs():
    """Poses to interpolate between."""
    x = dq.exp(halves(1.0, F64, seed=3))
    half_turn = torch.tensor([0.0, 0.0, 0.6, 0.8, 0.0, 1.0, 0.0, 0.0], dtype=F64).expand_as(x)
    slide = dq.exp(torch.tensor([0.0, 0.0, 0.0, 1.0, -2.0, 0.5], dtype=F64)).expand_as(x)
    return {
        "equal": (x, x),
        "antipodal": (x, -x),
        "half a turn": (x, dq.mul(x, half_turn)),
        "1e-12 apart": (x, dq.mul(x, dq.exp(halves(1e-12, F64, seed=4)))),
        "translation": (x, dq.mul(x, slide)),
        "anywhere": (x, dq.exp(halves(5.0, F64, seed=5))),
    }


PAIRS = pairs()


@pytest.mark.case("G12")
@all_in_one(PAIRS)
def test_sclerp_moves_with_a_constant_twist_also_outside_the_ends(case):
    x, y = PAIRS[case]
    whole = dq.log_shortest(dq.mul(dq.conj(x), y))
    t = torch.tensor([-1.5, -0.75, -0.25, 0.25, 0.5, 0.75, 1.25, 1.5], dtype=F64)
    path = dq.sclerp(x.unsqueeze(1), y.unsqueeze(1), t)
    step = dq.mul(dq.conj(path[:, :-1]), path[:, 1:])
    expected = (t[1:] - t[:-1]).unsqueeze(-1) * whole.unsqueeze(1)  # less than half a turn each
    torch.testing.assert_close(dq.log_shortest(step), expected, rtol=0, atol=1e-13)
    for end, expected in ((0.0, x), (1.0, y)):
        off = dq.log_shortest(dq.mul(dq.conj(dq.sclerp(x, y, end)), expected))
        torch.testing.assert_close(off, torch.zeros_like(off), rtol=0, atol=64 * EPS[F64])


@pytest.mark.case("G12")
@every_dtype
def test_sclerp_has_finite_derivatives(dtype):
    """Of all pairs, at the start, half way and at the end, the rows of one batch."""
    times = (torch.tensor([t], dtype=F64) for t in (0.0, 0.5, 1.0))
    rows = [torch.cat([x[0], y[0], t]) for (x, y), t in itertools.product(PAIRS.values(), times)]
    found = derivatives(lambda x: dq.sclerp(x[:, :8], x[:, 8:16], x[:, 16]), torch.stack(rows).to(dtype))
    assert all(x.isfinite().all() for x in found)


# --- normalisation ---------------------------------------------------------------------------------------------------


def defects(components):
    """How far a dual quaternion is from a unit one: | |P| - 1 | and |P.D| / |D|."""
    p, d = (np.array(part, dtype=np.float64) for part in components)
    return abs(np.linalg.norm(p) - 1), abs(p @ d) / np.linalg.norm(d)


def run_products(number, every):
    """1e4 products with one motion, in one precision, normalising after every so many (0: never)."""
    motion = dq.exp(torch.tensor([0.1, -0.2, 0.15, 0.02, 0.01, -0.03], dtype=F64)).numpy().astype(number)
    step = (tuple(motion[:4]), tuple(motion[4:]))
    x = step
    for k in range(1, 10_001):
        x = dual_quaternion.mul(x, step)
        if every and k % every == 0:
            row = dq.normalize(torch.tensor(np.array([*x[0], *x[1]], dtype=number))).numpy()
            x = (tuple(row[:4]), tuple(row[4:]))
    return defects(x)


drifted = cache(partial(run_products, every=0))  # in which no backend takes part


@pytest.mark.parametrize("number", [np.float32, np.float64])
def test_normalising_now_and_then_keeps_a_long_product_a_pose(number):
    """Alone it drifts, by less than an ulp per factor."""
    eps = float(np.finfo(number).eps)
    length, off = run_products(number, every=100)
    assert length <= 4 * eps and off <= 2 * eps
    length, off = drifted(number)
    assert 100 * eps < length <= 1e4 * eps and off <= 1e4 * eps


def test_normalize_divides_by_the_dual_norm():
    x = torch.randn(50, 8, dtype=F64, generator=torch.Generator().manual_seed(6))
    y = dq.normalize(x)
    torch.testing.assert_close(dq.paper.norm(y)[:, 0], torch.ones(50, dtype=F64), rtol=0, atol=4 * EPS[F64])
    assert (dq.paper.norm(y)[:, 1].abs() <= 8 * EPS[F64] * y.norm(dim=-1)).all()
    torch.testing.assert_close(dq.normalize(y), y, rtol=0, atol=16 * EPS[F64] * y.abs().max().item())
    # |x| y = x with the dual number |x|
    length = dq.paper.norm(x)
    back = torch.cat([length[:, :1] * y[:, :4], length[:, :1] * y[:, 4:] + length[:, 1:] * y[:, :4]], -1)
    torch.testing.assert_close(back, x, rtol=0, atol=32 * EPS[F64] * x.abs().max().item())


@pytest.mark.case("G11")
@every_dtype
def test_a_row_without_a_direction_is_nan_and_leaves_the_others_alone(dtype):
    for size in (4, 8):
        x = torch.randn(4, size, dtype=dtype, generator=torch.Generator().manual_seed(7))
        good = dq.normalize(x)
        x[1, :4], x[2, 0] = 0.0, math.nan
        found = dq.normalize(x)
        assert found[1:3, :4].isnan().all()
        assert found[[0, 3]].equal(good[[0, 3]])


# --- screw parameters ------------------------------------------------------------------------------------------------


@every_dtype
@pytest.mark.parametrize("angle", [1e-3, 1.0, PI - 1e-3])
def test_screw_parameters_make_the_motion_that_turns_the_shorter_way(angle, dtype):
    a = halves(angle, F64, rows=8)
    x = dq.exp(a).to(dtype)
    found = dq.paper.screw_params(x)
    tolerance = 16 * EPS[dtype]
    torch.testing.assert_close(found.axis.norm(dim=-1), torch.ones_like(found.slide), rtol=0, atol=tolerance)
    torch.testing.assert_close(found.angle.to(F64), torch.full((8,), angle, dtype=F64), rtol=tolerance, atol=0)
    moved = found.angle[:, None] * found.moment + found.slide[:, None] * found.axis
    again = torch.cat([found.angle[:, None] * found.axis, moved], -1)
    torch.testing.assert_close(again.to(F64), 2 * a, rtol=0, atol=4 * tolerance)
    assert (found.moment * found.axis).sum(-1).abs().max() <= 4 * tolerance * (1 + 2 / angle)
    assert all(torch.equal(one, other) for one, other in zip(found, dq.paper.screw_params(-x), strict=True))


@pytest.mark.case("G8")
def test_screw_parameters_of_a_translation_lie_along_it_and_those_of_the_identity_have_finite_gradients():
    found = dq.paper.screw_params(dq.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, -1.5, 2.0], dtype=F64)))
    torch.testing.assert_close(found.axis, torch.tensor([0.0, -0.6, 0.8], dtype=F64), rtol=2 * EPS[F64], atol=0)
    assert found.angle == 0 and found.slide == 5.0 and found.moment.equal(torch.zeros(3, dtype=F64))
    identity = torch.eye(8, dtype=F64)[0]
    found = dq.paper.screw_params(identity)
    assert found.axis.equal(torch.tensor([1.0, 0, 0], dtype=F64)) and found.angle == found.slide == 0
    assert all(j.isfinite().all() for j in jacobian(lambda x: tuple(dq.paper.screw_params(x)), identity))
