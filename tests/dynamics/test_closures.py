"""Closed loops: gaps and their motion are those of the frames; accelerations solve the equations with multipliers."""

from functools import partial

import numpy as np
import oracles
import pytest
import torch
from robots import EPS, states

import torchdq
from torchdq import dq
from torchdq.dynamics import closures
from torchdq.dynamics.posed import factors_by_entries
from torchdq.functions import posed

F64 = torch.float64
SIZES = {"point": 3, "hinge": 5, "weld": 6}
KINDS = pytest.mark.parametrize("kind", SIZES)


def ends(robot):
    """Two frames of different links, with poses there."""
    g = torch.Generator().manual_seed(7)
    r = torch.nn.functional.normalize(torch.randn(2, 4, dtype=F64, generator=g), dim=-1)
    X = dq.from_pose(r, torch.randn(2, 3, dtype=F64, generator=g))
    return [(2, X[0]), (robot.n, X[1])]


def of_loop(robot):
    """Joints that move one of the two frames and not the other."""
    paths = []
    for link, _ in ends(robot):
        i, path = link - 1, set()
        while i >= 0:
            path.add(i)
            i = robot.parents[i]
        paths.append(path)
    return paths[0] ^ paths[1]


def numbers(X):
    return tuple(X[:4].tolist()), tuple(X[4:].tolist())


def gap(robot, q, kind):
    """Gap by the poses of the links, [B, rows]."""
    poses = torchdq.forward_kinematics(robot, q, list(robot.link_names))
    X_A, X_B = (dq.mul(poses[:, i - 1], X) for i, X in ends(robot))
    d = dq.translation(X_B) - dq.translation(X_A)
    R = dq.to_matrix(dq.mul(dq.conj(X_A), X_B))[:, :3, :3]
    if kind == "point":
        return d
    if kind == "hinge":
        return torch.cat([d, R[:, :2, 2]], -1)
    skew = (R - R.mT) / 2
    return torch.cat([d, torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)], -1)


@KINDS
@pytest.mark.parametrize("form", ["general", "aligned"])
@pytest.mark.parametrize("name", ["tree5", "tree8"])
def test_gaps_and_their_motion_are_those_of_the_frames(name, form, kind):
    robot = oracles.case(name).robot
    n = robot.n
    q, qd, _ = states(n, rows=2, seed=n)
    moving = of_loop(robot)
    v = qd * torch.tensor([float(k in moving) for k in range(n)])
    t = torch.zeros(2, dtype=F64, requires_grad=True)
    whole = gap(robot, q + t[:, None] * v, kind)
    rate = torch.stack([torch.autograd.grad(x.sum(), t, create_graph=True)[0] for x in whole.unbind(-1)], -1)
    bend = torch.stack([torch.autograd.grad(x.sum(), t, retain_graph=True)[0] for x in rate.unbind(-1)], -1)
    for k in range(2):
        at = posed.general if form == "general" else partial(posed.aligned, group=False)
        frames = tuple((i, numbers(X)) for i, X in ends(robot))
        found = closures.gap(at(robot, q[k].tolist(), {}), kind, frames, moving, qd[k].tolist())
        assert found.columns.keys() == moving
        for one, other in ((found.values, whole), (found.rate, rate), (found.gamma, bend)):
            assert torch.allclose(
                torch.tensor(one, dtype=F64), other[k].detach(), 0, 1e4 * EPS * float(v[k].square().sum())
            )


@KINDS
def test_accelerations_are_those_of_the_equations_with_multipliers(kind):
    """(M -J^T; J 0) (a; lambda) = (b; c), by the factors of M alone; a row that others imply is left out."""
    rng = np.random.default_rng(3)
    n, m = 9, SIZES[kind]
    root = rng.normal(size=(n, n))
    M, J, b = root @ root.T + np.eye(n), rng.normal(size=(m + 1, n)), rng.normal(size=n)
    J[m] = J[:m].sum(0)
    c = J @ rng.normal(size=n)
    c[0] += 1e-6  # as by rounding in float32, which no motion has
    whole = np.block([[M, -J[1:].T], [J[1:], np.zeros((m, m))]])
    expected = np.linalg.solve(whole, np.concatenate([b, c[1:]]))[:n]
    factors = factors_by_entries(range(-1, n - 1), M.tolist())
    columns = {k: J[:, k].tolist() for k in range(n)}
    found = closures.solve(factors, b.tolist(), [closures.Held(columns, c.tolist())])
    assert np.abs(np.array(found) - expected).max() < 1e3 * EPS * np.linalg.cond(M) * np.abs(expected).max()
