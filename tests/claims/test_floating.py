"""Functions of robots with a floating base agree with Pinocchio's with a free-flyer.

Errors are relative to the size of what is added up: of generalised forces, the sum of the magnitudes |Y| |pi| of their
terms; of accelerations, 64 eps times the condition number of the mass matrix scaled to a unit diagonal.
"""

import copy
import itertools
from functools import partial

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from free_flyers import ANGULAR_FIRST, MORE_ROBOTS, ROBOTS, TREES, FreeFlyer, Motion, body, case, motion, over
from helpers import all_in_one, thinned
from messages import refused, warned
from oracles import EPS
from precisions import eager_first

import torchdq
from torchdq import dq, floating

F64, F32 = torch.float64, torch.float32
TOLERANCE = {F64: 1e-12, F32: 5e-6}
NAMES = (*TREES, *ROBOTS, *MORE_ROBOTS)
KEPT = ("tree1", "tree3", "solo12", "quadrotor_base")
EVERY = pytest.mark.parametrize("name", thinned(NAMES, KEPT))
FEW = ("tree1", "tree3", "tree7", "quadrotor_base", "solo12")
SOME = pytest.mark.parametrize("name", thinned(FEW, ("tree1", "tree3", "quadrotor_base")))
PLACE, TWIST, CHANGE = ("X_WB", "q"), ("X_WB", "q", "V_WB_B", "qd"), ("X_WB", "q", "V_WB_B", "qd", "A_WB_B", "qdd")
WRENCHES = ("f_tip", "f_ext", "f_base")
FUNCTIONS = {
    **dict.fromkeys(("inverse_dynamics", "regressor", "momentum_rate"), CHANGE),
    **dict.fromkeys(("closed_form", "coriolis_matrix", "kinetic_energy", "momentum"), TWIST),
    **dict.fromkeys(("mass_matrix", "potential_energy", "centre_of_mass", "forward_kinematics", "jacobian"), PLACE),
    "forward_dynamics": (*TWIST, "tau"),
}  # with their arguments
DYNAMIC = ("inverse_dynamics", "forward_dynamics")
DYNAMICS = pytest.mark.parametrize("function", DYNAMIC)


def near(found, expected, size=1.0, tolerance=TOLERANCE[F64]):
    found, expected = (np.asarray(x.detach() if isinstance(x, torch.Tensor) else x, float) for x in (found, expected))
    assert found.shape == expected.shape
    error = np.max(np.abs(found - expected) / size, initial=0.0)
    assert error <= tolerance, f"{error:.3g} > {tolerance:.3g}"


def generalised(F: floating.Forces | floating.Accelerations) -> torch.Tensor:
    """(moment, force, tau), or (angular, linear, qdd)."""
    base, joints = F
    base = dq.paper.swap(base) if isinstance(F, floating.Forces) else base
    return torch.cat([base, joints], -1)


def found_by(function: str, c: FreeFlyer, m: Motion, **more):
    """Results of a function for a motion."""
    more |= {"frame": c.robot.frame_names[-1]} if function == "jacobian" else {}
    return getattr(floating, function)(c.robot, **m.pick(*FUNCTIONS[function]), **more)


def forces_of(c: FreeFlyer, m: Motion, *wrenches: str) -> np.ndarray:
    """Pinocchio's forces, in our order."""

    def forces(model, data, q, v, a, row):
        return pin.rnea(model, data, q, v, a, c.wrenches(**{name: row[name] for name in wrenches}))

    return over(forces, c, m)[:, c.order]


def size_of(c: FreeFlyer, m: Motion) -> float:
    """Size of the terms of the forces, the largest."""
    pi = np.abs(np.concatenate([i.toDynamicParameters() for i in list(c.model.inertias)[1:]]))

    def size(model, data, q, v, a, row):
        return np.abs(pin.computeJointTorqueRegressor(model, data, q, v, a)) @ pi + model.armature * np.abs(a)

    moments = np.abs(over(lambda model, data, q, v, a, row: pin.rnea(model, data, q, v, a), c, m))
    return float(max(over(size, c, m).max(), moments.max()))


