"""Findings: faults, notes and diagnostics as values, rendered once for Python and once for the command line."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Literal, NamedTuple

__all__ = ["Finding"]

Severity = Literal["ok", "note", "warning", "error"]


def printable(text: str, kept: str = "") -> str:
    """Text with escapes for what a terminal would obey: control characters, line breaks, marks of direction.

    Names of files may hold them; every text that may hold such names passes here before it is shown.

    >>> print(printable("elbow\\u202e\\n99 kg"))
    elbow\\u202e\\n99 kg
    """
    if text.isprintable():
        return text
    return "".join(x if x.isprintable() or x in kept else json.dumps(x)[1:-1] for x in text)


class Finding(NamedTuple):
    """Fault, note or diagnostic: its subject, what was expected, what was found, and the cure.

    Compare findings by `code` and `subject`; the words may change.

    >>> claim, cure = "mass must not be negative", "correct its <mass>"
    >>> found = Finding("mass.negative", "link 'forearm'", claim, "-1 kg", cure)
    >>> print(found)
    link 'forearm': mass must not be negative, found -1 kg; correct its <mass>
    """

    code: str  # stable name of the kind of finding: "inertia.triangle"
    subject: str = ""  # joint, link, signal, parameter or file that it is about; empty: the whole
    expected: str = ""
    found: str = ""
    cure: str = ""
    option: str | None = None  # the cure in options of the command line, where Python's words would not serve
    severity: Severity = "warning"
    value: float | None = None  # the number that was found, where there is one

    def __str__(self) -> str:
        return self.text()

    def text(self, command_line: bool = False) -> str:
        """Sentence for a person, with the cure in Python's words or in options of the command line."""
        cure = self.option if command_line and self.option is not None else self.cure
        claim = ", found ".join(part for part in (self.expected, self.found) if part)
        sentence = f"{self.subject}: {claim}" if self.subject else claim
        return printable(f"{sentence}; {cure}" if cure else sentence)


def merged(findings: Sequence[Finding], command_line: bool = False) -> str:
    """Text of several findings; those that share their claim and cure are one sentence about all their subjects.

    >>> wrong = [
    ...     Finding("torque.sign", joint, "signs must agree", "-1") for joint in ("hip", "knee")
    ... ]
    >>> print(merged(wrong))
    hip, knee: signs must agree, found -1, -1
    """
    groups: dict[tuple[str, str, str], list[Finding]] = {}
    for one in findings:
        groups.setdefault((one.code, one.expected, one.cure), []).append(one)
    return "; ".join(
        some[0]
        ._replace(
            subject=", ".join(dict.fromkeys(one.subject for one in some if one.subject)),
            found=", ".join(one.found for one in some if one.found),
        )
        .text(command_line)
        for some in groups.values()
    )
