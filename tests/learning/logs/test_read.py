"""Logs are read as written, smoothed without delay, and refused by row and column with what to do about it.

What smoothing returns is held against motions known in closed form. The recordings of real arms are not part of the
package: their tests look in the folder that TORCHDQ_DATA names, or beside the checkout, and are skipped without it.
"""

import contextlib
import dataclasses
import gzip
import io
import math
import pickle
import re
import sys
import time
import warnings
import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from places import DATA
from recordings import LAYOUTS, layout_of

import torchdq
from torchdq import learning
from torchdq.errors import ArgumentError, MissingLibraryError, TorchdqError
from torchdq.learning.logs import motions

pytest.importorskip("scipy", reason="smoothing needs scipy")

RATE = 2 * np.pi * 0.7  # [rad/s] of the motion in the synthetic log


def motion(time: np.ndarray, n: int = 7) -> tuple[np.ndarray, ...]:
    """q, qd, qdd and tau of n joints, each [rows, n]."""
    phase = RATE * time[:, None] + np.arange(n)
    return np.sin(phase), RATE * np.cos(phase), -(RATE**2) * np.sin(phase), 3 * np.cos(phase) + np.arange(n)


def table(seconds: float = 5.0, n: int = 7) -> np.ndarray:
    """Rows of a log at about 1 kHz, in uneven steps."""
    time = np.cumsum(np.random.default_rng(0).uniform(0.4e-3, 1.6e-3, round(1000 * seconds)))
    q, qd, _, tau = motion(time, n)
    return np.column_stack([time, q, qd, tau])


def names(n: int, blocks: tuple[str, ...] = ("q", "qd", "tau")) -> list[str]:
    return ["time", *(f"{block}{joint}" for block in blocks for joint in range(1, n + 1))]


def written(path: Path, rows: np.ndarray, heads: list[str] | None) -> Path:
    np.savetxt(path, rows, delimiter=",", fmt="%.9g", header=",".join(heads or ()), comments="")
    if heads is None:
        path.write_text(path.read_text().removeprefix("\n"))
    return path


@pytest.fixture
def log(tmp_path) -> Path:
    return written(tmp_path / "log.csv", table(), names(7))


def edited(path: Path, edit: Callable[[list[str]], None]) -> Path:
    lines = path.read_text().splitlines()
    edit(lines)
    path.write_text("\n".join(lines) + "\n")
    return path


# --- reading ---------------------------------------------------------------------------------------------------------


def assert_holds(found: learning.Log, rows: np.ndarray) -> None:
    np.testing.assert_allclose(np.column_stack([found.time, found.q, found.qd, found.tau]), rows, atol=1e-7)


def test_log_is_read_as_written(log):
    found, rows = learning.read(log), table()
    assert found.layout == learning.Layout(joints=7) and found.repeats == 0 and found.qdd is None
    assert_holds(found, rows)
    assert_holds(learning.read(log, rows=(100, 200)), rows[100:200])


@pytest.mark.parametrize("n", [1, 3, 9])
def test_any_number_of_joints(tmp_path, n):
    found = learning.read(written(tmp_path / "log.csv", table(n=n), names(n)))
    assert found.layout == learning.Layout(joints=n)
    assert_holds(found, table(n=n))


def test_columns_are_found_by_name_and_others_stay_unread(tmp_path):
    rows, heads = table(n=3), names(3)
    order = np.random.default_rng(0).permutation(len(heads))
    shuffled = np.column_stack([np.full(len(rows), np.nan), rows[:, order]])
    found = learning.read(written(tmp_path / "log.csv", shuffled, ["temperature", *(heads[i] for i in order)]))
    assert_holds(found, rows)


def test_the_double_pendulums_columns(tmp_path):
    heads = names(2, ("pos_meas", "vel_meas", "pos_filt", "tau_con", "tau_meas"))
    rows = table(n=2)
    wide = np.column_stack([rows[:, :5], np.full((len(rows), 4), 7.0), rows[:, 5:]])
    layout = learning.Layout(joints=2, blocks=("pos_meas", "vel_meas", "tau_meas"))
    found = learning.read(written(tmp_path / "log.csv", wide, heads), layout)
    assert found.layout is layout
    assert_holds(found, rows)


def test_currents_become_torques(tmp_path):
    rows = np.hstack([np.arange(300)[:, None] * 0.01, np.ones((300, 30))])
    found = learning.read(written(tmp_path / "ur.csv", rows, None), LAYOUTS["ur10e"])
    assert found.layout is LAYOUTS["ur10e"]
    np.testing.assert_array_equal(found.tau[0], found.layout.gain)


def test_a_packed_file(log):
    packed = log.with_suffix(".gz")
    packed.write_bytes(gzip.compress(log.read_bytes()))
    assert_holds(learning.read(packed), table())


def arrays(n: int = 3) -> dict[str, np.ndarray]:
    time = table(n=n)[:, 0]
    return dict(zip(("time", "q", "qd", "qdd", "tau"), (time, *motion(time, n)), strict=True))


def test_an_archive_is_read_without_a_digit_lost(tmp_path):
    np.savez(tmp_path / "log.npz", **arrays())
    found = learning.read(tmp_path / "log.npz")
    for name, x in arrays().items():
        np.testing.assert_array_equal(getattr(found, name), x)
    np.testing.assert_array_equal(learning.read(tmp_path / "log.npz", rows=(10, 30)).q, arrays()["q"][10:30])


def test_an_archive_may_have_a_layout(tmp_path):
    np.savez(tmp_path / "log.npz", **arrays(7))
    assert learning.read(tmp_path / "log.npz", LAYOUTS["panda"]).layout is LAYOUTS["panda"]


def test_spreadsheets_write_a_mark_at_the_start(log):
    log.write_bytes(b"\xef\xbb\xbf" + log.read_bytes())
    assert_holds(learning.read(log), table())


def test_repeated_time_stamps_are_dropped_and_counted(log):
    edited(log, lambda lines: lines.insert(50, lines[49]))
    found = learning.read(log)
    assert found.repeats == 1
    assert (np.diff(found.time) > 0).all() and len(found.time) == len(table())


