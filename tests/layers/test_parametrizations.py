"""What is learned stays physical, is what it says it is, and can be learned.

That a body can exist is decided by the principal moments of its inertia, by numpy; formulas are written out here. That
friction is what a scene with the same effects simulates is held by effects/test_friction.py.
"""

import copy
import io
import math
import pickle
from functools import partial

import helpers
import numpy as np
import pytest
import torch
from helpers import all_in_one, double, exhaustive, random, thinned
from messages import refused
from oracles import EPS, random_tree, shipped, states
from torch.func import functional_call
from torch.nn.utils.parametrize import type_before_parametrizations

import torchdq
from torchdq.functions import posed
from torchdq.layers.parametrizations import PhysicalInertia, Positive
from torchdq.nn import RobotModule
from torchdq.robot.check.consistency import inert_joints

F32, F64 = torch.float32, torch.float64
EVERYTHING = ("mass", "com", "inertia", "friction", "armature", "offset")
TWO = shipped("two_link").robot
TREE = random_tree(3, seed=3).robot
ROBOTS = {**{name: shipped(name).robot for name in ("panda", "ur10e")}, "tree": TREE}
ROBOTS["puma560"] = shipped("puma560").robot.replace(on_unphysical="repair").bake()
every_robot = pytest.mark.parametrize("name", ROBOTS)
one_thread = helpers.one_thread


def matrices(inertia):
    """Inertias [..., 6] as matrices, in numpy's hands."""
    xx, xy, yy, xz, yz, zz = inertia.detach().double().unbind(-1)
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).unflatten(-1, (3, 3)).numpy()


def second_moments(inertia):
    """Principal second moments [..., 3] of inertias [..., 6], in ascending order."""
    inertia = matrices(inertia)
    return np.linalg.eigvalsh(np.trace(inertia, axis1=-2, axis2=-1)[..., None, None] / 2 * np.eye(3) - inertia)


def objections(mass, inertia):
    """What is unphysical about bodies; rounding of the numbers in hand may hide or show a flat direction."""
    moments, second = np.linalg.eigvalsh(matrices(inertia)), second_moments(inertia)
    slack = 16 * EPS[inertia.dtype] * moments.sum(-1)
    sound = {
        "not finite": np.isfinite(moments).all() and bool(mass.isfinite().all()),
        "mass": bool((mass > 0).all()),
        "definite": (moments[..., 0] >= -slack).all(),
        "triangle": (moments[..., 2] <= moments[..., 0] + moments[..., 1] + slack).all(),
        "second moments": (second[..., 0] >= -slack).all(),
    }
    return [fault for fault, fine in sound.items() if not fine]


def bodies(*batch, seed=0, flat=1.0):
    """Inertias of random point clouds, thinner by a factor in one direction of each."""
    points = random(*batch, 8, 3, seed=seed) * torch.tensor([1.0, 0.5, 0.5 * flat], dtype=F64)
    turn = torch.linalg.qr(random(*batch, 3, 3, seed=seed + 1)).Q
    points = (points - points.mean(-2, keepdim=True)) @ turn
    x, y, z = points.unbind(-1)
    entries = (y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y)
    return torch.stack([e.sum(-1) for e in entries], -1)


# --- forms -----------------------------------------------------------------------------------------------------------


@pytest.mark.case("I4")
@pytest.mark.parametrize("dtype", [F32, F64], ids=str)
@pytest.mark.parametrize("size", [1e-3, 1.0, 30.0, 1e3])
def test_any_free_numbers_are_a_body_that_exists(size, dtype):
    x = size * random(200, 6, seed=1, dtype=dtype)
    assert objections(Positive()(x[:, 0]), PhysicalInertia()(x)) == []


@pytest.mark.parametrize("form, columns", [(Positive(), ()), (PhysicalInertia(), (6,))], ids=["positive", "inertia"])
@pytest.mark.parametrize("dtype", [F32, F64], ids=str)
def test_free_numbers_come_back(form, columns, dtype):
    x = (0.5 * random(50, 3, *columns, seed=2)).to(dtype)
    back = form.right_inverse(form(x))
    assert back.dtype == dtype and back.shape == x.shape
    # the flattest of these bodies is known to eps over its flatness
    assert float((back - x).abs().max()) < 1e4 * EPS[dtype]


