"""Price of every effect, and its page: what it adds to a step of a seven-joint arm, in operations and in nanoseconds.

    python benchmarks/effects.py [--quick] [--measure [NAME ...]] [--write]

`--measure` stores nanoseconds in benchmarks/results/effects.json, with the machine; those of named effects are scaled
by the time of a step without effects, as if on the machine of the others. `--write` writes docs/effects from these,
from the docstrings, and from what the package says about each effect; it draws the pictures, too. A new effect needs
an entry in `pages/cases.py` and one in `pages/characteristics.py`.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import report
import torch
from pages import effect_page
from pages.cases import CASES, built
from pages.characteristics import CHARACTERISTICS
from pages.command import command
from pages.effect_facts import ARM, arm, tensors_of
from pages.pictures import svg
from torch import Tensor

from torchdq import Scene
from torchdq.effects import Effect

BATCH = 4096
FOLDER = effect_page.ROOT / "docs" / "effects"


def stepped(scene: Scene) -> Callable[[], object]:
    """A step of a batch of random states."""
    generator = torch.Generator().manual_seed(0)

    def random(width: int) -> Tensor:
        return torch.rand(BATCH, width, generator=generator, dtype=torch.float64)

    q, qd, noise = (random(width) for width in (scene.n, scene.n, scene.noises))
    state, _ = scene._begin({"q": q, "qd": qd}, {}, noise)
    inputs = {name: random(width) for name, width in scene.inputs.items()}
    return lambda: scene.step(state, noise=noise, **inputs)


def price(effect: Effect, rounds: int) -> tuple[float, float, float]:
    """Nanoseconds that an effect adds to a step, their spread, and those of the bare step.

    Both steps take turns, one call at a time, and the fastest twentieth of the calls counts: others were disturbed by
    whatever else the machine does. The spread is what the fastest tenth would have said instead.
    """
    calls = [stepped(Scene(arm())), stepped(Scene(arm(type(effect).__name__), (effect,)))]
    times: list[list[float]] = [[], []]
    for _ in range(rounds):
        for call, found in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            found.append((time.perf_counter() - start) / BATCH * 1e9)
    (bare, tenth), (whole, whole_tenth) = (statistics.quantiles(found[10:], n=20)[:2] for found in times)
    return max(0.0, whole - bare), abs(whole_tenth - tenth - (whole - bare)) + 0.05 * abs(whole - bare), bare


def measured(rounds: int, names: Sequence[str]) -> dict[str, Any]:
    """Prices of effects, in numbers and in tensors."""
    bare: list[float] = []
    found: dict[str, dict[str, list[float]]] = {}
    for name in names:
        effect = built(CASES[name].made)
        kinds = {"numbers": effect} | ({"tensors": tensors_of(effect, arm(name), BATCH)} if effect.SHAPES else {})
        found[name] = {}
        for kind, made in kinds.items():
            nanoseconds, spread, without = price(made, rounds)
            found[name][kind] = [nanoseconds, spread]
            bare.append(without)
            print(f"{name:18s} {kind:8s} {nanoseconds:7.1f} +- {spread:.1f} ns", flush=True)
    return {"robot": ARM, "batch": BATCH, "dtype": "float64", "bare": statistics.median(bare), "effects": found}


def pages() -> dict[str, str]:
    """Files of docs/effects that are text."""
    return {"index.md": effect_page.index(), **{effect_page.address(name): effect_page.page(name) for name in CASES}}


def pictures() -> dict[str, str]:
    """Files of docs/effects that are pictures."""
    return {effect_page.address(name).replace(".md", ".svg"): svg(draw()) for name, draw in CHARACTERISTICS.items()}


def store(quick: bool, names: Sequence[str]) -> None:
    """Measure prices, and store them with the machine; of named effects, in proportion to those of the others."""
    rounds = 200 if quick else 2000
    if not names:
        report.into_json(effect_page.PRICES, machine=report.machine(), **measured(rounds, list(CASES)))
        return
    stored, found = effect_page.prices(), measured(rounds, names)
    scale = stored["bare"] / found["bare"]
    for name, kinds in found["effects"].items():
        stored["effects"][name] = {kind: [scale * x for x in row] for kind, row in kinds.items()}
    report.into_json(effect_page.PRICES, **stored)


def main() -> None:
    """Prices of all effects measured, or their pages written, as the arguments say."""
    command(
        __doc__,
        "fewer calls of each step",
        store,
        CASES,
        effect_page.PRICES,
        FOLDER,
        files=lambda: pages() | pictures(),
    )


if __name__ == "__main__":
    main()
