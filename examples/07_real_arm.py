"""Share of a real arm's torque that each model explains, on any log, trained and tested by trajectory.

    python examples/07_real_arm.py --format ur10e --robot ur10e.urdf --train A.csv B.csv --test C.csv --json out.json
    python examples/07_real_arm.py --format panda --robot panda.urdf --train LOG.csv --split 0.6 --device cuda

The number is RMSE over standard deviation of the measured torque, per joint, on test motions that were used for no
choice. Models are selected on held-out blocks of the training motions. Rows:

    description          the URDF alone
    + friction           with viscous and Coulomb friction, offset and rotor inertia
    identified           least squares over all inertial parameters and friction, physically consistent
    chosen               the selection of `identify` among these and other friction models
    chosen + residual    the same with a small network, at the joints where it helps (`fit`)
    black box            a network from q, qd, qdd of all joints to torques, without a model

The last row is the coverage of the 95 % intervals of `Identified.predict`: near 95 % for similar motions,
less for others.
"""

import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
import tyro
from devices import OnDevice, fit_on
from pictures import BLUE, ORANGE, label, panels, prepare, save
from recordings import LAYOUTS, predicted, residual_samples
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

import torchdq
from torchdq import effects
from torchdq.learning import (
    Identified,
    LogError,
    Model,
    Motion,
    Samples,
    identify,
    read_log,
    smooth,
    stack_samples,
    train_test_split,
)

BATCH, RATE, DECAY = 256, 1e-2, 1e-2  # rows of a step, learning rate and weight decay of every training

Torques = Callable[[Motion], Tensor]  # model of a motion's torques [rows, n]


@dataclass
class Args(OnDevice):
    format: Literal["panda", "ur10e", "double_pendulum", "csv"]
    """Layout of the logs; see `recordings.LAYOUTS`."""
    robot: Path
    """URDF of the robot."""
    train: list[Path]
    """Logs to learn from."""
    test: list[Path] = field(default_factory=list)
    """Logs to test on; none: the last part of every log in `train`."""
    split: float = 0.6
    """Part of every log that is learned from if there are no test logs."""
    steps: int = 2500
    """Steps of every training."""
    seeds: int = 3
    """Trainings of every network; the table has their mean."""
    quick: bool = False
    """One seed, few steps, one candidate for the black box: to see that it runs."""
    json: Path | None = None
    """File for all numbers."""
    out: Path = Path("out")
    """Folder of the picture."""


