"""Linear maps from coordinates to joints: forces, mass matrix, solutions and Jacobians of coupled joints.

References: Pinocchio's mimic joints for gears, virtual work and the energy for any map.
"""

import numpy as np
import pinocchio as pin
import pytest
import torch
from oracles import EPS, random_tree, stack

from torchdq.dynamics.coupling import Coupled, Coupling
from torchdq.functions import posed

B, F64 = 3, torch.float64
GEARS = {2: (0, -1.5, 0.3), 4: (3, 0.5, 0.0)}  # joint: the joint it follows, ratio, offset


def gears(n: int) -> tuple[Coupling, list[int]]:
    """Map of the free joints to all, and the free joints."""
    free = [j for j in range(n) if j not in GEARS]
    rows = []
    for j in range(n):
        leader, ratio, _ = GEARS.get(j, (j, 1.0, 0.0))
        rows.append(tuple(ratio if i == leader else None for i in free))
    return Coupling(tuple(rows)), free


def dense(n: int, k: int, seed: int) -> Coupling:
    """Full map of k coordinates to n joints, such as that of a differential."""
    rng = np.random.default_rng([3, n, k, seed])
    return Coupling(tuple(tuple(map(float, row)) for row in rng.normal(size=(n, k))))


def coupled(robot, coupling: Coupling, z: torch.Tensor, form: str, offset=0.0) -> Coupled:
    q = (stack(coupling.joints(z.unbind(-1)), (B,)) + offset).unbind(-1)
    at = posed.general(robot, q, {}) if form == "general" else posed.aligned(robot, q, {}, group=form == "grouped")
    return Coupled(at, coupling)


FORMS = pytest.mark.parametrize("form", ["general", "aligned", "grouped"])


def coordinates(k: int, seed: int = 0) -> torch.Tensor:
    """Positions, velocities and accelerations [3, B, k]."""
    return torch.randn(3, B, k, dtype=F64, generator=torch.Generator().manual_seed(seed))


@FORMS
def test_geared_joints_are_pinocchios_mimic_joints(form):
    case = random_tree(6, 11)
    robot, coupling, free = case.robot.bake(), *gears(6)
    z, zd, zdd = coordinates(len(free))
    at = coupled(robot, coupling, z, form, torch.tensor([GEARS.get(j, (j, 1.0, 0.0))[2] for j in range(6)], dtype=F64))
    tau, M = stack(at.torques(zd.unbind(-1), zdd.unbind(-1), None), (B,)), stack(at.mass_matrix(), (B,))
    model = case.model
    for follower, (leader, ratio, offset) in GEARS.items():
        ids = (model.getJointId(robot.joint_names[j]) for j in (leader, follower))
        model = pin.transformJointIntoMimic(model, *ids, ratio, offset)
    data = model.createData()
    joints = [model.joints[model.getJointId(robot.joint_names[j])] for j in free]
    order = [joint.idx_v for joint in joints]
    for k in range(B):
        q = np.zeros(model.nq)
        for joint, x in zip(joints, z[k].tolist(), strict=True):
            q[joint.idx_q : joint.idx_q + joint.nq] = [x] if joint.nq == 1 else [np.cos(x), np.sin(x)]
        v, a = np.zeros((2, model.nv))
        v[order], a[order] = zd[k].numpy(), zdd[k].numpy()
        expected = pin.rnea(model, data, q, v, a)[order]
        assert abs(tau[k].numpy() - expected).max() <= 1e-12 * abs(expected).max()
        # by its columns: Pinocchio's own composite bodies leave out what mimic joints add beside the diagonal
        rest = pin.rnea(model, data, q, 0 * v, 0 * a)[order]
        unit = np.eye(model.nv)
        expected = np.stack([pin.rnea(model, data, q, 0 * v, unit[i])[order] - rest for i in order], -1)
        assert abs(M[k].numpy() - expected).max() <= 1e-11 * abs(expected).max()


