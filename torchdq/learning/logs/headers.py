"""Columns of a layout in the header of a log, and errors about those that are missing.

A log with half of its columns still has its use: an error names the models that are possible with what is there.
"""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace

from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.layouts import NEEDED, SIGNALS, Layout, is_number, listed

SEPARATORS = {";": "semicolons", "\t": "tabs", " ": "spaces", "|": "bars"}  # where commas are needed
CURRENT = re.compile(r"cur(rent)?(?![a-z])|\bi_?\[?\d", re.IGNORECASE)  # in names of columns of motor currents
OTHER_NAMES = (
    "other names are given by Layout(columns=...), e.g. {'q': 'position_{0}'}",
    "other names are given by --columns, e.g. --columns q position_{0}",
)


def find_columns(where: str, layout: Layout, heads: list[str]) -> tuple[Layout, dict[str, list[str]]]:
    """Layout with its number of joints, and names of the columns to read by signal: time, q and what else is known."""
    joints = layout.count(heads)
    n = layout.joints or max(joints, 1)
    counts = Counter(heads)
    columns = {signal: layout.names(signal, n) for signal in SIGNALS if layout.has(signal)}
    if "qdd" not in layout.columns and not any(re.fullmatch(r"qdd\d+", head) for head in heads):
        columns.pop("qdd", None)
    if "command" not in layout.columns:
        columns.pop("command", None)
    fault = _twice(columns) or _missing(columns, counts, heads, joints == n)
    if not fault and joints != n:
        fault = Finding("log.joints", "", f"{n} joints are needed", str(joints), value=joints)
    if not fault and not layout.joints:
        fault = _more(columns, counts, layout, n)
    for signal, names in columns.items():
        if not fault and signal != "time" and len(names) != n:
            expected = f"{n} columns of {signal} are needed, one for each joint"
            fault = Finding("column.count", "", expected, str(len(names)), value=len(names))
    if fault:
        raise LogError(fault, where=where)
    return layout if layout.joints else replace(layout, joints=n), columns


def _twice(columns: dict[str, list[str]]) -> Finding | None:
    """Fault of columns that would be read for several signals or joints."""
    readers = Counter(name for names in columns.values() for name in names)
    if not (twice := [name for name, count in readers.items() if count > 1]):
        return None
    claim = f"{', '.join(map(repr, twice))} would be read for several signals or joints"
    return Finding("column.shared", "", claim, "", "see columns", "see --columns")


def _missing(columns: dict[str, list[str]], counts: Counter[str], heads: list[str], whole: bool) -> Finding | None:
    """Fault of the first column that is not there, or there twice; `whole` if positions of all joints are there."""
    names = ((names[0], names[-1]) for signal in NEEDED if (names := columns.get(signal)))
    needed = ", ".join(first if first == last else f"{first} ... {last}" for first, last in names)
    for name in (name for names in columns.values() for name in names):
        if counts[name] != 1:
            claim = f"there are several columns {name!r}" if name in counts else f"there is no column {name!r}"
            code = "column.repeated" if name in counts else "column.missing"
            fault = Finding(code, "", f"{claim}; needed are columns {needed}", "", *_cure(name, heads))
            absent = [signal for signal, names in columns.items() if not counts.keys() & {*names}]
            return missing_signals(fault, absent, heads) if whole and name not in counts else fault
    return None


def _more(columns: dict[str, list[str]], counts: Counter[str], layout: Layout, n: int) -> Finding | None:
    """Fault of signals that have columns of more joints than there are positions of."""
    for signal in columns:
        for more in layout.names(signal, n + 1)[n:]:
            if signal != "time" and more in counts:
                cure = f"positions of all joints are needed, or Layout(joints={n}), which leaves the others out"
                some = ",".join(columns[signal])
                option = f"positions of all joints are needed, or the names of some: --columns {signal} {some}"
                return Finding("column.more", "", f"there is {more!r}, but positions of {n} joints", "", cure, option)
    return None


def missing_signals(fault: Finding, absent: Collection[str], names: Sequence[str]) -> Finding:
    """Fault with cures that name the models which are possible without some signals, among other names."""
    if "q" in absent or "time" in absent or not {"qd", "tau"} & {*absent}:
        return fault
    velocities = "qd" in absent
    current = next((name for name in names if CURRENT.search(name)), None)
    if "tau" not in absent:
        cure = (
            "if velocities were not recorded, Layout(columns={'qd': None}) reads positions and torques: smooth makes "
            "velocities of the positions, and identify and fit work as with recorded ones"
        )
        option = "if velocities were not recorded, --columns qd none reads positions and torques"
    elif current is not None:
        given = ", 'qd': None" if velocities else ""
        cure = (
            f"if {current!r} is a motor current, read it by columns={{'tau': ...{given}}} and gain=None, "
            "and identify(robot, motions, Model(gains=True)) finds torques per ampere"
        )
        given = " qd none" if velocities else ""
        option = (
            f"if {current!r} is a motor current, read it by --columns tau NAME{given}, and --estimate-gains finds "
            "torques per ampere"
        )
    else:
        none = "columns={'qd': None, 'tau': None}" if velocities else "columns={'tau': None}"
        cure = (
            f"without torques, Layout({none}) reads the motion alone: smooth makes velocities and accelerations of it, "
            "and fit_rollout fits a simulation to the positions if the commands are known (columns={'command': ...})"
        )
        option = (
            "torques are needed to identify a robot; without them fit_rollout, in Python, fits a scene to positions"
        )
    return fault._replace(cure=f"{fault.cure}; {cure}", option=f"{fault.option or fault.cure}; {option}")


def _cure(name: str, heads: list[str]) -> tuple[str, str]:
    """Probable reason why a column is not there, and what to do, in Python's words and in options."""
    same = ""
    if heads[0].startswith("#"):
        same = f"the line is {heads[0][:40]!r} ...; remove the lines before the header"
    elif '"' in heads[0]:
        same = "quotation marks must be removed"
    elif len(heads) == 1 and (words := [word for separator, word in SEPARATORS.items() if separator in heads[0]]):
        same = f"columns are separated by {words[0]}; commas are needed"
    elif all(is_number(head) for head in heads):
        line = "the line holds numbers; a file without a header needs"
        return f"{line} a Layout(header=False, joints=...)", f"{line} --blocks, e.g. --blocks q qd tau"
    elif close := [head for head in heads if head.lower() == name.lower() and head != name]:
        same = f"there is {close[0]!r}; capitals count"
    if same:
        return same, same
    return f"{OTHER_NAMES[0]}; found {listed(heads)}", f"{OTHER_NAMES[1]}; found {listed(heads)}"
