"""Packages that only some functions need, imported when those are called."""

import importlib
from typing import Any

from torchdq.errors import MissingLibraryError


def imported(module: str, package: str, purpose: str) -> Any:
    """A module of an optional package.

    Args:
        module: dotted name of the module.
        package: name to install it by.
        purpose: what needs it, for the message.
    Raises:
        MissingLibraryError: the package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as fault:
        raise MissingLibraryError(
            f"{purpose} needs {package}, which is not installed; pip install {package}"
        ) from fault
