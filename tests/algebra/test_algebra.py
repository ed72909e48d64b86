"""The algebra of sections 2 to 4 on components: axioms, equations (1) to (24) and (33) to (36), inertia, and counts.

Axioms are checked exactly, on integers; what needs unit quaternions, on 50-digit numbers. The evidence for an equation
is another equation (a cross product against the Hamilton products it is defined by), numpy, or pinocchio.
"""

import itertools
from functools import partial

import mpmath as mp
import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import EVERYTHING, all_in_one
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles import se3

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import elementary, matrix, screw
from torchdq.algebra import quaternion as quat
from torchdq.algebra.inertia import Inertia, Moments, RigidBody, six
from torchdq.numbers.count import cost
from torchdq.paper.tables import body, dual_quaternion, motion, number, operator, quaternion, tensor, vector

EPS = 2.0**-52
DIGITS = 50

whole = st.integers(-9, 9)
quaternions = st.tuples(whole, whole, whole, whole)
vectors = st.tuples(whole, whole, whole)
dual_quaternions = st.tuples(quaternions, quaternions)
screws = st.tuples(vectors, vectors)
claim = settings(max_examples=60 if EVERYTHING else 25, deadline=None, derandomize=True)


@st.composite
def poses(draw):
    """Unit dual quaternions with rational components, as 50-digit numbers: r = q^2/|q|^2, p an integer vector."""
    q = draw(quaternions)
    assume(any(q))
    with mp.workdps(DIGITS):
        square, n2 = quat.mul(q, q), quat.norm2(q)
        return dq.from_pose(tuple(mp.mpf(c) / n2 for c in square), tuple(mp.mpf(c) for c in draw(vectors)))


def flat(a):
    """Components of nested tuples in one list; a number is a list of one."""
    return [c for b in a for c in flat(b)] if isinstance(a, tuple | list) else [a]


def close(a, b, tolerance=1e-40):
    """Same components up to tolerance, to 40 digits unless told otherwise."""
    with mp.workdps(DIGITS):
        return all(abs(x - y) <= tolerance for x, y in zip(flat(a), flat(b), strict=True))


def pure(a):
    """Dual quaternion of a screw."""
    return (quat.pure(a[0]), quat.pure(a[1]))


def star(x, y, a, b):
    """x a b + y b a of dual quaternions."""
    return dq.add(dq.scale(x, dq.mul(a, b)), dq.scale(y, dq.mul(b, a)))


# --- axioms ----------------------------------------------------------------------------------------------------------


def test_the_units_multiply_as_hamilton_said():  # (1)
    minus_one = (-1.0, 0.0, 0.0, 0.0)
    i, j, k = quat.I, quat.J, quat.K
    assert quat.mul(i, i) == quat.mul(j, j) == quat.mul(k, k) == quat.mul(quat.mul(i, j), k) == minus_one
    assert quat.mul(i, j) == k
    assert quat.mul(j, i) == quat.neg(k)


def test_the_dual_unit_squares_to_zero():  # (5)
    eps, x = (dq.ZERO, quat.ONE), ((1, 2, 3, 4), (5, 6, 7, 8))
    assert dq.mul(eps, eps) == (dq.ZERO, dq.ZERO)
    assert dq.mul(eps, x) == dq.mul(x, eps) == (dq.ZERO, x[0])
    assert dq.add((dq.primary(x), dq.ZERO), dq.mul(eps, (dq.dual(x), dq.ZERO))) == x


@claim
@given(dual_quaternions, dual_quaternions, dual_quaternions, whole)
def test_dual_quaternions_are_an_associative_algebra(x, y, z, s):
    assert dq.mul(dq.mul(x, y), z) == dq.mul(x, dq.mul(y, z))
    assert dq.mul(x, dq.add(y, z)) == dq.add(dq.mul(x, y), dq.mul(x, z))
    assert dq.mul(dq.add(x, y), z) == dq.add(dq.mul(x, z), dq.mul(y, z))
    assert dq.mul(dq.scale(s, x), y) == dq.mul(x, dq.scale(s, y)) == dq.scale(s, dq.mul(x, y))
    assert dq.mul(dq.ONE, x) == dq.mul(x, dq.ONE) == x


