"""Hard cases of robot descriptions: what is missing, malformed, hostile, locked in a gimbal, tiny, or a tree.

What test_urdf.py holds already is marked there: every fault by name and at once, what is refused and what is read. Here
are pinocchio's readings of the same texts in both precisions, operation by operation and compiled, numbers to the last
digit by mpmath, wounded bytes in files, and what hostile files cost.
"""

import itertools
import math
import random
import re
import time
import tracemalloc

import mpmath
import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import double, one_thread  # noqa: F401
from messages import refused
from oracles import EPS, Case, over, size_of_torques, states, worst

import torchdq
from torchdq import DescriptionError, Robot, SingularInertiaError, TorchdqError, UnphysicalError, dq
from torchdq.backends import c_library as build
from torchdq.envs import Scene, effects

F32, F64 = torch.float32, torch.float64
C = pytest.param("c", marks=pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler"))
every_backend = pytest.mark.parametrize("backend", ["eager", C])
every_dtype = pytest.mark.parametrize("dtype", [F64, F32], ids=["f64", "f32"])
LIMIT = '<limit lower="-1" upper="2" velocity="3" effort="4"/>'


def link(name, mass="1", inertia=(0.04, 0.001, 0.05, -0.002, 0.003, 0.03), origin='xyz="0.02 -0.03 0.1" rpy="0 0 0"'):
    """A <link>; without mass it has no <inertial>."""
    if mass is None:
        return f'<link name="{name}"/>'
    entries = " ".join(f'i{k}="{x}"' for k, x in zip(("xx", "xy", "yy", "xz", "yz", "zz"), inertia, strict=True))
    return (
        f'<link name="{name}"><inertial><origin {origin}/><mass value="{mass}"/><inertia {entries}/></inertial></link>'
    )


def joint(name, parent, child, kind="revolute", axis="0 0 1", origin='xyz="0 0 0" rpy="0 0 0"', more=LIMIT):
    axis = "" if axis is None else f'<axis xyz="{axis}"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin {origin}/>'
    return f'<joint name="{name}" type="{kind}">{ends}{axis}{more}</joint>'


def urdf(*elements):
    return f'<robot name="arm">{"".join(elements)}</robot>'


def arm(*more, upper="1"):
    """base - shoulder - upper - elbow - lower."""
    return urdf(
        link("base", None),
        link("upper", upper),
        link("lower", "0.5", origin='xyz="0 0.2 0" rpy="0.1 0.2 0.3"'),
        joint("shoulder", "base", "upper", axis="0 1 0", origin='xyz="0 0 0.3" rpy="0.2 0 0"'),
        joint("elbow", "upper", "lower", axis="1 0 0", origin='xyz="0.1 0 0.4" rpy="0 0.4 0"'),
        *more,
    )


def readings(text, dtype, backend):
    """The robot, random states, our torques, and pinocchio's of its own reading, with the size of their terms."""
    case = Case(Robot.from_urdf(text), pin.buildModelFromXML(text))
    s = states(case.robot, 5, dtype=dtype)
    found = torchdq.inverse_dynamics(case.robot, s.q, s.qd, s.qdd, backend=backend)
    exact = over(lambda model, data, q, v, a, *_: pin.rnea(model, data, q, v, a)[case.order], case, s)
    return case, s, found, worst(found.double(), exact, size_of_torques(case, s))


# --- U1, U5, U9, U10: what pinocchio reads in the same text ----------------------------------------------------------

BRANCHES = (
    link("tool", "0.2", origin='xyz="0.1 0 0" rpy="0.3 0 0.1"'),
    link("flange", None),
    link("slide", "0.4"),
    link("wheel", "0.3"),
    joint("a", "lower", "flange", "fixed", None, 'xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"', ""),
    joint("b", "flange", "tool", "fixed", None, 'xyz="0 0.1 0" rpy="0 -0.5 0"', ""),
    joint("rail", "upper", "slide", "prismatic", "0 2 1", 'xyz="0 -0.2 0" rpy="0 0 1"'),
    joint("axle", "base", "wheel", axis="1 1 1"),
)
TEXTS = {
    "U1": arm(
        link("cross", None), link("tip", "2"), joint("c", "lower", "cross"), joint("d", "cross", "tip", axis="1 0 0")
    ),
    "U5": arm(*BRANCHES[:2], *BRANCHES[4:6]),
    "U9": arm(
        link("dust", "1e-9", ("2e-15", "0", "2e-15", "0", "0", "3e-15"), 'xyz="1e-3 0 0" rpy="0 1.5707963267948966 0"'),
        joint("j", "lower", "dust", origin='xyz="1e-3 0 0" rpy="0.3 -1.5707963267948966 0.2"'),
    ),
    "U10": arm(*BRANCHES),
}


@every_backend
@every_dtype
@pytest.mark.parametrize("id", [pytest.param(id, marks=pytest.mark.case(id)) for id in TEXTS])
def test_torques_are_those_of_pinocchios_own_reading(id, dtype, backend, margin):
    """A cross without mass, links on fixed joints, a grain of dust beyond a gimbal, and a tree of all of them."""
    _, _, _, off = readings(TEXTS[id], dtype, backend)
    margin(off, 8 * EPS[dtype], f"{id}, {dtype}")


@every_backend
@every_dtype
@pytest.mark.parametrize("id", [pytest.param(id, marks=pytest.mark.case(id)) for id in ("U1", "U9", "U10")])
def test_accelerations_are_those_of_pinocchios_own_reading(id, dtype, backend, margin):
    case = Case(Robot.from_urdf(TEXTS[id]), pin.buildModelFromXML(TEXTS[id]))
    s = states(case.robot, 5, dtype=dtype)
    found = torchdq.forward_dynamics(case.robot, s.q, s.qd, s.qdd, backend=backend).double().numpy()

    def aba(model, data, q, v, tau, *_):
        return pin.aba(model, data, q, v, tau)[case.order]

    exact = over(aba, case, s)
    growth = torchdq.error_growth(case.robot, s.q.double()).numpy()
    # torques that drive a grain of dust are rounded to its own scale, so the error is that of each row's own joints
    size = np.abs(exact).max(-1, keepdims=True)
    margin((np.abs(found - exact) / size).max(), 128 * EPS[dtype] * growth.max(), f"{id}, {dtype}")


@pytest.mark.case("U1")
@every_backend
@every_dtype
def test_no_inertial_is_one_of_nothing_to_the_bit(dtype, backend):
    nothing = link("upper", "0", (0,) * 6, 'xyz="0 0 0" rpy="0 0 0"')
    plain = arm(upper=None)
    robots = [Robot.from_urdf(text) for text in (plain, plain.replace('<link name="upper"/>', nothing))]
    s = states(robots[0], 5, dtype=dtype)
    for function in (torchdq.inverse_dynamics, torchdq.forward_dynamics):
        a, b = (function(robot, s.q, s.qd, s.qdd, backend=backend) for robot in robots)
        assert torch.equal(a, b)


@pytest.mark.case("U1")
@every_backend
def test_a_joint_that_moves_nothing_has_torques_but_no_accelerations(backend):
    text = arm(link("finger", None), joint("knuckle", "lower", "finger"))
    robot, plain = Robot.from_urdf(text), Robot.from_urdf(arm())
    assert robot.notes[0].text().startswith("joint 'knuckle': it moves no inertia")
    s = states(robot, 5)
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, backend=backend)
    expected = torchdq.inverse_dynamics(plain, *(x[:, :2] for x in (s.q, s.qd, s.qdd)), backend=backend)
    assert torch.equal(tau[:, 2], torch.zeros(5, dtype=F64))
    assert (tau[:, :2] - expected).abs().max() <= 64 * EPS[F64] * expected.abs().max()
    with refused(SingularInertiaError):
        torchdq.forward_dynamics(robot, s.q, s.qd, tau, backend=backend)


