"""The dynamics as tensor code: batches, layouts, dtypes, bad robots, torch.func, torch.compile, export, modules.

What the functions return is the business of other files; here it must be the same however it is asked for. The tests
run over `FUNCTIONS`, every public function of the dynamics, unless they are about a module. Empty batches, layouts in
memory, bad rows, autocast and denormal numbers are in hard_cases/test_tensors.py.
"""

import itertools
import operator
import shutil
from functools import cache

import helpers
import pytest
import torch
from helpers import all_in_one, exhaustive, rods, thinned
from oracles import scaled_condition
from torch._dynamo.backends.common import aot_autograd
from torch._dynamo.testing import CompileCounterWithBackend
from torch._functorch.aot_autograd import make_boxed_func
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, vmap

import torchdq
from torchdq import effects
from torchdq.backends.compiler import compiler

fresh = helpers.fresh
F32, F64 = torch.float32, torch.float64
EPS = {F32: 2.0**-23, F64: 2.0**-52}
TRAILING = {"mass": 1, "com": 2, "inertia": 2, "gravity": 1, "armature": 1, "home": 1, "X_PB_home": 2, "screw": 2}
FUNCTIONS = {
    "inverse_dynamics": (torchdq.inverse_dynamics, "q qd qdd f_tip f_ext"),
    "forward_dynamics": (torchdq.forward_dynamics, "q qd tau f_tip f_ext"),
    "error_growth": (torchdq.error_growth, "q"),
    "mass_matrix": (torchdq.mass_matrix, "q"),
    "closed_form": (torchdq.closed_form, "q qd"),
    "forward_kinematics": (torchdq.forward_kinematics, "q"),
    "jacobian": (lambda robot, q: torchdq.jacobian(robot, q, "tip"), "q"),
    "jacobian in world axes": (lambda robot, q: torchdq.jacobian(robot, q, "tip", "world"), "q"),
    "regressor": (torchdq.regressor, "q qd qdd"),
    "kinetic_energy": (torchdq.kinetic_energy, "q qd"),
    "potential_energy": (torchdq.potential_energy, "q"),
    "dynamics_jacobian": (torchdq.dynamics_jacobian, "q qd qdd"),
    "dynamics_hessian": (torchdq.dynamics_hessian, "q qd qdd tau"),
    "mass_matrix_derivative": (torchdq.mass_matrix_derivative, "q"),
    "computed_torque": (
        lambda robot, q, qd, qdd, tau, f_tip: torchdq.computed_torque(robot, q, qd, tau, qd, qdd, 9.0, 6.0, f_tip),
        "q qd qdd tau f_tip",
    ),
}
FRICTION = (
    effects.Stribeck(0.3, 0.4, sign_width=0.5),
    effects.LoadDependent(0.1, sign_width=0.5),
    effects.Viscous(0.7),
)
# the module, and what its forward takes
MODULES = {
    "DQRNEA": (torchdq.DQRNEA, "q qd qdd f_tip"),
    "ForwardDynamics": (torchdq.ForwardDynamics, "q qd tau f_tip"),
    "ComputedTorque": (
        lambda robot, learn=(): torchdq.ComputedTorque(robot, 9.0, 6.0, learn=learn),
        "q qd q qd qdd f_tip",
    ),
    "DQRNEA with friction": (lambda robot, learn=(): torchdq.DQRNEA(robot, learn, friction=FRICTION), "q qd qdd f_tip"),
    "ForwardDynamics with friction": (
        lambda robot, learn=(): torchdq.ForwardDynamics(robot, learn, friction=FRICTION),
        "q qd tau f_tip",
    ),
}
MASS = "parametrizations.mass.original"  # the free numbers behind a learned mass: its logarithms
every_function = all_in_one(FUNCTIONS)
C_COMPILER = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
every_module = all_in_one(MODULES)


# --- inputs and results ----------------------------------------------------------------------------------------------


def random(seed):
    g = torch.Generator().manual_seed(seed)
    return lambda *shape, dtype=F64: torch.randn(shape, dtype=F64, generator=g).to(dtype)


