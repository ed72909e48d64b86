"""Errors for attributes that a module or an object of the package lacks: they say which names may be meant."""

import sys
from collections.abc import Callable, Iterable, Mapping
from typing import NoReturn

from torchdq.errors import nearest

FEW = 12  # most names that an error lists where none is near


def no_attribute(module: str, name: str, known: Iterable[str], elsewhere: Mapping[str, str]) -> AttributeError:
    """Error for a name that a module lacks.

    Args:
        module, name: the two names.
        known: public names of the module.
        elsewhere: what is called here by names that other libraries, or other modules, have.

    >>> print(no_attribute("torchdq.effects", "Stribek", ["Stribeck", "Viscous"], {}))
    module 'torchdq.effects' has no attribute 'Stribek'; did you mean Stribeck?
    """
    return _error(f"module {module!r}", name, known, elsewhere, f"help({module})")


def no_member(x: object, name: str, elsewhere: Mapping[str, str]) -> AttributeError:
    """Error for a name that an object lacks.

    Args:
        x: the object.
        name: the name.
        elsewhere: what is called here by names that other libraries have.

    >>> print(no_member(1, "reel", {}))
    'int' object has no attribute 'reel'; did you mean real?
    """
    kind = type(x)
    known = [*dir(kind), *vars(x)] if hasattr(x, "__dict__") else dir(kind)
    return _error(f"{kind.__name__!r} object", name, known, elsewhere, f"help({kind.__module__}.{kind.__qualname__})")


def _error(what: str, name: str, known: Iterable[str], elsewhere: Mapping[str, str], lists: str) -> AttributeError:
    """Error for a name that something, in words, lacks; `lists` is a call that lists its names."""
    known = [one for one in known if not one.startswith("_")]
    if name in elsewhere:
        hint = f"; its name here is {elsewhere[name]}"
    elif name.startswith("_"):
        hint = ""
    elif close := nearest(name, known):
        hint = f"; did you mean {' or '.join(close)}?"
    else:
        hint = f"; known: {', '.join(known)}" if len(known) <= FEW else f"; {lists} lists what there is"
    # with its name but not its object, so that Python adds no hint of its own
    return AttributeError(f"{what} has no attribute {name!r}{hint}", name=name)


def refusing(module: str, **elsewhere: str) -> Callable[[str], NoReturn]:
    """Function `__getattr__` of a module, which raises `no_attribute` for its public names."""

    def __getattr__(name: str) -> NoReturn:
        own = vars(sys.modules[module])
        defined = (x for x, value in own.items() if x[0] != "_" and getattr(value, "__module__", None) == module)
        raise no_attribute(module, name, own.get("__all__") or sorted(defined), elsewhere)

    return __getattr__
