"""Hard cases of maps and group operations: what `test_exp_log.py` and `test_dq_tensors.py` do not hold of them.

Those compare exp, log and interpolation with multi-precision. Here are the joints' own path through the programs,
single precision and second derivatives where they are missing there, long products, distant frames, and axes that are
none.
"""

import itertools
import math

import mpmath as mp
import numpy as np
import pytest
import torch
from helpers import largest, random, thinned
from oracles import EPS
from precisions import F32, F64, compiler, every_backend_and_dtype, every_dtype
from torch.autograd.functional import hessian, jacobian

import torchdq
from torchdq import dq
from torchdq.algebra import dual_quaternion
from torchdq.backends.c import COMPILED
from torchdq.program.program import Argument, record

IDENTITY = [1.0, 0, 0, 0, 0, 0, 0, 0]
DIRECTION = np.array([2.0, -3.0, 6.0]) / 7.0
POINT = np.array([0.3, -0.2, 0.5])
LINE = np.concatenate([DIRECTION, np.cross(POINT, DIRECTION)])
BALL = (0.02, 0, 0.02, 0, 0, 0.02)


def one_joint(screw):
    """A body on one joint, its frame that of the base at home."""
    return torchdq.Robot.from_screws([screw], mass=[2.0], com=[[0.1, 0.2, 0.3]], inertia=[BALL])


def poses(rows, dtype, seed=0, reach=1.0):
    """Random poses [rows, 8], rounded to a dtype, with positions of that size."""
    turns = dq.normalize(random(rows, 4, seed=seed))
    return dq.from_pose(turns, reach * random(rows, 3, seed=seed + 1)).to(dtype)


def derivatives(f, x):
    """Value, first and second derivatives of a weighted sum of f's components at x."""
    weights = torch.arange(1.0, 1.0 + f(x).numel(), dtype=x.dtype)

    def weighted(y):
        return (weights * f(y)).sum()

    return f(x), jacobian(weighted, x), hessian(weighted, x)


# --- the identity and small angles -----------------------------------------------------------------------------------


@pytest.mark.case("G1")
@every_dtype
def test_derivatives_of_exp_at_the_identity_are_exact(dtype):
    zero = torch.zeros(6, dtype=dtype)
    first = torch.zeros(8, 6, dtype=dtype)
    first[1:4, :3] = first[5:, 3:] = torch.eye(3)
    assert jacobian(dq.exp, zero).equal(first)
    # the square of a + eps b is -a.a - 2 eps a.b, and half of it stands in the series
    for part, block in ((0, (0, 0)), (4, (0, 1))):
        second = torch.zeros(2, 3, 2, 3, dtype=dtype)
        second[block[0], :, block[1]] = second[block[1], :, block[0]] = -torch.eye(3)
        assert hessian(lambda a, part=part: dq.exp(a)[part], zero).equal(second.reshape(6, 6))
    for f in (dq.log, dq.log_shortest):
        assert jacobian(f, dq.exp(zero))[:, [1, 2, 3, 5, 6, 7]].equal(torch.eye(6, dtype=dtype))
        assert all(x.isfinite().all() for x in derivatives(f, dq.exp(zero)))


@pytest.mark.case("G1")
@every_backend_and_dtype
def test_a_joint_at_home_has_the_derivatives_of_its_exponential(dtype, backend, margin):
    """X = exp(q a / 2), so that X'' = a a / 4, whatever the kind of joint."""
    slide = np.concatenate([np.zeros(3), DIRECTION])
    for screw in (LINE, LINE + 0.1 * slide, slide):
        robot, home = one_joint(screw), torch.zeros(1, dtype=dtype)
        with torchdq.backend(backend):
            _, first, second = derivatives(lambda q, r=robot: torchdq.forward_kinematics(r, q, "link1"), home)
        a = torch.tensor([0, *screw[:3], 0, *screw[3:]], dtype=F64)
        weights = torch.arange(1.0, 9.0, dtype=F64)
        expected = [weights @ (a / 2), weights @ (dq.mul(a, a) / 4)]
        for found, reference in zip((first, second), expected, strict=True):
            margin(largest(found - reference), 16 * EPS[dtype], "derivatives")


@pytest.mark.case("G1", "G2")
@every_dtype
def test_derivatives_where_squares_underflow_are_those_at_the_identity(dtype, margin):
    sizes = (1e-20, 1e-38) if dtype == F32 else (1e-20, 1e-300)
    screw = torch.tensor([0.6, -0.48, 0.64, 0.3, -0.5, 0.7], dtype=dtype)
    for size, (name, f) in itertools.product(sizes, (("exp", dq.exp), ("log", lambda a: dq.log(dq.exp(a))))):
        a = screw * torch.tensor([size] * 3 + [1.0] * 3, dtype=dtype)
        _, *near = derivatives(f, a)
        _, *at = derivatives(f, a * torch.tensor([0.0] * 3 + [1.0] * 3, dtype=dtype))
        for order, (found, reference) in enumerate(zip(near, at, strict=True), 1):
            # they change by the next derivative times the angle
            margin(largest(found - reference), 16 * size, f"{name}, order {order}, at {size:g}")


