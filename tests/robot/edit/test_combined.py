"""Payloads, tools and other robots on a robot, against Pinocchio's bodies and joined models."""

import warnings
from functools import partial
from itertools import product

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one, random, thinned
from messages import refused, warned
from oracles import random_tree
from robots import F64, FREE_BODY, noted, on_free_base, two
from rotations import flat, tensor

import torchdq
from torchdq import ArgumentError, UnknownNameError, dq
from torchdq.robot import Frame

WORST = 1e-12
MASS, COM = 1.7, [0.1, -0.2, 0.3]
INERTIA = [0.3, 0.02, 0.4, -0.03, 0.01, 0.5]  # xx xy yy xz yz zz


def double(x):
    return torch.as_tensor(x, dtype=F64)


def body(mass=MASS, com=COM, inertia=INERTIA):
    return pin.Inertia(mass, np.array(com), tensor(inertia))


def rows(n, seed=0):
    return random(3, 3, n, seed=seed)


def pose(seed=0):
    return dq.exp(random(6, seed=seed))


def torques_of(model, robot, x):
    """Pinocchio's torques of the joints of a robot."""
    case, data = oracles.Case(robot, model), model.createData()
    arguments = (
        (case.configuration(q), case.velocity(qd), case.velocity(qdd)) for q, qd, qdd in x.movedim(1, 0).numpy()
    )
    return double(np.array([pin.rnea(model, data, *row)[case.order] for row in arguments]))


NO_PALM = "ignore:robot '.*' has no body of its base"  # said of robots whose base bodies these tests do without


def close(found, expected):
    return found.shape == expected.shape and bool((found - expected).abs().max() <= WORST * expected.abs().max())


# --- payloads and tools ----------------------------------------------------------------------------------------------


@all_in_one([2, 9])
def test_a_payload_is_pinocchios_body(seed):
    case = random_tree(5, seed, armature=True)
    frame = case.robot.frame("tip")
    held = case.robot.with_payload(MASS, COM, INERTIA)
    model = pin.Model(case.model)
    placement = case.link_placements()[frame.link] * oracles.se3(frame.X_BF)
    model.appendBodyToJoint(case.joints[frame.link].id, body(), placement)
    x = rows(5)
    assert close(torchdq.inverse_dynamics(held, *x), torques_of(model, case.robot, x))
    assert close(torchdq.inverse_dynamics(held.bake(), *x), torques_of(model, case.robot, x))
    assert close(torchdq.inverse_dynamics(case.robot, *x), torques_of(case.model, case.robot, x))


def test_a_payload_on_a_free_base_is_part_of_it():
    robot = on_free_base(random_tree(4, 3).robot)
    tipped = robot.replace(frames=(*robot.frames, Frame("hook", -1, pose())))
    held = tipped.with_payload(MASS, COM, INERTIA, frame="hook")
    whole = body(*FREE_BODY.values()) + oracles.se3(pose()).act(body())
    assert float(held.base_mass) == pytest.approx(whole.mass, rel=1e-14)
    assert torch.allclose(held.base_com, double(whole.lever), rtol=1e-13, atol=1e-15)
    assert torch.allclose(held.base_inertia, double(flat(whole.inertia)), rtol=1e-12)


def several(robot):
    """A robot and one that is twice as heavy."""
    return torchdq.Robot.stack([robot, robot.replace(mass=2 * robot.mass)])


def test_payloads_of_a_batch_and_their_gradients():
    robot = random_tree(4, 2).robot
    masses = double([0.5, 1.0, 2.0])
    together = robot.with_payload(masses, COM, INERTIA)
    assert together.mass.shape == (3, 4) and together.inertia.shape == (3, 4, 6)
    x = rows(4)
    found = torchdq.inverse_dynamics(together, *x)
    for i, mass in enumerate(masses):
        alone = robot.with_payload(mass, COM, INERTIA).bake()
        assert close(found[i], torchdq.inverse_dynamics(alone, *x[:, i]))

    def torques(own, mass, com, inertia):
        held = robot.replace(mass=own).with_payload(mass, com, inertia)
        return torchdq.inverse_dynamics(held, *x[:, 0])

    inputs = [robot.mass.clone(), double(MASS), double(COM), double(INERTIA)]
    assert torch.autograd.gradcheck(torques, [value.requires_grad_() for value in inputs], fast_mode=True)
    learned = double(COM).requires_grad_()
    assert robot.with_payload(MASS, learned).com.requires_grad and not robot.com.requires_grad


