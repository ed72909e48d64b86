"""Distances of spheres from objects, the ground and each other are MuJoCo's, their derivatives those of differences."""

import shutil

import mujoco
import pytest
import torch
from helpers import double
from messages import refused
from robots import on_free_base

import torchdq
from torchdq import TorchdqError, dq
from torchdq.objects import Ball, Box, Capsule, Cylinder

F64 = torch.float64
BACKEND = "auto"
ARM = """
<mujoco>
  <worldbody>
    {others}
    <body name="upper" pos="0 0 0.3">
      {free}
      <joint name="one" axis="0 0 1"/>
      <geom name="elbow" type="sphere" size="0.06" pos="0.3 0.02 0"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="two" axis="0 1 0"/>
        <geom name="wrist" type="sphere" size="0.05" pos="0.1 0 0.05"/>
        <geom name="tip" type="sphere" size="0.04" pos="0.3 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SPHERES = ("elbow", "wrist", "tip")
OBJECTS = {
    "box": (Box("box", 1.0, size=(0.2, 0.3, 0.16)), "0.1 0.15 0.08"),
    "capsule": (Capsule("capsule", 1.0, radius=0.05, length=0.2), "0.05 0.1"),
    "sphere": (Ball("sphere", 1.0, radius=0.08), "0.08"),
    "cylinder": (Cylinder("cylinder", 1.0, radius=0.05, length=0.2), "0.05 0.1"),
}
THINGS = tuple(body for body, _ in OBJECTS.values())
HEIGHT = -0.2
BALL, HERE = Ball("ball", 1.0, radius=0.1), torch.eye(1, 8, dtype=F64)


def robot(free=False):
    joint = "<freejoint/>" if free else ""
    text = ARM.format(others="", free="")
    found = torchdq.Robot.from_mjcf(text)
    return on_free_base(found) if joint else found


def postures(count=6):
    """Positions [count, 2], and poses of the objects [count, objects, 8] about the arm."""
    g = torch.Generator().manual_seed(0)
    q = torch.rand(count, 2, dtype=F64, generator=g) * 4.0 - 2.0
    turns = torch.nn.functional.normalize(torch.randn(count, len(THINGS), 4, dtype=F64, generator=g), dim=-1)
    places = torch.rand(count, len(THINGS), 3, dtype=F64, generator=g) - 0.5
    return q, dq.from_pose(turns, places)


def in_mujoco(q, X_WO):
    """Distances of the spheres from objects and ground, and from those of the other link, in the order of pairs."""
    geoms = ""
    for (kind, (_, size)), X in zip(OBJECTS.items(), X_WO, strict=True):
        turn, at = (" ".join(map(str, x.tolist())) for x in (dq.rotation(X), dq.translation(X)))
        geoms += f'<geom name="{kind}" type="{kind}" size="{size}" pos="{at}" quat="{turn}"/>'
    geoms += f'<geom name="ground" type="plane" size="9 9 1" pos="0 0 {HEIGHT}"/>'
    model = mujoco.MjModel.from_xml_string(ARM.format(others=geoms, free=""))
    data = mujoco.MjData(model)
    data.qpos[:] = q.tolist()
    mujoco.mj_forward(model, data)
    pairs = [(a, b) for b in (*OBJECTS, "ground") for a in SPHERES] + [("elbow", "wrist"), ("elbow", "tip")]
    return [mujoco.mj_geomDistance(model, data, model.geom(a).id, model.geom(b).id, 10.0, None) for a, b in pairs]


def points():
    return tuple(point for name in SPHERES for point in robot().contact_points(name))


def whole(q, X_WO, **more):
    return torchdq.distances(robot(), q, points(), THINGS, X_WO, HEIGHT, own=True, **more)


def test_distances_and_the_names_of_their_pairs_are_those_of_mujoco():
    q, X_WO = postures()
    found = whole(q, X_WO)
    expected = torch.tensor([in_mujoco(*row) for row in zip(q, X_WO, strict=True)], dtype=F64)
    apart = expected > 0  # which MuJoCo approximates where shapes overlap
    assert apart.float().mean() > 0.8
    assert (found.distance - expected)[apart].abs().max() < 1e-6
    bodies = [name for name, _ in found.pairs[:3]]
    assert bodies == ["upper", "lower", "lower"]
    assert found.pairs == tuple(
        [(a, b) for b in (*OBJECTS, "ground") for a in bodies] + [("upper", "lower"), ("upper", "lower")]
    )


def test_first_and_second_derivatives_are_those_of_differences_inside_too():
    q, X_WO = postures(20)
    X_WO[::2, 0] = dq.from_pose(dq.rotation(X_WO[::2, 0]), double(0.3, 0.1, 0.3))  # in the arm
    g, step = torch.Generator().manual_seed(2), 1e-6
    ways = [torch.randn(x.shape, dtype=F64, generator=g) for x in (q, X_WO)]

    def distance(*x):
        return whole(*x).distance

    def slope(*x):
        return torch.func.jvp(distance, x, tuple(ways))[1]

    assert bool((distance(q, X_WO)[::2, :12] < 0).any())
    for value, derivative in ((distance, slope), (slope, lambda *x: torch.func.jvp(slope, x, tuple(ways))[1])):
        up, down = (value(*[x + s * step * w for x, w in zip((q, X_WO), ways, strict=True)]) for s in (1.0, -1.0))
        found = derivative(q, X_WO)
        assert (found - (up - down) / (2 * step)).abs().max() < 1e-7 * found.abs().max()


def test_sizes_and_the_ground_may_be_tensors_of_samples_with_gradients():
    q, X_WO = postures(3)
    size = torch.tensor([[0.2, 0.3, 0.16], [0.1, 0.1, 0.1], [0.3, 0.2, 0.4]], dtype=F64, requires_grad=True)
    radius, height = double(0.08)[0].requires_grad_(), double(0.0, 0.1, -0.1).requires_grad_()

    def distance(size, radius, height):
        objects = (Box("box", 1.0, size=size), Ball("ball", size[..., 0], radius=radius))
        return torchdq.distances(robot(), q, points(), objects, X_WO[:, :2], height).distance

    found = distance(size, radius, height)
    for k in range(3):
        objects = Box("box", 1.0, size=tuple(size[k].tolist())), Ball("ball", 1.0, radius=0.08)
        alone = torchdq.distances(robot(), q[k], points(), objects, X_WO[k, :2], float(height[k].detach())).distance
        assert (found[k] - alone).abs().max() < 1e-14
    moved = [torch.autograd.grad(found.sum(), x, retain_graph=True)[0] for x in (size, radius, height)]
    for k in range(3):
        up, down = (
            distance(*[y + s * 1e-6 * (j == k) for j, y in enumerate((size, radius, height))]).sum() for s in (1, -1)
        )
        assert float(moved[k].sum()) == pytest.approx(float((up - down).detach()) / 2e-6, abs=1e-6)


def test_one_size_as_a_tensor_without_axes_is_that_number():
    q, radius = double(0.1, 0.2), double(0.1)[0].requires_grad_()
    found = torchdq.distances(robot(), q, points(), (Ball("ball", 1.0, radius=radius),)).distance
    assert torch.equal(found, torchdq.distances(robot(), q, points(), (BALL,)).distance)
    assert torch.autograd.grad(found.sum(), radius)[0] == pytest.approx(-3.0)


def test_a_floating_base_carries_the_spheres():
    q, X_WO = postures()
    g = torch.Generator().manual_seed(1)
    turn = torch.nn.functional.normalize(torch.randn(6, 4, dtype=F64, generator=g), dim=-1)
    X_WB = dq.from_pose(turn, torch.randn(6, 3, dtype=F64, generator=g))
    fixed = torchdq.distances(robot(), q, points(), THINGS, X_WO)
    floats = torchdq.floating.distances(robot(True), X_WB, q, points(), THINGS, dq.mul(X_WB[:, None], X_WO))
    assert floats.pairs == fixed.pairs
    assert (floats.distance - fixed.distance).abs().max() < 1e-14


def test_the_ground_may_slope_and_the_tip_is_the_point_by_default():
    q, slope = double(0.0, 0.0), double(0.6, 0.0, 0.8)
    arm = torchdq.robots.load("two_link")
    found = torchdq.distances(arm, q, height=0.5, normal=slope)
    assert found.pairs == ((arm.tip, "ground"),)
    assert float(found.distance) == pytest.approx(0.6 * 2.0 - 0.5)


@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
def test_a_compiled_program_takes_what_there_is_and_is_part_of_a_graph():
    arm, at = robot(), (points(), (BALL,), "", "")
    assert [a.name for a in torchdq.compile(arm, "distances").program.arguments] == ["q", "height", "normal"]
    program = torchdq.compile(arm, "distances", arguments=("q", "X_WO"), options=at)
    q = double(0.1, 0.2)[None]
    found = torch.compile(lambda q: program(q, HERE) ** 2, fullgraph=True)(q)
    assert torch.equal(found, torchdq.distances(arm, q, points(), (BALL,)).distance ** 2)


def test_an_arm_in_a_box_is_pushed_out_by_steps_along_the_gradients():
    arm, q = robot(), double(0.1, 0.2)
    box, X_WO = Box("box", 1.0, size=(0.3, 0.2, 0.3)), dq.from_pose(double(1, 0, 0, 0), double(0.6, 0.1, 0.2))[None]

    def depth(q):
        return torchdq.distances(arm, q, points(), (box,), X_WO).distance.clamp(max=0.01).sub(0.01).square().sum()

    assert float(depth(q)) > 1e-2
    for _ in range(20):
        q = q - 2.0 * torch.func.grad(depth)(q)
    assert float(torchdq.distances(arm, q, points(), (box,), X_WO).distance.min()) > 0.0


WRONG = {
    "nothing to be apart from": lambda q: torchdq.distances(robot(), q),
    "one object, not a sequence": lambda q: torchdq.distances(robot(), q, objects=BALL),
    "an object with the name of a frame": lambda q: torchdq.distances(
        robot(), q, objects=(Ball("lower", 1.0, radius=0.1),)
    ),
    "no such frame": lambda q: torchdq.distances(robot(), q, "hand", height=0.0),
    "no points": lambda q: torchdq.distances(robot(), q, (), height=0.0),
    "poses of other objects": lambda q: torchdq.distances(
        robot(), q, objects=(BALL,), X_WO=torch.ones(2, 8, dtype=F64)
    ),
    "a pose that is not unit": lambda q: torchdq.distances(robot(), q, objects=(BALL,), X_WO=2.0 * HERE),
    "a base whose pose is not unit": lambda q: torchdq.floating.distances(robot(True), 2.0 * HERE[0], q, height=0.0),
    "a normal that is not unit": lambda q: torchdq.distances(robot(), q, height=0.0, normal=double(0.0, 0.0, 2.0)),
    "a height that is a text": lambda q: torchdq.distances(robot(), q, height="low"),
    "a floating base": lambda q: torchdq.distances(robot(True), q, height=0.0),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_refused_with_its_name(what):
    with refused(TorchdqError):
        WRONG[what](torch.zeros(2, dtype=F64))
