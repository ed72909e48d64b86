"""Objects slide, roll, tip, collide and are held as analysis and conservation laws say; absent ones cost nothing."""

import math
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from helpers import PAIR, double, exhaustive, thinned
from messages import refused

import torchdq
from torchdq import Scene, TorchdqError, dq, effects
from torchdq.algebra.dual_quaternion import ONE
from torchdq.backends import c_library as build
from torchdq.objects import Ball, Box, Capsule, Cylinder, from_mjcf, from_urdf
from torchdq.robot import ContactPoint

F64 = torch.float64
BACKEND = "auto"
G = 9.81
MU, K = 0.5, 2e4
DOWN = effects.Gravity((0.0, 0.0, -G))
compiled = pytest.mark.skipif(build.compiler() is None, reason="thousands of steps need a C compiler")


@cache
def arm():
    """Two links in a vertical plane, away from the objects of most tests."""
    return torchdq.Robot.from_urdf(PAIR)


BELOW = 3.0  # depth of the base of the gripper, whose lift has positions with larger rounding than its hand [m]


@cache
def gripper():
    """Two fingers on a lift, each with a pad of four spheres; they close along x, about which the wrist turns them."""
    moments = 'ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"'
    link = '<link name="{}"><inertial><mass value="{}"/><inertia ' + moments + "/></inertial></link>"
    joint = (
        '<joint name="{1}_joint" type="{0}"><parent link="{2}"/><child link="{1}"/><origin xyz="{3}"/>'
        '<axis xyz="{4}"/><limit lower="-4" upper="4" effort="100" velocity="10"/></joint>'
    )
    masses = {"base": 1, "lift": 1, "wrist": 0.1, "left": 0.1, "right": 0.1}
    links = "".join(link.format(name, mass) for name, mass in masses.items())
    joints = joint.format("prismatic", "lift", "base", f"0 0 {-BELOW}", "0 0 1")
    joints += joint.format("revolute", "wrist", "lift", "0 0 0", "1 0 0")
    joints += joint.format("prismatic", "left", "wrist", "-0.03 0 0", "1 0 0")
    joints += joint.format("prismatic", "right", "wrist", "0.03 0 0", "-1 0 0")
    return torchdq.Robot.from_urdf(f'<robot name="gripper">{links}{joints}</robot>')


PADS = tuple(
    ContactPoint(finger, (0.0, y, z), 0.004)
    for finger in ("left", "right")
    for y in (-0.01, 0.01)
    for z in (-0.01, 0.01)
)
CUBE = 0.04  # edge of the cube that is held [m]
SQUEEZED = 5e-4  # how much further the fingers are told to close [m]


def held(dt=5e-3, mass=0.1, damping=2e3, **parameters):
    """Scene of a cube between two fingers on a lift with some damping."""
    given = {"friction": 1.0, "stiffness": 1e4, **parameters}
    servo = effects.Servo((1e5, 1e2, 2e4, 2e4), double(damping, 2.0, 3e2, 3e2))
    grip = effects.Contact(PADS, on="cube", **given)
    return Scene(gripper(), (DOWN, servo, grip), objects=(Box("cube", mass, size=(CUBE,) * 3),), dt=dt)


def grip(scene, *batch, dtype=F64):
    """State of a cube that was just taken, and the target that holds it."""
    closed = 0.03 - CUBE / 2 - 0.004
    q = torch.tensor([BELOW, 0.0, closed, closed], dtype=dtype).expand(*batch, 4)
    target = q + torch.tensor([0.0, 0.0, 1e-3, 1e-3])
    return scene.start(q, X_WO=at((0.0, 0.0, 0.0)).to(dtype).expand(*batch, 1, 8)), target


def alone(objects, *contacts, dt=5e-3, gravity=True):
    """Scene of objects that no robot touches."""
    return Scene(arm(), (*[DOWN] * gravity, *contacts), objects=objects, dt=dt)


def at(position, turn=(1.0, 0.0, 0.0, 0.0)):
    """Pose of an object, [1, 8]."""
    turn = torch.nn.functional.normalize(torch.as_tensor(turn, dtype=F64), dim=-1)
    return dq.from_pose(turn, torch.as_tensor(position, dtype=F64))[..., None, :]


def begin(scene, X_WO, V_WO=None):
    return scene.start(torch.zeros(*X_WO.shape[:-2], scene.n, dtype=F64), X_WO=X_WO, V_WO=V_WO)


def twist(*x):
    return torch.tensor(x, dtype=F64)[None]


def place(state):
    """Positions of the objects [..., objects, 3]."""
    return dq.translation(state.X_WO)


def momenta(state, bodies):
    """Linear and angular momentum in the world of bodies (mass, principal moments), about its origin."""
    linear, angular = 0.0, 0.0
    for k, (mass, moments) in enumerate(bodies):
        X, V = state.X_WO[..., k, :], state.V_WO[..., k, :]
        p = mass * dq.rotate(dq.rotation(X), V[..., 3:])
        spin = dq.rotate(dq.rotation(X), torch.tensor(moments, dtype=F64) * V[..., :3])
        linear, angular = linear + p, angular + torch.linalg.cross(dq.translation(X), p) + spin
    return linear, angular


