"""Machine that a program runs on: processor, vector instructions, threads, and versions of packages."""

import importlib.metadata
import os
import platform
from pathlib import Path

import torch

from torchdq.base.caches import remembered

CPUS = Path("/proc/cpuinfo")  # only on Linux
NAMES = ("model name", "Model", "Hardware")  # entries that hold the name of the processor, the best one first


def processor() -> str:
    """Name of the processor, or its architecture where the system does not know the name."""
    facts = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in _lines())}
    found = next((facts[name] for name in NAMES if facts.get(name)), "")
    return found or platform.processor() or platform.machine() or "unknown processor"


@remembered(1)
def features() -> str:
    """Features of the processor that compiled code depends on."""
    kinds = {line for line in _lines() if line.startswith(("flags", "Features", "model name", "CPU part"))}
    return "\n".join(
        [platform.machine(), platform.processor(), vector_instructions(), platform.system(), *sorted(kinds)]
    )


def _lines() -> list[str]:
    """Lines of what the system knows of its processors; none where it is not Linux."""
    try:
        return CPUS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def vector_instructions() -> str:
    """Widest vector instructions of the processor, e.g. "AVX2"; "" for none that torch knows."""
    found = torch.backends.cpu.get_cpu_capability()
    return "" if found in ("DEFAULT", "NO AVX") else found


def version_of(package: str) -> str | None:
    """Version of a package; None: it is not installed.

    >>> version_of("torch") is None, version_of("no-such-package") is None
    (False, True)
    """
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def words() -> str:
    """Machine in one line, for results that depend on it."""
    parts = (processor(), vector_instructions(), f"{os.cpu_count() or 1} processors", f"torch {torch.__version__}")
    return ", ".join(part for part in parts if part)