# --- what is refused -------------------------------------------------------------------------------------------------


def cell(row: int, column: int, text: str) -> Callable[[list[str]], None]:
    """Edit that puts text into a cell, both counted from 1 as the messages do."""

    def edit(lines: list[str]) -> None:
        cells = lines[row - 1].split(",")
        cells[column - 1] = text
        lines[row - 1] = ",".join(cells)

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (cell(17, 11, "nan"), r"log\.csv, row 17, column 'qd3': 'nan' is not a finite number.*rows="),
        (cell(17, 22, "inf"), r"log\.csv, row 17, column 'tau7': 'inf' is not a finite number"),
        (cell(17, 2, "high"), r"log\.csv, row 17, column 'q1': 'high' is not a finite number"),
        (cell(17, 2, ""), r"log\.csv, row 17, column 'q1': '' is not a finite number"),
        (cell(30, 1, "0.001"), r"log\.csv, row 30, column 'time': .* s before the row above"),
        (
            lambda lines: lines.__delitem__(slice(100, 400)),
            r"row 101, column 'time': 0\.\d+ s after the row above, more than 0\.1 s; .*rows=\(0, 99\) .* rows=\(99,",
        ),
        (cell(17, 2, "1,2"), r"row 17: 23 columns, expected 22 columns time \.\.\. tau7"),
        (lambda lines: lines.insert(16, ""), r"row 17: 1 columns, expected 22"),
        (cell(1, 9, "velocity1"), r"row 1: there is no column 'qd1'; needed are columns time, q1 \.\.\. q7, qd1"),
        (cell(1, 9, "tau7"), r"row 1: there is no column 'qd1'"),
        (cell(1, 1, "stamp"), r"row 1: there is no column 'time'; needed are columns time, q1"),
        (cell(1, 22, "tau7,tau7"), r"row 1: there are several columns 'tau7'"),
        (lambda lines: lines.pop(0), r"row 1: there is no column 'time'"),
        (lambda lines: lines.__delitem__(slice(1, None)), r"log\.csv: 0 rows of numbers"),
        (lambda lines: lines.clear(), r"log\.csv is empty"),
    ],
)
def test_bad_logs_are_refused_by_row_and_column(log, edit, message):
    with pytest.raises(learning.LogError, match=message):
        learning.read(edited(log, edit))


def test_the_layout_and_the_rows_are_checked(log):
    with pytest.raises(learning.LogError, match="row 1: there is no column 'pos_meas1'"):
        learning.read(log, LAYOUTS["double_pendulum"])
    with pytest.raises(ArgumentError, match="rows must be a first row"):
        learning.read(log, rows=(20, 10))
    with pytest.raises(learning.LogError, match="0 rows of numbers"):
        learning.read(log, rows=(100_000, 100_010))
    with pytest.raises(learning.LogError, match="9 joints, expected 7"):
        learning.read(written(log, table(n=9), names(9)), LAYOUTS["panda"])
    assert issubclass(learning.LogError, TorchdqError)


@pytest.mark.parametrize("opened", [Path.as_uri, Path.read_bytes, lambda log: log.open("rb"), Path.open])
def test_a_log_may_be_an_address_bytes_or_an_open_file(log, opened):
    source = opened(log)
    assert_holds(learning.read(source), table())
    if hasattr(source, "close"):
        source.close()


@pytest.mark.parametrize("error", [FileNotFoundError, learning.LogError])
def test_a_missing_log_is_what_a_caller_expects(log, error):
    with pytest.raises(error, match=r"there is no file .*missing\.csv"):
        learning.read(log.with_name("missing.csv"))


def test_what_is_no_log_at_all_is_refused(tmp_path):
    with pytest.raises(learning.LogError, match=r"the log .* cannot be read: .*directory"):
        learning.read(tmp_path)
    with pytest.raises(learning.LogError, match="only file:/// and package:// addresses"):
        learning.read("https://host/log.csv")
    for source in (None, 5, ["log.csv"]):
        with pytest.raises(ArgumentError, match="the log must be a path"):
            learning.read(source)


def test_rows_are_named_as_in_the_file_when_only_some_are_read(log):
    edited(log, cell(217, 11, "nan"))
    with pytest.raises(learning.LogError, match=r"row 217, column 'qd3'"):
        learning.read(log, rows=(200, 300))
    learning.read(log, rows=(216, 300))


def test_damaged_files(tmp_path, log):
    packed = tmp_path / "log.csv.gz"
    packed.write_bytes(gzip.compress(log.read_bytes())[:-1000])
    with pytest.raises(learning.LogError, match=r"log\.csv\.gz is damaged"):
        learning.read(packed)
    log.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(learning.LogError, match=r"log\.csv is damaged or not a text"):
        learning.read(log)
    archive = tmp_path / "log.npz"
    np.savez(archive, **arrays())
    archive.write_bytes(archive.read_bytes()[:5000])
    with pytest.raises(learning.LogError, match=r"log\.npz is damaged"):
        learning.read(archive)


def test_an_archive_cannot_run_anything(tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    np.savez(tmp_path / "log.npz", **{**arrays(), "q": np.array([Trap()], dtype=object)})
    with pytest.raises(learning.LogError, match="damaged or not an archive of numbers"):
        learning.read(tmp_path / "log.npz")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tau": None}, r"there is no array 'tau'; needed are time \[rows\]"),
        ({"qd": np.zeros((10, 3))}, r"array 'qd': float64 \[10, 3\], expected"),
        ({"time": np.zeros((5000, 1))}, r"array 'time': float64 \[5000, 1\], expected"),
        ({"q": np.full((5000, 3), "a")}, r"array 'q': <U1 \[5000, 3\], expected real numbers"),
        ({"q": np.full((5000, 3), np.nan)}, r"row 0, column 'q1': nan is not a finite number"),
    ],
)
def test_bad_archives(tmp_path, change, message):
    np.savez(tmp_path / "log.npz", **{k: x for k, x in {**arrays(), **change}.items() if x is not None})
    with pytest.raises(learning.LogError, match=message):
        learning.read(tmp_path / "log.npz")


DEGREES = 180 / np.pi


