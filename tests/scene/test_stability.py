"""Scenes say which steps hold, which rows were lost, and what their steps are in the neighbourhood of a state."""

import math
import warnings

import pytest
import torch
from helpers import INERTIA, WHEEL, called, double, random, thinned
from oracles import random_tree, shipped

import torchdq
from torchdq.envs import Scene, State, effects
from torchdq.scene.controllers import PD, ComputedTorqueController
from torchdq.scene.integrators import (
    DormandPrince,
    ExplicitEuler,
    LinearlyImplicit,
    Repeated,
    RungeKutta4,
    SemiImplicitEuler,
    StoermerVerlet,
)

ARM = shipped("two_link").robot
TREE = random_tree(3, seed=6, armature=True).robot
PANDA = shipped("panda").robot
HOME = double(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
EXPLICIT = [ExplicitEuler(), SemiImplicitEuler(), RungeKutta4(), StoermerVerlet()]

# --- the step --------------------------------------------------------------------------------------------------------

# damping times step over inertia, and angular frequency times step, up to which textbooks say that methods are stable
DAMPED = {ExplicitEuler(): 2.0, SemiImplicitEuler(): 2.0, RungeKutta4(): 2.785293563405282}
SWINGING = {SemiImplicitEuler(): 2.0, RungeKutta4(): 2 * math.sqrt(2)}


def verdict(effect, integrator, dt=0.01, **inputs):
    scene = Scene(WHEEL, (effect,), integrator=integrator, dt=dt)
    return scene.check(scene.start(double(0.1), double(0.1)), seconds=dt, **inputs)


@pytest.mark.parametrize("integrator", DAMPED, ids=called)
def test_the_bound_of_damping_is_that_of_the_textbook(integrator):
    coefficient = DAMPED[integrator] * INERTIA / 0.01
    assert verdict(effects.Viscous(0.99 * coefficient), integrator)
    assert not verdict(effects.Viscous(1.01 * coefficient), integrator)
    assert verdict(effects.Viscous(1e6 * coefficient), LinearlyImplicit())


@pytest.mark.parametrize("integrator", SWINGING, ids=called)
def test_the_bound_of_stiffness_is_that_of_the_textbook(integrator):
    stiffness = INERTIA * (SWINGING[integrator] / 0.01) ** 2
    assert verdict(effects.Spring(0.98 * stiffness), integrator)
    assert not verdict(effects.Spring(1.02 * stiffness), integrator)
    assert verdict(effects.Spring(1e6 * stiffness), LinearlyImplicit())


def test_explicit_euler_swings_up_at_any_step():
    assert not verdict(effects.Spring(10.0), ExplicitEuler())


@pytest.mark.parametrize("integrator", [*EXPLICIT, Repeated(SemiImplicitEuler(), 1)], ids=called)
def test_elastic_joints_are_part_of_it(integrator):
    """A wheel and a rotor of half its inertia swing at w^2 = k (1/I + 2/I)."""
    bound = {"RungeKutta4": 2 * math.sqrt(2)}.get(called(integrator), 2.0)
    stiffness = (bound / 0.01) ** 2 * INERTIA / 3
    hard, soft = (effects.Elastic(f * stiffness, 1e-4, INERTIA / 2) for f in (1.1, 0.5))
    assert not verdict(hard, integrator)
    assert verdict(soft, integrator) or called(integrator) in ("ExplicitEuler", "StoermerVerlet")
    assert verdict(hard, LinearlyImplicit())


def test_friction_at_rest_is_as_stiff_as_its_width_is_small():
    scene = Scene(WHEEL, (effects.Coulomb(0.1, 0.01),), integrator=SemiImplicitEuler())
    at_rest = scene.check(scene.start(double(0.0)), seconds=0.01)
    assert at_rest.growth == pytest.approx(0.01 * 0.1 / 0.01 / INERTIA - 1, rel=1e-6)
    assert scene.replace(dt=1e-3).check(scene.start(double(0.0)), seconds=0.01)


STIFF = {
    "Viscous": (effects.Viscous(500.0), {}),
    "Servo": (effects.Servo(1e5, 1e3), {"target": double(0.3, 0.3)}),
    "JointLimits": (effects.JointLimits(-0.5, 0.5, 1e6), {}),
    "Spring": (effects.Spring(1e6), {}),
    "Elastic": (effects.Elastic(1e6, 1.0, 0.1), {}),
}


@pytest.mark.parametrize("kind", thinned(STIFF, [kind for kind in STIFF if kind != "JointLimits"]))
def test_what_does_not_hold_says_what_does(kind):
    effect, inputs = STIFF[kind]
    scene = Scene(ARM, (effects.Gravity(), effect), integrator=SemiImplicitEuler())
    start = scene.start(double(0.45, 0.45), double(1.0, 1.0))
    found = scene.check(start, **inputs)
    assert not found
    assert bool(found.diverged)
    first, second = found.alternatives
    assert (first.integrator, first.substeps) == (LinearlyImplicit(), 1)
    assert (second.integrator, second.step) == (SemiImplicitEuler(), 0.01 / second.substeps)
    assert "do not hold" in str(found) and f"substeps={second.substeps}" in str(found)
    for other in found.alternatives:
        held = scene.replace(integrator=other.integrator, substeps=other.substeps).check(start, 0.2, **inputs)
        assert held and held.alternatives == () and str(held).endswith(" hold")


def test_the_joint_with_the_least_inertia_is_named():
    scene = Scene(PANDA, (effects.Gravity(), effects.Viscous(5.0)), integrator=SemiImplicitEuler())
    found = scene.check(scene.start(HOME), seconds=0.05)
    assert found.joint == "panda_joint7"
    assert "of panda_joint7" in str(found)


@pytest.mark.parametrize("integrator", [*EXPLICIT, LinearlyImplicit()], ids=called)
def test_a_falling_arm_is_not_stiff(integrator):
    scene = Scene(PANDA, (effects.Gravity(), effects.RotorInertia(0.1)), integrator=integrator)
    assert scene.check(scene.start(HOME), seconds=0.5)


def test_rows_are_lost_one_by_one():
    """A sample whose step is too long is found; a row that was not finite at the start is not lost."""
    damping = double(0.1, 500.0, 0.1)[:, None].expand(3, 2)
    scene = Scene(ARM, (effects.Viscous(damping),), integrator=SemiImplicitEuler())
    start = scene.start(double((0.1, 0.2), (0.1, 0.2), (math.nan, 0.2)), double(0.1, 0.2))
    with pytest.warns(UserWarning, match="1 of 3 rows have a non-finite initial state"):
        found = scene.check(start, seconds=2.0)
    assert found.diverged.tolist() == [False, True, False]
    assert len(found.alternatives) == 2


def test_controllers_hold_the_start_and_are_run():
    """Gains that a sampled controller cannot have are no stiffness of the joints, but the rows are lost."""
    calm, wild = (Scene(ARM, (effects.Gravity(),), ComputedTorqueController(100.0, kd)) for kd in (20.0, 500.0))
    assert calm.check(calm.start(double(0.3, 0.4)))
    found = wild.check(wild.start(double(0.3, 0.4), double(0.1, 0.1)), seconds=6.0)
    assert not found and found.growth <= 1.001 and bool(found.diverged)


def test_adaptive_steps_are_only_run():
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(100.0)), integrator=DormandPrince(1e-6))
    assert scene.check(scene.start(double(0.3, 0.4)), seconds=0.05)


