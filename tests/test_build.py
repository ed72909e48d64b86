"""Building programs: the cache of compiled libraries, many processes at once, compilers that are absent or fail.

Every process starts with an empty cache of its own and computes the torques of a robot; the torques are compared with
those of torch operations here. Compilers are shell scripts around the one that is there.
"""

import hashlib
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import torchdq
from torchdq.backends import cache as build
from torchdq.backends.c_source import source
from torchdq.program.program import Argument, record

pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")

Q = (0.3, -0.7)
TORQUES = """
import torch, torchdq
robot = torchdq.robots.load("two_link")
tau = torchdq.inverse_dynamics(robot, torch.tensor([0.3, -0.7], dtype=torch.float64){options})
print(*tau.tolist())
"""


def start(code: str, cache: Path, **environment: str | None) -> subprocess.Popen:
    """Python process with its own cache; None takes a variable out of its environment."""
    env = {**os.environ, "OMP_NUM_THREADS": "1", "TORCHDQ_CACHE": str(cache), **environment}
    root = str(Path(torchdq.__file__).parents[1])
    env["PYTHONPATH"] = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env={name: value for name, value in env.items() if value is not None},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def torques(cache: Path, options: str = "", **environment: str | None) -> tuple[list[float], str]:
    """Torques that a new process computes, and what it says besides."""
    process = start(TORQUES.format(options=options), cache, **environment)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return [float(x) for x in out.split()], err


def right(found: list[float]) -> bool:
    robot, q = torchdq.robots.load("two_link"), torch.tensor(Q, dtype=torch.float64)
    return torch.allclose(torch.tensor(found, dtype=torch.float64), torchdq.inverse_dynamics(robot, q, backend="eager"))


def script(path: Path, text: str) -> str:
    """Executable shell script."""
    path.write_text("#!/bin/sh\n" + text)
    path.chmod(0o755)
    return str(path)


REAL = build.compiler().command[0] if build.compiler() else ""

# --- here: one function, built and loaded by hand --------------------------------------------------------------------


def double(factor: float) -> tuple[str, str, int]:
    """Source, name and pointers of a program that multiplies a number."""
    program = record("scale", [Argument("x", 1)], lambda x: {"y": [factor * x[0]]})
    return source(program, False), program.name, 2


def apply(function, x: float) -> float:
    at, to = torch.tensor([x], dtype=torch.float64), torch.empty(1, dtype=torch.float64)
    function(1, at.data_ptr(), to.data_ptr())
    return to.item()


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """Path of a cache that is not there yet."""
    path = tmp_path / "deep" / "cache"
    monkeypatch.setenv("TORCHDQ_CACHE", str(path))
    return path


def libraries(cache: Path) -> list[Path]:
    return sorted(cache.glob("*.so"))


def test_the_cache_is_made_for_the_user_alone(cache):
    before = os.umask(0)
    try:
        build.load(*double(3.0))
    finally:
        os.umask(before)
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777], ids=oct)
def test_a_cache_that_others_can_write_is_not_used(cache, mode):
    cache.mkdir(parents=True)
    cache.chmod(mode)
    assert apply(build.load(*double(3.0)), 2.0) == 6.0
    assert list(cache.iterdir()) == []


def test_a_cache_that_is_a_file_is_not_used(cache):
    cache.parent.mkdir()
    cache.write_text("occupied")
    assert apply(build.load(*double(3.0)), 2.0) == 6.0
    assert cache.read_text() == "occupied"


def test_what_was_built_is_not_built_again(cache, monkeypatch):
    build.load(*double(3.0))
    monkeypatch.setattr(build, "_compile", None)
    assert apply(build.load(*double(3.0)), 2.0) == 6.0


def test_programs_that_differ_in_one_bit_of_a_constant_have_libraries_of_their_own(cache):
    close_by = 3.0 + 2.0**-51
    functions = [build.load(*double(3.0)), build.load(*double(close_by))]
    assert len(libraries(cache)) == 2
    assert [apply(f, 1.0) for f in functions] == [3.0, close_by]


def test_only_complete_libraries_are_left(cache):
    build.load(*double(3.0))
    (library,) = cache.iterdir()
    body, digest = library.read_bytes()[:-32], library.read_bytes()[-32:]
    assert hashlib.sha256(library.stem.encode() + body).digest() == digest


