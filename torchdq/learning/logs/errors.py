"""Errors and warnings about logs; their `findings` say what is wrong and what to do about it."""

from torchdq.errors import TorchdqError
from torchdq.findings import Finding, merged


class _AboutLog(Exception):
    """Findings in a log, and where in it they are; or a message alone."""

    def __init__(self, *found: Finding | str, where: object = ""):
        super().__init__(*found)
        self.where = str(where)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings that it is about."""
        return tuple(x for x in self.args if isinstance(x, Finding))

    def text(self, command_line: bool = False) -> str:
        """Text of the findings, with cures in Python's words or in options of the command line."""
        words = merged(self.findings, command_line) or "; ".join(map(str, self.args))
        link = ", " if words.startswith(("column", "array")) else ": "
        return f"{self.where}{link}{words}" if self.where else words

    __str__ = text


class LogError(_AboutLog, TorchdqError, ValueError):
    """Unusable log: `findings` hold the fault, with a column or array as subject, and `where` names file and row."""

    __module__ = "torchdq.learning"


class MissingLogError(LogError, FileNotFoundError):
    """Log in a file that does not exist."""

    __module__ = "torchdq.learning"


class LogWarning(_AboutLog, UserWarning):
    """Measurements that are probably wrong, or that a model cannot explain: `findings`, with joints as subjects.

    Silenced by `warnings.simplefilter("ignore", torchdq.learning.LogWarning)`.

    >>> from torchdq.findings import Finding
    >>> claim = "the sign of tau should be that of the description"
    >>> print(LogWarning(Finding("torque.sign", "elbow", claim)))
    elbow: the sign of tau should be that of the description
    """

    __module__ = "torchdq.learning"
