"""Where a learned residual acts: as trained in the trained states, not at all far away, never beyond its bound."""

import pickle

import pytest
import torch
from helpers import double, random
from oracles import shipped

import torchdq
from torchdq.envs import Scene, effects
from torchdq.layers.residual import ResidualDynamics
from torchdq.layers.residual.domain import Domain
from torchdq.layers.residual.smooth import BEYOND, limit_slope, limited, smooth_step, step_slope

F64 = torch.float64
TWO, PANDA = shipped("two_link").robot, shipped("panda").robot


def acting(robot=TWO, inputs="joint", size=1.0, **options):
    """A layer in its trained states whose network is anything but zero, in double precision."""
    torch.manual_seed(0)
    layer = ResidualDynamics(torchdq.DQRNEA(robot), inputs=inputs, hidden=(8, 5), **options).double()
    q, qd, qdd = 0.5 * random(3, 200, robot.n)
    layer.standardise(q, qd, qdd, layer.model(q, qd, qdd) + 0.3 * random(200, robot.n, seed=5))
    with torch.no_grad():
        for k, p in enumerate(layer.network.parameters()):
            p.copy_(size * random(*p.shape, seed=10 + k))
    return layer, (q, qd, qdd)


# --- steps and limits ------------------------------------------------------------------------------------------------


def test_a_limit_leaves_what_is_inside_and_is_never_passed():
    limit = double(0.5, 2.0)
    x = torch.linspace(-8, 8, 4001, dtype=F64)[:, None].expand(-1, 2)
    found = limited(x, limit)
    inside = x.abs() <= limit
    assert torch.equal(found[inside], x[inside])
    assert float((found.abs() - BEYOND * limit).max()) <= 1e-15
    assert torch.equal(found[-1], BEYOND * limit) and torch.equal(found[0], -BEYOND * limit)
    assert (found.diff(dim=0) >= -1e-15).all()


@pytest.mark.parametrize("function, slope", [(smooth_step, step_slope), (None, None)], ids=["step", "limit"])
def test_slopes_are_those_of_finite_differences_and_have_no_jump(function, slope):
    if function is None:
        one = torch.ones((), dtype=F64)
        function, slope = (lambda x: limited(x, one)), (lambda x: limit_slope(x, one))
    x, h = torch.linspace(-2, 2, 1601, dtype=F64), 1e-5
    assert torch.allclose(slope(x), (function(x + h) - function(x - h)) / (2 * h), atol=1e-8)
    curvature = (slope(x + h) - slope(x - h)) / (2 * h)
    assert float(curvature.diff().abs().max()) < 0.3  # steps of 1/400 in x; a jump would be of the size of 10
    by_autograd = torch.func.vmap(torch.func.grad(torch.func.grad(function)))(x)
    assert torch.allclose(by_autograd, curvature, atol=1e-3)


# --- the gate --------------------------------------------------------------------------------------------------------


def test_a_domain_is_one_on_its_rows_zero_far_away_and_falls_between():
    domain = Domain(2, 3)
    rows = random(500, 2, 3)
    domain.cover(rows)
    assert torch.equal(domain(rows), torch.ones(500, 2, dtype=F64))
    outwards = torch.linspace(0, 50, 400, dtype=F64)[:, None, None] * torch.ones(2, 3, dtype=F64)
    found = domain(outwards)
    assert torch.equal(found[-1], torch.zeros(2, dtype=F64))
    assert not domain(1e30 * rows.abs()).any() and domain(1e30 * rows.abs()).isfinite().all()
    assert (found.diff(dim=0) <= 1e-12).all()


@pytest.mark.parametrize("rows", [1, 2, 10])
def test_a_domain_of_few_rows_is_about_them(rows):
    domain, x = Domain(1, 2), random(rows, 1, 2)
    domain.cover(x)
    assert torch.equal(domain(x), torch.ones(rows, 1, dtype=F64)) and not domain(x + 10).any()


def test_the_gate_has_two_derivatives_everywhere():
    layer, _ = acting()
    x = random(1, 2, 6)[0]
    direction = random(2, 6, seed=3)

    def along(t):
        return layer.gate(x + t * direction).sum()

    t = torch.linspace(-20, 20, 2001, dtype=F64)
    first = torch.func.vmap(torch.func.grad(along))(t)
    second = torch.func.vmap(torch.func.grad(torch.func.grad(along)))(t)
    h = 1e-4
    assert torch.allclose(first, (torch.func.vmap(along)(t + h) - torch.func.vmap(along)(t - h)) / (2 * h), atol=1e-4)
    slopes = torch.func.vmap(torch.func.grad(along))
    assert torch.allclose(second, (slopes(t + h) - slopes(t - h)) / (2 * h), atol=2e-2)
    assert first.abs().max() > 0.05  # it does fall somewhere


