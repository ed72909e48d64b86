"""Scenes: what is off is absent, controllers are what their equations say, and tensors go in and out as they should.

What each effect does is the claim of tests/effects, how time passes that of test_integrators.py.
"""

import dataclasses
import itertools
import math

import numpy as np
import pinocchio as pin
import pytest
import torch
from effect_harness import EVERY, constant, home_of
from helpers import FIXED, WHEEL, all_in_one, called, double, exhaustive, random, thinned
from messages import refused
from oracles import shipped, states
from scenes import ARM, PANDA, RICH, TREE, ZERO, equal, inputs_of, rich, uniform

import torchdq
from torchdq import Scene, effects
from torchdq.backends import c_library as build
from torchdq.scene import State
from torchdq.scene import recording as plans
from torchdq.scene.controllers import PD, ComputedTorque
from torchdq.scene.integrators import DormandPrince, RungeKutta4, SemiImplicitEuler, StoermerVerlet

needs_compiler = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")


# --- off is absent ---------------------------------------------------------------------------------------------------

NOTHING = {
    "Viscous": effects.Viscous(0.0),
    "Coulomb": effects.Coulomb(0.0),
    "Stribeck": effects.Stribeck(0.0, 0.0),
    "Quadratic": effects.Quadratic(0.0),
    "Directional": effects.Directional(0.0, 0.0),
    "LoadDependent": effects.LoadDependent(0.0),
    "Ripple": effects.Ripple(0.1, 0.0, 0.0),
    "Spring": effects.Spring(0.0, 0.3),
    "Servo": effects.Servo(0.0, 0.0),
    "Limits": effects.JointLimits(-math.inf, math.inf),
    "Limits without stiffness": effects.JointLimits(-1.0, 1.0, 0.0),
    "Drag": effects.Drag(0.0, 0.0, 0.0),
    "PointSpring": effects.PointSpring(stiffness=0.0),
    "Contact": effects.Contact(stiffness=0.0, stiction=False),
    "RotorInertia": effects.RotorInertia(0.0),
    "MassScale": effects.MassScale(1.0),
    "Payload": effects.Payload(0.0, (0.1, 0.2, 0.3)),
    "Gravity": effects.Gravity((0.0, 0.0, 0.0)),
    "Saturation": effects.Saturation(math.inf),
    "TorqueSpeed": effects.TorqueSpeed(math.inf, 1.0),
    "Bias": effects.Bias(0.0, 0.0),
    "QuantisedReading": effects.QuantisedReading(0.0, 0.0),
}


@pytest.mark.case("T14")
@pytest.mark.parametrize("robot", thinned([ARM, PANDA], [ARM]), ids=lambda robot: robot.name)
def test_an_effect_of_no_size_is_no_operation(robot):
    """Constants fold, so nothing is left of it; results are the same bit by bit."""
    bare, s = Scene(robot), states(robot)
    expected = bare.step(State(s.q, s.qd), s.qdd)[:2]
    for kind, effect in NOTHING.items():
        made, inputs = Scene(robot, (effect,)), {"target": s.q} if kind == "Servo" else {}
        assert made.count() == bare.count(), kind
        assert equal(made.step(made.start(s.q, s.qd), s.qdd, **inputs)[:2], expected), kind


@pytest.mark.case("T14")
@pytest.mark.parametrize("integrator", thinned(FIXED, FIXED[2:4]), ids=called)
def test_an_effect_of_no_size_leaves_the_very_same_program(integrator):
    bare = Scene(TREE, integrator=integrator)
    for kind in ("Viscous", "Coulomb", "Spring", "Limits", "Saturation", "RotorInertia"):
        assert bare.replace(effects=(NOTHING[kind],)).program().ops == bare.program().ops, kind


@pytest.mark.case("T14")
@all_in_one(EVERY)
def test_a_scene_without_its_effect_is_one_that_never_had_it(kind):
    (effect, _), damped = constant(kind), Scene(home_of(kind), (effects.Viscous(0.2),))
    assert (
        damped.replace(effects=(effect,)).replace(effects=()).spec is damped.replace(effects=()).spec
    )  # and so are its programs
    assert damped.replace(effects=(effect, *damped.effects)).replace(effects=damped.effects).spec is damped.spec


