"""The figures of the paper are drawn from computations that agree; the formulations they compare are of one robot.

Homogeneous matrices and the printed operators know nothing of the package's recursion, and Pinocchio nothing of either.
"""

import itertools
import math
from functools import reduce
from importlib import import_module

import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one, double, eager, exhaustive, random, thinned
from messages import refused
from places import ROOT

import torchdq
from torchdq.algebra import dual_quaternion, screw
from torchdq.dynamics.general import kinematics
from torchdq.dynamics.joints import KINDS, Coordinate
from torchdq.paper import cost, homogeneous, printed
from torchdq.paper.closed_form import closed_form

for needed in ("matplotlib", "tyro"):
    pytest.importorskip(needed, reason="the examples need the extra 'examples'")
from matplotlib.image import imread  # noqa: E402
from oracles import Case, pinocchio_model  # noqa: E402

figures = import_module("10_paper_figures")


def relative(x, reference):
    """Largest difference, over the largest number that is expected."""
    reference = torch.as_tensor(np.asarray(reference))
    return float((torch.as_tensor(np.asarray(x)) - reference).abs().max() / reference.abs().max())


def half(x):
    """A joint's displacement with cosine and sine of its half."""
    return Coordinate(x, math.cos(x / 2), math.sin(x / 2))


# --- torques ---------------------------------------------------------------------------------------------------------


def test_four_computations_of_the_torques_agree_and_are_those_on_record():
    arm = torchdq.robots.load("two_link")
    along = figures.reference(torch.linspace(0, figures.DURATION, 50, dtype=torch.float64))
    for state in (along, tuple(3 * random(3, 50, 2))):
        found = figures.differences(figures.torques(arm, *state))
        assert len(found) == 3 and max(float(x.max()) for x in found.values()) < 1e-12
    state = double(0.3, -0.7), double(0.5, -1.1), double(1.2, 2.3)
    for tau in figures.torques(arm, *state).values():
        torch.testing.assert_close(tau, double(23.175058392651, 6.062848943717), rtol=0, atol=1e-11)


def test_the_reference_rests_at_both_ends_and_is_differentiated_right():
    t = torch.linspace(0, figures.DURATION, 7, dtype=torch.float64, requires_grad=True)
    q, qd, qdd = figures.reference(t)
    torch.testing.assert_close(q[[0, -1]], torch.stack([figures.START, figures.END]))
    torch.testing.assert_close(torch.cat([qd[[0, -1]], qdd[[0, -1]]]), torch.zeros(4, 2, dtype=torch.float64))
    for x, rate in ((q, qd), (qd, qdd)):
        for joint in range(2):
            (slope,) = torch.autograd.grad(x[:, joint].sum(), t, retain_graph=True)
            torch.testing.assert_close(slope, rate[:, joint])


CHAINS = [*itertools.product([1, 2, 3, 7, 16, 42], ["R", "P", "H", "RPH"])]


@pytest.mark.parametrize("n, kinds", thinned(CHAINS, [(1, "H"), (2, "P"), (3, "R"), (7, "RPH")]))
def test_formulations_of_the_torques_agree_with_this_package_and_with_pinocchio(n, kinds):
    chain, tip = cost.chain(n, kinds)
    robot = cost.robot(chain, tip)
    (q, qd, qdd), f = random(3, n, seed=n), random(6, seed=n + 1)
    floats, rates, accelerations, wrench = (x.tolist() for x in (q, qd, qdd, f))
    halves = [None, *map(half, floats)]

    recursion = torchdq.inverse_dynamics(robot, q, qd, qdd)
    assert relative(figures.homogeneous_rnea(chain, q[None], qd[None], qdd[None])[0], recursion) < 1e-12
    if n <= 7:
        assert relative(figures.closed_form(robot, q[None], qd[None], qdd[None])[0], recursion) < 1e-12
    # on floats, because to record so many operators takes long
    Ad = kinematics.adjoints(kinematics.joint_poses(chain, halves))
    M, c, g, _ = closed_form(chain, Ad, rates)
    *M, c, g = (double(*(x or 0.0 for x in row)) for row in (*M, c, g))  # None: zero by structure
    assert relative(torch.stack(M) @ qdd + c + g, recursion) < 1e-12

    # with a wrench at the tip
    case = Case(robot, pinocchio_model(robot))
    frame = case.model.frames[case.model.getFrameId("tip")]
    on_links = [pin.Force.Zero() for _ in range(case.model.njoints)]
    on_links[frame.parentJoint] = -frame.placement.act(pin.Force(f[:3].numpy(), f[3:].numpy()))
    data, at = case.model.createData(), case.configuration(floats)
    expected = pin.rnea(case.model, data, at, qd.numpy(), qdd.numpy(), on_links)
    assert relative(torchdq.inverse_dynamics(robot, q, qd, qdd, f_tip=f), expected) < 1e-12

    back = [homogeneous.Displacement(-x, -math.sin(x), 1 - math.cos(x), math.sin(x) - x) for x in floats]
    outer = homogeneous.matrix(dual_quaternion.conj(tip))
    bodies, swapped = homogeneous.bodies(chain), wrench[3:] + wrench[:3]
    by_matrices = homogeneous.rnea(bodies, chain.gravity, back, rates, accelerations, outer, swapped)
    assert relative(by_matrices, expected) < 1e-12

    Ad_tip = printed.vectors(printed.columns(tip))
    as_printed = printed.rnea(chain, halves, rates, accelerations, Ad_tip, (wrench[:3], wrench[3:]))
    assert relative(as_printed, expected) < 1e-12


