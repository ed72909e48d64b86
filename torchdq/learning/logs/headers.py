"""Columns of a layout in the tables of a log, and errors about those that are missing.

A log with half of its columns still has its use: an error names the models that are possible with what is there.
"""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
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

Places = Mapping[str, list[tuple[int, int]]]  # tables that have a column, and its place there, by name


def find_columns(where: str, layout: Layout, tables: Sequence[Table]) -> tuple[Layout, dict[str, list[str]], Places]:
    """Layout with its number of joints, names of the columns to read by signal, and where columns are."""
    places, arrays = _places(tables)
    heads = [name for table in tables for name in [*filter(None, table.arrays)] or table.heads]
    given = _with_arrays(layout, arrays, places)
    joints = given.count(places)
    n = layout.joints or max(joints, 1)
    columns = {signal: given.names(signal, n) for signal in SIGNALS if layout.has(signal)}
    if "qdd" not in given.columns and not any(re.fullmatch(r"qdd\d+", head) for head in places):
        columns.pop("qdd", None)
    if "command" not in given.columns:
        columns.pop("command", None)
    counts = {name: len(found) for name, found in places.items()}
    fault = _twice(columns) or _missing(columns, counts, heads, joints == n, tables)
    if not fault and joints != n:
        fault = Finding("log.joints", "", f"{n} joints are needed", str(joints), value=joints)
    if not fault and not layout.joints:
        fault = _more(columns, counts, given, n)
    for signal, names in columns.items():
        if not fault and signal != "time" and len(names) != n:
            expected = f"{n} columns of {signal} are needed, one for each joint"
            fault = Finding("column.count", "", expected, str(len(names)), value=len(names))
    if fault:
        raise LogError(fault, where=where)
    return layout if layout.joints else replace(layout, joints=n), columns, places


def _places(tables: Sequence[Table]) -> tuple[dict[str, list[tuple[int, int]]], dict[str, list[str]]]:
    """Where columns are, by name, and the columns of arrays; in one of several tables also by table:name."""
    places: dict[str, list[tuple[int, int]]] = {}
    arrays: dict[str, list[str]] = {}
    several = Counter(name for table in tables for name in table.arrays)
    for i, table in enumerate(tables):
        for prefix in ["", f"{table.name}:"][: 1 + (len(tables) > 1)]:
            for k, head in enumerate(table.heads):
                places.setdefault(prefix + head, []).append((i, k))
            arrays |= {
                prefix + name: [prefix + column for column in columns]
                for name, columns in table.arrays.items()
                if prefix or several[name] == 1
            }
    return places, arrays


def _with_arrays(layout: Layout, arrays: Mapping[str, Sequence[str]], heads: Collection[str]) -> Layout:
    """Layout in which names of arrays are those of their columns."""
    expanded: dict[str, str | list[str]] = {}
    for signal in filter(layout.has, SIGNALS):
        given = layout.columns.get(signal, signal)
        names = [bare(given)] if isinstance(given, str) else list(map(bare, given or ()))
        if any(name in arrays for name in names):
            columns = [column for name in names for column in arrays.get(name, [name])]
            expanded[signal] = columns[0] if signal == "time" else columns
        elif arrays and signal in NEEDED and signal not in layout.columns and f"{signal}1" not in heads:
            expanded[signal] = signal
    return layout.with_columns(expanded)


def _twice(columns: dict[str, list[str]]) -> Finding | None:
    """Fault of columns that would be read for several signals or joints."""
    readers = Counter(name for names in columns.values() for name in names)
    if not (twice := [name for name, count in readers.items() if count > 1]):
        return None
    claim = f"{', '.join(map(repr, twice))} would be read for several signals or joints"
    return Finding("column.shared", "", claim, "", "see columns", "see --columns")


