"""Logs are read as written, from files of all kinds and from arrays, and refused by row and column with a cure.

The recordings of real arms are not part of the package: their tests look in the folder that TORCHDQ_DATA names, or next
to the checkout, and are skipped without it.
"""

import contextlib
import gzip
import io
import itertools
import pickle
import warnings
import zipfile
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import EVERYTHING, all_in_one
from messages import refused
from recorded_logs import arrays, codes, log_refused, names, recordings, sines, table, with_findings, written
from recordings import LAYOUTS, layout_of

import torchdq
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.learning import Layout, Log, LogError, LogWarning, MissingLogError, read_log, smooth

pytest.importorskip("scipy", reason="rates need scipy")


@pytest.fixture
def log(tmp_path):
    return written(tmp_path / "log.csv", table(), names(7))


def assert_holds(found: Log, rows: np.ndarray):
    np.testing.assert_allclose(np.column_stack([found.time, found.q, found.qd, found.tau]), rows, atol=1e-7)


# --- what is read ----------------------------------------------------------------------------------------------------


def test_a_log_is_read_as_written(log):
    assert_holds(read_log(log, rows=(np.int64(100), np.int64(200))), table()[100:200])
    for n in (1, 3, 7, 9):
        found = read_log(written(log, table(n=n), names(n)))
        assert found.layout == Layout(joints=n) and found.repeats == 0 and found.qdd is None and not found.findings
        assert_holds(found, table(n=n))


def test_columns_are_found_by_name_and_others_stay_unread(tmp_path):
    rows, heads = table(n=3), names(3)
    order = np.random.default_rng(0).permutation(len(heads))
    shuffled = np.column_stack([np.full(len(rows), np.nan), rows[:, order]])
    assert_holds(read_log(written(tmp_path / "log.csv", shuffled, ["temperature", *(heads[i] for i in order)])), rows)
    heads = names(2, ("pos_meas", "vel_meas", "pos_filt", "tau_con", "tau_meas"))
    rows = table(n=2)
    wide = np.column_stack([rows[:, :5], np.full((len(rows), 4), 7.0), rows[:, 5:]])
    layout = Layout(joints=2, columns={"q": "pos_meas{1}", "qd": "vel_meas{1}", "tau": "tau_meas{1}"})
    found = read_log(written(tmp_path / "log.csv", wide, heads), layout)
    assert found.layout is layout
    assert_holds(found, rows)


def test_an_archive_and_arrays_are_read_without_a_digit_lost(tmp_path):
    known, path = arrays(), tmp_path / "log.npz"
    np.savez(path, **known)
    tensors = {name: torch.tensor(x, requires_grad=True) for name, x in known.items()}
    lists = {name: x.tolist() for name, x in known.items()}
    for source in (path, known, tensors, lists):
        found = read_log(source)
        for name, x in known.items():
            np.testing.assert_array_equal(getattr(found, name), x)
        np.testing.assert_array_equal(read_log(source, rows=(10, 30)).q, known["q"][10:30])
    np.savez(path, **arrays(7))
    assert read_log(path, LAYOUTS["panda"]).layout is LAYOUTS["panda"] and read_log(known).path.name == "the arrays"
    other = {"t": known["time"], "position": known["q"], "qd": known["qd"], "tau": known["tau"], "temperature": "hot"}
    np.testing.assert_array_equal(read_log(other, Layout(columns={"time": "t", "q": "position"})).q, known["q"])


def test_repeated_time_stamps_are_dropped_and_counted(log):
    lines = log.read_text().splitlines()
    log.write_text("\n".join([*lines[:50], lines[49], *lines[50:]]))
    found = read_log(log)
    assert found.repeats == 1 and (np.diff(found.time) > 0).all() and len(found.time) == len(table())


