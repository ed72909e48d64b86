"""A policy that learned to walk here walks in MuJoCo: the same URDF and servos, spheres as feet, another simulator.

    python examples/23_policy_in_mujoco.py [out/walk.pt] [--turning 0.5] [--urdf FILE]

Nothing of this package simulates or observes: the observation is built from MuJoCo's state, torques are cut at the limits
of the file, the step is 2 ms. Each line has four runs of 10 s from different starts.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import nn

from torchdq import Robot
from torchdq.envs.walk import FULL, SEEN, Walk
from torchdq.robot.shipped import go2

STEP, PERIOD = 0.002, 0.02  # of MuJoCo, and between actions [s]


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
        elliptic: whether friction cones are elliptic, as real ones are, or pyramidal, as by default.
    """

    def __init__(self, urdf: str, task: Walk, friction: float = 0.8, elliptic: bool = False) -> None:
        robot = Robot.from_urdf(urdf, base="floating")
        servo = next(effect for effect in task.defaults(robot)["effects"] if type(effect).__name__ == "Servo")
        compiler = '<mujoco><compiler fusestatic="false" discardvisual="true" strippath="true"/></mujoco></robot>'
        spec = mujoco.MjSpec.from_string(urdf.replace("</robot>", compiler))
        spec.worldbody.first_body().add_freejoint()
        ground = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
        for geom in spec.geoms:
            geom.friction[0] = friction
            geom.contype = geom.conaffinity = int(geom.type == mujoco.mjtGeom.mjGEOM_SPHERE)
        ground.contype = ground.conaffinity = 1
        self.model = model = spec.compile()
        model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if elliptic else mujoco.mjtCone.mjCONE_PYRAMIDAL
        joints = [model.joint(name) for name in robot.joint_names]
        self.at, self.moving = ([int(x[0]) for x in row] for row in zip(*[(j.qposadr, j.dofadr) for j in joints], strict=True))
        self.kp, self.limit = servo.kp, robot.limits.effort.numpy()
        model.dof_damping[self.moving] = servo.kd
        model.dof_armature[self.moving] = 0.01
        self.stand = np.array(task.joints(robot))
        self.height = task.start_height(robot)
        self.lowest = task.lowest * self.height

    def run(self, policy: nn.Module, command: tuple[float, float, float], seed: int = 0, seconds: float = 10.0) -> Run:
        """Run of a policy from a start near the stand."""
        model, data = self.model, mujoco.MjData(self.model)
        data.qpos[:7] = [0, 0, self.height, 1, 0, 0, 0]
        data.qpos[self.at] = self.stand + 0.1 * np.random.default_rng(seed).uniform(-1, 1, len(self.stand))
        action, up, total, steps = np.zeros(len(self.stand)), True, np.zeros(3), round(seconds / PERIOD)
        for k in range(steps):
            R = np.empty(9)
            mujoco.mju_quat2Mat(R, data.qpos[3:7])
            v, w, down = R.reshape(3, 3).T @ data.qvel[:3], data.qvel[3:6], -R[6:]
            seen = [SEEN["v"] * v, SEEN["w"] * w, down, [SEEN["v"] * command[0], SEEN["v"] * command[1]]]
            seen += [[SEEN["w"] * command[2]], data.qpos[self.at] - self.stand, SEEN["qd"] * data.qvel[self.moving]]
            observation = torch.from_numpy(np.concatenate([*seen, SEEN["action"] * action])).float()
            action = policy(observation).clamp(-6, 6).numpy() / 6
            target = self.stand + FULL * action
            for _ in range(round(PERIOD / STEP)):
                torque = self.kp * (target - data.qpos[self.at])
                data.qfrc_applied[self.moving] = np.clip(torque, -self.limit, self.limit)
                mujoco.mj_step(model, data)
            up = up and bool(-R[8] < -0.6) and data.qpos[2] > self.lowest
            if k >= round(2.0 / PERIOD):
                total += np.array([v[0], v[1], w[2]]) / (steps - round(2.0 / PERIOD))
        return Run(up, total)


@dataclass
class Args:
    policy: tyro.conf.Positional[Path] = Path("out/walk.pt")
    """File of `21_walk_ppo.py`."""
    urdf: Path | None = None
    """File of the robot; without one, Go2."""
    speeds: tuple[float, ...] = (0.5, 0.75, 1.0)
    """Commanded velocities [m/s]."""
    turning: float = 0.0
    """Commanded yaw rate [rad/s]."""


@torch.no_grad()
def main(args: Args) -> bool:
    """Whether every run stayed up."""
    torch.set_num_threads(1)
    weights = torch.load(args.policy, weights_only=True)
    sizes = [weights["0.weight"].shape[1], *[weights[f"{k}.weight"].shape[0] for k in (0, 2, 4)]]
    layers = [layer for a, b in zip(sizes, sizes[1:]) for layer in (nn.Linear(a, b), nn.ELU())]
    policy = nn.Sequential(*layers[:-1])
    policy.load_state_dict(weights)
    urdf = go2.urdf() if args.urdf is None else args.urdf.read_text()
    print("friction, cone, command [m/s]: runs that stay up, largest errors of forward velocity [m/s] and yaw rate [rad/s]")
    all_up = True
    for friction in (0.8, 0.4):
        for elliptic in (False, True):
            player = Player(urdf, Walk(), friction, elliptic)
            for speed in args.speeds:
                command = (speed, 0.0, args.turning)
                runs = [player.run(policy, command, seed) for seed in range(4)]
                error = np.max([abs(run.velocity - command) for run in runs], 0)
                up = sum(run.up for run in runs)
                cone = "elliptic" if elliptic else "pyramidal"
                print(f"{friction}, {cone}, {speed}: {up} of 4, {error[0]:.3f}, {error[2]:.3f}", flush=True)
                all_up = all_up and up == 4
    return all_up


if __name__ == "__main__":
    sys.exit(0 if main(tyro.cli(Args)) else 1)
