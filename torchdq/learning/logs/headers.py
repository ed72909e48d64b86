"""Columns of a layout in the tables of a log, and errors about those that are missing.

A log with half of its columns still has its use: an error names the models that are possible with what is there.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.layouts import NEEDED, SIGNALS, Layout, bare, listed
from torchdq.learning.logs.tables import Table

CURRENT = re.compile(r"cur(rent)?(?![a-z])|\bi_?\[?\d", re.IGNORECASE)  # in names of columns of motor currents
OTHER_NAMES = (
    "other names are given by Layout(columns=...), e.g. {'q': 'position_{0}'}",
    "other names are given by --columns, e.g. --columns q position_{0}",
)

Columns = Mapping[str, list[str]]  # names of columns by signal, or by array
Places = Mapping[str, list[tuple[int, int]]]  # tables that have a column, and its place there, by name


def find_columns(where: str, layout: Layout, tables: Sequence[Table]) -> tuple[Layout, Columns, Places]:
    """Layout with its number of joints, names of the columns to read by signal, and where columns are."""
    places, arrays = _places(tables)
    given = _with_arrays(layout, arrays, places)
    n = layout.joints or max(given.count(places), 1)
    wanted = {*NEEDED, *given.columns, *("qdd" for head in places if re.fullmatch(r"qdd\d+", head))}
    columns = {signal: given.names(signal, n) for signal in SIGNALS if signal in wanted and layout.has(signal)}
    for fault in _faults(given, n, columns, places, tables):
        raise LogError(fault, where=where)
    return layout if layout.joints else replace(layout, joints=n), columns, places


def _places(tables: Sequence[Table]) -> tuple[Places, Columns]:
    """Where columns are, by name, and the columns of arrays; in one of several tables also by table:name."""
    places: dict[str, list[tuple[int, int]]] = {}
    arrays: dict[str, list[str]] = {}
    several = Counter(name for table in tables for name in table.arrays)
    for i, table in enumerate(tables):
        for prefix in ("", f"{table.name}:") if len(tables) > 1 else ("",):
            for k, head in enumerate(table.heads):
                places.setdefault(prefix + head, []).append((i, k))
            for name, columns in table.arrays.items():
                if prefix or several[name] == 1:
                    arrays[prefix + name] = [prefix + column for column in columns]
    return places, arrays


def _with_arrays(layout: Layout, arrays: Columns, heads: Collection[str]) -> Layout:
    """Layout in which names of arrays are those of their columns."""
    expanded: dict[str, str | list[str]] = {}
    for signal in filter(layout.has, SIGNALS):
        given = layout.columns.get(signal, signal)
        names = [bare(given)] if isinstance(given, str) else list(map(bare, given or ()))
        if any(name in arrays for name in names):
            columns = [column for name in names for column in arrays.get(name, [name])]
            expanded[signal] = columns[0] if signal == "time" else columns
        elif signal not in layout.columns and f"{signal}0" in heads and signal != "time":
            expanded[signal] = f"{signal}{{0}}"
        elif arrays and signal in NEEDED and signal not in layout.columns and f"{signal}1" not in heads:
            expanded[signal] = signal
    return layout.with_columns(expanded)


def _faults(layout: Layout, n: int, columns: Columns, places: Places, tables: Sequence[Table]) -> Iterator[Finding]:
    """Faults of the columns of n joints."""
    readers = Counter(name for names in columns.values() for name in names)
    if twice := [name for name, count in readers.items() if count > 1]:
        claim = f"{', '.join(map(repr, twice))} would be read for several signals or joints"
        yield Finding("column.shared", "", claim, "", "see columns", "see --columns")
    joints = layout.count(places)
    yield from _missing(columns, places, joints == n, tables)
    if joints != n:
        yield Finding("log.joints", "", f"{n} joints are needed", str(joints), value=joints)
    for signal in columns if not layout.joints else ():
        for more in layout.names(signal, n + 1)[n:]:
            if more in places and len(layout.starts(signal)) == 1:
                cure = f"positions of all joints are needed, or Layout(joints={n}), which leaves the others out"
                some = ",".join(columns[signal])
                option = f"positions of all joints are needed, or the names of some: --columns {signal} {some}"
                yield Finding("column.more", "", f"there is {more!r}, but positions of {n} joints", "", cure, option)
    for signal, names in columns.items():
        if signal != "time" and len(names) != n:
            expected = f"{n} columns of {signal} are needed, one for each joint"
            yield Finding("column.count", "", expected, str(len(names)), value=len(names))


def _missing(columns: Columns, places: Places, whole: bool, tables: Sequence[Table]) -> Iterator[Finding]:
    """Faults of columns that are not there, or there twice; `whole` if positions of all joints are there."""
    ends = ((names[0], names[-1]) for signal in NEEDED if (names := columns.get(signal)))
    needed = ", ".join(first if first == last else f"{first} ... {last}" for first, last in ends)
    heads = [name for table in tables for name in [*filter(None, table.arrays)] or table.heads]
    for signal, name in ((signal, name) for signal, names in columns.items() for name in names):
        if name not in places:
            absent = [signal for signal, names in columns.items() if not places.keys() & {*names}]
            cures = [*_cures(name, heads), *(_possible(absent, heads) if whole else ())]
            cure, option = map("; ".join, zip(*cures, strict=True))
            claim = f"there is no column {name!r}; needed are columns {needed}"
            yield Finding("column.missing", "", claim, "", cure, option)
        elif len(places[name]) > 1 and (signal != "time" or len(tables) == 1):
            called = f"one of them is called {tables[0].name}:{name}"
            claim = f"there are several columns {name!r}; needed are columns {needed}"
            yield Finding("column.repeated", "", claim, "", *((called, None) if len(tables) > 1 else OTHER_NAMES))


def _cures(name: str, heads: list[str]) -> Iterator[tuple[str, str]]:
    """Probable reasons why a column is not there, and what to do, in Python's words and in options."""
    if close := [head for head in heads if head.lower() == name.lower() and head != name]:
        yield 2 * (f"there is {close[0]!r}; capitals count",)
    elif heads and all(head.isdecimal() for head in heads):
        n = max(1, (len(heads) - 1) // 3)
        columns = {"time": "1", "q": "{2}", "qd": f"{{{2 + n}}}", "tau": f"{{{2 + 2 * n}}}"}
        options = " ".join(f"{signal} {names}" for signal, names in columns.items())
        line = f"without a header columns are called {heads[0]} ... {heads[-1]}; name them, e.g. by"
        yield f"{line} Layout(columns={columns})", f"{line} --columns {options}"
    else:
        if name == "time" or name.endswith(":time"):
            way = "rows at an even rate need no times, but {}"
            yield way.format("Layout(rate=...)"), way.format("--rate")
        yield OTHER_NAMES
        yield 2 * (f"found {listed(heads)}",)


def _possible(absent: Collection[str], heads: list[str]) -> Iterator[tuple[str, str]]:
    """Models that are possible without some signals, in Python's words and in options."""
    if {"q", "time"} & {*absent}:
        return
    python, option = (", 'qd': None", " qd none") if "qd" in absent else ("", "")
    if "tau" in absent and (current := next(filter(CURRENT.search, heads), None)) is not None:
        way, end = f"if {current!r} is a motor current, read it by", ", which finds torques per ampere"
        yield (
            f"{way} columns={{'tau': ...{python}}}, gain=None and Model(gains=True) of identify{end}",
            f"{way} --columns tau NAME{option} and --estimate-gains{end}",
        )
    elif "tau" in absent:
        yield (
            f"Layout(columns={{'tau': None{python}}}) reads positions, and commands, for fit_rollout",
            "identification needs torques; fit_rollout, in Python, fits a scene to positions and commands",
        )
    elif "qd" in absent:
        way = "if velocities were not recorded, {} reads positions and torques, and smooth differentiates the positions"
        yield way.format("Layout(columns={'qd': None})"), way.format("--columns qd none")
