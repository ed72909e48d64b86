"""Tasks of functions of tensors, compared with recorded ones."""

import math
import warnings
from dataclasses import dataclass

import pytest
import torch
from messages import refused
from small_envs import actions_of, started

import torchdq
from torchdq import effects
from torchdq.envs import TorchTask
from torchdq.envs.tasks import Reach
from torchdq.scene import State
from torchdq.scene.integrators import ExplicitEuler

BOUNDS = [(-math.inf, math.inf)] * 4


def make(task, num_envs=5, **arguments):
    """Vector environment of a small robot with some friction, reset."""
    return started(num_envs, task, **{"effects": (effects.Viscous(1.0),), **arguments})


@dataclass(frozen=True)
class Gentle(Reach):
    """The example of `torchdq.envs.tasks`."""

    def rows(self, view):
        """With a cost of the velocities."""
        rows, energy = super().rows(view), sum((v * v for v in view.qd), 0.0)
        return {**rows, "reward": [rows["reward"][0] - 0.01 * energy], "energy": [energy]}


def gentle(now):
    """Reward of `Gentle`."""
    return now.rows["reward"] - 0.01 * now.qd.square().sum(1)


def state(now):
    """Observation of the measured state."""
    return torch.cat([now.q_measured, now.qd_measured], 1)


def test_a_reward_of_tensors_is_the_recorded_one():
    recorded, torched = make(Gentle()), make(TorchTask("reach", gentle))
    for action, _ in zip(actions_of(recorded), range(5), strict=False):
        a, b = recorded.step(action), torched.step(action)
        assert torch.equal(a[0], b[0]) and torch.allclose(a[1], b[1], rtol=1e-6, atol=1e-6)
        assert torch.allclose(a[4]["energy"], torched._buffers["qd"].square().sum(1), rtol=1e-5)


def test_terms_of_a_reward_are_summed_and_land_in_info():
    terms = {"closer": lambda now: -now.rows["distance"], "slower": lambda now: -0.1 * now.qd.square().sum(1)}
    named = make(TorchTask("reach", lambda now: {name: term(now) for name, term in terms.items()}))
    summed = make(TorchTask("reach", lambda now: sum(term(now) for term in terms.values())))
    for action, _ in zip(actions_of(named), range(3), strict=False):
        (_, found, *_, info), (_, expected, *_) = named.step(action), summed.step(action)
        assert torch.equal(found, expected) and torch.equal(info["closer"] + info["slower"], found)
        assert torch.equal(info["closer"], -info["distance"])


def test_functions_see_the_state_after_the_step():
    seen = []
    envs = make(TorchTask("track", lambda now: seen.append(now) or now.q.sum(1)), effects=(effects.Bias(0.3, 0.1),))
    action = torch.tensor([[0.5, -3.0]]).expand(5, 2)
    rewards = [envs.step(action)[1] for _ in range(2)][1]
    now = seen[1]
    assert torch.equal(now.q, envs._buffers["q"]) and torch.equal(now.qd, envs._buffers["qd"])
    assert torch.allclose(now.q_measured, now.q + 0.3) and torch.allclose(now.qd_measured, now.qd + 0.1)
    assert torch.equal(now.action, action.clamp(-1, 1))
    assert torch.allclose(now.time, torch.full((5,), 2 * envs.scene.dt)) and now.goal.shape == (5, 14)
    assert torch.equal(rewards, now.q.sum(1)) and {"observation", "reward", "reference", "error"} <= set(now.rows)


@pytest.mark.parametrize(
    "randomise", [{"mass": 0.3, "payload": (1.0, 2.0), "gravity": 0.2, "com": 0.05}, {"payload": 2.0}, None], ids=str
)
def test_the_robot_of_a_row_is_the_one_that_is_simulated(randomise):
    parts = (effects.Gravity(), effects.RotorInertia(0.3), effects.Payload(0.5, frame="tip"), effects.Viscous(1.0))
    seen = []

    def watched(now):
        seen.append((now, now.robot))
        return state(now)

    task = TorchTask("reach", observation=watched, bounds=BOUNDS)
    envs = make(task, effects=parts, randomise=randomise, dtype="float64", autoreset_mode="Disabled")
    some = torch.tensor([False, True, False, True, True])
    envs.reset(options={"reset_mask": some})
    envs.step(torch.zeros(5, 2, dtype=torch.float64))
    _, (_, of_some), (now, robot) = seen
    found = torchdq.kinetic_energy(robot, now.q, now.qd), torchdq.potential_energy(robot, now.q)
    energy = envs.scene.energy(State(now.q, now.qd))
    assert torch.allclose(torch.stack(found, -1), energy, rtol=1e-12, atol=1e-12)
    assert (robot.mass.ndim == 2) == (randomise is not None)
    assert torch.equal(of_some.mass, robot.mass if randomise is None else robot.mass[some])


