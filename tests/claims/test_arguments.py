"""Bad input is refused by name, and good input comes back untouched.

Functions, control laws and effects declare what they take as fields. Every field is wrong in every way here; the error
must be one of the package's, name the argument, and say what was expected and what was found.
"""

import contextlib
import dataclasses
import inspect
import math
import re
from functools import cache, partial

import numpy as np
import pytest
import torch
from effect_harness import EVERY, home_of
from helpers import EVERYTHING, all_in_one, thinned
from messages import refused
from robots import on_free_base

import torchdq
from torchdq import ArgumentError, DtypeError, Scene, TorchdqError, dq, effects, floating
from torchdq.functions.catalogue import FLOATING, RECIPES
from torchdq.functions.signature import Field, joints
from torchdq.learning import Samples, fit, identify
from torchdq.robot.fields import trailing
from torchdq.scene import controllers

F64 = torch.float64
N = 2
FIELDS = ("mass", "com", "inertia", "gravity", "armature", "home", "X_PB_home", "screw")
LAWS = {getattr(controllers, name).named(): getattr(controllers, name) for name in controllers.__all__ if name != "Law"}
OPTIONS = {"axes": ("x", "y"), "frame": "tip"}  # of a planar arm
OPTIONS |= {"points": "tip", "objects": (torchdq.objects.Ball("ball", 1.0, radius=0.1),), "own": False}
NOT_DYNAMICS = {"dq", "robots", "require_finite", "convert", "compile", "backend", "clear_caches", "recommend_settings"}
NOT_DYNAMICS |= {
    "external_wrenches",
    "inverse_kinematics",
    *("closed", "closure_errors", "constrained_inverse_dynamics"),
}  # a dictionary of tensors; rows have conditions of their own; robots with loops


def face(key):
    """Public function of a name in the catalogue, or of a law."""
    owner, name = (floating, key.removeprefix(FLOATING)) if key.startswith(FLOATING) else (torchdq, key)
    return None if name in NOT_DYNAMICS else getattr(owner, name, None)


def fields_of(key):
    """Fields of a function that are arguments of its face, by name."""
    if key not in LAWS:
        options = [field for field in RECIPES[key].options if field.name == "expressed"]
        known = [field for field in RECIPES[key].arguments if field.name != "sizes"]  # which objects have
        return {field.name: field for field in (*known, *options)}
    law = LAWS[key]
    goal = [Field(name, axes, name in law.OPTIONAL) for name, axes in law.GOAL.items()]
    wrenches, own = [Field(name, (6,), optional=True) for name in law.WRENCHES], {**law.PARAMETERS, **law.OPTIONS}
    return {field.name: field for field in (*joints("q", "qd"), *goal, *wrenches, *own.values())}


FUNCTIONS = [key for key in (*RECIPES, *LAWS) if face(key)]
FIXED = [key for key in FUNCTIONS if not key.startswith(FLOATING)]
every_function, of_fixed_bases = all_in_one(FUNCTIONS), all_in_one(FIXED)


@cache
def arm():
    return torchdq.robots.load("two_link")


@cache
def full():
    """Arm with every optional tensor."""
    return arm().replace(armature=torch.ones(N, dtype=F64), home=torch.ones(N, dtype=F64))


def robot_of(key):
    return floating_arm() if key.startswith(FLOATING) else arm()


@cache
def floating_arm():
    return on_free_base(arm())


UNIT = {"X_WB": dq.normalize, "X_WO": dq.normalize, "normal": lambda x: x / x.norm(dim=-1, keepdim=True)}


def tensors(key, batch=(3,)):
    """Inputs of a function, and those parameters of a law that are rows of joints."""
    g, sizes = torch.Generator().manual_seed(0), {**robot_of(key).sizes, "axes": 2, "objects": 1}
    kept = {name: field for name, field in fields_of(key).items() if field.kind == "input" or name == "q_null"}
    found = {name: torch.randn(*batch, *trailing(x.axes, sizes), dtype=F64, generator=g) for name, x in kept.items()}
    return {name: UNIT[name](x) if name in UNIT else x for name, x in found.items()}


def call(key, robot, arguments):
    """Results of a function as a tuple."""
    known = inspect.signature(face(key)).parameters
    options = {name: x for name, x in OPTIONS.items() if name in known}
    gains = {
        name: 9.0
        for name, x in known.items()
        if x.default is x.empty and name in getattr(LAWS.get(key), "PARAMETERS", ())
    }
    result = face(key)(robot, **{**options, **gains, **arguments})
    return (result,) if isinstance(result, torch.Tensor) else tuple(x for x in result if isinstance(x, torch.Tensor))