@pytest.mark.parametrize("flat", [1.0, 0.1, 0.01])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("dtype", [F32, F64], ids=str)
def test_a_positive_number_and_a_body_that_exists_come_back(scale, flat, dtype):
    x = (scale * random(100, seed=3).exp()).to(dtype)
    assert float((Positive()(Positive().right_inverse(x)) / x - 1).abs().max()) < 32 * EPS[dtype]
    inertia, form = (scale * bodies(40, 2, seed=4, flat=flat)).to(dtype), PhysicalInertia()
    error = (form(form.right_inverse(inertia)) - inertia).abs().amax(-1) / inertia.abs().amax(-1)
    assert float(error.max()) < 16 * EPS[dtype]


def test_the_free_numbers_are_the_triangle_of_the_second_moments():
    x = random(6, seed=5)
    L = np.zeros((3, 3))
    L[np.diag_indices(3)] = np.exp(x[[0, 2, 5]].numpy())
    L[np.tril_indices(3, -1)] = x[[1, 3, 4]].numpy() * np.linalg.norm(L)
    second = L @ L.T
    expected = np.trace(second) * np.eye(3) - second
    assert np.allclose(matrices(PhysicalInertia()(x)), expected, rtol=1e-14, atol=1e-14)


DEGENERATE = {
    "point": [0, 0, 0, 0, 0, 0],
    "rod": [0, 0, 1, 0, 0, 1],
    "oblique rod": [2, -1, 2, -1, -1, 2],
    "plate": [1, 0, 2, 0, 0, 3],
    "triangle inequality broken": [1, 0, 1, 0, 0, 5],
    "not definite": [-1, 0, 2, 0, 0, 2],
    "negative": [-1, 0, -1, 0, 0, -1],
    "only a product": [0, 1, 0, 0, 0, 0],
}


@pytest.mark.case("I4")
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("kind", DEGENERATE)
def test_a_body_at_or_beyond_the_limit_becomes_one_near_by(kind, scale):
    inertia, form = scale * torch.tensor(DEGENERATE[kind], dtype=F64), PhysicalInertia()
    x = form.right_inverse(inertia)
    found = form(x)
    assert bool(x.isfinite().all()) and objections(torch.ones(()), found) == []
    second = second_moments(found)
    assert second[0] > 0.9e-6 * second.sum()
    if kind in ("rod", "oblique rod", "plate"):
        assert float((found - inertia).abs().max()) < 3e-6 * scale * 3
    if kind == "point":
        assert np.allclose(matrices(found), 2e-8 * np.eye(3), rtol=1e-12)


@pytest.mark.case("I4")
@pytest.mark.parametrize("form, columns", [(Positive(), ()), (PhysicalInertia(), (6,))], ids=["positive", "inertia"])
def test_forms_have_the_derivatives_of_finite_differences(form, columns):
    x = random(3, *columns, seed=6).requires_grad_()
    assert torch.autograd.gradcheck(form, x)
    assert torch.autograd.gradgradcheck(form, x)


# --- optimisers cannot break a robot ---------------------------------------------------------------------------------


def adversarial(module, k):
    """Gradients that have nothing to do with anything, over twelve orders of magnitude."""
    for i, p in enumerate(module.parameters()):
        p.grad = random(*p.shape, seed=1000 * k + i) * 10.0 ** float(3 * random(1, seed=k))


def wanting_the_impossible(module, k):
    """Gradients towards the opposite torques, which only negative masses would give."""
    q, qd, qdd = random(3, 20, module.robot.n, seed=k)
    target = -torchdq.inverse_dynamics(module._robot, q, qd, qdd)
    (module(q, qd, qdd) - target).square().mean().backward()


