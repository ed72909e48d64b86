"""A policy that pushes, lifts or picks, in another engine.

    python examples/32_hands_in_mujoco.py pick [--runs 64] [--policy out/pick.pt] [--model FILE]

The policy of `31_hands_ppo.py` acts on the same arm and cube in MuJoCo, whose contacts follow another law: with
elliptic cones of friction, with pyramids as by default, and with elliptic cones whose friction is ten times stiffer. It
prints the share that succeeds at the end of an episode, from the same starts in both engines. The fingers have the
spheres that they have here, or with `--model` the shapes of a file of the same arm, as its author drew them.
"""

import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro
from torch import Tensor, nn

import torchdq
from torchdq import Robot, dq, effects
from torchdq.envs import RobotVectorEnv
from torchdq.envs.manipulation import PADS, PERIOD, PRESSING, TABLE, Manipulation
from torchdq.objects import Ball, Box, Object
from torchdq.robot.contact_points import points_of

walk, hands = import_module("23_policy_in_mujoco"), import_module("31_hands_ppo")
STEP, ARM = 0.002, "arm/"  # [s], and what names of the arm begin with in the scene
CONES = {"elliptic": ("elliptic", 10), "pyramidal": ("pyramidal", 1), "stiffer": ("elliptic", 100)}  # and impratio


@dataclass
class Args(hands.Args):
    policy: Path | None = None
    """File of the policy; None: `out/TASK.pt`."""
    runs: int = 64
    """Number of starts."""
    model: Path | None = None
    """MJCF or URDF file of the same arm, whose shapes, other than meshes, touch cube and table; None: the spheres."""


def at(position: list[float], rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)) -> Tensor:
    """Pose of a position and a quaternion."""
    return dq.from_pose(torch.tensor(rotation, dtype=torch.float64), torch.tensor(position, dtype=torch.float64))


def text(*rows: Tensor) -> list[str]:
    """Numbers as MJCF has them."""
    return [" ".join(f"{x:.12g}" for x in row.tolist()) for row in rows]


def geom(body: Object) -> tuple[str, str]:
    """Type and size of an object as MJCF has them."""
    match body:
        case Box():
            kind, size = "box", [0.5 * x for x in body.size]
        case Ball():
            kind, size = "sphere", [body.radius]
        case _:
            kind, size = type(body).__name__.lower(), [body.radius, 0.5 * body.length]
    return kind, text(torch.tensor(size, dtype=torch.float64))[0]


def read(file: Path, robot: Robot) -> mujoco.MjSpec:
    """Description of an arm, without meshes, and with neither motors nor couplings."""
    spec = walk.read(str(file), robot)
    meshes = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]
    for part in (*meshes, *spec.meshes, *spec.tendons, *spec.equalities):
        spec.delete(part)
    return spec


