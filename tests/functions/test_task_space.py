"""Motion, dynamics and control of frames, against Pinocchio, MuJoCo, forward dynamics, and laws of mechanics."""

import math
from functools import partial
from itertools import product

import mujoco
import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from compared import READ_BY_MUJOCO
from helpers import EVERYTHING, all_in_one, double, random, thinned
from messages import refused
from oracles import over, random_tree, worst
from robots import forked

import torchdq
from torchdq import ArgumentError, dq
from torchdq.errors import UnknownNameError

F64, EPS = torch.float64, 2.0**-52
AXES = ("body", "world")
TREES = oracles.TREE_NAMES[:40:10]
GEARS = {"j2": {"j0": -1.5}, "j4": {"j3": 0.5}, "j5": {"j3": 2.0}}
ARM, UR, PUMA, TWO = (torchdq.robots.load(name) for name in ("panda", "ur10e", "puma560", "two_link"))
FIVE = ARM.lock({ARM.joint_names[2]: 0.3, ARM.joint_names[6]: 0.1}).bake()  # joints are too few for a pose
ELBOW = double(0.3, 0.6, -0.2, -1.6, 0.4, 1.9, 0.5)  # a posture of the panda that is far from singular
CONTROLLED = {  # robots, and axes that their joints can serve
    "panda": (ARM, "pose"),
    "ur10e": (UR, "pose"),
    "puma560": (PUMA, "pose"),
    "panda by position": (ARM, "position"),
    "panda by names": (ARM, ("z", "rx", "rz", "ry")),
    "five joints": (FIVE, ("y", "rx", "ry", "rz", "x")),
    "two joints": (TWO, ("y", "x")),
}
FEW = ("panda by names", "five joints")
controlled = pytest.mark.parametrize("name", thinned(CONTROLLED, FEW))
in_axes = pytest.mark.parametrize("expressed", AXES)


def rows_of(axes):
    known = {"pose": range(6), "orientation": range(3), "position": range(3, 6)}
    return list(known[axes]) if isinstance(axes, str) else [("rx", "ry", "rz", "x", "y", "z").index(x) for x in axes]


def mechanism():
    """Tree of which three joints follow others, with rotors, and the ratios of all joints."""
    full = random_tree(6, 3).robot
    full = full.replace(armature=0.02 * torch.arange(1.0, 7, dtype=F64))
    ratios = double(1, 0, 0, 0, 1, 0, -1.5, 0, 0, 0, 0, 1, 0, 0, 0.5, 0, 0, 2).view(6, 3)
    return full, full.couple(GEARS).bake(), ratios


def regular(robot, axes, expressed, count=40, seed=0):
    """Positions that are not near a singular posture, and velocities."""
    q, qd = random(2, count, robot.n, seed=seed)
    near = torchdq.operational_space(robot, q, qd, expressed=expressed, axes=axes).growth
    return q[near < 1e4], qd[near < 1e4]


def moved(X, turn, shift):
    """Pose after a turn and a shift in its own axes."""
    return dq.mul(X, dq.exp(0.5 * torch.cat([turn, shift], -1)))


# --- motion ----------------------------------------------------------------------------------------------------------


@in_axes
@pytest.mark.parametrize("name", thinned([*oracles.SHIPPED_NAMES, *TREES], ["shipped-panda", TREES[1]]))
def test_motion_of_frames_is_that_of_pinocchio(name, expressed):
    case = oracles.case(name)
    s, world = oracles.states(case.robot), expressed == "world"
    reference = pin.LOCAL_WORLD_ALIGNED if world else pin.LOCAL
    accelerations = pin.getFrameClassicalAcceleration if world else pin.getFrameAcceleration
    for frame in sorted({case.robot.frame_names[-1], case.robot.tip or case.robot.link_names[0]}):
        index = case.frame_id(frame)

        def motion(model, data, q, v, a, *_, at=index):
            found = []
            for qdd in (a, 0 * a):
                pin.forwardKinematics(model, data, q, v, qdd)
                pin.updateFramePlacements(model, data)
                found.append(accelerations(model, data, at, reference).vector)
            return [pin.getFrameVelocity(model, data, at, reference).vector, *found]

        expected = over(motion, case, s)[..., [3, 4, 5, 0, 1, 2]]
        _, V, A = torchdq.frame_motion(case.robot, s.q, s.qd, s.qdd, frame, expressed)
        X, _, drift = torchdq.frame_motion(case.robot, s.q, s.qd, frame=frame, expressed=expressed)
        assert worst(torch.stack([V, A, drift], 1), expected, 1 + np.abs(expected).max()) <= 1e-12
        poses = [dq.to_matrix(x) for x in (X, torchdq.forward_kinematics(case.robot, s.q, frame))]
        torch.testing.assert_close(*poses, rtol=0, atol=1e-13)


