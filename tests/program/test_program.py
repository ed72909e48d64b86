"""Programs: what is recorded, how much it costs, its derivatives, and the frames and algorithms it is recorded from.

The references are mpmath, torch's own autograd, numpy's solver, and the paper's recursion in the robot's own frames.
"""

import itertools
from functools import partial

import mpmath
import numpy as np
import pytest
import torch
from helpers import all_in_one, eager, thinned
from oracles import (
    EPS,
    Case,
    as_printed,
    dual_quaternion,
    pin,
    pinocchio_model,
    random_inertia,
    se3,
    shipped,
    size_of_torques,
    stack,
    states,
)
from oracles import random_tree as random_case

import torchdq
import torchdq.envs
from torchdq.dynamics.aligned.posed import Aligned
from torchdq.dynamics.tree import BASE
from torchdq.effects import Contact, Drag, Push
from torchdq.functions import mdh, posed
from torchdq.numbers.ops import OPS, Count
from torchdq.program import autodiff as derive
from torchdq.program.program import Argument, Program, record, replay, results

F64 = torch.float64
EPS64 = EPS[F64]

# --- the recorder ----------------------------------------------------------------------------------------------------


def scalar(function, width: int = 2) -> Program:
    """Program of a function of `width` numbers."""
    return record("f", [Argument("x", width)], lambda x: {"y": [function(*x)]})


@pytest.mark.parametrize(
    ("function", "count"),
    [
        (lambda x, y: x * y + y * x, (1, 1, 0, 0)),
        (lambda x, y: (x - y) * (y - x), (1, 1, 0, 0)),
        (lambda x, y: (x + y) * (-y - x), (1, 1, 0, 0)),
        (lambda x, y: 0 * x + y * 0.0, (0, 0, 0, 0)),
        (lambda x, y: 1 * x + y * -1.0, (0, 1, 0, 0)),
        (lambda x, y: x / 4 + 4 / y, (1, 1, 1, 0)),
        (lambda x, y: (-x).sin() * x.sin() + (-x).cos() * x.cos(), (2, 1, 0, 2)),
        (lambda x, y: (x * y - y * x) + 0.0, (0, 0, 0, 0)),
        (lambda x, y: 2.0 * 3.0 * x - (-6.0) * x, (1, 1, 0, 0)),
    ],
)
def test_equal_operations_are_recorded_once_and_negations_never(function, count):
    assert scalar(function).count() == Count(*count)


def test_a_difference_and_its_opposite_are_one_value_with_two_signs():
    program = record("f", [Argument("x", 2)], lambda x: {"y": [x[0] - x[1], x[1] - x[0]]})
    (first, one), (second, other) = program.results[0].values
    assert first == second and one != other


def test_what_cancels_or_is_constant_is_a_number_and_not_an_operation():
    program = record("f", [Argument("x", 1)], lambda x: {"y": [x[0] - x[0], 0 * x[0], 0 / x[0], None, 2.5]})
    assert program.ops == () and program.results[0].values == (0.0, 0.0, 0.0, 0.0, 2.5)


def test_operations_that_no_result_needs_are_removed():
    def algorithm(x):
        unused = (x[0] * x[1]).sin() / x[2]
        return {"y": [x[0] + x[1]], "unused": [0 * unused]}

    assert [op.code for op in record("f", [Argument("x", 3)], algorithm).ops] == ["in", "in", "add"]


def sine(x):
    """Sine of a recorded number or a tensor."""
    return x.sin()


def cosine(x):
    """Cosine of a recorded number or a tensor."""
    return x.cos()


def tangle(x, y, z, sin=sine, cos=cosine):
    """Something of every operation, signs in awkward places."""
    a = -(x - y) * (z - 3.0) + (y - x) / (z * z + 1.5)
    b = sin(-a) * cos(a - z) - 2.0 / (1.0 + y * y)
    return -(b - a) * (-x) / 3.0 - (0.25 - b) + (a + b) * (b + a) - (-(y + z) - x)


def exact(program, x, result="y"):
    """Result of a program in numbers of mpmath."""
    turns = {"sin": mpmath.sin, "cos": mpmath.cos}
    return results(program, replay(program, [x], lambda op, *x: turns.get(op.code, OPS[op.code].value)(*x)))[result]


AT = ("0.3", "-1.7", "2.9")


