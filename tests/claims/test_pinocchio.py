"""Dynamics and kinematics agree with pinocchio, on every robot of example-robot-data, the shipped ones and 200 trees.

A robot of every folder and some trees are in the default run, most of them with torques and poses alone, and
those with joints of every kind with all quantities in both precisions; `make test-all` takes all of all.

Joint order, joint frames and unbounded joints differ between the two, so everything is mapped by name. The trees have
skew axes, prismatic and helical joints, full inertia tensors, random homes, random gravity and, every second one,
rotors; their pinocchio model is built from the same random numbers, not from the robot.

An error is a largest difference relative to the size of what was added up, so that a small joint of a heavy robot is
held to its own size: of a joint torque, the magnitudes of its terms (`size_of_torques`); of M_ij, sqrt(M_ii M_jj). Each
quantity says what it is relative to. The tolerance is 1e-12 (4500 eps) and in single precision 5e-6 (42 eps); for
accelerations it is 32 eps times the condition number of the mass matrix scaled to a unit diagonal.
"""

import contextlib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from compared import TOLERANCE
from helpers import EVERYTHING, all_in_one, thinned
from messages import refused, warned
from oracles import Case, States, over, size_of_torques, worst

import torchdq

NAMES = oracles.names()
# differentiated operation by operation, which takes long: all kinds of joints and trees, but not all robots
DIFFERENTIATED = (
    *("kinova", "ur10_robot", "xarm7", "z1", "panda", "baxter", "allegro_right_hand", "solo12", "hextilt_flying_arm_5"),
    *oracles.SHIPPED_NAMES,
    *oracles.TREE_NAMES[::7],
)
TILTED = (4.0, -7.0, 5.5)  # gravity of a base that hangs askew [m/s^2]


# --- pinocchio's answers, in the robot's joint order, link frames and twist order ------------------------------------


def torques_of(case: Case, s: States) -> np.ndarray:
    """Torques of a motion."""
    return over(lambda model, data, q, v, a, *_: pin.rnea(model, data, q, v, a), case, s)[:, case.order]


def jacobians_of(case: Case, s: States, names, reference=pin.LOCAL) -> np.ndarray:
    """Jacobians [state, frame, 6, n] of frames, with the angular rows first."""
    ids = [case.frame_id(name) for name in names]

    def jacobians(model, data, q, *_):
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        # a single joint's Jacobian comes back flat
        return [pin.getFrameJacobian(model, data, frame, reference).reshape(6, model.nv) for frame in ids]

    return over(jacobians, case, s)[:, :, [3, 4, 5, 0, 1, 2]][..., case.order]


def reach(case: Case, s: States) -> float:
    """Largest distance of a frame from the base's origin [m]."""

    def distance(model, data, q, *_):
        pin.framesForwardKinematics(model, data, q)
        return max(np.linalg.norm(placement.translation) for placement in data.oMf)

    return float(over(distance, case, s).max())


def mass_matrices(case: Case, s: States) -> np.ndarray:
    """Mass matrices."""
    M = over(lambda model, data, q, *_: np.array(pin.crba(model, data, q)), case, s)
    M = np.triu(M) + np.triu(M, 1).swapaxes(-1, -2)  # the other triangle is not promised
    return M[:, case.order][..., case.order]


# --- quantities: the largest relative error of each ------------------------------------------------------------------


def torques(case: Case, s: States) -> float:
    """Joint torques of a motion under gravity, each relative to its terms."""
    tau = torchdq.inverse_dynamics(case.robot, s.q, s.qd, s.qdd)
    return worst(tau, torques_of(case, s), size_of_torques(case, s))


def torques_on_a_tilted_base(case: Case, s: States) -> float:
    """The same with gravity along no axis."""
    return torques(case.with_gravity(TILTED), s)


