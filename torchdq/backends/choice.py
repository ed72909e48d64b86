"""Choice of the backend that runs a program."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal

import torch

from torchdq.backends.backend import Backend
from torchdq.backends.c import COMPILED, COMPILED_OR_EAGER
from torchdq.backends.compiler import BuildError
from torchdq.backends.cuda import CUDA, CUDA_OR_EAGER
from torchdq.backends.torch import EAGER
from torchdq.base.checks import require_choice
from torchdq.base.progress import warn_once
from torchdq.errors import ArgumentError
from torchdq.program.transforms import constant_in_graphs, proxy_tracing, reversing, transforming

BackendName = Literal["auto", "eager", "c", "cuda"]
# by name: the first that can run on the device
BACKENDS: dict[BackendName, tuple[Backend, ...]] = {
    "auto": (COMPILED_OR_EAGER, CUDA_OR_EAGER, EAGER),
    "c": (COMPILED,),
    "cuda": (CUDA,),
    "eager": (EAGER,),
}

_chosen: ContextVar[BackendName] = ContextVar("torchdq_backend", default="auto")


@contextmanager
def backend(name: BackendName) -> Iterator[None]:
    """Context in which functions and modules use this backend, unless their own argument `backend` names another.

    Args:
        name: what runs programs: "c", compiled for the CPU; "cuda", compiled for NVIDIA GPUs; "eager", torch operations
            on any device; "auto", the first of these that can run on the device.
    Raises:
        ArgumentError: there is no such backend.

    >>> import torchdq
    >>> with backend("eager"):
    ...     tau = torchdq.inverse_dynamics(torchdq.robots.load("two_link"), torch.zeros(2))
    """
    token = _chosen.set(_valid(name))
    try:
        yield
    finally:
        _chosen.reset(token)


def _valid(name: BackendName) -> BackendName:
    require_choice("backend", name, tuple(BACKENDS))
    return name


def present() -> BackendName:
    """Backend of the innermost `backend` block, or "auto"."""
    return _chosen.get()


def choose_for_graph(name: BackendName | None, device: torch.device) -> Backend:
    """Backend that runs programs in a traced graph.

    A graph of torch.export is saved and loaded elsewhere, so it consists of torch's own operations. One of make_fx may
    be transformed, and one that is traced in a transform of `torch.func` is, so without a named backend they do too.
    """
    if torch.compiler.is_exporting():
        return _exportable(present() if name is None else _valid(name))
    if (proxy_tracing() or transforming()) and (name or present()) == "auto":
        return EAGER
    return choose(name, device)


def _exportable(name: BackendName) -> Backend:
    """Backend of an exported graph; raises if the graph cannot be exported."""
    if name not in ("auto", "eager"):
        raise ArgumentError(
            f"backend must be 'auto' or 'eager' for torch.export, found {name!r}, whose programs are compiled for this "
            "process; torch.compile takes them, and torchdq.compile(...).export writes them as C"
        )
    if reversing():
        raise ArgumentError(
            "torch.export cannot trace torch.func.grad, vjp, jacrev or hessian; use jvp, or a derivative that is a "
            "program: torchdq.dynamics_jacobian, torchdq.compile(...).vjp()"
        )
    return EAGER


@constant_in_graphs  # a traced graph keeps the backend it was traced with
def choose(name: BackendName | None, device: torch.device) -> Backend:
    """Backend that runs programs on a device; the name None is that of the innermost `backend` block."""
    name = present() if name is None else _valid(name)
    for candidate in BACKENDS[name]:
        refusal = candidate.refusal(device)
        if refusal is None:
            return candidate
        if name != "auto":
            raise refusal
        if isinstance(refusal, BuildError):
            warn_once("compiler", f"torchdq runs its programs as torch operations, which is slower: {refusal}")
    raise ArgumentError(f"no backend runs on the device {device.type!r}")