SOURCES = {
    "an address": Path.as_uri,
    "an open file": Path.open,
    "an open file of bytes": lambda log: log.open("rb"),
    "bytes": Path.read_bytes,
    "packed": lambda log: gzip.compress(log.read_bytes()),
    **{name: lambda log, name=name: log.read_text().encode(name) for name in ("utf-8-sig", "utf-16", "utf-32")},
    "marked": lambda log: ("\ufeff" + log.read_text()).encode("utf-16-le"),
}


@all_in_one(SOURCES)
def test_a_log_may_be_an_address_an_open_file_or_bytes_packed_and_encoded(kind, log):
    source = SOURCES[kind](log)
    with source if hasattr(source, "close") else contextlib.nullcontext():
        assert_holds(read_log(source), table())


@all_in_one([0.0, -1.0, "50", 5000.0, 1.0, float("nan")])
def test_logs_are_read_at_a_rate(wrong):
    stamps = np.cumsum(np.random.default_rng(0).uniform(0.4, 1.6, 10_000)) / 2000
    found = read_log(arrays(time=stamps), rate=50.0)
    assert np.allclose(np.diff(found.time), 0.02) and len(found.time) == pytest.approx(250, abs=3)
    for name in ("time", "q", "qd", "tau"):
        exact = arrays(time=found.time)[name]
        np.testing.assert_allclose(getattr(found, name)[10:-10], exact[10:-10], atol=1e-3)
    with refused(ArgumentError):
        read_log(arrays(time=np.arange(0, 5, 1e-3)), rate=wrong)
    with log_refused("log.rows"):
        read_log(arrays(time=np.arange(0, 0.025, 1e-3)), rate=100.0)


def test_a_log_may_be_checked_against_its_robot():
    robot = torchdq.robots.load("panda")
    with log_refused("log.joints"):
        read_log(arrays(), robot=robot)
    known = arrays(7)
    known["q"] = 0.1 * known["q"] + robot.limits.lower.numpy() / 2
    known["q"][:, 3] -= 40
    found, findings = with_findings(read_log, known | {"qd": None}, Layout(farthest=1e3), robot=robot)
    assert [(one.code, one.subject) for one in findings] == [("position.limits", "panda_joint4")]
    assert found.findings == tuple(findings)


# --- what is refused -------------------------------------------------------------------------------------------------


def test_arguments_are_checked(log, tmp_path):
    rows = (5, (20, 10), (1.5, 100), (0, 10.0), (True, 10), ("0", "9"), (0, None), (-1, 5))
    for error, source, options in (
        (FileNotFoundError, tmp_path / "missing.csv", {}),
        (MissingLogError, tmp_path / "missing.csv", {}),
        *((LogError, source, {}) for source in (tmp_path, "https://host/log.csv", b"")),
        *((ArgumentError, source, {}) for source in (None, 5, [5], [])),
        *((ArgumentError, log, {"rows": x}) for x in rows),
        *((ArgumentError, log, {"layout": x}) for x in ({"time": "stamp"}, Layout(gain=(1.0, 2.0)))),
    ):
        with refused(error):
            read_log(source, **options)
    with log_refused("column.missing"):
        read_log(log, LAYOUTS["double_pendulum"])
    with log_refused("log.rows"):
        read_log(log, rows=(100_000, 100_010))
    with log_refused("log.joints"):
        read_log(written(log, table(n=9), names(9)), LAYOUTS["panda"])
    assert issubclass(LogError, TorchdqError) and LogError.__module__ == LogWarning.__module__ == "torchdq.learning"


def test_rows_and_columns_are_named_as_in_the_file_when_only_some_are_read(log):
    lines = log.read_text().splitlines()
    lines[216] = ",".join([*lines[216].split(",")[:10], "nan", *lines[216].split(",")[11:]])
    log.write_text("\n".join(lines))
    with log_refused("cell.number"):
        read_log(log, rows=(200, 300))
    read_log(log, rows=(216, 300))


DEGREES = 180 / np.pi


