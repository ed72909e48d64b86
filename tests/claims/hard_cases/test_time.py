"""Hard cases of time: orders, reversal, adaptive steps, long gradients, stiffness, friction, limits, NaN.

What test_integrators.py, tests/effects and test_scene.py hold already is marked there; here is single precision, the
compiled programs, second derivatives, and physics that those do not ask for. References are closed solutions, mpmath,
and scipy's DOP853 on pinocchio's accelerations. Energy over long times is in test_energy.py.
"""

import itertools
import math
from functools import cache

import mpmath
import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import EVERYTHING, FIXED, INERTIA, WHEEL, called, double, exhaustive, one_thread, random, thinned  # noqa: F401
from messages import warned
from oracles import EPS, pinocchio_model, shipped
from precisions import (
    F32,
    F64,
    C,
    compiled,
    eager_first,
    every_backend_and_dtype,
    every_dtype,
    of_backends_and_dtypes,
    single_compiled,
)
from scenes import ARM, rolled, swinging, trace
from scipy.integrate import solve_ivp

import torchdq
from torchdq import Scene, dq, effects
from torchdq.scene import State
from torchdq.scene.integrators import (
    DormandPrince,
    ExplicitEuler,
    Integrator,
    LinearlyImplicit,
    RungeKutta4,
    SemiImplicitEuler,
    StoermerVerlet,
)


def cast(state, dtype):
    return State(state.q.to(dtype), state.qd.to(dtype))


def largest(a, b):
    """Largest difference of two states, or of rows of tensors."""
    return float(np.max([float((x.double() - y.double()).abs().max()) for x, y in zip(a, b, strict=True)]))


# --- T1: orders ------------------------------------------------------------------------------------------------------

# order, and steps in half a second at the coarsest; the pair of order 5 takes its largest steps where no error is too
# large for it: a fixed pattern in every dt
ORDERS = {
    ExplicitEuler(): (1, 64),
    SemiImplicitEuler(): (1, 64),
    LinearlyImplicit(): (1, 64),
    StoermerVerlet(): (2, 16),
    RungeKutta4(): (4, 16),
    DormandPrince(1e6, 1e6): (5, 8),
}


@cache
def ends_by_scipy():
    """Starts and ends of half a second of the arm with damping 0.3."""
    case = shipped("two_link")
    starts, data = 0.5 * torch.cat([*random(2, 8, 2, seed=3)], -1), case.model.createData()

    def rates(_, y):
        return np.concatenate([y[2:], pin.aba(case.model, data, y[:2], y[2:], -0.3 * y[2:])])

    ends = [solve_ivp(rates, (0.0, 0.5), y, method="DOP853", rtol=2.3e-14, atol=1e-16).y[:, -1] for y in starts.numpy()]
    return State(*starts.split(2, -1)), State(*torch.from_numpy(np.array(ends)).split(2, -1))


def damped(integrator, backend, k):
    parts = (effects.Gravity(), effects.Viscous(0.3))
    return Scene(ARM, parts, integrator=integrator, dt=0.5 / k, backend=backend)


@pytest.mark.case("T1")
@compiled
@pytest.mark.parametrize("integrator", thinned(ORDERS, [RungeKutta4()]), ids=called)
def test_the_error_falls_with_the_order_over_two_quarterings(integrator, backend, margin):
    order, coarsest = ORDERS[integrator]
    starts, ends = ends_by_scipy()
    steps = coarsest * 4 ** np.arange(3)
    with torch.no_grad():
        found = [rolled(damped(integrator, backend, int(k)), starts, int(k)) for k in steps]
    errors = [float((torch.cat(x[:2]) - torch.cat(ends[:2])).norm()) for x in found]
    assert errors[-1] > 1e4 * EPS[F64]  # above rounding
    assert integrator.order == order
    margin(abs(-np.polyfit(np.log2(steps), np.log2(errors), 1)[0] - order), 0.15, called(integrator))


@pytest.mark.case("T1")
@compiled
@pytest.mark.parametrize("integrator", thinned(FIXED, FIXED[2:]), ids=called)
def test_single_precision_follows_to_its_rounding(integrator, backend, margin):
    starts, _ = ends_by_scipy()
    with torch.no_grad():
        exact = rolled(damped(integrator, backend, 64), starts, 64)
        found = rolled(damped(integrator, backend, 64), cast(starts, F32), 64)
    assert found.q.dtype == F32
    size = float(torch.cat(exact[:2]).abs().max())
    margin(largest(found[:2], exact[:2]) / size, 4 * EPS[F32] * 64**0.5, called(integrator))


# --- T3: reversal and momenta ----------------------------------------------------------------------------------------

# a cart on a rail with a double pendulum, and the arm without gravity: nothing acts along the first joint
CART = torchdq.Robot.from_screws(
    [[0, 0, 0, 1.0, 0, 0], [0, 0, 1.0, 0, 0, 0], [0, 0, 1.0, 0, -0.5, 0]],
    [2.0, 1.0, 0.7],
    [[0, 0, 0], [0.3, 0, 0], [0.9, 0.1, 0]],
    [np.diag([0.1, 0.2, 0.3])] * 3,
    name="cart",
)


