"""Rollouts: they are steps with a policy, learn through policies, keep little memory, and report rows that diverge."""

import math
import warnings
from dataclasses import dataclass

import pytest
import torch
from free_flyers import case, motion
from helpers import EVERYTHING, double, random, thinned
from messages import refused, warned
from scenes import ARM, equal, rich, uniform

import torchdq
from torchdq import Scene, effects
from torchdq.scene import State
from torchdq.scene.controllers import PD
from torchdq.scene.integrators import SemiImplicitEuler


@pytest.mark.parametrize("checkpoint", [0, 2])
def test_a_rollout_of_no_steps_is_empty(checkpoint):
    scene = Scene(ARM, (effects.FirstOrderLag(0.1),))
    found = scene.rollout(scene.start(random(4, 2)), steps=0, checkpoint=checkpoint)
    assert [tuple(x.shape) for x in found.rows().values()] == [(0, 4, 2), (0, 4, 2), (0, 4, 2)]


@pytest.mark.parametrize("backend", ["auto", "eager"])
def test_the_last_state_of_no_steps_is_the_start(backend):
    """Of rows that may end, too."""
    scene = Scene(ARM, (effects.Gravity(),), backend=backend)
    start, how = scene.start(random(4, 2)), {"steps": 0, "ends": True, "done": lambda s: s.q[:, 0] > 0}
    assert equal(scene.rollout(start, **how), start)
    _, rows = scene.replace(backend="auto").rollout(start, **how, task=Errors(), goal=random(0, 4, 2), total="cost")
    assert torch.equal(rows["cost"], torch.zeros(4, dtype=torch.float64))


@pytest.mark.parametrize("checkpoint", thinned([1, 4, 7, 100], [4, 100]))
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


@pytest.mark.parametrize("checkpoint", [0, 8])
def test_checkpoints_keep_less(checkpoint):
    """Without them the graph keeps every step's inputs; with them one state in so many."""
    kept = {}

    def pack(x):
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(random(2).abs().requires_grad_())))
    start = scene.start(random(64, 2))
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        scene.rollout(start, steps=60, checkpoint=checkpoint, done=lambda s: s.q[:, 0] > 1e9)
    assert (sum(kept.values()) >= 60 * 64 * 4 * 8) == (checkpoint == 0)
    assert checkpoint == 0 or sum(kept.values()) <= 9 * 64 * 4 * 8  # eight states, and the friction


DIVERGING = Scene(ARM, (effects.Viscous(double(0.1, 5e3)[:, None].expand(2, 2)),), integrator=SemiImplicitEuler())


def start():
    return DIVERGING.start(torch.zeros(2, 2, dtype=torch.float64), torch.ones(2, 2, dtype=torch.float64))


def test_rows_are_finite_one_by_one():
    q, qd = double((0.0, 0.0), (math.inf, 0.0), (0.0, 0.0)), double((0.0, 0.0), (0.0, 0.0), (math.nan, 0.0))
    assert State(q, qd).finite().tolist() == [True, False, False]
    remembering = Scene(ARM, (effects.FirstOrderLag(0.1),))
    state = remembering.start(torch.zeros(2, 2, dtype=torch.float64))
    assert state._replace(memory=double((0.0, 0.0), (0.0, math.nan))).finite().tolist() == [True, False]


def test_a_rollout_of_which_rows_diverge_warns():
    with warned(UserWarning):
        states = DIVERGING.rollout(start(), steps=300)
    assert states.finite()[-1].tolist() == [True, False]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert DIVERGING.rollout(start(), steps=300, nonfinite="ignore").q.shape == (300, 2, 2)
        assert DIVERGING.rollout(start(), steps=3).q.shape == (3, 2, 2)
    nonfinite_before = start()._replace(q=double((0.0, 0.0), (math.nan, 0.0)))
    with warned(UserWarning) as found:
        DIVERGING.rollout(nonfinite_before, steps=3)
    assert len(found) == 1
    alone = Scene(ARM, (effects.Viscous(5e3),), integrator=SemiImplicitEuler())
    with warned(UserWarning):
        alone.rollout(State(*(x[1] for x in start()[:2])), steps=300)


def test_rollouts_with_a_policy_ends_and_checkpoints_in_transforms():
    """Which have no values to look at, and in which checkpoints have no effect."""
    scene, q = Scene(ARM, (effects.Gravity(),)), random(4, 2)

    def end(q, checkpoint=1):
        how = {"policy": lambda s, k: -(1 + k) * s.qd, "done": lambda s: s.q[..., 0] > 0.5, "checkpoint": checkpoint}
        return scene.rollout(scene.start(q), steps=2, **how).last.q

    assert torch.equal(torch.func.vmap(end)(q), end(q))
    if EVERYTHING:  # export/test_torch_files.py compiles a rollout
        assert torch.equal(torch.compile(end, fullgraph=True, backend="eager")(q), end(q))
    by_row = torch.func.vmap(torch.func.grad(lambda q: end(q).square().sum()))(q)
    whole = torch.func.grad(lambda q: end(q, 0).square().sum())(q)
    assert (by_row - whole).abs().max() <= 1e-13 * whole.abs().max()


