"""A network on top of the dynamics: nothing before training, bounded, and nothing far from its training states."""

import copy
import pickle

import helpers
import pytest
import torch
from helpers import all_in_one, double, random
from messages import refused
from oracles import shipped, tree

import torchdq
from torchdq import Scene, effects
from torchdq.layers.residual import ResidualDynamics

F32, F64 = torch.float32, torch.float64
PANDA, TWO = shipped("panda").robot, shipped("two_link").robot
one_thread = helpers.one_thread


def acting(robot=TWO, size=0.5, inputs="joint", **options):
    """A layer in its training states whose network is anything but zero, in double precision, and these states."""
    torch.manual_seed(0)
    layer = ResidualDynamics(torchdq.DQRNEA(robot, **options), inputs=inputs, hidden=(8, 5)).double()
    q, qd, qdd = 0.5 * random(3, 200, robot.n)
    layer.standardise(q, qd, qdd, layer.model(q, qd, qdd).detach() + 0.3 * random(200, robot.n, seed=5))
    with torch.no_grad():
        for k, p in enumerate(layer.network.parameters()):
            p.copy_(size * random(*p.shape, seed=10 + k))
    return layer, (q, qd, qdd)


@pytest.mark.parametrize("dtype", [F32, F64], ids=str)
@pytest.mark.parametrize("hidden", [(), (32, 32)], ids=str)
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
    """Of joints that slide, positions are metres and no angles."""
    robot = tree(6).robot
    turns = torch.tensor([joint.turns for joint in robot.joint_types])
    assert 0 < int(turns.sum()) < robot.n
    q, qd = random(2, 5, robot.n)
    layer = ResidualDynamics(torchdq.DQRNEA(robot, sign_width=0.2)).double()
    signs = [qd / torch.sqrt(qd**2 + width**2) for width in (0.2, 1.0, 4.0)]
    places = torch.where(turns, q.sin(), q), torch.where(turns, q.cos(), 0.0)
    expected = torch.stack([*places, qd, *signs], -1)
    assert torch.allclose(layer.features(q, qd), expected.flatten(-2), rtol=1e-14, atol=1e-15)
    assert "turns" not in layer.state_dict()


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


@all_in_one(["joint", "all"])
def test_torques_of_every_joint_depend_on_itself_or_on_all(inputs):
    layer, (q, qd, _) = acting(PANDA, inputs=inputs)
    for J in torch.func.jacrev(layer.residual, argnums=(0, 1))(q[0], qd[0]):
        assert torch.equal(J != 0, torch.eye(7) == 1 if inputs == "joint" else torch.ones(7, 7) == 1)


def test_a_batch_is_its_rows_and_a_batch_of_robots_has_one_network():
    layer, _ = acting(PANDA)
    x, f_tip, f_ext = random(3, 2, 3, 7), random(2, 3, 6, seed=1), random(2, 3, 7, 6, seed=2)
    found = layer(*x)
    assert torch.allclose(found[1, 2], layer(*x[:, 1, 2]), rtol=1e-12, atol=1e-12)
    assert layer(*x[:, :0]).shape == (0, 3, 7)
    added = layer(*x, f_tip, f_ext) - layer.model(*x, f_tip, f_ext)
    assert torch.allclose(added, layer.residual(*x[:2]), rtol=1e-9, atol=1e-11)
    batch = PANDA.replace(mass=PANDA.mass * torch.tensor([[1.0], [2.0]], dtype=F64))
    several = ResidualDynamics(torchdq.DQRNEA(batch), hidden=(8, 5)).double()
    several.load_state_dict(layer.state_dict(), strict=False)
    assert torch.allclose(several(*x[:, :, 0])[0], layer(*x[:, 0, 0]), rtol=1e-12, atol=1e-12)


def test_derivatives_are_finite_differences():
    layer, (q, qd, _) = acting(learn=("mass", "friction"))
    x = [y[:3].clone().requires_grad_() for y in (q, qd)]
    assert torch.autograd.gradcheck(lambda q, qd, *_: layer.residual(q, qd), (*x, *layer.network.parameters()))


def test_a_network_of_ones_own_is_taken_as_it_is():
    network = torch.nn.Linear(42, 7)
    model, (q, qd) = torchdq.DQRNEA(PANDA), random(2, 5, 7)
    layer = ResidualDynamics(model, network)
    found = layer.residual(q, qd)
    assert found.dtype == F64 and torch.equal(found.float(), network(layer.features(q, qd)).tanh())


# --- where it acts ---


def test_the_gate_is_one_on_its_rows_zero_far_away_and_falls_between():
    layer = ResidualDynamics(torchdq.DQRNEA(TWO)).double()
    for rows in (500, 10, 1):
        x = random(rows, 12)
        layer.cover(x)
        assert torch.equal(layer.gate(x), torch.ones(rows, 2, dtype=F64))
    found = layer.gate(x + torch.linspace(0, 50, 400, dtype=F64)[:, None])
    assert not found[-1].any() and (found.diff(dim=0) <= 1e-12).all()
    assert not layer.gate(1e30 * x).any() and not layer.gate(1e300 * x).any()