@cache
def arm(name="two_link"):
    """A shipped robot with rotors and a home position, so that every optional tensor is there."""
    robot, draw = torchdq.robots.load(name), random(1)
    return robot.replace(armature=0.1 * draw(robot.n).abs(), home=draw(robot.n))


def inputs(names, n, batch=(), dtype=F64, seed=0):
    draw = random(seed)
    trailing = {"f_tip": (6,), "f_ext": (n, 6)}
    drawn = {name: draw(*batch, *trailing.get(name, (n,)), dtype=dtype) for name in dict.fromkeys(names.split())}
    return [drawn[name] for name in names.split()]


def call(key, robot, args):
    """Results of a function as a tuple."""
    result = FUNCTIONS[key][0](robot, *args)
    return (result,) if isinstance(result, torch.Tensor) else tuple(result)


def of(key, n, batch=(), dtype=F64, seed=0):
    return inputs(FUNCTIONS[key][1], n, batch, dtype, seed)


def same(a, b):
    """Equal to the last bit, shapes, dtypes and places of NaN included."""
    return len(a) == len(b) and all(
        x.dtype == y.dtype and x.shape == y.shape and torch.equal(x.nan_to_num(), y.nan_to_num())
        and torch.equal(x.isnan(), y.isnan())
        for x, y in zip(a, b, strict=True)
    )  # fmt: skip


def relative(a, b):
    pairs = [(x.detach(), y.detach()) for x, y in zip(a, b, strict=True)]
    return max(float((x - y).abs().max() / y.abs().max().clamp_min(1e-30)) for x, y in pairs)


# --- batches ---------------------------------------------------------------------------------------------------------


@every_function
def test_a_row_of_a_batch_is_bitwise_the_row_alone(key):
    robot = arm("panda" if key == "forward_dynamics" else "two_link")
    for batch in (1,), (5,), (3, 1, 2):
        args = of(key, robot.n, batch)
        together = call(key, robot, args)
        for at in itertools.product(*map(range, batch)):
            assert same([y[at] for y in together], call(key, robot, [x[at] for x in args]))


@pytest.mark.case("P2")
@every_function
def test_leading_axes_broadcast(key):
    robot = arm()
    args = of(key, 2, (3, 1))
    args = [x if i % 2 == 0 else x[0, 0] for i, x in enumerate(args)]
    args[-1] = args[-1] if args[-1].ndim == 1 else args[-1][:1].expand(1, 4, *args[-1].shape[2:])
    batch = torch.broadcast_shapes(*[x.shape[: x.ndim - t] for x, t in zip(args, trailing(key), strict=True)])
    full = [x.expand(*batch, *x.shape[x.ndim - t :]).contiguous() for x, t in zip(args, trailing(key), strict=True)]
    assert same(call(key, robot, args), call(key, robot, full))


def trailing(key):
    return [2 if name == "f_ext" else 1 for name in FUNCTIONS[key][1].split()]


@pytest.mark.case("P1")
@pytest.mark.parametrize(
    "backend, keys",
    [
        ("eager", FUNCTIONS),
        pytest.param("c", thinned(FUNCTIONS, ("inverse_dynamics", "forward_kinematics")), marks=C_COMPILER),
    ],
    ids=["eager", "c"],
)
def test_a_robot_without_joints_gives_empty_axes(backend, keys):
    expected = {
        "inverse_dynamics": [(4, 0)],
        "forward_dynamics": [(4, 0)],
        "error_growth": [(4,)],
        "mass_matrix": [(4, 0, 0)],
        "closed_form": [(4, 0, 0), (4, 0), (4, 0)],
        "forward_kinematics": [(4, 1, 8)],
        "jacobian": [(4, 6, 0)],
        "jacobian in world axes": [(4, 6, 0)],
        "regressor": [(4, 0, 0)],
        "kinetic_energy": [(4,)],
        "potential_energy": [(4,)],
        "dynamics_jacobian": [(4, 0, 0)] * 3,
        "dynamics_hessian": [(4, 0, 0), (4, 0, 0)],
        "mass_matrix_derivative": [(4, 0, 0, 0)],
        "computed_torque": [(4, 0)],
    }
    assert {key: sizes_without_joints(key, backend) for key in keys} == {key: expected[key] for key in keys}