@pytest.mark.case("U5")
def test_links_on_fixed_joints_are_lumped_as_pinocchio_lumps_them(margin):
    case = Case(Robot.from_urdf(TEXTS["U10"]), pin.buildModelFromXML(TEXTS["U10"]))
    for i, (body, placement) in enumerate(
        zip((case.model.inertias[j.id] for j in case.joints), case.link_placements(), strict=True)
    ):
        own = placement.actInv(body)
        xx, xy, yy, xz, yz, zz = case.robot.inertia[i].tolist()
        ours = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        margin(abs(float(case.robot.mass[i]) - own.mass) / own.mass, 2 * EPS[F64], "mass")
        margin(np.abs(case.robot.com[i].numpy() - own.lever).max(), 4 * EPS[F64] * np.abs(own.lever).max(), "centre")
        margin(np.abs(ours - own.inertia).max(), 16 * EPS[F64] * np.abs(own.inertia).max(), "inertia")


@pytest.mark.case("U10")
@every_dtype
@every_backend
def test_branches_of_a_tree_do_not_feel_each_other_to_the_bit(dtype, backend):
    """The mass matrix is zero between them, and no torque depends on what another branch does."""
    robot = Robot.from_urdf(TEXTS["U10"])
    ahead = {name: set() for name in robot.joint_names}
    for i, name in enumerate(robot.joint_names):
        k = i
        while k >= 0:
            ahead[name].add(k)
            k = robot.parents[k]
    s = states(robot, 5, dtype=dtype)
    M = torchdq.mass_matrix(robot, s.q, backend=backend)
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd, backend=backend)
    apart = 0
    for (i, a), (k, b) in itertools.permutations(enumerate(robot.joint_names), 2):
        if i in ahead[b] or k in ahead[a]:
            continue
        apart += 1
        assert not M[:, i, k].any()
        moved = [x.clone() for x in (s.q, s.qd, s.qdd)]
        for x in moved:
            x[:, k] += 1.0
        assert torch.equal(torchdq.inverse_dynamics(robot, *moved, backend=backend)[:, i], tau[:, i])
    assert apart == 2 + 6  # slide beside elbow; the wheel beside all three


