"""A tip that follows a circle at 0.3 m/s, through a singular configuration of the wrist, with a kilohertz controller.

    python examples/28_circle.py

A Panda and a UR10e follow circles of 0.1 m by operational space control with the exact model, torques held for a
millisecond. The Panda's wrist is regular, and its error is that of holding the torques. The UR10e's is straight in the
midst of its circle: there Lambda is damped, the tip leaves the circle a little, and torques stay bounded.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import torch
import tyro
from pictures import BLUE, prepare, save
from torch import Tensor

import torchdq
from torchdq import Robot, dq
from torchdq.scene import Scene, controllers, integrators

RADIUS, RATE, DT = 0.1, math.pi, 1e-3  # [m], [rad/s], [s]
STARTS = {  # posture in the midst of the circle
    "panda": (0.0, -0.4, 0.0, -2.0, 0.0, 1.7, 0.8),
    "ur10e": (0.3, -1.2, 1.9, -0.6, 0.0, 0.4),
}


@dataclass
class Args:
    seconds: float = 4.0
    """Duration of the motion; the error is counted after half a second."""
    out: Path = Path(__file__).parent / "figures"
    """Folder of the picture."""


def circle(robot: Robot, middle: Tensor, t: Tensor) -> Tensor:
    """Reference [..., 20] at times t: a circle through the pose of the posture in the midst, in a vertical plane."""
    X, phase, o = torchdq.forward_kinematics(robot, middle, robot.tip), RATE * t + math.pi, torch.zeros_like(t)
    s, c = phase.sin(), phase.cos()
    p, v, a = (
        RADIUS * torch.stack(x, -1)
        for x in ((o, s, c - 1), (o, RATE * c, -RATE * s), (o, -(RATE**2) * s, -(RATE**2) * c))
    )
    still = torch.zeros_like(p)
    pose = dq.from_pose(dq.rotation(X).expand(*t.shape, 4), dq.translation(X) + p)
    return torch.cat([pose, still, v, still, a], -1)


def posture(robot: Robot, X: Tensor, q: Tensor) -> Tensor:
    """Posture with the tip at X, by Newton's method from another one."""
    for _ in range(30):
        e = (dq.Pose(torchdq.forward_kinematics(robot, q, robot.tip)).inverse() @ dq.Pose(X)).log()
        q = q + torch.linalg.lstsq(torchdq.jacobian(robot, q, robot.tip), e).solution
    return q


def followed(name: str, seconds: float) -> dict[str, Tensor]:
    """Times, errors of the tip [m, rad], manipulabilities and torques [N m] of a motion."""
    robot, middle = torchdq.robots.load(name), torch.tensor(STARTS[name], dtype=torch.float64)
    t = DT * torch.arange(round(seconds / DT) + 1, dtype=torch.float64)
    reference = circle(robot, middle, t)
    q = posture(robot, reference[0, :8], middle + 0.3)
    qd = torch.linalg.lstsq(torchdq.jacobian(robot, q, robot.tip, "world"), reference[0, 8:14]).solution
    control = controllers.OperationalSpaceControl(kp=400.0, kd=40.0, expressed="world", q_null=q)
    scene = Scene(robot, controller=control, integrator=integrators.RungeKutta4(), dt=DT)
    path = scene.rollout(scene.start(q, qd), reference=reference[:-1])
    t, reference = t[1:], reference[1:]  # states are those at the ends of the steps
    X, goal = torchdq.forward_kinematics(robot, path.q, robot.tip), reference[:, :8]
    law = {"kp": 400.0, "kd": 40.0, "expressed": "world", "q_null": q.expand(path.q.shape)}
    tau = torchdq.operational_space_control(robot, path.q, path.qd, goal, reference[:, 8:14], reference[:, 14:], **law)
    return {
        "time": t,
        "position": (dq.translation(X) - dq.translation(goal)).norm(dim=-1),
        "rotation": (dq.Pose(X).inverse() @ dq.Pose(goal)).log()[:, :3].norm(dim=-1),
        "manipulability": torchdq.manipulability(robot, path.q),
        "torque": tau,
    }


def main(args: Args) -> dict[str, dict[str, Tensor]]:
    """Motions by robot."""
    found = {name: followed(name, args.seconds) for name in STARTS}
    prepare()
    figure, rows = plt.subplots(3, 2, figsize=(9, 7), sharex=True, sharey="row", layout="constrained")
    for (name, x), column in zip(found.items(), rows.T, strict=True):
        late = x["time"] > 0.5
        rms, most = x["position"][late].square().mean().sqrt(), x["position"][late].max()
        print(f"{name}: tip {1e3 * rms:.4f} mm rms, {1e3 * most:.3f} mm at most, {x['torque'].abs().max():.0f} N m")
        column[0].semilogy(x["time"], 1e3 * x["position"] + 1e-6, color=BLUE)
        column[1].semilogy(x["time"], x["manipulability"], color=BLUE)
        for k, row in enumerate(x["torque"].T):
            column[2].plot(x["time"], row, color=plt.cm.turbo(0.1 + 0.13 * k), label=f"joint {k + 1}")
        column[0].set_title({"panda": "Panda, regular wrist", "ur10e": "UR10e, through a singular wrist"}[name])
        column[2].set_xlabel("time [s]")
    for panel, label in zip(rows[:, 0], ("tip error [mm]", "manipulability", "torque [N m]"), strict=True):
        panel.set_ylabel(label)
    figure.legend(*rows[2, 0].get_legend_handles_labels(), loc="outside lower center", ncols=7, columnspacing=1.2)
    save(figure, args.out / "circle.png")
    return found


if __name__ == "__main__":
    main(tyro.cli(Args))
