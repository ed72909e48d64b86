"""Converters to other libraries' conventions: each against the library itself, and there and back."""

import math

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one, random
from messages import refused
from scipy.spatial.transform import RigidTransform, Rotation

from torchdq import convert, dq
from torchdq.errors import ArgumentError, DtypeError

EPS = 2.0**-52
SIZE = 10  # of the positions and products compared here


def poses(*batch, seed=0):
    return dq.from_pose(dq.normalize(random(*batch, 4, seed=seed)), random(*batch, 3, seed=seed + 1))


def near(found, expected, tolerance=32 * EPS * SIZE):
    np.testing.assert_allclose(np.asarray(found), np.asarray(expected), rtol=0, atol=tolerance)


def near_pose(found, expected, tolerance=32 * EPS * SIZE):
    """The same poses, whatever the signs."""
    sign = torch.where((found * expected)[..., :4].sum(-1, keepdim=True) < 0, -1.0, 1.0)
    near(sign * found, expected, tolerance)


# --- there and back --------------------------------------------------------------------------------------------------


def test_orders_there_and_back_are_exact():
    a, r = random(3, 2, 6), random(3, 2, 4)
    assert convert.motion_from_pinocchio(convert.motion_to_pinocchio(a)).equal(a)
    assert convert.from_xyzw(convert.to_xyzw(r)).equal(r)
    assert convert.to_xyzw(convert.from_xyzw(r)).equal(r)
    assert not convert.to_xyzw(convert.to_xyzw(r)).equal(r)


@all_in_one([(), (4,), (2, 3), (0,)])
def test_mujoco_and_scipy_there_and_back(batch):
    x = poses(*batch)
    position, rotation = convert.to_mujoco(x)
    assert (position.shape, rotation.shape) == ((*batch, 3), (*batch, 4))
    near(convert.from_mujoco(position, rotation), x)
    back = convert.from_scipy(convert.to_scipy(x))
    assert back.shape == x.shape
    near_pose(back, x)


def test_pinocchio_there_and_back():
    for x in poses(10):
        near_pose(convert.from_pinocchio(convert.to_pinocchio(x)), x)
        assert convert.from_pinocchio(convert.to_pinocchio(x))[0] >= 0


@all_in_one([torch.float32, torch.float64])
def test_the_dtype_is_the_one_asked_for(dtype):
    x = poses(3)
    for found in (
        convert.from_scipy(convert.to_scipy(x.to(dtype)), dtype=dtype),
        torch.stack([convert.from_pinocchio(convert.to_pinocchio(row), dtype=dtype) for row in x.to(dtype)]),
        convert.from_mujoco(*convert.to_mujoco(x.to(dtype))),
    ):
        assert found.dtype == dtype
        near_pose(found.double(), x, 16 * torch.finfo(dtype).eps * SIZE)


# --- against the libraries -------------------------------------------------------------------------------------------


def test_isaac_order_is_that_of_scipy_rotations_and_pinocchio_coefficients():
    r = dq.normalize(random(5, 4))
    near(Rotation.from_quat(convert.to_xyzw(r).numpy()).as_matrix(), dq.to_rotation_matrix(r))
    for row in r:
        near(pin.Quaternion(*row.tolist()).coeffs(), convert.to_xyzw(row))
    q = Rotation.from_matrix(dq.to_rotation_matrix(r).numpy()).as_quat()
    near(dq.to_rotation_matrix(convert.from_xyzw(torch.tensor(q))), dq.to_rotation_matrix(r))


