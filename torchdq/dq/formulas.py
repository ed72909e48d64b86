"""Formulas of the algebra on tensors, as one program each: a call takes microseconds, and gradients of all orders."""

from collections.abc import Callable, Iterator
from operator import index
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.call import Computation, evaluate
from torchdq.backends.choice import BackendName
from torchdq.base.caches import remembered
from torchdq.base.checks import DTYPES
from torchdq.dq.components import form, stack
from torchdq.program.program import Argument, Program, record

KEPT = 256  # programs of formulas


def numbers(components: Any) -> Iterator[Any]:
    """Numbers in nested tuples, in order."""
    if isinstance(components, tuple | list):
        for part in components:
            yield from numbers(part)
    else:
        yield components


class _Fields(NamedTuple):
    """Fields of `Formula`."""

    formula: Callable[..., Any]  # takes components in the form of the algebra
    widths: tuple[tuple[str, int], ...]  # arguments with the sizes of their last axes
    shape: tuple[int, ...] | None  # trailing axes of the result; None: one axis


class Formula(_Fields, Computation):
    """Formula of the algebra as a computation of `torchdq.backends.call`."""

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an argument."""
        return (dict(self.widths)[name],)

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Trailing axes of the result."""
        return ((len(program.results[0].values),) if self.shape is None else self.shape,)

    @remembered(KEPT)
    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the formula."""
        name = getattr(self.formula, "func", self.formula).__name__
        return record(name, arguments, lambda *rows: {"y": [*numbers(self.formula(*map(form, rows)))]})


def computed(formula: Callable[..., Any], shape: tuple[int, ...] | None = None, **x: Tensor) -> Tensor:
    """Tensor [..., k] of the components that a formula gives for those of tensors x.

    Args:
        formula: function of the algebra, the same object at every call.
        shape: trailing axes of the result; None: one axis.
        x: tensors, whose last axes are checked already.
    """
    if all([y.dtype not in DTYPES for y in x.values()]):  # half precision, which has no programs
        found = stack([*numbers(formula(*[form(y.unbind(-1)) for y in x.values()]))])
        return found if shape is None else found.reshape(*found.shape[:-1], *shape)
    widths = tuple([(name, index(y.shape[-1])) for name, y in x.items()])
    # torch.compile fuses torch operations itself
    backend: BackendName | None = "eager" if torch.compiler.is_compiling() else None
    return evaluate(Formula(formula, widths, shape), x, backend)["y"]
