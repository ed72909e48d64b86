"""Lags of measured torques are those of the log, whatever friction was chosen with them; friction alone is none."""

import math

import pytest
from recorded_logs import REAL, ROBOT, STEP, codes, fitted, late_log, states, torques, with_findings

from torchdq.learning import identify, smooth


@pytest.mark.parametrize("late", [0.03, -0.03])
def test_a_lag_is_found_with_friction_that_was_chosen_for_it(late):
    """Friction of other shapes takes a half of the lag, were it not moved with the model."""
    logs = [late_log(late, seed) for seed in (1, 2, 3)]
    found, (lag,) = with_findings(identify, ROBOT, [smooth(log) for log in logs])
    assert len(found.terms) > 2 and lag.code == "torque.lag" and abs(lag.value - late) < 0.6e-3
    if late > 0:
        mended, findings = with_findings(identify, ROBOT, [smooth(log, delay=round(lag.value, 3)) for log in logs])
        assert not findings and not any(term.bristles for term in mended.terms)


@pytest.mark.parametrize("period", [0.3, 0.7, 1.5])
def test_ripple_is_no_lag(period):
    q, qd, qdd = states(3, 500, seed=1)
    tau = torques(REAL, q, qd, qdd) + 2.0 * (2 * math.pi * q / period).sin()
    assert "torque.lag" not in codes(with_findings(fitted, ROBOT, q, qd, qdd, tau)[1])


def test_a_lag_of_many_rows_is_found_in_rows():
    q, qd, qdd = states(3, 500)
    late = 8
    tau = torques(REAL, q, qd, qdd)[:, :-late]
    _, (lag,) = with_findings(fitted, ROBOT, *(x[:, late:] for x in (q, qd, qdd)), tau)
    assert lag.code == "torque.lag" and lag.value == pytest.approx(late * STEP, rel=0.05)
