"""Parameters of environments that are drawn for every episode."""

import pytest
import torch
from helpers import thinned
from messages import refused
from small_envs import ALL_DRAWN, PARTS, ROBOT, started
from torch.distributions import Beta, Normal, Uniform

from torchdq import effects
from torchdq.envs import Absolute
from torchdq.envs.randomization import SHORT, DrawnDelay
from torchdq.errors import ArgumentError, UnknownNameError


def make(randomise, num_envs=200, **arguments):
    """Vector environment of a small robot, reset."""
    return started(
        num_envs, **{"task": "track", "effects": PARTS, "action": "residual", **arguments}, randomise=randomise
    )


def drawn(envs, kind, name):
    """Values of a parameter of an effect, a row per environment."""
    return next(getattr(e, name) for e in envs.scene.effects if isinstance(e, kind))


def fills(x, lower, upper):
    """Whether numbers fill a range."""
    edge = 0.1 * (upper - lower)
    return bool(lower <= x.min() < lower + edge) and bool(upper - edge < x.max() <= upper)


WAYS = {
    "mass": lambda envs: drawn(envs, effects.MassScale, "factor"),
    "friction": lambda envs: drawn(envs, effects.Coulomb, "coulomb") / 0.5,
    "damping": lambda envs: drawn(envs, effects.Viscous, "coefficient") / 2.0,
    "armature": lambda envs: drawn(envs, effects.RotorInertia, "inertia") / 0.1,
    "gravity": lambda envs: drawn(envs, effects.Gravity, "acceleration").sum(1) / -9.81,
    "gains": lambda envs: torch.cat([envs.scene.controller.kp / 100, envs.scene.controller.kd / 20], 1),
    "com": lambda envs: envs.scene.robot.com - ROBOT.com,
    "Noise.position": lambda envs: drawn(envs, effects.Noise, "position") / 0.01,
    "ComputedTorque.kp": lambda envs: envs.scene.controller.kp / 100,
    "payload": lambda envs: drawn(envs, effects.Payload, "mass"),
    "delay": lambda envs: next(e.late for e in envs.scene.effects if hasattr(e, "late")),
}
MIDDLE = {"com": 0.0, "payload": 0.15, "delay": 0.15}
HALF = {"payload": 0.15, "delay": 0.15}


@pytest.mark.parametrize("name", thinned(WAYS, [*WAYS][::3]))
def test_a_number_is_a_fraction_and_a_pair_is_a_range(name):
    """And a distribution is drawn from."""
    assert set(SHORT) <= set(WAYS)
    middle, half = MIDDLE.get(name, 1.0), HALF.get(name, 0.3)
    rounding = 1e-5
    found = WAYS[name](make({name: 0.3}, dtype=torch.float64)).double()
    assert fills(found, middle - half - rounding, middle + half + rounding)
    found = WAYS[name](make({name: (0.5, 2.0)}, dtype=torch.float64)).double()
    assert fills(found, 0.5 - rounding, 2.0 + rounding)
    found = WAYS[name](make({name: Normal(2.0, 0.1)}, 2000)).double()
    assert abs(found.mean() - 2.0) < 0.02 and abs(found.std() - 0.1) < 0.01


def test_every_number_has_a_distribution_of_its_own_if_there_are_as_many():
    scales = Uniform(torch.tensor([0.5, 2.0]), torch.tensor([0.6, 3.0]))
    found = drawn(make({"mass": scales}), effects.MassScale, "factor")
    assert fills(found[:, 0], 0.5, 0.6) and fills(found[:, 1], 2.0, 3.0)


@pytest.mark.parametrize("name", WAYS)
def test_what_is_drawn_acts(name):
    low, high = (make({name: (x, x)}, 5, effects=PARTS[:4] if "." not in name else PARTS) for x in (0.6, 1.7))
    for envs in (low, high):
        for _ in range(3):
            envs.step(torch.full((5, 2), 0.5))
    assert not torch.equal(low.get_state()["observation"], high.get_state()["observation"])


@pytest.mark.parametrize("task", ["reach", "track"])
@pytest.mark.parametrize("names", [list(ALL_DRAWN), *([name] for name in thinned(ALL_DRAWN, ()))], ids=str)
def test_start_and_goal_are_those_of_the_robot_as_described(task, names):
    """In every task, whatever else is drawn for an episode."""
    given = ({name: ALL_DRAWN[name] for name in names}, {})
    envs, plain = (make(drawn, 3, task=task, backend="eager") for drawn in given)
    for part in ("q", "goal"):
        assert torch.equal(envs.get_state()[part], plain.get_state()[part])
    assert envs.step(torch.zeros(3, 2))[0].isfinite().all()


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_drawn_delay_of_whole_steps_is_the_delay(steps):
    plain = make({}, 5, effects=(effects.Gravity(), effects.CommandDelay(steps)))
    late = make({"delay": (steps, steps)}, 5, effects=(effects.Gravity(),))
    for k in range(6):
        action = torch.full((5, 2), 0.3 * (-1) ** k)
        assert torch.equal(plain.step(action)[0], late.step(action)[0])


