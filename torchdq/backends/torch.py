"""Backend "eager": torch operations, on any device; torch traces, differentiates and transforms them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from torchdq.backends.backend import Backend, Kernel
from torchdq.errors import TorchdqError
from torchdq.numbers.ops import OPS
from torchdq.program.loop import Loop, by_steps, evaluated, shapes
from torchdq.program.program import Output, Program, outputs
from torchdq.program.transforms import number


class Torch(Backend):
    """Backend that runs programs operation by operation in torch."""

    name = "eager"
    differentiable = True

    def refusal(self, device: torch.device) -> TorchdqError | None:
        """None: torch runs on every device."""
        return None

    def kernel(self, program: Program, dtype: torch.dtype, device: torch.device) -> Kernel:
        """Function that interprets the program."""
        return partial(interpreted, program)


EAGER = Torch()


class InterpretedKernel:
    """Program run by torch, operation by operation, instead of compiled."""

    def __init__(self, program: Program):
        self.program = program

    def __call__(self, inputs: Sequence[Tensor], samples: int) -> list[Tensor]:
        """Outputs of the program."""
        return interpreted(self.program, inputs, samples)

    def into(self, inputs: Sequence[Tensor], results: Sequence[Tensor], samples: int) -> None:
        """Compute the outputs, none of them summed, into given tensors."""
        arguments = self.program.arguments
        rows = [
            x.reshape([a.width] if a.uniform else [samples, a.width]) for x, a in zip(inputs, arguments, strict=True)
        ]
        for y, found in zip(results, self(rows, samples), strict=True):
            y.copy_(found.reshape(y.shape))


class InterpretedLoop:
    """Loop that is run step by step, by torch instead of compiled."""

    def __init__(self, loop: Loop):
        self.loop = loop

    def __call__(self, inputs: Sequence[Tensor], samples: int, steps: int) -> list[Tensor]:
        """Outputs of the loop, differentiable by torch itself."""
        return interpreted_loop(self.loop, inputs, samples, steps, interpreted)


def interpreted_loop(
    loop: Loop,
    inputs: Sequence[Tensor],
    samples: int,
    steps: int,
    run: Callable[[Program, Sequence[Tensor], int], Sequence[Tensor]],
) -> list[Tensor]:
    """Outputs of a loop; `run(program, inputs, samples)` has those of a program, with or without the error growth."""
    count, own = len(loop.body.arguments), {r: k for k, r in loop.carried}

    def step(s: int, before: Mapping[int, Tensor]) -> dict[int, Tensor]:
        rows = [x[s] if k in loop.stepped else x for k, x in enumerate(inputs[:count])]
        for r, k in own.items():
            rows[k] = before[r]
        for more, k in enumerate(loop.added, count):
            rows[k] = rows[k] + inputs[more][s]
        return dict(enumerate(evaluated(loop.body, rows, lambda program, x: run(program, x, samples))))

    way, start = -1 if loop.backwards else 1, {r: inputs[k] for r, k in own.items()}
    growth, forms, order = len(loop.body.results), shapes(loop, samples, steps), range(steps)[::way]
    totals, last = {*range(growth)} - {*own, *loop.kept}, own.keys() - {*loop.kept}
    rows: dict[int, Tensor] = by_steps(step, start, order, lambda x: torch.stack(x[::way]), totals, last)
    if growth in rows:
        rows[growth] = rows[growth].amax(0)
    return [rows[r] if r in rows else inputs[0].new_zeros(shape) for r, shape in enumerate(forms)]


def interpreted(program: Program, inputs: Sequence[Tensor], samples: int) -> list[Tensor]:
    """Outputs of a program, operation by operation; differentiable by torch itself."""
    rows = [x.unbind(-1) for x in inputs]
    values: list = []  # tensors, or Python numbers

    def tensor(k: int) -> Tensor:
        x = values[k]
        return x if isinstance(x, Tensor) else inputs[0].new_full((), x)

    for code, operands, payload in program.ops:
        if code == "in":
            argument, component = payload
            values.append(rows[argument][component])
        elif code == "const":
            values.append(number(payload, inputs[0]))
        else:
            row = OPS[code]
            x = [values[k] if row.infix else tensor(k) for k in operands]
            values.append(row.value(*x) if row.tensor is None else row.tensor(torch, *x))

    nothing = inputs[0][..., :0]  # added to constants, so that they have gradients, which are zero

    def column(v: Output) -> Tensor:
        x = v if isinstance(v, float) else 0.0 - values[v[0]] if v[1] else values[v[0]]
        x = nothing.sum(-1) + number(x, inputs[0]) if isinstance(x, float) else x
        return x.expand(samples)

    found = [
        torch.stack([column(v) for v in r.values], -1) if r.values else nothing.expand(samples, 0)
        for r in outputs(program)
    ]
    return [y.sum(0) if r.summed else y for y, r in zip(found, outputs(program), strict=True)]
