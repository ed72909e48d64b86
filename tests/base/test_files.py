"""Files that are whole at any moment."""

import errno
import os
from pathlib import Path

import pytest

from torchdq.base.files import write_atomically


def test_a_file_is_whole_after_a_write_that_failed(tmp_path, monkeypatch):
    path = tmp_path / "page.html"
    write_atomically({path: "old"})

    def failing(error):
        def write(part, data):
            part.touch()
            raise error

        return write

    monkeypatch.setattr(Path, "write_bytes", failing(OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(OSError, match="No space left") as raised:
        write_atomically({path: "new"})
    assert raised.value.filename == str(path)
    monkeypatch.setattr(Path, "write_bytes", failing(KeyboardInterrupt()))
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
