"""Reports of robots."""

from robots import panda

import torchdq


def test_the_report_names_every_joint_with_its_link_and_limits():
    rows = panda().report().joints
    assert rows[3] == ("panda_joint4", "revolute", "panda_link4", "3.588 kg", "[-3.072, -0.0698]")
    assert len(rows) == 7


def test_the_report_says_what_is_used_and_that_limits_are_not_enforced():
    text = str(torchdq.robots.load("puma560").report())
    for part in ("Robot('puma560'", "mass, centre of mass and inertia", "gravity [0.0, 0.0, -9.81]", "rotor inertia"):
        assert part in text
    assert "limits (not enforced)" in text


def test_the_report_does_not_speak_of_what_is_absent():
    text = str(panda().replace(gravity=None).report())
    assert "gravity" not in text and "rotor" not in text and "nothing else in the description" in text