def torques_against_f_tip(case: Case, s: States) -> float:
    """Joint torques of a motion while the tip pushes on the environment."""
    robot = case.robot
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, f_tip=s.f_tip)
    f = s.f_tip.double().numpy()[:, [3, 4, 5, 0, 1, 2]]  # (moment, force) on a twist's (angular, linear)
    J = jacobians_of(case, s, [robot.tip])[:, 0]
    size = size_of_torques(case, s) + np.einsum("bkn,bk->bn", np.abs(J), np.abs(f)).max(0)
    return worst(tau, torques_of(case, s) + np.einsum("bkn,bk->bn", J, f), size)


def torques_under_f_ext(case: Case, s: States) -> float:
    """Joint torques of a motion while the environment pushes on every link."""
    tau = torchdq.inverse_dynamics(case.robot, s.q, s.qd, s.qdd, f_ext=s.f_ext)

    def loaded(model, data, q, v, a, _, f_ext):
        return pin.rnea(model, data, q, v, a, case.wrenches(f_ext))

    f = np.abs(s.f_ext.double().numpy()[..., [3, 4, 5, 0, 1, 2]])
    J = np.abs(jacobians_of(case, s, case.robot.link_names))
    size = size_of_torques(case, s) + np.einsum("blkn,blk->bn", J, f).max(0)
    return worst(tau, over(loaded, case, s)[:, case.order], size)


def mass_matrix(case: Case, s: States) -> float:
    """M_ij relative to sqrt(M_ii M_jj), each the largest over the states."""
    return _mass_matrix_error(torchdq.mass_matrix(case.robot, s.q), case, s)


@lru_cache(maxsize=1)
def closed_form(case: Case, s: States) -> torchdq.functional.ClosedForm:
    """Closed form; four tests in a row look at it."""
    return torchdq.closed_form(case.robot, s.q, s.qd)


def closed_form_mass_matrix(case: Case, s: States) -> float:
    """The same of the closed form (69)."""
    return _mass_matrix_error(closed_form(case, s).M, case, s)


def _mass_matrix_error(M: torch.Tensor, case: Case, s: States) -> float:
    reference = mass_matrices(case, s)
    size = np.sqrt(np.diagonal(reference, axis1=-2, axis2=-1).max(0))
    return worst(M, reference, size[:, None] * size)


def coriolis_torques(case: Case, s: States) -> float:
    """Torques c of the closed form (70), each relative to its terms."""
    free, moving = case.with_gravity((0.0, 0.0, 0.0)), s._replace(qdd=0 * s.qdd)
    c = closed_form(case, s).c
    return worst(c, torques_of(free, moving), size_of_torques(free, moving))


def gravity_torques(case: Case, s: States) -> float:
    """Torques g of the closed form (71), each relative to its terms."""
    g = closed_form(case, s).g
    reference = over(lambda model, data, q, *_: pin.computeGeneralizedGravity(model, data, q), case, s)
    return worst(g, reference[:, case.order], size_of_torques(case, s._replace(qd=0 * s.qd, qdd=0 * s.qdd)))


def transposed_tip_jacobian(case: Case, s: States) -> float:
    """J^T of the closed form (72) on (force, moment): angular columns absolute, linear ones relative to the reach."""
    Jt = closed_form(case, s).Jt
    J = jacobians_of(case, s, [case.robot.tip])[:, 0]
    return _jacobian_error(Jt.mT[:, [3, 4, 5, 0, 1, 2]], J, case, s)


def _jacobian_error(J, reference, case: Case, s: States) -> float:
    size = np.repeat([1.0, max(reach(case, s), 1e-3)], 3)[:, None]
    slides = np.array([kind != "revolute" for kind in case.robot.kinds], dtype=float)  # these also move by unit steps
    return worst(J, reference, np.maximum(size, slides))


def spread(names: Sequence[str], most: int) -> list[str]:
    """At most so many of the names, spread evenly, the first and the last among them."""
    return [names[round(i)] for i in np.linspace(0, len(names) - 1, min(most, len(names)))]


def body_jacobians(case: Case, s: States) -> float:
    """Jacobians of frames in their own axes: angular rows absolute, linear ones relative to the reach."""
    names = spread(case.robot.frame_names, 8)
    J = torch.stack([torchdq.jacobian(case.robot, s.q, name) for name in names], 1)
    return _jacobian_error(J, jacobians_of(case, s, names), case, s)