def sizes_without_joints(key, backend):
    """Shapes of the results for a robot without joints; gradients have those of what they belong to."""
    robot = torchdq.Robot.from_urdf("<robot name='rock'><link name='tip'/></robot>")
    args = [x for x in of(key, 0, (4,)) if x.shape[-1] != 6 or x.ndim == 3]  # there is no tip to push
    if "f_tip" in FUNCTIONS[key][1].split():
        args.insert(FUNCTIONS[key][1].split().index("f_tip"), None)
    with torchdq.backend(backend):
        leaves = [x if x is None else x.requires_grad_() for x in args]
        found = [y for y in call(key, robot, leaves) if y is not None]
        total = sum(y.sum() for y in found)
        if total.requires_grad:
            total.backward()
    assert all(x is None or x.grad is None or x.grad.shape == x.shape for x in leaves)
    return [tuple(y.shape) for y in found]


# --- batches of robots, bad ones, and dtypes -------------------------------------------------------------------------


def varied(robot, fields, batch=(3,)):
    """Robot with a batch axis in those fields, each row different."""
    draw = random(7)
    change = {f: getattr(robot, f) * (1.0 + 0.1 * draw(*batch, *[1] * TRAILING[f])) for f in fields}
    return robot.replace(**change, on_unphysical="ignore")


def one(robot, k):
    """Robot k of a batch of robots."""
    fields = {f: getattr(robot, f) for f in TRAILING}
    return robot.replace(**{f: x[k] for f, x in fields.items() if x.ndim > TRAILING[f]}, on_unphysical="ignore")


def alike(found, expected):
    """Equal shapes, and values equal but for the order of operations: what varies is not summed up beforehand."""
    return [x.shape for x in found] == [x.shape for x in expected] and relative(found, expected) < 4096 * EPS[F64]


ONE_BY_ONE = thinned(FUNCTIONS, ("inverse_dynamics",))  # the other functions with all fields


@all_in_one([(key, fields) for key in FUNCTIONS for fields in (
    *([field] for field in TRAILING if key in ONE_BY_ONE), list(TRAILING))])  # fmt: skip
def test_a_batch_of_robots_is_a_loop_over_robots(of_what):
    """In one state each, and all in the same: results have the robots' axes even where they do not depend on them."""
    key, fields = of_what
    robot, args = varied(arm(), fields), of(key, 2, (3,))
    loop = [call(key, one(robot, k), [x[k] for x in args]) for k in range(3)]
    assert alike(call(key, robot, args), [torch.stack(rows) for rows in zip(*loop, strict=True)])
    args = of(key, 2)
    loop = [call(key, one(robot, k), args) for k in range(3)]
    assert alike(call(key, robot, args), [torch.stack(rows) for rows in zip(*loop, strict=True)])


@all_in_one(["inverse_dynamics", "forward_dynamics"])
def test_each_robot_of_a_batch_gets_its_own_gradient(key):
    robot, args = varied(arm(), TRAILING), of(key, 2, (3,))

    def gradients(robot, args):
        fields = {name: getattr(robot, name).clone().requires_grad_() for name in TRAILING}
        (y,) = call(key, robot.replace(**fields, on_unphysical="ignore"), args)
        return torch.autograd.grad(y.square().sum(), fields.values())

    found = gradients(robot, args)
    for k in range(3):
        alone = gradients(one(robot, k), [x[k] for x in args])
        assert relative([x[k] for x in found], alone) < 64 * EPS[F64]


def test_the_parameters_of_a_batch_of_robots_are_those_of_each():
    robot = varied(arm(), ["com"])
    assert same([robot.inertial_parameters], [torch.stack([one(robot, k).inertial_parameters for k in range(3)])])


