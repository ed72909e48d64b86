"""Suspicions about units: a body in mm or kg mm^2 on a robot in m is named, and no robot that exists is suspected."""

import math
import warnings

import oracles
import pytest
import torch
from messages import refused, warned
from urdf_text import codes, joint, link, urdf

import torchdq
from torchdq.robot.check import units

CLEAR = 8.0  # factor by which every robot that exists stays below what is suspected
CLOSER = 1.6  # the same for sizes of bodies, which placeholders of existing files come close to
EXISTING = [name for name in oracles.urdf_paths() if name not in oracles.UNREADABLE]


def double(x):
    return torch.tensor(x, dtype=torch.float64)


def arm(*scaled, factor=1e3, **given):
    """Arm of three links of 0.3 m, with quantities of the second one in other units."""
    bodies = {
        "mass": double([1.0, 0.8, 0.5]),
        "com": double([[0.15, 0.01, 0.0]] * 3),
        "inertia": double([[1e-4, 0.0, 8e-3, 0.0, 0.0, 8e-3]] * 3),
    }
    for name in scaled:
        bodies[name][1] *= factor**2 if name == "inertia" else factor
    tip = double([1.0, 0, 0, 0, 0, 0.15, 0, 0])
    return torchdq.Robot.from_dh([0.3] * 3, [0.0] * 3, [0.0] * 3, [0.0] * 3, **bodies, tip_pose=tip, **given)


def suspicions(robot):
    """Codes and subjects of the notes about units."""
    return {x for x in codes(robot) if x[0].startswith("units.")}


def hinge(lower=-1, upper=1, kind="revolute", com=(0.3, 0, 0), rpy=(0, 0, 0), turned=(0, 0, 0)):
    """Text of an arm of one joint."""
    rod = link("rod", 1, (1e-4, 0, 0.03, 0, 0, 0.03), com, turned)
    limit = f'<limit lower="{lower}" upper="{upper}" velocity="1" effort="1"/>'
    return urdf(link("base", None), rod, joint("j", "base", "rod", kind, rpy=rpy, more=limit))


