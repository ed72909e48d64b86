"""Scenes of robots with a floating base: conservation, analytic motions, effects on the base, batches, gradients."""

import math
from functools import cache

import numpy as np
import pytest
import torch
from free_flyers import case, motion
from helpers import EVERYTHING, called, double, exhaustive, thinned
from messages import refused
from scipy.integrate import solve_ivp

import torchdq
from torchdq import Scene, dq, effects, floating
from torchdq.scene.controllers import PD, ComputedTorque
from torchdq.scene.free_base import EXACT, ORDER_4, rate
from torchdq.scene.integrators import (
    DormandPrince,
    ExplicitEuler,
    LinearlyImplicit,
    RungeKutta4,
    SemiImplicitEuler,
    StoermerVerlet,
)

F64 = torch.float64
STEPPED = (ExplicitEuler(), SemiImplicitEuler(), LinearlyImplicit(), RungeKutta4())
UPRIGHT = torch.eye(8, dtype=F64)[0]


def rigid_body(mass=2.0, com=(0.0, 0.0, 0.0), inertia=(0.3, 0.0, 0.2, 0.0, 0.0, 0.1)):
    """Robot without joints."""
    lone = case("quadrotor_base").robot
    values = {"base_mass": mass, "base_com": com, "base_inertia": inertia}
    return lone.replace(**{name: torch.tensor(x, dtype=F64) for name, x in values.items()}).bake()


WEIGHT = torch.tensor([0.0, 0.0, -9.81], dtype=F64)


def begun(scene, m):
    return scene.start(m["q"], m["qd"], X_WB=m["X_WB"], V_WB_B=m["V_WB_B"])


def invariants(scene, state):
    """Energy, and linear and angular momentum about the origin of the world, [..., 7]."""
    at = (scene.robot, state.X_WB, state.q)
    p, L = floating.momentum(*at, state.V_WB_B, state.qd)
    L = L + torch.linalg.cross(floating.centre_of_mass(*at), p)
    return torch.cat([scene.energy(state)[..., :1], p, L], -1)


@pytest.mark.parametrize("dt", thinned([1e-3, 5e-3, 0.02], [0.02]))
def test_a_spinning_body_keeps_the_size_of_its_momentum_and_never_gains_energy(dt):
    """Of any inertia, at 20 rad/s, over 1000 steps; the direction of the momentum is right to the order of the step."""
    rng, rows = np.random.default_rng(1), 64
    parts = rng.uniform(0.02, 1.0, (rows, 3)) ** 2  # second moments, so that inertias fulfil the triangle inequality
    diagonal = parts.sum(-1, keepdims=True) - parts
    inertia = torch.from_numpy(np.insert(diagonal, [1, 2, 2], 0.0, axis=-1)[:, [0, 1, 2, 3, 4, 5]])
    body = rigid_body(inertia=(0.3, 0.0, 0.2, 0.0, 0.0, 0.1)).replace(base_inertia=inertia)
    w = rng.normal(size=(rows, 3))
    V = torch.from_numpy(np.concatenate([20 * w / np.linalg.norm(w, axis=-1, keepdims=True), w], -1))
    scene = Scene(body, (), dt=dt, backend="auto")
    state = scene.start(torch.zeros(rows, 0, dtype=F64), X_WB=UPRIGHT.expand(rows, 8), V_WB_B=V)
    found = scene.rollout(state, steps=1000)
    first, then = (invariants(scene, s) for s in (state, found))
    gain, size = (then[..., 0] / first[:, 0] - 1, then[..., 4:].norm(dim=-1) / first[:, 4:].norm(dim=-1) - 1)
    assert gain.max() < 1e-12 and size.max() < 1e-12
    assert min(gain.min(), size.min()) > -20.0 * (20 * dt) ** 6 - 1e-12
    along = (then[..., 4:] - first[:, 4:]).norm(dim=-1) / first[:, 4:].norm(dim=-1)
    assert along.max() < 20 * dt
    assert torch.allclose(then[-1, :, 1:4], first[:, 1:4], rtol=0, atol=1e-11)


