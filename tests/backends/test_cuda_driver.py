"""Loading and launching of kernels, with a driver that this machine's C compiler makes and that writes down its calls.

What torch knows of its devices is replaced, so neither a GPU nor torch's CUDA build is needed. Where there is both, a
kernel is launched for real.
"""

import ctypes
import gc
import subprocess
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch
from messages import refused

import torchdq
from torchdq.backends import cuda_driver, nvrtc
from torchdq.backends.compiler import BuildError, compiler
from torchdq.backends.cuda_driver import DriverError, Module
from torchdq.errors import ArgumentError

GPU = torch.cuda.is_available()
pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

# a kernel's name ends with the number of its pointers; `fail` is the status of the function that `failing` names
FAKE = r"""
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
char calls[1<<20];
int fail,slow,mixed;
char failing[64];
static pthread_mutex_t lock=PTHREAD_MUTEX_INITIALIZER;
static int status(const char*name){return strcmp(name,failing)?0:fail;}
#define NOTE(...) {pthread_mutex_lock(&lock);sprintf(calls+strlen(calls),__VA_ARGS__);pthread_mutex_unlock(&lock);}
#define END return status(__func__);
int cuInit(unsigned flags){END}
int cuGetErrorName(int e,char**t){*t=e==999?NULL:"CUDA_ERROR_NAME";return 0;}
int cuGetErrorString(int e,char**t){*t=e==999?NULL:"what happened";return 0;}
int cuDeviceGet(int*d,int k){*d=10+k;END}
int cuDevicePrimaryCtxRetain(void**c,int d){*c=(void*)(long)(100+d);END}
int cuCtxSetCurrent(void*c){NOTE("context %ld\n",(long)c)fail=0;return 0;}
int cuLibraryLoadData(void**l,char*code,void*a,void*b,unsigned n,void*c,void*d,unsigned m){
  NOTE("load %s\n",code)*l=strdup(code);END
}
int cuLibraryUnload(void*l){NOTE("unload %s\n",(char*)l)return 0;}
int cuLibraryGetKernel(void**k,void*l,char*name){NOTE("kernel %s of %s\n",name,(char*)l)*k=strdup(name);END}
int cuLaunchKernel(char*k,unsigned x,unsigned y,unsigned z,unsigned u,unsigned v,unsigned w,unsigned shared,void*stream,
                   long long**arguments,void*extra){
  int n=1+atoi(k+strlen(k)-1);
  char line[999];
  int at=sprintf(line,"launch %s %u,%u,%u x %u,%u,%u shared %u stream %ld:",k,x,y,z,u,v,w,shared,(long)stream);
  for(int i=0;i<n;i++)at+=sprintf(line+at," %lld",*arguments[i]);
  if(slow){
    usleep(500);
    for(int i=1;i<n;i++)if(*arguments[i]!=*arguments[0]+i)mixed++;
  }
  if(status(__func__))return fail;
  NOTE("%s\n",line)
  return 0;
}
"""


def built(text, folder, name):
    """Path of a library."""
    (folder / "driver.c").write_text(text)
    command = [*compiler().command, "-w", "-shared", "-fPIC", "-pthread", "-o", name, "driver.c"]
    subprocess.run(command, cwd=folder, check=True)
    return str(folder / name)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Path of the driver."""
    if GPU:
        pytest.skip("there is a driver")
    return built(FAKE, tmp_path_factory.mktemp("driver"), "libdriver.so")


class Recorder:
    """The driver's notes, and how it shall fail."""

    def __init__(self, library):
        self.opened = library

    def number(self, name):
        return ctypes.c_int.in_dll(self.opened, name)

    def text(self, name, size):
        return (ctypes.c_char * size).in_dll(self.opened, name)

    def calls(self):
        """Calls since the last look."""
        notes = self.text("calls", 1 << 20)
        found = notes.value.decode().splitlines()
        notes.value = b""
        return found

    def fails(self, name, status):
        self.text("failing", 64).value = name.encode()
        self.number("fail").value = status


@pytest.fixture
def driver(library, monkeypatch):
    """A driver, and a torch that is on device 0, where stream 7 is current; on device 1 that is stream 8."""
    monkeypatch.setenv("TORCHDQ_CUDA_DRIVER", library)
    torchdq.clear_caches()
    gc.freeze()  # the collections below look for what is made from here on, not in all that other tests hold
    now = SimpleNamespace(device=0)

    @contextmanager
    def guard(index):
        before, now.device = now.device, index
        yield
        now.device = before

    monkeypatch.setattr(torch.cuda, "current_device", lambda: now.device)
    monkeypatch.setattr(torch.cuda, "device", guard)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    monkeypatch.setattr(cuda_driver, "_stream", lambda index: 7 + index if index == now.device else -1)
    recorder = Recorder(ctypes.CDLL(library))
    recorder.fails("", 0)
    recorder.calls()
    yield recorder
    gc.collect()
    torchdq.clear_caches()


def on(index):
    return torch.device("cuda", index)


def test_arguments_arrive(driver):
    many = 2**40 + 3
    Module(b"code").kernel("run2", 2)(5, 128, many, (2**47 + 1, 12), on(0))
    expected = f"launch run2 5,1,1 x 128,1,1 shared 0 stream 7: {many} {2**47 + 1} 12"
    assert driver.calls()[:3] == ["load code", "kernel run2 of code", expected]