def test_replay_in_exact_arithmetic_is_the_function_itself():
    with mpmath.workdps(50):
        x = list(map(mpmath.mpf, AT))
        (found,), expected = exact(scalar(tangle, 3), x), tangle(*x, mpmath.sin, mpmath.cos)
        # 1/3 and other folded constants are floats
        assert abs(found - expected) <= 4 * EPS64 * abs(expected)


def test_a_program_prints_its_arguments_operations_and_results():
    program = record(
        "f", [Argument("x", 2), Argument("m", 1, True)], lambda x, m: {"y": [-(x[0] * m[0]), 1.5]}, summed=["y"]
    )
    assert str(program) == (
        "f(x[2], m[1] uniform)\n  x0 = x[0]\n  x1 = m[0]\n  x2 = x0 * x1\n  y = [-x2, 1.5] summed over samples"
    )


# --- how much is recorded --------------------------------------------------------------------------------------------


def chain(
    n: int, seed: int = 0, tilt: float | None = None, meeting: bool = False, apart: float | None = None, slides: int = 0
) -> torchdq.Robot:
    """Chain with skew axes; or each axis `tilt` [rad] from the one before; or each meeting the one before.

    With `apart` [m], each axis is so far from the one before. The first `slides` joints are prismatic.
    """
    rng = np.random.default_rng([7, n, seed])
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    points = np.cumsum(rng.normal(size=(n, 3)) * 0.3, axis=0)
    for i in range(1, n):
        if tilt is not None:
            axes[i] = pin.exp3(tilt * np.cross(axes[i - 1], axes[i])) @ axes[i - 1]
        if meeting and i % 2:
            points[i] = points[i - 1] + 0.2 * axes[i - 1] - 0.3 * axes[i]
        if apart is not None:
            points[i] = points[i - 1] + 0.3 * axes[i - 1] + apart * np.cross(axes[i - 1], rng.normal(size=3))
    mass = rng.uniform(0.5, 3.0, n)
    poses = [pin.SE3(pin.exp3(rng.normal(size=3)), p + rng.normal(size=3) * 0.05) for p in points]
    screws = np.hstack([axes, np.cross(points, axes)])
    screws[:slides] = np.hstack([0 * axes, axes])[:slides]
    return torchdq.Robot.from_screws(
        screws,
        mass,
        rng.normal(size=(n, 3)) * 0.1,
        np.stack([random_inertia(rng, m) for m in mass]),
        link_poses=np.array([dual_quaternion(x) for x in poses]),
        tip_pose=dual_quaternion(poses[-1]),
        gravity=(1.0, -2.0, 9.0),
    )


def recorded(function: str, robot: torchdq.Robot, *names: str) -> Program:
    """Program of a public function that is given the named arguments."""
    return torchdq.compile(robot, function, arguments=names).program


@pytest.mark.parametrize("n", range(4, 17, 3))
def test_inverse_dynamics_of_a_general_chain_takes_84n_multiplications_and_70n_additions(n):
    count = recorded("inverse_dynamics", chain(n), "q", "qd", "qdd").count()
    assert count.multiplications <= 84 * n - 98 <= 91 * n - 93
    assert count.additions <= 70 * n - 87 <= 76 * n - 83
    assert count.divisions == 0 and count.sines == 2 * n


def test_forward_dynamics_of_a_long_chain_grows_linearly():
    short, long = (recorded("forward_dynamics", chain(n), "q", "qd", "tau").count().total for n in (15, 30))
    assert long <= 2.15 * short


@pytest.mark.parametrize("absent", ["qd", "qdd", "f_tip", "f_ext", "gravity"])
def test_what_is_absent_is_no_argument_of_the_program_and_saves_operations(absent):
    names, robot = ("q", "qd", "qdd", "f_tip", "f_ext"), chain(4)
    left = [name for name in names if name != absent]
    less = recorded("inverse_dynamics", robot.replace(gravity=None) if absent == "gravity" else robot, *left)
    assert [a.name for a in less.arguments] == left
    assert less.count().total < recorded("inverse_dynamics", robot, *names).count().total


def test_at_rest_and_without_gravity_nothing_is_recorded():
    assert recorded("inverse_dynamics", chain(3).replace(gravity=None), "q").ops == ()


def test_a_tensor_that_was_replaced_and_then_removed_is_no_argument():
    robot = torchdq.robots.load("two_link")
    robot = robot.replace(gravity=2 * robot.gravity).replace(gravity=None)
    assert [a.name for a in recorded("inverse_dynamics", robot, "q", "qd").arguments] == ["q", "qd"]


