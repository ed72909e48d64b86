"""Free bodies beside a robot: impedances between two bodies add J^T C J of the relative velocity to the mass matrix."""

import numpy as np
import pytest
import torch
from free_flyers import B, case, motion
from oracles import EPS, stack

import torchdq
from torchdq import dq
from torchdq.dynamics.free_bodies import FreeBody, WithFreeBodies
from torchdq.dynamics.point_mass import PointMass
from torchdq.functions import posed

F64 = torch.float64
FORMS = pytest.mark.parametrize("form", ["general", "aligned"])
MASSES, MOMENTS = (0.7, 1.3), ((0.2, 0.3, 0.4), (0.5, 0.1, 0.45))


def poses():
    """Poses of two free bodies [2, B, 8]."""
    g = torch.Generator().manual_seed(3)
    r = torch.nn.functional.normalize(torch.randn(2, B, 4, dtype=F64, generator=g), dim=-1)
    return dq.from_pose(r, torch.randn(2, B, 3, dtype=F64, generator=g))


def scattered(name, form):
    """A floating tree and two free bodies, on which three bodies act, and the numbers of its links."""
    m, robot = motion(case(name)), case(name).robot
    q, X_WB = m["q"].unbind(-1), (m["X_WB"][:, :4].unbind(-1), m["X_WB"][:, 4:].unbind(-1))
    at = posed.general(robot, q, {}, X_WB) if form == "general" else posed.aligned(robot, q, {}, False, X_WB)
    first = len(robot.link_names) + 1
    split = [(tuple(X[:, :4].unbind(-1)), tuple(X[:, 4:].unbind(-1))) for X in poses()]
    free = [FreeBody(X, mass, moments) for X, mass, moments in zip(split, MASSES, MOMENTS, strict=True)]
    pairs = [(first, first - 1), (first, 1), (first, first + 1), (first + 1, 0)]
    return WithFreeBodies.at(at, free, first, None, pairs), pairs


def acting(pairs):
    """Masses at two points of every pair, and of one body against the world."""
    rng = np.random.default_rng(5)
    found = []
    for o, a in [*pairs, (pairs[0][0], None)] * 2:
        n = rng.normal(size=3)
        m = rng.uniform(0.1, 2.0)
        normal = tuple(n / np.linalg.norm(n))
        found.append(PointMass(o, tuple(rng.normal(size=3)), m, normal, rng.uniform(-m, 3.0), 0.0, a))
    return found


def jacobians(name, first):
    """Columns (w, v) of the twist in the world, about its origin, of every body, [B, 6, velocities] by link."""
    m, robot = motion(case(name)), case(name).robot
    n, found = 12 + 6 + robot.n, {}
    for i in range(first):
        frame = next(f.name for f in robot.frames if f.link == -1) if i == 0 else robot.link_names[i - 1]
        X = torchdq.floating.forward_kinematics(robot, m["X_WB"], m["q"], frame)
        J = torchdq.floating.jacobian(robot, m["X_WB"], m["q"], frame, expressed="world")
        whole = torch.zeros(B, 6, n, dtype=F64)
        whole[:, :, 12:] = J
        whole[:, 3:] += torch.linalg.cross(dq.translation(X)[:, :, None].expand(B, 3, n), whole[:, :3], dim=1)
        found[i] = whole
    for k, X in enumerate(poses()):
        R, p = dq.rotation(X), dq.translation(X)
        own = torch.zeros(B, 6, n, dtype=F64)
        own[:, :3, 6 * k : 6 * k + 3] = own[:, 3:, 6 * k + 3 : 6 * k + 6] = torchdq.dq.to_rotation_matrix(R)
        own[:, 3:] += torch.linalg.cross(p[:, :, None].expand(B, 3, n), own[:, :3], dim=1)
        found[first + k] = own
    return found


