"""Programs of layers and controllers are what the layers compute, with what they learned as constants or arguments."""

import inspect

import pytest
import torch
from helpers import all_in_one, eager, thinned
from messages import refused

import torchdq
from torchdq import effects
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.scene import controllers

F64 = torch.float64
LEARN = ("mass", "com", "inertia", "armature", "friction", "offset")


def rows(*names, n=7):
    generator = torch.Generator().manual_seed(3)
    width = {"f_tip": 6, "f_ext": 6 * n}
    return {name: torch.rand(6, width.get(name, n), generator=generator, dtype=F64) - 0.4 for name in names}


def shifted(layer):
    """The layer, whose parameters have moved as an optimiser moves them."""
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for x in layer.parameters():
            x += 0.1 * (torch.rand(x.shape, generator=generator, dtype=x.dtype) - 0.5)
    return layer


PANDA = torchdq.robots.load("panda")
DESCRIBED = PANDA.replace(damping=torch.linspace(0.1, 0.7, 7, dtype=F64), friction=torch.full((7,), 0.3, dtype=F64))
RUBBING = (effects.Directional(0.3, 0.2), effects.LoadDependent(0.1), effects.Ripple(0.5, 0.1, -0.2))
LAYERS = {
    "inverse": lambda: torchdq.DQRNEA(PANDA, LEARN),
    "forward": lambda: torchdq.ForwardDynamics(PANDA, LEARN),
    "nothing learned": lambda: torchdq.InverseDynamics(PANDA),
    "offset alone": lambda: torchdq.ForwardDynamics(PANDA, "offset"),
    "controller": lambda: torchdq.ComputedTorque(DESCRIBED, 30.0, torch.arange(1.0, 8.0)),
    "without friction": lambda: torchdq.ComputedTorque(DESCRIBED, 30.0, 9.0, friction=False),
    "learned gains": lambda: torchdq.ComputedTorque(
        DESCRIBED, torch.arange(1.0, 8.0), 5.0, learn=("kp", "kd", "mass", "friction")
    ),
    "controller of a layer": lambda: torchdq.ComputedTorque(
        shifted(torchdq.DQRNEA(DESCRIBED, LEARN)), 30.0, 9.0, learn="kd"
    ),
    "friction": lambda: torchdq.DQRNEA(PANDA, friction=(effects.Stribeck(0.3, 0.4), *RUBBING)),
    "friction forward": lambda: torchdq.ForwardDynamics(PANDA, ("friction", "offset"), friction=RUBBING),
    "friction controlled": lambda: torchdq.ComputedTorque(DESCRIBED, 30.0, 9.0, learn="friction", friction=RUBBING),
}


def quantity(layer, name):
    """Present value of a quantity that a layer learned, or its model."""
    owner = layer if hasattr(layer, name) else layer.model
    return getattr(owner, name).detach()


@pytest.mark.parametrize("parameters", thinned(["constants", "arguments"], ("arguments",)))
@pytest.mark.parametrize("name", LAYERS)
def test_the_program_of_a_layer_computes_what_the_layer_does(name, parameters):
    layer = shifted(LAYERS[name]())
    given = rows(*(name for name in inspect.signature(layer.forward).parameters if name != "f_ext"))
    program = layer.program("f_tip", parameters=parameters)
    extra = [a for a in program.arguments if a.name not in given]
    assert all(a.uniform for a in extra) and bool(extra) == (
        parameters == "arguments" and bool(list(layer.parameters()))
    )
    present = [quantity(layer, a.name).reshape(-1) for a in extra]
    (found,) = eager(program, [*(given[a.name] for a in program.arguments if a.name in given), *present])
    expected = layer(*given.values()).detach()
    torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-11 * float(expected.abs().max()))


def test_friction_is_in_the_program_once():
    controller = torchdq.ComputedTorque(DESCRIBED, 30.0, 9.0)
    plain = torchdq.ComputedTorque(DESCRIBED, 30.0, 9.0, friction=False)
    count = [torchdq.compile(layer.program()).count() for layer in (controller, plain)]
    assert count[0].roots == 7 and count[1].roots == 0


def test_robots_with_batch_axes_are_arguments():
    robot = torchdq.robots.load("two_link")
    layer = torchdq.DQRNEA(robot.replace(mass=robot.mass * torch.ones(3, 1, dtype=F64)))
    assert [a.uniform for a in layer.program(parameters="arguments").arguments] == [False] * 4
    with refused(ArgumentError):
        layer.program()
    layer = torchdq.DQRNEA(robot, "friction")
    layer.viscous = torch.ones(3, 2, dtype=F64)
    with refused(ArgumentError):
        layer.program()


MISUSE = [
    lambda network: network.program(),
    lambda network: torchdq.ComputedTorque(network, 30.0, 9.0).program(),
    lambda network: network.model.program("f_base"),
    lambda network: network.model.program(parameters="both"),
]


@all_in_one(MISUSE)
def test_what_has_no_program_is_refused_with_the_way_to_export_it(call):
    with refused((ArgumentError, UnknownNameError)):
        call(torchdq.ResidualDynamics(torchdq.DQRNEA(torchdq.robots.load("two_link"))))


@all_in_one(
    [
        lambda robot: controllers.ComputedTorque(30.0, (9.0, 8.0)),
        lambda robot: controllers.ComputedTorque(30.0, 9.0, model=robot.replace(mass=1.5 * robot.mass)),
        lambda robot: controllers.PD(30.0, torch.tensor([9.0, 8.0])),
        lambda robot: controllers.PD(30.0, 9.0, model=robot),
    ]
)
def test_the_program_of_a_controller_is_its_part_of_a_scene(make):
    robot = torchdq.robots.load("two_link")
    controller = make(robot)
    given = rows("q", "qd", "q_des", "qd_des", "qdd_des", n=2)
    q, qd, *desired = given.values()
    program = controller.program(robot)
    given["kd"] = torch.tensor([9.0, 8.0], dtype=F64)
    (found,) = eager(program, [given[a.name] for a in program.arguments])
    kp, kd = (torch.as_tensor(x, dtype=F64) for x in (controller.kp, controller.kd))
    model = controller.model
    if isinstance(controller, controllers.ComputedTorque):
        expected = torchdq.computed_torque(model or robot, q, qd, *desired, kp.expand(2), kd.expand(2))
    else:
        weight = 0.0 if model is None else torchdq.inverse_dynamics(model, q)
        expected = kp * (desired[0] - q) + kd * (desired[1] - qd) + weight
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
