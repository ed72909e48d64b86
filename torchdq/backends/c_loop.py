"""C source of a loop: the samples outside, the steps inside, and what is carried in arrays that stay in the cache."""

from torchdq.backends import c_prelude
from torchdq.backends.c_source import Printer, add, load, store, store_sum
from torchdq.program.loop import Chain, Loop
from torchdq.program.program import GROWTH, Program, outputs


def loop_source(loop: Loop, single: bool, few: bool = False) -> str:
    """C source of a loop in double or single precision, for few samples or any number.

    It defines `run`, which takes the number of samples, that of the samples in the arrays, the number of steps, and a
    pointer per argument and per output: dense arrays [samples, width], [steps, samples, width] or [width]; the last
    output is the largest error growth of every sample, if the body has one.
    """
    body, results = loop.body, outputs(loop.body)
    inputs = {k: a.width for k, a in enumerate(body.arguments) if not a.uniform and a.width}
    widths = [max(len(r.values), 1) for r in results]  # a result without values still needs an array to name
    carried = {r: k for k, r in loop.carried if k in inputs}
    summed = [r for r, x in enumerate(results) if x.summed]
    totals = [r for r, x in enumerate(body.results) if x.values and r not in {*summed, *carried, *loop.kept}]
    kept = [r for r in loop.kept if body.results[r].values]
    growths = [len(body.results)] if body.growth is not None else []
    more = {k: f"in{i}" for i, k in enumerate(loop.added, len(body.arguments)) if k in inputs}
    first, step = ("steps-1", "steps-1-s") if loop.backwards else ("0", "s")
    before, after = ("at+stride", "at") if loop.backwards else ("at", "at+stride")  # states are one more than steps
    begin = [
        *(f"T I{k}[{w}];" for k, w in inputs.items()),
        *(load(f"I{k}", f"in{k}+b*{w}", w) for k, w in inputs.items() if k not in loop.stepped),
        *(_zeros(f"Q{r}", widths[r]) for r in (*totals, *growths)),
        f"{{const long at=b+({first})*stride;",
        *(store(f"out{r}+({before})*{inputs[k]}", f"I{k}", inputs[k]) for r, k in carried.items() if r in kept),
        "}",
    ]
    functions, links, prelude, statements = printed(body, single)
    once = [
        *(load(f"I{k}", f"in{k}+at*{w}", w) for k, w in inputs.items() if k in loop.stepped),
        *(_add_rows(f"I{k}", f"{x}+at*{inputs[k]}", inputs[k]) for k, x in more.items()),
        *(f"T O{r}[{w}];" for r, w in enumerate(widths)),
        *statements,
        *(store(f"out{r}+({after if r in carried else 'at'})*{widths[r]}", f"O{r}", widths[r]) for r in kept),
        *(add(f"A{r}", f"O{r}", widths[r]) for r in summed),
        *(f"for(int j=0;j<{widths[r]};j++)Q{r}[j]+=O{r}[j];" for r in totals),
        *(f"Q{r}[0]=max_(Q{r}[0],O{r}[0]);" for r in growths),
        *(f"for(int j=0;j<{inputs[k]};j++)I{k}[j]=O{r}[j];" for r, k in carried.items()),
    ]
    end = [
        *(store(f"out{r}+b*{inputs[k]}", f"I{k}", inputs[k]) for r, k in carried.items() if r not in kept),
        *(store(f"out{r}+b*{widths[r]}", f"Q{r}", widths[r]) for r in (*totals, *growths)),
    ]
    pointers = [f"const S*in{k}" for k in range(len(loop.arguments))] + [f"S*out{r}" for r in range(len(results))]
    lines = [
        *links,
        f"void run(long samples,long stride,long steps,{','.join(pointers)}){{",
        *prelude,
        *(_zeros(f"A{r}", widths[r]) for r in summed),
        "for(long b=0;b<samples;b+=LANES){const long here=samples-b<LANES?samples-b:LANES;",
        *begin,
        f"for(long s=0;s<steps;s++){{const long at=b+({step})*stride;",
        *once,
        "}",
        *end,
        "}",
        *(store_sum(f"out{r}", f"A{r}", len(results[r].values)) for r in summed),
        "}",
    ]
    whole = ["#if PIECE==0", *lines, "#endif"] if functions else lines
    return "\n".join([c_prelude.text(single, few), *functions, *whole]) + "\n"


def _zeros(name: str, width: int) -> str:
    """Statement that defines an array of zeros."""
    return f"T {name}[{width}];for(int j=0;j<{width};j++){name}[j]=(T){{}};"


def _add_rows(to: str, at: str, width: int) -> str:
    """Statement that adds rows in memory to an array."""
    return f"{{T J[{width}];{load('J', at, width)}for(int j=0;j<{width};j++){to}[j]+=J[j];}}"


def printed(body: Program | Chain, single: bool) -> tuple[list[str], list[str], list[str], list[str]]:
    """Functions of the parts, those of the links of a chain, and the statements before the loop and within it."""
    if isinstance(body, Program):
        printer = Printer(body, single)
        parts, statements = printer.body(_rows(body))
        return parts, [], printer.prelude(), statements
    arrays = {a.name: f"{'in' if a.uniform else 'I'}{k}" for k, a in enumerate(body.arguments)}
    wanted = {name: f"O{k}" for k, name in enumerate((*body.wanted, GROWTH))}
    functions, links, prelude, calls, first = list[str](), list[str](), list[str](), list[str](), 0
    for m, (program, takes, gives) in enumerate(body.links):
        printer, uniform = Printer(program, single, first), [k for k, a in enumerate(program.arguments) if a.uniform]
        parts, statements = printer.body(_rows(program))
        functions, first = functions + parts, first + (len(printer.schedule.parts) if parts else 0)
        if lines := printer.prelude():
            links.append(f"static void shared{m}(S*u{''.join(f',const S*in{k}' for k in uniform)}){{")
            links += [*lines[1:], "}"]
            prelude.append(lines[0].replace("S u[", f"S u{m}["))
            prelude.append(f"shared{m}({','.join([f'u{m}', *(arrays[takes[k]] for k in uniform)])});")
        given, found = [k for k, _ in _rows(program)], outputs(program)
        names = [f"const T*I{k}" for k in given] + [f"T*O{k}" for k in range(len(found))]
        # a function of its own, so that no operation is contracted with those of other links
        links.append(f"static __attribute__((noinline)) void link{m}({','.join(['const S*u', *names])}){{")
        links += [*statements, "}"]
        taken = [arrays[takes[k]] for k in given]
        for k, (result, name) in enumerate(zip(found, (*gives, GROWTH), strict=False)):
            arrays[name] = wanted.get(name, f"M{m}_{k}")
            if name not in wanted:
                calls.append(f"T {arrays[name]}[{max(len(result.values), 1)}];")
        made = [arrays[name] for name in (*gives, GROWTH)[: len(found)]]
        calls.append(f"link{m}({','.join([f'u{m}' if lines else '0', *taken, *made])});")
    return functions, links, prelude, calls


def _rows(program: Program) -> list[tuple[int, int]]:
    """Arguments that differ from sample to sample, and their widths."""
    return [(k, a.width) for k, a in enumerate(program.arguments) if not a.uniform and a.width]
