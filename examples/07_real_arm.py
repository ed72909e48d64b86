"""Share of a real arm's torque that each model explains, on any log, trained and tested by trajectory.

    python examples/07_real_arm.py --format ur10e --robot ur10e.urdf --train A.csv B.csv --test C.csv --json out.json
    python examples/07_real_arm.py --format panda --robot panda.urdf --train LOG.csv --split 0.6 --device cuda

The number is RMSE over standard deviation of the measured torque, per joint, on test motions that nothing was chosen
by: sizes and weights of the networks are chosen on one training motion that is held out for that, then everything is
trained on all of them. Rows:

    description               the URDF alone
    + friction                viscous, Coulomb, offset and rotor inertia by least squares
    identified                least squares over all inertial parameters and friction, kept physical
    black box                 a network from q, qd, qdd of all joints to torques, knowing nothing
    + friction + residual     the second row and a small network per joint
    physics                   the identified model, trained on by gradient, physical at every step
    physics + residual        the same with a small network per joint
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from devices import OnDevice, fit_on
from pictures import BLUE, ORANGE, label, panels, prepare, save
from recordings import LAYOUTS
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

import torchdq
from torchdq.learning import LogError, Samples, cut, identify, read, samples, smooth
from torchdq.residual import ResidualDynamics

LEARNED = ("mass", "com", "inertia", "friction", "armature", "offset")
BATCH = 512
WIDTH = 0.02  # speed over which Coulomb friction changes sign [rad/s]: about the noise of the filtered velocity


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
    epochs: int = 40
    """Passes over the data in every training."""
    seeds: int = 3
    """Trainings of every network; the table has their mean."""
    quick: bool = False
    """One seed, few passes, one candidate for the black box: to see that it runs."""
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


def errors(model: nn.Module, tests: Sequence[Samples]) -> list[np.ndarray]:
    """RMSE over standard deviation of the torque, per joint, on every test."""
    with torch.no_grad():
        return [
            ((model(*test[:3]) - test.tau).square().mean(0).sqrt() / test.tau.std(0)).double().numpy() for test in tests
        ]


def together(parts: Sequence[Samples]) -> Samples:
    """All samples as one."""
    return Samples(*(torch.cat(rows) for rows in zip(*parts, strict=True)))


def with_friction(robot: torchdq.Robot, data: Samples) -> torchdq.DQRNEA:
    """The described model with friction, offset and rotor inertia by least squares, joint by joint."""
    q, qd, qdd, tau = data
    layer = torchdq.DQRNEA(robot, learn=("friction", "armature", "offset"), friction_width=WIDTH)
    terms = torch.stack([qd, qd / (qd * qd + WIDTH**2).sqrt(), torch.ones_like(qd), qdd], -1)  # [N, n, 4]
    left = tau - torchdq.inverse_dynamics(robot.replace(armature=None), q, qd, qdd)
    columns = [torch.linalg.lstsq(terms[:, j], left[:, j, None]).solution[:, 0] for j in range(robot.n)]
    viscous, coulomb, offset, armature = torch.stack(columns, -1)
    layer.viscous, layer.coulomb, layer.armature = (x.clamp(min=0.0) for x in (viscous, coulomb, armature))
    layer.offset = nn.Parameter(offset)
    return layer


def identified(robot: torchdq.Robot, data: Samples) -> torchdq.DQRNEA:
    """The model whose inertial parameters and friction least squares find, as a layer that can learn on."""
    found = identify(robot, *data, friction=True, offset=True, armature=True, prior=1.0, width=WIDTH)
    layer = torchdq.DQRNEA(found.robot, learn=LEARNED, friction_width=WIDTH)
    layer.viscous, layer.coulomb, layer.offset = found.viscous, found.coulomb, nn.Parameter(found.offset)
    return layer


def residual(model: torchdq.DQRNEA, data: Samples, hidden: Sequence[int] = (32, 32)) -> ResidualDynamics:
    """The model with a small network per joint."""
    both = ResidualDynamics(model, hidden=hidden)
    both.standardise(*data)
    return both


def seconds_per_step(model: nn.Module, data: Samples) -> float:
    """Time of one gradient of a model's torques on a batch."""
    rows = [x[:BATCH] for x in data[:3]]
    for _ in range(5):
        model(*rows).sum().backward()
    start = time.perf_counter()
    for _ in range(50):
        model(*rows).sum().backward()
    return (time.perf_counter() - start) / 50


def parts_of(args: Args) -> tuple[list[Samples], dict[str, Samples]]:
    """Motions to learn from, and those to test on by name."""
    layout = LAYOUTS[args.format]
    motions = [smooth(read(path, layout)) for path in args.train]
    if args.test:
        return [samples(m) for m in motions], {p.name: samples(smooth(read(p, layout))) for p in args.test}
    halves = [cut(motion, args.split) for motion in motions]
    tests = {
        f"{path.name}, last {1 - args.split:.0%}": samples(b) for path, (_, b) in zip(args.train, halves, strict=True)
    }
    return [samples(a) for a, _ in halves], tests


