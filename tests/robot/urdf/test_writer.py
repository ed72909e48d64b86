"""URDF files that are written back: only the numbers that were changed differ, and read again they are the robot's."""

import warnings
from functools import partial
from itertools import product

import oracles
import pytest
import torch
from helpers import EVERYTHING, all_in_one
from messages import refused
from urdf_text import fixed, joint, link, mimic, random_elements, urdf
from written_files import TOLERANCE, changed, differences, require_equal, with_limit, with_rows

import torchdq

TEXT = """<?xml version="1.0"?>
<!-- a robot -->
<robot name='two'   >
  <link name="base"><inertial><mass value="3"/></inertial></link>
  <link
      name="upper" >  <!-- <mass value="9"/> -->
    <inertial>
      <inertia ixx="0.1" ixy="0.01" ixz="0"
               iyy="0.2" iyz="0"   izz='0.15'/>
      <origin rpy="0.1 0.2 0.3" xyz="0 0 .1"/>
      <mass value = "1e0" extra="&lt;&#65;"/>
    </inertial>
    <visual><geometry><box size="1 1 1"/></geometry></visual>
  </link>
  <link name="tool"><inertial><origin xyz="0.01 0 0"/><mass value="0.5"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <link name="bare"/>
  <link name="point"><inertial><mass value="0.3"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="5" velocity="2"/></joint>
  <joint name="fixed" type="fixed"><parent link="upper"/><child link="tool"/>
    <origin xyz="0 0.1 0.2" rpy="1 2 3"/></joint>
  <joint name="wrist" type="continuous"><parent link="tool"/><child link="bare"/>
    <dynamics damping="0.1"></dynamics></joint>
  <joint name="end" type="prismatic"><parent link="bare"/><child link="point"/><limit upper="1"/></joint>
</robot>
<!-- the end -->
"""
MIMIC = TEXT.replace('<dynamics damping="0.1">', f'{mimic("shoulder", 2)}<dynamics damping="0.1">')
ROOT = '<link name="world"/><joint name="root" type="floating"><parent link="world"/><child link="base"/>'
FLOATING = TEXT.replace("</robot>", f'{ROOT}<origin xyz="1 2 3" rpy="1 2 3"/></joint></robot>')
ROBOTS = ["panda", "ur5_robot", "z1", "talos_left_arm", "double_pendulum", "go2"]
TEXTS = {
    "two": TEXT,
    "mimic": MIMIC,
    "floating": FLOATING,
    **{name: oracles.urdf_paths()[name].read_bytes().decode() for name in ROBOTS},
    **{f"random {i}": urdf(*random_elements(i)) for i in range(4)},
}
read = partial(torchdq.Robot.from_urdf, on_unphysical="ignore")


@all_in_one(TEXTS)
def test_a_robot_is_read_back_as_it_was_written(name):
    """Without changes the text is the original; otherwise all that was there still is."""
    text = TEXTS[name]
    robot = read(text)
    assert robot.to_urdf(text) == text and robot.to(torch.float32).to_urdf(text) == text
    other = changed(robot)
    written = other.to_urdf(text.encode())
    require_equal(read(written), other)
    assert differences(text, written)


def test_the_body_of_a_floating_base_is_written_to_the_link_that_the_joint_carries():
    robot = read(FLOATING)
    written = robot.replace(base_mass=2 * robot.base_mass).to_urdf(FLOATING)
    assert read(written).base_mass == 6.0
    assert '<link name="base"><inertial><mass value="6.0" /></inertial></link>' in written
    held = read(FLOATING, base="fixed")
    assert held.replace(mass=held.mass).to_urdf(FLOATING) == FLOATING


