"""Every effect does what its formula says, checked against formulas written down here in numpy.

An explicit Euler step of one second adds the accelerations to the velocities, so a scene's accelerations are compared
with pinocchio's under the torques, wrenches or changed bodies that the effect stands for. Tolerances are roundings of
the largest torque, turned into accelerations by the inverse of the mass matrix.
"""

import dataclasses
import itertools
import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one
from oracles import Case, random_tree, shipped, states
from scipy import stats

import torchdq
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.envs import Scene, State, effects
from torchdq.errors import NumberError
from torchdq.scene.integrators import ExplicitEuler, LinearlyImplicit, RungeKutta4, SemiImplicitEuler

EPS = 2.0**-52
CASES = {"two_link": shipped("two_link"), "tree": random_tree(3, seed=6, armature=True), "panda": shipped("panda")}
SAMPLES = 5


def double(x):
    return torch.as_tensor(x, dtype=torch.float64)


def close(found, expected, size):
    """Whether every entry is off by no more than some roundings of a size."""
    return bool((np.abs(np.asarray(found) - np.asarray(expected)) <= 1000 * EPS * np.asarray(size)).all())


# --- pinocchio's accelerations ---------------------------------------------------------------------------------------


class Bare(NamedTuple):
    """A robot in random states, and pinocchio's model of it without gravity and rotors."""

    case: Case
    model: pin.Model
    q: torch.Tensor
    qd: torch.Tensor
    u: torch.Tensor

    @property
    def robot(self):
        return self.case.robot

    @property
    def n(self):
        return self.case.robot.n


@cache
def bare(name):
    case = CASES[name]
    model = pin.Model(case.model)
    model.gravity.linear = np.zeros(3)
    model.armature = np.zeros(model.nv)
    s = states(case.robot, batch=SAMPLES)
    return Bare(case, model, s.q, s.qd, 3.0 * s.qdd)


def accelerations(b, effect, *, u=None, **inputs):
    """A scene's accelerations with an effect, or several."""
    scene = Scene(b.robot, effect if isinstance(effect, tuple) else (effect,), integrator=ExplicitEuler(), dt=1.0)
    state = scene.start(b.q, b.qd)
    return (scene.step(state, torque=b.u if u is None else u, **inputs).qd - b.qd).numpy()


class Expected(NamedTuple):
    accelerations: np.ndarray  # [samples, n]
    size: np.ndarray  # that roundings are relative to


