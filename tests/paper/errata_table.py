"""Departures of this package from the printed paper, the lines of `errata.txt`: one per reading of a wrong equation.

Ids are the equation's number, `A` and a number for Algorithm 1, `T` table and row for the tables. Sizes are medians
over twenty draws, where they are torques over twenty random six-joint chains whose torques are about 58 N m;
`paper/test_paper_errata.py` measures them again and shows that the package is right.
"""

from pathlib import Path
from typing import NamedTuple


class Erratum(NamedTuple):
    """A form that is printed, or that the print can be read as, and is wrong."""

    id: str
    reading: str  # tells the readings of one id apart; empty where there is only one
    where: str
    printed: str
    correct: str
    error: float | None  # of the printed form; None: it has no value, its shapes or types do not fit
    unit: str

    @property
    def key(self) -> str:
        """Id and reading."""
        return f"{self.id} {self.reading}".rstrip()


COMPONENT = "largest component"


def cells(file: str) -> list[list[str]]:
    """Lines of a text file of this folder, as their cells."""
    text = (Path(__file__).parent / file).read_text(encoding="utf-8")
    return [[cell.strip() for cell in line.split("  |")] for line in text.splitlines()]


ERRATA = tuple(Erratum(*words, float(error) if error else None, unit) for *words, error, unit in cells("errata.txt"))

IDS = frozenset(row.id for row in ERRATA)
