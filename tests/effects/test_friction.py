"""Friction effects: each law is its formula, in scenes, layers and logs alike, and none gives energy.

Formulas are written anew in numpy; motions with bristles are compared with scipy's solution of the equations in their
usual form. Numbers in tolerances are measured ones with a margin of three to ten.
"""

import math
from functools import cache

import numpy as np
import pytest
import torch
from effect_harness import FRICTION, forms_of, over_width
from helpers import FIXED, INERTIA, WHEEL, called, double, random, thinned
from messages import refused
from oracles import random_tree, shipped
from scipy.integrate import solve_ivp

import torchdq
from torchdq import Scene, effects
from torchdq.effects.resistance import columns
from torchdq.errors import ArgumentError
from torchdq.scene import State
from torchdq.scene.integrators import DormandPrince, ExplicitEuler, LinearlyImplicit, RungeKutta4

F64 = torch.float64
ARM = shipped("two_link").robot
TREE = random_tree(3, seed=3, armature=True).robot
n = TREE.n


def law_of(kind):
    """Friction of one of the kinds whose torque is a damping, and its torque."""
    ranges, formula = FRICTION[kind]
    parameters, values = forms_of(ranges, "list", n)
    values = {name: x[0] for name, x in values.items()}
    return getattr(effects, kind)(**parameters), lambda q, qd, load: formula(q, qd, **values)[0] * qd


GEAR, _ = forms_of({"coefficient": (0.1, 0.9)}, "list", n)
TEETH, _ = forms_of({"period": (0.3, 2.0), "sine": (-1.0, 1.0), "cosine": (-1.0, 1.0)}, "list", n)


def rippling(q, qd, load):
    period, sine, cosine = map(np.array, TEETH.values())
    return sine * np.sin(2 * np.pi * q / period) + cosine * np.cos(2 * np.pi * q / period)


# effect, and the torque that overcomes it, of position, velocity and load
LAWS = {
    **{kind: law_of(kind) for kind in FRICTION},
    "LoadDependent": (
        effects.LoadDependent(**GEAR, sign_width=0.2),
        lambda q, qd, load: np.array(GEAR["coefficient"]) * np.abs(load) * qd * over_width(qd, 0.2),
    ),
    "Ripple": (effects.Ripple(**TEETH), rippling),
}
TOGETHER = tuple(effect for effect, _ in LAWS.values())


def together(q, qd, load):
    return sum(law(q, qd, load) for _, law in LAWS.values())


def alike(found, expected, roundings=100):
    size = np.abs(expected).max()
    return np.abs(np.asarray(found) - expected).max() <= roundings * np.finfo(float).eps * size


# --- the laws --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", LAWS)
def test_the_torque_of_a_joint_is_its_law(kind):
    effect, law = LAWS[kind]
    q, qd, load = random(3, 50, n, seed=1)
    expected = law(q.numpy(), qd.numpy(), load.numpy())
    layer = torchdq.DQRNEA(TREE, friction=(effect,))
    assert alike(layer.friction_torque(qd, q, load), expected)
    found = columns(TREE, effect, q, qd, load)
    assert tuple(found) == effect.LINEAR == effect.SCALES
    assert alike(sum(x * double(*getattr(effect, name)) for name, x in found.items()), expected)


@pytest.mark.parametrize("kind", LAWS)
def test_columns_need_no_values_of_what_they_are_columns_for(kind):
    effect, _ = LAWS[kind]
    q, qd, load = random(3, 5, n, seed=2)
    unknown = type(effect)(**{"period": effect.period} if kind == "Ripple" else {})
    assert all(getattr(unknown, name) is None for name in effect.LINEAR)
    assert all(x.shape == (5, n) and x.abs().max() > 0 for x in columns(TREE, unknown, q, qd, load).values())


@pytest.mark.parametrize("kind", [*LAWS, "all"])
def test_a_simulated_motion_takes_the_torques_of_the_layer(kind):
    """The acceleration of a scene, put into inverse dynamics, gives the torque that was applied; drives and brakes."""
    parts, law = (TOGETHER, together) if kind == "all" else ((LAWS[kind][0],), LAWS[kind][1])
    q, qd, u = random(3, 200, n, seed=3)
    scene = Scene(TREE, (effects.Gravity(), effects.RotorInertia(), *parts), integrator=ExplicitEuler(), dt=1.0)
    qdd = scene.step(State(q, qd), 10 * u).qd - qd
    load = torchdq.inverse_dynamics(TREE, q, qd, qdd)
    expected = 10 * u.numpy()
    assert ((load * qd > 0).any(0) & (load * qd < 0).any(0)).all()
    assert alike(load.numpy() + law(q.numpy(), qd.numpy(), load.numpy()), expected, 3e4)
    assert alike(torchdq.DQRNEA(TREE, friction=parts)(q, qd, qdd), expected, 3e4)


