"""Whether the suite would notice: faults are put into the sources one at a time, and it must turn red for each.

`make mutants` copies the tree, plants each fault in the copy, runs the tests that are expected to notice, and shows
which did. Before that every fault must fit the sources, every row of `errata_table` must be put back by one, and the
same tests must be green without any. The exit status is 0 only if no fault survives.

    python tests/mutants/mutants.py [--only NAME ...] [--changed [REF]] [--check] [-j N]

The faults are lines of the text files in this folder:

    torchdq/dynamics/tree.py < claims/test_moving_base.py
      name  |  Class.function  |  old  ->  new  |  ::test_that_notices

A source and the file of tests for it are followed by its faults. `old` is found as words and signs, whatever stands
between them, once in the function or else once in the source. A test of another file is given with its file; without
any, the whole file runs, and also if the test is no more. A name that begins with a key of the errata and a colon puts
that row back; one with `!` may end the tests by a crash or never. ⏎ is the end of a line.
"""

import argparse
import ast
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import accumulate
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import hypothesis
import pytest
from rich.console import Console
from rich.progress import track
from rich.table import Table

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent / "paper"), str(HERE.parent / "tools")]
from errata_table import ERRATA  # noqa: E402
from places import ROOT, TESTS  # noqa: E402

NEEDED = ("torchdq", "tests", "examples", "pyproject.toml")  # copied, so that the tests run on the copy
# imported once, by the process that those of the tests are forked from
HEAVY = ["torch", "pinocchio", "scipy.stats", "mujoco", "hypothesis", "mpmath", "gymnasium", "pytest"]
FRESH = multiprocessing.get_context("forkserver")
LIMIT = 120.0  # of the tests of one fault [s]
FOREIGN = 70  # exit status of tests that ran on sources from elsewhere
KILLED, AT_IMPORT, SURVIVED = "killed", "killed at import", "survived"
LATE, CRASHED, BROKEN = "timed out", "crashed", "not run"
WITHOUT_COUNTERPART = {
    "11": "the package multiplies matrices of any shapes; which of two columns is transposed is the caller's to say",
    "30 two-link arm": "the same form as 30, measured on another robot",
    "42": "no rate of a pose is written down: it is what autograd makes of (38); (44), which follows, is put back",
    "A1 every line as printed": "several lines at once; each is put back alone",
}


# --- the faults -------------------------------------------------------------------------------------------------------


class Misfit(Exception):
    """A fault whose place is not in the sources."""


class Mutant(NamedTuple):
    """A fault in one place of one file."""

    name: str
    file: str
    place: str  # class and function
    old: str
    new: str
    test: str  # pytest's argument, from the folder of tests

    @property
    def erratum(self) -> str:
        """Key of the erratum that it puts back, if it is one."""
        key, colon, _ = self.name.partition(":")
        return key if colon else ""

    def planted(self, text: str) -> str:
        """The text of the file with the fault."""
        everywhere = (0, len(text))
        found = occurrences(text, self.old, *spans(text).get(self.place, everywhere))
        if len(found) != 1:
            found = occurrences(text, self.old, *everywhere)
        if len(found) != 1:
            raise Misfit(f"{self.name!r}: {self.old!r} occurs {len(found)} times in {self.file}")
        ((first, last),) = found
        return text[:first] + self.new + text[last:]

    def noticing(self) -> str:
        """Test that is to notice it; the file where it is no more."""
        file, _, test = self.test.partition("::")
        known = tests_of(file)
        return f"tests/{self.test}" if test.partition("[")[0] in known else f"tests/{file}"


def tokens(text: str) -> list[tuple[str, int, int]]:
    """Words and signs with their places, without commas that only end a list over several lines."""
    found = [(m[0], m.start(), m.end()) for m in re.finditer(r"\w+|[^\w\s]", text)]
    closed = {k for k in range(len(found) - 1) if found[k][0] == "," and found[k + 1][0] in ")]}"}
    return [token for k, token in enumerate(found) if k not in closed]


