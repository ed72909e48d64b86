"""The environments: gymnasium's contract, rows that do not know of each other, and what is asked of the robot."""

import copy
import importlib
import itertools
import math
import pickle
import sys
import types
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from helpers import double, thinned
from messages import refused
from small_envs import ALL_DRAWN, FREE, PARTS, PUSHES, ROBOT, actions_of, grouped, make, policy_of, same, started, steps

import torchdq
from torchdq import effects
from torchdq.backends import c_library as build
from torchdq.envs import Absolute, Actions, RobotEnv, RobotVectorEnv, Simulation, TorchTask
from torchdq.envs.row_selection import Host
from torchdq.envs.tasks import Reach
from torchdq.robot import ContactPoint
from torchdq.scene import controllers
from torchdq.scene.defaults import default_effects

BACKEND = "auto"
TASKS = pytest.mark.parametrize("task", ["reach", "track"])
IN_TORCH = TorchTask(
    "reach",
    reward=lambda now: -now.q.square().sum(1),
    observation=lambda now: torch.cat([now.q_measured, now.qd_measured], 1),
    terminated=lambda now: now.q[:, 0] > 1.0,
    start=lambda robot, u: {"q": 2 * u - 1},
    bounds=[(-math.inf, math.inf)] * 4,
    draws=2,
)
FULL = Actions(scale=20.0)
PUSHED = (effects.Gravity(), effects.FirstOrderLag(0.05), effects.Push(), effects.Noise(0.01))
FEET = effects.Contact(tuple(ContactPoint("base", (x, y, -0.2), 0.02) for x in (-1.0, 2.5) for y in (-1.5, 1.5)))


def stand(robot, u):
    """Starts on feet, slightly above the ground, in slow motion."""
    place = torchdq.dq.from_pose(torch.eye(1, 4).to(u), torch.tensor([0.0, 0.0, 0.24]).to(u).expand(len(u), 3))
    return {"q": 0.2 * u[:, :2], "qd": u[:, 2:] - 0.5, "X_WB": place}


def stacked(limits=False):
    """Two robots of different masses, or of different limits."""
    robot = torchdq.robots.load("panda")
    changes = {"limits": robot.limits._replace(upper=0.9 * robot.limits.upper)} if limits else {"mass": 2 * robot.mass}
    return torchdq.Robot.stack([robot, robot.replace(**changes)])


# --- contract --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "action"),
    thinned(
        [*itertools.product(("reach", "track"), ("torque", "residual", "reference"))],
        [("reach", "torque"), ("track", "residual"), ("reach", "reference")],
    ),
)
def test_results_have_their_shapes_and_are_within_their_spaces(task, action):
    envs = make(5, task, action=action, max_episode_steps=15)
    observations, info = envs.reset(seed=0)
    assert info == {} and envs.observation_space.contains(observations.numpy())
    for observations, rewards, terminated, truncated, info in steps(envs, 21):
        assert envs.observation_space.contains(observations.numpy())
        assert rewards.dtype == torch.float32 and bool(rewards.isfinite().all())
        assert terminated.dtype == truncated.dtype == torch.bool
        assert {x.shape for x in (rewards, terminated, truncated, info["clipped"], info["nonfinite"])} == {(5,)}
    assert envs.single_observation_space.is_bounded()
    assert envs.single_action_space == gymnasium.spaces.Box(-1, 1, (2,), np.float32)


@pytest.mark.parametrize("robot", thinned(["panda", "ur10e", "puma560"], ["puma560"]))
def test_shipped_arms_need_no_arguments(robot):
    # the Puma's description has no limits of torque
    envs = started(2, robot=robot, backend="eager", action=None, scale=50.0 if robot == "puma560" else None)
    envs.reset(seed=0)
    assert not any(bool(terminated.any()) for _, _, terminated, _, _ in steps(envs, 10))


def test_numpy_in_and_numpy_out():
    envs, plain = make(output="numpy", max_episode_steps=3), make(max_episode_steps=3)
    assert isinstance(envs.reset(seed=0)[0], np.ndarray)
    plain.reset(seed=0)
    for _ in range(4):
        a, b = envs.step(np.full((5, 2), 0.3)), plain.step(torch.full((5, 2), 0.3))
        assert all(isinstance(x, np.ndarray) for x in a[:4]) and isinstance(a[4]["clipped"], np.ndarray)
        assert same(a, b)