@pytest.mark.case("I4")
@pytest.mark.parametrize(
    ("optimiser", "gradients"),
    thinned(
        [(x, y) for x in ("Adam", "SGD") for y in (adversarial, wanting_the_impossible)],
        [("Adam", adversarial)],
    ),
)
@pytest.mark.parametrize("name", thinned(ROBOTS, ["tree"]))
def test_a_robot_stays_physical_at_every_step(name, optimiser, gradients):
    module = torchdq.DQRNEA(ROBOTS[name], learn=EVERYTHING)
    rate = 0.5 if optimiser == "Adam" else 1e-3
    optimiser = getattr(torch.optim, optimiser)(module.parameters(), lr=rate)
    for k in range(40):
        optimiser.zero_grad()
        gradients(module, k)
        optimiser.step()
        robot = module.robot
        assert objections(robot.mass, robot.inertia) == []
        for positive in (robot.armature, module.viscous, module.coulomb):
            assert bool((positive > 0).all()) and bool(positive.isfinite().all())
        assert inert_joints(robot.joint_names, posed.tree(robot.bake(), {})) == {}


# --- where learning starts -------------------------------------------------------------------------------------------


def test_only_impossible_links_of_a_description_change():
    """The published inertias of the Puma 560 hold some, and a first link without mass."""
    robot = torchdq.robots.load("puma560")
    with refused(torchdq.UnphysicalError):
        RobotModule(robot, learn=("mass", "inertia"))
    module = RobotModule(robot.replace(on_unphysical="repair"), learn=("mass", "inertia"))
    second = second_moments(robot.inertia)
    possible = torch.from_numpy(second[:, 0] >= 1e-6 * second.sum(-1))
    assert 0 < int(possible.sum()) < robot.n
    assert torch.allclose(module.inertia[possible], robot.inertia[possible], rtol=1e-12, atol=1e-15)
    assert objections(module.mass, module.inertia) == []
    apart = (module.inertia - robot.inertia).abs().amax(-1) / robot.inertia.abs().amax(-1)
    assert bool((apart[~possible] > 1e-3).any()) and apart.max().item() < 0.6
    there = robot.mass > 0
    assert torch.allclose(module.mass[there], robot.mass[there], rtol=1e-14)


@all_in_one(["panda", "ur10e", "tree"])
def test_a_module_starts_as_the_plain_robot(name):
    robot = ROBOTS[name]
    robot = robot.replace(armature=0.1 * random(robot.n, seed=8).exp())
    s = states(robot, 20)
    module = torchdq.DQRNEA(robot, learn=("mass", "com", "inertia", "armature", "offset"))
    expected = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)
    assert float((module(s.q, s.qd, s.qdd) - expected).abs().max() / expected.abs().max()) < 1e-12


def test_what_the_description_has_none_of_starts_small():
    robot = ROBOTS["ur10e"]
    robot = robot.replace(damping=double(3, 0, 2, 0, 1, 0), friction=double(0, 5, 0, 0, 0, 0), armature=None)
    module = torchdq.DQRNEA(robot, learn=EVERYTHING)
    assert torch.allclose(module.viscous, double(3, 0.01, 2, 0.01, 1, 0.01), rtol=1e-14)
    assert torch.allclose(module.coulomb, double(0.01, 5, 0.01, 0.01, 0.01, 0.01), rtol=1e-14)
    assert torch.allclose(module.armature, torch.full((6,), 1e-3, dtype=F64), rtol=1e-14)
    assert not module.offset.any()


@pytest.mark.case("I1", "I4")
def test_links_without_mass_become_light_links():
    robot = ROBOTS["ur10e"]
    keep = double(1, 0, 1, 1, 1, 1)
    robot = robot.replace(mass=robot.mass * keep, inertia=robot.inertia * keep[:, None])
    module = torchdq.DQRNEA(robot, learn=EVERYTHING)
    assert abs(float(module.mass[1]) / 1e-6 - 1) < 1e-12
    assert objections(module.mass, module.inertia) == []
    x = random(3, 5, 6)
    module(*x).square().sum().backward()
    module.prior().backward()
    assert all(bool(p.grad.isfinite().all()) for p in module.parameters())


@all_in_one(["DQRNEA", "ForwardDynamics", "ComputedTorque"])
def test_gradients_reach_everything_that_is_learned(kind):
    gains = (9.0, 6.0) if kind == "ComputedTorque" else ()
    module = getattr(torchdq, kind)(ROBOTS["ur10e"], *gains, learn=EVERYTHING)
    module(*random(5 if gains else 3, 10, 6)).square().sum().backward()
    assert {name.removesuffix(".original").rpartition(".")[2] for name, _ in module.named_parameters()} == {
        *EVERYTHING, "viscous", "coulomb"
    } - {"friction"}  # fmt: skip
    assert all(bool((p.grad != 0).any()) for p in module.parameters())


