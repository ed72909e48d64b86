"""Text of URDF files: where it comes from, what is no URDF, and hostile files, which are refused quickly."""

import io
import os
import threading
import time

import pytest
import torch
from helpers import all_in_one
from messages import refused, warned
from robots import torques
from urdf_text import also, arm, fixed, joint, link, urdf

import torchdq
from torchdq import ArgumentError, DescriptionError, MissingFileError, Robot

ENDLESS = 10.0  # seconds of this thread: what is refused at once takes less than one


def refuse(source, error=DescriptionError):
    """Load a file that must be refused, at once."""
    begin = time.thread_time()
    with refused(error) as caught:
        Robot.from_urdf(source)
    assert time.thread_time() - begin < ENDLESS and len(str(caught.value)) < 500


def is_arm(source):
    return torch.equal(torques(Robot.from_urdf(source)), torques(arm()))


# --- sources ---------------------------------------------------------------------------------------------------------

OPENED = {
    "path": lambda path: path,
    "path as text": str,
    "bytes": lambda path: path.read_bytes(),
    "bytearray": lambda path: bytearray(path.read_bytes()),
    "text handle": lambda path: path.open(encoding="utf-8"),
    "binary handle": lambda path: path.open("rb"),
    "StringIO": lambda path: io.StringIO(path.read_text()),
    "BytesIO": lambda path: io.BytesIO(path.read_bytes()),
    "file address": lambda path: path.as_uri(),
    "file address of this machine": lambda path: path.as_uri().replace("file://", "file://localhost"),
    "byte order mark": lambda path: b"\xef\xbb\xbf" + path.read_bytes(),
}


@all_in_one(OPENED)
def test_paths_bytes_open_files_and_addresses_are_read(kind, tmp_path):
    path = tmp_path / "an arm.urdf"
    path.write_text(arm())
    source = OPENED[kind](path)
    assert is_arm(source)
    if hasattr(source, "close"):
        source.close()


def test_the_home_folder_is_written_as_in_a_shell(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "arm.urdf").write_text(arm())
    assert Robot.from_urdf("~/arm.urdf").n == 2


PACKAGES = [
    ("ROS_PACKAGE_PATH", "{0}/none:{0}/src", "src/arm_description"),
    ("ROS_PACKAGE_PATH", "{0}/src/arm_description", "src/arm_description"),
    ("AMENT_PREFIX_PATH", "{0}/none:{0}/install", "install/share/arm_description"),
]


@pytest.mark.parametrize("variable, value, folder", PACKAGES)
def test_a_package_of_ros_is_found(tmp_path, monkeypatch, variable, value, folder):
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    address = "package://arm_description/urdf/arm.urdf"
    refuse(address, MissingFileError)
    monkeypatch.setenv(variable, value.format(tmp_path))
    refuse(address, MissingFileError)
    path = tmp_path / folder / "urdf" / "arm.urdf"
    path.parent.mkdir(parents=True)
    path.write_text(arm())
    assert Robot.from_urdf(address).n == 2


UNREADABLE = ["https://host/arm.urdf", "file://other/arm.urdf", "$HOME/arm.urdf", "panda", "no/such/arm.urdf", "."]
UNREADABLE += ["", " \n", b"", "a\0b", "a/../" * 2000, "a" * 100_000, io.StringIO("")]


def test_a_source_that_cannot_be_read_says_what_to_do():
    closed = io.StringIO(arm())
    closed.close()
    for source in (*UNREADABLE, closed):
        refuse(source)
    with pytest.raises(FileNotFoundError):  # as callers expect
        Robot.from_urdf("no/such/arm.urdf")
    for source in (None, 5, True, ["arm.urdf"], {"path": "arm.urdf"}):
        refuse(source, ArgumentError)


def test_errors_of_a_file_name_it(tmp_path):
    """Of text there is nothing to name."""
    path = tmp_path / "broken.urdf"
    path.write_text(arm()[:-20])
    refuse(path.read_text())
    refuse(path)
    with path.open() as file:
        refuse(file)
    path.write_text(arm(mass="x"))
    with pytest.raises(DescriptionError) as caught:
        Robot.from_urdf(path)
    assert [x.code for x in caught.value.findings] == ["number.invalid"]
    path.write_text("<mujoco><worldbody>")
    pytest.importorskip("mujoco")
    with refused(DescriptionError):
        torchdq.Robot.from_mjcf(path)


