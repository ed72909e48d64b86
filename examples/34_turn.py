"""A hand with four fingers that turns a cube on its palm, learned on one thread, and in another engine.

    python examples/34_turn.py [--seconds 120] [--seed 0] [--policy FILE] [--hand FILE] [--out FOLDER]

The task is one of our own. It extends `Manipulation`, the tasks of an arm with a gripper, and is learned as those in
`31_hands_ppo.py`: until 98 % of 256 cubes turn by 90 degrees or more within 2.5 s, and none of these is lost on the
way, in three tests in a row. Its policy then acts in MuJoCo, as in `32_hands_in_mujoco.py`. `out/turn.pt` has it.

The hand is the Allegro hand of the package example-robot-data, its palm up in the plane z = 0, on which the cube lies.
"""

import math
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import files
from pathlib import Path
from typing import Any, ClassVar

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
import tyro
from torch import Tensor

from torchdq import Robot, dq
from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure, Quaternion
from torchdq.dynamics.posed import Row
from torchdq.envs.manipulation import Manipulation
from torchdq.envs.tasks import within
from torchdq.numbers.functions import at_least, clip, sqrt
from torchdq.objects import Box, Object
from torchdq.robot import ContactPoint
from torchdq.scene.spec import Rows, View

hands, play = import_module("31_hands_ppo"), import_module("32_hands_in_mujoco")
# palm up, fingers along x
MOUNT = """<link name="world"/><joint name="mount" type="fixed"><parent link="world"/><child link="palm_link"/>
<origin rpy="3.141592653589793 -1.5707963267948966 0" xyz="0 0 -0.0111"/></joint></robot>"""
# of the motors, of which the file has numbers that no hand has [kg m^2, N m, N m s/rad]
ROTOR, TORQUE, DAMPING = 1e-3, 0.7, 0.1
FINGER, THUMB = (0.0, 0.9, 1.1, 1.0), (0.83, 0.53, 0.73, 0.78)  # bent, above the cube [rad]
# of the links that touch the cube: the last ones, in frames of their tips, where the file has spheres, and the first
LAST = [ContactPoint(f"link_{k}.0_tip", (0.0, 0.0, -0.0134), 0.0098) for k in (3, 7, 11, 15)]
FIRST = [ContactPoint(f"link_{k}.0", (0.0, 0.0, 0.02), 0.0098) for k in (1, 5, 9)]
CUBE = Box("cube", 0.06, size=(0.05, 0.05, 0.05))
FULL = 0.6  # largest offset of a joint's target [rad]
PLACE, AROUND = (-0.035, 0.0), 0.008  # of the cube on the palm, and its largest deviation [m]
FAR, LEVEL = 0.04, 0.7  # distance at which a cube is lost [m], and cosine of its tilt
FASTEST, BACK = 4.0, 2.0  # rates of turning beyond which the reward does not change [rad/s]


@dataclass(frozen=True)
class Turn(Manipulation):
    """Turn a cube on the palm to the left by 90 degrees or more, and keep it there.

    Actions are offsets of the targets of all joints from `home`. Observation: positions of the joints from there,
    velocities, position of the cube from its place, its velocities, its yaw, of which quarters look the same, and tilt,
    and for every part of the fingers whether it presses. Reward of a cube that is held: 0.3 times the rate at which it
    turns, less 5 times its distance and 0.01 times the speed of the joints; of a lost one -2, and the episode ends.
    """

    TURNED: ClassVar[float] = math.pi / 2

    object: Object = CUBE
    home: tuple[float, ...] = (*FINGER, *THUMB, *FINGER, *FINGER)
    fingers: Any = ()
    pads: Any = ("*_tip", *LAST, *FIRST)
    gains: tuple[float, float] = (10.0, 1.0)

    def defaults(self, robot: Robot) -> Mapping[str, Any]:
        """Arguments of environments; targets stay within the limits of the joints."""
        bounds = zip(self.home, robot.limits.lower.tolist(), robot.limits.upper.tolist(), strict=True)
        return {**super().defaults(robot), "scale": [min(FULL, x - a, b - x) for x, a, b in bounds]}

    def inputs(self, n: int) -> dict[str, int]:
        """The place of the cube; the turn since the start of an episode, and the direction of its x axis."""
        return {"goal": 3, "carry": 3}

    def lowest(self, robot: Robot) -> tuple[ContactPoint, ...]:
        """Points that can touch the palm, which ends before the fingers."""
        return tuple(point for point in super().lowest(robot) if point not in FIRST)

    def place(self, robot: Robot, u: Row) -> tuple[Number, Number]:
        """Place of the cube at a start."""
        return PLACE[0] + AROUND * (2.0 * u[0] - 1.0), PLACE[1] + AROUND * (2.0 * u[1] - 1.0)

    def goal(self, robot: Robot, at: tuple[Number, Number], u: Row) -> list[Number]:
        """Where it should stay."""
        return [*PLACE, self.rest()]

    def bounds(self, robot: Robot) -> list[tuple[float, float]]:
        """Bounds of the observation."""
        return [(-10.0, 10.0)] * (2 * robot.n + 13 + len(self.parts(robot)))

    def reference(self, robot: Robot, q: Row) -> list[Number]:
        """Targets without an action."""
        return list(self.home)

    def rows(self, view: View) -> Rows:
        """Rows of a task with an object, and the turn."""
        rows, X_WO = super().rows(view), tuple(view.poses[:4])
        x, y = heading(X_WO)
        turned, a, b = view.inputs.get("carry", (0.0, x, y))
        sine = a * y - b * x  # of the turn in this step, which is hardly more
        held, turned = rows["success"][0], turned + sine
        rate = clip(sine * (1.0 / view.scene.spec.dt), -BACK, FASTEST)
        return {
            **rows,
            "reward": [held * (rows["reward"][0] + 0.3 * rate + 2.0) - 2.0],
            "success": [held * at_least(turned, math.pi / 2)],
            "terminated": [1.0 - held],
            "carry": [turned, x, y],
            "turned": [turned],
        }

    def observed(
        self, robot: Robot, q: Row, qd: Row, X_WO: DualQuaternion, V_WO: Row, goal: Pure, fingers: Row
    ) -> list[Number]:
        """Observation of a state."""
        w, v = quat.rotate(X_WO[0], tuple(V_WO[:3])), quat.rotate(X_WO[0], tuple(V_WO[3:]))
        up, yaw = quat.rotation_columns(X_WO[0])[2], heading(X_WO[0])
        for _ in range(2):  # twice the angle, twice
            yaw = (yaw[0] * yaw[0] - yaw[1] * yaw[1], 2.0 * yaw[0] * yaw[1])
        seen = [
            *[x - h for x, h in zip(q, self.home, strict=True)],
            *[0.1 * x for x in qd],
            *quat.scale(20.0, quat.sub(dual_quaternion.translation(X_WO), goal)),
            *quat.scale(2.0, v),
            *quat.scale(0.3, w),
            *(*yaw, *up[:2]),
            *fingers,
        ]
        return within(seen, self.bounds(robot))

    def judged(
        self, robot: Robot, q: Row, qd: Row, X_WO: DualQuaternion, goal: Pure, fingers: Row
    ) -> tuple[Number, Number]:
        """Reward without that of turning, and whether the cube is held."""
        way = quat.sub(dual_quaternion.translation(X_WO), goal)
        away, level = sqrt(quat.dot(way, way) + 1e-12), quat.rotation_columns(X_WO[0])[2][2]
        speed = sqrt(sum([x * x for x in qd], 1e-12))
        return -5.0 * away - 0.01 * speed, at_least(FAR, away) * at_least(level, LEVEL)


