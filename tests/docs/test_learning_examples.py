"""The example of residual learning: its arm is what it claims to be, its split is honest, and its table is in order."""

import json
from importlib import import_module

import numpy as np
import pytest
import torch

import torchdq

for needed in ("matplotlib", "mujoco", "rich", "scipy", "tyro"):
    pytest.importorskip(needed, reason="the example needs the extras 'examples' and 'bench'")
import mujoco  # noqa: E402
from matplotlib.image import imread  # noqa: E402

BACKEND = "auto"


@pytest.fixture(scope="module")
def example():
    return import_module("06_residual_learning")


@pytest.fixture(scope="module")
def plant(example):
    return example.Plant(seed=3)


# --- the arm ---------------------------------------------------------------------------------------------------------


def test_the_true_model_is_the_inverse_of_what_mujoco_simulates(example, plant):
    rng = np.random.default_rng(0)
    q, qdd = rng.uniform(-1, 1, (2, 20, 7))
    qd = rng.uniform(0.5, 1.5, (20, 7)) * rng.choice((-1, 1), (20, 7))  # dry friction is dry, not about to stick
    data, expected = mujoco.MjData(plant.model), []
    for rows in zip(q, qd, qdd, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = rows
        mujoco.mj_inverse(plant.model, data)
        expected.append(data.qfrc_inverse - plant.unmodelled(*rows[:2]))
    found = example.truth(plant)(*(torch.tensor(x) for x in (q, qd, qdd))).numpy()
    np.testing.assert_allclose(found, expected, atol=5e-3)


def test_the_arm_is_another_than_the_model(example, plant):
    nominal = example.nominal_robot()
    ratio = (plant.robot.mass / nominal.mass).numpy()
    assert ((abs(ratio[:6] - 1) >= 0.1) & (abs(ratio[:6] - 1) <= 0.2)).all()
    factor = float(plant.robot.mass[6] - 1.5) / float(nominal.mass[6])  # beside the payload
    assert 0.1 <= abs(factor - 1) <= 0.2
    assert not torch.equal(plant.robot.mass, example.Plant(seed=4).robot.mass)
    assert torch.equal(plant.robot.mass, example.Plant(seed=3).robot.mass)
    assert plant.model.dof_frictionloss.min() > 0 and plant.model.dof_armature.min() > 0


def test_motors_lag_and_readings_are_noisy(example, plant):
    still = example.Reference(*(np.zeros((8, 400, 7)) + x for x in (example.CENTRE, 0.0, 0.0)))
    calls = []

    def switched_on(q, qd, now):
        calls.append((q, qd))
        return np.zeros_like(q) if len(calls) == 1 else np.ones_like(q)

    readings = plant.run(switched_on, still, np.random.default_rng(0))
    expected = 1 - np.exp(-example.STEP / example.LAG * np.arange(8))
    noise = plant.noise
    assert plant.noise.min() > 0.1
    assert (abs(readings.tau.mean(1) - expected[:, None]) < 5 * noise / 20).all()
    np.testing.assert_allclose(readings.tau.std(1), np.broadcast_to(noise, (8, 7)), rtol=0.15)
    q, qd = calls[0]
    assert 0.5e-4 < (q - example.CENTRE).std() < 2e-4 and 0.5e-2 < qd.std() < 2e-2


# --- motions ---------------------------------------------------------------------------------------------------------


def test_every_model_gets_the_same_feedback(example, plant):
    robot = example.nominal_robot()
    rng = np.random.default_rng(0)
    q, qd = rng.normal(size=(2, 3, 7))
    wanted = example.Reference(*rng.normal(size=(3, 3, 7)))
    model = lambda *state: torchdq.inverse_dynamics(robot, *state)  # noqa: E731
    none = lambda q, qd, qdd: torch.zeros_like(q)  # noqa: E731
    difference = example.following(plant, model)(q, qd, wanted) - example.following(plant, none)(q, qd, wanted)
    expected = torchdq.inverse_dynamics(robot, *map(torch.tensor, (q, qd, wanted.qdd))).numpy()
    np.testing.assert_allclose(difference, expected, atol=1e-4)  # computed in float32


def test_filtering_recovers_a_known_motion(example):
    time = np.arange(0, 4, example.STEP)[:, None, None]
    phase = 3.0 * time + np.arange(7)
    rng = np.random.default_rng(0)
    readings = example.Readings(
        np.sin(phase), 3 * np.cos(phase) + rng.normal(0, 1e-2, phase.shape), 5 * np.sin(phase), 0 * phase
    )
    found = example.learnable(readings)
    assert len(found.q) == 300  # 100 Hz, without half a second at either end
    assert (found.qdd + 9 * found.q).square().mean().sqrt() < 0.08  # 3.5 without the filter
    assert (found.tau - 5 * found.q).abs().max() < 1e-2


def test_no_motion_is_learned_from_and_tested_on(example, plant):
    args = example.Args(samples=(400,), seconds=3.0)
    data = example.recorded(plant, example.nominal_robot(), args, np.random.default_rng(0))
    sets = [{tuple(row) for row in part.q.tolist()} for part in data]
    assert len(set.union(*sets)) == sum(map(len, sets)) == sum(len(part.q) for part in data)
    assert data.far.qd.square().mean() > 1.5 * data.near.qd.square().mean()
    centre, spread = data.train.q.mean(0), data.train.q.std(0)
    assert ((data.far.q - centre).abs() > 2 * spread).float().mean() > 0.3
    assert ((data.near.q - centre).abs() > 2 * spread).float().mean() < 0.2


# --- the table -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(example, tmp_path_factory):
    """The quick run, with motions of 0.8 s to be tracked, and the folder it wrote to."""
    folder, tracking = tmp_path_factory.mktemp("residual"), example.tracking
    with torchdq.backend(BACKEND), pytest.MonkeyPatch.context() as patched:
        patched.setattr(example, "tracking", lambda plant, model, seed, seconds: tracking(plant, model, seed, 0.8))
        found = example.main(example.Args(quick=True, out=folder / "new", json=folder / "found.json"))
    return found, folder


def test_tracking_improves_with_what_the_model_knows(example, run):
    (results,) = run[0][2000].values()
    error = {name: result.track_near for name, result in results.items()}
    assert error[example.NOTHING] > 1.5 * error[example.GRAVITY]
    assert error[example.NOMINAL] > error[example.FRICTION] > 1.7 * error[example.RESIDUAL]
    assert error[example.FRICTION] > 3 * error[example.PHYSICS] > 3 * error[example.BOTH]
    assert error[example.TRUE] == min(error.values()) < 2.0  # [mrad]
    assert results[example.TRUE].track_far < 2.0


def test_torque_errors_near_and_far(example, run):
    (results,) = run[0][2000].values()
    near = {name: np.mean(result.near) for name, result in results.items() if result.near}
    far = {name: np.mean(result.far) for name, result in results.items() if result.far}
    assert len(near) == len(far) == len(results) - 2
    # a network beside physics sees the state alone, and cannot learn masses
    assert near[example.FRICTION] > 2 * near[example.RESIDUAL] > 2 * near[example.BLACK] > 2 * near[example.BOTH]
    assert far[example.BLACK] > 5 * far[example.BOTH]  # a network alone does not extrapolate
    assert far[example.TRUE] < 0.01


def test_more_samples_help(example, run):
    few, many = (next(iter(run[0][size].values()))[example.BOTH] for size in (300, 2000))
    assert np.mean(many.near) < np.mean(few.near)
    assert few.track_near is None  # tracked with the most samples only


def test_numbers_and_picture_are_written(example, run):
    found, folder = run
    written = json.loads((folder / "found.json").read_text())["results"]
    for size, arms in found.items():
        for seed, results in arms.items():
            for name, result in results.items():
                assert written[str(size)][str(seed)][name] == result._asdict()
    picture = imread(folder / "new" / "residual_learning.png")[..., :3]
    assert picture.shape[0] > 500 and picture.shape[1] > 900 and picture.std() > 0.03


def test_intervals_are_of_the_mean(example):
    values = np.random.default_rng(1).normal(5.0, 1.0, 400)
    low, high = example.interval(values)
    assert low < values.mean() < high
    assert abs((high - low) / (2 * 1.96 * values.std() / 20) - 1) < 0.1
    assert example.interval([2.0]) == (2.0, 2.0)
