"""Lags of measured torques are those of the log, whatever friction was chosen with them; friction alone is none."""

import math

import pytest
import torch
from helpers import all_in_one, exhaustive, thinned
from recorded_logs import COULOMB, REAL, ROBOT, STEP, codes, fitted, late_log, states, torques, with_findings

from torchdq.learning import identify, smooth

BACKEND = "auto"  # one arm, whose programs all tests share


@exhaustive
def test_a_lag_is_found_with_friction_that_was_chosen_for_it():
    """Friction of other shapes takes a half of the lag, were it not moved with the model."""
    logs = [late_log(0.03, seed) for seed in (1, 2, 3)]
    found, (lag,) = with_findings(identify, ROBOT, [smooth(log) for log in logs])
    assert len(found.terms) > 2 and lag.code == "torque.lag" and abs(lag.value - 0.03) < 0.6e-3
    mended, findings = with_findings(identify, ROBOT, [smooth(log, delay=round(lag.value, 3)) for log in logs])
    assert not findings and not any(term.bristles for term in mended.terms)


@all_in_one(thinned([0.05, -0.03], [0.05]))
def test_a_lag_of_the_torques_has_a_finding_with_its_size_and_its_cure(late):
    logs = [late_log(late, seed) for seed in (1, 2, 3)]
    found, (lag,) = with_findings(fitted, ROBOT, [smooth(log) for log in logs])
    assert (lag.code, lag.subject) == ("torque.lag", "3 motions") and lag.value == pytest.approx(late, rel=0.2)
    assert f"smooth(log, delay={lag.value:.2g})" in lag.cure and f"--delay {lag.value:.2g}" in lag.option
    mended, findings = with_findings(fitted, ROBOT, [smooth(log, delay=late) for log in logs])
    assert not findings
    off = [float((one.coulomb - COULOMB).abs().max()) for one in (found, mended)]
    assert off[1] < 0.05 < off[0]


def test_each_log_has_a_lag_of_its_own():
    motions = [smooth(late_log(late, seed)) for seed, late in ((1, 0.0), (2, 0.06), (3, 0.0))]
    _, (lag,) = with_findings(fitted, ROBOT, motions)
    assert (lag.code, lag.subject) == ("torque.lag", "log2")


@all_in_one(thinned([0.3, 0.7, 1.5], [0.7]))
def test_ripple_is_no_lag(period):
    q, qd, qdd = states(3, 500, seed=1)
    tau = torques(REAL, q, qd, qdd) + 2.0 * (2 * math.pi * q / period).sin()
    assert "torque.lag" not in codes(with_findings(fitted, ROBOT, q, qd, qdd, tau)[1])


@pytest.mark.parametrize(("late", "error"), thinned([(3, 0.2), (8, 0.05)], [(8, 0.05)]))
def test_a_lag_of_many_rows_is_found_in_rows(late, error):
    moved = states(3, 500)
    signals = [*(x[:, late:] for x in moved), torques(REAL, *moved)[:, :-late]]
    _, (lag,) = with_findings(fitted, ROBOT, *signals)
    assert lag.code == "torque.lag" and lag.value == pytest.approx(late * STEP, rel=error) and "rows up" in lag.cure
    mixed = torch.randperm(500 - late, generator=torch.Generator().manual_seed(0))
    _, findings = with_findings(fitted, ROBOT, *(x[:, mixed] for x in signals))
    assert "torque.lag" not in codes(findings)  # rows in no order have no time
