"""Masses at points add their Jacobians' J^T C J to the mass matrix, in every form; Pinocchio's Jacobians are theirs."""

import numpy as np
import pinocchio as pin
import pytest
import torch
from free_flyers import B, case, motion, over
from oracles import EPS, stack

from torchdq.dynamics.coupling import Coupled, Coupling
from torchdq.dynamics.point_mass import PointMass
from torchdq.dynamics.posed import Posed
from torchdq.functions import posed

F64 = torch.float64
FORMS = pytest.mark.parametrize("form", ["general", "aligned", "grouped"])
TREES = pytest.mark.parametrize("robot", ["tree1", "tree4", "tree7", "tree12"])


def at(name: str, form: str) -> Posed:
    m, robot = motion(case(name)), case(name).robot
    q, X_WB = m["q"].unbind(-1), (m["X_WB"][:, :4].unbind(-1), m["X_WB"][:, 4:].unbind(-1))
    return (
        posed.general(robot, q, {}, X_WB) if form == "general" else posed.aligned(robot, q, {}, form == "grouped", X_WB)
    )


def points(name: str) -> list[tuple[int, np.ndarray, float, np.ndarray, float, float]]:
    """Link from 0, the base, on, point in the link's own frame, m, n, e and spin of several masses, two on one link."""
    rng = np.random.default_rng([7, len(name), case(name).robot.n])
    links = [0, case(name).robot.n, *rng.integers(0, case(name).robot.n + 1, 2)]
    links.append(links[1])
    found = []
    for i in links:
        n, m = rng.normal(size=3), rng.uniform(0.1, 2.0)
        found.append(
            (int(i), rng.normal(size=3), m, n / np.linalg.norm(n), rng.uniform(-m, 3.0), rng.uniform(0.0, 1.0))
        )
    return found


def masses(name: str, robot: Posed) -> list[PointMass]:
    """Masses of `points` in the frames of a form; normals are given in the axes of the link."""
    found = []
    for i, p, m, n, e, spin in points(name):
        place = robot.point(i, ((1.0, 0.0, 0.0, 0.0), (0.0, *(0.5 * p))))
        normal = tuple(sum(axis[k] * x for axis, x in zip(place.axes, n, strict=True)) for k in range(3))
        found.append(PointMass(i, place.position, m, normal, e, spin))
    return found


def expected(name: str) -> np.ndarray:
    """M + J^T C J [B, 6 + n, 6 + n], in Pinocchio's order."""
    c = case(name)

    def one(model, data, q, v, a, _):
        M = np.array(pin.crba(model, data, q))
        M = np.triu(M) + np.triu(M, 1).T
        pin.computeJointJacobians(model, data, q)
        for i, p, m, n, e, spin in points(name):
            if i:
                frame = c.frame_id(c.robot.link_names[i - 1])
                J = pin.computeFrameJacobian(model, data, q, frame, pin.ReferenceFrame.LOCAL)
            else:
                J = pin.getJointJacobian(model, data, c.root, pin.ReferenceFrame.LOCAL)
            velocity = J[:3] - pin.skew(p) @ J[3:]
            M += velocity.T @ (m * np.eye(3) + e * np.outer(n, n)) @ velocity + spin * J[3:].T @ J[3:]
        return M

    return over(one, c, motion(c))[:, c.order][:, :, c.order]


@FORMS
@TREES
def test_masses_at_points_add_their_jacobians_to_the_mass_matrix(robot, form):
    there, wanted = at(robot, form), expected(robot)
    M = stack(there.with_masses(masses(robot, there)).mass_matrix(), (B,)).numpy()
    assert abs(M - wanted).max() <= 64 * EPS[F64] * abs(wanted).max()


@FORMS
@TREES
def test_entries_and_articulated_bodies_solve_with_them(robot, form):
    there, wanted = at(robot, form), expected(robot)
    b = torch.randn(B, wanted.shape[-1], dtype=F64, generator=torch.Generator().manual_seed(3))
    heavy = there.with_masses(masses(robot, there))
    solution = np.linalg.solve(wanted, b.numpy()[..., None])[..., 0]
    bound = 64 * EPS[F64] * np.linalg.cond(wanted) * np.linalg.norm(solution, axis=-1)
    for linear in (False, True):
        found = stack(heavy.factors(linear).solve(b.unbind(-1)), (B,)).numpy()
        assert (np.linalg.norm(found - solution, axis=-1) <= bound).all()


@pytest.mark.parametrize("form", ["aligned", "grouped"])
@TREES
def test_rounding_errors_are_not_guessed_too_low(robot, form):
    there = at(robot, form)
    heavy = there.with_masses(masses(robot, there))
    by_entries, by_bodies = (stack(heavy.factors(linear).diagonal, (B,)) for linear in (False, True))
    assert (by_bodies >= by_entries * (1 - 64 * EPS[F64])).all()


def test_a_map_of_joints_carries_masses_to_its_coordinates():
    there = at("tree4", "aligned")
    S = np.random.default_rng(5).normal(size=(10, 3))
    coupled = Coupled(there, Coupling(tuple(map(tuple, S.tolist()))))
    M = stack(coupled.with_masses(masses("tree4", there)).mass_matrix(), (B,)).numpy()
    wanted = S.T @ expected("tree4") @ S
    assert abs(M - wanted).max() <= 256 * EPS[F64] * abs(wanted).max()