@pytest.mark.parametrize("looks", thinned([True, False], [False]), ids=str)
@pytest.mark.parametrize("mode", AutoresetMode)
def test_what_was_handed_out_does_not_change(mode, looks):
    """Results, state and scene, and what functions of tensors see; that buffers stay where they are is as on a GPU."""
    kept = []

    def keep(*found):
        kept.append((found, copy.deepcopy(found)))

    def reward(now):
        keep(now.q, now.qd, now.goal, now.q_measured, now.time, dict(now.rows), now.robot.mass)
        return now.time

    options = {"randomise": {"mass": 0.2}, "effects": PUSHED, "pushes": PUSHES, "max_episode_steps": 3}
    for task in ("reach", TorchTask("reach", reward=reward)):
        envs = make(task=task, autoreset_mode=mode, **options)
        envs._host = Host(looks)
        keep(envs.reset(seed=0), envs.state.rows(), envs.scene.parameters, envs.get_state())
        for action, _ in zip(actions_of(envs), range(7), strict=False):
            keep(envs.step(action), envs.state.rows(), envs.scene.parameters, envs.get_state())
            envs.reset(options={"reset_mask": envs.get_state()["finished"]})
        if mode == AutoresetMode.SAME_STEP:
            keep(envs.rollout(policy_of(envs), 4), envs.state.rows(), envs.scene.parameters)
        envs.set_state(envs.get_state())
        envs.reset()
    assert len(kept) > 20 and all(same(found, before) for found, before in kept)


@pytest.mark.parametrize("dtype", [torch.float64, "float64", np.float64])
def test_double_precision_throughout(dtype):
    envs = make(2, dtype=dtype)
    observations, _ = envs.reset(seed=0)
    _, rewards, *_ = envs.step(torch.zeros(2, 2))
    assert observations.dtype == rewards.dtype == torch.float64
    assert envs.single_observation_space.dtype == np.float64


@pytest.mark.parametrize(
    ("task", "action"),
    thinned(
        [("reach", "torque"), ("track", "residual"), ("reach", "reference")],
        [("track", "residual")],
    ),
)
def test_robots_of_a_stack_are_each_simulated(task, action):
    """A row moves as its own robot; a controller of the environment knows the mean of all."""
    robot = torchdq.robots.load("panda")
    robots = [robot, robot.replace(mass=1.5 * robot.mass, damping=robot.damping + 2.0)]
    controller = None if action == "torque" else controllers.ComputedTorque(100.0, 20.0, model=robot)
    given = {"task": task, "action": action, "dtype": torch.float64, "controller": controller, "backend": "eager"}
    several = started(2, robot=torchdq.Robot.stack(robots), **given)
    found, *_ = several.step(torch.ones(2, 7))
    for i, one in enumerate(robots):
        alone = make(1, robot=one, **given)
        alone.reset(seed=i)
        expected, *_ = alone.step(torch.ones(1, 7))
        assert torch.allclose(found[i], expected[0], rtol=1e-9, atol=1e-9)
    several = started(2, robot=torchdq.Robot.stack(robots), **(given | {"controller": None}))
    assert bool(several.step(torch.zeros(2, 7))[0].isfinite().all())
    if action != "torque":
        assert torch.allclose(several.scene.controller.model.mass, 1.25 * robot.mass)


def test_gymnasium_makes_them():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs = gymnasium.make_vec("torchdq/Reach-v0", num_envs=7, robot="ur10e", simulation=Simulation(backend="eager"))
        assert isinstance(envs, RobotVectorEnv) and envs.max_episode_steps == 250
        assert envs.output == "numpy" and envs.autoreset_mode == AutoresetMode.NEXT_STEP  # gymnasium's contract
        assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
        envs.reset(seed=0)
        envs.step(torch.zeros(7, 6))
        env = gymnasium.make("torchdq/Track-v0", robot=ROBOT, action=FULL, max_episode_steps=4)
        env.reset(seed=0)
        ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(4)]
        assert ends == [(False, False)] * 3 + [(False, True)]
    asked = {"output": "torch", "autoreset_mode": AutoresetMode.SAME_STEP}
    envs = gymnasium.make_vec("torchdq/Track-v0", num_envs=2, robot=ROBOT, action=FULL, **asked)
    assert (envs.output, envs.autoreset_mode) == (make().output, make().autoreset_mode) == tuple(asked.values())
    assert isinstance(envs.reset(seed=0)[0], torch.Tensor)


@TASKS
def test_gymnasiums_checker_has_nothing_to_say(task):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(RobotEnv(task=task, robot=ROBOT, action=FULL), skip_render_check=True)


def test_gymnasiums_wrappers_accept_them():
    conversion = pytest.importorskip("gymnasium.wrappers.vector.array_conversion")
    pytest.importorskip("array_api_compat")
    envs = conversion.ArrayConversion(make(max_episode_steps=3), env_xp=torch, target_xp=np)
    observations, _ = envs.reset(seed=0)
    for _ in range(4):
        observations, rewards, *_ = envs.step(np.zeros((5, 2), np.float32))
    assert isinstance(observations, np.ndarray) and isinstance(rewards, np.ndarray)


