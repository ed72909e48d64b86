"""Contact points of collision shapes lie where Pinocchio and MuJoCo have the shapes, in changed robots too."""

import copy
import pickle
import warnings
import xml.etree.ElementTree as ET
from itertools import product

import mujoco
import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one, thinned
from messages import refused, warned
from mjcf_text import ARM, ASSETS, FREE, model_of
from robots import two
from urdf_text import also, arm, fixed, link, random_elements, urdf, words

import torchdq
from torchdq import ArgumentError, Robot, UnknownNameError
from torchdq.robot import ContactPoint
from torchdq.robot.contact_points import require_contact_point

PICOMETRE = 1e-12  # centres are rounded to it
CORNERS = [*product((-1, 1), repeat=3)]
RIMS = [(x, y, z) for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1)) for z in (-1, 1)]


def collision(form, xyz=(0, 0, 0), rpy=(0, 0, 0), name=""):
    """A <collision>."""
    place = f'<origin xyz="{words(xyz)}" rpy="{words(rpy)}"/>'
    return f'<collision name="{name}">{place}<geometry>{form}</geometry></collision>'


def formed(name, *forms, on="lower"):
    """A link with these shapes, fixed to another."""
    return link(name, more="".join(map(collision, forms))) + fixed(f"f_{name}", on, name)


def random_form(rng):
    """A form of any kind."""
    a, b, c = rng.uniform(0.01, 0.2, 3)
    forms = (f'<sphere radius="{a}"/>', f'<cylinder radius="{a}" length="{b}"/>', f'<box size="{a} {b} {c}"/>')
    return forms[rng.integers(3)]


def near(points, theirs):
    """Whether points [centre, radius] are those of another library, in any order."""
    apart = np.abs(np.array(points)[:, None] - np.array(theirs)).max(-1)
    return apart.shape[0] == apart.shape[1] and max(apart.min(0).max(), apart.min(1).max()) <= PICOMETRE


def numbers(points):
    """Centres and radii [points, 4]."""
    return [(*point.center, point.radius) for point in points]


def preferred(points):
    """Points of another library's shapes: round ones alone where one of them is a sphere, which all round ones are."""
    return [p for p in points if p[3]] or points


# --- places ----------------------------------------------------------------------------------------------------------


def of_pinocchio(text):
    """Contact points by frame, of the geometry that Pinocchio reads."""
    model = pin.buildModelFromXML(text)
    found = {}
    for shape in pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION).geometryObjects:
        frame, form = model.frames[shape.parentFrame], shape.geometry
        own, radius = {
            "Sphere": lambda form: ([(0, 0, 0)], form.radius),
            "Box": lambda form: (np.multiply(CORNERS, form.halfSide), 0.0),
            "Cylinder": lambda form: (np.multiply(RIMS, [form.radius, form.radius, form.halfLength]), 0.0),
        }[type(form).__name__](form)
        X = frame.placement.inverse() * shape.placement
        found.setdefault(frame.name, []).extend((*X.act(np.array(p, float)), radius) for p in own)
    return found


def without_meshes(path):
    """Text of a file without meshes in its <collision> elements, and without <visual> ones."""
    root = ET.fromstring(path.read_text(encoding="utf-8-sig"))
    for part in root.findall("link"):
        meshes = [x for x in part.findall("collision") if x.find("geometry/mesh") is not None]
        for element in part.findall("visual") + meshes:
            part.remove(element)
    return ET.tostring(root, encoding="unicode")


WITH_SHAPES = ["a1", "anymal_b_simple-anymal", "go1", "laikago", "g1_29dof_rev_1_0", "hyq_no_sensors", "pr2"]


@all_in_one(thinned(WITH_SHAPES, ["anymal_b_simple-anymal", "go1", "g1_29dof_rev_1_0", "hyq_no_sensors"]))
def test_points_of_a_file_are_where_pinocchio_has_its_shapes(name):
    text = without_meshes(oracles.urdf_paths()[name])
    robot, theirs = Robot.from_urdf(text, on_unphysical="ignore", mimic="independent"), of_pinocchio(text)
    assert theirs and {frame.name for frame in robot.frames if frame.shapes} == {*theirs}
    for frame, points in theirs.items():
        assert near(numbers(robot.contact_points(frame)), preferred(points)), frame