@pytest.mark.parametrize("kind", [*LAWS, "all"])
def test_inverse_and_forward_dynamics_of_a_layer_agree(kind):
    parts = TOGETHER if kind == "all" else (LAWS[kind][0],)
    q, qd, qdd = random(3, 50, n, seed=4)
    tau = torchdq.DQRNEA(TREE, friction=parts)(q, qd, qdd)
    assert alike(torchdq.ForwardDynamics(TREE, friction=parts)(q, qd, tau), qdd.numpy(), 1e6)
    controller = torchdq.ComputedTorque(TREE, 9.0, 6.0, friction=parts)
    q_des, qd_des = random(2, 50, n, seed=5)
    expected = qdd + 6.0 * (qd_des - qd) + 9.0 * (q_des - q)
    tau = controller(q, qd, q_des, qd_des, qdd)
    assert alike(torchdq.ForwardDynamics(TREE, friction=parts)(q, qd, tau), expected.numpy(), 1e6)


def test_friction_that_needs_no_velocity_is_there_at_rest():
    ripple = LAWS["Ripple"][0]
    q = random(5, n, seed=6)
    layer = torchdq.DQRNEA(TREE, friction=ripple)  # one effect, without a sequence
    torque = layer(q) - torchdq.inverse_dynamics(TREE, q)
    assert alike(torque, LAWS["Ripple"][1](q.numpy(), 0 * q.numpy(), None), 1e3)
    assert torchdq.ForwardDynamics(TREE, friction=(ripple,))(q, None, layer(q)).abs().max() < 1e-9


@pytest.mark.parametrize("kind", thinned(LAWS, [*LAWS][::2]))
def test_second_derivatives_are_right(kind):
    effect, _ = LAWS[kind]
    given = {name: getattr(effect, name) for name in (*effect.LINEAR, *(["period"] if kind == "Ripple" else []))}
    made = type(effect)(**{name: x[:2] for name, x in given.items()})
    scene = Scene(ARM, (effects.Gravity(), made))
    point = [double(0.3, -0.7).requires_grad_(), double(0.9, -1.2).requires_grad_(), double(2.0, -0.7).requires_grad_()]
    assert torch.autograd.gradgradcheck(lambda q, qd, u: scene.step(State(q, qd), u).qd, point, atol=1e-6)


# --- load ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("torque", [2.0, -2.0])
def test_a_load_that_drives_meets_less_friction_than_one_that_is_driven(torque):
    """A wheel that turns forwards: (1 + mu) of the load to speed it up, (1 - mu) of it slows it down."""
    mu, width = 0.4, 1e-6
    scene = Scene(WHEEL, (effects.LoadDependent(mu, width),), integrator=ExplicitEuler(), dt=1.0)
    qd = double(3.0)
    found = float(scene.step(State(double(0.0), qd), double(torque)).qd - qd) * INERTIA
    assert found == pytest.approx(torque / (1 + math.copysign(mu, torque)), rel=1e-11)


@pytest.mark.parametrize("integrator", thinned(FIXED[1:], FIXED[2:4]), ids=called)
def test_friction_of_the_load_never_gives_energy(integrator):
    """Arms under constant torques, which lift them and are driven backwards as they swing; half start at rest."""
    parts = (effects.Gravity(), effects.LoadDependent(0.6, 0.05))
    scene = Scene(ARM, parts, integrator=integrator, dt=4e-4, backend="auto")
    (q, qd), u = random(2, 20, 2, seed=7), double(6.0, -2.0)
    qd[10:] = 0
    state = scene.start(q, qd)
    energies, backwards = [], []
    for _ in range(50):
        energies.append(scene.energy(state).sum(-1) - (u * state.q).sum(-1))
        backwards.append(u * state.qd < 0)
        for _ in range(10):
            state = scene.step(state, u)
    found = torch.stack(energies)
    assert 0.1 < torch.stack(backwards).double().mean() < 0.9
    assert (found[1:] - found[:-1]).max() <= 1e-3 * (found[0] - found[-1]).min()


