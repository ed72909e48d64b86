"""Constant torques that a fit lacks are found or named; what was asked for is all that is fitted.

The truth is that of the simulation, whose laws are written out here.
"""

import math

import pytest
import torch
from helpers import exhaustive, thinned
from places import DATA
from recorded_logs import COULOMB, REAL, ROBOT, WIDTH, codes, fitted, recordings, sign, states, torques, with_findings

import torchdq
from torchdq import Scene, effects
from torchdq.learning import Model, Samples, identify, posterior_samples, stack_samples

BACKEND = "auto"  # one arm, whose programs all tests share
CONSTANT = torch.tensor([1.5, -0.8], dtype=torch.float64)


@pytest.mark.parametrize("narrow", thinned([1.0, 0.4], [0.4]))
def test_constant_torques_are_found_and_no_ripple_is(narrow):
    """In a narrow range of positions a cosine is nearly constant, and so is gravity."""
    q, qd, qdd = (narrow * x for x in states(6, 500, seed=3))
    tau = torques(REAL, q, qd, qdd, size=0.03) + CONSTANT
    found, findings = with_findings(identify, ROBOT, Samples(q, qd, qdd, tau))
    assert found.selection.chosen.name == "identified, offsets" and not findings
    assert float(((found.offset - CONSTANT) / found.errors[-2:]).abs().max()) < 4
    assert torch.allclose(found.coulomb, COULOMB, rtol=0.1)
    assert "offset (" in str(found.selection)


def test_an_offset_is_estimated_only_where_it_may_be():
    q, qd, qdd = states(5, 400)
    clean = torques(REAL, q, qd, qdd)
    found, findings = with_findings(identify, ROBOT, Samples(q, qd, qdd, clean))
    assert found.offset is None and not findings
    found, findings = with_findings(fitted, ROBOT, q, qd, qdd, clean + CONSTANT)
    assert found.offset is None and codes(findings) == ["torque.offset"] and findings == [*found.findings]
    assert [one.subject for one in findings] == ["joint1", "joint2"] and "--offset" in findings[0].option
    assert [one.value for one in findings] == pytest.approx(CONSTANT.tolist(), abs=0.1)
    assert not with_findings(fitted, ROBOT, q, qd, qdd, clean + CONSTANT, offset=True)[1]


def test_friction_that_differs_by_direction_is_no_ripple():
    q, qd, qdd = states(6, 500, seed=4)
    more = torch.where(qd > 0, 0.4, 0.0) * sign(qd)
    samples = Samples(q, qd, qdd, torques(REAL, q, qd, qdd, size=0.03) + more)
    found, findings = with_findings(identify, ROBOT, samples)
    assert {gain.term for gain in found.selection.chosen.gains} <= {"forward", "offset"} and not findings
    _, findings = with_findings(fitted, ROBOT, q, qd, qdd, torques(REAL, q, qd, qdd) + 4 * more)
    assert codes(findings) == ["torque.offset"] and "friction that differs by direction has one" in findings[0].cure


def test_friction_effects_that_are_given_are_fitted_and_no_others():
    q, qd, qdd = states(5, 500)
    extra = 0.6 * qd * qd.abs() + 0.5 * (2 * math.pi * q / 0.7).cos()
    tau = torques(REAL, q, qd, qdd, size=0.03) + extra
    asked = (effects.Viscous(), effects.Coulomb(sign_width=WIDTH), effects.Quadratic(), effects.Ripple(period=0.7))
    for prior in (1.0, None):
        found = fitted(ROBOT, q, qd, qdd, tau, friction=asked, prior=prior, offset=False)
        names = [term.name for term in found.terms]
        assert names == ["viscous", "coulomb", "quadratic", "ripple sine 0.7", "ripple cosine 0.7"]
        for name, truth in (("quadratic", 0.6), ("ripple cosine 0.7", 0.5), ("ripple sine 0.7", 0.0)):
            assert float((found.coefficients(name) - truth).abs().max()) < 0.08, name
        assert torch.allclose(found.layer()(q, qd, qdd), found.predict(q, qd, qdd).tau, atol=1e-9)


def test_effects_have_terms_of_their_own_laws():
    q, qd, qdd = states(3, 300)
    tau = torques(REAL, q, qd, qdd)

    def names(*friction):
        return [term.name for term in fitted(ROBOT, q, qd, qdd, tau, friction=friction).terms]

    assert names(effects.Stribeck(velocity=0.25, sign_width=WIDTH)) == ["coulomb", "stribeck 0.25"]
    both = effects.Stribeck(velocity=0.1, sign_width=WIDTH), effects.Coulomb(sign_width=WIDTH)
    assert names(*both) == ["coulomb", "stribeck 0.1"]
    assert names(effects.Coulomb(sign_width=0.5)) == ["coulomb 0.5"]
    assert names(effects.LuGre(deflection=0.02)) == ["lugre 0.02"]
    both = effects.Directional(sign_width=WIDTH), effects.LoadDependent(sign_width=WIDTH)
    assert names(*both) == ["forward", "backward", "load"]
    again = fitted(ROBOT, q, qd, qdd, tau)
    assert [*again.terms] == [*fitted(ROBOT, q, qd, qdd, tau, friction=again.friction()).terms]