@pytest.mark.case("T14")
@all_in_one(EVERY)
def test_an_effect_costs_what_its_description_says(kind):
    """Operations of the bare step and of its parts add up to those of the scene."""
    (effect, _), damped = constant(kind), Scene(home_of(kind), (effects.Viscous(0.2),))
    scene = damped.replace(effects=(*damped.effects, effect))
    description = scene.describe(batch=2, seconds=0.0)
    bare, first, second = description.costs
    assert bare.operations == damped.replace(effects=()).count().total
    assert bare.operations + first.operations == damped.count().total
    assert (second.effect, second.slot) == (kind, effect.SLOT)
    assert sum(cost.operations for cost in description.costs) == description.total.operations == scene.count().total
    # moved, or folded into constants
    free = (effects.CommandDelay, effects.MeasurementDelay, effects.MassScale, effects.RotorInertia)
    assert (second.operations == 0) == isinstance(effect, free)


@pytest.mark.parametrize("robot", thinned([ARM, TREE, PANDA], [TREE]), ids=lambda robot: robot.name)
@pytest.mark.parametrize("integrator", FIXED, ids=called)
def test_a_resting_arm_of_a_bare_scene_stays_where_it_is(integrator, robot):
    """No gravity, whatever the robot has: bit by bit the same place."""
    q = states(robot).q
    state = Scene(robot, integrator=integrator).rollout(State(q, torch.zeros_like(q)), steps=3)
    assert torch.equal(state.q, q.expand(3, *q.shape))
    assert not state.qd.any()


def test_a_program_takes_the_inputs_of_its_scene():
    with refused(torchdq.ArgumentError):
        Scene(ARM).program("wind")


STRICT = Scene(ARM, (effects.Servo(1.0), effects.Push(), effects.CommandDelay(1), effects.Noise(0.1)), PD(1.0, 1.0))


THREE, SEVEN = torch.zeros(5, 3, dtype=torch.float64), torch.zeros(5, 7, dtype=torch.float64)
UNFIT = [
    *({"trgt": ZERO}, {"trgt": None}, {"q": ZERO}, {"target": None}, {"reference": None}, {"target": THREE[0]}),
    *({"torque": ZERO[:1]}, {"push": ZERO}, {"noise": ZERO}, {"torque": ZERO.float()}, {"torque": [0.0, 0.0]}),
    *({"torque": ZERO.numpy()}, {"torque": torch.zeros(7, 2, dtype=torch.float64)}),
    *({"state": x} for x in ({"q": SEVEN}, {"qd": THREE}, {"memory": None}, {"reading": None}, {"memory": THREE})),
]


@pytest.mark.case("P8", "P14")
@pytest.mark.parametrize("integrator", [SemiImplicitEuler(), DormandPrince()], ids=called)
@pytest.mark.parametrize("change", UNFIT)
def test_what_does_not_fit_at_a_step_is_refused_by_name(change, integrator):
    """At every step, also after one that fits."""
    scene = STRICT.replace(integrator=integrator)
    state = scene.start(torch.zeros(5, 2, dtype=torch.float64))
    given = {"target": ZERO, "reference": torch.zeros(6, dtype=torch.float64)}
    scene.step(state, **given)
    state = state._replace(**change.get("state", {}))
    given |= {name: x for name, x in change.items() if name != "state"}
    with refused((torchdq.ArgumentError, torchdq.DtypeError)):
        scene.step(state, **given)


def test_a_misspelt_input_is_refused_even_if_it_is_none():
    scene = Scene(torchdq.robots.load("two_link"))
    state = scene.start(ZERO)
    for use in (scene.check, scene.linearize, lambda state, **inputs: scene.rollout(state, steps=2, **inputs)):
        with refused(torchdq.ArgumentError):
            use(state, trgt=None)


# --- tensors ---------------------------------------------------------------------------------------------------------