@claim
@given(dual_quaternions, dual_quaternions)
def test_conjugation_reverses_products(x, y):
    assert dq.conj(dq.mul(x, y)) == dq.mul(dq.conj(y), dq.conj(x))
    assert dq.add(x, dq.conj(x)) == tuple((2 * part[0], 0, 0, 0) for part in x)


@claim
@given(dual_quaternions, dual_quaternions)
def test_the_squared_norm_is_multiplicative_and_is_x_times_its_conjugate(x, y):
    (p, d), (r, e) = dq.norm2(x), dq.norm2(y)
    assert dq.mul(x, dq.conj(x)) == ((p, 0, 0, 0), (d, 0, 0, 0))
    assert dq.norm2(dq.mul(x, y)) == (p * r, p * e + d * r)
    assert quat.norm2(quat.mul(x[0], y[0])) == quat.norm2(x[0]) * quat.norm2(y[0])


@claim
@given(vectors, vectors)
def test_pure_quaternions_have_the_inner_and_cross_product_of_their_products(a, b):  # (2), (3), (4)
    ab, ba = quat.mul(quat.pure(a), quat.pure(b)), quat.mul(quat.pure(b), quat.pure(a))
    assert quat.conj(quat.pure(a)) == quat.neg(quat.pure(a))
    assert quat.im(quat.pure(a)) == a
    assert quat.scale(-0.5, quat.add(ab, ba)) == (quat.dot(a, b), 0, 0, 0)
    assert quat.scale(0.5, quat.sub(ab, ba)) == quat.pure(quat.cross(a, b))
    assert quat.dot(a, b) == np.dot(a, b)
    assert quat.cross(a, b) == tuple(np.cross(a, b))


@claim
@given(screws, screws)
def test_screws_have_the_inner_and_cross_product_of_their_products(a, b):  # (6), (16)
    assert star(0.5, -0.5, pure(a), pure(b)) == pure(screw.cross(a, b))
    assert star(-0.5, -0.5, pure(a), pure(b)) == tuple((c, 0, 0, 0) for c in screw.inner(a, b))


@claim
@given(screws, screws, screws, whole)
def test_screws_are_a_lie_algebra(a, b, c, s):
    assert np.array_equal(flat(screw.add(a, screw.scale(s, b))), np.array(flat(a)) + s * np.array(flat(b)))
    assert screw.sub(a, b) == screw.add(a, screw.neg(b))
    assert screw.cross(a, b) == screw.neg(screw.cross(b, a))
    turns = [screw.cross(x, screw.cross(y, z)) for x, y, z in ((a, b, c), (b, c, a), (c, a, b))]
    assert screw.add(screw.add(*turns[:2]), turns[2]) == screw.ZERO  # Jacobi


@claim
@given(screws, screws)
def test_power_is_the_dual_part_of_the_inner_product(wrench, twist):  # (7), (48)
    assert screw.power(wrench, twist) == screw.inner(wrench, twist)[1]
    assert screw.power(wrench, twist) == np.dot(wrench[0], twist[1]) + np.dot(wrench[1], twist[0])
    assert screw.double_geodesic(wrench, twist) == np.dot(flat(wrench), flat(twist))
    assert screw.swap(screw.swap(twist)) == twist


# --- Hamilton operators ----------------------------------------------------------------------------------------------


@claim
@given(dual_quaternions, dual_quaternions)
def test_hamilton_operators_multiply_from_the_left_and_from_the_right(x, y):
    assert dq.apply(dq.hamilton_left(x), y) == dq.apply(dq.hamilton_right(y), x) == dq.mul(x, y)  # (24)
    (p, _), (r, _) = x, y
    pr = quat.mul(p, r)
    assert tuple(np.array(quat.hamilton_left_matrix(p)) @ r) == pr  # (18), (19)
    assert tuple(np.array(quat.hamilton_right_matrix(r)) @ p) == pr
    assert quat.t4(quat.hamilton_left(p), r) == quat.t4(quat.hamilton_right(r), p) == pr  # (20), (23)