@all_in_one([("mass", ()), ("com", (3,)), ("inertia", (6,))])
def test_a_batch_of_payloads_that_does_not_fit_that_of_the_robot_is_refused_by_name(payload):
    name, axes = payload
    with refused(torchdq.ArgumentError):
        several(two()).with_payload(**{"mass": 1.0, name: torch.ones(3, *axes, dtype=F64)})


def test_another_payload_needs_no_new_program():
    q = torch.zeros(2, dtype=F64)
    torchdq.inverse_dynamics(two().with_payload(0.5), q)
    before = torchdq.functions.catalogue.recordings()
    torchdq.inverse_dynamics(two().with_payload(0.7, [0.0, 0.1, 0.0]), q)
    assert torchdq.functions.catalogue.recordings() == before


def test_a_tool_is_a_payload_and_a_new_tip():
    robot = torchdq.robots.load("panda")
    tool = robot.with_tool("gun", pose(1), MASS, COM, INERTIA)
    held = robot.with_payload(MASS, COM, INERTIA)
    assert tool.tip == "gun" and robot.tip == "tip" and torch.equal(tool.mass, held.mass)
    x = rows(7)
    assert torch.equal(torchdq.inverse_dynamics(tool, *x), torchdq.inverse_dynamics(held, *x))
    tips = torchdq.forward_kinematics(tool, x[0], ["tip", "gun"])
    assert torch.allclose(dq.mul(tips[:, 0], pose(1)), tips[:, 1], rtol=1e-13, atol=1e-13)
    light = robot.with_tool("pen", pose(1), frame="panda_link5")
    assert torch.equal(light.mass, robot.mass) and light.frame("pen").link == 4


MISUSE = {
    "on the fixed base": lambda robot: robot.with_payload(1.0, frame="base"),
    "no such frame": lambda robot: robot.with_payload(1.0, frame="hand"),
    "a negative mass": lambda robot: robot.with_payload(-1.0),
    "no body's inertia": lambda robot: robot.with_payload(1.0, inertia=[1.0, 0, 0, 0, 0, 0]),
    "two numbers": lambda robot: robot.with_payload(1.0, [0.0, 0.0]),
    "a word": lambda robot: robot.with_payload("heavy"),
    "a known name": lambda robot: robot.with_tool("tip", pose()),
    "no end effector": lambda robot: robot.with_tip(None).with_tool("pen", pose()),
    "no prefix": lambda robot: robot.attach(robot, "tip"),
    "no robot": lambda robot: robot.attach("two_link", "tip"),
}


@all_in_one(MISUSE)
def test_what_cannot_be_put_on_a_robot_is_refused(case):
    with refused((ArgumentError, UnknownNameError)):
        MISUSE[case](two())


@all_in_one(["panda", "two_link", "ur10e"])
def test_a_payload_in_other_units_is_named_once(name):
    robot = torchdq.robots.load(name)
    given = {"com": (0, 0, 100.0)}, {"com": (0, 0, 0.1), "inertia": (5e3, 0, 5e3, 0, 0, 5e3)}
    for wrong, hold in product(given, (robot.with_payload, partial(robot.with_tool, "pen", pose()))):
        with warned(UserWarning) as seen:
            hold(mass=1.0, **wrong)
        assert len(seen) == 1 and seen[0].filename == __file__
        assert str(seen[0].message).startswith(f"a payload of robot '{name}' may have numbers in other units:")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot.with_payload(1.0, (0, 0, 1.0), (1.0, 0, 1.0, 0, 0, 1.0))
        robot.with_payload(1.0, double((0, 0, 100.0)).requires_grad_())  # read by `check` alone, as in `replace`
        several(robot).with_payload(1.0, (0, 0, 100.0))


