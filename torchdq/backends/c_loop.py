"""C source of a program: a loop of one step or of many, with the samples outside and the steps inside.

Whether an argument is the same at all steps, given for every step or carried from one to the next, and which results
are kept, is decided at every call, so that one library serves all calls of a program: a single evaluation is one step.
What a step carries are results that have the name of an argument, unless the loop is an adjoint, which says it. The
values of a step are a function of its own, so that no operation is contracted with those of other links of a chain,
whose library calls long ones by their address.
"""

from __future__ import annotations

from typing import NamedTuple

from torchdq.backends import c_prelude
from torchdq.backends.c_source import LONGEST, Printer
from torchdq.program.loop import Chain, Loop
from torchdq.program.program import GROWTH, Program, outputs

NOINLINE = "static __attribute__((noinline))"
# how a call takes an argument; a result is the last if constant
CONSTANT, OF_EVERY_STEP, CARRIED, TOTAL, COMMON = range(5)


class Body(NamedTuple):
    """All of a loop that its library depends on."""

    program: Program | Chain
    carried: tuple[tuple[int, int], ...]  # arguments that may be carried, and the results that they take
    backwards: bool = False
    added: tuple[int, ...] = ()


def body_of(what: Program | Loop) -> Body:
    """Body of a program or a loop: the same for all that carry what has one name, or nothing."""
    program = what.body if isinstance(what, Loop) else what
    results = [r.name for r in program.results]
    same = tuple([(k, results.index(a.name)) for k, a in enumerate(program.arguments) if a.name in results])
    same = tuple([(k, r) for k, r in same if len(program.results[r].values) == program.arguments[k].width])
    if isinstance(what, Loop) and (what.backwards or what.added or not {*what.carried} <= {*same}):
        return Body(program, what.carried, what.backwards, what.added)
    return Body(program, same)


def taken_as(loop: Loop) -> tuple[int, ...]:
    """How the arguments and outputs of the body are taken by a loop, as its plan has it."""
    states = {r: k for k, r in loop.carried}
    kinds = ((CARRIED, states.values()), (COMMON, loop.common), (OF_EVERY_STEP, loop.stepped))
    found = [next((how for how, among in kinds if k in among), CONSTANT) for k, _ in enumerate(loop.body.arguments)]
    for r, _ in enumerate(outputs(loop.body)):
        found.append(OF_EVERY_STEP if r in loop.kept else CONSTANT if r in states else TOTAL)
    return tuple(found)


