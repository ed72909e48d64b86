"""Accuracy against time: errors against verified references, beside the time they take, on one thread.

    python benchmarks/accuracy_vs_time.py [--quick] [--full] [--scene NAME ...] [--json FILE] [--page] [--again]

Trajectories by integrator, precision and step; forward dynamics by algorithm, precision and number of joints;
gradients; effects; energy over a long time; products of poses; exponential and logarithm; backends; a motion and a
gradient in other packages. Writes the results, six plots and the numbers of docs/accuracy.md. `--again` measures
nothing: it writes them again from the results.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import front_page
import report
import torch
from accuracy import (
    backends,
    effects,
    energy,
    findings,
    forward,
    gradients,
    maps,
    peers,
    plots,
    poses,
    recommended,
    references,
    table,
    trajectories,
)
from accuracy.scenes import CASES

FOLDER = Path(__file__).parent / "results"
SLOW = {"chain42": "the references of 42 joints take minutes (--quick; name it by --scene)"}


def truth(name: str) -> references.Truth:
    """Reference of a scene, in a process of its own."""
    torch.set_num_threads(1)
    return references.truth(CASES[name]())


def commit() -> str:
    """Commit that is measured, if git knows."""
    try:
        found = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return found.stdout.strip()


def measured(arguments: argparse.Namespace) -> dict[str, Any]:
    """All results, as the arguments ask for them."""
    start, quick = time.perf_counter(), arguments.quick

    def said(what: str) -> None:
        print(f"{time.perf_counter() - start:6.0f} s  {what}", file=sys.stderr, flush=True)

    names = arguments.scene or [name for name in CASES if not (quick and name in SLOW)]
    results: dict[str, Any] = {
        "machine": report.machine("scipy", "mpmath", "mujoco", *(x for x in ("torchdiffeq",) if find_spec(x))),
        "commit": commit(),
        "flags": [x for x in sys.argv[1:] if x.startswith("--")],
        "omitted": [f"{name}: {why}" for name, why in SLOW.items() if name not in names and not arguments.scene],
    }
    said("references")
    # nothing is timed yet, so they may use all cores; the longest first
    order = sorted(names, key=lambda name: -CASES[name]().robot.n)
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        truths = dict(zip(order, pool.map(truth, order), strict=True))
    results["trajectories"] = []
    with torch.no_grad():
        for name in names:
            said(f"trajectories: {name}")
            results["trajectories"].append(trajectories.measured(CASES[name](), truths[name], quick))
    if not arguments.scene:
        others = {
            "gradients": gradients.measured,
            "effects": effects.measured,
            "energy": energy.measured,
            "poses": poses.measured,
            "maps": maps.measured,
            "backends": backends.measured,
            "forward_dynamics": lambda quick: forward.measured(quick, arguments.full),
            "peers": lambda quick: peers.measured(quick, truths["arm7"]),
        }
        for name, of in others.items():
            said(name.replace("_", " "))
            results[name] = of(quick)
        said("recommended")
        results["recommended"] = recommended.measured(results["trajectories"])
    said("done")
    results["seconds"] = time.perf_counter() - start
    return results


def main() -> None:
    """The study, measured or read, and what follows from it: printed, plotted, and written into its page."""
    parser = report.parser(__doc__, quick="fewer steps, sizes and repeats: three minutes")
    parser.add_argument("--full", action="store_true", help="forward dynamics of up to 1000 joints also with --quick")
    parser.add_argument("--scene", nargs="+", choices=list(CASES), help="only these trajectories, and nothing else")
    parser.add_argument("--plots", type=Path, default=FOLDER / "accuracy", help="folder of the plots")
    parser.add_argument("--again", action="store_true", help="measure nothing; take the results of the JSON file")
    parser.set_defaults(json=FOLDER / "accuracy.json")
    arguments = parser.parse_args()
    if arguments.page and arguments.scene:
        parser.error("--page needs all scenes, leave out --scene")
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", message=".*moves no inertia.*")
    results = json.loads(arguments.json.read_text()) if arguments.again else measured(arguments)
    found = table.advice(results)
    results |= {"dominated": table.dominated(results), "crossovers": table.crossovers(results), "table": found}
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    report.into_json(arguments.json, **results)
    files = plots.draw(results, arguments.plots)
    if results.get("peers"):
        peers.PICTURE.write_text(peers.picture(results["peers"]), encoding="utf-8")
    omitted = results["omitted"] + [f"{s['scene']}: {why}" for s in results["trajectories"] for why in s["omitted"]]
    for part in ("forward_dynamics", "peers"):
        omitted += [f"{part.replace('_', ' ')}: {why}" for why in results.get(part, {}).get("omitted", ())]
    print(found, table.slopes(results), sep="\n\n")
    for title, items in (
        ("recommended", recommended.words(results.get("recommended", []))),
        ("dominated", results["dominated"]),
        ("crossovers", results["crossovers"]),
        ("omitted", omitted),
        ("plots", [str(file) for file in files]),
    ):
        print(f"\n{table.lines(title, items)}")
    print(f"\n{report.words(results['machine'])}, commit {results['commit']}, {results['seconds']:.0f} s")
    if arguments.page:
        report.into_page(findings.page(results), __file__, results["machine"])
    front_page.follow(arguments)


if __name__ == "__main__":
    main()