def drift(integrator, dt, steps, name="tree2", backend="eager"):
    """Largest change of the invariants over a number of steps."""
    scene = Scene(case(name).robot, integrator=integrator, dt=dt, backend=backend)
    state = begun(scene, motion(case(name)))
    end = scene.rollout(state, steps=steps, ends=True)
    return float((invariants(scene, end) - invariants(scene, state)).abs().max())


# --- conservation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", thinned(STEPPED, STEPPED[2:]), ids=called)
@pytest.mark.parametrize("name", thinned(["tree3", "tree2", "quadrotor_base"], ["tree2"]))
def test_momentum_and_energy_are_conserved_at_the_order_of_the_integrator(name, integrator):
    dt, steps = (0.02, 5) if isinstance(integrator, RungeKutta4) else (1e-3, 10)
    order = math.log2(drift(integrator, dt, steps, name) / drift(integrator, dt / 2, 2 * steps, name))
    assert order >= integrator.order - 0.25, order


def spinning(com, dtype=F64, size=10.0):
    """Body of rotation rates of that size [rad/s], tilted, away from the origin, at 1.1 m/s, and its robot."""
    robot = rigid_body(com=com, inertia=(0.25, 0.01, 0.2, 0.02, 0.0, 0.1))
    w = size * dq.normalize(torch.tensor([0.0, 0.6, -0.5, 0.62], dtype=F64))[1:]
    X = dq.normalize(torch.tensor([0.3, 0.4, -0.5, 0.7, 0.1, -2.0, 1.5, 0.8], dtype=F64))
    V = torch.cat([w, torch.tensor([1.0, 0.3, -0.2], dtype=F64)])
    return robot, {"q": torch.zeros(0, dtype=dtype), "X_WB": X.to(dtype), "V_WB_B": V.to(dtype)}


@pytest.mark.parametrize("integrator", [*thinned(STEPPED, STEPPED[1:3]), DormandPrince(1e-3, 1e-3)], ids=called)
def test_a_body_in_flight_keeps_its_linear_momentum(integrator):
    """But for its weight, however its angular velocity is integrated; its centre of mass moves as a point would."""
    robot, start = spinning((0.1, -0.05, 0.2))
    m, g, (dt, steps) = robot.base_mass, WEIGHT, (0.05, 4) if isinstance(integrator, DormandPrince) else (0.01, 20)
    scene = Scene(robot.replace(gravity=g), (effects.Gravity(),), integrator=integrator, dt=dt)
    states = [scene.start(**start)]
    for _ in range(steps):
        states.append(scene.step(states[-1]))
    path = type(states[0])._make(None if x[0] is None else torch.stack(x) for x in zip(*states, strict=True))
    t = dt * torch.arange(steps + 1, dtype=F64)[:, None]
    p, _ = floating.momentum(robot, path.X_WB, path.q, path.V_WB_B, path.qd)
    assert (p.diff(dim=0) - m * g * dt).abs().max() <= 1e-13 and (p - p[0] - m * g * t).abs().max() <= 1e-12
    # sums of the velocities at the beginnings or at the ends of the steps
    late = {ExplicitEuler: -1, SemiImplicitEuler: 1, LinearlyImplicit: 1}.get(type(integrator), 0)
    x = floating.centre_of_mass(robot, path.X_WB, path.q)
    assert (x - x[0] - p[0] / m * t - 0.5 * g * t * (t + late * dt)).abs().max() <= 1e-12
    assert (path.V_WB_B[-1, 3:] - path.V_WB_B[0, 3:]).abs().max() > 0.5  # of the origin, in axes that turn


@pytest.mark.parametrize("integrator", thinned(STEPPED, STEPPED[2:3]), ids=called)
def test_a_body_in_flight_keeps_its_linear_momentum_in_single_precision(integrator):
    robot, start = spinning((0.1, -0.05, 0.2), torch.float32)
    scene = Scene(robot, integrator=integrator, dt=0.01)
    path = scene.rollout(scene.start(**start), steps=30)
    p, _ = floating.momentum(robot, path.X_WB.double(), path.q.double(), path.V_WB_B.double(), path.qd.double())
    assert (p - p[0]).abs().max() <= 30 * 2.0**-24 * p[0].norm() * 4