# --- poses -----------------------------------------------------------------------------------------------------------


def tip_matrix(robot, q):
    """Homogeneous matrix of the tip by this package."""
    return torchdq.dq.to_matrix(torchdq.forward_kinematics(robot, q, "tip"))


def by_exponentials(screws, home, kinds, q):
    """Matrices of the tip from screws in the base frame: Rodrigues' formula, and dual quaternions."""
    turns = [homogeneous.Displacement(x, math.sin(x), 1 - math.cos(x), x - math.sin(x)) for x in q]
    steps = [homogeneous.exponential(homogeneous.generator(s), turn) for s, turn in zip(screws, turns, strict=True)]
    by_matrices = reduce(homogeneous.product, [*steps, homogeneous.matrix(home)])
    motions = [KINDS[kind](s).motion(half(x)) for s, kind, x in zip(screws, kinds, q, strict=True)]
    return by_matrices, homogeneous.matrix(reduce(dual_quaternion.mul, [*motions, home]))


def denavit_hartenberg_by_products(cos, sin, alpha, a, d):
    """Transform of a joint by the two dense products Rot_z(theta) Trans_z(d) . Trans_x(a) . Rot_x(alpha)."""
    ca, sa = alpha
    about_z = [[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, d], [0, 0, 0, 1]]
    along_x = [[1, 0, 0, a], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    about_x = [[1, 0, 0, 0], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1]]
    return reduce(homogeneous.product, [about_z, along_x, about_x])


@pytest.mark.parametrize("n", thinned([1, 2, 7, 42], [1, 7]))
def test_four_formulations_of_the_pose_agree_on_a_denavit_hartenberg_arm(n):
    a, alpha, d, theta, q = random(5, n, seed=n)
    bodies = [1.0] * n, torch.zeros(n, 3), torch.eye(3).expand(n, 3, 3)
    robot = torchdq.Robot.from_dh(a, alpha, d, theta, *bodies)
    expected = tip_matrix(robot, q)
    rows = list(zip((q + theta).tolist(), alpha.tolist(), a.tolist(), d.tolist(), strict=True))

    for form in (homogeneous.denavit_hartenberg, denavit_hartenberg_by_products):
        steps = [
            form(math.cos(t), math.sin(t), (math.cos(twist), math.sin(twist)), length, offset)
            for t, twist, length, offset in rows
        ]
        assert relative(reduce(homogeneous.product, steps), expected) < 1e-13

    halved = [
        ((math.cos(t / 2), math.sin(t / 2)), (math.cos(w / 2), math.sin(w / 2)), x / 2, y / 2) for t, w, x, y in rows
    ]
    by_quaternions = reduce(dual_quaternion.mul, [printed.denavit_hartenberg(*row) for row in halved])
    assert relative(homogeneous.matrix(by_quaternions), expected) < 1e-13

    axes, pose = [], dual_quaternion.ONE  # of the joints at home, from the products of the D-H matrices
    for t, twist, length, offset in zip(theta.tolist(), alpha.tolist(), a.tolist(), d.tolist(), strict=True):
        axes.append(screw.ad(screw.columns(pose), ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))))
        step = (math.cos(t / 2), math.sin(t / 2)), (math.cos(twist / 2), math.sin(twist / 2)), length / 2, offset / 2
        pose = dual_quaternion.mul(pose, printed.denavit_hartenberg(*step))
    for found in by_exponentials(axes, pose, robot.kinds, q.tolist()):
        assert relative(found, expected) < 1e-13


@all_in_one(thinned(CHAINS, [(1, "R"), (2, "P"), (2, "H"), (2, "RPH"), (7, "RPH")]))
def test_exponentials_agree_with_this_package_on_all_kinds_of_joints(of_what):
    n, kinds = of_what
    chain, tip = cost.chain(n, kinds)
    q = random(n, seed=n)
    home, joints = kinematics.link_poses(chain, [link.placement for link in chain.links])[1:], chain.links[1:]
    screws = [screw.ad(screw.columns(x), link.joint.screw) for x, link in zip(home, joints, strict=True)]
    robot = cost.robot(chain, tip)
    expected, names = tip_matrix(robot, q), robot.kinds
    for found in by_exponentials(screws, dual_quaternion.mul(home[-1], tip), names, q.tolist()):
        assert relative(found, expected) < 1e-13


# --- costs -----------------------------------------------------------------------------------------------------------