def energy(state, body):
    """Kinetic energy of the only object."""
    w, v = state.V_WO[..., 0, :].split(3, -1)
    return 0.5 * (body.mass * v.square() + torch.tensor(body.posed(ONE).moments, dtype=F64) * w.square()).sum(-1)


# --- bodies ---------------------------------------------------------------------------------------------------------


SOLIDS = {  # with the geoms of MuJoCo
    Box("box", 2.0, size=(0.2, 0.3, 0.5)): 'type="box" size="0.1 0.15 0.25"',
    Ball("ball", 2.0, radius=0.2): 'type="sphere" size="0.2"',
    Capsule("capsule", 2.0, radius=0.1, length=0.3): 'type="capsule" size="0.1 0.15"',
    Cylinder("cylinder", 2.0, radius=0.1, length=0.3): 'type="cylinder" size="0.1 0.15"',
}


@pytest.mark.parametrize("body", SOLIDS, ids=lambda body: body.name)
def test_inertias_are_those_of_mujoco_unless_they_are_given(body):
    text = f'<mujoco><worldbody><body><freejoint/><geom mass="2" {SOLIDS[body]}/></body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    turn = torch.from_numpy(model.body_iquat[1]).abs().round(decimals=3)
    assert turn.tolist() == [1.0, 0.0, 0.0, 0.0]
    assert body.posed(ONE).moments == pytest.approx(model.body_inertia[1], rel=1e-12)
    assert replace(body, inertia=(1.0, 2.0, 3.0)).posed(ONE).moments == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("body", SOLIDS, ids=lambda body: body.name)
def test_the_mobility_of_an_object_is_the_mean_of_its_points_and_directions(body):
    found = []
    for p, _ in body.points():
        turning = torch.linalg.cross(torch.tensor(p, dtype=F64).expand(3, 3), torch.eye(3, dtype=F64), dim=-1)
        whole = (
            torch.eye(3, dtype=F64) / body.mass
            + turning @ torch.diag(1 / torch.tensor(body.posed(ONE).moments, dtype=F64)) @ turning.mT
        )
        found.append(float(whole.trace()) / 3.0)
    assert body.mobility == pytest.approx(sum(found) / len(found), rel=1e-12)


@compiled
def test_a_box_that_spins_keeps_the_size_of_its_momentum_and_never_gains_energy():
    box = Box("box", 0.5, size=(0.1, 0.2, 0.3))
    scene, g = alone((box,), gravity=False), torch.Generator().manual_seed(0)
    V = torch.cat([12.0 * torch.randn(16, 1, 3, dtype=F64, generator=g), torch.ones(16, 1, 3, dtype=F64)], -1)
    start = begin(scene, at((0.0, 0.0, 0.0)).expand(16, 1, 8), V)
    path = scene.rollout(start, steps=400)
    before, after = (momenta(x, [(0.5, box.posed(ONE).moments)])[1].norm(dim=-1) for x in (start, path))
    assert (after / before - 1.0).abs().max() < 1e-3
    assert (energy(path, box) / energy(start, box)).max() < 1.0 + 1e-9


# --- on the ground ---------------------------------------------------------------------------------------------------


@compiled
def test_a_box_slides_as_far_as_friction_lets_it():
    scene = alone((Box("box", 1.0, size=(0.2, 0.2, 0.1)),), effects.Contact(("box",), friction=MU, stiffness=K))
    speed, start = 2.0, at((0.0, 0.0, 0.05 - G / (4 * K)))
    path = scene.rollout(begin(scene, start, twist(0, 0, 0, speed, 0, 0)), steps=400)
    # friction acts from the end of the first step on: half a step less of the way
    way = speed**2 / (2 * MU * G)
    assert float(place(path)[-1, 0, 0]) == pytest.approx(way - scene.dt * speed / 2, abs=2e-3 * way)
    assert path.V_WO[-1].abs().max() < 1e-9


@compiled
@pytest.mark.parametrize("dt", thinned([1e-3, 1e-2], [1e-2]))
def test_a_ball_that_slid_rolls_with_five_sevenths_of_its_speed(dt):
    scene = alone((Ball("ball", 1.0, radius=0.1),), effects.Contact(("ball",), friction=MU, stiffness=K), dt=dt)
    path = scene.rollout(begin(scene, at((0.0, 0.0, 0.1 - G / K)), twist(0, 0, 0, 2.0, 0, 0)), steps=round(2 / dt))
    speed = (place(path)[-1] - place(path)[-2])[0, 0] / dt
    assert float(speed) / 2.0 == pytest.approx(5 / 7, abs=1e-9)


@compiled
def test_a_box_tips_over_its_edge_with_the_spin_that_energy_says():
    mass, a, b = 0.2, 0.02, 0.06
    scene = alone(
        (Box("box", mass, size=(2 * a, 0.04, 2 * b)),), effects.Contact(("box",), friction=2.0, stiffness=1e5), dt=1e-3
    )
    about_edge = mass * ((2 * a) ** 2 + (2 * b) ** 2) / 12 + mass * (a * a + b * b)
    critical = math.sqrt(2 * mass * G * (math.hypot(a, b) - b) / about_edge)
    spin = critical * torch.tensor([0.98, 1.02], dtype=F64)
    V = torch.zeros(2, 1, 6, dtype=F64)
    V[:, 0, 1], V[:, 0, 3], V[:, 0, 5] = spin, b * spin, a * spin
    path = scene.rollout(begin(scene, at((0.0, 0.0, b)).expand(2, 1, 8), V), steps=2500)
    assert (place(path)[-1, :, 0, 2] < 0.7 * b).tolist() == [False, True]


