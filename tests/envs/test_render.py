"""Pictures: what they show, how large they are, and what is refused."""

import sys
import urllib.request
from dataclasses import replace

import pytest
import torch
from messages import refused
from urdf_text import joint, link, urdf

import torchdq
from torchdq import Scene, dq, effects
from torchdq.envs.bodies import surface_of
from torchdq.envs.render import (
    GROUND,
    LINK,
    MOST_ARMS,
    OBJECT,
    RULES,
    TARGET,
    TIP,
    Painter,
    Skeleton,
    Viewer,
    _on_ground,
    save_gif,
)
from torchdq.errors import MissingLibraryError
from torchdq.objects import Ball, Box, Capsule, Cylinder
from torchdq.robot import ContactPoint

np = pytest.importorskip("numpy")
pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

POSE = [0.3, -0.5, 0.2, -2.0, 0.1, 1.8, 0.4]


def gripper():
    """A wrist with two fingers that slide apart."""
    hand = [link(name, xyz=(0, 0, 0.03)) for name in ("wrist", "left", "right")]
    joints = [
        joint("turn", "base", "wrist", xyz=(0, 0, 0.1)),
        joint("open", "wrist", "left", "prismatic", xyz=(0, 0, 0.2), axis=(0, 1, 0)),
        joint("shut", "wrist", "right", "prismatic", xyz=(0, 0, 0.2), axis=(0, -1, 0)),
    ]
    return torchdq.Robot.from_urdf(urdf(link("base", mass=None), *hand, *joints, name="gripper"))


@pytest.fixture(scope="module")
def panda():
    return torchdq.robots.load("panda")


@pytest.fixture(scope="module")
def painter(panda):
    return Painter(panda)


def coloured(image, colour):
    """Where an image has just that colour."""
    return (image == np.frombuffer(bytes.fromhex(colour[1:]), np.uint8)).all(-1)


# --- the skeleton ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["two_link", "panda", "ur10e", "puma560"])
def test_points_are_where_the_kinematics_put_them(name):
    robot = torchdq.robots.load(name)
    skeleton, q = Skeleton(robot), torch.linspace(-1, 1, 3 * robot.n, dtype=torch.float64).view(3, robot.n)
    points = skeleton.points(q)
    X = torchdq.forward_kinematics(robot, q, "tip")
    assert points[:, skeleton.tip] == pytest.approx(torchdq.dq.translation(X).numpy())
    assert (points[:, 0] == 0).all()


def test_joints_lie_on_their_axes(panda):
    for robot in (panda, torchdq.robots.load("puma560"), torchdq.robots.load("two_link")):
        skeleton, q = Skeleton(robot), torch.zeros(robot.n)
        for i, point in enumerate(skeleton.joints):
            turned = q.clone()
            turned[i] = 1.0
            assert skeleton.points(turned)[0, point] == pytest.approx(skeleton.points(q)[0, point], abs=1e-12)


def test_every_link_of_a_tree_has_a_line_from_its_parent():
    robot = gripper()
    skeleton = Skeleton(robot)
    starts, ends = skeleton.points([0.0, 0.02, 0.05])[0][skeleton.lines].swapaxes(0, 1)
    wrist, left, right = [0.0, 0.0, 0.1], [0.0, 0.02, 0.3], [0.0, -0.05, 0.3]
    assert starts == pytest.approx(np.array([[0.0, 0.0, 0.0], wrist, wrist, left, right]))
    tips = [[0.0, 0.02, 0.33], [0.0, -0.05, 0.33]]  # without an end effector fingers end at their centres of mass
    assert ends == pytest.approx(np.array([wrist, left, right, *tips]))


def test_nothing_leaves_the_view(panda):
    skeleton = Skeleton(panda)
    middle, radius = skeleton.view()
    assert 0.7 < radius < 1.2
    q = torch.rand(200, 7) * (panda.limits.upper - panda.limits.lower) + panda.limits.lower
    assert np.linalg.norm(skeleton.points(q) - middle, axis=-1).max() < 1.04 * radius


def test_of_a_batch_of_robots_the_first_is_drawn(panda):
    heavier = panda.replace(mass=panda.mass * torch.tensor([[1.0], [2.0]]).double())
    assert (Skeleton(heavier).points(POSE) == Skeleton(panda).points(POSE)).all()