@pytest.mark.parametrize(
    ("columns", "factor", "message"),
    [
        (
            (3,),
            DEGREES,
            r"row \d+, column 'q3': -?57\.\d+ rad, more than 25\.1; are these degrees \(multiply by pi/180\), or "
            r"millimetres of a joint that slides \(by 0\.001\)\? .* by farthest",
        ),
        ((12,), DEGREES, r"row \d+, column 'qd5': -?25\d\S* rad/s, more than 50; are these degrees .* by fastest"),
        ((3,), 0.1 * DEGREES, r"column 'q3': q3 changes 5\.73 times as much as qd3 says; the two must agree in unit"),
        ((12,), -1.0, r"column 'q5': q5 changes -1 times as much as qd5 says; .* sign"),
        ((4, 5), (0.3 * DEGREES, 0.3), r"column 'q4': q4 changes 17\.2 times"),
        ((0,), 1000.0, r"column 'time': \S+ s after .*; times must be in seconds; divide milliseconds by 1000"),
        ((0,), 0.0, r"column 'time': the same time in all rows"),
    ],
)
def test_wrong_units_are_refused_by_column(tmp_path, columns, factor, message):
    rows = table()
    rows[:, list(columns)] *= factor
    with pytest.raises(learning.LogError, match=message):
        learning.read(written(tmp_path / "log.csv", rows, names(7)))


@pytest.mark.parametrize(("column", "name"), [(2, "q2"), (9, "qd2")])
def test_small_motions_in_degrees_are_told_by_their_rates(tmp_path, column, name):
    rows = table()
    rows[:, 1:15] *= 0.05  # three degrees, far within any range
    rows[:, column] *= DEGREES
    with pytest.raises(learning.LogError, match=rf"{name} seems to be in degrees; multiply the column by pi/180"):
        learning.read(written(tmp_path / "log.csv", rows, names(7)))


def test_positions_that_follow_the_velocity_of_another_joint_are_refused(tmp_path):
    time, rates = np.linspace(0.0, 10.0, 1001), np.arange(1.0, 8.0)
    q, qd = np.sin(np.outer(time, rates)), rates * np.cos(np.outer(time, rates))
    rows = np.column_stack([time, q[:, [0, 2, 1, 3, 4, 5, 6]], qd, q])
    with pytest.raises(learning.LogError, match=r"'q2': it changes as qd3 says, not as qd2; the columns of both"):
        learning.read(written(tmp_path / "log.csv", rows, names(7)))


def test_accelerations_in_degrees(tmp_path):
    found = arrays()
    found["qdd"] = found["qdd"] * DEGREES
    np.savez(tmp_path / "log.npz", **found)
    with pytest.raises(learning.LogError, match="qdd1 seems to be in degrees"):
        learning.read(tmp_path / "log.npz")


def test_a_joint_that_turns_far_has_a_layout_that_allows_it(tmp_path):
    rows = table(n=1)
    rows[:, 1] += 100.0
    path = written(tmp_path / "wheel.csv", rows, names(1))
    with pytest.raises(learning.LogError, match="pass a Layout that allows it, by farthest"):
        learning.read(path)
    assert learning.read(path, learning.Layout(farthest=np.inf)).q.max() > 100


# --- malformed files -------------------------------------------------------------------------------------------------

ROWS = [f"{0.01 * k:.2f},{np.sin(0.01 * k):.6f},{np.cos(0.01 * k):.6f},{0.1 * k:.3f}" for k in range(50)]
HEAD = "time,q1,qd1,tau1\n"
GOOD = HEAD + "\n".join(ROWS) + "\n"


def packed(**members: str) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        for name, text in members.items():
            file.writestr(name.replace("_", "."), text)
    return content.getvalue()


