"""Harness for tests of effects: a scene's accelerations compared with pinocchio's.

An explicit Euler step of one second adds the accelerations to the velocities, so a scene's accelerations are compared
with pinocchio's under the torques, wrenches or changed bodies that the effect stands for. Tolerances are roundings of
the largest torque, turned into accelerations by the inverse of the mass matrix.
"""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import torch
from helpers import thinned
from oracles import Case, random_tree, shipped, states

from torchdq import Closure, Scene, effects
from torchdq.robot import Limits
from torchdq.scene.integrators import ExplicitEuler, LinearlyImplicit

EPS = 2.0**-52
CASES = {"two_link": shipped("two_link"), "tree": random_tree(3, seed=6, armature=True), "panda": shipped("panda")}
SAMPLES = 5


def double(x):
    return torch.as_tensor(x, dtype=torch.float64)


def close(found, expected, size):
    """Whether every entry is off by no more than some roundings of a size."""
    return bool((np.abs(np.asarray(found) - np.asarray(expected)) <= 1000 * EPS * np.asarray(size)).all())


class Bare(NamedTuple):
    """A robot in random states, and pinocchio's model of it without gravity and rotors."""

    case: Case
    model: pin.Model
    q: torch.Tensor
    qd: torch.Tensor
    u: torch.Tensor

    @property
    def robot(self):
        return self.case.robot

    @property
    def n(self):
        return self.case.robot.n


@cache
def bare(name):
    case = CASES[name]
    model = pin.Model(case.model)
    model.gravity.linear = np.zeros(3)
    model.armature = np.zeros(model.nv)
    s = states(case.robot, batch=SAMPLES)
    return Bare(case, model, s.q, s.qd, 3.0 * s.qdd)


def accelerations(b, effect, *, u=None, **inputs):
    """A scene's accelerations with an effect, or several."""
    scene = Scene(b.robot, effect if isinstance(effect, tuple) else (effect,), integrator=ExplicitEuler(), dt=1.0)
    state = scene.start(b.q, b.qd)
    return (scene.step(state, torque=b.u if u is None else u, **inputs).qd - b.qd).numpy()


class Expected(NamedTuple):
    accelerations: np.ndarray  # [samples, n]
    size: np.ndarray  # that roundings are relative to


