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


@pytest.mark.parametrize(("arguments", "found"), [((), "none"), (("teach",), "'teach'")])
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


def test_a_report_is_a_page_about_a_robot(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["torchdq", "report", "panda"])
    command_line.main()
    page = capsys.readouterr().out
    assert "panda_joint1" in page and "forward_dynamics" in page and "largest growth" in page


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        (("report",), "report takes the FILE of a robot"),
        (("cost", "panda"), "cost takes no FILE"),
        (("report", "nowhere.urdf"), "nowhere.urdf"),
        (("report", "<robot/>"), "report: "),
    ],
)
def test_a_mistake_of_a_user_is_one_message(monkeypatch, capsys, arguments, found):
    code, _, errors = called(monkeypatch, capsys, *arguments)
    assert found in errors + str(code) and "Traceback" not in errors
