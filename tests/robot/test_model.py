"""Names and numbers of a robot: it does not change, its copies do, and changes in place do not go unseen."""

import copy
import dataclasses
import pickle

import pytest
import torch
from helpers import all_in_one, thinned
from messages import refused
from robots import ARMS, BALL, F64, LINE, one_joint, panda, same, states, torques, two

import torchdq
from torchdq import ArgumentError, Robot, Scene, UnknownNameError, effects
from torchdq.robot import Frame


def tensors(robot):
    fields = {f.name: getattr(robot, f.name) for f in dataclasses.fields(robot)}
    found = {name: x for name, x in fields.items() if isinstance(x, torch.Tensor)}
    found |= {f"limits.{name}": x for name, x in robot.limits._asdict().items()}
    return found | {f"frame {frame.name}": frame.X_BF for frame in robot.frames}


@all_in_one(thinned(ARMS, ["two_link", "puma560"]))
def test_no_function_modifies_a_robot(name):
    robot = torchdq.robots.load(name)
    before = {key: x.clone() for key, x in tensors(robot).items()}
    q, qd, qdd = states(robot.n, rows=1)
    torchdq.inverse_dynamics(robot, q, qd, qdd, torch.ones(6, dtype=F64), torch.ones(robot.n, 6, dtype=F64))
    for function in (torchdq.forward_dynamics, torchdq.regressor, torchdq.dynamics_jacobian):
        function(robot, q, qd, qdd)
    torchdq.closed_form(robot, q, qd)
    torchdq.forward_kinematics(robot, q)
    torchdq.jacobian(robot, q, "tip")
    torchdq.inverse_dynamics(robot, q.float())
    robot.replace(mass=2 * robot.mass).to(torch.float32).with_tip("base").report()
    robot.lock([robot.joint_names[0]])
    robot.subchain(robot.link_names[0], "tip")
    palm = {"base_mass": torch.tensor(0.5), "base_com": torch.zeros(3), "base_inertia": torch.zeros(6)}
    robot.with_payload(1.0).with_tool("pen", robot.frame("tip").X_BF).attach(two().replace(**palm), "pen", prefix="o_")
    assert all(torch.equal(x, before[key]) for key, x in tensors(robot).items())


def test_assignment_names_replace():
    with refused(torchdq.errors.FrozenError):
        panda().mass = torch.ones(7)
    with pytest.raises(dataclasses.FrozenInstanceError, match="a Robot does not change"):
        del panda().mass


def test_a_robot_is_in_double_precision_and_converted_as_tensors_of_torch_are():
    robot = torchdq.robots.load("puma560")
    assert {x.dtype for x in tensors(robot).values()} == {F64}
    for cast in (robot.to("float32"), robot.to(torch.float32), robot.to(dtype="float32"), robot.to("float32", "cpu")):
        assert {x.dtype for x in tensors(cast).values()} == {torch.float32}
    for moved in (robot.to("meta"), robot.to(torch.device("meta")), robot.to(device="meta")):
        assert {x.device.type for x in tensors(moved).values()} == {"meta"}
    for wrong in (("gpu",), ("cpu", "meta"), (torch.float16,)):
        with refused((ArgumentError, torchdq.DtypeError)):
            robot.to(*wrong)
    for device in ("cuda:99", "gpu", 3.5):
        with refused(ArgumentError):
            robot.to(device=device)


def test_a_robot_without_values_takes_no_arguments_with_values():
    robot = two().to("meta")
    for function in (torchdq.inverse_dynamics, torchdq.forward_kinematics, torchdq.mass_matrix):
        with refused(torchdq.ArgumentError):
            function(robot, torch.zeros(2))
        assert function(robot, torch.zeros(2, device="meta")).is_meta


@all_in_one(["mass", "com", "gravity"])
def test_tensors_without_values_make_results_without_values_or_are_named(field):
    robot = two()
    robot = robot.replace(**{field: getattr(robot, field).to("meta")})
    for function in (torchdq.inverse_dynamics, torchdq.mass_matrix):
        with refused(ArgumentError):
            function(robot, torch.zeros(2))
        assert function(robot, torch.zeros(2, device="meta")).is_meta
    assert "2 joints" in repr(robot)


# --- names -----------------------------------------------------------------------------------------------------------


def test_a_frame_has_a_name_a_link_and_a_pose():
    frame = panda().frame("tip")
    assert isinstance(frame, Frame) and frame.name == "tip" and frame.link == 6
    assert same(frame.X_BF, [1, 0, 0, 0, 0, 0, 0, 0.107 / 2])
    assert panda().frame("base").link == -1 and panda().joint_index("panda_joint3") == 2


def test_the_tip_can_be_another_frame():
    assert panda().with_tip("panda_link3").tip == "panda_link3" and panda().with_tip(None).tip is None


@all_in_one([("with_tip", "panda_link9"), ("frame", "tips"), ("joint_index", "joint3")])
def test_a_name_that_does_not_exist_names_the_closest(call):
    method, name = call
    with refused(UnknownNameError) as caught:
        getattr(panda(), method)(name)
    assert isinstance(caught.value, KeyError)


# --- changes in place ------------------------------------------------------------------------------------------------

CONSTANTS = ["mass", "com", "inertia", "gravity", "X_PB_home", "screw", "damping", "friction", "limits.effort"]
CONSTANTS += ["frame tip"]