@exhaustive
def test_momentum_and_energy_over_ten_thousand_steps():
    """The order of a short run is that of a long one."""
    coarse, fine = (drift(RungeKutta4(), 1e-3 * k, 10_000 // k, "tree3", "auto") for k in (2, 1))
    assert fine <= 1e-6 and math.log2(coarse / fine) >= 3.75


@pytest.mark.parametrize("integrator", [RungeKutta4(), LinearlyImplicit()], ids=called)
def test_substeps_of_a_free_base_in_a_loop_are_those_of_one_program(integrator):
    c, m = case("tree1"), motion(case("tree1"))
    parts = (effects.Gravity(), effects.Elastic(30.0, 0.2, 0.5))
    unrolled = Scene(c.robot, parts, integrator=integrator, dt=0.05, substeps=3)
    found, expected = (s.step(begun(s, m)).rows() for s in (unrolled.replace(unroll=False), unrolled))
    for name, x in found.items():
        torch.testing.assert_close(x, expected[name], rtol=1e-13, atol=1e-13)


@exhaustive
def test_an_adaptive_integrator_keeps_momentum_and_energy():
    assert drift(DormandPrince(1e-11, 1e-13), 0.1, 1, backend="auto") <= 1e-9


@pytest.mark.parametrize(
    ("series", "size", "tolerance"), [(ORDER_4, 0.05, 1e-7), (EXACT, 0.05, 1e-14), (EXACT, 1.0, 1e-12)]
)
def test_the_rate_of_a_displacement_is_the_derivative_of_its_logarithm(series, size, tolerance):
    theta, w, p, u = torch.randn(4, 20, 3, dtype=F64, generator=torch.Generator().manual_seed(3))
    theta = size * theta / theta.norm(dim=-1, keepdim=True)

    def displacement(t):
        """Rotation about own axes, translation in axes that do not turn, as one after the other."""
        turn, turned = (dq.exp(0.5 * torch.cat([x, torch.zeros_like(x)], -1)) for x in (theta, t * w))
        whole = dq.mul(turn, turned)
        return torch.cat([2 * dq.log(whole)[..., :3], p + t * u], -1)

    t = torch.zeros(20, 1, dtype=F64)
    _, expected = torch.autograd.functional.jvp(displacement, t, torch.ones_like(t))
    xi, v = (torch.cat(x, -1).unbind(-1) for x in ((theta, p), (w, u)))
    found = torch.stack(torch.broadcast_tensors(*rate(xi, v, series)), -1)
    assert (found - expected).abs().max() <= tolerance * w.norm(dim=-1).max()


# --- analytic motions ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", STEPPED, ids=called)
def test_a_body_turns_at_the_rate_of_its_spin_about_an_axis_of_inertia(integrator):
    scene = Scene(
        rigid_body(com=(0.0, 0.0, 0.4), inertia=(0.2, 0.0, 0.2, 0.0, 0.0, 0.1)), (), None, integrator, dt=0.05
    )
    spin, steps = 7.0, 5
    V = torch.tensor([0.0, 0.0, spin, 0.3, -0.2, 4.0], dtype=F64)
    end = scene.rollout(scene.start(torch.zeros(0, dtype=F64), X_WB=UPRIGHT, V_WB_B=V), steps=steps, ends=True)
    half = 0.5 * spin * steps * scene.dt
    attitude = torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)], dtype=F64)
    assert (dq.rotation(end.X_WB) - attitude).abs().max() <= 1e-12


def flipped(inertia, w0, T):
    """Angular velocity and attitude (w, x, y, z) of a free rigid body, by Euler's equations."""
    I = np.array(inertia)

    def rates(_, y):
        r, w = y[:4], y[4:]
        turn = np.concatenate([[-r[1:] @ w], r[0] * w + np.cross(r[1:], w)])
        return np.concatenate([0.5 * turn, np.cross(I * w, w) / I])

    end = solve_ivp(rates, (0, T), [1, 0, 0, 0, *w0], method="DOP853", rtol=2.3e-14, atol=1e-16).y[:, -1]
    return torch.from_numpy(end[4:]), torch.from_numpy(end[:4])


