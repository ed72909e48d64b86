"""Parameters from rollouts: those of greatest likelihood, with true errors, and nothing that is not identifiable.

The references are finite differences of a scene's step, scipy's least squares over simulated motions, MuJoCo's
simulation of the same arm, and the parameters by which the logs were made.
"""

import mujoco
import numpy as np
import pytest
import torch
from helpers import all_in_one, double, exhaustive, random, thinned
from messages import refused, warned
from scipy import optimize, signal, stats

import torchdq
from torchdq import Scene, effects
from torchdq.backends.call import evaluate
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.learning import LogError, LogWarning, Recording, fit_rollout
from torchdq.learning.rollout import fit, shooting, unknowns
from torchdq.learning.rollout.problem import Problem
from torchdq.learning.rollout.recordings import Commands
from torchdq.scene import controllers, integrators
from torchdq.scene.recording import Stage

BACKEND = "auto"  # thousands of steps one after the other
ROBOT = torchdq.robots.load("two_link")
DT, ROWS = 0.01, 301
TIME = DT * torch.arange(ROWS, dtype=torch.float64)
NOISE = 1e-3  # [rad]
RULE = integrators.RungeKutta4()


def driving(time):
    """Torques that excite both joints [N m]."""
    return 8 * torch.stack([(5 * time).sin() + 0.5 * (11 * time).cos(), 0.6 * (7 * time).cos()], -1)


def moved(scene, inputs, start=None, rows=ROWS):
    """Positions at the start and after each step."""
    state = scene.start(torch.zeros(scene.n, dtype=torch.float64) if start is None else start)
    given = {name: x[: rows - 1] for name, x in inputs.items()}
    return torch.cat([state.q[None], scene.rollout(state, steps=rows - 1, **given).q])


def with_friction(viscous, coulomb, rotor):
    """A scene with friction and rotors."""
    parts = (effects.Gravity(), effects.Viscous(viscous), effects.Coulomb(coulomb, 0.05), effects.RotorInertia(rotor))
    return Scene(ROBOT, parts, integrator=RULE, dt=DT)


def noisy(q, seed, size=NOISE):
    return q + size * random(*q.shape, seed=seed)


def logged(q, **changes):
    """Recording of a motion under the driving torques."""
    return Recording(TIME, q, {"torque": driving(TIME)}, **changes)


def chi_square_of(off, found):
    """Deviations of parameters, in their stated covariance."""
    return float(off @ torch.linalg.solve(found.covariance, off))


def worst_z(found, *true):
    """Greatest deviation from the true parameters, in standard errors."""
    return float(((found.estimate - double(*true)) / found.covariance.diagonal().sqrt()).abs().max())


FRICTION = ("Viscous.coefficient", "Coulomb.coulomb", "RotorInertia.inertia")
TRUE = double(0.5, 0.3, 0.4, 0.2, 0.05, 0.03)
REAL = with_friction(*TRUE.reshape(3, 2))


@pytest.fixture(scope="module")
def motion():
    """Positions of a scene with the true parameters."""
    return moved(REAL, {"torque": driving(TIME)})


@pytest.fixture(scope="module")
def guess():
    return with_friction(0.1, 0.1, 0.01)


# --- derivatives -----------------------------------------------------------------------------------------------------


