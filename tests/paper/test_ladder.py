"""Every step from the printed Algorithm 1 to the program that runs gives the same torques with fewer operations."""

from itertools import pairwise

import pinocchio as pin
import torch
from helpers import all_in_one
from oracles import EPS, Case, over, pinocchio_model, random_tree, size_of_torques, states, worst
from places import ROOT

import torchdq
from torchdq.paper import ladder
from torchdq.program.program import replay, results

PAGE = ROOT / "docs" / "how-it-works.md"
BEGIN, END = "<!-- torchdq.paper.ladder begins -->\n", "<!-- torchdq.paper.ladder ends -->"
CHAIN = ladder.example(7)
TREE = random_tree(8, 5).robot.bake()  # its frames lie beside the centres of mass, which the print does not have


def torques(form: ladder.LadderForm, robot: torchdq.Robot, s) -> torch.Tensor:
    rows = [x.unbind(-1) for x in (s.q, s.qd, s.qdd)]
    program = form.program(robot)
    return torch.stack(results(program, replay(program, rows))["tau"], -1)


@all_in_one([CHAIN, TREE, torchdq.robots.load("panda")])
def test_torques_are_those_of_pinocchio_after_every_step(robot):
    s, case = states(robot, 4), Case(robot, pinocchio_model(robot))
    expected = over(lambda model, data, *state: pin.rnea(model, data, *state[:3])[case.order], case, s)
    for form in ladder.FORMS:
        if robot is CHAIN or form.torques is not ladder.as_printed:  # which knows frames at centres of mass only
            assert worst(torques(form, robot, s), expected, size_of_torques(case, s)) <= 256 * EPS[torch.float64], form


def test_no_step_adds_operations():
    for robot in (CHAIN, torchdq.robots.load("panda"), torchdq.robots.load("ur10e")):
        forms = ladder.FORMS if robot is CHAIN else ladder.FORMS[1:]
        counts = [form.program(robot).count() for form in forms]
        for before, after in pairwise(counts):
            assert after.total < before.total and after.sines == before.sines


def test_the_last_step_is_the_program_that_runs():
    for robot in (CHAIN, torchdq.robots.load("ur10e")):
        last = ladder.FORMS[-1].program(robot)
        assert last.count() == torchdq.compile(robot, "inverse_dynamics").count()


def test_the_page_shows_the_counts_of_today():
    text = PAGE.read_text(encoding="utf-8")
    shown = text[text.index(BEGIN) + len(BEGIN) : text.index(END)].strip()
    assert shown == ladder.table()