@pytest.mark.parametrize("seconds", [1e-3, 0.1])
def test_friction_of_the_load_takes_power_in_every_state(seconds):
    q, qd, u = random(3, 500, 2, seed=8)
    qd = qd * 10 ** (-6 * torch.rand(500, 1, dtype=F64, generator=torch.Generator().manual_seed(1)))
    for integrator in (ExplicitEuler(), LinearlyImplicit()):
        made, bare = (
            Scene(ARM, parts, integrator=integrator, dt=seconds).step(State(q, qd), 5 * u).qd
            for parts in ((effects.LoadDependent(0.9, 1e-3),), ())
        )
        torque = torch.einsum("bij,bj->bi", torchdq.mass_matrix(ARM, q), made - bare) / seconds
        ends = qd if isinstance(integrator, ExplicitEuler) else made
        assert (torque * ends <= 1e-9 * torque.abs().amax() * ends.abs().amax()).all()


MISUSE = {
    "no load": lambda q, time: columns(TREE, effects.LoadDependent(), *random(2, 5, n)),
    "friction that locks": lambda q, time: Scene(ARM, (effects.LoadDependent(1.0),)),
    "load twice": lambda q, time: Scene(ARM, (effects.LoadDependent(0.1), effects.LoadDependent(0.2))),
    "no temperature": lambda q, time: Scene(ARM, (effects.Viscous(1.0, warming=-0.1),)).step(State(*random(2, 2))),
    "no times": lambda q, time: columns(WHEEL, effects.LuGre(), q, q),
    "times that stand still": lambda q, time: columns(WHEEL, effects.LuGre(), q, q, time=0 * time),
    "several motions": lambda q, time: columns(WHEEL, effects.LuGre(), q[None], q[None], time=time),
    "model's friction twice": lambda q, time: torchdq.ComputedTorque(
        torchdq.DQRNEA(ARM, friction=effects.Viscous(0.1)), 9.0, 6.0, friction=effects.Viscous(0.1)
    ),
}


@pytest.mark.parametrize("what", MISUSE)
def test_what_friction_needs_is_asked_for(what):
    with refused(ArgumentError):
        MISUSE[what](random(9, 1), torch.linspace(0.0, 1.0, 9, dtype=F64))


# --- ripple ----------------------------------------------------------------------------------------------------------


def test_the_stiffness_of_a_ripple_is_its_slope_where_it_holds():
    one = effects.Ripple(0.7, 0.3, -0.5)
    for q in np.linspace(0, 0.7, 15):
        slope = (one.law(q + 1e-6, 0.0).force - one.law(q - 1e-6, 0.0).force) / 2e-6
        assert one.law(float(q), 0.0).stiffness == pytest.approx(max(slope, 0.0), abs=1e-6)


def test_a_ripple_keeps_the_energy():
    adaptive = DormandPrince(1e-10, 1e-12)
    scene = Scene(WHEEL, (effects.Ripple(0.7, 0.3, -0.5),), integrator=adaptive, dt=0.02, backend="auto")
    state, k = scene.start(double(0.1), double(3.0)), 2 * math.pi / 0.7

    def energy(state):
        angle = k * state.q
        return float(0.5 * INERTIA * state.qd**2 + (-0.3 * angle.cos() - 0.5 * angle.sin()) / k)

    before = energy(state)
    for _ in range(20):
        state = scene.step(state)
        assert energy(state) == pytest.approx(before, abs=1e-9)


# --- temperature -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", LAWS)
def test_coefficients_change_with_the_temperature(kind):
    effect, law = LAWS[kind]
    warm = type(effect)(**{name: getattr(effect, name) for name in effect.SHAPES if name != "warming"}, warming=-0.02)
    q, qd, load = random(3, 50, n, seed=9)
    kelvin = torch.linspace(-30.0, 80.0, 50, dtype=F64)[:, None].expand(50, n)
    factor = np.maximum(1 - 0.02 * kelvin.numpy(), 0.0)
    found = columns(TREE, warm, q, qd, load, kelvin)
    total = sum(x * double(*getattr(effect, name)) for name, x in found.items())
    assert alike(total, factor * law(q.numpy(), qd.numpy(), load.numpy()))
    parts = [(effects.Gravity(), part) for part in (warm, effect)]
    warmed, plain = (Scene(TREE, part, integrator=ExplicitEuler(), dt=1.0) for part in parts)
    zero = torch.zeros(n, dtype=F64)
    assert torch.allclose(warmed.step(State(q, qd), load, temperature=zero).qd, plain.step(State(q, qd), load).qd)


