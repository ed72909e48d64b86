"""Robots with loops: accelerations are those of Pinocchio's terms with multipliers, and loops are closed by Newton."""

import itertools
import math

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from closed_loops import delta, four_bar, gripper
from free_flyers import case as flyer
from free_flyers import motion
from messages import refused
from robots import EPS, two

import torchdq
from torchdq import Closure, Scene, TorchdqError, effects
from torchdq.dynamics.closures import DECAY, ROWS
from torchdq.scene import integrators

F64 = torch.float64
KINDS = pytest.mark.parametrize("kind", ROWS)
LOOPS = {"gripper": gripper, "delta": delta}


def deepest(robot):
    """Link behind the most joints."""
    depths = [0]
    for parent in robot.parents:
        depths.append(1 + depths[parent + 1])
    return robot.link_names[max(range(robot.n), key=lambda i: depths[i + 1])]


def cosines(R, kind):
    """Rows of a gap that are about axes, of the rotation of B in A; and for each, its terms (weight, i, j)."""
    sines = [[(0.5, k - 1, k - 2), (-0.5, k - 2, k - 1)] for k in range(3)]
    terms = {"point": [], "hinge": [[(1, 0, 2)], [(1, 1, 2)]], "weld": sines}[kind]
    return [sum(s * R[i, j] for s, i, j in row) for row in terms], terms


def rows_of(c, closure, x, v):
    """J, gap g and d2g/dt2 at rest of a closure by Pinocchio's frames, the gap being in axes of the base."""
    *ends, kind = closure
    data, W = c.model.createData(), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    at = [0 if name == "universe" else c.frame_id(name) for name in ends]
    both = [set(c.model.supports[c.model.frames[k].parentJoint]) for k in at]
    moving = np.zeros(c.model.nv)  # the loop moves on joints at rest before it
    for joint in (c.model.joints[k] for k in both[0] ^ both[1]):
        moving[joint.idx_v : joint.idx_v + joint.nv] = 1
    pin.computeJointJacobians(c.model, data, x)
    pin.forwardKinematics(c.model, data, x, moving * v, np.zeros(c.model.nv))
    pin.updateFramePlacements(c.model, data)
    J = moving * np.subtract(*(pin.getFrameJacobian(c.model, data, k, W) for k in at[::-1]))
    a = np.subtract(*(pin.getFrameClassicalAcceleration(c.model, data, k, W).vector for k in at[::-1]))
    A, B = (data.oMf[k] for k in at)
    w = [pin.getFrameVelocity(c.model, data, k, W).angular for k in at]
    root = data.oMi[c.root].rotation
    linear = [root.T @ y for y in (B.translation - A.translation, J[:3], a[:3])]
    values, terms = cosines(A.rotation.T @ B.rotation, kind)
    rows, bends = [], []
    for row in terms:
        m = sum(s * np.cross(B.rotation[:, j], A.rotation[:, i]) for s, i, j in row)
        turned = sum(
            s * np.cross(np.cross(w[1], B.rotation[:, j]), A.rotation[:, i])
            + s * np.cross(B.rotation[:, j], np.cross(w[0], A.rotation[:, i]))
            for s, i, j in row
        )
        rows.append(m @ J[3:])
        bends.append(m @ a[3:] + turned @ (w[1] - w[0]))
    g, J = np.array([*linear[0], *values]), np.array([*linear[1], *rows])
    return J, g, np.array([*linear[2], *bends])


