"""Hard cases of bodies: without mass, thin, learned, a hundred million times heavier than their neighbours, tiny, huge.

That descriptions of such bodies are read, or refused by name, is tested in `test_urdf.py`; that learned ones stay
bodies, in `test_parameters.py`. Here are their dynamics.
"""

import contextlib
import itertools

import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import double, largest, random, thinned
from messages import refused
from oracles import EPS, pinocchio_model, random_tree, scaled, scaled_condition, states
from precisions import F32, F64, compiler, eager_first, every_backend_and_dtype, every_dtype, single_compiled

import torchdq
from torchdq import dq
from torchdq.errors import SingularInertiaError

HEAVY = 1e8
ONE = [1.0, 0, 0, 0]


def chain(axes, mass, com, inertia, **more):
    """Links of 1 m along x, each on a revolute joint; at home all frames have the axes of the base."""
    n = len(axes)
    points = np.stack([np.arange(n), np.zeros(n), np.zeros(n)], 1)
    link_poses = [[*ONE, 0, x / 2, 0, 0] for x in range(n)]
    screws = np.concatenate([axes, np.cross(points, axes)], 1)
    return torchdq.Robot.from_screws(screws, mass, com, inertia, link_poses, **more)


def rods(mass, seed=0):
    """Chain of rods of 1 m and of those masses, on random axes."""
    axes = np.random.default_rng([seed, len(mass)]).normal(size=(len(mass), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    m = np.asarray(mass)
    return chain(axes, m, np.tile([0.5, 0, 0], (len(m), 1)), np.outer(m / 12, [0, 0, 1, 0, 0, 1]))


def in_its_own_units(qdd, M):
    """Accelerations as the square roots of the energies that they are: D^-1 qdd, D = diag(M)^-1/2."""
    return qdd.double() * M.double().diagonal(dim1=-2, dim2=-1).sqrt()


def accelerations(robot, q, qd, tau):
    """Pinocchio's accelerations of rows of states."""
    model = pinocchio_model(robot)
    data = model.createData()
    rows = zip(*(x.double().numpy() for x in (q, qd, tau)), strict=True)
    return torch.from_numpy(np.array([pin.aba(model, data, *row) for row in rows]))


# --- bodies without mass, points, rods and plates --------------------------------------------------------------------

TURN = dq.to_rotation_matrix(dq.normalize(double(0.3, -0.5, 0.7, 0.4))).numpy()
THIN = {"point": (0, 0, 0), "rod": (0, 0.1, 0.1), "plate": (0.1, 0.2, 0.3)}


@pytest.mark.case("I1", "I2")
@every_backend_and_dtype
@pytest.mark.parametrize("kind", THIN)
def test_a_massless_cross_carries_a_heavy_thin_body(kind, dtype, backend, margin):
    """A universal joint: forward dynamics equals Pinocchio's, and undoes inverse dynamics."""
    inertia = np.stack([np.zeros((3, 3)), TURN @ np.diag(THIN[kind]) @ TURN.T])
    robot = chain([[0, 1.0, 0], [0, 0, 1.0]], [0.0, 40.0], [[0.0, 0, 0], [0.3, 0.2, 0.5]], inertia)
    s = states(robot, batch=4, dtype=dtype)
    with torchdq.backend(backend):
        tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)
        qdd = torchdq.forward_dynamics(robot, s.q, s.qd, tau)
        M = torchdq.mass_matrix(robot, s.q)
    condition = scaled_condition(M)
    error = in_its_own_units(qdd.double() - accelerations(robot, s.q, s.qd, tau), M)
    # what is subtracted from the torques is of their size
    size = largest(tau) * largest(M.double().diagonal(dim1=-2, dim2=-1).rsqrt())
    allowed = 4 * EPS[dtype] * condition * size
    margin(largest(error), allowed, "against pinocchio")
    margin(largest(in_its_own_units(qdd - s.qdd, M)), allowed, "there and back")


EMPTY = {
    "a link without mass": {"mass": 0.0, "com": (0.1, 0.2, 0.3)},
    "a point on the axis": {"mass": 1.0, "com": (0.0, 0.0, 0.7)},
    "a rod along the axis": {"mass": 1.0, "com": (0.0, 0.0, 0.7), "inertia": (0.1, 0, 0.1, 0, 0, 0)},
}


def with_finger(n, mass, com, inertia=(0,) * 6, rotor=None):
    """Chain of n rods whose last body is another one, on an axis along its own z."""
    axes = [[0.0, 1.0, 0.0]] * (n - 1) + [[0.0, 0.0, 1.0]]
    rod = (0, 0, 1 / 12, 0, 0, 1 / 12)
    robot = chain(
        axes,
        [1.0] * (n - 1) + [mass],
        [[0.5, 0, 0]] * (n - 1) + [com],
        [rod] * (n - 1) + [inertia],
        on_unphysical="ignore",
        joint_names=[f"j{i}" for i in range(n - 1)] + ["finger"],
    )
    return robot if rotor is None else robot.replace(armature=double(*[0.0] * (n - 1), rotor)).bake()


@pytest.mark.case("I1")
@eager_first
@pytest.mark.parametrize("n", [2, 12], ids=["by entries", "by articulated bodies"])
@pytest.mark.parametrize("kind", EMPTY)
def test_accelerations_of_a_joint_that_moves_nothing_are_refused_by_name(kind, n, backend):
    robot, q = with_finger(n, **EMPTY[kind]), torch.zeros(n, dtype=F64)
    assert torchdq.inverse_dynamics(robot, q, q, q, backend=backend).isfinite().all()  # needs no inverse
    with refused(SingularInertiaError):
        torchdq.forward_dynamics(robot, q, q, q, backend=backend)


@pytest.mark.case("I1", "I8")
@every_backend_and_dtype
def test_a_rotor_is_all_the_inertia_that_a_joint_needs(dtype, backend, margin):
    robot = with_finger(2, **EMPTY["a link without mass"], rotor=0.25)
    q = torch.tensor([[0.3, -0.7]], dtype=dtype)
    qdd = torchdq.forward_dynamics(robot, q, None, torch.tensor([[0.0, 2.0]], dtype=dtype), backend=backend)
    margin(abs(float(qdd[0, 1]) - 8.0), 8 * 4 * EPS[dtype])


# --- learned inertias ------------------------------------------------------------------------------------------------


@pytest.mark.case("I4")
@every_backend_and_dtype
def test_any_free_numbers_have_a_positive_definite_mass_matrix_and_finite_derivatives(dtype, backend):
    """From free numbers at random, of which those that are usual for arms are a small part."""
    robot = rods([1.0, 1.0, 1.0])
    module = torchdq.ForwardDynamics(robot, learn=("mass", "com", "inertia", "armature"))
    assert all(p.isfinite().all() for p in module.parameters())  # a rod, at the limit, has free numbers as well
    q, qd, tau = random(3, 5, 3, dtype=dtype)
    for seed in thinned(range(20), range(3)):
        for k, p in enumerate(module.parameters()):
            p.data = random(*p.shape, seed=10 * seed + k) * (1 + seed % 3)
        with torchdq.backend(backend):
            M = torchdq.mass_matrix(module.robot, q.double())
            assert (torch.linalg.eigvalsh(scaled(M)[0])[..., 0] > 64 * EPS[F64]).all()
            qdd = module(q, qd, tau)
            slopes = torch.autograd.grad(qdd.square().mean(), module.parameters())
        assert qdd.isfinite().all() and all(g.isfinite().all() for g in slopes)


@pytest.mark.case("I4")
def test_forward_dynamics_has_its_derivatives_in_the_free_numbers_of_a_rod():
    module = torchdq.ForwardDynamics(rods([1.0, 1.0]), learn=("mass", "inertia"))
    names, values = zip(*module.named_parameters(), strict=True)
    q, qd, tau = random(3, 2, 2)

    def f(*free):
        given = dict(zip(names, free, strict=True))
        return torch.func.functional_call(module, given, (q, qd, tau))

    # away from the flat limit, where a rod's logarithms of 1e-6 no longer change it
    free = [v.detach() + 0.1 * random(*v.shape, seed=3) + 3 * (v.detach() < -3) for v in values]
    free = [x.requires_grad_() for x in free]
    assert torch.autograd.gradcheck(f, free, eps=1e-6, atol=1e-7, rtol=1e-6)
    assert torch.autograd.gradgradcheck(f, free, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)


# --- mass ratios -----------------------------------------------------------------------------------------------------

RATIOS = {
    "heavy tip": [1.0] * 6 + [HEAVY],
    "heavy base": [HEAVY] + [1.0] * 6,
    "heavier outwards": np.geomspace(1.0, HEAVY, 7),
    "lighter outwards": np.geomspace(HEAVY, 1.0, 7),
    "heavy tip of a chain that is solved by articulated bodies": [1.0] * 15 + [HEAVY],
}


every_ratio = pytest.mark.parametrize("kind", RATIOS)


@pytest.mark.case("I5")
@every_ratio
def test_accelerations_of_unequal_masses_are_as_good_as_their_condition(kind, margin):
    """The condition number is of the matrix scaled to a unit diagonal: it knows that heavy bases are harmless."""
    robot = rods(RATIOS[kind])
    s = states(robot, batch=4)
    M = torchdq.mass_matrix(robot, s.q)
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)
    qdd = torchdq.forward_dynamics(robot, s.q, s.qd, tau)
    D = M.diagonal(dim1=-2, dim2=-1).rsqrt()
    size = largest(D * tau) + largest(in_its_own_units(s.qdd, M))
    margin(largest(in_its_own_units(qdd - s.qdd, M)), 20 * EPS[F64] * scaled_condition(M) * size, "there and back")
    error = in_its_own_units(qdd - accelerations(robot, s.q, s.qd, tau), M)
    margin(largest(error), 20 * EPS[F64] * scaled_condition(M) * size, "against pinocchio")
    back = torchdq.inverse_dynamics(robot, s.q, s.qd, qdd)
    margin(largest(D * (back - tau)), 32 * EPS[F64] * size, "residual")


