"""Calls of `torchdq.compile` objects: results in given memory, arrays of NumPy, one sample without detours."""

import copy
import itertools
import math
import pickle
import sys
import weakref

import messages
import numpy as np
import pytest
import torch
from helpers import thinned
from loops import parts, step, tensors

import torchdq
from torchdq.backends.backend import contiguous
from torchdq.backends.c import COMPILED
from torchdq.backends.cuda import CUDA
from torchdq.backends.fast_call import FAST, Forms, fast_call, learn, quick
from torchdq.backends.loop_call import repeat
from torchdq.backends.torch import EAGER
from torchdq.errors import ArgumentError, DtypeError
from torchdq.functions.compile import RecordedComputation
from torchdq.program.transforms import load_forward_mode

BACKEND = "auto"
F64 = torch.float64
TWO = ("inverse_dynamics", "forward_dynamics", "closed_form")


def compiled(function="inverse_dynamics", dtype="float64", robot="panda"):
    return torchdq.compile(torchdq.robots.load(robot), function, dtype)


def rows(program, *batch, dtype=F64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(*batch, a.width, generator=generator, dtype=F64).to(dtype) for a in program.program.arguments]


def fast(program, *batch, out=False):
    """Fast call of a program with rows of a batch."""
    recorded = program.program
    inputs = tuple([contiguous((*batch, a.width), program.dtype) for a in recorded.arguments])
    results = tuple([contiguous((*batch, len(r.values)), program.dtype) for r in recorded.results])
    names = tuple([r.name for r in recorded.results])
    return fast_call(recorded, Forms(inputs, results, names, math.prod(batch), out=out)).function


def listed(found):
    return [found] if isinstance(found, torch.Tensor | np.ndarray) else list(found)


@pytest.mark.parametrize("dtype", thinned(["float64", "float32"], ("float32",)))
@pytest.mark.parametrize("function", TWO)
def test_results_in_given_memory_are_those_of_the_function(function, dtype):
    call, tolerance = compiled(function, dtype), 2e-4 if dtype == "float32" else 1e-12
    for batch in ((), (1,), (5,), (2, 3), (200,)):
        inputs = rows(call, *batch, dtype=call.dtype)
        with torchdq.backend("eager"):
            expected = listed(call(*inputs))
        room = [torch.full_like(y, torch.nan) for y in expected]
        found = call(*inputs, out=room if len(room) > 1 else room[0])
        assert all(a is b for a, b in zip(listed(found), room, strict=True))
        for y, e, new in zip(room, expected, listed(call(*inputs)), strict=True):
            torch.testing.assert_close(y, e, rtol=tolerance, atol=tolerance * float(e.abs().max()))
            assert torch.equal(y, new)


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("function", TWO)
def test_arrays_of_numpy_give_arrays_and_may_be_the_memory(function, batch):
    call = compiled(function)
    inputs = rows(call, *batch)
    expected = listed(call(*inputs))
    arrays = [x.numpy() for x in inputs]
    for y, e in zip(listed(call(*arrays)), expected, strict=True):
        assert isinstance(y, np.ndarray) and np.array_equal(y, e.numpy())
    room = [np.empty_like(e.numpy()) for e in expected]
    call(*arrays, out=room if len(room) > 1 else room[0])
    assert all(np.array_equal(y, e.numpy()) for y, e in zip(room, expected, strict=True))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("batch", [(), (3,)])
def test_arrays_that_torch_cannot_share_are_read(batch, tmp_path):
    call = compiled()
    q, qd, qdd = (x.numpy() for x in rows(call, *batch))
    expected = call(q, qd, qdd)
    np.save(tmp_path / "q.npy", q)
    mapped = np.load(tmp_path / "q.npy", mmap_mode="r")
    assert np.array_equal(call(mapped, qd[..., ::-1].copy()[..., ::-1], qdd), expected)
    assert np.array_equal(call(mapped, qd, qdd, out=np.empty_like(q)), expected)


def other_arrays(x):
    """Arrays of the shape of one, of numbers that are not those of the program."""
    return x.astype(">f8"), x.astype(np.float32), x.astype(int), x.astype(object), np.ma.masked_array(x, mask=x > 0.5)


