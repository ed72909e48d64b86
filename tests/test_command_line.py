"""`python -m torchdq` says which commands there are, and its version."""

import subprocess
import sys

import pytest

import torchdq
from torchdq import __main__ as command_line


def called(monkeypatch, capsys, *arguments):
    """Exit code, output and errors of the command line."""
    monkeypatch.setattr(sys, "argv", ["torchdq", *arguments])
    with pytest.raises(SystemExit) as end:
        command_line.main()
    return end.value.code, *capsys.readouterr()


@pytest.mark.parametrize(("arguments", "found"), [((), "none"), (("report",), "'report'")])
def test_a_wrong_command_names_those_there_are(monkeypatch, capsys, arguments, found):
    code, _, errors = called(monkeypatch, capsys, *arguments)
    assert code == 2 and f"COMMAND must be one of the following, found {found}:" in errors
    assert all(f"  {name} " in errors for name in command_line.COMMANDS)


def test_the_help_names_the_commands(monkeypatch, capsys):
    code, out, _ = called(monkeypatch, capsys, "--help")
    assert code == 0 and "COMMAND" in out and "{cost}" not in out
    assert all(f"  {name} " in out and what in out for name, what in command_line.COMMANDS.items())


def test_the_version_is_given():
    found = subprocess.run([sys.executable, "-m", "torchdq", "--version"], capture_output=True, text=True, timeout=120)
    assert (found.returncode, found.stdout) == (0, f"torchdq {torchdq.__version__}\n")
