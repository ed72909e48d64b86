"""Claims about every effect: parameters, those of the description, gradients, and errors."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from effect_harness import CASES, agrees, bare, described, described_as, double
from helpers import all_in_one
from messages import refused

import torchdq
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.envs import Scene, State, effects
from torchdq.errors import NumberError
from torchdq.scene.integrators import LinearlyImplicit, RungeKutta4, SemiImplicitEuler


@pytest.mark.parametrize("name", CASES)
def test_a_bare_scene_moves_as_rigid_bodies_without_gravity_and_rotors(name):
    assert agrees(bare(name), ())


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
    with refused(torchdq.ArgumentError):
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
        with refused(torchdq.ArgumentError, parameter=f"{name} of {kind.__name__}"):
            made(kind, name, value)


def test_parameters_without_values_are_taken_as_they_are():
    """Inside a transform of torch there is nothing to read."""
    b = bare("two_link")

    def after(d):
        return Scene(b.robot, (effects.Viscous(d),)).step(State(b.q[0], b.qd[0])).qd

    d = double([[0.1, 0.2], [0.3, 0.4]])
    found = torch.func.vmap(torch.func.jacrev(after))(d)
    assert torch.allclose(found[1], torch.func.jacrev(after)(d[1]), rtol=1e-12)


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


@pytest.mark.parametrize(
    "effect",
    [
        effects.Gravity(9.81),
        effects.Gravity(torch.tensor(9.81)),
        effects.Gravity(torch.tensor([9.81])),
        effects.Payload(1.0, com=0.1),
        effects.Payload(1.0, inertia=0.1),
        effects.Payload(1.0, inertia=(1.0, 1.0, 100.0, 0.0, 0.0, 0.0)),
        effects.Payload(torch.ones(5), inertia=(0.01, 0.02, 0.015, 0.0, 0.0, 0.0)),
        effects.Stribeck(2.0, 1.0),
        effects.Stribeck(torch.tensor([1.0, 2.0]), 1.5),
        effects.JointLimits(torch.tensor([1.0, 1.0]), torch.tensor([2.0, -1.0])),
        effects.CommandDelay(10**7),
        effects.TorqueSpeed(torch.tensor([math.inf, 5.0]), 3.0),
    ],
)
def test_parameters_that_make_no_sense_are_refused(effect):
    robot = torchdq.robots.load("two_link").replace(joint_names=("shoulder", "elbow"))
    with refused(torchdq.ArgumentError):
        Scene(robot, (effect,))


PARAMETERS = [(name, parameter) for name in TENSORS for parameter in getattr(effects, name).SHAPES]


WRONG = ("1", True, np.bool_(True), b"1", 1j, [True, True], ["1", "1"], (0.1, "1"), [torch.ones(())] * 2, 10**400)


@all_in_one([(*at, wrong) for at in PARAMETERS for wrong in WRONG])
def test_parameters_that_are_no_numbers_are_refused(given):
    """Words, truth values and tensors within a list, of which float() makes numbers."""
    name, parameter, wrong = given
    own, _ = TENSORS[name]()
    with refused(torchdq.ArgumentError, parameter=f"{parameter} of {name}", found=repr(wrong)):
        Scene(CASES["two_link"].robot, (dataclasses.replace(own, **{parameter: wrong}),))


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_parameters_without_values_are_named(name, parameter):
    own, inputs = TENSORS[name]()
    wrong = getattr(own, parameter).detach().to("meta")
    scene = Scene(CASES["two_link"].robot, (dataclasses.replace(own, **{parameter: wrong}),))
    with refused(torchdq.ArgumentError, parameter=parameter):
        scene.step(scene.start(p(0.1, 0.2).detach(), noise=inputs.get("noise")), **inputs)


def test_numbers_of_numpy_are_numbers():
    robot, given = CASES["two_link"].robot, [np.float32(0.5), np.float64(2.0), np.int64(3)]
    for x in given:
        assert Scene(robot, (effects.Viscous(x),)).effects[0].coefficient == (float(x), float(x))
    assert Scene(robot, (effects.Viscous(given[:2]),)).effects[0].coefficient == (0.5, 2.0)
    with refused(torchdq.ArgumentError):
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
    with refused(torchdq.ArgumentError):
        Scene(robot, (Few(),)).program()
    scene = Scene(robot, (ByTorch(),))
    for recorded in (scene.program, lambda: scene.step(scene.start(torch.zeros(2)))):
        with refused(NumberError):
            recorded()


@dataclass(frozen=True, eq=False)
class Mutable(JointEffect):
    """An effect with a field that can change."""

    gains: object

    def impedances(self, q, qd, inputs):
        return [Impedance(force=1.0 * x) for x in q]


@pytest.mark.parametrize("gains", [{"k": 1.0}, [1.0], {1.0}, np.ones(2), torch.ones(2)], ids=lambda x: type(x).__name__)
def test_fields_of_effects_that_can_change_are_refused(gains):
    with refused(torchdq.ArgumentError):
        Scene(torchdq.robots.load("two_link"), (Mutable(gains),))
