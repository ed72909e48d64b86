"""Scenes with loops: linkages move as their one equation says, and loops stay closed beside everything else."""

import warnings
from functools import cache

import numpy as np
import torch
from closed_loops import four_bar
from helpers import double
from messages import refused, warned
from scipy.integrate import solve_ivp
from torch.func import jvp

import torchdq
from torchdq import Closure, Scene, TorchdqError, effects
from torchdq.objects import Ball
from torchdq.scene import controllers, integrators

F64 = torch.float64
BACKEND = "auto"
BARS, G = (0.2, 0.4, 0.4), 9.81
DOWN = effects.Gravity((0.0, 0.0, -G))


@cache
def start():
    """Closed positions with the crank at 1 rad."""
    return torchdq.closed(four_bar(), double(1.0, -0.6, -1.2), hold="ja")


def mechanics(q):
    """Inertia at the crank, potential energy, and rates of all joints per rate of the crank."""
    s, L = np.cumsum(q), np.array(BARS)
    across, along = -L * np.sin(s), L * np.cos(s)
    J = np.array([[across[j:].sum() for j in range(3)], [along[j:].sum() for j in range(3)]])
    rates = np.concatenate([[1.0], -np.linalg.solve(J[:, 1:], J[:, 0])])
    w, x, dx, inertia, potential = np.cumsum(rates), np.zeros(2), np.zeros(2), 0.0, 0.0
    for length, turn, spin in zip(BARS, s, w, strict=True):
        e = np.array([np.cos(turn), np.sin(turn)])
        n = np.array([-e[1], e[0]])
        speed = dx + n * length / 2 * spin
        inertia += length * speed @ speed + length**3 / 12 * spin**2
        potential += length * G * (x + e * length / 2)[1]
        x, dx = x + e * length, dx + n * length * spin
    return inertia, potential, rates


@cache
def crank(seconds):
    """Angle of the crank after a time from rest, by its reduced equation M w' = -(M' w^2 / 2 + U')."""

    def rate(_, y):
        q, w = y[:3], y[3]
        *_, rates = mechanics(q)
        ends = [mechanics(q + h * rates) for h in (1e-6, -1e-6)]  # along the loop, closed to second order
        (M1, U1, _), (M2, U2, _) = ends
        M, _, _ = mechanics(q)
        slope = ((M1 - M2) / 2 * w * w + (U1 - U2)) / 2e-6
        return [*(w * rates), -slope / M]

    found = solve_ivp(rate, (0, seconds), [*start().tolist(), 0.0], rtol=1e-11, atol=1e-12, method="DOP853")
    return found.y[0, -1]


def moved(integrator, h, seconds, robot=None, **more):
    scene = Scene(robot or four_bar(), (DOWN,), integrator=integrator, dt=h)
    return scene, scene.rollout(scene.start(start(), **more), steps=round(seconds / h))


def test_runge_kutta_moves_a_four_bar_linkage_as_its_equation_says_and_keeps_its_energy():
    scene, states = moved(integrators.RungeKutta4(), 1e-3, 1.0)
    assert abs(float(states.q[-1, 0]) - crank(1.0)) < 1e-6
    assert float(torchdq.closure_errors(scene.robot, states.q).distance.max()) < 1e-8
    energy = scene.energy(states).sum(-1)
    assert float((energy - energy[0]).abs().max()) < 1e-7


def test_implicit_steps_are_of_first_order_and_keep_the_loop_closed():
    ends = []
    for h in (2e-3, 1e-3):
        scene, states = moved(integrators.LinearlyImplicit(), h, 0.5)
        ends.append(float(states.q[-1, 0]) - crank(0.5))
        assert float(torchdq.closure_errors(scene.robot, states.q).distance.max()) < 1e-6 * (h / 1e-3) ** 3
    assert abs(ends[0] / ends[1] - 2) < 0.1


