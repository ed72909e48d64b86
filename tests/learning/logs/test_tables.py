"""Texts as programs and people write them, arrays and files of MATLAB; the motion is known in closed form."""

import io

import numpy as np
import pytest
from helpers import thinned
from messages import refused
from recorded_logs import HEADS, KNOWN, TABLE, TIME, arrays, assert_holds, log_refused

import torchdq
from torchdq.errors import ArgumentError
from torchdq.learning import Layout, read_log

ROBOT = torchdq.robots.load("two_link")
NUMBERED = {"time": "1", "q": "{2}", "qd": "{4}", "tau": "{6}"}


@pytest.mark.parametrize("separator", thinned([",", ";", "\t", "|", " "], [",", " "]))
@pytest.mark.parametrize("head", ["", "# ", "# measured today\n# at 21 degrees, indoors\n# "])
def test_texts_of_all_separators_are_read_below_comments(tmp_path, separator, head):
    path = tmp_path / "log.txt"
    np.savetxt(path, TABLE, delimiter=separator, header=head + separator.join(HEADS), comments="")
    assert_holds(read_log(path))
    np.savetxt(path, TABLE, delimiter=separator, header=head.removesuffix("# "), comments="" if head else "# ")
    if head:
        path.write_text(path.read_text().replace("\n\n", "\n").removeprefix("\n"))
        assert_holds(read_log(path, Layout(columns=NUMBERED)))


def test_texts_without_a_header_have_numbered_columns(tmp_path):
    path = tmp_path / "log.txt"
    np.savetxt(path, np.column_stack([TABLE, TABLE]))
    found = read_log(path, Layout(columns=NUMBERED | {"tau": "{6}"}, joints=2))
    assert_holds(found)
    assert read_log(path, Layout(columns=NUMBERED)).layout.joints == 2  # up to the columns of velocities
    np.testing.assert_array_equal(read_log(path, Layout(columns=NUMBERED), rows=(3, 9)).q, found.q[3:9])
    np.savetxt(path, TABLE[:, [1, 2, 5, 6]])
    found = read_log(path, Layout(columns={"q": "{1}", "qd": None, "tau": "{3}"}, rate=500.0))
    assert_holds(found._replace(qd=KNOWN["qd"]))
    assert read_log(path, found.layout, rows=(500, 600)).time[0] == 1.0
    for columns in ({"q": "{1}", "qd": "{1}", "tau": "{3}"}, {"q": "{1}", "qd": "{3}", "tau": "{4}"}):
        with log_refused("column.shared"):
            read_log(path, Layout(columns=columns, rate=500.0))
    path.write_text("0,1,2,3\n" + path.read_text().replace(" ", ","))  # names as tables of pandas have them
    assert len(read_log(path, Layout(columns={"q": "{0}", "qd": None, "tau": "{2}"}, rate=500.0)).time) == len(TIME)


def test_names_with_blanks_dashes_units_and_quotation_marks_are_found(tmp_path):
    heads = ["t [s]", "- arm_1_position", "- arm_2_position", '"arm 1 speed"', ' "arm 2 speed"', "eff(1)", "eff(2)"]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(heads), *(",".join(f'"{x:.12g}"' for x in row) for row in TABLE)]))
    names = {"time": "t [s]", "q": "- arm_{1}_position", "qd": "arm {1} speed", "tau": "eff({1})"}
    assert_holds(read_log(path, Layout(columns=names)), atol=1e-7)
    assert_holds(read_log(path, Layout(columns=names | {"q": "arm_{1}_position"})), atol=1e-7)


def test_lines_above_the_names_and_units_below_them_are_left_out(tmp_path):
    path = tmp_path / "log.csv"
    above = "Trace V3.2\nRate;100\n\n", "# arm; free\n# 2 joints\n", ""
    for lines, units in zip(above, (";".join(["ms", *["°"] * 6]) + "\n", "", ""), strict=True):
        np.savetxt(path, TABLE, fmt="%.12f", delimiter=";", header=lines + ";".join(HEADS), comments="")
        head, rows = lines + ";".join(HEADS) + "\n", path.read_text().partition(HEADS[-1] + "\n")[2]
        path.write_bytes((head + units + rows.replace(".", ",")).encode("cp1252"))
        assert_holds(read_log(path))


def test_decimal_commas_beside_semicolons_are_points(tmp_path):
    path = tmp_path / "log.csv"
    np.savetxt(path, TABLE, fmt="%.12f", delimiter=";", header=";".join(HEADS), comments="")
    path.write_text(path.read_text().replace(".", ","))
    assert_holds(read_log(path))


def test_columns_have_the_names_of_the_robots_joints(tmp_path):
    path, order = tmp_path / "log.csv", [0, 2, 1, 4, 3, 6, 5]
    first, second = ROBOT.joint_names
    heads = ["time", *(f"/states/{joint}/{what}" for what in ("q", "qd", "tau") for joint in (second, first))]
    np.savetxt(path, TABLE[:, order], delimiter=",", header=",".join(heads), comments="")
    layout = Layout(columns={name: f"/states/{{joint}}/{name}" for name in ("q", "qd", "tau")})
    assert_holds(read_log(path, layout, robot=ROBOT))
    with refused(ArgumentError):
        read_log(path, layout)


def test_arrays_of_columns_blocks_and_structures_are_read():
    columns = {head: TABLE[:, k] for k, head in enumerate(HEADS)}
    assert_holds(read_log(columns | {"note": "hot", "gain": 3.0}))
    nested = {"out": {"t": TIME[None], "state": {name: KNOWN[name].T for name in ("q", "qd", "tau")}}}
    names = {"time": "out.t"} | {name: f"out.state.{name}" for name in ("q", "qd", "tau")}
    assert_holds(read_log(nested, Layout(columns=names)))
    whole = {"data": TABLE}
    assert_holds(read_log(whole, Layout(columns={"time": "data1", "q": "data{2}", "qd": "data{4}", "tau": "data{6}"})))
    one = arrays(1, TIME)
    np.testing.assert_array_equal(read_log({name: x.ravel() for name, x in one.items()}).q, one["q"])
    file = io.BytesIO()
    np.save(file, TABLE)
    assert_holds(read_log(file.getvalue(), Layout(columns=NUMBERED)))


def test_arrays_without_times_have_a_rate():
    known = {name: KNOWN[name] for name in ("q", "qd", "tau")}
    for some in (known, {name: x.T for name, x in known.items()}):
        assert_holds(read_log(some, Layout(rate=500.0)))
    with log_refused("column.missing"):
        read_log(known)
    with log_refused("column.repeated"):
        read_log(KNOWN | {"q1": TIME})


def test_files_of_matlab_are_read(tmp_path):
    savemat = pytest.importorskip("scipy.io").savemat
    path = tmp_path / "log.mat"
    for row in ("row", "column"):
        savemat(path, {"time": TIME, **{name: KNOWN[name] for name in ("q", "qd", "tau")}}, oned_as=row)
        assert_holds(read_log(path))
        savemat(path, {"log": {"time": TIME, "q": KNOWN["q"].T, "qd": KNOWN["qd"], "tau": KNOWN["tau"]}}, oned_as=row)
        assert_holds(read_log(path, Layout(columns={name: f"log.{name}" for name in ("time", "q", "qd", "tau")})))
    whole = path.read_bytes()
    with log_refused("log.damaged"):
        read_log(whole[: len(whole) // 2])
    with log_refused("log.kind"):
        read_log(b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(500))
