"""Walking: starts, what is observed and rewarded, ends, other robots, and a policy that walks in MuJoCo.

The observation that the policy gets in MuJoCo is built by the example from MuJoCo's state alone.
"""

import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from importlib import import_module

import mujoco
import numpy as np
import pytest
import torch
from helpers import exhaustive, thinned
from messages import refused
from oracles import urdf_paths
from places import EXAMPLES
from small_envs import ON_FOUR, grouped, stool

import torchdq
from torchdq import Robot, dq, effects
from torchdq.envs import Pushes, RobotVectorEnv, Simulation
from torchdq.envs.walk import WEIGHTS, Walk
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot.shipped import go2

BACKEND = "auto"
NOMINAL = {"Contact.friction": (1.0, 1.0), "Contact.stiffness": (1.0, 1.0)}
STILL = {"push": Pushes((0.0,) * 6)}
POLICY = EXAMPLES / "go2_walk.pt"
ANYMAL = ("*_HAA=0", "?F_HFE=0.4", "?H_HFE=-0.4", "?F_KFE=-0.8", "?H_KFE=0.8")
BENT = ("*_pitch=-0.3", "*_knee=0.6", "*_tilt=-0.3")
LEG = """<body name="{0}_thigh" pos="0 {1} 0"><joint name="{0}_pitch"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.04" mass="3"/><body name="{0}_shank" pos="0 0 -0.3">
<joint name="{0}_knee"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="1"/>
<body name="{0}_foot" pos="0 0 -0.3"><joint name="{0}_tilt"/>
<geom type="box" pos="0 0 -0.04" size="0.1 0.05 0.01" mass="0.5"/></body></body></body>"""
BIPED = f"""<mujoco model="biped"><compiler angle="radian"/><default><joint axis="0 1 0" armature="0.01"/></default>
<worldbody><body name="pelvis" pos="0 0 1"><freejoint/><geom type="box" pos="0 0 0.15" size="0.08 0.12 0.15" mass="10"/>
{LEG.format("left", 0.1)}{LEG.format("right", -0.1)}</body></worldbody>
<actuator><position joint="left_knee" kp="1000"/></actuator></mujoco>"""


def walkers(num_envs, task=None, robot="go2", **arguments):
    """Robots on the nominal ground, without pushes, reset; all share a program."""
    arguments = {"randomise": NOMINAL, "pushes": STILL, "max_episode_steps": None, **arguments}
    envs = RobotVectorEnv(num_envs, task or Walk(), robot, **grouped(**arguments))
    envs.reset(seed=0)
    return envs


@cache
def player(friction=0.8, elliptic=False):
    module = import_module("23_policy_in_mujoco")
    return module.Player(module.ppo.Walker(), friction, elliptic)


@cache
def policy():
    return import_module("23_policy_in_mujoco").policy_of(POLICY)


def in_mujoco(state, k):
    """MuJoCo's data at the state of a robot."""
    made = player()
    data = mujoco.MjData(made.model)
    R = dq.to_matrix(state["X_WB"][k].double())[:3, :3].numpy()
    data.qpos[:3] = dq.translation(state["X_WB"][k].double()).numpy()
    mujoco.mju_mat2Quat(data.qpos[3:7], R.reshape(-1).copy())
    data.qpos[made.at], data.qvel[made.moving] = state["q"][k], state["qd"][k]
    data.qvel[:6] = [*(R @ state["V_WB_B"][k, 3:].numpy()), *state["V_WB_B"][k, :3]]
    mujoco.mj_forward(made.model, data)
    return data


def test_an_episode_starts_with_the_lowest_foot_on_the_ground():
    state = walkers(8).get_state()
    for k in range(8):
        data, model = in_mujoco(state, k), player().model
        feet = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
        assert abs(min(data.geom_xpos[g, 2] - model.geom_size[g, 0] for g in feet)) < 1e-6
    goal = RobotVectorEnv(500, Walk((0.2, 0.6), (-0.3, 0.1), (-2.0, 1.0)), "go2", randomise=NOMINAL, pushes=STILL)
    goal.reset(seed=0)
    low, high = goal.get_state()["goal"].aminmax(dim=0)
    assert torch.allclose(low, torch.tensor([0.2, -0.3, -2.0]), atol=0.05)
    assert torch.allclose(high, torch.tensor([0.6, 0.1, 1.0]), atol=0.05)