@pytest.mark.parametrize("seed", range(3))
@FORMS
def test_power_is_that_of_the_joints_and_energy_that_of_the_mass_matrix(form, seed):
    case = random_tree(5, seed, armature=bool(seed % 2))
    robot, coupling = case.robot.bake(), dense(5, 3, seed)
    z, zd, zdd = coordinates(3, seed)
    at = coupled(robot, coupling, z, form)
    tau = stack(at.torques(zd.unbind(-1), zdd.unbind(-1), None), (B,))
    qd, qdd = (stack(coupling.joints(x.unbind(-1)), (B,)) for x in (zd, zdd))
    joints = stack(at.robot.torques(qd.unbind(-1), qdd.unbind(-1), None), (B,))
    power, size = (joints * qd).sum(-1), (joints * qd).abs().sum(-1)
    assert ((tau * zd).sum(-1) - power).abs().max() <= 64 * EPS[F64] * size.max()
    M = stack(at.mass_matrix(), (B,))
    energy = stack(at.kinetic_energy(zd.unbind(-1)), (B,))
    assert (energy - 0.5 * (zd[:, None] @ M @ zd[..., None])[:, 0, 0]).abs().max() <= 256 * EPS[F64] * energy.max()
    J = at.jacobian(5, ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)), True)
    J = stack([[0.0] * 6 if c is None else [*c[0], *c[1]] for c in J], (B,))
    w, v = at.twists(zd.unbind(-1))[5]
    origin = at.point(5, ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))).position
    linear = torch.linalg.cross(stack(w, (B,)), stack(origin, (B,))) + stack(v, (B,))
    twist = [stack(at.to_world(5, x), (B,)) for x in (w, linear.unbind(-1))]
    found = (J.mT @ zd[..., None])[..., 0]
    assert (found - torch.cat(twist, -1)).abs().max() <= 256 * EPS[F64] * found.abs().max()


@pytest.mark.parametrize("linear", [False, True])
@FORMS
def test_accelerations_undo_forces(form, linear):
    robot, coupling = random_tree(6, 11, armature=True).robot.bake(), gears(6)[0]
    z, _, zdd = coordinates(4)
    bare = coupled(robot, coupling, z, form)
    at = bare.with_armature([0.1, 0.2, 0.3, 0.4]).with_armature([0.1] * 4)
    M = stack(at.mass_matrix(), (B,))
    rotors = torch.tensor([0.2, 0.3, 0.4, 0.5], dtype=F64).diag()
    assert (M - stack(bare.mass_matrix(), (B,)) - rotors).abs().max() <= 4 * EPS[F64] * M.abs().max()
    forces = at.without_gravity().torques(None, zdd.unbind(-1), None)
    assert (stack(forces, (B,)) - (M @ zdd[..., None])[..., 0]).abs().max() <= 256 * EPS[F64] * M.abs().max() * 10
    energy = stack(at.kinetic_energy(zdd.unbind(-1)), (B,))
    assert (energy - 0.5 * (zdd[:, None] @ M @ zdd[..., None])[:, 0, 0]).abs().max() <= 256 * EPS[F64] * energy.max()
    found = stack(at.factors(linear).solve(forces), (B,))
    assert (found - zdd).abs().max() <= 64 * EPS[F64] * np.linalg.cond(M.numpy()).max() * zdd.abs().max()


@FORMS
def test_forces_are_linear_in_the_inertial_parameters(form):
    robot, coupling = random_tree(5, 7).robot.bake(), dense(5, 3, 0)
    z, zd, zdd = coordinates(3)
    at = coupled(robot, coupling, z, form)
    Y = at.regressor(zd.unbind(-1), zdd.unbind(-1))
    Y = stack([[x for block in row for x in (block or (0.0,) * 10)] for row in Y], (B,))
    tau = stack(at.torques(zd.unbind(-1), zdd.unbind(-1), None), (B,))
    assert (Y @ robot.inertial_parameters - tau).abs().max() <= 1e-12 * tau.abs().max()


def test_a_point_does_not_move_with_the_map_but_with_its_joints():
    robot, coupling = random_tree(5, 7).robot.bake(), dense(5, 3, 0)
    z = coordinates(3)[0]
    at, q = coupled(robot, coupling, z, "aligned"), coupling.joints(z.unbind(-1))
    alone = posed.aligned(robot, q, {}, group=False)
    r = (0.1, 0.2, 0.3)
    assert torch.equal(stack(at.position(5, r), (B,)), stack(alone.position(5, r), (B,)))
    assert torch.equal(stack(at.potential_energy(), (B,)), stack(alone.potential_energy(), (B,)))