WRAPPERS = gymnasium.wrappers.vector
WRAPPED = {
    "RecordEpisodeStatistics": WRAPPERS.RecordEpisodeStatistics,
    "NormalizeReward": WRAPPERS.NormalizeReward,
    "NormalizeObservation": WRAPPERS.NormalizeObservation,
    "FlattenObservation": WRAPPERS.FlattenObservation,
    "RescaleAction": lambda envs: WRAPPERS.RescaleAction(envs, -2.0, 2.0),
    "ClipReward": lambda envs: WRAPPERS.ClipReward(envs, -1.0, 1.0),
    "DtypeObservation": lambda envs: WRAPPERS.DtypeObservation(envs, np.float64),
    "DictInfoToList": WRAPPERS.DictInfoToList,
}


@pytest.mark.parametrize("wrapper", WRAPPED)
def test_gymnasiums_vector_wrappers_take_its_vector_environments(wrapper):
    made = gymnasium.make_vec("torchdq/Reach-v0", num_envs=5, robot=ROBOT, action=FULL, max_episode_steps=3)
    envs = WRAPPED[wrapper](made)
    envs.reset(seed=0)
    for _ in range(8):
        observations, rewards, terminated, truncated, info = envs.step(np.zeros((5, 2), np.float32))
        assert all(isinstance(x, np.ndarray) for x in (observations, rewards, terminated, truncated))
        if wrapper == "RecordEpisodeStatistics" and truncated.any():
            assert info["episode"]["l"].tolist() == [3] * 5


def test_gymnasium_records_videos_of_all_environments(monkeypatch, tmp_path):
    pytest.importorskip("matplotlib")
    monkeypatch.setitem(sys.modules, "moviepy", types.ModuleType("moviepy"))  # which only writes the file
    given = {"robot": ROBOT, "action": FULL, "render_mode": "rgb_array"}
    envs = gymnasium.make_vec("torchdq/Reach-v0", num_envs=6, **given)
    filmed = WRAPPERS.RecordVideo(envs, str(tmp_path / "films"), episode_trigger=lambda k: k == 0)
    filmed.reset(seed=0)
    filmed.step(np.zeros((6, 2), np.float32))
    height, width, _ = envs.render()[0].shape
    assert [x.shape[0] * x.shape[1] for x in filmed.recorded_frames] == [6 * height * width] * 2
    filmed.recorded_frames.clear()  # so that none is written


