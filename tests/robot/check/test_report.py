"""Reports of robots."""

import re

from robots import panda

import torchdq


def test_the_report_names_every_joint_with_its_link_and_limits():
    rows = panda().report().joints
    assert len(rows) == 7 and rows[3] == ("panda_joint4", "revolute", "panda_link4", "3.588 kg", "[-3.072, -0.0698]")


def test_the_report_says_what_is_used_and_that_limits_are_not_enforced_and_nothing_of_what_is_absent():
    text = str(torchdq.robots.load("puma560").report())
    for part in ("Robot('puma560'", "mass, centre of mass and inertia", "gravity [0.0, 0.0, -9.81]", "rotor inertia"):
        assert part in text
    assert "limits (not enforced)" in text
    text = str(panda().replace(gravity=None).report())
    assert "gravity" not in text and "rotor" not in text and "notes" not in text


def test_the_report_has_limits_of_velocity_and_torque_where_there_are_any():
    report = torchdq.robots.load("ur10e").report()
    assert report.motors[0] == ("shoulder_pan_joint", "3.14", "330") and len(report.motors) == 6
    assert "limits of velocity and torque (not enforced):\njoint" in str(report)
    assert not torchdq.robots.load("two_link").report().motors


def test_a_name_forges_no_row_of_the_report():
    robot = panda()
    names = ("a\nb  revolute  l9  99 kg", "c\u202e", "d\u009b", *robot.joint_names[3:])
    text = str(robot.replace(joint_names=names).report())
    assert text.replace("\n", "").isprintable() and not re.search("^b ", text, re.MULTILINE)