def world_jacobians(case: Case, s: States) -> float:
    """The same in the axes of the base."""
    names = spread(case.robot.frame_names, 4)
    J = torch.stack([torchdq.jacobian(case.robot, s.q, name, expressed="world") for name in names], 1)
    return _jacobian_error(J, jacobians_of(case, s, names, pin.LOCAL_WORLD_ALIGNED), case, s)


def poses(case: Case, s: States) -> float:
    """Poses of all frames: rotation matrices absolute, positions relative to the reach."""
    X = torchdq.forward_kinematics(case.robot, s.q)
    found = np.array([[oracles.se3(x).homogeneous for x in row] for row in X])
    ids = [case.frame_id(name) for name in case.robot.frame_names]

    def placements(model, data, q, *_):
        pin.framesForwardKinematics(model, data, q)
        return [data.oMf[frame].homogeneous for frame in ids]

    reference = over(placements, case, s)
    turned = worst(found[..., :3], reference[..., :3], 1.0)
    return max(turned, worst(found[..., 3], reference[..., 3], max(reach(case, s), 1e-3)))


def inertial_parameters(case: Case, s: States) -> float:
    """Parameters of the links: masses, first and second moments each relative to the link's largest of their kind."""
    pi = case.robot.inertial_parameters.to(s.q.dtype).double().numpy().reshape(-1, 10)
    error = 0.0
    for found, joint, placement in zip(pi, case.joints, case.link_placements(), strict=True):
        body = placement.actInv(case.model.inertias[joint.id])
        about_frame, (m, c) = body.toDynamicParameters(), (body.mass, np.linalg.norm(body.lever))
        size = np.repeat([m, m * c, np.linalg.norm(body.inertia) + m * c * c], [1, 3, 6])
        error = max(error, worst(found, about_frame, np.maximum(size, 1e-30)))
    return error


def regressor(case: Case, s: States) -> float:
    """Regressor: its columns of masses, first and second moments each relative to the largest of their kind."""
    n = case.robot.n
    Y = torchdq.regressor(case.robot, s.q, s.qd, s.qdd).reshape(-1, n, n, 10)

    def pinocchios(model, data, q, v, a, *_):
        return pin.computeJointTorqueRegressor(model, data, q, v, a).reshape(n, n, 10)

    links = [joint.id - 1 for joint in case.joints]
    reference = over(pinocchios, case, s)[:, case.order][:, :, links]
    moved = np.array([oracles.moved_parameters(placement) for placement in case.link_placements()])
    reference = np.einsum("bjlk,lkp->bjlp", reference, moved)
    largest = np.abs(reference).max((0, 1, 2))
    size = np.repeat([largest[0], largest[1:4].max(), largest[4:].max()], [1, 3, 6])
    return worst(Y, reference, size)


def derivatives(case: Case, s: States) -> float:
    """dtau/dq and dtau/dqd row by row, relative to the row's largest entry or the size of its torque; M as above."""
    found = torchdq.dynamics_jacobian(case.robot, s.q, s.qd, s.qdd)
    resting, free = s._replace(qdd=0 * s.qdd), case.with_gravity((0.0, 0.0, 0.0))
    sizes = (size_of_torques(case, s), size_of_torques(free, resting))
    error = _mass_matrix_error(found[2], case, s)
    for which, size in enumerate(sizes):

        def pinocchios(model, data, q, v, a, *_, which=which):
            return np.array(pin.computeRNEADerivatives(model, data, q, v, a)[which])

        reference = over(pinocchios, case, s)[:, case.order][..., case.order]
        row = np.maximum(np.abs(reference).max((0, 2)), size)[:, None]
        error = max(error, worst(found[which], reference, row))
    return error