def require_named(error, parts, function, *arguments, **named):
    """The error of the package that a function must raise holds every part, names as whole words."""
    with pytest.raises(error) as raised:
        function(*arguments, **named)
    message = str(raised.value)
    assert isinstance(raised.value, TorchdqError)
    assert [part for part in parts if not re.search(rf"(?<!\w){re.escape(part)}(?!\w)", message)] == [], message


def test_every_public_function_takes_the_fields_that_it_declares():
    public = {name for name in dir(torchdq) if inspect.isfunction(getattr(torchdq, name))} - NOT_DYNAMICS
    assert public == {key for key in FUNCTIONS if not key.startswith(FLOATING)}
    for key in FUNCTIONS:
        taken = set(inspect.signature(face(key)).parameters) - {"robot", "backend", "precision"}
        assert set(fields_of(key)) <= taken <= {*fields_of(key), *OPTIONS, "limits", "of"}, key


def test_errors_are_those_that_python_has_for_them():
    assert issubclass(DtypeError, TypeError) and issubclass(ArgumentError, ValueError)
    assert issubclass(torchdq.UnknownNameError, KeyError)


# --- tensors ---------------------------------------------------------------------------------------------------------

# of all but the first tensor, which decides the batch, the dtype and the device
UNLIKE = {
    "batch": (ArgumentError, lambda x: x[:1].expand(4, *x.shape[1:]), "broadcast", "(3,)", "(4,)"),
    "dtype": (DtypeError, torch.Tensor.float, "torch.float32", "torch.float64"),
    "device": (ArgumentError, lambda x: x.to("meta"), "meta", "cpu"),
}


@pytest.mark.case("P5", "P7", "P8", "P14")
@every_function
def test_every_field_of_a_function_is_refused_by_name_in_every_way(key):
    given = tensors(key)
    for name, field in fields_of(key).items():
        for way, wrong in field.wrong(given.get(name)):
            if name in given or "numbers" not in way:  # gains have the axes of the joints
                arguments = {**given, name: wrong}
                found = str(tuple(wrong.shape)) if "numbers" in way else "found"
                require_named(TorchdqError, [name, found], call, key, robot_of(key), arguments)
    first, *others = given
    for error, change, *parts in UNLIKE.values():
        for name in others:
            require_named(error, [name, first, *parts], call, key, robot_of(key), given | {name: change(given[name])})


@all_in_one(LAWS)
def test_every_parameter_of_a_law_is_refused_by_name_in_every_way(key):
    """By the layer, and in one way of each by the controller of a scene, as by the function."""
    homes = (torchdq.nn.Control, lambda robot, law: Scene(robot, controller=law))
    law, axes = LAWS[key], {"axes": ("x", "y")} if "axes" in inspect.signature(LAWS[key]).parameters else {}
    for name, field in {**law.PARAMETERS, **law.OPTIONS}.items():
        for k, (_, wrong) in enumerate(field.wrong()):
            given = {**axes, **{x.name: 9.0 for x in dataclasses.fields(law) if x.default is x.default_factory}}
            given |= {"q_null": 0.1} if name == "k_null" else {}
            made = partial(law, **{**given, name: wrong})
            for home in homes if EVERYTHING or not k else homes[:1]:
                require_named(TorchdqError, [name, "found"], lambda home=home, made=made: home(arm(), made()))


PARAMETERS = [
    (kind, name) for kind in EVERY for name in (*getattr(effects, kind).PARAMETERS, *getattr(effects, kind).OPTIONS)
]


@pytest.mark.case("P5", "P7", "P8")
@all_in_one(PARAMETERS)
def test_every_parameter_of_an_effect_is_refused_by_name_in_every_way(at):
    """Also one bad entry among good ones, in a batch, in both precisions."""
    kind, name = at
    effect, robot = EVERY[kind]()[0], home_of(kind)
    field = {**effect.PARAMETERS, **effect.OPTIONS}[name]
    good = getattr(effect, name)
    ways = [x for _, x in field.wrong(good.detach() if field.kind == "parameter" else None)]
    for bad in [x for x in field.check.wrong() if isinstance(x, float) and field.kind == "parameter"]:
        rows = good.detach().expand(4, 3, *good.shape).clone()
        rows[(2, 1, *(0,) * good.ndim)] = bad
        ways += [rows, rows.float()]
    for wrong in ways:
        require_named(
            ArgumentError, [f"{name} of {kind}", "found"], dataclasses.replace(effect, **{name: wrong}).resolved, robot
        )


