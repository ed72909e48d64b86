"""Bodies of robots: that they are drawn where the file puts them, and what happens to meshes that are not there."""

import math
import warnings

import pytest
import torch
from urdf_text import joint, link, urdf

import torchdq
from torchdq.envs.bodies import bodies_of

np = pytest.importorskip("numpy")

SIZE, AT, TURN = (0.3, 0.1, 0.2), (0.05, -0.02, 0.15), (0.3, -0.4, 0.5)
TETRAHEDRON = "v 0 0 0\nv 0.3 0 0\nv 0 0.2 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
Q = [0.7, 0.2]


def shape(tag, geometry, xyz=(0, 0, 0), rpy=(0, 0, 0)):
    origin = f'<origin xyz="{" ".join(map(str, xyz))}" rpy="{" ".join(map(str, rpy))}"/>'
    return f"<{tag}>{origin}<geometry>{geometry}</geometry></{tag}>"


def arm(*shapes, end=()):
    """Text of two links and a frame that is fixed to the second, with shapes on the first and on the frame."""
    first, last = (link(name, xyz=(0, 0, 0.1)) for name in ("first", "last"))
    joints = [
        joint("turn", "base", "first", xyz=(0, 0, 0.2), axis=(0, 1, 0)),
        joint("slide", "first", "last", "prismatic", xyz=(0.1, 0, 0.5), axis=(1, 0, 0)),
        joint("fix", "last", "tool", "fixed", xyz=(0, 0.1, 0.2)),
    ]
    tool = f'<link name="tool">{"".join(end)}</link>'
    return urdf(link("base"), first.replace("</link>", "".join(shapes) + "</link>"), last, tool, *joints)


BOX = f'<box size="{SIZE[0]} {SIZE[1]} {SIZE[2]}"/>'
BALL = '<sphere radius="0.02"/>'


def placed(robot, q):
    """Vertices of the bodies in the world, by the name of their frame."""
    found = {}
    for i, surface in bodies_of(robot):
        name = robot.frames[i].name
        X = torchdq.forward_kinematics(robot, torch.tensor(q).double(), name)
        p = torchdq.dq.rotate(torchdq.dq.rotation(X), torch.from_numpy(surface.vertices)) + torchdq.dq.translation(X)
        found[name] = p.numpy()
    return found


def spread(p):
    return np.array(sorted(map(tuple, np.unique(p.round(6), axis=0))))


@pytest.mark.parametrize("tag", ["visual", "collision"])
def test_a_box_is_where_pinocchio_says_it_is(tag, tmp_path):
    pin = pytest.importorskip("pinocchio")
    path = tmp_path / "arm.urdf"
    path.write_text(arm(shape(tag, BOX, AT, TURN), end=[shape(tag, BOX, TURN, AT)]))
    robot = torchdq.Robot.from_urdf(path)
    model = pin.buildModelFromUrdf(str(path))
    kind = getattr(pin.GeometryType, tag.upper())
    theirs = pin.buildGeomFromUrdf(model, str(path), kind)
    data, places = model.createData(), theirs.createData()
    pin.updateGeometryPlacements(model, data, theirs, places, np.array(Q))
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * SIZE / 2
    found = placed(robot, Q)
    assert found.keys() == {"first", "tool"}
    for own, X in zip(found.values(), places.oMg, strict=True):
        expected = corners @ X.rotation.T + X.translation
        corner = own[np.abs(own[:, None] - expected).max(-1).min(1) < 1e-6]
        assert spread(corner) == pytest.approx(spread(expected), abs=2e-6)
        assert np.ptp(own, 0) == pytest.approx(np.ptp(expected, 0))


def test_a_link_with_a_body_is_drawn_by_it_and_the_others_by_lines():
    render = pytest.importorskip("torchdq.envs.render")
    pytest.importorskip("matplotlib")
    bare, seen = (torchdq.Robot.from_urdf(arm(*shapes)) for shapes in ((), (shape("visual", BOX, AT),)))
    touching = torchdq.Robot.from_urdf(arm(shape("visual", BALL), shape("collision", BOX, AT)))
    assert render.Skeleton(bare).sticks == render.Skeleton(bare).lines
    skeleton = render.Skeleton(seen)
    left = [line for line in skeleton.lines if line not in skeleton.sticks]
    assert left == [(skeleton.joints[0], skeleton.joints[1])]
    assert render.Skeleton(touching).sticks == skeleton.lines  # what is seen goes first, and is too small
    painter = render.Painter(seen)
    paper = painter.frame([math.nan] * 2)
    (middle,) = painter.project(placed(seen, Q)["first"].mean(0)[None, None])[0][0]
    column, row = round(middle[0]), 400 - round(middle[1])
    drawn = painter.frame(Q)
    assert (drawn[row - 3 : row + 3, column - 3 : column + 3] != paper[0, 0]).all()
    assert (drawn != render.Painter(bare).frame(Q)).any()


