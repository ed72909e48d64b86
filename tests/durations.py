"""Time and compiler runs of every test, from an empty cache of programs.

    python tests/durations.py [--out out/durations.tsv] [arguments of pytest]

Prints how many items take how long, and rooms and functions by their time. The file has every item: seconds of setup,
call and teardown, and how often a C or C++ compiler was started meanwhile.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

TESTS = Path(__file__).parent
COMPILERS = ("cc", "c++", "gcc", "g++", "clang", "clang++")
LONG = (10.0, 3.0, 1.0, 0.3, 0.1, 0.05)  # [s]
SHOWN = 30  # functions
started = 0  # compilers of this process


class Counted(subprocess.Popen):
    """Process that counts if it is a compiler."""

    def __init__(self, args, *more, **named):
        global started
        name = args if isinstance(args, (str, os.PathLike)) else args[0]
        started += Path(str(name).split()[0]).name in COMPILERS
        super().__init__(args, *more, **named)


def pytest_configure(config):
    """Count in every process of a run that has this file as a plugin."""
    subprocess.Popen = Counted


def pytest_runtest_teardown(item):
    """Number of compilers since the last test of this process."""
    global started
    item.user_properties.append(("compilers", started))
    started = 0


def pytest_terminal_summary(terminalreporter):
    """Every item and its seconds, in the file that the environment names."""
    seconds, compilers = Counter(), Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            if hasattr(report, "when"):
                seconds[report.nodeid] += report.duration
                compilers[report.nodeid] += sum(n for key, n in report.user_properties if key == "compilers")
    rows = [f"{s:.3f}\t{compilers[name]}\t{name}\n" for name, s in seconds.most_common()]
    Path(os.environ["TORCHDQ_DURATIONS"]).write_text("".join(rows), encoding="utf-8")


def table(rows):
    """Lines of the tables: items by their time, rooms and functions by all of it."""
    whole = sum(s for s, _, _ in rows)
    lines = [f"{len(rows)} items, {whole:.0f} s, {sum(n for _, n, _ in rows)} compilers", ""]
    for bound in LONG:
        longer = [s for s, _, _ in rows if s > bound]
        lines.append(f"{bound:6g} s and more: {len(longer):6d} items, {sum(longer) / whole:4.0%} of the time")
    rooms, functions, compilers = Counter(), Counter(), Counter()
    for s, n, name in rows:
        room, function = name.split("::")[0].removeprefix("tests/").split("/")[0], name.split("[")[0]
        for counter, key in ((rooms, room), (functions, function)):
            counter[key] += s
            compilers[key] += n
    for counter, shown in ((rooms, None), (functions, SHOWN)):
        lines += ["", *(f"{s:7.1f} s {compilers[key]:5d} compilers  {key}" for key, s in counter.most_common(shown))]
    return lines


def main():
    """Run the suite, and print what took its time."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--out", type=Path, default=TESTS.parent / "out" / "durations.tsv", help="file of all items")
    given, more = options.parse_known_args()
    given.out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as cache:
        path = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
        own = {"XDG_CACHE_HOME": cache, "TORCHDQ_DURATIONS": str(given.out.resolve()), "PYTHONPATH": path}
        command = [sys.executable, "-m", "pytest", "-p", "durations", "-p", "no:cacheprovider", "-q"]
        usual = ["-n", "auto", "--dist", "worksteal"] if "-n" not in more else []
        code = subprocess.call([*command, *usual, *more], env={"OMP_NUM_THREADS": "1", **os.environ, **own})
    rows = [line.split("\t") for line in given.out.read_text(encoding="utf-8").splitlines()]
    print("\n".join(table([(float(s), int(n), name) for s, n, name in rows])))
    return code


if __name__ == "__main__":
    sys.exit(main())