def kinetic_energy(case: Case, s: States) -> float:
    """Kinetic energy, relative to itself."""
    still = pin.Model(case.model)
    still.armature = np.zeros(still.nv)  # pinocchio counts the rotors of some types of joint only

    def energy(model, data, q, v, *_):
        return pin.computeKineticEnergy(model, data, q, v) + 0.5 * case.model.armature @ v**2

    reference = over(energy, Case(case.robot, still), s)
    return worst(torchdq.kinetic_energy(case.robot, s.q, s.qd), reference, reference)


def potential_energy(case: Case, s: States) -> float:
    """Differences of potential energy between the states, relative to weight times reach."""
    reference = over(lambda model, data, q, *_: pin.computePotentialEnergy(model, data, q), case, s)
    found = torchdq.potential_energy(case.robot, s.q).double().numpy()
    bodies = list(case.model.inertias)[1:]
    size = sum(body.mass * (reach(case, s) + np.linalg.norm(body.lever)) for body in bodies)
    weight = np.linalg.norm(case.model.gravity.linear)
    return worst(found[1:] - found[0], reference[1:] - reference[0], weight * size)


QUANTITIES = (
    *(torques, torques_on_a_tilted_base, torques_against_f_tip, torques_under_f_ext, mass_matrix, poses, regressor),
    *(closed_form_mass_matrix, coriolis_torques, gravity_torques, transposed_tip_jacobian, body_jacobians),
    *(world_jacobians, inertial_parameters, kinetic_energy, potential_energy),
)
IN_SINGLE = (torques, torques_under_f_ext, mass_matrix, world_jacobians, poses)
# in the default run these alone are of all robots, and the other quantities of a few with joints of every kind:
# hinges, slides, screws and unbounded joints, in chains and branches, with and without rotors, one, two and more
BASIC = (torques, poses)
THOROUGH = (
    *("TwoDofs", "double_pendulum_continuous", "hextilt_flying_arm_5", "bolt", "shipped-puma560"),
    *("tree0", "tree121", "tree110", "tree55"),
)


def acceleration_error(case: Case, s: States) -> float:
    """Error of forward dynamics with all wrenches, in units of eps times the condition number it may grow with.

    With D = diag(M)^-1/2 the accelerations D^-1 qdd solve (D M D) x = D (tau - ...). Rounding M moves x by cond(D M D)
    times x, rounding the right side by |(D M D)^-1| times its terms.
    """
    robot, n = case.robot, case.robot.n
    rng = np.random.default_rng(n)
    size = size_of_torques(case, s._replace(qdd=0 * s.qdd))
    tau = torch.from_numpy(rng.normal(size=(len(s.q), n)) * np.maximum(size, 1e-3)).to(s.q.dtype)
    qdd = torchdq.forward_dynamics(robot, s.q, s.qd, tau, f_tip=s.f_tip, f_ext=s.f_ext).double().numpy()
    J_tip = jacobians_of(case, s, [robot.tip])[:, 0]
    J = np.abs(jacobians_of(case, s, robot.link_names))
    swap = [3, 4, 5, 0, 1, 2]
    f_ext, f_tip, applied = (x.double().numpy() for x in (s.f_ext, s.f_tip, tau))
    M, data = mass_matrices(case, s), case.model.createData()
    error = 0.0
    for b, (q, qd, *_) in enumerate(s.rows()):
        net = applied[b] - J_tip[b].T @ f_tip[b, swap]
        forces = case.wrenches(f_ext[b])
        reference = pin.aba(case.model, data, case.configuration(q), case.velocity(qd), case.velocity(net), forces)[
            case.order
        ]
        terms = np.abs(applied[b]) + size + np.abs(J_tip[b]).T @ np.abs(f_tip[b, swap])
        terms = terms + np.einsum("lkn,lk->n", J[b], np.abs(f_ext[b][:, swap]))
        D = np.diagonal(M[b]) ** -0.5
        singular_values = np.linalg.svd(D[:, None] * M[b] * D, compute_uv=False)
        condition = singular_values[0] / singular_values[-1]
        largest = np.abs(reference / D).max() + np.abs(D * terms).max() / singular_values[0]
        error = max(error, worst(qdd[b] / D, reference / D, largest) / condition)
    return error / oracles.EPS[s.q.dtype]


