"""Which backend runs a program."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Literal, get_args

import torch

from torchdq.backends import cache as build
from torchdq.errors import ArgumentError

Backend = Literal["auto", "eager", "c"]

_chosen: ContextVar[Backend] = ContextVar("torchdq_backend", default="auto")


@contextmanager
def backend(name: Backend) -> Iterator[None]:
    """Within the block, functions and modules that are not told otherwise use this backend.

    >>> import torchdq
    >>> with backend("eager"):
    ...     tau = torchdq.inverse_dynamics(torchdq.robots.load("two_link"), torch.zeros(2))
    """
    token = _chosen.set(_valid(name))
    try:
        yield
    finally:
        _chosen.reset(token)


def _valid(name: Backend) -> Backend:
    if name not in get_args(Backend):
        raise ArgumentError(f"backend must be one of {', '.join(map(repr, get_args(Backend)))}, found {name!r}")
    return name


@cache
def _without_compiler() -> None:
    warnings.warn(
        "there is no C compiler on the path, so torchdq runs its programs as torch operations, which is slower; "
        "install gcc or clang, or name one in $CC",
        stacklevel=2,
    )


def present() -> Backend:
    """Backend of the innermost `backend` block, or "auto"."""
    return _chosen.get()


@torch.compiler.assume_constant_result  # a traced graph keeps the backend it was traced with
def choose(name: Backend | None, device: str) -> Literal["eager", "c"]:
    """Backend that runs a program on a kind of device."""
    name = _chosen.get() if name is None else _valid(name)
    if name == "c" and device != "cpu":
        raise ArgumentError(f"backend 'c' runs on the CPU, and the arguments are on the device {device!r}")
    if name != "auto":
        return name
    if device != "cpu":
        return "eager"
    if build.compiler() is None:
        _without_compiler()
        return "eager"
    return "c"
