"""The paper, equation by equation: what each says, where it is computed and which test holds it.

`equations.txt` holds what nothing else knows, `errata.txt` the errata, and `torchdq.paper.tables` verdicts on the
paper's costs. `docs/equations.md` is written from all three:

    python tests/paper/paper_index.py [--write]

The lines of `equations.txt` are equations, rows of Table 1, lines of Algorithm 1 and figures, under their sections:

    id  |  what it says, as corrected  |  code  |  tests  |  what stands for it, where no line computes it  |  repeats

Code is `module:name`, the module below torchdq, or a file. `repeats` are equations whose errata the line shares.
"""

import argparse
import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from errata_table import COMPONENT, ERRATA, IDS, Erratum, cells

from torchdq.paper import cost, tables

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "equations.md"
OURS = "paper/test_paper_errata.py::test_ours_agrees_with_an_independent_reference"
SHORT = {
    "algebra": "algebra/test_algebra.py",
    "control": "layers/test_computed_torque.py",
    "golden": "paper/test_paper_golden.py",
    "identities": "claims/test_identities.py",
    "ours": OURS,
}


def numbers(text: str) -> set[int]:
    """Equations that a text names, as (40), and as (57)-(72) with those between."""
    found: set[int] = set()
    for first, last in re.findall(r"(?<![\w)\]])\((\d{1,2})\)(?:-\((\d{1,2})\))?", text):
        found |= set(range(int(first), int(last or first) + 1))
    return found


class Row(NamedTuple):
    """Line of `equations.txt`."""

    id: str
    says: str
    code: str
    test: str
    instead: str = ""
    repeats: str = ""

    @property
    def number(self) -> int | None:
        """Number of an equation; None: it is something else."""
        return next(iter(numbers(self.id)), None)

    @property
    def places(self) -> list[str]:
        """Places of the code."""
        return self.code.split()

    @property
    def tests(self) -> list[str]:
        """Ids of the tests, whose files may be named by `SHORT`."""
        return [re.sub(r"^\w+(?=::|\[)", lambda name: SHORT[name[0]], test) for test in self.test.split()]

    @property
    def errata(self) -> list[str]:
        """Ids of the errata that have their place here, or in an equation that it repeats."""
        kind, _, k = self.id.partition(" ")
        if kind == "row":
            return [f"T1.{k}"] if f"T1.{k}" in IDS else []
        named = [e for e in ERRATA if self.number or "Algorithm 1" in e.where]
        found = [e.id for e in named if numbers(e.where) & numbers(f"{self.id} {self.repeats}")]
        last = ["A1"] if self.id == "backward 3" else []  # the last line
        return list(dict.fromkeys(last + found))


def read() -> dict[str, list[Row]]:
    """Rows by the headings of their sections."""
    sections: dict[str, list[Row]] = {}
    for line in cells("equations.txt"):
        if line[0].startswith("#"):
            rows = sections[line[0]] = []
        else:
            rows.append(Row(*line))
    return sections


SECTIONS = read()
ROWS = [row for rows in SECTIONS.values() for row in rows]


def path_of(place: str) -> Path:
    """File of a place."""
    module, colon, _ = place.partition(":")
    if not colon:
        return ROOT / module
    folder = ROOT if module.startswith("envs.") else ROOT / "torchdq"
    return (folder / module.replace(".", "/")).with_suffix(".py")


def plain(text: str) -> str:
    """Text that Markdown leaves as it is, within a table."""
    return re.sub(r"([*|<])", r"\\\1", text)


def size(erratum: Erratum) -> str:
    """Error of the printed form."""
    if erratum.error is None:
        return f"its {erratum.unit} does not fit"
    unit = f"in the {COMPONENT}" if erratum.unit == COMPONENT else erratum.unit
    return f"{erratum.error:g} {unit}"


def link_to_code(place: str) -> str:
    """Link to a place."""
    module, colon, name = place.partition(":")
    text = f"{module.rpartition('.')[2]}.{name}" if colon else Path(module).name
    return f"[{text}]({path_of(place).relative_to(ROOT)})"


def link_to_test(test: str) -> str:
    """Link to a test's file, by the test's id."""
    return f"[{test}](tests/{test.partition('::')[0]})"


def table(rows: Iterable[Row]) -> str:
    """Rows as a table."""
    lines = ["| | equation | code | test | erratum |", "|---|---|---|---|---|"]
    for row in rows:
        code = ", ".join(map(link_to_code, row.places))
        code = f"{plain(row.instead)}: {code}" if row.instead else code
        line = (row.id, plain(row.says), code, ", ".join(map(link_to_test, row.tests)), ", ".join(row.errata))
        lines.append(f"| {' | '.join(line)} |".replace("  |", " |"))
    return "\n".join(lines)


def corrected(ids: Iterable[str]) -> str:
    """Errata as a table, printed form beside correct form and the error of the former."""
    wanted = set(ids)
    lines = ["| erratum | where | printed | correct | error as printed |", "|---|---|---|---|---|"]
    for erratum in ERRATA:
        if erratum.id in wanted:
            cells = (erratum.key, erratum.where, erratum.printed, erratum.correct, size(erratum))
            lines.append(f"| {' | '.join(map(plain, cells))} |")
    return "\n".join(lines)