def pinocchio(b, torques=0.0, model=None, implicit=None):
    """Accelerations with torques on top of the commanded ones, or another model; `model` may be one per sample.

    `implicit` [samples, n] is added to the diagonal of the mass matrix.
    """
    found, sizes = [], []
    order = b.case.order
    u = b.u.numpy() + torques
    for k in range(SAMPLES):
        m = b.model if model is None else model[k] if isinstance(model, list) else model
        data = m.createData()
        q, v, tau = (
            b.case.configuration(b.q[k]),
            b.case.velocity(b.qd[k]),
            b.case.velocity(np.broadcast_to(u[k], b.n)),
        )
        M = pin.crba(m, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        if implicit is not None:
            M = M + np.diag(b.case.velocity(implicit[k]))
        h = pin.nle(m, data, q, v)
        found.append(np.linalg.solve(M, tau - h)[order])
        inverse = np.abs(np.linalg.inv(M)).sum(-1)[order]
        sizes.append(inverse * (np.abs(tau).max() + np.abs(h).max() + 1.0) + np.abs(b.qd[k].numpy()))
    return Expected(np.array(found), np.array(sizes))


def agrees(b, effect, *, torques=0.0, model=None, **inputs):
    expected = pinocchio(b, torques, model)
    return close(accelerations(b, effect, **inputs), *expected)


@pytest.mark.parametrize("name", CASES)
def test_a_bare_scene_moves_as_rigid_bodies_without_gravity_and_rotors(name):
    assert agrees(bare(name), ())


# --- forms a parameter may have --------------------------------------------------------------------------------------

FORMS = ("number", "list", "tensor", "batched")


class Given(NamedTuple):
    parameter: object  # as an effect takes it
    values: np.ndarray  # [samples, size], or [samples] of a parameter that is one number


def given(form, low, high, size, seed):
    """Random values between two bounds in one of the forms of a parameter; size None: it is a single number."""
    rng = np.random.default_rng([20260701, seed])
    trailing = () if size is None else (size,)
    if form == "batched":
        values = rng.uniform(low, high, (SAMPLES, *trailing))
        return Given(double(values), values)
    values = rng.uniform(low, high) * np.ones(trailing) if form == "number" else rng.uniform(low, high, trailing)
    parameter = {"number": float(values.flat[0]) if trailing else float(values), "list": values.tolist()}.get(
        form, double(values)
    )
    return Given(parameter, np.broadcast_to(values, (SAMPLES, *trailing)))


def forms_of(ranges, form, n, sizes=None):
    """Parameters of an effect by name, and their values."""
    found = {
        name: given(form, low, high, (sizes or {}).get(name, n), seed)
        for seed, (name, (low, high)) in enumerate(ranges.items())
    }
    return {name: g.parameter for name, g in found.items()}, {name: g.values for name, g in found.items()}


# --- joints ----------------------------------------------------------------------------------------------------------


def limits_impedance(q, qd, lower, upper, stiffness, dissipation):
    below, above = np.maximum(lower - q, 0), np.maximum(q - upper, 0)
    growing = np.where(below > 0, qd <= 0, qd >= 0)
    beyond = below + above
    return stiffness * dissipation * beyond * growing, stiffness * (beyond > 0), np.clip(q, lower, upper)


def over_width(qd, width):
    return 1.0 / np.sqrt(qd**2 + np.broadcast_to(width, (SAMPLES,))[:, None] ** 2)


# damping, stiffness and rest by parameters
JOINT = {
    "Viscous": ({"coefficient": (0.1, 2.0)}, lambda q, qd, coefficient: (coefficient, 0 * q, 0 * q)),
    "Coulomb": (
        {"coulomb": (0.1, 2.0), "sign_width": (0.1, 1.0)},
        lambda q, qd, coulomb, sign_width: (coulomb * over_width(qd, sign_width), 0 * q, 0 * q),
    ),
    "Quadratic": ({"coefficient": (0.1, 2.0)}, lambda q, qd, coefficient: (coefficient * np.abs(qd), 0 * q, 0 * q)),
    "Directional": (
        {"forward": (0.5, 1.0), "backward": (1.0, 2.0), "sign_width": (0.1, 1.0)},
        lambda q, qd, forward, backward, sign_width: (
            0.5
            * (forward + backward + (forward - backward) * qd * over_width(qd, sign_width))
            * over_width(qd, sign_width),
            0 * q,
            0 * q,
        ),
    ),
    "Stribeck": (
        {"coulomb": (0.5, 1.0), "static": (1.0, 2.0), "velocity": (0.5, 2.0), "sign_width": (0.1, 1.0)},
        lambda q, qd, coulomb, static, velocity, sign_width: (
            (coulomb + (static - coulomb) / (1 + (qd / velocity) ** 2)) * over_width(qd, sign_width),
            0 * q,
            0 * q,
        ),
    ),
    "Spring": (
        {"stiffness": (1.0, 20.0), "rest": (-1.0, 1.0)},
        lambda q, qd, stiffness, rest: (0 * q, stiffness, rest),
    ),
    "Servo": ({"kp": (1.0, 20.0), "kd": (0.1, 2.0)}, lambda q, qd, kp, kd: (kd, kp, TARGET[:, : q.shape[-1]])),
    "JointLimits": (
        {"lower": (-0.5, -0.1), "upper": (0.1, 0.5), "stiffness": (10.0, 50.0), "dissipation": (0.1, 2.0)},
        limits_impedance,
    ),
}
TARGET = np.random.default_rng(5).normal(size=(SAMPLES, 7))


def joint_effect(b, kind, form):
    """An effect, its inputs, and the damping, stiffness and rest that its formula gives in the states."""
    ranges, formula = JOINT[kind]
    if form == "list" and "sign_width" in ranges:  # a single number has no list
        ranges = {**ranges, "sign_width": ranges["sign_width"]}
    parameters, values = forms_of(ranges, form, b.n, {"sign_width": None})
    if form == "list" and "sign_width" in parameters:
        parameters["sign_width"] = float(values["sign_width"][0])
    inputs = {"target": double(TARGET[:, : b.n])} if kind == "Servo" else {}
    return getattr(effects, kind)(**parameters), inputs, formula(b.q.numpy(), b.qd.numpy(), **values)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", JOINT)
@pytest.mark.parametrize("name", CASES)
def test_an_effect_at_the_joints_adds_the_torques_of_its_formula(name, kind, form):
    b = bare(name)
    effect, inputs, (damping, stiffness, rest) = joint_effect(b, kind, form)
    torques = -damping * b.qd.numpy() - stiffness * (b.q.numpy() - rest)
    assert np.abs(torques).max() > 0.1
    assert agrees(b, effect, torques=torques, **inputs)


@pytest.mark.parametrize("form", ["list", "batched"])
@pytest.mark.parametrize("kind", JOINT)
@pytest.mark.parametrize("name", CASES)
def test_the_implicit_integrator_takes_the_state_at_the_end_of_the_step(name, kind, form):
    """(M + h D + h^2 K) (v' - v) = h (tau - nle - D v - K (q - rest) - h K v)."""
    b, h = bare(name), 0.05
    effect, inputs, (D, K, rest) = joint_effect(b, kind, form)
    q, qd = b.q.numpy(), b.qd.numpy()
    D, K = np.broadcast_to(D, q.shape), np.broadcast_to(K, q.shape)
    expected = pinocchio(b, -D * qd - K * (q - rest) - h * K * qd, implicit=h * D + h**2 * K)
    scene = Scene(b.robot, (effect,), integrator=LinearlyImplicit(), dt=h)
    after = scene.step(scene.start(b.q, b.qd), torque=b.u, **inputs)
    assert close((after.qd - b.qd).numpy() / h, expected.accelerations, expected.size + np.abs(qd) / h)
    assert close(after.q.numpy(), q + h * after.qd.numpy(), np.abs(q) + np.abs(h * after.qd.numpy()))


def test_effects_at_the_joints_add_up():
    b = bare("tree")
    parts = [joint_effect(b, kind, "list") for kind in JOINT]
    torques = sum(-D * b.qd.numpy() - K * (b.q.numpy() - rest) for _, _, (D, K, rest) in parts)
    inputs = {name: x for _, given, _ in parts for name, x in given.items()}
    assert agrees(b, tuple(effect for effect, _, _ in parts), torques=torques, **inputs)


URDF = """
<robot name="described">
  <link name="base"/>
  {links}
</robot>"""
LINK = """
  <link name="l{i}"><inertial><origin xyz="0.1 0 -0.3"/><mass value="1.5"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="l{i}"/>
    <origin xyz="0 0 -0.5" rpy="0.3 0 0.2"/><axis xyz="0 1 0"/>
    <limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="{velocity}"/>
    <dynamics damping="{damping}" friction="{friction}"/></joint>"""
DESCRIBED = [
    {"lower": -0.4, "upper": 0.3, "effort": 4.0, "velocity": 2.0, "damping": 0.5, "friction": 0.25},
    {"lower": -1.0, "upper": 0.1, "effort": 2.0, "velocity": 3.0, "damping": 0.125, "friction": 0.75},
]


@cache
def described():
    """Robot of a file that gives damping, friction and limits."""
    links = [LINK.format(i=i, parent=f"l{i - 1}" if i else "base", **joint) for i, joint in enumerate(DESCRIBED)]
    return torchdq.Robot.from_urdf(URDF.format(links="".join(links)))


def described_as(key):
    return [joint[key] for joint in DESCRIBED]


@pytest.mark.parametrize(
    "silent, spoken",
    [
        (effects.Viscous(), effects.Viscous(described_as("damping"))),
        (effects.Coulomb(sign_width=0.1), effects.Coulomb(described_as("friction"), sign_width=0.1)),
        (effects.Stribeck(static=1.0), effects.Stribeck(described_as("friction"), 1.0)),
        (effects.JointLimits(), effects.JointLimits(described_as("lower"), described_as("upper"))),
        (effects.Saturation(), effects.Saturation(described_as("effort"))),
        (effects.TorqueSpeed(), effects.TorqueSpeed(described_as("effort"), described_as("velocity"))),
        (effects.Gravity(), effects.Gravity((0.0, 0.0, -9.81))),
    ],
    ids=lambda effect: type(effect).__name__,
)
def test_what_is_not_given_is_as_the_description_says(silent, spoken):
    robot = described()
    q, qd, u = double([[0.5, -1.2], [0.1, 0.05]]), double([[1.0, -2.0], [0.5, 0.1]]), double([10.0, -7.0])
    found = [scene.step(scene.start(q, qd), u) for scene in (Scene(robot, (silent,)), Scene(robot, (spoken,)))]
    bare_one = Scene(robot).step(State(q, qd), u)
    assert torch.equal(found[0].qd, found[1].qd)
    assert not torch.equal(found[0].qd, bare_one.qd)


@pytest.mark.parametrize("effect", [effects.RotorInertia(), effects.Elastic(10.0)], ids=["RotorInertia", "Elastic"])
def test_what_neither_the_description_says_is_asked_for(effect):
    with pytest.raises(torchdq.ArgumentError, match=f"inertia of {type(effect).__name__} must be given"):
        Scene(described(), (effect,))


@pytest.mark.parametrize("name", ["gravity", "armature"])
@pytest.mark.parametrize("batched", [False, True], ids=["one", "batched"])
def test_a_robot_whose_gravity_or_rotors_vary_keeps_its_tensors(name, batched):
    b = bare("tree")
    value = getattr(b.robot, name)
    value = (value * double([[1.0], [1.5], [2.0], [2.5], [3.0]]) if batched else value.clone()).requires_grad_()
    changed = b.robot.replace(**{name: value})
    silent, spoken = {
        "gravity": (effects.Gravity(), effects.Gravity(value)),
        "armature": (effects.RotorInertia(), effects.RotorInertia(value)),
    }[name]
    found = [
        torch.autograd.grad(Scene(changed, (effect,)).step(State(b.q, b.qd), b.u).qd.square().sum(), value)[0]
        for effect in (silent, spoken)
    ]
    assert found[0].abs().sum() > 0
    assert torch.equal(*found)


# --- what parameters may be ------------------------------------------------------------------------------------------

ROOM = {"normal": (0.0, 0.0, 1.0), "ratio": (1.5, 1.5)}  # values of parameters that a number alone cannot be
NEEDED = {
    "Stribeck": {"coulomb": 0.0, "static": 1.0},
    "Quadratic": {"coefficient": 1.0},
    "Directional": {"forward": 1.0, "backward": 1.0},
    "LoadDependent": {"coefficient": 0.5},
    "Ripple": {"period": 1.0, "sine": 1.0, "cosine": 1.0},
    "JointLimits": {"lower": -math.inf, "upper": math.inf},
    "Payload": {"mass": 1.0},
    "Elastic": {"stiffness": 1.0, "inertia": 1.0},
}
PARAMETERS = [
    (kind, name)
    for kind in map(effects.__dict__.get, effects.__all__)
    for name in kind.SHAPES
    if kind is not effects.Effect and (kind, name) != (effects.Payload, "inertia")  # a body must exist as a whole
]


def made(kind, name, value):
    """Effect with one parameter given, and those that no description of `described` has."""
    needed = {field.name: 1.0 for field in dataclasses.fields(kind) if field.default is dataclasses.MISSING}
    return kind(**{**needed, **NEEDED.get(kind.__name__, {}), name: value}).resolved(described())


@pytest.mark.parametrize("kind, name", PARAMETERS, ids=lambda x: x if isinstance(x, str) else x.__name__)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -1.0, 0.0])
def test_a_parameter_that_is_a_tensor_is_checked_like_numbers(kind, name, bad):
    """One bad entry among good ones, in a batch, in both precisions."""
    size = math.prod(2 if isinstance(axis, str) else axis for axis in kind.SHAPES[name])
    good = double(ROOM.get(name, [0.5] * size))
    numbers = good.tolist()
    numbers[-1] = bad
    try:
        made(kind, name, numbers if kind.SHAPES[name] else bad)
        message = None
    except torchdq.ArgumentError as error:
        message = str(error)
    unbounded, signed, dividing = (name in group for group in (kind.UNBOUNDED, kind.SIGNED, kind.DIVIDING))
    allowed = {math.nan: False, math.inf: unbounded, -1.0: signed, 0.0: not dividing and name not in ROOM}
    assert (message is None) == allowed[bad]
    rows = good.expand(4, 3, size).clone()
    rows[2, 1] = double(numbers)
    for dtype in (torch.float64, torch.float32):
        value = (rows if kind.SHAPES[name] else rows[..., 0]).to(dtype)
        if message is None and (kind, name, bad) != (effects.TorqueSpeed, "stall", math.inf):
            assert made(kind, name, value).tensors()[name].shape == value.shape
            continue
        with pytest.raises(torchdq.ArgumentError, match=f"{name} of {kind.__name__} must"):
            made(kind, name, value)