def still(m: Motion, *names: str) -> Motion:
    """The motion with some of its parts zero."""
    return Motion({**m, **{name: 0 * m[name] for name in names}})


def mass_matrices(c: FreeFlyer, m: Motion) -> np.ndarray:
    M = over(lambda model, data, q, v, a, row: pin.crba(model, data, q).copy(), c, m)
    M = np.triu(M) + np.triu(M, 1).swapaxes(-1, -2)
    return M[:, c.order][..., c.order]


def rounding(c: FreeFlyer, m: Motion) -> float:
    """Error of accelerations: 64 eps times the condition number of the mass matrix scaled to a unit diagonal."""
    M = mass_matrices(c, m)
    d = np.sqrt(np.diagonal(M, axis1=-2, axis2=-1))
    return 64 * EPS[F64] * float(np.linalg.cond(M / d[..., None] / d[..., None, :]).max())


# --- forces ----------------------------------------------------------------------------------------------------------


@EVERY
def test_inverse_dynamics(name):
    c, m = case(name), motion(case(name))
    of_a_tip = [("f_tip",), WRENCHES] if c.robot.n else []  # a single body has none
    for wrenches in [(), ("f_ext",), ("f_base",), *of_a_tip]:
        found = generalised(floating.inverse_dynamics(c.robot, **m.pick(*CHANGE, *wrenches)))
        near(found, forces_of(c, m, *wrenches), size_of(c, m) + (1e3 if wrenches else 0.0))


@pytest.mark.parametrize("name", thinned(FEW, ("tree3", "quadrotor_base")))
def test_absent_velocities_and_accelerations_are_zero(name):
    c, m = case(name), motion(case(name))
    pairs = [("V_WB_B", "qd"), ("A_WB_B", "qdd"), ("V_WB_B", "A_WB_B"), ("qd", "qdd"), CHANGE[2:]]
    for absent in [*((x,) for x in CHANGE[2:]), *pairs]:
        found = floating.inverse_dynamics(c.robot, **m.pick(*(x for x in CHANGE if x not in absent)))
        near(generalised(found), forces_of(c, still(m, *absent)), size_of(c, m))


@EVERY
def test_forward_dynamics(name):
    c, m = case(name), motion(case(name))
    wrenches = WRENCHES if c.robot.n else ("f_base",)

    def accelerations(model, data, q, v, a, row):
        tau = c.velocity(np.zeros(6), row["tau"])
        return pin.aba(model, data, q, v, tau, c.wrenches(**{w: row[w] for w in wrenches}))

    expected = over(accelerations, c, m)[:, c.order]
    found = generalised(floating.forward_dynamics(c.robot, **m.pick(*TWIST, "tau", *wrenches)))
    near(found, expected, np.abs(expected).max(), rounding(c, m))
    at_rest = floating.forward_dynamics(c.robot, **m.pick(*PLACE), V_WB_B=None, qd=None, tau=0 * m["tau"])  # free fall
    expected = over(lambda model, data, q, v, a, row: pin.aba(model, data, q, 0 * v, 0 * v), c, m)[:, c.order]
    near(generalised(at_rest), expected, np.abs(expected).max(), rounding(c, m))


@EVERY
def test_mass_matrix_and_its_blocks(name):
    c, m = case(name), motion(case(name))
    found, expected = floating.mass_matrix(c.robot, **m.pick(*PLACE)), mass_matrices(c, m)
    size = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1).max(0))
    near(found.M, expected, (size[:, None] * size)[None])
    assert found.M.equal(found.M.mT)
    assert found.base.equal(found.M[..., :6, :6]) and found.coupling.equal(found.M[..., :6, 6:])
    assert found.joints.equal(found.M[..., 6:, 6:])
    torch.linalg.cholesky(found.M)  # positive definite


