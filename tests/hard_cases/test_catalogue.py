"""Every hard case of the catalogue is held by a test."""

import ast
from functools import cache
from pathlib import Path

import pytest
from hard_cases.catalogue import CASES, WITHOUT_COUNTERPART

TESTS = Path(__file__).parent.parent


@cache
def marked() -> set[str]:
    """Ids of all cases that tests are marked with."""
    return {
        argument.value
        for path in TESTS.rglob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.case"
        for argument in node.args
        if isinstance(argument, ast.Constant)
    }


@pytest.mark.parametrize("id", CASES)
def test_every_case_is_held_by_a_test(id):
    assert id in marked(), CASES[id]


def test_no_test_holds_a_case_that_is_not_in_the_catalogue():
    assert marked() <= CASES.keys()


def test_no_case_is_both_held_and_left_out():
    assert not CASES.keys() & WITHOUT_COUNTERPART.keys()