@pytest.mark.case("I5")
@pytest.mark.parametrize(
    ("kind", "backend"),
    [
        *((kind, "eager") for kind in RATIOS),
        *(pytest.param(kind, "c", marks=compiler) for kind in thinned(["heavy tip"], [])),
    ],
)
def test_single_precision_knows_which_unequal_masses_it_can_bear(kind, backend, margin):
    """Heavy tips are computed in double precision without being asked; heavy bases need not be."""
    robot = rods(RATIOS[kind])
    s = states(robot, batch=4, dtype=F32)
    with torchdq.backend(backend):
        tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)
        exact = torchdq.forward_dynamics(robot, s.q.double(), s.qd.double(), tau.double())
        growth = torchdq.error_growth(robot, s.q.double())
        found = torchdq.forward_dynamics(robot, s.q, s.qd, tau)
        asked = torchdq.forward_dynamics(robot, s.q, s.qd, tau, precision="double")
        M = torchdq.mass_matrix(robot, s.q.double())
    size = in_its_own_units(exact, M).abs().amax(-1)
    error, least = (in_its_own_units(x - exact, M).abs().amax(-1) / size for x in (found, asked))
    margin(least.max(), EPS[F32], "precision double")
    rescued = growth > 2**10
    assert bool(rescued.all()) == kind.startswith(("heavy tip", "heavier"))
    if rescued.any():
        margin(error[rescued].max(), EPS[F32], "rescued")
    else:
        # the torques that are subtracted are larger than what remains of them
        D = M.diagonal(dim1=-2, dim2=-1).rsqrt()
        cancelled = 1 + (D * tau.double()).abs().amax(-1) / size
        margin((error / cancelled).max(), EPS[F32] * scaled_condition(M), "borne")


