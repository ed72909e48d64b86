"""Mimic joints that follow others, and free bases, as descriptions: what `urdf.read` makes of a file.

The map from coordinates to joints is compared with the same robot whose joints are all independent, driven by hand.
"""

import math

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from robot.urdf.test_read import FOLLOWING, LIMIT, arm, beside, fixed, hand, joint, link, same, tree, urdf

import torchdq
from torchdq import ArgumentError, DescriptionError, Robot
from torchdq.robot.urdf import read as reader

F64 = torch.float64


def read(text, joints=None, lock=None, **options):
    """Description of a robot without faults."""
    description, faults, *_ = reader.read(text, joints, lock, **options)
    assert not faults
    return description


# --- mimic joints ----------------------------------------------------------------------------------------------------


def test_followers_have_no_coordinates():
    found = read(FOLLOWING)
    assert found.joint_names == ("thumb",)
    assert found.joint_map.joint_names == ("index", "little", "ring", "thumb")  # in the order of their names
    assert found.joint_map.S.tolist() == [[-2.0], [1.0], [-1.0], [1.0]]  # ring follows index at a half
    assert found.home.tolist() == [-0.25, 0.0, -0.125, 0.0]
    assert found.link_names == ("index_link", "little_link", "ring_link", "thumb_link")
    assert len(found.kinds) == len(found.parents) == len(found.mass) == 4
    note = "mimic joints follow others: index = -2 thumb + 0.25, little = 1 thumb, ring = -1 thumb + 0.125"
    assert note in found.notes and not any("independent" in note for note in map(str, found.notes))


def test_a_robot_without_followers_has_no_map():
    found = read(tree())
    assert found.joint_map is None and found.home is None


def test_displacements_are_the_map_of_the_coordinates():
    found, whole = read(beside(FOLLOWING)), Robot.from_urdf(beside(FOLLOWING), mimic="independent")
    assert found.joint_names == ("other", "thumb") and found.joint_map.joint_names == whole.joint_names
    q = torch.tensor([0.3, -0.7], dtype=F64)
    at = found.joint_map.S @ q - found.home
    expected = {"thumb": -0.7, "index": -2 * -0.7 + 0.25, "ring": 0.5 * (1.4 + 0.25), "little": -0.7, "other": 0.3}
    assert same(at, [expected[name] for name in whole.joint_names])
    assert torch.equal(found.X_PB_home, whole.X_PB_home) and torch.equal(found.screw, whole.screw)


def test_the_order_of_a_chain_of_followers_does_not_matter():
    chain = hand('<mimic joint="index" multiplier="2" offset="1"/>', '<mimic joint="ring" offset="1"/>', "")
    found = read(chain)
    assert found.joint_names == ("little", "ring")
    rows = dict(zip(found.joint_map.joint_names, found.joint_map.S.tolist(), strict=True))
    assert rows == {"index": [0.0, 1.0], "little": [1.0, 0.0], "ring": [0.0, 1.0], "thumb": [0.0, 2.0]}
    assert found.home.tolist() == [-1.0, 0.0, 0.0, -3.0]


def test_a_follower_may_come_before_its_driver_in_the_tree():
    text = arm().replace(LIMIT, LIMIT + '<mimic joint="elbow" multiplier="0.5"/>', 1)
    found = read(text)
    assert found.joint_names == ("elbow",) and found.joint_map.joint_names == ("shoulder", "elbow")
    assert found.joint_map.S.tolist() == [[0.5], [1.0]]


def test_a_long_chain_of_followers_is_composed():
    n = 1500
    links = [link("base", None), *(link(f"l{i}") for i in range(n))]
    joints = [
        joint(f"j{i}", "base", f"l{i}", more=LIMIT + (f'<mimic joint="j{i + 1}"/>' if i + 1 < n else ""))
        for i in range(n)
    ]
    found = read(urdf(*links, *joints))
    assert found.joint_names == (f"j{n - 1}",) and bool((found.joint_map.S == 1).all())