# --- derivatives -----------------------------------------------------------------------------------------------------


def mixed() -> Program:
    """All operations, an argument and a result of either kind, and a constant result."""

    def algorithm(x, c):
        a = (x[0] * c[0]).sin() / (2.0 + x[1] * x[1])
        b = x[2] * (x[1] - c[1]).cos() - c[1] * a
        return {"y": [a - b, -(a * b), 3.0], "z": [b * c[0], -a]}

    return record("mixed", [Argument("x", 3), Argument("c", 2, True)], algorithm, summed=["z"])


def inputs(program: Program, samples: int = 4) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(3)
    return [
        torch.randn(*(() if a.uniform else (samples,)), a.width, dtype=F64, generator=g).requires_grad_()
        for a in program.arguments
    ]


def close(found, expected) -> bool:
    return all(
        f.shape == e.shape and (f - e).abs().max() <= 64 * EPS64 * (1 + e.abs().max())
        for f, e in zip(found, expected, strict=True)
    )


def same_as_autograd(program, derivative):
    """Whether a derivative in all arguments is what torch finds by the operations of the program."""
    x = inputs(program)
    found, everything = partial(eager, program), tuple(range(len(x)))
    if derivative is derive.vjp:
        y = found(x)
        seeds = [torch.randn_like(v) for v in y]
        expected = torch.autograd.grad(y, x, seeds, materialize_grads=True)
    else:
        seeds = [torch.randn_like(v) for v in x]
        _, expected = torch.func.jvp(lambda *x: tuple(found(x)), tuple(x), tuple(seeds))
    return close(eager(derivative(program, everything), [*x, *seeds]), expected)


DERIVATIVES = pytest.mark.parametrize("derivative", [derive.vjp, derive.jvp])


@DERIVATIVES
def test_derivatives_equal_autograd(derivative):
    """Derivatives of first and second derivatives; the second are also by the cotangents and tangents of the first."""
    for program in (mixed(), derive.vjp(mixed(), (0, 1)), derive.jvp(mixed(), (0, 1))):
        assert same_as_autograd(program, derivative)


def test_the_gradient_of_a_uniform_argument_is_summed_and_the_others_are_not():
    gradients = derive.vjp(mixed(), (0, 1)).results
    assert [(r.name, r.summed) for r in gradients] == [("x'", False), ("c'", True)]


def test_jacobians_equal_autograd():
    program = record("f", [Argument("x", 3)], lambda x: {"y": [tangle(*x), x[0] * x[1], 1.0]})
    x = inputs(program, 1)[0].detach()
    expected = torch.func.jacrev(lambda x: eager(program, [x])[0])(x).reshape(1, -1)
    assert close(eager(derive.jacobian(program, (0,)), [x]), [expected])


def test_derivatives_equal_finite_differences_in_exact_arithmetic():
    program = scalar(tangle, 3)
    with mpmath.workdps(60):
        step = mpmath.mpf(10) ** -20
        x = list(map(mpmath.mpf, AT))
        for j, d in enumerate(exact(derive.jacobian(program, (0,)), x, "dy/dx")):
            below, above = (exact(program, [*x[:j], x[j] + h, *x[j + 1 :]])[0] for h in (-step, step))
            expected = (above - below) / (2 * step)
            assert abs(d - expected) <= 1e-30 * (1 + abs(expected))


@DERIVATIVES
def test_names_stay_apart_to_the_fourth_derivative(derivative):
    program = record("f", [Argument("x", 1)], lambda x: {"y": [x[0].sin()]})
    for _ in range(4):
        program = derivative(program, tuple(range(len(program.arguments))))
        names = [a.name for a in program.arguments]
        assert len(set(names)) == len(names)
    assert len(program.results) == (5 if derivative is derive.vjp else 1)


def test_a_constant_result_has_no_tangent_and_no_gradient():
    program = record("f", [Argument("x", 1)], lambda x: {"y": [2.0]})
    assert derive.jvp(program, (0,)).results[0].values == (0.0,)
    assert derive.vjp(program, (0,)).results[0].values == (0.0,)


# --- aligned frames --------------------------------------------------------------------------------------------------


def aligned(robot: torchdq.Robot, q: torch.Tensor, group: bool) -> Aligned:
    """The robot in its aligned frames, its numbers batches of positions."""
    return posed.aligned(robot, q.unbind(-1), {}, group)


