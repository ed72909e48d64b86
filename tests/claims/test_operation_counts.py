"""The operations of every kind of program: never more than those of `operation_counts.json`.

Programs are recorded here, and none is compiled or run. Where one has become cheaper, write the table again:

    PYTHONPATH=tests/tools python tests/claims/test_operation_counts.py --write
"""

import json
import sys
import warnings
from functools import cache
from pathlib import Path

import pytest
from helpers import thinned
from kinds_of_programs import PROGRAMS, STUDIED, recipes, step, study

from torchdq.control import LAWS
from torchdq.functions.catalogue import RECIPES

TABLE = Path(__file__).with_name("operation_counts.json")
AGAIN = "some programs have fewer operations than on record: python tests/claims/test_operation_counts.py --write"


@cache
def table() -> dict[str, list[int]]:
    """Multiplications, additions, divisions, sines, roots, exponentials and comparisons of every program."""
    return json.loads(TABLE.read_text(encoding="utf-8"))


def write() -> None:
    """Write the table again, a line per program."""
    rows = [f"{json.dumps(key)}: {json.dumps(list(PROGRAMS[key]().count()))}" for key in sorted(PROGRAMS)]
    TABLE.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


# every function of two joints, those that others are made of of seven, and every effect under one integrator
BASIC = ("inverse_dynamics", "forward_dynamics", "mass_matrix", "closed_form", "forward_kinematics", "jacobian")
KINDS = [
    key for key in PROGRAMS if key.startswith(("two_link/", "panda/scene/implicit/", "panda_hand/", "Reach/panda"))
]
KINDS += [f"panda/scene/{step}" for step in ("semi/none", "semi/Drag", "rk4/none", "verlet/none")]
KINDS += [key for key in PROGRAMS if key.startswith("panda/") and key.split("/")[1].split()[0] in BASIC]
KINDS += [key for key in PROGRAMS if key.startswith("study/") and "chain42" not in key][::4]


def test_no_program_has_more_operations_than_on_record():
    found = {key: list(PROGRAMS[key]().count()) for key in thinned(PROGRAMS, KINDS)}
    assert {key: count for key, count in found.items() if sum(count) > sum(table()[key])} == {}
    if any(sum(count) < sum(table()[key]) for key, count in found.items()):
        warnings.warn(AGAIN, stacklevel=1)


def test_the_record_is_of_these_programs_in_order():
    assert list(table()) == sorted(PROGRAMS)


def test_every_public_function_is_on_record():
    assert {key.split("/")[1].split()[0] for key in recipes("two_link")} == {*RECIPES, *LAWS} - {
        "closure_gaps",
        "loop_step",
        "loop_torques",
    }  # of loops


def test_every_case_and_method_of_the_study_is_on_record():
    assert {name for name, _ in STUDIED} == set(study("scenes").CASES)
    assert {method for _, method in STUDIED} == set(study("methods").INTEGRATORS)


@pytest.mark.parametrize(
    ("integrator", "effect", "most"), [("semi", "Push", 96), ("semi", "Drag", 326), ("implicit", "Contact", 670)]
)
def test_wrenches_on_links_take_the_kinematics_of_the_dynamics(integrator, effect, most):
    """They add the operations of their own formulas, and no second set of poses and twists."""
    bare, loaded = (step(integrator, name).count() for name in ("none", effect))
    assert loaded.total - bare.total <= most


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        sys.exit(__doc__)
    write()
