"""Robots whose first joint is far from the base: only what physically depends on the distance carries its rounding.

The independent evidence is the same robot near the base: its mass matrix, its torques and its Jacobians are the same,
and its poses differ by the offset.
"""

import itertools
from functools import partial

import pytest
import torch
from helpers import all_in_one, double, thinned
from oracles import EPS, random_tree, scaled_condition, states

import torchdq
from torchdq import Robot, dq

F64 = torch.float64
ROBOTS = {
    "panda": lambda: torchdq.robots.load("panda"),
    "puma560": lambda: torchdq.robots.load("puma560"),
    "tree": lambda: random_tree(9, 3).robot,
}
DISTANCES = {
    "37 km": (22200.0, 23680.0, -17760.0),
    "5000 km": (3e6, 3.2e6, 2.4e6),
    "beyond the moon": (6e9, 6.4e9, 4.8e9),
    "beyond Neptune": (6e12, 6.4e12, 4.8e12),
}
# every distance of one robot, and one of the others
some = pytest.mark.parametrize(
    ("name", "distance"),
    thinned(
        [*itertools.product(ROBOTS, DISTANCES)],
        [("panda", "37 km"), *((name, [*DISTANCES][-1]) for name in ("puma560", "tree"))],
    ),
)
FUNCTIONS = {
    "M": lambda robot, s: torchdq.mass_matrix(robot, s.q),
    "c": lambda robot, s: torchdq.closed_form(robot, s.q, s.qd).c,
    "g": lambda robot, s: torchdq.closed_form(robot, s.q, s.qd).g,
    "tau": lambda robot, s: torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd),
    "d tau": lambda robot, s: torch.stack(torchdq.dynamics_jacobian(robot, s.q, s.qd, s.qdd)[:2]),
    "qdd": lambda robot, s: torchdq.forward_dynamics(robot, s.q, s.qd, 10 * s.qdd),
    "Jacobian in its frame": lambda robot, s: torchdq.jacobian(robot, s.q, robot.frame_names[-1]),
    "Jacobian in the world": lambda robot, s: torchdq.jacobian(robot, s.q, robot.frame_names[-1], expressed="world"),
}


def moved(robot, offset):
    """The robot with its first joints moved by an offset."""
    X = dq.mul(dq.from_pose(double(1, 0, 0, 0), double(*offset)), robot.X_PB_home)
    first = torch.tensor([parent == -1 for parent in robot.parents])[:, None]
    return robot.replace(X_PB_home=torch.where(first, X, robot.X_PB_home), on_unphysical="ignore").bake()


def require_alike(near, far, functions, dtype=F64):
    """The results of functions are the same; those of forward dynamics up to the condition of the mass matrix."""
    s = states(near, 5, dtype=dtype)
    condition = scaled_condition(torchdq.mass_matrix(near, s.q.double()))
    for name in functions:
        expected, found = (FUNCTIONS[name](robot, s) for robot in (near, far))
        allowed = (64 if dtype == F64 else 8) * EPS[dtype] * (condition if name == "qdd" else 1.0)
        assert (found - expected).abs().max() <= allowed * expected.abs().max(), name


@pytest.mark.case("G13")
@some
def test_far_robots_move_as_near_ones(name, distance):
    """In single precision too: frames hold only what is near them."""
    near = ROBOTS[name]()
    far = moved(near, DISTANCES[distance])
    require_alike(near, far, FUNCTIONS)
    require_alike(near, far, ("M", "tau", "d tau", "qdd"), torch.float32)


@some
def test_poses_of_far_robots_differ_by_the_offset(name, distance):
    near, offset = ROBOTS[name](), DISTANCES[distance]
    far, q = moved(near, offset), states(near, 5).q
    frame = near.frame_names[-1]
    a, b = (dq.to_matrix(torchdq.forward_kinematics(robot, q, frame)) for robot in (near, far))
    assert (a - b)[..., :3, :3].abs().max() <= 64 * EPS[F64]
    assert ((b - a)[..., :3, 3] - double(*offset)).abs().max() <= 64 * EPS[F64] * double(*offset).norm()


def on_a_tower(height):
    """Arm of three joints on a mast that turns about its slanted axis; the mast carries the arm at that height."""
    turn = dq.from_pose(dq.normalize(double(0.9, 0.3, -0.2, 0.1)), double(0, 0, 0))
    links = [
        ([0, 0, 1.0, 0, 0, 0], double(1, 0, 0, 0, 0, 0, 0, 0)),
        ([0, 1.0, 0, 0, 0, 0], dq.from_pose(double(1, 0, 0, 0), double(0.3, 0, height))),
        ([0, 0.6, 0.8, 0, 0, 0], dq.from_pose(dq.normalize(double(1, 0.2, 0.3, 0)), double(0.5, 0.1, 0.0))),
    ]
    robot = Robot.from_screws(
        [screw for screw, _ in links], [2.0, 1.0, 0.5], [[0.1, 0, height], [0.2, 0.1, 0], [0.1, 0, 0.3]],
        [[0.2, 0, 0.3, 0, 0, 0.25]] * 3,
    )  # fmt: skip
    X = torch.stack([dq.mul(turn, links[0][1]), links[1][1], links[2][1]])
    screw = double(*[screw for screw, _ in links])
    return robot.replace(X_PB_home=X, screw=screw, on_unphysical="ignore").bake()


def test_a_tower_of_27_km_that_turns_about_its_axis_changes_no_inertia():
    require_alike(on_a_tower(0.0), on_a_tower(27e3), ("M", "c", "tau", "Jacobian in the world"))


# --- small pitches ---------------------------------------------------------------------------------------------------

screwed = partial(
    Robot.from_screws, on_unphysical="ignore", mass=[1.0], com=[[0.1, 0, 0]], inertia=[[0.2, 0, 0.3, 0, 0, 0.25]]
)


@pytest.mark.parametrize("pitch", [1e-2, -1e-6, 2e-9])
def test_a_pitch_is_that_of_the_screw(pitch):
    robot = screwed([[0, 0, 1.0, 0, 0, pitch]])
    assert robot.kinds == ("helical",) and robot.screw[0, 5] == pitch
    assert not any("pitch" in note for note in map(str, robot.notes))
    position = dq.translation(torchdq.forward_kinematics(robot, double(2.0), "link1"))
    assert abs(position[2] - 2.0 * pitch) <= 4 * EPS[F64] * abs(pitch)


@pytest.mark.parametrize("pitch", [5e-10, -5e-10, 1e-12])
def test_a_pitch_that_is_taken_for_rounding_is_noted(pitch):
    robot = screwed([[0, 0, 1.0, 0, 0, pitch]])
    assert robot.kinds == ("revolute",)
    assert [(x.code, x.subject) for x in robot.notes] == [("screw.pitch", "joint1")]
    assert f"its pitch of {pitch:.3g} m/rad is rounding" in str(robot.notes[0])


@all_in_one([*itertools.product(range(20), [1.0, 37e3, 5e6])])
def test_a_line_far_from_the_base_has_no_pitch(of_what):
    """Its moment p x l is perpendicular to l up to rounding only."""
    seed, distance = of_what
    generator = torch.Generator().manual_seed(seed)
    axis, point = torch.randn(2, 3, generator=generator, dtype=F64)
    axis = axis / axis.norm()
    robot = screwed(torch.cat([axis, torch.linalg.cross(distance * point, axis)])[None])
    assert robot.kinds == ("revolute",) and not any("pitch" in note for note in map(str, robot.notes))
