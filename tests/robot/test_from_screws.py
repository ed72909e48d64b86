"""Robots from joint screws: joints, homes, trees and link frames.

Evidence: homogeneous matrices multiplied out here, and formulas of one-joint robots.
"""

import math
import warnings

import messages
import numpy as np
import pytest
import torch
from helpers import all_in_one
from robots import (
    BALL,
    DIRECTION,
    F64,
    LINE,
    POINT,
    SLIDE,
    forked,
    homogeneous,
    matrices,
    one_joint,
    pose,
    rotation,
    same,
    states,
    torques,
)

import torchdq
from torchdq import DescriptionError, Robot, UnphysicalError


@pytest.mark.parametrize(
    "screw, kind",
    [(LINE, "revolute"), (SLIDE, "prismatic"), (LINE + 0.1 * SLIDE, "helical"), (LINE - 1e-6 * SLIDE, "helical")],
    ids=["line", "translation", "line with pitch", "line with a small pitch"],
)
def test_the_screw_tells_the_kind_of_joint(screw, kind):
    assert one_joint(screw).kinds == (kind,)


@all_in_one([0.0, 0.7, -2.5])
def test_a_revolute_joint_turns_about_its_line(q):
    T = matrices(one_joint(LINE), [q], "link1").numpy()
    assert same(T[:3, :3] @ DIRECTION, DIRECTION)
    assert same(T[:3, :3] @ POINT + T[:3, 3], POINT)  # points on the line stay
    assert math.isclose((np.trace(T[:3, :3]) - 1) / 2, math.cos(q), abs_tol=1e-15)


def test_a_prismatic_joint_moves_along_its_direction():
    assert same(matrices(one_joint(SLIDE), [0.7], "link1"), homogeneous(np.eye(3), 0.7 * DIRECTION))


def test_a_helical_joint_advances_by_its_pitch():
    T = matrices(one_joint(LINE + 0.1 * SLIDE), [0.7], "link1").numpy()
    assert same(T[:3, :3] @ POINT + T[:3, 3], POINT + 0.1 * 0.7 * DIRECTION)


def test_a_screw_jack_lifts_with_its_pitch():
    """Upright screw of pitch h through the centre of mass: M = I + m h^2, and gravity asks for m g h."""
    robot = Robot.from_screws([[0, 0, 1, 0, 0, 0.05]], mass=[3.0], com=[[0, 0, 0.2]], inertia=[BALL])
    tau = torchdq.inverse_dynamics(robot, *(torch.tensor([x], dtype=F64) for x in (0.4, 1.5, 2.0)))
    assert same(tau, [(0.02 + 3.0 * 0.05**2) * 2.0 + 3.0 * 9.81 * 0.05])


NO_SCREWS = [
    [0, 0, 2, 0, 0, 0],
    [0, 0, 0.999999, 0, 0, 0],
    [0, 0, 0, 0, 0, 0],
    [0, 0, 0, 0, 0, 2],
    [0, 0, 0.5, 0, 0, 1],
]


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
    {
        "joint_names": ["knee", "knee"],
        "joint_screws": [LINE] * 2,
        "mass": [1, 1],
        "com": [[0, 0, 0]] * 2,
        "inertia": [BALL] * 2,
    },
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
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = Robot.from_screws([LINE, SLIDE], mass=np.ones(2), com=[np.zeros(3)] * 2, inertia=[0.1 * np.eye(3)] * 2)
    assert same(robot.screw, np.array([LINE, SLIDE]))


def test_a_robot_does_not_change_with_the_arrays_it_was_made_of():
    mass = np.array([2.0])
    robot = one_joint(LINE, mass=mass)
    mass[0] = 3.0
    assert robot.mass.tolist() == [2.0]


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
    six = (matrix[0, 0], matrix[0, 1], matrix[1, 1], matrix[0, 2], matrix[1, 2], matrix[2, 2])
    assert same(torques(one_joint(LINE, inertia=[matrix])), torques(one_joint(LINE, inertia=[six])))


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
    f = torch.randn(5, 6, generator=torch.Generator().manual_seed(7), dtype=F64)
    for tip in (None, f):
        tau, reference = (
            torchdq.inverse_dynamics(robot, *states(4), f_tip=tip)
            for robot in (random_chain(frames), random_chain("base"))
        )
        assert same(tau, reference, 1e-12)


def test_without_link_poses_all_link_frames_are_the_base_frame_at_home():
    T = matrices(random_chain("base"), [0.0] * 4)
    assert same(T[:-1], torch.eye(4).expand(5, 4, 4))


def test_home_is_where_the_poses_hold():
    home = [0.3, -0.4, 0.5, -0.6]
    assert same(matrices(random_chain("joint", home), home), matrices(random_chain("joint"), [0.0] * 4))


def test_home_shifts_the_positions_and_nothing_else():
    home = torch.tensor([0.3, -0.4, 0.5, -0.6], dtype=F64)
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
