"""Sensors change measurements as their formulas say, in their order."""

import math

import numpy as np
import pytest
import torch
from effect_harness import CASES, FORMS, SAMPLES, U, close, double, forms_of
from scipy import stats

from torchdq import Scene, effects


def read(effect, q, qd=None, noise=None):
    scene = Scene(CASES["two_link"].robot, (effect,) if isinstance(effect, effects.Effect) else effect)
    return scene.start(q, qd, noise)


SPREAD = {"position": [0.1, 0.02], "velocity": [0.5, 3.0]}
MANY = 40_000


def test_noise_is_normal_with_its_standard_deviation_and_without_correlation():
    torch.manual_seed(0)
    q = torch.zeros(MANY, 2, dtype=torch.float64)
    scene = Scene(CASES["two_link"].robot, (effects.Noise(**SPREAD),))
    state = scene.start(q)
    readings = [state.reading, scene.step(state).reading]
    z = torch.cat(readings, -1).numpy() / np.tile(SPREAD["position"] + SPREAD["velocity"], 2)
    four_sigma = 4 / math.sqrt(MANY)
    assert np.abs(z.mean(0)).max() < four_sigma
    assert np.abs(z.std(0) - 1).max() < four_sigma / math.sqrt(2)
    assert np.abs(np.corrcoef(z.T) - np.eye(8)).max() < four_sigma
    assert min(stats.kstest(column, "norm").pvalue for column in z.T) > 1e-4
    assert np.abs(np.corrcoef(np.abs(z).T) - np.eye(8)).max() < four_sigma  # nor do they share a radius


def test_noise_is_drawn_anew_and_from_torchs_generator():
    torch.manual_seed(3)
    scene = Scene(CASES["two_link"].robot, (effects.Noise(0.1, 0.1),))
    q = torch.zeros(4, 2, dtype=torch.float64)
    once, twice = scene.start(q).reading, scene.start(q).reading
    torch.manual_seed(3)
    assert torch.equal(scene.start(q).reading, once)
    assert not torch.equal(once, twice)


def test_two_noises_of_a_reading_are_drawn_apart():
    rest, noise = torch.zeros(2, dtype=torch.float64), double([0.2, 0.7, 0.9, 0.4, 0.5, 0.1, 0.3, 0.8])
    kinds = (effects.Noise(0.1, 0.2), effects.Noise(0.3, 0.5))
    alone = [read(kind, rest, noise=part).reading for kind, part in zip(kinds, noise.split(4), strict=True)]
    assert torch.allclose(read(kinds, rest, noise=noise).reading, sum(alone), rtol=1e-14, atol=0)


def test_extreme_draws_are_finite(monkeypatch):
    """A draw of one is no noise; a generator that returns zero gives finite noise."""
    rest, noise = torch.zeros(2, dtype=torch.float64), torch.ones(4, dtype=torch.float64)
    assert torch.equal(read(effects.Noise(0.1, 0.1), rest, noise=noise).reading, torch.zeros(4, dtype=torch.float64))
    monkeypatch.setattr(torch, "rand", torch.zeros)
    assert read(effects.Noise(0.1, 0.1), rest).reading.isfinite().all()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("kind", "formula"),
    [("Bias", lambda x, b: x + b), ("QuantisedReading", lambda x, step: np.round(x / step) * step)],
    ids=["Bias", "QuantisedReading"],
)
def test_a_sensor_without_noise_is_its_formula(kind, formula, form):
    q, qd = U[:SAMPLES], U[SAMPLES : 2 * SAMPLES]
    parameters, values = forms_of({"position": (0.1, 1.0), "velocity": (0.1, 1.0)}, form, 2)
    expected = np.concatenate([formula(q.numpy(), values["position"]), formula(qd.numpy(), values["velocity"])], -1)
    assert close(read(getattr(effects, kind)(**parameters), q, qd).reading, expected, 1.0)


def test_a_bias_may_be_negative_and_is_added_exactly():
    biased = read(effects.Bias(-0.7, [0.3, -2.0]), U, U).reading
    assert torch.equal(biased, torch.cat([U - 0.7, U + double([0.3, -2.0])], -1))


def test_readings_in_steps_of_zero_are_exact_and_cost_nothing():
    robot = CASES["two_link"].robot
    assert torch.equal(read(effects.QuantisedReading(), U, U).reading, torch.cat([U, U], -1))
    assert Scene(robot, (effects.QuantisedReading(),)).count() == Scene(robot).count()


@pytest.mark.parametrize("steps", [1, 3])
def test_a_reading_delay_shows_the_state_of_so_many_steps_ago(steps):
    scene = Scene(CASES["two_link"].robot, (effects.MeasurementDelay(steps),))
    state = scene.start(double([0.3, 0.4]), double([1.0, -1.0]))
    truth, shown = [torch.cat([state.q, state.qd])], [state.reading]
    for u in U:
        state = scene.step(state, u)
        truth.append(torch.cat([state.q, state.qd]))
        shown.append(state.reading)
    assert torch.equal(torch.stack(shown[:steps]), truth[0].expand(steps, 4))
    assert torch.equal(torch.stack(shown[steps:]), torch.stack(truth[: len(truth) - steps]))


def test_sensors_act_in_their_order():
    q = double([0.34, 0.56])
    biased = read((effects.Bias(0.03), effects.QuantisedReading(0.1)), q).measured[0]
    rounded = read((effects.QuantisedReading(0.1), effects.Bias(0.03)), q).measured[0]
    assert torch.allclose(biased, double([0.4, 0.6]), atol=1e-15)
    assert torch.allclose(rounded, double([0.33, 0.63]), atol=1e-15)
