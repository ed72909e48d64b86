"""The example of a policy that is learned through the simulation: it learns, and processes share its gradients."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import torch

for needed in ("matplotlib", "tyro"):
    pytest.importorskip(needed, reason="the examples need the extra 'examples'")
from matplotlib.image import imread  # noqa: E402

BACKEND = "auto"
ROOT = Path(__file__).resolve().parents[1]
SHARED = """
import sys
from test_through_the_simulation import found
from torchdq.learning.training.distributed import team
import torch
with team(torch.device("cpu")) as share:
    torch.save(found(share), f"{sys.argv[1]}/{share.rank}.pt")
"""


@pytest.fixture(scope="module")
def example():
    return import_module("11_through_the_simulation")


def found(share):
    """Loss and gradients of an untrained policy, in float64."""
    example = import_module("11_through_the_simulation")
    torch.manual_seed(0)
    policy, q = example.Policy().double(), torch.tensor(example.WANTED).double() + torch.randn(31, 7).double() / 4
    total, gradients = example.gradients(policy, q, example.Args(steps=10), share)
    return [total, *gradients]


def test_it_learns(example, tmp_path, capsys):
    losses = example.main(example.Args(arms=32, iterations=30, out=tmp_path))
    assert losses[-1] < 0.1 * losses[0]
    assert "1 processes on cpu" in capsys.readouterr().out
    assert imread(tmp_path / "through_the_simulation.png")[..., :3].std() > 0.03


def test_two_processes_have_the_gradients_of_one(tmp_path):
    """Of 31 arms, one process has 16."""
    script = tmp_path / "shared.py"
    script.write_text(SHARED)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", script, tmp_path]
    paths = os.pathsep.join(filter(None, [*sys.path, str(ROOT / "tests"), str(ROOT / "examples")]))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": paths}
    started = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert started.returncode == 0, started.stderr
    ranks = [torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1)]
    share = import_module("torchdq.learning.training.distributed").Team()
    for one, two, alone in zip(*ranks, found(share), strict=True):
        assert torch.equal(one, two)
        torch.testing.assert_close(one, alone, rtol=1e-10, atol=1e-12)
