"""Recorded policies: the numbers of torch in values and gradients of any order, in loops and in steps."""

from dataclasses import dataclass

import pytest
import torch
from helpers import random, thinned
from messages import refused
from scenes import ARM
from torch import nn

import torchdq
from torchdq import Scene, effects
from torchdq.program.program import Argument, record
from torchdq.scene import policies

BACKEND = "auto"
EPS = torch.finfo(torch.float64).eps
SCENE = Scene(ARM, (effects.Gravity(), effects.Viscous(0.1)))


@dataclass(frozen=True)
class Distance:
    """Task: squared distance from a goal, the first torque, and the way so far."""

    def inputs(self, n):
        return {"goal": n, "carry": 1}

    def rows(self, view):
        error = [a - b for a, b in zip(view.q, view.inputs["goal"], strict=True)]
        d = sum(e * e for e in error)
        return {"cost": [d], "effort": [view.torque[0]], "carry": [view.inputs["carry"][0] + d]}


def seeded(*layers):
    """Network with random weights in float64."""
    torch.manual_seed(3)
    return nn.Sequential(*[layer() for layer in layers]).double()


def close(found, expected, factor):
    return all((a - b).abs().max() <= factor * EPS * b.abs().max() for a, b in zip(found, expected, strict=True))


def test_a_recorded_network_is_that_of_torch():
    act = nn.Tanh()  # one module at two places
    network = seeded(
        *[lambda: nn.Linear(4, 9), lambda: act, lambda: nn.LayerNorm(9), lambda: nn.Linear(9, 7), lambda: act],
        *[lambda: nn.ELU(0.7), lambda: nn.Sequential(nn.Linear(7, 6, bias=False), nn.ReLU()), lambda: nn.Linear(6, 3)],
    )
    policy = policies.Network(network)
    weights = {name: x.reshape(-1) for name, x in policy.weights().items()}
    taken = [Argument("x", 4), *(Argument(name, len(x), True) for name, x in weights.items())]
    run = torchdq.compile(
        record("f", taken, lambda x, *rows: {"y": policy.recorded(x, dict(zip(weights, rows, strict=True)))})
    )
    x, g = random(37, 4).requires_grad_(), random(37, 3, seed=1)
    found, expected = run(x, *weights.values()), network(x)
    wrt = [x, *network.parameters()]
    assert close([found], [expected], 50)
    assert close(torch.autograd.grad(found, wrt, g), torch.autograd.grad(expected, wrt, g), 200)


def test_the_gradient_of_a_relu_at_its_kink_is_that_of_torch():
    policy = policies.Network(nn.Sequential(nn.ReLU()))
    run = torchdq.compile(record("f", [Argument("x", 1)], lambda x: {"y": policy.recorded(x, {})}))
    x = torch.zeros(1, 1, requires_grad=True, dtype=torch.float64)
    assert torch.autograd.grad(run(x), x)[0] == torch.autograd.grad(torch.relu(x), x)[0] == 0


STEPS, ROWS = 6, 5
GOAL, CARRY = random(STEPS, 2, seed=6), random(ROWS, 1, seed=7)
TASK = {"task": Distance(), "goal": GOAL, "carry": CARRY}
HOW = {
    "states": {},
    "torques given as well": {"torque": random(STEPS, 2, seed=5)},
    "a task": TASK,
    "totals": {**TASK, "total": ("cost",), "ends": True},
    "states computed again": {**TASK, "total": ("cost",), "ends": True, "checkpoint": 4},
    "another precision of the weights": {"network": torch.float32},
}


@pytest.mark.parametrize("how", thinned(HOW, ("states computed again", "another precision of the weights")))
def test_rollouts_under_a_network_are_its_steps_with_gradients_of_two_orders(how):
    given = dict(HOW[how])
    network = seeded(lambda: nn.Linear(4, 8), nn.Tanh, lambda: nn.Linear(8, 2)).to(given.pop("network", torch.float64))
    policy, q = policies.Network(network), random(ROWS, 2).requires_grad_()
    wrt = [q, *network.parameters()]
    if "torque" in given:
        wrt.append(given["torque"].requires_grad_())

    def numbers(scene):
        found = scene.rollout(scene.start(q), policy=policy, steps=STEPS, **given)
        states, rows = found if "task" in given else (found, {})
        values = [states.q, states.qd, *rows.values()]
        loss = sum(x.square().sum() for x in values)
        gradients = torch.autograd.grad(loss, wrt, create_graph=True)
        second = torch.autograd.grad(sum(x.square().sum() for x in gradients), wrt, retain_graph=True)
        return [*values, *torch.autograd.grad(loss, wrt), *gradients, *second]

    single = network[0].weight.dtype == torch.float32
    for a, b in zip(numbers(SCENE), numbers(SCENE.replace(backend="eager")), strict=True):
        assert a.dtype == b.dtype and (a - b).abs().max() <= (1e-5 if single else 1e-12) * b.abs().max()


