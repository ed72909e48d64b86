"""Files that are written back: only the numbers that were changed differ, and read again they are the robot's."""

import dataclasses
import re
from functools import partial

import numpy as np
import oracles
import pytest
import torch

import torchdq
from torchdq.robot.description import Limits

TOLERANCE = 1e-12
URDF_ROBOTS = ["panda", "ur5_robot", "z1", "talos_left_arm", "double_pendulum", "go2"]

TEXT = """<?xml version="1.0"?>\r
<!-- a robot -->\r
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
"""
read_urdf = partial(torchdq.Robot.from_urdf, on_unphysical="ignore")


def changed(robot: torchdq.Robot, seed: int = 0) -> torchdq.Robot:
    """Robot with other bodies, damping, friction and limits."""
    rng = np.random.default_rng(seed)
    bodies = [oracles.random_inertia(rng, 1.0) for _ in robot.link_names]
    inertia = robot.inertia + torch.tensor(np.array([I[np.tril_indices(3)] for I in bodies])).reshape(-1, 6)
    shift = 0.125 if robot.joint_map is None else -0.001  # limits that are wider than those of followers have no place
    finite = [x.where(x.isinf(), x + shift * k) for k, x in enumerate(robot.limits)]
    return robot.replace(
        mass=robot.mass + torch.from_numpy(rng.uniform(0.1, 1, len(robot.link_names))),
        com=robot.com + torch.from_numpy(rng.normal(size=(len(robot.link_names), 3))) * 0.1,
        inertia=inertia,
        damping=robot.damping + torch.from_numpy(rng.uniform(size=robot.n)),
        friction=robot.friction + torch.from_numpy(rng.uniform(size=robot.n)),
        limits=Limits(*finite),
        on_unphysical="ignore",
    )


def require_equal(a: torchdq.Robot, b: torchdq.Robot, tolerance: float = TOLERANCE) -> None:
    """Compare all numbers that are written."""
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in ("mass", "com", "inertia", "damping", "friction")}
    pairs |= dict(zip(a.limits._fields, zip(a.limits, b.limits, strict=True), strict=True))
    for name, (x, y) in pairs.items():
        assert torch.allclose(x, y, rtol=tolerance, atol=tolerance), name
    assert (a.armature is None) == (b.armature is None)
    assert a.armature is None or torch.allclose(a.armature, b.armature, rtol=tolerance, atol=tolerance)


def without_numbers(text: str) -> str:
    """Text without the numbers in its attributes."""
    return re.sub(r"""(["'])[-+.\de\s]*\1""", '""', text)


# --- URDF ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", URDF_ROBOTS)
def test_a_urdf_robot_is_read_back_as_it_was_written(name):
    path = oracles.urdf_paths()[name]
    robot = read_urdf(path)
    text = path.read_bytes().decode()
    assert robot.to_urdf(path) == text
    other = changed(robot)
    written = other.to_urdf(path)
    require_equal(read_urdf(written), other)
    assert len(written.splitlines()) >= len(text.splitlines())


def test_an_unchanged_robot_is_the_original_byte_for_byte(tmp_path):
    robot = read_urdf(TEXT)
    assert robot.to_urdf(TEXT) == TEXT
    assert robot.to(torch.float32).to_urdf(TEXT) == TEXT
    path = tmp_path / "two.urdf"
    path.write_bytes(TEXT.encode())
    assert robot.to_urdf(path).encode() == path.read_bytes()


MIMIC = TEXT.replace('<dynamics damping="0.1">', '<mimic joint="shoulder" multiplier="2"/><dynamics damping="0.1">')


def test_a_robot_of_independent_mimic_joints_is_written_and_read_back_so():
    robot = read_urdf(MIMIC, mimic="independent")
    assert robot.to_urdf(MIMIC) == MIMIC and read_urdf(MIMIC).to_urdf(MIMIC) == MIMIC
    other = robot.replace(damping=torch.tensor([0.5, 0.25, 0.75], dtype=torch.float64), mass=2 * robot.mass)
    text = other.to_urdf(MIMIC)
    again = read_urdf(text, mimic="independent")
    assert again.damping.tolist() == [0.5, 0.25, 0.75] and torch.allclose(again.mass, other.mass, rtol=TOLERANCE)
    assert '<mimic joint="shoulder" multiplier="2"/>' in text


def test_single_precision_writes_only_what_was_changed():
    robot = read_urdf(TEXT).to(torch.float32)
    damping = robot.damping.clone()
    damping[1] = 0.25
    assert robot.replace(damping=damping).to_urdf(TEXT) == TEXT.replace('damping="0.1"', 'damping="0.25"')


