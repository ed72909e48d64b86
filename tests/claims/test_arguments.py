"""Bad input is refused by name, and good input comes back untouched.

Every function of the dynamics is called with every one of its tensors wrong in every way; the error must be one of the
package's, name the argument, and say what was expected and what was found. A function that is public and not in
`FUNCTIONS`, or takes an argument that is not listed there, fails the first test.
"""

import contextlib
import inspect
import re
from functools import cache

import numpy as np
import pytest
import torch
from helpers import all_in_one, thinned
from messages import refused

import torchdq
from torchdq import ArgumentError, DtypeError, Scene, TorchdqError, effects
from torchdq.learning import Samples, fit, identify

F64 = torch.float64
N = 2
FIELDS = ("mass", "com", "inertia", "gravity", "armature", "home", "X_PB_home", "screw")
TRAILING = {"f_tip": (6,), "f_ext": (N, 6), "X_des": (8,), "V_des": (6,), "A_des": (6,)}  # of the others: (N,)

FRAME, AXES = {"frame": None, "expressed": "body"}, ("x", "y")

# function -> its tensors, those that may be None, and its other arguments
FUNCTIONS = {
    "inverse_dynamics": ("q qd qdd f_tip f_ext", "qd qdd f_tip f_ext", {}),
    "forward_dynamics": ("q qd tau f_tip f_ext", "qd f_tip f_ext", {"precision": "auto"}),
    "error_growth": ("q", "", {}),
    "mass_matrix": ("q", "", {}),
    "closed_form": ("q qd", "", {}),
    "forward_kinematics": ("q", "", {"frame": None}),
    "jacobian": ("q", "", {"frame": "tip", "expressed": "world"}),
    "regressor": ("q qd qdd", "qd qdd", {}),
    "dynamics_jacobian": ("q qd qdd", "", {}),
    "kinetic_energy": ("q qd", "", {}),
    "potential_energy": ("q", "", {}),
    "coriolis_matrix": ("q qd", "", {}),
    "frame_motion": ("q qd qdd", "qdd", {"frame": None, "expressed": "world"}),
    "manipulability": ("q", "", {**FRAME, "axes": AXES}),
    "operational_space": ("q qd", "", {**FRAME, "axes": AXES}),
    "operational_space_control": (
        "q qd X_des V_des A_des q_null",
        "V_des A_des q_null",
        {**FRAME, "axes": AXES, "kp": 9.0, "kd": 6.0, "k_null": 1.0, "damping": 0.01, "limits": False},
    ),
    "cartesian_impedance": (
        "q qd X_des V_des q_null",
        "V_des q_null",
        {**FRAME, "axes": AXES, "stiffness": 9.0, "damping": 6.0, "k_null": 1.0, "coriolis": False},
    ),
    "computed_torque": ("q qd q_des qd_des qdd_des f_tip", "f_tip", {"kp": 9.0, "kd": 6.0}),
}
NOT_DYNAMICS = {"dq", "robots", "require_finite", "convert", "compile", "backend", "clear_caches", "recommend_settings"}
NOT_DYNAMICS |= {"external_wrenches"}  # whose tensors are in a dictionary
NOT_DYNAMICS |= {"inverse_kinematics", "differential_inverse_kinematics"}  # whose rows have conditions of their own
every_function = all_in_one(FUNCTIONS)


@cache
def arm():
    return torchdq.robots.load("two_link")


@cache
def full():
    """Arm with every optional tensor."""
    return arm().replace(armature=torch.ones(N, dtype=F64), home=torch.ones(N, dtype=F64))


def tensors(key, batch=(3,)):
    g = torch.Generator().manual_seed(0)
    names = FUNCTIONS[key][0].split()
    return {name: torch.randn(*batch, *TRAILING.get(name, (N,)), dtype=F64, generator=g) for name in names}


def call(key, robot, arguments):
    """Results of a function as a tuple."""
    result = getattr(torchdq, key)(robot, **arguments, **FUNCTIONS[key][2])
    return (result,) if isinstance(result, torch.Tensor) else tuple(result)


