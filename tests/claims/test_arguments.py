"""Bad input is refused by name, and good input comes back untouched.

Every function of the dynamics is called with every one of its tensors wrong in every way; the error must be one of the
package's, name the argument, and say what was expected and what was found. A function that is public and not in
`FUNCTIONS`, or takes an argument that is not listed there, fails the first test.
"""

import contextlib
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused

import torchdq
from torchdq import ArgumentError, DtypeError, TorchdqError, UnknownNameError
from torchdq.envs import Scene, effects
from torchdq.learning import Samples, fit, identify

F32, F64 = torch.float32, torch.float64
N = 7
FIELDS = ("mass", "com", "inertia", "gravity", "armature", "home", "X_PB_home", "screw")
TRAILING = {"f_tip": (6,), "f_ext": (N, 6)}  # of the others: (N,)

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
    "computed_torque": ("q qd q_des qd_des qdd_des f_tip", "f_tip", {"kp": 9.0, "kd": 6.0}),
}
NOT_DYNAMICS = {"dq", "robots", "require_finite", "convert", "compile", "backend", "clear_caches", "recommend_settings"}
CASES = [(key, name) for key, (names, _, _) in FUNCTIONS.items() for name in names.split()]
# the first tensor decides the dtype, the device and the batch; the others must follow it
FOLLOWERS = [(key, name) for key, name in CASES if name != "q"]
every_tensor = pytest.mark.parametrize(("key", "name"), CASES)
every_follower = pytest.mark.parametrize(("key", "name"), FOLLOWERS)


def arm():
    return torchdq.robots.load("panda")


def tensors(key, batch=(3,), dtype=F64, seed=0):
    g = torch.Generator().manual_seed(seed)
    names = FUNCTIONS[key][0].split()
    return {name: torch.randn(*batch, *TRAILING.get(name, (N,)), dtype=F64, generator=g).to(dtype) for name in names}


def call(key, robot, arguments):
    """Results of a function as a tuple."""
    result = getattr(torchdq, key)(robot, **arguments, **FUNCTIONS[key][2])
    return (result,) if isinstance(result, torch.Tensor) else tuple(result)


def objection(error, key, arguments, robot=None):
    """Message of the error that a function must raise."""
    with pytest.raises(error) as raised:
        call(key, arm() if robot is None else robot, arguments)
    assert isinstance(raised.value, TorchdqError)
    return str(raised.value)


def says(message, *parts):
    """The message holds every part, names as whole words."""
    return [part for part in parts if not re.search(rf"(?<!\w){re.escape(part)}(?!\w)", message)] == []


def test_every_public_function_is_listed_with_its_arguments():
    public = {name for name in dir(torchdq) if inspect.isfunction(getattr(torchdq, name))} - NOT_DYNAMICS
    listed = {key: {"robot", *names.split(), *rest} for key, (names, _, rest) in FUNCTIONS.items()}
    assert {key: set(inspect.signature(getattr(torchdq, key)).parameters) - {"backend"} for key in public} == listed


# --- shape -----------------------------------------------------------------------------------------------------------


@pytest.mark.case("P14")
@pytest.mark.parametrize("size", [0, 1, 5, 8])
@every_tensor
def test_a_last_axis_of_the_wrong_size_is_named(key, name, size):
    """One too: it would broadcast, and every joint would get the same number."""
    arguments = tensors(key)
    wrong = arguments[name][..., :1].expand(*arguments[name].shape[:-1], size)
    message = objection(ArgumentError, key, arguments | {name: wrong})
    expected = ", ".join(map(str, TRAILING.get(name, (N,))))
    assert says(message, name, f"..., {expected}", "panda") and str(tuple(wrong.shape)) in message


@pytest.mark.case("P14")
@every_tensor
def test_a_tensor_without_axes_is_named(key, name):
    message = objection(ArgumentError, key, tensors(key) | {name: torch.tensor(1.0, dtype=F64)})
    assert says(message, name) and "found ()" in message


@pytest.mark.case("P14")
@pytest.mark.parametrize("key", ["inverse_dynamics", "forward_dynamics"])
@pytest.mark.parametrize("shape", [(6,), (N,), (3, 6), (3, 6, N)])
def test_link_wrenches_of_the_wrong_rank_are_named(key, shape):
    message = objection(ArgumentError, key, tensors(key, ()) | {"f_ext": torch.zeros(shape, dtype=F64)})
    assert says(message, "f_ext") and f"found {shape}" in message


