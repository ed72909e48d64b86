"""Learned torques in a scene: what a network has learned acts on the joints as the physics would that it learned."""

import warnings

import helpers
import pytest
import torch
from helpers import FIXED, called, double, exhaustive, random, thinned
from messages import refused
from oracles import shipped
from torch import nn

import torchdq
from torchdq import Scene, effects
from torchdq.backends import c_library as build
from torchdq.envs import RobotVectorEnv
from torchdq.errors import ArgumentError
from torchdq.scene import State, controllers, stability
from torchdq.scene.integrators import DormandPrince, ExplicitEuler, LinearlyImplicit, RungeKutta4

ARM, PANDA = shipped("two_link").robot, shipped("panda").robot
EVERY = (*FIXED, DormandPrince())
UP_TO = 1e-12
one_thread = helpers.one_thread


def trained(learn=("friction", "offset", "mass"), robot=ARM):
    """A model whose network is no longer zero."""
    torch.manual_seed(0)
    model = torchdq.ResidualDynamics(torchdq.DQRNEA(robot, learn), hidden=(8,)).double()
    with torch.no_grad():
        for weight in model.network.parameters():
            weight.add_(0.1 * torch.randn_like(weight))
        if "offset" in learn:
            model.model.offset.add_(0.3)
    return model


def accelerations(scene, state, torque):
    """Accelerations by which an explicit step moves."""
    h = scene.dt
    return (scene.replace(integrator=ExplicitEuler()).step(state, torque).qd - state.qd) / h


# --- physics ---------------------------------------------------------------------------------------------------------


def test_a_network_that_learned_viscous_friction_is_that_friction_to_first_order_in_dt():
    """The end of a motion, against the friction itself integrated to 1e-9; halved steps halve the error."""
    q, qd, seconds = random(4, 2), random(4, 2, seed=1), 0.25
    parts = (effects.Gravity(),)
    exact = Scene(ARM, (*parts, effects.Viscous(0.8)), integrator=DormandPrince(), dt=seconds)
    expected = exact.step(exact.start(q, qd)).q
    errors = []
    learned = effects.Residual(lambda q, qd: 0.8 * qd)
    for steps in (25, 50):
        scene = Scene(ARM, (*parts, learned), integrator=RungeKutta4(), dt=seconds / steps)
        with torch.no_grad():
            errors.append(float((scene.rollout(scene.start(q, qd), steps=steps).q[-1] - expected).abs().max()))
    assert errors[0] < 1e-2
    assert 1.8 < errors[0] / errors[1] < 2.2


@pytest.mark.parametrize("learn", [(), ("friction",), ("friction", "offset", "mass", "armature", "gravity")])
def test_the_simulated_arm_accelerates_as_the_model_that_was_learned_says(learn):
    """Its torques for an acceleration, given back to the scene of its effects, cause that acceleration."""
    model = trained(learn)
    q, qd, qdd = random(3, 6, 2)
    scene = Scene(model.robot, model.effects(), dt=1e-3)
    found = accelerations(scene, State(q, qd), model(q, qd, qdd).detach())
    assert torch.allclose(found, qdd, rtol=1e-8, atol=1e-8)


@exhaustive
def test_an_arm_that_learned_from_friction_moves_as_the_arm_with_that_friction():
    """A network trained on torques of friction that its model does not know; a motion that it was not trained on."""
    generator = torch.Generator().manual_seed(3)
    ranges = double(2, 4, 10)[:, None, None]
    q, qd, qdd = (2 * torch.rand(3, 300, 2, generator=generator, dtype=torch.float64) - 1) * ranges
    tau = torchdq.inverse_dynamics(ARM, q, qd, qdd) + 1.5 * qd + 0.5 * qd / (qd * qd + 0.04).sqrt()
    torch.manual_seed(0)
    model = torchdq.ResidualDynamics(torchdq.DQRNEA(ARM), hidden=(16,)).double()
    model.standardise(q, qd, qdd, tau)
    optimiser = torch.optim.Adam(model.parameters(), 1e-2)
    for _ in range(300):
        optimiser.zero_grad()
        (model(q, qd, qdd) - tau).square().mean().backward()
        optimiser.step()
    friction = (effects.Viscous(1.5), effects.Coulomb(0.5, 0.2))
    torque = 2 * torch.sin(torch.arange(100, dtype=torch.float64) / 20)[:, None] * double(1, 0.5)
    ends = []
    for parts in ((), friction, (effects.Residual(model),)):
        scene = Scene(ARM, (effects.Gravity(), *parts), dt=0.01)
        with torch.no_grad():
            ends.append(scene.rollout(scene.start(double(0.2, -0.3)), torque).q)
    without, true, learned = ends
    assert float((learned - true).abs().max()) < 0.1 * float((without - true).abs().max())


