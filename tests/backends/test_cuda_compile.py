"""Kernels of the GPU backend, compiled for GPUs without one: registers, spills, and the same text for AMD's compiler.

Registers and spilled bytes are those of one version of the compiler, and of the architecture sm_90; other versions are
only asked to compile. To write the table again: python tests/backends/test_cuda_compile.py --write
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers import all_in_one, thinned
from kinds_of_programs import PROGRAMS

from torchdq.backends import nvrtc
from torchdq.backends.cuda_source import marks, recomputing_source, source
from torchdq.program.order import alive, listed, narrowest, recorded

TABLE = Path(__file__).with_name("gpu_registers.json")
F32, F64 = torch.float32, torch.float64
FEW = (
    "panda/inverse_dynamics",
    "panda/inverse_dynamics vjp",
    "panda/forward_dynamics",
    "panda/forward_dynamics vjp",
    "panda/inverse_dynamics_jacobian",
    "panda/closed_form tip",
    "panda/forward_kinematics",
    "Reach/panda",
    "Track/ur10e",
)
SPILLED = 64  # most bytes that a program of an arm spills in float32; one that flies has six degrees of freedom more

compiler = nvrtc.found()
needs_nvrtc = pytest.mark.skipif(isinstance(compiler, str), reason="no NVRTC: pip install nvidia-cuda-nvrtc")


def figures(key: str, architecture: int = 90) -> dict[str, list[int]]:
    """Registers and spilled bytes of every kernel of a program."""
    program = PROGRAMS[key]()
    texts = {"float32": source(program, True), "float64": source(program, False)}
    if marks(program, True):
        texts["recomputed"] = recomputing_source(program)
    built = {name: compiler.compile(text, key, architecture) for name, text in texts.items()}
    return {name: [kernel.registers, kernel.spilled] for name, kernel in built.items()}


@needs_nvrtc
@pytest.mark.parametrize(
    ("key", "architecture"),
    thinned(
        [(key, architecture) for key in PROGRAMS for architecture in (80, 90)],
        [("panda/forward_dynamics", 90)],  # scenes are those of test_cuda_loop.py
    ),
)
def test_programs_compile_and_those_of_arms_stay_in_registers(key, architecture):
    found = figures(key, architecture)
    if not key.startswith("study") and "/floating." not in key and "linearization" not in key:
        assert found["float32"][1] <= SPILLED
    table = json.loads(TABLE.read_text())
    if architecture == 90 and key in FEW and table["version"] == list(compiler.version):
        for name, row in found.items():
            assert all(x <= limit for x, limit in zip(row, table["kernels"][key][name], strict=True)), (name, row)


@all_in_one(thinned(PROGRAMS, FEW[::3]))
def test_orders_hold_every_value_once_after_its_operands(key):
    program = PROGRAMS[key]()
    for order in (recorded(program), listed(program)):
        assert sorted(order) == list(range(len(program.ops)))
        place = {i: at for at, i in enumerate(order)}
        for i, op in enumerate(program.ops):
            assert all(place[k] < place[i] for k in op.operands)


def test_the_narrowest_order_keeps_the_fewest_values_alive():
    for key in thinned(FEW, FEW[::3]):
        program = PROGRAMS[key]()
        counts = [alive(program, order) for order in (recorded(program), listed(program))]
        assert alive(program, narrowest(program)) == min(counts)


# what AMD's run-time compiler brings along
HIP = """
#define __device__ __attribute__((device))
#define __global__ __attribute__((global))
#define __shared__ __attribute__((shared))
#define __forceinline__ inline __attribute__((always_inline))
#define __noinline__ __attribute__((noinline))
#define __launch_bounds__(n) __attribute__((amdgpu_flat_work_group_size(1,n)))
struct Index{unsigned x;};
#define threadIdx (Index{__builtin_amdgcn_workitem_id_x()})
#define blockIdx (Index{__builtin_amdgcn_workgroup_id_x()})
static __device__ void __syncthreads(){__builtin_amdgcn_s_barrier();}
static __device__ int __float_as_int(float x){return __builtin_bit_cast(int,x);}
static __device__ float __int_as_float(int x){return __builtin_bit_cast(float,x);}
static __device__ long long __double_as_longlong(double x){return __builtin_bit_cast(long long,x);}
static __device__ double __longlong_as_double(long long x){return __builtin_bit_cast(double,x);}
extern "C" __device__ void sincosf(float,float*,float*);extern "C" __device__ void sincos(double,double*,double*);
extern "C" __device__ float expf(float);extern "C" __device__ double exp(double);
extern "C" __device__ float logf(float);extern "C" __device__ double log(double);
static __device__ float sqrtf(float x){return __builtin_sqrtf(x);}
static __device__ double sqrt(double x){return __builtin_sqrt(x);}
static __device__ float floorf(float x){return __builtin_floorf(x);}
static __device__ double floor(double x){return __builtin_floor(x);}
"""
AMD = ("clang", "-x", "hip", "--cuda-device-only", "--offload-arch=gfx90a", "-nogpuinc", "-nogpulib", "-O1", "-w")


def amd_compiler() -> bool:
    """Whether there is a clang with AMD's target."""
    if shutil.which("clang") is None:
        return False
    targets = subprocess.run(["clang", "-print-targets"], capture_output=True, text=True, check=False).stdout
    return "amdgcn" in targets


@pytest.mark.skipif(not amd_compiler(), reason="no clang with AMD's target")
@pytest.mark.parametrize("single", [True, False], ids=["float32", "float64"])
@pytest.mark.parametrize("key", ["panda/inverse_dynamics", "panda/forward_dynamics vjp"])
def test_the_same_text_is_hip(key, single, tmp_path):
    program = PROGRAMS[key]()
    for number, text in enumerate([source(program, single), recomputing_source(program)][: 1 + marks(program, single)]):
        path = tmp_path / f"{number}.hip"
        path.write_text(HIP + text)
        subprocess.run([*AMD, "-S", "-o", tmp_path / "kernel.s", path], check=True)
        assert "amdhsa_kernel run" in (tmp_path / "kernel.s").read_text()


if __name__ == "__main__" and "--write" in sys.argv:
    rows = {key: figures(key) for key in FEW}
    TABLE.write_text(json.dumps({"version": list(compiler.version), "kernels": rows}, indent=1) + "\n")
