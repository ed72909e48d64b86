"""Doubts about units: a body in mm or kg mm^2 on a robot in m is named, and no robot that exists is doubted."""

import math
import warnings

import oracles
import pytest
import torch

import torchdq
from torchdq.robot.check import units

CLEAR = 8.0  # factor by which every robot that exists stays below what is doubted
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


@pytest.mark.parametrize(
    "scaled, found",
    [
        (
            ("com",),
            r"link 'link2': com must be in m, found it 150\.3 m .* reach at most 3 m .*; is it in mm\?$",
        ),
        (("inertia",), r"link 'link2': inertia must be in kg m\^2 .* of 100\.3 m, .* is the inertia in kg mm\^2\?$"),
        (("com", "inertia"), r"link 'link2': inertia must be in kg m\^2"),
    ],
)
def test_a_body_in_other_units_is_named_when_loaded_and_when_checked(scaled, found):
    with pytest.warns(UserWarning, match="robot 'robot' may have numbers in other units:\n  link 'link2'") as seen:
        robot = arm(*scaled)
    assert len(seen) == 1 and seen[0].filename == __file__
    with pytest.warns(UserWarning, match=found) as seen:
        robot.check()
    assert len(seen) == 1 and seen[0].filename == __file__
    (note,) = (note for note in map(str, robot.notes) if note.startswith("link 'link2'"))
    assert note in str(robot.report())


def test_a_centre_of_mass_in_cm_is_named_where_there_are_several_links():
    com, inertia = [[0.0] * 3, [40.0, 0.0, 0.0], [0.0] * 3], [[0.3, 0.0, 0.3, 0.0, 0.0, 0.3]] * 3
    with pytest.warns(UserWarning, match=r"link 'link2': com must be in m, found it 40 m from the link's frame"):
        torchdq.Robot.from_dh([0.3] * 3, [0.0] * 3, [0.0] * 3, [0.0] * 3, [1.0] * 3, com, inertia)


@pytest.mark.parametrize(
    "field, factor, found",
    [
        ("com", 1e3, r"link 'link1': com must be in m, found it 150\.3 m"),
        ("inertia", 1e6, r"link 'link1': inertia must be in kg m\^2"),
        ("X_PB_home", None, r"lengths must be in m, found 300 m from one joint to the next"),
    ],
)
def test_replaced_numbers_in_other_units_are_named_once(field, factor, found):
    robot = arm()
    value = getattr(robot, field).clone()
    value = value * factor if factor else torch.cat([value[:, :4], 1e3 * value[:, 4:]], 1)
    with pytest.warns(UserWarning, match=f"may have numbers in other units:\n  {found}") as seen:
        changed = robot.replace(**{field: value})
    assert len(seen) == 1 and seen[0].filename == __file__
    assert any(found.split(",")[0].replace("\\", "") in note for note in map(str, changed.notes))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        changed.replace(mass=2 * robot.mass)  # known by the notes
        robot.replace(**{field: value}, on_unphysical="ignore")
        robot.replace(**{field: value.clone().requires_grad_()})  # read by `check` alone, as are batches
        robot.replace(**{field: torch.stack([value, value])})


def test_a_table_of_lengths_in_mm_is_named():
    robot = torchdq.robots.load("two_link")
    bodies = {"mass": robot.mass, "com": robot.com, "inertia": robot.inertia}
    torchdq.Robot.from_dh([0.3, 0.3], [0.0, 0.0], [0.2, 0.0], [0.0, 2 * math.pi], **bodies)
    expected = r"lengths must be in m, found 360\.6 m from one joint to the next, and frames up to .* are they in mm\?"
    with pytest.warns(UserWarning, match=expected):
        torchdq.Robot.from_dh([300, 300], [0.0, 0.0], [200, 0.0], [0.0, 0.0], **bodies)


def hinge(lower, upper, kind="revolute", rpy="0 0 0"):
    """Text of an arm of one joint."""
    return (
        f'<robot name="r"><link name="base"/><link name="rod"><inertial><mass value="1"/><origin xyz="0.3 0 0"/>'
        f'<inertia ixx="1e-4" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j" '
        f'type="{kind}"><parent link="base"/><child link="rod"/><axis xyz="0 0 1"/><origin rpy="{rpy}"/>'
        f'<limit lower="{lower}" upper="{upper}" velocity="1" effort="1"/></joint></robot>'
    )


@pytest.mark.parametrize("lower, upper", [(-170, 170), (-45, 0.0), (0.0, 360), (-1e16, 90)])
def test_limits_in_degrees_are_doubted(lower, upper):
    with pytest.warns(UserWarning, match=r"joint 'j': limits must be in rad, found .* are they in degrees\?") as seen:
        robot = torchdq.Robot.from_urdf(hinge(lower, upper))
    assert len(seen) == 1 and "are they in degrees?" in str(robot.report())


