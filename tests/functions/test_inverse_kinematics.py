"""Inverse kinematics: solutions against Pinocchio, closest points against SciPy, limits, rows, gradients."""

import math

import oracles
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one, double, random, thinned
from messages import refused
from scipy.optimize import minimize

import torchdq
from torchdq import ArgumentError, dq
from torchdq.robot.description import Limits

F64, BACKEND = torch.float64, "auto"
ARM, UR, TWO = (torchdq.robots.load(name) for name in ("panda", "ur10e", "two_link"))
FIVE = ARM.lock({ARM.joint_names[2]: 0.3, ARM.joint_names[6]: 0.1}).bake()
AXIS = ("rx", "ry", "x", "y", "z")  # the frame may turn about its z axis


@pytest.fixture
def by_torch():
    """Torch operations, for tests of few rows, which compile nothing."""
    with torchdq.backend("eager"):
        yield


def bounds(robot):
    """Limits, a turn where there are none."""
    lower, upper = robot.limits.lower, robot.limits.upper
    return lower.clamp(min=-math.pi), upper.clamp(max=math.pi)


def within(robot, count, seed=0):
    """Positions that fill the limits at random."""
    lower, upper = bounds(robot)
    return lower + (upper - lower) * torch.rand(
        count, robot.n, dtype=F64, generator=torch.Generator().manual_seed(seed)
    )


def poses(robot, q, frame=None):
    return torchdq.forward_kinematics(robot, q, frame or robot.tip)


def left(robot, q, X, frame=None):
    """Rotation vector and displacement to poses, in axes of the frame, [..., 6]."""
    there = poses(robot, q, frame)
    displacement = dq.translation(dq.mul(dq.conj(there), X))
    turn = 2 * dq.log_shortest(dq.mul(dq.conj(there), X))[..., :3]
    return torch.cat([turn, displacement], -1)


# --- solutions -------------------------------------------------------------------------------------------------------


@all_in_one(["shipped-panda", "shipped-ur10e"])
def test_random_poses_are_reached_within_the_limits_as_pinocchio_sees_them(name):
    case = oracles.case(name)
    robot, count = case.robot, 4000
    X = poses(robot, within(robot, count), robot.link_names[-1])
    found = torchdq.inverse_kinematics(robot, X, robot.link_names[-1], start=within(robot, count, seed=1))
    assert found.converged.double().mean() >= 0.9995 and found.error[found.converged].max() <= 1e-8
    assert ((found.q >= robot.limits.lower) & (found.q <= robot.limits.upper)).all()
    assert found.starts.double().mean() < 2.6  # more where joints at limits are not held
    data, index = case.model.createData(), case.frame_id(robot.link_names[-1])
    for q, matrix in zip(found.q[found.converged][:200], dq.to_matrix(X[found.converged][:200]), strict=True):
        pin.framesForwardKinematics(case.model, data, case.configuration(q.numpy()))
        off = data.oMf[index].inverse() * pin.SE3(matrix.numpy())
        assert pin.log6(off).vector.__abs__().max() <= 1e-8 + 1e-13


def sliding():
    """Arm of four turning joints without limits, of which one follows another, and two that slide."""
    full = oracles.random_tree(6, 3).robot
    return full.couple({"j4": {"j3": 0.5}}).bake()


SOME = {
    "position of seven joints": (ARM, "position"),
    "orientation of seven joints": (ARM, "orientation"),
    "five joints that may turn about an axis": (FIVE, AXIS),
    "two displacements of seven joints": (ARM, ("x", "y", "rz")),
    "joints that follow, slide, and have no limits": (sliding(), ("x", "y")),
    "two joints": (TWO, ("x", "y")),
}