# --- tests -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", thinned(NAMES, oracles.REPRESENTATIVES))
def test_agrees_with_pinocchio(name):
    case, found = oracles.case(name), {}
    for dtype, quantities in ((torch.float64, QUANTITIES), (torch.float32, IN_SINGLE)):
        states = oracles.states(case.robot, dtype=dtype)
        for quantity in quantities:
            if EVERYTHING or name in THOROUGH or (quantity in BASIC and dtype == torch.float64):
                found[f"{quantity.__name__} in {dtype}"] = quantity(case, states) / TOLERANCE[dtype]
    assert {what: error for what, error in found.items() if not error <= 1.0} == {}


@pytest.mark.case("D11")
@pytest.mark.parametrize("name", thinned(DIFFERENTIATED, ("hextilt_flying_arm_5", "shipped-puma560", "tree77")))
def test_derivatives_agree_with_pinocchio(name, margin):
    case = oracles.case(name)
    margin(derivatives(case, oracles.states(case.robot)), TOLERANCE[torch.float64])


@pytest.mark.case("D2")
@pytest.mark.parametrize(
    "name", thinned([name for name in NAMES if name not in oracles.SINGULAR], (*THOROUGH, "go2", "tree33"))
)
def test_accelerations_agree_with_pinocchio(name, margin):
    case = oracles.case(name)
    margin(acceleration_error(case, oracles.states(case.robot)), 32)


@pytest.mark.case("D2")
@pytest.mark.parametrize("name", thinned(oracles.SHIPPED_NAMES, ("shipped-puma560", "shipped-two_link")))
def test_accelerations_agree_in_single_precision(name, margin):
    case = oracles.case(name)
    margin(acceleration_error(case, oracles.states(case.robot, dtype=torch.float32)), 32)


@pytest.mark.parametrize("name", oracles.JOINTLESS)
def test_frames_of_a_body_without_joints_are_where_pinocchio_puts_them(name):
    path = oracles.urdf_paths()[name]
    case = Case(torchdq.Robot.from_urdf(path), pin.buildModelFromUrdf(str(path)))
    assert case.robot.n == 0
    assert poses(case, oracles.states(case.robot)) <= TOLERANCE[torch.float64]


@all_in_one([*thinned(oracles.example_robots(), (*oracles.UNPHYSICAL, *oracles.ODD, *THOROUGH)), *oracles.UNREADABLE])
def test_a_robot_is_read_by_default_unless_there_is_none_or_it_is_unphysical(name):
    """Files with inertias that break the triangle inequality give a warning."""
    with contextlib.ExitStack() as expected:
        if name in (*oracles.UNPHYSICAL, *oracles.UNREADABLE):
            expected.enter_context(refused((torchdq.UnphysicalError, torchdq.DescriptionError)))
        elif name in oracles.ODD:
            expected.enter_context(warned(UserWarning))
        robot = torchdq.Robot.from_urdf(oracles.urdf_paths()[name])
        assert len(robot.link_names) == oracles.case(name).model.nv


@pytest.mark.parametrize("name", oracles.SINGULAR)
def test_a_robot_left_out_of_the_accelerations_has_a_singular_mass_matrix(name):
    case = oracles.case(name)
    assert np.linalg.svd(mass_matrices(case, oracles.states(case.robot)), compute_uv=False)[:, -1].max() < 1e-15


def test_the_trees_hold_every_kind_of_joint_many_times():
    thorough = [name for name in THOROUGH if name in oracles.TREE_NAMES]
    for trees, number in ((oracles.REPRESENTATIVE_TREES, 20), (thorough, 3)):
        kinds = [found for name in trees for found in oracles.case(name).robot.kinds]
        assert all(kinds.count(kind) >= number for kind in ("revolute", "prismatic", "helical"))


def test_a_robot_of_every_folder_is_among_the_representatives():
    folders = {name: path.parts[path.parts.index("robots") + 1] for name, path in oracles.example_robots().items()}
    assert {folders[name] for name in oracles.REPRESENTATIVE_ROBOTS} == set(folders.values())
