"""Derivatives of a step: those of differences, for every kind of scene; those of Pinocchio, modes, a regulator."""

import cmath

import numpy as np
import pinocchio as pin
import pytest
import torch
from free_flyers import case, motion
from helpers import WHEEL, double, exhaustive, random, thinned
from scenes import ARM, TREE, rich
from scipy.linalg import solve_discrete_are
from urdf_text import joint, link, urdf

import torchdq
from torchdq import Scene, dq, effects
from torchdq.scene import State, linearize
from torchdq.scene.controllers import PD
from torchdq.scene.integrators import ExplicitEuler, RungeKutta4
from torchdq.scene.recording import branches
from torchdq.scene.spec import ORDER

EPS = torch.finfo(torch.float64).eps


def moved(state, ds):
    """State displaced by the numbers of a linearization; the pose of a floating base on the group."""
    rows = state.rows()
    widths = {name: 6 if name == "X_WB" else rows[name].shape[-1] for name in ORDER if name in rows}
    parts = dict(zip(widths, ds.split([*widths.values()], -1), strict=True))
    found = {name: rows[name] + d for name, d in parts.items() if name != "X_WB"}
    if "X_WB" in parts:
        found["X_WB"] = dq.mul(rows["X_WB"], dq.exp(parts["X_WB"] / 2))
    return State(**found)


def apart(one, other):
    """Numbers that displace one state to another."""
    rows, to = one.rows(), other.rows()
    found = {name: to[name] - x for name, x in rows.items()}
    if "X_WB" in rows:
        found["X_WB"] = 2 * dq.log_shortest(dq.mul(dq.conj(rows["X_WB"]), to["X_WB"]))
    return torch.cat([found[name] for name in ORDER if name in rows], -1)


def differences(scene, state, torque, **inputs):
    """Central differences of a step in every number of the state and of the torques."""
    s, n, h = apart(state, state).shape[-1], scene.n, 1e-5 if scene.robot.floating else 1e-6
    e = h * torch.eye(s + n, dtype=torque.dtype).reshape(-1, *[1] * (torque.dim() - 1), s + n)
    ends = [scene.step(moved(state, d[..., :s]), torque + d[..., s:], **inputs) for d in (e, -e)]
    return (apart(ends[1], ends[0]) / (2 * h)).movedim(0, -1)


LINEARIZED = {
    "bare": (Scene(ARM), {}),
    "tree": (Scene(TREE, (effects.Gravity(), effects.Coulomb(0.3, 0.5), effects.Drag(0.1, 0.1, 0.1))), {}),
    "of its own in every sample": (Scene(ARM, (effects.Payload(torch.linspace(0.1, 2.0, 4).double()),)), {}),
    "remembering and sensing": (
        Scene(
            ARM, (effects.Elastic(50.0, 0.5, 0.1), effects.FirstOrderLag(0.05), effects.Bias(0.1, 0.2)), PD(5.0, 1.0)
        ),
        {"reference": random(4, 6, seed=9)},
    ),
    "RungeKutta4": (Scene(ARM, (effects.Gravity(),), integrator=RungeKutta4()), {}),
    "floating": (Scene(case("tree2").robot, (effects.Gravity(), effects.Viscous(0.3)), dt=0.02), {}),
    "floating, in contact": (
        Scene(case("tree2").robot, (effects.Contact(height=100.0, stiffness=2.0, dissipation=0.01, friction=0.5),)),
        {},
    ),
    "floating, remembering and sensing": (
        Scene(case("tree2").robot, (effects.Elastic(50.0, 0.5, 0.1), effects.Bias(0.1, 0.2))),
        {},
    ),
    "of every slot": (
        rich(TREE, dt=0.02),
        {"reference": random(4, 9, seed=9), "push": random(4, 6, seed=7), "noise": random(4, 6).sigmoid()},
    ),
    "on a map of heights": (
        Scene(ARM, (effects.Contact(stiffness=20.0, surface=effects.HeightMap(random(9, 9), 0.5, (-2.0, -2.0))),)),
        {},
    ),
    "substeps in a loop": (Scene(ARM, (effects.Gravity(),), integrator=RungeKutta4(), substeps=3, unroll=False), {}),
}


# what these are linearized with is among that of others
AMONG_OTHERS = {"bare", "remembering and sensing", "floating", "floating, remembering and sensing"}