def array(x: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.save(content, x)
    return content.getvalue()


def replaced(row: int, text: str) -> str:
    return HEAD + "\n".join([*ROWS[:row], text, *ROWS[row + 1 :]]) + "\n"


MALFORMED = {
    "nothing": ("", "log is empty"),
    "blanks": (" \n \n", "log is empty"),
    "a header alone": (HEAD, "0 rows of numbers, at least two"),
    "one row": (HEAD + ROWS[0], "1 rows of numbers, at least two"),
    "semicolons": (GOOD.replace(",", ";"), "columns are separated by semicolons; commas are needed"),
    "tabs": (GOOD.replace(",", "\t"), "columns are separated by tabs; commas are needed"),
    "spaces": (GOOD.replace(",", " "), "columns are separated by spaces; commas are needed"),
    "decimal commas": (HEAD + "\n".join(row.replace(".", ",") for row in ROWS), "row 2: 8 .* decimal commas .* points"),
    "quotes": ("\n".join(f'"{line}"'.replace(",", '","') for line in GOOD.split("\n")), "quotation marks .* removed"),
    "quoted numbers": (replaced(8, '0.08,"1",1,1'), "row 10, column 'q1': '\"1\"' is not .* quotation marks"),
    "a comment": ("# log of today\n" + GOOD, "row 1: .* remove the lines before the header"),
    "units": (HEAD + "s,rad,rad/s,Nm\n" + GOOD[len(HEAD) :], r"row 2, .* words or units .* rows=\(1, last\)"),
    "no header": ("\n".join(ROWS), r"there is no column 'time'; .* Layout\(header=False, joints=\.\.\.\)"),
    "capitals": (GOOD.replace("time", "Time"), "no column 'time'; .* there is 'Time'; capitals count"),
    "other names": (GOOD.replace("q1,qd1", "a,b"), r"there is no column 'q1'; .* Layout\(columns="),
    "latin-1": (GOOD.replace("tau1", "tau1,température").encode("latin-1"), "not a text .*save it as UTF-8"),
    "zeros": (GOOD.replace("0.1", "\0"), r"'\\x00\S*' is not a finite number"),
    "empty lines": (GOOD.replace("\n", "\n\n"), "row 2: 1 columns, expected 4 .* remove empty lines"),
    "two q1": (GOOD.replace("qd1", "q1"), "several columns 'q1'"),
    "a short row": (replaced(9, "0.09,1"), "row 11: 2 columns, expected 4"),
    "a long row": (replaced(9, ROWS[9] + ",5"), "row 11: 5 columns, expected 4"),
    "a word": (replaced(9, "0.09,x,1,1"), "row 11, column 'q1': 'x' is not a finite number"),
    "an underscore": (replaced(9, "0.09,1_0,1,1"), "row 11, column 'q1': '1_0' is not a finite number"),
    "a number too large": (replaced(9, "0.09,1e400,1,1"), "row 11, column 'q1': '1e400' is not a finite number"),
    "backwards": (HEAD + "\n".join(ROWS[::-1]), "row 3, column 'time': 0.01 s before the row above"),
    "milliseconds": (
        HEAD + "\n".join(f"{10 * k},0,0,{k}" for k in range(50)),
        "times must be in seconds; divide milliseconds by 1000",
    ),
    "nanoseconds": (
        HEAD + "\n".join(f"{10**18 + 10**7 * k},0,0,{k}" for k in range(50)),
        "times must be in seconds; .* nanoseconds by 1e9",
    ),
    "a gap": (HEAD + "\n".join(ROWS[:10] + ROWS[40:]), "row 12, column 'time': 0.31 s after the row above"),
    "joints 1 and 3": ("time,q1,q3,qd1,qd3,tau1,tau3\n" + "0,0,0,0,0,0,0\n" * 3, "there is no column 'q2'"),
    "a velocity missing": ("time,q1,q2,qd1,tau1,tau2\n" + "0,0,0,0,0,0\n" * 3, "there is no column 'qd2'"),
    "a packed file cut short": (gzip.compress(GOOD.encode())[:60], "damaged"),
    "a bomb": (gzip.compress(b"0" * 40_000_000), "unpacks to more than .* 100 times its own size; unpack it by hand"),
    "a bomb of rows": (gzip.compress(HEAD.encode() + b"0,0,0,0\n" * 5_000_000), "unpacks to more than"),
    "a million columns": (",".join(f"c{i}" for i in range(1_000_000)) + "\n1", "first line is longer than 100000"),
    "many columns": (",".join(f"c{i}" for i in range(10_000)) + "\n1", "there is no column 'time'"),
    "a zip of a log": (packed(log_csv=GOOD), "a zip archive of log.csv; unpack it"),
    "an empty zip": (packed(), "there is no array 'time'"),
    "one array": (array(np.zeros((5, 4))), r"a single NumPy array, .*np\.savez\(time="),
    "an archive of what says it is huge": (
        packed(q_npy="\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (10, 99999999999999)}"),
        "there is no array 'time'|damaged",
    ),
    "JSON": ('{"time": [0, 1], "q": 3}', "JSON, not a table"),
    "pickle": (pickle.dumps({"a": 1}), "a pickle, .*columns separated by commas"),
    "Parquet": (b"PAR1" + bytes(50), "a Parquet file, .*columns separated by commas"),
    "HDF5": (b"\x89HDF\r\n\x1a\n" + bytes(50), "an HDF5 file"),
    "a bag": (b"#ROSBAG V2.0\n", "a ROS bag"),
    "a ROS 2 bag": (b"SQLite format 3\0", "an SQLite file"),
    "bytes": (bytes(range(256)), "damaged or not a text"),
}


@pytest.mark.parametrize("way", MALFORMED)
def test_a_malformed_log_is_refused_with_the_cure(tmp_path, way):
    content, message = MALFORMED[way]
    path = tmp_path / "log"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    start = time.process_time()
    with pytest.raises(learning.LogError, match=message):
        learning.read(path)
    assert time.process_time() - start < 2


@pytest.mark.parametrize("change", [bytes([1]), bytes([0x80])])
def test_an_archive_that_is_wounded_anywhere_is_read_or_refused(tmp_path, change):
    """Every 7th byte of an archive, changed: numpy's and zipfile's own errors never come through."""
    np.savez_compressed(tmp_path / "log.npz", **{k: x[:30] for k, x in arrays(1).items()})
    whole = (tmp_path / "log.npz").read_bytes()
    for at in range(2, len(whole), 7):
        (tmp_path / "log.npz").write_bytes(whole[:at] + bytes([whole[at] ^ change[0]]) + whole[at + 1 :])
        with contextlib.suppress(learning.LogError):
            learning.read(tmp_path / "log.npz")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
def test_encodings_that_say_their_name_are_read(tmp_path, encoding):
    text = GOOD if encoding != "utf-16-le" else "\ufeff" + GOOD
    (tmp_path / "log.csv").write_bytes(text.encode(encoding))
    assert len(learning.read(tmp_path / "log.csv").time) == 50


# --- names of columns ------------------------------------------------------------------------------------------------

ROS = [
    "stamp",
    *(f"position_{i}" for i in range(3)),
    *(f"joint_states.velocity[{i}]" for i in range(3)),
    "base",
    "shoulder",
    "elbow",
]


def test_columns_have_names_by_a_mapping(tmp_path):
    path = written(tmp_path / "ros.csv", table(n=3), ROS)
    columns = {
        "time": "stamp",
        "q": "position_{0}",
        "qd": "joint_states.velocity[{0}]",
        "tau": ["base", "shoulder", "elbow"],
    }
    found = learning.read(path, learning.Layout(columns=columns))
    assert found.layout.joints == 3
    assert_holds(found, table(n=3))
    edited(path, cell(9, 3, "nan"))
    with pytest.raises(learning.LogError, match="row 9, column 'position_1'"):
        learning.read(path, learning.Layout(columns=columns))
    columns["tau"] = "effort_{1}"
    message = r"no column 'position_3'; needed are columns stamp, position_0 \.\.\. position_3, joint_states"
    with pytest.raises(learning.LogError, match=message):
        learning.read(path, learning.Layout(joints=4, columns=columns))


def test_patterns_count_from_the_number_in_their_braces_and_others_keep_their_names(tmp_path):
    heads = ["time", "p_00", "p_01", "qd1", "qd2", "tau1", "tau2", "a5", "a6"]
    rows = np.column_stack([table(n=2), motion(table(n=2)[:, 0], 2)[2]])
    layout = learning.Layout(columns={"q": "p_0{0}", "qdd": "a{5}"})
    found = learning.read(written(tmp_path / "log.csv", rows, heads), layout)
    assert_holds(found, rows[:, :7])
    np.testing.assert_allclose(found.qdd, rows[:, 7:], atol=1e-6)
    with pytest.raises(learning.LogError, match="there is no column 'b1'"):  # named, so it must be there
        learning.read(tmp_path / "log.csv", learning.Layout(columns={"q": "p_0{0}", "qdd": "b{1}"}))


def test_a_single_joint_needs_no_number_and_an_archives_arrays_have_names_too(tmp_path):
    columns = {"time": "t", "q": "angle", "qd": "speed", "tau": "torque"}
    found = learning.read(
        written(tmp_path / "log.csv", table(n=1), list(columns.values())), learning.Layout(columns=columns)
    )
    assert_holds(found, table(n=1))
    known = arrays()
    np.savez(tmp_path / "log.npz", **{name: known[signal] for signal, name in columns.items()})
    found = learning.read(tmp_path / "log.npz", learning.Layout(columns=columns))
    np.testing.assert_array_equal(found.tau, known["tau"])
    np.savez(tmp_path / "log.npz", **{name: known[signal] for signal, name in columns.items() if signal != "q"})
    with pytest.raises(learning.LogError, match=r"there is no array 'angle'; .* found t, speed, torque$"):
        learning.read(tmp_path / "log.npz", learning.Layout(columns=columns))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": "q"}, r"columns must be a mapping such as \{'q': 'position_\{0\}'\}, found 'q'"),
        ({"columns": {"velocity": "v{1}"}}, "no signal named 'velocity'; .*time"),
        ({"columns": {"q": 3}}, r"columns\['q'\] must be a name, a pattern .* or a list of names, found 3"),
        ({"columns": {"q": ["a", 3]}}, r"columns\['q'\] must be"),
        ({"columns": {"q": []}}, r"columns\['q'\] must be"),
        ({"columns": {"time": ["a", "b"]}}, r"columns\['time'\] must be one name"),
        ({"columns": {"q": ["a", "b"], "qd": ["c"]}}, r"columns\['qd'\] has 1 names, columns\['q'\] 2"),
        ({"columns": {"q": ["a", "b"]}, "joints": 3}, r"columns\['q'\] has 2 names, expected 3, the number of joints"),
        ({"columns": {"q": "a{1}"}, "header": False, "joints": 2}, "columns needs a header"),
        ({"header": False}, "joints must be given for a file without a header"),
        (
            {"blocks": ("q", "tau")},
            r"blocks must be three or more different names, .* positions, velocities and torques, "
            r"found \('q', 'tau'\); .* keep the name and give columns=\{'qd': None\}",
        ),
        ({"blocks": ("q", "q", "tau")}, "blocks must be three or more different names"),
        ({"blocks": "qvt"}, "blocks must be three or more different names, .* found 'qvt'"),
        (
            {"columns": {"tau": ["ta", "tb", "tb", "td"]}},
            "columns must name every column once, found 'tb' several times",
        ),
        ({"columns": {"q": "x{1}", "qd": "x{1}"}}, r"columns must name every column once, found 'x\{1\}'"),
        ({"gain": 2.0}, r"gain must be numbers, one per joint, such as \(2.0, 1.5\), .*found 2.0"),
        ({"gain": "much"}, "gain must be numbers, one per joint, .*found 'much'"),
        ({"gain": (1.0, math.nan)}, "gain must be finite numbers"),
        ({"joints": 2.0}, "joints must be a whole number from 0, found 2.0"),
        ({"cutoff_qd": "8"}, "cutoff_qd must be a positive number, found '8'"),
        ({"fastest": math.nan}, "fastest must be a positive number, found nan"),
    ],
)
def test_names_of_columns_are_checked(options, message):
    with pytest.raises(TorchdqError, match=message):
        learning.Layout(**options)


