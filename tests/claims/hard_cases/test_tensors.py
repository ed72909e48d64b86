"""Hard cases of tensors: empty, strided, transformed, traced, half, mixed, not finite, subnormal, copied, threaded.

Values and derivatives of every function, of a step of a scene, and of rows of forward dynamics that are computed in
double precision because single would lose them; operation by operation, and the first few compiled.
"""

import copy
import itertools
import pickle
from functools import partial

import helpers
import numpy as np
import pytest
import torch
from helpers import EVERYTHING, double, exhaustive, one_thread, random, thinned  # noqa: F401
from messages import refused
from oracles import EPS, random_tree
from precisions import F32, F64, C, every_backend, every_backend_and_dtype, every_dtype, single_compiled
from torch.func import hessian, jacfwd, jacrev, vmap

import torchdq
from torchdq import Scene, effects
from torchdq.envs import RobotVectorEnv
from torchdq.envs.render import Skeleton
from torchdq.errors import ArgumentError
from torchdq.scene import State
from torchdq.scene.defaults import default_effects
from torchdq.scene.integrators import LinearlyImplicit

fresh, threads = helpers.fresh, helpers.threads
ARM = torchdq.robots.load("two_link")
TREE = random_tree(3, seed=6, armature=True).robot  # joints of all kinds
ROCK = torchdq.Robot.from_urdf("<robot name='rock'><link name='tip'/></robot>")
STONE = torchdq.Robot.from_urdf(
    "<robot name='stone'><link name='stone'><inertial><mass value='1'/>"
    "<inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial></link></robot>",
    base="floating",
)


def tipped(mass):
    """Two links of a metre, the second a point of that mass at its end."""
    return torchdq.Robot.from_screws(
        [[0, 0, 1.0, 0, 0, 0], [0, 0, 1.0, 0, -1.0, 0]],
        [1.0, mass],
        [[0.5, 0, 0], [2.0, 0, 0]],
        [np.diag([0.1] * 3), np.zeros((3, 3))],
        name="tipped",
    )


# where a heavy tip is straight ahead, joint 1 feels next to nothing of it: the first and the third row are ordinary,
# the second, fourth and fifth are beyond single precision, the fifth even divides by zero in it
BENT = double(1.5, 0.01, -1.2, 1e-4, 0.0)

FUNCTIONS = {
    "inverse_dynamics": torchdq.inverse_dynamics,
    "forward_dynamics": torchdq.forward_dynamics,
    "closed_form": lambda r, q, qd, x: flat(torchdq.closed_form(r, q, qd)[:3], q),
    "step": lambda r, q, qd, x: step(r, q, qd, x),
    "mass_matrix": lambda r, q, qd, x: torchdq.mass_matrix(r, q),
    "forward_kinematics": lambda r, q, qd, x: torchdq.forward_kinematics(r, q).flatten(-2),
    "jacobian": lambda r, q, qd, x: torchdq.jacobian(r, q, "tip").flatten(-2),
    "regressor": lambda r, q, qd, x: torchdq.regressor(r, q, qd, x).flatten(-2),
    "kinetic_energy": lambda r, q, qd, x: torchdq.kinetic_energy(r, q, qd),
    "potential_energy": lambda r, q, qd, x: torchdq.potential_energy(r, q),
    "error_growth": lambda r, q, qd, x: torchdq.error_growth(r, q),
    "dynamics_jacobian": lambda r, q, qd, x: flat(torchdq.dynamics_jacobian(r, q, qd, x), q),
    "computed_torque": lambda r, q, qd, x: torchdq.computed_torque(r, q, qd, x, qd, x, 9.0, 6.0, wrench(q, qd, x)),
    "wrenches": lambda r, q, qd, x: pushed(r, q, qd, x),
}
SOME = list(FUNCTIONS)[:4]  # of which the rest are parts
every_function = pytest.mark.parametrize(
    ("keys", "backend"),
    [
        pytest.param(FUNCTIONS, "eager", id="eager"),
        *([pytest.param(SOME, "c", marks=C.marks, id="c")] if EVERYTHING else []),
    ],
)
every_function_and_dtype = pytest.mark.parametrize(
    ("keys", "backend", "dtype"),
    [
        (FUNCTIONS, "eager", F64),
        (FUNCTIONS if EVERYTHING else SOME, "eager", F32),
        *(pytest.param(SOME if EVERYTHING else SOME[:2], "c", x, marks=C.marks) for x in thinned((F64, F32), (F32,))),
    ],
    ids=lambda x: "" if isinstance(x, (list, dict)) else str(x),
)