@pytest.mark.case("T3")
@compiled
@pytest.mark.parametrize(
    "robot, integrator, dtype",
    thinned(
        [*itertools.product((ARM, CART), (StoermerVerlet(), RungeKutta4()), (F64, F32))],
        [(ARM, StoermerVerlet(), F64), (CART, StoermerVerlet(), F32), (CART, RungeKutta4(), F64)],
    ),
    ids=lambda x: called(x) if isinstance(x, Integrator) else getattr(x, "name", str(x)),
)
def test_a_momentum_that_nothing_acts_on_is_kept(robot, integrator, dtype, backend, margin):
    """By pinocchio's mass matrix; 1e4 steps of 2.5 ms."""
    scene = Scene(robot, integrator=integrator, dt=2.5e-3, backend=backend)
    with torch.no_grad():
        q, qd = (x[::10] for x in trace(scene, cast(State(*random(2, robot.n, seed=4)), dtype), 10_000)[:2])
    model = pinocchio_model(robot)
    data = model.createData()
    pairs = zip(q.double().numpy(), qd.double().numpy(), strict=True)
    momentum = [(pin.crba(model, data, x) @ v)[0] for x, v in pairs]
    size = np.abs(momentum[0])
    assert (qd[:, 1] - qd[0, 1]).abs().max() > 0.1
    drift = np.abs(np.array(momentum) - momentum[0]).max() / size
    # Runge-Kutta keeps it to its order, Verlet to rounding
    order = 1e-10 if isinstance(integrator, RungeKutta4) else 0.0
    margin(drift, order + 0.5 * EPS[dtype] * 10_000, f"{robot.name}, {called(integrator)}, {dtype}")


@pytest.mark.case("T3")
@compiled
@every_dtype
@pytest.mark.parametrize(
    "integrator, factor", thinned([(StoermerVerlet(), 2.0), (RungeKutta4(), 0.05)], [(StoermerVerlet(), 2.0)]), ids=str
)
def test_a_motion_played_back_returns_to_rounding(integrator, factor, dtype, backend, margin):
    """In double precision, Runge-Kutta to 1e-9 of its order, and Verlet to that of its iterations."""
    scene = Scene(ARM, (effects.Gravity(),), integrator=integrator, dt=1e-3, backend=backend)
    with torch.no_grad():
        there = rolled(scene, swinging(dtype), 1000)
        back = rolled(scene, State(there.q, -there.qd), 1000)
    assert (there.q - swinging(dtype).q).abs().max() > 0.1
    allowed = 1e-9 if dtype == F64 else factor * 1000 * EPS[dtype]
    margin(largest([back.q, -back.qd], swinging()[:2]), allowed, f"{called(integrator)}, {dtype}")


# --- T5, T6, T7: adaptive steps --------------------------------------------------------------------------------------


def oscillation(rtol, atol, dtype, T=1.0):
    """End of x'' = -x by tolerances."""
    scene = Scene(WHEEL, (effects.Spring(INERTIA),), integrator=DormandPrince(rtol, atol), dt=T)
    return scene.step(State(torch.ones(1, dtype=dtype), torch.zeros(1, dtype=dtype)))


@pytest.mark.case("T5")
@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
def test_a_tolerance_below_rounding_is_that_of_rounding(dtype, margin):
    least = 1e-300 if dtype == F64 else 1e-38
    end, at_rounding = (oscillation(rtol, least, dtype) for rtol in (1e-30, 100 * EPS[dtype]))
    assert torch.equal(end.q, at_rounding.q) and torch.equal(end.qd, at_rounding.qd)
    margin(largest(end[:2], double(math.cos(1.0), -math.sin(1.0))), 100 * EPS[dtype], f"{dtype}")


@pytest.mark.case("T5")
def test_a_tolerance_below_rounding_is_reported():
    with warned(UserWarning):
        oscillation(1e-12, 1e-30, F32, T=0.1)


@pytest.mark.case("T5", "T6")
@eager_first
@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
def test_samples_with_adaptive_steps_are_bitwise_what_they_are_alone(dtype, backend):
    """Together with a stiff one, a fast one, one that is NaN, and one that is infinite."""
    q, qd = random(2, 6, 2, seed=1, dtype=dtype)
    qd[2] *= 20
    q[3, 0], qd[4, 1] = math.nan, math.inf
    stiffness = torch.full((6, 2), 10.0, dtype=dtype)
    stiffness[1] = 1e5
    parts = (effects.Gravity(), effects.Spring(stiffness))

    def end(rows):
        made = (parts[0], effects.Spring(stiffness[rows]))
        scene = Scene(ARM, made, integrator=DormandPrince(1e-4, 1e-6), dt=0.02, backend=backend)
        with torch.no_grad():
            return scene.step(State(q[rows], qd[rows]))

    together = end(slice(0, 6))
    for i in thinned(range(6), (0, 1, 3)):
        for a, b in zip(end(slice(i, i + 1))[:2], together[:2], strict=True):
            assert torch.equal(a[0].nan_to_num(99.0), b[i].nan_to_num(99.0))
    assert together.q[[0, 1, 2, 5]].isfinite().all()
    assert together.q[[3, 4]].isnan().all()


