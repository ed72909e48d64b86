"""Hard cases of the dynamics: long chains, singular mass matrices and positions, high speeds, and their derivatives.

Chains are of rods of 1 m and 1 kg on axes at random, or all parallel: the condition of their mass matrix grows with the
fourth power of their length, which forward dynamics cannot but show and inverse dynamics does not know of.
"""

import itertools
from functools import cache

import mpmath as mp
import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import DOWN, double, largest, random, rod_axes, rods, thinned
from messages import refused
from oracles import EPS, Case, over, random_tree, scaled, scaled_condition, shipped, size_of_torques, states
from precisions import F32, F64, compiler, eager_first, every_backend, every_backend_and_dtype
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vmap

import torchdq
from torchdq.errors import ArgumentError
from torchdq.functional import require_finite

HEAVY = 1e8


def norms(x):
    return x.double().norm(dim=-1)


def relative(found, expected):
    """Largest error of a row, relative to the row."""
    return float((norms(found.double() - expected) / norms(expected)).max())


# --- chains ----------------------------------------------------------------------------------------------------------


@cache
def chain_case(n, planar=False):
    """The chain with a model for pinocchio made from the same numbers."""
    model = pin.Model()
    model.gravity.linear = np.array(DOWN)
    rod, joint = pin.Inertia(1.0, np.array([0.5, 0, 0]), np.diag([0.0, 1 / 12, 1 / 12])), 0
    for i, axis in enumerate(rod_axes(n, planar)):
        placement = pin.SE3(np.eye(3), np.array([float(i > 0), 0, 0]))
        joint = model.addJoint(joint, pin.JointModelRevoluteUnaligned(axis), placement, f"joint{i + 1}")
        model.appendBodyToJoint(joint, rod, pin.SE3.Identity())
    return Case(rods(n, planar), model)


@cache
def motion(n, rows, dtype=F64):
    """Positions about the stretched one, velocities and accelerations; single precision's are double's too."""
    return tuple(x.float().to(dtype) for x in random(3, rows, n, seed=n) * torch.tensor([0.3, 1, 1])[:, None, None])


@cache
def exact_torques(n, planar):
    """Torques [rows, n] of the first two motions by Newton and Euler in the base frame, with 40 digits."""
    one, zero = mp.mpf(1), mp.mpf(0)
    exact = np.vectorize(mp.mpf, otypes=[object])
    rows = []
    with mp.workdps(40):
        for q, qd, qdd in zip(*(exact(x[: rows_of(n)].numpy()) for x in motion(n, 2)), strict=True):
            R, w, wd, a = exact(np.eye(3)), exact(np.zeros(3)), exact(np.zeros(3)), -exact(DOWN)
            links = []
            for axis, q_i, qd_i, qdd_i in zip(exact(rod_axes(n, planar)), q, qd, qdd, strict=True):
                x, y, z = axis
                K = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
                turning = R @ axis
                R = R @ (exact(np.eye(3)) + mp.sin(q_i) * K + (one - mp.cos(q_i)) * (K @ K))
                wd = wd + qdd_i * turning + qd_i * np.cross(w, turning)
                w = w + qd_i * turning
                rod = R[:, 0]

                def accelerated(r, a=a, w=w, wd=wd):
                    return a + np.cross(wd, r) + np.cross(w, np.cross(w, r))

                def spun(v, rod=rod):
                    return (v - rod * (rod @ v)) / 12

                moment = spun(wd) + np.cross(w, spun(w))
                links.append((turning, rod, accelerated(rod / 2), moment))
                a = accelerated(rod)
            force, moment, tau = exact(np.zeros(3)), exact(np.zeros(3)), []
            for turning, rod, f, m in reversed(links):
                moment = moment + np.cross(rod, force) + m + np.cross(rod / 2, f)
                force = force + f
                tau.append(float(turning @ moment))
            rows.append(tau[::-1])
    return double(*rows)


def rows_of(n):
    return 1 if n > 200 else 2


LENGTHS = (1, 2, 7, 42, 200, 300, 1000)
CHAINS = [*itertools.product(LENGTHS, (False, True))]
SHORT = [(1, False), (2, True), (7, False), (42, True)]


