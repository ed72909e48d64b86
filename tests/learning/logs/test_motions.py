"""Logs with half of the columns, or other ones, are read as what they are; errors say which model is still possible.

Signals of motors are made from those of the joints by a mechanism written out here, and torques by its lost-free power.
"""

import contextlib
import json
import warnings

import numpy as np
import pytest
import torch

pytest.importorskip("scipy", reason="smoothing needs scipy")

from torchdq import robots
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.learning import Layout, LogError, LogWarning, cut, directions, identify, read, samples, smooth

TIME = np.linspace(0.0, 6.0, 1201)
RATE = 2 * np.pi * np.array([0.5, 0.8, 1.1])


def signals() -> dict[str, np.ndarray]:
    """Motion of three joints and some torques."""
    phase = TIME[:, None] * RATE + np.arange(3)
    q, qd, qdd = np.sin(phase), RATE * np.cos(phase), -(RATE**2) * np.sin(phase)
    return {"time": TIME, "q": q, "qd": qd, "tau": 3 * qdd + 0.5 * qd + np.arange(3)}


def without(*names: str) -> dict[str, np.ndarray | None]:
    return {name: None if name in names else x for name, x in signals().items()}


def table(path, blocks: dict[str, np.ndarray], time: str = "time"):
    """CSV file of columns with the joint's number behind these names."""
    heads = [time, *(f"{name}{joint + 1}" for name, x in blocks.items() for joint in range(x.shape[1]))]
    np.savetxt(
        path, np.column_stack([TIME, *blocks.values()]), delimiter=",", fmt="%.12g", header=",".join(heads), comments=""
    )
    return path


# --- arrays ----------------------------------------------------------------------------------------------------------


def test_arrays_are_read_as_an_archive_of_them(tmp_path):
    np.savez(tmp_path / "log.npz", **signals())
    expected, found = read(tmp_path / "log.npz"), read(signals())
    for name in ("time", "q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.layout == expected.layout and found.path.name == "the arrays"
    np.testing.assert_array_equal(read(signals(), rows=(10, 30)).q, signals()["q"][10:30])


def test_tensors_lists_and_other_names_are_arrays_too():
    x = signals()
    tensors = {name: torch.tensor(part, requires_grad=True) for name, part in x.items()}
    np.testing.assert_array_equal(read(tensors).tau, x["tau"])
    np.testing.assert_array_equal(read({name: part.tolist() for name, part in x.items()}).q, x["q"])
    with pytest.raises(ArgumentError, match="columns must name every array once, found 'q' for several signals"):
        read(x, Layout(columns={"tau": "q"}))
    other = {"t": x["time"], "position": x["q"], "qd": x["qd"], "tau": x["tau"], "temperature": "hot"}
    np.testing.assert_array_equal(read(other, Layout(columns={"time": "t", "q": "position"})).q, x["q"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q": None}, r"the arrays: there is no array 'q'; needed are time \[rows\] and q, qd, tau \[rows, n\]"),
        ({"time": None}, "there is no array 'time'"),
        ({"q": [[1.0], [1.0, 2.0]]}, "array 'q': not an array of numbers"),
        ({"q": "high"}, "array 'q': <U4 .*expected real numbers"),
        ({"qd": np.zeros((7, 3))}, r"array 'qd': float64 \[7, 3\], expected"),
        ({"tau": np.full((1201, 3), np.nan)}, "row 0, column 'tau1': nan is not a finite number"),
        ({"q": 1j * signals()["q"]}, "array 'q': complex128 .*expected real numbers"),
        ({"time": TIME[::-1]}, "row 1, column 'time': .* before the row above"),
    ],
)
def test_arrays_are_checked_as_files_are(change, message):
    with pytest.raises(LogError, match=message):
        read(signals() | change)


# --- what is still possible ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        ({"q": "q", "tau": "tau"}, r"no column 'qd1'; .*columns=\{'qd': None\}\) reads positions and torques: smooth"),
        ({"q": "q", "qd": "qd"}, r"no column 'tau1'; .*columns=\{'tau': None\}\) reads the motion alone.* fit_rollout"),
        ({"q": "q"}, r"no column 'qd1'; .*columns=\{'qd': None, 'tau': None\}\) .* fit_rollout .*commands"),
        (
            {"q": "q", "qd": "qd", "tau": "current"},
            r"if 'current1' is a motor current, .*gain=None, and identify\(robot, motions, gains=True\)",
        ),
        ({"q": "q", "tau": "I"}, r"if 'I1' is a motor current, .*'qd': None"),
        ({"qd": "qd", "tau": "tau"}, r"no column 'q1'; [^;]*; other names are given by .* found time(, (qd|tau)\d?)*$"),
    ],
)
def test_half_a_log_says_which_model_is_still_possible(tmp_path, kept, message):
    path = table(tmp_path / "log.csv", {name: signals()[signal] for signal, name in kept.items()})
    with pytest.raises(LogError, match=message):
        read(path)
    if {*kept.values()} <= signals().keys():  # the same of arrays
        with pytest.raises(LogError, match=message.replace("column", "array", 1).replace("1'", "'")):
            read({"time": TIME} | {signal: signals()[signal] for signal in kept})