def test_a_delay_between_steps_mixes_the_nearest_torques():
    late = DrawnDelay(1.25, 2)
    found, memory = late.driven((5.0,), (0.0,), (7.0, 3.0), 0.01)  # now, and two steps ago and one
    assert found == [0.75 * 3.0 + 0.25 * 7.0] and memory == (3.0, 5.0)
    assert make({"delay": (0.0, 1.25)}, 5).scene.effects[0].steps == 2


BIAS = effects.Bias(0.0, 0.0)
TILTED = Absolute([-1.0, -2.0, -9.81], [1.0, 2.0, -9.81])
ABSOLUTE = {
    "Bias.position": (Absolute(-0.2, 0.1), (-0.2, -0.2), (0.1, 0.1)),
    "Gravity.acceleration": (TILTED, TILTED.lower, TILTED.upper),
    "Coulomb.coulomb": (Absolute([0.0, 1.0], [0.5, 3.0]), (0.0, 1.0), (0.5, 3.0)),
    "ComputedTorque.kp": (Absolute(50.0, 60.0), (50.0, 50.0), (60.0, 60.0)),
}


@pytest.mark.parametrize("name", ABSOLUTE)
def test_absolute_ranges_are_of_the_numbers_themselves(name):
    randomise, lower, upper = ABSOLUTE[name]
    envs = make({name: randomise}, 400, effects=(*PARTS, BIAS), dtype="float64")
    kind, _, parameter = name.partition(".")
    found = next(
        getattr(part, parameter) for part in (envs.scene.controller, *envs.scene.effects) if type(part).__name__ == kind
    )
    for column, a, b in zip(found.unbind(1), lower, upper, strict=True):
        assert fills(column, a - 1e-9, b + 1e-9) if a < b else bool(((column - a).abs() < 1e-9).all())


def test_absolute_numbers_of_a_distribution_may_be_negative():
    envs = make({"Bias.position": Absolute(Normal(0.0, 0.1))}, 2000, effects=(*PARTS, BIAS))
    found = drawn(envs, effects.Bias, "position")
    assert abs(found.mean()) < 0.01 and abs(found.std() - 0.1) < 0.01
    assert abs(torch.corrcoef(found.T)[0, 1]) < 0.1


def test_a_drawn_bias_is_what_the_sensors_read():
    envs = make({"Bias.position": Absolute(-0.2, 0.2)}, 5, effects=(effects.Gravity(), BIAS), dtype="float64")
    envs.step(torch.zeros(5, 2))
    state, bias = envs.get_state(), drawn(envs, effects.Bias, "position")
    torch.testing.assert_close(state["reading"][:, :2] - state["q"], bias)


def test_effects_of_a_kind_are_drawn_by_their_numbers():
    parts = (effects.Payload(1.0), effects.Gravity(), effects.Payload(2.0), effects.Noise(0.01))
    given = {"Payload.0.mass": (0.5, 0.6), "Payload.1.mass": Absolute(7.0, 8.0), "payload": 0.1, "mass": 0.1}
    first, second, added = (e.mass for e in make(given, effects=parts).scene.effects if isinstance(e, effects.Payload))
    assert fills(first, 0.5, 0.6) and fills(second, 7.0, 8.0) and fills(added, 0.0, 0.1)
    with refused(UnknownNameError) as caught:
        make({"Payload.mass": 0.1}, effects=parts)
    assert "'Payload.0.mass'" in str(caught.value) and "'Payload.1.mass'" in str(caught.value)


def test_all_friction_of_a_joint_has_one_factor():
    own = torch.linspace(1.0, 2.0, 200)[:, None].expand(200, 2)  # of every row
    parts = (effects.Viscous(own), effects.Stribeck(2.0, 3.0), effects.Directional(1.0, 4.0))
    viscous, stribeck, directional = make({"friction": (0.5, 2.0)}, effects=parts).scene.effects
    factor = viscous.coefficient / own
    found = (stribeck.coulomb / 2, stribeck.static / 3, directional.forward, directional.backward / 4)
    for other in found:
        torch.testing.assert_close(other, factor)
    assert fills(factor, 0.5, 2.0) and abs(torch.corrcoef(factor.T)[0, 1]) < 0.3