@pytest.mark.filterwarnings("ignore:contact points of robot")
@all_in_one(range(5))
def test_points_of_a_random_file_are_where_pinocchio_has_its_shapes(seed):
    """Placed in any way, several on a link, on fixed joints too."""
    rng = np.random.default_rng(seed)

    def shapes():
        placed = ((random_form(rng), rng.normal(size=3), rng.uniform(-3, 3, 3)) for _ in range(rng.integers(3)))
        return "".join(collision(*shape) for shape in placed)

    text = urdf(*(part.replace("</link>", shapes() + "</link>") for part in random_elements(seed)))
    robot, theirs = Robot.from_urdf(text), of_pinocchio(text)
    assert len(theirs) > 2
    for frame, points in theirs.items():
        assert near(numbers(robot.contact_points(frame)), preferred(points))


GEOMS = """<mujoco><compiler angle="degree"/>
  <default><geom type="capsule" size="0.03"/></default>
  <worldbody><frame pos="1 2 3" euler="10 20 30"><body name="a"><joint/>
    <geom name="rod" fromto="0.1 0.2 0.3 -0.2 0.1 0.5"/><geom type="box" size="0.1 0.2 0.3" euler="20 -40 70"/>
    <geom type="sphere" size="0.5" contype="0" conaffinity="0"/>
    <body name="b" pos="0 0 1" quat="1 2 3 4"><geom type="cylinder" size="0.1 0.2" pos="1 0 0" xyaxes="0 1 1 1 0 0"/>
    <geom name="ball" type="sphere" size="0.07" pos="0 0.2 0" contype="0"/></body>
  </body></frame></worldbody></mujoco>"""
MODELS = [GEOMS, *(ASSETS / f"{name}.xml" for name in ("ant", "half_cheetah", "humanoid", "walker2d_v5"))]


@pytest.mark.filterwarnings("ignore:compiler attribute", "ignore:contact points of robot")
@all_in_one(MODELS)
def test_points_of_geoms_are_where_mujoco_has_them(source):
    model = model_of(source)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    robot, compared = Robot.from_mjcf(source, on_unphysical="ignore"), 0
    for i in range(1, model.nbody):
        body, theirs, touching = model.body(i), [], []
        for g in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0]):
            geom, R = data.geom(g), data.geom(g).xmat.reshape(3, 3)
            a, b, c = model.geom_size[g]
            if model.geom_contype[g] or model.geom_conaffinity[g]:
                touching.append(g)
                own, radius = {
                    mujoco.mjtGeom.mjGEOM_SPHERE: ([(0, 0, 0)], a),
                    mujoco.mjtGeom.mjGEOM_CAPSULE: ([(0, 0, -b), (0, 0, b)], a),
                    mujoco.mjtGeom.mjGEOM_CYLINDER: (np.multiply(RIMS, (a, a, b)), 0.0),
                    mujoco.mjtGeom.mjGEOM_BOX: (np.multiply(CORNERS, (a, b, c)), 0.0),
                }[mujoco.mjtGeom(model.geom_type[g])]
                turned = data.body(i).xmat.reshape(3, 3).T
                theirs += [(*turned @ (geom.xpos + R @ p - data.body(i).xpos), radius) for p in np.array(own, float)]
        if theirs:
            compared += 1
            ball = mujoco.mjtGeom.mjGEOM_SPHERE in {int(model.geom_type[g]) for g in touching}
            assert near(numbers(robot.contact_points(body.name or f"body{i}")), preferred(theirs) if ball else theirs)
    assert compared > 1


def test_capsules_of_urdf_have_the_length_between_their_ends():
    capsule = collision('<capsule radius="0.1" length="0.6"/>', xyz=(1, 0, 0), rpy=(0, np.pi / 2, 0))
    ends = Robot.from_urdf(also(link("rod", more=capsule) + fixed("f", "lower", "rod"))).contact_points("rod")
    assert ends == tuple(ContactPoint("rod", (x, 0.0, 0.0), 0.1) for x in (0.7, 1.3))