@compiled
@pytest.mark.parametrize(("dt", "stiffness"), thinned([(1e-3, 1e5), (5e-3, 8e4), (1e-2, 2e4)], [(1e-2, 2e4)]))
def test_tumbling_boxes_never_gain_energy(dt, stiffness):
    g = torch.Generator().manual_seed(0)
    k = torch.tensor(stiffness, dtype=F64)
    box = Box("box", 0.5, size=(0.1, 0.2, 0.3))
    scene = alone((box,), effects.Contact(("box",), friction=0.7, stiffness=k, dissipation=0.2), dt=dt)
    X = at(torch.rand(64, 3, dtype=F64, generator=g) * 0.3 + 0.2, torch.randn(64, 4, dtype=F64, generator=g))
    V = torch.randn(64, 1, 6, dtype=F64, generator=g) * torch.tensor([6.0] * 3 + [1.5] * 3, dtype=F64)
    start = begin(scene, X, V)
    path = scene.rollout(start, steps=round(1 / dt))
    before, after = (energy(x, box) + box.mass * G * place(x)[..., 0, 2] for x in (start, path))
    assert bool(path.finite().all())
    assert float(((after - before) / before).max()) < 1e-3
    assert float(place(path)[..., 2].min()) > 0.03  # nothing falls through


@compiled
@pytest.mark.parametrize("shape", [Capsule, Cylinder])
def test_round_shapes_lie_on_the_ground_at_their_radius(shape):
    scene = alone((shape("it", 0.3, radius=0.05, length=0.2),), effects.Contact(("it",), friction=MU, stiffness=1e4))
    lying = at((0.0, 0.0, 0.05), (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0))
    path = scene.rollout(begin(scene, lying), steps=200)
    assert float(place(path)[-1, 0, 2]) == pytest.approx(0.05, abs=0.3 * G / (2 * 1e4) + 1e-6)


# --- between bodies --------------------------------------------------------------------------------------------------


@compiled
@pytest.mark.parametrize("dt", thinned([1e-3, 5e-3], [5e-3]))
def test_a_collision_keeps_linear_and_angular_momentum(dt):
    ball, cube = Ball("ball", 1.0, radius=0.1), Box("cube", 0.5, size=(0.2, 0.2, 0.2))
    touching = effects.Contact(("ball",), on="cube", friction=MU, stiffness=K)
    scene = alone((ball, cube), touching, dt=dt, gravity=False)
    X = torch.cat([at((-0.3, 0.05, 0.06)), at((0.0, 0.0, 0.0), (0.9, 0.1, -0.2, 0.3))])
    V = torch.cat([twist(3.0, 1.0, 0.0, 1.0, 0.0, 0.0), twist(0.0, 1.0, 2.0, 0.0, 0.0, 0.0)])
    start = begin(scene, X, V)
    path = scene.rollout(start, steps=round(1 / dt))
    bodies = [(1.0, [0.4 * 0.1**2] * 3), (0.5, [0.5 * 0.2**2 / 6] * 3)]
    for before, after in zip(momenta(start, bodies), momenta(path, bodies), strict=True):
        assert (after - before).abs().max() < 1e-13
    assert float((momenta(path, bodies[:1])[0][-1] - momenta(start, bodies[:1])[0]).norm()) > 0.1  # they did collide


@compiled
def test_the_friction_of_an_impact_between_objects_keeps_to_the_cone():
    """In one step or in several, by the normal force that the mobilities of both foresee."""
    heavy = {"inertia": (1e3,) * 3}  # nothing turns
    ball, cube = Ball("ball", 1.0, radius=0.1, **heavy), Box("cube", 0.5, size=(0.2, 0.2, 0.2), **heavy)
    touching = effects.Contact(("ball",), on="cube", friction=0.1, stiffness=K * double(1.0, 10.0), dissipation=0.0)
    scene = alone((ball, cube), touching, dt=1e-2, gravity=False)
    X = torch.cat([at((-0.25, 0.0, 0.0)), at((0.0, 0.0, 0.0))]).expand(2, 2, 8)
    V = torch.cat([twist(0, 0, 0, 3, 2, 0), twist(*[0.0] * 6)]).to(F64).expand(2, 2, 6)
    normal, along, _ = scene.rollout(begin(scene, X, V), steps=10).last.V_WO[:, 1].mul(0.5)[:, 3:].unbind(-1)
    assert normal.min() > 0.9
    assert ((0.085 * normal < along) & (along <= 0.1 * normal)).all()


