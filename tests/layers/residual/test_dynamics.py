"""A network beside the dynamics: nothing at first, blind to what it must not see, and able to learn the rest."""

import copy
import pickle
import warnings

import helpers
import pytest
import torch
from helpers import random
from messages import refused
from oracles import shipped, tree

import torchdq
from torchdq.layers.residual import ResidualDynamics
from torchdq.layers.residual.networks import Perceptrons

F32, F64 = torch.float32, torch.float64
PANDA, TWO = shipped("panda").robot, shipped("two_link").robot
every_kind = pytest.mark.parametrize("inputs", ["joint", "all"])
one_thread = helpers.one_thread


def trained(robot, inputs, seed=0, position=False, **options):
    """A layer whose network is anything but zero, in double precision."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = torchdq.DQRNEA(robot, **options)
        layer = ResidualDynamics(model, inputs=inputs, hidden=(8, 5), position=position).double()
    with torch.no_grad():
        for k, p in enumerate(layer.network.parameters()):
            p.copy_(0.5 * random(*p.shape, seed=100 * seed + k))
    return layer


# --- before training -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [F32, F64], ids=str)
@pytest.mark.parametrize("hidden", [(), (32, 32), (4,)], ids=str)
@every_kind
def test_before_training_the_torques_are_the_models_to_the_last_bit(inputs, hidden, dtype):
    model = torchdq.DQRNEA(PANDA, learn=("mass", "friction", "offset"))
    layer = ResidualDynamics(model, inputs=inputs, hidden=hidden)
    x = random(3, 20, 7, dtype=dtype)
    wrenches = {"f_tip": random(20, 6, seed=1, dtype=dtype), "f_ext": random(20, 7, 6, seed=2, dtype=dtype)}
    for _ in range(2):
        assert layer(*x).dtype == dtype
        assert torch.equal(layer(*x), model(*x)) and torch.equal(layer(*x, **wrenches), model(*x, **wrenches))
        assert torch.equal(layer(*x[:2]), model(*x[:2]))
        assert not layer.residual(*x).any() and layer.residual(*x).shape == (20, 7)
        layer.standardise(*x, 5 * random(20, 7, seed=3, dtype=dtype))


@every_kind
def test_the_network_learns_from_the_first_step(inputs):
    """Zero is where it starts, not where it stays."""
    layer = ResidualDynamics(torchdq.DQRNEA(PANDA), inputs=inputs)
    layer(*random(3, 20, 7)).square().sum().backward()
    assert any(bool(p.grad.any()) for p in layer.network.parameters())


# --- what it sees ----------------------------------------------------------------------------------------------------


def test_features_are_what_is_written():
    model = torchdq.DQRNEA(PANDA, sign_width=0.2)
    q, qd, qdd, tau = random(4, 5, 7)
    signs = [qd / torch.sqrt(qd**2 + width**2) for width in (0.2, 1.0, 4.0)]
    expected = [qd, *signs, qdd, tau]
    found = ResidualDynamics(model).features(q, qd, qdd, tau)
    assert found.shape == (5, 7, 6) and torch.allclose(found, torch.stack(expected, -1), rtol=1e-14, atol=1e-15)
    assert not ResidualDynamics(model).features(q, qd, None, tau)[..., 4].any()
    found = ResidualDynamics(model, position=True).features(q, qd, qdd, tau)
    assert torch.allclose(found, torch.stack([q.sin(), q.cos(), *expected], -1), rtol=1e-14, atol=1e-15)


def test_a_joint_that_slides_is_seen_where_it_is_and_metres_are_no_angles():
    robot = tree(6).robot
    turns = torch.tensor([joint.turns for joint in robot.joint_types])
    assert 0 < int(turns.sum()) < robot.n
    q, qd, qdd, tau = random(4, 5, robot.n)
    layer = ResidualDynamics(torchdq.DQRNEA(robot), position=True)
    first, second = layer.features(q, qd, qdd, tau).unbind(-1)[:2]
    assert torch.equal(first, torch.where(turns, q.sin(), q)) and torch.equal(second, torch.where(turns, q.cos(), 0.0))
    far = layer.features(q + 2 * torch.pi, qd, qdd, tau)[..., 0]
    assert torch.allclose(far[:, turns], first[:, turns]) and ((far - first)[:, ~turns] > 6).all()
    assert "turns" not in layer.state_dict()


def test_a_robot_with_learned_masses_prints_without_a_warning():
    model = torchdq.DQRNEA(PANDA, learn=("mass",))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "'panda'" in repr(model.robot)


def seen(inputs):
    """Whether torque i depends on feature k of joint j: [n, n, 6]."""
    layer = trained(PANDA, inputs)
    features = random(7, 6, seed=4)
    return torch.func.jacrev(layer.correction)(features) != 0


def test_a_joint_sees_nothing_of_the_others():
    found = seen("joint")
    assert torch.equal(found, torch.eye(7, dtype=torch.bool)[..., None].expand(7, 7, 6))


def test_all_joints_see_all_joints():
    assert bool(seen("all").all())


def test_no_gradient_of_the_network_reaches_other_joints_through_the_models_torque():
    layer = trained(PANDA, "joint", position=True, learn=("mass",))
    x = random(3, 7, seed=5)
    for J in torch.func.jacrev(layer.residual, argnums=(0, 1, 2))(*x):
        assert torch.equal(J, J.diagonal().diag()) and bool(J.diagonal().all())
    (mass,) = torch.autograd.grad(layer.residual(*x).sum(), layer.model.parameters(), allow_unused=True)
    assert mass is None


def test_joints_have_networks_of_their_own():
    """Alike at equal inputs they would be one network seven times."""
    layer = trained(PANDA, "joint")
    found = layer.correction(random(6, seed=6).expand(7, 6))
    assert len(set(found.tolist())) == 7


def test_the_residual_is_what_is_added_with_wrenches_too():
    layer = trained(PANDA, "joint")
    x, f_tip, f_ext = random(3, 4, 7), random(4, 6, seed=1), random(4, 7, 6, seed=2)
    added = layer(*x, f_tip, f_ext) - layer.model(*x, f_tip, f_ext)
    assert torch.allclose(added, layer.residual(*x, f_tip, f_ext), rtol=1e-9, atol=1e-11)
    assert not torch.allclose(added, layer.residual(*x))


@every_kind
def test_a_batch_is_its_rows(inputs):
    layer, x = trained(PANDA, inputs), random(3, 2, 3, 7)
    found = layer(*x)
    assert found.shape == (2, 3, 7)
    assert torch.allclose(found[1, 2], layer(*x[:, 1, 2]), rtol=1e-12, atol=1e-12)
    assert layer(*x[:, :0]).shape == (0, 3, 7)


def test_a_batch_of_robots_has_one_network():
    batch = PANDA.replace(mass=PANDA.mass * torch.tensor([[1.0], [2.0]], dtype=F64))
    layer, one = trained(batch, "joint"), trained(PANDA, "joint")
    x = random(3, 2, 7)
    assert torch.allclose(layer(*x)[0], one(*x[:, 0]), rtol=1e-12, atol=1e-12)
    assert layer(*x[:, 0]).shape == (2, 7)


# --- derivatives -----------------------------------------------------------------------------------------------------


@every_kind
def test_derivatives_are_finite_differences(inputs):
    layer = trained(TWO, inputs, learn=("mass", "friction"))
    q, qd, qdd, tau = (x.requires_grad_() for x in random(4, 3, 2))

    def correction(q, qd, qdd, *_):
        return layer.correction(layer.features(q, qd, qdd, tau.detach()))

    assert torch.autograd.gradcheck(correction, (q, qd, qdd, *layer.network.parameters()))


def test_side_by_side_is_one_after_the_other():
    layer, x = Perceptrons(3, 4, 2, (5, 6)), random(10, 3, 4, dtype=F32)
    with torch.no_grad():
        for k, p in enumerate(layer.parameters()):
            p.copy_(random(*p.shape, seed=k))
    for g in range(3):
        y = x[:, g]
        for k, (weight, bias) in enumerate(zip(layer.weights, layer.biases, strict=True)):
            y = torch.nn.functional.linear(torch.tanh(y) if k else y, weight[g], bias[g, :, 0])
        assert torch.allclose(layer(x)[:, g], y, rtol=1e-5, atol=1e-5)


# --- standardisation -------------------------------------------------------------------------------------------------


def test_standardised_features_have_no_mean_and_spread_one():
    model = torchdq.DQRNEA(PANDA)
    layer = ResidualDynamics(model)
    q, qd, qdd = (3 + 2 * random(50, 4, 7, seed=k) for k in range(3))
    q[..., 2], qd[..., 3], qdd[..., 4] = 0.7, 0.0, 1e-9  # one joint stands still, one never accelerates
    tau = 10 * random(50, 4, 7, seed=8) + 5
    layer.standardise(q, qd, qdd, tau)
    seen = []
    layer.network.register_forward_pre_hook(lambda _, x: seen.append(x[0].double()))
    layer(q, qd, qdd)
    mean, spread = seen[0].flatten(0, 1).mean(0), seen[0].flatten(0, 1).std(0, correction=0)
    constant = torch.zeros(7, 6, dtype=torch.bool)
    constant[3, :4] = constant[4, 4] = True
    assert float(mean.abs().max()) < 1e-4  # single precision
    assert torch.allclose(spread, (~constant).double(), atol=1e-4)
    assert torch.allclose(layer.torque_scale, tau.flatten(0, 1).std(0, correction=0), rtol=1e-12)


# --- as a module -----------------------------------------------------------------------------------------------------


@every_kind
@pytest.mark.parametrize("trip", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))], ids=["deepcopy", "pickle"])
def test_a_layer_survives_a_round_trip(trip, inputs):
    layer, x = trained(PANDA, inputs, learn=("mass", "friction")), random(3, 5, 7)
    assert torch.equal(trip(layer)(*x), layer(*x))


def test_prior_and_robot_are_the_models():
    layer = trained(PANDA, "joint", learn=("mass",))
    layer.model.mass = 2 * layer.model.mass.detach()
    assert torch.equal(layer.robot.mass, layer.model.mass)
    assert torch.equal(layer.prior(), layer.model.prior()) and layer.prior().item() > 0.1


def test_a_network_of_ones_own_is_taken_as_it_is():
    joint, every = torch.nn.Linear(6, 1), torch.nn.Linear(42, 7)
    model, (q, qd, qdd) = torchdq.DQRNEA(PANDA), random(3, 5, 7)
    features = ResidualDynamics(model).features(q, qd, qdd, model(q, qd, qdd)).float()
    found = ResidualDynamics(model, joint).residual(q, qd, qdd)
    assert found.dtype == F64 and torch.allclose(found.float(), joint(features).squeeze(-1), rtol=1e-5, atol=1e-4)
    found = ResidualDynamics(model, every, "all").residual(q, qd, qdd)
    assert torch.allclose(found.float(), every(features.flatten(-2)), rtol=1e-5, atol=1e-4)


MISUSE = {
    "model": lambda model: ResidualDynamics(model.robot),
    "inputs": lambda model: ResidualDynamics(model, inputs="joints"),
    "hidden": lambda model: ResidualDynamics(model, hidden=(32, 0)),
    "one sample": lambda model: ResidualDynamics(model).standardise(*random(4, 7)),
    "one row": lambda model: ResidualDynamics(model).standardise(*random(4, 1, 7)),
    "errors": lambda model: ResidualDynamics(model).predict(*random(3, 5, 7)),
    "width of a joint": lambda model: ResidualDynamics(model, torch.nn.Linear(6, 2))(*random(3, 5, 7)),
    "one width for all": lambda model: ResidualDynamics(model, torch.nn.Linear(42, 1), "all")(*random(3, 5, 7)),
    "width of all": lambda model: ResidualDynamics(model, torch.nn.Linear(42, 6), "all")(*random(3, 5, 7)),
}


@pytest.mark.parametrize("call", MISUSE)
def test_wrong_arguments_are_refused_by_name(call):
    with refused(torchdq.ArgumentError):
        MISUSE[call](torchdq.DQRNEA(PANDA))