@pytest.mark.parametrize(
    "given, message",
    [
        ({"state": ARM.mass}, "state must be a torchdq.envs.State, found Tensor"),
        ({"seconds": 0.0}, "seconds must be a positive number"),
        ({"seconds": 1e6}, "are 100000000 steps, and 32768 are the most"),
        ({"target": None}, "target must be given"),
    ],
)
def test_a_check_of_nothing_is_refused(given, message):
    scene = Scene(ARM, (effects.Servo(1.0),))
    with pytest.raises(torchdq.ArgumentError, match=message):
        scene.check(**{"state": scene.start(double(0.0, 0.0)), "target": double(0.0, 0.0), **given})


# --- rows that are lost ----------------------------------------------------------------------------------------------

LOSING = Scene(ARM, (effects.Viscous(double(0.1, 5e3)[:, None].expand(2, 2)),), integrator=SemiImplicitEuler())


def losing():
    return LOSING.start(torch.zeros(2, 2, dtype=torch.float64), torch.ones(2, 2, dtype=torch.float64))


def test_finite_tells_rows_apart():
    q, qd = double((0.0, 0.0), (math.inf, 0.0), (0.0, 0.0)), double((0.0, 0.0), (0.0, 0.0), (math.nan, 0.0))
    assert Scene(ARM).finite(State(q, qd)).tolist() == [True, False, False]
    remembering = Scene(ARM, (effects.FirstOrderLag(0.1),))
    state = remembering.start(torch.zeros(2, 2, dtype=torch.float64))
    assert remembering.finite(state._replace(memory=double((0.0, 0.0), (0.0, math.nan)))).tolist() == [True, False]