def test_frames_are_painted():
    pytest.importorskip("matplotlib")
    for task in ("reach", "track"):
        envs = make(6, task, render_mode="rgb_array")
        with pytest.raises(ResetNeeded):
            envs.render()
        envs.reset(seed=0)
        frames = envs.render()
        assert len(frames) == 6 and frames[0].shape[2] == 3 and frames[0].dtype == np.uint8
        assert not np.array_equal(frames[0], frames[1])
    env = gymnasium.make("torchdq/Reach-v0", robot=ROBOT, action=FULL, render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == frames[0].shape


# --- random numbers --------------------------------------------------------------------------------------------------


@TASKS
def test_the_same_seed_gives_the_same_bits(task):
    envs = make(task=task, max_episode_steps=10)
    first = [envs.reset(seed=3), *steps(envs, 25)]
    again = [envs.reset(seed=3), *steps(envs, 25)]  # not the first reset any more
    other = make(task=task, max_episode_steps=10)
    assert same(first, again) and same(first, [other.reset(seed=3), *steps(other, 25)])
    assert not same(first[0], envs.reset(seed=8)[0])


def test_without_a_seed_episodes_differ():
    envs = make()
    first, second = envs.reset()[0], envs.reset()[0]
    assert not torch.equal(first, second) and not torch.equal(first, make().reset()[0])
    assert len({tuple(row.tolist()) for row in first}) == 5


MEMORY = (effects.Viscous(1.0), effects.FirstOrderLag(0.05), effects.CommandDelay(2), effects.MeasurementDelay(2))
KINDS = {
    "panda": {"robot": "panda", "scale": None},
    "residual": {"task": "track", "action": "residual"},
    "randomised": {"task": "track", "action": "residual", "effects": PARTS, "randomise": ALL_DRAWN},
    "memory": {"effects": (effects.Gravity(), *MEMORY, effects.Noise(0.01))},
    "in torch": {"task": IN_TORCH, "effects": (effects.Viscous(1.0),)},
    "free and pushed": {
        **{"robot": FREE, "effects": (effects.Gravity(), effects.Push(), effects.Noise(0.01)), "pushes": PUSHES},
        "randomise": {"mass": 0.2},
    },
    "standing": {
        **{"task": TorchTask(reward=lambda now: -now.V_WB_B.square().sum(1), start=stand, draws=4), "robot": FREE},
        **{"effects": (effects.Gravity((0.0, 0.0, -9.81)), effects.Servo(40.0, 4.0), FEET), "dtype": "float64"},
        **{"action": "target", "scale": None},
        "randomise": {"Contact.friction": 0.5, "Contact.stiffness": 0.5, "Contact.height": Absolute(-0.01, 0.01)},
    },
    "free with servos": {
        **{"task": TorchTask(reward=lambda now: now.X_WB[:, 0]), "robot": FREE, "action": "target", "scale": None},
        "effects": (effects.Servo(5.0, 1.0),),
    },
}


@pytest.mark.parametrize("kind", thinned(KINDS, KINDS.keys() - {"panda", "residual", "memory", "free with servos"}))
def test_a_row_is_the_single_environment(kind):
    arguments = {"robot": ROBOT, "action": "torque", "scale": 20.0, "max_episode_steps": 30, **KINDS[kind]}
    many = make(21, **arguments)
    rows = (0, 7, 20)
    single = [RobotEnv(**grouped(**arguments)) for _ in rows]
    observations, _ = many.reset(seed=100)
    for k, env in zip(rows, single, strict=True):
        assert same(env.reset(seed=100 + k)[0], observations[k])
    for action, _ in zip(actions_of(many), range(70), strict=False):
        observations, rewards, terminated, truncated, info = many.step(action)
        last = info.get("final_obs", observations)
        for k, env in zip(rows, single, strict=True):
            one, reward, ended, cut, _ = env.step(action[k].numpy())
            assert same(one, last[k]) and (reward, ended, cut) == (rewards[k], terminated[k], truncated[k])
            if ended or cut:
                assert same(env.reset()[0], observations[k])


def test_every_row_may_have_its_own_seed_and_one_whose_seed_is_none_continues():
    one, other = make(3).reset(seed=np.array([4, 9, 5]))[0], make(6).reset(seed=4)[0]
    assert torch.equal(one, other[[0, 5, 1]])
    envs, plain = started(3), started(3)
    observations, _ = envs.reset(seed=[8, None, 9])
    assert torch.equal(observations[[0, 2]], make(2).reset(seed=8)[0])
    assert torch.equal(observations[1], plain.reset()[0][1])


def test_effects_remember_at_the_beginning_what_they_do_in_a_scene():
    envs = started(effects=(effects.MeasurementDelay(2), effects.Elastic(100.0, 1.0, 0.1), effects.CommandDelay(1)))
    found = envs.get_state()
    expected = envs.scene.start(found["q"], found["qd"])
    (memory,) = (x for name, x in found.items() if name.startswith("memory of "))
    assert torch.equal(memory, expected.memory) and torch.equal(found["reading"], expected.reading)
    assert expected.memory.shape == (5, 4 + 2 + 8)


# --- ends of episodes ------------------------------------------------------------------------------------------------


def test_finished_rows_are_reset_in_the_same_step():
    envs = started(max_episode_steps=4)
    envs.reset(seed=50, options={"reset_mask": np.array([True, False, True, False, False])})
    envs._buffers["steps"][1] = 2  # one row is ahead of the others
    quiet = started(max_episode_steps=None)
    quiet.set_state(envs.get_state())
    action = torch.full((5, 2), 0.4)
    for expected in ([False] * 5, [False, True, False, False, False]):
        observations, _, terminated, truncated, info = envs.step(action)
        before, *_ = quiet.step(action)
        assert truncated.tolist() == expected and not bool(terminated.any())
    assert info["_final_obs"].tolist() == info["_final_info"].tolist() == expected
    assert torch.equal(info["final_obs"], before)  # the last of the old episode, and of the others
    assert not torch.equal(observations[1], before[1]) and torch.equal(observations[2:], before[2:])
    assert set(info["final_info"]) == {"clipped", "nonfinite", "distance", "success"}
    assert envs.get_state()["steps"].tolist() == [2, 0, 2, 2, 2]


def test_a_torque_limit_of_zero_is_none():
    limits = ROBOT.limits
    still = ROBOT.replace(limits=limits._replace(effort=torch.tensor([0.0, 5.0], dtype=torch.float64)))
    assert effects.Saturation((math.inf, 5.0)) in default_effects(still)
    envs = RobotVectorEnv(2, "reach", still)
    envs.reset(seed=0)
    after, *_ = envs.step(torch.tensor([[1.0, 0.0], [-1.0, 0.0]]))
    assert after[0, 4] > 0.01 and after[1, 4] < -0.01  # velocity of the first joint


def test_finished_rows_are_reset_at_the_next_step():
    noisy = (*default_effects(ROBOT), effects.Noise(0.01, 0.01))
    envs, at_once = (make(max_episode_steps=3, autoreset_mode=mode, effects=noisy) for mode in ("NextStep", "SameStep"))
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert same(envs.reset(seed=0), at_once.reset(seed=0))
    action = torch.full((5, 2), 0.4)
    for _ in range(3):
        observations, _, _, truncated, info = envs.step(action)
        fresh, _, _, _, fresh_info = at_once.step(action)
    assert bool(truncated.all()) and "final_obs" not in info
    assert torch.equal(observations, fresh_info["final_obs"])
    observations, rewards, terminated, truncated, _ = envs.step(action)
    assert torch.equal(observations, fresh) and not bool((terminated | truncated).any())
    assert rewards.tolist() == [0.0] * 5
    assert same(envs.step(action)[:4], at_once.step(action)[:4])


def test_info_of_a_row_that_was_reset_is_that_of_its_start():
    terms = TorchTask("reach", reward=lambda now: {"near": -now.rows["distance"], "fast": now.qd.square().sum(1)})
    envs = started(task=terms, max_episode_steps=3, autoreset_mode="NextStep", dtype="float64")
    ahead = torch.tensor([0.0, 1.0, 0.0, 1.0, 0.0], dtype=torch.float64)
    envs.set_state({**envs.get_state(), "steps": ahead})
    for _ in range(2):
        *_, truncated, info = envs.step(torch.full((5, 2), 1.4))
    assert truncated.tolist() == [False, True, False, True, False]
    _, rewards, _, _, info = envs.step(torch.full((5, 2), 1.4))
    state = envs.get_state()
    tip = torchdq.dq.translation(torchdq.forward_kinematics(ROBOT, state["q"], "tip"))
    distance = (tip - state["goal"]).norm(dim=1)
    torch.testing.assert_close(info["distance"], distance)  # now, beside the observation of now
    assert info["success"].tolist() == (distance <= 0.05).tolist()
    assert info["clipped"].tolist() == [2, 0, 2, 0, 2] and not bool(info["nonfinite"].any())
    torch.testing.assert_close(info["near"] + info["fast"], rewards)
    assert rewards[1] == rewards[3] == 0.0


def test_finished_rows_wait_to_be_reset():
    envs = started(max_episode_steps=3, autoreset_mode=AutoresetMode.DISABLED)
    for _ in range(3):
        _, _, terminated, truncated, _ = envs.step(torch.zeros(5, 2))
    with refused(ResetNeeded):
        envs.step(torch.zeros(5, 2))
    envs.reset(options={"reset_mask": torch.tensor([True, True, True, True, False])})
    with refused(ResetNeeded):
        envs.step(torch.zeros(5, 2))
    envs.reset(options={"reset_mask": terminated | truncated})
    envs.step(torch.zeros(5, 2))


@pytest.mark.parametrize("mode", thinned(AutoresetMode, (AutoresetMode.SAME_STEP,)))
@pytest.mark.parametrize("task", ["reach", IN_TORCH], ids=["recorded", "in torch"])
def test_rows_are_the_same_where_the_host_does_not_look(mode, task):
    options = {
        "randomise": {"mass": 0.2, "friction": 0.3},
        "effects": (*default_effects(ROBOT), effects.Noise(0.01, 0.01), effects.Push()),
        **{"robot": FREE, "pushes": PUSHES},
    }
    looking, blind = (started(task=task, max_episode_steps=4, autoreset_mode=mode, **options) for _ in range(2))
    blind._host = Host(False)
    for envs in (looking, blind):
        envs._buffers["steps"][1:3] = 2  # two rows are ahead of the others
    for k in range(11):
        if k == 5:
            for envs in (looking, blind):
                envs._buffers["qd"][3, 0] = math.nan  # the row fails
        actions = torch.full((5, 2), 1.5 - 0.2 * k)
        found = [envs.step(actions) for envs in (looking, blind)]
        assert same(found[0][:4], found[1][:4])
        for name in found[0][4].keys() & {"clipped", "nonfinite", "distance", "success"}:
            torch.testing.assert_close(found[1][4][name], found[0][4][name], rtol=0, atol=0, equal_nan=True)
        if mode == AutoresetMode.DISABLED and bool((found[0][2] | found[0][3]).any()):
            for envs in (looking, blind):
                envs.reset(options={"reset_mask": found[0][2] | found[0][3]})
    states = [envs.get_state() for envs in (looking, blind)]
    assert states[0].keys() == states[1].keys()
    for name, x in states[0].items():
        torch.testing.assert_close(states[1][name], x, rtol=0, atol=0, equal_nan=True)


def test_a_mask_resets_only_its_rows():
    envs = started()
    steps(envs, 5)
    before, options = envs._buffers["observation"].clone(), {"reset_mask": np.array([False, True, False, False, True])}
    observations, _ = envs.reset(seed=70, options=options)
    assert torch.equal(observations[[0, 2, 3]], before[[0, 2, 3]])
    assert torch.equal(observations[[1, 4]], make().reset(seed=70)[0][[1, 4]])
    assert set(options) == {"reset_mask"}  # as it was given


@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_mode_of_resets_may_be_named_in_both_ways(mode):
    assert make(autoreset_mode=mode.name).autoreset_mode is make(autoreset_mode=mode.value).autoreset_mode is mode


@pytest.mark.parametrize("single", [False, True], ids=["five", "one"])
@pytest.mark.parametrize("seed", ["a", 1.5, -1, True, 2**63, [1, 2, 3], [1, "a", 2, 3, 4], [0.5], [True] * 5])
def test_a_seed_that_is_none_is_refused_by_name(seed, single):
    envs = RobotEnv(robot="panda") if single else make()
    with refused(torchdq.ArgumentError):
        envs.reset(seed=seed)


def test_the_largest_seed_is_named_and_taken():
    envs = make()
    for seed in (2**63 - 5, [0, 1, 2, 3, 2**63 - 1]):  # row 4 has the seed + 4
        envs.reset(seed=seed)
    for seed in (2**63 - 4, [0, 1, 2, 3, 2**63]):
        with refused(torchdq.ArgumentError):
            envs.reset(seed=seed)


def test_calls_in_the_wrong_order_are_refused():
    envs = make()
    for call in (lambda: envs.step(torch.zeros(5, 2)), envs.get_state,
                 lambda: envs.reset(options={"reset_mask": np.ones(5, bool)})):  # fmt: skip
        with refused(ResetNeeded):
            call()
    with refused(torchdq.ArgumentError):
        envs.reset(seed=[1, 2])
    with pytest.raises(ResetNeeded):  # a reset that failed was none
        envs.step(torch.zeros(5, 2))
    envs.reset(seed=0)
    envs.close()
    for call in (envs.reset, lambda: envs.step(torch.zeros(5, 2)), envs.get_state):
        with pytest.raises(ClosedEnvironmentError):
            call()


# --- actions ---------------------------------------------------------------------------------------------------------


def with_bad(x, bad):
    """Copy of a tensor with another number in row 3."""
    return torch.cat([x[:3], x[3:4].index_fill(1, torch.tensor(1), bad), x[4:]])


COMPLEX = torch.ones(5, 2, dtype=torch.complex128)
ACTIONS = [
    *(with_bad(torch.zeros(5, 2), bad) for bad in (math.nan, math.inf, -math.inf)),
    *(np.zeros(shape) for shape in ((2,), (5,), (4, 2), (5, 3), (5, 1), (1, 5, 2))),
    *(None, "x", np.array([None, {}]), {"a": 1}, [[1.0], []], torch.zeros(5, 2).to_sparse()),
    *(COMPLEX, COMPLEX.numpy(), COMPLEX.tolist()),
]
MASKS = [np.ones(4, bool), np.ones(5), torch.ones(5, 1, dtype=torch.bool)]
OPTIONS = [*({"reset_mask": mask} for mask in MASKS), {"mask": torch.ones(5, dtype=torch.bool)}]
STATES = [
    lambda state: {"q": state["q"]},
    lambda state: None,
    lambda state: {**state, "q": state["q"][:3]},
    lambda state: {**state, "q": state["q"].double()},
    lambda state: {**state, "q": 5},
    lambda state: {**state, "goal": with_bad(state["goal"], math.nan)},
]
CALLS = [
    *(lambda envs, actions=actions: envs.step(actions) for actions in ACTIONS),
    *(lambda envs, options=options: envs.reset(options=options) for options in OPTIONS),
    *(lambda envs, change=change: envs.set_state(change(envs.get_state())) for change in STATES),
    lambda envs: envs.render(),
]


@pytest.mark.parametrize("call", CALLS)
def test_a_call_that_is_refused_changes_nothing(call):
    envs = started()
    before = envs.get_state()
    with refused(torchdq.TorchdqError):
        call(envs)
    assert same(envs.get_state(), before)


def test_actions_out_of_range_are_clipped_and_counted():
    envs, within = started(), started()
    wild = torch.tensor([[0.5, 1.0], [-1.5, 0.0], [3.0, -1.00001], [0.0, 0.0], [0.0, 1e30]])
    result, expected = envs.step(wild), within.step(wild.clamp(-1, 1))
    assert result[4].pop("clipped").tolist() == [0, 1, 2, 0, 1]
    assert expected[4].pop("clipped").tolist() == [0] * 5
    assert same(result, expected)
    envs.step(np.zeros((5, 2), dtype=int))
    assert not envs.step(torch.zeros(5, 2, requires_grad=True))[0].requires_grad


def test_a_full_action_is_the_limit_of_the_torque():
    envs = RobotVectorEnv(1, robot="panda", effects=(), action="torque")
    assert envs._scale.tolist() == torchdq.robots.load("panda").limits.effort.tolist()


def test_a_full_action_needs_no_limit_of_a_passive_joint():
    one = ROBOT.replace(limits=ROBOT.limits._replace(effort=double(7.0, math.inf)))
    assert started(1, robot=one, joints=one.joint_names[0], scale=None)._scale.tolist() == [7.0]


def test_a_full_action_of_the_default_kind_moves_a_joint_at_its_velocity_limit():
    """The gains of the controller are those of a joint that follows an offset of 0.2 s at the speed of 0.2 s."""
    robot = torchdq.robots.load("panda")
    envs = started(1, "reach", robot=robot, effects=(effects.Gravity(),), action=None, scale=None)
    for _ in range(50):
        envs.step(torch.eye(7)[:1])
    expected = torch.eye(7)[0] * robot.limits.velocity
    assert torch.allclose(envs.get_state()["qd"][0].double(), expected, atol=0.02 * float(expected[0]))


# --- failing simulations ---------------------------------------------------------------------------------------------


@pytest.mark.case("T13")
@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e8])
@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_row_that_fails_terminates_alone(mode, bad):
    envs, healthy = (started(autoreset_mode=mode) for _ in range(2))
    before = envs.get_state()["observation"]
    envs._buffers["qd"][2, 0] = bad
    action = next(actions_of(envs))
    observations, rewards, terminated, truncated, info = envs.step(action)
    others = [0, 1, 3, 4]
    expected = healthy.step(action)
    assert terminated.tolist() == info["nonfinite"].tolist() == [False, False, True, False, False]
    assert not bool(truncated.any()) and rewards[2] == -1000
    assert torch.equal(observations[others], expected[0][others]) and torch.equal(rewards[others], expected[1][others])
    last = info["final_obs"] if mode == AutoresetMode.SAME_STEP else observations
    assert torch.equal(last[2], before[2])  # the last one that made sense
    assert info["distance"].isfinite().tolist() == [True, True, False, True, True]
    if mode == AutoresetMode.DISABLED:
        envs.reset(options={"reset_mask": terminated})
    for _ in range(2):
        observations, rewards, terminated, _, _ = envs.step(action)
        assert bool(observations.isfinite().all()) and bool(rewards.isfinite().all()) and not bool(terminated.any())


