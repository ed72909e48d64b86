"""Command line `torchdq`, also as `python -m torchdq`: one message for a user's mistake, exit codes, Ctrl-C.

Exit codes: 0 well; 1 a mistake of the user, or a check failed; 2 a command that is not understood; 130 Ctrl-C.
"""

import io
import os
import re
import shutil
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields
from functools import partial
from itertools import takewhile
from pkgutil import resolve_name
from typing import Any

import tyro

from torchdq import __version__
from torchdq.command.command import Command
from torchdq.command.outcome import Grid, Outcome, write, write_json
from torchdq.errors import TorchdqError, nearest
from torchdq.findings import Finding, merged, printable


class Commands(Mapping[str, type[Command]]):
    """Commands by name, each imported when it is asked for, so that none waits for what the others need."""

    def __init__(self, **places: str):
        self.places = places

    def __getitem__(self, name: str) -> type[Command]:
        found: type[Command] = resolve_name(f"torchdq.command.{self.places[name]}")
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)


COMMANDS = Commands(
    report="report:ReportCommand",
    bench="bench:BenchCommand",
    id="identify:IdCommand",
    scene="scene:SceneCommand",
    accuracy="accuracy:AccuracyCommand",
    export="export:ExportCommand",
    view="view:ViewCommand",
    cost="cost:CostCommand",
    doctor="doctor:DoctorCommand",
)
PROGRAM = "torchdq"
ABOUT = (
    "Rigid-body dynamics of robots. ROBOT is a URDF, xacro or MJCF file, a shipped robot such as panda, or a name in "
    "the package robot_descriptions.",
    "torchdq COMMAND --help has the options of a command and an example. torchdq --tyro-print-completion bash (or zsh, "
    "tcsh) prints what completes them in a shell.",
)
WELL, MISTAKE, USAGE, INTERRUPTED = 0, 1, 2, 130
CONFIGURATION = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)
DEEP = 10 * " "  # before the help of an argument that is missing
NUMBERS = re.compile(r"[-+.\de]+(,[-+.\de]+)+", re.IGNORECASE)  # with commas between


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code of a run with these arguments; None: those of the process."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if given == ["--version"]:
            sys.stdout.write(f"{PROGRAM} {__version__}\n")
            return WELL
        if given in (["--help"], ["-h"]):
            lines = [(name, (kind.__doc__ or "").split("\n\n")[0]) for name, kind in COMMANDS.items()]
            usage = f"usage: {PROGRAM} [--help] [--version] COMMAND ..."
            write(Outcome((usage, ABOUT[0], Grid((), lines), ABOUT[1]), {}), as_json=False)
            return WELL
        return _run(_parsed(given))
    except SystemExit as end:  # tyro's, after a message of its own
        return end.code if isinstance(end.code, int) else USAGE
    except KeyboardInterrupt:
        sys.stderr.write("\ntorchdq: interrupted\n")
        return INTERRUPTED
    except BrokenPipeError:  # who reads the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return WELL


def _parsed(given: Sequence[str]) -> Command:
    if given and not given[0].startswith("-") and given[0] not in COMMANDS:
        meant = "".join(f"did you mean {near!r}? " for near in nearest(given[0], COMMANDS)[:1])
        _say("error", f"there is no command {given[0]!r}; {meant}the commands are {', '.join(COMMANDS)}")
        raise SystemExit(USAGE)
    given = _apart(given)
    kinds: dict[str, Callable[..., Command]] = {
        name: COMMANDS[name] for name in (given[:1] if given and given[0] in COMMANDS else COMMANDS)
    }
    written, wrong = io.StringIO(), io.StringIO()
    try:
        with redirect_stdout(written), redirect_stderr(wrong):
            command: Command = tyro.extras.subcommand_cli_from_dict(
                kinds, prog=PROGRAM, description=ABOUT[0], args=given, config=CONFIGURATION
            )
    finally:
        text = written.getvalue()  # tyro's help, each paragraph of it one line, or the script of a shell
        sys.stdout.write(_filled(text) if {"-h", "--help"} & set(given) else text)
        if fault := _of_usage(wrong.getvalue()):
            command_help = " ".join([PROGRAM, *(given[:1] if given and given[0] in COMMANDS else ()), "--help"])
            _say("error", f"{fault}; see {command_help}")
    return command


def _of_usage(text: str) -> str:
    """One sentence of tyro's page about arguments that are not understood: without its title, rules and helps."""
    rows = takewhile(lambda row: set(row.strip()) != {"-"}, text.splitlines()[2:])
    return " ".join(row.strip() for row in rows if not row.startswith(DEEP)).strip().rstrip(".")


def _apart(given: Sequence[str]) -> list[str]:
    """Arguments in which numbers of an option that stand together, with commas between, stand apart: --q 1,2 or 1 2."""
    options = fields(COMMANDS[given[0]]) if given and given[0] in COMMANDS else ()
    many = {f"--{one.name.replace('_', '-')}" for one in options if re.search(r"tuple\[(int|float)", str(one.type))}
    apart, option = list[str](), ""
    for text in given:
        name, equals, value = text.partition("=")
        if equals and name in many and NUMBERS.fullmatch(value):
            apart += [name, *value.split(",")]
            continue
        option = name if text.startswith("--") else option
        apart += text.split(",") if option in many and NUMBERS.fullmatch(text) else [text]
    return apart


def _run(command: Command) -> int:
    """Exit code of a command, after its output."""
    shown: list[str] = []

    def show(message: Warning | str, *rest: Any, **others: Any) -> None:
        if (words := _words(message)) not in shown:
            shown.append(words)
            _say("warning", words)

    with warnings.catch_warnings():
        warnings.showwarning = show
        try:
            with redirect_stdout(sys.stderr):  # output of libraries does not belong to the result
                outcome = command.outcome()
        except (TorchdqError, OSError) as error:
            if isinstance(error, BrokenPipeError):
                raise
            words = _words(error)
            if command.json:
                write_json({"error": words, "kind": type(error).__name__})
            _say("error", words)
            return MISTAKE
    write(outcome, command.json, shown)
    sys.stdout.flush()
    return MISTAKE if outcome.failed else WELL


def _words(error: Exception | str) -> str:
    """Message of an error or a warning, with cures in options; one of the system names the file first."""
    if text := getattr(error, "text", None):  # of errors and warnings about logs
        return str(text(command_line=True))
    if isinstance(error, TorchdqError) and isinstance(error.args[0], Finding):
        return merged(error.findings, command_line=True)
    if isinstance(error, TorchdqError) or not isinstance(error, OSError) or error.filename is None:
        return str(error)
    return f"{str(error.filename)!r} cannot be used: {error.strerror}"


def _say(kind: str, text: str) -> None:
    """Write a message to stderr."""
    sys.stderr.write(_filled(printable(f"{PROGRAM}: {kind}: {text}", kept="\n")) + "\n")
    sys.stderr.flush()


def _filled(text: str) -> str:
    """Text whose lines fit the terminal."""
    width = max(40, shutil.get_terminal_size().columns)
    fill = partial(textwrap.wrap, width=width, break_long_words=False, break_on_hyphens=False)
    return "\n".join(line for part in text.split("\n") for line in fill(part) or [""])