def expected(c, closures, x, v, tau, springs=None):
    """Accelerations by Pinocchio's M, bias and frames, and the condition of the equations; rows may be implied.

    Springs are rows (k, d).
    """
    model, data = c.model, c.model.createData()
    M, h = pin.crba(model, data, x), pin.nonLinearEffects(model, data, v=v, q=x)
    M = np.triu(M) + np.triu(M, 1).T
    parts = zip(*[rows_of(c, closure, x, v) for closure in closures], strict=True)
    J, g, gamma = map(np.concatenate, parts)
    if springs is not None:
        k, d = springs[:, : len(g)]
        return np.linalg.solve(M, tau - h - J.T @ (k * g + d * (J @ v))), np.linalg.cond(M)
    right = -(gamma + 2 * DECAY * J @ v + DECAY**2 * g)
    whole = np.block([[M, -J.T], [J, np.zeros((len(J), len(J)))]])
    a, _, rank, sizes = np.linalg.lstsq(whole, np.concatenate([tau - h, right]), rcond=1e-14)
    return a[: model.nv], sizes[0] / sizes[rank - 1]


def case_of(name, kind):
    """Robot with closures, the case of its tree, and its closures between Pinocchio's frames."""
    if name in LOOPS:
        urdf, closures = LOOPS[name]()
        c = oracles.Case(torchdq.Robot.from_urdf(urdf, tip="ground"), pin.buildModelFromXML(urdf))
        closures = [x._replace(kind=kind) for x in closures]
        return c, c.robot.with_closures(*closures), closures
    c = oracles.random_tree(14, int(name))
    leaf, base = deepest(c.robot), next(x.name for x in c.robot.frames if x.link == -1)
    return c, c.robot.with_closures(Closure(base, leaf, kind)), [Closure("universe", leaf, kind)]


CASES = [*itertools.product("012", ROWS), ("gripper", "point"), ("gripper", "hinge"), ("delta", "point")]


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_accelerations_are_those_of_pinocchios_terms_with_multipliers(name, kind):
    """Of random trees of which a link is held to the base, and of mechanisms, far from where they are closed."""
    c, robot, closures = case_of(name, kind)
    s = oracles.states(c.robot)
    found = torchdq.forward_dynamics(robot, s.q, s.qd, s.qdd)
    for k, (q, v, tau, *_) in enumerate(s.rows()):
        x, u, b = c.configuration(q), c.velocity(v), c.velocity(tau)
        a, condition = expected(c, closures, x, u, b)
        close = 10 * EPS * condition * np.abs(a).max()
        assert np.abs(found[k].numpy() - a[c.order]).max() < close


@KINDS
def test_elastic_closures_are_springs_and_dampers_on_pinocchios_gaps(kind):
    c, robot, closures = case_of("1", kind)
    s = oracles.states(robot)
    parts = (effects.Gravity(c.robot.gravity.tolist()), effects.Closures(40.0, 3.0, 20.0, 2.0))
    scene = Scene(robot, parts, integrator=integrators.ExplicitEuler(), dt=1.0)
    found = scene.step(scene.start(s.q, s.qd), s.qdd).qd - s.qd
    springs = np.array([[40.0] * 3 + [20.0] * 3, [3.0] * 3 + [2.0] * 3])
    for k, (q, v, tau, *_) in enumerate(s.rows()):
        x, u, b = c.configuration(q), c.velocity(v), c.velocity(tau)
        a, condition = expected(c, closures, x, u, b, springs)
        assert np.abs(found[k].numpy() - a[c.order]).max() < 10 * EPS * condition * np.abs(a).max()


@KINDS
def test_a_loop_on_a_floating_base_is_that_of_its_joints(kind):
    c = flyer("tree12")
    m, leaf = motion(c), deepest(c.robot)
    base = next(x.name for x in c.robot.frames if x.link == -1)
    robot = c.robot.with_closures(Closure(base, leaf, kind))
    given = m.pick("X_WB", "q", "V_WB_B", "qd", "tau")
    A, qdd = torchdq.floating.forward_dynamics(robot, **given)
    for k in range(len(qdd)):
        x, v = c.configuration(m["X_WB"][k].numpy(), m["q"][k].numpy()), c.velocity(m["V_WB_B"][k], m["qd"][k])
        tau = c.velocity(torch.zeros(6), m["tau"][k])
        a, condition = expected(c, robot.closures, x, v, tau)
        found = np.concatenate([A[k].numpy(), qdd[k].numpy()])
        assert np.abs(found - a[c.order]).max() < 10 * EPS * condition * np.abs(a).max()


