"""Folders of the project, for tests that read its files, and of the recordings, where there are any."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TESTS, BENCHMARKS, EXAMPLES = ROOT / "tests", ROOT / "benchmarks", ROOT / "examples"
PACKAGE, ENVS = ROOT / "torchdq", ROOT / "envs"
DATA = Path(os.environ.get("TORCHDQ_DATA", ROOT.parent / "shared" / "data"))
