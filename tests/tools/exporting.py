"""Programs to export, and builds of the files: shared by the tests of exports."""

import ctypes
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import pytest
import torch
from robots import on_free_base

import torchdq
from torchdq import effects
from torchdq.scene import controllers, integrators
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


@cache
def library(command, *texts):
    """Shared library of files, by name and text, of which the last is its source."""
    folder = tempfile.mkdtemp(prefix="torchdq-exported-")
    for name, text in texts:
        Path(folder, name).write_text(text)
    run(*command, "-shared", "-fPIC", texts[-1][0], "-o", "exported.so", "-lm", cwd=folder)
    return ctypes.CDLL(f"{folder}/exported.so")


def loaded(made, *flags, compiler="gcc"):
    """Exported file as a shared library, which is built once for all that have the same text."""
    texts = ((path.name, path.read_text()) for path in (made.header, made.source))
    return library((compiler, *(flags or ("-std=c99", "-O2"))), *texts)


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


def step(*parts):
    """Program of a step of a scene under a torque."""
    return Scene(TWO, parts, integrator=integrators.RungeKutta4()).program("torque")


PANDA = torchdq.robots.load("panda")
FRICTION = (effects.Gravity(), effects.Viscous(1.0), effects.Coulomb(0.5))  # it has roots and comparisons, no memory
FRAME_CONTROL = controllers.OperationalSpaceControl(
    torch.ones(()), torch.ones(()), expressed="world", axes="position", limits=True
)


def of(robot, function="", derived=lambda compiled: compiled, **options):
    """Function that compiles a program of a robot, or a derivative of it, in a precision."""
    return lambda dtype="float64": derived(torchdq.compile(robot, function, dtype, **options))


def trained():
    """Layer whose parameters are arguments of its program."""
    return torchdq.ForwardDynamics(TWO, ("mass", "inertia", "armature", "friction"))


# every kind of program that is exported, by precision
PROGRAMS = {
    "inverse dynamics": of(PANDA, "inverse_dynamics"),
    "forward dynamics": of(TWO, "forward_dynamics"),
    "mass matrix": of(TWO, "mass_matrix"),
    "closed form": of(TWO, "closed_form"),
    "jacobian": of(PANDA, "jacobian", options=("tip", "world")),
    "kinematics": of(TWO, "forward_kinematics"),
    "energy": of(TWO, "kinetic_energy"),
    "regressor": of(TWO, "regressor"),
    "computed torque": of(TWO, controllers.ComputedTorque(torch.ones(2), torch.ones(2))),
    "gradient": of(TWO, "inverse_dynamics", lambda compiled: compiled.vjp()),
    "derivatives": of(TWO, "inverse_dynamics", lambda compiled: compiled.jacobian(["q", "qdd"])),
    "parameters": of(two_link("mass", "inertia"), "forward_dynamics"),
    "gradient in parameters": of(two_link("mass"), "inverse_dynamics", lambda compiled: compiled.vjp()),
    "floating base": of(free(), "floating.inverse_dynamics"),
    "scene": of(step(*FRICTION)),
    "scene with limits": of(step(*FRICTION, effects.JointLimits(-1.0, 1.0))),
    "operational space": of(TWO, "operational_space", options=("tip", "body", "x y")),
    "control of a frame": of(TWO, controllers.OperationalSpaceControl(100.0, 20.0, axes=("x", "y"), q_null=0.5)),
    "a controller": of(TWO, controllers.PD(9.0, 3.0)),
    "a trained layer": lambda dtype="float64": of(trained().program(parameters="arguments"))(dtype),
    "forward dynamics of an arm": of(PANDA, "forward_dynamics"),
    "computed torque of an arm": of(PANDA, controllers.ComputedTorque(torch.ones(7), torch.ones(7))),
    "control of an arm's frame": of(PANDA, FRAME_CONTROL),
    "parameters of an arm": of(PANDA.replace(mass=PANDA.mass, com=PANDA.com), "inverse_dynamics"),
}
