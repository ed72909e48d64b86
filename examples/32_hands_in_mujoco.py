"""A policy that pushes, lifts or picks, in another engine.

    python examples/32_hands_in_mujoco.py pick [--runs 64] [--policy out/pick.pt]

The policy of `31_hands_ppo.py` acts on the same arm and cube in MuJoCo, whose contacts follow another law, with elliptic
cones of friction, with pyramids as by default, and with elliptic cones whose friction is ten times stiffer. It prints the
share that succeeds at the end of an episode, from the same starts in both engines.
"""

import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

import mujoco
import numpy as np
import torch
import tyro
from torch import Tensor, nn

from torchdq import Robot, dq, effects
from torchdq.envs.manipulation import Manipulation
from torchdq.envs.task_names import task_of
from torchdq.robot.contact_points import points_of

hands = import_module("31_hands_ppo")
STEP = 0.002  # [s]
CONES = {"elliptic": ("elliptic", 10), "pyramidal": ("pyramidal", 1), "stiffer": ("elliptic", 100)}  # and impratio


@dataclass
class Args:
    task: Annotated[Literal["push", "lift", "pick"], tyro.conf.Positional] = "pick"
    """Task of the policy."""
    policy: Path | None = None
    """File of the policy; None: `out/TASK.pt`."""
    runs: int = 64
    """Number of starts."""


def pose(X: Tensor) -> str:
    """Attributes of a pose."""
    numbers = (" ".join(f"{x:.12g}" for x in row.tolist()) for row in (dq.translation(X), dq.rotation(X)))
    return 'pos="{}" quat="{}"'.format(*numbers)


