"""Messages of the package in the words of the command line: options in place of arguments of functions.

Messages about logs name what mends them as Python has it, `Layout(columns={'qd': None})` or `offset=True`; here that is
`--columns qd none` and `--offset`.
"""

from __future__ import annotations

import re
from collections.abc import Callable

PAIR = re.compile(r"'(\w+)': (?:'([^']*)'|(None)|\.\.\.)")
MAPPING = r"\{(?:'\w+': (?:'[^']*'|None|\.\.\.)(?:, )?)+\}"


def _columns(found: re.Match[str]) -> str:
    """Option for a mapping of columns."""
    pairs = [f"{signal} {name or ('none' if none else 'NAME')}" for signal, name, none in PAIR.findall(found[0])]
    return f"--columns {' '.join(pairs)}"


def _rows(found: re.Match[str]) -> str:
    """Option for a part of a log."""
    return f"--rows {found[1].upper()} {found[2].upper()}"


# whole phrases first, then arguments alone
PHRASES: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (
        r"without torques, Layout\(.*?\(columns=\{'command': \.\.\.\}\)",
        "torques are needed to identify a robot; without them fit_rollout, in Python, fits a simulation to positions",
    ),
    (r": smooth makes velocities of the positions, and identify and fit work as with recorded ones", ""),
    (r" and gain=None, and identify\(robot, motions, gains=True\)", ", and --seek-gains"),
    (r"gain=None and identify\(\.\.\., gains=True\)", "--seek-gains"),
    (r"identify\((?:robot, motions|\.\.\.), gains=True\)", "--seek-gains"),
    (r", an NPZ archive, or arrays: read\(\{.*?\}\)", " or an NPZ archive"),
    (r"a Layout\(header=False, joints=\.\.\.\)", "--blocks, e.g. --blocks q qd tau"),
    (r"Layout\(columns=\.\.\.\), e\.g\. ", "--columns, e.g. "),
    (
        r"or Layout\(joints=\d+\), which leaves the others out",
        "or the names of those that are meant, --columns tau tau1,tau2",
    ),
    (r"a Layout that allows it, by (\w+)", r"--\1"),
    (r"read (rows=\(\d+, \d+\)) and (rows=\(\d+, \d+\)), and give identify both motions; or", r"by \1 or \2; or"),
    (r"smooth\(log, delay=([^)]*)\)", r"--delay \1"),
    (r"smooth\(log\) its width; unless tau was filtered, no direction", "the --width of it"),
    (
        r"columns needs a header to find the names in; found header=False",
        "--columns needs a header, which --blocks says is not there; leave one of them out",
    ),
    (r"^gain must be .*, none of them zero,", "--gains must be numbers other than zero, one for each joint,"),
    (rf"Layout\(columns=({MAPPING})\)|columns=({MAPPING})|{MAPPING}", _columns),
    (r"rows=\((\w+), (\w+)\)", _rows),
    (r"columns\['(\w+)'\]", r"--columns \1"),
    (r"Layout\(gain=\.\.\.\)", "--gains"),
    (r"\bgains=True", "--seek-gains"),
    (r"\boffset=True", "--offset"),
    (r"\bdelay must", "--delay must"),
    (r"\bcutoff_(?:qd|tau) must", "--cutoff must"),
    (r"; see `excited`", ""),
)


def with_options(message: str) -> str:
    """Message with the options of `torchdq id` in place of arguments of functions.

    >>> with_options("Layout(columns={'qd': None}) reads positions and torques; offset=True seeks it")
    '--columns qd none reads positions and torques; --offset seeks it'
    """
    for pattern, option in PHRASES:
        message = re.sub(pattern, option, message)
    return message