def test_a_policy_is_asked_before_every_step():
    scene = rich(ARM)
    start, noise = scene.start(random(5, 2), random(5, 2, seed=1), uniform(scene, 5)), uniform(scene, 6, 5)
    inputs = {name: random(6, 5, width, seed=k) for k, (name, width) in enumerate(scene.inputs.items())}
    del inputs["torque"]

    def policy(state, k):
        q, qd = state.measured
        return -2.0 * q - (1 + k) * qd

    found, state = scene.rollout(start, policy=policy, noise=noise, **inputs), start
    for k in range(6):
        given = {name: x[k] for name, x in inputs.items()}
        state = scene.step(state, policy(state, k), noise=noise[k], **given)
        assert equal([x[k] for x in found.rows().values()], state.rows().values())


@pytest.mark.parametrize("checkpoint", thinned([0, 3], [3]))
def test_policies_are_learned_through_the_steps(checkpoint):
    torch.manual_seed(0)
    policy = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 2)).double()
    scene = Scene(ARM, (effects.Gravity(),))

    def end(bias):
        def torque(s, k):
            return (1 + 0.1 * k) * torch.func.functional_call(policy, {"2.bias": bias}, torch.cat([s.q, s.qd], -1))

        return scene.rollout(scene.start(random(3, 2)), steps=10, policy=torque, checkpoint=checkpoint).q[-1]

    assert torch.autograd.gradcheck(end, policy[2].bias, atol=1e-8)


class Positions(torch.nn.Sequential):
    """Network of the positions."""

    def forward(self, state, k):
        return super().forward(state.q)


class Filter(torch.nn.Module):
    """Policy whose torques depend on those before."""

    def __init__(self):
        super().__init__()
        self.gain, self.last = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64)), 0.0

    def forward(self, state, k):
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
    policy = Positions(norm)
    rolled(policy, 0).backward()
    with refused(torchdq.ArgumentError):
        rolled(policy, 3)
    policy.eval()
    rolled(policy, 3).backward()


def test_ends_that_remember_or_move_are_refused_where_they_are_asked_again():
    scene, q = Scene(ARM, (effects.Gravity(),)), random(3, 2).requires_grad_()
    counted, limits = [], [9.0]

    def third(state):
        counted.append(1)
        return torch.full((3,), len(counted) > 3)

    def beyond(state):
        return state.q[:, 0].abs() > limits[0]

    scene.rollout(scene.start(q), steps=6, done=third).q.sum().backward()
    counted.clear()
    end = scene.rollout(scene.start(q), steps=6, done=third, checkpoint=2)
    with refused(torchdq.ArgumentError):
        end.q.sum().backward()
    end = scene.rollout(scene.start(q), steps=6, done=beyond, checkpoint=2)
    limits[0] = 0.0
    with refused(torchdq.ArgumentError):
        end.q.sum().backward()


@dataclass(frozen=True)
class Errors:
    """Task of which the cost is the square of the distance to a goal."""

    def inputs(self, n):
        return {"goal": n}

    def rows(self, view):
        return {"cost": [sum([(a - b) * (a - b) for a, b in zip(view.q, view.inputs["goal"], strict=True)], 0.0)]}


class Drag(torch.nn.Module):
    """Residual torque with a parameter, or such a policy."""

    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(double(0.3)[0])

    def forward(self, x, y):
        return self.gain * y if isinstance(y, torch.Tensor) else -self.gain * x.qd


CHANGED = ("effect", "robot", "torque", "state", "network", "policy", "closed over", "goal")


