"""Backends and precisions that hard cases are computed with."""

import pytest
import torch
from helpers import thinned

from torchdq.backends import c_library as build

F32, F64 = torch.float32, torch.float64
NAMES = {F64: "f64", F32: "f32"}

compiler = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")
C = pytest.param("c", marks=compiler)
every_backend = pytest.mark.parametrize("backend", ["eager", C])
compiled = pytest.mark.parametrize("backend", [C])
every_dtype = pytest.mark.parametrize("dtype", [F64, F32], ids=NAMES.get)


def of_backends_and_dtypes(*kept):
    """Parameters `backend` and `dtype`: those that are kept, and in `make test-all` all four pairs."""
    pairs = thinned([(backend, dtype) for backend in ("eager", "c") for dtype in (F64, F32)], kept)
    marks = {"eager": (), "c": compiler}
    params = [pytest.param(b, dtype, marks=marks[b], id=f"{b}-{NAMES[dtype]}") for b, dtype in pairs]
    return pytest.mark.parametrize("backend, dtype", params)


# that compiled programs compute what operations do is the claim of backends/test_backends.py
every_backend_and_dtype = of_backends_and_dtypes(("eager", F64), ("eager", F32))
single_compiled = of_backends_and_dtypes(("eager", F64), ("c", F32))  # for rows that are mended, and for many steps
eager_first = pytest.mark.parametrize("backend", thinned(["eager", C], ("eager",)))
