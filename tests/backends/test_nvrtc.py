"""NVRTC: where it is found, how it is asked, and what it compiles.

Where it is found and how it is asked is tested with libraries that this machine's C compiler makes, of versions that do
not exist. What it compiles is tested where the wheel nvidia-cuda-nvrtc is installed; neither needs a GPU.
"""

import ctypes
import itertools
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from messages import refused, warned

import torchdq
from torchdq.backends import cache, nvrtc
from torchdq.backends.compiler import BuildError, compiler
from torchdq.backends.nvrtc import Usage, usage
from torchdq.base import system

# compiles nothing: the log is the source, or its second part with less optimisation; the code is the options
FAKE = """
#include <stdlib.h>
#include <string.h>
typedef struct{char*source;char options[999];}Program;
int alive;
#define TEXT(name,value) \\
  int nvrtcGet##name##Size(Program*p,size_t*n){*n=strlen(value)+1;return 0;} \\
  int nvrtcGet##name(Program*p,char*to){strcpy(to,value);return 0;}
static char*written(Program*p){
  char*next=strchr(p->source,'\\f');
  if(next&&strstr(p->options,"-O1"))return next+1;
  if(next)*next=0;
  return p->source;
}
static char*code(Program*p,char*kind){static char all[1099];return strcat(strcpy(all,kind),p->options);}
TEXT(ProgramLog,written(p))
TEXT(CUBIN,code(p,"cubin"))
TEXT(PTX,code(p,"ptx"))
int nvrtcVersion(int*major,int*minor){*major=MAJOR;*minor=4;return 0;}
int nvrtcGetNumSupportedArchs(int*n){*n=2;return 0;}
int nvrtcGetSupportedArchs(int*known){known[0]=80;known[1]=90;return 0;}
char*nvrtcGetErrorString(int status){return status==6?"NVRTC_ERROR_COMPILATION":"NVRTC_ERROR_OUT_OF_MEMORY";}
int nvrtcCreateProgram(Program**p,char*source,char*name,int n,void*a,void*b){
  if(!*source)return 1;
  alive++;*p=calloc(1,sizeof**p);(*p)->source=strdup(source);return 0;
}
int nvrtcDestroyProgram(Program**p){alive--;free((*p)->source);free(*p);return 0;}
int nvrtcCompileProgram(Program*p,int n,char**options){
  for(int i=0;i<n;i++)strcat(strcat(p->options," "),options[i]);
  return strstr(p->source,"error")?6:0;
}
"""
NAMES = ("libnvrtc.so.98", "libnvrtc-builtins.so.98.4")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, Path]:
    """Both libraries of versions 98.4, 97.4 and 96.4, of which the last say their names to the loader."""
    if compiler() is None or sys.platform != "linux":
        pytest.skip("there is no C compiler, or this is not Linux")
    folder = tmp_path_factory.mktemp("made")
    (folder / "fake.c").write_text(FAKE)
    (folder / "empty.c").write_text("int builtins;")
    for version, name in itertools.product((98, 97, 96), NAMES):
        library, source = name.replace("98", f"{version}"), "empty.c" if "builtins" in name else "fake.c"
        options = ["-w", f"-DMAJOR={version}", "-shared", "-fPIC", "-o", library, source]
        options += [f"-Wl,-soname,{library}"] if version == 96 else []
        subprocess.run([*compiler().command, *options], cwd=folder, check=True)
    return {path.name: path for path in folder.glob("lib*")}


@pytest.fixture
def machine(tmp_path, monkeypatch) -> Path:
    """Folder of a machine that has no NVRTC, whose torch is for no version of CUDA."""
    for name in ("TORCHDQ_NVRTC", "CONDA_PREFIX", "CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "torch").mkdir()
    monkeypatch.setattr(torch, "__file__", str(tmp_path / "torch" / "__init__.py"))
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setattr(sys, "path", [str(tmp_path / "site")])
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "prefix"))
    monkeypatch.setattr(nvrtc, "ROOT", tmp_path)
    monkeypatch.setattr(nvrtc, "MAJORS", (98, 97))
    torchdq.clear_caches()
    yield tmp_path
    torchdq.clear_caches()


