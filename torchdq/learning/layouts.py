"""Layouts of logs: names of the columns, units and filters; and the search for the columns in a header."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real

from torchdq.checks import names_of
from torchdq.errors import ArgumentError, TorchdqError

SIGNALS = ("time", "q", "qd", "tau", "qdd")
SHOWN = 8  # most names of columns that a message holds
NUMBER = re.compile(r"\{(\d+)\}")  # place of a joint's number in a pattern, and the number of the first joint
SEPARATORS = {";": "semicolons", "\t": "tabs", " ": "spaces", "|": "bars"}  # where commas are needed


class LogError(TorchdqError, ValueError):
    """Unusable log; the message names the file, and the row and column where there is one."""


class MissingLogError(LogError, FileNotFoundError):
    """Log in a file that does not exist."""


@dataclass(frozen=True)
class Layout:
    """Columns and units of a log, and the filters its signals need.

    Args:
        joints: number of joints; 0: as many as the header names.
        blocks: names of the columns without the number of the joint, which counts from 1: ("q", "qd", "tau") are q1,
            q2 ..., qd1 ..., tau1 ... . The first three hold positions [rad or m], velocities [rad/s or m/s] and efforts
            and are read; more are named only where there is no header.
        header: whether the first line holds the names; if not, the columns are time and all `blocks`, in order.
        gain: torque per unit of effort, one number per joint [N m or N per unit], e.g. of motor currents [N m/A];
            empty: the effort is the torque.
        cutoff_qd, cutoff_tau: frequencies of the low-pass filters of velocities and torques [Hz], for `smooth`.
        farthest: position beyond which a column is refused as one in degrees or millimetres [rad or m].
        fastest: speed beyond which it is refused [rad/s or m/s].
        columns: names that `blocks` does not fit, of "time", "q", "qd", "tau" (the effort) and "qdd" [rad/s^2 or
            m/s^2]: a pattern, in which {0} is the number of the joint if the first joint has 0, {1} if it has 1, {7}
            if it has 7; or, where columns carry the names of joints, a list of names in the robot's order of joints.
            In NPZ archives these are names of arrays.

    >>> ros = Layout(columns={"time": "stamp", "q": "position_{0}", "qd": "velocity_{0}", "tau": ["base", "elbow"]})
    >>> ros.names("q", 2), ros.names("tau", 2)
    (['position_0', 'position_1'], ['base', 'elbow'])
    """

    joints: int = 0
    blocks: tuple[str, ...] = ("q", "qd", "tau")
    header: bool = True
    gain: tuple[float, ...] = ()
    cutoff_qd: float = 8.0  # [Hz]
    cutoff_tau: float = 8.0  # [Hz]
    farthest: float = 8 * math.pi  # [rad]
    fastest: float = 50.0  # [rad/s]
    columns: Mapping[str, str | Sequence[str]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        self._require_numbers()
        if isinstance(self.blocks, str) or len({*self.blocks}) < max(3, len(self.blocks)):
            expected = "three or more different names, the first of positions, velocities and torques"
            cure = "where velocities were not recorded, add qd = numpy.gradient(q, time, axis=0); `smooth` filters it"
            raise ArgumentError(f"blocks must be {expected}, found {self.blocks!r}; {cure}")
        if not isinstance(self.columns, Mapping):
            expected = "a mapping such as {'q': 'position_{0}'}"
            raise ArgumentError(f"columns must be {expected}, found {self.columns!r}")
        if self.columns and not self.header:
            raise ArgumentError("columns needs a header to find the names in; found header=False")
        if not self.header and not self.joints:
            raise ArgumentError("joints must be given for a file without a header; found joints=0, header=False")
        names_of("columns", tuple(self.columns), SIGNALS, "signal")
        lists: dict[str, int] = {}
        for signal, given in self.columns.items():
            name = f"columns[{signal!r}]"
            if not given or not isinstance(given, str | Sequence) or not all(isinstance(one, str) for one in given):
                expected = "a name, a pattern such as 'position_{0}' or a list of names"
                raise ArgumentError(f"{name} must be {expected}, found {given!r}")
            if signal == "time" and not isinstance(given, str):
                raise ArgumentError(f"{name} must be one name, found {given!r}")
            if not isinstance(given, str):
                lists[name] = len(given)
        for name, count in lists.items():
            first, most = next(iter(lists.items()))
            if self.joints and count != self.joints:
                raise ArgumentError(f"{name} has {count} names, expected {self.joints}, the number of joints")
            if count != most:
                raise ArgumentError(f"{name} has {count} names, {first} {most}")
        counts = Counter(one for x in self.columns.values() for one in ([x] if isinstance(x, str) else x))
        if twice := [name for name, count in counts.items() if count > 1]:
            raise ArgumentError(
                f"columns must name every column once, found {', '.join(map(repr, twice))} several times"
            )

    def _require_numbers(self) -> None:
        """Raise unless what must be numbers is; `gain` becomes a tuple of floats."""
        if not isinstance(self.joints, int) or isinstance(self.joints, bool) or self.joints < 0:
            raise ArgumentError(f"joints must be a whole number from 0, found {self.joints!r}")
        for name in ("cutoff_qd", "cutoff_tau", "farthest", "fastest"):
            x = getattr(self, name)
            if not isinstance(x, Real) or isinstance(x, bool) or not float(x) > 0:
                raise ArgumentError(f"{name} must be a positive number, found {x!r}")
        try:
            gain = tuple(map(float, [self.gain] if isinstance(self.gain, str) else self.gain))
        except (TypeError, ValueError) as error:
            expected = "numbers, one per joint, such as (2.0, 1.5), or () for torques"
            raise ArgumentError(f"gain must be {expected}, found {self.gain!r}") from error
        if not all(map(math.isfinite, gain)):
            raise ArgumentError(f"gain must be finite numbers, found {self.gain!r}")
        object.__setattr__(self, "gain", gain)

    def names(self, signal: str, joints: int) -> list[str]:
        """Names of a signal's columns."""
        given = self._given(signal)
        if not isinstance(given, str):
            return list(given)
        if not NUMBER.search(given):
            return [given]
        parts = NUMBER.split(given)  # the odd ones are the numbers of the first joint
        return ["".join(str(int(x) + i) if k % 2 else x for k, x in enumerate(parts)) for i in range(joints)]

    def count(self, heads: Sequence[str]) -> int:
        """Number of joints whose positions a header names."""
        given = self._given("q")
        if not isinstance(given, str):
            return len(given)
        pattern = re.compile(r"\d+".join(map(re.escape, NUMBER.split(given)[::2])))
        return sum(pattern.fullmatch(head) is not None for head in heads)

    @property
    def order(self) -> list[str]:
        """Columns of a file without a header: the time and all columns of the blocks."""
        return ["time", *(f"{block}{joint}" for block in self.blocks for joint in range(1, self.joints + 1))]

    def _given(self, signal: str) -> str | Sequence[str]:
        block = dict(zip(("q", "qd", "tau"), self.blocks, strict=False)).get(signal, signal)
        return self.columns.get(signal, "time" if signal == "time" else f"{block}{{1}}")