# --- pivots that are rounding ----------------------------------------------------------------------------------------


def point_mass(mass, at, screws, seed, far=1.0, **more):
    """Point of that mass and place on the second of two joints, the first link without any; frames are anywhere."""
    pose = dq.from_pose(dq.normalize(random(4, seed=seed)), far * random(3, seed=seed + 1))
    links = dq.mul(pose, dq.from_pose(dq.normalize(random(2, 4, seed=seed + 2)), random(2, 3, seed=seed + 3)))
    com = dq.translation(dq.mul(dq.conj(links[1]), dq.mul(pose, dq.from_pose(double(*ONE), double(*at)))))
    screws, com = dq.ad(pose, double(*screws).view(2, 6)), torch.stack([0 * com, com])
    return torchdq.Robot.from_screws(screws, [0.0, mass], com, np.zeros((2, 6)), links, **more)


def stretched(mass, far, seed):
    """Point mass at the end of a massless arm of two links, on hinges that are parallel."""
    return point_mass(mass, (2.0, 0, 0), (0, 0, 1, 0, 0, 0, 0, 0, 1, 0, -1, 0), seed, far)


@pytest.mark.case("I6")
@every_dtype
def test_a_stretched_arm_without_inertia_has_no_acceleration(dtype):
    """Its pivot is zero but for rounding, of either sign, which must not become a huge acceleration."""
    for mass, far, seed in itertools.product([1e-9, 1.0, 1e9], [0.0, 1.0, 1e4], thinned(range(5), range(1))):
        robot, q = stretched(mass, far, 10 * seed), torch.zeros(2, dtype=dtype)
        tau = torch.ones(2, dtype=dtype, requires_grad=True)
        qdd = torchdq.forward_dynamics(robot, q, None, tau)
        assert qdd.isnan().all()
        assert torch.autograd.grad(qdd.sum(), tau)[0].isnan().all()
        bent = torchdq.forward_dynamics(robot, torch.tensor([0.0, 1.0], dtype=dtype), None, tau)
        assert bent.isfinite().all()