@pytest.mark.case("D3", "P9")
@all_in_one(["inverse_dynamics", "forward_dynamics", "closed_form", "mass_matrix"])
def test_a_bad_robot_leaves_the_other_robots_bitwise_alone(key):
    """Its masses are not numbers, or it has none beyond a joint."""
    robot, args = varied(torchdq.robots.load("two_link"), ["mass", "inertia"]), of(key, 2, (3,))
    good = [y[[0, 2]] for y in call(key, robot, args)]
    for bad in (torch.nan, 0.0):
        fields = {name: getattr(robot, name).clone() for name in ("mass", "inertia")}
        for x in fields.values():
            x[1] = bad
        found = call(key, robot.replace(**fields), args)
        assert same(good, [y[[0, 2]] for y in found])
        assert not found[0][1].isfinite().all() or (bad == 0.0 and key != "forward_dynamics")


@every_function
def test_float32_stays_float32_and_is_as_accurate(key):
    robot = torchdq.robots.load("panda" if key in ("forward_dynamics", "forward_kinematics") else "two_link")
    args = of(key, robot.n, (20,), F32)
    exact = call(key, robot, [x.double() for x in args])
    found = call(key, robot, args)
    assert {y.dtype for y in found} == {F32}
    condition = 1.0
    if key == "forward_dynamics":
        # 5e-6 is about 40 eps; solving with M multiplies it by the condition of M scaled to a unit diagonal
        condition = scaled_condition(torchdq.mass_matrix(robot, args[0].double()))
    assert relative([y.double() for y in found], exact) < 5e-6 * condition


# --- torch.func ------------------------------------------------------------------------------------------------------


def module_of(key, robot, learn=()):
    return MODULES[key][0](robot, learn=learn)


@pytest.mark.case("P3")
@every_module
def test_vmap_over_a_module_is_its_batch(key):
    module = module_of(key, arm())
    args = inputs(MODULES[key][1], 2, (4,))
    assert same([vmap(module)(*args)], [module(*args)])


@pytest.mark.case("P3")
@every_module
def test_functional_call_takes_other_parameters(key):
    robot = arm()
    module = module_of(key, robot, ("mass",))
    args = inputs(MODULES[key][1], 2, (3,))
    other = module_of(key, robot.replace(mass=2.0 * robot.mass))
    found = functional_call(module, {MASS: (2.0 * robot.mass).log()}, tuple(args))
    assert relative([found], [other(*args)]) < 16 * EPS[F64]  # of the exponential of a logarithm


@pytest.mark.case("P3")
@every_module
def test_vmap_over_functional_call_is_a_batch_of_robots(key):
    robot = varied(arm(), ["mass"])
    module = module_of(key, one(robot, 0), ("mass",))
    args = inputs(MODULES[key][1], 2, (3,))
    found = vmap(lambda mass, *x: functional_call(module, {MASS: mass}, x))(robot.mass.log(), *args)
    assert alike([found], [module_of(key, robot)(*args)])


@pytest.mark.case("P3")
@every_module
def test_grad_of_functional_call_is_that_of_backward(key):
    friction = () if "friction" in key else ("friction",)  # Stribeck's has two that are ordered, and is not learned
    module = module_of(key, arm(), ("mass", "com", "inertia", "armature", "offset", *friction))
    args = inputs(MODULES[key][1], 2, (3,))
    found = grad(lambda p: functional_call(module, p, tuple(args)).square().sum())(dict(module.named_parameters()))
    module(*args).square().sum().backward()
    assert relative(list(found.values()), [p.grad for p in module.parameters()]) < 1e-12


# --- torch.compile and torch.export ----------------------------------------------------------------------------------


@pytest.mark.case("P4")
@pytest.mark.parametrize(
    "key",
    thinned(FUNCTIONS, ("computed_torque",)),  # hard_cases/test_tensors.py has others
)
def test_every_function_compiles_without_a_graph_break(key, fresh):
    robot = arm()
    args = of(key, 2, (3,))
    compiled = torch.compile(lambda *x: call(key, robot, x), backend="eager", fullgraph=True)
    assert relative(compiled(*args), call(key, robot, args)) < 1e-12