def require_named(error, parts, function, *arguments):
    """The error of the package that a function must raise holds every part, names as whole words."""
    with pytest.raises(error) as raised:
        function(*arguments)
    message = str(raised.value)
    assert isinstance(raised.value, TorchdqError)
    assert [part for part in parts if not re.search(rf"(?<!\w){re.escape(part)}(?!\w)", message)] == [], message


def test_every_public_function_is_listed_with_its_arguments():
    public = {name for name in dir(torchdq) if inspect.isfunction(getattr(torchdq, name))} - NOT_DYNAMICS
    listed = {key: {"robot", *names.split(), *rest} for key, (names, _, rest) in FUNCTIONS.items()}
    assert {key: set(inspect.signature(getattr(torchdq, key)).parameters) - {"backend"} for key in public} == listed


def test_errors_are_those_that_python_has_for_them():
    assert issubclass(DtypeError, TypeError) and issubclass(ArgumentError, ValueError)
    assert issubclass(torchdq.UnknownNameError, KeyError)


# --- tensors ---------------------------------------------------------------------------------------------------------

# error, what becomes of a tensor, and what is said besides its name; one number would broadcast to every joint
WRONG = {
    **{
        f"{k} numbers": (ArgumentError, lambda x, k=k: x[..., :1].expand(*x.shape[:-1], k), "two_link")
        for k in (0, 1, 5, 9)
    },
    "no axes": (ArgumentError, lambda x: x.new_tensor(1.0), "found ()"),
    "list": (ArgumentError, torch.Tensor.tolist, "tensor", "list"),
    "array": (ArgumentError, torch.Tensor.numpy, "tensor", "ndarray"),
    "number": (ArgumentError, lambda x: 1.0, "tensor", "float"),
    **{
        str(dtype): (DtypeError, lambda x, dtype=dtype: x.to(dtype), "float32", "float64", str(dtype))
        for dtype in (torch.int64, torch.bool, torch.float16, torch.bfloat16, torch.complex128)
    },
}
# of all but the first tensor, which decides the batch, the dtype and the device
UNLIKE = {
    "batch": (ArgumentError, lambda x: x[:1].expand(4, *x.shape[1:]), "broadcast", "q", "(3,)", "(4,)"),
    "dtype": (DtypeError, torch.Tensor.float, "torch.float32", "q", "torch.float64"),
    "device": (ArgumentError, lambda x: x.to("meta"), "meta", "q", "cpu"),
}


@pytest.mark.case("P5", "P7", "P8", "P14")
@every_function
def test_a_wrong_tensor_is_named_with_what_was_expected_and_found(key):
    arguments = tensors(key)
    for way, (error, change, *parts) in (WRONG | UNLIKE).items():
        for name in list(arguments)[way in UNLIKE :]:
            if name == "q_null" and way in ("no axes", "number"):  # one number for all joints
                continue
            wrong = change(arguments[name])
            expected = [name, *parts]
            if way.endswith("numbers"):
                expected += [", ".join(map(str, ("...", *TRAILING.get(name, (N,))))), str(tuple(wrong.shape))]
            require_named(error, expected, call, key, arm(), arguments | {name: wrong})


@pytest.mark.case("P14")
@all_in_one(["inverse_dynamics", "forward_dynamics"])
def test_link_wrenches_of_the_wrong_rank_are_named(key):
    for shape in [(6,), (N,), (3, 6), (3, 6, N)]:
        arguments = tensors(key, ()) | {"f_ext": torch.zeros(shape, dtype=F64)}
        require_named(ArgumentError, ["f_ext", f"found {shape}"], call, key, arm(), arguments)


@every_function
def test_a_missing_tensor_is_named_unless_it_may_be_absent(key):
    for name in tensors(key):
        arguments = tensors(key) | {name: None}
        if name in FUNCTIONS[key][1].split():
            assert all(bool(y.isfinite().all()) for y in call(key, arm(), arguments))
        else:
            require_named(ArgumentError, [name, "tensor", "NoneType"], call, key, arm(), arguments)


