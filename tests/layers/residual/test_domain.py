"""Where a learned residual acts: as trained in the trained states, not at all far away, never beyond its bound."""

import copy
import pickle

import torch
from helpers import all_in_one, double, random
from oracles import shipped

import torchdq
from torchdq import Scene, effects
from torchdq.layers.residual import ResidualDynamics
from torchdq.layers.residual.domain import Domain

F64 = torch.float64
TWO, PANDA = shipped("two_link").robot, shipped("panda").robot


def acting(robot=TWO, size=1.0, inputs="joint"):
    """A layer in its trained states whose network is anything but zero, in double precision."""
    torch.manual_seed(0)
    layer = ResidualDynamics(torchdq.DQRNEA(robot), inputs=inputs, hidden=(8, 5)).double()
    q, qd, qdd = 0.5 * random(3, 200, robot.n)
    layer.standardise(q, qd, qdd, layer.model(q, qd, qdd) + 0.3 * random(200, robot.n, seed=5))
    with torch.no_grad():
        for k, p in enumerate(layer.network.parameters()):
            p.copy_(size * random(*p.shape, seed=10 + k))
    return layer, (q, qd, qdd)


def test_a_domain_is_one_on_its_rows_zero_far_away_and_falls_between():
    domain = Domain(2, 3)
    rows = random(500, 2, 3)
    domain.cover(rows)
    assert torch.equal(domain(rows), torch.ones(500, 2, dtype=F64))
    outwards = torch.linspace(0, 50, 400, dtype=F64)[:, None, None] * torch.ones(2, 3, dtype=F64)
    found = domain(outwards)
    assert not found[-1].any() and (found.diff(dim=0) <= 1e-12).all()
    assert not domain(1e30 * rows.abs()).any() and domain(1e30 * rows.abs()).isfinite().all()


@all_in_one([1, 2, 10])
def test_a_domain_of_few_rows_is_about_them(rows):
    domain, x = Domain(1, 2), random(rows, 1, 2)
    domain.cover(x)
    assert torch.equal(domain(x), torch.ones(rows, 1, dtype=F64)) and not domain(x + 10).any()


def test_the_gate_has_two_derivatives_everywhere():
    """Derivatives are those of finite differences, and steps of 1/20000 change none by what a jump would."""
    domain = Domain(1, 1)
    domain.cover(torch.zeros(1, 1, 1, dtype=F64))
    t, h = torch.linspace(0, 2, 40001, dtype=F64), 1e-5

    def along(t):
        return domain(t[None, None])[0]

    value, slopes = torch.func.vmap(along), torch.func.vmap(torch.func.grad(along))
    falls = ((value(t) > 0) & (value(t) < 1)).nonzero()[:, 0]
    t = t[falls[0] - 9 : falls[-1] + 10]
    first, second = slopes(t), torch.func.vmap(torch.func.grad(torch.func.grad(along)))(t)
    assert torch.allclose(first, (value(t + h) - value(t - h)) / (2 * h), atol=1e-5)
    assert torch.allclose(second, (slopes(t + h) - slopes(t - h)) / (2 * h), atol=1.0)
    assert first.min() < -1 and first.diff().abs().max() < 0.01 and second.diff().abs().max() < 2


def test_the_residual_is_the_networks_where_it_was_trained_and_exactly_zero_far_away():
    layer, (q, qd, qdd) = acting(size=0.1)
    x = layer.features(q, qd)
    assert torch.equal(layer.gate(x), torch.ones(200, 2, dtype=F64))
    expected = layer.bound * layer.network(x).tanh()
    assert torch.allclose(layer.residual(q, qd), expected, rtol=1e-12) and expected.abs().min() > 0
    fast = qd.clone()
    fast[:, 1] = 100.0  # of one joint alone
    found = layer.residual(q, fast)
    assert torch.equal(found[:, 0], layer.residual(q, qd)[:, 0]) and not found[:, 1].any()
    assert torch.equal(layer(q, fast, qdd)[:, 1], layer.model(q, fast, qdd)[:, 1])


def test_a_network_of_all_joints_is_trusted_where_all_of_them_were_trained():
    layer, (q, qd, qdd) = acting(size=0.1, inputs="all")
    assert torch.equal(layer.gate(layer.features(q, qd)), torch.ones(200, 1, dtype=F64))
    fast = qd.clone()
    fast[:, 1] = 100.0
    assert not layer.residual(q, fast).any() and torch.equal(layer(q, fast, qdd), layer.model(q, fast, qdd))


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


def test_weights_scale_what_each_joint_gets():
    layer, (q, qd, _) = acting()
    whole = layer.residual(q, qd)
    layer.weight.copy_(double(0.25, 0.0))
    assert torch.equal(layer.residual(q, qd), whole * double(0.25, 0.0))


def test_a_traced_graph_equals_the_layer_where_the_gate_falls():
    layer, x = acting()
    torch._dynamo.reset()
    traced = torch.compile(layer, backend="aot_eager", fullgraph=True)
    with torch.no_grad():
        for scale in (1.0, 2.0, 4.0):
            moved = [scale * y for y in x]
            assert torch.allclose(traced(*moved), layer(*moved), rtol=1e-12, atol=1e-12)
