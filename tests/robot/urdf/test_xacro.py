"""Robots from xacro files, and from names of descriptions that are kept elsewhere."""

import sys
import types

import pytest
from helpers import all_in_one
from messages import refused

import torchdq

pytest.importorskip("xacrodoc")

PARTS = """
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="body" params="name mass">
    <link name="${name}"><inertial><mass value="${mass}"/><origin xyz="0 0 ${length / 2}"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  </xacro:macro>
</robot>
"""
ROBOT = """
<robot name="rod" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="mass" default="2"/>
  <xacro:arg name="hand" default="false"/>
  <xacro:property name="length" value="0.4"/>
  <xacro:include filename="{parts}"/>
  <link name="base"/>
  <xacro:body name="upper" mass="$(arg mass)"/>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
  <xacro:if value="$(arg hand)">
    <xacro:body name="hand" mass="0.5"/>
    <joint name="wrist" type="continuous"><parent link="upper"/><child link="hand"/><axis xyz="0 1 0"/></joint>
  </xacro:if>
</robot>
"""


@pytest.fixture
def folder(tmp_path):
    """Package of ROS with a robot that includes a file of its folder, and one that includes it from the package."""
    urdf = tmp_path / "rod_description" / "urdf"
    urdf.mkdir(parents=True)
    (urdf.parent / "package.xml").write_text("<package><name>rod_description</name></package>")
    (urdf / "parts.xacro").write_text(PARTS)
    (urdf / "rod.xacro").write_text(ROBOT.format(parts="parts.xacro"))
    (urdf / "found.xacro").write_text(ROBOT.format(parts="$(find rod_description)/urdf/parts.xacro"))
    (tmp_path / "elsewhere.xacro").write_text(ROBOT.format(parts="$(find rod_description)/urdf/parts.xacro"))
    return urdf


@all_in_one(["rod.xacro", "found.xacro"])
def test_a_xacro_file_is_expanded_with_its_includes(file, folder):
    robot = torchdq.Robot.from_xacro(folder / file)
    assert (robot.name, robot.joint_names) == ("rod", ("shoulder",))
    assert robot.mass.tolist() == [2.0] and robot.com.tolist() == [[0, 0, 0.2]]


def test_meshes_lie_around_the_file(folder):
    robot = torchdq.Robot.from_xacro(folder / "rod.xacro")
    assert {frame.drawing.folder for frame in robot.frames} == {str(folder)}


def test_arguments_are_those_of_the_file(folder):
    robot = torchdq.Robot.from_xacro(folder / "rod.xacro", {"hand": True, "mass": 3}, lock=["shoulder"])
    assert robot.joint_names == ("wrist",)
    robot = torchdq.Robot.from_xacro(str(folder / "rod.xacro"), arguments={"mass": 3})
    assert robot.mass.tolist() == [3.0]
    for wrong in ({"hnad": True}, ["hand"]):
        with refused((torchdq.UnknownNameError, torchdq.ArgumentError)):
            torchdq.Robot.from_xacro(folder / "rod.xacro", wrong)


def test_packages_are_searched_where_they_are_said_to_be(folder, monkeypatch):
    elsewhere = folder.parents[1] / "elsewhere.xacro"
    with refused(torchdq.DescriptionError):
        torchdq.Robot.from_xacro(elsewhere)
    robot = torchdq.Robot.from_xacro(elsewhere, packages={"rod_description": folder.parent})
    assert robot.joint_names == ("shoulder",)
    with refused(torchdq.DescriptionError):
        torchdq.Robot.from_xacro(elsewhere)  # nothing is remembered


HEAD = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
TEXTS = ["<robot", f"<robot {HEAD}><xacro:nothing/></robot>", f'<robot name="${{1 / 0}}" {HEAD}/>', "<robot name='r'/>"]
MACRO = '<xacro:macro name="part" params="n"><link name="${n}"/></xacro:macro>'
ALONE = [  # macros without a call
    f"<robot {HEAD}>{MACRO}</robot>",
    f'<robot name="r" {HEAD}>{MACRO}<xacro:property name="x" value="1"/><material name="grey"/></robot>',
    f'<robot {HEAD}><xacro:include filename="more.xacro"/></robot>',
]