def test_a_column_that_is_missing_among_others_is_a_mistake_and_no_choice(tmp_path):
    x = signals()
    path = table(tmp_path / "log.csv", {"q": x["q"], "qd": x["qd"][:, :2], "tau": x["tau"]})
    with pytest.raises(LogError, match=r"no column 'qd3'; [^;]*; other names .* and 1 more$"):
        read(path)
    path = table(tmp_path / "log.csv", {"q": x["q"][:, :2], "qd": x["qd"], "tau": x["tau"]})
    with pytest.raises(LogError, match=r"there is 'qd3', but positions of 2 joints; .* Layout\(joints=2\)"):
        read(path)
    assert read(path, Layout(joints=2)).tau.shape == (1201, 2)


@pytest.mark.parametrize("header", [True, False])
def test_what_the_layout_says_was_not_recorded_is_none(tmp_path, header):
    x = signals()
    path = table(tmp_path / "log.csv", {"q": x["q"], "tau": x["tau"]})
    if not header:
        path.write_text(path.read_text().partition("\n")[2])
    found = read(path, Layout(joints=3, header=header, columns={"qd": None}))
    assert found.qd is None and "qd " not in str(found)
    np.testing.assert_allclose(found.tau, x["tau"], atol=1e-9)
    found = read(table(tmp_path / "q.csv", {"q": x["q"]}), Layout(columns={"qd": None, "tau": None}))
    assert found.qd is None and found.tau is None
    np.testing.assert_allclose(found.q, x["q"], atol=1e-9)


def test_commands_are_kept_as_they_are(tmp_path):
    x = signals()
    path = table(tmp_path / "log.csv", {"q": x["q"], "wanted": x["q"] + 0.1})
    layout = Layout(columns={"qd": None, "tau": None, "command": "wanted{1}"}, transmission=(0.5, 0.5, 0.5))
    found = read(path, layout)
    np.testing.assert_allclose(found.command, x["q"] + 0.1, atol=1e-9)
    np.testing.assert_allclose(found.q, 0.5 * x["q"], atol=1e-9)
    assert read(signals() | {"command": x["q"]}).command is not None and read(signals()).command is None
    with pytest.raises(LogError, match="there is no array 'wanted'"):
        read(signals(), Layout(columns={"command": "wanted"}))


