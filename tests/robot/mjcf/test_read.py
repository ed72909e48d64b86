"""Robots from MJCF files agree with MuJoCo itself, which computes in other frames and with other algorithms.

An error of torques and of the mass matrix is relative to the largest number of its kind.
"""

import sys
import warnings

import messages
import mujoco
import numpy as np
import oracles
import pinocchio as pin
import torch
from helpers import all_in_one
from messages import refused
from mjcf_text import ARM, COUPLED, FREE, fixed_assets, model_of, random_mjcf
from robots import noted
from rotations import tensor
from urdf_text import codes

import torchdq
from torchdq import dq
from torchdq.robot.mjcf import read as mjcf

TOLERANCE = 1e-10
CASES = {"arm": ARM, **{f"random{i}": random_mjcf(i) for i in range(6)}} | {path.stem: path for path in fixed_assets()}


def near(found, reference, tolerance: float = TOLERANCE) -> None:
    """Compare with numbers of one kind."""
    found, reference = np.asarray(found), np.asarray(reference)
    assert found.shape == reference.shape
    if reference.size:
        assert np.abs(found - reference).max() <= tolerance * max(1.0, np.abs(reference).max())


def transform(x: torch.Tensor) -> np.ndarray:
    """Homogeneous matrix of a pose."""
    return torchdq.dq.to_matrix(x).numpy()


def xpose(data) -> np.ndarray:
    """Homogeneous matrix of a body or site of MuJoCo's data."""
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = data.xmat.reshape(3, 3), data.xpos
    return X


