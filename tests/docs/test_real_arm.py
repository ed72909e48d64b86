"""The rows of a real arm's log, on a log whose truth is known: each model explains what it can, and no more."""

import csv
from importlib import import_module
from pathlib import Path

import pytest
import torch
from helpers import PAIR, exhaustive
from places import DATA

import torchdq

for needed in ("matplotlib", "rich", "scipy", "tyro"):
    pytest.importorskip(needed, reason="the examples need the extra 'examples'")
from matplotlib.image import imread  # noqa: E402

BACKEND = "auto"


@pytest.fixture(scope="module")
def main():
    return import_module("07_real_arm")


def record(path: Path, robot: torchdq.Robot, seed: int) -> Path:
    """A log of the robot with heavier links and dry friction, in even steps of 10 ms."""
    real = robot.replace(mass=robot.mass * torch.tensor([1.3, 0.8], dtype=torch.float64))
    g = torch.Generator().manual_seed(seed)
    t = torch.arange(0, 12, 0.01, dtype=torch.float64)[:, None]
    w, phase, size = (torch.rand(3, 2, 3, generator=g, dtype=torch.float64)[k] for k in range(3))
    w = 1 + 3 * w
    angle = w * t[:, None] + 6 * phase
    q, qd, qdd = (size * angle.sin()).sum(-1), (size * w * angle.cos()).sum(-1), -(size * w * w * angle.sin()).sum(-1)
    tau = torchdq.inverse_dynamics(real, q, qd, qdd) + 2.0 * torch.tanh(qd / 0.02)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "q1", "q2", "qd1", "qd2", "tau1", "tau2"])
        writer.writerows(torch.cat([t, q, qd, tau], -1).tolist())
    return path


def test_every_model_explains_what_it_can(main, tmp_path):
    (tmp_path / "pair.urdf").write_text(PAIR)
    robot = torchdq.Robot.from_urdf(tmp_path / "pair.urdf")
    logs = [record(tmp_path / f"{k}.csv", robot, k) for k in range(3)]
    result = main.main(
        main.Args("csv", tmp_path / "pair.urdf", logs[:2], logs[2:], quick=True, json=tmp_path / "r.json", out=tmp_path)
    )
    assert result.tests == ["2.csv"]
    mean = {name: float(found.mean()) for name, found in result.errors.items()}
    assert mean["identified"] < 0.1 < mean["+ friction"] < mean["description"]
    assert mean["identified"] < 0.5 * mean["+ friction"]
    assert mean["chosen"] < 0.1 and mean["chosen + residual"] < 1.01 * mean["chosen"]
    assert result.covered.mean() > 0.5
    assert (tmp_path / "r.json").is_file() and imread(tmp_path / "real_arm.png")[..., :3].std() > 0.03


@exhaustive
@pytest.mark.skipif(not (DATA / "panda_gaz2019").is_dir(), reason="the recordings are not here")
def test_a_real_panda_is_explained_best_by_physics(main, tmp_path):
    folder = DATA / "panda_gaz2019"
    logs = [folder / "panda_exciting_traj1.csv"]
    args = main.Args("panda", folder / "panda_gaz2019.urdf", logs, quick=True, out=tmp_path)
    result = main.main(args)
    mean = {name: float(found.mean()) for name, found in result.errors.items()}
    assert mean["identified"] < 0.075 < 0.09 < mean["+ friction"] < mean["description"]
    assert mean["chosen + residual"] < 1.01 * mean["chosen"] < 0.5 * mean["black box"]
    assert 0.93 < result.covered.mean() <= 1.0  # wide, since the motion repeats what was learned