@pytest.mark.parametrize("changed", CHANGED)
def test_a_tensor_changed_before_the_steps_are_computed_again_is_refused(changed):
    friction, network, policy = double(0.1, 0.2), Drag(), Drag()
    acting = (effects.Viscous(friction), effects.Residual(network))
    scene = Scene(ARM.replace(mass=ARM.mass.clone().requires_grad_()), acting)
    size = 0.0 if changed == "robot" else 1.0  # at rest, its masses are seen in the gradient alone
    start, torque = scene.start(random(3, 2), size * random(3, 2, seed=1)), size * random(6, 3, 2, seed=2)
    gain = double(3.0, 2.0)
    inputs = {
        "policy": {"policy": policy},
        "closed over": {"policy": lambda state, k: -gain * (state.q - state.q.detach())},
    }.get(changed, {"torque": torque})
    tensors = {"effect": friction, "robot": scene.robot.mass, "torque": torque, "state": start.qd, "closed over": gain}
    if changed == "goal":  # of which the states know nothing, in a loop
        tensors["goal"] = inputs["goal"] = random(6, 3, 2, seed=3)
        inputs |= {"task": Errors(), "total": "cost", "ends": True}
        scene = scene.replace(effects=acting[:1])
        end = scene.rollout(start, steps=6, checkpoint=2, **inputs)[1]["cost"].sum()
    else:
        end = scene.rollout(start, steps=6, checkpoint=2, **inputs).q.sum()
    with torch.no_grad():
        {**tensors, "network": network.gain, "policy": policy.gain}[changed].mul_(1.1)
    with refused(torchdq.ArgumentError):
        end.backward()


def test_a_random_policy_has_the_same_gradient_with_a_checkpoint():
    """Random numbers of torch are drawn again as they were."""
    gain = torch.ones((), dtype=torch.float64, requires_grad=True)
    gradients = []
    for checkpoint in (0, 3):
        torch.manual_seed(0)
        end = rolled(lambda s, k: -gain * s.q + gain * torch.randn_like(s.q), checkpoint)
        gradients.append(torch.autograd.grad(end, gain)[0])
    assert torch.equal(*gradients)


# --- parts of a motion ------------------------------------------------------------------------------------------------


def standing():
    """Scene with effects of every slot, and its state at rest."""
    scene = rich(ARM)
    return scene, scene.start(random(3, 2) / 9, noise=uniform(scene, 3))


def flying():
    """Scene of a floating base with memory and sensors, and its state in motion."""
    base = case("tree1")
    m = motion(base)
    scene = Scene(base.robot, (effects.Gravity(), effects.FirstOrderLag(0.05), effects.Noise(0.1, 0.2)))
    return scene, scene.start(m["q"], m["qd"], uniform(scene, 3), X_WB=m["X_WB"], V_WB_B=m["V_WB_B"])


@pytest.mark.parametrize("begun", [standing, flying])
def test_a_rollout_goes_on_from_the_last_state_of_another(begun):
    scene, start = begun()
    noise = uniform(scene, 8, 3)
    inputs = {name: random(8, 3, width, seed=k) for k, (name, width) in enumerate(scene.inputs.items())}

    def rolled(state, rows):
        return scene.rollout(state, noise=noise[rows], **{name: x[rows] for name, x in inputs.items()})

    whole, first = rolled(start, slice(None)), rolled(start, slice(5))
    second = rolled(first.last, slice(5, None))
    assert first.last.memory is not None and first.last.reading is not None
    for a, b, c in zip(whole, first, second, strict=True):
        assert (a is None and b is None and c is None) or torch.equal(a, torch.cat([b, c]))


@pytest.mark.parametrize("checkpoint", [0, 3])
def test_rows_that_end_keep_their_state_and_the_others_go_on(checkpoint):
    """One row has ended at the start, one ends on the way, and one does not."""
    scene = rich(ARM)
    start = scene.start(double((0.9, 0.0), (0.3, 0.0), (-0.5, 0.0)), noise=uniform(scene, 3))
    start = start._replace(qd=double((0.0, 0.0), (10.0, 0.0), (0.0, math.nan)))
    noise, reference = uniform(scene, 12, 3), random(12, 3, 6)

    def done(state):
        return state.q[..., 0] > 0.5

    def rolled(**how):
        inputs = {"noise": noise, "reference": reference, "nonfinite": "ignore", "checkpoint": checkpoint}
        return scene.rollout(start, steps=12, **inputs, **how)

    free, found = rolled(), rolled(done=done)
    ended = done(found)
    assert ended[:, 0].all() and not ended[:, 2].any()
    taken = int((~ended[:, 1]).sum()) + 1
    assert 1 < taken < 12 and ended[taken - 1 :, 1].all()
    for x, y, first in zip(found.rows().values(), free.rows().values(), start.rows().values(), strict=True):
        assert torch.equal(x[:, 0], first[0].expand_as(x[:, 0]))
        assert torch.equal(x[:taken, 1], y[:taken, 1])
        assert torch.equal(x[taken:, 1], y[taken - 1, 1].expand_as(x[taken:, 1]))
        assert torch.equal(x[:, 2].nan_to_num(), y[:, 2].nan_to_num())


