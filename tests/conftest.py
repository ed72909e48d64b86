"""Which backend the tests run on: operation by operation, unless a test file names another as BACKEND.

Compiling costs a fraction of a second for every robot and function, which thousands of random robots do not repay. That
the compiled programs give the same numbers, gradients and errors is the claim of test_backends.py.
"""

import pytest

import torchdq


@pytest.fixture(autouse=True)
def chosen_backend(request):
    with torchdq.backend(getattr(request.module, "BACKEND", "eager")):
        yield