@claim
@given(quaternions)
def test_hamilton_vectors_hold_the_products_with_the_units(x):  # (22)
    units = (quat.ONE, quat.I, quat.J, quat.K)
    assert quat.hamilton_left(x) == tuple(quat.mul(x, e) for e in units)
    assert quat.hamilton_right(x) == tuple(quat.mul(e, x) for e in units)
    h = np.array(quat.hamilton_left_matrix(x))
    assert np.array_equal(h @ h.T, quat.norm2(x) * np.eye(4))  # orthogonal only for a unit x


@claim
@given(st.tuples(*[quaternions] * 4), quaternions, st.tuples(*[dual_quaternions] * 8), dual_quaternions)
def test_t4_and_t8_combine_the_columns_of_a_matrix(m, q, n, x):  # (20), (21)
    assert quat.t4(m, q) == tuple(np.array(m).T @ q)
    assert flat(dq.t8(n, x)) == list(np.array([flat(column) for column in n]).T @ flat(x))


# --- change of frame -------------------------------------------------------------------------------------------------


def conjugation(x, m):
    """x m x* by two products."""
    return dq.mul(dq.mul(x, pure(m)), dq.conj(x))


def ad(x, m):
    return screw.ad(screw.columns(x), m)


@claim
@given(poses(), screws)
def test_the_adjoint_is_the_conjugation(x, m):  # (33), (36)
    with mp.workdps(DIGITS):
        assert close(pure(ad(x, m)), conjugation(x, m))
        assert close(pure(screw.ad(screw.inverse(screw.columns(x)), m)), conjugation(dq.conj(x), m))


@claim
@given(poses())
def test_the_columns_are_products_with_the_units(x):
    with mp.workdps(DIGITS):
        (xp, xd), (a_p, a_d) = x, screw.columns(x)
        for e, p, d in zip((quat.I, quat.J, quat.K), a_p, a_d, strict=True):
            assert close(quat.pure(p), quat.mul(quat.mul(xp, e), quat.conj(xp)))  # (34)
            assert close(d, quat.scale(2, quat.im(quat.mul(quat.mul(xp, e), quat.conj(xd)))))  # (35)


@pytest.mark.case("G15")
@claim
@given(poses(), poses(), screws, screws)
def test_the_adjoint_respects_products_of_poses_and_of_screws(x, y, a, b):
    with mp.workdps(DIGITS):
        assert close(ad(dq.mul(x, y), a), ad(x, ad(y, a)))
        assert close(screw.compose(screw.columns(x), screw.columns(y)), screw.columns(dq.mul(x, y)))
        assert close(ad(x, screw.cross(a, b)), screw.cross(ad(x, a), ad(x, b)))
        assert close(ad(dq.conj(x), ad(x, a)), a)
        assert ad((quat.neg(x[0]), quat.neg(x[1])), a) == ad(x, a)  # x and -x are the same pose


@claim
@given(poses(), screws, screws)
def test_power_and_inner_product_are_the_same_in_every_frame(x, wrench, twist):
    with mp.workdps(DIGITS):
        assert close(screw.power(ad(x, wrench), ad(x, twist)), screw.power(wrench, twist))
        assert close(screw.inner(ad(x, wrench), ad(x, twist)), screw.inner(wrench, twist))


def test_the_double_geodesic_product_depends_on_the_frame():  # (7)
    x = dq.from_pose(quat.ONE, (1.0, 2.0, 3.0))
    a, b = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), ((0.0, 1.0, 0.0), (1.0, 0.0, 1.0))
    assert abs(screw.double_geodesic(ad(x, a), ad(x, b)) - screw.double_geodesic(a, b)) > 1


