"""Objects measured: price beside MuJoCo, operations, gradients, and accuracy by the step.

    python benchmarks/objects.py [--parts NAME ...]

The scene is the shipped Panda with its gripper and a cube of 50 mm, in MuJoCo as well, with the same spheres on the
pads. Times are processor times of one thread, of both packages in turns, the least of several.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.append(str(Path(__file__).parents[1] / "examples"))

import mujoco
import report
import torch
from torch import Tensor

import torchdq
from torchdq import Scene, dq, effects
from torchdq.envs.manipulation import Lift
from torchdq.objects import Ball, Box
from torchdq.scene import State

F32, F64 = torch.float32, torch.float64
BATCH, STEPS, TURNS, G = 4096, 8, 12, 9.81
EDGE, MASS, STIFF = 0.05, 0.1, 1e4  # of the cube [m, kg], and stiffness of its contacts [N/m]
CUBE = Box("cube", MASS, size=(EDGE,) * 3)
FINGERS = effects.Contact("*_finger", on="cube", friction=1.0, stiffness=STIFF)
TABLE = effects.Contact("cube", friction=0.5, stiffness=STIFF)


@cache
def robot() -> torchdq.Robot:
    return torchdq.robots.load("panda_hand")


def scene(*contacts: effects.Contact, dt: float = 5e-3, cube: Box | None = CUBE) -> Scene:
    """Arm with servos, and the cube."""
    servo = effects.Servo(1000.0, 100.0, limit=robot().limits.effort.tolist())
    parts = (effects.Gravity(), effects.RotorInertia(), effects.Viscous(), servo)
    return Scene(robot(), (*parts, *contacts), objects=() if cube is None else (cube,), dt=dt)


@cache
def above(height: float) -> Tensor:
    """Joint positions with the tip pointing down at a height [m], the gripper open."""
    X = dq.from_pose(torch.tensor([0.0, 1.0, 0.0, 0.0]).double(), torch.tensor([0.5, 0.0, height]).double())
    start = torch.tensor([0.0, 0.1, 0.0, -2.57, 0.0, 2.68, 0.785, 0.04], dtype=F64)
    q = torchdq.inverse_kinematics(robot(), X, "tcp", start=start).q
    return torch.cat([q[:7], torch.tensor([0.04], dtype=F64)])


def at(*position: float) -> Tensor:
    return dq.from_pose(torch.eye(4, dtype=F64)[0], torch.tensor([position], dtype=F64))


def lift(seconds: float, dt: float) -> Tensor:
    """Targets that close the gripper for 0.5 s, lift the cube by 0.2 m in 1 s, and hold it."""
    t = torch.arange(round(seconds / dt), dtype=F64)[:, None] * dt
    s = (t - 0.5).clamp(0, 1)
    s = s * s * (3 - 2 * s)
    q = above(EDGE / 2) + s * (above(EDGE / 2 + 0.2) - above(EDGE / 2))
    return torch.cat([q[:, :7], torch.full_like(t, 0.005)], 1)


def held(where: Scene, seconds: float, dtype: torch.dtype = F64) -> State:
    """States of a cube that is grasped, lifted and held."""
    state = where.start(above(EDGE / 2).to(dtype), X_WO=at(0.5, 0.0, EDGE / 2 - MASS * G / (4 * STIFF)).to(dtype))
    return where.rollout(state, target=lift(seconds, where.dt).to(dtype))


def rows_of(state: State, dtype: torch.dtype = F32) -> State:
    """State in every sample."""
    return State._make(None if x is None else x.to(dtype).expand(BATCH, -1).contiguous() for x in state)


# --- parts -----------------------------------------------------------------------------------------------------------


def price() -> None:
    """Steps of float32 and of MuJoCo in turns, and gradients."""
    hand = import_module("32_hands_in_mujoco").Hand(replace(Lift(), object=CUBE), robot())
    hand.model.opt.timestep = 5e-3
    gripped, resting, q = scene(FINGERS, TABLE), scene(TABLE), above(EDGE / 2 + 0.2)
    states = {
        "held cube": (gripped, rows_of(held(gripped, 3.0).last), lift(3.0, 5e-3)[-1]),
        "cube on a table": (
            resting,
            rows_of(resting.rollout(resting.start(q, X_WO=at(0.5, 0.0, 0.025)), target=q.expand(100, 8)).last),
            q,
        ),
        "arm": (bare := scene(cube=None), rows_of(bare.start(q)), q),
    }
    calls: dict[str, tuple[Callable[[], object], int]] = {}
    for name, (where, state, target) in states.items():
        targets = target.float().expand(STEPS, BATCH, 8)
        calls[name] = (lambda w=where, s=state, u=targets: w.rollout(s, target=u, ends=True)), BATCH * STEPS
    where, state, target = states["held cube"]
    targets = target.float().expand(STEPS, BATCH, 8)

    def gradient() -> None:
        x = state.q.clone().requires_grad_()
        found = where.rollout(state._replace(q=x), target=targets, ends=True)
        torch.autograd.grad(found.poses.square().sum(), x)

    calls["gradient of the held cube"] = gradient, BATCH * STEPS
    for name, end, gap in (("held cube", True, 0.005), ("cube on a table", False, 0.04)):
        data = mujoco.MjData(hand.model)
        for x, own in zip(above(EDGE / 2) if end else q, hand.moved, strict=True):
            data.qpos[hand.at[own]] = float(x)
        data.qpos[hand.place : hand.place + 7] = [0.5, 0.0, EDGE / 2, 1.0, 0.0, 0.0, 0.0]
        for u in lift(3.0, 5e-3) if end else [torch.tensor([*q[:7], gap])] * 200:
            data.ctrl[:] = [len(own) * float(x) for own, x in zip(hand.moved, u, strict=True)]
            mujoco.mj_step(hand.model, data)
        calls[f"{name} in MuJoCo, {data.ncon} contacts"] = (lambda d=data: mujoco.mj_step(hand.model, d, 200)), 200
    best = report.least(calls, TURNS)
    for name, nanoseconds in best.items():
        print(f"{name:44s} {nanoseconds:9.0f} ns")
    for name in ("held cube", "cube on a table"):
        theirs = next(x for other, x in best.items() if other.startswith(f"{name} in MuJoCo"))
        print(f"{name}: {theirs / best[name]:.0f} times MuJoCo")
    print(f"gradient: {best['gradient of the held cube'] / best['held cube']:.1f} times the rollout")


def operations() -> None:
    """Operations over the arm alone."""
    points = robot().contact_points("left_finger")
    arm = scene(cube=None).count().total

    def over(*contacts: effects.Contact) -> int:
        return scene(*contacts).count().total - arm

    pair, two, four = (over(replace(FINGERS, points=points[:k])) for k in (1, 2, 4))
    print(f"arm {arm}, an object {over()}, a first pair {pair}, a further contact {(four - two) / 2:.0f}")
    print(f"eight corners {over(TABLE)}, two fingers of four points {over(FINGERS)}, both {over(FINGERS, TABLE)}")


def accuracy() -> None:
    """Creep, slip, rolling, sliding and tipping."""
    for dt in (1e-3, 5e-3, 1e-2):
        for dtype in (F64, F32):
            place = dq.translation(held(scene(FINGERS, TABLE, dt=dt), 11.5, dtype).X_WO)[:, 0].double()
            creep = (place[-1] - place[round(2.5 / dt)])[2].abs()
            print(
                f"held cube, {1e3 * dt:.0f} ms, {dtype}: creeps {1e6 * float(creep):.3f} um along the vertical in 9 s"
            )
    floor = robot()
    for dt in (1e-3, 5e-3, 1e-2):
        kept = effects.Contact("it", friction=0.5, stiffness=2e4)
        ball = Scene(floor, (effects.Gravity(), kept), objects=(Ball("it", 1.0, radius=0.1),), dt=dt)
        box = ball.replace(objects=(Box("it", 1.0, size=(0.2, 0.2, 0.1)),))
        V = torch.tensor([[0.0, 0.0, 0.0, 2.0, 0.0, 0.0]], dtype=F64)
        q = above(0.5)
        rolls = dq.translation(
            ball.rollout(ball.start(q, X_WO=at(3.0, 0.0, 0.1 - G / 2e4), V_WO=V), steps=round(2 / dt)).X_WO
        )
        slides = dq.translation(
            box.rollout(box.start(q, X_WO=at(3.0, 0.0, 0.05 - G / 8e4), V_WO=V), steps=round(2 / dt)).X_WO
        )
        speed, way = float((rolls[-1] - rolls[-2])[0, 0]) / dt / 2.0, float(slides[-1, 0, 0]) - 3.0
        share = way * 2 * 0.5 * G / 2.0**2
        print(f"{1e3 * dt:.0f} ms: a ball rolls at {speed:.7f} of its speed (5/7), a box slides {share:.4f} of its way")


def slip() -> None:
    """Speed at which a held cube of 40 mm slides down through the fingers, in MuJoCo."""
    play = import_module("32_hands_in_mujoco")
    for cone in play.CONES:
        hand = play.Hand(Lift(), robot(), cone)
        for over, opening in ((0.0, 0.0), (0.0, -0.03), (0.01, 0.0)):  # tip over the cube's middle, and target [m]
            data, heights = mujoco.MjData(hand.model), []
            q = above(0.2 + over)[:7].tolist()
            data.qpos[hand.at] = [*q, 0.0199, 0.0199]
            data.qpos[hand.place : hand.place + 7] = [0.5, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0]
            data.ctrl[:] = [*q, 2 * opening]
            for steps in (500, 250):
                mujoco.mj_step(hand.model, data, steps)
                heights.append(data.qpos[hand.place + 2] - data.xpos[hand.pads[0], 2])
            found = 1e3 * (heights[0] - heights[1]) / (250 * play.STEP)
            print(
                f"{cone:9s} {1e3 * over:2.0f} mm below the tip, {data.ncon} contacts, each finger presses by "
                f"{-data.actuator_force[7]:4.1f} N: {found:5.2f} mm/s"
            )


PARTS = {"price": price, "operations": operations, "accuracy": accuracy, "slip": slip}


def main() -> None:
    """Print the parts."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--parts", nargs="+", choices=PARTS, default=[*PARTS], help="what is measured")
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    print(report.machine("mujoco"))
    for name in options.parse_args().parts:
        print(f"\n{PARTS[name].__doc__}")
        PARTS[name]()


if __name__ == "__main__":
    main()