def test_derivatives_of_a_step_are_finite_differences():
    parts = (effects.Gravity(), effects.FirstOrderLag(double(0.02, 0.02)), effects.Servo(double(60.0, 60.0), 5.0))
    scene = Scene(ROBOT, (*parts, effects.Coulomb(double(0.3, 0.3), 0.1)), dt=0.01)
    s, torque, target = random(3, 10).split((6, 2, 2), -1)

    def evaluated(state, lag, target, wrt=None):
        rows = dict(zip(scene.spec.state, state.split(2, -1), strict=True))
        given = {**rows, "target": target, "torque": torque, **scene.parameters, "1.time": lag}
        return evaluate(Stage(scene.spec, "step", wrt=wrt), given)

    def after(**changed):
        return torch.cat(list(evaluated(**{**at, **changed}).values()), -1)

    at = {"state": s, "lag": double(0.02, 0.02), "target": target}
    reached, *slopes = evaluated(**at, wrt=("1.time", "target")).values()
    torch.testing.assert_close(reached, after(), rtol=0, atol=1e-13)
    for slope, (name, x) in zip(slopes, at.items(), strict=True):
        h = 1e-8 if name == "lag" else 1e-6
        steps = h * torch.eye(x.shape[-1], dtype=torch.float64)
        sides = [(after(**{name: x + e}) - after(**{name: x - e})) / (2 * h) for e in steps]
        tolerance = 1e-5 if name == "lag" else 1e-6
        torch.testing.assert_close(slope, torch.stack(sides, -1), rtol=tolerance, atol=tolerance)


def test_means_and_slopes_of_commands_are_those_of_a_fine_sum():
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.5, 1.5, 40))
    commands = Commands(time, rng.normal(size=(40, 2)))
    start, span = rng.uniform(-2, 45, 30), 2.3
    fine = start[:, None] + span * (np.arange(20000) + 0.5) / 20000
    held = commands.values[np.clip(np.searchsorted(time, fine, side="right") - 1, 0, 39)]
    np.testing.assert_allclose(commands.mean(start, span), held.mean(1), atol=1e-3)
    slope = (commands.mean(start + 1e-4, span) - commands.mean(start - 1e-4, span)) / 2e-4
    np.testing.assert_allclose(commands.slope(start, span), slope, atol=1e-8)
    np.testing.assert_array_equal(commands.mean(time[:-1], 1e-3), commands.values[:-1])


@all_in_one([(99, 21), (9, 9), (30, 5), (4, 3), (2, 1)])
def test_slopes_at_the_first_nodes_are_those_of_savitzky_and_golay(case):
    rows, window = case
    x = np.random.default_rng(0).normal(size=(rows, 3))
    expected = signal.savgol_filter(x, window, min(3, window - 1), deriv=1, axis=0)
    np.testing.assert_allclose(shooting.slopes(x, window), expected, atol=1e-12)


# --- the parameters of greatest likelihood ---------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@all_in_one(thinned([None, 1.0, 0.1], [None, 0.1]))
def test_exact_logs_give_the_exact_parameters(segment, motion, guess):
    before = guess.effects
    found = fit_rollout(guess, logged(motion), FRICTION, segment, integrator=RULE)
    assert guess.effects == before
    torch.testing.assert_close(found.estimate, TRUE, rtol=1e-7, atol=0)
    assert not found.unidentifiable and not found.warning and float(found.rms.max()) < 1e-12
    again = moved(found.scene, {"torque": driving(TIME)})
    torch.testing.assert_close(again, motion, rtol=0, atol=1e-8)


def test_it_is_the_least_squares_over_simulated_motions(motion, guess):
    """One motion with one start, by a library that knows nothing of shooting, with its own finite differences."""
    measured = noisy(motion, 5)
    found = fit_rollout(guess, logged(measured), FRICTION, segment=None, integrator=RULE)
    weight = 1 / found.noise

    def residuals(x):
        """Weighted residuals of every row of parameters and start [rows, 10]."""
        viscous, coulomb, rotor, q, qd = torch.from_numpy(x).split(2, -1)
        scene = with_friction(viscous, coulomb, rotor)
        states = torch.cat([q[None], scene.rollout(scene.start(q, qd), torque=driving(TIME)[:-1]).q])
        return (weight * (states - measured[:, None])).transpose(0, 1).flatten(1).numpy()

    def slopes(x):
        h = 1e-6 * np.eye(10)
        return ((residuals(x + h) - residuals(x - h)) / 2e-6).T

    start = np.concatenate([TRUE.numpy(), measured[0].numpy(), np.zeros(2)])
    reference = optimize.least_squares(lambda x: residuals(x[None])[0], start, slopes, x_scale="jac", xtol=1e-10)
    covariance = np.linalg.inv(reference.jac.T @ reference.jac)[:6, :6]
    errors = np.sqrt(covariance.diagonal())
    assert (abs(found.estimate.numpy() - reference.x[:6]) < 0.02 * errors).all()
    np.testing.assert_allclose(found.covariance.diagonal().sqrt(), errors, rtol=0.02)