@pytest.mark.case("D1")
@pytest.mark.parametrize(("n", "planar"), thinned(CHAINS, SHORT))
def test_torques_of_a_chain_of_any_length_are_exact_to_rounding(n, planar, margin):
    robot, expected = rods(n, planar), exact_torques(n, planar)
    for dtype, allowed in ((F64, 4 * n * EPS[F64]), (F32, 5e-6)):
        x, backend = (v[: rows_of(n)] for v in motion(n, 2, dtype)), "c" if n == 7 else "eager"
        tau = torchdq.inverse_dynamics(robot, *x, backend=backend)
        margin(relative(tau, expected), allowed, f"{dtype}")
    if n <= 200:  # pinocchio keeps several tensors of n^3 numbers, 8 GB each at n = 1000
        case = chain_case(n, planar)
        data = case.model.createData()
        reference = [pin.rnea(case.model, data, *row) for row in zip(*(x.numpy() for x in motion(n, 2)), strict=True)]
        tau = torchdq.inverse_dynamics(robot, *motion(n, 2))
        margin(relative(tau, double(*map(list, reference))), 4 * n * EPS[F64], "against pinocchio")


@pytest.mark.case("D2", "D9")
@pytest.mark.parametrize(("n", "planar"), thinned(CHAINS, SHORT))
def test_torques_of_the_accelerations_of_a_chain_are_the_torques_given(n, planar, margin):
    """The residual is small whatever the condition; the error of the accelerations themselves is within it."""
    robot = rods(n, planar)
    q, qd, _ = single = tuple(x[: rows_of(n)] for x in motion(n, 2, F32))
    wide = tuple(x.double() for x in single)
    tau = torchdq.inverse_dynamics(robot, *wide).float()  # a number of either precision

    def residual(qdd):
        return relative(torchdq.inverse_dynamics(robot, *wide[:2], qdd.double()), tau.double())

    exact = torchdq.forward_dynamics(robot, *wide[:2], tau.double())
    margin(residual(exact), max(32, 4 * n) * EPS[F64], "residual in double precision")
    found = torchdq.forward_dynamics(robot, q, qd, tau)
    margin(residual(found), 5e-6, "residual in single precision")
    if n > 200:
        assert found.equal(exact.float())  # no float32 is closer
    else:
        asked = torchdq.forward_dynamics(robot, q, qd, tau, precision="double")
        assert asked.dtype == F32 and (n < 200 or found.equal(asked))  # from some length on without being asked
        margin(relative(asked, exact), EPS[F32], "precision double")  # a rounding; 1e-6 was asked for


@pytest.mark.case("D2", "D9")
@every_backend_and_dtype
@pytest.mark.parametrize("n", thinned([2, 7, 16], [7]))
def test_accelerations_of_a_chain_are_as_exact_as_their_condition(n, dtype, backend, margin):
    """In units of 1 / sqrt(M_ii); rounded are M, and on the right side torques, some of which cancel."""
    case = chain_case(n, False)
    q, qd, qdd = motion(n, 6, dtype)
    wide = [x.double() for x in (q, qd)]
    tau = torchdq.inverse_dynamics(case.robot, *wide, qdd.double()).to(dtype)
    with torchdq.backend(backend):
        found = torchdq.forward_dynamics(case.robot, q, qd, tau).double()
    data = case.model.createData()
    rows = zip(*(x.numpy() for x in (*wide, tau.double())), strict=True)
    expected = double(*[pin.aba(case.model, data, *row).tolist() for row in rows])
    M, D = scaled(torchdq.mass_matrix(case.robot, wide[0]))
    sizes = torch.linalg.svdvals(M)
    terms = tau.double().abs() + torchdq.inverse_dynamics(case.robot, *wide).abs()
    size = (expected / D).abs().amax(-1) + (D * terms).abs().amax(-1) / sizes[:, 0]
    error = ((found - expected) / D).abs().amax(-1) / (size * sizes[:, 0] / sizes[:, -1])
    margin(error.max(), 32 * EPS[dtype], "against pinocchio, per condition")
    assert (torchdq.error_growth(case.robot, wide[0]) < 2**10).all()  # none was mended