def test_gradients_of_the_free_numbers_are_finite_differences():
    module = torchdq.DQRNEA(ROBOTS["tree"], learn=EVERYTHING)
    x = random(3, 2, module.robot.n, seed=9)
    names, values = zip(*module.named_parameters(), strict=True)

    def torques(*values):
        return functional_call(module, dict(zip(names, values, strict=True)), tuple(x))

    assert torch.autograd.gradcheck(torques, values, fast_mode=True)


REFUSED = [
    *({"learn": ("mass", bad)} for bad in ("viscous", "coulomb", "damping", "limits", "kp")),
    *({"learn": bad} for bad in (True, False, None, 1, [["mass"]], {"mass": True})),
]


@all_in_one(REFUSED)
def test_an_option_that_a_layer_cannot_take_is_named(options):
    makers = [torchdq.DQRNEA, torchdq.ForwardDynamics]
    if not isinstance(options.get("learn"), tuple):  # a controller learns its gains
        makers.append(partial(torchdq.ComputedTorque, kp=1.0, kd=1.0))
    for make in makers:
        with refused(torchdq.ArgumentError):
            make(ROBOTS["panda"], **options)


# --- friction and offset ---------------------------------------------------------------------------------------------

VISCOUS, COULOMB, WIDTH = double(3, 0.5, 2), double(1, 2, 0.3), 0.05
OFFSET = double(1, -2, 3)  # of any sign


def with_friction(kind, learn=("friction", "offset"), **options):
    """A module with friction and offset that are not its starting ones."""
    module = getattr(torchdq, kind)(TREE, learn=learn, sign_width=WIDTH, **options)
    module.viscous, module.coulomb, module.offset = VISCOUS, COULOMB, OFFSET
    return module


def test_friction_and_offset_are_their_formulas():
    q, qd, qdd = random(3, 30, 3, seed=10)
    qd[0] = 0.0
    module, expected = with_friction("DQRNEA"), VISCOUS * qd + COULOMB * qd / torch.sqrt(qd**2 + WIDTH**2)
    assert torch.allclose(module.friction_torque(qd), expected, rtol=1e-13, atol=1e-15)
    rigid = torchdq.inverse_dynamics(TREE, q, qd, qdd)
    assert torch.allclose(module(q, qd, qdd), rigid + expected + OFFSET, rtol=1e-13, atol=1e-12)
    assert torch.allclose(module(q), torchdq.inverse_dynamics(TREE, q) + OFFSET, rtol=1e-13, atol=1e-12)
    assert not torchdq.DQRNEA(TREE).friction_torque(qd).any() and module.friction_torque(qd.float()).dtype == F32


@all_in_one([("friction", "offset"), ("friction", "offset", "armature", "mass")])
def test_forward_dynamics_is_the_way_back_and_the_controller_compensates_at_the_measured_velocity(learn):
    q, qd, qdd, q_des, qd_des = random(5, 20, 3, seed=13)
    back = with_friction("ForwardDynamics", learn)
    found = back(q, qd, with_friction("DQRNEA", learn)(q, qd, qdd))
    assert torch.allclose(found, qdd, rtol=1e-9, atol=1e-9)
    found = back(q, qd, with_friction("ComputedTorque", learn, kp=9.0, kd=6.0)(q, qd, q_des, qd_des, qdd))
    assert torch.allclose(found, qdd + 6.0 * (qd_des - qd) + 9.0 * (q_des - q), rtol=1e-8, atol=1e-8)


# --- prior -----------------------------------------------------------------------------------------------------------


@every_robot
def test_the_prior_is_zero_at_the_start_and_positive_away(name):
    module = torchdq.DQRNEA(ROBOTS[name], learn=EVERYTHING)
    for start in (module, torchdq.DQRNEA(ROBOTS[name]), torchdq.DQRNEA(ROBOTS[name], learn="gravity")):
        assert float(start.prior()) == 0.0
    for key in dict(module.named_parameters()):
        other = copy.deepcopy(module)
        with torch.no_grad():
            dict(other.named_parameters())[key].view(-1)[-1] += 0.1
        assert key == "offset" or float(other.prior()) > 0.0


