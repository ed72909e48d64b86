"""Layouts of logs: names of the columns, units, the side of the gears that was measured, and filters."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np

from torchdq.base.checks import names_of, require_count
from torchdq.errors import ArgumentError
from torchdq.findings import Finding

SIGNALS = ("time", "q", "qd", "tau", "qdd", "command")
NEEDED = SIGNALS[:4]  # unless a layout says that they were not recorded
BLOCKS = NEEDED[1:]  # what the first three of a layout's blocks hold
SPARE = SIGNALS[2:]  # signals that a layout may say were not recorded
SHOWN = 8  # most names of columns that a message holds
NUMBER = re.compile(r"\{(\d+)\}")  # place of a joint's number in a pattern, and the number of the first joint


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
            empty: the effort is the torque; None: unknown, `tau` of the log is the effort in its own unit; so is that
            of a joint whose number is None.
        cutoff_qd, cutoff_tau: frequencies of the low-pass filters of velocities and torques [Hz], for `smooth`; None:
            8 Hz, or a quarter of the rate of the rows where that is less.
        farthest: position beyond which a column is refused as one in degrees or millimetres [rad or m].
        fastest: speed beyond which it is refused [rad/s or m/s].
        columns: names that `blocks` does not fit, of "time", "q", "qd", "tau" (the effort), "qdd" [rad/s^2 or m/s^2]
            and "command" (what the drives were asked for, kept as it is): a pattern, in which {0} is the number of the
            joint if the first joint has 0, {1} if it has 1, {7} if it has 7; or, where columns carry the names of
            joints, a list of names in the robot's order of joints. None: "qd" or "tau" was not recorded. In NPZ
            archives these are names of arrays.
        transmission: change of the joints' positions per change of the motors', where motors were measured: a number
            per joint, 1/100 for a gear of 100:1, negative where it reverses; or, for coupled wrists, the rows of a
            matrix S, joints = S motors. Torques at the joints are then S^-T times those at the motors, which `gain`
            belongs to. Empty: joints were measured.
        zero: positions of the joints where the motors' are zero, a number per joint [rad or m]; empty: zero.
        at_motors: signals that `transmission` takes to the joints.

    >>> ros = Layout(columns={"time": "stamp", "q": "position_{0}", "qd": "velocity_{0}", "tau": ["base", "elbow"]})
    >>> ros.names("q", 2), ros.names("tau", 2)
    (['position_0', 'position_1'], ['base', 'elbow'])

    Positions of motors behind gears and their currents, whose gains are not known, without velocities:

    >>> drives = Layout(columns={"qd": None, "tau": "current{1}"}, gain=None, transmission=(1 / 100, -1 / 80))
    """

    joints: int = 0
    blocks: tuple[str, ...] = ("q", "qd", "tau")
    header: bool = True
    gain: tuple[float | None, ...] | None = ()
    cutoff_qd: float | None = None  # [Hz]
    cutoff_tau: float | None = None  # [Hz]
    farthest: float = 8 * math.pi  # [rad]
    fastest: float = 50.0  # [rad/s]
    columns: Mapping[str, str | Sequence[str] | None] = field(default_factory=dict, hash=False)
    transmission: tuple[float, ...] | tuple[tuple[float, ...], ...] = ()
    zero: tuple[float, ...] = ()
    at_motors: tuple[str, ...] = ("q", "qd", "qdd", "tau")

    def __post_init__(self) -> None:
        self._require_numbers()
        self._require_transmission()
        if isinstance(self.blocks, str) or len({*self.blocks}) < max(3, len(self.blocks)):
            expected = "three or more different names, the first of positions, velocities and torques"
            cure = "where velocities were not recorded, keep the name and give columns={'qd': None}"
            raise ArgumentError(f"blocks must be {expected}, found {self.blocks!r}; {cure}")
        object.__setattr__(self, "blocks", tuple(self.blocks))
        if not isinstance(self.columns, Mapping):
            expected = "a mapping such as {'q': 'position_{0}'}"
            raise ArgumentError(f"columns must be {expected}, found {self.columns!r}")
        if any(given is not None for given in self.columns.values()) and not self.header:
            claim = "columns needs a header to find the names in; found header=False"
            option = "--blocks says that there is no header; give --columns or --blocks, not both"
            raise ArgumentError(Finding("layout.header", "", claim, "", "", option))
        if not self.header and not self.joints:
            raise ArgumentError("joints must be given for a file without a header; found joints=0, header=False")
        names_of("columns", tuple(self.columns), SIGNALS, "signal")
        for signal, given in self.columns.items():
            if given is None and signal in SPARE:
                continue
            kinds = str if signal == "time" else str | Sequence
            if not given or not isinstance(given, kinds) or not all(isinstance(one, str) for one in given):
                expected = (
                    "a name" if signal == "time" else "a name, a pattern such as 'position_{0}' or a list of names"
                )
                option = f"give other names by --columns {signal} NAMES"
                claim = f"columns[{signal!r}] must be {expected}, found {given!r}"
                raise ArgumentError(Finding("layout.columns", "", claim, "", "", option))

    def _require_numbers(self) -> None:
        """Raise unless what must be numbers is; `gain` becomes a tuple of floats."""
        require_count("joints", self.joints, 0)
        for name in ("cutoff_qd", "cutoff_tau", "farthest", "fastest"):
            x = getattr(self, name)
            if x is None and name.startswith("cutoff"):
                continue
            if not isinstance(x, Real) or isinstance(x, bool) or not float(x) > 0:
                raise ArgumentError(f"{name} must be a positive number, found {x!r}")
        object.__setattr__(self, "gain", _gains(self.gain))
        object.__setattr__(self, "zero", _floats("zero", self.zero, "numbers, one per joint, or ()"))

    def _require_transmission(self) -> None:
        """Raise unless motors and joints have a transmission with an inverse; `transmission` becomes a tuple."""
        object.__setattr__(self, "at_motors", names_of("at_motors", self.at_motors, SIGNALS[1:5], "signal"))
        expected = "numbers, one per joint, such as (0.01, -0.0125), or the rows of a square matrix"
        rows = list(self.transmission) if isinstance(self.transmission, Iterable) else [None]
        if any(isinstance(row, Iterable) and not isinstance(row, str) for row in rows):
            matrix = tuple(_floats("transmission", row, expected) for row in rows)
            if any(len(row) != len(matrix) for row in matrix) or np.linalg.matrix_rank(matrix) < len(matrix):
                raise ArgumentError(f"transmission must be {expected}, which has an inverse, found {matrix}")
            coupled = sum(x != 0 for row in matrix for x in row) > len(matrix)
            object.__setattr__(self, "transmission", matrix)
        else:
            found, coupled = _floats("transmission", self.transmission, expected), False
            if not all(found):
                raise ArgumentError(f"transmission must be {expected}, none of them zero, found {found}")
            object.__setattr__(self, "transmission", found)
        if coupled and not np.all(self.known_gains) and "tau" in self.at_motors:
            cure = "give gains of data sheets; Model(gains=True) of identify then finds a factor for each joint"
            raise ArgumentError(f"gain must be known where a transmission couples joints, found {self.gain}; {cure}")
        if self.zero and not self.transmission:
            raise ArgumentError(f"zero needs a transmission, e.g. ones, found zero={self.zero} and transmission=()")

    @property
    def known_gains(self) -> bool | tuple[bool, ...]:
        """Whether efforts are torques, of all joints or of each."""
        return self.gain is not None and (None not in self.gain or tuple(x is not None for x in self.gain))

    def names(self, signal: str, joints: int) -> list[str]:
        """Names of a signal's columns; none of one that was not recorded."""
        given = self._given(signal)
        if given is None:
            return []
        if not isinstance(given, str):
            return list(given)
        if not NUMBER.search(given):
            return [given]
        parts = NUMBER.split(given)  # the odd ones are the numbers of the first joint
        return ["".join(str(int(x) + i) if k % 2 else x for k, x in enumerate(parts)) for i in range(joints)]

    def count(self, heads: Sequence[str]) -> int:
        """Number of joints whose positions a header names."""
        given = self._given("q") or ()
        if not isinstance(given, str):
            return len(given)
        pattern = re.compile(r"\d+".join(map(re.escape, NUMBER.split(given)[::2])))
        return sum(pattern.fullmatch(head) is not None for head in heads)

    def has(self, signal: str) -> bool:
        """Whether a signal was recorded, as far as the layout says."""
        return self.columns.get(signal, signal) is not None

    @property
    def order(self) -> list[str]:
        """Columns of a file without a header: the time and all columns of the blocks."""
        absent = [block for signal, block in zip(BLOCKS, self.blocks, strict=False) if not self.has(signal)]
        blocks = [block for block in self.blocks if block not in absent]
        return ["time", *(f"{block}{joint}" for block in blocks for joint in range(1, self.joints + 1))]

    def _given(self, signal: str) -> str | Sequence[str] | None:
        block = dict(zip(BLOCKS, self.blocks, strict=False)).get(signal, signal)
        return self.columns.get(signal, "time" if signal == "time" else f"{block}{{1}}")


def _gains(given: Any) -> tuple[float | None, ...] | None:
    """Gains as a tuple, with None for each that is unknown; None: all are unknown."""
    if given is None:
        return None
    expected = "numbers, one per joint, such as (2.0, 1.5), () for torques, or None where they are unknown"
    if not isinstance(given, Iterable) or isinstance(given, str):
        return _floats("gain", given, expected)
    gains = list(given)
    known = iter(_floats("gain", [x for x in gains if x is not None], expected))
    found = tuple(None if x is None else next(known) for x in gains)
    if 0.0 in found:
        raise ArgumentError(f"gain must be {expected}, none of them zero, found {found}")
    return None if found and all(x is None for x in found) else found


def _floats(name: str, x: Any, expected: str) -> tuple[float, ...]:
    """Finite numbers as a tuple of floats."""
    try:
        found = tuple(map(float, [x] if isinstance(x, str) else x))
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name} must be {expected}, found {x!r}") from error
    if not all(map(math.isfinite, found)):
        raise ArgumentError(f"{name} must be finite numbers, found {x!r}")
    return found


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
