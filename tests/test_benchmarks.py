"""Every benchmark starts: what it imports exists."""

import json
import os
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
SCRIPTS = [file for file in sorted(FOLDER.glob("*.py")) if "__main__" in file.read_text()]
# all in one process, since importing torch takes longer than all of them
HELP = """
import contextlib, io, json, runpy, sys, traceback
said = {}
for script in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        sys.argv, code = [script, "--help"], "no end"
        try:
            runpy.run_path(script, run_name="__main__")
        except SystemExit as end:
            code = end.code
        except Exception:
            code = traceback.format_exc()
    said[script] = [code, out.getvalue()]
print(json.dumps(said))
"""


def test_benchmarks_print_their_help():
    found = subprocess.run(
        [sys.executable, "-c", HELP, *map(str, SCRIPTS)],
        capture_output=True,
        text=True,
        cwd=FOLDER.parent,
        env=os.environ | {"PYTHONPATH": str(FOLDER)},
    )
    assert found.returncode == 0, found.stderr
    for script, (code, out) in json.loads(found.stdout).items():
        assert not code, f"{script}: {code}"
        assert "usage" in out, script


def test_there_are_benchmarks():
    assert {"peers", "envs", "formulations", "accuracy_vs_time"} <= {file.stem for file in SCRIPTS}