def flat(results, q):
    """Rows of vectors and matrices."""
    return torch.cat([y.flatten(-2) if y.ndim > q.ndim else y for y in results], -1)


def wrench(*x):
    """Six of the numbers."""
    return torch.cat(x, -1)[..., :6]


def pushed(robot, q, qd, x):
    """Torques under wrenches on the tip and on every link."""
    return torchdq.inverse_dynamics(robot, q, qd, x, wrench(x, q, qd), torch.stack([wrench(q, x, qd)] * robot.n, -2))


PARTS = (effects.Gravity(), effects.Viscous(0.1), effects.Coulomb(0.1))
SCENES = {robot.name: Scene(robot, PARTS, integrator=LinearlyImplicit()) for robot in (ARM, TREE)}


def step(robot, q, qd, torque):
    return torch.cat(SCENES[robot.name].step(State(q, qd), torque)[:2], -1)


def states(n, *batch, dtype=F64):
    """Positions, velocities, and torques or accelerations."""
    return [random(*batch, n, seed=k, dtype=dtype) for k in range(3)]


def slopes(f, x):
    """Results, gradients of their sum, and gradients of the sum of those."""
    x = [v.detach().clone().requires_grad_() for v in x]
    y = f(*x)
    g = torch.autograd.grad(y.sum(), x, create_graph=True, allow_unused=True, materialize_grads=True)
    total = sum(v.sum() for v in g)
    h = torch.autograd.grad(total, x, allow_unused=True, materialize_grads=True) if total.requires_grad else ()
    return [v.detach() for v in (y, *g, *h)]


def same(a, b):
    """Equal to the bit, places of NaN included."""
    return all(
        x.dtype == y.dtype and torch.equal(x.nan_to_num(7.0), y.nan_to_num(7.0)) and torch.equal(x.isnan(), y.isnan())
        for x, y in zip(a, b, strict=True)
    )


def distance(found, expected):
    """Largest difference, relative to the largest entry of each tensor; NaN if there is one."""
    ratios = [
        float((a.double() - b.double()).abs().max() / b.double().abs().max().clamp_min(1e-30))
        for a, b in zip(found, expected, strict=True)
        if a.numel()
    ]
    return float(np.max(ratios))


# --- P1: nothing -----------------------------------------------------------------------------------------------------


@pytest.mark.case("P1")
@every_function_and_dtype
def test_nothing_has_the_shapes_and_derivatives_of_nothing(keys, backend, dtype):
    """Empty batches, and a robot without joints."""
    with torchdq.backend(backend):
        for key, batch in itertools.product(keys, ((0,), (3, 0), (0, 2))):
            one = FUNCTIONS[key](ARM, *states(2, dtype=dtype))
            found = slopes(partial(FUNCTIONS[key], ARM), states(2, *batch, dtype=dtype))
            assert found[0].shape == (*batch, *one.shape) and found[0].dtype == dtype, key
            assert all(g.shape == (*batch, 2) for g in found[1:]), key


@pytest.mark.case("P1")
@every_backend
def test_a_scene_of_a_free_body_without_joints_takes_steps(backend):
    scene = Scene(STONE, default_effects(STONE), backend=backend)
    state = scene.rollout(scene.start(torch.zeros(4, 0)), steps=3)
    assert state.q.shape == state.qd.shape == (3, 4, 0) and bool((state.V_WB_B[-1, :, 5] < -0.2).all())
    assert scene.describe(seconds=0).left_out == ()


@pytest.mark.case("P1")
def test_nothing_that_moves_is_no_scene_no_environment_and_no_picture():
    for make in (lambda: Scene(ROCK), lambda: RobotVectorEnv(2, "track", ROCK)):
        with refused(ArgumentError):
            make()
    with refused(ArgumentError):
        Skeleton(ROCK)


# --- P2: layouts -----------------------------------------------------------------------------------------------------