@all_in_one(READ_BY_MUJOCO[:3])
def test_accelerations_of_velocities_are_those_of_mujoco(name):
    robot, model = oracles.example_case(name).robot, mujoco.MjModel.from_xml_string(oracles.rigid_bodies(name))
    s, data, frame = oracles.states(robot), mujoco.MjData(model), robot.link_names[-1]
    joints = [model.joint(joint) for joint in robot.joint_names]
    expected = []
    for q, qd, *_ in s.rows():
        data.qpos[[j.qposadr[0] for j in joints]], data.qvel[[j.dofadr[0] for j in joints]] = q, qd
        mujoco.mj_forward(model, data)
        moving, turning = np.zeros((2, 3, model.nv))
        mujoco.mj_jacDot(model, data, moving, turning, data.body(frame).xpos, model.body(frame).id)
        expected.append([*(turning @ data.qvel), *(moving @ data.qvel)])
    found = torchdq.frame_motion(robot, s.q, s.qd, frame=frame, expressed="world").A
    assert worst(found, np.array(expected), 1 + np.abs(expected).max()) <= 1e-12


@in_axes
def test_frames_of_coupled_joints_move_as_those_of_joints_that_are_moved_so(expressed):
    full, robot, ratios = mechanism()
    q, qd, qdd = random(3, 4, 3)
    found = torchdq.frame_motion(robot, q, qd, qdd, "b5", expressed)
    expected = torchdq.frame_motion(full, *[x @ ratios.mT for x in (q, qd, qdd)], "b5", expressed)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@in_axes
@pytest.mark.parametrize("name", ["shipped-panda", TREES[1]])
def test_wrenches_at_frames_are_the_torques_of_pinocchios_jacobians(name, expressed):
    case, axes = oracles.case(name), {"body": pin.LOCAL, "world": pin.LOCAL_WORLD_ALIGNED}[expressed]
    s, robot = oracles.states(case.robot), case.robot
    frames = [robot.link_names[-1], robot.link_names[0], robot.link_names[robot.n // 2], robot.frame_names[0]]
    wrenches = {f: random(*[3] * (k % 2), 6, seed=k) for k, f in enumerate(frames)}  # some for all rows

    def torques(model, data, q, *_):
        found = [pin.computeFrameJacobian(model, data, q, case.frame_id(f), axes).copy() for f in wrenches]
        return [J[:, case.order] for J in found]

    J = torch.from_numpy(over(torques, case, s))
    expected = sum((J[:, k].mT @ F[..., None])[..., 0] for k, F in enumerate(wrenches.values()))
    f_ext = torchdq.external_wrenches(robot, s.q, wrenches, expressed)
    found = torchdq.inverse_dynamics(robot, s.q) - torchdq.inverse_dynamics(robot, s.q, f_ext=f_ext)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * float(1 + expected.abs().max()))


# --- dynamics --------------------------------------------------------------------------------------------------------


@in_axes
@controlled
def test_forces_at_a_frame_accelerate_it_and_torques_of_the_projector_do_not(name, expressed):
    robot, axes = CONTROLLED[name]
    q, qd = regular(robot, axes, expressed)
    at = torchdq.operational_space(robot, q, qd, expressed=expressed, axes=axes)
    a, free, m = random(len(q), len(rows_of(axes)), seed=1), random(len(q), robot.n, seed=2), at.growth[:, None, None]
    tau = ((at.Lambda @ a[..., None] + (at.mu + at.p)[..., None]).mT @ at.J + free[:, None] @ at.N)[:, 0]
    qdd = torchdq.forward_dynamics(robot, q, qd, tau)
    found = torchdq.frame_motion(robot, q, qd, qdd, expressed=expressed).A[:, rows_of(axes)]
    size = 1 + qdd.abs().amax(1, keepdim=True)
    assert ((found - a).abs() / size <= 1024 * EPS * m[..., 0] * size).all()
    M = torchdq.mass_matrix(robot, q)
    still = at.J @ torch.linalg.solve(M, at.N.mT)
    assert (still.abs() <= 256 * EPS * m * torch.linalg.inv(M).abs().amax((1, 2), keepdim=True)).all()
    V = at.J @ qd[..., None]  # a frame has no more energy than the robot
    energy = (V.mT @ at.Lambda @ V)[:, 0, 0] / 2
    most = torchdq.kinetic_energy(robot, q, qd)
    assert (energy <= most * (1 + 1e-9)).all()
    if len(rows_of(axes)) == robot.n:
        torch.testing.assert_close(energy, most, rtol=1e-9, atol=0)


def test_manipulability_is_a_determinant_with_a_gradient_at_singular_postures_too():
    q = random(8, 7).requires_grad_()
    for robot, x, axes in ((ARM, q, "pose"), (ARM, q, ("y", "rz")), (TWO, q[:, :2], ("x", "y"))):
        J = torchdq.jacobian(robot, x, robot.tip)[:, rows_of(axes)]
        expected, found = torch.linalg.det(J @ J.mT).sqrt(), torchdq.manipulability(robot, x, axes=axes)
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=0)
        slopes = [torch.autograd.grad(y.sum(), q, retain_graph=True)[0] for y in (found, expected)]
        torch.testing.assert_close(*slopes, rtol=1e-7, atol=1e-7)
    for robot, axes in ((TWO, ("x", "y")), (ARM, "pose"), (UR, "pose")):
        stretched = torch.zeros(robot.n, dtype=F64, requires_grad=True)
        w = torchdq.manipulability(robot, stretched, axes=axes)
        w.backward()
        assert w < 1e-7 and stretched.grad.isfinite().all()