@pytest.mark.parametrize("batch", thinned([(ROWS,), ()], [(ROWS,)]))
def test_rollouts_under_gains_are_the_formula(batch):
    tensors = [random(STEPS, *batch, *axes, seed=k).requires_grad_() for k, axes in enumerate(((2, 6), (2,), (6,)))]
    scene = SCENE.replace(effects=(effects.Gravity(), effects.FirstOrderLag(0.05)))
    start = scene.start(random(ROWS, 2))

    def formula(state, k):
        gain, torque, expected = (x[k] for x in tensors)
        s = torch.cat([state.q, state.qd, state.memory], -1)
        return torque + torch.einsum("...ij,...j->...i", gain, s - expected)

    ends = [scene.rollout(start, policy=policy, steps=STEPS).q for policy in (policies.Linear(*tensors), formula)]
    assert close(ends[:1], ends[1:], 1e3)
    assert close(*[torch.autograd.grad(end.square().sum(), tensors) for end in ends], 1e5)


def test_checkpoints_of_a_network_keep_one_state_in_so_many():
    kept, policy = {}, policies.Network(seeded(lambda: nn.Linear(4, 8), nn.Tanh, lambda: nn.Linear(8, 2)))

    def pack(x):
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    sizes = []
    for checkpoint in (0, 10):
        kept.clear()
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
            SCENE.rollout(SCENE.start(random(64, 2)), policy=policy, steps=50, ends=True, checkpoint=checkpoint)
        sizes.append(sum(kept.values()))
    assert sizes[1] <= (5 * 4 + 10) * 64 * 8  # states, and the weights


Q = torch.zeros(3, 2, dtype=torch.float64)


def moved(policy=None, scene=SCENE, q=Q, **given):
    """Rollout of a scene from rest."""
    return scene.rollout(scene.start(q), policy=policy, **given)


def wide(name, outputs=2):
    """Network of the four numbers of a state that it is told to see."""
    return policies.Network(nn.Sequential(nn.Linear(4, outputs)), (name,))


def hooked(network):
    """Network whose first layer does more than its type says."""
    network[0].register_forward_hook(lambda layer, x, y: 3 * y)
    return network


ZEROS = torch.zeros(5, 2), torch.zeros(5, 4)
GAINS = policies.Linear(torch.zeros(5, 2, 4), *ZEROS)


@pytest.mark.parametrize(
    "call",
    [
        lambda: policies.Network(nn.Linear(4, 2)),
        lambda: policies.Network(nn.Sequential(nn.Linear(4, 2), nn.Sigmoid())),
        lambda: policies.Network(type("Scaled", (nn.Sequential,), {})(nn.Linear(4, 2))),
        lambda: policies.Network(hooked(nn.Sequential(nn.Linear(4, 2)))),
        lambda: policies.Network(nn.Sequential(nn.Linear(4, 2)), "q"),
        lambda: moved(wide("velocity"), steps=2),
        lambda: moved(wide("velocity"), SCENE.replace(backend="eager"), steps=2),
        lambda: moved(wide("q"), steps=2),
        lambda: moved(policies.Network(nn.Sequential(nn.Linear(4, 3))), steps=2),
        lambda: policies.Linear(torch.zeros(2, 4), *ZEROS),
        lambda: policies.Linear(None, *ZEROS),
        lambda: moved(policies.Linear(torch.zeros(5, 2, 3), *ZEROS), q=Q.float()),
        lambda: moved(policies.Linear(torch.zeros(5, 2, 4).double(), *ZEROS)),
        lambda: moved(GAINS, torque=Q[None]),
        lambda: moved(steps=2, total=("cost",)),
        lambda: moved(steps=2, task=Distance()),
        lambda: moved(steps=2, task="distance"),
        lambda: moved(steps=2, task=Distance),
        lambda: moved(steps=2, total=3),
    ],
)
def test_a_wrong_policy_or_task_is_refused(call):
    with refused(torchdq.TorchdqError):
        call()