def test_a_column_is_read_for_one_signal(tmp_path):
    heads = ["time", "q1", "q2", "qd1", "qd2", "tau1", "tau2"]
    path = written(tmp_path / "log.csv", np.ones((3, 7)), heads)
    with pytest.raises(learning.LogError, match="'q2' would be read for several signals or joints"):
        learning.read(path, learning.Layout(columns={"tau": ["tau1", "q2"]}))


def test_gains_may_be_any_row_of_numbers():
    for gain in ([2.0, 1.5], np.array([2.0, 1.5]), (2, 1.5)):
        assert learning.Layout(gain=gain).gain == (2.0, 1.5)


def test_a_missing_column_says_how_many_others_there_are(tmp_path):
    heads = ["stamp", *(f"{joint}_{what}" for what in ("pos", "vel", "eff") for joint in ("base", "elbow"))]
    for more, end in ((0, "elbow_eff$"), (1, "extra0$"), (5, "extra0 and 4 more$")):
        path = written(tmp_path / "log.csv", np.ones((3, 7 + more)), heads + [f"extra{i}" for i in range(more)])
        with pytest.raises(learning.LogError, match=f"found stamp, base_pos, .*{end}"):
            learning.read(path)


def test_every_field_of_a_layout_is_explained():
    text = learning.Layout.__doc__ or ""
    entries = text[text.index("Args:") : text.index(">>>")]
    for field in dataclasses.fields(learning.Layout):
        assert re.search(rf"^ +(\w+, )?{field.name}(, \w+)?: ", entries, re.MULTILINE), field.name
    assert entries.count("[rad") == 6 and "[Hz]" in entries and "a list of names in the robot's order" in entries


