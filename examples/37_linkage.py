"""A four-bar linkage, closed by hand: it swings under gravity, and its loop stays closed.

    python examples/37_linkage.py

The figure `out/linkage.png` shows the linkage at five times, its energy, and the gap of its loop, with two integrators.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, ORANGE, prepare, save
from torch import Tensor

import torchdq
from torchdq import Closure, Scene, dq, effects
from torchdq.scene import State, integrators

STEP, SECONDS = 1e-3, 5.0
METHODS = {
    "LinearlyImplicit": (integrators.LinearlyImplicit(), BLUE),
    "RungeKutta4": (integrators.RungeKutta4(), ORANGE),
}
BARS = {"crank": 0.2, "coupler": 0.4, "rocker": 0.4}  # lengths [m]; as heavy as they are long
GROUND = 0.4  # distance of the pivots [m]
BAR = """<link name="{0}"><inertial><origin xyz="{2} 0 0"/><mass value="{1}"/>
  <inertia ixx="1e-4" ixy="0" ixz="0" iyy="{3}" iyz="0" izz="{3}"/></inertial></link>
  <joint name="{0}_joint" type="continuous"><parent link="{4}"/><child link="{0}"/><origin xyz="{5} 0 0"/>
  <axis xyz="0 -1 0"/></joint>"""
FRAME = """<link name="{0}"/><joint name="to_{0}" type="fixed"><parent link="{1}"/><child link="{0}"/>
  <origin xyz="{2} 0 0"/></joint>"""


@dataclass
class Args:
    out: Path = Path("out")
    """Folder of the picture."""


def linkage() -> torchdq.Robot:
    """Three bars in a row, of which the end of the last one is held at a pivot."""
    text, parent, at = '<robot name="four_bar"><link name="ground"/>', "ground", 0.0
    for name, length in BARS.items():
        text += BAR.format(name, length, length / 2, length**3 / 12, parent, at)
        parent, at = name, length
    text += FRAME.format("end", parent, at) + FRAME.format("pivot", "ground", GROUND)
    return torchdq.Robot.from_urdf(text + "</robot>", tip="end").with_closures(Closure("pivot", "end"))


def swung(robot: torchdq.Robot, q: Tensor, integrator: integrators.Integrator) -> tuple[State, Tensor, Tensor]:
    """States of every step from rest, energies [J] and gaps [m]."""
    scene = Scene(robot, (effects.Gravity(),), integrator=integrator, dt=STEP)
    states = scene.rollout(scene.start(q), steps=round(SECONDS / STEP))
    return states, scene.energy(states).sum(-1), torchdq.closure_errors(robot, states.q).distance[:, 0]


def pictures(path: Path, robot: torchdq.Robot, found: dict[str, tuple[State, Tensor, Tensor]]) -> None:
    """Draw the linkage, its energies and its gaps."""
    figure, panels = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
    states, *_ = found["RungeKutta4"]
    for k, shade in zip(range(0, 400, 80), (0.75, 0.6, 0.45, 0.3, 0.0), strict=True):
        ends = torchdq.forward_kinematics(robot, states.q[k], [*list(BARS), "end"])
        x, _, z = dq.translation(ends).T
        panels[0].plot(x, z, "o-", color=str(shade))
    panels[0].plot([0.0, GROUND], [0.0, 0.0], "^", color=GREY)
    panels[0].set(aspect="equal", xlabel="x [m]", ylabel="z [m]", title="every 80 ms")
    time = STEP * torch.arange(1, len(states.q) + 1)
    for name, (_, energy, gap) in found.items():
        panels[1].plot(time, energy, color=METHODS[name][1], label=name)
        panels[2].semilogy(time, gap.clamp_min(1e-16), color=METHODS[name][1])
    panels[1].set(xlabel="time [s]", title="energy [J]")
    panels[2].set(xlabel="time [s]", title="gap of the loop [m]")
    figure.legend(*panels[1].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    save(figure, path)


def main(args: Args) -> dict[str, tuple[float, float]]:
    """Part of the energy that is lost, and largest gap [m], by integrator."""
    robot, found = linkage(), {}
    q = torchdq.closed(robot, torch.tensor([1.0, -0.6, -1.2], dtype=torch.float64), hold="crank_joint")
    for name, (integrator, _) in METHODS.items():
        found[name] = swung(robot, q, integrator)
    result = {name: (float(1 - E[-1] / E[0]), float(gap.max())) for name, (_, E, gap) in found.items()}
    for name, (lost, gap) in result.items():
        print(f"{name}: loses {lost:.1e} of its energy in {SECONDS:g} s, gap at most {gap:.1e} m")
    still = torch.zeros_like(q)
    tau, _ = torchdq.constrained_inverse_dynamics(robot, q, still, still, actuated="crank_joint")
    print(f"a motor at the crank holds it at rest with {float(tau[0]):.4f} N m")
    args.out.mkdir(parents=True, exist_ok=True)
    prepare()
    pictures(args.out / "linkage.png", robot, found)
    return result


if __name__ == "__main__":
    main(tyro.cli(Args))
