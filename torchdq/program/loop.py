"""A program that is applied step after step, as one call: a rollout, and its adjoint, which is a loop as well."""

from __future__ import annotations

from collections.abc import Callable, Container, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

from torchdq.numbers.ops import Count
from torchdq.program.autodiff import vjp
from torchdq.program.program import Argument, Program, Result, outputs

Name = TypeVar("Name", bound=Hashable)
Rows = Mapping[Name, Any]  # tensors by name


class Link(NamedTuple):
    """Program of a chain."""

    program: Program
    takes: tuple[str, ...]  # its arguments: names of those of the chain, and of results of earlier links
    gives: tuple[str, ...]  # names of its results


@dataclass(frozen=True, eq=False)
class Chain:
    """Programs one after the other as the body of a loop, without gradients; at most one has an error growth.

    Each is compiled as it is alone, so that its results are bitwise the same.
    """

    name: str
    arguments: tuple[Argument, ...]
    links: tuple[Link, ...]
    wanted: tuple[str, ...]  # names of the results

    @property
    def results(self) -> tuple[Result, ...]:
        """Results of the links that are wanted."""
        found = {n: r for link in self.links for n, r in zip(link.gives, link.program.results, strict=True)}
        return tuple([found[name]._replace(name=name) for name in self.wanted])

    @property
    def growth(self) -> Result | None:
        """Error growth of the link that has one."""
        return next((link.program.growth for link in self.links if link.program.growth is not None), None)

    def count(self) -> Count:
        """Operations per sample."""
        return Count(*map(sum, zip(*(link.program.count() for link in self.links), strict=True)))


@dataclass(frozen=True, eq=False)
class Loop:
    """A program whose results are arguments of the next step; samples do not depend on each other.

    An argument is carried from step to step, given for every step, by sample or for all of them, or, as a uniform one,
    the same at all. A result is carried, kept for every step, or the total over the steps, which is that over the
    samples, too, where the program sums it. Of a carried result there is the last, or, if it is kept, all including the
    start: a row more than steps.
    """

    body: Any  # a program; or a `Chain`, on the CPU and without gradients
    carried: tuple[tuple[int, int], ...]  # argument of a step, and the result of the step before that it takes
    stepped: tuple[int, ...] = ()  # arguments that are given for every step
    kept: tuple[int, ...] = ()  # results that are returned of every step
    backwards: bool = False  # whether the last step comes first
    added: tuple[int, ...] = ()  # carried arguments that more is added to before every step, given after the body's own
    common: tuple[int, ...] = ()  # arguments of every step that all samples share, [steps, 1, width]

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


def evaluated(
    body: Program | Chain, inputs: Sequence[Any], evaluate: Callable[[Program, Sequence[Any]], Sequence[Any]]
) -> Sequence[Any]:
    """Outputs of a body, by a function that has those of a program, with or without the error growth."""
    if isinstance(body, Program):
        return evaluate(body, inputs)
    known, growth = dict(zip([a.name for a in body.arguments], inputs, strict=True)), list[Any]()
    for link in body.links:
        found = evaluate(link.program, [known[name] for name in link.takes])
        known.update(zip(link.gives, found, strict=False))
        growth += found[len(link.gives) :]
    return [*(known[name] for name in body.wanted), *growth]


def shapes(loop: Loop, samples: int, steps: int) -> list[tuple[int, ...]]:
    """Shapes of the outputs of a loop, with the largest error growth of every sample if the body has one."""
    found, states = list[tuple[int, ...]](), {r for _, r in loop.carried}
    for r, result in enumerate(outputs(loop.body)):
        axes: tuple[int, ...] = () if result.summed else (samples,)
        axes = (steps + (r in states), *axes) if r in loop.kept else axes
        found.append((*axes, len(result.values)))
    return found


def by_steps(
    step: Callable[[int, Rows], Rows],
    start: Rows,
    order: Iterable[int],
    join: Callable[..., Any],
    total: Container[Name] = (),
    last: Container[Name] = (),
) -> dict[Name, Any]:
    """Rows by name of the start and of every step, `joined`; `step(k, rows)` takes the rows of the step before.

    It serves what is no compiled loop: functions of a caller, torch operations, and rows near a limit. Where the last
    of some rows is wanted no other is kept.
    """
    found: dict[Name, list[Any]] = {}
    rows = start
    for k in order:
        rows = step(k, rows)
        for name, x in rows.items():
            if name in last:
                found[name] = [x]
            else:
                found.setdefault(name, [start[name]] if name in start else []).append(x)
    return joined(found or {name: [x] for name, x in start.items()}, join, total, last)


def joined(
    found: Mapping[Name, Sequence[Any]], join: Callable[..., Any], total: Container[Name], last: Container[Name]
) -> dict[Name, Any]:
    """Rows of steps or parts as one: the totals of some, the last of others, and all the others joined."""
    return {
        name: sum(x[1:], x[0]) if name in total else x[-1] if name in last else join(x) for name, x in found.items()
    }


def with_states(loop: Loop) -> Loop:
    """Loop that keeps everything that it carries."""
    kept = {*loop.kept, *(r for _, r in loop.carried)}
    return loop if len(kept) == len(loop.kept) else replace(loop, kept=tuple(sorted(kept)))


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