# --- names -----------------------------------------------------------------------------------------------------------

BALL = '<sphere radius="0.02"/>'
MESH = '<mesh filename="package://legs/foot.stl"/>'


def legs(*forms, names=("left_toe", "right_toe")):
    """An arm with two feet on fixed joints."""
    more = ""
    for foot, form, name in zip(("left_foot", "right_foot"), forms, names, strict=True):
        more += link(foot, 0.1, more=collision(form, (0, 0, -0.1), name=name))
        more += fixed(f"{foot}_joint", "lower", foot, (0, 0, 1))
    return also(more)


def test_names_are_those_of_frames_or_of_collision_elements():
    robot = Robot.from_urdf(legs(BALL, BALL))
    left, right = (ContactPoint(f"{side}_foot", (0.0, 0.0, -0.1), 0.02) for side in ("left", "right"))
    for pattern in ("*_foot", "*_toe", ["right_foot", "left_foot"], ("left_foot", "right_toe")):
        assert robot.contact_points(pattern) == (left, right)
    assert robot.contact_points("right_toe") == robot.contact_points("right_foot") == (right,)
    ball, rod = (Robot.from_mjcf(GEOMS).contact_points(name) for name in ("ball", "rod"))
    assert [x.frame for x in (*ball, *rod)] == ["b", "a", "a"]


def test_names_without_shapes_and_shapes_without_points_are_refused_with_a_way_out():
    robot = Robot.from_urdf(legs(BALL, MESH))
    assert len(robot.contact_points("left_*")) == 1
    for pattern in ("right_foot", "right_toe"):
        with refused(ArgumentError, frame="right_foot", file="package://legs/foot.stl"):
            robot.contact_points(pattern)
    for pattern in ("leftfoot", "base", "*_hand"):
        with refused(UnknownNameError):
            robot.contact_points(pattern)
    with refused(UnknownNameError):
        Robot.from_urdf(arm()).contact_points("*")
    with refused(ArgumentError):
        robot.contact_points(3)


NO_FORMS = ["", "<cone/>", '<sphere radius="-1"/>', "<sphere/>", '<box size="1 2"/>']


@all_in_one([*NO_FORMS, '<cylinder radius="1" length="nan"/>'])
def test_shapes_that_cannot_be_read_keep_no_robot_from_being_read(form):
    robot = Robot.from_urdf(legs(BALL, form))
    assert robot.contact_points("left_foot")
    with refused(ArgumentError):
        robot.contact_points("right_foot")


BOX, CYLINDER = '<box size="0.1 0.2 0.3"/>', '<cylinder radius="0.1" length="0.4"/>'
PARTS = {  # shapes on one link: number of its points, and what is left out
    "a mesh beside a box": ([MESH, BOX], 8, ["mesh"]),
    "a cone beside a cylinder": ([CYLINDER, "<cone/>"], 8, ["cone"]),
    "a cylinder beside spheres": ([BALL, CYLINDER, BALL], 2, ["cylinder"]),
    "a box and a mesh beside a sphere": ([BOX, BALL, MESH], 1, ["box", "mesh"]),
    "a capsule beside a sphere": ([BALL, '<capsule radius="0.1" length="0.6"/>'], 3, []),
    "a box beside a cylinder": ([BOX, CYLINDER], 16, []),
}


@all_in_one([*product(PARTS, ["the same link", "links of their own"])])
def test_what_has_points_serves_and_the_rest_is_named_in_one_warning(of_what):
    case, on = of_what
    forms, count, left_out = PARTS[case]
    if on == "the same link":
        text = formed("foot", *forms)
    else:  # only what has no points is left out
        text = "".join(formed(f"foot{i}", form) for i, form in enumerate(forms))
        left_out = [x for x in left_out if x in ("mesh", "cone")]
        count = sum({BALL: 1, BOX: 8, CYLINDER: 8, MESH: 0, "<cone/>": 0}.get(form, 2) for form in forms)
    robot = Robot.from_urdf(also(text))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        points = robot.contact_points("foot*")
    assert len(points) == count and len(said) == bool(left_out)
    assert all(f"{kind}" in str(said[0].message) for kind in left_out)