ANGLES = (1e-38, 1e-20, 1e-8, 1e-6, 1e-4, 1e-3, 0.1, 2.0, math.pi - 1e-6, math.pi, math.pi + 1e-6)
TURNS = (2 * math.pi - 1e-3, 2 * math.pi - 1e-6, 7.0, 13.0, 1e3, 1e5)


@pytest.mark.case("G2", "G3", "G7")
@every_backend_and_dtype
def test_a_joint_turns_by_its_angle_within_an_ulp_at_every_angle(dtype, backend, margin):
    """The angle is taken as it was rounded, so that nothing grows with it."""
    robot = one_joint([0, 0, 1, 0, 0, 0])
    angles = (*ANGLES, *TURNS, 1e6, 1e-160, 1e-300) if dtype == F64 else ANGLES + TURNS
    q = torch.tensor([[s * x] for x in angles for s in (1, -1)], dtype=dtype)
    X = torchdq.forward_kinematics(robot, q, "link1", backend=backend)
    worst = 0.0
    for angle, (w, x, y, z, *dual) in zip(q[:, 0].tolist(), X.tolist(), strict=True):
        assert [x, y, *dual] == [0.0] * 6
        with mp.workdps(60):
            cos, sin = mp.cos(mp.mpf(angle) / 2), mp.sin(mp.mpf(angle) / 2)
            # the sine of a small angle is held to its own size
            worst = max(worst, abs(w - cos), abs(z - sin) / (abs(sin) if abs(angle) < 1 else 1))
    margin(worst, EPS[dtype])


@pytest.mark.case("G4")
@pytest.mark.parametrize("name", ["exp", "log"])
def test_nothing_jumps_in_single_precision_where_the_formula_changes(name, margin):
    f = {"exp": dq.exp, "log": dq.log}[name]
    # the smallest float32 on the far side: |a|^2 >= 1, and |v|^2 >= 0.05 w^2
    at = np.float32(1.0) if name == "exp" else np.float32(math.sqrt(0.05))
    beyond = (lambda x: x * x >= np.float32(1.0)) if name == "exp" else (lambda x: not x * x < np.float32(0.05))
    at = np.nextafter(at, np.float32(0.0)) if beyond(at) else at
    while not beyond(np.nextafter(at, np.float32(2.0))):
        at = np.nextafter(at, np.float32(2.0))
    rest = [0.0, 0.0, 0.3, -0.5, 0.7] if name == "exp" else [0.0, 0.0, 0.1, 0.3, -0.5, 0.7]
    first = [] if name == "exp" else [1.0]
    below, above = (torch.tensor([*first, float(x), *rest]) for x in (at, np.nextafter(at, np.float32(2.0))))
    for order, (x, y) in enumerate(zip(derivatives(f, below), derivatives(f, above), strict=True)):
        # each derivative of the logarithm divides by the sine once more
        condition = 1.0 if name == "exp" or order < 2 else 8.0
        margin(largest(x - y), 8 * condition * EPS[F32] * max(1.0, largest(x)), f"order {order}")


@pytest.mark.case("G9")
@every_dtype
def test_a_distance_does_not_see_the_sign_of_a_pose(dtype):
    x, y = poses(20, dtype), poses(20, dtype, seed=5)

    def distance(x):
        return dq.log_shortest(dq.mul(dq.conj(x), y[: len(x)])).square().sum(-1)

    assert distance(x).equal(distance(-x))
    slope, opposite = (jacobian(lambda z: distance(z).sum(), z) for z in (x, -x))
    assert slope.equal(-opposite)
    bend, same = (hessian(lambda z: distance(z[None])[0], z) for z in (x[0], -x[0]))
    assert bend.equal(same)
    for t in (0.0, 0.3, 1.0, 1.7):
        middle, other = dq.sclerp(x, y, t), dq.sclerp(-x, y, t)
        assert dq.ad_matrix(middle).equal(dq.ad_matrix(other))


PRODUCTS, BETWEEN, AT_ONCE = 1_000_000, 1000, 20


def multiplied(x, step):
    """x after some products with one motion."""
    x, step = (x[:4], x[4:]), (step[:4], step[4:])
    for _ in range(AT_ONCE):
        x = dual_quaternion.mul(x, step)
    return {"x": [*x[0], *x[1]]}