def chi_squares(motion, guess, runs, segment):
    """Deviations from the true parameters, in their stated covariance, of logs that differ by their noise."""
    for seed in range(runs):
        found = fit_rollout(guess, logged(noisy(motion, seed)), FRICTION, segment=segment, integrator=RULE)
        yield chi_square_of(found.estimate - TRUE, found)


def test_the_errors_are_as_large_as_they_are_said_to_be(motion, guess):
    total = sum(chi_squares(motion, guess, 12, 1.0))
    assert stats.chi2(72).ppf(1e-3) < total < stats.chi2(72).ppf(1 - 1e-3)


@exhaustive
@pytest.mark.parametrize("segment", [None, 1.0])
def test_the_errors_of_two_hundred_runs_are_chi_square(motion, guess, segment):
    found = list(chi_squares(motion, guess, 200, segment))
    assert stats.kstest(found, stats.chi2(6).cdf).pvalue > 1e-3


ARM = """<mujoco><option timestep="{step}" integrator="{integrator}"/><worldbody>
    <body><inertial pos="0.2 0 0" mass="2" diaginertia="0.02 0.02 0.02"/><joint name="a" axis="0 1 0" damping="0.7"
      armature="0.3"/>
      <body pos="0.4 0 0"><inertial pos="0.1 0.05 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <joint name="b" axis="0 0 1" damping="0.2" armature="0.1"/></body></body></worldbody>
    <actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""
DAMPING, WIDTH = double(0.7, 0.2), 0.02  # [N m s/rad], [rad/s]


def with_noise(log, seed):
    return log._replace(q=noisy(torch.from_numpy(log.q), seed, 2e-4))


def by_mujoco(rows, dt, steps, integrator, coulomb=(0.0, 0.0)):
    """Recording of an arm that MuJoCo moves, in a number of its steps from row to row, with smooth dry friction."""
    model = mujoco.MjModel.from_xml_string(ARM.format(step=dt / steps, integrator=integrator))
    data, time = mujoco.MjData(model), dt * np.arange(rows)
    torque, q = np.stack([6 * np.sin(4 * time), 2 * np.cos(6 * time)], -1), []

    def friction(model, data):
        data.qfrc_passive[:] -= coulomb * data.qvel / np.sqrt(data.qvel**2 + WIDTH**2)

    mujoco.set_mjcb_passive(friction if any(coulomb) else None)
    try:
        for u in torque:
            q.append(data.qpos.copy())
            data.ctrl[:] = u
            mujoco.mj_step(model, data, steps)
    finally:
        mujoco.set_mjcb_passive(None)
    return Recording(time, np.stack(q), {"torque": torque})


def arm_guess(dt, *parts):
    robot = torchdq.Robot.from_mjcf(ARM.format(step=dt, integrator="RK4"))
    return Scene(robot, (effects.Gravity(), effects.Viscous(0.05), *parts), dt=dt)


def test_positions_of_another_simulator():
    """MuJoCo's implicit integrator is the scene's: its parameters are found to rounding, from positions alone."""
    scene = arm_guess(0.005, effects.RotorInertia(0.02))
    log = by_mujoco(400, 0.005, 1, "implicitfast")
    found = fit_rollout(scene, log, ("Viscous.*", "RotorInertia.*"), integrator=scene.integrator)
    torch.testing.assert_close(found.estimate, double(0.7, 0.2, 0.3, 0.1), rtol=1e-6, atol=0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("dt", thinned([0.005, 0.02], [0.005]))
@pytest.mark.parametrize(
    "coulomb", thinned([(0.0, 0.0), (0.5, 0.2)], [(0.5, 0.2)]), ids=lambda x: "dry" if any(x) else "viscous"
)
def test_errors_are_those_of_a_motion_in_continuous_time(dt, coulomb):
    """Whatever the steps of the scene: a first-order step of 5 ms is tens of standard errors wrong."""
    log = by_mujoco(round(2 / dt), dt, round(dt / 5e-4), "RK4", coulomb)
    rotors = effects.RotorInertia(double(0.3, 0.1))
    parts, learn, true = (rotors,), ["Viscous.coefficient"], DAMPING
    if any(coulomb):
        parts, true = (rotors, effects.Coulomb(0.05, WIDTH)), torch.cat([DAMPING, double(*coulomb)])
        learn.append("Coulomb.coulomb")
    guess, total, runs = arm_guess(dt, *parts), 0.0, 3
    for seed in range(runs):
        found = fit_rollout(guess, with_noise(log, seed), learn)
        total += chi_square_of(found.estimate - true, found)
    chi_square = stats.chi2(runs * len(true))
    assert chi_square.ppf(1e-4) < total < chi_square.ppf(1 - 1e-4)
    # the scene that is returned moves as recorded
    start = found.scene.start(torch.from_numpy(log.q[0]))
    again = found.scene.rollout(start, torch.from_numpy(log.inputs["torque"])[:-1]).q
    assert float((again - torch.from_numpy(log.q[1:])).square().mean().sqrt()) < 2e-3
    assert (found.scene.substeps == 1) == (not any(coulomb))


def test_first_order_steps_are_told_by_correlated_residuals():
    scene = arm_guess(0.005, effects.RotorInertia(double(0.3, 0.1)))
    log = with_noise(by_mujoco(400, 0.005, 10, "RK4"), 0)
    with warned(LogWarning):
        found = fit_rollout(scene, log, "Viscous.coefficient", integrator=scene.integrator)
    assert worst_z(found, *DAMPING.tolist()) > 10


@exhaustive
def test_errors_that_shorter_steps_contradict_are_wider(monkeypatch):
    """Where no integrator is fine enough, the change by the finest is a standard error, too."""
    coulomb = (0.5, 0.2)
    scene = arm_guess(0.02, effects.RotorInertia(double(0.3, 0.1)), effects.Coulomb(0.05, WIDTH))
    log = with_noise(by_mujoco(100, 0.02, 40, "RK4", coulomb), 0)
    learn = ("Viscous.coefficient", "Coulomb.coulomb")
    fine = fit_rollout(scene, log, learn)
    monkeypatch.setattr(fit, "FINER", (64,))
    with warned(LogWarning):
        coarse = fit_rollout(scene, log, learn)
    by_fine, by_coarse = (chi_square_of(coarse.estimate - fine.estimate, x) for x in (fine, coarse))
    assert by_coarse < stats.chi2(4).ppf(1 - 1e-3) < stats.chi2(4).ppf(1 - 1e-8) < by_fine
    assert worst_z(coarse, *DAMPING.tolist(), *coulomb) < 4


# --- hard cases ------------------------------------------------------------------------------------------------------


@exhaustive
def test_stiff_friction():
    """Friction that stops a joint within a step, over many reversals."""
    dt = 0.005
    time = dt * torch.arange(301, dtype=torch.float64)
    both = ((effects.Viscous(0.2), effects.Coulomb(level, 0.005)) for level in ((1.5, 1.0), 0.2))
    real, wrong = (Scene(ROBOT, parts, integrator=RULE, dt=dt, substeps=64, unroll=False) for parts in both)
    inputs = {"torque": driving(time)}
    log = Recording(time, noisy(moved(real, inputs), 1, 1e-4), inputs)
    found = fit_rollout(wrong, log, ("Coulomb.coulomb", "Viscous.coefficient"), integrator=RULE)
    assert worst_z(found, 1.5, 1.0, 0.2, 0.2) < 4
    assert float(found.rms.max()) < 1.1e-4


@pytest.fixture(scope="module")
def late():
    """A scene with a lag, and the function that logs it behind a delay that is no number of steps."""
    scene = Scene(ROBOT, (effects.Viscous(0.5), effects.FirstOrderLag(0.02)), dt=DT)

    def log(speed, size):
        torque = driving(speed * TIME)
        acting = torch.from_numpy(Commands(TIME.numpy(), torque.numpy()).mean((TIME - 0.0137).numpy(), DT))
        return Recording(TIME, noisy(moved(scene, {"torque": acting}), 2, size), {"torque": torque})

    return scene, log


def test_delay_and_lag_are_identifiable_from_fast_commands(late):
    scene, log = late
    start = scene.replace(effects=(effects.Viscous(0.1), effects.FirstOrderLag(0.005)))
    learn = ("delay", "FirstOrderLag.time", "Viscous.coefficient")
    found = fit_rollout(start, log(1.0, 1e-4), learn, integrator=scene.integrator)
    assert worst_z(found, 0.0137, 0.02, 0.02, 0.5, 0.5) < 4 and not found.unidentifiable
    assert found.delay == float(found.values["delay"]) and 0 < float(found.errors["delay"]) < 1e-3


def test_delay_and_lag_are_named_as_unidentifiable_from_slow_commands(late):
    scene, log = late
    found = fit_rollout(scene, log(0.1, 1e-2), ("delay", "FirstOrderLag.time"), integrator=scene.integrator)
    assert found.values["delay"].isnan() and found.values["FirstOrderLag.time"].isnan().all()
    assert any("delay by" in text and "FirstOrderLag.time" in text for text in found.unidentifiable)
    assert "unidentifiable" in str(found)


def test_scales_that_are_unidentifiable_from_positions_are_named():
    """A servo of unknown gains that moves unknown masses: only their ratios show, and the scene moves as logged."""
    parts = (effects.Servo(100.0, 10.0), effects.RotorInertia(0.5), effects.MassScale(1.0))
    target = torch.stack([(3 * TIME).sin(), 0.6 * (5 * TIME).cos()], -1)
    real = Scene(ROBOT, parts, integrator=RULE, dt=DT)
    log = Recording(TIME, noisy(moved(real, {"target": target}), 3, 1e-4), {"target": target})
    wrong = real.replace(effects=(effects.Servo(60.0, 5.0), effects.RotorInertia(0.3), effects.MassScale(1.2)))
    found = fit_rollout(wrong, log, ("Servo.*", "RotorInertia.inertia", "MassScale.factor"), integrator=RULE)
    # the scale of all, and what the first link adds to its rotor
    assert len(found.unidentifiable) == 2 and all(x.isnan().all() for x in found.values.values())
    names = ("Servo.kp[joint1]", "Servo.kd[joint2]", "RotorInertia.inertia[joint2]", "MassScale.factor[link2]")
    assert any(all(name in text for name in names) for text in found.unidentifiable)
    assert float(found.rms.max()) < 1.1e-4
    servo = found.scene.effects[0]
    torch.testing.assert_close(servo.kp / servo.kd, double(10.0, 10.0), rtol=2e-3, atol=0)
    rotors_known = wrong.replace(effects=(effects.Servo(60.0, 5.0), effects.RotorInertia(0.5)))
    known = fit_rollout(rotors_known, log, "Servo.*", integrator=RULE)
    assert not known.unidentifiable
    torch.testing.assert_close(known.estimate, double(100.0, 100.0, 10.0, 10.0), rtol=5e-3, atol=0)


def test_a_payload_is_found_from_far_away():
    parts = effects.Gravity((0.0, -9.81, 0.0)), effects.Viscous(0.5)
    real, light, heavy = (
        Scene(ROBOT, (*parts, effects.Payload(mass)), integrator=RULE, dt=DT) for mass in (1.7, 1e-3, 20.0)
    )
    log = logged(moved(real, {"torque": driving(TIME)}))
    for start in (light, heavy):
        assert abs(float(fit_rollout(start, log, "Payload.mass", integrator=RULE).estimate) - 1.7) < 1e-6


def test_links_stay_bodies_and_unidentifiable_masses_are_named():
    axes = [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]]  # the first link is on its upright axis
    coms, ball = [[0.0, 0.0, 0.1], [0.3, 0.0, 0.0]], [0.02, 0.0, 0.02, 0.0, 0.0, 0.02]
    robot = torchdq.Robot.from_screws(axes, [2.0, 1.0], coms, [ball] * 2, gravity=(0.0, 0.0, -9.81))
    scene = Scene(robot, (effects.Gravity(), effects.Viscous(1.0)), integrator=RULE, dt=DT)
    log = logged(noisy(moved(scene, {"torque": driving(TIME)}), 0, 1e-5))
    wrong = scene.replace(robot=robot.replace(mass=1.2 * robot.mass))
    found = fit_rollout(wrong, log, "mass", integrator=RULE)
    assert found.values["mass"][0].isnan() and len(found.unidentifiable) == 1
    assert float(found.values["mass"][1]) == pytest.approx(1.0, rel=1e-3)
    assert (found.scene.robot.mass > 0).all() and float(found.rms.max()) < 2e-5


def test_two_logs_of_other_lengths(motion, guess):
    second = moved(REAL, {"torque": -driving(TIME)}, double(0.5, 0.2), rows=120)
    logs = [logged(noisy(motion, 0)), Recording(TIME[:120] + 3.0, noisy(second, 1), {"torque": -driving(TIME)[:120]})]
    found, alone = (fit_rollout(guess, some, FRICTION, 0.7, integrator=RULE) for some in (logs, logs[:1]))
    assert [len(x) for x in found.residuals] == [ROWS, 120]
    assert worst_z(found, *TRUE.tolist()) < 4
    assert (found.covariance.diagonal() < alone.covariance.diagonal()).all()


def test_rows_at_other_times_than_steps(guess):
    """A scene whose steps are finer than the log, and stamps that miss them."""
    fine, coarse = REAL.replace(dt=0.001), guess.replace(dt=0.002)
    time = 0.001 * torch.arange(2001, dtype=torch.float64)
    rows = torch.arange(0, 2001, 20)
    rows[1:-1] += torch.randint(-3, 4, (99,), generator=torch.Generator().manual_seed(0))
    held = torch.bucketize(time, time[rows], right=True) - 1
    torque = driving(time[rows])
    q = moved(fine, {"torque": torque[held]}, rows=2001)[rows]
    found = fit_rollout(coarse, Recording(time[rows], q, {"torque": torque}), FRICTION, integrator=RULE)
    torch.testing.assert_close(found.estimate, TRUE, rtol=5e-3, atol=0)
    assert float(found.rms.max()) < 1e-4


def test_measured_velocities_and_a_controller():
    """A controller with unknown gains, driven by its reference; velocities are measured as well."""
    gains = [(controllers.PD(*kp_kd), (effects.Gravity(),)) for kp_kd in ((80.0, 8.0), (40.0, 10.0))]
    real, wrong = (Scene(ROBOT, parts, controller=control, integrator=RULE, dt=DT) for control, parts in gains)
    reference = torch.cat([(3 * TIME[:, None] + double(0.0, 1.0)).sin(), torch.zeros(ROWS, 4, dtype=torch.float64)], -1)
    state = real.start(double(0.0, 0.8))
    after = real.rollout(state, steps=ROWS - 1, reference=reference[:-1])
    q, qd = (torch.cat([getattr(state, name)[None], getattr(after, name)]) for name in ("q", "qd"))
    log = Recording(TIME, noisy(q, 0), {"reference": reference}, qd=noisy(qd, 1, 0.01))
    found = fit_rollout(wrong, log, ("PD.kp", "PD.kd"), integrator=RULE)
    assert worst_z(found, 80.0, 80.0, 8.0, 8.0) < 4 and found.noise.shape == (2,)


# --- ends and errors -------------------------------------------------------------------------------------------------


def test_an_interrupted_search_returns_what_it_found(motion, guess, monkeypatch):
    calls, linearised = [], Problem.linearised

    def interrupted(self, at):
        calls.append(at)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return linearised(self, at)

    monkeypatch.setattr(Problem, "linearised", interrupted)
    with warned(LogWarning):
        found = fit_rollout(guess, logged(noisy(motion, 0)), FRICTION, integrator=RULE)
    assert torch.isfinite(found.estimate).all() and "interrupted" in found.warning


def test_a_part_that_the_scene_cannot_follow_is_named(motion, guess):
    q = noisy(motion, 0, 1e-4)
    q[150:155] += 0.02  # a slip of the encoder
    with warned(LogWarning):
        fit_rollout(guess, logged(q, name="slip"), FRICTION, integrator=RULE)


STILL = torch.zeros(20, 2)
LOG = Recording(TIME[:20], STILL, {"torque": STILL})
RUBBING = Scene(ROBOT, (effects.Viscous(0.1), effects.Coulomb(0.0)), dt=DT)
SERVO = Scene(ROBOT, (effects.Servo(100.0, 10.0), effects.FirstOrderLag(0.01)), dt=DT)


def with_value(x, at, value):
    changed = x.clone()
    changed[at] = value
    return changed


def refit(log, learn="Viscous.coefficient", scene=RUBBING, **options):
    return lambda: fit_rollout(scene, log, learn, **options)


MISUSE = {
    "not finite": refit(LOG._replace(q=with_value(LOG.q, (7, 1), torch.nan))),
    "time that stands": refit(LOG._replace(name="b", time=with_value(LOG.time, 4, 0.0))),
    "wide input": refit(LOG._replace(inputs={"torque": torch.zeros(20, 3)})),
    "fewer rows": refit(LOG._replace(q=torch.zeros(19, 2))),
    "unknown input": refit(LOG._replace(inputs={"tau": STILL})),
    "no inputs by name": refit(LOG._replace(inputs=None)),
    "rows between steps": refit(LOG._replace(time=TIME[:20] / 10)),
    "other signals": refit([LOG, LOG._replace(qd=LOG.q)]),
    "no recording": refit({"q": 1}),
    "misspelt parameter": refit(LOG, "Viscos.coefficient"),
    "parameter of zero": refit(LOG, "Coulomb.coulomb"),
    "no name": refit(LOG, 3),
    "negative segment": refit(LOG, segment=-1.0),
    "missing input": refit(LOG, "Servo.kp", SERVO),
    "sensors": refit(LOG, scene=RUBBING.replace(effects=(effects.Viscous(0.1), effects.Noise(0.1)))),
    "class of integrators": refit(LOG, integrator=integrators.RungeKutta4),
    "delay of nothing": refit(LOG._replace(inputs={}), "delay"),
    # a servo is no command to the actuators: a lag would follow the noise of the positions
    "actuator without command": refit(LOG._replace(inputs={"target": STILL}), "FirstOrderLag.time", SERVO),
    "actuator at zero": refit(LOG._replace(inputs={"target": STILL, "torque": STILL}), "FirstOrderLag.*", SERVO),
}


@all_in_one(MISUSE)
def test_misuse_is_refused(misuse):
    with refused((ArgumentError, UnknownNameError, LogError)):
        MISUSE[misuse]()


def test_from_a_scene_that_cannot_follow_nothing_is_identifiable(guess):
    torque = 5 * driving(TIME)
    log = Recording(TIME, moved(REAL, {"torque": torque}), {"torque": -torque})
    with warned(LogWarning):
        found = fit_rollout(guess, log, FRICTION, iterations=1, integrator=RULE)
    assert all(x.isnan().all() for x in (*found.values.values(), *found.errors.values()))
    assert "does not move" in found.warning


def test_positive_numbers_stay_positive_however_long_the_step():
    """An unidentifiable mass may be taken far down: exp(-step) alone would be zero, and no body."""
    value = np.array([2.0, 3.0])
    after = unknowns.PositiveNumbers("", "", (), value, np.arange(2)).moved(value, np.array([-1e6, 0.5]))
    assert after[0] > 0 and after[1] == 3.5
