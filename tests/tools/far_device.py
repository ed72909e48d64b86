"""A device "far" for tests: its tensors have numbers, and everything that would make a host wait for a GPU is an error.

    python tests/tools/far_device.py CLAIM ...    runs claims below, and prints a line for each

Operations compute on the CPU, but a tensor of the far device and one of the CPU do not meet, except where one is copied
on purpose. While the host is `ahead` of the device, it may not read numbers of the device or copy any to or from
it. Programs run as GPU kernels do, compiled for the host. The name of the device is one for the whole process, so the
claims have a process of their own.
"""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from host_gpu import HOST
from small_envs import grouped
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

import torchdq
from torchdq import Scene, effects
from torchdq.backends import call, choice
from torchdq.backends.cuda import Cuda
from torchdq.envs import RobotVectorEnv, TorchTask
from torchdq.envs.row_selection import Host
from torchdq.program import transforms
from torchdq.scene.controllers import ComputedTorque
from torchdq.scene.defaults import default_effects

_setup_privateuseone_for_python_backend("far")
FAR = torch.device("far", 0)
READS = ("_local_scalar_dense", "equal", "is_nonzero", "nonzero", "masked_select", "_unique2", "repeat_interleave")


class FarError(Exception):
    """The host waits for the device, or tensors of two devices meet."""


class FarTensor(Tensor):
    """Tensor of the far device; `near` has its numbers."""

    near: Tensor

    def tolist(self):
        """Numbers, which torch refuses to list for tensors of a subclass."""
        return self.cpu().tolist()

    @staticmethod
    def __new__(cls, near: Tensor) -> FarTensor:
        memory = {"strides": near.stride(), "storage_offset": near.storage_offset()}
        kind = {"dtype": near.dtype, "device": FAR, "requires_grad": near.requires_grad}
        found = Tensor._make_wrapper_subclass(cls, near.size(), **memory, **kind)
        found.near = near
        return found

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return computed(func, args, kwargs or {})


class Far(TorchDispatchMode):
    """Mode in which the far device can be named."""

    ahead = False  # whether the host is ahead of the device
    graph: Graph | None = None  # graph that is being captured

    @classmethod
    def _should_skip_dynamo(cls):
        return False  # else torch imports its compiler, which takes seconds and has no part here

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return computed(func, args, kwargs or {})

    def __enter__(self):
        torch._C._set_only_lift_cpu_tensors(True)  # else `torch.tensor` asks for the device where no mode sees it
        return super().__enter__()


def near(x):
    """Tensor with the numbers of a far one."""
    return x.near if isinstance(x, FarTensor) else x


def far(x):
    """Tensor of the far device."""
    return FarTensor(x) if isinstance(x, Tensor) and not isinstance(x, FarTensor) else x


def computed(func, args, kwargs):
    """Result of an operation of torch."""
    name = func.overloadpacket.__name__
    given = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
    distant = [isinstance(x, FarTensor) for x in given]
    wanted = kwargs.get("device")
    to_far = any(distant) if wanted is None else torch.device(wanted).type == FAR.type
    if name in ("_to_copy", "copy_"):
        waits = len({*distant, to_far}) > 1
        to_far = to_far if name == "_to_copy" else distant[0]
    else:
        masks = name.startswith("index") and any(x.dtype == torch.bool for x in given[1:])
        waits = any(distant) and (masks or name in READS)
        if any(distant) and any(x.ndim and not there for x, there in zip(given, distant, strict=True)):
            raise FarError(f"{func} has tensors of two devices")
    if Far.ahead and waits:
        raise FarError(f"the host waits for {func}")
    here = {**kwargs, "device": "cpu"} if wanted is not None else kwargs
    here, there = tree_map(near, here), tree_map(near, args)
    found = func(*there, **here)
    if Far.graph is not None and (to_far or any(distant)):
        Far.graph.calls.append((lambda: func(*there, **here), found))
    if func._schema.is_mutable:
        return args[0] if name.endswith("_") and isinstance(found, Tensor) else kwargs.get("out", found)
    return tree_map(far, found) if to_far else found


