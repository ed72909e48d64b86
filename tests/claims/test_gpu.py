"""Claims that a GPU could break, on a GPU: `pytest -m gpu`. Without one they are skipped.

Values and gradients against the C backend, streams, captured graphs, traced layers, rows that are recomputed, several
devices, and environments.
"""

import itertools

import pytest
import torch
from helpers import all_in_one, random
from oracles import states
from programs import FUNCTIONS, MIXED, PANDA, TREE, TWO, agree, condition, mixed, same
from torch.autograd import gradcheck, gradgradcheck

import torchdq
from torchdq import Scene, effects
from torchdq.backends.choice import choose
from torchdq.envs import RobotVectorEnv
from torchdq.program.program import LARGEST_GROWTH
from torchdq.scene import integrators

F32, F64 = torch.float32, torch.float64
pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU that torch can use")]
GPU = torch.device("cuda")


def to(device, x):
    """Results on another device."""
    return tuple(y.to(device) for y in (x if isinstance(x, tuple) else (x,)))


def moved(state, device):
    """State of `oracles.states` on a device."""
    return type(state)(*(None if x is None else x.to(device) for x in state))


def test_tensors_on_a_gpu_take_its_backend():
    assert choose(None, GPU).name == "cuda"


# --- values and derivatives ------------------------------------------------------------------------------------------


@all_in_one([*itertools.product(FUNCTIONS, [TWO, TREE, PANDA], [F64, F32])])
def test_functions_equal_those_of_the_c_backend(of_what):
    name, robot, dtype = of_what
    s = states(robot, 1000, dtype=dtype)
    worst = condition(name, robot, s)
    expected = FUNCTIONS[name](robot, s)
    found = FUNCTIONS[name](robot.to(GPU), moved(s, GPU))
    agree(to("cpu", found), to("cpu", expected), 64 * worst)


@pytest.mark.parametrize("batch", [0, 1, 31, 33, 127, 129, 100_000])
def test_a_row_of_a_batch_is_bitwise_the_row_alone(batch):
    s = moved(states(PANDA, batch), GPU)
    tau = torchdq.inverse_dynamics(PANDA, s.q, s.qd, s.qdd)
    assert tau.shape == (batch, 7)
    for k in {*range(min(batch, 3)), *range(max(batch - 3, 0), batch)}:
        same([torchdq.inverse_dynamics(PANDA, s.q[k], s.qd[k], s.qdd[k])], [tau[k]])


@pytest.mark.parametrize("dtype", [F64, F32], ids=str)
def test_gradients_with_learned_masses_equal_those_of_the_c_backend_and_repeat(dtype):
    s = states(PANDA, 5000, dtype=dtype)

    def gradients(device):
        layer = torchdq.DQRNEA(PANDA, learn=("mass", "com", "inertia")).to(device)
        x = [v.to(device).requires_grad_() for v in (s.q, s.qd, s.qdd)]
        (layer(*x) ** 2).sum().backward()
        return [x.cpu() for x in (*(v.grad for v in x), *(p.grad for p in layer.parameters()))]

    found = gradients(GPU)
    agree(found, gradients("cpu"), 4096, dtype)
    same(gradients(GPU), found)


def test_first_and_second_derivatives_are_those_of_finite_differences():
    x = [random(2, 2, seed=k).to(GPU).requires_grad_() for k in range(3)]
    for function in (torchdq.inverse_dynamics, torchdq.forward_dynamics):
        gradcheck(lambda *x, f=function: f(TWO, *x), x)
        gradgradcheck(lambda *x, f=function: f(TWO, *x), x)


def test_rows_over_the_limit_are_recomputed_in_float64():
    q, qd, tau = mixed(3000)
    lost = torchdq.error_growth(MIXED, q) > LARGEST_GROWTH.single
    found = torchdq.forward_dynamics(MIXED, q.to(GPU), qd.to(GPU), tau.to(GPU)).cpu()
    exact = torchdq.forward_dynamics(MIXED, q.double(), qd.double(), tau.double())
    assert lost.any() and ((found - exact).abs() / exact.abs().amax(-1, keepdim=True))[lost].max() <= 2.0**-22


# --- how calls are made ----------------------------------------------------------------------------------------------


def test_a_call_does_not_wait_for_the_gpu():
    s = moved(states(MIXED, 1000, dtype=F32), GPU)
    torchdq.forward_dynamics(MIXED, s.q, s.qd, s.qdd)
    torch.cuda.set_sync_debug_mode("error")
    try:
        torchdq.forward_dynamics(MIXED, s.q, s.qd, s.qdd)
        torchdq.inverse_dynamics(MIXED, s.q, s.qd, s.qdd)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def warm_up(iteration):
    """Iterations on another stream, as graphs want them before they are captured."""
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        for _ in range(3):
            iteration()
    torch.cuda.current_stream().wait_stream(stream)


def test_a_training_iteration_is_captured_in_a_graph():
    layer = torchdq.DQRNEA(PANDA, learn=("mass",)).to(GPU)
    x = random(3, 256, 7, dtype=F32).to(GPU)

    def iteration():
        layer.zero_grad(set_to_none=False)
        (layer(*x) ** 2).mean().backward()

    warm_up(iteration)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        iteration()
    x.copy_(random(3, 256, 7, seed=1, dtype=F32))
    graph.replay()
    found = [p.grad.clone() for p in layer.parameters()]
    iteration()
    same(found, [p.grad for p in layer.parameters()])


