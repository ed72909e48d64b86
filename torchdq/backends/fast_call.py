"""Calls of a compiled program in about a microsecond, for as many samples as one thread computes.

To check the tensors of a call one by one in Python takes longer than the program itself does for a few samples. Here a
function in C does what is left where nothing is to be decided: torch compares type, dtype, device, sizes and strides of
all tensors at once, as it does for its compiled graphs, results are allocated, and the program runs, without Python's
lock if that takes long. For any other call it returns None, and nothing has happened. It is compiled like a program,
and gets the functions of Python as addresses, so that it needs neither headers nor a library.

That comparison is private to torch (`transforms.alike`): where it is absent every call takes the common way, and a test
of `alike` pins what it means in the torch that is installed.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Hashable, Sequence
from functools import cache
from math import prod
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.compiler import is_dynamo_compiling

from torchdq.backends import c_library, choice, threads
from torchdq.backends.backend import Backend, Form, contiguous, largest_growth
from torchdq.backends.c import COMPILED, C, CompiledKernel
from torchdq.backends.compiler import BuildError
from torchdq.base.caches import LAYOUTS, PROGRAMS, Bounded, remembered
from torchdq.program.loop import Loop
from torchdq.program.program import Program
from torchdq.program.transforms import LEVEL, alike, empty_on_cpu, modes

MOST, FEW = 48, 64  # arrays of a program, and samples whose error growths need no memory
LONG = 50_000  # operations of a call from which Python's lock is let go: some ten microseconds
FASTCALL = 0x80  # flag of a function in C that takes an array of arguments and their number
# functions of Python, in the order of `Python` in C
PYTHON = (
    *("PyObject_Vectorcall", "PyObject_GetAttr", "PyContextVar_Get", "PyLong_AsVoidPtr", "PyTuple_New"),
    *("PyTuple_SetItem", "Py_IncRef", "Py_DecRef", "PyErr_Clear", "PyEval_SaveThread", "PyEval_RestoreThread"),
)

SOURCE = """
typedef struct Object Object;
typedef __INT64_TYPE__ word;
typedef struct {
  Object *(*call)(Object *, Object *const *, __SIZE_TYPE__, Object *), *(*attribute)(Object *, Object *);
  int (*context)(Object *, Object *, Object **);
  void *(*address)(Object *);
  Object *(*tuple)(word);
  int (*put)(Object *, word, Object *);
  void (*hold)(Object *), (*drop)(Object *), (*forgive)(void);
  void *(*unlock)(void);
  void (*lock)(void *);
  Object *none, *yes;
} Python;
typedef struct {
  Object *fits, *empty, *pointer, *forward, *level, *modes, *chosen, *automatic;
  Object *const *forms;  // size, strides and dtype of every result
  const word *bytes;     // of every array
  void (*run)(void);
  const void *plan;
  const word *starts;  // of states of which a loop keeps the start: argument, result, bytes
  double limit;
  word samples, inputs, results, given, unlocked, growth;  // given: results, too; growth: bytes of the error growth
  word arguments, present;  // number of them, some of which may be None, and a bit for each of the others
  word states;
} Call;
static const Python *py;

static Object *nothing(Object *found) {
  if (found) py->drop(found);
  py->forgive();
  py->hold(py->none);
  return py->none;
}

static int is(Object *found, void *value) {  // whether a number that was returned has a value
  int same = found && py->address(found) == value;
  if (found) py->drop(found);
  return same;
}

static int plain(const Call *c) {  // no backend is chosen, and no dispatch or forward mode; other transforms do not fit
  Object *now = 0;
  if (py->context(c->chosen, 0, &now) < 0 || !now) return 0;
  py->drop(now);
  int automatic = now == c->automatic && is(py->call(c->modes, 0, 0, 0), 0);
  return automatic && is(py->attribute(c->forward, c->level), (void *)(word)-1);
}

static int overlapping(const Call *c, char **p, word count) {
  for (word k = c->inputs; k < count; k++)
    for (word i = 0; i < k; i++)
      if (p[i] < p[k] + c->bytes[k] && p[k] < p[i] + c->bytes[i]) return 1;
  return 0;
}

static void start(const Call *c, char **p, word count) {
  switch (count) {
CASES
  }
}

static void begin(const Call *c, char **p) {  // the start of states, behind which a loop writes the others
  for (const word *s = c->starts; s < c->starts + 3 * c->states; s += 3) {
    char **to = p + c->inputs + s[1];
    for (word k = 0; k < s[2]; k++) *(*to)++ = p[s[0]][k];
  }
}

static int limited(const Call *c, const void *growth) {  // whether no sample's errors grow more than the limit
  const float *single = growth;
  const double *dual = growth;
  for (word k = 0; k < c->samples; k++)
    if (!((c->growth == 4 ? single[k] : dual[k]) <= c->limit)) return 0;
  return 1;
}