def test_a_loop_is_closed_with_the_joints_that_are_held_where_they_are():
    robot = four_bar()
    q = torch.tensor([[1.0, -0.5, -1.0], [0.4, -0.6, -1.2]], dtype=F64, requires_grad=True)
    found = torchdq.closed(robot, q, hold="ja")
    assert (
        torch.equal(found[:, 0], q[:, 0])
        and float(torchdq.closure_errors(robot, found).distance.detach().max()) < 1e-14
    )
    (slope,) = torch.autograd.grad(found[:, 1].sum(), q)
    h = 1e-5
    ends = [torchdq.closed(robot, q.detach() + h * s * torch.tensor([1.0, 0, 0]), hold="ja")[:, 1] for s in (1, -1)]
    assert torch.allclose(slope[:, 0], (ends[0] - ends[1]) / (2 * h), rtol=0, atol=1e-6)
    (first,) = torch.autograd.grad(torchdq.closed(robot, q, hold="ja")[:, 1].sum(), q, create_graph=True)
    (bend,) = torch.autograd.grad(first[:, 0].sum(), q)
    h = 1e-4
    ends = [torchdq.closed(robot, q.detach() + h * s * torch.tensor([1.0, 0, 0]), hold="ja")[:, 1] for s in (1, 0, -1)]
    assert torch.allclose(bend[:, 0], (ends[0] - 2 * ends[1] + ends[2]) / h**2, rtol=0, atol=1e-5)
    assert float(torchdq.closure_errors(robot, torchdq.closed(robot, q)).distance.detach().max()) < 1e-14


def test_points_that_contradict_one_another_by_the_rounding_of_a_file_are_closed_as_far_as_they_go():
    """A pin given as two points on its axis, of which the file has one 30 nm off."""
    mass = '<inertial mass="1" pos=".1 0 0" diaginertia=".01 .01 .01"/>'
    text = f"""<mujoco><worldbody><body name="a"><joint name="ja" axis="0 -1 0"/>{mass}
      <body name="b" pos=".2 0 0"><joint name="jb" axis="0 -1 0"/>{mass}
      <site name="b1" pos=".3 0 0"/><site name="b2" pos=".30000003 .02 0"/></body></body>
      <site name="a1" pos=".1 0 .4"/><site name="a2" pos=".1 .02 .4"/></worldbody>
      <equality><connect site1="a1" site2="b1"/><connect site1="a2" site2="b2"/></equality></mujoco>"""
    robot = torchdq.Robot.from_mjcf(text)
    found = torchdq.closed(robot, torch.tensor([1.0, 1.0], dtype=F64))
    assert float(torchdq.closure_errors(robot, found).distance.max()) < 3e-8
    assert found.allclose(torchdq.closed(robot, found), rtol=0, atol=1e-12)


def test_errors_of_closures_are_distances_and_angles():
    robot = two().with_closures(Closure("base", "tip"), Closure("base", "tip", "weld"))
    q = torch.tensor([0.3, 0.2], dtype=F64)
    found = torchdq.closure_errors(robot, q)
    distance = math.hypot(math.cos(0.3) + math.cos(0.5), math.sin(0.3) + math.sin(0.5))
    assert torch.allclose(found.distance, torch.full((2,), distance, dtype=F64))
    assert torch.allclose(found.angle, torch.tensor([0.0, 0.5], dtype=F64))


