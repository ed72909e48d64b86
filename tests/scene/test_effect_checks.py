"""Effects of one scene: those that take nothing from a description, and those that cannot be combined."""

import math
import warnings

import pytest
import torch
from helpers import double, random
from messages import refused, warned
from scenes import ARM, PANDA

import torchdq
from torchdq import Scene, effects
from torchdq.errors import ArgumentError
from torchdq.scene.controllers import PD
from torchdq.scene.integrators import RungeKutta4

# parts of a description, and what the shipped arm without friction and limits says of each
TAKING = {
    effects.Viscous(): ("coefficient from", "no damping", "coefficient is 0"),
    effects.Coulomb(): ("coulomb from", "no friction", "coulomb is 0"),
    effects.Stribeck(static=0.0): ("coulomb from", "no friction", "coulomb is 0, static is 0"),
    effects.JointLimits(): ("lower and upper from", "no limits.lower and limits.upper", "lower is -inf, upper is inf"),
    effects.Saturation(): ("limit from", "no limits.effort", "limit is inf"),
    effects.TorqueSpeed(): ("stall and speed from", "no limits.effort and limits.velocity", "stall is inf"),
}


@pytest.mark.parametrize("effect", TAKING, ids=lambda e: type(e).__name__)
def test_a_description_that_has_nothing_to_take_is_reported_once(effect):
    torchdq.clear_caches()
    name, (_wanted, _absent, value) = type(effect).__name__, TAKING[effect]
    with warned(UserWarning):
        scene = Scene(ARM, (effect,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Scene(ARM, (effect,))
        lines = scene.describe(batch=1, seconds=0.0).left_out
    assert f"{name} acts on no joint: {value}" in lines


def test_effects_that_act_are_not_reported():
    """Nor are numbers that were given, and limits of zero are limits."""
    torchdq.clear_caches()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for effect in (effects.Viscous(0.0), effects.Stribeck(static=1.0), effects.Saturation(0.0), effects.Gravity()):
            Scene(ARM, (effect,))
        Scene(PANDA, (effects.Viscous(double(*[0.0] * 7)), effects.Saturation(), effects.JointLimits()))
    held = Scene(ARM, (effects.Saturation(0.0), effects.JointLimits(0.0, 0.0))).describe(batch=1, seconds=0.0).left_out
    assert not any("acts on no joint" in line for line in held)


SENSELESS = [  # effects
    *(effects.Gravity, "gravity", effects.CommandDelay(True), effects.CommandDelay(0), effects.MeasurementDelay(1.5)),
    *(
        effects.Push("base"),
        effects.Push(axes="tool"),
        effects.Viscous([1.0, 2.0, 3.0]),
        effects.Viscous(torch.ones(3)),
    ),
    *(effects.Viscous(torch.ones(2, dtype=torch.bool)), effects.Stribeck(1.0), effects.JointLimits(1.0, -1.0)),
    effects.Gravity((0.0, 9.81)),
]
TOGETHER = [  # two effects
    *((effects.Elastic(1.0, 0.0, 1.0),) * 2, (effects.Push(), effects.Push("link1"))),
    (effects.Servo(1.0), effects.Servo(2.0)),
]
ARGUMENTS = [
    *({"robot": "panda"}, {"controller": PD}, {"integrator": RungeKutta4}, {"effects": effects.Gravity()}),
    *({"dt": x} for x in (0.0, math.inf, "fast", True)),
    *({"substeps": x} for x in (True, 0, 1.5)),
    *({"effects": (effect,)} for effect in SENSELESS),
    *({"effects": pair} for pair in TOGETHER),
    {"robot": PANDA, "effects": (effects.Payload(1.0, frame=PANDA.frame_names[0]),)},
    {"robot": ARM.replace(armature=double(0.1, 0.1)).bake(), "effects": (effects.RotorInertia(), effects.Elastic(1e3))},
]


@pytest.mark.parametrize("arguments", ARGUMENTS)
def test_a_scene_that_makes_no_sense_is_refused_by_name(arguments):
    with refused(torchdq.ArgumentError):
        Scene(**{"robot": ARM, **arguments})


def test_an_unknown_frame_is_refused_by_name():
    for effect in (effects.Push("nowhere"), effects.Contact("nowhere"), effects.Payload(1.0, frame="nowhere")):
        with refused(torchdq.UnknownNameError):
            Scene(ARM, (effect,))


def test_a_column_of_numbers_for_the_samples_is_refused():
    scene = Scene(ARM, (effects.Payload(torch.rand(3, 1, dtype=torch.float64)),))
    with refused(ArgumentError):
        scene.step(scene.start(random(3, 2)))