def test_what_is_seen_and_rewarded_is_that_of_its_formulas():
    envs, task, robot = walkers(16), Walk(), torchdq.robots.load("go2")
    generator = torch.Generator().manual_seed(0)
    air, on = torch.zeros(16, 4), torch.ones(16, 4)
    last, stepped = torch.zeros(16, 12), 0
    for _ in range(40):
        before = envs.get_state()
        action = 0.3 * torch.randn(16, 12, generator=generator).clamp(-3, 3)
        seen, reward, _, _, info = envs.step(action)
        now = envs.get_state()
        v, w, R = now["V_WB_B"][:, 3:], now["V_WB_B"][:, :3], dq.to_matrix(now["X_WB"])[:, :3, :3]
        stand = torch.tensor(task.joints(robot))
        rows = {"velocity": [v, now["goal"][:, :2]], "rate": [w, now["goal"][:, 2:]], "down": [-R[:, 2]]}
        rows |= {"offset": [now["q"] - stand], "speed": [now["qd"]], "action": [action]}
        expected = torch.cat([Walk.SEEN[name] * x for name, row in rows.items() for x in row], 1)
        going = ~(info["_final_obs"] if "_final_obs" in info else torch.zeros(16, dtype=torch.bool))
        assert torch.allclose(seen[going], expected[going], atol=1e-4)
        on = info["touching"]
        landed = (air > 0) * on
        servo = next(x for x in envs.scene.effects if isinstance(x, effects.Servo))
        kp, kd = torch.tensor(servo.kp), torch.tensor(servo.kd)
        torque = kp * (stand + 1.5 * action - now["q"]) - kd * now["qd"]
        z = dq.translation(now["X_WB"])[:, 2]
        height = float(task.height(robot, task.joints(robot)))
        terms = {
            "velocity": torch.exp(-(v[:, :2] - now["goal"][:, :2]).square().sum(1) / 0.25),
            "turning": torch.exp(-(w[:, 2] - now["goal"][:, 2]).square() / 0.25),
            "air_time": ((air + 0.02 - 0.3) * landed).sum(1),
            "vertical": v[:, 2].square(),
            "rocking": w[:, :2].square().sum(1),
            "tilt": R[:, 2, :2].square().sum(1),
            "height": (z - 0.88 * height).square(),
            "hips": (now["q"] - stand)[:, ::3].square().sum(1),
            "acceleration": ((now["qd"] - before["qd"]) / 0.02).square().sum(1),
            "action_rate": (action - last).square().sum(1),
        }
        held = (torque.abs() < torch.tensor(servo.limit)).all(1)
        size = 9.81 * float(robot.mass.sum() + robot.base_mass) * height
        terms["torque"] = torch.where(held, (torque / size).square().sum(1), info["torque"] / WEIGHTS["torque"])
        assert terms.keys() == WEIGHTS.keys()
        for name, x in terms.items():
            assert torch.allclose(info[name][going], WEIGHTS[name] * x[going], rtol=2e-3, atol=2e-4), name
        total = sum(info[name] for name in terms).clamp(min=0)
        assert torch.allclose(reward[going], 0.02 * total[going], atol=1e-6)
        air, last, stepped = (air + 0.02) * (1 - on), action, stepped + int(going.sum())
        air[~going], last[~going] = 0.0, 0.0
    assert stepped > 300


def test_an_episode_ends_when_the_base_tilts_or_sinks():
    envs = walkers(4, autoreset_mode="Disabled")
    state = envs.get_state()
    angles = torch.tensor([0.85, 1.0, 0.0, 0.0])  # 49 and 57 degrees
    half, z = 0.5 * angles, torch.tensor([1.0, 1.0, 0.1, 1.0])
    r = torch.stack([half.cos(), half.sin(), 0 * half, 0 * half], 1)
    X = dq.from_pose(r, torch.stack([0 * z, 0 * z, z], 1))
    envs.set_state({**state, "X_WB": X, "V_WB_B": torch.zeros(4, 6)})
    terminated = envs.step(torch.zeros(4, 12))[2]
    assert terminated.tolist() == [False, True, True, False]


def test_an_episode_ends_when_another_point_touches():
    task = replace(ON_FOUR, fatal=("feeler",))
    envs = walkers(3, task, stool(), substeps=1, autoreset_mode="Disabled")
    state = envs.get_state()
    state["q"][1] = 1.5  # its legs lie on the ground
    state["X_WB"][1, 7] -= 0.5 * 0.02  # half of the height
    envs.set_state(state)
    ended = torch.zeros(3, dtype=torch.bool)
    while envs.get_state()["steps"][0] < 20 and not ended.any():
        ended = envs.step(torch.zeros(3, 4))[2]
    assert ended.tolist() == [False, True, False]


@exhaustive
@pytest.mark.parametrize("name", ["a1", "anymal_c_simple-anymal"])
def test_the_quadruped_of_another_file_stands(name):
    robot = Robot.from_urdf(urdf_paths()[name], base="floating", on_unphysical="ignore")
    task = Walk() if name == "a1" else examples_walker("", ANYMAL, "*_FOOT")[1].task()
    envs = walkers(8, task, robot, randomise={}, substeps=1, dt=0.005)
    start = envs.get_state()
    for _ in range(300):
        terminated, info = envs.step(torch.zeros(8, 12))[2::2]
        assert not terminated.any()
    now = envs.get_state()
    z = dq.translation(now["X_WB"])[:, 2] / float(task.height(robot, task.joints(robot)))
    assert bool(((z > 0.75) & (z < 1.02)).all()) and bool(info["touching"].all())
    moved = (dq.translation(now["X_WB"]) - dq.translation(start["X_WB"]))[:, :2].norm(dim=1)
    assert float(moved.max()) < 0.2