WEIGHTS = double(1.0, -2.0, 0.5, 0.3)


def flowed(rtol, backend):
    """Weighted end of an adaptive step as a function of position, velocity and damping [..., 6]."""

    def end(x):
        parts = (effects.Gravity(), effects.Viscous(x[..., 4:]))
        scene = Scene(ARM, parts, integrator=DormandPrince(rtol, 1e-2 * rtol), dt=0.2, backend=backend)
        after = scene.step(State(x[..., :2], x[..., 2:4]))
        return torch.cat(after[:2], -1) @ WEIGHTS.to(x.dtype)

    return end


POINT = double(0.3, -0.4, 0.8, -0.5, 0.3, 0.5)


def differences(f, x, h):
    """Derivatives [n, ...] of a function of rows by central differences of sixth order, all rows at once."""
    places = torch.tensor([-3, -2, -1, 1, 2, 3], dtype=F64)
    weights = torch.tensor([-1, 9, -45, 45, -9, 1], dtype=F64) / 60
    steps = places[:, None, None] * torch.diag(torch.as_tensor(h, dtype=F64).expand(len(x)))
    y = f((x + steps).flatten(0, 1)).unflatten(0, (6, len(x)))
    return torch.einsum("k,ki...->i...", weights, y) / torch.as_tensor(h, dtype=F64).expand(len(x)).view(
        -1, *[1] * (y.ndim - 2)
    )


@cache
def slope_of_the_flow():
    with torch.no_grad():
        return differences(flowed(1e-12, "auto"), POINT, 0.01)


def gradient_of(end, x):
    x = x.detach().clone().requires_grad_()
    return torch.autograd.grad(end(x).sum(), x)[0]


@pytest.mark.case("T7")
@compiled
@pytest.mark.parametrize(
    "rtol, dtype, allowed",
    thinned(
        [(1e-10, F64, 1e-9), (1e-2, F64, 1e-2), (1e-4, F64, 1e-4), (1e-4, F32, 1e-4)],
        [(1e-10, F64, 1e-9), (1e-4, F32, 1e-4)],
    ),
    ids=str,
)
def test_gradients_through_adaptive_steps_are_finite_differences_up_to_the_tolerance(
    rtol, dtype, allowed, backend, margin
):
    gradient = slope_of_the_flow()
    found = gradient_of(flowed(rtol, backend), POINT.to(dtype))
    margin((found - gradient).abs().max() / gradient.abs().max(), allowed, f"gradient at a tolerance of {rtol:g}")


@exhaustive
@pytest.mark.case("T7")
@compiled
def test_second_derivatives_through_adaptive_steps_are_finite_differences(backend, margin):
    hessian = differences(lambda y: gradient_of(flowed(1e-12, backend), y), POINT, 0.01)
    x = POINT.clone().requires_grad_()
    (slope,) = torch.autograd.grad(flowed(1e-10, backend)(x), x, create_graph=True)
    found = torch.stack([torch.autograd.grad(y, x, retain_graph=True)[0] for y in slope])
    margin((found - found.mT).abs().max() / found.abs().max(), 16 * EPS[F64], "symmetry of the Hessian")
    margin((found - hessian).abs().max() / hessian.abs().max(), 10 * 1e-10, "Hessian at a tolerance of 1e-10")


# --- T8: long gradients ----------------------------------------------------------------------------------------------


def after_a_thousand(integrator, backend):
    """End of a rollout of a damped arm that is driven, as a function of state, damping and torque [..., 8]."""

    def end(x):
        parts = (effects.Gravity(), effects.Viscous(x[..., 4:6]), effects.Coulomb(0.3, 0.1))
        scene = Scene(ARM, parts, integrator=integrator, dt=2e-3, backend=backend)
        after = rolled(scene, State(x[..., :2], x[..., 2:4]), 1000, x[..., 6:])
        return torch.cat(after[:2], -1) @ WEIGHTS.to(x.dtype)

    return end


DRIVEN = double(0.3, -0.4, 0.8, -0.5, 4.0, 2.0, 1.0, -0.5)


@pytest.mark.case("T8")
@compiled
@pytest.mark.parametrize("integrator", thinned(FIXED[1:], (LinearlyImplicit(),)), ids=called)
def test_gradients_through_a_thousand_steps_are_finite_differences(integrator, backend, margin):
    """In single precision to its rounding."""
    end = after_a_thousand(integrator, backend)
    found = gradient_of(end, DRIVEN)
    with torch.no_grad():
        expected = differences(end, DRIVEN, 1e-3)
    margin((found - expected).abs().max() / found.abs().max(), 1e-10, called(integrator))
    if EVERYTHING or integrator == LinearlyImplicit():
        single = gradient_of(end, DRIVEN.float())
        margin((single - found).abs().max() / found.abs().max(), 4 * EPS[F32] * 1000**0.5, f"{called(integrator)}, F32")