@every_function
def test_a_wrong_robot_is_named(key):
    require_named(ArgumentError, ["robot", "torchdq.Robot", "Tensor"], call, key, torch.zeros(3, N), tensors(key))
    for field in FIELDS:
        x = getattr(full(), field)
        batch = full().replace(**{field: x.expand(4, *x.shape)})
        parts = ["broadcast", f"robot.{field}", "q", "(3,)", "(4,)"]
        require_named(ArgumentError, parts, call, key, batch, tensors(key))
    robot = arm().replace(mass=arm().mass.expand(4, N), gravity=arm().gravity.expand(5, 3))
    require_named(ArgumentError, ["robot.mass", "robot.gravity", "(4,)", "(5,)"], call, key, robot, tensors(key, ()))


@pytest.mark.case("P4")
@pytest.mark.parametrize("key", thinned(FUNCTIONS, ("inverse_dynamics",)))
def test_a_function_is_exported_for_any_batch_with_what_all_rows_share(key):
    robot, options = arm().lock({"joint2": 0.5}), FUNCTIONS[key][2]  # never called with
    options = {name: ("x",) if name == "axes" else x for name, x in options.items()}
    given = {name: x[0] if name in TRAILING else x[:, :1] for name, x in tensors(key).items()}
    given = {name: x[:1] if name == "f_ext" else x for name, x in given.items()}

    class Traced(torch.nn.Module):
        def forward(self, *x):
            return getattr(torchdq, key)(robot, **dict(zip(given, x, strict=True)), **options)

    shapes = [None if name in TRAILING else {0: torch.export.Dim("batch")} for name in given]
    torch.export.export(Traced(), tuple(given.values()), dynamic_shapes=(tuple(shapes),))  # raises for guarded sizes


@every_function
def test_the_robot_follows_the_device_of_the_inputs(key):
    results = call(key, arm(), {name: x.to("meta") for name, x in tensors(key).items()})
    assert {y.device.type for y in results} == {"meta"}


@pytest.mark.case("P5", "P7")
@all_in_one(FIELDS)
def test_a_wrong_parameter_of_a_robot_is_named(field):
    wrong = torch.zeros(2, 2, 5, dtype=F64)
    require_named(ArgumentError, [field, "two_link", "found (2, 2, 5)"], lambda: arm().replace(**{field: wrong}))
    for dtype in (torch.int64, torch.float16, torch.bfloat16):
        parts = [field, "two_link", "float32", "float64", str(dtype)]
        require_named(DtypeError, parts, lambda: full().replace(**{field: getattr(full(), field).to(dtype)}))  # noqa: B023


@all_in_one(["float32", torch.float32, np.float32])
def test_a_dtype_may_be_given_by_its_name(dtype):
    assert torchdq.compile(arm(), "mass_matrix", dtype=dtype).dtype == torch.float32


@all_in_one(["inverse_dynamics", "forward_dynamics", "computed_torque"])
def test_a_tip_wrench_on_a_robot_without_a_tip_is_refused_with_the_frames_it_has(key):
    parts = ["f_tip", "two_link", *arm().frame_names]
    require_named(ArgumentError, parts, call, key, arm().with_tip(None), tensors(key))
    require_named(ArgumentError, ["tip", "base", "two_link"], call, key, arm().with_tip("base"), tensors(key))


def test_require_finite_lets_finite_and_absent_arguments_pass():
    assert torchdq.require_finite(q=torch.full((2,), 1e38), qd=None, qdd=torch.zeros(0, N)) is None


# --- nothing is lost -------------------------------------------------------------------------------------------------


def remember(arguments):
    """Values and version counters, the latter counting the writes to a tensor."""
    return {name: (x.detach().clone(), x._version) for name, x in arguments.items()}


def untouched(arguments, before):
    return [
        name for name, x in arguments.items() if not (torch.equal(x, before[name][0]) and x._version == before[name][1])
    ]


@every_function
def test_results_are_tensors_of_their_own(key):
    """Writing to a result changes no input, nothing of the robot, no other entry, and not the next call."""
    robot, arguments = full(), tensors(key)
    known = arguments | {field: getattr(robot, field) for field in FIELDS}
    before, expected = remember(known), [y.clone() for y in call(key, robot, arguments)]
    assert untouched(known, before) == []
    for y in call(key, robot, arguments):
        y.fill_(7.0)
    assert untouched(known, before) == []
    assert all(torch.equal(a, b) for a, b in zip(call(key, robot, arguments), expected, strict=True))


