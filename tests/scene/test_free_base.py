"""Scenes of robots with a free base: conservation, analytic motions, effects on the base, batches, gradients."""

import math

import numpy as np
import pytest
import torch
from free_flyers import case, motion
from helpers import called
from messages import refused
from scipy.integrate import solve_ivp

import torchdq
from torchdq import dq, floating
from torchdq.envs import Scene, effects
from torchdq.scene.free_base import EXACT, ORDER_4, rate
from torchdq.scene.integrators import (
    DormandPrince,
    ExplicitEuler,
    LinearlyImplicit,
    Repeated,
    RungeKutta4,
    SemiImplicitEuler,
    StoermerVerlet,
)

BACKEND = "auto"  # many steps
F64 = torch.float64
STEPPED = (ExplicitEuler(), SemiImplicitEuler(), LinearlyImplicit(), RungeKutta4())
UPRIGHT = torch.eye(8, dtype=F64)[0]


def rigid_body(mass=2.0, com=(0.0, 0.0, 0.0), inertia=(0.3, 0.0, 0.2, 0.0, 0.0, 0.1)):
    """Robot without joints."""
    lone = case("quadrotor_base").robot
    values = {"base_mass": mass, "base_com": com, "base_inertia": inertia}
    return lone.replace(**{name: torch.tensor(x, dtype=F64) for name, x in values.items()}).bake()


def begun(scene, m):
    return scene.start(m["q"], m["qd"], X_WB=m["X_WB"], V_WB_B=m["V_WB_B"])


def after(scene, state, T):
    """State after a time."""
    path = scene.rollout(state, steps=round(T / scene.dt))
    return type(path)._make(None if x is None else x[-1] for x in path)


def invariants(scene, state):
    """Energy, and linear and angular momentum about the origin of the world, [..., 7]."""
    at = (scene.robot, state.X_WB, state.q)
    p, L = floating.momentum(*at, state.V_WB_B, state.qd)
    L = L + torch.linalg.cross(floating.centre_of_mass(*at), p)
    return torch.cat([scene.energy(state)[..., :1], p, L], -1)


def drift(integrator, dt, steps, name="tree3"):
    """Largest change of the invariants over a number of steps."""
    scene = Scene(case(name).robot, integrator=integrator, dt=dt)
    state = begun(scene, motion(case(name)))
    end = scene.rollout(state, steps=steps)
    return float((invariants(scene, end)[-1] - invariants(scene, state)).abs().max())


# --- conservation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", STEPPED, ids=called)
@pytest.mark.parametrize("name", ["tree3", "quadrotor_base"])
def test_momentum_and_energy_are_conserved_at_the_order_of_the_integrator(name, integrator):
    dt = 0.01 if isinstance(integrator, RungeKutta4) else 1e-3
    coarse, fine = drift(integrator, dt, 50, name), drift(integrator, dt / 2, 100, name)
    order = math.log2(coarse / fine)
    assert order >= integrator.order - 0.25, order


@pytest.mark.exhaustive
def test_momentum_and_energy_over_ten_thousand_steps():
    """The order of a short run is that of a long one."""
    coarse, fine = drift(RungeKutta4(), 2e-3, 5_000), drift(RungeKutta4(), 1e-3, 10_000)
    assert fine <= 1e-6 and math.log2(coarse / fine) >= 3.75


@pytest.mark.parametrize("parts", [(), (effects.Elastic(30.0, 0.2, 0.5),)], ids=["rigid", "elastic"])
@pytest.mark.parametrize(
    ("integrator", "tolerance"),
    [
        (Repeated(RungeKutta4(), 4), 1e-5),
        (Repeated(LinearlyImplicit(), 500), 1e-3),
        (DormandPrince(1e-11, 1e-13), 1e-8),
    ],
    ids=str,
)
def test_integrators_that_are_not_recorded_serve_free_bases_too(integrator, tolerance, parts):
    c, m = case("tree2"), motion(case("tree2"))
    scene = Scene(c.robot, (effects.Gravity(), *parts), integrator=integrator, dt=0.05)
    fine = scene.replace(integrator=RungeKutta4(), dt=0.0025)
    found, expected = scene.step(begun(scene, m)), after(fine, begun(fine, m), 0.05)
    for name, x in found.rows().items():
        assert (x - expected.rows()[name]).abs().max() <= tolerance


def test_an_adaptive_integrator_keeps_momentum_and_energy():
    assert drift(DormandPrince(1e-11, 1e-13), 0.1, 2, "tree2") <= 1e-9


@pytest.mark.parametrize(
    ("series", "size", "tolerance"), [(ORDER_4, 0.05, 1e-7), (EXACT, 0.05, 1e-14), (EXACT, 1.0, 1e-12)]
)
def test_the_rate_of_a_displacement_is_the_derivative_of_its_logarithm(series, size, tolerance):
    xi, V = torch.randn(2, 20, 6, dtype=F64, generator=torch.Generator().manual_seed(3))
    xi = size * xi / xi.norm(dim=-1, keepdim=True)

    def displacement(t):
        return 2 * dq.log(dq.mul(dq.exp(0.5 * xi), dq.exp(0.5 * t * V)))

    t = torch.zeros(20, 1, dtype=F64)
    _, expected = torch.autograd.functional.jvp(displacement, t, torch.ones_like(t))
    found = torch.stack(torch.broadcast_tensors(*rate(xi.unbind(-1), V.unbind(-1), series)), -1)
    assert (found - expected).abs().max() <= tolerance * V.norm(dim=-1).max()


