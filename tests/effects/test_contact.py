"""Contact: a step solves its law, and bodies slide, roll, stick, bounce and stand as analysis and MuJoCo say."""

import math
import re

import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import thinned
from messages import refused
from on_ground import F64, FEET, STAND, G, at, ball, begin, box, go2, path, place, rolled, tilted
from oracles import random_tree, shipped, states, urdf_paths
from small_envs import stool

import torchdq
from torchdq import Scene, effects
from torchdq.backends import c_library as build
from torchdq.robot import ContactPoint
from torchdq.scene import State, recording
from torchdq.scene.integrators import RungeKutta4

pytestmark = pytest.mark.skipif(build.compiler() is None, reason="thousands of steps need a C compiler")
MU = 0.5
STEPS = pytest.mark.parametrize("dt", thinned([1e-3, 5e-3, 1e-2], [5e-3, 1e-2]))


def double(*x):
    return torch.tensor(x if len(x) > 1 else x[0], dtype=F64)


def ground(robot_and_points, dt, stiction=True, **parameters):
    """Scene of a body on the ground under gravity; parameters as tensors, so that all values share a program."""
    robot, points = robot_and_points
    usual = {"normal": (0.0, 0.0, 1.0), "stiffness": 2e4, "dissipation": 1.0, "friction": MU}
    given = {name: torch.as_tensor(x, dtype=F64) for name, x in {**usual, **parameters}.items()}
    return Scene(robot, (effects.Gravity(), effects.Contact(points, stiction=stiction, **given)), dt=dt)


# --- a step ----------------------------------------------------------------------------------------------------------


def pressing(memory, n, depth, u, h, law):
    """Normal force on a point without its effect on the velocity, its impedance, compression and that velocity."""
    k, c, d, v = law[0], law[1], min(depth, memory[3]), n @ u - h * memory[6]
    Z_n = k * (h + c * max(d, 0.0))
    f_n = k * d - Z_n * v
    if f_n < 0 < d:
        f_n = k * d * d * max(1 - c * v, 0.0) / (2 * h * v)
        Z_n = f_n / v
    elif d < 0 < f_n:
        Z_n = f_n / -v
    return f_n, Z_n, d, v


def touched(memory, n, depth, u, h, law, W, Z_others):
    """Force on a point, its impedance C and its memory at the end, a function of the velocity there; in numpy."""
    *z, _, pressed, last, _, left = memory
    k, mu, T = law[0], law[2], max(law[3], h / 2)
    tangent, along, z = np.eye(3) - np.outer(n, n), n @ u, np.array(z)
    f_n, Z_n, d, v = pressing(memory, n, depth, u, h, law)
    Z_t, active, was = k * (h + T), f_n > 0, pressed > k * 1e-6
    y = k * z + Z_t * tangent @ u
    size = math.sqrt(y @ y + 1e-12)
    lift = max(n @ W @ n - mu * n @ W @ y / size, 0.0)
    foreseen = f_n / (1 + h * lift * (Z_n + (0.0 if was else Z_others)))
    cone = mu * foreseen
    limit = active * max(cone + left * abs(left) / (abs(left) + 0.03 * cone + 1e-6), 0.0)
    ahead = np.clip(2 * size - last, size, 2 * size) if was else size
    if active:
        more = max(foreseen - pressed, 0.0) * (1 + Z_others / Z_n)
        ahead += h * Z_t * more * np.linalg.norm(tangent @ W @ n)
    s = min(1.0, limit / ahead)

    def after(end):
        bent = s * (z + (h + T) * tangent @ end)
        f = max(f_n - Z_n * (n @ end - v), 0.0)
        rest = left + mu * f - k * math.sqrt(bent @ bent + 1e-24) if limit < ahead else 0.0
        deepest = math.sqrt(max(max(d, 0.0) ** 2 - 2 * h * (n @ end) * f / k, 0.0) + (0.1 * h) ** 2)
        kept = [deepest, f, size, n @ W @ (f * n - k * bent) - (n @ end - along) / h, rest]
        return [*((bent + T / h * z) / (1 + T / h)), *(kept if active else [0.0] * 5)]

    return active * (f_n + Z_n * (v - along)) * n - s * y, active * Z_n * np.outer(n, n) + s * Z_t * tangent, after