def test_an_unknown_name_lists_all():
    with refused(UnknownNameError) as caught:
        make({"masses": 7.0})
    for name in (*SHORT, "Viscous.coefficient", "Noise.velocity", "ComputedTorque.kd"):
        assert name in str(caught.value)


NUMBERS = [1.5, True, (True, 2), (1.2, 0.8), (0.8, 1.0, 1.2), "much", (0.0, 1.0)]
DISTRIBUTIONS = [Normal(1.0, 0.3), Beta(2.0, 2.0), Uniform(torch.ones(3), 2 * torch.ones(3))]
ACCELERATIONS = [
    ([0.0, 0.0], [1.0, 1.0]),
    ([0.0, 0.0, 0.0], [1.0, -1.0, 1.0]),
    (0.0, True),
    (0.0,),
    (float("nan"), 1.0),
]
WRONG = [
    *({"mass": x} for x in (*NUMBERS, *DISTRIBUTIONS)),
    *({"delay": -1}, {"delay": 600}, {"payload": (-1.0, 1.0)}, {"damping": 0.1, "friction": 0.1}),
    *({"Noise.velocity": 0.1}, [("mass", 0.1)]),
    *({name: Absolute(0.5, 1.0)} for name in ("mass", "payload", "friction")),
    *({"Coulomb.coulomb": x} for x in (Absolute(-1.0, 1.0), Absolute(Normal(0.0, 1.0)))),
    *({"Gravity.acceleration": Absolute(*x)} for x in ACCELERATIONS),
]


@pytest.mark.parametrize("randomise", WRONG)
def test_wrong_ranges_are_refused(randomise):
    with refused(ArgumentError):
        make(randomise)


FLOOR = effects.Contact(normal=(0.0, 1.0, 0.0))
BOX = (1.0, 0.0, 1.0, 0.0, 0.0, 1.9)  # nearly as flat as a body can be
REFUSED = [
    (FLOOR, {"Contact.normal": Absolute([-0.5, 0.75**0.5, 0.0], [0.5, 0.75**0.5, 0.0])}),  # both ends are unit vectors
    (FLOOR, {"Contact.normal": 0.3}),
    (
        effects.JointLimits(-1.0, 1.0),
        {"JointLimits.lower": Absolute(-1.0, 0.5), "JointLimits.upper": Absolute(0.0, 1.0)},
    ),
    (effects.JointLimits(-1.0, torch.linspace(3, 1, 200)[:, None]), {"JointLimits.lower": Absolute(-1.0, 1.5)}),
    (effects.JointLimits(1.0, 2.0), {"JointLimits.lower": (1.0, 3.0)}),
    (effects.Stribeck(1.0, 1.2), {"Stribeck.static": 0.9}),
    (effects.Stribeck(1.0, 1.2), {"Stribeck.static": Uniform(0.5, 1.0), "Stribeck.coulomb": Uniform(0.1, 0.7)}),
    (effects.Payload(1.0, inertia=BOX), {"Payload.inertia": 0.9}),
]


@pytest.mark.parametrize("effect, randomise", REFUSED)
def test_draws_that_an_effect_refuses_are_refused_at_construction(effect, randomise):
    with refused(ArgumentError) as caught:
        make(randomise, effects=(effect,))
    assert all(repr(name) in str(caught.value) for name in randomise)


def test_rows_of_their_own_are_refused_by_what_is_drawn_for_them():
    """Limits of every row: what is drawn is compared with those of that row."""
    upper = torch.linspace(1, 3, 200)[:, None].expand(200, 2)
    envs = make({"JointLimits.lower": Absolute(-1.0, 1.0)}, effects=(effects.JointLimits(-1.0, upper),))
    limits = envs.scene.effects[0]
    assert bool((limits.lower < limits.upper).all()) and torch.equal(limits.upper.float(), upper)


@pytest.mark.parametrize("name", ["damping", "armature", "gravity", "gains"])
def test_a_factor_of_nothing_is_refused(name):
    with refused(ArgumentError):
        make({name: 0.1}, effects=(), action="torque")


def test_a_payload_of_the_scene_adds_to_the_drawn_one_and_does_not_grow_with_the_links():
    parts = (effects.Gravity(), effects.Payload(3.0))
    scaled, _, held, other = make({"mass": (1.999, 2.0), "payload": 1.0}, effects=parts).scene.effects
    assert isinstance(scaled, effects.MassScale) and held.mass == 3.0 and other.mass.shape == (200,)