# --- U4: mimic joints ------------------------------------------------------------------------------------------------

MIMICS = {
    "a chain": {"shoulder": "", "elbow": '<mimic joint="shoulder"/>', "c": '<mimic joint="elbow" multiplier="-2"/>'},
    "a circle": {"shoulder": '<mimic joint="elbow"/>', "elbow": '<mimic joint="shoulder"/>', "c": ""},
    "itself": {"shoulder": '<mimic joint="shoulder"/>', "elbow": "", "c": ""},
    "nobody": {"shoulder": '<mimic joint="nobody"/>', "elbow": "", "c": ""},
    "a multiplier of zero": {"shoulder": "", "elbow": '<mimic joint="shoulder" multiplier="0" offset="9"/>', "c": ""},
}


@pytest.mark.case("U4")
@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
@pytest.mark.parametrize("which", MIMICS)
def test_mimic_joints_of_every_kind_move_by_themselves_and_are_told(which, kind):
    """On request, chains and circles of them are joints like others, and the robot says which."""
    names = {"shoulder": ("base", "upper"), "elbow": ("upper", "lower"), "c": ("lower", "hand")}

    def text(mimics):
        links = [link("base", None), *(link(child) for _, child in names.values())]
        return urdf(*links, *(joint(n, *ends, kind, "0 1 0", more=LIMIT + mimics[n]) for n, ends in names.items()))

    robot = Robot.from_urdf(text(MIMICS[which]), mimic="independent")
    plain = Robot.from_urdf(text(dict.fromkeys(names, "")))
    names_of = [name for name in names if MIMICS[which][name]]
    told = "all joints" if len(names_of) == 3 else ", ".join(names_of)
    assert ("unsimulated.mimic", told) in {(x.code, x.subject) for x in robot.notes}
    s = states(plain)
    assert robot.n == 3
    assert torch.equal(*(torchdq.inverse_dynamics(r, s.q, s.qd, s.qdd) for r in (robot, plain)))