@compiled
def test_the_order_of_objects_does_not_matter():
    ball, cube = Ball("ball", 1.0, radius=0.1), Box("cube", 0.5, size=(0.2, 0.2, 0.2))
    touching = effects.Contact(("ball",), on="cube", friction=MU, stiffness=K)
    X = torch.cat([at((-0.25, 0.05, 0.06)), at((0.0, 0.0, 0.0), (0.9, 0.1, -0.2, 0.3))])
    V = torch.cat([twist(3.0, 1.0, 0.0, 1.0, 0.0, 0.0), twist(0.0, 1.0, 2.0, 0.0, 0.0, 0.0)])
    ends = []
    for order in ([0, 1], [1, 0]):
        scene = alone(tuple((ball, cube)[k] for k in order), touching, gravity=False)
        ends.append(scene.rollout(begin(scene, X[order], V[order]), steps=100).X_WO[-1][order])
    assert (ends[0] - ends[1]).abs().max() < 1e-12


@compiled
def test_turning_the_world_turns_the_result():
    turn = torch.nn.functional.normalize(torch.tensor([0.6, -0.3, 0.5, 0.2], dtype=F64), dim=0)
    ball, cube = Ball("ball", 1.0, radius=0.1), Box("cube", 0.5, size=(0.2, 0.2, 0.2))
    touching = effects.Contact(("ball",), on="cube", friction=MU, stiffness=K)
    scene = Scene(arm(), (effects.Gravity(torch.zeros(3, dtype=F64)), touching), objects=(ball, cube), dt=5e-3)
    X = torch.cat([at((-0.25, 0.05, 0.06)), at((0.0, 0.0, 0.0), (0.9, 0.1, -0.2, 0.3))])
    V = torch.cat([twist(3.0, 1.0, 0.0, 1.0, 0.0, 0.0), twist(0.0, 1.0, 2.0, 0.0, 0.0, 0.0)])
    by = dq.from_pose(turn, torch.tensor([0.3, 0.1, -0.2], dtype=F64))
    g = torch.tensor([0.5, 0.2, -1.0], dtype=F64)
    ends = []
    for X_0, gravity in ((X, g), (dq.mul(by, X), dq.rotate(turn, g))):
        turned = scene.replace(effects=(effects.Gravity(gravity), touching))
        ends.append(turned.rollout(begin(turned, X_0, V), steps=100).X_WO[-1])
    assert (dq.mul(by, ends[0]) - ends[1]).abs().max() < 1e-11


@compiled
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_cube_that_is_held_does_not_creep(dtype):
    scene = held()
    start, target = grip(scene, dtype=dtype)
    path = scene.rollout(start, target=target.to(dtype).expand(1200, 4))
    heights = place(path)[:, 0].double()
    assert float((heights[-1] - heights[400]).abs().max()) < (5e-8 if dtype == torch.float64 else 5e-7)
    assert bool(scene.grasped(path.last, "cube"))
    if dtype == F64:
        weight = scene.contacts(path.last, "cube").force.sum(-2)  # on the robot
        assert weight.tolist() == pytest.approx([0.0, 0.0, -0.1 * G], abs=1e-9)


@compiled
def test_a_cube_follows_a_hand_whose_steps_are_lost_in_rounding():
    """Bristles must not be bent by velocities that move neither of the bodies."""
    scene = held(damping=1e6)
    start, target = grip(scene, dtype=torch.float32)
    path = scene.rollout(start, target=target.to(torch.float32).expand(1200, 4))
    rates = (path.qd[400:, 0] * scene.dt).abs()
    assert 0.1 < float(rates.mean()) / (math.ulp(BELOW) * 2**29) < 0.5
    assert (place(path)[-1] - place(path)[400]).abs().max() < 1e-6


@compiled
def test_a_cube_slips_where_its_weight_exceeds_the_friction_of_the_grip():
    ratios = torch.tensor([0.97, 0.99, 1.01, 1.03], dtype=F64)  # of the weight to the friction of all pads
    scene = held(friction=torch.ones(4, dtype=F64))
    start, target = grip(scene, 4)
    target = target.expand(200, 4, 4)
    start = scene.rollout(start, target=target).last
    force = scene.contacts(start, "cube").normal_force.sum(-1)
    scene = held(friction=0.1 * G / (ratios * force))
    path = scene.rollout(start, target=target)
    fallen = place(start)[:, 0, 2] - place(path)[-1, :, 0, 2]
    assert (fallen > 1e-3).tolist() == [False, False, True, True]
    assert fallen[:2].abs().max() < 1e-5


@compiled
def test_a_cube_turns_with_the_hand_that_holds_it():
    """Bristles turn with the object: in axes of the world they would wind up, and let go."""
    scene = held()
    start, target = grip(scene)
    start = scene.rollout(start, target=target.expand(100, 4)).last
    steps = torch.arange(400, dtype=F64).clamp(max=300)[:, None]
    end = scene.rollout(start, target=target + steps * double(2e-4, 5e-3, 0.0, 0.0)).last
    assert float((end.q - start.q)[1]) == pytest.approx(1.5, abs=1e-3)
    held_at = [dq.mul(dq.conj(torchdq.forward_kinematics(scene.robot, x.q, "wrist")), x.X_WO[0]) for x in (start, end)]
    assert dq.translation(held_at[1] - held_at[0]).abs().max() < 2 * 0.1 * G / (8 * 1e4)  # what its weight bends
    assert (dq.rotation(held_at[1]) - dq.rotation(held_at[0])).abs().max() < 1e-4


