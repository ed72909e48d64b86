"""Command `doctor`: what of an installation works, what is slow or broken, and how to fix it."""

import math
import os
import platform
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from torchdq import __version__
from torchdq.backends import cache, nvrtc
from torchdq.backends.choice import backend
from torchdq.backends.compiler import BuildError, compiler
from torchdq.base import machine
from torchdq.base.caches import clear_caches
from torchdq.base.progress import Progress
from torchdq.command.command import Command
from torchdq.command.outcome import Grid, Outcome
from torchdq.errors import TorchdqError
from torchdq.findings import Finding, Severity
from torchdq.functions.compile import compile
from torchdq.robot import shipped

STATES = {"ok": "ok", "warning": "warning", "error": "broken"}  # that are shown, by severity
CACHE = "TORCHDQ_CACHE"  # variable that names the folder of compiled programs
NEEDED = ("numpy", "torch", "gymnasium", "rich", "tyro")
# what optional packages are for, and how they are installed
OPTIONAL = {
    "scipy": ("logs", "torchdq[learn]"),
    "mcap-ros2-support": ("ROS 2 bags", "torchdq[ros]"),
    "matplotlib": ("pictures", "torchdq[viz]"),
    "viser": ("torchdq view", "torchdq[viz]"),
    "pin": ("conversions to Pinocchio", "torchdq[pinocchio]"),
    "mujoco": ("MJCF files", "torchdq[mujoco]"),
    "xacrodoc": ("xacro files", "torchdq[xacro]"),
    "robot_descriptions": ("robots by name", "torchdq[names]"),
    "casadi": ("running exports to CasADi", "casadi"),
    "onnx": ("exports to ONNX", "torchdq[onnx]"),
    "stable_baselines3": ("training of policies", "torchdq[rl]"),
}
EXTRA = "torchdq["  # beginning of the names of extras
POSITION = (0.3, 0.4)  # [rad]
# what holds the double pendulum of unit rods there [N m]: the moments of its weights about the joints
OUTER = 9.81 * 0.5 * math.cos(0.7)
TORQUES = (9.81 * 1.5 * math.cos(0.3) + OUTER, OUTER)
TOLERANCE = 1e-12  # relative


@dataclass(kw_only=True)
class DoctorCommand(Command):
    """Compiler, threads, GPU, packages, cache: what works, and how to fix what does not.

    Example: torchdq doctor
    """

    def outcome(self) -> Outcome:
        """Table of findings; it failed if something is broken."""
        found = [{"what": f.subject, "state": STATES[f.severity], "found": f.found, "cure": f.cure} for f in findings()]
        counts = Counter(one["state"] for one in found)
        verdict = "all is well"
        if counts["broken"]:
            verdict = f"broken: {', '.join(one['what'] for one in found if one['state'] == 'broken')}"
        elif counts["warning"]:
            verdict = f"it works; {counts['warning']} warning{'s' * (counts['warning'] > 1)}"
        rows = [(one["state"], one["what"], one["found"]) for one in found]
        cures = [("-", f"{one['what']}:", one["cure"]) for one in found if one["cure"]]
        mend = ("to do:", Grid((), cures)) if cures else ()
        text = (f"torchdq {__version__}", Grid(("state", "what", "found"), rows), *mend, verdict)
        data = {"version": __version__, "verdict": verdict, "findings": found}
        return Outcome(text, data, counts["broken"] > 0)


def _finding(subject: str, found: str, severity: Severity = "ok", cure: str = "") -> Finding:
    """Finding about a part of the installation."""
    return Finding(f"health.{subject.replace(' ', '_')}", subject, "", found, cure, severity=severity)


def findings() -> list[Finding]:
    """Parts of an installation as subjects, with what was found of each and how it is mended.

    >>> {finding.severity for finding in findings()} <= {"ok", "warning", "error"}
    True
    """
    with Progress("checking the installation"):
        vectors = machine.vector_instructions() or "none that torch knows"
        found = [
            _finding("python", f"{platform.python_version()}, {sys.executable}"),
            _packages(),
            _optional(),
            _finding("processor", f"{machine.processor()}, vector instructions: {vectors}"),
            _threads(),
        ]
        return [*found, *map(_caught, (_compiler, _cache, _gpu)), _known_torque()]


