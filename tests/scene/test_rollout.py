"""Rollouts: they are their steps, learn through policies, keep little memory, and report rows that diverge."""

import math
import warnings
from collections import OrderedDict

import pytest
import torch
from helpers import double, random
from messages import refused, warned
from scenes import ARM, equal, rich, uniform

import torchdq
from torchdq.envs import Scene, State, effects
from torchdq.scene.controllers import PD
from torchdq.scene.integrators import SemiImplicitEuler


def test_a_rollout_is_its_steps():
    scene = rich(ARM)
    noise = uniform(scene, 6, 4)
    inputs = {name: random(6, 4, width, seed=k) for k, (name, width) in enumerate(scene.inputs.items())}
    start = state = scene.start(random(4, 2), random(4, 2, seed=1), uniform(scene, 4))
    found = scene.rollout(start, noise=noise, **inputs)
    for k in range(6):
        state = scene.step(state, noise=noise[k], **{name: x[k] for name, x in inputs.items()})
        assert equal([x[k] for x in found.rows().values()], list(state.rows().values()))


@pytest.mark.parametrize("checkpoint", [0, 2])
def test_a_rollout_of_no_steps_is_empty(checkpoint):
    scene = Scene(ARM, (effects.FirstOrderLag(0.1),))
    found = scene.rollout(scene.start(random(4, 2)), steps=0, checkpoint=checkpoint)
    assert [tuple(x.shape) for x in found.rows().values()] == [(0, 4, 2), (0, 4, 2), (0, 4, 2)]


@pytest.mark.parametrize("checkpoint", [1, 4, 7, 100])
def test_checkpoints_change_neither_values_nor_gradients(checkpoint):
    """Not even with noise that is drawn within."""
    d, q, torque = (x.requires_grad_() for x in (random(2).abs(), random(3, 2, seed=1), random(20, 3, 2, seed=2)))
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(d), effects.Noise(0.1)), PD(3.0, 1.0))
    reference = random(20, 6, seed=3)

    def end(checkpoint):
        torch.manual_seed(0)
        found = scene.rollout(scene.start(q), torque, reference=reference, checkpoint=checkpoint)
        return *found[:2], *torch.autograd.grad(found.q.square().sum(), [d, q, torque])

    for a, b in zip(end(checkpoint), end(0), strict=True):
        assert torch.equal(a, b) or (a - b).abs().max() <= 1e-12 * b.abs().max()


@pytest.mark.parametrize("checkpoint, computed", [(0, 60), (8, 120)])
def test_checkpoints_keep_less_and_compute_again(checkpoint, computed, monkeypatch):
    """Without them the graph keeps every step's inputs; with them none, and each step is computed twice."""
    kept, calls, step = {}, [], Scene.step

    def pack(x):
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    def counted(*args, **given):
        calls.append(1)
        return step(*args, **given)

    monkeypatch.setattr(Scene, "step", counted)
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(random(2).abs().requires_grad_())))
    start = scene.start(random(64, 2))
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        found = scene.rollout(start, steps=60, checkpoint=checkpoint)
    assert (sum(kept.values()) >= 60 * 64 * 4 * 8) == (checkpoint == 0)
    assert checkpoint == 0 or sum(kept.values()) <= 8 * 64 * 4 * 8
    found.q.sum().backward()
    assert len(calls) == computed


DIVERGING = Scene(ARM, (effects.Viscous(double(0.1, 5e3)[:, None].expand(2, 2)),), integrator=SemiImplicitEuler())


def start():
    return DIVERGING.start(torch.zeros(2, 2, dtype=torch.float64), torch.ones(2, 2, dtype=torch.float64))


def test_rows_are_finite_one_by_one():
    q, qd = double((0.0, 0.0), (math.inf, 0.0), (0.0, 0.0)), double((0.0, 0.0), (0.0, 0.0), (math.nan, 0.0))
    assert Scene(ARM).finite(State(q, qd)).tolist() == [True, False, False]
    remembering = Scene(ARM, (effects.FirstOrderLag(0.1),))
    state = remembering.start(torch.zeros(2, 2, dtype=torch.float64))
    assert remembering.finite(state._replace(memory=double((0.0, 0.0), (0.0, math.nan)))).tolist() == [True, False]


def test_a_rollout_of_which_rows_diverge_warns():
    with warned(UserWarning):
        states = DIVERGING.rollout(start(), steps=300)
    assert DIVERGING.finite(states)[-1].tolist() == [True, False]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert DIVERGING.rollout(start(), steps=300, nonfinite="ignore").q.shape == (300, 2, 2)
        assert DIVERGING.rollout(start(), steps=3).q.shape == (3, 2, 2)
    nonfinite_before = start()._replace(q=double((0.0, 0.0), (math.nan, 0.0)))
    with warned(UserWarning) as found:
        DIVERGING.rollout(nonfinite_before, steps=3)
    assert len(found) == 1


