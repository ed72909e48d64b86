"""A moving base passes through every form of the algorithms: forces, base wrench, mass matrix, solutions, energies.

The reference is Pinocchio with a free-flyer whose body has an inertia of its own. A generalised force of the base is a
moment and a force in the base's frame, as its twist is (angular, linear); Pinocchio's order is the other way round.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
import torch
from oracles import EPS, Case, random_inertia, random_tree, stack, states

import torchdq
from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.inertia import Inertia, Moments
from torchdq.dynamics.aligned.posed import Aligned
from torchdq.dynamics.aligned.regroup import regrouped
from torchdq.dynamics.general.posed import General
from torchdq.dynamics.joints import KINDS, Coordinate, Fixed, Free, along_z
from torchdq.dynamics.posed import Posed, closed_form
from torchdq.dynamics.tree import Tree, on_base
from torchdq.functions import mdh, posed
from torchdq.paper import closed_form as paper_closed_form

B = 3  # samples
F64 = torch.float64
X_BT = dq.from_pose((0.5, 0.5, -0.5, 0.5), (0.3, -0.2, 0.4))  # a tool on the last link


class Moving(NamedTuple):
    """A random robot on a free base, in both forms, and Pinocchio's model of it."""

    robot: torchdq.Robot
    general: General
    aligned: Aligned
    model: pin.Model
    q: np.ndarray  # Pinocchio's configurations [B, nq]
    v: torch.Tensor  # twist of the base (angular, linear), and joint velocities [B, 6 + n]
    a: torch.Tensor  # rate of the twist, and joint accelerations


def free(case: Case) -> pin.Model:
    """The model with a free-flyer in the place of its universe."""
    model = pin.Model()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")
    for i in range(1, case.model.njoints):
        joint, placement = case.model.joints[i], case.model.jointPlacements[i]
        new = model.addJoint(root + case.model.parents[i], joint, placement, case.model.names[i])
        model.appendBodyToJoint(new, case.model.inertias[i], pin.SE3.Identity())
    for frame in case.model.frames:
        if frame.name in case.robot.link_names:
            model.addBodyFrame(frame.name, root + frame.parentJoint, frame.placement, 0)
    last = model.frames[model.getFrameId(case.robot.link_names[-1])]
    tool = pin.SE3(np.array(quat.rotation_columns(X_BT[0])).T, np.array(dq.translation(X_BT)))
    model.addFrame(pin.Frame("tool", last.parentJoint, last.placement * tool, pin.FrameType.OP_FRAME))
    model.gravity = case.model.gravity
    model.armature = np.concatenate([np.zeros(6), case.model.armature])
    return model


@cache
def moving(n: int, seed: int, armature: bool = False) -> Moving:
    case = random_tree(n, seed, armature)
    robot = case.robot.bake()
    rng = np.random.default_rng([5, n, seed])
    mass, com = 4.0, rng.normal(size=3) * 0.2
    about_com = random_inertia(rng, mass)
    six = tuple(float(about_com[i, j]) for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))
    model = free(case)
    model.inertias[1] = pin.Inertia(mass, com, about_com)

    s = states(robot, B, seed)
    r, p = rng.normal(size=(B, 4)), rng.normal(size=(B, 3))
    r /= np.linalg.norm(r, axis=-1, keepdims=True)
    X = torch.stack([torchdq.dq.from_pose(*(torch.from_numpy(x) for x in pair)) for pair in zip(r, p, strict=True)])
    X_WB = (X[:, :4].unbind(-1), X[:, 4:].unbind(-1))
    v, a = (torch.cat([torch.from_numpy(rng.normal(size=(B, 6))), x], -1) for x in (s.qd, s.qdd))
    q = np.stack([np.concatenate([p[k], r[k, 1:], r[k, :1], case.configuration(s.q[k].numpy())]) for k in range(B)])

    still = posed.tree(robot, {})
    x = (s.q if robot.home is None else s.q - robot.home).unbind(-1)
    links = still.links[1:]
    body = Inertia.from_com(mass, tuple(com), six)
    own = with_base(still, [link.placement for link in links], [link.inertia for link in links], body)
    coordinates = [X_WB, *(Coordinate(y, (0.5 * y).cos(), (0.5 * y).sin()) for y in x)]
    general = General.at(own, posed.field(robot, "com", {}), coordinates)

    alignments = mdh.align(still)
    fixed = posed.aligned(robot, s.q.unbind(-1), {}, group=False)
    bodies = [link.inertia for link in fixed.tree.links[1:]]
    body = Moments.from_com(mass, tuple(com), six)
    tree = with_base(still, [at.placement for at in alignments], bodies, body)
    aligned = Aligned.at(tree, alignments, posed.field(robot, "com", {}), x, X_WB)
    return Moving(robot, general, aligned, model, q, v, a)


