"""Layouts of logs: names of the columns, units, the side of the gears that was measured, and filters."""

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchdq.base.checks import names_of, require_count, require_number
from torchdq.errors import ArgumentError
from torchdq.findings import Finding

SIGNALS = ("time", "q", "qd", "tau", "qdd", "command")
NEEDED = SIGNALS[:4]  # unless a layout says that they were not recorded
SPARE = SIGNALS[2:]  # signals that a layout may say were not recorded
SCALED = tuple(x for x in SIGNALS if x != "tau")  # signals with a scale: the scale of the efforts is the gain
SHOWN = 8  # most names of columns that a message holds
NUMBER = re.compile(r"\{(\d+)\}")  # place of a joint's number in a pattern, and the number of the first joint
JOINT = "{joint}"  # place of a joint's name in a pattern


@dataclass(frozen=True)
class Layout:
    """Columns and units of a log, and the filters its signals need.

    Args:
        joints: number of joints; 0: as many as positions are found.
        gain: torque per unit of effort, one number per joint [N m or N per unit], e.g. of motor currents [N m/A];
            empty: the effort is the torque; None: unknown, `tau` of the log is the effort in its own unit; so is that
            of a joint whose number is None.
        cutoff_qd, cutoff_tau: frequencies of the low-pass filters of velocities and torques [Hz], for `smooth`; None:
            8 Hz, or a quarter of the rate of the rows where that is less.
        farthest: position beyond which a column is taken to be in degrees or millimetres, and refused [rad or m].
        fastest: speed beyond which it is refused [rad/s or m/s].
        columns: names of "time", "q", "qd", "tau" (the effort), "qdd" [rad/s^2 or m/s^2] and "command" (what the drives
            were asked for, kept as it is), where they are not time, q1, q2 ..., qd1 ..., tau1 ...: a pattern, in which
            {0} is the number of the joint if the first joint has 0, {1} if it has 1, {7} if it has 7, and {joint} the
            name of the robot's joint; a list of names in the robot's order of joints; or the name of an array with a
            column per joint. None: "qd" or "tau" was not recorded. Columns without a header are called 1, 2, 3 ...;
            those of one of several files also file:name, with the name of the file without its ending. Where there is a
            q0, the joints are counted from zero.
        rate: rows per second of a log without times [Hz]; None: it has times.
        transmission: change of the joints' positions per change of the motors', where motors were measured: a number
            per joint, 1/100 for a gear of 100:1, negative where it reverses; or the rows of a matrix S, joints = S
            motors, where a motor turns several joints, as in wrists. Motors are read at the scale of their joints:
            positions times the numbers, or the diagonal of S, and torques, which `gain` belongs to, divided by them.
            Where they are coupled, the log is in the coordinates of `robot.couple(coupling, names)`. Empty: joints.
        zero: positions of the joints where those in the log are zero, which are added to them, a number per joint [rad
            or m]; empty: zero.
        at_motors: signals that were measured at the motors, if there is a transmission; the others were at the joints.
        scale: factors that take signals to SI units, where they are in others, by "time", "q", "qd", "qdd" and
            "command": a number, or one per joint. pi/180 reads degrees, pi/30 turns per minute, 0.001 milliseconds or
            millimetres; that of "tau" is its `gain`.

    >>> names = {"time": "stamp", "q": "position_{0}", "qd": "velocity_{0}"}
    >>> ros = Layout(columns={**names, "tau": ["base", "elbow"]})
    >>> ros.names("q", 2), ros.names("tau", 2)
    (['position_0', 'position_1'], ['base', 'elbow'])

    A file of two joints without a header, whose rows hold positions and torques at 500 Hz:

    >>> bare = Layout(columns={"q": "{1}", "qd": None, "tau": "{3}"}, rate=500.0)

    Motors behind gears, their positions in degrees, with currents of unknown gains, and a second joint whose zero is a
    quarter turn away:

    >>> gears = {"transmission": (1 / 100, -1 / 80), "zero": (0.0, -math.pi / 2)}
    >>> names = {"qd": None, "tau": "current{1}"}
    >>> drives = Layout(columns=names, gain=None, scale={"q": math.pi / 180}, **gears)
    """

    joints: int = 0
    gain: tuple[float | None, ...] | None = ()
    cutoff_qd: float | None = None  # [Hz]
    cutoff_tau: float | None = None  # [Hz]
    farthest: float = 8 * math.pi  # [rad]
    fastest: float = 50.0  # [rad/s]
    columns: Mapping[str, str | Sequence[str] | None] = field(default_factory=dict, hash=False)
    transmission: tuple[float, ...] | tuple[tuple[float, ...], ...] = ()
    zero: tuple[float, ...] = ()
    at_motors: tuple[str, ...] = ("q", "qd", "qdd", "tau")
    rate: float | None = None  # [Hz]
    scale: Mapping[str, float | Sequence[float]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        require_count("joints", self.joints, 0)
        for name in ("cutoff_qd", "cutoff_tau", "rate", "farthest", "fastest"):
            x = getattr(self, name)
            if not (x == math.inf or (x is None and name not in ("farthest", "fastest"))):
                require_number(name, x, positive=True)
        object.__setattr__(self, "gain", _gains(self.gain))
        object.__setattr__(self, "zero", _floats("zero", self.zero, "numbers, one per joint, or ()"))
        object.__setattr__(self, "at_motors", names_of("at_motors", self.at_motors, SIGNALS[1:5], "signal"))
        object.__setattr__(self, "transmission", _transmission(self.transmission))
        if not isinstance(self.scale, Mapping):
            raise ArgumentError(f"scale must be a mapping such as {{'q': 0.0174533}}, found {self.scale!r}")
        scale: dict[str, float | tuple[float, ...]] = {}
        for signal in names_of("scale", tuple(self.scale), SCALED, "signal"):
            x = self.scale[signal]
            factors = _floats("scale", x if np.ndim(x) else [x], "numbers, one or one per joint")
            if not all(factors) or (signal == "time" and not factors[0] > 0):
                raise ArgumentError(f"scale must be numbers other than zero, found {self.scale!r}")
            scale[signal] = factors if np.ndim(x) and signal != "time" else factors[0]
        object.__setattr__(self, "scale", scale)
        if not isinstance(self.columns, Mapping):
            expected = "a mapping such as {'q': 'position_{0}'}"
            raise ArgumentError(f"columns must be {expected}, found {self.columns!r}")
        for signal in names_of("columns", tuple(self.columns), SIGNALS, "signal"):
            given, kinds = self.columns[signal], str if signal == "time" else str | Sequence
            named = isinstance(given, kinds) and given and all(isinstance(name, str) for name in given)
            if not named and (given is not None or signal not in SPARE):
                more = "" if signal == "time" else ", a pattern such as 'position_{0}' or a list of names"
                claim = f"columns[{signal!r}] must be a name{more}, found {given!r}"
                option = f"give other names by --columns {signal} NAMES"
                raise ArgumentError(Finding("layout.columns", "", claim, "", "", option))

    @property
    def ratios(self) -> np.ndarray:
        """Change of each joint's position per change of its own motor's [n]."""
        S = np.array(self.transmission)
        return S if S.ndim == 1 else S.diagonal()

    @property
    def coupling(self) -> tuple[tuple[float, ...], ...] | None:
        """Rows of the matrix C, joints = C motors, motors being at the scale of their joints; None: not coupled.

        >>> Layout(transmission=((1 / 80, 0), (1 / 80, 1 / 50))).coupling
        ((1.0, 0.0), (1.0, 1.0))
        """
        S = np.array(self.transmission)
        if S.ndim == 1 or np.count_nonzero(S) == len(S):
            return None
        return tuple(map(tuple, (S / self.ratios).tolist()))

    @property
    def known_gains(self) -> bool | tuple[bool, ...]:
        """Whether efforts are torques, of all joints or of each."""
        return self.gain is not None and (None not in self.gain or tuple(x is not None for x in self.gain))

    def names(self, signal: str, joints: int) -> list[str]:
        """Column names of a signal; empty if not recorded."""
        given = self.given(signal) or []
        if isinstance(given, list) or not NUMBER.search(given):
            return [given] if isinstance(given, str) else given
        parts = NUMBER.split(given)  # the odd ones are the numbers of the first joint
        return ["".join(str(int(x) + i) if k % 2 else x for k, x in enumerate(parts)) for i in range(joints)]

    def count(self, heads: Collection[str]) -> int:
        """Number of joints whose positions are in a header."""
        given = self.given("q") or []
        if isinstance(given, list) or not NUMBER.search(given):
            return int(given in heads) if isinstance(given, str) else len(given)
        first, *others = self.starts("q")
        after = min((k for k in others if k > first), default=math.inf)
        pattern = re.compile(r"(\d+)".join(map(re.escape, NUMBER.split(given)[::2])))
        return sum((found := pattern.fullmatch(head)) is not None and first <= int(found[1]) < after for head in heads)

    def starts(self, signal: str) -> list[int]:
        """First number in a signal's pattern, and in those of other signals that have the same words."""
        patterns = {x: NUMBER.split(given) for x in SIGNALS if isinstance(given := self.given(x), str)}
        words = patterns.get(signal, [])[::2]
        found = {x: int(parts[1]) for x, parts in patterns.items() if len(parts) > 1 and parts[::2] == words}
        return [found.pop(signal), *found.values()] if signal in found else []

    def has(self, signal: str) -> bool:
        """Whether the layout says that a signal was recorded."""
        return self.columns.get(signal, signal) is not None and not (signal == "time" and self.rate)

    def given(self, signal: str) -> str | list[str] | None:
        """Name, pattern or names of a signal's columns."""
        given = self.columns.get(signal, "time" if signal == "time" else f"{signal}{{1}}")
        return None if given is None else bare(given) if isinstance(given, str) else [bare(name) for name in given]

    def with_columns(self, columns: Mapping[str, str | Sequence[str] | None]) -> "Layout":
        """Layout with these names instead of its own."""
        return replace(self, columns={**self.columns, **columns}) if columns else self

    def of_joints(self, names: Sequence[str]) -> "Layout":
        """Layout in which {joint} is replaced by the names of a robot's joints."""
        patterns = {signal: x for signal, x in self.columns.items() if isinstance(x, str) and JOINT in x}
        if patterns and not names:
            raise ArgumentError(f"robot must be given for the names of its joints in columns={patterns}, found None")
        return self.with_columns({signal: [x.replace(JOINT, name) for name in names] for signal, x in patterns.items()})


def _transmission(given: Any) -> tuple[Any, ...]:
    """Numbers, or the rows of a matrix with an inverse, as tuples."""
    expected = "numbers, one per joint, such as (0.01, -0.0125), or the rows of a square matrix"
    rows = list(given) if isinstance(given, Iterable) else []
    if any(isinstance(row, Iterable) and not isinstance(row, str) for row in rows):
        found: tuple[Any, ...] = tuple(_floats("transmission", row, expected) for row in rows)
        if any(len(row) != len(found) for row in found) or np.linalg.matrix_rank(found) < len(found):
            raise ArgumentError(f"transmission must be {expected}, which has an inverse, found {found}")
    else:
        found = _floats("transmission", given, expected)
    if not np.all(found if np.ndim(found) < 2 else np.diagonal(found)):
        raise ArgumentError(f"transmission must be {expected}, with motor k turning joint k, found zero in {found}")
    return found


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


def bare(name: str) -> str:
    """Column name stripped of quotation marks, blanks and marks of comments and lists."""
    return name.strip(' \t"').lstrip("#%- ").rstrip(" ,")


def listed(names: Sequence[str]) -> str:
    """Names for a message, shortened to the first few."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def is_numeric(cell: str) -> bool:
    """Whether a cell is an ASCII number; Python's float also takes 1_000 and digits of other scripts."""
    try:
        return cell.isascii() and "_" not in cell and isinstance(float(cell), float)
    except ValueError:
        return False