LEARNED = thinned(("mass", "com", "inertia", "armature", "friction", "offset"), ("mass", "friction"))


def slopes(module, f, args):
    args = [x.clone().requires_grad_() for x in args]
    tau = f(*args)
    return (tau, *torch.autograd.grad(tau.square().sum(), [*args, *module.parameters()]))


@pytest.mark.case("P4")
@C_COMPILER
def test_a_compiled_arm_has_the_same_values_and_gradients_and_is_compiled_once_more_for_another_batch(fresh):
    module = torchdq.DQRNEA(torchdq.robots.load("two_link"), learn=LEARNED, backend="c")
    counter = CompileCounterWithBackend("aot_eager")
    compiled = torch.compile(module, backend=counter, fullgraph=True)
    for batch in thinned((4, 7, 9, 33), (4, 7, 33)):
        args = inputs("q qd qdd", 2, (batch,))
        assert relative(slopes(module, compiled, args), slopes(module, module, args)) < 1e-12
    assert counter.frame_count <= 2


@exhaustive
@pytest.mark.case("P4")
@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
def test_compiled_to_machine_code_for_any_batch_size_it_has_the_same_values_and_gradients(fresh):
    """Of one joint: inductor takes a minute for some."""
    module = torchdq.DQRNEA(rods(1), learn=("mass",))
    compiled = torch.compile(module, backend="inductor", fullgraph=True, dynamic=True)
    for batch in (5, 18):
        args = inputs("q", 1, (batch,))
        assert relative(slopes(module, compiled, args), slopes(module, module, args)) < 1e-12


@pytest.mark.case("P4")
@pytest.mark.parametrize(
    "transform, backend",
    [  # torch refuses vmap of an operator that is not its own
        *((transform, "auto") for transform in thinned((grad, jacrev, jacfwd, vmap), ())),
        *(pytest.param(transform, "c", marks=C_COMPILER) for transform in thinned((grad, jacfwd, jacrev), (grad,))),
    ],
)
def test_a_transform_inside_a_compiled_function_has_the_values_of_the_transform_outside(transform, backend, fresh):
    robot, args = arm(), inputs("q qd tau", 2, (3,))

    def f(q):
        qdd = torchdq.forward_dynamics(robot, q, *(x[:1] for x in args[1:]))
        return qdd.square().sum() if transform is grad else qdd

    with torchdq.backend(backend):
        compiled = torch.compile(lambda q: transform(f)(q), backend="aot_eager", fullgraph=True)
        assert relative([compiled(args[0])], [transform(f)(args[0])]) < 1e-12


@pytest.mark.case("P4")
@C_COMPILER
def test_a_compiled_graph_is_little_more_than_its_program(fresh):
    """Operators and guards, for which every call of a compiled layer pays; no views and no copies are among them."""
    graphs, guards = [], []

    def counting(graph, _):
        graphs.append([node.target for node in graph.graph.nodes if node.op == "call_function"])
        return make_boxed_func(graph.forward)

    def all_of(found):
        guards.extend(found)
        return [True] * len(found)

    module, args = torchdq.DQRNEA(torchdq.robots.load("panda"), backend="c"), inputs("q qd qdd", 7, (4,))
    backend = aot_autograd(fw_compiler=counting)
    compiled = torch.compile(module, backend=backend, fullgraph=True, options={"guard_filter_fn": all_of})
    with torch.no_grad():
        assert same([compiled(*args)], [module(*args)])
    assert graphs == [[torch.ops.torchdq.run.default, operator.getitem]]
    assert len(guards) < 120  # 80 at present, and 150 if the checks of arguments were traced


@pytest.mark.case("P4")
@C_COMPILER
def test_a_compiled_layer_broadcasts_batch_axes(fresh):
    module, (q, qd, qdd) = torchdq.DQRNEA(arm(), backend="c"), inputs("q qd qdd", 2, (4,))
    compiled = torch.compile(module, backend="eager", fullgraph=True)
    args = q, qd[:1], qdd[:3, None]
    assert compiled(*args).shape == (3, 4, 2) and relative([compiled(*args)], [module(*args)]) < 1e-12


