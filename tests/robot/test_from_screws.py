"""Robots from joint screws: joints, homes, trees and link frames.

Evidence: homogeneous matrices multiplied out here, and formulas of one-joint robots.
"""

import math
import warnings

import messages
import numpy as np
import pytest
import torch
from helpers import all_in_one, random
from robots import BALL, F64, LINE, forked, homogeneous, matrices, one_joint, pose, rotation, same, states, torques
from rotations import flat

import torchdq
from torchdq import DescriptionError, Robot, UnphysicalError

POINT = np.array([0.3, -0.2, 0.5])  # on the line
D = LINE[:3]
SLIDE = np.concatenate([np.zeros(3), D])


def test_the_screw_tells_the_kind_of_joint():
    pitched = [LINE + 0.1 * SLIDE, LINE - 1e-6 * SLIDE]
    kinds = [one_joint(screw).kinds[0] for screw in (LINE, SLIDE, *pitched)]
    assert kinds == ["revolute", "prismatic", "helical", "helical"]


@all_in_one([0.0, 0.7, -2.5])
def test_a_joint_turns_about_its_line_and_advances_by_its_pitch(q):
    for pitch in (0.0, 0.1):
        T = matrices(one_joint(LINE + pitch * SLIDE), [q], "link1").numpy()
        assert same(T[:3, :3] @ D, D)
        assert same(T[:3, :3] @ POINT + T[:3, 3], POINT + pitch * q * D)  # points of the line stay on it
        assert math.isclose((np.trace(T[:3, :3]) - 1) / 2, math.cos(q), abs_tol=1e-15)
    assert same(matrices(one_joint(SLIDE), [q], "link1"), homogeneous(np.eye(3), q * D))


def test_a_screw_jack_lifts_with_its_pitch():
    """Upright screw of pitch h through the centre of mass: M = I + m h^2, and gravity asks for m g h."""
    robot = Robot.from_screws([[0, 0, 1, 0, 0, 0.05]], mass=[3.0], com=[[0, 0, 0.2]], inertia=[BALL])
    tau = torchdq.inverse_dynamics(robot, *(torch.tensor([x], dtype=F64) for x in (0.4, 1.5, 2.0)))
    assert same(tau, [(0.02 + 3.0 * 0.05**2) * 2.0 + 3.0 * 9.81 * 0.05])


NO_SCREWS = [[0, 0, *x] for x in ((2, 0, 0, 0), (0.999999, 0, 0, 0), (0, 0, 0, 0), (0, 0, 0, 2), (0.5, 0, 0, 1))]
TWO_JOINTS = {"joint_screws": [LINE] * 2, "mass": [1, 1], "com": [[0, 0, 0]] * 2, "inertia": [BALL] * 2}
BROKEN = [
    *({"joint_screws": [x], "joint_names": ["knee"]} for x in NO_SCREWS),
    *({"joint_screws": x} for x in ([], 3.0, [[0, 0, 1, 0, 0]], "z")),
    *({"mass": x} for x in ([1.0, 2.0], ["heavy"], [math.nan], [1j], [1e300])),
    *({"com": x} for x in ([[0, 0]], [[0, 0, 0], [0]], torch.ones(1, 3, dtype=torch.complex64))),
    *({"inertia": x} for x in ([[1, 2, 3]], [[[1, 0, 0], [0.1, 1, 0], [0, 0, 1]]])),
    *({"link_poses": x} for x in ([[0.0] * 8], [[1.0] * 7])),
    {"tip_pose": [0.0] * 8},
    *({"parents": x} for x in ([0], [-1, 0], [None], ["a"], [0.5], [math.nan], 5)),
    *({"home": x} for x in ([-1e300], [0.0, 0.0], [math.inf])),
    *({"joint_names": x} for x in (5, "a", [])),
    *({"link_names": x} for x in ([["a"]], ["a", "b"], ["tip"])),
    {"joint_names": ["knee", "knee"]} | TWO_JOINTS,
    {"name": 5},
    {"gravity": "down"},
]


@pytest.mark.case("G14")
@all_in_one(range(len(BROKEN)))
def test_an_argument_that_does_not_fit_is_named(k):
    arguments = {"joint_screws": [LINE], "mass": [2.0], "com": [[0.1, 0.2, 0.3]], "inertia": [BALL]} | BROKEN[k]
    with messages.refused(DescriptionError):
        Robot.from_screws(**arguments)