def test_friction_of_one_scene_shares_the_temperature():
    parts = (effects.Viscous(1.0, warming=-0.01), effects.Coulomb(0.5, warming=0.005))
    scene = Scene(ARM, parts)
    assert scene.inputs == {"torque": 2, "temperature": 2}
    found = scene.step(State(*random(2, 3, 2)), temperature=double(20.0, 0.0)).qd
    cold = scene.step(State(*random(2, 3, 2)), temperature=double(0.0, 0.0)).qd
    assert not torch.equal(found[:, 0], cold[:, 0])
    assert Scene(ARM, (effects.Viscous(1.0, warming=0.0),)).inputs == {"torque": 2}


# --- bristles --------------------------------------------------------------------------------------------------------

LEVEL, BEND, RATIO, SLOW, SETTLING = 0.4, 0.02, 1.5, 0.3, 0.02


def bristles(t, x, u):
    """Equations of a wheel with LuGre friction in their usual form, of sigma_0 and sigma_1."""
    _, v, z = x
    stiffness = LEVEL / BEND
    damping = SETTLING * stiffness / (1 + (SETTLING * v / (8 * BEND)) ** 2)
    g = LEVEL + (RATIO - 1) * LEVEL * np.exp(-((v / SLOW) ** 2))
    rate = v - stiffness * abs(v) / g * z
    return [v, (u - stiffness * z - damping * rate) / INERTIA, rate]


def torque_at(t):
    return 1.2 * LEVEL * math.sin(6.0 * t) + 0.6 * LEVEL * math.sin(17.0 * t)


@cache
def followed(integrator, dt, seconds=0.6):
    """Position, velocity and deflection over time, of a scene and of scipy."""
    lugre = effects.LuGre(LEVEL, BEND, RATIO, SLOW, SETTLING)
    scene = Scene(WHEEL, (lugre,), integrator=integrator, dt=dt, backend="auto")
    state, x = scene.start(double(0.0)), np.zeros(3)
    rows = []
    for k in range(round(seconds / dt)):
        u = torque_at(k * dt)
        state = scene.step(state, double(u))
        x = solve_ivp(bristles, (0, dt), x, args=(u,), rtol=1e-11, atol=1e-13).y[:, -1]
        rows.append(([float(state.q), float(state.qd), BEND * float(state.memory)], x))
    return np.array(rows)


FOLLOWED = [  # integrators, steps and errors
    (DormandPrince(1e-9, 1e-11), 0.02, 1e-7),
    (RungeKutta4(), 1e-3, 1e-4),
    (FIXED[4], 1e-3, 1e-2),
    (FIXED[1], 5e-4, 5e-2),
    (LinearlyImplicit(), 5e-4, 0.2),
]


@pytest.mark.parametrize(
    ("integrator", "dt", "off"),
    thinned(FOLLOWED, [FOLLOWED[1], FOLLOWED[4]]),
    ids=lambda x: called(x) if hasattr(x, "order") else "",
)
def test_bristles_move_as_scipy_says(integrator, dt, off):
    found, expected = np.moveaxis(followed(integrator, dt), 1, 0)
    assert expected[:, 2].max() > 1.05 * BEND and np.abs(expected[:, 1]).max() > 1
    assert (np.abs(found - expected).max(0) <= off * np.abs(expected).max(0)).all()


def test_the_error_of_bristles_in_an_implicit_step_halves_with_it():
    errors = [np.abs(np.subtract(*np.moveaxis(followed(LinearlyImplicit(), dt), 1, 0))).max() for dt in (1e-3, 5e-4)]
    assert 1.6 < errors[0] / errors[1] < 2.4