class Graph:
    """Graph in the manner of CUDA: the operations of a block, repeated on the same memory."""

    def __init__(self) -> None:
        self.calls: list[tuple[Callable[[], object], object]] = []

    @contextmanager
    def capture(self) -> Iterator[None]:
        """Block whose operations are captured; the host does not ask for a number in it."""
        Far.graph = self
        with ahead():
            yield
        Far.graph = None

    def replay(self) -> None:
        """The operations once more, from the numbers that are in memory now."""
        for call_again, before in self.calls:
            after = call_again()
            for old, new in zip(tree_flatten(before)[0], tree_flatten(after)[0], strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.detach().copy_(new)


class FarBackend(Cuda):
    """Backend of the far device: kernels of GPUs, compiled for the host."""

    name = "far"

    def refusal(self, device):
        return None if device.type == FAR.type else torchdq.ArgumentError(f"not on {device}")

    def kernel(self, program, dtype, device):
        kernel = HOST.kernel(program, dtype, torch.device("cpu"))

        def run(inputs, samples):
            if not all(isinstance(x, FarTensor) for x in inputs):
                raise FarError(f"{program.name} takes a tensor of the CPU")
            given = [x.near for x in inputs]
            found = kernel(given, samples)
            if Far.graph is not None:
                Far.graph.calls.append((lambda: kernel(given, samples), found))
            return [far(y) for y in found]

        return run


choice.BACKENDS["host"] = (HOST,)
choice.BACKENDS["auto"] = (*choice.BACKENDS["auto"][:1], FarBackend(), *choice.BACKENDS["auto"][2:])
call.dispatching = lambda: False  # the mode is part of the device, and no trace
transforms.captured = lambda x: isinstance(x, FarTensor) and Far.graph is not None


@contextmanager
def ahead() -> Iterator[None]:
    """Block in which the host asks the far device for nothing."""
    Far.ahead = True
    try:
        yield
    finally:
        Far.ahead = False


# --- claims ----------------------------------------------------------------------------------------------------------

ROBOT = torchdq.robots.load("two_link")
PARTS = (*default_effects(ROBOT), effects.Noise(0.01, 0.01), effects.CommandDelay(2))
N = 7


def environment(**options):
    """Environments that never look at the numbers of actions."""
    envs = RobotVectorEnv(N, **grouped(**options))
    envs._host = Host(False)
    return envs


def outcomes(device, actions, mode="SameStep", between=lambda envs, found: None, **options):
    """All that an environment returns in some steps, and its state at the end, on the CPU; no step asks the device."""
    with torchdq.backend("auto" if device == FAR else "host"):
        small = {"robot": ROBOT, "effects": PARTS, "scale": 20.0, "max_episode_steps": 3, "autoreset_mode": mode}
        envs = environment(device=device, **{**small, **options})
        found = [envs.reset(seed=3)[0]]
        with ahead():
            found += [envs.reset()[0]]
            for action in actions:
                found += [envs.step(action)]
                between(envs, found[-1])
        return tree_flatten(tree_map(lambda x: x.cpu(), (found, envs.get_state())))[0]


def agree(found, expected):
    for f, e in zip(found, expected, strict=True):
        torch.testing.assert_close(f, e, rtol=0, atol=0, equal_nan=True)


def same_steps(**options):
    """Steps of the far device and of the CPU are the same, bit for bit."""
    actions = 1.5 * torch.randn(8, N, 2, generator=torch.Generator().manual_seed(0))
    agree(outcomes(FAR, list(actions.to(FAR).unbind()), **options), outcomes("cpu", list(actions.unbind()), **options))


def descend(module, rate):
    """Step of gradient descent; an optimiser of torch would import its compiler."""
    with torch.no_grad():
        for p in module.parameters():
            p -= rate * p.grad


def steps_with_resets_in_the_same_step():
    same_steps(randomise={"mass": 0.2, "friction": 0.3, "com": 0.01, "payload": 1.0, "delay": 1.5})


def steps_with_resets_in_the_next_step():
    same_steps(task="track", mode="NextStep", randomise={"gravity": (0.9, 1.1)})


def steps_with_masked_resets():
    def reset(envs, found):
        envs.reset(options={"reset_mask": found[2] | found[3]})

    same_steps(mode="Disabled", between=reset)


def steps_of_a_task_in_torch():
    def start(robot, u):
        return {"q": robot.limits.lower + 0.1 * u}

    def observation(now):
        tip = torchdq.forward_kinematics(now.robot, now.q_measured, now.robot.end_effector().name)
        return torch.cat([torchdq.dq.translation(tip), now.goal], 1)

    def reward(now):
        return -now.qd.square().sum(1)

    same_steps(task=TorchTask("reach", reward, observation, start=start, bounds=[(-9, 9)] * 6, draws=2))


def steps_with_tensors_that_were_given_on_the_cpu():
    controller = ComputedTorque(torch.full((2,), 50.0), torch.full((2,), 10.0))
    parts = (effects.Viscous(torch.ones(2)), effects.Payload(torch.tensor(0.5)))
    robot = ROBOT.replace(mass=ROBOT.mass.clone())
    same_steps(robot=robot, action="residual", controller=controller, effects=parts)


def a_step_is_repeated_by_a_graph():
    with torchdq.backend("auto"):
        options = {"task": "reach", "robot": ROBOT, "effects": PARTS, "scale": 9.0, "max_episode_steps": 3}
        envs, other = (environment(**options, device=FAR) for _ in "ab")
        for each in (envs, other):
            each.reset(seed=0)
        actions, graph = torch.zeros(N, 2, device=FAR), Graph()
        with graph.capture():
            observation, reward, *_ = envs.step(actions)
        envs.set_state(other.get_state())  # the capture of a real graph computes nothing
        for k in range(8):
            actions.copy_(torch.randn(N, 2, generator=torch.Generator().manual_seed(k)))
            graph.replay()
            expected = other.step(actions)
            agree([observation.cpu(), reward.cpu()], [x.cpu() for x in expected[:2]])
            if k == 4:
                for each in (envs, other):
                    each.reset()
        agree([x.cpu() for x in envs.get_state().values()], [x.cpu() for x in other.get_state().values()])


def a_rollout_is_repeated_by_a_graph():
    scene = Scene(ROBOT, (effects.Gravity(), effects.Viscous(1.0), effects.JointLimits(-2.0, 2.0)))
    policy = nn.Linear(4, 2, dtype=torch.float64).to(FAR)
    q, graph = torch.zeros(N, 2, dtype=torch.float64, device=FAR), Graph()

    def rollout():
        return scene.rollout(scene.start(q), steps=5, policy=lambda s, k: policy(torch.cat([s.q, s.qd], 1))).q

    with graph.capture(), torch.no_grad():
        found = rollout()
    q.copy_(torch.ones(N, 2, dtype=torch.float64))
    graph.replay()
    with torch.no_grad():
        agree([found.cpu()], [rollout().cpu()])


def a_training_iteration_is_repeated_by_a_graph():
    scene = Scene(ROBOT, (effects.Gravity(), effects.Viscous(1.0)))
    nets = []
    for _ in "ab":
        torch.manual_seed(0)
        nets.append(nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 2)).to(FAR))
    q = torch.randn(N, 2, generator=torch.Generator().manual_seed(1)).to(FAR)

    def iteration(net):
        net.zero_grad(set_to_none=False)
        states = scene.rollout(
            scene.start(q), steps=4, policy=lambda s, k: net(torch.cat([s.q, s.qd], 1)), nonfinite="ignore"
        )
        loss = states.q.square().mean()
        loss.backward()
        descend(net, 0.1)
        return loss.detach()

    for net in nets:
        iteration(net)
    graph = Graph()
    with graph.capture():
        found = iteration(nets[0])
    losses = [iteration(nets[1])]
    for _ in range(3):
        graph.replay()
        losses.append(iteration(nets[1]))
        agree([found.cpu()], [losses[-1].cpu()])
    assert losses[-1].cpu() < losses[0].cpu()


def a_learned_model_is_trained_without_waiting():
    layer = torchdq.DQRNEA(ROBOT, learn=("mass", "com", "inertia", "friction", "armature")).to(FAR)
    q, qd, qdd, tau = torch.randn(4, 50, 2, generator=torch.Generator().manual_seed(1)).to(FAR)
    for k in range(3):
        Far.ahead = k > 0
        layer.zero_grad()
        (layer(q, qd, qdd) - tau).square().mean().backward()
        descend(layer, 1e-3)
    Far.ahead = False


if __name__ == "__main__":
    torch.set_num_threads(1)
    for name in sys.argv[1:]:
        try:
            with Far(), warnings.catch_warnings(action="ignore"):
                globals()[name]()
            print(f"{name}: holds", flush=True)
        except Exception:
            Far.ahead, Far.graph = False, None
            print(f"{name}: fails\n{traceback.format_exc()}", flush=True)
    os._exit(0)  # torch's thread of the device would crash, now and then, as the interpreter ends under it