@compiled
def test_rounded_cubes_stand_on_each_other_and_sharp_ones_are_refused():
    cubes = tuple(Box(name, 0.1, size=(CUBE,) * 3, rounding=0.006) for name in ("lower", "upper"))
    contacts = effects.Contact(("lower",), stiffness=1e4), effects.Contact(("upper",), on="lower", stiffness=1e4)
    scene = alone(cubes, *contacts)
    X = torch.cat([at((0.0, 0.0, 0.02)), at((0.004, 0.003, 0.06))])
    path = scene.rollout(begin(scene, X), steps=800)
    assert (place(path)[-1] - place(path)[400]).abs().max() < 1e-8
    assert float(place(path)[-1, 1, 2]) == pytest.approx(0.06, abs=1e-3)
    sharp = tuple(Box(name, 0.1, size=(CUBE,) * 3) for name in ("lower", "upper"))
    with refused(TorchdqError):
        alone(sharp, contacts[1])


# --- gradients -------------------------------------------------------------------------------------------------------


@compiled
def test_gradients_through_a_grasp_are_those_of_differences():
    scene = held(mass=torch.tensor(0.1, dtype=F64))
    start, target = grip(scene)
    start = scene.rollout(start, target=target.expand(40, 4)).last
    g = torch.Generator().manual_seed(0)

    def height(mass, moved):
        lifted = scene.with_parameters({"-4.mass": mass})
        return (lifted.rollout(start, target=(target + moved).expand(20, 4)).X_WO[-1] ** 2).sum()

    x = (torch.tensor(0.1, dtype=F64, requires_grad=True), torch.full((4,), 1e-3, dtype=F64, requires_grad=True))
    found = torch.autograd.grad(height(*x), x)
    ways = [torch.randn(a.shape, dtype=F64, generator=g) for a in x]
    step = 1e-5
    with torch.no_grad():
        up, down = (height(*[a + s * step * w for a, w in zip(x, ways, strict=True)]) for s in (1.0, -1.0))
    expected = float(up - down) / (2 * step)
    assert float(sum((a * w).sum() for a, w in zip(found, ways, strict=True))) == pytest.approx(expected, rel=1e-5)


# --- the scene -------------------------------------------------------------------------------------------------------


def test_a_scene_without_objects_has_none_in_its_state_and_records_what_it_did():
    scene = Scene(arm(), (DOWN,))
    state = scene.start(torch.zeros(3, 2, dtype=F64))
    assert state.X_WO is None and state.V_WO is None
    assert "poses" not in scene.spec.state


@pytest.mark.parametrize("touched", [False, True])
def test_an_arm_beside_an_object_that_it_does_not_reach_moves_as_alone(touched):
    point = effects.Contact((ContactPoint("b", radius=0.02),), on="far", friction=MU, stiffness=K)
    far = (Box("far", 1.0, size=(0.1, 0.1, 0.1)),)
    beside = Scene(arm(), (DOWN, *[point] * touched), objects=far)
    single = Scene(arm(), (DOWN,))
    q = torch.tensor([0.3, -0.2], dtype=F64)
    ends = [begin(beside, at((50.0, 0.0, 0.0)))._replace(q=q), single.start(q)]
    for _ in range(5):
        ends = [s.step(x) for s, x in zip((beside, single), ends, strict=True)]
    assert (ends[0].q - ends[1].q).abs().max() < 1e-13


def test_samples_may_have_masses_sizes_and_friction_of_their_own():
    sizes = torch.tensor([[0.2, 0.2, 0.1], [0.1, 0.1, 0.3]], dtype=F64)
    masses, spin = double(1.0, 2.0), (0.1, 0.2, 0.3, 1.0, 0.0, -0.5)
    scene = alone((Box("box", masses, size=sizes),), effects.Contact(("box",), friction=double(0.8, 0.1), stiffness=K))
    after = scene.step(begin(scene, at((0.0, 0.0, 0.1)).expand(2, 1, 8), twist(*spin).expand(2, 1, 6)))
    one = alone((Box("box", 2.0, size=tuple(sizes[1].tolist())),), effects.Contact(("box",), friction=0.1, stiffness=K))
    wanted = one.step(begin(one, at((0.0, 0.0, 0.1)), twist(*spin)))
    assert (after.poses[1] - wanted.poses).abs().max() < 1e-14
    assert (after.twists[1] - wanted.twists).abs().max() < 1e-13
    assert (after.twists[1] - after.twists[0]).abs().max() > 1e-3


def test_contacts_follow_an_object_that_is_replaced():
    scene = alone((Ball("it", 1.0, radius=0.1),), effects.Contact(("it",)))
    boxed = scene.replace(objects=(Box("it", 1.0, size=(0.1, 0.1, 0.1)),))
    assert (len(scene.touching), len(boxed.touching)) == (1, 8)
    assert boxed.replace(dt=0.001).touching == boxed.touching


