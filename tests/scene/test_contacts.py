"""Readings of `scene.contacts` in a state: forces that carry the robot, touch, depth and slip of every point."""

import math

import pytest
import torch
from helpers import thinned
from messages import refused
from on_ground import body

import torchdq
from torchdq import Scene, dq, effects
from torchdq.errors import ArgumentError
from torchdq.robot import ContactPoint

F64 = torch.float64
MASS, SIDE, G = 2.0, 0.1, 9.81
CORNERS = tuple(ContactPoint("body", (x, y, -SIDE / 2)) for x in (-SIDE / 2, SIDE / 2) for y in (-SIDE / 2, SIDE / 2))


ROBOT, GRAVITY = body(MASS, (0.003, 0.003, 0.003)), effects.Gravity((0.0, 0.0, -G))


def scene(*points: ContactPoint, **parameters) -> Scene:
    return Scene(ROBOT, (GRAVITY, effects.Contact(points, stiffness=1e4, friction=0.3, **parameters)), dt=0.005)


def pose(height: float, angle: float = 0.0) -> torch.Tensor:
    turn = torch.tensor([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0], dtype=F64)
    return dq.from_pose(turn, torch.tensor([0.0, 0.0, height], dtype=F64))


def after(scene: Scene, steps: int, X_WB: torch.Tensor, **start: torch.Tensor):
    state = scene.start(torch.zeros(0, dtype=F64), X_WB=X_WB, **start)
    return scene.replace(backend="auto" if steps > 30 else "eager").rollout(state, steps=steps, ends=True)


@pytest.mark.parametrize("stiction", thinned([True, False], [True]))
def test_a_body_at_rest_is_carried(stiction):
    resting = scene(*CORNERS, stiction=stiction)
    found = resting.contacts(after(resting, 400, pose(SIDE / 2)))
    torch.testing.assert_close(found.force.sum(-2), torch.tensor([0.0, 0.0, MASS * G], dtype=F64), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found.normal_force, torch.full((4,), MASS * G / 4, dtype=F64), rtol=1e-6, atol=0.0)
    torch.testing.assert_close(found.depth, found.normal_force / 1e4, rtol=1e-6, atol=0.0)
    assert found.touching.all()
    assert (found.slip < 1e-6).all()


@pytest.mark.parametrize("stiction", [True, False])
def test_friction_of_a_sliding_body_opposes_its_slip(stiction):
    sliding = scene(*CORNERS, stiction=stiction)
    V = torch.tensor([0.0, 0.0, 0.0, 2.0, 0.0, 0.0], dtype=F64)
    state = after(sliding, 60, pose(SIDE / 2 - MASS * G / 4e4), V_WB_B=V)
    found = sliding.contacts(state)
    assert found.touching.all()
    torch.testing.assert_close(found.force[:, 0], -0.3 * found.normal_force, rtol=1e-3, atol=0.0)
    torch.testing.assert_close(found.slip, state.V_WB_B[3].expand(4), rtol=1e-4, atol=0.0)


def test_forces_are_those_of_the_world_and_points_count_in_the_order_of_the_effects():
    parts = (CORNERS[:1], CORNERS[1:], CORNERS)
    *floors, whole = (effects.Contact(part, stiffness=1e4, friction=0.3, stiction=False) for part in parts)
    two, one = Scene(ROBOT, (GRAVITY, *floors), dt=0.005), Scene(ROBOT, (GRAVITY, whole), dt=0.005)
    tilted = pose(0.07, 0.4)
    for a, b in zip(two.contacts(after(two, 30, tilted)), one.contacts(after(one, 30, tilted)), strict=True):
        torch.testing.assert_close(a, b)


def test_a_body_in_the_air_touches_nothing():
    flying = scene(*CORNERS)
    found = flying.contacts(after(flying, 3, pose(1.0)))
    assert not found.touching.any() and (found.force == 0).all() and (found.depth < -0.9).all()


def test_a_scene_without_contact_has_none():
    bare = Scene(torchdq.robots.load("two_link"))
    with refused(ArgumentError):
        bare.contacts(bare.start(torch.zeros(2)))