def test_what_would_need_the_forces_of_closures_is_refused():
    robot, q = four_bar(), torch.zeros(3, dtype=F64)
    links = flyer("tree12").robot.link_names
    loop = (Closure(links[0], links[-1]),)
    calls = (
        lambda: torchdq.inverse_dynamics(robot, q),
        lambda: torchdq.dynamics_jacobian(robot, q, q, q),
        lambda: torchdq.regressor(robot, q, q, q),
        lambda: torchdq.computed_torque(robot, q, q, q, q, q, 1.0, 1.0),
        lambda: torchdq.operational_space(robot, q, q),
        lambda: torchdq.inverse_kinematics(robot, torchdq.forward_kinematics(robot, q, "end")),
        lambda: torchdq.closed(robot, torch.tensor([0.0, 0.0, 0.0], dtype=F64), hold=["ja", "jb"]),
        lambda: torchdq.closed(robot, q, hold="jd"),
        lambda: torchdq.constrained_inverse_dynamics(flyer("tree12").robot.with_closures(*loop), q),
        lambda: torchdq.closed(two(), torch.zeros(2)),
        lambda: two().with_closures(Closure("base", "tip", "bolt")),
        lambda: two().with_closures(Closure("link2", "tip")),
        lambda: two().with_closures(Closure("base", "top")),
        lambda: two().with_closures(("base", "tip")),
    )
    for call in calls:
        with refused(TorchdqError):
            call()
    assert torchdq.inverse_dynamics(robot.replace(closures=()), q).shape == (3,)


def motion_of_the_loop(robot, q, qd, qdd):
    """Velocities and accelerations of all joints of the four-bar linkage, of those of its crank."""
    q = q.requires_grad_()

    def gap(q):
        s = q.cumsum(-1)
        return torch.stack([(torch.tensor([0.2, 0.4, 0.4]) * f(s)).sum() for f in (torch.cos, torch.sin)])

    J = torch.autograd.functional.jacobian(gap, q)
    rates = torch.cat([torch.ones(1, dtype=F64), -torch.linalg.solve(J[:, 1:], J[:, 0])])
    v = qd * rates
    bend = torch.autograd.functional.jvp(
        lambda t: torch.autograd.functional.jvp(gap, q + t * v, v, create_graph=True)[1],
        torch.zeros((), dtype=F64),
        torch.ones((), dtype=F64),
    )[1]
    a = torch.cat([torch.full((1,), qdd, dtype=F64), -torch.linalg.solve(J[:, 1:], bend + J[:, 0] * qdd)])
    return v.detach(), a.detach()


def test_a_motor_of_a_loop_has_the_torque_of_its_virtual_work():
    """Of the forces at all joints of the tree; whichever joint has the motor, its power is the same."""
    robot = four_bar()
    q = torchdq.closed(robot, torch.tensor([1.0, -0.6, -1.2], dtype=F64), hold="ja")
    v, a = motion_of_the_loop(robot, q.detach(), 1.3, -0.7)
    tree = torchdq.inverse_dynamics(robot.replace(closures=()), q, v, a)
    for joint in ("ja", "jb", "jc"):
        tau, _ = torchdq.constrained_inverse_dynamics(robot, q, v, a, actuated=joint)
        assert abs(float(tau @ v - tree @ v)) < 1e-12 and int((tau != 0).sum()) == 1
        found = torchdq.forward_dynamics(robot, q, v, tau)
        assert torch.allclose(found, a, rtol=0, atol=1e-10)
    least = torchdq.constrained_inverse_dynamics(robot, q, v, a).tau
    assert float(least.norm()) < min(
        float(torchdq.constrained_inverse_dynamics(robot, q, v, a, x).tau.norm()) for x in ("ja", "jb", "jc")
    )
    assert torch.allclose(torchdq.forward_dynamics(robot, q, v, least), a, rtol=0, atol=1e-10)
    single = [x.float() for x in (q, v, a)]
    for given in ((q, v, a), single):
        with refused(TorchdqError):
            torchdq.constrained_inverse_dynamics(robot, *given, actuated=())
    near = torchdq.constrained_inverse_dynamics(robot, *single, actuated="ja").tau
    assert torch.allclose(near.double(), torchdq.constrained_inverse_dynamics(robot, q, v, a, "ja").tau, atol=1e-6)