def put(folder: Path, made, names=NAMES) -> Path:
    """Copies of libraries in a folder; the first one."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        shutil.copy(made[name], folder)
    return folder / names[0]


def search():
    return nvrtc.found.__wrapped__()


# --- where it is found -----------------------------------------------------------------------------------------------

# folder, and the variables that lead to it
LAYOUTS = {
    "wheel beside torch": ("nvidia/cu98/lib", {}),
    "older wheel beside torch": ("nvidia/cuda_nvrtc/lib", {}),
    "within torch": ("torch/lib", {}),
    "wheel elsewhere": ("site/nvidia/cu98/lib", {}),
    "older wheel elsewhere": ("site/nvidia/cuda_nvrtc/lib", {}),
    "conda": ("conda/lib", {"CONDA_PREFIX": "conda"}),
    "conda, by target": ("conda/targets/x86_64-linux/lib", {"CONDA_PREFIX": "conda"}),
    "conda, not activated": ("prefix/lib", {}),
    "CUDA_HOME": ("toolkit/lib64", {"CUDA_HOME": "toolkit"}),
    "CUDA_PATH": ("toolkit/lib64", {"CUDA_PATH": "toolkit"}),
    "toolkit": ("usr/local/cuda/lib64", {}),
    "toolkit with its version": ("usr/local/cuda-98.4/lib64", {}),
    "toolkit by target": ("usr/local/cuda/targets/sbsa-linux/lib", {}),
    "Arch": ("opt/cuda/lib64", {}),
    "Debian": ("usr/lib/x86_64-linux-gnu", {}),
    "Fedora": ("usr/lib64", {}),
    "the folder that is named": ("mine", {"TORCHDQ_NVRTC": "mine"}),
    "the toolkit that is named": ("mine/lib64", {"TORCHDQ_NVRTC": "mine"}),
    "the file that is named": ("mine", {"TORCHDQ_NVRTC": "mine/libnvrtc.so.98"}),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_it_is_found_with_its_second_library(layout, machine, made, monkeypatch):
    folder, environment = LAYOUTS[layout]
    for name, value in environment.items():
        monkeypatch.setenv(name, str(machine / value))
    library = put(machine / folder, made)
    found = search()
    assert (found.path, found.version) == (str(library), (98, 4))
    assert str(library.with_name(NAMES[1])) in Path("/proc/self/maps").read_text()


def test_every_place_goes_before_the_next(machine, made, monkeypatch):
    """Each is found while those after it have one too."""
    wheels = ("wheel beside torch", "wheel elsewhere")
    kinds = ("the file that is named", *wheels, "conda", "CUDA_HOME", "toolkit", "Debian")
    for kind in kinds:
        for name, value in LAYOUTS[kind][1].items():
            monkeypatch.setenv(name, str(machine / value))
        put(machine / LAYOUTS[kind][0], made)
    for kind in kinds:
        assert search().path == str(machine / LAYOUTS[kind][0] / NAMES[0])
        shutil.rmtree(machine / LAYOUTS[kind][0])
        monkeypatch.delenv("TORCHDQ_NVRTC", raising=False)


def of(version: int) -> list[str]:
    """Names of both libraries of a version."""
    return [name.replace("98", f"{version}") for name in NAMES]


def test_what_the_loader_knows_goes_before_packages(machine, made, monkeypatch):
    """It knows the names of libraries that are loaded."""
    monkeypatch.setattr(nvrtc, "MAJORS", (96,))
    put(machine / "site/nvidia/cu96/lib", made, of(96))
    for name in of(96):
        ctypes.CDLL(str(made[name]))
    assert search().path == "libnvrtc.so.96"


def test_the_version_of_torch_goes_before_newer_ones_wherever_they_are(machine, made, monkeypatch):
    older = put(machine / "usr/lib64", made, of(97))
    newer = put(machine / "nvidia/cu98/lib", made)
    assert search().path == str(newer)
    monkeypatch.setattr(torch.version, "cuda", "97.1")
    assert search().path == str(older)


SPOILED = {
    "no second library": (lambda bad, made: bad.with_name(NAMES[1]).unlink(), "lacks its second library"),
    "no library": (lambda bad, made: bad.write_bytes(b"hello"), "is no NVRTC"),
    "another library": (lambda bad, made: shutil.copy(made[NAMES[1]], bad), "is no NVRTC"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_one_that_cannot_be_used_is_passed_over(name, machine, made):
    bad, good = put(machine / "nvidia/cu98/lib", made), put(machine / "usr/lib64", made)
    spoil, reason = SPOILED[name]
    spoil(bad, made)
    assert search().path == str(good)
    shutil.rmtree(good.parent)
    assert f"(not usable: {bad} {reason}" in search()


def test_without_one_the_reason_says_what_to_do(machine, monkeypatch):
    said = search()
    assert "no libnvrtc.so.98 or libnvrtc.so.97 that can be used" in said and "\n" not in said
    assert "pip install nvidia-cuda-nvrtc'" in said and "$TORCHDQ_NVRTC" in said
    monkeypatch.setattr(torch.version, "cuda", "12.6")
    monkeypatch.setattr(nvrtc, "_candidates", lambda: ())
    assert "pip install nvidia-cuda-nvrtc-cu12'" in search()
    monkeypatch.setattr(system, "NVRTC", "")  # on macOS
    assert "Linux and Windows only" in search()


@pytest.mark.parametrize("name", ["nowhere", "occupied"])
def test_a_named_one_that_cannot_be_used_is_replaced_by_another_with_a_warning(name, machine, made, monkeypatch):
    (machine / "occupied").write_text("no library")
    other = put(machine / "usr/lib64", made)
    monkeypatch.setenv("TORCHDQ_NVRTC", str(machine / name))
    with warned(UserWarning):
        assert search().path == str(other)


# --- how it is asked -------------------------------------------------------------------------------------------------


@pytest.fixture
def fake(machine, made) -> nvrtc.Nvrtc:
    """NVRTC that compiles nothing."""
    return nvrtc.Nvrtc(str(put(machine / "usr/lib64", made)))


def alive(library: nvrtc.Nvrtc) -> int:
    """Number of programs that it has in memory."""
    return ctypes.c_int.in_dll(library._library, "alive").value


def options_of(compiled: nvrtc.Compiled) -> tuple[str, list[str]]:
    """Kind of code, and options that it was compiled with."""
    kind, *options = compiled.code.rstrip(b"\0").decode().split()
    return kind, options


@pytest.mark.parametrize(
    ("architecture", "kind", "target"),
    [(80, "cubin", "sm_80"), (86, "ptx", "compute_80"), (100, "ptx", "compute_90")],
)
def test_machine_code_is_compiled_for_known_architectures_and_text_for_those_between(architecture, kind, target, fake):
    """Text is that of the newest architecture before it."""
    assert fake.architectures == (80, 90)
    found = fake.compile("source", "scale", architecture)
    assert options_of(found) == (kind, [f"--gpu-architecture={target}", *nvrtc.FLAGS])
    assert found.code.endswith(b"\0")  # by which the driver knows where text ends


FAILURES = {
    "a GPU that is too old": ("source", 75),
    "a long log": ("\n".join(f"line {k}: error" for k in range(100)), 90),
    "no program": ("", 90),
}


@pytest.mark.parametrize("name", FAILURES)
def test_an_error_names_the_program_with_the_first_lines_of_the_log_and_no_program_stays_in_memory(name, fake):
    source, architecture = FAILURES[name]
    with refused(BuildError):
        fake.compile(source, "scale", architecture)
    fake.compile("source", "scale", 90)
    assert alive(fake) == 0


def said(registers: int, stack: int, spilled: int = 0) -> str:
    """Log of one kernel."""
    return (
        "ptxas info    : Compiling entry function 'run' for 'sm_90'\n"
        "ptxas info    : Function properties for run\n"
        f"ptxas         .     {stack} bytes stack frame, 0 bytes spill stores, {spilled} bytes spill loads\n"
        f"ptxas info    : Used {registers} registers, used 0 barriers\n"
    )


@pytest.mark.parametrize(
    "first, second, again",
    [
        (said(32, 24000), said(255, 7000, 9000), True),
        (said(32, 24000), said(255, 25000), False),
        (said(255, 24000), said(255, 7000), False),
        (said(32, 1000), said(255, 0), False),
    ],
    ids=["less stack", "more stack", "registers in use", "short program"],
)
def test_where_registers_are_not_allocated_less_optimisation_is_tried(fake, first, second, again):
    found = fake.compile(f"{first}\f{second}", "scale", 90)
    assert found.log == (second if again else first) and (nvrtc.CALMER in options_of(found)[1]) == again
    assert (found.registers, found.spilled, found.stack) == usage(found.log)["run"]


def test_code_is_kept_by_all_that_it_depends_on(fake, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHDQ_CACHE", str(tmp_path / "kept"))
    code = fake.load("source", "scale", 80)
    assert code == fake.compile("source", "scale", 80).code
    changes = (("source", "other"), (80, 90), ((98, 4), (98, 5)))
    keys = set()
    for source, architecture, version in itertools.product(*changes):
        fake.version = version
        keys.add(fake.key(source, architecture))
    assert len(keys) == 8
    fake.version = (98, 4)
    monkeypatch.setattr(fake, "compile", None)
    assert fake.load("source", "scale", 80) == code
    assert [path.suffix for path in cache.directory().iterdir()] == [".cubin"]


# --- registers and memory --------------------------------------------------------------------------------------------

LOG_12 = """\
ptxas info    : 24 bytes gmem, 8 bytes cmem[4]
ptxas info    : Compiling entry function 'mends' for 'sm_80'
ptxas info    : Function properties for mends
ptxas         .     5864 bytes stack frame, 8444 bytes spill stores, 12716 bytes spill loads
ptxas info    : Used 32 registers, used 0 barriers, 5864 bytes cumulative stack size, 376 bytes cmem[0]
ptxas info    : Compile time = 1408.194 ms
ptxas info    : Compiling entry function 'run' for 'sm_80'
ptxas info    : Function properties for run
ptxas         .     32 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 18 registers, used 0 barriers, 32 bytes cumulative stack size, 376 bytes cmem[0], 8 bytes cmem[2]
ptxas info    : Function properties for _ZN36_INTERNAL_00000000_10_program_cu_run4wildEf
ptxas         .     0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
"""
LOG_13 = """\
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'second' for 'sm_90'
ptxas info    : Function properties for second
ptxas         .     800 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 32 registers, used 0 barriers, 800 bytes cumulative stack size
ptxas info    : Compile time = 45.716 ms
ptxas info    : Compiling entry function 'run' for 'sm_90'
ptxas info    : Function properties for run
ptxas         .     0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 23 registers, used 1 barriers, 256 bytes smem
ptxas info    : Compile time = 8.210 ms
"""


def test_registers_and_memory_of_every_kernel_are_read_from_the_logs_of_both_versions():
    assert usage(LOG_12) == {"mends": Usage(32, 12716, 5864), "run": Usage(18, 0, 32)}
    assert usage(LOG_13) == {"second": Usage(32, 0, 800), "run": Usage(23, 0, 0)}
    assert usage("") == {}


# --- what it compiles ------------------------------------------------------------------------------------------------

SMALL = """
extern "C" __global__ void __launch_bounds__(64) run(long long samples,const float*__restrict__ x,float*__restrict__ y){
  __shared__ float row[64];
  const long long b=blockIdx.x*64LL+threadIdx.x;
  row[threadIdx.x]=b<samples?sinf(x[b]):0;
  __syncthreads();
  if(b<samples)y[b]=row[63-threadIdx.x];
}
"""
# more values at once than there are registers, which ptxas 12.9, 13.0 and 13.5 give up to allocate
MANY = """
extern "C" __global__ void __launch_bounds__(64) run(long long n,const double*__restrict__ x,double*__restrict__ out){
  double y[150],s=0;
  const long long b=blockIdx.x*64LL+threadIdx.x;
  for(int k=0;k<150;k++)y[k]=x[b+k*n];
  #pragma unroll
  for(int k=0;k<150;k++)for(int j=0;j<3;j++)y[k]+=y[(k*37+j*11)%150]*s,s+=y[k];
  out[b]=s;
}
"""


@pytest.fixture(scope="module")
def real() -> nvrtc.Nvrtc:
    """NVRTC of this machine."""
    library = nvrtc.found()
    if isinstance(library, str):
        pytest.skip(library)
    return library


def test_a_kernel_is_compiled_without_a_gpu_and_an_error_in_its_source_is_shown(real):
    for architecture in (80, 90):
        found = real.compile(SMALL, "small", architecture)
        assert found.code.startswith(b"\x7fELF") and b"run" in found.code
        assert 8 <= found.registers <= 64 and found.spilled == 0 and "'run'" in found.log
    found = real.compile(SMALL, "small", 9990)  # text for a GPU that is newer than the compiler
    assert f".target sm_{real.architectures[-1]}" in found.code.decode() and found.registers == 0
    with pytest.raises(BuildError, match='identifier "x" is undefined'):
        real.compile("__device__ int f(){return x;}", "bad", 90)


def test_a_kernel_of_too_many_values_uses_all_registers(real):
    found = real.compile(MANY, "many", 80)
    assert found.registers > 200 and found.stack < nvrtc.LARGE