@claim
@given(poses(), vectors)
def test_a_unit_quaternion_turns_a_vector_by_conjugation(x, v):
    r = x[0]
    with mp.workdps(DIGITS):
        expected = quat.mul(quat.mul(r, quat.pure(v)), quat.conj(r))
        assert close(quat.pure(quat.rotate(r, v)), expected)
        by_columns = np.array(quat.rotation_columns(r)).T @ np.array(v)
        assert close(tuple(by_columns), quat.im(expected))


@claim
@given(poses(), poses())
def test_a_pose_holds_rotation_and_position_in_both_frames(x, y):  # (28)
    with mp.workdps(DIGITS):
        r, p, p_body = x[0], dq.translation(x), dq.translation_body(x)
        assert close(dq.from_pose(r, p), x)
        assert close((r, quat.scale(0.5, quat.mul(r, quat.pure(p_body)))), x)
        assert close(p, quat.rotate(r, p_body))
        # position of the composed pose: p_AC = p_AB + R_AB p_BC
        assert close(dq.translation(dq.mul(x, y)), quat.add(p, quat.rotate(r, dq.translation(y))))
        assert close(dq.norm2(x), (1, 0))


# --- exponential of a joint ------------------------------------------------------------------------------------------


def entire(a):
    """C, S and K of `screw.exp` on multi-precision numbers."""
    x = quat.norm2(a)
    if x == 0:
        return mp.mpf(1), mp.mpf(1), -mp.mpf(1) / 3
    h = mp.sqrt(x)
    return mp.cos(h), mp.sin(h) / h, (mp.cos(h) - mp.sin(h) / h) / x


def series(a):
    """Power series of the exponential of a dual quaternion."""
    term = total = dq.ONE
    for k in range(1, 60):
        term = dq.scale(mp.mpf(1) / k, dq.mul(term, a))
        total = dq.add(total, term)
    return total


@all_in_one([*itertools.product([0, 0.25], [-2.5, 0, 0.5, 3])])
def test_joint_exponentials_are_power_series_to_40_digits(of_what):  # (27)
    pitch, angle = of_what
    with mp.workdps(DIGITS):
        angle, third = mp.mpf(angle), mp.mpf(1) / 3
        axis = (2 * third, -third, 2 * third)
        line = (axis, quat.cross((mp.mpf(1), mp.mpf(-2), mp.mpf(0.5)), axis))
        joint = (axis, quat.add(line[1], quat.scale(pitch, axis)))
        c, s = mp.cos(angle / 2), mp.sin(angle / 2)
        expected = series(pure(screw.scale(angle / 2, joint)))
        assert close(screw.exp_helical(joint, angle, c, s), expected)
        assert close(screw.exp(screw.scale(angle / 2, joint), entire), expected)
        if pitch == 0:
            assert close(screw.exp_revolute(line, c, s), expected)
        slide = ((mp.mpf(0),) * 3, quat.scale(angle / 2, axis))
        assert close(screw.exp_prismatic(axis, angle), series(pure(slide)))


# --- vectors and matrices of dual quaternions ------------------------------------------------------------------------


def random_matrix(rng, rows, columns, make):
    return tuple(tuple(make(rng) for _ in range(columns)) for _ in range(rows))


def random_dq(rng):
    return tuple(tuple(rng.integers(-9, 9, 4).tolist()) for _ in range(2))


def random_screw(rng):
    return tuple(tuple(rng.integers(-9, 9, 3).tolist()) for _ in range(2))


def random_pose(rng):
    r = rng.standard_normal(4)
    return dq.from_pose(tuple((r / np.linalg.norm(r)).tolist()), tuple(rng.standard_normal(3).tolist()))