def test_all_numbers_are_written_where_some_are_missing():
    robot = read_urdf(TEXT)
    other = changed(robot)
    require_equal(read_urdf(other.to_urdf(TEXT)), other)
    require_equal(read_urdf(other.to_urdf(TEXT.encode())), other)


CHANGES = {
    "mass alone": ({"mass": [1.0, 0.0, 0.7]}, '<mass value="0.3"/>', '<mass value="0.7"/>'),
    "com of a body alone": (
        {"com": [None, None, [1e-5, 0.25, -3]]},
        '<mass value="0.3"/>',
        '<origin xyz="1e-05 0.25 -3.0"/><mass value="0.3"/>',
    ),
    "damping": (
        {"damping": [0, 0.25, 0]},
        '<dynamics damping="0.1"></dynamics>',
        '<dynamics damping="0.25"></dynamics>',
    ),
    "friction": (
        {"friction": [0, 0.25, 0]},
        '<dynamics damping="0.1"></dynamics>',
        '<dynamics damping="0.1" friction="0.25"></dynamics>',
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_only_what_changed_is_written(name):
    changes, old, new = CHANGES[name]
    robot = read_urdf(TEXT)
    ((field, rows),) = changes.items()
    value = getattr(robot, field).clone()
    for i, row in enumerate(rows):
        if row is not None and not (field == "mass" and i < 2):
            value[i] = torch.as_tensor(row, dtype=torch.float64)
    written = robot.replace(**{field: value}, on_unphysical="ignore").to_urdf(TEXT)
    assert TEXT.count(old) == 1
    assert written == TEXT.replace(old, new)


def test_a_link_takes_on_what_changed_of_the_links_fixed_to_it():
    robot = read_urdf(TEXT)
    mass = robot.mass.clone()
    mass[0] += 0.25
    written = robot.replace(mass=mass).to_urdf(TEXT)
    tool = TEXT[TEXT.index('<link name="tool">') :]
    assert written.endswith(tool)
    assert '<mass value = "1.25" extra="&lt;&#65;"/>' in written
    assert 'rpy="0.1 0.2 0.3"' in written
    assert without_numbers(written) == without_numbers(TEXT)
    inertia = robot.inertia.clone()
    inertia[0, 0] += 0.01
    written = robot.replace(inertia=inertia).to_urdf(TEXT)
    assert '<mass value = "1e0"' in written
    assert 'xyz="0 0 .1"' in written
    assert 'ixx="0.1"' not in written


def test_one_limit_is_written_alone():
    robot = read_urdf(TEXT)
    upper = robot.limits.upper.clone()
    upper[0] = 1.25
    written = robot.replace(limits=robot.limits._replace(upper=upper)).to_urdf(TEXT)
    assert written == TEXT.replace('lower="-1" upper="1"', 'lower="-1" upper="1.25"')
    velocity = robot.limits.velocity.clone()
    velocity[1] = 3
    written = robot.replace(limits=robot.limits._replace(velocity=velocity)).to_urdf(TEXT)
    assert '<limit velocity="3.0"/><parent link="tool"/>' in re.sub(r"\s*<", "<", written)
    assert read_urdf(written).limits.velocity[1] == 3


def test_a_robot_that_was_read_with_some_joints_is_written():
    """What changed of a body goes to the link that moves it; links beyond joints that were left stay as they are."""
    robot = torchdq.Robot.from_urdf(TEXT, joints=["shoulder"])
    assert robot.to_urdf(TEXT) == TEXT
    other = robot.replace(mass=1.5 * robot.mass, damping=robot.damping + 0.5)
    written = other.to_urdf(TEXT)
    again, whole, before = torchdq.Robot.from_urdf(written, joints=["shoulder"]), read_urdf(written), read_urdf(TEXT)
    assert torch.allclose(again.mass, other.mass) and torch.allclose(again.damping, other.damping)
    added = whole.mass - before.mass
    assert float(added[0]) == pytest.approx(0.5 * float(robot.mass[0])) and float(added[1]) == 0


def _limit(robot, field, i, value):
    x = getattr(robot.limits, field).clone()
    x[i] = value
    return robot.replace(limits=robot.limits._replace(**{field: x}), on_unphysical="ignore")


REFUSED = {
    "locked": (lambda r: r.lock({"wrist": 0.4}), "of robot 'two' must be that of the original"),
    "cut": (lambda r: r.subchain("upper", "point"), "of robot 'two' must be that of the original"),
    "moved": (lambda r: r.replace(X_PB_home=r.X_PB_home * -1), "X_PB_home of robot 'two' must be that of the original"),
    "batch": (lambda r: r.replace(mass=r.mass.expand(2, -1)), "mass of robot 'two' must have no batch axes"),
    "rotor": (lambda r: r.replace(armature=r.mass), "armature of joint 'shoulder' has no place in a URDF file"),
    "too light": (lambda r: r.replace(mass=0.1 * r.mass), "must be at least that of the links on fixed joints"),
    "infinite": (
        lambda r: _limit(r, "effort", 0, torch.inf),
        "effort of joint 'shoulder' must be finite",
    ),
    "continuous": (lambda r: _limit(r, "upper", 1, 2.0), "upper limit of joint 'wrist' has no place in the file"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_robot_that_has_no_place_in_the_file_is_refused(name):
    change, message = REFUSED[name]
    with pytest.raises(torchdq.ArgumentError, match=re.escape(message)):
        change(read_urdf(TEXT)).to_urdf(TEXT)


def test_a_faulty_original_is_refused_as_by_the_reader():
    with pytest.raises(torchdq.DescriptionError):
        read_urdf(TEXT).to_urdf("<robot")
    with pytest.raises(torchdq.DescriptionError, match="must not be negative"):
        read_urdf(TEXT.replace("0.1", "0.2", 1)).to_urdf(TEXT.replace('damping="0.1"', 'damping="-1"'))


# --- MJCF ------------------------------------------------------------------------------------------------------------

mujoco = pytest.importorskip("mujoco")
from robot.mjcf import test_read as test_mjcf  # noqa: E402

MODELS = {
    "arm": test_mjcf.ARM,
    "random": test_mjcf.random_mjcf(3),
    "coupled": test_mjcf.COUPLED,
    **{
        path.stem: path.read_text().replace('inertiafromgeom="true"', "")
        for path in test_mjcf.fixed_assets()
        if path.stem in ("hopper", "reacher", "pusher_v5")
    },
}
read_mjcf = partial(torchdq.Robot.from_mjcf, on_unphysical="ignore")


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


@pytest.mark.parametrize("name", MODELS)
def test_an_mjcf_robot_is_read_back_as_it_was_written(name):
    text = MODELS[name]
    robot = read_mjcf(text)
    assert robot.to_mjcf(text) == text
    assert robot.to(torch.float32).to_mjcf(text) == text
    other = changed_in_mjcf(robot)
    written = other.to_mjcf(text)
    require_equal(read_mjcf(written), other)
    assert len(written.splitlines()) >= len(text.splitlines())


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
MJCF_CHANGES = {
    "armature": ("armature", [0.75, None], '"a" axis="0 1 0"/', '"a" axis="0 1 0" armature="0.75"/'),
    "armature behind an actuator": ("armature", [None, 0.79], 'range="-90 90"/', 'range="-90 90" armature="0.75"/'),
    "damping": ("damping", [0.25, None], '"a" axis="0 1 0"/', '"a" axis="0 1 0" damping="0.25"/'),
    "friction": ("friction", [None, 0.25], 'range="-90 90"/', 'range="-90 90" frictionloss="0.25"/'),
    "mass": ("mass", [2.5, None], 'mass="2"', 'mass="2.5"'),
    "com": ("com", [[0.5, 0, 0], None], 'pos="0 0 0" mass', 'pos="0.5 0.0 0.0" mass'),
}


@pytest.mark.parametrize("name", MJCF_CHANGES)
def test_only_what_changed_is_written_of_mjcf(name):
    field, rows, old, new = MJCF_CHANGES[name]
    robot = read_mjcf(MJCF)
    value = getattr(robot, field).clone()
    for i, row in enumerate(rows):
        if row is not None:
            value[i] = torch.as_tensor(row, dtype=torch.float64)
    assert MJCF.count(old) == 1
    assert robot.replace(**{field: value}).to_mjcf(MJCF) == MJCF.replace(old, new)


def test_inertias_of_mjcf_are_written_by_their_principal_axes():
    robot = read_mjcf(MJCF)
    written = robot.replace(inertia=2 * robot.inertia).to_mjcf(MJCF)
    require_equal(read_mjcf(written), robot.replace(inertia=2 * robot.inertia))
    assert "fullinertia" not in written
    # a body that got its mass from geoms, and the one without joints that it carries
    two = written[written.index('<body name="two">') :]
    assert two.startswith('<body name="two"><inertial pos=')
    assert two[two.index('<body name="three"') :] == MJCF[MJCF.index('<body name="three"') :]


def test_ranges_of_mjcf_are_in_its_units():
    robot = read_mjcf(MJCF)
    lower = robot.limits.lower.nan_to_num(neginf=-0.5)
    upper = torch.tensor([0.5, np.pi / 4], dtype=torch.float64)
    written = robot.replace(limits=robot.limits._replace(lower=lower, upper=upper)).to_mjcf(MJCF)
    (line,) = [line for line in written.splitlines() if 'name="b"' in line]
    assert line == '      <body name="two"><joint name="b" class="soft" range="-90.0 45.0"/>'
    assert re.search(r'name="a" axis="0 1 0" range="-28.64\d* 28.64\d*" limited="true"/>', written)


def test_the_body_of_a_free_base_is_written():
    robot = read_mjcf(test_mjcf.FREE)
    assert robot.to_mjcf(test_mjcf.FREE) == test_mjcf.FREE
    bases = {
        "base_mass": 2 * robot.base_mass,
        "base_com": robot.base_com + 0.01,
        "base_inertia": 2 * robot.base_inertia,
    }
    other = dataclasses.replace(robot, **bases, _constants=None, _storages=())
    again = read_mjcf(other.to_mjcf(test_mjcf.FREE))
    for name, x in bases.items():
        assert torch.allclose(getattr(again, name), x, rtol=TOLERANCE, atol=TOLERANCE)
    require_equal(again, robot)


MJCF_REFUSED = {
    "locked": (lambda r: r.lock(["b"]), "joint_names of robot 'robot' must be that of the original"),
    "effort": (lambda r: _limit(r, "effort", 1, 3.0), "effort limit of joint 'b' has no place in an MJCF file"),
    "velocity": (lambda r: _limit(r, "velocity", 0, 3.0), "velocity limit of joint 'a' has no place"),
    "half a range": (lambda r: _limit(r, "upper", 0, 3.0), "limits of joint 'a' must both be finite, found -inf and 3"),
    "too light": (lambda r: r.replace(mass=0.1 * r.mass), "must be at least that of the bodies without joints"),
}


@pytest.mark.parametrize("name", MJCF_REFUSED)
def test_a_robot_that_has_no_place_in_mjcf_is_refused(name):
    change, message = MJCF_REFUSED[name]
    with pytest.raises(torchdq.ArgumentError, match=re.escape(message)):
        change(read_mjcf(MJCF)).to_mjcf(MJCF)


def test_numbers_that_the_compiler_overrules_are_refused():
    text = MJCF.replace("<default>", '<compiler inertiafromgeom="true"/><default>', 1).replace(
        "<frame><joint", '<geom size="0.1"/><frame><joint'
    )
    robot = read_mjcf(text)
    assert robot.to_mjcf(text) == text
    with pytest.raises(torchdq.ArgumentError, match="must be those of its geoms, because the file says so"):
        robot.replace(mass=2 * robot.mass).to_mjcf(text)


def test_numbers_that_others_overrule_are_refused():
    text = MJCF.replace("<default>", '<compiler settotalmass="9"/><default>', 1)
    with pytest.warns(UserWarning, match="settotalmass"):
        robot = read_mjcf(text)
        with pytest.raises(torchdq.ArgumentError, match=r"mass of robot .* cannot be written: a"):
            robot.replace(mass=2 * robot.mass).to_mjcf(text)


def test_bodies_of_other_files_are_not_written(tmp_path):
    (tmp_path / "parts").mkdir()
    body = "<body name='b'><joint name='j'/><geom size='1'/></body>"
    (tmp_path / "parts" / "body.xml").write_text(f"<mujoco>{body}</mujoco>")
    (tmp_path / "parts" / "soft.xml").write_text("<mujoco><default><joint damping='3'/></default></mujoco>")
    path = tmp_path / "robot.xml"
    path.write_text("<mujoco><worldbody><include file='parts/body.xml'/></worldbody></mujoco>")
    robot = read_mjcf(path)
    assert robot.to_mjcf(path) == path.read_text()
    with pytest.raises(torchdq.ArgumentError, match=r"holds its bodies itself, .* found 0 of 1"):
        robot.replace(mass=2 * robot.mass).to_mjcf(path)
    path.write_text(f"<mujoco><include file='parts/soft.xml'/><worldbody>{body}</worldbody></mujoco>")
    robot = read_mjcf(path)
    assert robot.damping.tolist() == [3]
    assert "<inertial" in robot.replace(mass=2 * robot.mass).to_mjcf(path)


def test_urdf_is_not_written_as_mjcf():
    text = oracles.rigid_bodies("panda")
    robot = read_mjcf(text)
    with pytest.raises(torchdq.ArgumentError, match="must be an MJCF file"):
        robot.replace(mass=2 * robot.mass).to_mjcf(text)