def occurrences(text: str, code: str, begin: int, end: int) -> list[tuple[int, int]]:
    """Places of code, whatever stands between its words and signs, in a part of a text."""
    pattern = [token for token, _, _ in tokens(code)]
    found = [token for token in tokens(text) if begin <= token[1] and token[2] <= end]
    words = [token[0] for token in found]
    starts = [k for k, word in enumerate(words) if word == pattern[0] and words[k : k + len(pattern)] == pattern]
    return [(found[k][1], found[k + len(pattern) - 1][2]) for k in starts]


@cache
def spans(text: str) -> dict[str, tuple[int, int]]:
    """First and last character of each class and function of a source, by its qualified name."""
    lines = [0, *accumulate(len(line) for line in text.splitlines(keepends=True))]
    found: dict[str, tuple[int, int]] = {}

    def visit(node: ast.AST, path: str) -> None:
        for child in ast.iter_child_nodes(node):
            inner = path
            if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                inner = f"{path}.{child.name}".lstrip(".")
                first = min([child.lineno, *(one.lineno for one in child.decorator_list)])
                found[inner] = (lines[first - 1], lines[child.end_lineno or child.lineno])
            visit(child, inner)

    visit(ast.parse(text), "")
    return found


@cache
def tests_of(file: str) -> set[str]:
    """Names of functions and classes in a file of tests."""
    path = TESTS / file
    nodes = ast.walk(ast.parse(path.read_text())) if path.is_file() else ()
    return {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}


def read() -> list[Mutant]:
    """All faults."""
    found, source, tests = [], "", ""
    for path in sorted(HERE.glob("*.txt")):
        for line in path.read_text(encoding="utf-8").splitlines():
            if not line.startswith(" "):
                source, _, tests = line.partition(" < ")
                continue
            name, place, change, test = (*(part.strip() for part in line.split("  |  ")), "::")[:4]
            old, _, new = change.replace("⏎", "\n").partition("  ->  ")
            where = (tests + test if test.startswith("::") else test).removesuffix("::")
            found.append(Mutant(name, source, place, old, "" if new == "(nothing)" else new, where))
    return found


def objections(mutants: Iterable[Mutant], everything: list[Mutant]) -> list[str]:
    """What is wrong with the tables: faults that do not fit the sources, and errata that nothing puts back."""
    names = [mutant.name for mutant in everything]
    found = [f"{name!r}: two faults have this name" for name in sorted({n for n in names if names.count(n) > 1})]
    for mutant in mutants:
        path = ROOT / mutant.file
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        try:
            compile(mutant.planted(text), mutant.file, "exec")
        except Misfit as error:
            found.append(f"{error}{elsewhere(mutant)}")
        except SyntaxError as error:
            found.append(f"{mutant.name!r}: it is no Python in line {error.lineno}")
        if not (TESTS / mutant.test.partition("::")[0]).exists():
            found.append(f"{mutant.name!r}: there is no tests/{mutant.test}")
    keys, put_back = {row.key for row in ERRATA}, {mutant.erratum for mutant in everything} - {""}
    for key in sorted(keys - put_back - WITHOUT_COUNTERPART.keys()):
        found.append(f"erratum {key}: no fault puts it back, and it is not named as without counterpart")
    for key in sorted((put_back | WITHOUT_COUNTERPART.keys()) - keys):
        found.append(f"erratum {key}: not in the table of errata")
    for key in sorted(put_back & WITHOUT_COUNTERPART.keys()):
        found.append(f"erratum {key}: put back by a fault, and named as without counterpart")
    return found


def uncollected(tests: Iterable[str]) -> set[str]:
    """Tests with a parameter that pytest does not collect any more, since it was renamed."""
    wanted = {test for test in tests if "[" in test}
    files = sorted({test.partition("::")[0] for test in wanted})
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", *files]
    return wanted - set(subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.splitlines())


