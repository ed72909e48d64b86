"""Layouts name the columns of logs, with half of them or other ones; errors say which model is still possible.

Signals of motors are made from those of the joints by a mechanism written out here, and torques by its lossless power.
"""

import dataclasses
import json
import math
import re
import warnings

import numpy as np
import pytest
from helpers import all_in_one
from messages import refused
from recorded_logs import arrays, log_refused, names, sines, table, with_findings, written

from torchdq import robots
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.learning import Layout, Model, identify, read_log, smooth, stack_samples, train_test_split

pytest.importorskip("scipy", reason="smoothing needs scipy")

COUPLED = ((0.01, 0.0, 0.0), (0.0, -0.0125, 0.0), (0.0, 0.0125, 0.02))  # the second motor turns the third joint too
KNOWN = arrays()


def blocks(path, **signals):
    """CSV file of signals with the joint's number behind their names."""
    heads = ["time", *(f"{name}{joint + 1}" for name, x in signals.items() for joint in range(x.shape[1]))]
    return written(path, np.column_stack([KNOWN["time"], *signals.values()]), heads)


@all_in_one(
    [
        *({"columns": x} for x in ("q", {"velocity": "v{1}"}, {"q": None}, {"time": ["a", "b"]})),
        *({"columns": {"q": x}} for x in (3, ["a", 3], [])),
        *({"rate": x} for x in (0.0, -500.0, "fast")),
        *({"gain": x} for x in (2.0, "much", (1.0, math.nan), (1.0, 0.0))),
        *({name: x} for name, x in (("joints", 2.0), ("cutoff_qd", "8"), ("fastest", math.nan))),
        *({"transmission": x} for x in ((0.01, 0.0), 0.01, "fast", ((1.0, 2.0), (2.0, 4.0)), ((1.0, 2.0),))),
        {"transmission": ((1.0, np.nan), (0.0, 1.0))},
        {"transmission": ((0.0, 1.0), (1.0, 0.0))},
        {"zero": (np.inf,)},
        *({"scale": x} for x in (2.0, {"tau": 2.0}, {"q": 0.0}, {"q": "much"}, {"time": -1.0})),
        {"at_motors": ("time",)},
    ]
)
def test_arguments_are_checked(options):
    with refused(TorchdqError):
        Layout(**options)


@all_in_one(
    [
        {"transmission": (0.1, 0.1)},
        {"transmission": ((1.0, 0.0), (0.0, 1.0))},
        {"transmission": (1, 1, 1), "zero": (0.1,)},
        {"zero": (0.1,)},
        {"scale": {"qd": (1.0, 2.0)}},
    ]
)
def test_they_are_checked_against_the_log(options):
    with refused(ArgumentError):
        read_log(KNOWN, Layout(**options))


def test_gains_are_rows_of_numbers_some_of_which_may_be_unknown():
    for gain in ([2.0, 1.5], np.array([2.0, 1.5]), (2, 1.5)):
        assert Layout(gain=gain).gain == (2.0, 1.5)
    assert Layout(gain=(1, None, 2)).gain == (1.0, None, 2.0)
    assert Layout(gain=(1, None)).known_gains == (True, False) and Layout(gain=(None, None)).gain is None
    assert Layout().known_gains is True and Layout(gain=None).known_gains is False


def test_a_layout_may_come_from_a_file_of_plain_data():
    given = {"joints": 2, "rate": 500.0, "gain": [2, 3], "columns": {"qd": None, "q": "p_{0}"}}
    given |= {"transmission": [[0.01, 0], [0.01, 0.02]], "zero": [0.1, 0.2], "at_motors": ["q", "tau"], "cutoff_qd": 5}
    found = Layout(**json.loads(json.dumps(given)))
    expected = {name: tuple(x) if isinstance(x, list) else x for name, x in given.items()}
    assert found == Layout(**expected | {"transmission": ((0.01, 0.0), (0.01, 0.02))})
    assert hash(found) == hash(Layout(**given))


