"""Controllers: their equations, the model that they believe in, and gains that may be learned."""

import dataclasses
import itertools

import pytest
import torch
from helpers import called, double, exhaustive, random, thinned
from messages import refused
from scenes import ARM, KD, KP, PANDA, TREE

import torchdq
from torchdq import Scene, dq, effects
from torchdq.errors import ArgumentError
from torchdq.scene import State
from torchdq.scene.controllers import PD, CartesianImpedance, ComputedTorque, OperationalSpaceControl
from torchdq.scene.integrators import ExplicitEuler, RungeKutta4, SemiImplicitEuler


def reference(t, n):
    """Positions, velocities and accelerations of n joints."""
    w = torch.arange(1, n + 1, dtype=torch.float64) / 3
    return torch.cat([0.5 * (w * t).sin(), 0.5 * w * (w * t).cos(), -0.5 * w**2 * (w * t).sin()])


HELD = (effects.Gravity(), effects.RotorInertia(0.2), effects.Payload(double(0.3, 1.0, 2.0), (0.0, 0.05, 0.1)))


@pytest.mark.parametrize(
    ("robot", "integrator"),
    thinned(
        [*itertools.product((ARM, PANDA), (ExplicitEuler(), SemiImplicitEuler()))],
        [(ARM, ExplicitEuler())],
    ),
    ids=lambda x: getattr(x, "name", type(x).__name__),
)
def test_computed_torque_makes_any_arm_a_double_integrator(robot, integrator):
    """Gravity, rotors and payload of the scene included, Euler's steps are those of q'' = commanded, to 1e-9."""
    n, h, q, qd = robot.n, 0.02, random(3, robot.n) * 0.3, random(3, robot.n, seed=1)
    scene = Scene(robot, HELD, ComputedTorque(KP, KD), integrator, dt=h)
    state = scene.start(q, qd)
    for k in range(50):
        r = reference(k * h, n)
        state = scene.step(state, reference=r)
        a = r[2 * n :] + KD * (r[n : 2 * n] - qd) + KP * (r[:n] - q)
        q, qd = (q + h * qd, qd + h * a) if integrator == ExplicitEuler() else (q + h * (qd + h * a), qd + h * a)
        assert (state.q - q).abs().max() < 1e-9
        assert (state.qd - qd).abs().max() < 1e-9
    assert (q - reference(1.0, n)[:n]).abs().max() < 0.1


def tracking_error(dt, integrator):
    """Of the arm after a second, less that of e'' + kd e' + kp e = 0 by a matrix exponential."""
    scene = Scene(ARM, (effects.Gravity(),), ComputedTorque(KP, KD), integrator, dt)
    state = scene.start(double(0.5, -0.3), double(0.2, 0.1))
    start = torch.stack([reference(0.0, 2)[:2] - state.q, reference(0.0, 2)[2:4] - state.qd])
    for k in range(round(1 / dt)):
        state = scene.step(state, reference=reference(k * dt, 2))
    e = (torch.matrix_exp(double((0.0, 1.0), (-KP, -KD))) @ start)[0]
    return reference(1.0, 2)[:2] - state.q - e


@pytest.mark.parametrize("integrator", thinned([SemiImplicitEuler(), RungeKutta4()], [RungeKutta4()]), ids=called)
def test_the_error_equation_holds_up_to_holding_the_torque_over_a_step(integrator):
    errors = [float(tracking_error(dt, integrator).norm()) for dt in (0.02, 0.01)]
    assert errors[0] < 0.02
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.15)


def test_pd_is_its_formula_and_torques_add_to_it():
    q, qd, r, u = random(4, 3), random(4, 3, seed=1), random(4, 9, seed=2), random(4, 3, seed=3)
    kp, kd = [1.0, 2.0, 3.0], double(0.1, 0.2, 0.3)
    tau = u + double(*kp) * (r[:, :3] - q) + kd * (r[:, 3:6] - qd)
    gravity = torchdq.inverse_dynamics(TREE, q, torch.zeros_like(q), torch.zeros_like(q))
    for model, more in ((None, 0.0), (TREE, gravity)):
        found = Scene(TREE, controller=PD(kp, kd, model=model)).step(State(q, qd), u, reference=r)
        assert torch.allclose(found.qd, Scene(TREE).step(State(q, qd), tau + more).qd, rtol=1e-12, atol=1e-11)