def warned(path: Path, **settings) -> list[str]:
    """Warnings of a log that is read."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        learning.read(path, **settings)
    assert all(one.category is learning.LogWarning and one.filename == __file__ for one in seen)
    return [str(one.message) for one in seen]


def test_a_file_that_ends_within_its_last_number_is_told(tmp_path):
    path = written(tmp_path / "log.csv", table(0.5, 2), names(2))
    assert warned(path) == []
    whole = path.read_text().rstrip("\n")
    path.write_text(whole)  # without the last line break, as many programs write it
    assert warned(path) == []
    for cut in (whole[:-8], whole[:-9]):
        path.write_text(cut)
        (told,) = warned(path)
        assert re.search(r"log\.csv, row 501: the last number has fewer .* leave the row out by rows=\(0, 499\)$", told)
        assert warned(path, rows=(0, 499)) == []
        assert "rows=(10, 499)" in warned(path, rows=(10, 600))[0]
        path.write_text(cut + "\n")
        assert warned(path) == []


def test_positions_that_jump_farther_than_their_velocities_explain_are_told(tmp_path):
    rows = table(0.5, 2)

    def told(change) -> list[str]:
        changed = rows.copy()
        change(changed)
        return warned(written(tmp_path / "log.csv", changed, names(2)))

    assert told(lambda x: None) == []
    (one,) = told(lambda x: np.add.at(x, (100, 2), 1.0))
    assert re.search(r"log\.csv, row 102, column 'q2': it changes by \S+ within 0.00\d+ s, of which its", one)
    assert "the first of 2 such jumps; is a number wrong, or does an angle turn over at pi?" in one

    def twice(x):
        x[200, 0], x[200, 1] = x[199, 0], x[199, 1] - 0.3

    (one,) = told(twice)
    assert "row 202, column 'q1'" in one and "within 0 s" in one

    def over(x):
        x[300:, 1] -= 2 * np.pi

    assert "it changes by 6.28 within" in told(over)[0]
    assert told(lambda x: np.add.at(x, (100, 2), 0.01)) == []  # noise


def test_a_layout_must_be_one(log):
    with pytest.raises(ArgumentError, match=r"layout must be a Layout, found dict; .*Layout\(columns="):
        learning.read(log, {"time": "stamp"})
    with pytest.raises(ArgumentError, match="rows must be a first row"):
        learning.read(log, rows=5)
    for rows in ((1.5, 100), (0, 10.0), (True, 10), ("0", "9"), (0, None), (-1, 5)):
        with pytest.raises(ArgumentError, match=r"rows must be a first row .* whole numbers, found"):
            learning.read(log, rows=rows)
    assert len(learning.read(log, rows=(np.int64(0), np.int64(10))).time) == 10
    with pytest.raises(ArgumentError, match="gain must have 7 numbers, one per joint, found 2"):
        learning.read(log, learning.Layout(gain=(1.0, 2.0)))


# --- smoothing -------------------------------------------------------------------------------------------------------


def test_smoothing_recovers_a_known_motion(log):
    """Although the steps are uneven by 60 %."""
    found = learning.smooth(learning.read(log))
    for name, x, expected in zip(("q", "qd", "qdd", "tau"), found[1:5], motion(found.time), strict=True):
        assert abs(x - expected).max() < 1e-3 * abs(expected).max(), name
    assert np.diff(found.time).std() < 1e-9
    assert found.time[0] >= learning.read(log).time[0] + motions.ENDS


def phase_of(x: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Phase of the motion's frequency in each column [rad], by least squares on whole numbers of rows."""
    basis = np.stack([np.sin(RATE * time), np.cos(RATE * time), np.ones_like(time)], axis=-1)
    sine, cosine, _ = np.linalg.lstsq(basis, x, rcond=None)[0]
    return np.arctan2(cosine, sine)


def test_a_sine_keeps_its_phase(log):
    """A lag of one row would be 4e-3 rad; accelerations are opposite to the positions to 1e-5 rad."""
    found = learning.smooth(learning.read(log))
    expected = np.arange(7) * 1.0
    for x, ahead in ((found.q, 0.0), (found.qd, np.pi / 2), (found.qdd, np.pi), (found.tau, np.pi / 2)):
        lag = np.angle(np.exp(1j * (phase_of(x, found.time) - expected - ahead)))
        assert abs(lag).max() < 2e-5


def test_smoothing_removes_noise_without_delay(tmp_path):
    rows = table(20.0)
    rows[:, 1:] += np.random.default_rng(1).normal(0, 0.1, rows[:, 1:].shape)
    found = learning.smooth(learning.read(written(tmp_path / "noisy.csv", rows, names(7)), LAYOUTS["panda"]))
    _, qd, qdd, tau = motion(found.time)
    assert (found.qd - qd).std() < 0.02 and (found.tau - tau).std() < 0.02
    assert (found.qdd - qdd).std() < 0.02 * qdd.std()
    delay = (found.tau * motion(found.time + 0.01)[3]).sum() - (found.tau * motion(found.time - 0.01)[3]).sum()
    assert abs(delay) < 1e-3 * (found.tau * tau).sum()


def test_accelerations_of_the_log_are_preferred(tmp_path):
    found = arrays()
    found["qdd"] = 1.01 * found["qdd"]
    np.savez(tmp_path / "log.npz", **found)
    smoothed = learning.smooth(learning.read(tmp_path / "log.npz"))
    np.testing.assert_allclose(smoothed.qdd, 1.01 * motion(smoothed.time, 3)[2], atol=1e-3 * RATE**2)


def test_frequencies_may_be_chosen(tmp_path):
    read = learning.read(written(tmp_path / "log.csv", table(20.0), names(7)))
    narrow = learning.smooth(read, cutoff_qd=0.7, cutoff_tau=30.0)
    # twice through a filter of order four, a sine at the cutoff is halved
    assert abs(narrow.qd).max() == pytest.approx(RATE / 2, rel=0.05)
    np.testing.assert_allclose(narrow.tau, motion(narrow.time)[3], atol=1e-3)
    for rate in (1e-9, 5e-324):
        with pytest.raises(ArgumentError, match=rf"rate must leave rows of the 20.1 s of motion, found {rate:g} Hz"):
            learning.smooth(read, rate=rate)
    for name in ("cutoff_qd", "cutoff_tau"):
        with pytest.raises(ArgumentError, match=rf"{name} must be between 0 and .* found '8'"):
            learning.smooth(read, **{name: "8"})
        with pytest.raises(
            ArgumentError, match=rf"{name} must be between 0 and \d+\.?\d* Hz, half the rate, found 600"
        ):
            learning.smooth(read, **{name: 600.0})
        with pytest.raises(ArgumentError, match=f"{name} must be"):
            learning.smooth(read, **{name: 0.0})


