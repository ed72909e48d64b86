"""Programs to export, and builds of the files: shared by the tests of exports."""

import ctypes
import shutil
import subprocess

import pytest
import torch
from robots import on_free_base

import torchdq
from torchdq.scene import integrators
from torchdq.scene.scene import Scene

F64 = torch.float64
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
COMPILERS = [
    pytest.param(name, marks=pytest.mark.skipif(not shutil.which(name), reason=f"no {name}"))
    for name in ("gcc", "clang")
]
TWO = torchdq.robots.load("two_link")


def needs(command):
    """Mark of a test that takes a command."""
    return pytest.mark.skipif(not shutil.which(command), reason=f"no {command}")


def run(*command: str, cwd=None) -> str:
    """Output of a command that succeeds."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def loaded(made, *flags, compiler="gcc"):
    """Exported file as a shared library."""
    folder = made.source.parent
    path = str(folder / "exported.so")
    flags = flags or ("-std=c99", "-O2")
    run(compiler, *flags, "-shared", "-fPIC", "-I", str(folder), str(made.source), "-o", path, "-lm")
    return ctypes.CDLL(path)


def passes_its_test(made, *flags, compiler="gcc"):
    """Output of the test of an exported file, built in strict C99."""
    folder = made.source.parent
    test = str(folder / "test")
    run(compiler, *STRICT, *flags, "-I", str(folder), str(made.source), str(made.test), "-o", test, "-lm")
    return run(test)


def two_link(*parameters):
    """Two-link arm of which some tensors are arguments."""
    return TWO.replace(**{name: getattr(TWO, name) for name in parameters})


def free():
    """Two-link arm on a floating base."""
    return on_free_base(TWO)


def step(*effects):
    """Program of a step of a scene under a torque."""
    return Scene(TWO, effects, integrator=integrators.RungeKutta4()).program("torque")