@EVERY
def test_closed_form_is_the_bias_and_its_parts(name):
    c, m = case(name), motion(case(name))
    M, g_and_c, size = mass_matrices(c, m), forces_of(c, still(m, "A_WB_B", "qdd")), size_of(c, m)
    found = floating.closed_form(c.robot, **m.pick(*TWIST))
    near(found.M, M, np.abs(M).max())
    near(found.c + found.g, g_and_c, size)
    gravity = over(lambda model, data, q, v, a, row: pin.computeGeneralizedGravity(model, data, q), c, m)[:, c.order]
    near(found.g, gravity, size)


@EVERY
def test_the_coriolis_matrix_gives_the_bias_and_the_rate_of_the_mass_matrix_and_swaps_by_the_bracket(name):
    c, m = case(name), motion(case(name))
    C, v = floating.coriolis_matrix(c.robot, **m.pick(*TWIST)), torch.cat([m["V_WB_B"], m["qd"]], -1)
    bias = over(lambda model, data, q, v, a, row: pin.nonLinearEffects(model, data, q, v), c, m)
    gravity = over(lambda model, data, q, v, a, row: pin.computeGeneralizedGravity(model, data, q), c, m)
    size = size_of(c, m)
    near((C @ v[..., None])[..., 0], (bias - gravity)[:, c.order], size)
    theirs = over(lambda model, data, q, v, a, row: pin.computeCoriolisMatrix(model, data, q, v).copy(), c, m)
    rate = theirs + theirs.swapaxes(-1, -2)  # Pinocchio's has another skew part
    near(C + C.mT, rate[:, c.order][..., c.order], size)
    W, wd = m["A_WB_B"], m["qdd"]
    other = floating.coriolis_matrix(c.robot, m["X_WB"], m["q"], W, wd)
    V, cross = m["V_WB_B"], torch.linalg.cross
    bracket = [cross(V[:, :3], W[:, :3]), cross(V[:, :3], W[:, 3:]) + cross(V[:, 3:], W[:, :3]), 0 * wd]
    M = floating.mass_matrix(c.robot, **m.pick(*PLACE)).M
    swapped = other @ v[..., None] + M @ torch.cat(bracket, -1)[..., None]
    near(C @ torch.cat([W, wd], -1)[..., None], swapped, 4 * size)


@EVERY
def test_regressor(name):
    c, m = case(name), motion(case(name))
    expected = over(lambda model, data, q, v, a, row: pin.computeJointTorqueRegressor(model, data, q, v, a), c, m)
    found = floating.regressor(c.robot, **m.pick(*CHANGE))
    tau = found @ c.robot.inertial_parameters
    bare = c.robot if c.robot.armature is None else c.robot.replace(armature=None)
    near(tau, generalised(floating.inverse_dynamics(bare, **m.pick(*CHANGE))), size_of(c, m))
    # Pinocchio's parameters are about its joint frames: moved to the link frames, they are ours
    bodies = [np.eye(10)]
    for link in c.robot.link_names:
        bodies.append(oracles.moved_parameters(c.model.frames[c.frame_id(link)].placement))
    ids = [1, *(joint.id for joint in c.joints)]
    blocks = [expected[:, c.order, 10 * (i - 1) : 10 * i] @ moved for i, moved in zip(ids, bodies, strict=True)]
    near(found, np.concatenate(blocks, -1), np.abs(expected).max())


# --- energy, momentum, kinematics ------------------------------------------------------------------------------------


@EVERY
def test_energies(name):
    c, m = case(name), motion(case(name))
    U = over(lambda model, data, q, *_: pin.computePotentialEnergy(model, data, q), c, m)
    M, v = mass_matrices(c, m), torch.cat([m["V_WB_B"], m["qd"]], -1).numpy()
    T = 0.5 * np.einsum("bi,bij,bj->b", v, M, v)
    near(floating.kinetic_energy(c.robot, **m.pick(*TWIST)), T, T.max())
    size = np.abs(U).max() + 30 * pin.computeTotalMass(c.model)
    near(floating.potential_energy(c.robot, **m.pick(*PLACE)), U, size)


