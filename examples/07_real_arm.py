"""Share of a real arm's torque that each model explains, on any log, trained and tested by trajectory.

    python examples/07_real_arm.py --format ur10e --robot ur10e.urdf --train A.csv B.csv --test C.csv --json out.json
    python examples/07_real_arm.py --format panda --robot panda.urdf --train LOG.csv --split 0.6 --device cuda

The number is RMSE over standard deviation of the measured torque, per joint, on test motions that nothing was chosen
by. What is chosen is chosen on blocks of the training motions that were left out. Rows, a ladder of models:

    description          the URDF alone
    + friction           viscous, Coulomb, offset and rotor inertia by least squares
    identified           least squares over all inertial parameters and friction, kept physical
    chosen               what `identify` chooses among these and friction of other shapes, as a layer
    chosen + residual    the same and a small network per joint, kept where it helps (`fit`)
    black box            a network from q, qd, qdd of all joints to torques, knowing nothing

The last table is the share of the test torques in the 95 % intervals of `ResidualDynamics.predict`: near 95 % for
motions of the same kind, less for others.
"""

import json
import sys
import time
from collections.abc import Sequence
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
from torchdq.learning import LogError, Motion, Samples, cut, identify, read, samples, smooth

BATCH, RATE, DECAY = 256, 1e-2, 1e-2  # rows of a step, learning rate and weight decay of every training
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


def covered(model: torchdq.ResidualDynamics, test: Samples) -> np.ndarray:
    """Share of the torques in their 95 % intervals, per joint."""
    told = model.predict(*test[:3])
    return ((test.tau >= told.low) & (test.tau <= told.high)).double().mean(0).numpy()


def parts_of(args: Args) -> tuple[list[Motion], dict[str, Samples]]:
    """Motions to learn from, and samples of those to test on by name."""
    layout = LAYOUTS[args.format]
    motions = [smooth(read(path, layout)) for path in args.train]
    if args.test:
        return motions, {p.name: samples(smooth(read(p, layout))) for p in args.test}
    halves = [cut(motion, args.split) for motion in motions]
    tests = {
        f"{path.name}, last {1 - args.split:.0%}": samples(b) for path, (_, b) in zip(args.train, halves, strict=True)
    }
    return [a for a, _ in halves], tests


def black_box(args: Args, candidate: tuple[int, float], data: Samples, steps: int, seed: int = 0) -> nn.Module:
    """Trained black box of a width and a weight decay."""
    torch.manual_seed(seed)
    width, decay = candidate
    box = BlackBox(data, width)
    fit_on(args.place, box, data, steps=steps, batch=BATCH, rate=3e-3, decay=decay, seed=seed)
    return box


def chosen_box(args: Args, parts: Sequence[Samples], steps: int, console: Console) -> tuple[int, float]:
    """Width and weight decay that do best on the last training motion, or on the last fifth of the only one."""
    candidates = [(64, 0.1)] if args.quick else [(w, d) for w in (64, 128) for d in (1e-2, 1e-1, 1.0)]
    if len(candidates) == 1:
        return candidates[0]
    k = len(parts[0].q) * 4 // 5
    early = together(parts[:-1]) if len(parts) > 1 else Samples(*(x[:k] for x in parts[0]))
    late = parts[-1] if len(parts) > 1 else Samples(*(x[k:] for x in parts[0]))
    scores = {c: float(np.mean(errors(black_box(args, c, early, steps), [late]))) for c in candidates}
    best = min(scores, key=scores.__getitem__)
    console.print(f"black box (width, decay): {best} chosen among {len(candidates)}")
    return best


def main(args: Args) -> dict[str, dict[str, list[float]]]:
    """RMSE/std per joint, by row and test; and the share of torques in their intervals, as the row `covered`."""
    console, begin = Console(width=120), time.perf_counter()
    robot = torchdq.Robot.from_urdf(args.robot, on_unphysical="ignore")
    motions, held = parts_of(args)
    tests, parts = list(held.values()), [samples(motion) for motion in motions]
    data = together(parts)
    steps, seeds = (200, 1) if args.quick else (args.steps, args.seeds)
    console.print(
        f"{robot.name}, {robot.n} joints: {len(data.q)} samples of {len(parts)} motions to learn from, "
        f"{sum(len(test.q) for test in tests)} of {len(tests)} to test on"
    )
    rows: dict[str, list[list[np.ndarray]]] = {}  # by row, per seed, per test
    models: dict[str, nn.Module] = {}

    def add(name: str, model: nn.Module) -> None:
        rows.setdefault(name, []).append(errors(model, tests))
        models[name] = model

    add("description", torchdq.DQRNEA(robot))
    add("+ friction", with_friction(robot, data))
    options = {"offset": True, "armature": True, "width": WIDTH}
    add("identified", identify(robot, motions, friction=True, prior=1.0, **options).layer())
    found = identify(robot, motions, **options)
    console.print(str(found.report) if found.report is not None else "too few rows to choose by", highlight=False)
    add("chosen", found.layer())
    box = chosen_box(args, parts, steps, console)
    inside: list[list[np.ndarray]] = []  # per seed, per test
    for seed in range(seeds):
        torch.manual_seed(seed)
        model = torchdq.ResidualDynamics(found.layer())
        for p in model.model.parameters():
            p.requires_grad_(False)  # least squares have found the best there is
        model.standardise(*data)
        how = {"steps": steps, "batch": BATCH, "rate": RATE, "decay": DECAY, "seed": seed}
        history = fit_on(args.place, model, parts, **how)
        add("chosen + residual", model)
        inside.append([covered(model, test) for test in tests])
        add("black box", black_box(args, box, data, steps, seed))
    console.print(str(history.residual), highlight=False)

    means = {name: np.mean(found, axis=0) for name, found in rows.items()}  # [tests, n]
    shares = np.mean(inside, axis=0)
    heads = [*(f"joint {j + 1}" for j in range(robot.n)), "mean"]
    for i, test in enumerate(held):
        table = Table("model", *heads, title=f"RMSE / std of the torque, {test}")
        for name, scores in means.items():
            table.add_row(name, *(f"{x:.3f}" for x in (*scores[i], scores[i].mean())))
        table.add_section()
        table.add_row("torques in 95 % intervals", *(f"{x:.0%}" for x in (*shares[i], shares[i].mean())))
        console.print(table)
    console.print(
        f"{seeds} seeds; everything took {time.perf_counter() - begin:.0f} s on {torch.get_num_threads()} threads"
    )
    plot(robot, tests[0], models, args.out)
    means["covered"] = shares
    result = {name: {test: scores[i].tolist() for i, test in enumerate(held)} for name, scores in means.items()}
    if args.json is not None:
        args.json.write_text(json.dumps(result, indent=1))
    return result


def plot(robot: torchdq.Robot, test: Samples, models: dict[str, nn.Module], out: Path) -> None:
    """Measured torques and those of three models over a stretch of a test motion, a panel per joint."""
    prepare()
    stretch = slice(0, min(len(test.q), 800))
    rows = Samples(*(x[stretch] for x in test))
    shown = {"description": ORANGE, "+ friction": "#E69F00", "chosen + residual": BLUE}
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