def test_a_rollout_needs_a_number_of_steps():
    scene = Scene(torchdq.robots.load("two_link"))
    with pytest.raises(torchdq.ArgumentError, match="steps must be given where there is no torque"):
        scene.rollout(scene.start(double(0, 0)))


def test_a_rollout_that_loses_rows_says_so():
    with pytest.warns(UserWarning, match=r"1 of 2 rows left .*, the first at step \d+ of 300; scene.check"):
        states = LOSING.rollout(losing(), steps=300)
    assert LOSING.finite(states)[-1].tolist() == [True, False]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert LOSING.rollout(losing(), steps=300, nonfinite="ignore").q.shape == (300, 2, 2)
        assert LOSING.rollout(losing(), steps=3).q.shape == (3, 2, 2)
    lost_before = losing()._replace(q=double((0.0, 0.0), (math.nan, 0.0)))
    with pytest.warns(UserWarning, match="1 of 2 rows have a non-finite initial state") as found:
        LOSING.rollout(lost_before, steps=3)
    assert len(found) == 1


@pytest.mark.parametrize("checkpoint", [0, 7])
def test_a_rollout_may_stop_before_the_step_that_loses_a_row(checkpoint):
    whole = LOSING.rollout(losing(), steps=300, nonfinite="ignore")
    stopped = LOSING.rollout(losing(), steps=300, nonfinite="stop", checkpoint=checkpoint)
    length = int(LOSING.finite(whole).all(-1).sum())
    assert 0 < length < 300
    assert stopped.q.shape == (length, 2, 2)
    assert torch.equal(stopped.q, whole.q[:length])


def test_transforms_have_no_values_to_look_at():
    scene = Scene(ARM, (effects.Gravity(),))

    def end(q, **how):
        return scene.rollout(scene.start(q), steps=3, **how).q[-1]

    q = random(4, 2)
    assert torch.equal(torch.func.vmap(end)(q), end(q))
    with pytest.raises(torchdq.ArgumentError, match="nonfinite='stop' reads values"):
        torch.func.vmap(lambda q: end(q, nonfinite="stop"))(q)


# --- policies --------------------------------------------------------------------------------------------------------