def find_columns(where: str, layout: Layout, heads: list[str]) -> tuple[Layout, list[str]]:
    """Layout with its number of joints, and names of the columns to read: time, q, qd, tau and, if they are known, qdd.

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
    columns = {signal: layout.names(signal, n) for signal in SIGNALS}
    if "qdd" not in layout.columns and not any(re.fullmatch(r"qdd\d+", head) for head in heads):
        del columns["qdd"]
    readers = Counter(name for names in columns.values() for name in names)
    if twice := [name for name, count in readers.items() if count > 1]:
        raise LogError(
            f"{where}: {', '.join(map(repr, twice))} would be read for several signals or joints; see columns"
        )
    needed = ", ".join(_range(columns[signal]) for signal in SIGNALS[:4])
    for name in (name for names in columns.values() for name in names):
        if counts[name] != 1:
            found = f"there are several columns {name!r}" if name in counts else f"there is no column {name!r}"
            raise LogError(f"{where}: {found}; needed are columns {needed}; {_cure(name, heads)}")
    if joints != n:
        raise LogError(f"{where}: {joints} joints, expected {n}")
    for signal, names in columns.items():
        if signal != "time" and len(names) != n:
            raise LogError(f"{where}: {len(names)} columns of {signal}, expected {n}, one for each joint")
    return replace(layout, joints=n) if not layout.joints else layout, [x for names in columns.values() for x in names]


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


def listed(names: Sequence[str]) -> str:
    """Names for a message, and how many it leaves out."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def is_number(cell: str) -> bool:
    """Whether a cell is a number as files write it: Python's float also takes 1_000 and digits of other scripts."""
    try:
        return cell.isascii() and "_" not in cell and isinstance(float(cell), float)
    except ValueError:
        return False
