"""Locked joints and chains of robots that are loaded already.

Evidence: the full robot, whose locked joints stand still; `urdf/test_read.py` has Pinocchio's reduced models.
"""

import math
import warnings

import oracles
import pytest
import torch
from helpers import all_in_one, random, thinned
from messages import refused, warned
from robots import F64, noted, on_free_base, panda, two

import torchdq
from torchdq import ArgumentError, Robot, UnknownNameError, dq


def test_locking_a_loaded_robot_is_locking_its_file():
    path = oracles.urdf_paths()["panda"]
    lock = {"panda_joint3": 0.4, "panda_finger_*": 0.02}
    ours, files = Robot.from_urdf(path).lock(lock), Robot.from_urdf(path, lock=lock)
    assert ours.joint_names == files.joint_names and ours.link_names == files.link_names
    assert ours.frame_names == files.frame_names and ours.parents == files.parents
    for name in ("X_PB_home", "mass", "com", "inertia", "damping", "friction"):
        assert torch.allclose(getattr(ours, name), getattr(files, name), rtol=1e-13, atol=1e-14), name
    assert torch.equal(ours.limits.upper, files.limits.upper)
    expected = "locked: panda_joint3 at 0.4, panda_finger_joint1 at 0.02, panda_finger_joint2 at 0.02"
    assert noted(ours, "lock") == [expected]


def test_a_lock_beyond_the_limits_of_a_loaded_robot_is_told():
    with warned(UserWarning) as seen:
        locked = panda().lock({"panda_joint1": 90.0, "panda_joint2": 0.1})
    assert len(seen) == 1 and seen[0].filename == __file__
    (note,) = noted(locked, "lock.beyond_limits")
    assert "panda_joint1 at 90, limits [-2.89" in note and "panda_joint2" not in note
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        locked = panda().lock(["panda_joint4"])  # home was not chosen
    assert "panda_joint4 at 0, limits [-3.07" in noted(locked, "lock.beyond_limits")[0]


def test_a_batch_of_robots_is_locked_as_a_whole():
    full = panda()
    factors = torch.tensor([[1.0], [1.5], [3.0]], dtype=F64)
    batch = full.replace(mass=full.mass * factors).lock({"panda_joint5": 0.7})
    assert batch.mass.shape == (3, 6) and batch.inertia.shape == (3, 6, 6)
    s = oracles.states(batch)
    together = torchdq.inverse_dynamics(batch, s.q, s.qd, s.qdd)
    for i, factor in enumerate(factors):
        alone = full.replace(mass=full.mass * factor).bake().lock({"panda_joint5": 0.7})
        expected = torchdq.inverse_dynamics(alone, s.q[i], s.qd[i], s.qdd[i])
        assert torch.allclose(together[i], expected, rtol=1e-13, atol=1e-13)


def test_links_without_mass_have_gradients():
    mass = torch.zeros_like(two().mass).requires_grad_()
    empty = two().replace(mass=mass).lock("joint2")
    assert torch.autograd.grad(empty.com.sum() + empty.mass.sum(), mass)[0].tolist() == [1.0, 1.0]


@all_in_one(["X_PB_home", "screw"])
def test_the_geometry_must_be_constant(name):
    full = panda()
    learned = full.replace(**{name: getattr(full, name).clone()})
    for cut in (lambda: learned.lock(["panda_joint5"]), lambda: learned.subchain("panda_link2", "tip")):
        with refused(ArgumentError):
            cut()
    assert learned.bake().lock(["panda_joint5"]).n == 6


DIFFERENTIAL = [[0.5, 0.5], [0.5, -0.5]], ["left", "right"]
NO_LOCKS = "*", ["joint?"], {"joint3": 0.0}, 5, None, [None], {"joint1": math.nan}, {"joint1": None}
MISUSE = {
    **{f"lock {x!r}": lambda robot, x=x: robot.lock(x) for x in NO_LOCKS},
    **{f"a follower {x!r}": lambda _, x=x: mapped("gears").lock(x) for x in (["j4"], {"j4": 0.1}, "j4", ["j9"])},
    "a follower of two": lambda robot: robot.couple(*DIFFERENTIAL).lock("joint1"),
    "a chain inwards": lambda robot: robot.subchain("tip", "link1"),
    "a chain of nothing": lambda robot: robot.subchain("link1", "link1"),
    "a chain without joints": lambda robot: robot.subchain("link2", "tip"),
    "a chain from nowhere": lambda robot: robot.subchain("link9", "tip"),
}


@all_in_one(MISUSE)
def test_what_cannot_be_locked_or_cut_is_refused(case):
    with refused((ArgumentError, UnknownNameError)):
        MISUSE[case](two())


# --- chains ----------------------------------------------------------------------------------------------------------