def with_base(tree: Tree, placements, inertias, base: Inertia | Moments) -> Tree:
    """The tree on a free base with a body, its joints along z if the body has moments."""
    links = tree.links[1:]
    joints = [along_z(link.joint) if isinstance(base, Moments) else link.joint for link in links]
    armature = None if links[0].armature is None else [link.armature for link in links]
    parents = [link.parent - 1 for link in links]
    return on_base(parents, joints, placements, inertias, armature, tree.gravity, Free(), base)


def to_pinocchio(m: Moving, x) -> np.ndarray:
    """Velocities or forces in Pinocchio's order: (linear, angular) of the base, then its joints."""
    x = np.asarray(x)
    found = np.zeros_like(x)
    found[..., :3], found[..., 3:6] = x[..., 3:6], x[..., :3]
    for i, name in enumerate(m.robot.joint_names):
        found[..., m.model.joints[m.model.getJointId(name)].idx_v] = x[..., 6 + i]
    return found


def forms(m: Moving) -> list[tuple[str, Posed]]:
    return [
        ("general", m.general),
        ("aligned", m.aligned),
        ("grouped", m.aligned._replace(tree=regrouped(m.aligned.tree))),
    ]


ROBOTS = [(1, 0, False), (4, 1, False), (7, 2, True), (12, 3, False)]
FORMS = pytest.mark.parametrize("form", ["general", "aligned", "grouped"])
EVERY = pytest.mark.parametrize("robot", ROBOTS, ids=str)


def posed_as(m: Moving, form: str) -> Posed:
    return dict(forms(m))[form]


def expected_forces(m: Moving, v, a) -> np.ndarray:
    data = m.model.createData()
    return np.stack(
        [pin.rnea(m.model, data, *x) for x in zip(m.q, to_pinocchio(m, v), to_pinocchio(m, a), strict=True)]
    )


@FORMS
@EVERY
def test_forces_and_base_wrench_equal_pinocchios_with_a_free_flyer(robot, form):
    m = moving(*robot)
    tau = posed_as(m, form).torques(m.v.unbind(-1), m.a.unbind(-1), None)
    expected = expected_forces(m, m.v, m.a)
    assert abs(to_pinocchio(m, stack(tau, (B,))) - expected).max() <= 1e-12 * abs(expected).max()


@FORMS
@EVERY
def test_the_mass_matrix_equals_pinocchios(robot, form):
    m = moving(*robot)
    M = stack(posed_as(m, form).mass_matrix(), (B,)).numpy()
    data = m.model.createData()
    for k in range(B):
        expected = pin.crba(m.model, data, m.q[k])
        expected = np.triu(expected) + np.triu(expected, 1).T
        found = to_pinocchio(m, to_pinocchio(m, M[k]).T)
        assert abs(found - expected).max() <= 1e-12 * abs(expected).max()


@EVERY
def test_the_closed_form_with_a_moving_base_is_the_recursion(robot):
    m = moving(*robot)
    terms = paper_closed_form.closed_form(m.general.tree, m.general.Ad, m.v.unbind(-1))
    M, c, g = (stack(x, (B,)) for x in terms[:3])
    expected = expected_forces(m, m.v, m.a)
    found = (M @ m.a[..., None])[..., 0] + c + g
    assert abs(to_pinocchio(m, found) - expected).max() <= 1e-12 * abs(expected).max()
    assert abs(to_pinocchio(m, c + g) - expected_forces(m, m.v, 0 * m.a)).max() <= 1e-12 * abs(expected).max()
    assert abs(to_pinocchio(m, g) - expected_forces(m, 0 * m.v, 0 * m.a)).max() <= 1e-12 * abs(expected).max()