@pytest.mark.parametrize("integrator", thinned(EVERY, EVERY[2:4]), ids=called)
def test_it_is_held_over_a_step_as_a_commanded_torque_is(integrator):
    """Every integrator: the torque of a function is that of the state at the start of the step."""
    q, qd, torque = random(3, 4, 2)
    for parts in ((), (effects.Gravity(), effects.Viscous(0.3), effects.Drag(0.2))):
        scene = Scene(ARM, (*parts, effects.Residual(lambda q, qd: q * qd + 1)), integrator=integrator, dt=0.02)
        other = Scene(ARM, parts, integrator=integrator, dt=0.02)
        found, expected = scene.step(State(q, qd), torque), other.step(State(q, qd), torque - (q * qd + 1))
        for a, b in zip(found[:2], expected[:2], strict=True):
            assert torch.allclose(a, b, rtol=UP_TO, atol=UP_TO)


# --- gradients -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("integrator", "substeps"),
    thinned(
        [(LinearlyImplicit(), 1), (RungeKutta4(), 1), (RungeKutta4(), 2)], [(LinearlyImplicit(), 1), (RungeKutta4(), 2)]
    ),
)
def test_gradients_are_those_of_finite_differences(integrator, substeps):
    """In the state, the torques, and every parameter of the network."""
    model = trained(())
    how = {"integrator": integrator, "substeps": substeps, "unroll": False}
    scene = Scene(ARM, (effects.Gravity(), effects.Residual(model)), dt=0.02, **how)

    def end(q, qd, torque, *parameters):  # gradcheck changes the parameters in place
        state = State(q, qd)
        for _ in range(2):
            state = scene.step(state, torque)
        return torch.cat(state[:2], -1)

    q, qd, torque = (x.clone().requires_grad_() for x in random(3, 1, 2))
    assert torch.autograd.gradcheck(end, (q, qd, torque, *model.parameters()), atol=1e-6, fast_mode=True)


def test_a_loss_of_a_rollout_reaches_the_network_and_a_step_against_it_lessens_it():
    model, q = trained(), random(3, 2)
    losses = []
    for _ in range(2):
        scene = Scene(model.robot, model.effects(), dt=0.01)
        loss = scene.rollout(scene.start(q), steps=10, checkpoint=3).q.square().mean()
        model.zero_grad()
        loss.backward()
        losses.append(loss.item())
        assert all(x.grad is not None and x.grad.abs().sum() > 0 for x in model.parameters())
        with torch.no_grad():
            for x in model.parameters():
                x -= 1e-3 * x.grad
    assert losses[1] < losses[0]


# --- batches, precisions, transforms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["function", "dynamics"])
def test_rows_do_not_see_each_other(model):
    acting = trained() if model == "dynamics" else (lambda q, qd: 0.3 * q * qd)
    scene = Scene(ARM, (effects.Gravity(), effects.Residual(acting)))
    q, qd = random(2, 5, 2)
    whole = scene.step(State(q, qd))
    spoiled = q.clone()
    spoiled[2] = torch.nan
    rest = [0, 1, 3, 4]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        other = scene.step(State(spoiled, qd))
    assert torch.allclose(other.qd[rest], whole.qd[rest], rtol=UP_TO, atol=UP_TO)
    assert other.qd[2].isnan().all()
    for i in range(5):
        assert torch.allclose(scene.step(State(q[i], qd[i])).qd, whole.qd[i], rtol=UP_TO, atol=UP_TO)