LAYOUTS = {
    "transposed": lambda x: x.mT.contiguous().mT,
    "strided": lambda x: torch.stack([x, torch.full_like(x, torch.nan)], -1)[..., 0],
    "every second row": lambda x: torch.stack([x, torch.full_like(x, torch.nan)], 1).flatten(0, 1)[::2],
    "expanded": lambda x: x[:1].expand_as(x),
    "backwards": lambda x: x.flip(0).contiguous().flip(0),
    "beside its alignment": lambda x: torch.cat([x.new_zeros(1), x.flatten()])[1:].view(x.shape),
}


@pytest.mark.case("P2")
@every_backend
def test_how_inputs_lie_in_memory_changes_no_bit_of_values_and_derivatives(backend):
    keys = thinned(("inverse_dynamics", "forward_dynamics", "wrenches", "step"), ("wrenches", "step"))
    for key, layout, dtype in itertools.product(keys, LAYOUTS, (F64, F32)):
        x = [LAYOUTS[layout](v) for v in states(2, 9, dtype=dtype)]
        plain = [v.clone(memory_format=torch.contiguous_format) for v in x]
        with torchdq.backend(backend):
            y, z = FUNCTIONS[key](ARM, *x), FUNCTIONS[key](ARM, *plain)
            assert same([y], [z]), (key, layout, dtype)
            found = []
            for args in (x, plain):
                leaves = [v.detach().requires_grad_() for v in args]  # which lie as they did
                made = FUNCTIONS[key](ARM, *leaves)
                found.append(torch.autograd.grad(made.sum(), leaves, allow_unused=True, materialize_grads=True))
            assert same(*found), (key, layout, dtype)


@pytest.mark.case("P2")
@every_backend_and_dtype
@pytest.mark.parametrize("key", thinned(["inverse_dynamics", "forward_dynamics", "step"], ["forward_dynamics", "step"]))
def test_inputs_of_different_batches_broadcast_and_so_do_their_derivatives(key, dtype, backend, margin):
    """q [5, 1, n], qd [n], x [4, n] are [5, 4, n] each; a gradient is the sum over what was broadcast."""
    q, qd, x = (random(*shape, seed=k, dtype=dtype) for k, shape in enumerate([(5, 1, 2), (2,), (4, 2)]))
    full = [v.expand(5, 4, 2).contiguous() for v in (q, qd, x)]
    with torchdq.backend(backend):
        found, whole = (slopes(lambda *v: FUNCTIONS[key](ARM, *v), args)[:4] for args in ((q, qd, x), full))
    assert same(found[:1], whole[:1])
    sums = [whole[1].sum(1, keepdim=True), whole[2].sum((0, 1)), whole[3].sum(0)]
    margin(distance(found[1:], sums), 64 * EPS[dtype], f"{key}, {dtype}")


# --- P3, P4: transforms and torch.compile ----------------------------------------------------------------------------


def loop(f, args):
    """Jacobians and Hessians of every row, by plain backward passes."""
    rows = []
    for row in zip(*args, strict=True):
        x = [v.detach().clone().requires_grad_() for v in row]
        y = f(*x)
        first = [torch.autograd.grad(v, x, create_graph=True) for v in y]
        second = torch.stack(
            [
                torch.stack([torch.autograd.grad(v, x[0], retain_graph=True)[0] for v in g[0]])
                if g[0].requires_grad
                else torch.zeros(2, 2, dtype=y.dtype)
                for g in first
            ]
        )
        rows.append([torch.stack([g[k] for g in first]).detach() for k in range(3)] + [second])
    return [torch.stack(column) for column in zip(*rows, strict=True)]


THREE = ("inverse_dynamics", "forward_dynamics", "step")


@pytest.mark.case("P3")
@pytest.mark.parametrize(
    "key, backend, dtype",
    [
        *((key, "eager", dtype) for key in THREE for dtype in thinned((F64, F32), (F64,))),
        *(pytest.param(key, "c", F32, marks=C.marks) for key in thinned(THREE, ("forward_dynamics",))),
    ],
    ids=str,
)
def test_transforms_are_loops_over_backward_passes(key, dtype, backend, margin):
    x = states(2, 4, dtype=dtype)

    def f(*x):
        return FUNCTIONS[key](ARM, *x)

    with torchdq.backend(backend):
        expected = loop(f, x)
        for what, transform in (("jacrev", jacrev), ("jacfwd", jacfwd)):
            found = vmap(transform(f, argnums=(0, 1, 2)))(*x)
            margin(distance(found, expected[:3]), 64 * EPS[dtype], f"vmap of {what}, {key}, {dtype}")
        margin(distance([vmap(hessian(f))(*x)], expected[3:]), 64 * EPS[dtype], f"vmap of hessian, {key}, {dtype}")