@pytest.mark.parametrize("dtype", [F64, F32], ids=str)
def test_rollouts_and_their_gradients_equal_those_of_the_c_backend(dtype):
    scene = Scene(PANDA, (effects.Gravity(), effects.Viscous(1.0)), dt=1e-3)

    def found(device):
        q, torque = random(300, 7, dtype=dtype).to(device), random(20, 300, 7, seed=1, dtype=dtype).to(device)
        q, torque = q.requires_grad_(), torque.requires_grad_()
        states = scene.rollout(scene.start(q), torque)
        return to("cpu", (*states[:2], *torch.autograd.grad((states.q * states.qd).sum(), (q, torque))))

    agree(found(GPU), found("cpu"), 2.0**14)


def test_a_rollout_is_captured_in_a_graph():
    scene = Scene(PANDA, (effects.Gravity(), effects.Viscous(1.0)), integrator=integrators.SemiImplicitEuler(), dt=1e-3)
    q, torque = random(64, 7, dtype=F32).to(GPU), random(10, 64, 7, seed=1, dtype=F32).to(GPU)
    expected = scene.rollout(scene.start(q), torque, nonfinite="ignore").q
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = scene.rollout(scene.start(q), torque, nonfinite="ignore").q
    graph.replay()
    same([found], [expected])


def test_a_training_iteration_through_a_rollout_is_captured_in_a_graph():
    scene = Scene(PANDA, (effects.Gravity(), effects.Viscous(1.0)))
    q = random(64, 7, dtype=F32).to(GPU)

    def trainer():
        torch.manual_seed(0)
        net = torch.nn.Linear(14, 7).to(GPU)
        optimiser = torch.optim.Adam(net.parameters(), 1e-3, capturable=True)

        def iteration():
            optimiser.zero_grad(set_to_none=False)
            states = scene.rollout(
                scene.start(q), steps=5, policy=lambda s, k: net(torch.cat(s[:2], 1)), nonfinite="ignore"
            )
            loss = states.q.square().mean()
            loss.backward()
            optimiser.step()
            return loss.detach()

        warm_up(iteration)
        return iteration

    captured, plain, graph = trainer(), trainer(), torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        found = captured()
    for _ in range(3):
        graph.replay()
        torch.testing.assert_close(found, plain())


def test_calls_run_on_the_present_stream():
    s = moved(states(PANDA, 100_000), GPU)
    expected = torchdq.inverse_dynamics(PANDA, s.q, s.qd, s.qdd)
    torch.cuda.synchronize()
    found = []
    for _ in range(4):
        stream = torch.cuda.Stream()
        with torch.cuda.stream(stream):
            torch.cuda._sleep(10_000_000)
            q = s.q + 0.0
            found.append(torchdq.inverse_dynamics(PANDA, q, s.qd, s.qdd))
    torch.cuda.synchronize()
    same(found, [expected] * 4)


def test_inputs_need_not_be_contiguous():
    q, qd, qdd = random(7, 3, 90).to(GPU).unbind(1)
    found = torchdq.inverse_dynamics(PANDA, q.T, qd.T, qdd.T[:1])
    agree([found.cpu()], [torchdq.inverse_dynamics(PANDA, q.T.cpu(), qd.T.cpu(), qdd.T[:1].cpu())])


def test_compiled_and_exported_layers():
    layer = torchdq.DQRNEA(PANDA)
    x = tuple(random(3, 50, 7, dtype=F32).to(GPU))
    expected = layer(*x)
    same([torch.compile(layer, fullgraph=True)(*x)], [expected])
    agree([torch.export.export(layer, x).module()(*x)], [expected])


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="one GPU")
def test_several_devices():
    s = states(PANDA, 100)
    found = [torchdq.inverse_dynamics(PANDA, *(x.to(f"cuda:{k}") for x in (s.q, s.qd, s.qdd))).cpu() for k in (0, 1)]
    same(found[:1], found[1:])


# --- environments ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["reach", "track"])
def test_environments_are_those_of_the_cpu(task):
    envs = [RobotVectorEnv(300, task, "panda", device=device, output="torch") for device in ("cpu", GPU)]
    observations = [env.reset(seed=0)[0].cpu() for env in envs]
    agree(observations[1:], observations[:1], 1024)
    for k in range(20):
        actions = random(300, 7, seed=k, dtype=F32).tanh()
        (a, *_), (b, *_) = (env.step(actions.to(env.device)) for env in envs)
    agree([b.cpu()], [a], 2.0**16)
    counters = [env.get_state()["counter"].cpu() for env in envs]
    same(counters[1:], counters[:1])


@pytest.mark.parametrize("mode", ["SameStep", "NextStep", "Disabled"])
def test_a_step_asks_the_gpu_nothing_and_is_repeated_by_a_graph(mode):
    options = {"max_episode_steps": 5, "randomise": {"mass": 0.1, "payload": 1.0}, "autoreset_mode": mode}
    envs, plain = (RobotVectorEnv(300, "reach", "panda", device=GPU, **options) for _ in "ab")
    actions = torch.zeros(300, 7, device=GPU)
    for each in (envs, plain):
        each.reset(seed=0)
        each.step(actions)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        observations, rewards, terminated, truncated, _ = envs.step(actions)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for k in range(12):
            graph.replay()
            expected = plain.step(actions)
            if k == 7:
                for each in (envs, plain):
                    each.reset(options={"reset_mask": expected[2] | expected[3]})
    finally:
        torch.cuda.set_sync_debug_mode("default")
    same([observations, rewards, terminated, truncated], expected[:4])
    same(envs.get_state().values(), plain.get_state().values())
