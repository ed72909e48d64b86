"""Derivatives of a step: those of differences, for every kind of scene."""

import pytest
import torch
from helpers import double, random
from messages import refused
from scenes import ARM, TREE

import torchdq
from torchdq.envs import Scene, State, effects
from torchdq.scene.controllers import PD
from torchdq.scene.integrators import Repeated, RungeKutta4


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
    with refused(torchdq.ArgumentError):
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