@pytest.mark.case("T8")
@compiled
@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
def test_gradients_without_damping_grow_but_stay_numbers(dtype, backend):
    """The pendulum thrown over, where a thousand steps of 10 ms amplify a disturbance a millionfold."""
    scene = Scene(ARM, (effects.Gravity(),), integrator=RungeKutta4(), dt=1e-2, backend=backend)
    q = double(2.2, 2.5).to(dtype).requires_grad_()
    sizes = []
    for steps in (10, 100, 1000):
        end = rolled(scene, State(q, torch.zeros_like(q)), steps)
        sizes.append(float(torch.autograd.grad(end.q.sum(), q)[0].norm()))
    assert all(map(math.isfinite, sizes))
    assert sizes[0] < sizes[1] < sizes[2]


# --- T9: stiff servos ------------------------------------------------------------------------------------------------

# w h beyond which a critically damped servo is unstable: 2 (sqrt 2 - 1), 2, and where |1 + z + ... + z^4/24| = 1
BOUNDS = {SemiImplicitEuler(): 2 * (math.sqrt(2) - 1), ExplicitEuler(): 2.0, RungeKutta4(): 2.785293563405282}


@pytest.mark.case("T9")
@compiled
@pytest.mark.parametrize(
    "integrator, dtype",
    thinned([*itertools.product(BOUNDS, (F64, F32))], [*zip(BOUNDS, (F64, F32, F64), strict=True)]),
    ids=lambda x: called(x) if isinstance(x, Integrator) else str(x),
)
def test_explicit_integrators_are_stable_up_to_their_bound_and_no_further(integrator, dtype, backend, margin):
    h, ratio = 2e-3, double(*np.linspace(0.9, 1.1, 41))[:, None]
    w = BOUNDS[integrator] * ratio / h
    scene = Scene(
        WHEEL, (effects.Servo(INERTIA * w**2, 2 * INERTIA * w),), integrator=integrator, dt=h, backend=backend
    )
    with torch.no_grad():
        start = State(torch.ones(41, 1, dtype=dtype), torch.zeros(41, 1, dtype=dtype))
        q = trace(scene, start, 3000, target=torch.zeros(1, dtype=dtype)).q[-1]
    bounded = (q.abs() < 1.0)[:, 0]
    assert (~bounded[1:] | bounded[:-1]).all()  # all that are stable lie below all that are not
    edge = float(ratio[bounded].max())
    margin(abs(edge - 1.0), 0.01, called(integrator))


@pytest.mark.case("T9")
@single_compiled
def test_implicit_servos_of_any_gain_arrive_without_overshoot(dtype, backend, margin):
    """Critically damped, w h from 0.1 to 1e5 (200 Hz at 2 ms is 2.5); 5 % would be allowed."""
    h = 2e-3
    w = torch.cat([torch.logspace(-1, 5, 25, dtype=F64), double(2 * math.pi * 200 * h)])[:, None] / h
    scene = Scene(
        WHEEL, (effects.Servo(INERTIA * w**2, 2 * INERTIA * w),), integrator=LinearlyImplicit(), dt=h, backend=backend
    )
    start = State(torch.zeros(26, 1, dtype=dtype), torch.zeros(26, 1, dtype=dtype))
    with torch.no_grad():
        q = trace(scene, start, 400, target=torch.ones(1, dtype=dtype)).q
    margin(max(float(q.max()) - 1.0, 0.0), 0.05, "overshoot")
    margin((q[-1] - 1.0).abs().max(), 16 * EPS[dtype], "what is left after 400 steps")


@pytest.mark.case("T9")
@pytest.mark.parametrize("dtype", thinned([F64, F32], [F64]), ids=str)
def test_a_servo_of_200_hertz_at_2_milliseconds_rests_where_the_torques_of_an_arm_balance(dtype, margin):
    """Without overshoot, although the step is a fortieth of a period."""
    w = 2 * math.pi * 200
    kp, kd = (w**2 * double(1.0, 0.3)).tolist(), (2 * w * double(1.0, 0.3)).tolist()
    parts, target = (effects.Gravity(), effects.Servo(kp, kd)), double(0.7, -0.4).to(dtype)
    start = State(torch.zeros(2, dtype=dtype), torch.zeros(2, dtype=dtype))
    scene = Scene(ARM, parts, integrator=LinearlyImplicit(), dt=2e-3)
    with torch.no_grad():
        q = trace(scene, start, 100, target=target).q
    margin(max(float(((q - target) * target.sign()).max() / 0.7), 0.0), 0.05, "overshoot")
    end = q[-1].double()
    off = torchdq.inverse_dynamics(ARM, end) - double(*kp) * (target.double() - end)
    margin((off / double(*kp)).abs().max() / 0.7, 64 * EPS[dtype], "end")


# --- T10: dry friction -----------------------------------------------------------------------------------------------


def creeping(level, tau, width):
    """Speed at which friction of that level holds a torque below it."""
    return width * tau / (level**2 - tau**2) ** 0.5


