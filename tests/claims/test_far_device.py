"""A device that is not the CPU: the claims of `far_device`, which have a process of their own."""

import os
import re
import subprocess
import sys

import pytest
from helpers import thinned
from places import TESTS

from torchdq.backends.compiler import compiler

SCRIPT = TESTS / "tools" / "far_device.py"
CLAIMS = thinned(
    re.findall(r"^def ((?:steps|a)_\w+)\(\):", SCRIPT.read_text(), re.M),
    (
        "steps_with_resets_in_the_same_step",
        "a_step_is_repeated_by_a_graph",
        "a_training_iteration_is_repeated_by_a_graph",
        "a_learned_model_is_trained_without_waiting",
    ),
)

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def outcome():
    """Output of the script by the claim."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [*sys.path, str(SCRIPT.parent)]))}
    run = subprocess.run(
        [sys.executable, SCRIPT, *CLAIMS], env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return dict(re.findall(r"^(\w+): (holds|fails.*?)$(?=\n\w+: |\Z)", run.stdout.strip(), re.M | re.S))


@pytest.mark.parametrize("claim", CLAIMS)
def test_on_a_far_device(claim, outcome):
    assert outcome[claim] == "holds"
