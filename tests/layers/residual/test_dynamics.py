"""A network beside the dynamics: nothing at first, with the features that are written, and able to learn the rest."""

import helpers
import pytest
import torch
from helpers import all_in_one, random
from messages import refused
from oracles import shipped, tree

import torchdq
from torchdq.layers.residual import ResidualDynamics

F32, F64 = torch.float32, torch.float64
PANDA, TWO = shipped("panda").robot, shipped("two_link").robot
one_thread = helpers.one_thread


def trained(robot, inputs="joint", **options):
    """A layer whose network is anything but zero, in double precision."""
    layer = ResidualDynamics(torchdq.DQRNEA(robot, **options), inputs=inputs, hidden=(8, 5)).double()
    with torch.no_grad():
        for k, p in enumerate(layer.network.parameters()):
            p.copy_(0.5 * random(*p.shape, seed=k))
    return layer


@pytest.mark.parametrize("dtype", [F32, F64], ids=str)
@pytest.mark.parametrize("hidden", [(), (32, 32), (4,)], ids=str)
def test_before_training_the_torques_are_the_models_to_the_last_bit(hidden, dtype):
    model = torchdq.DQRNEA(PANDA, learn=("mass", "friction", "offset"))
    layer = ResidualDynamics(model, hidden=hidden)
    x = random(3, 20, 7, dtype=dtype)
    wrenches = {"f_tip": random(20, 6, seed=1, dtype=dtype), "f_ext": random(20, 7, 6, seed=2, dtype=dtype)}
    for _ in range(2):
        assert layer(*x).dtype == dtype
        assert torch.equal(layer(*x), model(*x)) and torch.equal(layer(*x, **wrenches), model(*x, **wrenches))
        assert torch.equal(layer(*x[:2]), model(*x[:2]))
        assert not layer.residual(*x[:2]).any() and layer.residual(*x[:2]).shape == (20, 7)
        layer.standardise(*x, 5 * random(20, 7, seed=3, dtype=dtype))


def test_features_are_what_is_written():
    q, qd = random(2, 5, 7)
    signs = [qd / torch.sqrt(qd**2 + width**2) for width in (0.2, 1.0, 4.0)]
    expected = torch.stack([q.sin(), q.cos(), qd, *signs], -1)
    found = ResidualDynamics(torchdq.DQRNEA(PANDA, sign_width=0.2)).double().features(q, qd)
    assert torch.allclose(found, expected.flatten(-2), rtol=1e-14, atol=1e-15)


def test_a_joint_that_slides_is_seen_where_it_is_and_metres_are_no_angles():
    robot = tree(6).robot
    turns = torch.tensor([joint.turns for joint in robot.joint_types])
    assert 0 < int(turns.sum()) < robot.n
    q, qd = random(2, 5, robot.n)
    layer = ResidualDynamics(torchdq.DQRNEA(robot)).double()
    first, second = layer.features(q, qd).unflatten(-1, (robot.n, -1)).unbind(-1)[:2]
    assert torch.equal(first, torch.where(turns, q.sin(), q)) and torch.equal(second, torch.where(turns, q.cos(), 0.0))
    assert "turns" not in layer.state_dict()


@all_in_one(["joint", "all"])
def test_torques_of_every_joint_depend_on_itself_or_on_all(inputs):
    layer, (q, qd) = trained(PANDA, inputs=inputs), random(2, 7)
    for J in torch.func.jacrev(layer.residual, argnums=(0, 1))(q, qd):
        assert torch.equal(J != 0, torch.eye(7) == 1 if inputs == "joint" else torch.ones(7, 7) == 1)


def test_the_residual_is_what_is_added_with_wrenches_too():
    layer = trained(PANDA)
    x, f_tip, f_ext = random(3, 4, 7), random(4, 6, seed=1), random(4, 7, 6, seed=2)
    added = layer(*x, f_tip, f_ext) - layer.model(*x, f_tip, f_ext)
    assert torch.allclose(added, layer.residual(*x[:2]), rtol=1e-9, atol=1e-11)


def test_a_batch_is_its_rows():
    layer, x = trained(PANDA), random(3, 2, 3, 7)
    found = layer(*x)
    assert found.shape == (2, 3, 7)
    assert torch.allclose(found[1, 2], layer(*x[:, 1, 2]), rtol=1e-12, atol=1e-12)
    assert layer(*x[:, :0]).shape == (0, 3, 7)


def test_a_batch_of_robots_has_one_network():
    batch = PANDA.replace(mass=PANDA.mass * torch.tensor([[1.0], [2.0]], dtype=F64))
    layer, one = trained(batch), trained(PANDA)
    x = random(3, 2, 7)
    assert torch.allclose(layer(*x)[0], one(*x[:, 0]), rtol=1e-12, atol=1e-12)
    assert layer(*x[:, 0]).shape == (2, 7)


def test_derivatives_are_finite_differences():
    layer = trained(TWO, learn=("mass", "friction"))
    q, qd = (x.requires_grad_() for x in random(2, 3, 2))
    assert torch.autograd.gradcheck(lambda q, qd, *_: layer.residual(q, qd), (q, qd, *layer.network.parameters()))


def test_standardised_features_have_no_mean_and_spread_one():
    layer = ResidualDynamics(torchdq.DQRNEA(PANDA)).double()
    q, qd, qdd = (3 + 2 * random(50, 4, 7, seed=k) for k in range(3))
    q[..., 2], qd[..., 3] = 0.7, 0.0  # one joint stays where it is, one stands still
    layer.standardise(q, qd, qdd, random(50, 4, 7, seed=8))
    seen = layer.features(q, qd).flatten(0, 1).unflatten(-1, (7, 6))
    constant = torch.zeros(7, 6, dtype=torch.bool)
    constant[2, :2] = constant[3, 2:] = True
    assert float(seen.mean(0).abs().max()) < 1e-9
    assert torch.allclose(seen.std(0, correction=0), (~constant).double(), atol=1e-9)


def test_robot_is_the_models():
    layer = trained(PANDA, learn=("mass",))
    layer.model.mass = 2 * layer.model.mass.detach()
    assert torch.equal(layer.robot.mass, layer.model.mass)


def test_a_network_of_ones_own_is_taken_as_it_is():
    network = torch.nn.Linear(42, 7)
    model, (q, qd) = torchdq.DQRNEA(PANDA), random(2, 5, 7)
    layer = ResidualDynamics(model, network)
    found = layer.residual(q, qd)
    assert found.dtype == F64 and torch.equal(found.float(), network(layer.features(q, qd)).tanh())


MISUSE = {
    "model": lambda model: ResidualDynamics(model.robot),
    "hidden": lambda model: ResidualDynamics(model, hidden=(32, 0)),
    "one sample": lambda model: ResidualDynamics(model).standardise(*random(4, 7)),
    "one row": lambda model: ResidualDynamics(model).standardise(*random(4, 1, 7)),
    "width of the network": lambda model: ResidualDynamics(model, torch.nn.Linear(42, 6))(*random(3, 5, 7)),
}


@all_in_one(MISUSE)
def test_wrong_arguments_are_refused_by_name(call):
    with refused(torchdq.ArgumentError):
        MISUSE[call](torchdq.DQRNEA(PANDA))