@pytest.mark.case("P2")
@pytest.mark.parametrize("integrator", FIXED[1:4], ids=called)
def test_batch_axes_broadcast(integrator):
    """State, inputs and parameters each with their own axes are the same, bit by bit, as all of them written out."""
    q, qd, torque, push = random(4, 1, 2), random(2, seed=1), random(3, 2, seed=2), random(4, 3, 6, seed=3)
    d, g = random(4, 1, 2, seed=4).abs(), random(3, 3, seed=5)
    full = [x.expand(4, 3, x.shape[-1]).contiguous() for x in (q, qd, torque, push, d, g)]

    def end(q, qd, torque, push, d, g):
        parts = (effects.Viscous(d), effects.Gravity(g), effects.Push(), effects.FirstOrderLag(0.1))
        scene = Scene(ARM, parts, integrator=integrator)
        return scene.step(scene.start(q, qd), torque, push=push)

    found = end(q, qd, torque, push, d, g)
    assert found.q.shape == (4, 3, 2)
    assert equal(found, end(*full))


def test_an_adaptive_step_broadcasts_too():
    parts = (effects.Elastic(20.0, 0.1, 0.1), effects.Viscous(random(3, 1, 2).abs()))
    scene = Scene(ARM, parts, integrator=DormandPrince())
    found = scene.step(scene.start(random(2)), random(4, 2, seed=1))
    assert [tuple(x.shape) for x in found if x is not None] == [(3, 4, 2), (3, 4, 2), (3, 4, 4)]


@pytest.mark.case("P1")
@pytest.mark.parametrize("shape", [(0,), (3, 0), (0, 4)])
@pytest.mark.parametrize("integrator", [*FIXED, DormandPrince()], ids=called)
def test_a_batch_may_be_empty(integrator, shape):
    scene = Scene(ARM, (effects.Gravity(), effects.FirstOrderLag(0.1), effects.Bias(0.1)), integrator=integrator)
    q = torch.zeros(*shape, 2, dtype=torch.float64, requires_grad=True)
    after = scene.step(scene.start(q), ZERO)
    assert [tuple(x.shape) for x in after.rows().values()] == [(*shape, 2), (*shape, 2), (*shape, 2), (*shape, 4)]
    after.q.sum().backward()
    assert q.grad.shape == q.shape


@pytest.mark.parametrize("robot", [ARM, PANDA], ids=lambda robot: robot.name)
def test_single_precision_stays_single(robot):
    scene = rich(robot)
    state = scene.start(random(4, robot.n) * 0.3, random(4, robot.n, seed=1), uniform(scene, 4))
    exact = scene.step(state, noise=uniform(scene, 4), **inputs_of(scene, 4))
    single = state.to(torch.float32)
    found = scene.step(single, noise=uniform(scene, 4).float(), **inputs_of(scene, 4, dtype=torch.float32))
    for a, b in zip(found.rows().values(), exact.rows().values(), strict=True):
        assert a.dtype == torch.float32
        assert (a - b).abs().max() < 1e-3 * (1 + b.abs().max())


def test_parameters_follow_the_dtype_of_the_state():
    scene = Scene(ARM, (effects.Viscous(double(0.1, 0.2)), effects.Gravity()))
    assert scene.step(scene.start(torch.zeros(3, 2))).q.dtype == torch.float32


@pytest.mark.case("T13", "P9")
def test_a_sample_that_is_nan_takes_no_other_with_it():
    scene, d = rich(ARM), random(5, 2, seed=6).abs()
    scene = scene.replace(effects=(*RICH, effects.Spring(d)))
    noise, inputs = uniform(scene, 5), inputs_of(scene, 5)
    good = scene.start(random(5, 2), random(5, 2, seed=1), noise)
    bad = State(**{name: x.clone() for name, x in good.rows().items()})
    bad.q[2] = math.nan
    bad.qd[3] = math.inf
    others = [0, 1, 4]

    def end(state):
        q = state.q.clone().requires_grad_()
        after = scene.step(state._replace(q=q), noise=noise, **inputs)
        (gradient,) = torch.autograd.grad(after.q[others].sum() + after.qd[others].sum(), q)
        return *after.rows().values(), gradient

    for a, b in zip(end(good), end(bad), strict=True):
        assert torch.equal(a[others], b[others])
    assert end(bad)[0][2].isnan().any()