# --- singular rows and positions -------------------------------------------------------------------------------------

GOOD, MENDED, SINGULAR, NOT_FINITE = range(4)


# massless arm of two links with a point at its end: M = m J^T J, singular where it is stretched
STRETCHABLE = torchdq.Robot.from_screws(
    [[0, 0, 1, 0, 0, 0], [0, 0, 1, 0, -1, 0]],
    mass=[0.0, 2.0],
    com=[[0, 0, 0], [1.0, 0, 0]],
    inertia=np.zeros((2, 6)),
    link_poses=[[1.0, 0, 0, 0, 0, x, 0, 0] for x in (0, 0.5)],
    gravity=DOWN,
)


def rows(dtype):
    """Positions, velocities and torques: well conditioned, indefinite in single precision only, singular, no number."""
    q = torch.tensor([[0.3, 1.0], [0.3, 1e-4], [0.3, 0.0], [0.3, torch.nan]], dtype=dtype)
    tau = torch.tensor([1.0, -2.0], dtype=dtype).expand_as(q).clone()
    return q, 0.5 * tau, tau


def accelerate(q, qd, tau):
    return torchdq.forward_dynamics(STRETCHABLE, q, qd, tau)


def value(*x):
    return (accelerate(*x),)


def gradients(*x):
    x = [v.clone().requires_grad_() for v in x]
    return torch.autograd.grad((accelerate(*x) * x[0].new_tensor([1.0, 2.0])).sum(), x)


def second_gradients(*x):
    x = [v.clone().requires_grad_() for v in x]
    (first,) = torch.autograd.grad((accelerate(*x) * x[0].new_tensor([1.0, 2.0])).sum(), x[:1], create_graph=True)
    return torch.autograd.grad(first.sum(), x)


def compiled(*x):
    """Values and gradients of a traced graph."""
    torch._dynamo.reset()
    traced = torch.compile(accelerate, backend="aot_eager", fullgraph=True)
    x = [v.clone().requires_grad_() for v in x]
    y = traced(*x)
    return (y.detach(), *torch.autograd.grad((y * x[0].new_tensor([1.0, 2.0])).sum(), x))


ROUTES = {
    "value": value,
    "gradients": gradients,
    "second gradients": second_gradients,
    "vmap": lambda *x: (vmap(accelerate)(*x),),
    "jacrev under vmap": lambda *x: vmap(jacrev(accelerate, (0, 1, 2)))(*x),
    "jacfwd under vmap": lambda *x: vmap(jacfwd(accelerate, (0, 1, 2)))(*x),
    "hessian under vmap": lambda *x: vmap(hessian(accelerate))(*x)[None],
    "torch.compile": compiled,
}
UNTRACED = [route for route in ROUTES if route != "torch.compile"]


@pytest.mark.case("D3", "D12")
@pytest.mark.parametrize(
    ("route", "backend", "dtype"),
    [
        *itertools.product(thinned(ROUTES, UNTRACED), ["eager"], thinned((F64, F32), (F64,))),
        *(
            pytest.param(route, "c", dtype, marks=compiler)
            for route in thinned(ROUTES, ("gradients",))
            for dtype in thinned((F64, F32), (F32,))
        ),
    ],
    ids=str,
)
def test_a_good_row_is_bitwise_what_it_is_alone_beside_singular_ones(route, backend, dtype):
    x = rows(dtype)
    growth = torchdq.error_growth(STRETCHABLE, x[0])
    assert not growth[MENDED] <= 2**10 and not growth[SINGULAR] <= 2**46 and growth[GOOD] < 10
    with torchdq.backend(backend):
        together, alone = ROUTES[route](*x), ROUTES[route](*(v[:1] for v in x))
    for many, one in zip(together, alone, strict=True):
        assert one.isfinite().all() and torch.equal(many[GOOD], one[0])
        assert not many[SINGULAR].isfinite().any() or route != "value"
    assert all(y[[SINGULAR, NOT_FINITE]].isnan().any() for y in together)