# --- analytic motions ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", [*STEPPED, DormandPrince(1e-12, 1e-14)], ids=called)
def test_a_symmetric_top_falls_and_spins(integrator):
    """Centre of mass on a parabola; with constant spin about an axis of inertia, the attitude turns at that rate."""
    robot = rigid_body(com=(0.0, 0.0, 0.4), inertia=(0.2, 0.0, 0.2, 0.0, 0.0, 0.1))
    robot = robot.replace(gravity=torch.tensor([0.0, 0.0, -9.81], dtype=F64))
    scene = Scene(robot, (effects.Gravity(),), integrator=integrator, dt=0.01)
    spin, v0, T = 7.0, torch.tensor([0.3, -0.2, 4.0], dtype=F64), 0.5
    V = torch.cat([torch.tensor([0.0, 0.0, spin], dtype=F64), v0])
    state = scene.start(torch.zeros(0, dtype=F64), X_WB=UPRIGHT, V_WB_B=V)
    end = after(scene, state, T)
    half = torch.tensor(0.5 * spin * T, dtype=F64)
    attitude = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()])
    position = v0 * T + 0.5 * robot.gravity * T**2
    # a step of an order-1 method is off by a share of dt of the fall, and of the turn of the velocity in the body
    tolerance = 1e-9 if integrator.order > 3 else 0.2
    tolerance = 1e-7 if isinstance(integrator, RungeKutta4) else tolerance
    assert (dq.rotation(end.X_WB) - attitude).abs().max() <= 1e-12
    assert (dq.translation(end.X_WB) - position).abs().max() <= tolerance


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
    inertia, w0, T = (0.3, 0.2, 0.1), (0.01, 6.0, 0.0), 3
    w, r = flipped(inertia, w0, T)
    robot = rigid_body(inertia=(0.3, 0.0, 0.2, 0.0, 0.0, 0.1))
    state = {"q": torch.zeros(0, dtype=F64), "X_WB": UPRIGHT}
    V = torch.tensor([*w0, 0.0, 0.0, 0.0], dtype=F64)
    scene = Scene(robot, integrator=RungeKutta4(), dt=5e-4, backend="auto")
    path = scene.rollout(scene.start(**state, V_WB_B=V), steps=round(T / scene.dt))
    assert (path.V_WB_B[:, 1] < -5.9).any()  # it has turned over
    assert (path.V_WB_B[-1, :3] - w).abs().max() <= 1e-8 * 6
    assert (dq.rotation(path.X_WB[-1]) - r).abs().max() <= 1e-8
    adaptive = scene.replace(integrator=DormandPrince(1e-13, 1e-15), dt=float(T))
    end = adaptive.step(adaptive.start(**state, V_WB_B=V))
    assert (dq.rotation(end.X_WB) - r).abs().max() <= 1e-8


@pytest.mark.case("T4")
def test_poses_stay_unit_dual_quaternions():
    c, m = case("tree1"), motion(case("tree1"))
    for integrator in STEPPED:
        parts = (effects.Gravity(), effects.Viscous(0.5))
        scene = Scene(c.robot, parts, integrator=integrator, dt=2e-3, backend="auto")
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


def test_a_body_comes_to_rest_on_the_ground():
    robot = rigid_body().replace(gravity=torch.tensor([0.0, 0.0, -9.81], dtype=F64))
    base = robot.frame_names[0]
    contact = effects.Contact(frame=base, stiffness=1e4, dissipation=2.0, friction=0.5)
    scene = Scene(robot, (effects.Gravity(), contact), integrator=RungeKutta4(), dt=1e-3)
    X = dq.from_pose(UPRIGHT[:4], torch.tensor([0.0, 0.0, 0.2], dtype=F64))
    V = torch.tensor([0.0, 0, 0, 1.0, 0, 0], dtype=F64)
    end = scene.rollout(scene.start(torch.zeros(0, dtype=F64), X_WB=X, V_WB_B=V), steps=3000)
    p = dq.translation(end.X_WB[-1])
    assert abs(p[2] + 2 * 9.81 / 1e4) <= 2e-4 and 0 < p[0] < 1
    assert end.V_WB_B[-1].norm() <= 0.05


def test_drag_of_the_links_slows_the_whole_robot():
    c, m = case("tree3"), motion(case("tree3"))
    scene = Scene(c.robot, (effects.Drag(linear=2.0, angular=1.0),), integrator=RungeKutta4(), dt=2e-3)
    energy = scene.energy(scene.rollout(begun(scene, m), steps=500))[..., 0]
    assert (energy.diff(dim=0) < 0).all()


