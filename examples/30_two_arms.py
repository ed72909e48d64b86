"""Two arms that hold one object by relative and absolute pose, in five lines of dual quaternions.

    python examples/30_two_arms.py

The relative pose x_r = x_1* x_2 of the hands says how they hold the object, the absolute pose x_a = x_1 x_r^(1/2), half
way between them, where it is. Both follow screw motions: the object turns in the hands' midst, which come closer and go
apart again. Either arm follows its own hand's pose by operational space control.

Source: B. V. Adorno, Two-arm manipulation: from manipulators to enhanced human-robot collaboration, 2011.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import torch
import tyro
from pictures import BLUE, GREY, ORANGE, prepare, save
from torch import Tensor

import torchdq
from torchdq import dq
from torchdq.scene import Scene, controllers

ARM = torchdq.robots.load("panda")
BASES = torch.tensor([[1.0, 0, 0, 0, 0, 0, y, 0] for y in (-0.2, 0.2)], dtype=torch.float64)  # 0.8 m apart, along y
HOME = torch.tensor([[0.3, 0.0, 0.0, -2.0, 0.0, 2.0, 0.8], [-0.3, 0.0, 0.0, -2.0, 0.0, 2.0, 0.8]], dtype=torch.float64)
DT = 0.002


@dataclass
class Args:
    seconds: float = 4.0
    """Duration of the motion."""
    out: Path = Path(__file__).parent / "figures"
    """Folder of the picture."""


def relative_and_absolute(x: Tensor) -> tuple[Tensor, Tensor]:
    """Relative and absolute pose of two hands x [..., 2, 8]."""
    x_r = dq.mul(dq.conj(x[..., 0, :]), x[..., 1, :])
    return x_r, dq.mul(x[..., 0, :], dq.exp(0.5 * dq.log_shortest(x_r)))


def hands(x_r: Tensor, x_a: Tensor) -> Tensor:
    """Poses of both hands [..., 2, 8] of their relative and absolute pose."""
    half = dq.exp(0.5 * dq.log_shortest(x_r))
    return torch.stack([dq.mul(x_a, dq.conj(half)), dq.mul(x_a, half)], -2)


def main(args: Args) -> tuple[Tensor, Tensor]:
    """Errors of relative and absolute pose [steps, 6]."""
    t = DT * torch.arange(1, round(args.seconds / DT) + 1, dtype=torch.float64)
    s = 0.5 - 0.5 * torch.cos(2 * math.pi * t / args.seconds)
    x_r, x_a = relative_and_absolute(dq.mul(BASES, torchdq.forward_kinematics(ARM, HOME, ARM.tip)))
    turn = dq.exp(torch.tensor([0.0, 0.0, 0.15, 0.0, 0.0, 0.05], dtype=torch.float64))  # 0.3 rad, and 0.1 m up
    closer = dq.sclerp(dq.exp(torch.zeros(6, dtype=torch.float64)), x_r, 0.8)
    wanted = hands(dq.sclerp(x_r, closer, s), dq.sclerp(x_a, dq.mul(x_a, turn), s))
    in_bases = dq.mul(dq.conj(BASES), wanted)
    reference = torch.nn.functional.pad(in_bases, (0, 12))
    control = controllers.OperationalSpaceControl(kp=900.0, kd=60.0, q_null=HOME)
    path = Scene(ARM, controller=control, dt=DT).rollout(Scene(ARM).start(HOME), reference=reference)
    reached = dq.mul(BASES, torchdq.forward_kinematics(ARM, path.q, ARM.tip))
    pairs = zip(relative_and_absolute(reached), relative_and_absolute(wanted), strict=True)
    errors = [(dq.Pose(found).inverse() @ dq.Pose(goal)).log() for found, goal in pairs]
    prepare()
    figure, (above, over_time) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
    p = dq.translation(reached)
    for k in torch.linspace(0, len(t) // 2, 5).long().clamp(max=len(t) - 1):
        above.plot(p[k, :, 1], p[k, :, 0], color=GREY, linewidth=1.0, label=None if k else "object")
    for k, (name, colour) in enumerate((("right hand", BLUE), ("left hand", ORANGE))):
        above.plot(p[:, k, 1], p[:, k, 0], color=colour, linewidth=2.5, label=name)
    above.set(xlabel="y [m]", ylabel="x [m]", title="Hands from above", aspect="equal", ylim=(0.35, 0.7))
    above.invert_xaxis()  # seen from above, y is to the left of x
    above.legend(loc="lower left", ncols=3, columnspacing=1.0, handlelength=1.2)
    for e, name, colour in zip(errors, ("relative", "absolute"), (BLUE, ORANGE), strict=True):
        print(f"{name} pose: {1e3 * e[:, 3:].norm(dim=-1).max():.2f} mm, {1e3 * e[:, :3].norm(dim=-1).max():.2f} mrad")
        over_time.plot(t, 1e3 * e[:, 3:].norm(dim=-1), color=colour, label=f"{name} pose")
    over_time.set(xlabel="time [s]", ylabel="error [mm]", title="Errors of the two poses", ylim=(0, 7))
    over_time.legend(loc="upper left", ncols=2)
    save(figure, args.out / "two_arms.png")
    return errors[0], errors[1]


if __name__ == "__main__":
    main(tyro.cli(Args))