def test_every_field_is_explained():
    text = Layout.__doc__ or ""
    entries = text[text.index("Args:") : text.index(">>>")]
    for field in dataclasses.fields(Layout):
        assert re.search(rf"^ +(\w+, )?{field.name}(, \w+)?: ", entries, re.MULTILINE), field.name
    assert entries.count("[rad") == 4 and "[Hz]" in entries and "a list of names in the robot's order" in entries


def test_columns_have_names_by_a_mapping(tmp_path):
    heads = ["stamp", *(f"position_{i}" for i in range(3)), *(f"joint_states.velocity[{i}]" for i in range(3))]
    path = written(tmp_path / "ros.csv", table(n=3), [*heads, "base", "shoulder", "elbow"])
    columns = {"time": "stamp", "q": "position_{0}", "qd": "joint_states.velocity[{0}]"}
    columns["tau"] = ["base", "shoulder", "elbow"]
    found = read_log(path, Layout(columns=columns))
    assert found.layout.joints == 3
    np.testing.assert_allclose(np.column_stack(found[2:6]), table(n=3), atol=1e-7)
    columns["tau"] = "effort_{1}"
    with log_refused("column.missing"):
        read_log(path, Layout(joints=4, columns=columns))


def test_patterns_count_from_the_number_in_their_braces_and_others_keep_their_names(tmp_path):
    heads = ["time", "p_00", "p_01", "qd1", "qd2", "tau1", "tau2", "a5", "a6"]
    rows = np.column_stack([table(n=2), sines(table(n=2)[:, 0], 2)[2]])
    path = written(tmp_path / "log.csv", rows, heads)
    found = read_log(path, Layout(columns={"q": "p_0{0}", "qdd": "a{5}"}))
    np.testing.assert_allclose(np.column_stack([*found[2:6], found.qdd]), rows, atol=1e-6)
    with log_refused("column.missing"):  # named, so it must be there
        read_log(path, Layout(columns={"q": "p_0{0}", "qdd": "b{1}"}))


def test_a_single_joint_needs_no_number_and_an_archives_arrays_have_names_too(tmp_path):
    columns = {"time": "t", "q": "angle", "qd": "speed", "tau": "torque"}
    path = written(tmp_path / "log.csv", table(n=1), list(columns.values()))
    np.testing.assert_allclose(np.column_stack(read_log(path, Layout(columns=columns))[2:6]), table(n=1), atol=1e-7)
    named = {name: KNOWN[signal] for signal, name in columns.items()}
    np.testing.assert_array_equal(read_log(named, Layout(columns=columns)).tau, KNOWN["tau"])
    del named["angle"]
    np.savez(tmp_path / "log.npz", **named)
    with log_refused("column.missing"):
        read_log(tmp_path / "log.npz", Layout(columns=columns))


def test_columns_are_as_many_as_the_joints_and_read_for_one_signal(tmp_path):
    path = written(tmp_path / "log.csv", np.ones((3, 7)), names(2))
    for code, columns in (
        ("column.shared", {"tau": ["tau1", "q2"]}),
        ("column.shared", {"q": "tau{1}"}),
        ("column.shared", {"tau": ["tau1", "tau1"]}),
        ("column.count", {"tau": ["tau1"]}),
    ):
        with log_refused(code):
            read_log(path, Layout(columns=columns))
    with log_refused("column.missing"):
        read_log(path, Layout(columns={"q": ["q1", "q2"]}, joints=3))


def test_a_missing_column_says_how_many_others_there_are(tmp_path):
    heads = ["stamp", *(f"{joint}_{what}" for what in ("pos", "vel", "eff") for joint in ("base", "elbow"))]
    for more in (0, 1, 5):
        path = written(tmp_path / "log.csv", np.ones((3, 7 + more)), heads + [f"extra{i}" for i in range(more)])
        with log_refused("column.missing"):
            read_log(path)


@pytest.mark.parametrize("kept", ["q tau", "q qd", "q", "q qd current", "q I", "qd tau"])
def test_half_a_log_says_which_model_is_still_possible(tmp_path, kept):
    signals = {name: KNOWN.get(name, KNOWN["tau"]) for name in kept.split()}
    with log_refused("column.missing"):
        read_log(blocks(tmp_path / "log.csv", **signals))
    if signals.keys() <= KNOWN.keys():
        with log_refused("column.missing"):
            read_log({"time": KNOWN["time"]} | signals)