@pytest.mark.parametrize(
    "mimics, expected",
    [
        (['<mimic joint="thumb"/>'], "joint 'thumb': it must not follow itself by <mimic>, found the circle ['thumb']"),
        (['<mimic joint="index"/>', '<mimic joint="thumb"/>'], "found the circle ['thumb', 'index']"),
        (["", '<mimic joint="thumb" multiplier="1e40"/>', '<mimic joint="index" multiplier="1e40"/>'], "joint 'ring'"),
        (["", '<mimic joint="thumb" multiplier="x"/>'], "mimic multiplier must be a finite number, found 'x'"),
    ],
)
def test_followers_that_end_nowhere_are_refused(mimics, expected):
    with pytest.raises(DescriptionError, match="cannot be used") as caught:
        read(hand(*mimics))
    assert expected in str(caught.value) and len(str(caught.value).splitlines()) == 2
    if "multiplier" not in expected:
        assert len(read(hand(*mimics), mimic="independent").joint_names) == 4


@pytest.mark.parametrize("mimic", ['<mimic joint="nobody"/>', "<mimic/>"])
def test_a_follower_of_nobody_is_independent(mimic):
    found = read(hand("", mimic, '<mimic joint="index"/>'))
    assert found.joint_names == ("index", "little", "thumb") and len(found.joint_map.S) == 4
    told = "mimic joints whose drivers are not in the file, taken as independent: index mimics "
    assert any(note.startswith(told) for note in map(str, found.notes))


def test_followers_of_a_circle_bring_no_other_faults():
    text = hand('<mimic joint="index"/>', '<mimic joint="ring"/>', '<mimic joint="index"/>', '<mimic joint="thumb"/>')
    with pytest.raises(DescriptionError) as caught:
        read(text)
    assert len(str(caught.value).splitlines()) == 2


@pytest.mark.parametrize("multiplier", ["0", "-0.0"])
def test_a_follower_at_no_multiple_stays_at_its_offset(multiplier):
    mimic = f'<mimic joint="thumb" multiplier="{multiplier}" offset="0.5"/>'
    found = read(hand("", mimic, '<mimic joint="index" multiplier="2"/>'))
    assert found.joint_names == ("little", "thumb") and found.joint_map is None
    assert "mimic joints that stay where they are: index at 0.5, ring at 1" in found.notes
    frame = next(frame for frame in found.frames if frame.name == "ring_link")
    assert frame.link == -1 and same(torchdq.dq.translation(frame.X_BF), [0, 0, 1])


def test_a_follower_of_a_fixed_joint_stays_at_its_offset():
    text = hand("", '<mimic joint="bolt" offset="0.5"/>')
    text = text.replace("</robot>", link("plate") + fixed("bolt", "base", "plate") + "</robot>")
    found = read(text)
    assert "mimic joints that stay where they are: index at 0.5" in found.notes
    assert found.joint_names == ("little", "ring", "thumb")


def limits(lower=-1, upper=2, velocity=3, effort=4):
    return f'<limit lower="{lower}" upper="{upper}" velocity="{velocity}" effort="{effort}"/>'


def pair(driver, follower, mimic):
    return urdf(
        link("base", None),
        link("a"),
        link("b"),
        joint("driver", "base", "a", more=driver),
        joint("follower", "base", "b", more=follower + mimic),
    )


@pytest.mark.parametrize(
    "follower, mimic, expected",
    [
        (limits(-9, 9, 9, 1), "", [-1, 2, 3]),
        (limits(-0.5, 1, 1, 1), "", [-0.5, 1, 1]),
        (limits(-0.5, 1, 1, 1), ' multiplier="-2" offset="0.5"', [-0.25, 0.5, 0.5]),
        (limits(5, 6, 3, 1), "", [-1, 2, 3]),  # no position is allowed to both
        (limits(0, 0, 0, 0), "", [-1, 2, 3]),  # as files have them where nothing is meant
        ("", "", [-1, 2, 3]),
    ],
)
def test_limits_of_a_coordinate_keep_its_followers_within_theirs(follower, mimic, expected):
    found = read(pair(limits(), follower, f'<mimic joint="driver"{mimic}/>'))
    assert [float(x) for x in found.limits] == [*expected, 4]
    narrowed = [
        note for note in map(str, found.notes) if note.startswith("limits narrowed to those of followers: driver ")
    ]
    left_out = "limits of followers that leave their drivers no room, left out: follower" in found.notes
    assert bool(narrowed) == (expected != [-1, 2, 3])
    assert left_out == (follower in (limits(5, 6, 3, 1), limits(0, 0, 0, 0)))


