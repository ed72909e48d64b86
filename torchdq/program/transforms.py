"""State of torch's transforms, which torch has no public functions for: all of its private symbols are used here.

They exist in torch 2.6 to 2.13. Where one is missing, a transform is taken to be active, which costs time and changes
no result. Of one that torch keeps and gives another meaning results could be wrong, so tests pin the meaning of each
that decides whether a compiled program may run: `alike` above all.
"""

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache, wraps
from operator import attrgetter
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch._C import _functorch
from torch._functorch import pyfunctorch
from torch.autograd import forward_ad
from torch.utils import _python_dispatch

Made = TypeVar("Made", bound=Callable[..., Any])


def _private(name: str, missing: Any) -> Any:
    try:
        return attrgetter(name)(torch._C)
    except AttributeError:
        return missing


# whether a transform of `torch.func` is active
functional: Callable[[], bool] = _private("_are_functorch_transforms_active", lambda: True)
# whether one of the tensors requires grad, in half of the time that asking each of them takes
any_requires_grad: Callable[..., bool] = _private(
    "_any_requires_grad", lambda *tensors: any([x.requires_grad for x in tensors])
)
# number of modes that see the operators that tensors go through
modes: Callable[[], int] = _private("_len_torch_dispatch_stack", lambda: 1)
# tensor on the CPU without values, of a size, strides and a dtype, in half of the time that `torch.empty_like` takes
empty_on_cpu: Callable[..., Tensor] = _private(
    "_dynamo.guards._empty_strided_cpu",
    lambda size, strides, dtype: torch.empty_strided(size, strides, dtype=dtype, device="cpu"),
)
# `autograd.Function` that knows of no transform
SingleLevelFunction: Any = getattr(torch.autograd.function, "_SingleLevelFunction", torch.autograd.Function)
_guards = _private("_dynamo.guards.TensorGuards", None)
_levels: Callable[[], list[Any]] = getattr(pyfunctorch, "retrieve_all_functorch_interpreters", lambda: [])
_unseen = _private("DisableTorchFunction", nullcontext)
_jit_state = _private("_get_tracing_state", lambda: None)
_batched_by_autograd = _private("_functorch.is_legacy_batchedtensor", lambda x: False)


LEVEL = (forward_ad, "_current_level")  # module and name of a number that is -1 outside of forward mode


def constant_in_graphs(function: Made) -> Made:
    """Function whose result torch.compile keeps as a constant of the graph, as `torch.compiler.assume_constant_result`.

    That one imports torch's compiler where it is called, a second's work for everyone who imports this package.
    """
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]
    return function


def outside_of_graphs(function: Made) -> Made:
    """Function that torch.compile calls between two graphs, as `torch.compiler.disable`, which imports the compiler."""

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        if torch.compiler.is_dynamo_compiling():
            return torch.compiler.disable(function)(*args, **named)
        return function(*args, **named)

    return call  # type: ignore[return-value]


@contextmanager
def with_values() -> Iterator[None]:
    """Context in which new tensors are plain ones, although torch.export or a transform of `torch.func` is active.

    torch.export makes tensors without values, and a transform makes tensors that end with it.
    """
    no_export = getattr(_python_dispatch, "_disable_current_modes", nullcontext)
    no_transform = getattr(pyfunctorch, "temporarily_clear_interpreter_stack", nullcontext)
    # export would also record that gradients are switched off and on in between
    with no_export(), no_transform(), _unseen():
        yield


@cache
def load_forward_mode() -> None:
    """Load torch's rules for forward-mode differentiation now, without the warnings that torch gives of its own code.

    Torch loads them at the first use, and warns eighteen times that it calls its deprecated torch.jit.script.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from torch._decomp import decompositions_for_jvp  # noqa: F401


def alike(
    forms: Sequence[tuple[tuple[int, ...], tuple[int, ...], torch.dtype]], learned: Sequence[bool] = ()
) -> Callable[..., bool]:
    """Function that is true for plain tensors on the CPU of these sizes, strides and dtypes, as many as there are.

    Those that are `learned` require grad, the others do not.

    It is false if one tensor comes twice, for tensors that require grad where torch records gradients, for views that
    torch negates later, for tensors in inference mode, and inside of all transforms and modes but forward-mode
    differentiation and make_fx, whose tensors are plain ones.
    """
    if _guards is None:
        return lambda *tensors: False
    with torch.inference_mode(False), with_values():
        examples = [empty_on_cpu(*form) for form in forms]
        for x, grad in zip(examples, learned, strict=False):
            x.requires_grad_(grad)
        return _guards(*examples, dynamic_dims_sizes=None, dynamic_dims_strides=None).check


def forward_mode() -> bool:
    """Whether forward-mode differentiation is active."""
    return getattr(forward_ad, "_current_level", 0) >= 0


def transforming() -> bool:
    """Whether a transform of `torch.func` or forward-mode differentiation is active."""
    return functional() or forward_mode()


class Level:
    """Last active transform of `torch.func`: what torch does at it with an operation, for a program."""

    def __init__(self, interpreter: Any):
        self._interpreter, key, self._recording = interpreter, interpreter.key(), torch.is_grad_enabled()
        self._number = interpreter.level()
        self.maps = key == pyfunctorch.TransformType.Vmap
        self.differentiates = key in (pyfunctorch.TransformType.Grad, pyfunctorch.TransformType.Jvp)

    def below(self) -> AbstractContextManager[None]:
        """Context without this transform."""
        return self._interpreter.lower()

    @contextmanager
    def below_recording(self) -> Iterator[None]:
        """Context without this transform, in which those before it record although an `autograd.Function` runs."""
        with torch.set_grad_enabled(self._recording), forward_ad._set_fwd_grad_enabled(True), self.below():
            yield

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Context in which an `autograd.Function` may record for this transform alone."""
        allowed = _functorch.get_single_level_autograd_function_allowed()
        _functorch.set_single_level_autograd_function_allowed(True)
        try:
            yield
        finally:
            _functorch.set_single_level_autograd_function_allowed(allowed)

    def unmapped(self, x: Tensor) -> tuple[Tensor, int | None]:
        """Tensor without the axis that `vmap` maps over, and where that is; None: it has none."""
        return _functorch._unwrap_batched(x, self._number)

    def mapped(self, x: Tensor) -> Tensor:
        """Tensor whose first axis `vmap` maps over."""
        return _functorch._add_batch_dim(x, 0, self._number)

    def differentiated(self, x: Tensor) -> Tensor:
        """Tensor that this transform differentiates by."""
        return self._interpreter._cptr.lift(x)

    def constant(self, x: Tensor) -> Tensor:
        """Tensor below this transform."""
        return _functorch._unwrap_for_grad(x, self._number)

    def result(self, x: Tensor) -> Tensor:
        """Tensor from below this transform as one that it differentiates."""
        return _functorch._wrap_for_grad(x, self._number)