@all_in_one([*TEXTS, *ALONE])
def test_files_that_expand_to_no_robot_are_refused(text, tmp_path):
    (tmp_path / "more.xacro").write_text(ALONE[0])
    (tmp_path / "robot.xacro").write_text(text)
    with refused(torchdq.DescriptionError) as caught:
        torchdq.Robot.from_xacro(tmp_path / "robot.xacro")
    assert ("expand the file that calls them" in str(caught.value)) == (text in ALONE)


def test_options_are_refused_by_the_function_that_was_called(folder):
    for options in ({"args": {"mass": 3}}, {"on_unphysica": "warn"}, {"source": "x"}):
        with refused(torchdq.UnknownNameError) as caught:
            torchdq.Robot.from_xacro(folder / "rod.xacro", **options)
        assert "Robot.from_xacro" in str(caught.value) and "from_urdf" not in str(caught.value)


def test_a_path_is_needed(tmp_path):
    for path in ("<robot/>", tmp_path / "none.xacro"):
        with refused((torchdq.ArgumentError, torchdq.errors.MissingFileError)):
            torchdq.Robot.from_xacro(path)


def test_without_xacrodoc_a_message_says_what_to_install(monkeypatch, folder):
    monkeypatch.setitem(sys.modules, "xacrodoc", None)
    with refused(torchdq.MissingLibraryError):
        torchdq.Robot.from_xacro(folder / "rod.xacro")


# --- names -----------------------------------------------------------------------------------------------------------

URDF = "<robot name='plain'><link name='base'/></robot>"
MJCF = "<mujoco model='other'><worldbody><body><joint name='j'/><geom size='1'/></body></worldbody></mujoco>"


@pytest.fixture
def names(monkeypatch, folder):
    """Package robot_descriptions with some names; the real one clones repositories."""
    path = folder.parent / "robot_descriptions"
    path.mkdir()
    (path / "__init__.py").write_text("")
    urdf, mjcf, xacro = path / "plain.urdf", path / "other.xml", folder.parents[1] / "elsewhere.xacro"
    urdf.write_text(URDF)
    mjcf.write_text(MJCF)
    of_rod = f"XACRO_PATH, XACRO_PACKAGE_PATHS = {str(xacro)!r}, {{'rod_description': {str(folder.parent)!r}}}\n"
    modules = {
        "plain_description": f"URDF_PATH = {str(urdf)!r}",
        "other_mj_description": f"MJCF_PATH, URDF_PATH = {str(mjcf)!r}, {str(urdf)!r}",
        "both_description": f"MJCF_PATH, URDF_PATH = {str(mjcf)!r}, {str(urdf)!r}",
        "rod_description": of_rod + "XACRO_ARGS = {'mass': '7', 'hand': 'true', 'old': '1'}",
        "empty_description": "SRDF_PATH = ''",
        "broken_description": "raise OSError('no network')",
    }
    for name, text in modules.items():
        (path / f"{name}.py").write_text(text)
    package = types.ModuleType("robot_descriptions")
    package.__path__ = [str(path)]
    for name in [x for x in sys.modules if x.partition(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "robot_descriptions", package)
    yield
    for name in modules:
        sys.modules.pop(f"robot_descriptions.{name}", None)


def test_a_name_finds_a_file_of_any_format(names):
    assert torchdq.Robot.from_name("plain_description").name == "plain"
    assert torchdq.Robot.from_name("both_description").name == "plain"
    rod = torchdq.Robot.from_name("rod_description", arguments={"hand": False})
    assert rod.joint_names == ("shoulder",) and rod.mass.tolist() == [7.0]
    pytest.importorskip("mujoco")
    assert torchdq.Robot.from_name("other_mj_description", gravity=None).name == "other"


def test_names_without_a_file_are_refused(names, monkeypatch):
    for name in ("plane_description", 3, "empty_description", "broken_description"):
        with refused(torchdq.TorchdqError):
            torchdq.Robot.from_name(name)
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    with refused(torchdq.MissingLibraryError):
        torchdq.Robot.from_name("plain_description")