@pytest.mark.parametrize("bend", thinned([1e-3, 1e-6, 1e-12], [1e-6]))
@pytest.mark.parametrize("dt", [1e-3, 0.1])
def test_bristles_reach_the_stationary_deflection_at_any_stiffness(bend, dt):
    """A wheel that a torque holds at a speed, in both directions, and one at rest under less than its friction."""
    ratio, slow, settling = 1.5, 5.0, 0.01
    lugre = effects.LuGre(LEVEL, bend, ratio, slow, settling)
    scene, moved = Scene(WHEEL, (lugre, effects.RotorInertia(1e9)), dt=dt), Scene(WHEEL, (lugre,), dt=1e-9)
    for v in (3.0, -3.0):
        state = scene.start(double(0.0))
        g = 1 + (ratio - 1) * math.exp(-((v / slow) ** 2))
        for _ in range(30):
            state = scene.step(state._replace(qd=double(v)))
        assert float(state.memory) == pytest.approx(math.copysign(g, v), rel=1e-6)
        # the torque on the wheel is that of the deflection
        slowed = moved.step(state._replace(qd=double(v)))
        assert float(slowed.qd - v) * INERTIA / 1e-9 == pytest.approx(-LEVEL * math.copysign(g, v), rel=1e-4)
    held = Scene(WHEEL, (effects.LuGre(LEVEL, double(bend)),), dt=dt, backend="auto")
    state = held.rollout(held.start(double(0.0)), double(0.9 * LEVEL).expand(2000, 1)).last
    assert float(state.memory) == pytest.approx(0.9, rel=1e-3) and abs(float(state.qd)) < 1e-3
    assert float(state.q) < 20 * bend + 1e-9


def test_bristles_take_power_but_for_what_they_store():
    """F qd >= d/dt (level deflection z^2 / 2) in every state, whatever the damping of the bristles."""
    rng = np.random.default_rng(0)
    for _ in range(2000):
        bend, settling, v = (10.0 ** rng.uniform(-5, 1) for _ in range(3))
        one = effects.LuGre((1.0,), (bend,), (1.3,), (1.0,), (settling,), warming=(0.0,))
        z = 1.3 * rng.uniform(-1, 1)
        (impedance,) = one.impedances_at_end((0.0,), (v,), {}, (z,), 0.0)
        (rate,) = one.memory_rates((0.0,), (v,), {}, (z,), (v,), 0.0)
        force = impedance.damping * v + impedance.force
        assert force * v - bend * z * rate >= -1e-9 * abs(bend * z * rate)


@pytest.mark.parametrize("dt", [1e-3, 0.05])
def test_implicit_bristles_never_give_energy(dt):
    scene = Scene(WHEEL, (effects.LuGre(LEVEL, 1e-4, 1.5, 0.1, 0.003),), dt=dt, backend="auto")
    state = scene.start(torch.zeros(9, 1, dtype=F64), torch.linspace(-5, 5, 9, dtype=F64)[:, None])

    def energy(state):
        return (0.5 * INERTIA * state.qd**2 + 0.5 * LEVEL * 1e-4 * state.memory**2)[:, 0]

    before = energy(state)
    for _ in range(500):
        state = scene.step(state)
        after = energy(state)
        assert (after <= before * (1 + 1e-12)).all()
        before = after
    assert state.qd.abs().max() < 1e-3


def test_bristles_along_a_log_are_those_of_the_simulation():
    effect = effects.LuGre(0.4, 5e-4, 1.5, 0.3, 0.005)
    scene = Scene(WHEEL, (effect,), integrator=RungeKutta4(), dt=2e-4, backend="auto")
    state, states = scene.start(double(0.0)), []
    for k in range(1500):
        states.append(state)
        state = scene.step(state, double(torque_at(k * 2e-4)))
    q, qd, z = (torch.stack([getattr(s, name) for s in states]) for name in ("q", "qd", "memory"))
    time = torch.arange(1500, dtype=F64) * 2e-4
    unit = effects.LuGre(None, 5e-4, 1.5, 0.3)  # whose torque is its deflection
    found = columns(WHEEL, unit, q, qd, time=time)["coulomb"]
    assert z.abs().max() > 1.05 and (found - z).abs().max() < 0.02


def test_bristles_are_rows_of_a_batch_and_are_remembered():
    scene = Scene(TREE, (effects.Gravity(), effects.LuGre(torch.ones(4, n, dtype=F64)), effects.Elastic(1e3)), dt=1e-3)
    q = random(4, n, seed=10)
    state = scene.start(q)
    assert state.memory.shape == (4, 3 * n) and not state.memory[:, :n].any()
    for _ in range(5):
        state = scene.step(state)
    assert state.memory[:, :n].abs().min() > 0
    assert torch.allclose(state.memory[:, n : 2 * n], q, atol=0.05)