@pytest.mark.case("D3", "D12")
@pytest.mark.parametrize(
    ("route", "backend"),
    [
        *((route, "eager") for route in thinned(ROUTES, UNTRACED)),
        *(pytest.param(route, "c", marks=compiler) for route in thinned(ROUTES, ("second gradients",))),
    ],
)
def test_a_row_that_is_indefinite_in_single_precision_is_that_of_double_rounded(route, backend):
    x = tuple(v[[GOOD, MENDED]] for v in rows(F32))
    with torchdq.backend(backend):
        single, wide = ROUTES[route](*x), ROUTES[route](*(v.double() for v in x))
    for y, exact in zip(single, wide, strict=True):
        assert y.dtype == F32 and torch.equal(y[MENDED], exact[MENDED].float())


@pytest.mark.case("D3", "D12")
@every_backend
def test_a_mended_row_leaves_the_gradient_of_what_all_rows_share_finite(backend, margin):
    x = tuple(v[[GOOD, MENDED]] for v in rows(F32))

    def total(mass, x):
        return torchdq.forward_dynamics(STRETCHABLE.replace(mass=mass), *x).sum()

    with torchdq.backend(backend):
        found = grad(total)(torch.tensor([0.0, 2.0]), x)
        expected = grad(total)(double(0.0, 2.0), [v.double() for v in x])
    margin(abs(float(found[1] - expected[1])), 4 * EPS[F32] * abs(float(expected[1])))


@pytest.mark.case("D4")
@every_backend_and_dtype
def test_at_a_stretched_arm_only_the_task_space_is_singular(dtype, backend, margin):
    """The Jacobian loses a rank; accelerations and their derivatives do not notice, and damping bounds its inverse."""
    case = shipped("two_link")
    q = torch.tensor([[0.4, 0.0], [0.4, 1e-9]], dtype=dtype)
    qd, tau = 1 + q, 2 - q
    with torchdq.backend(backend):
        J = torchdq.jacobian(case.robot, q, "tip")[:, 3:5]
        bent = torch.stack([q.new_full((60,), 0.4), double(*np.geomspace(1e-6, 1, 60)).to(dtype)], -1)
        near = torchdq.jacobian(case.robot, bent, "tip")[:, 3:5].double()
        qdd = torchdq.forward_dynamics(case.robot, q, qd, tau).double()
        slopes = vmap(jacrev(lambda *x: torchdq.forward_dynamics(case.robot, *x), (0, 1, 2)))(q, qd, tau)
        bends = vmap(hessian(lambda q: torchdq.forward_kinematics(case.robot, q, "tip")))(q)
    wide = [x.double().numpy() for x in (q, qd, tau)]
    data = case.model.createData()
    condition = float(torch.linalg.cond(torchdq.mass_matrix(case.robot, q.double())).max())
    expected = double(*[pin.aba(case.model, data, *row).tolist() for row in zip(*wide, strict=True)])
    margin(relative(qdd, expected), 8 * EPS[dtype] * condition, "accelerations")
    for k, row in enumerate(zip(*wide, strict=True)):
        reference = pin.computeABADerivatives(case.model, data, *row)
        for found, name, derivative in zip(slopes, ("q", "qd", "tau"), reference, strict=True):
            size = max(1.0, np.abs(derivative).max())  # Coriolis torques vanish here
            error = np.abs(found[k].double().numpy() - derivative).max() / size
            margin(error, 16 * EPS[dtype] * condition, f"derivative in {name}")
    assert bends.isfinite().all()
    least = torch.linalg.svdvals(J.double())[:, 1]
    margin(least.max(), 1e-9 + EPS[dtype], "least singular value")
    for damping in (1e-1, 1e-4):
        inverse = near.mT @ torch.linalg.inv(near @ near.mT + damping**2 * torch.eye(2))
        margin(torch.linalg.matrix_norm(inverse, 2).max(), (1 + 1e-9) / (2 * damping), f"damped by {damping:g}")


# --- high speeds -----------------------------------------------------------------------------------------------------

SPEEDS = (1.0, 1e2, 1e4, 1e6)