def start(scene):
    """Four states of a scene, and memory that is not that of rest."""
    n = scene.n
    base = {"X_WB": dq.exp(random(4, 6, seed=5)), "V_WB_B": random(4, 6, seed=6)} if scene.robot.floating else {}
    state = scene.start(0.4 * random(4, n), random(4, n, seed=1), **base)
    if state.memory is None:
        return state
    return state._replace(memory=state.memory + 0.1 * random(*state.memory.shape, seed=2))


@pytest.mark.parametrize("kind", thinned(LINEARIZED, LINEARIZED.keys() - AMONG_OTHERS))
def test_a_linearization_is_made_of_the_derivatives_of_a_step(kind):
    scene, inputs = LINEARIZED[kind]
    n, state = scene.n, start(scene)
    torque = random(4, n, seed=3)
    A, B = scene.linearize(state, torque, **inputs)
    s = apart(state, state).shape[-1]
    assert (A.shape, B.shape) == ((4, s, s), (4, s, n))
    expected = differences(scene, state, torque, **inputs)
    found = torch.cat([A, B], -1)
    assert (found - expected).abs().max() <= 1e-7 * expected.abs().max()


@pytest.mark.parametrize("kind", thinned(["tree", "floating"], ("floating",)))
def test_gradients_of_steps_that_are_called_one_by_one_are_the_same_derivatives(kind):
    scene = LINEARIZED[kind][0]
    torque = random(4, scene.n, seed=3)
    found, expected = (
        torch.cat(one.linearize(start(one), torque), -1)
        for one in (scene.replace(substeps=2, unroll=unroll) for unroll in (False, True))
    )
    assert (found - expected).abs().max() <= 1e3 * EPS * expected.abs().max()


@pytest.mark.parametrize("kind", thinned(["bare", "floating"], ("bare",)))
def test_a_linearization_is_differentiable(kind):
    """In states, torques and parameters, against differences; and mapped over, it is that of the batch."""
    robot = LINEARIZED[kind][0].robot
    generator, n = torch.Generator().manual_seed(0), robot.n
    base = {"X_WB": dq.exp(random(4, 6, seed=5)), "V_WB_B": random(4, 6, seed=6)} if robot.floating else {}
    z = [random(4, n), random(4, n, seed=1), random(4, n, seed=2), random(n, seed=3).exp()]

    def linearized(q, qd, torque, friction):
        scene = Scene(robot, (effects.Gravity(), effects.Viscous(friction)), dt=0.05)
        return torch.cat(scene.linearize(State(q, qd, **base), torque), -1)

    weights = torch.rand(linearized(*z).shape, dtype=torch.float64, generator=generator)
    gradients = torch.func.grad(lambda *z: (weights * linearized(*z)).sum(), (0, 1, 2, 3))(*z)
    for k, gradient in enumerate(gradients):
        along, h = torch.rand(z[k].shape, dtype=torch.float64, generator=generator), 1e-5
        ends = [linearized(*z[:k], z[k] + s * along, *z[k + 1 :]) for s in (h, -h)]
        expected = (weights * (ends[0] - ends[1])).sum() / (2 * h)
        assert (gradient * along).sum() == pytest.approx(float(expected), rel=1e-7)
    if not base:
        mapped = torch.func.vmap(linearized, (0, 0, 0, None))(*z)
        assert (mapped - linearized(*z)).abs().max() <= 100 * EPS * mapped.abs().max()


def test_a_linearization_is_part_of_a_graph():
    scene = Scene(WHEEL, (effects.Viscous(0.1),))

    class Module(torch.nn.Module):
        def forward(self, q, qd):
            return torch.cat(scene.linearize(State(q, qd)), -1)

    q, qd = random(4, 1), random(4, 1, seed=1)
    expected = Module()(q, qd)
    compiled = torch.compile(Module(), fullgraph=True, backend="eager")
    for graph in (torch.export.export(Module(), (q, qd)).module(), compiled):
        assert (graph(q, qd) - expected).abs().max() <= 100 * EPS * expected.abs().max()


