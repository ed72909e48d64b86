"""Suspicions about units: a body in mm or kg mm^2 on a robot in m is named, and no robot that exists is suspected."""

import math
import warnings

import oracles
import pytest
import torch
from helpers import all_in_one, thinned
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


@all_in_one([(("com",), "com"), (("inertia",), "inertia"), (("com", "inertia"), "inertia")])
def test_a_body_in_other_units_is_named_when_loaded_and_when_checked(case):
    scaled, code = case
    with warned(UserWarning) as seen:
        robot = arm(*scaled)
    assert len(seen) == 1 and seen[0].filename == __file__
    with warned(UserWarning) as seen:
        robot.check()
    assert len(seen) == 1 and seen[0].filename == __file__
    assert suspicions(robot) == {(f"units.{code}", "link 'link2'")}


REPLACED = {
    "com": (1e3, ("units.com", "link 'link1'")),
    "inertia": (1e6, ("units.inertia", "link 'link1'")),
    "X_PB_home": (double([1.0] * 4 + [1e3] * 4), ("units.length", "")),
}


@all_in_one(REPLACED)
def test_replaced_numbers_in_other_units_are_named_once(field):
    robot, (factor, found) = arm(), REPLACED[field]
    value = getattr(robot, field) * factor
    with warned(UserWarning) as seen:
        changed = robot.replace(**{field: value})
    assert len(seen) == 1 and seen[0].filename == __file__ and found in suspicions(changed)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        changed.replace(mass=2 * robot.mass)  # known by the notes
        robot.replace(**{field: value}, on_unphysical="ignore")
        robot.replace(**{field: value.clone().requires_grad_()})  # read by `check` alone, as are batches
        robot.replace(**{field: torch.stack([value, value])})


@all_in_one([(-170, 170), (-45, 0.0), (0.0, 360), (-1e16, 90)])
def test_limits_in_degrees_are_suspected(limits):
    with warned(UserWarning) as seen:
        robot = torchdq.Robot.from_urdf(hinge(*limits))
    assert len(seen) == 1 and suspicions(robot) == {("units.degrees", "joint 'j'")}


def test_limits_of_some_turns_and_those_that_stand_for_none_are_not_suspected(silent):
    for x in (6.3, 10, 31.4, 62.83, 99, 100, 314.159, 628.3185, 999, 1e3, 1e16, math.inf):
        torchdq.Robot.from_urdf(hinge(-x, x))
    torchdq.Robot.from_urdf(hinge(-170, 170, "continuous"))


def legged(*ends):
    """Text of a chain of turning joints with these limits on both sides."""
    rows = [link("l0", None)]
    for i, end in enumerate(ends):
        limit = f'<limit lower="-{end}" upper="{end}" velocity="1" effort="1"/>'
        moved = joint(f"j{i}", f"l{i}", f"l{i + 1}", xyz=(0.3, 0, 0), axis=(0, 1, 0), more=limit)
        rows += [link(f"l{i + 1}", 1), moved]
    return urdf(*rows)


ENDS = {  # limits of joints: those that are suspected
    (1.57, 3.14, 50): set(),  # the others are in rad
    (1.57, 2.0, 3.0, 30, 30, 720): {"j3", "j4", "j5"},
    (170, 120, 170, 5): {"j0", "j1", "j2"},  # a narrow one in degrees
    (170, 100, 120): {"j0", "j2"},
    (170.5, 90, 135, 110): {"j0", "j1", "j2", "j3"},
}


@all_in_one(ENDS)
def test_wide_limits_mean_none_where_most_are_in_rad(ends):
    suspected = ENDS[ends]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        robot = torchdq.Robot.from_urdf(legged(*ends))
    assert {subject.split("'")[1] for _, subject in suspicions(robot)} == suspected
    assert len(said) == bool(suspected)


def table(a=0.3, d=0.2, n=2, **bodies):
    """Arm by a table of Denavit and Hartenberg."""
    ones = {"mass": [1.0] * n, "com": [[0.1, 0.0, 0.0]] * n, "inertia": [[0.01, 0, 0.01, 0, 0, 0.01]] * n}
    return torchdq.Robot.from_dh([a] * n, [0.0] * n, [d] + [0.0] * (n - 1), [2 * math.pi] * n, **(ones | bodies))