def examples_walker(path, stand, feet, **options):
    module = import_module("23_policy_in_mujoco")
    return module, module.ppo.Walker(str(path), stand, (feet,), **options)


@exhaustive
def test_a_biped_with_flat_feet_stands_and_is_pushed_and_does_so_in_mujoco(tmp_path):
    path = tmp_path / "biped.xml"
    path.write_text(BIPED)
    module, walker = examples_walker(path, BENT, "*_foot", stiffness=2.0)
    robot, task = walker.load(), walker.task()
    pushes = {"push": Pushes((25.0, 25.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.5))}
    envs = walkers(16, task, robot, randomise={}, pushes=pushes, substeps=2)
    assert len(envs.task.feet) == 16 and envs.get_state()["carry"].shape == (16, 2 * robot.n + 2)
    q, X = torch.tensor(task.joints(robot)), envs.get_state()["X_WB"]
    X[:, 7] = 0.5 * float(task.height(robot, q.tolist()))
    envs.set_state({**envs.get_state(), "q": q.expand(16, -1), "X_WB": X, "V_WB_B": torch.zeros(16, 6)})
    for _ in range(100):
        terminated, info = envs.step(torch.zeros(16, robot.n))[2::2]
        assert not terminated.any() and info["touching"].shape == (16, 2)
    run = module.Player(walker).run(lambda x: torch.zeros(robot.n), (0.0, 0.0, 0.0), seconds=3.0)
    assert run.up and np.abs(run.velocity).max() < 0.02


def test_mujoco_has_the_bodies_of_a_published_file():
    """Some of its links have no inertia, and others one that no rigid body can have."""
    path = urdf_paths()["anymal_c_simple-anymal"]
    module, walker = examples_walker(path, ANYMAL, "*_FOOT")
    with pytest.warns(UserWarning, match="unphysical"):
        mass = module.Player(walker).model.body_mass.sum()
    assert abs(mass - sum(float(x.get("value")) for x in ET.parse(path).iter("mass"))) < 1e-9
    other = torchdq.robots.load("go2")
    with pytest.raises(ValueError, match="another robot"):
        player().require_the_same(other.replace(com=other.com + 1e-4))


def test_what_walks_has_feet_on_a_floating_base():
    for cause in (
        lambda: RobotVectorEnv(1, "walk", go2.urdf()),
        lambda: Walk().inputs(12),
        lambda: Walk(weights={"speed": 1.0}),
        lambda: Walk(turning=1.0),
        lambda: Walk(stiffness=0.0),
        lambda: RobotVectorEnv(1, "walk", effects=(effects.Servo(40.0, 1.0), effects.Contact("F?_foot"))).reset(),
    ):
        with refused(ArgumentError):
            cause()
    with refused(UnknownNameError):
        RobotVectorEnv(1, Walk(stand={"knee": 1.0}), "go2")


def test_a_policy_walks_at_the_commanded_speeds():
    envs = walkers(12)
    commands = torch.zeros(12, 3)
    commands[:, 0] = torch.tensor([0.5, 0.75, 1.0]).repeat_interleave(4)
    envs.set_state({**envs.get_state(), "goal": commands})
    seen, mean = torch.zeros(12, 48), torch.zeros(12)
    with torch.no_grad():
        for k in range(250):
            seen, _, terminated, _, _ = envs.step(policy()(seen) / 6)
            assert not terminated.any()
            mean += (k >= 100) * seen[:, 0] / Walk.SEEN["velocity"] / 150
    assert float((mean - commands[:, 0]).abs().max()) < 0.1


@pytest.mark.parametrize(("friction", "elliptic"), thinned([(0.8, False), (0.4, True)], [(0.8, False)]))
def test_the_policy_walks_in_mujoco(friction, elliptic):
    for seed, speed in enumerate((0.5, 0.75, 1.0)):
        command = np.array([speed, 0.0, 0.7 * elliptic])
        run = player(friction, elliptic).run(policy(), tuple(command), seed, seconds=5.0)
        assert run.up and np.abs(run.velocity - command)[[0, 2]].max() < 0.1


def test_robots_on_maps_of_their_own_are_reset_one_by_one():
    heights = torch.tensor([0.0, 0.01, 0.02]).reshape(3, 1, 1).expand(3, 2, 2)
    ground = effects.Contact("foot?", surface=effects.HeightMap(heights, 10.0, (-5.0, -5.0)))
    held = (effects.Gravity(), effects.Servo(40.0, 1.0), ground)
    envs = RobotVectorEnv(3, ON_FOUR, stool(), effects=held, simulation=Simulation(0.005, substeps=1))
    envs.reset(seed=0)
    envs.reset(options={"reset_mask": torch.tensor([False, True, False])})
    for _ in range(50):
        envs.step(torch.zeros(3, 4))
    depth = envs.scene.contacts(envs.state).depth
    assert (depth.amax(1) > 0).all() and depth.max() < 0.01  # every robot stands on its own ground
