"""Other systems than this one: Windows as far as it can be pretended, and programs compiled for others, not run.

The compiler for other systems is that of the package ziglang; without it these tests are skipped.
"""

import os
import shlex
import subprocess
import sys
from importlib.machinery import PathFinder

import pytest
import torch
from exporting import STRICT
from places import ROOT, TESTS

import torchdq
from torchdq.backends import c_library, compiler, fast_call
from torchdq.backends.c_loop import source
from torchdq.program.loop import Loop
from torchdq.program.program import Argument, record

zig = pytest.mark.skipif(PathFinder.find_spec("ziglang") is None, reason="no ziglang")
Q = (0.3, -0.7)
PRETENDED = f"""
import pkgutil, warnings
import windows
windows.pretend()
import torch, torchdq
from torchdq.envs import RobotVectorEnv
robot, q = torchdq.robots.load("two_link"), torch.tensor({Q}, dtype=torch.float64)
"""
EAGER = """
for module in pkgutil.walk_packages(torchdq.__path__, "torchdq."):
    if not module.name.endswith("__main__"):
        __import__(module.name)
with torchdq.backend("eager"):
    envs = RobotVectorEnv(3, "reach", "panda")
    envs.reset(seed=0)
    assert envs.step(torch.zeros(3, 7))[1].isfinite().all()
with warnings.catch_warnings(record=True) as said:
    print(*torchdq.inverse_dynamics(robot, q).tolist(), *torchdq.inverse_dynamics(robot, q, backend="eager").tolist())
assert "there is no C compiler" in str(said[0].message) and len(said) == 1
"""
BUILD = """
from pathlib import Path
from torchdq.backends import c_library
from torchdq.backends.c_loop import source
from torchdq.program.program import Argument, record
program = record("sines", [Argument("x", 50)], lambda x: {"y": [a.sin() for a in x]})  # more than a page of the stack
Path("program.c").write_text(source(program, False))
c_library._run_compiler([*c_library.compiler().command, *c_library.flags()], Path("program.so").absolute(), 1)
"""


def pretended(code: str, folder, **environment: str) -> str:
    """Output of a process that pretends Windows, in a folder, and has no compiler but a named one."""
    path = os.pathsep.join(map(str, (ROOT, TESTS / "tools", *filter(None, [os.environ.get("PYTHONPATH")]))))
    env = {**os.environ, "PYTHONPATH": path, "CC": "", "TORCHDQ_CACHE": str(folder / "cache"), **environment}
    command = [sys.executable, "-c", PRETENDED + code]
    run = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_without_what_windows_lacks_all_is_imported_and_torch_computes(tmp_path):
    hidden = "from torchdq.backends import compiler\ncompiler.ZIG = ('/nowhere',)\n"
    found = torch.tensor([float(x) for x in pretended(hidden + EAGER, tmp_path).split()], dtype=torch.float64)
    q = torch.tensor(Q, dtype=torch.float64)
    expected = torchdq.inverse_dynamics(torchdq.robots.load("two_link"), q, backend="eager")
    torch.testing.assert_close(found, expected.repeat(2))


@zig
def test_a_library_of_windows_is_built_as_it_is_there_and_exports_its_functions(tmp_path):
    """For processors with vectors of 64 bytes."""
    command = shlex.join([*compiler.ZIG, "-target", "x86_64-windows-gnu"])
    pretended(BUILD, tmp_path, CC=command, TORCHDQ_CFLAGS="-O0 -march=x86_64_v4")
    library = (tmp_path / "program.so").read_bytes()
    assert library.startswith(b"MZ") and b"\0parts\0run\0" in library


@zig
@pytest.mark.parametrize("target", ["aarch64-linux-gnu", "aarch64-linux-musl", "aarch64-macos", "x86_64-windows-gnu"])
def test_programs_compile_for_other_systems(target, tmp_path):
    """A function, a loop, what calls programs, and an exported function."""
    robot = torchdq.robots.load("panda")
    compiled = torchdq.compile(robot, "forward_dynamics")
    exported = compiled.export(tmp_path, "exported", batch=True).source
    step = record("turn", [Argument("x", 3)], lambda x: {"x": [a + a.sin() for a in x], "y": [x[0] * x[1]]})
    loop = Loop(step, carried=((0, 0),), kept=(1,))
    texts = {"program": source(compiled.program, False), "loop": source(loop, True), "call": fast_call.source()}
    for name, text in texts.items():
        (tmp_path / f"{name}.c").write_text(text)
    named = (*compiler.ZIG, "-target", target)
    flags = [flag for flag in (*c_library.flags(), "-O0") if flag != "-march=native"]
    commands = [[*compiler._asked(shlex.join(named)).command, *flags, str(tmp_path / f"{name}.c")] for name in texts]
    made = [tmp_path / f"{name}.o" for name in (*texts, "exported")]
    commands.append([*named, *STRICT, str(exported)])
    compiler.run([[*x, "-c", "-o", str(to)] for x, to in zip(commands, made, strict=True)], 100.0)
    assert all(one.stat().st_size > 1000 for one in made)
