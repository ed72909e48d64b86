"""Graphs of programs for torch.export: the function itself, for any number of samples."""

import torch
from helpers import double, random

import torchdq


def test_the_graph_of_a_control_law_by_its_name_takes_its_gains(tmp_path):
    robot, kp, kd, x = torchdq.robots.load("two_link"), double(30.0, 50.0), double(4.0, 6.0), random(5, 3, 2)
    exported = torchdq.compile(robot, "computed_torque").export(tmp_path, "track", language="torch")
    found = torch.export.load(exported.source).module()(*x, kp, kd)
    torch.testing.assert_close(found, torchdq.computed_torque(robot, *x, kp=kp, kd=kd), rtol=2.0**-45, atol=0)
