"""A thousand Pandas under computed torque, as a film: the figure at the top of the README.

    python examples/00_a_thousand_arms.py

One scene steps all arms at once. Every arm has its own masses and friction; the common controller uses the nominal
model, so both are disturbances. A wave runs through the references of the arms. The film is one period of the wave, and
loops seamlessly. The panels on the right show the torques of the orange arm.
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import films
import numpy as np
import torch
import tyro
from films import CHOSEN, FAST, FOG, INK, QUIET, SLOW
from matplotlib import pyplot as plt
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from torch import Tensor

import torchdq
from torchdq import Scene, effects
from torchdq.envs.render import Skeleton
from torchdq.scene import controllers, integrators

WIDTH, HEIGHT, VIEW = 960, 440, 640  # of the film, and width of its part with the arms [pixels]
EYE = np.array([0.0, -7.5, 4.4])  # place of the camera [m]
PITCH, FOCUS = 0.40, 700.0  # how far it looks down [rad], its focal length [pixels]
SPACING, REACH = 1.25, 120  # of the lattice of arms [m]; its rows
PERIOD = 4.0  # of the wave [s]
KP, KD = 400.0, 40.0  # of the controller [1/s^2, 1/s]
ROTORS = 0.1  # inertia of the motors at their joints [kg m^2]

double = partial(torch.tensor, dtype=torch.float64)


@dataclass
class Args:
    arms: int = 1000
    """Number of arms."""
    frames: int = 48
    """Images of the film."""
    step: float = 2e-3
    """Step of the simulation [s]."""
    quality: int = 40
    """Quality of the images, 1 to 100."""
    out: Path = Path("out")
    """Folder of the film."""


class Motion(NamedTuple):
    """Quantities drawn of all arms, each [frame, arm, joint]."""

    q: Tensor
    qd: Tensor
    tau: Tensor
    error: Tensor


def project(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [..., 2] from the lower left corner, and distances along the axis of the camera [...] [m]."""
    x = x - EYE
    c, s = math.cos(PITCH), math.sin(PITCH)
    depth, up = x[..., 1] * c - x[..., 2] * s, x[..., 1] * s + x[..., 2] * c
    return np.stack([x[..., 0], up], -1) * (FOCUS / depth)[..., None] + (VIEW / 2, 0.27 * HEIGHT), depth


def places(count: int) -> np.ndarray:
    """Places [count, 3] on the ground [m]: the nearest ones of a lattice that the camera sees, far ones first."""
    x, y = np.meshgrid(np.arange(-REACH, REACH + 1.0), np.arange(REACH))
    lattice = SPACING * np.stack([x + y % 2 / 2, y, 0 * x], -1).reshape(-1, 3)
    across = project(lattice)[0][:, 0]
    seen = lattice[(across > -5) & (across < VIEW - 28)]
    return seen[np.argsort(seen[:, 1], kind="stable")[:count]][::-1].copy()