def limited(kind, upper):
    robot = torchdq.Robot.from_urdf(hinge(kind=kind))
    return robot.replace(limits=robot.limits._replace(upper=double([upper])))


def larger(name, factor):
    robot = torchdq.robots.load(name)
    return robot.replace(inertia=factor * robot.inertia)


def ranged(upper, angle=""):
    """MJCF file whose ranges are in degrees."""
    pytest.importorskip("mujoco")
    body = f"<body name='a'><joint name='j' range='-1.57 {upper}'/><geom size='0.1'/></body>"
    return torchdq.Robot.from_mjcf(f"<mujoco>{angle}<worldbody>{body}</worldbody></mujoco>")


SUSPECTED = {
    "lengths in mm": lambda: table(300, 200),
    "limits in degrees": lambda: limited("revolute", 180.0),
    "a joint turned in degrees": lambda: torchdq.Robot.from_urdf(hinge(rpy=(0, 0, 90))),
    "a body turned in degrees": lambda: torchdq.Robot.from_urdf(hinge(turned=(-180, 0, 0))),
    "ranges in radians": lambda: ranged(3.14),
    **{f"inertias of {name}": lambda name=name: larger(name, 1e3) for name in ("panda", "ur10e", "puma560")},
    "one inertia": lambda: arm("inertia", factor=90.0),
    # without joints at a distance, the size of the body itself is what its centre of mass is compared with
    "an arm of one link in mm": lambda: torchdq.Robot.from_urdf(hinge(kind="continuous", com=(300, 0, 0))),
}
UNSUSPECTED = {
    "lengths in m": table,
    "limits of a slide": lambda: limited("prismatic", 25.0),
    "a whole turn": lambda: torchdq.Robot.from_urdf(hinge(rpy=(0, 0, 6.28318))),
    "ranges in degrees": lambda: ranged(90),
    "ranges in a file in radians": lambda: ranged(3.14, "<compiler angle='radian'/>"),
    **{f"inertias of {name}": lambda name=name: larger(name, 10) for name in ("panda", "ur10e", "puma560")},
    "a disc on a short axle": lambda: table(0.05, n=1, com=[[0.0, 0, 0]], inertia=[[0.5, 0, 0.5, 0, 0, 1.0]]),
    "rods on short axles": lambda: table(0.05, n=3, com=[[0.5, 0, 0]] * 3, inertia=[[1e-4, 0, 0.09, 0, 0, 0.09]] * 3),
    "a long chain of short links": lambda: table(n=150),
    "an arm of one link": lambda: torchdq.Robot.from_urdf(hinge(kind="continuous")).check(),
}


@all_in_one(SUSPECTED)
def test_numbers_in_other_units_are_suspected(case, silent):
    with refused(UserWarning):
        SUSPECTED[case]()


@all_in_one(UNSUSPECTED)
def test_numbers_that_a_robot_may_have_are_not_suspected(case, silent):
    UNSUSPECTED[case]()


def test_what_is_unphysical_by_consent_is_only_noted(silent):
    assert suspicions(arm("com", on_unphysical="ignore")) == {("units.com", "link 'link2'")}


def test_a_batch_is_suspected_for_one_of_its_robots():
    robot = arm()
    batch = robot.replace(com=torch.stack([robot.com, robot.com * double([[1.0], [1.0], [1e3]])]))
    with warned(UserWarning):
        batch.check()


def clear(robot):
    """Whether a robot stays unsuspected with limits that are lower by a clear factor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(units, "TURNS", (0.55 * units.TURNS[0], 1.3 * units.TURNS[1]))  # some legs turn 10 rad
        for limit in ("STEP", "FAR", "LARGE", "SLENDER"):
            patch.setattr(units, limit, getattr(units, limit) / CLEAR)
        patch.setattr(units, "HEAVY", units.HEAVY / CLOSER)
        return units.diagnostics(robot) == []


@all_in_one(thinned(EXISTING, (*oracles.REPRESENTATIVE_ROBOTS[::4], "romeo", "tiago_dual")))
def test_no_robot_that_exists_is_suspected(name):
    assert clear(torchdq.Robot.from_urdf(oracles.urdf_paths()[name], on_unphysical="ignore"))


def test_no_shipped_robot_and_no_arm_in_its_units_is_suspected():
    assert all(clear(torchdq.robots.load(name)) for name in torchdq.robots.names()) and clear(arm())
