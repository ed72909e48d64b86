"""Rollouts as loops: to the bit what steps one after the other are, in states, rows of a task and gradients."""

from dataclasses import dataclass

import pytest
import torch
from free_flyers import case, motion
from helpers import random, thinned
from scenes import ARM, equal, inputs_of, rich, uniform

from torchdq import Scene, effects
from torchdq.scene.integrators import RungeKutta4
from torchdq.scene.loops import loops

ROWS, STEPS = 5, 7


@dataclass(frozen=True)
class Effort:
    """Task: a reward of the state and the torque, an observation, and the last velocities, which it remembers."""

    def inputs(self, n):
        return {"goal": n, "carry": n}

    def rows(self, view):
        changes = [a - b for a, b in zip(view.qd, view.inputs["carry"], strict=True)]
        error = [a - b for a, b in zip(view.q, view.inputs["goal"], strict=True)]
        reward = sum([t * c + e * e for t, c, e in zip(view.torque, changes, error, strict=True)], 0.0)
        return {"reward": [reward], "observation": [*view.reading, *error], "carry": view.qd}


def flying(rows=ROWS):
    """Scene of a floating base that touches the ground, and its state in motion."""
    base = case("tree1")
    m = motion(base, batch=rows)
    acting = (effects.Gravity(), effects.Contact(height=0.3, stiffness=100.0, friction=0.5), effects.Noise(0.1, 0.2))
    scene = Scene(base.robot, acting)
    return scene.replace(backend="auto"), scene.start(
        m["q"], m["qd"], uniform(scene, rows), X_WB=m["X_WB"], V_WB_B=m["V_WB_B"]
    )


def standing(scene):
    """Scene, and a state of it in motion."""
    q = 0.3 * random(ROWS, scene.n)
    start = scene.start(q, random(ROWS, scene.n, seed=1), uniform(scene, ROWS))
    return scene.replace(backend="auto"), start


masses = ARM.mass * torch.linspace(0.8, 1.2, ROWS, dtype=torch.float64)[:, None]
SCENES = {
    "effects of every slot": lambda: standing(rich(ARM)),
    "a floating base with contact": flying,
    "rows that differ": lambda: standing(
        Scene(ARM.replace(mass=masses), (effects.Viscous(random(ROWS, 2).abs()),), integrator=RungeKutta4())
    ),
}


def inputs_of_task(scene, rows=ROWS):
    """Inputs of a scene and of the task, random."""
    n = scene.n
    return {"carry": random(rows, n), **inputs_of(scene, STEPS, rows), "goal": random(STEPS, rows, n, seed=8)}


def learning(tensors):
    """Copies that require gradients."""
    return {key: x.detach().clone().requires_grad_() for key, x in tensors.items()}


def with_gradients(values, wrt):
    """Values, and gradients of a function of all of them."""
    gradients = torch.autograd.grad(sum(x.square().sum() for x in values), wrt, allow_unused=True)
    return [*values, *(0 * x if g is None else g for x, g in zip(wrt, gradients, strict=True))]


def looped(scene, start, noise, inputs):
    """States and rows of the task of a rollout, with their gradients in the start and the inputs."""
    rows, inputs = learning(start.rows()), learning(inputs)
    start = type(start)(**rows)
    assert loops(scene, start)
    found, told = scene.rollout(start, noise=noise, task=Effort(), nonfinite="ignore", **inputs)
    return with_gradients([*found.rows().values(), *told.values()], [*rows.values(), *inputs.values()])


@pytest.mark.parametrize("name", thinned(SCENES, ("effects of every slot", "a floating base with contact")))
def test_loops_are_steps_to_the_bit(name):
    scene, start = SCENES[name]()
    inputs, noise = inputs_of_task(scene), uniform(scene, STEPS, ROWS)
    found = looped(scene, start, noise, inputs)
    rows, inputs = learning(start.rows()), learning(inputs)
    state, carry, states, heard = type(start)(**rows), inputs["carry"], [], []
    for k in range(STEPS):
        given = {"carry": carry, **{key: x[k] for key, x in inputs.items() if key != "carry"}}
        state, more = scene._advance(state, given, noise[k], Effort())
        carry = more["carry"]
        states.append(state)
        heard.append(more)
    stacked = [torch.stack([getattr(x, key) for x in states]) for key in rows]
    stacked += [torch.stack([x[key] for x in heard]) for key in heard[0]]
    assert equal(found, with_gradients(stacked, [*rows.values(), *inputs.values()]))


def test_totals_and_ends_are_sums_and_the_last_state():
    scene, start = SCENES["rows that differ"]()
    given = {"task": Effort(), "carry": random(ROWS, 2), "goal": random(STEPS, 2), "torque": random(STEPS, ROWS, 2)}
    states, rows = scene.rollout(start, **given)
    ends, told = scene.rollout(start, **given, total=("reward",), ends=True)
    assert equal(ends, states.last) and torch.equal(told["carry"], rows["carry"][-1])
    assert torch.equal(told["observation"], rows["observation"])
    assert (told["reward"] - rows["reward"].sum(0)).abs().max() <= 1e-14 * rows["reward"].abs().sum(0).max()
    stepped, heard = scene.rollout(start, **given, total=("reward",), ends=True, done=lambda s: s.q[:, 0] > 99.0)
    assert equal(stepped, ends) and equal(heard.values(), told.values())


def test_rows_that_have_ended_have_no_reward():
    scene, start = SCENES["rows that differ"]()
    given = {"task": Effort(), "carry": random(ROWS, 2), "goal": random(STEPS, 2)}

    def done(state):
        return state.q[:, 0] > start.q[:, 0].median()

    states, rows = scene.rollout(start, steps=STEPS, **given, done=done)
    before = torch.cat([start.q[None], states.q])[:-1]
    ended = before[..., 0] > start.q[:, 0].median()
    assert ended[0].any() and not ended[-1].all()
    assert not rows["reward"][ended].any() and rows["reward"][~ended].all()


@pytest.mark.parametrize("checkpoint", [1, 3, 10])
def test_states_computed_again_change_neither_totals_nor_gradients(checkpoint):
    scene, start = SCENES["rows that differ"]()
    torque = random(STEPS, ROWS, 2).requires_grad_()
    given = {"task": Effort(), "carry": random(ROWS, 2), "goal": random(STEPS, 2), "torque": torque, "ends": True}

    def numbers(checkpoint):
        state, rows = scene.rollout(start, **given, total=("reward",), checkpoint=checkpoint)
        loss = rows["reward"].sum() + state.q.square().sum() + rows["observation"].sum()
        return loss, *state.rows().values(), *rows.values(), *torch.autograd.grad(loss, torque)

    for a, b in zip(numbers(checkpoint), numbers(0), strict=True):
        assert (a - b).abs().max() <= 1e-13 * b.abs().max()