def forwarded(model: mujoco.MjModel) -> mujoco.MjData:
    """Data of a model where it begins."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


@all_in_one(CASES)
def test_dynamics_agree_with_mujoco(name):
    source = CASES[name]
    model, robot = model_of(source), torchdq.Robot.from_mjcf(source, on_unphysical="ignore")
    data = mujoco.MjData(model)
    assert robot.n == model.nv
    s = oracles.states(robot, batch=2)
    tau, M = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd), torchdq.mass_matrix(robot, s.q)
    for k in range(len(s.q)):
        data.qpos[:], data.qvel[:] = s.q[k].numpy(), s.qd[k].numpy()
        mujoco.mj_forward(model, data)
        reference = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, reference)
        near(M[k], reference)
        near(tau[k], reference @ s.qdd[k].numpy() + data.qfrc_bias)


@all_in_one(["arm", "random0", "random1"])
def test_frames_and_jacobians_agree_with_mujoco(name):
    source = CASES[name]
    model, robot = model_of(source), torchdq.Robot.from_mjcf(source)
    data = mujoco.MjData(model)
    q = oracles.states(robot).q[0]
    data.qpos[:] = q.numpy()
    mujoco.mj_forward(model, data)
    poses = dict(zip(robot.frame_names, torchdq.forward_kinematics(robot, q), strict=True))
    for i in range(model.nbody):
        name = model.body(i).name
        near(transform(poses[name]), xpose(data.body(i)))
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, linear, angular, i)
        near(torchdq.jacobian(robot, q, name, expressed="world"), np.concatenate([angular, linear]))
    for i in range(model.nsite):
        name = model.site(i).name + ("_site" if model.site(i).name == "plate" else "")
        near(transform(poses[name]), xpose(data.site(i)))


@all_in_one(["panda", "simple_humanoid", "talos_left_arm", "ur5_gripper"])
def test_a_robot_from_urdf_is_that_from_mujocos_reading_of_the_urdf(name):
    text = oracles.rigid_bodies(name)
    with messages.warned(UserWarning):
        other = torchdq.Robot.from_mjcf(text, gravity=(0, 0, -9.81))
    robot = oracles.example_case(name).robot
    s, order = oracles.states(robot), [robot.joint_index(joint) for joint in other.joint_names]
    tau = torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd)[:, order]
    other_tau = torchdq.inverse_dynamics(other, *(x[:, order] for x in (s.q, s.qd, s.qdd)))
    near(other_tau, tau, 1e-9)  # MuJoCo's principal axes


# --- numbers of the joints -------------------------------------------------------------------------------------------


def test_numbers_of_joints_are_the_files():
    robot = torchdq.Robot.from_mjcf(ARM)
    assert robot.name == "arm" and robot.joint_names == ("turn", "tilt", "slide", "joint3", "yaw")
    assert robot.link_names == ("shoulder before turn", "shoulder", "rail", "hand", "tower")
    assert robot.kinds == ("revolute", "revolute", "prismatic", "revolute", "revolute")
    assert robot.parents == (-1, 0, 1, 2, -1)
    inf, degree = np.inf, np.pi / 180
    near(robot.home, [0, 20 * degree, 0.1, 0, 0])
    near(robot.armature, [0.02 + 9 * 0.01, 0.02, 0.4, 0.02, 0.02])
    near(robot.damping, [0.5 + 9 * 0.1, 0.5, 0.5, 0, 0.5])
    near(robot.friction, [0, 0.3, 0, 0, 0])
    near(robot.gravity, [0.3, -1, -9])
    near([robot.limits.lower[0], robot.limits.upper[0]], [-90 * degree, 120 * degree])
    assert robot.limits.lower[1:].tolist() == [-inf] * 4
    assert robot.limits.effort.tolist() == [3 * 2 + 2 * 5, inf, inf, inf, inf]
    assert [robot.frame(name).link for name in ("plate", "plate_site", "foot")] == [1, 1, -1]
    assert robot.tip is None and torchdq.Robot.from_mjcf(ARM, tip="mark").tip == "mark"


def test_parts_that_are_not_used_are_noted():
    assert codes(torchdq.Robot.from_mjcf(ARM)) >= {
        ("damping.unused", "turn, tilt, slide, yaw"),
        ("friction.unused", "tilt"),
        ("limits.unused", "turn"),
        ("joint.unactuated", "tilt, joint3, yaw"),
        ("unsimulated.actuator", "actuator0 (gear 3), actuator1 (gear -2), actuator2"),
        ("unsimulated.contact", "geoms"),
        ("body.lumped", ""),
        ("tip.missing", ""),
    }
    extras = """<mujoco><option density="1.2"/><worldbody><body name="b" gravcomp="0.5"><joint name="j" stiffness="2"/>
      <geom size="1"/><site name="s"/><body name="c" pos="1 0 0"><joint name="k"/><geom size="1"/></body></body>
      <body name="m" mocap="true"/></worldbody>
      <tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>
      <equality><connect name="loop" body1="c" body2="b" anchor="0 0 0"/>
      <joint name="curve" joint1="k" joint2="j" polycoef="0 1 2 0 0"/></equality>
      <actuator><general name="pull" tendon="t"/></actuator></mujoco>"""
    with messages.warned(UserWarning):
        robot = torchdq.Robot.from_mjcf(extras)
    left_out = {"spring": "j", "actuator": "pull", "tendon": "t", "fluid": "air or water", "gravcomp": "b"}
    assert codes(robot) >= {("body.mocap", ""), *((f"unsimulated.{part}", name) for part, name in left_out.items())}
    assert "pull: actuators that act on no joint, not used" in str(robot.report())


FOUR_BAR = """<mujoco><worldbody><site name="post" pos=".6 0 0"/><body name="a"><joint name="j"/><geom size=".1"/>
  <body name="b" pos=".3 0 0"><joint name="k"/><geom size=".1"/><site name="end"/></body></body>
  <body name="c" pos=".6 0 0"><joint name="m"/><geom size=".1"/></body></worldbody>
  <tendon><fixed name="s"><joint joint="j" coef="1"/></fixed>
  <fixed name="t"><joint joint="m" coef="1"/></fixed></tendon>
  <equality>{}</equality></mujoco>"""
OPEN = {  # constraint: its subject, and what a warning of it names
    '<joint name="curve" joint1="k" joint2="j" polycoef="0 1 2 0 0"/>': ("joint 'curve'", ("k", "j")),
    '<tendon name="pull" tendon1="s" tendon2="t"/>': ("tendon 'pull'", ("s", "t")),
}


@all_in_one(OPEN)
def test_an_equality_constraint_that_is_left_open_is_warned_of_by_name(constraint):
    subject, ends = OPEN[constraint]
    with messages.warned(UserWarning) as caught:
        robot = torchdq.Robot.from_mjcf(FOUR_BAR.format(constraint))
    assert [x.subject for x in robot.notes if x.code == "unsimulated.equality"] == [subject]
    assert all(repr(end) in str(caught[0].message) for end in ends) and robot.n == 3
    off = constraint.replace("/>", ' active="false"/>')
    assert not [x for x in torchdq.Robot.from_mjcf(FOUR_BAR.format(off)).notes if x.code == "unsimulated.equality"]


CLOSED = (
    '<connect name="loop" body1="b" body2="c" anchor=".3 0 0"/>',
    '<connect body1="b" anchor=".3 0 0"/>',
    '<connect name="loop" site1="end" site2="post"/>',
    '<weld name="loop" body1="b" body2="c"/>',
    '<weld name="loop" body1="b" body2="c" anchor=".1 .2 .3" relpose=".4 .1 0 .6 0 0 .8"/>',
    '<weld name="loop" site1="end" site2="post"/>',
    '<weld name="loop" body1="b" body2="c" anchor=".1 .2 .3" torquescale="0"/>',
)


@all_in_one(CLOSED)
def test_connect_and_weld_are_closures_with_the_gaps_of_mujoco(constraint):
    text = FOUR_BAR.format(constraint)
    robot = torchdq.Robot.from_mjcf(text)
    (closure,) = robot.closures
    assert closure.kind == ("weld" if "weld" in constraint and "torquescale" not in constraint else "point")
    model = mujoco.MjModel.from_xml_string(text)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(3):
        data.qpos[:] = rng.normal(size=3)
        mujoco.mj_forward(model, data)
        found = torchdq.closure_errors(robot, torch.tensor(data.qpos))
        near(found.distance, [np.linalg.norm(data.efc_pos[:3])])
        # MuJoCo's rows are the vector part of a quaternion, the sine of half of the angle
        half = np.linalg.norm(data.efc_pos[3:6]) if closure.kind == "weld" else 0.0
        near(found.angle, [2 * np.arcsin(half)])


def test_a_loop_that_locked_joints_close_is_no_closure():
    loop = FOUR_BAR.format('<connect name="loop" body1="b" body2="c" anchor=".3 0 0"/>')
    still = torchdq.Robot.from_mjcf(loop, joints=["j"], lock=["k", "m"], on_unphysical="ignore")
    assert len(still.closures) == 1  # a moves b, and c stands
    rigid = FOUR_BAR.format('<weld name="w" body1="a" body2="b"/>')
    assert torchdq.Robot.from_mjcf(rigid, lock="k").closures == ()


def test_a_floating_base_that_is_held_to_the_world_is_warned_of():
    text = FREE.replace("</mujoco>", '<equality><connect body1="torso" anchor="0 0 0"/></equality></mujoco>')
    with messages.warned(UserWarning):
        robot = torchdq.Robot.from_mjcf(text)
    assert ("unsimulated.equality", "connect 'equality0'") in codes(robot) and not robot.closures


def test_gravity_is_the_files_unless_it_is_given():
    near(torchdq.Robot.from_mjcf(ARM, gravity=(0, 0, -1)).gravity, [0, 0, -1])
    assert torchdq.Robot.from_mjcf(ARM, gravity=None).gravity is None
    off = ARM.replace('gravity="0.3 -1 -9"/>', '><flag gravity="disable"/></option>')
    for text in (off, ARM.replace("0.3 -1 -9", "0 0 0")):
        assert torchdq.Robot.from_mjcf(text).gravity is None


def test_bodies_that_are_all_compensated_for_gravity_feel_none():
    text = "<mujoco><worldbody><body gravcomp='1'><joint/><geom size='1'/>{}</body></worldbody></mujoco>"
    robot = torchdq.Robot.from_mjcf(text.format(""))
    assert robot.gravity is None and ("gravity.compensated", "") in codes(robot)
    heavy = "<body name='heavy' pos='1 0 0'><joint/><geom size='1'/></body>"
    with messages.warned(UserWarning):
        assert torchdq.Robot.from_mjcf(text.format(heavy)).gravity is not None


def warned(load, *arguments, **options):
    """Result of loading, and the lines of its warnings but their headings."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        found = load(*arguments, **options)
    return found, [line.strip() for warning in seen for line in str(warning.message).splitlines()[1:]]