def test_rows_at_rest_are_left_out(tmp_path):
    rows = table(6.0)
    resting = (rows[:, 0] > 2) & (rows[:, 0] < 4)
    rows[resting, 8:15] = 0.0
    found = learning.smooth(learning.read(written(tmp_path / "pause.csv", rows, names(7))))
    assert not ((found.time > 2.5) & (found.time < 3.5)).any()
    assert (found.time < 1.5).any() and (found.time > 4.5).any()


def test_too_little_motion_is_refused(tmp_path):
    with pytest.raises(learning.LogError, match=r"short\.csv: 1\.02 s of motion, more than 1\.5 s are needed"):
        learning.smooth(learning.read(written(tmp_path / "short.csv", table(1.0), names(7))))
    rows = table()
    rows[:, 8:15] = 0.0
    with pytest.raises(learning.LogError, match=r"still\.csv: no joint ever moves faster"):
        learning.smooth(learning.read(written(tmp_path / "still.csv", rows, names(7))))


def test_without_scipy_the_message_says_so(log, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.signal", None)
    with pytest.raises(MissingLibraryError, match="smooth needs scipy, which is not installed; pip install scipy"):
        learning.smooth(learning.read(log))


# --- splitting -------------------------------------------------------------------------------------------------------


def test_a_cut_keeps_the_parts_apart(log):
    whole = learning.smooth(learning.read(log))
    before, after = learning.cut(whole, 0.6)
    assert len(before.time) == np.ceil(0.6 * len(whole.time))
    assert after.time[0] - before.time[-1] >= motions.ENDS
    assert after.time[0] - before.time[-1] < motions.ENDS + 0.002
    np.testing.assert_array_equal(after.tau[-1], whole.tau[-1])
    for share in (0.0, 1.0, 0.99, -1.0):
        with pytest.raises(ArgumentError, match=r"share must leave rows on both sides of the cut of \d+ rows"):
            learning.cut(whole, share)


def test_whole_motions_are_held_out(log):
    whole = learning.smooth(learning.read(log))
    motions = [whole._replace(tau=np.full_like(whole.tau, i)) for i in range(10)]
    fitted, tested = learning.hold_out(motions, 0.3, seed=4)
    assert sorted(m.tau[0, 0] for m in fitted + tested) == list(range(10)) and len(tested) == 3
    assert [m.tau[0, 0] for m in learning.hold_out(motions, 0.3, seed=4)[1]] == [m.tau[0, 0] for m in tested]
    others = [learning.hold_out(motions, 0.3, seed=k)[1] for k in range(3)]
    assert any([m.tau[0, 0] for m in other] != [m.tau[0, 0] for m in tested] for other in others)
    assert len(learning.hold_out(motions[:2], 0.01)[1]) == 1 and len(learning.hold_out(motions[:2], 0.99)[0]) == 1
    with pytest.raises(ArgumentError, match="motions must be at least two to hold one out, found 1"):
        learning.hold_out(motions[:1], 0.5)
    with pytest.raises(ArgumentError, match="share must be between 0 and 1, found 1"):
        learning.hold_out(motions, 1.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_are_the_rows_of_all_motions(log, dtype):
    whole = learning.smooth(learning.read(log))
    before, after = learning.cut(whole, 0.5)
    found = learning.samples([before, after], dtype)
    for name, x in found._asdict().items():
        expected = np.concatenate([getattr(before, name), getattr(after, name)])
        torch.testing.assert_close(x, torch.tensor(expected, dtype=dtype), rtol=0, atol=0)
    assert torch.equal(learning.samples(before, dtype).q, found.q[: len(before.q)])
    with pytest.raises(ArgumentError, match=r"motions must be of one arm, found motions of \[3, 7\] joints"):
        learning.samples([before, before._replace(q=before.q[:, :3])])
    with pytest.raises(ArgumentError, match="found motions of no joints"):
        learning.samples([])


@pytest.mark.parametrize("kind", ["log", "motion", "samples"])
def test_they_print_as_tables(log, kind):
    """Shape, range and unit of every signal in place of thousands of numbers."""
    read = learning.read(log)
    motion = learning.smooth(read)
    found = {"log": read, "motion": motion, "samples": learning.samples(motion)}[kind]
    lines = str(found).splitlines()
    assert repr(found) == str(found) and len(lines) < 10
    (row,) = [line for line in lines if line.startswith("qd ")]
    assert str(list(found.qd.shape)) in row and f"{float(found.qd.max()):.4g}" in row and row.endswith("rad/s")
    if kind == "log":
        assert lines[0] == f"{log}: 7 joints, {len(read.time)} rows, 0 repeated time stamps left out"


# --- recordings of real arms -----------------------------------------------------------------------------------------


def recording(name: str, **options) -> learning.Log:
    if not (DATA / name).exists():
        pytest.skip(f"no recording {DATA / name}; TORCHDQ_DATA names the folder that holds it")
    return learning.read(DATA / name, layout_of(DATA / name), **options)


@pytest.mark.parametrize(
    ("name", "layout", "rows", "rate"),
    [
        ("panda_gaz2019/panda_exciting_traj1.csv", "panda", 20544, 1000),
        ("ur10e_innopolis/ur-20_02_19_14harm50sec.csv", "ur10e", 5375, 100),
        ("double_pendulum_dfki_A0/trajectory_00.csv.gz", "double_pendulum", 4997, 500),
        ("double_pendulum_dfki_A0/trajectory_11.csv.gz", "double_pendulum", 3857, 660),  # with two columns more
    ],
)
def test_recordings_are_read(name, layout, rows, rate):
    log = recording(name)
    assert log.layout is LAYOUTS[layout]
    assert len(log.time) + log.repeats == rows
    found = learning.smooth(log)
    assert 1 / np.diff(found.time).min() == pytest.approx(rate, rel=0.02)
    # positions are not filtered: they change as the filtered velocities say
    for joint in range(log.layout.joints):
        integral = np.cumsum(found.qd[:, joint]) * np.diff(found.time).min()
        if np.diff(found.time).max() < 0.02 and found.qd[:, joint].std() > 0.1:
            drift = found.q[:, joint] - integral
            assert drift.std() < 0.05 * found.q[:, joint].std() + 0.02, joint


def test_spoilt_rows_are_left_out_by_rows():
    name = "ur10e_innopolis/ur-20_02_19_15harm50secLoad.csv"
    words = (
        r"row 2, column 'time': 3048 s before the row above; read a part of it .* runs on: rows=\(10, 6106\) of 64.1 s"
    )
    with pytest.raises(learning.LogError, match=words):
        recording(name)
    assert len(recording(name, rows=(10, 6106)).time) > 5000
    with pytest.raises(learning.LogError, match=r"runs on: rows=\(10, 6106\)"):
        recording(name, rows=(1, 6106))


def test_parts_of_a_log_whose_time_jumps_are_named():
    time = np.concatenate([np.arange(100), 40 + np.arange(100), 500 + np.arange(50)]) * 0.01
    q = np.sin(np.stack([time, 2 * time], 1))
    log = {"time": time, "q": q, "qd": None, "tau": q + np.arange(250)[:, None]}
    parts = r"rows=\(0, 100\) of 0.99 s or rows=\(100, 200\) of 0.99 s or rows=\(200, 250\) of 0.49 s"
    with pytest.raises(learning.LogError, match=f"row 100, column 'time': 0.59 s before .*{parts}"):
        learning.read(log)
    again = log | {"tau": q}  # the rows from 100 to 159 are those from 40 to 99
    cure = r"rows 100 to 159 repeat rows 40 to 99; leave them out: read rows=\(0, 100\) and rows=\(160, 250\)"
    with pytest.raises(learning.LogError, match=cure):
        learning.read(again)
    assert len(learning.read(again, rows=(0, 100)).time) == 100
    with pytest.raises(learning.LogError, match=r"3.61 s after the row above.* rows=\(160, 200\) .* rows=\(200, 250\)"):
        learning.read(again, rows=(160, 250))


def test_the_double_pendulums_elbow_is_explained_by_its_published_model():
    """The published parameters of the data set, in a model written out here, explain the elbow's torque."""
    found = learning.smooth(recording("double_pendulum_dfki_A0/trajectory_03.csv.gz"))
    (q1, q2), (v1, v2), (a1, a2) = found.q.T, found.qd.T, found.qdd.T
    inertia, rotor, gear, mass, length, com = 0.02392374528789766, 7.659297952841183e-05, 6.0, 0.6043459, 0.3, 0.1837769
    coupling = mass * length * com
    tau = (inertia + coupling * np.cos(q2) - gear * rotor) * a1 + (inertia + gear**2 * rotor) * a2
    tau += coupling * np.sin(q2) * v1**2 + 9.81 * mass * com * np.sin(q1 + q2)
    tau += 0.001 * v2 + 0.078 * 2 / np.pi * np.arctan(100 * v2)
    measured = found.tau[:, 1]
    assert 1 - ((measured - tau) ** 2).mean() / measured.var() > 0.95


def test_a_log_of_any_seven_joints_is_no_data_set(tmp_path, log):
    """Columns alone name nothing: those of the Panda's log are the ones any seven joints have."""
    assert layout_of(log) is LAYOUTS["csv"]
    assert layout_of(written(tmp_path / "nine.csv", table(n=9), names(9))) is LAYOUTS["csv"]
    without_time = tmp_path / "t.csv"
    without_time.write_text("t,a,b\n0,1,2\n")
    assert layout_of(without_time) is LAYOUTS["csv"]
    heads = names(2, ("pos_meas", "vel_meas", "tau_meas"))
    assert layout_of(written(tmp_path / "pendulum.csv", table(n=2), heads)) is LAYOUTS["csv"]


def test_a_data_set_is_recognised_by_the_name_of_its_file_and_its_columns(tmp_path):
    panda = written(tmp_path / "panda_exciting_traj1.csv", table(), names(7))
    assert layout_of(panda) is LAYOUTS["panda"]
    assert layout_of(written(panda, table(n=6), names(6))) is LAYOUTS["csv"]
    ur10e = written(tmp_path / "ur-20_02_19.csv", np.ones((3, 31)), None)
    assert layout_of(ur10e) is LAYOUTS["ur10e"]
    assert layout_of(written(ur10e, np.ones((3, 30)), None)) is LAYOUTS["csv"]
    assert layout_of(written(ur10e, np.ones((3, 31)), names(10))) is LAYOUTS["csv"]
    heads = names(2, ("pos_meas", "vel_meas", "tau_meas"))
    pendulum = written(tmp_path / "trajectory_03.csv", table(n=2), heads)
    packed = tmp_path / "trajectory_03.csv.gz"
    packed.write_bytes(gzip.compress(pendulum.read_bytes()))
    assert layout_of(pendulum) is layout_of(packed) is LAYOUTS["double_pendulum"]


def test_the_example_prints_what_it_recognised(tmp_path, capsys):
    for needed in ("matplotlib", "pytorch_kinematics", "rich", "tyro"):
        pytest.importorskip(needed, reason="the examples need the extra 'examples'")
    example = import_module("01_inverse_dynamics")
    example.read_log(str(written(tmp_path / "panda_exciting_traj1.csv", table(), names(7))), "auto")
    assert "panda_exciting_traj1.csv: recognised as panda" in capsys.readouterr().out
    example.read_log(str(written(tmp_path / "mine.csv", table(), names(7))), "auto")
    assert "mine.csv: of no data set that is known" in capsys.readouterr().out


def test_the_robot_of_a_layout_is_shipped_with_its_joints():
    for kind in LAYOUTS.values():
        assert kind.robot is None or torchdq.robots.load(kind.robot).n == kind.joints


@pytest.mark.parametrize("wrong", ["std.csv", None, 3])
def test_what_is_no_log_and_no_motion_is_named(wrong):
    with pytest.raises(ArgumentError, match=r"log must be a Log, found .*read\(path\)"):
        motions.smooth(wrong)
    with pytest.raises(ArgumentError, match=r"motions must be Motion objects, found .*smooth\(log\)"):
        motions.samples(wrong)
