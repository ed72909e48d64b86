"""CUDA source of a loop: one thread per sample, the steps inside, and what is carried in variables of the thread.

Rows are read and written where they are. In float32 a kernel marks the samples whose errors grow too much at one of the
steps, and a second one computes all of their steps in float64, rounded at the end. In float64 such a sample is NaN from
that step on.
"""

from __future__ import annotations

from torchdq.backends.cuda_source import KernelPrinter, Staged, marks
from torchdq.program.loop import Loop
from torchdq.program.order import narrowest

BLOCK = 64  # threads of a block: few, since the samples of a loop are often few


def loop_source(loop: Loop, single: bool) -> str:
    """Kernel of a loop in one precision.

    It defines `run`, which takes the numbers of samples and of steps, a pointer for each argument and result, and,
    where it `marks` rows, one to a byte per sample. Arrays are dense: [samples, width], [steps, samples, width], or
    [width] where an argument is uniform. A result that is summed is [samples, width], whose sum is left to the caller.
    """
    return _LoopPrinter(loop, single, recomputing=False).text()


def recomputing_loop_source(loop: Loop) -> str:
    """Kernel that computes the marked samples in float64, from float32 to float32; its arguments are the same."""
    return _LoopPrinter(loop, single=False, recomputing=True).text()


class _LoopPrinter(KernelPrinter):
    def __init__(self, loop: Loop, single: bool, recomputing: bool):
        super().__init__(loop.body, single, recomputing)
        self.loop, self.stage = loop, Staged(BLOCK, frozenset(), frozenset())

    def input(self, k: int, j: int) -> str:
        """Expression for a number of an argument."""
        if k in dict(self.loop.carried):
            return f"c{k}_{j}"
        return f"in{k}[at*{self.arguments[k].width}+{j}]" if k in self.loop.stepped else super().input(k, j)

    def text(self) -> str:
        loop, results = self.loop, self.program.results
        states = {r: k for k, r in loop.carried}
        totals = [r for r in range(len(results)) if r not in (*states, *loop.kept)]
        marked = marks(self.program, self.single)
        first, step = ("steps-1", "steps-1-s") if loop.backwards else ("0", "s")
        before, after = ("at+samples", "at") if loop.backwards else ("at", "at+samples")  # one state more than steps
        begin = [
            *(self.row(r, f"S c{k}_#=in{k}[b*@+#];") for r, k in states.items()),
            *(self.row(r, f"S sum{r}_#=0;") for r in totals),
            "int gone=0;" if marked else "",
            f"{{const long long at=({first})*samples+b;",
            *(self.row(r, f"out{r}[({before})*@+#]=c{k}_#;") for r, k in states.items() if r in loop.kept),
            "}",
        ]
        added = {r: i for i, k in enumerate(loop.added, len(self.arguments)) for r in states if states[r] == k}
        once = [
            *(self.row(r, f"c{states[r]}_#+=in{i}[at*@+#];") for r, i in added.items()),
            *self.values.statements(narrowest(self.program)),
            *self.over(),
            *(f"const S y{r}_{j}={self.value(v)};" for r, x in enumerate(results) for j, v in enumerate(x.values)),
            "gone|=over;" if marked else "",
            *(self.row(r, f"out{r}[({after if r in states else 'at'})*@+#]=y{r}_#;") for r in loop.kept),
            *(self.row(r, f"sum{r}_#+=y{r}_#;") for r in totals),
            *(self.row(r, f"c{k}_#=y{r}_#;") for r, k in states.items()),
        ]
        end = [
            *(self.row(r, f"out{r}[b*@+#]=c{k}_#;") for r, k in states.items() if r not in loop.kept),
            *(self.row(r, f"out{r}[b*@+#]=sum{r}_#;") for r in totals),
            "lost[b]=gone;" if marked else "",
        ]
        lines = [
            *self.opening(BLOCK, len(loop.arguments), "long long steps"),
            *self.shared(),
            f"EACH{{const long long b=first+t;if(t<here{'&&lost[b]' if self.recomputing else ''}){{",
            *begin,
            f"UNROLL(1)for(long long s=0;s<steps;s++){{const long long at=({step})*samples+b;",
            *once,
            "}",
            *end,
            "}}}}",
        ]
        return "\n".join(lines) + "\n"

    def row(self, r: int, statement: str) -> str:
        """Statement for every number # of a result, of which there are @."""
        width = len(self.program.results[r].values)
        return "".join(statement.replace("@", str(width)).replace("#", str(j)) for j in range(width))