@pytest.mark.parametrize("by", ["entries", "articulated bodies"])
@pytest.mark.parametrize("n", thinned([2, 4, 9], [9]))
def test_a_step_solves_the_law_with_the_mobilities_of_its_points(n, by, monkeypatch):
    """(M + h J^T C J) (v' - v) = h (tau - nle + J^T f), with Pinocchio's matrices of a random tree of all joints."""
    linear = by == "articulated bodies"
    monkeypatch.setattr(recording, "alternatives_to_record", lambda n, both: (linear,))
    case, h, law = random_tree(n, seed=3), 0.01, (300.0, 0.7, 0.6 + 0.1 * linear, 0.02)  # each a program of its own
    robot, rng = case.robot, np.random.default_rng(n)
    frames = [robot.link_names[0], robot.link_names[-1], robot.end_effector().name]
    points = tuple(ContactPoint(name, tuple(rng.normal(size=3) * 0.2), 0.05) for name in frames)
    normal = np.array([0.48, -0.6, 0.64])
    q, qd, tau, memory = _pressed_states(case, points, normal, law[0], rng)
    contact = effects.Contact(points, 0.1, tuple(normal), None, *law[:3], settling=law[3])
    scene = Scene(robot, (effects.Gravity(), contact), dt=h, backend="eager")
    mobilities = [m * np.eye(3) if isinstance(m := p.mobility, float) else m for p in scene.effects[1].points]
    links = [robot.frame(name).link for name in frames]
    found = scene.step(State(*(torch.from_numpy(x) for x in (q, qd, memory))), torch.from_numpy(tau))
    kinds = set()
    for i in range(len(q)):
        data = case.model.createData()
        at_q, v = case.configuration(double(q[i].tolist())), case.velocity(qd[i])
        M = pin.crba(case.model, data, at_q)
        M = np.triu(M) + np.triu(M, 1).T
        force = case.velocity(tau[i]) - pin.nle(case.model, data, at_q, v)
        pin.forwardKinematics(case.model, data, at_q)
        pin.updateFramePlacements(case.model, data)
        rows, places = [], []
        for point in points:
            placement = data.oMf[f := case.frame_id(point.frame)]
            center = placement.act(np.array(point.center))
            J = pin.computeFrameJacobian(case.model, data, at_q, f, pin.LOCAL_WORLD_ALIGNED)
            arm = center - point.radius * normal - placement.translation
            J = J[:3] - pin.skew(arm) @ J[3:]
            places.append((J, placement.rotation, 0.1 + point.radius - normal @ center))
        of_points = memory[i].reshape(-1, 8)
        found_now = [
            pressing(own, normal, depth, J @ v, h, law) for own, (J, _, depth) in zip(of_points, places, strict=True)
        ]
        for k, (J, R, depth) in enumerate(places):
            others = [x for x, link in zip(found_now, links, strict=True) if link == links[k] and x is not found_now[k]]
            Z_others, W = sum(Z for f, Z, *_ in others if f > 0), R @ mobilities[k] @ R.T
            one, C, after = touched(of_points[k], normal, depth, J @ v, h, law, W, Z_others)
            kinds.add((depth > 0, bool(one.any()), of_points[k, 4] > 0))
            M, force = M + h * J.T @ C @ J, force + J.T @ one
            rows.append((J, after))
        end = v + h * np.linalg.solve(M, force)
        size = np.abs(end).max() * np.linalg.cond(M)
        assert np.abs(found.qd[i].numpy() - end[case.order]).max() <= 1e-13 * size
        expected = np.concatenate([after(J @ end) for J, after in rows])
        assert np.abs(found.memory[i].numpy() - expected).max() <= 1e-13 * size * (1 + np.abs(expected).max())
    assert len(kinds) >= 3


def _pressed_states(case, points, normal, k, rng, rows=24):
    """Random states near the ground, and memories of points that pressed and of points that did not."""
    s = states(case.robot, batch=rows, seed=1)
    was = rng.random((rows, len(points))) < 0.6
    z = rng.normal(size=(rows, len(points), 3)) * 0.01 * was[..., None]
    z -= (z @ normal)[..., None] * normal
    compression = was * rng.uniform(0, 0.05, was.shape)
    last = was * np.linalg.norm(k * z, axis=-1) * rng.uniform(0.3, 1.5, was.shape)
    pressed = was * rng.uniform(0, 5, was.shape)
    others = was * rng.uniform(-1, 5, was.shape), was * rng.uniform(-0.1, 0.5, was.shape)  # acceleration, friction left
    memory = np.concatenate([z, np.stack([compression, pressed, last, *others], -1)], -1).reshape(rows, -1)
    return s.q.numpy(), s.qd.numpy(), s.qdd.numpy(), memory


def test_a_memory_of_the_size_of_rounding_is_none():
    """A point that comes down meets the friction of its first touch, whatever is left of its last one."""
    scene, X = ground(ball(), 5e-3), at(0.1 - 1e-4, 1)
    V = double([[0.0, 0, 0, 1.0, 0, -0.5]])
    clean = begin(scene, X, V)
    left = clean._replace(memory=double([[0.0, 0.0, 0.0, 1e3, 1e-12, 0.0, 0.0, 0.0]]))
    clean, left = scene.step(clean), scene.step(left)
    assert clean.V_WB_B[0, 3] < 0.99
    assert torch.allclose(clean.V_WB_B, left.V_WB_B, rtol=0, atol=1e-12)


# --- friction --------------------------------------------------------------------------------------------------------

SHARES = double(0.5, 0.9, 0.99, 1.01, 1.1, 1.5)  # of the friction angle


