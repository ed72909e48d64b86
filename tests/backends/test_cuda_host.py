"""Kernels of the GPU backend, run on the host, against torch operations: rows, sums, shared memory and scenes.

Values and gradients of functions are those of test_backends.py and test_derivatives.py.
"""

import pytest
import torch
from helpers import random, thinned
from host_gpu import BACKWARDS, HOST, host_backends  # noqa: F401
from oracles import EPS
from programs import MIXED, PANDA, TWO, agree, mixed, same

import torchdq
from torchdq import effects
from torchdq.backends import cuda_source
from torchdq.backends.compiler import compiler
from torchdq.backends.precision import run
from torchdq.backends.torch import EAGER
from torchdq.envs import Actions, Pushes, RobotVectorEnv
from torchdq.envs.row_selection import Host
from torchdq.numbers.ops import apply as applied
from torchdq.program.program import LARGEST_GROWTH, Argument, record
from torchdq.program.uniform import split

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

F32, F64 = torch.float32, torch.float64
each_dtype = pytest.mark.parametrize("dtype", [F64, F32], ids=str)


def test_kernels_write_only_into_their_results():
    program = record("sums", [Argument("x", 3)], lambda x: {"y": [x[0] + x[1], x[2]], "z": [x[0] * x[2]]}, ["z"])
    for dtype in (F32, F64):
        kernel = HOST.kernel(program, dtype, torch.device("cpu"))
        x = random(45, 3, dtype=dtype)
        room = torch.full((60, 2), 9.0, dtype=dtype)
        y, z = room[10:55], torch.full((3, 1), 9.0, dtype=dtype)
        kernel._run([x], [y, z[1:2]], [], 45, x.device)
        assert (room[:10] == 9).all() and (room[55:] == 9).all() and z[[0, 2]].tolist() == [[9.0], [9.0]]
        same([y], [torch.stack([x[:, 0] + x[:, 1], x[:, 2]], -1)])


# --- rows that would lose their digits -------------------------------------------------------------------------------


def test_rows_over_the_limit_are_recomputed_in_float64():
    q, qd, tau = mixed(300)
    lost = torchdq.error_growth(MIXED, q) > LARGEST_GROWTH.single
    assert 4 < lost.sum() < 296
    found = torchdq.forward_dynamics(MIXED, q, qd, tau, backend="host")
    exact = torchdq.forward_dynamics(MIXED, q.double(), qd.double(), tau.double())
    assert ((found - exact).abs() / exact.abs().amax(-1, keepdim=True))[lost].max() <= 2 * EPS[F32]
    agree([found], [torchdq.forward_dynamics(MIXED, q, qd, tau)], 2.0**13)
    same([torchdq.forward_dynamics(MIXED, q, qd, tau, backend="backwards")], [found])


@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
def test_singular_rows_are_nan_and_alone(dtype):
    q, qd, tau = mixed(200, dtype)
    mass = MIXED.mass.to(dtype).repeat(200, 1)
    mass[60] *= -1
    robot = MIXED.to(dtype).replace(mass=mass, on_unphysical="ignore")
    others = [k for k in range(200) if k != 60]
    with torchdq.backend("host"):
        found = torchdq.forward_dynamics(robot, q, qd, tau)
        alone = torchdq.forward_dynamics(robot.replace(mass=mass[others]), q[others], qd[others], tau[others])
    assert found[60].isnan().all()
    same([found[others]], [alone])


@pytest.mark.parametrize("batch", thinned([1, 300], [300]))
def test_sums_contain_the_recomputed_rows(batch):
    q, qd, tau = mixed(batch)

    def gradient(backend, dtype=F32):
        layer = torchdq.ForwardDynamics(MIXED, learn=("mass",))
        with torchdq.backend(backend):
            (layer(q.to(dtype), qd.to(dtype), tau.to(dtype)) ** 2).sum().backward()
        return layer.parametrizations.mass.original.grad

    exact = gradient("eager", F64)
    errors = [(gradient(backend) - exact).norm() for backend in ("host", "eager")]
    assert errors[0] <= 4 * errors[1] + EPS[F32] * exact.norm()
    same([gradient("backwards")], [gradient("host")])


# --- values that all samples share ------------------------------------------------------------------------------------


@each_dtype
def test_values_that_all_samples_share_are_computed_once_in_a_block(dtype):
    def algorithm(x, p):
        common = [applied("sin", p[0]) * p[1] + p[k] for k in range(4)]
        weight = common[0] * common[1] * common[2] + common[3]
        return {"y": [weight * x[0], common[0] - x[0]], "sum": [weight * x[1]], "alone": [weight]}

    program = record("common", [Argument("x", 2), Argument("p", 4, uniform=True)], algorithm, ["sum"])
    parts = split(program)
    assert parts.rest.arguments[-1].width == 2 and not any(op.code == "sin" for op in parts.rest.ops)
    x, p = random(300, 2, dtype=dtype), random(4, seed=1, dtype=dtype)
    found = run(program, [x, p], HOST)
    agree(found, run(program, [x, p], EAGER))
    same(run(program, [x, p], BACKWARDS), found)


def test_programs_without_enough_to_share_stay_whole():
    layer = torchdq.compile(PANDA, "inverse_dynamics").program
    little = record("little", [Argument("x", 1), Argument("p", 1, True)], lambda x, p: {"y": [(p[0] + 1.0) * x[0]]})
    assert split(layer) is None and split(little) is None


# --- programs of any width -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
def test_rows_too_wide_for_shared_memory_are_read_and_written_where_they_are(dtype):
    def algorithm(x, y):
        return {"wide": [a * y[0] for a in x], "sum": [a + y[1] for a in x], "narrow": [y[0] + x[-1]]}

    program = record("wide", [Argument("x", 250), Argument("y", 2)], algorithm, ["sum"])
    stage = cuda_source.staged(program, dtype == F32)
    assert not stage.arguments & {0} and 0 not in stage.results and 2 in stage.results
    x, y = random(70, 250, dtype=dtype), random(70, 2, seed=1, dtype=dtype)
    found = run(program, [x, y], HOST)
    agree(found, run(program, [x, y], EAGER))
    same(run(program, [x, y], BACKWARDS), found)


# --- scenes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", thinned(["SameStep", "NextStep"], ("SameStep",)))
def test_a_step_of_environments_asks_the_device_nothing(mode, monkeypatch):
    with torchdq.backend("host"):
        pushed = {"effects": (effects.Push(),), "pushes": {"push": Pushes((1.0,) * 6, (0.0, 0.1))}}
        envs = RobotVectorEnv(
            70, "reach", TWO, action=Actions(scale=20.0), max_episode_steps=2, autoreset_mode=mode, **pushed
        )
        envs._host = Host(False)  # as on a GPU
        envs.reset(seed=0)
        envs.step(torch.zeros(70, 2))
        asked = []
        for name in ("item", "__bool__", "__int__", "__float__", "tolist", "nonzero", "cpu", "numpy"):
            monkeypatch.setattr(torch.Tensor, name, lambda x, *a, name=name: asked.append(name))
        monkeypatch.setattr(torch, "equal", lambda *a: asked.append("equal"))
        truncated = envs.step(torch.zeros(70, 2))[3]
        envs.step(torch.zeros(70, 2))
        monkeypatch.undo()
    assert not asked and bool(truncated.all())


# --- text ------------------------------------------------------------------------------------------------------------


def test_a_text_is_the_same_for_equal_programs():
    one, other = (record("sum", [Argument("x", 2)], lambda x: {"y": [x[0] + x[1]]}) for _ in range(2))
    assert cuda_source.source(one, True) == cuda_source.source(other, True)