# --- Coriolis matrix -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", thinned([*oracles.SHIPPED_NAMES, *TREES[:2], "coupled"], ["shipped-panda", TREES[0], "coupled"])
)
def test_the_coriolis_matrix_gives_the_torques_and_the_rate_of_the_mass_matrix(name):
    robot = mechanism()[1] if name == "coupled" else oracles.case(name).robot
    q, qd = random(2, 3, robot.n)
    C = torchdq.coriolis_matrix(robot, q, qd)
    assert torchdq.compile(robot, "coriolis_matrix").program.name == f"coriolis_matrix_{robot.name}"
    c = torchdq.closed_form(robot, q, qd).c
    _, rate = torch.func.jvp(lambda q: torchdq.mass_matrix(robot, q), (q,), (qd,))
    size = 1 + C.abs().max()
    assert ((C @ qd[..., None])[..., 0] - c).abs().max() <= 1e-12 * size
    assert (C + C.mT - rate).abs().max() <= 1e-12 * size


# --- closed loop -----------------------------------------------------------------------------------------------------


def turning(X):
    """Pose without its displacement."""
    return torch.cat([X[..., :4], 0 * X[..., :4]], -1)


def errors(robot, motion, goal, axes, expressed):
    """Error of the pose as a function of time, by poses alone; vectors in the axes that the frame has at first."""
    axes_at_first = dq.conj(torchdq.forward_kinematics(robot, motion(0.0), robot.tip)[..., :4])

    def at(t):
        X, Y = torchdq.forward_kinematics(robot, motion(t), robot.tip), goal(t)
        if expressed == "body" and axes == "pose":
            return 2 * dq.log_shortest(dq.mul(dq.conj(X), Y))
        r, s = turning(X), turning(Y)
        turn = dq.mul(s, dq.conj(r)) if expressed == "world" else dq.mul(dq.conj(r), s)
        p = dq.translation(Y) - dq.translation(X)
        p = p if expressed == "world" else dq.rotate(axes_at_first, p)
        return torch.cat([2 * dq.log_shortest(turn)[..., :3], p], -1)[:, rows_of(axes)]

    return at


def moving_goal(X, V, A, expressed):
    """Pose as a function of time that begins at X with the twist V and the rate A of its components."""

    def at(t):
        w, v = (V * t + A * (t * t / 2)).split(3, -1)
        if expressed == "body":
            return moved(X, w, v)
        turn = dq.mul(dq.exp(0.5 * torch.cat([w, 0 * w], -1)), turning(X))
        return dq.from_pose(turn[..., :4], dq.translation(X) + v)

    return at


# robot, axes, and whether there is a posture, where joints are free for it
OBEYED = {name: (*x, False) for name, x in CONTROLLED.items()}
OBEYED |= {f"{name} with a posture": (*x, True) for name, x in CONTROLLED.items() if x[0] is ARM and x[1] != "pose"}
OBEYED["panda"] = (*CONTROLLED["panda"], True)
KEPT = (
    "panda-body",
    "panda by names with a posture-world",
    "two joints-world",
)
OBEYED = {f"{name}-{e}": (*x, e) for name, x in OBEYED.items() for e in AXES if EVERYTHING or f"{name}-{e}" in KEPT}