def test_claims_are_those_that_the_laws_on_record_allow():
    fkm, rnea = figures.kinematics_costs(7), figures.dynamics_costs(17)
    said = "\n".join(figures.claims(fkm, rnea))
    for sentence in (
        "Pose, dense products: UDQ by D-H costs less than HTM by D-H for every n;",
        "Pose, dense products: UDQ by screws costs less than HTM by screws for every n;",
        "Torques, dense products: DQ costs less than HTM for every n;",
        "Pose, zeros known: UDQ by D-H costs less than HTM by D-H for no n;",
        # 50 n < 64 n - 48, 36 n < 44 n - 40
        "Pose, zeros known: UDQ by screws costs less than UDQ by D-H from n = 4 (multiplications) and from n = 6",
        "Pose, zeros known: HTM by screws costs less than HTM by D-H for no n;",
        "Torques, zeros known: DQ with the printed operators costs less than HTM for no n;",
        # 248 n - 133 < 243 n - 51, 206 n - 122 < 185 n - 51
        "DQ as this package has it costs less than HTM up to n = 16 (multiplications) and up to n = 3 (additions);",
    ):
        assert sentence in said
    stored = [{c.name: c.of("storage")[6] for c in curves if c.colour != figures.BLACK} for curves in fkm]
    assert stored[0] == {"HTM by D-H": 36 * 7, "HTM by screws": 12 * 7, "UDQ by D-H": 24 * 7, "UDQ by screws": 8 * 7}
    assert stored[1] == {"HTM by D-H": 6 * 7, "HTM by screws": 22 * 7, "UDQ by D-H": 6 * 7, "UDQ by screws": 8 * 7}
    dense, folded = ({c.name: c for c in curves} for curves in rnea)
    assert dense["HTM"].costs[6][:2] == (394 * 7 + 27, 335 * 7 + 18)
    assert dense["DQ as printed in Table 4"].costs[6][:2] == (321 * 7, 273 * 7)
    assert folded["DQ with the printed operators"].costs[6][:2] == (323 * 7 - 51, 242 * 7 - 51)
    program = folded["compiled program"]
    at = dict(zip(program.joints, program.of("operations"), strict=True))
    assert at[8] < min(c.of("operations")[7] for c in folded.values() if c is not program) / 2


def test_where_one_curve_is_below_another():
    def curve(*values):
        return figures.Curve("", "", "", range(1, 4), [cost.Cost(v, 0, 0) for v in values])

    level = curve(2, 2, 2)
    assert figures.where(curve(1, 1, 1), level, "multiplications") == "for every n"
    assert figures.where(curve(2, 3, 3), level, "multiplications") == "for no n"
    assert figures.where(curve(1, 1, 2), level, "multiplications") == "up to n = 2"
    assert figures.where(curve(3, 1, 1), level, "operations") == "from n = 2"


def test_numbers_of_a_joint_are_counted():
    # D-H: two of the angle, two of the twist, a, d; a line and two of the half angle; v, w, W2, Wv, W2v and four
    assert figures.numbers_read() == {"HTM, D-H": 6, "HTM, screws": 22, "UDQ, D-H": 6, "UDQ, screws": 8}


# --- pictures --------------------------------------------------------------------------------------------------------


@exhaustive
def test_the_figures_are_written(tmp_path, capsys):
    worst, off = figures.main(figures.Args(joints=3, step=0.02, dpi=25, out=tmp_path / "new"))
    assert max(worst.values()) < 1e-12 and 0 < off < 1e-5
    pictures = {path.name: imread(path)[..., :3] for path in (tmp_path / "new").iterdir()}
    assert pictures.keys() == {f"paper_{name}.png" for name in ("torques", "arm", "loop", "kinematics", "dynamics")}
    assert [name for name, picture in pictures.items() if picture.std() <= 0.03] == []  # that are blank
    said = capsys.readouterr().out
    assert "closed equations" in said and "for no n" in said


# --- what is timed ---------------------------------------------------------------------------------------------------


def test_formulations_that_are_timed_compute_the_same(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    timed = import_module("formulations")
    monkeypatch.setattr(timed, "BATCH", 16)
    arm = timed.Arm.random(timed.N)
    poses, torques = timed.poses(arm), timed.torques(*cost.chain(timed.N))
    assert [len(poses), len(torques)] == [5, 4]
    for group in (poses, torques):
        timed.require_agreement(group, eager)
        assert all(f.program.count().sines == 2 * timed.N for f in group)
    arm.d[3] += 1e-9
    with refused(ArithmeticError):
        timed.require_agreement([poses[0], timed.poses(arm)[3]], eager)

    for f, nanoseconds in zip((*poses, *torques), (4.0, 5.0, 4.0, 3.0, 2.0, 4.0, 4.0, 3.0, 1.0), strict=True):
        f.nanoseconds = nanoseconds
    said = timed.verdict([*poses, *torques])
    assert "as the paper counts, less for the pose by D-H (0.79)" in said
    assert "with zeros known, more for the pose by D-H (1.79), less for the pose by screws (0.84)" in said
    in_time = "in time, more for the pose by D-H (1.25), less for the pose by screws (0.75), as much for the torques"
    assert in_time in said