@pytest.mark.usefixtures("by_torch")
@pytest.mark.parametrize(
    ("name", "expressed"),
    thinned(
        [(x, y) for x in SOME for y in ("body", "world")],
        [*((x, "world") for x in SOME if "seven" not in x), ("orientation of seven joints", "body")],
    ),
)
def test_the_axes_that_count_are_served(name, expressed):
    robot, axes = SOME[name]
    X = poses(robot, within(robot, 20, seed=2))
    found = torchdq.inverse_kinematics(robot, X, expressed=expressed, axes=axes)
    off = left(robot, found.q, X)
    if expressed == "world":
        turn = poses(robot, found.q)[:, None, :4]
        off = dq.rotate(turn, off.unflatten(-1, (2, 3))).flatten(-2)
    names = {"position": (3, 4, 5), "orientation": (0, 1, 2)}
    rows = names[axes] if isinstance(axes, str) else [("rx", "ry", "rz", "x", "y", "z").index(a) for a in axes]
    assert found.converged.double().mean() >= 0.99
    assert off[..., rows][found.converged].abs().max() <= 1e-8 + 1e-14
    assert ((found.q >= robot.limits.lower) & (found.q <= robot.limits.upper)).all()


def test_goals_at_limits_at_singular_postures_and_half_a_turn_away_are_reached():
    lower, upper = bounds(ARM)
    middle = (lower + upper) / 2
    corner = torch.where(torch.arange(7) % 2 == 0, lower, upper)
    elbow = middle.clone()
    elbow[3] = upper[3]
    X = poses(ARM, torch.stack([lower, upper, corner, elbow, middle]))
    X = torch.cat([X, dq.mul(X[-1], dq.from_pose(double(0, 0, 0, 1), double(0, 0, 0)))[None]])  # half a turn about z
    found = torchdq.inverse_kinematics(ARM, X, start=middle, starts=1000)
    assert found.converged.all() and left(ARM, found.q, X).abs().max() <= 1e-8 + 1e-14
    assert found.starts[4] == 1 and torch.equal(found.q[4], middle)  # a solution is its own
    again = torchdq.inverse_kinematics(ARM, -3 * X, start=middle, starts=1000)
    assert again.converged.all()  # the same poses


def closest(robot, X, axes, starts):
    """Smallest norm of an error that a minimiser of SciPy finds from some starts within the limits."""
    rows = slice(3, 6) if axes == "position" else slice(0, 6)

    def squared(x):
        q = torch.tensor(x, requires_grad=True)
        e = left(robot, q, X)[rows].square().sum()
        return e.item(), torch.autograd.grad(e, q)[0].numpy()

    limits, stop = list(zip(*[x.tolist() for x in bounds(robot)], strict=True)), {"ftol": 1e-14, "gtol": 1e-9}
    return math.sqrt(min(minimize(squared, x, jac=True, bounds=limits, options=stop).fun for x in starts.numpy()))


@pytest.mark.parametrize("axes", thinned(["position", "pose"], ("pose",)))
def test_goals_beyond_reach_leave_the_closest_point(axes):
    robot = ARM
    far = double(2.0, 0.0, 0.5, 0.5, 0.0, 2.0, -1.5, 0.3, 0.2).view(3, 3)
    X = dq.from_pose(double(0.5, 0.5, -0.5, 0.5).expand(3, 4), far)
    found = torchdq.inverse_kinematics(robot, X, axes=axes)
    assert not found.converged.any() and found.starts.eq(128).all()
    off = left(robot, found.q, X).view(3, 2, 3).norm(dim=-1)
    torch.testing.assert_close(found.error[:, 1], off[:, 1], rtol=1e-12, atol=0)  # of this q, and not of the last
    assert ((found.q >= robot.limits.lower) & (found.q <= robot.limits.upper)).all()
    for k in range(3):
        starts = torch.cat([found.q[k : k + 1], within(robot, 1, seed=k)])
        assert found.error[k].norm() <= closest(robot, X[k], axes, starts) + 1e-6