@pytest.mark.parametrize("inputs", ["joint", "all"])
def test_the_residual_is_the_networks_where_it_was_trained_and_exactly_zero_far_away(inputs):
    layer, (q, qd, qdd) = acting(inputs=inputs, size=0.1)
    assert layer.residual(q, qd, qdd).abs().min() > 0
    scaled = layer.scaled(layer.features(q, qd, qdd, layer.model(q, qd, qdd)))
    assert torch.equal(layer.gate(scaled), torch.ones(200, 2, dtype=F64))
    for far in ((q, 100 * qd.sign(), qdd), (q, qd, 1e5 * qdd.sign())):  # too fast; torques beyond their range
        assert not layer.residual(*far).any()
        assert torch.equal(layer(*far), layer.model(*far))


def test_a_joint_that_is_far_away_leaves_the_others_their_residual():
    layer, (q, qd, _) = acting(PANDA)
    fast = qd.clone()
    fast[:, 6] = 50.0
    x = layer.features(q, fast, None, torch.zeros_like(q))
    found = layer.correction(x)
    assert not found[:, 6].any() and bool(found[:, :6].any(0).all())


def test_the_whole_torque_rises_with_the_models_where_the_gate_falls():
    """A residual as large as its bound, which the gate takes away while the model's torque grows."""
    layer, (q, qd, qdd) = acting(size=0.0)
    with torch.no_grad():
        layer.network.biases[-1].fill_(1e6)
    features = layer.features(q[:1], qd[:1], qdd[:1], torch.zeros(1, 2, dtype=F64)).expand(20001, -1, -1).clone()
    tau = torch.linspace(-200, 200, 20001, dtype=F64)
    features[..., -1] = tau[:, None]
    slope = layer.correction(features).diff(dim=0) / tau.diff()[:, None]
    assert -0.5 < slope.min().item() < -0.3
    assert not layer.correction(features)[[0, -1]].any()


# --- the bound -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("inputs", ["joint", "all"])
@pytest.mark.parametrize("size", [1e3, 1e12])
def test_no_weights_take_a_residual_beyond_its_bound(inputs, size):
    layer, (q, qd, qdd) = acting(PANDA, inputs, size)
    assert torch.allclose(layer.bound, 1.25 * layer.largest, rtol=1e-15)
    found = layer.residual(*(3 * x for x in (q, qd, qdd)))
    assert found.isfinite().all() and (found.abs() <= layer.bound * (1 + 1e-12)).all()
    assert (layer.residual(q, qd, qdd).abs() > 0.5 * layer.bound).any()  # they do try


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
    q, qd, q_des, qd_des, qdd_des = 3 * random(5, 500, 2)
    difference = wild(q, qd, q_des, qd_des, qdd_des) - plain(q, qd, q_des, qd_des, qdd_des)
    assert difference.any() and (difference.abs() <= layer.bound * (1 + 1e-9)).all()
    scene = Scene(TWO, (effects.Gravity(),), dt=0.002)
    goal = double(0.4, -0.3)
    with torch.no_grad():
        held = (goal, 0 * goal, 0 * goal)
        path = scene.rollout(scene.start(goal), steps=500, policy=lambda s, k: wild(s.q, s.qd, *held)).q
        M = torchdq.mass_matrix(TWO, path)
        worst = torch.linalg.inv(M).abs() @ layer.bound
    assert float((path - goal).abs().max()) <= 1.1 * float(worst.max()) / 100.0


# --- as a module -----------------------------------------------------------------------------------------------------


def test_gate_bound_and_weights_are_part_of_the_state():
    layer, x = acting()
    layer.weight.copy_(double(0.25, 0.75))
    other = ResidualDynamics(torchdq.DQRNEA(TWO), hidden=(8, 5)).double()
    other.load_state_dict(layer.state_dict())
    for twin in (other, pickle.loads(pickle.dumps(layer))):
        for scale in (1.0, 3.0, 30.0):
            moved = [scale * y for y in x]
            assert torch.equal(twin(*moved), layer(*moved))


def test_weights_scale_what_each_joint_gets():
    layer, x = acting()
    whole = layer.residual(*x)
    layer.weight.copy_(double(0.25, 0.0))
    assert torch.equal(layer.residual(*x), whole * double(0.25, 0.0)) and not layer.bound[1]


@pytest.mark.parametrize("inputs", ["joint", "all"])
def test_a_traced_graph_equals_the_layer_where_the_gate_falls(inputs):
    layer, x = acting(inputs=inputs)
    torch._dynamo.reset()
    traced = torch.compile(layer, backend="aot_eager", fullgraph=True)
    for scale in (1.0, 2.0, 4.0):
        moved = [scale * y for y in x]
        assert torch.allclose(traced(*moved), layer(*moved), rtol=1e-12, atol=1e-12)