def test_an_observation_of_tensors_has_its_own_space():
    envs = make(TorchTask("reach", observation=state, bounds=BOUNDS))
    assert envs.single_observation_space.shape == (4,)
    for call in (lambda: envs.reset(seed=1), lambda: envs.step(torch.ones(5, 2))):
        observations, now = call()[0], envs.get_state()
        assert torch.equal(observations, torch.cat([now["q"], now["qd"]], 1))


def test_episodes_end_where_a_function_says():
    envs = make(TorchTask("reach", terminated=lambda now: now.q[:, 0] > 0.5), autoreset_mode="Disabled")
    envs.set_state(
        {**envs.get_state(), "q": torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [2.0, 0.0], [0.0, 0.0]])}
    )
    _, _, terminated, _, info = envs.step(torch.zeros(5, 2))
    assert terminated.tolist() == [False, True, False, True, False] and not bool(info["nonfinite"].any())


def above(robot, u):
    """The better of two random starts of each row, that whose second joint is bent more."""
    q = (2 * u - 1).reshape(-1, 2, 2)
    best = q[:, :, 1].abs().argmax(1)
    return {"q": q[torch.arange(len(q)), best], "qd": torch.full((len(q), 2), 0.5)}


def test_starts_may_be_chosen_among_several():
    envs = make(TorchTask("reach", start=above, draws=4), 400)
    q, qd = envs._buffers["q"], envs._buffers["qd"]
    assert bool((qd == 0.5).all()) and bool((q.abs() <= 1).all())
    assert abs(q[:, 1].abs().mean() - 2 / 3) < 0.05 and abs(q[:, 0].abs().mean() - 1 / 2) < 0.05


@pytest.mark.parametrize(
    "name, bad",
    [("reward", math.nan), ("reward", math.inf), ("reward", 1e9), ("observation", math.nan), ("observation", math.inf)],
)
def test_a_function_that_fails_ends_that_row_alone(name, bad):
    def wrong(x, now):
        return torch.where((now.time > 0.03) & (torch.arange(len(x)) == 2), bad, x.sum(1))

    functions = {
        "reward": {"reward": lambda now: wrong(now.q, now)},
        "observation": {"observation": lambda now: wrong(now.q, now)[:, None], "bounds": [(-9, 9)]},
    }
    envs = make(TorchTask("reach", **functions[name]), dt=0.02)
    first, *_ = envs.step(torch.zeros(5, 2))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        observations, rewards, terminated, _, info = envs.step(torch.zeros(5, 2))
    fault = f"{name} of the task is NaN in 1 of 5 rows whose positions and velocities are finite"
    assert [str(one.message).startswith(fault) for one in said] == [True] * math.isnan(bad)
    assert terminated.tolist() == info["nonfinite"].tolist() == [False, False, True, False, False]
    assert rewards[2] == -1000 and bool(rewards.isfinite().all()) and bool(observations.isfinite().all())
    assert torch.equal(info["final_obs"][2], first[2])


REWARDS = [1.0, lambda now: now.rows["dist"], lambda now: {"distance": now.q[:, 0]}]  # of a task that reaches
ALONE = [*(lambda now: 1.0, lambda now: now.q, lambda now: now.q.sum()), lambda now: {"clipped": now.q[:, 0]}]
STARTS = [*((lambda robot, u: {}, True), (lambda robot, u: u, 0), (lambda robot, u: {"x": u}, 0)),
          *((lambda robot, u: {"q": u}, 3), (lambda robot, u: {"q": u / 0}, 2))]  # fmt: skip
SEEN = [(state, None), (state, [(1, -1)]), (state, BOUNDS[:3]), (lambda now: state(now) / 0, BOUNDS)]
TASKS = [
    *(lambda: TorchTask("pull"), lambda: TorchTask(lambda now: now.q.sum(1)), lambda: TorchTask()),
    *(lambda x=x: TorchTask("reach", x) for x in REWARDS),
    *(lambda x=x: TorchTask("reach", terminated=x) for x in (True, lambda now: now.q[:, 0])),
    *(lambda x=x: TorchTask(reward=x) for x in ALONE),
    *(lambda start=start, draws=draws: TorchTask("reach", start=start, draws=draws) for start, draws in STARTS),
    *(lambda x=x, bounds=bounds: TorchTask("reach", observation=x, bounds=bounds) for x, bounds in SEEN),
]


@pytest.mark.parametrize("task", TASKS)
def test_wrong_functions_are_refused(task):
    with refused(torchdq.TorchdqError):
        make(task()).step(torch.zeros(5, 2))


# --- tasks that name no other ----------------------------------------------------------------------------------------

CARTPOLE = """<robot name="cartpole"><link name="rail"/>
  <link name="cart"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="pole"><inertial><origin xyz="0 0 -0.5"/><mass value="0.2"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" velocity="5" effort="20"/></joint>
  <joint name="hinge" type="continuous"><parent link="cart"/><child link="pole"/><axis xyz="0 1 0"/></joint></robot>"""


