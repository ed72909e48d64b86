"""The page of equations is complete: every equation once, at code and tests that exist and cite it, with its errata."""

import ast
import io
import re
import textwrap
import tokenize
from functools import cache

import paper_index
from errata_table import ERRATA, IDS
from helpers import all_in_one
from paper_index import IN_USE, OURS, PAGE, ROOT, ROWS, corrected, numbers, path_of, plain

from torchdq.paper import tables

REMEDY = "write it again with `python tests/paper/paper_index.py --write`"
EQUATIONS = [row for row in ROWS if row.number]
TABLE_1 = [row for row in ROWS if row.id.startswith("row")]


@cache
def page():
    """Text of the page, as the index has it now."""
    return paper_index.page()


@cache
def tree(path):
    """Syntax of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def names_of(node):
    """Names that a statement gives to something."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return {target.id for target in targets if isinstance(target, ast.Name)}


def found(path, name):
    """Statement of a file that makes a dotted name, or None."""
    node = tree(path)
    for part in name.split("."):
        node = next((child for child in getattr(node, "body", ()) if part in names_of(child)), None)
    return node


def source(place):
    """Whole lines of what stands at a place."""
    path, node = path_of(place), found(path_of(place), place.partition(":")[2])
    return "\n".join(path.read_text(encoding="utf-8").splitlines()[node.lineno - 1 : node.end_lineno])


def comments(text):
    """Comments of a source."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return [token.string for token in tokens if token.type == tokenize.COMMENT]


def cited(place):
    """Equations that the comments and docstrings at a place name."""
    text = textwrap.dedent(source(place))
    nodes = ast.walk(ast.parse(text))
    documents = [
        ast.get_docstring(x) or "" for x in nodes if isinstance(x, ast.Module | ast.ClassDef | ast.FunctionDef)
    ]
    return set().union(*map(numbers, comments(text) + documents))


# --- the page --------------------------------------------------------------------------------------------------------


def test_the_page_is_what_the_index_says():
    assert PAGE.read_text(encoding="utf-8") == page(), f"{PAGE.name} is old; {REMEDY}"


def test_every_equation_table_row_line_and_figure_is_there_once():
    assert [row.id for row in ROWS if not (row.says and row.places and row.tests)] == []
    assert [row.number for row in EQUATIONS] == list(range(1, 80))
    others = {"start": 5, "forward": 4, "backward": 3, "row": 5, "Fig.": 5}  # Algorithm 1, Table 1 and figures
    expected = [f"{part} {i + 1}" for part, k in others.items() for i in range(k)]
    assert sorted(row.id for row in ROWS if not row.number) == sorted(expected)
    text = page()
    for first in [f"| ({i}) |" for i in range(1, 80)] + [f"| {title} |" for title in tables.TABLES]:
        assert text.count(f"\n{first}") == 1, first


def test_every_erratum_is_there_once_and_named_by_a_row():
    rows = [line.split(" | ")[0].removeprefix("| ") for line in page().splitlines()]
    assert [rows.count(erratum.key) for erratum in ERRATA] == [1] * len(ERRATA)
    for erratum in ERRATA:
        assert f"| {plain(erratum.printed)} | {plain(erratum.correct)} |" in page(), erratum.key
    named = re.findall(r"\| ([^|]*) \|$", page(), re.MULTILINE)
    assert {id for cell in named for id in cell.split(", ")} >= IDS


def test_links_lead_to_files():
    assert [link for link in re.findall(r"\]\(([^)]*)\)", page()) if not (PAGE.parent / link).is_file()] == []


def test_a_table_of_errata_says_how_wrong_the_print_is():
    assert "| (40), (44), section 5.1; Algorithm 1 |" in corrected(["40"])
    assert corrected(["40"]).endswith("| 71 N m |")
    assert corrected(["11"]).endswith("| its shape does not fit |")


# --- what it points to -----------------------------------------------------------------------------------------------

PLACES = sorted({place for row in ROWS for place in row.places})


@all_in_one(PLACES)
def test_code_that_is_named_exists(place):
    assert path_of(place).is_file()
    assert ":" not in place or found(path_of(place), place.partition(":")[2]) is not None


def test_code_cites_the_equation_or_the_row_of_table_1_that_it_computes():
    rows = [row for row in EQUATIONS if not row.instead]
    assert [(row.id, place) for row in rows for place in row.places if row.number not in cited(place)] == []
    for row in TABLE_1:
        assert row.instead or all(f"# Table 1, {row.id}" in source(place) for place in row.places)


TESTS = sorted({*re.findall(r"[\w/]+\.py::\w+", IN_USE), *(test for row in ROWS for test in row.tests)})


@all_in_one(TESTS)
def test_tests_that_are_named_exist(test):
    file, _, name = test.partition("::")
    path = ROOT / "tests" / file
    assert path.is_file()
    assert not name or found(path, name.partition("[")[0]) is not None
    assert not test.startswith(OURS) or test.removeprefix(OURS)[1:-1] in IDS


SOURCES = [path for folder in ("torchdq", "envs") for path in sorted((ROOT / folder).rglob("*.py"))]


def test_comments_cite_only_equations_that_are_in_the_index_at_their_file():
    listed = {(path_of(place), row.number) for row in EQUATIONS for place in row.places}
    unknown, count = [], 0
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        if not re.search(r"#.*\(\d", text):
            continue
        here = set().union(*map(numbers, comments(text)))
        count += len(here)
        unknown += [f"{path.relative_to(ROOT)}: ({number})" for number in sorted(here) if (path, number) not in listed]
    assert count > 50
    assert not unknown, "name the file in tests/paper/equations.txt, or correct the number"


def test_citations_are_read_one_by_one_in_lists_and_in_ranges():
    assert numbers("# (34), (35), erratum 35") == {34, 35}
    assert numbers("# (75)-(77) and (73)") == {73, 75, 76, 77}
    assert numbers("cos(3), 5(4), between exp(-30) and exp(30), (8.50), x[0](1)") == set()


def test_a_place_that_does_not_exist_is_not_found():
    assert found(path_of("algebra.quaternion:mul"), "multiply") is None
    assert found(path_of("control.joints:PD"), "PD.torques") is not None
    assert found(path_of("control.joints:PD"), "torques") is None