COMPILED = {
    "effects of every slot": rich(ARM),
    "Runge-Kutta": rich(ARM).replace(integrator=RungeKutta4(), effects=[x for x in RICH if not x.IMPLICIT]),
    "Verlet": Scene(TREE, RICH[:4], integrator=StoermerVerlet(2)),
    "panda": Scene(PANDA, RICH[:6]),
}
PAIRS = [*itertools.product(COMPILED, (torch.float64, torch.float32))]


@needs_compiler
@pytest.mark.parametrize(("which", "dtype"), thinned(PAIRS, [PAIRS[4]]), ids=str)
def test_compiled_scenes_agree_with_eager_ones(which, dtype):
    """Values and gradients, of state, inputs and parameters, over three steps."""
    scene, tolerance = COMPILED[which], 1e-11 if dtype == torch.float64 else 2e-3

    def end(backend):
        d = torch.full((4, scene.n), 0.3, dtype=dtype, requires_grad=True)
        inputs = {name: x.requires_grad_() for name, x in inputs_of(scene, 4, dtype=dtype).items()}
        q, qd = ((0.3 * random(4, scene.n, seed=k)).to(dtype).requires_grad_() for k in range(2))
        run = scene.replace(backend=backend, effects=(*scene.effects, effects.Viscous(d)))
        noise = uniform(run, 4).to(dtype) if run.noises else None
        state = run.start(q, qd, noise)
        for _ in range(3):
            state = run.step(state, noise=noise, **inputs)
        total = sum((x * x).sum() for x in state if x is not None)
        return *state, *torch.autograd.grad(total, [d, q, qd, *inputs.values()])

    for a, b in zip(end("c"), end("eager"), strict=True):
        assert (a is None and b is None) or (a - b).abs().max() <= tolerance * (1 + b.abs().max())


# --- programs --------------------------------------------------------------------------------------------------------


def test_new_values_of_tensors_need_no_new_recording():
    def scene(k):
        parts = (effects.Viscous(random(2, seed=k).abs()), effects.Payload(random(4, seed=k).abs()))
        gains = random(2, seed=k).abs(), 1.0
        return Scene(ARM.replace(mass=ARM.mass * (1 + k)), parts, ComputedTorque(*gains))

    def step(k):
        return scene(k).step(State(random(4, 2), random(4, 2, seed=1)), reference=random(6)).qd

    first = step(0)
    before = plans._program.cache_info().misses
    assert not torch.equal(step(1), first)
    assert not torch.equal(step(2), first)
    assert plans._program.cache_info().misses == before


def test_equal_scenes_share_their_programs():
    assert rich(ARM).spec is rich(ARM).spec
    assert rich(ARM).spec is not rich(ARM, dt=0.02).spec
    assert Scene(ARM, (effects.Viscous(0.1),)).spec is not Scene(ARM, (effects.Viscous(0.2),)).spec
    assert Scene(ARM, (effects.Viscous(double(0.1)),)).spec is Scene(ARM, (effects.Viscous(double(0.2)),)).spec


def test_substeps_in_a_loop_change_the_program_of_a_substep_alone(monkeypatch):
    scene = Scene(ARM, (effects.Viscous(0.0123), effects.Bias(0.1)), PD(9.0, 1.0))
    names, record = [], plans.record
    monkeypatch.setattr(plans, "record", lambda name, *given: names.append(name) or record(name, *given))
    for integrator, substeps in ((RungeKutta4(), 2), (RungeKutta4(), 4), (SemiImplicitEuler(), 4)):
        other = scene.replace(integrator=integrator, substeps=substeps, unroll=False)
        other.step(other.start(ZERO), reference=double(*[0.1] * 6))
    stages = ("begin", "drive", "sense", "substep", "substep")
    assert sorted(names) == [f"{stage}_two_link" for stage in stages]


def test_a_scene_cannot_be_changed_but_replaced():
    scene = Scene(ARM)
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.dt = 0.1
    assert scene.replace(dt=0.1).dt == 0.1 and scene.dt == 0.01