def test_a_product_of_matrices_is_the_sum_over_rows_and_columns():  # (8), (10), (11), (12)
    rng = np.random.default_rng(0)
    a, b, c = (random_matrix(rng, *shape, random_dq) for shape in ((3, 4), (4, 2), (3, 4)))
    product = matrix.matmul(a, b)
    for i, j in itertools.product(range(3), range(2)):
        expected = sum(np.array(flat(dq.mul(a[i][k], b[k][j]))) for k in range(4))
        assert flat(product[i][j]) == list(expected)
    for i, k in itertools.product(range(3), range(4)):
        assert matrix.add(a, c)[i][k] == dq.add(a[i][k], c[i][k])
    row, column = (a[0],), tuple((x,) for x in c[0])  # the product (11) of two vectors is a dual quaternion
    assert flat(matrix.matmul(row, column)) == list(
        sum(np.array(flat(dq.mul(x, y))) for x, y in zip(a[0], c[0], strict=True))
    )


def test_transposing_moves_entries_and_conjugating_changes_them_in_place():  # (9), (13)
    rng = np.random.default_rng(1)
    a, b = random_matrix(rng, 3, 2, random_dq), random_matrix(rng, 2, 3, random_dq)
    for i, j in itertools.product(range(3), range(2)):
        assert matrix.transpose(a)[j][i] == a[i][j]
        assert matrix.conj(a)[i][j] == dq.conj(a[i][j])
    a_star, b_star, product = (matrix.transpose(matrix.conj(m)) for m in (a, b, matrix.matmul(a, b)))
    assert product == matrix.matmul(b_star, a_star)
    # without the transposition, as (13) is printed, the factors do not even fit the other way round
    assert matrix.conj(matrix.matmul(a, b)) != matrix.matmul(matrix.conj(a), matrix.conj(b))


def test_elementwise_products_are_products_of_the_entries():  # (14), (15), (16), (17)
    rng = np.random.default_rng(3)
    (a,), (b,) = (random_matrix(rng, 1, 5, random_screw) for _ in range(2))
    for product in (screw.cross, screw.inner, screw.double_geodesic):
        assert matrix.elementwise(product, a, b) == tuple(product(x, y) for x, y in zip(a, b, strict=True))
    with pytest.raises(ValueError):
        matrix.elementwise(screw.cross, a, b[:3])


def fill(m, zero):
    return tuple(tuple(zero if entry is None else entry for entry in row) for row in m)


def test_none_stands_for_zero():
    rng = np.random.default_rng(4)
    a, b, c = (random_matrix(rng, 3, 3, random_dq) for _ in range(3))
    # a lower triangle, a diagonal and an empty row, so that sums of none, one and several terms all occur
    lower = tuple(tuple(x if j <= i else None for j, x in enumerate(row)) for i, row in enumerate(a))
    diagonal = ((b[0][0], None, None), (None, None, None), (None, None, b[2][2]))
    zero = (dq.ZERO, dq.ZERO)
    for left, right in itertools.product((lower, diagonal, c), repeat=2):
        full = matrix.matmul(fill(left, zero), fill(right, zero))
        assert fill(matrix.matmul(left, right), zero) == full
        assert fill(matrix.add(left, right), zero) == matrix.add(fill(left, zero), fill(right, zero))
    assert matrix.matmul(lower, diagonal)[0] == (dq.mul(a[0][0], b[0][0]), None, None)
    assert matrix.conj(lower)[0][1] is None
    assert matrix.transpose(lower)[0][1] == a[1][0]
    assert matrix.elementwise(screw.cross, (None,), (random_screw(rng),)) == (None,)


def lower_operators(rng, n=4):
    """Lower triangle of adjoint operators, without structural zeros on and below the diagonal."""
    return tuple(tuple(screw.columns(random_pose(rng)) if j <= i else None for j in range(n)) for i in range(n))


def dense(operators):
    """Blocks [n, n, 6, 6] of a matrix of operators, by their action on the unit screws."""
    units = [((e[0], e[1], e[2]), (e[3], e[4], e[5])) for e in np.eye(6).tolist()]
    blocks = [
        [np.zeros((6, 6)) if a is None else np.array([flat(screw.ad(a, e)) for e in units]).T for a in row]
        for row in operators
    ]
    return np.array(blocks)


