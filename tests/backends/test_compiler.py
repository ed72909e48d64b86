"""Building programs: the cache of compiled libraries, many processes at once, compilers that are absent or fail.

Every process starts with an empty cache of its own and computes the torques of a robot; the torques are compared with
those of torch operations here. Compilers are shell scripts around the one that is there.
"""

import os
import shlex
import signal
import stat
import sys
import tempfile
import time
from pathlib import Path

import messages
import pytest
import torch
from forked import Forked
from helpers import thinned
from messages import refused

import torchdq
from torchdq.backends import c_library as build
from torchdq.backends import cache as kept
from torchdq.backends import compiler as machine
from torchdq.backends.c_loop import source
from torchdq.backends.c_source import pieces_of
from torchdq.backends.compiler import BuildError
from torchdq.program.program import Argument, record

pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")

Q = (0.3, -0.7)
ARM = f"""
import os, torch, torchdq
robot, q = torchdq.robots.load("two_link"), torch.tensor({Q}, dtype=torch.float64)
"""
ANY, COMPILED = (
    f"{ARM}print(*torchdq.inverse_dynamics(robot, q{backend}).tolist())\n" for backend in ("", ", backend='c'")
)


def start(code: str, cache: Path, **environment: str | None) -> Forked:
    """Process with its own cache, which lies beside its output; None takes a variable out of its environment."""
    env = {**os.environ, "OMP_NUM_THREADS": "1", "TORCHDQ_CACHE": str(cache), **environment}
    given = {name: value for name, value in env.items() if value is not None}
    return Forked(code, given, Path(tempfile.mkdtemp(prefix="process", dir=cache.parent)))


def ran(code: str, cache: Path, **environment: str | None) -> tuple[int, str, str]:
    """Exit status, output and errors of a process with its own cache."""
    process = start(code, cache, **environment)
    out, err = process.communicate(timeout=300)
    return process.returncode, out.strip(), err


def computes(code: str, cache: Path, **environment: str | None) -> str:
    """Warnings of a process that computes torques, which are right."""
    status, out, err = ran(code, cache, **environment)
    assert status == 0, err
    robot, q = torchdq.robots.load("two_link"), torch.tensor(Q, dtype=torch.float64)
    found = torch.tensor([float(x) for x in out.split()], dtype=torch.float64)
    torch.testing.assert_close(found, torchdq.inverse_dynamics(robot, q, backend="eager"))
    return err


def script(path: Path, text: str) -> str:
    """Executable shell script."""
    path.write_text("#!/bin/sh\n" + text)
    path.chmod(0o755)
    return str(path)


REAL = shlex.join(build.compiler().command) if build.compiler() else ""
NO_COMPILER = "from torchdq.backends import compiler\ncompiler.ZIG = ('/nowhere',)\n"  # beside an empty path


def in_place_of_compiling(path: Path, text: str) -> str:
    """Compiler that states the version of the one that is there, and otherwise does this."""
    return script(path, f'case "$*" in *--version*) exec {REAL} "$@";; esac\n{text}\n')


# --- here: one function, built and loaded by hand --------------------------------------------------------------------


def double(factor: float) -> tuple[str, str, int]:
    """Source, name and pointers of a program that multiplies a number."""
    program = record("scale", [Argument("x", 1)], lambda x: {"y": [factor * x[0]]})
    return source(program, False), program.name, 2


def apply(library, x: float) -> float:
    at, to = torch.tensor([x], dtype=torch.float64), torch.empty(1, dtype=torch.float64)
    library.run(1, None, at.data_ptr(), to.data_ptr())
    return to.item()


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """Path of a cache that is not there yet."""
    path = tmp_path / "deep" / "cache"
    monkeypatch.setenv("TORCHDQ_CACHE", str(path))
    return path


@pytest.fixture
def warned():
    """Process that was not warned about anything."""
    torchdq.clear_caches()
    yield
    torchdq.clear_caches()


def libraries(cache: Path) -> list[Path]:
    return sorted(cache.glob("*.so"))


def test_the_compiler_of_a_python_package_is_found_where_there_is_no_other(cache, tmp_path, monkeypatch, warned):
    """One with its name that compiles as the one that is there, with the arguments that zig needs."""
    package = tmp_path / "ziglang"
    package.mkdir()
    (package / "__init__.py").write_text("")
    real, environment = shlex.split(REAL), dict(os.environ)  # which may find zig itself, and has a path for the linker
    call = f"os.execve({real[0]!r}, [*{real}, *sys.argv[2:]], {environment})"
    (package / "__main__.py").write_text(f"import os, sys\n{call}\n")
    for name, value in {"PATH": str(tmp_path), "CC": "", "PYTHONPATH": str(tmp_path)}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.syspath_prepend(str(tmp_path))
    found = build.compiler()
    assert found.command[:4] == (sys.executable, "-m", "ziglang", "cc") and "-nostdlib" in found.command
    assert apply(build.load(*double(3.0)), 2.0) == 6.0