@pytest.mark.parametrize(
    ("columns", "factor", "code", "size"),
    [
        ((3,), DEGREES, "q.unit", 1.0),
        ((12,), DEGREES, "qd.unit", 1.0),
        ((3,), 0.1 * DEGREES, "columns.rate", 1.0),
        ((12,), -1.0, "columns.rate", 1.0),
        ((4, 5), (0.3 * DEGREES, 0.3), "columns.rate", 1.0),
        ((2,), DEGREES, "columns.rate", 0.05),  # three degrees, far within any range
        ((9,), DEGREES, "columns.rate", 0.05),
        ((0,), 1000.0, "time.unit", 1.0),
        ((0,), 0.0, "time.still", 1.0),
    ],
)
def test_wrong_units_are_refused_by_column(tmp_path, columns, factor, code, size):
    rows = table()
    rows[:, 1:15] *= size
    rows[:, list(columns)] *= factor
    with log_refused(code):
        read_log(written(tmp_path / "log.csv", rows, names(7)))


def test_a_log_may_have_ten_rows_a_second():
    time = np.arange(0, 20, 0.1)
    known = {"time": time, "q": np.sin(time)[:, None], "qd": np.cos(time)[:, None], "tau": None}
    assert len(read_log(known).time) == 200
    late = {name: x if x is None else np.delete(x, [50, 51], axis=0) for name, x in known.items()}
    with log_refused("time.gap"):
        read_log(late)


def test_positions_that_follow_the_velocity_of_another_joint_are_refused():
    time, rates = np.linspace(0.0, 10.0, 1001), np.arange(1.0, 8.0)
    q, qd = np.sin(np.outer(time, rates)), rates * np.cos(np.outer(time, rates))
    with log_refused("columns.order"):
        read_log({"time": time, "q": q[:, [0, 2, 1, 3, 4, 5, 6]], "qd": qd, "tau": q})


def test_a_joint_that_turns_far_has_a_layout_that_allows_it():
    known = arrays(1)
    known["q"] += 100.0
    with log_refused("q.unit"):
        read_log(known)
    assert read_log(known, Layout(farthest=np.inf)).q.max() > 100


# --- malformed sources -----------------------------------------------------------------------------------------------

ROWS = [f"{0.01 * k:.2f},{np.sin(0.01 * k):.6f},{np.cos(0.01 * k):.6f},{0.1 * k:.3f}" for k in range(50)]
HEAD = "time,q1,qd1,tau1\n"
GOOD = HEAD + "\n".join(ROWS) + "\n"


def zipped(**members):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        for name, text in members.items():
            file.writestr(name.replace("_", "."), text)
    return content.getvalue()


def array(x):
    content = io.BytesIO()
    np.save(content, x)
    return content.getvalue()


def replaced(row, text):
    return HEAD + "\n".join([*ROWS[:row], text, *ROWS[row + 1 :]]) + "\n"