@pytest.mark.case("T10")
@of_backends_and_dtypes(("eager", F64))
def test_creep_is_that_of_the_width_and_so_are_its_derivatives(dtype, backend, margin):
    """Speed, and its first and second derivatives in torque, level and width, when it has settled."""
    # the nearer the level, the longer it takes to settle
    shares, steps = ((0.1, 0.5, 0.9, 0.99), 1500) if EVERYTHING else ((0.1, 0.5, 0.9), 250)
    tau, level = (x.to(dtype) for x in (double(*shares)[:, None, None], double(1.0)))
    width = double(1e-2, 1e-4, 1e-6)[:, None].to(dtype)
    x = [v.expand(len(shares), 3, 1).clone().requires_grad_() for v in (tau, level, width)]
    # the width is a number per sample, without an axis for the joints
    parts = (effects.Coulomb(x[1], x[2][..., 0]),)
    scene = Scene(WHEEL, parts, integrator=LinearlyImplicit(), dt=0.01, backend=backend)
    state = State(torch.zeros_like(x[0]), torch.zeros_like(x[0]))
    for _ in range(steps):
        state = scene.step(state, x[0])
    slopes = torch.autograd.grad(state.qd.sum(), x, create_graph=True)
    curves = torch.autograd.grad(slopes[0].sum(), x)
    y = [v.detach().double().requires_grad_() for v in x]
    exact = creeping(y[1], y[0], y[2])
    exact_slopes = torch.autograd.grad(exact.sum(), y, create_graph=True)
    exact_curves = torch.autograd.grad(exact_slopes[0].sum(), y)
    # near the level the speed is ill-conditioned in the torque: 1 / (1 - share^2), squared for the curvature
    c = 1 / (1 - y[0].detach() ** 2)
    for what, found, expected, condition in (
        ("speed", [state.qd], [exact], c),
        ("gradient", slopes, exact_slopes, c**2),
        ("curvature", curves, exact_curves, c**3),
    ):
        off = max(
            float(((a.detach() - b.detach()) / (condition * b.detach().abs())).abs().max())
            for a, b in zip(found, expected, strict=True)
        )
        margin(off, 64 * EPS[dtype], f"{what} of creep, {dtype}")


def slowed(v, tau, level, width, h=0.01):
    """Velocity after a linearly implicit step of the wheel."""
    damping = level / (v * v + width * width) ** 0.5
    return v + h * (tau - damping * v) / (INERTIA + h * damping)


@pytest.mark.case("T10")
@every_backend_and_dtype
@pytest.mark.parametrize("width", [1e-2, 1e-4, 1e-6])
def test_a_step_from_rest_has_the_derivatives_of_its_formula_however_steep(width, dtype, backend, margin):
    """Value, gradient and Hessian at v = 0, against mpmath's differences of the formula in 60 digits."""
    point = (0.0, 0.3, 1.0, width)
    with mpmath.workdps(60):
        point = [mpmath.mpf(float(torch.tensor(x, dtype=dtype))) for x in point]
        value = slowed(*point)
        orders = np.eye(4, dtype=int)
        gradient = [float(mpmath.diff(slowed, point, tuple(e), h=mpmath.mpf(10) ** -25)) for e in orders]
        hessian = [
            [float(mpmath.diff(slowed, point, tuple(a + b), h=mpmath.mpf(10) ** -25)) for a in orders] for b in orders
        ]
    x = torch.tensor([float(v) for v in point], dtype=dtype).requires_grad_()
    parts = (effects.Coulomb(x[2:3], x[3]),)
    scene = Scene(WHEEL, parts, integrator=LinearlyImplicit(), dt=0.01, backend=backend)
    found = scene.step(State(torch.zeros(1, dtype=dtype), x[0:1]), x[1:2]).qd[0]
    (slope,) = torch.autograd.grad(found, x, create_graph=True)
    curve = torch.stack([torch.autograd.grad(y, x, retain_graph=True)[0] for y in slope])
    assert curve.isfinite().all()
    # entries of a row cancel against each other: they are as good as the largest in units of their variables
    unit = torch.tensor([width, 0.3, 1.0, width], dtype=F64)
    scale = abs(float(value))
    margin(abs(found.item() - float(value)) / scale, 16 * EPS[dtype], "value")
    for what, a, b, u in (("gradient", slope, gradient, unit), ("Hessian", curve, hessian, unit[:, None] * unit)):
        b = torch.tensor(b, dtype=F64)
        margin(((a.detach() - b) * u).abs().max() / (b * u).abs().max(), 16 * EPS[dtype], what)


@pytest.mark.case("T10")
@single_compiled
@pytest.mark.parametrize("width", [1e-2, 1e-4, 1e-6])
def test_friction_brings_a_joint_to_rest_without_chatter(width, dtype, backend):
    parts = (effects.Coulomb(1.0, torch.tensor(width)),)
    scene = Scene(WHEEL, parts, integrator=LinearlyImplicit(), dt=0.01, backend=backend)
    with torch.no_grad():
        qd = trace(scene, State(torch.zeros(1, dtype=dtype), torch.ones(1, dtype=dtype)), 150).qd[:, 0]
    assert (qd >= 0).all()
    assert (qd[1:] <= qd[:-1]).all()
    assert qd[-1] < 1e-6 * width