def accelerations(robot):
    """Forward dynamics of rows (q2, qd, tau) [..., 5]."""
    return lambda x: torchdq.forward_dynamics(
        robot, torch.cat([x[..., :1] * 0, x[..., :1]], -1), x[..., 1:3], x[..., 3:]
    )


def endangered(dtype):
    return torch.cat([BENT[:, None], random(5, 4)], -1).to(dtype)


@pytest.mark.case("P4")
@pytest.mark.parametrize("backend", [C])
@pytest.mark.parametrize(
    "key, dtype, unknown",
    thinned(
        [*itertools.product(("forward_dynamics", "step"), (F64, F32), (False, True))],
        (("forward_dynamics", F32, True),),
    ),
    ids=str,
)
def test_a_traced_graph_of_any_batch_has_the_same_values_and_gradients(key, dtype, unknown, backend, margin, fresh):
    """Traced as torch.compile does, without what it makes of the graph, which is not our claim."""

    def f(*x):
        return FUNCTIONS[key](ARM, *x)

    traced = torch.compile(f, fullgraph=True, backend="aot_eager", dynamic=unknown or None)
    with torchdq.backend(backend):
        for batch in (3, 8) if unknown else (3, 8, 1, 21):
            q, qd, x = states(2, batch, dtype=dtype)
            found = []
            for function in (traced, f):
                leaves = [v.clone().requires_grad_() for v in (q, qd, x[0] if unknown else x)]
                y = function(*leaves)
                found.append([y.detach(), *torch.autograd.grad(y.square().sum(), leaves)])
            margin(distance(*found), 64 * EPS[dtype], f"{key}, {dtype}")


# --- P5, P7: what is not a number in single or double precision ---------------------------------------------


@pytest.mark.case("P5")
@every_function
def test_under_autocast_values_and_derivatives_are_the_same_bits(keys, backend):
    x = states(2, 4, dtype=F32)
    with torchdq.backend(backend):
        for key in keys:
            expected = slopes(partial(FUNCTIONS[key], ARM), x)
            for half in (torch.bfloat16, torch.float16):
                with torch.autocast("cpu", dtype=half):
                    assert same(slopes(partial(FUNCTIONS[key], ARM), x), expected), key


@pytest.mark.case("P7")
def test_integers_of_a_description_are_the_numbers_that_they_are():
    """A robot of integers is that of floating numbers; what is computed from them is not rounded."""
    arguments = ([[0, 0, 1, 0, 0, 0], [0, 0, 1, 0, -1, 0]], [1, 2], [[1, 0, 0], [2, 0, 0]], [np.diag([1, 1, 1])] * 2)
    whole = torchdq.Robot.from_screws(*arguments, gravity=(0, -10, 0))
    real = torchdq.Robot.from_screws(*(np.array(x, dtype=float) for x in arguments), gravity=(0.0, -10.0, 0.0))
    x = states(2, 5)
    assert same([torchdq.inverse_dynamics(whole, *x)], [torchdq.inverse_dynamics(real, *x)])
    assert same([whole.mass, whole.com, whole.inertia], [real.mass, real.com, real.inertia])
    parts = [(effects.Viscous(k), effects.Gravity((0, 0, -10))) for k in (1, 1.0)]
    assert same(*([Scene(ARM, p).step(State(*x[:2])).q] for p in parts))


# --- P9, P10: rows that are not finite, and subnormal numbers --------------------------------------------------------


@pytest.mark.case("P9")
@every_function_and_dtype
def test_a_bad_row_changes_no_bit_of_another_to_the_second_derivative(keys, backend, dtype):
    """Not a number, infinite, and so large that squares overflow, in every argument, one after the other."""
    x, good = states(2, 21, dtype=dtype), [k for k in range(21) if k not in (0, 9, 20)]
    with torchdq.backend(backend):
        for key in keys:
            before = slopes(partial(FUNCTIONS[key], ARM), x)
            for bad in (torch.nan, -torch.inf, 1e30):
                spoiled = [v.clone() for v in x]
                for v in spoiled:
                    v[[0, 9, 20]] = bad
                after = slopes(partial(FUNCTIONS[key], ARM), spoiled)
                assert same([v[good] for v in after], [v[good] for v in before]), (key, bad)
                assert not after[0][[0, 9, 20]].isfinite().all() or bad == 1e30 or key == "forward_kinematics"