@all_in_one([("0", "1", "b"), ("0.5", "0.5", "a, b"), ("1", "1", ""), ("0", "0", "")])
def test_gravity_that_is_compensated_in_part_is_warned_of(bodies):
    """MuJoCo relieves these bodies, and a robot has one gravity for all."""
    a, b, named = bodies
    geom = "<geom size='1' contype='0' conaffinity='0'/>"
    ball = f"<joint type='slide'/>{geom}"
    bodies = f"<body name='a' gravcomp='{a}'>{ball}<body name='b' gravcomp='{b}'>{ball}</body></body>"
    stand = f"<body name='stand' gravcomp='1'>{geom}{bodies}</body>"
    text = f"<mujoco><worldbody>{stand}</worldbody></mujoco>"
    robot, lines = warned(torchdq.Robot.from_mjcf, text)
    assert lines == [f"{named}: gravcomp ignored: gravity acts on these bodies in full"] * bool(named)
    assert set(lines) <= {*map(str, robot.notes)}
    for quiet in ({"gravity": None}, {"on_unphysical": "ignore"}):
        assert warned(torchdq.Robot.from_mjcf, text, **quiet)[1] == []
    rises = torchdq.forward_dynamics(robot, *torch.zeros(3, 2, dtype=torch.float64))
    assert np.allclose(rises, forwarded(model_of(text)).qacc, atol=1e-9) == (not named)