@FORMS
@EVERY
def test_the_terms_of_the_form_that_runs_are_those_of_the_paper(robot, form):
    m = moving(*robot)
    found, expected = (
        closed_form(posed_as(m, form), m.v.unbind(-1)),
        paper_closed_form.closed_form(m.general.tree, m.general.Ad, m.v.unbind(-1)),
    )
    for ours, papers in zip(found, expected[:3], strict=True):
        ours, papers = stack(ours, (B,)), stack(papers, (B,))
        assert (ours - papers).abs().max() <= 1e-12 * papers.abs().max()


@pytest.mark.parametrize("linear", [False, True])
@FORMS
@EVERY
def test_accelerations_undo_forces(robot, form, linear):
    m = moving(*robot)
    at = posed_as(m, form)
    M = stack(at.mass_matrix(), (B,))
    b = (M @ m.a[..., None])[..., 0]
    x = stack(at.factors(linear).solve(b.unbind(-1)), (B,))
    bound = 64 * EPS[F64] * np.linalg.cond(M.numpy()).max() * m.a.norm(dim=-1).max()
    assert (x - m.a).norm(dim=-1).max() <= bound


@FORMS
@EVERY
def test_energies_equal_pinocchios(robot, form):
    m = moving(*robot)
    at = posed_as(m, form)
    T, U = stack(at.kinetic_energy(m.v.unbind(-1)), (B,)), stack(at.potential_energy(), (B,))
    data = m.model.createData()
    for k in range(B):
        M, v = pin.crba(m.model, data, m.q[k]), to_pinocchio(m, m.v[k])
        kinetic = 0.5 * v @ (np.triu(M) + np.triu(M, 1).T) @ v  # rotors included
        assert abs(T[k] - kinetic) <= 1e-12 * kinetic
        potential = pin.computePotentialEnergy(m.model, data, m.q[k])
        assert abs(U[k] - potential) <= 1e-12 * max(abs(potential), 10.0)


@pytest.mark.parametrize("world", [False, True])
@FORMS
@EVERY
def test_jacobians_and_poses_equal_pinocchios(robot, form, world):
    m = moving(*robot)
    at, data = posed_as(m, form), m.model.createData()
    i = m.robot.n  # the last link
    J = at.jacobian(i, X_BT, world)
    J = stack([[0.0] * 6 if c is None else [*c[0], *c[1]] for c in J], (B,)).numpy()
    reference = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED if world else pin.ReferenceFrame.LOCAL
    frame = m.model.getFrameId("tool")
    poses = [at.poses(), *([at.poses_in_chain()] if form != "general" else [])]
    placed = [torchdq.dq.to_matrix(stack([*p, *d], (B,))).numpy() for p, d in (dq.mul(X[i], X_BT) for X in poses)]
    for k in range(B):
        expected = pin.computeFrameJacobian(m.model, data, m.q[k], frame, reference)
        expected = np.concatenate([expected[3:], expected[:3]])
        assert abs(to_pinocchio(m, J[k].T) - expected).max() <= 1e-12 * max(1.0, abs(expected).max())
        pin.framesForwardKinematics(m.model, data, m.q[k])
        for matrices in placed:
            assert abs(matrices[k] - data.oMf[frame].homogeneous).max() <= 1e-11


@EVERY
def test_poses_by_screws_in_the_base_frame_are_those_by_elementary_screws(robot):
    at = moving(*robot).aligned
    for found, expected in zip(at.poses_from_base(), at.poses_in_chain(), strict=True):
        pair = (dq.mul(found.motion, found.home), expected)  # which may differ in their sign
        found, expected = (torchdq.dq.to_matrix(stack([*p, *d], (B,))) for p, d in pair)
        assert (found - expected).abs().max() <= 1e-12