def test_the_energy_is_that_of_pinocchio():
    case = shipped("panda")
    data, s = case.model.createData(), states(PANDA)
    found = Scene(PANDA, (effects.Gravity(),)).energy(State(s.q, s.qd)).numpy()
    for k in range(len(found)):
        q, qd = case.configuration(s.q[k]), case.velocity(s.qd[k])
        assert found[k, 0] == pytest.approx(pin.computeKineticEnergy(case.model, data, q, qd), rel=1e-12)
    rise = [pin.computePotentialEnergy(case.model, data, case.configuration(q)) for q in s.q]
    assert np.diff(found[:, 1]) == pytest.approx(np.diff(rise), rel=1e-11)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_readings_are_the_same_from_the_first_in_any_order_of_bias_and_delay(order):
    sensors = (effects.Bias(0.1), effects.MeasurementDelay(2))
    scene = Scene(ARM, [sensors[i] for i in order])
    state = scene.start(double(0.3, -0.2))
    for _ in range(4):
        assert torch.allclose(state.measured[0], double(0.4, -0.1))
        state = scene.step(state)


def test_a_motor_behind_a_spring_runs_out_of_torque_at_its_own_speed():
    scene = Scene(ARM, (effects.Elastic(50.0, inertia=0.5), effects.TorqueSpeed(10.0, 1.0)), dt=1e-3)
    state = scene.start(ZERO)
    fast = state._replace(memory=torch.cat([ZERO, double(5.0, 5.0)]))  # the rotors, at five times that speed
    after = scene.step(fast, double(10.0, 10.0))
    assert torch.allclose(after.memory[2:], double(5.0, 5.0), atol=1e-3)


def test_a_learned_damping_of_the_robot_is_learned_in_a_scene():
    damping = double(0.1, 0.2).requires_grad_()
    scene = Scene(ARM.replace(damping=damping), (effects.Viscous(),))
    state = scene.step(scene.start(ZERO, double(1.0, 1.0)))
    (gradient,) = torch.autograd.grad(state.qd.sum(), damping)
    assert bool((gradient != 0).any())


# --- graphs ----------------------------------------------------------------------------------------------------------


@needs_compiler
def test_a_start_has_a_graph_of_what_its_reading_depends_on_alone():
    """Two rollouts from a state share its graph, which torch walks once."""
    q, others = double(0.3, -0.2), [x.requires_grad_() for x in (ARM.mass.clone(), double(9.0, 8.0), double(0.2, 0.1))]

    def scene(bias):
        mass, kp, damping = others
        parts = (effects.Viscous(damping), effects.Bias(bias), effects.MeasurementDelay(1))
        return Scene(ARM.replace(mass=mass), parts, PD(kp, 1.0), backend="c")

    def gradients(scene, state, *wrt):
        return torch.autograd.grad(scene.rollout(state, reference=ZERO.new_zeros(3, 6)).q.sum(), wrt)

    known, bias = scene(0.1), double(0.1, 0.1).requires_grad_()
    state = known.start(q)
    for a, b in zip(gradients(known, state, *others), gradients(known, state, *others), strict=True):
        assert torch.equal(a, b) and bool((a != 0).any())
    learned = scene(bias)
    state = learned.start(q)
    (first,) = gradients(learned, state, bias)
    with pytest.raises(RuntimeError):
        gradients(learned, state, bias)
    assert torch.equal(gradients(learned, learned.start(q), bias)[0], first)


@exhaustive
@pytest.mark.case("P4")
def test_steps_are_traced_whole():
    """torch.compile without a break, with gradients in parameters; hard_cases/test_tensors.py has compiled programs."""
    learned = double(0.1).requires_grad_()
    scene = Scene(WHEEL, (effects.Gravity(), effects.Viscous(learned), effects.Coulomb(0.2)))

    def roll(q, qd):
        return scene.step(State(q, qd), q).qd

    traced = torch.compile(roll, fullgraph=True, backend="aot_eager")
    for batch in (3, 5):
        q = random(batch, 1)
        found, expected = traced(q, 0 * q), roll(q, 0 * q)
        assert torch.equal(found, expected)
        gradients = [torch.autograd.grad(x.sum(), learned)[0] for x in (found, expected)]
        assert torch.allclose(*gradients, rtol=1e-13)