@pytest.mark.parametrize("checkpoint", [0, 7])
def test_a_rollout_may_stop_before_the_step_in_which_a_row_diverges(checkpoint):
    whole = DIVERGING.rollout(start(), steps=300, nonfinite="ignore")
    stopped = DIVERGING.rollout(start(), steps=300, nonfinite="stop", checkpoint=checkpoint)
    length = int(DIVERGING.finite(whole).all(-1).sum())
    assert 0 < length < 300
    assert stopped.q.shape == (length, 2, 2)
    assert torch.equal(stopped.q, whole.q[:length])


def test_transforms_have_no_values_to_look_at():
    scene = Scene(ARM, (effects.Gravity(),))

    def end(q, **how):
        return scene.rollout(scene.start(q), steps=3, **how).q[-1]

    q = random(4, 2)
    assert torch.equal(torch.func.vmap(end)(q), end(q))
    with refused(torchdq.ArgumentError):
        torch.func.vmap(lambda q: end(q, nonfinite="stop"))(q)


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

    def end(bias):
        def torque(s):
            return torch.func.functional_call(policy, {"2.bias": bias}, torch.cat([s.q, s.qd], -1))

        return scene.rollout(scene.start(random(3, 2)), steps=10, policy=torque, checkpoint=checkpoint).q[-1]

    assert torch.autograd.gradcheck(end, policy[2].bias, atol=1e-8)


class Position(torch.nn.Module):
    """Layer that takes the position of a state."""

    def forward(self, state):
        return state.q


class Filter(torch.nn.Module):
    """Policy whose torques depend on those before."""

    def __init__(self):
        super().__init__()
        self.gain, self.last = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64)), 0.0

    def forward(self, state):
        self.last = 0.5 * self.last - self.gain * state.q
        return self.last


def rolled(policy, checkpoint):
    scene = Scene(ARM, (effects.Gravity(),))
    return scene.rollout(scene.start(random(3, 2)), steps=7, policy=policy, checkpoint=checkpoint).q.square().sum()


def test_a_policy_that_remembers_is_refused_where_it_is_called_again():
    rolled(Filter(), 0).backward()
    with torch.no_grad():
        rolled(Filter(), 3)  # nothing is called again
    end = rolled(Filter(), 3)
    with refused(torchdq.ArgumentError):
        end.backward()
    # a batch norm counts the states that it has seen
    norm = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2)).double()
    policy = torch.nn.Sequential(OrderedDict(measured=Position(), norm=norm))
    rolled(policy, 0).backward()
    with refused(torchdq.ArgumentError):
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


Q = torch.zeros(3, 2, dtype=torch.float64)


@pytest.mark.parametrize(
    "call",
    [
        lambda s: s.step(Q, Q),
        lambda s: s.step((Q, Q), Q),
        lambda s: s.rollout(Q, steps=2),
        lambda s: s.energy(Q),
        lambda s: s.finite(None),
        lambda s: s.linearize(Q),
        lambda s: s.step(State(Q, None)),
        lambda s: s.energy(State([0.0], Q)),
        lambda s: s.rollout(s.start(Q), steps=2.5),
        lambda s: s.rollout(s.start(Q), steps=2, checkpoint=0.5),
        lambda s: s.rollout(s.start(Q), lambda x: x.q, 2),
        lambda s: s.rollout(s.start(Q), torch.tensor(1.0)),
        lambda s: s.rollout(s.start(Q), [[1.0, 2.0]]),
        lambda s: s.rollout(s.start(Q), policy=lambda x: x.q),
        lambda s: s.rollout(s.start(Q), steps=3, torque=torch.zeros(4, 2)),
        lambda s: s.rollout(s.start(Q), steps=-1),
        lambda s: s.rollout(s.start(Q), Q, policy=lambda x: x.q),
        lambda s: s.rollout(s.start(Q), steps=2, policy=Q),
        lambda s: s.rollout(s.start(Q), steps=2, policy=lambda x: None),
        lambda s: s.rollout(s.start(Q), steps=2, policy=lambda x: Q[:, :1]),
        lambda s: s.rollout(s.start(Q), steps=2, policy=lambda x: x.q.float()),
        lambda s: s.rollout(s.start(Q), steps=2, nonfinite="keep"),
    ],
)
def test_a_wrong_state_or_rollout_is_refused(call):
    with refused(torchdq.ArgumentError):
        call(Scene(ARM, (effects.Gravity(),)))