@STEPS
def test_a_box_on_a_slope_sticks_below_the_friction_angle_and_slides_as_analysis_says_above(dt):
    angle = SHARES * math.atan(MU)
    normal, turn = tilted(angle)
    scene = ground(box(), dt, normal=normal)
    first = rolled(scene, begin(scene, _on(normal, turn, 0.01)), 1.0)
    last = rolled(scene, first, 0.5)
    moved = (place(last) - place(first)).norm(dim=-1)
    assert (moved[:2] <= 1e-12).all() and moved[2] < 1e-3  # a share of 0.99 slides until it has landed
    found = scene.contacts(last)
    weight = G * angle.cos()
    assert torch.allclose(found.normal_force.sum(-1), weight, rtol=1e-3)
    tangential = found.force.sum(-2) - found.normal_force.sum(-1)[:, None] * normal
    expected = torch.minimum(G * angle.sin(), MU * weight)
    assert torch.allclose(tangential.norm(dim=-1), expected, rtol=2e-3)
    exact = G * (angle.sin() - MU * angle.cos())
    acceleration = (last.V_WB_B[:, 3] - first.V_WB_B[:, 3]).abs() / 0.5
    assert torch.allclose(acceleration[3:], exact[3:], rtol=1e-3)
    assert torch.allclose(found.slip[3:, 0], last.V_WB_B[3:, 3].abs(), rtol=1e-6)


def _on(normal, turn, height):
    """Poses at a height over planes through the origin."""
    return torchdq.dq.from_pose(turn, height * normal)


@STEPS
def test_friction_of_an_impact_is_mu_times_its_normal_impulse(dt):
    """Of a ball that slides at 8 m/s and lands, up to a stiffness of 4 m / h^2 and far above it; by its momentum."""
    speeds, firmness = torch.meshgrid(double(0.5, 1.0, 3.0), double(0.1, 1.0, 4.0, 40.0), indexing="ij")
    speeds, firmness = speeds.flatten(), firmness.flatten()
    scene = ground(ball(), dt, stiffness=firmness / dt**2, friction=0.2)
    V = torch.zeros(12, 6, dtype=F64)
    V[:, 3], V[:, 5] = 8.0, -speeds
    end, T = rolled(scene, begin(scene, at(0.1 + 1e-4, 12), V), 12 * dt), 12 * dt
    linear = torchdq.dq.rotate(torchdq.dq.rotation(end.X_WB), end.V_WB_B[:, 3:])
    normal, tangential = linear[:, 2] + speeds + G * T, 8.0 - linear[:, 0]
    ratio = tangential / (0.2 * normal)
    assert (ratio <= 1.01).all()
    assert (ratio[firmness <= 4] >= 0.99).all()  # beyond, it may touch for a step or two


def test_friction_of_an_impact_off_the_centre_is_at_most_mu_times_its_normal_impulse():
    """Of thin plates that tumble onto one, two or four corners, to five times the stiffness m / h^2; by momentum."""
    rng, rows, h, mu = np.random.default_rng(3), 96, 5e-3, 0.3
    scene = ground(box(0.6, 0.6, 0.005, mass=1.5, upper=True), h, friction=mu, stiffness=torch.logspace(3, 5.5, rows))
    turn = torch.from_numpy(rng.normal(size=(rows, 4)))
    V = torch.from_numpy(rng.normal(size=(rows, 6)) * [3, 3, 3, 1, 1, 1])
    state = begin(scene, at(0.6, rows, turn=turn / turn.norm(dim=-1, keepdim=True)), V)
    states = path(scene, state, 160)
    v = torchdq.dq.rotate(torchdq.dq.rotation(states.X_WB), states.V_WB_B[..., 3:])
    impulse = 1.5 * (v.diff(dim=0) + h * double(0.0, 0.0, G))
    hit = impulse.norm(dim=-1) > 1e-9
    first = hit & ((~hit & (hit.cumsum(0) > 0)).cumsum(0) == 0)  # up to the first step without a force after it
    whole = (impulse * first[..., None]).sum(0)
    assert (first.sum(0) > 0).all()
    assert (whole[:, :2].norm(dim=-1) / (mu * whole[:, 2])).max() < 1.05


def test_the_mobility_of_a_point_is_that_of_its_body():
    """1 / m + [r]^T I^-1 [r] at a corner of a box."""
    robot, points = box(0.4, 0.1, 0.2, mass=2.0)
    r = np.array(points[0].center)
    inverse = np.diag(6 / np.array([0.05, 0.2, 0.17]))
    expected = np.eye(3) / 2.0 + pin.skew(r).T @ inverse @ pin.skew(r)
    assert np.allclose(ground((robot, points), 1e-2).effects[1].points[0].mobility, expected, rtol=1e-12)


FALLING = [
    ((5e-4, 0.0, 7e-4, 0.0, 0.0, 9e-4), (0.0, 0.0, 0.0)),
    ((8e-3, 0.0, 0.01, 0.0, 0.0, 0.012), (0.08, 0.02, -0.03)),
]