def test_a_stiffness_that_is_not_given_is_1e5_times_the_mass_of_the_lightest_object():
    """A point at rest, as deep as d, is pushed by k d."""
    depth, touching = 1e-3, (effects.Contact(("it",), stiction=False), effects.Contact("it", on="far"))

    def force(scene, X_WO):
        return scene.contacts(begin(scene, X_WO), "ground").normal_force[..., 0]

    def with_masses(it, far):
        return alone((Ball("it", it, radius=0.1), Ball("far", far, radius=0.1)), *touching)

    X_WO = torch.cat([at((0.0, 0.0, 0.1 - depth)), at((0.0, 0.0, 0.3))], -2)
    scene = with_masses(0.5, 2.0)
    assert force(scene, X_WO) == pytest.approx(1e5 * 0.5 * depth)
    assert force(scene.replace(objects=with_masses(3.0, 2.0).objects), X_WO) == pytest.approx(1e5 * 3.0 * depth)
    mass = double(0.5, 3.0).requires_grad_()
    found = force(with_masses(mass, 2.0), X_WO.expand(2, 2, 8))
    assert found.tolist() == pytest.approx([1e5 * x * depth for x in (0.5, 3.0)])
    assert torch.autograd.grad(found.sum(), mass)[0].tolist() == pytest.approx([1e5 * depth] * 2)
    apart = torch.cat([at((0.0, 0.0, 0.1)), at((0.0, 0.0, 0.3 - depth))], -2).expand(2, 2, 8)
    scene = alone(with_masses(mass, 2.0).objects, effects.Contact("it", on="far", stiction=False))
    between = scene.contacts(begin(scene, apart)).normal_force[:, 0]
    assert between.tolist() == pytest.approx([1e5 * x * depth for x in (0.5, 2.0)])


@compiled
@pytest.mark.parametrize("dt", [5e-3, 1e-3])
def test_a_cube_stays_where_it_is_held_in_a_hand_that_turns_fast(dt):
    """Its hand moves on an arc, and a step along its tangent: friction remembers displacements, not velocities."""
    robot = torchdq.robots.load("panda_hand")
    servo = effects.Servo(1e3, 1e2, limit=robot.limits.effort.tolist())
    parts = (effects.RotorInertia(), effects.Viscous(), servo, effects.Contact("*_finger", on="cube", friction=1.0))
    scene = Scene(robot, parts, objects=(Box("cube", 0.1, size=(0.04,) * 3),), dt=dt)
    q = torch.tensor([0.0, 0.1, 0.0, -2.57, 0.0, 2.68, 0.785, 0.0185], dtype=F64)
    X_WT = torchdq.forward_kinematics(robot, q, "tcp")
    target = torch.cat([q[:7], torch.zeros(1, dtype=F64)])
    state = scene.rollout(scene.start(q, X_WO=X_WT[None]), target=target.expand(round(0.5 / dt), 8)).last
    turned = target.expand(round(2.0 / dt), 8).clone()
    turned[:, 0] = 1.5 * (torch.arange(len(turned), dtype=F64) * dt / 1.0).clamp(max=1.0)
    path = scene.rollout(state, target=turned)
    places = [
        dq.translation(dq.mul(dq.conj(torchdq.forward_kinematics(robot, x.q, "tcp")), x.X_WO[..., 0, :]))
        for x in (state, path.last)
    ]
    assert float(path.qd[:, 0].max()) > 1.0
    assert float((places[1] - places[0]).norm()) < 1e-4


def test_energy_is_that_of_all_bodies():
    scene = alone((Ball("ball", 2.0, radius=0.1),))
    state = begin(scene, at((0.0, 0.0, 3.0)), twist(0.0, 5.0, 0.0, 1.0, 2.0, 0.0))
    bare = Scene(arm(), (DOWN,))
    own = bare.energy(bare.start(torch.zeros(2, dtype=F64)))
    kinetic, potential = (scene.energy(state) - own).tolist()
    assert kinetic == pytest.approx(0.5 * 2.0 * 5.0 + 0.5 * 0.4 * 2.0 * 0.01 * 25.0)
    assert potential == pytest.approx(2.0 * G * 3.0)


def test_contacts_are_read_by_the_pair():
    scene = held()
    state, _ = grip(scene)
    assert scene.touching == [("left", "cube")] * 4 + [("right", "cube")] * 4
    assert scene.contacts(state, "left").force.shape == (4, 3)
    assert scene.contacts(state, "cube").force.shape == (8, 3)
    assert not bool(scene.grasped(state, "cube"))


def test_a_description_prices_objects_and_names_the_pairs():
    text = str(held().describe(seconds=0))
    assert "Box cube" in text
    assert "left on cube (4), right on cube (4)" in text


# --- objects of files ------------------------------------------------------------------------------------------------

ARM = (
    """<body name="arm" pos="0 0 0.5"><joint name="elbow" axis="0 1 0"/><geom type="capsule" size="0.03 0.2"/></body>"""
)
FREE = """
<body name="cube" pos="0.4 0.1 0.02" euler="0 0 30"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>
<body name="brick"><freejoint/><geom type="box" size="0.02 0.03 0.05" pos="0.1 0 0"/>
<geom type="sphere" size="0.3" contype="0" conaffinity="0" mass="0"/></body>
<body name="ball"><freejoint/><geom size="0.03" density="300"/></body>
<body name="pill"><freejoint/><geom type="capsule" size="0.02 0.04" euler="0 90 0" pos="0 0 0.2"/></body>
<body name="can"><freejoint/><geom type="cylinder" size="0.03 0.05" mass="0.35"/></body>
<body name="hollow"><freejoint/><inertial pos="0 0 0" mass="0.2" diaginertia="3e-4 3e-4 2e-4"/>
<geom type="cylinder" size="0.03 0.05"/></body>
"""
TABLE = f"<mujoco><worldbody>{ARM}{FREE}</worldbody></mujoco>"


