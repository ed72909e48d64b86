"""One example of every effect: how it is made, how it is switched off, and code that uses it."""

from __future__ import annotations

import textwrap
from typing import NamedTuple

import torch

import torchdq
from torchdq import effects
from torchdq.effects import Effect

START = """import torch

import torchdq
from torchdq import Scene, effects

robot = torchdq.robots.load("two_link")
"""


class Case(NamedTuple):
    """An effect as its page shows it."""

    made: str  # Python, for a robot of any number of joints
    code: str  # what follows START
    off: str = ""  # the same effect of no size; "": it has none


def built(made: str) -> Effect:
    """Effect of its Python."""
    return eval(made, {"effects": effects, "torch": torch, "torchdq": torchdq})


def _case(made: str, code: str, off: str = "") -> Case:
    return Case(made, textwrap.dedent(code).strip(), off)


CASES: dict[str, Case] = {
    # --- model ---
    "Gravity": _case(
        "effects.Gravity()",
        """
        scene = Scene(robot, (effects.Gravity(),))  # the robot's own acceleration
        # a base on a slope of 30 degrees
        tilted = Scene(robot, (effects.Gravity((4.9, -8.5, 0.0)),))
        state = scene.step(scene.start(torch.zeros(robot.n)))
        """,
        "effects.Gravity((0.0, 0.0, 0.0))",
    ),
    "RotorInertia": _case(
        "effects.RotorInertia(0.1)",
        """
        torque = torch.tensor([1.0, 0.0])
        light, heavy = Scene(robot), Scene(robot, (effects.RotorInertia(0.5),))
        start = light.start(torch.zeros(robot.n))
        assert heavy.step(start, torque).qd[0] < light.step(start, torque).qd[0]
        """,
        "effects.RotorInertia(0.0)",
    ),
    "Payload": _case(
        "effects.Payload(1.5, com=(0.0, 0.0, 0.05))",
        """
        mass = torch.rand(64)  # each of 64 samples holds a mass of its own
        scene = Scene(robot, (effects.Gravity(), effects.Payload(mass)))
        state = scene.rollout(scene.start(torch.zeros(64, robot.n)), steps=10)
        """,
        "effects.Payload(0.0)",
    ),
    "MassScale": _case(
        "effects.MassScale(1.1)",
        """
        factor = 1 + 0.1 * torch.randn(64, 2).clamp(-2, 2)  # 64 arms whose links differ
        scene = Scene(robot, (effects.Gravity(), effects.MassScale(factor)))
        state = scene.rollout(scene.start(torch.zeros(64, robot.n)), steps=10)
        """,
        "effects.MassScale(1.0)",
    ),
    # --- joint ---
    "Viscous": _case(
        "effects.Viscous(0.5)",
        """
        coefficient = torch.tensor([0.5, 0.2], requires_grad=True)  # learned
        scene = Scene(robot, (effects.Viscous(coefficient),))
        state = scene.rollout(scene.start(torch.zeros(2), torch.ones(2)), steps=20)
        state.qd[-1].sum().backward()
        print(coefficient.grad)
        """,
        "effects.Viscous(0.0)",
    ),
    "Quadratic": _case(
        "effects.Quadratic(0.2)",
        """
        scene = Scene(robot, (effects.Quadratic(0.2),))
        state = scene.rollout(scene.start(torch.zeros(2), torch.ones(2)), steps=20)
        # the same law in a layer
        layer = torchdq.DQRNEA(robot, friction=(effects.Quadratic(0.2),))
        """,
        "effects.Quadratic(0.0)",
    ),
    "Coulomb": _case(
        "effects.Coulomb(0.5)",
        """
        scene = Scene(robot, (effects.Coulomb(coulomb=2.0),))
        state = scene.rollout(scene.start(torch.zeros(2), torch.ones(2)), steps=200)
        assert state.qd[-1].abs().max() < 1e-3  # it has come to rest
        """,
        "effects.Coulomb(0.0)",
    ),
    "Directional": _case(
        "effects.Directional(0.5, 0.3)",
        """
        scene = Scene(robot, (effects.Directional(forward=0.5, backward=0.1),))
        forth = scene.rollout(scene.start(torch.zeros(2), torch.ones(2)), steps=20)
        back = scene.rollout(scene.start(torch.zeros(2), -torch.ones(2)), steps=20)
        """,
        "effects.Directional(0.0, 0.0)",
    ),
    "Stribeck": _case(
        "effects.Stribeck(0.5, 0.8)",
        """
        scene = Scene(robot, (effects.Stribeck(coulomb=0.5, static=0.8, velocity=0.1),))
        state = scene.rollout(scene.start(torch.zeros(2)), torch.full((20, 2), 0.6))
        """,
        "effects.Stribeck(0.0, 0.0)",
    ),
    "LoadDependent": _case(
        "effects.LoadDependent(0.1)",
        """
        friction = (effects.LoadDependent(0.1), effects.Viscous(0.2))
        layer = torchdq.DQRNEA(robot, friction=friction)  # torques of the motors
        q, qd, qdd = torch.randn(3, 16, 2)
        tau = layer(q, qd, qdd)
        scene = Scene(robot, friction)
        """,
        "effects.LoadDependent(0.0)",
    ),
    "LuGre": _case(
        "effects.LuGre(0.5)",
        """
        scene = Scene(robot, (effects.LuGre(coulomb=0.5, deflection=1e-3),))
        state = scene.rollout(scene.start(torch.zeros(2)), torch.full((100, 2), 0.2))
        assert state.q[-1].abs().max() < 1e-2  # it holds below its Coulomb friction
        assert state.memory.shape == (100, 2)  # the deflections
        """,
    ),
    "Ripple": _case(
        "effects.Ripple(0.1, 0.05, 0.02)",
        """
        teeth = 2 * torch.pi / 50
        scene = Scene(robot, (effects.Ripple(period=teeth, sine=0.05, cosine=0.02),))
        state = scene.rollout(scene.start(torch.zeros(2), torch.ones(2)), steps=20)
        """,
        "effects.Ripple(0.1, 0.0, 0.0)",
    ),
    "Spring": _case(
        "effects.Spring(5.0, 0.3)",
        """
        scene = Scene(robot, (effects.Spring(stiffness=5.0, rest=0.3),))
        state = scene.rollout(scene.start(torch.zeros(2)), steps=20)
        """,
        "effects.Spring(0.0)",
    ),
    "Servo": _case(
        "effects.Servo(100.0, 10.0)",
        """
        servo = effects.Servo(kp=400.0, kd=40.0, limit=[30.0, 10.0])
        scene = Scene(robot, (effects.Gravity(), servo))
        target = torch.tensor([0.5, -0.5]).expand(100, 2)  # an input of every step
        state = scene.rollout(scene.start(torch.zeros(2)), target=target)
        """,
        "effects.Servo(0.0)",
    ),
    "JointLimits": _case(
        "effects.JointLimits()",
        """
        scene = Scene(robot, (effects.JointLimits(lower=-1.0, upper=1.0),))
        state = scene.rollout(scene.start(torch.zeros(2), torch.ones(2)), steps=300)
        assert state.q.abs().max() < 1.1
        """,
        'effects.JointLimits(-float("inf"), float("inf"))',
    ),
    "Elastic": _case(
        "effects.Elastic(1000.0, 1.0, 0.1)",
        """
        scene = Scene(robot, (effects.Elastic(stiffness=1000.0, damping=1.0, inertia=0.1),))
        state = scene.rollout(scene.start(torch.zeros(2)), torch.ones(20, 2))
        rotors = state.memory[..., :2]  # their positions; the velocities follow
        """,
    ),
    "Residual": _case(
        "effects.Residual(lambda q, qd: 0.1 * qd)",
        """
        network = torch.nn.Linear(4, 2)
        learned = effects.Residual(lambda q, qd: network(torch.cat([q, qd], -1)))
        scene = Scene(robot, (effects.Gravity(), learned))
        state = scene.rollout(scene.start(torch.zeros(8, 2)), steps=5)
        state.q.square().mean().backward()  # gradients of the network
        """,
    ),
    # --- body ---
    "Push": _case(
        "effects.Push()",
        """
        scene = Scene(robot, (effects.Push(axes="world"),))
        force = torch.tensor([0.0, 5.0, 0.0, 0.0, 0.0, 0.0])  # force, then moment
        state = scene.step(scene.start(torch.zeros(2)), push=force)
        state = scene.step(state)  # a step without it
        """,
    ),
    "Drag": _case(
        "effects.Drag(0.5, 0.2, 0.01)",
        """
        scene = Scene(robot, (effects.Drag(linear=0.5, quadratic=0.2),))
        state = scene.rollout(scene.start(torch.zeros(2), torch.ones(2)), steps=20)
        """,
        "effects.Drag()",
    ),
    "PointSpring": _case(
        "effects.PointSpring(damping=10.0)",
        """
        anchor = (1.0, 1.0, 0.0)
        spring = effects.PointSpring("tip", anchor, stiffness=200.0, damping=20.0)
        scene = Scene(robot, (effects.Viscous(2.0), spring))
        state = scene.rollout(scene.start(torch.tensor([0.2, 0.8])), steps=500).last
        tip = torchdq.dq.translation(torchdq.forward_kinematics(robot, state.q, "tip"))
        assert torch.allclose(tip, torch.tensor([1.0, 1.0, 0.0]), atol=0.02)
        """,
        "effects.PointSpring(stiffness=0.0)",
    ),
    "Closures": _case(
        "effects.Closures(1e5, damping=100.0, rotational_stiffness=100.0)",
        """
        loop = robot.with_closures(torchdq.Closure("base", "tip"))  # an elastic band
        scene = Scene(loop, (effects.Viscous(1.0), effects.Closures(stiffness=20.0)))
        state = scene.rollout(scene.start(torch.tensor([0.2, 0.8])), steps=500).last
        assert torchdq.closure_errors(loop, state.q).distance < 0.01
        """,
    ),
    "Contact": _case(
        "effects.Contact(height=0.1, friction=0.5)",
        """
        floor = effects.Contact("tip", height=-1.0, normal=(0.0, 1.0, 0.0), friction=0.5)
        scene = Scene(robot, (effects.Gravity(), effects.Viscous(0.5), floor), dt=0.005)
        states = scene.rollout(scene.start(torch.zeros(2)), steps=400)
        # of every step: force [400, 1, 3], touching, depth, slip
        found = scene.contacts(states)
        assert found.touching[-1].all() and found.force[-1, 0, 1] > 0
        """,
        "effects.Contact(stiffness=0.0, stiction=False)",
    ),
    # --- actuator ---
    "Saturation": _case(
        "effects.Saturation()",
        """
        scene = Scene(robot, (effects.Saturation(limit=2.0),))
        state = scene.start(torch.zeros(2))
        ends = [scene.step(state, torch.full((2,), tau)).qd for tau in (2.0, 9.0)]
        assert torch.equal(*ends)
        """,
        'effects.Saturation(float("inf"))',
    ),
    "TorqueSpeed": _case(
        "effects.TorqueSpeed()",
        """
        scene = Scene(robot, (effects.TorqueSpeed(stall=5.0, speed=2.0),))
        state = scene.rollout(scene.start(torch.zeros(2)), torch.full((100, 2), 5.0))
        """,
        'effects.TorqueSpeed(float("inf"), 1.0)',
    ),
    "FirstOrderLag": _case(
        "effects.FirstOrderLag(0.02)",
        """
        scene = Scene(robot, (effects.FirstOrderLag(time=0.02),))
        state = scene.rollout(scene.start(torch.zeros(2)), torch.ones(20, 2))
        """,
    ),
    "CommandDelay": _case(
        "effects.CommandDelay(2)",
        """
        scene = Scene(robot, (effects.CommandDelay(steps=2),))
        state = scene.rollout(scene.start(torch.zeros(2)), torch.ones(3, 2))
        assert state.qd[1].abs().max() == 0 and state.qd[2].abs().max() > 0
        """,
    ),
    "DeadBand": _case(
        "effects.DeadBand(0.2)",
        """
        scene = Scene(robot, (effects.DeadBand(width=0.2),))
        state = scene.step(scene.start(torch.zeros(2)), torch.full((2,), 0.1))
        assert state.qd.abs().max() == 0
        """,
        "effects.DeadBand(0.0)",
    ),
    "QuantisedCommand": _case(
        "effects.QuantisedCommand(0.1)",
        """
        scene = Scene(robot, (effects.QuantisedCommand(step=0.1),))
        # acts as 0 and 0.3
        state = scene.step(scene.start(torch.zeros(2)), torch.tensor([0.04, 0.26]))
        """,
    ),
    # --- sensor ---
    "Noise": _case(
        "effects.Noise(0.001, 0.01)",
        """
        scene = Scene(robot, (effects.Noise(position=0.001, velocity=0.01),))
        state = scene.step(scene.start(torch.zeros(512, 2)))
        q, qd = state.measured
        """,
    ),
    "Bias": _case(
        "effects.Bias(0.01, 0.02)",
        """
        scene = Scene(robot, (effects.Bias(position=0.01),))
        state = scene.step(scene.start(torch.zeros(2)))
        q, qd = state.measured
        """,
    ),
    "QuantisedReading": _case(
        "effects.QuantisedReading(0.001, 0.01)",
        """
        counts = 2 * torch.pi / 4096  # an encoder of 12 bits
        scene = Scene(robot, (effects.QuantisedReading(position=counts),))
        state = scene.step(scene.start(torch.zeros(2), torch.ones(2)))
        q, qd = state.measured
        """,
    ),
    "MeasurementDelay": _case(
        "effects.MeasurementDelay(2)",
        """
        scene = Scene(robot, (effects.MeasurementDelay(steps=2),))
        state = scene.rollout(scene.start(torch.zeros(2), torch.ones(2)), steps=3)
        q, qd = state.measured
        """,
    ),
}