def test_a_column_that_is_missing_among_others_is_a_mistake_and_no_choice(tmp_path):
    path = blocks(tmp_path / "log.csv", q=KNOWN["q"], qd=KNOWN["qd"][:, :2], tau=KNOWN["tau"])
    with log_refused("column.missing"):
        read_log(path)
    path = blocks(tmp_path / "log.csv", q=KNOWN["q"][:, :2], qd=KNOWN["qd"], tau=KNOWN["tau"])
    with log_refused("column.more"):
        read_log(path)
    assert read_log(path, Layout(joints=2)).tau.shape == (5000, 2)


@pytest.mark.parametrize("header", [True, False])
def test_a_signal_that_the_layout_says_was_not_recorded_is_none(tmp_path, header):
    path, columns = blocks(tmp_path / "log.csv", q=KNOWN["q"], tau=KNOWN["tau"]), {"qd": None}
    if not header:
        path.write_text(path.read_text().partition("\n")[2])
        columns |= {"time": "1", "q": "{2}", "tau": "{5}"}
    found = read_log(path, Layout(joints=3, columns=columns))
    assert found.qd is None and "qd " not in str(found)
    np.testing.assert_allclose(found.tau, KNOWN["tau"], atol=1e-9)
    found = read_log(blocks(tmp_path / "q.csv", q=KNOWN["q"]), Layout(columns={"qd": None, "tau": None}))
    assert found.qd is None and found.tau is None
    np.testing.assert_allclose(found.q, KNOWN["q"], atol=1e-9)


def test_commands_are_kept_as_they_are(tmp_path):
    path = blocks(tmp_path / "log.csv", q=KNOWN["q"], wanted=KNOWN["q"] + 0.1)
    layout = Layout(columns={"qd": None, "tau": None, "command": "wanted{1}"}, transmission=(0.5, 0.5, 0.5))
    found = read_log(path, layout)
    np.testing.assert_allclose(found.command, KNOWN["q"] + 0.1, atol=1e-9)
    np.testing.assert_allclose(found.q, 0.5 * KNOWN["q"], atol=1e-9)
    assert read_log(KNOWN | {"command": KNOWN["q"]}).command is not None and read_log(KNOWN).command is None
    with log_refused("column.missing"):
        read_log(KNOWN, Layout(columns={"command": "wanted"}))