@pytest.mark.parametrize(("robot", "axes", "posture", "expressed"), OBEYED.values(), ids=OBEYED)
def test_the_error_obeys_its_equation_of_motion(robot, axes, posture, expressed):
    """It is differentiated along the motion that forward dynamics has under the torques; the goal moves too."""
    q, qd = regular(robot, axes, expressed)
    V, A = random(2, len(q), 6, seed=3)
    X = torchdq.forward_kinematics(robot, random(len(q), robot.n, seed=4), robot.tip)
    kp, kd = 1.0 + torch.arange(len(rows_of(axes)), dtype=F64), 3.0
    more = {"q_null": 0 * q, "k_null": 7.0} if posture else {}
    tau = torchdq.operational_space_control(
        robot, q, qd, X, V, A, kp=kp, kd=kd, expressed=expressed, axes=axes, damping=None, **more
    )
    qdd = torchdq.forward_dynamics(robot, q, qd, tau)
    e = errors(robot, lambda t: q + qd * t + qdd * (t * t / 2), moving_goal(X, V, A, expressed), axes, expressed)
    t, one = torch.zeros((), dtype=F64), torch.ones((), dtype=F64)

    def rate(t):
        return torch.func.jvp(e, (t,), (one,))[1]

    change, second = torch.func.jvp(rate, (t,), (one,))
    growth = torchdq.operational_space(robot, q, qd, expressed=expressed, axes=axes).growth[:, None]
    size = (1 + second.abs() + qdd.abs().amax(1, keepdim=True)) * (1 + qd.square().sum(1, keepdim=True))
    assert ((second + kd * change + kp * e(t)).abs() <= 256 * EPS * growth * size).all()
    if posture and len(rows_of(axes)) < robot.n:  # what the frame leaves free is the posture's, weighted by the mass
        N = torchdq.operational_space(robot, q, qd, expressed=expressed, axes=axes).N
        left = (N @ (qdd + 7.0 * q + 2 * math.sqrt(7.0) * qd)[..., None])[..., 0]
        assert (left.abs() <= 256 * EPS * growth * size.amax(1, keepdim=True)).all()


def test_the_error_from_170_degrees_is_that_of_an_oscillator():
    robot = UR.replace(armature=torch.full((6,), 0.1, dtype=F64))
    q, qd, kp, kd, h = double(0.3, -1.2, 1.4, -0.6, 1.2, 0.4), torch.zeros(6, dtype=F64), 25.0, 4.0, 2e-3
    X = torchdq.forward_kinematics(robot, q, "tip")
    goal = moved(X, math.radians(170) * double(1, -2, 14) / math.sqrt(201), double(0.02, 0.03, -0.02))

    def slope(q, qd):
        tau = torchdq.operational_space_control(robot, q, qd, goal, kp=kp, kd=kd)
        return torch.cat([qd, torchdq.forward_dynamics(robot, q, qd, tau)])

    def error(q):
        return 2 * dq.log_shortest(dq.mul(dq.conj(torchdq.forward_kinematics(robot, q, "tip")), goal))

    def stepped(x):
        k1 = slope(*x.split(6))
        k2 = slope(*(x + h / 2 * k1).split(6))
        k3 = slope(*(x + h / 2 * k2).split(6))
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(*(x + h * k3).split(6)))

    first, x, rate = error(q), torch.cat([q, qd]), math.sqrt(kp - kd * kd / 4)
    for k in range(300):
        with torchdq.backend("auto"):  # some thousand calls
            x = stepped(x)
        t = h * (k + 1)
        left = math.exp(-kd / 2 * t) * (math.cos(rate * t) + kd / 2 / rate * math.sin(rate * t))
        if k % 20 == 19:
            assert (error(x[:6]) - left * first).abs().max() <= 1e-9


def test_a_spring_at_the_tip_pulls_with_its_stiffness_and_damps():
    q, qd, stiffness, damping = ELBOW, 0.1 * random(7), double(9, 8, 7, 600, 500, 400), double(1, 2, 3, 40, 50, 60)
    X = torchdq.forward_kinematics(ARM, q, "tip")
    shift = double(0.01, -0.02, 0.03)
    goal = dq.from_pose(X[:4], dq.translation(X) + shift)
    J, held = torchdq.jacobian(ARM, q, "tip", "world"), torchdq.inverse_dynamics(ARM, q)
    tau = torchdq.cartesian_impedance(ARM, q, 0 * q, goal, stiffness=stiffness, damping=damping)
    torch.testing.assert_close(tau - held, (stiffness[3:] * shift) @ J[3:], rtol=1e-10, atol=1e-11)
    tau = torchdq.cartesian_impedance(ARM, q, qd, X, stiffness=stiffness, damping=damping)
    moving = torchdq.inverse_dynamics(ARM, q, qd)
    torch.testing.assert_close(tau - moving, -(damping * (J @ qd)) @ J, rtol=1e-10, atol=1e-11)
    at = []
    for posture in ({}, {"q_null": 0 * q, "k_null": 50.0}):
        tau = torchdq.cartesian_impedance(ARM, q, qd, goal, stiffness=stiffness, damping=damping, **posture)
        at.append(torchdq.frame_motion(ARM, q, qd, torchdq.forward_dynamics(ARM, q, qd, tau)).A)
    torch.testing.assert_close(*at, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("robot", "axes"), [(ARM, "pose"), (ARM, "position"), (TWO, ("x", "y"))])
