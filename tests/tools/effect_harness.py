"""Harness for tests of effects: a scene's accelerations compared with pinocchio's.

An explicit Euler step of one second adds the accelerations to the velocities, so a scene's accelerations are compared
with pinocchio's under the torques, wrenches or changed bodies that the effect stands for. Tolerances are roundings of
the largest torque, turned into accelerations by the inverse of the mass matrix.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import torch
from oracles import Case, random_tree, shipped, states

import torchdq
from torchdq.envs import Scene
from torchdq.scene.integrators import ExplicitEuler

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
        data = m.createData()
        q, v, tau = (
            b.case.configuration(b.q[k]),
            b.case.velocity(b.qd[k]),
            b.case.velocity(np.broadcast_to(u[k], b.n)),
        )
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
    values = rng.uniform(low, high) * np.ones(trailing) if form == "number" else rng.uniform(low, high, trailing)
    parameter = {"number": float(values.flat[0]) if trailing else float(values), "list": values.tolist()}.get(
        form, double(values)
    )
    return Given(parameter, np.broadcast_to(values, (SAMPLES, *trailing)))


def forms_of(ranges, form, n, sizes=None):
    """Parameters of an effect by name, and their values."""
    found = {
        name: given(form, low, high, (sizes or {}).get(name, n), seed)
        for seed, (name, (low, high)) in enumerate(ranges.items())
    }
    return {name: g.parameter for name, g in found.items()}, {name: g.values for name, g in found.items()}


# --- a robot whose file gives friction and limits ---

URDF = """
<robot name="described">
  <link name="base"/>
  {links}
</robot>"""
LINK = """
  <link name="l{i}"><inertial><origin xyz="0.1 0 -0.3"/><mass value="1.5"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="l{i}"/>
    <origin xyz="0 0 -0.5" rpy="0.3 0 0.2"/><axis xyz="0 1 0"/>
    <limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="{velocity}"/>
    <dynamics damping="{damping}" friction="{friction}"/></joint>"""
DESCRIBED = [
    {"lower": -0.4, "upper": 0.3, "effort": 4.0, "velocity": 2.0, "damping": 0.5, "friction": 0.25},
    {"lower": -1.0, "upper": 0.1, "effort": 2.0, "velocity": 3.0, "damping": 0.125, "friction": 0.75},
]


@cache
def described():
    """Robot of a file that gives damping, friction and limits."""
    links = [LINK.format(i=i, parent=f"l{i - 1}" if i else "base", **joint) for i, joint in enumerate(DESCRIBED)]
    return torchdq.Robot.from_urdf(URDF.format(links="".join(links)))


def described_as(key):
    return [joint[key] for joint in DESCRIBED]


U = double(np.random.default_rng(7).normal(size=(12, 2)) * 3)  # commands, or states
