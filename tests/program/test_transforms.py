"""Meanings of torch's private symbols, in the torch that is installed: results would be wrong if one had another."""

from contextlib import suppress

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._python_dispatch import TorchDispatchMode

import torchdq
from torchdq.program import transforms
from torchdq.program.transforms import alike, any_requires_grad, empty_on_cpu, number

BACKEND = "auto"  # see conftest.py
F64 = torch.float64
ROW = ((3,), (1,), F64)


def rows():
    return torch.zeros(3, dtype=F64), torch.ones(3, dtype=F64)


UNLIKE = {
    "another dtype": lambda a: a.float(),
    "another size": lambda a: torch.zeros(4, dtype=F64),
    "another number of axes": lambda a: a[None],
    "other strides": lambda a: torch.zeros(6, dtype=F64)[::2],
    "another device": lambda a: a.to("meta"),
    "a tensor that requires grad": lambda a: a.requires_grad_(),
    "a parameter": lambda a: torch.nn.Parameter(a),
    "a view that is negated later": lambda a: torch.complex(a, a).conj().imag,
    "a sparse tensor": lambda a: a.to_sparse(),
}


def test_plain_tensors_of_the_forms_are_alike_and_no_others():
    fits, (a, b) = alike([ROW, ROW]), rows()
    assert fits(a, b) and fits(torch.arange(6, dtype=F64)[3:], b)
    for name, make in UNLIKE.items():
        assert not fits(make(rows()[0]), b), name
    assert not fits(a, a)
    for other in ((a,), (a, b, b.clone()), (a, [0.0, 0.0, 0.0])):
        with suppress(TypeError):  # torch says so in this way
            assert not fits(*other)


def test_nothing_is_alike_inside_of_transforms_and_modes_that_say_so():
    fits, (a, b) = alike([ROW, ROW]), rows()
    seen = []
    torch.func.vmap(lambda x: seen.append(fits(x, b)) or x)(torch.zeros(2, 3, dtype=F64))
    torch.func.grad(lambda x: seen.append(fits(x, b)) or x.sum())(a)
    with torch.inference_mode():
        seen.append(fits(torch.zeros(3, dtype=F64), b))
    with TorchDispatchMode():
        seen.append(fits(a, b))
    assert seen == [False] * 4


def test_transforms_and_modes_are_seen():
    a, _ = rows()
    states = []

    def look(x):
        states.append((transforms.transforming(), transforms.reversing()))
        return x.sum()

    look(a)
    torch.func.grad(look)(a)
    torch.func.vmap(look)(a[None])
    with forward_ad.dual_level():
        look(a)
    assert states == [(False, False), (True, True), (True, False), (True, False)]
    assert not transforms.dispatching() and not transforms.jit_tracing() and not transforms.proxy_tracing()
    traced = []
    torch.jit.trace(lambda x: traced.append(transforms.jit_tracing()) or x + 1, a, check_trace=False)
    make_fx(lambda x: traced.append(transforms.proxy_tracing() and transforms.dispatching()) or x + 1)(a)
    assert traced == [True, True]


def test_a_fast_call_that_is_traced_is_no_constant():
    """make_fx has plain tensors, which are alike; that it is at work is seen apart from them."""
    compiled = torchdq.compile(torchdq.robots.load("two_link"), "inverse_dynamics")
    q, qd, qdd = (torch.full((2,), x, dtype=F64) for x in (0.3, 1.0, 2.0))
    compiled(q, qd, qdd)
    graph = make_fx(compiled)(q, qd, qdd)
    torch.testing.assert_close(graph(2 * q, qd, qdd), compiled(2 * q, qd, qdd))
    with pytest.raises(torchdq.ArgumentError, match="cannot record"):
        torch.jit.trace(lambda *x: compiled(*x), (q, qd, qdd))


def test_the_quick_ways_do_what_the_public_ones_do():
    a, b = rows()
    made = empty_on_cpu((2, 3), (3, 1), torch.float32)
    assert (made.shape, made.stride(), made.dtype, made.device.type) == ((2, 3), (3, 1), torch.float32, "cpu")
    assert not any_requires_grad(a, b) and any_requires_grad(a, b.requires_grad_())
    assert number(2.0, a) == 2.0


def test_values_are_plain_in_spite_of_transforms_and_modes():
    found = []

    def make(x):
        with transforms.with_values():
            found.append(torch.ones(2, dtype=F64).tolist())
        return x.sum()

    torch.func.grad(make)(rows()[0])
    with FakeTensorMode():
        make(rows()[0])
    assert found == [[1.0, 1.0]] * 2