class Hand:
    """Arm with a gripper on a fixed base, an object and a plane in MuJoCo.

    Args:
        task: the task.
        robot: the robot.
        cone: how friction is limited, one of `CONES`.
        file: description of the same robot, with shapes on its fingers; None: the spheres of their pads.
    """

    def __init__(self, task: Manipulation, robot: Robot, cone: str = "elliptic", file: Path | None = None) -> None:
        self.task, self.robot = task, robot
        self.parts = {type(effect): effect for effect in task.defaults(robot)["effects"]}
        self.joints, S = robot.joint_names, torch.eye(robot.n, dtype=torch.float64)
        if robot.joint_map is not None:
            self.joints, S = robot.joint_map.joint_names, robot.joint_map.S
        # joints that each coordinate moves, all by the same amount
        self.moved = [row.nonzero()[:, 0].tolist() for row in S.T]
        scene = mujoco.MjSpec.from_string(self.scene(*CONES[cone]))
        arm = mujoco.MjSpec.from_string(self.arm()) if file is None else read(file, robot)
        for shape in arm.geoms:
            touches = shape.parent.name != "world" and bool(shape.contype or shape.conaffinity)
            kind = shape.contype if file is None else int(touches)
            shape.contype, shape.conaffinity, shape.friction[0] = kind, 2 * (kind == 1), PADS
        scene.attach(arm, frame=scene.worldbody.add_frame(), prefix=ARM)
        self.model = model = scene.compile()
        known, cube = [model.joint(ARM + name) for name in self.joints], model.joint("object")
        self.at = np.array([int(joint.qposadr[0]) for joint in known])
        self.dof = np.array([int(joint.dofadr[0]) for joint in known])
        self.place, self.speed, self.cube = int(cube.qposadr[0]), int(cube.dofadr[0]), int(cube.bodyid[0])
        self.bodies = model.body_weldid[model.geom_bodyid]  # that move each shape
        links = [robot.frame(point.frame).link for point in points_of(robot, task.pads)]
        self.pads = [int(known[i].bodyid[0]) for i in dict.fromkeys(links)]  # bodies that press
        rotors = self.parts[effects.RotorInertia].inertia
        armature = robot.armature if rotors is None else torch.full((robot.n,), rotors, dtype=torch.float64)
        damping = torch.zeros(robot.n) if robot.damping is None else robot.damping
        for i, own in enumerate(self.moved):
            model.dof_armature[self.dof[own]] = float(armature[i]) / len(own)
            model.dof_damping[self.dof[own]] = float(damping[i]) / len(own)
        self.require_the_same(armature, S)
        self.scale = np.array(task.defaults(robot)["scale"])

    def require_the_same(self, armature: Tensor, S: Tensor) -> None:
        """Raise unless MuJoCo has the masses of the robot, and shapes on its fingers."""
        data, home = mujoco.MjData(self.model), torch.tensor(self.task.home, dtype=torch.float64)
        data.qpos[self.at] = S @ home
        expected = torchdq.mass_matrix(self.robot.replace(armature=armature), home)
        walk.require_the_same(self.model, data, np.eye(self.model.nv)[:, self.dof] @ S.numpy(), expected)
        shaped = self.bodies[self.model.geom_contype > 0]
        if bare := [self.model.body(i).name for i in self.pads if i not in shaped]:
            raise ValueError(f"fingers {', '.join(bare)} need boxes or other shapes that are no meshes")

    def arm(self) -> str:
        """The arm as text, with a sphere for every point of its pads; contype 4: it does not touch the table."""
        robot, low = self.robot, self.task.lowest(self.robot)
        points = points_of(robot, self.task.pads)

        def body(i: int) -> str:
            screw, turns = robot.screw[i], robot.kinds[i] == "revolute"
            place, turn, com, inertia, axis = text(
                dq.translation(robot.X_PB_home[i]),
                dq.rotation(robot.X_PB_home[i]),
                robot.com[i],
                robot.inertia[i, [0, 2, 5, 1, 3, 4]],
                screw[:3] if turns else screw[3:],
            )
            inside = f'<joint name="{self.joints[i]}" type="{"hinge" if turns else "slide"}" axis="{axis}"/>'
            inside += f'<inertial pos="{com}" mass="{float(robot.mass[i])}" fullinertia="{inertia}"/>'
            for point in points:
                if robot.frame(point.frame).link == i:
                    (center,) = text(dq.translation(dq.mul(robot.frame(point.frame).X_BF, at(point.center))))
                    kind = 1 if point in low else 4
                    inside += f'<geom size="{point.radius}" pos="{center}" contype="{kind}"/>'
            inside += "".join(body(k) for k, parent in enumerate(robot.parents) if parent == i)
            return f'<body name="{robot.link_names[i]}" pos="{place}" quat="{turn}">{inside}</body>'

        roots = "".join(body(k) for k, parent in enumerate(robot.parents) if parent < 0)
        return f'<mujoco><compiler angle="radian"/><worldbody>{roots}</worldbody></mujoco>'

    def scene(self, cone: str, impratio: float) -> str:
        """Table, object and servos; fingers that move together pull on one tendon, as those of a real gripper."""
        motors, tendons, ends = "", "", ""
        robot, servo = self.robot, self.parts[effects.Servo].resolved(self.robot)
        for i, own in enumerate(self.moved):
            k, name, names = len(own), robot.joint_names[i], [ARM + self.joints[j] for j in own]
            where = f'joint="{names[0]}"'
            if k > 1:
                parts = "".join(f'<joint joint="{x}" coef="1"/>' for x in names)
                tendons += f'<fixed name="{name}">{parts}</fixed>'
                ends += "".join(f'<joint joint1="{names[0]}" joint2="{x}"/>' for x in names[1:])
                where = f'tendon="{name}"'
            kp, kd, most = servo.kp[i] / k**2, servo.kd[i] / k**2, servo.limit[i] / k
            motors += f'<position {where} kp="{kp}" kv="{kd}" forcerange="-{most} {most}"/>'
        kind, size = geom(self.task.object)
        sliding = f'friction="{TABLE} 0.005 0.0001"'
        return f"""<mujoco><compiler angle="radian"/>
          <option integrator="implicitfast" timestep="{STEP}" cone="{cone}" impratio="{impratio}"/>
          <worldbody><geom type="plane" size="2 2 0.1" contype="2" conaffinity="3" priority="1" {sliding}/>
            <body name="object"><freejoint name="object"/><geom type="{kind}" size="{size}"
              mass="{self.task.object.mass}" contype="2" conaffinity="5" {sliding}/></body></worldbody>
          <tendon>{tendons}</tendon><equality>{ends}</equality><actuator>{motors}</actuator></mujoco>"""

    def state(self, data: mujoco.MjData) -> tuple[list[float], ...]:
        """Positions and velocities of the coordinates, pose and twist of the object, and which fingers press on it."""
        first = [own[0] for own in self.moved]
        p, r = np.split(data.qpos[self.place : self.place + 7], [3])
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, r)
        v, w = np.split(data.qvel[self.speed : self.speed + 6], 2)
        twist = [*w, *(R.reshape(3, 3).T @ v)]
        return (
            [*data.qpos[self.at[first]]],
            [*data.qvel[self.dof[first]]],
            at(p.tolist(), tuple(r)).tolist(),
            twist,
            self.fingers(data),
        )

    def fingers(self, data: mujoco.MjData) -> list[float]:
        """1 for every finger that presses on the object, otherwise 0."""
        force, found = np.zeros(6), dict.fromkeys(self.pads, 0.0)
        for k in range(data.ncon):
            bodies = self.bodies[data.contact[k].geom]
            if self.cube in bodies:
                mujoco.mj_contactForce(self.model, data, k, force)
                other = int(bodies.sum()) - self.cube
                found |= {other: found[other] + force[0]} if other in found else {}
        return [float(x >= PRESSING) for x in found.values()]

    @torch.no_grad()
    def run(self, policy: nn.Module, q: Tensor, X_WO: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Whether episodes end in success [N], and poses of the object [steps + 1, N, 8].

        Starts are q [N, n], poses of the object [N, 8] and goals [N, 3].
        """
        runs, seen = [mujoco.MjData(self.model) for _ in q], self.task.reader(self.robot)
        for data, start, X in zip(runs, q.tolist(), X_WO, strict=True):
            for x, own in zip(start, self.moved, strict=True):
                data.qpos[self.at[own]] = x
            data.qpos[self.place : self.place + 7] = torch.cat([dq.translation(X), dq.rotation(X)])
            mujoco.mj_forward(self.model, data)
        success, poses = torch.zeros(len(q), dtype=torch.bool), []
        for k in range(hands.STEPS + 1):
            states = [torch.tensor(rows) for rows in zip(*map(self.state, runs), strict=True)]
            poses.append(states[2])
            observation, success, target = seen(*[x.float() for x in (*states, goal)])
            action = policy(observation).clamp(-1, 1).double().numpy()
            for data, x in zip(runs, target.double().numpy() + self.scale * action, strict=True):
                data.ctrl[:] = [len(own) * y for own, y in zip(self.moved, x, strict=True)]
                mujoco.mj_step(self.model, data, round(PERIOD / STEP) * (k < hands.STEPS))
        return success, torch.stack(poses)


def policy_of(path: Path, envs: RobotVectorEnv) -> nn.Module:
    """Policy that `31_hands_ppo.py` saved."""
    spaces = envs.single_observation_space, envs.single_action_space
    policy = hands.ppo.network(*(space.shape[0] for space in spaces), 0.1, nn.ELU())
    policy.load_state_dict(torch.load(path))
    return policy


def main(args: Args) -> dict[str, float]:
    """Shares of starts that succeed: here, and with every cone of friction there."""
    task = args.of_task()
    test = hands.Test(task, args.load())
    envs = test.envs
    policy = policy_of(args.policy or Path("out") / f"{args.task}.pt", envs)
    shares = {"here": test(policy)[0]}
    envs.reset(seed=2_000_000_000)
    state, goals = envs.state, envs.get_state()["goal"]
    for cone in CONES:
        hand = Hand(task, envs.robot, cone, args.model)
        found, _ = hand.run(policy, *(x[: args.runs] for x in (state.q, state.X_WO[:, 0], goals)))
        shares[cone] = float(found.float().mean())
        print(f"{cone}: {shares[cone]:.0%} of {args.runs} succeed in MuJoCo, {shares['here']:.0%} here", flush=True)
    return shares


if __name__ == "__main__":
    sys.exit(min(main(tyro.cli(Args)).values()) < 0.5)