@pytest.mark.parametrize(
    ("inertia", "com"),
    thinned(FALLING, FALLING[1:]),
)
@pytest.mark.parametrize("friction", thinned([0.0, 0.8], [0.8]))
def test_a_fall_never_gains_height_whatever_the_body_and_the_stiffness(friction, inertia, com):
    """Boxes of low inertia, without and with an offset of their centre of mass, to 30 m / h^2, by their energy."""
    rng, rows, h = np.random.default_rng(0), 96, 0.01
    robot, points = box(0.4, 0.1, 0.2, upper=True)
    robot = robot.replace(base_com=double(*com), base_inertia=double(*inertia))
    stiffness = torch.from_numpy(10 ** rng.uniform(-1, 1.5, rows)) / h**2
    scene = ground((robot, points), h, friction=friction, dissipation=0.0, stiffness=stiffness)
    turn = torch.from_numpy(rng.normal(size=(rows, 4)))
    X = at(rng.uniform(0.5, 0.8, rows), rows, turn=turn / turn.norm(dim=-1, keepdim=True))
    state = begin(scene, X, torch.from_numpy(rng.normal(size=(rows, 6)) * [5, 5, 5, 1, 1, 1]))
    energy = scene.energy(path(scene, state, 100)).sum(-1)
    assert ((energy - scene.energy(state).sum(-1)) / G).max() <= 1e-9


def test_viscous_friction_creeps_at_the_speed_of_its_width():
    """tan(angle) = mu v / sqrt(v^2 + w^2), w = 10 mm/s."""
    normal, turn = tilted(double([0.5]) * math.atan(MU))
    scene = ground(box(), 5e-3, stiction=False, normal=normal)
    state = rolled(scene, begin(scene, _on(normal, turn, 0.01)), 0.5)
    assert state.memory is None
    share = math.tan(0.5 * math.atan(MU)) / MU
    assert abs(float(state.V_WB_B[0, 3].abs()) / (0.01 * share / math.sqrt(1 - share**2)) - 1) < 1e-3
    assert scene.contacts(state).force.sum(-2)[0, 2] == pytest.approx(G, rel=1e-3)


@STEPS
def test_a_ball_that_slides_rolls_in_the_end_with_five_sevenths_of_its_speed(dt):
    scene = ground(ball(), dt)
    V = double([[0.0, 0, 0, 1, 0, 0]])
    state = rolled(scene, begin(scene, at(0.1 - G / 2e4, 1), V), 1.0)
    speed = torchdq.dq.rotate(torchdq.dq.rotation(state.X_WB), state.V_WB_B[:, 3:]).norm()
    assert abs(float(speed) / (5 / 7) - 1) < 1e-3
    assert abs(float(state.V_WB_B[0, :3].norm()) * 0.1 / float(speed) - 1) < 1e-3


# --- the normal force ------------------------------------------------------------------------------------------------


def test_a_box_at_rest_weighs_what_it_weighs_and_sinks_as_deep_as_its_springs():
    scene = ground(box(), 5e-3)
    state = rolled(scene, begin(scene, at(0.015, 1)), 2.0)
    found = scene.contacts(state)
    assert found.touching.all() and float(found.normal_force.sum()) == pytest.approx(G, rel=1e-9)
    assert torch.allclose(found.depth, double(G / 8e4), rtol=1e-6)


def bounced(c, v, k=2e4):
    """Speed after a bounce of a mass of 1 kg under gravity, by Runge-Kutta steps of the law in continuous time."""

    def rates(d, v):
        return v, G - max(k * d * (1 + c * v), 0.0)

    d, h = 0.0, 1e-6
    while d >= 0:
        a = rates(d, v)
        b = rates(d + h / 2 * a[0], v + h / 2 * a[1])
        e = rates(d + h / 2 * b[0], v + h / 2 * b[1])
        f = rates(d + h * e[0], v + h * e[1])
        d, v = (x + h / 6 * (p + 2 * q + 2 * r + s) for x, p, q, r, s in zip((d, v), a, b, e, f, strict=True))
    return -v


def test_bounces_converge_to_those_of_the_continuous_law_with_order_one():
    c, exact = double([0.2, 0.5]), double([bounced(0.2, 1.0), bounced(0.5, 1.0)])
    errors = []
    for dt in (1e-4, 5e-5):
        scene = ground(ball(), dt, dissipation=c)
        state = begin(scene, at(0.1, 2), double([[0.0, 0, 0, 0, 0, -1]] * 2))
        state = rolled(scene, state, 0.03)
        assert (scene.contacts(state).normal_force == 0).all()
        # the speed at which it left, from its height then
        left = (state.V_WB_B[:, 5] ** 2 + 2 * G * (place(state)[:, 2] - 0.1)).sqrt()
        errors.append(exact - left)
    assert (errors[-1].abs() < 0.02).all() and (errors[-1] > 0).all()
    assert (errors[0] / errors[1] > 1.7).all() and (errors[0] / errors[1] < 2.3).all()