def test_a_policy_is_asked_before_every_step():
    scene = Scene(ARM, (effects.Gravity(), effects.Servo(3.0), effects.Bias(0.1, 0.2)))
    start, targets = scene.start(random(5, 2), random(5, 2, seed=1)), random(20, 2, seed=2)

    def policy(state):
        q, qd = state.measured
        return -2.0 * q - qd

    found = scene.rollout(start, policy=policy, target=targets)
    state = start
    for k, target in enumerate(targets):
        state = scene.step(state, policy(state), target=target)
        assert all(torch.equal(x[k], y) for x, y in zip(found, state, strict=True) if y is not None)


@pytest.mark.parametrize("checkpoint", [0, 3])
def test_policies_are_learned_through_the_steps(checkpoint):
    torch.manual_seed(0)
    policy = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 2)).double()
    scene = Scene(ARM, (effects.Gravity(),))

    def end():
        start = scene.start(random(3, 2))
        by = lambda s: policy(torch.cat([s.q, s.qd], -1))  # noqa: E731
        return scene.rollout(start, steps=10, policy=by, checkpoint=checkpoint).q[-1].square().sum()

    bias = policy[2].bias
    (gradient,) = torch.autograd.grad(end(), bias)
    for k in range(2):
        ends = []
        for step in (1e-5, -1e-5):
            with torch.no_grad():
                bias[k] += step
                ends.append(end())
                bias[k] -= step
        assert float(gradient[k]) == pytest.approx(float(ends[0] - ends[1]) / 2e-5, rel=1e-6)


class Filter(torch.nn.Module):
    """Policy whose torques depend on those before."""

    def __init__(self):
        super().__init__()
        self.gain, self.last = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64)), 0.0

    def forward(self, state):
        self.last = 0.5 * self.last - self.gain * state.q
        return self.last


class Normalised(torch.nn.Module):
    """Policy whose batch norm counts the states that it has seen."""

    def __init__(self):
        super().__init__()
        self.net = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2)).double()

    def forward(self, state):
        return self.net(state.q)


def rolled(policy, checkpoint):
    scene = Scene(ARM, (effects.Gravity(),))
    return scene.rollout(scene.start(random(3, 2)), steps=7, policy=policy, checkpoint=checkpoint).q.square().sum()


def test_a_policy_that_remembers_is_refused_where_it_is_called_again():
    message = "policy must depend on the state alone where checkpoint is not 0.*other torques the second.*checkpoint=0"
    rolled(Filter(), 0).backward()
    with torch.no_grad():
        rolled(Filter(), 3)  # nothing is called again
    end = rolled(Filter(), 3)
    with pytest.raises(torchdq.ArgumentError, match=message):
        end.backward()


def test_a_policy_that_counts_is_refused_where_it_is_called_again():
    policy = Normalised()
    rolled(policy, 0).backward()
    with pytest.raises(torchdq.ArgumentError, match=r"found that it changes its buffer 'net\.1\..*policy\.eval\(\)"):
        rolled(policy, 3)
    policy.eval()
    rolled(policy, 3).backward()


@pytest.mark.parametrize("checkpoint", [0, 3])
def test_a_random_policy_has_the_same_gradient_with_a_checkpoint(checkpoint):
    """Random numbers of torch are drawn again as they were."""
    gain = torch.ones((), dtype=torch.float64, requires_grad=True)
    gradients = []
    for stride in (0, checkpoint):
        torch.manual_seed(0)
        end = rolled(lambda s: -gain * s.q + gain * torch.randn_like(s.q), stride)
        gradients.append(torch.autograd.grad(end, gain)[0])
    assert torch.equal(*gradients)


# --- what is refused -------------------------------------------------------------------------------------------------