def _missing(
    columns: dict[str, list[str]], counts: Mapping[str, int], heads: list[str], whole: bool, tables: Sequence[Table]
) -> Finding | None:
    """Fault of the first column that is not there, or there twice; `whole` if positions of all joints are there."""
    names = ((names[0], names[-1]) for signal in NEEDED if (names := columns.get(signal)))
    needed = ", ".join(first if first == last else f"{first} ... {last}" for first, last in names)
    for signal, name in ((signal, name) for signal, names in columns.items() for name in names):
        if name not in counts:
            claim = f"there is no column {name!r}; needed are columns {needed}"
            fault = Finding("column.missing", "", claim, "", *_cure(name, heads))
            absent = [signal for signal, names in columns.items() if not counts.keys() & {*names}]
            return missing_signals(fault, absent, heads) if whole else fault
        if counts[name] > 1 and (signal != "time" or len(tables) == 1):
            cure = "" if len(tables) == 1 else f"one of them is called {tables[0].name}:{name}"
            claim = f"there are several columns {name!r}; needed are columns {needed}"
            return Finding("column.repeated", "", claim, "", cure or OTHER_NAMES[0], cure or OTHER_NAMES[1])
    return None


def _more(columns: dict[str, list[str]], counts: Mapping[str, int], layout: Layout, n: int) -> Finding | None:
    """Fault of signals that have columns of more joints than there are positions of."""
    for signal in columns:
        for more in layout.names(signal, n + 1)[n:]:
            if more in counts and len(layout.starts(signal)) == 1:
                cure = f"positions of all joints are needed, or Layout(joints={n}), which leaves the others out"
                some = ",".join(columns[signal])
                option = f"positions of all joints are needed, or the names of some: --columns {signal} {some}"
                return Finding("column.more", "", f"there is {more!r}, but positions of {n} joints", "", cure, option)
    return None


def missing_signals(fault: Finding, absent: Collection[str], names: Sequence[str]) -> Finding:
    """Fault with cures that name the models which are possible without some signals, among other names."""
    if "q" in absent or "time" in absent or not {"qd", "tau"} & {*absent}:
        return fault
    velocities = (", 'qd': None", " qd none") if "qd" in absent else ("", "")
    current = next((name for name in names if CURRENT.search(name)), None)
    if "tau" not in absent:
        way = "if velocities were not recorded, {} reads positions and torques, and smooth differentiates the positions"
        cure, option = way.format("Layout(columns={'qd': None})"), way.format("--columns qd none")
    elif current is not None:
        way = f"if {current!r} is a motor current, read it by {{}}, which finds torques per ampere"
        cure = way.format(f"columns={{'tau': ...{velocities[0]}}}, gain=None and Model(gains=True) of identify")
        option = way.format(f"--columns tau NAME{velocities[1]} and --estimate-gains")
    else:
        cure = f"Layout(columns={{'tau': None{velocities[0]}}}) reads positions, and commands, for fit_rollout"
        option = "identification needs torques; fit_rollout, in Python, fits a scene to positions and commands"
    return fault._replace(cure=f"{fault.cure}; {cure}", option=f"{fault.option or fault.cure}; {option}")


def _cure(name: str, heads: list[str]) -> tuple[str, str]:
    """Probable reason why a column is not there, and what to do, in Python's words and in options."""
    if close := [head for head in heads if head.lower() == name.lower() and head != name]:
        same = f"there is {close[0]!r}; capitals count"
        return same, same
    if heads and all(head.isdecimal() for head in heads):
        n = max(1, (len(heads) - 1) // 3)
        columns = {"time": "1", "q": "{2}", "qd": f"{{{2 + n}}}", "tau": f"{{{2 + 2 * n}}}"}
        options = " ".join(f"{signal} {names}" for signal, names in columns.items())
        line = f"without a header columns are called {heads[0]} ... {heads[-1]}; name them, e.g. by"
        return f"{line} Layout(columns={columns})", f"{line} --columns {options}"
    found = f"; found {listed(heads)}"
    if name == "time" or name.endswith(":time"):
        python, option = (f"rows at an even rate need no times, but {way}" for way in ("Layout(rate=...)", "--rate"))
        return f"{python}; {OTHER_NAMES[0]}{found}", f"{option}; {OTHER_NAMES[1]}{found}"
    return f"{OTHER_NAMES[0]}{found}", f"{OTHER_NAMES[1]}{found}"