def test_matrices_of_operators_act_as_block_matrices():
    rng = np.random.default_rng(5)
    operators = lower_operators(rng)
    blocks = dense(operators)
    (v,), m = random_matrix(rng, 1, 4, random_screw), random_matrix(rng, 4, 3, random_screw)
    numbers = rng.standard_normal(3).tolist()
    as_array = np.array([[flat(s) for s in row] for row in m])
    cases = [
        (matrix.act(operators, v), np.einsum("ijab,jb->ia", blocks, [flat(s) for s in v])),
        (matrix.act_on_matrix(operators, m), np.einsum("ijab,jkb->ika", blocks, as_array)),
        (matrix.combine(m, numbers), np.einsum("jka,k->ja", as_array, numbers)),
    ]
    assert all(near(found, expected, 64 * np.abs(expected).max()) for found, expected in cases)


def test_the_hermitian_conjugate_is_transposed_and_inverted_and_moves_to_the_other_side_of_power():
    rng = np.random.default_rng(6)
    operators = lower_operators(rng)
    for i, j in itertools.product(range(4), range(4)):
        entry = matrix.hermitian(operators)[i][j]
        assert (entry is None) == (j < i)
        assert entry is None or near((dense(((entry,),))[0, 0] @ dense(operators)[j, i]).tolist(), np.eye(6), 640)
    (f,), (v,) = (random_matrix(rng, 1, 4, random_screw) for _ in range(2))

    def power(a, b):
        return sum(screw.power(x, y) for x, y in zip(a, b, strict=True))

    here, there = power(f, matrix.act(operators, v)), power(matrix.act(matrix.hermitian(operators), f), v)
    assert abs(here - there) <= 1000 * EPS * 100
    untransposed = tuple(tuple(None if a is None else screw.inverse(a) for a in row) for row in operators)
    assert abs(here - power(matrix.act(untransposed, f), v)) > 1


# --- inertia ---------------------------------------------------------------------------------------------------------


def random_body(rng):
    """Mass, centre of mass, and a rotational inertia about it with six different entries."""
    a = rng.standard_normal((3, 3))
    return rng.uniform(1, 3), rng.standard_normal(3), a @ a.T + np.eye(3)


def rows(m):
    return tuple(tuple(row) for row in np.asarray(m).tolist())


def near(found, expected, roundings):
    """Same numbers up to some roundings of one."""
    expected = expected.vector if isinstance(expected, pin.Force) else expected
    expected = np.concatenate([expected.angular, expected.linear]) if isinstance(expected, pin.Motion) else expected
    return np.allclose(flat(found), np.ravel(expected), rtol=0, atol=roundings * EPS)


def about_origin(mass, com, inertia):
    """Rotational inertia about the frame's origin, by the parallel axis theorem."""
    return inertia + mass * (com @ com * np.eye(3) - np.outer(com, com))


@all_in_one(range(5))
def test_adjoint_and_composition_are_those_of_pinocchio(seed):
    rng = np.random.default_rng(seed)
    x, y = random_pose(rng), random_pose(rng)
    w, v = rng.standard_normal((2, 3))
    a, X, Y = (tuple(w), tuple(v)), se3(flat(x)), se3(flat(y))
    assert near(ad(x, a), X.act(pin.Motion(v, w)), 320) and near(ad(x, a), X.act(pin.Force(w, v)), 320)
    assert near((X * Y).homogeneous.tolist(), se3(flat(dq.mul(x, y))).homogeneous, 320)