@EVERY
def test_centre_of_mass_and_momentum(name):
    c, m = case(name), motion(case(name))

    def expected(model, data, q, v, a, row):
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        h, dh = data.hg.vector.copy(), data.dhg.vector.copy()
        return np.concatenate([pin.centerOfMass(model, data, q), h, dh])

    found = over(expected, c, m)
    near(floating.centre_of_mass(c.robot, **m.pick(*PLACE)), found[:, :3], 10.0)
    h, dh = floating.momentum(c.robot, **m.pick(*TWIST)), floating.momentum_rate(c.robot, **m.pick(*CHANGE))
    near(torch.cat(h, -1), found[:, 3:9], np.abs(found[:, 3:9]).max(), 4e-12)
    near(torch.cat(dh, -1), found[:, 9:], max(np.abs(found[:, 9:]).max(), size_of(c, m)), 4e-12)


@EVERY
def test_poses_of_all_frames(name):
    c, m = case(name), motion(case(name))
    known = [f for f in c.robot.frame_names if c.model.existFrame(f, pin.FrameType.BODY)]
    assert known

    def placements(model, data, q, v, a, row):
        pin.framesForwardKinematics(model, data, q)
        return [data.oMf[c.frame_id(f)].homogeneous for f in known]

    found = floating.forward_kinematics(c.robot, **m.pick(*PLACE), frame=known)
    near(dq.to_matrix(found), over(placements, c, m), 10.0)
    assert floating.forward_kinematics(c.robot, **m.pick(*PLACE)).shape == (3, len(c.robot.frames), 8)
    one = floating.forward_kinematics(c.robot, **m.pick(*PLACE), frame=known[-1])
    near(dq.to_matrix(one), dq.to_matrix(found[:, -1]), 10.0)