@pytest.mark.case("P14")
@every_follower
def test_batch_axes_that_do_not_broadcast_are_all_named(key, name):
    arguments = tensors(key)
    arguments[name] = tensors(key, (4,))[name]
    message = objection(ArgumentError, key, arguments)
    assert says(message, "broadcast", *arguments) and "(3,)" in message and "(4,)" in message


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("key", FUNCTIONS)
def test_batch_axes_of_the_robot_that_do_not_broadcast_are_named(key, field):
    robot = arm().replace(armature=torch.ones(N, dtype=F64), home=torch.zeros(N, dtype=F64))
    x = getattr(robot, field)
    message = objection(ArgumentError, key, tensors(key), robot.replace(**{field: x.expand(4, *x.shape)}))
    assert says(message, "broadcast", f"robot.{field}", "q") and "(3,)" in message and "(4,)" in message


def test_batch_axes_of_a_robot_that_do_not_broadcast_with_each_other_are_named():
    robot = arm()
    robot = robot.replace(mass=robot.mass.expand(4, N), gravity=robot.gravity.expand(5, 3))
    message = objection(ArgumentError, "mass_matrix", tensors("mass_matrix", ()), robot)
    assert says(message, "robot.mass", "robot.gravity") and "(4,)" in message and "(5,)" in message


# --- kind, dtype, device ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "convert", [torch.Tensor.tolist, torch.Tensor.numpy, lambda x: 1.0], ids=["list", "array", "float"]
)
@every_tensor
def test_what_is_not_a_tensor_is_named(key, name, convert):
    arguments = tensors(key)
    wrong = convert(arguments[name])
    assert says(objection(ArgumentError, key, arguments | {name: wrong}), name, "tensor", type(wrong).__name__)


@every_tensor
def test_a_missing_tensor_is_named_unless_it_may_be_absent(key, name):
    arguments = tensors(key) | {name: None}
    if name in FUNCTIONS[key][1].split():
        assert all(bool(y.isfinite().all()) for y in call(key, arm(), arguments))
    else:
        assert says(objection(ArgumentError, key, arguments), name, "tensor", "NoneType")


@pytest.mark.case("P5", "P7")
@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.float16, torch.bfloat16, torch.complex128], ids=str)
@every_tensor
def test_a_dtype_that_dynamics_are_not_computed_in_is_named(key, name, dtype):
    arguments = tensors(key)
    message = objection(DtypeError, key, arguments | {name: arguments[name].to(dtype)})
    assert says(message, name, "float32", "float64", str(dtype))


def test_a_dtype_error_is_a_type_error():
    assert issubclass(DtypeError, TypeError)


def test_an_argument_error_is_a_value_error():
    assert issubclass(ArgumentError, ValueError)


@pytest.mark.case("P8")
@every_follower
def test_mixed_dtypes_are_named(key, name):
    arguments = tensors(key)
    message = objection(DtypeError, key, arguments | {name: arguments[name].float()})
    assert says(message, name, "torch.float32", "q", "torch.float64")


@pytest.mark.case("P8")
@every_follower
def test_mixed_devices_are_named(key, name):
    arguments = tensors(key)
    message = objection(ArgumentError, key, arguments | {name: arguments[name].to("meta")})
    assert says(message, name, "meta", "q", "cpu")


@pytest.mark.parametrize("key", FUNCTIONS)
def test_the_robot_follows_the_device_of_the_inputs(key):
    results = call(key, arm(), {name: x.to("meta") for name, x in tensors(key).items()})
    assert {y.device.type for y in results} == {"meta"}


@pytest.mark.parametrize("key", FUNCTIONS)
def test_what_is_not_a_robot_is_named(key):
    message = objection(ArgumentError, key, tensors(key), robot=torch.zeros(3, N))
    assert says(message, "robot", "torchdq.Robot", "Tensor")


MAKERS = {
    "DQRNEA": lambda robot: torchdq.DQRNEA(robot),
    "InverseDynamics": lambda robot: torchdq.InverseDynamics(robot, learn="mass"),
    "ForwardDynamics": lambda robot: torchdq.ForwardDynamics(robot),
    "ComputedTorque": lambda robot: torchdq.ComputedTorque(robot, 1.0, 1.0),
    "compile": lambda robot: torchdq.compile(robot, "inverse_dynamics"),
    "inverse_dynamics": lambda robot: torchdq.inverse_dynamics(robot, torch.zeros(N)),
}


