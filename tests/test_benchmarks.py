"""Every benchmark starts: what it imports exists."""

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
SCRIPTS = [file for file in sorted(FOLDER.glob("*.py")) if "__main__" in file.read_text()]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda file: file.stem)
def test_a_benchmark_prints_its_help(script):
    found = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True, cwd=FOLDER.parent)
    assert found.returncode == 0, found.stderr
    assert "usage" in found.stdout


def test_there_are_benchmarks():
    assert {"peers", "envs", "formulations", "accuracy_vs_time"} <= {file.stem for file in SCRIPTS}