class BlackBox(nn.Module):
    """Torques from the states of all joints, standardised, by a network that knows no mechanics."""

    def __init__(self, data: Samples, width: int):
        super().__init__()
        x, n = self.features(*data[:3]), data.q.shape[1]
        self.register_buffer("mean", x.mean(0))
        self.register_buffer("deviation", x.std(0) + 1e-6)
        self.register_buffer("scale", data.tau.std(0))
        self.register_buffer("middle", data.tau.mean(0))
        layers = [nn.Linear(x.shape[1], width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, n)]
        self.network = nn.Sequential(*layers)

    @staticmethod
    def features(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Inputs of the network: angles by sine and cosine, rates, and the sign of motion, softly."""
        return torch.cat([q.sin(), q.cos(), qd, qdd, torch.tanh(qd / 0.05)], -1)

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Torques [..., n]."""
        x = (self.features(q, qd, qdd) - self.mean) / self.deviation
        return self.middle + self.scale * self.network(x.float())  # single precision, as networks are


def errors(model: Torques, tests: Sequence[Motion]) -> list[np.ndarray]:
    """RMSE over standard deviation of the torque, per joint, on every test."""
    with torch.no_grad():
        pairs = [(model(test), stack_samples(test).tau) for test in tests]
    return [((found - tau).square().mean(0).sqrt() / tau.std(0)).double().numpy() for found, tau in pairs]


def of_states(model: nn.Module) -> Torques:
    """Torques of a motion by a module of q, qd and qdd."""
    return lambda motion: model(*stack_samples(motion)[:3])


def of_motions(model: Identified) -> Torques:
    """Torques of a motion by a model with memory."""
    return lambda motion: model.predict(motion).tau


def covered(found: Any, test: Motion) -> np.ndarray:
    """Share of the torques in their 95 % intervals, per joint."""
    tau = stack_samples(test).tau
    return ((tau >= found.low) & (tau <= found.high)).double().mean(0).numpy()


def parts_of(args: Args) -> tuple[list[Motion], dict[str, Motion]]:
    """Training motions, and test motions by name."""
    layout = LAYOUTS[args.format]
    motions = [smooth(read_log(path, layout)) for path in args.train]
    if args.test:
        return motions, {p.name: smooth(read_log(p, layout)) for p in args.test}
    halves = [train_test_split(motion, args.split) for motion in motions]
    names = [f"{path.name}, last {1 - args.split:.0%}" for path in args.train]
    return [a for (a,), _ in halves], {name: b for name, (_, (b,)) in zip(names, halves, strict=True)}


def black_box(args: Args, candidate: tuple[int, float], data: Samples, steps: int, seed: int = 0) -> nn.Module:
    """Trained black box of a width and a weight decay."""
    torch.manual_seed(seed)
    width, decay = candidate
    box = BlackBox(data, width)
    fit_on(args.place, box, data, steps=steps, batch=BATCH, rate=3e-3, decay=decay, seed=seed)
    return box


def chosen_box(args: Args, motions: Sequence[Motion], steps: int, console: Console) -> tuple[int, float]:
    """Width and weight decay that do best on the last training motion, or on the last fifth of the only one."""
    candidates = [(64, 0.1)] if args.quick else [(w, d) for w in (64, 128) for d in (1e-2, 1e-1, 1.0)]
    if len(candidates) == 1:
        return candidates[0]
    early, late = (motions[:-1], motions[-1:]) if len(motions) > 1 else train_test_split(motions[0], 0.8)
    data = stack_samples(early)
    scores = {c: float(np.mean(errors(of_states(black_box(args, c, data, steps)), late))) for c in candidates}
    best = min(scores, key=scores.__getitem__)
    console.print(f"black box (width, decay): {best} chosen among {len(candidates)}")
    return best


class Result(NamedTuple):
    """Errors and shares in intervals; every list has a row of joints for each test."""

    tests: list[str]
    errors: dict[str, np.ndarray]  # RMSE over standard deviation by model
    covered: np.ndarray  # share of the torques in the intervals
    learned: float  # time that was learned from [s]
    seeds: int


def main(args: Args) -> Result:
    """Errors of all models, and the share of the torques in their intervals."""
    console, begin = Console(width=120), time.perf_counter()
    robot = torchdq.Robot.from_urdf(args.robot, on_unphysical="ignore")
    motions, held = parts_of(args)
    tests, data = list(held.values()), stack_samples(motions)
    steps, seeds = (200, 1) if args.quick else (args.steps, args.seeds)
    console.print(
        f"{robot.name}, {robot.n} joints: {len(data.q)} samples of {len(motions)} motions to learn from, "
        f"{sum(len(test.q) for test in tests)} of {len(tests)} to test on"
    )
    rows: dict[str, list[list[np.ndarray]]] = {}  # by row, per seed, per test
    models: dict[str, Torques] = {}

    def add(name: str, model: Torques) -> None:
        rows.setdefault(name, []).append(errors(model, tests))
        models[name] = model

    add("description", of_states(torchdq.DQRNEA(robot)))
    plain = Model(friction=(effects.Viscous(), effects.Coulomb()), offset=True, armature=True)
    add("+ friction", of_motions(identify(robot, motions, plain, prior=math.inf)))
    add("identified", of_motions(identify(robot, motions, plain, prior=1.0)))
    found = identify(robot, motions, Model(offset=True, armature=True))
    console.print(str(found.selection) if found.selection is not None else "too few rows to choose by", highlight=False)
    add("chosen", of_motions(found))
    box = chosen_box(args, motions, steps, console)
    inside: list[list[np.ndarray]] = []  # per seed, per test
    for seed in range(seeds):
        torch.manual_seed(seed)
        network = torchdq.ResidualDynamics(found.layer())
        parts = [residual_samples(found, network, motion) for motion in motions]
        how = {"steps": steps, "batch": BATCH, "rate": RATE, "decay": DECAY, "seed": seed}
        history = fit_on(args.place, network, parts, **how)
        both = partial(predicted, found, network)
        add("chosen + residual", lambda motion, both=both: both(motion).tau)
        inside.append([covered(both(test), test) for test in tests])
        add("black box", of_states(black_box(args, box, data, steps, seed)))
    console.print(str(history.residual), highlight=False)

    result = Result(
        list(held),
        {name: np.mean(found, axis=0) for name, found in rows.items()},  # [tests, n]
        np.mean(inside, axis=0),
        sum(float(motion.time[-1] - motion.time[0]) for motion in motions),
        seeds,
    )
    heads = [*(f"joint {j + 1}" for j in range(robot.n)), "mean"]
    for i, test in enumerate(held):
        table = Table("model", *heads, title=f"RMSE / std of the torque, {test}")
        for name, scores in result.errors.items():
            table.add_row(name, *(f"{x:.3f}" for x in (*scores[i], scores[i].mean())))
        table.add_section()
        shares = result.covered[i]
        table.add_row("torques in 95 % intervals", *(f"{x:.0%}" for x in (*shares, shares.mean())))
        console.print(table)
    console.print(
        f"{seeds} seeds; everything took {time.perf_counter() - begin:.0f} s on {torch.get_num_threads()} threads"
    )
    plot(robot, tests[0], models, args.out)
    if args.json is not None:
        plain = {name: scores.tolist() for name, scores in (*result.errors.items(), ("covered", result.covered))}
        args.json.write_text(json.dumps({"tests": result.tests, **plain}, indent=1))
    return result


def plot(robot: torchdq.Robot, test: Motion, models: dict[str, Torques], out: Path) -> None:
    """Measured torques and those of three models over a stretch of a test motion, a panel per joint."""
    prepare()
    stretch = slice(0, min(len(test.q), 800))
    shown = {"description": ORANGE, "+ friction": "#E69F00", "chosen + residual": BLUE}
    legend = {
        "description": "nominal",
        "+ friction": "nominal + friction",
        "chosen + residual": "identified + residual",
    }
    with torch.no_grad():
        torques = {name: models[name](test)[stretch] for name in shown}
    measured = stack_samples(test).tau[stretch]
    figure, joints = panels(robot.n, 2, 1.7)
    for j, panel in enumerate(joints):
        panel.plot(measured[:, j], color="#B0B0B0", linewidth=4, label="measured")
        for name, color in shown.items():
            panel.plot(torques[name][:, j], color=color, linewidth=1.1, label=legend[name])
        panel.set_title(robot.joint_names[j], fontsize=10)
    label(figure, joints[0], "sample of the first test motion")
    save(figure, out / "real_arm.png")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (LogError, torchdq.TorchdqError, OSError) as fault:
        sys.exit(f"{type(fault).__name__}: {fault}")