@pytest.mark.case("D5")
@every_backend_and_dtype
@pytest.mark.parametrize("name", ["panda", "puma560"])
def test_torques_keep_their_digits_at_any_speed(name, dtype, backend, margin):
    case, worst = shipped(name), 0.0
    for speed in SPEEDS:
        s = states(case.robot, batch=4, dtype=dtype)
        s = s._replace(qd=s.qd * speed)
        with torchdq.backend(backend):
            tau = torchdq.inverse_dynamics(case.robot, s.q, s.qd, s.qdd).double()
        reference = over(lambda model, data, q, v, a, *_: pin.rnea(model, data, q, v, a), case, s)
        error = np.abs(tau.numpy() - reference[:, case.order]).max(0) / size_of_torques(case, s).max()
        worst = max(worst, error.max())
    margin(worst, 8 * EPS[dtype], "of the largest torque")


@pytest.mark.case("D5")
@eager_first
def test_speeds_whose_squares_overflow_are_seen_in_their_own_row(backend):
    robot = torchdq.robots.load("two_link")
    for dtype, speed in ((F32, 1e25), (F32, torch.inf), (F64, 1e200), (F64, torch.inf)):
        q, qd, qdd = random(3, 4, 2, dtype=dtype)
        fast = qd.clone()
        fast[2] = speed
        with torchdq.backend(backend):
            for f in (torchdq.inverse_dynamics, torchdq.forward_dynamics):
                found, before = (f(robot, q, v, qdd) for v in (fast, qd))
                assert not found[2].isfinite().all()
                assert found[[0, 1, 3]].equal(before[[0, 1, 3]])
                with refused(ArgumentError):
                    require_finite(tau=found)


# --- the mass matrix and the closed form -----------------------------------------------------------------------------


@pytest.mark.case("D6")
@every_backend_and_dtype
@pytest.mark.parametrize("tip", [1.0, HEAVY], ids=["uniform", "heavy tip"])
def test_the_mass_matrix_of_a_chain_is_symmetric_and_definite_to_rounding(tip, dtype, backend, margin):
    n = 7
    robot = rods(n, tip=tip)
    q, qd, _ = motion(n, 8, dtype)
    with torchdq.backend(backend):
        M = torchdq.mass_matrix(robot, q)
        T = torchdq.kinetic_energy(robot, q, qd)
        slope = vmap(jacrev(lambda q: torchdq.mass_matrix(robot, q)))(q)
    assert M.equal(M.mT)
    assert slope.equal(slope.transpose(1, 2))
    least = torch.linalg.eigvalsh(scaled(M.double())[0])[:, 0].min()
    if tip == 1.0 or dtype == F64:
        assert least > 0
    margin(-float(least.clamp(max=0)), n * EPS[dtype], "negative eigenvalue")
    size = torch.einsum("bi,bij,bj->b", qd.abs(), M.abs(), qd.abs()).double()
    power = torch.einsum("bi,bij,bj->b", qd.double(), M.double(), qd.double())
    margin(((power - 2 * T.double()).abs() / size).max(), 4 * EPS[dtype], "kinetic energy")


@pytest.mark.case("D7")
@pytest.mark.parametrize(
    ("n", "planar", "backend"),
    [
        *thinned([(9, False, "eager"), (16, True, "eager")], [(9, False, "eager")]),
        pytest.param(4, False, "c", marks=compiler),
    ],
)
def test_the_closed_form_of_a_long_chain_is_its_recursion(n, planar, backend, margin):
    """Its operations grow with the cube of the length, which is why the chain is no longer."""
    robot, f_tip = rods(n, planar), random(2, 6, seed=2, dtype=F32)
    expected = torchdq.inverse_dynamics(robot, *motion(n, 2), f_tip.double())
    composite = torchdq.mass_matrix(robot, motion(n, 2)[0])
    for dtype in (F64, F32):
        q, qd, qdd = motion(n, 2, dtype)
        M, c, g, Jt = torchdq.closed_form(robot, q, qd, backend=backend)
        tau = torch.einsum("bij,bj->bi", M, qdd) + c + g + torch.einsum("bij,bj->bi", Jt, f_tip.to(dtype))
        margin(relative(tau, expected), 64 * n * EPS[F64] if dtype == F64 else 1e-5, f"torques, {dtype}")
        margin(largest(M - composite) / largest(composite), n * EPS[dtype], f"mass matrix, {dtype}")