def test_goals_beyond_reach_of_two_joints_are_faced():
    reach = double(2 + 1e-3, 12, 2 - 1e-3)
    X = dq.from_pose(double(1, 0, 0, 0).expand(3, 4), torch.stack([reach, 0 * reach, 0 * reach], -1))
    found = torchdq.inverse_kinematics(TWO, X, start=double(0.4, -0.3), axes=("x", "y"))
    assert found.converged.tolist() == [False, False, True] and found.starts.tolist()[:2] == [128, 128]
    torch.testing.assert_close(found.error[:, 1], double(1e-3, 10, 0), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("dtype", "size"), thinned([(F64, 1e200), (F64, 1e9), (torch.float32, 1e30)], [(F64, 1e200), (torch.float32, 1e30)])
)
def test_goals_at_any_distance_turn_the_arm_towards_them_and_leave_other_rows_alone(dtype, size):
    toward = double(0.6, 0.0, 0.8).to(dtype)
    near = poses(ARM, within(ARM, 1)).to(dtype)
    far = dq.from_pose(double(1, 0, 0, 0).to(dtype), size * toward)
    found = torchdq.inverse_kinematics(ARM, torch.stack([far, near[0], far * math.nan]), axes="position")
    assert found.converged.tolist() == [False, True, False]
    assert found.q.isnan().any(-1).tolist() == [False, False, True]
    reached = dq.translation(poses(ARM, found.q[0])) @ toward
    best = torchdq.inverse_kinematics(ARM, dq.from_pose(double(1, 0, 0, 0), 100 * toward.double()), axes="position")
    assert reached > dq.translation(poses(ARM, best.q)) @ toward.double() - 0.05
    assert abs(found.error[0, 1] / size - 1) < 2e-3
    alone = torchdq.inverse_kinematics(ARM, near, axes="position")
    assert torch.equal(alone.q[0], found.q[1])


def test_a_compiled_function_calls_it_between_its_graphs():
    torch._dynamo.reset()

    def twice(X):
        return 2 * torchdq.inverse_kinematics(TWO, 1.0 * X, axes=("x", "y")).q

    X = poses(TWO, within(TWO, 3)).requires_grad_()
    expected, found = twice(X), torch.compile(twice, backend="eager")(X)
    assert torch.equal(found, expected)
    assert torch.equal(*[torch.autograd.grad(q.sum(), X)[0] for q in (found, expected)])


def test_single_precision_converges_to_its_own_tolerance():
    X = poses(UR, within(UR, 200)).float()
    found = torchdq.inverse_kinematics(UR, X)
    assert found.q.dtype == torch.float32 and found.converged.all()
    assert left(UR, found.q.double(), X.double()).abs().max() <= 1.2e-5


# --- rows ------------------------------------------------------------------------------------------------------------


def test_a_row_is_the_same_in_every_batch():
    X, start = poses(ARM, within(ARM, 3000)), within(ARM, 3000, seed=1)
    X[7], start[11] = math.nan, math.nan
    every = torchdq.inverse_kinematics(ARM, X, start=start)
    for some in (slice(5, 12), slice(2990, 3000), slice(1000, 1001)):
        few = torchdq.inverse_kinematics(ARM, X[some], start=start[some])
        for a, b in zip(few, every, strict=True):
            assert torch.equal(a.nan_to_num(), b[some].nan_to_num())
    assert not every.converged[7] and every.error[7].isinf().all() and every.starts[7] == 128
    assert every.q[7].isnan().all() and every.q.isnan().any(-1).sum() == 1
    assert every.converged[11] and every.starts[11] > 1
    alone = torchdq.inverse_kinematics(ARM, X[42], start=start[42])
    assert torch.equal(alone.q, every.q[42]) and alone.converged.shape == ()
    assert torchdq.inverse_kinematics(ARM, X[:0]).q.shape == (0, 7)


# --- gradients -------------------------------------------------------------------------------------------------------


FLAT = ("rx", "ry", "rz", "x", "y")  # anywhere along its z axis


