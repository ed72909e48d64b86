"""The paper's cost tables, counted, are those of the independent counts on record; the counting number counts right."""

import math
from functools import partial

import pytest
from helpers import all_in_one

import torchdq
from torchdq.command.main import main
from torchdq.numbers.count import Cost, Counted, dense, executed
from torchdq.numbers.count import cost as needed
from torchdq.paper import cost, ladder, tables

# multiplications and additions as counted on record, row by row
RECORD = {
    "Table 2, quaternions": "0 4, 4 0, 16 12, 6 3, 22 14, 3 2, 16 12, 16 12, 28 20, 15 15",
    "Table 3, dual quaternions": "0 8, 8 0, 48 40, 18 12, 9 7, 6 5, 64 56, 48 40, 108 72, 39 36, 27 21, 72 58",
    "Table 4, the algorithm per joint": "144 120, 16 4, 48 40, 50 36, 108 72, 33 27, 57 45, 42 30, 27 27, 6 5",
}
# the entries of the paper that are wrong in their operations
WRONG = {"quaternion cross product (4)", "quaternion adjoint transformation", "inner product (16)"}
WRONG |= {"Hamilton operator applied (24)", "adjoint from them (36)", "(40)", "(44)", "(46)"}


@all_in_one(tables.TABLES)
def test_an_operation_costs_what_is_on_record(title):
    found = [f"{entry.counted.multiplications} {entry.counted.additions}" for entry in tables.TABLES[title]]
    assert ", ".join(found) == RECORD[title]


def test_the_wrong_entries_are_the_known_ones_and_every_difference_is_explained():
    entries = [entry for entries in tables.TABLES.values() for entry in entries]
    wrong = {entry.operation for entry in entries if entry.printed and entry.printed[:2] != entry.counted[:2]}
    assert wrong == WRONG
    assert [entry.operation for entry in entries if entry.printed != entry.counted and not entry.remark] == []


def test_table_4_sums_to_321n_and_with_its_slips_mended_246n():
    rows = [entry for entry in tables.TABLE_4 if entry.operation in tables.PER_JOINT]
    assert [sum(x) for x in zip(*(row.printed[:2] for row in rows), strict=True)] == [321, 273]
    assert [sum(x) for x in zip(*(row.counted[:2] for row in rows), strict=True)] == [321, 246]


LAWS = {
    "323n-51, 242n-51": cost.dqrnea_as_printed,
    "243n-51, 185n-51": cost.htm_rnea,
    "394n+27, 335n+18": lambda n: cost.htm_rnea(n, full=True),
    "39n-40, 24n-28": lambda n: cost.htm_dh_kinematics(n),
    "64n-48, 44n-40": lambda n: cost.udq_dh_kinematics(n),
    "50n, 36n": lambda n: cost.udq_screw_kinematics(n),
}


@all_in_one(LAWS)
def test_an_algorithm_costs_what_is_on_record(law):
    algorithm = LAWS[law]
    assert cost.Line("", algorithm).law() == law
    a, b, c = (algorithm(n) for n in (5, 6, 7))
    assert [y - x for x, y in zip(a, b, strict=True)] == [y - x for x, y in zip(b, c, strict=True)], "it is a line"


@pytest.mark.parametrize("n", [6, 7, 12])
def test_a_program_of_a_general_chain_costs_less_than_the_best_on_record(n):
    count = torchdq.compile(cost.robot(*cost.chain(n)), "inverse_dynamics").count()
    assert count.multiplications <= 91 * n - 93 and count.additions <= 76 * n - 83


def test_the_command_prints_every_table(capsys, monkeypatch):
    monkeypatch.setattr(ladder, "times", partial(ladder.times, batch=8, seconds=0.01))
    assert main(["cost"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    for title in tables.TABLES:
        assert title in said
    assert "323n-51, 242n-51" in said
    assert all(form.name in said for form in ladder.FORMS) and said.count(" ns ") == len(ladder.FORMS)


# --- the counting number ----------------------------------------------------------------------------------------------


def test_counting_is_of_what_was_asked_for():
    a, b = Counted(), Counted()
    assert needed([a * b + a]) == Cost(1, 1, 2)
    assert needed([a * b, a]) == Cost(1, 0, 2)
    assert needed([(a * b) * 1.0 + 0.0, -(a * b)])[:2] == (2, 0)
    assert needed([0.0 * a, 1.0 * a, -1 * a, a - 0.0])[:2] == (0, 0)
    assert needed([0.5 * a, 1.0 - a, a / b, a / 4.0])[:2] == (3, 1)
    assert math.prod(needed([a - b])[:2]) == 0


def test_what_is_executed_counts_whether_it_is_used_or_not():
    def formula():
        a, b = Counted(), Counted()
        _ = a * b + a
        return a

    assert executed(formula) == Cost(1, 1, 2)
    assert needed(formula()) == Cost(0, 0, 1)


def test_hidden_zeros_are_counted():
    a = Counted()
    assert needed([x * a for x in (0.0, 1.0)])[:2] == (0, 0)
    assert needed([x * a for x in dense((0.0, 1.0))])[:2] == (2, 0)
