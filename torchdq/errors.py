"""Errors of this package, each also an instance of the built-in error a caller would expect."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from difflib import SequenceMatcher, get_close_matches

from torchdq.findings import Finding, merged, printable

NEAR = 0.5  # share of letters in common from which a known name may be meant


class TorchdqError(Exception):
    """Base class of all torchdq errors, raised with a message, findings, or both in this order."""

    # no __init__: graphs of torch.compile break before exceptions that have one, and not at the call around them
    @property
    def findings(self) -> tuple[Finding, ...]:
        """Faults that it is raised for, as values."""
        return tuple(x for x in self.args if isinstance(x, Finding))

    def __str__(self) -> str:
        if self.args and isinstance(self.args[0], Finding):
            return merged(self.findings)
        return printable(str(self.args[0]), kept="\n") if self.args else ""


class ArgumentError(TorchdqError, ValueError):
    """Argument of the wrong shape, device or value."""


class DtypeError(TorchdqError, TypeError):
    """Argument of a dtype that the dynamics are not computed in."""


class NumberError(TorchdqError, TypeError):
    """Operation that a program cannot record, on a number whose value differs from sample to sample."""


class FrozenError(TorchdqError, dataclasses.FrozenInstanceError):
    """Assignment to a field of an object that does not change."""


class DescriptionError(TorchdqError, ValueError):
    """Robot description that cannot be used as it is written."""


class MissingFileError(DescriptionError, FileNotFoundError):
    """Robot description in a file that does not exist."""


class UnphysicalError(DescriptionError):
    """Robot description with a body that cannot exist."""


class SingularInertiaError(UnphysicalError):
    """Accelerations of a robot with a joint that moves no inertia in any position, or dynamics of one without mass."""


class MissingLibraryError(TorchdqError, ImportError):
    """Optional package that is not installed."""


class UnknownNameError(TorchdqError, KeyError):
    """Name of no joint, link, frame or robot."""

    def __init__(self, kind: str, name: str, known: Iterable[str], every: bool = False):
        known = list(known)
        close = nearest(str(name), known)
        hint = f"did you mean {', '.join(map(repr, close))}?" if close else f"known: {', '.join(known) or 'none'}"
        if close and every:  # the names are few
            hint += f" known: {', '.join(known)}"
        self.message = f"there is no {kind} named {name!r}; {hint}"
        super().__init__(self.message)

    def __str__(self) -> str:  # KeyError would print the quoted repr
        return printable(self.message)


def nearest(name: str, known: Iterable[str]) -> list[str]:
    """Known names that resemble a name, at most three, the nearest first; case and underscores do not count.

    >>> nearest("dqrnea", ["dq", "DQRNEA", "mass_matrix"]), nearest("MassMatrix", ["mass_matrix"])
    (['DQRNEA'], ['mass_matrix'])
    """
    plain: dict[str, list[str]] = {}
    for one in known:
        plain.setdefault(_plain(one), []).append(one)
    if same := plain.get(_plain(name)):
        return same
    close = [one for found in get_close_matches(_plain(name), plain, 3, NEAR) for one in plain[found]]
    return sorted(close, key=lambda one: -SequenceMatcher(None, name, one).ratio())[:3]


def _plain(name: str) -> str:
    return name.casefold().replace("_", "")


def no_attribute(
    owner: str, name: str, known: Iterable[str], elsewhere: Mapping[str, str], listing: str
) -> AttributeError:
    """Error for an attribute that a module or an object lacks, with the name that may be meant.

    Args:
        owner, name: the module or the object, and the attribute.
        known: attributes of the owner.
        elsewhere: names here by those of other libraries.
        listing: call that lists the attributes.

    >>> print(no_attribute("module 'arm'", "bsae", ["base", "tip"], {"ee": "tip"}, "help(arm)"))
    module 'arm' has no attribute 'bsae'; did you mean base?
    """
    hint = f"; {listing} lists what there is"
    if name in elsewhere:
        hint = f"; its name here is {elsewhere[name]}"
    elif name.startswith("_"):
        hint = ""
    elif close := nearest(name, [one for one in known if not one.startswith("_")]):
        hint = f"; did you mean {' or '.join(close)}?"
    # with its name but not its object, so that Python adds no hint of its own
    return AttributeError(f"{owner} has no attribute {name!r}{hint}", name=name)