Q = torch.zeros(3, 2, dtype=torch.float64)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda s: s.step(Q, Q), "state must be a torchdq.envs.State, found Tensor; scene.start"),
        (lambda s: s.step((Q, Q), Q), "state must be a torchdq.envs.State, found tuple"),
        (lambda s: s.rollout(Q, steps=2), "state must be a torchdq.envs.State, found Tensor"),
        (lambda s: s.energy(Q), "state must be a torchdq.envs.State, found Tensor"),
        (lambda s: s.finite(None), "state must be a torchdq.envs.State, found NoneType"),
        (lambda s: s.linearize(Q), "state must be a torchdq.envs.State, found Tensor"),
        (lambda s: s.step(State(Q, None)), "qd of the state must be a tensor, found NoneType"),
        (lambda s: s.energy(State([0.0], Q)), "q of the state must be a tensor, found list"),
        (lambda s: s.rollout(s.start(Q), steps=2.5), "steps must be a whole number from 0, found 2.5"),
        (lambda s: s.rollout(s.start(Q), steps=2, checkpoint=0.5), "checkpoint must be a whole number from 0, found"),
        (lambda s: s.rollout(s.start(Q), lambda x: x.q, 2), "torque must be a tensor, found a function; .* as policy"),
        (lambda s: s.rollout(s.start(Q), torch.tensor(1.0)), r"torque must have the shape \[steps, ...\], found \(\)"),
        (lambda s: s.rollout(s.start(Q), [[1.0, 2.0]]), "torque must be a tensor, found list"),
        (lambda s: s.rollout(s.start(Q), policy=lambda x: x.q), "steps must be given where there is no torque"),
        (lambda s: s.rollout(s.start(Q), Q, policy=lambda x: x.q), "torque and policy exclude each other"),
        (lambda s: s.rollout(s.start(Q), steps=2, policy=Q), "policy must be a function of the state"),
        (lambda s: s.rollout(s.start(Q), steps=2, policy=lambda x: None), "policy must return torques, a tensor"),
        (
            lambda s: s.rollout(s.start(Q), steps=2, policy=lambda x: Q[:, :1]),
            r"policy must return torques, .*\[..., 2\]",
        ),
        (lambda s: s.rollout(s.start(Q), steps=2, policy=lambda x: x.q.float()), r"policy .* found torch.float32 of"),
        (
            lambda s: s.rollout(s.start(Q), steps=2, policy=lambda x: x.reading[..., :2]),
            "policy must not use state.reading and state.memory, which is None, .*state.measured is there",
        ),
        (lambda s: s.rollout(s.start(Q), steps=2, nonfinite="keep"), "lost must be one of 'warn', 'stop', 'keep'"),
    ],
)
def test_what_is_no_state_and_no_rollout_is_refused(call, message):
    with pytest.raises(torchdq.ArgumentError, match=message):
        call(Scene(ARM, (effects.Gravity(),)))


# --- linearization ---------------------------------------------------------------------------------------------------


def differences(scene, state, torque, **inputs):
    """Central differences of a step in every number of the state and of the torques."""
    rows = [*state.rows().values(), torque]
    names, widths = list(state.rows()), [x.shape[-1] for x in rows]
    z = torch.cat(rows, -1)

    def after(z):
        *parts, u = z.split(widths, -1)
        return torch.cat(
            list(scene.step(State(**dict(zip(names, parts, strict=True))), u, **inputs).rows().values()), -1
        )

    h = 1e-6
    columns = [(after(z + h * e) - after(z - h * e)) / (2 * h) for e in torch.eye(z.shape[-1], dtype=z.dtype)]
    return torch.stack(columns, -1)


LINEARIZED = {
    "bare": (Scene(ARM), {}),
    "tree": (Scene(TREE, (effects.Gravity(), effects.Coulomb(0.3, 0.5), effects.Drag(0.1, 0.1, 0.1))), {}),
    "of its own in every sample": (Scene(ARM, (effects.Payload(torch.linspace(0.1, 2.0, 4).double()),)), {}),
    "remembering and sensing": (
        Scene(
            ARM, (effects.Elastic(50.0, 0.5, 0.1), effects.FirstOrderLag(0.05), effects.Bias(0.1, 0.2)), PD(5.0, 1.0)
        ),
        {"reference": random(4, 6, seed=9)},
    ),
    "RungeKutta4": (Scene(ARM, (effects.Gravity(),), integrator=RungeKutta4()), {}),
    "Repeated": (Scene(ARM, (effects.Gravity(),), integrator=Repeated(RungeKutta4(), 3)), {}),
}