# --- robots on robots ------------------------------------------------------------------------------------------------


def renamed(model, prefix):
    model = pin.Model(model)
    for i in range(1, model.njoints):
        model.names[i] = prefix + model.names[i]
    for frame in model.frames:
        frame.name = prefix + frame.name
    return model


def joined(first, other, frame, placement):
    """Pinocchio's model of both, with the rotors and the gravity, which it forgets."""
    model = pin.appendModel(first, other, first.getFrameId(frame, pin.FrameType.BODY), placement)
    model.gravity = first.gravity
    armature = np.zeros(model.nv)
    for part in (first, other):
        for name in list(part.names)[1:]:
            own, its = (m.joints[m.getJointId(name)].idx_v for m in (part, model))
            armature[its] = part.armature[own]
    model.armature = armature
    return model


@pytest.mark.filterwarnings(NO_PALM)
@pytest.mark.parametrize("seeds", thinned([(2, 9), (4, 1)], [(2, 9)]))
@pytest.mark.parametrize("rotors", thinned([(False, False), (True, False), (False, True)], [(True, False)]))
def test_an_attached_robot_is_pinocchios_joined_model(seeds, rotors):
    first, other = (random_tree(4, seed, armature=has) for seed, has in zip(seeds, rotors, strict=True))
    robot = first.robot.attach(other.robot, "b2", prefix="o_", base_pose=pose(5))
    model = joined(first.model, renamed(other.model, "o_"), "b2", oracles.se3(pose(5)))
    x = rows(8)
    assert close(torchdq.inverse_dynamics(robot, *x), torques_of(model, robot, x))
    data = model.createData()
    X = torchdq.forward_kinematics(robot, x[0, 0])
    pin.framesForwardKinematics(model, data, oracles.Case(robot, model).configuration(x[0, 0].tolist()))
    for name, found in zip(robot.frame_names, X, strict=True):
        expected = data.oMf[model.getFrameId(name, pin.FrameType.BODY)].homogeneous
        assert np.allclose(dq.to_matrix(found), expected, rtol=0, atol=1e-13)
    assert robot.tip == "o_tip" and robot.joint_names == tuple(f"{p}j{i}" for p in ("", "o_") for i in range(4))
    parts = (torch.cat(pair) for pair in zip(first.robot.limits, other.robot.limits, strict=True))
    assert all(map(torch.equal, robot.limits, parts))


@pytest.mark.filterwarnings(NO_PALM)
def test_joint_maps_of_both_robots_are_kept():
    first, other = (random_tree(4, seed).robot for seed in (2, 9))
    plain = first.attach(other, "b3", prefix="o_")
    maps = {"j2": {"j0": -1.5}}, {"j3": {"j1": 0.5}}
    robot = first.couple(maps[0]).attach(other.couple(maps[1]), "b3", prefix="o_")
    expected = plain.couple({"j2": {"j0": -1.5}, "o_j3": {"o_j1": 0.5}})
    assert robot.joint_names == expected.joint_names and robot.every_joint == plain.joint_names
    assert torch.equal(robot.joint_map.S, expected.joint_map.S)
    x = rows(robot.n)
    assert torch.equal(torchdq.inverse_dynamics(robot, *x), torchdq.inverse_dynamics(expected, *x))


@pytest.mark.filterwarnings(NO_PALM)
@pytest.mark.parametrize("carrier", ["link", "floating base", "fixed base"])
def test_the_free_base_of_an_attached_robot_becomes_part_of_its_carrier(carrier):
    first, other = random_tree(3, 2).robot, on_free_base(random_tree(2, 9).robot)
    first = on_free_base(first) if carrier == "floating base" else first
    frame = "b1" if carrier == "link" else "base"
    robot = first.attach(other, frame, prefix="o_", base_pose=pose(5))
    without = other.replace(base_mass=None, base_com=None, base_inertia=None)
    expected = first.attach(without, frame, prefix="o_", base_pose=pose(5))
    if carrier != "fixed base":
        seat = Frame("seat", 1 if carrier == "link" else -1, robot.frame("o_base").X_BF)
        expected = expected.replace(frames=(*expected.frames, seat))
        expected = expected.with_payload(*FREE_BODY.values(), frame="seat")
    else:
        assert "the mass of its base is left out" in noted(robot, "robot.attached")[0]
    for name in ("mass", "com", "inertia", *FREE_BODY):
        ours, theirs = getattr(robot, name), getattr(expected, name)
        assert ours is theirs is None or torch.allclose(ours, theirs, rtol=1e-14), name