def test_the_cache_is_made_for_the_user_alone(cache):
    before = os.umask(0)
    try:
        build.load(*double(3.0))
    finally:
        os.umask(before)
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700


@pytest.mark.usefixtures("warned")
@pytest.mark.parametrize("mode", [0o770, 0o707, None], ids=["by the group", "by all", "a file"])
def test_a_cache_that_others_can_write_or_that_is_a_file_is_not_used(cache, mode):
    cache.parent.mkdir()
    if mode is None:
        cache.write_text("occupied")
    else:
        cache.mkdir()
        cache.chmod(mode)
    with messages.warned(UserWarning):
        assert apply(build.load(*double(3.0)), 2.0) == 6.0
    assert cache.read_text() == "occupied" if mode is None else list(cache.iterdir()) == []


def test_programs_that_differ_in_one_bit_of_a_constant_have_libraries_of_their_own(cache):
    close_by = 3.0 + 2.0**-51
    functions = [build.load(*double(3.0)), build.load(*double(close_by))]
    assert len(libraries(cache)) == 2
    assert [apply(f, 1.0) for f in functions] == [3.0, close_by]


SPOILED = {
    "empty": lambda data, other: b"",
    "shorter than a hash": lambda data, other: data[:20],
    "cut short": lambda data, other: data[: len(data) // 2],
    "without its hash": lambda data, other: data[:-32],
    "one bit changed": lambda data, other: data[:999] + bytes([data[999] ^ 1]) + data[1000:],
    "no library": lambda data, other: b"#!/bin/sh\necho hello\n" * 10,
    "another program's": lambda data, other: other,
}


def test_a_broken_or_foreign_entry_is_built_again(cache, monkeypatch):
    """Spoiled under its own name, in a cache of its own, before this process ever loads it."""
    entry, other = (built(double(factor)) for factor in (3.0, 5.0))
    for name, spoil in SPOILED.items():
        monkeypatch.setenv("TORCHDQ_CACHE", str(cache / name))
        spoiled, data = cache_entry(cache, double(3.0)), spoil(entry.read_bytes(), other.read_bytes())
        spoiled.write_bytes(data)
        assert apply(build.load(*double(3.0)), 2.0) == 6.0, name
        assert spoiled.read_bytes() != data, name


def cache_entry(cache: Path, program: tuple[str, str, int]) -> Path:
    """Where a program's library lies, or will."""
    return kept.directory() / f"{build.entry_key(program[0])}.so"


def built(program: tuple[str, str, int]) -> Path:
    """Where the library of a program lies, which is built but not loaded."""
    text, name, _ = program
    return kept.kept(build.entry_key(text), ".so", name, lambda library: build._compile(library, text, name))


# --- processes -------------------------------------------------------------------------------------------------------


def test_processes_that_start_on_an_empty_cache_at_once_all_succeed(tmp_path):
    cache = tmp_path / "cache"
    code = f"""{ARM}
expected = torchdq.inverse_dynamics(robot, q, backend="eager")
children = []
for _ in range(2):
    child = os.fork()
    if child == 0:
        found = torchdq.inverse_dynamics(robot, q, backend="c")
        os._exit(0 if torch.allclose(found, expected) else 1)
    children.append(child)
print(sum(os.waitpid(child, 0)[1] == 0 for child in children))
"""
    status, out, err = ran(code, cache)
    assert (status, out) == (0, "2"), err
    assert [path.suffix for path in cache.iterdir()] == [".so"]


def test_sixteen_threads_compile_a_program_once(tmp_path):
    log = tmp_path / "log"
    noted = in_place_of_compiling(tmp_path / "noted", f'echo built >> {log}\nexec {REAL} "$@"')
    code = f"""{ARM}
from concurrent.futures import ThreadPoolExecutor
with ThreadPoolExecutor(16) as pool:
    found = list(pool.map(lambda k: torchdq.inverse_dynamics(robot, q), range(16)))
assert all(torch.equal(found[0], tau) for tau in found)
print(*found[0].tolist())
"""
    computes(code, tmp_path / "cache", CC=noted)
    assert log.read_text().split() == ["built"] * 2  # the program, and what calls it
    assert [path.suffix for path in (tmp_path / "cache").iterdir()] == [".so"] * 2


def test_a_process_killed_while_it_compiles_leaves_nothing_that_is_loaded(tmp_path):
    cache, begun = tmp_path / "cache", tmp_path / "begun"
    slow = in_place_of_compiling(tmp_path / "slow", f'{REAL} "$@"\necho $$ > {begun}\nsleep 600')
    process = start(COMPILED, cache, CC=slow)
    deadline = time.monotonic() + 300
    while not (begun.exists() and begun.read_text()) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    os.killpg(int(begun.read_text()), signal.SIGKILL)  # the compiler, which a session of its own outlives
    assert libraries(cache) == []
    computes(COMPILED, cache)
    assert len(libraries(cache)) == 1


THRICE = f"""{ARM}
for k in range(3):
    tau = torchdq.inverse_dynamics(robot, q.expand(k + 1, 2))[0]
torchdq.mass_matrix(robot, torch.zeros(2))
print(*tau.tolist())
"""
FULL_DISK = """{arm}
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))  # no file can be longer
torchdq.forward_dynamics(robot, q.requires_grad_(), q, q{options}).sum().backward()
print(*torchdq.inverse_dynamics(robot, q.detach().expand(5, 2){options})[0].tolist())
"""
NO_FOLDER = f"import tempfile; tempfile.tempdir = '/nowhere'\n{ANY}"
# code, whether there is a compiler, whether a file stands where the cache should be, words of the only warning
IMPAIRED = {
    "no compiler": (NO_COMPILER + THRICE, False, False, "as torch operations, which is slower: there is no C compiler"),
    "a full disk": (FULL_DISK.format(arm=ARM, options=""), True, False, "torchdq runs programs as torch operations"),
    "no folder at all": (NO_FOLDER, True, True, "no folder can hold compiled programs"),
    "no folder to keep them": (THRICE, True, True, "compiled programs are not kept"),
}


@pytest.mark.parametrize("name", IMPAIRED)
def test_where_programs_are_not_compiled_or_not_kept_one_warning_is_given_and_torch_computes(name, tmp_path):
    code, compiler, occupied, words = IMPAIRED[name]
    cache, missing = tmp_path / "cache", {} if compiler else {"PATH": str(tmp_path), "CC": None}
    if occupied:
        cache.touch()
    err = computes(code, cache, **missing)
    assert err.count(words) == err.count("Warning") == 1
    assert occupied or not cache.exists() or list(cache.iterdir()) == []


@pytest.mark.parametrize("name", ["no compiler", "a full disk", "a compiler that fails"])
def test_a_named_backend_that_cannot_compile_is_an_error_that_says_so(name, tmp_path):
    broken = in_place_of_compiling(tmp_path / "broken", 'echo "out of cheese" >&2\nexit 3')
    failure = f"{broken} could not compile the program 'inverse_dynamics_two_link'"
    code, environment, *words = {
        "no compiler": (
            NO_COMPILER + COMPILED,
            {"PATH": str(tmp_path), "CC": None},
            "there is no C compiler; install gcc or clang, name one in $CC, or pip install 'torchdq[compiler]'",
        ),
        "a full disk": (FULL_DISK.format(arm=ARM, options=", backend='c'"), {}, "clear_caches"),
        "a compiler that fails": (
            COMPILED,
            {"CC": broken},
            *(failure, "out of cheese", "clear_caches() makes this process try again"),
        ),
    }[name]
    status, _, err = ran(code, tmp_path / "cache", **environment)
    assert status == 1 and "BuildError: " in err and all(part in err for part in words), err
    assert not (tmp_path / "cache").exists() or list((tmp_path / "cache").iterdir()) == []


BAD = {
    "hangs": "sleep 600 & echo $! > started; wait",
    "prints garbage and fails": r"printf '\377\376garbage' >&2; exit 1",
    "crashes": "kill -SEGV $$",
    "writes garbage": r"""while [ $# -gt 1 ]; do [ "$1" = -o ] && printf '\377\376\000' > "$2"; shift; done""",
    "writes nothing": "exit 0",
    "writes a library without run": f'echo "int other;" > empty.c; exec {REAL} -shared -o "$OUT" empty.c',
}


@pytest.mark.parametrize("name", BAD)
def test_a_compiler_that_does_not_compile_is_an_error_and_nothing_is_kept(name, tmp_path, cache, monkeypatch):
    action = BAD[name]
    find = 'for x in "$@"; do [ "$before" = -o ] && OUT="$x"; before="$x"; done'
    bad = script(
        tmp_path / "bad", f'case "$*" in *--version*) echo bad; exit 0;; esac\ncd {tmp_path}\n{find}\n{action}\n'
    )
    monkeypatch.setattr(build, "compiler", lambda: machine.Compiler((bad,), "bad"))
    monkeypatch.setattr(build, "LIMIT", 1.0 if name == "hangs" else 60.0)
    started = time.monotonic()
    with refused(BuildError):
        build.load(*double(3.0))
    assert list(cache.iterdir()) == [] and time.monotonic() - started < 300
    if name == "hangs":  # what it started ends with it
        left = Path("/proc", (tmp_path / "started").read_text().strip(), "cmdline")
        while left.exists() and left.read_bytes() and time.monotonic() - started < 30:
            time.sleep(0.05)
        assert not left.exists() or not left.read_bytes()  # a process that ended and nobody waited for has none
    monkeypatch.undo()
    monkeypatch.setenv("TORCHDQ_CACHE", str(cache))
    assert apply(build.load(*double(3.0)), 2.0) == 6.0


NAMED = {"is not there": "/nope", "has an open quotation": "cc '"}
VERSIONS = {"hangs": "sleep 600 & sleep 600", "fails": "echo no >&2; exit 1"}


@pytest.mark.usefixtures("warned")
@pytest.mark.parametrize("name", [*VERSIONS, *NAMED])
def test_a_named_compiler_that_states_no_version_is_replaced_by_another_with_a_warning(name, tmp_path, monkeypatch):
    named = NAMED.get(name) or script(tmp_path / "bad", VERSIONS[name])
    if name == "hangs":
        monkeypatch.setattr(machine, "ASKED", 1.0)
    monkeypatch.setenv("CC", named)
    with messages.warned(UserWarning):
        found = machine.compiler.__wrapped__()
    assert found is not None and found.command[0] != named


def test_a_version_that_is_garbage_is_a_version(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", script(tmp_path / "odd", r"printf '\377\376'"))
    assert machine.compiler.__wrapped__().command == (str(tmp_path / "odd"),)


# --- bounds ----------------------------------------------------------------------------------------------------------


def mapped(cache: Path) -> int:
    """Number of libraries of a cache in the memory of this process."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    return len({line.split()[-1] for line in lines if str(cache) in line})


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="what is mapped is read from /proc")
def test_a_library_is_unloaded_with_its_kernel(cache):
    torchdq.clear_caches()
    robot, q = torchdq.robots.load("two_link"), torch.zeros(2, dtype=torch.float64)
    for k in range(3):
        torchdq.inverse_dynamics(robot.replace(mass=(1 + k) * robot.mass).bake(), q, backend="c")
    assert mapped(cache) == 3
    torchdq.clear_caches()
    assert mapped(cache) == 0


def test_a_full_cache_loses_the_libraries_that_were_used_least_recently(cache, monkeypatch):
    for k in range(3):
        build.load(*double(3.0 + k))
        os.utime(cache_entry(cache, double(3.0 + k)), (1000.0 + k,) * 2)
    build.load(*double(3.0))  # the oldest, used again
    size = sum(path.stat().st_size for path in libraries(cache))
    monkeypatch.setattr(kept, "LARGEST", 0.7 * size)
    build.load(*double(7.0))
    assert {cache_entry(cache, double(x)) for x in (3.0, 5.0, 7.0)} == set(libraries(cache))


# --- files that are no libraries -------------------------------------------------------------------------------------


def machine_code(key: str, content: bytes) -> Path:
    """File of machine code in the cache."""
    return kept.kept(key, ".cubin", "scale", lambda path: path.write_bytes(content))


def test_a_pipe_of_the_name_of_a_file_is_replaced(cache):
    machine_code("key", b"code").unlink()
    os.mkfifo(cache / "key.cubin")
    assert kept.content(machine_code("key", b"code")) == b"code"


def test_a_file_has_the_content_that_was_made_and_is_made_once(cache):
    path = machine_code("key", b"\x00code\xff")
    assert path == cache / "key.cubin" and kept.content(path) == b"\x00code\xff"
    assert machine_code("key", b"other") == path and kept.content(path) == b"\x00code\xff"
    assert list(cache.iterdir()) == [path]


def test_a_full_cache_loses_files_of_any_kind(cache, monkeypatch):
    build.load(*double(3.0))
    old = machine_code("old", bytes(1000))
    os.utime(old, (1000.0, 1000.0))
    monkeypatch.setattr(kept, "LARGEST", cache_entry(cache, double(3.0)).stat().st_size + 500)
    new = machine_code("new", bytes(100))
    assert set(cache.iterdir()) == {cache_entry(cache, double(3.0)), new}


# --- long programs ---------------------------------------------------------------------------------------------------


def test_a_long_program_is_compiled_in_pieces_and_is_right(cache, monkeypatch):
    def algorithm(x):
        y = x[0]
        for _ in range(4000):
            y = y * x[0] + 1.0
        return {"y": [y]}

    program = record("long", [Argument("x", 1)], algorithm)
    text = source(program, False)
    assert pieces_of(text) > 2
    found = []
    for processes in (1, 3):
        monkeypatch.setattr(build, "PROCESSES", processes)
        monkeypatch.setattr(os, "cpu_count", lambda: 4)
        cache_entry(cache, (text, "long", 2)).unlink(missing_ok=True)
        found.append(apply(build.load(text, "long", 2), 0.5))
    assert found == [2.0] * 2


@pytest.mark.parametrize("arguments", thinned(["", " -g0"], [" -g0"]))
def test_the_compiler_named_in_the_environment_is_used_with_its_arguments(arguments, tmp_path):
    log = tmp_path / "log"
    mine = script(tmp_path / "mine", f'echo "$*" >> {log}\nexec {REAL} "$@"\n')
    computes(ANY, tmp_path / "cache", CC=f"{mine}{arguments}")
    assert any("-march=native" in line and line.startswith(arguments.strip()) for line in log.read_text().splitlines())


# -ffast-math, and parts of it that gcc or clang accept alone
ASSOCIATIVE = "-fassociative-math -fno-signed-zeros -fno-trapping-math"
FAST = [
    (variable, flags)
    for variable in ("CC", "TORCHDQ_CFLAGS")
    for flags in ("-ffast-math", "-funsafe-math-optimizations", ASSOCIATIVE, "-Ofast")
]


@pytest.mark.parametrize(("variable", "flags"), thinned(FAST, [FAST[0], FAST[7]]))
def test_no_argument_of_the_user_makes_arithmetic_inexact(variable, flags, tmp_path):
    """Neither that of the program, nor that of the process: start files of -ffast-math make subnormal numbers zero."""
    code = COMPILED + "assert torch.tensor(2.0**-1070, dtype=torch.float64) * 0.5 > 0.0, 'flushed to zero'\n"
    environment = {"CC": REAL, "TORCHDQ_CFLAGS": "-O3"}
    environment[variable] += f" {flags}"
    computes(code, tmp_path / "cache", **environment)


def test_arguments_of_the_compiler_in_the_environment_overrule_ours_and_are_part_of_the_key(cache, monkeypatch):
    commands, run = [], build.run
    monkeypatch.setattr(build, "run", lambda *x: (commands.extend(x[0]), run(*x))[1])
    for flags in ("", "-O1 -g0", "-O0"):
        monkeypatch.setenv("TORCHDQ_CFLAGS", flags)
        assert apply(build.load(*double(3.0)), 2.0) == 6.0
    assert len(libraries(cache)) == 3
    assert [word for word in commands[1] if word.startswith(("-O", "-g"))][1:] == ["-O1", "-g0"]


def test_a_slow_build_is_announced(tmp_path):
    slow = in_place_of_compiling(tmp_path / "slow", f'sleep 0.3\nexec {REAL} "$@"')
    sooner = "from torchdq.base import progress as notice\nnotice.FIRST, notice.EVERY = 0.1, 1e4\n"
    assert computes(sooner + ANY, tmp_path / "cache", CC=slow).count("compiling inverse_dynamics_two_link") == 1


def test_a_child_forked_after_use_computes_in_threads_of_its_own(tmp_path):
    """Inputs and comparisons by numpy, since torch's own threads do not survive a fork."""
    code = f"""{ARM}
import numpy
from torchdq.backends import threads
torch.set_num_threads(2)
threads.PER_THREAD = 1e4
q = torch.from_numpy(numpy.linspace(-3, 3, 400_000).reshape(-1, 2))
before = torchdq.inverse_dynamics(robot, q, backend="c").numpy()
assert threads.running(), "the batch was to be large enough for threads"
child = os.fork()
if child == 0:
    os._exit(0 if (torchdq.inverse_dynamics(robot, q, backend="c").numpy() == before).all() else 1)
print(os.waitpid(child, 0)[1])
"""
    status, out, err = ran(code, tmp_path / "cache")
    assert (status, out) == (0, "0"), err
