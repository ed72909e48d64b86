"""CUDA source of a program: one thread per sample; rows [batch, n] pass through shared memory.

Neighbouring threads read and write neighbouring numbers of memory. A thread finds its row in shared memory, where rows
have odd lengths, so that the rows of a warp begin in different banks. Values that all samples share are computed by one
thread of a block, where that spares enough.

Where errors grow too much, a kernel in float32 marks the row, and a second one, launched in any case, recomputes the
marked rows in float64; so that the host has nothing to ask. A kernel in float64 writes NaN.
"""

from __future__ import annotations

from typing import NamedTuple

from torchdq.backends import cuda_prelude
from torchdq.backends.cuda_prelude import CUDA
from torchdq.backends.emitter import Emitter
from torchdq.program.order import narrowest
from torchdq.program.program import LARGEST_GROWTH, Output, Program
from torchdq.program.uniform import split

SHARED = 48 * 1024  # shared memory that every block may have [bytes]
BLOCKS = (128, 64, 32)  # threads of a block; the first whose rows fit
UNROLLED = 32  # most steps of a loop that is unrolled


class Staged(NamedTuple):
    """Rows that pass through shared memory."""

    block: int
    arguments: frozenset[int]
    results: frozenset[int]


def source(program: Program, single: bool) -> str:
    """Kernel of a program in one precision.

    It defines `run`, which takes the number of samples, a pointer for each argument and result, and, where it `marks`
    rows, one to a byte per sample. Arrays are dense: [samples, width], or [width] where an argument is uniform. A
    result that is summed is [blocks, width], the sums of the blocks, where it is `staged`, and otherwise [samples,
    width], whose sum is left to the caller.
    """
    return KernelPrinter(program, single, recomputing=False).text()


def recomputing_source(program: Program) -> str:
    """Kernel that recomputes the marked rows in float64, from float32 to float32; its arguments are those of `source`.

    Sums of blocks are those of the marked rows alone.
    """
    return KernelPrinter(program, single=False, recomputing=True).text()


def marks(program: Program, single: bool) -> bool:
    """Whether the kernel of a program marks rows that are to be recomputed."""
    return single and program.growth is not None


def odd(width: int) -> int:
    """Length of a row in shared memory."""
    return width + 1 - width % 2


def staged(program: Program, single: bool) -> Staged:
    """Rows that pass through shared memory; the narrow ones if not all of them fit."""
    size = 4 if single else 8
    arguments = {k: odd(a.width) for k, a in enumerate(program.arguments) if a.width and not a.uniform}
    results = {k: odd(len(r.values)) for k, r in enumerate(program.results) if r.values}
    parts = split(program)
    free = SHARED - (0 if parts is None else size * parts.rest.arguments[-1].width)
    for block in BLOCKS:
        if block * size * (sum(arguments.values()) + sum(results.values())) <= free:
            return Staged(block, frozenset(arguments), frozenset(results))
    room, chosen = free // (block * size), (set[int](), set[int]())
    # sums first, which otherwise take a row per sample
    wanted = [(not program.results[k].summed, w, 1, k) for k, w in results.items()]
    wanted += [(True, w, 0, k) for k, w in arguments.items()]
    for _, width, side, k in sorted(wanted):
        if width <= room:
            room -= width
            chosen[side].add(k)
    return Staged(block, *map(frozenset, chosen))


