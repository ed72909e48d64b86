"""A quadruped of yours stands on its feet: forces, a slope, waves, and a landing and a jump at three steps.

    python examples/24_on_feet.py
    python examples/24_on_feet.py --robot a1.urdf --feet "*_foot" --hip 0 --thigh 0.8 --knee -1.6

Joints of the file are hips, thighs and knees, leg after leg. The figure `out/on_feet.png` shows the robot on flat
ground, on a slope and on waves, and the forces of a landing with steps of 1, 5 and 10 ms.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, ORANGE, prepare, save
from torch import Tensor

import torchdq
from torchdq import Scene, dq, effects, floating
from torchdq.envs.render import Painter
from torchdq.scene import State

STEPS = {1e-3: GREY, 5e-3: BLUE, 1e-2: ORANGE}  # of different durations [s], and their colours
SLOPE = math.radians(10.0)
DROP = 0.1  # height of the fall [m]


@dataclass
class Args:
    robot: str = "go2"
    """File of the robot, or the name of a shipped one."""
    feet: str = "*_foot"
    """Names or pattern of the frames of its feet."""
    hip: float = 0.0
    """Position of the hips at the stand [rad]."""
    thigh: float = 0.8
    """Of the thighs."""
    knee: float = -1.6
    """Of the knees."""
    out: Path = Path("out")
    """Folder of the picture."""


@dataclass
class Quadruped:
    """A robot, its feet, and its stand."""

    robot: torchdq.Robot
    feet: str
    q: Tensor  # [n] of the stand [rad]

    @property
    def weight(self) -> float:
        """Weight [N]."""
        return 9.81 * float(self.robot.mass.sum() + self.robot.base_mass)

    def height(self, q: Tensor) -> Tensor:
        """Height of a level base at which the lowest foot touches the ground [m]."""
        points = self.robot.contact_points(self.feet)
        X = floating.forward_kinematics(self.robot, torch.eye(8, dtype=q.dtype)[0], q, [p.frame for p in points])
        centres = [
            dq.translation(X[k]) + dq.rotate(dq.rotation(X[k]), q.new_tensor(p.center)) for k, p in enumerate(points)
        ]
        return max(p.radius - c[2] for p, c in zip(points, centres, strict=True))

    def scene(self, dt: float, firm: float = 2.0, sink: float = 1e-3, **ground: Any) -> Scene:
        """Scene with servos as firm as half of the weight on one leg asks for, and a ground in which the robot sinks.

        Numbers are tensors, so that scenes with others share their programs.
        """
        kp = self.q.new_tensor(firm * self.weight * float(self.height(self.q)))
        hold = effects.Servo(kp.expand(self.robot.n), (kp / 40.0).expand(self.robot.n), self.robot.limits.effort)
        stiffness = self.q.new_tensor(self.weight / (sink * len(self.robot.contact_points(self.feet))))
        ground = {"normal": self.normal(0.0), **ground} if "surface" not in ground else ground
        contact = effects.Contact(self.feet, stiffness=stiffness, **ground)
        return Scene(self.robot, (effects.Gravity(), effects.RotorInertia(0.01), hold, contact), dt=dt)

    def placed(self, scene: Scene, q: Tensor, above: float = 0.0, tilt: float = 0.0) -> State:
        """State at rest with the feet on the ground, or above it."""
        turned = q.new_tensor([math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0])
        return scene.start(q, X_WB=dq.from_pose(turned, (self.height(q) + above) * self.normal(tilt)))

    def normal(self, tilt: float) -> Tensor:
        """Normal of a plane that rises towards -x."""
        return self.q.new_tensor([math.sin(tilt), 0.0, math.cos(tilt)])


def held(scene: Scene, state: State, target: Tensor, seconds: float) -> State:
    """Path under a target that stays."""
    steps = round(seconds / scene.dt)
    return scene.rollout(state, steps=steps, target=target.expand(steps, -1))


def landing(dog: Quadruped, dt: float) -> tuple[Tensor, Tensor]:
    """Times [s] and sums of the normal forces in weights, of a fall from 10 cm."""
    scene = dog.scene(dt, sink=2e-3)
    path = held(scene, dog.placed(scene, dog.q, above=DROP), dog.q, 0.6)
    force = scene.contacts(path).normal_force.sum(-1) / dog.weight
    return dt * torch.arange(1, len(force) + 1), force


def jump(dog: Quadruped, dt: float) -> float:
    """Height that the base gains in a jump from a crouch, in which the targets of the servos stretch the legs [m]."""
    crouch, stretched = dog.q * 1.5, dog.q * 0.4
    scene = dog.scene(dt, firm=6.0, sink=2e-3)
    ready = held(scene, dog.placed(scene, crouch), crouch, 1.0).last
    path = held(scene, ready, stretched, 1.0)
    return float((dq.translation(path.X_WB)[:, 2]).max() - dq.translation(ready.X_WB)[2])


def creep(dog: Quadruped, dt: float) -> float:
    """Way of the base on a slope of 10 degrees from 5 s to 20 s [m]."""
    scene = dog.scene(dt, normal=dog.normal(SLOPE))
    first = held(scene, dog.placed(scene, dog.q, tilt=SLOPE), dog.q, 5.0).last
    last = held(scene, first, dog.q, 15.0).last
    return float((dq.translation(last.X_WB) - dq.translation(first.X_WB)).norm())


def pictures(dog: Quadruped, path: Path, falls: Sequence[tuple[Tensor, Tensor]]) -> None:
    """Draw the robot on three grounds, and the forces of landings."""
    grounds = {
        "flat ground": {},
        "a slope of 10 degrees": {"normal": dog.normal(SLOPE)},
        "waves": {"surface": lambda x, y: 0.02 * (8.0 * x).sin()},
    }
    figure = plt.figure(figsize=(9, 6.2), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1.2, 1))
    for axes, (name, ground) in zip(above.subplots(1, 3), grounds.items(), strict=True):
        scene = dog.scene(5e-3, **ground)
        tilt = SLOPE if "normal" in ground else 0.0
        end = held(scene, dog.placed(scene, dog.q, above=0.03, tilt=tilt), dog.q, 1.0).last
        axes.imshow(Painter(scene, (420, 420)).frame(end.q, X_WB=end.X_WB)[90:])
        axes.set_axis_off()
        axes.set_title(name)
    axes = below.subplots()
    for (t, force), (dt, colour) in zip(falls, STEPS.items(), strict=True):
        axes.plot(t, force, color=colour, label=f"steps of {1e3 * dt:g} ms")
    axes.set(xlabel="time after a fall from 10 cm begins [s]", ylabel="force of the feet / weight", xlim=(0.1, 0.5))
    axes.legend()
    save(figure, path)


def main(args: Args) -> dict[float, tuple[float, float, float]]:
    """Largest force of a landing in weights, height of a jump [m] and creep [m], by step."""
    shipped = not Path(args.robot).exists()
    robot = torchdq.robots.load(args.robot) if shipped else torchdq.Robot.from_urdf(args.robot, base="floating")
    stand = torch.tensor([args.hip, args.thigh, args.knee], dtype=torch.float64)
    dog = Quadruped(robot, args.feet, stand.repeat(robot.n // 3))
    scene = dog.scene(5e-3)
    begun = dog.placed(scene, dog.q)
    end = held(scene, begun, dog.q, 2.0).last
    seen = scene.contacts(end)
    print(scene.check(begun, target=dog.q))
    forces, z = ", ".join(f"{f:.1f}" for f in seen.normal_force), float(dq.translation(end.X_WB)[2])
    print(f"{robot.name}: forces of the feet {forces} N, weight {dog.weight:.1f} N, base at {z:.3f} m")
    falls = [landing(dog, dt) for dt in STEPS]
    found = {dt: (float(f.max()), jump(dog, dt), creep(dog, dt)) for dt, (_, f) in zip(STEPS, falls, strict=True)}
    for dt, (peak, height, way) in found.items():
        print(f"{1e3 * dt:g} ms: landing {peak:.2f} weights, jump {height:.3f} m, creep in 15 s {1e3 * way:.2g} mm")
    args.out.mkdir(parents=True, exist_ok=True)
    prepare()
    pictures(dog, args.out / "on_feet.png", falls)
    return found


if __name__ == "__main__":
    main(tyro.cli(Args))
