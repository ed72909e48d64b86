"""Several robots in one batch."""

import math

import torch
from helpers import all_in_one
from messages import refused
from robots import panda, row, same, states, two

import torchdq
from torchdq import ArgumentError, Robot


def test_a_stack_of_robots_is_a_batch_of_them():
    robots = [two(), two().replace(mass=row(2, 3), com=two().com + 0.1), two().replace(armature=row(0.1, 0.2)).bake()]
    batch = Robot.stack(robots)
    assert (batch.mass.shape, batch.com.shape, batch.armature.shape) == ((3, 2), (3, 2, 3), (3, 2))
    assert batch.screw.shape == (2, 6) and batch.inertia.shape == (2, 6)
    q, qd, qdd = states(2, rows=3)
    expected = torch.stack([torchdq.inverse_dynamics(x, *rows) for x, *rows in zip(robots, q, qd, qdd, strict=True)])
    assert same(torchdq.inverse_dynamics(batch, q, qd, qdd), expected)


def test_a_stack_holds_frictions_and_limits_of_all():
    other = two().replace(damping=row(1, 2), limits=two().limits._replace(effort=row(3, 4)))
    batch = Robot.stack([two(), other])
    assert batch.damping[1].tolist() == [1, 2] and batch.limits.effort[1].tolist() == [3, 4]
    assert "joint2" in str(batch.report())


def test_a_stack_has_an_axis_of_its_robots_even_if_they_are_equal():
    unlimited = two().replace(limits=two().limits._replace(effort=row(math.inf, math.inf)))
    for robots in ([two()] * 3, [two(), two(), unlimited], [two()]):
        batch = Robot.stack(robots)
        assert torchdq.mass_matrix(batch, torch.zeros(2).double()).shape == (len(robots), 2, 2)
        assert batch.mass.shape == (len(robots), 2) and batch.com.shape == (2, 3)


def moved_tip(**changes):
    *frames, tip = two().frames
    return two().replace(frames=(*frames, tip._replace(**changes)))


LONGER = two().frames[-1].X_BF * row(1, 1, 1, 1, 1, 2, 1, 1)
APART = {
    "tip": lambda: [two(), two().with_tip(None)],
    "tree": lambda: [two(), panda()],
    "names": lambda: [two(), two().replace(joint_names=("a", "b"))],
    "frame": lambda: [two(), moved_tip(X_BF=LONGER)],
    "link": lambda: [two(), moved_tip(link=0)],
    "dtype": lambda: [two(), two().to(torch.float32)],
    "dtype of one": lambda: [two(), two().replace(mass=two().mass.float())],
    "a number": lambda: [two(), 3],
    "none": lambda: [],
    "batch": lambda: [two().replace(mass=two().mass * torch.ones(3, 1)), two()],
}


@all_in_one(APART)
def test_robots_that_differ_in_more_than_numbers_are_not_stacked(case):
    robots = APART[case]
    with refused(ArgumentError):
        Robot.stack(robots())