def test_positions_alone_give_the_velocities_and_accelerations():
    x = signals()
    for lost in (("qd",), ("qd", "tau")):
        motion = smooth(read(without(*lost)))
        phase = motion.time[:, None] * RATE + np.arange(3)
        # what the filter takes at 1.1 Hz, and what it lets through of the ends
        np.testing.assert_allclose(motion.qd, RATE * np.cos(phase), atol=2e-3 * RATE.max())
        np.testing.assert_allclose(motion.qdd, -(RATE**2) * np.sin(phase), atol=2e-3 * RATE.max() ** 2)
    assert motion.tau is None and motion.direction is None and motion.cutoff_tau is None
    assert len(cut(motion, 0.5)[0].q) == -(-len(motion.q) // 2) and "tau" not in str(motion)
    with pytest.raises(ArgumentError, match=r"motions must have torques, found none .*fit_rollout"):
        samples(motion)
    with pytest.raises(ArgumentError, match="motions must have the field direction"):
        directions(motion)
    recorded = smooth(read(x))
    np.testing.assert_allclose(smooth(read(without("qd"))).tau, recorded.tau)


def test_positions_that_jump_are_told_without_velocities():
    x = without("qd", "tau")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(x)
    for change, told in ((2 * np.pi, "changes by 6.3"), (0.5, "changes by 0.5")):
        jumping = signals()["q"].copy()
        jumping[600:, 1] -= change
        with pytest.warns(LogWarning, match=f"row 600, column 'q2': it {told}"):
            read(x | {"q": jumping})
    spike = signals()["q"].copy()
    spike[600, 1] += 0.5
    with pytest.warns(LogWarning, match="row 600, column 'q2': .*the first of 2"):
        read(x | {"q": spike})


# --- drives ----------------------------------------------------------------------------------------------------------


def test_efforts_of_unknown_gains_are_never_taken_for_torques(tmp_path):
    x = signals()
    path = table(tmp_path / "log.csv", {"q": x["q"], "qd": x["qd"], "current": x["tau"] / 7})
    layout = Layout(columns={"tau": "current{1}"}, gain=None)
    log = read(path, layout)
    np.testing.assert_allclose(log.tau, x["tau"] / 7, atol=1e-9)
    assert "unknown gains" in str(log)
    motion = smooth(log)
    assert not motion.known_gains and "unknown gains" in str(motion) and not cut(motion, 0.5)[1].known_gains
    with pytest.raises(ArgumentError, match=r"efforts of unknown gains in that of .*log\.csv; .*gains=True"):
        samples([motion])
    flat = robots.load("two_link")
    two = motion._replace(**{name: getattr(motion, name)[:, :2] for name in ("q", "qd", "qdd", "tau", "direction")})
    with pytest.raises(ArgumentError, match="efforts of unknown gains; give gains=True"):
        identify(flat, two)
    with pytest.raises(ArgumentError, match="motions must have torques"):
        identify(flat, two._replace(tau=None, known_gains=True))
    known = smooth(read(path, Layout(columns={"tau": "current{1}"}, gain=(7, 7, 7))))
    assert known.known_gains
    np.testing.assert_allclose(samples(known).tau, 7 * motion.tau)


COUPLED = ((0.01, 0.0, 0.0), (0.0, -0.0125, 0.0), (0.0, 0.0125, 0.02))  # the second motor turns the third joint too


@pytest.mark.parametrize("transmission", [(0.01, -0.0125, 0.02), COUPLED])
def test_motors_are_taken_to_the_joints(transmission):
    x, zero = signals(), np.array([0.1, -0.2, 0.3])
    S = np.diag(transmission) if np.ndim(transmission) == 1 else np.array(transmission)
    motors = {"time": TIME, "qd": x["qd"] @ np.linalg.inv(S).T, "q": (x["q"] - zero) @ np.linalg.inv(S).T}
    gain = np.array([2.0, 3.0, 4.0])
    # each motor's torque is the power of all joints per its own velocity
    motors["tau"] = np.einsum("jm,tj->tm", S, x["tau"]) / gain
    found = read(motors, Layout(transmission=transmission, zero=zero, gain=gain, farthest=30.0))
    for name, expected in x.items():
        np.testing.assert_allclose(getattr(found, name), expected, atol=1e-9)
    power = (motors["tau"] * gain * motors["qd"]).sum(1)
    np.testing.assert_allclose((found.tau * found.qd).sum(1), power, atol=1e-9 * abs(power).max())
    only = read(motors | {"tau": x["tau"]}, Layout(transmission=transmission, zero=zero, at_motors=("q", "qd")))
    np.testing.assert_array_equal(only.tau, x["tau"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"transmission": (0.01, 0.0)}, "transmission must be numbers, .* none of them zero"),
        ({"transmission": 0.01}, "transmission must be numbers, one per joint, .*found 0.01"),
        ({"transmission": "fast"}, "transmission must be numbers, one per joint"),
        ({"transmission": ((1.0, 2.0), (2.0, 4.0))}, "transmission must be .* which has an inverse"),
        ({"transmission": ((1.0, 2.0),)}, "transmission must be .* the rows of a square matrix"),
        ({"transmission": ((1.0, np.nan), (0.0, 1.0))}, "transmission must be finite numbers"),
        ({"transmission": COUPLED, "gain": None}, "gain must be known where a transmission couples joints"),
        ({"zero": (1.0,)}, "zero needs a transmission"),
        ({"gain": (1.0, 0.0)}, "gain must be numbers, .* none of them zero"),
        ({"zero": (np.inf,), "transmission": (1.0,)}, "zero must be finite numbers"),
        ({"at_motors": ("time",)}, "there is no signal named 'time'"),
        ({"columns": {"q": None}}, r"columns\['q'\] must be a name"),
    ],
)
def test_transmissions_are_checked(options, message):
    with pytest.raises(TorchdqError, match=message):
        Layout(**options)


