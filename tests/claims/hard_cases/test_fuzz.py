"""Descriptions at random: files, screws and Denavit-Hartenberg tables with wounds, and arguments that fit nothing.

Whatever is given, the outcome is a robot whose numbers are finite or an error of this package, within a second. Cases
are numbered, and a number makes the same case on every machine: `outcome(file_case, 1234)` does one again.
"""

import copy
import math
import random
import re
import time

import numpy as np
import pytest
import torch
from helpers import one_thread  # noqa: F401

import torchdq
from torchdq import Robot, TorchdqError

SECOND = 1.0
BATCH = 50

# --- files -----------------------------------------------------------------------------------------------------------

BODY = (
    '<inertial><origin xyz="0.1 0 0.2" rpy="0.1 0.2 0.3"/><mass value="1.5"/>'
    '<inertia ixx="0.04" ixy="0.001" ixz="0" iyy="0.05" iyz="-0.002" izz="0.03"/></inertial>'
)


def joint(name, parent, kind="revolute", more=""):
    """A link with a body and the joint that carries it."""
    limit = "" if kind in ("continuous", "fixed") else '<limit lower="-1" upper="2" velocity="3" effort="4"/>'
    return (
        f'<link name="{name}_link">{BODY}</link><joint name="{name}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{name}_link"/><origin xyz="0.1 0.2 0.3" rpy="0 1.5 0"/><axis xyz="0 1 0"/>{limit}{more}</joint>'
    )


FILES = {
    "gripper": joint("driver", "base") + joint("follower", "base", more='<mimic joint="driver" multiplier="-1"/>'),
    "arm": joint("a", "base") + joint("b", "a_link", "prismatic") + joint("c", "b_link", "continuous"),
    "tree": joint("waist", "base", more='<dynamics damping="1" friction="0.5"/>')
    + joint("left", "waist_link")
    + joint("right", "waist_link")
    + joint("tool", "right_link", "fixed"),
    "prefixes": joint("a", "base") + '<drake:x value="1"/><gazebo><plugin name="p"/></gazebo>',
    "body": "",
}
TOKEN = re.compile(r"""<[/!?]?[\w:]*|/?>|[\w.:+-]+|["'= ]""")
WORDS = [
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "1e-320",
    "1e50",
    "",
    " ",
    "x",
    "1_0",
    "\u0661",
    "0 0 0",
    "1 2 3 4",
    "9" * 99,
]
WORDS += ["é", "\0", "\ud800", "${x}", "$(find x)", "base", "a_link", "driver", "fixed", "floating", "continuous"]
WORDS += ["<link", "<joint", "<mimic", "<xacro:macro", "<robot", "<inertial", "<!--", "<![CDATA[", "&amp;", "&x;", "</"]


def wounded(rng, text):
    """Text with one to four tokens left out, doubled, exchanged or replaced, or cut off."""
    for _ in range(rng.choice([1, 1, 2, 4])):
        tokens = TOKEN.findall(text) or [""]
        i, k = rng.randrange(len(tokens)), rng.randrange(len(tokens))
        how = rng.choice(["leave out", "double", "exchange", "replace", "replace", "replace", "move", "many", "cut"])
        if how == "leave out":
            del tokens[i : i + rng.choice([1, 1, 5, 50])]
        elif how == "double":
            tokens[i:i] = tokens[i : i + rng.choice([1, 10, 100])]
        elif how == "exchange":
            tokens[i], tokens[k] = tokens[k], tokens[i]
        elif how == "replace":
            tokens[i] = rng.choice([*WORDS, tokens[k]])
        elif how == "move":
            tokens.insert(i, tokens.pop(k))
        elif how == "many":
            tokens[i] *= rng.choice([2, 100, 10_000, 1_000_000])
        elif rng.random() < 0.3:
            del tokens[i:]
        text = "".join(tokens)
    return text


ODD = [
    None,
    True,
    0,
    -1,
    5,
    1e308,
    math.nan,
    math.inf,
    1j,
    10**400,
    "",
    "a",
    "*",
    "[",
    b"a",
    b"",
    (),
    [],
    {},
    [[]],
    [None],
]
ODD += [["a", "a"], ["a", None], {"a": None}, {"*": 1e60}, {None: 1}, np.ones(3), np.array("x"), np.ones(3, complex)]
ODD += [
    torch.ones(2),
    torch.ones(2, dtype=torch.complex64),
    object(),
    len,
    Robot,
    "revolute",
    "error",
    float("-inf"),
    {1, 2},
]


def file_case(rng):
    """Reader and arguments of a wounded file."""
    name = rng.choice(list(FILES))
    text = f'<robot name="{name}"><link name="base"/>{FILES[name]}</robot>'
    arguments = {"on_unphysical": rng.choice(["error", "ignore"])}
    if rng.random() < 0.9:
        text = wounded(rng, text)
    if rng.random() < 0.3:
        known = [{"a": 0.3}, {"d*": 0.3}, ["*"], "waist", ["left", "right"], {"*": 9.0}, rng.choice(ODD)]
        arguments[rng.choice(["lock", "joints", "tip", "base"])] = rng.choice(known)
    if rng.random() < 0.03:
        text = rng.choice(ODD)
    return (
        Robot.from_urdf,
        (rng.choice([text, text.encode(errors="replace")]) if isinstance(text, str) else text,),
        arguments,
    )


