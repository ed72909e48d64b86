"""Pushes: Newton's law under them, the times at which they begin, and what they refuse."""

import math

import pytest
import torch
from messages import refused
from small_envs import FREE, started

import torchdq
from torchdq import effects, floating
from torchdq.envs import Pushes
from torchdq.scene import integrators

BACKEND = "auto"
FLYING = {"robot": FREE, "effects": (effects.Push(),), "dtype": "float64", "integrator": integrators.RungeKutta4()}


def test_pushes_that_are_over_have_given_a_free_robot_the_momentum_of_their_forces():
    """Each its force times its duration, at whatever time between two steps it began."""
    envs = started(60, **FLYING, pushes={"push": Pushes((8.0, 5.0, 0.0, 0.0, 0.0, 0.3), (0.05, 0.25), 0.1)})
    given, number, pushes = torch.zeros(60, 3, dtype=torch.float64), torch.zeros(60), [envs.get_state()["push"]]
    for _ in range(60):
        envs.step(torch.zeros(60, 2))
        pushes.append(envs.get_state()["push"])
        over = pushes[-1][:, 6] != pushes[-2][:, 6]
        given, number = given + 0.1 * over[:, None] * pushes[-2][:, :3], number + over
        waits = (pushes[-1][:, 6] - pushes[-2][:, 6])[over] - 0.1
        assert bool((waits > 0.05 - 1e-9).all() and (waits < 0.25 + 0.02).all())  # noticed at the next step
    now = envs.get_state()
    between = 0.02 * (now["steps"] - 1) < now["push"][:, 6]
    found = floating.momentum(FREE, *(now[name] for name in ("X_WB", "q", "V_WB_B", "qd")))[0]
    assert between.sum() > 10 and number.min() >= 2
    assert (found - given)[between].abs().max() < 1e-5


def test_wrenches_and_times_are_drawn_evenly_within_their_ranges():
    envs = started(2000, **FLYING, pushes={"push": Pushes((8.0, 0.0, 2.0, 0.0, 0.5, 0.0), (1.0, 3.0))})
    (drawn, end), size = envs.get_state()["push"].split((7, 1), 1), torch.tensor([8.0, 0.0, 2.0, 0.0, 0.5, 0.0, 1.0])
    share = (drawn - torch.tensor([0.0] * 6 + [2.0])) / size.where(size > 0, 1.0)
    assert share.abs().max() <= 1 and torch.allclose(end, drawn[:, 6:] + 0.1)
    varied = share[:, size > 0].double()
    assert (varied.mean(0).abs() < 5 / math.sqrt(3 * 2000)).all()  # five standard errors
    assert (varied.square().mean(0) - 1 / 3).abs().max() < 0.05
    assert (torch.corrcoef(varied.T) - torch.eye(4)).abs().max() < 0.12


MISUSE = {
    "five components": lambda: Pushes((1.0,) * 5),
    "a negative force": lambda: Pushes((-1.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
    "one number": lambda: Pushes(20.0),
    "times in the wrong order": lambda: Pushes((1.0,) * 6, every=(2.0, 1.0)),
    "no duration": lambda: Pushes((1.0,) * 6, duration=0.0),
}


@pytest.mark.parametrize("what", MISUSE)
def test_wrong_pushes_are_refused(what):
    with refused(torchdq.TorchdqError):
        MISUSE[what]()
