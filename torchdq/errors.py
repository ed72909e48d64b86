"""The errors this package raises, each also an instance of the built-in error a caller would expect."""

from collections.abc import Iterable
from difflib import get_close_matches


class TorchdqError(Exception):
    """Anything this package objects to."""


class ArgumentError(TorchdqError, ValueError):
    """An argument has the wrong shape, device or value."""


class DtypeError(TorchdqError, TypeError):
    """An argument has a dtype the dynamics are not computed in."""


class DescriptionError(TorchdqError, ValueError):
    """A robot description cannot be used as it is written."""


class MissingFileError(DescriptionError, FileNotFoundError):
    """A robot description is to be read from a file that does not exist."""


class UnphysicalError(DescriptionError):
    """A robot description holds a body that cannot exist."""


class SingularInertiaError(UnphysicalError):
    """Accelerations are asked of a robot with a joint that moves no inertia in any position."""


class MissingLibraryError(TorchdqError, ImportError):
    """A package that only some functions need is not installed."""


class UnknownNameError(TorchdqError, KeyError):
    """A joint, link, frame or robot of that name does not exist."""

    def __init__(self, kind: str, name: str, known: Iterable[str]):
        known = list(known)
        close = get_close_matches(str(name), known, n=3, cutoff=0.4)
        hint = f"did you mean {', '.join(map(repr, close))}?" if close else f"known: {', '.join(known) or 'none'}"
        self.message = f"there is no {kind} named {name!r}; {hint}"
        super().__init__(self.message)

    def __str__(self) -> str:  # KeyError would print the quoted repr
        return self.message