def _caught(look: Callable[[], Finding]) -> Finding:
    """Finding of a check that may warn: what it warns of is part of it."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        finding = look()
    if not said:
        return finding
    severity: Severity = "warning" if finding.severity == "ok" else finding.severity
    return finding._replace(severity=severity, found="; ".join([finding.found, *(str(one.message) for one in said)]))


def _packages() -> Finding:
    found = {name: machine.version_of(name) for name in NEEDED}
    words = ", ".join(f"{name} {version or 'missing'}" for name, version in found.items())
    missing = [name for name, version in found.items() if version is None]
    return _finding("packages", words, *(("error", f"pip install {' '.join(missing)}") if missing else ()))


def _optional() -> Finding:
    found = {name: machine.version_of(name) for name in OPTIONAL}
    there = ", ".join(f"{name} {version}" for name, version in found.items() if version)
    absent = {name: OPTIONAL[name] for name, version in found.items() if not version}
    if not absent:
        return _finding("optional packages", there)
    purposes = ", ".join(f"{name} for {purpose}" for name, (purpose, _) in absent.items())
    extras = sorted({one[len(EXTRA) : -1] for _, one in absent.values() if one.startswith(EXTRA)})
    packages = sorted({one for _, one in absent.values() if not one.startswith(EXTRA)})
    how = " ".join(["pip install", *([f"'{EXTRA}{','.join(extras)}]'"] if extras else []), *packages])
    return _finding("optional packages", f"{there or 'none'}; not installed: {purposes} ({how})")


def _threads() -> Finding:
    used, there = torch.get_num_threads(), os.cpu_count() or 1
    stated = os.environ.get("OMP_NUM_THREADS")
    words = f"{used} of {there} processors" + (f", OMP_NUM_THREADS={stated}" if stated else "")
    if used > there:
        cure = "set OMP_NUM_THREADS or torch.set_num_threads to at most that many"
        return _finding("threads", f"{words}: they wait for each other", "warning", cure)
    return _finding("threads", words)


def _compiler() -> Finding:
    found = compiler()
    if found is None:
        words = "none; programs run as torch operations, which is slower"
        cure = "install gcc or clang (apt install gcc), name one in $CC, or pip install 'torchdq[compiler]'"
        return _finding("C compiler", words, "warning", cure)
    version = found.version.strip().splitlines()
    return _finding("C compiler", f"{' '.join(found.command)}, {version[0] if version else 'of unknown version'}")


def _cache() -> Finding:
    try:
        folder = cache.directory()
    except BuildError as error:
        return _finding("cache", str(error), "error", f"name a folder that only you can write in ${CACHE}")
    programs = (entry for entry in folder.iterdir() if entry.is_file() and not entry.name.startswith("."))
    files = [entry.stat().st_size for entry in programs]
    words = f"{folder}, {len(files)} programs, {sum(files) / 2**20:.1f} MiB of at most {cache.LARGEST / 2**20:.0f} MiB"
    return _finding("cache", words)


def _gpu() -> Finding:
    if not torch.cuda.is_available():
        if Path("/dev/nvidia0").exists():
            words = f"there is one, which torch {torch.__version__} cannot use"
            cure = "install a build of torch for CUDA: https://pytorch.org/get-started"
            return _finding("GPU", words, "warning", cure)
        return _finding("GPU", "none; everything runs on the processor")
    names = ", ".join(torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count()))
    found = nvrtc.found()
    if isinstance(found, str):
        words = f"{names}; programs run there as torch operations, which is slower"
        return _finding("GPU", words, "warning", found)
    return _finding("GPU", f"{names}, {found!r}")


def _known_torque() -> Finding:
    """Torques of a known arm, computed by a program that is compiled now."""
    what = "compiled program"
    q = torch.tensor(POSITION, dtype=torch.float64)
    expected = torch.tensor(TORQUES, dtype=torch.float64)
    try:
        with _empty_cache(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a missing compiler has a finding of its own
            start = time.perf_counter()
            tau = torch.empty_like(q)
            with backend("auto" if compiler() is None else "c"):  # "auto" would hide that a compiler fails
                compile(shipped.load("two_link"), "inverse_dynamics", arguments=("q",))(q, out=tau)
            seconds = time.perf_counter() - start
    except (TorchdqError, OSError) as fault:
        cure = "the message of the compiler says why; another one is named in $CC"
        return _finding(what, f"a small program cannot be compiled: {fault}", "error", cure)
    error = float(((tau - expected) / expected).abs().max())
    if not error < TOLERANCE:
        words = f"torques of a double pendulum must be {TORQUES} N m, found {tuple(tau.tolist())}"
        return _finding(what, words, "error", "try another compiler, named in $CC, and report this with its version")
    how = "compiled and run" if compiler() else "run as torch operations"
    return _finding(what, f"{how} in {seconds:.2f} s; torques of a double pendulum are right to {error:.0e}")


@contextmanager
def _empty_cache() -> Iterator[None]:
    """Context in which nothing is compiled yet."""
    before = os.environ.get(CACHE)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        clear_caches()
        os.environ[CACHE] = folder
        try:
            yield
        finally:
            clear_caches()
            os.environ.pop(CACHE)
            if before is not None:
                os.environ[CACHE] = before