MALFORMED = {
    "nothing": ("\n", "log.empty"),
    "blanks": (" \n \n", "log.empty"),
    "a header alone": (HEAD, "log.rows"),
    "one row": (HEAD + ROWS[0], "log.rows"),
    "decimal commas": (HEAD + "\n".join(row.replace(".", ",") for row in ROWS), "row.columns"),
    "stamps of a clock": (HEAD + "\n".join(f"10:00:0{row}" for row in ROWS), "cell.number"),
    "no header": ("\n".join(ROWS), "column.missing"),
    "capitals": (GOOD.replace("time", "Time"), "column.missing"),
    "other names": (GOOD.replace("q1,qd1", "a,b"), "column.missing"),
    "utf-16 without a mark": (GOOD.replace("tau1", "tau1,température").encode("utf-16-le"), "log.damaged"),
    "zeros": (GOOD.replace("0.1", "\0"), "cell.number"),
    "empty lines": (GOOD.replace("\n", "\n\n"), "row.columns"),
    "another time": (GOOD.replace("time", "stamp"), "column.missing"),
    "another velocity": (GOOD.replace("qd1", "tau7"), "column.missing"),
    "two tau1": (GOOD.replace("tau1", "tau1,tau1", 1).replace("\n", ",1\n"), "column.repeated"),
    "two q1": (GOOD.replace("qd1", "q1"), "column.repeated"),
    "a short row": (replaced(9, "0.09,1"), "row.columns"),
    "a long row": (replaced(9, ROWS[9] + ",5"), "row.columns"),
    "a word": (replaced(9, "0.09,x,1,1"), "cell.number"),
    "a number left out": (replaced(9, "0.09,,1,1"), "cell.number"),
    "no number": (replaced(9, "0.09,nan,1,1"), "cell.number"),
    "an underscore": (replaced(9, "0.09,1_0,1,1"), "cell.number"),
    "a number too large": (replaced(9, "0.09,1e400,1,1"), "cell.number"),
    "backwards": (HEAD + "\n".join(ROWS[::-1]), "time.backwards"),
    "milliseconds": (HEAD + "\n".join(f"{10 * k},0,0,{k}" for k in range(50)), "time.unit"),
    "nanoseconds": (HEAD + "\n".join(f"{10**18 + 10**7 * k},0,0,{k}" for k in range(50)), "time.unit"),
    "a gap": (HEAD + "\n".join(ROWS[:10] + ROWS[40:]), "time.gap"),
    "joints 1 and 3": ("time,q1,q3,qd1,qd3,tau1,tau3\n" + "0,0,0,0,0,0,0\n" * 3, "column.missing"),
    "a velocity missing": ("time,q1,q2,qd1,tau1,tau2\n" + "0,0,0,0,0,0\n" * 3, "column.missing"),
    "a packed file cut short": (gzip.compress(GOOD.encode())[:60], "log.damaged"),
    "many columns": (",".join(f"c{i}" for i in range(100_000)) + "\n1", "column.missing"),
    "a zip of a log": (zipped(log_csv=GOOD), "log.zip"),
    "an empty zip": (zipped(), "column.missing"),
    "one array": (array(np.zeros((5, 4))), "column.missing"),
    "an archive of what says it is huge": (
        zipped(q_npy="\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (10, 99999999999999)}"),
        "column.missing",
    ),
    "JSON": ('{"time": [0, 1], "q": 3}', "log.kind"),
    "pickle": (pickle.dumps({"a": 1}), "log.kind"),
    "Parquet": (b"PAR1" + bytes(50), "log.kind"),
    "HDF5": (b"\x89HDF\r\n\x1a\n" + bytes(50), "log.kind"),
    "a bag": (b"#ROSBAG V2.0\n", "log.kind"),
    "a ROS 2 bag": (b"SQLite format 3\0", "log.kind"),
    "bytes": (bytes(range(256)), "log.damaged"),
}


@pytest.mark.parametrize("way", MALFORMED)
def test_a_malformed_log_is_refused_with_the_cure(tmp_path, way):
    content, code = MALFORMED[way]
    (tmp_path / "log").write_bytes(content if isinstance(content, bytes) else content.encode())
    with log_refused(code):
        read_log(tmp_path / "log")