def elsewhere(mutant: Mutant) -> str:
    """Where the code of a fault stands now, if it moved."""
    found = []
    for path in sorted([*(ROOT / "torchdq").rglob("*.py"), *(ROOT / "envs").rglob("*.py")]):
        text = path.read_text(encoding="utf-8")
        found += [path.relative_to(ROOT).as_posix()] * len(occurrences(text, mutant.old, 0, len(text)))
    return f"; it is in {found[0]}" if len(found) == 1 else ""


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
        ignored = shutil.ignore_patterns("__pycache__")
        for name in NEEDED:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, folder / name, ignore=ignored)
            else:
                shutil.copy2(ROOT / name, folder / name)
        # found where it lies, not where an installation says
        shutil.copytree(ROOT / "envs", folder / "torchdq" / "envs", ignore=ignored)
        (folder / "cache").mkdir(mode=0o700)

    @contextmanager
    def planted(self, mutant: Mutant) -> Iterator[None]:
        """The copy with a fault, and afterwards without."""
        path = self.folder / mutant.file.replace("envs/", "torchdq/envs/", 1)
        text = path.read_text(encoding="utf-8")
        self.write(path, mutant.planted(text))
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
    sys.path[:] = [str(folder), *(path for path in sys.path if not path.startswith(str(TESTS)))]
    for name in ("places", "errata_table"):  # those of the copy
        del sys.modules[name]
    # a counterexample need not be the smallest, and every run tries the same examples
    hypothesis.settings.register_profile("planted", phases=(hypothesis.Phase.generate,), derandomize=True)
    hypothesis.settings.load_profile("planted")
    sys.exit(pytest.main(arguments, plugins=[Here()]))


class Here:
    """All that was imported of the package must lie in the copy."""

    def pytest_sessionfinish(self, session) -> None:
        package = [module for name, module in sys.modules.items() if name.partition(".")[0] == "torchdq"]
        root = os.path.realpath(session.config.rootpath) + os.sep
        if not all(os.path.realpath(str(module.__file__)).startswith(root) for module in package):
            session.exitstatus = FOREIGN


# --- all of them ------------------------------------------------------------------------------------------------------


def killed(mutant: Mutant, outcome: Outcome) -> bool:
    """Whether the suite noticed."""
    return outcome.result in (KILLED, AT_IMPORT) or (mutant.name.startswith("!") and outcome.result in (LATE, CRASHED))


def spread(work, items: list, copies: list[Copy], title: str, console: Console) -> list:
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
        return list(track(pool.map(one, items), title, len(items), console=console, transient=True))


def examine(copy: Copy, mutant: Mutant) -> Outcome:
    """Outcome of the tests of a fault."""
    with copy.planted(mutant):
        return copy.test([mutant.noticing()], LIMIT, "-x")


def changed_since(reference: str) -> set[str]:
    """Files that differ from a commit."""
    command = ["git", "-C", str(ROOT), "diff", "--name-only", reference]
    return set(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split())


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
    parser.add_argument("--changed", metavar="REF", nargs="?", const="HEAD", help="faults of files changed since REF")
    parser.add_argument("--check", action="store_true", help="say which faults fit no source or test; run nothing")
    parser.add_argument("-j", metavar="N", type=int, default=os.cpu_count() or 1, help="faults examined at a time")
    options = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": "1", "TORCHDQ_TESTS": "all"}  # tests of `make test-all` notice, too
    console = Console(markup=False, highlight=False, **({} if sys.stdout.isatty() else {"width": 200}))
    everything = read()
    mutants = [mutant for mutant in everything if not options.only or mutant.name in options.only]
    if options.changed:
        mutants = [mutant for mutant in mutants if mutant.file in changed_since(options.changed)]
    found = objections(mutants, everything)
    found += [f"{name!r}: there is no such fault" for name in {*(options.only or ())} - {m.name for m in everything}]
    if options.check:
        lost = uncollected([mutant.noticing() for mutant in mutants])
        gone = [m for m in mutants if m.noticing() != f"tests/{m.test}" or m.noticing() in lost]
        found += [f"{mutant.name!r}: there is no test {mutant.test}" for mutant in gone]
    if found or options.check:
        console.print("\n".join(found) or f"all {len(mutants)} faults fit the sources and the tests")
        return bool(found)
    start = time.perf_counter()
    FRESH.set_forkserver_preload(HEAVY)
    with tempfile.TemporaryDirectory(prefix="torchdq-mutants-") as folder:
        copies = [Copy(Path(folder, str(k))) for k in range(max(options.j, 1)) if Path(folder, str(k)).mkdir() is None]
        tests = sorted({mutant.noticing() for mutant in mutants})
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
    return 0 if score == len(mutants) else 1


if __name__ == "__main__":
    sys.exit(main())