# --- joints that are locked or coupled -------------------------------------------------------------------------------


def test_a_locked_joint_stands_where_it_is_put():
    robot = torchdq.Robot.from_mjcf(ARM)
    for lock in ({"turn": 0.4, "slide": -0.3}, {"tilt": 1.0, "j*": 0.2}, ["t*"]):
        near_robot(torchdq.Robot.from_mjcf(ARM, lock=lock), robot.lock(lock))
    assert torchdq.Robot.from_mjcf(ARM, joints="t*").joint_names == ("turn", "tilt")
    near_robot(torchdq.Robot.from_mjcf(ARM, joints="t*"), robot.lock(["slide", "joint3", "yaw"]))


def near_robot(a: torchdq.Robot, b: torchdq.Robot) -> None:
    """Compare the torques of two robots with the same joints."""
    assert a.joint_names == b.joint_names
    s = oracles.states(a)
    near(*(torchdq.inverse_dynamics(robot, s.q, s.qd, s.qdd) for robot in (a, b)))


def coupled(**arguments) -> torchdq.robot.description.RobotDescription:
    """Description of the robot with coupled joints."""
    return mjcf.read(COUPLED, "file", **arguments).description


def test_linear_couplings_of_joints_are_a_map_of_coordinates():
    found, model = coupled(), model_of(COUPLED)
    assert found.joint_names == ("lift", "left")
    assert found.joint_map.joint_names == ("lift", "left", "tip", "right")
    near(found.joint_map.S, [[1, 0], [0, 1], [0, 1], [0, -2]])
    q = torch.tensor([0.5, 0.7], dtype=torch.float64)
    displaced = dict(zip(found.joint_map.joint_names, (found.joint_map.S @ q - found.home).tolist(), strict=True))
    data = mujoco.MjData(model)
    for name, x in displaced.items():
        data.joint(name).qpos[0] = model.qpos0[model.joint(name).qposadr[0]] + x
    mujoco.mj_forward(model, data)
    assert np.abs(data.efc_pos[: data.ne]).max() < 1e-15  # all equality constraints hold
    near(displaced["left"], 0.7 - 0.3)
    near(found.damping, [0, 2 + 4 * 3])
    near(found.friction, [0, 0.5 + 2 * 0.25])
    near(found.armature, [0, 0.1 + 4 * 0.2])
    near(found.limits.effort[1:], [3 + 2 * 1])
    # left follows its own limits, and those of the joint that follows it at the displacement of left + const
    shift = displaced["tip"] - displaced["left"]
    near(found.limits.lower[1:], [max(-1, 0.3 + 0 - shift)])
    near(found.limits.upper[1:], [min(2, 0.3 + 1.5 - shift)])