@all_in_one([torchdq.DQRNEA, torchdq.ForwardDynamics, partial(torchdq.ComputedTorque, kp=9.0, kd=6.0)])
def test_every_option_of_a_layer_is_refused_by_name_in_every_way(layer):
    for name, field in getattr(layer, "func", layer).OPTIONS.items():
        for _, wrong in field.wrong():
            require_named(ArgumentError, [name, "found"], layer, arm(), **{name: wrong})


# parameters of laws and effects that may be negative, must be positive, or may be infinite
NEGATIVE = {
    *("warming", "rest", "lower", "upper", "sine", "cosine", "acceleration", "com", "height", "normal", "anchor")
}
NEGATIVE |= {"Payload.inertia", "Bias.position", "Bias.velocity", "q_null"}
ABOVE_ZERO = {*("sign_width", "step", "Stribeck.velocity", "LuGre.velocity", "deflection", "period", "speed")}
ABOVE_ZERO |= {
    "Servo.limit",
    "Elastic.inertia",
    "Closures.stiffness",
    "rotational_stiffness",
    "operational_space_control.damping",
}
INFINITE = {"limit", "limits", "stall", "speed", "lower", "upper"}


def test_what_divides_must_be_positive_limits_may_be_infinite_and_little_may_be_negative():
    for owner, of in {**{kind: getattr(effects, kind) for kind in EVERY}, **LAWS}.items():
        for name, field in of.PARAMETERS.items():
            names, check = {name, f"{owner}.{name}"}, field.check
            assert check.signed == bool(names & NEGATIVE), names
            assert check.open == bool(names & ABOVE_ZERO), names
            assert check.infinite == bool(names & INFINITE), names
            assert check.below == (1 if (owner, name) == ("LoadDependent", "coefficient") else math.inf)
            assert check.least == (1 if (owner, name) == ("LuGre", "ratio") else -math.inf if check.signed else 0)


@all_in_one([at for at in PARAMETERS if at[1] in getattr(effects, at[0]).PARAMETERS and at[1] != "normal"])
def test_a_tensor_parameter_of_an_effect_may_be_as_large_as_is_said(at):
    kind, name = at
    effect, names = EVERY[kind]()[0], {name, f"{kind}.{name}"}
    allowed = [0.0] * (not names & ABOVE_ZERO and at != ("LuGre", "ratio"))
    allowed += [-0.7] * bool(names & NEGATIVE)
    # an infinite stall torque is a number
    allowed += [-math.inf if name == "lower" else math.inf] * bool(names & INFINITE - {"stall"})
    for x in allowed:
        pair = getattr(effect, "ORDERED", ())  # neither is above the other
        given = torch.full_like(getattr(effect, name), x)
        found = dataclasses.replace(effect, **dict.fromkeys(pair if name in pair else [name], given))
        assert torch.equal(getattr(found.resolved(home_of(kind)), name), getattr(found, name)), x


@every_function
def test_a_missing_tensor_is_named_unless_it_may_be_absent(key):
    for name in tensors(key):
        arguments = tensors(key) | {name: None}
        if fields_of(key)[name].optional:
            assert all(bool(y.isfinite().all()) for y in call(key, robot_of(key), arguments))
        else:
            require_named(ArgumentError, [name, "tensor", "NoneType"], call, key, robot_of(key), arguments)


@of_fixed_bases
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
@pytest.mark.parametrize("key", thinned(FIXED, ("inverse_dynamics",)))
def test_a_function_is_exported_for_any_batch_with_what_all_rows_share(key):
    robot, of_all = arm().lock({"joint2": 0.5}), {x.name for x in fields_of(key).values() if x.axes != ("n",)}
    given = {name: x[0] if name in of_all else x[:, :1] for name, x in tensors(key).items()}  # never called with
    given |= {name: x[:1] for name, x in given.items() if name == "f_ext" or fields_of(key)[name].axes == ("axes",)}

    class Traced(torch.nn.Module):
        def forward(self, *x):
            return call(key, robot, dict(zip(given, x, strict=True)) | one_axis)

    one_axis = {"axes": ("x",)} if "axes" in inspect.signature(face(key)).parameters else {}
    shapes = [None if name in of_all else {0: torch.export.Dim("batch")} for name in given]
    torch.export.export(Traced(), tuple(given.values()), dynamic_shapes=(tuple(shapes),))  # raises for guarded sizes


@of_fixed_bases
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


@of_fixed_bases
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


@of_fixed_bases
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
