"""Packages that only some functions need, imported when those are called."""

import importlib
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