def test_joints_that_are_coupled_to_a_locked_one_are_locked():
    found = coupled(lock={"left": 0.4})
    assert found.joint_names == ("lift",) and found.joint_map is None
    assert noted(found, "lock") == ["locked: left at 0.4, tip at 0.075, right at -0.25"]
    assert coupled(kept="right").joint_names == ("left",)


def test_a_coupling_that_is_said_twice_holds_no_joint():
    text = COUPLED.replace("0.05 -2", "0.05 -3").replace("0.025 -0.5", "0.0166666667 -0.3333333333")
    assert mjcf.read(text, "file").description.joint_names == ("lift", "left")


def test_positions_beyond_the_range_are_warned_of_and_ranges_that_end_before_they_begin_are_noted():
    with messages.warned(UserWarning) as seen:
        torchdq.Robot.from_mjcf(ARM, lock={"turn": 90})
    assert seen[0].filename == __file__
    robot = torchdq.Robot.from_mjcf(ARM.replace('range="-90 120"', 'range="120 -90"'))
    assert ("limits.reversed", "turn") in codes(robot)


def test_joints_that_couplings_hold_are_told_from_locked_ones():
    text = COUPLED.replace('joint2="left" polycoef="0.05 -2', 'polycoef="0.05 0')
    robot = torchdq.Robot.from_mjcf(text)
    (note,) = noted(robot, "joint.stuck")
    assert note.endswith("held by equality constraints: left at 0.3, tip at -0.025, right at -0.05")
    assert robot.joint_names == ("lift",) and not noted(robot, "lock")


@all_in_one(["equality", "constraint"])
def test_couplings_that_a_flag_disables_are_noted_and_not_used(flag):
    text = COUPLED.replace("<worldbody>", f"<option><flag {flag}='disable'/></option><worldbody>", 1)
    robot = torchdq.Robot.from_mjcf(text)
    assert robot.joint_map is None and "right" in robot.joint_names
    assert any("joint 'both'" in subject for code, subject in codes(robot) if code == "unsimulated.equality")


# --- floating bases ---------------------------------------------------------------------------------------------------


def test_a_free_joint_makes_a_floating_base():
    found, gravity = mjcf.read(FREE, "file")[:2]
    assert found.joint_names == ("hip",) and found.parents == (-1,) and not codes(found, ("error", "warning"))
    near(gravity, (0, 0, -3.7))
    assert [(frame.name, frame.link) for frame in found.frames] == [("torso", -1), ("head", -1), ("leg", 0)]
    # the mass matrix of the torso and head alone
    model = model_of(FREE.split('<body name="leg"')[0] + "</body></worldbody></mujoco>")
    data, M = mujoco.MjData(model), np.zeros((6, 6))
    data.qpos[3:] = 1, 0, 0, 0
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, M)
    m, skew = float(found.base_mass), pin.skew(found.base_com.numpy())
    about_com = tensor(found.base_inertia.tolist())
    near(M, np.block([[m * np.eye(3), -m * skew], [m * skew, about_com - m * skew @ skew]]))