@pytest.fixture
def silent():
    """Every warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize(
    ("scaled", "code"),
    [
        (("com",), "units.com"),
        (("inertia",), "units.inertia"),
        (("com", "inertia"), "units.inertia"),
    ],
)
def test_a_body_in_other_units_is_named_when_loaded_and_when_checked(scaled, code):
    with warned(UserWarning) as seen:
        robot = arm(*scaled)
    assert len(seen) == 1 and seen[0].filename == __file__
    with warned(UserWarning) as seen:
        robot.check()
    assert len(seen) == 1 and seen[0].filename == __file__ and suspicions(robot) == {(code, "link 'link2'")}


@pytest.mark.parametrize(
    "field, factor, found",
    [
        ("com", 1e3, ("units.com", "link 'link1'")),
        ("inertia", 1e6, ("units.inertia", "link 'link1'")),
        ("X_PB_home", None, ("units.length", "")),
    ],
)
def test_replaced_numbers_in_other_units_are_named_once(field, factor, found):
    robot = arm()
    value = getattr(robot, field).clone()
    value = value * factor if factor else torch.cat([value[:, :4], 1e3 * value[:, 4:]], 1)
    with warned(UserWarning) as seen:
        changed = robot.replace(**{field: value})
    assert len(seen) == 1 and seen[0].filename == __file__ and found in suspicions(changed)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        changed.replace(mass=2 * robot.mass)  # known by the notes
        robot.replace(**{field: value}, on_unphysical="ignore")
        robot.replace(**{field: value.clone().requires_grad_()})  # read by `check` alone, as are batches
        robot.replace(**{field: torch.stack([value, value])})


def test_a_table_of_lengths_in_mm_is_named(silent):
    robot = torchdq.robots.load("two_link")
    bodies = {"mass": robot.mass, "com": robot.com, "inertia": robot.inertia}
    torchdq.Robot.from_dh([0.3, 0.3], [0.0, 0.0], [0.2, 0.0], [0.0, 2 * math.pi], **bodies)
    with refused(UserWarning):
        torchdq.Robot.from_dh([300, 300], [0.0, 0.0], [200, 0.0], [0.0, 0.0], **bodies)


@pytest.mark.parametrize("lower, upper", [(-170, 170), (-45, 0.0), (0.0, 360), (-1e16, 90)])
def test_limits_in_degrees_are_suspected(lower, upper):
    with warned(UserWarning) as seen:
        robot = torchdq.Robot.from_urdf(hinge(lower, upper))
    assert len(seen) == 1 and suspicions(robot) == {("units.degrees", "joint 'j'")}


@pytest.mark.parametrize(
    "lower, upper, kind",
    [(-6.3, 6.3, "revolute"), (-10, 10, "revolute"), (-1e16, 1e16, "revolute"), (-170, 170, "continuous")],
)
def test_limits_of_some_turns_and_those_that_stand_for_none_are_not_suspected(lower, upper, kind, silent):
    torchdq.Robot.from_urdf(hinge(lower, upper, kind))


def test_replaced_limits_in_degrees_are_suspected_and_those_of_a_slide_are_not(silent):
    robot, slide = (torchdq.Robot.from_urdf(hinge(kind=kind)) for kind in ("revolute", "prismatic"))
    slide.replace(limits=slide.limits._replace(upper=double([25.0])))
    with refused(UserWarning):
        robot.replace(limits=robot.limits._replace(upper=double([180.0])))


def test_placements_in_degrees_are_suspected(silent):
    for angles in ({"rpy": (0, 0, 90)}, {"turned": (-180, 0, 0)}):
        robot = torchdq.Robot.from_urdf(hinge(**angles), on_unphysical="ignore")
        about = "joint 'j'" if "rpy" in angles else "link 'rod'"
        assert suspicions(robot) == {("units.degrees", about)} and "is it in degrees?" in str(robot.report())
        with refused(UserWarning):
            torchdq.Robot.from_urdf(hinge(**angles))
    torchdq.Robot.from_urdf(hinge(rpy=(0, 0, 6.28318)))


def test_ranges_in_radians_in_a_file_in_degrees_are_suspected(silent):
    pytest.importorskip("mujoco")
    text = (
        "<mujoco>{}<worldbody><body name='a'><joint name='j' range='-1.57 {}'/><geom size='0.1'/></body></worldbody>"
        "</mujoco>"
    )
    with refused(UserWarning):
        torchdq.Robot.from_mjcf(text.format("", "3.14"))
    assert suspicions(torchdq.Robot.from_mjcf(text.format("", "3.14"), on_unphysical="ignore"))
    torchdq.Robot.from_mjcf(text.format("", "90"))
    torchdq.Robot.from_mjcf(text.format("<compiler angle='radian'/>", "3.14"))


def test_a_long_chain_of_short_links_is_not_suspected(silent):
    n = 400
    bodies = {"mass": [1.0] * n, "com": [[0.1, 0.0, 0.0]] * n, "inertia": [[0.01, 0.0, 0.01, 0.0, 0.0, 0.01]] * n}
    torchdq.Robot.from_dh([0.3] * n, [0.0] * n, [0.0] * n, [0.0] * n, **bodies)


def test_what_is_unphysical_by_consent_is_only_noted(silent):
    assert suspicions(arm("com", on_unphysical="ignore")) == {("units.com", "link 'link2'")}


@pytest.mark.parametrize("name", ["panda", "ur10e", "puma560"])
def test_inertias_a_thousand_times_too_large_are_suspected(name, silent):
    robot = torchdq.robots.load(name)
    robot.replace(inertia=10 * robot.inertia)
    with refused(UserWarning):
        robot.replace(inertia=1e3 * robot.inertia)


def test_one_inertia_a_thousand_times_too_large_is_suspected_where_no_link_is_so_large(silent):
    with refused(UserWarning):
        arm("inertia", factor=90.0)
    # a disc on a short axle, and rods on short ones
    disc = {"mass": [1.0], "com": [[0.0, 0, 0]], "inertia": [[0.5, 0, 0.5, 0, 0, 1.0]]}
    torchdq.Robot.from_dh([0.05], [0.0], [0.0], [0.0], **disc)
    rods = {"mass": [1.0] * 3, "com": [[0.5, 0, 0]] * 3, "inertia": [[1e-4, 0, 0.09, 0, 0, 0.09]] * 3}
    torchdq.Robot.from_dh([0.05] * 3, [0.0] * 3, [0.0] * 3, [0.0] * 3, **rods)


def test_a_batch_is_suspected_for_one_of_its_robots():
    robot = arm()
    batch = robot.replace(com=torch.stack([robot.com, robot.com * double([[1.0], [1.0], [1e3]])]))
    with warned(UserWarning):
        batch.check()


def test_a_file_in_mm_of_an_arm_of_one_link_is_suspected(silent):
    """Without joints at a distance, the size of the body itself is what its centre of mass is compared with."""
    torchdq.Robot.from_urdf(hinge(kind="continuous")).check()
    with refused(UserWarning):
        torchdq.Robot.from_urdf(hinge(kind="continuous", com=(300, 0, 0)))


def clear(robot):
    """Whether a robot stays unsuspected with limits that are lower by a clear factor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(units, "TURNS", (0.55 * units.TURNS[0], 1.3 * units.TURNS[1]))  # some legs turn 10 rad
        for limit in ("STEP", "FAR", "LARGE", "SLENDER"):
            patch.setattr(units, limit, getattr(units, limit) / CLEAR)
        patch.setattr(units, "HEAVY", units.HEAVY / CLOSER)
        return units.diagnostics(robot) == []


@pytest.mark.parametrize("name", EXISTING)
def test_no_robot_that_exists_is_suspected(name):
    assert clear(torchdq.Robot.from_urdf(oracles.urdf_paths()[name], on_unphysical="ignore"))


def test_no_shipped_robot_and_no_arm_in_its_units_is_suspected():
    assert all(clear(torchdq.robots.load(name)) for name in torchdq.robots.names()) and clear(arm())