@pytest.mark.parametrize("maker", MAKERS)
@pytest.mark.parametrize(
    "wrong",
    ["arm.urdf", Path("arm.urdf"), None],
    ids=str,
)
def test_what_is_made_of_no_robot_says_at_once_how_to_load_one(maker, wrong):
    with refused(ArgumentError) as raised:
        MAKERS[maker](wrong)
    assert says(str(raised.value), "robot", "torchdq.Robot")


def test_a_layer_in_the_place_of_a_robot_says_where_its_robot_is():
    with refused(ArgumentError):
        torchdq.ForwardDynamics(torchdq.DQRNEA(arm()))


@pytest.mark.parametrize("dtype", ["float32", torch.float32, np.float32], ids=str)
def test_a_dtype_may_be_given_by_its_name(dtype):
    assert torchdq.compile(arm(), "mass_matrix", dtype=dtype).dtype == torch.float32


@pytest.mark.parametrize("dtype", ["float16", "single precision", torch.int64, np.float16, 32, None], ids=str)
def test_a_dtype_that_is_not_of_the_package_is_named(dtype):
    with refused(DtypeError):
        torchdq.compile(arm(), "mass_matrix", dtype=dtype)


# --- gains -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain", ["kp", "kd"])
@pytest.mark.parametrize(
    ("wrong", "error", "found"),
    [
        (torch.ones(3, dtype=F64), ArgumentError, "(3,)"),
        (torch.ones(N, 1, dtype=F64), ArgumentError, "(7, 1)"),
        (torch.ones(4, N, dtype=F64), ArgumentError, "(4,)"),
        (torch.ones(N), DtypeError, "torch.float32"),
        ([9.0] * N, ArgumentError, "list"),
    ],
)
def test_a_gain_that_does_not_fit_is_named(gain, wrong, error, found):
    x = tensors("computed_torque")
    with pytest.raises(error) as raised:
        torchdq.computed_torque(arm(), **x, **({"kp": 9.0, "kd": 6.0} | {gain: wrong}))
    assert says(str(raised.value), gain) and found in str(raised.value)


@pytest.mark.parametrize("gain", ["kp", "kd"])
@pytest.mark.parametrize("wrong", [-1.0, torch.nan, [1.0, 2.0], torch.ones(1, N)], ids=str)
def test_a_controller_with_a_gain_that_does_not_fit_is_refused(gain, wrong):
    with pytest.raises(ArgumentError) as raised:
        torchdq.ComputedTorque(arm(), **({"kp": 9.0, "kd": 6.0} | {gain: wrong}))
    assert says(str(raised.value), gain, "7", str(wrong))


# --- names -----------------------------------------------------------------------------------------------------------


NAMES = {
    "frame, forward kinematics": (lambda: torchdq.forward_kinematics(arm(), torch.zeros(N), "panda_link77")),
    "frame, jacobian": (lambda: torchdq.jacobian(arm(), torch.zeros(N), "panda_link77")),
    "frame, tip": (lambda: arm().with_tip("panda_link77")),
    "frame, robot": (lambda: arm().frame("panda_link77")),
    "joint": (lambda: arm().joint_index("panda_joint77")),
    "shipped robot": (lambda: torchdq.robots.load("pandas")),
}
CLOSE = {"frame": "panda_link7", "joint": "panda_joint7", "shipped robot": "panda"}


@pytest.mark.parametrize("what", NAMES)
def test_an_unknown_name_is_a_key_error_with_the_closest_names(what):
    with pytest.raises(KeyError) as raised:
        NAMES[what]()
    kind = what.split(",")[0]
    message = str(raised.value)
    assert isinstance(raised.value, TorchdqError)
    assert says(message, kind, "did you mean") and f"'{CLOSE[kind]}'" in message


def test_a_name_like_no_other_is_answered_with_all_names():
    with pytest.raises(UnknownNameError) as raised:
        torchdq.robots.load("xyzzy")
    assert says(str(raised.value), "xyzzy", "two_link", "panda", "ur10e", "puma560")