def test_a_spring_beside_which_gravity_alone_is_held_takes_the_power_that_it_gives(robot, axes):
    """T' = qd (tau - g) for any motion, which is less the rate of the spring's energy without a damper."""
    q, qd = random(2, 20, robot.n)
    stiffness = torch.cat([double(30.0).expand(3), double(600, 500, 400)])[rows_of(axes)]
    goal = torchdq.forward_kinematics(robot, random(20, robot.n, seed=3), "tip")

    def spring(q):
        X = torchdq.forward_kinematics(robot, q, "tip")
        turn = 2 * dq.log_shortest(dq.mul(goal, dq.conj(X)))[..., :3]
        e = torch.cat([turn, dq.translation(goal) - dq.translation(X)], -1)[..., rows_of(axes)]
        return 0.5 * (stiffness * e * e).sum(-1)

    def power(stiffness, damping):
        given = {"stiffness": stiffness, "damping": damping, "axes": axes, "coriolis": False}
        tau = torchdq.cartesian_impedance(robot, q, qd, goal, **given)
        return ((tau - torchdq.inverse_dynamics(robot, q)) * qd).sum(-1)

    taken = torch.func.jvp(spring, (q,), (qd,))[1]
    torch.testing.assert_close(power(stiffness, 0.0), -taken, rtol=1e-11, atol=1e-11 * float(taken.abs().max()))
    assert (power(0.0, 5.0) < 0).all()


# --- goals -----------------------------------------------------------------------------------------------------------


def control(q, qd, X, **more):
    return torchdq.operational_space_control(ARM, q, qd, X, **({"kp": 100.0, "kd": 20.0} | more))


@in_axes
def test_a_pose_its_opposite_and_a_multiple_are_the_same_goal(expressed):
    q, qd = random(2, 16, 7)
    X = torchdq.forward_kinematics(ARM, random(16, 7, seed=5), "tip")
    more = {"V_des": random(16, 6), "A_des": random(16, 6, seed=1), "expressed": expressed}
    tau = control(q, qd, X, **more)
    for same in (-X, 4.0 * X):
        assert torch.equal(control(q, qd, same, **more), tau)
    stretched = X + torch.cat([torch.zeros(16, 4, dtype=F64), X[:, :4]], -1)  # by a dual number
    torch.testing.assert_close(control(q, qd, stretched, **more), tau, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("angle", "expressed"),
    thinned(
        list(product([0.0, 1e-300, 1e-9, 3.0, math.pi - 1e-9, math.pi, math.pi + 1e-9], AXES)),
        [(0.0, "world"), (1e-9, "body"), (3.0, "body"), (math.pi, "body")],
    ),
)
def test_every_error_of_the_rotation_has_a_torque_with_two_derivatives(angle, expressed):
    axis = double(2, -3, 6) / 7
    q, X = ELBOW.clone().requires_grad_(), torchdq.forward_kinematics(ARM, ELBOW, "tip")
    goal = moved(X, angle * axis, double(0.1, 0.0, 1e4) if angle == 3.0 else torch.zeros(3, dtype=F64))
    tau = control(q, 0 * ELBOW, goal, expressed=expressed)
    (slope,) = torch.autograd.grad(tau.sum(), q, create_graph=True)
    (second,) = torch.autograd.grad(slope.sum(), q)
    assert all(bool(x.isfinite().all()) for x in (tau, slope, second))
    asked = torchdq.frame_motion(ARM, ELBOW, 0 * ELBOW, torchdq.forward_dynamics(ARM, ELBOW, None, tau.detach())).A
    turned = min(angle, 2 * math.pi - angle)  # the other way round is the shorter one beyond half a turn
    assert abs(float(asked[:3].norm()) - 100.0 * turned) <= 1e-9 * (1 + 100 * turned) or angle == 3.0


# --- singular postures -----------------------------------------------------------------------------------------------