def test_robots_that_are_drawn_have_all_friction_found():
    q, qd, qdd = states(5, 500)
    tau = torques(REAL, q, qd, qdd, size=0.05) + 0.6 * qd * qd.abs() + 0.4 * (3 * q).sin()
    asked = (effects.Viscous(), effects.Coulomb(sign_width=WIDTH), effects.Quadratic(), effects.Ripple(2 * math.pi / 3))
    found = fitted(ROBOT, q, qd, qdd, tau, friction=asked)
    drawn = posterior_samples(found, 8)
    kinds = [type(effect).__name__ for effect in drawn.effects()]
    assert kinds == ["Gravity", "Viscous", "Coulomb", "Quadratic", "Ripple", "Ripple"]
    wave = drawn.coefficients(next(term.name for term in found.terms if term.parameter == "sine"))
    assert bool(((wave - 0.4).abs() < 0.1).all()) and float(wave.std(0).min()) > 0
    assert bool((drawn.coefficients("quadratic") > 0).all()) and drawn.coefficients("load") is None
    x, v = torch.full((8, 2), 0.3).double(), torch.full((8, 2), 0.5).double()
    scene = Scene(drawn.robot, drawn.effects(), dt=1e-4)
    after = scene.step(scene.start(x, v), torch.zeros(8, 2).double())
    viscous, coulomb, quadratic = (drawn.coefficients(name) for name in ("viscous", "coulomb", "quadratic"))
    cosine = drawn.coefficients(next(term.name for term in found.terms if term.parameter == "cosine"))
    rub = viscous * v + coulomb * sign(v) + quadratic * v * v + wave * (3 * x).sin() + cosine * (3 * x).cos()
    expected = torchdq.forward_dynamics(drawn.robot, x, v, -rub)
    assert torch.allclose((after.qd - v) / 1e-4, expected, rtol=0.02, atol=0.02 * float(expected.abs().max()))


@exhaustive
def test_errors_hold_what_blocks_that_were_left_out_show():
    """Torques that no term explains: intervals of the parameters alone are too narrow in motions that were left out."""

    def wrong(q, k):
        a, b = q.unbind(-1)
        return torch.stack([(7 * b + k).sin() * a.cos(), (5 * a).cos() * (4 * b).sin()], -1)

    inside = []
    for seed in range(3):
        q, qd, qdd = states(1, 500, seed=seed)
        tau = torques(REAL, q, qd, qdd, size=0.05, seed=seed) + wrong(q, seed)
        found = identify(ROBOT, Samples(q, qd, qdd, tau))
        other = states(3, 400, seed=100 + seed)
        new = torques(REAL, *other, size=0.05, seed=seed + 50) + wrong(other[0], seed)
        predicted, alone = found.predict(*other), found._replace(model=torch.zeros(2).double()).predict(*other).error
        assert torch.allclose(predicted.error.square(), alone.square() + found.model.square())
        inside.append(float(((new > predicted.low) & (new < predicted.high)).double().mean()))
        own = found._replace(model=0 * found.model).predict(q, qd, qdd).error.square().mean((0, 1))
        expected = (found.selection.left - found.noise.square() - own).clamp_min(0).sqrt()
        assert torch.allclose(found.model, expected, rtol=1e-3, atol=1e-3 * float(found.noise.max()))
    assert min(inside) > 0.9 and 0.93 < sum(inside) / len(inside) < 0.97
    q, qd, qdd = states(5, 400)
    right = identify(ROBOT, Samples(q, qd, qdd, torques(REAL, q, qd, qdd)))
    assert bool((right.model < 0.4 * right.noise).all())
    given = fitted(ROBOT, q, qd, qdd, torques(REAL, q, qd, qdd))
    assert not bool(given.model.any())


@pytest.mark.filterwarnings("ignore")
def test_intervals_hold_in_the_rest_of_a_recording():
    recordings("panda_gaz2019")
    splits = pytest.importorskip("splits")
    split = splits.panda(DATA, False)[1]  # identified on less than a third; 0.85 with errors of the parameters alone
    found = identify(split.robot, split.train, Model(armature=True, offset=True))
    predicted, tau = found.predict(split.test), stack_samples(split.test).tau
    assert 0.93 < float(((tau > predicted.low) & (tau < predicted.high)).double().mean()) < 0.99