def test_steps_of_elastic_loops_are_of_first_order_and_become_those_of_rigid_ones():
    """From a loop that is open, whose spring the first step takes at its end."""
    q, spring = start() + double(0.0, 0.05, 0.0), effects.Closures(2e3, 20.0)

    def end(integrator, h, *parts, at=q):
        scene = Scene(four_bar(), (DOWN, *parts), integrator=integrator, dt=h)
        return scene.rollout(scene.start(at), steps=round(0.2 / h)).q[-1]

    exact = end(integrators.RungeKutta4(), 5e-4, spring)
    errors = [end(integrators.LinearlyImplicit(), h, spring) - exact for h in (1e-3, 5e-4)]
    assert float((errors[0] / errors[1] - 2).abs().max()) < 0.1
    rigid = end(integrators.LinearlyImplicit(), 1e-3, at=start())
    stiff = [end(integrators.LinearlyImplicit(), 1e-3, effects.Closures(k), at=start()) - rigid for k in (1e6, 1e7)]
    assert float((stiff[0] / stiff[1] - 10).abs().max()) < 0.1


def test_computed_torques_of_one_motor_move_a_linkage_along_its_path():
    """From a tenth of a radian beside it; the error decays like that of every joint, to first order in the step."""
    robot, t = four_bar(), torch.arange(500, dtype=F64) * 2e-3
    guess, one = start().expand(500, 3), torch.ones_like(t)

    def path(t):
        return torchdq.closed(robot, torch.cat([1.0 + 0.3 * torch.sin(2 * t)[:, None], guess[:, 1:]], -1), hold="ja")

    (q, qd), (_, qdd) = jvp(lambda t: jvp(path, (t,), (one,)), (t,), (one,))

    def policy(state, k):
        a = qdd[k] + 900 * (q[k] - state.q) + 60 * (qd[k] - state.qd)
        return torchdq.constrained_inverse_dynamics(robot, state.q, state.qd, a, actuated="ja").tau

    scene = Scene(robot, (DOWN,), dt=2e-3)
    first = torchdq.closed(robot, q[0] + double(0.1, 0.0, 0.0), hold="ja")
    errors = (scene.rollout(scene.start(first), steps=499, policy=policy).q - q[1:]).abs().amax(-1)
    assert float(errors[0]) > 0.09 and float(errors[250:].max()) < 2e-3


def test_a_loop_in_float32_stays_with_the_one_in_float64():
    scene = Scene(four_bar(), (DOWN,), dt=1e-3)
    exact, found = (scene.rollout(scene.start(start().to(t)), steps=500).q for t in (F64, torch.float32))
    assert float((exact - found).abs().max()) < 1e-4


def test_a_welded_link_moves_like_a_part_of_the_other():
    """Two links on one trunk; the second one is welded to the first."""
    text = """<mujoco><option gravity="0 0 -9.81"/><worldbody><body name="a"><joint name="j" axis="0 1 0"/>
      <inertial mass="1" pos=".2 0 0" diaginertia=".01 .02 .03"/>
      <body name="b" pos=".3 .1 0"><joint name="k" axis="1 0 0"/>
      <inertial mass=".5" pos="0 .1 .2" diaginertia=".01 .01 .02"/></body></body></worldbody>{}</mujoco>"""
    weld = '<equality><weld body1="a" body2="b"/></equality>'
    held = torchdq.Robot.from_mjcf(text.format(weld), on_unphysical="ignore")
    one = torchdq.Robot.from_mjcf(text.format(""), lock={"k": 0.0})
    scenes = [Scene(r, (effects.Gravity(),), integrator=integrators.RungeKutta4(), dt=2e-3) for r in (held, one)]
    (many, _), (few, _) = ((s.rollout(s.start(torch.zeros(s.robot.n, dtype=F64)), steps=100), s) for s in scenes)
    assert float((many.q[:, 0] - few.q[:, 0]).abs().max()) < 1e-10 and float(many.q[:, 1].abs().max()) < 1e-12


def test_gradients_through_steps_are_those_of_differences():
    scene = Scene(four_bar(), (DOWN, effects.Viscous(0.1)), dt=2e-3)

    def last(q, torque):
        state = scene.start(start())._replace(qd=q)
        return scene.rollout(state, torque.expand(50, 3)).q[-1].square().sum()

    given = (double(0.5, 0.0, 0.0), double(0.2, -0.1, 0.3))
    slopes = torch.autograd.functional.jacobian(last, given)
    for k, x in enumerate(given):
        for i in range(3):
            h = torch.zeros(3, dtype=F64)
            h[i] = 1e-5
            a, b = ([*given[:k], x + s * h, *given[k + 1 :]] for s in (1, -1))
            assert abs(float(slopes[k][i]) - float(last(*a) - last(*b)) / 2e-5) < 1e-8