@pytest.mark.case("U4")
@pytest.mark.parametrize("number", ["multiplier", "offset"])
def test_a_mimic_joint_with_a_number_that_is_none_is_refused(number):
    text = arm().replace(LIMIT, LIMIT + f'<mimic joint="elbow" {number}="nan"/>', 1)
    with refused(DescriptionError):
        Robot.from_urdf(text)


# --- U2, U6, U7, U9: numbers -----------------------------------------------------------------------------------------

SPELLINGS = ["1e-9", "1E-9", "0.000000001", "+1.e-9", ".1e-8", "10e-10", "00001e-9"]


@pytest.mark.case("U2", "U9")
@pytest.mark.parametrize(
    "text", [*SPELLINGS, "4.9e-324", "2.2250738585072014e-308", "0.1", "1e22", "123456789.123456789"]
)
def test_a_number_is_read_to_its_last_bit(text):
    """Against the nearest double of its decimals."""
    robot = Robot.from_urdf(arm(upper=text), on_unphysical="ignore")
    with mpmath.workdps(60):
        assert robot.mass[0].item() == float(mpmath.mpf(text))


@pytest.mark.case("U2")
@pytest.mark.parametrize("number", ["-1", "-1e-300", "-0.5e-9"])
def test_a_mass_below_zero_is_refused_whatever_its_size(number):
    with refused(UnphysicalError):
        Robot.from_urdf(arm(upper=number))


@pytest.mark.case("U2")
@pytest.mark.parametrize("number", ["nan", "inf", "1_000", "0x1p3", "1,5", "٣", "१", "1e", "", "1 2", "1e309", "-1e51"])
def test_what_is_no_number_in_size_is_refused_by_place_in_every_place(number):
    """Everywhere a number is read at once: every place is named."""
    places = ("link 'upper': mass value", "link 'upper': inertia ixx", "joint 'shoulder': dynamics damping")
    text = arm(upper=number).replace('ixx="0.04"', f'ixx="{number}"', 1)
    text = text.replace(LIMIT, LIMIT + f'<dynamics damping="{number}"/>', 1)
    with pytest.raises(DescriptionError) as raised:
        Robot.from_urdf(text)
    assert all(place in str(raised.value) for place in places)


def turned(rpy):
    """Rotation of roll, pitch and yaw by mpmath."""
    (r, p, y) = (mpmath.mpf(x) for x in rpy)
    c, s = mpmath.cos, mpmath.sin
    x = mpmath.matrix([[1, 0, 0], [0, c(r), -s(r)], [0, s(r), c(r)]])
    y_ = mpmath.matrix([[c(p), 0, s(p)], [0, 1, 0], [-s(p), 0, c(p)]])
    z = mpmath.matrix([[c(y), -s(y), 0], [s(y), c(y), 0], [0, 0, 1]])
    return np.array((z * y_ * x).tolist(), dtype=float)


@pytest.mark.case("U9")
@pytest.mark.parametrize(
    "pitch", [math.pi / 2, -math.pi / 2, math.pi / 2 - 1e-9, math.pi / 2 + 1e-4, math.pi, 1e-9, 7.0]
)
@pytest.mark.parametrize("roll, yaw", [(0.3, 0.2), (0.0, 0.0), (-2.0, 3.1)])
def test_a_frame_in_gimbal_lock_is_turned_exactly(roll, pitch, yaw, margin):
    """Angles become a rotation and never angles again."""
    origin = f'xyz="0 0 0" rpy="{roll!r} {pitch!r} {yaw!r}"'
    robot = Robot.from_urdf(urdf(link("base", None), link("a"), joint("j", "base", "a", origin=origin)))
    X = torchdq.forward_kinematics(robot, torch.zeros(1, dtype=F64), "a")
    with mpmath.workdps(50):
        exact = turned((roll, pitch, yaw))
    margin(np.abs(dq.to_matrix(X)[:3, :3].numpy() - exact).max(), 8 * EPS[F64], f"pitch {pitch}")