# --- saving ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", thinned(["reach", "track"], ["track"]))
def test_saved_environments_go_on_as_if_nothing_had_been(task, tmp_path):
    remembering = (*PARTS, effects.FirstOrderLag(0.05), effects.MeasurementDelay(1))
    made = {"action": "residual", "max_episode_steps": 15, "randomise": ALL_DRAWN, "effects": remembering}
    envs = started(task=task, **made)
    steps(envs, 40)
    torch.save(envs.get_state(), tmp_path / "state.pt")
    expected = steps(envs, 40, seed=1)
    other = make(task=task, **made)
    for _ in range(2):  # into one that was never reset, and into one that went on
        other.set_state(torch.load(tmp_path / "state.pt", weights_only=True))
        assert same(steps(other, 40, seed=1), expected)
    assert same(other.get_state(), envs.get_state())


def test_a_state_that_other_effects_remember_is_refused():
    remembering = (effects.FirstOrderLag(0.05), effects.CommandDelay(1))
    lagging, late = (started(effects=(*default_effects(ROBOT), effect)) for effect in remembering)
    state = lagging.get_state()
    assert state["memory of FirstOrderLag"].shape == late.get_state()["memory of CommandDelay"].shape
    with refused(torchdq.ArgumentError):
        late.set_state(state)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["copy", "pickle"])