def model_of(task: Manipulation, robot: Robot, cone: str, impratio: float) -> mujoco.MjModel:
    """Robot with a fixed base, spheres on its fingers, and a box as object, on a plane."""
    chosen = {type(effect): effect for effect in task.defaults(robot)["effects"]}
    joints = robot.joint_names if robot.joint_map is None else robot.joint_map.joint_names
    points = points_of(robot, task.pads)

    def body(i: int) -> str:
        screw, mass = robot.screw[i].tolist(), float(robot.mass[i])
        kind, axis = ("hinge", screw[:3]) if robot.kinds[i] == "revolute" else ("slide", screw[3:])
        place, inertia = (" ".join(f"{x:.12g}" for x in row.tolist()) for row in (robot.com[i], inertias[i]))
        inside = f'<joint name="{joints[i]}" type="{kind}" axis="{axis[0]} {axis[1]} {axis[2]}"/>'
        inside += f'<inertial pos="{place}" mass="{mass}" fullinertia="{inertia}"/>'
        for point in points:
            if robot.frame(point.frame).link == i:
                center = dq.translation(dq.mul(robot.frame(point.frame).X_BF, at(point.center))).tolist()
                inside += '<geom type="sphere" size="{}" pos="{} {} {}" mass="0" '.format(point.radius, *center)
                inside += 'contype="1" conaffinity="2" friction="1 0.005 0.0001"/>'
        inside += "".join(body(k) for k, parent in enumerate(robot.parents) if parent == i)
        return f'<body name="{robot.link_names[i]}" {pose(robot.X_PB_home[i])}>{inside}</body>'

    inertias = robot.inertia[:, [0, 2, 5, 1, 3, 4]]
    half, servo = 0.5 * torch.tensor(task.object.size), chosen[effects.Servo].resolved(robot)
    cube = float(task.object.mass)
    motors, tendons, ends = "", "", ""
    for i, name in enumerate(robot.joint_names):
        followers = (
            [joints[i]]
            if robot.joint_map is None
            else [joint for joint, row in zip(joints, robot.joint_map.S, strict=True) if row[i] != 0]
        )
        k, limit = len(followers), servo.limit[i]
        kp, kd, most = servo.kp[i] / k**2, servo.kd[i] / k**2, limit / k
        where = f'joint="{followers[0]}"'
        if k > 1:  # a tendon along all of them: its length is their sum, and its force acts on each
            tendons += (
                f'<fixed name="{name}">{"".join(f"""<joint joint="{x}" coef="1"/>""" for x in followers)}</fixed>'
            )
            ends += "".join(f'<joint joint1="{followers[0]}" joint2="{x}"/>' for x in followers[1:])
            where = f'tendon="{name}"'
        motors += f'<position {where} kp="{kp}" kv="{kd}" forcerange="-{most} {most}"/>'
    roots = "".join(body(k) for k, parent in enumerate(robot.parents) if parent < 0)
    text = f"""<mujoco><compiler angle="radian"/>
      <option integrator="implicitfast" timestep="{STEP}" cone="{cone}" impratio="{impratio}"/>
      <worldbody><geom type="plane" size="2 2 0.1" contype="2" conaffinity="3" friction="0.5 0.005 0.0001"/>{roots}
        <body name="object"><freejoint/><geom type="box" size="{half[0]} {half[1]} {half[2]}" mass="{cube}"
          contype="2" conaffinity="1" friction="0.5 0.005 0.0001"/></body></worldbody>
      <tendon>{tendons}</tendon><equality>{ends}</equality><actuator>{motors}</actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    for i, name in enumerate(robot.joint_names):
        followers = (
            [joints[i]]
            if robot.joint_map is None
            else [joint for joint, row in zip(joints, robot.joint_map.S, strict=True) if row[i] != 0]
        )
        for joint in followers:
            dof = int(model.joint(joint).dofadr[0])
            model.dof_armature[dof] = float(robot.armature[i]) / len(followers)
            model.dof_damping[dof] = float(robot.damping[i]) / len(followers)
    return model


def at(center: tuple[float, float, float]) -> Tensor:
    """Pose of a point."""
    return dq.from_pose(torch.tensor([1.0, 0.0, 0.0, 0.0]).double(), torch.tensor(center).double())


class Player:
    """Arm, object and policy in MuJoCo.

    Args:
        task: the task.
        robot: the robot.
        cone: how friction is limited, one of `CONES`.
    """

    def __init__(self, task: Manipulation, robot: Robot, cone: str = "elliptic") -> None:
        self.task, self.robot, self.model = task, robot, model_of(task, robot, *CONES[cone])
        known, driven = self.model.joint, robot.joint_map
        names = robot.joint_names if driven is None else driven.joint_names
        self.at = [int(known(name).qposadr[0]) for name in names]
        rows = [[k for k, row in enumerate(driven.S) if row[i] != 0] for i in range(robot.n)] if driven else None
        self.first = [row[0] for row in rows] if rows else [*range(robot.n)]  # joint of every coordinate
        self.sizes = np.array([len(row) for row in rows] if rows else [1] * robot.n)
        self.coordinate = (
            [next(i for i, row in enumerate(rows) if k in row) for k in range(len(names))] if rows else self.first
        )
        self.parts = [*dict.fromkeys(robot.link_names[robot.frame(p.frame).link] for p in points_of(robot, task.pads))]
        self.scale = np.array(task.defaults(robot)["scale"])

    def fingers(self, data: mujoco.MjData) -> list[float]:
        """1 for every finger that presses on the object, otherwise 0."""
        force, found, cube = np.zeros(6), dict.fromkeys(self.parts, 0.0), self.model.body("object").id
        for k in range(data.ncon):
            bodies = [int(self.model.geom_bodyid[g]) for g in data.contact[k].geom]
            if cube in bodies:
                other = self.model.body(bodies[1 - bodies.index(cube)]).name
                mujoco.mj_contactForce(self.model, data, k, force)
                if other in found:
                    found[other] += force[0]
        return [float(x >= 0.5) for x in found.values()]

    def run(self, policy: nn.Module, q: Tensor, X_WO: Tensor, goal: Tensor) -> bool:
        """Whether an episode from a start ends in success."""
        task, robot, model, data = self.task, self.robot, self.model, mujoco.MjData(self.model)
        data.qpos[self.at] = q.double().numpy()[self.coordinate]
        free = int(model.body("object").jntadr[0])
        place, speed = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])
        data.qpos[place : place + 7] = torch.cat([dq.translation(X_WO), dq.rotation(X_WO)])
        mujoco.mj_forward(model, data)
        target, success = tuple(goal.tolist()), 0.0
        grip = task._fingers(robot)
        for _ in range(hands.STEPS):
            own = [data.qpos[self.at][k] for k in self.first]
            moving = [data.qvel[self.at][k] for k in self.first]
            r = tuple(data.qpos[place + 3 : place + 7].tolist())
            X = at(tuple(data.qpos[place : place + 3].tolist()))
            X = dq.mul(X, torch.tensor([*r, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
            X_O = tuple(X[:4].tolist()), tuple(X[4:].tolist())
            R = dq.to_rotation_matrix(torch.tensor(r, dtype=torch.float64)).numpy()
            V = [*data.qvel[speed + 3 : speed + 6], *(R.T @ data.qvel[speed : speed + 3])]
            fingers = self.fingers(data)
            seen = task.observed(robot, [*map(float, own)], [*map(float, moving)], X_O, V, target, fingers)
            with torch.no_grad():
                action = policy(torch.tensor(seen, dtype=torch.float32)).clamp(-1, 1).double().numpy()
            half = 0.5 * task._open(robot)
            reference = np.array([half if i in grip else x for i, x in enumerate(own)])
            data.ctrl[:] = self.sizes * (reference + self.scale * action)
            for _ in range(round(0.05 / STEP)):
                mujoco.mj_step(model, data)
        own = [float(data.qpos[self.at][k]) for k in self.first]
        moving = [float(data.qvel[self.at][k]) for k in self.first]
        X = at(tuple(data.qpos[place : place + 3].tolist()))
        X_O = tuple(X[:4].tolist()), tuple(X[4:].tolist())
        _, success = task.judged(robot, own, moving, X_O, target, self.fingers(data))
        return bool(success > 0)


def main(args: Args, robot: Robot | None = None) -> dict[str, float]:
    """Shares of starts that succeed: here, and with every cone of friction there."""
    task = task_of(args.task)
    test = hands.Test(task, robot)
    envs = test.envs
    policy = nn.Sequential(
        *hands.ppo.network(envs.single_observation_space.shape[0], envs.single_action_space.shape[0], 0.1, nn.ELU())
    )
    policy.load_state_dict(torch.load(args.policy or Path("out") / f"{args.task}.pt"))
    shares = {"here": test(policy)[0]}
    envs.reset(seed=2_000_000_000)
    state, goals = envs.state, envs.get_state()["goal"]
    for cone in CONES:
        player = Player(task, envs.robot, cone)
        runs = [player.run(policy, state.q[i], state.X_WO[i, 0].double(), goals[i]) for i in range(args.runs)]
        shares[cone] = sum(runs) / len(runs)
        print(f"{cone}: {shares[cone]:.0%} of {args.runs} succeed in MuJoCo, {shares['here']:.0%} here", flush=True)
    return shares


if __name__ == "__main__":
    sys.exit(min(main(tyro.cli(Args)).values()) < 0.5)
