"""MJCF files that are written back: only the numbers that were changed differ, and read again they are the robot's."""

import re
from functools import partial

import numpy as np
import oracles
import pytest
import torch
from helpers import all_in_one
from messages import refused, warned

import torchdq

mujoco = pytest.importorskip("mujoco")
from mjcf_text import ARM, COUPLED, FREE, fixed_assets, random_mjcf  # noqa: E402
from written_files import TOLERANCE, changed, differences, require_equal, with_limit, with_rows  # noqa: E402

ASSETS = [path for path in fixed_assets() if path.stem in ("hopper", "reacher", "pusher_v5")]
MODELS = {"arm": ARM, "random": random_mjcf(3), "coupled": COUPLED}
MODELS |= {path.stem: path.read_text().replace('inertiafromgeom="true"', "") for path in ASSETS}
read = partial(torchdq.Robot.from_mjcf, on_unphysical="ignore")


def changed_in_mjcf(robot: torchdq.Robot) -> torchdq.Robot:
    """Robot with other bodies where there are some, damping, friction, armature and finite positions."""
    other, bodies = changed(robot), (robot.mass > 0).double().unsqueeze(-1)
    armature = torch.zeros_like(robot.damping) if robot.armature is None else robot.armature
    shift = 0.001 if robot.joint_map is None else -0.0001
    lower, upper = robot.limits.lower.nan_to_num(neginf=-1.0), robot.limits.upper.nan_to_num(posinf=1.0)
    return other.replace(
        mass=1.125 * robot.mass,
        com=robot.com + 0.001 * (other.com - robot.com) * bodies,
        inertia=1.2 * robot.inertia + 0.01 * (other.inertia - robot.inertia) * bodies,
        armature=armature + 0.25,
        limits=robot.limits._replace(lower=lower - 100 * shift, upper=upper + 300 * shift),
        on_unphysical="ignore",
    )


@all_in_one(MODELS)
def test_a_robot_is_read_back_as_it_was_written(name):
    text = MODELS[name]
    robot = read(text)
    assert robot.to_mjcf(text) == text and robot.to(torch.float32).to_mjcf(text) == text
    other = changed_in_mjcf(robot)
    require_equal(read(other.to_mjcf(text)), other)


MJCF = """<mujoco>\t<!-- one -->
  <default><joint armature="0.5" damping="1"/><default class="soft"><joint damping="2"/></default></default>
  <worldbody>
    <frame pos="0 0 1">
    <body name="one" pos='0 0 1'>
      <inertial pos="0 0 0" mass="2" fullinertia="1 1.1 1.2 0.1 0 0" />
      <frame><joint name="a" axis="0 1 0"/></frame>
      <body name="two"><joint name="b" class="soft" range="-90 90"/>
        <geom size="0.1" mass="3"/><geom size="0.2" mass="1"/>
        <body name="three"><geom size="0.1" mass="0.5" pos="1 0 0"/></body></body>
    </body></frame>
  </worldbody>
  <actuator><motor joint="b" gear="2" armature="0.01"/></actuator>
</mujoco>"""
CHANGES = {
    "armature": ("armature", [0.75, None], {"joint armature": "0.75"}),
    "armature behind an actuator": ("armature", [None, 0.79], {"joint armature": "0.75"}),
    "damping": ("damping", [0.25, None], {"joint damping": "0.25"}),
    "friction": ("friction", [None, 0.25], {"joint frictionloss": "0.25"}),
    "mass": ("mass", [2.5, None], {"inertial mass": "2.5"}),
    "com": ("com", [[0.5, 0, 0], None], {"inertial pos": "0.5 0.0 0.0"}),
}


@all_in_one(CHANGES)
def test_only_what_changed_is_written(name):
    field, rows, expected = CHANGES[name]
    assert differences(MJCF, with_rows(read(MJCF), field, rows).to_mjcf(MJCF)) == expected


