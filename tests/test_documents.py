"""The code in the documents runs."""

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import helpers
import pytest
import torch

import torchdq
from torchdq.envs import Scene, effects

DOCS = Path(__file__).resolve().parents[1] / "docs"
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
one_thread = helpers.one_thread


@pytest.mark.parametrize("path", sorted(DOCS.glob("*.md")), ids=lambda path: path.name)
def test_every_block_of_a_document_runs_after_the_ones_before_it(path):
    text, known = path.read_text(encoding="utf-8"), {"__name__": "document"}
    for match in FENCE.finditer(text):
        language, code = match.groups()
        assert language == "python", f"{path.name}: a block of {language or 'no language'} cannot be run"
        first = text.count("\n", 0, match.start()) + 1
        exec(compile("\n" * first + code, str(path), "exec"), known)  # line numbers are those of the document


def test_the_page_on_extending_has_what_it_promises():
    code = "".join(code for _, code in FENCE.findall((DOCS / "extending.md").read_text(encoding="utf-8")))
    for name in ("Gentle(Reach)", "TorchTask(", "(JointEffect)", "Integrator)", "Painter", ".memory", ".source()"):
        assert name in code, name


def test_a_scene_gives_several_threads_what_it_gives_one():
    def end(seed):
        scene = Scene(torchdq.robots.load("two_link"), (effects.Viscous(0.1 + 0.01 * (seed % 3)),), backend="eager")
        return scene.rollout(scene.start(helpers.random(5, 2, seed=seed)), steps=10).q

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(end, range(16)))
    assert all(torch.equal(x, end(seed)) for seed, x in enumerate(found))