def test_the_ground_does_not_hold_what_is_thrown_up():
    """It flies from the depth at which it would rest as if there were no ground."""
    scene, dt = ground(ball(), 5e-3), 5e-3
    state = begin(scene, at(0.1 - G / 2e4, 1), double([[0.0, 0, 0, 0, 0, 1]]))
    for k in range(4):
        state = rolled(scene, state, dt)
        assert float(state.V_WB_B[0, 5]) == pytest.approx(1.0 - G * dt * (k + 1), rel=1e-12)
    assert not scene.contacts(state).touching.any()


# --- symmetries, rows, size zero -------------------------------------------------------------------------------------


def tumbling(dt, turn=(1.0, 0.0, 0.0, 0.0), **parameters):
    """State of a cube that fell on its corner, 0.5 s later, in a world that is turned."""
    turn = torch.as_tensor(turn, dtype=F64)
    robot, points = box(0.2, 0.2, 0.2, upper=True)
    gravity, normal = (torchdq.dq.rotate(turn, double(x)) for x in ((0.0, 0.0, -G), (0.0, 0.0, 1.0)))
    contact = effects.Contact(points, normal=normal, stiffness=double(5e3), friction=double(MU), **parameters)
    scene = Scene(robot, (effects.Gravity(gravity), contact), dt=dt)
    own = torch.nn.functional.normalize(double(1.0, 0.3, 0.2, 0.1), dim=-1)
    X = torchdq.dq.mul(torchdq.dq.from_pose(turn, torch.zeros(3, dtype=F64)), at(0.2, turn=own))
    return scene, begin(scene, X, double(2.0, -1, 0.5, 0.5, 0, 0))


def test_turning_the_world_turns_the_motion():
    turn = torch.nn.functional.normalize(double(0.8, -0.3, 0.4, 0.2), dim=-1)
    (plain, a), (turned, b) = tumbling(5e-3), tumbling(5e-3, turn)
    a, b = rolled(plain, a, 0.4), rolled(turned, b, 0.4)
    assert a.memory[4::5].any()  # it has touched
    assert torch.allclose(torchdq.dq.rotate(turn, place(a)), place(b), rtol=0, atol=1e-9)
    assert torch.allclose(a.V_WB_B, b.V_WB_B, rtol=0, atol=1e-8)


@pytest.mark.parametrize("stiction", thinned([True, False], [True]))
def test_a_tumbling_cube_loses_energy_and_comes_to_rest(stiction):
    scene, state = tumbling(5e-3, stiction=stiction)
    states = path(scene, state, 800)
    found = scene.contacts(states)
    assert found.touching.any() and (found.force[~found.touching] == 0).all()
    stored = 0.5 * 5e3 * found.depth.clamp(min=0).square().sum(-1)
    if stiction:
        memory = states.memory.unflatten(-1, (8, 8))
        pressed = torch.minimum(memory[..., 3], found.depth).clamp(min=0)
        stored = 0.5 * 5e3 * (memory[..., :3].square().sum(-1) + pressed.square()).sum(-1)
    energy = torch.cat([scene.energy(state).sum()[None], scene.energy(states).sum(-1) + stored])
    assert (torch.diff(energy) <= 1e-3 * energy[0]).all() and energy[-1] < 0.6 * energy[0]
    assert states.V_WB_B[-1].norm() < 0.02
    assert float(place(states)[-1, 2]) == pytest.approx(0.1 - G / 2e4, abs=2e-5)


def test_friction_and_stiffness_of_no_size_change_nothing():
    """Without stiffness it flies as without ground; without friction it slides on for ever."""
    robot, _ = box()
    V = double(0.3, 0.1, 0.2, 1.0, 0.5, 0.0)
    soft, none = ground(box(), 5e-3, stiffness=0.0), Scene(robot, (effects.Gravity(),), dt=5e-3)
    flown, free = (rolled(s, begin(s, at(0.01), V), 0.5) for s in (soft, none))
    assert torch.allclose(flown.X_WB, free.X_WB, rtol=0, atol=1e-14)
    assert torch.allclose(flown.V_WB_B, free.V_WB_B, rtol=0, atol=1e-14)
    scene = ground(box(), 5e-3, friction=0.0)
    end = rolled(scene, begin(scene, at(0.01 - G / 8e4), double(0.0, 0, 0, 1.0, 0.5, 0.0)), 1.0)
    assert torch.allclose(place(end)[:2], double(1.0, 0.5), rtol=1e-9)


# --- surfaces --------------------------------------------------------------------------------------------------------


def test_a_surface_with_a_constant_slope_is_a_plane():
    a, b = 0.2, -0.1
    normal = torch.nn.functional.normalize(double(-a, -b, 1.0), dim=-1)
    robot, points = box()
    contact = effects.Contact(points, surface=lambda x, y: a * x + b * y, friction=MU, stiffness=1e4)
    ends = []
    for scene in (
        Scene(robot, (effects.Gravity(), contact), dt=5e-3),
        ground(box(), 5e-3, normal=normal, stiffness=1e4),
    ):
        state = rolled(scene, begin(scene, at(0.05), double(0.5, 0.2, 0.1, 0.4, 0, 0)), 0.5)
        ends.append((state, scene.contacts(state)))
    (one, found), (two, expected) = ends
    assert torch.allclose(place(one), place(two), atol=1e-10)
    assert torch.allclose(found.force, expected.force, atol=1e-7) and found.touching.any()


