"""Claims about every effect: parameters, those of the description, gradients, and errors."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from effect_harness import CASES, DESCRIBED, EVERY, agrees, bare, described, double, home_of, integrates, p
from helpers import all_in_one, thinned
from messages import refused

import torchdq
from torchdq import Scene, effects
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.errors import NumberError
from torchdq.scene import State
from torchdq.scene.integrators import LinearlyImplicit, RungeKutta4, SemiImplicitEuler


@pytest.mark.parametrize("name", CASES)
def test_a_bare_scene_moves_as_rigid_bodies_without_gravity_and_rotors(name):
    assert agrees(bare(name), ())


@pytest.mark.parametrize(
    "silent, spoken",
    [
        (effects.Viscous(), effects.Viscous(DESCRIBED["damping"])),
        (effects.Coulomb(sign_width=0.1), effects.Coulomb(DESCRIBED["friction"], sign_width=0.1)),
        (effects.Stribeck(static=1.0), effects.Stribeck(DESCRIBED["friction"], 1.0)),
        (effects.JointLimits(), effects.JointLimits(DESCRIBED["lower"], DESCRIBED["upper"])),
        (effects.Saturation(), effects.Saturation(DESCRIBED["effort"])),
        (effects.TorqueSpeed(), effects.TorqueSpeed(DESCRIBED["effort"], DESCRIBED["velocity"])),
        (effects.Gravity(), effects.Gravity((0.0, -9.81, 0.0))),
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
    free = torchdq.forward_dynamics(robot.replace(gravity=None), q, qd, u)  # without what the description says
    assert torch.allclose(bare_one.qd, qd + 0.01 * free, rtol=1e-11, atol=1e-11)


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


def test_parameters_without_values_are_taken_as_they_are():
    """Inside a transform of torch there is nothing to read."""
    b = bare("two_link")

    def after(d):
        return Scene(b.robot, (effects.Viscous(d),)).step(State(b.q[0], b.qd[0])).qd

    d = double([[0.1, 0.2], [0.3, 0.4]])
    found = torch.func.vmap(torch.func.jacrev(after))(d)
    assert torch.allclose(found[1], torch.func.jacrev(after)(d[1]), rtol=1e-12)


STEPPED = ("QuantisedCommand", "QuantisedReading")  # differentiable only between their steps


def test_every_effect_is_there():
    assert set(EVERY) == set(effects.__all__) - {"Effect", "HeightMap"}


def differentiable(effect, inputs, integrator, steps):
    """End of a rollout as a function of state, torque, inputs and parameters, and a point to take it at."""
    names = [name for name in effect.SHAPES if isinstance(getattr(effect, name), torch.Tensor)]
    learned = [name for name, x in inputs.items() if x.requires_grad]
    robot = home_of(type(effect).__name__)

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


def integrated(*integrators):
    """Kinds of effects, each with the integrators that take it."""
    return [(kind, integrator) for kind in EVERY for integrator in integrators if integrates(kind, integrator)]


@all_in_one(sorted(set(EVERY) - set(STEPPED)))
def test_gradients_of_a_step_are_right(kind):
    assert torch.autograd.gradcheck(*differentiable(*EVERY[kind](), LinearlyImplicit(), 1), atol=1e-7, fast_mode=True)


def _remembers(kind):
    return EVERY[kind]()[0].SLOT in ("actuator", "sensor")


# those with memory, and stiff ones; the gradients of other steps are the chain rule's
ROLLED = [kind for kind in EVERY if kind in ("Elastic", "JointLimits", "Contact", "LuGre") or _remembers(kind)]


@all_in_one(thinned(sorted(set(EVERY) - set(STEPPED)), ROLLED))
def test_gradients_of_a_rollout_are_right(kind):
    integrator = LinearlyImplicit() if kind in ("Elastic", "JointLimits", "Contact") else SemiImplicitEuler()
    steps = 4 if _remembers(kind) or kind in ("Elastic", "Contact", "LuGre") else 2
    assert torch.autograd.gradcheck(*differentiable(*EVERY[kind](), integrator, steps), atol=1e-7, fast_mode=True)


@pytest.mark.parametrize("kind", thinned(["Coulomb", "Elastic"], ("Elastic",)))
def test_gradients_through_runge_kutta_are_right(kind):
    assert torch.autograd.gradcheck(*differentiable(*EVERY[kind](), RungeKutta4(), 2), atol=1e-7, fast_mode=True)


@pytest.mark.parametrize("kind", STEPPED)
def test_gradients_through_rounding_are_those_of_a_staircase(kind):
    """Nothing comes back through it, but its step still scales what it rounds to."""
    assert torch.autograd.gradcheck(*differentiable(*EVERY[kind](), SemiImplicitEuler(), 1), atol=1e-7)


@pytest.mark.case("T10", "T11", "P11")
@pytest.mark.parametrize("where", thinned(["rest", "limit", "home"], ("limit", "home")))
def test_gradients_are_finite_where_formulas_have_corners(where):
    """At rest without a torque; at the limits exactly; and with both, at home."""
    q = {"rest": p(0.4, -0.7), "limit": p(0.2, -0.6), "home": p(0.0, 0.0)}[where]
    qd, torque = (p(0.9, -1.2), p(2.0, -0.7)) if where == "limit" else (p(0.0, 0.0), p(0.0, 0.0))
    implicit = [LinearlyImplicit()]
    for kind, integrator in integrated(*thinned([SemiImplicitEuler(), *implicit, RungeKutta4()], implicit)):
        end, (_, _, _, *rest) = differentiable(*EVERY[kind](), integrator, 2)
        x = [q, qd, torque, *rest]
        found = torch.autograd.grad(end(*x).square().sum(), x, allow_unused=True)
        assert all(x is None or bool(x.isfinite().all()) for x in found), (kind, integrator)
        assert found[0] is not None, (kind, integrator)


FLAT, LOPSIDED = (1.0, 1.0, 100.0, 0.0, 0.0, 0.0), (0.01, 0.02, 0.015, 0.0, 0.0, 0.0)  # no inertias
SENSELESS = [
    *(effects.Gravity(g) for g in (9.81, torch.tensor(9.81), torch.tensor([9.81]))),
    *(effects.Payload(1.0, com=0.1), effects.Payload(1.0, inertia=0.1), effects.Payload(1.0, inertia=FLAT)),
    *(effects.Payload(torch.ones(5), inertia=LOPSIDED), effects.Stribeck(2.0, 1.0)),
    *(effects.Stribeck(torch.tensor([1.0, 2.0]), 1.5), effects.CommandDelay(10**7)),
    effects.JointLimits(torch.tensor([1.0, 1.0]), torch.tensor([2.0, -1.0])),
    effects.TorqueSpeed(torch.tensor([math.inf, 5.0]), 3.0),
]


@pytest.mark.parametrize("effect", SENSELESS)
def test_parameters_that_make_no_sense_are_refused(effect):
    robot = torchdq.robots.load("two_link").replace(joint_names=("shoulder", "elbow"))
    with refused(torchdq.ArgumentError):
        Scene(robot, (effect,))


PARAMETERS = [(kind, name) for kind in EVERY for name in getattr(effects, kind).PARAMETERS]


@all_in_one(PARAMETERS)
def test_parameters_without_values_are_named(given):
    name, parameter = given
    own, inputs = EVERY[name]()
    wrong = getattr(own, parameter).detach().to("meta")
    scene = Scene(home_of(name), (dataclasses.replace(own, **{parameter: wrong}),))
    with refused(torchdq.ArgumentError, parameter=parameter):
        scene.step(scene.start(p(0.1, 0.2).detach(), noise=inputs.get("noise")), **inputs)


def test_numbers_of_numpy_are_numbers():
    robot, given = CASES["two_link"].robot, [np.float32(0.5), np.float64(2.0), np.int64(3)]
    for x in given:
        assert effects.Viscous(x).resolved(robot).coefficient == (float(x), float(x))
    assert effects.Viscous(given[:2]).resolved(robot).coefficient == (0.5, 2.0)


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