@pytest.mark.case("D8")
@every_backend_and_dtype
def test_mdot_less_two_c_is_skew(dtype, backend, margin):
    """C is Christoffel's: half of the derivative of the Coriolis torques in the velocities, which are quadratic."""
    for case in (shipped("two_link"), random_tree(4, seed=7, armature=True)):
        robot, s = case.robot.replace(gravity=None).bake(), states(case.robot, batch=4, dtype=dtype)
        with torchdq.backend(backend):
            matrix = torchdq.dynamics_jacobian(robot, s.q, s.qd, torch.zeros_like(s.q))[1] / 2
            rate = jvp(lambda q, r=robot: torchdq.mass_matrix(r, q), (s.q,), (s.qd,))[1]
            c = torchdq.inverse_dynamics(robot, s.q, s.qd)
        N = (rate - 2 * matrix).double()
        size = torch.linalg.matrix_norm(matrix.double())
        margin((torch.linalg.matrix_norm(N + N.mT) / size).max(), 64 * EPS[dtype], "skew")
        margin(largest(torch.einsum("bij,bj->bi", matrix, s.qd) - c) / largest(c), 64 * EPS[dtype], "C qd = c")


# --- wrenches and free fall ------------------------------------------------------------------------------------------


@pytest.mark.case("D10")
@every_backend_and_dtype
def test_wrenches_do_the_work_that_torques_do(dtype, backend, margin):
    """Virtual work, the velocities of frames being those of pinocchio."""
    case = random_tree(4, seed=7)
    robot, s = case.robot, states(case.robot, batch=3, dtype=dtype)
    with torchdq.backend(backend):
        free = torchdq.inverse_dynamics(robot, s.q).double()
        loaded = torchdq.inverse_dynamics(robot, s.q, f_tip=s.f_tip, f_ext=s.f_ext).double()
    ids = [case.frame_id(name) for name in (*robot.link_names, robot.tip)]
    wrenches = torch.cat([s.f_ext, -s.f_tip[:, None]], 1).double().numpy()  # on the links

    def velocities(model, data, q, *_):
        return [pin.computeFrameJacobian(model, data, q, k, pin.LOCAL) for k in ids]  # linear, angular

    J = over(velocities, case, s)[..., case.order]
    work, size = (np.einsum("bfkn,bfk->bfn", *x) for x in ((J, wrenches), (abs(J), abs(wrenches))))
    margin(np.abs((loaded - free).numpy() + work.sum(1)).max(), 16 * EPS[dtype] * size.max())


@pytest.mark.case("D10")
@every_backend_and_dtype
def test_what_falls_freely_feels_no_gravity(dtype, backend, margin):
    robot = torchdq.Robot.from_screws(
        [[0, 0, 0, 0, 0, -1.0], [0, 1.0, 0, 0, 0, 0], [0.6, 0, 0.8, 0, -0.8, 0]],
        mass=[1.0, 2.0, 0.5],
        com=[[0, 0, 0], [0.5, 0.1, 0], [1.3, 0, 0.2]],
        inertia=[(0.1, 0, 0.1, 0, 0, 0.1)] * 3,
        gravity=(0, 0, -9.81),
    )
    s = states(robot, batch=4, dtype=dtype)
    fall = torch.tensor([9.81, 0, 0], dtype=dtype)
    with torchdq.backend(backend):
        tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd + fall)
        expected = torchdq.inverse_dynamics(robot.replace(gravity=None).bake(), s.q, s.qd, s.qdd)
        qdd = torchdq.forward_dynamics(robot, s.q, None, torch.zeros_like(s.q))
    size = largest(expected) + 9.81 * 3.5
    margin(largest(tau - expected), 16 * EPS[dtype] * size, "torques")
    condition = float(torch.linalg.cond(torchdq.mass_matrix(robot, s.q.double())).max())
    margin(largest(qdd - fall), 4 * EPS[dtype] * 9.81 * condition, "accelerations")


# --- derivatives -----------------------------------------------------------------------------------------------------

TWINS = {"chain": lambda: chain_case(7, False), "tree": lambda: random_tree(3, seed=4, armature=True)}
every_twin = pytest.mark.parametrize(
    ("twin", "dtype"), thinned([*itertools.product(TWINS, (F64, F32))], [("chain", F64), ("tree", F32)]), ids=str
)