def test_a_row_that_is_not_finite_is_alone():
    scene = Scene(case("tree1").robot, (effects.Gravity(),))
    q, X_WB = random(4, 1), dq.exp(random(4, 6, seed=5))
    spoilt = torch.where(torch.tensor([0, 1, 0, 0])[:, None] > 0, torch.nan, q)
    for found, other in zip(*(scene.linearize(scene.start(x, X_WB=X_WB)) for x in (spoilt, q)), strict=True):
        assert torch.equal(found[[0, 2, 3]], other[[0, 2, 3]]) and found[1].isnan().any()


def test_a_program_of_derivatives_has_none_that_vanish():
    """An explicit step moves positions by its duration times the velocities, whatever else there is."""
    arm = Scene(TREE, (effects.Gravity(),), dt=0.5, integrator=ExplicitEuler())
    program, n = arm.program(wrt=("torque",)), 3
    _, A, B = (np.array([v if isinstance(v, float) else np.nan for v in r.values]) for r in program.results)
    one, zero = np.eye(n), np.zeros((n, n))
    np.testing.assert_array_equal(A.reshape(2 * n, -1)[:n], np.hstack([one, 0.5 * one]))
    np.testing.assert_array_equal(B.reshape(2 * n, -1)[:n], zero)


@pytest.mark.parametrize(
    "kind", thinned(["of its own in every sample", "floating, in contact", "of every slot"], ("floating, in contact",))
)
def test_a_program_of_one_column_of_every_branch_finds_all(kind, monkeypatch):
    """Where one of all columns would be too long."""
    scene, inputs = LINEARIZED[kind]
    given = start(scene), random(4, scene.n, seed=3)
    expected = torch.cat(scene.linearize(*given, **inputs), -1)
    monkeypatch.setattr(linearize, "LARGEST", 0)
    found = torch.cat(scene.linearize(*given, **inputs), -1)
    assert (found - expected).abs().max() <= 1e3 * EPS * expected.abs().max()


def test_branches_of_a_quadruped_are_its_base_and_legs():
    """Three positions, velocities and torques of a leg, and what its foot remembers."""
    scene = Scene(torchdq.robots.load("go2"), (effects.Contact("*_foot"),))
    base, *legs = branches(scene.spec)
    assert sorted(j for branch in (base, *legs) for j in branch) == [*range(6 + 12 + 6 + 12 + 4 * 8 + 12)]
    assert base == [*range(6), *range(18, 24)] and [len(leg) for leg in legs] == [3 * 3 + 8] * 4
    names = scene.robot.joint_names
    for leg in legs:
        assert len({names[j - 6].split("_")[0] for j in leg[:3]}) == 1
        assert [j - 6 for j in leg[:3]] == [j - 24 for j in leg[3:6]] == [j - 68 for j in leg[-3:]]