def wrong_arguments(q, qd, qdd):
    """Arguments in place of three right ones, as tensors or as arrays."""
    others = [torch.from_numpy(qd), *other_arrays(q)] if isinstance(q, np.ndarray) else []
    return (q, qd), (q, qd, qdd, q), *((q, other, qdd) for other in others)


@pytest.mark.parametrize("given", ["tensors", "arrays"])
@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("room", [False, True])
def test_wrong_arguments_are_refused(given, batch, room):
    call = compiled()
    right = [*rows(call, *batch), torch.empty(*batch, 7, dtype=F64)]
    *right, own = [x.numpy() for x in right] if given == "arrays" else right
    for wrong in wrong_arguments(*right):
        with messages.refused(ArgumentError):
            call(*wrong, **({"out": own} if room else {}))


def test_rows_whose_errors_grow_too_much_are_recomputed_into_the_given_memory():
    robot = torchdq.robots.load("two_link")
    # a straight arm of which only the end has mass hardly resists in one direction
    values = {"q": [0.1, 1e-3], "qd": [0.3, -0.1], "tau": [1.0, 0.5], "mass": [1e-6, 1.0], "inertia": [0.0] * 12}
    call = torchdq.compile(robot.replace(mass=robot.mass, inertia=robot.inertia), "forward_dynamics", "float32")
    inputs = [torch.tensor(values[a.name]) for a in call.program.arguments]
    assert fast(call)(*inputs) is None and fast(call, 2)(*[torch.stack([x, x]) for x in inputs]) is None
    wide = torchdq.compile(robot.replace(mass=robot.mass, inertia=robot.inertia), "forward_dynamics")
    room = torch.empty(2)
    assert call(*inputs, out=room) is room
    torch.testing.assert_close(room, wide(*[x.double() for x in inputs]).float(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_a_fast_call_takes_no_detour_unless_torch_or_the_user_asks_for_one(batch):
    call = compiled()
    inputs, room = rows(call, *batch), torch.empty(*batch, 7, dtype=F64)
    single = fast(call, *batch)
    (found,), (given,) = single(*inputs), fast(call, *batch, out=True)(*inputs, room)
    with torchdq.backend("c"):
        assert single(*inputs) is None and torch.equal(found, call(*inputs))
    assert given is room and torch.equal(found, room) and single(None, *inputs, None) is None
    refused = {
        "a batch": [x[None] for x in inputs],
        "another dtype": [x.float() for x in inputs],
        "gradients": [inputs[0].clone().requires_grad_(), *inputs[1:]],
        "gaps": [torch.rand(*batch, 14, dtype=F64)[..., ::2], *inputs[1:]],
        "one tensor twice": [inputs[0], inputs[0], inputs[2]],
        "a negative view": [torch._neg_view(inputs[0]), *inputs[1:]],
        "too few": inputs[:2],
        "none": [],
        "far too many": [*inputs] * 20,
        "no tensor": [[0.0] * 7, *inputs[1:]],
    }
    for why, rows_ in refused.items():
        assert single(*rows_) is None, why
    with torchdq.backend("eager"):
        assert single(*inputs) is None
    seen = []
    torch.func.vmap(lambda q: (seen.append(single(q, *inputs[1:])), q)[1])(torch.rand(2, *batch, 7, dtype=F64))
    load_forward_mode()
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(inputs[0], inputs[1])
        seen.append(single(dual, *inputs[1:]))
    assert seen == [None, None]


def test_fast_calls_hold_no_reference_longer_than_they_last():
    """Whether they take place or not; in Pythons whose None and True are counted, of them, too."""
    call = compiled("closed_form", robot="two_link")
    inputs = rows(call, 3)
    single, room = fast(call, 3), [torch.empty_like(y) for y in call(*inputs)]
    given = fast(call, 3, out=True)
    watched = (*inputs, *room, None, True, False, 0, "auto")
    before = [sys.getrefcount(x) for x in watched]
    for _ in range(1000):
        single(*inputs), single(*inputs[1:]), single(inputs), given(*inputs, *room), given(*inputs, *room[:-1], room[0])
    after = [sys.getrefcount(x) for x in watched]
    assert all(abs(b - a) < 100 for a, b in zip(before, after, strict=True))
    freed = weakref.ref(single(*inputs)[0])
    assert freed() is None


def test_calls_of_other_backends_stay_with_them():
    """Programs of a GPU are not compiled for the CPU, nor run there."""
    call, keys = compiled(robot="two_link"), ("C", "eager", "cuda")
    for key, backend in zip(keys, (COMPILED, EAGER, CUDA), strict=True):
        forms = Forms.of(list(torch.rand(3, 2, dtype=F64)), [(2,)], F64, ("tau",), 1)
        learn(key, backend, call.program, 1, 1, lambda forms=forms: forms)
    assert [key in FAST for key in keys] == [True, False, False]


@pytest.mark.parametrize("learns", [False, True])
def test_absent_arguments_are_told_apart(learns):
    """Calls of one function with other tensors, which have the same shapes, one after the other."""
    robot = torchdq.robots.load("two_link")
    q, qd, qdd = torch.rand(3, 5, 2, dtype=F64).requires_grad_(learns).unbind()
    at_rest, still = (torchdq.inverse_dynamics(robot, *x, backend="eager") for x in ((q, None, qdd), (q, qd, None)))
    for _ in range(3):
        torch.testing.assert_close(torchdq.inverse_dynamics(robot, q, None, qdd), at_rest)
        torch.testing.assert_close(torchdq.inverse_dynamics(robot, q, qd), still)
        torch.testing.assert_close(torchdq.inverse_dynamics(robot, q[:1], None, qdd[:1]), at_rest[:1])


def test_an_axis_of_one_number_may_have_any_stride():
    call = compiled(robot="two_link")
    inputs = [torch.rand(2, dtype=F64).as_strided((1, 2), (stride, 1)) for stride in (0, 1, 7)]
    found = [call(*inputs) for _ in range(2)]
    assert torch.equal(*found) and quick((call.program, F64, 0), inputs)[2] is not None


@pytest.mark.parametrize("function", TWO)
def test_calls_of_any_form_are_fast_from_the_second_on(function):
    """Functions, compiled objects and modules."""
    robot = torchdq.robots.load("panda")
    for batch in ((), (5,), (2, 3), (300,)):
        call = compiled(function)
        inputs = rows(call, *batch)
        expected = listed(call(*inputs))
        names = [a.name for a in call.program.arguments]
        for found in (call(*inputs), getattr(torchdq, function)(robot, **dict(zip(names, inputs, strict=True)))):
            assert all(torch.equal(x.reshape(y.shape), y) for x, y in zip(listed(found), expected, strict=True))
        _, results, found = quick((call.program, F64, 0), inputs)
        assert results == tuple(r.name for r in call.program.results)
        assert all(torch.equal(x, y) for x, y in zip(found, expected, strict=True))


@pytest.mark.parametrize("growth", [False, True])
@pytest.mark.parametrize("samples", [1, 5])
def test_loops_are_fast_from_the_second_call_on(samples, growth):
    """With the states of every step and the start before them; where errors grow too much all is as it was."""
    program, given, steps = step(growth=growth), tensors(samples, 4, dtype=torch.float32), range(4)
    carried, stepped, fixed = parts(given)
    stepped |= {} if not growth else {"u": 1e-3 * stepped["u"]}
    what, found = RecordedComputation(program), []
    for kept in ({"ends": True}, {"total": ("z",)}):
        calls = [repeat(what, len(steps), carried, stepped, fixed, **kept) for _ in range(3)]
        with torchdq.backend("c"):
            calls.append(repeat(what, len(steps), carried, stepped, fixed, **kept))
        assert all(torch.equal(x[name], calls[0][name]) for x in calls for name in x)
        found += [calls[0]["x"]]
    assert torch.equal(found[0], found[1][-1]) and torch.equal(found[1][0], given["x"])
    known = [fast for key, fast in FAST.items() if key[0] == what]
    assert len(known) == 2


@pytest.mark.parametrize("function", ["inverse_dynamics", "mass_matrix"])
def test_graphs_of_fast_calls_are_those_of_the_common_way(function):
    """Values and gradients, whichever arguments need one, again and again, and where no row has a batch axis."""
    robot, call = torchdq.robots.load("two_link"), getattr(torchdq, function)
    wanted = [(True,)] if function == "mass_matrix" else [(True, True, True), (False, True, False), (True, False, True)]

    def slopes(x):
        y = call(robot, *x)
        return (y, *torch.autograd.grad((y * y.detach().cos()).sum(), [a for a in x if a.requires_grad]))

    for batch, needed in itertools.product(((3, 2), (2, 3, 2), (2,)), wanted):
        x = [torch.rand(*batch, dtype=F64).requires_grad_(n) for n in needed]
        calls = [slopes(x) for _ in range(3)]
        with torchdq.backend("c"):
            calls.append(slopes(x))
        assert all(torch.equal(a, b) for found in calls for a, b in zip(found, calls[-1], strict=True))
        with torch.no_grad():
            assert not call(robot, *x).requires_grad


@pytest.mark.parametrize("batch", [(), (4,)])
def test_gradients_pass_and_are_refused_with_given_memory(batch):
    call = compiled()
    q, qd, qdd = rows(call, *batch)
    q.requires_grad_()
    call(q, qd, qdd).sum().backward()
    assert q.grad is not None and q.grad.shape == q.shape
    with messages.refused(ArgumentError):
        call(q, qd, qdd, out=torch.empty_like(qd))
    with torch.no_grad():
        assert torch.equal(call(q, qd, qdd, out=torch.empty_like(qd)), call(q.detach(), qd, qdd))


@pytest.mark.parametrize("batch", [(), (4,)])
def test_memory_that_cannot_be_written_to_is_refused_with_the_reason(batch):
    call, closed = compiled(), compiled("closed_form", robot="two_link")
    inputs, at = rows(call, *batch), rows(closed, *batch)
    own, (M, c, g, Jt) = torch.zeros(*batch, 7, dtype=F64), (torch.empty_like(y) for y in closed(*at))
    whole = torch.zeros(4, 10, dtype=F64)
    overlapping, read_only = [whole[..., :7]] * 3, own.numpy().copy()
    read_only.flags.writeable = False
    arrays = [x.numpy() for x in inputs]
    call(*inputs, out=own), closed(*at, out=[M, c, g, Jt])  # after which calls are fast
    for function, given, room in (
        (call, inputs, inputs[2]),
        (call, inputs, inputs[2][:]),
        (call, inputs, own.new_empty(*batch, 14)[..., ::2]),
        (call, inputs, own.new_empty(*batch, 6)),
        (call, inputs, torch._neg_view(own)),
        (call, inputs, torch._efficientzerotensor(own.shape, dtype=F64)),
        (call, inputs, own.float()),
        (call, inputs, "tau"),
        (call, inputs, [own, own.clone()]),
        (call, inputs, own.clone().requires_grad_()),
        (call, overlapping, whole.view(-1)[5:33].view(4, 7)),
        *((call, arrays, room) for room in (*other_arrays(own.numpy()), own.numpy()[..., ::-1], read_only)),
        (closed, at, [M, c, c, Jt]),
        (closed, at, [M.view(*batch, 2, 2), c, g, Jt]),
    ):
        with messages.refused((ArgumentError, DtypeError)):
            function(*given, out=room)
    both = torch.empty(40, dtype=F64)
    assert call(both[:7], both[7:14], both[14:21], out=both[21:28]).data_ptr() == both[21:].data_ptr()


def test_a_compiled_program_in_a_traced_graph_takes_no_memory():
    call = compiled(robot="two_link")
    inputs = rows(call, 3)
    traced = torch.compile(lambda q, qd, qdd: call(q, qd, qdd), backend="eager", fullgraph=True)
    torch.testing.assert_close(traced(*inputs), call(*inputs))


def test_compiled_programs_are_copied_and_pickled():
    call = compiled(robot="two_link")
    inputs = rows(call)
    for other in (copy.deepcopy(call), pickle.loads(pickle.dumps(call))):
        assert torch.equal(other(*inputs), call(*inputs))