@all_in_one([1e-3, 60.0])
def test_the_prior_does_not_depend_on_the_unit_of_mass(unit):
    robot = ROBOTS["ur10e"]
    values = []
    for factor in (1.0, unit):
        mass, inertia, armature = (factor * x for x in (robot.mass, robot.inertia, torch.ones(6, dtype=F64)))
        module = torchdq.DQRNEA(robot.replace(mass=mass, inertia=inertia, armature=armature), learn=EVERYTHING[:5])
        module.mass, module.armature = mass * random(6, seed=16).exp(), armature * random(6, seed=17).exp()
        module.inertia = factor * (robot.inertia + 0.01 * bodies(6, seed=18))
        module.com = robot.com + 0.01 * random(6, 3, seed=19)
        values.append(float(module.prior()))
    assert values[0] > 0.1 and abs(values[1] / values[0] - 1) < 1e-9


def test_the_prior_is_its_formula():
    robot = ROBOTS["panda"]
    module = RobotModule(robot, learn=("mass", "com", "friction"))
    factor, shift = random(7, seed=20).exp(), 0.1 * random(7, 3, seed=21)
    module.mass, module.com = robot.mass * factor, robot.com + shift
    sizes = robot.inertia[:, [0, 2, 5]].sum(-1) / 2 / robot.mass
    expected = factor.log().square().mean() + (shift.square().sum(-1) / sizes).mean()
    assert abs(float(module.prior()) / float(expected) - 1) < 1e-12


# --- as torch modules ------------------------------------------------------------------------------------------------


def moved(kind=torchdq.DQRNEA):
    """A module that is away from its start, and inputs for it."""
    robot = ROBOTS["ur10e"]
    module = kind(robot, learn=EVERYTHING)
    with torch.no_grad():
        for i, p in enumerate(module.parameters()):
            p += 0.1 * random(*p.shape, seed=i)
    return module, random(3, 5, robot.n, seed=22)


def loaded(module):
    """The state, through a file, in a module that started from another robot."""
    file = io.BytesIO()
    torch.save(module.state_dict(), file)
    file.seek(0)
    robot = ROBOTS["ur10e"]
    other = type_before_parametrizations(module)(robot.replace(mass=3 * robot.mass, com=-robot.com), learn=EVERYTHING)
    other.load_state_dict(torch.load(file, weights_only=True))
    return other


TRIPS = {"deepcopy": copy.deepcopy, "pickle": lambda m: pickle.loads(pickle.dumps(m)), "state": loaded}


@pytest.mark.case("P12")
@pytest.mark.parametrize("trip", TRIPS)
@pytest.mark.parametrize("kind", [torchdq.DQRNEA, torchdq.ForwardDynamics])
def test_a_module_survives_a_round_trip_to_the_last_bit(kind, trip):
    module, x = moved(kind)
    other = TRIPS[trip](module)
    assert isinstance(other, kind) and torch.equal(other(*x), module(*x))
    assert trip == "state" or torch.equal(other.prior(), module.prior())
    assert [name for name, _ in other.named_parameters()] == [name for name, _ in module.named_parameters()]
    before = module.mass.detach().clone()
    other.mass = 2 * before  # on its own
    assert torch.equal(module.mass, before) and not torch.equal(other.mass, before)


def test_the_state_holds_what_is_learned_and_nothing_else():
    assert set(torchdq.DQRNEA(TREE, learn=("com", "inertia", "friction", "offset")).state_dict()) == {
        "com", "offset", *(f"parametrizations.{name}.original" for name in ("inertia", "viscous", "coulomb"))
    }  # fmt: skip
    assert torchdq.DQRNEA(TREE).state_dict() == {}


def test_a_batch_of_robots_learns_side_by_side():
    base = ROBOTS["ur10e"]
    factor = random(4, 1, seed=23).exp()
    robot = base.replace(mass=base.mass * factor, inertia=base.inertia * factor[..., None])
    module = torchdq.DQRNEA(robot, learn=("mass", "com", "inertia", "friction"))
    assert module.parametrizations.inertia.original.shape == (4, 6, 6)
    x = random(3, 4, 6, seed=24)
    found = module(*x)
    for k in range(4):
        one = base.replace(mass=robot.mass[k], inertia=robot.inertia[k])
        expected = torchdq.inverse_dynamics(one, *x[:, k]) + module.friction_torque(x[1, k])
        assert torch.allclose(found[k], expected, rtol=1e-10, atol=1e-10)
    (gradient,) = torch.autograd.grad(found[2].sum(), [module.parametrizations.mass.original])
    assert bool(gradient[2].any()) and not gradient[[0, 1, 3]].any()
    module.mass = 2 * module.mass.detach()
    assert abs(float(module.prior()) - np.log(2) ** 2) < 1e-12


