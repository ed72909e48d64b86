"""A program that is applied step after step, as one call: a rollout, and its adjoint, which is a loop as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torchdq.program.autodiff import vjp
from torchdq.program.program import Argument, Program, outputs


@dataclass(frozen=True, eq=False)
class Loop:
    """A program whose results are arguments of the next step; samples do not depend on each other.

    An argument is carried from step to step, given for every step, or, like a uniform one, the same at all. A result is
    carried, kept for every step, or the total over the steps, which is that over the samples, too, where the program
    sums it. Of a carried result there is the last, or, if it is kept, all including the start: a row more than steps.
    """

    body: Program
    carried: tuple[tuple[int, int], ...]  # argument of a step, and the result of the step before that it takes
    stepped: tuple[int, ...] = ()  # arguments that are given for every step
    kept: tuple[int, ...] = ()  # results that are returned of every step
    backwards: bool = False  # whether the last step comes first
    added: tuple[int, ...] = ()  # carried arguments that more is added to before every step, given after the body's own

    @property
    def name(self) -> str:
        """Name of the body."""
        return f"{self.body.name}_loop"

    @property
    def arguments(self) -> tuple[Argument, ...]:
        """Arguments of the body, and what is added to some."""
        own = self.body.arguments
        return (*own, *(own[k]._replace(name=f"{own[k].name}+") for k in self.added))

    @property
    def given(self) -> tuple[int, ...]:
        """Arguments that are given for every step, with what is added."""
        first = len(self.body.arguments)
        return (*self.stepped, *range(first, first + len(self.added)))


# functions, since all that depends on a loop alone is computed where its kernel is made


def shapes(loop: Loop, samples: int, steps: int) -> list[tuple[int, ...]]:
    """Shapes of the outputs of a loop, with the largest error growth of every sample if the body has one."""
    found, states = list[tuple[int, ...]](), {r for _, r in loop.carried}
    for r, result in enumerate(outputs(loop.body)):
        axes: tuple[int, ...] = () if result.summed else (samples,)
        axes = (steps + (r in states), *axes) if r in loop.kept else axes
        found.append((*axes, len(result.values)))
    return found


def with_states(loop: Loop) -> Loop:
    """Loop that keeps everything that it carries."""
    carried = [r for _, r in loop.carried]
    return replace(loop, kept=tuple(sorted({*loop.kept, *carried})))


def adjoint(loop: Loop, wrt: Sequence[int]) -> Loop:
    """Vector-Jacobian product of a loop `with_states`, which runs the other way.

    Its arguments are those of the loop, of carried ones the values before every step; then the cotangent of every
    result: of a carried one the start, zero, of what it carries. The cotangents of the states follow, those of the
    start left out. Its results are the cotangents of carried arguments, and of those in `wrt`.
    """
    states, count = dict(loop.carried), len(loop.body.arguments)
    taken = sorted({*wrt, *states})
    return Loop(
        vjp(loop.body, taken),
        tuple((count + r, taken.index(k)) for k, r in loop.carried),
        (*sorted({*loop.stepped, *states}), *(count + r for r in loop.kept if r not in states.values())),
        tuple(taken.index(k) for k in loop.stepped if k in taken),
        not loop.backwards,
        tuple(count + r for _, r in loop.carried),
    )
