"""Description of a scene: the cost of every effect, and what it leaves out of the robot's description."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import dtype_of, require_count, require_number
from torchdq.base.progress import Progress
from torchdq.base.timing import digits, measure
from torchdq.effects.effect import Effect
from torchdq.findings import printable
from torchdq.robot import Robot
from torchdq.robot.description import UNSIMULATED
from torchdq.scene.model import SceneModel
from torchdq.scene.state import State, initial_motion

MEASURED = 0.1  # longest time of measuring each effect [s]


class EffectCost(NamedTuple):
    """Cost that an effect adds to a step."""

    effect: str
    slot: str
    operations: int
    nanoseconds: float  # not below zero; NaN: there was no time to measure it
    spread: float  # half of the range of the middle half of the measurements [ns]

    @property
    def time(self) -> str:
        """Nanoseconds as text: a bound if the cost is within the spread, "-" if it was not measured."""
        if math.isnan(self.nanoseconds):
            return "-"
        if self.nanoseconds > self.spread:
            return digits(self.nanoseconds)
        return f"< {digits(max(self.nanoseconds + self.spread, 0.1))}"


class Description(NamedTuple):
    """Effects of a scene with their costs, and what it leaves out; `print` it."""

    costs: tuple[EffectCost, ...]  # the bare step first, then every effect in its order
    total: EffectCost
    left_out: tuple[str, ...]
    measured_on: str
    outside: tuple[str, ...] = ()  # computations of torch outside the program of a step

    def __str__(self) -> str:
        rows = [("effect", "slot", "operations", "ns per step")]
        rows += [(c.effect, c.slot, f"{c.operations}", c.time) for c in (*self.costs, self.total)]
        widths = [max(len(row[k]) for row in rows) for k in range(4)]
        lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        left_out = "\n".join(f"- {printable(what)}" for what in self.left_out) or "- nothing"
        outside = "".join(f"\n- {what}" for what in self.outside)
        if outside:
            outside = f"\n\ncomputed outside the program, and not among the operations:{outside}"
        return "\n".join(lines) + f"\n({self.measured_on}){outside}\n\ndescribed, and not simulated:\n{left_out}"


def describe(
    scene: SceneModel, batch: int = 4096, dtype: torch.dtype | str = torch.float64, seconds: float = 10.0
) -> Description:
    """Simulated effects, the cost of each in a step, and what the scene leaves out of the description.

    Effects are added one after the other to the bare step; each costs the difference it makes. The times are
    medians of differences of steps that took turns; a cost within their spread prints as a bound, "< 3.1".

    Args:
        batch: samples per step of which the time is taken, on torch's present number of threads; that of the
            parameters if they differ from sample to sample.
        dtype: dtype of those samples.
        seconds: time for all of it, compiling included [s]; effects it does not last for print "-". 0: no times.
    """
    require_count("batch", batch)
    require_number("seconds", seconds, least=0)
    end = time.monotonic() + seconds
    dtype = dtype_of("dtype", dtype)
    batches = scene.batches.values()
    batch = math.prod(torch.broadcast_shapes(*batches)) if any(batches) else batch
    bare = scene.replace(effects=(), controller=None, objects=())
    scenes = [bare.replace(objects=scene.objects[:k]) for k in range(len(scene.objects) + 1)]
    scenes += [scenes[-1].replace(effects=scene.effects[: k + 1]) for k in range(len(scene.effects))]
    labels = [("bare step", f"rigid bodies, {'loops, ' if scene.robot.closures else ''}integrator")]
    labels += [(f"{type(body).__name__} {body.name}", "object") for body in scene.objects]
    labels += [(effect.label(), effect.SLOT) for effect in scene.effects]
    if scene.controller is not None:
        scenes.append(scene)
        labels.append((type(scene.controller).__name__, "controller"))
    with Progress(f"describe the scene of {scene.robot.name!r}") as notice:
        counts = [part.count().total for part in scenes]
        times = _times([partial(_step, part, batch, dtype) for part in scenes], batch, end, notice)
    costs = [
        EffectCost(*label, count - before, *_difference(t, t_before))
        for label, count, before, t, t_before in zip(labels, counts, [0, *counts], times, [None, *times], strict=False)
    ]
    threads = torch.get_num_threads()
    on = f"{batch} samples of {str(dtype).removeprefix('torch.')}, {threads} thread{'s' * (threads != 1)}"
    total = EffectCost("all", "", counts[-1], *_difference(times[-1], None))
    outside = [f"{type(effect).__name__}: {words}" for effect in scene.effects if (words := effect.outside())]
    return Description(tuple(costs), total, left_out(scene.robot, scene.effects), on, tuple(outside))


def _times(
    steps: Sequence[Callable[[], Callable[[], State]]], batch: int, end: float, notice: Progress
) -> list[list[float]]:
    """Times of steps that take turns [ns], one in each round; without those that there was no time to compile."""
    calls: dict[str, Callable[[], object]] = {}
    order = [len(steps) - 1, *range(len(steps) - 1)]  # the whole scene first
    longest = 0.0
    for done, k in enumerate(order):
        start = time.monotonic()
        if start + longest >= end:
            break
        notice.at(f"{done} of {len(steps)} programs are ready")
        calls[str(k)] = call = steps[k]()
        call()
        longest = max(longest, time.monotonic() - start)
    notice.at("measuring")
    seconds = min(MEASURED, max(0.0, end - time.monotonic()) / max(1, len(calls)))
    found = measure(calls, batch, seconds) if calls else {}
    return [found.get(str(k), []) for k in range(len(steps))]


def _difference(times: Sequence[float], before: Sequence[float] | None) -> tuple[float, float]:
    """Median of the differences of each round, not below zero, and their spread [ns]; NaN without measurements.

    Args:
        before: times from which the difference is taken; None: from zero.
    """
    if not times or before == []:
        return math.nan, math.nan
    rounds = times if before is None else [t - t_before for t, t_before in zip(times, before, strict=True)]
    lower, middle, upper = statistics.quantiles(rounds, n=4, method="inclusive")
    return max(0.0, middle), (upper - lower) / 2


def _step(scene: SceneModel, batch: int, dtype: torch.dtype) -> Callable[[], State]:
    """Step of a batch of random states, to be timed."""
    generator = torch.Generator().manual_seed(0)

    def random(width: int) -> Tensor:
        return torch.rand(batch, width, generator=generator, dtype=dtype)

    # not `start`, which warns of positions outside the limits
    moved = initial_motion(scene.spec, {"q": random(scene.n), "qd": random(scene.n)})
    state, _ = scene._begin(moved, {}, random(scene.noises))
    inputs = {name: random(width) for name, width in scene.inputs.items()}
    noise = random(scene.noises)
    return lambda: scene.step(state, noise=noise, **inputs)


def left_out(robot: Robot, effects: Sequence[Effect]) -> tuple[str, ...]:
    """Lines, one for each part of a robot's description that no effect simulates."""
    limits, one = robot.limits, torch.ones(1, dtype=torch.bool)
    # attribute of the description, joints that have it, its name, and the effect that simulates it
    parts = (
        ("gravity", one & (robot.gravity is not None), "gravity", "Gravity()"),
        ("armature", one & (robot.armature is not None), "rotor inertia", "RotorInertia()"),
        ("damping", robot.damping > 0, "damping of {}", "Viscous()"),
        ("friction", robot.friction > 0, "dry friction of {}", "Coulomb()"),
        ("limits.lower", limits.lower.isfinite() | limits.upper.isfinite(), "position limits of {}", "JointLimits()"),
        ("limits.effort", limits.effort.isfinite(), "torque limits of {}", "Saturation(), or limit of Servo"),
        (
            "limits.velocity",
            limits.velocity.isfinite(),
            "velocity limits of {}",
            "TorqueSpeed(), which takes the torque away there",
        ),
    )
    simulated = {source for effect in effects for source in effect.simulates()}
    lines = []
    for source, there, words, effect in parts:
        there = there.reshape(there.shape[:-1].numel(), there.shape[-1]).any(0)  # in one of several robots
        if bool(there.any()) and source not in simulated:
            joints = ", ".join(name for name, has in zip(robot.joint_names, there.tolist(), strict=False) if has)
            lines.append(f"{words.format(joints)}: effects.{effect}")
    for acting in effects:
        if robot.n and (idle := acting.idle()):
            values = ", ".join(f"{name} is {getattr(acting, name)[0]:g}" for name in idle)
            lines.append(f"{type(acting).__name__} acts on no joint: {values}")
    return (*lines, *[str(note) for note in robot.notes if note.code.startswith(UNSIMULATED)])
