"""First torques of your own arm: its URDF, its report, checks, torques along a motion, and gradients.

    python examples/20_own_urdf.py
    python examples/20_own_urdf.py --robot my_arm.urdf

Three checks need no other robot library: the torques of an arm at rest are the gradient of its potential energy; the
power of the torques is the rate of its energy; and the eigenvalues of the mass matrix are positive. A fourth one
compares the torques with Pinocchio, if it is installed. The figure `out/own_urdf.png` shows the terms of the torques.
"""

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, ORANGE, prepare, save
from torch import Tensor

import torchdq

ARM = Path(__file__).with_name("arm.urdf")
SHOWN = 4  # joints in the picture: those with the largest torques


@dataclass
class Args:
    robot: Path = ARM
    """URDF of the arm."""
    seconds: float = 2.0
    """Duration of the motion [s]."""
    batch: int = 4096
    """Number of random states that are checked."""
    out: Path = Path("out")
    """Folder of the picture."""


def checks(robot: torchdq.Robot, path: Path, batch: int) -> dict[str, float]:
    """Errors of the checks, relative to the largest torque."""
    q, qd, qdd = torch.randn(3, batch, robot.n, dtype=torch.float64)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    largest = tau.abs().max()

    held = torchdq.inverse_dynamics(robot, q, 0 * q, 0 * q)
    slope = torch.func.grad(lambda q: torchdq.potential_energy(robot, q).sum())(q)

    def energy(q: Tensor, qd: Tensor) -> Tensor:
        return torchdq.kinetic_energy(robot, q, qd) + torchdq.potential_energy(robot, q)

    _, rate = torch.func.jvp(energy, (q, qd), (qd, qdd))
    found = {
        "torques at rest are slopes of the potential energy": (held - slope).abs().max() / largest,
        "power of the torques is the rate of the energy": (rate - (tau * qd).sum(-1)).abs().max() / largest,
        "the mass matrix has positive eigenvalues": (torch.linalg.eigvalsh(torchdq.mass_matrix(robot, q)) <= 0).sum(),
    }
    if importlib.util.find_spec("pinocchio") is not None:
        import pinocchio

        model = pinocchio.buildModelFromUrdf(str(path))
        data = model.createData()
        if list(model.names)[1:] == list(robot.joint_names) and model.nq == robot.n:
            rows = [pinocchio.rnea(model, data, *(x.numpy() for x in row)) for row in zip(q, qd, qdd, strict=True)]
            found["the torques are Pinocchio's"] = (tau - torch.from_numpy(np.array(rows))).abs().max() / largest
    return {name: float(x) for name, x in found.items()}


def motion(robot: torchdq.Robot, seconds: float, rows: int = 400) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Times [rows] and a motion [rows, n] from rest to rest, a polynomial of degree five."""
    s = torch.linspace(0, 1, rows, dtype=torch.float64)[:, None]
    start = torch.where(torch.arange(robot.n) % 2 == 0, 0.3, -0.6).double()
    way = torch.where(torch.arange(robot.n) % 2 == 0, 0.9, 1.2).double()
    q = start + way * (10 * s**3 - 15 * s**4 + 6 * s**5)
    qd = way * (30 * s**2 - 60 * s**3 + 30 * s**4) / seconds
    qdd = way * (60 * s - 180 * s**2 + 120 * s**3) / seconds**2
    return s[:, 0] * seconds, q, qd, qdd


def main(args: Args) -> dict[str, float]:
    """Errors of the checks by name."""
    torch.manual_seed(0)
    robot = torchdq.Robot.from_urdf(args.robot)
    print(robot.report())
    found = checks(robot, args.robot, args.batch)
    for name, error in found.items():
        print(f"{name}: error {error:.1e}")

    time, q, qd, qdd = motion(robot, args.seconds)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    M, c, g, _ = torchdq.closed_form(robot, q, qd)
    parts = {"gravity g": (g, GREY), "inertia M qdd": ((M @ qdd[..., None])[..., 0], BLUE), "Coriolis c": (c, ORANGE)}

    mass = robot.mass.clone().requires_grad_()
    effort = torchdq.inverse_dynamics(robot.replace(mass=mass), q, qd, qdd).square().mean()
    (slopes,) = torch.autograd.grad(effort, mass)
    name, slope = robot.link_names[int(slopes.argmax())], float(slopes.max())
    print(f"mean squared torque {effort.item():.0f} (N m)^2; a kilogram more in {name!r} adds most, {slope:.0f}")

    prepare()
    order = tau.abs().amax(0).argsort(descending=True)[:SHOWN].sort().values
    figure, grid = plt.subplots(2, 2, figsize=(9, 5), sharex=True, layout="constrained")
    for joint, panel in zip(order.tolist(), grid.ravel(), strict=False):
        panel.plot(time, tau[:, joint], color="black", linewidth=2.5, label="torque tau")
        for name, (part, colour) in parts.items():
            panel.plot(time, part[:, joint], color=colour, label=name)
        panel.set_title(robot.joint_names[joint])
    figure.supxlabel("time [s]", fontsize=11)
    figure.supylabel("torque [N m]", fontsize=11)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    save(figure, args.out / "own_urdf.png")
    return found


if __name__ == "__main__":
    found = main(tyro.cli(Args))
    sys.exit(0 if max(found.values()) < 1e-9 else 1)