def source(what: Program | Loop | Body, single: bool, few: bool = False) -> str:
    """C source of a program or a loop in double or single precision, for few samples or any number.

    It defines `run`, which takes the number of samples, a plan, and a pointer per argument and per output: dense arrays
    [samples, width], [steps, samples, width], [steps, 1, width] or [width]. The plan holds the number of steps, that of
    the samples in the arrays, and how each argument and output is taken, which is as of every step where the plan is
    null; then for each long link of a chain the addresses in `parts` of its library. `parts` are the functions of what
    is the same for all samples, and of the values of a step. The last output is the largest error growth of every
    sample, if the body has one.
    """
    body = what if isinstance(what, Body) else body_of(what)
    program, results = body.program, outputs(body.program)
    inputs = {k: a.width for k, a in enumerate(program.arguments) if not a.uniform and a.width}
    widths = [max(len(r.values), 1) for r in results]  # a result without values still needs an array to name
    first, places = len(program.arguments), len(program.arguments) + len(results)
    summed = [r for r, x in enumerate(results) if x.summed]
    rows = [r for r, x in enumerate(results) if x.values and not x.summed]
    functions, parts, prelude, calls = _printed(program, single, places)
    once = list[str]()
    for k, w in inputs.items():
        each, common = f"how[{k}]=={OF_EVERY_STEP}", f"how[{k}]=={COMMON}"
        once.append(f"if({common})read{w}(I{k},in{k}+now*{w},1);")
        once.append(f"else if(!s||{each})read{w}(I{k},in{k}+(b+({each})*row)*{w},left);")
    for i, k in enumerate(body.added, first):
        w = inputs.get(k, 0)
        once.append(f"{{T J[{w}];read{w}(J,in{i}+at*{w},left);for(int j=0;j<{w};j++)I{k}[j]+=J[j];}}" if w else "")
    once += calls
    for r in rows:
        kind, how = ("growth", 0) if r == len(program.results) else (f"keep{widths[r]}", f"how[{first + r}]")
        wanted = f"if({how}||s==steps-1)" if how else ""  # no call for what is only wanted of the last step
        once.append(f"{wanted}{kind}(out{r},Q{r},O{r},b,row,ahead,left,s,steps,{how});")
    once += [f"add{widths[r]}(A{r},O{r},left);" for r in summed]
    once += [
        f"if(how[{k}]=={CARRIED})for(int j=0;j<{widths[r]};j++)I{k}[j]=O{r}[j];" for k, r in body.carried if k in inputs
    ]
    pointers = [f"const S*in{k}" for k in range(first + len(body.added))] + [f"S*out{k}" for k in range(len(results))]
    lines = [
        *map(_read, sorted({*inputs.values()})),
        *map(_keep, sorted({widths[r] for r in rows})),
        *map(_add, sorted({widths[r] for r in summed})),
        _GROWTH if program.growth is not None else "",
        *parts,
        f"void run(word samples,const word*plan,{','.join(pointers)}){{",
        f"static const word alone[]={{1,0{f',{OF_EVERY_STEP}' * places}}};if(!plan)plan=alone;",
        f"const word steps=plan[0],stride=plan[1],ahead={'-' * body.backwards}stride,*how=plan+2;",
        *prelude,
        *(f"T A{r}[{widths[r]}];for(int j=0;j<{widths[r]};j++)A{r}[j]=(T){{}};" for r in summed),
        "for(word b=0;b<samples;b+=LANES){const word left=samples-b;",
        *(f"T I{k}[{w}];" for k, w in inputs.items()),
        *(f"T O{r}[{w}];" for r, w in enumerate(widths)),
        *(f"T Q{r}[{widths[r]}];" for r in rows),
        f"for(word s=0;s<steps;s++){{const word now={'steps-1-s' if body.backwards else 's'};",
        "const word row=now*stride,at=b+row;",
        *once,
        "}}",
        *(
            f"for(int j=0;j<{widths[r]};j++){{S t=0;for(int l=0;l<LANES;l++)t+=A{r}[j][l];out{r}[j]=t;}}"
            for r in summed
        ),
        "}",
    ]
    whole = ["#if PIECE==0", *lines, "#endif"] if functions else lines
    return "\n".join([c_prelude.text(single, few), *functions, *whole]) + "\n"


# --- functions of rows of a width, for the samples in the lanes of a vector, of which `left` or more are left ---------


def _read(w: int) -> str:
    """Function that reads rows; idle lanes repeat the last sample, so that every sample takes the same code."""
    return (
        f"{NOINLINE} void read{w}(T*to,const S*from,word left){{"
        f"if(left>=LANES+(TILE+{w - 1})/{w})load(to,from,{w});else{{const word last=(left<LANES?left:LANES)-1;"
        f"for(int l=0;l<LANES;l++)for(int j=0;j<{w};j++)to[j][l]=from[(l<=last?l:last)*{w}+j];}}}}"
    )


_KEPT = "S*to,T*sums,const T*of,word b,word row,word ahead,word left,word s,word steps,word how"


def _keep(w: int) -> str:
    """Function that writes the rows of a step, or the last or the totals of all steps after the last.

    Memory of the next step is asked for in advance: otherwise every step would wait for it.
    """
    return (
        f"{NOINLINE} void keep{w}({_KEPT}){{"
        f"if(how=={TOTAL}){{for(int j=0;j<{w};j++)sums[j]=s?sums[j]+of[j]:of[j];of=sums;}}"
        f"if(how!={OF_EVERY_STEP}){{if(s<steps-1)return;row=0;}}"
        f"to+=(b+row)*{w};if(left>=LANES){{"
        f"if(s<steps-1)for(int j=0;j<={w}*BYTES;j+=64)__builtin_prefetch((char*)(to+ahead*{w})+j,1);"
        f"store(to,of,{w});}}else for(int l=0;l<left;l++)for(int j=0;j<{w};j++)to[l*{w}+j]=of[j][l];}}"
    )


def _add(w: int) -> str:
    """Function that adds rows, without those of idle lanes, to sums in the lanes."""
    return (
        f"{NOINLINE} void add{w}(T*to,const T*of,word left){{"
        f"if(left>=LANES)for(int j=0;j<{w};j++)to[j]+=of[j];"
        f"else for(int j=0;j<{w};j++)for(int l=0;l<left;l++)to[j][l]+=of[j][l];}}"
    )