SPOILED = {
    "empty": lambda data, other: b"",
    "shorter than a hash": lambda data, other: data[:20],
    "cut short": lambda data, other: data[: len(data) // 2],
    "without its hash": lambda data, other: data[:-32],
    "one bit changed": lambda data, other: data[:999] + bytes([data[999] ^ 1]) + data[1000:],
    "no library": lambda data, other: b"#!/bin/sh\necho hello\n" * 10,
    "another program's": lambda data, other: other,
}


@pytest.mark.parametrize("spoil", SPOILED.values(), ids=SPOILED)
def test_a_broken_or_foreign_entry_is_built_again(cache, spoil):
    """Spoiled under its own name before this process ever loads it."""
    build._compile(cache_entry(cache, double(5.0)), cache_entry(cache, double(5.0)).stem, *double(5.0)[:2])
    entry = cache_entry(cache, double(3.0))
    build._compile(entry, entry.stem, *double(3.0)[:2])
    good = entry.read_bytes()
    entry.write_bytes(spoil(good, cache_entry(cache, double(5.0)).read_bytes()))
    assert apply(build.load(*double(3.0)), 2.0) == 6.0
    assert build._intact(entry, entry.stem)


def cache_entry(cache: Path, program: tuple[str, str, int]) -> Path:
    """Where a program's library lies, or will."""
    return build.directory() / f"{build.entry_key(program[0])}.so"


# --- processes -------------------------------------------------------------------------------------------------------


def test_sixteen_processes_that_start_on_an_empty_cache_all_succeed(tmp_path):
    """Forked, so that they start at once."""
    cache = tmp_path / "cache"
    code = """
import os, sys
import torch, torchdq
robot, q = torchdq.robots.load("two_link"), torch.tensor([0.3, -0.7], dtype=torch.float64)
expected = torchdq.inverse_dynamics(robot, q, backend="eager")
children = []
for _ in range(16):
    child = os.fork()
    if child == 0:
        found = torchdq.inverse_dynamics(robot, q, backend="c")
        os._exit(0 if torch.allclose(found, expected) else 1)
    children.append(child)
print(sum(os.waitpid(child, 0)[1] == 0 for child in children))
"""
    process = start(code, cache)
    out, err = process.communicate(timeout=120)
    assert (process.returncode, out.strip()) == (0, "16"), err
    assert [path.suffix for path in cache.iterdir()] == [".so"]


def test_a_process_killed_while_it_compiles_leaves_nothing_that_is_loaded(tmp_path):
    cache, begun = tmp_path / "cache", tmp_path / "begun"
    slow = script(
        tmp_path / "slow",
        f'case "$*" in *--version*) exec {REAL} "$@";; esac\n{REAL} "$@"\ntouch {begun}\nsleep 60\n',
    )
    process = start(TORQUES.format(options=", backend='c'"), cache, CC=slow)
    deadline = time.monotonic() + 60
    while not begun.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    process.stderr.close()
    assert begun.exists() and libraries(cache) == []
    assert right(torques(cache, ", backend='c'")[0]) and len(libraries(cache)) == 1


def test_without_a_compiler_one_warning_is_given_and_torch_computes(tmp_path):
    twice = """
import torch, torchdq
robot = torchdq.robots.load("two_link")
for k in range(3):
    tau = torchdq.inverse_dynamics(robot, torch.tensor([0.3, -0.7], dtype=torch.float64).expand(k + 1, 2))[0]
torchdq.mass_matrix(robot, torch.zeros(2))
print(*tau.tolist())
"""
    process = start(twice, tmp_path / "cache", PATH=str(tmp_path), CC=None)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0 and right([float(x) for x in out.split()])
    assert err.count("there is no C compiler on the path") == 1


def test_without_a_compiler_asking_for_one_says_what_to_do(tmp_path):
    process = start(TORQUES.format(options=", backend='c'"), tmp_path / "cache", PATH=str(tmp_path), CC=None)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "BuildError: there is no C compiler; install gcc or clang, or name one in $CC" in err


def test_a_compiler_that_fails_is_an_error_that_names_the_program(tmp_path):
    broken = script(
        tmp_path / "broken", f'case "$*" in *--version*) exec {REAL} "$@";; esac\necho "out of cheese" >&2\nexit 3\n'
    )
    process = start(TORQUES.format(options=", backend='c'"), tmp_path / "cache", CC=broken)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert f"BuildError: {broken} could not compile the program 'inverse_dynamics_two_link'" in err
    assert "out of cheese" in err and list((tmp_path / "cache").iterdir()) == []


def test_the_compiler_named_in_the_environment_is_used(tmp_path):
    log = tmp_path / "log"
    mine = script(tmp_path / "mine", f'echo "$*" >> {log}\nexec {REAL} "$@"\n')
    found, _ = torques(tmp_path / "cache", CC=mine)
    assert right(found)
    assert any("-march=native" in line for line in log.read_text().splitlines())


def test_the_compiler_named_in_the_environment_may_have_arguments(tmp_path):
    log = tmp_path / "log"
    mine = script(tmp_path / "mine", f'echo "$*" >> {log}\nexec {REAL} "$@"\n')
    found, _ = torques(tmp_path / "cache", ", backend='c'", CC=f"{mine} -g0")
    assert right(found)
    assert any(line.startswith("-g0 ") and "-march=native" in line for line in log.read_text().splitlines())


def test_what_a_killed_build_left_behind_is_removed_by_a_later_one(cache):
    directory = build.directory()
    abandoned, at_work = directory / ".build-abandoned", directory / ".build-atwork"
    for folder in (abandoned, at_work):
        folder.mkdir()
        (folder / "program.c").touch()
    long_ago = time.time() - 2 * build.ABANDONED
    os.utime(abandoned, (long_ago, long_ago))
    build.load(*double(7.0))
    assert not abandoned.exists() and at_work.exists()


def test_a_slow_build_is_announced(tmp_path):
    slow = script(tmp_path / "slow", f'case "$*" in *--version*) ;; *) sleep 1.5;; esac\nexec {REAL} "$@"\n')
    found, err = torques(tmp_path / "cache", CC=slow)
    assert right(found) and err.count("compiling inverse_dynamics_two_link") == 1


def test_a_child_forked_after_use_computes_in_threads_of_its_own(tmp_path):
    """Inputs and comparisons by numpy, since torch's own threads do not survive a fork."""
    code = """
import os
import numpy, torch, torchdq
from torchdq.backends import threads
torch.set_num_threads(2)
robot = torchdq.robots.load("two_link")
threads.PER_THREAD = 1e4
q = torch.from_numpy(numpy.linspace(-3, 3, 400_000).reshape(-1, 2))
before = torchdq.inverse_dynamics(robot, q, backend="c").numpy()
assert threads.running(), "the batch was to be large enough for threads"
child = os.fork()
if child == 0:
    os._exit(0 if (torchdq.inverse_dynamics(robot, q, backend="c").numpy() == before).all() else 1)
print(os.waitpid(child, 0)[1])
"""
    process = start(code, tmp_path / "cache")
    try:
        out, err = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert (process.returncode, out.strip()) == (0, "0"), err