def test_bodies_go_with_robots_that_are_changed():
    robot = torchdq.Robot.from_urdf(arm(shape("visual", BOX, AT)))
    locked = robot.lock({"slide": Q[1]})
    two = robot.attach(robot, "tool", prefix="other_")
    assert placed(locked, Q[:1])["first"] == pytest.approx(placed(robot, Q)["first"])
    assert placed(two, [*Q, 0.0, 0.0])["first"] == pytest.approx(placed(robot, Q)["first"])
    assert placed(two, [*Q, 0.0, 0.0]).keys() == {"first", "other_first"}


def test_the_live_view_has_the_bodies_at_their_poses():
    render = pytest.importorskip("torchdq.envs.render")
    pytest.importorskip("viser")
    robot = torchdq.Robot.from_urdf(arm(shape("visual", BOX, AT, TURN), end=[shape("visual", BOX)]))
    viewer = render.Viewer(robot)
    viewer.show(Q)
    for body, (i, surface) in zip(viewer.bodies, viewer.skeleton.bodies, strict=True):
        X = torchdq.forward_kinematics(robot, torch.tensor(Q).double(), robot.frames[i].name)
        assert body.position == pytest.approx(torchdq.dq.translation(X).numpy())
        assert body.wxyz == pytest.approx(torchdq.dq.rotation(X).numpy())
        assert body.vertices == pytest.approx(surface.vertices, abs=1e-6)
    viewer.close()


MESHES = ["thing.obj", "parts/thing.obj", "package://this_robot/parts/thing.obj"]


@pytest.mark.parametrize("name", MESHES)
def test_meshes_are_found_beside_the_file_and_in_its_package(name, tmp_path):
    pytest.importorskip("trimesh")
    folder = tmp_path / "this_robot" / "urdf"
    path = folder / name if ":" not in name else tmp_path / "this_robot" / "parts" / "thing.obj"
    for each in (folder, path.parent):
        each.mkdir(parents=True, exist_ok=True)
    path.write_text(TETRAHEDRON)
    mesh = f'<mesh filename="{name}" scale="2 2 -1"/>'
    (folder / "arm.urdf").write_text(arm(shape("visual", mesh, AT), shape("visual", mesh, TURN)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ((_, surface),) = bodies_of(torchdq.Robot.from_urdf(folder / "arm.urdf"))
    corners = np.array([(0, 0, 0), (0.6, 0, 0), (0, 0.4, 0), (0, 0, -0.1)])
    assert spread(surface.vertices) == pytest.approx(spread(np.concatenate([corners + AT, corners + TURN])))
    assert len(surface.faces) == 8


def test_a_mesh_that_is_not_there_is_named_once_and_its_link_drawn_by_lines(tmp_path):
    render = pytest.importorskip("torchdq.envs.render")
    mesh = '<mesh filename="package://this_robot/lost.stl"/>'
    path = tmp_path / "arm.urdf"
    path.write_text(arm(shape("visual", mesh), shape("visual", mesh, AT), end=[shape("visual", mesh)]))
    robot = torchdq.Robot.from_urdf(path)
    with pytest.warns(UserWarning, match="lost") as caught:
        skeleton = render.Skeleton(robot)
    assert len(caught) == 1 and str(caught[0].message).count("package://this_robot/lost.stl") == 1
    assert str(tmp_path) in str(caught[0].message)
    assert skeleton.sticks == skeleton.lines and not skeleton.bodies


GEOMS = """<mujoco><compiler meshdir="{}" angle="degree" eulerseq="zyx"/>
<default><default class="tall"><mesh scale="1 1 3"/><geom pos="0 0 0.1"/></default></default>
<asset><mesh name="m" class="tall" file="thing.obj"/></asset>
<worldbody><body name="b"><joint name="j" axis="0 1 0"/>{}
<frame pos="0.1 0.2 0.3" euler="10 20 30"><geom class="tall" type="mesh" mesh="m" euler="30 0 50"/></frame>
<geom type="box" size="0.1 0.2 0.3" pos="1 0 0"/><geom type="sphere" size="0.1" group="4"/></body></worldbody>
</mujoco>"""


@pytest.mark.parametrize("inertial", ["", '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'])
def test_meshes_of_an_mjcf_file_are_where_mujoco_puts_them(inertial, tmp_path):
    """With an inertial element, the mesh is not opened when the file is read."""
    mujoco = pytest.importorskip("mujoco")
    pytest.importorskip("trimesh")
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "thing.obj").write_text(TETRAHEDRON)
    path = tmp_path / "thing.xml"
    path.write_text(GEOMS.format("meshes", inertial))
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = 0.7
    mujoco.mj_kinematics(model, data)
    mesh = model.mesh_vert @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    found = placed(torchdq.Robot.from_mjcf(path), [0.7])["b"]
    distance = np.linalg.norm(found[:, None] - mesh, axis=-1)
    assert distance.min(0).max() < 1e-6
    box = np.abs((found[distance.min(1) > 1e-6] - data.geom_xpos[1]) @ data.geom_xmat[1].reshape(3, 3))
    assert box.max(0) == pytest.approx([0.1, 0.2, 0.3])