def simulated(robot: torchdq.Robot, at: np.ndarray, frames: int, step: float) -> Motion:
    """Motion of all arms over one period, after one in which they settle."""
    torch.manual_seed(0)
    arms, n = len(at), robot.n
    many = robot.replace(mass=robot.mass * (1 + 0.1 * torch.randn(arms, n, dtype=torch.float64)).clamp(0.7, 1.3))
    share = 1 + torch.rand(arms, n, dtype=torch.float64)
    friction = (effects.Viscous(0.5 * share), effects.Stribeck(0.5 * share, 0.8 * share))
    control = controllers.ComputedTorque(KP, KD, model=robot)
    scene = Scene(
        many, (effects.Gravity(), *friction), integrator=integrators.LinearlyImplicit(), controller=control, dt=step
    )

    phase = torch.from_numpy(0.55 * np.hypot(at[:, 0], at[:, 1] + 4.0))[:, None]  # circles around a point in front
    rest, swing = double([0.0, -0.35, 0.0, -1.9, 0.0, 1.6, 0.8]), double([0.9, 0.45, 0.3, 0.5, 0.6, 0.5, 0.8])
    turns, lead = double([1, 1, 2, 2, 1, 2, 1]), double([0.0, 1.6, 0.5, 0.0, 1.0, 2.0, 0.3])
    w = 2 * math.pi * turns / PERIOD

    def reference(t: float) -> tuple[Tensor, Tensor, Tensor]:
        angle = w * t + lead - turns * phase
        return rest + swing * angle.sin(), swing * w * angle.cos(), -swing * w**2 * angle.sin()

    period = round(PERIOD / step)
    shown = {period + k * period // frames for k in range(frames)}
    state, found = scene.start(*reference(0.0)[:2]), []
    with torch.inference_mode():
        for k in range(max(shown) + 1):
            now = reference(k * step)
            if k in shown:
                tau = torchdq.computed_torque(robot, state.q, state.qd, *now, KP, KD)
                found.append((state.q, state.qd, tau, now[0] - state.q))
            state = scene.step(state, reference=torch.cat(now, -1))
    return Motion(*map(torch.stack, zip(*found, strict=True)))


def torque_panels(figure: Figure, tau: np.ndarray) -> Iterator[None]:
    """Draw torques [frame, joint] over the period; every time it is asked, a dot moves on."""
    time = np.linspace(0.0, PERIOD, len(tau) + 1)
    dots = []
    for j, curve in enumerate(np.concatenate([tau, tau[:1]]).T):
        panel = figure.add_axes((0.73, 0.80 - 0.117 * j, 0.245, 0.092), facecolor="none")
        low, high = curve.min(), curve.max()
        room = 0.2 * (high - low) + 1e-3
        panel.set(xlim=(0, PERIOD), ylim=(low - room, high + room), xticks=[])
        panel.set_yticks([low, high], [f"{x:.0f}" if abs(x) >= 9.5 else f"{x:.1f}" for x in (low, high)])
        panel.tick_params(length=0, labelsize=7.5, labelcolor=QUIET, pad=3)
        panel.spines[:].set_visible(False)
        panel.axhline(low - room, color=FOG, linewidth=1)
        panel.text(1.0, 0.97, f"joint {j + 1}", transform=panel.transAxes, size=7.5, color=QUIET, ha="right")
        panel.plot(time, curve, color=CHOSEN, linewidth=1.4)
        dots += panel.plot([], [], "o", color="white", markersize=4.5)
    for t, row in zip(time, tau, strict=False):
        for dot, x in zip(dots, row, strict=True):
            dot.set_data([t], [x])
        yield


def arms_moving(figure: Figure, robot: torchdq.Robot, at: np.ndarray, motion: Motion, chosen: int) -> Iterator[None]:
    """Draw all arms and their shadows; every time it is asked, they move on."""
    drawn = films.Bodies(figure, (VIEW, HEIGHT), project, EYE, FOCUS)
    skeleton, (_, depth) = Skeleton(robot), project(at)
    bodies = [body for _, body in skeleton.bodies]
    far = ((depth - depth.min()) / max(np.ptp(depth), 1e-9))[:, None]
    fog = 0.93 * far**0.6
    slow, fast, mist = (np.array(to_rgb(colour)) for colour in (SLOW, FAST, FOG))
    for q, qd in zip(motion.q, motion.qd.norm(dim=-1).numpy(), strict=True):
        speed = np.clip(qd / 3.2, 0, 1)[:, None]  # the faster, the brighter
        colours = (slow * (1 - speed) + fast * speed) * (1 - fog) + mist * fog
        colours[chosen] = to_rgb(CHOSEN)
        drawn.add(bodies, skeleton.placed(q)[1], at, colours)
        drawn.show(0.3)
        yield


def main(args: Args) -> tuple[Path, float]:
    """File of the film, and the largest distance of an arm from its reference [rad]."""
    torch.set_num_threads(1)
    robot, at = torchdq.robots.load("panda"), places(args.arms)
    robot = robot.replace(armature=torch.full_like(robot.mass, ROTORS))
    chosen = int(np.argmin(np.linalg.norm(at - EYE, axis=-1)))
    motion = simulated(robot, at, args.frames, args.step)

    with plt.rc_context({"font.size": 10, "text.color": INK}):
        subtitle = "computed torque, with unknown masses and friction"
        figure = films.card(WIDTH, HEIGHT, f"{len(at)} arms, one program", subtitle)
        arms = arms_moving(figure, robot, at, motion, chosen)
        torques = torque_panels(figure, motion.tau[:, chosen].numpy())
        figure.text(0.70, 0.935, "torques of the orange arm [N m]", va="center")
        path, pace = args.out / "arms.webp", round(1e3 * PERIOD / args.frames)
        films.save(figure, zip(arms, torques, strict=True), path, pace, args.quality)
    return path, float(motion.error.abs().max())


if __name__ == "__main__":
    path, error = main(tyro.cli(Args))
    print(f"{path}, {path.stat().st_size / 1e6:.2f} MB; no arm was farther than {error:.2f} rad from its reference")
    sys.exit(0 if error < 0.5 else 1)