def test_objects_of_a_file_have_the_masses_and_inertias_that_mujoco_computes():
    model, found = mujoco.MjModel.from_xml_string(TABLE), from_mjcf(TABLE)
    kinds = {"cube": Box, "brick": Box, "ball": Ball, "pill": Capsule, "can": Cylinder, "hollow": Cylinder}
    assert {one.name: type(one) for one in found} == kinds
    for one in found:
        body = model.body(one.name)
        moments = one.inertia or [one.mass * x for x in one.radii()]
        assert math.isclose(one.mass, body.mass.item(), rel_tol=1e-12)
        assert np.allclose(sorted(moments), sorted(body.inertia), rtol=1e-10)
        assert (one.inertia is None) == (one.name != "hollow")
    assert from_mjcf(TABLE, bodies=["c*"])[1] == Cylinder("can", 0.35, radius=0.03, length=0.1)
    assert found[1].size == (0.04, 0.06, 0.1)


def test_an_arm_and_the_objects_beside_it_are_read_from_one_file():
    robot = torchdq.Robot.from_mjcf(TABLE, base="fixed")
    alone = torchdq.Robot.from_mjcf(f"<mujoco><worldbody>{ARM}</worldbody></mujoco>")
    q = torch.tensor([0.3], dtype=F64)
    assert torch.equal(torchdq.inverse_dynamics(robot, q), torchdq.inverse_dynamics(alone, q))
    scene = Scene(robot, (DOWN, effects.Contact("cube")), objects=from_mjcf(TABLE, "cube"), dt=5e-3)
    start = scene.start(q, X_WO=torchdq.forward_kinematics(robot, q, "cube")[None])
    assert torch.allclose(place(start), torch.tensor([[0.4, 0.1, 0.02]], dtype=F64))
    assert scene.contacts(start).depth.max().abs() < 1e-12  # it stands on the ground


LYING = """<collision><origin xyz="0.1 0 0" rpy="0 1.5707963267948966 0"/>
<geometry><box size="0.06 0.02 0.08"/></geometry></collision>"""


def urdf(com="0.1 0 0", ixx="2e-4", ixy="0", shape=LYING, more=""):
    body = f'<inertial><origin xyz="{com}"/><mass value="0.6"/><inertia ixx="{ixx}" iyy="5e-4" izz="3.4e-4" '
    body += f'ixy="{ixy}" ixz="0" iyz="0"/></inertial>'
    return f'<robot name="block"><link name="base">{body}{shape}</link>{more}</robot>'


STAND = """<link name="stand"/><joint name="j" type="fixed"><origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>
<parent link="stand"/><child link="base"/></joint>"""


def test_an_object_of_a_urdf_file_has_the_axes_of_its_shape():
    """The file prints 0.6 (0.02^2 + 0.08^2) / 12 and the like, in axes that are turned by a quarter."""
    assert from_urdf(urdf()) == Box("block", 0.6, size=(0.06, 0.02, 0.08))
    assert from_urdf(urdf(more=STAND)) == from_urdf(urdf())
    heavier = from_urdf(urdf(ixx="2.1e-4"))
    assert heavier.inertia == pytest.approx((3.4e-4, 5e-4, 2.1e-4))


FREED = "<mujoco><worldbody><body name='x'><freejoint/>{}</body></worldbody></mujoco>"
GEOM = "<geom type='box' size='0.1 0.1 0.1' pos='{}'/>"
HINGED = '<link name="b"/><joint name="j" type="revolute"><parent link="base"/><child link="b"/></joint>'
NO_OBJECT = {
    "two geoms": lambda: from_mjcf(FREED.format(GEOM.format("0 0 0") + GEOM.format("0.1 0 0"))),
    "an ellipsoid": lambda: from_mjcf(FREED.format("<geom type='ellipsoid' size='0.1 0.2 0.3'/>")),
    "nothing that touches": lambda: from_mjcf(FREED.format("<geom size='1' contype='0' conaffinity='0'/>")),
    "a body on it": lambda: from_mjcf(FREED.format(GEOM.format("0 0 0") + "<body name='lid'><geom size='1'/></body>")),
    "nothing free": lambda: from_mjcf(f"<mujoco><worldbody>{ARM}</worldbody></mujoco>"),
    "an unknown body": lambda: from_mjcf(TABLE, bodies="arm"),
    "a mesh": lambda: from_urdf(urdf(shape='<collision><geometry><mesh filename="a.obj"/></geometry></collision>')),
    "a centre of mass elsewhere": lambda: from_urdf(urdf(com="0.11 0 0")),
    "other principal axes": lambda: from_urdf(urdf(ixy="5e-5")),
    "no inertia": lambda: from_urdf(urdf(ixx="0").replace("5e-4", "0").replace("3.4e-4", "0")),
    "a joint": lambda: from_urdf(urdf(more=HINGED)),
    "a fault of the file": lambda: from_urdf("<robot/>"),
}