def test_scipy_transforms_points_and_composes_as_we_do():
    x, y, p = poses(5), poses(5, seed=2), random(5, 3, seed=4)
    there = dq.rotate(dq.rotation(x), p) + dq.translation(x)
    near(convert.to_scipy(x).apply(p.numpy()), there)
    near(convert.to_scipy(x).as_matrix(), dq.to_matrix(x))
    near_pose(convert.from_scipy(convert.to_scipy(x) * convert.to_scipy(y)), dq.mul(x, y))
    made = RigidTransform.from_components(translation=p.numpy(), rotation=Rotation.from_rotvec([0.0, 0.0, math.pi / 3]))
    quarter = torch.tensor([math.cos(math.pi / 6), 0.0, 0.0, math.sin(math.pi / 6)], dtype=torch.float64)
    near_pose(convert.from_scipy(made), dq.from_pose(quarter.expand(5, 4), p))


def test_pinocchio_placements_act_and_compose_as_poses_do():
    for x, y, p in zip(poses(5), poses(5, seed=2), random(5, 3, seed=4), strict=True):
        placement = convert.to_pinocchio(x)
        near(placement.act(p.numpy()), dq.rotate(dq.rotation(x), p) + dq.translation(x))
        near_pose(convert.from_pinocchio(placement * convert.to_pinocchio(y)), dq.mul(x, y))
        near_pose(convert.from_pinocchio(placement.inverse()), dq.conj(x))


def test_pinocchio_motions_are_swapped_and_forces_are_not():
    x, twist, wrench = poses(), random(6), random(6, seed=1)
    motion, force = pin.Motion(convert.motion_to_pinocchio(twist).numpy()), pin.Force(wrench.numpy())
    near(motion.angular, twist[:3])
    near(motion.linear, twist[3:])
    near(force.linear, wrench[:3])
    near(force.angular, wrench[3:])
    near(force.dot(motion), dq.paper.power(wrench, twist))
    placement = convert.to_pinocchio(x)
    near(convert.motion_from_pinocchio(torch.tensor(placement.act(motion).vector)), dq.ad(x, twist))
    near(placement.act(force).vector, dq.ad(x, wrench))
    # the same screws, so that the cross product of two twists is the one of two motions
    other = pin.Motion(convert.motion_to_pinocchio(wrench).numpy())
    near(convert.motion_from_pinocchio(torch.tensor(motion.cross(other).vector)), dq.paper.cross(twist, wrench))


BODIES = """
<mujoco><worldbody>
  <body name="b" pos="{}" quat="{}"><geom type="sphere" size="0.1"/>
    <body name="c" pos="{}" quat="{}"><geom type="sphere" size="0.1"/></body>
  </body>
</worldbody></mujoco>"""


def test_mujoco_places_bodies_where_our_poses_do():
    X_WB, X_BC = poses(2)
    text = [" ".join(f"{v:.17g}" for v in part) for x in (X_WB, X_BC) for part in convert.to_mujoco(x)]
    model = mujoco.MjModel.from_xml_string(BODIES.format(*text))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = convert.from_mujoco(data.xpos, data.xquat)
    assert found.shape == (3, 8)
    near_pose(found[1:], torch.stack([X_WB, dq.mul(X_WB, X_BC)]))
    near(data.xmat[1:].reshape(2, 3, 3), dq.to_rotation_matrix(dq.rotation(found[1:])))


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("f", "name", "size"),
    [
        (convert.to_xyzw, "r", 4),
        (convert.from_xyzw, "r", 4),
        (convert.to_mujoco, "x", 8),
        (convert.to_scipy, "x", 8),
        (convert.to_pinocchio, "x", 8),
        (convert.motion_to_pinocchio, "twist", 6),
        (convert.motion_from_pinocchio, "motion", 6),
        (lambda v: convert.from_mujoco(v, torch.ones(4)), "position", 3),
        (lambda v: convert.from_mujoco(torch.ones(3), v), "rotation", 4),
    ],
)
def test_wrong_arguments_are_named(f, name, size):
    with refused(ArgumentError):
        f(torch.ones(2, 5))
    with refused(DtypeError):
        f(torch.ones(size, dtype=torch.int64))


def test_pinocchio_holds_one_pose_only():
    with refused(ArgumentError):
        convert.to_pinocchio(poses(2))