def test_a_chain_from_the_base_to_the_tip_is_the_robot_and_stands_on_a_fixed_base():
    robot = panda()
    chain, landed = robot.subchain("base", "tip"), on_free_base(robot).subchain("base", "tip")
    assert chain.joint_names == robot.joint_names and chain.notes == robot.notes
    assert not landed.floating and noted(landed, "base.fixed")
    s = oracles.states(robot)
    whole, part, on_ground = (torchdq.inverse_dynamics(x, s.q, s.qd, s.qdd) for x in (robot, chain, landed))
    assert torch.allclose(whole, part, rtol=1e-14, atol=1e-13) and torch.equal(part, on_ground)


def test_a_chain_from_a_link_is_what_it_carries():
    """The joints before stand still at home."""
    full = panda()
    chain = full.subchain("panda_link3", "tip")
    assert chain.joint_names == full.joint_names[3:] and chain.parents == (-1, 0, 1, 2)
    without = "without the joints panda_joint1, panda_joint2, panda_joint3"
    assert noted(chain, "robot.cut")[0] == f"chain from 'panda_link3' to 'tip', {without}"
    s = oracles.states(chain)
    q, qd, qdd = (torch.cat([torch.zeros(3, 3, dtype=F64), x], -1) for x in (s.q, s.qd, s.qdd))
    found, expected = torchdq.inverse_dynamics(chain, s.q, s.qd, s.qdd), torchdq.inverse_dynamics(full, q, qd, qdd)
    assert torch.allclose(found, expected[:, 3:], rtol=1e-13, atol=1e-12)
    X = torchdq.forward_kinematics(full, q, "panda_link3")
    seen = dq.mul(X, torchdq.forward_kinematics(chain, s.q, "tip"))
    assert torch.allclose(dq.to_matrix(seen), dq.to_matrix(torchdq.forward_kinematics(full, q, "tip")), atol=1e-13)


def test_a_chain_leaves_branches_out():
    full = oracles.tree(11).robot
    tip = full.frame(full.tip)
    chain = full.subchain("base", tip.name)
    path, link = [], tip.link
    while link >= 0:
        path.insert(0, full.joint_names[link])
        link = full.parents[link]
    assert list(chain.joint_names) == path and len(path) < full.n
    s = oracles.states(chain)
    at = torch.tensor([full.joint_index(name) for name in path])
    q = full.home.expand(3, full.n).index_copy(-1, at, s.q)
    found, expected = (torchdq.forward_kinematics(*x) for x in ((chain, s.q, tip.name), (full, q, tip.name)))
    assert torch.allclose(dq.to_matrix(found), dq.to_matrix(expected), atol=1e-13)
    assert chain.mass.tolist() == [float(full.mass[full.joint_index(name)]) for name in path]


def test_robots_of_a_stack_with_different_limits_are_locked_and_cut_as_one():
    robot = panda()
    narrow = robot.replace(limits=robot.limits._replace(upper=0.5 * robot.limits.upper))
    stack = Robot.stack([robot, narrow])
    locked = stack.lock({"panda_joint1": 2.0, "panda_joint2": 0.1})
    alone = narrow.lock({"panda_joint1": 2.0, "panda_joint2": 0.1})
    assert torch.equal(locked.limits.upper[1], alone.limits.upper) and locked.mass.shape == (2, 5)
    assert "panda_joint1 at 2, limits [-2.8973, 1.44865]" in noted(locked, "lock.beyond_limits")[0]
    assert stack.subchain("panda_link3", "panda_link6").limits.upper.shape == (2, 3)


# --- joints that follow coordinates, and floating bases ---------------------------------------------------------------

GEARS = {"j2": {"j0": -1.5}, "j4": {"j3": 0.5}, "j5": {"j3": 2.0}}
LOCKS = {"plain": {"j0": 0.4, "j2": -0.3}, "gears": {"j3": 0.3}, "root": {"j0": 0.2}, "dense": {"b": 0.7, "d": -0.2}}


def mapped(kind, free=False):
    full = oracles.random_tree(6, 5).robot
    if kind == "plain":
        robot = full
    elif kind != "dense":
        robot = full.couple(GEARS, offset={"j2": 0.4})
    else:
        S = random(6, 4, seed=1)
        robot = full.couple(S, list("abcd"), offset={"j1": -0.3})
    return on_free_base(robot) if free else robot