def test_the_last_link_of_a_leg_ends_at_its_last_frame():
    foot = joint("ankle", "wrist", "foot", "fixed", xyz=(0, 0, 0.4))
    text = urdf(link("base"), link("wrist"), link("foot"), joint("turn", "base", "wrist"), foot)
    points = Skeleton(torchdq.Robot.from_urdf(text).with_tip(None)).points([0.0])[0]
    assert points[-1] == pytest.approx([0.0, 0.0, 0.4])


@pytest.fixture(scope="module")
def walker():
    """Base with two legs, and poses of it."""
    legs = [link(name, xyz=(0, 0, -0.2)) for name in ("left", "right")]
    joints = [joint(name, "base", name, xyz=(0, y, 0), axis=(0, 1, 0)) for name, y in (("left", 0.1), ("right", -0.1))]
    robot = torchdq.Robot.from_urdf(urdf(link("base"), *legs, *joints, name="walker"), base="floating")
    X = dq.exp(torch.tensor([[0.1, 0.4, -0.3, 0.5, 0.2, 0.3], [0.3, 0.1, 0.9, -1.0, 2.0, 0.4]]).double())
    return robot, X


def test_points_of_a_floating_base_are_in_the_world(walker):
    robot, X = walker
    skeleton, q = Skeleton(robot), torch.tensor([[0.3, -0.4], [1.0, 0.5]]).double()
    points = skeleton.points(q, X_WB=X)
    legs = dq.translation(torchdq.floating.forward_kinematics(robot, X, q, ["left", "right"]))
    assert points[:, 0] == pytest.approx(dq.translation(X).numpy())
    assert points[:, skeleton.joints] == pytest.approx(legs.numpy())
    assert skeleton.points(q) == pytest.approx(skeleton.points(q, X_WB=torch.eye(8)[0]))
    with refused(torchdq.ArgumentError):
        skeleton.points(q, X_WB=X[:, :7])


# --- images ----------------------------------------------------------------------------------------------------------


def test_equal_arguments_give_equal_images_of_the_size_that_was_asked_for(panda):
    painter = Painter(panda, (320, 200))
    first = painter.frame(POSE)
    assert first.shape == (200, 320, 3) and first.dtype == np.uint8
    for other in (painter.frame([x + 0.2 for x in POSE]), painter.frame(POSE, target=[0.4, 0.0, 0.3])):
        assert (first != other).any()
    assert (painter.frame(POSE, text="t = 1 s") != first).any()
    assert (painter.frame(torch.tensor(POSE)) == painter.frame(np.array(POSE, np.float32))).all()
    assert (painter.frame(POSE) == first).all()


def test_arms_and_targets_are_projected_along_the_camera_each_into_a_cell_of_its_own(panda):
    painter = Painter(panda, (400, 200))
    toward = painter._camera[:, 2]
    points = painter.skeleton.points([POSE, POSE])
    pixels, nearness, _ = painter.project(points)
    assert (pixels[0, :, 0] < 200).all() and pixels[1] == pytest.approx(pixels[0] + [200, 0])
    moved, nearer, _ = painter.project(points + 0.5 * painter.radius * toward)
    assert moved == pytest.approx(pixels) and nearer == pytest.approx(nearness + 0.5)
    up, *_ = painter.project(points + np.array([0.0, 0.0, 0.1]))
    assert (up[..., 1] > pixels[..., 1]).all() and up[..., 0] == pytest.approx(pixels[..., 0])


def test_what_is_nearer_covers_what_is_farther(painter):
    """A target on the line of sight to the elbow, before it and behind it."""
    elbow = painter.skeleton.points(POSE)[0, painter.skeleton.joints[3]]
    toward = painter._camera[:, 2]
    before, behind = (coloured(painter.frame(POSE, elbow + s * 0.5 * toward), TARGET).sum() for s in (1, -1))
    assert before > behind == 0


def test_a_robot_whose_position_is_not_finite_is_left_out(painter):
    image = painter.frame([POSE, [float("nan")] * 7])
    assert coloured(image[:200], LINK).any()
    assert not coloured(image[200:], LINK).any()
    assert not coloured(image, TARGET).any()  # none was given


