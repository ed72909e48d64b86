"""Effects of one scene: those that take nothing from a description, and those that cannot be combined."""

import math
import warnings

import pytest
import torch
from helpers import double, random
from scenes import ARM, PANDA

import torchdq
from torchdq.envs import Scene, effects
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
    name, (wanted, absent, value) = type(effect).__name__, TAKING[effect]
    with pytest.warns(
        UserWarning, match=f"{name} takes {wanted} .* 'two_link', which has {absent}: it acts on no joint"
    ):
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


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"robot": "panda"}, "robot must be a torchdq.Robot, found str"),
        ({"effects": (effects.Gravity,)}, "it is a class, call it"),
        ({"effects": effects.Gravity()}, "effects must be a sequence"),
        ({"effects": ("gravity",)}, "effects must be objects of torchdq.effects, found 'gravity'"),
        ({"controller": PD}, "controller must be an object of .* it is a class, call it"),
        ({"integrator": RungeKutta4}, "integrator must be an object of .* it is a class, call it"),
        ({"dt": 0.0}, "dt must be a positive number"),
        ({"dt": math.inf}, "dt must be a positive number"),
        ({"dt": "fast"}, "dt must be a positive number"),
        ({"dt": True}, "dt must be a positive number, found True"),
        ({"substeps": True}, "substeps must be a whole number from 1, found True"),
        ({"effects": (effects.CommandDelay(True),)}, "steps of CommandDelay must be a whole number from 1, found True"),
        ({"substeps": 0}, "substeps must be a whole number"),
        ({"substeps": 1.5}, "substeps must be a whole number"),
        ({"effects": (effects.Elastic(1.0, 0.0, 1.0),) * 2}, "must not hold Elastic twice"),
        ({"effects": (effects.Push(), effects.Push("link1"))}, "the input 'push' belongs to 2 effects"),
        ({"effects": (effects.Servo(1.0), effects.Servo(2.0))}, "the input 'target' belongs to 2 effects"),
        ({"effects": (effects.Push("base"),)}, "frame of Push is 'base', which is fixed to the base"),
        ({"effects": (effects.Push(axes="tool"),)}, "axes of Push must be 'world' or 'body'"),
        ({"effects": (effects.CommandDelay(0),)}, "steps of CommandDelay must be a whole number from 1"),
        ({"effects": (effects.MeasurementDelay(1.5),)}, "steps of MeasurementDelay must be a whole number from 1"),
        ({"effects": (effects.Viscous(-1.0),)}, "coefficient of Viscous must not be negative"),
        ({"effects": (effects.Viscous(math.nan),)}, "coefficient of Viscous must be finite"),
        ({"effects": (effects.Viscous([1.0, 2.0, 3.0]),)}, "coefficient of Viscous must be one number or 2, found 3"),
        ({"effects": (effects.Viscous(torch.ones(3)),)}, r"coefficient of Viscous must have the shape \[..., 2\]"),
        (
            {"effects": (effects.Viscous(torch.ones(2, dtype=torch.int64)),)},
            "coefficient of Viscous must be a floating",
        ),
        ({"effects": (effects.Viscous("much"),)}, "coefficient of Viscous must be a number"),
        ({"effects": (effects.Coulomb(1.0, 0.0),)}, "width of Coulomb must be positive"),
        ({"effects": (effects.Stribeck(1.0, 2.0, velocity=0.0),)}, "velocity of Stribeck must be positive"),
        ({"effects": (effects.Stribeck(1.0),)}, "static of Stribeck must be given"),
        ({"effects": (effects.Elastic(1.0, 0.0, [0.1, 0.0]),)}, "inertia of Elastic must be positive"),
        ({"effects": (effects.Drag(1.0, sign_width=0.0),)}, "sign_width of Drag must be positive"),
        ({"effects": (effects.Contact(sign_width=0.0),)}, "sign_width of Contact must be positive"),
        ({"effects": (effects.TorqueSpeed(1.0, 0.0),)}, "speed of TorqueSpeed must be positive"),
        ({"effects": (effects.QuantisedCommand(0.0),)}, "step of QuantisedCommand must be positive"),
        ({"effects": (effects.JointLimits(1.0, -1.0),)}, "JointLimits must not be above upper, found 1 and -1"),
        ({"robot": PANDA, "effects": (effects.Payload(1.0, frame=PANDA.frame_names[0]),)}, "fixed to the base"),
        (
            {
                "robot": ARM.replace(armature=double(0.1, 0.1)).bake(),
                "effects": (effects.RotorInertia(), effects.Elastic(1e3)),
            },
            "rotor inertia of the description",
        ),
        ({"effects": (effects.Gravity((0.0, 9.81)),)}, "acceleration of Gravity must be one number or 3, found 2"),
    ],
)
def test_a_scene_that_makes_no_sense_is_refused_by_name(arguments, message):
    with pytest.raises(torchdq.ArgumentError, match=message):
        Scene(**{"robot": ARM, **arguments})


def test_an_unknown_frame_is_refused_by_name():
    for effect in (effects.Push("nowhere"), effects.Contact("nowhere"), effects.Payload(1.0, frame="nowhere")):
        with pytest.raises(torchdq.UnknownNameError, match=r"no frame .* named 'nowhere'"):
            Scene(ARM, (effect,))


def test_a_column_of_numbers_for_the_samples_is_refused():
    scene = Scene(ARM, (effects.Payload(torch.rand(3, 1, dtype=torch.float64)),))
    with pytest.raises(ArgumentError, match=r"mass is one number for each sample: shape \(3,\), found \(3, 1\)"):
        scene.step(scene.start(random(3, 2)))