@pytest.mark.parametrize("free", thinned([False, True], [True]))
@pytest.mark.parametrize("kind", LOCKS)
def test_a_locked_coordinate_is_one_that_stands_still(kind, free):
    """Joints that follow it alone are fixed too, and links that become part of a floating base weigh there."""
    full, lock = mapped(kind, free), LOCKS[kind]
    robot = full.lock(lock)
    assert robot.joint_names == tuple(name for name in full.joint_names if name not in lock)
    if kind == "gears":
        assert robot.every_joint == ("j0", "j1", "j2") and robot.floating == free
    if kind == "root" and free:
        assert full.parents[0] == -1 and float(robot.base_mass) > float(full.base_mass)
    kept = [full.joint_index(name) for name in robot.joint_names]
    x = random(3, 3, robot.n, seed=2)
    q, qd, qdd = torch.zeros(3, 3, full.n, dtype=F64).index_copy(-1, torch.tensor(kept), x)
    for name, value in lock.items():
        q[:, full.joint_index(name)] = value
    X = dq.exp(x.sum((0, 2))[:, None] * torch.linspace(-1, 1, 6, dtype=F64))
    V, A = random(2, 3, 6, seed=3)
    if free:
        found = torchdq.floating.inverse_dynamics(robot, X, x[0], V, x[1], A, x[2])
        expected = torchdq.floating.inverse_dynamics(full, X, q, V, qd, A, qdd)
        pairs = [(found.F_B, expected.F_B), (found.tau, expected.tau[:, kept])]
    else:
        pairs = [(torchdq.inverse_dynamics(robot, *x), torchdq.inverse_dynamics(full, q, qd, qdd)[:, kept])]
        poses = (torchdq.forward_kinematics(r, y) for r, y in ((robot, x[0]), (full, q)))
        pairs.append(tuple(dq.to_matrix(pose) for pose in poses))
    assert all(float((a - b).abs().max()) < 1e-12 * float(b.abs().max()) for a, b in pairs)


def test_a_map_that_nothing_follows_any_more_is_gone():
    robot = mapped("gears").lock(["j3", "j0"])
    assert robot.joint_names == ("j1",) and robot.joint_map is None
    q = torch.ones(3, 1, 1, dtype=F64)
    assert torchdq.inverse_dynamics(robot, *q).isfinite().all()


def test_a_coordinate_is_locked_where_its_own_joint_is_at_home():
    full = mapped("gears")
    home = float(full.home[3])
    assert home and f"locked: j3 at {home:g}, j4 at {home / 2:g}," in noted(full.lock("j3"), "lock")[0]
    same = full.lock({"j3": home})
    assert noted(full.lock({"j3": 0.3}), "lock") == ["locked: j3 at 0.3, j4 at 0.15, j5 at 0.6"]
    assert torch.equal(same.home, full.lock("j3").home) and torch.equal(same.inertia, full.lock("j3").inertia)


def test_a_batch_of_geometries_is_not_locked_and_the_message_says_how_it_can_be():
    several = Robot.stack([panda(), panda().replace(home=torch.full((7,), 0.1, dtype=F64))])
    with refused(ArgumentError):
        several.lock(["panda_joint1"])


def test_gradients_reach_a_free_base_that_links_became_part_of():
    full = mapped("gears", free=True)
    z = torch.linspace(0.1, 0.4, 3, dtype=F64)[: full.n - 1]
    X, V = torch.eye(8, dtype=F64)[0], torch.linspace(-1, 1, 6, dtype=F64)

    def forces(mass, base):
        robot = full.replace(mass=mass, base_mass=base).lock({"j0": 0.2})
        return torch.cat([*torchdq.floating.inverse_dynamics(robot, X, z, V, z, V, z)])

    values = (full.mass.clone().requires_grad_(), full.base_mass.clone().requires_grad_())
    assert torch.autograd.gradcheck(forces, values, fast_mode=True)
    batch = full.replace(base_mass=torch.tensor([3.0, 4.0], dtype=F64)).lock({"j0": 0.2})
    assert batch.base_mass.shape == (2,) and batch.base_inertia.shape == (2, 6)


def test_a_chain_keeps_the_map_of_its_coordinates():
    full = panda().couple({"panda_joint7": {"panda_joint6": 0.5}, "panda_joint3": {"arm": 2.0}})
    chain = full.subchain("panda_link5", "tip")
    assert chain.joint_names == ("panda_joint6",) and chain.every_joint == ("panda_joint6", "panda_joint7")
    x = random(3, 3, 1, seed=2)
    k = full.joint_index("panda_joint6")
    q = torch.zeros(3, 3, full.n, dtype=F64).index_copy(-1, torch.tensor([k]), x)
    found, expected = torchdq.inverse_dynamics(chain, *x), torchdq.inverse_dynamics(full, *q)[:, [k]]
    assert torch.allclose(found, expected, rtol=1e-12, atol=1e-13)
    assert torch.equal(chain.limits.upper, full.limits.upper[[k]])


def test_a_chain_whose_coordinates_move_other_joints_is_refused():
    shared = panda().couple({"panda_joint7": {"panda_joint2": 0.5}})
    with refused(ArgumentError):
        shared.subchain("panda_link5", "tip")
    assert shared.subchain("panda_link1", "tip").joint_names == shared.joint_names[1:]
    hand = Robot.from_urdf(oracles.urdf_paths()["panda"])
    hand = hand.couple({"panda_finger_joint2": {"panda_finger_joint1": 1.0}}) if hand.joint_map is None else hand
    assert hand.subchain("panda_hand", "panda_leftfinger").joint_names == ("panda_finger_joint1",)
    with refused(ArgumentError):
        hand.subchain("panda_hand", "panda_rightfinger")