def test_the_largest_launch_and_the_smallest(driver):
    launch = Module(b"code").kernel("run0", 0)
    launch(2**31 - 1, 32, 2**36 - 32, (), on(0))
    launch(0, 32, 0, (), on(0))  # an empty batch
    assert driver.calls()[2:] == [f"launch run0 2147483647,1,1 x 32,1,1 shared 0 stream 7: {2**36 - 32}"]
    with refused(ArgumentError):
        launch(2**31, 32, 2**36, (), on(0))


def test_another_device_is_current_during_the_launch_only(driver):
    launch = Module(b"code").kernel("run0", 0)
    for index in (1, 0):
        launch(1, 32, 4, (), on(index))
    assert [line.split(" shared ")[1] for line in driver.calls()[2:]] == ["0 stream 8: 4", "0 stream 7: 4"]


def test_threads_do_not_mix_their_arguments(driver):
    """The driver reads arguments late, while other threads launch the same kernel."""
    launch = Module(b"code").kernel("run3", 3)
    driver.number("slow").value, driver.number("mixed").value = 1, 0
    firsts = range(0, 64000, 1000)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda k: launch(1, 32, k, (k + 1, k + 2, k + 3), on(0)), firsts))
    driver.number("slow").value = 0
    assert driver.number("mixed").value == 0
    found = {line.split(": ")[1] for line in driver.calls() if line.startswith("launch")}
    assert found == {f"{k} {k + 1} {k + 2} {k + 3}" for k in firsts}


def test_kernels_are_loaded_once_and_unloaded_with_the_last_reference(driver):
    module = Module(b"code")
    launch = module.kernel("run0", 0)
    del module
    for _ in range(3):
        launch(1, 32, 4, (), on(0))
    gc.collect()
    assert [line.split()[0] for line in driver.calls()] == ["load", "kernel", *["launch"] * 3]
    del launch
    gc.collect()
    assert driver.calls() == ["unload code"]


def test_what_a_graph_captured_stays_loaded(driver, monkeypatch):
    monkeypatch.setattr(cuda_driver, "_captured", set())
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    Module(b"captured").kernel("run0", 0)(1, 32, 4, (), on(0))
    gc.collect()
    assert not any("unload" in line for line in driver.calls())


def test_a_thread_without_a_context_gets_that_of_torch(driver):
    driver.fails("cuLaunchKernel", cuda_driver.NO_CONTEXT)
    launch = Module(b"code").kernel("run0", 0)
    launch(1, 32, 4, (), on(1))
    assert [line.split(" x ")[0] for line in driver.calls()[2:]] == ["context 111", "launch run0 1,1,1"]


@pytest.mark.parametrize(
    ("function", "status", "kind"),
    [
        ("cuInit", 100, BuildError),
        ("cuLibraryLoadData", 222, BuildError),
        ("cuLibraryGetKernel", 500, BuildError),
        ("cuLaunchKernel", 700, DriverError),
        ("cuLaunchKernel", 2, DriverError),
        ("cuLaunchKernel", 999, DriverError),
    ],
)
def test_an_error_says_what_to_do(function, status, kind, driver):
    driver.fails(function, status)
    with refused(kind):
        Module(b"code").kernel("run0", 0)(3, 32, 90, (), on(0))
    driver.fails("", 0)
    Module(b"code").kernel("run0", 0)(3, 32, 90, (), on(0))


def test_a_wrong_number_of_pointers_is_an_error(driver):
    with refused(ValueError):
        Module(b"code").kernel("run2", 2)(1, 32, 4, (1,), on(0))
    assert not any(line.startswith("launch") for line in driver.calls())


def test_without_a_driver_or_with_an_old_one_an_error_says_so(tmp_path, monkeypatch):
    torchdq.clear_caches()
    for path in (str(tmp_path / "nowhere.so"), built("int cuInit(unsigned f){return 0;}", tmp_path, "old.so")):
        monkeypatch.setenv("TORCHDQ_CUDA_DRIVER", path)
        with refused(BuildError):
            Module(b"code")
    torchdq.clear_caches()


def test_the_stream_by_torch_s_public_function(monkeypatch):
    monkeypatch.setattr(torch.cuda, "current_stream", lambda index: SimpleNamespace(cuda_stream=40 + index))
    assert cuda_driver._public_stream(2) == 42


# --- on a GPU --------------------------------------------------------------------------------------------------------

SCALE = """
extern "C" __global__ void scale(long long samples,const double*x,double*y){
  __shared__ double row[128];
  const long long b=blockIdx.x*(long long)blockDim.x+threadIdx.x;
  row[threadIdx.x]=b<samples?x[b]:0;
  __syncthreads();
  if(b<samples)y[b]=3*row[threadIdx.x];
}
"""


@pytest.mark.skipif(not GPU or isinstance(nvrtc.found(), str), reason="there is no GPU, or no NVRTC")
def test_a_kernel_runs_on_every_gpu_from_every_thread_and_in_a_graph():
    major, minor = torch.cuda.get_device_capability()
    launch = Module(nvrtc.found().compile(SCALE, "scale", 10 * major + minor).code).kernel("scale", 2)

    def scaled(index):
        x = torch.arange(1000, dtype=torch.float64, device=on(index))
        y = torch.empty_like(x)
        launch(-(-1000 // 128), 128, 1000, (x.data_ptr(), y.data_ptr()), on(index))
        return torch.equal(y, 3 * x)

    assert all(scaled(index) for index in range(torch.cuda.device_count()))
    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(scaled, [0] * 16))
    x = torch.ones(1000, dtype=torch.float64, device=on(0))
    y, graph = torch.zeros_like(x), torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        launch(8, 128, 1000, (x.data_ptr(), y.data_ptr()), on(0))
    x.fill_(5.0)
    graph.replay()
    assert torch.equal(y, 3 * x)
