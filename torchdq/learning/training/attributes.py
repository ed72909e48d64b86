"""Attributes of a model that its state dict does not hold, as plain text, by which two models can be compared."""

import dataclasses
import hashlib
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

DIGITS = 9  # decimal digits of a number, or of the largest of an array, that count: others differ between processors
NEUTRAL = ("backend",)  # attributes that results depend on by rounding alone
_OWN = frozenset(vars(nn.Module()))  # attributes that torch gives every module


def attributes(model: nn.Module) -> dict[str, str]:
    """Text of the attributes of a model and of the modules in it, and of buffers that its state dict leaves out.

    Numbers, words and arrays, in sequences, mappings and dataclasses such as robots; the name of a function, and the
    type of everything else.

    >>> attributes(nn.Sequential(nn.Dropout(0.1)))["0.p"]
    '0.1'
    """
    return dict(_of_modules("", model, {id(part) for part in model.modules()}))


def _of_modules(name: str, model: nn.Module, known: set[int]) -> Iterator[tuple[str, str]]:
    for owner, module in model.named_modules(prefix=name):
        held = {key: value for key, value in vars(module).items() if key not in (*_OWN, *NEUTRAL)}
        held |= {key: module._buffers[key] for key in module._non_persistent_buffers_set}
        for key, value in held.items():
            yield from _entries(f"{owner}.{key}" if owner else key, value, known)


def _entries(name: str, value: Any, known: set[int]) -> Iterator[tuple[str, str]]:
    """Name and text of every number, word, array and function in a value."""
    if isinstance(value, nn.Module) and id(value) not in known:  # hidden in a list, so not among the parameters
        known.update(map(id, value.modules()))
        yield from _entries(name, value.state_dict(), known)
        yield from _of_modules(name, value, known)
    if isinstance(value, nn.Module | nn.Parameter):
        return
    for key, part in _parts(value):
        yield from _entries(f"{name}.{key}", part, known)
    if not list(_parts(value)):
        yield name, _text(value)


def _parts(value: Any) -> Iterator[tuple[Any, Any]]:
    """Names and values of the parts of a value."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield from ((f.name, getattr(value, f.name)) for f in dataclasses.fields(value) if not f.name.startswith("_"))
    elif isinstance(value, Namespace | SimpleNamespace):
        yield from vars(value).items()
    elif isinstance(value, partial):
        yield from {"function": value.func, "arguments": value.args, **value.keywords}.items()
    elif isinstance(value, Mapping):
        yield from value.items()
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes | range):
        yield from zip(getattr(value, "_fields", range(len(value))), value, strict=True)


def _text(value: Any) -> str:
    """Text of a value without parts, the same in every process."""
    if isinstance(value, Tensor):
        dense = value.detach().to_dense() if value.layout != torch.strided else value.detach()
        if value.is_meta:
            return f"{value.dtype} {list(value.shape)} without values"
        value = (dense.double() if dense.is_floating_point() else dense).cpu().numpy()
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, np.ndarray):
        numbers = _rounded(value.astype(float)) if value.dtype.kind == "f" else value
        return f"{list(value.shape)} numbers with SHA-256 {hashlib.sha256(numbers.tobytes()).hexdigest()[:16]}"
    if isinstance(value, float):
        return f"{value:.{DIGITS}g}"
    if isinstance(value, set | frozenset):
        return repr(sorted(map(_text, value)))
    if value is None or isinstance(value, bool | int | complex | str | bytes | range | torch.dtype):
        return repr(value)
    return getattr(value, "__qualname__", type(value).__qualname__)


def _rounded(x: np.ndarray) -> np.ndarray:
    """Numbers rounded relative to the largest of them."""
    largest = float(np.max(np.abs(x), where=np.isfinite(x), initial=0.0))
    decimals = DIGITS - int(np.ceil(np.log10(largest))) if largest else DIGITS
    return np.round(x, decimals) + 0.0  # never -0.0