def test_stiff_joints_on_a_free_base_are_held():
    """Damping and stiffness far beyond what explicit steps hold."""
    c, m = case("tree3"), motion(case("tree3"))
    m = {**m, "q": 0.01 * m["q"], "qd": 0.1 * m["qd"]}
    parts = (effects.Viscous(50.0), effects.Spring(1e4, 0.0))
    stiff = Scene(c.robot, parts, dt=5e-3)
    state = begun(stiff, m)
    assert stiff.check(state, seconds=0.5)
    assert not stiff.replace(integrator=SemiImplicitEuler()).check(state, seconds=0.1)
    end = after(stiff, state, 2.0)
    assert end.q.abs().max() <= 5e-3 and end.qd.abs().max() <= 0.05


def test_springs_and_dampers_of_joints_do_not_push_the_base():
    """Internal forces leave the momentum alone, also where they are implicit."""
    c, m = case("tree2"), motion(case("tree2"))
    changes = []
    for dt in (1e-3, 5e-4):
        scene = Scene(c.robot, (effects.Viscous(20.0), effects.Spring(100.0, 0.0)), dt=dt)
        state = begun(scene, m)
        end = after(scene, state, 0.1)
        changes.append(float((invariants(scene, end) - invariants(scene, state))[:, 1:].abs().max()))
    assert changes[1] <= 0.6 * changes[0]  # an error of the step, not of the forces


# --- batches and gradients -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["eager", "c"])
def test_rows_of_a_batch_are_those_of_solo_runs_bit_for_bit(backend):
    c, m = case("tree3"), motion(case("tree3"), batch=37)
    scene = Scene(c.robot, (effects.Gravity(),), integrator=RungeKutta4(), dt=1e-2, backend=backend)
    path = scene.rollout(begun(scene, m), m["tau"].expand(5, 37, 3))
    for k in (0, 17, 36):
        solo = begun(scene, {name: x[k] for name, x in m.items()})
        alone = scene.rollout(solo, m["tau"][k].expand(5, 3))
        for name, x in alone.rows().items():
            assert x.equal(path.rows()[name][:, k]), name


def test_gradients_through_a_rollout_are_those_of_differences():
    c, m = case("tree2"), motion(case("tree2"), batch=1)
    scene = Scene(c.robot, (effects.Gravity(), effects.Viscous(0.2)), integrator=RungeKutta4(), dt=0.02)
    at = [m[name][0].clone().requires_grad_() for name in ("X_WB", "q", "V_WB_B", "qd", "tau")]
    mass = c.robot.base_mass.clone().requires_grad_()

    def end(X, q, V, qd, tau, mass):
        scene_of = scene.replace(robot=c.robot.replace(base_mass=mass))
        path = scene_of.rollout(scene_of.start(q, qd, X_WB=X, V_WB_B=V), tau.expand(5, 2))
        return torch.cat([path.X_WB[-1], path.q[-1], path.V_WB_B[-1], path.qd[-1]], -1)

    torch.autograd.gradcheck(end, (*at, mass), atol=1e-6, fast_mode=True)


@pytest.mark.parametrize("rotation", [(0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.6, 0.8), (-1.0, 0.0, 0.0, 0.0)], ids=str)
def test_no_orientation_is_special_in_time(rotation):
    """A motion is the same in a turned world, through half turns."""
    c, m = case("tree2"), motion(case("tree2"))
    scene = Scene(c.robot, integrator=RungeKutta4(), dt=5e-3)
    X_NW = dq.from_pose(torch.tensor(rotation, dtype=F64), torch.zeros(3, dtype=F64))
    path = scene.rollout(begun(scene, m), steps=100)
    other = scene.rollout(begun(scene, {**m, "X_WB": dq.mul(X_NW, m["X_WB"])}), steps=100)
    assert (other.X_WB - dq.mul(X_NW, path.X_WB)).abs().max() <= 1e-11
    assert (other.q - path.q).abs().max() <= 1e-11


def started(scale):
    scene = Scene(rigid_body())
    return scene.start(torch.zeros(0, dtype=F64), X_WB=scale * UPRIGHT)


FREE = Scene(case("tree2").robot)
FIXED = FREE.replace(robot=FREE.robot.replace(base_mass=None, base_com=None, base_inertia=None))
MISUSE = {
    "integrator of momenta": lambda m: FREE.replace(integrator=StoermerVerlet()),
    "pose of a fixed base": lambda m: FIXED.start(m["q"], X_WB=m["X_WB"]),
    "state of a fixed base": lambda m: FREE.step(FIXED.start(m["q"])),
    **{f"pose of size {scale}": lambda m, scale=scale: started(scale) for scale in (0.0, 1.001, 2.0)},
}


@pytest.mark.parametrize("what", MISUSE)
def test_what_a_free_base_does_not_have_is_refused(what):
    with refused(torchdq.ArgumentError):
        MISUSE[what](motion(case("tree2")))


def test_a_start_is_upright_unless_a_pose_is_given():
    assert torch.equal(FREE.start(motion(case("tree2"))["q"]).X_WB, UPRIGHT.expand(3, 8))
