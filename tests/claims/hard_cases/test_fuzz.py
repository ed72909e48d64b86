"""Arguments at random: joint screws and Denavit-Hartenberg tables with wounds, and options that fit nothing.

Whatever is given, the outcome is a robot whose numbers are finite or an error of this package, within a second. Cases
are numbered, and a number makes the same case on every machine. Files are wounded in robot/urdf/test_urdf_fuzz.py.
"""

import copy
import math
import random
import time

import fuzz_urdf
import numpy as np
import pytest
import torch
from helpers import EVERYTHING, one_thread, thinned  # noqa: F401

from torchdq import Robot, TorchdqError

SECOND = 1.0
BATCH = 50

ODD = [
    *(None, True, 0, -1, 5, 1e308, math.nan, math.inf, -math.inf, 1j, 10**400, "", "a", "*", "[", b"a", b"", (), []),
    *({}, [[]], [None], ["a", "a"], ["a", None], {"a": None}, {"*": 1e60}, {None: 1}, {1, 2}, object(), len, Robot),
    *(np.ones(3), np.array("x"), np.ones(3, complex), torch.ones(2), torch.ones(2, dtype=torch.complex64)),
    *("revolute", "error"),
]
NUMBERS = [
    *(math.nan, math.inf, 0, -1, 1e308, 1e-320, 1e200, -0.0, None, "x", 1j, True, [], [1.0], 10**400),
    torch.tensor(1.0),
]
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


def changed(rng, arguments):
    """Arguments with one to three numbers, rows or whole values that are others, missing or doubled."""
    arguments = copy.deepcopy(arguments) | {"on_unphysical": rng.choice(["error", "ignore"])}
    for _ in range(rng.choice([1, 1, 2, 3])):
        name = rng.choice(list(arguments))
        value, how = arguments[name], rng.random()
        if how < 0.2:
            arguments[name] = rng.choice(ODD)
        elif how < 0.25 and isinstance(value, list):
            arguments[name] = rng.choice([tuple(value), np.array(value, dtype=object)])
        elif isinstance(value, list) and value:
            row = rng.choice([value, *(row for row in value if isinstance(row, list) and row)])
            i = rng.randrange(len(row))
            row[i : i + 1] = rng.choice([[], row[i : i + 1] * 2, [rng.choice(NUMBERS)], [rng.choice(NUMBERS)]])
    return arguments


def with_options(rng, text):
    """Arguments of a reader of files: one, or something else, and options that may name what is not there."""
    fitting = [{"*": 0.3}, {"b*": 0.3}, ["*"], "waist", ["l", "r"], {"*": 9.0}]
    option = rng.choice(["lock", "joints", "tip", "base", "mimic", "on_unphysical"])
    given = rng.choice([*fitting, rng.choice(ODD)])
    return {"source": text, option: given} if rng.random() < 0.9 else {"source": rng.choice(ODD)}


READERS = {
    "screws": (Robot.from_screws, lambda rng: changed(rng, SCREWS)),
    "tables": (Robot.from_dh, lambda rng: changed(rng, TABLE)),
    "options": (Robot.from_urdf, lambda rng: with_options(rng, rng.choice(fuzz_urdf.FILES))),
}


@pytest.mark.case("U2", "U3", "U8")
@pytest.mark.parametrize("kind, batch", [(kind, k) for kind in READERS for k in range(20 if EVERYTHING else 2)])
def test_anything_is_a_robot_or_one_of_the_packages_errors(kind, batch):
    read, arguments = READERS[kind]
    robots = 0
    for seed in range(BATCH * batch, BATCH * (batch + 1)):
        given = arguments(random.Random(seed))
        begin = time.thread_time()  # other tests may run beside this one
        try:
            robot = read(**given)
        except TorchdqError as error:
            assert len(str(error)) < 20_000
        except Exception as error:
            pytest.fail(f"{kind}, seed {seed}: {type(error).__name__}: {error!s:.500}")
        else:
            robots += 1
            fuzz_urdf.require_finite(robot)
        assert time.thread_time() - begin < SECOND, seed
    assert 0 < robots < BATCH  # wounds are neither all deadly nor all harmless


@pytest.mark.case("U8")
@pytest.mark.parametrize("kind", thinned(fuzz_urdf.HUGE, ["depth", "chain", "circle", "numbers", "text"]))
def test_a_huge_file_costs_neither_time_nor_memory(kind, margin):
    """A robot, or an error of the package."""
    found = fuzz_urdf.outcome(fuzz_urdf.Case(fuzz_urdf.huge(random.Random(0), kind), {}))
    margin(found.megabytes, fuzz_urdf.MEGABYTES, f"megabytes for {kind}")
    assert found.seconds < 5.0  # on any machine; a tenth of it here


@pytest.mark.parametrize("read, arguments", [(Robot.from_screws, SCREWS), (Robot.from_dh, TABLE)])
def test_the_arguments_are_sound_before_they_are_changed(read, arguments):
    fuzz_urdf.require_finite(read(**arguments))
