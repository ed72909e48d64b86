"""Every hard case of the catalogue is held by a test."""

import pytest
from claims.hard_cases.catalogue import CASES, WITHOUT_COUNTERPART, held, shown, table


@pytest.mark.parametrize("id", CASES)
def test_every_case_is_held_by_a_test(id):
    assert id in held(), CASES[id]


def test_no_test_holds_a_case_that_is_not_in_the_catalogue():
    assert held().keys() <= CASES.keys()


def test_no_case_is_both_held_and_left_out():
    assert not CASES.keys() & WITHOUT_COUNTERPART.keys()


def test_the_page_shows_every_case():
    assert shown() == table(), "python tests/claims/hard_cases/catalogue.py writes it again"