def test_parameters_without_values_are_taken_as_they_are():
    """Inside a transform of torch there is nothing to read."""
    b = bare("two_link")

    def after(d):
        return Scene(b.robot, (effects.Viscous(d),)).step(State(b.q[0], b.qd[0])).qd

    d = double([[0.1, 0.2], [0.3, 0.4]])
    found = torch.func.vmap(torch.func.jacrev(after))(d)
    assert torch.allclose(found[1], torch.func.jacrev(after)(d[1]), rtol=1e-12)


# --- what limits promise ---------------------------------------------------------------------------------------------


def limit_torque(q, qd, **parameters):
    """Torque of limits at -1 and 1 on a joint, from the acceleration it causes alone."""
    x = [double([[float(value), 0.0]]) for value in (q, qd)]
    robot = CASES["two_link"].robot
    made = Scene(robot, (effects.JointLimits(-1.0, 1.0, **parameters),), integrator=ExplicitEuler(), dt=1.0)
    difference = made.step(State(*x)).qd - Scene(robot, integrator=ExplicitEuler(), dt=1.0).step(State(*x)).qd
    return float((torchdq.mass_matrix(robot, x[0])[0] @ difference[0])[0])


@pytest.mark.parametrize("qd", [-3.0, 0.0, 3.0])
@pytest.mark.parametrize("q", [-1.0, -0.999, 0.0, 0.7, 1.0])
def test_limits_do_nothing_within_them(q, qd):
    assert limit_torque(q, qd) == 0.0


@pytest.mark.case("T11")
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("qd", [-100.0, -1.0, 0.0, 1.0, 100.0])
def test_limits_never_pull(side, qd):
    torque = limit_torque(side * 1.01, qd, dissipation=5.0)
    assert torque * side < 0
    assert abs(torque) >= 1e4 * 0.01 * (1 - 1e-9)  # at least that of the spring
    assert (abs(torque) > 1e4 * 0.01 * (1 + 1e-9)) == (qd * side > 0)  # damped only while it goes deeper


@pytest.mark.case("T11")
def test_limits_are_continuous_at_the_limit():
    sizes = [abs(limit_torque(1.0 + depth, 2.0)) for depth in (1e-3, 1e-6, 1e-9)]
    assert sizes[0] == pytest.approx(1e3 * sizes[1], rel=1e-3)
    assert sizes[2] < 1e-4


@pytest.mark.filterwarnings("ignore:.*it acts on no joint:UserWarning")  # held by test_scene.py
def test_infinite_limits_cost_nothing():
    robot = CASES["two_link"].robot
    assert not robot.limits.upper.isfinite().any()
    bare = Scene(robot, integrator=SemiImplicitEuler())
    assert bare.replace(effects=(effects.JointLimits(),)).program().ops == bare.program().ops
    one = bare.replace(effects=(effects.JointLimits([-1.0, -math.inf], [1.0, math.inf]),)).count().total
    both = bare.replace(effects=(effects.JointLimits(-1.0, 1.0),)).count().total
    assert both - one == one - bare.count().total > 0


# --- the model -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["list", "tensor", "batched"])
@pytest.mark.parametrize("name", CASES)
def test_gravity_pulls_in_its_direction(name, form):
    b = bare(name)
    g, values = given(form, -9.0, 9.0, 3, 0)
    models = [pin.Model(b.model) for _ in range(SAMPLES)]
    for model, vector in zip(models, values, strict=True):
        model.gravity.linear = vector
    assert agrees(b, effects.Gravity(g), model=models)


@pytest.mark.parametrize("name", CASES)
def test_gravity_is_the_robots_own_unless_given(name):
    b = bare(name)
    model = pin.Model(b.model)
    model.gravity.linear = b.robot.gravity.numpy()
    assert agrees(b, effects.Gravity(), model=model)


def test_gravity_of_a_robot_without_any_points_downwards():
    b = bare("tree")
    model = pin.Model(b.model)
    model.gravity.linear = np.array([0.0, 0.0, -9.81])
    b = b._replace(case=dataclasses.replace(b.case, robot=b.robot.replace(gravity=None)))
    assert agrees(b, effects.Gravity(), model=model)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", CASES)
def test_rotors_add_to_the_diagonal_of_the_mass_matrix(name, form):
    b = bare(name)
    inertia, values = given(form, 0.05, 2.0, b.n, 0)
    expected = pinocchio(b, implicit=values)
    assert close(accelerations(b, effects.RotorInertia(inertia)), *expected)


def test_rotors_are_the_robots_own_unless_given_and_add_up():
    b = bare("tree")
    expected = pinocchio(b, implicit=np.broadcast_to(b.robot.armature.numpy() + 0.5, (SAMPLES, b.n)))
    assert close(accelerations(b, (effects.RotorInertia(), effects.RotorInertia(0.5))), *expected)