@pytest.mark.usefixtures("by_torch")
@pytest.mark.parametrize("axes", thinned(["pose", AXIS, FLAT], [FLAT]), ids=len)
def test_gradients_are_those_of_the_solution(axes):
    robot = FIVE if axes == AXIS else ARM
    q = torch.stack([0.6 * x + 0.4 * sum(bounds(robot)) / 2 for x in within(robot, 2, seed=5)])
    X, twist = poses(robot, q), random(6, seed=3)
    if axes != "pose":  # what is left out does not vanish at the solution
        X = dq.mul(X, dq.exp(double(0, 0, 0.4, 0, 0, 0) if axes == AXIS else double(0, 0, 0, 0, 0, 0.1)))
    start = torchdq.inverse_kinematics(robot, X, start=q, axes=axes, tolerance=1e-12).q

    def solved(s, tolerance=1e-12):
        return torchdq.inverse_kinematics(
            robot, dq.mul(X, dq.exp(0.5 * s * twist)), start=start, axes=axes, tolerance=tolerance
        )

    s, h = double(0)[0].requires_grad_(), 1e-5
    slope = torch.func.jacfwd(lambda s: solved(s).q)(s.detach())
    difference = (solved(h).q - solved(-h).q) / (2 * h)
    torch.testing.assert_close(slope, difference, rtol=1e-6, atol=1e-6)
    weight = random(*slope.shape, seed=4)
    torch.testing.assert_close(torch.autograd.grad((weight * solved(s).q).sum(), s)[0], (weight * slope).sum())


@pytest.mark.usefixtures("by_torch")
def test_gradients_reach_the_robot_and_vanish_where_there_is_no_solution():
    q = double(0.3, -0.7)
    lengths = TWO.X_PB_home.clone().requires_grad_()
    X = poses(TWO, q, "tip").repeat(2, 1)
    X[1] = dq.from_pose(double(1, 0, 0, 0), double(9, 0, 0))
    robot = TWO.replace(X_PB_home=lengths)
    found = torchdq.inverse_kinematics(robot, X.requires_grad_(), start=q, axes=("x", "y"), starts=2)
    (slope,) = torch.autograd.grad(found.q[0, 0], lengths, retain_graph=True)
    longer = TWO.X_PB_home.clone()
    longer[1] = dq.from_pose(double(1, 0, 0, 0), dq.translation(longer[1]) * (1 + 1e-6))
    moved = torchdq.inverse_kinematics(
        TWO.replace(X_PB_home=longer), X[0].detach(), start=q, axes=("x", "y"), tolerance=1e-13
    )
    change = (slope * (longer - TWO.X_PB_home)).sum()
    torch.testing.assert_close(change, moved.q[0] - q[0], rtol=1e-4, atol=0)
    assert (change.abs() > 1e-7) and torch.autograd.grad(found.q[1].sum(), X)[0].eq(0).all()


# --- velocities ------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("by_torch")
def test_joint_velocities_keep_the_direction_of_a_twist_and_all_limits():
    q, V, dt = within(ARM, 500), random(500, 6), 0.02
    qd, scale = torchdq.differential_inverse_kinematics(ARM, q, V, dt=dt)
    J = torchdq.jacobian(ARM, q, ARM.tip)
    given = scale > 0
    twist = (J @ qd[..., None])[..., 0]
    torch.testing.assert_close(twist[given], (scale[..., None] * V)[given], rtol=1e-6, atol=1e-9)
    assert given.double().mean() > 0.99 and scale.max() <= 1
    assert (qd.abs() <= ARM.limits.velocity * (1 + 1e-12)).all()
    after = q + dt * qd
    assert ((after >= ARM.limits.lower - 1e-12) & (after <= ARM.limits.upper + 1e-12)).all()
    tight = (qd.abs() / ARM.limits.velocity).amax(-1) > 1 - 1e-9
    tight |= torch.minimum(after - ARM.limits.lower, ARM.limits.upper - after).amin(-1) < 1e-9
    assert (tight | (scale == 1) | ~given).all()  # no smaller than it must be
    free, _ = torchdq.differential_inverse_kinematics(ARM, q, V, limits=False)
    torch.testing.assert_close(free, (torch.linalg.pinv(J) @ V[..., None])[..., 0], rtol=1e-6, atol=1e-6)