@pytest.mark.parametrize(
    "integrator", thinned([LinearlyImplicit(), RungeKutta4(), DormandPrince(1e-9)], [LinearlyImplicit()]), ids=called
)
def test_bristles_move_with_a_free_base(integrator):
    """A base of a million tons is a fixed one."""
    zero, body = torch.zeros(3, dtype=F64), torch.tensor([1e9, 0, 1e9, 0, 0, 1e9], dtype=F64)
    floating = ARM.replace(base_mass=torch.tensor(1e9, dtype=F64), base_com=zero, base_inertia=body)
    parts, u = (effects.LuGre(0.5, 0.01, settling=0.01), effects.LoadDependent(0.2)), double(2.0, -1.0)
    found = []
    for robot in (ARM, floating):
        scene = Scene(robot, parts, integrator=integrator, dt=1e-3)
        found.append(scene.rollout(scene.start(double(0.3, -0.5)), u.expand(40, 2)).last)
    assert found[0].memory.abs().min() > 0.1
    for name in ("q", "qd", "memory"):
        assert torch.allclose(getattr(found[1], name), getattr(found[0], name), rtol=1e-6, atol=1e-8)


# --- layers ----------------------------------------------------------------------------------------------------------


def test_layers_learn_what_friction_is_linear_in():
    parts = (effects.Viscous(), effects.Quadratic(0.2), effects.Directional(0.3, 0.2), effects.LoadDependent(0.3))
    parts += (effects.Ripple(1.0, -0.1, 0.2),)
    layer = torchdq.DQRNEA(ARM, "friction", friction=parts)
    names = {"viscous", "quadratic_coefficient", "directional_forward", "directional_backward"}
    names |= {"loaddependent_coefficient", "ripple_sine", "ripple_cosine"}
    learned = (name.removeprefix("parametrizations.") for name, _ in layer.named_parameters())
    assert {name.removesuffix(".original") for name in learned} == names
    q, qd, qdd = random(3, 60, 2, seed=11)
    truth = torchdq.DQRNEA(ARM, friction=(effects.Viscous(0.7), *parts[1:3], effects.LoadDependent(0.2), parts[4]))
    tau = truth(q, qd, qdd)
    how = {"max_iter": 200, "history_size": 100, "line_search_fn": "strong_wolfe", "tolerance_change": 1e-15}
    optimiser = torch.optim.LBFGS(layer.parameters(), **how)

    def loss():
        optimiser.zero_grad()
        value = (layer(q, qd, qdd) - tau).square().mean()
        value.backward()
        return value

    optimiser.step(loss)
    assert torch.allclose(layer.loaddependent_coefficient, double(0.2, 0.2), atol=1e-3)
    assert torch.allclose(layer.viscous, double(0.7, 0.7), atol=1e-3)
    assert [type(effect) for effect in layer.friction] == [type(effect) for effect in parts]
    assert torch.equal(layer.friction[3].coefficient, layer.loaddependent_coefficient)


LAYER = {  # friction that a layer cannot have, and what it learns
    "with memory": ((effects.LuGre(1.0),), ()),
    "of a temperature": ((effects.Viscous(1.0, warming=0.01),), ()),
    "another effect": ((effects.Gravity(),), ()),
    "load twice": ((effects.LoadDependent(0.1), effects.LoadDependent(0.1)), ()),
    "learned with an order": ((effects.Stribeck(1.0, 2.0),), "friction"),
    "learned twice": ((effects.Coulomb(1.0), effects.Coulomb(1.0)), "friction"),
    "without coefficients": ((effects.Directional(),), ()),
}


@pytest.mark.parametrize("what", LAYER)
def test_friction_that_a_layer_cannot_have_is_refused(what):
    friction, learn = LAYER[what]
    with refused(ArgumentError):
        torchdq.DQRNEA(ARM, learn, friction=friction)


def test_the_friction_of_a_model_is_that_of_its_controller():
    robot = TREE.replace(damping=double(*[0.5] * n))
    own = LAWS["LoadDependent"][0]
    model = torchdq.DQRNEA(robot, friction=(own,))
    given = random(5, 20, n, seed=12)
    apart, held = torchdq.ComputedTorque(robot, 9.0, 6.0, friction=(own,)), torchdq.ComputedTorque(model, 9.0, 6.0)
    assert torch.allclose(held(*given), apart(*given), rtol=1e-9, atol=1e-9)
    described = torchdq.ComputedTorque(torchdq.DQRNEA(robot), 9.0, 6.0)
    plain = torchdq.ComputedTorque(robot, 9.0, 6.0, friction=False)
    assert torch.allclose(described(*given) - plain(*given), 0.5 * given[1], atol=1e-9)