class KernelPrinter:
    """Text of the values of a program, and of its kernel."""

    def __init__(self, program: Program, single: bool, recomputing: bool):
        self.arguments, self.stage = program.arguments, staged(program, single or recomputing)
        parts = None if recomputing else split(program)  # few rows compute all of their values
        self.program = program if parts is None else parts.rest
        self.common = None if parts is None else parts.common
        self.values = Emitter(self.program, CUDA, self.input)
        self.single, self.recomputing = single, recomputing
        self.number = "float" if recomputing else "S"  # type in memory; the arithmetic is in S
        if recomputing:  # few rows, which are read and written where they are; sums are those of all threads
            sums = frozenset(k for k in self.stage.results if program.results[k].summed)
            self.stage = self.stage._replace(arguments=frozenset(), results=sums)

    # --- statements ---

    def input(self, k: int, j: int) -> str:
        """Expression for a number of an argument."""
        if k == len(self.arguments):
            return f"common[{j}]"
        argument = self.arguments[k]
        if argument.uniform:
            return f"in{k}[{j}]"
        return f"s{k}[t*{odd(argument.width)}+{j}]" if k in self.stage.arguments else f"in{k}[b*{argument.width}+{j}]"

    def shared(self) -> list[str]:
        """Statements of the first thread of a block: values that are common to all samples."""
        if self.common is None:
            return []
        values, (row,) = Emitter(self.common, CUDA, self.input), self.common.results
        stored = [f"common[{j}]={values.output(v)};" for j, v in enumerate(row.values)]
        return [
            f"STAGE S common[{len(stored)}];",
            "EACH{if(t==0){",
            *values.statements(narrowest(self.common)),
            *stored,
            "}}",
        ]

    def over(self) -> list[str]:
        """Statement that tells whether the errors of a sample grow too much."""
        if self.program.growth is None:
            return []
        factor = self.values.output(self.program.growth.values[0])
        limit = LARGEST_GROWTH.single if self.single else LARGEST_GROWTH.double
        return [f"const int over=!({factor}<={CUDA.literal(limit)});"]

    def value(self, v: Output) -> str:
        """Expression for a number of a result."""
        nan = self.program.growth is not None and not self.single
        return f"over?{CUDA.nan}:{self.values.output(v)}" if nan else self.values.output(v)

    def results(self) -> list[str]:
        """Statements that write all results of a sample."""
        lines, marked = self.over(), marks(self.program, self.single)
        lines += ["lost[b]=over;"] if marked else []
        for k, result in enumerate(self.program.results):
            for j, v in enumerate(result.values):
                # the kernel that recomputes the row adds what it is to a sum
                value = f"over?(S)0:{self.value(v)}" if marked and result.summed else self.value(v)
                lines.append(f"{self.place(k, j)}={value};")
        return lines

    def place(self, k: int, j: int) -> str:
        """Expression for the place of a number of a result."""
        w = len(self.program.results[k].values)
        return f"o{k}[t*{odd(w)}+{j}]" if k in self.stage.results else f"out{k}[b*{w}+{j}]"

    # --- the whole ---

    def opening(self, block: int, arguments: int, *numbers: str) -> list[str]:
        """Lines in front of the statements: the prelude, and what the kernel takes, beginning with `numbers`."""
        pointers = [f"const {self.number}*__restrict__ in{k}" for k in range(arguments)]
        pointers += [f"{self.number}*__restrict__ out{k}" for k in range(len(self.program.results))]
        if marks(self.program, self.single or self.recomputing):
            pointers.append(f"{'const ' if self.recomputing else ''}unsigned char*__restrict__ lost")
        return [
            cuda_prelude.text(self.single, block),
            f"KERNEL({','.join([*numbers, *pointers])})",
            "const long long first=block*BLOCK;const int here=samples-first<BLOCK?(int)(samples-first):BLOCK;",
        ]

    def text(self) -> str:
        """Text of the kernel."""
        p, stage, number = self.program, self.stage, self.number
        names, loads, stores, size = [], [], [], 0
        for k in sorted(stage.arguments):
            w = self.arguments[k].width
            names.append(f"{number}*const s{k}=stage+{size};")
            loads.append(_moved(w, f"s{k}[{{0}}]=in{k}[first*{w}+i]"))
            size += stage.block * odd(w)
        for k in sorted(stage.results):
            w = len(p.results[k].values)
            names.append(f"{number}*const o{k}=stage+{size};")
            size += stage.block * odd(w)
            if p.results[k].summed:
                total = f"S a=0;for(int i=0;i<here;i++)a+=o{k}[i*{odd(w)}+j];out{k}[block*{w}+j]=a;"
                stores.append(f"EACH{{for(int j=t;j<{w};j+=BLOCK){{{total}}}}}")
            else:
                stores.append(_moved(w, f"out{k}[first*{w}+i]=o{k}[{{0}}]"))
        body = ["{", *self.values.statements(narrowest(self.program)), *self.results(), "}"]
        if self.recomputing:
            sums = [(k, j) for k in sorted(stage.results) for j in range(len(p.results[k].values))]
            body = ["if(lost[b])", *body, "else{", *(f"{self.place(k, j)}=0;" for k, j in sums), "}"]
        lines = [
            *self.opening(stage.block, len(self.arguments)),
            *([f"STAGE {number} stage[{size}];"] if size else []),
            *names,
            *loads,
            *self.shared(),
            "EACH{const long long b=first+t;if(t<here){",
            *body,
            "}}",
            *stores,
            "}}",
        ]
        return "\n".join(lines) + "\n"


def _moved(width: int, statement: str) -> str:
    """Rows between memory, where neighbouring threads take neighbouring numbers, and shared memory."""
    one = statement.format("i" if width % 2 else f"i/{width}*{width + 1}+i%{width}")
    return (
        f"EACH{{if(here==BLOCK){{UNROLL({min(width, UNROLLED)})for(int k=0;k<{width};k++)"
        f"{{const int i=k*BLOCK+t;{one};}}}}else UNROLL(1)for(int i=t;i<here*{width};i+=BLOCK){one};}}"
    )