def test_a_ball_rolls_to_and_fro_in_a_valley_without_gaining_energy():
    """Waves of 2 cm: its period is that of rolling, 2 pi sqrt(7 / (5 g curvature)), and it never rises higher."""
    A, k = 0.02, 6.0

    def waves(x, y):
        return -A * (k * x).cos()

    robot, points = ball()
    scene = Scene(robot, (effects.Gravity(), effects.Contact(points, surface=waves, stiffness=2e4)), dt=5e-3)
    X = torchdq.dq.from_pose(double(1.0, 0, 0, 0), double(0.03, 0.0, -A * math.cos(0.18) + 0.1))
    x = place(path(scene, begin(scene, X), 1600))[:, 0]
    assert x.min() < -0.02 and x.abs().max() <= 0.0301  # to the other side, and no further
    crossings = ((x[1:] < 0) != (x[:-1] < 0)).nonzero()[:, 0]
    period = float((crossings[2:] - crossings[:-2]).double().mean()) * 5e-3
    # the ground is the tangent plane below the centre, so that the radius does not change the curvature
    assert period == pytest.approx(2 * math.pi * math.sqrt(7 / (5 * G * A * k * k)), rel=0.01)


# --- arms ------------------------------------------------------------------------------------------------------------


def test_an_arm_that_wipes_rubs_with_mu_times_what_it_presses():
    """Stiff servos draw the tip of an arm along a wall at 0.1 m/s; the friction of a step does not alternate."""
    robot, mu = shipped("two_link").robot, 0.4
    wall = effects.Contact("tip", height=-1.2, normal=(0.0, 1.0, 0.0), friction=mu, stiffness=1e4)
    scene = Scene(robot, (effects.Servo(2e4, 1e3), wall), dt=5e-3)
    time = torch.arange(400, dtype=F64)[:, None] * 5e-3
    x, y = 0.6 + 0.1 * time, torch.full_like(time, -1.23)  # 3 cm into the wall
    elbow = torch.acos((x * x + y * y) / 2 - 1)
    target = torch.cat([torch.atan2(y, x) - elbow / 2, elbow], -1)
    found = scene.contacts(path(scene, scene.start(target[0]), 400, target=target))
    f_t, f_n = found.force[200:, 0, 0].abs(), found.normal_force[200:, 0]
    assert (f_n > 5).all() and torch.allclose(f_t, mu * f_n, rtol=5e-3)
    assert torch.allclose(found.slip[200:, 0], double(0.1), rtol=0.2)


def test_an_elastic_arm_leans_on_the_ground_with_the_torques_of_its_springs():
    """At rest every torque is gravity's less J^T f, and that of the transmission is k (rotor - joint)."""
    robot, stiffness = shipped("two_link").robot, 300.0
    parts = (
        effects.Gravity((0.0, -G, 0.0)),
        effects.Viscous(2.0),
        effects.Elastic(stiffness, 5.0, 0.05),
        effects.Contact("tip", height=-1.2, normal=(0.0, 1.0, 0.0), stiffness=1e4),
    )
    scene = Scene(robot, parts, dt=5e-3)
    torque = double(2.0, 0.0)
    state = rolled(scene, scene.start(double(0.0, -0.6)), 8.0, torque=torque)
    assert state.qd.abs().max() < 1e-6
    found = scene.contacts(state)
    assert float(found.normal_force) > 1.0
    J = torchdq.jacobian(robot, state.q, "tip", expressed="world")[..., 3:, :]
    still = torch.zeros_like(state.q)
    needed = torchdq.inverse_dynamics(robot.replace(gravity=double(0.0, -G, 0.0)), state.q, still, still)
    needed = needed - J.mT @ found.force[0]
    rotors = state.memory[..., :2]
    assert torch.allclose(stiffness * (rotors - state.q), needed, atol=1e-6)
    assert torch.allclose(needed, torque, atol=1e-6)


# --- gradients -------------------------------------------------------------------------------------------------------


def thrown(steps, height=0.012, backend="auto"):
    """End of a box thrown along the ground, as a function of speed, spin, friction and stiffness [..., 4]."""

    def end(point):
        v, w, mu, k = point.unbind(-1)
        scene = ground(box(), 5e-3, friction=mu, stiffness=k)
        V = torch.stack([w, 0 * w, w, v, 0.3 * v, 0 * v], -1)
        state = scene.replace(backend=backend).rollout(begin(scene, at(height, *v.shape), V), steps=steps, ends=True)
        return torch.cat([state.X_WB, state.V_WB_B], -1)

    return end