def test_a_free_base_is_held_on_request():
    robot, data = torchdq.Robot.from_mjcf(FREE, base="fixed"), forwarded(model_of(FREE))
    assert robot.base_mass is None and ("joint.held", "root") in codes(robot)
    near(transform(torchdq.forward_kinematics(robot, torch.zeros(1).double(), "head")), xpose(data.body("head")))
    assert torchdq.Robot.from_mjcf(FREE, lock=["root"]).base_mass is None


def test_armature_of_a_free_joint_is_warned_of():
    """MuJoCo adds it to the mass matrix of the base where a joint of type "free" inherits it; <freejoint/> does not."""
    default = '<default><joint armature="0.7" damping="0.1"/></default><worldbody>'
    freed = FREE.replace("<worldbody>", default)
    joint = freed.replace('<freejoint name="root"/>', '<joint name="root" type="free"/>')
    for text, armature in ((FREE, 0.0), (freed, 0.0), (joint, 0.7)):
        assert model_of(text).dof_armature[:6].tolist() == [armature] * 6
        robot, lines = warned(torchdq.Robot.from_mjcf, text)
        assert [line.split(" ignored")[0] for line in lines] == ["free joint 'root': armature"] * bool(armature)
        assert all("write <freejoint/>" in line and line in map(str, robot.notes) for line in lines)
        near(robot.base_mass, float(torchdq.Robot.from_mjcf(FREE).base_mass))
    assert warned(torchdq.Robot.from_mjcf, joint, base="fixed")[1] == []
    assert ("unsimulated.base", "root") in codes(robot)


BALL = "<body name='x' pos='1 0 0'><joint name='knob' type='ball'/><geom size='1'/></body>"
CUBE = "<body name='cube'><freejoint name='loose'/><geom size='1'/></body>"
DOOR = "<body name='door'><joint name='hinge'/><geom size='1'/></body>"


OF_ARM = [{"base": "floating"}, {"base": "flying"}, {"lock": "*"}, {"lock": ["elbow"]}, {"joints": []}]
OF_ARM += [{"joints": ["turn"], "lock": ["turn"]}, {"tip": "finger"}, {"gravity": "moon"}]
AGAINST_A_COUPLING = (COUPLED, {"lock": {"left": 0.4, "tip": 1.0}})
OPTIONS = [*((ARM, x) for x in OF_ARM), (FREE, {"lock": {"root": 0.0}}), (3, {}), AGAINST_A_COUPLING]
TWICE = "".join(f"<joint name='{x}' joint1='j' joint2='k' polycoef='0 {x} 0 0 0'/>" for x in "12")
STUCK = f"""<mujoco><worldbody><body name='a'><joint name='j'/><geom size='1'/><body name='b'><joint name='k'/>
<geom size='1'/></body></body></worldbody><equality>{TWICE}</equality></mujoco>"""
FAULTY = [
    STUCK,
    FREE.replace('<body name="leg"', BALL.replace("/><geom", "/><joint/><geom") + '<body name="leg"'),
    FREE.replace("</worldbody>", CUBE + "</worldbody>"),
    FREE.replace("</worldbody>", DOOR + "</worldbody>"),
    "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>",
    ARM.replace('frictionloss="0.3"', 'frictionloss="nan"'),
    ARM.replace('damping="0.5"', 'damping="-1"'),
    ARM.replace('ref="0.1"', 'ref="1e60"'),
    ARM.replace('mass="3"', 'mass="1e60"'),
    COUPLED.replace("0 -0.5 0", "0 1e60 0"),
    COUPLED.replace("0.05 -2", "nan -2"),
    COUPLED.replace("0.025 -0.5", "0.1 -0.5"),  # couplings that contradict each other
    *("<mujoco", "<sdf/>", b"\xff<mujoco/>", "<mujoco>\0</mujoco>", "no/such.xml"),
]


@all_in_one([*OPTIONS, *((text, {}) for text in FAULTY)])
def test_files_and_arguments_that_make_no_robot_are_refused(given):
    text, arguments = given
    with refused(torchdq.TorchdqError):
        torchdq.Robot.from_mjcf(text, **arguments)


