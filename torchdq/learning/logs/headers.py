"""Search for the columns of a layout in the header of a log; and what is said where some are not there.

A log with half of its columns still has its use: an error names the models that what is there can tell.
"""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace

from torchdq.learning.logs.layouts import NEEDED, SIGNALS, Layout, LogError, is_number, listed

SEPARATORS = {";": "semicolons", "\t": "tabs", " ": "spaces", "|": "bars"}  # where commas are needed
CURRENT = re.compile(r"cur(rent)?(?![a-z])|\bi_?\[?\d", re.IGNORECASE)  # in names of columns of motor currents


def find_columns(where: str, layout: Layout, heads: list[str]) -> tuple[Layout, dict[str, list[str]]]:
    """Layout with its number of joints, and names of the columns to read by signal: time, q and what else is known.

    Args:
        where: file and row, for the message.
        layout: the layout.
        heads: names in the header.
    Raises:
        LogError: a column is missing or there twice, or the joints are not as many as the layout has.
    """
    joints = layout.count(heads)
    n = layout.joints or max(joints, 1)
    counts = Counter(heads)
    columns = {signal: layout.names(signal, n) for signal in SIGNALS if layout.has(signal)}
    if "qdd" not in layout.columns and not any(re.fullmatch(r"qdd\d+", head) for head in heads):
        columns.pop("qdd", None)
    if "command" not in layout.columns:
        columns.pop("command", None)
    readers = Counter(name for names in columns.values() for name in names)
    if twice := [name for name, count in readers.items() if count > 1]:
        raise LogError(
            f"{where}: {', '.join(map(repr, twice))} would be read for several signals or joints; see columns"
        )
    needed = ", ".join(_range(columns[signal]) for signal in NEEDED if signal in columns)
    for name in (name for names in columns.values() for name in names):
        if counts[name] != 1:
            found = f"there are several columns {name!r}" if name in counts else f"there is no column {name!r}"
            cure = _cure(name, heads)
            lost = [signal for signal, names in columns.items() if not counts.keys() & {*names}]
            if joints == n and name not in counts and (way := still_possible(lost, heads)):
                cure += f"; {way}"
            raise LogError(f"{where}: {found}; needed are columns {needed}; {cure}")
    if joints != n:
        raise LogError(f"{where}: {joints} joints, expected {n}")
    for signal in columns if not layout.joints else ():
        for more in layout.names(signal, n + 1)[n:]:
            if signal != "time" and more in counts:
                cure = f"positions of all joints are needed, or Layout(joints={n}), which leaves the others out"
                raise LogError(f"{where}: there is {more!r}, but positions of {n} joints; {cure}")
    for signal, names in columns.items():
        if signal != "time" and len(names) != n:
            raise LogError(f"{where}: {len(names)} columns of {signal}, expected {n}, one for each joint")
    return replace(layout, joints=n) if not layout.joints else layout, columns


def still_possible(lost: Collection[str], names: Sequence[str]) -> str:
    """Words for what a log without some of its signals is still good for, and how to say so; "" if for nothing.

    Args:
        lost: signals of which nothing is there.
        names: names of what is there.
    """
    if "q" in lost or "time" in lost:
        return ""
    if "tau" in lost:
        currents = [name for name in names if CURRENT.search(name)]
        none = "columns={'qd': None, 'tau': None}" if "qd" in lost else "columns={'tau': None}"
        velocities = ", 'qd': None" if "qd" in lost else ""
        if currents:
            return (
                f"if {currents[0]!r} is a motor current, read it by columns={{'tau': ...{velocities}}} and gain=None, "
                "and identify(robot, motions, gains=True) finds torques per ampere"
            )
        return (
            f"without torques, Layout({none}) reads the motion alone: smooth makes velocities and accelerations of it, "
            "and fit_rollout fits a simulation to the positions if the commands are known (columns={'command': ...})"
        )
    if "qd" in lost:
        return (
            "if velocities were not recorded, Layout(columns={'qd': None}) reads positions and torques: smooth makes "
            "velocities of the positions, and identify and fit work as with recorded ones"
        )
    return ""


def _range(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} ... {names[-1]}"


def _cure(name: str, heads: list[str]) -> str:
    """Probable reason why a column is not there, and what to do."""
    if heads[0].startswith("#"):
        return f"the line is {heads[0][:40]!r} ...; remove the lines before the header"
    if '"' in heads[0]:
        return "quotation marks must be removed"
    if len(heads) == 1:
        for separator, word in SEPARATORS.items():
            if separator in heads[0]:
                return f"columns are separated by {word}; commas are needed"
    if all(is_number(head) for head in heads):
        return "the line holds numbers; a file without a header needs a Layout(header=False, joints=...)"
    for head in heads:
        if head.lower() == name.lower() and head != name:
            return f"there is {head!r}; capitals count"
    example = "{'q': 'position_{0}'}"
    return f"other names are given by Layout(columns=...), e.g. {example}; found {listed(heads)}"
