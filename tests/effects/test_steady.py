"""Friction at the speeds that reports state: a joint driven by that torque keeps its speed, or begins to slide."""

import pytest
import torch
from helpers import double

import torchdq
from torchdq import Scene
from torchdq.dynamics.friction import SPEEDS
from torchdq.effects import Coulomb, Directional, Gravity, LoadDependent, LuGre, Quadratic, Ripple, Stribeck, Viscous
from torchdq.effects.steady import at_speeds, lines

SLIDER = torchdq.Robot.from_screws([[0, 0, 0, 1.0, 0, 0]], [2.0], [[0.0, 0.0, 0.0]], [torch.zeros(3, 3)], name="slider")
TWO = torchdq.robots.load("two_link")
DRY = {
    "Coulomb": Coulomb(0.5, 0.001),
    "Stribeck": Stribeck(0.5, 0.8, 0.2, 0.001),
    "two ways": Directional(0.5, 0.8, 0.001),
}
BRISTLES = LuGre(0.5, 1e-4, ratio=1.6, velocity=0.3)
LAWS = {
    **DRY,
    "viscous": Viscous(0.4),
    "quadratic": Quadratic(0.3),
    "Coulomb with a wide sign": Coulomb(0.5, 0.3),
    "warm": Viscous(0.4, warming=-0.01),
}


def stated(effect):
    """Torques that are stated for the slider at each speed, forwards and backwards."""
    texts = [row[0].split("/") for row in at_speeds((effect.resolved(SLIDER),), 1)]
    return [(float(text[0]), -float(text[-1])) for text in texts]


def driven(effect, torques, speeds, robot=SLIDER, steps=200, slowly=False):
    """Velocities [steps, rows] of a slider under constant forces, or ones that grow over half of the time."""
    scene = Scene(robot, (effect,), dt=0.01 if robot is SLIDER else 1e-4)
    share = 2 * torch.arange(steps, dtype=torch.float64) / steps if slowly else torch.ones(steps, dtype=torch.float64)
    series = {"torque": (share.clamp(max=1.0).unsqueeze(1) * double(*torques)).unsqueeze(-1)}
    if "temperature" in scene.inputs:
        series["temperature"] = 0 * series["torque"]
    qd = double(*speeds).unsqueeze(-1)
    return scene.rollout(scene.start(0 * qd, qd), **series).qd[..., 0]


@pytest.mark.parametrize("name", LAWS)
def test_a_joint_under_the_stated_torque_keeps_its_speed(name):
    speeds = [way * speed for speed in SPEEDS[1:] for way in (1, -1)]
    found = driven(LAWS[name], [x for pair in stated(LAWS[name])[1:] for x in pair], speeds)[-1]
    torch.testing.assert_close(found, double(*speeds), rtol=2e-3, atol=0)  # torques are stated with four digits


def test_bristles_of_a_sliding_joint_bend_until_they_resist_as_stated():
    rock = SLIDER.replace(mass=double(1e6))  # so heavy that it keeps its speed; its loss of momentum is the force
    qd = driven(BRISTLES, [0.0, 0.0], SPEEDS[1:], rock, 1000)
    forces = 1e6 * (qd[-501] - qd[-1]) / 0.05
    torch.testing.assert_close(forces, double(*[forward for forward, _ in stated(BRISTLES)[1:]]), rtol=1e-3, atol=0)


@pytest.mark.parametrize("effect", [*DRY.values(), BRISTLES], ids=[*DRY, "bristles"])
def test_the_torque_at_rest_is_that_at_which_a_joint_begins_to_slide(effect):
    limits = stated(effect)[0]
    found = driven(effect, [share * x for share in (0.95, 1.1) for x in limits], [0.0] * 4, slowly=True)[-1].abs()
    assert found[:2].max() < 0.005 and found[2:].min() > 0.01


def test_laws_add_up_and_the_load_ripple_and_unknown_numbers_are_told_apart():
    parts = [part.resolved(TWO) for part in (Gravity(), Viscous((0.1, 0.2)), Coulomb((0.5, 0.0), 1e-3), Coulomb(0.0))]
    assert at_speeds(parts, 2) == (("0.5", "0"), ("0.51", "0.02"), ("0.6", "0.2"))
    assert at_speeds((LoadDependent(0.1).resolved(TWO),), 2)[2] == ("0.1 load", "0.1 load")
    assert at_speeds((*parts, LoadDependent((0.1, 0.0)).resolved(TWO)), 2)[0] == ("0.5 + 0.1 load", "0")
    ripple = Ripple(1.0, 0.5, 0.5).resolved(TWO)
    assert at_speeds((*parts, ripple), 2) == at_speeds(parts, 2) and at_speeds((ripple,), 2) == ()
    assert at_speeds((*parts, Viscous(torch.ones(2)).resolved(TWO)), 2) == ()
    assert at_speeds((parts[0], parts[-1]), 2) == () and lines((parts[0],), 2) == []


def test_the_report_of_a_robot_states_its_viscous_and_coulomb_friction_alike():
    robot = TWO.replace(damping=double(0.1, 0.2), friction=double(0.5, 0.0))
    parts = [part.resolved(robot) for part in (Viscous(), Coulomb(sign_width=1e-9))]
    rows = [row[1:] for row in robot.report().friction]
    assert rows == [*zip(*at_speeds(parts, 2), strict=True)]
    assert "at rest" in str(robot.report()) and "friction" not in str(TWO.report())