def test_copies_go_on_alike_and_apart(duplicate):
    envs = started(randomise={"mass": 0.5}, max_episode_steps=4)
    steps(envs, 2)
    other = duplicate(envs)
    assert same(steps(envs, 10), steps(other, 10))


# --- what differs between episodes -----------------------------------------------------------------------------------


def test_randomised_rows_differ_and_need_no_new_program(monkeypatch):
    envs = started(64, randomise={"mass": 0.2, "friction": 0.5, "payload": 2.0}, max_episode_steps=5)
    steps(envs, 6)
    loaded = []
    monkeypatch.setattr(build, "load", lambda *arguments: loaded.append(arguments))
    parameters = envs._reset.drawn
    before = {name: x.clone() for name, x in parameters.items()}
    steps(envs, 6)
    assert loaded == []
    assert all(not torch.equal(x, before[name]) for name, x in parameters.items())


PD, PLANE = controllers.PD(1.0, 1.0), controllers.OperationalSpaceControl(100.0, 20.0, axes=("x", "y"))
POSED = {"action": "pose", "scale": None, "controller": PLANE}
SOME = {"joints": ROBOT.joint_names[:1]}  # the other one is passive
WRONG = {
    "task": ("pull", 3, Reach),
    "robot": ("pandaa", torchdq.robots.load("panda").with_tip(None), stacked(limits=True), stacked()),
    "effects": ((effects.Gravity,), (effects.Servo(10.0),), (effects.Payload(torch.rand(4, 1)),), (effects.Push(),)),
    "action": ("force",),
    "scale": (None, (), [1.0], [20.0, 0.0], np.array([1.0, -2.0])),
    "leash": ((-1.0, 1.0),),
    "joints": ("wheel", (), 1),
    "controller": (PD,),
    "pushes": (PUSHES,),
    "dt": (0.0,),
    "simulation": (0.02,),
    "num_envs": (0,),
    "max_episode_steps": (0,),
    "dtype": (torch.float16,),
    "device": ("cuda:99", "gpu"),
    "output": ("jax",),
    "render_mode": ("ansi",),
}
TOGETHER = [
    *({**SOME, "action": kind} for kind in ("reference", "residual")),
    *({"effects": (effects.Push(),), "pushes": x} for x in ({"pull": PUSHES["push"]}, {"push": (1.0,) * 6})),
    *({**POSED, **x} for x in ({"controller": PD}, {"action": "reference"}, {"scale": (0.1,) * 3}, SOME)),
]
ARGUMENTS = [*({name: x} for name, values in WRONG.items() for x in values), *TOGETHER]