def test_the_view_follows_a_floating_base_and_the_lines_on_the_ground_stay(walker):
    robot, X = walker
    painter, q = Painter(robot), [0.3, -0.4]
    X = X[0]

    def at(*place):
        X_WB = dq.mul(dq.from_pose(torch.eye(4, dtype=X.dtype)[0], torch.tensor(place, dtype=X.dtype)), X)
        return painter.frame(q, X_WB=X_WB, target=torch.tensor([0.3, 0.2, 0.1]) + torch.tensor(place))

    step = painter.radius / RULES
    here, there, between, higher = at(0.0, 0.0, 0.0), at(3 * step, -step, 0.0), at(0.4 * step, 0.0, 0.0), at(0, 0, 0.2)
    assert (here != there).mean() < 1e-3  # up to roundings
    changed = (here != between).any(-1)
    assert 0.005 < changed.mean() < 0.2 and not (changed & coloured(here, LINK)).any()
    assert coloured(higher, LINK).sum() == pytest.approx(coloured(here, LINK).sum(), rel=0.01)
    low, lower = (np.flatnonzero(coloured(image, GROUND).any(-1)).max() for image in (here, higher))
    assert lower == 399 or lower > low + 10


def test_shadows_are_on_the_ground():
    points = np.random.default_rng(0).normal(size=(2, 5, 2, 3))
    place = np.array([[[1.0, 2.0, 3.0]], [[-1.0, 0.0, 0.5]]])
    for ground in (lambda x, y: 0.0, lambda x, y: 0.1 * x * y):
        found = _on_ground(ground, points - place[:, None], place) + place[:, None]
        assert found[..., 2] == pytest.approx(ground(points[..., 0], points[..., 1]), abs=1e-12)
        assert found[..., :2] == pytest.approx(points[..., :2])


@pytest.mark.parametrize(
    ("contact", "height"),
    [
        ({"height": 0.1}, lambda x, y: 0.1),
        ({"normal": (0.6, 0.0, 0.8), "height": torch.tensor([0.1, 9.0])}, lambda x, y: (0.1 - 0.6 * x) / 0.8),
        ({"surface": lambda x, y: 0.1 * x.sin(), "height": 0.2}, lambda x, y: 0.2 + 0.1 * x.sin()),
    ],
    ids=["plane", "slope", "waves"],
)
def test_the_ground_of_a_scene_is_drawn_below_its_contact_points(walker, contact, height):
    robot, X = walker
    scene = Scene(robot, (effects.Contact(ContactPoint("left", (0.0, 0.0, -0.4), 0.03), **contact),), dt=0.001)
    x, y = torch.linspace(-1, 1, 5).double(), torch.linspace(0, 1, 5).double()
    assert torch.allclose(
        torch.as_tensor(Skeleton(scene).ground(x, y)).double(), torch.as_tensor(height(x, y)).double()
    )
    painter, q = Painter(scene), [0.3, -0.4]
    image = painter.frame(q, X_WB=X[0])
    assert coloured(image, TIP).any() and not coloured(Painter(robot).frame(q, X_WB=X[0]), TIP).any()
    foot = torchdq.floating.forward_kinematics(robot, X[0], torch.tensor(q).double(), "left")
    p = dq.mul(foot, dq.from_pose(torch.eye(4)[0].double(), torch.tensor([0.0, 0.0, -0.4]).double()))
    (ball, radius), *_ = painter.skeleton.balls
    assert painter.skeleton.points(q, X_WB=X[0])[0, ball] == pytest.approx(dq.translation(p).numpy()) and radius == 0.03


THINGS = (
    Box("box", 1.0, size=(0.1, 0.2, 0.3)),
    Ball("ball", 1.0, radius=0.1),
    Capsule("capsule", 1.0, radius=0.1, length=0.2),
    Cylinder("cylinder", 1.0, radius=torch.tensor([0.1, 0.5]), length=0.2),  # of two, the first
)


def among(*objects):
    """A scene of an arm and objects, and poses apart from each other and from the arm."""
    scene = Scene(torchdq.robots.load("two_link"), (effects.Contact("box", on="ball"),), objects=objects, dt=0.01)
    poses = [dq.exp(torch.tensor([0.3, 0.2, -0.5, 0.1, 0.4 * k - 0.6, 0.3]).double()) for k in range(len(objects))]
    return scene, torch.stack(poses)


def test_surfaces_of_objects_are_theirs():
    spans = ((0.05, 0.1, 0.15), (0.1, 0.1, 0.1), (0.1, 0.1, 0.2), (0.1, 0.1, 0.1))
    for body, span in zip(THINGS, spans, strict=True):
        surface = surface_of(body)
        for p, near in ((surface.vertices, 1e-7), (surface.points(0.02)[0], 1e-3)):
            assert np.abs(p).max(0) == pytest.approx(span, abs=2e-2)
            single = replace(body, radius=0.1) if isinstance(body, Cylinder) else body
            assert all(abs(single.nearest(tuple(row)).distance) < near for row in p.tolist())