MOST = 30.0  # times the usual torque
SINGULAR = {  # robots, singular postures, and the way through them
    "panda at zero": (ARM, torch.zeros(7, dtype=F64), ELBOW, "pose"),
    "wrist": (UR, double(0.3, -1.2, 1.4, -0.6, 0, 0.4), double(0, 0, 0, 0, 1, 0), "pose"),
    "wrist of a puma": (PUMA, double(0.3, -1.2, 1.4, 0.6, 0, 0.4), double(0, 0, 0, 0, 1, 0), "pose"),
    "elbow": (UR, double(0.3, -1.2, 0, 0.6, 0.9, 0.4), double(0, 0, 1, 0, 0, 0), "pose"),
    "stretched along an axis": (TWO, double(0.0, 0.0), double(0.0, 1.0), ("x", "y")),
}


@in_axes
@pytest.mark.parametrize("name", thinned(SINGULAR, ("wrist", "stretched along an axis")))
def test_torques_through_a_singular_posture_are_bounded_and_continuous(name, expressed):
    """And away from it they are those without damping to the last bit, where a singular row is NaN."""
    robot, q, way, axes = SINGULAR[name]
    steps = torch.linspace(-1.0, 1.0, 4001, dtype=F64)
    sweep = q + steps[:, None] * way
    X = moved(torchdq.forward_kinematics(robot, sweep, robot.tip), double(0.1, 0.2, 0.1), double(0.02, 0.02, 0.01))
    given = {"kp": 100.0, "kd": 20.0, "expressed": expressed, "axes": axes}
    exact = torchdq.operational_space_control(robot, sweep, 0 * sweep, X, **given, damping=None)
    tau = torchdq.operational_space_control(robot, sweep, 0 * sweep, X, **given)
    same = (tau == exact).all(1)
    usual = tau[same].abs().amax(1).median()
    assert same.double().mean() > 0.8 and not same[steps.abs() < 0.02].any()
    assert tau.isfinite().all() and tau.abs().max() <= MOST * usual
    assert (tau[1:] - tau[:-1]).abs().max() <= 0.05 * MOST * usual
    alone = torchdq.operational_space_control(robot, sweep[:1], 0 * sweep[:1], X[:1], **given)
    assert torch.equal(tau[:1], alone)
    assert exact[2000].isnan().all() and exact[same].isfinite().all()


