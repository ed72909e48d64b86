"""Mistakes that a newcomer makes, each met once: the message says what was expected, what was found and what to do."""

import dataclasses
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import refused

import torchdq
from torchdq import (
    ArgumentError,
    DescriptionError,
    DtypeError,
    Robot,
    Scene,
    TorchdqError,
    UnknownNameError,
    convert,
    dq,
    effects,
)
from torchdq.effects.actuator import Actuator
from torchdq.effects.body import BodyEffect
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.effects.model import ModelEffect
from torchdq.envs import Actions, RobotEnv, RobotVectorEnv, TorchTask
from torchdq.errors import nearest
from torchdq.learning import (
    LogError,
    Recording,
    Samples,
    excitation_trajectory,
    fit,
    fit_rollout,
    identify,
    read_log,
    train_test_split,
)
from torchdq.scene import controllers

F32, F64 = torch.float32, torch.float64
ARM = torchdq.robots.load("two_link")
ROW = torch.zeros(2, dtype=F64)


def bad(*numbers):
    """Rows of which one or several entries are not finite."""
    x = torch.zeros(3, 7)
    for k, number in enumerate(numbers):
        x[k + 1, 4 - 4 * k] = number
    return x


# --- effects of one's own --------------------------------------------------------------------------------------------


def own(base, method, result, **more):
    """Program of a scene with an effect whose method returns a result."""
    members = {method: lambda self, *given: result(*given), **more}
    return Scene(ARM, (dataclasses.dataclass(frozen=True)(type("Own", (base,), members))(),)).program()


def joints(result, **more):
    return own(JointEffect, "impedances", lambda q, qd, inputs: result(q, inputs), **more)


def links(result):
    return own(BodyEffect, "wrenches", lambda bodies, inputs: result)


def motors(result, **more):
    return own(Actuator, "driven", lambda u, qd, memory, dt: result(u), **more)


def model(result):
    return own(ModelEffect, "changed", lambda robot, overrides: result)


# --- calls -----------------------------------------------------------------------------------------------------------

ORIGIN, ONE, TURN = torch.zeros(3), torch.tensor([1.0, 0, 0, 0]), torch.eye(3)
IN_LAST_ROW = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]])
UNTURNED = torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0])
CONTROL, STATE = torchdq.ComputedTorque(ARM, 9.0, 3.0), Scene(ARM).start(ROW)
TIME = 0.01 * np.arange(400)
Q = np.stack([np.sin(3 * TIME), np.cos(2 * TIME)], 1)
LOG = {"time": TIME, "q": Q, "qd": Q, "tau": Q}
SAMPLES = Samples(*4 * [torch.tensor(Q)])