def test_a_spinning_t_handle_flips():
    """Dzhanibekov's effect: a spin about the middle axis of inertia turns over and back, again and again."""
    inertia, w0, T = (0.3, 0.2, 0.1), (0.1, 6.0, 0.0), 2.4
    w, r = flipped(inertia, w0, T)
    V = torch.tensor([*w0, 0.0, 0.0, 0.0], dtype=F64)
    scene = Scene(rigid_body(), integrator=RungeKutta4(), dt=5e-4, backend="auto")
    start = scene.start(torch.zeros(0, dtype=F64), X_WB=UPRIGHT, V_WB_B=V)
    path = scene.rollout(start, steps=round(T / scene.dt))
    assert (path.V_WB_B[:, 1] < -5.9).any()  # it has turned over
    assert (path.V_WB_B[-1, :3] - w).abs().max() <= 1e-8 * 6
    ends = [path.last]
    if EVERYTHING:
        ends.append(scene.replace(integrator=DormandPrince(1e-11, 1e-13), dt=T).step(start))
    assert all((dq.rotation(end.X_WB) - r).abs().max() <= 1e-8 for end in ends)


@pytest.mark.case("T4")
@pytest.mark.parametrize("integrator", thinned(STEPPED, STEPPED[3:]), ids=called)
def test_poses_stay_unit_dual_quaternions(integrator):
    c, m = case("tree1"), motion(case("tree1"))
    scene = Scene(c.robot, (effects.Gravity(), effects.Viscous(0.5)), None, integrator, dt=2e-3, backend="auto")
    r, d = scene.rollout(begun(scene, m), steps=1000).X_WB.split(4, -1)
    assert (r.norm(dim=-1) - 1).abs().max() <= 1e-15
    assert ((r * d).sum(-1).abs() / (1 + d.norm(dim=-1))).max() <= 1e-15


# --- effects ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", STEPPED, ids=called)
def test_a_step_is_that_of_forward_dynamics(integrator):
    """Torques, viscous friction, gravity and a push on the base, against the functions of `torchdq.floating`."""
    c, m = case("tree3"), motion(case("tree3"))
    parts = (effects.Gravity(), effects.RotorInertia(), effects.Viscous(0.3), effects.Push("base", axes="body"))
    scene = Scene(c.robot, parts, integrator=integrator, dt=1e-6)
    state = begun(scene, m)
    end = scene.step(state, m["tau"], push=m["f_base"])
    tau = m["tau"] - 0.3 * m["qd"]
    A, qdd = floating.forward_dynamics(c.robot, *m.pick("X_WB", "q", "V_WB_B", "qd").values(), tau, f_base=m["f_base"])
    size = max(A.abs().max(), qdd.abs().max())
    assert ((end.V_WB_B - state.V_WB_B) / 1e-6 - A).abs().max() <= 1e-3 * size
    assert ((end.qd - state.qd) / 1e-6 - qdd).abs().max() <= 1e-3 * size
    moved = 2 * dq.mul(dq.conj(state.X_WB), (end.X_WB - state.X_WB) / 1e-6)
    assert (moved[:, [1, 2, 3, 5, 6, 7]] - state.V_WB_B).abs().max() <= 1e-3


def test_drag_of_the_links_slows_the_whole_robot():
    c, m = case("tree2"), motion(case("tree2"))
    scene = Scene(c.robot, (effects.Drag(linear=2.0, angular=1.0),), integrator=RungeKutta4(), dt=0.01)
    energy = scene.energy(scene.rollout(begun(scene, m), steps=10))[..., 0]
    assert (energy.diff(dim=0) < 0).all()


