"""C source of a loop: the samples outside, the steps inside, and what is carried in arrays that stay in the cache."""

from torchdq.backends import c_prelude
from torchdq.backends.c_source import Printer, add, load, store, store_sum
from torchdq.program.loop import Loop
from torchdq.program.program import outputs


def loop_source(loop: Loop, single: bool) -> str:
    """C source of a loop in double or single precision.

    It defines `run`, which takes the number of samples, that of the samples in the arrays, the number of steps, and a
    pointer per argument and per output: dense arrays [samples, width], [steps, samples, width] or [width]; the last
    output is the largest error growth of every sample, if the body has one.
    """
    printer, body, results = Printer(loop.body, single), loop.body, outputs(loop.body)
    widths = {k: a.width for k, a in enumerate(body.arguments) if not a.uniform and a.width}
    wide = [max(len(r.values), 1) for r in results]  # a result without values still needs an array to name
    functions, statements = printer.body(list(widths.items()))
    pointers = [f"const S*in{k}" for k in range(len(loop.arguments))] + [f"S*out{k}" for k in range(len(results))]
    zero = "T {0}[{1}];for(int j=0;j<{1};j++){0}[j]=(T){{}};"
    summed = [k for k, r in enumerate(results) if r.summed]
    starts = {r: k for k, r in loop.carried if k in widths}
    ends = [(r, k) for r, k in starts.items() if r not in loop.kept]
    total = [r for r, x in enumerate(body.results) if not (x.summed or r in starts or r in loop.kept or not x.values)]
    growth = len(body.results) if body.growth is not None else None
    before, after = ("at+stride", "at") if loop.backwards else ("at", "at+stride")
    lines = [
        *(["#if PIECE==0"] if functions else []),
        f"void run(long samples,long stride,long steps,{','.join(pointers)}){{",
        *printer.prelude(),
        *(zero.format(f"A{k}", wide[k]) for k in summed),
        "for(long b=0;b<samples;b+=LANES){const long here=samples-b<LANES?samples-b:LANES;",
        *(f"T I{k}[{w}];" for k, w in widths.items()),
        *(load(f"I{k}", f"in{k}+b*{w}", w) for k, w in widths.items() if k not in loop.stepped),
        *(zero.format(f"Q{k}", wide[k]) for k in total),
        "T G[1]={(T){}};" if growth is not None else "",
        f"{{const long at=b{'+(steps-1)*stride' if loop.backwards else ''};",
        *(store(f"out{r}+({before})*{widths[k]}", f"I{k}", widths[k]) for r, k in starts.items() if r in loop.kept),
        "}",
        f"for(long s=0;s<steps;s++){{const long at=b+{'(steps-1-s)' if loop.backwards else 's'}*stride;",
        *(load(f"I{k}", f"in{k}+at*{w}", w) for k, w in widths.items() if k in loop.stepped),
        *(
            f"{{T J[{widths[k]}];{load('J', f'in{more}+at*{widths[k]}', widths[k])}"
            f"for(int j=0;j<{widths[k]};j++)I{k}[j]+=J[j];}}"
            for more, k in enumerate(loop.added, len(body.arguments))
            if k in widths
        ),
        *(f"T O{k}[{w}];" for k, w in enumerate(wide)),
        *statements,
        *(
            store(f"out{r}+({after if r in starts else 'at'})*{wide[r]}", f"O{r}", wide[r])
            for r in loop.kept
            if body.results[r].values
        ),
        *(add(f"A{k}", f"O{k}", wide[k]) for k in summed),
        *(f"for(int j=0;j<{wide[k]};j++)Q{k}[j]+=O{k}[j];" for k in total),
        f"G[0]=max_(G[0],O{growth}[0]);" if growth is not None else "",
        *(f"for(int j=0;j<{widths[k]};j++)I{k}[j]=O{r}[j];" for r, k in starts.items()),
        "}",
        *(store(f"out{r}+b*{widths[k]}", f"I{k}", widths[k]) for r, k in ends),
        *(store(f"out{k}+b*{wide[k]}", f"Q{k}", wide[k]) for k in total),
        store(f"out{growth}+b", "G", 1) if growth is not None else "",
        "}",
        *(store_sum(f"out{k}", f"A{k}", len(results[k].values)) for k in summed),
        "}",
        *(["#endif"] if functions else []),
    ]
    return "\n".join([c_prelude.text(single), *functions, *lines]) + "\n"
