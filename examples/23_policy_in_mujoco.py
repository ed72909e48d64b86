"""A policy that learned to walk here walks in MuJoCo: the same URDF and servos, spheres as feet, another simulator.

    python examples/23_policy_in_mujoco.py [out/walk.pt] [--turning 0.5] [--urdf FILE]

Nothing of this package simulates or observes: the observation is built from MuJoCo's state, torques are cut at the
limits of the file, the step is 2 ms. Each line has four runs of 10 s from different starts.
"""

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import nn

from torchdq import Robot, effects
from torchdq.envs.walk import Walk
from torchdq.robot.shipped import go2

STEP, PERIOD = 0.002, 0.02  # of MuJoCo, and between actions [s]
UNIT = 1 / 6  # output of the policy as an action


class Run(NamedTuple):
    """One run: whether the robot stayed up, and its mean velocity after 2 s (forward, sideways, yaw rate)."""

    up: bool
    velocity: NDArray


class Player:
    """A quadruped in MuJoCo, on a plane.

    Args:
        urdf: text of its description; of its collision elements only spheres touch the ground.
        task: the task that the policy learned.
        friction: of the ground.
        elliptic: whether cones of friction are elliptic, as in nature, or pyramids, as MuJoCo has them by default.
    """

    def __init__(self, urdf: str, task: Walk, friction: float = 0.8, elliptic: bool = False) -> None:
        robot = Robot.from_urdf(urdf, base="floating")
        chosen = task.defaults(robot)
        parts, self.full = {type(effect): effect for effect in chosen["effects"]}, chosen["scale"]
        compiler = '<mujoco><compiler fusestatic="false" discardvisual="true" strippath="true"/></mujoco></robot>'
        spec = mujoco.MjSpec.from_string(urdf.replace("</robot>", compiler))
        spec.worldbody.first_body().add_freejoint()
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
        for geom in spec.geoms:
            geom.friction[0] = friction
            touches = geom.type in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_PLANE)
            geom.contype = geom.conaffinity = int(touches)
        self.model = model = spec.compile()
        model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if elliptic else mujoco.mjtCone.mjCONE_PYRAMIDAL
        joints = [model.joint(name) for name in robot.joint_names]
        self.at, self.moving = [int(x.qposadr[0]) for x in joints], [int(x.dofadr[0]) for x in joints]
        self.kp, self.limit = parts[effects.Servo].kp, robot.limits.effort.numpy()
        model.dof_damping[self.moving] = parts[effects.Servo].kd
        model.dof_armature[self.moving] = parts[effects.RotorInertia].inertia
        self.stand, self.lowest = np.array(task.joints(robot)), task.lowest
        self.height = float(task.height(robot, task.joints(robot)))

    def run(self, policy: nn.Module, command: tuple[float, float, float], seed: int = 0, seconds: float = 10.0) -> Run:
        """Run of a policy from a start near the stand."""
        model, data, R = self.model, mujoco.MjData(self.model), np.empty(9)
        data.qpos[:7] = [0, 0, self.height, 1, 0, 0, 0]
        data.qpos[self.at] = self.stand + 0.1 * np.random.default_rng(seed).uniform(-1, 1, len(self.stand))
        action, up, mean = np.zeros(len(self.stand)), True, np.zeros(3)
        start, end = round(2.0 / PERIOD), round(seconds / PERIOD)
        for k in range(end):
            mujoco.mju_quat2Mat(R, data.qpos[3:7])
            v, w, down = R.reshape(3, 3).T @ data.qvel[:3], data.qvel[3:6], -R[6:]
            seen = {
                "velocity": [*v, *command[:2]],
                "rate": [*w, command[2]],
                "down": down,
                "offset": data.qpos[self.at] - self.stand,
                "speed": data.qvel[self.moving],
                "action": action,
            }
            observation = np.concatenate([Walk.SEEN[name] * np.asarray(x) for name, x in seen.items()])
            with torch.no_grad():
                action = (UNIT * policy(torch.from_numpy(observation).float())).clamp(-1, 1).numpy()
            target = self.stand + self.full * action
            for _ in range(round(PERIOD / STEP)):
                torque = self.kp * (target - data.qpos[self.at])
                data.qfrc_applied[self.moving] = np.clip(torque, -self.limit, self.limit)
                mujoco.mj_step(model, data)
            up = up and bool(down[2] < -0.6) and data.qpos[2] > self.lowest * self.height
            mean += (k >= start) / (end - start) * np.array([v[0], v[1], w[2]])
        return Run(up, mean)


def policy_of(path: Path) -> nn.Module:
    """Policy that `21_walk_ppo.py` saved."""
    weights = torch.load(path, weights_only=True)
    widths = [weights["0.weight"].shape[1], *[len(weights[f"{k}.weight"]) for k in (0, 2, 4)]]
    layers = [layer for pair in pairwise(widths) for layer in (nn.Linear(*pair), nn.ELU())]
    policy = nn.Sequential(*layers[:-1])
    policy.load_state_dict(weights)
    return policy


@dataclass
class Args:
    policy: tyro.conf.Positional[Path] = Path("out/walk.pt")
    """File of `21_walk_ppo.py`."""
    urdf: Path | None = None
    """File of the robot; without one, Go2."""
    stand: tuple[str, ...] = ()
    """Positions of joints at the stand [rad], as `21_walk_ppo.py` had them."""
    feet: str = "*_foot"
    """Names of the feet."""
    speeds: tuple[float, ...] = (0.5, 0.75, 1.0)
    """Commanded velocities [m/s]."""
    turning: float = 0.0
    """Commanded yaw rate [rad/s]."""


def main(args: Args) -> bool:
    """Whether every run stayed up."""
    torch.set_num_threads(1)
    policy, urdf = policy_of(args.policy), go2.urdf() if args.urdf is None else args.urdf.read_text()
    stand = {"stand": {name: float(x) for name, x in (pair.split("=") for pair in args.stand)}} if args.stand else {}
    task = Walk(feet=args.feet, **stand)
    print("friction, cones, command [m/s]: runs that stay up, largest errors of speed [m/s] and yaw rate [rad/s]")
    all_up = True
    for friction in (0.8, 0.4):
        for elliptic in (False, True):
            player = Player(urdf, task, friction, elliptic)
            for speed in args.speeds:
                command = (speed, 0.0, args.turning)
                runs = [player.run(policy, command, seed) for seed in range(4)]
                error, up = np.max([abs(run.velocity - command) for run in runs], 0), sum(run.up for run in runs)
                cones = "elliptic" if elliptic else "pyramidal"
                print(f"{friction}, {cones}, {speed}: {up} of 4, {error[0]:.3f}, {error[2]:.3f}", flush=True)
                all_up = all_up and up == 4
    return all_up


if __name__ == "__main__":
    sys.exit(0 if main(tyro.cli(Args)) else 1)
