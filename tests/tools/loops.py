"""Small programs that are steps of a loop, and loops over them."""

import torch
from helpers import random
from programs import same

from torchdq.backends.call import evaluate
from torchdq.backends.torch import InterpretedLoop
from torchdq.functions.compile import RecordedComputation
from torchdq.numbers.functions import sin
from torchdq.program.loop import Loop
from torchdq.program.program import GROWTH, Argument, Program, record

CARRIED, STEPPED, FIXED = ("x",), ("u",), ("p", "m")


def step(width: int = 3, links: int = 1, growth: bool = False) -> Program:
    """Step of x, [samples, width], with u of every step, p of every sample, and m that all samples share.

    y is looked at after every step, z at the end; with `growth`, that of errors is 1000 |x_0| and limits float32.
    """

    def algorithm(x, u, p, m):
        for _ in range(links):
            x = [a + 0.2 * (m[0] * sin(x[j - 1]) - p[0] * b * a) for j, (a, b) in enumerate(zip(x, u, strict=True))]
        z = sum((a * b for a, b in zip(x, u, strict=True)), m[1] * p[0])
        rows = {"x": x, "y": [p[0] * a + m[1] for a in x[:2]], "z": [z]}
        return rows if not growth else {**rows, GROWTH: [1000.0 * x[0] * x[0]]}

    arguments = [Argument("x", width), Argument("u", width), Argument("p", 1), Argument("m", 2, uniform=True)]
    return record("small", arguments, algorithm)


def tensors(samples: int, steps: int, width: int = 3, dtype=torch.float64, grad: bool = False) -> dict:
    """Arguments of a loop over `step`, by name."""
    shapes = {"x": (samples, width), "u": (steps, samples, width), "p": (samples, 1), "m": (2,)}
    found = {name: random(*shape, seed=k, dtype=dtype) for k, (name, shape) in enumerate(shapes.items())}
    return {name: x.requires_grad_(grad) for name, x in found.items()}


def parts(given: dict) -> list[dict]:
    """Arguments that are carried, of every step, and fixed."""
    return [{name: given[name] for name in names} for names in (CARRIED, STEPPED, FIXED)]


def loop(program: Program, kept=(0, 1), backwards: bool = False) -> Loop:
    """Loop over `step`."""
    return Loop(program, ((0, 0),), (1,), kept, backwards)


def interpreted(loop: Loop, inputs, samples: int, steps: int) -> list[torch.Tensor]:
    """Outputs of a loop, by torch's own operations."""
    return InterpretedLoop(loop)(inputs, samples, steps)


def one_by_one(program: Program, steps: int, given: dict, backend: str) -> dict[str, torch.Tensor]:
    """Results of calls of a program one after the other: all x with the start, all y, and the total of z."""
    x, found = given["x"], {"x": [given["x"]], "y": [], "z": []}
    for k in range(steps):
        after = evaluate(RecordedComputation(program), {**given, "x": x, "u": given["u"][k]}, backend)
        x = after["x"]
        for name, y in after.items():
            found[name].append(y)
    start = {"y": x.new_zeros(0, *x.shape[:-1], min(x.shape[-1], 2)), "z": x.new_zeros(*x.shape[:-1], 1)}
    stacked = {name: torch.stack(found[name]) if found[name] else start[name] for name in ("x", "y")}
    return {**stacked, "z": sum(found["z"][1:], found["z"][0]) if steps else start["z"]}


def gradients(found: dict, given: dict) -> list[torch.Tensor]:
    """Gradients of a function of all results in all arguments."""
    total = sum((y * (0.3 + random(*y.shape, seed=k, dtype=y.dtype))).sum() for k, y in enumerate(found.values()))
    return torch.autograd.grad(total, list(given.values()))


def equal(found, expected) -> bool:
    """Whether results are equal to the last bit; raises with the difference otherwise."""
    same(list(found.values()), [expected[name] for name in found])
    return True