def verdicts() -> str:
    """Tables 2 to 4: how many of the printed costs are those that are counted."""
    lines = ["| | printed rows | as counted | operations differ | only storage differs | whose operations differ |"]
    lines.append("|---|---|---|---|---|---|")
    for title, entries in tables.TABLES.items():
        printed = [entry for entry in entries if entry.printed is not None]
        wrong = [entry for entry in printed if entry.printed[:2] != entry.counted[:2]]
        stored = [entry for entry in printed if entry not in wrong and entry.printed != entry.counted]
        counts = (len(printed), len(printed) - len(wrong) - len(stored), len(wrong), len(stored))
        names = ", ".join(entry.operation for entry in wrong)
        lines.append(f"| {title} | {' | '.join(map(str, counts))} | {names} |")
    return "\n".join(lines)


def laws() -> str:
    """What the algorithms cost."""
    rows = [f"| {line.name} | {line.law()} |" for line in cost.RNEA]
    return "\n".join(["| inverse dynamics of n revolute joints | multiplications, additions |", "|---|---|", *rows])


INTRODUCTION = f"""
*A Novel Dual Quaternion Based Cost Efficient Recursive Newton-Euler Inverse Dynamics Algorithm*
([CITATION.cff](CITATION.cff)): every equation, table, line of Algorithm 1 and figure, its place in this package, and
the test that checks it.

**Unchanged**, down to the symbols: the algebra, the screws and home poses that describe a robot, the two passes of the
recursion, the closed form and the controller. **Corrected**: {len(IDS)} places, in {len(ERRATA)} readings, listed
below the equations of each section with the printed form, the correct one, and the error of the printed one. Equations
without an erratum are correct up to obvious misprints, some of which may be artefacts of a copy. **Added**: prismatic
and helical joints, trees, frames anywhere on a link, and the most efficient forms of the algorithms
([rnea](torchdq/dynamics/aligned/rnea.py), [crba](torchdq/dynamics/crba.py), [aba](torchdq/dynamics/aligned/aba.py)),
which agree with these to rounding.

* q, qd, qdd are the paper's theta and its derivatives; dq_i is q_i minus its value at home.
* **x_i^j and delta_i^j are the pose of F_i in F_j**, as in section 5.1, and Ad(x_i^j) maps screws from F_i to
  F_j; the inverse is x_j^i = (x_i^j)\\*. From (40) on the paper uses the opposite reading: errata 38, 40, 46 and 61.
  In the code X_AB is the pose of B in A, so that x_i^{{i-1}} is X_PB of link B and its parent P.
* **A twist is angular + eps linear, a wrench force + eps moment**, both about the origin of their frame. Power is
  therefore f (.) (D(w) + eps P(w)), with the parts of one exchanged.
* wd is the rate of a twist's components in the body, the spatial acceleration; gravity is the acceleration -eps g of
  the base. f_EF is what the end effector exerts on the environment.
* (.) is the double geodesic product, (x) and (\\*) are the entry-wise cross and double geodesic products, L^H is the
  conjugate transpose.

Errors are medians over twenty random chains of six joints, with torques of about 58 N m, or over twenty random draws;
if an arm is named, they are those of the paper's arm.
[paper/test_paper_errata.py](tests/paper/test_paper_errata.py) measures all of them, and
compares this package in the same place with Pinocchio or the definition. Words before the code mean that the code does
not compute the equation itself, but an alternative.
""".strip()

IN_USE = f"""
Line by line it is [printed.rnea](torchdq/paper/printed.py). The code below is its form on trees, used if the
geometry of a robot is learned or differs from sample to sample; otherwise it is
[newton_euler](torchdq/dynamics/aligned/rnea.py), the same recursion in the most efficient frames
({link_to_test("program/test_program.py::test_torques_in_aligned_frames_equal_the_papers_recursion")}).
""".strip()

FOOT = """
`python tests/paper/paper_index.py --write` writes this page; `tests/paper/test_paper_index.py` checks it against the
sources.
""".strip()


VERDICTS = """
`torchdq cost` prints Tables 2, 3 and 4 row by row, with the counts of running each formula, and reasons for
differences ([tables](torchdq/paper/tables.py), checked by [test_cost.py](tests/paper/test_cost.py)):

{}

Dual quaternions cost less than homogeneous matrices, as the paper finds, if every product is one of dense matrices;
with structural zeros and ones removed, the matrices cost less than the algorithm as printed.

{}
""".strip()


def page() -> str:
    """Text of the page."""
    parts = ["# The paper, equation by equation", INTRODUCTION]
    for heading, rows in SECTIONS.items():
        parts += [heading, IN_USE, table(rows)] if heading.endswith("Algorithm 1") else [heading, table(rows)]
        letter = {"## Algorithm 1": "A", "### Table 1": "T"}.get(heading)
        own = [id for id in IDS if id[0] == letter] if letter else {str(row.number) for row in rows} & IDS
        parts += [corrected(own)] if own else []
        parts += [VERDICTS.format(verdicts(), laws())] if "Costs" in heading else []
    return re.sub(r"\]\((?=\w)", "](../", "\n\n".join([*parts, FOOT])) + "\n"


def main() -> None:
    """Page of the paper, printed or written to its file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="write docs/equations.md instead of printing it")
    if parser.parse_args().write:
        PAGE.write_text(page(), encoding="utf-8")
    else:
        print(page(), end="")


if __name__ == "__main__":
    main()