def test_a_list_of_arrays_is_an_array():
    """A robot does not change with the arrays it was made of."""
    mass = np.ones(2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = Robot.from_screws([LINE, SLIDE], mass=mass, com=[np.zeros(3)] * 2, inertia=[0.1 * np.eye(3)] * 2)
    mass[0] = 3.0
    assert same(robot.screw, np.array([LINE, SLIDE])) and robot.mass.tolist() == [1.0, 1.0]


@pytest.mark.case("I1")
def test_a_link_without_a_body_is_noted():
    robot = one_joint(LINE, mass=[0.0], inertia=[(0,) * 6], on_unphysical="ignore")
    with pytest.raises(UnphysicalError) as refused:
        robot.check()
    (note,), (fault,) = robot.notes, refused.value.findings
    assert note == fault and (note.code, note.subject) == ("robot.massless", "")


def test_an_inertia_may_be_a_matrix():
    rng = np.random.default_rng(0)
    R = rotation(rng)
    matrix = R @ np.diag([0.1, 0.2, 0.25]) @ R.T  # symmetric up to rounding only
    assert same(torques(one_joint(LINE, inertia=[matrix])), torques(one_joint(LINE, inertia=[flat(matrix)])))


# --- home, trees, link frames ----------------------------------------------------------------------------------------


def random_chain(frames="base", home=None, n=4, seed=1):
    """The same random chain with its links described in other frames: the base frame, at the joints, or at the
    centres of mass with random axes."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    points, coms, mass = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), rng.uniform(0.5, 2, n)
    turns = [rotation(rng) for _ in range(n)]
    inertia = [R @ np.diag([0.1, 0.2, 0.25]) @ R.T for R in (rotation(rng) for _ in range(n))]
    screws = [np.concatenate([a, np.cross(p, a)]) for a, p in zip(axes, points, strict=True)]
    screws[2] = np.concatenate([np.zeros(3), axes[2]])
    tip = pose(homogeneous(rotation(rng), rng.normal(size=3)))
    common = {"mass": mass, "tip_pose": tip, "home": home}
    if frames == "base":
        return Robot.from_screws(screws, com=coms, inertia=inertia, **common)
    origins = points if frames == "joint" else coms
    return Robot.from_screws(
        screws,
        com=[R.T @ (c - p) for R, c, p in zip(turns, coms, origins, strict=True)],
        inertia=[R.T @ I @ R for R, I in zip(turns, inertia, strict=True)],
        link_poses=torch.stack([pose(homogeneous(R, p)) for R, p in zip(turns, origins, strict=True)]),
        **common,
    )


@all_in_one(["joint", "centre of mass"])
def test_torques_with_a_wrench_at_the_tip_do_not_depend_on_the_link_frames(frames):
    robots = random_chain(frames), random_chain("base")
    for f_tip in (None, random(5, 6)):
        tau, reference = (torchdq.inverse_dynamics(robot, *states(4), f_tip=f_tip) for robot in robots)
        assert same(tau, reference, 1e-12)


def test_without_link_poses_all_link_frames_are_the_base_frame_at_home():
    T = matrices(random_chain("base"), [0.0] * 4)
    assert same(T[:-1], torch.eye(4).expand(5, 4, 4))


def test_home_is_where_the_poses_hold_and_shifts_the_positions_and_nothing_else():
    home = torch.tensor([0.3, -0.4, 0.5, -0.6], dtype=F64)
    assert same(matrices(random_chain("joint", home), home), matrices(random_chain("joint"), [0.0] * 4))
    q, qd, qdd = states(4)
    tau = torchdq.inverse_dynamics(random_chain("joint", home), q + home, qd, qdd)
    assert same(tau, torchdq.inverse_dynamics(random_chain("joint"), q, qd, qdd), 1e-13)


@pytest.mark.case("U10")
def test_arms_of_a_tree_hang_on_the_trunk_not_on_each_other():
    at_rest = matrices(forked(), [0.2, 0.0, 0.0], "link3")
    assert same(matrices(forked(), [0.2, 0.9, 0.0], "link3"), at_rest)
    assert not same(matrices(forked(), [0.5, 0.0, 0.0], "link3"), at_rest)


@pytest.mark.case("U10")
def test_the_mass_matrix_of_a_tree_is_its_textbook_one():
    q2, q3 = 0.9, 0.4
    # the turning arm's centre of mass: 0.5 below x-axis at y = 1, swung by q2 about x
    y = 1 + 0.5 * math.sin(q2)
    trunk = 3 * 0.02 + 2 * y**2 + 3 * (1 + q3**2)
    # turning the trunk moves the slide along x: -y = 1 m away from it
    M = [[trunk, 0, 3.0], [0, 0.02 + 2 * 0.25, 0], [3.0, 0, 3.0]]
    assert same(torchdq.mass_matrix(forked(), torch.tensor([0.3, q2, q3], dtype=F64)), M)
