"""Body effects: pushes and drag are the torques of their wrenches; contact is in `test_contact`."""

import itertools
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
import torch
from effect_harness import CASES, ON_ROBOTS, SAMPLES, agrees, bare, double, forms_of
from on_ground import body

import torchdq
from torchdq import Scene, effects


class At(NamedTuple):
    """A frame in a state, everything in world axes."""

    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray  # of the frame's origin
    spin: np.ndarray
    jacobian: np.ndarray  # [6, n], of both


def at_frame(b, name, k):
    data = b.model.createData()
    q, v, f = b.case.configuration(b.q[k]), b.case.velocity(b.qd[k]), b.case.frame_id(name)
    pin.forwardKinematics(b.model, data, q, v)
    pin.updateFramePlacement(b.model, data, f)
    jacobian = pin.computeFrameJacobian(b.model, data, q, f, pin.LOCAL_WORLD_ALIGNED)[:, b.case.order]
    twist = jacobian @ b.qd[k].numpy()
    return At(data.oMf[f].rotation.copy(), data.oMf[f].translation.copy(), twist[:3], twist[3:], jacobian)


@pytest.mark.parametrize("axes", ["world", "body"])
@pytest.mark.parametrize("frame", ["tip", "link"])
@pytest.mark.parametrize("name", CASES)
def test_a_push_is_the_torque_of_its_jacobian(name, frame, axes):
    b = bare(name)
    frame = b.robot.end_effector().name if frame == "tip" else b.robot.link_names[b.n // 2]
    push = np.random.default_rng(1).normal(size=(SAMPLES, 6)) * 5
    torques = []
    for k in range(SAMPLES):
        at = at_frame(b, frame, k)
        turn = np.eye(3) if axes == "world" else at.rotation
        torques.append(at.jacobian.T @ np.concatenate([turn @ push[k, :3], turn @ push[k, 3:]]))
    assert agrees(b, effects.Push(frame, axes), torques=np.array(torques), push=double(push))


def test_wrenches_on_a_link_add_up():
    b, frame = bare("tree"), bare("tree").robot.end_effector().name
    one, two = np.random.default_rng(6).normal(size=(2, SAMPLES, 6)) * 5
    torques = [at_frame(b, frame, k).jacobian.T @ (one[k] + two[k]) for k in range(SAMPLES)]
    pushes = (effects.Push(frame, name="one"), effects.Push(frame, name="two"))
    assert agrees(b, pushes, torques=np.array(torques), one=double(one), two=double(two))


def test_a_push_that_is_not_given_is_none_and_costs_nothing():
    robot = CASES["panda"].robot
    scene = Scene(robot, (effects.Push(),))
    assert scene.program("torque").count() == Scene(robot).program("torque").count()
    assert scene.program("torque", "push").count().total > scene.program("torque").count().total


@pytest.mark.parametrize(("name", "form"), ON_ROBOTS)
def test_drag_resists_the_motion_of_every_link(name, form):
    b = bare(name)
    ranges = {"linear": (0.1, 1.0), "quadratic": (0.1, 1.0), "angular": (0.01, 0.2), "sign_width": (0.01, 0.5)}
    parameters, values = forms_of(ranges, form, b.n)
    torques = np.zeros((SAMPLES, b.n))
    for k, i in itertools.product(range(SAMPLES), range(b.n)):
        at = at_frame(b, b.robot.link_names[i], k)
        arm = at.rotation @ b.robot.com[i].numpy()
        v = at.velocity + np.cross(at.spin, arm)
        speed = np.sqrt(v @ v + values["sign_width"][k] ** 2)
        force = -(values["linear"][k, i] + values["quadratic"][k, i] * speed) * v
        moment = np.cross(arm, force) - values["angular"][k, i] * at.spin
        torques[k] += at.jacobian.T @ np.concatenate([force, moment])
    assert agrees(b, effects.Drag(**parameters), torques=torques)


@pytest.mark.parametrize("tensors", [False, True], ids=["constant", "tensors"])
@pytest.mark.parametrize("name", CASES)
def test_a_spring_to_a_point_pulls_the_frame_there(name, tensors):
    b, rng = bare(name), np.random.default_rng(8)
    frame = b.robot.end_effector().name
    values = {"anchor": rng.normal(size=3), "stiffness": 30.0, "damping": 2.0}
    if tensors:
        values = {"anchor": rng.normal(size=(SAMPLES, 3)), **{x: rng.uniform(1, 30, SAMPLES) for x in list(values)[1:]}}
    torques = []
    for k in range(SAMPLES):
        at = at_frame(b, frame, k)
        a, stiffness, damping = (x[k] if tensors else x for x in values.values())
        torques.append(at.jacobian[:3].T @ (stiffness * (a - at.position) - damping * at.velocity))
    parameters = {x: double(y) if tensors else tuple(y) if x == "anchor" else y for x, y in values.items()}
    assert agrees(b, effects.PointSpring(**parameters), torques=np.array(torques))


@pytest.mark.parametrize("stiffness", [1e3, 1e9])
def test_a_body_on_a_spring_swings_at_its_frequency_and_a_stiff_spring_holds_it(stiffness):
    mass, dt = 2.0, 1e-3
    spring = effects.PointSpring("body", (0.1, 0.0, 0.0), double(stiffness))
    scene = Scene(body(mass, (1.0, 1.0, 1.0)), (spring,), dt=dt, backend="auto")
    path = scene.rollout(scene.start(torch.zeros(0, dtype=torch.float64)), steps=1000)
    x = torchdq.dq.translation(path.X_WB)[:, 0] - 0.1
    if stiffness > 1e6:  # as damped as an implicit step is
        assert x[-1].abs() < 1e-9
        assert (x.abs() <= 0.1 + 1e-12).all()
    else:  # implicit steps with h w = 0.022
        turns = (x[:-1] * x[1:] < 0).nonzero().flatten().double()
        assert abs(turns.diff().mean() * dt / (np.pi / np.sqrt(stiffness / mass)) - 1) < 2e-3