@pytest.mark.case("G10")
@compiler
@pytest.mark.parametrize(
    "dtype, normalised",
    thinned([*itertools.product((F32, F64), (True, False))], ((F32, True),)),
    ids=lambda x: {True: "normalised", False: "left alone"}.get(x, str(x)),
)
def test_a_million_products_stay_a_pose_if_normalised_now_and_then(dtype, normalised, margin):
    program = record("million", [Argument("x", 8), Argument("step", 8, True)], multiplied)
    kernel = COMPILED.kernel(program, dtype, torch.device("cpu"))
    step = dq.exp(torch.tensor([0.1, -0.2, 0.15, 0.02, 0.01, -0.03], dtype=F64)).to(dtype)
    x = torch.tensor([IDENTITY], dtype=dtype)
    for _ in range(PRODUCTS // BETWEEN):
        for _ in range(BETWEEN // AT_ONCE):
            (x,) = kernel([x, step], 1)
        x = dq.normalize(x) if normalised else x
    p, d = x[0].double().split(4)
    length, off = abs(float(p.norm()) - 1), abs(float(p @ d)) / float(d.norm())
    # else systematic: the rounded step is off unit by less than an ulp, and so is every product
    margin(length, (4 if normalised else PRODUCTS) * EPS[dtype], "length")
    margin(off, (8 if normalised else PRODUCTS) * EPS[dtype], "P.D")


# --- normalising, interpolation, distant frames, axes ----------------------------------------------------------------


@pytest.mark.case("G11")
@every_dtype
@pytest.mark.parametrize("size", [4, 8])
def test_rows_without_a_direction_leave_the_derivatives_of_the_others_alone(dtype, size):
    good = random(4, size, seed=7, dtype=dtype)
    bad = good.clone()
    bad[1, :4], bad[2, 0] = 0.0, math.nan

    def loss(x):
        return (dq.normalize(x) * torch.arange(1.0, 1.0 + size, dtype=dtype)).sum()

    spoiled, before = ((jacobian(loss, x), hessian(loss, x)) for x in (bad, good))
    for row in (0, 3):
        assert spoiled[0][row].equal(before[0][row])
        assert spoiled[1][row, :, row].equal(before[1][row, :, row])
    assert dq.normalize(bad)[1:3, :4].isnan().all()


@pytest.mark.case("G11")
@every_dtype
def test_short_and_long_quaternions_are_normalised_with_gradients_of_their_inverse_length(dtype, margin):
    """Gradients as far as squares of the length can be written."""
    for exponent in (0, 4, 15, 20, 30) if dtype == F32 else (0, 4, 15, 160, 300):
        for length in (10.0**-exponent, 10.0**exponent):
            x = torch.tensor([0.2, 0.4, 0.4, 0.8], dtype=dtype) * length
            margin(abs(float(dq.normalize(x).double().norm()) - 1), 4 * EPS[dtype], f"length of {length:g}")
            if exponent <= 15:
                margin(largest(jacobian(dq.normalize, x)) * length, 1.0 + 16 * EPS[dtype], f"gradient at {length:g}")


def ends():
    """Poses to interpolate between, of single precision."""
    x = poses(6, F32, seed=3)
    half_turn = torch.tensor([0.0, 0.0, 0.6, 0.8, 0.0, 1.0, 0.0, 0.0]).expand_as(x)
    slide = dq.exp(torch.tensor([0.0, 0.0, 0.0, 1.0, -2.0, 0.5])).expand_as(x)
    near = dq.exp(1e-6 * random(6, 6, seed=4, dtype=F32))
    return {
        "equal": x,
        "opposite": -x,
        "half a turn": dq.mul(x, half_turn),
        "nearly equal": dq.mul(x, near),
        "translation": dq.mul(x, slide),
        "anywhere": poses(6, F32, seed=9),
    }


@pytest.mark.case("G12")
@pytest.mark.parametrize("case", ends())
def test_interpolation_holds_in_single_precision(case, margin):
    x, y = poses(6, F32, seed=3), ends()[case]
    size = (x.norm(dim=-1) * y.norm(dim=-1) * x.norm(dim=-1)).double()  # of the dual parts that cancel

    def apart(a, b):
        return (torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1)) / size).max()

    for t, end in ((0.0, x), (1.0, y)):
        margin(apart(dq.sclerp(x, y, t).double(), end), 8 * EPS[F32], f"end {t:g}")
    for t in (-0.5, 0.5, 1.5):
        middle, exact = dq.sclerp(x, y, t).double(), dq.sclerp(x.double(), y.double(), t)
        margin((middle[:, :4].norm(dim=-1) - 1).abs().max(), 4 * EPS[F32], f"length at {t:g}")
        far = max(1.0, abs(t)) * (1 + abs(t))  # outside its ends the motion is multiplied
        if case != "half a turn":  # where rounding decides which way is the shorter
            margin(apart(middle, exact), 16 * far * EPS[F32], f"pose at {t:g}")


