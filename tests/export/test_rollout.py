"""Rollouts in C: the exported function of many steps is `Scene.rollout`, and only steps have one."""

import ctypes

import pytest
import torch
from exporting import F64, STRICT, TWO, loaded, passes_its_test
from helpers import random, thinned
from programs import F32, PANDA, agree

import torchdq
from torchdq import Scene, effects
from torchdq.program.program import Argument, record

STEPS = 20


def numbers(x):
    """Pointer to the numbers of a tensor."""
    assert x.is_contiguous()
    return ctypes.c_void_p(x.data_ptr())


@pytest.mark.parametrize(
    ("robot", "dtype"),
    thinned([(r, x) for r in (TWO, PANDA) for x in (F64, F32)], [(TWO, F64), (TWO, F32)]),
    ids=lambda x: getattr(x, "name", str(x)),
)
def test_an_exported_rollout_is_that_of_the_scene(robot, dtype, tmp_path):
    n = robot.n
    damping = 0.5 + random(n, dtype=dtype).abs()  # an argument that is the same at all steps
    scene = Scene(robot, (effects.Gravity(), effects.Viscous(damping), effects.FirstOrderLag(0.02)), dt=0.005)
    made = torchdq.compile(scene.program(), dtype=dtype).export(tmp_path, "arm")
    passes_its_test(made)
    called = loaded(made).arm_rollout
    start, torque = scene.start(random(n, dtype=dtype)), random(STEPS, n, seed=1, dtype=dtype)
    expected = list(scene.rollout(start, torque).rows().values())
    found = [torch.full_like(y, torch.nan) for y in expected]
    inputs = [*start.rows().values(), torque, damping]
    growth = torch.empty(STEPS, dtype=dtype)
    assert called(ctypes.c_size_t(STEPS), *map(numbers, (*inputs, *found, growth))) == 0
    agree(found, expected, 2.0**14)
    kept = [y.clone() for y in found]
    assert called(ctypes.c_size_t(0), *map(numbers, (*inputs, *found, growth))) == 0
    assert all(torch.equal(a, b) for a, b in zip(found, kept, strict=True))
    torque[7, 0] = torch.nan
    assert called(ctypes.c_size_t(STEPS), *map(numbers, (*inputs, *found, growth))) == 1
    assert torch.equal(found[0][:7], kept[0][:7]) and found[1][7:].isnan().any(-1).all()


def test_only_steps_have_a_rollout(tmp_path):
    step = torchdq.compile(Scene(TWO, (effects.Gravity(),)).program("torque"))
    for other in (torchdq.compile(TWO, "forward_dynamics"), step.vjp(), step.jacobian()):
        made = other.export(tmp_path, "other")
        assert "rollout" not in made.header.read_text() + made.source.read_text() + made.test.read_text()
    made = step.export(tmp_path, "arm")
    assert "int arm_rollout(size_t steps, const double *q, const double *qd, const double *torque," in (
        made.header.read_text()
    )
    assert "of the start: q, qd." in made.header.read_text()


def test_any_names_of_arguments_make_a_rollout(tmp_path):
    names = ("k", "j", "steps", "place", "status", "rollout", "f")
    program = record("odd", [Argument(name, 2) for name in names], lambda *x: {"k": x[1], "j": x[0], "steps": x[4]})
    passes_its_test(torchdq.compile(program).export(tmp_path, "f_odd"), *STRICT)
