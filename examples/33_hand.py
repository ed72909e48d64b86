"""A hand closes on a cube, lifts it, and holds it: forces of the fingers, and what the cube does, at three steps.

    python examples/33_hand.py

The figure `out/hand.png` shows the grasp, the height of the cube, and the normal force of a finger with steps of 1, 5
and 10 ms.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, ORANGE, prepare, save
from torch import Tensor

import torchdq
from torchdq import Scene, dq, effects
from torchdq.envs.render import Painter
from torchdq.objects import Box
from torchdq.scene import State

STEPS = {1e-3: GREY, 5e-3: BLUE, 1e-2: ORANGE}  # of different durations [s], and their colours
CLOSES, LIFTS, HOLDS = 0.5, 1.0, 1.0  # durations [s]
PLACE, HEIGHT = 0.5, 0.2  # of the cube before the arm, and by how much it is lifted [m]
OPEN, SHUT = 0.04, 0.005  # of the gripper, the second tighter than the cube [m]
START = (0.0, 0.1, 0.0, -2.57, 0.0, 2.68, 0.785, OPEN)  # of inverse kinematics


@dataclass
class Args:
    out: Path = Path("out")
    """Folder of the picture."""


def scene(dt: float) -> Scene:
    """Panda with its gripper, a cube, and what touches what."""
    robot, cube = torchdq.robots.load("panda_hand"), Box("cube", mass=0.1, size=(0.04, 0.04, 0.04))
    parts = (
        effects.Gravity(),
        effects.RotorInertia(),
        effects.Viscous(),
        effects.Servo(1000.0, 100.0, limit=robot.limits.effort),
        effects.Contact("*_finger", on="cube", friction=1.0),
        effects.Contact("cube", friction=0.5),
    )
    return Scene(robot, parts, objects=(cube,), dt=dt)


def arm(robot: torchdq.Robot, z: float, opening: float) -> Tensor:
    """Positions [n] with the tip at a height above the place of the cube, pointing down."""
    X = dq.from_pose(torch.tensor([0.0, 1.0, 0.0, 0.0]).double(), torch.tensor([PLACE, 0.0, z]).double())
    q = torchdq.inverse_kinematics(robot, X, "tcp", start=torch.tensor(START).double()).q
    return torch.cat([q[:-1], q.new_tensor([opening])])


def lifted(scene: Scene) -> tuple[State, State]:
    """First state of a grasp, and all that follow."""
    low, high = (arm(scene.robot, z, SHUT) for z in (0.02, 0.02 + HEIGHT))
    counts = [round(seconds / scene.dt) for seconds in (CLOSES, LIFTS, HOLDS)]
    share = torch.cat([torch.zeros(counts[0]), torch.linspace(0, 1, counts[1]), torch.ones(counts[2])]).double()
    cube = dq.from_pose(torch.eye(4).double()[0], torch.tensor([[PLACE, 0.0, 0.02]]).double())
    begun = scene.start(arm(scene.robot, 0.02, OPEN), X_WO=cube)
    return begun, scene.rollout(begun, target=low + share[:, None] * (high - low))


def pictures(path: Path, found: dict[float, tuple[Scene, State, Tensor]]) -> None:
    """Draw the grasp, the height of the cube and the force of a finger."""
    figure = plt.figure(figsize=(9, 6.2), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1.1, 1))
    shown, states, _ = found[5e-3]
    size = 2400  # of an image, which is cut to the hand [pixels]
    painter = Painter(shown, (size, size))
    for axes, seconds in zip(above.subplots(1, 3), (shown.dt, CLOSES, CLOSES + LIFTS), strict=True):
        k = round(seconds / shown.dt) - 1
        image = painter.frame(states.q[k], X_WO=states.X_WO[k])
        right, up = painter.project(dq.translation(states.X_WO[k])[None].numpy())[0].ravel().astype(int)
        axes.imshow(image[size - up - 330 : size - up + 120, right - 300 : right + 300])
        axes.set_axis_off()
        axes.set_title(f"{seconds:.3g} s")
    for axes, words in zip(
        below.subplots(1, 2), ("height of the cube [m]", "normal force of a finger [N]"), strict=True
    ):
        for dt, (_, states, force) in found.items():
            y = dq.translation(states.X_WO[:, 0])[:, 2] if "height" in words else force
            axes.plot(dt * torch.arange(1, len(y) + 1), y, color=STEPS[dt], label=f"steps of {1e3 * dt:g} ms")
        axes.set(xlabel="time [s]", ylabel=words)
        axes.legend()
    save(figure, path)


def main(args: Args) -> dict[float, tuple[float, float, float]]:
    """Normal force of a finger [N], creep of the cube in the hand in half a second [m], and its turn [rad], by step."""
    drawn, found = {}, {}
    for dt in STEPS:
        taken = scene(dt)
        begun, states = lifted(taken)
        force = taken.contacts(states, "left_finger").normal_force.sum(-1)
        tip = torchdq.forward_kinematics(taken.robot, states.q, "tcp")
        held = dq.translation(dq.mul(dq.conj(tip), states.X_WO[:, 0]))  # seen from the hand
        turn = 2.0 * dq.rotation(states.last.X_WO[0])[1:].norm()
        found[dt] = tuple(float(x) for x in (force[-1], (held[-1] - held[-round(0.5 / dt)]).norm(), turn))
        drawn[dt] = taken, states, force
        assert taken.grasped(states.last, "cube") and not taken.grasped(begun, "cube")
        end, creep, turned = found[dt]
        print(f"{1e3 * dt:g} ms: {end:.1f} N, creeps by {1e9 * creep:.2g} nm, turned by {turned:.2g} rad")
    args.out.mkdir(parents=True, exist_ok=True)
    prepare()
    pictures(args.out / "hand.png", drawn)
    return found


if __name__ == "__main__":
    main(tyro.cli(Args))