def upright(now):
    """Reward of a pole that stands above a cart in the middle."""
    x, angle = now.q.unbind(1)
    return {"upright": -angle.cos(), "centred": -0.1 * x.square(), "effort": -0.01 * now.action.square().sum(1)}


def hanging(robot, u):
    """Start near the pole's rest, with the place for the cart as the goal."""
    return {"q": 0.2 * (u - 0.5), "goal": u[:, :1]}


@pytest.fixture(scope="module")
def cartpole():
    """A cart on a rail, with a pole that has no motor."""
    return torchdq.Robot.from_urdf(CARTPOLE)


def swinging(cartpole, num_envs=5, **arguments):
    """Swing-up of a cart-pole, reset."""
    parts = (effects.Gravity(), effects.Viscous([0.1, 0.0]))
    task = TorchTask(reward=upright, start=hanging, draws=2)
    given = {"robot": cartpole, "effects": parts, "joints": "slide", "action": None, "scale": None}
    return started(num_envs, task, **{**given, **arguments})


def test_a_task_of_functions_alone_has_their_start_and_goal_and_a_plain_observation(cartpole):
    envs, seen = swinging(cartpole), []
    state = envs.get_state()
    assert bool((state["q"].abs() <= 0.1).all()) and state["goal"].shape == (5, 1) and bool((state["goal"] > 0).all())
    observations, rewards, *_, info = envs.step(torch.ones(5, 1))
    q, qd = (envs.get_state()[name] for name in ("q", "qd"))
    limits = torch.tensor([5.0, 2.0])  # a joint without a limit has 2 rad/s
    expected = torch.cat([q[:, :1], q[:, 1:].sin(), q[:, 1:].cos(), qd / limits], 1)
    torch.testing.assert_close(observations, expected)
    torch.testing.assert_close(rewards, info["upright"] + info["centred"] + info["effort"])
    alone = started(3, TorchTask(reward=lambda now: seen.append(now) or now.time))
    assert alone.get_state()["goal"].shape == (3, 0) and alone.single_observation_space.shape == (6,)
    alone.step(torch.zeros(3, 2))
    assert seen[0].goal.shape == (3, 0)


def test_a_passive_joint_gets_no_torque(cartpole):
    """The step is that of the scene with the torques of the others alone, and none of a controller."""
    envs = swinging(cartpole, dtype="float64", substeps=20, scale=7.0)
    assert envs.single_action_space.shape == (1,)
    before = envs.get_state()
    envs.step(torch.ones(5, 1))
    scene = torchdq.Scene(cartpole, envs.scene.effects, integrator=envs.scene.integrator, dt=0.02, substeps=20)
    expected = scene.step(State(before["q"], before["qd"]), torque=torch.tensor([7.0, 0.0], dtype=torch.float64))
    assert torch.equal(envs.get_state()["q"], expected.q) and torch.equal(envs.get_state()["qd"], expected.qd)
    actions = []
    watched = TorchTask(reward=lambda now: actions.append(now.action) or now.time)
    other = started(5, watched, robot=cartpole, joints=["slide"], scale=[7.0])
    *_, info = other.step(torch.full((5, 1), -2.0))
    assert actions[0].tolist() == [[-1.0, 0.0]] * 5 and info["clipped"].tolist() == [1] * 5
    other = started(5, watched, robot=cartpole, joints="h*", scale=1.0)
    other.step(torch.full((5, 1), 0.5))
    assert actions[1].tolist() == [[0.0, 0.5]] * 5


@pytest.mark.parametrize(
    "joints, order",
    [
        (["panda_joint6", "panda_joint2"], [5, 1]),
        (["panda_joint[32]", "*2", "panda_joint1"], [1, 2, 0]),
        ({"panda_joint6", "panda_joint2"}, [1, 5]),
        ([f"panda_joint{i}" for i in range(7, 0, -1)], [6, 5, 4, 3, 2, 1, 0]),
    ],
    ids=["names", "patterns", "set", "all"],
)
def test_actions_and_their_scale_follow_the_names(joints, order):
    """Work of the first step from rest, on joints that inertia alone resists: qd = M^-1 tau dt."""
    panda, k = torchdq.robots.load("panda"), len(order)
    still = TorchTask(reward=lambda now: now.time)
    scale, action = [1.0 + i for i in range(k)], torch.linspace(0.2, 0.9, k, dtype=torch.float64)
    given = {"effects": (), "integrator": ExplicitEuler(), "substeps": 1, "dtype": "float64", "action": "torque"}
    envs = started(1, still, robot=panda, joints=joints, scale=scale, **given)
    q = envs.get_state()["q"]
    envs.step(action[None])
    torque = torch.zeros(1, 7, dtype=torch.float64)
    for column, joint in enumerate(order):
        torque[0, joint] = scale[column] * action[column]
    found = (torchdq.mass_matrix(panda, q) @ envs.get_state()["qd"][..., None]).squeeze(-1) / 0.02
    torch.testing.assert_close(found, torque, rtol=1e-9, atol=1e-9)