@pytest.mark.parametrize("arguments", ARGUMENTS, ids=" and ".join)
def test_wrong_arguments_are_refused(arguments):
    with refused(torchdq.TorchdqError):
        make(**{"num_envs": 4, **arguments})


# --- other libraries -------------------------------------------------------------------------------------------------


def test_stable_baselines_that_is_missing_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "torchdq.envs.sb3", raising=False)
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    with refused(torchdq.MissingLibraryError):
        importlib.import_module("torchdq.envs.sb3")


def test_stable_baselines_trains():
    library = pytest.importorskip("stable_baselines3")
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
    from torchdq.envs.sb3 import StableBaselinesVecEnv

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(RobotEnv(robot=ROBOT, action=FULL))
    envs = StableBaselinesVecEnv(make(4, max_episode_steps=10))
    envs.seed(3)
    assert same(envs.reset(), make(4).reset(seed=3)[0])
    for _ in range(10):
        observations, _, done, infos = envs.step(np.zeros((4, 2), np.float32))
    assert done.all() and infos[0]["TimeLimit.truncated"]
    assert infos[0]["terminal_observation"].shape == observations[0].shape
    monitored = vec_env.VecMonitor(envs)
    model = library.PPO("MlpPolicy", monitored, n_steps=16, batch_size=32, device="cpu").learn(128)
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer) > 0  # of which it logs the means


