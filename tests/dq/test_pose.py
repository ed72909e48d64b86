"""`Pose` satisfies the axioms of a group with an exponential map, agrees with Pinocchio, and is taken as a tensor."""

import math

import pinocchio as pin
import pytest
import torch
from helpers import random
from messages import refused
from torch.autograd import gradcheck
from torch.func import jacfwd, jacrev, vmap

import torchdq
from torchdq import floating
from torchdq.dq import Pose
from torchdq.errors import ArgumentError, DtypeError

F64 = torch.float64
EPS = 2.0**-52
ARM = torchdq.robots.load("panda")


def motions(*batch, seed=0, longest=3.0):
    """Motions (angular, linear) [..., 6] that turn by up to `longest` rad."""
    axis = torch.nn.functional.normalize(random(*batch, 3, seed=seed), dim=-1)
    angle = longest * torch.rand(*batch, 1, dtype=F64, generator=torch.Generator().manual_seed(seed))
    return torch.cat([axis * angle, random(*batch, 3, seed=seed + 1)], -1)


def poses(*batch, seed=0):
    return Pose.exp(motions(*batch, seed=seed))


def near(found, expected, tolerance=64):
    """Same tensors to rounding, or same poses whatever their signs."""
    if isinstance(found, Pose):
        found, expected = found.as_matrix(), expected.as_matrix()
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance * EPS * max(1.0, float(expected.abs().max())))


def action(xi):
    """Matrix of a motion as an operator on motions, ad xi: the derivative of the adjoint."""
    w, v = (torch.linalg.cross(part[..., None, :].expand(3, 3), torch.eye(3, dtype=F64)).mT for part in xi.split(3))
    return torch.cat([torch.cat([w, torch.zeros(3, 3, dtype=F64)], 1), torch.cat([v, w], 1)])


AXIOMS = {
    "associative": lambda x, y, z, xi, p: ((x @ y) @ z, x @ (y @ z)),
    "identity": lambda x, y, z, xi, p: (Pose.identity(dtype=F64) @ x, x @ Pose.identity((20,), dtype=F64)),
    "inverse": lambda x, y, z, xi, p: (x @ x.inverse(), Pose.identity((20,), F64)),
    "inverse of a product": lambda x, y, z, xi, p: ((x @ y).inverse(), y.inverse() @ x.inverse()),
    "exp of log": lambda x, y, z, xi, p: (Pose.exp(x.log()), x),
    "log of exp": lambda x, y, z, xi, p: (Pose.exp(xi).log(), xi),
    "log of the other sign": lambda x, y, z, xi, p: (Pose(-x.parameters).log(), x.log()),
    "log of the inverse": lambda x, y, z, xi, p: (x.inverse().log(), -x.log()),
    "one-parameter subgroup": lambda x, y, z, xi, p: (Pose.exp(0.3 * xi) @ Pose.exp(0.7 * xi), Pose.exp(xi)),
    "action of a product": lambda x, y, z, xi, p: ((x @ y).apply(p), x.apply(y.apply(p))),
    "action of the matrix": lambda x, y, z, xi, p: (x.apply(p), times(x.as_matrix(), p, 1.0)),
    "adjoint of a product": lambda x, y, z, xi, p: ((x @ y).adjoint(), x.adjoint() @ y.adjoint()),
    "adjoint of the inverse": lambda x, y, z, xi, p: (x.inverse().adjoint(), torch.linalg.inv(x.adjoint())),
    "adjoint is conjugation": lambda x, y, z, xi, p: (
        Pose.exp((x.adjoint() @ xi[..., None])[..., 0]),
        x @ Pose.exp(xi) @ x.inverse(),
    ),
    "adjoint of exp": lambda x, y, z, xi, p: (
        Pose.exp(xi).adjoint(),
        torch.stack([torch.linalg.matrix_exp(action(row)) for row in xi]),
    ),
    "matrix there and back": lambda x, y, z, xi, p: (Pose.from_matrix(x.as_matrix()), x),
    "parts there and back": lambda x, y, z, xi, p: (
        Pose.from_rotation_and_translation(x.rotation(), x.translation()).parameters,
        x.parameters,
    ),
    "origin": lambda x, y, z, xi, p: (x.apply(torch.zeros(3, dtype=F64)), x.translation()),
    "normalize": lambda x, y, z, xi, p: (Pose(3.0 * x.parameters).normalize().parameters, x.parameters),
}


def times(matrix, p, w):
    """First three components of a homogeneous matrix times (p, w)."""
    return (matrix @ torch.nn.functional.pad(p, (0, 1), value=w)[..., None])[..., :3, 0]


@pytest.mark.parametrize("law", AXIOMS)
def test_poses_satisfy_the_axioms(law):
    x, y, z = (poses(20, seed=k) for k in (0, 10, 20))
    near(*AXIOMS[law](x, y, z, motions(20, seed=30), random(20, 3, seed=40)), tolerance=256)


def test_poses_are_those_of_pinocchio():
    """With the linear part of a motion first there, and last here."""
    x, y, xi = poses(20), poses(20, seed=10), motions(20, seed=20)
    for a, b, motion in zip(x.parameters, y.parameters, xi, strict=True):
        a, b = Pose(a), Pose(b)
        A, B = (pin.SE3(pose.as_matrix().numpy()) for pose in (a, b))
        near((a @ b).as_matrix(), torch.tensor((A * B).homogeneous))
        near(a.inverse().as_matrix(), torch.tensor(A.inverse().homogeneous))
        near((a.inverse() @ b).log().roll(3, -1), torch.tensor(pin.log6(A.actInv(B)).vector), 1024)
        near(Pose.exp(motion).as_matrix(), torch.tensor(pin.exp6(pin.Motion(motion.roll(3, -1).numpy())).homogeneous))
        near(a.adjoint().roll((3, 3), (0, 1)), torch.tensor(A.action))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 2.0, math.pi - 1e-6])