def test_the_note_says_how_limits_are_narrowed():
    notes = read(pair(limits(), limits(-0.5, 9, 9, 1), '<mimic joint="driver"/>')).notes
    assert "limits narrowed to those of followers: driver lower -1 to -0.5" in notes


def test_friction_of_followers_is_that_of_the_coordinate():
    dynamics = '<dynamics damping="0.3" friction="0.2"/>'
    found = read(pair(LIMIT + dynamics, LIMIT + dynamics, '<mimic joint="driver" multiplier="-2"/>'))
    # the power lost is the same: d qd^2 + d (-2 qd)^2, and f |qd| + f |-2 qd|
    assert same(found.damping, [0.3 * 5]) and same(found.friction, [0.2 * 3])


def test_masses_and_motion_are_those_of_the_reduced_system():
    """Mass matrix S^T M S of the joints, which is that of the coordinates whatever computes it."""
    text = beside(FOLLOWING)
    found, whole = read(text), Robot.from_urdf(text, mimic="independent")
    S, q = found.joint_map.S, torch.tensor([0.3, -0.7], dtype=F64)
    M = torchdq.mass_matrix(whole, S @ q - found.home, backend="eager")
    assert same(torch.diagonal(S.T @ M @ S), [1.0, 1 + 4 + 1 + 1])  # four sliding fingers of 1 kg


@pytest.mark.parametrize("name", ["baxter", "tiago_pro", "panda"])
def test_mass_matrices_of_mimic_robots_are_those_of_pinocchio(name):
    path = oracles.urdf_paths()[name]
    found = read(path)
    whole = Robot.from_urdf(path, mimic="independent")
    model = pin.buildModelFromUrdf(str(path), mimic=True)
    pin_joints = [(joint, name) for joint, name in zip(model.joints, model.names, strict=True) if joint.nv == 1]
    at = {joint_name: (joint.idx_q, joint.idx_v) for joint, joint_name in pin_joints}
    assert set(found.joint_names) <= set(at)
    q = torch.linspace(-0.7, 0.7, len(found.joint_names), dtype=F64)
    z = pin.neutral(model)
    for joint_name, x in zip(found.joint_names, q.tolist(), strict=True):
        k = at[joint_name][0]
        z[k : k + 1] = x
    S = found.joint_map.S
    M = S.T @ torchdq.mass_matrix(whole, S @ q - (0 if found.home is None else found.home), backend="eager") @ S
    theirs = pin.crba(model, model.createData(), z)
    rows = [at[joint_name][1] for joint_name in found.joint_names]
    theirs = (np.triu(theirs) + np.triu(theirs, 1).T)[np.ix_(rows, rows)]
    assert same(M, theirs, 1e-13)


def test_a_locked_driver_locks_its_followers():
    found = read(beside(FOLLOWING), lock={"thumb": 0.5})
    assert found.joint_names == ("other",) and found.joint_map is None
    assert "locked: thumb at 0.5, index at -0.75, ring at -0.375, little at 0.5" in found.notes


def test_a_driver_that_is_kept_keeps_its_followers():
    found = read(beside(FOLLOWING), joints="thumb")
    assert found.joint_names == ("thumb",) and len(found.joint_map.S) == 4
    assert "locked: other at 0" in found.notes


@pytest.mark.parametrize(
    "arguments, named",
    [
        ({"lock": "index"}, "lock must not name 'index' without 'thumb', which it follows"),
        ({"lock": {"ring": 0.1}}, "lock must not name 'ring' without 'thumb'"),
        ({"joints": "ring"}, "joints must not name 'ring' without 'thumb'"),
        ({"joints": "index", "lock": {"thumb": 0.5}}, "joints must not name 'index' without 'thumb'"),
    ],
)
def test_a_follower_is_not_locked_or_kept_alone(arguments, named):
    with pytest.raises(ArgumentError, match=named) as caught:
        read(beside(FOLLOWING), **arguments)
    assert "pass mimic='independent'" in str(caught.value)
    assert read(beside(FOLLOWING), mimic="independent", **arguments).joint_names


