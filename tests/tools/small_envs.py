"""Small vector environments, random actions for them, and equality of what they return, for several test files."""

from functools import cache

import torch
from torch.distributions import LogNormal

import torchdq
from torchdq import effects
from torchdq.envs import Actions, Pushes, RobotVectorEnv, Simulation
from torchdq.envs.walk import Walk

ROBOT = torchdq.robots.load("two_link")
FREE = ROBOT.replace(
    base_mass=torch.tensor(3.0),
    base_com=torch.tensor([0.0, 0.1, 0.0]),
    base_inertia=torch.tensor([0.3, 0.0, 0.4, 0.0, 0.0, 0.5]),
).bake()  # flying freely
PUSHES = {"push": Pushes((5.0, 5.0, 5.0, 1.0, 1.0, 1.0), every=(0.05, 0.2))}
PARTS = (effects.Gravity(), effects.RotorInertia(0.1), effects.Viscous(2.0), effects.Coulomb(0.5), effects.Noise(0.01))
ALL_DRAWN = {
    **{"mass": 0.2, "com": 0.02, "friction": (0.5, 2.0), "gravity": LogNormal(0.0, 0.02), "armature": 0.5},
    **{"gains": 0.1, "delay": (0.0, 2.0), "payload": 0.5, "Noise.position": 0.5},
}  # of environments with a controller and these parts

BEAM = """<body name="leg{0}" pos="{1} {2} 0"><joint axis="0 1 0" armature="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.5"/><body name="foot{0}" pos="0 0 -0.28">
<geom type="sphere" size="0.02" mass="0.1"/></body></body>"""
STOOL = f"""<mujoco model="stool"><worldbody><body name="seat" pos="0 0 0.3"><freejoint/>
<geom type="box" size="0.15 0.1 0.03" mass="5"/><body name="feeler" pos="0 0 -0.28"/>
{"".join(BEAM.format(k, 0.15 - 0.3 * (k % 2), 0.1 - 0.2 * (k // 2)) for k in range(4))}</body></worldbody></mujoco>"""
ON_FOUR = Walk(feet="foot?", stand={})


@cache
def stool():
    """Four legs of a joint each, and a point without mass two centimetres above the ground."""
    return torchdq.Robot.from_mjcf(STOOL)


ACTIONS = ("controller", "scale", "leash", "joints")
SIMULATION = ("dt", "substeps", "integrator", "backend")


def make(num_envs=5, task="reach", **arguments):
    """Vector environment of a small robot; fields of `Actions` and `Simulation` may be arguments."""
    return RobotVectorEnv(num_envs, task, **grouped(**{"robot": ROBOT, "action": "torque", "scale": 20.0, **arguments}))


def grouped(action=None, **arguments):
    """Arguments of an environment, of which fields of `Actions` and `Simulation` are among those given."""
    own, timing = ({x: arguments.pop(x) for x in names if x in arguments} for names in (ACTIONS, SIMULATION))
    return {"simulation": Simulation(**timing), **arguments, "action": Actions(action, **own)}


def started(num_envs=5, task="reach", **arguments):
    """Vector environment of a small robot, reset with the seed 0."""
    envs = make(num_envs, task, **arguments)
    envs.reset(seed=0)
    return envs


def actions_of(envs, seed=0):
    """Random actions, within their bounds, that do not end."""
    generator = torch.Generator().manual_seed(seed)
    while True:
        yield 2 * torch.rand(envs.num_envs, envs.robot.n, generator=generator) - 1


def steps(envs, number, seed=0):
    """Results of a number of steps with random actions."""
    return [envs.step(action) for action, _ in zip(actions_of(envs, seed), range(number), strict=False)]


def same(a, b):
    """Whether nested results are equal to the bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return torch.equal(torch.as_tensor(a), torch.as_tensor(b))


def policy_of(envs, activation=torch.nn.ELU):
    """Small random policy."""
    torch.manual_seed(0)
    width, k = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    return torch.nn.Sequential(torch.nn.Linear(width, 8), activation(), torch.nn.Linear(8, k)).to(envs.dtype)


def assert_as_stepped(envs, twin, policy, steps, blocks=2):
    """Assert that blocks have what steps of an equal environment return, and leave the same state."""
    for _ in range(blocks):
        noise = torch.randn(steps, *envs.action_space.shape, dtype=envs.dtype)
        found, observation = envs.rollout(policy, steps, noise, 0.5), twin.get_state()["observation"]
        for k in range(steps):
            assert torch.equal(found.observations[k], observation)
            expected = 0.5 * (policy(observation) + noise[k])
            torch.testing.assert_close(found.actions[k], expected, rtol=1e-4, atol=1e-5)
            observation, *others, info = twin.step(found.actions[k])
            last = info.pop("final_obs", observation)
            rows = (*found[2:5], found.final_observations)
            assert same([x[k] for x in rows], [*others, last])
            assert found.info.keys() == {name for name in info if "final" not in name}
            for name, x in found.info.items():
                torch.testing.assert_close(x[k], info[name], rtol=0, atol=0, equal_nan=True)
        assert torch.equal(found.observations[-1], observation)
        assert same(envs.get_state(), twin.get_state())
    return found