@pytest.mark.parametrize("steps", thinned([24, 128], [24]))
def test_gradients_through_many_steps_are_differences(steps):
    """Of speed, spin, friction and stiffness, while it lands, slides and comes to rest."""
    point = double(1.5, 0.5, 0.3, 1e4)
    h = torch.diag(1e-6 * point.clamp(min=1.0))
    points = torch.cat([point[None], point + h, point - h]).requires_grad_()
    values = (thrown(steps)(points) * torch.linspace(0.5, 1.5, 14, dtype=F64)).sum(-1)
    (found,) = torch.autograd.grad(values[0], points)
    differences = (values[1:5] - values[5:]) / (2 * h.diagonal())
    assert ((found[0] - differences).abs() <= 1e-6 * differences.abs() + 1e-8 / point).all()
    assert (found[0].abs() * point > 1e-4).all()


def test_second_derivatives_of_a_step_that_touches_are_right():
    end, size = thrown(1, height=0.009, backend="eager"), double(1.0, 1.0, 1.0, 1e4)
    point = double(1.5, 0.5, 0.3, 1.0).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda x: end(x * size)[8:], [point], atol=1e-5, rtol=1e-4, fast_mode=True)


# --- a quadruped -----------------------------------------------------------------------------------------------------


def standing(robot, dt, dtype=F64, points=FEET, kp=60.0, kd=2.0, **parameters):
    """Scene of a robot with servos, whose parameters are tensors."""
    given = {name: torch.as_tensor(x, dtype=dtype) for name, x in {"stiffness": 2e4, **parameters}.items()}
    servo = effects.Servo(*(torch.as_tensor(x, dtype=dtype) for x in (kp, kd)))
    parts = (effects.Gravity(), effects.RotorInertia(0.01), servo, effects.Contact(points, **given))
    return Scene(robot, parts, dt=dt)


def on_stool(*frames, radius=0.02):
    """Spheres on the links of a quadruped of a joint each leg."""
    return tuple(ContactPoint(f"{frame}{k}", radius=radius) for frame in frames for k in range(4))


@pytest.mark.parametrize("dtype, most", thinned([(F64, 1e-9), (torch.float32, 1e-5)], [(torch.float32, 1e-5)]), ids=str)
def test_a_quadruped_that_stands_on_a_slope_does_not_creep(dtype, most):
    """In three seconds, after twenty of settling; the benchmark stands for a minute."""
    normal, turn = tilted(double([math.radians(10)]))
    robot, q = stool(), torch.zeros(1, 4, dtype=dtype)
    scene = standing(robot, 5e-3, dtype, on_stool("foot"), normal=normal)
    first = rolled(scene, scene.start(q, X_WB=_on(normal, turn, 0.31).to(dtype)), 20.0, target=q)
    last = rolled(scene, first, 3.0, target=q)
    assert (place(last) - place(first)).norm() <= most
    weight = G * float(robot.mass.sum() + robot.base_mass)
    assert float(scene.contacts(last).force.sum(-2)[0, 2]) == pytest.approx(weight, rel=1e-4)


def test_a_quadruped_in_any_state_gains_no_energy_at_large_steps():
    """Feet, hips and seat fall on ground from soft to 4 m / h^2 under servos with random targets, with 20 ms."""
    dt, rows, robot = 0.02, 24, stool()
    weight, generator = float(robot.mass.sum() + robot.base_mass), torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.randn(rows, *shape, generator=generator, dtype=F64)

    seat = tuple(ContactPoint("seat", (x, y, z)) for x in (-0.15, 0.15) for y in (-0.1, 0.1) for z in (-0.03, 0.03))
    k = torch.logspace(3, math.log10(4 * weight / dt**2), rows, dtype=F64)
    scene = standing(robot, dt, points=(*on_stool("foot", "leg"), *seat), kp=40.0, kd=1.0, stiffness=k)
    target = 0.5 * random(4)
    X = at(0.8, rows, turn=torch.nn.functional.normalize(random(4), dim=-1))
    state = scene.start(0.6 * random(4), 3 * random(4), X_WB=X, V_WB_B=2 * random(6))

    def energy(state):
        return scene.energy(state).sum(-1) + 20.0 * (state.q - target).square().sum(-1)

    before, touched = energy(state), torch.zeros(rows, dtype=torch.bool)
    for k in range(80):
        state = rolled(scene, state, dt, target=target)
        if k % 4 == 3:
            touched |= scene.contacts(state).touching.any(-1)
            assert (energy(state) <= 1.01 * before).all()  # NaN is not
    assert touched.all()


