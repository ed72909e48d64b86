"""Mistakes that a newcomer makes, each met once: the message says what was expected, what was found and what to do."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import torchdq
from torchdq import ArgumentError, DescriptionError, Robot, TorchdqError, UnknownNameError, convert, dq
from torchdq.effects.actuator import Actuator
from torchdq.effects.body import BodyEffect
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.effects.model import ModelEffect
from torchdq.envs import ArmEnv, ArmVectorEnv, Scene, TorchTask, effects
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

F64 = torch.float64
ARM = torchdq.robots.load("two_link")
ROW = torch.zeros(2, dtype=F64)


def refused(call, error, *parts):
    """The call raises an error of the package, and its message has every part, in this order."""
    with pytest.raises(error) as raised:
        call()
    assert isinstance(raised.value, TorchdqError)
    message = str(raised.value)
    assert re.search(".*".join(map(re.escape, parts)), message, re.DOTALL), message


# --- names -----------------------------------------------------------------------------------------------------------

NAMES = [
    ("dqrnea", "did you mean DQRNEA?"),
    ("MassMatrix", "did you mean mass_matrix?"),
    ("read", "its name here is learning.read_log"),
    ("crba", "its name here is mass_matrix"),
    ("qwzx", "help(torchdq) lists what there is"),
]


@pytest.mark.parametrize(("name", "hint"), NAMES)
def test_a_misspelt_attribute_has_a_hint(name, hint):
    with pytest.raises(AttributeError) as raised:
        getattr(torchdq, name)
    assert str(raised.value).startswith(f"module 'torchdq' has no attribute {name!r}; {hint}")
    assert not hasattr(torchdq, name) and getattr(torchdq, name, 3) == 3


def test_private_attributes_that_are_absent_cost_no_search():
    with pytest.raises(AttributeError, match=r"has no attribute '_absent'$"):
        torchdq._absent  # noqa: B018


def test_python_adds_no_second_hint():
    code = "import torchdq; torchdq.DQRNAE"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stderr
    assert found.count("DQRNEA") == 1


def test_names_are_near_whatever_their_case_and_far_names_are_not():
    known = ["base", "panda_link6", "panda_link7", "tip"]
    assert nearest("PANDA_LINK7", known) == ["panda_link7"]
    assert nearest("Panda-Link7", known)[0] == "panda_link7"
    assert nearest("hand", known) == []  # the two share no more than letters
    refused(lambda: torchdq.jacobian(ARM, ROW, "hand"), UnknownNameError, "'hand'; known: base, link1, link2, tip")


# --- what is compiled ------------------------------------------------------------------------------------------------

COMPILED = [
    (lambda: (controllers.PD(kp=9.0, kd=1.0),), "found a PD; pass what its program(robot) returns"),
    (lambda: (Scene(ARM),), "found a Scene; pass what its program() returns"),
    (lambda: (torchdq.DQRNEA(ARM),), "found a DQRNEA; pass what its program() returns"),
    (lambda: (torchdq.compile(ARM, "mass_matrix"),), "found 'mass_matrix_two_link', which is compiled already"),
    (lambda: (Robot,), "found Robot; it is a class"),
    (lambda: (ARM,), "function must be the name of one, found ''; known: inverse_dynamics"),
    (lambda: (ARM, ["mass_matrix"]), "function must be the name of one, found ['mass_matrix']"),
    (lambda: (ARM, "floating.mass_matrix"), "'two_link' has a fixed base: use torchdq.mass_matrix, or load it with"),
]


@pytest.mark.parametrize(("arguments", "message"), COMPILED, ids=[message for _, message in COMPILED])
def test_what_cannot_be_compiled_says_what_can(arguments, message):
    refused(lambda: torchdq.compile(*arguments()), ArgumentError, message)


def test_what_the_messages_about_programs_advise_works():
    for program in (controllers.PD(kp=9.0, kd=1.0).program(ARM), Scene(ARM).program(), torchdq.DQRNEA(ARM).program()):
        assert torchdq.compile(program).count().multiplications > 0


# --- poses -----------------------------------------------------------------------------------------------------------

ORIGIN, ONE = torch.zeros(3), torch.tensor([1.0, 0, 0, 0])
IN_LAST_ROW = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]])
POSES = [
    (lambda: dq.from_pose(torch.zeros(4), ORIGIN), "rotation must hold unit quaternions, found [0.0", "zero is no"),
    (lambda: dq.from_pose(2 * ONE, ORIGIN), "rotation must hold unit quaternions, found [2.0", "dq.normalize"),
    (lambda: dq.from_pose(torch.stack([ONE, ONE / 2]), ORIGIN), "found [0.5, 0.0, 0.0, 0.0]"),
    (lambda: dq.from_pose(2 * ONE, torch.zeros(4)), "position must end with an axis of 3"),
    (lambda: convert.from_mujoco(np.zeros(3), np.zeros(4)), "rotation must hold unit quaternions"),
    (lambda: convert.from_scipy("x"), "transform must be a RigidTransform of scipy, found str"),
    (lambda: convert.from_pinocchio(np.eye(4)), "placement must be an SE3 of Pinocchio, found ndarray"),
    (lambda: dq.from_matrix(IN_LAST_ROW), "matrix must end with the row 0, 0, 0, 1, found [1.0, 2.0, 3.0", "transpose"),
    (lambda: dq.from_matrix(torch.zeros(4, 4)), "matrix must end with the row 0, 0, 0, 1"),
    (lambda: dq.from_rotation_matrix(torch.zeros(3, 3)), "matrix must be a rotation, with rows of length 1"),
    (lambda: dq.from_rotation_matrix(1.01 * torch.eye(3)), "matrix must be a rotation, with rows of length 1"),
    (lambda: dq.from_rotation_matrix(torch.diag(torch.tensor([1.0, 1, -1]))), "with the determinant 1, not -1"),
    (lambda: dq.sclerp(torch.zeros(8), torch.zeros(8), "half"), "t must be a finite number, found 'half'"),
    (lambda: dq.stack((1.0, 2.0)), "components must hold one tensor at least"),
    (lambda: dq.stack(()), "components must hold one tensor at least"),
]


@pytest.mark.parametrize(("call", "parts"), [(call, parts) for call, *parts in POSES], ids=[p[1] for p in POSES])
def test_what_is_no_pose_is_refused(call, parts):
    refused(call, ArgumentError, *parts)


@pytest.mark.parametrize("dtype", [torch.float32, F64, torch.bfloat16], ids=str)
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


# --- scenes ----------------------------------------------------------------------------------------------------------

SCENES = [
    (lambda: Scene("panda"), "robot must be a torchdq.Robot, found str; load it with Robot.from_urdf"),
    (lambda: Scene(ARM, "Viscous"), "effects must be a sequence of effects, found 'Viscous'; write effects=("),
    (lambda: Scene(ARM, effects.Viscous(0.1)), "write effects=(Viscous(...),), with a comma"),
    (lambda: Scene(ARM, (controllers.PD(9.0, 1.0),)), "found PD(", "; give it by controller="),
    (lambda: Scene(ARM, controller="PD"), "controller must be an object of torchdq.scene.controllers, found 'PD'"),
    (lambda: Scene(ARM, controller=controllers.PD), "found PD; it is a class, call it"),
    (lambda: Scene(ARM, integrator="rk4"), "found 'rk4', such as RungeKutta4()"),
    (lambda: setattr(Scene(ARM), "dt", 0.1), "a Scene does not change; use scene.replace(dt=...)"),
    (lambda: controllers.PD(9.0, 1.0).program("panda"), "robot must be a torchdq.Robot, found str"),
    (lambda: torchdq.recommend_settings("panda"), "what must be", "found str; load a robot with Robot.from_urdf"),
    (lambda: torchdq.computed_torque(ARM, *5 * [ROW], [9.0, 9.0], 1.0), "kp must be", "list; use torch.as_tensor"),
]


@pytest.mark.parametrize(("call", "parts"), [(call, parts) for call, *parts in SCENES], ids=[p[-1] for p in SCENES])
def test_what_a_scene_cannot_take_says_what_it_takes(call, parts):
    refused(call, TorchdqError, *parts)


# --- learning --------------------------------------------------------------------------------------------------------

TIME = 0.01 * np.arange(400)
Q = np.stack([np.sin(3 * TIME), np.cos(2 * TIME)], 1)
LOG = {"time": TIME, "q": Q, "qd": Q, "tau": Q}
SAMPLES = Samples(*4 * [torch.tensor(Q)])
LEARNING = [
    (lambda: read_log(LOG | {"q": Q[:-1]}), LogError, "it has 400 rows and q has 399"),
    (lambda: read_log(LOG | {"tau": Q[:-1]}), LogError, "'tau'", "it has 399 rows and q has 400"),
    (lambda: read_log(LOG | {"q": Q.T, "qd": Q.T, "tau": Q.T}), LogError, "the 400 rows in the second: transpose"),
    (lambda: read_log({name: x if x.ndim == 1 else x[:, 0] for name, x in LOG.items()}), LogError, "as q[:, None]"),
    (lambda: read_log(LOG | {"q": [["a", "b"]] * 400}), LogError, "'q'", "convert it by .astype(float)"),
    (
        lambda: train_test_split(read_log(LOG), 0.5),
        ArgumentError,
        "motions must be Motion objects, found Log; smooth(log)",
    ),
    (lambda: identify("panda", SAMPLES.q), ArgumentError, "robot must be a torchdq.Robot, found str"),
    (lambda: excitation_trajectory("panda", 5.0), ArgumentError, "robot must be a torchdq.Robot, found str"),
    (
        lambda: fit(ARM, SAMPLES, steps=1),
        ArgumentError,
        "model must be a torch module",
        "InverseDynamics(robot, learn=",
    ),
    (
        lambda: fit_rollout(ARM, Recording(TIME, Q, {}), "mass"),
        ArgumentError,
        "scene must be a torchdq.envs.Scene, found Robot; torchdq.envs.Scene(robot, effects) makes one",
    ),
]


@pytest.mark.parametrize(
    ("call", "error", "parts"), [(c, e, p) for c, e, *p in LEARNING], ids=[x[-1] for x in LEARNING]
)
def test_what_cannot_be_learned_from_says_what_can(call, error, parts):
    refused(call, error, *parts)


# --- effects of one's own --------------------------------------------------------------------------------------------


def own(base, method, result, **more):
    """Scene with an effect whose method returns a result."""
    members = {method: lambda self, *given: result(*given), **more}
    return Scene(ARM, (dataclasses.dataclass(frozen=True)(type("Own", (base,), members))(),))


def joints(result):
    return lambda: own(JointEffect, "impedances", lambda q, qd, inputs: result(q, inputs))


def links(result):
    return lambda: own(BodyEffect, "wrenches", lambda bodies, inputs: result)


def motors(result, **more):
    return lambda: own(Actuator, "driven", lambda u, qd, memory, dt: result(u), **more)


def model(result):
    return lambda: own(ModelEffect, "changed", lambda robot, overrides: result)


OWN = [
    (joints(lambda q, inputs: [Impedance(damping=-5.0)] * 2), "damping in impedances of Own must not be negative"),
    (joints(lambda q, inputs: [Impedance(0.0, -x, -1.0) for x in q]), "stiffness in impedances of Own must not be neg"),
    (joints(lambda q, inputs: [Impedance(1.0)]), "one Impedance for each of 2 joints, found 1"),
    (joints(lambda q, inputs: None), "one Impedance for each of 2 joints, found NoneType"),
    (joints(lambda q, inputs: list(q)), "one Impedance for each of 2 joints, found list of 2"),
    (joints(lambda q, inputs: [Impedance(0.0, inputs["wind"][0])] * 2), "no input of the scene named 'wind'; known: "),
    (
        lambda: own(JointEffect, "impedances", None, inputs=lambda self, n: {"torque": n}),
        "inputs of Own must not hold 'torque'",
    ),
    (links({1: (1.0,) * 6}), "wrenches of Own must be (force, moment) with three numbers each, found tuple of 6"),
    (links({7: ((1.0,) * 3, None)}), "links from 0, the base, to 2, found 7; bodies.frame(name) has them"),
    (links({"link1": ((1.0,) * 3, None)}), "links from 0, the base, to 2, found 'link1'"),
    (links(None), "wrenches of Own must return a dict of wrenches"),
    (motors(lambda u: (u[:1], ())), "driven of Own must return a row of 2 numbers, found 1"),
    (motors(lambda u: list(u)), "driven of Own must return a row of 2 numbers and its memory, (row, ()) if it has"),
    (motors(lambda u: (u, ()), memory=lambda self, n: n), "driven of Own must return a memory of 2 numbers, found 0"),
    (model({"mass": (1.0,)}), "mass from changed of Own must be a row of 2 numbers, found 1"),
    (model({"masses": (1.0, 1.0)}), "'masses'; did you mean 'mass'"),
    (model({"mass": (-1.0, 1.0)}), "mass from changed of Own must not be negative, found [-1.0, 1.0]"),
]


@pytest.mark.parametrize(("scene", "message"), OWN, ids=[message for _, message in OWN])
def test_an_effect_of_ones_own_is_told_its_fault(scene, message):
    refused(lambda: scene().program(), TorchdqError, message)


def test_a_method_that_is_missing_is_named():
    with pytest.raises(NotImplementedError, match="Own must define the method impedances"):
        Scene(ARM, (type("Own", (JointEffect,), {})(),)).program()


# --- layers, environments, files -------------------------------------------------------------------------------------

CONTROL = torchdq.ComputedTorque(ARM, 9.0, 3.0)
STATE = Scene(ARM).start(ROW)
UNTURNED = torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0])
MORE = [
    (lambda: CONTROL(*5 * [np.zeros(2)]), "q must be a tensor, found ndarray; use torch.as_tensor"),
    (lambda: CONTROL(ROW, *4 * [np.zeros(2)]), "qd must be a tensor, found ndarray; use torch.as_tensor"),
    (lambda: CONTROL.friction_torque([0.0, 0.0]), "qd must be a tensor, found list; use torch.as_tensor"),
    (lambda: Scene(ARM).start(None), "q must be a tensor, found NoneType"),
    (lambda: Scene(ARM).linearize(STATE, np.zeros(2)), "torque must be a tensor, found ndarray"),
    (lambda: Scene(ARM).linearize(STATE, torch.zeros(2, dtype=torch.int64)), "torque must be float32 or float64"),
    (lambda: Scene(ARM, backend="gpu"), "backend must be one of None, 'auto'"),
    (lambda: torchdq.DQRNEA(ARM, learn="damping"), "found 'damping'; 'friction' learns viscous and Coulomb friction"),
    (lambda: torchdq.DQRNEA(ARM, learn="masses"), "found 'masses'; did you mean 'mass'?"),
    (lambda: torchdq.DQRNEA(ARM, learn={"mass": [1.0]}), "it takes names alone", "robot.replace(...)"),
    (lambda: torchdq.DQRNEA(ARM, learn="kp"), "gains are learned by torchdq.ComputedTorque alone"),
    (lambda: ArmEnv(robot=ARM, scale=1.0).reset(options={"qq": 1}), "no option of reset", "'qq'; known: none"),
    (lambda: ArmVectorEnv(2, robot=ARM, scale=np.array([1.0, -2.0])), "scale must be a positive number or 2 of them"),
    (lambda: TorchTask(observation=len), "bounds must be given with an observation", "bounds=[(-10, 10)] * k"),
    (lambda: TorchTask(bounds=[(-1, 1)]), "bounds must be given with an observation, and only then"),
    (lambda: TorchTask(observation=len, bounds=(-1, 1)), "bounds must be pairs (lower, upper), one for each", "-1"),
    (
        lambda: TorchTask(observation=len, bounds=3),
        "bounds must be pairs (lower, upper), one for each number of an observation, found 3",
    ),
    (lambda: torchdq.compile(ARM, "mass_matrix").export(None), "folder must be a path, found NoneType"),
    (lambda: torchdq.compile(ARM, "mass_matrix").export(__file__), "folder must be one that files can be written to"),
    (lambda: convert.configuration_to_mujoco(UNTURNED, np.zeros(2)), "the row of the joints must be a tensor"),
    (
        lambda: convert.configuration_to_mujoco(UNTURNED.expand(2, 8), torch.zeros(3, 2)),
        "the batch axes of the arguments must broadcast, found (2,), (2,), (3,)",
    ),
    (lambda: fit(torch.nn.Linear(2, 2), SAMPLES, steps=1), "model must be called as model(q, qd, qdd), found Linear"),
    (
        lambda: fit(torchdq.ForwardDynamics(ARM, learn="mass"), SAMPLES, steps=1),
        "model must return the torques of motions (q, qd, qdd), found a ForwardDynamics; fit an InverseDynamics",
    ),
]


@pytest.mark.parametrize(("call", "parts"), [(call, parts) for call, *parts in MORE], ids=[p[0] for _, *p in MORE])
def test_what_layers_environments_and_files_cannot_take_says_what_they_take(call, parts):
    refused(call, TorchdqError, *parts)


def test_an_action_with_a_gradient_is_taken_without_it():
    env = ArmEnv(robot=ARM, scale=1.0)
    env.reset(seed=0)
    assert np.isfinite(env.step(torch.zeros(2, requires_grad=True))[1])


# --- files that are no URDF ------------------------------------------------------------------------------------------

FILES = [
    ("<!DOCTYPE html><html><head></head></html>", "found <!DOCTYPE html>; this is a web page"),
    ("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n", "Git LFS; fetch that by `git lfs pull`"),
    ('{"name": "arm"}', "the file is not XML", "this is JSON"),
    ("PXR-USDC\0", "this is USD"),
    ("404: Not Found", "a server's answer that there is no such file"),
    ("solid part\n", "this is a mesh"),
    ("name,mass\n", "found 'name,mass\\n' at its start; it must begin with '<'"),
]


@pytest.mark.parametrize(("text", "parts"), [(text, parts) for text, *parts in FILES], ids=[f[-1] for f in FILES])
def test_a_file_that_is_no_urdf_is_told_apart(text, parts, tmp_path: Path):
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    refused(lambda: Robot.from_urdf(path), DescriptionError, *parts)