FAR = 1e4  # [m]


@pytest.mark.case("G13")
@every_dtype
@pytest.mark.parametrize("reach", [1.0, FAR, 1e6])
def test_the_adjoint_of_a_distant_frame_loses_the_digits_of_the_distance(dtype, reach, margin):
    x, m = poses(20, dtype, reach=reach), random(20, 6, seed=3, dtype=dtype)
    found = dq.ad(x, m)
    with mp.workdps(50):
        for row, screw, result in zip(x.tolist(), m.tolist(), found.tolist(), strict=True):
            X, s = [mp.mpf(v) for v in row], [mp.mpf(v) for v in screw]
            r, d, zero = tuple(X[:4]), tuple(X[4:]), mp.mpf(0)
            # x m x*, by products of quaternions alone
            product = dual_quaternion.mul((r, d), ((zero, *s[:3]), (zero, *s[3:])))
            w, v = dual_quaternion.mul(product, ((r[0], *(-c for c in r[1:])), (d[0], *(-c for c in d[1:]))))
            off = [max(abs(a - b) for a, b in zip(result[k : k + 3], e[1:], strict=True)) for k, e in ((0, w), (3, v))]
            size = max(abs(c) for c in s)
            far = 2 * mp.sqrt(sum(c * c for c in d))
            margin(off[0] / size, 8 * EPS[dtype], "angular")
            margin(off[1] / size, 8 * EPS[dtype] * (1 + far), "linear")
    back = dq.ad(dq.conj(x), found)
    margin(largest(back - m), 16 * EPS[dtype] * (1 + 2 * reach) * largest(m), "there and back")


@pytest.mark.case("G14")
@pytest.mark.parametrize("what", ["direction", "moment"])
def test_a_screw_that_is_off_by_little_becomes_a_line(what, margin):
    off = 5e-10  # accepted as what a user's own rounding leaves
    screw = LINE * (1 + off) if what == "direction" else LINE + off * np.concatenate([np.zeros(3), DIRECTION])
    robot = one_joint(screw)
    direction, moment = robot.screw[0].split(3)
    assert robot.kinds == ("revolute",)
    margin(abs(float(direction.norm()) - 1), 2 * EPS[F64], "unit")
    margin(abs(float(direction @ moment)) / max(1.0, float(moment.norm())), 2 * EPS[F64], "moment along the axis")


# --- the adjoint -----------------------------------------------------------------------------------------------------


@pytest.mark.case("G15")
@every_dtype
def test_the_adjoint_respects_products_inverses_and_exponentials_to_rounding(dtype, margin):
    x, y, s = poses(50, dtype), poses(50, dtype, seed=4), random(50, 6, seed=8, dtype=dtype)
    size = (1 + dq.translation(x).norm(dim=-1) + dq.translation(y).norm(dim=-1)).max().item()
    A, B = dq.ad_matrix(x), dq.ad_matrix(y)
    margin(largest(dq.ad_matrix(dq.mul(x, y)) - A @ B), 16 * EPS[dtype] * size, "products")
    margin(largest(dq.ad_matrix(dq.conj(x)) @ A - torch.eye(6, dtype=dtype)), 16 * EPS[dtype] * size, "inverses")
    margin(largest(dq.ad(dq.mul(x, y), s) - dq.ad(x, dq.ad(y, s))), 16 * EPS[dtype] * size * largest(s), "screws")
    a = s / 4  # turns of less than pi
    moved = dq.mul(dq.mul(x, dq.exp(a)), dq.conj(x))
    margin(largest(dq.exp(dq.ad(x, a)) - moved), 16 * EPS[dtype] * size, "exponentials")


@pytest.mark.case("G15")
def test_derivatives_of_the_adjoint_are_its_commutator(margin):
    """d/dt Ad(exp(t a / 2)) m = a x m at t = 0, and twice for the second derivative."""
    a, m = random(2, 6, seed=1)

    def turned(t):
        return dq.ad(dq.exp(0.5 * t * a), m)

    first = jacobian(turned, torch.zeros((), dtype=F64))
    second = jacobian(lambda t: jacobian(turned, t, create_graph=True), torch.zeros((), dtype=F64))
    margin(largest(first - dq.paper.cross(a, m)), 16 * EPS[F64] * largest(a) * largest(m), "first")
    expected = dq.paper.cross(a, dq.paper.cross(a, m))
    margin(largest(second - expected), 32 * EPS[F64] * largest(a) ** 2 * largest(m), "second")