def test_scales_and_zeros_take_any_unit_to_that_of_the_description():
    turn, zero = math.pi / 180, np.array([0.1, -0.2, 0.3])
    per = np.array([turn, 1e-3, 1.0])  # a joint in degrees, one in millimetres, one in metres
    other = {"time": 1e3 * KNOWN["time"], "q": (KNOWN["q"] - zero) / per, "tau": KNOWN["tau"]}
    other |= {"qd": KNOWN["qd"] / (math.pi / 30), "qdd": KNOWN["qdd"] / turn}
    scale = {"time": 1e-3, "q": per, "qd": math.pi / 30, "qdd": turn}
    found = read_log(other, Layout(scale=scale, zero=zero))
    for name, x in KNOWN.items():
        np.testing.assert_allclose(getattr(found, name), x, atol=1e-9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_log(KNOWN, Layout(scale={"command": 2.0})).command is None


def test_units_of_some_signals_alone_say_which():
    degrees = KNOWN | {"q": KNOWN["q"] * 180 / math.pi}
    with log_refused("q.unit"):
        read_log(degrees)
    with log_refused("columns.rate"):  # velocities were in rad/s
        read_log(degrees, Layout(scale=dict.fromkeys(("q", "qd"), math.pi / 180)))
    assert read_log(degrees, Layout(scale={"q": math.pi / 180})).q.max() < 2


def test_joints_are_counted_from_zero_where_the_columns_are(tmp_path):
    zero = {f"{name}{j}": KNOWN[name][:, j] for name in ("q", "qd", "tau") for j in range(3)}
    np.testing.assert_array_equal(read_log({"time": KNOWN["time"], **zero}).tau, KNOWN["tau"])
    del zero["tau1"]
    with log_refused("column.missing"):
        read_log(written(tmp_path / "log.csv", np.column_stack([KNOWN["time"], *zero.values()]), ["time", *zero]))


def test_signals_without_a_number_are_left_out_with_a_word():
    nan = np.full_like(KNOWN["q"], np.nan)
    for name in ("qd", "qdd", "tau"):
        found, said = with_findings(read_log, KNOWN | {name: nan})
        assert getattr(found, name) is None and [(one.code, one.subject) for one in said] == [("column.empty", name)]
    for name in ("q", "tau"):
        one = KNOWN[name].copy()
        one[:, 1] = np.nan
        with log_refused("column.empty"):
            read_log(KNOWN | {name: one})


def test_efforts_of_unknown_gains_are_never_taken_for_torques(tmp_path):
    path = blocks(tmp_path / "log.csv", q=KNOWN["q"], qd=KNOWN["qd"], current=KNOWN["tau"] / 7)
    log = read_log(path, Layout(columns={"tau": "current{1}"}, gain=None))
    np.testing.assert_allclose(log.tau, KNOWN["tau"] / 7, atol=1e-9)
    motion = smooth(log)
    assert not motion.known_gains and not train_test_split(motion, 0.5)[1][0].known_gains
    assert "unknown gains" in str(log) and "unknown gains" in str(motion)
    with refused(ArgumentError) as raised:
        stack_samples([motion])
    assert "--estimate-gains" in raised.value.findings[0].option
    two = motion._replace(**{name: getattr(motion, name)[:, :2] for name in ("q", "qd", "qdd", "tau", "direction")})
    with refused(ArgumentError):
        identify(robots.load("two_link"), two)
    with refused(ArgumentError):
        identify(robots.load("two_link"), two._replace(tau=None, known_gains=True), Model())
    known = smooth(read_log(path, Layout(columns={"tau": "current{1}"}, gain=(7, 7, 7))))
    assert known.known_gains
    np.testing.assert_allclose(stack_samples(known).tau, 7 * motion.tau)


@all_in_one([(0.01, -0.0125, 0.02), COUPLED])
def test_motors_are_taken_to_the_scale_of_their_joints(transmission):
    x, zero = {name: KNOWN[name] for name in ("time", "q", "qd", "tau")}, np.array([0.1, -0.2, 0.3])
    S = np.diag(transmission) if np.ndim(transmission) == 1 else np.array(transmission)
    motors = {"time": x["time"], "qd": x["qd"] @ np.linalg.inv(S).T, "q": (x["q"] - zero) @ np.linalg.inv(S).T}
    gain = np.array([2.0, 3.0, 4.0])
    # each motor's torque is the power of all joints per its own velocity
    motors["tau"] = np.einsum("jm,tj->tm", S, x["tau"]) / gain
    layout = Layout(transmission=transmission, zero=zero, gain=gain, farthest=30.0)
    found = read_log(motors, layout)
    C = np.eye(3) if layout.coupling is None else np.array(layout.coupling)
    assert (layout.coupling is None) == (transmission is not COUPLED) and (C.diagonal() == 1).all()
    for name in ("q", "qd"):  # of all joints, with those that other motors turn
        np.testing.assert_allclose(getattr(found, name) @ C.T, x[name], atol=1e-9)
    np.testing.assert_allclose(found.qd, motors["qd"] * S.diagonal(), atol=1e-9)
    power = (motors["tau"] * gain * motors["qd"]).sum(1)
    np.testing.assert_allclose(found.tau * found.qd, motors["tau"] * gain * motors["qd"], atol=1e-9 * abs(power).max())
    np.testing.assert_allclose((found.tau * found.qd).sum(1), (x["tau"] * x["qd"]).sum(1), atol=1e-9 * abs(power).max())
    for sides in (("q", "qd"), ("tau",), ()):  # the others were measured at the joints
        mixed = {name: motors[name] * (gain if name == "tau" else 1.0) if name in sides else x[name] for name in x}
        other = read_log(mixed, Layout(transmission=transmission, zero=zero, at_motors=sides, farthest=30.0))
        for name in ("q", "qd", "tau"):
            np.testing.assert_allclose(getattr(other, name), getattr(found, name), atol=1e-9)