def test_stable_baselines_has_the_info_of_every_row():
    pytest.importorskip("stable_baselines3")
    from torchdq.envs.sb3 import StableBaselinesVecEnv

    plain, envs = started(4, max_episode_steps=3), StableBaselinesVecEnv(make(4, max_episode_steps=3))
    envs.seed(0)
    envs.reset()
    state = plain.get_state()
    state["qd"][3] = 1e8  # fails
    state["goal"][0] = torchdq.dq.translation(torchdq.forward_kinematics(ROBOT, state["q"], "tip"))[0]
    for k in range(3):
        for one in (plain, envs.envs) if k == 2 else ():
            one.set_state({**state, "steps": one.get_state()["steps"]})
        actions = torch.full((4, 2), 1.5 if k < 2 else 0.0)
        _, _, done, infos = envs.step(actions.numpy())
        *_, info = plain.step(actions)
        for name in ("clipped", "nonfinite", "distance", "success"):
            np.testing.assert_equal([row[name] for row in infos], info[name].tolist())
        assert all(("is_success" in row) == ended for row, ended in zip(infos, done, strict=True))
    assert infos[3]["nonfinite"] and [row["is_success"] for row in infos] == [True, False, False, False]


def test_success_is_what_is_above_zero():
    pytest.importorskip("stable_baselines3")
    from torchdq.envs.sb3 import StableBaselinesVecEnv

    bonus = torch.tensor([5.0, 0.2, 0.0, -1.0])
    envs = StableBaselinesVecEnv(make(4, TorchTask(reward=lambda now: {"success": bonus}), max_episode_steps=1))
    envs.reset()
    *_, infos = envs.step(np.zeros((4, 2), np.float32))
    assert [row["is_success"] for row in infos] == [True, True, False, False]


@pytest.mark.parametrize(
    "module, wrapped",
    [
        ("torchrl.envs", lambda library, envs: library.GymWrapper(envs, convert_actions_to_numpy=False)),
        ("skrl.envs.wrappers.torch", lambda library, envs: library.wrap_env(envs, wrapper="gymnasium")),
    ],
    ids=["torchrl", "skrl"],
)
def test_other_libraries_wrap_them(module, wrapped):
    envs = wrapped(pytest.importorskip(module), make(4, max_episode_steps=10))
    found = envs.rollout(5)["observation"] if hasattr(envs, "rollout") else envs.reset()[0]
    assert found.shape[0] == 4


def test_a_robot_that_stands_carries_its_weight_and_rests_where_it_was():
    """On grounds that differ; from a state that was saved it goes on the same, bristles included."""
    envs = started(30, **{**KINDS["standing"], "max_episode_steps": None})
    held = torch.zeros(30, 2)
    for _ in range(150):
        envs.step(held)
    saved, weight = envs.get_state(), 9.81 * (3.0 + float(ROBOT.mass.sum()))
    contacts, heights = envs.scene.contacts(envs.state), saved["2.height"]
    assert (contacts.normal_force.sum(1) - weight).abs().max() < 1e-3 * weight
    assert contacts.touching.all() and (torchdq.dq.translation(saved["X_WB"])[:, 2] - 0.22 - heights).abs().max() < 5e-3
    assert saved["V_WB_B"].abs().max() < 1e-3
    later = steps(envs, 50)
    envs.set_state(saved)
    assert same(steps(envs, 50), later) and not same(steps(envs, 50), later)
