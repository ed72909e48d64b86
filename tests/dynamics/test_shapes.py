"""Distances to shapes are MuJoCo's, and normals their gradients."""

import mujoco
import numpy as np
import pytest

from torchdq.dynamics import shapes

SHAPES = {
    "ball": ("sphere", (0.3,), lambda p: shapes.ball(0.3, p)),
    "capsule": ("capsule", (0.2, 0.4), lambda p: shapes.capsule(0.2, 0.4, p)),
    "box": ("box", (0.2, 0.3, 0.5), lambda p: shapes.box((0.2, 0.3, 0.5), 0.0, p)),
    "cylinder": ("cylinder", (0.2, 0.4), lambda p: shapes.cylinder(0.2, 0.4, p)),
}
TOUCHING = 0.05  # radius of the sphere that measures the distance [m]


def distance_in_mujoco(kind, size, p):
    geom = f'<geom type="{kind}" size="{" ".join(map(str, size))}"/>'
    probe = f'<body pos="{p[0]} {p[1]} {p[2]}"><freejoint/><geom type="sphere" size="{TOUCHING}"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geom}{probe}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return mujoco.mj_geomDistance(model, data, 0, 1, 10.0, None) + TOUCHING


@pytest.mark.parametrize("shape", SHAPES)
def test_the_distance_of_a_point_outside_is_that_of_mujoco(shape):
    kind, size, nearest = SHAPES[shape]
    points = np.random.default_rng(0).normal(size=(40, 3))
    outside = [p for p in points if nearest(tuple(map(float, p))).distance > TOUCHING]
    assert len(outside) > 20
    for p in outside:
        found = nearest(tuple(map(float, p))).distance
        assert found == pytest.approx(distance_in_mujoco(kind, size, p), abs=1e-6)  # which iterates for cylinders


@pytest.mark.parametrize("shape", SHAPES)
def test_the_normal_is_the_gradient_of_the_distance_inside_too(shape):
    nearest, step = SHAPES[shape][2], 1e-6
    for p in np.random.default_rng(1).uniform(-0.6, 0.6, (60, 3)):
        found = nearest(tuple(map(float, p)))
        ways = [nearest(tuple(map(float, p + d))).distance for d in (*step * np.eye(3), *-step * np.eye(3))]
        assert np.array(found.normal) == pytest.approx(np.subtract(ways[:3], ways[3:]) / (2 * step), abs=1e-7)
        assert np.dot(found.normal, found.normal) == pytest.approx(1.0, abs=1e-12)


def test_a_point_inside_a_box_is_as_deep_as_its_nearest_face():
    normal, distance = shapes.box((1.0, 2.0, 3.0), 0.0, (0.2, -1.9, 0.5))
    assert (normal, distance) == ((0.0, -1.0, 0.0), pytest.approx(-0.1))


def test_a_rounded_box_keeps_its_faces_and_loses_its_corners():
    sharp, rounded = (shapes.box((0.2, 0.2, 0.2), r, (0.3, 0.0, 0.0)).distance for r in (0.0, 0.05))
    assert sharp == pytest.approx(rounded) == pytest.approx(0.1)
    corner = shapes.box((0.2, 0.2, 0.2), 0.05, (0.2, 0.2, 0.2)).distance
    assert corner == pytest.approx(0.05 * (3**0.5 - 1.0))