Object *run(Object *self, Object *const *all, word count) {
  if (count < 0) {  // before all calls, with the functions of Python
    py = (const Python *)self;
    return 0;
  }
  const Call *c = py->address(self);
  if (count != c->arguments) return nothing(0);
  word arrays = c->inputs + c->results;
  Object *args[MOST];
  count = 0;
  for (word k = 0; k < c->arguments; k++)
    if (all[k] != py->none) {
      if (!(c->present >> k & 1)) return nothing(0);
      args[count++] = all[k];
    }
  if (count != (c->given ? arrays : c->inputs) || !plain(c)) return nothing(0);
  Object *fits = py->call(c->fits, args, count, 0);
  if (fits != py->yes) return nothing(fits);
  py->drop(fits);
  Object *found = py->tuple(c->results);
  char *p[MOST + 1];
  for (word k = 0; k < arrays; k++) {
    word r = k - c->inputs;
    Object *x = k < count ? args[k] : py->call(c->empty, c->forms + 3 * r, 3, 0);
    if (!x || !found) return nothing(found);
    if (r >= 0) {
      if (k < count) py->hold(x);
      py->put(found, r, x);
    }
    Object *at = py->call(c->pointer, &x, 1, 0);
    if (!at) return nothing(found);
    p[k] = py->address(at);
    py->drop(at);
  }
  if (c->given && overlapping(c, p, arrays)) return nothing(found);
  double few[FEW];
  Object *many = 0;
  if (c->growth && c->samples > FEW) {
    many = py->call(c->empty, c->forms + 3 * c->results, 3, 0);
    Object *at = many ? py->call(c->pointer, &many, 1, 0) : 0;
    if (!at) return nothing(found);
    p[arrays++] = py->address(at);
    py->drop(at);
  } else if (c->growth) {
    p[arrays++] = (char *)few;
  }
  begin(c, p);
  void *lock = c->unlocked ? py->unlock() : 0;
  start(c, p, arrays);
  if (c->unlocked) py->lock(lock);
  int within = !c->growth || limited(c, p[arrays - 1]);
  if (many) py->drop(many);
  return within ? found : nothing(found);
}
"""


class Python(ctypes.Structure):
    """Functions and values of Python, as `Python` in C."""

    _fields_ = [(name, ctypes.c_void_p) for name in (*PYTHON, "none", "yes")]


OBJECTS = ("fits", "empty", "pointer", "forward", "level", "modes", "chosen", "automatic")
WORDS = ("samples", "inputs", "results", "given", "unlocked", "growth", "arguments", "present", "states")


class Call(ctypes.Structure):
    """Facts about a call, as `Call` in C."""

    _fields_ = [
        *((name, ctypes.py_object) for name in OBJECTS),
        *((name, ctypes.c_void_p) for name in ("forms", "bytes", "run", "plan", "starts")),
        ("limit", ctypes.c_double),
        *((name, ctypes.c_int64) for name in WORDS),
    ]


class Method(ctypes.Structure):
    """Python's description of a function in C."""

    _fields_ = [
        ("name", ctypes.c_char_p),
        ("function", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    ]


class FastCall(NamedTuple):
    """Function of the arguments of a call, which returns a tuple of results, or None: take the common way."""

    function: Callable[..., tuple[Tensor, ...] | None]
    names: tuple[str, ...]  # of the results


FAST: Bounded[Hashable, tuple[FastCall, ...]] = Bounded(
    LAYOUTS
)  # by key of `quick`, the last one that was learned first
SHAPES = 8  # fast calls of a key


def quick(
    key: Hashable, given: Collection[Any], out: Sequence[Any] = ()
) -> tuple[Hashable, tuple[str, ...], tuple[Tensor, ...] | None]:
    """Key of a call, None in a traced graph, and names and values of its results; None: it takes the common way.

    Args:
        key: all that tells programs apart for tensors of one form, and whether there are tensors for the results.
        given: its arguments, tensors or None.
        out: tensors for the results; (): new ones. Where errors grow too much, they have been written to.
    """
    if is_dynamo_compiling():  # tensors of other traces are none of these forms
        return None, (), None
    for function, names in FAST.get(key, ()):
        found = function(*given, *out)
        if found is not None:
            return key, names, found
    return key, (), None


class Forms(NamedTuple):
    """Forms of the tensors of a call, of every sample or uniform."""

    inputs: tuple[Form, ...]
    results: tuple[Form, ...]
    names: tuple[str, ...]  # of the results
    samples: int
    steps: int = 1
    out: bool = False  # whether tensors for the results are given; where errors grow too much they have been written to
    absent: tuple[bool, ...] = ()  # whether each argument is None; (): none of them
    learned: tuple[bool, ...] = ()  # whether each input requires grad; (): none of them

    @classmethod
    def of(
        cls,
        given: Collection[Tensor | None],
        results: Sequence[tuple[int, ...]],
        dtype: torch.dtype,
        *others: Any,
        learned: bool = False,
    ) -> Forms:
        """Forms of arguments, and of results of these shapes; the others are the fields from `names` to `out`.

        With `learned` inputs may require grad: for calls where torch records nothing.
        """
        inputs, absent = [x for x in given if x is not None], tuple([x is None for x in given])
        shapes = tuple([contiguous(tuple(shape), dtype) for shape in results])
        grads = tuple([x.requires_grad for x in inputs]) if learned else ()
        return cls(tuple(map(_form, inputs)), shapes, *others)._replace(absent=absent, learned=grads)


def learn(
    key: Hashable, backend: Backend, what: Program | Loop, samples: int, steps: int, of: Callable[[], Forms]
) -> None:
    """Let calls with a key of `quick` be fast for tensors of some forms, if they can be.

    The program, or that of the loop, has no sums over the samples.
    """
    if key is not None and isinstance(backend, C) and 0 < samples < most(what, steps):
        keep(key, fast_call(what, of()))


def _form(x: Tensor) -> Form:
    """Form of a tensor, or that of a contiguous one; an axis of one number may have any stride."""
    shape = tuple(x.shape)
    return (shape, tuple(x.stride()), x.dtype) if x.is_contiguous() else contiguous(shape, x.dtype)


def keep(key: Hashable, fast: FastCall | None, last: bool = False) -> None:
    """Let `quick` try a fast call before those of its key that it knows, or as the last one."""
    known = FAST.get(key, ())
    if fast is not None and fast not in known:
        known = known[: SHAPES - 1]
        FAST[key] = (*known, fast) if last else (fast, *known)


@remembered(PROGRAMS)
def most(what: Program | Loop, steps: int) -> int:
    """Number of samples from which threads may share them."""
    body = what.body if isinstance(what, Loop) else what
    return 2 * threads.least(body.count().total * steps)


@remembered(LAYOUTS)
def fast_call(what: Program | Loop, forms: Forms) -> FastCall | None:
    """Fast call for tensors of these forms; None: there is none here."""
    inputs, results, names, samples, steps, out, absent, learned = forms
    dtype, cpu = results[0][2], torch.device("cpu")
    arrays, absent = (*inputs, *results), (absent or (False,) * len(inputs)) + (False,) * (len(results) * out)
    if max(len(arrays), len(absent)) >= MOST or COMPILED.refusal(cpu) is not None:
        return None
    try:
        made = COMPILED.loop(what, dtype, cpu, samples) if isinstance(what, Loop) else COMPILED.kernel(what, dtype, cpu)
        kernel = cast(CompiledKernel, made)
        start, library = _started()
    except (BuildError, AttributeError):  # the latter in a Python without these functions
        return None
    if isinstance(what, Loop) and what.backwards and kernel.states:  # of which the start is the last
        return None
    numbers: list[Any] = [x for form in (*results, contiguous((samples,), dtype)) for x in form]
    objects = (ctypes.py_object * len(numbers))(*numbers)
    plan, states = kernel.plan(samples, steps), kernel.starts(samples)
    starts = (ctypes.c_int64 * (3 * len(states)))(*[x for state in states for x in state])
    sizes = (ctypes.c_int64 * len(arrays))(*[prod(shape) * dtype.itemsize for shape, _, _ in arrays])
    call = Call(
        alike(arrays if out else inputs, learned),
        *(empty_on_cpu, torch.Tensor.data_ptr, *LEVEL, modes, choice._chosen, "auto"),
        *(ctypes.addressof(objects), ctypes.addressof(sizes), _address(kernel.compiled.run)),
        *(None if plan is None else ctypes.addressof(plan), ctypes.addressof(starts)),
        largest_growth(dtype),
        *(samples, len(inputs), len(results), out, samples * steps * kernel.operations > LONG),
        dtype.itemsize * kernel.grows,
        *(len(absent), sum((not x) << k for k, x in enumerate(absent)), len(states)),
    )
    method = Method(what.name.encode(), start, FASTCALL, None)
    make = ctypes.pythonapi.PyCFunction_NewEx
    make.restype, make.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.py_object, ctypes.py_object)
    kept = (
        call,
        method,
        objects,
        sizes,
        plan,
        starts,
        kernel,
        library,
    )  # what it points to lives as its module, as long as it does
    return FastCall(make(ctypes.addressof(method), ctypes.addressof(call), kept), names)


def source() -> str:
    """Source of the function in C."""
    arrays = (", ".join(f"p[{k}]" for k in range(n)) for n in range(1, MOST + 1))
    cases = [
        f"    case {n}: ((void (*)(word, const void *{', char *' * n}))c->run)(c->samples, c->plan, {given}); break;"
        for n, given in enumerate(arrays, 1)
    ]
    return SOURCE.replace("CASES", "\n".join(cases)).replace("MOST", str(MOST)).replace("FEW", str(FEW))


@remembered(1)
def _started() -> tuple[int, Any]:
    """Address of the function in C, and its library."""
    library = c_library.load(source(), "call", 1)
    address = _address(library.run)
    begin = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(address)
    begin(ctypes.addressof(_python()), None, -1)
    return address, library


@cache
def _python() -> Python:
    """Functions of Python."""
    return Python(*[_address(getattr(ctypes.pythonapi, name)) for name in PYTHON], id(None), id(True))


def _address(function: Any) -> int:
    found: Any = ctypes.cast(function, ctypes.c_void_p).value
    return int(found)
