"""Questions about torch's transforms that torch has no public answer to: its private symbols, all in one place.

They are those of torch 2.6 to 2.13. Where one is missing, the answer is the careful one: that a transform is active,
which costs time and changes no result.
"""

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad


def _private(name: str, missing: Any) -> Any:
    try:
        return attrgetter(name)(torch._C)
    except AttributeError:
        return missing


_functional = _private("_are_functorch_transforms_active", lambda: True)
_batched_by_autograd = _private("_functorch.is_legacy_batchedtensor", lambda x: False)


def transforming() -> bool:
    """Whether a transform of `torch.func` or forward-mode differentiation is active."""
    return _functional() or getattr(forward_ad, "_current_level", 0) >= 0


def in_a_batch_of_gradients(inputs: Sequence[Tensor]) -> bool:
    """Whether autograd maps over gradients (`is_grads_batched`), which knows torch's own operations only."""
    return any(map(_batched_by_autograd, inputs))


def without_values(inputs: Sequence[Tensor]) -> bool:
    """Whether tensors are traced or transformed, or have no values, so that they cannot be asked for them."""
    return (
        torch.compiler.is_compiling()
        or inputs[0].device.type == "meta"
        or _functional()
        or in_a_batch_of_gradients(inputs)
    )