MISUSE = {
    # what is compiled
    "compile a controller": lambda: torchdq.compile(controllers.PD(kp=9.0, kd=1.0)),
    "compile a scene": lambda: torchdq.compile(Scene(ARM)),
    "compile a layer": lambda: torchdq.compile(torchdq.DQRNEA(ARM)),
    "compile twice": lambda: torchdq.compile(torchdq.compile(ARM, "mass_matrix")),
    "compile a class": lambda: torchdq.compile(Robot),
    "compile no function": lambda: torchdq.compile(ARM),
    "compile a class of laws": lambda: torchdq.compile(ARM, controllers.PD),
    "compile a layer for a robot": lambda: torchdq.compile(ARM, CONTROL),
    "compile a list": lambda: torchdq.compile(ARM, ["mass_matrix"]),
    "compile for a floating base": lambda: torchdq.compile(ARM, "floating.mass_matrix"),
    "export nowhere": lambda: torchdq.compile(ARM, "mass_matrix").export(None),
    "export into a file": lambda: torchdq.compile(ARM, "mass_matrix").export(__file__),
    # poses
    "pose by a tensor": lambda: dq.Pose(UNTURNED) @ UNTURNED,
    "rotation of zeros": lambda: dq.from_pose(torch.zeros(4), ORIGIN),
    "rotation of two": lambda: dq.from_pose(2 * ONE, ORIGIN),
    "one rotation of two": lambda: dq.from_pose(torch.stack([ONE, ONE / 2]), ORIGIN),
    "position of four": lambda: dq.from_pose(2 * ONE, torch.zeros(4)),
    "rotation of mujoco": lambda: convert.from_mujoco(np.zeros(3), np.zeros(4)),
    "text for scipy": lambda: convert.from_scipy("x"),
    "matrix for pinocchio": lambda: convert.from_pinocchio(np.eye(4)),
    "array for mujoco": lambda: convert.configuration_to_mujoco(UNTURNED, np.zeros(2)),
    "batches for mujoco": lambda: convert.configuration_to_mujoco(UNTURNED.expand(2, 8), torch.zeros(3, 2)),
    "transposed matrix": lambda: dq.from_matrix(IN_LAST_ROW),
    "matrix of zeros": lambda: dq.from_matrix(torch.zeros(4, 4)),
    "rotation matrix of zeros": lambda: dq.from_rotation_matrix(0 * TURN),
    "rotation matrix too long": lambda: dq.from_rotation_matrix(1.01 * TURN),
    "mirror": lambda: dq.from_rotation_matrix(torch.diag(torch.tensor([1.0, 1, -1]))),
    "no frame": lambda: torchdq.jacobian(ARM, ROW, None),
    "interpolation by name": lambda: dq.sclerp(torch.zeros(8), torch.zeros(8), "half"),
    # functions
    "infinite": lambda: torchdq.require_finite(q=ROW, qd=bad(torch.inf)),
    "negative infinite": lambda: torchdq.require_finite(q=ROW, qd=bad(-torch.inf, torch.nan)),
    "not a number": lambda: torchdq.require_finite(qd=bad(torch.nan, torch.nan)),
    "finite list": lambda: torchdq.require_finite(q=[0.0]),
    # scenes
    "effects of text": lambda: Scene(ARM, "Viscous"),
    "one effect": lambda: Scene(ARM, effects.Viscous(0.1)),
    "controller as an effect": lambda: Scene(ARM, (controllers.PD(9.0, 1.0),)),
    "controller of text": lambda: Scene(ARM, controller="PD"),
    "class of a controller": lambda: Scene(ARM, controller=controllers.PD),
    "integrator of text": lambda: Scene(ARM, integrator="rk4"),
    "backend of a scene": lambda: Scene(ARM, backend="gpu"),
    "start of nothing": lambda: Scene(ARM).start(None),
    "linearize by an array": lambda: Scene(ARM).linearize(STATE, np.zeros(2)),
    # layers
    "layer of a layer": lambda: torchdq.ForwardDynamics(torchdq.DQRNEA(ARM)),
    "control by arrays": lambda: CONTROL(*5 * [np.zeros(2)]),
    "control by an array": lambda: CONTROL(ROW, *4 * [np.zeros(2)]),
    "friction of a list": lambda: CONTROL.friction_torque([0.0, 0.0]),
    "learn damping": lambda: torchdq.DQRNEA(ARM, learn="damping"),
    "learn masses": lambda: torchdq.DQRNEA(ARM, learn="masses"),
    "learn limits": lambda: torchdq.ForwardDynamics(ARM, learn=("mass", "limits")),
    "learn home": lambda: torchdq.ComputedTorque(ARM, 9.0, 6.0, learn=("mass", "home")),
    "learn values": lambda: torchdq.DQRNEA(ARM, learn={"mass": [1.0]}),
    "learn gains": lambda: torchdq.DQRNEA(ARM, learn="kp"),
    # learning
    "split a log": lambda: train_test_split(read_log(LOG), 0.5),
    "fit a robot": lambda: fit(ARM, SAMPLES, steps=1),
    "fit forward dynamics": lambda: fit(torchdq.ForwardDynamics(ARM, learn="mass"), SAMPLES, steps=1),
    "fit the rollout of a robot": lambda: fit_rollout(ARM, Recording(TIME, Q, {}), "mass"),
    # environments
    "observation without bounds": lambda: TorchTask(observation=len),
    "bounds without observation": lambda: TorchTask(bounds=[(-1, 1)]),
    "one pair of bounds": lambda: TorchTask(observation=len, bounds=(-1, 1)),
    "autoreset mode": lambda: RobotVectorEnv(robot=ARM, autoreset_mode="same"),
    "bounds of a number": lambda: TorchTask(observation=len, bounds=3),
    # effects of one's own
    "negative damping": lambda: joints(lambda q, inputs: [Impedance(damping=-5.0)] * 2),
    "negative stiffness": lambda: joints(lambda q, inputs: [Impedance(0.0, -x, -1.0) for x in q]),
    "one impedance": lambda: joints(lambda q, inputs: [Impedance(1.0)]),
    "no impedance": lambda: joints(lambda q, inputs: None),
    "numbers as impedances": lambda: joints(lambda q, inputs: list(q)),
    "input named torque": lambda: joints(None, inputs=lambda self, n: {"torque": n}),
    "wrench of six": lambda: links({1: (1.0,) * 6}),
    "wrench on link 7": lambda: links({7: ((1.0,) * 3, None)}),
    "wrench on a name": lambda: links({"link1": ((1.0,) * 3, None)}),
    "no wrenches": lambda: links(None),
    "short row of a motor": lambda: motors(lambda u: (u[:1], ())),
    "motor without memory": lambda: motors(lambda u: list(u)),
    "memory forgotten": lambda: motors(lambda u: (u, ()), memory=lambda self, n: n),
    "short row of masses": lambda: model({"mass": (1.0,)}),
    "negative mass": lambda: model({"mass": (-1.0, 1.0)}),
}
NO_ROBOT = {
    "Scene": Scene,
    "PD": controllers.PD(9.0, 1.0).program,
    "recommend_settings": torchdq.recommend_settings,
    "identify": lambda robot: identify(robot, SAMPLES),
    "excitation_trajectory": lambda robot: excitation_trajectory(robot, 5.0),
    "DQRNEA": torchdq.DQRNEA,
    "InverseDynamics": lambda robot: torchdq.InverseDynamics(robot, learn="mass"),
    "ForwardDynamics": torchdq.ForwardDynamics,
    "ComputedTorque": lambda robot: torchdq.ComputedTorque(robot, 1.0, 1.0),
    "compile": lambda robot: torchdq.compile(robot, "inverse_dynamics"),
    "inverse_dynamics": lambda robot: torchdq.inverse_dynamics(robot, ROW),
}
MISUSE |= {
    f"{name} of {of}": lambda make=make, of=of: make(of) for name, make in NO_ROBOT.items() for of in ("arm.urdf", None)
}
MISUSE["Scene of a path"] = lambda: Scene(Path("arm.urdf"))
UNKNOWN_NAMES = {
    "frame": lambda: torchdq.forward_kinematics(ARM, ROW, "link77"),
    "frame of a jacobian": lambda: torchdq.jacobian(ARM, ROW, "link77"),
    "frame like no other": lambda: torchdq.jacobian(ARM, ROW, "hand"),
    "number of a frame": lambda: torchdq.jacobian(ARM, ROW, 3),
    "tip": lambda: ARM.with_tip("link77"),
    "frame of a robot": lambda: ARM.frame("link77"),
    "joint": lambda: ARM.joint_index("joint77"),
    "robot": lambda: torchdq.robots.load("pandas"),
    "option of reset": lambda: RobotEnv(robot=ARM, action=Actions(scale=1.0)).reset(options={"qq": 1}),
    "input of no name": lambda: joints(lambda q, inputs: [Impedance(0.0, inputs["wind"][0])] * 2),
    "field of no name": lambda: model({"masses": (1.0, 1.0)}),
    "robot like no other": lambda: torchdq.robots.load("xyzzy"),
}
DTYPES = {
    "linearize by integers": lambda: Scene(ARM).linearize(STATE, torch.zeros(2, dtype=torch.int64)),
    **{
        f"{layer.__name__} in half precision": lambda layer=layer: layer(ARM, learn="mass").half()(*3 * [ROW.float()])
        for layer in (torchdq.DQRNEA, torchdq.ForwardDynamics)
    },
    **{
        f"dtype {dtype}": lambda dtype=dtype: torchdq.compile(ARM, "mass_matrix", dtype=dtype)
        for dtype in ("float16", "single precision", torch.int64, np.float16, 32, None)
    },
}
LOGS = {
    "short q": lambda: read_log(LOG | {"q": Q[:-1]}),
    "short tau": lambda: read_log(LOG | {"tau": Q[:-1]}),
    "text": lambda: read_log(LOG | {"q": [["a", "b"]] * 400}),
}
# a file that is no URDF
FILES = {
    "a web page": "<!DOCTYPE html><html><head></head></html>",
    "Git LFS": "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n",
    "JSON": '{"name": "arm"}',
    "USD": "PXR-USDC\0",
    "an answer of a server": "404: Not Found",
    "a mesh": "solid part\n",
    "a table": "name,mass\n",
}
TABLES = {ArgumentError: MISUSE, UnknownNameError: UNKNOWN_NAMES, DtypeError: DTYPES, LogError: LOGS}