@pytest.mark.parametrize("integrator", STEPPED, ids=called)
def test_drag_is_that_of_links_which_fly_with_the_base(integrator):
    """In proportion to the masses of the links it takes their momentum, k (p - that of the base), in every second."""
    c, m, k, dt = case("tree3"), motion(case("tree3")), 0.7, 1e-6
    scene = Scene(c.robot, (effects.Drag(linear=k * c.robot.mass),), integrator=integrator, dt=dt)
    state = begun(scene, {**m, "V_WB_B": m["V_WB_B"] + 20.0})
    (p, _), (after_p, _) = (floating.momentum(c.robot, s.X_WB, s.q, s.V_WB_B, s.qd) for s in (state, scene.step(state)))
    w, v = state.V_WB_B.split(3, -1)
    velocity = v + torch.linalg.cross(w, c.robot.base_com.expand_as(w))
    of_links = p - c.robot.base_mass * dq.rotate(dq.rotation(state.X_WB), velocity)
    assert ((after_p - p) / dt + k * of_links).abs().max() <= 1e-3 * of_links.abs().max()


@cache
def under_effects_of_all_kinds():
    """Scene of an adaptive step under effects of all kinds that act continuously, its start, inputs, and end."""
    c, m = case("tree2"), motion(case("tree2"))
    parts = (
        *(effects.Gravity(), effects.RotorInertia(0.1), effects.Payload(0.5, (0.1, 0.0, 0.1)), effects.Viscous(0.3)),
        *(effects.Stribeck(0.2, 0.4, velocity=1.0, sign_width=1.0), effects.Elastic(30.0, 0.2, 0.5)),
        *(effects.Drag(0.3, 0.1, 0.1, sign_width=0.5), effects.Push("base")),
    )
    exact = Scene(c.robot, parts, integrator=DormandPrince(1e-11, 1e-12), dt=0.1, backend="auto")
    state = begun(exact, m)
    inputs = {"torque": m["tau"], "push": m["f_base"]}
    return exact, state, inputs, exact.step(state, **inputs).rows()


@exhaustive
@pytest.mark.parametrize(("integrator", "steps"), [(LinearlyImplicit(), 64), (RungeKutta4(), 8)], ids=called)
def test_the_error_falls_with_the_order_under_effects_of_all_kinds(integrator, steps):
    exact, state, inputs, expected = under_effects_of_all_kinds()
    errors = []
    for n in (steps, 2 * steps):
        scene = exact.replace(integrator=integrator, dt=exact.dt / n)
        found = scene.rollout(state, **{name: x.expand(n, *x.shape) for name, x in inputs.items()}, ends=True)
        errors.append(max(float((x - expected[name]).abs().max()) for name, x in found.rows().items()))
    assert errors[1] > 1e-11 and abs(math.log2(errors[0] / errors[1]) - integrator.order) <= 0.2


def test_stiff_joints_on_a_free_base_are_held():
    """Damping and stiffness far beyond what explicit steps hold."""
    c, m = case("tree2"), motion(case("tree2"))
    stiff = Scene(c.robot, (effects.Viscous(50.0), effects.Spring(1e4, 0.0)), dt=5e-3)
    state = begun(stiff, {**m, "q": 0.01 * m["q"], "qd": 0.1 * m["qd"]})
    assert not stiff.replace(integrator=SemiImplicitEuler()).check(state, seconds=0.02)
    assert stiff.check(state, seconds=0.02)
    end = stiff.replace(backend="auto").rollout(state, steps=400, ends=True)
    assert end.q.abs().max() <= 5e-3 and end.qd.abs().max() <= 0.05


def test_springs_and_dampers_of_joints_do_not_push_the_base():
    """Internal forces leave the momentum alone, also where they are implicit."""
    c, m, changes = case("tree2"), motion(case("tree2")), []
    for steps in (10, 20):
        scene = Scene(c.robot, (effects.Viscous(20.0), effects.Spring(100.0, 0.0)), dt=0.02 / steps)
        state = begun(scene, m)
        end = scene.rollout(state, steps=steps, ends=True)
        changes.append(float((invariants(scene, end) - invariants(scene, state))[:, 1:].abs().max()))
    assert changes[1] <= 0.6 * changes[0]  # an error of the step, not of the forces