def test_what_is_left_out_is_said_once_and_in_short():
    robot = Robot.from_urdf(also("".join(formed(f"m{i}", MESH) for i in range(9)), legs(BALL, BALL)))
    with warned(UserWarning) as seen:
        assert len(robot.contact_points("*")) == 2
    assert len(seen) == 1 and seen[0].filename == __file__
    assert "m0, m1, m2, m3, m4 and 4 more cannot touch" in str(seen[0].message)
    with warned(UserWarning) as seen:
        assert {x.frame for x in robot.contact_points(("*_foot", "m8"))} == {"left_foot", "right_foot"}
    assert "m8 cannot touch" in str(seen[0].message) and "ContactPoint('m8'" in str(seen[0].message)


def test_meshes_and_other_geoms_are_refused_by_name():
    text = """<mujoco><asset><mesh name="sole" file="none.stl"/></asset><worldbody><geom type="plane" size="1 1 1"/>
      <body name="foot"><joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <geom type="mesh" mesh="sole" {}/><geom name="toe" size="0.1"/></body></worldbody></mujoco>"""
    assert len(Robot.from_mjcf(text.format('contype="0" conaffinity="0"')).contact_points("foot")) == 1
    robot = Robot.from_mjcf(text.format(""))
    assert len(robot.contact_points("toe")) == 1
    with warned(UserWarning):
        assert robot.contact_points("foot") == robot.contact_points("toe")
    for other, frame in ((robot, "world"), (Robot.from_mjcf(ARM), "rail")):
        with refused(ArgumentError):
            other.contact_points(frame)
    assert len(Robot.from_mjcf(FREE).contact_points("*")) == 10  # what stands apart from the base is none of it


# --- changed robots --------------------------------------------------------------------------------------------------


def test_points_stay_with_their_frames():
    robot = Robot.from_urdf(legs(BALL, '<box size="0.1 0.2 0.3"/>'))
    points, locked = robot.contact_points("*_foot"), robot.lock({"elbow": 0.3})
    copies = [pickle.loads(pickle.dumps(robot)), copy.deepcopy(robot), robot.to(torch.float32), robot.bake()]
    copies += [robot.replace(mass=2 * robot.mass), Robot.stack([robot, robot]), robot.subchain("upper", "left_foot")]
    for other in (*copies, locked):
        assert other.contact_points("*_foot") == points
    before = torchdq.forward_kinematics(robot, torch.tensor([0.2, 0.3]), "left_foot")
    assert torch.allclose(torchdq.forward_kinematics(locked, torch.tensor([0.2]), "left_foot"), before)
    with warned(UserWarning):
        both = two().attach(robot, "tip", prefix="x_")
    assert both.contact_points("x_*_foot") == tuple(p._replace(frame=f"x_{p.frame}") for p in points)


def test_shapes_cost_no_program_an_operation():
    """Nor another program: the compiled code is the same."""
    robots = (Robot.from_urdf(text) for text in (legs(BALL, MESH), legs("<cone/>", BALL)))
    one, other = (torchdq.compile(robot, "forward_dynamics").source("c") for robot in robots)
    assert one == other


# --- given points ----------------------------------------------------------------------------------------------------


NO_CENTRES = (1.0, 2.0), 0.1, (0.0, 0.0, float("nan")), (0.0, "0", 0.0)
NO_POINTS = [ContactPoint("tp"), *(ContactPoint("tip", center) for center in NO_CENTRES)]
NO_POINTS += [*(ContactPoint("tip", radius=x) for x in (-0.1, None)), ("tip", (0.0, 0.0, 0.0), 0.1), ContactPoint]


@all_in_one(NO_POINTS)
def test_a_point_that_is_none_is_refused(point):
    robot = torchdq.robots.load("panda")
    require_contact_point(robot, ContactPoint("tip", (0, 0.1, -1), 1))
    with refused((ArgumentError, UnknownNameError)):
        require_contact_point(robot, point)