@FORMS
@EVERY
def test_twists_and_points_are_those_of_the_world(robot, form):
    """The velocity of a point is the derivative of its position along the motion."""
    m = moving(*robot)
    at = posed_as(m, form)
    V = at.twists(m.v.unbind(-1))
    i, data = m.robot.n, m.model.createData()
    com = at.com(i)
    there_and_back = at.to_link(i, at.to_world(i, com))
    assert (stack(there_and_back, (B,)) - stack(com, (B,))).abs().max() <= 64 * EPS[F64]
    position = torch.stack(torch.broadcast_tensors(*at.position(i, com)), -1)
    w, v = V[i]
    velocity = torch.stack(torch.broadcast_tensors(*at.to_world(i, quat.add(v, quat.cross(w, com)))), -1)
    frame, lever = m.model.getFrameId(m.robot.link_names[i - 1]), m.robot.com[i - 1].numpy()
    for k in range(B):
        pin.forwardKinematics(m.model, data, m.q[k], to_pinocchio(m, m.v[k]))
        pin.updateFramePlacements(m.model, data)
        assert abs(position[k].numpy() - data.oMf[frame].act(lever)).max() <= 1e-11
        twist = pin.getFrameVelocity(m.model, data, frame, pin.ReferenceFrame.LOCAL)
        expected = data.oMf[frame].rotation @ (twist.linear + np.cross(twist.angular, lever))
        assert abs(velocity[k].numpy() - expected).max() <= 1e-11


@pytest.mark.parametrize("joint", [Free(), Fixed()], ids=["free", "fixed"])
def test_a_base_moves_on_the_group_or_not_at_all(joint):
    v = torch.randn(6, dtype=F64, generator=torch.Generator().manual_seed(1))
    X = torchdq.dq.exp(torch.randn(6, dtype=F64, generator=torch.Generator().manual_seed(2)))

    def exp(a):
        x = torchdq.dq.exp(torch.stack([*a[0], *a[1]]))
        return tuple(x[:4]), tuple(x[4:])

    moved = joint.moved(tuple(X) if joint.nq else (), tuple(v), 0.3, exp)
    if not joint.nq:
        assert moved == ()
        return
    M = pin.SE3(torchdq.dq.to_matrix(X).numpy()) * pin.exp6(pin.Motion(0.3 * v[3:].numpy(), 0.3 * v[:3].numpy()))
    assert abs(torchdq.dq.to_matrix(torch.stack(moved)).numpy() - M.homogeneous).max() <= 32 * EPS[F64]


@pytest.mark.parametrize("kind", KINDS)
def test_a_joint_moves_along_its_screw(kind):
    """The motion over a time is the exponential of the rate, times half of that time."""
    direction, point = (0.6, 0.0, 0.8), (0.2, -0.3, 0.5)
    moment = quat.add(quat.cross(point, direction), quat.scale(0.25 * (kind == "helical"), direction))
    joint = KINDS[kind](((0.0, 0.0, 0.0), direction) if kind == "prismatic" else (direction, moment))
    q, v, h = (torch.tensor(x, dtype=F64) for x in (0.7, -1.1, 0.3))

    def motion(q):
        p, d = joint.motion(Coordinate(q, (0.5 * q).cos(), (0.5 * q).sin()))
        return stack([*p, *d], ())

    step = torchdq.dq.exp(stack([x for part in screw.scale(0.5 * h, joint.rate((v,))) for x in part], ()))
    (moved,) = joint.moved((q,), (v,), h, None)
    assert (torchdq.dq.mul(motion(q), step) - motion(moved)).abs().max() <= 16 * EPS[F64]


def test_a_fixed_base_records_nothing():
    """The operations of inverse dynamics are those of the moving links alone."""
    robot = random_tree(5, 4).robot.bake()
    tree = posed.tree(robot, {})
    assert tree.links[0].joint == Fixed() and tree.nv == robot.n and tree.links[0].inertia is None