def test_a_layout_may_come_from_a_file_of_plain_data():
    given = {"joints": 2, "blocks": ["p", "v", "i"], "gain": [2, 3], "columns": {"qd": None, "q": "p_{0}"}}
    given |= {"transmission": [[0.01, 0], [0.01, 0.02]], "zero": [0.1, 0.2], "at_motors": ["q", "tau"], "cutoff_qd": 5}
    found = Layout(**json.loads(json.dumps(given)))
    expected = {name: tuple(x) if isinstance(x, list) else x for name, x in given.items()}
    assert found == Layout(**expected | {"transmission": ((0.01, 0.0), (0.01, 0.02))})
    assert hash(found) == hash(Layout(**given))


def test_what_is_given_per_joint_is_given_for_all():
    for options, message in (
        ({"transmission": (0.1, 0.1)}, "transmission must have 3 numbers, one per joint, found 2"),
        ({"transmission": ((1.0, 0.0), (0.0, 1.0))}, "transmission must have 3 rows, one per joint, found 2"),
        ({"transmission": (1, 1, 1), "zero": (0.1,)}, "zero must have 3 numbers, one per joint, found 1"),
    ):
        with pytest.raises(ArgumentError, match=message):
            read(signals(), Layout(**options))


# --- anything at all -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(60))
def test_any_columns_are_read_or_refused_by_an_error_that_says_what_to_do(tmp_path, seed):
    """Columns left out, doubled, renamed, in another order, in another unit, beside layouts of all kinds."""
    rng = np.random.default_rng(seed)
    x = signals()
    columns = [("time", TIME[:60])] + [
        (f"{name}{joint + 1}", x[name][:60, joint]) for name in ("q", "qd", "tau") for joint in range(3)
    ]
    kept = [columns[i] for i in rng.permutation(len(columns)) if rng.random() < 0.9]
    kept += [kept[i] for i in range(len(kept)) if rng.random() < 0.02]
    heads = [
        str(rng.choice([head, head.upper(), f"{head} [rad]", f'"{head}"', ""], p=[0.96, *[0.01] * 4]))
        for head, _ in kept
    ]
    rows = np.column_stack([values * rng.choice([1.0, 57.3, 1e3], p=[0.98, 0.01, 0.01]) for _, values in kept])
    lines = [",".join(f"{value:.9g}" for value in row) for row in rows]
    if rng.random() < 0.2:
        lines.insert(int(rng.integers(60)), str(rng.choice(["", "x", "1,2,3", "#", "nan," * 9 + "nan"])))
    separator = str(rng.choice([",", ";", "\t"], p=[0.9, 0.05, 0.05]))
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(heads), *lines][int(rng.random() < 0.05) :]).replace(",", separator) + "\n")
    lost = {name: None for name in ("qd", "tau") if rng.random() < 0.4}
    options = {"columns": lost, "gain": [(), None, (1, 2, 3), (1,)][rng.integers(4)]}
    if rng.random() < 0.3:
        options["transmission"] = [(1.0, 2.0, -1.0), (1.0, 1.0)][rng.integers(2)]
    with contextlib.suppress(LogError, ArgumentError), warnings.catch_warnings():
        warnings.simplefilter("ignore", LogWarning)
        found = read(path, Layout(**options), rate=[None, 50.0, 1e4][rng.integers(3)])
        assert found.q.shape[0] == len(found.time) and (found.qd is None) == ("qd" in lost)
        assert found.q.shape[1] == 3 or lost.keys() == {"qd", "tau"}