@pytest.mark.case("P9")
@single_compiled
def test_a_singular_row_is_not_a_number_and_changes_no_bit_of_another(dtype, backend):
    """A tip so heavy that at full stretch joint 1 feels nothing of it, in double precision either."""
    robot, x = tipped(1e15), endangered(dtype)
    with torchdq.backend(backend):
        found = slopes(accelerations(robot), [x])
        alone = [slopes(accelerations(robot), [x[k : k + 1]]) for k in range(5)]
    singular = torchdq.error_growth(robot, torch.stack([0 * BENT, BENT], -1)) > 2.0**46
    assert singular.tolist() == [False, False, False, False, True]
    assert found[0][singular].isnan().all() and found[1][singular].isnan().all()
    assert all(v[~singular].isfinite().all() for v in found)
    assert same(found, [torch.cat(rows) for rows in zip(*alone, strict=True)])


@pytest.mark.case("P10")
@every_function_and_dtype
def test_flushing_subnormal_numbers_changes_nothing_that_counts(keys, backend, dtype, margin):
    tiny = 1e-40 if dtype == F32 else 1e-310
    x = states(2, 5, dtype=dtype)
    for k, v in enumerate(x):
        v[k] = tiny
        v[3, k % 2] = -tiny
    x[0][4], x[1][4] = tiny, tiny
    # What is flushed is as small as it was, but for friction, which is steep at rest. A sum may still round to its
    # other neighbour, as sums of poses do.
    allowed = {"step": 1e6 * tiny, "forward_kinematics": 4 * EPS[dtype]}
    for key in keys:
        with torchdq.backend(backend):
            kept = slopes(partial(FUNCTIONS[key], ARM), x)
            try:
                assert torch.set_flush_denormal(True)
                flushed = slopes(partial(FUNCTIONS[key], ARM), x)
            finally:
                torch.set_flush_denormal(False)
        assert all(v.isfinite().all() for v in kept)
        margin(distance(flushed, kept), allowed.get(key, 100 * tiny), f"{key}, {dtype}")


# --- P11: at home ----------------------------------------------------------------------------------------------------


@pytest.mark.case("P11")
@every_function
def test_at_home_derivatives_are_finite_and_in_both_precisions_alike(keys, backend, margin):
    """Zero positions, velocities and torques; operation by operation of a tree with joints of all kinds."""
    found, robot = {}, TREE if backend == "eager" else ARM
    for key in keys:
        with torchdq.backend(backend):
            for dtype in (F64, F32):
                home = [torch.zeros(2, robot.n, dtype=dtype)] * 3
                found[dtype] = slopes(partial(FUNCTIONS[key], robot), home)
                assert all(v.isfinite().all() for v in found[dtype]), key
        scale = max(float(v.abs().max()) for v in found[F64])
        gap = max(float((a - b).abs().max()) for a, b in zip(found[F32], found[F64], strict=True))
        margin(gap / scale, 64 * EPS[F32], key)


@pytest.mark.case("P11")
@pytest.mark.parametrize("backend", ["eager"])
@pytest.mark.parametrize("key", thinned(THREE, ("step",)))
def test_at_home_second_derivatives_are_differences_and_third_are_finite(key, backend, margin):
    def f(x):
        # dry friction is steep at rest; its differences need steps far below its width of 1e-2
        return FUNCTIONS[key](TREE, *x.unflatten(-1, (3, 3)).unbind(-2))

    home, h = torch.zeros(9, dtype=F64), 1e-4
    with torchdq.backend(backend):
        found = jacfwd(jacrev(f))(home)
        rows = torch.diag(home + h)
        slope = vmap(jacrev(f))
        expected = ((8 * (slope(rows) - slope(-rows)) - slope(2 * rows) + slope(-2 * rows)) / (12 * h)).movedim(0, -1)
        margin((found - expected).abs().max() / found.abs().max(), 1e-7, key)
        assert jacrev(jacfwd(jacrev(f)))(home).isfinite().all()