def uses(robot):
    """Everything that reads a robot's constants."""
    q = torch.ones(robot.n, dtype=F64)
    return {
        "function": lambda: torchdq.inverse_dynamics(robot, q),
        "kinematics": lambda: torchdq.forward_kinematics(robot, q),
        "module": lambda: torchdq.DQRNEA(robot)(q),
        "learned module": lambda: torchdq.DQRNEA(robot, learn=("offset",))(q),
        "compile": lambda: torchdq.compile(robot, "inverse_dynamics"),
        "scene": lambda: Scene(robot, (effects.Gravity(),)),
        "replace": lambda: robot.replace(com=robot.com.clone()),
        "with_tip": lambda: robot.with_tip(None),
        "to": lambda: robot.to(torch.float32),
        "bake": lambda: robot.bake(),
        "tree": lambda: robot.tree(),
        "report": lambda: robot.report(),
        "parameters": lambda: robot.inertial_parameters,
        "pickle": lambda: pickle.dumps(robot),
        "copy": lambda: copy.deepcopy(robot),
        "check": lambda: robot.check(),
    }


USES = list(uses(two()))


@all_in_one(USES)
def test_a_constant_that_was_changed_in_place_is_told_at_the_next_use(use):
    robot = two()
    uses(robot)[use]()
    robot.mass.mul_(2)
    with refused(ArgumentError):
        uses(robot)[use]()


@all_in_one(CONSTANTS)
def test_every_constant_is_watched(name):
    robot = two()
    tensors(robot)[name].fill_(3)
    with refused(ArgumentError):
        torchdq.inverse_dynamics(robot, torch.ones(2, dtype=F64))


def test_a_scene_sees_that_its_robot_was_changed_in_place():
    robot = two()
    scene, q = Scene(robot, (effects.Viscous(),)), torch.zeros(2, dtype=F64)
    scene.step(scene.start(q, q))
    robot.damping.add_(5.0)
    with refused(ArgumentError):
        scene.step(scene.start(q, q))


@all_in_one([copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_are_watched_too(copied):
    for constant in ("mass", "limits.lower"):
        original = two()
        robot = copied(original)
        assert torch.equal(torques(robot), torques(original))
        tensors(robot)[constant].fill_(3)
        with refused(ArgumentError):
            torques(robot)
        torques(original)


def test_a_robot_shares_no_tensor_with_another_by_chance():
    a, b = (Robot.from_screws([LINE], [2.0], [[0.1, 0.2, 0.3]], [BALL]) for _ in range(2))
    a.frames[0].X_BF.mul_(2)
    torques(b)
    mass = torch.ones(1, dtype=F64)
    baked = b.replace(mass=mass).bake()
    mass.mul_(3)
    assert baked.mass.tolist() == [1.0]
    torques(baked)


def test_a_replaced_tensor_may_be_changed_in_place():
    robot = two()
    q, mass = torch.ones(2, dtype=F64), torch.nn.Parameter(robot.mass)  # one storage with the robot
    learned = robot.replace(mass=mass)
    before = torchdq.inverse_dynamics(learned, q)
    with torch.no_grad():
        mass.mul_(2)
    assert not torch.equal(torchdq.inverse_dynamics(learned, q), before)
    with refused(ArgumentError):
        torchdq.inverse_dynamics(robot, q)


@all_in_one(["damping", "friction", "limits", "frames"])
def test_other_replaced_tensors_are_copied(field):
    """Writing into the given tensor changes neither the robot nor a scene; into the robot's own it is refused."""
    robot = two()
    mine = getattr(copy.deepcopy(robot), field)
    changed = robot.replace(**{field: mine})
    pick = {"limits": lambda x: x.effort, "frames": lambda x: x[0].X_BF}.get(field, lambda x: x)
    pick(mine).fill_(7.0)
    assert torch.equal(pick(getattr(changed, field)), pick(getattr(robot, field)))
    Scene(changed)
    pick(getattr(changed, field)).fill_(7.0)
    with refused(ArgumentError):
        Scene(changed)


def test_robots_of_inference_mode_are_watched():
    with torch.inference_mode():
        robot = two().replace(mass=torch.ones(2, dtype=F64)).bake()
        torques(robot)
    robot.mass.mul_(2)
    with refused(ArgumentError):
        torques(robot)


@all_in_one(USES)
def test_a_constant_that_requires_grad_is_told_at_the_next_use(use):
    robot = two()
    robot.mass.requires_grad_()
    with refused(ArgumentError):
        uses(robot)[use]()
    tau = torchdq.inverse_dynamics(robot.replace(mass=robot.mass), torch.ones(2, dtype=F64))
    tau.sum().backward()
    assert robot.mass.grad is not None
    robot.mass.requires_grad_(False)
    uses(robot)[use]()


@all_in_one(["auto", "eager"])
def test_a_robot_made_of_a_tensor_that_requires_grad_is_told(backend):
    robot = one_joint(LINE, mass=torch.ones(1, dtype=F64, requires_grad=True))
    with refused(ArgumentError):
        torchdq.inverse_dynamics(robot, torch.ones(1, dtype=F64), backend=backend)


@all_in_one(["data", "numpy"])
def test_writes_that_torch_does_not_count_change_nothing(way):
    """`Robot.replace` says so; `x[...] = ` is counted, and refused."""
    robot, q = two(), torch.ones(2, dtype=F64)
    before = torchdq.inverse_dynamics(robot, q)
    (robot.mass.data if way == "data" else robot.mass.numpy())[:] = 5.0
    assert robot.mass._version == 0 and torch.equal(torchdq.inverse_dynamics(robot, q), before)
    robot.mass[:] = 5.0
    with refused(ArgumentError):
        torchdq.inverse_dynamics(robot, q)