@pytest.mark.case("P4")
@C_COMPILER
def test_a_compiled_layer_notices_that_its_robot_was_replaced_by_one_of_equal_shapes(fresh):
    module, args = torchdq.DQRNEA(arm(), backend="c"), inputs("q qd qdd", 2, (4,))
    compiled = torch.compile(module, backend="aot_eager", fullgraph=True)
    before = compiled(*args)
    heavier = arm().replace(mass=2 * arm().mass).bake()
    module._robot = heavier
    expected = torchdq.inverse_dynamics(heavier, *args)
    assert relative([before], [expected]) > 0.1 and relative([compiled(*args)], [expected]) < 1e-12


def test_the_first_call_may_be_inside_a_transform():
    """Programs are recorded from numbers of the robot, which are kept; none of them may end with the transform."""
    robot = arm().replace(mass=torch.tensor([1.25, 0.75], dtype=F64))  # not the robot of another test
    for key in thinned(FUNCTIONS, ("forward_dynamics", "closed_form", "jacobian", "regressor", "potential_energy")):
        q, *rest = of(key, 2)

        def total(q, key=key, rest=rest):
            return sum(y.square().sum() for y in call(key, robot, [q, *rest]))

        assert bool(jacfwd(hessian(total))(q).isfinite().all())


@pytest.mark.case("P4")
@pytest.mark.parametrize("key", thinned(MODULES, ("ForwardDynamics with friction",)))
def test_an_exported_module_takes_any_batch_size(key):
    torchdq.clear_caches()  # as of one that was never called
    module = module_of(key, torchdq.robots.load("two_link"))
    batch = torch.export.Dim("batch")
    args = inputs(MODULES[key][1], 2, (3,))
    exported = torch.export.export(module, tuple(args), dynamic_shapes=[{0: batch} for _ in args])
    args = inputs(MODULES[key][1], 2, (11,))
    # torch operations; a compiled program may round a product and a sum of friction at once
    rounding = 16 * EPS[F64] if "friction" in key else 0.0
    assert relative([exported.module()(*args)], [module(*args)]) <= rounding


# --- modules ---------------------------------------------------------------------------------------------------------


@pytest.mark.case("P12")
def test_the_state_of_a_controller_holds_its_gains():
    robot = arm()
    controller = torchdq.ComputedTorque(robot, 9.0, torch.tensor([6.0, 5.0]))
    other = torchdq.ComputedTorque(robot, 1.0, torch.ones(2))
    other.load_state_dict(controller.state_dict())
    args = inputs("q qd q qd qdd", 2)
    assert same([other(*args)], [controller(*args)])


@pytest.mark.case("P8", "P12")
@every_module
def test_a_module_computes_in_the_dtype_of_its_inputs_and_keeps_parameters_in_its_own(key):
    module = module_of(key, arm(), ("mass", "inertia"))
    args, single = (inputs(MODULES[key][1], 2, (3,), dtype) for dtype in (F64, F32))
    assert {x.dtype for x in module.state_dict().values()} == {F64}
    before, exact = module(*single), module(*args)
    assert (before.dtype, exact.dtype) == (F32, F64)
    module.to(F32)
    assert {x.dtype for x in module.state_dict().values()} == {module.prior().dtype} == {F32}
    # the exponential of a rounded logarithm is not the rounded exponential of the logarithm
    assert relative([module(*single)], [before]) < 16 * EPS[F32]
    # what was rounded stays rounded, to single precision and no worse
    assert module(*args).dtype == F64 and 0.0 < relative([module.double()(*args)], [exact]) < 100 * EPS[F32]


@every_module
def test_what_is_learnt_is_a_parameter_with_a_gradient(key):
    module = module_of(key, arm(), tuple(TRAILING))
    module(*inputs(MODULES[key][1], 2, (3,))).square().sum().backward()
    parameters = dict(module.named_parameters())
    assert {name.removesuffix(".original").rpartition(".")[2] for name in parameters} == set(TRAILING)
    assert all(float(p.grad.abs().max()) > 0.0 for p in parameters.values())