@FORMS
def test_impedances_between_bodies_add_the_jacobians_of_their_relative_motion(form):
    there, pairs = scattered("tree7", form)
    plain = stack(there.mass_matrix(), (B,))
    M = stack(there.with_masses(acting(pairs)).mass_matrix(), (B,))
    J, wanted = jacobians("tree7", there.first), plain.clone()
    for o, p, m, normal, e, _, a in acting(pairs):
        X = poses()[o - there.first]
        R = torchdq.dq.to_rotation_matrix(dq.rotation(X))
        x = dq.translation(X) + R @ torch.tensor(p, dtype=F64)
        own = J[o] - (0.0 if a is None else J[a])
        velocity = own[:, 3:] + torch.linalg.cross(own[:, :3], x[:, :, None].expand_as(own[:, 3:]), dim=1)
        n_W = R @ torch.tensor(normal, dtype=F64)
        C = m * torch.eye(3, dtype=F64) + e * n_W[:, :, None] * n_W[:, None, :]
        wanted = wanted + velocity.mT @ C @ velocity
    assert (M - wanted).abs().max() <= 256 * EPS[F64] * wanted.abs().max()


@FORMS
def test_the_relative_twist_is_that_of_the_jacobians_and_a_reaction_has_its_power(form):
    there, pairs = scattered("tree7", form)
    J = jacobians("tree7", there.first)
    v = torch.randn(B, J[0].shape[-1], dtype=F64, generator=torch.Generator().manual_seed(4))
    twists = there.twists(v.unbind(-1))
    for o, a in pairs:
        X = poses()[o - there.first]
        R, p = torchdq.dq.to_rotation_matrix(dq.rotation(X)), dq.translation(X)
        V = ((J[o] - J[a]) @ v[:, :, None])[:, :, 0]
        linear = V[:, 3:] + torch.linalg.cross(V[:, :3], p)
        wanted = [(R.mT @ x[..., None])[..., 0] for x in (V[:, :3], linear)]
        found = there.relative((o, a), v.unbind(-1))
        for x, y in zip(found, wanted, strict=True):
            assert (torch.stack(x, -1) - y).abs().max() <= 256 * EPS[F64] * y.abs().max()
        F = ((0.3, -1.0, 0.5), (0.2, 0.7, -0.4))
        reaction = there.reaction((o, a), F)

        def power(F, V):
            return sum(f * x for part, of in zip(F, V[::-1], strict=True) for f, x in zip(part, of, strict=True))

        # of the wrench on the one body less that on the other: that of the relative motion
        assert power(F, twists[o]) - power(reaction, twists[a]) == pytest.approx(power(F, found), rel=1e-12)


def test_free_bodies_move_as_a_robot_of_one_body_does():
    there, _ = scattered("tree1", "aligned")
    xx, yy, zz = MOMENTS[0]
    body = torchdq.Robot.from_urdf(
        f"""<robot name="body"><link name="body"><inertial><mass value="{MASSES[0]}"/>
        <inertia ixx="{xx}" ixy="0" ixz="0" iyy="{yy}" iyz="0" izz="{zz}"/></inertial></link></robot>""",
        base="floating",
    )
    g = torch.Generator().manual_seed(6)
    V, A = (torch.randn(B, 6, dtype=F64, generator=g) for _ in range(2))
    X, none = poses()[0], torch.zeros(B, 0, dtype=F64)
    force, moment = torchdq.floating.inverse_dynamics(body, X, none, V, none, A, none)[0].split(3, -1)
    wanted = torch.cat([moment, force], -1)
    rest = torch.zeros(B, there.robot.tree.nv + 6, dtype=F64)
    rows = [torch.cat([x, rest], -1).unbind(-1) for x in (V, A)]
    with_gravity = there._replace(gravity=(0.0, 0.0, -9.81))
    found = torch.stack([x + 0.0 * V[:, 0] for x in with_gravity.torques(*rows, None)[:6]], -1)
    assert (found - wanted).abs().max() <= 64 * EPS[F64] * wanted.abs().max()