@pytest.mark.case("U6")
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("size", ["1e-8", "1e-3", "1", "1e3", "1e49"])
def test_an_axis_of_any_length_is_one_of_unit_length_and_is_told(size, kind, margin):
    """Its direction as good as its numbers; reported unless it is a unit vector already."""
    numbers = [f"{k}e{size.partition('e')[2] or 0}" for k in (2, -3, 6)]
    text = urdf(link("base", None), link("a"), joint("j", "base", "a", kind, " ".join(numbers)))
    robot = Robot.from_urdf(text)
    with mpmath.workdps(50):
        exact = np.array([float(mpmath.mpf(k) / 7) for k in (2, -3, 6)])
    found = robot.screw[0, :3] if kind == "revolute" else robot.screw[0, 3:]
    margin(np.abs(found.numpy() - exact).max(), 2 * EPS[F64], "direction")
    margin(abs(float(found.norm()) - 1.0), 2 * EPS[F64], "length")
    assert ("axis.scaled", "j") in {(x.code, x.subject) for x in robot.notes}


@pytest.mark.case("U6")
@pytest.mark.parametrize("axis", ["0 0 0", "-0 0 0.0", "1e-10 0 0", "1e-320 1e-320 0"])
@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
def test_an_axis_without_a_direction_is_refused_where_it_matters(kind, axis):
    with refused(DescriptionError):
        Robot.from_urdf(urdf(link("base", None), link("a"), joint("j", "base", "a", kind, axis)))
    assert Robot.from_urdf(arm(link("a"), joint("j", "lower", "a", "fixed", axis, more=""))).n == 2


@pytest.mark.case("U7")
def test_limits_of_nothing_are_limits():
    """Effort and velocity of zero, and a range of one point, are taken as they stand by what enforces them."""
    text = arm().replace(LIMIT, '<limit lower="0.5" upper="0.5" velocity="0" effort="0"/>')
    robot = Robot.from_urdf(text)
    assert [x.tolist() for x in robot.limits] == [[0.5, 0.5], [0.5, 0.5], [0.0, 0.0], [0.0, 0.0]]
    q, torque = double(0.3, 0.7), double(5.0, -5.0)
    held = Scene(robot, (effects.Saturation(),))
    assert torch.equal(held.step(held.start(q), torque).qd, torch.zeros(2, dtype=F64))
    with refused(torchdq.ArgumentError):
        Scene(robot, (effects.TorqueSpeed(),))
    pushed = Scene(robot, (effects.JointLimits(),)).step(held.start(q)).qd
    assert pushed[0] > 0  # back to the only place that is allowed


@pytest.mark.case("U7")
@pytest.mark.parametrize("lower, upper", [("1", "-1"), ("1e-300", "0"), ("0.1", "0.09999999999999999")])
def test_reversed_limits_are_refused_however_little(lower, upper):
    text = arm().replace('lower="-1" upper="2"', f'lower="{lower}" upper="{upper}"', 1)
    with refused(DescriptionError):
        Robot.from_urdf(text)


# --- U3: graphs ------------------------------------------------------------------------------------------------------

GRAPHS = {
    "a circle of many": [(f"l{i}", f"l{(i + 1) % 50}") for i in range(50)],
    "every link under every other": [(f"l{i}", f"l{k}") for i, k in itertools.permutations(range(6), 2)],
    "two circles that share a link": [("a", "b"), ("b", "c"), ("c", "a"), ("b", "d"), ("d", "b")],
    "a joint onto itself": [("a", "a")],
    "islands": [(f"a{i}", f"b{i}") for i in range(20)],
    "a link that nobody has": [("a", "b"), ("ghost", "c"), ("c", "spirit")],
}