def test_an_object_is_drawn_where_it_is():
    scene, X_WO = among(*THINGS)
    painter = Painter(scene)
    bare, image = painter.frame([0.0, 0.0]), painter.frame([0.0, 0.0], X_WO=X_WO)
    assert not coloured(bare, OBJECT).any()
    pixels, *_ = painter.project(dq.translation(X_WO).numpy()[None, :, None])
    for x, y in pixels[0, :, 0]:
        row, column = 400 - round(y), round(x)
        around = np.s_[row - 20 : row + 20, column - 20 : column + 20]
        assert image[around].mean() < bare[around].mean() - 1 and coloured(image[around], OBJECT).any()


# --- refusals --------------------------------------------------------------------------------------------------------


POSITIONS = [torch.zeros(shape) for shape in ((6,), (0, 7), (MOST_ARMS + 1, 7), (2, 2, 7), ())]
TARGETS = [torch.zeros(shape) for shape in ((2,), (3, 3), (1, 1, 3))]
FRAMES = [[], [np.zeros((4, 4, 3))], [np.zeros((4, 4), np.uint8)], [np.zeros((s, 4, 3), np.uint8) for s in (4, 5)]]
MISUSE = [
    *(lambda painter, q=q: painter.frame(q) for q in POSITIONS),
    *(lambda painter, target=target: painter.frame([POSE, POSE], target) for target in TARGETS),
    *(lambda painter, size=size: Painter(painter.skeleton.robot, size) for size in ((400,), (0, 400), (400.0, 400.0))),
    *(lambda painter, frames=frames: save_gif(frames, "never.gif") for frames in FRAMES),
    *(lambda painter, fps=fps: save_gif([painter.frame(POSE)], "never.gif", fps) for fps in (0, 51, float("nan"))),
    lambda painter: painter.frame(POSE, X_WB=torch.eye(8)[0]),
    lambda painter: Painter(among(*THINGS)[0]).frame([0.0, 0.0], X_WO=torch.eye(8)[:3]),
]


@pytest.mark.parametrize("call", MISUSE)
def test_wrong_arguments_are_refused(painter, call):
    with refused(torchdq.ArgumentError):
        call(painter)


@pytest.mark.parametrize(
    ("module", "draw"),
    [
        ("matplotlib.figure", Painter),
        ("viser", Viewer),
        ("PIL.Image", lambda _: save_gif([np.zeros((4, 4, 3), np.uint8)], "never.gif")),
    ],
)
def test_a_library_that_is_missing_is_named(panda, monkeypatch, module, draw):
    monkeypatch.setitem(sys.modules, module, None)
    with refused(MissingLibraryError):
        draw(panda)


# --- films and the live view -----------------------------------------------------------------------------------------


def test_a_film_has_all_its_images(painter, tmp_path):
    path = tmp_path / "film.gif"
    save_gif((painter.frame([0.1 * i, *POSE[1:]]) for i in range(5)), path, fps=20)
    with Image.open(path) as film:
        assert film.n_frames == 5
        assert film.size == (400, 400)
        assert film.info["duration"] == 50


def test_the_live_view_follows_a_floating_base(walker):
    pytest.importorskip("viser")
    robot, X = walker
    viewer = Viewer(robot)
    viewer.show([0.3, -0.4], X_WB=X[0], target=[0.0, 0.0, 0.0])
    place = dq.translation(X[0]).numpy()
    rules = viewer.ground.points + place
    step = 2 * viewer.skeleton.view()[1] / RULES
    along = np.abs(rules[:, :, :2] / step - (rules[:, :, :2] / step).round()).max(1)  # at whole numbers of steps
    assert along.min(-1).max() < 1e-4 and np.abs(rules[..., 2]).max() < 1e-6
    assert viewer.target.position == pytest.approx(-place)
    assert viewer.links.points[0, 0] == pytest.approx([0.0, 0.0, 0.0])
    assert viewer.base.wxyz == pytest.approx(X[0, :4].numpy())
    viewer.close()


def test_the_live_view_is_served_until_it_is_closed(panda):
    pytest.importorskip("viser")
    viewer = Viewer(panda)
    viewer.show(POSE, target=[0.5, 0.0, 0.5])
    with urllib.request.urlopen(viewer.url) as page:
        assert b"<html" in page.read()
    with refused(torchdq.ArgumentError):
        viewer.show([POSE, POSE])
    viewer.close()
    with pytest.raises(OSError):
        urllib.request.urlopen(viewer.url, timeout=2)