def main(args: Args) -> dict[str, dict[str, list[float]]]:
    """RMSE/std per joint, by row and test."""
    console, begin = Console(width=120), time.perf_counter()
    robot = torchdq.Robot.from_urdf(args.robot, on_unphysical="ignore")
    parts, held = parts_of(args)
    tests, data = list(held.values()), together(parts)
    # whatever is chosen is chosen on the last training motion, or on the last fifth of the only one
    k = len(data.q) * 4 // 5
    early = together(parts[:-1]) if len(parts) > 1 else Samples(*(x[:k] for x in data))
    late = parts[-1] if len(parts) > 1 else Samples(*(x[k:] for x in data))
    epochs, seeds = (2, 1) if args.quick else (args.epochs, args.seeds)
    console.print(
        f"{robot.name}, {robot.n} joints: {len(data.q)} samples of {len(parts)} motions to learn from, "
        f"{sum(len(test.q) for test in tests)} of {len(tests)} to test on"
    )
    rows: dict[str, list[list[np.ndarray]]] = {}  # by row, per seed, per test
    models: dict[str, nn.Module] = {}

    def add(name: str, model: nn.Module) -> None:
        rows.setdefault(name, []).append(errors(model, tests))
        models[name] = model

    def chosen(what: str, candidates: Sequence, run: Callable) -> tuple:
        """The candidate that does best on what is held out of the training motions."""
        if args.quick:
            return candidates[0]
        scores = {candidate: float(np.mean(errors(run(candidate, early), [late]))) for candidate in candidates}
        best = min(scores, key=scores.__getitem__)
        console.print(f"{what}: {best} chosen among {len(candidates)}, {scores[best]:.3f} on what was held out")
        return best

    def network(candidate: tuple[int, float], data: Samples, seed: int = 0) -> nn.Module:
        torch.manual_seed(seed)
        width, decay = candidate
        box = BlackBox(data, width)
        fit_on(args.place, box, data, epochs=epochs, batch=BATCH, rate=3e-3, decay=decay, seed=seed)
        return box

    def corrected(candidate: tuple[int, float], data: Samples, seed: int = 0, learned: bool = True) -> nn.Module:
        torch.manual_seed(seed)
        width, decay = candidate
        model = residual(identified(robot, data) if learned else with_friction(robot, data), data, (width, width))
        fit_on(args.place, model, data, epochs=epochs, batch=BATCH, rate=3e-3, decay=decay, prior=1e-4, seed=seed)
        return model

    add("description", torchdq.DQRNEA(robot))
    add("+ friction", with_friction(robot, data))
    add("identified", identified(robot, data))
    box = chosen("black box (width, decay)", [(w, d) for w in (64, 128) for d in (1e-2, 1e-1, 1.0)], network)
    small = chosen("residual (width, decay)", [(w, d) for w in (16, 32) for d in (1e-2, 1e-1)], corrected)
    for seed in range(seeds):
        add("black box", network(box, data, seed))
        add("+ friction + residual", corrected(small, data, seed, learned=False))
        learned = identified(robot, data)
        fit_on(args.place, learned, data, epochs=epochs, batch=BATCH, rate=1e-3, prior=1e-4, seed=seed)
        add("physics", learned)
        start = time.perf_counter()
        add("physics + residual", corrected(small, data, seed))
        trained = time.perf_counter() - start

    means = {name: np.mean(found, axis=0) for name, found in rows.items()}  # [tests, n]
    for i, test in enumerate(held):
        table = Table(
            *("model", *(f"joint {j + 1}" for j in range(robot.n)), "mean"), title=f"RMSE / std of the torque, {test}"
        )
        for name, found in means.items():
            table.add_row(name, *(f"{x:.3f}" for x in (*found[i], found[i].mean())))
        console.print(table)
    steps = epochs * -(-len(data.q) // BATCH)
    share = seconds_per_step(learned, data) * steps / trained
    console.print(
        f"{seeds} seeds; the last row trains in {trained:.0f} s, of which the rigid-body model and its gradient take "
        f"{share:.0%}; everything took {time.perf_counter() - begin:.0f} s on {torch.get_num_threads()} threads"
    )
    plot(robot, tests[0], models, args.out)
    result = {
        name: {test: [float(x) for x in found[i]] for i, test in enumerate(held)} for name, found in means.items()
    }
    if args.json is not None:
        args.json.write_text(json.dumps(result, indent=1))
    return result


def plot(robot: torchdq.Robot, test: Samples, models: dict[str, nn.Module], out: Path) -> None:
    """Measured torques and those of three models over a stretch of a test motion, a panel per joint."""
    prepare()
    stretch = slice(0, min(len(test.q), 800))
    rows = Samples(*(x[stretch] for x in test))
    shown = {"description": ORANGE, "+ friction": "#E69F00", "physics + residual": BLUE}
    figure, joints = panels(robot.n, 2, 1.7)
    for j, panel in enumerate(joints):
        panel.plot(rows.tau[:, j], color="#B0B0B0", linewidth=4, label="measured")
        for name, color in shown.items():
            with torch.no_grad():
                panel.plot(models[name](*rows[:3])[:, j], color=color, linewidth=1.1, label=name)
        panel.set_title(robot.joint_names[j], fontsize=10)
    label(figure, joints[0], "sample of the first test motion")
    save(figure, out / "real_arm.png")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except (LogError, torchdq.TorchdqError, OSError) as fault:
        sys.exit(f"{type(fault).__name__}: {fault}")
