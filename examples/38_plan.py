"""An arm that swings around a post: a motion that is planned within torque limits, and followed with a payload.

    python examples/38_plan.py

The figure `out/plan.png` shows both ways of the tool from above, with and without the cost of being near, the distance
from the post, and the torques as shares of their limits.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, INK, ORANGE, prepare, save
from torch import Tensor

import torchdq
from torchdq import Scene, dq, effects, optimal
from torchdq.objects import Cylinder
from torchdq.robot import ContactPoint

ROBOT = torchdq.Robot.from_urdf(Path(__file__).parent / "arm.urdf")
LINKS = ["shoulder", "forearm", "wrist_1", "wrist_2", "tool"]  # where the arm is drawn
SCENE = Scene(ROBOT, (effects.Gravity(), effects.Viscous()), dt=0.02)
STEPS = 30
START, END = (torch.tensor([turn, 0.4, 1.2, 0.0, 0.6, 0.0], dtype=torch.float64) for turn in (-0.9, 0.9))
POST = Cylinder("post", mass=1.0, radius=0.06, length=2.0)  # upright
SPHERES = (
    ContactPoint("tool", radius=0.05),
    ContactPoint("wrist_1", radius=0.08),
    ContactPoint("forearm", center=(0.0, 0.02, 0.19), radius=0.08),
)
JOINTS = (("1", BLUE), ("2", ORANGE), ("3", INK), ("4", GREY), ("5, 6", GREY), ("", GREY))  # words and colours
PAYLOAD = 0.5  # that the plan does not know of [kg]


@dataclass
class Args:
    out: Path = Path("out")
    """Folder of the picture."""


class Found(NamedTuple):
    """Plan with a cost that is of interest, distances of the arm from the post, and the same without that cost."""

    plan: optimal.Plan
    distance: Tensor
    straight: optimal.Plan
    struck: Tensor
    missed: tuple[float, float]  # distances from the goal with the payload, with gains and without [m]


def places(q: Tensor, names: list[str] | str = "tool") -> Tensor:
    """Positions of frames [m]."""
    return dq.translation(torchdq.forward_kinematics(ROBOT, q, names))


def planned() -> Found:
    """Plans with and without the post."""
    goal, middle = places(END), places(0.5 * (START + END))
    X_WO = dq.from_pose(torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64), middle)[None]
    costs = [optimal.Torques(1e-6), optimal.Speeds(1e-3), optimal.JointLimits(100.0)]
    final = [optimal.Point("tool", goal, 1e3), optimal.Speeds(10.0)]
    away = optimal.Spheres(1e3, SPHERES, (POST,), X_WO)
    free, around = (optimal.Problem(SCENE, STEPS, each, final) for each in (costs, [*costs, away]))
    straight, plan = (optimal.solve(problem, SCENE.start(START)) for problem in (free, around))
    near = [torchdq.distances(ROBOT, x.states.q, SPHERES, (POST,), X_WO).distance.amin(-1) for x in (plan, straight)]
    loaded = SCENE.replace(effects=(*SCENE.effects, effects.Payload(PAYLOAD)))
    followed = loaded.rollout(loaded.start(START), policy=plan.policy, steps=STEPS)
    blind = loaded.rollout(loaded.start(START), plan.torque)
    missed = [float((places(states.q[-1]) - goal).norm()) for states in (followed, blind)]
    return Found(plan, near[0], straight, near[1], (missed[0], missed[1]))


def picture(path: Path, found: Found) -> None:
    """Draw the arm from above, distances and torques."""
    figure, panels = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained", width_ratios=(1.1, 1, 1))
    x, y, _ = places(0.5 * (START + END)).tolist()
    panels[0].add_patch(plt.Circle((x, y), float(POST.radius), color=ORANGE, alpha=0.4, linewidth=0))
    for k, shade in zip(range(0, STEPS + 1, 6), (0.8, 0.7, 0.6, 0.5, 0.3, 0.0), strict=True):
        panels[0].plot(*places(found.plan.states.q[k], LINKS)[:, :2].T, "o-", color=str(shade), markersize=3)
    time = SCENE.dt * torch.arange(STEPS + 1)
    for plan, near, name, colour in (
        (found.straight, found.struck, "without the post", GREY),
        (found.plan, found.distance, "around it", BLUE),
    ):
        panels[0].plot(*places(plan.states.q)[:, :2].T, color=colour)
        panels[1].plot(time, near, color=colour, label=name)
    panels[0].set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="from above, every 0.12 s")
    panels[1].axhline(0.0, color=ORANGE, linewidth=1.0)
    panels[1].set(xlabel="time [s]", title="distance from the post [m]")
    panels[1].legend()
    share = found.plan.torque / ROBOT.limits.effort
    for k, (words, colour) in enumerate(JOINTS):
        panels[2].plot(time[:-1], share[:, k], color=colour)
        panels[2].text(-0.015, share[0, k], words, color=colour, ha="right", va="center")
    panels[2].set(xlabel="time [s]", xlim=(-0.13, 0.6), ylim=(-1.05, 1.05), title="torques of joints 1 to 6 / limits")
    save(figure, path)


def main(args: Args) -> Found:
    """Plan, print and draw."""
    found = planned()
    for name, plan, near in (
        ("without the post", found.straight, found.struck),
        ("around it", found.plan, found.distance),
    ):
        print(f"{name}: cost {float(plan.cost):.3f}, {int(plan.iterations)} iterations, nearest {near.min():+.3f} m")
    gains, blind = found.missed
    print(f"with {PAYLOAD} kg more than planned: {gains:.3f} m from the goal by its gains, {blind:.3f} m without")
    args.out.mkdir(parents=True, exist_ok=True)
    prepare()
    picture(args.out / "plan.png", found)
    return found


if __name__ == "__main__":
    main(tyro.cli(Args))