def test_a_path_comments_and_what_stands_around_the_robot_stay(tmp_path):
    path = tmp_path / "two.urdf"
    path.write_bytes(TEXT.replace("\n", "\r\n").encode())
    assert read(path).to_urdf(path).encode() == path.read_bytes()
    written = changed(read(TEXT)).to_urdf(TEXT)
    assert written.startswith(TEXT[: TEXT.index("<robot")]) and written.endswith("\n<!-- the end -->\n")
    assert '<!-- <mass value="9"/> -->' in written and 'extra="&lt;A"' in written


def test_a_robot_of_independent_mimic_joints_is_written_and_read_back_so():
    robot = read(MIMIC, mimic="independent")
    assert robot.to_urdf(MIMIC) == MIMIC
    other = robot.replace(damping=torch.tensor([0.5, 0.25, 0.75], dtype=torch.float64), mass=2 * robot.mass)
    text = other.to_urdf(MIMIC)
    again = read(text, mimic="independent")
    assert again.damping.tolist() == [0.5, 0.25, 0.75] and torch.allclose(again.mass, other.mass, rtol=TOLERANCE)
    assert '<mimic joint="shoulder" multiplier="2"' in text


CHANGES = {
    "mass alone": ("mass", [None, None, 0.7], {"mass value": "0.7"}),
    "com of a body alone": ("com", [None, None, [1e-5, 0.25, -3]], {"origin xyz": "1e-05 0.25 -3.0"}),
    "damping": ("damping", [None, 0.25, None], {"dynamics damping": "0.25"}),
    "friction": ("friction", [None, 0.25, None], {"dynamics friction": "0.25"}),
}


@all_in_one(CHANGES)
def test_only_what_changed_is_written(name):
    field, rows, expected = CHANGES[name]
    assert differences(TEXT, with_rows(read(TEXT), field, rows).to_urdf(TEXT)) == expected
    if field == "damping":
        single = with_rows(read(TEXT).to(torch.float32), field, rows)
        assert differences(TEXT, single.to_urdf(TEXT)) == expected


def test_one_limit_is_written_alone():
    robot = read(TEXT)
    assert differences(TEXT, with_limit(robot, "upper", 0, 1.25).to_urdf(TEXT)) == {"limit upper": "1.25"}
    written = with_limit(robot, "velocity", 1, 3.0).to_urdf(TEXT)
    assert differences(TEXT, written) == {"limit velocity": "3.0"} and read(written).limits.velocity[1] == 3


def test_a_link_takes_on_what_changed_of_the_links_fixed_to_it():
    robot = read(TEXT)
    written = with_rows(robot, "mass", [robot.mass[0] + 0.25, None, None]).to_urdf(TEXT)
    found = differences(TEXT, written)
    assert found["mass value"] == "1.25" and {key.split()[0] for key in found} == {"mass", "origin", "inertia"}
    assert "origin rpy" not in found
    inertia = robot.inertia[0].clone()
    inertia[0] += 0.01
    found = differences(TEXT, with_rows(robot, "inertia", [inertia, None, None]).to_urdf(TEXT))
    assert {key.split()[0] for key in found} == {"inertia"}


def test_a_robot_that_was_read_with_some_joints_is_written():
    """What changed of a body goes to the link that moves it; links beyond joints that were left stay as they are."""
    robot = torchdq.Robot.from_urdf(TEXT, joints=["shoulder"])
    assert robot.to_urdf(TEXT) == TEXT
    other = robot.replace(mass=1.5 * robot.mass, damping=robot.damping + 0.5)
    written = other.to_urdf(TEXT)
    again, whole, before = torchdq.Robot.from_urdf(written, joints=["shoulder"]), read(written), read(TEXT)
    assert torch.allclose(again.mass, other.mass) and torch.allclose(again.damping, other.damping)
    added = whole.mass - before.mass
    assert float(added[0]) == pytest.approx(0.5 * float(robot.mass[0])) and float(added[1]) == 0