@all_in_one(range(5))
def test_the_inertia_transform_is_mass_times_velocity_and_tensor_times_rate(seed):  # (30)
    rng = np.random.default_rng(seed)
    mass, com, inertia = random_body(rng)
    w, v = rng.standard_normal((2, 3))
    a = (tuple(w), tuple(v))
    assert near(Inertia(mass, None, rows(inertia)).momentum(a), [mass * v, inertia @ w], 640)
    found = Inertia(mass, tuple(mass * com), rows(about_origin(mass, com, inertia))).momentum(a)
    assert near(found, pin.Inertia(mass, com, inertia) * pin.Motion(v, w), 640)


@all_in_one([*itertools.product(range(5), [True, False])])
def test_carried_inertia_is_that_of_pinocchio_and_exactly_symmetric(of_what):
    seed, centred = of_what
    rng = np.random.default_rng(seed)
    mass, com, inertia = random_body(rng)
    com, x = com * (not centred), random_pose(rng)
    own = Inertia(mass, None if centred else tuple(mass * com), rows(about_origin(mass, com, inertia)))
    there = own.carried(screw.columns(x), dq.translation(x))
    m, h, carried = there
    expected = se3(flat(x)).act(pin.Inertia(mass, com, inertia))
    assert m == mass and near(h, mass * expected.lever, 320)
    tensor = about_origin(mass, expected.lever, expected.inertia)
    assert near(carried, tensor, 64 * np.abs(tensor).max()) and np.array_equal(carried, np.transpose(carried))
    # the momentum of the same motion, seen from the other frame
    twist = random_screw(rng)
    momentum = flat(ad(x, own.momentum(twist)))
    assert near(there.momentum(ad(x, twist)), momentum, 1e-11 / EPS)


# --- one source, any number ------------------------------------------------------------------------------------------

R = (0.5, -0.5, 0.5, 0.5)  # exact in binary, so that every kind of number starts from the same values
P = (1.25, -2.0, 0.75)
V = ((0.5, 1.5, -2.0), (3.0, -0.25, 1.0))
W = ((-1.0, 0.125, 2.5), (0.75, 2.0, -3.5))
INERTIA = ((2.0, 0.25, -0.5), (0.25, 3.0, 0.125), (-0.5, 0.125, 1.5))


def everything(r, p, v, w, mass, inertia):
    """A result of every function of the algebra."""
    x = dq.from_pose(r, p)
    y = dq.mul(x, dq.conj(dq.add(x, dq.scale(mass, x))))
    columns = screw.columns(x)
    body = Inertia(mass, p, inertia)
    about_com = six(inertia)
    moments = Moments.from_com(mass, p, about_com)
    angle = (mass, mass)
    operators = ((columns, None), (columns, screw.inverse(columns)))
    return [
        *(y, dq.norm2(y), dq.apply(dq.hamilton_left(y), x), dq.apply(dq.hamilton_right(y), x), dq.t8((y,) * 8, x)),
        *(dq.translation(x), dq.translation_body(x), quat.rotate(r, p), quat.hamilton_left_matrix(r)),
        *(quat.hamilton_right_matrix(r), quat.t4(quat.hamilton_left(r), r), quat.sub(r, quat.neg(r))),
        *(screw.cross(v, w), screw.inner(v, w), screw.double_geodesic(v, w), screw.power(v, w), screw.sub(v, w)),
        *(screw.ad(columns, v), screw.compose(columns, columns), body.momentum(v), moments.momentum(v)),
        *(body.carried(columns, p), body.plus(Inertia.from_com(mass, p, about_com)), moments.plus(moments)),
        *(moments.shifted(p), *moments.split(2), *(moments.turned(k, angle) for k in range(3))),
        RigidBody(mass, p, about_com).moved(x).plus(RigidBody(mass, r[1:], about_com), mass),
        *(elementary.ad(k, elementary.DualAngle(angle, mass), v) for k in range(3)),
        *(elementary.times(x, k, angle, mass) for k in range(3)),
        *(screw.exp_revolute(v, mass, mass), screw.exp_prismatic(p, mass), screw.exp_helical(v, mass, mass, mass)),
        *(screw.exp(v, lambda a: a), screw.log(y, lambda a, b: (a, b)), matrix.act(operators, (v, w))),
        *(matrix.combine(((v, w), (None, w)), (mass, mass)), matrix.act_on_matrix(operators, ((v,), (w,)))),
        *(matrix.matmul(((x, None),), ((y,), (x,))), matrix.conj(((x,),)), matrix.transpose(((x, y),))),
    ]


