"""Robots with some fields replaced: shapes, kinds and values of what is given are checked, as a file's are."""

import dataclasses
import math

import messages
import pytest
import torch
from helpers import all_in_one, thinned
from robots import ARMS, F64, panda, row, same, torques, two

import torchdq
from torchdq import ArgumentError, DescriptionError, DtypeError, Robot, UnknownNameError, UnphysicalError, dq
from torchdq.robot import Frame


def test_replace_shares_the_rest():
    robot = panda()
    heavier = robot.replace(mass=2 * robot.mass)
    assert heavier.com is robot.com and torch.equal(heavier.mass, 2 * robot.mass)


POSE = row(2, 0, 0, 0, 0, 0, 0, 0)
UNPHYSICAL = {  # changed fields, and code and subject of the fault
    "negative mass": ({"mass": row(1, -1)}, "mass.negative", "link 'link2'"),
    "mass of nan": ({"mass": row(math.nan, 1)}, "body.finite", "link 'link1'"),
    "negative inertia": ({"inertia": -two().inertia}, "inertia.indefinite", "link 'link1'"),
    "inertia without mass": ({"mass": row(1, 0)}, "inertia.massless", "link 'link2'"),
    "com of inf": ({"com": two().com + math.inf}, "com.value", ""),
    "home of nan": ({"home": row(0, math.nan)}, "home.value", ""),
    "gravity of nan": ({"gravity": row(0, 0, math.nan)}, "gravity.value", ""),
    **{name: ({name: row(0, -1)}, f"{name}.value", "") for name in ("armature", "damping", "friction")},
    "effort": ({"limits": two().limits._replace(effort=row(1, -1))}, "effort limit.value", ""),
    "velocity": ({"limits": two().limits._replace(velocity=row(1, math.nan))}, "velocity limit.value", ""),
    "crossed": ({"limits": two().limits._replace(lower=row(9, 9), upper=row(0, 0))}, "lower limit.value", ""),
    "long screw": ({"screw": 2 * two().screw}, "screw.kind", "joint 'joint1'"),
    "screw with pitch": ({"screw": two().screw + row(0, 0, 0, 0, 0, 0.1)}, "screw.kind", "joint 'joint1'"),
    "no screw": ({"screw": 0 * two().screw}, "screw.kind", "joint 'joint1'"),
    "screw of nan": ({"screw": math.nan * two().screw}, "screw.kind", "joint 'joint1'"),
    "kinds and screws": ({"kinds": ("revolute", "prismatic")}, "screw.kind", "joint 'joint2'"),
    "long pose": ({"X_PB_home": 2 * two().X_PB_home}, "pose.unit", ""),
    "long frame": ({"frames": (Frame("tip", 1, POSE),)}, "pose.unit", "frame 'tip'"),
}


@all_in_one(UNPHYSICAL)
def test_replace_checks_values_as_a_file_is_checked(case):
    changes, *expected = UNPHYSICAL[case]
    with messages.refused(UnphysicalError) as refused:
        two().replace(**changes)
    fault = refused.value.findings[0]
    assert [fault.code, fault.subject] == expected
    with messages.warned(UserWarning) as warned:
        robot = two().replace(**changes, on_unphysical="warn")
    assert warned[0].filename == __file__ and str(robot.report().notes[0]) == str(fault)
    with pytest.raises(UnphysicalError) as refused:
        two().replace(**changes, on_unphysical="ignore").check()
    assert str(refused.value.findings[0]) == str(fault)


LONG, BENT = row(2, 0, 0, 0, 0, 0.2, 0, 0), row(1, 0, 0, 0, 0.5, 0, 0, 0)  # |r| = 2, and a dual part that is no pose's
BODIES = {"mass": [1.0], "com": [[0.1, 0.0, 0.0]], "inertia": [[0.01, 0, 0.01, 0, 0, 0.01]]}
GIVEN_POSES = {
    "pose": lambda x: two().with_tool("pen", x),
    "base_pose": lambda x: two().attach(two(), "tip", prefix="o_", base_pose=x),
    "tip_pose": lambda x: Robot.from_screws([[0, 0, 1, 0, 0, 0]], **BODIES, tip_pose=x),
    "link_poses": lambda x: Robot.from_screws([[0, 0, 1, 0, 0, 0]], **BODIES, link_poses=x.unsqueeze(0)),
    "tip_pose of dh": lambda x: Robot.from_dh([0.1], [0.0], [0.0], [0.0], **BODIES, tip_pose=x),
}