@pytest.mark.case("U3")
@pytest.mark.parametrize("kind", ["revolute", "fixed"])
@pytest.mark.parametrize("which", GRAPHS)
def test_graphs_that_are_no_tree_are_refused_at_once_with_every_fault(which, kind):
    edges = GRAPHS[which]
    names = sorted({name for edge in edges for name in edge} - {"ghost", "spirit"})
    text = urdf(*map(link, names), *(joint(f"j{i}", *edge, kind) for i, edge in enumerate(edges)))
    with pytest.raises(DescriptionError) as raised:
        Robot.from_urdf(text)
    message = str(raised.value)
    children = [child for _, child in edges]
    for name in names:
        assert children.count(name) < 2 or f"link {name!r}: it is carried by two joints" in message
    roots = [name for name in names if name not in children]
    assert len(roots) == 1 or f"found {len(roots)}" in message
    for ghost in ("ghost", "spirit"):
        assert (f"there is no link {ghost!r}" in message) == any(ghost in edge for edge in edges)


# --- U8: hostile files -----------------------------------------------------------------------------------------------

MEGABYTE = 1 << 20
HOSTILE = {
    "ten megabytes of tags": lambda: "<robot>" + "<a/>" * 2_400_000,
    "a tag of ten megabytes": lambda: "<" + "a" * 9_900_000,
    "an attribute of nine megabytes": lambda: arm().replace('name="arm"', f'name="{"x" * 9_000_000}"'),
    "a number of nine megabytes": lambda: arm(upper="1" * 9_000_000),
    "a hundred thousand numbers": lambda: arm(upper="1 " * 100_000),
    "a link of many inertials": lambda: arm().replace("</inertial>", "</inertial>" + "<inertial/>" * 90_000, 1),
    "a depth of a hundred thousand": lambda: "<robot>" + "<link>" * 99_999,
    "ten thousand links": lambda: urdf(*(link(f"l{i}", None) for i in range(10_000))),
    "attributes without end": lambda: "<robot " + " ".join(f'a{i}="1"' for i in range(150_000)) + "/>",
    "comments": lambda: arm() + "<!-- -->" * 190_000,
    "instructions": lambda: "<?a?>" * 190_000 + arm(),
    "references to characters": lambda: arm().replace('name="arm"', f'name="{"&#65;" * 1_000_000}"'),
}


@pytest.mark.case("U8")
@pytest.mark.parametrize("which", HOSTILE)
def test_hostile_text_costs_neither_time_nor_memory(which, margin):
    """A robot, or an error of the package; in a second or so, and in 256 megabytes."""
    text = HOSTILE[which]()
    begin = time.thread_time()
    fate(text)
    seconds = time.thread_time() - begin
    tracemalloc.start()
    try:
        fate(text)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    margin(peak / MEGABYTE, 256, f"megabytes for {which}")
    assert seconds < 5.0  # on any machine; a tenth of it here


@pytest.mark.case("U8")
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-8", "utf-16", "utf-16-le", "utf-32", "cp500", "latin-1"])
def test_bytes_are_utf8_or_refused_whatever_they_declare(encoding, tmp_path):
    path = tmp_path / "arm.urdf"
    text = arm().replace('"arm"', '"bras articulé"')
    for declared in ("utf-8", "utf-16", "cp500"):
        path.write_bytes(f'<?xml version="1.0" encoding="{declared}"?>{text}'.encode(encoding))
        if encoding.startswith("utf-8"):
            assert Robot.from_urdf(path).name == "bras articulé"
        else:
            with pytest.raises(DescriptionError):
                Robot.from_urdf(path)


# --- U2 to U8: wounds ------------------------------------------------------------------------------------------------