@pytest.mark.case("I6")
@single_compiled
@pytest.mark.parametrize("mass", [1e-9, 1e9])
def test_a_nearly_stretched_arm_has_its_digits_or_none(mass, dtype, backend, margin):
    """M_11 / D_1 is 1 / sin^2 q_2 and more: what remains of sixteen digits is right, down to six bits of them."""
    robot = stretched(mass, 0.0, 0).replace(gravity=None).bake()
    bends = double(*np.geomspace(1e-9, 1.0, 40)).to(dtype)
    q = torch.stack([torch.zeros_like(bends), bends], -1)
    tau = torch.tensor([0.0, mass], dtype=dtype).expand_as(q)
    with torchdq.backend(backend):
        qdd = torchdq.forward_dynamics(robot, q, None, tau).double()
        growth = torchdq.error_growth(robot, q.double())
    lost = qdd.isnan().any(-1)
    assert lost.equal(~(growth <= 2.0**46)) and 0 < int(lost.sum()) < 20
    # M = m J^T J of two unit links, and tau = (0, m)
    exact = 1 / torch.sin(bends.double() / 2) ** 2
    error = ((qdd[:, 1] - exact) / exact).abs()[~lost]
    kept = growth[~lost]
    own = EPS[F32] * torch.where(kept <= 2.0**10, kept, 1.0) if dtype == F32 else 0.0
    margin((error / (8 * EPS[F64] * kept + 8 * own)).max(), 1.0, "errors in roundings times their growth")


@pytest.mark.case("I6")
def test_a_heavy_point_on_its_axis_is_noted_when_the_robot_is_read_and_has_no_acceleration_either():
    """Up to the rounding of where the axis is."""
    ones = torch.ones(2, dtype=F64)
    for seed in thinned(range(0, 200, 10), range(0, 200, 40)):
        given = 1e9, (1.0, 0, 0.7), (0, 1, 0, 0, 0, 0, 0, 0, 1, 0, -1, 0), seed
        assert point_mass(*given).notes[0].text().startswith("joint 'joint2': it moves no inertia")
        with contextlib.suppress(SingularInertiaError):
            qdd = torchdq.forward_dynamics(point_mass(*given, on_unphysical="ignore"), ones, None, ones)
            assert qdd.isnan().all()


# --- sizes and rotors ------------------------------------------------------------------------------------------------


def of_size(robot, s):
    """The robot with lengths times s, masses s^3, inertias s^5 and gravity s, so that a second stays a second."""
    length = torch.tensor([1.0] * 4 + [s] * 4, dtype=F64)
    slides = torch.tensor([kind == "prismatic" for kind in robot.kinds])[:, None]
    moment = torch.where(slides, robot.screw[:, 3:], s * robot.screw[:, 3:])
    return robot.replace(
        X_PB_home=robot.X_PB_home * length,
        screw=torch.cat([robot.screw[:, :3], moment], -1),
        mass=robot.mass * s**3,
        com=robot.com * s,
        inertia=robot.inertia * s**5,
        gravity=robot.gravity * s,
        armature=robot.armature * s**5,
    ).bake()