@pytest.mark.parametrize("acting", [trained(), nn.Bilinear(2, 2, 2), nn.Bilinear(2, 2, 2).double()])
def test_float32_states_give_what_float64_ones_do(acting):
    scene = Scene(ARM, (effects.Gravity(), effects.Residual(acting)), dt=0.01)
    q, qd = random(2, 5, 2)
    exact, single = scene.step(State(q, qd)), scene.step(State(q.float(), qd.float()))
    inside = scene.replace(precision="double").step(State(q.float(), qd.float()))
    for found in (single, inside):
        assert found.q.dtype == found.qd.dtype == torch.float32
        assert torch.allclose(found.qd.double(), exact.qd, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("model", ["function", "dynamics"])
def test_it_is_mapped_and_linearised(model):
    acting = trained() if model == "dynamics" else (lambda q, qd: 0.3 * q * qd)
    scene = Scene(ARM, (effects.Gravity(), effects.Residual(acting)), dt=0.01)
    q, qd = random(2, 5, 2)
    mapped = torch.func.vmap(lambda q, qd: scene.step(State(q, qd)).qd)(q, qd)
    assert torch.allclose(mapped, scene.step(State(q, qd)).qd, rtol=UP_TO, atol=UP_TO)
    A, B = scene.linearize(State(q, qd))
    h = 1e-6
    for k in range(4):
        d = h * torch.eye(4, dtype=torch.float64)[k]
        ends = [torch.cat(scene.step(State(q + s * d[:2], qd + s * d[2:]))[:2], -1) for s in (1, -1)]
        assert torch.allclose(A[..., k], (ends[0] - ends[1]) / (2 * h), atol=1e-6)
    assert B.shape == (5, 4, 2)


@pytest.mark.parametrize("backend", thinned(["eager", "c"], ["c"]))
def test_steps_are_traced_whole(backend):
    if backend == "c" and build.compiler() is None:
        pytest.skip("there is no C compiler")
    for acting in thinned((trained, lambda: nn.Bilinear(2, 2, 2).double()), (trained,)):
        scene = Scene(ARM, (effects.Gravity(), effects.Residual(acting())), backend=backend)
        traced = torch.compile(lambda q, qd, scene=scene: scene.step(State(q, qd)).qd, fullgraph=True, backend="eager")
        q, qd = random(2, 5, 2)
        assert torch.allclose(traced(q, qd), scene.step(State(q, qd)).qd, rtol=UP_TO, atol=UP_TO)


# --- in scenes and environments --------------------------------------------------------------------------------------


def test_it_costs_a_sum_per_joint_and_its_program_serves_every_network():
    bare = Scene(PANDA, (effects.Gravity(),))
    scenes = [bare.replace(effects=(*bare.effects, effects.Residual(f))) for f in (torch.add, trained((), PANDA))]
    assert scenes[0].count().total - bare.count().total == PANDA.n
    assert scenes[0].spec is scenes[1].spec
    assert scenes[0].inputs == bare.inputs


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (trained(), "network of 130 numbers in a ResidualDynamics"),
        *thinned([(nn.Bilinear(2, 2, 2), "network of 10 numbers in a Bilinear"), (torch.mul, "function")], []),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_a_description_tells_the_size_of_the_network_and_what_it_adds_to(model, words):
    found = Scene(ARM, (effects.Viscous(0.1), effects.Residual(model))).describe(batch=8, seconds=5.0)
    line = f"Residual: a {words}, run by torch once per step, adds to the joint torques of the rigid bodies"
    assert found.outside == (f"{line} and other effects",)
    assert "\ncomputed outside the program, and not among the operations:\n- Residual: a " in str(found)
    assert [cost.effect for cost in found.costs] == ["bare step", "Viscous", "Residual"]
    assert found.costs[-1].nanoseconds > 0 or not isinstance(model, torchdq.ResidualDynamics)  # others take no time
    assert Scene(ARM).describe(batch=1, seconds=0.0).outside == ()


def test_a_check_of_the_step_counts_its_torques(monkeypatch):
    monkeypatch.setattr(stability, "FEW", 8)  # of trials of shorter steps, none of which hold
    assert Scene(ARM).check(Scene(ARM).start(double(0.1, 0.2)), seconds=0.2)
    scene = Scene(ARM, (effects.Residual(lambda q, qd: -400.0 * qd),))  # grows with the velocity
    assert not scene.check(scene.start(double(0.1, 0.2), double(0.1, 0.1)), seconds=0.2)


@pytest.mark.parametrize("action", thinned(["torque", "residual"], ("residual",)))
def test_environments_have_it(action):
    parts = (effects.Gravity(), effects.RotorInertia(0.1), effects.Residual(trained((), PANDA)))
    envs = RobotVectorEnv(3, "reach", PANDA, effects=parts, action=action, dtype="float64")
    others = RobotVectorEnv(3, "reach", PANDA, effects=parts[:2], action=action, dtype="float64")
    first, second = (x.reset(seed=0)[0] for x in (envs, others))
    assert torch.equal(first, second)
    first, second = (x.step(torch.full((3, 7), 0.1))[0] for x in (envs, others))
    assert first.isfinite().all() and not torch.allclose(first, second)
    alone = RobotVectorEnv(1, "reach", PANDA, effects=parts, action=action, dtype="float64")
    alone.reset(seed=2)
    assert torch.allclose(alone.step(torch.full((1, 7), 0.1))[0][0], first[2], rtol=1e-9, atol=1e-9)


def test_a_controller_and_a_rollout_by_a_policy_see_it():
    model = trained()
    scene = Scene(model.robot, model.effects(), controllers.ComputedTorque(100.0, 20.0), dt=0.004)
    q = double(0.3, -0.4)
    wanted = torch.cat([q, 0 * q, 0 * q])
    control = torchdq.ComputedTorque(model, 100.0, 20.0)
    plain = scene.replace(controller=None)
    with torch.no_grad():
        held = scene.rollout(scene.start(q), steps=100, reference=wanted.expand(100, -1)).q[-1]
        known = plain.rollout(plain.start(q), steps=100, policy=lambda s, k: control(s.q, s.qd, q, 0 * q, 0 * q)).q[-1]
    assert float((held - q).abs().max()) > 1e-3  # the described model does not know what was learned
    assert float((known - q).abs().max()) < 1e-6


# --- errors ----------------------------------------------------------------------------------------------------------


def returning(result):
    scene = Scene(ARM, (effects.Residual(lambda q, qd: result),))
    return scene.step(scene.start(torch.zeros(4, 2)))


ADDING = Scene(ARM, (effects.Residual(torch.add),))
MISUSE = {
    "module as an effect": lambda: Scene(ARM, (nn.Linear(2, 2),)),
    "number": lambda: Scene(ARM, (effects.Residual(3.0),)),
    "class": lambda: Scene(ARM, (effects.Residual(nn.Bilinear),)),
    "model of all bodies": lambda: Scene(ARM, (effects.Residual(torchdq.DQRNEA(ARM)),)),
    "model of another robot": lambda: Scene(ARM, (effects.Residual(trained((), PANDA)),)),
    "two models": lambda: Scene(ARM, (effects.Residual(torch.add), effects.Residual(torch.mul))),
    "model that returns nothing": lambda: returning(None),
    "torques of three joints": lambda: returning(torch.ones(3)),
    "torques of one row": lambda: returning(torch.ones(2)),
    "torques from elsewhere": lambda: ADDING.step(ADDING.start(torch.zeros(2)), residual=torch.zeros(2)),
    "recommended settings": lambda: torchdq.recommend_settings(ADDING),
}


@pytest.mark.parametrize("what", MISUSE)
def test_what_a_residual_cannot_be_is_refused(what):
    with refused(ArgumentError):
        MISUSE[what]()