@pytest.mark.parametrize("kind", LINEARIZED)
def test_a_linearization_is_made_of_the_derivatives_of_a_step(kind):
    scene, inputs = LINEARIZED[kind]
    n = scene.n
    state = scene.start(random(4, n), random(4, n, seed=1))
    if state.memory is not None:
        state = state._replace(memory=state.memory + 0.1 * random(*state.memory.shape, seed=2))
    torque = random(4, n, seed=3)
    A, B = scene.linearize(state, torque, **inputs)
    s = sum(x.shape[-1] for x in state.rows().values())
    assert (A.shape, B.shape) == ((4, s, s), (4, s, n))
    expected = differences(scene, state, torque, **inputs)
    found = torch.cat([A, B], -1)
    assert (found - expected).abs().max() <= 1e-7 * expected.abs().max()


def test_a_linearization_of_one_state_is_a_pair_of_matrices():
    """Without torques it is that at none."""
    scene = Scene(ARM, (effects.Gravity(),))
    state = scene.start(double(0.3, -0.4))
    A, B = scene.linearize(state)
    assert (A.shape, B.shape) == ((4, 4), (4, 2))
    assert torch.equal(A, scene.linearize(state, double(0.0, 0.0)).A)
    whole = scene.linearize(scene.start(double(0.3, -0.4).expand(3, 2)), double((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
    assert torch.equal(whole.A[0], A)


def test_a_step_of_a_free_base_is_differentiated_by_torch_in_place_of_linearize():
    body = {"base_mass": double(2.0)[0], "base_com": double(0.1, 0, 0), "base_inertia": double(0.2, 0, 0.3, 0, 0, 0.4)}
    scene = Scene(torchdq.robots.load("two_link").replace(**body), (effects.Gravity(),), dt=0.01)
    X_WB = torchdq.dq.exp(random(6, seed=5))
    state = scene.start(random(2), random(2, seed=1), X_WB=X_WB, V_WB_B=random(6, seed=2))
    with pytest.raises(
        torchdq.ArgumentError, match=r"must have a fixed base .*torch\.func\.jacrev.*finite differences"
    ):
        scene.linearize(state)
    rows, torque = state.rows(), random(2, seed=3)
    names, widths = tuple(rows), [x.shape[-1] for x in rows.values()]

    def after(z):
        stepped = scene.step(State(**dict(zip(names, z.split(widths), strict=True))), torque)
        return torch.cat(list(stepped.rows().values()))

    z, pose = torch.cat(list(rows.values())), sum(widths[: names.index("X_WB")])
    found, h = torch.func.jacrev(after)(z), 1e-5
    assert found.shape == (18, 18)
    for k in range(16):  # 6 directions of the pose, and the other components
        way, ahead, behind = torch.zeros(18, dtype=z.dtype), z.clone(), z.clone()
        if k < 6:
            unit = torch.eye(6, dtype=z.dtype)[k]
            at = slice(pose, pose + 8)
            ahead[at], behind[at] = (torchdq.dq.mul(X_WB, torchdq.dq.exp(s * h * unit)) for s in (1, -1))
            way[at] = torchdq.dq.mul(X_WB, torch.cat([z.new_zeros(1), unit[:3], z.new_zeros(1), unit[3:]]))
        else:
            j = [i for i in range(18) if not pose <= i < pose + 8][k - 6]
            way[j] = 1.0
            ahead[j], behind[j] = z[j] + h, z[j] - h
        expected = (after(ahead) - after(behind)) / (2 * h)
        assert (found @ way - expected).abs().max() <= 1e-7 * (1 + expected.abs().max())