@pytest.mark.parametrize(
    "lower, upper, kind",
    [(-6.3, 6.3, "revolute"), (-10, 10, "revolute"), (-1e16, 1e16, "revolute"), (-170, 170, "continuous")],
)
def test_limits_of_some_turns_and_those_that_stand_for_none_are_not_doubted(lower, upper, kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchdq.Robot.from_urdf(hinge(lower, upper, kind))


def test_replaced_limits_in_degrees_are_doubted_and_those_of_a_slide_are_not():
    robot = torchdq.Robot.from_urdf(hinge(-1, 1))
    with pytest.warns(UserWarning, match="are they in degrees"):
        robot.replace(limits=robot.limits._replace(upper=double([180.0])))
    slide = torchdq.Robot.from_urdf(hinge(-1, 1, "prismatic"))
    assert units.doubts(slide.replace(limits=slide.limits._replace(upper=double([25.0]))), quiet=True) == []


def test_placements_in_degrees_are_doubted():
    told = r"joint 'j': rpy must be in rad, found 0 0 90; is it in degrees\?"
    with pytest.warns(UserWarning, match=told) as seen:
        robot = torchdq.Robot.from_urdf(hinge(-1, 1, rpy="0 0 90"))
    assert len(seen) == 1 and seen[0].filename == __file__ and "is it in degrees?" in str(robot.report())
    with pytest.warns(UserWarning, match="link 'rod': rpy of its inertial must be in rad, found -180 0 0"):
        torchdq.Robot.from_urdf(hinge(-1, 1).replace('xyz="0.3 0 0"', 'rpy="-180 0 0"'))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchdq.Robot.from_urdf(hinge(-1, 1, rpy="0 0 6.28318"))
        torchdq.Robot.from_urdf(hinge(-1, 1, rpy="0 0 90"), on_unphysical="ignore")


def test_ranges_in_radians_in_a_file_in_degrees_are_doubted():
    pytest.importorskip("mujoco")
    text = (
        "<mujoco>{}<worldbody><body name='a'><joint name='j' range='-1.57 {}'/><geom size='0.1'/></body></worldbody>"
        "</mujoco>"
    )
    told = r"ranges of hinges must be in degrees .*, found none beyond 3\.14; are they in radians\?"
    with pytest.warns(UserWarning, match=told):
        robot = torchdq.Robot.from_mjcf(text.format("", "3.14"))
    assert "are they in radians?" in str(robot.report())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchdq.Robot.from_mjcf(text.format("", "90"))
        torchdq.Robot.from_mjcf(text.format("<compiler angle='radian'/>", "3.14"))


def test_a_long_chain_of_short_links_is_not_doubted():
    n = 400
    bodies = {"mass": [1.0] * n, "com": [[0.1, 0.0, 0.0]] * n, "inertia": [[0.01, 0.0, 0.01, 0.0, 0.0, 0.01]] * n}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchdq.Robot.from_dh([0.3] * n, [0.0] * n, [0.0] * n, [0.0] * n, **bodies)


def test_what_is_unphysical_by_consent_is_only_noted():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = arm("com", on_unphysical="ignore")
    assert "is it in mm?" in str(robot.report())


@pytest.mark.parametrize("name", ["panda", "ur10e", "puma560"])
def test_inertias_a_thousand_times_too_large_are_doubted(name):
    robot = torchdq.robots.load(name)
    told = r"(inertias must be in kg m\^2|link '\w+': inertia must be in kg m\^2) .* in g m\^2 or in kg cm\^2\?"
    with pytest.warns(UserWarning, match=told):
        large = robot.replace(inertia=1e3 * robot.inertia)
    assert "in g m^2 or in kg cm^2?" in str(large.report())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot.replace(inertia=10 * robot.inertia)


def test_one_inertia_a_thousand_times_too_large_is_doubted_where_no_link_is_so_large():
    with pytest.warns(UserWarning, match=r"link 'link2': inertia must be in kg m\^2 .* in g m\^2 or in kg cm\^2\?"):
        arm("inertia", factor=90.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # a disc on a short axle, and a rod on one
        disc = {"mass": [1.0], "com": [[0.0, 0, 0]], "inertia": [[0.5, 0, 0.5, 0, 0, 1.0]]}
        torchdq.Robot.from_dh([0.05], [0.0], [0.0], [0.0], **disc)
        rods = {"mass": [1.0] * 3, "com": [[0.5, 0, 0]] * 3, "inertia": [[1e-4, 0, 0.09, 0, 0, 0.09]] * 3}
        torchdq.Robot.from_dh([0.05] * 3, [0.0] * 3, [0.0] * 3, [0.0] * 3, **rods)


def test_a_batch_is_doubted_for_one_of_its_robots():
    robot = arm()
    batch = robot.replace(com=torch.stack([robot.com, robot.com * double([[1.0], [1.0], [1e3]])]))
    with pytest.warns(UserWarning, match=r"link 'link3': com must be in m, found it 150\.3 m"):
        batch.check()


def test_every_file_in_mm_of_an_arm_of_one_link_is_doubted():
    """Without joints at a distance, the size of the body itself is what its centre of mass is compared with."""
    text = (
        '<robot name="r"><link name="base"/><link name="rod"><inertial><mass value="1"/><origin xyz="{} 0 0"/>'
        '<inertia ixx="1e-4" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j" '
        'type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 0 1"/></joint></robot>'
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchdq.Robot.from_urdf(text.format(0.3)).check()
        with pytest.raises(UserWarning, match="com must be in m, found it 300 m"):
            torchdq.Robot.from_urdf(text.format(300))


def silent(robot):
    """Whether a robot stays undoubted with limits that are lower by a clear factor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(units, "TURNS", (0.55 * units.TURNS[0], 1.3 * units.TURNS[1]))  # some legs turn 10 rad
        for limit in ("LONG", "STEP", "FAR", "LARGE", "SLENDER"):
            patch.setattr(units, limit, getattr(units, limit) / CLEAR)
        for limit in ("BULKY", "HEAVY"):
            patch.setattr(units, limit, getattr(units, limit) / CLOSER)
        return units.doubts(robot, quiet=True) == []


@pytest.mark.parametrize("name", EXISTING)
def test_no_robot_that_exists_is_doubted(name):
    assert silent(torchdq.Robot.from_urdf(oracles.urdf_paths()[name], on_unphysical="ignore"))


@pytest.mark.parametrize("name", torchdq.robots.names())
def test_no_shipped_robot_is_doubted(name):
    assert silent(torchdq.robots.load(name))


def test_an_arm_in_its_units_is_not_doubted():
    assert silent(arm())