@pytest.mark.parametrize("frame", [None, 3])
def test_a_frame_that_is_not_a_name_is_refused(frame):
    with refused(UnknownNameError):
        torchdq.jacobian(arm(), torch.zeros(N), frame)


def test_axes_other_than_body_and_world_are_refused():
    with pytest.raises(ArgumentError) as raised:
        torchdq.jacobian(arm(), torch.zeros(N), "tip", "local")
    assert says(str(raised.value), "expressed", "'body'", "'world'", "'local'")


@pytest.mark.parametrize("key", ["inverse_dynamics", "forward_dynamics", "computed_torque"])
def test_a_tip_wrench_on_a_robot_without_a_tip_is_refused_with_the_frames_it_has(key):
    message = objection(ArgumentError, key, tensors(key), arm().with_tip(None))
    assert says(message, "f_tip", "panda", *arm().frame_names)


def test_a_tip_wrench_on_a_robot_whose_tip_is_on_the_base_is_refused():
    message = objection(ArgumentError, "inverse_dynamics", tensors("inverse_dynamics"), arm().with_tip("base"))
    assert says(message, "tip", "base", "panda")


@pytest.mark.parametrize("module", ["DQRNEA", "ForwardDynamics", "ComputedTorque"])
@pytest.mark.parametrize("field", ["masses", "limits", "home", "viscous"])
def test_learning_what_the_robot_does_not_have_is_refused(module, field):
    gains = (9.0, 6.0) if module == "ComputedTorque" else ()
    with pytest.raises(ArgumentError) as raised:
        getattr(torchdq, module)(arm(), *gains, learn=("mass", field))
    assert says(str(raised.value), "learn", f"'{field}'", "'mass'", "'inertia'")


# --- robots ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("field", FIELDS)
def test_a_parameter_of_the_wrong_shape_is_named(field):
    robot = arm()
    wrong = torch.zeros(2, 2, 2, dtype=F64)
    with pytest.raises(ArgumentError) as raised:
        robot.replace(**{field: wrong})
    assert says(str(raised.value), field, "panda") and "found (2, 2, 2)" in str(raised.value)


@pytest.mark.case("P5", "P7")
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("dtype", [torch.int64, torch.float16, torch.bfloat16], ids=str)
def test_a_parameter_of_a_dtype_without_the_precision_is_named(field, dtype):
    robot = arm().replace(armature=torch.ones(N, dtype=F64), home=torch.zeros(N, dtype=F64))
    with pytest.raises(DtypeError) as raised:
        robot.replace(**{field: getattr(robot, field).to(dtype)})
    assert says(str(raised.value), field, "panda", "float32", "float64", str(dtype))


@pytest.mark.case("P5")
@pytest.mark.parametrize("module", ["DQRNEA", "ForwardDynamics"])
def test_a_module_in_half_precision_is_refused(module):
    x = torch.zeros(3, N)
    with refused(DtypeError):
        getattr(torchdq, module)(arm(), learn="mass").half()(x, x, x)


# --- require_finite --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_require_finite_names_the_argument_its_first_bad_entry_and_how_many_more(bad):
    x = torch.zeros(3, N)
    x[1, 4], x[2, 0] = bad, torch.nan
    with pytest.raises(ArgumentError) as raised:
        torchdq.require_finite(q=torch.zeros(N), qd=x)
    assert says(str(raised.value), "qd", str(bad), "1 more") and "(1, 4)" in str(raised.value)


def test_require_finite_lets_finite_and_absent_arguments_pass():
    assert torchdq.require_finite(q=torch.full((2,), 1e38), qd=None, qdd=torch.zeros(0, N)) is None


def test_require_finite_names_what_is_not_a_tensor():
    with pytest.raises(ArgumentError) as raised:
        torchdq.require_finite(q=[0.0])
    assert says(str(raised.value), "q", "tensor", "list")


# --- nothing is lost -------------------------------------------------------------------------------------------------


def remember(arguments):
    """Values and version counters, the latter counting the writes to a tensor."""
    return {name: (x.detach().clone(), x._version) for name, x in arguments.items()}


def untouched(arguments, before):
    return [
        name for name, x in arguments.items() if not (torch.equal(x, before[name][0]) and x._version == before[name][1])
    ]


