"""Options and reports of all benchmarks: options, tables, the machine; pages and JSON files."""

import argparse
import importlib.metadata
import json
import math
import os
import platform
import shutil
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
Line = tuple[str, str]  # what, and what was measured


class Comparison(NamedTuple):
    """Times of a task [ns], of torchdq and of another package."""

    task: str
    ours: float
    theirs: float
    package: str


def parser(document: str, quick: str, page: bool = True) -> argparse.ArgumentParser:
    """Parser of the options that benchmarks share; `quick` is the help of --quick, and not all write into a page."""
    found = argparse.ArgumentParser(description=document.splitlines()[0])
    found.add_argument("--quick", action="store_true", help=quick)
    found.add_argument("--json", type=Path, help="write everything here")
    if page:
        found.add_argument("--page", action="store_true", help="write the table into its page of the documentation")
    return found


def least(
    calls: Mapping[str, tuple[Callable[[], object], float]],
    turns: int = 3,
    seconds: float = 0.0,
    shortest: float = 0.0,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, float]:
    """Least times of calls [ns], each over the number that is given with it; processor times, unless there are threads.

    The calls take turns, at least so many and for at least so many seconds, so that load on the machine affects all of
    them alike; the least time counts, since others only add to it. A turn lasts at least the shortest time [s].
    """
    repeats = dict.fromkeys(calls, 1)
    for name, (call, _) in calls.items():
        call()
        begin = clock()
        while clock() - begin < shortest:
            call()
            repeats[name] += 1
    best, end = dict.fromkeys(calls, math.inf), time.perf_counter() + seconds
    while turns > 0 or time.perf_counter() < end:
        turns -= 1
        for name, (call, per) in calls.items():
            begin = clock()
            for _ in range(repeats[name]):
                call()
            best[name] = min(best[name], (clock() - begin) / repeats[name] / per * 1e9)
    return best


def table(title: str, lines: Sequence[Line]) -> str:
    """Measurements as a table."""
    rows = "\n".join(f"| {what} | {found} |" for what, found in lines)
    return f"| {title} | measured |\n|---|---|\n{rows}"


def comparison(title: str, rows: Sequence[Comparison]) -> str:
    """Comparisons as a table; pages of the site draw bars in its column `ratio`."""
    lines = [
        f"| {row.task} | {row.ours:.1f} ns | {row.theirs:.0f} ns, {row.package} | {row.theirs / row.ours:.1f} x |"
        for row in rows
    ]
    return "\n".join([f"| {title} | torchdq | other package | ratio |", "|---|---|---|---|", *lines])


def spread(times: Sequence[float]) -> tuple[float, float, float]:
    """Median of times, and 10 % and 90 % of them."""
    low, *_, high = statistics.quantiles(times, n=10)
    return statistics.median(times), low, high


def finish(
    arguments: argparse.Namespace,
    script: str,
    text: str,
    facts: dict[str, str],
    how: str = "Measured on",
    **everything: Sequence[Any],
) -> None:
    """Print the machine; write a text into its page and everything into a JSON file, where the options ask for it."""
    print(f"\n{words(facts)}")
    if arguments.page:
        into_page(text, script, facts, how)
    into_json(arguments.json, machine=facts, **everything)


def into_json(path: Path | None, **everything: Any) -> None:
    """Write everything to a path, if there is one, to four digits."""
    if path:
        path.write_text(json.dumps(_short(everything), separators=(",", ":")) + "\n")


def _short(x: Any) -> Any:
    """Values with shorter numbers."""
    if isinstance(x, dict):
        return {key: _short(value) for key, value in x.items()}
    if isinstance(x, list | tuple):
        return [_short(value) for value in x]
    return float(f"{x:.4g}") if isinstance(x, float) else x


def marks(script: str) -> tuple[str, str]:
    """Comments of a page before and after the table of a script."""
    name = f"benchmarks/{Path(script).name}"
    return f"<!-- {name} begins -->", f"<!-- {name} ends -->"


def pages(script: str) -> list[Path]:
    """README and pages of the documentation that have the marks of a script."""
    every = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [path for path in every if marks(script)[0] in path.read_text(encoding="utf-8")]


def shown(script: str, page: Path | None = None) -> str:
    """Text between the marks of a script in a page; None: in the one page that has them."""
    if page is None:
        (page,) = pages(script)
    begin, end = marks(script)
    return page.read_text(encoding="utf-8").split(begin)[1].split(end)[0].strip()


def between_marks(text: str, script: str, page: Path | None = None) -> None:
    """Write a text between the marks of a script in a page; None: in the one page that has them."""
    if page is None:
        (page,) = pages(script)
    begin, end = marks(script)
    before, rest = page.read_text(encoding="utf-8").split(begin)
    page.write_text(f"{before}{begin}\n{text}\n{end}{rest.split(end)[1]}", encoding="utf-8")


def source(script: str, facts: dict[str, str], how: str = "Measured on") -> str:
    """Sentence on what measured a table, and where."""
    verb, by = how.split()
    return f"{verb} by `benchmarks/{Path(script).name}` {by}: {words(facts)}."


def into_page(text: str, script: str, facts: dict[str, str], how: str = "Measured on") -> None:
    """Write a text and its source into the page of a script."""
    between_marks(f"{text}\n\n{source(script, facts, how)}", script)


def words(facts: dict[str, str]) -> str:
    """Facts of a machine in one line."""
    return ", ".join(f"{name} {fact}" for name, fact in facts.items())


def machine(*packages: str) -> dict[str, str]:
    """Machine of the measurement: names and versions, also of further packages."""
    lines = [line.partition(":") for line in Path("/proc/cpuinfo").read_text().splitlines()]
    facts = {key.strip(): value.strip() for key, _, value in lines}
    widest = [name for name in ("avx512f", "avx2", "avx") if name in facts.get("flags", "").split()]
    compiler = shutil.which(os.environ.get("CC", "cc"))
    version = (
        subprocess.run([compiler, "--version"], capture_output=True, text=True).stdout.splitlines()[0]
        if compiler
        else "none"
    )
    return {
        "processor": facts.get("model name") or platform.processor(),
        "vector instructions": widest[0] if widest else "unknown",
        "cores": str(os.cpu_count()),
        "compiler": version,
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in ("torch", "pin", "numpy", *packages)},
    }
