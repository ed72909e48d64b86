"""Links as rods. Evidence: rods placed by hand, an arm by three descriptions, and what is identified from them."""

import math

import pytest
import torch
from helpers import PAIR, all_in_one
from messages import refused
from robots import F64, SHIPPED, forked, states

import torchdq
from torchdq import Robot, effects
from torchdq.learning import Model, Samples, identify

H = math.pi / 2
ROWS = [[0.1, H, 0.4, 0.0], [0.6, 0.0, 0.0, H], [0.05, H, 0.0, 0.0], [0.0, -H, 0.5, 0.0], [0.0, H, 0.0, 0.0]]
A, ALPHA, D, THETA = map(list, zip(*ROWS, [0.0, 0.0, 0.1, 0.0], strict=True))


def test_rods_go_from_axis_to_axis():
    """Two rods of a plane arm: lengths, centres, the moments of solid cylinders, masses in proportion."""
    robot = SHIPPED["two_link"].with_rods(10.0, radius=0.1)
    tip = torchdq.forward_kinematics(robot, torch.zeros(2, dtype=F64), "tip")
    assert torchdq.dq.translation(tip).tolist() == pytest.approx([2.0, 0.0, 0.0])
    for body in range(2):
        m, h = 5.0, 1.0 + 0.2
        along, across = m * 0.1**2 / 2, m * (3 * 0.1**2 + h**2) / 12
        assert float(robot.mass[body]) == pytest.approx(m)
        assert sorted(robot.inertia[body, [0, 2, 5]].tolist()) == pytest.approx([along, across, across])
    g = sum(5.0 * 9.81 * x for x in (0.5, 1.5))
    down = robot.replace(gravity=torch.tensor([0.0, -9.81, 0.0], dtype=F64))
    q = torch.zeros(2, dtype=F64)
    assert torchdq.inverse_dynamics(down, q, q, q)[0] == pytest.approx(g)


def test_an_arm_has_the_same_rods_whatever_its_link_frames_are():
    """Its table, its joint screws with all frames at the base, and its URDF."""
    table = Robot.from_dh(A, ALPHA, D, THETA)
    X = torchdq.forward_kinematics(table, torch.zeros(6, dtype=F64), [*table.frame_names])
    screws = [torchdq.dq.ad(x, s) for x, s in zip(X[1:7], table.screw, strict=True)]
    others = (
        Robot.from_screws(torch.stack(screws), tip_pose=X[-1]),
        Robot.from_urdf(table.to_urdf(), on_unphysical="ignore"),
    )
    expected = torchdq.inverse_dynamics(table.with_rods(36.5), *states(6))
    for other in others:
        found = torchdq.inverse_dynamics(other.with_rods(36.5), *states(6))
        assert torch.allclose(found, expected, atol=1e-12 * float(expected.abs().max()))


@all_in_one([*SHIPPED, "forked"])
def test_links_of_any_robot_become_bodies_that_can_be(name):
    robot = forked() if name == "forked" else SHIPPED[name]
    rods = robot.with_rods(20.0, radius=0.05)
    rods.check()
    assert float(rods.mass.sum()) == pytest.approx(20.0) and bool((rods.inertia[:, [0, 2, 5]] > 0).all())
    assert rods.base_mass is robot.base_mass and rods.to(torch.float32).with_rods(1.0).mass.dtype == torch.float32


def test_an_arm_is_identified_from_rods():
    """Masses a fifth too low in all: torques of another motion are those of the real arm."""
    real = Robot.from_urdf(PAIR).replace(gravity=torch.tensor([0.0, 0.0, -9.81], dtype=F64))
    bare = real.replace(mass=0 * real.mass, com=0 * real.com, inertia=0 * real.inertia, on_unphysical="ignore")
    q, qd, qdd = states(2, rows=300)
    tau = torchdq.inverse_dynamics(real, q, qd, qdd) + 0.3 * qd
    found = identify(bare.with_rods(2.4), Samples(q, qd, qdd, tau), Model((effects.Viscous(),)), prior=1.0)
    test = states(2, seed=1)
    expected = torchdq.inverse_dynamics(real, *test) + 0.3 * test[1]
    assert (found.predict(*test).tau - expected).abs().max() < 0.01 * expected.abs().max()


BROKEN = {
    "mass": lambda: SHIPPED["panda"].with_rods(0.0),
    "radius": lambda: SHIPPED["panda"].with_rods(1.0, -1.0),
    "points": lambda: Robot.from_dh([0.0], [0.0], [0.3], [0.0]).with_rods(1.0),
    "batch": lambda: SHIPPED["panda"].replace(mass=torch.ones(2, 7)).with_rods(1.0),
}


@all_in_one(BROKEN)
def test_what_gives_no_rods_is_refused(name):
    with refused(torchdq.ArgumentError):
        BROKEN[name]()