def innermost() -> Level | None:
    """Last active transform of `torch.func`; None: there is none."""
    found = _functorch.peek_interpreter_stack()
    return None if found is None else Level(pyfunctorch.coerce_cinterpreter(found))


def alive(x: Tensor) -> Tensor:
    """Tensor without the mark of a transform that has ended, such as one that its derivative has kept."""
    return _functorch.unwrap_if_dead(x)


def reversing() -> bool:
    """Whether a transform of `torch.func` that differentiates in reverse mode is active: grad, vjp, jacrev, hessian."""
    return any(level.key() == pyfunctorch.TransformType.Grad for level in _levels())


def mapped(x: Tensor) -> bool:
    """Whether `torch.func.vmap` maps over a tensor; values can be read under the other transforms."""
    try:
        return x.detach().sum().item() is None
    except RuntimeError:
        return True


def jit_tracing() -> bool:
    """Whether torch.jit.trace records torch's operations; it cannot record a compiled program."""
    return _jit_state() is not None


def dispatching() -> bool:
    """Whether a mode of torch sees the operators that tensors go through: make_fx, tensors without values, counters."""
    return modes() > 0


def proxy_tracing() -> bool:
    """Whether make_fx records the operators that tensors go through."""
    # importing it brings sympy, a second's work; where it was not imported, make_fx cannot run
    tracer = sys.modules.get("torch.fx.experimental.proxy_tensor") if modes() > 0 else None
    return tracer is not None and tracer.get_proxy_mode() is not None


def number(value: float, like: Tensor) -> Tensor | float:
    """Number beside a tensor; in an exported graph a tensor of its dtype.

    In a graph of float64, torch's ONNX exporter rounds numbers to float32, and leaves tensors as they are. Inside of a
    transform of `torch.func`, torch.export loses track of such tensors.
    """
    if not torch.compiler.is_exporting() or transforming():
        return value
    return _constant(value, like.dtype, like.device)


@constant_in_graphs
def _constant(value: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    with with_values():
        return torch.tensor(value, dtype=dtype, device=device)


def in_a_batch_of_gradients(inputs: Sequence[Tensor]) -> bool:
    """Whether autograd maps over gradients (`is_grads_batched`)."""
    return any(map(_batched_by_autograd, inputs))


def batches_of_gradients() -> range:
    """Numbers of the axes that autograd maps over in this thread, the first one first."""
    last = torch._C._vmapmode_increment_nesting() - 1
    torch._C._vmapmode_decrement_nesting()
    return range(1, last + 1)


def without_batch(x: Tensor, number: int) -> Tensor:
    """Tensor with an axis that autograd maps over as its first one, of size 1 where it has none or is empty."""
    found = torch._remove_batch_dim(x, number, 0, 0)  # expanded to the size 0 if there is none
    return found if len(found) else x.unsqueeze(0)


def with_batch(x: Tensor, number: int) -> Tensor:
    """Tensor whose first axis autograd maps over."""
    return torch._add_batch_dim(x, 0, number)


def captured(x: Tensor) -> bool:
    """Whether a CUDA graph records the operations that the tensor goes through."""
    return x.is_cuda and torch.cuda.is_current_stream_capturing()


def without_values(inputs: Sequence[Tensor]) -> bool:
    """Whether values of tensors cannot be read: they are traced, transformed, captured, or on the device "meta"."""
    return (
        torch.compiler.is_compiling()
        or inputs[0].device.type == "meta"
        or captured(inputs[0])
        or functional()
        or jit_tracing()
        or proxy_tracing()
        or in_a_batch_of_gradients(inputs)
    )