def test_a_quadruped_stands_as_in_mujoco():
    """Height, joints and the forces of the feet at rest, after its own reading of the same file."""
    mujoco = pytest.importorskip("mujoco")
    model = _in_mujoco(mujoco)
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7:] = [0, 0, 0.32, 1, 0, 0, 0], STAND.numpy()
    for _ in range(4000):
        data.qfrc_applied[6:] = 60.0 * (STAND.numpy() - data.qpos[7:])
        mujoco.mj_step(model, data)
    theirs = np.zeros(4)
    wrench = np.zeros(6)
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, wrench)
        name = model.geom(max(data.contact[i].geom)).name
        theirs[[p.frame for p in FEET].index(name)] += wrench[0]
    scene = standing(go2(), 5e-3, stiffness=1e5)
    q = STAND[None]
    state = rolled(scene, scene.start(q, X_WB=at(0.32, 1)), 4.0, target=q)
    found = scene.contacts(state)
    assert np.allclose(found.normal_force[0].numpy(), theirs, rtol=0.02)
    order = [model.joint(name).qposadr[0] for name in go2().joint_names]
    assert np.abs(state.q[0].numpy() - data.qpos[order]).max() < 8e-3  # where dry friction left them
    assert abs(float(place(state)[0, 2]) - data.qpos[2]) < 2e-3


def _in_mujoco(mujoco):
    """The file's bodies on spheres as feet, with rotors and dampers."""
    text = urdf_paths()["go2"].read_text(encoding="utf-8")
    for word in ("visual", "collision", "mujoco"):
        text = re.sub(rf"<{word}>.*?</{word}>", "", text, flags=re.S)
    text = text.replace("</robot>", '<mujoco><compiler fusestatic="false"/></mujoco></robot>')
    spec = mujoco.MjSpec.from_string(text)
    spec.worldbody.first_body().add_freejoint()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], friction=[0.8, 0.005, 1e-4])
    for one in spec.bodies:
        if one.name in [p.frame for p in FEET]:
            one.add_geom(name=one.name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.022, 0, 0], mass=0)
    model = spec.compile()
    model.opt.timestep, model.opt.integrator = 2e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.noslip_iterations, model.opt.impratio = 20, 100.0  # its friction creeps otherwise
    model.geom_solref[:] = [0.005, 1.0]  # firm ground
    model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    model.dof_damping[6:], model.dof_armature[6:] = 2.0, 0.01
    return model


# --- what is refused -------------------------------------------------------------------------------------------------

MISUSE = {
    "another integrator": lambda r: Scene(r, (effects.Contact(),), integrator=RungeKutta4()),
    "a point on the fixed base": lambda r: Scene(r, (effects.Contact("base"),)),
    "a point on no frame": lambda r: Scene(r, (effects.Contact(ContactPoint("nowhere")),)),
    "no points": lambda r: Scene(r, (effects.Contact(()),)),
    "a number as point": lambda r: Scene(r, (effects.Contact(3),)),
    "a radius below zero": lambda r: Scene(r, (effects.Contact(ContactPoint("tip", radius=-1.0)),)),
    "a surface and a normal": lambda r: Scene(r, (effects.Contact(normal=(0.0, 1.0, 0.0), surface=lambda x, y: 0.0),)),
    "a surface with slopes": lambda r: Scene(r, (effects.Contact(surface=lambda x, y: (x, 1.0, 0.0)),)).count(),
    "a surface that is a number": lambda r: Scene(r, (effects.Contact(surface=0.3),)),
    "contacts of a scene without": lambda r: Scene(r).contacts(Scene(r).start(torch.zeros(2))),
}


@pytest.mark.parametrize("what", MISUSE)
def test_contacts_that_make_no_sense_are_refused(what):
    with refused(torchdq.TorchdqError):
        MISUSE[what](shipped("two_link").robot)


def test_a_stiffness_that_is_not_given_sinks_the_robot_by_a_millimetre_whatever_its_mass():
    robot, points = box()
    scene = Scene(robot, (effects.Contact(list(points)),), dt=0.1)
    assert scene.effects[0].stiffness == pytest.approx(G / 4e-3)
    twice = scene.replace(robot=robot.replace(base_mass=2 * robot.base_mass))
    assert twice.effects[0].stiffness == 2 * scene.effects[0].stiffness


def test_other_masses_beside_contact_need_no_other_program():
    """Neither those that are learned, nor those of several robots, whose rows are those of each alone."""
    robot, points = box()
    scene = Scene(robot, (effects.Gravity(), effects.Contact(list(points), stiffness=1e4)), dt=5e-3)
    first, second = (scene.replace(robot=robot.replace(base_mass=k * robot.base_mass)) for k in (1.0, 1.5))
    assert first.spec is second.spec
    made = Scene(second.robot, (effects.Contact(list(points), stiffness=1e4),))
    assert made.effects[0].points != scene.effects[1].points  # a scene of its own knows the heavier box
    both = scene.replace(robot=robot.replace(base_mass=torch.stack([robot.base_mass, 1.5 * robot.base_mass])))
    states = []
    for one, batch in ((both, (2,)), (first, ()), (second, ())):
        state = begin(one, at(0.005, *batch), double(0.3, 0.0, 0.0, 2.0, 0.0, -1.0).expand(*batch, 6))
        states.append(one.rollout(state, steps=4, ends=True))
    assert bool(both.contacts(states[0]).touching.any(-1).all())
    for row in (0, 1):
        assert torch.equal(states[0].V_WB_B[row], states[1 + row].V_WB_B)