def test_a_ball_joint_is_three_hinges_with_a_warning_of_their_range():
    """Three hinges about x, y and z have the orientation of the ball joint whose quaternion is their product."""
    knob = BALL.replace("/>", " damping='.3' pos='.1 .2 .3'/>", 1)
    text = f"<mujoco><worldbody>{knob}</worldbody></mujoco>"
    with messages.warned(UserWarning):
        robot = torchdq.Robot.from_mjcf(text)
    assert robot.joint_names == ("knob_x", "knob_y", "knob_z") and ("joint.ball", "ball joint 'knob'") in codes(robot)
    near(robot.damping, [0.3] * 3)
    model = mujoco.MjModel.from_xml_string(text)
    data, q = mujoco.MjData(model), torch.tensor([0.4, -0.9, 1.3], dtype=torch.float64)
    x, y, z = dq.exp(torch.cat([torch.diag(q / 2), torch.zeros(3, 3).double()], -1))
    data.qpos[:] = dq.mul(dq.mul(x, y), z)[:4].numpy()
    mujoco.mj_forward(model, data)
    X = torchdq.forward_kinematics(robot, q, "x")
    near(dq.translation(X), data.xpos[1])
    near(dq.to_matrix(X)[:3, :3], data.xmat[1].reshape(3, 3))
    more = text.replace("</body>", "<body><joint/><geom size='1'/></body></body>")
    held = torchdq.Robot.from_mjcf(more, lock="knob_*")
    assert held.n == 1 and not [x for x in held.notes if x.code == "joint.ball"]


# --- files -----------------------------------------------------------------------------------------------------------

MESHES = """
<mujoco><compiler meshdir="meshes"/>
  <asset>
    <mesh name="a" file="a.stl"/><mesh file="b.obj"/>
    <texture name="t" type="2d" file="t.png"/><material name="m" texture="t"/>
  </asset>
  <default><default class="visual"><geom type="mesh" mass="0" material="m"/></default></default>
  <worldbody>
    <geom type="mesh" mesh="a"/>
    <body name="stated"><joint name="j"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <geom name="g" type="mesh" mesh="a" material="m"/>
      <body name="shown"><joint axis="1 0 0"/><geom size="1"/><geom class="visual" mesh="b"/></body>
    </body>
  </worldbody>
  <contact><pair geom1="g" geom2="g"/></contact>
  <sensor><framepos objtype="geom" objname="g"/></sensor>
</mujoco>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_meshes_that_give_mass_are_needed_and_no_others_are_opened(tmp_path):
    assert torchdq.Robot.from_mjcf(MESHES).link_names == ("stated", "shown")
    text = MESHES.replace('<geom size="1"/>', '<geom type="mesh" mesh="b"/>')
    with refused(torchdq.DescriptionError):
        torchdq.Robot.from_mjcf(text)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "b.obj").write_text(TETRAHEDRON)
    (tmp_path / "robot.xml").write_text(text)
    robot = torchdq.Robot.from_mjcf(tmp_path / "robot.xml")
    near(robot.mass, [1, 1000 / 6], 1e-6)


def test_files_include_others_beside_them(tmp_path):
    (tmp_path / "part.xml").write_text("<mujoco><body name='b'><joint name='j'/><geom size='1'/></body></mujoco>")
    path = tmp_path / "robot.xml"
    path.write_text("<mujoco><worldbody><include file='part.xml'/></worldbody></mujoco>")
    assert torchdq.Robot.from_mjcf(path).joint_names == ("j",)
    assert torchdq.Robot.from_mjcf(f"file://{path}").joint_names == ("j",)
    (tmp_path / "whole.xml").write_text(ARM)
    with (tmp_path / "whole.xml").open() as file:
        assert torchdq.Robot.from_mjcf(file).name == "arm"


def test_without_mujoco_a_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with refused(torchdq.MissingLibraryError):
        torchdq.Robot.from_mjcf(ARM)
