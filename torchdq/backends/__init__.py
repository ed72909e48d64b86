"""Backends: execution of programs on tensors.

call       from named tensors to a program, or a loop over it, and back; loop_call repeats a computation
precision  the function by which callers run a program, and recomputation in float64 of rows whose rounding errors are
           too large
choice     list of backends, and choice of one by name and device
backend    interface of a backend
emitter    the operations of a program as text, in any dialect
c          compiled C on the CPU: c_source prints values, c_loop and c_prelude what is around them, compiler runs the
           compiler, c_library makes functions of it, threads share a batch
cuda       CUDA C++ on NVIDIA GPUs: cuda_prelude, cuda_source and cuda_loop print it, nvrtc compiles it, cuda_driver
           launches it, cuda_kernel makes functions of it
cache      compiled programs on disk
torch      torch's own operations, on any device

A new backend is one file with an object, and its entry in `choice.BACKENDS`.
"""