@pytest.mark.case("T10")
@compiled
@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
def test_an_arm_under_dry_friction_never_gains_energy(dtype, backend, margin):
    """From slow motion, in which a first-order step of rigid bodies alone gains next to nothing."""
    q, qd = random(2, 50, 2, seed=2, dtype=dtype)
    parts = (effects.Coulomb([0.5, 2.0], 1e-6),)
    scene = Scene(ARM, parts, integrator=LinearlyImplicit(), dt=1e-3, backend=backend)
    with torch.no_grad():
        energy = scene.energy(cast(trace(scene, State(q, 0.1 * qd), 300), F64))[..., 0]
    gain = ((energy[1:] - energy[:-1]) / energy[0]).max()
    margin(max(float(gain), 0.0), 4 * EPS[dtype], "gain in a step, of the energy at the beginning")
    assert (energy[-1] < 0.7 * energy[0]).all()


# --- T11: limits -----------------------------------------------------------------------------------------------------


@pytest.mark.case("T11")
@single_compiled
@pytest.mark.parametrize("dissipation", [0.0, 1.0])
@pytest.mark.parametrize("stiffness, h", thinned([(1e6, 1e-2), (1e7, 1e-3), (1e8, 1e-2)], [(1e7, 1e-3), (1e8, 1e-2)]))
def test_no_bounce_gains_speed_or_goes_deeper_than_a_step(stiffness, h, dissipation, dtype, backend, margin):
    """Restitution at most 1 + 1e-6, which the rounding of positions must not spoil in single precision either."""
    speed = torch.logspace(-3, 2, 60, dtype=F64)[:, None].to(dtype)
    parts = (effects.JointLimits(-math.inf, 0.1, double(stiffness), double(dissipation)),)
    scene = Scene(WHEEL, parts, integrator=LinearlyImplicit(), dt=h, backend=backend)
    with torch.no_grad():
        start = State(0.1 - 2.5 * h * speed, speed)
        q, qd = trace(scene, start, 60)[:2]
        explicit = rolled(scene.replace(integrator=SemiImplicitEuler()), start, 60)
    assert not (explicit.qd.abs() <= 1.5 * speed).all()  # as many a simulator does
    # the place of the limit is known to a rounding of the positions, which a step divides by its duration
    rounding = 8 * EPS[dtype] * (0.1 + 2.5 * h * speed.double()) / h / speed.double()
    beyond = (qd.double().abs() / speed.double() - rounding).max() - 1.0
    margin(max(float(beyond), 0.0), 1e-6, "restitution beyond 1")
    margin(((q.double() - 0.1) / (h * speed.double()) - rounding).max(), 1.0, "depth in steps")


@pytest.mark.case("T11")
def test_the_torque_of_a_limit_is_lipschitz_across_it(margin):
    """Continuous, with slope at most k (1 + c v) in the position and k c p in the velocity.

    Not C1 as the catalogue has it: a spring that is linear in the depth, which the implicit step needs, bends at the
    limit. The bend is the stiffness, however close one looks.
    """
    k, c, line = 1e4, 2.0, double(*np.linspace(-1, 1, 41))[:, None]
    scene = Scene(WHEEL, (effects.JointLimits(-1.0, 1.0, k, c),), integrator=ExplicitEuler(), dt=1.0)

    def rise(q, qd):
        """Largest change from a row to the next, but for rounding: torques are read off accelerations, next to qd."""
        tau = INERTIA * (scene.step(State(q, qd)).qd - qd)
        return (tau[1:] - tau[:-1]).abs().max() - 4 * EPS[F64] * (INERTIA * qd.abs().max() + tau.abs().max())

    for distance in (1e-3, 1e-6, 1e-9, 1e-12):
        q = 1.0 + distance * line
        for v in (1.5, -1.5):
            most = k * (1 + c * 1.5) * (q[1:] - q[:-1]).max()
            margin(rise(q, torch.full_like(q, v)) / most, 1.01, "slope in the position")
        margin(rise(torch.full_like(q, 1.0 + distance), 2 * line) / (k * c * distance * 0.1), 1.01, "in the velocity")


@pytest.mark.case("T11")
@eager_first
def test_gradients_through_a_bounce_are_finite_differences(backend, margin):
    """Of the state after it, in speed, stiffness and dissipation."""

    def end(x):
        parts = (effects.JointLimits(-10.0, 0.1, x[..., 1:2], x[..., 2:3]),)
        scene = Scene(WHEEL, parts, integrator=LinearlyImplicit(), dt=1e-3, backend=backend)
        state = rolled(scene, State(torch.zeros(1, dtype=F64), x[..., :1]), 150)
        return (state.q + state.qd)[..., 0]

    point = double(1.013, 3e2, 0.7)
    found = gradient_of(end, point)
    with torch.no_grad():
        expected = differences(end, point, [1e-5, 1e-3, 1e-5])
        assert end(point) < 0  # it came back
    unit = double(1.0, 3e2, 1.0)
    margin(((found - expected) * unit).abs().max() / (found * unit).abs().max(), 1e-8, "gradient")