@pytest.mark.case("I7")
@every_backend_and_dtype
@pytest.mark.parametrize("size", [1e-3, 1e3], ids=["a millimetre", "a kilometre"])
def test_a_robot_of_any_size_moves_alike(size, dtype, backend, margin):
    robot = random_tree(4, seed=7, armature=True).robot
    small, s = of_size(robot, size), states(robot, batch=4, dtype=dtype)
    with torchdq.backend(backend):
        tau, tiny = (torchdq.inverse_dynamics(r, s.q, s.qd, s.qdd).double() for r in (robot, small))
        M, m = (torchdq.mass_matrix(r, s.q).double() for r in (robot, small))
        qdd = torchdq.forward_dynamics(robot, s.q, s.qd, tau.to(dtype)).double()
        alike = torchdq.forward_dynamics(small, s.q, s.qd, (tau * size**5).to(dtype)).double()
    growth = [torchdq.error_growth(r, s.q.double()) for r in (robot, small)]
    slopes = [torchdq.dynamics_jacobian(r, s.q, s.qd, s.qdd)[0].double() for r in (robot, small)]
    margin(largest(tiny / size**5 - tau) / largest(tau), 16 * EPS[dtype], "torques")
    margin(largest(m / size**5 - M) / largest(M), 16 * EPS[dtype], "mass matrix")
    margin(largest(slopes[1] / size**5 - slopes[0]) / largest(slopes[0]), 16 * EPS[dtype], "derivatives")
    margin(largest(growth[1] / growth[0] - 1), 16 * EPS[F64] * scaled_condition(M), "growth of errors")
    own = in_its_own_units(alike - qdd, M)
    margin(largest(own) / largest(in_its_own_units(qdd, M)), 16 * EPS[dtype] * scaled_condition(M), "accelerations")


@pytest.mark.case("I8")
@every_backend_and_dtype
@pytest.mark.parametrize("n", thinned([3, 16], [3]))  # by entries, and by articulated bodies
def test_rotors_are_in_every_form_of_the_dynamics(n, dtype, backend, margin):
    """They add armature qdd to the torques and themselves to the diagonal of M, and nothing to anything else."""
    bare = random_tree(n, seed=7).robot if n == 3 else rods([1.0] * n)
    rotors = 0.1 + random(n, seed=1).abs()
    robot, s = bare.replace(armature=rotors).bake(), states(bare, batch=3, dtype=dtype)
    rotors = rotors.to(dtype)
    M = torchdq.mass_matrix(robot, s.q)
    with torchdq.backend(backend):
        ID = [torchdq.inverse_dynamics(r, s.q, s.qd, s.qdd) for r in (bare, robot)]
        size = ID[0].abs().amax() + (rotors * s.qdd).abs().amax()
        margin(largest(ID[1] - ID[0] - rotors * s.qdd) / size, 8 * EPS[dtype], "inverse dynamics")
        back = torchdq.forward_dynamics(robot, s.q, s.qd, ID[1])
        size = largest(ID[1] * M.diagonal(dim1=-2, dim2=-1).rsqrt())
        allowed = 8 * EPS[dtype] * scaled_condition(M) * size
        margin(largest(in_its_own_units(back - s.qdd, M)), allowed, "forward dynamics")
    if n == 3 and backend == "eager":  # compiled, they are the same programs (test_backends.py)
        more = torchdq.mass_matrix(robot, s.q) - torchdq.mass_matrix(bare, s.q)
        margin(largest(more - rotors.diag()) / largest(M), 8 * EPS[dtype], "mass matrix")
        found, expected = torchdq.closed_form(robot, s.q, s.qd), torchdq.closed_form(bare, s.q, s.qd)
        margin(largest(found.M - expected.M - rotors.diag()) / largest(M), 8 * EPS[dtype], "closed form")
        assert all(x.equal(y) for x, y in zip(found[1:], expected[1:], strict=True))
        T = [torchdq.kinetic_energy(r, s.q, s.qd) for r in (bare, robot)]
        more = (rotors * s.qd.square()).sum(-1) / 2
        margin(largest((T[1] - T[0] - more) / T[1]), 8 * EPS[dtype], "kinetic energy")
        Y = [torchdq.regressor(r, s.q, s.qd, s.qdd) for r in (bare, robot)]
        assert Y[0].equal(Y[1])
        assert torchdq.dynamics_jacobian(robot, s.q, s.qd, s.qdd)[2].equal(M)
