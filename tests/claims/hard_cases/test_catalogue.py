"""Every hard case of the catalogue is held by a test."""

from claims.hard_cases.catalogue import CASES, WITHOUT_COUNTERPART, held, shown, table


def test_every_case_is_held_by_a_test():
    assert {id: case for id, case in CASES.items() if id not in held()} == {}


def test_no_test_holds_a_case_that_is_not_in_the_catalogue():
    assert held().keys() <= CASES.keys()


def test_no_case_is_both_held_and_left_out():
    assert not CASES.keys() & WITHOUT_COUNTERPART.keys()


def test_the_page_shows_every_case():
    assert shown() == table(), "python tests/claims/hard_cases/catalogue.py writes it again"
