"""Lags of measured torques are those of the log, whatever friction was chosen with them; friction alone is none."""

import math

import pytest
import torch
from learning.identification.test_missing import log_of, told
from learning.identification.test_model_selection import REAL, ROBOT, WIDTH, states, torques

from torchdq.learning import smooth


@pytest.mark.parametrize("late", [0.03, -0.03])
def test_a_lag_is_found_beside_friction_that_was_chosen_for_it(late):
    """Friction of other shapes takes a half of the lag, were it not moved with the model."""
    motions = [smooth(log_of(late, seed)) for seed in (1, 2, 3)]
    found, words = told(ROBOT, motions)
    assert len(found.terms) > 2 and len(words) == 1
    size, error = words[0].split("about ")[1].split(" ms")[0].split(" +- ")
    assert abs(float(size) - 1e3 * abs(late)) < max(0.6, 4 * float(error))
    if late > 0:
        delay = float(words[0].split("delay=")[1].split(")")[0])
        mended, words = told(ROBOT, [smooth(log_of(late, seed), delay=delay) for seed in (1, 2, 3)])
        assert not words and not any(term.bristles for term in mended.terms)


@pytest.mark.parametrize("period", [0.3, 0.7, 1.5])
def test_ripple_is_no_lag(period):
    q, qd, qdd = states(3, 500, seed=1)
    tau = torques(REAL, q, qd, qdd) + 2.0 * (2 * math.pi * q / period).sin()
    _, words = told(ROBOT, q, qd, qdd, tau, friction=True, prior=1.0, width=WIDTH)
    assert not any("the motion in" in one for one in words)


def test_a_lag_of_many_rows_is_found_in_rows():
    q, qd, qdd = states(3, 500)
    late = 8
    tau = torques(REAL, q, qd, qdd)[:, :-late]
    _, words = told(ROBOT, *(x[:, late:] for x in (q, qd, qdd)), tau, friction=True, prior=1.0, width=WIDTH)
    assert len(words) == 1 and float(words[0].split("moving them ")[1].split(" rows")[0]) == pytest.approx(
        late, rel=0.05
    )
    assert torch.isfinite(tau).all()