# --- P12: copies -----------------------------------------------------------------------------------------------------

COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda x: pickle.loads(pickle.dumps(x))}


@pytest.mark.case("P12")
@every_backend
@pytest.mark.parametrize("how", COPIES)
def test_copies_of_robots_modules_and_scenes_compute_the_same_bits(how, backend):
    """Replaced and learned tensors, rotors and dtypes included; and a scene's goes on with the same programs."""
    x = states(3, 4)
    robot = TREE.replace(mass=TREE.mass * (1 + random(4, 1).abs()))
    module = torchdq.ForwardDynamics(TREE, learn=("mass", "inertia"), backend=backend).float()
    control = torchdq.ComputedTorque(TREE, double(9.0, 8.0, 7.0), 6.0, learn=("kp",), backend=backend)
    scene = Scene(TREE, (effects.Gravity(), effects.Viscous(random(4, 3).abs())), backend=backend)
    twin, module2, control2, scene2 = COPIES[how]((robot, module, control, scene))
    with torchdq.backend(backend):
        assert same(*([torchdq.inverse_dynamics(r, *x)] for r in (robot, twin)))
    assert same(*([m(*x)] for m in (module, module2)))
    assert same(*([m(*x, *x[1:])] for m in (control, control2)))
    assert same(*(s.step(State(*x[:2]), x[2])[:2] for s in (scene, scene2)))
    assert scene2.spec.robot is not None and {p.dtype for p in module2.parameters()} == {F32}


@pytest.mark.case("P12")
@every_backend_and_dtype
@pytest.mark.parametrize("module", [torchdq.DQRNEA, torchdq.ForwardDynamics], ids=lambda m: m.__name__)
def test_a_state_dict_carries_everything_that_is_learned(module, dtype, backend):
    learn = ("mass", "com", "inertia", "gravity", "armature", "home", "X_PB_home", "screw")
    robot = TREE.replace(home=double(0.1, 0.2, 0.3))
    other = robot.replace(**{name: getattr(robot, name) * 1.01 for name in learn if name not in ("X_PB_home", "screw")})
    a, b = (module(r, learn=learn, backend=backend).to(dtype) for r in (robot, other))
    x = states(3, 4, dtype=dtype)
    assert not same([a(*x)], [b(*x)])
    b.load_state_dict(a.state_dict())
    assert same([a(*x)], [b(*x)])
    assert {v.dtype for v in b.state_dict().values()} == {dtype}


# --- P13: threads ----------------------------------------------------------------------------------------------------


def with_threads(threads, function):
    """Results with one, two and three threads."""
    found = []
    for number in (1, 2, 3):
        threads(number)
        found.append(function())
    return found


@pytest.mark.case("P13")
@pytest.mark.parametrize("backend", [C])
@every_dtype
@pytest.mark.parametrize("key", ["inverse_dynamics", "forward_dynamics", "step"])
def test_the_number_of_threads_changes_no_bit_of_values_and_derivatives_by_row(key, dtype, backend, threads):
    x = states(2, 5003, dtype=dtype)
    with torchdq.backend(backend):
        one, *others = with_threads(threads, lambda: slopes(lambda *x: FUNCTIONS[key](ARM, *x), x))
    assert all(same(one, other) for other in others)


@exhaustive
@pytest.mark.case("P13")
@pytest.mark.parametrize("backend", [C])
def test_nor_of_rows_that_single_precision_loses(backend, threads):
    x = endangered(F32).repeat(1001, 1)
    with torchdq.backend(backend):
        one, *others = with_threads(threads, lambda: slopes(accelerations(tipped(1e9)), [x]))
    assert one[0].isfinite().all()
    assert all(same(one, other) for other in others)


@pytest.mark.case("P13")
@pytest.mark.parametrize("backend", [C])
@every_dtype
def test_nor_of_gradients_that_are_sums_over_the_batch(dtype, backend, threads):
    def gradient_of_masses():
        mass, x = TREE.mass.clone().requires_grad_(), states(3, 9001, dtype=dtype)
        tau = torchdq.inverse_dynamics(TREE.replace(mass=mass), *x)
        return torch.autograd.grad(tau.square().sum(), mass)

    with torchdq.backend(backend):
        one, *others = with_threads(threads, gradient_of_masses)
    assert all(same(one, other) for other in others)