def inexact(case, s, group):
    """Largest error of the torques in aligned frames, in sizes of their terms, against the paper's recursion."""
    found, expected = (
        stack(at.torques(s.qd.unbind(-1), s.qdd.unbind(-1), None), (len(s.q),))
        for at in (aligned(case.robot, s.q, group), as_printed(case.robot, s.q))
    )
    return ((found - expected).abs() / torch.from_numpy(size_of_torques(case, s))).max()


TREES = [random_case(n, seed, armature=bool(seed % 2)) for n, seed in ((5, 0), (8, 1), (12, 2), (12, 3))]
TREES = [Case(case.robot.bake(), case.model) for case in TREES]
EVERY_KIND = {kind for case in TREES for kind in case.robot.kinds}


def rotation_z(c, s):
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def rotation_x(c, s):
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


@pytest.mark.parametrize(
    "robot", [*(case.robot for case in TREES), chain(6, meeting=True), chain(6, tilt=0.0)], ids=str
)
def test_aligned_frames_put_the_links_where_they_are_and_the_axes_along_z(robot):
    """Turning the aligned frames by R_z(gamma) R_x(alpha) R_z(theta) leads to the same link poses at home."""
    assert {"revolute", "prismatic", "helical"} == EVERY_KIND
    links, own = [], []
    for i, (parent, at) in enumerate(zip(robot.parents, mdh.align(posed.tree(robot, {})), strict=True)):
        X = pin.SE3(np.eye(3), np.zeros(3)) if parent == BASE else own[parent]
        constants = at.placement
        R = rotation_z(*constants.gamma) @ rotation_x(*constants.alpha)
        step = pin.SE3(R, np.array(constants.p)) * pin.SE3(rotation_z(*at.turn), np.array([0, 0, constants.shift]))
        own.append(X * step)
        R_BL, p_BL = np.array(at.R_BL), np.array(at.p_BL)
        links.append(own[i] * pin.SE3(R_BL, p_BL).inverse())
        x = robot.X_PB_home[i].numpy()
        r, d = pin.Quaternion(*x[:4]), pin.Quaternion(*x[4:])
        home = pin.SE3(r.matrix(), 2 * (d * r.conjugate()).coeffs()[:3])
        expected = home if parent == BASE else links[parent] * home
        assert abs(links[i].homogeneous - expected.homogeneous).max() <= 64 * EPS64 * 8
        assert (
            abs(se3(np.array([*at.X_WB_home[0], *at.X_WB_home[1]])).homogeneous - links[i].homogeneous).max() <= 1e-13
        )
        # the joint's screw in the aligned frame: its axis is z, and the origin is on it
        s = robot.screw[i].numpy()
        direction = s[3:] if robot.kinds[i] == "prismatic" else s[:3]
        assert abs(R_BL.T @ direction - [0, 0, 1]).max() <= 32 * EPS64
        if robot.kinds[i] != "prismatic":
            moment = s[3:] - np.cross(p_BL, direction)
            assert abs(moment - s[:3] @ s[3:] * direction).max() <= 64 * EPS64 * 4


@pytest.mark.parametrize("group", [False, True])
@pytest.mark.parametrize("case", TREES, ids=lambda case: case.robot.name)
def test_torques_in_aligned_frames_equal_the_papers_recursion(case, group):
    assert inexact(case, states(case.robot, 5), group) <= 256 * EPS64


@pytest.mark.parametrize("group", [False, True])
@pytest.mark.parametrize("case", [*TREES, shipped("panda")], ids=lambda case: case.robot.name)
def test_the_mass_matrix_by_composite_bodies_equals_the_papers(case, group):
    s = states(case.robot, 5)
    expected = stack(as_printed(case.robot, s.q).mass_matrix(), (5,))
    found = stack(aligned(case.robot, s.q, group).mass_matrix(), (5,))
    size = expected.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((found - expected).abs() / (size[:, :, None] * size[:, None, :])).max() <= 256 * EPS64


AWKWARD = {
    **{f"tilt {tilt}": {"n": 6, "tilt": tilt} for tilt in (1e-3, 1e-5, 1.1e-6, 0.9e-6, 1e-7, 1e-9, 1e-15, 0.0)},
    "axes that meet": {"n": 8, "meeting": True},
}


@pytest.mark.parametrize("options", AWKWARD.values(), ids=AWKWARD)
def test_axes_that_are_nearly_parallel_or_meet_lose_no_accuracy(options):
    robot = chain(**options)
    assert inexact(Case(robot, pinocchio_model(robot)), states(robot, 5), True) <= 1e-12


