"""A device that is not the CPU: the claims of `far_device`, which have a process of their own."""

import os
import re
import subprocess
import sys

import pytest
from places import TESTS

from torchdq.backends.compiler import compiler

SCRIPT = TESTS / "tools" / "far_device.py"
CLAIMS = re.findall(r"^def ((?:steps|a)_\w+)\(\):", SCRIPT.read_text(), re.M)

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def outcome():
    """Output of the script by the claim."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [*sys.path, str(SCRIPT.parent)]))}
    run = subprocess.run([sys.executable, SCRIPT], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return dict(re.findall(r"^(\w+): (holds|fails.*?)$(?=\n\w+: |\Z)", run.stdout.strip(), re.M | re.S))


@pytest.mark.parametrize("claim", CLAIMS)
def test_on_a_far_device(claim, outcome):
    assert outcome[claim] == "holds"