@pytest.mark.parametrize("key", FUNCTIONS)
def test_inputs_are_never_written_to(key):
    arguments = tensors(key)
    before = remember(arguments)
    call(key, arm(), arguments)
    assert untouched(arguments, before) == []


@pytest.mark.parametrize("key", FUNCTIONS)
def test_the_robot_is_never_written_to(key):
    robot = arm().replace(armature=torch.ones(N, dtype=F64), home=torch.ones(N, dtype=F64))
    fields = {field: getattr(robot, field) for field in FIELDS}
    before = remember(fields)
    call(key, robot, tensors(key))
    assert untouched(fields, before) == []


@pytest.mark.parametrize("key", FUNCTIONS)
def test_results_are_tensors_of_their_own(key):
    """Writing to a result must not change an input, the robot, another entry of the result, or the next call."""
    robot, arguments = arm(), tensors(key)
    robot = robot.replace(armature=torch.ones(N, dtype=F64), home=torch.ones(N, dtype=F64))
    fields = {field: getattr(robot, field) for field in FIELDS}
    before, expected = remember(arguments | fields), [y.clone() for y in call(key, robot, arguments)]
    for y in call(key, robot, arguments):
        y.fill_(7.0)
    assert untouched(arguments | fields, before) == []
    assert all(torch.equal(a, b) for a, b in zip(call(key, robot, arguments), expected, strict=True))


@pytest.mark.parametrize("key", FUNCTIONS)
def test_backward_writes_to_nothing_but_gradients(key):
    arguments = {name: x.requires_grad_() for name, x in tensors(key).items()}
    before = remember(arguments)
    sum(y.sum() for y in call(key, arm(), arguments)).backward()
    assert untouched(arguments, before) == []
    assert bool(arguments["q"].grad.isfinite().all())


def test_a_module_does_not_write_to_the_robot_it_is_made_of():
    robot = arm()
    before = remember({field: getattr(robot, field) for field in ("mass", "com", "inertia")})
    module = torchdq.DQRNEA(robot, learn=("mass", "com", "inertia"))
    with torch.no_grad():
        for p in module.parameters():
            p.add_(1.0)
    assert untouched({field: getattr(robot, field) for field in before}, before) == []


# --- tensors that are not dense ---------------------------------------------------------------------------------------

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
    uses = {
        "q": lambda x: torchdq.inverse_dynamics(robot, x),
        "qd": lambda x: torchdq.inverse_dynamics(robot, plain, x, backend="eager"),
        "q ": lambda x: torchdq.compile(robot, "mass_matrix", dtype=plain.dtype)(x),
        "q  ": lambda x: scene.start(x),
        "torque": lambda x: scene.step(scene.start(plain), x),
        "mass of robot 'two_link'": lambda x: robot.replace(mass=x),
        "coefficient of Viscous": lambda x: Scene(robot, (effects.Viscous(x),)),
        r"train\.tau": lambda x: fit(torchdq.DQRNEA(robot, learn="mass"), tables._replace(tau=x), steps=1),
        "tau": lambda x: identify(robot, Samples(plain, plain, plain, x)),
    }
    for use in uses.values():
        with contextlib.suppress(ArgumentError):  # samples that are all the same may be refused
            use(plain)
        with refused(ArgumentError):
            use(other)
    with refused(torchdq.TorchdqError):
        robot.replace(damping=OTHERS["mkldnn"](plain) if layout == "mkldnn" else other)


# --- torch's default device -------------------------------------------------------------------------------------------


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
    with torch.device("meta"):
        for name in torchdq.robots.names():
            assert torchdq.robots.load(name).mass.device.type == "cpu"
        here = torchdq.robots.load("two_link")
        torch.testing.assert_close(torchdq.inverse_dynamics(here, q), torchdq.inverse_dynamics(robot, q))
        assert here.lock({"joint1": 0.5}).n == 1 and here.replace(gravity=(0 * here.gravity)).bake().tip == "tip"
        for part in parts:
            scene = Scene(here, (part,))
            assert scene.step(scene.start(q)).q.device.type == "cpu"
        with refused(ArgumentError):
            Scene(here, (effects.Payload(1.0, inertia=(1.0, 0.0, 0.0, 9.0, 0.0, 1.0)),))
        layer = torchdq.DQRNEA(here, learn=("mass", "inertia", "friction", "offset"))
        assert layer(q).device.type == "cpu"