@pytest.mark.case("T11")
@every_backend_and_dtype
@pytest.mark.parametrize("qd", [-1.0, 0.0, 1.0])
def test_derivatives_exactly_at_a_limit_are_finite(qd, dtype, backend):
    x = torch.tensor([1.0, qd, 1e4, 2.0], dtype=dtype).requires_grad_()
    parts = (effects.JointLimits(-1.0, 1.0, x[2:3], x[3:]),)
    scene = Scene(WHEEL, parts, integrator=LinearlyImplicit(), dt=1e-2, backend=backend)
    state = rolled(scene, State(x[:1], x[1:2]), 2)
    (slope,) = torch.autograd.grad(state.q[0] + state.qd[0], x, create_graph=True)
    curve = torch.stack([torch.autograd.grad(y, x, retain_graph=True)[0] for y in slope])
    assert state.q.isfinite().all() and slope.isfinite().all() and curve.isfinite().all()


# --- T12, T13, T14: a body that tumbles, states that are not finite, effects that are zero ---------------------------

# Three slides and three hinges without mass carry one body. Its middle axis is along z at zero, where it turns first;
# the middle hinge stays within 30 degrees, far from where hinges one and three align.
MASS, CENTRE, MOMENTS = 1.5, np.array([0.1, 0.2, -0.1]), np.diag([2.4, 1.0, 1.8])
TUMBLING = torchdq.Robot.from_screws(
    np.eye(6)[[3, 4, 5, 2, 0, 1]],
    [0.0] * 5 + [MASS],
    [[0.0] * 3] * 5 + [CENTRE],
    [np.zeros((3, 3))] * 5 + [MOMENTS],
    name="tumbling",
)
TUMBLING_START = State(double(0.1, 0.2, 0.3, 0.4, 0.01, 0.02), double(0.3, -0.2, 0.1, 5.0, 0.02, 0.03))


def conserved(states):
    """Energy, momentum, angular momentum about the origin, and rotation, from the body's pose and twist."""
    q, qd = states.q.double(), states.qd.double()
    X = dq.to_matrix(torchdq.forward_kinematics(TUMBLING, q, "link6")).numpy()
    twist = torchdq.jacobian(TUMBLING, q, "link6", "world").numpy() @ qd.numpy()[..., None]
    R, p, w, v = X[:, :3, :3], X[:, :3, 3], twist[:, :3, 0], twist[:, 3:, 0]
    arm = R @ CENTRE
    momentum = MASS * (v + np.cross(w, arm))
    spin = (R @ MOMENTS @ R.transpose(0, 2, 1) @ w[..., None])[..., 0]
    energy = 0.5 * (momentum**2).sum(-1) / MASS + 0.5 * (w * spin).sum(-1)
    return energy, momentum, np.cross(p + arm, momentum) + spin, R


@pytest.mark.case("T12")
@compiled
@pytest.mark.parametrize("dtype", thinned([F64, F32], [F64]), ids=str)
def test_a_tumbling_body_keeps_energy_and_momenta_and_turns_as_eulers_equations_say(dtype, backend, margin):
    """1e4 steps of 1 ms, to rounding; Euler's equations with a quaternion by DOP853 know nothing of hinges."""
    scene = Scene(TUMBLING, integrator=RungeKutta4(), dt=1e-3, backend=backend)
    with torch.no_grad():
        energy, momentum, angular, R = conserved(trace(scene, cast(TUMBLING_START, dtype), 10_000))
    along = R[:, :, 2] @ angular[0] / np.linalg.norm(angular[0])
    assert along.min() < -0.9 and along.max() > 0.9  # it flips
    for what, x in (("energy", energy[:, None]), ("momentum", momentum), ("angular momentum", angular)):
        off = np.abs(x - x[0]).max() / np.linalg.norm(x[0])
        margin(off, 4 * EPS[dtype] * 10_000, f"{what}, {dtype}")
        assert dtype == F32 or off < 1e-9
    inverse = np.linalg.inv(MOMENTS)
    spin = angular[0] - np.cross(TUMBLING_START.q[:3].numpy() + R[0] @ CENTRE, momentum[0])

    def rates(_, y):
        w = inverse @ y[4:]
        turn = pin.Quaternion(np.array(y[:4])) * pin.Quaternion(0.0, *w)
        return np.concatenate([0.5 * turn.coeffs(), np.cross(y[4:], w)])

    start = np.concatenate([pin.Quaternion(np.ascontiguousarray(R[0])).coeffs(), R[0].T @ spin])  # x y z w
    end = solve_ivp(rates, (0.0, 10.0), start, method="DOP853", rtol=1e-13, atol=1e-14).y[:4, -1]
    exact = pin.Quaternion(end / np.linalg.norm(end)).matrix()
    growth = 2e3  # of a disturbance between the flips: exp(2.2 1/s) over 3.5 s
    margin(np.abs(R[-1] - exact).max(), 4 * growth * EPS[dtype] * 100, f"rotation after 10 s, {dtype}")