def test_inertias_of_mjcf_are_written_by_their_principal_axes():
    robot = read(MJCF)
    written = robot.replace(inertia=2 * robot.inertia).to_mjcf(MJCF)
    require_equal(read(written), robot.replace(inertia=2 * robot.inertia))
    assert "fullinertia" not in written
    # a body that got its mass from geoms, and the one without joints that it carries
    two, three = (written[written.index(f'<body name="{name}">') :] for name in ("two", "three"))
    assert two.startswith('<body name="two"><inertial ') and three.startswith('<body name="three"><geom')


def test_ranges_of_mjcf_are_in_its_units():
    robot = read(MJCF)
    lower = robot.limits.lower.nan_to_num(neginf=-0.5)
    upper = torch.tensor([0.5, np.pi / 4], dtype=torch.float64)
    written = robot.replace(limits=robot.limits._replace(lower=lower, upper=upper)).to_mjcf(MJCF)
    assert '<joint name="b" class="soft" range="-90.0 45.0" />' in written
    assert re.search(r'name="a" axis="0 1 0" range="-28.64\d* 28.64\d*" limited="true" />', written)


def test_the_body_of_a_free_base_is_written():
    robot = read(FREE)
    assert robot.to_mjcf(FREE) == FREE
    bases = {"base_mass": 2 * robot.base_mass, "base_com": robot.base_com + 0.01}
    bases |= {"base_inertia": 2 * robot.base_inertia}
    other = robot.replace(**bases)
    again = read(other.to_mjcf(FREE))
    for name, x in bases.items():
        assert torch.allclose(getattr(again, name), x, rtol=TOLERANCE, atol=TOLERANCE)
    require_equal(again, robot)


def test_a_robot_that_has_no_place_in_mjcf_is_refused():
    robot = read(MJCF)
    limits = ("effort", 1), ("velocity", 0), ("upper", 0)  # which is half a range
    limited = [with_limit(robot, name, i, 3.0) for name, i in limits]
    for other in (robot.lock(["b"]), *limited, robot.replace(mass=0.1 * robot.mass)):
        with refused(torchdq.ArgumentError):
            other.to_mjcf(MJCF)


def refuse_masses(robot, text):
    """Other masses have no place in the file."""
    with refused(torchdq.ArgumentError):
        robot.replace(mass=2 * robot.mass).to_mjcf(text)


def test_numbers_that_others_overrule_are_refused():
    overruled = MJCF.replace("<default>", '<compiler inertiafromgeom="true"/><default>', 1)
    text = overruled.replace("<frame><joint", '<geom size="0.1"/><frame><joint')
    assert read(text).to_mjcf(text) == text
    refuse_masses(read(text), text)
    text = MJCF.replace("<default>", '<compiler settotalmass="9"/><default>', 1)
    with warned(UserWarning):
        refuse_masses(read(text), text)


def test_bodies_of_other_files_are_not_written(tmp_path):
    (tmp_path / "parts").mkdir()
    body = "<body name='b'><joint name='j'/><geom size='1'/></body>"
    (tmp_path / "parts" / "body.xml").write_text(f"<mujoco>{body}</mujoco>")
    (tmp_path / "parts" / "soft.xml").write_text("<mujoco><default><joint damping='3'/></default></mujoco>")
    path = tmp_path / "robot.xml"
    path.write_text("<mujoco><worldbody><include file='parts/body.xml'/></worldbody></mujoco>")
    assert read(path).to_mjcf(path) == path.read_text()
    refuse_masses(read(path), path)
    path.write_text(f"<mujoco><include file='parts/soft.xml'/><worldbody>{body}</worldbody></mujoco>")
    robot = read(path)
    assert robot.damping.tolist() == [3]
    assert "<inertial" in robot.replace(mass=2 * robot.mass).to_mjcf(path)


def test_urdf_is_not_written_as_mjcf():
    text = oracles.rigid_bodies("panda")
    refuse_masses(read(text), text)