def test_derivatives_of_exp_and_log_invert_each_other_up_to_half_a_turn(angle):
    xi = torch.cat([angle * torch.nn.functional.normalize(random(3), dim=0), random(3, seed=1)])
    near(jacrev(lambda xi: Pose.exp(xi).log())(xi), torch.eye(6, dtype=F64), 1e6)
    near(jacfwd(lambda xi: Pose.exp(xi).log())(xi), torch.eye(6, dtype=F64), 1e6)
    start = Pose.exp(xi)
    assert gradcheck(lambda d: (start @ Pose.exp(d)).log(), torch.zeros(6, dtype=F64, requires_grad=True), atol=1e-5)
    near(jacrev(lambda d: (start.inverse() @ (start @ Pose.exp(d))).log())(0 * xi), torch.eye(6, dtype=F64), 1e4)


def test_the_shortest_motion_is_taken_beyond_half_a_turn():
    xi = torch.tensor([0.0, 0.0, math.pi + 0.1, 0.0, 0.0, 0.0], dtype=F64)
    near(Pose.exp(xi).log(), torch.tensor([0.0, 0.0, 0.1 - math.pi, 0.0, 0.0, 0.0], dtype=F64))


def test_batches_broadcast_and_dtypes_stay():
    x, y = poses(4, 1), poses(3, seed=5)
    assert (x @ y).parameters.shape == (4, 3, 8) and x.apply(random(3, 3)).shape == (4, 3, 3)
    assert Pose.identity((2, 5), torch.float32).log().shape == (2, 5, 6)
    single = Pose(x.parameters.float())
    for found in ((single @ single).log(), single.as_matrix(), single.adjoint(), single.inverse().translation()):
        assert found.dtype == torch.float32


def test_poses_pass_transforms_and_graphs():
    x, y = poses(5), poses(5, seed=5)
    near(vmap(lambda x, y: x.inverse() @ y)(x, y), x.inverse() @ y)
    near(jacrev(lambda x: x.log())(x[0]).parameters, jacrev(lambda x: Pose(x).log())(x.parameters[0]))
    difference = torch.compile(lambda x, y: x.inverse().multiply(y), fullgraph=True, backend="eager")
    near(difference(x, y), x.inverse() @ y)
    with pytest.raises(AttributeError):
        x.parameters = y.parameters


def test_functions_take_a_pose_as_its_tensor():
    q = torch.linspace(-0.5, 0.5, 7, dtype=F64) + torch.tensor([0, 0, 0, -1.5, 0, 1.5, 0.0], dtype=F64)
    goal = Pose(torchdq.forward_kinematics(ARM, q + 0.1, ARM.tip))
    go2 = torchdq.robots.load("go2")
    stand, base = torch.zeros(go2.n, dtype=F64), poses(seed=3)
    calls = [
        lambda X, _: torchdq.operational_space_control(ARM, q, 0 * q, X, kp=100.0, kd=20.0),
        lambda X, _: torchdq.inverse_kinematics(ARM, X).q,
        lambda X, _: ARM.with_tool("tool", X).frame("tool").X_BF,
        lambda X, _: torchdq.dq.translation(X) + torchdq.dq.mul(X, X)[..., :3],
        lambda _, X: floating.potential_energy(go2, X, stand),
        lambda _, X: torchdq.Scene(go2).start(stand, X_WB=X).X_WB,
        lambda _, X: (
            vmap(lambda x: floating.mass_matrix(go2, x, stand)[0])(Pose(X.parameters[None]))
            if isinstance(X, Pose)
            else floating.mass_matrix(go2, X, stand)[0][None]
        ),
    ]
    with torchdq.backend("eager"):
        for k, call in enumerate(calls):
            assert torch.equal(call(goal, base), call(goal.parameters, base.parameters)), k
    with refused(ArgumentError):
        torchdq.inverse_dynamics(ARM, goal)


WRONG = {
    "seven numbers": lambda X: Pose(torch.ones(7, dtype=F64)),
    "a list": lambda X: Pose([1.0] * 8),
    "integers": lambda X: Pose(torch.ones(8, dtype=torch.int64)),
    "four coordinates": lambda X: X.apply(torch.ones(4)),
    "a motion of seven": lambda X: Pose.exp(torch.ones(7)),
    "a translation of four": lambda X: Pose.from_rotation_and_translation(X.rotation(), torch.ones(4)),
    "another dtype": lambda X: X @ X.to(torch.float32),
    "points of another dtype": lambda X: X.apply(torch.ones(3)),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_no_pose_is_refused_by_the_name_it_was_given_as(wrong):
    with refused((ArgumentError, DtypeError)):
        WRONG[wrong](poses())


def test_an_index_is_one_of_the_batch():
    x = poses(8, 8)
    near(x[2, 1:].parameters, x.parameters[2, 1:])
    near(x[..., 5].parameters, x.parameters[:, 5])
    assert len([*x[0]]) == 8 and x.to(torch.float32)[0].log().dtype == torch.float32