def test_a_follower_may_be_locked_elsewhere_with_its_driver():
    found = read(beside(FOLLOWING), lock={"thumb": 0.5, "index": 0.0})
    assert "locked: thumb at 0.5, index at 0, ring at 0, little at 0.5" in found.notes


# --- free bases ------------------------------------------------------------------------------------------------------

FLYING = tree().replace(link("base", None), link("base", 5.0))


def test_a_fixed_base_has_no_body():
    found = read(FLYING)
    assert found.base_mass is found.base_com is found.base_inertia is None


def test_a_free_base_has_its_body():
    found = read(FLYING, base="floating")
    assert found.base_mass == 5.0 and same(found.base_com, [0.02, -0.03, 0.1])
    assert same(found.base_inertia, [0.04, 0.001, 0.05, -0.002, 0.003, 0.03])
    assert found.base_mass.shape == () and found.base_com.shape == (3,) and found.base_inertia.shape == (6,)


def test_all_that_is_fixed_to_a_free_base_is_of_its_body():
    # two equal balls of 1 kg, 0.6 m apart along x, as for a link that a joint carries
    ball = (0.01, 0, 0.01, 0, 0, 0.01)
    text = urdf(
        link("frame", None),
        link("pelvis", 1.0, ball, (0, 0, 0)),
        link("ball", 1.0, ball, (0.1, 0, 0)),
        link("leg"),
        fixed("a", "frame", "pelvis"),
        fixed("b", "pelvis", "ball", (0.5, 0, 0)),
        joint("hip", "pelvis", "leg"),
    )
    found = read(text, base="floating")
    assert found.base_mass == 2.0 and same(found.base_com, [0.3, 0, 0])
    assert same(found.base_inertia, [0.02, 0, 0.2, 0, 0, 0.2])
    assert found.joint_names == ("hip",) and float(found.mass[0]) == 1.0


def test_a_joint_that_is_locked_to_a_free_base_adds_its_link():
    found = read(FLYING, base="floating", lock={"waist": 0.4})
    assert found.base_mass == 8.0


def test_a_free_base_without_mass_is_told():
    _, faults, *_ = reader.read(tree(), None, None, base="floating")
    assert [(fault.code, fault.subject) for fault in faults] == [("base.massless", "link 'base'")]


def test_a_free_base_with_inertia_alone_is_no_fault():
    found = read(tree().replace(link("base", None), link("base", 0.0)), base="floating")
    assert found.base_mass == 0.0 and float(found.base_inertia[0]) == 0.04
    assert any("'base': it has no mass, so its inertia must be zero" in note for note in map(str, found.notes))


def test_a_free_base_is_judged():
    text = FLYING.replace(link("base", 5.0), link("base", -5.0))
    assert read(text).base_mass is None
    _, faults, *_ = reader.read(text, None, None, base="floating")
    assert [(fault.code, fault.subject, fault.found) for fault in faults] == [("mass.negative", "link 'base'", "-5 kg")]


def test_a_flying_body_needs_no_joints():
    found = read(urdf(link("drone", 2.0)), base="floating")
    assert found.joint_names == () and found.base_mass == 2.0


@pytest.mark.parametrize("name", ["talos_full_v2", "solo12", "romeo", "quadrotor_base"])
def test_free_bases_of_real_robots_are_those_of_pinocchio(name):
    path = oracles.urdf_paths()[name]
    found, *_ = reader.read(path, None, None, base="floating", mimic="independent")
    body = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer()).inertias[1]
    I = body.inertia
    assert math.isclose(found.base_mass, body.mass, rel_tol=1e-14)
    np.testing.assert_allclose(found.base_com, body.lever, rtol=0, atol=1e-14)
    six = [I[0, 0], I[0, 1], I[1, 1], I[0, 2], I[1, 2], I[2, 2]]
    np.testing.assert_allclose(found.base_inertia, six, rtol=0, atol=1e-14 * np.abs(I).max())