@EVERY
def test_jacobians_of_frames(name):
    c, m = case(name), motion(case(name))
    known = [f for f in c.robot.frame_names if c.model.existFrame(f, pin.FrameType.BODY)]
    references = {"body": pin.LOCAL, "world": pin.LOCAL_WORLD_ALIGNED}
    for f, expressed in itertools.product({known[0], known[len(known) // 2], known[-1]}, references):

        def jacobian(model, data, q, v, a, row, frame=f, reference=references[expressed]):
            return pin.computeFrameJacobian(model, data, q, c.frame_id(frame), reference)

        found = floating.jacobian(c.robot, **m.pick(*PLACE), frame=f, expressed=expressed)
        near(found, over(jacobian, c, m)[:, ANGULAR_FIRST][..., c.order], 10.0)


@pytest.mark.parametrize("expressed", ["body", "world"])
@pytest.mark.parametrize("name", thinned(FEW, ("tree3", "quadrotor_base")))
def test_wrenches_at_frames_move_the_robot_as_those_of_pinocchio(name, expressed):
    c, m = case(name), motion(case(name))
    known = [f for f in c.robot.frame_names if c.model.existFrame(f, pin.FrameType.BODY)]
    wrenches = dict.fromkeys((known[0], known[len(known) // 2], known[-1]), m["f_base"])

    def accelerations(model, data, q, v, a, row):
        pin.framesForwardKinematics(model, data, q)
        forces = [pin.Force.Zero() for _ in range(model.njoints)]
        for f in wrenches:
            frame, turn = model.frames[c.frame_id(f)], data.oMf[c.frame_id(f)].rotation
            turn = turn.T if expressed == "world" else np.eye(3)
            F = pin.Force(turn @ row["f_base"][:3], turn @ row["f_base"][3:])
            forces[frame.parentJoint] += frame.placement.act(F)
        return pin.aba(model, data, q, v, 0 * v, forces)

    expected = over(accelerations, c, m)[:, c.order]
    held = floating.external_wrenches(c.robot, **m.pick(*PLACE), wrenches=wrenches, expressed=expressed)
    found = floating.forward_dynamics(c.robot, **m.pick(*TWIST), tau=0 * m["tau"], **held._asdict())
    near(generalised(found), expected, np.abs(expected).max(), rounding(c, m))


# --- derivatives -----------------------------------------------------------------------------------------------------


def displaced(X: torch.Tensor) -> torch.Tensor:
    """Derivative [..., 8, 6] of X exp(xi/2) in a displacement xi at 0: X xi / 2."""
    xi = torch.zeros(6, 8, dtype=X.dtype)
    xi[:3, 1:4], xi[3:, 5:] = torch.eye(3), torch.eye(3)
    return 0.5 * dq.mul(X[..., None, :], xi).mT


def tangent(f, *at: torch.Tensor) -> list[torch.Tensor]:
    """Derivatives of f(X_WB, q, base, joints, ...) in a displacement of the place and in its pairs, [rows, 6 + n]."""
    J = torch.autograd.functional.jacobian(lambda *x: generalised(f(*x)), at, vectorize=False)
    return [torch.cat([J[0] @ displaced(at[0]), J[1]], -1), *(torch.cat(J[k : k + 2], -1) for k in range(2, len(J), 2))]


@pytest.mark.parametrize(
    "name, backend",
    thinned(
        [*itertools.product(["tree1", "tree4", "tree7", "quadrotor_base", "tree12", "solo12"], ["eager", "c"])],
        (("tree1", "eager"), ("tree4", "eager"), ("quadrotor_base", "eager")),
    ),
)
@DYNAMICS
def test_derivatives_of_forces_and_accelerations(name, backend, function):
    c, m = case(name), motion(case(name), batch=1)

    def of_forces(model, data, q, v, a, row):
        pin.computeRNEADerivatives(model, data, q, v, a)
        return [data.dtau_dq, data.dtau_dv, np.triu(data.M) + np.triu(data.M, 1).T]

    def of_accelerations(model, data, q, v, a, row):
        pin.computeABADerivatives(model, data, q, v, c.velocity(row["A_WB_B"], row["tau"]))
        return [data.ddq_dq, data.ddq_dv, np.triu(data.Minv) + np.triu(data.Minv, 1).T]

    def accelerations(X_WB, q, V, qd, moment_and_force, tau):
        return floating.forward_dynamics(
            c.robot, X_WB, q, V, qd, tau, f_base=dq.paper.swap(moment_and_force), backend=backend
        )

    if function == "inverse_dynamics":
        expected, given, tolerance = of_forces, CHANGE, TOLERANCE[F64]
        found = partial(floating.inverse_dynamics, c.robot, backend=backend)
    else:
        expected, given, found = of_accelerations, (*CHANGE[:5], "tau"), accelerations
        tolerance = max(TOLERANCE[F64], rounding(c, m) ** 2 / (64 * EPS[F64]))
    reference = over(expected, c, m)[0][:, c.order][..., c.order]
    for ours, theirs in zip(tangent(found, *(x[0] for x in m.pick(*given).values())), reference, strict=True):
        near(ours, theirs, np.abs(reference).max(), tolerance)


def test_derivatives_of_all_orders_are_those_of_differences():
    c, m = case("tree1"), motion(case("tree1"), batch=1)
    bodies = ("base_mass", "base_com", "base_inertia", "mass", "gravity")
    given = [m[name].clone().requires_grad_() for name in (*TWIST, "tau", "f_base")]
    tensors = [getattr(c.robot, name).clone().requires_grad_() for name in bodies]

    def accelerations(X_WB, q, V, qd, tau, f_base, *fields):
        robot = c.robot.replace(**dict(zip(bodies, fields, strict=True)))
        return generalised(floating.forward_dynamics(robot, X_WB, q, V, qd, tau, f_base=f_base))

    torch.autograd.gradcheck(accelerations, (*given, *tensors), fast_mode=True)
    torch.autograd.gradgradcheck(accelerations, (*given, *tensors), atol=1e-4, fast_mode=True)


@all_in_one(
    thinned(
        [name for name in FUNCTIONS if "dynamics" not in name],
        ("momentum_rate", "jacobian"),
    )
)
def test_the_other_functions_are_differentiable(function):
    c, m = case("tree2"), motion(case("tree2"), batch=1)
    more = {"frame": "b1", "expressed": "world"} if function == "jacobian" else {}

    def f(*x):
        found = getattr(floating, function)(c.robot, *x, **more)
        return found if isinstance(found, torch.Tensor) else found[0]

    given = [x.clone().requires_grad_() for x in m.pick(*FUNCTIONS[function]).values()]
    torch.autograd.gradcheck(f, given, fast_mode=True)
    torch.autograd.gradgradcheck(f, given, fast_mode=True)


# --- ways to call ----------------------------------------------------------------------------------------------------


@eager_first
def test_batches_broadcast(backend):
    c, m = case("tree3"), motion(case("tree3"), batch=12)
    at = {name: x.unflatten(0, (3, 4)) for name, x in m.items()}
    given = at | {"X_WB": at["X_WB"][:, :1], "qd": m["qd"][5], "tau": at["tau"][:1], "f_base": m["f_base"][2]}
    full = {name: x.expand(3, 4, *x.shape[x.ndim - m[name].ndim + 1 :]) for name, x in given.items()}
    for f, names in (
        (floating.forward_dynamics, (*TWIST, "tau", *WRENCHES)),
        (floating.inverse_dynamics, (*CHANGE, "f_ext")),
    ):
        found = generalised(f(c.robot, **{x: given[x] for x in names}, backend=backend))
        rows = [f(c.robot, **{x: full[x][i, j] for x in names}, backend=backend) for i in range(3) for j in range(4)]
        near(found, torch.stack([*map(generalised, rows)]).view(3, 4, -1), found.abs().max().item())


@eager_first
def test_base_bodies_can_differ_from_sample_to_sample(backend):
    c, m = case("tree3"), motion(case("tree3"))
    bodies = [body(pin.Inertia(2.0 + k, np.array([0.1 * k, -0.2, 0.3]), oracles.random_inertia(
        np.random.default_rng(k), 2.0 + k))) for k in range(3)]  # fmt: skip
    batch = c.robot.replace(**{name: torch.stack([x[name] for x in bodies]) for name in bodies[0]})
    for f, names in ((floating.forward_dynamics, (*TWIST, "tau")), (floating.inverse_dynamics, CHANGE)):
        found = generalised(f(batch, **m.pick(*names), backend=backend))
        for k in range(3):
            one = c.robot.replace(**bodies[k])
            solo = generalised(f(one, **{x: m[x][k] for x in names}, backend=backend))
            near(found[k], solo, found.abs().max().item())
            # every body has a program of its own there, which is not compiled
            near(solo, generalised(f(one.bake(), **{x: m[x][k] for x in names}, backend="eager")), 100.0)


@pytest.mark.parametrize(
    ("name", "function"),
    thinned(
        [
            *itertools.product(
                ["tree3", "quadrotor_base"], ["inverse_dynamics", "forward_dynamics", "momentum", "regressor"]
            )
        ],
        [("tree3", "forward_dynamics")],
    ),
)
def test_single_precision_and_compiled_programs(name, function):
    c, m = case(name), motion(case(name))

    def found(dtype, backend):
        y = found_by(function, c, Motion({x: value.to(dtype) for x, value in m.items()}), backend=backend)
        return y if isinstance(y, torch.Tensor) else torch.cat(y, -1)

    expected = found(F64, "eager")
    near(found(F64, "c"), expected, expected.abs().max().item())
    for backend in ("eager", "c"):
        single = found(F32, backend)
        assert single.dtype == F32
        near(single, expected, expected.abs().max().item(), EPS[F32] / EPS[F64] * rounding(c, m))


def test_functional_transforms():
    c, m = case("tree1"), motion(case("tree1"))
    given = tuple(m.pick(*TWIST, "tau").values())

    def accelerations(*x):
        return generalised(floating.forward_dynamics(c.robot, *x))

    expected = accelerations(*given)
    near(torch.func.vmap(accelerations)(*given), expected, 100.0)
    J = torch.func.vmap(torch.func.jacrev(accelerations, argnums=(0, 2)))(*given)
    rows = [torch.autograd.functional.jacobian(accelerations, tuple(x[k] for x in given)) for k in range(3)]
    for ours, argument in zip(J, (0, 2), strict=True):
        near(ours, torch.stack([row[argument] for row in rows]), ours.abs().max().item())
    forward = torch.func.vmap(torch.func.jacfwd(accelerations, argnums=(0, 2)))(*given)
    near(forward[0], J[0], J[0].abs().max().item())


def test_a_traced_graph():
    c, m = case("tree3"), motion(case("tree3"))
    given = [x.clone().requires_grad_() for x in m.pick(*TWIST, "tau").values()]

    def loss(*x):
        return generalised(floating.forward_dynamics(c.robot, *x, backend="auto")).square().sum()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    near(compiled(*given), loss(*given), 1e4)
    for a, b in zip(
        torch.autograd.grad(compiled(*given), given), torch.autograd.grad(loss(*given), given), strict=True
    ):
        near(a, b, b.abs().max().item(), 1e-11)


# --- hard cases ------------------------------------------------------------------------------------------------------


def turned(m: Motion, rotation, position=(0.0, 0.0, 0.0)) -> Motion:
    r, p = (torch.tensor(x, dtype=F64) for x in (rotation, position))
    return Motion({**m, "X_WB": dq.from_pose(dq.normalize(r), p).expand(len(m["q"]), 8)})


ROTATIONS = [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (0, 1, 1, 0), (0, 1, -2, 3), (1e-9, 1, 0, 0),
             (1, 1e-9, 0, 0), (1, 1, 0, 0), (1, 0, -1, 0), (-1, 0, 0, 0)]  # fmt: skip


@all_in_one([*(("tree1", x) for x in ROTATIONS), *(("solo12", x) for x in thinned(ROTATIONS, ()))])
def test_no_orientation_is_special(of_what):
    name, rotation = of_what
    c = case(name)
    m = turned(motion(c), [float(x) for x in rotation])
    near(generalised(found_by("inverse_dynamics", c, m)), forces_of(c, m), size_of(c, m))
    U = over(lambda model, data, q, v, a, row: pin.computePotentialEnergy(model, data, q), c, m)
    near(floating.potential_energy(c.robot, **m.pick(*PLACE)), U, np.abs(U).max() + 300)
    found = tangent(lambda *x: floating.inverse_dynamics(c.robot, *x), *(m[x][0] for x in CHANGE))[0]
    assert found.isfinite().all()


def alike(c: FreeFlyer, m: Motion, other: Motion, *functions: str) -> bool:
    """Whether functions find the same for two motions, to the bit."""
    return all(a.equal(b) for f in functions for a, b in zip(found_by(f, c, m), found_by(f, c, other), strict=True))


@SOME
def test_both_signs_of_a_pose_are_the_same_pose(name):
    c, m = case(name), motion(case(name))
    other = Motion({**m, "X_WB": -m["X_WB"]})
    assert alike(c, m, other, *(f for f in FUNCTIONS if f != "forward_kinematics"))
    assert found_by("forward_kinematics", c, m).equal(-found_by("forward_kinematics", c, other))


@SOME
def test_the_distance_from_the_origin_costs_no_digits(name):
    """Forces and accelerations do not depend on the place at all; momentum is about the centre of mass."""
    c, m = case(name), motion(case(name))
    here, far = (
        Motion({**m, "X_WB": dq.from_pose(m["X_WB"][:, :4], torch.full((3, 3), at, dtype=F64))}) for at in (0.0, 1e6)
    )
    assert alike(c, here, far, "inverse_dynamics", "forward_dynamics", "momentum", "momentum_rate")


@all_in_one([*itertools.product(thinned(["tree2", "tree7"], ["tree2"]), thinned([1e-9, 1e-6, 1e6, 1e9], [1e-9, 1e9]))])
def test_light_and_heavy_bases(of_what):
    name, ratio = of_what
    c, m = case(name), motion(case(name))
    inertia = c.model.inertias[1]
    inertia = pin.Inertia(ratio * inertia.mass, inertia.lever, ratio * inertia.inertia)
    model = pin.Model(c.model)
    model.inertias[1] = inertia
    light = FreeFlyer(c.robot.replace(**body(inertia)).bake(), model)
    near(generalised(floating.inverse_dynamics(light.robot, **m.pick(*CHANGE))), forces_of(light, m), size_of(light, m))
    M = mass_matrices(light, m)
    A, qdd = floating.forward_dynamics(light.robot, **m.pick(*TWIST, "tau"))
    force = floating.inverse_dynamics(light.robot, **m.pick(*TWIST), A_WB_B=A, qdd=qdd)
    size = (np.abs(M) @ torch.cat([A, qdd], -1).abs().numpy()[..., None]).max() + size_of(light, m)
    near(force.F_B, torch.zeros(3, 6), size, 256 * EPS[F64])
    near(force.tau, m["tau"], size, 256 * EPS[F64])


@eager_first
def test_a_row_that_is_not_a_number_stays_alone(backend):
    c, m = case("tree3"), motion(case("tree3"))
    expected = generalised(found_by("forward_dynamics", c, m, backend=backend))
    for argument in (*TWIST, "tau"):
        given = copy.deepcopy(m)
        given[argument][1, 0] = torch.nan
        found = generalised(found_by("forward_dynamics", c, given, backend=backend))
        assert found[[0, 2]].equal(expected[[0, 2]])
        assert found[1].isnan().all()


# --- errors ----------------------------------------------------------------------------------------------------------


def fixed(robot):
    """Robot on a fixed base."""
    return robot.replace(base_mass=None, base_com=None, base_inertia=None)


MISUSE = [
    lambda robot, m: torchdq.inverse_dynamics(robot, m["q"]),
    lambda robot, m: floating.mass_matrix(fixed(robot), m["X_WB"], m["q"]),
    lambda robot, m: fixed(robot).replace(base_mass=torch.tensor(1.0)),
    lambda robot, m: robot.replace(base_mass=torch.tensor(-1.0)),
    lambda robot, m: robot.replace(base_inertia=torch.tensor([1.0, 0, 1, 0, 0, -9])),
]


@pytest.mark.parametrize("call", MISUSE)
def test_the_other_kind_of_base_and_a_body_that_cannot_exist_are_refused(call):
    with refused((torchdq.ArgumentError, torchdq.UnphysicalError)):
        call(case("tree3").robot, motion(case("tree3")))


def test_a_body_that_breaks_the_triangle_inequality_is_warned_of():
    with warned(UserWarning):
        case("tree3").robot.replace(base_inertia=torch.tensor([1.0, 0, 1, 0, 0, 9]))


def test_the_tip_of_a_free_robot_may_be_fixed_to_its_base():
    c, m = case("tree3"), motion(case("tree3"))
    robot, f = c.robot.with_tip("base"), m["f_tip"]
    found = generalised(floating.inverse_dynamics(robot, **m.pick(*CHANGE), f_tip=f))
    expected = generalised(floating.inverse_dynamics(robot, **m.pick(*CHANGE), f_base=-f))
    near(found, expected, expected.abs().max().item())


def test_a_fixed_robot_is_freed_by_the_body_of_its_base():
    """Given to `replace`, which makes arguments of the programs, or baked into constants."""
    c, m = case("tree3"), motion(case("tree3"))
    robot = fixed(c.robot)
    assert not robot.floating and torchdq.inverse_dynamics(robot, m["q"]).shape == (3, 3)
    freed = robot.replace(**body(c.model.inertias[1]))
    expected = generalised(floating.inverse_dynamics(c.robot, **m.pick(*CHANGE)))
    for robot in (freed, freed.bake(), torchdq.Robot.stack([freed, freed])):
        given = {name: x[:, None] if robot.mass.ndim > 1 else x for name, x in m.pick(*CHANGE).items()}
        found = generalised(floating.inverse_dynamics(robot, **given))
        near(found, expected[:, None].expand_as(found) if found.ndim > 2 else expected, 100.0)
