"""Friction found from filtered logs is that of the robot, within the stated errors, at any rate of the log."""

import pytest
import torch
from helpers import all_in_one, thinned
from recorded_logs import codes, fitted, noisy_log, with_findings

import torchdq
from torchdq.learning import smooth, stack_samples

pytest.importorskip("scipy", reason="smoothing needs scipy")


EVERY = [(name, rate) for name in ("two_link", "ur10e", "panda") for rate in (100, 500, 1000)]


@pytest.mark.parametrize(("name", "rate"), thinned(EVERY, [("two_link", 100), ("two_link", 1000)]))
def test_friction_is_found_within_the_stated_errors(name, rate):
    robot = torchdq.robots.load(name)
    log, viscous, coulomb = noisy_log(robot, rate, seed=rate)
    motion = smooth(log, rate=16)
    found, findings = with_findings(fitted, robot, motion)
    assert not findings and float(errors(found, viscous, coulomb).abs().max()) < 3
    assert float((found.coulomb / coulomb - 1).abs().max()) < 0.03
    sharp = fitted(robot, *stack_samples(motion))
    assert float((sharp.coulomb / coulomb).mean()) < 0.98  # what the rounded steps cost otherwise


def errors(found, *truths):
    """Distances of viscous and Coulomb friction from the true ones, in standard errors."""
    friction = slice(-2 * found.robot.n, None)
    return (found.parameters[friction] - torch.cat(truths)) / found.errors[friction]


@all_in_one(thinned([0.03, 0.1], [0.1]))
def test_friction_of_another_shape_has_a_finding_and_its_width_is_the_cure(width):
    """Friction as simulated, which is viscous below a width, with the sign of a sharp step."""
    robot = torchdq.robots.load("two_link")
    log, *truths = noisy_log(robot, 100, 3, width)
    biased, findings = with_findings(fitted, robot, smooth(log, rate=16))
    assert codes(findings) == ["friction.shape"] and "smooth(log) its sign_width" in findings[0].cure
    assert "--sign-width" in findings[0].option and findings[0].subject in robot.joint_names
    assert errors(biased, *truths).abs().max() > 3
    found, findings = with_findings(fitted, robot, smooth(log, rate=16, sign_width=width), sign_width=width)
    assert not findings and errors(found, *truths).abs().max() < 3


def test_dry_friction_of_filtered_torques_has_a_finding_without_the_filtered_sign():
    robot = torchdq.robots.load("two_link")
    data = stack_samples(smooth(noisy_log(robot, 100, 3)[0], rate=16))
    _, findings = with_findings(fitted, robot, *data)
    assert (findings[0].code, findings[0].subject) == ("friction.shape", "joint1")
    assert "motions of smooth(log), which hold the filtered sign" in findings[0].cure
