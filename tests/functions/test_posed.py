"""Robots without mass: kinematics as with mass, and an error, whatever asks for dynamics."""

import warnings

import pytest
import torch
from helpers import all_in_one, random
from messages import refused, warned
from urdf_text import also, arm, codes, fixed, joint, link, same, tree, urdf

import torchdq
from torchdq import Robot, Scene, SingularInertiaError, effects
from torchdq.scene import controllers

F64 = torch.float64


def bare(text):
    """Text of a file without its <inertial> elements."""
    start, *rest = text.split("<inertial>")
    return start + "".join(part.split("</inertial>")[1] for part in rest)


def loaded(text, **options):
    """Robot of a file that is told to have kinematics only."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Robot.from_urdf(text, **options)


ARM = loaded(bare(arm()))
FOLLOWED = loaded(
    bare(tree().replace('child link="left2"/>', 'child link="left2"/><mimic joint="waist" multiplier="2"/>'))
)
ROBOTS = {
    "an arm": ARM,
    "a joint that follows": FOLLOWED,
    "screws": Robot.from_screws(
        [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0]], [0.0] * 2, [[0.1, 0, 0]] * 2, [[0.0] * 6] * 2, on_unphysical="ignore"
    ),
    "one that was locked": Robot.from_urdf(
        urdf(link("base", None), link("a"), link("b", None), joint("j", "base", "a"), joint("k", "a", "b"))
    ).lock({"j": 0.5}),
    "a mass on the base": loaded(bare(arm()).replace('<link name="base">', link("base", 5.0)[:-7])),
}


def needs(robot):
    """Everything that asks for dynamics, by name."""
    q = torch.zeros(robot.n, dtype=F64)
    scene = Scene(robot, (effects.Gravity(), effects.Viscous(0.1)), dt=0.01)
    return {
        "inverse_dynamics": lambda: torchdq.inverse_dynamics(robot, q, q, q),
        "forward_dynamics": lambda: torchdq.forward_dynamics(robot, q, q, q),
        "mass_matrix": lambda: torchdq.mass_matrix(robot, q),
        "closed_form": lambda: torchdq.closed_form(robot, q, q),
        "dynamics_jacobian": lambda: torchdq.dynamics_jacobian(robot, q, q, q),
        "coriolis_matrix": lambda: torchdq.coriolis_matrix(robot, q, q),
        "kinetic_energy": lambda: torchdq.kinetic_energy(robot, q, q),
        "error_growth": lambda: torchdq.error_growth(robot, q),
        "compile": lambda: torchdq.compile(robot, "inverse_dynamics"),
        "DQRNEA": lambda: torchdq.DQRNEA(robot)(q, q, q),
        "DQRNEA with friction": lambda: torchdq.DQRNEA(robot, learn="friction")(q, q, q),
        "ComputedTorque": lambda: torchdq.ComputedTorque(robot, 1.0, 1.0)(q, q, q, q, q),
        "a scene": lambda: scene.step(scene.start(q)),
        "its description": lambda: scene.describe(),
        "a controller": lambda: controllers.ComputedTorque(1.0, 1.0).program(robot),
        "an environment": lambda: torchdq.envs.RobotVectorEnv(2, robot=robot.with_tip(robot.frame_names[-1])),
    }


@all_in_one(ROBOTS)
def test_dynamics_of_a_robot_without_mass_are_refused_by_name(name):
    robot = ROBOTS[name]
    for what, ask in needs(robot).items():
        with pytest.raises(SingularInertiaError) as caught:
            ask()
        assert "kinematics only" in str(caught.value) and repr(robot.name) in str(caught.value), what
        assert [x.code for x in caught.value.findings] == ["robot.massless"]


def test_a_robot_without_mass_is_told_of_once_at_load_and_in_its_report():
    with warned(UserWarning) as seen:
        robot = Robot.from_urdf(bare(arm()))
    assert len(seen) == 1 and seen[0].filename == __file__ and ("robot.massless", "") in codes(robot)
    assert "kinematics only" in str(robot.report()) and str(robot.report()).count("moves no inertia") == 0
    with refused(SingularInertiaError):
        torchdq.mass_matrix(robot, torch.zeros(2, dtype=F64))
    with refused(SingularInertiaError):
        torchdq.forward_dynamics(robot, *torch.zeros(3, 2, dtype=F64))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Robot.from_urdf(bare(arm()), on_unphysical="ignore")
        Robot.from_urdf(urdf(link("base", None), link("tool", None), fixed("f", "base", "tool")))  # nothing moves
        heavier = robot.replace(mass=torch.ones(2, dtype=F64))
    assert ("robot.massless", "") not in codes(heavier) | codes(robot.with_payload(1.0, (0, 0, 0.1)))


@all_in_one([arm(), tree().replace('child link="left2"/>', 'child link="left2"/><mimic joint="waist"/>')])
def test_kinematics_and_the_regressor_are_those_of_the_robot_with_mass(text):
    robot, heavy = loaded(bare(text)), Robot.from_urdf(text)
    q, qd, qdd = (random(5, robot.n, seed=k, dtype=F64) for k in range(3))
    frame = robot.frame_names[-1]
    for name, given in (("forward_kinematics", (q,)), ("jacobian", (q, frame)), ("frame_motion", (q, qd, None, frame))):
        mine, theirs = (getattr(torchdq, name)(x, *given) for x in (robot, heavy))
        for a, b in zip(*([x] if torch.is_tensor(x) else x for x in (mine, theirs)), strict=True):
            assert same(a, b), name
    Y = torchdq.regressor(robot, q, qd, qdd)
    assert same(Y @ heavy.inertial_parameters, torchdq.inverse_dynamics(heavy, q, qd, qdd), 1e-13)
    X = torchdq.forward_kinematics(heavy, q.clamp(-0.9, 1.9), frame)
    found = torchdq.inverse_kinematics(robot, X, frame, axes=("x",))
    assert bool(found.converged.all())


def test_rotors_payloads_and_masses_that_are_learned_or_vary_are_dynamics():
    q = torch.zeros(2, dtype=F64)
    J = torch.tensor([0.5, 0.25], dtype=F64)
    assert torch.equal(torchdq.mass_matrix(ARM.replace(armature=J).bake(), q), torch.diag(J))  # rotors alone
    scene = Scene(ARM, (effects.RotorInertia(J),), dt=0.01)
    assert scene.step(scene.start(q), torque=J).qd.allclose(torch.full_like(q, 0.01))
    # a point on the upper link, whose inertia about the shoulder is m r^2
    m, r = 2.0, 0.5
    held = effects.Payload(mass=m, com=(r, 0.0, 0.0), frame="lower")
    scene = Scene(ARM, (held, effects.RotorInertia(J)), dt=0.01)
    assert bool(scene.step(scene.start(q)).qd.isfinite().all())
    zero = torch.zeros(2, dtype=F64)
    layer = torchdq.DQRNEA(ARM, learn="mass")
    layer(zero, zero, zero + 1).sum().backward()
    assert layer.parametrizations.mass.original.grad is not None
    start = zero.clone().requires_grad_()  # learned from nothing
    (slope,) = torch.autograd.grad(
        torchdq.inverse_dynamics(ARM.replace(mass=start), zero + 0.3, zero, zero).sum(), start
    )
    assert bool((slope != 0).any())
    masses = torch.tensor([[0.0, 0.0], [1.0, 0.5]], dtype=F64)  # a batch
    tau = torchdq.inverse_dynamics(ARM.replace(mass=masses), zero + 0.3, zero, zero)
    assert bool((tau[0] == 0).all()) and bool((tau[1] != 0).any())


def test_a_joint_that_moves_nothing_beside_others_has_torques():
    robot = Robot.from_urdf(also(link("finger", None) + joint("knuckle", "lower", "finger")))
    assert bool(torchdq.inverse_dynamics(robot, *torch.ones(3, 3, dtype=F64)).isfinite().all())
    with pytest.raises(SingularInertiaError) as caught:
        torchdq.forward_dynamics(robot, *torch.ones(3, 3, dtype=F64))
    assert [x.code for x in caught.value.findings] == ["joint.inert"]
