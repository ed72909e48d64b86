"""Backends: what runs a program on tensors.

run        the one function by which callers run a program
choice     which backend runs on a device: the registry, and the name a user gives
backend    what a backend is
c          compiled for the processor: c_prelude and c_source print, cache builds and keeps, threads share a batch
torch      torch's own operations, on any device
precision  rows whose rounding errors grow too far, recomputed in float64

A new backend is one file with an object, and its entry in `choice.BACKENDS`.
"""