def test_an_archive_that_is_damaged_anywhere_is_read_or_refused(tmp_path):
    """Every so many bytes of an archive, changed: numpy's and zipfile's own errors never come through."""
    np.savez_compressed(tmp_path / "log.npz", **{k: x[:30] for k, x in arrays(1).items()})
    whole = (tmp_path / "log.npz").read_bytes()
    for at, change in itertools.product(range(2, len(whole), 7 if EVERYTHING else 17), (1, 0x80)):
        with contextlib.suppress(LogError):
            read_log(whole[:at] + bytes([whole[at] ^ change]) + whole[at + 1 :])
    with log_refused("log.damaged"):
        read_log(whole[: len(whole) // 2])


def test_an_archive_cannot_run_anything(tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    np.savez(tmp_path / "log.npz", **{**arrays(), "q": np.array([Trap()], dtype=object)})
    with log_refused("log.damaged"):
        read_log(tmp_path / "log.npz")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"tau": ...}, "column.missing"),
        ({"q": None}, "column.missing"),
        ({"time": None}, "column.missing"),
        ({"qd": np.zeros((10, 3))}, "array.shape"),
        ({"q": np.full((5000, 3), "a")}, "array.shape"),
        ({"q": 1j * np.ones((5000, 3))}, "array.shape"),
        ({"q": [[1.0], [1.0, 2.0]]}, "array.kind"),
        ({"q": np.full((5000, 3), np.nan)}, "column.empty"),
        ({"q": np.where(np.arange(15000) % 7, 0.0, np.nan).reshape(5000, 3)}, "cell.number"),
        ({"time": arrays()["time"][::-1]}, "time.backwards"),
        ({"qdd": arrays()["qdd"] * DEGREES}, "columns.rate"),
    ],
)
def test_bad_arrays_are_refused(tmp_path, change, code):
    known = {k: x for k, x in {**arrays(), **change}.items() if x is not ...}
    with log_refused(code):
        read_log(known)
    if all(isinstance(x, np.ndarray) for x in known.values()):
        np.savez(tmp_path / "log.npz", **known)
        with log_refused(code):
            read_log(tmp_path / "log.npz")


# --- what is warned of -----------------------------------------------------------------------------------------------


def over(x):
    x[300:, 1] -= 2 * np.pi


def twice(x):
    x[200, 0], x[200, 1] = x[199, 0], x[199, 1] - 0.3


@pytest.mark.parametrize(
    ("change", "column", "row", "value"),
    [
        (lambda x: None, None, 0, 0),
        (lambda x: np.add.at(x, (100, 2), 0.01), None, 0, 0),  # noise
        (lambda x: np.add.at(x, (100, 2), 1.0), "column 'q2'", 102, 1.0),
        (twice, "column 'q1'", 202, -0.3),
        (over, "column 'q1'", 302, -2 * np.pi),
    ],
)
def test_positions_that_jump_farther_than_their_velocities_explain_have_a_finding(tmp_path, change, column, row, value):
    rows = table(0.5, 2)
    change(rows)
    _, found = with_findings(read_log, written(tmp_path / "log.csv", rows, names(2)))
    assert [(one.code, one.subject) for one in found] == ([("position.jump", column)] if column else [])
    for one in found:
        assert one.value == pytest.approx(value, abs=0.01) and f"in row {row} " in one.expected


def test_positions_that_jump_have_a_finding_without_velocities():
    time = np.linspace(0.0, 6.0, 1201)
    q = np.sin(np.outer(time, 2 * np.pi * np.array([0.5, 0.8, 1.1])))
    assert with_findings(read_log, {"time": time, "q": q, "qd": None, "tau": None})[1] == []
    for change, rows in ((2 * np.pi, slice(600, None)), (0.5, slice(600, None)), (-0.5, slice(600, 601))):
        jumping = q.copy()
        jumping[rows, 1] -= change
        _, (one,) = with_findings(read_log, {"time": time, "q": jumping, "qd": None, "tau": None})
        assert (one.code, one.subject) == ("position.jump", "column 'q2'") and "in row 600 " in one.expected
        assert one.value == pytest.approx(-change, abs=0.05) and ("the first of 2" in one.expected) == (change < 0)


def test_a_warning_is_given_where_the_log_is_read(log):
    rows = table()
    rows[100, 17] = 1e4
    with pytest.warns(LogWarning) as given:
        found = read_log(written(log, rows, names(7)))
    assert given[0].filename == __file__ and codes(found.findings) == ["torque.outliers"]
    assert found.findings == given[0].message.findings and found.tau[100, 2] == 1e4
    assert str(given[0].message).startswith(f"{log}, column 'tau3': ")