@pytest.mark.usefixtures("by_torch")
def test_joints_at_a_limit_leave_the_twist_to_the_others():
    q, V = double(0.3, -0.4, 0.2, -1.8, 0.1, 1.6, 0.4), double(0, 0, 0, 0.1, 0, 0)
    first, _ = torchdq.differential_inverse_kinematics(ARM, q, V)
    i = int(first.abs().argmax())
    lower, upper = ARM.limits.lower.clone(), ARM.limits.upper.clone()
    (upper if first[i] > 0 else lower)[i] = q[i]
    held = ARM.replace(limits=Limits(lower, upper, *ARM.limits[2:])).bake()
    qd, scale = torchdq.differential_inverse_kinematics(held, q, V, dt=0.01)
    assert scale > 0 and qd[i] == 0
    torch.testing.assert_close(torchdq.jacobian(ARM, q, ARM.tip) @ qd, scale * V, rtol=0, atol=1e-12)


@pytest.mark.usefixtures("by_torch")
def test_a_twist_that_the_joints_cannot_give_has_the_scale_zero():
    q = torch.zeros(2, 2, dtype=F64)
    V = torch.stack([double(1, 0), double(0, 1)])  # along the stretched arm, and across it
    qd, scale = torchdq.differential_inverse_kinematics(TWO, q, V, axes=("x", "y"))
    assert scale.tolist() == [0, 1] and (qd[0] == 0).all() and qd[1].abs().max() > 0


# --- misuse ----------------------------------------------------------------------------------------------------------

X = poses(ARM, torch.zeros(7, dtype=F64))
MISUSE = {
    "too many axes": lambda: torchdq.inverse_kinematics(FIVE, X),
    "no axes": lambda: torchdq.inverse_kinematics(ARM, X, axes="everything"),
    "a tolerance of nothing": lambda: torchdq.inverse_kinematics(ARM, X, tolerance=(1e-3, 0.0)),
    "no tolerance": lambda: torchdq.inverse_kinematics(ARM, X, tolerance=0.0),
    "three tolerances": lambda: torchdq.inverse_kinematics(ARM, X, tolerance=(1e-3, 1e-3, 1e-3)),
    "no start": lambda: torchdq.inverse_kinematics(ARM, X, starts=0),
    "matrices": lambda: torchdq.inverse_kinematics(ARM, torch.eye(4, dtype=F64)),
    "a start of another robot": lambda: torchdq.inverse_kinematics(ARM, X, start=torch.zeros(6, dtype=F64)),
    "a mapped pose": lambda: torch.func.vmap(lambda x: torchdq.inverse_kinematics(ARM, x).q)(X[None]),
    "a mapped start": lambda: torch.func.vmap(lambda q: torchdq.inverse_kinematics(ARM, X, start=q).q)(X[None, :7]),
    "axes of nothing": lambda: torchdq.inverse_kinematics(ARM, X, expressed="up"),
    "meta": lambda: torchdq.inverse_kinematics(ARM, X.to("meta")),
    "no time": lambda: torchdq.differential_inverse_kinematics(ARM, X[:7], X[:6], dt=0.0),
    "a velocity as limits": lambda: torchdq.differential_inverse_kinematics(ARM, X[:7], X[:6], limits=2.0),
    "a free base": lambda: torchdq.inverse_kinematics(torchdq.robots.load("go2"), X, "base"),
}


@all_in_one(MISUSE)
def test_what_means_nothing_is_refused_by_name(name):
    with refused(ArgumentError):
        MISUSE[name]()