@pytest.mark.filterwarnings("ignore:robot 'two_link' has no body of its base")
@all_in_one(GIVEN_POSES)
def test_a_pose_that_is_not_unit_is_refused_not_normalised(argument):
    make, name = GIVEN_POSES[argument], argument.partition(" ")[0]
    error = ArgumentError if name in ("pose", "base_pose") else DescriptionError
    for wrong in (LONG, BENT, LONG.to(torch.float32), 0 * LONG):
        with messages.refused(error):
            make(wrong)
    with messages.refused(error):
        make(LONG[:7])
    # a pose in single precision is unit up to its rounding, which goes
    turned = dq.exp(row(0.3, -0.2, 0.5, 0.1, 0.7, -0.4))
    for robot in (make(turned), make(turned.float())):
        assert all(abs(float(frame.X_BF[:4].norm()) - 1) < 1e-15 for frame in robot.frames)
    for exact, rounded in zip(make(turned).frames, make(turned.float()).frames, strict=True):
        assert torch.allclose(exact.X_BF, rounded.X_BF, rtol=0, atol=2**-23)


SHAPES = [("mass", (6,)), ("mass", (2, 1)), ("mass", ()), ("com", (2,)), ("inertia", (2, 3, 3)), ("X_PB_home", (8,))]
SHAPES += [("screw", (6, 6)), ("gravity", (2,)), ("home", (1,)), ("armature", (8,))]
BROKEN = [
    *({name: torch.zeros(shape, dtype=F64)} for name, shape in SHAPES),
    *({"mass": x} for x in (None, [1.0] * 2, 3.0, torch.ones(2, dtype=torch.int64))),
    {"frames": (Frame("tip", 2, two().frames[0].X_BF),)},  # beyond the links
    *({"damping": torch.ones(5)}, {"friction": torch.ones(2, dtype=torch.int64)}, {"limits": 5}, {"name": 3}),
    *({"joint_names": ("a", "a")}, {"link_names": ["a", "b"]}, {"parents": (1, 0)}, {"kinds": ("ball", "ball")}),
    *({"tip": 3}, {"tip": "tool"}, {"notes": "none"}, {"masses": two().mass}),
]


@pytest.mark.case("P7")
@all_in_one(range(len(BROKEN)))
def test_replace_checks_names_shapes_and_structure(k):
    with messages.refused((ArgumentError, DtypeError, UnknownNameError)):
        two().replace(**BROKEN[k])


@all_in_one(thinned(ARMS, ["two_link", "puma560"]))
def test_every_field_can_be_replaced_by_itself(name):
    robot = torchdq.robots.load(name)
    single = robot.to(torch.float32)
    for field in (f.name for f in dataclasses.fields(robot) if not f.name.startswith("_")):
        assert same(torques(robot.replace(**{field: getattr(robot, field)})), torques(robot))
        assert single.replace(**{field: getattr(single, field)}).n == robot.n


def test_learned_and_transformed_values_are_read_by_check_alone():
    mass = -torch.ones(2, dtype=F64)
    learned = two().replace(mass=mass.clone().requires_grad_())
    torch.func.vmap(lambda m: torchdq.inverse_dynamics(two().replace(mass=m), torch.ones(2, dtype=F64)))(mass[None])
    for robot in (learned, two().replace(mass=mass[None])):
        with messages.refused(UnphysicalError):
            robot.check()
    with messages.refused(UnphysicalError):  # a joint without inertia
        two().replace(mass=row(1, 0), inertia=row(0, 0, 0, 0, 0, 0).expand(2, 6)).check()