# --- parts of logs, and recordings of real arms ----------------------------------------------------------------------


def test_parts_of_a_log_whose_time_jumps_are_named():
    time = np.concatenate([np.arange(100), 40 + np.arange(100), 500 + np.arange(50)]) * 0.01
    q = np.sin(np.stack([time, 2 * time], 1))
    log = {"time": time, "q": q, "qd": None, "tau": q + np.arange(250)[:, None]}
    with log_refused("time.backwards"):
        read_log(log)
    again = log | {"tau": q}  # the rows from 100 to 159 are those from 40 to 99
    with log_refused("time.backwards"):
        read_log(again)
    assert len(read_log(again, rows=(0, 100)).time) == 100
    with log_refused("time.gap"):
        read_log(again, rows=(160, 250))


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
    path = recordings(name)
    log = read_log(path, layout_of(path))
    assert log.layout is LAYOUTS[layout] and len(log.time) + log.repeats == rows
    found = smooth(log)
    assert 1 / np.diff(found.time).min() == pytest.approx(rate, rel=0.02)
    # positions change as the filtered velocities say
    for joint in range(log.layout.joints):
        integral = np.cumsum(found.qd[:, joint]) * np.diff(found.time).min()
        if np.diff(found.time).max() < 0.02 and found.qd[:, joint].std() > 0.1:
            drift = found.q[:, joint] - integral
            assert drift.std() < 0.05 * found.q[:, joint].std() + 0.02, joint


def test_spoilt_rows_of_a_recording_are_left_out_by_rows():
    path = recordings("ur10e_innopolis/ur-20_02_19_15harm50secLoad.csv")
    for rows in (None, (1, 6106)):
        with log_refused("time.backwards"):
            read_log(path, layout_of(path), rows)
    assert len(read_log(path, layout_of(path), (10, 6106)).time) > 5000


def test_the_double_pendulums_elbow_is_explained_by_its_published_model():
    """The published parameters of the data set, in a model written out here, explain the elbow's torque."""
    path = recordings("double_pendulum_dfki_A0/trajectory_03.csv.gz")
    found = smooth(read_log(path, layout_of(path)))
    (q1, q2), (v1, v2), (a1, a2) = found.q.T, found.qd.T, found.qdd.T
    inertia, rotor, gear, mass, length, com = 0.02392374528789766, 7.659297952841183e-05, 6.0, 0.6043459, 0.3, 0.1837769
    coupling = mass * length * com
    tau = (inertia + coupling * np.cos(q2) - gear * rotor) * a1 + (inertia + gear**2 * rotor) * a2
    tau += coupling * np.sin(q2) * v1**2 + 9.81 * mass * com * np.sin(q1 + q2)
    tau += 0.001 * v2 + 0.078 * 2 / np.pi * np.arctan(100 * v2)
    measured = found.tau[:, 1]
    assert 1 - ((measured - tau) ** 2).mean() / measured.var() > 0.95


