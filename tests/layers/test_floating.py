"""Layers of robots with a floating base: those of the functions, friction, learned bodies, programs."""

import torch
from free_flyers import body, case, motion, random_body
from helpers import all_in_one, exhaustive, random
from messages import refused

import torchdq
from torchdq import effects, floating
from torchdq.nn import FloatingForwardDynamics, FloatingInverseDynamics

C = case("tree3")
M = motion(C)
MOTION = M.pick("X_WB", "q", "V_WB_B", "qd", "A_WB_B", "qdd")
WRENCHES = M.pick("f_tip", "f_ext", "f_base")
FRICTION = (effects.Viscous(0.3), effects.Coulomb(0.2, sign_width=0.1))


@all_in_one([(), FRICTION])
def test_layers_are_the_functions_with_the_friction_of_the_motors(friction):
    inverse, forward = (kind(C.robot, friction=friction) for kind in (FloatingInverseDynamics, FloatingForwardDynamics))
    F_B, tau = floating.inverse_dynamics(C.robot, **MOTION, **WRENCHES)
    motors = tau + inverse.friction_torque(M["qd"])
    found = inverse(**MOTION, **WRENCHES)
    assert torch.allclose(found.F_B, F_B, rtol=1e-12) and torch.allclose(found.tau, motors, rtol=1e-12)
    assert bool(friction) == (not torch.equal(found.tau, tau))
    at = M.pick("X_WB", "q", "V_WB_B", "qd")
    back = forward(**at, tau=motors, **{**WRENCHES, "f_base": WRENCHES["f_base"] + F_B})
    assert torch.allclose(back.A_WB_B, M["A_WB_B"], atol=1e-9) and torch.allclose(back.qdd, M["qdd"], atol=1e-9)


@all_in_one(["base_mass", "base_com", "base_inertia", "mass", "friction", "offset"])
def test_every_quantity_has_the_gradient_of_differences(learn):
    layer = FloatingInverseDynamics(C.robot, learn=learn)
    weights = random(3, 6 + C.robot.n, seed=4)

    def loss():
        return (torch.cat(layer(**MOTION, **WRENCHES), -1) * weights).sum()

    loss().backward()
    for p in layer.parameters():
        k, h = p.numel() - 1, 1e-6
        found = []
        for sign in (1, -1):
            with torch.no_grad():
                p.view(-1)[k] += sign * h
                found.append(loss())
                p.view(-1)[k] -= sign * h
        assert abs(p.grad.view(-1)[k] - (found[0] - found[1]) / (2 * h)) <= 1e-6 * (1 + p.grad.abs().max())


@exhaustive
def test_the_body_of_the_base_is_learned_from_its_motion():
    """Least squares on the wrenches and torques of another base, by Newton's method of torch."""
    true = C.robot.replace(**body(random_body(9)))
    F_B, tau = floating.inverse_dynamics(true, **MOTION)
    layer = FloatingInverseDynamics(C.robot, learn=("base_mass", "base_com", "base_inertia"))
    start = layer.prior()
    optimizer = torch.optim.LBFGS(layer.parameters(), max_iter=300, line_search_fn="strong_wolfe", tolerance_change=0)

    def loss():
        optimizer.zero_grad()
        found = layer(**MOTION)
        value = (found.F_B - F_B).square().mean() + (found.tau - tau).square().mean()
        value.backward()
        return value

    optimizer.step(loss)
    for name in ("base_mass", "base_com", "base_inertia"):
        assert torch.allclose(getattr(layer, name), getattr(true, name), rtol=1e-3, atol=1e-4), name
    assert start == 0 and layer.prior() > 0.01


def test_the_prior_of_the_base_is_that_of_the_links():
    """Masses by the logarithm of their factor, centres of mass by their shift in sizes of the body."""
    layer = FloatingInverseDynamics(C.robot, learn=("base_mass", "base_com"))
    layer.base_mass = 1.1 * layer.base_mass.detach()
    shift = torch.tensor([0.01, -0.02, 0.03]).double()
    layer.base_com = layer.base_com.detach() + shift
    size = C.robot.base_inertia[[0, 2, 5]].sum() / 2 / C.robot.base_mass
    expected = torch.tensor(1.1).double().log().square() + shift.square().sum() / size
    assert torch.allclose(layer.prior(), expected, rtol=1e-6)


def test_a_layer_has_a_program():
    layer = FloatingInverseDynamics(C.robot, learn=("base_mass", "friction"))
    program = layer.program("f_base", parameters="arguments")
    names = [a.name for a in program.arguments]
    assert names == [*MOTION, "f_base", "base_mass", "viscous", "coulomb"]
    given = [*MOTION.values(), WRENCHES["f_base"], layer.base_mass.reshape(1), layer.viscous, layer.coulomb]
    F_B, tau = torchdq.compile(program)(*given)
    expected = layer(**MOTION, f_base=WRENCHES["f_base"])
    assert torch.allclose(F_B, expected.F_B) and torch.allclose(tau, expected.tau)


ARM = torchdq.robots.load("two_link")
MISUSE = {
    "a floating base for a fixed one": lambda: torchdq.DQRNEA(C.robot),
    "a controller of a floating base": lambda: torchdq.ComputedTorque(C.robot, kp=1.0, kd=1.0),
    "a fixed base for a floating one": lambda: FloatingForwardDynamics(ARM),
    "no pose": lambda: FloatingInverseDynamics(C.robot)(None, M["q"]),
    "learn what there is not": lambda: FloatingInverseDynamics(C.robot, learn="base"),
    "a controller of a layer": lambda: torchdq.ComputedTorque(FloatingInverseDynamics(C.robot), kp=1.0, kd=1.0),
    "a residual of a layer": lambda: torchdq.ResidualDynamics(FloatingInverseDynamics(C.robot)),
}


@all_in_one(MISUSE)
def test_misuse_is_refused(key):
    with refused((torchdq.ArgumentError, torchdq.DtypeError)):
        MISUSE[key]()