SIMULATED = (effects.Gravity(), effects.Viscous(0.3), effects.Coulomb(0.2, 1e-3), effects.JointLimits(-2.0, 2.0))
DIVERGING = (LinearlyImplicit(), RungeKutta4(), DormandPrince(1e-4, 1e-6))
KEPT = [(DIVERGING[0], "c", F32)]


@pytest.mark.case("T13")
@pytest.mark.parametrize(
    "integrator, backend, dtype",
    [
        *([(LinearlyImplicit(), "eager", F64), (LinearlyImplicit(), "eager", F32)] if EVERYTHING else []),
        *(pytest.param(*x, marks=C.marks) for x in thinned([*itertools.product(DIVERGING, "c", (F64, F32))], KEPT)),
    ],
    ids=lambda x: called(x) if isinstance(x, Integrator) else str(x),
)
def test_a_row_that_diverges_takes_no_other_with_it_in_a_hundred_steps(integrator, backend, dtype):
    """One from the beginning, one that is infinite, one by a torque at step 50; and when is there to be seen."""
    steps = 8 if isinstance(integrator, DormandPrince) else 100
    scene = Scene(ARM, SIMULATED, integrator=integrator, dt=2e-3, backend=backend)
    q, qd = random(2, 7, 2, seed=1, dtype=dtype)
    torque = random(steps, 7, 2, seed=2, dtype=dtype)
    bad = State(q.clone(), qd.clone())
    bad.q[2], bad.qd[3, 1] = math.nan, math.inf
    spoiled = torque.clone()
    spoiled[steps // 2, 4, 0] = math.nan
    others = [0, 1, 5, 6]

    def end(state, torque):
        start = State(state.q.clone().requires_grad_(), state.qd.clone().requires_grad_())
        states = scene.rollout(start, torque)
        total = states.q[-1, others].square().sum() + states.qd[-1, others].sum()
        return states.q, states.qd, *torch.autograd.grad(total, start[:2])

    good, found = end(State(q, qd), torque), end(bad, spoiled)
    for a, b in zip(good[:2], found[:2], strict=True):
        assert torch.equal(a[:, others], b[:, others])
    for a, b in zip(good[2:], found[2:], strict=True):
        assert torch.equal(a[others], b[others])
    assert good[0].isfinite().all()
    nonfinite = ~found[1].isfinite().all(-1)
    assert nonfinite[:, [2, 3]].all()
    assert torch.equal(nonfinite[:, 4].nonzero()[:, 0], torch.arange(steps // 2, steps))


OFF = {kind: getattr(effects, kind) for kind in ("Viscous", "Coulomb", "Quadratic", "LoadDependent", "RotorInertia")}
OFF |= {
    "Stribeck": lambda zero: effects.Stribeck(zero, zero),
    "Directional": lambda zero: effects.Directional(zero, zero),
    "Ripple": lambda zero: effects.Ripple(0.1, zero, zero),
    "Spring": lambda zero: effects.Spring(zero, 0.3),
    "Limits": lambda zero: effects.JointLimits(-0.1, 0.1, zero),
    "Drag": lambda zero: effects.Drag(zero, zero, zero),
}


def stepped(parts, integrator, dtype, backend):
    scene = Scene(ARM, (effects.Gravity(), *parts), integrator=integrator, backend=backend)
    q, qd, torque = random(3, 5, 2, dtype=dtype)
    q, qd = q.requires_grad_(), qd.requires_grad_()
    state = scene.step(State(q, qd), torque)
    return torch.cat(state[:2], -1), *torch.autograd.grad((state.q + state.qd).sum(), [q, qd])


@pytest.mark.case("T14")
@pytest.mark.parametrize(
    "integrator, kinds, backend, dtype",
    [
        *((SemiImplicitEuler(), OFF, "eager", dtype) for dtype in thinned((F64, F32), (F64,))),
        *((LinearlyImplicit(), OFF, "eager", dtype) for dtype in thinned((F64, F32), (F32,))),
        *((RungeKutta4(), OFF, "eager", dtype) for dtype in thinned((F64, F32), ())),
        *(pytest.param(SemiImplicitEuler(), kinds, "c", F32, marks=C.marks) for kinds in thinned([["Coulomb"]], [])),
    ],
    ids=lambda x: called(x) if isinstance(x, Integrator) else "" if x is OFF else str(x),
)
def test_an_effect_whose_size_is_zero_is_none_but_for_rounding(integrator, kinds, backend, dtype, margin):
    """As a constant and as a tensor; sums may be taken in another order, in gradients most of all."""
    bare = stepped((), integrator, dtype, backend)
    size = max(float(x.detach().abs().max()) for x in bare)
    zeros = (("constant", 0.0), ("tensor", torch.zeros(2, dtype=F64)))
    for kind, (what, zero) in itertools.product(kinds, zeros):
        found = stepped((OFF[kind](zero),), integrator, dtype, backend)
        off = max(float((a - b).detach().abs().max()) for a, b in zip(bare, found, strict=True))
        margin(off / size, 4 * EPS[dtype], f"{kind}, {what}")