def pinocchio(b, torques=0.0, model=None, implicit=None):
    """Accelerations with torques on top of the commanded ones, or another model; `model` may be one per sample.

    `implicit` [samples, n] is added to the diagonal of the mass matrix.
    """
    found, sizes = [], []
    order = b.case.order
    u = b.u.numpy() + torques
    for k in range(SAMPLES):
        m = b.model if model is None else model[k] if isinstance(model, list) else model
        data, q = m.createData(), b.case.configuration(b.q[k])
        v, tau = b.case.velocity(b.qd[k]), b.case.velocity(np.broadcast_to(u[k], b.n))
        M = pin.crba(m, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        if implicit is not None:
            M = M + np.diag(b.case.velocity(implicit[k]))
        h = pin.nle(m, data, q, v)
        found.append(np.linalg.solve(M, tau - h)[order])
        inverse = np.abs(np.linalg.inv(M)).sum(-1)[order]
        sizes.append(inverse * (np.abs(tau).max() + np.abs(h).max() + 1.0) + np.abs(b.qd[k].numpy()))
    return Expected(np.array(found), np.array(sizes))


def agrees(b, effect, *, torques=0.0, model=None, **inputs):
    expected = pinocchio(b, torques, model)
    return close(accelerations(b, effect, **inputs), *expected)


# --- forms of a parameter ---

FORMS = ("number", "list", "tensor", "batched")
# robots and forms: in every form on a tree of all joints, and once on a real arm
ON_ROBOTS = thinned(
    [(name, form) for name in CASES for form in FORMS], [*(("tree", x) for x in FORMS), ("panda", "list")]
)


class Given(NamedTuple):
    parameter: object  # as an effect takes it
    values: np.ndarray  # [samples, size], or [samples] of a parameter that is one number


def given(form, low, high, size, seed):
    """Random values between two bounds in one of the forms of a parameter; size None: it is a single number."""
    rng = np.random.default_rng([20260701, seed])
    trailing = () if size is None else (size,)
    if form == "batched":
        values = rng.uniform(low, high, (SAMPLES, *trailing))
        return Given(double(values), values)
    one = form == "number"
    values = np.full(trailing, rng.uniform(low, high)) if one else np.array(rng.uniform(low, high, trailing))
    parameters = {"number": float(values.flat[0]), "list": values.tolist(), "tensor": double(values)}
    return Given(parameters[form], np.broadcast_to(values, (SAMPLES, *trailing)))


def forms_of(ranges, form, n):
    """Parameters of an effect by name, and their values; a width is one number, whatever the form."""
    found = {
        name: given(form, low, high, None if name == "sign_width" else n, seed)
        for seed, (name, (low, high)) in enumerate(ranges.items())
    }
    return {name: g.parameter for name, g in found.items()}, {name: g.values for name, g in found.items()}


# --- formulas of effects at the joints: ranges of the parameters; damping, stiffness and rest in a state --------------

TARGET = np.random.default_rng(5).normal(size=(SAMPLES, 7))  # of servos


def over_width(qd, width):
    return 1.0 / np.sqrt(qd**2 + np.asarray(width)[..., None] ** 2)


def directional(q, qd, forward, backward, sign_width):
    slope = over_width(qd, sign_width)
    return 0.5 * (forward + backward + (forward - backward) * qd * slope) * slope, 0 * q, 0 * q


def stribeck(q, qd, coulomb, static, velocity, sign_width):
    level = coulomb + (static - coulomb) / (1 + (qd / velocity) ** 2)
    return level * over_width(qd, sign_width), 0 * q, 0 * q


def limits(q, qd, lower, upper, stiffness, dissipation):
    below, above = np.maximum(lower - q, 0), np.maximum(q - upper, 0)
    growing = np.where(below > 0, qd <= 0, qd >= 0)
    beyond = below + above
    return stiffness * dissipation * beyond * growing, stiffness * (beyond > 0), np.clip(q, lower, upper)


FRICTION = {
    "Viscous": ({"coefficient": (0.1, 2.0)}, lambda q, qd, coefficient: (coefficient, 0 * q, 0 * q)),
    "Quadratic": ({"coefficient": (0.1, 2.0)}, lambda q, qd, coefficient: (coefficient * np.abs(qd), 0 * q, 0 * q)),
    "Coulomb": (
        {"coulomb": (0.1, 2.0), "sign_width": (0.1, 1.0)},
        lambda q, qd, coulomb, sign_width: (coulomb * over_width(qd, sign_width), 0 * q, 0 * q),
    ),
    "Directional": ({"forward": (0.5, 1.0), "backward": (1.0, 2.0), "sign_width": (0.1, 1.0)}, directional),
    "Stribeck": (
        {"coulomb": (0.5, 1.0), "static": (1.0, 2.0), "velocity": (0.5, 2.0), "sign_width": (0.1, 1.0)},
        stribeck,
    ),
}
JOINT = {
    **FRICTION,
    "Spring": (
        {"stiffness": (1.0, 20.0), "rest": (-1.0, 1.0)},
        lambda q, qd, stiffness, rest: (0 * q, stiffness, rest),
    ),
    "Servo": ({"kp": (1.0, 20.0), "kd": (0.1, 2.0)}, lambda q, qd, kp, kd: (kd, kp, TARGET[:, : q.shape[-1]])),
    "JointLimits": (
        {"lower": (-0.5, -0.1), "upper": (0.1, 0.5), "stiffness": (10.0, 50.0), "dissipation": (0.1, 2.0)},
        limits,
    ),
}


# --- every effect of two joints: parameters as tensors that require gradients, and the inputs that it needs -----------


def p(*x):
    """Tensor that requires gradients."""
    return double(x if len(x) > 1 else x[0]).requires_grad_()


def warm():
    return {"temperature": p(12.0, -7.0)}


def alone(kind, *rows):
    """An effect of these numbers, which needs no input."""
    return lambda: (kind(*(p(*row) for row in rows)), {})


def warmed(kind, *rows):
    """Friction of these numbers, which depends on the temperature."""
    return lambda: (kind(*(p(*row) for row in rows), warming=p(0.02, 0.01)), warm())


EVERY = {
    "Gravity": alone(effects.Gravity, (1.0, -9.0, 2.0)),
    "RotorInertia": alone(effects.RotorInertia, (0.1, 0.2)),
    "Payload": alone(effects.Payload, (0.7,), (0.1, 0.2, 0.0), (0.02, 0.0, 0.02, 0.0, 0.0, 0.03)),
    "MassScale": alone(effects.MassScale, (0.8, 1.3)),
    "Viscous": warmed(effects.Viscous, (0.3, 0.5)),
    "Quadratic": warmed(effects.Quadratic, (0.3, 0.5)),
    "Coulomb": warmed(effects.Coulomb, (0.3, 0.5), (0.1,)),
    "Directional": warmed(effects.Directional, (0.3, 0.5), (0.6, 0.2), (0.1,)),
    "Stribeck": warmed(effects.Stribeck, (0.3, 0.5), (0.6, 0.8), (0.1, 0.2), (0.1,)),
    "LoadDependent": warmed(effects.LoadDependent, (0.3, 0.2), (0.1,)),
    "LuGre": warmed(effects.LuGre, (0.3, 0.5), (0.2, 0.3), (1.5, 1.2), (0.7, 0.9), (0.1, 0.05)),
    "Ripple": warmed(effects.Ripple, (0.3, 0.5), (0.3, -0.5), (-0.2, 0.1)),
    "Spring": alone(effects.Spring, (3.0, 5.0), (0.1, -0.2)),
    "Servo": lambda: (effects.Servo(p(3.0, 5.0), p(0.2, 0.1), p(9.0, 1.2)), {"target": p(0.5, 0.1)}),
    "JointLimits": alone(effects.JointLimits, (-0.5, -0.6), (0.2, 0.5), (30.0, 50.0), (1.0, 2.0)),
    "Elastic": alone(effects.Elastic, (30.0, 50.0), (0.3, 0.1), (0.2, 0.3)),
    "Push": lambda: (effects.Push(axes="body"), {"push": p(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)}),
    "Drag": lambda: (effects.Drag(p(0.3, 0.1), p(0.2, 0.4), p(0.01, 0.02), p(0.1)), {}),
    "PointSpring": lambda: (effects.PointSpring(None, p(0.3, 0.2, 0.1), p(40.0), p(2.0)), {}),
    "Closures": alone(effects.Closures, (40.0, 30.0), (2.0, 1.0), (3.0, 5.0), (0.5, 0.2)),
    "Contact": lambda: (
        effects.Contact(None, p(1.5), p(0.28, 0.96, 0.0), None, p(40.0), p(0.5), p(0.6), settling=p(0.03)),
        {},
    ),
    "Saturation": lambda: (effects.Saturation(p(1.0, 5.0)), {}),
    "TorqueSpeed": lambda: (effects.TorqueSpeed(p(1.0, 5.0), p(3.0, 4.0)), {}),
    "FirstOrderLag": lambda: (effects.FirstOrderLag(p(0.05, 0.1)), {}),
    "CommandDelay": lambda: (effects.CommandDelay(1), {}),
    "DeadBand": lambda: (effects.DeadBand(p(0.3, 0.4)), {}),
    "Noise": lambda: (effects.Noise(p(0.1, 0.2), p(0.3, 0.4)), {"noise": double([0.3, 0.6, 0.2, 0.9])}),
    "Bias": lambda: (effects.Bias(p(0.1, 0.2), p(0.3, 0.4)), {}),
    "MeasurementDelay": lambda: (effects.MeasurementDelay(1), {}),
    "QuantisedCommand": lambda: (effects.QuantisedCommand(p(0.3, 0.4)), {}),
    "Residual": lambda: (effects.Residual(torch.mul), {}),
    "QuantisedReading": lambda: (effects.QuantisedReading(p(0.03, 0.04), p(0.3, 0.4)), {}),
}


def home_of(kind):
    """Robot on which an effect acts: elastic closures need a loop."""
    robot = CASES["two_link"].robot
    return robot.with_closures(Closure("base", "tip", "weld"), Closure("base", "tip")) if kind == "Closures" else robot


def integrates(kind, integrator):
    """Whether an integrator takes an effect."""
    return isinstance(integrator, LinearlyImplicit) or not getattr(effects, kind).IMPLICIT


def constant(kind):
    """An effect with numbers as parameters, and its inputs."""
    effect, inputs = EVERY[kind]()
    return replace(effect, **{name: x.tolist() for name, x in effect.tensors().items()}), inputs


# --- a robot that is described in everything but rotors --------------------------------------------------------------

LIMITS = {"lower": [-0.4, -1.0], "upper": [0.3, 0.1], "velocity": [2.0, 3.0], "effort": [4.0, 2.0]}
DESCRIBED = {**LIMITS, "damping": [0.5, 0.125], "friction": [0.25, 0.75]}


@cache
def described():
    """Robot whose description has damping, friction and limits."""
    given = {name: double(x) for name, x in DESCRIBED.items()}
    limits = Limits(**{name: given.pop(name) for name in LIMITS})
    return CASES["two_link"].robot.replace(limits=limits, **given)


U = double(np.random.default_rng(7).normal(size=(12, 2)) * 3)  # commands, or states