def test_the_gate_has_two_derivatives_everywhere():
    """Derivatives are those of finite differences, and steps of 1/20000 change none by what a jump would."""
    layer = ResidualDynamics(torchdq.DQRNEA(TWO), inputs="all").double()
    layer.cover(torch.zeros(1, 12, dtype=F64))
    t, h = torch.linspace(0, 2, 40001, dtype=F64), 1e-5

    def along(t):
        return layer.gate(t * torch.ones(12, dtype=F64))[0]

    value, slopes = torch.func.vmap(along), torch.func.vmap(torch.func.grad(along))
    falls = ((value(t) > 0) & (value(t) < 1)).nonzero()[:, 0]
    t = t[falls[0] - 9 : falls[-1] + 10]
    first, second = slopes(t), torch.func.vmap(torch.func.grad(torch.func.grad(along)))(t)
    assert torch.allclose(first, (value(t + h) - value(t - h)) / (2 * h), atol=1e-5)
    assert torch.allclose(second, (slopes(t + h) - slopes(t - h)) / (2 * h), atol=1.0)
    assert first.min() < -1 and first.diff().abs().max() < 0.03 and second.diff().abs().max() < 6


@all_in_one(["joint", "all"])
def test_the_residual_is_the_networks_where_it_was_trained_and_exactly_zero_far_away(inputs):
    """Far of one joint alone is far for its own network, or for that of all."""
    layer, (q, qd, qdd) = acting(size=0.1, inputs=inputs)
    expected = layer.bound * layer.network(layer.features(q, qd)).tanh()
    assert torch.allclose(layer.residual(q, qd), expected, rtol=1e-12) and expected.abs().min() > 0
    fast = qd.clone()
    fast[:, 1] = 100.0
    found, own = layer.residual(q, fast), 0 if inputs == "all" else expected[:, 0]
    assert not found[:, 1].any() and ((found[:, 0] - own).abs() < 1e-12).all()
    assert torch.equal(layer(q, fast, qdd)[:, 1], layer.model(q, fast, qdd)[:, 1])


@all_in_one([1e3, 1e12])
def test_no_weights_take_a_residual_beyond_its_bound(size):
    layer, (q, qd, _) = acting(PANDA, size)
    found = layer.residual(2 * q, 2 * qd)
    assert found.isfinite().all() and (found.abs() <= layer.bound).all()
    assert (layer.residual(q, qd).abs() > 0.5 * layer.bound).any()  # they do try


def test_the_bound_is_that_of_the_largest_residual_in_the_data():
    layer = ResidualDynamics(torchdq.DQRNEA(TWO))
    q, qd, qdd, off = random(4, 50, 2)
    layer.standardise(q, qd, qdd, layer.model(q, qd, qdd) + off)
    assert torch.allclose(layer.bound, 1.25 * off.abs().amax(0), rtol=1e-9)


def test_computed_torque_with_a_network_that_went_wrong_stays_bounded_and_the_arm_near_its_goal():
    """The error of tracking under a bounded disturbance d of M^-1 d is at most about that over kp."""
    layer, _ = acting(size=1e9)
    plain = torchdq.ComputedTorque(layer.model, 100.0, 20.0)
    wild = torchdq.ComputedTorque(layer, 100.0, 20.0)
    q, qd, q_des, qd_des, qdd_des = random(5, 500, 2)
    difference = wild(q, qd, q_des, qd_des, qdd_des) - plain(q, qd, q_des, qd_des, qdd_des)
    assert difference.any() and (difference.abs() <= layer.bound * (1 + 1e-9)).all()
    scene = Scene(TWO, (effects.Gravity(),), dt=0.002)
    goal = double(0.4, -0.3)
    with torch.no_grad():
        held = (goal, 0 * goal, 0 * goal)
        path = scene.rollout(scene.start(goal), steps=200, policy=lambda s, k: wild(s.q, s.qd, *held)).q
        M = torchdq.mass_matrix(TWO, path)
        worst = torch.linalg.inv(M).abs() @ layer.bound
    assert float((path - goal).abs().max()) <= 1.1 * float(worst.max()) / 100.0


def test_gate_bound_and_weights_are_part_of_the_state():
    layer, x = acting()
    layer.weight.copy_(double(0.25, 0.75))
    layer.remaining.copy_(double(0.5, 0.7))
    other = ResidualDynamics(torchdq.DQRNEA(TWO), hidden=(8, 5)).double()
    other.load_state_dict(layer.state_dict())
    for twin in (other, copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
        for scale in (1.0, 3.0, 30.0):
            moved = [scale * y for y in x]
            assert torch.equal(twin(*moved), layer(*moved))
            assert torch.equal(twin.narrowing(*moved[:2]), layer.narrowing(*moved[:2]))
    whole = layer.residual(*x[:2]) / double(0.25, 0.75)
    layer.weight.copy_(double(0.5, 0.0))
    assert torch.allclose(layer.residual(*x[:2]), whole * double(0.5, 0.0), rtol=1e-12)


def test_a_traced_graph_equals_the_layer_where_the_gate_falls():
    layer, x = acting()
    torch._dynamo.reset()
    traced = torch.compile(layer, backend="aot_eager", fullgraph=True)
    with torch.no_grad():
        for scale in (1.0, 2.0, 4.0):
            moved = [scale * y for y in x]
            assert torch.allclose(traced(*moved), layer(*moved), rtol=1e-12, atol=1e-12)


MISUSE = {
    "model": lambda model: ResidualDynamics(model.robot),
    "hidden": lambda model: ResidualDynamics(model, hidden=(32, 0)),
    "inputs": lambda model: ResidualDynamics(model, inputs="each"),
    "one sample": lambda model: ResidualDynamics(model).standardise(*random(4, 7)),
    "width of the network": lambda model: ResidualDynamics(model, torch.nn.Linear(42, 6))(*random(3, 5, 7)),
}


@all_in_one(MISUSE)
def test_wrong_arguments_are_refused_by_name(call):
    with refused(torchdq.ArgumentError):
        MISUSE[call](torchdq.DQRNEA(PANDA))