NEARLY_ONE_LINE = itertools.product(
    thinned([0.0, 1e-17, 1e-16, 1e-15, 1e-14, 1e-13, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4], [0.0, 1e-16]),
    thinned([0.0, 1e-16, 1e-14, 1e-12, 1e-9, 3e-7, 1.1e-6, 1e-4], [0.0, 1e-9, 1.1e-6]),
    [0, 3],
    thinned([0, 1, 2], [0]),
)


@all_in_one(list(NEARLY_ONE_LINE))
def test_axes_that_are_nearly_one_line_lose_no_accuracy(of_what):
    """The common normal of such axes is a difference of almost equal points: its direction is rounding."""
    apart, tilt, slides, seed = of_what
    robot = chain(4, seed, tilt=tilt, apart=apart, slides=slides)
    case, s = Case(robot, pinocchio_model(robot)), states(robot, 2, seed)
    assert all(inexact(case, s, group) <= 1e-12 for group in (False, True))


def test_grouping_leaves_a_revolute_link_without_mass_on_its_axis():
    robot = chain(5)
    for link in aligned(robot, states(robot).q, True).tree.links[1:]:
        mass, (_, _, hz), (*_, zz) = link.inertia
        assert (mass, hz, zz) == (0.0, 0.0, 0.0)


# --- articulated bodies ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "robot",
    [*(case.robot for case in TREES), *(chain(n) for n in thinned((3, 10, 20, 42), (3, 20)))],
    ids=lambda r: f"{r.name}-{r.n}",
)
def test_articulated_bodies_solve_the_mass_matrix(robot):
    s = states(robot, 4)
    m = aligned(robot, s.q, True)
    factored, found = (stack(m.factors(linear).solve(s.qdd.unbind(-1)), (4,)) for linear in (False, True))
    M = stack(m.mass_matrix(), (4,)).numpy()
    expected = torch.from_numpy(np.linalg.solve(M, s.qdd.numpy()[..., None])[..., 0])
    bound = torch.from_numpy(32 * EPS64 * np.linalg.cond(M)) * expected.norm(dim=-1)
    assert ((found - expected).norm(dim=-1) <= bound).all()
    assert ((found - factored).norm(dim=-1) <= bound).all()


# --- half angles -----------------------------------------------------------------------------------------------------


def test_an_angle_and_its_half_have_one_sine_and_one_cosine():
    program = record("f", [Argument("x", 1)], lambda x: {"y": [x[0].sin(), x[0].cos(), (0.5 * x[0]).sin(), x[0]]})
    assert program.count().sines == 2
    x = torch.linspace(-7.0, 7.0, 101, dtype=F64)
    found = eager(program, [x[:, None]])[0]
    expected = torch.stack([x.sin(), x.cos(), (0.5 * x).sin(), x], -1)
    assert (found - expected).abs().max() <= 4 * EPS64


def test_a_program_that_holds_poses_and_dynamics_takes_the_sines_of_a_position_once():
    """Dual quaternions are made of half angles, dynamics of whole ones."""
    robot = torchdq.robots.load("panda")

    def both(q, qd, qdd):
        at = posed.posed(robot, q, {}, ())
        return {"tau": at.torques(qd, qdd, None), "X": [x for part in at.poses()[-1] for x in part]}

    program = record("both", [Argument(name, 7) for name in ("q", "qd", "qdd")], both)
    assert program.count().sines == 2 * robot.n
    s = states(robot, 5)
    tau, X = eager(program, [s.q, s.qd, s.qdd])
    assert (tau - torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)).abs().max() <= 1e-12 * tau.abs().max()
    expected = torchdq.forward_kinematics(robot, s.q, robot.link_names[-1])
    assert torch.minimum((X - expected).abs(), (X + expected).abs()).max() <= 1e-12


def test_wrenches_on_the_links_take_no_sine_that_the_dynamics_have():
    bare, *others = (
        torchdq.Scene(torchdq.robots.load("panda"), effects).program("torque", *inputs)
        for effects, inputs in (
            ((), ()),
            ((Drag(0.1, 0.1, 0.1),), ()),
            # the position of the tip in the world takes the first joint's angle as well
            ((Drag(0.1, 0.1, 0.1), Contact(friction=0.5), Push()), ("push",)),
        )
    )
    assert [p.count().sines - bare.count().sines for p in others] == [0, 2]