@pytest.mark.parametrize("what", NO_OBJECT)
def test_bodies_that_are_no_objects_are_refused_with_the_reason(what):
    with refused(torchdq.TorchdqError):
        NO_OBJECT[what]()


WRONG = {
    "an object that is none": lambda: alone((1.0,)),
    "an object, not a sequence": lambda: Scene(arm(), objects=Ball("ball", 1.0, radius=0.1)),
    "two of one name": lambda: alone((Ball("ball", 1.0, radius=0.1), Ball("ball", 1.0, radius=0.2))),
    "a name of a frame": lambda: alone((Ball("a", 1.0, radius=0.1),)),
    "no name": lambda: alone((Ball("", 1.0, radius=0.1),)),
    "no mass": lambda: alone((Ball("ball", 0.0, radius=0.1),)),
    "a negative size": lambda: alone((Box("box", 1.0, size=(0.1, -0.1, 0.1)),)),
    "a contact on an unknown object": lambda: alone((Ball("ball", 1.0, radius=0.1),), effects.Contact(on="cube")),
    "points of an unknown object": lambda: alone((Ball("ball", 1.0, radius=0.1),), effects.Contact("can")),
    "points of an object without objects": lambda: alone((), effects.Contact("can")),
    "a contact on an object without objects": lambda: alone((), effects.Contact(on="can")),
    "a contact on no object": lambda: alone((Ball("ball", 1.0, radius=0.1),), effects.Contact(on=())),
    "a contact of an object with itself": lambda: alone(
        (Ball("ball", 1.0, radius=0.1),), effects.Contact("ball", on="ball")
    ),
    "a size of two numbers": lambda: alone((Box("box", 1.0, size=(0.1, 0.1)),)),
    "a size that is one number": lambda: alone((Box("box", 1.0, size=0.1),)),
    "a size that is a text": lambda: alone((Box("box", 1.0, size="large"),)),
    "no radius": lambda: alone((Ball("ball", 1.0, radius=None),)),
    "two radii": lambda: alone((Ball("ball", 1.0, radius=(0.1, 0.1)),)),
    "an inertia against the triangle inequality": lambda: alone((inert(1.0, 1.0, 3.0),)),
    "such an inertia of one row": lambda: alone((inert(double(1.0, 1.0, 1.0), double(1.0, 1.0, 3.0)),)),
    "an inertia that is not positive": lambda: alone((inert(1.0, 1.0, -0.5),)),
    "an inertia that is a matrix": lambda: alone((inert(*torch.eye(3, dtype=F64)),)),
    "a rounding beyond the middle": lambda: alone((Box("box", 1.0, size=(0.1, 0.1, 0.1), rounding=0.06),)),
    "poses without an axis of objects": lambda: begin_wrong(at((0.0, 0.0, 0.0))[0]),
    "poses of another dtype": lambda: begin_wrong(at((0.0, 0.0, 0.0)).float()),
    "poses of another batch": lambda: begin_wrong(at((0.0, 0.0, 0.0)).expand(3, 1, 8), batch=2),
    "twists of another dtype": lambda: begin_wrong(None, V_WO=torch.zeros(1, 6)),
    "twists of another batch": lambda: begin_wrong(None, V_WO=torch.zeros(3, 1, 6, dtype=F64), batch=2),
    "poses that are not unit": lambda: begin_wrong(2.0 * at((0.0, 0.0, 0.0))),
    "poses without objects": lambda: Scene(arm()).start(torch.zeros(2, dtype=F64), X_WO=at((0.0, 0.0, 0.0))),
    "contacts of an unknown name": lambda: held().contacts(grip(held())[0], "ball"),
    "a grasp of what nothing touches": lambda: alone((Ball("b2", 1.0, radius=0.1),)).grasped(None, "b2"),
}


def inert(*rows):
    """Ball with an inertia of its own."""
    inertia = torch.stack(rows) if isinstance(rows[0], torch.Tensor) else rows
    return Ball("ball", 1.0, radius=0.1, inertia=inertia)


def begin_wrong(X_WO, V_WO=None, batch=1):
    scene = alone((Ball("ball", 1.0, radius=0.1),))
    return scene.start(torch.zeros(batch, 2, dtype=F64), X_WO=X_WO, V_WO=V_WO)


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_refused_with_its_name(what):
    with refused(TorchdqError):
        WRONG[what]()


@compiled
@exhaustive
def test_five_rounded_cubes_stand():
    cubes = tuple(Box(f"cube{i}", 0.1, size=(CUBE,) * 3, rounding=0.006) for i in range(5))
    contacts = [effects.Contact(("cube0",), stiffness=1e4)]
    contacts += [effects.Contact((f"cube{i + 1}",), on=f"cube{i}", stiffness=1e4) for i in range(4)]
    scene = alone(cubes, *contacts)
    X = torch.cat([at((0.004 * (i % 2), 0.003 * (i % 2), 0.02 + 0.04 * i)) for i in range(5)])
    path = scene.rollout(begin(scene, X), steps=2000)
    assert (place(path)[-1, :, 2] > torch.tensor([0.019 + 0.039 * i for i in range(5)])).all()