def test_a_data_set_is_recognised_by_the_name_of_its_file_and_its_columns(tmp_path, log):
    """Columns alone name nothing: those of the Panda's log are the ones any seven joints have."""
    unknown = [log, written(tmp_path / "nine.csv", table(n=9), names(9)), tmp_path / "t.csv"]
    unknown[-1].write_text("t,a,b\n0,1,2\n")
    heads = names(2, ("pos_meas", "vel_meas", "tau_meas"))
    unknown.append(written(tmp_path / "pendulum.csv", table(n=2), heads))
    assert all(layout_of(path) is LAYOUTS["csv"] for path in unknown)
    panda = written(tmp_path / "panda_exciting_traj1.csv", table(), names(7))
    assert layout_of(panda) is LAYOUTS["panda"]
    assert layout_of(written(panda, table(n=6), names(6))) is LAYOUTS["csv"]
    ur10e = written(tmp_path / "ur-20_02_19.csv", np.ones((3, 31)), None)
    assert layout_of(ur10e) is LAYOUTS["ur10e"]
    assert layout_of(written(ur10e, np.ones((3, 30)), None)) is LAYOUTS["csv"]
    assert layout_of(written(ur10e, np.ones((3, 31)), names(10))) is LAYOUTS["csv"]
    pendulum = written(tmp_path / "trajectory_03.csv", table(n=2), heads)
    packed = tmp_path / "trajectory_03.csv.gz"
    packed.write_bytes(gzip.compress(pendulum.read_bytes()))
    assert layout_of(pendulum) is layout_of(packed) is LAYOUTS["double_pendulum"]
    for kind in LAYOUTS.values():
        assert kind.robot is None or torchdq.robots.load(kind.robot).n == kind.joints


def test_the_example_prints_what_it_recognised(tmp_path, capsys):
    for needed in ("matplotlib", "pytorch_kinematics", "rich", "tyro"):
        pytest.importorskip(needed, reason="the examples need the extra 'examples'")
    example = import_module("01_inverse_dynamics")
    example.read_log(str(written(tmp_path / "panda_exciting_traj1.csv", table(), names(7))), "auto")
    assert "panda_exciting_traj1.csv: recognised as panda" in capsys.readouterr().out
    example.read_log(str(written(tmp_path / "mine.csv", table(), names(7))), "auto")
    assert "mine.csv: of no data set that is known" in capsys.readouterr().out


# --- anything at all -------------------------------------------------------------------------------------------------


@all_in_one(range(60))
def test_any_columns_are_read_or_refused_by_an_error_of_this_package(seed, tmp_path):
    """Columns left out, doubled, renamed, in another order, in another unit, with layouts of all kinds."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 6.0, 1201)[:60]
    x = dict(zip(("q", "qd", "qdd", "tau"), sines(time, 3), strict=True))
    columns = [("time", time)]
    columns += [(f"{name}{joint + 1}", x[name][:, joint]) for name in ("q", "qd", "tau") for joint in range(3)]
    kept = [columns[i] for i in rng.permutation(len(columns)) if rng.random() < 0.9]
    kept += [kept[i] for i in range(len(kept)) if rng.random() < 0.02]
    odd = [0.96, *[0.01] * 4]
    heads = [str(rng.choice([head, head.upper(), f"{head} [rad]", f'"{head}"', ""], p=odd)) for head, _ in kept]
    rows = np.column_stack([values * rng.choice([1.0, 57.3, 1e3], p=[0.98, 0.01, 0.01]) for _, values in kept])
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    if rng.random() < 0.2:
        lines.insert(int(rng.integers(60)), str(rng.choice(["", "x", "1,2,3", "#", "nan," * 9 + "nan"])))
    separator = str(rng.choice([",", ";", "\t"], p=[0.9, 0.05, 0.05]))
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(heads), *lines][int(rng.random() < 0.05) :]).replace(",", separator) + "\n")
    absent = {name: None for name in ("qd", "tau") if rng.random() < 0.4}
    options = {"columns": absent, "gain": [(), None, (1, 2, 3), (1,)][rng.integers(4)]}
    if rng.random() < 0.3:
        options["transmission"] = [(1.0, 2.0, -1.0), (1.0, 1.0)][rng.integers(2)]
    with contextlib.suppress(LogError, ArgumentError), warnings.catch_warnings():
        warnings.simplefilter("ignore", LogWarning)
        found = read_log(path, Layout(**options), rate=[None, 50.0, 1e4][rng.integers(3)])
        assert found.q.shape[0] == len(found.time) and (found.qd is None) == ("qd" in absent)
        assert found.q.shape[1] == 3 or absent.keys() == {"qd", "tau"}