@pytest.mark.parametrize(("robot", "q", "way", "axes"), SINGULAR.values(), ids=SINGULAR)
def test_damping_adds_what_its_formula_says_to_the_inverse_of_the_inertia(robot, q, way, axes):
    """To its diagonal, row by row from the last, as the pivots of J J^T ask for, to which it adds as much."""
    q, b, rows = q + torch.linspace(-0.1, 0.1, 5, dtype=F64)[:, None] * way, 0.25, rows_of(axes)
    e = 0.1 * random(5, 6, seed=3) * double(*[float(r in rows) for r in range(6)])
    goal = moved(torchdq.forward_kinematics(robot, q, robot.tip), *e.split(3, -1))
    J = torchdq.jacobian(robot, q, robot.tip)
    S, A = J @ J.mT, J @ torch.linalg.solve(torchdq.mass_matrix(robot, q), J.mT)
    sizes = [x.diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, 3)).mean(-1) for x in (S, A)]
    S, A, most = S[:, rows][..., rows], A[:, rows][..., rows], 0.0
    for k in reversed(range(len(rows))):
        after, (size, own) = slice(k + 1, None), (x[:, rows[k] // 3] for x in sizes)
        known = S[:, k, None, after] @ torch.linalg.solve(S[:, after, after], S[:, after, k, None])
        share = (b - (S[:, k, k] - known[:, 0, 0]) / size).clamp(min=0) ** 2 / (4 * b)
        S[:, k, k] += share * size
        A[:, k, k] += share * own
        most = max(most, float(share.max()))
    F = torch.linalg.solve(A, 50.0 * e[:, rows, None])
    expected = torchdq.inverse_dynamics(robot, q) + (J[:, rows].mT @ F)[..., 0]
    tau = torchdq.operational_space_control(robot, q, 0 * q, goal, kp=50.0, kd=3.0, axes=axes, damping=b)
    torch.testing.assert_close(tau, expected, rtol=1e-9, atol=1e-9)
    assert most > 0


SINGLE = [(name, x, axes) for name in ("panda", "ur10e") for x in (2.0**-8, None) for axes in AXES]


@pytest.mark.parametrize(("name", "damping", "expressed"), thinned(SINGLE, [("ur10e", None, "body")]))
def test_torques_in_single_precision_are_those_in_double(name, damping, expressed):
    """Near singular postures too, where rows whose growth is above the limit are computed in double precision."""
    robot = CONTROLLED[name][0]
    q, qd = random(2, 10_000, robot.n)
    X = torchdq.forward_kinematics(robot, q + 0.2 * random(10_000, robot.n, seed=1), "tip")
    given = {"kp": 100.0, "kd": 20.0, "expressed": expressed, "damping": damping}
    x = [a.float() for a in (q, qd, X)]
    exact = torchdq.operational_space_control(robot, *[a.double() for a in x], **given)
    single = torchdq.operational_space_control(robot, *x, **given).double()
    off = (single - exact).abs().amax(1) / exact.abs().amax(1)
    assert off.max() <= 2.0**-10 and off.median() <= 32 * 2.0**-23
    if name == "ur10e" and damping is None:
        found = torchdq.operational_space(robot, *x[:2], expressed=expressed)
        at = torchdq.operational_space(robot, *[a.double() for a in x[:2]], expressed=expressed)
        for a, b in zip((found.Lambda, found.mu, found.p, found.Jbar), (at.Lambda, at.mu, at.p, at.Jbar), strict=True):
            size = b.flatten(1).abs().amax(1)
            assert ((a.double() - b).flatten(1).abs().amax(1) <= 2.0**-9 * size).all()


def test_a_damped_row_has_a_gradient_and_nan_stays_in_its_row():
    q = torch.zeros(3, 7, dtype=F64)
    q[1], q[2, 0] = ELBOW, math.nan
    q.requires_grad_()
    X = torchdq.forward_kinematics(ARM, ELBOW + 0.1, "tip")
    tau = control(q, torch.zeros_like(q), X)
    (slope,) = torch.autograd.grad(tau[:2].sum(), q)
    assert tau[:2].isfinite().all() and slope[:2].isfinite().all() and tau[2].isnan().all()
    X = X.repeat(2, 1)
    X[1, 0] = math.nan  # the last joint turns the position of the tip about itself, so it does not move it
    for limits in (False, True):
        tau = control(q[:2].detach(), torch.zeros(2, 7, dtype=F64), X, axes="position", limits=limits)
        assert tau[0].isfinite().all() and tau[1].isnan().all()


# --- limits ----------------------------------------------------------------------------------------------------------


def test_limits_scale_the_torques_of_the_task_and_keep_the_direction():
    q, qd = ELBOW + 0.1 * random(40, 7), 0.1 * random(40, 7, seed=1)
    X = moved(torchdq.forward_kinematics(ARM, q, "tip"), *(0.2 * random(2, 40, 3, seed=2)))
    free, held = control(q, qd, X, kp=400.0), control(q, qd, X, kp=400.0, limits=True)
    within = (free.abs() <= ARM.limits.effort).all(1)
    assert within.any() and (free.abs() > 1.1 * ARM.limits.effort).any() and torch.equal(free[within], held[within])
    assert (held.abs() <= ARM.limits.effort * (1 + 1e-12)).all()
    bias = torchdq.inverse_dynamics(ARM, q, qd)
    share = ((held - bias) * (free - bias)).sum(1, keepdim=True) / (free - bias).square().sum(1, keepdim=True)
    torch.testing.assert_close(held - bias, share * (free - bias), rtol=1e-10, atol=1e-10)
    reached = ((held.abs() / ARM.limits.effort).amax(1) - 1).abs() <= 1e-12  # no smaller than it must be
    assert reached[~within].all()


# --- refusals --------------------------------------------------------------------------------------------------------


REST = torch.zeros(2, dtype=F64)
GOALS = {robot: torchdq.forward_kinematics(robot, q, "tip") for robot, q in ((ARM, ELBOW), (TWO, REST))}
GAINS = {"kp": 1.0, "kd": 1.0}


def served(**more):
    return torchdq.operational_space_control(TWO, REST, REST, GOALS[TWO], **({"axes": ("x",), **GAINS} | more))


def of_axes(axes):
    return torchdq.operational_space(TWO, REST, REST, axes=axes)


def of_wrenches(wrenches):
    return torchdq.external_wrenches(TWO, REST, wrenches)


REFUSED = [
    *(partial(of_axes, axes) for axes in ("pose", ("x", "z"), ("x", "x"), ("x", "up"), "", 3, (1, 2))),
    lambda: torchdq.manipulability(ARM, ELBOW, frame="base"),
    lambda: torchdq.frame_motion(ARM.with_tip(None), *torch.zeros(2, 7, dtype=F64)),
    partial(served, limits=True),
    lambda: torchdq.compile(ARM, "operational_space", options=("tip", "body", "pose", "limits")),
    partial(control, ELBOW, ELBOW, GOALS[ARM], kp=100.0 * torch.eye(6, dtype=F64)),
    *(partial(of_wrenches, x) for x in ({}, [random(6)], {"tip": 1.0}, {"hand": random(6)}, {"tip": random(5)})),
]


@all_in_one(REFUSED)
def test_what_joints_cannot_serve_is_refused_with_what_they_can(call):
    with refused((ArgumentError, UnknownNameError)):
        call()


def test_axes_of_a_compiled_function_are_names_in_a_row_or_in_one_string():
    found = [torchdq.compile(ARM, "operational_space", options=("tip", "world", x)) for x in (("x", "y"), "x y")]
    assert str(found[0].program) == str(found[1].program)


@all_in_one(["frame_motion", "manipulability", "operational_space", "operational_space_control"])
def test_floating_bases_are_refused_with_the_reason(name):
    """Before the axes, more than two joints can serve."""
    inertia = double(1, 0, 1, 0, 0, 1)
    free = TWO.replace(base_mass=double(1)[0], base_com=torch.zeros(3), base_inertia=inertia)
    more, gains = () if name == "manipulability" else (REST,), {}
    if name == "operational_space_control":
        more, gains = (REST, torch.eye(8, dtype=F64)[0]), GAINS
    with refused(ArgumentError):
        getattr(torchdq, name)(free, REST, *more, **gains)


def test_one_joint_that_slides_is_controlled():
    robot = forked()
    q, goal = torch.zeros(3, dtype=F64), dq.from_pose(double(1, 0, 0, 0), double(0.3, 0, 0))
    frame = robot.link_names[2]
    tau = torchdq.operational_space_control(robot, q, q, goal, kp=4.0, kd=4.0, frame=frame, axes="x")
    A = torchdq.frame_motion(robot, q, q, torchdq.forward_dynamics(robot, q, q, tau), frame).A
    p = dq.translation(torchdq.forward_kinematics(robot, q, frame))
    assert abs(float(A[3] - 4.0 * (0.3 - p[0]))) < 1e-12


# --- transforms and derivatives --------------------------------------------------------------------------------------


def test_the_law_goes_through_transforms_graphs_and_backends():
    q, qd = random(2, 4, 2)
    X = torchdq.forward_kinematics(TWO, random(4, 2, seed=1), "tip")
    kp = torch.tensor(9.0, dtype=F64, requires_grad=True)
    strong = TWO.replace(limits=TWO.limits._replace(effort=double(1e6, 1e6)))
    given = {"kd": 6.0, "axes": ("x", "y"), "expressed": "world", "limits": True}

    def law(q, qd, X):
        return torchdq.operational_space_control(strong, q, qd, X, kp=kp.detach(), q_null=q.detach(), **given)

    expected = law(q, qd, X)
    assert torch.equal(torch.func.vmap(law)(q, qd, X), expected)
    if EVERYTHING:  # layers/test_task_control.py compiles another law
        assert torch.equal(torch.compile(law, fullgraph=True, backend="eager")(q, qd, X), expected)
    with torchdq.backend("auto"):
        torch.testing.assert_close(law(q, qd, X), expected, rtol=1e-12, atol=1e-12)
    inputs = [x[:2].clone().requires_grad_() for x in (q, qd, X)]
    assert torch.autograd.gradcheck(law, inputs, fast_mode=True)
    assert torch.autograd.gradgradcheck(law, inputs, fast_mode=True)
    tau = torchdq.operational_space_control(TWO, q, qd, X, kp=kp, kd=6.0, axes=("x", "y"))
    (slope,) = torch.autograd.grad(tau.sum(), kp)
    rows = torchdq.operational_space_control(TWO, q, qd, X, kp=kp.detach().expand(4, 2), kd=6.0, axes=("x", "y"))
    assert slope.shape == () and torch.equal(rows, tau.detach())


def test_the_law_of_a_robot_with_replaced_masses_has_their_gradient():
    mass = (1.1 * ARM.mass).requires_grad_()
    robot = ARM.replace(mass=mass)
    X = torchdq.forward_kinematics(ARM, ELBOW + 0.1, "tip")
    tau = torchdq.operational_space_control(robot, ELBOW, ELBOW, X, kp=9.0, kd=6.0, damping=None)
    (slope,) = torch.autograd.grad(tau.sum(), mass)
    h = 1e-6

    def total(scale):
        changed = ARM.replace(mass=1.1 * ARM.mass * torch.where(torch.arange(7) == 5, double(scale), double(1)))
        given = {"kp": 9.0, "kd": 6.0, "damping": None}
        return torchdq.operational_space_control(changed, ELBOW, ELBOW, X, **given).sum()

    expected = (total(1 + h) - total(1 - h)) / (2 * h * 1.1 * ARM.mass[5])
    torch.testing.assert_close(slope[5], expected, rtol=1e-6, atol=1e-6)