def full(row):
    xx, xy, yy, xz, yz, zz = row
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@pytest.mark.parametrize("form", ["constant", "tensor", "batched"])
@pytest.mark.parametrize("frame", ["tip", "link"])
@pytest.mark.parametrize("name", CASES)
def test_a_payload_is_a_body_more(name, frame, form):
    b = bare(name)
    link = b.robot.link_names[b.n // 2]
    frame = b.robot.end_effector().name if frame == "tip" else link
    rng = np.random.default_rng(3)
    rows = SAMPLES if form == "batched" else 1
    mass, com = rng.uniform(0.5, 3.0, rows), rng.normal(size=(rows, 3)) * 0.2
    spread = rng.normal(size=(rows, 3, 3)) * 0.1
    second = spread @ spread.swapaxes(-1, -2) * mass[:, None, None]  # of a body about its centre of mass
    inertia = np.trace(second, axis1=-2, axis2=-1)[:, None, None] * np.eye(3) - second
    six = inertia[:, (0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)]
    models = []
    for k in range(SAMPLES):
        model = pin.Model(b.model)
        at = model.frames[b.case.frame_id(frame)]
        held = pin.Inertia(mass[k % rows], com[k % rows], inertia[k % rows])
        model.appendBodyToJoint(at.parentJoint, held, at.placement)
        models.append(model)
    parameters = {
        "constant": lambda: (float(mass[0]), com[0].tolist(), six[0].tolist()),
        "tensor": lambda: (double(mass[0]), double(com[0]), double(six[0])),
        "batched": lambda: (double(mass), double(com), double(six)),
    }[form]()
    assert agrees(b, effects.Payload(*parameters, frame=frame), model=models)


def test_payloads_of_many_masses_with_the_rest_constant():
    b = bare("panda")
    mass = np.linspace(0.0, 4.0, SAMPLES)
    models = [pin.Model(b.model) for _ in mass]
    for model, m in zip(models, mass, strict=True):
        at = model.frames[b.case.frame_id(b.robot.end_effector().name)]
        model.appendBodyToJoint(
            at.parentJoint, pin.Inertia(m, np.array([0.0, 0.0, 0.1]), np.zeros((3, 3))), at.placement
        )
    assert agrees(b, effects.Payload(double(mass), (0.0, 0.0, 0.1)), model=models)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", CASES)
def test_denser_links_have_more_mass_and_inertia_about_the_same_centres(name, form):
    b = bare(name)
    factor, values = given(form, 0.5, 2.0, b.n, 0)
    models = []
    for row in values:
        model = pin.Model(b.model)
        for i, joint in enumerate(b.case.joints):
            body = model.inertias[joint.id]
            model.inertias[joint.id] = pin.Inertia(body.mass * row[i], body.lever, body.inertia * row[i])
        models.append(model)
    assert agrees(b, effects.MassScale(factor), model=models)


def test_payloads_are_not_scaled_with_the_links_wherever_they_stand():
    b = bare("tree")
    parts = (
        effects.MassScale(2.0),
        effects.Payload(1.0, (0.0, 0.1, 0.2)),
        effects.MassScale(1.5),
        effects.Payload(0.5),
    )
    heavy = b.case.robot.replace(mass=3.0 * b.case.robot.mass, inertia=3.0 * b.case.robot.inertia, armature=None)
    q, qd, u = b.q[:2], b.qd[:2], b.u[:2]
    expected = Scene(heavy, parts[1::2]).step(State(q, qd), u)
    for order in itertools.permutations(parts):
        found = Scene(b.case.robot, order).step(State(q, qd), u)
        assert close(found.qd, expected.qd, float(expected.qd.abs().max()))


# --- bodies ----------------------------------------------------------------------------------------------------------


class At(NamedTuple):
    """A frame in a state, everything in world axes."""

    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray  # of the frame's origin
    spin: np.ndarray
    jacobian: np.ndarray  # [6, n], of both


def at_frame(b, name, k):
    data = b.model.createData()
    q, v, f = b.case.configuration(b.q[k]), b.case.velocity(b.qd[k]), b.case.frame_id(name)
    pin.forwardKinematics(b.model, data, q, v)
    pin.updateFramePlacement(b.model, data, f)
    jacobian = pin.computeFrameJacobian(b.model, data, q, f, pin.LOCAL_WORLD_ALIGNED)[:, b.case.order]
    twist = jacobian @ b.qd[k].numpy()
    return At(data.oMf[f].rotation.copy(), data.oMf[f].translation.copy(), twist[:3], twist[3:], jacobian)


@pytest.mark.parametrize("axes", ["world", "body"])
@pytest.mark.parametrize("frame", ["tip", "link"])
@pytest.mark.parametrize("name", CASES)
def test_a_push_is_the_torque_of_its_jacobian(name, frame, axes):
    b = bare(name)
    frame = b.robot.end_effector().name if frame == "tip" else b.robot.link_names[b.n // 2]
    push = np.random.default_rng(1).normal(size=(SAMPLES, 6)) * 5
    torques = []
    for k in range(SAMPLES):
        at = at_frame(b, frame, k)
        turn = np.eye(3) if axes == "world" else at.rotation
        torques.append(at.jacobian.T @ np.concatenate([turn @ push[k, :3], turn @ push[k, 3:]]))
    assert agrees(b, effects.Push(frame, axes), torques=np.array(torques), push=double(push))


def test_a_push_is_an_external_wrench():
    """The same wrench through torchdq's own `f_ext`, which acts on links in their frames."""
    b = bare("tree")
    link = b.n - 1
    push = double(np.random.default_rng(2).normal(size=(SAMPLES, 6)))
    f_ext = torch.zeros(SAMPLES, b.n, 6, dtype=torch.float64)
    f_ext[:, link] = push
    robot = b.robot.replace(gravity=torch.zeros(3, dtype=torch.float64), armature=None)
    expected = torchdq.forward_dynamics(robot, b.q, b.qd, b.u, f_ext=f_ext)
    assert close(
        accelerations(b, effects.Push(b.robot.link_names[link], "body"), push=push), expected, pinocchio(b).size
    )


def test_wrenches_on_a_link_add_up():
    b, frame = bare("tree"), bare("tree").robot.end_effector().name
    one, two = np.random.default_rng(6).normal(size=(2, SAMPLES, 6)) * 5
    torques = [at_frame(b, frame, k).jacobian.T @ (one[k] + two[k]) for k in range(SAMPLES)]
    pushes = (effects.Push(frame, name="one"), effects.Push(frame, name="two"))
    assert agrees(b, pushes, torques=np.array(torques), one=double(one), two=double(two))


def test_a_push_that_is_not_given_is_none_and_costs_nothing():
    robot = CASES["panda"].robot
    scene = Scene(robot, (effects.Push(),))
    assert scene.program("torque").count() == Scene(robot).program("torque").count()
    assert scene.program("torque", "push").count().total > scene.program("torque").count().total


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", CASES)
def test_drag_resists_the_motion_of_every_link(name, form):
    b = bare(name)
    ranges = {"linear": (0.1, 1.0), "quadratic": (0.1, 1.0), "angular": (0.01, 0.2), "sign_width": (0.01, 0.5)}
    parameters, values = forms_of(ranges, form, b.n, {"sign_width": None})
    torques = np.zeros((SAMPLES, b.n))
    for k, i in itertools.product(range(SAMPLES), range(b.n)):
        at = at_frame(b, b.robot.link_names[i], k)
        arm = at.rotation @ b.robot.com[i].numpy()
        v = at.velocity + np.cross(at.spin, arm)
        speed = np.sqrt(v @ v + values["sign_width"][k] ** 2)
        force = -(values["linear"][k, i] + values["quadratic"][k, i] * speed) * v
        moment = np.cross(arm, force) - values["angular"][k, i] * at.spin
        torques[k] += at.jacobian.T @ np.concatenate([force, moment])
    if form == "list":
        parameters["sign_width"] = float(values["sign_width"][0])
    assert agrees(b, effects.Drag(**parameters), torques=torques)


def contact(b, values, k, frame):
    """Force of the ground and the joint torques it causes."""
    at = at_frame(b, frame, k)
    n = values["normal"][k]
    depth = max(values["height"][k] - n @ at.position, 0.0)
    rate = -(n @ at.velocity)
    f_n = max(values["stiffness"][k] * depth * (1 + values["dissipation"][k] * rate), 0.0)
    sliding = at.velocity - (n @ at.velocity) * n
    f = f_n * n - values["friction"][k] * f_n * sliding / np.sqrt(sliding @ sliding + values["sign_width"][k] ** 2)
    return f, at.jacobian[:3].T @ f


@pytest.mark.parametrize("tensors", [False, True], ids=["constant", "tensors"])
@pytest.mark.parametrize("name", CASES)
def test_contact_pushes_along_the_normal_and_rubs_across_it(name, tensors):
    b = bare(name)
    frame = b.robot.end_effector().name
    rng = np.random.default_rng(4)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    single = {"stiffness": 100.0, "dissipation": 0.3, "friction": 0.7, "sign_width": 0.2}
    values = {name: np.full(SAMPLES, x) for name, x in single.items()} | {"normal": np.tile(normal, (SAMPLES, 1))}
    heights = np.array([at_frame(b, frame, k).position @ normal for k in range(SAMPLES)])
    if tensors:
        values["height"] = heights + np.linspace(-0.1, 0.3, SAMPLES)
        parameters = {name: double(x) for name, x in values.items()}
    else:
        values["height"] = np.full(SAMPLES, float(np.median(heights)) + 0.05)
        parameters = single | {"normal": normal.tolist(), "height": values["height"][0]}
    forces, torques = zip(*(contact(b, values, k, frame) for k in range(SAMPLES)), strict=True)
    assert 0 < sum(np.linalg.norm(f) > 0 for f in forces) < SAMPLES  # some touch, some do not
    assert agrees(b, effects.Contact(**parameters), torques=np.array(torques))


def tip_force(q, qd, effect):
    """Force on the tip of the arm, in its plane, from the joint torques it causes."""
    robot = CASES["two_link"].robot
    made, empty = (
        Scene(robot, parts, integrator=ExplicitEuler(), dt=1.0).step(State(q, qd)) for parts in ((effect,), ())
    )
    tau = torch.einsum("bij,bj->bi", torchdq.mass_matrix(robot, q), made.qd - empty.qd)
    a, s = q[:, 0], q.sum(-1)
    rows = [torch.stack([-a.sin() - s.sin(), -s.sin()], -1), torch.stack([a.cos() + s.cos(), s.cos()], -1)]
    J = torch.stack(rows, -2)  # of a two-link arm with links of one metre
    return torch.linalg.solve(J.mT, tau), torch.einsum("bij,bj->bi", J, qd)


def test_the_ground_never_pulls_and_rubs_no_more_than_its_cone_allows():
    generator = torch.Generator().manual_seed(0)
    q = torch.rand(2000, 2, generator=generator, dtype=torch.float64) * 2 + 0.3
    qd = torch.randn(2000, 2, generator=generator, dtype=torch.float64) * 4
    effect = effects.Contact(height=1.2, normal=(0.0, 1.0, 0.0), stiffness=50.0, dissipation=2.0, friction=0.6)
    force, velocity = tip_force(q, qd, effect)
    tip = q[:, 0].sin() + q.sum(-1).sin()
    assert (force[:, 1] >= -1e-9).all()
    assert (force[:, 0].abs() <= 0.6 * force[:, 1] + 1e-9).all()
    assert (force[:, 0] * velocity[:, 0] <= 1e-9).all()
    assert (force[tip > 1.2].abs() < 1e-9).all()
    touching = force[:, 1] > 1e-6
    assert 100 < touching.sum() < 1900
    # a tip that leaves fast enough is let go at once
    assert ((tip < 1.2) & ~touching & (velocity[:, 1] > 0.5)).any()


# --- actuators -------------------------------------------------------------------------------------------------------


def driven(effect, u, robot=None, qd=None):
    """Torques behind an actuator for a series of commands [steps, n]: those that a robot without it would need."""
    robot = robot or CASES["two_link"].robot
    scene, plain = (Scene(robot, parts, dt=0.02) for parts in ((effect,), ()))
    state = scene.start(torch.zeros(u.shape[-1], dtype=u.dtype), qd)
    found = []
    for row in u:
        after = scene.step(state, row)
        free = plain.step(State(state.q, state.qd))
        found.append(torchdq.mass_matrix(robot, state.q) @ (after.qd - free.qd) / 0.02)
        state = after
    return torch.stack(found)


U = double(np.random.default_rng(7).normal(size=(12, 2)) * 3)


def test_saturation_is_exactly_its_limit_beyond_it():
    robot = CASES["panda"].robot
    scene = Scene(robot, (effects.Saturation(2.0), effects.Gravity()))
    state = scene.start(states(robot).q)
    assert torch.equal(
        scene.step(state, double([100.0, -3.0] * 3 + [2.0])).qd, scene.step(state, double([2.0, -2.0] * 3 + [2.0])).qd
    )
    unbounded = Scene(robot, (effects.Gravity(),))
    u = double([1.0, -1.999999, 0.0, 1.5, -2.0, 2.0, 0.3])
    assert torch.equal(scene.step(state, u).qd, unbounded.step(state, u).qd)


@pytest.mark.filterwarnings("ignore:.*it acts on no joint:UserWarning")  # held by test_scene.py
def test_saturation_without_limits_costs_nothing():
    robot = CASES["two_link"].robot
    for effect in (effects.Saturation(), effects.TorqueSpeed()):
        assert Scene(robot, (effect,)).program().ops == Scene(robot).program().ops


@pytest.mark.parametrize("form", FORMS)
def test_a_motor_loses_torque_with_speed(form):
    b = bare("panda")
    parameters, p = forms_of({"stall": (5.0, 20.0), "speed": (1.0, 4.0)}, form, b.n)
    u, v = b.u.numpy(), b.qd.numpy()
    upper = p["stall"] * np.clip(1 - v / p["speed"], 0, 1)
    lower = -p["stall"] * np.clip(1 + v / p["speed"], 0, 1)
    torques = np.clip(u, lower, upper)
    assert ((torques != u).any() and (torques == u).any()) or form
    assert agrees(b, effects.TorqueSpeed(**parameters), torques=torques - u)


@pytest.mark.parametrize("form", FORMS)
def test_a_dead_band_swallows_its_width(form):
    b = bare("panda")
    width, values = given(form, 1.0, 20.0, b.n, 0)
    u = b.u.numpy()
    left = np.sign(u) * np.maximum(np.abs(u) - values, 0)
    assert agrees(b, effects.DeadBand(width), torques=left - u)


@pytest.mark.parametrize("form", FORMS)
def test_commands_are_rounded_to_steps(form):
    b = bare("panda")
    step, values = given(form, 1.0, 5.0, b.n, 0)
    u = b.u.numpy()
    assert agrees(b, effects.QuantisedCommand(step), torques=np.round(u / values) * values - u)


@pytest.mark.parametrize("parameter", [0.05, [0.05, 0.05], double([0.05, 0.05]), double(0.05)])
def test_a_lag_is_the_mean_of_the_exponential_of_its_time(parameter):
    """T tau' = u - tau has the solution tau + (1 - exp(-t/T)) (u - tau) while u is constant; its mean over dt acts."""
    found, tau, expected = driven(effects.FirstOrderLag(parameter), U), np.zeros(2), []
    decay = math.exp(-0.02 / 0.05)
    for u in U.numpy():
        expected.append(u + 0.05 / 0.02 * (1 - decay) * (tau - u))
        tau = tau + (1 - decay) * (u - tau)
    assert np.abs(found.numpy() - np.array(expected)).max() < 1e-11


@pytest.mark.parametrize("integrator", [LinearlyImplicit(), RungeKutta4()], ids=["implicit", "fourth order"])
@pytest.mark.parametrize("substeps", [1, 4])
@pytest.mark.parametrize("dt", [0.001, 0.01, 0.05])
def test_the_impulse_of_a_lag_is_exact_at_any_step(dt, substeps, integrator):
    """A slide of 2 kg under a torque of 2 N from rest has the velocity t - T (1 - exp(-t/T))."""
    slide = torchdq.Robot.from_screws([(0, 0, 0, 1, 0, 0)], [2.0], [[0.0] * 3], [torch.eye(3)], gravity=None)
    scene = Scene(slide, (effects.FirstOrderLag(0.02),), integrator=integrator, dt=dt, substeps=substeps)
    state = scene.start(double([0.0]))
    for k in range(1, 4):
        state = scene.step(state, double([2.0]))
        exact = k * dt - 0.02 * (1 - math.exp(-k * dt / 0.02))
        assert float(state.qd) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("time", [1e-3, 0.39, 0.41, 10.0, 1e9])
def test_a_lag_keeps_its_digits_whatever_its_time(time, dtype):
    robot = CASES["two_link"].robot
    tensor, number = (
        Scene(robot, (effects.FirstOrderLag(x),), dt=0.02) for x in (torch.tensor(time, dtype=dtype), time)
    )
    q, u = torch.zeros(2, dtype=dtype), torch.ones(2, dtype=dtype)
    found, expected = (scene.step(scene.start(q), u).qd for scene in (tensor, number))
    free = Scene(robot, dt=0.02)
    size = float(free.step(free.start(q), u).qd.abs().max())
    assert (found - expected).abs().max() < 100 * torch.finfo(dtype).eps * size


def test_a_lag_of_no_time_is_none():
    assert (driven(effects.FirstOrderLag(0.0), U) - U).abs().max() < 1e-11
    assert (driven(effects.FirstOrderLag([0.0, 1.0]), U) - U)[:, 0].abs().max() < 1e-11


@pytest.mark.parametrize("steps", [1, 3, 20])
def test_a_delay_shifts_by_whole_steps(steps):
    expected = torch.cat([torch.zeros(steps, 2, dtype=torch.float64), U])[: len(U)]
    assert (driven(effects.CommandDelay(steps), U) - expected).abs().max() < 1e-11


def test_what_is_delayed_is_exactly_what_was_commanded():
    scene = Scene(CASES["two_link"].robot, (effects.CommandDelay(2),))
    state = scene.start(torch.zeros(2, dtype=torch.float64))
    for u in U[:5]:
        state = scene.step(state, u)
    assert torch.equal(state.memory, U[3:5].flatten())


def test_actuators_act_in_their_order():
    saturated_late = driven(effects.Saturation(1.0), 2 * U)
    robot = CASES["two_link"].robot
    state = State(torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
    first = Scene(robot, (effects.DeadBand(1.0), effects.Saturation(1.0))).step(state, double([1.5, 9.0])).qd
    then = Scene(robot, (effects.Saturation(1.0), effects.DeadBand(1.0))).step(state, double([1.5, 9.0])).qd
    assert torch.equal(first, Scene(robot).step(state, double([0.5, 1.0])).qd)
    assert torch.equal(then, state.qd)
    assert saturated_late.abs().max() < 1 + 1e-11


# --- sensors ---------------------------------------------------------------------------------------------------------


def read(effect, q, qd=None, noise=None):
    scene = Scene(CASES["two_link"].robot, (effect,) if isinstance(effect, effects.Effect) else effect)
    return scene.start(q, qd, noise)


SPREAD = {"position": [0.1, 0.02], "velocity": [0.5, 3.0]}
MANY = 40_000


def test_noise_is_normal_with_its_standard_deviation_and_without_correlation():
    torch.manual_seed(0)
    q = torch.zeros(MANY, 2, dtype=torch.float64)
    scene = Scene(CASES["two_link"].robot, (effects.Noise(**SPREAD),))
    state = scene.start(q)
    readings = [state.reading, scene.step(state).reading]
    z = torch.cat(readings, -1).numpy() / np.tile(SPREAD["position"] + SPREAD["velocity"], 2)
    four_sigma = 4 / math.sqrt(MANY)
    assert np.abs(z.mean(0)).max() < four_sigma
    assert np.abs(z.std(0) - 1).max() < four_sigma / math.sqrt(2)
    assert np.abs(np.corrcoef(z.T) - np.eye(8)).max() < four_sigma
    assert min(stats.kstest(column, "norm").pvalue for column in z.T) > 1e-4
    assert np.abs(np.corrcoef(np.abs(z).T) - np.eye(8)).max() < four_sigma  # nor do they share a radius


def test_noise_is_drawn_anew_and_from_torchs_generator():
    torch.manual_seed(3)
    scene = Scene(CASES["two_link"].robot, (effects.Noise(0.1, 0.1),))
    q = torch.zeros(4, 2, dtype=torch.float64)
    once, twice = scene.start(q).reading, scene.start(q).reading
    torch.manual_seed(3)
    assert torch.equal(scene.start(q).reading, once)
    assert not torch.equal(once, twice)


def test_the_gradient_of_a_standard_deviation_is_the_draw():
    q, qd = double([[0.3, -0.4]]), double([[1.0, 2.0]])
    position, velocity = (double(x).requires_grad_() for x in SPREAD.values())
    noise = double([[0.2, 0.7, 0.9, 0.4]])
    state = read(effects.Noise(position, velocity), q, qd, noise)
    state.reading.sum().backward()
    radius, angle = (-2 * noise[0, 0::2].log()).sqrt(), 2 * math.pi * noise[0, 1::2]
    assert torch.allclose(position.grad, radius * angle.cos(), rtol=1e-14, atol=1e-14)
    assert torch.allclose(velocity.grad, radius * angle.sin(), rtol=1e-14, atol=1e-14)


def test_two_noises_of_a_reading_are_drawn_apart():
    rest, noise = torch.zeros(2, dtype=torch.float64), double([0.2, 0.7, 0.9, 0.4, 0.5, 0.1, 0.3, 0.8])
    kinds = (effects.Noise(0.1, 0.2), effects.Noise(0.3, 0.5))
    alone = [read(kind, rest, noise=part).reading for kind, part in zip(kinds, noise.split(4), strict=True)]
    assert torch.allclose(read(kinds, rest, noise=noise).reading, sum(alone), rtol=1e-14, atol=0)


def test_a_draw_of_one_is_no_noise():
    state = read(effects.Noise(0.1, 0.1), torch.zeros(2, dtype=torch.float64), noise=torch.ones(4, dtype=torch.float64))
    assert torch.equal(state.reading, torch.zeros(4, dtype=torch.float64))


def test_noise_is_finite_even_if_the_generator_gives_zero(monkeypatch):
    monkeypatch.setattr(torch, "rand", torch.zeros)
    assert read(effects.Noise(0.1, 0.1), torch.zeros(2, dtype=torch.float64)).reading.isfinite().all()


@pytest.mark.parametrize("form", FORMS)
def test_readings_are_off_by_their_bias(form):
    q, qd = U[:SAMPLES], U[SAMPLES : 2 * SAMPLES]
    parameters, values = forms_of({"position": (-1.0, 1.0), "velocity": (-1.0, 1.0)}, form, 2)
    expected = np.concatenate([q.numpy() + values["position"], qd.numpy() + values["velocity"]], -1)
    assert np.array_equal(read(effects.Bias(**parameters), q, qd).reading, expected)


@pytest.mark.parametrize("form", FORMS)
def test_readings_are_rounded_to_steps(form):
    q, qd = U[:SAMPLES], U[SAMPLES : 2 * SAMPLES]
    parameters, values = forms_of({"position": (0.1, 1.0), "velocity": (0.1, 1.0)}, form, 2)
    truth = np.concatenate([q.numpy(), qd.numpy()], -1)
    steps = np.concatenate([values["position"], values["velocity"]], -1)
    expected = np.round(truth / steps) * steps
    assert close(read(effects.QuantisedReading(**parameters), q, qd).reading, expected, 1.0)


def test_readings_in_steps_of_zero_are_exact_and_cost_nothing():
    robot = CASES["two_link"].robot
    assert torch.equal(read(effects.QuantisedReading(), U, U).reading, torch.cat([U, U], -1))
    assert Scene(robot, (effects.QuantisedReading(),)).count() == Scene(robot).count()


@pytest.mark.parametrize("steps", [1, 3])
def test_a_reading_delay_shows_the_state_of_so_many_steps_ago(steps):
    scene = Scene(CASES["two_link"].robot, (effects.MeasurementDelay(steps),))
    state = scene.start(double([0.3, 0.4]), double([1.0, -1.0]))
    truth, shown = [torch.cat([state.q, state.qd])], [state.reading]
    for u in U:
        state = scene.step(state, u)
        truth.append(torch.cat([state.q, state.qd]))
        shown.append(state.reading)
    assert torch.equal(torch.stack(shown[:steps]), truth[0].expand(steps, 4))
    assert torch.equal(torch.stack(shown[steps:]), torch.stack(truth[: len(truth) - steps]))


def test_sensors_act_in_their_order():
    q = double([0.34, 0.56])
    biased = read((effects.Bias(0.03), effects.QuantisedReading(0.1)), q).measured[0]
    rounded = read((effects.QuantisedReading(0.1), effects.Bias(0.03)), q).measured[0]
    assert torch.allclose(biased, double([0.4, 0.6]), atol=1e-15)
    assert torch.allclose(rounded, double([0.33, 0.63]), atol=1e-15)


# --- elastic joints --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", CASES)
def test_elastic_joints_are_two_masses_with_a_spring_between(name, form):
    b = bare(name)
    ranges = {"stiffness": (10.0, 50.0), "damping": (0.1, 1.0), "inertia": (0.1, 1.0)}
    parameters, p = forms_of(ranges, form, b.n)
    scene = Scene(b.robot, (effects.Elastic(**parameters),), integrator=ExplicitEuler(), dt=1.0)
    rng = np.random.default_rng(8)
    theta, omega = b.q.numpy() + rng.normal(size=b.q.shape), rng.normal(size=b.q.shape)
    state = State(b.q, b.qd, double(np.concatenate([theta, omega], -1)))
    after = scene.step(state, torque=b.u)
    spring = p["stiffness"] * (theta - b.q.numpy()) + p["damping"] * (omega - b.qd.numpy())
    expected = pinocchio(b, spring - b.u.numpy())
    assert close((after.qd - b.qd).numpy(), *expected)
    rotors = np.concatenate([theta + omega, omega + (b.u.numpy() - spring) / p["inertia"]], -1)
    assert close(after.memory.numpy(), rotors, 1e3)


def test_rotors_start_with_their_joints():
    q, qd = double([0.3, 0.4]), double([1.0, -1.0])
    state = Scene(CASES["two_link"].robot, (effects.Elastic(10.0, 0.1, 0.1),)).start(q, qd)
    assert torch.equal(state.memory, torch.cat([q, qd]))


def test_the_implicit_integrator_takes_elastic_springs_at_the_end_of_the_step():
    """One linear system for joints and rotors: the elimination of the rotors is checked against solving it whole."""
    b, h = bare("tree"), 0.05
    k, d, J, D, K = np.random.default_rng(9).uniform(1, 9, (5, b.n))
    elastic = effects.Elastic(k.tolist(), d.tolist(), J.tolist())
    others = (effects.Viscous(D.tolist()), effects.Spring(K.tolist()))
    scene = Scene(b.robot, (elastic, *others), integrator=LinearlyImplicit(), dt=h)
    theta, omega = b.q.numpy() + 0.3, b.qd.numpy() - 0.5
    after = scene.step(State(b.q, b.qd, double(np.concatenate([theta, omega], -1))), torque=b.u)
    for i in range(SAMPLES):
        q, qd, u = b.q[i].numpy(), b.qd[i].numpy(), b.u[i].numpy()
        data = b.model.createData()
        configuration, velocity = b.case.configuration(q), b.case.velocity(qd)
        M = pin.crba(b.model, data, configuration)
        M = (np.triu(M) + np.triu(M, 1).T)[np.ix_(b.case.order, b.case.order)]
        nle = pin.nle(b.model, data, configuration, velocity)[b.case.order]
        # unknowns v', w': every impedance with the state at the end, q + h v'
        A = np.block(
            [
                [M + np.diag(h * (D + d) + h**2 * (K + k)), -np.diag(h * d + h**2 * k)],
                [-np.diag(h * d + h**2 * k), np.diag(J + h * d + h**2 * k)],
            ]
        )
        right = np.concatenate(
            [M @ qd + h * (-nle - K * q + k * (theta[i] - q)), J * omega[i] + h * (u - k * (theta[i] - q))]
        )
        ends = np.linalg.solve(A, right)
        assert np.abs(after.qd[i].numpy() - ends[: b.n]).max() < 1e-11
        assert np.abs(after.memory[i, b.n :].numpy() - ends[b.n :]).max() < 1e-11
        assert np.abs(after.memory[i, : b.n].numpy() - (theta[i] + h * ends[b.n :])).max() < 1e-11


def test_a_very_stiff_elastic_joint_is_a_rotor():
    robot = CASES["two_link"].robot
    q, u = double([0.3, 0.4]), double([1.0, -0.5])
    elastic = Scene(robot, (effects.Elastic(1e8, 1e3, 0.2),), integrator=LinearlyImplicit())
    rigid = Scene(robot, (effects.RotorInertia(0.2),), integrator=LinearlyImplicit())
    a, b = elastic.start(q), rigid.start(q)
    for _ in range(20):
        a, b = elastic.step(a, u), rigid.step(b, u)
    assert (a.q - b.q).abs().max() < 1e-6


# --- passivity -------------------------------------------------------------------------------------------------------

FRICTION = {
    "Viscous": effects.Viscous([0.3, 0.1]),
    "Coulomb": effects.Coulomb([0.5, 2.0], sign_width=1e-3),
    "Stribeck": effects.Stribeck([0.5, 1.0], [1.0, 1.5], sign_width=1e-3),
    "Drag": effects.Drag(0.5, 0.5, 0.1),
}


@pytest.mark.case("T10")
@pytest.mark.parametrize("kind", FRICTION)
def test_friction_only_takes_power(kind):
    robot = CASES["two_link"].robot
    generator = torch.Generator().manual_seed(1)
    q, qd = torch.randn(2, 1000, 2, generator=generator, dtype=torch.float64) * 3
    qd = qd * 10 ** (-6 * torch.rand(1000, 1, generator=generator, dtype=torch.float64))
    made, empty = (
        Scene(robot, parts, integrator=ExplicitEuler(), dt=1.0).step(State(q, qd)) for parts in ((FRICTION[kind],), ())
    )
    tau = torch.einsum("bij,bj->bi", torchdq.mass_matrix(robot, q), made.qd - empty.qd)
    each = tau * qd if kind != "Drag" else (tau * qd).sum(-1)  # the drag of a link acts on all joints below it
    assert (each <= 1e-12 * tau.abs().amax() * qd.abs().amax()).all()
    assert (each < 0).double().mean() > 0.9


@pytest.mark.case("T10")
@pytest.mark.parametrize("width", [1e-2, 1e-6])
@pytest.mark.parametrize("kind", ["Viscous", "Coulomb", "Stribeck"])
def test_an_arm_never_gains_energy_from_friction_when_integrated_implicitly(kind, width):
    """Friction takes h D v'^2 and more out of a step; what rigid bodies alone gain by rounding and order is left aside.

    The arm moves slowly, so that Coriolis torques, which a first-order step gets wrong by dt |v|^3, are small.
    """
    robot = CASES["two_link"].robot
    effect = FRICTION[kind] if kind == "Viscous" else dataclasses.replace(FRICTION[kind], sign_width=width)
    generator = torch.Generator().manual_seed(2)
    q, qd = torch.randn(2, 50, 2, generator=generator, dtype=torch.float64)
    scene = Scene(robot, (effect,), integrator=LinearlyImplicit(), dt=1e-3)
    state = scene.start(q, 0.1 * qd)
    energies = [scene.energy(state)[:, 0]]
    for _ in range(300):
        state = scene.step(state)
        energies.append(scene.energy(state)[:, 0])
    energies = torch.stack(energies)
    assert (energies[1:] <= energies[:-1] * (1 + 1e-12) + 1e-18).all()
    assert (energies[-1] < energies[0]).all()


# --- gradients -------------------------------------------------------------------------------------------------------


def p(*x):
    return double(x if len(x) > 1 else x[0]).requires_grad_()


def warm():
    return {"temperature": p(12.0, -7.0)}


# every effect with every parameter a tensor that requires gradients, and the inputs it needs
TENSORS = {
    "Gravity": lambda: (effects.Gravity(p(1.0, -9.0, 2.0)), {}),
    "RotorInertia": lambda: (effects.RotorInertia(p(0.1, 0.2)), {}),
    "Payload": lambda: (effects.Payload(p(0.7), p(0.1, 0.2, 0.0), p(0.02, 0.0, 0.02, 0.0, 0.0, 0.03)), {}),
    "MassScale": lambda: (effects.MassScale(p(0.8, 1.3)), {}),
    "Viscous": lambda: (effects.Viscous(p(0.3, 0.5), warming=p(0.02, 0.01)), warm()),
    "Quadratic": lambda: (effects.Quadratic(p(0.3, 0.5), warming=p(0.02, 0.01)), warm()),
    "Coulomb": lambda: (effects.Coulomb(p(0.3, 0.5), p(0.1), warming=p(0.02, 0.01)), warm()),
    "Directional": lambda: (effects.Directional(p(0.3, 0.5), p(0.6, 0.2), p(0.1), warming=p(0.02, 0.01)), warm()),
    "Stribeck": lambda: (
        effects.Stribeck(p(0.3, 0.5), p(0.6, 0.8), p(0.1, 0.2), p(0.1), warming=p(0.02, 0.01)),
        warm(),
    ),
    "LoadDependent": lambda: (effects.LoadDependent(p(0.3, 0.2), p(0.1), warming=p(0.02, 0.01)), warm()),
    "LuGre": lambda: (
        effects.LuGre(p(0.3, 0.5), p(0.2, 0.3), p(1.5, 1.2), p(0.7, 0.9), p(0.1, 0.05), warming=p(0.02, 0.01)),
        warm(),
    ),
    "Ripple": lambda: (effects.Ripple(p(0.3, 0.5), p(0.3, -0.5), p(-0.2, 0.1), warming=p(0.02, 0.01)), warm()),
    "Spring": lambda: (effects.Spring(p(3.0, 5.0), p(0.1, -0.2)), {}),
    "Servo": lambda: (effects.Servo(p(3.0, 5.0), p(0.2, 0.1)), {"target": p(0.5, 0.1)}),
    "JointLimits": lambda: (effects.JointLimits(p(-0.5, -0.6), p(0.2, 0.5), p(30.0, 50.0), p(1.0, 2.0)), {}),
    "Elastic": lambda: (effects.Elastic(p(30.0, 50.0), p(0.3, 0.1), p(0.2, 0.3)), {}),
    "Push": lambda: (effects.Push(axes="body"), {"push": p(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)}),
    "Drag": lambda: (effects.Drag(p(0.3, 0.1), p(0.2, 0.4), p(0.01, 0.02), p(0.1)), {}),
    "Contact": lambda: (
        effects.Contact(None, p(1.5), p(0.28, 0.96, 0.0), p(40.0), p(0.5), p(0.6), p(0.2)),
        {},
    ),
    "Saturation": lambda: (effects.Saturation(p(1.0, 5.0)), {}),
    "TorqueSpeed": lambda: (effects.TorqueSpeed(p(1.0, 5.0), p(3.0, 4.0)), {}),
    "FirstOrderLag": lambda: (effects.FirstOrderLag(p(0.05, 0.1)), {}),
    "CommandDelay": lambda: (effects.CommandDelay(1), {}),
    "DeadBand": lambda: (effects.DeadBand(p(0.3, 0.4)), {}),
    "Noise": lambda: (effects.Noise(p(0.1, 0.2), p(0.3, 0.4)), {"noise": double([0.3, 0.6, 0.2, 0.9])}),
    "Bias": lambda: (effects.Bias(p(0.1, 0.2), p(0.3, 0.4)), {}),
    "MeasurementDelay": lambda: (effects.MeasurementDelay(1), {}),
    "QuantisedCommand": lambda: (effects.QuantisedCommand(p(0.3, 0.4)), {}),
    "Residual": lambda: (effects.Residual(torch.mul), {}),
    "QuantisedReading": lambda: (effects.QuantisedReading(p(0.03, 0.04), p(0.3, 0.4)), {}),
}
STEPPED = ("QuantisedCommand", "QuantisedReading")  # differentiable only between their steps


def test_every_effect_has_its_gradients_checked():
    assert set(TENSORS) == set(effects.__all__) - {"Effect"}


def differentiable(effect, inputs, integrator, steps):
    """End of a rollout as a function of state, torque, inputs and parameters, and a point to take it at."""
    names = list(effect.tensors()) if isinstance(effect, effects.Effect) else []
    names = [name for name in effect.SHAPES if isinstance(getattr(effect, name), torch.Tensor)]
    learned = [name for name, x in inputs.items() if x.requires_grad]
    robot = CASES["two_link"].robot

    def end(q, qd, torque, *rest):
        values = dict(zip([*names, *learned], rest, strict=True))
        changed = dataclasses.replace(effect, **{name: values[name] for name in names})
        scene = Scene(robot, (changed,), integrator=integrator, dt=0.02)
        given = {name: values.get(name, x) for name, x in inputs.items()}
        state = scene.start(q, qd, given.get("noise"))
        for _ in range(steps):
            state = scene.step(state, torque, **given)
        return torch.cat([x for x in state if x is not None], -1)

    point = [p(0.4, -0.7), p(0.9, -1.2), p(2.0, -0.7)]
    return end, [*point, *(getattr(effect, name) for name in names), *(inputs[name] for name in learned)]


@pytest.mark.parametrize("integrator", [SemiImplicitEuler(), LinearlyImplicit()], ids=["semi-implicit", "implicit"])
@pytest.mark.parametrize("kind", sorted(set(TENSORS) - set(STEPPED)))
def test_gradients_of_a_step_are_right(kind, integrator):
    assert torch.autograd.gradcheck(*differentiable(*TENSORS[kind](), integrator, 1), atol=1e-7, fast_mode=True)


@pytest.mark.parametrize("kind", sorted(set(TENSORS) - set(STEPPED)))
def test_gradients_of_a_rollout_are_right(kind):
    integrator = LinearlyImplicit() if kind in ("Elastic", "JointLimits") else SemiImplicitEuler()
    assert torch.autograd.gradcheck(*differentiable(*TENSORS[kind](), integrator, 4), atol=1e-7, fast_mode=True)


@pytest.mark.parametrize("kind", ["Coulomb", "Elastic", "Contact"])
def test_gradients_through_runge_kutta_are_right(kind):
    assert torch.autograd.gradcheck(*differentiable(*TENSORS[kind](), RungeKutta4(), 2), atol=1e-7, fast_mode=True)


@pytest.mark.parametrize("kind", STEPPED)
def test_gradients_through_rounding_are_those_of_a_staircase(kind):
    """Nothing comes back through it, but its step still scales what it rounds to."""
    assert torch.autograd.gradcheck(*differentiable(*TENSORS[kind](), SemiImplicitEuler(), 1), atol=1e-7)


@pytest.mark.case("T10", "T11", "P11")
@pytest.mark.parametrize("where", ["rest", "limit", "home"])
@pytest.mark.parametrize(
    "integrator", [SemiImplicitEuler(), LinearlyImplicit(), RungeKutta4()], ids=lambda i: type(i).__name__
)
@pytest.mark.parametrize("kind", TENSORS)
def test_gradients_are_finite_where_formulas_have_corners(kind, integrator, where):
    """At rest without a torque; at the limits exactly; and with both, at home."""
    end, (_, _, _, *rest) = differentiable(*TENSORS[kind](), integrator, 2)
    q = {"rest": p(0.4, -0.7), "limit": p(0.2, -0.6), "home": p(0.0, 0.0)}[where]
    qd, torque = (p(0.9, -1.2), p(2.0, -0.7)) if where == "limit" else (p(0.0, 0.0), p(0.0, 0.0))
    found = torch.autograd.grad(end(q, qd, torque, *rest).square().sum(), [q, qd, torque, *rest], allow_unused=True)
    assert all(x is None or bool(x.isfinite().all()) for x in found)
    assert found[0] is not None


@pytest.mark.case("T10")
@pytest.mark.parametrize("torque", [0.0, 0.2, 2.0])
@pytest.mark.parametrize("qd", [0.0, 1e-9, 1e-6, 1.0])
@pytest.mark.parametrize("width", [1e-2, 1e-4, 1e-6])
def test_gradients_of_dry_friction_stay_finite_as_its_width_shrinks(width, qd, torque):
    end, point = differentiable(effects.Coulomb(p(0.3, 0.5), p(width)), {}, LinearlyImplicit(), 5)
    point[1:3] = p(qd, -qd), p(torque, -torque)
    found = torch.autograd.grad(end(*point).sum(), point)
    assert all(bool(x.isfinite().all()) for x in found)
    if torque < 0.3:  # nor large while friction holds: the state's gradient is damped, not amplified
        assert max(float(x.abs().max()) for x in found[:3]) < 10


# --- parameters that make no sense -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (effects.Gravity(9.81), "acceleration of Gravity must have 3 components, found the number 9.81"),
        (effects.Gravity(torch.tensor(9.81)), "acceleration of Gravity must have 3 components, found the number 9.81"),
        (effects.Gravity(torch.tensor([9.81])), r"must have the shape \[..., 3\], found \(1,\)"),
        (effects.Payload(1.0, com=0.1), "com of Payload must have 3 components"),
        (effects.Payload(1.0, inertia=0.1), "inertia of Payload must have 6 components"),
        (effects.Payload(1.0, inertia=(1.0, 1.0, 100.0, 0.0, 0.0, 0.0)), "must be physically consistent, inertia in"),
        (effects.Payload(torch.ones(5), inertia=(0.01, 0.02, 0.015, 0.0, 0.0, 0.0)), "must be physically consistent"),
        (effects.Stribeck(2.0, 1.0), "coulomb of Stribeck must not be above static, found 2 and 1"),
        (
            effects.Stribeck(torch.tensor([1.0, 2.0]), 1.5),
            "coulomb of Stribeck must not be above static, found 2 and 1.5 at joint 'elbow'",
        ),
        (effects.JointLimits(torch.tensor([1.0, 1.0]), torch.tensor([2.0, -1.0])), "found 1 and -1 at joint 'elbow'"),
        (effects.CommandDelay(10**7), "steps of CommandDelay must be at most 500"),
        (effects.TorqueSpeed(torch.tensor([math.inf, 5.0]), 3.0), "stall of TorqueSpeed must be finite as a tensor"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(effect, message):
    robot = torchdq.robots.load("two_link").replace(joint_names=("shoulder", "elbow"))
    with pytest.raises(torchdq.ArgumentError, match=message):
        Scene(robot, (effect,))


PARAMETERS = [(name, parameter) for name in TENSORS for parameter in getattr(effects, name).SHAPES]


WRONG = ("1", True, np.bool_(True), b"1", 1j, [True, True], ["1", "1"], (0.1, "1"), [torch.ones(())] * 2, 10**400)


@all_in_one([(*at, wrong) for at in PARAMETERS for wrong in WRONG])
def test_parameters_that_are_no_numbers_are_refused(given):
    """Words, truth values and tensors within a list, of which float() makes numbers."""
    name, parameter, wrong = given
    own, _ = TENSORS[name]()
    with pytest.raises(torchdq.ArgumentError, match=f"^{parameter} of {name} must be a number.* or a tensor, found "):
        Scene(CASES["two_link"].robot, (dataclasses.replace(own, **{parameter: wrong}),))


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_parameters_without_values_are_named(name, parameter):
    own, inputs = TENSORS[name]()
    wrong = getattr(own, parameter).detach().to("meta")
    scene = Scene(CASES["two_link"].robot, (dataclasses.replace(own, **{parameter: wrong}),))
    with pytest.raises(torchdq.ArgumentError, match=f"^{parameter} is on the device 'meta', where tensors have no val"):
        scene.step(scene.start(p(0.1, 0.2).detach(), noise=inputs.get("noise")), **inputs)


def test_numbers_of_numpy_are_numbers():
    robot, given = CASES["two_link"].robot, [np.float32(0.5), np.float64(2.0), np.int64(3)]
    for x in given:
        assert Scene(robot, (effects.Viscous(x),)).effects[0].coefficient == (float(x), float(x))
    assert Scene(robot, (effects.Viscous(given[:2]),)).effects[0].coefficient == (0.5, 2.0)
    with pytest.raises(torchdq.ArgumentError, match="acceleration of Gravity must have 3 components, found the number"):
        Scene(robot, (effects.Gravity(np.float32(9.81)),))


def test_a_payload_is_a_point_or_any_body():
    robot = torchdq.robots.load("two_link")
    for inertia in (0.0, (0.0,) * 6, (0.1, 0.0, 0.1, 0.0, 0.0, 0.1), torch.zeros(6)):
        Scene(robot, (effects.Payload(1.0, inertia=inertia), effects.Payload(torch.ones(3))))


@dataclass(frozen=True)
class Few(JointEffect):
    """An effect that forgets a joint."""

    def impedances(self, q, qd, inputs):
        return [Impedance(force=x) for x in q][:1]


@dataclass(frozen=True)
class ByTorch(JointEffect):
    """An effect that calls torch."""

    def impedances(self, q, qd, inputs):
        return [Impedance(force=torch.sin(x)) for x in q]


def test_own_effects_that_are_wrong_are_named():
    robot = torchdq.robots.load("two_link")
    with pytest.raises(torchdq.ArgumentError, match="impedances of Few must return one Impedance for each of 2 joints"):
        Scene(robot, (Few(),)).program()
    scene = Scene(robot, (ByTorch(),))
    for recorded in (scene.program, lambda: scene.step(scene.start(torch.zeros(2)))):
        with pytest.raises(NumberError, match=r"recorded number .*use the functions of torchdq"):
            recorded()


@dataclass(frozen=True, eq=False)
class Mutable(JointEffect):
    """An effect with a field that can change."""

    gains: object

    def impedances(self, q, qd, inputs):
        return [Impedance(force=1.0 * x) for x in q]


@pytest.mark.parametrize("gains", [{"k": 1.0}, [1.0], {1.0}, np.ones(2), torch.ones(2)], ids=lambda x: type(x).__name__)
def test_fields_of_effects_that_can_change_are_refused(gains):
    with pytest.raises(torchdq.ArgumentError, match=r"gains of Mutable is a .*, which can change after"):
        Scene(torchdq.robots.load("two_link"), (Mutable(gains),))
