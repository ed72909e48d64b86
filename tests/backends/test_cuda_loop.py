"""Loops of the GPU backend: limits and shared values on the host, and that they compile for GPUs."""

import pytest
import torch
from helpers import EVERYTHING, random, thinned
from host_gpu import BACKWARDS, HOST, host_backends  # noqa: F401
from loops import gradients, loop, one_by_one, parts, step, tensors
from messages import refused, warned
from programs import PANDA, TWO, agree, same

import torchdq
from torchdq import Scene, effects
from torchdq.backends import cuda, nvrtc
from torchdq.backends.compiler import BuildError, compiler
from torchdq.backends.cuda_loop import loop_source, recomputing_loop_source
from torchdq.backends.cuda_source import source
from torchdq.backends.loop_call import repeat
from torchdq.backends.torch import InterpretedLoop
from torchdq.functions.compile import RecordedComputation
from torchdq.program.loop import Loop, adjoint, with_states
from torchdq.program.program import LARGEST_GROWTH, Argument, record

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

F32, F64 = torch.float32, torch.float64
SMALL, GROWING = step(), step(growth=True)
each_dtype = pytest.mark.parametrize("dtype", [F64, F32], ids=str)


def looped(program, steps, given, backend="host", **options):
    return repeat(RecordedComputation(program), steps, *parts(given), total=("z",), backend=backend, **options)


def test_samples_over_the_limit_at_some_step_are_those_of_a_loop_in_float64():
    given = tensors(150, 5, dtype=F32)
    expected, wide = one_by_one(SMALL, 5, given, "host"), {name: x.double() for name, x in given.items()}
    exact = one_by_one(SMALL, 5, wide, "host")
    over = ~((1000 * expected["x"][1:, :, 0] ** 2).amax(0) <= LARGEST_GROWTH.single)
    assert 10 < over.sum() < 140
    found = looped(GROWING, 5, given)
    for name, y in found.items():
        same([y[..., ~over, :]], [expected[name][..., ~over, :]])
        same([y[..., over, :]], [exact[name][..., over, :].float()])


def test_gradients_of_samples_over_the_limit_are_those_of_float64():
    def found(program, dtype):
        given = {name: x.to(dtype).detach().requires_grad_() for name, x in tensors(150, 4, dtype=F32).items()}
        return [y.double() for y in gradients(looped(program, 4, given), given)]

    exact, errors = found(SMALL, F64), []
    for program in (GROWING, SMALL):
        errors.append([(y - e).norm() / e.norm() for y, e in zip(found(program, F32), exact, strict=True)])
    assert all(guarded <= 2 * plain for guarded, plain in zip(*errors, strict=True))


@each_dtype
def test_values_that_all_samples_share_are_computed_once_for_all_steps(dtype):
    def algorithm(x, m):
        weight = m[0] * m[1] + m[2] * m[3] - m[0] / (m[1] * m[1] + 2.0) + m[3] / (m[2] * m[2] + 3.0)
        return {"x": [0.5 * x[0] + weight * x[1], x[1] - 0.1 * weight]}

    program = record("common", [Argument("x", 2), Argument("m", 4, uniform=True)], algorithm)
    assert "common[" in loop_source(Loop(program, ((0, 0),)), dtype == F32)
    x, m, after = random(150, 2, dtype=dtype), random(4, seed=1, dtype=dtype), []
    for backend in ("host", "backwards"):
        after.append(repeat(RecordedComputation(program), 4, {"x": x}, {}, {"m": m}, backend=backend)["x"])
    y = x.double()
    for _ in range(4):
        w = algorithm([0.0, 1.0], m.double())["x"][0]
        y = torch.stack([0.5 * y[:, 0] + w * y[:, 1], y[:, 1] - 0.1 * w], -1)
    same(after[:1], after[1:])
    agree([after[0][-1]], [y.to(dtype)], 256)


@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
def test_a_rollout_of_a_scene_is_its_steps_and_asks_the_device_nothing(dtype, monkeypatch):
    parts = (effects.Gravity(), effects.Viscous(0.5), effects.Coulomb(0.3), effects.FirstOrderLag(0.02))
    scene = Scene(TWO, (*parts, effects.Noise(1e-3, 1e-3)), dt=0.005)
    torque, noise = random(3, 20, 2, dtype=dtype), 0.5 + 0.1 * random(3, 20, 4, dtype=dtype).tanh()
    asked = []
    with torchdq.backend("host"):
        state = scene.start(random(20, 2, seed=1, dtype=dtype), noise=noise[0])
        scene.rollout(state, torque, noise=noise)  # records and compiles
        with monkeypatch.context() as patch:
            for name in ("item", "__bool__", "__int__", "__float__", "tolist", "nonzero", "cpu", "numpy"):
                patch.setattr(torch.Tensor, name, lambda x, *a, name=name: asked.append(name))
            found = scene.rollout(state, torque, noise=noise, nonfinite="ignore")
        for k in range(3):
            state = scene.step(state, torque[k], noise=noise[k])
            same([x[k] for x in found.rows().values()], state.rows().values())
    assert not asked


def test_loops_that_cannot_be_compiled_are_run_by_torch_or_refused(monkeypatch):
    monkeypatch.setattr(nvrtc, "found", lambda: "no NVRTC")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (9, 0))
    device = torch.device("cuda", 99)
    torchdq.clear_caches()  # what was warned of once
    with warned(UserWarning):
        assert isinstance(cuda.CUDA_OR_EAGER.loop(loop(SMALL), F64, device, 1), InterpretedLoop)
    with refused(BuildError):
        cuda.CUDA.loop(loop(SMALL), F64, device, 1)


# --- for GPUs --------------------------------------------------------------------------------------------------------

found = nvrtc.found()


@pytest.mark.skipif(isinstance(found, str), reason="no NVRTC: pip install nvidia-cuda-nvrtc")
@pytest.mark.parametrize(
    "kind, robot",
    thinned([(kind, x) for kind in ("rollout", "adjoint") for x in (TWO, PANDA)], [("adjoint", TWO)]),
    ids=lambda x: getattr(x, "name", x),
)
def test_loops_compile_for_gpus_in_about_the_registers_of_a_step(kind, robot):
    body = Scene(robot, (effects.Gravity(), effects.Viscous(0.5)), dt=0.005).program("torque")
    whole = with_states(Loop(body, ((0, 0), (1, 1)), (2,)))
    whole = whole if kind == "rollout" else adjoint(whole, (2,))
    assert body.growth is not None
    for single in thinned((True, False), (True,) if robot is PANDA else (True, False)):
        step_, loop_ = (found.compile(f(x, single), "x", 90) for f, x in ((source, whole.body), (loop_source, whole)))
        assert loop_.registers <= step_.registers + 8 and loop_.spilled <= 1.25 * step_.spilled
    if EVERYTHING or robot is TWO:
        assert found.compile(recomputing_loop_source(whole), "x", 90).registers
