"""Receding horizons in C: ticks are those of Python, whatever is measured and wherever the goal is."""

import ctypes
import math
import re
from importlib import import_module

import pytest
import torch
from exporting import loaded, passes_its_test, run
from helpers import double, random
from messages import refused
from robots import on_free_base

import torchdq
from torchdq import Scene, effects, optimal
from torchdq.errors import ArgumentError
from torchdq.optimal.problem import Passes

BACKEND = "auto"
ARM = Scene(torchdq.robots.load("two_link"), (effects.Gravity(), effects.Viscous(0.1)), dt=0.02)
GOAL = double(1.2, 0.4, 0.0)
STEPS = 30
SANITIZED = ("-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def swing(torques=(-60.0, 20.0), **changes):
    """Problem of the arm, whose tip is brought to a point and to rest, within limits that bind."""
    costs, final = (
        [optimal.Torques(1e-3), optimal.Speeds(1e-2)],
        [optimal.Point("tip", GOAL, 1e3), optimal.Speeds(10.0)],
    )
    return optimal.Problem(
        **{"scene": ARM, "steps": STEPS, "costs": costs, "final": final, "torques": torques, **changes}
    )


def begun(problem, q=(0.1, 0.2), dtype=torch.float64, iterations=1):
    """Receding horizon after its first call."""
    mpc = optimal.Receding(problem, iterations)
    mpc(problem.scene.start(torch.tensor(q, dtype=dtype)))
    return mpc


class InC:
    """Struct of an exported horizon, all of whose members are numbers, and its tick."""

    def __init__(self, made):
        text = made.header.read_text().split("typedef struct", 1)[1]
        axes = {
            name: [int(k) for k in re.findall(r"\d+", of)] for name, of in re.findall(r"(\w+)((?:\[\d+\])+);", text)
        }
        plan = sum(math.prod(axes[name]) for name in ("states", "torque", "gain"))
        self.memory = torch.full([sum(map(math.prod, axes.values())) + 2 * plan], torch.nan, dtype=torch.float64)
        parts = self.memory.split([*map(math.prod, axes.values()), 2 * plan])
        self.at = {name: x.view(of) for (name, of), x in zip(axes.items(), parts[:-1], strict=True)}
        self.compiled, self.name = loaded(made, "-std=c99", "-O0"), made.function
        self.called("begin")

    def called(self, name, *tensors):
        """Status of a call."""
        pointers = [ctypes.c_void_p(x.data_ptr()) for x in (self.memory, *tensors)]
        return getattr(self.compiled, f"{self.name}_{name}")(*pointers)

    def tick(self, state):
        """Status, torques and gains."""
        torque, gain = torch.empty_like(self.at["torque"][0]), torch.empty_like(self.at["gain"][0])
        return self.called("tick", state.q, state.qd, torque, gain), torque, gain


def agree(inside, mpc, state):
    """Whether the next ticks are equal but for rounding, and the plans after them."""
    (status, torque, gain), (expected, gains) = inside.tick(state), mpc(state)
    plan = mpc.plan
    pairs = [(torque, expected), (gain, gains.flatten()), (inside.at["torque"], plan.torque)]
    pairs += [
        (inside.at["gain"], plan.gain.flatten(1)),
        (inside.at["states"], torch.cat([plan.states.q, plan.states.qd], 1)),
    ]
    return status == 0 and all((a - b).abs().max() <= 1e-9 * b.abs().max() for a, b in pairs)


def test_ticks_are_those_of_python_with_disturbances_and_goals_that_jump(tmp_path, monkeypatch):
    mpc, passes = begun(swing()), list()
    inside, forward = InC(mpc.export(tmp_path, "arm_mpc")), Passes.forward
    monkeypatch.setattr(Passes, "forward", lambda *of: passes.append(of) or forward(*of))
    state, bound = ARM.start(double(0.1, 0.2)), 0
    for k in range(20):
        if k in (5, 12):
            goal = double(-0.9, 0.8, 0.0) if k == 5 else double(1.0, -1.0, 0.0)
            mpc.problem = swing(final=[optimal.Point("tip", goal, 500.0), optimal.Speeds(10.0)])
            inside.at["goal_of_cost_2"][:], inside.at["weight_of_cost_2"][:] = goal, 500.0
        assert agree(inside, mpc, state)
        bound += int((mpc.plan.torque == 20.0).sum() + (mpc.plan.torque == -60.0).sum())
        state = ARM.step(state, mpc.plan.torque[0] + random(2, seed=k))
    assert bound > 20 and len(passes) > 20 * 2 + 3


def test_the_header_says_how_gains_are_used_and_the_plan_in_the_struct_starts_at_the_measured_state(tmp_path):
    """torque + gain (x - x_plan), row by row, against the policy of the plan in Python, which follows it likewise."""
    mpc = begun(swing())
    made = mpc.export(tmp_path, "arm_mpc")
    inside, state = InC(made), ARM.start(double(0.1, 0.2))
    assert agree(inside, mpc, state)
    words = " ".join(made.header.read_text().replace("*", " ").split())
    assert "torque + gain (x - x_plan)" in words and "gain[2][4] is row by row" in words and "q[2], qd[2], in" in words
    x, x_plan = double(0.11, 0.19, 0.02, -0.03), inside.at["states"][0]
    assert x_plan.tolist() == [0.1, 0.2, 0.0, 0.0]
    tau = inside.at["torque"][0] + inside.at["gain"][0].view(2, 4) @ (x - x_plan)
    expected = mpc.plan.policy(ARM.start(x[:2], x[2:]), 0)
    assert torch.allclose(tau, expected, rtol=1e-9)


def test_iterations_that_find_no_step_are_damped_as_in_python(tmp_path, monkeypatch):
    mpc, damped = begun(swing(), iterations=8), list()
    inside, backward = InC(mpc.export(tmp_path, "arm_mpc")), Passes.backward
    monkeypatch.setattr(Passes, "backward", lambda *of: damped.append(float(of[-1])) or backward(*of))
    goal, state = double(0.2, 0.2, 0.0), ARM.start(double(-0.6, 1.4), double(-9.0, 6.0))
    mpc.problem = swing(final=[optimal.Point("tip", goal, 1e5), optimal.Speeds(10.0)])
    inside.at["goal_of_cost_2"][:], inside.at["weight_of_cost_2"][:] = goal, 1e5
    assert agree(inside, mpc, state) and {0.0, 1e-3, 1e-2} <= {*damped}


def test_ticks_of_an_arm_at_its_limits_are_those_of_python(tmp_path):
    example = import_module("39_receding")
    problem = example.problem(example.GOALS[0])
    limits = 0.35 * example.LIMITS
    mpc = begun(problem.replace(torques=(-limits, limits)), example.HOME.tolist())
    inside, state, bound = InC(mpc.export(tmp_path, "arm_mpc")), example.MODEL.start(example.HOME), 0
    for k in range(6):
        if k == 3:
            mpc.problem = example.problem(example.GOALS[1])
            inside.at["goal_of_cost_2"][:] = example.GOALS[1]
            inside.at["lower"][:], inside.at["upper"][:] = -example.LIMITS, example.LIMITS
        assert agree(inside, mpc, state)
        bound += int((mpc.plan.torque.abs() >= limits).sum()) if k < 3 else 0
        state = example.MODEL.step(state, mpc.plan.torque[0] + random(6, seed=k))
    assert bound > 3


def test_a_measurement_that_is_missing_is_told_and_the_plan_goes_on(tmp_path):
    mpc, missing = begun(swing()), ARM.start(double(math.nan, 0.2))
    inside, state = InC(mpc.export(tmp_path, "arm_mpc")), ARM.start(double(0.12, 0.25))
    before = inside.at["torque"].clone()
    for k in (1, 2):
        status, torque, gain = inside.tick(missing)
        assert status == 1 and torque.isnan().all() and gain.isfinite().all() and mpc(missing)[0].isnan().all()
        assert torch.equal(inside.at["torque"][:-k], before[k:])
    assert agree(inside, mpc, state) and agree(inside, mpc, ARM.step(state, mpc.plan.torque[0]))


def floating():
    """Horizon of an arm on a floating base."""
    scene = Scene(on_free_base(ARM.robot), (effects.Viscous(0.1),), dt=0.05)
    X = torchdq.dq.exp(double(0.0, 0.0, 0.15, 0.0, 0.0, 0.0)[None] / 2)[0]
    final = [optimal.BasePose(X, double(1, 1, 1, 0, 0, 0)), optimal.BaseVelocity(0.1), optimal.Speeds(0.1)]
    return begun(optimal.Problem(scene, 20, [optimal.Torques(1e-4)], final), (0.3, 0.4))


def remembering():
    """Horizon of targets of servos, with a tensor of the scene, a memory and goals of every step."""
    servo, lag = effects.Servo(100.0, 10.0), effects.FirstOrderLag(0.05)
    scene = ARM.replace(effects=(effects.Gravity(), effects.Viscous(double(0.1, 0.2)), servo, lag))
    path = torch.linspace(0.0, 1.0, 10).double()[:, None] * double(1.0, -1.0)
    return begun(optimal.Problem(scene, 10, [optimal.Posture(path, 1.0)], control="target", torques=None))


KINDS = {
    "single precision": (lambda: begun(swing(), dtype=torch.float32), "math.h", SANITIZED),
    "floating base": (floating, "own", ("-O0",)),
    "servos": (remembering, "own", SANITIZED),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_horizon_passes_its_test_within_its_memory(kind, tmp_path):
    mpc, library, flags = KINDS[kind]
    made = mpc().export(tmp_path, library=library)
    assert "largest relative difference" in passes_its_test(made, *flags) and made.spans is None
    run("g++", "-std=c++11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only", str(made.header))


def sampled(problem):
    """Receding horizon of samples, whose plan has no gains."""
    mpc = optimal.Receding(problem, method=optimal.CEM(8))
    mpc(ARM.start(double(0.1, 0.2)))
    return mpc


def lost(problem):
    """Receding horizon whose plan is not finite."""
    mpc = begun(problem)
    mpc.plan = mpc.plan._replace(cost=mpc.plan.cost * math.inf)
    return mpc


@pytest.mark.parametrize(
    "call",
    [
        lambda to: optimal.Receding(swing()).export(to),
        lambda to: begun(swing(), ((0.1, 0.2), (0.0, 0.0))).export(to),
        lambda to: sampled(swing()).export(to),
        lambda to: lost(swing()).export(to),
        lambda to: begun(swing()).export(to, "forward"),
        lambda to: begun(swing()).export(to, "two words"),
        lambda to: begun(swing()).export(to, library="libm"),
        lambda to: begun(swing()).export(3),
    ],
)
def test_what_cannot_be_exported_is_refused_and_nothing_is_written(call, tmp_path):
    with refused(ArgumentError):
        call(tmp_path / "folder")
    assert not (tmp_path / "folder").exists()
