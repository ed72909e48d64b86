"""Error for a subpackage that lies beside the package in the folder of its sources, and is not found uninstalled."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchdq.errors import MissingLibraryError

PACKAGE = Path(__file__).parent


class _Explained:
    """Finder of modules that Python asks last; it finds nothing, and says why a subpackage is missing."""

    def __init__(self, name: str):
        self.name = name

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: Any = None) -> None:
        """None; raises for the subpackage, which no other finder has found."""
        if name == self.name:
            raise MissingLibraryError(
                f"{name} is not found: torchdq was imported from the folder of its sources, {PACKAGE.parent}, which is "
                f"not installed; run pip install -e {PACKAGE.parent}, or start Python in another folder to use the "
                "installed package",
                name=name,
            )


def explain_missing(subpackage: str) -> None:
    """Make a missing subpackage an error that says what to do; an installed package has it and needs no such thing."""
    if not (PACKAGE / subpackage).is_dir():
        sys.meta_path.append(_Explained(f"torchdq.{subpackage}"))