# --- screws and tables -----------------------------------------------------------------------------------------------

SCREWS = {
    "joint_screws": [[0.0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 1, 0], [0, 1, 0, -0.5, 0.2, 0]],
    "mass": [1.0, 2.0, 0.5],
    "com": [[0.1, 0, 0.2], [0, 0.1, 0], [0.3, 0, 0]],
    "inertia": [[0.04, 0.001, 0.05, 0, -0.002, 0.03]] * 3,
    "link_poses": [[1.0, 0, 0, 0, 0, 0, 0, 0]] * 3,
    "tip_pose": [1.0, 0, 0, 0, 0, 0.1, 0, 0],
    "parents": [-1, 0, 0],
    "home": [0.1, 0.2, 0.3],
    "joint_names": ["a", "b", "c"],
    "link_names": ["A", "B", "C"],
    "name": "arm",
}
TABLE = {name: SCREWS[name] for name in ("mass", "com", "inertia", "tip_pose", "joint_names", "link_names", "name")}
TABLE |= {"a": [0.1, 0.2, 0.0], "alpha": [1.57, 0.0, -1.57], "d": [0.3, 0.0, 0.1], "theta": [0.0, 1.0, math.pi]}
TABLE |= {"convention": "modified", "kinds": ["revolute", "prismatic", "revolute"]}
NUMBERS = [
    math.nan,
    math.inf,
    0,
    -1,
    1e308,
    1e-320,
    1e200,
    -0.0,
    None,
    "x",
    1j,
    True,
    [],
    [1.0],
    10**400,
    torch.tensor(1.0),
]


def changed(rng, arguments):
    """Arguments with one to three numbers, rows or whole values that are others, missing or doubled."""
    arguments = copy.deepcopy(arguments)
    for _ in range(rng.choice([1, 1, 2, 3])):
        name = rng.choice(list(arguments))
        value, how = arguments[name], rng.random()
        if how < 0.15:
            arguments[name] = rng.choice(ODD)
        elif how < 0.25 and isinstance(value, list):
            arguments[name] = rng.choice([tuple(value), np.array(value, dtype=object)])
        elif how < 0.3:
            del arguments[name]
            arguments[name] = None
        elif isinstance(value, list) and value:
            rows = [value, *(row for row in value if isinstance(row, list) and row)]
            row = rng.choice(rows)
            i = rng.randrange(len(row))
            row[i : i + 1] = rng.choice([[], row[i : i + 1] * 2, [rng.choice(NUMBERS)], [rng.choice(NUMBERS)]])
    return arguments


def screws_case(rng):
    """Reader and arguments of joint screws."""
    return Robot.from_screws, (), changed(rng, SCREWS) | {"on_unphysical": rng.choice(["error", "ignore"])}


def table_case(rng):
    """Reader and arguments of a Denavit-Hartenberg table."""
    return Robot.from_dh, (), changed(rng, TABLE) | {"on_unphysical": rng.choice(["error", "ignore"])}


# --- outcomes --------------------------------------------------------------------------------------------------------


def outcome(case, seed):
    """Robot or error of this package that a case ends in; any other error, or more than a second, is a failure."""
    read, positional, named = case(random.Random(seed))
    begin = time.thread_time()  # other tests may run beside this one
    try:
        found = read(*positional, **named)
    except TorchdqError as error:
        found = error
        assert len(str(error)) < 20_000
    assert time.thread_time() - begin < SECOND
    return found


def assert_sound(robot):
    """Numbers of a robot are finite, and so are its torques."""
    for name in ("X_PB_home", "screw", "mass", "com", "inertia", "damping", "friction"):
        assert getattr(robot, name).isfinite().all(), name
    q = torch.full((robot.n,), 0.3, dtype=torch.float64)
    assert torchdq.inverse_dynamics(robot, q, q, q, backend="eager").isfinite().all()


CASES = {"files": (file_case, 3000), "screws": (screws_case, 1000), "tables": (table_case, 1000)}
FEW = 2  # batches of each kind that every run does
BATCHES = [
    pytest.param(kind, batch, marks=[] if batch < FEW else pytest.mark.exhaustive)
    for kind, (_, count) in CASES.items()
    for batch in range(count // BATCH)
]


@pytest.mark.case("U2", "U3", "U8")
@pytest.mark.parametrize("kind, batch", BATCHES)
def test_anything_is_a_robot_or_one_of_the_packages_errors(kind, batch):
    robots = 0
    for seed in range(BATCH * batch, BATCH * (batch + 1)):
        try:
            found = outcome(CASES[kind][0], seed)
            if isinstance(found, Robot):
                robots += 1
                assert_sound(found)
        except Exception as error:
            pytest.fail(f"{kind}, seed {seed}: {type(error).__name__}: {error!s:.500}")
    assert 0 < robots < BATCH  # wounds are neither all deadly nor all harmless


@pytest.mark.parametrize("read, arguments", [(Robot.from_screws, SCREWS), (Robot.from_dh, TABLE)])
def test_the_arguments_are_sound_before_they_are_changed(read, arguments):
    assert_sound(read(**arguments))


@pytest.mark.parametrize("name", FILES)
def test_the_files_are_sound_before_they_are_wounded(name):
    assert_sound(Robot.from_urdf(f'<robot name="{name}"><link name="base"/>{FILES[name]}</robot>'))