# --- learning --------------------------------------------------------------------------------------------------------


@exhaustive
def test_a_whole_arm_is_found_from_torques_but_for_what_torques_do_not_show():
    true, n = ROBOTS["ur10e"], 6
    wrong = true.replace(mass=true.mass * random(6, seed=26).mul(0.3).exp())
    q, qd, qdd = random(3, 256, n, seed=27)
    tau = torchdq.inverse_dynamics(true, q, qd, qdd)
    module = torchdq.DQRNEA(wrong, learn=("mass", "com", "inertia"))
    optimiser = torch.optim.Adam(module.parameters(), lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 400)
    before = float((module(q, qd, qdd) - tau).square().mean())
    for _ in range(400):
        optimiser.zero_grad()
        with torchdq.backend("auto"):
            (module(q, qd, qdd) - tau).square().mean().backward()
        optimiser.step()
        schedule.step()
    unseen = random(3, 256, n, seed=28)
    error = (module(*unseen) - torchdq.inverse_dynamics(true, *unseen)).square().mean()
    assert float(error) < 1e-3 * before
    assert objections(module.mass, module.inertia) == []


WRONG = {
    "mass": ([math.nan, 1.0], [math.inf, 1.0], [1.0, -2.0], [1.0] * 3),
    "armature": ([1.0, -2.0],),
    "viscous": ([1.0, -2.0], [1.0] * 3),
    "coulomb": ([1.0, -2.0],),
    "inertia": ([[math.nan] * 6] * 2, [[math.inf] * 6] * 2, [[1.0] * 5] * 2),
    "offset": ([1.0] * 3,),
    "com": ([[1.0] * 3] * 3,),
}


@pytest.mark.parametrize("name, value", [(name, x) for name, values in WRONG.items() for x in values])
def test_a_quantity_that_cannot_be_set_is_named(name, value):
    module = torchdq.DQRNEA(TWO, learn=EVERYTHING)
    before = getattr(module, name).detach()
    for one in (module, pickle.loads(pickle.dumps(module))):
        with refused(torchdq.ArgumentError):
            setattr(one, name, torch.tensor(value))
        assert torch.equal(getattr(one, name), before)


def test_a_layer_says_what_takes_the_place_of_torchscript():
    layer = torchdq.DQRNEA(TWO, learn="mass")
    for one in (layer, torchdq.ForwardDynamics(TWO), torchdq.ResidualDynamics(layer)):
        with refused(torchdq.ArgumentError):
            torch.jit.script(one)


def test_negative_friction_of_a_description_is_not_another_one():
    with refused(torchdq.ArgumentError):
        torchdq.DQRNEA(TWO.replace(friction=-torch.ones_like(TWO.mass), on_unphysical="ignore"), learn="friction")


@all_in_one(["com", "inertia", "gravity", "viscous", "coulomb", "offset"])
def test_assigning_to_what_is_not_learned_is_refused(name):
    """It would leave the torques as they are."""
    layer = torchdq.DQRNEA(ROBOTS["panda"], learn=("mass",))
    with refused(torchdq.ArgumentError):
        setattr(layer, name, torch.ones(7, dtype=torch.float64))


def test_learned_quantities_are_assigned_in_their_shape():
    layer = torchdq.DQRNEA(TWO, learn=("offset", "friction", "mass", "com"))
    before = layer.offset
    layer.offset = torch.tensor([0.5, 0.25])
    assert layer.offset is before and layer.offset.tolist() == [0.5, 0.25]
    layer.mass = torch.tensor([1.5, 2.5])
    assert layer.mass.tolist() == layer.robot.mass.tolist() == pytest.approx([1.5, 2.5])
    assert torch.allclose(layer.parametrizations.mass.original, double(1.5, 2.5).log())
