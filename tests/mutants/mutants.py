"""Whether the suite would notice: faults are put into the sources one at a time, and it must turn red for each.

`make mutants` copies the tree, plants each fault of `mutants_table` in the copy, runs the tests that are expected to
notice, and shows which did. Before that every fault must fit the sources, every row of `errata_table` must be put back
by one, and the same tests must be green without any. The exit status is 0 only if no fault survives.

    python tests/mutants/mutants.py [--only NAME ...] [--list] [--json FILE] [-j N]
"""

import argparse
import json
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import hypothesis
import pytest
from errata_table import ERRATA
from mutants_table import MUTANTS, WITHOUT_COUNTERPART, Mutant
from places import ROOT
from rich.console import Console
from rich.progress import track
from rich.table import Table

NEEDED = ("torchdq", "envs", "tests", "examples", "pyproject.toml")  # copied, so that the tests run on the copy
# imported once, by the process that those of the tests are forked from
HEAVY = ["torch", "pinocchio", "scipy.stats", "mujoco", "hypothesis", "mpmath", "gymnasium", "pytest"]
FRESH = multiprocessing.get_context("forkserver")
LIMIT = 120.0  # of the tests of one fault [s]
FOREIGN = 70  # exit status of tests that ran on sources from elsewhere

KILLED, AT_IMPORT, SURVIVED, LATE, CRASHED, BROKEN = (
    "killed",
    "killed at import",
    "survived",
    "timed out",
    "crashed",
    "not run",
)


# --- a copy of the tree, and its tests --------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """What became of the tests."""

    result: str
    test: str  # the first that failed
    seconds: float
    output: str


class Copy:
    """A copy of the tree, with a cache of compiled programs of its own."""

    def __init__(self, folder: Path):
        self.folder = folder
        for name in NEEDED:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(ROOT / name, folder / name)
        # found where it lies, not where an installation says
        (folder / "torchdq" / "envs").symlink_to(folder / "envs", target_is_directory=True)
        (folder / "cache").mkdir(mode=0o700)

    @contextmanager
    def planted(self, mutant: Mutant) -> Iterator[None]:
        """The copy with a fault, and afterwards without."""
        path = self.folder / mutant.file
        text = path.read_text(encoding="utf-8")
        self.write(path, text.replace(mutant.old, mutant.new))
        try:
            yield
        finally:
            self.write(path, text)

    def write(self, path: Path, text: str) -> None:
        """Write a source, and remove what Python compiled of it: a fault may have its size and its second."""
        path.write_text(text, encoding="utf-8")
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
            compiled.unlink()

    def test(self, tests: Iterable[str], limit: float, *options: str) -> Outcome:
        """Outcome of tests, in a process that has imported nothing of the package before."""
        start, log = time.perf_counter(), self.folder / "log"
        process = FRESH.Process(target=run, args=(self.folder, ["-q", "-p", "no:cacheprovider", *options, *tests]))
        process.start()
        process.join(limit)
        late = process.is_alive()
        process.kill()
        process.join()
        seconds, output, status = time.perf_counter() - start, log.read_text(errors="replace"), process.exitcode or 0
        failed = re.search(r"^(?:FAILED|ERROR) (.*?\.py(?:::.*?)?)(?: - |$)", output, re.MULTILINE)
        if late:
            result = LATE
        elif status < 0:
            result = CRASHED
        elif status < 2:
            result = KILLED if status else SURVIVED
        else:  # the tests were not collected; otherwise there is no such test, or the sources were others
            result = AT_IMPORT if status == 2 or "while loading conftest" in output else BROKEN
        return Outcome(result, failed[1] if failed else "", seconds, output)


def run(folder: Path, arguments: list[str]) -> None:
    """Run pytest in a copy, in a process of its own, which ends with pytest's status."""
    with (folder / "log").open("wb") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    os.chdir(folder)
    sys.dont_write_bytecode = False  # what is compiled of the copy serves all faults
    os.environ |= {"PYTHONPATH": str(folder), "TORCHDQ_CACHE": str(folder / "cache"), "COLUMNS": "200"}
    sys.path[:] = [str(folder), *(path for path in sys.path if path != str(ROOT / "tests"))]
    # a counterexample need not be the smallest, and every run tries the same examples
    hypothesis.settings.register_profile("planted", phases=(hypothesis.Phase.generate,), derandomize=True)
    hypothesis.settings.load_profile("planted")
    sys.exit(pytest.main(arguments, plugins=[Here()]))


class Here:
    """What pytest is told besides: all that was imported of the package must lie in the copy."""

    def pytest_sessionfinish(self, session) -> None:
        """End with a status of its own if it does not."""
        package = [module for name, module in sys.modules.items() if name.partition(".")[0] == "torchdq"]
        root = os.path.realpath(session.config.rootpath) + os.sep
        if not all(os.path.realpath(str(module.__file__)).startswith(root) for module in package):
            session.exitstatus = FOREIGN


# --- before any test --------------------------------------------------------------------------------------------------


