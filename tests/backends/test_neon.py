"""The C that is emitted is right on ARM too: built for it, run under emulation, compared with this machine's results.

Needs a cross compiler and an emulator (Debian: gcc-aarch64-linux-gnu, libc6-dev-arm64-cross, qemu-user), and is skipped
where they are missing.
"""

import shutil
import subprocess

import numpy as np
import pytest
import torch
from helpers import compiled

import torchdq
from torchdq import Scene, effects
from torchdq.backends import c_library as build
from torchdq.backends.c_loop import source as source_of
from torchdq.program.program import outputs

CROSS, EMULATOR = shutil.which("aarch64-linux-gnu-gcc"), shutil.which("qemu-aarch64")
pytestmark = pytest.mark.skipif(
    CROSS is None or EMULATOR is None or build.compiler() is None, reason="no compiler for ARM, or no emulator"
)

# reads the arguments from a file, in order, and writes the results to another
MAIN = """
#include <stdio.h>
#include <stdlib.h>
int main(int n,char**paths){{
  FILE*from=fopen(paths[1],"rb"),*to=fopen(paths[2],"wb");
  {buffers}
  run({samples},0,{pointers});
  {writing}
  return 0;
}}
"""


def on_arm(program, inputs, folder, single):
    """Results of a program on an emulated ARM processor."""
    samples = inputs[0].shape[0]
    widths = [len(r.values) for r in outputs(program)]
    buffers = [
        f"S*a{k}=malloc(sizeof(S)*{x.numel()});if(fread(a{k},sizeof(S),{x.numel()},from)!={x.numel()})return 1;"
        for k, x in enumerate(inputs)
    ]
    buffers += [f"S*r{k}=malloc(sizeof(S)*{samples * w});" for k, w in enumerate(widths)]
    pointers = [f"a{k}" for k in range(len(inputs))] + [f"r{k}" for k in range(len(widths))]
    writing = [f"fwrite(r{k},sizeof(S),{samples * w},to);" for k, w in enumerate(widths)]
    text = source_of(program, single) + MAIN.format(
        buffers="".join(buffers), samples=samples, pointers=",".join(pointers), writing="".join(writing)
    )
    source, binary, given, written = (folder / name for name in ("program.c", "program", "given", "found"))
    source.write_text(text)
    given.write_bytes(b"".join(x.numpy().tobytes() for x in inputs))
    subprocess.run([CROSS, "-O3", *build.ARITHMETIC, "-w", "-static", "-o", binary, source, "-lm"], check=True)
    subprocess.run([EMULATOR, binary, given, written], check=True)
    flat = np.frombuffer(written.read_bytes(), np.float32 if single else np.float64)
    parts = np.split(flat, np.cumsum([samples * w for w in widths])[:-1])
    found = [torch.tensor(part.reshape(samples, w)) for part, w in zip(parts, widths, strict=True)]
    return found[: len(program.results)]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("function", ["inverse_dynamics", "forward_dynamics", "forward_kinematics"])
def test_programs_give_the_same_numbers_on_arm(function, dtype, tmp_path):
    robot = torchdq.robots.load("panda")
    options = robot.frame_names[-1:] if function == "forward_kinematics" else ()
    program = torchdq.compile(robot, function, dtype=dtype, options=options).program
    torch.manual_seed(0)
    inputs = [2 * torch.randn(37, a.width, dtype=dtype) for a in program.arguments]  # 37: whole vectors and a tail
    same(program, inputs, tmp_path)


def same(program, inputs, folder):
    """Assert that the processors differ in nothing but the order in which fused operations round."""
    dtype = inputs[0].dtype
    for found, here in zip(
        on_arm(program, inputs, folder, dtype == torch.float32), compiled(program, inputs), strict=True
    ):
        assert (found - here).abs().max() <= 2000 * torch.finfo(dtype).eps * here.abs().max()


def test_a_step_of_a_scene_gives_the_same_numbers_on_arm(tmp_path):
    """With roots, exponentials, logarithms and comparisons in it."""
    parts = (effects.Gravity(), effects.Coulomb(1.0), effects.JointLimits(), effects.FirstOrderLag(0.02))
    program = Scene(torchdq.robots.load("panda"), (*parts, effects.Noise(0.1, 0.1))).program()
    torch.manual_seed(0)
    same(program, [torch.rand(37, a.width, dtype=torch.float64) for a in program.arguments], tmp_path)


def test_wild_angles_fall_back_to_the_library_on_arm(tmp_path):
    robot = torchdq.robots.load("two_link")
    program = torchdq.compile(robot, "inverse_dynamics").program
    q = torch.zeros(21, 2, dtype=torch.float64)
    q[3], q[7, 0], q[11, 1] = 1e6, float("inf"), float("nan")
    (found,) = on_arm(program, [q, 0 * q[:1].expand(21, 2).contiguous(), torch.ones_like(q)], tmp_path, False)
    (here,) = compiled(program, [q, torch.zeros_like(q), torch.ones_like(q)])
    torch.testing.assert_close(found, here, rtol=1e-12, atol=1e-12, equal_nan=True)
