"""Characteristic of every effect, simulated: a torque over a velocity, a response over time, a reading over the truth.

All are of one joint with an inertia of 1 kg m^2 (or a mass of 1 kg), and are what the scene's own program computes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchdq
from pages.pictures import Curve, Picture
from torchdq import Scene, effects
from torchdq.effects import Effect
from torchdq.effects.resistance import columns
from torchdq.robot import Robot
from torchdq.scene import State
from torchdq.scene.integrators import ExplicitEuler

POINTS = 121
SMALL = 1e-6  # inertia of a point mass, which a description must have [kg m^2]
VELOCITY, POSITION, TIME = "velocity [rad/s]", "position [rad]", "time [s]"
TORQUE = "torque on the joint [N m]"
KINDS = {  # type and axis of the joint, place of the mass, its inertia
    "wheel": ("continuous", "0 0 1", "0 0 0", 1.0),
    "pendulum": ("continuous", "0 1 0", "0 0 -1", SMALL),
    "mass": ("prismatic", "0 0 1", "0 0 0", SMALL),
}


@cache
def body(kind: str) -> Robot:
    """Robot of one joint: a wheel, a pendulum of 1 m that hangs at zero, or a mass that slides upwards."""
    joint, axis, at, inertia = KINDS[kind]
    limit = '<limit lower="-10" upper="10" effort="0" velocity="0"/>' if joint == "prismatic" else ""
    size = " ".join(f'{name}="{inertia}"' for name in ("ixx", "iyy", "izz"))
    return Robot.from_urdf(
        f"""<robot name="{kind}"><link name="base"/><link name="body"><inertial><origin xyz="{at}"/><mass value="1"/>
        <inertia {size} ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="joint" type="{joint}"><parent link="base"/>
        <child link="body"/><axis xyz="{axis}"/>{limit}</joint><link name="tip"/><joint name="at_the_mass" type="fixed">
        <parent link="body"/><child link="tip"/><origin xyz="{at}"/></joint></robot>"""
    )


def grid(low: float, high: float, points: int = POINTS) -> Tensor:
    """Column of evenly spaced numbers."""
    return torch.linspace(low, high, points, dtype=torch.float64)[:, None]


def column(x: Tensor) -> np.ndarray:
    """Numbers of a column, for a curve."""
    return x.detach().reshape(-1).numpy()


def felt(
    kind: str, parts: Sequence[Effect], q: Any = 0.0, qd: Any = 0.0, torque: Any = 0.0, **inputs: Tensor
) -> Tensor:
    """Torque that acts on the joint in some states, from the velocities after a short step."""
    dt = 1e-3
    scene = Scene(body(kind), tuple(parts), integrator=ExplicitEuler(), dt=dt)
    rows = [torch.as_tensor(x, dtype=torch.float64).reshape(-1, 1) for x in (q, qd, torque)]
    q, qd, torque = torch.broadcast_tensors(*rows)
    return (scene.step(scene.start(q, qd), torque, **inputs).qd - qd) / dt


def motion(kind: str, parts: Sequence[Effect], steps: int, dt: float, q: float = 0.0, **given: Any) -> State:
    """States of a joint after each of some steps, from rest; a number that is given is an input of all steps."""
    scene = Scene(body(kind), tuple(parts), dt=dt)
    inputs = {
        k: torch.full((steps, 1), x, dtype=torch.float64) if isinstance(x, float) else x for k, x in given.items()
    }
    start = scene.start(torch.full((1,), q, dtype=torch.float64))
    return scene.rollout(start, steps=None if inputs else steps, **inputs)


def times(steps: int, dt: float) -> np.ndarray:
    """Times at the ends of some steps [s]."""
    return dt * np.arange(1, steps + 1)


# --- kinds of pictures --------------------------------------------------------------------------------------------


def over_velocity(high: float, **made: Effect) -> Picture:
    """Torques over the velocity."""
    v = grid(-high, high, 2 * POINTS - 1)
    return Picture(
        VELOCITY, TORQUE, {_words(k): Curve(column(v), column(felt("wheel", [e], qd=v))) for k, e in made.items()}
    )


def over_position(low: float, high: float, kind: str = "wheel", **made: Sequence[Effect]) -> Picture:
    """Torques over the position."""
    q = grid(low, high, 2 * POINTS - 1)
    return Picture(POSITION, TORQUE, {_words(k): Curve(column(q), column(felt(kind, e, q=q))) for k, e in made.items()})


def over_command(high: float, **made: Effect) -> Picture:
    """Torques over the commanded torque."""
    u = grid(-high, high, 4 * POINTS - 3)
    curves = {_words(k): Curve(column(u), column(felt("wheel", [e], torque=u))) for k, e in made.items()}
    return Picture("commanded torque [N m]", TORQUE, {**curves, "without": Curve(column(u), column(u))})


def after_a_command(**made: Effect) -> Picture:
    """Torques over time after a command of 1 N m, of a wheel that stands."""
    steps, dt = 20, 0.01
    t = np.repeat(dt * np.arange(steps + 1), 2)[1:-1]

    def torques(parts: Sequence[Effect]) -> np.ndarray:
        v = column(motion("wheel", parts, steps, dt, torque=1.0).qd)
        return np.repeat(np.diff(v, prepend=0.0) / dt, 2)

    curves = {_words(k): Curve(t, torques([e])) for k, e in made.items()}
    return Picture(TIME, TORQUE, {**curves, "without": Curve(t, torques([]))})


def over_time(
    y: str, steps: int, dt: float, made: dict[str, tuple[str, Sequence[Effect]]], what: str, **given: Any
) -> Picture:
    """Positions or velocities over time, of some bodies with some effects."""
    found = {k: getattr(motion(kind, e, steps, dt, **given), what) for k, (kind, e) in made.items()}
    return Picture(TIME, y, {k: Curve(times(steps, dt), column(x)) for k, x in found.items()})


def read(words: str, sensor: Effect, steps: int = 100, dt: float = 0.01) -> Picture:
    """Readings over time of a wheel on a spring, and its true position."""
    scene = Scene(body("wheel"), (effects.Spring(40.0), sensor), dt=dt)
    noise = torch.from_numpy(np.random.default_rng(0).uniform(size=(steps + 1, scene.noises)))
    state = scene.start(torch.ones(1, dtype=torch.float64), noise=noise[0] if scene.noises else None)
    states = scene.rollout(state, steps=steps, noise=noise[1:] if scene.noises else None)
    t = times(steps, dt)
    curves = {words: Curve(t, column(states.measured[0])), "true": Curve(t, column(states.q))}
    return Picture(TIME, POSITION, curves)


def _words(name: str) -> str:
    """Label in a legend, from a keyword: `width__0_1` becomes "width 0.1"."""
    head, _, number = name.partition("__")
    return head.replace("_", " ") + (f" {number.replace('_', '.')}" if number else "")


# --- effects ------------------------------------------------------------------------------------------------------


def _gravity() -> Picture:
    tilted = effects.Gravity((9.81 / 2, 0.0, -9.81 * 3**0.5 / 2))
    return over_position(
        -np.pi, np.pi, "pendulum", upright_base=[effects.Gravity()], base_tilted_by_30_degrees=[tilted]
    )


def _payload() -> Picture:
    q = grid(-np.pi, np.pi)

    def weight(*parts: Effect) -> np.ndarray:
        free, moved = (felt("pendulum", parts, q=q, torque=u) for u in (0.0, 1.0))
        return column(free / (moved - free))  # accelerations times the inertia

    held = effects.Payload(0.5, frame="tip")
    found = {"mass 0.5": weight(effects.Gravity(), held), "without": weight(effects.Gravity())}
    return Picture(POSITION, TORQUE, {k: Curve(column(q), y) for k, y in found.items()})


def _spun(words: str, made: Effect) -> Picture:
    with_and_without: dict[str, tuple[str, Sequence[Effect]]] = {words: ("wheel", (made,)), "without": ("wheel", ())}
    return over_time("velocity under 1 N m [rad/s]", 100, 0.01, with_and_without, "qd", torque=1.0)


def _load() -> Picture:
    u = grid(-10, 10)
    slowly = {"forwards": 0.5, "backwards": -0.5}
    friction = effects.LoadDependent(0.2)
    curves = {k: Curve(column(u), column(felt("wheel", [friction], qd=v, torque=u) - u)) for k, v in slowly.items()}
    return Picture("all other torques on the joint [N m]", "torque of friction [N m]", curves)


def _bristles() -> Picture:
    t = grid(0.0, 2.5, 5 * POINTS)
    size, w = 2e-3, 2 * np.pi
    q, qd = size * torch.sin(w * t), size * w * torch.cos(w * t)
    curves = {}
    for words, ratio in (("ratio 1", 1.0), ("ratio 1.5", 1.5)):
        effect = effects.LuGre(1.0, deflection=5e-4, ratio=ratio)
        torque = columns(body("wheel"), effect, q, qd, time=t[:, 0])["coulomb"]
        last = slice(-3 * POINTS, None)
        curves[words] = Curve(1e3 * column(q)[last], -column(torque)[last])
    return Picture("position, to and fro [mrad]", TORQUE, curves)


def _limits() -> Picture:
    q = grid(0.99, 1.02)
    limit = effects.JointLimits(-1.0, 1.0, stiffness=1e4, dissipation=1.0)
    speeds = {"at rest": 0.0, "inwards at 0.5 rad/s": -0.5, "outwards at 0.5 rad/s": 0.5}
    return Picture(
        POSITION, TORQUE, {k: Curve(column(q), column(felt("wheel", [limit], q=q, qd=v))) for k, v in speeds.items()}
    )


def _servo() -> Picture:
    made = {f"kd {kd:g}": ("wheel", (effects.Servo(100.0, kd),)) for kd in (5.0, 20.0)}
    made["kd 20, limit 20"] = ("wheel", (effects.Servo(100.0, 20.0, limit=20.0),))
    return over_time(POSITION, 120, 0.01, {k: (kind, parts) for k, (kind, parts) in made.items()}, "q", target=1.0)


def _elastic() -> Picture:
    steps, dt = 150, 0.01
    state = motion("wheel", (effects.Elastic(10.0, 0.1, 0.2),), steps, dt, torque=1.0)
    rotor = state.memory[..., :1] if state.memory is not None else state.q
    found = {
        "joint": state.q,
        "rotor": rotor,
        "rigid": motion("wheel", (effects.RotorInertia(0.2),), steps, dt, torque=1.0).q,
    }
    return Picture(
        TIME, "position under 1 N m [rad]", {k: Curve(times(steps, dt), column(x)) for k, x in found.items()}
    )


def _residual() -> Picture:
    return over_velocity(2.0, r_is_tanh_of__4_qd=effects.Residual(lambda q, qd: torch.tanh(4 * qd)))


def _push() -> Picture:
    steps, dt = 150, 0.01
    given = torch.zeros(steps, 6, dtype=torch.float64)
    given[20:40, 0] = 5.0
    parts = (effects.Gravity(), effects.Viscous(1.0))
    pushed = motion("pendulum", (*parts, effects.Push("tip")), steps, dt, push=given)
    still = motion("pendulum", parts, steps, dt)
    curves = {"pushed from 0.2 to 0.4 s": pushed.q, "without": still.q}
    return Picture(TIME, POSITION, {k: Curve(times(steps, dt), column(x)) for k, x in curves.items()})


def _drag() -> Picture:
    v = grid(-3, 3)
    made = {"linear 0.5": effects.Drag(linear=0.5), "quadratic 0.5": effects.Drag(quadratic=0.5)}
    curves = {k: Curve(column(v), column(felt("mass", [e], qd=v))) for k, e in made.items()}
    return Picture("velocity [m/s]", "force on the body [N]", curves)


def _point_spring() -> Picture:
    steps, dt = 400, 0.005
    found = {}
    for b in (0.0, 2.0):
        parts = (effects.Gravity(), effects.PointSpring("body", (0.0, 0.0, 0.5), stiffness=50.0, damping=b))
        found[f"damping {b:g}"] = motion("mass", parts, steps, dt, q=0.5).q
    return Picture(TIME, "height of a mass [m]", {k: Curve(times(steps, dt), column(x)) for k, x in found.items()})


def _closures() -> Picture:
    steps, dt = 300, 0.01
    robot = torchdq.robots.load("two_link").with_closures(torchdq.Closure("base", "tip"))
    found = {}
    for k in (20.0, 200.0):
        scene = Scene(robot, (effects.Viscous(0.5), effects.Closures(k)), dt=dt)
        states = scene.rollout(scene.start(torch.tensor([0.2, 0.8], dtype=torch.float64)), steps=steps)
        found[f"stiffness {k:g}"] = torchdq.closure_errors(robot, states.q).distance[:, 0]
    return Picture(TIME, "gap [m]", {k: Curve(times(steps, dt), column(x)) for k, x in found.items()})


def _contact() -> Picture:
    steps, dt = 1500, 0.001
    found = {}
    for c in (0.1, 1.0):
        parts = (effects.Gravity(), effects.Contact("body", stiffness=1e4, dissipation=c))
        found[f"dissipation {c:g}"] = motion("mass", parts, steps, dt, q=0.5).q[::5]
    return Picture(
        TIME, "height of a falling mass [m]", {k: Curve(times(steps, dt)[::5], column(x)) for k, x in found.items()}
    )


def _motor() -> Picture:
    v = grid(-3, 3)
    motor = effects.TorqueSpeed(5.0, 2.0)
    most = {"largest": 100.0, "smallest": -100.0}
    return Picture(
        VELOCITY, TORQUE, {k: Curve(column(v), column(felt("wheel", [motor], qd=v, torque=u))) for k, u in most.items()}
    )


CHARACTERISTICS: dict[str, Callable[[], Picture]] = {
    "Gravity": _gravity,
    "RotorInertia": lambda: _spun("rotor of 0.5 kg m²", effects.RotorInertia(0.5)),
    "Payload": _payload,
    "MassScale": lambda: _spun("factor 1.5", effects.MassScale(1.5)),
    "Viscous": lambda: over_velocity(2.0, coefficient__0_5=effects.Viscous(0.5), coefficient__1=effects.Viscous(1.0)),
    "Quadratic": lambda: over_velocity(
        2.0, coefficient__0_5=effects.Quadratic(0.5), coefficient__1=effects.Quadratic(1.0)
    ),
    "Coulomb": lambda: over_velocity(
        0.5, sign_width__0_01=effects.Coulomb(1.0, 0.01), sign_width__0_1=effects.Coulomb(1.0, 0.1)
    ),
    "Directional": lambda: over_velocity(
        0.5, sign_width__0_01=effects.Directional(1.0, 0.5), sign_width__0_1=effects.Directional(1.0, 0.5, 0.1)
    ),
    "Stribeck": lambda: over_velocity(
        0.5, velocity__0_1=effects.Stribeck(0.5, 1.0, 0.1), velocity__0_03=effects.Stribeck(0.5, 1.0, 0.03)
    ),
    "LoadDependent": _load,
    "LuGre": _bristles,
    "Ripple": lambda: over_position(
        0.0, 1.0, sine__0_5=[effects.Ripple(0.5, 0.5, 0.0)], cosine__0_5=[effects.Ripple(0.5, 0.0, 0.5)]
    ),
    "Spring": lambda: over_position(-1.0, 1.0, rest__0=[effects.Spring(5.0)], rest__0_5=[effects.Spring(5.0, 0.5)]),
    "Servo": _servo,
    "JointLimits": _limits,
    "Elastic": _elastic,
    "Residual": _residual,
    "Push": _push,
    "Drag": _drag,
    "PointSpring": _point_spring,
    "Closures": _closures,
    "Contact": _contact,
    "Saturation": lambda: over_command(4.0, limit__2=effects.Saturation(2.0)),
    "TorqueSpeed": _motor,
    "FirstOrderLag": lambda: after_a_command(
        time__0_02=effects.FirstOrderLag(0.02), time__0_05=effects.FirstOrderLag(0.05)
    ),
    "CommandDelay": lambda: after_a_command(steps__5=effects.CommandDelay(5)),
    "DeadBand": lambda: over_command(4.0, width__1=effects.DeadBand(1.0)),
    "QuantisedCommand": lambda: over_command(2.0, step__0_5=effects.QuantisedCommand(0.5)),
    "Noise": lambda: read("read, position 0.05", effects.Noise(0.05)),
    "Bias": lambda: read("read, position 0.2", effects.Bias(0.2)),
    "QuantisedReading": lambda: read("read, position 0.2", effects.QuantisedReading(0.2)),
    "MeasurementDelay": lambda: read("read, steps 10", effects.MeasurementDelay(10)),
}
