"""A policy that learned to walk here walks in MuJoCo: the same file, servos and feet, another simulator.

    python examples/23_policy_in_mujoco.py [out/walk.pt] [--turning 0.5] [--robot FILE]

Nothing of this package simulates or observes: MuJoCo reads the file, the observation is built from MuJoCo's state,
torques are cut at the limits of the file, the step is 2 ms. The mass matrix must be that of the robot that learned.
Each line has four runs of 10 s from different starts.
"""

import sys
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor, nn

from torchdq import Robot, effects, floating
from torchdq.envs.walk import Walk
from torchdq.robot.shipped import go2

ppo = import_module("21_walk_ppo")
STEP, PERIOD = 0.002, 0.02  # of MuJoCo, and between actions [s]
UNIT = ppo.UNIT  # output of the policy as an action


class Run(NamedTuple):
    """One run: whether the robot stayed up, and its mean velocity after 2 s (forward, sideways, yaw rate)."""

    up: bool
    velocity: NDArray


def read(file: str, robot: Robot) -> mujoco.MjSpec:
    """Description of a robot whose other joints are locked, of its file or of "go2".

    Of an MJCF file without actuators. Of a URDF file without meshes, and links on fixed joints are added to those that
    carry them, as readers of URDF do. Left alone, MuJoCo gives a link without `<inertial>` the mass of its geoms, and
    refuses one whose inertia no rigid body can have, such as a placeholder, although the sum is sound.
    """
    if file.endswith(".xml"):
        spec = mujoco.MjSpec.from_file(file)
        for part in (*spec.sensors, *spec.keys, *spec.actuators, *locked(spec, robot)):
            spec.delete(part)
        return spec
    urdf = go2.urdf() if file == "go2" else Path(file).read_text()
    compiler = '<mujoco><compiler fusestatic="false" discardvisual="true" strippath="true"/></mujoco></robot>'
    spec = mujoco.MjSpec.from_string(urdf.replace("</robot>", compiler))
    meshes = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]
    for part in (*meshes, *spec.meshes, *locked(spec, robot)):
        spec.delete(part)
    for geom in spec.geoms:
        geom.mass = 0.0
    for body in reversed(spec.bodies[1:]):  # children before their parents
        parts = [(body, np.zeros(3), np.eye(3))]
        parts += [(child, child.pos, rotation(child.quat)) for child in body.bodies if not child.joints]
        parts = [(part, p, R) for part, p, R in parts if part.mass > 0]
        if parts:
            masses, centers = [part.mass for part, _, _ in parts], [p + R @ part.ipos for part, p, R in parts]
            center = np.average(centers, 0, masses)
            total = sum(inertia(*part, center) for part in parts)
            for part, _, _ in parts:
                part.mass, part.explicitinertial, part.fullinertia[0] = 0.0, False, np.nan
            body.mass, body.explicitinertial, body.ipos, body.iquat = sum(masses), True, center, [1, 0, 0, 0]
            body.fullinertia = total[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return spec


def locked(spec: mujoco.MjSpec, robot: Robot) -> list[mujoco.MjsJoint]:
    """Joints that the robot does not have."""
    own = robot.joint_names if robot.joint_map is None else robot.joint_map.joint_names
    known = (*own, *(joint.name for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE))
    return [joint for joint in spec.joints if joint.name not in known]


def rotation(quat: NDArray) -> NDArray:
    """Matrix of a quaternion."""
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, quat)
    return R.reshape(3, 3)


def inertia(body: mujoco.MjsBody, p: NDArray, R: NDArray, center: NDArray) -> NDArray:
    """Rotational inertia of a body at a place, about a point."""
    xx, yy, zz, xy, xz, yz = body.fullinertia
    turned, d = R @ rotation(body.iquat), p + R @ body.ipos - center
    own = turned @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turned.T
    return own + body.mass * (d @ d * np.eye(3) - np.outer(d, d))


def require_the_same(model: mujoco.MjModel, data: mujoco.MjData, S: NDArray, expected: Tensor) -> None:
    """Raise unless the mass matrix of velocities S v is expected: masses, centres of mass and inertias are the same."""
    M = np.empty((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, M)
    error = np.abs(S.T @ M @ S - expected.numpy()).max() / expected.abs().max()
    if error > 1e-6:
        raise ValueError(f"MuJoCo reads another robot: its mass matrix differs by {error:.2g} of the largest entry")


class Player:
    """A robot with feet in MuJoCo, on a plane, which only the feet touch.

    Args:
        walker: the robot's file, and its stand and feet.
        friction: of the ground.
        elliptic: whether cones of friction are elliptic, as in nature, or pyramids, as MuJoCo has them by default.
    """

    def __init__(self, walker: ppo.Walker, friction: float = 0.8, elliptic: bool = False) -> None:
        robot, task = walker.load(), walker.task()
        task = task.described(robot)
        chosen = task.defaults(robot)
        parts, self.full = {type(effect): effect for effect in chosen["effects"]}, chosen["scale"]
        spec = read(walker.robot, robot)
        if not any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.worldbody.first_body().joints):
            spec.worldbody.first_body().add_freejoint()
        feet = {point.frame for point in task.feet}
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = int(geom.parent.name in feet and bool(geom.contype or geom.conaffinity))
            geom.friction[0] = friction
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], friction=[friction, 0.005, 1e-4])
        self.model = model = spec.compile()
        model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if elliptic else mujoco.mjtCone.mjCONE_PYRAMIDAL
        joints, servo = [model.joint(name) for name in robot.joint_names], parts[effects.Servo]
        self.at, self.moving = [int(x.qposadr[0]) for x in joints], [int(x.dofadr[0]) for x in joints]
        self.stand, self.lowest = np.array(task.joints(robot)), task.lowest
        self.height = float(task.height(robot, task.joints(robot)))
        self.require_the_same(robot)
        self.kp, self.limit = servo.kp, np.array(servo.limit)
        model.dof_damping[self.moving] = servo.kd
        rotors = parts[effects.RotorInertia].inertia
        model.dof_armature[self.moving] = robot.armature if rotors is None else rotors

    def require_the_same(self, robot: Robot) -> None:
        """Raise unless MuJoCo has the mass matrix of the robot."""
        data = mujoco.MjData(self.model)
        data.qpos[3], data.qpos[self.at] = 1.0, self.stand
        S = np.eye(self.model.nv)[:, [3, 4, 5, 0, 1, 2, *self.moving]]
        expected = floating.mass_matrix(robot, torch.eye(8)[0].double(), torch.tensor(self.stand)).M
        require_the_same(self.model, data, S, expected)

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
class Args(ppo.Walker):
    policy: tyro.conf.Positional[Path] = Path("out/walk.pt")
    """File of `21_walk_ppo.py`."""
    speeds: tuple[float, ...] = (0.5, 0.75, 1.0)
    """Commanded velocities [m/s]."""
    turning: float = 0.0
    """Commanded yaw rate [rad/s]."""


def main(args: Args) -> bool:
    """Whether every run stayed up."""
    torch.set_num_threads(1)
    policy = policy_of(args.policy)
    print("friction, cones, command [m/s]: runs that stay up, largest errors of speed [m/s] and yaw rate [rad/s]")
    all_up = True
    for friction in (0.8, 0.4):
        for elliptic in (False, True):
            player = Player(args, friction, elliptic)
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
