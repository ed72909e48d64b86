"""Packages that only some functions need, imported when those are called."""

import importlib
from collections.abc import Mapping
from typing import Any

from torchdq.errors import MissingLibraryError


def imported(module: str, package: str, purpose: str, install: str | None = None) -> Any:
    """Module of an optional package.

    Args:
        module: dotted name of the module.
        package: name of the package, for the message.
        purpose: function that needs it, for the message.
        install: argument of `pip install`; None: the package.
    Raises:
        MissingLibraryError: the package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as fault:
        cure = f"pip install {install or package}"
        raise MissingLibraryError(f"{purpose} needs {package}, which is not installed; {cure}") from fault


def require_packages(purpose: str, extras: Mapping[str, str]) -> None:
    """Raise unless packages are installed; the error names all that are not, so that one command brings them.

    Args:
        purpose: command or function that needs them, for the message.
        extras: packages, each with the extra of torchdq that brings it.
    Raises:
        MissingLibraryError: one is not installed.
    """
    missing = []
    for package in extras:
        try:
            importlib.import_module(package)
        except ImportError:
            missing.append(package)
    if missing:
        found = f"{' and '.join(missing)}, which {'is' if len(missing) == 1 else 'are'} not installed"
        wanted = ",".join(sorted({extras[package] for package in missing}))
        raise MissingLibraryError(f"{purpose} needs {found}; pip install 'torchdq[{wanted}]'")