@pytest.mark.parametrize("checkpoint", thinned([0, 4], [4]))
def test_the_gradient_of_rows_that_end_is_that_of_the_steps_they_took(checkpoint):
    """Of a policy and of friction that all rows share, neither of which has a value where rows end."""
    q, qd = double((0.7, 0.0), (0.0, 0.0), (0.4, 0.1)), double((1.0, 0.0), (5.0, 1.0), (1.0, 0.0))

    def gradients(rows, steps, **how):
        gain, friction, start = (x.clone().requires_grad_() for x in (double(2.0), double(0.3, 0.2), q[rows]))
        scene = Scene(ARM, (effects.Viscous(friction),))

        def policy(state, k):
            return gain * (1 - state.q[..., :1]).sqrt() * (1 + 0.1 * k) * torch.tanh(state.qd)

        path = scene.rollout(scene.start(start, qd[rows]), steps=steps, policy=policy, **how)
        return path, torch.autograd.grad(path.last.q.square().sum() + path.last.qd.sum(), [gain, friction, start])

    path, found = gradients([0, 1, 2], 40, done=lambda s: s.q[..., 0] >= 1, checkpoint=checkpoint)
    ended = path.q[..., 0] >= 1
    taken = [int((~row).sum()) + 1 for row in ended.T]
    assert ended[-1].all() and len(set(taken)) == 3 and max(taken) < 40
    alone = [gradients([k], steps)[1] for k, steps in enumerate(taken)]
    expected = [sum(x[0] for x in alone), sum(x[1] for x in alone), torch.cat([x[2] for x in alone])]
    for a, b in zip(found, expected, strict=True):
        assert b.isfinite().all() and (a - b).abs().max() <= 1e-12 * b.abs().max()


@pytest.mark.parametrize("checkpoint", [0, 2])
@pytest.mark.parametrize("begun", thinned([standing, flying], [flying]))
def test_a_row_without_values_that_has_ended_leaves_the_gradient_of_the_others(begun, checkpoint):
    scene, start = begun()
    robot = scene.robot.replace(mass=scene.robot.mass.clone().requires_grad_())
    scene, noise = scene.replace(robot=robot), uniform(scene, 4, 3)
    bad = State._make(None if x is None else x.index_fill(0, torch.tensor([1]), math.nan) for x in start)

    def gradient(start):
        inputs = {"noise": noise, "nonfinite": "ignore", "checkpoint": checkpoint}
        inputs |= {name: random(4, 3, width, seed=k) for k, (name, width) in enumerate(scene.inputs.items())}
        path = scene.rollout(start, done=lambda s: torch.tensor([False, True, False]), **inputs)
        return torch.autograd.grad(sum(x[-1, [0, 2]].square().sum() for x in path.rows().values()), robot.mass)[0]

    expected = gradient(start)
    assert expected.abs().max() > 0 and (gradient(bad) - expected).abs().max() <= 1e-12 * expected.abs().max()


Q = torch.zeros(3, 2, dtype=torch.float64)


STATES = [  # no states, or calls without one
    *(lambda s: s.step(Q, Q), lambda s: s.step((Q, Q), Q), lambda s: s.rollout(Q, steps=2), lambda s: s.energy(Q)),
    *(lambda s: s.energy(None), lambda s: s.linearize(Q), lambda s: s.step(State(Q, None))),
    *(lambda s: s.energy(State([0.0], Q)), lambda s: s.rollout(s.start(Q), steps=0).last, lambda s: s.start(Q[0]).last),
    lambda s: s.rollout(s.rollout(s.start(Q), steps=2)[-1], steps=2),
]
POLICIES = [lambda x, k: None, lambda x, k: Q[:, :1], lambda x, k: x.q.float(), lambda x: x.q, torch.nn.Linear(2, 2), Q]
ENDS = [True, lambda x, k: x.q > 0, lambda x: x.q > 0, lambda x: x.q[:, 0]]
WRONG = [  # arguments of rollouts
    *({"steps": 2.5}, {"steps": -1}, {"steps": 2, "checkpoint": 0.5}, {"steps": 2, "nonfinite": "keep"}),
    *({"torque": lambda x: x.q, "steps": 2}, {"torque": torch.tensor(1.0)}, {"torque": [[1.0, 2.0]]}),
    *({"policy": lambda x, k: x.q}, {"policy": lambda x, k: x.q, "torque": Q}),
    {"steps": 3, "torque": torch.zeros(4, 2)},
    *({"steps": 2, "policy": policy} for policy in POLICIES),
    *({"steps": 2, "done": done} for done in ENDS),
]


@pytest.mark.parametrize("call", [*STATES, *(lambda s, wrong=x: s.rollout(s.start(Q), **wrong) for x in WRONG)])
def test_a_wrong_state_or_rollout_is_refused(call):
    with refused(torchdq.ArgumentError):
        call(Scene(ARM, (effects.Gravity(),)))