NUMBERS = ["nan", "inf", "-inf", "1e308", "-1e308", "-0", "", "0", "-1", "1e-320", "1e50", "1e9999", "0 0", "x"]
SOUND = arm(*BRANCHES, link("camera", None), joint("stand", "base", "camera", "fixed", None, more="")).replace(
    LIMIT, LIMIT + '<dynamics damping="1" friction="0.5"/><mimic joint="axle"/>', 1
)


def wounded(seed):
    """The bytes of a sound file with one to three wounds."""
    rng, data = random.Random(seed), SOUND.encode()
    for _ in range(rng.choice([1, 1, 2, 3])):
        tags = list(re.finditer(rb"<[^>]*>", data))
        elements = list(re.finditer(rb"<(link|joint|inertial|origin|axis) .*?(/>|</\1>)", data))
        numbers = list(re.finditer(rb'(?<=[" ])-?\d+(\.\d+)?(?=[" ])', data))
        words = list(re.finditer(rb"[a-z_]+", data))
        kind = rng.choice(["delete", "double", "rename", "number", "number", "number", "truncate", "byte", "element"])
        if kind == "truncate" and rng.random() < 0.5:
            data = data[: rng.randrange(len(data) + 1)]
        elif kind == "byte" and data:
            at = rng.randrange(len(data))
            data = data[:at] + bytes([rng.randrange(256)]) + data[at + rng.randrange(2) :]
        elif kind == "rename" and words:
            word = rng.choice(words)
            data = data[: word.start()] + rng.choice(words).group() + data[word.end() :]
        elif kind == "number" and numbers:
            number = rng.choice(numbers)
            data = data[: number.start()] + rng.choice(NUMBERS).encode() + data[number.end() :]
        elif kind in ("delete", "double", "element") and tags:
            what = rng.choice(elements if kind == "element" and elements else tags)
            again = what.group() * (0 if kind == "delete" else rng.choice([0, 2]) if kind == "element" else 2)
            data = data[: what.start()] + again + data[what.end() :]
    return data


def fate(source, **arguments):
    """A robot, or the name of one of the package's errors; anything else is let through."""
    try:
        return Robot.from_urdf(source, **arguments)
    except TorchdqError as error:
        assert len(str(error)) < 20_000
        return type(error).__name__


@pytest.mark.case("U2", "U3", "U5", "U6", "U7", "U8")
@pytest.mark.parametrize("batch", range(6))
def test_a_wounded_file_is_a_robot_that_can_be_computed_or_one_of_the_packages_errors(batch, tmp_path, margin):
    """Fifty of three hundred; what is read is finite, and its dynamics are numbers or say that they are none."""
    path, slowest, robots = tmp_path / "arm.urdf", 0.0, 0
    for seed in range(50 * batch, 50 * (batch + 1)):
        path.write_bytes(wounded(seed))
        begin = time.thread_time()
        robot = fate(path, on_unphysical="error" if seed % 2 else "ignore")
        slowest = max(slowest, time.thread_time() - begin)
        if isinstance(robot, str):
            continue
        robots += 1
        for name in ("X_PB_home", "screw", "mass", "com", "inertia", "damping", "friction"):
            assert getattr(robot, name).isfinite().all(), (seed, name)
        assert not any(x.isnan().any() for x in robot.limits)
        s = states(robot)
        assert torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd).isfinite().all(), seed
        try:
            qdd = torchdq.forward_dynamics(robot, s.q, s.qd, s.qdd)
        except SingularInertiaError:
            # what is unphysical was to be ignored, or was noted
            assert seed % 2 == 0 or any("moves no inertia" in note for note in map(str, robot.notes)), seed
        else:
            assert seed % 2 == 0 or qdd.isfinite().all(), seed
    assert 3 < robots < 47  # wounds are neither all deadly nor all harmless
    margin(slowest, 1.0, "seconds for one file")


def test_the_file_is_sound_before_it_is_wounded():
    assert isinstance(fate(SOUND), Robot)
    assert isinstance(fate(SOUND.encode().decode()), Robot)