PALM = """<robot name="hand"><link name="palm"><inertial><mass value="0.4"/><origin xyz="0 0 0.05"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="finger"><inertial><mass value="0.1"/><origin xyz="0 0 0.02"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="prismatic"><parent link="palm"/><child link="finger"/><axis xyz="0 1 0"/>
<limit lower="0" upper="0.04" velocity="1" effort="1"/></joint></robot>"""


def test_a_palm_whose_mass_is_missing_is_warned_of():
    arm = torchdq.robots.load("panda")
    fixed, free = (torchdq.Robot.from_urdf(PALM, base=base) for base in ("fixed", "floating"))
    with warned(UserWarning) as seen:
        light = arm.attach(fixed, "tip", prefix="h_")
    assert len(seen) == 1 and seen[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = arm.attach(free, "tip", prefix="h_")
        arm.attach(fixed, "base", prefix="h_")  # nothing is lost on a fixed base
    assert float((whole.mass - light.mass).sum()) == pytest.approx(0.4, rel=1e-14)
    with warned(UserWarning):
        on_free_base(arm).attach(fixed, "base", prefix="h_")


def test_gradients_and_batches_of_attached_robots():
    first, other = random_tree(3, 2).robot, on_free_base(random_tree(2, 9).robot)
    x = rows(5)

    def torques(*masses):
        a, b = first.replace(mass=masses[0]), other.replace(mass=masses[1], base_mass=masses[2])
        return torchdq.inverse_dynamics(a.attach(b, "tip", prefix="o_"), *x[:, 0])

    values = [first.mass, other.mass, other.base_mass]
    assert torch.autograd.gradcheck(torques, [value.clone().requires_grad_() for value in values], fast_mode=True)
    scale = double([[1.0], [2.0], [0.5]])
    batch = first.attach(other.replace(mass=other.mass * scale), "tip", prefix="o_")
    assert batch.mass.shape == (3, 5)
    found = torchdq.inverse_dynamics(batch, *x)
    for i in range(3):
        alone = first.attach(other.replace(mass=other.mass * scale[i]).bake(), "tip", prefix="o_").bake()
        assert close(found[i], torchdq.inverse_dynamics(alone, *x[:, i]))


@pytest.mark.filterwarnings(NO_PALM)
def test_names_of_both_robots_differ():
    robot = two()
    twice = robot.attach(robot, "tip", prefix="a_")
    with refused(ArgumentError):
        twice.attach(robot, "tip", prefix="a_")
    led = robot.couple({"joint2": {"a_joint1": 1.0}})  # a coordinate that has the name of a joint of the other one
    with refused(ArgumentError):
        led.attach(robot.replace(joint_names=("joint1", "x")), "tip", prefix="a_")
    assert twice.attach(robot, "a_tip", prefix="b_").joint_names[-2:] == ("b_joint1", "b_joint2")


@pytest.mark.filterwarnings(NO_PALM)
def test_a_robot_on_a_tool_is_a_robot():
    arm, hand = torchdq.robots.load("panda"), two().with_tip(None)
    both = arm.with_payload(1.0).with_tool("t", pose()).attach(hand, "t", prefix="h_")
    assert both.tip == "t"
    assert noted(both, "robot.attached") == ["frame 't': 'two_link' attached, without a mass of its base"]
    assert both.to(torch.float32).attach(hand, "t", prefix="g_").mass.dtype == torch.float32
    assert both.lock({"h_*": 0.1}).n == 7