@pytest.mark.case("P5")
@pytest.mark.parametrize(
    ("error", "call"),
    [pytest.param(error, call, id=name) for error, table in TABLES.items() for name, call in table.items()],
)
def test_misuse_is_refused_with_what_to_do(error, call):
    with refused(error) as raised:
        call()
    assert isinstance(raised.value, TorchdqError)


@pytest.mark.parametrize("kind", FILES)
def test_a_file_that_is_no_urdf_is_told_apart(kind, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(FILES[kind])
    with refused(DescriptionError):
        Robot.from_urdf(path)


@pytest.mark.parametrize("name", ["dqrnea", "MassMatrix", "Robots", "read", "crba", "rnea", "fk", "qwzx"])
def test_a_misspelt_attribute_has_a_hint(name):
    with refused(AttributeError):
        getattr(torchdq, name)
    assert not hasattr(torchdq, name) and getattr(torchdq, name, 3) == 3


def test_private_attributes_that_are_absent_cost_no_search():
    with pytest.raises(AttributeError, match=r"has no attribute '_absent'$"):
        attrgetter("_absent")(torchdq)


def test_a_scene_does_not_change():
    with refused(dataclasses.FrozenInstanceError):
        Scene(ARM).dt = 0.1


def test_a_method_that_is_missing_is_named():
    with refused(NotImplementedError):
        Scene(ARM, (type("Own", (JointEffect,), {})(),)).program()


# --- what is right ---------------------------------------------------------------------------------------------------


def test_names_are_near_whatever_their_case_and_far_names_are_not():
    known = ["base", "panda_link6", "panda_link7", "tip"]
    assert nearest("PANDA_LINK7", known) == ["panda_link7"]
    assert nearest("Panda-Link7", known)[0] == "panda_link7"
    assert nearest("hand", known) == []  # the two share no more than letters


def test_what_the_messages_about_programs_advise_works():
    for program in (controllers.PD(kp=9.0, kd=1.0).program(ARM), Scene(ARM).program(), torchdq.DQRNEA(ARM).program()):
        assert torchdq.compile(program).count().multiplications > 0


@pytest.mark.parametrize("dtype", [F32, F64, torch.bfloat16], ids=str)
def test_rotations_with_rounding_errors_pass(dtype):
    g = torch.Generator().manual_seed(0)
    r = torch.nn.functional.normalize(torch.randn(200, 4, dtype=F64, generator=g), dim=-1).to(dtype)
    assert dq.from_pose(r, torch.zeros(3, dtype=dtype)).shape == (200, 8)
    if dtype != torch.bfloat16:
        matrix = dq.to_rotation_matrix((1 + 5e-5) * r)
        assert torch.equal(dq.from_rotation_matrix(matrix).isfinite(), torch.ones(200, 4, dtype=torch.bool))


def test_rows_that_are_not_a_number_stay_so_and_transforms_read_no_values():
    rows = torch.stack([ONE, torch.full((4,), torch.nan)])
    assert dq.from_pose(rows, ORIGIN)[:, :4].isfinite().all(-1).tolist() == [True, False]
    matrices = torch.stack([torch.eye(4), torch.full((4, 4), torch.nan)])
    assert dq.from_matrix(matrices).isfinite().all(-1).tolist() == [True, False]
    assert torch.equal(torch.func.vmap(dq.from_pose)(torch.zeros(2, 4), torch.zeros(2, 3)), torch.zeros(2, 8))
    assert torch.func.vmap(dq.from_matrix)(torch.zeros(2, 4, 4)).shape == (2, 8)


def test_an_action_with_a_gradient_is_taken_without_it():
    env = RobotEnv(robot=ARM, action=Actions(scale=1.0))
    env.reset(seed=0)
    assert np.isfinite(env.step(torch.zeros(2, requires_grad=True))[1])