def test_rows_of_motors_are_those_alone_with_gradients_and_a_nan_stays_in_its_row():
    robot, still = four_bar(), torch.zeros(3, dtype=F64)
    q = torchdq.closed(robot, torch.tensor([[1.0, -0.6, -1.2], [0.5, -0.6, -1.2]], dtype=F64), hold="ja").detach()
    broken = torch.cat([q, torch.full((1, 3), torch.nan, dtype=F64)])
    alone = torch.stack([torchdq.constrained_inverse_dynamics(robot, x, still, still, "ja").tau for x in q])
    found = torchdq.constrained_inverse_dynamics(robot, broken, still, still, "ja").tau
    assert torch.allclose(found[:2], alone, rtol=0, atol=1e-13) and bool(found[2].isnan().any())
    again = torchdq.closed(robot, broken)
    assert torch.allclose(again[:2], q, rtol=0, atol=1e-12) and bool(again[2].isnan().all())

    def holding(angle):
        x = torchdq.closed(robot, torch.cat([angle, q[0, 1:]]), hold="ja")
        return torchdq.constrained_inverse_dynamics(robot, x, still, still, "ja").tau[0]

    angle = q[0, :1].requires_grad_()
    (slope,) = torch.autograd.grad(holding(angle), angle)
    h = 1e-5
    assert abs(float(slope) - float(holding(angle + h) - holding(angle - h)) / (2 * h)) < 1e-6


def test_frames_half_a_turn_apart_are_not_closed():
    """Two links on one base about one axis, the second one welded to the first."""
    links = [[0, 0, 1, 0, 0, 0]] * 2
    body = {"mass": [1.0, 1.0], "com": [[0.1, 0, 0]] * 2, "inertia": [[0.1, 0, 0.1, 0, 0, 0.1]] * 2}
    robot = torchdq.Robot.from_screws(links, **body, parents=[-1, -1]).with_closures(Closure("link1", "link2", "weld"))
    assert torch.allclose(torchdq.closed(robot, torch.tensor([0.0, 1.0])), torch.tensor([0.5, 0.5]))
    turned = torchdq.closure_errors(robot, torch.tensor([0.0, 3.0], dtype=F64))
    assert abs(float(turned.angle) - 3.0) < 1e-12
    with refused(TorchdqError):
        torchdq.closed(robot, torch.tensor([0.0, 2.0]))


def test_a_light_link_of_a_loop_keeps_its_conditions():
    """A bar of a tenth of a milligram beside bars of kilograms, in a plane along no axes of the base."""
    mul, rotate = torchdq.dq.mul, torchdq.dq.rotate
    turn = torch.nn.functional.normalize(torch.tensor([0.7, 0.3, 0.5, -0.2], dtype=F64), dim=0)
    tilt, robot = torchdq.dq.from_pose(turn, torch.zeros(3, dtype=F64)), four_bar()
    X, inertia = robot.X_PB_home.clone(), robot.inertia * torch.tensor([[1.0], [1.0], [1e-7]])
    X[0] = mul(tilt, X[0])
    frames = tuple(f._replace(X_BF=mul(tilt, f.X_BF)) if f.link == -1 else f for f in robot.frames)
    level = robot.replace(mass=torch.tensor([0.2, 0.4, 1e-7], dtype=F64), inertia=inertia)
    tilted = level.replace(X_PB_home=X, frames=frames, gravity=rotate(turn, robot.gravity)).bake()
    q = torchdq.closed(level, torch.tensor([1.0, -0.6, -1.2], dtype=F64), hold="ja")
    qd, tau = torch.ones(3, dtype=F64), torch.zeros(3, dtype=F64)
    found, expected = (torchdq.forward_dynamics(r, q, qd, tau) for r in (tilted, level.bake()))
    assert torch.allclose(found, expected, rtol=1e-6, atol=0)