@every_function
def test_backward_writes_to_nothing_but_gradients(key):
    arguments = {name: x.requires_grad_() for name, x in tensors(key).items()}
    before = remember(arguments)
    sum(y.sum() for y in call(key, arm(), arguments)).backward()
    assert untouched(arguments, before) == []
    assert bool(arguments["q"].grad.isfinite().all())


def test_a_module_does_not_write_to_the_robot_it_is_made_of():
    robot = arm()
    known = {field: getattr(robot, field) for field in ("mass", "com", "inertia")}
    before = remember(known)
    module = torchdq.DQRNEA(robot, learn=tuple(known))
    with torch.no_grad():
        for p in module.parameters():
            p.add_(1.0)
    assert untouched({field: getattr(robot, field) for field in known}, before) == []


# --- tensors that are not dense, and devices -------------------------------------------------------------------------

OTHERS = {
    "sparse_coo": lambda x: x.to_sparse(),
    "sparse_csr": lambda x: x.to_sparse_csr(),
    "mkldnn": lambda x: x.float().to_mkldnn(),
    "nested": lambda x: torch.nested.nested_tensor([x[0], x[1]]),
}


@pytest.mark.parametrize("layout", OTHERS)
@pytest.mark.filterwarnings("ignore:Sparse CSR|The PyTorch API of nested|The PyTorch API of MKLDNN")
def test_tensors_that_are_not_dense_are_named(layout):
    """Also where a dense tensor of the same shape was seen before."""
    robot = torchdq.robots.load("two_link")
    plain = torch.ones(2, 2, dtype=torch.float64)
    other = OTHERS[layout](plain)
    plain = plain.to(other.dtype)
    scene, tables = Scene(robot), Samples(plain, plain, plain, plain)
    uses = (
        lambda x: torchdq.inverse_dynamics(robot, x),
        lambda x: torchdq.inverse_dynamics(robot, plain, x, backend="eager"),
        lambda x: torchdq.compile(robot, "mass_matrix", dtype=plain.dtype)(x),
        lambda x: scene.start(x),
        lambda x: scene.step(scene.start(plain), x),
        lambda x: robot.replace(mass=x),
        lambda x: Scene(robot, (effects.Viscous(x),)),
        lambda x: fit(torchdq.DQRNEA(robot, learn="mass"), tables._replace(tau=x), steps=1),
        lambda x: identify(robot, Samples(plain, plain, plain, x)),
    )
    for use in uses:
        with contextlib.suppress(ArgumentError):  # samples that are all the same may be refused
            use(plain)
        with refused(ArgumentError):
            use(other)
    with refused(torchdq.TorchdqError):
        robot.replace(damping=OTHERS["mkldnn"](plain) if layout == "mkldnn" else other)


@pytest.mark.filterwarnings("ignore:.* acts on no joint")
def test_robots_effects_and_layers_are_made_on_the_cpu_whatever_the_default_device_is():
    q = torch.ones(2, dtype=torch.float64)
    robot = torchdq.robots.load("two_link")
    parts = [
        effects.Contact("tip"),
        effects.Payload(1.0),
        effects.JointLimits(),
        effects.Viscous(1.0),
        effects.Elastic(9.0, inertia=1.0),
    ]
    held = robot.with_payload(1.0, (0.1, 0.0, 0.0))
    with torch.device("meta"):
        for name in torchdq.robots.names():
            assert torchdq.robots.load(name).mass.device.type == "cpu"
        here = torchdq.robots.load("two_link")
        torch.testing.assert_close(torchdq.inverse_dynamics(here, q), torchdq.inverse_dynamics(robot, q))
        assert here.lock({"joint1": 0.5}).n == 1 and here.replace(gravity=(0 * here.gravity)).bake().tip == "tip"
        assert torch.equal(here.with_payload(1.0, (0.1, 0.0, 0.0)).com, held.com)
        for part in parts:
            scene = Scene(here, (part,))
            assert scene.step(scene.start(q)).q.device.type == "cpu"
        with refused(ArgumentError):
            Scene(here, (effects.Payload(1.0, inertia=(1.0, 0.0, 0.0, 9.0, 0.0, 1.0)),))
        layer = torchdq.DQRNEA(here, learn=("mass", "inertia", "friction", "offset"))
        assert layer(q).device.type == "cpu"
