"""Files that are whole at any moment, and Ctrl-C while the command line is loaded."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from torchdq.base.files import write_atomically


def test_a_file_is_whole_after_a_write_that_failed(tmp_path, monkeypatch):
    path = tmp_path / "page.html"
    write_atomically({path: "old"})

    def full(number):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as raised:
        write_atomically({path: "new"})
    assert raised.value.filename == str(path)
    monkeypatch.setattr(os, "fsync", lambda number: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_atomically({path: "new"})
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_of_several_files_none_changes_where_one_cannot_be_written(tmp_path):
    first, last = tmp_path / "a.h", tmp_path / "a.c"
    write_atomically({first: "old", last: b"old"})
    with pytest.raises(OSError) as raised:
        write_atomically({first: "new", tmp_path / "nowhere" / "b.h": "new", last: "new"})
    assert raised.value.filename == str(tmp_path / "nowhere" / "b.h")
    assert first.read_text() == last.read_text() == "old" and {*tmp_path.iterdir()} == {first, last}


def test_a_file_is_written_where_a_link_leads_and_nowhere_else(tmp_path):
    path, link = tmp_path / "a.csv", tmp_path / "link.csv"
    link.symlink_to(path)
    write_atomically({link: b"1,2\n"})
    assert link.is_symlink() and path.read_bytes() == b"1,2\n"
    write_atomically({tmp_path / "/dev/null": "nothing"})
    assert not os.path.isfile(os.devnull)
    for wrong in (tmp_path, tmp_path / "nowhere" / "a.csv"):
        with pytest.raises(OSError) as raised:
            write_atomically({wrong: "x"})
        assert raised.value.filename == str(wrong)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.csv", "link.csv"]


LOAD = """
import importlib.abc, os, signal, sys

class Interrupted(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "torch":
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)  # a process in the background of a shell ignores it
sys.meta_path.insert(0, Interrupted())
sys.argv = [{argument!r}]
import torchdq.command.main
"""


@pytest.mark.parametrize("argument, quiet", [("/usr/bin/torchdq", True), ("train.py", False)])
def test_ctrl_c_while_the_command_is_loaded_is_quiet(argument, quiet):
    code = LOAD.format(argument=argument)
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert found.returncode == -signal.SIGINT  # 130 for a shell
    assert ("Traceback" not in found.stderr) == quiet
