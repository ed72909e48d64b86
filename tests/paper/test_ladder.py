"""Every step from the printed Algorithm 1 to the program that runs gives the same torques with fewer operations."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
import torch
from oracles import EPS, Case, pinocchio_model, random_tree, size_of_torques, states
from places import ROOT

import torchdq
from torchdq.paper import ladder
from torchdq.program.program import replay, results

PAGE = ROOT / "docs" / "how-it-works.md"
BEGIN, END = "<!-- torchdq.paper.ladder begins -->\n", "<!-- torchdq.paper.ladder ends -->"
CHAIN = ladder.example(7)
TREE = random_tree(8, 5).robot.bake()  # its frames lie beside the centres of mass, which the print does not have


def torques(rung: ladder.LadderForm, robot: torchdq.Robot, s) -> torch.Tensor:
    rows = [x.unbind(-1) for x in (s.q, s.qd, s.qdd)]
    program = rung.program(robot)
    return torch.stack(results(program, replay(program, rows))["tau"], -1)


@pytest.mark.parametrize(
    ("robot", "rung"),
    [
        (robot, rung)
        for robot in (CHAIN, TREE, torchdq.robots.load("panda"))
        for rung in ladder.RUNGS
        if robot is CHAIN or rung.torques is not ladder.as_printed  # which knows frames at centres of mass only
    ],
    ids=lambda x: x.name,
)
def test_torques_are_those_of_pinocchio_after_every_step(robot, rung):
    s = states(robot, 4)
    case = Case(robot, pinocchio_model(robot))
    data = case.model.createData()
    expected = np.stack(
        [
            pin.rnea(case.model, data, case.configuration(q), case.velocity(qd), case.velocity(qdd))[case.order]
            for q, qd, qdd in zip(s.q.numpy(), s.qd.numpy(), s.qdd.numpy(), strict=True)
        ]
    )
    error = (torques(rung, robot, s) - torch.from_numpy(expected)).abs() / torch.from_numpy(size_of_torques(case, s))
    assert error.max() <= 256 * EPS[torch.float64]


def test_no_step_adds_operations():
    for robot in (CHAIN, torchdq.robots.load("panda"), torchdq.robots.load("ur10e")):
        rungs = ladder.RUNGS if robot is CHAIN else ladder.RUNGS[1:]
        counts = [rung.program(robot).count() for rung in rungs]
        for before, after in pairwise(counts):
            assert after.total < before.total and after.sines == before.sines


def test_the_last_step_is_the_program_that_runs():
    for robot in (CHAIN, torchdq.robots.load("ur10e")):
        last = ladder.RUNGS[-1].program(robot)
        assert last.count() == torchdq.compile(robot, "inverse_dynamics").count()


def test_the_page_shows_the_counts_of_today():
    text = PAGE.read_text(encoding="utf-8")
    shown = text[text.index(BEGIN) + len(BEGIN) : text.index(END)].strip()
    assert shown == ladder.table()