def objections(mutants: Iterable[Mutant]) -> list[str]:
    """What is wrong with the table: faults that do not fit the sources, and errata that nothing puts back."""
    found = []
    names = [mutant.name for mutant in MUTANTS]
    found += [f"{name!r}: two faults have this name" for name in sorted({n for n in names if names.count(n) > 1})]
    for mutant in mutants:
        path = ROOT / mutant.file
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        count = text.count(mutant.old)
        if count != 1:
            found.append(
                f"{mutant.name!r}: its code occurs {count} times in {mutant.file}, must once; correct the table"
            )
            continue
        try:
            compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
        except SyntaxError as error:
            found.append(f"{mutant.name!r}: it is no Python in line {error.lineno}")
    keys, put_back = {row.key for row in ERRATA}, {mutant.erratum for mutant in MUTANTS} - {""}
    for key in sorted(keys - put_back - WITHOUT_COUNTERPART.keys()):
        found.append(f"erratum {key}: no fault puts it back, and it is not named as without counterpart")
    for key in sorted((put_back | WITHOUT_COUNTERPART.keys()) - keys):
        found.append(f"erratum {key}: not in the table of errata")
    for key in sorted(put_back & WITHOUT_COUNTERPART.keys()):
        found.append(f"erratum {key}: put back by a fault, and named as without counterpart")
    return found


# --- all of them ------------------------------------------------------------------------------------------------------


def killed(mutant: Mutant, outcome: Outcome) -> bool:
    """Whether the suite noticed."""
    return outcome.result in (KILLED, AT_IMPORT) or (mutant.fatal and outcome.result in (LATE, CRASHED))


def spread(work: Callable, items: Iterable, copies: list[Copy], title: str, console: Console) -> list:
    """Results of the work on every item, in their order, each item with a copy that nobody else uses."""
    free: SimpleQueue[Copy] = SimpleQueue()
    for copy in copies:
        free.put(copy)

    def one(item):
        copy = free.get()
        try:
            return work(copy, item)
        finally:
            free.put(copy)

    with ThreadPoolExecutor(len(copies)) as pool:
        futures = [pool.submit(one, item) for item in items]
        try:
            for _ in track(as_completed(futures), title, len(futures), console=console, transient=True):
                pass
            return [future.result() for future in futures]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def examine(copy: Copy, mutant: Mutant) -> Outcome:
    """Outcome of the tests of a fault."""
    with copy.planted(mutant):
        return copy.test(mutant.tests, LIMIT, "-x")


def shown(mutants: list[Mutant], outcomes: list[Outcome]) -> Table:
    """Table of the faults and what noticed them."""
    table = Table("fault", "file", "result", "first failing test", "s")
    for mutant, outcome in zip(mutants, outcomes, strict=True):
        style = None if killed(mutant, outcome) else "bold red"
        test = outcome.test.removeprefix("tests/")
        table.add_row(mutant.name, mutant.file, outcome.result, test, f"{outcome.seconds:.1f}", style=style)
    return table


def main() -> int:
    """Exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", metavar="NAME", action="append", help="this fault, and no other; may be repeated")
    parser.add_argument("--list", action="store_true", help="list the faults, and run nothing")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the outcomes to a file")
    parser.add_argument("-j", metavar="N", type=int, default=os.cpu_count() or 1, help="faults examined at a time")
    options = parser.parse_args()
    console = Console(markup=False, highlight=False, **({} if sys.stdout.isatty() else {"width": 200}))
    mutants = [mutant for mutant in MUTANTS if not options.only or mutant.name in options.only]
    found = objections(mutants)
    found += [
        f"{name!r}: there is no such fault" for name in options.only or () if name not in {m.name for m in MUTANTS}
    ]
    if found:
        console.print("\n".join(found))
        return 1
    if options.list:
        console.print("\n".join(f"{mutant.file}: {mutant.name}" for mutant in mutants))
        return 0
    start = time.perf_counter()
    os.environ["OMP_NUM_THREADS"] = "1"
    FRESH.set_forkserver_preload(HEAVY)
    with tempfile.TemporaryDirectory(prefix="torchdq-mutants-") as folder:
        copies = [Copy(Path(folder, str(k))) for k in range(max(options.j, 1)) if Path(folder, str(k)).mkdir() is None]
        tests = sorted({test for mutant in mutants for test in mutant.tests})
        files = sorted({test.partition("::")[0] for test in tests})
        by_file = [[test for test in tests if test.partition("::")[0] == file] for file in files]
        for healthy in spread(lambda copy, some: copy.test(some, 10 * LIMIT), by_file, copies, "without", console):
            if healthy.result != SURVIVED:
                console.print(f"{healthy.output[-4000:]}\n{healthy.result}: the tests must be green without a fault")
                return 1
        outcomes = spread(examine, mutants, copies, "faults", console)
    console.print(shown(mutants, outcomes))
    score = sum(map(killed, mutants, outcomes))
    for mutant, outcome in zip(mutants, outcomes, strict=True):
        if outcome.result == BROKEN:
            console.print(f"{mutant.name}: its tests did not run\n{outcome.output[-2000:]}")
    console.print(f"{score}/{len(mutants)} killed in {time.perf_counter() - start:.0f} s")
    if options.json:
        rows = [
            mutant._asdict() | outcome._replace(output="")._asdict() | {"killed": killed(mutant, outcome)}
            for mutant, outcome in zip(mutants, outcomes, strict=True)
        ]
        options.json.write_text(json.dumps({"killed": score, "of": len(mutants), "mutants": rows}, indent=1))
    return 0 if score == len(mutants) else 1


if __name__ == "__main__":
    sys.exit(main())