def test_a_controller_sees_readings():
    """A position read a tenth too large is a reference a tenth too small."""
    q, qd, r = double(0.3, -0.4), double(0.5, 0.6), random(6)
    biased = Scene(ARM, (effects.Bias(0.1, -0.2),), PD(10.0, 1.0))
    shifted = r - double(0.1, 0.1, -0.2, -0.2, 0.0, 0.0)
    found = biased.step(biased.start(q, qd), reference=r)
    assert torch.allclose(found.qd, Scene(ARM, controller=PD(10.0, 1.0)).step(State(q, qd), reference=shifted).qd)


def test_gains_may_be_learned():
    q, qd, r = random(5, 2), random(5, 2, seed=1), random(5, 6, seed=2)

    def end(kp, kd):
        return Scene(ARM, (effects.Gravity(),), ComputedTorque(kp, kd)).step(State(q, qd), reference=r).qd

    assert torch.autograd.gradcheck(
        end, [double(3.0, 4.0).requires_grad_(), random(5, 2, seed=3).abs().requires_grad_()]
    )


LEARNED = ARM.replace(mass=ARM.mass.clone().requires_grad_())
MODELS = {"other joints": PANDA, "several": ARM.replace(mass=ARM.mass * double(1.0, 2.0)[:, None]), "learned": LEARNED}


@pytest.mark.parametrize("controller", [ComputedTorque, PD])
@pytest.mark.parametrize("model", MODELS)
def test_a_model_that_is_not_one_constant_robot_with_these_joints_is_refused(model, controller):
    with refused(ArgumentError):
        Scene(ARM, controller=controller(1.0, 1.0, model=MODELS[model]))
    Scene(ARM, controller=controller(1.0, 1.0, model=LEARNED.bake()))


@pytest.mark.parametrize("controller", [ComputedTorque, PD])
def test_a_model_is_copied_when_a_scene_is_made(controller):
    """Writing into its mass changes no scene that is there, and every later one, although the object is the same."""
    mass = ARM.mass.clone()
    given = controller(20.0, 5.0, model=ARM.replace(mass=mass))

    def stepped(scene):
        return scene.step(State(double(0.3, -0.4), double(0.0, 0.0)), reference=random(6)).qd

    def made(controller):
        return Scene(ARM, (effects.Gravity(),), controller, dt=0.05)

    before = made(given)
    found = stepped(before)
    mass.mul_(2)
    assert torch.equal(stepped(before), found)
    assert torch.equal(before.controller.model.mass, ARM.mass)
    later = dataclasses.replace(given, model=ARM.replace(mass=2 * ARM.mass))
    assert torch.equal(stepped(made(given)), stepped(made(later)))
    assert not torch.equal(stepped(made(given)), found)


# --- control of a frame ----------------------------------------------------------------------------------------------