def convert(number, a):
    return tuple(convert(number, b) for b in a) if isinstance(a, tuple) else number(a)


def numbers_of(kind):
    """Every result on one kind of number."""
    return flat(everything(*(convert(kind, a) for a in (R, P, V, W, 1.5, INERTIA))))


@all_in_one([mp.mpf, partial(torch.tensor, dtype=torch.float64), np.float64])
def test_one_source_gives_the_same_results_on_every_kind_of_number(kind):
    expected, found = numbers_of(float), [float(x) for x in numbers_of(kind)]
    assert len(expected) > 200 and near(found, expected, 4 * max(map(abs, expected)))


# --- counts ----------------------------------------------------------------------------------------------------------


HAMILTON = (quat.hamilton_left_matrix, quat.hamilton_right_matrix, quat.hamilton_left, quat.hamilton_right)

COUNTS = [
    # result, multiplications, additions; more operations are in the tables of the paper, `paper/test_cost.py`
    ("quaternion conjugate", lambda: quat.conj(quaternion()), 0, 0),
    ("quaternion norm", lambda: quat.norm2(quaternion()), 4, 3),
    ("rotation matrix", lambda: quat.rotation_columns(quaternion()), 9, 15),
    ("Hamilton matrices and vectors (19), (22)", lambda: [h(quaternion()) for h in HAMILTON], 0, 0),
    ("dual quaternion norm", lambda: dq.norm2(dual_quaternion()), 8, 7),
    ("dual h+ applied (24)", lambda: dq.apply(dq.hamilton_left(dual_quaternion()), dual_quaternion()), 48, 40),
    ("dual h- applied (24)", lambda: dq.apply(dq.hamilton_right(dual_quaternion()), dual_quaternion()), 48, 40),
    ("screw times number", lambda: screw.scale(number(), motion()), 6, 0),
    ("inverse columns", lambda: screw.inverse(operator()), 0, 0),
    ("composed columns", lambda: screw.compose(operator(), operator()), 81, 63),
    ("inertia transform, centred (30)", lambda: body().momentum(motion()), 12, 6),
    ("inertia transform", lambda: Inertia(number(), vector(), tensor()).momentum(motion()), 24, 18),
    ("revolute exponential (27)", lambda: screw.exp_revolute(motion(), number(), number()), 6, 0),
    ("prismatic exponential (27)", lambda: screw.exp_prismatic(vector(), number()), 4, 0),
    ("adjoint of the identity", lambda: screw.ad(screw.IDENTITY, motion()), 0, 0),
    ("product with one", lambda: dq.mul(dq.ONE, dual_quaternion()), 0, 0),
]


@all_in_one(COUNTS)
def test_an_operation_costs_no_more_than_it_must(of_what):
    _, make, *expected = of_what
    assert [*cost(make())[:2]] == expected


def test_a_structural_zero_costs_nothing():
    n = 5
    lower = tuple(tuple(dual_quaternion() if j <= i else None for j in range(n)) for i in range(n))
    one_entry = tuple(tuple(dual_quaternion() if i == j == 0 else None for j in range(n)) for i in range(n))
    terms, entries = n * (n + 1) * (n + 2) // 6, n * (n + 1) // 2
    product = [[e for e in row if e] for row in matrix.matmul(lower, lower)]
    assert cost(product)[:2] == (48 * terms, 40 * terms + 8 * (terms - entries))
    column = [row[0] for row in matrix.matmul(lower, one_entry)]
    assert cost(column)[:2] == (48 * n, 40 * n)
    assert cost([e for row in matrix.add(one_entry, lower) for e in row if e])[:2] == (0, 8)