def heading(turn: Quaternion) -> tuple[Number, Number]:
    """Horizontal direction of the x axis of a cube, of the rotation of its pose."""
    x, y, _ = quat.rotation_columns(turn)[0]
    size = sqrt(x * x + y * y + 1e-12)
    return x / size, y / size


def load(path: Path | None = None) -> Robot:
    """The hand, with motors."""
    path = path or next(Path(x.locate()) for x in files("example-robot-data") if x.name == "allegro_right_hand.urdf")
    robot = Robot.from_urdf(path.read_text().replace("</robot>", MOUNT), tip="palm_link", on_unphysical="repair")
    one = torch.ones_like(robot.damping)
    limits = robot.limits._replace(effort=TORQUE * one)
    return robot.replace(armature=ROTOR * one, damping=DAMPING * one, friction=0 * one, limits=limits).bake()


@dataclass
class Args(hands.Learning):
    policy: Path | None = None
    """File of a policy, which is tested only; None: learn one."""
    hand: Path | None = None
    """URDF of the hand; None: that of the package example-robot-data."""
    runs: int = 64
    """Number of starts in MuJoCo."""


def in_mujoco(hand: Any, policy: torch.nn.Module, start: tuple[Tensor, ...]) -> tuple[float, float]:
    """Share of starts whose cube is held to the end, and median of the turn of these [rad]."""
    held, X_WO = hand.run(policy, *start)
    x, y = heading(dq.rotation(X_WO).unbind(-1))
    turned = (x[:-1] * y[1:] - y[:-1] * x[1:]).sum(0)
    return float(held.double().mean()), float(turned[held].median())


def main(args: Args) -> dict[str, float]:
    """Shares of cubes: turned here, and held with every cone of friction in MuJoCo."""
    torch.set_num_threads(1)
    task, robot = Turn(), load(args.hand)
    test = hands.Test(task, robot)
    if args.policy is None:
        policy, learned = hands.learn(task, robot, args)
        args.out.mkdir(parents=True, exist_ok=True)
        torch.save(policy.state_dict(), args.out / "turn.pt")
        print("not learned yet" if learned is None else f"learned after {learned:.0f} s")
    else:
        policy = play.policy_of(args.policy, test.envs)
    shares = {"here": test(policy)[0]}
    print(f"{shares['here']:.0%} of {hands.TESTED} cubes turn by 90 degrees or more in 2.5 s")
    test.envs.reset(seed=2_000_000_000)
    state, goals = test.envs.state, test.envs.get_state()["goal"]
    start = tuple(x[: args.runs] for x in (state.q, state.X_WO[:, 0], goals))
    for cone in play.CONES:
        shares[cone], turned = in_mujoco(play.Hand(task, robot, cone), policy, start)
        print(f"{cone}: {shares[cone]:.0%} of {args.runs} held in MuJoCo, which turn by {turned:.1f} rad", flush=True)
    return shares


if __name__ == "__main__":
    torch.set_flush_denormal(True)
    sys.exit(main(tyro.cli(Args))["here"] < hands.SHARE)
