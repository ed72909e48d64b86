"""Checks of arguments that every public function shares: the error names the argument, and what was found."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence, Set, Sized
from fnmatch import fnmatchcase
from numbers import Real
from typing import Any, NamedTuple, NoReturn, TypeVar

import torch
from torch import Tensor

from torchdq.errors import ArgumentError, DtypeError, FrozenError, UnknownNameError

DTYPES = (torch.float32, torch.float64)  # supported for inputs, parameters and programs
LARGEST = sys.float_info.max  # whole numbers may be larger
NUMBERS = (float, int, Real)  # an abstract class alone takes ten times as long

Class = TypeVar("Class", bound=type)


def frozen(cls: Class) -> Class:
    """Class of a frozen dataclass with a method `replace`, which errors of assignments name."""

    def refuse(self: Any, name: str, value: Any = None) -> NoReturn:
        kind = cls.__name__
        raise FrozenError(
            f"a {kind} does not change; use {kind.lower()}.replace({name}=...), which returns another one"
        )

    cls.__setattr__ = cls.__delattr__ = refuse  # type: ignore[assignment]
    return cls


class Named(dict[str, Any]):
    """Dictionary whose error for an unknown name says which names there are.

    >>> "x" in Named("row", {"x": 1}), Named("row", {"x": 1}).get("y")
    (True, None)
    """

    def __init__(self, kind: str, entries: Mapping[str, Any]):
        super().__init__(entries)
        self.kind = kind

    def __missing__(self, name: str) -> NoReturn:
        raise UnknownNameError(self.kind, name, self, every=True)


class TensorValue:
    """Base of values around one tensor, such as poses, which public functions take in its place."""

    parameters: Tensor


def tensor_in(x: Any) -> Any:
    """Tensor of such a value; anything else as it is."""
    return x.parameters if isinstance(x, TensorValue) else x


def is_dense(x: Tensor) -> bool:
    """True unless a tensor is sparse, nested, or laid out for a library."""
    return x.layout == torch.strided and not x.is_nested


def require_tensor(name: str, x: Any) -> None:
    """Raise unless x is a dense tensor."""
    if not isinstance(x, Tensor):
        raise ArgumentError(f"{name} must be a tensor, found {type(x).__name__}; use torch.as_tensor")
    if not is_dense(x):
        found = "nested" if x.is_nested else str(x.layout).removeprefix("torch.").strip("_")
        cure = "torch.nested.to_padded_tensor" if x.is_nested else "to_dense()"
        raise ArgumentError(f"{name} must be a dense tensor, found a {found} one; use {cure}")


def require_finite(**arguments: Tensor | None) -> None:
    """Raise `ArgumentError`, naming the argument and its first bad entry, unless all `arguments` are finite.

    The dynamics functions do not check values: a row with NaN gives a row with NaN. Call this function where such a row
    must be an error.

    >>> import torch
    >>> require_finite(q=torch.zeros(3), qd=None)
    """
    for name, x in arguments.items():
        if x is None:
            continue
        require_tensor(name, x)
        bad = (~x.isfinite()).nonzero()
        if len(bad):
            at = tuple(bad[0].tolist())
            raise ArgumentError(f"{name} must be finite, found {x[at].item()} at {at}{and_more(bad)}")


def and_more(found: Sized) -> str:
    """Text for how many there are after the first one; "" for none."""
    return f", and {len(found) - 1} more" if len(found) > 1 else ""


def floating(name: str, x: Any) -> Tensor:
    """Tensor x; raises unless it is one of floating-point numbers."""
    require_tensor(name, x)
    if not x.dtype.is_floating_point:
        raise DtypeError(f"{name} must be a floating tensor, found {x.dtype}; convert it, e.g. {name}.double()")
    return x


def require_object(name: str, x: Any, kind: type, module: str, example: str) -> None:
    """Raise unless x is an object of a class, which those of a module are, such as the example."""
    if not isinstance(x, kind):
        cure = "; it is a class; call it to make an object" if isinstance(x, type) else f", such as {example}"
        found = x.__name__ if isinstance(x, type) else repr(x)
        raise ArgumentError(f"{name} must be an object of {module}, found {found}{cure}")


def is_number(x: Any) -> bool:
    """True for a real number of Python or numpy; a truth value is none, nor is a whole number beyond any float."""
    return isinstance(x, NUMBERS) and not isinstance(x, bool) and not (isinstance(x, int) and abs(x) > LARGEST)


# --- checks as values ------------------------------------------------------------------------------------------------


class Interval(NamedTuple):
    """Check of a number: a finite one, or an integer, within bounds."""

    least: float = -math.inf
    open: bool = False  # whether it must be greater than `least`
    below: float = math.inf
    infinite: bool = False  # whether it may be infinite, too
    whole: bool = False  # whether it must be an integer
    cure: str = ""

    @property
    def signed(self) -> bool:
        """True if it may be negative."""
        return self.least < 0

    @property
    def expected(self) -> str:
        """Text after "must be"."""
        if self.whole and self.below < math.inf:
            return f"an integer from {self.least:g} to {self.below - 1:g}"
        bounds = [f"of at least {self.least:g}"] * (not self.open and self.least > -math.inf)
        bounds += [f"below {self.below:g}"] * (self.below < math.inf)
        kind = "an integer" if self.whole else "a positive number" if self.open else "a finite number"
        return f"{kind.replace('finite ', '') if self.infinite else kind} {' and '.join(bounds)}".rstrip()

    def holds(self, x: Any) -> bool:
        """Whether x is a number in the interval."""
        if not is_number(x) or (self.whole and not isinstance(x, int)):
            return False
        inside = self.least < x < self.below or (x == self.least and not self.open)
        return math.isfinite(x) and inside if not (math.isinf(x) and self.infinite) else x > 0 or self.signed

    def wrong(self) -> tuple[Any, ...]:
        """Numbers beyond the bounds, and what is no such number."""
        beyond = (self.least - 1.0,) * (self.least > -math.inf) + (self.least,) * self.open
        beyond += (self.below,) * (self.below < math.inf) + (math.inf,) * (not self.infinite)
        return (*beyond, math.nan, "1", True, 1j, 10**400, *[self.least + 0.5] * self.whole)


class OneOf(NamedTuple):
    """Check of a value among some."""

    known: tuple[Any, ...]
    cure: str = ""

    @property
    def expected(self) -> str:
        """Text after "must be"."""
        return f"one of {', '.join(map(repr, self.known))}"

    def holds(self, x: Any) -> bool:
        """Whether x is one of them, of the same type."""
        return any(x is value or (isinstance(x, type(value)) and x == value) for value in self.known)

    def wrong(self) -> tuple[Any, ...]:
        """Other names, and what is none."""
        return ("another", 3, ("x",))


Check = Interval | OneOf  # what a value may be: `require` raises by it, and tests generate what it refuses
REAL, NOT_NEGATIVE, POSITIVE = Interval(), Interval(0.0), Interval(0.0, open=True)


def require(name: str, x: Any, check: Check) -> None:
    """Raise unless x is what a check expects."""
    if not check.holds(x):
        raise ArgumentError(f"{name} must be {check.expected}, found {x!r}" + f"; {check.cure}" * bool(check.cure))


def require_all(name: str, x: Tensor, check: Check) -> None:
    """Raise unless all numbers of a tensor are what a check expects."""
    for one in torch.stack(x.detach().aminmax()).tolist() if x.numel() else ():
        require(name, one, check)


def require_choice(name: str, x: Any, known: Sequence[Any]) -> None:
    """Raise unless x is among the known values."""
    require(name, x, OneOf(tuple(known)))


def require_count(name: str, x: Any, least: int = 1) -> None:
    """Raise unless x is an integer of at least `least`."""
    require(name, x, Interval(least, whole=True))


def require_number(name: str, x: Any, positive: bool = False, least: float = -math.inf) -> None:
    """Raise unless x is a finite number of at least `least`, and greater than zero if `positive`."""
    require(name, x, POSITIVE if positive else Interval(least))


def names_of(name: str, x: Any, known: Iterable[str], kind: str) -> tuple[str, ...]:
    """Names in a string or a sequence of strings; raises unless all of them are known."""
    known = tuple(known)
    found = _words(name, x, known, "a name or a sequence of names")
    for one in found:
        if one not in known:
            raise UnknownNameError(kind, one, known)
    return found


def matching(name: str, x: Any, known: Iterable[str], kind: str) -> tuple[str, ...]:
    """Known names, in their order, that a name, a pattern such as "finger*", or a sequence of these matches.

    Raises unless each matches one.
    """
    known, found = tuple(known), set()
    for one in _words(name, x, known, "a name, a pattern such as 'finger*', or a sequence of them"):
        matched = [one] if one in known else [other for other in known if fnmatchcase(other, one)]
        if not matched:
            raise UnknownNameError(kind, one, known)
        found.update(matched)
    return tuple(other for other in known if other in found)


def _words(name: str, x: Any, known: tuple[str, ...], expected: str) -> tuple[str, ...]:
    words = (x,) if isinstance(x, str) else x
    if not isinstance(words, Sequence | Set) or not all(isinstance(one, str) for one in words):
        raise ArgumentError(f"{name} must be {expected}, found {x!r}; known: {', '.join(known)}")
    return tuple(words)


def tensor_of(x: Any) -> Tensor:
    """Tensor of a number or of numbers; one that is a tensor, as it is."""
    return x if isinstance(x, Tensor) else torch.as_tensor(x, dtype=torch.float64, device="cpu")


def device_of(name: str, x: Any) -> torch.device:
    """Device, by itself or by its name; raises unless torch can hold a tensor there."""
    try:
        device = torch.device(x)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:  # the second by a torch without CUDA
        present = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
        reason = str(error).partition("\n")[0]
        raise ArgumentError(
            f"{name} must be a device that torch has on this machine, which are {', '.join(present)}, found {x!r} "
            f"({reason}); choose one of them, or install a torch that was built for the device"
        ) from error
    return device


def dtype_of(name: str, x: Any) -> torch.dtype:
    """Dtype of the package, by itself or by its name in torch or numpy."""
    found = getattr(torch, x, x) if isinstance(x, str) else getattr(torch, getattr(x, "__name__", ""), x)
    if found not in DTYPES:
        raise DtypeError(f"{name} must be torch.float32 or torch.float64, found {x!r}")
    return found


def destination(what: Any, device: Any) -> dict[str, Any]:
    """Dtype and device to convert tensors to, by name; `what` is a dtype, or a device where there is no other."""
    named = isinstance(what, str) and isinstance(getattr(torch, what, None), torch.dtype)
    if what is None or named or not isinstance(what, str | torch.device):
        dtype = None if what is None else dtype_of("dtype", what)
        return {"dtype": dtype, "device": None if device is None else device_of("device", device)}
    if device is not None:
        raise ArgumentError(f"one device must be given, found {what!r} and {device!r}")
    return {"dtype": None, "device": device_of("device", what)}