def pinocchios(function, case, s):
    """Derivatives of pinocchio for every state, in the robot's order."""

    def derivatives(model, data, q, v, a, *_):
        return [np.array(x) for x in function(model, data, q, v, a)]

    found = over(derivatives, case, s)[:, :, case.order][..., case.order]
    found[:, 2] = np.triu(found[:, 2]) + np.triu(found[:, 2], 1).swapaxes(-1, -2)  # the other triangle is not promised
    return torch.from_numpy(found)


def error_of_derivatives(found, expected):
    """Largest error of each derivative, relative to its largest entry."""
    pairs = zip(found, expected.unbind(1), strict=True)
    return max(float(((x.double() - y).abs().amax((-2, -1)) / y.abs().amax((-2, -1))).max()) for x, y in pairs)


@pytest.mark.case("D11")
@every_twin
def test_gradients_of_torques_are_those_of_pinocchio(twin, dtype, margin):
    case = TWINS[twin]()
    s = states(case.robot, batch=3, dtype=dtype)
    expected = pinocchios(pin.computeRNEADerivatives, case, s)
    reverse = vmap(jacrev(lambda *x: torchdq.inverse_dynamics(case.robot, *x), (0, 1, 2)))(s.q, s.qd, s.qdd)
    direct = torchdq.dynamics_jacobian(case.robot, s.q, s.qd, s.qdd)
    slope = vmap(jacrev(lambda q: torchdq.mass_matrix(case.robot, q)))(s.q)
    # angles are of several turns, and rounded when home is subtracted
    margin(error_of_derivatives(reverse, expected), 128 * EPS[dtype], "reverse mode")
    margin(error_of_derivatives(direct, expected), 128 * EPS[dtype], "dynamics_jacobian")
    margin(largest(slope - slope.transpose(1, 2)), EPS[dtype] * largest(slope), "dM/dq is symmetric")


@pytest.mark.case("D11")
def test_gradients_of_the_torques_of_a_long_chain_are_those_of_pinocchio(margin):
    case = chain_case(42, False)
    x = [v[:1].clone().requires_grad_() for v in motion(42, 2)]
    weights = random(1, 42, seed=3)
    found = torch.autograd.grad((torchdq.inverse_dynamics(case.robot, *x) * weights).sum(), x)
    data = case.model.createData()
    reference = pin.computeRNEADerivatives(case.model, data, *(v[0].detach().numpy() for v in x))
    M = np.triu(reference[2]) + np.triu(reference[2], 1).T
    for name, y, derivative in zip(("q", "qd", "qdd"), found, (*reference[:2], M), strict=True):
        expected = weights.numpy() @ derivative
        margin(np.abs(y.numpy() - expected).max() / np.abs(expected).max(), 4 * 42 * EPS[F64], f"in {name}")


@pytest.mark.case("D12")
@every_twin
def test_gradients_of_accelerations_are_those_of_pinocchio(twin, dtype, margin):
    case = TWINS[twin]()
    s = states(case.robot, batch=3, dtype=dtype)
    expected = pinocchios(pin.computeABADerivatives, case, s)
    found = vmap(jacrev(lambda *x: torchdq.forward_dynamics(case.robot, *x), (0, 1, 2)))(s.q, s.qd, s.qdd)
    allowed = 64 * EPS[dtype] * scaled_condition(torchdq.mass_matrix(case.robot, s.q.double()))
    assert dtype == F32 or allowed < 1e-9
    margin(error_of_derivatives(found, expected), allowed)


@pytest.mark.case("D12")
@eager_first
def test_second_derivatives_of_accelerations_are_finite_differences(backend):
    robot = torchdq.robots.load("two_link")
    x = [v.requires_grad_() for v in random(3, 2)]

    def f(*x):
        return torchdq.forward_dynamics(robot, *x, backend=backend)

    assert torch.autograd.gradcheck(f, x, eps=1e-6, atol=1e-8, rtol=1e-6)
    assert torch.autograd.gradgradcheck(f, x, eps=1e-6, atol=1e-7, rtol=1e-5)