REFUSED = {
    "locked": lambda r: r.lock({"wrist": 0.4}),
    "cut": lambda r: r.subchain("upper", "point"),
    "moved": lambda r: r.replace(X_PB_home=r.X_PB_home * -1),
    "batch": lambda r: r.replace(mass=r.mass.expand(2, -1)),
    "rotor": lambda r: r.replace(armature=r.mass),
    "too light": lambda r: r.replace(mass=0.1 * r.mass),
    "infinite": lambda r: with_limit(r, "effort", 0, torch.inf),
    "continuous": lambda r: with_limit(r, "upper", 1, 2.0),
}


@all_in_one(REFUSED)
def test_a_robot_that_has_no_place_in_the_file_is_refused(name):
    with refused(torchdq.ArgumentError):
        REFUSED[name](read(TEXT)).to_urdf(TEXT)


def test_a_faulty_original_is_refused_as_by_the_reader():
    with pytest.raises(torchdq.DescriptionError):
        read(TEXT).to_urdf("<robot")
    with refused(torchdq.DescriptionError):
        read(TEXT).to_urdf(TEXT.replace('damping="0.1"', 'damping="-1"'))


# --- repairs ---------------------------------------------------------------------------------------------------------

FLAT = (0.1, 0.1, 0.25)  # principal moments that break the triangle inequality
NEGATIVE = (0.1, 0.2, -0.05)
WHOLE = ("upper", "tool", "hand")
EDITS = {
    "as it was read": lambda robot: robot,
    "with a payload": lambda robot: robot.with_tip("hand").with_payload(0.2, (0, 0, 0.1)),
    "heavier": lambda robot: robot.replace(mass=1.5 * robot.mass),
    "in single precision": lambda robot: robot.to(torch.float32),
    "with other limits": lambda robot: robot.replace(limits=robot.limits._replace(upper=robot.limits.upper + 1)),
}


def unsound(moments, links=WHOLE, turn='rpy="0.1 0.2 0.3"'):
    """An arm some of whose links, among them two on fixed joints, have inertias that no body has."""
    bodies = []
    for name in ("base", "upper", "tool", "hand"):
        xx, yy, zz = moments if name in links else (0.1, 0.1, 0.1)
        bodies.append(link(name, 1.0, (xx, 0, yy, 0, 0, zz), (0.1, 0, 0)).replace('rpy="0.0 0.0 0.0"', turn))
    place = (0, 0.1, 0.2), (1, 2, 3)
    moved = joint("j", "base", "upper", "revolute", *place, (0, 1, 0), '<limit upper="1"/>')
    return urdf(*bodies, moved, fixed("to_tool", "upper", "tool", *place), fixed("to_hand", "tool", "hand", *place))


REPAIRED = [*product([FLAT, NEGATIVE], EDITS, [("tool",), WHOLE], ["fixed"])]
REPAIRED += [(FLAT, "as it was read", ("base", "hand"), "floating")]


@all_in_one(REPAIRED if EVERYTHING else REPAIRED[::3])
def test_a_repaired_robot_that_is_written_has_nothing_to_repair(case):
    moments, edit, links, base = case
    text = unsound(moments, links, 'quat_xyzw="0.1 0.2 0.3 0.9"' if base == "floating" else 'rpy="0.1 0.2 0.3"')
    robot = EDITS[edit](torchdq.Robot.from_urdf(text, base=base, on_unphysical="repair"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = torchdq.Robot.from_urdf(robot.to_urdf(text), base=base)
    assert not [x for x in again.notes if x.code.startswith("inertia.")]
    again.check()
    require_equal(again.to(robot.mass.dtype), robot)


def test_only_inertias_of_repaired_links_are_written():
    text = unsound(FLAT, links=("tool",))
    written = torchdq.Robot.from_urdf(text, on_unphysical="repair").to_urdf(text)
    before, after = (x.replace(" />", "/>").replace(" >", ">").split("<link ") for x in (text, written))
    assert [a.split('"')[1] for a, b in zip(before, after, strict=True) if a != b] == ["tool"]
    assert torchdq.Robot.from_urdf(text, on_unphysical="ignore").to_urdf(text) == text
