"""Robots drawn from a posterior: each can exist, together they spread as the identification says.

The references are the checks that a description passes, the covariance of `identify`, and its errors of predicted
torques.
"""

import math

import oracles
import pytest
import torch
from helpers import all_in_one, random, thinned
from messages import refused
from recorded_logs import fitted
from scenes import rolled

import torchdq
from torchdq import Scene, effects
from torchdq.errors import ArgumentError
from torchdq.learning import posterior_samples
from torchdq.learning.identification.solution import nearest, of_numbers
from torchdq.robot.pseudo_inertia import pseudo_inertia, relative
from torchdq.scene import integrators

WIDTH = 0.02


def found_on(name, rows, noise, seed=0, prior=1.0, **options):
    """Identification of a shipped robot with friction, from random states."""
    robot, generator = torchdq.robots.load(name), torch.Generator().manual_seed(seed)
    q, qd, qdd = torch.randn(3, rows, robot.n, dtype=torch.float64, generator=generator)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + qd + 2 * qd / (qd**2 + WIDTH**2).sqrt()
    size = noise * tau.std(0)
    measured = tau + size * torch.randn(tau.shape, dtype=torch.float64, generator=generator)
    return fitted(robot, q, qd, qdd, measured, prior=prior, sign_width=WIDTH, **options)


@pytest.fixture(scope="module")
def found():
    return found_on("two_link", 500, 0.02, prior=16.0, offset=True)


@pytest.fixture(scope="module")
def drawn(found):
    return posterior_samples(found, 600)


def test_slopes_of_the_distance_are_those_of_autograd():
    def distance(y):
        """Distance of two links, three positive coefficients and one of any sign, as its formula reads."""
        x = 1 + y[20:23]
        bodies = sum(2 * (B.trace() - torch.logdet(B) - 4) for B in relative(y[:20].reshape(2, 10)))
        return bodies + 2 * (x - x.log() - 1).sum() + y[23:].square().sum()

    y, near = 0.1 * random(24), of_numbers(2, 3, 1)
    gradient, H = near.slopes(y)
    assert torch.allclose(near.distance(y), distance(y))
    assert torch.allclose(gradient, torch.autograd.functional.jacobian(distance, y))
    assert torch.allclose(H, torch.autograd.functional.hessian(distance, y))


def test_the_nearest_robot_is_a_minimum_where_bodies_can_exist():
    A, offset = 30 * random(40, 9, 24, seed=1), 100 * random(40, 9, seed=2)
    near = of_numbers(2, 3, 1)
    y = nearest(near, A, offset)  # such offsets would take most bodies where none can exist
    least = torch.linalg.eigvalsh(relative(y[:, :20].unflatten(1, (2, 10)))).min()
    assert float(least) > 0 and float(y[:, 20:23].min()) > -1
    gradient = near.slopes(y)[0] + 2 * torch.einsum("rm,rmt->rt", offset + torch.einsum("rmt,rt->rm", A, y), A)
    assert float(gradient.abs().max()) < 1e-3 * float((A.mT @ offset[..., None]).abs().max())


def test_base_parameters_have_the_mean_and_the_covariance_found(found, drawn):
    F = found.base @ found.spread
    off = (drawn.parameters - found.parameters) @ found.base.T
    z = torch.linalg.solve_triangular(torch.linalg.cholesky(F @ F.T), off.T, upper=False)
    rows, rank = len(off), len(F)
    assert float(z.mean(1).abs().max()) < 4 / math.sqrt(rows)
    # eigenvalues of the covariance of normal numbers are within these (V. Marchenko, L. Pastur, 1967)
    e = torch.linalg.eigvalsh(z @ z.T / rows)
    edge = math.sqrt(rank / rows)
    assert 0.85 * (1 - edge) ** 2 < float(e[0]) and float(e[-1]) < 1.15 * (1 + edge) ** 2


def test_torques_spread_as_predicted(found, drawn):
    q, qd, qdd = random(3, 40, 2, seed=5)
    viscous, coulomb, offset = (drawn.coefficients(name)[:, None] for name in ("viscous", "coulomb", "offset"))
    robot = drawn.robot.replace(**{x: getattr(drawn.robot, x)[:, None] for x in ("mass", "com", "inertia")})
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + viscous * qd + offset
    tau = tau + coulomb * qd / (qd**2 + WIDTH**2).sqrt()
    expected = found.predict(q, qd, qdd)
    assert torch.allclose(tau.std(0), expected.error, rtol=0.2)
    assert float(((tau.mean(0) - expected.tau) / expected.error).abs().max()) < 0.3