# largest error growth of all steps
_GROWTH = (
    f"{NOINLINE} void growth({_KEPT}){{"
    "sums[0]=s?max_(sums[0],of[0]):of[0];if(s==steps-1)for(int l=0;l<LANES&&l<left;l++)to[b+l]=sums[0][l];}"
)


# --- the values of a step --------------------------------------------------------------------------------------------


def long(program: Program) -> bool:
    """Whether a link has a library of its own, shared with other calls of it, or is a function in that of the chain."""
    return len(program.ops) > LONGEST


def _printed(body: Program | Chain, single: bool, place: int) -> tuple[list[str], list[str], list[str], list[str]]:
    """Functions of long programs, `parts` or links, and the statements before the loop and within it.

    Addresses of the parts of long links are in the plan from `place` on.
    """
    if isinstance(body, Program):
        functions, parts, u = _functions(body, single, "")
        taken, made = [f"I{k}" for k, _ in _rows(body)], [f"O{k}" for k, _ in enumerate(outputs(body))]
        before = [u, f"shared({','.join(['u', *(f'in{k}' for k in _uniform(body))])});"] if u else []
        parts.append(f"void*const parts[]={{{'(void*)shared' if u else '0'},(void*)step}};")
        return functions, parts, before, [f"step({','.join(['u' if u else '0', *taken, *made])});"]
    arrays = {a.name: f"{'in' if a.uniform else 'I'}{k}" for k, a in enumerate(body.arguments)}
    wanted = {name: f"O{k}" for k, name in enumerate((*body.wanted, GROWTH))}
    links, before, calls = list[str](), list[str](), list[str]()
    for m, (program, takes, gives) in enumerate(body.links):
        found, shared = outputs(program), [arrays[takes[k]] for k in _uniform(program)]
        taken = [arrays[takes[k]] for k, _ in _rows(program)]
        for k, (result, name) in enumerate(zip(found, (*gives, GROWTH), strict=False)):
            arrays[name] = wanted.get(name, f"M{m}_{k}")
            if name not in wanted:
                calls.append(f"T {arrays[name]}[{max(len(result.values), 1)}];")
        made = [arrays[name] for name in (*gives, GROWTH)[: len(found)]]
        if long(program):
            prelude, step = f"how[{place}]", f"how[{place + 1}]"
            place += 2
            links.append(f"typedef void Shared{m}({','.join(['S*', *['const S*'] * len(shared)])});")
            links.append(
                f"typedef void Step{m}({','.join(['const S*', *['const T*'] * len(taken), *['T*'] * len(found)])});"
            )
            before.append(f"S u{m}[{len(program.ops)}];")
            before.append(f"if({prelude})((Shared{m}*){prelude})({','.join([f'u{m}', *shared])});")
            calls.append(f"((Step{m}*){step})({','.join([f'u{m}', *taken, *made])});")
        else:
            _, parts, u = _functions(program, single, str(m))
            links += parts
            before += [u, f"shared{m}({','.join([f'u{m}', *shared])});"] if u else []
            calls.append(f"step{m}({','.join([f'u{m}' if u else '0', *taken, *made])});")
    return [], links, before, calls


def _functions(program: Program, single: bool, m: str) -> tuple[list[str], list[str], str]:
    """Functions of a long program, those of the values of a step, numbered m, and the array of shared values, or ""."""
    printer = Printer(program, single)
    functions, statements = printer.body(_rows(program))
    prelude = printer.prelude()
    parts = list[str]()
    if prelude:
        parts += [f"{NOINLINE} void shared{m}({','.join(['S*u', *(f'const S*in{k}' for k in _uniform(program))])}){{"]
        parts += [*prelude[1:], "}"]
    rows = [f"const T*I{k}" for k, _ in _rows(program)] + [f"T*O{k}" for k, _ in enumerate(outputs(program))]
    parts += [f"{NOINLINE} void step{m}({','.join(['const S*u', *rows])}){{", *statements, "}"]
    return functions, parts, prelude[0].replace("S u[", f"S u{m}[") if prelude else ""


def _rows(program: Program) -> list[tuple[int, int]]:
    """Arguments that differ from sample to sample, and their widths."""
    return [(k, a.width) for k, a in enumerate(program.arguments) if not a.uniform and a.width]


def _uniform(program: Program) -> list[int]:
    """Arguments that are the same for all samples."""
    return [k for k, a in enumerate(program.arguments) if a.uniform]