@pytest.mark.case("U8")
def test_meshes_are_never_opened(tmp_path):
    pipe = tmp_path / "mesh.stl"
    os.mkfifo(pipe)  # nobody writes into it, so whoever opens it waits for ever
    prefixes = "", "file://", "package://arm", "http://localhost:1"
    meshes = [f'<geometry><mesh filename="{prefix}{pipe}"/></geometry>' for prefix in prefixes]
    robots, text = [], arm(more="".join(f"<visual>{x}</visual><collision>{x}</collision>" for x in meshes))
    loading = threading.Thread(target=lambda: robots.append(Robot.from_urdf(text)), daemon=True)
    loading.start()
    loading.join(10)
    assert torch.equal(torques(robots[0]), torques(arm()))


# --- XML -------------------------------------------------------------------------------------------------------------


@all_in_one(["utf-8", "utf-16", "latin-1", "ebcdic-of-no-kind"])
def test_text_is_decoded_whatever_its_declaration_says(encoding):
    assert is_arm(f'<?xml version="1.0" encoding="{encoding}"?>' + arm())


BEFORE = ["\n", " \t", "\ufeff", "\ufeff\n", "\n\ufeff", "<!-- a comment, \u00e9 -->\n", "<!--a--><!--b-->\ufeff"]
DECLARED = "", "<?xml version='1.0' encoding='utf-8'?>\n"


@all_in_one([(before, declaration) for before in BEFORE for declaration in DECLARED])
def test_a_file_may_begin_with_blanks_comments_and_byte_order_marks(head, tmp_path):
    text, path = "".join(head) + arm(), tmp_path / "arm.urdf"
    path.write_text(text, encoding="utf-8")
    robot = Robot.from_urdf(path)
    assert torch.equal(torques(robot), torques(arm())) and is_arm(text)
    assert robot.to_urdf(text) == text
    heavier = robot.replace(mass=2 * robot.mass).to_urdf(text)
    assert heavier.startswith("".join(head)) and torch.equal(Robot.from_urdf(heavier).mass, 2 * robot.mass)


MESHES = '<visual><geometry><sphere radius="nan"/></geometry></visual><visual/><collision><geometry/></collision>'
XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
UNREAD = [
    arm(more=MESHES),
    arm(more='<gz:y gz:x="1"/>'),
    arm(more="<a>" * 90_000 + "</a>" * 90_000),
    also('<transmission name="t"/><gazebo><plugin/></gazebo><material name="m"/><material name="m"/>'),
    also('<drake:x value="1"><drake:y/></drake:x>'),
    also('<!-- <xacro:arm/> ${x} --><gazebo reference="${x}"/><transmission><xacro:arm/></transmission>'),
    also('<xacro:property name="x" value="${y}"/><xacro:arg name="hand" default="1"/>'),  # definitions
    *(arm().replace("<robot", f"<robot {x}") for x in ('xsi:schema="x"', 'xmlns="http://www.ros.org"', XACRO)),
]


@pytest.mark.case("U8")
@all_in_one(UNREAD)
def test_what_dynamics_do_not_need_may_be_wrong_and_prefixes_need_no_declaration(text):
    assert is_arm(text)


BOMB = '<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {after} "{f"&{before};" * 10}">' for before, after in zip("abcdefghi", "bcdefghij", strict=True)
)
LINKS = [link(f"l{i}", None) for i in range(10_001)]
HOSTILE = {
    "a document type": "<!DOCTYPE robot>" + arm(),
    "a bomb": BOMB + "]>" + arm().replace('"arm"', '"&j;"'),
    "a file": '<!DOCTYPE robot [<!ENTITY f SYSTEM "file:///etc/hostname">]>' + arm().replace('"arm"', '"&f;"'),
    "the network": '<!DOCTYPE robot SYSTEM "http://localhost:1/robot.dtd">' + arm(),
    "a bomb in another encoding": (BOMB + "]>" + arm()).encode("utf-16"),
    "nesting in a link": arm(more="<a>" * 200_000 + "</a>" * 200_000),
    "nesting": urdf("<a>" * 200_000 + "</a>" * 200_000),
    "robots in robots": "<robot>" * 90_000 + "</robot>" * 90_000,
    "attributes": arm().replace("<robot", "<robot " + " ".join(f'a{i}="1"' for i in range(300_000))),
    "a long text": arm() + " " * 10_000_000,
    "links in a chain": urdf(*LINKS, *(fixed(f"j{i}", f"l{i}", f"l{i + 1}") for i in range(10_000))),
    "links in a star": urdf(*LINKS, *(fixed(f"j{i}", "l0", f"l{i + 1}") for i in range(10_000))),
    **{f"cut at {part}": arm()[: int(part * len(arm()))] for part in (0.1, 0.5, 0.9, 0.99)},
    "cut in a character": arm().replace('"arm"', '"ä"').encode()[:14],
    **{f"in {x}": arm().replace('"arm"', '"bras articulé"').encode(x) for x in ("utf-16", "utf-32", "latin-1")},
    **{repr(bad): also(bad) for bad in ("\0", "\ud800", "<", "&", "&nbsp;", "<!-- ", "]]>")},
}