def test_objects_beside_a_loop_leave_it_as_it_is_unless_they_touch_it():
    far = Ball("ball", mass=0.2, radius=0.05)
    alone = Scene(four_bar(), (DOWN,), dt=2e-3)
    beside = Scene(four_bar(), (DOWN, effects.Contact("end", on="ball")), objects=(far,), dt=2e-3)
    place = torchdq.dq.from_pose(double(1, 0, 0, 0), double(5, 0, 0))[None]
    first, second = (
        alone.rollout(alone.start(start()), steps=50),
        beside.rollout(beside.start(start(), X_WO=place), steps=50),
    )
    assert float((first.q - second.q).abs().max()) < 1e-12


def test_a_start_that_is_not_closed_is_moved_with_a_warning():
    scene = Scene(four_bar(), (DOWN,), dt=1e-3)
    with warned(UserWarning):
        state = scene.start(double(1.0, -0.5, -1.0))
    assert float(torchdq.closure_errors(scene.robot, state.q).distance) < 1e-11
    moving = scene.start(start(), double(2.0, 0.0, 0.0))  # and velocities are those of the linkage
    after = torchdq.closure_errors(scene.robot, moving.q + 1e-6 * moving.qd)
    assert float(after.distance) < 1e-10 and float(moving.qd[0]) > 0.5


def test_a_check_tells_loops_that_are_open_in_its_state():
    scene = Scene(four_bar(), (DOWN,), dt=1e-3)
    state = scene.start(start())
    assert float(scene.closure_errors(state).distance) < 1e-11
    with warned(UserWarning):
        scene.check(state._replace(q=state.q + double(0.0, 0.1, 0.0)), seconds=0.01)
    elastic = scene.replace(effects=(DOWN, effects.Closures(1e4, 10.0)))  # which may be open
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        elastic.check(elastic.start(start() + double(0.0, 0.1, 0.0)), seconds=0.01)


def test_ball_joints_near_a_right_angle_are_warned_of_at_a_start_and_along_a_rollout():
    body = '<body name="a"><joint name="knob" type="ball"/><geom size=".1" pos=".2 0 0"/></body>'
    with warned(UserWarning):
        robot = torchdq.Robot.from_mjcf(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    scene = Scene(robot, (effects.RotorInertia(0.1),), dt=0.01)
    still = scene.start(double(1.6, 1.0, 1.6))
    for turn in (
        lambda: scene.start(double(0.0, 1.4, 0.0)),
        lambda: scene.rollout(still._replace(qd=double(0, 6, 0)), steps=9),
    ):
        with warned(UserWarning):
            turn()


def test_what_does_not_serve_loops_is_refused():
    robot = four_bar()
    for given in (
        {"integrator": integrators.StoermerVerlet()},
        {"controller": controllers.ComputedTorque(1.0, 1.0)},
    ):
        with refused(TorchdqError):
            Scene(robot, (DOWN,), **given)


def test_robots_that_are_cut_or_put_together_keep_their_closures():
    robot = four_bar()
    assert robot.lock({"jb": 0.1}).closures == robot.closures
    assert robot.subchain("ground", "b").closures == ()
    with warned(UserWarning):  # of the mass of its base
        both = robot.attach(robot, "end", prefix="next_")
    assert both.closures == (*robot.closures, Closure("next_pivot", "next_end"))
    heavier = torchdq.Robot.stack([robot, robot.replace(mass=2 * robot.mass, inertia=2 * robot.inertia)])
    assert heavier.closures == robot.closures
    found = torchdq.forward_dynamics(heavier, start(), torch.zeros(3, dtype=F64), torch.zeros(3, dtype=F64))
    assert torch.allclose(found[0], found[1])  # twice as heavy in all links