def test_unidentifiable_bodies_have_the_width_of_the_prior(found, drawn):
    """The links move in a plane: where mass is along the axes, and the mass of the first, is in no torque."""
    at = [found.names.index(f"link1 {name}") for name in ("mz", "Ixz", "Iyz")]
    assert not bool(found.identifiable[at].any())
    assert torch.allclose(drawn.parameters[:, at].std(0), found.errors[at], rtol=0.15)
    mass, width = drawn.robot.mass[:, 0], float(found.errors[0] / found.parameters[0])
    assert 0.05 < float(mass.log().std()) == pytest.approx(width, rel=0.15)


@all_in_one(thinned(["two_link", "ur10e"], ["two_link"]))
def test_every_robot_can_exist_however_few_the_samples(name):
    found = found_on(name, 40, 0.5, prior=0.05)
    drawn = posterior_samples(found, 60, seed=3)
    normal = found.parameters + random(60, found.spread.shape[1]) @ found.spread.T
    pi = normal[:, : 10 * found.robot.n].reshape(60, -1, 10)
    assert float(torch.linalg.eigvalsh(pseudo_inertia(pi)).min()) < 0  # not every normal draw could exist
    drawn.robot.check()
    assert bool((drawn.robot.mass > 0).all())
    assert all(bool((drawn.coefficients(kind) > 0).all()) for kind in ("viscous", "coulomb"))
    pi = drawn.parameters[:, : 10 * found.robot.n]
    size = found.robot.inertial_parameters.abs().max()
    assert oracles.worst(drawn.robot.inertial_parameters, pi, size) < 1e-12


def test_less_width_is_less_spread_of_what_is_unidentifiable(found, drawn):
    narrow = posterior_samples(found, 100, most=0.05)
    none = posterior_samples(found, 100, most=0.0)
    widths = [float(x.robot.mass[:, 0].log().std()) for x in (drawn, narrow, none)]
    assert widths[0] > 2 * widths[1] > 2 * widths[2]
    off = (none.parameters - found.parameters) @ found.base.T
    assert torch.allclose(off.std(0), found.base_errors, rtol=0.35)  # what is identifiable spreads as before


def test_links_without_mass_stay_without():
    robot = torchdq.robots.load("two_link")
    keep = torch.tensor([0.0, 1.0])
    described = robot.replace(mass=robot.mass * keep, inertia=robot.inertia * keep[:, None])
    q, qd, qdd, noise = torch.randn(4, 300, 2, dtype=torch.float64)
    tau = torchdq.inverse_dynamics(described, q, qd, qdd) + 0.1 * noise
    drawn = posterior_samples(fitted(described, q, qd, qdd, tau), 20)
    assert bool((drawn.robot.mass[:, 0] == 0).all()) and bool((drawn.robot.inertia[:, 0] == 0).all())
    assert float(drawn.robot.mass[:, 1].std()) > 0


def test_robots_of_which_only_friction_was_estimated_share_their_bodies(found):
    spread = found.spread.clone()
    spread[: 10 * found.robot.n] = 0
    rows = found.base[:, : 10 * found.robot.n].abs().sum(1) == 0
    drawn = posterior_samples(found._replace(spread=spread, base=found.base[rows]), 50)
    assert bool((drawn.robot.mass == found.robot.mass).all())
    assert torch.allclose(drawn.coefficients("viscous").std(0), found.errors[-6:-4], rtol=0.4)


def test_seeds_reproduce_robots(found):
    one, same, other = (posterior_samples(found, 3, seed=seed).parameters for seed in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)


def test_a_scene_simulates_all_of_them_at_once():
    some = posterior_samples(found_on("two_link", 200, 0.2, armature=True), 5)
    q, tau = torch.zeros(5, 2, dtype=torch.float64), torch.ones(5, 2, dtype=torch.float64)
    scene = Scene(some.robot, some.effects(), integrator=integrators.RungeKutta4(), dt=1e-3)
    state = rolled(scene, scene.start(q, q), 20, tau)
    bodies = {name: getattr(some.robot, name)[2] for name in ("mass", "com", "inertia", "armature")}
    viscous, coulomb = (some.coefficients(kind)[2] for kind in ("viscous", "coulomb"))
    friction = effects.Viscous(viscous), effects.Coulomb(coulomb, some.identified.sign_width)
    third = (effects.Gravity(), effects.RotorInertia(), *friction)
    alone = scene.replace(robot=some.robot.replace(**bodies), effects=third)
    other = rolled(alone, alone.start(q[2], q[2]), 20, tau[2])
    assert torch.allclose(state.q[2], other.q, rtol=1e-9)
    assert float(state.q.std(0).min()) > 1e-5


@pytest.mark.parametrize("arguments", [{"identified": 3}, {"n": 0}, {"most": -1.0}])
def test_other_arguments_are_refused(found, arguments):
    with refused(ArgumentError):
        posterior_samples(**{"identified": found, "n": 3, **arguments})