# --- batches and gradients -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "integrator",
    thinned([RungeKutta4(), LinearlyImplicit()], [LinearlyImplicit()]),
    ids=called,
)
def test_gradients_through_a_rollout_are_those_of_differences(integrator):
    c, m = case("tree2"), motion(case("tree2"), batch=1)
    parts = (effects.Gravity(), effects.RotorInertia(0.1), effects.LuGre(0.2, deflection=0.1), effects.Drag(0.3, 0.1))
    scene = Scene(c.robot, (*parts, effects.Push("base")), None, integrator, dt=0.02, backend="auto")
    at = [m[name][0].clone().requires_grad_() for name in ("X_WB", "q", "V_WB_B", "qd", "tau", "f_base")]
    body = [getattr(c.robot, name).clone().requires_grad_() for name in ("base_mass", "base_com")]

    def end(X, q, V, qd, tau, push, mass, com):
        scene_of = scene.replace(robot=c.robot.replace(base_mass=mass, base_com=com))
        path = scene_of.rollout(scene_of.start(q, qd, X_WB=X, V_WB_B=V), tau.expand(5, 2), push=push.expand(5, 6))
        return torch.cat([path.X_WB[-1], path.q[-1], path.V_WB_B[-1], path.qd[-1], path.memory[-1]], -1)

    torch.autograd.gradcheck(end, (*at, *body), atol=1e-6, fast_mode=True)


def test_no_orientation_is_special_in_time():
    """A motion is the same in turned worlds, through half turns."""
    c, m = case("tree1"), motion(case("tree1"))
    scene = Scene(c.robot, dt=0.02)
    turns = dq.from_pose(double((0.0, 0.0, 0.6, 0.8), (-1.0, 0.0, 0.0, 0.0)), torch.zeros(2, 3, dtype=F64))[:, None]
    path = scene.rollout(begun(scene, m), steps=20)
    other = scene.rollout(begun(scene, {**m, "X_WB": dq.mul(turns, m["X_WB"])}), steps=20)
    assert (other.X_WB - dq.mul(turns, path.X_WB[:, None])).abs().max() <= 1e-11
    assert (other.q - path.q[:, None]).abs().max() <= 1e-11


@exhaustive
def test_feedback_of_the_joints_moves_a_free_robot_without_a_force_from_outside():
    robot, m = case("tree3").robot.replace(gravity=None), motion(case("tree3"))
    scene = Scene(robot, (effects.RotorInertia(0.5),), PD(40.0, 20.0), RungeKutta4(), dt=0.005, backend="auto")
    state, wanted = scene.start(m["q"], X_WB=m["X_WB"]), 0.3 * m["q"]
    reference = torch.cat([wanted, 0 * wanted, 0 * wanted], -1).expand(2000, *wanted.shape[:-1], -1)
    path = scene.rollout(state, reference=reference)
    assert (path.q[-1] - wanted).abs().max() < 1e-3 and (path.X_WB[-1] - m["X_WB"]).abs().max() > 0.01
    assert (invariants(scene, path) - invariants(scene, state))[..., 1:].abs().max() < 1e-5


FREE = Scene(case("tree2").robot)
FIXED = FREE.replace(robot=FREE.robot.replace(base_mass=None, base_com=None, base_inertia=None))
MISUSE = {
    "integrator of momenta": lambda m: FREE.replace(integrator=StoermerVerlet()),
    "computed torque": lambda m: FREE.replace(controller=ComputedTorque(100.0, 20.0)),
    "model of a free robot": lambda m: FREE.replace(controller=PD(9.0, 6.0, model=FREE.robot)),
    "model of a fixed robot": lambda m: FREE.replace(controller=PD(9.0, 6.0, model=FIXED.robot)),
    "pose of a fixed base": lambda m: FIXED.start(m["q"], X_WB=m["X_WB"]),
    "state of a fixed base": lambda m: FREE.step(FIXED.start(m["q"])),
    **{
        f"pose of size {scale}": lambda m, scale=scale: FREE.start(m["q"][0], X_WB=scale * UPRIGHT)
        for scale in (0.0, 1.001, 2.0)
    },
}


@pytest.mark.parametrize("what", MISUSE)
def test_what_a_free_base_does_not_have_is_refused(what):
    with refused(torchdq.ArgumentError):
        MISUSE[what](motion(case("tree2")))


def test_a_start_is_upright_unless_a_pose_is_given():
    assert torch.equal(FREE.start(motion(case("tree2"))["q"]).X_WB, UPRIGHT.expand(3, 8))