@pytest.mark.case("U8")
@all_in_one(HOSTILE)
def test_a_hostile_text_is_refused(case):
    refuse(HOSTILE[case])


@pytest.mark.case("U8")
def test_a_huge_file_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "arm.urdf"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # a terabyte, of which nothing is on the disk
    refuse(path)


def test_a_long_chain_is_read_in_time_that_grows_with_its_length():
    n = 800
    links = [link("l0", None), *(link(f"l{i + 1}", 1.0) for i in range(n))]
    text = urdf(*links, *(joint(f"j{i}", f"l{i}", f"l{i + 1}", axis=(0, 1, 0)) for i in range(n)))
    begin = time.thread_time()
    assert Robot.from_urdf(text).n == n
    assert time.thread_time() - begin < ENDLESS


# --- other formats ---------------------------------------------------------------------------------------------------

STARTS = ("version https://git-lfs x", "PXR-USDC", "{}", "xml: 1", "404: not", "solid x", "hm")
ROOTS = ("sdf", "mujoco", "srdf", "launch", "COLLADA", "html", "Robot", "arm")


@all_in_one((*STARTS, *ROOTS))
def test_other_formats_are_told_by_their_beginning_or_their_root(start):
    refuse(start.encode() if start in STARTS else f"<{start}>{link('base')}</{start}>")


UNEXPANDED = [
    '<xacro:arm prefix="a"/><link name="base"/>',
    '<xacro:include filename="arm.xacro"/>',
    '<link name="base"><xacro:inertia mass="1"/></link>',
    '<link name="base" xacro:if="true"/>',
    '<link name="${prefix}_base"/>',
    arm(mass="${2 * m}").removeprefix('<robot name="arm">').removesuffix("</robot>"),
    '<link name="$(arg prefix)base"/>',
]


def test_unexpanded_xacro_is_refused_with_the_command_that_expands_it():
    for content in UNEXPANDED:
        for head in (f'<robot name="a" {XACRO}>', '<robot name="a">'):
            refuse(head + content + "</robot>")
    refuse(f'<xacro:robot {XACRO}><link name="base"/></xacro:robot>')


def test_calls_of_macros_that_xacro_left_beside_the_links_are_warned_of():
    with warned(UserWarning):
        robot = Robot.from_urdf(also('<xacro:hand_sensors_usb prefix="left"/>' * 2))
    assert torch.equal(torques(robot), torques(arm()))
    assert [x.code for x in robot.notes if x.severity == "warning"] == ["element.ignored"]
    for inside in ("<xacro:a><xacro:b/></xacro:a>", '<xacro:a p="${x}"/>', '<xacro:if value="1"/>'):
        refuse(also(inside))


@all_in_one(['<group name="hand"/>', "<robot><link name='c'/></robot>", '<Joint name="j"/>'])
def test_a_file_of_other_things_is_no_robot_without_joints(more):
    refuse(urdf(link("base", None), more))


def test_a_body_alone_may_have_what_robots_have():
    for more in ("", '<material name="m"/>', "<gazebo/>", '<drake:x value="1"/>', "<ros2_control/>"):
        robot = Robot.from_urdf(urdf(link("base"), more))
        assert robot.n == 0 and "0 joints, chain, 0 kg" in repr(robot)
    robot = Robot.from_urdf(urdf(link("drone"), '<frame name="f"/><force_element name="p"/>'), base="floating")
    assert robot.base_mass == 1.0 and [x.severity for x in robot.notes if x.code == "element.ignored"] == ["note"] * 2