def test_a_linearization_of_one_state_is_a_pair_of_matrices():
    """Without torques it is that at none."""
    scene = Scene(ARM, (effects.Gravity(),))
    state = scene.start(double(0.3, -0.4))
    A, B = scene.linearize(state)
    assert (A.shape, B.shape) == ((4, 4), (4, 2))
    assert torch.equal(A, scene.linearize(state, double(0.0, 0.0)).A)
    whole = scene.linearize(scene.start(double(0.3, -0.4).expand(3, 2)), double((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
    assert torch.equal(whole.A[0], A)


@pytest.mark.parametrize("name", thinned(["tree3", "tree7"], ["tree3"]))
def test_the_limit_of_short_steps_is_pinocchios(name):
    """(A - 1)/h and B/h of a floating base at h -> 0 are derivatives of Pinocchio's dynamics on its group."""
    c, h = case(name), 1e-7
    m, n = motion(c), c.robot.n
    scene = Scene(c.robot, (effects.Gravity(), effects.RotorInertia(c.robot.armature)), dt=h)
    A, B = scene.linearize(scene.start(m["q"], m["qd"], X_WB=m["X_WB"], V_WB_B=m["V_WB_B"]), m["tau"])
    v = n + 6
    for k in range(len(A)):
        data, q = c.model.createData(), c.configuration(m["X_WB"][k], m["q"][k])
        rate, tau = c.velocity(m["V_WB_B"][k], m["qd"][k]), c.velocity(torch.zeros(6), m["tau"][k])
        pin.computeABADerivatives(c.model, data, q, rate, tau)
        turned = (pin.dIntegrate(c.model, q, h * rate, pin.ArgumentPosition.ARG0) - np.eye(v)) / h
        moves = (turned, np.eye(v), data.ddq_dq, data.ddq_dv)
        expected = np.block([[x[np.ix_(c.order, c.order)] for x in moves[i : i + 2]] for i in (0, 2)])
        found = ((A[k] - torch.eye(2 * v)) / h).numpy()
        assert np.abs(found - expected).max() <= 10 * h * np.abs(expected @ expected).max()
        push = data.Minv[np.ix_(c.order, c.order)][:, 6:]
        assert np.abs(B[k, v:].numpy() / h - push).max() <= 10 * h * np.abs(expected[v:] @ expected[:, v:] @ push).max()


INERTIA = (0.1, 0.2, 0.25)  # of a body about its axes [kg m^2]


def lone(**start):
    """Rigid body in flight, and its linearization."""
    body = {"base_mass": double(2.0)[0], "base_com": double(0.0, 0, 0), "base_inertia": double(0.1, 0, 0.2, 0, 0, 0.25)}
    scene = Scene(case("quadrotor_base").robot.replace(**body), integrator=RungeKutta4(), dt=0.01)
    return scene.linearize(scene.start(double(), X_WB=dq.exp(random(6, seed=3)), **start)).A


def test_a_body_at_rest_in_space_is_a_double_integrator_of_its_displacement():
    A = lone()
    one = torch.eye(12, dtype=A.dtype)
    assert (A - one - 0.01 * one.roll(6, -1).triu()).abs().max() <= 1e-15


@pytest.mark.parametrize("axis", range(3))
def test_a_spinning_body_has_the_modes_of_euler(axis):
    """Rates: sqrt((I - I_1) (I_2 - I) / (I_1 I_2)) w; real about the middle axis alone, where it tumbles."""
    w, others = 3.0, [x for k, x in enumerate(INERTIA) if k != axis]
    rate = w * cmath.sqrt((INERTIA[axis] - others[0]) * (others[1] - INERTIA[axis]) / (others[0] * others[1]))
    A = lone(V_WB_B=w * torch.eye(6, dtype=torch.float64)[axis])
    found = torch.linalg.eigvals(A[6:9, 6:9])
    for sign in (1, -1):
        assert (found - cmath.exp(0.01 * sign * rate)).abs().min() <= 1e-7
    assert (float(found.abs().max()) > 1.01) == (axis == 1)


WHEELS = urdf(
    link("body", 10, (1, 0, 1.2, 0, 0, 0.8), (0, 0, 0)),
    *(link(f"wheel_{x}", 0.5, (0.01, 0, 0.01, 0, 0, 0.01), (0, 0, 0)) for x in "xyz"),
    *(joint(x, "body", f"wheel_{x}", "continuous", axis=[x == y for y in "xyz"], more="") for x in "xyz"),
)


@exhaustive
def test_a_regulator_of_the_linearization_turns_a_satellite_by_its_wheels():
    """LQR of the attitude and its rate, from 80 degrees about a skew axis."""
    satellite = torchdq.Robot.from_urdf(WHEELS, base="floating")
    scene = Scene(satellite, dt=0.2, backend="auto")
    goal = scene.start(torch.zeros(3, dtype=torch.float64))
    A, B = (x.numpy() for x in scene.linearize(goal))
    kept = [0, 1, 2, 9, 10, 11]  # attitude and its rate; wheels and place are as they come
    A, B = A[np.ix_(kept, kept)], B[kept]
    P = solve_discrete_are(A, B, np.eye(6), 10 * np.eye(3))
    K = torch.from_numpy(np.linalg.solve(10 * np.eye(3) + B.T @ P @ B, B.T @ P @ A))
    axis = double(0.6, -0.48, 0.64)
    state = goal._replace(X_WB=dq.exp(torch.cat([axis * 1.4 / 2, double(0.0, 0, 0)])))
    path = scene.rollout(state, steps=200, policy=lambda s, k: -K @ apart(goal, s)[kept])
    off = torch.stack([apart(goal, type(path)(*(None if x is None else x[k] for x in path))) for k in (49, 99, 199)])
    size = off[:, kept].norm(dim=-1)
    closed = float(np.abs(np.linalg.eigvals(A - B @ K.numpy())).max())
    assert size[2] <= 2 * size[1] * closed**100 + 1e-12 and closed < 0.94
