"""Intervals of predicted torques: as wide as rows that were left out ask for, whatever the errors are like."""

import pytest
import torch
from helpers import all_in_one, double
from recorded_logs import ROBOT as TWO
from recorded_logs import fitted, states

import torchdq
from torchdq.learning import Samples, identify
from torchdq.learning.evaluation.statistics import interval_factors

F64 = torch.float64


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def held(factors, ratios):
    return float(torch.stack([(ratio.abs() <= factors).double().mean() for ratio in ratios]).mean())


@all_in_one([0.5, 1.0, 2.0])
def test_blocks_alike_have_the_quantile_of_all_rows(power):
    """Powers of normal numbers: from tails that are lighter than theirs to far heavier ones."""
    normal = torch.randn(8, 5000, 1, generator=generator(), dtype=F64)
    found = interval_factors(list(normal.abs() ** power))
    assert float(found) == pytest.approx(1.96**power, rel=0.05)


def test_blocks_that_differ_leave_room_for_another_one():
    """Sizes that vary from motion to motion: the quantile of the known ones alone would hold fewer of a new one."""
    plain, found = [], []
    for seed in range(200):
        g = generator(seed)
        sizes = torch.exp(0.5 * torch.randn(7, 1, 1, generator=g, dtype=F64))
        blocks = sizes * torch.randn(7, 300, 1, generator=g, dtype=F64)
        known, new = list(blocks[:-1]), [blocks[-1]]
        plain.append(held(torch.cat(known).abs().quantile(0.95, 0), new))
        found.append(held(interval_factors(known), new))
    assert sum(plain) / 200 < 0.94 and sum(found) / 200 == pytest.approx(0.95, abs=0.005)


def test_one_block_has_its_own_quantile_and_none_of_zeros_is_wide():
    one = torch.randn(1000, 2, generator=generator(), dtype=F64)
    assert torch.equal(interval_factors([one]), one.abs().quantile(0.95, 0))
    assert torch.equal(interval_factors([torch.zeros(50, 2, dtype=F64)] * 3), torch.zeros(2, dtype=F64))


def test_a_block_that_is_unlike_all_others_widens_no_more_than_twice():
    blocks = torch.randn(4, 1000, 1, generator=generator(), dtype=F64)
    blocks[0] *= 20
    assert float(interval_factors(list(blocks))) == 2 * float(blocks.flatten().abs().quantile(0.95))


def test_rows_without_a_number_do_not_count():
    rows = torch.randn(6, 500, 2, generator=generator(), dtype=F64)
    gaps = rows.repeat_interleave(2, 1)
    gaps[:, ::2] = torch.nan
    assert torch.equal(interval_factors(list(gaps)), interval_factors(list(rows)))


def motion(seed, noise):
    """A motion, and torques with a few outliers at the first joint, and noise of two values at the second."""
    (q, qd, qdd), g = (x[0] for x in states(1, 300, seed)), generator(seed)
    white = torch.randn(len(q), 2, generator=g, dtype=F64)
    tau = torchdq.inverse_dynamics(TWO, q, qd, qdd) + 0.3 * qd
    spikes = torch.where(torch.rand(len(q), generator=g) < 0.03, 10.0, 1.0)
    return q, qd, qdd, tau + noise * torch.stack([spikes * white[:, 0], white[:, 1].sign()], -1)


def test_intervals_of_an_identified_robot_hold_their_share_whatever_the_noise_is_like():
    motions = [torch.stack(x) for x in zip(*(motion(seed, 0.2) for seed in range(5)), strict=True)]
    found = identify(TWO, Samples(*motions))
    q, qd, qdd, tau = (torch.stack(x) for x in zip(*(motion(seed, 0.2) for seed in range(50, 70)), strict=True))
    predicted = found.predict(q, qd, qdd)
    assert torch.allclose(predicted.high - predicted.tau, predicted.tau - predicted.low)
    inside = ((tau > predicted.low) & (tau < predicted.high)).double().mean((0, 1))
    assert 0.93 < float(inside[0]) < 0.97 and float(inside[1]) > 0.93
    normal = 1.96 * torch.hypot(predicted.error, found.noise)
    narrower = ((tau - predicted.tau).abs() < normal).double()[..., 0].mean()
    assert float(narrower) > 0.97  # outliers make a deviation large
    assert float(found.half_width[1]) < 1.3  # no torque is off by more than one standard deviation


def test_a_model_that_was_given_has_the_intervals_of_normal_errors():
    q, qd, qdd, tau = motion(0, 0.1)
    found = fitted(TWO, q, qd, qdd, tau)
    some = qd.abs().amin(-1) > 1.0  # they slide
    predicted = found.predict(q[some], qd[some], qdd[some])
    assert torch.equal(found.half_width, double(1.96, 1.96)) and not found.model.any()
    half = (predicted.high - predicted.low) / 2
    assert torch.allclose(half, 1.96 * torch.hypot(predicted.error, found.noise), rtol=1e-4)


def test_intervals_have_room_for_friction_at_rest_and_for_speeds_beyond_the_samples():
    q, qd, qdd, tau = motion(0, 0.1)
    found = fitted(TWO, q, qd, qdd, tau + 2.0 * qd.sign())
    at_rest, other = torch.zeros_like(qd), torch.zeros_like(qd)
    other[:, 1] = 0.5 * qd[:, 1].abs().amax()
    fast = qd.abs().amax(0) * double(1.5, 3.0)

    def half(qd):
        predicted = found.predict(q, qd, qdd)
        return (predicted.high - predicted.low) / 2, 1.96 * torch.hypot(predicted.error, found.noise)

    for speed, held in ((at_rest, double(1.0, 1.0)), (other, double(1.0, 0.0))):
        width, sliding = half(speed)
        assert torch.allclose(width - sliding, (held * found.coulomb).expand_as(width), atol=1e-3)
    width, sliding = half(fast.expand_as(qd))
    assert torch.allclose(width, 3.0 * sliding, rtol=1e-3)