UR = torchdq.robots.load("ur10e")
SIX = double(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
GOAL = {"q_des": random(4, 7, seed=5), "qd_des": random(4, 7, seed=6), "qdd_des": random(4, 7, seed=7)}
GOAL |= {"X_des": random(4, 8, seed=2), "V_des": random(4, 6, seed=3), "A_des": random(4, 6, seed=4)}
POSTURE = random(7, seed=8)
LAWS = {
    "computed torque": ComputedTorque(100.0, 20.0),
    "PD": PD(random(7).abs(), 9.0),
    "PD of a model": PD(100.0, 20.0, model=PANDA),
    "pose": OperationalSpaceControl(100.0, 20.0),
    "gains and posture": OperationalSpaceControl(10 * SIX, 2 * SIX, expressed="world", q_null=POSTURE, k_null=3.0),
    "limits": OperationalSpaceControl(90.0, 9.0, axes=("x", "z"), limits=True, damping=0.1),
    "spring": CartesianImpedance(300.0, 30.0, axes="position", q_null=POSTURE),
    "body": CartesianImpedance(90 * SIX, SIX, expressed="body"),
    "passive": CartesianImpedance(90 * SIX, SIX, coriolis=False),
}
FACES = {
    ComputedTorque: torchdq.computed_torque,
    OperationalSpaceControl: torchdq.operational_space_control,
    CartesianImpedance: torchdq.cartesian_impedance,
}


@pytest.mark.parametrize("case", thinned(LAWS, ("computed torque", "pose", "spring")))
def test_a_law_is_the_same_as_function_layer_controller_and_program(case):
    """With gravity in the scene, and with poses of any norm."""
    law, q, qd = LAWS[case], random(4, 7), random(4, 7, seed=1)
    goal = [GOAL[name] for name in law.GOAL]
    tau = law(PANDA, q, qd, *goal)
    if type(law) in FACES:
        given = {name: x for name, x in vars(law).items() if name not in ("model", "task")}
        assert torch.equal(FACES[type(law)](PANDA, q, qd, *goal, **given), tau)
    bare, whole = (torchdq.nn.Control(PANDA, law, friction=friction) for friction in (False, True))
    assert torch.allclose(bare(q, qd, *goal), tau, rtol=1e-14)
    assert torch.allclose(whole(q, qd, *goal), tau + whole.friction_torque(qd), rtol=1e-13)
    assert not list(bare.parameters()) and {*law.tensors()} <= bare.state_dict().keys()
    program = torchdq.compile(PANDA, law)
    assert torch.allclose(program(q, qd, *goal, *program.examples.values()), tau, rtol=1e-12, atol=1e-12)
    free, controlled = (Scene(PANDA, (effects.Gravity(),), controller=x) for x in (None, law))
    found, expected = controlled.step(State(q, qd), reference=torch.cat(goal, -1)), free.step(State(q, qd), tau)
    assert torch.allclose(found.qd, expected.qd, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("case", ["computed torque", "pose", "spring"])
def test_a_controller_with_a_model_is_the_function_of_that(case):
    law, q, qd, model = LAWS[case], random(4, 7), random(4, 7, seed=1), PANDA.replace(mass=1.1 * PANDA.mass)
    goal = [GOAL[name] for name in law.GOAL]
    believing = Scene(PANDA, (effects.Gravity(),), dataclasses.replace(law, model=model))
    found = believing.step(State(q, qd), reference=torch.cat(goal, -1))
    expected = Scene(PANDA, (effects.Gravity(),)).step(State(q, qd), law(model, q, qd, *goal))
    assert torch.allclose(found.qd, expected.qd, rtol=1e-10, atol=1e-10)


@exhaustive
def test_small_steps_have_the_poles_of_the_error_equation():
    """Six of each root of s^2 + kd s + kp, up to the step, around a pose that is held."""
    q, dt = double(0.1, -1.0, 1.2, 0.3, 0.8, 0.2), 1e-5
    scene = Scene(UR, (effects.Gravity(),), OperationalSpaceControl(100.0, 29.0), SemiImplicitEuler(), dt)
    reference = scene.controller.holding(UR, q)
    assert torch.allclose(scene.step(scene.start(q), reference=reference).q, q, atol=1e-15)
    poles = torch.linalg.eigvals(scene.linearize(scene.start(q), reference=reference).A).log() / dt
    assert poles.imag.abs().max() < 1e-3
    assert torch.allclose(poles.real.sort().values, double(*[-25.0] * 6, *[-4.0] * 6), rtol=1e-3)


def test_a_rollout_follows_a_screw_path():
    """Up to the torque that is held over a step, which is of first order in it."""
    q, worst, control = double(0.1, -1.0, 1.2, 0.3, 0.8, 0.2), [], OperationalSpaceControl(100.0, 20.0)
    X = torchdq.forward_kinematics(UR, q, UR.tip)
    Y = dq.mul(X, dq.exp(double(0.15, -0.2, 0.1, 0.02, 0.05, 0.02)))
    for steps in (100, 200):
        t = torch.arange(steps, dtype=torch.float64) / steps
        way = dq.screw_path(X, Y, t**2 * (3 - 2 * t), 6 * t * (1 - t), 6 - 12 * t)
        scene = Scene(UR, (effects.Gravity(),), control, SemiImplicitEuler(), 1 / steps, backend="auto")
        found = scene.rollout(scene.start(q), reference=torch.cat(way, -1), ends=True)
        e = dq.log_shortest(dq.mul(dq.conj(torchdq.forward_kinematics(UR, found.q, UR.tip)), Y)).norm()
        worst.append(float(e))
    assert worst[0] < 0.01 and worst[0] / worst[1] == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize(
    "kind", thinned([OperationalSpaceControl, CartesianImpedance], [OperationalSpaceControl]), ids=lambda x: x.__name__
)
def test_gains_of_a_frame_and_a_posture_may_be_learned(kind):
    """One number for all axes or several, with a gain of the posture for every sample."""
    q, qd, X = random(2, 3), random(2, 3, seed=1), dq.exp(random(2, 6, seed=2))
    rates = random(2, 12, seed=3)

    def end(first, second, q_null, k_null):
        control = kind(first, second, axes="position", q_null=q_null, k_null=k_null)
        reference = torch.cat([X, rates], -1)[:, : control.reference(TREE.n)]
        return Scene(TREE, (effects.Gravity(),), control).step(State(q, qd), reference=reference).qd

    gains = [double(30.0)[0], double(4.0, 5.0, 6.0), random(3), double(3.0, 4.0)]
    assert torch.autograd.gradcheck(end, [x.requires_grad_() for x in gains])


def test_kinetic_and_spring_energy_never_grow_where_gravity_alone_is_compensated():
    """With a damper for the torques that are held over a step; that of c drives the same arm."""
    q, qd = double(0.3, 1.2, 1.0, -2.0).view(2, 2), double(3.0, -6.0, -4.0, 3.0).view(2, 2)
    X, energies = torchdq.forward_kinematics(ARM, double(0.6, 0.9), ARM.tip), {}
    for coriolis in (True, False):
        control = CartesianImpedance(200.0, 1.0, axes=("x", "y"), coriolis=coriolis)
        scene = Scene(ARM, (effects.Gravity(),), control, RungeKutta4(), 1e-3, backend="auto")
        reference = torch.nn.functional.pad(X, (0, 6)).expand(300, 2, 14)
        states = scene.rollout(scene.start(q, qd), reference=reference)
        away = dq.translation(torchdq.forward_kinematics(ARM, states.q, ARM.tip)) - dq.translation(X)
        energies[coriolis] = torchdq.kinetic_energy(ARM, states.q, states.qd) + 100.0 * away.square().sum(-1)
    assert (energies[False].diff(dim=0) < 0).all() and (energies[True][-1] > 1.5 * energies[True][0]).any()


def test_a_check_of_steps_holds_the_frame():
    start = torch.tensor([0.4, 0.9], dtype=torch.float64)
    control = OperationalSpaceControl(100.0, 20.0, frame=ARM.tip, axes=("x", "y"), expressed="world")
    scene = Scene(ARM, (effects.Gravity(),), control, dt=0.002)
    assert scene.check(scene.start(start), seconds=0.1).stable
    assert torch.allclose(scene.step(scene.start(start), reference=control.holding(ARM, start)).q, start, atol=1e-14)


WRONG_TASKS = {
    "a floating base": lambda: Scene(torchdq.robots.load("go2"), controller=OperationalSpaceControl(1.0, 1.0)),
    "more axes than joints": lambda: Scene(ARM, controller=OperationalSpaceControl(1.0, 1.0)),
    "a gain too few": lambda: Scene(UR, controller=OperationalSpaceControl((1.0, 1.0), 1.0)),
    "a learned model": lambda: Scene(ARM, controller=OperationalSpaceControl(1.0, 1.0, axes=("x", "y"), model=LEARNED)),
}


def test_more_rows_than_a_goal_has_are_refused():
    with refused(ArgumentError):
        PD(1.0, 1.0)(ARM, *torch.zeros(6, 2))


@pytest.mark.parametrize("case", WRONG_TASKS)
def test_control_of_a_frame_that_cannot_be_is_refused(case):
    with refused(ArgumentError):
        WRONG_TASKS[case]()
