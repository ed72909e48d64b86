"""Formulas of docstrings in TeX.

A docstring writes a formula as code would, `tau = -level qd / sqrt(qd^2 + width^2)`, so that it is readable where
there is no TeX. A page shows the same formula set. A name is a symbol if it is a letter, a letter with d for a rate, a
Greek letter, or one that the caller knows; other names are words.
"""

from __future__ import annotations

import re
from collections.abc import Set

GREEK = ("tau", "mu", "sigma", "pi")
FUNCTIONS = ("sin", "cos", "exp", "max", "min", "sqrt", "log")
NAMED = ("sign", "floor", "mean", "diag", "dt")  # names that TeX does not have
OPERATORS = {"<=": r"\le ", ">=": r"\ge ", "*": r"\cdot ", ".": r"\cdot ", ",": r",\; "}
TOKEN = re.compile(r"\s*(?:([A-Za-z]+(?:_[A-Za-z0-9])?)('*)|(\d+(?:\.\d+)?)|(<=|>=|[-+*/=<>(),.|^]))")
SPLIT = re.compile(r",\s{2,}")  # between equations of one line
POWER = re.compile(r"-?\w+")
SYMBOL = re.compile(r"[A-Za-z]d{0,2}|th|thd|[A-Za-z]_[A-Za-z0-9]")


def symbol(name: str, known: Set[str]) -> str | None:
    """TeX of a name that is a symbol; None: it is a word."""
    if name in GREEK:
        return rf"\{name}"
    if name in FUNCTIONS:
        return rf"\{name}"
    if name in known or name in NAMED:
        return rf"\mathrm{{{name}}}" if len(name) > 1 else name
    if "_" in name:
        letter, _, index = name.partition("_")
        return rf"\{letter}_{{{index}}}" if letter in GREEK else rf"{letter}_{{{index}}}"
    if not SYMBOL.fullmatch(name):
        return None
    base, rates = (r"\theta", name[2:]) if name.startswith("th") else (name[0], name[1:])
    return {0: base, 1: rf"\dot {base}", 2: rf"\ddot {base}"}[len(rates)]


def length(text: str, known: Set[str]) -> int:
    """Characters at the start of a text that are a formula; 0 if there is none."""
    at, depth, end, relations = 0, 0, 0, 0
    while match := TOKEN.match(text, at):
        name, _, number, operator = match.groups()
        if name and symbol(name, known) is None:
            break
        at = match.end()
        depth += (operator == "(") - (operator == ")")
        relations += operator in ("=", "<=", ">=")
        if depth == 0 and (name or number or operator in (")", "|")):
            end = at
    return end if relations else 0


def tex(text: str, known: Set[str] = frozenset()) -> str:
    """TeX of a formula, or of several with a comma and two blanks between them; words are set as such."""
    return r",\qquad ".join(_one(part.strip(), known) for part in SPLIT.split(text.strip()))


def _one(text: str, known: Set[str]) -> str:
    parts: list[str] = []
    closing: list[str] = []  # what ends each open bracket
    at, bar, factor = 0, False, False  # factor: what comes next is multiplied by what was before

    def put(found: str, space: bool = True) -> None:
        parts.append(r"\," + found if factor and space else found)

    while match := TOKEN.match(text, at):
        name, primes, number, operator = match.groups()
        close = text[at] == "("  # without a blank: what a function is applied to
        if name:
            found = symbol(name, known)
            if found is None:
                break
            at = match.end()
            put(found + primes)
            factor = name not in FUNCTIONS
            if name == "sqrt":
                at = text.index("(", at) + 1
                parts.append("{")
                closing.append("}")
            continue
        at = match.end()
        if number:
            put(number)
            factor = True
        elif operator == "(":
            put("(", not close)
            closing.append(")")
            factor = False
        elif operator == ")":
            parts.append(closing.pop())
            factor = True
        elif operator == "|":
            put(r"\rvert " if bar else r"\lvert ", not bar)
            bar = not bar
            factor = not bar
        elif operator == "^":
            power = POWER.match(text, at)
            assert power, f"no power at {text[at:]!r}"
            parts.append(f"^{{{power.group()}}}")
            at, factor = power.end(), True
        else:
            unary = operator == "-" and not factor
            parts.append("-" if unary else OPERATORS.get(operator, f" {operator} "))
            factor = False
    words = text[at:].strip()
    return "".join(parts) + (rf"\;\text{{{words}}}" if words and parts else rf"\text{{{words}}}" if words else "")
