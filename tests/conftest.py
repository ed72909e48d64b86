"""Which backend and which random numbers the tests run on, and how close they come to what they allow.

Tests run operation by operation, unless a test file names another backend as BACKEND. Compiling costs a fraction of a
second for every robot and function, which thousands of random robots do not repay. That the compiled programs give the
same numbers, gradients and errors is the claim of backends/test_backends.py.

What is compiled is compiled with -O0, in a fifth of the time, and on Linux linked to nothing but libm, in half of the
linker's; except for test files with AS_SHIPPED = True and where $TORCHDQ_CFLAGS says otherwise, as in `make test-all`.

A test marked `case("G1")` holds a case of `hard_cases/catalogue.py`, and says by the fixture `margin` what it observed
and what it allows. `pytest --margins FILE` writes both, and their ratio, for every criterion.
"""

import gc
import json
import math
import os
import sys
from pathlib import Path

import messages
import pytest
import torch

import torchdq

os.environ.setdefault("TORCHDQ_CFLAGS", "-O0 -nodefaultlibs" if sys.platform == "linux" else "-O0")
LOOSE = 1e-4  # a criterion that is never approached closer than this says little


# it gives torch a device of its own, and would give it to every other test
collect_ignore = ["tools/far_device.py"]


@pytest.fixture(autouse=True)
def chosen_backend(request):
    # of those that name no generator, whatever ran before; torch.manual_seed also notes for GPUs who called it, slowly
    torch.default_generator.manual_seed(0)
    with torchdq.backend(getattr(request.module, "BACKEND", "eager")):
        yield


@pytest.fixture(autouse=True, scope="module")
def optimised(request):
    """The flags of the package itself, for test files that are about what they make of a program."""
    if not getattr(request.module, "AS_SHIPPED", False):
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHDQ_CFLAGS", "")
        torchdq.clear_caches()
        yield
    torchdq.clear_caches()


@pytest.fixture
def margin(request, record_property):
    """Assert that what is observed is at most what is allowed, and put both on record.

    `margin(observed, allowed, what)`: numbers, and a word for the criterion where a test has several.
    """
    marks = list(request.node.iter_markers("case"))
    assert marks, "a test with margins is marked with the cases that it holds"
    ids = ", ".join(id for mark in marks for id in mark.args)

    def hold(observed, allowed, what: str = "") -> None:
        observed, allowed = float(observed), float(allowed)
        record_property("margin", (ids, what, observed, allowed))
        assert observed <= allowed, f"{ids} {what}: observed {observed:.3g}, allowed {allowed:.3g}"

    return hold


def pytest_addoption(parser):
    parser.addoption("--margins", metavar="FILE", help="write observed and allowed of every criterion to a JSON file")
    parser.addoption("--update-messages", action="store_true", help="write what tests say to messages.json of a room")


def pytest_configure(config):
    config.addinivalue_line("markers", "case(*ids): cases of tests/claims/hard_cases/catalogue.py that a test holds")
    messages.install(config)
    gc.disable()  # until the tests are collected: there is little garbage in a million new objects


def pytest_collection_finish():
    """What is there now stays to the end, so that no collection of garbage visits it again: a tenth of all time."""
    gc.freeze()
    gc.set_threshold(10_000, 10, 100)  # robots and programs that tests share are not visited again and again either
    gc.enable()


def pytest_terminal_summary(terminalreporter, config):
    """The margins of all tests, those of other processes included."""
    found = [
        {"test": report.nodeid, "case": case, "what": what, "observed": observed, "allowed": allowed}
        for reports in terminalreporter.stats.values()
        for report in reports
        for name, value in getattr(report, "user_properties", ())
        if name == "margin" and report.when == "call"
        for case, what, observed, allowed in [value]
    ]
    if not found:
        return
    ratios = [row["observed"] / row["allowed"] if row["allowed"] else math.nan for row in found]
    loose = sum(ratio < LOOSE and row["observed"] > 0 for ratio, row in zip(ratios, found, strict=True))
    terminalreporter.write_line(
        f"margins: {len(found)} criteria, closest {max(ratios, default=0):.2g} of what is allowed, "
        f"{loose} never above {LOOSE:g} of it"
    )
    if config.getoption("--margins"):
        rows = [{**row, "ratio": ratio} for row, ratio in zip(found, ratios, strict=True)]
        rows.sort(key=lambda row: -row["ratio"])
        path = Path(config.getoption("--margins"))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(rows, indent=1))
